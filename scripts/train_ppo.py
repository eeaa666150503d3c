"""Train a policy with PPO on the Kalman filter's estimate. Ctrl-C keeps the policy so far."""

import argparse
import json
import os
from pathlib import Path
from typing import Any

import command_line
from tqdm import tqdm

from coax_env.env.tasks import TASKS
from coax_env.errors import InputError
from coax_env.files import write_json
from coax_env.model.sensors import SUITES
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers import ppo, trainings

TEST_SEED = 20_000
"""First seed of the flights on which the best policy is scored: it is selected on others."""


def main() -> None:
    options = arguments()
    if options.seeds < (0 if options.start else 1):
        raise InputError(
            f"need at least one seed, or a policy to start from; found {options.seeds}"
        )
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # small nets: more threads only get in the way

    vehicle = load_vehicle(options.vehicle)
    training: dict[str, Any] = {
        "steps": round(options.steps), "nominal": options.nominal, "sensors": options.sensors,
        "resume": options.resume, "tensorboard": options.tensorboard,
        "command_line": command_line.typed("train_ppo"), "task": options.task,
        "settings": dict(setting(text) for text in options.set), "hidden": options.hidden,
    }  # fmt: skip
    world: dict[str, Any] = command_line.air(options)
    if options.randomize:
        world["randomize"] = options.randomize
    if options.seeds == 1 and not options.start:
        path = train_one(vehicle, options, training | world)
        first = trainings.SELECTION_SEED + options.seed
    else:
        path = train_several(vehicle, options, training, world)
        first = TEST_SEED + options.seed
    score = trainings.score_of(path, vehicle, first, task=options.task, world=world)
    write_json(options.out / "score.json", score)
    print(in_words(score))
    print(f"policy {path}, score {options.out / 'score.json'}")


def arguments() -> argparse.Namespace:
    """What was asked for on the command line."""
    parser = command_line.parser("train_ppo", __doc__, seed=True)
    parser.add_argument("--vehicle", default="lama400d", help="shipped name or TOML file")
    parser.add_argument("--nominal", help="vehicle whose trim centres the action (default: bare)")
    parser.add_argument(
        "--task", nargs="+", default=["hover"], choices=list(TASKS),
        help="one or several, learnt by one policy; the score is of the first (default: hover)",
    )  # fmt: skip
    parser.add_argument(
        "--sensors", nargs="+", default=["onboard"], choices=list(SUITES),
        help="one suite or several; tasks with a target fly on those that show it (default: onboard)",
    )  # fmt: skip
    command_line.add_air(parser)
    parser.add_argument(
        "--hidden", action="store_true",
        help="half the flights on machines with lags and trims that the filter does not know",
    )  # fmt: skip
    parser.add_argument(
        "--steps", type=float, default=3e6, help="of all helicopters (default: 3e6)"
    )
    parser.add_argument("--randomize", choices=["posterior"], help="draw a vehicle every flight")
    parser.add_argument(
        "--resume", metavar="PATH", help="policy.zip to go on from; it may run code: trust it"
    )
    parser.add_argument(
        "--start", metavar="PATH",
        help="policy.zip for another model: kept is the best, on this vehicle, of it as it is, on this "
        "vehicle's filter and trim, trained from there, and --seeds from nothing (0: none)",
    )  # fmt: skip
    parser.add_argument(
        "--set", nargs="+", metavar="NAME=VALUE", default=[],
        help=f"hyperparameters, as JSON (default: {json.dumps(ppo.SETTINGS)})",
    )  # fmt: skip
    parser.add_argument("--tensorboard", metavar="DIR", help="write TensorBoard's logs there")
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="N",
        help="policies from seed, seed + 1, ...: DIR/seed_K each, the best in DIR; what lies there is "
        "not trained again (default: 1)",
    )  # fmt: skip
    command_line.add_workers(parser, "seeds", 1)
    return parser.parse_args()


def train_one(vehicle: Vehicle, options: argparse.Namespace, training: dict[str, Any]) -> Path:
    """DIR/policy.zip, there from the first checkpoint on.

    Args:
        vehicle: what flies.
        options: of the command line.
        training: further arguments of `ppo.train`.
    """
    with tqdm(total=training["steps"], unit="step", unit_scale=True, disable=None) as bar:

        def progress(steps: int, mean: dict[str, float]) -> None:
            bar.set_postfix(
                {"flight": f"{mean['seconds']:.1f} s", "return": f"{mean['return']:.0f}"}
            )
            bar.update(steps - bar.n)

        return ppo.train(vehicle, options.out, seed=options.seed, progress=progress, **training)


def train_several(
    vehicle: Vehicle,
    options: argparse.Namespace,
    training: dict[str, Any],
    world: dict[str, Any],
) -> Path:
    """Every candidate's policy.zip and score.json in a folder of DIR, and a copy of the best in DIR.

    Args:
        vehicle: what flies.
        options: of the command line.
        training: further arguments of `trainings.train_best`.
        world: arguments of the env in which they learn and are scored.
    """
    seeds = range(options.seed, options.seed + options.seeds)
    count = options.seeds + (3 if options.start else 0)
    with tqdm(total=count, unit="policy", disable=None) as bar:
        best, scores = trainings.train_best(
            vehicle, options.out, seeds, options.start, options.jobs, options.backend,
            done=lambda *_: bar.update(), world=world, **training,
        )  # fmt: skip
    for name, score in scores.items():
        print(f"{name.replace('_', ' ')}: {in_words(score)}")
    print(f"the best, {best.replace('_', ' ')}, on flights that it was not selected on:")
    return options.out / "policy.zip"


def in_words(score: dict[str, Any]) -> str:
    """A score in one line."""
    return (
        f"{score['episodes']} flights of {score['seconds']:.0f} s: "
        f"{100 * score['survival_rate']:.0f} % stay up, "
        f"{100 * score['success_rate']:.0f} % succeed, mean cost {score['mean_cost']:.3g}"
    )


def setting(text: str) -> tuple[str, Any]:
    """NAME=VALUE, the value as JSON where it is that, else as it stands."""
    name, _, value = text.partition("=")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


if __name__ == "__main__":
    command_line.run(main)
