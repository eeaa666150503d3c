"""A machine that changes while it flies: effects that begin, end or grow at a moment.

An effect's numbers are what the machine has after its moment, the last that is known of it;
``swash_offset.lon@before`` is what it had before, its off-value where that is not said. All else is the
model's that it is made of. The parameter vector has a block for each stretch between moments, the last
stretch first, and behind them a block's length; an input more says which block a row is flown with.
"""

from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from typing import Any

import numpy as np

from coax_env.estimation import helicopter
from coax_env.estimation.helicopter import MEASURE, STEP, HeliModel, Moment, Motion
from coax_env.estimation.parted_engine import AT, of_part
from coax_env.estimation.state_space import FreeParameter, Noise, ProcessNoise, Record
from coax_env.kernel.compilation import compiled, pointer
from coax_env.kernel.simd import simd_view
from coax_env.kernel.variants import under_names
from coax_env.model import effects

BEFORE = "before"
"""The part of the flight before an effect's moment, as in ``swash_offset.lon@before``."""

_step_of: Any = None  # the model's own, put in by `_pointers`
_measure_of: Any = None
_drift_of: Any = None


@compiled(inline="always")
def _block(u: Any, p: Any) -> Any:
    """Where in `p` the parameters of a row begin and end."""
    size = int(p[p.size - 1])
    first = int(u[u.size - 1]) * size
    return first, first + size


def _step(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    first, end = _block(u, p)
    _step_of(x, u[: u.size - 1], dt, p[first:end], work, out)


def _measure(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    first, end = _block(u, p)
    _measure_of(x, u[: u.size - 1], p[first:end], work, out)


def _drift_and_readings(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    first, end = _block(u, p)
    _drift_of(x, u[: u.size - 1], dt, p[first:end], work, out)


@cache
def _pointers(motion: Motion, name: str) -> tuple[Any, Any, Any]:
    """`step`, `measure` and `drift_and_readings` that fly each row as a model does with its block.

    Args:
        motion: the model's. name: its class', by which numba's cache tells them apart.
    """
    step, measure, drift = (
        compiled()(under_names(function, {}, f"of_{name}")) for function in motion
    )
    kind = f"changing_{name}"
    return (
        pointer(STEP)(under_names(_step, {"_step_of": step}, kind)),
        pointer(MEASURE)(under_names(_measure, {"_measure_of": measure}, kind)),
        pointer(STEP)(under_names(_drift_and_readings, {"_drift_of": drift}, kind)),
    )


@compiled(inline="always")
def _block_of_lanes(u: Any, p: Any) -> Any:
    """As `_block`: the row is the same in every lane."""
    size = int(p[p.shape[0] - 1, 0])
    first = int(u[u.shape[0] - 1, 0]) * size
    return first, first + size


def _step_of_lanes(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """As `helicopter._step_of_lanes`, with the row's block."""
    first, end = _block_of_lanes(u, p)
    u_, p_, out_ = simd_view(u)[: u.shape[0] - 1], simd_view(p)[first:end], simd_view(out)
    _start_of_step(simd_view(x), u_, p_, out_)
    _step_of_registers(out_, u_, dt, p_, simd_view(work), out_)


def _measure_of_lanes(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    """`_measure` of as many."""
    first, end = _block_of_lanes(u, p)
    u_, p_ = simd_view(u)[: u.shape[0] - 1], simd_view(p)[first:end]
    _measure_of_registers(simd_view(x), u_, p_, simd_view(work), simd_view(out))


def _drift_of_lanes(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """`_drift_and_readings` of as many."""
    first, end = _block_of_lanes(u, p)
    u_, p_, out_ = simd_view(u)[: u.shape[0] - 1], simd_view(p)[first:end], simd_view(out)
    _drift_of_registers(simd_view(x), u_, dt, p_, simd_view(work), out_)
    _take_in_innovations(u_, p_, out_)


_step_of_registers: Any = None  # put in by `_side_by_side`, as in helicopter.py
_measure_of_registers: Any = None
_drift_of_registers: Any = None
_take_in_innovations = helicopter._take_in_innovations
_start_of_step = helicopter._start_of_step


@cache
def _side_by_side() -> Any:
    """Pointers to the three; None where the helicopter has none."""
    return helicopter.lanes_of_registers(
        Motion(_step_of_lanes, _measure_of_lanes, _drift_of_lanes), "changing"
    )


class ChangingModel(HeliModel):
    """A model of which some effects begin or change at a moment, through the engine's protocol.

    Attributes:
        moments: of each effect that begins or changes.
        runs: names of all runs in the order in which they were flown, held-out ones too.
    """

    def __init__(self, base: HeliModel, moments: Mapping[str, Moment], runs: Sequence[str]) -> None:
        super().__init__(base.vehicle, base.bare_values)
        self._base, self.moments, self.runs = base, dict(moments), tuple(runs)
        self.step, self.measure, self.drift_and_readings = _pointers(
            base.motion, type(base).__name__
        )
        self.exact, self.work_size = base.exact, base.work_size
        self.state_scale, self.noise_places = base.state_scale, base.noise_places
        self._times = sorted({self._place(m) for m in self.moments.values()}, reverse=True)

    @property
    def base(self) -> HeliModel:
        """The model that it is at any time."""
        return self._base

    @property
    def side_by_side(self) -> Any:
        """The helicopter's own, block by block; None where the model has none."""
        return None if self.base.side_by_side is None else _side_by_side()

    def _place(self, moment: Moment) -> tuple[int, float]:
        """Where in the flight a moment is: number of its run, and time in it."""
        return self.runs.index(moment.run), moment.t

    def _run(self, name: str) -> int:
        """Number of a run, or of the one of which the name says a part, as in "hover (last third)"."""
        if name in self.runs:
            return self.runs.index(name)
        return next(i for i, run in enumerate(self.runs) if name.startswith(f"{run} ("))

    def stretches(self, record: Record) -> np.ndarray:
        """How many moments come after each row (n,): 0 where the machine is what it is at last."""
        run = self._run(record.whole)
        first = np.zeros(record.t.size)
        for place, t in self._times:
            first += (run < place) | ((run == place) & (record.t < t))
        return first

    def values_in(self, stretch: int, values: Mapping[str, float]) -> dict[str, float]:
        """Plain names' values with so many moments to come."""
        own = {name: value for name, value in values.items() if AT not in name}
        for effect, moment in self.moments.items():
            if self._times.index(self._place(moment)) < stretch:
                for p in effects.CATALOGUE[effect].parameters:
                    name = f"{effect}.{p.name}"
                    if not (p.shape or p.held):
                        own[name] = values.get(of_part(name, BEFORE), p.off)
        return own

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """The model's parameter vector for each stretch, the last one first; and its length."""
        stretches = range(len(self._times) + 1)
        blocks = [self.base.vector(self.values_in(s, values), noise) for s in stretches]
        return np.concatenate([*blocks, [float(blocks[0].size)]])

    def _blocks(self, vector: np.ndarray) -> np.ndarray:
        return vector[:-1].reshape(-1, int(vector[-1]))

    @cached_property
    def input_places(self) -> np.ndarray:
        """As `HeliModel.input_places`, in every stretch's block."""
        size = self.base.vector(self.base.bare_values).size
        own = np.arange(size)[self.base.input_places]
        return np.concatenate([s * size + own for s in range(len(self._times) + 1)])

    def inputs(self, record: Record, vector: np.ndarray) -> np.ndarray:
        """The model's inputs with each row's parameters, and which these are, (n, nu + 1)."""
        which = self.stretches(record)
        there = [
            np.column_stack([self.base.inputs(record, block), which])
            for block in self._blocks(vector)
        ]
        return np.choose(which.astype(int)[:, None], there) if len(there) > 1 else there[0]

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """First state and its covariance, the model's."""
        return self.base.start(record)

    def start_noise(self, noise: Noise) -> np.ndarray:
        """Variances that the noise levels add to the first state, the model's."""
        return self.base.start_noise(noise)

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        """What the noise adds to the covariance, by what the machine is at last."""
        return self.base.process_noise(noise, self._blocks(vector)[0])


def before(f: FreeParameter) -> FreeParameter:
    """An effect's number before its moment, under the same prior."""
    return FreeParameter(
        of_part(f.name, BEFORE), f.value, f.std, f.lower, f.upper, f.probe, f.reading_only
    )
