
/* One design, at hover. */
static void choose_points(coax_controller *c, const float *way, blend *b)
{
    (void)c;
    (void)way;
    b->count = 1;
    b->point[0] = b->point[1] = POINT;
    b->weight[0] = 1.0f;
    b->weight[1] = 0.0f;
}
