"""Find what changed in a machine between two flights, or between two parts of one."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import command_line

from coax_env.files import write_json

if TYPE_CHECKING:
    from coax_env.comparison.compare import Comparison


def main() -> None:
    options = arguments()
    from coax_env import compare

    with command_line.progress("comparison") as report_progress:
        result = compare(
            options.a, options.b, options.vehicle, progress=report_progress, waive=options.waive
        )
    page = save(result, options.out, command_line.typed("compare"))
    print("\n".join(summary(result.changes)))
    print(f"changes {options.out / 'changes.json'}, {page}")


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("compare", __doc__)
    parser.add_argument("a", type=Path, metavar="A", help="flight folder")
    parser.add_argument(
        "b", type=Path, metavar="B", nargs="?",
        help='flight folder of the later flight; without it, runs of A whose card says part = "A"'
        ' and part = "B"',
    )  # fmt: skip
    parser.add_argument("--vehicle", help="shipped name or TOML file (default: the cards')")
    command_line.add_waive(parser)
    return parser.parse_args()


def save(result: "Comparison", out: Path, command: str) -> str:
    """changes.json, then report.html; where the report is, or why there is none.

    Args:
        result: of the comparison. out: folder of the results. command: what was typed.
    """
    from coax_env import report

    write_json(out / "changes.json", result.changes)
    return command_line.write_report(
        out / "report.html", lambda: report.comparison_page(result, command)
    )


def summary(changes: Mapping[str, Any]) -> list[str]:
    """The changes in a few lines."""
    lines = [f"verdict: {changes['verdict']}"]
    for c in changes["changes"]:
        moved = ", ".join(
            f"{name.partition('.')[2]} {p['before']:.4g} -> {p['after']:.4g}"
            f" ({p['change']:+.4g} +- {p['std']:.2g} {p['unit']})"
            for name, p in c["parameters"].items()
        )
        line = f"  {c['effect']}: {moved}; {c['evidence']:.0f} nats"
        if c["confusable_with"]:
            line += f"; confounded alternatives: {', '.join(c['confusable_with'])}"
        lines.append(line)
    lines += [f"  unexplained: {u['channel']} ({u['form']})" for u in changes["unexplained"]]
    return [*lines, *(f"note: {remark}" for remark in changes.get("remarks", ()))]


if __name__ == "__main__":
    command_line.run(main)
