"""A gain schedule over forward speed: designs in steady flight, blended by the speed asked for.

At each speed of the grid there is a whole LQG, designed about the trim of level flight at that speed:
filter, model, feedback and trim. In between, estimate and action are those of the two neighbours,
weighed by their distance::

    x = sum w_k (x_k + deviation that design k's filter makes of x - x_k)
    action = sum w_k (feedforward_k - gain_k [x - x_k; integrals])

Without a target it hovers, as the design of speed 0 does. Towards a target that is ahead it asks for
the speed from which it can still stop there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.env.actions import Nominal
from coax_env.env.period import DT
from coax_env.env.tasks import FORWARD
from coax_env.errors import InputError
from coax_env.kernel.angles import wrap_angles
from coax_env.model.dynamics import full_state
from coax_env.model.layout import FULL_STATES
from coax_env.model.trim import trim
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers import lqr
from controllers.estimator import Tracker
from controllers.feedback import Designed, Feedback
from controllers.lqr import LQG
from controllers.target import REACH, TargetView

SPEEDS = (0.0, 1.0, 2.0, 3.0)
"""Usual grid [m/s]."""
BRAKING = 0.5  # [m/s2] with which it stops ahead of a target
GATHERING = 1.0  # [m/s2] the most that the speed asked for changes by
_NAMES = [name for name, _ in FULL_STATES]


@dataclass
class Schedule(Feedback, Designed):
    """LQGs at some speeds as one controller; ``act`` as every controller."""

    vehicle: str
    speeds: np.ndarray  # (k,) forward [m/s], rising from 0
    points: list[LQG]  # (k,)
    state_trims: np.ndarray  # (k, n), of the filter's states, less those of hover

    kind = "scheduled"

    def __post_init__(self) -> None:
        first = self.points[0].estimator
        self.sensors = first.sensors
        self.action_trim, self.action_scale = first.action_trim, first.action_scale
        self._view = TargetView(self.sensors)

    @property
    def advances(self) -> np.ndarray:
        """How far each trim's own position moves in a control period, (k, n)."""
        found = np.zeros_like(self.state_trims)
        states = self.points[0].estimator.states
        if "x" in states:
            found[:, states.index("x")] = DT * self.speeds
        return found

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        self.speed = np.zeros(self.count)  # asked for [m/s]
        self._trackers = [Tracker(point.estimator, self.count) for point in self.points]
        self.state = self._trackers[0].state + self.state_trims[0]
        self._turn = self._states.index("psi") if "psi" in self._states else -1

    @property
    def _states(self) -> tuple[str, ...]:
        return self.points[0].estimator.states

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to observations (count, n_obs)."""
        self._ask(observations)
        self._weights = shares(self.speed, self.speeds)
        self._spread_state()
        for tracker in self._trackers:
            tracker.see(observations)
        self.state = self._blended(np.zeros_like(self.state_trims))
        self._spread_state()
        actions = np.zeros((self.count, 4))
        for weight, point, tracker in zip(
            self._weights.T, self.points, self._trackers, strict=True
        ):
            known = np.hstack([tracker.state, tracker.integrals])
            feedforward = -tracker.offset / point.estimator.action_scale
            actions += weight[:, None] * (feedforward - known @ point.gain.T)
        return actions

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Observation (n_obs,) or (count, n_obs) to action (4,) or (count, 4), float32."""
        actions = super().act(observation)
        for tracker in self._trackers:
            tracker.acted(np.atleast_2d(actions))
        self.state = self._blended(self.advances)
        integrals = sum(
            weight[:, None] * tracker.integrals
            for weight, tracker in zip(self._weights.T, self._trackers, strict=True)
        )
        for tracker in self._trackers:
            tracker.integrals = np.array(integrals)
        return actions

    def _ask(self, observations: np.ndarray) -> None:
        """The speed from which it can still stop at the target, approached at GATHERING."""
        wanted = np.zeros(self.count)
        if self._view.has_target(observations):
            ahead = observations[:, self._view.width + FORWARD].astype(float) - REACH["place"]
            wanted = np.sqrt(2.0 * BRAKING * np.maximum(ahead, 0.0))
            wanted = np.minimum(wanted, self.speeds[-1])
        most = GATHERING * DT
        self.speed = self.speed + np.clip(wanted - self.speed, -most, most)

    def _spread_state(self) -> None:
        """Give every design's filter the common state, about its own trim."""
        for tracker, at in zip(self._trackers, self.state_trims, strict=True):
            tracker.state = self.state - at

    def _blended(self, further: np.ndarray) -> np.ndarray:
        """The common state (count, n) of what the filters have made of theirs.

        Args:
            further: added to each design's state, (k, n).
        """
        states = [
            t.state + at for t, at in zip(self._trackers, self.state_trims + further, strict=True)
        ]
        moves = [state - states[0] for state in states]
        if self._turn >= 0:
            for move in moves:
                move[:, self._turn] = wrap_angles(move[:, self._turn])
        return states[0] + sum(
            weight[:, None] * move for weight, move in zip(self._weights.T, moves, strict=True)
        )  # fmt: skip

    def content(self) -> dict[str, Any]:
        """What a file of this kind has of its own."""
        return {
            "speeds_mps": self.speeds.tolist(),
            "points": [point.content() for point in self.points],
            "state_trims": self.state_trims.tolist(),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "Schedule":
        """From a JSON file; shapes are checked."""
        name = str(content["vehicle"])
        points = [LQG.from_dict({**point, "vehicle": name}) for point in content["points"]]
        trims = np.array(content["state_trims"], dtype=float)
        speeds = _checked(content["speeds_mps"])
        if trims.shape != (len(speeds), len(points[0].estimator.states)) or len(points) != len(
            speeds
        ):
            raise ValueError("speeds, points and trims do not fit")
        return cls(name, speeds, points, trims)


def shares(speed: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """What each speed of the grid counts at speeds (count,): (count, k), sums 1."""
    if len(grid) == 1:
        return np.ones((len(speed), 1))
    within = np.clip(speed, grid[0], grid[-1])
    before = np.clip(np.searchsorted(grid, within, side="right") - 1, 0, len(grid) - 2)
    after = (within - grid[before]) / (grid[before + 1] - grid[before])
    result = np.zeros((len(speed), len(grid)))
    rows = np.arange(len(speed))
    result[rows, before], result[rows, before + 1] = 1.0 - after, after
    return result


def design(
    vehicle: str | Vehicle,
    nominal: Nominal = None,
    sensors: str = "mocap",
    speeds: Sequence[float] = SPEEDS,
    limits: Mapping[str, float] | None = None,
    weights: Mapping[str, float] | None = None,
) -> Schedule:
    """Design an LQG at each of some forward speeds.

    Args:
        vehicle: what the design is made on: shipped name, path or Vehicle.
        nominal: whose trim centres the action, as in the env.
        sensors: the suite it will be given; it flies to targets where that shows the position.
        speeds: forward [m/s], rising from 0.
        limits: errors that count 1 in the cost, where not lqr.BRISK's and hover.LIMITS.
        weights: of the errors, where not hover.COST_WEIGHTS.
    """
    vehicle = load_vehicle(vehicle)
    grid = _checked(speeds)
    own = lqr.BRISK | dict(limits or {})
    points = [lqr.design(vehicle, nominal, sensors, own, weights, (speed, 0.0)) for speed in grid]
    states = points[0].estimator.states
    if any(point.estimator.states != states for point in points):
        raise InputError("what the sensors show differs from speed to speed: choose nearer speeds")
    flown = [full_state(*trim(vehicle, (speed, 0.0)), vehicle) for speed in grid]
    places = [_NAMES.index(name) if name in _NAMES else -1 for name in states]
    trims = [
        [(one - flown[0])[at] if at >= 0 else 0.0 for at in places] for one in flown
    ]  # biases have none
    return Schedule(vehicle.name, grid, points, np.array(trims))


def _checked(speeds: Sequence[float]) -> np.ndarray:
    """A grid of speeds [m/s]; InputError where it is none."""
    grid = np.array(speeds, dtype=float)
    if grid.ndim != 1 or not len(grid) or grid[0] != 0.0 or not (np.diff(grid) > 0.0).all():
        raise InputError(f"speeds must rise from 0, found {list(speeds)}")
    if not np.isfinite(grid).all():
        raise InputError("speeds must be finite")
    return grid
