"""Whether each run has air of its own, asked after a search (estimation/run_air.py).

What a model lacks shakes it more on some runs than on others, which looks like rougher air on these: so
this is asked beside what was found, and the search is done again from nothing, in such air.
"""

from collections.abc import Sequence

import numpy as np

from coax_env.diagnosis.fits import fitted, noise_fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter_noise import GUST_LEVELS, MEMORIES
from coax_env.estimation.run_air import (
    gain_promised,
    in_own_air,
    strength_and_memory,
    unlikely,
)
from coax_env.estimation.state_space import Record

PROMISED, NATS_A_LEVEL = 0.5, 1.0
"""That a level of a run's own must promise beyond chance, and be worth: by chance half a nat. It was
1.8 to 3.1 on four **synthetic** flights in such air, 0.1 at most in other air; ours."""
APART = (1.5, 3.0)
"""Times that the roughest run must be as rough as the calmest, or the longest memory as long as the
shortest: less changes little, and gusts that swing want it, too (100 nats for 1.3 and 1.9 times on a
**synthetic** flight, whose spin-up reaction and frequencies were lost so); ours."""
TURNS = 2
"""Of levels of the runs and of all, at most; ours."""


def has_own_air(problem: Problem) -> bool:
    """Whether runs have levels of their own already."""
    return any(record.air for record in problem.engine.records)


def with_own_air(problem: Problem, fit: Fit) -> tuple[Problem, Fit] | None:
    """The problem whose runs have air of their own and the fit to it, where worth the threshold.

    Args:
        problem, fit: after a search.
    """
    if has_own_air(problem) or len(problem.engine.records) < 2:
        return None
    levels, chosen = _levels(fit), problem.settings
    count = len(levels) * len(problem.engine.records)
    promised = gain_promised(problem.engine, fit.values, fit.noise, levels)
    if promised < chosen.evidence + PROMISED * count:
        return None
    trial = fit
    for _ in range(TURNS):
        last = trial.objective
        problem = in_air(problem, trial)
        trial = fitted(problem, noise_fitted(problem, trial))
        if last - trial.objective < chosen.tie:
            break
    records = problem.engine.records
    gained = fit.objective - trial.objective - unlikely(records)
    problem.report(f"air of each run's own: {gained:.1f} nats")
    worth = gained > chosen.evidence + NATS_A_LEVEL * count
    return (problem, trial) if worth and _are_apart(records) else None


def _are_apart(records: Sequence[Record]) -> bool:
    of_runs = np.array([strength_and_memory(record.air) for record in records])
    return bool(np.any(of_runs.max(axis=0) > APART * of_runs.min(axis=0)))


def in_air(problem: Problem, fit: Fit) -> Problem:
    """The problem whose runs have the levels of their own that are likeliest at a fit."""
    records = in_own_air(problem.engine, fit.values, fit.noise, _levels(fit))
    return problem.with_records(records)


def like_fitted(problem: Problem, engine: Engine, fit: Fit) -> Engine:
    """An engine over records that were not fitted, in air of their own where the fitted ones are.

    Args:
        problem: as fitted. engine: over the other records. fit: of the model that flies them.
    """
    if not has_own_air(problem):
        return engine
    records = in_own_air(engine, fit.values, fit.noise, _levels(fit))
    return Engine(engine.model, records, engine.threads)


def _levels(fit: Fit) -> tuple[str, ...]:
    """Of gusts that there are: those at a bound are none."""
    felt = [name for name in GUST_LEVELS if not fit.noise.at_bound(name)]
    return (*felt, *(memory for memory in MEMORIES if memory.removeprefix("memory_") in felt))
