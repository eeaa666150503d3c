"""Gains of the input innovations (estimation/input_innovations.py), where they are worth it.

What the commands show of the machine beyond what the readings do corrects the filter's state, by gains
that are fitted with everything else.
"""

from collections.abc import Sequence

from coax_env.diagnosis.fits import fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.shocks import engine_of
from coax_env.estimation.engine import Engine
from coax_env.estimation.input_innovations import (
    innovations,
    sampled_passes,
    shown_by_commands,
    with_innovations,
)
from coax_env.estimation.state_space import Record
from coax_env.estimation.whiteness import is_white
from coax_env.model import parameters as P


def with_command_gains(problem: Problem, fit: Fit, coloured: bool = False) -> tuple[Problem, Fit]:
    """Fit the gains of the input innovations, where that gains more than a tie.

    Only where the innovations of the readings are white: what a model gets wrong follows the commands
    too, and the gains would explain it away.

    Args:
        problem, fit: after the search.
        coloured: fit them where innovations are not white, too: to ask names, not to be stated.

    Returns:
        the problem with input innovations in its records and the gains free, and the fit with them;
        both as they were where that gains nothing.
    """
    passes = sampled_passes(problem.engine, fit.values, fit.noise)
    if not coloured and not is_white(passes, problem.model.channels):
        return problem, fit
    records, gains = shown_by_commands(problem.engine, passes)
    wider = problem.with_records(records).with_free(gains)
    tie = problem.settings.tie
    trial = fitted(wider, fit.at({n: fit.values.get(n, 0.0) for n in P.COMMAND_GAINS}),
                   tolerance=0.5 * tie)  # fmt: skip
    gained = fit.objective - trial.objective
    if not gained > tie:  # none of two fits whose filters diverge
        return problem, fit
    problem.report(f"the commands carry information on the gusts: {gained:.1f} nats")
    return wider, trial


def has_command_gains(problem: Problem) -> bool:
    """Whether the gains of the input innovations are fitted."""
    return any(f.name in P.COMMAND_GAINS for f in problem.added)


def engine_as_fitted(problem: Problem, records: Sequence[Record], fit: Fit) -> Engine:
    """An engine over other records, with all that the fitted ones have: strengths, input innovations.

    Args:
        problem: as fitted. records: that were not fitted. fit: of the model that flies them.
    """
    engine = engine_of(problem, records, fit)
    return with_input_innovations(engine, fit) if has_command_gains(problem) else engine


def with_input_innovations(engine: Engine, fit: Fit) -> Engine:
    """The engine with the input innovations at a fit in its records."""
    found = innovations(sampled_passes(engine, fit.values, fit.noise))
    return Engine(engine.model, with_innovations(engine.records, found), engine.threads)
