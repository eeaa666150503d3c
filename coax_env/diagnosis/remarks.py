"""What a reader should know beside the findings: white process noise, moved numbers, unseen effects."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from coax_env.diagnosis.confounding import Alternatives, undecided
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.run_air import has_own_air
from coax_env.diagnosis.settings import Settings
from coax_env.estimation.helicopter_noise import (
    WHITE_LEVELS,
    error_level,
    error_memory,
    level_unit,
)
from coax_env.estimation.joint_gusts import SHARES, is_arm
from coax_env.estimation.prediction import RunReplay
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.run_air import strength_and_memory
from coax_env.estimation.state_space import FreeParameter
from coax_env.model.layout import AXES_OF_GUSTS, ERRING_GROUPS
from coax_env.plain_words import and_list, channel_name, plain, with_unit

OTHERWISE = 5.0
"""Percent by which the gain must be another one without channels that are lost in noise; ours."""


def remarks(problem: Problem, fit: Fit, quadratic: Quadratic, found: Alternatives) -> list[str]:
    """Every remark on a finished diagnosis.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit.
        found: the confounded alternatives of each cause that is named.
    """
    return [
        *_seen_late(problem),
        *_unlike_gusts(problem),
        *_smoothed(problem),
        *_clock_errors(problem),
        *_own_air(problem),
        *_swings(problem),
        *_joint_gusts(fit),
        *_lasting_errors(fit),
        *_white_noise(problem, fit),
        *_moved_base(problem, fit),
        *_resting_on_unseen(problem, fit, quadratic, found),
        *_resting_on_undecided(problem, fit, quadratic, found),
    ]


def lost_in_noise(gain: Mapping[str, Any] | None) -> list[str]:
    """That channels count in the gain whose error is not told from their sensors' noise.

    Only where it is another gain without them, by OTHERWISE percent.

    Args:
        gain: of the corrected model on the held-out runs.
    """
    other = (gain or {}).get("beyond_noise")
    if not gain or other is None or other["error_removed_percent"] is None:
        return []
    if abs(other["error_removed_percent"] - gain["error_removed_percent"]) < OTHERWISE:
        return []
    low, high = other["ci95"]
    interval = "" if low is None else f" ({low:.0f} to {high:.0f})"
    channels = other["without"]
    whose = "its sensor's" if len(channels) == 1 else "their sensors'"
    return [
        f"on the held-out runs the error of {and_list([channel_name(c) for c in channels])} is not "
        f"told from {whose} noise, and counts in the gain by chance; by the other channels "
        f"{other['error_removed_percent']:.0f} % of the error is removed{interval}"
    ]


def one_step_against_a_second(
    gain: Mapping[str, Any] | None,
    refitted: Sequence[RunReplay],
    corrected: Sequence[RunReplay],
    chosen: Settings,
) -> list[str]:
    """That the likelihood of one step prefers what predicts a second ahead worse, where it does.

    Args:
        gain: of the corrected model on the held-out runs.
        refitted, corrected: those runs flown by the bare model, refitted, and by the corrected one.
        chosen: what decides.
    """
    if not gain:
        return []
    nats = [sum(run.log_likelihood for run in runs) for runs in (refitted, corrected)]
    worse = [
        channel_name(c)
        for c, e in gain["channels"].items()
        if e["before_refitted"] is not None
        and e["ci95"][0] is not None
        and e["ci95"][0] > e["before_refitted"]
    ]
    if not worse or not nats[1] - nats[0] > chosen.tie:
        return []
    return [
        f"on the held-out runs the likelihood of one step prefers the corrected model by"
        f" {nats[1] - nats[0]:.0f} nats, but a second ahead it predicts {and_list(worse)} worse:"
        " the noise model is wrong"
    ]


def answered_gusts(gain: Mapping[str, Any] | None) -> list[str]:
    """That nothing moves predicts some channels better than the corrected model, beyond chance.

    On a real heading no model whose rotors turn it the right way does better
    (scripts/study/heading_bound.py).

    Args:
        gain: of the corrected model on the held-out runs.
    """
    better = [
        channel_name(c)
        for c, e in (gain["channels"] if gain else {}).items()
        if e["persistence"] is not None
        and e["ci95"][0] is not None
        and e["persistence"] < e["ci95"][0]
    ]
    if not better:
        return []
    return [
        f"that nothing moves predicts {and_list(better)} better a second ahead than the corrected"
        " model: commands that answer gusts say the opposite of what they do, or the model is wrong"
        " there; a maneuver flown without such answers would tell"
    ]


def held_out_before(
    gain: Mapping[str, Any] | None, causes: Sequence[Mapping[str, Any]], runs: Sequence[str]
) -> list[str]:
    """That the gain says nothing of a cause, since all held-out runs were flown before it began.

    Args:
        gain: of the corrected model on the held-out runs.
        causes: of the findings.
        runs: names of all, in the order in which they were flown.
    """
    began_in = {c["effect"]: c["since"]["run"] for c in causes if c.get("since")}
    if not gain or not {*gain["held_out"], *began_in.values()} <= set(runs):
        return []  # of one run a part was held out
    last = max((runs.index(name) for name in gain["held_out"]), default=len(runs))
    return [
        f"the held-out runs were flown before {plain(effect)} began: the gain says nothing of it"
        for effect, run in began_in.items()
        if runs.index(run) > last
    ]


def _seen_late(problem: Problem) -> list[str]:
    if problem.has_slow_rows:
        why = f"rows {1e3 * problem.row:.0f} ms apart: what the commands did between them is not known"
    elif problem.knows_commands_seldom:
        apart = 1e3 * problem.between_commands
        why = f"commands on straight lines, {apart:.0f} ms long: what they did there is not known"
    elif problem.reads_seldom:
        apart = 1e3 * problem.between_readings
        why = f"readings {apart:.0f} ms apart: commands may answer what none has shown yet"
    elif problem.sees_poses_alone:
        why = "neither gyros nor accelerometers: who flies may see gusts before poses show them"
    else:
        return []
    return [
        f"{why}, and what looks like a weak or late answer must be worth"
        f" {problem.unseen_times:g} times as much"
    ]


def _clock_errors(problem: Problem) -> list[str]:
    if problem.clock_error == 0.0:
        return []
    return [
        f"the times of the log's rows are wrong by {1e3 * problem.clock_error:.2g} ms (std), or poses"
        " were smoothed as though they were even: readings that move fast are believed less"
    ]


def _own_air(problem: Problem) -> list[str]:
    """How far the runs' gusts are apart, where each has air of its own."""
    if not has_own_air(problem):
        return []
    of_runs = np.array([strength_and_memory(record.air) for record in problem.engine.records])
    (least, shortest), (most, longest) = of_runs.min(axis=0), of_runs.max(axis=0)
    return [
        f"each run has air of its own: gusts {least:.2g} to {most:.2g} times as strong as common ones,"
        f" and {shortest:.2g} to {longest:.2g} times as long"
    ]


def _swings(problem: Problem) -> list[str]:
    """At what frequencies the gusts come, where they have some."""
    of = zip(AXES_OF_GUSTS, problem.model.base.frequencies, strict=False)
    said = [f"{axis} {frequency:.2g}" for axis, frequency in of if frequency > 0.0]
    return [f"gusts have a frequency [Hz]: {', '.join(said)}"] if said else []


def _joint_gusts(fit: Fit) -> list[str]:
    """Which gusts push and turn at once, where some do."""
    said = [
        f"{name.partition('.')[2].replace('_', ' ')} {fit.values[name]:+.2g}{' m' * is_arm(name)}"
        for name in SHARES
        if name in fit.values
    ]
    return [f"gusts push and turn at once: {', '.join(said)}"] if said else []


def _lasting_errors(fit: Fit) -> list[str]:
    """Which readings have errors that last, where they have some."""
    levels, said = fit.noise.process, []
    for group in ERRING_GROUPS:
        name = error_level(group)
        if name in levels and levels[name] > fit.noise.floor[name]:
            unit, memory = level_unit(name), levels[error_memory(group)]
            said.append(f"{group} {with_unit(levels[name], unit, 2)} for {memory:.2g} s")
    return [f"readings have errors that last: {', '.join(said)}"] if said else []


def _unlike_gusts(problem: Problem) -> list[str]:
    if not problem.unlike_gusts:
        return []
    return [
        "no accelerometer's innovations are white: gusts are not as the filter has them, who flies may"
        " foresee them better, and what looks like a weak or late answer must be worth"
        f" {problem.unseen_times:g} times as much"
    ]


def _smoothed(problem: Problem) -> list[str]:
    if not problem.smoothed:
        return []
    return [
        "what is left of a low-pass looks like a late answer: such a cause must be worth"
        f" {problem.unseen_times:g} times as much"
    ]


def _white_noise(problem: Problem, fit: Fit) -> list[str]:
    """The levels of white process noise, where they are well above their floor."""
    process, floor = fit.noise.process, fit.noise.floor
    least = problem.settings.white_noise_reported
    if not any(process[level] > least * floor[level] for level in WHITE_LEVELS):
        return []  # what seemed to shake the bare model has found its cause
    xy, z, moment_xy, moment_z = (process[level] for level in WHITE_LEVELS)
    return [
        "white process noise beside the gusts, x and y, z:"
        f" force {xy:.2g}, {z:.2g} N s^1/2, moment {moment_xy:.2g}, {moment_z:.2g} N m s^1/2"
    ]


def _moved_base(problem: Problem, fit: Fit) -> list[str]:
    texts = []
    for f in problem.free(fit.active):
        if "." not in f.name:
            value = fit.values[f.name]
            sigmas = (value - f.value) / f.std
            if abs(sigmas) > 2.0:
                texts.append(
                    f"base parameter {f.name} moved {sigmas:+.1f} prior sigmas,"
                    f" from {f.value:.4g} to {value:.4g}"
                )
    return texts


def _resting_on_unseen(
    problem: Problem, fit: Fit, quadratic: Quadratic, found: Alternatives
) -> list[str]:
    """Causes' numbers that an effect which these flights cannot show would change.

    An interval covers what is in the model. A usual accelerometer scale is worth nothing on flights
    that never leave 1 g, and is then in the accelerometer's bias.
    """
    if not found:
        return []
    chosen = problem.settings
    free = problem.free_names(fit.active)
    std = np.sqrt(np.diag(quadratic.covariance(free)))
    unseen = list(_not_named(problem, fit, found))
    information, regression = quadratic.projected([f.name for f in unseen], free)
    of_cause = np.array([name.partition(".")[0] in found for name in free], bool)
    worst: dict[str, tuple[float, str]] = {}
    for f, known, weights in zip(unseen, np.diag(information), regression.T, strict=True):
        if 0.5 * known * f.std**2 > chosen.evidence:
            continue
        moved = np.abs(weights) * f.std
        for k in np.flatnonzero(of_cause & (moved > chosen.moved_by_unseen * std)):
            name, effect = free[k], f.name.partition(".")[0]
            text = (
                f"{name} = {fit.values[name]:.3g} holds without {effect}: a usual {f.name}"
                f" ({f.std:.2g}) cannot be seen here and would move it by {moved[k]:.2g}"
            )
            worst[name] = max(worst.get(name, (0.0, "")), (float(moved[k] / std[k]), text))
    return _of_the_worst(worst, chosen)


def _resting_on_undecided(
    problem: Problem, fit: Fit, quadratic: Quadratic, found: Alternatives
) -> list[str]:
    """Causes' numbers that an effect which these flights neither show nor rule out has elsewhere."""
    chosen = problem.settings
    free = problem.free_names(fit.active)
    std = np.sqrt(np.diag(quadratic.covariance(free)))
    of_cause = np.array([name.partition(".")[0] in found for name in free], bool)
    worst: dict[str, tuple[float, str]] = {}
    for effect, (probability, move) in undecided(problem, fit, quadratic).items():
        far = math.sqrt(probability) * np.abs(move) / std
        for k in np.flatnonzero(of_cause & (far > chosen.moved_by_undecided)):
            name = free[k]
            text = (
                f"{name} = {fit.values[name]:.3g} holds without {effect}, which these flights neither"
                f" show nor rule out: with it {fit.values[name] + move[k]:.3g} fits as well"
            )
            worst[name] = max(worst.get(name, (0.0, "")), (float(far[k]), text))
    return _of_the_worst(worst, chosen)


def _of_the_worst(worst: Mapping[str, tuple[float, str]], chosen: Settings) -> list[str]:
    """What is said of the numbers that would move farthest: number -> std by which, and the text."""
    return [text for _, text in sorted(worst.values(), reverse=True)[: chosen.most_warnings]]


def _not_named(problem: Problem, fit: Fit, found: Alternatives) -> Iterable[FreeParameter]:
    named = {*fit.active}.union(*found.values())
    for effect in problem.candidates:
        if effect not in named:
            yield from (f for f in problem.own[effect] if f.probe == 0.0)
