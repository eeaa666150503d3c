"""How often is a comparison right? Pairs of flights with known changes, or none, flown and counted."""

import argparse
import json
from pathlib import Path

import command_line
from study import pairs
from tqdm import tqdm

from coax_env import workers
from coax_env.errors import InputError
from coax_env.files import make_folder, write_json, write_text


def main() -> None:
    options = arguments()
    make_folder(options.out)
    wanted = [
        pairs.planned(changed, n, options.seed)
        for changed, count in ((False, options.same), (True, options.changed))
        for n in range(count)
    ]
    wanted.sort(key=lambda pair: pair.number)
    paths = {pair.name: options.out / f"{pair.name}.json" for pair in wanted}
    waiting = [pair for pair in wanted if not paths[pair.name].exists()]
    try:
        done = workers.each(pairs.fly_and_compare, waiting, options.jobs, options.backend)
        for pair, row in tqdm(done, "study", len(wanted), initial=len(wanted) - len(waiting)):
            write_json(paths[pair.name], row)
    finally:
        rows = [json.loads(p.read_text(encoding="utf-8")) for p in paths.values() if p.exists()]
        if rows:
            write_text(options.out / "table.md", pairs.text_of(rows))
    print((options.out / "table.md").read_text(encoding="utf-8"))


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("study_changes", __doc__, seed=True)
    parser.set_defaults(out=Path("runs/study_changes"))
    parser.add_argument("--same", type=int, default=100, help="pairs of one and the same machine")
    parser.add_argument("--changed", type=int, default=100, help="pairs with one change")
    command_line.add_workers(parser, "pairs", -1)
    options = parser.parse_args()
    if min(options.same, options.changed) < 0 or options.same + options.changed == 0:
        raise InputError("a study needs at least one pair")
    return options


if __name__ == "__main__":
    command_line.run(main)
