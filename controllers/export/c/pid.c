
/* --- cascaded loops on the raw sensors ------------------------------------------------------------------ */

void coax_reset(coax_controller *c)
{
    for (int k = 0; k < 3; k++)
        c->smooth[k] = 0.0f;
    for (int k = 0; k < 4; k++)
        c->sum[k] = c->asked[k] = 0.0f;
    for (int k = 0; k < COAX_OBSERVED; k++)
        c->last[k] = 0.0f;
    c->asked[DOWN] = -HOVER_HEIGHT;
}

/* Forward and right [m/s], towards a position that is measured. */
static void speed_demand(const float *y, float *forward, float *right)
{
    *forward = *right = 0.0f;
    if (AT_NORTH >= 0) {
        float length, share;
        *forward = -GAIN_PLACE * y[AT_NORTH];
        *right = -GAIN_PLACE * y[AT_EAST];
        length = fmaxf(hypotf(*forward, *right), LEAST_DISTANCE);
        share = fminf(1.0f, GAIN_FASTEST / length);
        *forward *= share;
        *right *= share;
        turn(forward, right, -y[AT_HEADING]);
    }
}

void coax_step(coax_controller *c, const float observation[COAX_OBSERVED], const float way[4],
               float action[COAX_COMMANDS], float command[COAX_COMMANDS])
{
    const float most[4] = {GAIN_STEEPEST / GAIN_SPEED_SUM, GAIN_STEEPEST / GAIN_SPEED_SUM,
                           0.5f / GAIN_HEIGHT_SUM, 0.5f / GAIN_HEADING_SUM};
    float held[COAX_OBSERVED], y[COAX_OBSERVED];
    float forward, right, pitch, roll, lift, twist, error[4], speed[3];
    const float farthest[AXES] = {REACH_PLACE, REACH_HEIGHT, REACH_HEADING};
    int there[AXES] = {1, 1, 1};

    for (int k = 0; k < COAX_OBSERVED; k++) /* a reading that is no number: the last one that was */
        held[k] = c->last[k] = isfinite(observation[k]) ? observation[k] : c->last[k];
    if (way)
        see_from_target(held, way, farthest, c->asked, y, there);
    else
        for (int k = 0; k < COAX_OBSERVED; k++)
            y[k] = held[k];

    speed[0] = y[AT_SPEED_NORTH];
    speed[1] = y[AT_SPEED_EAST];
    speed[2] = y[AT_SPEED_DOWN];
    turn(&speed[0], &speed[1], -y[AT_HEADING]);
    for (int k = 0; k < 3; k++)
        c->smooth[k] += (speed[k] - c->smooth[k]) * SMOOTHING_SHARE;
    speed_demand(y, &forward, &right);
    error[0] = forward - c->smooth[0];
    error[1] = right - c->smooth[1];
    error[2] = HOVER_HEIGHT - y[AT_HEIGHT];
    error[3] = -wrapped(y[AT_HEADING]);
    for (int k = 0; k < 4; k++) {
        if (there[AXIS_PLACE] && there[AXIS_HEIGHT] && there[AXIS_HEADING])
            c->sum[k] += PERIOD * error[k];
        c->sum[k] = within(c->sum[k], -most[k], most[k]);
    }
    pitch = within(-(GAIN_SPEED * error[0] + GAIN_SPEED_SUM * c->sum[0]), -GAIN_STEEPEST, GAIN_STEEPEST);
    roll = within(GAIN_SPEED * error[1] + GAIN_SPEED_SUM * c->sum[1], -GAIN_STEEPEST, GAIN_STEEPEST);
    lift = GAIN_HEIGHT * error[2] + GAIN_HEIGHT_SUM * c->sum[2] + GAIN_CLIMB * c->smooth[2];
    twist = GAIN_HEADING * error[3] + GAIN_HEADING_SUM * c->sum[3] - GAIN_TURN * y[AT_YAW_RATE];
    action[0] = lift + twist;
    action[1] = lift - twist;
    action[2] = GAIN_TILT * (pitch - y[AT_PITCH]) - GAIN_RATE * y[AT_PITCH_RATE];
    action[3] = GAIN_TILT * (roll - y[AT_ROLL]) - GAIN_RATE * y[AT_ROLL_RATE];
    for (int k = 0; k < COAX_COMMANDS; k++) {
        action[k] += FEEDFORWARD[k];
        action[k] = isfinite(action[k]) ? within(action[k], -1.0f, 1.0f) : 0.0f;
        command[k] = ACTION_TRIM[k] + ACTION_SCALE[k] * action[k];
    }
}
