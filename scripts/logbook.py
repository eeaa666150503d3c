"""Keep a machine's logbook: each of its numbers over many flights, and what changed between them."""

import argparse
import json
from pathlib import Path
from typing import Any

import command_line

from coax_env.errors import InputError
from coax_env.files import read_text, write_json


def main() -> None:
    options = arguments()
    from coax_env import logbook, report

    kept = earlier(options.out / "logbook.json")
    with command_line.progress("logbook") as report_progress:

        def done(content: dict[str, Any]) -> None:
            write_json(options.out / "logbook.json", content)
            report_progress(f"{len(content['links'])} neighbours compared")

        content = logbook(
            options.folder,
            options.vehicle,
            kept,
            options.jobs,
            options.backend,
            done,
            options.waive,
        )
    write_json(options.out / "logbook.json", content)
    command = command_line.typed("logbook")
    page = command_line.write_report(
        options.out / "logbook.html", lambda: report.logbook_page(content, command)
    )
    print(f"{len(content['flights'])} flights, {len(content['changes'])} changes")
    for change in content["changes"]:
        print(f"  since {change['since']}: {change['effect']}, {change['evidence']:.0f} nats")
    print(f"logbook {options.out / 'logbook.json'}, {page}")


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("logbook", __doc__)
    parser.add_argument("folder", type=Path, help="folder of flight folders of one machine")
    parser.add_argument("--vehicle", help="shipped name or TOML file (default: the cards')")
    command_line.add_workers(parser, "comparisons", 1)
    command_line.add_waive(parser)
    return parser.parse_args()


def earlier(path: Path) -> dict[str, Any] | None:
    """The logbook that is there, or None."""
    if not path.exists():
        return None
    try:
        content: dict[str, Any] = json.loads(read_text(path))
        if not {"vehicle", "links"} <= content.keys():
            raise ValueError("no links")
        return content
    except (ValueError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a logbook: {error}") from error


if __name__ == "__main__":
    command_line.run(main)
