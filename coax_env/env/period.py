"""One control period of a helicopter, in parts: command, gusts, judgement and readings.

Each part takes one helicopter's rows of numbers, or SIMD_WIDTH helicopters' rows of lanes (simd.py), and
is compiled for what it is given. fleet.py and fleet_simd.py put the parts together.
"""

import math

from coax_env.env import hover
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
from coax_env.model import parameters as P
from coax_env.model.layout import N_CHANNELS
from coax_env.model.sensors import new_samples

DT = hover.CONTROL_PERIOD

# columns of the sensor table the kernel reads
(
    INDEX, NOISE, RATE, LOW, HIGH, WRAPS, FLAG, LATE, DROPOUT, INSTRUMENT, BIAS, BIAS_STD
) = range(12)  # fmt: skip

_TURN = 2.0 * math.pi


@compiled()
def command(action, trim, scale, u):
    """An action (4,), clipped in place to [-1, 1], as commands into `u`."""
    for k in range(4):
        a = action[k]
        a = select(a < -1.0, -1.0, a)
        action[k] = select(a > 1.0, 1.0, a)  # NaN stays
        u[k] = trim[k] + scale[k] * action[k]


@compiled()
def blow(x, p, gust, stream):
    """Move the gust states on by one period: exponential memory, stationary std `gust` (2,)."""
    share = math.sqrt(1.0 - math.exp(-2.0 * DT / p[P.GUST_MEMORY]))
    for half in range(2):
        if gust[half] > 0.0:
            a, b = two_normals(stream)
            c, _ = two_normals(stream)
            x[20 + 3 * half] += share * gust[half] * a
            x[21 + 3 * half] += share * gust[half] * b
            x[22 + 3 * half] += share * gust[half] * c


@compiled()
def turned(azimuth, speed):
    """Azimuth [rad] of a rotor of this speed [rad/s] after one period, within a turn."""
    azimuth = azimuth + DT * speed
    return azimuth - _TURN * math.floor(azimuth / _TURN)


@compiled()
def seen(x, readings, sensors, out):
    """What the sensors look at, of the readings (18,) and the state (26,), into `out`."""
    for k in range(len(sensors)):
        index = int(sensors[k, INDEX])
        out[k] = readings[index] if index < N_CHANNELS else x[index - N_CHANNELS]


@compiled()
def rest(row, out):
    """One row of numbers into another: of a helicopter that does not fly."""
    for k in range(len(row)):
        out[k] = row[k]


@compiled()
def read(values, row, sensors, bias, stream, flags, held):
    """New readings where they are due, into `held`: readings, then this many flags.

    A sensor's noise, and an instrument's chance of losing a sample, have their own places in the
    stream of random numbers: every row takes twice as many as there are sensors.
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
        if sensors[k, WRAPS] != 0.0:
            value -= _TURN * math.floor((value + math.pi) / _TURN)
        got = new
        if sensors[k, DROPOUT] > 0.0:
            chance = chance_of(bits_ahead(place, n + int(sensors[k, INSTRUMENT])))
            got = select((row <= 0) | (chance >= sensors[k, DROPOUT]), got, 0.0)
        before = held[k]
        value = select(math.isfinite(value), value, before)
        value = select(got < 1.0, before, value)
        held[k] = min(max(value, sensors[k, LOW]), sensors[k, HIGH])
        flag = int(sensors[k, FLAG])
        if flag >= 0:
            held[flag] = max(held[flag], min(got, 1.0))
    skip(stream, 2 * n)
