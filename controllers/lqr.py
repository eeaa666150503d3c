"""LQG with integral action: python-control's LQR on the kernel's linearisation, and the estimator.

The regulator minimises the quadratic cost by which every controller is compared (hover.LIMITS and
COST_WEIGHTS, or one's own), with integrals of the measured height, heading and position added, so
that no error of trim or sensor model stays in them. Where position is not measured, the integral of
the measured velocity stands for it: the machine then holds still, and its position drifts. Its
stability margins are computed in margins.py.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from coax_env.env import hover
from coax_env.env.actions import Nominal
from coax_env.env.period import DELAYS, DT
from coax_env.errors import InputError
from coax_env.model.vehicle import Parameter, Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers.estimator import Estimating
from controllers.estimator_design import (
    INTEGRAL_TIME,
    EstimatorDesign,
    design_estimator,
    integrated_readings,
)
from controllers.feedback import Designed


@dataclass
class LQG(Estimating, Designed):
    """A designed controller: plain matrices. `act` flies one helicopter or a batch of them.

    action = clip(feedforward - gain @ [estimate; integrals], -1, 1), all deviations from the design
    vehicle's trim.
    """

    vehicle: str
    estimator: EstimatorDesign
    gain: np.ndarray  # (4, n + i), per state [SI], of the action
    cost_to_go: np.ndarray  # (n + i, n + i): x'Px is the cost of all further steps
    cost: dict[str, dict[str, float]] = field(default_factory=lambda: quadratic_cost())

    kind = "lqg"

    def actions_from_estimate(self, known: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to estimates and integrals (count, n + i)."""
        return -self.tracker.offset / self.estimator.action_scale - known @ self.gain.T

    def content(self) -> dict[str, Any]:
        """What a file of this kind has of its own."""
        return {
            "control_period_s": DT,
            "cost": self.cost,
            "integral_time_s": INTEGRAL_TIME,
            "estimator": self.estimator.to_dict(),
            "gain": self.gain.tolist(),
            "cost_to_go": self.cost_to_go.tolist(),
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "LQG":
        """From a JSON file."""
        return cls(
            vehicle=str(content["vehicle"]),
            estimator=EstimatorDesign.from_dict(content["estimator"]),
            gain=np.array(content["gain"], dtype=float),
            cost_to_go=np.array(content["cost_to_go"], dtype=float),
            cost=quadratic_cost(content["cost"]["limits"], content["cost"]["weights"]),
        )


BRISK = {"position": 0.5, "speed": 1.0}
"""Limits [m, m/s] that make a design go to its target sooner than hover.LIMITS do."""


HEDGE = {"motor_lag.upper": 0.05, "motor_lag.lower": 0.05, "servo_lag.time": 0.02}
"""Lags [s] of machines of this class, about two thirds of their usual sizes."""


def hedged(vehicle: Vehicle, lags: Mapping[str, float]) -> Vehicle:
    """A vehicle to design on: with lags of its actuators where its file names none.

    A loop closed on them rolls off before the lags that a machine may have: they are the low-pass in
    its inputs. What the file itself says of a lag stays as it is, and a delay that it names is part of
    the hedge: the design takes it for a lag.

    Args:
        vehicle: what is known.
        lags: parameter -> time [s], such as HEDGE.
    """
    known = vehicle.values()
    late, swash_later = (known.get(name, 0.0) for name in DELAYS)
    own = {}
    for name, lag in lags.items():
        left = lag - late - (swash_later if name.startswith("servo") else 0.0)
        if left > 0.0 and name.split(".")[0] not in vehicle.effects:
            own[name] = Parameter(left, 0.0, "s", "a hedge, not measured")
    return vehicle.with_parameters(own)


def quadratic_cost(
    limits: Mapping[str, float] | None = None, weights: Mapping[str, float] | None = None
) -> dict[str, dict[str, float]]:
    """What a regulator minimises: an error of its limit counts its weight.

    Args:
        limits: where not hover.LIMITS [SI]; all positive.
        weights: where not hover.COST_WEIGHTS [1]; none negative, the effort's positive.

    Raises:
        InputError: an unknown name, or a number that no regulator has.
    """
    result = {"weights": dict(hover.COST_WEIGHTS), "limits": dict(hover.LIMITS)}
    for kind, own in (("weights", weights), ("limits", limits)):
        for name, value in (own or {}).items():
            if name not in hover.LIMITS:
                raise InputError(f"{kind}: no {name!r} in the cost: {', '.join(hover.LIMITS)}")
            may_vanish = kind == "weights" and name != "effort"
            if not (value > 0.0 or (may_vanish and value == 0.0)) or not np.isfinite(value):
                least = "0 or more" if may_vanish else "more than 0"
                raise InputError(f"{kind}: {name} must be {least}, found {value:g}")
            result[kind][name] = float(value)
    return result


def design(
    vehicle: str | Vehicle,
    nominal: Nominal = None,
    sensors: str = "onboard",
    limits: Mapping[str, float] | None = None,
    weights: Mapping[str, float] | None = None,
    velocity: Sequence[float] = (0.0, 0.0),
    hedge: Mapping[str, float] | None = None,
) -> LQG:
    """Design a hover controller on a vehicle.

    Args:
        vehicle: what the design is made on: shipped name, path or Vehicle.
        nominal: whose trim centres the action, as in the env.
        sensors: the suite it will be given.
        limits: errors that count 1 in the cost, where not hover.LIMITS, such as BRISK.
        weights: of the errors, where not hover.COST_WEIGHTS.
        velocity: forward and right over ground [m/s], of the flight that it holds; 0: hover.
        hedge: lags to reckon with where the vehicle has none, such as HEDGE, see `hedged`.
    """
    import control

    vehicle = hedged(load_vehicle(vehicle), hedge or {})
    cost = quadratic_cost(limits, weights)
    estimator = design_estimator(vehicle, nominal, sensors, velocity)
    A, B, Q, R = regulator_problem(estimator, cost["limits"], cost["weights"])
    gain, cost_to_go, _ = control.dlqr(A, B, Q, R, method="scipy")
    return LQG(vehicle.name, estimator, np.asarray(gain), np.asarray(cost_to_go), cost)


def regulator_problem(
    estimator: EstimatorDesign,
    limits: Mapping[str, float] | None = None,
    weights: Mapping[str, float] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The discrete regulator problem: `hover.cost` per control period, deviations from trim.

    Args:
        estimator: whose states, with the integrals of its readings, are fed back.
        limits: errors that count 1 in the cost, where not hover.LIMITS.
        weights: of the errors, where not hover.COST_WEIGHTS.

    Returns:
        A (n + i, n + i), B (n + i, 4) per action, Q (n + i, n + i), R (4, 4).
    """
    cost = quadratic_cost(limits, weights)
    limits, weights = cost["limits"], cost["weights"]
    integrated = integrated_readings(estimator)
    n = len(estimator.states)
    A, B = np.eye(n + len(integrated)), np.zeros((n + len(integrated), 4))
    A[:n, :n], B[:n] = estimator.A, estimator.B * estimator.action_scale
    Q = np.zeros_like(A)
    for k, (name, limit) in enumerate(integrated.items()):
        A[n + k, :n] = DT * estimator.C[estimator.readings.index(name)]
        Q[n + k, n + k] = 1.0 / limit**2
    errors = {
        "height": "z", "position": "x y", "speed": "u v w", "heading": "psi", "rates": "p q r",
    }  # fmt: skip
    for error, names in errors.items():
        for name in set(names.split()) & set(estimator.states):
            at = estimator.index(name)
            Q[at, at] += weights[error] / limits[error] ** 2
    R = np.eye(4) * weights["effort"] / limits["effort"] ** 2
    return A, B, Q, R
