"""Noise levels of largest likelihood, those of process and readings together."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import minimize

from coax_env.estimation.engine import Engine, NoiseScore, Progress
from coax_env.estimation.state_space import Noise, Record

STEP_OF_LOG = 1e-3  # of a noise level, for the slopes of the model's variances
ASKS_FROM = 0.05  # nats that a level's own step must promise for it to be moved; ours


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

    Quasi-Newton in log levels, scaled by the scatter of their slopes from block to block. Nothing is
    done where that scatter predicts a gain of less than `tolerance` nats; a level that asks for
    nothing stays.

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
    picked = Engine(engine.model, _some(engine.records, seconds), engine.threads)
    score = picked.noise_score(values, noise)
    slope, scale = slopes(engine, values, noise, levels, score)
    start, lower, upper = _logs(noise, levels)
    held = ((start <= lower) & (slope < 0.0)) | ((start >= upper) & (slope > 0.0))
    gains = np.where(held, 0.0, 0.5 * (slope / scale) ** 2)
    if gains.sum() < tolerance:
        return noise
    asking = np.flatnonzero(gains > ASKS_FROM)
    names = [levels[int(i)] for i in asking]
    scale, lower, upper = scale[asking], lower[asking], upper[asking]

    def changed(logs: np.ndarray) -> Noise:
        return noise.with_levels(dict(zip(names, np.exp(logs).tolist(), strict=True)))

    first = score.log_likelihood + _log_prior(noise, names)[0]
    seen = {tuple(start[asking] * scale): (first, slope[asking])}

    def cost(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        known = seen.get(tuple(scaled))
        if known is None:
            here = changed(scaled / scale)
            there = picked.noise_score(values, here)
            value = there.log_likelihood + _log_prior(here, names)[0]
            if not np.isfinite(value):
                return 1e12, np.zeros(scaled.size)
            known = value, slopes(engine, values, here, names, there)[0]
            seen[tuple(scaled)] = known
        return -known[0], -known[1] / scale

    found = minimize(
        cost, start[asking] * scale, jac=True, method="L-BFGS-B",
        bounds=list(zip(lower * scale, upper * scale, strict=True)),
        options={"maxfun": evaluations, "ftol": 0.5 * tolerance / max(abs(first), 1.0)},
    )  # fmt: skip
    if progress:
        progress(f"noise levels: {found.nfev} evaluations")
    return changed(np.array(max(seen, key=lambda scaled: seen[scaled][0])) / scale)


def slopes(
    engine: Engine,
    values: Mapping[str, float],
    noise: Noise,
    levels: Sequence[str],
    score: NoiseScore,
) -> tuple[np.ndarray, np.ndarray]:
    """Slope of the log-posterior in the logarithm of each level, and the std it scatters by.

    Args:
        engine: whose model says what a level does.
        values, noise: where. levels: names.
        score: the engine's, there.
    """
    slope, information = np.empty(len(levels)), np.empty(len(levels))
    for i, name in enumerate(levels):
        parts = level_slopes(engine, values, noise, name, score)
        slope[i], information[i] = parts.sum(), parts.size * parts.var()
    prior = _log_prior(noise, levels)
    return slope + prior[1], np.sqrt(np.maximum(information + prior[2], 1.0))


def level_slopes(
    engine: Engine, values: Mapping[str, float], noise: Noise, name: str, score: NoiseScore
) -> np.ndarray:
    """Slope of the log-likelihood in the logarithm of one level, by blocks of time, (blocks,).

    That in the variances of the first states is spread over the blocks.

    Args:
        engine: whose model says what a level does.
        values, noise: where. name: of the level.
        score: the engine's, there.
    """
    model = engine.model
    if name not in noise.process:
        column = model.channels.index(name)
        return np.asarray(2.0 * noise.level(name) ** 2 * score.in_reading[:, column])
    sides = []
    for sign in (1.0, -1.0):
        there = noise.with_levels({name: noise.level(name) * math.exp(sign * STEP_OF_LOG)})
        vector = model.vector(values, there)
        sides.append((*model.process_noise(there, vector), model.start_noise(there)))
    q, decay, start = ((a - b) / (2.0 * STEP_OF_LOG) for a, b in zip(*sides, strict=True))
    parts = score.in_noise @ q + score.in_decay @ decay
    return np.asarray(parts + float(np.sum(score.in_start @ start)) / parts.size)


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


def _some(records: Sequence[Record], seconds: float) -> list[Record]:
    """Records of so many seconds in all, or just more, evenly picked."""
    whole = sum(r.t[-1] - r.t[0] for r in records)
    count = math.ceil(min(1.0, seconds / whole) * len(records))
    return [records[i] for i in np.linspace(0, len(records) - 1, count).round().astype(int)]
