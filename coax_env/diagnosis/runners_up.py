"""What explained about as much as an effect when that was added, tried in its place in the end.

The search exchanges by the quadratic at the fit. Where an effect is known to a thousandth of its size,
that reaches a thousand std back to nothing and as far to another effect, and says nothing any more:
turned markers (`frame_yaw`, 264 nats) and a turned swash plate (286) look alike at first, in noise
that has taken up what is wrong; with the plate in the model the markers were 805 nats likelier, and
nothing said so (**synthetic**, position and gyros read, still air).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from coax_env.diagnosis.fits import at_optimum, converged, fitted, noise_fitted
from coax_env.diagnosis.moves import BEHIND, FAR_STEPS, FAR_TURNS
from coax_env.diagnosis.problem import Fit, Problem, exclusive_with
from coax_env.diagnosis.scores import Score, is_large, loss
from coax_env.estimation.quadratic import Quadratic

SHARE = 0.5
"""Of what the added effect explains, that another must explain to be one; ours."""
FAR_OFF = 450.0
"""nats that an effect is worth by the quadratic, from which on that is not believed about what else may
stand in its place: thirty std from nothing, where a tenth of curvature is 45 nats; ours."""

RunnersUp = Mapping[str, Mapping[str, float]]
"""Effect -> its numbers where the fit stood when another was added."""


def runners_up(
    problem: Problem, fit: Fit, quadratic: Quadratic, strong: Sequence[Score]
) -> RunnersUp:
    """Of the effects that may be added those that explain about as much as the first.

    Args:
        problem, fit: what may be free, and where. quadratic: linearised at the fit.
        strong: with enough evidence, the one that is added first.
    """
    found = {}
    for other in strong[1:]:
        if other.nats < SHARE * strong[0].nats or problem.file_values(other.effect):
            continue
        there = at_optimum(problem, fit, quadratic, (*fit.active, other.effect), {})
        found[other.effect] = {f.name: there.values[f.name] for f in problem.own[other.effect]}
    return found


def exchanged(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, others: RunnersUp
) -> Fit | None:
    """The fit with one of its runners-up in an effect's place, where that is likelier in the end.

    Args:
        problem, fit: what may be free, and where; fitted. quadratic: linearised at the fit.
        effect: an active one. others: its runners-up.
    """
    if loss(problem, quadratic, fit.active, effect, 1.0) < FAR_OFF:
        return None
    for other, numbers in others.items():
        rest = set(fit.rest(effect))
        if other in rest or other not in problem.candidates or exclusive_with(other) & rest:
            continue
        trial = _in_place_of(problem, fit, effect, other, numbers)
        gained = fit.objective - trial.objective
        if gained > problem.settings.tie and is_large(problem, other, trial.values):
            problem.report(
                f"{other} explains it better than {effect}, by {gained:.1f} nats in the end"
            )
            return trial.noted(f"{effect} -> {other}", gained)
    return None


def _in_place_of(
    problem: Problem, fit: Fit, effect: str, other: str, numbers: Mapping[str, float]
) -> Fit:
    """The fit with another effect, begun at these numbers; it converges unless it stays far behind."""
    active = tuple(other if e == effect else e for e in fit.active)
    gone = problem.off_values(effect) | problem.file_values(effect)
    trial = replace(fit.at({**gone, **numbers}), active=active)
    for _ in range(FAR_TURNS):
        trial = fitted(problem, noise_fitted(problem, fitted(problem, trial, FAR_STEPS)))
        if not trial.objective < fit.objective + BEHIND * problem.settings.tie:
            return trial
    return converged(problem, trial)
