"""Find what a vehicle's simulation gets wrong on measured flights, name the causes, extend it."""

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import command_line

from coax_env import load_effect
from coax_env.files import staged_folder, write_json, write_text

if TYPE_CHECKING:
    from coax_env.diagnosis.diagnose import Diagnosis
    from coax_env.report import FlownControllers


def main() -> None:
    parser = command_line.parser("diagnose", __doc__)
    parser.add_argument("flight", type=Path, help="flight folder")
    parser.add_argument("--vehicle", help="shipped name or TOML file (default: the card's)")
    parser.add_argument(
        "--hold-out", metavar="RUN,RUN|none",
        help="runs on which the gain is measured (default: a quarter, chosen by signature)",
    )  # fmt: skip
    parser.add_argument(
        "--exclude", default="", metavar="EFFECT,EFFECT", help="effects that must not be named"
    )
    parser.add_argument(
        "--effect", action="append", default=[], type=Path, metavar="FILE",
        help="Python file with an effect of your own (coax_env/user_effects.py); may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--ceiling", action="store_true",
        help="also fit a black box: how much of the reachable gain the named causes explain",
    )  # fmt: skip
    parser.add_argument(
        "--fly", action="store_true",
        help="also design a hover controller on the model before and after, and fly both",
    )  # fmt: skip
    options = parser.parse_args()
    for file in options.effect:
        load_effect(file)
    # compiles the kernel, with the catalogue as it is now
    from coax_env.diagnosis.diagnose import diagnose

    held = None
    if options.hold_out is not None:
        held = [] if options.hold_out == "none" else options.hold_out.split(",")
    with command_line.progress("diagnosis") as say:
        result = diagnose(
            options.flight,
            options.vehicle,
            hold_out=held,
            exclude=[e for e in options.exclude.split(",") if e],
            progress=say,
            ceiling=options.ceiling,
        )
        flown = fly(result, say) if options.fly else None
    save(result, options.out, "scripts/diagnose.py " + shlex.join(sys.argv[1:]), flown)
    print(summary(result))
    print(f"findings {options.out / 'findings.json'}, extended vehicle "
          f"{options.out / 'vehicle.toml'}, report {options.out / 'report.html'}")  # fmt: skip


def fly(result: "Diagnosis", say: Callable[[str], None]) -> "FlownControllers":
    """An LQG of each model, flown on the extended one: the machine itself is not at hand."""
    from controllers import mended

    say("flying a controller of each model")
    before, after = result.vehicle_before, result.vehicle_after
    flown = mended.before_and_after(before, after, after)
    return mended.flown_controllers(flown, "the extended model, the best guess at the machine")


def save(
    result: "Diagnosis", out: Path, command: str, flown: "FlownControllers | None" = None
) -> None:
    """findings.json, vehicle.toml and report.html, all or none; then the next flight's card."""
    from coax_env import report
    from coax_env.design.flight_card import write_flight_card
    from coax_env.model.vehicle_file import vehicle_toml

    page = report.diagnosis_page(result, command, flown)
    with staged_folder(out) as folder:
        write_json(folder / "findings.json", result.findings)
        write_text(folder / "vehicle.toml", vehicle_toml(result.vehicle_after))
        write_text(folder / "report.html", page)
    if result.design and result.design.ranked:
        write_flight_card(result.design, result.flight, out / "next_flight")


def summary(result: "Diagnosis") -> str:
    """The finding in a few lines."""
    findings = result.findings
    lines = [f"verdict: {findings['verdict']}"]
    for cause in findings["causes"]:
        values = ", ".join(
            f"{name.split('.')[1]} {p['value']:.4g} +- {p['std']:.2g} {p['unit']}"
            for name, p in cause["parameters"].items()
        )
        alike = ", ".join(cause["confusable_with"])
        lines.append(
            f"  {cause['effect']}: {values}; {cause['evidence']:.0f} nats"
            + (f"; these flights cannot tell it from {alike}" if alike else "")
        )
    for left in findings["unexplained"]:
        lines.append(f"  unexplained: {left['channel']} ({left['form']})")
    gain = findings["gain"]
    if gain and gain["error_removed_percent"] is not None:
        low, high = gain["ci95"]
        interval = "" if low is None else f" (95 % interval {low:.0f} to {high:.0f})"
        lines.append(
            f"gain on {', '.join(gain['held_out'])}: {gain['error_removed_percent']:.0f} % of the "
            f"{gain['horizon_s']:g} s prediction error removed{interval}"
        )
    following = findings["next_maneuver"]
    if following:
        lines.append(f"fly next: {following['maneuver']}: {following['why']}")
    for remark in result.remarks:
        lines.append(f"note: {remark}")
    return "\n".join(lines)


if __name__ == "__main__":
    command_line.run(main)
