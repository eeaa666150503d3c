"""Do the identification's 95 % intervals hold the truth? Simulated flights in gusts, counted.

With --arms, flights of the diagnosis' study instead: by other code, in closed loop, the file right.
"""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import command_line
from study import arms, judge
from study.coverage import (
    ALL_ARMS,
    METHODS,
    READINGS_ALONE,
    fly_and_identify,
    identify_in_arm,
)
from tqdm import tqdm

from coax_env.errors import InputError
from coax_env.files import make_folder, write_json, write_text
from coax_env.workers import each


def main() -> None:
    parser = command_line.parser("study_identification", __doc__, seed=True)
    parser.add_argument("--flights", type=int, default=200, help="default: %(default)s")
    parser.add_argument("--peer", action="store_true", help="AeroID on the same doublets, too")
    parser.add_argument(
        "--arms", default="", metavar="ARM,ARM|all",
        help="--flights clean flights of each of these arms, numbers that they determine",
    )  # fmt: skip
    command_line.add_workers(parser, "flights", -1)
    options = parser.parse_args()
    if options.flights < 1:
        raise InputError("a study needs at least one flight")
    names = arms.named(options.arms)
    make_folder(options.out)
    pieces: list[Any] = [
        (name, k, options.seed) for name in names for k in range(options.flights)
    ] or [1000 * options.seed + k for k in range(options.flights)]
    waiting = [piece for piece in pieces if not path_of(options.out, piece).exists()]
    work: Any = identify_in_arm if names else partial(fly_and_identify, peer=options.peer)
    results = each(work, waiting, options.jobs, options.backend)
    done = len(pieces) - len(waiting)
    try:
        for piece, row in tqdm(results, "study", len(pieces), initial=done, unit="flight"):
            write_json(path_of(options.out, piece), row)
    finally:
        stored = [path_of(options.out, piece) for piece in pieces]
        rows = [json.loads(path.read_text()) for path in stored if path.exists()]
        text = table(rows, (*names, ALL_ARMS, READINGS_ALONE) if names else METHODS)
        write_text(options.out / "table.md", text)
    print(text)


def path_of(folder: Path, piece: int | tuple[str, int, int]) -> Path:
    """File of a flight's result: by its number, or by arm, number and seed."""
    (folder / "flights").mkdir(exist_ok=True)
    name = f"{piece:06d}" if isinstance(piece, int) else "{}-{:04d}-{}".format(*piece)
    return folder / "flights" / f"{name}.json"


def table(rows: list[dict[str, list[dict[str, Any]]]], methods: Sequence[str]) -> str:
    """Share of intervals that hold the truth, by method, with Wilson's interval, and by name.

    Args:
        rows: of each flight, its intervals by method. methods: in order.
    """
    header = ["| intervals | hold the truth | of | Wilson 95 % |", "|---|---|---|---|"]
    lines = [f"{len(rows)} flights", "", *header]
    for method in methods:
        every = [i for row in rows for i in row.get(method, ())]
        if not every:
            continue
        lines.append(line(method, every))
        for name in dict.fromkeys(i["name"] for i in every):
            lines.append(line(f"- {name}", [i for i in every if i["name"] == name]))
    return "\n".join(lines) + "\n"


def line(name: str, intervals: list[dict[str, Any]]) -> str:
    """One row of the table."""
    inside = sum(i["low"] <= i["truth"] <= i["high"] for i in intervals)
    low, high = judge.wilson(inside, len(intervals))
    share = 100.0 * inside / max(len(intervals), 1)
    return f"| {name} | {share:.1f} % | {len(intervals)} | {100 * low:.1f}-{100 * high:.1f} % |"


if __name__ == "__main__":
    command_line.run(main)
