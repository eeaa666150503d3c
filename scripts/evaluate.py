"""Fly a hover controller many times and judge it from true states."""

import command_line
from tqdm import tqdm

from coax_env.files import write_json
from coax_env.hover import CONTROL_PERIOD
from coax_env.vehicle import load_vehicle
from controllers import Controller, load_controller, lqr
from controllers.evaluation import evaluate


def main() -> None:
    parser = command_line.parser("evaluate", __doc__, seed=True)
    parser.add_argument(
        "--controller", default="lqr", metavar="lqr|PATH",
        help="lqr (designed on the vehicle), a controller.json or a policy.zip",
    )  # fmt: skip
    parser.add_argument(
        "--vehicle", default="lama400d", help="what flies: shipped name or TOML file"
    )
    parser.add_argument("--episodes", type=int, default=100, help="(default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="(default: %(default)s)")
    parser.add_argument("--sensors", help="for lqr (default: onboard); else the controller's own")
    parser.add_argument("--wind", type=float, nargs="+", metavar="M/S", help="north east, or speed")
    options = parser.parse_args()

    vehicle = load_vehicle(options.vehicle)
    controller: Controller
    if options.controller == "lqr":
        controller = lqr.design(vehicle, sensors=options.sensors or "onboard")
    else:
        controller = load_controller(options.controller)
    with tqdm(
        total=round(options.seconds / CONTROL_PERIOD), unit="step", leave=False, disable=None
    ) as bar:
        score = evaluate(
            controller, vehicle, options.episodes, options.seconds, options.seed, options.sensors,
            bar.update, wind=options.wind,
        )  # fmt: skip
    path = write_json(options.out / "score.json", score)
    command_line.print_columns(
        [[name, words(value)] for name, value in score.items() if not isinstance(value, dict)]
    )
    print(f"score {path}")


def words(value: object) -> str:
    """A figure of the score as text."""
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)


if __name__ == "__main__":
    command_line.run(main)
