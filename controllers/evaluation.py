"""How well a controller flies: the figures of score.json, from true states."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from coax_env.env import hover, tasks
from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.errors import InputError
from coax_env.model.layout import PLACE
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.workers import each
from controllers.loading import Controller
from controllers.own_controller import as_controller


def evaluate(
    controller: Controller | Any,
    vehicle: str | Vehicle,
    episodes: int = 100,
    seconds: float = 20.0,
    seed: int = 0,
    sensors: str | None = None,
    progress: Callable[[int], None] | None = None,
    each_flight: bool = False,
    **env_arguments: Any,
) -> dict[str, Any]:
    """Fly ``episodes`` flights at once, seeds seed, seed + 1, ..., and score them.

    Success is `tasks.judge`'s, from true states: hovering, flown to the end, and after the
    first 3 s height rms < 0.10 m, speed rms < 0.25 m/s, heading rms < 10 deg, drift < 2 m, the
    largest horizontal distance from the position at 3 s (in ``position`` from the target); of
    ``waypoints`` those given must be reached, or the first of those drawn. The rms figures are
    pooled over what was flown after 3 s; in ``trajectory`` the speed is relative to the path's, and
    ``distance_rms_m`` is that to the moving target. ``mean_cost`` is the mean of `hover.cost` about the
    target over every step; steps not flown cost hover.CRASHED_COST. ``effort`` is the rms of the action
    vector.

    Args:
        controller: what flies: a `Controller`, or whatever `own_controller.as_controller` makes one
            of: a function of an observation, a class, a Stable-Baselines3 model, a
            python-control system.
        vehicle: what is flown.
        episodes: flights.
        seconds: duration of a flight.
        seed: of the first flight.
        sensors: default the controller's own suite, which it must be; for one without a suite of
            its own: what it is given (default ``onboard``).
        progress: called with the number of steps flown.
        each_flight: add ``flight_costs``, the mean cost of every flight.
        env_arguments: further ones of CoaxVectorEnv, such as ``wind``.

    Returns:
        score.json; a figure without a flight to take it from is None.
    """
    if episodes < 1 or not seconds > tasks.SETTLED:
        raise InputError(f"need at least one episode of more than {tasks.SETTLED} s")
    vehicle = load_vehicle(vehicle)
    controller = as_controller(controller, vehicle, sensors)
    if sensors not in (None, controller.sensors):
        raise InputError(f"this controller needs sensors {controller.sensors!r}, not {sensors!r}")
    env = CoaxVectorEnv(
        episodes, vehicle, controller.nominal, controller.sensors,
        autoreset_mode=AutoresetMode.DISABLED, **env_arguments,
    )  # fmt: skip
    steps = round(seconds / hover.CONTROL_PERIOD)
    totals = _Totals(episodes, env_arguments.get("task", "hover"), env_arguments.get("target"))
    observations, info = env.reset(seed=seed)
    controller.reset(episodes)
    for step in range(steps):
        actions = np.nan_to_num(controller.act(observations))
        targets, rates = info.get("target", totals.targets), info.get("target_rates")
        observations, rewards, terminated, _, info = env.step(actions)
        settled = step + 1 >= tasks.FIRST_JUDGED
        totals.add(info, targets, np.clip(actions, -1.0, 1.0), rewards, settled, rates)
        totals.alive &= ~terminated
        if progress:
            progress(1)
    totals.add_up()
    own = {"flight_costs": (totals.cost / steps).tolist()} if each_flight else {}
    return (
        totals.score(steps)
        | own
        | {
            "controller": controller.kind,
            "vehicle": vehicle.name,
            "episodes": episodes,
            "seconds": seconds,
            "seed": seed,
            "sensors": controller.sensors,
            "task": totals.task,
            "cost": {
                "weights": hover.COST_WEIGHTS,
                "limits": hover.LIMITS,
                "step_not_flown": hover.CRASHED_COST,
            },
        }
    )


def evaluate_spread(
    controller: Controller,
    vehicle: str | Vehicle,
    vehicles: int = 50,
    episodes: int = 20,
    seconds: float = 20.0,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
    jobs: int = 1,
    backend: str = "loky",
    **env_arguments: Any,
) -> dict[str, Any]:
    """`evaluate` on vehicles drawn from a vehicle's spread, the same seeds on each.

    Args:
        controller: what flies.
        vehicle: whose parameters' stds give the spread.
        vehicles: how many are drawn.
        episodes: flights on each.
        seconds: duration of a flight.
        seed: of the first flight, and of the draws.
        progress: called with the number of vehicles flown.
        jobs: vehicles at once, as in `coax_env.workers.each`; the figures are the same.
        backend: where, as in `coax_env.workers.each`.
        env_arguments: further ones of CoaxVectorEnv.

    Returns:
        score.json of the vehicle with the lowest success rate (the highest cost among equals), with
        ``"vehicles"``: the figures of each, and what it was drawn as.
    """
    if vehicles < 1:
        raise InputError(f"need at least one drawn vehicle, found {vehicles}")
    vehicle = load_vehicle(vehicle)
    rng = np.random.default_rng(seed)
    drawn = [vehicle.draw(rng) for _ in range(vehicles)]
    judge = partial(_one_drawn, controller, (episodes, seconds, seed), env_arguments)
    found = {}
    for (number, _), score in each(judge, list(enumerate(drawn)), jobs, backend):
        found[number] = score
        if progress:
            progress(1)
    scores = [found[number] for number in range(vehicles)]
    worst = min(scores, key=lambda score: (score["success_rate"], -score["mean_cost"]))
    table = [
        {name: score[name] for name in FIGURES} | {"values": one.values()}
        for score, one in zip(scores, drawn, strict=True)
    ]
    return worst | {"vehicles": table}


def _one_drawn(
    controller: Controller,
    flights: tuple[int, float, int],
    env_arguments: dict[str, Any],
    numbered: tuple[int, Vehicle],
) -> dict[str, Any]:
    """The score on one of the drawn vehicles, which come with their numbers."""
    return evaluate(controller, numbered[1], *flights, **env_arguments)


FIGURES = (
    "success_rate", "survival_rate", "mean_cost", "height_rms_m", "velocity_rms_mps",
    "heading_rms_deg", "drift_m", "effort",
)  # fmt: skip
"""What a table of scores shows."""


_POOLED = ("height", "speed", "heading", "distance")
"""Errors whose squares are summed, see `hover.squared_errors`; ``distance``: to the target."""


AT_ONCE = 100
"""Periods that are summed at once: of a few flights, NumPy's calls cost more than the sums."""


class _Totals:
    """Sums over every flight."""

    def __init__(self, count: int, task: str, course: Any) -> None:
        self.count, self.task = count, task
        self.alive = np.ones(count, dtype=bool)
        self.targets = np.tile([0.0, 0.0, -hover.HEIGHT, 0.0], (count, 1))
        self.wanted = max(1, len(tasks.course(task, course)))
        self.cost, self.reward, self.effort = np.zeros(count), np.zeros(count), np.zeros(count)
        self.flown, self.judged = np.zeros(count), np.zeros(count)
        self.squares = {name: np.zeros(count) for name in _POOLED}
        self.drift, self.reached = np.zeros(count), np.zeros(count)
        self.place: np.ndarray | None = None
        self._waiting: list[tuple[np.ndarray, ...]] = []
        self._settled: list[bool] = []

    def add(
        self,
        info: dict[str, Any],
        targets: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        settled: bool,
        rates: np.ndarray | None = None,
    ) -> None:
        """Add one period; it is in the sums after `add_up`.

        Args:
            info: of the env after the period; ``state`` is (count, n).
            targets: x y z psi before it, (count, 4).
            actions: (count, 4).
            rewards: (count,).
            settled: whether errors count already.
            rates: of the targets before it, (count, 4), where they move.
        """
        reached = np.broadcast_to(info.get("reached", 0), self.count)
        period = (info["state"], targets, actions, rewards, reached, self.alive.copy())
        self._waiting.append(period if rates is None else (*period, rates))
        self._settled.append(settled)
        if len(self._waiting) == AT_ONCE:
            self.add_up()

    def add_up(self) -> None:
        """Take the periods into the sums that are not yet there."""
        if not self._waiting:
            return
        states, targets, actions, rewards, reached, alive, *moving = (
            np.stack(values) for values in zip(*self._waiting, strict=True)
        )
        settled = np.array(self._settled)
        self._waiting.clear()
        self._settled.clear()
        rates = moving[0] if moving else None
        finite = alive & np.isfinite(states).all(axis=-1)
        states = np.where(finite[..., None], states, 0.0)
        cost = hover.cost(states, actions, targets, rates=rates)
        self.cost += np.where(finite, cost, hover.CRASHED_COST).sum(axis=0)
        self.reward += np.where(finite, rewards, 0.0).sum(axis=0)
        self.effort += np.where(finite, (actions.astype(float) ** 2).sum(axis=-1), 0.0).sum(axis=0)
        self.flown += finite.sum(axis=0)
        self.reached = np.maximum(self.reached, np.where(finite, reached, 0).max(axis=0))
        if settled.any():
            judged = (finite[settled], states[settled], targets[settled])
            self._judge(*judged, rates=None if rates is None else rates[settled])

    def _judge(
        self,
        finite: np.ndarray,
        states: np.ndarray,
        targets: np.ndarray,
        rates: np.ndarray | None,
    ) -> None:
        """Add the errors of some periods, each (periods, count, ...)."""
        if self.place is None:
            self.place = states[0, :, PLACE].copy()
        place = self.place if self.task == "hover" else targets[..., hover.HORIZONTAL]
        errors = hover.squared_errors(states, targets, rates)
        errors["distance"] = errors["position"] + errors["height"]
        for name, total in self.squares.items():
            total += np.where(finite, errors[name], 0.0).sum(axis=0)
        self.judged += finite.sum(axis=0)
        away = np.linalg.norm(states[..., PLACE] - place, axis=-1)
        self.drift = np.maximum(self.drift, np.where(finite, away, 0.0).max(axis=0))

    def score(self, steps: int) -> dict[str, Any]:
        """The figures of score.json; `steps` is the length of a whole flight."""
        judged = np.maximum(self.judged, 1.0)
        errors = {name: np.sqrt(total / judged) for name, total in self.squares.items()}
        errors["drift"] = self.drift
        success = tasks.judge(self.task, self.alive, errors, self.reached, self.wanted)
        at_rest = errors | {"drift": np.zeros(self.count)}
        but_drift = tasks.judge("hover", self.alive, at_rest)

        def pooled(name: str) -> float | None:
            total = self.judged.sum()
            return math.sqrt(self.squares[name].sum() / total) if total else None

        heading_rms = pooled("heading")
        seen = self.judged > 0
        figures = {
            "success_rate": float(success.mean()),
            "mean_cost": float(self.cost.mean() / steps),
            "mean_return": float(self.reward.mean()),
            "height_rms_m": pooled("height"),
            "velocity_rms_mps": pooled("speed"),
            "heading_rms_deg": None if heading_rms is None else math.degrees(heading_rms),
            "drift_m": float(self.drift[seen].mean()) if seen.any() else None,
            "effort": float(math.sqrt(self.effort.sum() / max(self.flown.sum(), 1.0))),
            "success_but_drift_rate": float(but_drift.mean()),
            "survival_rate": float(self.alive.mean()),
            "worst_height_rms_m": float(errors["height"][seen].max()) if seen.any() else None,
            "worst_cost": float(self.cost.max() / steps),
        }
        if tasks.task(self.task).moves_on:
            figures["mean_reached"] = float(self.reached.mean())
        if tasks.task(self.task).follows_path:
            figures["distance_rms_m"] = pooled("distance")
        return figures
