"""Does a cause that begins in flight come at once, or does it grow?

What grows has a share of its size that goes from 0 to 1 evenly between two times (changing_model.py).
The two are fitted beside all other numbers, from the length about the step's moment that is likeliest
and from the longest that may be, and both models pay for their times alike: of all times of the flight
each was as likely.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from coax_env.diagnosis.fits import fitted, linearise, noise_fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.changing_model import (
    BEGINS,
    GROWN,
    SHORTEST,
    ChangingModel,
    times_of_growth,
)
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.quadratic import Quadratic

LENGTHS = tuple(0.5 * 2.0**k for k in range(9))
"""s over which something may grow, where a fit of it begins: up to two minutes; ours."""


@dataclass(frozen=True)
class Growth:
    """What is known of a cause as one that grows.

    Attributes:
        begins, grown: times between which it grows [s of the clock].
        covariance: of these two, (2, 2).
        nats: what that is worth beside a step, both with their times paid for.
    """

    begins: float
    grown: float
    covariance: np.ndarray
    nats: float

    def at_once(self, inflation: float = 1.0) -> float:
        """Probability that it came at once, before any look as likely as that it grew.

        Args:
            inflation: of variances, by coloured innovations.
        """
        return 1.0 / (1.0 + math.exp(min(self.nats / inflation, 700.0)))

    def width(self, seconds: float) -> float:
        """s that a step's moment would be narrowed down to at the same price as these two times.

        Args:
            seconds: of flight, in which each pair of times was as likely.
        """
        pairs = 0.5 * seconds**2
        area = 2.0 * math.pi * math.sqrt(max(float(np.linalg.det(self.covariance)), 0.0))
        return seconds * min(area / pairs, 1.0)


def growing(
    problem: Problem, step: Fit, effect: str, moment: Moment, width: float
) -> tuple[Problem, Fit, Growth] | None:
    """A change as one that grows; None where it comes as fast as a step, or is worse by a tie.

    Args:
        problem, step: with the change at its moment, fitted.
        effect, moment: that changes, and when.
        width: s that the posterior of this moment is wide.
    """
    wider = with_moment(problem, effect, replace(moment, grows=LENGTHS[0]))
    step = fitted(problem, noise_fitted(problem, step), steps=2)
    tried = [_fitted(with_free, begun, effect) for with_free, begun in
             _starts(problem, wider, step, effect, moment)]  # fmt: skip
    found = [t for t in tried if t[2].grown - t[2].begins > 1.01 * SHORTEST]
    if not found:
        return None

    def nats(fit: Fit, own: Growth) -> float:
        return step.objective - fit.objective - math.log(width / own.width(problem.seconds))

    best = max(found, key=lambda t: nats(*t[1:]))
    return best[0], best[1], replace(best[2], nats=nats(*best[1:]))


def _starts(
    problem: Problem, wider: Problem, step: Fit, effect: str, moment: Moment
) -> list[tuple[Problem, Fit]]:
    """Where fits of growth begin: the likeliest length, and the longest within a tie of it.

    Args:
        problem, step: with the change at once, fitted. wider: in which it may grow.
        effect, moment: that changes, and when.
    """
    model = changing(problem)
    last = max(float(model.times(record)[-1]) for record in problem.engine.records)
    middle = model.time(moment)

    def about(length: float) -> tuple[float, Problem, Fit]:
        begins, grown = max(middle - 0.5 * length, 0.0), min(middle + 0.5 * length, last)
        free = times_of_growth(effect, begins, grown, last)
        there = step.at({f.name: f.value for f in free})
        return wider.engine.log_likelihood(there.values, there.noise), wider.with_free(free), there

    tried = [about(length) for length in LENGTHS]
    likeliest = max(tried, key=lambda t: t[0])
    least = max(likeliest[0], problem.engine.log_likelihood(step.values, step.noise))
    near = [t for t in tried if t[0] > least - problem.settings.tie]
    starts = [likeliest, near[-1]] if near and near[-1] is not likeliest else near[-1:]
    return [t[1:] for t in starts]


def _fitted(wider: Problem, begun: Fit, effect: str) -> tuple[Problem, Fit, Growth]:
    """A change that grows, fitted from there."""
    fit = fitted(wider, noise_fitted(wider, fitted(wider, begun, steps=6)), steps=3)
    fit, _, quadratic = linearise(wider, fit)
    return wider, fit, growth_at(wider, fit, quadratic, effect)


def growth_at(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, nats: float = 0.0
) -> Growth:
    """When an effect grows at a fit, with covariance, any time of the flight as likely before.

    Args:
        problem, fit: in which it grows.
        quadratic: linearised at the fit.
        effect: that grows.
        nats: what that is worth beside a step.
    """
    own = [f"{effect}.{name}" for name in (BEGINS, GROWN)]
    precision = quadratic.precision.copy()
    precision[quadratic.index(own)] = 12.0 / problem.seconds**2  # of an even spread over the flight
    free = problem.free_names(fit.active)
    covariance = replace(quadratic, precision=precision).covariance(free)
    places = [free.index(name) for name in own]
    times = changing(problem).spans(fit.values)[effect]
    return Growth(*times, covariance[np.ix_(places, places)], nats)


def with_moment(problem: Problem, effect: str, moment: Moment) -> Problem:
    """With another moment of an effect that changes."""
    model = changing(problem)
    moments = {**model.moments, effect: moment}
    return problem.with_model(ChangingModel(model.base, moments, model.clock))


def changing(problem: Problem) -> ChangingModel:
    """The model of a problem in which something changes."""
    assert isinstance(problem.model, ChangingModel)
    return problem.model
