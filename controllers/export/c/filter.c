
/* --- the Kalman filter ----------------------------------------------------------------------------- */

/* What blends the design points: the one before the speed asked for, and the next one. */
typedef struct {
    const design_point *point[2];
    float weight[2];
    int count;
} blend;

static void deviation(const float *state, const design_point *point, float *out)
{
    for (int j = 0; j < STATES; j++)
        out[j] = state[j] - point->state_trim[j];
}

void coax_reset(coax_controller *c)
{
    for (int j = 0; j < STATES; j++)
        c->state[j] = FIRST_STATE[j];
    for (int j = 0; j < INTEGRALS; j++)
        c->integral[j] = 0.0f;
    for (int j = 0; j < COAX_COMMANDS; j++)
        c->action[j] = c->asked[j] = 0.0f;
    c->asked[DOWN] = -HOVER_HEIGHT;
    c->speed = 0.0f;
    c->nearest = c->last = -1.0f; /* none yet: no distance is near it */
    c->plate = 1.0f;
    c->row = c->periods = 0;
}

/* 0 up to `first`, 1 from `last` on, linear between them. */
static float share_between(float value, float first, float last)
{
    return within((value - first) / (last - first), 0.0f, 1.0f);
}

/* How far the setpoint may be away, by axis: less where the machine was blown back from where it has
 * been, and at a busy start.
 */
static void reach(coax_controller *c, const float *way, float *farthest)
{
    const float distance = hypotf(way[FORWARD], way[RIGHT]);
    const float calm = (1.0f - share_between(PERIOD * (float)c->periods, CALM_FIRST, CALM_LAST))
                       * share_between(c->plate, BUSY_FIRST, BUSY_LAST);
    float place;

    if (isfinite(distance)) {
        c->nearest = fabsf(distance - c->last) < NEW_TARGET ? fminf(c->nearest, distance) : distance;
        c->last = distance;
    }
    place = REACH_PLACE + share_between(c->last - c->nearest, BLOWN_FIRST, BLOWN_LAST)
                              * (REACH_RETURN - REACH_PLACE);
    farthest[AXIS_PLACE] = place + calm * (fminf(place, CALM_PLACE) - place);
    farthest[AXIS_HEIGHT] = REACH_HEIGHT;
    farthest[AXIS_HEADING] = (1.0f - calm) * REACH_HEADING;
}

/* The setpoint has moved: so has the estimate, which is relative to it. */
static void follow(coax_controller *c, const float *before, float heading)
{
    float forward = c->asked[NORTH] - before[NORTH], right = c->asked[EAST] - before[EAST];
    turn(&forward, &right, -heading);
    if (STATE_X >= 0)
        c->state[STATE_X] -= forward;
    if (STATE_Y >= 0)
        c->state[STATE_Y] -= right;
    if (STATE_Z >= 0)
        c->state[STATE_Z] -= c->asked[DOWN] - before[DOWN];
    if (STATE_PSI >= 0)
        c->state[STATE_PSI] -= wrapped(c->asked[HEADING] - before[HEADING]);
}

/* One design's part: readings as deviations from its trim, added to `reading`, and what those that are
 * new make of the state, added to `change`; both by weight.
 */
static void correct_by(const coax_controller *c, const design_point *p, float weight,
                       const float *seen, float *reading, float *change)
{
    const float(*gain)[STATES] = c->periods ? p->gain[c->row] : p->first_gain;
    float y[READINGS], expected[READINGS], dx[STATES], du[COAX_COMMANDS];

    deviation(c->state, p, dx);
    for (int j = 0; j < COAX_COMMANDS; j++)
        du[j] = p->offset[j] + ACTION_SCALE[j] * c->action[j];
    for (int k = 0; k < READINGS; k++) {
        expected[k] = 0.0f;
        for (int j = 0; j < STATES; j++)
            expected[k] += p->C[k][j] * dx[j];
        for (int j = 0; j < COAX_COMMANDS; j++)
            expected[k] += p->D[k][j] * du[j];
        y[k] = seen[PLACE[k]];
    }
    if (READ_PSI >= 0) { /* horizontal pairs, turned into the heading */
        if (!isfinite(y[READ_PSI]))
            y[READ_PSI] = expected[READ_PSI] + p->reading_trim[READ_PSI];
        for (int j = 0; j < PAIRS; j++)
            turn(&y[PAIR[j][0]], &y[PAIR[j][1]], -y[READ_PSI]);
    }
    for (int k = 0; k < READINGS; k++) {
        float innovation;
        y[k] -= p->reading_trim[k];
        if (!isfinite(y[k])) { /* no number, no information */
            reading[k] += weight * expected[k];
            continue;
        }
        if (k == READ_PSI)
            y[k] = wrapped(y[k]);
        reading[k] += weight * y[k];
        if (FLAG[k] >= 0 && !(seen[FLAG[k]] > 0.5f))
            continue;
        innovation = weight * (k == READ_PSI ? wrapped(y[k] - expected[k]) : y[k] - expected[k]);
        for (int j = 0; j < STATES; j++)
            change[j] += innovation * gain[k][j];
    }
}

/* Readings as deviations from trim into `reading`, and the state corrected by those that are new. */
static void correct(coax_controller *c, const blend *b, const float *seen, float *reading)
{
    float change[STATES] = {0.0f};

    for (int k = 0; k < READINGS; k++)
        reading[k] = 0.0f;
    for (int s = 0; s < b->count; s++)
        correct_by(c, b->point[s], b->weight[s], seen, reading, change);
    for (int j = 0; j < STATES; j++)
        c->state[j] += change[j];
}

/* On by one control period under the action that was given. */
static void predict(coax_controller *c, const blend *b, const float *reading, const int *there)
{
    const float use = fmaxf(fabsf(c->action[COAX_COMMAND_DELTA_LON]),
                            fabsf(c->action[COAX_COMMAND_DELTA_LAT]));
    float next[STATES] = {0.0f}, dx[STATES], moved[STATES], du[COAX_COMMANDS];

    for (int s = 0; s < b->count; s++) {
        const design_point *p = b->point[s];
        deviation(c->state, p, dx);
        for (int j = 0; j < COAX_COMMANDS; j++)
            du[j] = p->offset[j] + ACTION_SCALE[j] * c->action[j];
        for (int i = 0; i < STATES; i++) {
            moved[i] = 0.0f;
            for (int j = 0; j < STATES; j++)
                moved[i] += p->A[i][j] * dx[j];
            for (int j = 0; j < COAX_COMMANDS; j++)
                moved[i] += p->B[i][j] * du[j];
        }
        for (int k = 0; k < TURNED_PAIRS; k++) /* what yawing does to velocity, tilt and place */
            turn(&moved[TURNED[k][0]], &moved[TURNED[k][1]], -PERIOD * dx[STATE_R]);
        for (int i = 0; i < STATES; i++)
            next[i] += b->weight[s] * (p->state_trim[i] + p->advance[i] + moved[i]);
    }
    for (int i = 0; i < STATES; i++)
        c->state[i] = next[i];
    if (STATE_PSI >= 0)
        c->state[STATE_PSI] = wrapped(c->state[STATE_PSI]);
    for (int k = 0; k < INTEGRALS; k++) {
        if (there[AXIS[k]])
            c->integral[k] += PERIOD * reading[INTEGRATED[k]];
        c->integral[k] = within(c->integral[k], -MOST[k], MOST[k]);
    }
    c->row = (c->row + 1) % CYCLE;
    c->plate += BUSY_SHARE * (use - c->plate);
    if (PERIOD * (float)c->periods < CALM_LAST)
        c->periods++;
}
