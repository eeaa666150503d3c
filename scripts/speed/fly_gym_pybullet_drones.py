"""gym-pybullet-drones' hover env: PyBullet, an agent at 30 Hz over physics at 240 Hz."""

import contextlib
import sys
import warnings
from importlib.metadata import version

from timing import Flown, drawn, main, with_resets


def open_env(count: int | None) -> Flown:
    """The single env; for many its users take a process each, which PyFlyt's row shows."""
    warnings.simplefilter("ignore")
    with contextlib.redirect_stdout(sys.stderr):
        import gym_pybullet_drones  # noqa: F401 - registers
        import gymnasium

        env = gymnasium.make("hover-aviary-v0")
        env.reset(seed=0)
    return Flown(with_resets(env), drawn(env.action_space), 1, control_hz=30.0, physics_steps=8,
                 version=version("gym-pybullet-drones"))  # fmt: skip


if __name__ == "__main__":
    main(open_env)
