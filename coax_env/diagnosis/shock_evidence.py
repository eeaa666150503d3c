"""What a cause is worth in gusts of single shocks, where the model without it has its own.

Strengths of the gusts (estimation/gust_strength.py) are those of largest posterior beside the causes:
they believe the readings less where these contradict the causes. The bound that they maximise touches
the posterior there and lies below it elsewhere, so that without a cause readings are less likely at
these strengths than at the best ones without it. A centre of gravity that is not there was worth 166
nats so, on a clean **synthetic** flight in gusts from one side, and 81 where each model had its own. At
strengths taken without a cause it is worth less than that, a false one 36 nats, but true ones of 150,
82, 60, 35 and 17 were worth 0, 20, 39, 15 and 11: that tells nothing.
"""

from collections.abc import Mapping
from dataclasses import replace

from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.fits import converged
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.shocks import has_strengths, with_shocks
from coax_env.estimation.gust_strength import prior_cost

OFTEN = 10.0
"""Clear evidences from which a cause is not asked: 1,255 to 18,000 nats lost 97 to 380; ours."""


def in_own_strengths(
    problem: Problem, fit: Fit, evidence: Mapping[str, Evidence]
) -> dict[str, Evidence]:
    """The evidence of each cause where it and what is without it have strengths of their own.

    Args:
        problem, fit: with the causes.
        evidence: of each, at the strengths of the problem, with the fit without it.
    """
    most = OFTEN * problem.settings.clear
    asked = [e for e in fit.active if evidence[e].nats < most] if has_strengths(problem) else []
    if not asked:
        return dict(evidence)
    problem.report("asking what causes are worth in shocks without them")
    own, there = with_shocks(problem, fit)
    now = _cost(own, converged(own, there))

    def one(effect: str) -> Evidence:
        weighed, held = evidence[effect], tuple(problem.file_values(effect))
        assert weighed.rest is not None, "every cause was weighed"
        other, rest = with_shocks(problem, weighed.rest, held)
        lost = _cost(other, converged(other, rest, held)) - now
        return replace(weighed, lost=min(weighed.lost, lost))

    return {**evidence, **problem.for_each(one, asked)}


def _cost(problem: Problem, fit: Fit) -> float:
    """Minus the log-posterior of the fit and of the strengths that it was fitted in [nats]."""
    return fit.objective + prior_cost(problem.engine.records)
