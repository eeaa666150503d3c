"""From true readings to what a sensor shows: vibration, delay, bias, rate, lost samples, limits.

One set of compiled rules for the env, the batch and simulated logs. Who flies or logs draws the chance:
the env from its helicopter's random stream (env/period.py), a log from NumPy's (simulation/log.py).
The numbers of the sensors flown are one array, see `sensor_table`.
"""

import math
from collections.abc import Sequence

import numpy as np

from coax_env.kernel.angles import wrap_angle
from coax_env.kernel.compilation import compiled
from coax_env.kernel.simd import select
from coax_env.model.layout import CHANNELS, N_CHANNELS
from coax_env.model.sensors import BASE_RATE, Sensor

(
    INDEX, NOISE, RATE, LOW, HIGH, WRAPS, FLAG, DELAY, DROPOUT, INSTRUMENT, BIAS, BIAS_STD
) = range(12)  # fmt: skip
"""Columns of a sensor table. RATE in samples per row, DELAY in rows; FLAG: place of the instrument's
"new" flag among the readings held, -1 without one."""

_ACCELEROMETER = CHANNELS.index("ax")


def sensor_table(
    sensors: Sequence[Sensor], flags: Sequence[str] = (), dt: float = 1.0 / BASE_RATE
) -> np.ndarray:
    """The sensors' numbers as compiled code takes them, shape (n_sensors, 12).

    Args:
        flags: instruments that have a "new" flag after the readings, see `slow_instruments`.
        dt: seconds per row.
    """
    instruments = [s.instrument for s in sensors]
    per_second = round(1.0 / dt, 9)  # rows
    return np.array(
        [
            [
                s.index, s.noise, s.rate / per_second, s.low, s.high, float(s.wraps),
                len(sensors) + flags.index(s.instrument) if s.instrument in flags else -1,
                s.delay / dt, s.dropout, instruments.index(s.instrument), s.bias, s.bias_std,
            ]
            for s in sensors
        ],
        dtype=float,
    )  # fmt: skip


@compiled()
def add_vibration(readings, azimuth, amplitude):
    """Add to a row of readings (18,), in place, what the upper rotor at an azimuth [rad] shakes.

    An unbalance turns with the rotor: a line at rotor speed on every axis (effect `vibration`). An
    amplitude [m/s2] of zero changes nothing.

    Args:
        readings: (18,), in place. azimuth: of the upper rotor [rad]. amplitude: [m/s2].
    """
    readings[_ACCELEROMETER] += amplitude * math.sin(azimuth)
    readings[_ACCELEROMETER + 1] += amplitude * math.cos(azimuth)
    readings[_ACCELEROMETER + 2] += amplitude * math.sin(azimuth)


@compiled()
def measured_quantities(x, readings, sensors, out):
    """What each sensor measures, of the readings (18,) and the full state (29,), into `out`.

    Args:
        x: full state, (29,). readings: without errors, (18,). sensors: `sensor_table`.
        out: is put here, (n_sensors,), each in its channel's unit.
    """
    for k in range(len(sensors)):
        index = int(sensors[k, INDEX])
        out[k] = readings[index] if index < N_CHANNELS else x[index - N_CHANNELS]


@compiled()
def delayed(value, past, row, k, delay):
    """The value of `delay` rows before this one, between rows by a straight line.

    Keeps `value` in column `k` of the ring `past` (slots, n_sensors), with two slots more than the
    whole rows of the delay. Before the first row all was as in it.

    Args:
        value: in this row. past: (slots, n_sensors), in place. row: since the flight's start.
        k: which sensor. delay: rows, whole or not.
    """
    slots = len(past)
    if row == 0:
        for slot in range(slots):
            past[slot, k] = value
    past[row % slots, k] = value
    whole = int(delay)
    share = delay - whole
    newer = past[(row - whole) % slots, k]
    older = past[(row - whole - 1) % slots, k]
    return newer + share * (older - newer)


def delay_slots(delay_rows: float) -> int:
    """Slots of the ring that `delayed` needs for delays of up to so many rows; none for no delay."""
    return 2 + math.ceil(delay_rows) if delay_rows > 0.0 else 0


@compiled()
def new_samples(row, per_row):
    """How many samples a sensor of `per_row` samples a row has taken since the row before.

    Samples are rounded up to rows: at 40 Hz and 100 rows a second they come after 3, 2, 3, 2 ... rows.
    """
    now = math.floor(row * per_row + 1e-9)
    return now - math.floor((row - 1) * per_row + 1e-9)


@compiled()
def is_new(row: int, rate: float) -> bool:
    """Whether a sensor of `rate` [Hz] has a new sample in a row of the 100 Hz loop; row 0 always."""
    return new_samples(row, rate / BASE_RATE) > 0.0


@compiled()
def received(new, row, chance, dropout):
    """`new`, or zero where the sample is lost: where `chance` in [0, 1) is less than `dropout`.

    A flight's first sample is never lost.

    Args:
        new: samples since the row before. row: since the flight's start.
        chance: drawn in [0, 1). dropout: probability that a sample is lost.
    """
    return select((row <= 0) | (chance >= dropout), new, 0.0)


@compiled()
def within_a_turn(value, wraps):
    """A reading, taken within a turn where its sensor `wraps`."""
    return wrap_angle(value) if wraps != 0.0 else value
