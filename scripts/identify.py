"""Fit a vehicle's parameters to a flight; the result is a vehicle file for the env."""

import argparse

import command_line

from coax_env import report
from coax_env.estimation.prediction import pooled_rms
from coax_env.files import make_folder, write_text
from coax_env.identification.identify import METHODS, Identification, identify
from coax_env.identification.two_step.method import TwoStep
from coax_env.model.vehicle_file import vehicle_toml


def main() -> None:
    options = arguments()
    with command_line.progress("identification") as report_progress:
        result = identify(
            options.flight,
            options.vehicle,
            options.method,
            report_progress,
            channels=None if options.channels is None else options.channels.split(","),
            also=[name for name in options.also.split(",") if name],
            hold_out=[name for name in options.hold_out.split(",") if name],
            waive=options.waive,
        )
    make_folder(options.out)
    path = write_text(options.out / "vehicle.toml", vehicle_toml(result.after))
    print_result(result)
    command = command_line.typed("identify")
    page = command_line.write_report(
        options.out / "report.html", lambda: report_page(result, command)
    )
    print(f"vehicle {path}, {page}")


def report_page(result: Identification | TwoStep, command: str) -> str:
    """The report of either method; `command` is what was typed."""
    if isinstance(result, TwoStep):
        return report.two_step_page(result, command)
    return report.identification_page(
        result.before,
        result.after,
        result.fitted,
        flight=result.flight,
        replay_before=result.replay_before,
        replay_after=result.replay_after,
        remarks=result.remarks,
        undetermined=result.undetermined,
        directions=result.directions,
        by_run=result.by_run,
        command_line=command,
    )


def print_result(result: Identification | TwoStep) -> None:
    """Parameters before and after, prediction errors, and what is not determined."""
    for name in result.fitted:
        old, new = result.before[name], result.after[name]
        print(f"{name:32s} {old.value:11.5g} -> {new.value:11.5g} +- {new.std:.2g} {new.unit}")
    if isinstance(result, Identification):
        before, after = pooled_rms(result.replay_before), pooled_rms(result.replay_after)
        moved = ", ".join(f"{c} {before[c]:.3g} -> {after[c]:.3g}" for c in after if c in before)
        print(f"1 s prediction error on {', '.join(result.flight.run_names)}: {moved}")
        if result.undetermined:
            print("not determined by these flights:", ", ".join(result.undetermined))
            print("undetermined combinations:", "; ".join(result.directions) or "each of them")
    for remark in result.remarks:
        print(remark)


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("identify", __doc__)
    command_line.add_flight(parser)
    command_line.add_waive(parser)
    parser.add_argument("--method", choices=METHODS, default="ml", help="default: %(default)s")
    parser.add_argument(
        "--channels", metavar="C,C", help="use these measured channels only (default: all)"
    )
    parser.add_argument(
        "--also", metavar="EFFECT,EFFECT", default="",
        help="free these effects' parameters too, gyro_bias,accel_bias for instance (method ml)",
    )  # fmt: skip
    parser.add_argument(
        "--hold-out", default="", metavar="RUN,RUN",
        help="runs not to fit; they are predicted before and after instead",
    )  # fmt: skip
    return parser.parse_args()


if __name__ == "__main__":
    command_line.run(main)
