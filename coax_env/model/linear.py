"""Linearisation about hover or any steady flight, from the same kernel that flies.

Central differences of `dynamics.full_derivative`, `dynamics.measure` and `dynamics.step`: there
are no linear equations here that could drift from the nonlinear ones.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from coax_env.model import dynamics
from coax_env.model.dynamics import WORK_SIZE, full_derivative, full_state, kernel_input
from coax_env.model.effects import CATALOGUE
from coax_env.model.layout import (
    ACTUATOR_STATES,
    CHANNELS,
    COMMANDS,
    GUSTS,
    N_CHANNELS,
    N_FULL,
    N_STATES,
    STATES,
)
from coax_env.model.trim import in_wind, trim
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

if TYPE_CHECKING:
    import control

WITHOUT_SLOPE = ("servo_play", "servo_deadband", "servo_rate", "dynamic_inflow")
"""Effects that designs leave out: a small command does not meet a servo's limits, or is not answered
at all; the inflow, a state that designs do not have, has settled."""
FASTEST_LAG = 1e-3  # [s] what an actuator without lag is given where its lag is a state
N_FLOWN = N_STATES + len(ACTUATOR_STATES)  # all but the gusts
N_SAMPLED = GUSTS.stop
_STEP = 1e-5  # of each quantity's own scale below: truncation and rounding errors both near 1e-10
_STATE_SCALE = np.array([1.0] * N_STATES + [100.0, 100.0, 1.0, 1.0] + [1.0] * (N_FULL - N_FLOWN))
_COMMAND_SCALE = np.array([100.0, 100.0, 1.0, 1.0])


def linearize(
    vehicle: Vehicle | str,
    full: bool = False,
    *,
    velocity: Sequence[float] = (0.0, 0.0),
    climb: float = 0.0,
    wind: Sequence[float] | None = None,
) -> "control.StateSpace":
    """The vehicle's small motions about a `trim`, as a continuous ``control.StateSpace``.

    States are the paper's sixteen (layout.STATES), inputs the four commands (layout.COMMANDS), both
    as deviations from trim, SI. Outputs are the readings of every canonical channel
    (layout.CHANNELS), so that C and D are those of the sensors. The row of ``v`` is zero at hover:
    the unsigned speed has no slope there.

    Args:
        full: add the actual rotor speeds and swash tilt as four more states. An actuator without
            lag gets FASTEST_LAG there; with ``full=False`` every lag is at its static limit. Pure
            delays (``command_delay``, ``servo_delay``) are in neither, nor what has no slope
            (WITHOUT_SLOPE); droop is, and a battery is at its nominal voltage.
        velocity: forward and right over ground [m/s]; with the others as in `trim`.
        climb: upwards [m/s].
        wind: velocity of the air towards north and east [m/s]; None: the vehicle's own.
    """
    import control

    vehicle = in_wind(load_vehicle(vehicle).without_effects(WITHOUT_SLOPE), wind)
    vehicle = with_lags(vehicle, None if full else 0.0)
    state, command = trim(vehicle, velocity, climb)
    x, u = full_state(state, command, vehicle), kernel_input(command)
    n = N_FLOWN if full else N_STATES
    A, B = _slopes_of_motion(vehicle, x, u)
    C = slopes(lambda x_: _readings(x_, u, vehicle), x, _STATE_SCALE)
    D = slopes(lambda u_: _readings(x, u_, vehicle), u, _COMMAND_SCALE)
    flight = "flight" if any((*velocity, climb)) else "hover"
    name = f"{flight}_{'full_' if full else ''}{vehicle.name}"
    return control.ss(
        A[:n, :n], B[:n], C[:, :n], D,
        states=[name for name, _ in (*STATES, *ACTUATOR_STATES)[:n]],
        inputs=[name for name, _ in COMMANDS],
        outputs=list(CHANNELS),
        name=name.replace(".", "_").replace("$", "_"),
    )  # fmt: skip


def hover_matrices(vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray]:
    """A (16, 16) and B (16, 4) of `linearize`, without python-control, lags static."""
    vehicle = with_lags(vehicle.without_effects(WITHOUT_SLOPE), 0.0)
    state, command = trim(vehicle)
    A, B = _slopes_of_motion(vehicle, full_state(state, command, vehicle), kernel_input(command))
    return A[:N_STATES, :N_STATES], B[:N_STATES]


def _slopes_of_motion(
    vehicle: Vehicle, x: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of the full derivative by the state and by the four commands."""
    A = slopes(lambda x_: full_derivative(x_, u, vehicle), x, _STATE_SCALE)
    B = slopes(lambda u_: full_derivative(x, u_, vehicle), u, _COMMAND_SCALE)
    return A, B


def sampled(
    vehicle: Vehicle, dt: float, velocity: Sequence[float] = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One control period of the kernel itself, linearised about hover or steady level flight.

    The state is the full one up to the gusts (26,): drifts of trim are the estimator's, and the inflow
    stays at hover's. Lags and held commands are those of `dynamics.step`, with nothing discretised a
    second time; pure delays and WITHOUT_SLOPE are left out. A reading is taken at a row's end, with the
    command that is in force there::

        x[k+1] = A x[k] + B u[k]        y[k] = C x[k] + D u[k-1]       (deviations from trim)

    In flight the trim's own position moves on.

    Args:
        vehicle: what flies.
        dt: control period [s].
        velocity: forward and right over ground [m/s].

    Returns:
        A (26, 26), B (26, 4), C (18, 26), D (18, 4), and the trim: full state (29,), command (4,).
    """
    vehicle = vehicle.without_effects(WITHOUT_SLOPE)
    state, command = trim(vehicle, velocity)
    x, u = full_state(state, command, vehicle), kernel_input(command)
    work = np.zeros(WORK_SIZE)

    def fly(x_: np.ndarray, u_: np.ndarray) -> np.ndarray:
        out = np.empty(N_FULL)
        dynamics.step(x_, u_, dt, vehicle.vector, work, out)
        return out

    A = slopes(lambda x_: fly(x_, u), x, _STATE_SCALE)
    B = slopes(lambda u_: fly(x, u_), u, _COMMAND_SCALE)
    C = slopes(lambda x_: _readings(x_, u, vehicle), x, _STATE_SCALE)
    D = slopes(lambda u_: _readings(x, u_, vehicle), u, _COMMAND_SCALE)
    n = N_SAMPLED
    return A[:n, :n], B[:n], C[:, :n], D, x, command


def slopes(
    function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Jacobian (n_out, len(scale)) of a function by central differences.

    Args:
        function: of a vector, gives a vector (n_out,). at: where (n,).
        scale: size of a usual change of each of the first inputs; the others are not moved.
    """
    columns = []
    for i, size in enumerate(scale):
        ahead, behind = at.copy(), at.copy()
        ahead[i] += _STEP * size
        behind[i] -= _STEP * size
        columns.append((function(ahead) - function(behind)) / (ahead[i] - behind[i]))
    return np.stack(columns, axis=1)


def with_lags(vehicle: Vehicle, lag: float | None) -> Vehicle:
    """A copy with every actuator lag set to `lag` [s]; None: at least FASTEST_LAG each."""
    values = vehicle.values()
    changed = vehicle
    for name in ("motor_lag", "servo_lag"):
        own = {p.name: values.get(f"{name}.{p.name}", 0.0) for p in CATALOGUE[name].parameters}
        if lag is not None and not any(own.values()):
            continue
        new = {k: max(v, FASTEST_LAG) if lag is None else lag for k, v in own.items()}
        changed = changed.with_effect(name, **new)
    return changed


def _readings(x: np.ndarray, u: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    out = np.empty(N_CHANNELS)
    dynamics.measure(x, u, vehicle.vector, np.zeros(WORK_SIZE), out)
    return out
