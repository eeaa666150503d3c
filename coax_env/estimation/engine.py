"""Filter passes over records, and fits on top of them: signatures, Gauss-Newton under priors.

One engine, three uses: every parameter fixed is the simulation check, base parameters free is
identification, effects' parameters free is diagnosis.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.estimation import frozen_gains, noise_score
from coax_env.estimation.beginnings import Asked, Beginning
from coax_env.estimation.freed_memory import return_freed_memory
from coax_env.estimation.linearised_runs import (
    BLOCKS_AT_ONCE,
    LinearisedRun,
    ParameterMoves,
    beginnings_of_run,
    blocks_of,
    linearise_run,
    moves_of,
)
from coax_env.estimation.noise_score import Slopes, in_common
from coax_env.estimation.quadratic import Linearised, Quadratic, penalty
from coax_env.estimation.run_passes import GATE, Buffers, RunPass, RunPasses, trace_of
from coax_env.estimation.sparse import padded
from coax_env.estimation.state_space import FreeParameter, Model, Noise, Record
from coax_env.progress import Progress

OF_GAINS = ("gains", "per_sigma", "H")  # what takes most of a pass' memory
MANY_ROWS = 50_000
"""Rows, 500 s at 100 Hz, from which on what was freed goes back before a linearisation; ours."""
REMEMBERED = 4
"""Points at which something was linearised, a fit ended, or the noise was scored; ours."""


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
class ByReading:
    """A run by its readings. innovations: (n, m) whitened; nats: (n, m) log-likelihood, but for a
    constant. Both are NaN where there is no reading; nats are 0 where the filter diverged."""

    innovations: np.ndarray
    nats: np.ndarray


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


class Engine(RunPasses):
    """A model and its records: what is asked of all of them at once, and remembered at a few points."""

    def __init__(self, model: Model, records: Sequence[Record], threads: int | None = None) -> None:
        super().__init__(model, records, threads)
        self._flown: deque[_Flown] = deque(maxlen=REMEMBERED)
        self._scored: deque[_Scored] = deque(maxlen=REMEMBERED)

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
            buffers = Buffers() if keep else None
            return self.filter_run(i, *self.of_run(i, values, noise, p), buffers, start_rows=starts)[0]

        return self.each(one, which)

    def remember(
        self, values: Mapping[str, float], noise: Noise, passes: Sequence[RunPass]
    ) -> None:
        """Passes of all records, to be returned where `filter` is asked for them again.

        Args:
            values, noise: at which the passes were flown. passes: of every record.
        """
        self._flown.append(_Flown(self.model.vector(values, noise), noise, _without_gains(passes)))

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

    def by_reading(self, values: Mapping[str, float], noise: Noise) -> list[ByReading]:
        """Innovation and log-likelihood of each reading, per run.

        A row's readings are taken one by one in the order of the channels: each is judged by what was
        known before it.

        Args:
            values: of the parameters, by name. noise: levels of process and reading noise.
        """
        p = self.model.vector(values, noise)

        def one(i: int) -> ByReading:
            with self.borrowed_buffers() as buffers:
                run, _ = self.filter_run(i, *self.of_run(i, values, noise, p), buffers)
                nats = -0.5 * run.innovations**2
                if not np.isfinite(run.log_likelihood):
                    return ByReading(run.innovations, np.zeros(nats.shape))
                nats[np.isfinite(nats)] += np.log(run.per_sigma)
                return ByReading(run.innovations, nats)

        return self.each(one)

    def likelihood_by_channel(self, values: Mapping[str, float], noise: Noise) -> np.ndarray:
        """Log-likelihood of each channel's readings, (m,) [nats], but for a constant.

        Without those of a run whose filter diverged.

        Args:
            values: of the parameters, by name. noise: levels of process and reading noise.
        """
        of_runs = [np.nansum(run.nats, axis=0) for run in self.by_reading(values, noise)]
        return np.asarray(np.sum(of_runs, axis=0))

    def of_run(
        self, i: int, values: Mapping[str, float], noise: Noise, p: np.ndarray
    ) -> tuple[np.ndarray, Noise]:
        """Parameter vector and noise of a run, in the air that it has of its own.

        Args:
            i: index of the run. values: of the parameters, by name. noise: of all runs.
            p: vector of these.
        """
        own = noise.times(self.records[i].air)
        return (p, noise) if own is noise else (self.model.vector(values, own), own)

    def _moved_of_run(
        self,
        i: int,
        values: Mapping[str, float],
        noise: Noise,
        p: np.ndarray,
        free: Sequence[FreeParameter],
        moves: ParameterMoves,
    ) -> tuple[np.ndarray, Noise, ParameterMoves]:
        """`of_run`, and `moves_of` what is differentiated in there; `moves`: of all runs."""
        own_p, own = self.of_run(i, values, noise, p)
        return own_p, own, moves if own is noise else moves_of(self.model, values, own, free)

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
        moves = moves_of(self.model, values, noise, free)
        if sum(record.t.size for record in self.records) > MANY_ROWS:
            return_freed_memory()

        def one(i: int) -> LinearisedRun:
            there = self._moved_of_run(i, values, noise, p, free, moves)
            with self.borrowed_buffers() as buffers:
                return linearise_run(self, i, *there, buffers, BLOCKS_AT_ONCE)

        return self._gathered(p, noise, free, self.each(one))

    def _gathered(
        self,
        p: np.ndarray,
        noise: Noise,
        free: Sequence[FreeParameter],
        found: Sequence[LinearisedRun],
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
        moves = moves_of(self.model, values, noise, free)

        def one(i: int) -> tuple[LinearisedRun, list[Beginning]]:
            n, nx = self.records[i].t.size, self.compiled.exact.size
            s = np.zeros((rows[i].size, nx, padded(len(free) + 1)), np.float32)
            kept = frozen_gains.Kept(s, np.full(n, -1, np.int64))
            kept.places[rows[i]] = np.arange(rows[i].size)
            there = self._moved_of_run(i, values, noise, p, free, moves)
            with self.borrowed_buffers() as buffers:
                found = linearise_run(self, i, *there, buffers, n, kept)
                begun = beginnings_of_run(self, i, found, rows[i], kept, asked)
            return replace(found, J=found.J[:0].copy()), begun

        found, begun = zip(*self.each(one), strict=True)
        return *self._gathered(p, noise, free, found), list(begun)

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
            own, _ = self.of_run(i, values, noise, p)
            return 0.5 * float(np.sum(e**2)) if self.frozen(i, run, own, e) else np.inf

        return sum(self.each(one)) + penalty(free, values)

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
        blocks = [blocks_of(r.t) for r in self.records]
        log_likelihood, slopes = self._slopes(values, noise, blocks)
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
        log_likelihood, slopes = self._slopes(values, noise, [r.strength.block for r in self.records])
        expected = [q * s.noise_expected for s in slopes]
        shown = [q * (s.in_noise + s.noise_expected) for s in slopes]
        return float(sum(log_likelihood)), shown, expected

    def _slopes(
        self, values: Mapping[str, float], noise: Noise, blocks: Sequence[np.ndarray]
    ) -> tuple[list[float], list[Slopes]]:
        """Each record's log-likelihood and its slopes, by blocks (n,) of its rows.

        Slopes are in the noise of all runs; that of a run in air of its own is a multiple of it.
        """
        p = self.model.vector(values, noise)
        q, decay = self.model.process_noise(noise, p)
        nx, m = self.starts[0][0].size, len(self.model.channels)
        decaying = np.flatnonzero(decay[:nx] > 0.0)

        def one(i: int) -> tuple[float, Slopes]:
            shape = (int(blocks[i].max()) + 1, q.size)
            slopes = Slopes(
                np.zeros(shape), np.zeros(shape), np.zeros(nx), np.zeros((shape[0], m)),
                np.zeros(shape), np.zeros(nx), np.zeros(m),
            )  # fmt: skip
            p_own, own = self.of_run(i, values, noise, p)
            drives, fades = (q, decay) if own is noise else self.model.process_noise(own, p_own)
            with self.borrowed_buffers() as buffers:
                run, path = self.filter_run(i, p_own, own, buffers, buffers, decaying=decaying)
                if np.isfinite(run.log_likelihood):
                    noise_score.score_pass(
                        self.intervals[i], self.records[i].strength, trace_of(run, path),
                        self.compiled.noise_places, drives, fades, GATE, self.refresh[i], blocks[i],
                        slopes,
                    )  # fmt: skip
            if own is not noise:
                begun, begins = self.model.start_noise(noise), self.model.start_noise(own)
                slopes = in_common(slopes, _over(drives, q), _over(fades, decay), _over(begins, begun))
            return run.log_likelihood, slopes

        log_likelihood, slopes = zip(*self.each(one), strict=True)
        return list(log_likelihood), list(slopes)


def _without_gains(passes: Sequence[RunPass]) -> list[RunPass]:
    """Passes without what takes most of their memory."""
    return [
        replace(run, **{name: np.empty_like(getattr(run, name)[:0]) for name in OF_GAINS})
        for run in passes
    ]


def _over(own: np.ndarray, common: np.ndarray) -> np.ndarray:
    """How many times a run's own each number of all runs is; 1 where that is none."""
    return np.divide(own, common, out=np.ones_like(own), where=common != 0.0)


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
