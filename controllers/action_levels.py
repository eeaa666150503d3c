"""What an action may mean instead of the four commands: rates and thrust, or a velocity.

`ActionLevel` wraps a CoaxHeli-v0, `VectorActionLevel` a batch of them; an inner loop turns the action
into commands from the readings of the last observation, at the env's 100 Hz::

    env = ActionLevel(gymnasium.make("CoaxHeli-v0"), "velocity")

The inner loops are simple: proportional and integral on the gyros, and the cascade of pid.py.
"""

from collections.abc import Callable
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from coax_env.env import hover
from coax_env.env.period import DT
from coax_env.errors import InputError
from coax_env.kernel.angles import wrap_angles
from coax_env.model.sensors import suite
from controllers import pid
from controllers.target import turned

_DEGREE = np.pi / 180.0
_ONBOARD = tuple(sensor.name for sensor in suite("onboard"))


class Level(Protocol):
    """An inner loop over a batch; `reset` begins new flights in the rows of a mask (count,)."""

    entries: tuple[tuple[str, str], ...]  # what an action's four numbers are, and what 1 means

    def reset(self, which: np.ndarray) -> None:
        """New flights in the rows of a mask."""

    def commands(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Actions of the env (count, 4) for those of the level, both within [-1, 1]."""


class RatesAndThrust:
    """Collective thrust and body rates: what an acrobatic pilot's sticks ask for.

    The stabiliser bar resists: a roll or pitch rate is kept for about half a second, then the swash
    plate is at its end until the bar has followed.

    Args:
        names: of the observation's entries. count: helicopters.
    """

    entries: tuple[tuple[str, str], ...] = (
        ("thrust", "both rotors 15 % faster than the nominal trim"),
        ("roll_rate", "40 deg/s"), ("pitch_rate", "40 deg/s"), ("yaw_rate", "90 deg/s"),
    )  # fmt: skip
    REACH = np.array([40.0, 40.0, 90.0]) * _DEGREE
    GAIN = np.array([2.0, 2.0, 1.0])  # [action per rad/s] of roll, pitch, yaw; tuned on lama400d
    SUM = np.array([20.0, 20.0, 2.0])  # [action per rad]
    MOST = 1.0  # [action] of the sums

    def __init__(self, vehicle: Any, names: tuple[str, ...], count: int) -> None:
        self._at = _places(names, ("p", "q", "r"), "rates")
        self._sums = np.zeros((count, 3))

    def reset(self, which: np.ndarray) -> None:
        """New flights in the rows of a mask."""
        self._sums[which] = 0.0

    def commands(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Actions of the env (count, 4) for those of the level, both within [-1, 1]."""
        error = self.REACH * actions[:, 1:] - observations[:, self._at]
        self._sums += DT * self.SUM * error
        np.clip(self._sums, -self.MOST, self.MOST, out=self._sums)
        lat, lon, turn = (self.GAIN * error + self._sums).T
        return np.column_stack([actions[:, 0] + turn, actions[:, 0] - turn, lon, lat])


class Velocity:
    """Speeds forward, right and up, and a turn rate, flown by the cascade of pid.py.

    Height and heading are held where the asked speeds have brought them.

    Args:
        vehicle: whose trim the cascade is about. names: of the observation's entries.
        count: helicopters.
    """

    entries: tuple[tuple[str, str], ...] = (
        ("forward", "1 m/s"), ("right", "1 m/s"), ("up", "0.5 m/s"), ("turn_rate", "60 deg/s"),
    )  # fmt: skip
    REACH = np.array([1.0, 1.0, 0.5, 60.0 * _DEGREE])
    LEAD = 0.3  # [m, rad] that what is asked may run ahead of what is measured

    def __init__(self, vehicle: Any, names: tuple[str, ...], count: int) -> None:
        self._at = _places(names, ("vn", "ve", "vd", "psi", "h"), "velocity")
        self._cascade = pid.design(vehicle)
        self._cascade.reset(count)
        self._names = _places(names, _ONBOARD, "velocity")
        self._aim = np.zeros((count, 2))  # height, heading

    def reset(self, which: np.ndarray) -> None:
        """New flights in the rows of a mask."""
        self._aim[which] = hover.HEIGHT, 0.0
        self._cascade.forget(which)

    def commands(self, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Actions of the env (count, 4) for those of the level, both within [-1, 1]."""
        north, east, down, psi, height = self._at
        asked = self.REACH * actions
        self._aim += DT * asked[:, 2:]
        ahead = np.column_stack(
            [
                self._aim[:, 0] - observations[:, height],
                wrap_angles(self._aim[:, 1] - observations[:, psi]),
            ]
        )
        self._aim -= ahead - np.clip(ahead, -self.LEAD, self.LEAD)
        seen = observations.astype(float)
        level = turned(seen[:, [north, east]], -self._aim[:, 1])
        seen[:, [north, east]] = level - turned(asked[:, :2], seen[:, psi] - self._aim[:, 1])
        seen[:, down] += asked[:, 2]
        seen[:, height] += hover.HEIGHT - self._aim[:, 0]
        seen[:, psi] = wrap_angles(seen[:, psi] - self._aim[:, 1])
        return self._cascade.compute_actions(seen[:, self._names])


LEVELS: dict[str, Callable[..., Level]] = {"rates": RatesAndThrust, "velocity": Velocity}
"""The levels by name."""


class ActionLevel(gymnasium.Wrapper):
    """One CoaxHeli-v0 whose action is of a level.

    Args:
        env: ``gymnasium.make("CoaxHeli-v0")``.
        level: a key of LEVELS.
    """

    def __init__(self, env: Any, level: str) -> None:
        super().__init__(env)
        self.level = _level(level, env.unwrapped, 1)
        self.action_space = Box(-1.0, 1.0, (4,), np.float32)

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """As the env's."""
        self._observation, info = self.env.reset(**arguments)
        self.level.reset(np.ones(1, dtype=bool))
        return self._observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """As the env's; ``info["commands"]`` is the action that the env was given."""
        asked = np.clip(np.asarray(action, dtype=float), -1.0, 1.0)[None]
        given = np.clip(self.level.commands(self._observation[None], asked)[0], -1.0, 1.0)
        self._observation, reward, terminated, truncated, info = self.env.step(given)
        return self._observation, reward, terminated, truncated, info | {"commands": given}


class VectorActionLevel(VectorWrapper):
    """A batch of CoaxHeli-v0 whose actions are of a level.

    Args:
        env: ``gymnasium.make_vec("CoaxHeli-v0", vectorization_mode="vector_entry_point")``.
        level: a key of LEVELS.
    """

    def __init__(self, env: VectorEnv, level: str) -> None:
        super().__init__(env)
        self.level = _level(level, env.unwrapped, env.num_envs)
        self._ended = np.zeros(env.num_envs, dtype=bool)

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """As the env's."""
        self._observations, info = self.env.reset(**arguments)
        every = np.ones(self.env.num_envs, dtype=bool)
        which = (arguments.get("options") or {}).get("reset_mask", every)
        self.level.reset(which)
        self._ended &= ~which
        return self._observations, info

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, Any, Any, Any, dict[str, Any]]:
        """As the env's; a row that starts anew begins its inner loop anew."""
        asked = np.clip(np.asarray(actions, dtype=float), -1.0, 1.0)
        given = np.clip(self.level.commands(self._observations, asked), -1.0, 1.0)
        self._observations, reward, terminated, truncated, info = self.env.step(given)
        done = np.asarray(terminated | truncated)
        mode = self.env.metadata["autoreset_mode"]
        started = {AutoresetMode.NEXT_STEP: self._ended, AutoresetMode.SAME_STEP: done}
        self.level.reset(started.get(mode, np.zeros_like(done)))
        self._ended = done
        return self._observations, reward, terminated, truncated, info


def _level(name: str, env: Any, count: int) -> Level:
    if name not in LEVELS:
        raise InputError(f"no action level {name!r}: choose one of {', '.join(LEVELS)}")
    if env.fleet.periods != 1:
        raise InputError("action levels have inner loops at 100 Hz: leave control_rate at 100")
    return LEVELS[name](env.fleet.vehicle, env.observation_names, count)


def _places(names: tuple[str, ...], wanted: tuple[str, ...], level: str) -> list[int]:
    missing = [name for name in wanted if name not in names]
    if missing:
        raise InputError(f"action level {level!r} needs readings of {', '.join(missing)}")
    return [names.index(name) for name in wanted]
