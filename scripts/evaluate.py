"""Fly a hover controller many times and score it from true states; or compare all of them."""

import argparse
from typing import Any

import command_line
from tqdm import tqdm

from coax_env.env.hover import CONTROL_PERIOD
from coax_env.env.paths import SHAPES
from coax_env.env.tasks import TASKS
from coax_env.errors import InputError
from coax_env.files import make_folder, write_json
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers import comparison
from controllers.evaluation import evaluate, evaluate_spread
from controllers.loading import KINDS, Controller, make_controller


def main() -> None:
    options = arguments()
    vehicle = load_vehicle(options.vehicle)
    if options.compare:
        compare(options, vehicle)
        return
    controller = make_controller(options.controller, vehicle, None, options.sensors)
    score = fly(options, vehicle, controller)
    path = write_json(options.out / "score.json", score)
    command_line.print_columns(
        [[n, words(v)] for n, v in score.items() if not isinstance(v, dict | list)]
    )
    print(f"score {path}")


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("evaluate", __doc__, seed=True)
    parser.add_argument(
        "--controller", default="lqr", metavar="NAME|PATH",
        help="a controller.json, a policy.zip, a function, class or python-control system of your own "
        "(my.py:NAME), a zip of Stable-Baselines3 (both run what is in the file), or "
        + "; ".join(f"{name}: {words}" for name, words in KINDS.items()),
    )  # fmt: skip
    parser.add_argument(
        "--vehicle", default="lama400d", help="what flies: shipped name or TOML file"
    )
    parser.add_argument("--episodes", type=int, default=100, help="(default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="(default: %(default)s)")
    parser.add_argument("--sensors", help="to design for (default: onboard); a file has its own")
    command_line.add_air(parser)
    parser.add_argument("--task", default="hover", choices=list(TASKS), help="(default: hover)")
    parser.add_argument(
        "--path", metavar="NAME|CSV",
        help=f"of --task trajectory: {', '.join(SHAPES)}, or columns t, north, east, height, heading",
    )  # fmt: skip
    parser.add_argument(
        "--randomize", choices=["posterior"],
        help="fly vehicles drawn from the file's spread; the score is of the worst",
    )  # fmt: skip
    parser.add_argument("--vehicles", type=int, default=50, help="how many (default: 50)")
    command_line.add_workers(parser, "drawn vehicles", 1)
    parser.add_argument(
        "--compare", action="store_true",
        help="LQG, PPO, PID and LQI in hover, gusts, wind, on drawn vehicles, and to targets; "
        "--controller may give the policy",
    )  # fmt: skip
    return parser.parse_args()


def fly(options: argparse.Namespace, vehicle: Vehicle, controller: Controller) -> dict[str, Any]:
    """The score, on the vehicle or on the worst of those drawn from its spread.

    Args:
        options: of the command line.
        vehicle: what is flown.
        controller: what flies.
    """
    env: dict[str, Any] = command_line.air(options) | {"task": options.task}
    if options.path:
        if options.task != "trajectory":
            raise InputError("--path is for --task trajectory")
        env["target"] = options.path
    if options.randomize:
        with tqdm(total=options.vehicles, unit="vehicle", leave=False, disable=None) as bar:
            return evaluate_spread(
                controller, vehicle, options.vehicles, options.episodes, options.seconds,
                options.seed, bar.update, options.jobs, options.backend, **env,
            )  # fmt: skip
    steps = round(options.seconds / CONTROL_PERIOD)
    with tqdm(total=steps, unit="step", leave=False, disable=None) as bar:
        return evaluate(
            controller, vehicle, options.episodes, options.seconds, options.seed, options.sensors,
            bar.update, **env,
        )  # fmt: skip


def compare(options: argparse.Namespace, vehicle: Vehicle) -> None:
    """The comparison's table, compare.json and report.html."""
    named = options.controller in KINDS and options.controller != "ppo_outdoor"
    policy = None if named else make_controller(options.controller)
    with command_line.progress("compare") as report_progress:
        content = comparison.compare(
            vehicle, policy, options.episodes, options.seconds, options.vehicles, options.seed,
            report_progress,
            options.jobs, options.backend,
        )  # fmt: skip
    make_folder(options.out)
    path = write_json(options.out / "compare.json", content)
    words = command_line.typed("evaluate")
    page = command_line.write_report(
        options.out / "report.html", lambda: comparison.comparison_page(content, words)
    )
    rows = comparison.rows(content["conditions"])
    command_line.print_columns(comparison.without_repeats(comparison.HEADER, rows))
    print(f"scores {path}, {page}")


def words(value: object) -> str:
    """A figure of the score as text."""
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)


if __name__ == "__main__":
    command_line.run(main)
