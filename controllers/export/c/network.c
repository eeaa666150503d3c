
/* --- a network on the estimate and its integrals ------------------------------------------------------- */

static void act(const coax_controller *c, const blend *b, float *action)
{
    float first[WIDEST], second[WIDEST];
    float *in = first, *out = second;

    (void)b;
    for (int j = 0; j < STATES; j++)
        in[j] = c->state[j];
    for (int j = 0; j < INTEGRALS; j++)
        in[STATES + j] = c->integral[j];
    for (int j = 0; j < STATES + INTEGRALS; j++)
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
    for (int i = 0; i < COAX_COMMANDS; i++)
        action[i] = in[i];
}
