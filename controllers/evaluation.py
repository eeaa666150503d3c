"""How well a controller hovers: the figures of score.json, from true states."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from coax_env import hover
from coax_env.env import CoaxVectorEnv
from coax_env.errors import InputError
from coax_env.vehicle import Vehicle, load_vehicle
from controllers.loading import Controller

SETTLED = 3.0  # [s] from here on the success conditions count
HIGHEST_HEIGHT_RMS = 0.10  # [m]
HIGHEST_SPEED_RMS = 0.25  # [m/s]
HIGHEST_HEADING_RMS = 10.0  # [deg]
FARTHEST_DRIFT = 2.0  # [m]


def evaluate(
    controller: Controller,
    vehicle: str | Vehicle,
    episodes: int = 100,
    seconds: float = 20.0,
    seed: int = 0,
    sensors: str | None = None,
    progress: Callable[[int], None] | None = None,
    **env_arguments: Any,
) -> dict[str, Any]:
    """Fly ``episodes`` flights at once, seeds seed, seed + 1, ..., and judge them.

    Success, from true states after the first 3 s: flown to the end, height rms < 0.10 m, speed rms
    < 0.25 m/s, heading rms < 10 deg, drift < 2 m; drift is the largest horizontal distance from
    the place at 3 s. The rms figures are pooled over what was flown after 3 s. ``mean_cost`` is the
    mean of `hover.cost` over every step; steps not flown cost hover.CRASHED_COST. ``effort`` is the
    rms of the action vector.

    Args:
        sensors: default the controller's own suite, which it must be.
        progress: called with the number of steps flown.
        env_arguments: further ones of CoaxVectorEnv, such as ``wind``.

    Returns:
        score.json; a figure without a flight to take it from is None.
    """
    if episodes < 1 or not seconds > SETTLED:
        raise InputError(f"need at least one episode of more than {SETTLED} s")
    if sensors not in (None, controller.sensors):
        raise InputError(f"this controller needs sensors {controller.sensors!r}, not {sensors!r}")
    vehicle = load_vehicle(vehicle)
    env = CoaxVectorEnv(
        episodes, vehicle, controller.nominal, controller.sensors,
        autoreset_mode=AutoresetMode.DISABLED, **env_arguments,
    )  # fmt: skip
    steps, settled = round(seconds / hover.CONTROL_PERIOD), round(SETTLED / hover.CONTROL_PERIOD)
    tally = _Tally(episodes)
    observations, _ = env.reset(seed=seed)
    controller.reset(episodes)
    alive = np.ones(episodes, dtype=bool)
    for step in range(steps):
        actions = np.nan_to_num(controller.act(observations))
        observations, rewards, terminated, _, info = env.step(actions)
        tally.add(alive, info["state"], np.clip(actions, -1.0, 1.0), rewards, step + 1 >= settled)
        alive &= ~terminated
        if progress:
            progress(1)
    return tally.score(controller.kind, vehicle.name, alive, steps) | {
        "survival_rate": float(alive.mean()),
        "seconds": seconds,
        "seed": seed,
        "sensors": controller.sensors,
        "cost": {
            "weights": hover.COST_WEIGHTS,
            "limits": hover.LIMITS,
            "step_not_flown": hover.CRASHED_COST,
        },
    }


class _Tally:
    """Sums over every flight, kept while they are flown."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.cost, self.reward, self.effort = np.zeros(count), np.zeros(count), np.zeros(count)
        self.flown, self.judged = np.zeros(count), np.zeros(count)
        self.height, self.speed, self.heading = np.zeros(count), np.zeros(count), np.zeros(count)
        self.drift = np.zeros(count)
        self.place: np.ndarray | None = None

    def add(
        self,
        alive: np.ndarray,
        states: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        settled: bool,
    ) -> None:
        finite = alive & np.isfinite(states).all(axis=1)
        states = np.where(finite[:, None], states, 0.0)
        self.cost += np.where(finite, hover.cost(states, actions), 0.0)
        self.cost += np.where(finite, 0.0, hover.CRASHED_COST)
        self.reward += np.where(finite, rewards, 0.0)
        self.effort += np.where(finite, (actions.astype(float) ** 2).sum(axis=1), 0.0)
        self.flown += finite
        if not settled:
            return
        if self.place is None:
            self.place = states[:, 13:15].copy()
        heading = (states[:, 12] + math.pi) % (2.0 * math.pi) - math.pi
        self.height += np.where(finite, (states[:, 15] + hover.HEIGHT) ** 2, 0.0)
        self.speed += np.where(finite, (states[:, 0:3] ** 2).sum(axis=1), 0.0)
        self.heading += np.where(finite, heading**2, 0.0)
        self.judged += finite
        away = np.linalg.norm(states[:, 13:15] - self.place, axis=1)
        self.drift = np.maximum(self.drift, np.where(finite, away, 0.0))

    def score(self, kind: str, vehicle: str, alive: np.ndarray, steps: int) -> dict[str, Any]:
        judged = np.maximum(self.judged, 1.0)
        height = np.sqrt(self.height / judged)
        speed = np.sqrt(self.speed / judged)
        heading = np.degrees(np.sqrt(self.heading / judged))
        success = (
            alive
            & (height < HIGHEST_HEIGHT_RMS)
            & (speed < HIGHEST_SPEED_RMS)
            & (heading < HIGHEST_HEADING_RMS)
            & (self.drift < FARTHEST_DRIFT)
        )
        but_drift = (
            alive
            & (height < HIGHEST_HEIGHT_RMS)
            & (speed < HIGHEST_SPEED_RMS)
            & (heading < HIGHEST_HEADING_RMS)
        )

        def pooled(squares: np.ndarray) -> float | None:
            total = self.judged.sum()
            return math.sqrt(squares.sum() / total) if total else None

        heading_rms = pooled(self.heading)
        seen = self.judged > 0
        return {
            "controller": kind,
            "vehicle": vehicle,
            "episodes": self.count,
            "success_rate": float(success.mean()),
            "mean_cost": float(self.cost.mean() / steps),
            "mean_return": float(self.reward.mean()),
            "height_rms_m": pooled(self.height),
            "velocity_rms_mps": pooled(self.speed),
            "heading_rms_deg": None if heading_rms is None else math.degrees(heading_rms),
            "drift_m": float(self.drift[seen].mean()) if seen.any() else None,
            "effort": float(math.sqrt(self.effort.sum() / max(self.flown.sum(), 1.0))),
            "success_but_drift_rate": float(but_drift.mean()),
            "worst_height_rms_m": float(height[seen].max()) if seen.any() else None,
        }
