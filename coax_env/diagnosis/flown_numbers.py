"""The numbers of a model whose noise is not the flight's: those that fly the fitted runs nearest.

Where much is coloured the likelihood of one step is no guide to what happens in a second
(estimation/multi_step.py). Causes are searched, weighed and named by it all the same. What the findings
and the corrected vehicle have is the numbers that fly nearest, and their std has in it how far the
likelihood had them from there. The two real CoaXes are such flights, and few **synthetic** ones.
"""

import numpy as np

from coax_env.diagnosis.fits import flown_errors, is_much_coloured, quadratic_at
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.multi_step import fit_multi_step
from coax_env.estimation.parted_engine import PartedEngine
from coax_env.estimation.prediction import mean_log_ratio

REMARK = (
    "much of what is read follows from what was read before, so the noise is not as the filter has it:"
    " the numbers are those that fly the fitted runs nearest over half a second and a second, and their"
    " std has in it how far the likelihood has them from there"
)
"""For who reads the findings, where `flying_nearest` has moved them."""


def flying_nearest(problem: Problem, fit: Fit, covariance: np.ndarray | None = None) -> Fit:
    """The fit at the numbers that fly its runs nearest, noise levels as they are.

    The fit itself where little is coloured, something changes in flight, or none fly nearer.

    Args:
        problem, fit: what is free, and where it is likeliest.
        covariance: (k, k) of what is free there; default by the signatures.
    """
    if isinstance(problem.engine, PartedEngine) or not is_much_coloured(problem, fit):
        return fit
    free = problem.free(fit.active)
    if covariance is None:
        _, quadratic = quadratic_at(problem, fit, free)
        covariance = quadratic.covariance([f.name for f in free])
    values = fit_multi_step(
        problem.engine, free, fit.values, fit.noise, covariance, problem.settings.horizon
    )
    flown = fit.at(values)
    nearer = mean_log_ratio(flown_errors(problem, flown), flown_errors(problem, fit)) < 0.0
    return flown if nearer else fit


def numbers_apart(fit: Fit, flown: Fit) -> dict[str, float]:
    """How far the numbers that fly nearest are from the likeliest; none: empty.

    Args:
        fit, flown: before and after `flying_nearest`.
    """
    moved = ((name, value - fit.values[name]) for name, value in flown.values.items())
    return {name: far for name, far in moved if far != 0.0}
