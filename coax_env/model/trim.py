"""Trim in steady flight: at any speed, climb and wind."""

from collections.abc import Sequence

import numpy as np

from coax_env.errors import InputError
from coax_env.model import state as S
from coax_env.model.dynamics import derivative, hover_trim
from coax_env.model.layout import ATTITUDE, FLYBAR, LOWER_FLAP, N_STATES, VELOCITY
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

STEADY = 1e-6  # [SI] largest rate of velocity, rates and flap that still counts as steady
_STEADY_RATES = slice(0, S.PHI)  # the first ten
_LARGEST_PART = 1.0  # [m/s] of the way to the flight asked for that is gone at once


def trim(
    vehicle: Vehicle | str,
    velocity: Sequence[float] = (0.0, 0.0),
    climb: float = 0.0,
    wind: Sequence[float] | None = None,
    height: float = 1.5,
) -> tuple[np.ndarray, np.ndarray]:
    """State (16,) and command (4,) of straight and steady flight with the nose to the north.

    SciPy's root finder on the kernel's derivative, from hover on in parts.

    Args:
        vehicle: shipped name, path or Vehicle.
        velocity: over ground, forward and right [m/s].
        climb: upwards [m/s].
        wind: velocity of the air towards north and east [m/s]; None: the vehicle's own.
        height: of the centre of gravity above ground [m]; matters near the ground only.

    Raises:
        InputError: the vehicle cannot fly so, or a number is not finite.
    """
    vehicle = in_wind(load_vehicle(vehicle), wind)
    asked = np.array([*velocity, -climb], dtype=float)
    if asked.shape != (3,) or not np.isfinite(asked).all():
        raise InputError("trim needs a velocity (forward, right) and a climb, all finite [m/s]")
    state, command = hover_trim(vehicle, height)
    if not asked.any():
        return state, command
    from scipy.optimize import root

    scale = np.concatenate([command[:2], np.full(8, 0.1)])
    z = np.concatenate([command, state[ATTITUDE][:2], state[LOWER_FLAP], state[FLYBAR]]) / scale
    parts = int(np.ceil(np.linalg.norm(asked) / _LARGEST_PART))
    for share in np.linspace(0.0, 1.0, parts + 1)[1:]:

        def residual(z: np.ndarray, over_ground: np.ndarray = share * asked) -> np.ndarray:
            state, command = _unpacked(z * scale, over_ground, height)
            return derivative(state, command, vehicle)[_STEADY_RATES]

        z = root(residual, z, tol=1e-12).x
    state, command = _unpacked(z * scale, asked, height)
    if not np.abs(residual(z)).max() < STEADY or command[:2].min() <= 0.0:
        raise InputError(
            f"vehicle {vehicle.name!r} has no steady flight at {velocity[0]:g} m/s forward, "
            f"{velocity[1]:g} right, {climb:g} up: its forces do not balance"
        )
    return state, command


def in_wind(vehicle: Vehicle, wind: Sequence[float] | None) -> Vehicle:
    """A vehicle in a steady wind towards north and east [m/s]; None: as it is."""
    if wind is None:
        return vehicle
    north, east = (float(part) for part in wind)
    if not np.isfinite([north, east]).all():
        raise InputError(f"a wind is two finite numbers [m/s], found {north:g}, {east:g}")
    return vehicle.with_effect("wind", north=north, east=east)


def _unpacked(
    z: np.ndarray, over_ground: np.ndarray, height: float
) -> tuple[np.ndarray, np.ndarray]:
    """State and command of the unknowns: commands, roll, pitch, lower flap, fly-bar, (10,)."""
    state = np.zeros(N_STATES)
    state[S.PHI], state[S.THETA] = z[4:6]
    state[LOWER_FLAP], state[FLYBAR] = z[6:8], z[8:10]
    state[S.Z] = -height
    state[VELOCITY] = _to_body(state[S.PHI], state[S.THETA]) @ over_ground
    return state, z[:4]


def _to_body(roll: float, pitch: float) -> np.ndarray:
    """What turns a vector from earth to body axes at heading north, (3, 3)."""
    (sin_r, cos_r), (sin_p, cos_p) = ((np.sin(a), np.cos(a)) for a in (roll, pitch))
    return np.array(
        [
            [cos_p, 0.0, -sin_p],
            [sin_r * sin_p, cos_r, sin_r * cos_p],
            [cos_r * sin_p, -sin_r, cos_r * cos_p],
        ]
    )
