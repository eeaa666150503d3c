"""Whether gyros and accelerometers are read through a low-pass, which the model does not have.

Where a sensor smooths, two innovations that follow each other are alike, whatever gusts and levels take
up of it. Where they are, or something is named that looks like it (LIKE), each group of channels is
tried with its readings taken back through low-passes of several times (estimation/low_pass.py), noise
levels fitted anew to each; the likeliest is fitted from the levels of the search, too, since the others
may end short of these: one of 32 Hz that is worth 240 nats seemed to cost 136. Worth the threshold,
they stay so, and causes are searched for again. Without it every clean **synthetic** flight behind
20 Hz had a `thrust_exponent` of 25 to 100 nats: rotor speeds are not smoothed, and thrust seemed to
follow them less.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from coax_env.diagnosis.fits import fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.engine import Engine
from coax_env.estimation.low_pass import (
    NONE,
    LowPass,
    before_low_pass,
    records_before,
)
from coax_env.estimation.noise_levels import fit_noise
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import Noise
from coax_env.model.layout import ACCELEROMETERS, GYROS, ROTOR_SPEEDS
from coax_env.plain_words import and_list, channel_name, plain

GROUPS = (GYROS, ACCELEROMETERS)
LIKE: Mapping[tuple[str, ...], str] = {GYROS: "attitude_delay", ACCELEROMETERS: "thrust_exponent"}
"""Group -> the effect that a low-pass of it looks like, too weak to show by itself as it may be: one of
49 Hz was an exponent of 73 nats on a clean **synthetic** flight."""
ALIKE = 4.0
"""std of the correlation of neighbouring innovations, of a group or one channel, from which low-passes
are tried; chance reaches it once in 4,000 flights. A low-pass of 20 Hz makes 7 to 14 of it in 110 s.
(Pooled alone one of 43 Hz was not seen beside rotors that jitter: 7.2 and 4.3 of roll and pitch rate,
-13.7 of yaw rate; a servo's delay of 7,186 nats was not named on that **synthetic** flight.)"""
LATER = 2.0
"""Times the delay of gyros' low-pass from which attitudes are late by themselves; ours. Gyros that come
late make attitudes early, and what one of 26 ms took back too far was half of that."""
TIMES = (0.4, 0.65, 1.1, 1.8)
"""Of a row, that are tried: 40 to 9 Hz at 100 Hz; ours."""
FALLS = 2
"""Times, each less likely than the one before it, after which no longer one is tried; ours."""
BOUNDS = (0.2, 3.0)
"""Of a row: less is not seen in the next one, more is no sensor's; ours."""
TURNS = 2
"""In which each group is asked, beside what the other one has by then; ours."""
WITHIN = 0.01
"""Of a row, to which the likeliest time is sought; ours."""


def low_passes(
    problem: Problem, fit: Fit, noise: Noise, groups: Sequence[Sequence[str]] = GROUPS
) -> dict[str, LowPass]:
    """The low-passes of the channels that have one.

    Args:
        problem, fit: after a search. noise: from which that began: gusts have taken up by now what a
            low-pass does to the readings' noise.
        groups: channels that are asked, each group for one low-pass.
    """
    groups = [group for group in groups if not problem.aboard.isdisjoint(group)]
    if problem.has_slow_rows or not groups:
        return {}
    passes = problem.engine.filter(fit.values, fit.noise)
    if max(_alike(passes, problem.model.channels, channels) for channels in _pools(groups)) < ALIKE:
        groups = [group for group in groups if LIKE[tuple(group)] in fit.active]
    if not groups:
        return {}
    found: dict[str, LowPass] = {}
    for turn in range(TURNS if len(groups) > 1 else 1):
        for group in groups:
            low_pass, noise = likeliest(problem, fit, noise, group, found)
            found |= dict.fromkeys(group, low_pass)
        if all(low_pass == NONE for low_pass in found.values()):
            return {}
        if turn == 0:
            fit = _refitted(problem, replace(fit, noise=noise), found)
    return {channel: low_pass for channel, low_pass in found.items() if low_pass != NONE}


def hidden_behind(passes: Mapping[str, LowPass], fit: Fit, problem: Problem) -> set[str]:
    """Effects that cannot be told from what is left of a low-pass.

    Where rotors follow at once, a command acts on the accelerations within its own row, and no inverse
    says how much of it a smoothed reading has seen: an exponent of the thrust does the same. Gyros
    taken back too far are ahead of attitudes, as if these came late (by 12 ms, worth 270 nats, on a
    **synthetic** flight where 6 Hz were found for 21, beside errors that last). Attitudes that come
    later than that by far do so by themselves: 48 ms, worth 1,841 nats, beside 4.3 ms of a low-pass.

    Args:
        passes: by channel. fit, problem: of the search before readings were taken back through them.
    """
    at_once = "motor_lag" not in {*fit.active, *problem.model.vehicle.effects}
    hidden = {LIKE[ACCELEROMETERS]} if at_once and passes.keys() & set(ACCELEROMETERS) else set()
    of_gyros = max((passes[c].delay for c in GYROS if c in passes), default=0.0)
    late = fit.values.get(f"{LIKE[GYROS]}.time", 0.0)
    return hidden | {LIKE[GYROS]} if late < LATER * of_gyros else hidden


def may_hide_behind(problem: Problem, fit: Fit, effect: str) -> bool:
    """Whether a low-pass too fast to be seen would do what an effect does.

    Accelerometers that lag a few milliseconds show less of what the rotors do, as a smaller exponent of
    the thrust does: one of 68 Hz, read at 100, was an exponent of 47 nats, sure, on a clean
    **synthetic** flight.

    Args:
        problem, fit: with the effect. effect: an active one.
    """
    felt = not problem.aboard.isdisjoint(ACCELEROMETERS)
    return effect == LIKE[ACCELEROMETERS] and felt and fit.values[f"{effect}.excess"] < 0.0


def remark(passes: Mapping[str, LowPass], hidden: Collection[str]) -> str:
    """That readings came through a low-pass, for who reads the findings.

    Args:
        passes: by channel. hidden: effects that are not asked for, therefore.
    """
    said = [
        f"{and_list([channel_name(c) for c in group])} of about {passes[group[0]].cut_off:.0f} Hz"
        f" ({('first', 'second')[passes[group[0]].order - 1]} order)"
        for group in (*GROUPS, ROTOR_SPEEDS)
        if group[0] in passes
    ]
    text = (
        f"readings come through a low-pass: {'; '.join(said)}."
        " They were taken back through it before causes were looked for; the simulation has none"
    )
    if hidden:
        text += (
            f"; {and_list([plain(e) for e in sorted(hidden)])} cannot be told from what is left of it:"
            " not looked for"
        )
    return text


def _alike(passes: Sequence[RunPass], channels: Sequence[str], group: Sequence[str]) -> float:
    """Correlation of neighbouring innovations, pooled over a group's channels [std of chance]."""
    of_each = []
    for channel in group:
        products, squares, count = 0.0, 0.0, 0
        for run in passes:
            e = run.innovations[:, channels.index(channel)]
            e = e[np.isfinite(e)]
            products += float(e[1:] @ e[:-1])
            squares += float(e @ e)
            count += e.size
        if count:
            of_each.append(products / squares * math.sqrt(count))
    return sum(of_each) / math.sqrt(max(len(of_each), 1))


def _pools(groups: Sequence[Sequence[str]]) -> list[Sequence[str]]:
    """Channels that are asked together: each group's, and each by itself, since signs may differ."""
    return [*groups, *([channel] for group in groups for channel in group)]


def likeliest(
    problem: Problem, fit: Fit, noise: Noise, group: Sequence[str], others: Mapping[str, LowPass]
) -> tuple[LowPass, Noise]:
    """A group's low-pass, NONE where it is not worth the threshold; the noise with it.

    Of one that was found already the order is known, and its time looked for anew.

    Args:
        problem, fit: after a search. noise: levels from which fits of them begin.
        group: channels. others: low-passes of all channels as found by now.
    """
    row, channels, chosen = problem.row, problem.model.channels, problem.settings

    def at(low_pass: LowPass) -> tuple[Engine, float]:
        passes = {**others, **dict.fromkeys(group, low_pass)}
        found = [before_low_pass(record, channels, passes) for record in problem.engine.records]
        records, nats = zip(*found, strict=True)
        return Engine(problem.model, records, problem.engine.threads), sum(nats)

    def fitted_at(low_pass: LowPass, levels: Noise) -> tuple[float, Noise]:
        engine, nats = at(low_pass)
        levels = fit_noise(
            engine, fit.values, levels, fit.levels,
            chosen.first_noise_evaluations, chosen.step_gain, problem.noise_fit_seconds,
        )  # fmt: skip
        return engine.log_likelihood(fit.values, levels) + nats, levels

    def scaled(levels: Noise, since: LowPass, to: LowPass) -> Noise:
        factor = to.noise_before(row) / since.noise_before(row)
        return levels.with_levels(
            {c: factor * levels.reading[c] for c in group if c in levels.reading}
        )

    def likelier_of(low_pass: LowPass, fitted_so: tuple[float, Noise]) -> tuple[float, Noise]:
        """As fitted, or from the levels of the search."""
        if fit.noise is noise:
            return fitted_so
        return max(
            fitted_so,
            fitted_at(low_pass, scaled(fit.noise, had, low_pass)),
            key=lambda fit: fit[0],
        )

    had = others.get(group[0], NONE)
    without = fitted_at(NONE, scaled(noise, had, NONE))
    tried: dict[tuple[int, int], tuple[LowPass, float, Noise]] = {}
    orders, places = [1, 2], list(range(len(TIMES)))
    if had != NONE:
        orders, places = [had.order], [_nearest(had.time / row)]
    for order in orders:
        near, levels = had, noise  # a fit begins where the one before it ended
        last, falls = without[0], 0
        for k in places:
            trial = LowPass(TIMES[k] * row, order)
            nats, levels = fitted_at(trial, scaled(levels, near, trial))
            tried[order, k], near = (trial, nats, levels), trial
            last, falls = nats, falls + 1 if nats < last else 0
            if falls == FALLS:
                break
    order, k = max(tried, key=lambda place: tried[place][1])
    best, _, levels = tried[order, k]
    bounds = (BOUNDS[0], *TIMES, BOUNDS[1])

    def cost(time: float) -> float:
        trial = LowPass(time * row, order)
        engine, nats = at(trial)
        return -engine.log_likelihood(fit.values, scaled(levels, best, trial)) - nats

    least = minimize_scalar(
        cost, bounds=(bounds[k], bounds[k + 2]), method="bounded", options={"xatol": WITHIN}
    )
    found = LowPass(float(least.x) * row, order)
    nats, levels = likelier_of(found, fitted_at(found, scaled(levels, best, found)))
    gained = nats - likelier_of(NONE, without)[0]
    problem.report(
        f"a low-pass of {found.cut_off:.0f} Hz, order {found.order}, of {', '.join(group)}:"
        f" {gained:.1f} nats"
    )
    return (found, levels) if gained > chosen.evidence else (NONE, scaled(noise, had, NONE))


def _nearest(time: float) -> int:
    """Place of the nearest of TIMES, by their ratios.

    Args:
        time: of a row.
    """
    return min(range(len(TIMES)), key=lambda k: abs(math.log(time / TIMES[k])))


def _refitted(problem: Problem, fit: Fit, passes: Mapping[str, LowPass]) -> Fit:
    """The fit to readings as they were before these: what was found may stand for them."""
    records = records_before(problem.engine.records, problem.model.channels, passes)
    return fitted(problem.with_records(records), fit)
