"""Another effect in the place of one, begun far from where the search stands, and fitted to the end.

The search exchanges effects by the quadratic at the fit (`moves.swaps`), which does not reach

- from a limited rate of a servo to a lag or delay: the slope in a rate is that of the few moments at
  the limit, so that it begins at its likeliest size (`far_swap`);
- from an effect that is known to a thousandth of its size back to nothing, and as far to another one:
  what explained about as much when it was added is tried in its place (`exchanged`). Turned markers
  (`frame_yaw`, 264 nats) and a turned swash plate (286) look alike at first, in noise that has taken up
  what is wrong; with the plate in the model the markers were 805 nats likelier, and nothing said so
  (**synthetic**, position and gyros read, still air);
- to what no slope shows from where it is not (`FAR`), among the alternatives of what is named
  (confounding.py).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from scipy.optimize import minimize_scalar

from coax_env.diagnosis.fits import (
    at_optimum,
    converged,
    fitted,
    noise_fitted,
    quadratic_at,
    without,
)
from coax_env.diagnosis.problem import (
    LATE_SERVO,
    SERVO_FORMS,
    SERVO_RATE,
    Fit,
    Problem,
    exclusive_with,
)
from coax_env.diagnosis.scores import Score, cost, is_large, loss
from coax_env.estimation.quadratic import Quadratic

REACH = 4.0
"""Times its usual size, and that part of it, between which a number is looked for; ours."""
WITHIN = 0.02
"""Of its logarithm, to which it is; ours."""
TURNS = 2
"""Of likeliest sizes or noise levels and all other numbers, before it converges; ours."""
STEPS = 6
"""Gauss-Newton steps of a fit that begins far from where the search stands; ours."""
BEHIND = 5.0
"""Ties by which it may be less likely then, before noise levels have converged; ours."""
SHARE = 0.5
"""Of what an added effect explains, that another must explain to be its runner-up; ours."""
TURNED = ("swash_phase", "frame_yaw")
"""Of which each is the other's runner-up, however little it explains at first, and begun at its angle:
a machine that is flown by its position looks the same with either. At 50 rows a second, in still air,
the quadratic had turned markers of 0.15 rad at 0.02, too small to matter, and no name was given; at 25
Hz those of -0.1, at -0.003, were a sure swash phase (**synthetic**)."""
FAR_OFF = 450.0
"""nats that an effect is worth by the quadratic, from which on that is not believed about what else may
stand in its place: thirty std from nothing, where a tenth of curvature is 45 nats; ours."""
FAR: Mapping[str, frozenset[str]] = {
    "thrust_exponent": frozenset({"dynamic_inflow"}),
    SERVO_RATE: frozenset(SERVO_FORMS),
}
"""Alternatives that no slope shows from where they are not, nor a quadratic reaches: of a limited rate
what else makes a servo late; of thrust that answers quick changes of speed by more than slow ones an
inflow, which follows late by any time, and how far thrust overshoots hardly depends on it: of six
**synthetic** inflows of 0.1 to 0.24 s four were an exponent of 4 to 5 usual sizes."""

RunnersUp = Mapping[str, Mapping[str, float]]
"""Effect -> its numbers where the fit stood when another was added."""


def far_swap(problem: Problem, fit: Fit, quadratic: Quadratic) -> Fit | None:
    """What makes a servo late in the place of what else does (LATE_SERVO), from its likeliest size.

    Gauss-Newton's steps end at 1.07 rad/s on the way from 1 to 1.33 (**synthetic**).

    Args:
        problem, fit: what may be free, and where; converged.
        quadratic: linearised at the fit.
    """
    for old, new in _late_pairs(problem, fit):
        trial = in_place_of(problem, fit, quadratic, old, new)
        taken = _taken(problem, trial, fit.objective - trial.objective, old, new)
        if taken is not None:
            return taken
    return None


def runners_up(
    problem: Problem, fit: Fit, quadratic: Quadratic, strong: Sequence[Score]
) -> RunnersUp:
    """Of the effects that may be added those that explain about as much as the first, or turn alike.

    Args:
        problem, fit: what may be free, and where. quadratic: linearised at the fit.
        strong: with enough evidence, the one that is added first.
    """
    near = [s.effect for s in strong[1:] if s.nats >= SHARE * strong[0].nats]
    if strong[0].effect in TURNED:
        near += [e for e in TURNED if e in problem.candidates and e not in fit.active]
    found = {}
    for effect in dict.fromkeys(near):
        if effect == strong[0].effect or problem.file_values(effect):
            continue
        there = at_optimum(problem, fit, quadratic, (*fit.active, effect), {})
        found[effect] = {f.name: there.values[f.name] for f in problem.own[effect]}
    return found


def exchanged(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, others: RunnersUp
) -> Fit | None:
    """The fit with one of its runners-up in an effect's place, where that has more evidence in the end.

    Args:
        problem, fit: what may be free, and where; fitted. quadratic: linearised at the fit.
        effect: an active one. others: its runners-up.
    """
    if problem.changes(effect) or loss(problem, quadratic, fit.active, effect, 1.0) < FAR_OFF:
        return None  # what changes in flight has a size before and one after
    gone = problem.off_values(effect) | problem.file_values(effect)
    for other, numbers in others.items():
        rest = set(fit.rest(effect))
        absent = other in problem.candidates and other not in rest
        if not absent or problem.changes(other) or exclusive_with(other) & rest:
            continue
        if {effect, other} <= set(TURNED):
            numbers = {**numbers, f"{other}.angle": fit.values[f"{effect}.angle"]}
        begun = replace(fit.at({**gone, **numbers}), active=fit.instead(effect, other))
        trial = _to_the_end(problem, fit, begun, lambda trial: _in_own_noise(problem, trial))
        trial, there = quadratic_at(problem, trial)
        gained = cost(problem, fit, quadratic) - cost(problem, trial, there)
        taken = _taken(problem, trial, gained, effect, other)
        if taken is not None:
            return taken
    return None


def in_place_of(problem: Problem, fit: Fit, quadratic: Quadratic, old: str, new: str) -> Fit:
    """The fit with one effect in another's place, begun at its likeliest size.

    Args:
        problem, fit: what may be free, and where. quadratic: linearised at the fit.
        old: an active effect. new: one with one number, that is not active.
    """
    begun = without(problem, fit, quadratic, old)
    begun = replace(begun, active=fit.instead(old, new))
    return _to_the_end(
        problem, fit, begun, lambda trial: fitted(problem, likeliest(problem, trial, new))
    )


def likeliest(problem: Problem, fit: Fit, effect: str) -> Fit:
    """The fit at the likeliest size of an effect's one number, all else held.

    Args:
        problem, fit: what may be free, and where. effect: with one number.
    """
    (number,) = problem.own[effect]

    def at(logarithm: float) -> Fit:
        return fit.at({number.name: math.exp(logarithm)})

    def cost(logarithm: float) -> float:
        return -problem.engine.log_likelihood(at(logarithm).values, fit.noise)

    usual = number.value + number.probe
    found = minimize_scalar(
        cost, bounds=(math.log(usual / REACH), math.log(usual * REACH)), method="bounded",
        options={"xatol": WITHIN},
    )  # fmt: skip
    return at(float(found.x))


def _late_pairs(problem: Problem, fit: Fit) -> list[tuple[str, str]]:
    """What makes a servo late, and what may stand in its place; lag and delay are near each other."""
    return [
        (old, new)
        for old in fit.active
        if old in LATE_SERVO and not problem.changes(old)
        for new in LATE_SERVO
        if SERVO_RATE in (old, new) and new in problem.candidates
        if new not in fit.active and not problem.changes(new)
        if not exclusive_with(new) & set(fit.rest(old))
    ]


def _in_own_noise(problem: Problem, fit: Fit) -> Fit:
    return fitted(problem, noise_fitted(problem, fitted(problem, fit, STEPS)))


def _to_the_end(problem: Problem, fit: Fit, trial: Fit, turn: Callable[[Fit], Fit]) -> Fit:
    """A trial after some turns, converged unless it stays far behind the fit."""
    for _ in range(TURNS):
        trial = turn(trial)
        if not trial.objective < fit.objective + BEHIND * problem.settings.tie:
            return trial
    return converged(problem, trial)


def _taken(problem: Problem, trial: Fit, gained: float, old: str, new: str) -> Fit | None:
    """The trial, where it gains more than a tie and what came matters."""
    if not gained > problem.settings.tie or not is_large(problem, new, trial.values):
        return None
    problem.report(f"{new} explains it better than {old}, by {gained:.1f} nats in the end")
    return trial.noted(f"{old} -> {new}", gained)
