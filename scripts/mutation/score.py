"""The share of mutations that a test caught, and the table of all that were tried."""

from collections.abc import Mapping, Sequence
from typing import Any

from mutation.draw import PARTS, part_of

ENOUGH = 0.95  # of the mutations


def share(rows: Sequence[Mapping[str, Any]]) -> float:
    """Share of the rows that were caught; 0 where there are none."""
    return sum(row["caught"] for row in rows) / len(rows) if rows else 0.0


def table_text(
    rows: Sequence[Mapping[str, Any]], equivalent: Sequence[Mapping[str, str]], command: str
) -> str:
    """The table as Markdown: score by part, what survived, what was passed over, every trial.

    Args:
        rows: a result each, as mutate.py stores them. equivalent: file, before, after and reason of
            what was drawn and passed over. command: that made them.
    """
    lines = [f"`{command}`", "", "| part | mutations | caught | |", "|---|---|---|---|"]
    for part in PARTS:
        own = [row for row in rows if part_of(row["file"]) == part]
        if own:
            lines.append(_score(part, own))
    lines += [_score("all", rows), ""]
    survived = [row for row in rows if not row["caught"]]
    for title, chosen in (("Survived", survived), ("Caught", [r for r in rows if r["caught"]])):
        lines += [f"## {title}: {len(chosen)}", ""]
        if chosen:
            lines += ["| where | was | became | by |", "|---|---|---|---|"]
        for row in chosen:
            where = f"{row['file']}:{row['line']}"
            lines.append(
                f"| {where} | {_code(row['before'])} | {_code(row['after'])} | {row['by']} |"
            )
        lines.append("")
    lines += [f"## Drawn and passed over as equivalent: {len(equivalent)}", ""]
    for row in equivalent:
        lines.append(
            f"- {row['file']}: {_code(row['before'])} -> {_code(row['after'])}: {row['reason']}"
        )
    return "\n".join(lines).rstrip() + "\n"


def _score(part: str, rows: Sequence[Mapping[str, Any]]) -> str:
    caught = sum(row["caught"] for row in rows)
    return f"| {part} | {len(rows)} | {caught} | {100.0 * share(rows):.1f} % |"


def _code(line: str) -> str:
    return "`" + line.replace("|", "\\|").replace("`", "'") + "`"
