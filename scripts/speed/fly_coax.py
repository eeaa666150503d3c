"""CoaxHeli-v0 as its users run it: `gymnasium.make` and `make_vec`, default sensors, autoreset."""

import sys
from typing import Any

from timing import BATCHES, Flown, drawn, main, with_resets

THREADS = 2
FACTS = {"control_hz": 100.0, "physics_steps": 1}


def open_env(count: int | None) -> Flown:
    """The env, or a vector env of so many."""
    import gymnasium

    import coax_env

    version = coax_env.__version__
    if count is None:
        env = gymnasium.make("CoaxHeli-v0")
        env.reset(seed=0)
        return Flown(with_resets(env), drawn(env.action_space), 1, **FACTS, version=version)
    many = gymnasium.make_vec(
        "CoaxHeli-v0", num_envs=count, vectorization_mode="vector_entry_point", threads=THREADS
    )
    many.reset(seed=0)
    return Flown(many.step, drawn(many.action_space), count, **FACTS, version=version,
                 note=f"RK4, onboard sensors with noise, {THREADS} threads")  # fmt: skip


def open_kernel(count: int | None) -> Flown:
    """The dynamics alone: no sensors, no reward, no end."""
    import numpy as np

    import coax_env
    from coax_env.env.fleet_simd import fly_dynamics
    from coax_env.model import dynamics

    vehicle = coax_env.load_vehicle("lama400d")
    state, command = dynamics.hover_trim(vehicle)
    rows = count or 1
    x = np.tile(dynamics.full_state(state, command, vehicle), (rows, 1))
    u = np.tile(dynamics.kernel_input(command), (rows, 1))

    def step(action: Any) -> None:
        fly_dynamics(x, u, vehicle, THREADS)

    return Flown(step, [None] * BATCHES, rows, **FACTS, version=coax_env.__version__,
                 note=f"RK4, {THREADS} threads")  # fmt: skip


if __name__ == "__main__":
    kernel = sys.argv[1] == "kernel"
    main(open_kernel if kernel else open_env)
