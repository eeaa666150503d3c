"""Whether the times of a log's rows are wrong, asked after the first search where motion is coloured.

Readings of motion are then off by their rates times the error of the times, loud in a dash and quiet in
hover, which no level of their noise says (estimation/clock_errors.py). What a model lacks shows in a
dash as well: a quarter of the colour of motion must be gone then, or the times are taken to be right.
(Of two real helicopters whose motion no model in reach makes white they were wrong by 0.7 and 17 ms.)
"""

import math

from scipy.optimize import minimize_scalar

from coax_env.diagnosis.fits import fitted, noise_fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.whiteness import Whiteness, colour, whiteness
from coax_env.model.layout import MOTION

LEAST, MOST = 5e-5, 0.02
"""s of the std of the times that are tried: below, half a mm at 10 m/s; above, two rows of 100 Hz."""
LEFT = 0.75
"""Share of the colour of motion that may be left then; ours. It was 0.1 to 0.5 on four **synthetic**
flights whose times were wrong, 1.0 and 1.3 on the real ones above."""
TURNS = 3
"""Of that and the noise levels, at most; ours."""
WITHIN = 0.1
"""Of its logarithm, to which it is looked for; ours."""


def with_clock_errors(problem: Problem, fit: Fit) -> Problem | None:
    """The problem whose rows' times are wrong, where that is worth the threshold.

    Args:
        problem, fit: after a search.
    """
    if problem.clock_error > 0.0:
        return None
    before = _of_motion(problem, fit)
    if all(judged.white for judged in before):
        return None
    trial, best = fit, problem
    for _ in range(TURNS):
        best = _likeliest(problem, trial)
        last = trial.objective
        trial = fitted(best, noise_fitted(best, trial))
        if last - trial.objective < problem.settings.tie:
            break
    gained = fit.objective - trial.objective
    problem.report(f"times wrong by {1e3 * best.clock_error:.2g} ms: {gained:.1f} nats")
    explained = colour(_of_motion(best, trial)) < LEFT * colour(before)
    if gained < problem.settings.evidence or not explained:
        return None
    return best


def _likeliest(problem: Problem, fit: Fit) -> Problem:
    """The problem with the error of the times that is likeliest at a fit."""

    def cost(logarithm: float) -> float:
        there = problem.with_clock_error(math.exp(logarithm))
        return -there.engine.log_likelihood(fit.values, fit.noise)

    found = minimize_scalar(
        cost, bounds=(math.log(LEAST), math.log(MOST)), method="bounded",
        options={"xatol": WITHIN},
    )  # fmt: skip
    return problem.with_clock_error(math.exp(float(found.x)))


def _of_motion(problem: Problem, fit: Fit) -> list[Whiteness]:
    passes = problem.engine.filter(fit.values, fit.noise)
    shown = whiteness(passes, problem.model.channels)
    return [shown[channel] for channel in MOTION if channel in shown]
