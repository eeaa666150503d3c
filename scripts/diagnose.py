"""Find what a vehicle's simulation gets wrong on measured flights, name the causes, correct it."""

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import command_line

from coax_env import load_effect
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
    for file in options.effect:
        load_effect(file)
    # compiles the kernel, with the catalogue as it is now
    from coax_env.diagnosis.diagnose import diagnose

    hold_out = None
    if options.hold_out is not None:
        hold_out = [] if options.hold_out == "none" else options.hold_out.split(",")
    with command_line.progress("diagnosis") as report_progress:
        result = diagnose(
            options.flight,
            options.vehicle,
            hold_out=hold_out,
            exclude=[e for e in options.exclude.split(",") if e],
            progress=report_progress,
            ceiling=options.ceiling,
        )
        scores = fly_both(result, report_progress) if options.fly else None
    save(result, options.out, "scripts/diagnose.py " + shlex.join(sys.argv[1:]), scores)
    print(summary(result))
    print(f"findings {options.out / 'findings.json'}, corrected vehicle "
          f"{options.out / 'vehicle.toml'}, report {options.out / 'report.html'}")  # fmt: skip


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("diagnose", __doc__)
    command_line.add_flight(parser)
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
) -> None:
    """findings.json, vehicle.toml and report.html, all or none; then the next flight's card.

    Args:
        result: of the diagnosis.
        out: folder of the results.
        command: what was typed.
        scores: of controllers designed on both models.
    """
    from coax_env import report
    from coax_env.design.flight_card import write_flight_card
    from coax_env.model.vehicle_file import vehicle_toml

    page = report.diagnosis_page(result, command, scores)
    with staged_folder(out) as folder:
        write_json(folder / "findings.json", result.findings)
        write_text(folder / "vehicle.toml", vehicle_toml(result.vehicle_after))
        write_text(folder / "report.html", page)
    if result.design and result.design.ranked:
        write_flight_card(result.design, result.flight, out / "next_flight")


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
    gain = findings["gain"]
    if gain and gain["error_removed_percent"] is not None:
        low, high = gain["ci95"]
        interval = "" if low is None else f" (95 % interval {low:.0f} to {high:.0f})"
        lines.append(
            f"gain on {', '.join(gain['held_out'])}: {gain['error_removed_percent']:.0f} % of the "
            f"{gain['horizon_s']:g} s prediction error removed{interval}"
        )
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
    if cause["confusable_with"]:
        line += f"; confounded alternatives: {', '.join(cause['confusable_with'])}"
    if cause["doubts"]:
        line += f"\n    {'; '.join(cause['doubts'])}"
    return line


if __name__ == "__main__":
    command_line.run(main)
