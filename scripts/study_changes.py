"""How often is a comparison right, how often an onset? Flights with known changes, or none, counted."""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import command_line
from study import onsets, pairs
from tqdm import tqdm

from coax_env import workers
from coax_env.errors import InputError
from coax_env.files import make_folder, write_json, write_text


def main() -> None:
    options = arguments()
    make_folder(options.out)
    wanted = [
        pairs.planned(changed, n, options.seed, options.whole)
        for changed, count in ((False, options.same), (True, options.changed))
        for n in range(count)
    ]
    wanted.sort(key=lambda pair: pair.number)
    in_flight = [
        onsets.planned(kind, n, options.seed, options.whole)
        for n in range(options.onsets)
        for kind in options.kinds
    ]
    if wanted:
        study(wanted, pairs.fly_and_compare, pairs.text_of, options, options.out / "table.md")
    if in_flight:
        table = options.out / "onsets.md"
        study(in_flight, onsets.fly_and_diagnose, onsets.text_of, options, table)


def study(
    wanted: Sequence[Any],
    work: Callable[[Any], dict[str, Any]],
    text_of: Callable[[Sequence[Any]], str],
    options: argparse.Namespace,
    table: Path,
) -> None:
    """Do what has not been done yet, each to a file of its own, and count all.

    Args:
        wanted: what is planned, each with its `name`. work: makes a row of one.
        text_of: the figures of all rows. options: of the command line. table: where these go.
    """
    paths = {one.name: options.out / f"{one.name}.json" for one in wanted}
    waiting = [one for one in wanted if not paths[one.name].exists()]
    try:
        done = workers.each(work, waiting, options.jobs, options.backend)
        for one, row in tqdm(done, "study", len(wanted), initial=len(wanted) - len(waiting)):
            write_json(paths[one.name], row)
    finally:
        rows = [json.loads(p.read_text(encoding="utf-8")) for p in paths.values() if p.exists()]
        if rows:
            write_text(table, text_of(rows))
    print(table.read_text(encoding="utf-8"))


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("study_changes", __doc__, seed=True)
    parser.set_defaults(out=Path("runs/study_changes"))
    parser.add_argument("--same", type=int, default=100, help="pairs of one and the same machine")
    parser.add_argument("--changed", type=int, default=100, help="pairs with one change")
    parser.add_argument(
        "--whole", action="store_true",
        help="fly twelve whole runs, instead of four of 8 s (pairs) or 12 s (onsets)",
    )  # fmt: skip
    parser.add_argument(
        "--onsets", type=int, default=0, metavar="N",
        help="flights of each kind: something begins, is there all the time, nothing",
    )  # fmt: skip
    parser.add_argument(
        "--kinds", nargs="+", choices=onsets.KINDS, default=onsets.KINDS[:3], metavar="KIND",
        help=f"of these flights: {', '.join(onsets.KINDS)}",
    )  # fmt: skip
    command_line.add_workers(parser, "pairs", -1)
    options = parser.parse_args()
    counts = (options.same, options.changed, options.onsets)
    if min(counts) < 0 or sum(counts) == 0:
        raise InputError("a study needs at least one pair")
    return options


if __name__ == "__main__":
    command_line.run(main)
