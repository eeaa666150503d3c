"""Fits of a problem: linearise, step, fit, noise levels. Each takes a fit and returns another one."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation import whiteness
from coax_env.estimation.engine import NoiseScore, objective
from coax_env.estimation.helicopter_noise import (
    JITTER_LEVEL,
    JITTER_MEMORY,
    LATENT_START,
    MEMORIES,
    TRIM_LEVELS,
    fitted_levels,
)
from coax_env.estimation.noise_levels import fit_noise, level_slopes
from coax_env.estimation.parted_engine import AT, PartedEngine, joint_noise, of_part
from coax_env.estimation.prediction import pooled_rms, replay_runs
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.estimation.whiteness import is_white
from coax_env.model.effect_registry import GUST_MEMORY

LASTING = 4.0 * GUST_MEMORY
"""s, of gusts that may stand for what is always there. A mass of 0.17 kg of 0.8 was taken for gusts of
1 N for 18 s, and worth 12 nats beside them; fitted with short ones it is 82 (`study_diagnosis.py --arms
sizes_large --seed 859`, one 503, **synthetic**); ours."""

BRIEF = 0.1
"""s, of gusts that are tried as brief ones: shorter ones are nearly white at 100 Hz; ours."""


def start(problem: Problem, noise: Noise, held: Collection[str] = ()) -> Fit:
    """The bare model with its own noise levels.

    Args:
        problem: what may be free. noise: levels to start from. held: those that stay.
    """
    values = dict(problem.model.bare_values)
    for f in problem.parameters:
        values.setdefault(f.name, f.value)
    return in_noise_from(problem, Fit((), values, noise), noise, held)


def in_noise_from(problem: Problem, fit: Fit, noise: Noise, held: Collection[str] = ()) -> Fit:
    """The fit with noise levels from a first guess, white noise and drifts among them where asked for.

    Args:
        problem, fit: whose values stay. noise: levels to start from. held: those that stay.
    """
    chosen = problem.settings
    levels = tuple(name for name in fitted_levels(noise) if name not in held)
    noise = fit_noise(
        problem.engine, fit.values, noise, levels,
        chosen.first_noise_evaluations, chosen.step_gain, problem.noise_fit_seconds,
    )  # fmt: skip
    fit = replace(fit, noise=noise, levels=levels)
    return with_latent_noise(problem, fit) or fit


def linearise(problem: Problem, fit: Fit) -> tuple[Fit, list[RunPass], Quadratic]:
    """The quadratic at a fit, over all parameters that may be free; the fit with its objective."""
    return _linearised(problem, fit, problem.parameters, gains=True)


def quadratic_at(
    problem: Problem, fit: Fit, of: Sequence[FreeParameter] | None = None
) -> tuple[Fit, Quadratic]:
    """As `linearise`, of some parameters, for who needs no passes: a last fit may have left it.

    Args:
        problem, fit: what may be free, and where.
        of: the parameters; default all that may be free.
    """
    fit, _, quadratic = _linearised(problem, fit, problem.parameters if of is None else of, False)
    return fit, quadratic


def _linearised(
    problem: Problem, fit: Fit, of: Sequence[FreeParameter], gains: bool
) -> tuple[Fit, list[RunPass], Quadratic]:
    passes, lin = problem.engine.linearise(fit.values, fit.noise, of, gains)
    nats = objective(passes, problem.free(fit.active), fit.values)
    return replace(fit, objective=nats), passes, Quadratic.of(lin, of, fit.values)


def stepped(problem: Problem, fit: Fit, passes: Sequence[RunPass], quadratic: Quadratic) -> Fit:
    """After a Newton step of what is free, halved until the cost falls.

    Args:
        problem, fit: what may be free, and where.
        passes: of the filter at the fit, whose gains the cost is taken with.
        quadratic: linearised at the fit.
    """
    free = problem.free(fit.active)
    _, move = quadratic.best([f.name for f in free])
    moves = {n: float(m) for n, m in zip(quadratic.names, move, strict=True) if m != 0.0}
    values, _ = problem.engine.descend(passes, free, fit.values, fit.noise, moves)
    return replace(fit, values=values)


def at_optimum(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    active: Sequence[str],
    fixed: Mapping[str, float],
) -> Fit:
    """Where the quadratic has its least value with other effects active and some values fixed.

    Args:
        problem, fit: of the quadratic; noise levels stay.
        quadratic: linearised at the fit.
        active: effects that are active then.
        fixed: values of parameters that are not free.
    """
    free = [n for n in problem.free_names(active) if n not in fixed]
    _, move = quadratic.best(free, fixed)
    return replace(fit.at({**quadratic.moved(move), **fixed}), active=tuple(active))


def without(problem: Problem, fit: Fit, quadratic: Quadratic, *effects: str) -> Fit:
    """The fit without some effects, the rest at the quadratic's optimum.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        effects: active ones.
    """
    fixed: dict[str, float] = {}
    for effect in effects:
        fixed |= problem.off_values(effect) | problem.file_values(effect)
    rest = [effect for effect in fit.active if effect not in effects]
    return at_optimum(problem, fit, quadratic, rest, fixed)


def only(problem: Problem, fit: Fit, effects: Collection[str]) -> Fit:
    """The fit with all other effects off; the rest stays where it is.

    Args:
        problem, fit: what may be free, and where. effects: those that stay.
    """
    for effect in set(fit.active) - set(effects):
        off = problem.off_values(effect) | problem.file_values(effect)
        fit = replace(fit.at(off), active=fit.rest(effect))
    return fit


def fitted(
    problem: Problem,
    fit: Fit,
    steps: int = 3,
    tolerance: float = 1.0,
    held: Collection[str] = (),
) -> Fit:
    """What is free fitted by Gauss-Newton.

    Args:
        problem, fit: where to begin.
        steps: at most.
        tolerance: predicted gain that ends the fit [nats].
        held: names of free parameters that stay.
    """
    free = [f for f in problem.free(fit.active) if f.name not in held]
    estimate = problem.engine.fit(free, fit.values, fit.noise, steps, tolerance)
    return replace(fit.at(estimate.values), objective=estimate.objective)


def noise_fitted(
    problem: Problem, fit: Fit, seconds: float | None = None, evaluations: int | None = None
) -> Fit:
    """Noise levels fitted from where they stand.

    Args:
        problem, fit: where to begin; parameters stay.
        seconds: of flight that are enough; default the settings'. Endless: of all of it, closer where
            rows are slow.
        evaluations: of the likelihood at most; default the settings'.
    """
    if isinstance(problem.engine, PartedEngine):
        return by_parts(problem, fit, lambda p, own: noise_fitted(p, own, seconds, evaluations))
    chosen = problem.settings
    closely = seconds == math.inf and problem.has_slow_rows
    noise = fit_noise(
        problem.engine, fit.values, fit.noise, fit.levels,
        evaluations=evaluations or chosen.noise_evaluations,
        tolerance=chosen.noise_gain if closely else chosen.step_gain,
        seconds=problem.noise_fit_seconds if seconds is None else seconds,
    )  # fmt: skip
    return replace(fit, noise=noise)


def by_parts(problem: Problem, fit: Fit, work: Callable[[Problem, Fit], Fit]) -> Fit:
    """What is done to the noise of each part of the flights alone, at the joint values.

    Args:
        problem, fit: whose engine is a `PartedEngine`.
        work: gets a part's problem and fit, by plain names, and returns the fit with other noise.
    """
    assert isinstance(problem.engine, PartedEngine)
    noise: dict[str, Noise] = {}
    levels: list[str] = []
    for part in problem.engine.parts:
        own = replace(
            fit,
            values=part.values(fit.values),
            noise=part.noise(fit.noise),
            levels=part.levels(fit.levels),
        )
        done = work(replace(problem, engine=part.engine), own)
        noise[part.name] = done.noise
        levels += [of_part(name, part.name) for name in done.levels]
    return replace(fit, noise=joint_noise(noise), levels=tuple(levels))


def converged(problem: Problem, fit: Fit, held: Collection[str] = ()) -> Fit:
    """Noise levels and free parameters by turns until neither gains, those in `held` fixed.

    Evidence is a difference of two such fits: what one of them lacks in convergence would count for
    the other.

    Args:
        problem, fit: where to begin.
        held: names of free parameters that stay.
    """
    for _ in range(problem.settings.most_turns):
        before = fit.objective
        fit = fitted(problem, noise_fitted(problem, fit, math.inf), steps=1, held=held)
        if before - fit.objective < problem.settings.step_gain:
            break
    return fit


def with_latent_noise(problem: Problem, fit: Fit) -> Fit | None:
    """With white process noise, or drifts of trim, where the score asks and a fit pays more than a tie.

    A level at its floor has next to no slope in its logarithm, however much it wants to grow; its
    score over the scatter of that from block to block says so all the same.
    """
    if isinstance(problem.engine, PartedEngine):
        both = by_parts(problem, fit, lambda p, own: with_latent_noise(p, own) or own)
        return both if both.levels != fit.levels else None
    engine, chosen = problem.engine, problem.settings
    latent = [name for name in LATENT_START if name not in fit.levels]
    if not latent:
        return None
    score = engine.noise_score(fit.values, fit.noise)
    asked = [n for n in latent if _score(problem, fit, score, n) > chosen.latent_noise_score]
    if not asked:
        return None
    first = {}
    for name in asked:
        axes, share = LATENT_START[name]
        first[name] = max(share * fit.noise.level(axes), 2.0 * fit.noise.floor[name])
    levels = (*fit.levels, *asked)
    noise = fit_noise(
        engine, fit.values, fit.noise.with_levels(first), levels,
        chosen.first_noise_evaluations, chosen.step_gain, problem.noise_fit_seconds,
    )  # fmt: skip
    gained = engine.log_likelihood(fit.values, noise)
    gained -= engine.log_likelihood(fit.values, fit.noise)
    if gained < chosen.tie:
        return None
    problem.report(f"{', '.join(asked)} beside the gusts: {gained:.1f} nats")
    return replace(fit, noise=noise, levels=levels)


def brief_memories(noise: Noise) -> Noise:
    """Gusts with memories of no more than BRIEF, shaken as much per second."""
    return _with_memories(noise, BRIEF)


def short_memories(noise: Noise) -> Noise:
    """Gusts with no longer memories than usual, shaken as much per second.

    Gusts that were fitted without a change have taken up a part of it, as a push that lasts: a mass
    that is 6 % less was worth 3 nats then.
    """
    return _with_memories(noise, GUST_MEMORY)


def _with_memories(noise: Noise, most: float) -> Noise:
    levels = {}
    for name, memory in noise.process.items():
        plain_name, at, part = name.partition(AT)
        if plain_name in MEMORIES and memory > most:
            gusts = plain_name.removeprefix("memory_") + at + part
            levels[name] = most
            levels[gusts] = noise.process[gusts] * math.sqrt(most / memory)
    return noise.with_levels(levels)


def without_drifts(fit: Fit) -> Fit:
    """With noise that cannot take up what changes: no drifting trims or jitter, gusts of short memory.

    Rotors that jitter take up a motor that slows down. Values stay.
    """
    least = {n: fit.noise.floor[n] for n in fit.levels if n in (*TRIM_LEVELS, JITTER_LEVEL)}
    gone = {*least, JITTER_MEMORY}
    noise = short_memories(fit.noise.with_levels(least))
    return replace(fit, noise=noise, levels=tuple(n for n in fit.levels if n not in gone))


def steadied(problem: Problem, fit: Fit) -> Fit:
    """With noise levels fitted from steady noise, where that ends likelier.

    Noise is first fitted while the vehicle's own numbers are off. It may take these up, as a push that
    lasts, and stay so: gusts with a memory of 7.7 s and a drift, where 0.5 s and none are true, hid a
    mass of 96 g (`study_diagnosis.py --arms gusty --seed 50`, one 1).

    Args:
        problem, fit: with levels that were fitted, and the vehicle's own numbers.
    """
    steady = from_steady_noise(problem, fit)
    if steady is None:
        return fit
    return min(fitted(problem, noise_fitted(problem, fit)), steady, key=lambda end: end.objective)


def from_steady_noise(problem: Problem, fit: Fit) -> Fit | None:
    """The fit from there with steady noise; None where it is that already.

    Args:
        problem, fit: with levels that were fitted.
    """
    steady = without_drifts(fit)
    if steady.noise.process == fit.noise.process:
        return None
    return fitted(problem, noise_fitted(problem, steady))


def _score(problem: Problem, fit: Fit, score: NoiseScore, name: str) -> float:
    """Slope in a level over its scatter from block to block [std]."""
    parts, _ = level_slopes(problem.engine, fit.values, fit.noise, name, score)
    return float(parts.sum() / (np.sqrt(parts.size) * parts.std() + 1e-300))


def is_much_coloured(problem: Problem, fit: Fit) -> bool:
    """Whether much of the innovations is foretold by their own past (estimation/whiteness.py)."""
    passes = problem.engine.filter(fit.values, fit.noise)
    return whiteness.is_much_coloured(passes, problem.model.channels)


def is_all_white(problem: Problem, fit: Fit) -> bool:
    """Whether no channel's innovations are coloured."""
    return is_white(problem.engine.filter(fit.values, fit.noise), problem.model.channels)


def noise_may_hide(problem: Problem, fit: Fit) -> bool:
    """Whether noise may have taken up what no score shows then: rows are slow, poses alone are read or
    gusts last, and little is coloured.

    Few readings tell there what acts from gusts, poses tell it after two integrations, and gusts that
    last push as what is always there does. By poses alone a marker offset of 59 nats scored 5 beside a
    white force (`study_diagnosis.py --arms mixed_poses --seed 864`, one 540, **synthetic**).
    Where much is coloured, noise stands for what the model lacks: on a real helicopter (second CoaX) a
    ground effect and a hub stiffness that were found so made errors of 1 s larger, 39 % removed for
    62 %.
    """
    hides = problem.has_slow_rows or problem.sees_poses_alone or gusts_last(fit.noise)
    return hides and not is_much_coloured(problem, fit)


def gusts_last(noise: Noise) -> bool:
    """Whether one of the gusts has a memory of LASTING or more.

    Args:
        noise: levels of the flights, or of their parts.
    """
    named = ((name.partition(AT)[0], memory) for name, memory in noise.process.items())
    return any(name in MEMORIES and memory >= LASTING for name, memory in named)


def flown_errors(problem: Problem, fit: Fit) -> dict[str, float]:
    """RMS by channel of the open-loop errors on the fitted runs, over the settings' horizon."""
    runs = replay_runs(problem.engine, fit.values, fit.noise, problem.settings.horizon)
    return pooled_rms(runs)
