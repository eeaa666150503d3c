"""The causes on a page: each as a sentence with its number, interval and evidence; look-alikes."""

from collections.abc import Mapping
from typing import Any

from coax_env.model import effects
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import (
    and_list,
    capital,
    channel_name,
    number,
    plain,
    title,
    unit_name,
)
from coax_env.report.consequences import NORMAL_95, outside_usual, sigmas, told
from coax_env.report.page import Markup, bullets, callout, card, cards, datum, numbers_table, prose

Findings = Mapping[str, Any]


def cause_blocks(findings: Findings, before: Vehicle, after: Vehicle) -> list[str]:
    """Every cause in words, strongest first, and all its numbers.

    before, after: the vehicle as given and the extended one.
    """
    causes = findings["causes"]
    alarms = prose(_false_alarms(findings.get("false_alarm_rate")))
    if not causes:
        nothing = prose("Nothing that these flights can show: no effect of the catalogue is named.")
        return [nothing, alarms]
    rows = [row for k, cause in enumerate(causes) for row in _rows(k, cause)]
    header = ["parameter", "value", "std", "95 % interval", "unit", "usual size"]
    return [
        cards(_card(k, cause, before, after) for k, cause in enumerate(causes)),
        prose(
            "In brackets: 95 % intervals. Sigma: the evidence (in nats, of the likelihood) as if it "
            "were that of one number so many standard deviations from zero."
        ),
        numbers_table("The numbers behind the sentences", header, rows),
        alarms,
    ]


def _card(place: int, cause: Mapping[str, Any], before: Vehicle, after: Vehicle) -> str:
    effect, twins = cause["effect"], cause["confusable_with"]
    entry = effects.CATALOGUE.get(effect)
    odd = entry is not None and outside_usual(effect, _values(cause))
    evidence = cause["evidence"]
    nats = datum(f"{number(evidence)} nats", f"causes/{place}/evidence", evidence)
    doubt = (
        f"**These flights cannot tell it from {and_list([plain(t) for t in twins])}.**"
        if twins
        else "Cannot be mistaken for another effect on these flights."
    )
    if odd:
        doubt += " **Its size is outside the usual range: take the name with care.**"
    if cause["channels"]:
        doubt += f" Showed in {and_list([channel_name(c) for c in cause['channels']])}."
    return card(
        title(effect),
        capital(told(cause, before, after) or "An effect of your own, see the numbers below."),
        [doubt],
        badge=Markup(f"{sigmas(evidence):.0f} sigma, {nats}"),
        kind="warning" if twins or odd else "",
    )


def _values(cause: Mapping[str, Any]) -> dict[str, float]:
    """Parameter's own name -> value."""
    return {name.rpartition(".")[2]: p["value"] for name, p in cause["parameters"].items()}


def _rows(place: int, cause: Mapping[str, Any]) -> list[list[str]]:
    """A cause's parameters in a table."""
    entry = effects.CATALOGUE.get(cause["effect"])
    usual = {f"{entry.name}.{p.name}": p.usual for p in entry.parameters} if entry else {}
    result = []
    for name, p in cause["parameters"].items():
        where, value, std = f"causes/{place}/parameters/{name}", p["value"], p["std"]
        ends = [number(value + side * NORMAL_95 * std) for side in (-1.0, 1.0)]
        result.append(
            [
                capital(plain(name)),
                datum(number(value), f"{where}/value", value),
                datum(number(std, 2), f"{where}/std", std),
                " to ".join(ends),
                unit_name(p["unit"]) or "1",
                number(usual.get(name), 2),
            ]
        )
    return result


def look_alike_blocks(findings: Findings) -> list[str]:
    """What these flights cannot tell apart, and the maneuver that would."""
    tied = [c for c in findings["causes"] if c["confusable_with"]]
    following = findings.get("next_maneuver")
    blocks = []
    if tied:
        blocks.append(
            bullets(
                f"**{title(c['effect'])}** cannot be told from "
                f"{and_list([plain(t) for t in c['confusable_with']])} on these flights."
                for c in tied
            )
        )
    elif findings["causes"]:
        blocks.append(
            callout("Every cause named here stands alone: nothing else would do.", "good")
        )
    if following:
        parted = and_list([plain(s) for s in following["separates"]])
        blocks.append(
            callout(
                f"**Fly next: {plain(following['maneuver'])}.** It parts {parted}: "
                f"{following['why'].rstrip('.')}."
            )
        )
    elif tied:
        blocks.append(
            callout("No maneuver is known that would part them at these sensors.", "note")
        )
    return blocks


def _false_alarms(rate: float | None) -> str:
    if rate is None:
        return "How often a cause is named where there is none has not been calibrated yet."
    return (
        "**False alarms.** Calibrated on clean synthetic flights: the threshold lets a false cause "
        f"through in {100 * rate:.2g} % of them."
    )
