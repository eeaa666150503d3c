
/* --- a network on the estimate and its integrals ------------------------------------------------------- */

#if BEYOND
/* What is left of the way at the setpoint; none without a way, or where it is no number. */
static void beyond_setpoint(const float *way, float *left)
{
    for (int k = 0; k < BEYOND; k++)
        left[k] = 0.0f;
    if (way && isfinite(way[FORWARD] + way[RIGHT] + way[UP] + way[TURN])) {
        const float farthest[AXES] = {REACH_PLACE, REACH_HEIGHT, REACH_HEADING};
        within_reach(way, farthest, left);
        for (int k = 0; k < BEYOND; k++)
            left[k] = way[k] - left[k];
    }
}
#endif

static void act(const coax_controller *c, const blend *b, const float *way, float *action)
{
    float first[WIDEST], second[WIDEST];
    float *in = first, *out = second;

    (void)way;
    for (int j = 0; j < STATES; j++)
        in[j] = c->state[j];
    for (int j = 0; j < INTEGRALS; j++)
        in[STATES + j] = c->integral[j];
#if BEYOND
    beyond_setpoint(way, &in[STATES + INTEGRALS]);
#endif
    for (int j = 0; j < STATES + INTEGRALS + BEYOND; j++)
        in[j] = within(in[j] * PER_SCALE[j], -FEATURE_LIMIT, FEATURE_LIMIT);
    for (int k = 0; k < LAYERS; k++) {
        const layer *l = &LAYER[k];
        float *swap = in;
        for (int i = 0; i < l->outputs; i++) {
            float sum = l->bias[i];
            for (int j = 0; j < l->inputs; j++)
                sum += l->weight[i * l->inputs + j] * in[j];
            out[i] = k + 1 < LAYERS ? ACTIVATION(sum) : sum;
        }
        in = out;
        out = swap;
    }
    feed_back(c, b, action);
    for (int i = 0; i < COAX_COMMANDS; i++)
        action[i] += in[i];
}
