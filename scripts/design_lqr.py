"""Design a hover controller (LQR with integral action, and a Kalman filter) on a vehicle."""

import argparse

import command_line

from coax_env.env import hover
from coax_env.files import make_folder
from coax_env.model.sensors import SUITES
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers import hinf, lqr, margins, schedule
from controllers.design_report import (
    BESIDE_HEADER,
    MARGIN_HEADER,
    STEP_HEADER,
    design_page,
    disk_in_words,
    extreme_in_words,
    margin_rows,
    spread_in_words,
    step_rows,
)
from controllers.evaluation import evaluate, evaluate_spread
from controllers.steps import step_responses


def main() -> None:
    options = arguments()
    vehicle = load_vehicle(options.vehicle)
    limits = command_line.numbers(options.limits, "--limits")
    weights = command_line.numbers(options.weights, "--weights")
    asked = (options.nominal, options.sensors, limits, weights)
    designs: dict[str, margins.Design] = {"lqg": lqr.design(vehicle, *asked)}
    if options.hedge:
        designs["lqg, hedged"] = lqr.design(vehicle, *asked, hedge=lqr.HEDGE)
    if options.method == "hinf":
        designs["hinf"] = hinf.design(vehicle, *asked)
    controller = list(designs.values())[-1]
    scheduled = (
        schedule.design(vehicle, options.nominal, options.sensors, options.speeds, limits, weights)
        if options.speeds
        else None
    )
    inputs, disk = margins.stability_margins(controller)
    score = evaluate(controller, vehicle, episodes=50, seed=options.seed)
    worst = evaluate_spread(controller, vehicle, options.vehicles, 5, seed=options.seed)
    spread = margins.margins_over_spread(controller, vehicle, options.vehicles, options.seed)
    extreme = margins.worst_over_spread(controller, vehicle, seed=options.seed)
    beside = beside_rows(designs, vehicle, options.seed) if len(designs) > 1 else []
    steps = step_responses(controller)
    make_folder(options.out)
    path = controller.save(options.out / "controller.json")
    if scheduled is not None:
        print(f"gain schedule {scheduled.save(options.out / 'schedule.json')}")
    words = command_line.typed("design_lqr")
    page = command_line.write_report(
        options.out / "report.html",
        lambda: design_page(
            controller, vehicle, inputs, disk, score, worst, spread, steps, words, extreme, beside
        ),
    )
    print_margins(controller, inputs, disk)
    print(
        f"{score['episodes']} flights of {score['seconds']:.0f} s on this vehicle: "
        f"{100 * score['success_rate']:.0f} % succeed, mean cost {score['mean_cost']:.3g}"
    )
    print(spread_in_words(worst, spread))
    print(extreme_in_words(extreme))
    if beside:
        command_line.print_columns([BESIDE_HEADER, *beside])
    command_line.print_columns([STEP_HEADER, *step_rows(steps)])
    print(f"controller {path}, {page}")


def beside_rows(designs: dict[str, margins.Design], vehicle: Vehicle, seed: int) -> list[list[str]]:
    """Designs side by side, on the vehicle and with lqr.HEDGE's lags in it.

    Args:
        designs: by name.
        vehicle: what they were designed on.
        seed: of the flights.
    """
    rows = []
    for name, one in designs.items():
        row = [name]
        for flown in (vehicle, lqr.hedged(vehicle, lqr.HEDGE)):
            score = evaluate(one, flown, episodes=50, seed=seed)
            disk = margins.disk_margin(one, flown)
            row += [f"{disk:.2f}" if disk else "unstable", f"{score['mean_cost']:.3g}"]
        rows.append(row)
    return rows


def print_margins(
    controller: margins.Design, inputs: list[margins.InputMargins], disk: float
) -> None:
    """Stability margins, and the states that the sensors do not show.

    Args:
        controller: the design.
        inputs: margins of each input.
        disk: margin of all inputs at once.
    """
    command_line.print_columns([MARGIN_HEADER, *margin_rows(inputs)])
    gain, phase = disk_in_words(disk)
    print(f"all inputs at once: disk margin {disk:.2f}, {gain} in gain or {phase} in phase")
    hidden = controller.estimator.unobserved
    print("not observable with these sensors, left out:", ", ".join(hidden) or "nothing")
    if "theta" in hidden:
        print("WARNING: without attitude or velocity no linear design can hold the hover")


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("design_lqr", __doc__, seed=True)
    parser.add_argument("--vehicle", default="lama400d", help="shipped name or TOML file")
    parser.add_argument("--nominal", help="vehicle whose trim centres the action (default: bare)")
    parser.add_argument(
        "--sensors", default="onboard", help=f"{', '.join(SUITES)} (default: %(default)s)"
    )
    parser.add_argument(
        "--weights", nargs="+", default=[], metavar="FILE|NAME=VALUE",
        help="of the squared errors; a TOML file of such lines, or one by one (default: "
        + ", ".join(f"{name}={value:g}" for name, value in hover.COST_WEIGHTS.items()) + ")",
    )  # fmt: skip
    parser.add_argument(
        "--limits", nargs="+", default=[], metavar="FILE|NAME=VALUE",
        help="errors that count their weight, SI (default: "
        + ", ".join(f"{name}={value:.3g}" for name, value in hover.LIMITS.items()) + ")",
    )  # fmt: skip
    parser.add_argument(
        "--speeds",
        type=float,
        nargs="+",
        metavar="M/S",
        help="also a gain schedule over forward speed, rising from 0: DIR/schedule.json",
    )
    parser.add_argument(
        "--method", choices=("lqg", "hinf"), default="lqg",
        help="hinf: H-infinity (slycot), beside LQG in the report (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--hedge", action="store_true",
        help="reckon with lags of motors and servos that the vehicle file does not name",
    )  # fmt: skip
    parser.add_argument(
        "--vehicles", type=int, default=20,
        help="how many to draw from the file's spread for the worst case (default: %(default)s)",
    )  # fmt: skip
    return parser.parse_args()


if __name__ == "__main__":
    command_line.run(main)
