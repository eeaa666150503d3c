"""What each cause is worth once everything else, noise levels too, is refitted without it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from coax_env.diagnosis.fits import converged, fitted, linearise, noise_fitted, without
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.refinement import refined
from coax_env.diagnosis.scores import inflation, loss
from coax_env.estimation.quadratic import Quadratic


@dataclass(frozen=True)
class Evidence:
    """What a cause is worth. lost: nats without it. inflation: variance inflation in its direction."""

    lost: float
    inflation: float

    @property
    def nats(self) -> float:
        """What coloured innovations leave of what is lost."""
        return self.lost / self.inflation


@dataclass(frozen=True)
class Weighed:
    """What a cause is worth, and the fit without it."""

    evidence: Evidence
    rest: Fit


def weigh(
    problem: Problem, fit: Fit, quadratic: Quadratic, which: Sequence[str]
) -> dict[str, Weighed]:
    """Evidence of active effects, each from a refit without it.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        which: the effects.
    """
    chosen = problem.settings

    def one(effect: str) -> Weighed:
        held = tuple(problem.file_values(effect))
        factor = inflation(problem, quadratic, fit.active, effect)
        rest = noise_fitted(problem, without(problem, fit, quadratic, effect))
        rest = fitted(problem, rest, steps=1, held=held)
        if rest.objective - fit.objective < chosen.clear_evidence * chosen.evidence * factor:
            rest = converged(problem, rest, held)
        return Weighed(Evidence(float(rest.objective - fit.objective), factor), rest)

    return problem.for_each(one, which)


def prune(problem: Problem, fit: Fit) -> tuple[Fit, Quadratic, dict[str, Evidence]]:
    """Remove, one at a time, causes whose evidence is gone once the noise levels are fitted too.

    What is in doubt by the quadratic is weighed first: the clear ones wait until nothing is removed.

    Returns:
        the refined fit, the quadratic at it, and the evidence of what is left.
    """
    while True:
        fit = refined(problem, converged(problem, fit))
        fit, _, quadratic = linearise(problem, fit)
        doubtful = [e for e in fit.active if _is_doubtful(problem, fit, quadratic, e)]
        weighed: dict[str, Weighed] = {}
        for which in (doubtful, [e for e in fit.active if e not in doubtful]):
            weighed |= weigh(problem, fit, quadratic, which)
            better = _better(problem, fit, weighed)
            if better is not None:
                fit = better
                break
        else:
            return fit, quadratic, {e: weighed[e].evidence for e in fit.active}


def _is_doubtful(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str) -> bool:
    """Whether a cause is not worth several thresholds by the quadratic."""
    factor = inflation(problem, quadratic, fit.active, effect)
    worth = loss(problem, quadratic, fit.active, effect, factor)
    return worth < problem.settings.clear_evidence * problem.settings.evidence


def _better(problem: Problem, fit: Fit, weighed: Mapping[str, Weighed]) -> Fit | None:
    """A fit to go on from: with noise levels of larger likelihood, else without the weakest cause.

    A model with one cause less cannot be likelier but by its noise levels: the fit's have then not
    converged, and the cause has its say beside better ones before it may be removed.
    """
    if not weighed:
        return None
    weakest = min(weighed, key=lambda e: weighed[e].evidence.nats)
    evidence, rest = weighed[weakest].evidence, weighed[weakest].rest
    if evidence.lost < -problem.settings.tie:
        again = converged(problem, replace(fit, noise=rest.noise))
        if again.objective < fit.objective - problem.settings.tie:
            return again
    if evidence.nats >= problem.settings.evidence:
        return None
    problem.report(f"dropped {weakest}: worth {evidence.nats:.1f} nats in the end")
    return rest.noted(f"- {weakest}", max(evidence.nats, 0.0))
