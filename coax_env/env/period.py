"""One control period of one helicopter, in parts::

    command -> give_command (limits; on its way) -> add_gusts -> fly_period (dynamics.step)
            -> true_readings (dynamics.measure, vibration) -> take_samples (sampling.py)

The batch (flight_loop.py), the SIMD batch (fleet_simd.py) and simulated maneuvers (simulation/) put the
same parts together, so that what is logged is what is flown. Each part takes one helicopter's rows of
numbers; those that the SIMD batch uses also take the rows of SIMD_WIDTH helicopters (simd.py), and are
compiled for what they are given.
"""

import math

from coax_env.env import hover
from coax_env.kernel.angles import TURN
from coax_env.kernel.compilation import compiled
from coax_env.kernel.random_streams import (
    bits_ahead,
    chance_of,
    normals_of,
    place_of,
    skip,
    two_normals,
)
from coax_env.kernel.simd import any_lane, select
from coax_env.model import effects
from coax_env.model import inputs as U
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.actuators import limit
from coax_env.model.dynamics import measure, step
from coax_env.model.layout import N_COMMANDS
from coax_env.model.sampling import (
    DROPOUT,
    FLAG,
    HIGH,
    INSTRUMENT,
    LOW,
    NOISE,
    RATE,
    WRAPS,
    add_vibration,
    new_samples,
    received,
    within_a_turn,
)

DT = hover.CONTROL_PERIOD

DELAYS = ("command_delay.time", "servo_delay.time")
"""Pure delays of the commands [s]: of all four, and of the swash plate's on top."""
_COMMAND_DELAY, _SERVO_DELAY = (effects.parameter_index(name) for name in DELAYS)
_VIBRATION = effects.parameter_index("vibration.amplitude")
FORCE, MOMENT = range(2)
"""Places of the gusts' std."""
SHORTEST_PART = 1e-9  # [s] of a period that is flown by itself


# --- commands -----------------------------------------------------------------------------------------


@compiled()
def command(action, trim, scale, u):
    """An action (4,), clipped in place to [-1, 1], as commands into `u`.

    Args:
        action: (4,). trim, scale: command = trim + scale action, (4,) each [rad/s, rad/s, rad, rad].
        u: commands, time and battery, (6,); its commands are put here.
    """
    for k in range(4):
        a = action[k]
        a = select(a < -1.0, -1.0, a)
        action[k] = select(a > 1.0, 1.0, a)  # NaN stays
        u[k] = trim[k] + scale[k] * action[k]


def delay_slots(delay: float, dt: float = DT) -> int:
    """Slots of the ring of commands for delays that sum up to so many seconds."""
    return 2 + math.ceil(delay / dt) if delay > 0.0 else 1


@compiled()
def give_command(u, last, limits, ring, row, dt):
    """The command of a row, in `u`, after the actuators' limits: on its way to them from now on.

    Args:
        u: commands, time since the flight's start and battery, (6,), in place.
        last: the command given in the row before, (4,); this one afterwards.
        limits: `actuators.limits`, (3, 4).
        ring: commands given in the last rows, (slots, 4), see `delay_slots`.
        row: control periods flown so far. dt: seconds per row.
    """
    limit(u, last, limits, dt)
    slot = row % len(ring)
    for k in range(N_COMMANDS):
        ring[slot, k] = u[k]
    u[U.TIME] = row * dt


@compiled()
def _split(delay, slots, dt):
    """A delay [s] as whole rows, and the seconds of a row for which the command before holds."""
    whole = min(math.floor(delay / dt + 1e-9), slots - 2.0)
    rest = min(max(delay - whole * dt, 0.0), dt)
    return whole, select(rest > SHORTEST_PART, rest, 0.0)


@compiled()
def _delays(p):
    """Delays [s] of the rotors' commands and of the swash plate's."""
    rotors = max(p[_COMMAND_DELAY], 0.0)
    return rotors, rotors + max(p[_SERVO_DELAY], 0.0)


@compiled()
def apply_delays(u, p, ring, row, dt):
    """Put into `u` the commands that are in force as a row begins; arguments as `give_command`.

    Args:
        u, ring, row, dt: as in `give_command`. p: parameter vector.
    """
    rotors, swash = _delays(p)
    slots = len(ring)
    if swash <= 0.0 or slots == 1:
        return
    _take(ring, row, _split(rotors, slots, dt), 0.0, U.OMEGA_U, u)
    _take(ring, row, _split(swash, slots, dt), 0.0, U.DELTA_LON, u)


@compiled()
def _take(ring, row, late, since, first, u):
    """Two commands from the `first` on, as in force `since` seconds after a row began, into `u`."""
    whole, rest = late
    slot = (row - int(whole) - (1 if since < rest else 0)) % len(ring)
    u[first], u[first + 1] = ring[slot, first], ring[slot, first + 1]


# --- flight -------------------------------------------------------------------------------------------


@compiled()
def _slots(ring):
    """How many commands a ring holds."""
    return len(ring)


@compiled()
def _fly_part(x, u, length, p, work):
    """Fly so many seconds in place."""
    step(x, u, length, p, work, x)


@compiled()
def fly_period(x, u, p, ring, row, dt, work):
    """Fly one control period in place, after `give_command`.

    A pure delay is a look-up of the command that was given that long ago; where it is no whole number
    of periods, the period is split. Leaves in `u` the commands in force at the end.

    Args:
        x: full state, (29,). u, ring, row, dt: as in `give_command`. p: parameter vector.
        work: scratch, (dynamics.WORK_SIZE,).
    """
    rotors, swash = _delays(p)
    slots = _slots(ring)
    if slots == 1 or not any_lane(swash > 0.0):
        _fly_part(x, u, dt, p, work)
        return
    late_rotors, late_swash = _split(rotors, slots, dt), _split(swash, slots, dt)
    first = min(late_rotors[1], late_swash[1])
    second = max(late_rotors[1], late_swash[1])
    since, begin = 0.0 * first, u[U.TIME]
    for k in range(3):
        until = first if k == 0 else (second if k == 1 else dt)
        flies = until - since > SHORTEST_PART
        if any_lane(flies):
            _take(ring, row, late_rotors, since, U.OMEGA_U, u)
            _take(ring, row, late_swash, since, U.DELTA_LON, u)
            u[U.TIME] = begin + since
            _fly_part(x, u, until - since, p, work)
            since = select(flies, until, since)


@compiled()
def next_azimuth(azimuth, speed, dt):
    """Azimuth [rad] of a rotor of this speed [rad/s] after `dt` seconds, within a turn.

    Args:
        azimuth: [rad] now. speed: of the rotor [rad/s]. dt: [s].
    """
    azimuth = azimuth + dt * speed
    return azimuth - TURN * math.floor(azimuth / TURN)


@compiled()
def gust_growth(dt, memory):
    """What a gust of unit std gains over `dt` seconds to stay of unit std, as a std."""
    return math.sqrt(1.0 - math.exp(-2.0 * dt / memory))


@compiled()
def add_gusts(x, p, gust, stream):
    """Move the gust states on by one period: exponential memory, stationary std `gust` (2,).

    Args:
        x: full state, (29,), in place. p: parameter vector.
        gust: std of force [N] and moment [N m], (2,). stream: key and counter, (2,) uint64.
    """
    for half, first, memory_xy in (
        (FORCE, S.GUST_X, P.MEMORY_FORCE_XY), (MOMENT, S.GUST_L, P.MEMORY_MOMENT_XY),
    ):  # fmt: skip
        if gust[half] > 0.0:
            a, b = two_normals(stream)
            c, _ = two_normals(stream)
            share = gust_growth(DT, p[memory_xy]) * gust[half]
            x[first] += share * a
            x[first + 1] += share * b
            x[first + 2] += gust_growth(DT, p[memory_xy + 1]) * gust[half] * c


# --- readings -----------------------------------------------------------------------------------------


@compiled()
def true_readings(x, u, p, azimuth, work, readings):
    """Every channel without its sensor's errors, (18,), into `readings`; the vibration is in them.

    Args:
        x, u, p, work: as in `fly_period`. azimuth: of the upper rotor [rad].
    """
    measure(x, u, p, work, readings)
    shake(readings, azimuth, p)


@compiled()
def shake(readings, azimuth, p):
    """Add the vibration, if there is one, to readings (18,), in place.

    Args:
        readings: (18,), in place. azimuth: of the upper rotor [rad]. p: parameter vector.
    """
    v = _VIBRATION
    if p[v] + p[v + 1] + p[v + 2] + p[v + 3] != 0.0:  # none is negative
        add_vibration(readings, azimuth, p[v], p[v + 1], p[v + 2], p[v + 3])


@compiled()
def take_samples(values, row, sensors, bias, stream, flags, held):
    """New readings where they are due, into `held`: readings, then this many flags.

    A sensor's noise, and an instrument's chance of losing a sample, have their own places in the
    stream of random numbers: every row takes twice as many as there are sensors.

    Args:
        values: what the sensors measure, without errors, (n_sensors,).
        row: control periods since the flight's start.
        sensors: `sampling.sensor_table`. bias: of this flight, (n_sensors,).
        stream: key and counter, (2,) uint64. flags: how many. held: (n_sensors + flags or more,).
    """
    n = len(sensors)
    for k in range(n, n + flags):
        held[k] = 0.0
    place = place_of(stream)
    noisy = 0
    pair = -1
    rate = -1.0
    new = first = second = 0.0 * row
    for k in range(n):
        noise = sensors[k, NOISE]
        here = noisy // 2
        even = noisy % 2 == 0
        noisy += noise > 0.0
        if sensors[k, RATE] != rate:
            rate = sensors[k, RATE]
            new = new_samples(row, rate)
        if not any_lane(new > 0.0):
            continue
        value = values[k] + bias[k]
        if noise > 0.0:
            if here != pair:
                pair = here
                first, second = normals_of(bits_ahead(place, pair))
            value += noise * (first if even else second)
        value = within_a_turn(value, sensors[k, WRAPS])
        got = new
        if sensors[k, DROPOUT] > 0.0:
            chance = chance_of(bits_ahead(place, n + int(sensors[k, INSTRUMENT])))
            got = received(new, row, chance, sensors[k, DROPOUT])
        before = held[k]
        value = select(math.isfinite(value), value, before)
        value = select(got < 1.0, before, value)
        held[k] = min(max(value, sensors[k, LOW]), sensors[k, HIGH])
        flag = int(sensors[k, FLAG])
        if flag >= 0:
            held[flag] = max(held[flag], min(got, 1.0))
    skip(stream, 2 * n)


@compiled()
def copy_row(row, out):
    """One row of numbers into another."""
    for k in range(len(row)):
        out[k] = row[k]
