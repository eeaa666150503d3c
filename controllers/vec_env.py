"""The batch of helicopters as Stable-Baselines3 wants it: a VecEnv over CoaxVectorEnv.

``PPO("MlpPolicy", FleetVecEnv(256))`` trains on raw observations. Each env is handed its own
``terminal_observation`` and ``TimeLimit.truncated``. A subclass that gives the policy something else
than the observation (an estimate, a history) overrides `begin`, `view` and `acted`.

Importing this module imports Stable-Baselines3, and with it torch.
"""

import time
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.errors import InputError, require

_base = require("stable_baselines3.common.vec_env", "rl")


class FleetVecEnv(_base.VecEnv):  # type: ignore[name-defined]
    """Many helicopters for Stable-Baselines3; after ``seed(s)``, row i flies seed s + i.

    Args:
        num_envs: how many.
        max_episode_steps: the time limit; None for none.
        reward_scale: what rewards are multiplied with.
        observation_space: what `view` returns, per env; None: the env's own.
        env_arguments: further ones of CoaxVectorEnv, such as ``vehicle`` and ``task``.
    """

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = 2000,
        reward_scale: float = 1.0,
        observation_space: Box | None = None,
        **env_arguments: Any,
    ) -> None:
        self.env = CoaxVectorEnv(
            num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=AutoresetMode.SAME_STEP,
            **env_arguments,
        )
        self._reward_scale = reward_scale
        self._return, self._length = np.zeros(num_envs), np.zeros(num_envs, dtype=np.int64)
        self._begun = time.time()
        space = observation_space or self.env.single_observation_space
        super().__init__(num_envs, space, self.env.single_action_space)

    # --- what a subclass may change -----------------------------------------------------------------

    def begin(self, which: np.ndarray) -> None:
        """The rows of a mask (num_envs,) have started new flights; their observations follow."""

    def view(self, observations: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
        """What the policy gets of observations (num_envs, n): an array with one row each.

        With a mask, only those rows are new: the rest has been seen already.
        """
        return observations

    def acted(self, actions: np.ndarray) -> None:
        """These actions (num_envs, 4), within [-1, 1], are flown next."""

    # --- the interface of Stable-Baselines3 ---------------------------------------------------------

    def reset(self) -> np.ndarray:
        """New flights everywhere; returns what the policy gets, (num_envs, n)."""
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observations, info = self.env.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [_of_row(info, i) for i in range(self.num_envs)]
        self.begin(np.ones(self.num_envs, dtype=np.bool_))
        self._return[:], self._length[:] = 0.0, 0
        return self.view(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (num_envs, 4); larger ones are clipped."""
        self._actions = np.clip(np.asarray(actions, dtype=np.float64), -1.0, 1.0)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Fly one control period; ended rows start anew at once."""
        self.acted(self._actions)
        observations, rewards, terminated, truncated, info = self.env.step(self._actions)
        self._return += rewards
        self._length += 1
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if not done.any():
            seen = self.view(observations)
        else:
            last = self.view(info["final_obs"])
            self.begin(done)
            seen = np.where(done[:, None], self.view(observations, done), last)
            self.report_ends(infos, done, truncated & ~terminated, last)
            for i in np.flatnonzero(done).tolist():
                infos[i] |= _of_row(info["final_info"], i)
            self._return[done], self._length[done] = 0.0, 0
        return seen, (self._reward_scale * rewards).astype(np.float32), done, infos

    def report_ends(
        self, infos: list[dict[str, Any]], which: np.ndarray, by_time: np.ndarray, last: np.ndarray
    ) -> None:
        """What Stable-Baselines3 wants to know of the flights that have ended, into their `infos`.

        Args:
            infos: one of each env, in place. which: those that have ended, (n,) bool.
            by_time: those that the time limit ended, (n,) bool.
            last: their last observations, (n, n_obs).
        """
        for i in np.flatnonzero(which).tolist():
            infos[i] = {
                "terminal_observation": last[i],
                "TimeLimit.truncated": bool(by_time[i]),
                "episode": {
                    "r": float(self._return[i]),
                    "l": int(self._length[i]),
                    "t": time.time() - self._begun,
                },
            }

    def get_images(self) -> list[np.ndarray | None]:
        """One picture per env."""
        return list(self.env.render() or [])

    def close(self) -> None:
        """Close the envs."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the batch, once for each env asked for."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the batch: it holds for all envs.

        Args:
            attr_name: of the batch. value: its new value. indices: not looked at.
        """
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """The envs of the batch have no methods of their own, but for drawing it."""
        if method_name != "render":
            raise InputError(f"the envs of the batch have no method {method_name!r} of their own")
        pictures = self.env.render()
        return [pictures[i] if pictures else None for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No env of the batch is wrapped."""
        return [False] * len(list(self._get_indices(indices)))


def _of_row(info: dict[str, Any], row: int) -> dict[str, Any]:
    """One row's part of a batch's info."""
    return {
        name: _of_row(value, row) if isinstance(value, dict) else value[row]
        for name, value in info.items()
        if not name.startswith("_") and (f"_{name}" not in info or info[f"_{name}"][row])
    }
