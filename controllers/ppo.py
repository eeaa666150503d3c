"""PPO (Schulman et al. 2017, by Stable-Baselines3) on what the Kalman filter knows.

Single noisy observations do not show the velocity, so the policy gets the estimate and the
integrals of controllers/estimator.py, scaled, and its previous action. Torch is imported only when
a policy is trained or loaded.
"""

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from coax_env import hover
from coax_env.env import CoaxVectorEnv
from coax_env.errors import InputError, require
from coax_env.files import make_folder
from coax_env.fleet import DT, Nominal
from coax_env.vehicle import Vehicle, load_vehicle
from controllers.estimator import EstimatorDesign, Tracker, design_estimator, integrated_readings

FORMAT = "coax-policy"
VERSION = 1
_MEMBER = "coax.json"  # inside policy.zip, beside what Stable-Baselines3 keeps there

SETTINGS: dict[str, Any] = {
    "n_envs": 256,
    "n_steps": 64,
    "batch_size": 1024,
    "n_epochs": 5,
    "learning_rate": 1.5e-3,
    "gamma": 0.99,
    "gae_lambda": 0.98,
    "clip_range": 0.2,
    "ent_coef": 0.0,
    "log_std_init": -1.0,
    "net_arch": [64, 64],
    "episode_s": 10.0,
}
"""Hyperparameters of `train`, kept in the policy's file."""

FEATURE_SCALES = {
    "u": 0.5, "v": 0.5, "w": 0.5, "p": 0.3, "q": 0.3, "r": 0.3,
    "alpha_l": 0.05, "beta_l": 0.05, "alpha_f": 0.05, "beta_f": 0.05,
    "phi": 0.1, "theta": 0.1, "psi": 0.3, "x": 1.0, "y": 1.0, "z": 0.2,
    "swash_lon": 0.1, "swash_lat": 0.1,
}  # fmt: skip
"""Size of an estimate that becomes 1 for the policy; the rest by the filter's own figures."""


class Policy:
    """A trained policy with its estimator: a controller like any other."""

    kind = "ppo"

    def __init__(self, model: Any, design: EstimatorDesign, content: dict[str, Any]) -> None:
        self.model = model
        self.estimator = design
        self.content = content
        self._eyes = _Eyes(design, 1)

    @property
    def sensors(self) -> str:
        """The suite it must be given."""
        return self.estimator.sensors

    @property
    def nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """Trim and scale of its actions, for ``nominal=`` of the env."""
        return self.estimator.action_trim, self.estimator.action_scale

    def reset(self, count: int = 1) -> None:
        """Forget the last flight; `count` helicopters are flown next."""
        self._eyes = _Eyes(self.estimator, count)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Observation (n_obs,) or (count, n_obs) to action (4,) or (count, 4), float32."""
        batch = np.atleast_2d(observation)
        if self._eyes.count != len(batch):
            self.reset(len(batch))
        features = self._eyes.see(batch)
        actions = np.clip(self.model.predict(features, deterministic=True)[0], -1.0, 1.0)
        self._eyes.acted(actions)
        return actions if np.ndim(observation) == 2 else actions[0]


class _Eyes:
    """Observations to the policy's features, for one helicopter or many."""

    def __init__(self, design: EstimatorDesign, count: int) -> None:
        self.count = count
        self.tracker = Tracker(design, count)
        self._scale = feature_scales(design)
        self._last = np.zeros((count, 4))

    def reset(self, which: np.ndarray) -> None:
        self.tracker.reset(which)
        self._last[which] = 0.0

    def see(self, observations: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
        """Features (count, n), float32, within [-10, 10]."""
        known = self.tracker.see(observations, which) / self._scale
        return np.clip(np.hstack([known, self._last]), -10.0, 10.0).astype(np.float32)

    def acted(self, actions: np.ndarray) -> None:
        self.tracker.acted(actions)
        self._last = actions.astype(float)


def feature_scales(design: EstimatorDesign) -> np.ndarray:
    """What becomes 1 in each feature but the last four, shape (n + i,)."""
    sizes = []
    for name, spread in zip(design.states, design.spread, strict=True):
        if name.startswith("omega_"):
            sizes.append(float(design.action_scale[0 if name == "omega_u" else 1]))
        else:
            sizes.append(FEATURE_SCALES.get(name, max(3.0 * float(spread), 1e-6)))
    return np.array(sizes + list(integrated_readings(design).values()))


def hover_vec_env(
    vehicle: str | Vehicle,
    design: EstimatorDesign,
    n_envs: int,
    episode_s: float = 10.0,
    reward_scale: float = 1.0,
    **env_arguments: Any,
) -> Any:
    """A Stable-Baselines3 VecEnv over CoaxVectorEnv, whose observations are the features.

    Each env gets its own ``terminal_observation`` and ``TimeLimit.truncated`` as it ends.
    """
    base = require("stable_baselines3.common.vec_env", "rl")

    class HoverVecEnv(base.VecEnv):  # type: ignore[name-defined]
        """See hover_vec_env."""

        def __init__(self) -> None:
            self.env = CoaxVectorEnv(
                n_envs, vehicle, (design.action_trim, design.action_scale), design.sensors,
                max_episode_steps=round(episode_s / DT),
                autoreset_mode=AutoresetMode.SAME_STEP, **env_arguments,
            )  # fmt: skip
            self.eyes = _Eyes(design, n_envs)
            self.episode_return, self.episode_length = np.zeros(n_envs), np.zeros(n_envs)
            width = len(feature_scales(design)) + 4
            super().__init__(
                n_envs, Box(-10.0, 10.0, (width,), np.float32), self.env.single_action_space
            )

        def reset(self) -> np.ndarray:
            seed = self._seeds[0]
            observations, _ = self.env.reset(seed=seed)
            self._reset_seeds()
            self._reset_options()
            self.eyes.reset(np.ones(n_envs, dtype=bool))
            self.episode_return[:] = self.episode_length[:] = 0.0
            return self.eyes.see(observations)

        def step_async(self, actions: np.ndarray) -> None:
            self._actions = np.clip(actions, -1.0, 1.0)

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
            self.eyes.acted(self._actions)
            observations, rewards, terminated, truncated, info = self.env.step(self._actions)
            self.episode_return += rewards
            self.episode_length += 1
            done = terminated | truncated
            infos: list[dict[str, Any]] = [{} for _ in range(n_envs)]
            if not done.any():
                features = self.eyes.see(observations)
            else:
                last = self.eyes.see(info["final_obs"])
                self.eyes.reset(done)
                fresh = self.eyes.see(observations, done)
                features = np.where(done[:, None], fresh, last)
                for i in np.flatnonzero(done):
                    infos[i] = {
                        "terminal_observation": last[i],
                        "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                        "episode": {
                            "r": float(self.episode_return[i]),
                            "l": int(self.episode_length[i]),
                            "t": 0.0,
                        },
                    }
                self.episode_return[done] = self.episode_length[done] = 0.0
            return features, (reward_scale * rewards).astype(np.float32), done, infos

        def close(self) -> None:
            self.env.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            setattr(self.env, attr_name, value)

        def env_method(
            self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
        ) -> list[Any]:
            raise NotImplementedError("the envs of the batch have no methods of their own")

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * len(list(self._get_indices(indices)))

    return HoverVecEnv()


def train(
    vehicle: str | Vehicle,
    out: str | Path,
    steps: int = 3_000_000,
    seed: int = 0,
    nominal: Nominal = None,
    sensors: str = "onboard",
    resume: str | Path | None = None,
    progress: Callable[[int, dict[str, float]], None] | None = None,
    tensorboard: str | Path | None = None,
    checkpoint_steps: int = 500_000,
    **env_arguments: Any,
) -> Path:
    """Train a policy; OUT/policy.zip is there from the first checkpoint on, and after Ctrl-C.

    Args:
        steps: env steps, all envs together.
        resume: a policy.zip to go on from.
        progress: called after every rollout with the steps so far and the mean episode's figures.
        env_arguments: further ones of CoaxVectorEnv, such as ``randomize="posterior"``.

    Returns:
        the path of policy.zip.
    """
    ppo = require("stable_baselines3", "rl")
    callbacks = require("stable_baselines3.common.callbacks", "rl")
    if steps < 1:
        raise InputError(f"steps must be at least 1, found {steps}")
    path = make_folder(out) / "policy.zip"
    vehicle = load_vehicle(vehicle)
    old = load_policy(resume) if resume else None
    design = old.estimator if old else design_estimator(vehicle, nominal, sensors)
    settings = dict(SETTINGS)
    content = {
        "format": FORMAT,
        "version": VERSION,
        "kind": Policy.kind,
        "vehicle": vehicle.name,
        "seed": seed,
        "steps": steps,
        "settings": settings,
        "cost": {"weights": hover.COST_WEIGHTS, "limits": hover.LIMITS},
        "reward": {"weights": hover.REWARD_WEIGHTS, "scales": hover.REWARD_SCALES},
        "estimator": design.to_dict(),
    }
    env = hover_vec_env(
        vehicle, design, settings["n_envs"], settings["episode_s"],
        reward_scale=1.0 - settings["gamma"], **env_arguments,
    )  # fmt: skip
    env.seed(seed)
    if old:
        model = old.model
        model.set_env(env)
    else:
        rate = settings["learning_rate"]
        model = ppo.PPO(
            "MlpPolicy", env, seed=seed, device="cpu", verbose=0,
            learning_rate=lambda left: rate * max(left, 0.05),
            tensorboard_log=str(tensorboard) if tensorboard else None,
            policy_kwargs={
                "net_arch": settings["net_arch"], "log_std_init": settings["log_std_init"],
            },
            **{
                k: settings[k]
                for k in (
                    "n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "clip_range",
                    "ent_coef",
                )
            },
        )  # fmt: skip

    class Watch(callbacks.BaseCallback):  # type: ignore[name-defined]
        """Reports and saves after rollouts."""

        saved = 0

        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            if progress:
                episodes = list(self.model.ep_info_buffer or [])
                mean = {
                    "return": float(np.mean([e["r"] for e in episodes])) if episodes else 0.0,
                    "seconds": DT * float(np.mean([e["l"] for e in episodes])) if episodes else 0.0,
                }
                progress(self.num_timesteps, mean)
            if self.num_timesteps - self.saved >= checkpoint_steps:
                self.saved = self.num_timesteps
                save_policy(self.model, content, path)

    try:
        model.learn(steps, callback=Watch(), progress_bar=False)
    finally:
        save_policy(model, content, path)
        env.close()
    return path


def save_policy(model: Any, content: dict[str, Any], path: str | Path) -> Path:
    """Write policy.zip whole or not at all: the model, and the estimator it looks through."""
    path = Path(path)
    buffer = io.BytesIO()
    model.save(buffer)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr(_MEMBER, json.dumps(content, allow_nan=False))
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(buffer.getvalue())
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)
    return path


def load_policy(path: str | Path) -> Policy:
    """Read a policy.zip of `train`."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no policy {str(path)!r}")
    try:
        with zipfile.ZipFile(path) as archive:
            content = json.loads(archive.read(_MEMBER))
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a policy of this project") from error
    if content.get("format") != FORMAT or content.get("version") != VERSION:
        raise InputError(f"{path}: version {content.get('version')!r} of a policy is unknown")
    ppo = require("stable_baselines3", "rl")
    model = ppo.PPO.load(path, device="cpu")
    return Policy(model, EstimatorDesign.from_dict(content["estimator"]), content)
