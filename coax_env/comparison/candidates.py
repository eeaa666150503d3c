"""What may have changed, and what each change would be worth.

A change of an effect is the difference of its numbers between the flights: columns that are B's share
of the effect's own. It is scored with everything that both flights share free under its prior, named or
not: what a model lacks, and two flights show differently because they were flown differently, is then
no evidence for a change. Nor is what air, ground, battery or pilot may be in each (circumstances.py).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coax_env.comparison.circumstances import (
    BATTERY_SPEED,
    NEVER_CHANGES,
    battery_is_logged,
    is_shape,
    own,
)
from coax_env.comparison.two_flights import ROTOR_SPEED, B, OneFlight
from coax_env.diagnosis.problem import Problem
from coax_env.estimation.parted_engine import AT, of_part
from coax_env.estimation.quadratic import Quadratic, bounded_solve
from coax_env.estimation.state_space import FreeParameter
from coax_env.model import effects

Numbers = Mapping[str, tuple[FreeParameter, ...]]
"""Effect -> the numbers of its change."""


def numbers(problem: Problem, flights: Sequence[OneFlight]) -> dict[str, tuple[FreeParameter, ...]]:
    """Every change that may be named. Its prior is as wide as the effect's usual size.

    Args:
        problem: of both flights. flights: both.
    """
    found = {}
    of_file = [e for e in problem.model.vehicle.effects if e in effects.CATALOGUE]
    for effect in (*problem.candidates, *of_file):
        if effect not in NEVER_CHANGES and not effects.CATALOGUE[effect].line:
            group = problem.model.effect_parameters(effect)
            found[effect] = tuple(own(f, B) for f in group if not is_shape(f.name))
    if battery_is_logged(flights):  # then it is no battery's
        name = of_part(ROTOR_SPEED, B)
        found["rotor_speed"] = (FreeParameter(name, 0.0, BATTERY_SPEED, -0.175, 0.175),)
    return found


@dataclass(frozen=True)
class Score:
    """What a change is worth. nats: log Bayes factor. gained: of the log-posterior. occam: its price.

    move: name -> its most likely value; std: its std. inflation: of variances, by coloured innovations.
    """

    effect: str
    gained: float
    occam: float
    move: Mapping[str, float]
    std: Mapping[str, float]
    inflation: float = 1.0

    @property
    def nats(self) -> float:
        """What is left of the gain."""
        return self.gained / self.inflation - self.occam


def scored(
    problem: Problem,
    quadratic: Quadratic,
    effect: str,
    group: Sequence[FreeParameter],
    inflated: bool = False,
) -> Score:
    """What a change is worth by the quadratic, active or not, all that is shared free.

    Args:
        problem: whose parameters are free, but for those of the change.
        quadratic: over those and the change's.
        effect: its name. group: its numbers.
        inflated: whether coloured innovations are allowed for; only at a fit with the change.
    """
    mine = [f.name for f in group]
    rest = [f.name for f in problem.parameters if f.name not in mine]
    c, r = quadratic.index(mine), quadratic.index(rest)
    information, weights = quadratic.projected(mine, rest)
    pull = quadratic.g + quadratic.precision * (quadratic.at - quadratic.mean)
    slope = quadratic.g[c] - weights.T @ pull[r]
    at, prior = quadratic.at[c], quadratic.precision[c]
    A = information + np.diag(prior)
    b = information @ at - slope
    x = bounded_solve(A, b, quadratic.lower[c], quadratic.upper[c])
    occam = 0.5 * float(np.linalg.slogdet(A / np.sqrt(np.outer(prior, prior)))[1])
    gained = float(b @ x - 0.5 * x @ A @ x)
    factor = quadratic.variance_inflation(mine, mine + rest) if inflated else 1.0
    std = np.sqrt(np.diag(np.linalg.inv(A)))
    move, spread = (dict(zip(mine, v.tolist(), strict=True)) for v in (x, std))
    return Score(effect, gained, occam, move, spread, factor)


def best_first(
    problem: Problem, quadratic: Quadratic, candidates: Numbers, but: Collection[str] = ()
) -> list[Score]:
    """Scores of all that may have changed, the best first.

    Args:
        problem, quadratic: of both flights, linearised. candidates: numbers of each effect.
        but: effects that are left out.
    """
    found = [
        scored(problem, quadratic, effect, group)
        for effect, group in candidates.items()
        if effect not in but
    ]
    return sorted(found, key=lambda score: -score.nats)


def plain(name: str) -> str:
    """A number's name without the flight's."""
    return name.partition(AT)[0]
