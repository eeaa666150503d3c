
/* --- one control period ------------------------------------------------------------------------------- */

void coax_step(coax_controller *c, const float observation[COAX_OBSERVED], const float way[4],
               float action[COAX_COMMANDS], float command[COAX_COMMANDS])
{
    float seen[COAX_OBSERVED], reading[READINGS], before[4], farthest[AXES];
    const float *now = observation;
    int there[AXES] = {1, 1, 1};
    blend b;

    if (way) {
        for (int k = 0; k < 4; k++)
            before[k] = c->asked[k];
        reach(c, way, farthest);
        see_from_target(observation, way, farthest, c->asked, seen, there);
        now = seen;
        if (c->periods && isfinite(now[OBSERVED_PSI]))
            follow(c, before, c->asked[HEADING] + now[OBSERVED_PSI]);
    }
    choose_points(c, way, &b);
    correct(c, &b, now, reading);
    act(c, &b, way, action);
    for (int k = 0; k < COAX_COMMANDS; k++) {
        action[k] = isfinite(action[k]) ? within(action[k], -1.0f, 1.0f) : 0.0f;
        command[k] = ACTION_TRIM[k] + ACTION_SCALE[k] * action[k];
        c->action[k] = action[k];
    }
    predict(c, &b, reading, there);
}
