"""Whether gusts come in single shocks, of which a likelihood of Gaussian noise knows nothing.

One gust that stands out of the others is then a push on one run, and some effect always fits such
pushes a little. Measured on clean synthetic flights of 108 s (`study_diagnosis.py --seed 52`, three of
each arm): the largest excess kurtosis of an axis is 0.1 to 0.6 where gusts have an exponential memory,
0.6 to 2.4 in Dryden turbulence, 5.9 to 10 of 1-cosine gusts, 6 to 154 of heavy-tailed ones.
"""

import numpy as np
from scipy.stats import kurtosis

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.fitted_vehicle import median_step
from coax_env.estimation.helicopter_noise import GUST_AXES
from coax_env.model.layout import GUSTS

SECONDS = 0.1
"""s between gusts of which the difference is looked at: beyond the readings' own noise; ours."""


def gust_kurtosis(problem: Problem, fit: Fit) -> float:
    """Largest excess kurtosis of the increments of the gusts as filtered; 0 where there are none.

    Args:
        problem, fit: with the causes. An axis whose level stands at a bound has no gusts.
    """
    moving = [not fit.noise.at_bound(level) for level in GUST_AXES]
    if not any(moving):
        return 0.0
    apart = max(round(SECONDS / median_step(problem.engine.records)), 1)
    passes = problem.engine.filter(fit.values, fit.noise)
    moved = [np.diff(run.states[::apart, GUSTS][:, moving], axis=0) for run in passes]
    return float(np.max(kurtosis(np.concatenate(moved), axis=0), initial=0.0))
