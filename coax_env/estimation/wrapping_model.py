"""A model with more states around another one, in the filter alone: gusts that swing, errors that last.

The outer model's states and parameters follow the inner one's, so that whatever the inner one is - the
helicopter, one whose rotors jitter, one in gusts that swing - it is flown as it is by itself. Its
compiled functions call the inner one's (`Motion.inner`), and machine code is made for each nesting that
is used.
"""

from collections.abc import Mapping
from copy import copy
from functools import cache
from typing import Self

import numpy as np

from coax_env.estimation.helicopter import HeliModel, Motion
from coax_env.estimation.state_space import Noise, ProcessNoise, Record
from coax_env.kernel.variants import under_names
from coax_env.model.layout import N_CHANNELS


@cache
def _around(own: Motion, inner: Motion, states: int, work: int, name: str) -> Motion:
    """A motion around an inner one, not compiled.

    Args:
        own: which calls `inner_step` and its like; INNER in it is the number of the inner one's states,
            WORK the size of its scratch, behind which its drift and readings may be put.
        inner: what is called. states, work: its numbers.
        name: of the inner one's kind, by which numba's cache tells copies apart.
    """
    names = {"INNER": states, "WORK": work}
    step, measure, drift = (under_names(f, names, f"over_{name}") for f in own[:3])
    return Motion(step, measure, drift, inner)


class WrappingModel(HeliModel):
    """A model around another one, through the engine's protocol.

    Attributes:
        inner: the model without the added states. states: how many it has.
    """

    own: Motion  # of the added states, calling the inner model's
    added_scale: np.ndarray  # size of a small change of each added state, for differences
    tail: int  # parameters behind the inner model's
    word: str  # in `kind`

    def __init__(self, inner: HeliModel) -> None:
        self.inner, self.states = inner, inner.exact.size
        self.motion = _around(self.own, inner.motion, self.states, inner.work_size, inner.kind)
        super().__init__(inner.vehicle, inner.bare_values)
        self.read_delay, self.frequencies, self.air = inner.read_delay, inner.frequencies, inner.air
        added = np.ones(self.added_scale.size, bool)
        self.exact, self.of_noise = np.append(inner.exact, added), np.append(inner.of_noise, added)
        self.work_size = inner.work_size + self.states + N_CHANNELS
        self.state_scale = np.append(inner.state_scale, self.added_scale)
        places = np.repeat(np.r_[self.added][:, None], 2, axis=1)
        self.noise_places = np.insert(inner.noise_places, self._behind, places, 0)

    @classmethod
    def like(cls, model: HeliModel) -> Self:
        """Around a model, whose readings see the same commands."""
        return cls(model)

    def around(self, inner: HeliModel) -> "WrappingModel":
        """The same around another model.

        Args:
            inner: instead of its own.
        """
        return self.like(inner)

    def reading_after(self, delay: float) -> "WrappingModel":
        """The same, whose readings see commands this much later [s], once any delay is there."""
        model = copy(self)
        model.inner = self.inner.reading_after(delay)
        model.read_delay = delay
        return model

    @property
    def kind(self) -> str:
        """As `HeliModel.kind`."""
        return f"{self.word}_{self.inner.kind}"

    @property
    def added(self) -> slice:
        """Places of the added states."""
        return slice(self.states, self.states + self.added_scale.size)

    @property
    def _behind(self) -> list[int]:
        """Where each added state's own entry goes into the inner model's."""
        return [self.states] * self.added_scale.size

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """The inner model's parameter vector, and behind it what the added states need."""
        inner = self.inner.vector(values, noise)
        return np.append(inner, self.added_parameters(inner, noise))

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """First state (n,) and its covariance, without what the noise levels add."""
        x, covariance = self.inner.start(record)
        count = self.added_scale.size
        return np.append(x, np.zeros(count)), np.pad(covariance, (0, count))

    def start_noise(self, noise: Noise) -> np.ndarray:
        """Variances that the noise levels add to the first state (n,)."""
        return np.append(self.inner.start_noise(noise), self.added_variances(noise))

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        """What the noise adds to the covariance, by entry of `noise_places`."""
        inner = self.inner.process_noise(noise, vector[: -self.tail])
        driven, fades = self.added_noise(noise, vector[-self.tail :])
        return ProcessNoise(
            np.insert(inner.intensity, self._behind, driven),
            np.insert(inner.decay, self._behind, fades),
        )

    # --- what each kind says of its states ----------------------------------------------------------

    def added_parameters(self, inner: np.ndarray, noise: Noise | None) -> np.ndarray:
        """Parameters (tail,) of the added states.

        Args:
            inner: the inner model's parameter vector.
            noise: whose memories they have; None: usual ones.
        """
        raise NotImplementedError

    def added_variances(self, noise: Noise) -> np.ndarray:
        """Variances that the noise levels give the added states at the start of a run."""
        raise NotImplementedError

    def added_noise(self, noise: Noise, tail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Intensity of the noise that drives each added state, and the rate at which that fades [1/s].

        Args:
            noise: its levels. tail: parameters of the added states.
        """
        raise NotImplementedError


def with_innermost(model: HeliModel, kind: type[HeliModel]) -> HeliModel:
    """The same wraps around the helicopter with another motion, or with one wrap more around it.

    Args:
        model: with wraps or without. kind: of the helicopter's motion, or of the innermost wrap.
    """
    if isinstance(model, WrappingModel):
        return model.around(with_innermost(model.inner, kind))
    return kind.like(model)
