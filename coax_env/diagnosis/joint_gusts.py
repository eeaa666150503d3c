"""Whether gusts push and turn at once, asked after a search (estimation/joint_gusts.py).

What a model lacks makes gusts that seem joint, and joint gusts take up what a marker or a damping
explains; so none are fitted before the search has named what it can, and they are kept only where they
are worth as much as a cause.
"""

from dataclasses import replace

import numpy as np

from coax_env.diagnosis.fits import fitted, noise_fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.joint_gusts import JointModel, free_shares, is_joint, score_slopes
from coax_env.estimation.wrapping_model import with_innermost
from coax_env.model.layout import GUSTS

ASKS_FROM = 3.0
"""std of its score by which a share, one of 14, must want to be another than none; ours."""
TURNS = 4
"""Of shares and noise levels, at most; ours."""


def in_joint_gusts(problem: Problem, fit: Fit) -> tuple[Problem, Fit] | None:
    """The problem whose gusts are joint and the fit to it, where they are worth the threshold.

    Args:
        problem, fit: after a search.
    """
    asked = [] if is_joint(problem.model) else _asked(problem, fit)
    if not asked:
        return None
    shares = free_shares(asked, problem.model.vehicle)
    joint = with_innermost(problem.model, JointModel)
    wider = problem.with_model(joint).with_free(shares)
    trial = fit.at({f.name: f.value for f in shares})
    last = _cost(problem, fit)
    for _ in range(TURNS):  # what gains nothing at first did not gain the threshold later
        trial = noise_fitted(wider, fitted(wider, trial))
        trial = replace(trial, objective=_cost(wider, trial))
        if last - trial.objective < problem.settings.tie:
            break
        last = trial.objective
    trial = fitted(wider, trial)
    gained = fit.objective - trial.objective
    problem.report(f"gusts that push and turn at once: {gained:.1f} nats")
    return (wider, trial) if gained > problem.settings.evidence else None


def _cost(problem: Problem, fit: Fit) -> float:
    return -problem.engine.log_likelihood(fit.values, fit.noise)


def _asked(problem: Problem, fit: Fit) -> list[str]:
    """Shares whose score asks for some."""
    score = problem.engine.noise_score(fit.values, fit.noise)
    vector = problem.model.vector(fit.values, fit.noise)
    driven = problem.model.process_noise(fit.noise, vector).intensity[GUSTS]
    asked = []
    for name, parts in score_slopes(score.in_noise, driven).items():
        scatter = float(np.sqrt(parts.size) * parts.std())
        if abs(float(parts.sum())) > ASKS_FROM * scatter > 0.0:
            asked.append(name)
    return asked
