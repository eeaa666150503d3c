"""The entries of findings.json: causes, what is unexplained, the verdict."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from coax_env.diagnosis.confounding import untold
from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.problem import Fit, exclusive_with
from coax_env.diagnosis.trust import Trust, of_line, of_voltage
from coax_env.diagnosis.weighing import Weighed
from coax_env.estimation import vibration
from coax_env.estimation.battery import PER_VOLT, VOLTAGE, FeltVoltage, Line
from coax_env.estimation.changing_model import BEFORE
from coax_env.estimation.fitted_vehicle import with_timing
from coax_env.estimation.helicopter_noise import level_unit
from coax_env.estimation.parted_engine import AT, of_part
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.estimation.vibration import large
from coax_env.estimation.whiteness import Whiteness
from coax_env.model import effects
from coax_env.model.layout import CHANNELS
from coax_env.plain_words import plain

FORM = 0.01
"""Of an effect's number, by which it is unsure however clearly it shows: no form is right to better
(Settings.form_error). Where 40,000 nats and more showed it, **synthetic** flights by other forms had a
battery's sag 0.8 % off, a motor's droop 0.6 %, at 20 and 3 std of the readings alone."""


def causes(
    weighed: Weighed,
    trust: Mapping[str, Trust],
    lines: Sequence[vibration.Line],
    felt: FeltVoltage | None = None,
) -> list[dict[str, Any]]:
    """The causes: those that are sure before those that are doubtful, each strongest first.

    One that began or changed in flight has its `since`; its numbers are those after that moment, and
    where it was there before, those before it too, as `before`.

    Args:
        weighed: the causes.
        trust: what speaks for and against each name; one without a name is not among the causes.
        lines: of a vibration that the vehicle file does not have.
        felt: how speeds follow the battery's voltage, where that is known before the search.
    """
    problem, _, quadratic, evidence, _, found = weighed.settled
    fit, onsets = weighed.flown, weighed.onsets
    free = problem.free_names(fit.active)
    std = quadratic.std(free)
    dt = problem.row
    entries: list[dict[str, Any]] = []

    def number(f: FreeParameter, inflation: float) -> dict[str, float]:
        spread = stated_std(fit, f, std[f.name], inflation, dt)
        return {"value": float(fit.values[f.name]), "std": spread}

    for effect in (e for e in fit.active if trust[e].named):
        known = {f.name: f for f in problem.own[effect]}
        last = [f for f in known.values() if AT not in f.name]
        factor = evidence[effect].inflation
        alike = untold(problem, fit, quadratic, effect)
        entries.append(
            {
                "effect": effect,
                "parameters": {
                    f.name: {
                        **number(f, factor),
                        "unit": p.unit,
                        "determined": trust[effect].determined[f.name],
                    }
                    for f, p in zip(last, effects.CATALOGUE[effect].fitted, strict=True)
                },
                "evidence": evidence[effect].nats,
                "confusable_with": confusable_with(effect, found[effect], alike),
                "channels": list(trust[effect].channels),
                **trust[effect].entries(),
            }
        )
        if effect in onsets:
            earlier = {f.name: known.get(of_part(f.name, BEFORE)) for f in last}
            entries[-1]["since"] = onsets[effect].entry()
            entries[-1]["before"] = {n: number(f, factor) for n, f in earlier.items() if f}
    if sizes := large(lines):
        entries.append(_vibration(lines, sizes))
    if felt is not None and felt.line is not None:
        entries.append(_voltage(felt, felt.line))
    return _in_order(mixtures_as_one(entries))


def _in_order(entries: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Causes that are sure before those that are doubtful, each strongest first."""
    return sorted(entries, key=lambda c: (c["trust"] != "sure", -c["evidence"]))


def confusable_with(effect: str, alternatives: Iterable[str], alike: Iterable[str]) -> list[str]:
    """What a cause may as well be: its alternatives, and those that no flight or not this one tells.

    Args:
        effect: the cause. alternatives: that were fitted. alike: what this flight cannot tell from it.
    """
    never = effects.found_by_the_name_of(effect)
    return list(dict.fromkeys([*alternatives, *never, *alike]))


def mixtures_as_one(entries: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Causes of which one at most is named, such as a servo's lag and its delay, stated as one.

    It goes by the name of the stronger; the other is among its alternatives, and its numbers, which the
    model has too, are the entry's `mixture`. So the name is in doubt.
    """
    kept: list[dict[str, Any]] = []
    for weaker in sorted(entries, key=lambda c: -c["evidence"]):
        same = (c for c in kept if weaker["effect"] in exclusive_with(c["effect"]))
        stronger = next(same, None)
        if stronger is None:
            kept.append(dict(weaker))
            continue
        alike = dict.fromkeys([*stronger["confusable_with"], weaker["effect"]])
        mixed = f"it is a mixture with {plain(weaker['effect'])}"
        stronger |= {
            "trust": "doubtful",
            "doubts": [*stronger["doubts"], mixed],
            "confusable_with": [e for e in alike if e != stronger["effect"]],
            "channels": list(dict.fromkeys([*stronger["channels"], *weaker["channels"]])),
            "mixture": {**stronger.get("mixture", {}), **weaker["parameters"]},
        }
    return kept


def stated_std(
    fit: Fit, parameter: FreeParameter, std: float, inflation: float, dt: float
) -> float:
    """Std of a number that is reported, of an effect's with what its form may be wrong by.

    Args:
        fit: whose `std_ratio` corrects for what the signatures hold fixed.
        parameter: the number.
        std: by the signatures.
        inflation: variance inflation by coloured innovations.
        dt: seconds per row, for lags and delays.
    """
    spread = fit.spread(parameter.name, std, inflation)
    if "." in parameter.name:
        spread = math.hypot(spread, FORM * fit.values[parameter.name])
    return with_timing(parameter, spread, dt)


def _vibration(
    lines: Sequence[vibration.Line], sizes: Mapping[str, tuple[float, float]]
) -> dict[str, Any]:
    """The cause that is found by its lines; sizes: `large` of these."""
    own = [line for line in lines if line.kind in sizes]
    trust = of_line(max(own, key=lambda line: line.evidence))
    return {
        **_by_no_signature("vibration", sizes, sum(line.evidence for line in own), trust),
        "channels": list(dict.fromkeys(c for line in own for c in line.channels)),
    }


def _voltage(felt: FeltVoltage, line: Line) -> dict[str, Any]:
    """The cause that is found by the felt thrust; line: of `felt`."""
    spread = math.hypot(line.std, FORM * line.per_volt)
    sizes = {PER_VOLT.removeprefix(f"{VOLTAGE}."): (line.per_volt, spread)}
    return _by_no_signature(VOLTAGE, sizes, felt.evidence, of_voltage(felt))


def _by_no_signature(
    effect: str, sizes: Mapping[str, tuple[float, float]], evidence: float, trust: Trust
) -> dict[str, Any]:
    """The entry of a cause that is found otherwise than the others; sizes: value and std by number."""
    units = {p.name: p.unit for p in effects.CATALOGUE[effect].parameters}
    return {
        "effect": effect,
        "parameters": {
            f"{effect}.{name}": {
                "value": value,
                "std": std,
                "unit": units[name],
                "determined": True,
            }
            for name, (value, std) in sizes.items()
        },
        "evidence": evidence,
        "confusable_with": [],
        "channels": list(trust.channels),
        **trust.entries(),
    }


def unexplained(white: Mapping[str, Whiteness], described: Collection[str]) -> list[dict[str, Any]]:
    """Channels that are not white, beside those that generic terms describe."""
    return [
        {
            "channel": c,
            "depends_on": [],
            "share": round(w.coloured_share, 3),
            "form": "not found",
        }
        for c, w in white.items()
        if not w.white and c not in described
    ]


def without_a_name(
    evidence: Mapping[str, Evidence],
    trust: Mapping[str, Trust],
    white: Mapping[str, Whiteness],
) -> list[dict[str, Any]]:
    """Entries of `unexplained` for what the model has and no name is given to.

    Args:
        evidence: of each effect. trust: what speaks for and against each.
        white: whiteness of the innovations, by channel.
    """
    entries = []
    for effect in (e for e in trust if not trust[e].named):
        first = trust[effect].channels[0]
        entries.append(
            {
                "channel": first,
                "depends_on": [],
                "share": round(white[first].coloured_share, 3) if first in white else 0.0,
                "form": f"as {plain(effect)} would",
                "like": effect,
                "evidence": evidence[effect].nats,
                "why": list(trust[effect].doubts),
            }
        )
    return entries


def verdict(causes: Collection[Any], unexplained: Collection[Any]) -> str:
    """The verdict in a word: consistent, explained, partly explained, unexplained."""
    if causes:
        return "partly explained" if unexplained else "explained"
    return "unexplained" if unexplained else "consistent"


def innovations(passes: Sequence[RunPass]) -> dict[str, dict[str, np.ndarray]]:
    """Run -> time "t" and whitened innovations by channel, (n,) each."""
    result: dict[str, dict[str, np.ndarray]] = {}
    for run in passes:
        table = {"t": run.record.t}
        for i, channel in enumerate(CHANNELS):
            if np.isfinite(run.record.z[:, i]).any():
                table[channel] = run.innovations[:, i]
        result[run.record.name] = table
    return result


def noise_levels(noise: Noise) -> dict[str, dict[str, Any]]:
    """Every level of the noise, process and readings.

    A level that stands at a bound says so: noise that is not there stands at the least that no model
    is without.
    """
    return {
        name: {
            "value": float(noise.level(name)),
            "unit": level_unit(name),
            "at_bound": noise.at_bound(name),
        }
        for name in (*noise.process, *noise.reading)
    }
