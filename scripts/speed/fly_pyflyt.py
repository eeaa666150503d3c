"""PyFlyt's hover env: PyBullet, an agent at 40 Hz over physics at 240 Hz."""

import warnings
from importlib.metadata import version

from timing import Flown, drawn, main, with_resets

MOST = 8  # a process with its own PyBullet each; 4096 of them would not fit into memory


def open_env(count: int | None) -> Flown:
    """The env, or Gymnasium's AsyncVectorEnv over at most MOST of them."""
    warnings.simplefilter("ignore")
    import gymnasium
    import PyFlyt.gym_envs  # noqa: F401 - registers

    name = "PyFlyt/QuadX-Hover-v4"
    facts = {"control_hz": 40.0, "physics_steps": 6, "version": version("pyflyt")}
    if count is None:
        env = gymnasium.make(name)
        env.reset(seed=0)
        return Flown(with_resets(env), drawn(env.action_space), 1, **facts)
    many = gymnasium.make_vec(name, num_envs=min(count, MOST), vectorization_mode="async")
    many.reset(seed=0)
    return Flown(many.step, drawn(many.action_space), many.num_envs, **facts,
                 note="AsyncVectorEnv, a process per env")  # fmt: skip


if __name__ == "__main__":
    main(open_env)
