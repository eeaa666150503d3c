"""Filter passes over records, and fits on top of them: signatures, Gauss-Newton under priors.

One engine, three uses: every parameter fixed is the simulation check, base parameters free is
identification, effects' parameters free is diagnosis.
"""

import math
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from coax_env.estimation import compiled_model, frozen_gains, kalman, noise_score, pass_data
from coax_env.estimation.beginnings import Asked, Beginning, Moved, Sums, beginnings_pass
from coax_env.estimation.freed_memory import return_freed_memory
from coax_env.estimation.noise_score import Slopes
from coax_env.estimation.quadratic import Linearised, Quadratic, penalty
from coax_env.estimation.sparse import add_gram, aligned, padded
from coax_env.estimation.state_space import FreeParameter, Model, Noise, Record
from coax_env.kernel.simd import SIMD_WIDTH
from coax_env.progress import Progress

GATE = 8.0  # std of an innovation beyond which a reading counts as an outlier; ours
REFRESH = 4  # rows between new Jacobians, at least
REFRESH_SECONDS = 0.04  # [s] in which they change little: more rows of a log faster than 100 Hz
BLOCK = 2.0  # [s] of the blocks whose scores are taken as independent
BLOCKS_AT_ONCE = 5  # whose signatures are held at a time: 7 MB at 100 Hz with every parameter
NONE_KEPT = frozen_gains.Kept(np.zeros((0, 0, 0), np.float32), np.zeros(0, np.int64))
OF_GAINS = ("gains", "per_sigma", "H")  # what takes most of a pass' memory
MANY_ROWS = 50_000
"""Rows, 500 s at 100 Hz, from which on what was freed goes back before a linearisation; ours."""
REMEMBERED = 4
"""Points at which something was linearised, a fit ended, or the noise was scored; ours."""
DIVERGED = 1e6  # whitened innovations [std] that only a diverging mean has


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


@dataclass(frozen=True)
class PassJacobians:
    """What a filter pass linearised the model at, for the signature and score passes.

    F: (<= n, nx, nx) Jacobians of the step, F_of: (n,) which of them a row has. predicted: (n, nx)
    states before each row's readings. decaying, P, beyond: see pass_data.Path.
    """

    F: np.ndarray
    F_of: np.ndarray
    predicted: np.ndarray
    decaying: np.ndarray
    P: np.ndarray
    beyond: np.ndarray


def _trace(run: RunPass, at: PassJacobians) -> pass_data.Trace:
    gains = pass_data.Gains(run.gains, run.per_sigma, run.H, run.shown)
    path = pass_data.Path(at.F, at.F_of, at.predicted, at.decaying, at.P, at.beyond)
    return pass_data.Trace(run.states, run.innovations, gains, path)


@dataclass(frozen=True)
class Estimate:
    """Result of a fit: values of the free parameters with their covariance.

    objective: minus log-likelihood plus the priors' penalty, nats.
    """

    names: tuple[str, ...]
    values: dict[str, float]
    covariance: np.ndarray
    objective: float
    log_likelihood: float
    iterations: int
    converged: bool

    @property
    def std(self) -> dict[str, float]:
        """Standard deviation by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@dataclass(frozen=True)
class _Moves:
    """Each free parameter moved: vectors (np,) with one of them moved by steps (k,).

    probed: (k,) where a finite step is needed. reading_only: (k,) which never move the state.
    """

    vectors: list[np.ndarray]
    steps: np.ndarray
    probed: np.ndarray
    reading_only: np.ndarray


@dataclass(frozen=True)
class _LinearisedRun:
    """One run's part of `Linearised`, its blocks' slopes with it.

    run, at: its pass. J: (readings, padded) signatures of its last blocks, k of them, then the
    innovations. wild: (k,) whose signatures were not finite.
    """

    run: RunPass
    at: PassJacobians
    J: np.ndarray
    wild: np.ndarray
    information: np.ndarray
    by_channel: np.ndarray
    blocks: np.ndarray


@dataclass(frozen=True)
class NoiseScore:
    """Log-likelihood [nats] (-inf where a filter diverged) and its slopes in the noise.

    in_noise: (blocks, e) in the intensity of each entry of the process noise, by blocks of BLOCK
    seconds, in_decay: (blocks, e) in its decay, in_start: (records, nx) in each variance of the first
    state, in_reading: (blocks, m) in each channel's variance. Expected: see noise_score.Slopes; of all
    records, (e,), by record (records, nx), of all (m,).
    """

    log_likelihood: float
    in_noise: np.ndarray
    in_decay: np.ndarray
    in_start: np.ndarray
    in_reading: np.ndarray
    noise_expected: np.ndarray
    start_expected: np.ndarray
    reading_expected: np.ndarray


@dataclass(frozen=True)
class _Known:
    """What is known at a point."""

    p: np.ndarray
    noise: Noise

    def is_at(self, p: np.ndarray, noise: Noise) -> bool:
        """Whether this is the point."""
        return np.array_equal(self.p, p) and self.noise == noise


@dataclass(frozen=True)
class _Flown(_Known):
    """The passes, without the rows' gains, and what was linearised there, in `free`, if anything."""

    passes: list[RunPass]
    free: tuple[FreeParameter, ...] = ()
    lin: Linearised | None = None


@dataclass(frozen=True)
class _Scored(_Known):
    """The noise's score."""

    score: NoiseScore


class _Buffers:
    """Large arrays, filled anew by every pass: fresh memory would cost as much time as a pass."""

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
        """An array of this shape with whatever is in it."""
        size = math.prod(shape)
        if name not in self._kept or self._kept[name].size < size:
            self._kept[name] = np.empty(size, dtype)
        return self._kept[name][:size].reshape(shape)


class Engine:
    """A model, the records it is held against, and the two passes over them.

    threads: runs worked on at once; default COAX_THREADS of the environment, else 2.
    """

    def __init__(self, model: Model, records: Sequence[Record], threads: int | None = None) -> None:
        self.model = model
        self.compiled = compiled_model.CompiledModel.of(model)
        self.records = tuple(records)
        self.threads = threads or int(os.environ.get("COAX_THREADS", "2"))
        self.starts = [model.start(r) for r in self.records]
        self.intervals = [np.append(np.diff(r.t), 0.0) for r in self.records]
        self._refresh = [_rows_between_jacobians(dt) for dt in self.intervals]
        self._readings = [int((~np.isnan(r.z)).sum()) for r in self.records]
        self._buffers: list[_Buffers] = []  # that no thread works with
        self._flown: deque[_Flown] = deque(maxlen=REMEMBERED)
        self._scored: deque[_Scored] = deque(maxlen=REMEMBERED)

    def _each(self, work: Callable[[int], Any], which: Sequence[int] | None = None) -> list[Any]:
        """Work done on every run (or those in `which`), the longest first so that no thread waits."""
        indices = range(len(self.records)) if which is None else which
        with ThreadPoolExecutor(self.threads) as pool:
            begun = {
                i: pool.submit(work, i)
                for i in sorted(indices, key=lambda i: -self.records[i].t.size)
            }
            return [begun[i].result() for i in indices]

    @contextmanager
    def _borrowed_buffers(self) -> Iterator[_Buffers]:
        try:
            buffers = self._buffers.pop()
        except IndexError:
            buffers = _Buffers()
        try:
            yield buffers
        finally:
            self._buffers.append(buffers)

    def filter(
        self,
        values: Mapping[str, float],
        noise: Noise,
        keep: bool = False,
        which: Sequence[int] | None = None,
        start_rows: Sequence[np.ndarray] | None = None,
    ) -> list[RunPass]:
        """Filter every run (or those in `which`) with these parameter values and noise levels.

        Args:
            values: of the parameters, by name.
            noise: levels of process and reading noise.
            keep: store gains and Jacobians of the readings.
            which: indices of records; None: all.
            start_rows: per record, rows at which to keep the filtered covariance.
        """
        p = self.model.vector(values, noise)
        if not keep and which is None and start_rows is None:
            for known in tuple(self._flown):
                if known.is_at(p, noise):
                    return known.passes

        def one(i: int) -> RunPass:
            starts = None if start_rows is None else start_rows[i]
            buffers = _Buffers() if keep else None
            return self._filter_run(i, p, noise, buffers, start_rows=starts)[0]

        return self._each(one, which)

    def remember(
        self, values: Mapping[str, float], noise: Noise, passes: Sequence[RunPass]
    ) -> None:
        """Passes of all records, to be returned where `filter` is asked for them again.

        Args:
            values, noise: at which the passes were flown. passes: of every record.
        """
        self._flown.append(_Flown(self.model.vector(values, noise), noise, _without_gains(passes)))

    def _reading_variances(self, noise: Noise) -> np.ndarray:
        return np.array([noise.reading.get(c, 1.0) for c in self.model.channels]) ** 2

    def _filter_run(
        self,
        i: int,
        p: np.ndarray,
        noise: Noise,
        keep: _Buffers | None,
        jacobians: _Buffers | None = None,
        start_rows: np.ndarray | None = None,
        decaying: np.ndarray | None = None,
    ) -> tuple[RunPass, PassJacobians]:
        """The filter pass of a run, and what it linearised the model at.

        Args:
            keep: buffers for what a mean pass needs (gains, H); nothing is stored without them.
            jacobians: buffers for the rest (F, predicted states); nothing is stored without them.
            decaying: states whose rows of the covariance are stored with these.
        """
        record = self.records[i]
        n, m = record.z.shape
        q, decay = self.model.process_noise(noise, p)
        R = self._reading_variances(noise)
        nx = self.starts[i][0].size
        u = self.model.inputs(record, p)
        x0, P0 = self.starts[i]
        P0 = P0 + np.diag(self.model.start_noise(noise))
        e = np.full((n, m), np.nan)
        states = np.zeros((n, nx))
        count, rows, buffers = (0, 0, _Buffers()) if keep is None else (self._readings[i], n, keep)
        K = buffers.array("K", (count, nx), np.float32)
        per_sigma = buffers.array("per_sigma", (count,))
        H = buffers.array("H", (math.ceil(rows / self._refresh[i]), m, nx), np.float32)
        rows, buffers = (0, _Buffers()) if jacobians is None else (n, jacobians)
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
        gains = pass_data.Gains(K, per_sigma, H, shown)
        path = pass_data.Path(F, F_of, predicted, decaying, rows_of_P, beyond)
        log_likelihood, deweighted = kalman.filter_pass(
            self.compiled, pass_data.RunData(self.intervals[i], u, record.z, record.strength),
            pass_data.Variances(x0, P0, R, q, decay), p, GATE, self._refresh[i],
            pass_data.Trace(states, e, gains, path), pass_data.Covariances(P, slots),
        )  # fmt: skip
        if not np.isfinite(log_likelihood):
            K[:], per_sigma[:], H[:] = 0.0, 0.0, 0.0
        run = RunPass(
            record, u, log_likelihood, e, states, deweighted, K, per_sigma, H, shown, starts, P
        )
        return run, PassJacobians(F, F_of, predicted, decaying, rows_of_P, beyond)

    def log_likelihood(
        self, values: Mapping[str, float], noise: Noise, which: Sequence[int] | None = None
    ) -> float:
        """Log-likelihood of the records, nats; -inf where a filter diverged.

        Args:
            values: of the parameters, by name.
            noise: levels of process and reading noise.
            which: indices of records; None: all.
        """
        for known in tuple(self._scored) if which is None else ():
            if known.is_at(self.model.vector(values, noise), noise):
                return known.score.log_likelihood
        return float(sum(p.log_likelihood for p in self.filter(values, noise, which=which)))

    def linearise(
        self,
        values: Mapping[str, float],
        noise: Noise,
        free: Sequence[FreeParameter],
        gains: bool = True,
    ) -> tuple[list[RunPass], Linearised]:
        """Filter, then the derivatives of the innovations in every free parameter, gains frozen.

        A parameter without a slope at its off-value (`probe`) is moved that far in a mean pass of its
        own.

        Args:
            values: of all parameters, by name.
            noise: levels of process and reading noise.
            free: the parameters to differentiate in.
            gains: whether the passes must have theirs; what is remembered has none.
        """
        p = self.model.vector(values, noise)
        for known in () if gains else tuple(self._flown):
            if known.lin is not None and known.free == tuple(free) and known.is_at(p, noise):
                return known.passes, known.lin
        moves = self._moves(values, noise, free)
        if sum(record.t.size for record in self.records) > MANY_ROWS:
            return_freed_memory()

        def one(i: int) -> _LinearisedRun:
            with self._borrowed_buffers() as buffers:
                return self._linearise_run(i, p, noise, moves, buffers, BLOCKS_AT_ONCE)

        return self._gathered(p, noise, free, self._each(one))

    def _gathered(
        self,
        p: np.ndarray,
        noise: Noise,
        free: Sequence[FreeParameter],
        found: Sequence[_LinearisedRun],
    ) -> tuple[list[RunPass], Linearised]:
        """The passes, and the linearisations of all runs."""
        passes = [one.run for one in found]
        lin = Linearised(
            tuple(f.name for f in free),
            np.array([one.information for one in found]),
            np.array([one.blocks.sum(0) for one in found]),
            np.array([one.by_channel for one in found]),
            np.concatenate([one.blocks for one in found]),
        )
        self._flown.append(_Flown(p, noise, _without_gains(passes), tuple(free), lin))
        return passes, lin

    def _linearise_run(
        self,
        i: int,
        p: np.ndarray,
        noise: Noise,
        moves: _Moves,
        buffers: _Buffers,
        at_once: int,
        kept: frozen_gains.Kept = NONE_KEPT,
    ) -> _LinearisedRun:
        """One run filtered and linearised, the signatures of so many blocks at once in memory."""
        run, at = self._filter_run(i, p, noise, _Buffers(), buffers)
        count, edges, before = len(moves.vectors), *_block_edges(run)
        width = padded(count + 1)
        products, blocks = np.zeros((width, width)), np.zeros((edges.size - 1, count))
        by_channel = np.zeros((count, run.innovations.shape[1]))
        J = np.zeros((0, width))
        if np.isfinite(run.log_likelihood):
            signatures = self._signatures(i, run, at, p, moves, by_channel)
            probed = self._probed_signatures(i, run, p, moves, by_channel)
            e = run.innovations[np.isfinite(run.innovations)]
            for first in range(0, edges.size - 1, at_once):
                own = edges[first : first + at_once + 1]
                since, until = before[own[0]], before[own[-1]]
                J = buffers.array("J", (int(until - since), width))
                J[:, count:] = 0.0
                J[:, count] = e[since:until]
                J[:, np.flatnonzero(moves.probed)] = probed[since:until]
                signatures(frozen_gains.Portion(int(own[0]), int(own[-1]), int(since)), J, kept)
                for b, (a, z) in enumerate(pairwise(before[own] - since), first):
                    of_block = np.zeros((width, width))
                    add_gram(J[a:z], count, of_block)
                    blocks[b] = of_block[:count, count]
                    products += of_block
        information = products[:count, :count]
        information = np.triu(information) + np.triu(information, 1).T
        wild = ~np.isfinite(np.diag(information))
        information[wild] = information[:, wild] = 0.0
        by_channel[wild] = 0.0
        blocks[:, wild] = 0.0
        return _LinearisedRun(run, at, J, wild, information, by_channel, blocks)

    def _moves(
        self, values: Mapping[str, float], noise: Noise, free: Sequence[FreeParameter]
    ) -> _Moves:
        probed = np.array([abs(values[f.name] - f.value) < 0.25 * abs(f.probe) for f in free], bool)
        steps = np.array([f.probe if probed[k] else 0.02 * f.std for k, f in enumerate(free)])
        over = np.array([values[f.name] + steps[k] > f.upper for k, f in enumerate(free)], bool)
        steps[over] *= -1.0
        vectors = [
            self.model.vector({**values, f.name: values[f.name] + step}, noise)
            for f, step in zip(free, steps, strict=True)
        ]
        reading_only = np.array([f.reading_only for f in free], bool)
        return _Moves(vectors, steps, probed, reading_only)

    def _signatures(
        self,
        i: int,
        run: RunPass,
        at: PassJacobians,
        p: np.ndarray,
        moves: _Moves,
        by_channel: np.ndarray,
    ) -> Callable[[frozen_gains.Portion, np.ndarray, frozen_gains.Kept], None]:
        """Derivatives of a run's whitened innovations where a small step does.

        Returns:
            what puts those of a portion of the run, one after the other, into columns of J, adds their
            squares, by channel, to rows of `by_channel`, and keeps the state's derivatives.
        """
        columns = np.flatnonzero(~moves.probed)
        if not columns.size:
            return lambda portion, J, kept: None
        columns = columns[np.argsort(~moves.reading_only[columns], kind="stable")]
        vectors = [moves.vectors[k] for k in columns]
        sets, which = [run.inputs], np.zeros(columns.size, np.int64)
        for k, vector in enumerate(vectors):
            inputs = self._inputs(run, p, vector)
            if not np.array_equal(inputs, run.inputs):
                which[k] = len(sets)
                sets.append(inputs)
        moved = frozen_gains.Moves(
            np.array(vectors), moves.steps[columns], moves.reading_only[columns],
            np.array(sets), which, columns,
        )  # fmt: skip
        s = aligned(self.compiled.exact.size, padded(columns.size + 1))
        trace = _trace(run, at)

        def of_portion(
            portion: frozen_gains.Portion, J: np.ndarray, kept: frozen_gains.Kept
        ) -> None:
            frozen_gains.signature_pass(
                self.compiled,
                self.intervals[i],
                trace,
                p,
                moved,
                self._refresh[i],
                portion,
                s,
                J,
                by_channel,
                kept,
            )

        return of_portion

    def beginnings(
        self,
        values: Mapping[str, float],
        noise: Noise,
        free: Sequence[FreeParameter],
        rows: Sequence[np.ndarray],
        asked: Asked,
    ) -> tuple[list[RunPass], Linearised, list[list[Beginning]]]:
        """`linearise`, and what free parameters would do if they moved from some row of a run on.

        See beginnings.py. Of a parameter that needs a finite step (`probe`) its past is not taken out
        of the state.

        Args:
            values: of all parameters, by name.
            noise: levels of process and reading noise.
            free: the parameters.
            rows: of each record, rising.
            asked: what is wanted of each row, in places of `free`.

        Returns:
            as `linearise`, and the rows' beginnings by record; none where the filter diverged.
        """
        p = self.model.vector(values, noise)
        moves = self._moves(values, noise, free)

        def one(i: int) -> tuple[_LinearisedRun, list[Beginning]]:
            n, nx = self.records[i].t.size, self.compiled.exact.size
            s = np.zeros((rows[i].size, nx, padded(len(free) + 1)), np.float32)
            kept = frozen_gains.Kept(s, np.full(n, -1, np.int64))
            kept.places[rows[i]] = np.arange(rows[i].size)
            with self._borrowed_buffers() as buffers:
                found = self._linearise_run(i, p, noise, moves, buffers, n, kept)
                begun = self._beginnings_of_run(i, found, rows[i], kept, asked)
            return replace(found, J=found.J[:0].copy()), begun

        found, begun = zip(*self._each(one), strict=True)
        return *self._gathered(p, noise, free, found), list(begun)

    def _beginnings_of_run(
        self,
        i: int,
        of: _LinearisedRun,
        rows: np.ndarray,
        kept: frozen_gains.Kept,
        asked: Asked,
    ) -> list[Beginning]:
        if not np.isfinite(of.run.log_likelihood):
            return []
        k, width = of.wild.size, of.J.shape[1]
        of.J[:, :k][:, of.wild] = kept.s[:, :, :k][:, :, of.wild] = 0.0
        a, pairs = rows.size, asked.first.size
        sums = Sums(
            np.zeros((a, width)), np.zeros((a, asked.beside.size, width)), np.zeros((a, pairs)),
            np.zeros((a, pairs)),
        )  # fmt: skip
        beginnings_pass(_trace(of.run, of.at), self._refresh[i], Moved(of.J, kept), asked, sums)
        return [
            Beginning(i, int(row), slope[:k], across[:, :k].T, crossed, own)
            for row, slope, across, crossed, own in zip(rows, *sums, strict=True)
        ]

    def _inputs(self, run: RunPass, p: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """A run's inputs with the parameters `vector`, known those with `p`."""
        places = getattr(self.model, "input_places", None)
        if places is not None and np.array_equal(p[places], vector[places]):
            return run.inputs
        return self.model.inputs(run.record, vector)

    def _probed_signatures(
        self, i: int, run: RunPass, p: np.ndarray, moves: _Moves, by_channel: np.ndarray
    ) -> np.ndarray:
        """The same where a finite step is needed, by a mean pass each: (readings, probed)."""
        there = np.isfinite(run.innovations)
        channel, e = np.nonzero(there)[1], run.innovations[there]
        columns = np.flatnonzero(moves.probed)
        found = np.zeros((e.size, columns.size))
        moved = self._moved_innovations(i, run, p, [moves.vectors[k] for k in columns])
        for column, (k, innovations) in enumerate(zip(columns, moved, strict=True)):
            change = innovations - e
            if np.abs(change).max(initial=0.0) < DIVERGED:
                change /= moves.steps[k]
                found[:, column] = change
                by_channel[k] = np.bincount(channel, change**2, by_channel.shape[1])
        return found

    def _moved_innovations(
        self, i: int, run: RunPass, p: np.ndarray, vectors: Sequence[np.ndarray]
    ) -> Iterator[np.ndarray]:
        """Innovations (readings,) with other parameters, gains frozen; not finite where it diverged."""
        there = np.isfinite(run.innovations)
        if not self.compiled.has_lanes:
            e = np.zeros(there.shape)
            for vector in vectors:
                yield e[there] if self._frozen(i, run, vector, e) else np.full(there.sum(), np.nan)
            return
        data = pass_data.RunData(self.intervals[i], run.inputs, run.record.z)
        gains = pass_data.Gains(run.gains, run.per_sigma, run.H, run.shown)
        for first in range(0, len(vectors), SIMD_WIDTH):
            some = vectors[first : first + SIMD_WIDTH]
            lanes = [*some, *[p] * (SIMD_WIDTH - len(some))]
            e = np.zeros((int(there.sum()), SIMD_WIDTH))
            frozen_gains.mean_passes(
                self.compiled, data, self.starts[i][0], p, np.array(lanes).T.copy(),
                np.array([self._inputs(run, p, vector) for vector in lanes]),
                gains, self._refresh[i], e,
            )  # fmt: skip
            yield from e.T[: len(some)]

    def descend(
        self,
        passes: Sequence[RunPass],
        free: Sequence[FreeParameter],
        values: Mapping[str, float],
        noise: Noise,
        moves: Mapping[str, float],
    ) -> tuple[dict[str, float], float]:
        """Move along a step, halved until the cost at frozen gains falls.

        Args:
            passes: of the filter at `values`, whose gains are used, and whose innovations are those of
                no move.
            free: parameters with their priors and bounds.
            values: of all parameters, by name.
            noise: levels of process and reading noise.
            moves: change of each parameter that moves.

        Returns:
            the new values and the gain, nats (0 and the old values where no shortening helped).
        """
        before = penalty(free, values) + _half_squares(passes)
        limits = {f.name: (f.lower, f.upper) for f in free}
        for damping in (1.0, 0.5, 0.25, 0.1, 0.03):
            trial = dict(values)
            for name, change in moves.items():
                lower, upper = limits.get(name, (-np.inf, np.inf))
                trial[name] = float(np.clip(values[name] + damping * change, lower, upper))
            gained = before - self.frozen_cost(passes, free, trial, noise)
            if gained > 0.0:
                return trial, gained
        return dict(values), 0.0

    def frozen_cost(
        self,
        passes: Sequence[RunPass],
        free: Sequence[FreeParameter],
        values: Mapping[str, float],
        noise: Noise,
    ) -> float:
        """Half the squared innovations at frozen gains, plus the priors' penalty, nats.

        Args:
            passes: of a filter, whose gains are used.
            free: parameters with their priors.
            values: of all parameters, by name.
            noise: levels of process and reading noise.
        """
        p = self.model.vector(values, noise)

        def one(i: int) -> float:
            run = passes[i]
            e = np.zeros(run.record.z.shape)
            return 0.5 * float(np.sum(e**2)) if self._frozen(i, run, p, e) else np.inf

        return sum(self._each(one)) + penalty(free, values)

    def _frozen(self, i: int, run: RunPass, p: np.ndarray, out: np.ndarray) -> bool:
        u = self.model.inputs(run.record, p)
        gains = pass_data.Gains(run.gains, run.per_sigma, run.H, run.shown)
        return frozen_gains.mean_pass(
            self.compiled, pass_data.RunData(self.intervals[i], u, run.record.z), self.starts[i][0], p,
            gains, self._refresh[i], out,
        )  # fmt: skip

    def fit(
        self,
        free: Sequence[FreeParameter],
        values: Mapping[str, float],
        noise: Noise,
        iterations: int = 6,
        tolerance: float = 0.1,
        progress: Progress | None = None,
    ) -> Estimate:
        """Gauss-Newton for the free parameters under their priors, damped and within bounds.

        Each step keeps the gains of its own linearisation, then filters anew (iteratively reweighted
        least squares). Stops when the predicted or the actual gain of a step is less than `tolerance`.
        A step that raises the cost at those gains is halved. The covariance is that of the last
        linearisation.

        Args:
            free: the parameters, with priors and bounds.
            values: of all parameters, by name: where to begin.
            noise: levels of process and reading noise.
            iterations: steps at most.
            tolerance: gain that ends the fit [nats].
            progress: called with a line of text.
        """
        values = dict(values)
        names = [f.name for f in free]
        passes, lin = self.linearise(values, noise, free, gains=False)
        converged = False
        count = 0
        for count in range(1, iterations + 1):
            change, step = Quadratic.of(lin, free, values).best(names)
            if -change < tolerance:
                converged = True
                break
            moves = dict(zip(names, step.tolist(), strict=True))
            if not passes[0].gains.size:
                passes = self.filter(values, noise, keep=True)
            values, gained = self.descend(passes, free, values, noise, moves)
            del passes  # gains of every row: gone before others are made
            if progress:
                progress(f"fit: step {count}, gained {gained:.1f} nats")
            if gained < tolerance or count == iterations:
                passes = self.filter(values, noise)
                self.remember(values, noise, passes)
                break
            passes, lin = self.linearise(values, noise, free)
        return Estimate(
            names=tuple(names),
            values={name: values[name] for name in names},
            covariance=Quadratic.of(lin, free, values).covariance(names),
            objective=objective(passes, free, values),
            log_likelihood=float(sum(p.log_likelihood for p in passes)),
            iterations=count,
            converged=converged,
        )

    def noise_score(self, values: Mapping[str, float], noise: Noise) -> NoiseScore:
        """Log-likelihood and its slopes in the variances of process and reading noise.

        Args:
            values: of the parameters, by name.
            noise: levels of process and reading noise.
        """
        p = self.model.vector(values, noise)
        for known in tuple(self._scored):
            if known.is_at(p, noise):
                return known.score
        blocks = [((r.t - r.t[0]) / BLOCK).astype(np.int64) for r in self.records]
        log_likelihood, slopes = self._slopes(p, noise, blocks)
        score = NoiseScore(
            float(sum(log_likelihood)),
            np.concatenate([s.in_noise for s in slopes]),
            np.concatenate([s.in_decay for s in slopes]),
            np.array([s.in_start for s in slopes]),
            np.concatenate([s.in_reading for s in slopes]),
            np.sum([s.noise_expected.sum(axis=0) for s in slopes], axis=0),
            np.array([s.start_expected for s in slopes]),
            np.sum([s.reading_expected for s in slopes], axis=0),
        )
        self._scored.append(_Scored(p, noise, score))
        return score

    def strength_slopes(
        self, values: Mapping[str, float], noise: Noise
    ) -> tuple[float, list[np.ndarray], list[np.ndarray]]:
        """Log-likelihood [nats], and its slopes in the logarithms of the records' `Strength`.

        Args:
            values: of the parameters, by name. noise: levels of process and reading noise.

        Returns:
            -inf where a filter diverged; by record (blocks, e) what the data show of the noise and what
            was expected, whose difference is the slope.
        """
        p = self.model.vector(values, noise)
        q, _ = self.model.process_noise(noise, p)
        log_likelihood, slopes = self._slopes(p, noise, [r.strength.block for r in self.records])
        expected = [q * s.noise_expected for s in slopes]
        shown = [q * (s.in_noise + s.noise_expected) for s in slopes]
        return float(sum(log_likelihood)), shown, expected

    def _slopes(
        self, p: np.ndarray, noise: Noise, blocks: Sequence[np.ndarray]
    ) -> tuple[list[float], list[Slopes]]:
        """Each record's log-likelihood and its slopes, by blocks (n,) of its rows."""
        q, decay = self.model.process_noise(noise, p)
        nx, m = self.starts[0][0].size, len(self.model.channels)
        decaying = np.flatnonzero(decay[:nx] > 0.0)

        def one(i: int) -> tuple[float, Slopes]:
            shape = (int(blocks[i].max()) + 1, q.size)
            slopes = Slopes(
                np.zeros(shape), np.zeros(shape), np.zeros(nx), np.zeros((shape[0], m)),
                np.zeros(shape), np.zeros(nx), np.zeros(m),
            )  # fmt: skip
            with self._borrowed_buffers() as buffers:
                run, at = self._filter_run(i, p, noise, buffers, buffers, decaying=decaying)
                if np.isfinite(run.log_likelihood):
                    noise_score.score_pass(
                        self.intervals[i], self.records[i].strength, _trace(run, at),
                        self.compiled.noise_places, q, decay, GATE, self._refresh[i], blocks[i],
                        slopes,
                    )  # fmt: skip
            return run.log_likelihood, slopes

        log_likelihood, slopes = zip(*self._each(one), strict=True)
        return list(log_likelihood), list(slopes)


def _without_gains(passes: Sequence[RunPass]) -> list[RunPass]:
    """Passes without what takes most of their memory."""
    return [
        replace(run, **{name: np.empty_like(getattr(run, name)[:0]) for name in OF_GAINS})
        for run in passes
    ]


def _half_squares(passes: Sequence[RunPass]) -> float:
    """Half the squared innovations; a pass that diverged has no gains, and counts nothing."""
    steady = [run for run in passes if np.isfinite(run.log_likelihood)]
    return 0.5 * float(sum(np.nansum(run.innovations**2) for run in steady))


def objective(
    passes: Sequence[RunPass], free: Sequence[FreeParameter], values: Mapping[str, float]
) -> float:
    """Minus log-likelihood plus half the squared distance to the priors, nats.

    Args:
        passes: of the filter at `values`.
        free: parameters with their priors.
        values: of all parameters, by name.
    """
    return penalty(free, values) - float(sum(p.log_likelihood for p in passes))


def _rows_between_jacobians(dt: np.ndarray) -> int:
    """Rows of a run, with these seconds between them, that new Jacobians serve."""
    usual = float(np.median(dt[:-1])) if dt.size > 1 else 0.0
    return max(REFRESH, round(REFRESH_SECONDS / usual)) if usual > 0.0 else REFRESH


def _block_edges(run: RunPass) -> tuple[np.ndarray, np.ndarray]:
    """First rows of blocks of BLOCK seconds, and the end (blocks + 1,); readings before each row."""
    t = run.record.t
    edges = np.searchsorted(t, np.arange(t[0] + BLOCK, t[-1], BLOCK))
    readings = np.isfinite(run.innovations).sum(1)
    return np.array([0, *edges, t.size]), np.append(0, np.cumsum(readings))
