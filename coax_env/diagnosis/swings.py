"""Whether gusts have a frequency, which a memory that fades does not have.

Asked after a search, of white innovations too: poses are too coarse to be coloured by a swing, and it
makes false names all the same. Spectra of the filter's own gusts show where each may swing
(estimation/swinging_gusts.py). Spectra peak by chance, too: where no clear group of axes is felt and
gains more than a tie by swinging alone, nothing else is asked. All clear ones are, the clearest first:
what was named may have taken one up, as a motor's droop had the yaw's (-40 nats alone, the forces' 631,
all together 2,127; **synthetic**, clean). From there frequencies, noise levels and numbers are fitted
in turns, frequencies by the likelihood itself, since they change the filter's gains. Gusts that swing
have no fast part, so that white noise is asked for once more. What a model lacks may look like a swing
as well: after a search with them nothing may be coloured, or none is used (searches/unrest.py).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize
from scipy.stats import gmean

from coax_env.diagnosis.fits import fitted, noise_fitted, with_latent_noise
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.helicopter_noise import AXES, GUST_AXES, GUST_LEVELS, MEMORIES
from coax_env.estimation.noise_levels import evenly_picked
from coax_env.estimation.state_space import Noise
from coax_env.estimation.swinging_gusts import (
    CLEARLY,
    FASTEST,
    clearly_swinging,
    swinging_at,
    swings,
)
from coax_env.plain_words import and_list

TURNS = 3
"""Of frequencies, noise levels and numbers, at most; ours."""
EVALUATIONS = 60
"""Likelihoods of a group's frequencies, memory and level, at most; ours."""
REACH = (0.3, 0.1)
"""Of their logarithms, by which they are moved first in the first turn, and in later ones; ours."""
NEAR = 0.1
"""Of their logarithms, within which the likeliest are found, if by no more than a nat, too. By 0.03 it
took 511 likelihoods for 275 and brought 2 nats of 1,023 (**synthetic**); ours."""
SWUNG = 1.0
"""Swings that a memory lasts, where its fit begins: a sixth of critical damping; ours."""
FAR = 1.7
"""Times the frequency of a swing, or part of it, at which its spectrum peaks, from which on it is
fitted once more: a peak is up to 0.1 Hz off; ours."""
HOPELESS = 10.0
"""Times what one group gains alone that all together may lose at first: swings that were there gained
1,443 nats at once, on the real first CoaX 72,840 were lost, and 5,899 after 39 s; ours."""
SLOWEST = 0.05
"""Hz: slower, no run shows a swing of; ours."""
FELT = 2.0
"""Times its floor that the level of a group's gusts must be for a swing of it to be asked; ours. In
still air all are at it, and what a filter makes of nothing has peaks, too."""


def with_swings(problem: Problem, fit: Fit) -> tuple[Problem, dict[str, float]] | None:
    """The problem whose gusts swing, and levels of these, where they are worth the threshold.

    Args:
        problem, fit: after a search.
    """
    passes = problem.engine.filter(fit.values, fit.noise)
    frequencies = swings(passes, problem.row)
    felt = [a for a in clearly_swinging(passes, problem.row) if _is_felt(fit.noise, a)]
    for axes in felt:
        alone = _gained_by(problem, fit, frequencies, axes)
        if alone >= problem.settings.tie:
            return _fitted_from(problem, fit, frequencies, HOPELESS * alone)
    return None


def with_other_swings(problem: Problem, fit: Fit) -> tuple[Problem, dict[str, float]] | None:
    """As `with_swings`, of gusts that swing already: where a spectrum shows another frequency, or
    clearly one of a gust that only fades so far.

    What was found beside them had hidden it: a centre of gravity that is off, the moments'. One of 1.8
    mm had a hub stiffness and a rate damping in its place, beside inertias 21 and 32 % too large
    (**synthetic**).
    """
    passes = problem.engine.filter(fit.values, fit.noise)
    found, clear = swings(passes, problem.row), swings(passes, problem.row, CLEARLY)
    so_far = problem.model.frequencies
    is_new = any(f > 0.0 and was == 0.0 for f, was in zip(clear, so_far, strict=True))
    apart = [abs(math.log(f / was)) for f, was in zip(found, so_far, strict=True) if f * was]
    if not is_new and max(apart, default=0.0) < math.log(FAR):
        return None
    return _fitted_from(problem, fit, found)


def _is_felt(noise: Noise, axes: str) -> bool:
    """Whether the gusts of a group of axes are more than the least that there may be."""
    return noise.level(axes) > FELT * noise.floor.get(axes, 0.0)


def _fitted_from(
    problem: Problem, fit: Fit, frequencies: Sequence[float], most_lost: float = math.inf
) -> tuple[Problem, dict[str, float]] | None:
    """Frequencies, noise levels and numbers fitted in turns, where that is worth the threshold.

    Args:
        problem, fit: without them. frequencies: to begin from [Hz].
        most_lost: nats that the numbers may lose at first, before levels and frequencies are fitted.
    """
    best = _swinging(problem, frequencies)
    trial = replace(fit, noise=_lasting(fit.noise, frequencies))
    last = math.inf
    for turn in range(TURNS):
        trial = fitted(best, trial)
        lost = trial.objective - fit.objective
        if turn == 0 and lost > most_lost:
            problem.report(f"gusts that swing: {-lost:.1f} nats at first")
            return None
        hopeless = turn > 0 and lost > 0.0
        if hopeless or last - trial.objective < problem.settings.tie:
            break
        last = trial.objective
        part = best.with_records(evenly_picked(best.engine.records, best.noise_fit_seconds))
        for axes in AXES:
            frequencies, trial = _likeliest(part, trial, frequencies, axes, REACH[turn > 0])
        best = _swinging(problem, frequencies)
    trial = noise_fitted(best, trial)
    trial = fitted(best, with_latent_noise(best, trial) or trial)
    gained = fit.objective - trial.objective
    problem.report(
        f"gusts that swing at {and_list([f'{f:.2f}' for f in frequencies])} Hz: {gained:.1f} nats"
    )
    if gained < problem.settings.evidence:
        return None
    return best, {name: trial.noise.level(name) for name in (*GUST_LEVELS, *MEMORIES)}


def _gained_by(problem: Problem, fit: Fit, frequencies: Sequence[float], axes: str) -> float:
    """What it gains that one group of axes swings, all else as it is [nats].

    Args:
        problem, fit: without swings. frequencies: of the six gusts. axes: one of AXES.
    """
    part = problem.with_records(evenly_picked(problem.engine.records, problem.noise_fit_seconds))
    alone = [f if of == axes else 0.0 for f, of in zip(frequencies, GUST_AXES, strict=True)]
    begun = replace(fit, noise=_lasting(fit.noise, alone))
    found, trial = _likeliest(part, begun, alone, axes, REACH[0])
    gained = _swinging(part, found).engine.log_likelihood(trial.values, trial.noise)
    return gained - part.engine.log_likelihood(fit.values, fit.noise)


def _swinging(problem: Problem, frequencies: Sequence[float]) -> Problem:
    return problem.with_model(swinging_at(problem.model, frequencies))


def _lasting(noise: Noise, frequencies: Sequence[float]) -> Noise:
    """Noise levels whose memories are SWUNG swings, where a gust of the group has some."""
    of_group: dict[str, list[float]] = {}
    for axes, frequency in zip(GUST_AXES, frequencies, strict=True):
        if frequency > 0.0:
            of_group.setdefault(f"memory_{axes}", []).append(SWUNG / frequency)
    return noise.with_levels({name: float(gmean(memories)) for name, memories in of_group.items()})


def _likeliest(
    problem: Problem, fit: Fit, frequencies: Sequence[float], axes: str, reach: float
) -> tuple[list[float], Fit]:
    """Frequencies [Hz], memory and level of one group of axes, by the likelihood itself.

    Args:
        problem, fit: with the frequencies. axes: one of AXES.
        reach: by which logarithms are moved first.
    """
    swinging = [i for i, f in enumerate(frequencies) if f > 0.0 and GUST_AXES[i] == axes]
    if not swinging:
        return list(frequencies), fit
    levels = [axes, f"memory_{axes}"]
    first = [*(frequencies[i] for i in swinging), *(fit.noise.level(n) for n in levels)]
    lows = [SLOWEST] * len(swinging) + [fit.noise.floor[n] for n in levels]
    highs = [FASTEST] * len(swinging) + [fit.noise.ceiling[n] for n in levels]
    bounds = np.log(np.stack([lows, highs], axis=1))
    start = np.clip(np.log(first), *bounds.T)

    def at(logs: np.ndarray) -> tuple[list[float], Noise]:
        found, values = list(frequencies), np.exp(logs).tolist()
        for i, f in zip(swinging, values, strict=False):
            found[i] = f
        return found, fit.noise.with_levels(dict(zip(levels, values[-2:], strict=True)))

    def cost(logs: np.ndarray) -> float:
        found, noise = at(logs)
        return -_swinging(problem, found).engine.log_likelihood(fit.values, noise)

    least = minimize(
        cost, start, method="Nelder-Mead",
        bounds=bounds,
        options={
            "maxfev": EVALUATIONS, "fatol": 1.0, "xatol": NEAR,
            "initial_simplex": start + reach * np.vstack([np.zeros(len(start)), np.eye(len(start))]),
        },
    )  # fmt: skip
    found, noise = at(least.x)
    return found, replace(fit, noise=noise)
