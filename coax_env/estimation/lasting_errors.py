"""Errors of readings that last: what an onboard filter says, a compass near iron, GNSS.

An attitude that drifts with its gyros is wrong now as it was a moment ago, and so is a velocity of
GNSS. Fifteen states more than a model's own, in the filter alone: one error of each reading but the
rotors' speeds, with an exponential memory, which its reading has on top (Gelb, Applied Optimal
Estimation, 1974, section 4.5; Maybeck, Stochastic Models, 1979, section 6.5). Channels of one group
share a level and a memory. Taken for errors of a row alone, readings are believed as often as they are
read, and numbers with them: on **synthetic** flights a tilt of the inertial sensor was 3 and 4.5 std
off so, where it is 1.0 to 1.6 with these.
"""

import math
from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np

from coax_env.estimation.helicopter import Motion
from coax_env.estimation.helicopter_noise import error_level, error_memory
from coax_env.estimation.state_space import Noise
from coax_env.estimation.wrapping_model import WrappingModel
from coax_env.kernel.compilation import compiled
from coax_env.model import dynamics
from coax_env.model.layout import (
    ANGLES,
    CHANNELS,
    ERRING_GROUPS,
    MOTION_GROUPS,
    N_CHANNELS,
    N_FULL,
    SENSOR_GROUPS,
)

GROUP_OF = {channel: group for group in ERRING_GROUPS for channel in SENSOR_GROUPS[group]}
ERRING = tuple(GROUP_OF)
"""Channels whose errors may last, in the order of their states."""
MEMORY_START, MEMORY_OF_INERTIAL, MEMORY_SPREAD = 2.0, 10.0, 1.5
"""Median [s] of an error's memory, of an inertial sensor's, which drifts, and std of its logarithm;
ours."""
MEMORY_BOUNDS = (0.03, 60.0)
"""[s]: below, it is white at 100 Hz; above, a bias."""
LEAST_OF_INERTIAL = 0.5
"""[s] that an inertial sensor's error lasts at least: one of a few rows is no drift, but what a
low-pass leaves (0.07 s for one of 15 Hz on a **synthetic** flight); ours."""
START, START_OF_INERTIAL = 1.0, 0.3
SMALLEST, LARGEST = 0.01, 100.0
"""Times the std of a reading that its lasting error's is at first, at least and at most; ours."""
FINER = 0.1
"""Times the least std of a reading that its white part may have beside a lasting one: an onboard filter
has next to none; ours."""

_PLACES = np.array([CHANNELS.index(channel) for channel in ERRING])
_COUNT = len(ERRING)

inner_step: Any = None  # the inner model's, put in by `WrappingModel` and `side_by_side`
inner_measure: Any = None
inner_drift: Any = None
INNER = N_FULL  # its number of states, put in by `WrappingModel`
WORK = dynamics.WORK_SIZE  # the size of its scratch; behind it drift and readings


@compiled()
def _left(i, dt, p):
    """Share that is left of the i-th error after `dt` seconds; `p` ends with their memories."""
    return math.exp(-dt / p[p.size - _COUNT + i])


def _step(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The inner model's step; errors fade."""
    inner_step(x[:INNER], u, dt, p[: p.size - _COUNT], work, out[:INNER])
    for i in range(_COUNT):
        out[INNER + i] = x[INNER + i] * _left(i, dt, p)


def _measure(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    """The inner model's readings with their errors."""
    inner_measure(x[:INNER], u, p[: p.size - _COUNT], work, out)
    for i in range(_COUNT):
        out[_PLACES[i]] += x[INNER + i]


def _drift_and_readings(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The inner model's with errors; these fade exactly."""
    own = work[WORK : WORK + INNER + N_CHANNELS]
    inner_drift(x[:INNER], u, dt, p[: p.size - _COUNT], work, own)
    for i in range(INNER):
        out[i] = own[i]
    for i in range(_COUNT):
        own[INNER + _PLACES[i]] += x[INNER + i]
        out[INNER + i] = x[INNER + i] * (_left(i, dt, p) - 1.0)
    for i in range(N_CHANNELS):
        out[INNER + _COUNT + i] = own[INNER + i]


class ErringModel(WrappingModel):
    """A model whose readings have errors that last as well, through the engine's protocol."""

    own = Motion(_step, _measure, _drift_and_readings)
    added_scale = np.array([1e-5 if c in ANGLES else 1e-4 for c in ERRING])
    tail = _COUNT
    word = "erring"

    def added_parameters(self, inner: np.ndarray, noise: Noise | None) -> np.ndarray:
        """Memories of the errors [s]."""
        return _by_channel(noise, error_memory, MEMORY_START)

    def added_variances(self, noise: Noise) -> np.ndarray:
        """Of the errors, in their units squared."""
        return _by_channel(noise, error_level, 0.0) ** 2

    def added_noise(self, noise: Noise, tail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of errors with an exponential memory."""
        fades = 1.0 / tail
        return 2.0 * self.added_variances(noise) * fades, fades


def _by_channel(noise: Noise | None, name_of: Any, otherwise: float) -> np.ndarray:
    """A level of each of the channels ERRING, by its group's name."""
    levels = {} if noise is None else noise.process
    return np.array([levels.get(name_of(GROUP_OF[channel]), otherwise) for channel in ERRING])


def reading_std(noise: Noise, group: str) -> float:
    """Mean std of a group's readings, of which there is one at least."""
    read = [noise.reading[channel] for channel in SENSOR_GROUPS[group] if channel in noise.reading]
    return float(np.mean(read))


def without_errors(noise: Noise, groups: Collection[str]) -> Noise:
    """Noise levels without those of lasting errors of some groups, whose states are at rest then."""
    gone = {name(group) for group in groups for name in (error_level, error_memory)}
    return replace(noise, process={n: v for n, v in noise.process.items() if n not in gone})


def with_errors(noise: Noise) -> Noise:
    """Noise levels with those of lasting errors of the channels that it has, where their fit begins."""
    process, prior = dict(noise.process), dict(noise.prior)
    floor, ceiling = dict(noise.floor), dict(noise.ceiling)
    for group in ERRING_GROUPS:
        read = [channel for channel in SENSOR_GROUPS[group] if channel in noise.reading]
        if not read:
            continue
        std = reading_std(noise, group)
        level, memory = error_level(group), error_memory(group)
        inertial = group not in MOTION_GROUPS
        lasts = MEMORY_OF_INERTIAL if inertial else MEMORY_START
        process |= {level: (START_OF_INERTIAL if inertial else START) * std, memory: lasts}
        floor |= {level: SMALLEST * std}
        floor |= {memory: LEAST_OF_INERTIAL if inertial else MEMORY_BOUNDS[0]}
        floor |= {channel: FINER * noise.floor.get(channel, 0.0) for channel in read}
        ceiling |= {level: LARGEST * std, memory: MEMORY_BOUNDS[1]}
        prior[memory] = (lasts, MEMORY_SPREAD)
    return replace(noise, process=process, floor=floor, ceiling=ceiling, prior=prior)
