"""Whether rotor speeds jitter, asked after a search (estimation/rotor_jitter.py).

Beside what was found, and in the place of what jitter looks like: a yaw rate that is shaken and comes
back is a damped one under white noise, and once both are fitted jitter gains nothing beside them.
"""

import math
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from coax_env.diagnosis.fits import fitted, noise_fitted, only, without
from coax_env.diagnosis.problem import OF_ROTORS, WEAK_OR_LATE, Fit, Problem
from coax_env.estimation.helicopter_noise import (
    JITTER_LEVEL,
    JITTER_MEMORY,
    JITTER_REACTION,
    JITTER_RETURN,
)
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.rotor_jitter import (
    REACTION,
    REACTION_BOUNDS,
    REACTION_STD,
    JitteryModel,
    with_jitter,
)
from coax_env.estimation.state_space import Noise
from coax_env.estimation.wrapping_model import with_innermost

STANDING_IN = "white_moment_z"
"""The level that stands for a jitter's reaction where there is none."""
LEFT_BESIDE, LEFT_INSTEAD = 0.3, 0.0
"""Share of that from which jitter is fitted, or it would stay what it has become; ours. On four
**synthetic** flights whose rotors jitter beside names 2, 26, 79 and 9,400 nats from there for 2, 10, 77
and 9,100 from all of it, and 22 for -18 in the place of names."""
TURNS = 2
"""Of levels and numbers; ours."""
LOOKED_AT = (0.4, 1.0)
"""Shares that motors make of it between which the likelihood may have two summits: on a flight of
another simulator (`tests/blade_element.py`, **synthetic**), whose air shakes the rotors, one at 0.07
and one at 2, 1,064 nats lower, with a spin-up reaction of 1.48 +- 0.10 for 1; ours."""
WITHIN = 0.05
"""Of the body's share of the rotors' angular momentum, to which it is looked for; ours."""


def in_jitter(problem: Problem, fit: Fit, quadratic: Quadratic) -> tuple[Problem, Fit] | None:
    """The problem whose rotors jitter and the fit to it, where that is worth more than a tie.

    Args:
        problem, fit: after a search. quadratic: linearised there.
    """
    if JITTER_LEVEL in fit.noise.process:
        return None
    wider = problem.with_model(with_innermost(problem.model, JitteryModel))
    trial = _fitted(wider, fit, LEFT_BESIDE)
    alike = [effect for effect in fit.active if effect in WEAK_OR_LATE]
    if alike and fit.objective - trial.objective < problem.settings.tie:
        trial = _fitted(wider, without(problem, fit, quadratic, *alike), LEFT_INSTEAD)
    gained = fit.objective - trial.objective
    problem.report(f"rotor speeds that jitter: {gained:.1f} nats")
    return (wider, trial) if gained > problem.settings.tie else None


def with_share_anew(problem: Problem, fit: Fit, noise: Noise) -> Noise:
    """Levels to start from, with the motors' share of the jitter as this problem's readings show it.

    What the body takes up of a jitter is read by the gyros. Before these were taken back through their
    low-pass, or had errors that last, it was another share, which a search keeps; and gyros that scale
    stand for what is left: on a clean **synthetic** flight (`--arms mixed`, seed 798, clean 52) by 16 %
    beside a magnetic field, 196 and 114 nats, where a share of 1.06 for 0.90 is 240 nats likelier
    without either.

    Args:
        problem: with readings as they are now. fit: after a search in them as they were.
        noise: levels to start from, with jitter or without.
    """
    if JITTER_LEVEL not in noise.process:
        return noise
    return share_of(_in_turns(problem, only(problem, fit, OF_ROTORS)), noise)


def share_of(fit: Fit, noise: Noise) -> Noise:
    """Levels to start from, with the motors' share of a fit's jitter, if it has one.

    Args:
        fit: whose share that is. noise: the levels.
    """
    if JITTER_LEVEL not in noise.process:
        return noise
    kept = (JITTER_REACTION, JITTER_RETURN)
    return noise.with_levels({name: fit.noise.level(name) for name in kept})


def _fitted(wider: Problem, fit: Fit, left: float) -> Fit:
    """With jitter, from a share of the white noise that stood for it."""
    noise = with_jitter(fit.noise, wider.model)
    least = max(left * noise.level(STANDING_IN), noise.floor[STANDING_IN])
    levels = (*fit.levels, JITTER_LEVEL, JITTER_MEMORY)
    return _in_turns(
        wider, replace(fit, noise=noise.with_levels({STANDING_IN: least}), levels=levels)
    )


def _in_turns(wider: Problem, fit: Fit) -> Fit:
    """Levels, the motors' share of the jitter and numbers, each fitted beside the others.

    On all of the flight: maneuvers shake rotors more than hover does, and levels of some runs may be
    worse for all of them than none. On a flight of another simulator (`tests/blade_element.py`,
    **synthetic**) jitter was worth -448 nats by 60 s of 84, by all of it 1,371.
    """
    for _ in range(TURNS):
        fit = fitted(wider, _taken_up(wider, noise_fitted(wider, fit, math.inf)))
    return fit


def _taken_up(wider: Problem, fit: Fit) -> Fit:
    """With the share of the motors that has the largest posterior; they return as late as found."""
    lag = 0.5 * sum(fit.values.get(f"motor_lag.{rotor}", 0.0) for rotor in ("upper", "lower"))
    back = lag if lag > 0.0 else fit.noise.level(JITTER_MEMORY)

    def at(share: float) -> Fit:
        levels = {JITTER_REACTION: share, JITTER_RETURN: back}
        return replace(fit, noise=fit.noise.with_levels(levels))

    def cost(share: float) -> float:
        unusual = 0.5 * ((share - REACTION) / REACTION_STD) ** 2
        return unusual - wider.engine.log_likelihood(fit.values, at(share).noise)

    low, high = REACTION_BOUNDS
    shares = sorted({low, *LOOKED_AT, high, fit.noise.level(JITTER_REACTION)})
    costs = [cost(share) for share in shares]
    best = int(np.argmin(costs))
    between = shares[max(best - 1, 0)], shares[min(best + 1, len(shares) - 1)]
    found = minimize_scalar(cost, bounds=between, method="bounded", options={"xatol": WITHIN})
    return at(float(found.x) if found.fun < costs[best] else shares[best])
