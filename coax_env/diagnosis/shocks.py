"""Whether gusts come in single shocks, of which a likelihood of Gaussian noise knows nothing.

One gust that stands out of the others is then a push on one run, and some effect always fits such
pushes a little. Measured on clean synthetic flights of 108 s (`study_diagnosis.py --seed 52`, three of
each arm): the largest excess kurtosis of an axis is 0.1 to 0.6 where gusts have an exponential memory,
0.6 to 2.4 in Dryden turbulence, 5.9 to 10 of 1-cosine gusts, 6 to 154 of heavy-tailed ones. Where they
do, each block of time gets a strength of its own (estimation/gust_strength.py).
"""

from collections.abc import Collection, Sequence

import numpy as np
from scipy.stats import kurtosis

from coax_env.diagnosis.fits import fitted, noise_fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.run_air import has_own_air, like_fitted
from coax_env.estimation.engine import Engine
from coax_env.estimation.gust_strength import with_strengths
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.helicopter_noise import GUST_AXES
from coax_env.estimation.state_space import Record
from coax_env.model.layout import GUSTS, N_FULL

SECONDS = 0.1
"""s between gusts of which the difference is looked at: beyond the readings' own noise; ours."""
ABOUT = 0.5
"""s between two moments that may be one, as a filter sees it; ours."""
ROUNDS = 3
"""Of strengths and levels by turns: a level that strengths make smaller shows more of them; ours."""


def in_shocks(problem: Problem, fit: Fit) -> bool:
    """Whether some axis' gusts come in shocks that no strengths speak for."""
    return not has_strengths(problem) and gust_kurtosis(problem, fit) > problem.settings.shocks


def gust_kurtosis(problem: Problem, fit: Fit) -> float:
    """Largest excess kurtosis of the increments of the gusts as filtered; 0 where there are none.

    Args:
        problem, fit: with the causes.
    """
    return _largest_kurtosis(np.concatenate(_increments(problem, fit)))


def only_shock(problem: Problem, fit: Fit) -> Moment | None:
    """When the shock was without which there are none; None where there are others.

    Args:
        problem, fit: with the causes, in shocks.
    """
    of_runs = _increments(problem, fit)
    moved = np.concatenate(of_runs)
    row = int(np.argmax(np.max(np.abs(moved) / np.std(moved, axis=0), axis=1)))
    near = round(ABOUT / SECONDS)
    rest = np.delete(moved, slice(max(row - near, 0), row + near + 1), axis=0)
    if _largest_kurtosis(rest) > problem.settings.shocks:
        return None
    ends = np.cumsum([len(own) for own in of_runs])
    run = int(np.searchsorted(ends, row, side="right"))
    record, row = problem.engine.records[run], row - int(ends[run]) + len(of_runs[run])
    return Moment(record.whole, float(record.t[row * _apart(problem)]))


def _increments(problem: Problem, fit: Fit) -> list[np.ndarray]:
    """Of each run, (rows, axes) how far the gusts have moved since SECONDS before.

    In air of each run's own over what is usual on the run, or the roughest ones would be shocks.
    """
    moving, apart = _moving(fit), _apart(problem)
    passes = problem.engine.filter(fit.values, fit.noise)
    moved = [np.diff(run.states[::apart, moving], axis=0) for run in passes]
    return [own / np.std(own, axis=0) for own in moved] if has_own_air(problem) else moved


def _apart(problem: Problem) -> int:
    return max(round(SECONDS / problem.row), 1)


def _largest_kurtosis(moved: np.ndarray) -> float:
    return float(np.max(kurtosis(moved, axis=0), initial=0.0)) if moved.size else 0.0


def with_shocks(problem: Problem, fit: Fit, held: Collection[str] = ()) -> tuple[Problem, Fit]:
    """The problem with a strength of the gusts for each block of time, and the fit to it.

    Args:
        problem, fit: with the causes. held: names of free parameters that stay.
    """
    for _ in range(ROUNDS):
        records = with_strengths(problem.engine, fit.values, fit.noise, _moving(fit))
        problem = problem.with_records(records)
        fit = noise_fitted(problem, fitted(problem, fit, held=held))
    return problem, fit


def engine_of(problem: Problem, records: Sequence[Record], fit: Fit) -> Engine:
    """An engine over other records, their air and strengths fitted where those of the problem are.

    Args:
        problem: whose model it has. records: that were not fitted. fit: of the model that flies them.
    """
    engine = like_fitted(problem, Engine(problem.model, records), fit)
    if not has_strengths(problem):
        return engine
    shaken = with_strengths(engine, fit.values, fit.noise, _moving(fit))
    return Engine(problem.model, shaken)


def has_strengths(problem: Problem) -> bool:
    """Whether blocks of time have strengths of their own."""
    return not problem.engine.records[0].strength.steady


def _moving(fit: Fit) -> np.ndarray:
    """Gust states whose level is not at a bound; at one, an axis has no gusts."""
    return np.arange(N_FULL)[GUSTS][[not fit.noise.at_bound(level) for level in GUST_AXES]]
