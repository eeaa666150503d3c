"""When a change came: the likelihood over its moments, and whether it came at once or grew."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.onsets.changing import Onset
from coax_env.diagnosis.onsets.growth import changing_model, growing, profiled, with_moment
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.changing_model import ChangingModel
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Record

NEAR = 1.0
"""s to both sides of a moment in which the likelihood is asked for a better one first; ours."""
AFAR = 20
"""Other moments of its run that it is asked for, evenly spaced; ours, a bound on time."""
FADED = 10.0
"""nats under the best moment's from which on another has no share in the interval; ours."""
SMOOTH = 0.5
"""nats by which two moments may differ for a line between them to do; ours."""


def moved_to_best(problem: Problem, fit: Fit, effect: str) -> tuple[Problem, Onset]:
    """The problem with an effect's moment where the likelihood is largest, and the interval of it.

    Args:
        problem, fit: with the change. effect: that changes.
    """
    found = moment_of(problem, fit, effect)
    return with_moment(problem, effect, found.moment), found


def moment_of(problem: Problem, fit: Fit, effect: str, inflation: float = 1.0) -> Onset:
    """The best moment of a change in its run, with mean, std and width of its posterior.

    From the likelihood of its run with the change at each row, all else as it is.

    Args:
        problem, fit: with the change.
        effect: that changes.
        inflation: of variances, by coloured innovations.
    """
    moment = problem.model.moments[effect]
    records = [r for r in problem.engine.records if r.whole == moment.run]
    t = np.concatenate([r.t for r in records])
    nats = _profile(problem, fit, effect, records, t) / inflation
    share = np.exp(nats - nats.max())
    step = np.gradient(t) if t.size > 1 else np.ones(1)
    weight = share * step / float(share @ step)
    mean = float(weight @ t)
    spread = math.hypot(math.sqrt(float(weight @ (t - mean) ** 2)), float(np.median(step)))
    best = Moment(moment.run, float(t[int(np.argmax(nats))]))
    return Onset(effect, best, mean, spread, float(share @ step), 0.0)


def _profile(
    problem: Problem, fit: Fit, effect: str, records: Sequence[Record], times: np.ndarray
) -> np.ndarray:
    """Log-likelihood of records with an effect's moment at each of these times (n,).

    At every tenth near where it stands and at some others first, then between any two of which one has
    a share in the interval and that differ, and by a line between the others.
    """
    model = changing_model(problem)

    def nats_at(k: int) -> float:
        moments = {**model.moments, effect: Moment(model.moments[effect].run, float(times[k]))}
        other = ChangingModel(model.base, moments, model.clock)
        return Engine(other, records, problem.engine.threads).log_likelihood(fit.values, fit.noise)

    known: dict[int, float] = {}
    near = np.flatnonzero(np.abs(times - model.moments[effect].t) <= NEAR)
    afar = np.linspace(0, times.size - 1, AFAR).astype(int)
    asked = {*near[::10].tolist(), *near[-1:].tolist(), *afar.tolist()}
    while asked:
        known |= {k: nats_at(k) for k in asked}
        best = max(known.values())
        asked = {
            (a + b) // 2
            for a, b in pairwise(sorted(known))
            if b > a + 1
            and max(known[a], known[b]) > best - FADED
            and (abs(known[a] - known[b]) > SMOOTH or best in (known[a], known[b]))
        }
    places = sorted(known)
    return np.interp(np.arange(times.size), places, [known[k] for k in places])


def moments_of(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    onsets: Mapping[str, Onset],
) -> dict[str, Onset]:
    """The onsets of causes that are still there, each with its interval at the final fit.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit.
        evidence: of each cause.
        onsets: as they were found.
    """
    found = {}
    for effect, onset in onsets.items():
        if effect in fit.active:
            inflation = evidence[effect].inflation
            if onset.grown is not None:
                assert onset.growth is not None
                own = profiled(problem, fit, quadratic, effect, onset.growth.nats, inflation)
                found[effect] = _as_growth(problem, replace(onset, growth=own))
            else:
                step = moment_of(problem, fit, effect, inflation)
                step = replace(step, nats=onset.nats, beside=onset.beside, growth=onset.growth)
                found[effect] = _as_step(problem, step, inflation)
    return found


def grown_or_step(problem: Problem, step: Fit, found: Onset) -> tuple[Problem, Fit, Onset]:
    """A change as one that grows, where that is worth more than a tie beside the step; else the step.

    Args:
        problem, step: with the change at its moment, fitted. found: its moment.
    """
    effect = found.effect
    tried = growing(problem, step, effect, found.moment, found.width)
    if tried is None:
        return problem, step, found
    wider, fit, own = tried
    problem.report(f"{effect} grows for {own.grown - own.begins:.2f} s:"
                   f" {own.nats:.1f} nats beside a step")  # fmt: skip
    found = replace(found, growth=own)
    if own.nats < problem.settings.tie:
        return problem, step, _as_step(problem, found)
    found = replace(_as_growth(wider, found), width=own.width(problem.seconds))
    return with_moment(wider, effect, found.moment), fit, found


def _as_growth(problem: Problem, onset: Onset) -> Onset:
    """The onset of what grows: its moment is when it begins to."""
    model, own = changing_model(problem), onset.growth
    assert own is not None
    moment = replace(model.moment(own.begins), grows=own.grown - own.begins)
    std = np.sqrt(np.diag(own.covariance))
    return replace(
        onset, moment=moment, t=moment.t, std=float(std[0]), at_once=own.at_once(),
        grown=(model.moment(own.grown), float(std[1])),
    )  # fmt: skip


def _as_step(problem: Problem, onset: Onset, inflation: float = 1.0) -> Onset:
    """The onset of a step; where it may as well have grown, from when on is in its interval."""
    model, own = changing_model(problem), onset.growth
    if own is None:
        return onset
    p = own.at_once(inflation)
    step = model.time(replace(onset.moment, t=onset.t))
    mean = p * step + (1.0 - p) * own.begins
    spread = p * (onset.std**2 + (step - mean) ** 2)
    spread += (1.0 - p) * (inflation * float(own.covariance[0, 0]) + (own.begins - mean) ** 2)
    there = model.moment(mean)
    return replace(onset, t=there.t, run=there.run, std=math.sqrt(spread), at_once=p)
