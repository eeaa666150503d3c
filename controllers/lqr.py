"""LQG with integral action: python-control's LQR on the kernel's linearisation, and the estimator.

The regulator minimises the quadratic cost by which every controller is compared (hover.LIMITS and
COST_WEIGHTS), with integrals of the measured height, heading and position added, so that no error
of trim or sensor model stays in them. Where position is not measured, the integral of the measured
velocity stands for it: the machine then holds still, and its place drifts.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.env import hover
from coax_env.env.actions import Nominal
from coax_env.env.period import DT
from coax_env.model.vehicle import Vehicle, load_vehicle
from controllers.estimator import (
    INTEGRAL_TIME,
    Estimating,
    EstimatorDesign,
    design_estimator,
    integrated_readings,
)
from controllers.feedback import Designed

INPUT_NAMES = ("rotor_upper", "rotor_lower", "swash_lon", "swash_lat")


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

    kind = "lqg"

    def answer_knowing(self, known: np.ndarray) -> np.ndarray:
        """Actions (count, 4), not yet clipped, to estimates and integrals (count, n + i)."""
        return -self.tracker.offset / self.estimator.action_scale - known @ self.gain.T

    def content(self) -> dict[str, Any]:
        """What a file of this kind has of its own."""
        return {
            "control_period_s": DT,
            "cost": {"weights": hover.COST_WEIGHTS, "limits": hover.LIMITS},
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
        )


BRISK = {"position": 0.5, "speed": 1.0}
"""Limits [m, m/s] that make a design go to its target sooner than hover.LIMITS do."""


def design(
    vehicle: str | Vehicle,
    nominal: Nominal = None,
    sensors: str = "onboard",
    limits: Mapping[str, float] | None = None,
) -> LQG:
    """Design a hover controller on a vehicle.

    Args:
        vehicle: what the design is made on: shipped name, path or Vehicle.
        nominal: whose trim centres the action, as in the env.
        sensors: the suite it will be given.
        limits: errors that count 1 in the cost, where not hover.LIMITS, such as BRISK.
    """
    import control

    vehicle = load_vehicle(vehicle)
    estimator = design_estimator(vehicle, nominal, sensors)
    A, B, Q, R = regulator_problem(estimator, limits)
    gain, cost_to_go, _ = control.dlqr(A, B, Q, R)
    return LQG(vehicle.name, estimator, np.asarray(gain), np.asarray(cost_to_go))


def regulator_problem(
    estimator: EstimatorDesign, limits: Mapping[str, float] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B, Q, R of the regulator: states and integrals, actions, `hover.cost` per period."""
    limits = hover.LIMITS | dict(limits or {})
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
            Q[at, at] += hover.COST_WEIGHTS[error] / limits[error] ** 2
    R = np.eye(4) * hover.COST_WEIGHTS["effort"] / limits["effort"] ** 2
    return A, B, Q, R


@dataclass(frozen=True)
class Margins:
    """Stability margins at one plant input, the other loops closed."""

    input: str
    gain_down: float  # the loop's gain may fall to this
    gain_up: float  # and rise to this
    phase_deg: float
    distance: float  # least |1 + L|
    crossover_hz: float  # where the phase margin is least


def loop(controller: LQG, flown: EstimatorDesign | None = None) -> Any:
    """The loop broken at the plant's four inputs, as a discrete ``control.StateSpace``.

    `flown` is the model of another plant than the one designed on, from `design_estimator`.

    The estimator is the single-rate equivalent of the periodic one: slow sensors taken as fast ones
    with as much more noise.
    """
    import control

    e = controller.estimator
    integrated = integrated_readings(e)
    n, m, i = len(e.states), len(e.readings), len(integrated)
    S, plant_of = np.diag(e.action_scale), flown or e
    # plant: the states and the command in force; readings see both
    plant = control.ss(
        np.block([[plant_of.A, np.zeros((n, 4))], [np.zeros((4, n)), np.zeros((4, 4))]]),
        np.vstack([plant_of.B @ S, S]),
        np.hstack([plant_of.C, plant_of.D]),
        np.zeros((m, 4)),
        DT,
    )
    K, F = e.single_rate_gain, controller.gain
    F_x, F_i = F[:, :n], F[:, n:]
    M = np.zeros((i, m))
    for k, name in enumerate(integrated):
        M[k, e.readings.index(name)] = DT
    # state: prediction, integrals, command in force; corrected = prediction + K (y - C x - D u)
    corrected = np.hstack([np.eye(n) - K @ e.C, np.zeros((n, i)), -K @ e.D])
    act = -F_x @ corrected - np.hstack([np.zeros((4, n)), F_i, np.zeros((4, 4))])
    act_y = -F_x @ K
    regulator = control.ss(
        np.vstack(
            [
                e.A @ corrected + e.B @ S @ act,
                np.hstack([np.zeros((i, n)), np.eye(i), np.zeros((i, 4))]),
                S @ act,
            ]
        ),
        np.vstack([e.A @ K + e.B @ S @ act_y, M, S @ act_y]),
        -act,
        -act_y,
        DT,
    )
    return regulator * plant


def frequency_responses(
    controller: LQG, flown: EstimatorDesign | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of `loop`, up to Nyquist: frequencies [rad/s] (w,), the whole loop (w, 4, 4), and the loop of
    each input with the others closed (w, 4)."""
    omega = np.append(np.geomspace(1e-3, 0.99 * math.pi / DT, 1000), math.pi / DT)
    L = np.moveaxis(loop(controller, flown).frequency_response(omega).frdata, -1, 0)
    single = np.empty(L.shape[:2], dtype=complex)
    for k in range(4):
        rest = [i for i in range(4) if i != k]
        others = np.linalg.solve(np.eye(3) + L[:, rest][:, :, rest], L[:, rest, k : k + 1])
        single[:, k] = L[:, k, k] - (L[:, k : k + 1, rest] @ others)[:, 0, 0]
    return omega, L, single


def margins(controller: LQG) -> tuple[list[Margins], float]:
    """Classical margins of each input with the others closed, and the disk margin of all four.

    The disk margin alpha allows every input at once a gain between (2 - alpha)/(2 + alpha) and its
    inverse, or a phase of 2 atan(alpha/2) (Seiler, Packard and Gahinet, IEEE CSM 2020).
    """
    import control

    omega, L, single = frequency_responses(controller)
    found = [
        Margins(name, *_classical(control.frd(one, omega)))
        for name, one in zip(INPUT_NAMES, single.T, strict=True)
    ]
    return found, _disk(L)


def margins_over_spread(
    controller: LQG, vehicle: str | Vehicle, draws: int = 20, seed: int = 0
) -> np.ndarray:
    """Disk margin on each of so many vehicles drawn from a vehicle's spread, (draws,); 0: unstable."""
    import control

    vehicle = load_vehicle(vehicle)
    rng = np.random.default_rng(seed)
    found = np.zeros(draws)
    for k in range(draws):
        flown = design_estimator(vehicle.draw(rng), controller.nominal, controller.sensors)
        closed = control.feedback(loop(controller, flown), np.eye(4))
        if np.abs(closed.poles()).max() < 1.0:
            found[k] = _disk(frequency_responses(controller, flown)[1])
    return found


def _disk(L: np.ndarray) -> float:
    """Disk margin of a loop's frequency response (w, 4, 4), all inputs at once."""
    S = np.linalg.inv(np.eye(4) + L)
    return 1.0 / max(_structured(matrix - 0.5 * np.eye(4)) for matrix in S)  # (S - T)/2


def _classical(loop: Any) -> tuple[float, float, float, float, float]:
    """Fields of Margins but the name, from the frequency response of a loop up to Nyquist."""
    import control

    values = loop.frdata[0, 0]
    gains, phases, _, _, crossovers, _ = control.stability_margins(loop, returnall=True)
    gains, phases = np.asarray(gains, dtype=float), np.abs(np.asarray(phases, dtype=float))
    if values[-1].real < 0.0:  # the last crossing of the negative axis
        gains = np.append(gains, -1.0 / values[-1].real)
    worst = int(np.argmin(phases)) if len(phases) else None
    return (
        float(gains[gains < 1.0].max(initial=0.0)),
        float(gains[gains > 1.0].min(initial=math.inf)),
        math.inf if worst is None else float(phases[worst]),
        float(np.abs(1.0 + values).min()),
        0.0 if worst is None else float(crossovers[worst]) / (2.0 * math.pi),
    )


def _structured(matrix: np.ndarray) -> float:
    """Upper bound of the structured singular value for diagonal uncertainty (Osborne scaling)."""
    scale = np.ones(len(matrix))
    for _ in range(30):
        M = matrix * scale[:, None] / scale
        off = M - np.diag(np.diag(M))
        rows, columns = np.linalg.norm(off, axis=1), np.linalg.norm(off, axis=0)
        scale *= np.sqrt(np.maximum(columns, 1e-12) / np.maximum(rows, 1e-12))
    return float(np.linalg.norm(matrix * scale[:, None] / scale, 2))
