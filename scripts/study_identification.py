"""Do the identification's 95 % intervals hold the truth? Simulated flights in gusts, counted."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import command_line
from study import judge
from study.coverage import METHODS, fly_and_identify
from tqdm import tqdm

from coax_env.errors import InputError
from coax_env.files import make_folder, write_json, write_text
from coax_env.workers import each


def main() -> None:
    parser = command_line.parser("study_identification", __doc__, seed=True)
    parser.add_argument("--flights", type=int, default=200, help="default: %(default)s")
    parser.add_argument("--peer", action="store_true", help="AeroID on the same doublets, too")
    command_line.add_workers(parser, "flights", -1)
    options = parser.parse_args()
    if options.flights < 1:
        raise InputError("a study needs at least one flight")
    make_folder(options.out)
    numbers = [1000 * options.seed + k for k in range(options.flights)]
    waiting = [n for n in numbers if not path_of(options.out, n).exists()]
    work = partial(fly_and_identify, peer=options.peer)
    results = each(work, waiting, options.jobs, options.backend)
    done = len(numbers) - len(waiting)
    try:
        for number, row in tqdm(results, "study", len(numbers), initial=done, unit="flight"):
            write_json(path_of(options.out, number), row)
    finally:
        stored = [path_of(options.out, n) for n in numbers]
        text = table([json.loads(path.read_text()) for path in stored if path.exists()])
        write_text(options.out / "table.md", text)
    print(text)


def path_of(folder: Path, number: int) -> Path:
    """File of a flight's result."""
    (folder / "flights").mkdir(exist_ok=True)
    return folder / "flights" / f"{number:06d}.json"


def table(rows: list[dict[str, list[dict[str, Any]]]]) -> str:
    """Share of intervals that hold the truth, by method, with Wilson's interval, and by name."""
    header = ["| intervals | hold the truth | of | Wilson 95 % |", "|---|---|---|---|"]
    lines = [f"{len(rows)} flights", "", *header]
    for method in METHODS:
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
