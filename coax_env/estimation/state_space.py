"""What the engine asks of a model, and the records it works on."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np


@dataclass(frozen=True)
class FreeParameter:
    """A number the engine may change.

    ``value`` is the prior's mean and ``std`` its width; ``probe`` the finite step used for its
    signature near that mean (0: a small one, for the derivative). ``reading_only``: it never moves the
    state.
    """

    name: str
    value: float
    std: float
    lower: float = -np.inf
    upper: float = np.inf
    probe: float = 0.0
    reading_only: bool = False


@dataclass(frozen=True)
class Record:
    """One run as the engine sees it.

    t: (n,) seconds, increasing. command: (n, k), held from each row to the next.
    z: (n, m) readings in the order of the model's channels, NaN where there is no new sample.
    origin: time at which the run began, also where the record is a part of it.
    input_innovations: (n, k) what each command shows beyond the readings before it, or None
    (input_innovations.py). battery: (n,) its voltage [V], or None.
    """

    name: str
    t: np.ndarray
    command: np.ndarray
    z: np.ndarray
    origin: float = 0.0
    input_innovations: np.ndarray | None = None
    battery: np.ndarray | None = None


def part(record: Record, rows: np.ndarray) -> Record:
    """Some rows of a record, its clock kept."""

    def of(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[rows]

    return replace(
        record,
        t=record.t[rows],
        command=record.command[rows],
        z=record.z[rows],
        input_innovations=of(record.input_innovations),
        battery=of(record.battery),
    )


@dataclass(frozen=True)
class Noise:
    """Spread of what the model does not say.

    process: named levels of the model's process noise (for the helicopter: gust force [N] and moment
    [N m]). reading: std of each channel, in its unit. floor: the least that a process level can be,
    since no model is exact.
    """

    process: Mapping[str, float]
    reading: Mapping[str, float] = field(default_factory=dict)
    floor: Mapping[str, float] = field(default_factory=dict)


class Model(Protocol):
    """A system that can be put through the engine.

    Derivatives are taken of `drift_and_readings`: into `out`, (nx + m,), what a row of `dt` seconds
    adds to the state, to first order at least, and the readings at its start. A run's last row has 0.
    """

    channels: tuple[str, ...]
    wraps: np.ndarray  # (m,) True where an innovation is an angle
    state_scale: np.ndarray  # (nx,) size of a small change of each state, for derivatives
    step: Any  # compiled pointer: (x, u, dt, p, work, out)
    measure: Any  # compiled pointer: (x, u, p, work, out)
    drift_and_readings: Any  # compiled pointer: (x, u, dt, p, work, out), see above
    exact: np.ndarray  # (nx,) True where the drift is more than first order in dt
    work_size: int

    def vector(self, values: Mapping[str, float]) -> np.ndarray:
        """The compiled functions' parameter vector for named values; others as in the model."""

    def inputs(self, record: Record, vector: np.ndarray) -> np.ndarray:
        """Inputs (n, nu) of the compiled functions, row by row."""

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """First state (nx,) and its covariance (nx, nx), from the record's first readings."""

    def start_noise(self, noise: Noise) -> np.ndarray:
        """What the noise levels add to the variances of the first state (nx,)."""

    def process_noise(self, noise: Noise) -> np.ndarray:
        """Growth of each state's variance per second (nx,)."""
