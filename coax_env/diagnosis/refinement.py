"""The final Newton refinement: slope and curvature of the likelihood itself in the effects' parameters.

Signatures hold the filter's gains fixed. What an effect does to the gains is small, and zero on
average, but on a gusty flight it can be a standard deviation. The slope by differences of whole filter
passes has it in, and so has the curvature. Coloured innovations say that the gains are not those of
the true noise: then that part of the slope is no more than a bias, and is left out.

Where a linkage's play lets go depends on every twitch of the command: over less than a milliradian its
likelihood is as rough as noise (ROUGH). Signatures and small differences see the roughness: of eight
**synthetic** flights with play two had it 5 and 8 std off, 0.0163 +- 0.0003 rad for 0.0212, where the
likelihood over several milliradians has 0.018 +- 0.0017. So that is a parabola through points which lie
some nats lower.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from coax_env.diagnosis.fits import fitted
from coax_env.diagnosis.problem import ROUGH, Fit, Problem
from coax_env.estimation.engine import objective
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter
from coax_env.estimation.whiteness import is_white

FALL = 4.0
"""nats by which the likelihood is to fall to either side of a rough number: more than it is rough."""
MOST_DOUBLED = 5
"""Times that a step of one std is doubled until it does; ours."""
BESIDE = (-1.0, -0.7, -0.4, 0.4, 0.7, 1.0)
"""Points of the parabola, in steps. Where the fit ended is none: that is the top of a spike; ours."""


def refined(problem: Problem, fit: Fit) -> Fit:
    """Fitted to the end, effects' parameters by the slope of the likelihood itself.

    Sets `Fit.std_ratio`.
    """
    return _over_roughness(problem, _refined(problem, fit))


def _refined(problem: Problem, fit: Fit) -> Fit:
    """`refined`, as if no likelihood were rough."""
    engine, chosen = problem.engine, problem.settings
    fit = replace(fit, std_ratio={})
    own = [f for e in fit.active for f in problem.own[e]]
    free = problem.free(fit.active)
    passes, lin = engine.linearise(fit.values, fit.noise, free, gains=False)
    if not own or not is_white(passes, engine.model.channels):
        return fitted(problem, fit, chosen.most_steps, chosen.refinement_gain)
    names = [f.name for f in free]
    missing = np.zeros(len(names))  # of the slope with the gains held; it hardly changes on the way
    for count in range(chosen.most_refinements):
        if count:
            passes, lin = engine.linearise(fit.values, fit.noise, free, gains=False)
        quadratic = Quadratic.of(lin, free, fit.values)
        if count == 0:
            fit = replace(fit, objective=objective(passes, free, fit.values))
            missing, std_ratio = _likelihood_derivatives(problem, fit, quadratic, free, own)
            fit = replace(fit, std_ratio=std_ratio)
        _, move = replace(quadratic, g=quadratic.g + missing).best(names)
        moved, gained = _line_search(problem, fit, quadratic, free, move)
        if gained > 0.0:
            fit = replace(moved, objective=fit.objective - gained)
        if gained < chosen.refinement_gain:
            break
    return fit


def _line_search(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    free: Sequence[FreeParameter],
    move: np.ndarray,
) -> tuple[Fit, float]:
    """The fit after a move, shortened once where it gains nothing, and the gain [nats]."""
    for share in (1.0, 0.4):
        there = fit.at(quadratic.moved(share * move))
        passes = problem.engine.filter(there.values, fit.noise)
        gained = fit.objective - objective(passes, free, there.values)
        if gained > 0.0:
            break
    return there, gained


def _likelihood_derivatives(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    free: Sequence[FreeParameter],
    own: Sequence[FreeParameter],
) -> tuple[np.ndarray, dict[str, float]]:
    """What the likelihood's slope has beyond the quadratic's, (k,), and `Fit.std_ratio`.

    By differences inside the bounds, along the profile of each of `own`, on which all others are at
    their optimum: the curvature there is one over its variance.
    """
    chosen = problem.settings
    covariance = quadratic.covariance(quadratic.names)
    profiles = covariance / np.diag(covariance)  # a column each
    mine = quadratic.index([f.name for f in own])
    pull = quadratic.g + quadratic.precision * (quadratic.at - quadratic.mean)
    beyond, std_ratio = np.zeros(len(own)), {}
    for j, (k, f) in enumerate(zip(mine, own, strict=True)):
        step = chosen.difference_step * math.sqrt(covariance[k, k])
        ends = min(step, f.upper - quadratic.at[k]), max(-step, f.lower - quadratic.at[k])
        if ends[0] <= ends[1]:
            continue
        costs = []
        for end in ends:
            moved = np.clip(quadratic.at + end * profiles[:, k], quadratic.lower, quadratic.upper)
            there = {**fit.values, **dict(zip(quadratic.names, moved.tolist(), strict=True))}
            costs.append(objective(problem.engine.filter(there, fit.noise), free, there))
        beyond[j] = (costs[0] - costs[1]) / (ends[0] - ends[1]) - pull @ profiles[:, k]
        curvature = costs[0] + costs[1] - 2.0 * fit.objective
        if ends == (step, -step) and curvature > 0.0:
            ratio = chosen.difference_step / math.sqrt(curvature)
            std_ratio[f.name] = float(np.clip(ratio, *chosen.std_ratio_bounds))
    missing = np.zeros(len(free))
    missing[mine] = np.linalg.lstsq(profiles[np.ix_(mine, mine)].T, beyond, rcond=None)[0]
    return missing, std_ratio


def _over_roughness(problem: Problem, fit: Fit) -> Fit:
    """The fit with rough numbers at the top of their parabola, where that is likelier, and its std."""
    free = problem.free(fit.active)
    for f in [f for e in fit.active if e in ROUGH for f in problem.own[e]]:
        _, lin = problem.engine.linearise(fit.values, fit.noise, free, gains=False)
        fit = _of_parabola(problem, fit, Quadratic.of(lin, free, fit.values), f)
    return fit


def _of_parabola(problem: Problem, fit: Fit, quadratic: Quadratic, number: FreeParameter) -> Fit:
    """`_over_roughness` of one number, all others at their optimum by the quadratic.

    A fit that stays beside the top is as unsure as that is far.
    """
    free = problem.free(fit.active)
    k = int(quadratic.index([number.name])[0])
    covariance = quadratic.covariance(quadratic.names)
    std, profile = math.sqrt(covariance[k, k]), covariance[k] / covariance[k, k]

    @cache
    def moved(by: float) -> Fit:
        along = np.clip(quadratic.at + by * profile, quadratic.lower, quadratic.upper)
        there = fit.at(dict(zip(quadratic.names, along.tolist(), strict=True)))
        passes = problem.engine.filter(there.values, there.noise)
        return replace(there, objective=objective(passes, free, there.values))

    fit = moved(0.0)
    step = std
    for _ in range(MOST_DOUBLED):
        fallen = moved(step).objective + moved(-step).objective - 2.0 * fit.objective
        if fallen >= 2.0 * FALL:
            break
        step *= 2.0
    points = step * np.array(BESIDE)
    curvature, slope, _ = np.polyfit(points, [moved(by).objective for by in points], 2)
    if not curvature > 0.0:
        return fit
    off = float(np.clip(-0.5 * slope / curvature, -step, step))
    top = moved(off)
    apart = math.sqrt(0.5 / curvature)
    if top.objective < fit.objective:
        fit = top
    else:
        apart = math.hypot(apart, off)
    ratios = {**fit.std_ratio, number.name: max(apart / std, 1.0)}
    return replace(fit, std_ratio=ratios)
