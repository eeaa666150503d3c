"""Find what a vehicle's simulation gets wrong on measured flights, name the causes, correct it."""

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import command_line

from coax_env import load_effect, workers
from coax_env.errors import InputError
from coax_env.files import staged_folder, write_json, write_text

if TYPE_CHECKING:
    from coax_env.diagnosis.diagnose import Diagnosis
    from coax_env.report import ControllerScores

TRUST = {
    "sure": "sure",
    "doubtful": "doubtful: they improve the model, but these flights do not settle the name",
}
"""How far a cause's name may be believed, and the heading of such causes."""


def main() -> None:
    options = arguments()
    flights = flights_in(options.flight)
    if not options.effect and all(map(Path.is_dir, flights)):  # a user's effect: with the rest
        from coax_env.estimation.compile_ahead import fill_cache

        fill_cache()
    if flights != options.flight or len(flights) > 1:
        of_many(flights, options)
        return
    for file in options.effect:
        load_effect(file)
    with command_line.progress("diagnosis", time_shares()) as report_progress:
        result, page = diagnosed(flights[0], options, options.out, report_progress)
    print(summary(result))
    print(f"findings {options.out / 'findings.json'}, corrected vehicle "
          f"{options.out / 'vehicle.toml'}, {page}")  # fmt: skip


def time_shares() -> Mapping[str, float]:
    """When a diagnosis' steps come, for the time that is left; imports what it needs late."""
    from coax_env.diagnosis.diagnose import SHARES

    return SHARES


def diagnosed(
    flight: Path, options: argparse.Namespace, out: Path, report_progress: Callable[[str], None]
) -> tuple["Diagnosis", str]:
    """A flight's diagnosis, written to a folder; and where its report is, or why there is none.

    Args:
        flight: its folder. options: what was asked for. out: folder of the results.
        report_progress: called with a line of text.
    """
    # compiles the kernel, with the catalogue as it is now
    from coax_env.diagnosis.diagnose import diagnose

    hold_out = None
    if options.hold_out is not None:
        hold_out = [] if options.hold_out == "none" else options.hold_out.split(",")
    result = diagnose(
        flight,
        options.vehicle,
        hold_out=hold_out,
        exclude=[e for e in options.exclude.split(",") if e],
        progress=report_progress,
        ceiling=options.ceiling,
        waive=options.waive,
    )
    scores = fly_both(result, report_progress) if options.fly else None
    return result, save(result, out, command_line.typed("diagnose"), scores)


# --- many flights -----------------------------------------------------------------------------------


def flights_in(paths: Sequence[Path]) -> list[Path]:
    """Flight folders among these, and in those of them that are folders of flights."""
    found: list[Path] = []
    for path in paths:
        inner = [] if (path / "card.toml").exists() else path.rglob("card.toml")
        found += sorted(card.parent for card in inner) or [path]
    return list(dict.fromkeys(found))


def of_many(flights: Sequence[Path], options: argparse.Namespace) -> None:
    """Each flight diagnosed into a folder of its own, and a page over all of them.

    A flight that cannot be read is one of the page's rows, and of the exit code.

    Raises:
        InputError: a flight could not be diagnosed; the others' results are there.
    """
    if options.hold_out not in (None, "none"):
        raise InputError("--hold-out takes names of runs for one flight only; none is for many")
    folders = dict(zip(flights, folder_names(flights), strict=True))
    work = partial(_one_of_many, folders, options, Path.cwd())
    rows = {}
    for flight, row in workers.each(work, flights, options.jobs, options.backend):
        rows[flight] = row
        print(f"{len(rows)} of {len(flights)}: {row['flight']}: {row['error'] or row['verdict']}",
              file=sys.stderr, flush=True)  # fmt: skip
    from coax_env import report

    ordered = [rows[flight] for flight in flights]
    read = [row for row in ordered if not row["error"]]
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "summary.json", {"flights": ordered})
    words = command_line.typed("diagnose")
    page = command_line.write_report(
        options.out / "summary.html", lambda: report.many_flights_page(ordered, words)
    )
    if read:
        table = [list(report.MANY_FLIGHTS_HEADER), *map(report.summary_cells, read)]
        command_line.print_columns(table)
    print(f"summary {options.out / 'summary.json'}, {page}, each flight's results in"
          f" {options.out}/FLIGHT")  # fmt: skip
    bad = [row for row in ordered if row["error"]]
    if bad:
        others = f"; so {len(bad) - 1} more, see the summary" if len(bad) > 1 else ""
        raise InputError(f"{bad[0]['flight']}: {bad[0]['error']}{others}")


def folder_names(flights: Sequence[Path]) -> list[str]:
    """A name for each flight's results: its folder's, with those above that tell them apart."""
    parts = [flight.resolve().parts[1:] for flight in flights]
    names = []
    for own in parts:
        length = 1
        while sum(other[-length:] == own[-length:] for other in parts) > 1:
            length += 1
        names.append("_".join(own[-length:]))
    return names


def _one_of_many(
    folders: Mapping[Path, str], options: argparse.Namespace, here: Path, flight: Path
) -> dict[str, Any]:
    """A flight's row of the summary. here: folder that paths are relative to."""
    os.chdir(here)
    if options.jobs != 1:
        os.environ.setdefault("COAX_THREADS", "1")  # the flights are what is worked on at once
    if "coax_env.model.dynamics" not in sys.modules:
        for file in options.effect:
            load_effect(file)
    row: dict[str, Any] = {"flight": str(flight), "folder": folders[flight], "error": ""}
    row |= {"verdict": "", "sure": [], "doubtful": [], "removed": None, "seconds": 0.0}
    begun = time.perf_counter()
    try:
        result, _ = diagnosed(flight, options, options.out / folders[flight], lambda text: None)
    except InputError as error:
        return row | {"error": str(error)}
    except Exception as error:  # whatever one flight does to the numbers, the others are diagnosed
        return row | {"error": f"{type(error).__name__}: {error}"}
    found = result.findings
    for trust in TRUST:
        row[trust] = [c["effect"] for c in found["causes"] if c["trust"] == trust]
    gain = found["gain"]
    return row | {
        "verdict": found["verdict"], "removed": gain["error_removed_percent"] if gain else None,
        "seconds": round(time.perf_counter() - begun, 1),
    }  # fmt: skip


# --- one flight -------------------------------------------------------------------------------------


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("diagnose", __doc__)
    parser.add_argument(
        "flight", type=Path, nargs="+",
        help="flight folder; several, or a folder of them: each diagnosed, and a page over all",
    )  # fmt: skip
    parser.add_argument("--vehicle", help="shipped name or TOML file (default: the card's)")
    command_line.add_workers(parser, "flights", -1)
    command_line.add_waive(parser)
    parser.add_argument(
        "--hold-out", metavar="RUN,RUN|none",
        help="runs on which the gain is measured (default: a quarter, chosen by signature)",
    )  # fmt: skip
    parser.add_argument(
        "--exclude", default="", metavar="EFFECT,EFFECT", help="effects that must not be named"
    )
    parser.add_argument(
        "--effect", action="append", default=[], type=Path, metavar="FILE",
        help="Python file with an effect of your own (coax_env/model/user_effects.py); may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--ceiling", action="store_true",
        help="also fit a black box: how much of the reachable gain the named causes explain",
    )  # fmt: skip
    parser.add_argument(
        "--fly", action="store_true",
        help="also design a hover controller on the bare and on the corrected model, and fly both",
    )  # fmt: skip
    return parser.parse_args()


def fly_both(result: "Diagnosis", report_progress: Callable[[str], None]) -> "ControllerScores":
    """An LQG of each model, flown on the corrected one: the machine itself is not at hand."""
    from controllers import model_comparison

    report_progress("flying a controller of each model")
    bare, corrected = result.vehicle_before, result.vehicle_after
    designs = model_comparison.lqg_of_both(bare, corrected, corrected)
    machine = "the corrected model, the best estimate of the machine"
    return model_comparison.controller_scores(designs, machine)


def save(
    result: "Diagnosis", out: Path, command: str, scores: "ControllerScores | None" = None
) -> str:
    """findings.json and vehicle.toml, both or none; then the next flight's card and report.html.

    Args:
        result: of the diagnosis.
        out: folder of the results.
        command: what was typed.
        scores: of controllers designed on both models.

    Returns:
        Where the report is, or why there is none.
    """
    from coax_env import report
    from coax_env.design.flight_card import write_flight_card
    from coax_env.model.vehicle_file import vehicle_toml

    with staged_folder(out) as folder:
        write_json(folder / "findings.json", result.findings)
        write_text(folder / "vehicle.toml", vehicle_toml(result.vehicle_after))
    if result.design and result.design.ranked:
        write_flight_card(result.design, result.flight, out / "next_flight")
    return command_line.write_report(
        out / "report.html", lambda: report.diagnosis_page(result, command, scores)
    )


def summary(result: "Diagnosis") -> str:
    """The findings in a few lines."""
    findings = result.findings
    lines = [f"verdict: {findings['verdict']}"]
    for trust, words in TRUST.items():
        causes = [c for c in findings["causes"] if c["trust"] == trust]
        lines += [f"{words}:", *map(cause_line, causes)] if causes else []
    if findings["causes"]:
        lines.append("  (nats: gain in log-likelihood by the cause; 5 nats are odds of 150 to 1)")
    for term in findings["unexplained"]:
        lines.append(f"  unexplained: {term['channel']} ({term['form']})")
        if "like" in term:
            lines.append(f"    {term['evidence']:.0f} nats, no name: {'; '.join(term['why'])}")
    gain = findings["gain"]
    if gain and gain["error_removed_percent"] is not None:
        low, high = gain["ci95"]
        interval = "" if low is None else f" (95 % interval {low:.0f} to {high:.0f})"
        lines.append(
            f"gain on {', '.join(gain['held_out'])}: {gain['error_removed_percent']:.0f} % of the "
            f"{gain['horizon_s']:g} s prediction error removed{interval}"
        )
        if round(gain["error_removed_percent"]) < 0:
            lines.append("  (it is larger with them in the model)")
        if gain["persistence_percent"] is not None:
            lines.append(f"  (that nothing moves: {gain['persistence_percent']:.0f} %)")
    following = findings["next_maneuver"]
    if following:
        lines.append(f"fly next: {following['maneuver']}: {following['why']}")
    return "\n".join([*lines, *(f"note: {remark}" for remark in result.remarks)])


def cause_line(cause: Mapping[str, Any]) -> str:
    """A cause of findings.json in one line, and what speaks against it in another."""
    values = ", ".join(
        f"{name.split('.')[1]} {p['value']:.4g} +- {p['std']:.2g} {p['unit']}"
        if p["determined"]
        else f"{name.split('.')[1]} not determined"
        for name, p in cause["parameters"].items()
    )
    line = f"  {cause['effect']}: {values}; {cause['evidence']:.0f} nats"
    if cause.get("since"):
        moment = cause["since"]
        line += f"; since {moment['t']:.2f} +- {moment['std']:.2g} s of {moment['run']}"
        if moment["grown"]:
            grown = moment["grown"]
            line += f", grown at {grown['t']:.2f} +- {grown['std']:.2g} s of {grown['run']}"
    if cause["confusable_with"]:
        line += f"; confounded alternatives: {', '.join(cause['confusable_with'])}"
    if cause["doubts"]:
        line += f"\n    {'; '.join(cause['doubts'])}"
    return line


if __name__ == "__main__":
    command_line.run(main)
