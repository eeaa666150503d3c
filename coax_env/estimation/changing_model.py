"""A machine that changes while it flies: effects that begin, end or grow at a moment.

An effect's numbers are what the machine has after its moment, the last that is known of it;
``swash_offset.lon@before`` is what it had before, its off-value where that is not said. What grows has
a share of the difference that goes from 0 to 1 evenly between two times of the flight's clock, which
are numbers that may be fitted: ``swash_offset.moment@begins`` and ``swash_offset.moment@grown``. The
clock counts flown time, from run to run.

The parameter vector has a block of the model's own for every size that the machine has between
changes, the last one first; behind them when it has them, which of the blocks these are, and a block's
length. An input more says where between the blocks a row is: a whole number, or while something grows
a fraction.
"""

from collections.abc import Iterable, Mapping
from functools import cache, cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from coax_env.estimation.helicopter import (
    MEASURE,
    STEP,
    HeliModel,
    Moment,
    Motion,
    compiled_motion,
    side_by_side,
)
from coax_env.estimation.parted_engine import AT, of_part
from coax_env.estimation.state_space import FreeParameter, Noise, ProcessNoise, Record
from coax_env.kernel.compilation import compiled, pointer
from coax_env.kernel.simd import SIMD_WIDTH, select, simd_view
from coax_env.kernel.variants import under_names
from coax_env.model import effects

BEFORE = "before"
"""The part of the flight before an effect's moment, as in ``swash_offset.lon@before``."""
BEGINS, GROWN = "moment@begins", "moment@grown"
"""Times of the clock [s] between which an effect grows, as in ``swash_offset.moment@begins``."""
SHORTEST = 0.05
"""s in which something grows at least; ours: what comes faster comes at once."""
MOVED = 5.0
"""s, prior std at least of a time at which growth begins or ends, about where a fit of it begins: next
to none beside what is to be told; where it grows for longer, that length, or slow growth would stay
where its fit begins. Its slope is taken over a fiftieth of it; ours."""

step_of: Any = None  # the model's own, put in by `_pointers` and `side_by_side`
measure_of: Any = None
drift_of: Any = None


@compiled(inline="always")
def _own(u: Any, p: Any, work: Any) -> Any:
    """The model's parameters of a row: a block of `p`, or between two of them, in the scratch's end."""
    size = int(p[p.size - 1])
    last = int(u[u.size - 1])
    share = u[u.size - 1] - last
    if share == 0.0:
        return p[last * size : (last + 1) * size]
    own = work[work.size - size :]
    for i in range(size):
        later = p[last * size + i]
        own[i] = later + share * (p[(last + 1) * size + i] - later)
    return own


def _step(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    step_of(x, u[: u.size - 1], dt, _own(u, p, work), work, out)


def _measure(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    measure_of(x, u[: u.size - 1], _own(u, p, work), work, out)


def _drift_and_readings(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    drift_of(x, u[: u.size - 1], dt, _own(u, p, work), work, out)


@cache
def _pointers(motion: Motion, name: str) -> tuple[Any, Any, Any]:
    """`step`, `measure` and `drift_and_readings` that fly each row as a model does with its block.

    Args:
        motion: the model's. name: its kind, by which numba's cache tells them apart.
    """
    step, measure, drift = compiled_motion(motion, {}, f"of_{name}")
    kind = f"changing_{name}"
    return (
        pointer(STEP)(under_names(_step, {"step_of": step}, kind)),
        pointer(MEASURE)(under_names(_measure, {"measure_of": measure}, kind)),
        pointer(STEP)(under_names(_drift_and_readings, {"drift_of": drift}, kind)),
    )


@compiled()
def _in_one_block(u: Any) -> bool:
    """Whether all lanes are in the same block."""
    where = u[u.shape[0] - 1]
    same = where[0] == int(where[0])
    for lane in range(1, SIMD_WIDTH):
        same &= where[lane] == where[0]
    return same


@compiled()
def _mix_lanes(u: Any, p: Any, work: Any, size: int) -> None:
    """`_own` of each lane, into the scratch's end: the last block, and the way back from it."""
    end = p.shape[0] - 1
    blocks = end // (size + 2)
    p_, own = simd_view(p), simd_view(work)[work.shape[0] - size :]
    where = simd_view(u)[u.shape[0] - 1]
    for i in range(size):
        own[i] = p_[i]
    for k in range(blocks - 1):
        share = where - float(k)
        share = select(share > 1.0, 0.0 * share + 1.0, select(share > 0.0, share, 0.0 * share))
        for i in range(size):
            own[i] = own[i] + share * (p_[(k + 1) * size + i] - p_[k * size + i])


@compiled(inline="always")
def _own_of_lanes(u: Any, p: Any, work: Any) -> Any:
    """As `_own`, of every lane."""
    size = int(p[p.shape[0] - 1, 0])
    if _in_one_block(u):
        first = int(u[u.shape[0] - 1, 0]) * size
        return simd_view(p)[first : first + size]
    _mix_lanes(u, p, work, size)
    return simd_view(work)[work.shape[0] - size :]


def _step_of_lanes(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """`_step` of SIMD_WIDTH states, inputs and vehicles, a column each."""
    u_, p_ = simd_view(u)[: u.shape[0] - 1], _own_of_lanes(u, p, work)
    step_of(simd_view(x), u_, dt, p_, simd_view(work), simd_view(out))


def _measure_of_lanes(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    """`_measure` of as many."""
    u_, p_ = simd_view(u)[: u.shape[0] - 1], _own_of_lanes(u, p, work)
    measure_of(simd_view(x), u_, p_, simd_view(work), simd_view(out))


def _drift_of_lanes(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """`_drift_and_readings` of as many."""
    u_, p_ = simd_view(u)[: u.shape[0] - 1], _own_of_lanes(u, p, work)
    drift_of(simd_view(x), u_, dt, p_, simd_view(work), simd_view(out))


OF_LANES = Motion(_step_of_lanes, _measure_of_lanes, _drift_of_lanes)


class Timed(Protocol):
    """A run, or a part of one: `Run` and `Record`."""

    @property
    def t(self) -> np.ndarray: ...

    @property
    def whole(self) -> str: ...


class Lap(NamedTuple):
    """When a run starts on the clock [s], and what its own time is then [s]."""

    start: float
    first: float


def clock_of(runs: Iterable[Timed]) -> dict[str, Lap]:
    """The clock that runs on from run to run: a first row comes a row after the last one before it.

    Args:
        runs: in the order in which they were flown, or parts of them.
    """
    spans: dict[str, tuple[float, float, float]] = {}
    for run in runs:
        first, last, step = spans.get(run.whole, (np.inf, -np.inf, 0.0))
        own = float(np.median(np.diff(run.t))) if run.t.size > 1 else step
        spans[run.whole] = (min(first, float(run.t[0])), max(last, float(run.t[-1])), own)
    clock, now = {}, 0.0
    for name, (first, last, step) in spans.items():
        clock[name] = Lap(now, first)
        now += last - first + step
    return clock


class Knot(NamedTuple):
    """A time of the clock [s] at which a change begins or is done, and each effect's share there.

    at: place of its block.
    """

    time: float
    shares: Mapping[str, float]
    at: int


class ChangingModel(HeliModel):
    """A model of which some effects begin, change or grow at a moment, through the engine's protocol.

    Attributes:
        moments: of each effect that begins, changes or grows.
        clock: of all runs in the order in which they were flown, held-out ones too; see `clock_of`.
    """

    def __init__(
        self, base: HeliModel, moments: Mapping[str, Moment], clock: Mapping[str, Lap]
    ) -> None:
        super().__init__(base.vehicle, base.bare_values)
        self._base, self.moments, self.clock = base, dict(moments), dict(clock)
        self.step, self.measure, self.drift_and_readings = _pointers(base.motion, base.kind)
        at_once = {m: e for e, m in self.moments.items() if m.grows == 0.0}
        self._changes = [*at_once.values(), *(e for e, m in self.moments.items() if m.grows > 0.0)]
        self._size = base.vector(base.bare_values).size
        self.exact, self.of_noise = base.exact, base.of_noise
        self.work_size = base.work_size + self._size
        self.state_scale, self.noise_places = base.state_scale, base.noise_places
        self.air = base.air

    @property
    def base(self) -> HeliModel:
        """The model that it is at any time."""
        return self._base

    @property
    def side_by_side(self) -> Any:
        """The base's own, block by block; None where it has none."""
        if self.base.side_by_side is None:
            return None
        return side_by_side(self.base.motion, f"changing_{self.base.kind}", OF_LANES)

    def time(self, moment: Moment) -> float:
        """A moment on the clock [s]."""
        lap = self.clock[moment.run]
        return lap.start + moment.t - lap.first

    def moment(self, time: float) -> Moment:
        """The moment at a time of the clock [s]."""
        begun = [name for name, lap in self.clock.items() if lap.start <= time]
        run = begun[-1] if begun else next(iter(self.clock))
        lap = self.clock[run]
        return Moment(run, time - lap.start + lap.first)

    def times(self, record: Record) -> np.ndarray:
        """Times of a record's rows on the clock [s], (n,).

        Of a part of a run, as "hover (last third)", too.
        """
        name = record.whole
        if name not in self.clock:
            name = next(run for run in self.clock if name.startswith(f"{run} ("))
        lap = self.clock[name]
        return lap.start + record.t - lap.first

    def spans(self, values: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """When each effect begins to come and is all there [s of the clock]: at once, or later."""
        found = {}
        for effect, moment in self.moments.items():
            begins = self.time(moment)
            grown = begins + moment.grows
            if moment.grows > 0.0:
                begins = values.get(f"{effect}.{BEGINS}", begins)
                least = min(SHORTEST, moment.grows)
                grown = max(values.get(f"{effect}.{GROWN}", grown), begins + least)
            found[effect] = (begins, grown)
        return found

    def knots(self, values: Mapping[str, float]) -> list[Knot]:
        """Two for each thing that grows and for each moment at which others change, in time's order."""
        spans = self.spans(values)
        times = sorted(t for e in self._changes for t in _ends(*spans[e]))
        shares = [{e: _share(t, *span) for e, span in spans.items()} for t in times]
        found: list[Knot] = []
        at = 0
        for t, own in zip(times[::-1], shares[::-1], strict=True):
            at += bool(found) and own != found[-1].shares
            found.append(Knot(t, own, at))
        return found[::-1]

    def stretches(self, record: Record, values: Mapping[str, float] | None = None) -> np.ndarray:
        """Which block each row is flown with (n,): 0 where the machine is what it is at last."""
        return _stretches(self.times(record), self._tail(self.knots(values or {})))

    def _tail(self, knots: Iterable[Knot]) -> np.ndarray:
        """What stands behind the blocks: times, places, and a block's length."""
        own = list(knots)
        return np.array([*(k.time for k in own), *(k.at for k in own), self._size], float)

    def values_at(self, knot: Knot, values: Mapping[str, float]) -> dict[str, float]:
        """Plain names' values at a knot."""
        own = {name: value for name, value in values.items() if AT not in name}
        for effect, share in knot.shares.items():
            for p in effects.CATALOGUE[effect].parameters if share < 1.0 else ():
                name = f"{effect}.{p.name}"
                if not (p.shape or p.held):
                    was = values.get(of_part(name, BEFORE), p.off)
                    last = own.get(name, self.bare_values.get(name, p.off))
                    own[name] = was + share * (last - was) if share > 0.0 else was
        return own

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """The blocks, the last one first, and behind them when the machine has them."""
        knots = self.knots(values)
        blocks = {k.at: self.base.vector(self.values_at(k, values), noise) for k in knots[::-1]}
        spare = [blocks[max(blocks)]] * (len(knots) - len(blocks))  # the length depends on no value
        return np.concatenate([*blocks.values(), *spare, self._tail(knots)])

    @cached_property
    def _places(self) -> np.ndarray:
        """Places in a block of what the model's inputs follow."""
        return np.arange(self._size)[self.base.input_places]

    @property
    def input_places(self) -> np.ndarray:
        """As `HeliModel.input_places`, in every block, and when the machine has these."""
        count = 2 * len(self._changes)
        own = np.concatenate([k * self._size + self._places for k in range(count)])
        return np.append(own, count * self._size + np.arange(2 * count))

    def in_blocks(self, place: int) -> np.ndarray:
        """A place in the model's parameter vector, in every block."""
        return np.arange(2 * len(self._changes)) * self._size + place

    def inputs(self, record: Record, vector: np.ndarray) -> np.ndarray:
        """The model's inputs with each row's parameters, and which these are, (n, nu + 1)."""
        count = (vector.size - 1) // (self._size + 2)
        blocks, tail = np.split(vector, [count * self._size])
        where = _stretches(self.times(record), tail)
        last = where.astype(int)
        there = {}
        for k in range(int(where.min()), int(np.ceil(where.max())) + 1):
            there[k] = self.base.inputs(record, blocks.reshape(count, -1)[k])
        first = next(iter(there.values()))
        u = first.copy()
        for k, own in there.items():
            rows, back = last == k, (where - k)[:, None]
            earlier = there.get(k + 1, own)
            u[rows] = (own + np.where(back > 0.0, back * (earlier - own), 0.0))[rows]
        return np.column_stack([u, where])

    def between(self, record: Record, vector: np.ndarray) -> np.ndarray:
        """As `HeliModel.between`, by what the machine is at last."""
        return self.base.between(record, vector[: self._size])

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """First state and its covariance, the model's."""
        return self.base.start(record)

    def start_noise(self, noise: Noise) -> np.ndarray:
        """Variances that the noise levels add to the first state, the model's."""
        return self.base.start_noise(noise)

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        """What the noise adds to the covariance, by what the machine is at last."""
        return self.base.process_noise(noise, vector[: self._size])


def before(f: FreeParameter) -> FreeParameter:
    """An effect's number before its moment, under the same prior."""
    return FreeParameter(
        of_part(f.name, BEFORE), f.value, f.std, f.lower, f.upper, f.probe, f.reading_only
    )


def times_of_growth(effect: str, begins: float, grown: float, until: float) -> list[FreeParameter]:
    """When an effect begins to grow and when it has grown, as numbers that may be fitted.

    Args:
        begins, grown: where the fit of them begins [s of the clock]. until: the flight's end there.
    """
    read = effects.CATALOGUE[effect].stage == effects.SENSOR
    std = max(MOVED, grown - begins)
    return [
        FreeParameter(f"{effect}.{name}", time, std, 0.0, until, 0.0, read)
        for name, time in ((BEGINS, begins), (GROWN, grown))
    ]


def _ends(begins: float, grown: float) -> tuple[float, float]:
    """The times between which a change comes; of one that comes at once, just before it and its own."""
    return (begins, grown) if begins < grown else (float(np.nextafter(begins, -np.inf)), begins)


def _share(time: float, begins: float, grown: float) -> float:
    """How much of a change is there at a time: none before it begins, all once it has grown."""
    if time >= grown:
        return 1.0
    return max(time - begins, 0.0) / (grown - begins) if grown > begins else 0.0


def _stretches(times: np.ndarray, tail: np.ndarray) -> np.ndarray:
    """Between which blocks rows are (n,), by their times on the clock; tail: of a parameter vector."""
    count = (tail.size - 1) // 2
    return np.interp(times, tail[:count], tail[count : 2 * count])
