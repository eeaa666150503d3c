"""What the engine asks of a model, and the records it works on."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

AT_LIMIT = 0.99
"""Share of the way from a prior's mean to a limit from which a number stands there; ours."""


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

    def is_at_limit(self, value: float) -> bool:
        """Whether a value is as far from the prior's mean as it may be.

        Not where that mean is the limit: an effect that may be none has not gone far to be none.

        Args:
            value: a fitted one.
        """
        far = value - self.value
        most = abs((self.upper if far > 0.0 else self.lower) - self.value)
        return abs(far) > AT_LIMIT * most > 0.0


class Strength(NamedTuple):
    """How much stronger than its level process noise is, by blocks of time.

    block: (n,) the block of each row. factor: (blocks, e) of the intensity of each entry of the
    model's `noise_places`. Both are empty where it is steady.
    """

    block: np.ndarray
    factor: np.ndarray

    @property
    def steady(self) -> bool:
        """Whether it is one level from the first row to the last."""
        return not self.block.size

    def part(self, rows: np.ndarray) -> "Strength":
        """That of some rows."""
        return self if self.steady else self._replace(block=self.block[rows])


STEADY = Strength(np.zeros(0, np.int64), np.zeros((0, 0)))
"""Process noise of one level from the first row to the last."""


class Late(NamedTuple):
    """Whose readings are late, and by how many whole rows they are moved back (late_readings.py).

    place: of the delay in the parameter vector. channels: (m,) True where readings are late by it.
    rows, seconds: how far they are moved. rates: (n, m) [1/s] of the record's readings. nats:
    log-likelihood of those that have no row to go to. done: whether the record's were moved.
    """

    place: int
    channels: np.ndarray
    rows: int
    seconds: float
    rates: np.ndarray = np.zeros((0, 0))
    nats: float = 0.0
    done: bool = False


@dataclass(frozen=True)
class Record:
    """One run as the engine sees it.

    t: (n,) seconds, increasing. command: (n, k), held from each row to the next.
    z: (n, m) readings in the order of the model's channels, NaN where there is no new sample.
    origin: time at which the run began, also where the record is a part of it.
    run: name of the run of which it is a part; empty where it is a run itself.
    input_innovations: (n, k) what each command shows beyond the readings before it, or None
    (input_innovations.py). battery: (n,) its voltage [V], or None. strength: of its process noise.
    blur: (n, m) variance of each reading beyond its level's (clock_errors.py), or None.
    of_next: share of the next row's command in what is commanded over a row in the mean, which readings
    at its beginning do not see (between_rows.py); 0: it is held. between: variance of that mean, in
    squares of the change to the next row; 0: it was so.
    air: level of the process noise -> times which it is on this run (run_air.py).
    late: which readings can be moved back, or None.
    """

    name: str
    t: np.ndarray
    command: np.ndarray
    z: np.ndarray
    origin: float = 0.0
    input_innovations: np.ndarray | None = None
    run: str = ""
    battery: np.ndarray | None = None
    strength: Strength = STEADY
    blur: np.ndarray | None = None
    of_next: float = 0.0
    between: float = 0.0
    air: Mapping[str, float] = field(default_factory=dict)
    late: Late | None = None

    @property
    def whole(self) -> str:
        """Name of the run that it is, or is a part of."""
        return self.run or self.name


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
        strength=record.strength.part(rows),
        blur=of(record.blur),
        late=None if record.late is None else record.late._replace(rates=record.late.rates[rows]),
    )


@dataclass(frozen=True)
class Noise:
    """Spread of what the model does not say: its levels, by name.

    process: levels of the model's process noise (for the helicopter: gust force [N] and moment [N m]
    with their memories [s], and more, see helicopter.py). reading: std of each channel, in its unit.
    floor, ceiling: the least and the most that a level can be. prior: what is known of a level
    beforehand, as its median and the std of its logarithm; levels without one are known by the data
    alone.
    """

    process: Mapping[str, float]
    reading: Mapping[str, float] = field(default_factory=dict)
    floor: Mapping[str, float] = field(default_factory=dict)
    ceiling: Mapping[str, float] = field(default_factory=dict)
    prior: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def level(self, name: str) -> float:
        """A level by its name, that of a channel for its readings."""
        return self.process[name] if name in self.process else self.reading[name]

    def with_levels(self, levels: Mapping[str, float]) -> "Noise":
        """With some levels changed."""
        process = {n: levels.get(n, v) for n, v in self.process.items()}
        return replace(
            self, process=process, reading={n: levels.get(n, v) for n, v in self.reading.items()}
        )

    def times(self, air: Mapping[str, float]) -> "Noise":
        """With levels of the process noise so many times as large: those of a run with such air."""
        if not air:
            return self
        return self.with_levels({n: f * self.process[n] for n, f in air.items()})

    def at_bound(self, name: str) -> bool:
        """Whether a level stands at the least or most that it can be, within a hundredth."""
        low, high = self.floor.get(name, 0.0), self.ceiling.get(name, np.inf)
        return not 1.01 * low < self.level(name) < 0.99 * high


class ProcessNoise(NamedTuple):
    """Process noise as the filter takes it: what it adds to the covariance's entries `noise_places`.

    intensity: (e,) growth per second, decay: (e,) rate [1/s] at which what was added decays (the state
    of an exponential memory has that of its own decay; 0 elsewhere).
    """

    intensity: np.ndarray
    decay: np.ndarray


class Model(Protocol):
    """A system that can be put through the engine.

    Derivatives are taken of `drift_and_readings`: into `out`, (nx + m,), what a row of `dt` seconds
    adds to the state, to first order at least, and the readings at its start. A run's last row has 0.
    A model may have `side_by_side`: pointers to `step`, `measure` and `drift_and_readings` of
    SIMD_WIDTH states, inputs and parameter vectors at once, a column each, (.., SIMD_WIDTH);
    `input_places`: the places in the parameter vector of all that `inputs` follows; `in_blocks`: the
    places of a parameter in a vector that has it more than once; and `of_noise`:
    (nx,) True of states that are nothing, and move nothing, but for the noise that shakes them.
    """

    channels: tuple[str, ...]
    wraps: np.ndarray  # (m,) True where an innovation is an angle
    state_scale: np.ndarray  # (nx,) size of a small change of each state, for derivatives
    step: Any  # compiled pointer: (x, u, dt, p, work, out)
    measure: Any  # compiled pointer: (x, u, p, work, out)
    drift_and_readings: Any  # compiled pointer: (x, u, dt, p, work, out), see above
    air: np.ndarray  # places of the states that are gusts
    exact: np.ndarray  # (nx,) True where the drift is more than first order in dt
    work_size: int
    noise_places: (
        np.ndarray
    )  # (e, 2) entries (i <= j) of the process noise: all (i, i), then others

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """The compiled functions' parameter vector for named values; others as in the model.

        Args:
            values: by name. noise: whose memories the vector has; None: usual ones.
        """

    def inputs(self, record: Record, vector: np.ndarray) -> np.ndarray:
        """Inputs (n, nu) of the compiled functions, row by row."""

    def between(self, record: Record, vector: np.ndarray) -> np.ndarray:
        """Variance of the first k inputs' means over each row (n, k), of a record that has some."""

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """First state (nx,) and its covariance (nx, nx), from the record's first readings."""

    def start_noise(self, noise: Noise) -> np.ndarray:
        """What the noise levels add to the variances of the first state (nx,)."""

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        """What the noise adds to the covariance, entry by entry of `noise_places`.

        Args:
            noise: its levels. vector: the parameters, which noise may act through.
        """
