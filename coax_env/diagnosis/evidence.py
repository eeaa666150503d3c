"""What each cause is worth once everything else, noise levels too, is refitted without it.

A cause must be worth the threshold twice: to the likelihood of the readings alone, and where commands
show the gusts (input_innovations.py) with that too. Alone, a pilot who flies the gusts out looks like a
late servo. With it, a damping: the gains are constant and the filter's covariances do not know of them,
so that readings correct once more what the commands have corrected, and a rate that is damped takes
half of it back. `rate_damping` was worth 44 and 50 nats so on clean synthetic flights by telemetry
where, alone, it was worth less than nothing.
"""

from dataclasses import dataclass, replace

from coax_env.diagnosis.fits import converged, fitted, linearise, noise_fitted, without
from coax_env.diagnosis.input_innovations import has_command_gains, with_command_gains
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.refinement import refined
from coax_env.diagnosis.scores import inflation
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


def weigh(problem: Problem, fit: Fit, quadratic: Quadratic) -> dict[str, Evidence]:
    """Evidence of every active effect.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
    """
    chosen = problem.settings

    def one(effect: str) -> Evidence:
        held = tuple(problem.file_values(effect))
        factor = inflation(problem, quadratic, fit.active, effect)
        rest = noise_fitted(problem, without(problem, fit, quadratic, effect))
        rest = fitted(problem, rest, steps=1, held=held)
        if rest.objective - fit.objective < chosen.clear_evidence * chosen.evidence * factor:
            rest = converged(problem, rest, held)
        return Evidence(float(rest.objective - fit.objective), factor)

    return problem.for_each(one, fit.active)


def prune(problem: Problem, fit: Fit) -> tuple[Fit, Quadratic, dict[str, Evidence]]:
    """Remove, one at a time, causes whose evidence is gone once the noise levels are fitted too.

    Returns:
        the refined fit, the quadratic at it, and the evidence of what is left.
    """
    while True:
        fit = refined(problem, converged(problem, fit))
        fit, _, quadratic = linearise(problem, fit)
        evidence = weigh(problem, fit, quadratic)
        weakest = min(evidence, key=lambda e: evidence[e].nats, default=None)
        if weakest is None or evidence[weakest].nats >= problem.settings.evidence:
            return fit, quadratic, evidence
        nats = evidence[weakest].nats
        problem.report(f"dropped {weakest}: worth {nats:.1f} nats in the end")
        fit = _dropped(problem, fit, weakest).noted(f"- {weakest}", max(nats, 0.0))


def weighed(problem: Problem, fit: Fit) -> tuple[Problem, Fit, Quadratic, dict[str, Evidence]]:
    """The causes that stand by the readings alone and with the gains of the commands, where those are.

    Args:
        problem, fit: after the search, without such gains.

    Returns:
        the problem, with the gains where they are worth it and innovations white, and what `prune` has
        of it.
    """
    while True:
        wider, trial = with_command_gains(problem, fit)
        if not fit.active:
            return wider, *prune(wider, trial)
        stated = has_command_gains(wider)
        if not stated:  # colour spoils them for a model, not for the question
            wider, trial = with_command_gains(problem, fit, coloured=True)
        joint = prune(wider, trial)
        standing = joint[0].active
        if not has_command_gains(wider) or (stated and not standing):
            return wider, *joint
        for effect in set(fit.active) - set(standing):
            fit = _dropped(problem, fit, effect)
        alone = prune(problem, fit)
        fit = alone[0]
        if fit.active == standing:
            return (wider, *joint) if stated else (problem, *alone)


def _dropped(problem: Problem, fit: Fit, effect: str) -> Fit:
    off = problem.off_values(effect) | problem.file_values(effect)
    return replace(fit.at(off), active=fit.rest(effect))
