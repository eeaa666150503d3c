"""RotorPy's vectorised hover env (a stable-baselines3 VecEnv on torch), 100 Hz, motor speeds."""

import warnings
from importlib.metadata import version

from timing import BATCHES, Flown, main


def open_env(count: int | None) -> Flown:
    """Its own default batch; it has no other single env than a batch of one."""
    warnings.simplefilter("ignore")
    import numpy as np
    import torch
    from rotorpy.learning.quadrotor_environments import make_default_vec_env
    from rotorpy.vehicles.crazyflie_params import quad_params

    rows = count or 1
    env = make_default_vec_env(rows, quad_params, "cmd_motor_speeds", torch.device("cpu"))
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = [rng.uniform(-1.0, 1.0, (rows, 4)).astype(np.float32) for _ in range(BATCHES)]
    return Flown(
        env.step, actions, rows, control_hz=100.0, physics_steps=1, version=version("rotorpy"),
        note="RK4, torch, true state observed",
    )  # fmt: skip


if __name__ == "__main__":
    main(open_env)
