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
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from coax_env.estimation.helicopter import HeliModel, Motion
from coax_env.estimation.helicopter_noise import error_level, error_memory
from coax_env.estimation.state_space import Noise, ProcessNoise, Record
from coax_env.kernel.compilation import compiled
from coax_env.kernel.variants import under_names
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

inner_step: Any = None  # the inner model's, put in by `erring` and `side_by_side`
inner_measure: Any = None
inner_drift: Any = None
INNER = N_FULL  # its number of states, put in by `erring`
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


@cache
def erring(inner: Motion, states: int, work: int, name: str) -> Motion:
    """The motion of a model whose readings have errors that last, not compiled.

    Args:
        inner: the model's without them. states: how many it has. work: size of its scratch.
        name: its class', by which numba's cache tells them apart.
    """
    names = {"INNER": states, "WORK": work}
    step, measure, drift = (
        under_names(f, names, f"over_{name}") for f in (_step, _measure, _drift_and_readings)
    )
    return Motion(step, measure, drift, inner)


class ErringModel(HeliModel):
    """A model whose readings have errors that last as well, through the engine's protocol.

    Attributes:
        inner: the model without them: the helicopter, or one whose rotor speeds jitter.
    """

    def __init__(self, inner: HeliModel) -> None:
        self.inner, self.states = inner, inner.exact.size
        self.motion = erring(inner.motion, self.states, inner.work_size, inner.kind)
        super().__init__(inner.vehicle, inner.bare_values)
        self.read_delay, self.frequencies = inner.read_delay, inner.frequencies
        self.air, self.exact = inner.air, np.append(inner.exact, np.ones(_COUNT, bool))
        self.work_size = inner.work_size + self.states + N_CHANNELS
        self.state_scale = np.append(
            inner.state_scale, [1e-5 if c in ANGLES else 1e-4 for c in ERRING]
        )
        added = [[i, i] for i in range(self.states, self.states + _COUNT)]
        self.noise_places = np.insert(inner.noise_places, self.states, added, 0)

    @property
    def kind(self) -> str:
        """As `HeliModel.kind`."""
        return f"erring_{self.inner.kind}"

    @property
    def errors(self) -> slice:
        """Places of the states that are errors of the channels ERRING, in their units."""
        return slice(self.states, self.states + _COUNT)

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """The inner model's parameter vector, and behind it the errors' memories [s]."""
        memories = _by_channel(noise, error_memory, MEMORY_START)
        return np.append(self.inner.vector(values, noise), memories)

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """First state (n,) and its covariance, without what the noise levels add."""
        x, covariance = self.inner.start(record)
        return np.append(x, np.zeros(_COUNT)), np.pad(covariance, (0, _COUNT))

    def start_noise(self, noise: Noise) -> np.ndarray:
        """Variances that the noise levels add to the first state (n,)."""
        errors = _by_channel(noise, error_level, 0.0)
        return np.append(self.inner.start_noise(noise), errors**2)

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        """What the noise adds to the covariance, by entry of `noise_places`."""
        own = self.inner.process_noise(noise, vector[:-_COUNT])
        fades = 1.0 / vector[-_COUNT:]
        driven = 2.0 * _by_channel(noise, error_level, 0.0) ** 2 * fades
        return ProcessNoise(
            np.insert(own.intensity, self.states, driven), np.insert(own.decay, self.states, fades)
        )


def with_inner(model: HeliModel, kind: type[HeliModel]) -> HeliModel:
    """A model of another kind, whose readings have errors that last where the first's have.

    Args:
        model: with such errors or without. kind: of the helicopter's motion.
    """
    if not isinstance(model, ErringModel):
        return kind.like(model)
    own = ErringModel(kind.like(model.inner))
    own.read_delay = model.read_delay
    return own


def _by_channel(noise: Noise | None, name_of: Any, otherwise: float) -> np.ndarray:
    """A level of each of the channels ERRING, by its group's name."""
    levels = {} if noise is None else noise.process
    return np.array([levels.get(name_of(GROUP_OF[channel]), otherwise) for channel in ERRING])


def with_errors(noise: Noise) -> Noise:
    """Noise levels with those of lasting errors of the channels that it has, where their fit begins."""
    process, prior = dict(noise.process), dict(noise.prior)
    floor, ceiling = dict(noise.floor), dict(noise.ceiling)
    for group in ERRING_GROUPS:
        read = [channel for channel in SENSOR_GROUPS[group] if channel in noise.reading]
        if not read:
            continue
        std = float(np.mean([noise.reading[channel] for channel in read]))
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
