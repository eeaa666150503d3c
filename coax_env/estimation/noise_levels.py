"""Noise levels of largest likelihood, those of process and readings together."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from coax_env.estimation.engine import Engine, NoiseScore
from coax_env.estimation.state_space import Noise, Record
from coax_env.progress import Progress

STEP_OF_LOG = 1e-3  # of a noise level, for the slopes of the model's variances
ASKS_FROM = 0.05  # nats that a level's own step must promise for it to be moved; ours
FAR = 0.4  # of a level's logarithm: from here on a quadratic is good enough; ours
LONGEST_MOVE = 3.0  # of a level's logarithm at once; ours


def fit_noise(
    engine: Engine,
    values: Mapping[str, float],
    noise: Noise,
    levels: Sequence[str],
    evaluations: int = 16,
    tolerance: float = 0.5,
    seconds: float = np.inf,
    progress: Progress | None = None,
) -> Noise:
    """Noise levels of largest posterior, or the best seen in so many evaluations.

    From afar by minorisation-maximisation, then quasi-Newton in log levels, scaled by the scatter of
    their slopes from block to block. Nothing is done where that scatter predicts a gain of less than
    `tolerance` nats; a level that asks for nothing stays.

    Args:
        engine: model and records.
        values: of the parameters, held.
        noise: levels to start from, their bounds and priors.
        levels: names of the levels to fit, those of channels for their readings.
        evaluations: of the likelihood, at most.
        tolerance: gain that ends the fit [nats].
        seconds: of flight that are enough: whole runs, evenly picked.
        progress: called with a line of text.
    """
    some = evenly_picked(engine.records, seconds)
    whole = len(some) == len(engine.records)
    picked = engine if whole else Engine(engine.model, some, engine.threads)
    first = _Point.at(picked, values, noise, levels)
    gains = first.predicted_gains()
    if gains.sum() < tolerance:
        return noise
    here = first.only(np.flatnonzero(gains > ASKS_FROM))
    here, left = _from_afar(picked, values, here, evaluations)
    if left > 0 and here.predicted_gains().sum() >= tolerance:
        here = _quasi_newton(picked, values, here, left, tolerance)
    if progress:
        progress(f"noise levels: {here.value - first.value:.1f} nats")
    return here.noise


@dataclass(frozen=True)
class _Point:
    """Levels and the log-posterior there.

    logs: (k,) of the levels named, lower and upper their bounds. value: nats. slope: (k,). scale: (k,)
    std by which the slopes scatter. ratio: (k,) what the data show of a level's variance over what is
    expected of it; 1 where it is no variance.
    """

    names: tuple[str, ...]
    noise: Noise
    logs: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    value: float
    slope: np.ndarray
    scale: np.ndarray
    ratio: np.ndarray

    @classmethod
    def at(
        cls, engine: Engine, values: Mapping[str, float], noise: Noise, names: Sequence[str]
    ) -> "_Point":
        """Evaluated: one filter pass and one back."""
        score = engine.noise_score(values, noise)
        slope, information, ratio = np.empty((3, len(names)))
        for i, name in enumerate(names):
            parts, expected = level_slopes(engine, values, noise, name, score)
            slope[i], information[i] = parts.sum(), parts.size * parts.var()
            ratio[i] = 1.0 + slope[i] / expected if expected > 0.0 else 1.0
        log_prior, pull, known = _log_prior(noise, names)
        return cls(
            tuple(names), noise, *_logs(noise, names), score.log_likelihood + log_prior,
            slope + pull, np.sqrt(np.maximum(information + known, 1.0)), ratio,
        )  # fmt: skip

    def predicted_gains(self) -> np.ndarray:
        """Nats that each level's own step promises; none at a bound that it wants to cross."""
        beyond = (self.logs <= self.lower) & (self.slope < 0.0)
        beyond |= (self.logs >= self.upper) & (self.slope > 0.0)
        return np.where(beyond, 0.0, 0.5 * (self.slope / self.scale) ** 2)

    def only(self, which: np.ndarray) -> "_Point":
        """With some of the levels, the others held."""
        arrays = {
            name: getattr(self, name)[which]
            for name in ("logs", "lower", "upper", "slope", "scale", "ratio")
        }
        return replace(self, names=tuple(self.names[int(i)] for i in which), **arrays)

    def moved(self, engine: Engine, values: Mapping[str, float], logs: np.ndarray) -> "_Point":
        """Evaluated at other levels."""
        logs = np.clip(logs, self.lower, self.upper)
        levels = dict(zip(self.names, np.exp(logs).tolist(), strict=True))
        return _Point.at(engine, values, self.noise.with_levels(levels), self.names)


def _from_afar(
    engine: Engine, values: Mapping[str, float], here: _Point, evaluations: int
) -> tuple[_Point, int]:
    """Levels of variances by their fixed point, while it asks for much more or less of one.

    A variance times what is shown of it over what is expected: the step of EM and its kin, which goes
    up from anywhere (Zhou, Hu, Zhou and Lange 2019, J. Comput. Graph. Stat. 28), where a quadratic
    does not reach.

    Returns:
        the last point that was better, and the evaluations that are left.
    """
    while evaluations > 0:
        move = 0.5 * np.log(np.maximum(here.ratio, 1e-6))
        move = np.clip(move, -LONGEST_MOVE, LONGEST_MOVE)
        target = np.clip(here.logs + move, here.lower, here.upper)
        if np.abs(target - here.logs).max(initial=0.0) < FAR:
            break
        there = here.moved(engine, values, target)
        evaluations -= 1
        if not there.value > here.value:
            break
        here = there
    return here, evaluations


def _quasi_newton(
    engine: Engine, values: Mapping[str, float], here: _Point, evaluations: int, tolerance: float
) -> _Point:
    """L-BFGS-B from a point, the best that it saw."""
    scale = here.scale
    seen = {tuple(here.logs * scale): here}

    def cost(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        point = seen.get(tuple(scaled)) or here.moved(engine, values, scaled / scale)
        if not np.isfinite(point.value):
            return 1e12, np.zeros(scaled.size)
        seen[tuple(scaled)] = point
        return -point.value, -point.slope / scale

    minimize(
        cost, here.logs * scale, jac=True, method="L-BFGS-B",
        bounds=list(zip(here.lower * scale, here.upper * scale, strict=True)),
        options={"maxfun": evaluations, "ftol": 0.5 * tolerance / max(abs(here.value), 1.0)},
    )  # fmt: skip
    return max(seen.values(), key=lambda point: point.value)


def level_slopes(
    engine: Engine, values: Mapping[str, float], noise: Noise, name: str, score: NoiseScore
) -> tuple[np.ndarray, float]:
    """Slope of the log-likelihood in the logarithm of one level.

    That in the variances of the first states is spread over the blocks.

    Args:
        engine: whose model says what a level does.
        values, noise: where. name: of the level.
        score: the engine's, there.

    Returns:
        by blocks of time, (blocks,), and what was expected of the variance: the slope is what is shown
        less that; 0 where the level is no variance.
    """
    model = engine.model
    if name not in noise.process:
        column = model.channels.index(name)
        twice = 2.0 * noise.level(name) ** 2
        return twice * score.in_reading[:, column], twice * float(score.reading_expected[column])
    sides = []
    for sign in (1.0, -1.0):
        there = noise.with_levels({name: noise.level(name) * math.exp(sign * STEP_OF_LOG)})
        vector = model.vector(values, there)
        sides.append((*model.process_noise(there, vector), model.start_noise(there)))
    q, decay, start = ((a - b) / (2.0 * STEP_OF_LOG) for a, b in zip(*sides, strict=True))
    parts = score.in_noise @ q + score.in_decay @ decay
    parts = parts + float(np.sum(score.in_start @ start)) / parts.size
    if decay.any():
        return parts, 0.0
    return parts, float(score.noise_expected @ q + np.sum(score.start_expected @ start))


def _log_prior(noise: Noise, levels: Sequence[str]) -> tuple[float, np.ndarray, np.ndarray]:
    """Log-prior of some levels, its slopes in their logarithms, and its information."""
    known = [noise.prior.get(name, (1.0, np.inf)) for name in levels]
    std = np.array([spread for _, spread in known])
    medians = np.array([median for median, _ in known])
    away = np.log([noise.level(name) for name in levels]) - np.log(medians)
    return -0.5 * float(np.sum((away / std) ** 2)), -away / std**2, 1.0 / std**2


def _logs(noise: Noise, levels: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Logarithms of levels, of the least and of the most that each can be."""
    start = np.log([noise.level(name) for name in levels])
    lower = np.log([noise.floor.get(name, 1e-9) for name in levels])
    upper = np.log([noise.ceiling.get(name, 1e9) for name in levels])
    return start, lower, upper


def evenly_picked(records: Sequence[Record], seconds: float) -> list[Record]:
    """Records of so many seconds in all, or just more, evenly picked."""
    whole = sum(r.t[-1] - r.t[0] for r in records)
    count = math.ceil(min(1.0, seconds / whole) * len(records))
    return [records[i] for i in np.linspace(0, len(records) - 1, count).round().astype(int)]
