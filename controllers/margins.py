"""Stability margins of an LQG design, from the frequency response of its loop.

Of the loop with the single-rate equivalent of the multi-rate filter, broken at the plant's inputs.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.env.period import DT
from coax_env.errors import InputError
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers.estimator_design import EstimatorDesign, integrated_readings, plant
from controllers.hinf import HInfinity
from controllers.lqr import LQG

INPUT_NAMES = ("rotor_upper", "rotor_lower", "swash_lon", "swash_lat")
WORST_DISTANCE = 3.0
"""Std from the mean within which the worst vehicle is looked for."""
_SEARCH_POINTS = 200  # frequencies while it is
_SLOPE_STEP = 0.3  # [std]


@dataclass(frozen=True)
class InputMargins:
    """Stability margins at one plant input, the other loops closed."""

    input: str
    gain_down: float  # the loop's gain may fall to this
    gain_up: float  # and rise to this
    phase_deg: float
    distance: float  # least |1 + L|
    crossover_hz: float  # where the phase margin is least


Design = LQG | HInfinity
Matrices = tuple[np.ndarray, ...]
"""A, B, C, D of a plant, see `estimator.plant`."""


def open_loop(controller: Design, vehicle: Vehicle | None = None) -> Any:
    """The loop broken at the plant's four inputs, as a discrete ``control.StateSpace``.

    The estimator is the single-rate equivalent of the periodic one: slow sensors taken as fast ones
    with as much more noise.

    Args:
        controller: the design.
        vehicle: the plant, where it is another than the one designed on.
    """
    design = controller.estimator
    own = (design.A, design.B, design.C, design.D)
    model = own if vehicle is None else plant(vehicle, design)
    own_system = _regulator(controller) if isinstance(controller, LQG) else controller.as_system()
    return own_system * _plant(model, design)


def _plant(model: Matrices, design: EstimatorDesign) -> Any:
    """From actions to readings; states: those of the model, then the command in force (4,)."""
    import control

    n, m = len(design.states), len(design.readings)
    S = np.diag(design.action_scale)
    A, B, C, D = model
    return control.ss(
        np.block([[A, np.zeros((n, 4))], [np.zeros((4, n)), np.zeros((4, 4))]]),
        np.vstack([B @ S, S]),
        np.hstack([C, D]),
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
    controller: Design, vehicle: Vehicle | None = None, points: int = 1000
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequency responses of `open_loop` up to Nyquist.

    Args:
        controller, vehicle: as in `open_loop`.
        points: frequencies.

    Returns:
        frequencies [rad/s] (w,); the whole loop (w, 4, 4); the loop of each input with the others
        closed (w, 4).
    """
    omega, L = _frequency_response(open_loop(controller, vehicle), points)
    single = np.empty(L.shape[:2], dtype=complex)
    for k in range(4):
        rest = [i for i in range(4) if i != k]
        others = np.linalg.solve(np.eye(3) + L[:, rest][:, :, rest], L[:, rest, k : k + 1])
        single[:, k] = L[:, k, k] - (L[:, k : k + 1, rest] @ others)[:, 0, 0]
    return omega, L, single


def _frequency_response(loop: Any, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies up to Nyquist [rad/s] (w,), and a loop's response (w, 4, 4)."""
    omega = np.append(np.geomspace(1e-3, 0.99 * math.pi / DT, points), math.pi / DT)
    return omega, np.moveaxis(loop.frequency_response(omega).frdata, -1, 0)


def sensitivities(L: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest singular values of S = (1 + L)^-1 and T = L S at the inputs, (w,) each.

    Args:
        L: frequency response of the loop, (w, 4, 4).
    """
    S = np.linalg.inv(np.eye(4) + L)
    return np.linalg.norm(S, 2, axis=(1, 2)), np.linalg.norm(np.eye(4) - S, 2, axis=(1, 2))


def stability_margins(controller: Design) -> tuple[list[InputMargins], float]:
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
    controller: Design, vehicle: str | Vehicle, draws: int = 20, seed: int = 0
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
    vehicle = load_vehicle(vehicle)
    rng = np.random.default_rng(seed)
    return np.array([disk_margin(controller, vehicle.draw(rng)) for _ in range(draws)])


@dataclass(frozen=True)
class WorstVehicle:
    """The vehicle within a distance of the mean on which a controller has the least disk margin."""

    disk: float  # 0 where the loop is unstable
    vehicle: Vehicle
    moves: dict[str, float]  # std by which each number is off its mean, largest first


def worst_over_spread(
    controller: Design,
    vehicle: str | Vehicle,
    distance: float = WORST_DISTANCE,
    rounds: int = 3,
    draws: int = 20,
    seed: int = 0,
) -> WorstVehicle:
    """The least disk margin over all vehicles that are so many std from the mean.

    Against the slope of the margin, from the mean and from the worst of some draws: a search, and
    so an upper bound of the true worst case, near it as far as the margin is smooth.

    Args:
        controller: the design.
        vehicle: whose parameters' stds and correlations give the spread.
        distance: std, of all numbers together.
        rounds: steps to the boundary, each from where the last one ended.
        draws: directions tried by chance, too.
        seed: of these.
    """
    vehicle = load_vehicle(vehicle)
    spread = vehicle.spread()
    free = np.flatnonzero(spread.std > 0.0)
    found: dict[bytes, float] = {}

    def margin(z: np.ndarray) -> float:
        key = z.tobytes()
        if key not in found:
            found[key] = disk_margin(controller, vehicle.at(z), _SEARCH_POINTS)
        return found[key]

    def against_the_slope(z: np.ndarray) -> np.ndarray:
        here, slope = margin(z), np.zeros(len(z))
        for at in free:
            step = np.zeros(len(z))
            step[at] = _SLOPE_STEP
            slope[at] = margin(z + step) - here
        size = np.linalg.norm(slope)
        return z if size == 0.0 else -distance * slope / size

    tried = [np.zeros(len(spread.names))]
    rng = np.random.default_rng(seed)
    for _ in range(draws if len(free) else 0):
        z = np.zeros(len(spread.names))
        z[free] = rng.standard_normal(len(free))
        tried.append(distance * z / np.linalg.norm(z))
    for start in (tried[0], min(tried, key=margin)):
        for _ in range(rounds):
            start = against_the_slope(start)
            tried.append(start)
            if margin(start) == 0.0:
                break
    worst = min(tried, key=margin)
    order = np.argsort(-np.abs(worst))
    moves = {spread.names[k]: float(worst[k]) for k in order if worst[k] != 0.0}
    return WorstVehicle(disk_margin(controller, vehicle.at(worst)), vehicle.at(worst), moves)


def disk_margin(controller: Design, vehicle: Vehicle, points: int = 1000) -> float:
    """Disk margin of all inputs at once on a vehicle; 0 where the loop is unstable.

    Args:
        controller: the design. vehicle: the plant. points: frequencies.
    """
    import control

    try:
        loop = open_loop(controller, vehicle)
    except InputError:  # it has no hover
        return 0.0
    closed = control.feedback(loop, np.eye(4))
    if np.abs(closed.poles()).max() >= 1.0:
        return 0.0
    return _disk_margin(_frequency_response(loop, points)[1])


def _disk_margin(L: np.ndarray) -> float:
    """Disk margin of a loop's frequency response (w, 4, 4), all inputs at once."""
    S = np.linalg.inv(np.eye(4) + L)
    return 1.0 / float(_mu_upper_bounds(S - 0.5 * np.eye(4)).max())  # (S - T)/2


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


def _mu_upper_bounds(matrices: np.ndarray) -> np.ndarray:
    """Upper bounds of the structured singular value for diagonal uncertainty (Osborne scaling).

    Args:
        matrices: (w, k, k).
    """
    size = matrices.shape[-1]
    off_diagonal = 1.0 - np.eye(size)
    scale = np.ones(matrices.shape[:2])
    for _ in range(30):
        off = np.abs(matrices * scale[:, :, None] / scale[:, None, :]) * off_diagonal
        rows, columns = np.linalg.norm(off, axis=2), np.linalg.norm(off, axis=1)
        scale *= np.sqrt(np.maximum(columns, 1e-12) / np.maximum(rows, 1e-12))
    return np.linalg.norm(matrices * scale[:, :, None] / scale[:, None, :], 2, axis=(1, 2))
