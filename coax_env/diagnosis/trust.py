"""When may a name be believed? Each cause is sure, or doubtful with the reasons in plain words.

Sure is what holds: under half and twice every noise level (noise_variation.py), without any one run and
on halves of the flights (replication.py), with white innovations where it shows, a usual size and no
cause at its limit beside it, a number that the flights determine, no other effect that would do as
well, and more evidence than something that no list has, or a single gust (shocks.py), gives a wrong
name. A doubtful cause still improves the model, and stays in it.

No name at all has what stands at the limit of what is believed and is not determined, or does not hold
under other noise or on parts of the flights; nor what two of these speak against: other noise, parts of
the flights, noise left where it shows, little evidence there, such a one beside it. The model keeps it,
findings tell it among what is unexplained.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from coax_env.diagnosis.confounding import Alternatives, channels_of
from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.noise_variation import not_holding
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.replication import Asked, Replication, halves_of, of_runs, replications
from coax_env.diagnosis.settings import SETTINGS, Settings
from coax_env.diagnosis.shocks import in_shocks
from coax_env.diagnosis.vibration import Line
from coax_env.estimation.helicopter import MOST_USUAL_SIZES, UNUSUAL_FROM
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter
from coax_env.estimation.whiteness import Whiteness
from coax_env.model import effects
from coax_env.plain_words import and_list, channel_name, plain

AT_BOUND = 0.99
"""Share of the most usual sizes from which a number stands at its bound; ours."""
SPEAKING_AGAINST = 2
"""Of what speaks against a name so much takes it: colour where it shows, little evidence beside that,
parts of the flights and noise under which it does not hold, something at its limit beside it; ours."""
MOST_VARIATIONS = 3
"""Variations of the noise that a doubt names; of more, their number; ours."""


@dataclass(frozen=True)
class Trust:
    """What is known of a name.

    Attributes:
        noise: it holds at half and twice every noise level.
        runs: share of left-out runs without which it returns.
        kept: share of halves in which it returns; None where none could tell.
        determined: parameter -> whether the flights say more of it than its prior did.
        doubts: reasons against the name, in plain words; none: it is sure.
        named: whether it is stated as a cause; what is not is told among the unexplained.
    """

    noise: bool
    runs: float
    kept: float | None
    determined: Mapping[str, bool]
    doubts: tuple[str, ...]
    named: bool = True

    @property
    def word(self) -> str:
        """findings.json's `trust`."""
        return "doubtful" if self.doubts else "sure"

    def entries(self) -> dict[str, Any]:
        """What findings.json has of it, beside `determined`."""
        return {
            "robust": {"noise": self.noise, "runs": self.runs, "kept": self.kept},
            "trust": self.word,
            "doubts": list(self.doubts),
            "since": None,
        }


def trusts(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    found: Alternatives,
    white: Mapping[str, Whiteness],
) -> dict[str, Trust]:
    """Every active effect judged.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit, its runs in it.
        evidence: of each cause.
        found: the confounded alternatives of each cause.
        white: whiteness of the innovations, by channel.
    """
    worth = {effect: weighed.nats for effect, weighed in evidence.items()}
    replicated = replications(problem, fit, quadratic, worth)
    falling = not_holding(problem, fit, quadratic, worth)
    shaken = bool(fit.active) and in_shocks(problem, fit)
    runs = len(of_runs(problem.engine.records))
    channels = {e: channels_of(problem, fit, quadratic, e) for e in fit.active}
    limited = {e: channels[e] for e in fit.active if at_limit(problem, fit, e)}
    result = {}
    unnamed: dict[str, Sequence[str]] = {}
    for effect in sorted(fit.active, key=lambda e: e not in limited):
        known = determined(problem, fit, quadratic, effect, evidence[effect].inflation)
        coloured = list(_not_white(channels[effect], white))
        undetermined = list(_undetermined(problem, effect, known))
        doubts = (
            *coloured,
            *_under_noise(falling[effect]),
            *on_parts(replicated[effect], runs, problem.settings),
            *_sizes(problem, fit, effect),
            *_beside_limits(effect, channels[effect], limited),
            *undetermined,
            *_alternatives(found[effect]),
            *_weak(worth[effect], shaken, problem.settings),
        )
        of_parts = replicated[effect]
        gone = _gone_without_runs(of_parts, runs, problem.settings)
        gone |= _gone_in_halves(of_parts, problem.settings)
        if effect in limited and (falling[effect] or gone or undetermined):
            unnamed[effect] = channels[effect]
        beside = list(_beside_limits(effect, channels[effect], unnamed))
        weak = coloured and worth[effect] < problem.settings.sure_evidence
        against = (coloured, weak, falling[effect], gone, beside)
        if sum(map(bool, against)) >= SPEAKING_AGAINST:
            unnamed.setdefault(effect, ())
        result[effect] = Trust(
            not falling[effect], of_parts.runs, of_parts.kept, known, tuple(doubts),
            effect not in unnamed,
        )  # fmt: skip
    return {effect: result[effect] for effect in fit.active}


def of_line(line: Line, chosen: Settings = SETTINGS) -> Trust:
    """What is known of a vibration, which is found by its line and not by a signature.

    Its evidence compares the line with its neighbours, so that no level of noise is in it.

    Args:
        line: with its segments.
        chosen: what decides.
    """
    runs = [name for name, ratios in line.ratios.items() if ratios]
    rest = [[r for n in runs if n != out for r in line.ratios[n]] for out in runs]
    every = [r for n in runs for r in line.ratios[n]]
    groups = [range(len(every))]
    halves = [[every[i] for i in half] for half in halves_of(groups, chosen.splits)]

    def returns(part: Sequence[float]) -> bool:
        asked = Asked(len(part) / len(every), 1.0, line.evidence, chosen)
        return asked.can_tell and asked.margin(line.evidence_of(part)) >= 0.0

    of_parts = Replication(
        sum(map(returns, rest)) / len(runs),
        sum(map(returns, halves)) / len(halves) if halves else None,
        tuple(name for name, part in zip(runs, rest, strict=True) if not returns(part)),
    )
    doubts = tuple(on_parts(of_parts, len(runs), chosen))
    return Trust(True, of_parts.runs, of_parts.kept, {f"vibration.{line.kind}": True}, doubts)


def determined(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, inflation: float
) -> dict[str, bool]:
    """Whether the flights determine each of an effect's parameters, or its interval is the prior's.

    Args:
        problem, fit: with the effect.
        quadratic: linearised at the fit.
        effect: an active one.
        inflation: of the data's variance, by coloured innovations.
    """
    free = problem.free_names(fit.active)
    variance = dict(zip(free, quadratic.covariance(free).diagonal(), strict=True))
    result = {}
    for f in problem.own[effect]:
        of_data = max(1.0 / variance[f.name] - 1.0 / f.std**2, 0.0) / inflation
        left = 1.0 / math.sqrt(1.0 + of_data * f.std**2)  # std over the prior's
        result[f.name] = left <= problem.settings.undetermined
    return result


# --- what speaks against a name ---------------------------------------------------------------------


def _not_white(channels: Sequence[str], white: Mapping[str, Whiteness]) -> Iterable[str]:
    coloured = [channel_name(c) for c in channels if c in white and not white[c].white]
    if coloured:
        yield f"it shows in {and_list(coloured)}, where the model leaves more than noise"


def _under_noise(variations: Sequence[str]) -> Iterable[str]:
    if variations:
        shown = list(variations[:MOST_VARIATIONS])
        if len(variations) > MOST_VARIATIONS:
            shown.append(f"{len(variations) - MOST_VARIATIONS} more changes of the noise")
        yield f"it does not hold at {and_list(shown)}"


def on_parts(of_parts: Replication, runs: int, chosen: Settings) -> Iterable[str]:
    """What left-out runs and halves say against a name.

    Args:
        of_parts: how it fared.
        runs: number of runs that were fitted.
        chosen: the shares that it needs.
    """
    if runs < 2:
        yield "one run alone was fitted"
    elif _gone_without_runs(of_parts, runs, chosen):
        if len(of_parts.rests_on) == 1:
            yield f"it rests on {of_parts.rests_on[0]} alone"
        else:
            yield f"it is gone without {' or without '.join(of_parts.rests_on)}"
    if of_parts.kept is None:
        yield "no half of the flights could tell"
    elif _gone_in_halves(of_parts, chosen):
        yield f"it returns in {100.0 * of_parts.kept:.0f} % of the halves of the flights"


def _gone_without_runs(of_parts: Replication, runs: int, chosen: Settings) -> bool:
    """Whether a name does not return without enough of the runs; of one run nothing is left out."""
    return runs > 1 and of_parts.runs < chosen.least_runs


def _gone_in_halves(of_parts: Replication, chosen: Settings) -> bool:
    """Whether a name does not return in enough of the halves that could tell, where some could."""
    return of_parts.kept is not None and of_parts.kept < chosen.least_kept


def _sizes(problem: Problem, fit: Fit, effect: str) -> Iterable[str]:
    for f in problem.model.effect_parameters(
        effect
    ):  # usual sizes, however wide the priors are now
        size = abs(fit.values[f.name] - f.value)
        if _is_limit(size, f):
            limit = f"{plain(f.name)} stands at the limit of what is believed"
            yield f"{limit}: something else hides behind the name"
        elif size > UNUSUAL_FROM * f.std:
            yield f"{plain(f.name)} is {size / f.std:.1f} usual sizes"


def at_limit(problem: Problem, fit: Fit, effect: str) -> bool:
    """Whether a number of an effect is as large as is believed at most.

    Args:
        problem, fit: with the effect. effect: an active one.
    """
    numbers = problem.model.effect_parameters(effect)
    return any(_is_limit(abs(fit.values[f.name] - f.value), f) for f in numbers)


def _is_limit(size: float, f: FreeParameter) -> bool:
    return size > AT_BOUND * MOST_USUAL_SIZES * f.std


def _beside_limits(
    effect: str, channels: Sequence[str], limited: Mapping[str, Sequence[str]]
) -> Iterable[str]:
    """What stands at its limit leaves a part of itself to others that show in its channels."""
    others = [plain(e) for e, of in limited.items() if e != effect and set(of) & set(channels)]
    if others:
        limit = f"{and_list(others)} beside it stands at the limit of what is believed"
        yield f"{limit}: it may be a part of that"


def _undetermined(problem: Problem, effect: str, known: Mapping[str, bool]) -> Iterable[str]:
    if not any(known[name] for name in problem.acting_names(effect)):
        yield "none of its numbers is determined"


def _alternatives(names: Iterable[str]) -> Iterable[str]:
    alternatives = [plain(name) for name in names]
    if alternatives:
        yield f"these flights cannot distinguish it from {and_list(alternatives)}"


def _weak(nats: float, shaken: bool, chosen: Settings) -> Iterable[str]:
    if shaken and nats < chosen.clear_evidence * chosen.evidence:
        yield f"gusts come in single shocks here, and {nats:.0f} nats may be one of them"
    elif nats < chosen.sure_evidence:
        yield f"it is worth {nats:.0f} nats only: an effect that is in no list may look like it"


# --- priors beside a large axis ---------------------------------------------------------------------


def beside_large_axes(problem: Problem, fit: Fit) -> Problem:
    """With the priors of an effect's other axes as wide as the largest that was found.

    Where x is five times its usual size, that y and z are usual is not known.

    Args:
        problem, fit: after the search.
    """
    own = dict(problem.own)
    for effect in fit.active:
        acting = set(problem.acting_names(effect))
        axes = [f for f in own[effect] if f.name in acting]
        units = {p.unit for p in effects.CATALOGUE[effect].parameters if not p.shape}
        largest = max(abs(fit.values[f.name] - f.value) / f.std for f in axes)
        if len(axes) > 1 and len(units) == 1 and largest > UNUSUAL_FROM:
            own[effect] = tuple(
                replace(f, std=largest * f.std) if f.name in acting else f for f in own[effect]
            )
    return replace(problem, own=own)
