"""CoaxHeli-v0 with effects, in wind and turbulence, and drawn, against the bare vehicle: one process,
in turns, so that the machine's other load falls on all alike.

Called as ``python fly_vehicles.py fly|train COUNT ROUNDS``; the last line printed is a JSON object with
env-steps per second of each, the best of all rounds. ``fly``: COUNT envs under random actions;
``train``: PPO from nothing, `controllers.ppo.train` with its own settings.
"""

import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

THREADS = 2
STEPS = 16
"""Env steps of one turn, each with its own actions."""
TRAINED = 3 * 256 * 32 * 4
"""Control periods of one turn's training: three rollouts."""
TRAINED_ON = ("bare", "four effects", "nine effects")


def worlds() -> dict[str, dict[str, Any]]:
    """Arguments of the env by the name of what flies; the first is the bare vehicle."""
    import coax_env

    lama = coax_env.load_vehicle("lama400d")
    drag = lama.with_effect("rotor_drag", coefficient=3.5e-4)
    four = (  # the bundled flight's
        drag.with_effect("motor_lag", upper=0.07, lower=0.07)
        .with_effect("wind", north=-1.0, east=1.2)
        .with_effect("gyro_bias", x=4e-4, y=-0.012, z=2e-3)
    )
    nine = (  # those that the diagnosis of the real CoaX names
        lama.with_effect("command_delay", time=0.068)
        .with_effect("hub_stiffness", upper=0.2, lower=0.1)
        .with_effect("swash_phase", angle=0.2)
        .with_effect("yaw_damping", coefficient=3e-3)
        .with_effect("motor_droop", upper=0.2, lower=0.15)
        .with_effect("flap_blowback", gain=6e-3)
        .with_effect("swash_offset", lon=0.01, lat=-0.01)
        .with_effect("marker_offset", y=0.18)
        .with_effect("vibration", tilt=2.1e-3, heave=3.3e-4)
    )
    air = {"wind": 2.0, "turbulence": "light"}
    return {
        "bare": {},
        "four effects": {"vehicle": four},
        "nine effects": {"vehicle": nine},
        "wind and turbulence, rotor drag": {"vehicle": drag, **air},
        "four effects, wind and turbulence": {"vehicle": four, **air},
        "posterior": {"randomize": "posterior"},
    }


def flying(count: int, arguments: Mapping[str, Any]) -> Callable[[], int]:
    """One turn of a vector env under random actions, which returns its env-steps."""
    import numpy as np

    from coax_env.env.vector_env import CoaxVectorEnv

    env = CoaxVectorEnv(count, threads=THREADS, **arguments)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = [rng.uniform(-1.0, 1.0, (count, 4)).astype(np.float32) for _ in range(STEPS)]

    def turn() -> int:
        for action in actions:
            env.step(action)
        return STEPS * count

    return turn


def training(count: int, arguments: Mapping[str, Any]) -> Callable[[], int]:
    """One turn of PPO from nothing, which returns its control periods."""
    from controllers.ppo import train

    fly = {"vehicle": "lama400d", **arguments}

    def turn() -> int:
        with tempfile.TemporaryDirectory() as folder:
            train(out=folder, steps=TRAINED, **fly)
        return TRAINED

    return turn


def best_of(turns: Mapping[str, Callable[[], int]], rounds: int) -> dict[str, float]:
    """Steps per second of each, the best of so many rounds in turns; the first turn only warms up."""
    best = dict.fromkeys(turns, 0.0)
    for k in range(rounds + 1):
        for name, turn in turns.items():
            start = time.perf_counter()
            steps = turn()
            if k:
                best[name] = max(best[name], steps / (time.perf_counter() - start))
    return best


def main() -> None:
    training_too = sys.argv[1] == "train"
    make = partial(training if training_too else flying, int(sys.argv[2]))
    turns = {
        name: make(arguments)
        for name, arguments in worlds().items()
        if name in TRAINED_ON or not training_too
    }
    print(json.dumps(best_of(turns, int(sys.argv[3]))), flush=True)


if __name__ == "__main__":
    main()
