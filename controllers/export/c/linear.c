
static void act(const coax_controller *c, const blend *b, const float *way, float *action)
{
    (void)way;
    feed_back(c, b, action);
}
