"""The final Newton refinement: slope and curvature of the likelihood itself in the effects' parameters.

Signatures hold the filter's gains fixed. What an effect does to the gains is small, and zero on
average, but on a gusty flight it can be a standard deviation. The slope by differences of whole filter
passes has it in, and so has the curvature. Coloured innovations say that the gains are not those of
the true noise: then that part of the slope is no more than a bias, and is left out.

A number over which the likelihood is rough has its best and its std over several std
(estimation/rough_numbers.py).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.fits import fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.engine import objective
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.rough_numbers import is_rough, top_of
from coax_env.estimation.state_space import FreeParameter
from coax_env.estimation.whiteness import is_white


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
    for name in [f.name for e in fit.active for f in problem.own[e] if is_rough(f.name)]:
        top = top_of(problem.engine, free, fit.values, fit.noise, name)
        fit = replace(fit.at(top.values), objective=top.objective)
        if top.std_ratio is not None:
            fit = replace(fit, std_ratio={**fit.std_ratio, name: top.std_ratio})
    return fit
