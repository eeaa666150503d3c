
/* --- linear feedback of the estimate and its integrals ------------------------------------------------ */

static void feed_back(const coax_controller *c, const blend *b, float *action)
{
    float dx[STATES];

    for (int i = 0; i < COAX_COMMANDS; i++)
        action[i] = 0.0f;
    for (int s = 0; s < b->count; s++) {
        const design_point *p = b->point[s];
        deviation(c->state, p, dx);
        for (int i = 0; i < COAX_COMMANDS; i++) {
            float sum = p->feedforward[i];
            for (int j = 0; j < STATES; j++)
                sum -= p->feedback[i][j] * dx[j];
            for (int j = 0; j < INTEGRALS; j++)
                sum -= p->feedback[i][STATES + j] * c->integral[j];
            action[i] += b->weight[s] * sum;
        }
    }
}
