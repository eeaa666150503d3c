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
from coax_env.files import write_bytes, write_json
from coax_env.model.sensors import SUITES
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers import ppo
from controllers.evaluation import evaluate
from controllers.policy import load_policy
from controllers.target import TargetView

FLIGHTS = 100
SELECTION_SEED, TEST_SEED = 10_000, 20_000
"""First seeds of the flights on which the best policy is selected, and on which it is then scored."""


def main() -> None:
    options = arguments()
    if options.seeds < 1:
        raise InputError(f"need at least one seed, found {options.seeds}")
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # small nets: more threads only get in the way

    vehicle = load_vehicle(options.vehicle)
    training: dict[str, Any] = {
        "steps": round(options.steps), "nominal": options.nominal, "sensors": options.sensors,
        "resume": options.resume, "tensorboard": options.tensorboard,
        "command_line": command_line.typed("train_ppo"),
        "settings": dict(setting(text) for text in options.set),
    }  # fmt: skip
    world: dict[str, Any] = command_line.air(options)
    if options.randomize:
        world["randomize"] = options.randomize
    training |= world | {"task": options.task, "hidden": options.hidden}
    if options.seeds == 1:
        path = train_one(vehicle, options, training)
        score = score_of(path, vehicle, SELECTION_SEED + options.seed, options.task[0], world)
    else:
        path = train_several(vehicle, options, training, world)
        score = score_of(path, vehicle, TEST_SEED + options.seed, options.task[0], world)
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
        "--set", nargs="+", metavar="NAME=VALUE", default=[],
        help=f"hyperparameters, as JSON (default: {json.dumps(ppo.SETTINGS)})",
    )  # fmt: skip
    parser.add_argument("--tensorboard", metavar="DIR", help="write TensorBoard's logs there")
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="N",
        help="policies from seed, seed + 1, ...: DIR/seed_K each, the best in DIR (default: 1)",
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
    """DIR/seed_K/policy.zip and score.json of every seed, and a copy of the best in DIR.

    Args:
        vehicle: what flies.
        options: of the command line.
        training: further arguments of `ppo.train_seeds`.
        world: arguments of the env in which they are scored.
    """
    seeds = range(options.seed, options.seed + options.seeds)
    found: dict[int, tuple[Path, dict[str, Any]]] = {}
    trained = ppo.train_seeds(
        vehicle, options.out, seeds, options.jobs, options.backend, **training
    )
    for seed, path in tqdm(trained, total=len(seeds), unit="policy", disable=None):
        first = SELECTION_SEED + options.seed
        found[seed] = path, score_of(path, vehicle, first, options.task[0], world)
        write_json(path.with_name("score.json"), found[seed][1])
    for seed in seeds:
        print(f"seed {seed}: {in_words(found[seed][1])}")
    best = min(seeds, key=lambda s: (-found[s][1]["success_rate"], found[s][1]["mean_cost"]))
    print(f"the best, seed {best}, on flights that it was not selected on:")
    return write_bytes(options.out / "policy.zip", found[best][0].read_bytes())


def score_of(
    path: Path, vehicle: Vehicle, seed: int, task: str, world: dict[str, Any]
) -> dict[str, Any]:
    """The score of a policy.

    Args:
        path: of its policy.zip.
        vehicle: what is flown.
        seed: of the first flight.
        task: that is flown, on the first suite that shows its target.
        world: arguments of the env.
    """
    policy = load_policy(path)
    suites = [s for s in policy.suites.sights if task == "hover" or TargetView(s).aims]
    return evaluate(policy.on(suites[0]), vehicle, FLIGHTS, seed=seed, task=task, **world)


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
