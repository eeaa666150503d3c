"""The causes on a page: each with its size in words, interval, evidence and alternatives."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from coax_env.model import effects
from coax_env.model.usual_sizes import sized_for
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import (
    and_list,
    bounds,
    capital,
    channel_name,
    number,
    plain,
    read_factor,
    title,
    unit_name,
    whole_percent,
)
from coax_env.report.consequences import NORMAL_95, described, sigmas
from coax_env.report.page import (
    Markup,
    Section,
    bullets,
    callout,
    card,
    cards,
    datum,
    folded_table,
    inline,
    prose,
)

Findings = Mapping[str, Any]


def cause_sections(
    findings: Findings, bare: Vehicle, corrected: Vehicle, remarks: Sequence[str] = ()
) -> list[Section]:
    """Every cause in words, sure and doubtful ones apart, strongest first, and all its numbers.

    Args:
        findings: as in findings.json.
        bare: the vehicle as given.
        corrected: the vehicle with the causes in it.
        remarks: of the diagnosis; what begins with a cause's number is said beside the cause.
    """
    causes = findings["causes"]
    if not causes:
        nothing = prose("No effect of the catalogue is named: these flights show none.")
        return [Section("The causes", [nothing])]
    rows = [row for k, cause in enumerate(causes) for row in _rows(k, cause, bare)]
    header = ["parameter", "value", "std", "95 % interval", "unit", "usual size"]
    numbers = [
        prose(
            "In brackets: 95 % intervals. Evidence is the gain in log-likelihood over the best "
            "model without the cause, in nats: 5 nats are odds of 150 to 1. In sigma it is that of one "
            "number so many standard deviations from zero."
        ),
        folded_table("The parameters in numbers", header, rows),
        folded_table("Why a name is believed", _ROBUST_HEADER, map(_robust_row, causes)),
    ]
    shown = {t: [(k, c) for k, c in enumerate(causes) if c["trust"] == t] for t in TRUST}
    sections = [
        Section(
            heading,
            [prose(words), cards(_card(k, c, bare, corrected, remarks) for k, c in shown[t])],
        )
        for t, (heading, words) in TRUST.items()
        if shown[t]
    ]
    last = sections[-1]
    return [*sections[:-1], Section(last.title, [*last.blocks, *numbers])]


TRUST = {
    "sure": (
        "Causes that are sure",
        "**Sure.** These names hold at half and twice every noise level, on parts of the flights, "
        "and no other effect of the catalogue does as well.",
    ),
    "doubtful": (
        "Doubtful causes",
        "**Doubtful.** With these the model predicts better, but the flights do not settle the "
        "name: another cause may hide behind it.",
    ),
}
"""How far a cause's name may be believed -> the heading of such causes, and what that means."""
AT_ONCE = 0.95
"""Probability from which on a cause is said to have come at once; ours."""
_ROBUST_HEADER = [
    "cause", "name is", "under other noise", "left-out runs", "halves", "held-out runs",
    "size where it shows",
]  # fmt: skip


def _robust_row(cause: Mapping[str, Any]) -> list[str]:
    """What a cause's name withstood, in a table."""
    robust, unseen, most = cause["robust"], cause.get("unseen"), cause.get("where_most")
    return [
        capital(plain(cause["effect"])),
        cause["trust"],
        "holds" if robust["noise"] else "falls",
        f"returns in {whole_percent(100.0 * robust['runs'])}",
        "could not tell"
        if robust["kept"] is None
        else f"returns in {whole_percent(100.0 * robust['kept'])}",
        f"worth {number(unseen['nats'])} nats" if unseen else "not asked",
        f"{most['size']:.2f} of all" if most else "not asked",
    ]


def _card(
    index: int,
    cause: Mapping[str, Any],
    bare: Vehicle,
    corrected: Vehicle,
    remarks: Sequence[str],
) -> str:
    effect, doubts = cause["effect"], cause["doubts"]
    lines = [f"**{capital(since(cause))}.** {_was(cause)}"] if cause.get("since") else []
    lines += [f"**{capital(doubt)}.**" for doubt in doubts] or [
        "Within the catalogue and this class of noise no other effect fits these flights equally well."
    ]
    if cause["channels"]:
        lines.append(f"Seen in {and_list([channel_name(c) for c in cause['channels']])}.")
    lines += [f"{remark}." for remark in remarks if remark.startswith(f"{effect}.")]
    evidence = cause["evidence"]
    nats = datum(f"{number(evidence)} nats", f"causes/{index}/evidence", evidence)
    return card(
        title(effect),
        capital(
            described(cause, bare, corrected) or "An effect of your own, see the numbers below."
        ),
        [" ".join(lines)],
        badge=Markup(f"{inline(f'{sigmas(evidence):.0f} sigma')}, {nats}"),
        kind="warning" if doubts else "",
    )


def since(cause: Mapping[str, Any]) -> str:
    """When a cause began, changed or grew, in words, with 95 % intervals."""
    moment = cause["since"]
    words = f"since {_moment(moment)}"
    if moment["grown"]:
        return f"growing {words}, grown at {_moment(moment['grown'])}"
    if moment["at_once"] < AT_ONCE:
        words += " (whether it came at once or grew, these flights do not tell)"
    return words


def _moment(moment: Mapping[str, Any]) -> str:
    return f"{bounds(moment['t'], NORMAL_95 * moment['std'], 's')} of run {moment['run']}"


def _was(cause: Mapping[str, Any]) -> str:
    """What it was before that."""
    earlier = [
        f"{plain(name)} {number(p['value'])} ± {number(p['std'], 2)}"
        for name, p in cause["before"].items()
    ]
    was = f"Before it was {and_list(earlier)}" if earlier else "Before, it was not there"
    return f"{was}; the numbers, and the corrected vehicle, are as after that moment."


def _plain_list(names: list[str]) -> str:
    return and_list([plain(name) for name in names])


def _rows(index: int, cause: Mapping[str, Any], vehicle: Vehicle) -> list[list[str]]:
    """A cause's parameters in a table."""
    effect = cause["effect"]
    sized = sized_for(vehicle, effect) if effect in effects.CATALOGUE else ()
    usual = {f"{effect}.{p.name}": p.usual for p in sized}
    result = []
    for name, p in cause["parameters"].items():
        place, value, std = f"causes/{index}/parameters/{name}", p["value"], p["std"]
        by = read_factor(p["unit"])
        ends = [number(by * (value + side * NORMAL_95 * std)) for side in (-1.0, 1.0)]
        result.append(
            [
                capital(plain(name)),
                datum(number(by * value), f"{place}/value", value, by),
                datum(number(by * std, 2), f"{place}/std", std, by),
                " to ".join(ends) if p["determined"] else "not determined",
                unit_name(p["unit"]) or "1",
                number(by * usual.get(name, math.nan), 2),
            ]
        )
    return result


def confounding_blocks(findings: Findings) -> list[str]:
    """The confounded alternatives of the causes, and the maneuver that would separate them."""
    confounded = [c for c in findings["causes"] if c["confusable_with"]]
    following = findings.get("next_maneuver")
    blocks: list[str] = []
    if confounded:
        blocks += [
            prose("Effects that would fit these flights about as well as the cause named:"),
            bullets(
                f"**{title(c['effect'])}** or {_plain_list(c['confusable_with'])}"
                for c in confounded
            ),
        ]
    elif findings["causes"]:
        blocks.append(
            callout(
                "None within the catalogue and this class of noise: no other effect of it fits these "
                "flights as well as the causes named.",
                "good",
            )
        )
    if following:
        blocks.append(
            callout(
                f"**Fly next: {plain(following['maneuver'])}.** It separates "
                f"{_plain_list(following['separates'])}: {following['why'].rstrip('.')}."
            )
        )
    elif confounded:
        blocks.append(
            callout("No maneuver is known that would separate them at these sensors.", "note")
        )
    return blocks
