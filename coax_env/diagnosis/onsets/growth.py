"""Does a cause that begins in flight come at once, or does it grow?

What grows has a share of its size that goes from 0 to 1 evenly between two times (changing_model.py).
The two are fitted beside all other numbers, from several lengths about the step's moment, since a short
growth is not far from a step and a likelihood of its own. Both models pay for their times alike: of all
times of the flight each was as likely.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import PchipInterpolator

from coax_env.diagnosis.fits import converged, fitted, noise_fitted, quadratic_at
from coax_env.diagnosis.onsets.ends import at_an_end
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.changing_model import (
    BEGINS,
    GROWN,
    SHORTEST,
    ChangingModel,
    times_of_growth,
)
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.quadratic import Quadratic, penalty

LENGTHS = (0.5, 2.0, 8.0, 32.0, 128.0)
"""s over which something may grow, where fits of it begin; ours."""
WORSE = 100.0
"""nats by which growth with a step's numbers may be worse than the step, to be fitted; ours. One that
was fitted was 128 worse before and 30 better then."""

STEPS = (2, 4)
"""Gauss-Newton steps of each start, and more of those that are near the best then; ours."""
BEHIND = 40.0
"""nats behind the best, or the step, that a start may be after its first steps to get more; ours."""

GONE, MOST_POINTS = 4.5, 10
"""nats from the best at which a time has no share in its interval, and points to each side; ours."""
BETWEEN = 50
"""Times between two points of a profile; ours."""


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
    """A change as one that grows; None where it would come as fast as a step, or all are far worse.

    Args:
        problem, step: with the change at its moment, fitted.
        effect, moment: that changes, and when.
        width: s that the posterior of this moment is wide.
    """
    step = fitted(problem, noise_fitted(problem, step), steps=2)

    def judged(wider: Problem, fit: Fit) -> tuple[Problem, Fit, Growth]:
        fit, quadratic = quadratic_at(wider, fit, wider.free(fit.active))
        own = growth_at(wider, fit, quadratic, effect)
        price = math.log(width / own.width(problem.seconds))
        return wider, fit, replace(own, nats=step.objective - fit.objective - price)

    begun = [(wider, fitted(wider, fit, STEPS[0]))
             for wider, fit in _starts(problem, step, effect, moment)]  # fmt: skip
    least = min(fit.objective for fit in (step, *(fit for _, fit in begun)))
    near = [(wider, fit) for wider, fit in begun if fit.objective < least + BEHIND]
    tried = [judged(wider, fitted(wider, fit, STEPS[1])) for wider, fit in near]
    tried = [t for t in tried if t[2].grown - t[2].begins > 1.01 * SHORTEST]
    if not tried:
        return None
    wider, fit, own = max(tried, key=lambda t: t[2].nats)
    wider = _about(wider, effect, own)
    begins = changing_model(wider).moment(own.begins)
    in_between = not at_an_end(problem.engine.records, begins)  # else it is no change, however likely
    if own.nats > -problem.settings.tie and in_between:
        step = converged(problem, step)  # or growth is credited with what a step would gain as well
        return judged(wider, converged(wider, fit))
    return wider, fit, own


def _starts(problem: Problem, step: Fit, effect: str, moment: Moment) -> list[tuple[Problem, Fit]]:
    """Where fits of growth begin: the lengths about a moment that are not hopeless as they are.

    Args:
        problem, step: with the change at once, fitted. effect, moment: that changes, and when.
    """
    last, middle = _last(problem), changing_model(problem).time(moment)
    least = problem.engine.log_likelihood(step.values, step.noise) - WORSE
    found = []
    for length in LENGTHS:
        begins, grown = max(middle - 0.5 * length, 0.0), min(middle + 0.5 * length, last)
        free = times_of_growth(effect, begins, grown, last)
        wider = with_moment(problem, effect, replace(moment, grows=length)).with_free(free)
        there = step.at({f.name: f.value for f in free})
        if wider.engine.log_likelihood(there.values, there.noise) > least:
            found.append((wider, there))
    return found


def _about(wider: Problem, effect: str, own: Growth) -> Problem:
    """With the priors of the times at which an effect grows about those that were found."""
    free = times_of_growth(effect, own.begins, own.grown, _last(wider))
    return wider.with_fixed([f.name for f in free]).with_free(free)


def _last(problem: Problem) -> float:
    """Time of the last row that is fitted [s of the clock]."""
    model = changing_model(problem)
    return max(float(model.times(record)[-1]) for record in problem.engine.records)


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
    times = changing_model(problem).spans(fit.values)[effect]
    return Growth(*times, covariance[np.ix_(places, places)], nats)


def profiled(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, nats: float, inflation: float
) -> Growth:
    """`growth_at`, its times and their covariance by the likelihood's profile over the first of them.

    What a time does to the likelihood depends on what is flown then: no parabola in it. Outwards from
    the fit to both sides, all else refitted, until it is `GONE` nats worse.

    Args:
        problem, fit: in which it grows, and its last fit.
        quadratic: linearised at the fit.
        effect: that grows.
        nats: what that is worth beside a step.
        inflation: of variances, by coloured innovations.
    """
    own = growth_at(problem, fit, quadratic, effect, nats)
    begins, grown = (f"{effect}.{name}" for name in (BEGINS, GROWN))
    free = [f for f in problem.free(fit.active) if f.name in (begins, grown)]
    first = math.sqrt(inflation * own.covariance[0, 0])

    def at(time: float, near: Fit) -> Fit:
        return fitted(problem, near.at({begins: time}), tolerance=0.1, held=[begins])

    def likelihood(there: Fit) -> float:
        return (penalty(free, there.values) - there.objective) / inflation

    points = [at(fit.values[begins], fit)]
    best = likelihood(points[0])
    for way in (-1.0, 1.0):
        there, step = points[0], first
        for _ in range(MOST_POINTS):
            here = there.values[begins]
            time = max(here + way * step, 0.0)
            if time == here or time > there.values[grown] - SHORTEST:
                break
            there, step = at(time, there), 1.3 * step
            points.append(there)
            best = max(best, likelihood(there))
            if likelihood(there) < best - GONE:
                break
    if len(points) == 1:  # nowhere to go
        return replace(own, covariance=inflation * own.covariance, nats=nats / inflation)
    times = np.array([[there.values[begins], there.values[grown]] for there in points])
    mean, covariance = _moments(times, np.array([likelihood(there) for there in points]))
    alone = own.covariance[1, 1] - own.covariance[0, 1] ** 2 / own.covariance[0, 0]
    covariance[1, 1] += inflation * alone  # the second beside the first
    return Growth(float(mean[0]), float(mean[1]), covariance, nats / inflation)


def _moments(times: np.ndarray, nats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (2,) and covariance (2, 2) of both times, by the likelihood [nats] at some of the first.

    Between these it goes on without a swing (pchip): the best of them may be far from the next.
    """
    order = np.argsort(times[:, 0])
    times, nats = times[order], nats[order]
    between = np.concatenate(
        [np.linspace(a, b, BETWEEN, endpoint=False) for a, b in pairwise(times[:, 0])]
        + [times[-1:, 0]]
    )
    both = PchipInterpolator(times[:, 0], times)(between)
    share = PchipInterpolator(times[:, 0], nats)(between)
    width = np.gradient(between)
    width[[0, -1]] *= 0.5
    weight = np.exp(share - share.max()) * width
    return weight @ both / weight.sum(), np.cov(both.T, aweights=weight, ddof=0)


def with_moment(problem: Problem, effect: str, moment: Moment) -> Problem:
    """A problem whose model has another moment of an effect that changes.

    Args:
        problem: in which it changes. effect, moment: that changes, and when.
    """
    model = changing_model(problem)
    moments = {**model.moments, effect: moment}
    return problem.with_model(ChangingModel(model.base, moments, model.clock))


def changing_model(problem: Problem) -> ChangingModel:
    """The model of a problem in which something changes."""
    assert isinstance(problem.model, ChangingModel)
    return problem.model
