"""Stability margins of an LQG design, from the frequency response of its loop.

Of the loop with the single-rate equivalent of the multi-rate filter, broken at the plant's inputs.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.env.period import DT
from coax_env.model.vehicle import Vehicle, load_vehicle
from controllers.estimator import EstimatorDesign, design_estimator, integrated_readings
from controllers.lqr import LQG

INPUT_NAMES = ("rotor_upper", "rotor_lower", "swash_lon", "swash_lat")


@dataclass(frozen=True)
class InputMargins:
    """Stability margins at one plant input, the other loops closed."""

    input: str
    gain_down: float  # the loop's gain may fall to this
    gain_up: float  # and rise to this
    phase_deg: float
    distance: float  # least |1 + L|
    crossover_hz: float  # where the phase margin is least


def open_loop(controller: LQG, plant: EstimatorDesign | None = None) -> Any:
    """The loop broken at the plant's four inputs, as a discrete ``control.StateSpace``.

    The estimator is the single-rate equivalent of the periodic one: slow sensors taken as fast ones
    with as much more noise.

    Args:
        controller: the design.
        plant: the model of another plant than the one designed on, from `design_estimator`.
    """
    return _regulator(controller) * _plant(plant or controller.estimator, controller.estimator)


def _plant(model: EstimatorDesign, design: EstimatorDesign) -> Any:
    """From actions to readings; states: those of the model, then the command in force (4,)."""
    import control

    n, m = len(design.states), len(design.readings)
    S = np.diag(design.action_scale)
    return control.ss(
        np.block([[model.A, np.zeros((n, 4))], [np.zeros((4, n)), np.zeros((4, 4))]]),
        np.vstack([model.B @ S, S]),
        np.hstack([model.C, model.D]),
        np.zeros((m, 4)),
        DT,
    )


def _regulator(controller: LQG) -> Any:
    """From readings to minus the actions; states: prediction, integrals, command in force (4,)."""
    import control

    e = controller.estimator
    integrated = integrated_readings(e)
    n, m, i = len(e.states), len(e.readings), len(integrated)
    S = np.diag(e.action_scale)
    K, F = e.single_rate_gain, controller.gain
    F_x, F_i = F[:, :n], F[:, n:]
    M = np.zeros((i, m))
    for k, name in enumerate(integrated):
        M[k, e.readings.index(name)] = DT
    # corrected = prediction + K (y - C x - D u)
    corrected = np.hstack([np.eye(n) - K @ e.C, np.zeros((n, i)), -K @ e.D])
    act = -F_x @ corrected - np.hstack([np.zeros((4, n)), F_i, np.zeros((4, 4))])
    act_y = -F_x @ K
    return control.ss(
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


def frequency_responses(
    controller: LQG, plant: EstimatorDesign | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequency responses of `open_loop` up to Nyquist.

    Returns:
        frequencies [rad/s] (w,); the whole loop (w, 4, 4); the loop of each input with the others
        closed (w, 4).
    """
    omega = np.append(np.geomspace(1e-3, 0.99 * math.pi / DT, 1000), math.pi / DT)
    L = np.moveaxis(open_loop(controller, plant).frequency_response(omega).frdata, -1, 0)
    single = np.empty(L.shape[:2], dtype=complex)
    for k in range(4):
        rest = [i for i in range(4) if i != k]
        others = np.linalg.solve(np.eye(3) + L[:, rest][:, :, rest], L[:, rest, k : k + 1])
        single[:, k] = L[:, k, k] - (L[:, k : k + 1, rest] @ others)[:, 0, 0]
    return omega, L, single


def stability_margins(controller: LQG) -> tuple[list[InputMargins], float]:
    """Classical margins of each input with the others closed, and the disk margin of all four.

    The disk margin alpha allows every input at once a gain between (2 - alpha)/(2 + alpha) and its
    inverse, or a phase of 2 atan(alpha/2) (Seiler, Packard and Gahinet, IEEE CSM 2020).
    """
    import control

    omega, L, single = frequency_responses(controller)
    found = [
        InputMargins(name, *_classical(control.frd(one, omega)))
        for name, one in zip(INPUT_NAMES, single.T, strict=True)
    ]
    return found, _disk_margin(L)


def margins_over_spread(
    controller: LQG, vehicle: str | Vehicle, draws: int = 20, seed: int = 0
) -> np.ndarray:
    """Disk margins on vehicles drawn from a vehicle's spread.

    Args:
        controller: the design.
        vehicle: whose parameters' stds give the spread.
        draws: number of vehicles.
        seed: of the draws.

    Returns:
        (draws,); 0 where the loop is unstable.
    """
    import control

    vehicle = load_vehicle(vehicle)
    rng = np.random.default_rng(seed)
    found = np.zeros(draws)
    for k in range(draws):
        plant = design_estimator(vehicle.draw(rng), controller.nominal, controller.sensors)
        closed = control.feedback(open_loop(controller, plant), np.eye(4))
        if np.abs(closed.poles()).max() < 1.0:
            found[k] = _disk_margin(frequency_responses(controller, plant)[1])
    return found


def _disk_margin(L: np.ndarray) -> float:
    """Disk margin of a loop's frequency response (w, 4, 4), all inputs at once."""
    S = np.linalg.inv(np.eye(4) + L)
    return 1.0 / max(_mu_upper_bound(matrix - 0.5 * np.eye(4)) for matrix in S)  # (S - T)/2


def _classical(loop: Any) -> tuple[float, float, float, float, float]:
    """Fields of InputMargins but the name, from the frequency response of a loop up to Nyquist."""
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


def _mu_upper_bound(matrix: np.ndarray) -> float:
    """Upper bound of the structured singular value for diagonal uncertainty (Osborne scaling)."""
    scale = np.ones(len(matrix))
    for _ in range(30):
        M = matrix * scale[:, None] / scale
        off = M - np.diag(np.diag(M))
        rows, columns = np.linalg.norm(off, axis=1), np.linalg.norm(off, axis=0)
        scale *= np.sqrt(np.maximum(columns, 1e-12) / np.maximum(rows, 1e-12))
    return float(np.linalg.norm(matrix * scale[:, None] / scale, 2))
