"""PPO (Schulman et al. 2017, by Stable-Baselines3) on what the Kalman filter knows.

The policy that comes out is controllers/policy.py's. Torch is imported only to train.
"""

import io
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from coax_env.env import hover
from coax_env.env.actions import Nominal
from coax_env.env.period import DT
from coax_env.errors import InputError, require
from coax_env.files import make_folder, write_bytes
from coax_env.model.vehicle import Vehicle, load_vehicle
from coax_env.workers import each
from controllers.estimator import EstimatorDesign, Tracker, design_estimator
from controllers.policy import (
    Network,
    feature_scales,
    features,
    load_policy,
    n_features,
    save_policy,
)

SETTINGS: dict[str, Any] = {
    "n_envs": 256,
    "n_steps": 32,
    "batch_size": 2048,
    "n_epochs": 5,
    "learning_rate": 1e-2,
    "gamma": 0.97,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.0,
    "log_std_init": -1.0,
    "net_arch": {"pi": [32, 32], "vf": [64]},
    "activation": "tanh",
    "episode_s": 10.0,
    "hold": 4,
    "cost_weight": 0.03,
    "threads": 1,
}
"""Hyperparameters of `train`, kept in the policy's file.

``hold``: an action is held for so many control periods while training (it is flown at 100 Hz):
noise that lasts 40 ms moves the machine, so less of it is needed to learn from. ``cost_weight``: of
`hover.cost`, added to the env's reward as weight * (MOST_COST - cost), which counts the first seconds
of a flight as they are judged. ``threads``: torch's; two only help on a machine with nothing else to
do.
"""

MOST_COST = 20.0
"""Costs above count as this: a start far off may cost as much, and flying on must stay worth it."""


def hover_vec_env(
    vehicle: str | Vehicle,
    design: EstimatorDesign,
    n_envs: int,
    episode_s: float = 10.0,
    reward_scale: float = 1.0,
    hold: int = 1,
    cost_weight: float = 0.0,
    **env_arguments: Any,
) -> Any:
    """A Stable-Baselines3 VecEnv over CoaxVectorEnv, whose observations are the features.

    One step holds the action for `hold` control periods; its reward is the sum of theirs times the
    scale, each with `cost_weight` * (MOST_COST - cost) where the flight goes on.
    Each env gets its own ``terminal_observation`` and ``TimeLimit.truncated`` as it ends.
    """
    from controllers.vec_env import FleetVecEnv  # imports Stable-Baselines3, and with it torch

    class HoverVecEnv(FleetVecEnv):
        """See hover_vec_env."""

        def __init__(self) -> None:
            self.tracker, self.scales = Tracker(design, n_envs), feature_scales(design)
            super().__init__(
                n_envs, round(episode_s / DT), reward_scale,
                Box(-10.0, 10.0, (n_features(design),), np.float32),
                vehicle=vehicle, nominal=(design.action_trim, design.action_scale),
                sensors=design.sensors, **env_arguments,
            )  # fmt: skip

        def begin(self, which: np.ndarray) -> None:
            self.tracker.reset(which)

        def view(self, observations: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
            return features(self.tracker.see(observations, which), self.scales)

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
            actions, total = self._actions, np.zeros(n_envs)
            over = np.zeros(n_envs, dtype=bool)
            infos: list[dict[str, Any]] = [{} for _ in range(n_envs)]
            for _ in range(hold):
                self.tracker.acted(actions)
                observations, rewards, terminated, truncated, info = self.env.step(actions)
                done = terminated | truncated
                ended = info["final_info"]["state"] if done.any() else info["state"]
                saved = MOST_COST - np.nan_to_num(hover.cost(ended, actions), nan=MOST_COST)
                bonus = np.where(terminated, 0.0, cost_weight * np.maximum(saved, 0.0))
                total += np.where(over, 0.0, rewards + bonus)
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
            rewards = (reward_scale * total).astype(np.float32)
            return features(known, self.scales), rewards, over, infos

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
    command_line: str = "",
    settings: Mapping[str, Any] | None = None,
    **env_arguments: Any,
) -> Path:
    """Train a policy; OUT/policy.zip is there from the first checkpoint on, and after Ctrl-C.

    Args:
        steps: control periods, all envs together.
        resume: a policy.zip to go on from. Its training members are pickles, which can run
            anything: only from those you trust.
        progress: called after every rollout with the steps so far and the mean episode's figures.
        tensorboard: folder for TensorBoard's logs; its package is the extra ``tensorboard``.
        command_line: what made the policy, for its description.
        settings: where not SETTINGS.
        env_arguments: further ones of CoaxVectorEnv, such as ``randomize="posterior"``.

    Returns:
        the path of policy.zip.
    """
    callbacks = require("stable_baselines3.common.callbacks", "rl")
    torch = require("torch", "rl")
    if tensorboard:
        require("tensorboard", "tensorboard")
    if steps < 1:
        raise InputError(f"steps must be at least 1, found {steps}")
    path = make_folder(out) / "policy.zip"
    vehicle = load_vehicle(vehicle)
    old = load_policy(resume) if resume else None
    design = old.estimator if old else design_estimator(vehicle, nominal, sensors)
    chosen = {**SETTINGS, **(settings or {})}
    if chosen.keys() > SETTINGS.keys():
        raise InputError(f"no setting {', '.join(chosen.keys() - SETTINGS.keys())} of PPO")
    content = {
        "vehicle": vehicle.name,
        "command": command_line,
        "seed": seed,
        "steps": steps,
        "settings": chosen,
        "cost": {"weights": hover.COST_WEIGHTS, "limits": hover.LIMITS},
        "reward": {"weights": hover.REWARD_WEIGHTS, "scales": hover.REWARD_SCALES},
    }
    env = hover_vec_env(
        vehicle, design, chosen["n_envs"], chosen["episode_s"],
        reward_scale=(1.0 - chosen["gamma"]) / chosen["hold"], hold=chosen["hold"],
        cost_weight=chosen["cost_weight"], **env_arguments,
    )  # fmt: skip
    env.seed(seed)
    torch.set_num_threads(chosen["threads"])
    model = (
        _old_model(resume, env, tensorboard)
        if resume
        else _new_model(env, chosen, seed, tensorboard)
    )

    def save() -> None:
        save_policy(path, network(model), design, feature_scales(design), content, _file_of(model))

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
                progress(self.num_timesteps * chosen["hold"], mean)
            if chosen["hold"] * (self.num_timesteps - self.saved) >= checkpoint_steps:
                self.saved = self.num_timesteps
                save()

    try:
        model.learn(max(steps // chosen["hold"], 1), callback=Watch(), progress_bar=False)
    finally:
        save()
        env.close()
    return path


def train_seeds(
    vehicle: str | Vehicle,
    out: str | Path,
    seeds: Sequence[int],
    jobs: int = 1,
    backend: str = "loky",
    **training: Any,
) -> Iterator[tuple[int, Path]]:
    """`train` once for each seed, several at a time; a seed gives the policy it would give alone.

    Every policy is trained in a temporary folder and comes back as bytes, so that the machines of a
    cluster need no disk in common; one that is interrupted is lost.

    Args:
        jobs, backend: as in `coax_env.workers.each`.
        training: further arguments of `train`, but for ``progress``.

    Returns:
        each seed with its OUT/seed_N/policy.zip, as they are done.
    """
    training["vehicle"] = load_vehicle(vehicle)
    if isinstance(training.get("nominal"), str | Path):
        training["nominal"] = load_vehicle(training["nominal"])
    for name in ("resume", "tensorboard"):  # a worker may stand in another folder
        if training.get(name):
            training[name] = Path(training[name]).resolve()
    for seed, content in each(partial(_trained, training), list(seeds), jobs, backend):
        yield seed, write_bytes(Path(out) / f"seed_{seed}" / "policy.zip", content)


def _trained(training: Mapping[str, Any], seed: int) -> bytes:
    """The policy.zip of a seed."""
    with tempfile.TemporaryDirectory(prefix="coax-ppo-") as folder:
        return train(out=folder, seed=seed, **training).read_bytes()


def _new_model(env: Any, settings: dict[str, Any], seed: int, tensorboard: Any) -> Any:
    ppo = require("stable_baselines3", "rl")
    nn = require("torch.nn", "rl")
    rate = settings["learning_rate"]
    names = ("n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "clip_range", "ent_coef")
    return ppo.PPO(
        "MlpPolicy", env, seed=seed, device="cpu", verbose=0,
        learning_rate=lambda left: rate * max(left, 0.05),
        tensorboard_log=str(tensorboard) if tensorboard else None,
        policy_kwargs={
            "net_arch": settings["net_arch"], "log_std_init": settings["log_std_init"],
            "activation_fn": {"tanh": nn.Tanh, "relu": nn.ReLU}[settings["activation"]],
        },
        **{name: settings[name] for name in names},
    )  # fmt: skip


def _old_model(path: str | Path, env: Any, tensorboard: Any) -> Any:
    ppo = require("stable_baselines3", "rl")
    with zipfile.ZipFile(path) as archive:
        if "policy.pth" not in archive.namelist():
            raise InputError(f"{path}: cannot be trained on: it holds the plain arrays only")
    folder = str(tensorboard) if tensorboard else None
    return ppo.PPO.load(path, env, device="cpu", tensorboard_log=folder)


def _file_of(model: Any) -> bytes:
    """The model as Stable-Baselines3 writes it."""
    buffer = io.BytesIO()
    model.save(buffer)
    return buffer.getvalue()


def network(model: Any) -> Network:
    """The mean of a Stable-Baselines3 policy as plain arrays."""
    nn = require("torch.nn", "rl")
    modules = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    layers = [
        (m.weight.detach().numpy().copy(), m.bias.detach().numpy().copy())
        for m in modules
        if isinstance(m, nn.Linear)
    ]
    tanh = any(isinstance(m, nn.Tanh) for m in modules)
    return Network(layers, "tanh" if tanh else "relu")
