"""Forces and moments that a vehicle file's equations give along a flight: the kernel, row by row.

What the regressions take as regressors, and what their coefficients should be, all comes from here, so
from equations (13)-(25) and (35)-(37) as the compiled model has them.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from coax_env.kernel.compilation import compiled
from coax_env.model import inputs as U
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model import workspace as F
from coax_env.model.dynamics import WORK_SIZE, measure
from coax_env.model.layout import N_CHANNELS, N_FULL, N_INPUTS
from coax_env.model.vehicle import Vehicle


class Loads(NamedTuple):
    """Thrusts and torques of the rotors, (15)-(20); force and moment on the body, (21)-(25), (35)-(37).

    In N and N m, body axes; the moment includes the gyroscopic one.
    """

    T_u: np.ndarray
    T_l: np.ndarray
    Q_u: np.ndarray
    Q_l: np.ndarray
    X: np.ndarray
    Y: np.ndarray
    Z: np.ndarray
    L: np.ndarray
    M: np.ndarray
    N: np.ndarray


_PLACES = (
    F.THRUST_U, F.THRUST_L, F.TORQUE_U, F.TORQUE_L,
    F.FORCE_X, F.FORCE_Y, F.FORCE_Z, F.MOMENT_X, F.MOMENT_Y, F.MOMENT_Z,
)  # fmt: skip


def loads(
    vehicle: Vehicle,
    omega_u: Any,
    omega_l: Any,
    alpha: tuple[Any, Any] = (0.0, 0.0),
    beta: tuple[Any, Any] = (0.0, 0.0),
    rates: tuple[Any, Any] = (0.0, 0.0),
) -> Loads:
    """Loads of a vehicle without its effects; arguments are broadcast, results have their shape.

    Args:
        vehicle: whose numbers. omega_u, omega_l: rotor speeds [rad/s].
        alpha, beta: tilts of the upper and of the lower disc, back and right [rad].
        rates: p and q [rad/s], for the gyroscopic moment.
    """
    p = vehicle.without_effects().vector
    bar = alpha[0] / p[P.FLYBAR_TO_ROTOR_LON], beta[0] / p[P.FLYBAR_TO_ROTOR_LAT]
    flat = np.broadcast_arrays(omega_u, omega_l, *bar, alpha[1], beta[1], *rates)
    rows = np.stack([np.ravel(column).astype(float) for column in flat], axis=-1)
    found = np.empty((len(_PLACES), len(rows)))
    _load_rows(rows, p, found)
    return Loads(*(part.reshape(np.shape(flat[0])) for part in found))


_OMEGA_U, _OMEGA_L, _ALPHA_F, _BETA_F, _ALPHA_L, _BETA_L, _P, _Q = range(8)


@compiled(makes_arrays=True)
def _load_rows(rows: np.ndarray, p: np.ndarray, found: np.ndarray) -> None:
    """Rows of omega_u, omega_l, alpha_f, beta_f, alpha_l, beta_l, p, q, (n, 8), to loads (10, n)."""
    x, u, work = np.zeros(N_FULL), np.zeros(N_INPUTS), np.empty(WORK_SIZE)
    readings = np.empty(N_CHANNELS)
    for i in range(len(rows)):
        u[U.OMEGA_U], u[U.OMEGA_L] = rows[i, _OMEGA_U], rows[i, _OMEGA_L]
        x[S.ALPHA_F], x[S.BETA_F] = rows[i, _ALPHA_F], rows[i, _BETA_F]
        x[S.ALPHA_L], x[S.BETA_L] = rows[i, _ALPHA_L], rows[i, _BETA_L]
        x[S.P], x[S.Q] = rows[i, _P], rows[i, _Q]
        measure(x, u, p, work, readings)
        for k in range(len(_PLACES)):
            found[k, i] = work[_PLACES[k]]


def scales(vehicle: Vehicle, omega_u: Any) -> tuple[Any, Any]:
    """1/2 rho pi R^4 w^2 [N] and 1/2 rho pi R^5 w^2 [N m] with w = omega_u, (61)-(63)."""
    radius = vehicle["rotor_radius"].value
    force = 0.5 * vehicle["air_density"].value * math.pi * radius**4 * omega_u**2
    return force, force * radius


def coefficients(columns: dict[str, Any], vehicle: Vehicle) -> dict[str, np.ndarray]:
    """C_X to C_n, (61)-(63), of a vehicle file at thrusts, tilts and rates; a_z and C_Z positive up.

    Args:
        columns: T_u, T_l [N], alpha_u, alpha_l, beta_u, beta_l [rad], p, q [rad/s], any one shape.
        vehicle: whose numbers.
    """
    unit = loads(vehicle, 1.0, 1.0)
    omega_u, omega_l = np.sqrt(columns["T_u"] / unit.T_u), np.sqrt(columns["T_l"] / unit.T_l)
    force, moment = scales(vehicle, omega_u)
    flown = loads(
        vehicle,
        omega_u,
        omega_l,
        (columns["alpha_u"], columns["alpha_l"]),
        (columns["beta_u"], columns["beta_l"]),
        (columns["p"], columns["q"]),
    )
    return {
        "C_X": flown.X / force, "C_Y": flown.Y / force, "C_Z": -flown.Z / force,
        "C_l": flown.L / moment, "C_m": flown.M / moment, "C_n": flown.N / moment,
    }  # fmt: skip
