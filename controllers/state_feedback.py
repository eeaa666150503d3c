"""LQR and LQI: linear feedback of the exact state, without and with integrals.

Three designs share one quadratic cost (`lqr.regulator_problem`) and differ in what they are given:

``lqr``   the exact state (suite ``state``), no memory
``lqi``   the same, and the integrals of height, heading and position: no offset stays
``lqg``   any suite's noisy readings: `lqi`'s feedback of a Kalman filter's estimate (lqr.py)

The first two show what the noise of real sensors costs the third.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.env import hover
from coax_env.env.actions import Nominal
from coax_env.env.period import DT
from coax_env.model.layout import ACTUATOR_STATES, STATES
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers.estimator import WINDUP
from controllers.estimator_design import design_estimator, integrated_readings
from controllers.feedback import Designed, Feedback
from controllers.lqr import regulator_problem
from controllers.target import TargetView, turned

NAMES = tuple(name for name, _ in (*STATES, *ACTUATOR_STATES))
_X, _Y, _PSI = (NAMES.index(name) for name in ("x", "y", "psi"))


@dataclass
class StateFeedback(Feedback, Designed):
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

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        self._view = TargetView(self.sensors)
        self.integrals = np.zeros((self.count, len(self.integrated)))

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to observations (count, n_obs)."""
        batch, there = self._view.as_hover(observations)
        state = batch - self.state_trim
        state[:, [_X, _Y]] = turned(state[:, [_X, _Y]], -state[:, _PSI])
        known = np.hstack([state, self.integrals])
        places = [NAMES.index(name) for name in self.integrated]
        most = WINDUP * np.array(list(self.integrated.values()))
        self.integrals += DT * there[:, None] * state[:, places]
        np.clip(self.integrals, -most, most, out=self.integrals)
        return self.feedforward - known @ self.gain.T

    def content(self) -> dict[str, Any]:
        """What a file of this kind has of its own."""
        return {
            "control_period_s": DT,
            "cost": {"weights": hover.COST_WEIGHTS, "limits": hover.LIMITS},
            "states": NAMES,
            "integrated": self.integrated,
            **{name: getattr(self, name).tolist() for name in _ARRAYS},
        }

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
    """Design LQI, or LQR without the integrals, on a vehicle.

    Args:
        vehicle: what the design is made on: shipped name, path or Vehicle.
        nominal: vehicle whose trim centres the action, as in the env (default: the bare one).
        integral: whether height, heading and position are integrated.
        limits: errors that count 1 in the cost, where not hover.LIMITS.
    """
    import control

    vehicle = load_vehicle(vehicle)
    model = design_estimator(vehicle, nominal, StateFeedback.sensors)
    integrated = integrated_readings(model) if integral else {}
    n = len(model.states)
    kept = [model.index(name) for name in NAMES] + list(range(n, n + len(integrated)))
    A, B, Q, R = regulator_problem(model, limits)
    gain, cost_to_go, _ = control.dlqr(
        A[np.ix_(kept, kept)], B[kept], Q[np.ix_(kept, kept)], R, method="scipy"
    )
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
