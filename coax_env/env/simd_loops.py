"""The loops over SIMD_WIDTH rows of a fleet at a time, not compiled: fleet_simd.py compiles them.

The same control period as flight_loop.py's for one row, made of the same parts (period.py); here each
part is compiled for SIMD_WIDTH helicopters side by side. Any active rows make a group; the last group
is filled up with copies, whose results are dropped.

Where they ask one of the names in capitals, numba drops the branch that a variant does not have.
"""

import numpy as np

from coax_env.env import hover, period
from coax_env.env.arrays import AIR_DOWN
from coax_env.env.flight_loop import move_air
from coax_env.env.period import (
    DT,
    FORCE,
    MOMENT,
    add_gusts,
    command,
    copy_row,
    next_azimuth,
    shake,
    take_samples,
)
from coax_env.env.turbulence import N_FILTERS
from coax_env.kernel.compilation import compiled
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
from coax_env.model import state as S
from coax_env.model.actuators import limit
from coax_env.model.dynamics import WORK_SIZE, measure_bare, step_bare
from coax_env.model.layout import N_CHANNELS, N_COMMANDS, N_FULL, N_INPUTS, N_STATES, TIME
from coax_env.model.sampling import BIAS, BIAS_STD, DELAY, delayed, measured_quantities

CHUNK = 512
"""Rows that are flown, and then sense: as many as the second-level cache can hold."""

PHASES = 10
"""Rows after which the shipped sensors' rates, 10 to 100 Hz, come round again."""

EFFECTS = OWN = TURBULENT = DELAYED = SHAKES = LATE = False
"""What a variant has: effects; parameters of each row's own; turbulence; delayed commands; vibration;
late readings. These, and the kernel's functions after them, are the bare one's."""

_step, _measure, _fly_delayed = step_bare, measure_bare, period.fly_period

_N_PARAMETERS = effects.n_parameters()
_ROW, _AZIMUTH, _REWARD, _OVER = range(4)
_N_SINGLES = 4


@compiled()
def next_group(i, last, active, which):
    """The next SIMD_WIDTH active rows from row `i` on, into `which`; how many, and the row after.

    Args:
        i: first row to look at. last: row after the last one. active: (n,) bool.
        which: (SIMD_WIDTH,) row of each lane, written; lanes left over repeat the first.
    """
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


# --- parameters -----------------------------------------------------------------------------------


@compiled(makes_arrays=True)
def _own_blocks(world, own):
    """What become registers of the parameters, (n_parameters, SIMD_WIDTH), those that are read the same
    in every lane, and of the numbers of each row's own, (k, SIMD_WIDTH)."""
    p_block = np.empty((_N_PARAMETERS, SIMD_WIDTH))
    for k in world.read:
        for j in range(SIMD_WIDTH):
            p_block[k, j] = world.params[k]
    return p_block, np.empty((own.shape[1], SIMD_WIDTH))


@compiled()
def _gather_own(own, which, block, own_, world, p):
    """The rows' own parameters into registers: all of `own_` (k,), and their places in `p`."""
    gather(own, which, block)
    for k in range(len(own_)):
        p[world.own[k]] = own_[k]


# --- loops ----------------------------------------------------------------------------------------


def step_rows(kind, first, last, active, actions, x, flown, heli, world, mission, outcome):
    """Command, flight and judgement of the active rows first..last-1; arguments as `fly`."""
    # names outside the loop: numba counts a reference each time it takes an array from a tuple
    u, rows, azimuth, streams, own = heli[:5]
    last_commands, targets, ring = heli.last_commands, heli.targets, heli.command_ring
    trim, scale, gust, limits = world.trim, world.scale, world.gust, world.limits[kind]
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
    last_, target_, terms_ = simd_view(last_block), simd_view(target_block), simd_view(term_block)
    single_, stream_ = simd_view(single_block), simd_view_uint64(stream_block)
    work, flown_ = simd_scratch(WORK_SIZE), simd_scratch(N_FULL)
    if OWN:
        p_block, own_block = _own_blocks(world, own)
        p, own_ = simd_view(p_block), simd_view(own_block)
    else:
        p = world.params
    if TURBULENT:
        filter_block, steady_block = np.empty((N_FILTERS, SIMD_WIDTH)), np.empty((2, SIMD_WIDTH))
        filter_, steady_ = simd_view(filter_block), simd_view(steady_block)
        air = simd_scratch(3)
    gusty = gust[FORCE] > 0.0 or gust[MOMENT] > 0.0
    limited = np.isfinite(limits).any()
    n, after = next_group(first, last, active, which)
    while n > 0:
        gather(x, which, x_block)
        gather(actions, which, action_block)
        gather(targets, which, target_block)
        if OWN:
            _gather_own(own, which, own_block, own_, world, p)
        for j in range(SIMD_WIDTH):
            single_block[_ROW, j] = rows[which[j]]
            single_block[_AZIMUTH, j] = azimuth[which[j]]
        command(action_, trim, scale, u_)
        if limited:
            gather(last_commands, which, last_block)
            limit(u_, last_, limits, DT)
            scatter(last_block, which, n, last_commands)
        if gusty or TURBULENT:
            gather(streams, which, stream_block)
            if gusty:
                add_gusts(x_, p, gust, stream_)
            if TURBULENT:
                gather(heli.filters, which, filter_block)
                gather(heli.steady_wind, which, steady_block)
                move_air(x_, own_, stream_, filter_, steady_, world.turbulence, air)
                for k in range(AIR_DOWN + 1):
                    p[world.own[k]] = own_[k]
                scatter(filter_block, which, n, heli.filters)
                scatter(own_block[: AIR_DOWN + 1], which, n, own)
            scatter(stream_block, which, n, streams)
        u_[TIME] = single_[_ROW] * DT
        if DELAYED:
            for j in range(n):
                i = which[j]
                for k in range(N_COMMANDS):
                    ring[i, rows[i] % ring.shape[1], k] = u_block[k, j]
            for k in range(N_FULL):
                flown_[k] = x_[k]
            _fly_delayed(flown_, u_, p, (ring, which, rows, u_block), single_[_ROW], DT, work)
        else:
            _step(x_, u_, DT, p, work, flown_)
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
        n, after = next_group(after, last, active, which)


def sense_rows(kind, first, last, active, x, heli, world, observations):
    """New readings of the active rows first..last-1 of one kind, at the states `x` (n, 29);
    arguments as `sense`.
    """
    rows, streams, own, past = heli.rows, heli.streams, heli.own, heli.past
    bias, held, sensors, flags = heli.bias, heli.held, world.sensors[kind], world.flags
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
    if OWN:
        p_block, own_block = _own_blocks(world, own)
        p, own_ = simd_view(p_block), simd_view(own_block)
    else:
        p = world.params
    if EFFECTS:
        u_block, azimuth_block = np.empty((N_INPUTS, SIMD_WIDTH)), np.empty((1, SIMD_WIDTH))
        u_, azimuth_ = simd_view(u_block), simd_view(azimuth_block)
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
        if OWN:
            _gather_own(own, which, own_block, own_, world, p)
        for j in range(SIMD_WIDTH):
            row_block[0, j] = rows[which[j]]
        if EFFECTS:
            gather(heli.u, which, u_block)
            _measure(x_, u_, p, work, readings_)
        else:
            # the actuators are where they were sent, and time has no part
            _measure(x_, x_[N_STATES:], p, work, readings_)
        if SHAKES:
            for j in range(SIMD_WIDTH):
                azimuth_block[0, j] = heli.azimuth[which[j]]
            shake(readings_, azimuth_[0], p)
        measured_quantities(x_, readings_, sensors, values_)
        if LATE:
            for j in range(n):
                i = which[j]
                for k in range(count):
                    value_block[k, j] = delayed(
                        value_block[k, j], past[i], rows[i], k, sensors[k, DELAY]
                    )
        take_samples(values_, row_[0], sensors, bias_, stream_, flags, held_)
        scatter(held_block, which, n, held)
        scatter(held_block, which, n, observations)
        scatter(stream_block, which, n, streams)


def fly(first, last, active, actions, x, flown, heli, world, mission, outcome):
    """One control period of the active rows first..last-1.

    Args:
        first, last: the share of the rows. active: which of them fly, (n,) bool.
        actions: (n, 4). x: full states, (n, 29). flown: where those after the period are put.
        heli, world, mission, outcome: the batch's arrays, arrays.py.
    """
    observations, kinds = outcome.observations, len(world.sensors)
    mine = active.copy() if kinds > 1 else active
    for start in range(first, last, CHUNK):
        end = min(start + CHUNK, last)
        for kind in range(kinds):
            if kinds > 1:
                for i in range(start, end):
                    mine[i] = active[i] and heli.kinds[i] == kind
            step_rows(kind, start, end, mine, actions, x, flown, heli, world, mission, outcome)
            sense_rows(kind, start, end, mine, flown, heli, world, observations)
        for i in range(start, end):
            if not active[i]:
                copy_row(x[i], flown[i])
                copy_row(heli.held[i], observations[i])
                for k in range(outcome.terms.shape[1]):
                    outcome.terms[i, k] = 0.0
                outcome.rewards[i] = 0.0
                outcome.over[i] = False
