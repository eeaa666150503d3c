"""Does the env fly on for ever? A hundred million steps in every kind of world, each number checked.

In turns through the worlds: every sensor suite and task, gusts, wind and turbulence, drawn vehicles,
every effect at once. A quarter of the rows is flown by an LQG, a quarter by one that is pushed about, a
quarter by held random commands, a quarter by full deflections. After every step all observations must
lie in their space, all rewards be finite and at least zero, all states finite and within bounds.
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import command_line
import numpy as np
from tqdm import tqdm

from coax_env import load_vehicle
from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.errors import InputError
from coax_env.files import write_json
from coax_env.model.effects import CATALOGUE
from coax_env.model.layout import FULL_STATES
from coax_env.model.vehicle import Vehicle
from controllers import lqr

LONGEST = 2000  # steps of a flight
HELD = 25  # steps for which a random command is held
PUSH = 0.3  # std of what is added to an LQG's actions
FARTHEST = {
    "rad/s": 1e4, "m/s": 100.0, "m": 100.0, "rad": 1e4, "N": 100.0, "N m": 100.0,
    "1": 100.0,
}  # fmt: skip
"""Bounds of the states, by unit: far beyond any flight, far below what runs away. A heading counts its
turns: a light machine with both rotors at their ends spins by a hundred in a flight."""


@dataclass(frozen=True)
class World:
    """One kind of env: the arguments of `CoaxVectorEnv`, and the vehicle an LQG is designed on."""

    name: str
    arguments: Mapping[str, Any]
    vehicle: str | Vehicle = "lama400d"

    @property
    def sensors(self) -> str:
        """The suite it is seen by."""
        return self.arguments.get("sensors", "onboard")


def everything() -> Vehicle:
    """The vehicle with every effect of the catalogue at half its usual size."""
    vehicle = load_vehicle("lama400d")
    for name, effect in CATALOGUE.items():
        sizes = {p.name: p.off if p.shape else p.at(0.5) for p in effect.parameters}
        vehicle = vehicle.with_effect(name, **sizes)
    return vehicle.with_actuators(swash_travel=0.15, swash_rate=3.0, rotor_acceleration=600.0)


def worlds() -> list[World]:
    """All that are flown."""
    draggy = load_vehicle("lama400d").with_effect("rotor_drag", coefficient=4e-4)
    ranges = {"mass": (0.7, 0.9), "ground_effect.gain": (0.0, 0.3), "servo_delay.time": (0.0, 0.05)}
    return [
        World("bare", {}),
        World("paper's sensors, gusts", {"sensors": "paper", "gusts": (0.3, 0.01)}),
        World("drawn vehicles", {"sensors": "state", "task": "position", "randomize": "posterior"}),
        World("turbulence", {"vehicle": draggy, "turbulence": "moderate", "wind": 3.0}, draggy),
        World("waypoints", {"sensors": "mocap", "task": "waypoints"}),
        World("ranges", {"randomize": ranges, "wind": (1.0, -1.0)}),
        World("every effect", {"vehicle": everything(), "sensors": "mocap", "turbulence": "light"}),
        World("CoaX", {"vehicle": "skybotix_coax", "gusts": (0.05, 1e-3)}, "skybotix_coax"),
    ]


class Fault(Exception):
    """A number that should not be."""


class Flying:
    """A world's env with who flies it, and what has been seen of its states."""

    def __init__(self, world: World, envs: int, seed: int) -> None:
        self.world = world
        self.env = CoaxVectorEnv(
            envs, max_episode_steps=LONGEST, autoreset_mode="SameStep", **world.arguments
        )
        self.rng = np.random.default_rng(seed)
        self.lqg = lqr.design(world.vehicle, sensors=world.sensors)
        self.lqg.reset(envs)
        self.held = np.zeros((envs, 4))
        self.observation, info = self.env.reset(seed=seed)
        self.farthest = np.abs(info["state"]).max(axis=0)
        self.flights = self.steps = 0
        bounds = self.env.fleet.low, self.env.fleet.high
        self.low, self.high = (bound.astype(self.observation.dtype) for bound in bounds)
        self.bounds = np.array([FARTHEST[unit] for _, unit in FULL_STATES])

    def step(self) -> None:
        """One step of every row, and the check of all that it brought."""
        observation, reward, terminated, truncated, info = self.env.step(self.actions())
        ended = terminated | truncated
        self.check("observation", observation, self.low, self.high)
        self.check("reward", reward, 0.0, 60.0)
        self.check("state", info["state"], -self.bounds, self.bounds)
        if ended.any():
            self.check("last observation", info["final_obs"], self.low, self.high)
            self.check("last state", info["final_info"]["state"], -self.bounds, self.bounds)
            self.lqg.tracker.reset(ended)
        self.observation = observation
        np.maximum(self.farthest, np.abs(info["state"]).max(axis=0), out=self.farthest)
        self.flights += int(ended.sum())
        self.steps += len(ended)

    def actions(self) -> np.ndarray:
        """Of each row by its number: an LQG's, an LQG's pushed about, held ones, full deflections."""
        actions = np.asarray(self.lqg.act(self.observation), dtype=float)
        if self.steps % (HELD * len(actions)) == 0:
            self.held = self.rng.uniform(-1.0, 1.0, actions.shape)
        actions[1::4] += PUSH * self.rng.standard_normal(actions[1::4].shape)
        actions[2::4] = self.held[2::4]
        actions[3::4] = np.sign(self.held[3::4])
        return actions

    def check(self, what: str, values: np.ndarray, low: Any, high: Any) -> None:
        """Raise a Fault where a value is not a number, or out of bounds.

        Args:
            what: name of the values in the message. values: any shape.
            low, high: bounds, broadcast against the values.
        """
        fine = (values >= low) & (values <= high)  # false for NaN
        if not fine.all():
            place = tuple(int(i) for i in np.argwhere(~fine)[0])
            raise Fault(
                f"{self.world.name}: after {self.steps:,} steps {what} {place} is {values[place]}"
            )


def main() -> None:
    parser = command_line.parser("endurance", __doc__, seed=True)
    parser.add_argument("--steps", type=float, default=1e8, help="of all rows (default: 1e8)")
    parser.add_argument("--envs", type=int, default=4096, help="rows flown at once (default: 4096)")
    options = parser.parse_args()
    if options.envs < 4 or not (math.isfinite(options.steps) and options.steps >= 1.0):
        raise InputError("--steps must be at least 1 and --envs at least 4")
    start = time.monotonic()
    with tqdm(total=round(options.steps), desc="endurance", unit="step", unit_scale=True) as bar:
        rows = fly(round(options.steps), options.envs, options.seed, bar.update)
    seconds = time.monotonic() - start
    total = sum(row["steps"] for row in rows)
    write_json(options.out / "endurance.json", {"steps": total, "seconds": seconds, "worlds": rows})
    lines = [["world", "steps", "flights", "fastest rate", "fastest", "highest"]]
    for row in rows:
        x = row["farthest"]
        rate, speed = max(x["p"], x["q"], x["r"]), max(x["u"], x["v"], x["w"])
        lines.append([row["world"], f"{row['steps']:,}", f"{row['flights']:,}",
                      f"{rate:.1f} rad/s", f"{speed:.1f} m/s", f"{x['z']:.2f} m"])  # fmt: skip
    command_line.print_columns(lines)
    print(f"{total:,} steps in {seconds:.0f} s, every number finite and within its bounds")


def fly(
    steps: int, envs: int, seed: int, flown: Callable[[int], object] = lambda rows: None
) -> list[dict[str, Any]]:
    """Fly so many steps in all, every world its share.

    Args:
        steps: of all rows together. envs: rows flown at once. seed: of the first world.
        flown: called with the number of rows after every step.

    Raises:
        Fault: a number that is not finite or out of bounds.
    """
    rows = []
    every = worlds()
    for k, world in enumerate(every):
        flying = Flying(world, envs, seed + k)
        share = math.ceil(steps / len(every) / envs)
        for _ in range(share):
            flying.step()
            flown(envs)
        farthest = dict(zip((n for n, _ in FULL_STATES), flying.farthest.tolist(), strict=True))
        rows.append({"world": world.name, "steps": flying.steps, "flights": flying.flights,
                     "farthest": farthest})  # fmt: skip
    return rows


if __name__ == "__main__":
    command_line.run(main)
