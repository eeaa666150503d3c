
/* The speed from which it can still stop at the target, and the two designs next to it. */
static void choose_points(coax_controller *c, const float *way, blend *b)
{
    const float most = GATHERING * PERIOD;
    float wanted = 0.0f;
    int before = 0;

    if (way && way[FORWARD] > REACH_PLACE)
        wanted = fminf(sqrtf(2.0f * BRAKING * (way[FORWARD] - REACH_PLACE)), SPEED[POINTS - 1]);
    c->speed += within(wanted - c->speed, -most, most);
    while (before + 2 < POINTS && c->speed >= SPEED[before + 1])
        before++;
    b->count = POINTS > 1 ? 2 : 1;
    b->point[0] = &POINT[before];
    b->point[1] = &POINT[POINTS > 1 ? before + 1 : 0];
    b->weight[1] = POINTS > 1
        ? within((c->speed - SPEED[before]) / (SPEED[before + 1] - SPEED[before]), 0.0f, 1.0f) : 0.0f;
    b->weight[0] = 1.0f - b->weight[1];
}
