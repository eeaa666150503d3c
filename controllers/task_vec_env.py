"""The batches of helicopters on which PPO trains: the filter's estimate in, held actions out.

`TaskVecEnv` is a batch of one task on one sensor suite; `SeveralVecEnvs` puts such batches beside each
other, so that one network learns all of them.

Importing this module imports Stable-Baselines3, and with it torch.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from coax_env.env import hover
from coax_env.env.period import DT
from coax_env.errors import require
from coax_env.model.vehicle import Vehicle
from controllers.estimator import Tracker
from controllers.estimator_design import EstimatorDesign
from controllers.policy import feature_sizes, features, linear_actions, seen
from controllers.target import TargetView
from controllers.vec_env import FleetVecEnv

MOST_COST = 20.0
"""Costs above count as this: a distant start may cost as much, and flying on must still pay."""

_base = require("stable_baselines3.common.vec_env", "rl")


class TaskVecEnv(FleetVecEnv):
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
        cost_weight: of `hover.cost` about the target in the reward.
        cost_limits: errors that count 1 in that cost, where not hover.LIMITS.
        sizes: of the network's features by name; None: those of `design`.
        base_gain: a linear feedback (4, n + i) that actions are added to; None: none.
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
        cost_limits: Mapping[str, float] | None = None,
        sizes: Mapping[str, float] | None = None,
        base_gain: np.ndarray | None = None,
        **env_arguments: Any,
    ) -> None:
        self.tracker, self.target = Tracker(design, n_envs), TargetView(design.sensors)
        own = list(feature_sizes(design))
        sizes = feature_sizes(design) if sizes is None else sizes
        self._scales = np.array([sizes[name] for name in own])
        self._places = np.array([list(sizes).index(name) for name in own])
        self._width = len(sizes)
        self._base_gain = base_gain
        self._known = np.zeros((n_envs, len(own)))
        self.hold, self.cost_weight, self.cost_limits = hold, cost_weight, cost_limits
        super().__init__(
            n_envs, round(episode_s / DT), reward_scale,
            Box(-10.0, 10.0, (self._width,), np.float32),
            vehicle=vehicle, nominal=(design.action_trim, design.action_scale),
            sensors=design.sensors, **env_arguments,
        )  # fmt: skip

    def begin(self, which: np.ndarray) -> None:
        """The rows of a mask (n_envs,) have started new flights."""
        self.tracker.reset(which)

    def view(self, observations: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
        """Observations (n_envs, n) as features; those that this suite does not have are zero."""
        self._known = seen(self.tracker, self.target, observations, which)
        return self._features(self._known)

    def _features(self, known: np.ndarray) -> np.ndarray:
        found = np.zeros((len(known), self._width), dtype=np.float32)
        found[:, self._places] = features(known, self._scales)
        return found

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Features, rewards, whether the flight ended, and infos, after `hold` control periods."""
        asked, total = self._actions, np.zeros(self.num_envs)
        over = np.zeros(self.num_envs, dtype=bool)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for _ in range(self.hold):
            actions = np.clip(asked + self._base(), -1.0, 1.0)
            self.tracker.acted(actions)
            targets, rates = self.env.fleet.targets.copy(), self._target_rates()
            observations, rewards, terminated, truncated, info = self.env.step(actions)
            done = terminated | truncated
            states = info["final_info"]["state"] if done.any() else info["state"]
            total += np.where(
                over, 0.0, rewards + self._bonus(states, actions, targets, rates, terminated)
            )
            self._return += np.where(over, 0.0, rewards)
            self._length += ~over
            if not done.any():
                self._known = seen(self.tracker, self.target, observations)
                continue
            last = self.view(info["final_obs"])
            self.begin(done)
            self._known = seen(self.tracker, self.target, observations, done)
            self.report_ends(infos, done & ~over, truncated & ~terminated, last)
            over |= done
            asked = np.where(over[:, None], 0.0, asked)  # until the next decision
        self._return[over], self._length[over] = 0.0, 0
        rewards = (self._reward_scale * total).astype(np.float32)
        return self._features(self._known), rewards, over, infos

    def _base(self) -> np.ndarray | float:
        """The linear feedback's actions (n_envs, 4); 0 without one."""
        if self._base_gain is None:
            return 0.0
        return linear_actions(self.tracker, self._base_gain, self._known)

    def _target_rates(self) -> np.ndarray | None:
        """Of the targets' x y z psi (n_envs, 4), where they move."""
        return self.env.fleet.target_rates if self.env.fleet.task.follows_path else None

    def _bonus(
        self, states: np.ndarray, actions: np.ndarray, targets: np.ndarray,
        rates: np.ndarray | None, terminated: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """What one period adds to the env's reward, (n_envs,); 0 where the flight has failed."""
        if not self.cost_weight:
            return np.zeros(self.num_envs)
        cost = hover.cost(states, actions, targets, self.cost_limits, rates)
        cost = np.nan_to_num(cost, nan=MOST_COST)
        return np.where(terminated, 0.0, self.cost_weight * np.maximum(MOST_COST - cost, 0.0))


class SeveralVecEnvs(_base.VecEnv):  # type: ignore[name-defined]
    """Batches beside each other, as one: the rows of the first, then those of the second, and so on.

    Args:
        parts: batches with the same spaces.
    """

    def __init__(self, parts: Sequence[TaskVecEnv]) -> None:
        self.parts = list(parts)
        counts = [part.num_envs for part in self.parts]
        self._edges = np.cumsum(counts)[:-1]
        first = self.parts[0]
        super().__init__(sum(counts), first.observation_space, first.action_space)

    def reset(self) -> np.ndarray:
        """New flights everywhere; returns what the policy gets, (num_envs, n)."""
        seeds = np.split(np.array(self._seeds, dtype=object), self._edges)
        for part, own in zip(self.parts, seeds, strict=True):
            part._seeds = list(own)
        self._reset_seeds()
        self._reset_options()
        found = [part.reset() for part in self.parts]
        self.reset_infos = [info for part in self.parts for info in part.reset_infos]
        return np.concatenate(found)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (num_envs, 4); larger ones are clipped."""
        for part, own in zip(self.parts, np.split(actions, self._edges), strict=True):
            part.step_async(own)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Features, rewards, whether the flight ended, and infos of every row."""
        observations, rewards, over, infos = zip(
            *(part.step_wait() for part in self.parts), strict=True
        )
        return (
            np.concatenate(observations), np.concatenate(rewards), np.concatenate(over),
            [info for own in infos for info in own],
        )  # fmt: skip

    def close(self) -> None:
        """Close the envs."""
        for part in self.parts:
            part.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of each env's batch, once for each env asked for."""
        values = [v for part in self.parts for v in part.get_attr(attr_name)]
        return [values[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of every batch: it holds for all envs.

        Args:
            attr_name: of the batches. value: its new value. indices: not looked at.
        """
        for part in self.parts:
            part.set_attr(attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        """The envs have no methods of their own, but for drawing them."""
        values = [v for part in self.parts for v in part.env_method(method_name, *args, **kwargs)]
        return [values[i] for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No env of the batches is wrapped."""
        return [False] * len(list(self._get_indices(indices)))
