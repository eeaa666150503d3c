"""Columns of the regressions: what a run's sensors and the vehicle file's equations say row by row.

Every column, the response too, goes through the same low-pass, so that a linear relation stays one.
The errors of a row (total least squares needs their covariance) are found by putting draws of the
sensors' noise through the same flow: the flap angles inherit the gyro's error, thrusts and response
share the rotor speed's.

Signs: a_z and C_Z are positive up here, as the paper plots them; the rest is in body axes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coax_env.identification.two_step.loads import loads, scales
from coax_env.identification.two_step.processing import even_grid, lagrange_derivative, low_pass
from coax_env.identification.two_step.reconstruction import flapping
from coax_env.logs.flight import Run
from coax_env.model import inputs as U
from coax_env.model.layout import INERTIAL, ROTOR_SPEEDS
from coax_env.model.vehicle import Vehicle

EDGE = 0.5
"""Seconds at either end of a run that are left out: the filter's and the flap angles' transients."""
DRAWS = 60
"""Of the sensors' noise, per run."""
Columns = dict[str, np.ndarray]
EXACT = ("1", "delta_lon", "delta_lat")
"""Columns without error: the intercept and the swash commands."""


@dataclass(frozen=True)
class Rows:
    """Low-passed columns of the runs that a mode uses, one after the other.

    errors: (n, draws) per column, what the sensors' noise does to it. lengths: rows of each run.
    """

    columns: Columns
    errors: Columns
    lengths: tuple[int, ...]
    t: np.ndarray


def rows_of(
    run: Run, vehicle: Vehicle, noise: Mapping[str, float], cutoff: float, seed: int = 0
) -> Rows:
    """A run's low-passed columns, and what the sensors' noise does to them.

    Args:
        run: with gyros and accelerometers. vehicle: whose numbers the columns take.
        noise: std of each channel. cutoff: of the low-pass [Hz]. seed: of the draws of the noise.
    """
    rng = np.random.default_rng(seed)
    dt, t, signals = even_grid(run, (*INERTIAL, *ROTOR_SPEEDS))
    held = np.searchsorted(run.t, t + 1e-9, side="right") - 1
    command = run.command[held]
    edge = round(EDGE / dt)
    kept = slice(edge, len(t) - edge)
    clean = columns_of(signals, command, dt, vehicle)
    disturbed = {
        channel: values[:, None] + _noise(run, channel, t, noise, rng)
        for channel, values in signals.items()
    }
    noisy = columns_of(disturbed, command[:, :, None], dt, vehicle)
    columns, errors = {}, {}
    for name, values in clean.items():
        columns[name] = low_pass(values, dt, cutoff)[kept]
        if name not in EXACT:
            moved = np.broadcast_to(noisy[name].T, (DRAWS, len(t))).T - values[:, None]
            errors[name] = low_pass(moved, dt, cutoff)[kept]
    return Rows(columns, errors, (len(t[kept]),), t[kept] - t[0])


def joined(parts: Sequence[Rows]) -> Rows:
    """Rows of several runs, one after the other."""
    names = set.intersection(*(set(part.columns) for part in parts))
    return Rows(
        {n: np.concatenate([part.columns[n] for part in parts]) for n in names},
        {n: np.concatenate([part.errors[n] for part in parts]) for n in names - set(EXACT)},
        tuple(length for part in parts for length in part.lengths),
        np.concatenate([part.t for part in parts]),
    )


def _noise(
    run: Run, channel: str, t: np.ndarray, noise: Mapping[str, float], rng: np.random.Generator
) -> np.ndarray:
    """Draws of a sensor's noise on the even grid (n, DRAWS), at the rate at which it was read."""
    there = np.flatnonzero(np.isfinite(run.measured[channel]))
    if len(there) > 0.8 * len(t):
        return noise[channel] * rng.standard_normal((len(t), DRAWS))
    read = noise[channel] * rng.standard_normal((len(there), DRAWS))
    return np.column_stack([np.interp(t, run.t[there], column) for column in read.T])


def _tilts(
    signals: Mapping[str, np.ndarray],
    delta_lon: np.ndarray,
    delta_lat: np.ndarray,
    dt: float,
    p: Mapping[str, float],
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Tilts [rad] of the upper and of the lower disc, back and right, by (26)-(29) from rest."""
    bar, flap = p["flybar_time_constant"], p["flap_time_constant"]
    alpha_u = p["flybar_to_rotor_lon"] * flapping(signals["q"], 0.0, dt, bar, 0.0)
    beta_u = p["flybar_to_rotor_lat"] * flapping(signals["p"], 0.0, dt, bar, 0.0)
    alpha_l = flapping(signals["q"], delta_lon, dt, flap, p["swash_to_flap"])
    beta_l = flapping(signals["p"], delta_lat, dt, flap, p["swash_to_flap"])
    return (alpha_u, alpha_l), (beta_u, beta_l)


def columns_of(
    signals: Mapping[str, np.ndarray], command: np.ndarray, dt: float, vehicle: Vehicle
) -> Columns:
    """Every column of a run on an even grid.

    Args:
        signals: channel -> (n,) or (n, draws). command: (n, 4) or (n, 4, 1). dt: seconds per row.
        vehicle: whose numbers the columns take.
    """
    p = {name: parameter.value for name, parameter in vehicle.parameters.items()}
    omega_u, omega_l = (
        signals[rpm] * math.pi / 30.0 if rpm in signals else command[:, i]
        for i, rpm in ((U.OMEGA_U, "rpm_upper"), (U.OMEGA_L, "rpm_lower"))
    )
    force, moment = scales(vehicle, omega_u)
    delta_lon, delta_lat = command[:, U.DELTA_LON], command[:, U.DELTA_LAT]
    tilts = (alpha_u, alpha_l), (beta_u, beta_l) = _tilts(signals, delta_lon, delta_lat, dt, p)
    flown = loads(vehicle, omega_u, omega_l, *tilts, (signals["p"], signals["q"]))
    moment_x, moment_y, moment_z = (
        p[inertia] * lagrange_derivative(signals[rate], dt)
        for inertia, rate in (("inertia_xx", "p"), ("inertia_yy", "q"), ("inertia_zz", "r"))
    )
    return {
        "1": np.ones(len(command)),
        "delta_lon": delta_lon if delta_lon.ndim == 1 else delta_lon[:, 0],
        "delta_lat": delta_lat if delta_lat.ndim == 1 else delta_lat[:, 0],
        "alpha_u": alpha_u,
        "beta_u": beta_u,
        "alpha_l": alpha_l,
        "beta_l": beta_l,
        "p": signals["p"],
        "q": signals["q"],
        "r": signals["r"],
        "T_u": flown.T_u,
        "T_l": flown.T_l,
        "Q_u": flown.Q_u,
        "Q_l": flown.Q_l,
        "C_X": p["mass"] * signals["ax"] / force,
        "C_Y": p["mass"] * signals["ay"] / force,
        "C_Z": -p["mass"] * signals["az"] / force,
        "C_l": moment_x / moment,
        "C_m": moment_y / moment,
        "C_n": moment_z / moment,
        # the same in newtons and with what ties them pooled: PHYSICS
        "weight": -p["mass"] * signals["az"],
        "lift_u": -loads(vehicle, omega_u, 0.0, *tilts).Z,
        "lift_l": -loads(vehicle, 0.0, omega_l, *tilts).Z,
        "moment_z": moment_z,
        "against_l": -flown.Q_l,
        "moment_y": moment_y,
        "driven_y": flown.M,
        "moment_x": moment_x,
        "driven_x": flown.L,
    }
