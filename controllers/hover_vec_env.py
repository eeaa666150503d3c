"""The batch of helicopters on which PPO trains: the Kalman filter's estimate in, held actions out.

Importing this module imports Stable-Baselines3, and with it torch.
"""

from typing import Any

import numpy as np
from gymnasium.spaces import Box

from coax_env.env import hover
from coax_env.env.period import DT
from coax_env.model.vehicle import Vehicle
from controllers.estimator import EstimatorDesign, Tracker
from controllers.policy import feature_scales, features, n_features
from controllers.vec_env import FleetVecEnv

MOST_COST = 20.0
"""Costs above count as this: a distant start may cost as much, and flying on must still pay."""


class HoverVecEnv(FleetVecEnv):
    """A Stable-Baselines3 VecEnv over CoaxVectorEnv, whose observations are the features.

    One step holds the action for `hold` control periods; its reward is the sum of theirs times the
    scale, each with `cost_weight` * (MOST_COST - cost) where the flight goes on.
    Each env gets its own ``terminal_observation`` and ``TimeLimit.truncated`` as it ends.

    Args:
        vehicle: what flies.
        design: the estimator; its trim and scale centre the actions.
        n_envs: helicopters.
        episode_s: time limit [s].
        reward_scale: what rewards are multiplied with.
        hold: control periods per step.
        cost_weight: of `hover.cost` in the reward.
        env_arguments: further ones of CoaxVectorEnv.
    """

    def __init__(
        self,
        vehicle: str | Vehicle,
        design: EstimatorDesign,
        n_envs: int,
        episode_s: float = 10.0,
        reward_scale: float = 1.0,
        hold: int = 1,
        cost_weight: float = 0.0,
        **env_arguments: Any,
    ) -> None:
        self.tracker, self.scales = Tracker(design, n_envs), feature_scales(design)
        self.hold, self.cost_weight = hold, cost_weight
        super().__init__(
            n_envs, round(episode_s / DT), reward_scale,
            Box(-10.0, 10.0, (n_features(design),), np.float32),
            vehicle=vehicle, nominal=(design.action_trim, design.action_scale),
            sensors=design.sensors, **env_arguments,
        )  # fmt: skip

    def begin(self, which: np.ndarray) -> None:
        """The rows of a mask (n_envs,) have started new flights."""
        self.tracker.reset(which)

    def view(self, observations: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
        """Observations (n_envs, n) as features."""
        return features(self.tracker.see(observations, which), self.scales)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Features, rewards, whether the flight ended, and infos, after `hold` control periods."""
        actions, total = self._actions, np.zeros(self.num_envs)
        over = np.zeros(self.num_envs, dtype=bool)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for _ in range(self.hold):
            self.tracker.acted(actions)
            observations, rewards, terminated, truncated, info = self.env.step(actions)
            done = terminated | truncated
            states = info["final_info"]["state"] if done.any() else info["state"]
            total += np.where(over, 0.0, rewards + self._bonus(states, actions, terminated))
            self._return += np.where(over, 0.0, rewards)
            self._length += ~over
            if not done.any():
                known = self.tracker.see(observations)
                continue
            last = self.view(info["final_obs"])
            self.begin(done)
            known = self.tracker.see(observations, done)
            self.report_ends(infos, done & ~over, truncated & ~terminated, last)
            over |= done
            actions = np.where(over[:, None], 0.0, actions)  # until the next decision
        self._return[over], self._length[over] = 0.0, 0
        rewards = (self._reward_scale * total).astype(np.float32)
        return features(known, self.scales), rewards, over, infos

    def _bonus(self, states: np.ndarray, actions: np.ndarray, terminated: np.ndarray) -> np.ndarray:
        """What one period adds to the env's reward, (n_envs,); 0 where the flight has failed."""
        cost = np.nan_to_num(hover.cost(states, actions), nan=MOST_COST)
        return np.where(terminated, 0.0, self.cost_weight * np.maximum(MOST_COST - cost, 0.0))
