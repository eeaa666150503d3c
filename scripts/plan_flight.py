"""Plan a flight: maneuvers that determine a vehicle's parameters, proved safe in simulation."""

import argparse
from dataclasses import fields

import command_line

from coax_env.design.candidates import Envelope
from coax_env.design.flight_plan import plan_flight, write_plan
from coax_env.model.sensors import SUITES
from coax_env.simulation.simulate import Gusts

LIMITS = {
    "lowest": ("least height [m]", 1.0),
    "ceiling": ("greatest height [m]", 1.0),
    "tilt": ("greatest roll and pitch [deg]", 3.141592653589793 / 180.0),
    "turning": ("greatest yaw rate [deg/s]", 3.141592653589793 / 180.0),
    "speed": ("greatest speed [m/s]", 1.0),
    "room": ("greatest distance from the start [m]", 1.0),
}


def main() -> None:
    options = arguments()
    envelope = Envelope(
        **{name: getattr(options, name) * unit for name, (_, unit) in LIMITS.items()}
    )

    with command_line.progress("flight plan") as report_progress:
        plan = plan_flight(
            options.vehicle,
            [name for name in options.learn.split(",") if name],
            options.runs,
            options.sensors,
            envelope,
            Gusts() if options.gusts else None,
            options.seed,
            report_progress,
        )
    folder = write_plan(plan, options.out)
    for k, run in enumerate(plan.runs, 1):
        print(f"{k:2d}. {run.maneuver.name}: {run.maneuver.summary} (+{run.gain:.1f} nats)")
    for option, why in plan.refused:
        print(f"left out: {option.name}, {option.summary}: {why}")
    rows = [["parameter", "std now", "std after the flight", "left"]]
    for name in plan.wanted:
        now, then = plan.std_before[name], plan.std_after[name]
        rows.append([name, f"{now:.3g}", f"{then:.3g}", f"{100 * then / now:.0f} %"])
    command_line.print_columns(rows)
    print(f"flight card {folder / 'card.toml'}, setpoints in {folder / 'asked_01.csv'} ...")


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("plan_flight", __doc__, seed=True)
    parser.add_argument("--vehicle", default="lama400d", help="shipped name or TOML file")
    parser.add_argument(
        "--learn", default="", metavar="NAME,NAME",
        help="parameters or effects to learn (default: every base parameter with a std)",
    )  # fmt: skip
    parser.add_argument("--runs", type=int, default=8, help="maneuvers (default: %(default)s)")
    parser.add_argument(
        "--sensors", default="onboard", help=f"{', '.join(SUITES)} (default: %(default)s)"
    )
    parser.add_argument("--gusts", action="store_true", help="plan for light gusts, not still air")
    usual = {f.name: float(f.default) for f in fields(Envelope)}  # type: ignore[arg-type]
    for name, (what, unit) in LIMITS.items():
        parser.add_argument(
            f"--{name}", type=float, default=usual[name] / unit, metavar="X",
            help=f"{what} (default: %(default).3g)",
        )  # fmt: skip
    return parser.parse_args()


if __name__ == "__main__":
    command_line.run(main)
