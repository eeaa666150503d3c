"""Linearisation about hover, from the same kernel that flies.

Central differences of `dynamics.full_derivative`, `dynamics.measure` and `dynamics.step`: there
are no linear equations here that could drift from the nonlinear ones.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from coax_env.model import dynamics
from coax_env.model.dynamics import WORK_SIZE, full_derivative, full_state, hover_trim, kernel_input
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


def linearize(vehicle: Vehicle | str, full: bool = False) -> "control.StateSpace":
    """The vehicle's small motions about `hover_trim`, as a continuous ``control.StateSpace``.

    States are the paper's sixteen (layout.STATES), inputs the four commands (layout.COMMANDS), both
    as deviations from trim, SI. Outputs are the readings of every canonical channel
    (layout.CHANNELS), so that C and D are those of the sensors. The row of ``v`` is zero: the
    unsigned speed has no slope at hover.

    Args:
        full: add the actual rotor speeds and swash tilt as four more states. An actuator without
            lag gets FASTEST_LAG there; with ``full=False`` every lag is at its static limit. Pure
            delays (``command_delay``, ``servo_delay``) are in neither, nor what has no slope
            (WITHOUT_SLOPE); droop is, and a battery is at its nominal voltage.
    """
    import control

    vehicle = with_lags(load_vehicle(vehicle).without_effects(WITHOUT_SLOPE), None if full else 0.0)
    state, command = hover_trim(vehicle)
    x, u = full_state(state, command, vehicle), kernel_input(command)
    n = N_FLOWN if full else N_STATES
    A = slopes(lambda x_: full_derivative(x_, u, vehicle), x, _STATE_SCALE)
    B = slopes(lambda u_: full_derivative(x, u_, vehicle), u, _COMMAND_SCALE)
    C = slopes(lambda x_: _readings(x_, u, vehicle), x, _STATE_SCALE)
    D = slopes(lambda u_: _readings(x, u_, vehicle), u, _COMMAND_SCALE)
    return control.ss(
        A[:n, :n], B[:n], C[:, :n], D,
        states=[name for name, _ in (*STATES, *ACTUATOR_STATES)[:n]],
        inputs=[name for name, _ in COMMANDS],
        outputs=list(CHANNELS),
        name=f"hover_{'full_' if full else ''}{vehicle.name}".replace(".", "_").replace("$", "_"),
    )  # fmt: skip


def sampled(
    vehicle: Vehicle, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One control period of the kernel itself, linearised about hover.

    The state is the full one up to the gusts (26,): drifts of trim are the estimator's, and the inflow
    stays at hover's. Lags and held commands are those of `dynamics.step`, with nothing discretised a
    second time; pure delays and WITHOUT_SLOPE are left out. A reading is taken at a row's end, with the
    command that is in force there::

        x[k+1] = A x[k] + B u[k]        y[k] = C x[k] + D u[k-1]       (deviations from trim)

    Args:
        dt: control period [s].

    Returns:
        A (26, 26), B (26, 4), C (18, 26), D (18, 4), and the trim: full state (29,), command (4,).
    """
    vehicle = vehicle.without_effects(WITHOUT_SLOPE)
    state, command = hover_trim(vehicle)
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
