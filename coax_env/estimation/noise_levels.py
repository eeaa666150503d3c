"""Noise levels of largest likelihood, those of process and readings together."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from coax_env.estimation.engine import Engine, NoiseScore
from coax_env.estimation.state_space import Noise, Record
from coax_env.estimation.whiteness import is_much_coloured
from coax_env.progress import Progress

STEP_OF_LOG = 1e-3  # of a noise level, for the slopes of the model's variances
ASKS_FROM = 0.05  # nats that a level's own step must promise for it to be moved; ours
FAR = 0.4  # of a level's logarithm: from here on a quadratic is good enough; ours
LONGEST_MOVE = 3.0  # of a level's logarithm at once; ours
MEMORY_OF = "memory_"  # before the name of a level, that of its memory


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
    their slopes from block to block, each level by its memory (`_Point.lean`). Nothing is done where
    that scatter predicts a gain of less than `tolerance` nats; a level that asks for nothing stays.
    Where much is coloured, noise stands for what the model lacks, and each level is moved alone: closer
    fits made the readings of a real helicopter (first CoaX) 10,000 nats likelier, and 3 to 49 % of its
    error was removed for 54.

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
    promises = [point.predicted_gains().sum() for point in (first, first.apart())]
    if max(promises) < tolerance:
        return noise
    if is_much_coloured(picked.filter(values, noise), engine.model.channels):
        first = first.apart()
    if first.predicted_gains().sum() < tolerance:
        return noise
    here = first.only(first.asking())
    here, left = _from_afar(picked, values, here, evaluations)
    if left > 0 and here.predicted_gains().sum() >= tolerance:
        here = _quasi_newton(picked, values, here, left, tolerance)
    if progress:
        progress(f"noise levels: {here.value - first.value:.1f} nats")
    return here.noise


@dataclass(frozen=True)
class _Point:
    """Levels and the log-posterior there.

    Of gusts that last long the likelihood knows what they shake a second, 2 std^2 / memory, far better
    than either alone: from 0.26 N and 0.86 s to 0.2 N and 0.49 s, where 20 nats were to be had, each
    alone promised 0.3 and 0.02, both together 36 (**synthetic**, `study_diagnosis.py --arms sizes_large
    --seed 859`, two 491). So a level is moved with its memory: its coordinate is log std + lean log
    memory, in which the two slopes do not scatter together; lean is -1/2 where that is so.

    logs: (k,) of the levels named, lower and upper their bounds. value: nats. slope: (k,). scale: (k,)
    std by which the slopes scatter, of a memory by its level's coordinate. lean: (k,) of memories upon
    their levels, else 0. ratio: (k,) what the data show of a level's variance over what is expected of
    it; 1 where it is no variance. together: whether levels are moved with their memories.
    """

    names: tuple[str, ...]
    noise: Noise
    logs: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    value: float
    slope: np.ndarray
    scale: np.ndarray
    lean: np.ndarray
    ratio: np.ndarray
    together: bool = True

    @classmethod
    def at(
        cls, engine: Engine, values: Mapping[str, float], noise: Noise, names: Sequence[str]
    ) -> "_Point":
        """Evaluated: one filter pass and one back."""
        score = engine.noise_score(values, noise)
        found = [level_slopes(engine, values, noise, name, score) for name in names]
        parts = np.array([by_block for by_block, _ in found]).reshape(len(names), len(score.in_noise))
        expected = np.array([variance for _, variance in found])
        slope = parts.sum(axis=1)
        shown = np.divide(slope, expected, out=np.zeros_like(slope), where=expected > 0.0)
        log_prior, pull, known = _log_prior(noise, names)
        information = np.maximum(parts.shape[1] * parts.var(axis=1) + known, 1.0)
        logs, lower, upper = _logs(noise, names)
        bound = _is_bound(logs, lower, upper, slope + pull)
        lean = np.zeros(len(names))
        for i, j in couples(names):
            if bound[i]:  # it cannot go with its memory
                continue
            across = parts.shape[1] * float(np.cov(parts[i], parts[j], bias=True)[0, 1])
            lean[j] = across / information[i]
            information[j] = max(information[j] - lean[j] * across, 1.0)
        return cls(
            tuple(names), noise, logs, lower, upper, score.log_likelihood + log_prior,
            slope + pull, np.sqrt(information), lean, 1.0 + shown,
        )  # fmt: skip

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Places of levels that are moved with their memories, and of these."""
        return [(i, j) for i, j in couples(self.names) if self.lean[j] != 0.0]

    def slope_of_coordinates(self, lean: np.ndarray, held: np.ndarray | None = None) -> np.ndarray:
        """Slope, (k,), in the coordinates of a lean.

        Args:
            lean: (k,) of memories. held: (k,) levels that do not follow their coordinate.
        """
        slope = self.slope if held is None else np.where(held, 0.0, self.slope)
        found = slope.copy()
        for i, j in couples(self.names):
            found[j] -= lean[j] * slope[i]
        return found

    def predicted_gains(self) -> np.ndarray:
        """Nats that each level's own step promises, of a memory with its level's coordinate held; none
        at a bound that it wants to cross."""
        slope = self.slope_of_coordinates(self.lean)
        bound = _is_bound(self.logs, self.lower, self.upper, slope)
        return np.where(bound, 0.0, 0.5 * (slope / self.scale) ** 2)

    def apart(self) -> "_Point":
        """With each level its own coordinate."""
        scale = self.scale.copy()
        for i, j in self.pairs:
            scale[j] = math.hypot(scale[j], self.lean[j] * scale[i])
        return replace(self, scale=scale, lean=np.zeros_like(self.lean), together=False)

    def asking(self) -> np.ndarray:
        """Places of the levels that promise enough to be moved, and of those that go with them."""
        asks = self.predicted_gains() > ASKS_FROM
        for i, j in self.pairs:
            asks[i] = asks[j] = asks[i] or asks[j]
        return np.flatnonzero(asks)

    def only(self, which: np.ndarray) -> "_Point":
        """With some of the levels, the others held."""
        arrays = {
            name: getattr(self, name)[which]
            for name in ("logs", "lower", "upper", "slope", "scale", "lean", "ratio")
        }
        return replace(self, names=tuple(self.names[int(i)] for i in which), **arrays)

    def moved(self, engine: Engine, values: Mapping[str, float], logs: np.ndarray) -> "_Point":
        """Evaluated at other levels."""
        logs = np.clip(logs, self.lower, self.upper)
        levels = dict(zip(self.names, np.exp(logs).tolist(), strict=True))
        there = _Point.at(engine, values, self.noise.with_levels(levels), self.names)
        return there if self.together else there.apart()


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
    """L-BFGS-B from a point in its coordinates, the best that it saw."""
    scale, lean = here.scale, here.lean
    levels, memories = np.array(here.pairs, dtype=int).reshape(-1, 2).T
    start, lower, upper = here.logs.copy(), here.lower.copy(), here.upper.copy()
    start[levels] += lean[memories] * here.logs[memories]
    lower[levels], upper[levels] = -np.inf, np.inf  # of a level itself where it is put back
    seen = {tuple(start * scale): here}

    def cost(scaled: np.ndarray) -> tuple[float, np.ndarray]:
        logs = scaled / scale
        logs[levels] -= lean[memories] * logs[memories]
        point = seen.get(tuple(scaled)) or here.moved(engine, values, logs)
        if not np.isfinite(point.value):
            return 1e12, np.zeros(scaled.size)
        seen[tuple(scaled)] = point
        held = (logs < here.lower) | (logs > here.upper)
        return -point.value, -point.slope_of_coordinates(lean, held) / scale

    minimize(
        cost, start * scale, jac=True, method="L-BFGS-B",
        bounds=list(zip(lower * scale, upper * scale, strict=True)),
        options={"maxfun": evaluations, "ftol": 0.5 * tolerance / max(abs(here.value), 1.0)},
    )  # fmt: skip
    return max(seen.values(), key=lambda point: point.value)


def _is_bound(
    logs: np.ndarray, lower: np.ndarray, upper: np.ndarray, slope: np.ndarray
) -> np.ndarray:
    """Which levels stand at a bound that they want to cross, (k,)."""
    return ((logs <= lower) & (slope < 0.0)) | ((logs >= upper) & (slope > 0.0))


def couples(names: Sequence[str]) -> list[tuple[int, int]]:
    """Places of levels and of their memories, where both are named.

    Args:
        names: of levels.
    """
    places = {name: i for i, name in enumerate(names)}
    return [
        (places[level], j)
        for name, j in places.items()
        if (level := name.removeprefix(MEMORY_OF)) != name and level in places
    ]


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
