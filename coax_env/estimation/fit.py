"""Fits on top of the passes: innovations, signatures, Gauss-Newton under priors, noise levels.

One engine, three uses: every parameter fixed is the simulation check, base parameters free is
identification, effects' parameters free is diagnosis.
"""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import lsq_linear, minimize

from coax_env.estimation import frozen_gains, kalman, noise_score
from coax_env.estimation.state_space import FreeParameter, Model, Noise, Record

GATE = 8.0  # sigmas
REFRESH = 4  # rows between new Jacobians
STRETCH = 2.0  # s
STEP_OF_LOG = 1e-3  # of a noise level, for the slopes of the model's variances
HUGE = 1e6  # whitened innovations that only a diverging mean has
Progress = Callable[[str], None]


@dataclass(frozen=True)
class RunPass:
    """What a filter pass leaves of one run.

    innovations: (n, m) whitened, NaN where there is no reading. states: (n, nx) filtered.
    gains: (readings, nx), per_sigma: (readings,), H: (n / REFRESH, m, nx), see kalman.py, empty unless
    kept. start_covariances: (s, nx, nx) of the filtered state at `start_rows`. deweighted: how many
    readings were beyond the gate.
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
    start_rows: np.ndarray
    start_covariances: np.ndarray


@dataclass(frozen=True)
class Along:
    """What a filter pass linearised the model at.

    F: (<= n, nx, nx) Jacobians of the step, F_of: (n,) which of them a row has. predicted: (n, nx)
    states before each row's readings.
    """

    F: np.ndarray
    F_of: np.ndarray
    predicted: np.ndarray


def _trace(run: RunPass, along: Along) -> kalman.Trace:
    gains = kalman.Gains(run.gains, run.per_sigma, run.H)
    path = kalman.Path(along.F, along.F_of, along.predicted)
    return kalman.Trace(run.states, run.innovations, gains, path)


@dataclass(frozen=True)
class Linearised:
    """Likelihood to second order about a point, per run.

    information: (runs, k, k) Gram matrices of the signatures. slope: (runs, k) signatures times
    innovations. by_channel: (runs, k, m) squared signatures summed per channel. stretches: (s, k) the
    slope again, by stretches of STRETCH seconds.
    """

    names: tuple[str, ...]
    information: np.ndarray
    slope: np.ndarray
    by_channel: np.ndarray
    stretches: np.ndarray


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


class _Room:
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
        self.compiled = kalman.CompiledModel.of(model)
        self.records = list(records)
        self.threads = threads or int(os.environ.get("COAX_THREADS", "2"))
        self.starts = [model.start(r) for r in self.records]
        self.intervals = [np.append(np.diff(r.t), 0.0) for r in self.records]
        self._readings = [int((~np.isnan(r.z)).sum()) for r in self.records]
        self._rooms: list[_Room] = []  # that no thread works in

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
    def _room(self) -> Iterator[_Room]:
        try:
            room = self._rooms.pop()
        except IndexError:
            room = _Room()
        try:
            yield room
        finally:
            self._rooms.append(room)

    def filter(
        self,
        values: Mapping[str, float],
        noise: Noise,
        keep: bool = False,
        which: Sequence[int] | None = None,
        start_rows: Sequence[np.ndarray] | None = None,
    ) -> list[RunPass]:
        """Filter every run (or those in `which`) with these parameter values and noise levels.

        start_rows: per record, rows at which to keep the filtered covariance.
        """
        p = self.model.vector(values)
        q = self.model.process_noise(noise)
        R = self._reading_variances(noise)

        def one(i: int) -> RunPass:
            starts = None if start_rows is None else start_rows[i]
            room = _Room() if keep else None
            return self._filter_run(i, p, q, R, noise, room, start_rows=starts)[0]

        return self._each(one, which)

    def _reading_variances(self, noise: Noise) -> np.ndarray:
        return np.array([noise.reading.get(c, 1.0) for c in self.model.channels]) ** 2

    def _filter_run(
        self,
        i: int,
        p: np.ndarray,
        q: np.ndarray,
        R: np.ndarray,
        noise: Noise,
        keep: _Room | None,
        along: _Room | None = None,
        start_rows: np.ndarray | None = None,
    ) -> tuple[RunPass, Along]:
        """The filter pass of a run, and what it went along.

        keep: room for what a mean pass needs, along: room for the rest; empty without one.
        """
        record = self.records[i]
        n, m = record.z.shape
        nx = q.size
        u = self.model.inputs(record, p)
        x0, P0 = self.starts[i]
        P0 = P0 + np.diag(self.model.start_noise(noise))
        e = np.full((n, m), np.nan)
        states = np.zeros((n, nx))
        count, rows, room = (0, 0, _Room()) if keep is None else (self._readings[i], n, keep)
        K = room.array("K", (count, nx), np.float32)
        per_sigma = room.array("per_sigma", (count,))
        H = room.array("H", (math.ceil(rows / REFRESH), m, nx), np.float32)
        rows, room = (0, _Room()) if along is None else (n, along)
        F = room.array("F", (rows, nx, nx), np.float32)
        F_of = room.array("F_of", (rows,), np.int64)
        predicted = room.array("predicted", (rows, nx))
        starts = np.empty(0, np.int64) if start_rows is None else start_rows
        slots = np.full(n, -1, np.int64)
        slots[starts] = np.arange(starts.size)
        P = np.zeros((starts.size, nx, nx))
        gains, path = kalman.Gains(K, per_sigma, H), kalman.Path(F, F_of, predicted)
        log_likelihood, deweighted = kalman.filter_pass(
            self.compiled, kalman.RunData(self.intervals[i], u, record.z),
            kalman.Variances(x0, P0, R, q), p, GATE, REFRESH,
            kalman.Trace(states, e, gains, path), kalman.Covariances(P, slots),
        )  # fmt: skip
        if not np.isfinite(log_likelihood):
            K[:], per_sigma[:], H[:] = 0.0, 0.0, 0.0
        run = RunPass(record, u, log_likelihood, e, states, deweighted, K, per_sigma, H, starts, P)
        return run, Along(F, F_of, predicted)

    def log_likelihood(
        self, values: Mapping[str, float], noise: Noise, which: Sequence[int] | None = None
    ) -> float:
        """Log-likelihood of the records, nats; -inf where a filter diverged."""
        return float(sum(p.log_likelihood for p in self.filter(values, noise, which=which)))

    def linearise(
        self, values: Mapping[str, float], noise: Noise, free: Sequence[FreeParameter]
    ) -> tuple[list[RunPass], Linearised]:
        """Filter, then the derivatives of the innovations in every free parameter, gains frozen.

        A parameter without a slope at its off-value (`probe`) is moved that far in a mean pass of its
        own.
        """
        p, q = self.model.vector(values), self.model.process_noise(noise)
        R = self._reading_variances(noise)
        far = np.array([f.probe > 0.0 and values[f.name] < 0.25 * f.probe for f in free], bool)
        steps = np.array([f.probe if far[k] else 0.02 * f.std for k, f in enumerate(free)])
        over = np.array([values[f.name] + steps[k] > f.upper for k, f in enumerate(free)], bool)
        steps[over] *= -1.0
        reading_only = np.array([f.reading_only for f in free], bool)
        moved = [
            self.model.vector({**values, f.name: values[f.name] + step})
            for f, step in zip(free, steps, strict=True)
        ]

        def one(i: int) -> tuple[Any, ...]:
            with self._room() as room:
                run, along = self._filter_run(i, p, q, R, noise, _Room(), room)
                there = np.isfinite(run.innovations)
                e = run.innovations[there]
                J = room.array("J", (e.size, len(free)))
                by_channel = np.zeros((len(free), there.shape[1]))
                near = np.flatnonzero(~far)
                if np.isfinite(run.log_likelihood):
                    self._signatures(
                        i, run, along, p, [moved[k] for k in near], steps[near],
                        reading_only[near], near, J, by_channel,
                    )  # fmt: skip
                else:
                    J[:] = 0.0
                probed = np.zeros(there.shape)
                for k in np.flatnonzero(far):
                    J[:, k] = 0.0
                    if self._frozen(i, run, moved[k], probed):
                        change = np.where(there, probed - run.innovations, 0.0)
                        if np.abs(change).max(initial=0.0) < HUGE:
                            J[:, k] = change[there] / steps[k]
                            by_channel[k] = np.square(change / steps[k]).sum(0)
                information = J.T @ J
                wild = ~np.isfinite(np.diag(information))
                if wild.any():
                    J[:, wild] = 0.0
                    information[wild] = information[:, wild] = 0.0
                    by_channel[wild] = 0.0
                row = np.nonzero(there)[0]
                t = run.record.t
                edges = np.searchsorted(t, np.arange(t[0] + STRETCH, t[-1], STRETCH))
                parts = np.split(np.arange(e.size), np.searchsorted(row, edges))
                stretches = np.array([e[part] @ J[part] for part in parts])
            return run, information, stretches.sum(0), by_channel, stretches

        passes, *parts, stretches = zip(*self._each(one), strict=True)
        information, slope, by_channel = (np.array(part) for part in parts)
        return list(passes), Linearised(
            tuple(f.name for f in free), information, slope, by_channel, np.concatenate(stretches)
        )

    def _signatures(
        self,
        i: int,
        run: RunPass,
        along: Along,
        p: np.ndarray,
        moved: Sequence[np.ndarray],
        steps: np.ndarray,
        reading_only: np.ndarray,
        columns: np.ndarray,
        J: np.ndarray,
        by_channel: np.ndarray,
    ) -> None:
        """Derivatives of a run's whitened innovations in the parameters moved, into columns of J.

        And their squares, summed by channel, into rows of `by_channel`.
        """
        if not moved:
            return
        sets, which = [run.inputs], np.zeros(len(moved), np.int64)
        for k, vector in enumerate(moved):
            inputs = self.model.inputs(run.record, vector)
            if not np.array_equal(inputs, run.inputs):
                which[k] = len(sets)
                sets.append(inputs)
        moves = frozen_gains.Moves(
            np.array(moved), steps, reading_only, np.array(sets), which, columns
        )  # fmt: skip
        frozen_gains.signature_pass(
            self.compiled, self.intervals[i], _trace(run, along), p, moves, REFRESH, J, by_channel
        )

    def descend(
        self,
        passes: Sequence[RunPass],
        free: Sequence[FreeParameter],
        values: Mapping[str, float],
        noise: Noise,
        moves: Mapping[str, float],
    ) -> tuple[dict[str, float], float]:
        """Move along a step, halved until the cost at frozen gains falls.

        Returns the new values and the gain, nats (0 and the old values where no shortening helped).
        """
        before = self.frozen_cost(passes, free, values, noise)
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
        """Half the squared innovations at frozen gains, plus the priors' penalty, nats."""
        p = self.model.vector(values)

        def one(i: int) -> float:
            run = passes[i]
            e = np.zeros(run.record.z.shape)
            return 0.5 * float(np.sum(e**2)) if self._frozen(i, run, p, e) else np.inf

        return sum(self._each(one)) + penalty(free, values)

    def _frozen(self, i: int, run: RunPass, p: np.ndarray, out: np.ndarray) -> bool:
        u, gains = self.model.inputs(run.record, p), kalman.Gains(run.gains, run.per_sigma, run.H)
        return frozen_gains.mean_pass(
            self.compiled, kalman.RunData(self.intervals[i], u, run.record.z), self.starts[i][0], p,
            gains, REFRESH, out,
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
        least squares). Stops when a step promises or gains less than `tolerance` nats. A step that
        raises the cost at those gains is halved. The covariance is that of the last linearisation.
        """
        values = dict(values)
        passes, lin = self.linearise(values, noise, free)
        converged = False
        count = 0
        for count in range(1, iterations + 1):
            step, promised = newton_step(lin, free, values)
            if promised < tolerance:
                converged = True
                break
            moves = {f.name: float(change) for f, change in zip(free, step, strict=True)}
            values, gained = self.descend(passes, free, values, noise, moves)
            if progress:
                progress(f"fit: step {count}, gained {gained:.1f} nats")
            if gained < tolerance or count == iterations:
                passes = self.filter(values, noise)
                break
            passes, lin = self.linearise(values, noise, free)
        best = objective(passes, free, values)
        information = lin.information.sum(0) + np.diag([1.0 / f.std**2 for f in free])
        return Estimate(
            names=tuple(f.name for f in free),
            values={f.name: values[f.name] for f in free},
            covariance=np.linalg.inv(information),
            objective=best,
            log_likelihood=float(sum(p.log_likelihood for p in passes)),
            iterations=count,
            converged=converged,
        )

    def noise_score(
        self, values: Mapping[str, float], noise: Noise
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Log-likelihood and its slopes in the process noise.

        Returns nats (-inf where a filter diverged), the slope in each state's growth of variance per
        second, by stretches of STRETCH seconds (stretches, nx), and by record in each variance of the
        first state, (records, nx).
        """
        p = self.model.vector(values)
        q = self.model.process_noise(noise)
        R = self._reading_variances(noise)

        def one(i: int) -> tuple[float, np.ndarray, np.ndarray]:
            t = self.records[i].t
            stretch = ((t - t[0]) / STRETCH).astype(np.int64)
            by_noise, by_start = np.zeros((stretch[-1] + 1, q.size)), np.zeros(q.size)
            with self._room() as room:
                run, along = self._filter_run(i, p, q, R, noise, room, room)
                if np.isfinite(run.log_likelihood):
                    noise_score.score_pass(
                        self.intervals[i], _trace(run, along), REFRESH, stretch, by_noise, by_start
                    )
            return run.log_likelihood, by_noise, by_start

        log_likelihood, by_noise, by_start = zip(*self._each(one), strict=True)
        return float(sum(log_likelihood)), np.concatenate(by_noise), np.array(by_start)

    def fit_noise(
        self,
        values: Mapping[str, float],
        noise: Noise,
        process: Sequence[str],
        evaluations: int = 16,
        tolerance: float = 0.5,
        seconds: float = np.inf,
        progress: Progress | None = None,
    ) -> Noise:
        """Process-noise levels of largest likelihood, or the best seen in so many evaluations.

        Quasi-Newton in log levels, scaled by the scatter of their slopes from stretch to stretch.
        Nothing is done where that scatter promises less than `tolerance` nats.

        Args:
            process: names of the process-noise levels to fit.
            seconds: of flight that are enough to look at: whole runs, evenly picked.
        """
        picked = Engine(self.model, _some(self.records, seconds), self.threads)

        def changed(logs: np.ndarray) -> Noise:
            levels = dict(noise.process)
            for name, log in zip(process, logs, strict=True):
                levels[name] = float(np.exp(log))
            return replace(noise, process=levels)

        def variances(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            here = changed(logs)
            return self.model.process_noise(here), self.model.start_noise(here)

        def slopes(logs: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
            """Log-likelihood, its slope in each log level, and the scatter of that."""
            log_likelihood, by_noise, by_start = picked.noise_score(values, changed(logs))
            slope, scatter = np.empty(logs.size), np.empty(logs.size)
            for i, unit in enumerate(STEP_OF_LOG * np.eye(logs.size)):
                (q, start), (q_less, start_less) = variances(logs + unit), variances(logs - unit)
                parts = by_noise @ (q - q_less) / (2.0 * STEP_OF_LOG)
                first = float(np.sum(by_start * (start - start_less))) / (2.0 * STEP_OF_LOG)
                slope[i] = parts.sum() + first
                scatter[i] = np.sqrt(parts.size) * parts.std()
            return log_likelihood, slope, scatter

        start = np.array([np.log(noise.process[name]) for name in process])
        lower = np.log([noise.floor.get(name, 1e-9) for name in process])
        upper = lower + np.log(1e4)
        first, slope, scatter = slopes(start)
        scale = np.maximum(scatter, 1.0)
        held = ((start <= lower) & (slope < 0.0)) | ((start >= upper) & (slope > 0.0))
        if 0.5 * np.sum((slope / scale)[~held] ** 2) < tolerance:
            return noise
        seen = {tuple(start * scale): (first, slope)}

        def cost(scaled: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = seen.get(tuple(scaled)) or slopes(scaled / scale)[:2]
            if not np.isfinite(value):
                return 1e12, np.zeros(scaled.size)
            seen[tuple(scaled)] = (value, slope)
            return -value, -slope / scale

        found = minimize(
            cost, start * scale, jac=True, method="L-BFGS-B",
            bounds=list(zip(lower * scale, upper * scale, strict=True)),
            options={"maxfun": evaluations, "ftol": 0.5 * tolerance / max(abs(first), 1.0)},
        )  # fmt: skip
        if progress:
            progress(f"noise levels: {found.nfev} evaluations")
        return changed(np.array(max(seen, key=lambda scaled: seen[scaled][0])) / scale)


def _some(records: Sequence[Record], seconds: float) -> list[Record]:
    """Records of so many seconds in all, or just more, evenly picked."""
    whole = sum(r.t[-1] - r.t[0] for r in records)
    count = math.ceil(min(1.0, seconds / whole) * len(records))
    return [records[i] for i in np.linspace(0, len(records) - 1, count).round().astype(int)]


def part(record: Record, rows: np.ndarray) -> Record:
    """Some rows of a record, its clock kept."""
    return replace(
        record,
        t=record.t[rows],
        command=record.command[rows],
        z=record.z[rows],
        news=None if record.news is None else record.news[rows],
    )


def objective(
    passes: Sequence[RunPass], free: Sequence[FreeParameter], values: Mapping[str, float]
) -> float:
    """Minus log-likelihood plus half the squared distance to the priors, nats."""
    return penalty(free, values) - float(sum(p.log_likelihood for p in passes))


def penalty(free: Sequence[FreeParameter], values: Mapping[str, float]) -> float:
    """Half the squared distance to the priors, nats."""
    return 0.5 * sum(((values[f.name] - f.value) / f.std) ** 2 for f in free)


def newton_step(
    lin: Linearised, free: Sequence[FreeParameter], values: Mapping[str, float]
) -> tuple[np.ndarray, float]:
    """Gauss-Newton step within bounds, and the gain in nats it promises."""
    prior = np.array([1.0 / f.std**2 for f in free])
    away = np.array([values[f.name] - f.value for f in free])
    A = lin.information.sum(0) + np.diag(prior)
    g = lin.slope.sum(0) + prior * away
    now = np.array([values[f.name] for f in free])
    lower = np.array([f.lower for f in free]) - now
    upper = np.array([f.upper for f in free]) - now
    step = bounded_solve(A, -g, lower, upper)
    return step, float(-(g @ step) - 0.5 * step @ A @ step)


def bounded_solve(A: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Minimise 1/2 x'A x - b'x within bounds (A positive definite), shape (k,).

    Bounded least squares on the Cholesky factor, in units of A's diagonal (Stark and Parker 1995).
    """
    unit = 1.0 / np.sqrt(np.diag(A))
    factor = cholesky(A * np.outer(unit, unit))
    target = solve_triangular(factor, b * unit, trans="T")
    x = solve_triangular(factor, target) * unit
    if np.any(x < lower) or np.any(x > upper):
        bounds = (np.minimum(lower, 0.0) / unit, np.maximum(upper, 0.0) / unit)
        x = lsq_linear(factor, target, bounds, method="bvls", tol=1e-12).x * unit
    return np.clip(x, lower, upper)
