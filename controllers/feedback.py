"""Common to this project's controllers: one helicopter or a batch, and controller.json."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.files import write_json

FORMAT = "coax-controller"
VERSION = 1
"""Of controller.json, whatever the kind."""


class Feedback(ABC):
    """A controller; a subclass defines how a flight begins and what action follows an observation.

    Its actions are about `action_trim`, in units of `action_scale`, both (4,) per command.
    """

    kind: str
    sensors: str  # the suite it must be given
    action_trim: np.ndarray
    action_scale: np.ndarray
    count = 0  # helicopters in flight

    @property
    def nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """Trim and scale of its actions, for ``nominal=`` of the env."""
        return self.action_trim, self.action_scale

    def reset(self, count: int = 1) -> None:
        """Forget the last flight; `count` helicopters are flown next."""
        self.count = count
        self.begin()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Observation (n_obs,) or (count, n_obs) to action (4,) or (count, 4), float32."""
        batch = np.atleast_2d(observation)
        if self.count != len(batch):
            self.reset(len(batch))
        actions = np.clip(self.compute_actions(batch), -1.0, 1.0).astype(np.float32)
        return actions if np.ndim(observation) == 2 else actions[0]

    @abstractmethod
    def begin(self) -> None:
        """New flights of `count` helicopters."""

    @abstractmethod
    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to observations (count, n_obs)."""


class Designed(ABC):
    """What is kept in a controller.json."""

    kind: str
    vehicle: str  # the name of what it was designed on

    @abstractmethod
    def content(self) -> dict[str, Any]:
        """What a file of this kind has of its own."""

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file, weights included."""
        header = {"format": FORMAT, "version": VERSION, "kind": self.kind, "vehicle": self.vehicle}
        return header | self.content()

    def save(self, path: str | Path) -> Path:
        """Write controller.json."""
        return write_json(path, self.to_dict())
