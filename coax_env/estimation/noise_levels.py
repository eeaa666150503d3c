"""Process-noise levels of largest likelihood."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from coax_env.estimation.engine import Engine, Progress
from coax_env.estimation.state_space import Noise, Record

STEP_OF_LOG = 1e-3  # of a noise level, for the slopes of the model's variances
LARGEST = 1e4  # times its floor that a level may have; ours


def fit_noise(
    engine: Engine,
    values: Mapping[str, float],
    noise: Noise,
    process: Sequence[str],
    evaluations: int = 16,
    tolerance: float = 0.5,
    seconds: float = np.inf,
    progress: Progress | None = None,
) -> Noise:
    """Process-noise levels of largest likelihood, or the best seen in so many evaluations.

    Quasi-Newton in log levels, scaled by the scatter of their slopes from block to block. Nothing is
    done where that scatter predicts a gain of less than `tolerance` nats.

    Args:
        engine: model and records.
        values: of the parameters, held.
        noise: levels to start from, and their floors.
        process: names of the process-noise levels to fit.
        evaluations: of the likelihood, at most.
        tolerance: gain that ends the fit [nats].
        seconds: of flight that are enough: whole runs, evenly picked.
        progress: called with a line of text.
    """
    picked = Engine(engine.model, _some(engine.records, seconds), engine.threads)

    def changed(logs: np.ndarray) -> Noise:
        levels = dict(noise.process)
        for name, log in zip(process, logs, strict=True):
            levels[name] = float(np.exp(log))
        return replace(noise, process=levels)

    def variances(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        here = changed(logs)
        return engine.model.process_noise(here), engine.model.start_noise(here)

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
    upper = lower + np.log(LARGEST)
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
