"""Change what a flight's log says, and nothing else: a known truth on real noise."""

import argparse
from pathlib import Path

import command_line

from coax_env.logs.edits import EDITS, edited
from coax_env.logs.flight import read_flight, write_flight


def main() -> None:
    options = arguments()
    flight = read_flight(options.flight)
    changed = edited(flight, dict(options.edit), options.since)
    where = write_flight(changed, options.out)
    said = ", ".join(f"{name} {size:g} {EDITS[name].unit}" for name, size in options.edit)
    print(f"{where}: {flight.path} with {said}")


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("edit_log", __doc__)
    parser.add_argument("flight", type=Path, help="flight folder")
    known = "; ".join(f"{name} [{edit.unit}]: {edit.summary}" for name, edit in EDITS.items())
    parser.add_argument(
        "--edit", action="append", required=True, type=_edit, metavar="NAME=SIZE",
        help=f"may be repeated. {known}",
    )  # fmt: skip
    command_line.add_since(parser)
    return parser.parse_args()


def _edit(text: str) -> tuple[str, float]:
    return command_line.named_number(text, "=", "NAME=SIZE")


if __name__ == "__main__":
    command_line.run(main)
