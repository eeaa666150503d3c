"""The page of a machine's logbook: its numbers over flights, changes marked."""

from collections.abc import Mapping
from typing import Any

from coax_env.plain_words import (
    bounds,
    capital,
    count_word,
    number,
    plain,
    read_factor,
    title,
    unit_name,
    with_std,
)
from coax_env.report.consequences import NORMAL_95
from coax_env.report.page import (
    Section,
    callout,
    card,
    cards,
    command,
    figure,
    folded_table,
    page,
    prose,
    side_by_side,
)
from coax_env.report.plot_style import AFTER, BEFORE, MEASURED, Figure, figure_of

Content = Mapping[str, Any]
HOW_TO_READ = (
    "In the figures, points are by each flight alone; the band is by all flights so far, the posterior "
    "of the last as the prior of the next, opened where a change is named (dotted line). Both are 95 % "
    "intervals."
)


def logbook_page(content: Content, command_line: str = "") -> str:
    """The logbook as HTML text.

    Args:
        content: as in logbook.json.
        command_line: what was typed.
    """
    flights, changes = content["flights"], content["changes"]
    since = sorted({c["since"] for c in changes}, key=[f["name"] for f in flights].index)
    headline = (
        f"{capital(count_word(len(changes)))} change{'s' if len(changes) > 1 else ''} in "
        f"{count_word(len(flights))} flights"
        if changes
        else f"The machine is the same in all {count_word(len(flights))} flights"
    )
    changed = {n for c in changes for n in c["parameters"]}
    numbers = content["numbers"]
    first = [n for n in numbers if n in changed]
    rest = [n for n in numbers if n not in changed]
    sections = [
        Section("What changed", [*_changes(changes), prose(HOW_TO_READ)]),
        Section("Numbers that changed", _figures(content, first)),
        Section("The other numbers", _figures(content, rest)),
        Section("Circumstances", _circumstances(content)),
        Section("In numbers", [_table(content)] if numbers else []),
        Section("How this was computed", [command(command_line)] if command_line else []),
    ]
    lead = [f"Since {name}: {_names(changes, name)}." for name in since] or [
        "No two neighbouring flights differ in what belongs to the machine."
    ]
    return page(
        headline,
        lead,
        [section for section in sections if any(section.blocks)],
        kicker=f"Logbook · {flights[0]['name']} to {flights[-1]['name']}" if flights else "Logbook",
    )


def _names(changes: Any, since: str) -> str:
    return ", ".join(plain(c["effect"]) for c in changes if c["since"] == since)


def _changes(changes: Any) -> list[str]:
    if not changes:
        return [callout("The same from the first flight to the last.", "good")]
    shown = []
    for c in changes:
        sizes = ", ".join(
            f"{plain(n.partition('.')[2])} "
            f"{bounds(p['change'], NORMAL_95 * p['std'], p['unit'], signed=True)}"
            for n, p in c["parameters"].items()
        )
        lines = [f"Between {c['after']} and {c['since']}."]
        if c["confusable_with"]:
            lines.append(
                f"**Or:** a change of {', '.join(plain(n) for n in c['confusable_with'])}."
            )
        kind = "warning" if c["confusable_with"] else ""
        shown.append(card(title(c["effect"]), sizes, lines, f"{number(c['evidence'])} nats", kind))
    return [cards(shown)]


def _figures(content: Content, names: list[str]) -> list[str]:
    if not names:
        return []
    return [
        side_by_side(
            figure(_over_time(content, n), label=f"{plain(n)} over the flights") for n in names
        ),
    ]


_SHOWN = ("value", "std", "alone", "alone_std")
"""What a figure shows of a number in each flight."""


def _over_time(content: Content, name: str) -> Figure:
    """One number over the flights."""
    known = content["numbers"][name]
    by = read_factor(known["unit"])
    rows = [{key: by * r[key] for key in _SHOWN} for r in known["flights"]]
    x = [f["name"] for f in content["flights"]]
    low = [r["value"] - NORMAL_95 * r["std"] for r in rows]
    high = [r["value"] + NORMAL_95 * r["std"] for r in rows]
    fill = {"type": "scatter", "mode": "lines", "line": {"width": 0}, "hoverinfo": "skip",
            "showlegend": False}  # fmt: skip
    data: list[dict[str, Any]] = [
        fill | {"x": x, "y": low},
        fill | {"x": x, "y": high, "fill": "tonexty", "fillcolor": "rgba(47,143,214,0.25)"},
        {
            "type": "scatter", "mode": "lines", "x": x, "y": [r["value"] for r in rows],
            "line": {"color": AFTER, "width": 2}, "name": "all so far",
            "hovertemplate": "%{y:.4~g}",
        },
        {
            "type": "scatter", "mode": "markers", "x": x, "y": [r["alone"] for r in rows],
            "name": "alone", "marker": {"color": MEASURED, "size": 6},
            "error_y": {
                "type": "data", "array": [NORMAL_95 * r["alone_std"] for r in rows],
                "color": MEASURED, "thickness": 1, "width": 0,
            },
            "hovertemplate": "%{y:.4~g}",
        },
    ]  # fmt: skip
    marks = [
        {
            "type": "line", "xref": "x", "yref": "paper", "x0": x.index(c["since"]) - 0.5,
            "x1": x.index(c["since"]) - 0.5, "y0": 0, "y1": 1,
            "line": {"color": BEFORE, "width": 2, "dash": "dot"},
        }
        for c in content["changes"]
        if name in c["parameters"]
    ]  # fmt: skip
    unit = unit_name(known["unit"])
    words = f"{plain(name)} [{unit}]" if unit else plain(name)
    return figure_of(
        data, 260, shapes=marks, title={"text": words, "font": {"size": 14}}, showlegend=False,
        xaxis={"type": "category"}, yaxis={"exponentformat": "power"},
        margin={"l": 60, "r": 10, "t": 40, "b": 36},
    )  # fmt: skip


def _circumstances(content: Content) -> list[str]:
    """Gusts of each flight, which are the air's."""
    flights = content["flights"]
    by_mark: dict[str, Any] = {}
    for link in content["links"]:
        by_mark.setdefault(link["a"], link["circumstances"]["A"])
        by_mark[link["b"]] = link["circumstances"]["B"]
    header = ["flight", "gusts, force x y [N]", "force z [N]", "moment x y [N m]", "moment z [N m]"]
    rows = [
        [f["name"], *(number(by_mark[f["hash"]]["gusts"][g]) for g in
                      ("force_xy", "force_z", "moment_xy", "moment_z"))]
        for f in flights
        if f["hash"] in by_mark
    ]  # fmt: skip
    return [folded_table("The air of each flight", header, rows)] if rows else []


def _table(content: Content) -> str:
    header = ["number", *(f["name"] for f in content["flights"])]
    rows = [
        [plain(n), *(with_std(r["value"], r["std"], known["unit"]) for r in known["flights"])]
        for n, known in content["numbers"].items()
    ]
    return folded_table("Every number after every flight", header, rows)
