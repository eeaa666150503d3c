"""PPO (Schulman et al. 2017, by Stable-Baselines3) on the Kalman filter's estimate.

The policy that comes out is controllers/policy.py's. Torch is imported only to train.
"""

import io
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.env import hover, tasks
from coax_env.env.actions import Nominal, action_map
from coax_env.env.period import DT
from coax_env.errors import InputError, require
from coax_env.files import make_folder
from coax_env.model.vehicle import Parameter, Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers import lqr
from controllers.estimator_design import design_estimator
from controllers.policy import (
    Network,
    Policy,
    Sight,
    load_policy,
    save_policy,
)
from controllers.policy_transfer import begin_from, joined_features, transferred
from controllers.target import TargetView

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
    "base": "none",
    "threads": 1,
}
"""Hyperparameters of `train`, kept in the policy's file.

``hold``: an action is held for so many control periods while training (it is flown at 100 Hz):
noise that lasts 40 ms moves the machine, so less of it is needed to learn from. ``cost_weight``: of
`hover.cost`, added to the env's reward, see `TaskVecEnv`, which counts the first seconds of a flight
as the score does. ``threads``: torch's; two only help on an otherwise idle machine.
"""

START_RATE = 0.1
"""Of the learning rate, where training begins from a policy: with the whole rate it loses in two
million periods what it had (cost 0.60 instead of 0.42), with three tenths of it some."""


def train(
    vehicle: str | Vehicle,
    out: str | Path,
    steps: int = 3_000_000,
    seed: int = 0,
    nominal: Nominal = None,
    sensors: str | Sequence[str] = "onboard",
    resume: str | Path | None = None,
    start: str | Path | None = None,
    progress: Callable[[int, dict[str, float]], None] | None = None,
    tensorboard: str | Path | None = None,
    checkpoint_steps: int = 500_000,
    command_line: str = "",
    settings: Mapping[str, Any] | None = None,
    task: str | Sequence[str] = "hover",
    hidden: bool = False,
    **env_arguments: Any,
) -> Path:
    """Train a policy; OUT/policy.zip is there from the first checkpoint on, and after Ctrl-C.

    Args:
        vehicle: what flies: shipped name, path or Vehicle.
        out: folder of policy.zip.
        steps: control periods, all envs together.
        seed: of the network, the flights and the draws.
        nominal: whose trim centres the action, as in the env.
        sensors: the suite that the policy is given, or several: it flies on each.
        resume: a policy.zip to go on from. Its training members are pickles, which can run
            anything: only from those you trust.
        start: a policy.zip whose networks training begins from, on the filter and the trim of
            `vehicle`, see policy_transfer.py, with the policy's settings where `settings` has no
            others, and START_RATE of its learning rate. Nothing in it is run.
        progress: called after every rollout with the steps so far and the mean episode's return
            and duration [s].
        tensorboard: folder for TensorBoard's logs; its package is the extra ``tensorboard``.
        checkpoint_steps: control periods between two checkpoints.
        command_line: what made the policy, for its description.
        settings: where not SETTINGS.
        task: what it learns, or several tasks, each on every suite that shows its targets.
        hidden: half the flights on machines with what UNKNOWN says, which the filter does not know.
        env_arguments: further ones of CoaxVectorEnv, such as ``randomize="posterior"``.

    Returns:
        the path of policy.zip.
    """
    require("stable_baselines3", "rl")
    torch = require("torch", "rl")
    if tensorboard:
        require("tensorboard", "tensorboard")
    if steps < 1:
        raise InputError(f"steps must be at least 1, found {steps}")
    path = make_folder(out) / "policy.zip"
    vehicle = load_vehicle(vehicle)
    if resume and start:
        raise InputError("a policy is gone on with, or started from: resume or start, not both")
    earlier = resume or start
    old = load_policy(earlier) if earlier else None
    suites = [sensors] if isinstance(sensors, str) else list(sensors)
    chosen = _settings({**(_settings_after(old) if old and start else {}), **(settings or {})})
    sights = (
        list(old.suites.sights.values())
        if old and resume
        else [design_sight(vehicle, nominal, name, chosen["base"]) for name in suites]
    )
    description = {
        "vehicle": vehicle.name,
        "command": command_line,
        "seed": seed,
        "steps": steps,
        "settings": chosen,
        "cost": {"weights": hover.COST_WEIGHTS, "limits": hover.LIMITS},
        "reward": {"weights": hover.REWARD_WEIGHTS, "scales": hover.REWARD_SCALES},
    }
    wanted = [task] if isinstance(task, str) else list(task)
    machines = [vehicle, with_unknown(vehicle)] if hidden else [vehicle]
    sizes = joined_features(old, sights)
    env = _training_env(machines, sights, sizes, wanted, chosen, env_arguments)
    env.seed(seed)
    torch.set_num_threads(chosen["threads"])
    model = (
        _old_model(resume, env, tensorboard)
        if resume
        else _new_model(env, chosen, seed, tensorboard)
    )
    if old and start:
        begin_from(model, transferred(old, sights), start)

    def save() -> None:
        save_policy(path, network(model), sights, sizes, description, _file_of(model))

    hold = chosen["hold"]
    callback = _rollout_callback(save, progress, checkpoint_steps, hold)
    try:
        model.learn(max(steps // hold, 1), callback=callback, progress_bar=False)
    finally:
        save()
        env.close()
    return path


BRISKER = {"position": 0.3, "speed": 1.2}
"""Limits [m, m/s] of the feedback under a policy that sees a target, and of its cost in training, which
makes it calmer again: with lqr.BRISK it reaches fewer waypoints than LQG."""

UNKNOWN = {
    "motor_lag.upper": (0.045, 0.015, "s"), "motor_lag.lower": (0.045, 0.015, "s"),
    "servo_lag.time": (0.02, 0.007, "s"), "thrust_scale.scale": (0.0, 0.03, "1"),
    "torque_balance.scale": (0.0, 0.03, "1"), "swash_offset.lon": (0.0, 0.01, "rad"),
    "swash_offset.lat": (0.0, 0.01, "rad"),
}  # fmt: skip
"""Mean, std and unit of effects that a policy may meet unknown: half of their usual sizes; ours."""


def with_unknown(vehicle: Vehicle) -> Vehicle:
    """A vehicle whose spread has the effects of UNKNOWN; those that it has already stay."""
    return vehicle.with_parameters(
        {
            name: Parameter(mean, std, unit, "unknown to the filter, for training")
            for name, (mean, std, unit) in UNKNOWN.items()
            if name.split(".")[0] not in vehicle.effects
        }
    )


def _settings_after(old: Policy) -> dict[str, Any]:
    """Those with which training begins from a policy."""
    kept: dict[str, Any] = {**SETTINGS, **old.content["settings"]}
    return kept | {"learning_rate": START_RATE * kept["learning_rate"]}


def _settings(settings: Mapping[str, Any] | None) -> dict[str, Any]:
    """SETTINGS with those given."""
    chosen = {**SETTINGS, **(settings or {})}
    if chosen.keys() > SETTINGS.keys():
        raise InputError(f"no setting {', '.join(chosen.keys() - SETTINGS.keys())} of PPO")
    return chosen


def design_sight(vehicle: Vehicle, nominal: Nominal, sensors: str, base: str) -> Sight:
    """The filter for a suite and, for the base ``lqg``, LQG's gain: brisk where it sees a target.

    The base reckons with lqr.HEDGE's lags: on a machine without any they cost nothing (0.424 against
    0.423 in still air), on one with more they keep the loop from ringing (0.45 against 1.74).

    Args:
        vehicle: whose filter it is.
        nominal: whose trim centres the action.
        sensors: the suite.
        base: what the network's actions are added to, ``none`` or ``lqg``.
    """
    if base == "none":
        return Sight(design_estimator(vehicle, nominal, sensors))
    brisk = BRISKER if TargetView(sensors).aims else None
    scaling = action_map(vehicle, nominal)
    design = lqr.design(vehicle, scaling, sensors, brisk, hedge=lqr.HEDGE)
    return Sight(design.estimator, design.gain)


def _training_env(
    machines: Sequence[Vehicle],
    sights: Sequence[Sight],
    sizes: Mapping[str, float],
    wanted: Sequence[str],
    settings: Mapping[str, Any],
    env_arguments: Mapping[str, Any],
) -> Any:
    """The helicopters of every task on every suite that shows its targets, as many of each."""
    from controllers.task_vec_env import SeveralVecEnvs, TaskVecEnv  # import torch

    flown = [
        (name, sight, vehicle)
        for name in wanted
        for sight in sights
        for vehicle in machines
        if TargetView(sight.estimator.sensors).aims or not tasks.task(name).shows_target
    ]
    if {name for name, *_ in flown} != set(wanted):
        raise InputError("a task with a target needs sensors that measure position: mocap or state")
    hold, parts = settings["hold"], []
    for name, sight, vehicle in flown:
        own = tasks.task(name)
        unknown = {"randomize": "posterior"} if vehicle is not machines[0] else {}
        part = TaskVecEnv(
            vehicle, sight.estimator, settings["n_envs"] // len(flown), settings["episode_s"],
            reward_scale=(1.0 - settings["gamma"]) / hold, hold=hold,
            cost_weight=0.0 if own.moves_on else settings["cost_weight"],
            cost_limits=BRISKER if own.shows_target else None,
            sizes=sizes, base_gain=sight.base_gain, task=name, **{**env_arguments, **unknown},
        )  # fmt: skip
        parts.append(part)
    return parts[0] if len(parts) == 1 else SeveralVecEnvs(parts)


def _rollout_callback(
    save: Callable[[], None],
    progress: Callable[[int, dict[str, float]], None] | None,
    checkpoint_steps: int,
    hold: int,
) -> Any:
    """A callback of Stable-Baselines3 that reports and saves after rollouts."""
    callbacks = require("stable_baselines3.common.callbacks", "rl")

    class AfterRollout(callbacks.BaseCallback):  # type: ignore[name-defined]
        saved = 0

        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            if progress:
                progress(self.num_timesteps * hold, _mean_episode(self.model))
            if hold * (self.num_timesteps - self.saved) >= checkpoint_steps:
                self.saved = self.num_timesteps
                save()

    return AfterRollout()


def _mean_episode(model: Any) -> dict[str, float]:
    """Mean return and duration [s] of the last episodes; 0 before the first has ended."""
    episodes = list(model.ep_info_buffer or [])
    if not episodes:
        return {"return": 0.0, "seconds": 0.0}
    return {
        "return": float(np.mean([e["r"] for e in episodes])),
        "seconds": DT * float(np.mean([e["l"] for e in episodes])),
    }


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
