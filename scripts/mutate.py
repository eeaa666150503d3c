"""Is every test able to fail? Breaks the code in one place at a time, and counts what a test notices.

Signs, terms, products, sines, constants, indices and comparisons of the model, env, estimation,
identification and diagnosis, drawn by seed; each in a copy of the tree, tested by the tests of its file
and then by the rest of the quick ones. What is known is not tried again: a mutation that was caught
while its file stays as it is, one that survived while no source and no test has changed.
"""

import json
import queue
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import command_line
from mutation import draw, score
from mutation.sites import Mutation
from mutation.trial import Tree, fingerprint, own_tests
from tqdm import tqdm

from coax_env.errors import InputError
from coax_env.files import write_json, write_text

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    options = parse()
    equivalent = draw.equivalents()
    found = draw.all_sites(options.root)
    different = [m for m in found if (m.file, m.before, m.after) not in equivalent]
    drawn = draw.draw(different, options.count, options.seed)
    if options.only:
        drawn = [m for m in drawn if any(word in m.file for word in options.only)]
    passed_over = [m for m in draw.draw(found, options.count, options.seed) if m not in different]
    known = {m.name: row for m in drawn if (row := stored(options, m)) is not None}
    waiting = [m for m in drawn if m.name not in known]
    try:
        with tqdm(total=len(drawn), initial=len(known), desc="mutate", unit="mutation") as bar:
            for row in trials(waiting, options):
                known[row["name"]] = row
                bar.update()
                bar.set_postfix(caught=f"{100.0 * score.share(list(known.values())):.0f} %")
    finally:
        rows = [known[m.name] for m in drawn if m.name in known]
        reasons = [
            {"file": m.file, "before": m.before, "after": m.after,
             "reason": equivalent.get((m.file, m.before, m.after), "")}
            for m in passed_over if (m.file, m.before, m.after) in equivalent
        ]  # fmt: skip
        command = command_line.typed("mutate")
        write_text(options.out / "table.md", score.table_text(rows, reasons, command))
        summary = {"command": command, "score": score.share(rows), "count": len(rows)}
        write_json(options.out / "score.json", {**summary, "equivalent": reasons, "rows": rows})
    survived = [row for row in rows if not row["caught"]]
    for row in survived:
        print(f"{row['file']}:{row['line']}: {row['before']}  ->  {row['after']}")
    print(f"{len(rows) - len(survived)} of {len(rows)} caught, {100.0 * score.share(rows):.1f} %")
    if score.share(rows) < score.ENOUGH:
        sys.exit(1)


def parse() -> Any:
    """The command line."""
    parser = command_line.parser("mutate", __doc__, seed=True)
    parser.add_argument("--count", type=int, default=60, help="mutations (default: 60)")
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD",
                        help="of those drawn, only in files whose path has such a word")  # fmt: skip
    parser.add_argument("--own", action="store_true",
                        help="only the tests of the mutation's file, not the rest")  # fmt: skip
    parser.add_argument("--jobs", type=int, default=1, help="mutations at once (default: 1)")
    parser.add_argument("--root", type=Path, default=ROOT, help="of the tree (default: this one)")
    options = parser.parse_args()
    if min(options.count, options.jobs) < 1:
        raise InputError("--count and --jobs must be at least 1")
    return options


def trials(waiting: Sequence[Mutation], options: Any) -> Iterator[dict[str, Any]]:
    """Rows as they come, from as many copies of the tree as there are jobs; each is stored at once."""
    if not waiting:
        return
    jobs = min(options.jobs, len(waiting))
    trees = [Tree(options.root, options.out.resolve() / f"job_{k}") for k in range(jobs)]
    check_whole(trees[0], waiting, options)
    free: queue.SimpleQueue[Tree] = queue.SimpleQueue()
    for tree in trees:
        free.put(tree)

    def one(mutation: Mutation) -> dict[str, Any]:
        tree = free.get()
        try:
            row = described(mutation) | tree.try_out(mutation, rest=not options.own)
            row |= fingerprints(tree.place, mutation)  # of the copy: the tree may have gone on
        finally:
            free.put(tree)
        write_json(place_of(options, mutation), row)
        return row

    with ThreadPoolExecutor(jobs) as pool:
        begun = [pool.submit(one, mutation) for mutation in waiting]
        try:
            for future in as_completed(begun):
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for tree in trees:
                tree.stop()
            raise


def check_whole(tree: Tree, waiting: Sequence[Mutation], options: Any) -> None:
    """Make sure that the tests pass while nothing is broken; what has passed is not run again.

    Args:
        tree: a copy to test in. waiting: the mutations whose tests are needed.
        options: the command line's.

    Raises:
        InputError: a test fails as the tree stands.
    """
    needed = dict.fromkeys(t for m in waiting for t in own_tests(m.file))
    sources = [
        p for folder in ("coax_env", "controllers") for p in (options.root / folder).rglob("*.py")
    ]
    state = {
        name: fingerprint(*sources, options.root / name)
        for name in needed
        if (options.root / name).exists()
    }
    path = options.out / "whole.json"
    passed: dict[str, str] = json.loads(path.read_text()) if path.exists() else {}
    for name in state:
        if passed.get(name) != state[name]:
            if by := tree.test([name]):
                raise InputError(f"{by} fails before anything is broken")
            passed[name] = state[name]
            write_json(path, passed)


def place_of(options: Any, mutation: Mutation) -> Path:
    """File of a mutation's result."""
    return options.out / "mutations" / f"{mutation.name}.json"


def described(mutation: Mutation) -> dict[str, Any]:
    """A mutation as its row says it."""
    return {
        "name": mutation.name, "file": mutation.file, "line": mutation.line, "kind": mutation.kind,
        "before": mutation.before, "after": mutation.after,
    }  # fmt: skip


def fingerprints(root: Path, mutation: Mutation) -> dict[str, str]:
    """What a result holds for: the file as it was, and all sources and tests."""
    every = [
        p for folder in ("coax_env", "controllers", "tests") for p in (root / folder).rglob("*.py")
    ]
    return {"source": fingerprint(root / mutation.file), "all": fingerprint(*every)}


def stored(options: Any, mutation: Mutation) -> dict[str, Any] | None:
    """The result of a mutation, where it still holds."""
    try:
        row = json.loads(place_of(options, mutation).read_text())
    except (OSError, ValueError):
        return None
    now = fingerprints(options.root, mutation)
    as_far = row["all"] == now["all"] and (options.own or row["rest"])
    holds = row["source"] == now["source"] and (row["caught"] or as_far)
    return row | {"line": mutation.line} if holds else None


if __name__ == "__main__":
    command_line.run(main)
