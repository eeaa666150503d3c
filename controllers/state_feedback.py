"""LQR and LQI: linear feedback of the exact state, without and with integrals.

Three designs share one quadratic cost (`lqr.regulator_problem`) and differ in what they are given:

``lqr``   the exact state (suite ``state``), nothing remembered
``lqi``   the same, and the integrals of height, heading and position: no offset stays
``lqg``   any suite's noisy readings: `lqi`'s feedback of a Kalman filter's estimate (lqr.py)

The first two say what the noise of real sensors costs the third.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coax_env import hover
from coax_env.files import write_json
from coax_env.fleet import DT, Nominal
from coax_env.layout import ACTUATOR_STATES, STATES
from coax_env.vehicle import Vehicle, load_vehicle
from controllers.estimator import design_estimator, integrated_readings
from controllers.loading import FORMAT, VERSION
from controllers.lqr import regulator_problem
from controllers.target import TargetView

NAMES = tuple(name for name, _ in (*STATES, *ACTUATOR_STATES))
_X, _Y, _PSI = (NAMES.index(name) for name in ("x", "y", "psi"))
_WINDUP = 20.0  # integrals stop at so many of the limits they are weighed by


@dataclass
class StateFeedback:
    """action = clip(feedforward - gain @ [state; integrals], -1, 1), deviations from trim."""

    vehicle: str
    kind: str  # "lqr" or "lqi"
    gain: np.ndarray  # (4, 20 + i), per state [SI], of the action
    cost_to_go: np.ndarray  # (20 + i, 20 + i): x'Px is the cost of all further steps
    integrated: dict[str, float]  # states integrated, and what counts 1 of them; none for lqr
    state_trim: np.ndarray  # (20,), of the design vehicle
    feedforward: np.ndarray  # (4,), the design vehicle's trim as an action
    action_trim: np.ndarray  # (4,)
    action_scale: np.ndarray  # (4,)

    sensors = "state"

    def __post_init__(self) -> None:
        self._view = TargetView(self.sensors)
        self._integrals = np.zeros((1, len(self.integrated)))

    @property
    def nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """Trim and scale of its actions, for ``nominal=`` of the env."""
        return self.action_trim, self.action_scale

    def reset(self, count: int = 1) -> None:
        """Forget the last flight; `count` helicopters are flown next."""
        self._integrals = np.zeros((count, len(self.integrated)))

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Observation (n_obs,) or (count, n_obs) to action (4,) or (count, 4), float32."""
        batch = np.atleast_2d(observation).astype(float)
        if len(self._integrals) != len(batch):
            self.reset(len(batch))
        there = np.ones(len(batch), dtype=bool)
        if self._view.aims(batch):
            batch, _, there = self._view.seen(batch)
        state = batch - self.state_trim
        heading, north, east = state[:, _PSI], state[:, _X].copy(), state[:, _Y].copy()
        state[:, _X] = np.cos(heading) * north + np.sin(heading) * east
        state[:, _Y] = np.cos(heading) * east - np.sin(heading) * north
        known = np.hstack([state, self._integrals])
        actions = np.clip(self.feedforward - known @ self.gain.T, -1.0, 1.0).astype(np.float32)
        places = [NAMES.index(name) for name in self.integrated]
        most = _WINDUP * np.array(list(self.integrated.values()))
        self._integrals += DT * there[:, None] * state[:, places]
        np.clip(self._integrals, -most, most, out=self._integrals)
        return actions if np.ndim(observation) == 2 else actions[0]

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file, weights included."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "kind": self.kind,
            "vehicle": self.vehicle,
            "control_period_s": DT,
            "cost": {"weights": hover.COST_WEIGHTS, "limits": hover.LIMITS},
            "states": NAMES,
            "integrated": self.integrated,
            **{name: getattr(self, name).tolist() for name in _ARRAYS},
        }

    def save(self, path: str | Path) -> Path:
        """Write controller.json."""
        return write_json(path, self.to_dict())

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "StateFeedback":
        """From a JSON file."""
        arrays = {name: np.array(content[name], dtype=float) for name in _ARRAYS}
        return cls(
            vehicle=str(content["vehicle"]), kind=str(content["kind"]),
            integrated=dict(content["integrated"]), **arrays,
        )  # fmt: skip


_ARRAYS = ("gain", "cost_to_go", "state_trim", "feedforward", "action_trim", "action_scale")


def design(
    vehicle: str | Vehicle,
    nominal: Nominal = None,
    *,
    integral: bool = True,
    limits: Mapping[str, float] | None = None,
) -> StateFeedback:
    """Design LQI, or LQR without the integrals, on a vehicle; `limits` as in `lqr.design`."""
    import control

    vehicle = load_vehicle(vehicle)
    model = design_estimator(vehicle, nominal, StateFeedback.sensors)
    integrated = integrated_readings(model) if integral else {}
    n = len(model.states)
    kept = [model.index(name) for name in NAMES] + list(range(n, n + len(integrated)))
    A, B, Q, R = regulator_problem(model, limits)
    gain, cost_to_go, _ = control.dlqr(A[np.ix_(kept, kept)], B[kept], Q[np.ix_(kept, kept)], R)
    return StateFeedback(
        vehicle=vehicle.name,
        kind="lqi" if integral else "lqr",
        gain=np.asarray(gain),
        cost_to_go=np.asarray(cost_to_go),
        integrated=integrated,
        state_trim=model.reading_trim,
        feedforward=(model.command_trim - model.action_trim) / model.action_scale,
        action_trim=model.action_trim,
        action_scale=model.action_scale,
    )
