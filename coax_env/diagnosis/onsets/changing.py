"""A problem in which causes begin or change in flight, and when each does."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

from coax_env.diagnosis.onsets.growth import Growth
from coax_env.diagnosis.problem import Fit, Problem, exclusive_with
from coax_env.estimation.changing_model import BEFORE, ChangingModel, Lap, before
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.quadratic import Quadratic

NEVER_BEGINS = frozenset(
    {"wind", "battery_sag", "ground_effect", "battery_voltage", "trim_drift", "wake_interference",
     "gyroscopic_coupling", "spin_up_reaction", "dynamic_inflow", "sonar_tilt", "thrust_exponent"}
)  # fmt: skip
"""What belongs to air, ground and battery, and laws of motion and flow that no damage changes."""


@dataclass(frozen=True)
class Onset:
    """When a cause began, or changed.

    Attributes:
        effect: the cause.
        moment: the best by likelihood; it is the model's.
        t, std: mean and std of its posterior in that run [s].
        width: s that this posterior is wide; of what grows, `Growth.width`.
        nats: what it is worth to have the change, its price paid.
        beside: the same beside the nearest model without one, a cause that was always there among them.
        growth: as what grows, where that was fitted.
        at_once: probability that it came at once, and did not grow.
        grown: when it had its size, and the std of that [s]; None where the model has a step.
        run: in which t is, where that is not the moment's.
    """

    effect: str
    moment: Moment
    t: float
    std: float
    width: float
    nats: float
    growth: Growth | None = None
    at_once: float = 1.0
    grown: tuple[Moment, float] | None = None
    run: str = ""
    beside: float = math.inf

    def entry(self) -> dict[str, Any]:
        """findings.json's `since`."""
        until = None
        if self.grown is not None:
            moment, std = self.grown
            until = {"run": moment.run, "t": moment.t, "std": std}
        return {"run": self.run or self.moment.run, "t": self.t, "std": self.std,
                "at_once": round(self.at_once, 4), "grown": until}  # fmt: skip


@dataclass(frozen=True)
class Changing:
    """A problem in which some causes begin or change, the fit, the quadratic at it, and the onsets."""

    problem: Problem
    fit: Fit
    quadratic: Quadratic
    onsets: Mapping[str, Onset]


def may_begin(problem: Problem, fit: Fit, onsets: Collection[str]) -> list[str]:
    """Effects that the machine may get or lose in flight, and that have no moment yet.

    Args:
        problem, fit: with what was found so far. onsets: effects that have a moment.
    """
    others = [e for e in problem.candidates if e not in NEVER_BEGINS and e not in onsets]
    active = set(fit.active)
    return [e for e in others if e in active or not exclusive_with(e) & active]


def beginning(
    problem: Problem, fit: Fit, moments: Mapping[str, Moment], clock: Mapping[str, Lap]
) -> Problem:
    """The problem in which effects begin at moments of theirs, or change where they are active.

    Args:
        problem, fit: with what was found so far. moments: of the effects.
        clock: of all runs, in the order in which they were flown.
    """
    model = ChangingModel(problem.model.base, {**problem.model.moments, **moments}, clock)
    own = dict(problem.own)
    for effect in moments:
        if effect in fit.active and not problem.changes(effect):
            acting = set(problem.acting_names(effect))
            own[effect] += tuple(before(f) for f in own[effect] if f.name in acting)
    return replace(problem, own=own).with_model(model)


def before_names(problem: Problem, effect: str) -> list[str]:
    """An effect's numbers before its moment, none where it begins."""
    return [n for n in problem.acting_names(effect) if n.endswith(BEFORE)]
