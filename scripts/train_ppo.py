"""Train a hover policy with PPO on the Kalman filter's estimate. Ctrl-C keeps what is learnt."""

import json
import os
import shlex
import sys
from typing import Any

import command_line
from tqdm import tqdm

from coax_env.files import write_json
from coax_env.sensors import SUITES
from coax_env.vehicle import load_vehicle
from controllers import load_controller, ppo
from controllers.evaluation import evaluate


def main() -> None:
    parser = command_line.parser("train_ppo", __doc__, seed=True)
    parser.add_argument("--vehicle", default="lama400d", help="shipped name or TOML file")
    parser.add_argument("--nominal", help="vehicle whose trim centres the action (default: bare)")
    parser.add_argument(
        "--sensors", default="onboard", help=f"{', '.join(SUITES)} (default: %(default)s)"
    )
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
    options = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # small nets: more threads only get in the way

    vehicle = load_vehicle(options.vehicle)
    with tqdm(total=round(options.steps), unit="step", unit_scale=True, disable=None) as bar:

        def progress(steps: int, mean: dict[str, float]) -> None:
            bar.set_postfix(
                {"flight": f"{mean['seconds']:.1f} s", "return": f"{mean['return']:.0f}"}
            )
            bar.update(steps - bar.n)

        more: dict[str, Any] = {"randomize": options.randomize} if options.randomize else {}
        path = ppo.train(
            vehicle, options.out, round(options.steps), options.seed, options.nominal,
            options.sensors, options.resume, progress, options.tensorboard,
            command_line=shlex.join(["scripts/train_ppo.py", *sys.argv[1:]]),
            settings=dict(setting(text) for text in options.set), **more,
        )  # fmt: skip
    score = evaluate(load_controller(path), vehicle, episodes=100, seed=10_000 + options.seed)
    write_json(options.out / "score.json", score)
    print(
        f"100 flights of 20 s: {100 * score['survival_rate']:.0f} % stay up, "
        f"{100 * score['success_rate']:.0f} % succeed, mean cost {score['mean_cost']:.3g}"
    )
    print(f"policy {path}, score {options.out / 'score.json'}")


def setting(text: str) -> tuple[str, Any]:
    """NAME=VALUE, the value as JSON where it is that, else as it stands."""
    name, _, value = text.partition("=")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


if __name__ == "__main__":
    command_line.run(main)
