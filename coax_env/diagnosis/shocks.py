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
from coax_env.model import state as S

SECONDS = 0.1
"""s between gusts of which the difference is looked at: beyond the readings' own noise; ours."""
STATES = {
    "force_xy": (S.GUST_X, S.GUST_Y), "force_z": (S.GUST_Z,),
    "moment_xy": (S.GUST_L, S.GUST_M), "moment_z": (S.GUST_N,),
}  # fmt: skip
"""Level of the gusts -> the states that it is of."""


def gust_kurtosis(problem: Problem, fit: Fit) -> float:
    """Largest excess kurtosis of the increments of the gusts as filtered; 0 where there are none.

    Args:
        problem, fit: with the causes. An axis whose level stands at a bound has no gusts.
    """
    if any(level not in fit.noise.process for level in STATES):
        return 0.0
    states = [
        state
        for level, of in STATES.items()
        if not fit.noise.at_bound(level)
        for state in of
    ]  # fmt: skip
    apart = max(round(SECONDS / median_step(problem.engine.records)), 1)
    passes = problem.engine.filter(fit.values, fit.noise)
    moved = [np.diff(run.states[::apart, states], axis=0) for run in passes]
    largest = kurtosis(np.concatenate(moved), axis=0) if states else np.zeros(0)
    return float(np.max(largest, initial=0.0))
