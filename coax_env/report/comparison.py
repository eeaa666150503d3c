"""The report of a comparison: what changed in a machine between two flights, and what did not."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from coax_env.plain_words import (
    and_list,
    bounds,
    capital,
    channel_name,
    count_word,
    number,
    plain,
    title,
    with_std,
    with_unit,
)
from coax_env.report.consequences import NORMAL_95
from coax_env.report.flight_data import data_blocks
from coax_env.report.page import (
    Section,
    bullets,
    callout,
    card,
    cards,
    command,
    datum,
    details,
    figure,
    folded_table,
    page,
    prose,
    table,
)
from coax_env.report.plot_style import AFTER, BEFORE, NOISE, Figure, figure_of

if TYPE_CHECKING:
    from coax_env.comparison.compare import Comparison

Changes = Mapping[str, Any]
CIRCUMSTANCES = {
    "wind.north": ("wind, north", "m/s"), "wind.east": ("wind, east", "m/s"),
    "battery_sag.rate": ("rotor speed per command, lost per second", "1/s"),
    "rotor_speed.scale": ("rotor speed per command, beside A", "1"),
    "air_density": ("air density, beside what the cards say", "kg/m3"),
    "ground_effect.gain": ("ground effect, beside A", "1"),
}  # fmt: skip
GUSTS = {
    "force_xy": ("gusts, force along x and y", "N"), "force_z": ("gusts, force along z", "N"),
    "moment_xy": ("gusts, moment about x and y", "N m"),
    "moment_z": ("gusts, moment about z", "N m"),
}  # fmt: skip


def comparison_page(result: "Comparison", command_line: str = "") -> str:
    """The report of one comparison as HTML text.

    Args:
        result: of `coax_env.compare`.
        command_line: what was typed.
    """
    changes = result.changes
    sections = [
        Section("What changed", _changed(changes)),
        Section("What did not change, and how well that is known", _unchanged(changes)),
        Section("Air, battery and gusts", _circumstances(changes)),
        Section("What both share", _shared(changes)),
        Section("Unexplained", _unexplained(changes)),
        Section("The flights", _flights(result)),
        Section("How this was computed", [command(command_line)] if command_line else []),
    ]
    names = [f.flight.path.name if f.flight.path else f.name for f in result.flights]
    return page(
        change_headline(changes),
        _lead(changes),
        [section for section in sections if any(section.blocks)],
        kicker=f"Comparison · {names[0]} (A) and {names[1]} (B) · vehicle "
        f"{result.flights[0].vehicle.name}",
    )


def change_headline(changes: Changes) -> str:
    """The verdict in one sentence."""
    names = [plain(c["effect"]) for c in changes["changes"]]
    if changes.get("of_one_flight"):
        said = and_list(names) if names else "nothing that an effect explains"
        return f"Two logs of one flight differ by {said}"
    if not names:
        return "The machine is the same in both flights"
    return f"Between the flights changed: {and_list(names)}"


def _lead(changes: Changes) -> list[str]:
    if changes.get("of_one_flight"):
        return [*changes["remarks"], *(f"{_change(c)}." for c in changes["changes"])]
    if not changes["changes"]:
        return [
            "Nothing that these flights can show has changed. Wind, gusts, air density, the battery's "
            "state and the pilot may differ; they are fitted for each flight and are never a change."
        ]
    return [f"{_change(c)}; {number(c['evidence'])} nats." for c in changes["changes"]]


def _change(change: Mapping[str, Any]) -> str:
    return f"{capital(plain(change['effect']))}: {_sizes(change)}"


def _sizes(change: Mapping[str, Any]) -> str:
    """The numbers that moved by more than two std, or the one that moved most."""
    parameters = sorted(
        change["parameters"].items(),
        key=lambda item: -abs(item[1]["change"]) / max(item[1]["std"], 1e-300),
    )
    shown = [n for n, p in parameters if abs(p["change"]) > 2.0 * p["std"]] or [parameters[0][0]]
    return ", ".join(
        f"{plain(n.partition('.')[2])} "
        f"{bounds(p['change'], NORMAL_95 * p['std'], p['unit'], signed=True)}"
        for n, p in parameters
        if n in shown
    )


def _changed(changes: Changes) -> list[str]:
    if not changes["changes"]:
        return [callout("The same: no change is worth naming.", "good")]
    shown, rows = [], []
    for k, c in enumerate(changes["changes"]):
        nats = datum(f"{number(c['evidence'])} nats", f"changes/{k}/evidence", c["evidence"])
        lines = ["Every other change fits these flights worse."]
        if c["confusable_with"]:
            names = and_list([plain(n) for n in c["confusable_with"]])
            lines = [f"**These flights cannot distinguish it from** a change of {names}."]
        shown.append(
            card(
                title(c["effect"]),
                _sizes(c),
                lines,
                nats,
                "warning" if c["confusable_with"] else "",
            )
        )
        rows += [
            [plain(name), *(with_unit(p[key], p["unit"]) for key in _SHOWN)]
            for name, p in c["parameters"].items()
        ]  # fmt: skip
    return [
        cards(shown),
        table(["number", "before", "after", "change", "std"], rows),
        prose(f"In brackets: 95 % intervals of the difference. {_evidence(changes)}"),
    ]


def _evidence(changes: Changes) -> str:
    """What the nats are."""
    if changes.get("of_one_flight"):
        return (
            "The nats are what the change would be worth in a flight with noise of its own. Here the "
            "noise is the same in both logs, and what is worth less is seen too."
        )
    return (
        "Evidence is a log Bayes factor in nats: 5 nats are odds of 150 to 1, and 14 are needed for a "
        "name."
    )


_SHOWN = ("before", "after", "change", "std")
"""What the table shows of a number that changed."""


def _unchanged(changes: Changes) -> list[str]:
    """Every number's difference, one change at a time, in usual sizes."""
    if not changes["bounds"]:
        return []
    named = {c["effect"] for c in changes["changes"]}
    rows = [
        [
            plain(name),
            with_std(b["value"], b["std"], b["unit"]),
            with_unit(b["usual"], b["unit"]),
            number(b["nats"]),
        ]
        for name, b in changes["bounds"].items()
    ]
    return [
        prose(
            "Each line is the difference of one number between the flights, with its 95 % interval, "
            "were it alone what changed. Short lines about zero: it did not change, and that is known. "
            "Long ones: these flights cannot tell. Everything both flights share is free."
        ),
        figure(_bounds_figure(changes["bounds"], named), "Differences in usual sizes."),
        folded_table(
            "These differences in numbers", ["number", "difference", "usual size", "nats"], rows
        ),
    ]


def _bounds_figure(known: Mapping[str, Mapping[str, Any]], named: set[str]) -> Figure:
    names = sorted(known, key=lambda n: -known[n]["std"] / known[n]["usual"])
    data = []
    for own, colour, label in ((False, AFTER, "not named"), (True, BEFORE, "named")):
        chosen = [n for n in names if (n.partition(".")[0] in named) == own]
        if chosen:
            data.append(
                {
                    "type": "scatter", "mode": "markers", "name": label,
                    "x": [known[n]["value"] / known[n]["usual"] for n in chosen],
                    "y": [plain(n) for n in chosen],
                    "error_x": {
                        "type": "data", "thickness": 2, "width": 0, "color": colour,
                        "array": [NORMAL_95 * known[n]["std"] / known[n]["usual"] for n in chosen],
                    },
                    "marker": {"color": colour, "size": 7},
                    "hovertemplate": "%{y}: %{x:.3~g}<extra></extra>",
                }
            )  # fmt: skip
    return figure_of(
        data,
        120 + 17 * len(names),
        xaxis={"title": {"text": "difference [usual sizes]"}, "zerolinecolor": NOISE},
        yaxis={"categoryorder": "array", "categoryarray": [plain(n) for n in names],
               "tickfont": {"size": 12}, "dtick": 1},
        hovermode="closest",
        margin={"l": 190, "r": 10, "t": 34, "b": 36},
    )  # fmt: skip


def _circumstances(changes: Changes) -> list[str]:
    """What each flight has of its own, side by side."""
    if changes.get("of_one_flight"):
        return []
    a, b = (changes["circumstances"][name] for name in "AB")
    rows = []
    for name, (words, unit) in CIRCUMSTANCES.items():
        if name in a["own"] or name in b["own"]:
            rows.append([words, *(_own(f["own"].get(name), unit) for f in (a, b))])
    for name, (words, unit) in GUSTS.items():
        rows.append([words, *(with_unit(f["gusts"][name], unit) for f in (a, b))])
    return [
        prose(
            "Fitted for each flight, and never a change of the machine. A rotor speed per command that "
            "differs is a battery's state as far as the log can tell, unless the log has its voltage."
        ),
        table(["", "A", "B"], rows),
    ]


def _own(entry: Mapping[str, float] | None, unit: str) -> str:
    return "–" if entry is None else with_std(entry["value"], entry["std"], unit)


def _shared(changes: Changes) -> list[str]:
    names = [plain(n) for n in changes["shared"]]
    if changes.get("of_one_flight"):
        return [
            prose(
                "The model of log A, with the effects that it shows"
                + (f": {and_list(names)}" if names else "")
                + ". What is wrong with it is in both logs and cancels in the difference."
            )
        ]
    if not names:
        return [prose("The vehicle file's own numbers, refitted to both; no effect beside them.")]
    return [
        prose(
            f"The vehicle file's own numbers, refitted to both, and what makes both flights likelier "
            f"beside them: {and_list(names)}. These are not weighed as changes are: what it lacks, "
            "a diagnosis says. What is wrong with the model is in both flights and cancels in the "
            "difference."
        )
    ]


def _unexplained(changes: Changes) -> list[str]:
    lines = [
        f"The innovations of **{channel_name(u['channel'])}** are coloured in B and were not in A: "
        "something is different there that no change explains."
        for u in changes["unexplained"]
    ]
    return [bullets(lines)] if lines else []


def _flights(result: "Comparison") -> list[str]:
    blocks: list[str] = []
    for f in result.flights:
        total = sum(run.duration for run in f.flight.runs)
        words = f"**{f.name}**: {count_word(len(f.flight.runs))} runs, {total:.0f} s: "
        blocks.append(prose(words + f"{and_list(list(f.flight.run_names))}."))
        blocks.append(details(f"The data of {f.name}", *data_blocks(f.flight, f.flight.notes, {})))
    return blocks
