"""Passes of the filter over single runs: what they leave, and the memory that they work in."""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.estimation import frozen_gains, kalman
from coax_env.estimation.compiled_model import CompiledModel
from coax_env.estimation.late_readings import as_flown, rest_of
from coax_env.estimation.pass_data import Covariances, Gains, Path, RunData, Trace, Variances
from coax_env.estimation.state_space import Model, Noise, Record

GATE = 8.0  # std of an innovation beyond which a reading counts as an outlier; ours
REFRESH = 4  # rows between new Jacobians, at least
REFRESH_SECONDS = 0.04  # [s] in which they change little: more rows of a log faster than 100 Hz


@dataclass(frozen=True)
class RunPass:
    """What a filter pass leaves of one run.

    innovations: (n, m) whitened, NaN where there is no reading. states: (n, nx) filtered.
    gains: (readings, nx), per_sigma: (readings,), H: (n / rows between new ones, m, nx), see kalman.py,
    empty unless kept; shown: (nx,) of which states these are.
    start_covariances: (s, nx, nx) of the filtered state at `start_rows`.
    deweighted: how many readings were beyond the gate.
    """

    record: Record
    inputs: np.ndarray
    log_likelihood: float
    innovations: np.ndarray
    states: np.ndarray
    deweighted: int
    gains: np.ndarray
    per_sigma: np.ndarray
    H: np.ndarray
    shown: np.ndarray
    start_rows: np.ndarray
    start_covariances: np.ndarray


def gains_of(run: RunPass) -> Gains:
    """The gains of a pass that kept them, as other passes take them."""
    return Gains(run.gains, run.per_sigma, run.H, run.shown)


def trace_of(run: RunPass, path: Path) -> Trace:
    """A pass as the passes back over it take it."""
    return Trace(run.states, run.innovations, gains_of(run), path)


class Buffers:
    """Large arrays, filled anew by every pass: fresh memory would cost as much time as a pass."""

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
        """An array with whatever is in it.

        Args:
            name: under which it is filled anew. shape, dtype: that it is to have.
        """
        size = math.prod(shape)
        if name not in self._kept or self._kept[name].size < size:
            self._kept[name] = np.empty(size, dtype)
        return self._kept[name][:size].reshape(shape)


class RunPasses:
    """A model, the records that it is held against, and the passes over each of them.

    Attributes:
        threads: runs worked on at once; default COAX_THREADS of the environment, else 2.
        compiled: the model as passes fly it.
        starts: per record, first state (nx,) and covariance. intervals: seconds to the next row (n,).
        refresh: per record, rows that new Jacobians serve.
    """

    def __init__(self, model: Model, records: Sequence[Record], threads: int | None = None) -> None:
        self.model = model
        self.compiled = CompiledModel.of(model)
        self.records = tuple(records)
        self.threads = threads or int(os.environ.get("COAX_THREADS", "2"))
        self.starts = [model.start(r) for r in self.records]
        self.intervals = [np.append(np.diff(r.t), 0.0) for r in self.records]
        self.refresh = [_rows_between_jacobians(dt) for dt in self.intervals]
        self._buffers: list[Buffers] = []  # that no thread works with

    def each(self, work: Callable[[int], Any], which: Sequence[int] | None = None) -> list[Any]:
        """`work` done on every run (or those in `which`), the longest first so that no thread waits."""
        indices = range(len(self.records)) if which is None else which
        with ThreadPoolExecutor(self.threads) as pool:
            begun = {
                i: pool.submit(work, i)
                for i in sorted(indices, key=lambda i: -self.records[i].t.size)
            }
            return [begun[i].result() for i in indices]

    @contextmanager
    def borrowed_buffers(self) -> Iterator[Buffers]:
        """Buffers that no other thread works with meanwhile."""
        try:
            buffers = self._buffers.pop()
        except IndexError:
            buffers = Buffers()
        try:
            yield buffers
        finally:
            self._buffers.append(buffers)

    def filter_run(
        self,
        i: int,
        p: np.ndarray,
        noise: Noise,
        keep: Buffers | None,
        jacobians: Buffers | None = None,
        start_rows: np.ndarray | None = None,
        decaying: np.ndarray | None = None,
    ) -> tuple[RunPass, Path]:
        """The filter pass of a run, and what it linearised the model at.

        Args:
            i: index of the run. p: (np,) the parameters. noise: levels of process and reading noise.
            keep: buffers for what a mean pass needs (gains, H); nothing is stored without them.
            jacobians: buffers for the rest (F, predicted states); nothing is stored without them.
            start_rows: rows at which to keep the filtered covariance.
            decaying: states whose rows of the covariance are stored with these.
        """
        record, p = as_flown(self.model, self.records[i], p)
        n, m = record.z.shape
        q, decay = self.model.process_noise(noise, p)
        R = self._reading_variances(noise)
        nx = self.starts[i][0].size
        u = self.model.inputs(record, p)
        x0, P0 = self.starts[i]
        P0 = P0 + np.diag(self.model.start_noise(noise))
        blur = np.zeros((1, 0)) if record.blur is None else np.ascontiguousarray(record.blur)
        between = self.model.between(record, p) if record.between > 0.0 else np.zeros((0, 0))
        e = np.full((n, m), np.nan)
        states = np.zeros((n, nx))
        count, rows, buffers = (0, 0, Buffers()) if keep is None else (_readings(record), n, keep)
        K = buffers.array("K", (count, nx), np.float32)
        per_sigma = buffers.array("per_sigma", (count,))
        H = buffers.array("H", (math.ceil(rows / self.refresh[i]), m, nx), np.float32)
        rows, buffers = (0, Buffers()) if jacobians is None else (n, jacobians)
        F = buffers.array("F", (rows, nx, nx), np.float32)
        F_of = buffers.array("F_of", (rows,), np.int64)
        predicted = buffers.array("predicted", (rows, nx))
        decaying = np.empty(0, np.int64) if decaying is None else decaying
        rows_of_P = buffers.array("P", (rows, decaying.size, nx), np.float32)
        beyond = buffers.array("beyond", (count if rows else 0,))
        starts = np.empty(0, np.int64) if start_rows is None else start_rows
        slots = np.full(n, -1, np.int64)
        slots[starts] = np.arange(starts.size)
        P = np.zeros((starts.size, nx, nx))
        shown = np.full(nx, -1)
        gains = Gains(K, per_sigma, H, shown)
        path = Path(F, F_of, predicted, decaying, rows_of_P, beyond)
        log_likelihood, deweighted = kalman.filter_pass(
            self.compiled, RunData(self.intervals[i], u, record.z, record.strength, blur, between),
            Variances(x0, P0, R, q, decay), p, GATE, self.refresh[i],
            Trace(states, e, gains, path), Covariances(P, slots),
        )  # fmt: skip
        if record.late is not None:
            log_likelihood += record.late.nats
        if not np.isfinite(log_likelihood):
            K[:], per_sigma[:], H[:] = 0.0, 0.0, 0.0
        run = RunPass(
            record, u, log_likelihood, e, states, deweighted, K, per_sigma, H, shown, starts, P
        )
        return run, path

    def _reading_variances(self, noise: Noise) -> np.ndarray:
        return np.array([noise.reading.get(c, 1.0) for c in self.model.channels]) ** 2

    def frozen(self, i: int, run: RunPass, p: np.ndarray, out: np.ndarray) -> bool:
        """Whitened innovations of a run's mean with other parameters and the gains of a pass.

        Args:
            i: index of the run. run: a filter pass that kept its gains. p: (np,) the parameters.
            out: (n, m) innovations, 0 where there is no reading.

        Returns:
            False where the mean diverged.
        """
        p = rest_of(self.model, run.record, p)
        u = self.model.inputs(run.record, p)
        return frozen_gains.mean_pass(
            self.compiled, RunData(self.intervals[i], u, run.record.z), self.starts[i][0], p,
            gains_of(run), self.refresh[i], out,
        )  # fmt: skip


def _readings(record: Record) -> int:
    """How many readings a record has."""
    return int((~np.isnan(record.z)).sum())


def _rows_between_jacobians(dt: np.ndarray) -> int:
    """Rows of a run, with these seconds between them, that new Jacobians serve."""
    usual = float(np.median(dt[:-1])) if dt.size > 1 else 0.0
    return max(REFRESH, round(REFRESH_SECONDS / usual)) if usual > 0.0 else REFRESH
