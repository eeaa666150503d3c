"""The batch kernel for helicopters without effects: WIDTH rows of the fleet at a time, in lanes.

The same control period as fleet.py's for one row, made of the same parts (period.py); here each part
is compiled for lanes. Any active rows make a group; the last group is filled up with copies, whose
results are dropped.
"""

import numpy as np

from coax_env import effects, hover, tasks
from coax_env import parameters as P
from coax_env.dynamics import WORK_SIZE, measure_bare, step_bare
from coax_env.jit import compiled
from coax_env.lanes import WIDTH, gather, lanes_of, scatter, select, words_of
from coax_env.layout import N_CHANNELS, N_FULL, N_INPUTS, TIME
from coax_env.period import DT, blow, command, read, seen, turned


@compiled()
def _next_group(i, last, active, which):
    """The next WIDTH active rows from row `i` on into `which`; how many they are, and the row after."""
    n = 0
    while i < last and n < WIDTH:
        if active[i]:
            which[n] = i
            n += 1
        i += 1
    for j in range(n, WIDTH):
        which[j] = which[0]
    return n, i


def _fly_of(own):
    """The kernel for parameters of each row's own, or for one vehicle."""

    def fly(
        first, last, active, actions, trim, scale, params, sensors, limits, gust,
        weights, scales, places, height_sign, course, box, dwell,
        x, u, rows, azimuth, streams, asked, bias, targets, progress, held,
        observations, rewards, terms, over,
    ):  # fmt: skip
        """One control period of the active rows first..last-1. See fleet.Fleet for the arrays."""
        which = np.empty(WIDTH, np.int64)
        x_block, u_block = np.empty((N_FULL, WIDTH)), np.empty((N_INPUTS, WIDTH))
        action_block, asked_block = np.empty((4, WIDTH)), np.empty((4, WIDTH))
        target_block, held_block = np.empty((4, WIDTH)), np.empty((held.shape[1], WIDTH))
        n_sensors = len(sensors)
        bias_block, value_block = np.empty((n_sensors, WIDTH)), np.empty((n_sensors, WIDTH))
        term_block = np.zeros((len(weights), WIDTH))
        clock_block = np.empty((4, WIDTH))
        stream_block = np.empty((2, WIDTH), np.uint64)
        reading_block, work_block = np.empty((N_CHANNELS, WIDTH)), np.empty((WORK_SIZE, WIDTH))
        x_, u_, action_, asked_ = (
            lanes_of(x_block), lanes_of(u_block), lanes_of(action_block), lanes_of(asked_block)
        )  # fmt: skip
        target_, held_, bias_ = lanes_of(target_block), lanes_of(held_block), lanes_of(bias_block)
        values_, terms_, clock_ = (
            lanes_of(value_block), lanes_of(term_block), lanes_of(clock_block)
        )  # fmt: skip
        readings_, work = lanes_of(reading_block), lanes_of(work_block)
        stream_ = words_of(stream_block)
        if own:
            p_block = np.empty((P.N_FIXED + len(effects.STAGES), WIDTH))
            p = lanes_of(p_block)
        else:
            p = params[0]
        aim = len(held_) - len(places)
        for i in range(first, last):
            if not active[i]:
                for k in range(held.shape[1]):
                    observations[i, k] = held[i, k]
        n, after = _next_group(first, last, active, which)
        while n > 0:
            gather(x, which, x_block)
            gather(actions, which, action_block)
            gather(asked, which, asked_block)
            gather(targets, which, target_block)
            gather(held, which, held_block)
            gather(bias, which, bias_block)
            gather(streams, which, stream_block)
            if own:
                gather(params, which, p_block)
            for j in range(WIDTH):
                clock_block[0, j] = rows[which[j]]
                clock_block[1, j] = azimuth[which[j]]

            command(action_, trim, scale, limits, asked_, u_)
            u_[TIME] = clock_[0] * DT
            if gust[0] > 0.0 or gust[1] > 0.0:
                blow(x_, p, gust, stream_)
            step_bare(x_, u_, DT, p, work, x_)
            clock_[0] += 1.0
            clock_[1] = turned(clock_[1], x_[16])
            u_[TIME] = clock_[0] * DT
            clock_[2] = hover.reward(x_, action_, target_, weights, scales, terms_)
            clock_[3] = select(hover.is_over(x_), 1.0, 0.0)
            scatter(x_block, which, n, x)
            scatter(term_block, which, n, terms)
            for j in range(n):
                row = which[j]
                rows[row] = int(clock_block[0, j])
                azimuth[row] = clock_block[1, j]
                rewards[row] = clock_block[2, j]
                over[row] = clock_block[3, j] != 0.0
            if dwell > 0:
                scatter(stream_block, which, n, streams)
                for j in range(n):
                    row = which[j]
                    if tasks.arrive(x[row], targets[row], dwell, progress[row], course):
                        terms[row, hover.N_TERMS] = weights[hover.N_TERMS]
                        rewards[row] += weights[hover.N_TERMS]
                        tasks.aim(
                            streams[row], course, box, progress[row, tasks.REACHED], targets[row]
                        )
                gather(targets, which, target_block)
                gather(streams, which, stream_block)

            measure_bare(x_, u_, p, work, readings_)
            seen(x_, readings_, sensors, values_)
            read(values_, clock_[0], sensors, bias_, stream_, aim - n_sensors, held_)
            if len(places) > 0:
                tasks.point(held_, places, height_sign, target_, held_[aim:])
            scatter(u_block, which, n, u)
            scatter(asked_block, which, n, asked)
            scatter(held_block, which, n, held)
            scatter(held_block, which, n, observations)
            scatter(stream_block, which, n, streams)
            n, after = _next_group(after, last, active, which)

    return compiled()(fly)


fly_shared = _fly_of(False)
fly_own = _fly_of(True)
