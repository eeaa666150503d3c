"""How often is the diagnosis right? Flights whose truth is known, flown, diagnosed and counted."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import command_line
import numpy as np
from study import arm_table, arms, classes, plan, refusals, store, table, threshold
from study.one_flight import fly_and_diagnose
from study.plan import PlannedFlight
from study.refusals import fly_and_check
from tqdm import tqdm

from coax_env import workers
from coax_env.diagnosis import calibration
from coax_env.errors import InputError
from coax_env.files import make_folder, write_json, write_text
from coax_env.report.page import Section, figure, page

QUICK = {"clean": 8, "effects": 16}


def main() -> None:
    options = parse()
    flights = planned(options)
    if options.calibrate:
        flights = [f for f in flights if not f.effects]
    make_folder(options.out)
    command = command_line.typed("study_diagnosis")
    if options.check_only:
        check_only(flights, options, command)
        return
    waiting = store.missing(options.out, flights)
    done = len(flights) - len(waiting)
    try:
        results = each(waiting, options)
        for flight, row in tqdm(results, "study", len(flights), initial=done, unit="flight"):
            store.store(options.out, flight, row)
    finally:
        rows = store.rows_of(options.out, flights)
        if rows:
            write_results(options.out, rows, command)
    if options.adopt:
        adopt(options.out)
    print((options.out / "table.md").read_text())


def check_only(flights: list[PlannedFlight], options: Any, command: str) -> None:
    """Whether the logs of these flights would be refused: refusals.md, refusals.json."""
    found = workers.each(fly_and_check, flights, options.jobs, options.backend)
    rows = [refusals.check_log(folder) for folder in options.logs]
    try:
        for _, row in tqdm(found, "study", len(flights), unit="flight"):
            rows.append(row)
    finally:
        write_json(options.out / "refusals.json", {"command": command, "flights": rows})
        write_text(options.out / "refusals.md", refusals.table_text(rows, command))
    print((options.out / "refusals.md").read_text())


def planned(options: Any) -> list[PlannedFlight]:
    """The flights that the command line asks for."""
    if options.arms:
        return arms.plan_arms(
            options.arms, options.clean, options.effects, options.seed, options.first
        )
    runs = None if options.full else plan.RICH
    return plan.plan(options.clean, options.effects, options.seed, runs, options.many)


def parse() -> Any:
    """The command line."""
    parser = command_line.parser("study_diagnosis", __doc__, seed=True)
    parser.set_defaults(out=Path("runs/study"))
    parser.add_argument("--clean", type=int, default=200, help="flights without effects")
    parser.add_argument("--effects", type=int, default=400, help="flights with effects")
    parser.add_argument(
        "--many", type=int, default=0,
        help=f"gusty flights with up to {plan.MANY} effects each, for the intervals",
    )  # fmt: skip
    parser.add_argument(
        "--arms", default="", metavar="ARM,ARM|all",
        help="flights of these arms, --clean and --effects of each, instead, without baselines",
    )  # fmt: skip
    parser.add_argument(
        "--first", type=int, default=0, metavar="N",
        help="with --arms: number of each arm's first flight; another one has another effect, other "
        "sensors, another pilot",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="24 flights in all")
    parser.add_argument(
        "--full",
        action="store_true",
        help="all twelve runs a flight, 220 s, not the eight of 136 s",
    )
    parser.add_argument(
        "--calibrate", action="store_true",
        help="clean flights only; DIR/threshold.json says which evidence 1 %% of them reach",
    )  # fmt: skip
    parser.add_argument(
        "--adopt", action="store_true",
        help="with --calibrate: what was measured becomes the package's calibration.json",
    )  # fmt: skip
    parser.add_argument(
        "--check-only", action="store_true",
        help="only whether these sound logs, their halves and single runs, would be refused",
    )  # fmt: skip
    parser.add_argument(
        "--logs", type=Path, nargs="+", default=[], metavar="FLIGHT",
        help="with --check-only: sound logs that are there, beside those that are flown",
    )  # fmt: skip
    parser.add_argument("--no-baselines", action="store_true", help="the package alone")
    command_line.add_workers(parser, "flights", -1)
    options = parser.parse_args()
    options.arms = arms.named(options.arms)
    if options.quick:
        options.clean, options.effects = QUICK["clean"], QUICK["effects"]
    counts = (options.clean, options.effects, options.many)
    if min(counts) < 0 or sum(counts) == 0:
        raise InputError("a study needs at least one flight")
    if options.first and not options.arms:
        raise InputError("--first goes with --arms")
    if options.first < 0:
        raise InputError(f"--first {options.first}: a flight's number is 0 or more")
    if options.adopt and not options.calibrate:
        raise InputError("--adopt goes with --calibrate")
    return options


def each(
    flights: list[PlannedFlight], options: Any
) -> Iterator[tuple[PlannedFlight, dict[str, Any]]]:
    """Results as they come, of flights worked on in parallel; one job works in this process."""
    work = partial(fly_and_diagnose, only_own=options.no_baselines)
    return workers.each(work, flights, options.jobs, options.backend)


def adopt(out: Path) -> None:
    """Make the folder's calibration the package's."""
    measured = out / "threshold.json"
    if not measured.exists():
        raise InputError(f"no calibration in {out}: it takes {threshold.FEWEST} clean flights")
    for of_class in json.loads(measured.read_text(encoding="utf-8"))["classes"]:
        calibration.adopt(of_class)


def write_results(out: Path, rows: list[dict[str, Any]], command: str) -> None:
    """table.md, summary.json, the confusion matrix; the threshold of each class where there is enough.

    Args:
        out: the study's folder. rows: results of flights, failures included. command: that made them.
    """
    calibrated = classes.calibrations(rows, command)
    if calibrated:
        write_json(out / "threshold.json", {"classes": calibrated})
    if rows[0]["plan"]["arm"]:
        write_text(out / "table.md", arm_table.arm_text(rows, command))
        counted = arm_table.figures(rows)
        write_json(out / "arms.json", {"command": command, "flights": len(rows), "arms": counted})
        return
    write_text(out / "table.md", table.table_text(rows, command))
    methods = sorted({m for row in rows for m in row.get("methods", ())})
    write_json(
        out / "summary.json",
        {
            "command": command,
            "flights": len(rows),
            "failed": sum("error" in row for row in rows),
            "code": sorted({row["code"] for row in rows}),
            "methods": {m: [f.as_json() for f in table.all_figures(rows, m)] for m in methods},
        },
    )
    confusion = table.confusion(rows)
    write_text(out / "confusion.csv", table.confusion_csv(*confusion))
    if np.any(confusion[2]):
        print(command_line.write_report(out / "confusion.html", lambda: confusion_page(*confusion)))


def confusion_page(truths: list[str], names: list[str], shares: np.ndarray) -> str:
    """What was hidden against what was named, drawn."""
    drawn = figure(table.confusion_figure(truths, names, shares))
    return page("What was hidden, what was named", [], [Section("One effect", [drawn])])


if __name__ == "__main__":
    command_line.run(main)
