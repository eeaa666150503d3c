"""The batch for helicopters without effects: SIMD_WIDTH rows of the fleet at a time.

The same control period as flight_loop.py's for one row, made of the same parts (period.py); here each
part is compiled for SIMD_WIDTH helicopters side by side. Any active rows make a group; the last group
is filled up with copies, whose results are dropped.
"""

import numpy as np

from coax_env.env import hover
from coax_env.env.period import (
    DT,
    FORCE,
    MOMENT,
    add_gusts,
    command,
    copy_row,
    next_azimuth,
    take_samples,
)
from coax_env.env.threads import in_threads
from coax_env.errors import InputError
from coax_env.kernel.compilation import compiled, looked_up_once
from coax_env.kernel.simd import (
    SIMD_WIDTH,
    gather,
    scatter,
    select,
    simd_scratch,
    simd_view,
    simd_view_uint64,
)
from coax_env.model import effects
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.actuators import limit
from coax_env.model.dynamics import WORK_SIZE, measure_bare, step_bare
from coax_env.model.layout import N_CHANNELS, N_FULL, N_INPUTS, N_STATES, TIME
from coax_env.model.sampling import BIAS, BIAS_STD, measured_quantities
from coax_env.model.vehicle import Vehicle

CHUNK = 512
"""Rows that are flown, and then sense: as many as the second-level cache can hold."""

PHASES = 10
"""Rows after which the shipped sensors' rates, 10 to 100 Hz, come round again."""

_N_PARAMETERS = P.N_FIXED + len(effects.STAGES)
_ROW, _AZIMUTH, _REWARD, _OVER = range(4)
_N_SINGLES = 4


@compiled()
def _next_group(i, last, active, which):
    """The next SIMD_WIDTH active rows from row `i` on, into `which`; how many, and the row after."""
    n = 0
    while i < last and n < SIMD_WIDTH:
        if active[i]:
            which[n] = i
            n += 1
        i += 1
    for j in range(n, SIMD_WIDTH):
        which[j] = which[0]
    return n, i


@compiled(makes_arrays=True)
def _by_phase(first, last, active, rows, order):
    """The active rows first..last-1 into `order`, those together whose sensors are due together; how
    many they are. What no row of a group has due, none of them draws noise for.
    """
    places = np.zeros(PHASES + 1, np.int64)
    for i in range(first, last):
        if active[i]:
            places[rows[i] % PHASES + 1] += 1
    for phase in range(PHASES):
        places[phase + 1] += places[phase]
    for i in range(first, last):
        if active[i]:
            phase = rows[i] % PHASES
            order[places[phase]] = i
            places[phase] += 1
    return places[PHASES]


def _step_of(own):
    """Command, flight and judgement, for parameters of each row's own, or for one vehicle."""

    def step_rows(first, last, active, actions, x, flown, heli, world, mission, outcome):
        """Fly the active rows first..last-1 for one control period; arguments as `_fly_of`."""
        # names outside the loop: numba counts a reference each time it takes an array from a tuple
        u, rows, azimuth, streams, params = heli[:5]
        last_commands, targets = heli.last_commands, heli.targets
        trim, scale, gust, limits = world.trim, world.scale, world.gust, world.limits[0]
        weights, scales = mission.weights, mission.scales
        rewards, terms, over = outcome.rewards, outcome.terms, outcome.over
        which = np.empty(SIMD_WIDTH, np.int64)
        x_block, u_block = np.empty((N_FULL, SIMD_WIDTH)), np.zeros((N_INPUTS, SIMD_WIDTH))
        action_block, last_block = np.empty((4, SIMD_WIDTH)), np.empty((4, SIMD_WIDTH))
        target_block = np.empty((4, SIMD_WIDTH))
        term_block = np.zeros((len(weights), SIMD_WIDTH))
        stream_block = np.empty((2, SIMD_WIDTH), np.uint64)
        single_block = np.empty((_N_SINGLES, SIMD_WIDTH))
        x_, u_, action_ = simd_view(x_block), simd_view(u_block), simd_view(action_block)
        last_, target_, terms_ = (
            simd_view(last_block),
            simd_view(target_block),
            simd_view(term_block),
        )
        single_, stream_ = simd_view(single_block), simd_view_uint64(stream_block)
        work, flown_ = simd_scratch(WORK_SIZE), simd_scratch(N_FULL)
        if own:
            p_block = np.empty((_N_PARAMETERS, SIMD_WIDTH))
            p = simd_view(p_block)
        else:
            p = params[0]
        gusty = gust[FORCE] > 0.0 or gust[MOMENT] > 0.0
        limited = np.isfinite(limits).any()
        n, after = _next_group(first, last, active, which)
        while n > 0:
            gather(x, which, x_block)
            gather(actions, which, action_block)
            gather(targets, which, target_block)
            if own:
                gather(params, which, p_block)
            for j in range(SIMD_WIDTH):
                single_block[_ROW, j] = rows[which[j]]
                single_block[_AZIMUTH, j] = azimuth[which[j]]
            command(action_, trim, scale, u_)
            if limited:
                gather(last_commands, which, last_block)
                limit(u_, last_, limits, DT)
                scatter(last_block, which, n, last_commands)
            if gusty:
                gather(streams, which, stream_block)
                add_gusts(x_, p, gust, stream_)
                scatter(stream_block, which, n, streams)
            u_[TIME] = single_[_ROW] * DT
            step_bare(x_, u_, DT, p, work, flown_)
            for k in range(N_FULL):
                x_[k] = flown_[k]
            u_[TIME] = (single_[_ROW] + 1.0) * DT
            single_[_AZIMUTH] = next_azimuth(single_[_AZIMUTH], x_[S.OMEGA_U], DT)
            single_[_REWARD] = hover.reward(x_, action_, target_, weights, scales, terms_)
            single_[_OVER] = select(hover.is_over(x_), 1.0, 0.0)
            scatter(x_block, which, n, flown)
            scatter(u_block, which, n, u)
            scatter(term_block, which, n, terms)
            for j in range(n):
                i = which[j]
                rows[i] += 1
                azimuth[i] = single_block[_AZIMUTH, j]
                rewards[i] = single_block[_REWARD, j]
                over[i] = single_block[_OVER, j] != 0.0
            n, after = _next_group(after, last, active, which)

    return compiled(makes_arrays=True)(step_rows)


def _sense_of(own):
    """Readings, for parameters of each row's own, or for one vehicle."""

    def sense_rows(first, last, active, x, heli, world, observations):
        """New readings of the active rows first..last-1, at the states `x` (n, 29)."""
        rows, streams, params = heli.rows, heli.streams, heli.params
        bias, held, sensors, flags = heli.bias, heli.held, world.sensors[0], world.flags
        which, order = np.empty(SIMD_WIDTH, np.int64), np.empty(last - first, np.int64)
        count = len(sensors)
        x_block, reading_block = np.empty((N_FULL, SIMD_WIDTH)), np.empty((N_CHANNELS, SIMD_WIDTH))
        held_block = np.empty((held.shape[1], SIMD_WIDTH))
        row_block = np.empty((1, SIMD_WIDTH))
        bias_block, value_block = np.zeros((count, SIMD_WIDTH)), np.empty((count, SIMD_WIDTH))
        stream_block, work = np.empty((2, SIMD_WIDTH), np.uint64), simd_scratch(WORK_SIZE)
        x_, held_, row_ = simd_view(x_block), simd_view(held_block), simd_view(row_block)
        bias_, values_, readings_ = (
            simd_view(bias_block), simd_view(value_block), simd_view(reading_block)
        )  # fmt: skip
        stream_ = simd_view_uint64(stream_block)
        if own:
            p_block = np.empty((_N_PARAMETERS, SIMD_WIDTH))
            p = simd_view(p_block)
        else:
            p = params[0]
        biased = False
        for k in range(count):
            biased = biased or sensors[k, BIAS] != 0.0 or sensors[k, BIAS_STD] != 0.0
        active_rows = _by_phase(first, last, active, rows, order)
        for at in range(0, active_rows, SIMD_WIDTH):
            n = min(SIMD_WIDTH, active_rows - at)
            for j in range(SIMD_WIDTH):
                which[j] = order[at + j if j < n else at]
            gather(x, which, x_block)
            gather(held, which, held_block)
            gather(streams, which, stream_block)
            if biased:
                gather(bias, which, bias_block)
            if own:
                gather(params, which, p_block)
            for j in range(SIMD_WIDTH):
                row_block[0, j] = rows[which[j]]
            # without effects the actuators are where they were sent, and time has no part
            measure_bare(x_, x_[N_STATES:], p, work, readings_)
            measured_quantities(x_, readings_, sensors, values_)
            take_samples(values_, row_[0], sensors, bias_, stream_, flags, held_)
            scatter(held_block, which, n, held)
            scatter(held_block, which, n, observations)
            scatter(stream_block, which, n, streams)

    return compiled(makes_arrays=True)(sense_rows)


# numba's cache wants what a compiled function calls as global names
_step_shared, _step_own = _step_of(False), _step_of(True)
_sense_shared, _sense_own = _sense_of(False), _sense_of(True)


def _fly_of(own):
    """One control period, for parameters of each row's own, or for one vehicle."""

    def fly(first, last, active, actions, x, flown, heli, world, mission, outcome):
        """One control period of the active rows first..last-1.

        Args:
            first, last: the share of the rows. active: which of them fly, (n,) bool.
            actions: (n, 4). x: full states, (n, 29). flown: where those after the period are put.
            heli, world, mission, outcome: the batch's arrays, arrays.py.
        """
        observations = outcome.observations
        for start in range(first, last, CHUNK):
            end = min(start + CHUNK, last)
            if own:
                _step_own(start, end, active, actions, x, flown, heli, world, mission, outcome)
            else:
                _step_shared(start, end, active, actions, x, flown, heli, world, mission, outcome)
            for i in range(start, end):
                if not active[i]:
                    copy_row(x[i], flown[i])
                    copy_row(heli.held[i], observations[i])
                    for k in range(outcome.terms.shape[1]):
                        outcome.terms[i, k] = 0.0
                    outcome.rewards[i] = 0.0
                    outcome.over[i] = False
            if own:
                _sense_own(start, end, active, flown, heli, world, observations)
            else:
                _sense_shared(start, end, active, flown, heli, world, observations)

    return looked_up_once(compiled(makes_arrays=True)(fly))


fly_shared = _fly_of(False)
fly_own = _fly_of(True)


@compiled(makes_arrays=True)
def _dynamics_rows(first, last, x, u, p):
    which, active = np.empty(SIMD_WIDTH, np.int64), np.ones(len(x), np.bool_)
    x_block, u_block = np.empty((N_FULL, SIMD_WIDTH)), np.zeros((N_INPUTS, SIMD_WIDTH))
    x_, u_ = simd_view(x_block), simd_view(u_block)
    work, flown_ = simd_scratch(WORK_SIZE), simd_scratch(N_FULL)
    n, after = _next_group(first, last, active, which)
    while n > 0:
        gather(x, which, x_block)
        gather(u, which, u_block)
        step_bare(x_, u_, DT, p, work, flown_)
        for k in range(N_FULL):
            x_[k] = flown_[k]
        scatter(x_block, which, n, x)
        n, after = _next_group(after, last, active, which)


def fly_dynamics(x: np.ndarray, u: np.ndarray, vehicle: Vehicle, threads: int = 1) -> None:
    """The dynamics alone, of one vehicle without effects, over one control period and in place.

    No sensors, no task, no ends: what the env's speed is measured against.

    Args:
        x: full states, (count, 29). u: commands and time, (count, 5).
    """
    if vehicle.vector[effects.SWITCHES].any():
        raise InputError(
            f"vehicle {vehicle.name!r} has effects: the SIMD batch is for those without"
        )
    in_threads(lambda a, b: _dynamics_rows(a, b, x, u, vehicle.vector), len(x), threads)
