"""The page over many diagnosed flights: a row each, with a link to its own report."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from coax_env.report.page import Markup, Section, callout, command, page, table

HEADER = ("flight", "verdict", "sure", "doubtful", "error removed", "seconds")


def many_flights_page(rows: Sequence[Mapping[str, Any]], command_line: str) -> str:
    """The page as HTML text.

    Args:
        rows: one for each flight: `flight` and `folder`, and `error` or verdict, causes by trust,
            `removed` [%] or None, and `seconds`.
        command_line: what was typed.
    """
    read = [row for row in rows if not row["error"]]
    named = sum(bool(row["sure"]) for row in read)
    lead = [
        f"{len(read)} of {len(rows)} flights were diagnosed, {named} of them with a cause that is sure."
    ]
    blocks = [table(HEADER, [_cells(row) for row in read])] if read else []
    blocks += [
        callout(f"{row['flight']}: {row['error']}", "warning") for row in rows if row["error"]
    ]
    sections = [
        Section("Flights", blocks),
        Section("Causes", [_by_cause(read)]),
        Section("The command that made this", [command(command_line)]),
    ]
    return page("Many flights", lead, sections, "Diagnosis")


def summary_cells(row: Mapping[str, Any]) -> list[str]:
    """A flight's row in words, as the columns of HEADER."""
    removed = "-" if row["removed"] is None else f"{row['removed']:.0f} %"
    return [
        row["flight"], row["verdict"], ", ".join(row["sure"]) or "-",
        ", ".join(row["doubtful"]) or "-", removed, f"{row['seconds']:.0f}",
    ]  # fmt: skip


def _cells(row: Mapping[str, Any]) -> list[str]:
    link = f'<a href="{escape(row["folder"])}/report.html">{escape(row["flight"])}</a>'
    return [Markup(link), *summary_cells(row)[1:]]


def _by_cause(rows: Sequence[Mapping[str, Any]]) -> str:
    """In how many flights each name was found."""
    names = sorted({name for row in rows for name in (*row["sure"], *row["doubtful"])})
    if not names:
        return callout("No cause was named in any of them.")
    return table(
        ("cause", "flights where it is sure", "doubtful"),
        [
            [
                name,
                *(str(sum(name in row[trust] for row in rows)) for trust in ("sure", "doubtful")),
            ]
            for name in names
        ],
    )
