"""What two logs of one flight differ in, as it is stated: sizes, intervals, evidence.

The std of a change is that of the residual's scores, block by block (sandwich; Huber 1967): far smaller
than the std of either diagnosis. What a change would be worth in a flight with noise of its own is
stated beside it, as its evidence.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.comparison.two_logs.coordinates import Coordinate, effective, moved, scale_of
from coax_env.comparison.two_logs.logs import Logs
from coax_env.comparison.two_logs.trials import Trial, fitted, nats_of, ridge_of
from coax_env.diagnosis.problem import Problem
from coax_env.estimation.fitted_vehicle import median_step
from coax_env.estimation.helicopter import Moment

LEAST_STD = 0.01
"""Std of a change as a share of it at least, since forms and rows express it only so well; ours.

Where more of the difference is left, the share is the root of what is left of its square: a change that
no number can express as it is, such as a constant tilt where the phase follows the rotor speed, is
known no better than it fits.
"""
LEAST_DIFFERENT = 0.1
"""nats by which two logs differ at least: the digits of a CSV are worth 1e-6; ours."""


@dataclass(frozen=True)
class ParameterChange:
    """A number before and after, effective: with what a fit had put into its base parameter."""

    before: float
    after: float
    std: float
    unit: str

    @property
    def change(self) -> float:
        """After less before."""
        return self.after - self.before


@dataclass(frozen=True)
class Change:
    """An effect that changed. evidence: nats that it would be worth in a flight of its own noise."""

    effect: str
    parameters: Mapping[str, ParameterChange]
    evidence: float
    confusable_with: tuple[str, ...] = ()


@dataclass(frozen=True)
class Since:
    """From when on two logs of a flight differ. moment: the first row that does; t, std: of the time
    between the last row that is the same and that one [s]."""

    moment: Moment
    t: float
    std: float

    def entry(self) -> dict[str, str | float]:
        """As findings.json has a moment."""
        return {"run": self.moment.run, "t": self.t, "std": self.std}


@dataclass(frozen=True)
class Changes:
    """All that changed, strongest first.

    different: nats by which the logs differ under the model of the one before.
    left: nats of that which no change explains.
    since: from when on they differ; None: from the start.
    """

    changes: tuple[Change, ...]
    different: float
    left: float
    since: Since | None = None

    def as_json(self) -> dict[str, Any]:
        """As changes.json has it."""
        return {
            "verdict": "changed" if self.changes else "same",
            "since": self.since.entry() if self.since else None,
            "changes": [
                {
                    "effect": c.effect,
                    "parameters": {
                        name: {
                            "before": p.before, "after": p.after, "change": p.change,
                            "std": p.std, "unit": p.unit,
                        }
                        for name, p in c.parameters.items()
                    },
                    "evidence": c.evidence,
                    "confusable_with": list(c.confusable_with),
                }
                for c in self.changes
            ],
            "different_nats": self.different,
            "left_nats": self.left,
        }  # fmt: skip


def stated(
    problem: Problem,
    logs: Logs,
    known: Mapping[str, Sequence[Coordinate]],
    best: Trial,
    alternatives: Mapping[str, tuple[str, ...]],
    nothing: np.ndarray,
) -> Changes:
    """The best set of changes in effective numbers, each with what the others alone would leave.

    Args:
        problem: of the log before. logs: both. known: effect -> its coordinates. best: the set.
        alternatives: effect -> others that do as well.
        nothing: the difference (k,) with nothing changed.
    """
    own = [c for e in best.effects for c in known[e]]
    unexpressed = math.sqrt(nats_of(best.residual) / max(nats_of(nothing), LEAST_DIFFERENT))
    std = std_of(logs, own, best, median_step(problem.engine.records), max(unexpressed, LEAST_STD))
    fit = logs.fit
    found = []
    for effect in best.effects:
        rest = tuple(e for e in best.effects if e != effect)
        without = fitted(logs, known, rest, best.moves, nothing).residual if rest else nothing
        before = effective(problem, fit.values, effect)
        after = effective(problem, moved(fit.values, best.moves), effect)
        found.append(
            Change(
                effect,
                {
                    c.name: ParameterChange(
                        before[c.name], after[c.name], std[c.name] * scale_of(before, c), c.unit
                    )
                    for c in known[effect]
                },
                nats_of(without) - nats_of(best.residual),
                alternatives[effect],
            )
        )
    found.sort(key=lambda c: -c.evidence)
    return Changes(tuple(found), nats_of(nothing), nats_of(best.residual))


def std_of(
    logs: Logs, own: Sequence[Coordinate], best: Trial, dt: float, least: float
) -> dict[str, float]:
    """Std of every move by the residual's scores, block by block; lags with half a sample.

    Args:
        logs: both. own: coordinates of the changes. best: the changes. dt: a sample [s].
        least: share of the effect's change, in usual sizes, that a std is at least.
    """
    if not own:
        return {}
    count = int(logs.block.max()) + 1
    scores = np.zeros((count, len(own)))
    np.add.at(scores, logs.block, best.slopes * best.residual[:, None])
    inverse = np.linalg.inv(best.slopes.T @ best.slopes + ridge_of(own))
    covariance = inverse @ (scores.T @ scores) @ inverse * count / max(count - len(own), 1)
    half = dt / math.sqrt(12.0)
    size: dict[str, float] = {}  # of an effect's change, in usual sizes
    for c in own:
        size[c.effect] = max(size.get(c.effect, 0.0), abs(best.moves[c.name]) / c.usual)
    return {
        c.name: math.hypot(s, least * size[c.effect] * c.usual, half if c.timing else 0.0)
        for c, s in zip(own, np.sqrt(np.diag(covariance)), strict=True)
    }
