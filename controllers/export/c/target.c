
/* --- the flight, seen from the target ------------------------------------------------------------- */

/* A way, or its beginning where it is longer than a setpoint may be away at once: `farthest`, by axis. */
static void within_reach(const float *way, const float *farthest, float *first)
{
    const float distance = fmaxf(hypotf(way[FORWARD], way[RIGHT]), LEAST_DISTANCE);
    const float share = fminf(1.0f, farthest[AXIS_PLACE] / distance);

    first[FORWARD] = way[FORWARD] * share;
    first[RIGHT] = way[RIGHT] * share;
    first[UP] = within(way[UP], -farthest[AXIS_HEIGHT], farthest[AXIS_HEIGHT]);
    first[TURN] = within(way[TURN], -farthest[AXIS_HEADING], farthest[AXIS_HEADING]);
}

/* The observation as that of a hover at the target, or on the way to it.
 *
 * farthest: how far the setpoint may be away, by axis [m, m, rad]. asked: the setpoint, x y z psi;
 * without a way or a reading that it takes, it stays the last one. there: whether it is the target
 * itself in place, height and heading.
 */
static void see_from_target(const float *observation, const float *way, const float *farthest,
                            float *asked, float *seen, int *there)
{
    const float x = observation[AT_NORTH], y = observation[AT_EAST];
    const float z = HEIGHT_SIGN * observation[AT_HEIGHT], psi = observation[AT_HEADING];
    const float measured = x + y + z + psi, wanted = way[0] + way[1] + way[2] + way[3];
    there[AXIS_PLACE] = there[AXIS_HEIGHT] = there[AXIS_HEADING] = 1;
    if (isfinite(measured) && isfinite(wanted)) {
        float first[4];
        within_reach(way, farthest, first);
        there[AXIS_PLACE] = first[FORWARD] == way[FORWARD] && first[RIGHT] == way[RIGHT];
        there[AXIS_HEIGHT] = first[UP] == way[UP];
        there[AXIS_HEADING] = first[TURN] == way[TURN];
        turn(&first[FORWARD], &first[RIGHT], psi);
        asked[NORTH] = x + first[FORWARD];
        asked[EAST] = y + first[RIGHT];
        asked[DOWN] = -z - first[UP];
        asked[HEADING] = psi + first[TURN];
    }
    for (int k = 0; k < COAX_OBSERVED; k++)
        seen[k] = observation[k];
    seen[AT_NORTH] = x - asked[NORTH];
    seen[AT_EAST] = y - asked[EAST];
    turn(&seen[AT_NORTH], &seen[AT_EAST], -asked[HEADING]);
    seen[AT_HEIGHT] = HEIGHT_SIGN * (HOVER_HEIGHT + z + asked[DOWN]);
    seen[AT_HEADING] = wrapped(psi - asked[HEADING]);
    if (AT_SPEED_NORTH >= 0)
        turn(&seen[AT_SPEED_NORTH], &seen[AT_SPEED_EAST], -asked[HEADING]);
}
