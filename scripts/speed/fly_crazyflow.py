"""crazyflow's reach-position task, JAX on the CPU, settings as they come.

Physics 500 Hz, one step per env-step; the true state is observed.
"""

import warnings
from importlib.metadata import version

from timing import Flown, drawn, main


def open_env(count: int | None) -> Flown:
    """The vector env; crazyflow's single env is one of one."""
    warnings.simplefilter("ignore")
    import crazyflow.envs  # noqa: F401 - registers
    import gymnasium
    import jax

    env = gymnasium.make_vec("DroneReachPos-v0", num_envs=count or 1)
    env.reset(seed=0)
    actions = [jax.numpy.asarray(a) for a in drawn(env.action_space)]
    last: list[object] = []

    def step(action: object) -> None:
        last[:] = env.step(action)[:2]

    return Flown(
        step, actions, count or 1, control_hz=500.0, physics_steps=1, version=version("crazyflow"),
        note="JAX, true state observed", finish=lambda: jax.block_until_ready(last),
    )  # fmt: skip


if __name__ == "__main__":
    main(open_env)
