"""The loops over SIMD_WIDTH rows of a fleet at a time, not compiled: fleet_simd.py compiles them.

The same control period as flight_loop.py's for one row, made of the same parts (period.py); here each
part is compiled for SIMD_WIDTH helicopters side by side. Any active rows make a group; the last group
is filled up with copies, whose results are dropped. A group goes through the whole period at once, so
that its numbers stay in registers and in the nearest cache.

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
from coax_env.kernel.random_streams import COUNTER, KEY
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
from coax_env.model import workspace as F
from coax_env.model.actuators import limit
from coax_env.model.dynamics import WORK_SIZE, measure_bare, step_bare
from coax_env.model.layout import N_CHANNELS, N_COMMANDS, N_FULL, N_INPUTS, TIME
from coax_env.model.sampling import BIAS, BIAS_STD, DELAY, delayed, measured_quantities

OWN = TURBULENT = DELAYED = SHAKES = LATE = False
"""What a variant has: parameters of each row's own; turbulence; delayed commands; vibration; late
readings. These, and the kernel's functions after them, are the bare one's."""

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


# --- numbers that are one a row -------------------------------------------------------------------


@compiled(forceinline=True)
def _gather_singles(which, rows, azimuth, streams, block, stream_block):
    """Periods flown and azimuth into `block` (_N_SINGLES, SIMD_WIDTH), streams into theirs (2, ...)."""
    for j in range(SIMD_WIDTH):
        i = which[j]
        block[_ROW, j] = rows[i]
        block[_AZIMUTH, j] = azimuth[i]
        stream_block[KEY, j] = streams[i, KEY]
        stream_block[COUNTER, j] = streams[i, COUNTER]


@compiled(forceinline=True)
def _scatter_singles(which, some, block, stream_block, heli, outcome):
    """What `_gather_singles` took back to the first lanes' rows, one period on; reward and end."""
    rows, azimuth, streams = heli.rows, heli.azimuth, heli.streams
    rewards, over = outcome.rewards, outcome.over
    for j in range(some):
        i = which[j]
        rows[i] += 1
        azimuth[i] = block[_AZIMUTH, j]
        streams[i, COUNTER] = stream_block[COUNTER, j]
        rewards[i] = block[_REWARD, j]
        over[i] = block[_OVER, j] != 0.0


@compiled()
def _delay_readings(which, some, rows, past, sensors, block):
    """What late sensors show of what they measure, (n_sensors, SIMD_WIDTH), in place."""
    for j in range(some):
        i = which[j]
        for k in range(len(sensors)):
            block[k, j] = delayed(block[k, j], past[i], rows[i] + 1, k, sensors[k, DELAY])


# --- loops ----------------------------------------------------------------------------------------


def fly_rows(kind, first, last, active, actions, x, flown, heli, world, mission, outcome):
    """One control period of the active rows first..last-1 of one kind; arguments as `fly`."""
    # names outside the loop: numba counts a reference each time it takes an array from a tuple
    rows, streams, own, held = heli.rows, heli.streams, heli.own, heli.held
    last_commands, targets, ring, bias = (
        heli.last_commands, heli.targets, heli.command_ring, heli.bias
    )  # fmt: skip
    trim, scale, gust, limits = world.trim, world.scale, world.gust, world.limits[kind]
    sensors, flags = world.sensors[kind], world.flags
    weights, scales = mission.weights, mission.scales
    terms, observations, width = outcome.terms, outcome.observations.reshape(-1), held.shape[1]
    readings_held = held.reshape(-1)
    count = len(sensors)
    which = np.empty(SIMD_WIDTH, np.uint64)  # no place is counted from the end
    x_block, u_block = np.empty((N_FULL, SIMD_WIDTH)), np.zeros((N_INPUTS, SIMD_WIDTH))
    action_block, last_block = np.empty((4, SIMD_WIDTH)), np.empty((4, SIMD_WIDTH))
    target_block = np.empty((4, SIMD_WIDTH))
    term_block = np.zeros((len(weights), SIMD_WIDTH))
    stream_block = np.empty((2, SIMD_WIDTH), np.uint64)
    single_block = np.empty((_N_SINGLES, SIMD_WIDTH))
    held_block, bias_block = np.empty((held.shape[1], SIMD_WIDTH)), np.zeros((count, SIMD_WIDTH))
    value_block, reading_block = np.empty((count, SIMD_WIDTH)), np.empty((N_CHANNELS, SIMD_WIDTH))
    x_, u_, action_ = simd_view(x_block), simd_view(u_block), simd_view(action_block)
    last_, target_, terms_ = simd_view(last_block), simd_view(target_block), simd_view(term_block)
    single_, stream_ = simd_view(single_block), simd_view_uint64(stream_block)
    held_, bias_ = simd_view(held_block), simd_view(bias_block)
    values_, readings_ = simd_view(value_block), simd_view(reading_block)
    # the readings' own scratch: their rates of change, which nobody asks for, are not computed then
    work, sensed, flown_ = simd_scratch(WORK_SIZE), simd_scratch(WORK_SIZE), simd_scratch(N_FULL)
    if OWN:
        p_block, own_block = _own_blocks(world, own)
        p, own_ = simd_view(p_block), simd_view(own_block)
        numbers = p
    else:
        # on the stack, and in no call but those inlined: what follows from it is then done once
        p, numbers = simd_scratch(_N_PARAMETERS), world.params
        for k in world.read:
            p[k] = numbers[k]
    if TURBULENT:
        filter_block, steady_block = np.empty((N_FILTERS, SIMD_WIDTH)), np.empty((2, SIMD_WIDTH))
        filter_, steady_ = simd_view(filter_block), simd_view(steady_block)
        air = simd_scratch(3)
    gusty = gust[FORCE] > 0.0 or gust[MOMENT] > 0.0
    limited = np.isfinite(limits).any()
    biased = False
    for k in range(count):
        biased = biased or sensors[k, BIAS] != 0.0 or sensors[k, BIAS_STD] != 0.0
    shown = sensed_to = first * width
    n, after = next_group(first, last, active, which)
    while n > 0:
        _gather_singles(which, rows, heli.azimuth, streams, single_block, stream_block)
        gather(x, which, x_block)
        gather(actions, which, action_block)
        gather(targets, which, target_block)
        gather(held, which, held_block)
        if OWN:
            _gather_own(own, which, own_block, own_, world, p)
        command(action_, trim, scale, u_)
        if limited:
            gather(last_commands, which, last_block)
            limit(u_, last_, limits, DT)
            scatter(last_block, which, n, last_commands)
        if gusty:
            add_gusts(x_, numbers, gust, stream_)
        if TURBULENT:
            gather(heli.filters, which, filter_block)
            gather(heli.steady_wind, which, steady_block)
            move_air(x_, own_, stream_, filter_, steady_, world.turbulence, air)
            for k in range(AIR_DOWN + 1):
                p[world.own[k]] = own_[k]
            scatter(filter_block, which, n, heli.filters)
            scatter(own_block[: AIR_DOWN + 1], which, n, own)
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
        single_[_ROW] += 1.0
        u_[TIME] = single_[_ROW] * DT
        single_[_AZIMUTH] = next_azimuth(single_[_AZIMUTH], x_[S.OMEGA_U], DT)
        single_[_REWARD] = hover.reward(x_, action_, target_, weights, scales, terms_)
        scatter(x_block, which, n, flown)
        scatter(term_block, which, n, terms)
        _measure(x_, u_, p, sensed, readings_)
        upright = sensed[F.COS_PHI] * sensed[F.COS_THETA]
        single_[_OVER] = select(hover.is_over_at_tilt(x_, upright), 1.0, 0.0)
        if SHAKES:
            shake(readings_, single_[_AZIMUTH], numbers)
        measured_quantities(x_, readings_, sensors, values_)
        if LATE:
            _delay_readings(which, n, rows, heli.past, sensors, value_block)
        if biased:
            gather(bias, which, bias_block)
        take_samples(values_, single_[_ROW], sensors, bias_, stream_, flags, held_)
        scatter(held_block, which, n, held)
        _scatter_singles(which, n, single_block, stream_block, heli, outcome)
        # a group later: by then, what was written in parts can be read as a whole
        copy_row(readings_held[shown:sensed_to], observations[shown:sensed_to])
        shown, sensed_to = sensed_to, after * width
        n, after = next_group(after, last, active, which)
    copy_row(readings_held[shown : last * width], observations[shown : last * width])


def fly(first, last, active, actions, x, flown, heli, world, mission, outcome):
    """One control period of the active rows first..last-1.

    Args:
        first, last: the share of the rows. active: which of them fly, (n,) bool.
        actions: (n, 4). x: full states, (n, 29). flown: where those after the period are put.
        heli, world, mission, outcome: the batch's arrays, arrays.py.
    """
    kinds = len(world.sensors)
    mine = active.copy() if kinds > 1 else active
    for kind in range(kinds):
        if kinds > 1:
            for i in range(first, last):
                mine[i] = active[i] and heli.kinds[i] == kind
        fly_rows(kind, first, last, mine, actions, x, flown, heli, world, mission, outcome)
    for i in range(first, last):
        if not active[i]:
            copy_row(x[i], flown[i])
            for k in range(outcome.terms.shape[1]):
                outcome.terms[i, k] = 0.0
            outcome.rewards[i] = 0.0
            outcome.over[i] = False
