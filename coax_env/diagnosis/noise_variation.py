"""Does a name hold under other noise? Half and twice every level, memory and sensor's noise.

Evidence pays for a wrong noise model. What fits of the levels say is taken back here, one level at a
time: the likelihood is linearised anew in the causes' own and the vehicle's own numbers, and every
cause must be worth what its share of the information asks for (replication.py): noise twice as loud
hides a part of a true cause, and takes no more than that.

Runs that have a third of what is known of each cause are enough, and of a clear cause those that have a
third of what is known of one of 14 thresholds: what a cause is worth under other noise is compared with
what it is worth on the same runs under the fitted one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.replication import Asked, Known, information, same_way
from coax_env.diagnosis.scores import lost
from coax_env.estimation.engine import Engine
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.run_passes import RunPass
from coax_env.model.layout import SENSOR_GROUPS


@dataclass(frozen=True)
class Level:
    """Noise levels that are varied together. names: of process noise, or channels. words: for them."""

    names: tuple[str, ...]
    words: str


def not_holding(
    problem: Problem, fit: Fit, quadratic: Quadratic, worth: Mapping[str, float]
) -> dict[str, list[str]]:
    """Cause -> the variations of the noise under which it does not hold, in words.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit, its runs in it.
        worth: evidence of each cause [nats].
    """
    if not fit.active:
        return {}
    picked = _informative_runs(problem, fit, quadratic, worth)
    nominal = Known.of(problem, fit, quadratic.of_parts(picked), worth)
    engine = Engine(problem.model, [problem.engine.records[i] for i in picked], threads=1)
    trial = _Trial(problem, engine, fit, nominal, engine.filter(fit.values, fit.noise))
    levels = {level.words: level for level in _levels(problem, fit)}
    failing = problem.for_each(lambda words: trial.failing(levels[words]), list(levels))
    return {
        e: [variation for found in failing.values() for variation in found.get(e, [])]
        for e in fit.active
    }


def _levels(problem: Problem, fit: Fit) -> Iterable[Level]:
    """Every level of the process noise, and every sensor's noise."""
    yield from (Level((name,), name.replace("_", " ")) for name in fit.noise.process)
    for sensor in SENSOR_GROUPS.values():
        names = tuple(c for c in sensor if c in problem.aboard and c in fit.noise.reading)
        if names:
            yield Level(names, f"the noise of {', '.join(names)}")


def _informative_runs(
    problem: Problem, fit: Fit, quadratic: Quadratic, worth: Mapping[str, float]
) -> list[int]:
    """Runs that have enough of the information on each cause in the least time."""
    records, chosen = problem.engine.records, problem.settings
    nats = np.array([max(worth[e], 1e-300) for e in fit.active])
    enough = chosen.noise_share * np.minimum(chosen.noise_clear * chosen.evidence / nats, 1.0)
    known = np.array(
        [
            [information(problem, fit, quadratic.of_parts([i]), e) for e in fit.active]
            for i in range(len(records))
        ]
    )
    share = known / np.maximum(known.sum(0), 1e-300)
    seconds = np.array([r.t[-1] - r.t[0] for r in records])
    picked: list[int] = []
    while len(picked) < len(records):
        missing = np.maximum(enough - share[picked].sum(0), 0.0)
        if not missing.any():
            break
        gained = np.minimum(share, missing).sum(1) / seconds
        gained[picked] = -1.0
        picked.append(int(np.argmax(gained)))
    return sorted(picked)


@dataclass(frozen=True)
class _Trial:
    """The runs flown again: their engine, what they know of each cause, passes at the fitted noise."""

    problem: Problem
    engine: Engine
    fit: Fit
    nominal: Mapping[str, Known]
    passes: Sequence[RunPass]

    def failing(self, level: Level) -> dict[str, list[str]]:
        """Causes that do not hold at twice or half of a level, and at which."""
        factor = self.problem.settings.noise_factor
        found: dict[str, list[str]] = {}
        twice = self._at(level, factor)
        unfelt = any(self.fit.noise.at_bound(name) for name in level.names)
        if unfelt and not self._felt(self.engine.filter(twice.values, twice.noise)):
            return found
        for words, there in (("twice", twice), ("half", self._at(level, 1.0 / factor))):
            passes, fallen = self._fallen(there)
            if there is twice and not self._felt(passes):
                return found
            for effect in fallen:
                found.setdefault(effect, []).append(f"{words} {level.words}")
        return found

    def _at(self, level: Level, factor: float) -> Fit:
        noise = self.fit.noise
        changed = {name: factor * noise.level(name) for name in level.names}
        return replace(self.fit, noise=noise.with_levels(changed))

    def _felt(self, passes: Sequence[RunPass]) -> bool:
        """Whether the innovations of another level are so much others that a score could be."""
        change = sum(
            float(np.nansum((new.innovations - old.innovations) ** 2))
            for new, old in zip(passes, self.passes, strict=True)
        )
        return not change < self.problem.settings.felt_change

    def _fallen(self, there: Fit) -> tuple[list[RunPass], list[str]]:
        """The passes with another level, and the causes that do not hold there."""
        problem, fit = self.problem, self.fit
        replaced = {b for e in fit.active for b in problem.file_values(e)}
        names = replaced.union(problem.free_names(fit.active))
        free = [f for f in problem.parameters if f.name in names]
        passes, lin = self.engine.linearise(there.values, there.noise, free)
        if not all(np.isfinite(run.log_likelihood) for run in passes):
            return passes, []  # the filter cannot fly with such noise
        varied = Quadratic.of(lin, free, there.values)
        return passes, [e for e in fit.active if not self._holds(varied, e)]

    def _holds(self, varied: Quadratic, effect: str) -> bool:
        problem, fit = self.problem, self.fit
        asked = Asked.of(problem, fit, self.nominal[effect], varied)
        gone = lost(problem, varied, fit.active, effect)
        return asked.margin(gone) >= 0.0 and same_way(problem, fit, varied, fit.active, effect)
