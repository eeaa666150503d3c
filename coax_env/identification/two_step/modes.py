"""Step 2 of the paper's method: force and moment coefficients as regressions, (61)-(69).

Data flow of a run::

    even grid -> rotor speeds, thrusts, flap angles, accelerations -> columns -> low-pass -> rows

Every column of a regression, the response too, goes through the same low-pass, so that a linear
relation stays one. The errors of a row (total least squares needs their covariance) are found by
putting draws of the sensors' noise through the same flow: the flap angles inherit the gyro's error,
thrusts and response share the rotor speed's.

Signs: a_z and C_Z are positive up here, as the paper plots them; the rest is in body axes.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coax_env.identification.two_step.processing import even_grid, lagrange_derivative, low_pass
from coax_env.identification.two_step.reconstruction import flapping
from coax_env.identification.two_step.regression import (
    Collinearity,
    Regression,
    collinearity,
    least_squares,
    total_least_squares,
)
from coax_env.logs.flight import Run
from coax_env.model.vehicle import Vehicle

EDGE = 0.5
"""Seconds at either end of a run that are left out: the filter and the flap angles settle there."""
DRAWS = 60
"""Of the sensors' noise, per run."""
STILL = 4.0
"""A regressor whose variance is not so many times its error's did not move."""
IMU = ("p", "q", "r", "ax", "ay", "az")
Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Mode:
    """One regression of the paper's form.

    response: column that is explained. regressors: columns beside the intercept. completed: columns
    that the physics has and the paper's regression has not. axis: of STIR, whose movement makes a run
    one for this mode.
    """

    name: str
    response: str
    regressors: tuple[str, ...]
    completed: tuple[str, ...]
    axis: str
    source: str


_LON = ("alpha_u", "alpha_l", "q", "delta_lon", "T_l", "T_u")
_LAT = ("beta_u", "beta_l", "p", "delta_lat", "T_l", "T_u")
MODES = (
    Mode("longitudinal force", "C_X", _LON, (), "delta_lon", "(64), (67)"),
    Mode("vertical force", "C_Z", _LON, (), "delta_lon", "(65), (68)"),
    Mode("pitching moment", "C_m", _LON, ("p",), "delta_lon", "(66), (69); p: the p H of (36)"),
    Mode("lateral force", "C_Y", _LAT, (), "delta_lat", "as (64); left open by the paper"),
    Mode("rolling moment", "C_l", _LAT, ("q",), "delta_lat", "as (66); q: the q H of (35)"),
    Mode("heave", "C_Z", ("T_l", "T_u"), (), "collective", "as (65); left open by the paper"),
    Mode(
        "yawing moment", "C_n", ("Q_l", "Q_u"), (), "differential", "(37); left open by the paper"
    ),
)


@dataclass(frozen=True)
class Physics:
    """A regression whose coefficients are 1 where the vehicle file is right.

    What eq (26) ties is pooled in one column, the missing gyroscopic moment is in it, and nothing is
    divided by a rotor speed: the remedy for what Table VIII hides. parameters: the file's number that
    each regressor's coefficient multiplies (power 1) or divides (power -1). axes: of STIR, any of which
    makes a run one for it.
    """

    name: str
    response: str
    regressors: tuple[str, ...]
    parameters: tuple[str, ...]
    power: int
    offset: bool
    axes: tuple[str, ...]


PHYSICS = (
    Physics("lift", "weight", ("lift_u", "lift_l"),
            ("thrust_coefficient_upper", "thrust_coefficient_lower"), 1, False,
            ("collective", "differential")),
    Physics("torque", "moment_z", ("Q_u", "against_l"),
            ("torque_coefficient_upper", "torque_coefficient_lower"), 1, False,
            ("collective", "differential")),
    Physics("pitch", "moment_y", ("driven_y",), ("inertia_yy",), -1, True, ("delta_lon",)),
    Physics("roll", "moment_x", ("driven_x",), ("inertia_xx",), -1, True, ("delta_lat",)),
)  # fmt: skip
EXACT = ("1", "delta_lon", "delta_lat")
"""Columns without error: the intercept and what the servos are told."""
STIR = {"delta_lon": 0.015, "delta_lat": 0.015, "collective": 0.01, "differential": 0.005}
"""Std of a command above which a run stirs its mode: swash tilt [rad], half the sum and half the
difference of the rotor speeds over their means. Less is the pilot's own work, which follows the gusts
and so makes a poor regressor (numerics.md)."""
_THROTTLE = ("collective", "differential")


@dataclass(frozen=True)
class Rows:
    """Low-passed columns of the runs that a mode uses, one after the other.

    errors: (n, draws) per column, what the sensors' noise does to it. lengths: rows of each run.
    """

    columns: Columns
    errors: Columns
    lengths: tuple[int, ...]
    t: np.ndarray


@dataclass(frozen=True)
class ModeFit:
    """A mode's regressions on the same rows.

    expected: coefficient -> what the vehicle file's physics gives. still: regressors that did not move
    beyond their errors and so were left out. completed: total least squares with the missing term.
    """

    mode: Mode
    rows: Rows
    runs: tuple[str, ...]
    ordinary: Regression
    total: Regression
    completed: Regression | None
    expected: dict[str, float]
    still: tuple[str, ...]
    tied: Collinearity


def fit_mode(
    mode: Mode, runs: Sequence[Run], parts: Mapping[str, Rows], vehicle: Vehicle
) -> ModeFit | None:
    """A mode's regressions on the runs that stir it; None where none does.

    parts: rows by run.
    """
    stirred = [run for run in runs if stir(run, mode.axis) > STIR[mode.axis]]
    if not stirred:
        return None
    rows = joined([parts[run.name] for run in stirred])
    moving: list[str] = []
    still: list[str] = []
    throttled = any(stir(run, axis) > STIR[axis] for run in stirred for axis in _THROTTLE)
    for name in mode.regressors:
        error = rows.errors[name].var() if name not in EXACT else 0.0
        moved = _spread(rows, name) > max(STILL * error, 1e-16)
        moved &= throttled or name not in ("T_l", "T_u")
        (moving if moved else still).append(name)
    if not moving:
        return None
    expected = expectation(mode, rows, vehicle, moving)
    return ModeFit(
        mode,
        rows,
        tuple(run.name for run in stirred),
        _regress(rows, mode.response, moving, total=False),
        _regress(rows, mode.response, moving),
        _regress(rows, mode.response, [*moving, *mode.completed]) if mode.completed else None,
        expected,
        tuple(still),
        collinearity(np.column_stack([rows.columns[n] for n in moving]), moving),
    )


def stir(run: Run, axis: str) -> float:
    """Std of a run's command along an axis of STIR."""
    upper, lower = (run.command[:, i] / max(run.command[:, i].mean(), 1e-9) for i in (0, 1))
    moves = {
        "delta_lon": run.command[:, 2],
        "delta_lat": run.command[:, 3],
        "collective": 0.5 * (upper + lower),
        "differential": 0.5 * (upper - lower),
    }
    return float(moves[axis].std())


def _spread(rows: Rows, name: str) -> float:
    """Variance of a column about each run's mean."""
    parts = np.split(rows.columns[name], np.cumsum(rows.lengths)[:-1])
    return float(np.mean(np.concatenate([part - part.mean() for part in parts]) ** 2))


def fit_physics(physics: Physics, rows: Rows) -> Regression | None:
    """Total least squares of a pooled form; None where what moves does not stand out of its errors."""
    fit = _regress(rows, physics.response, physics.regressors, offset=physics.offset)
    return fit if fit.trusted else None


def _regress(
    rows: Rows,
    response: str,
    regressors: Sequence[str],
    total: bool = True,
    offset: bool = True,
) -> Regression:
    names = ["1", *regressors] if offset else list(regressors)
    X = np.column_stack([rows.columns[n] for n in names])
    y = rows.columns[response]
    if not total:
        return least_squares(X, y, names, rows.lengths)
    exact = [n in EXACT for n in names]
    noisy = [n for n, known in zip(names, exact, strict=True) if not known]
    draws = np.stack([rows.errors[n].T for n in (*noisy, response)], axis=-1)
    errors = np.cov(draws.reshape(-1, draws.shape[-1]).T)
    return total_least_squares(X, y, names, errors, exact, rows.lengths, draws)


# --- columns ------------------------------------------------------------------------------------------


def rows_of(
    run: Run, vehicle: Vehicle, noise: Mapping[str, float], cutoff: float, seed: int = 0
) -> Rows:
    """A run's low-passed columns, and what the sensors' noise does to them."""
    rng = np.random.default_rng(seed)
    dt, t, signals = even_grid(run, (*IMU, "rpm_upper", "rpm_lower"))
    held = np.searchsorted(run.t, t + 1e-9, side="right") - 1
    command = run.command[held]
    edge = round(EDGE / dt)
    kept = slice(edge, len(t) - edge)
    clean = _columns(signals, command, dt, vehicle)
    shaken = {
        channel: values[:, None] + _noise(run, channel, t, noise, rng)
        for channel, values in signals.items()
    }
    noisy = _columns(shaken, command[:, :, None], dt, vehicle)
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


def _columns(
    signals: Mapping[str, np.ndarray], command: np.ndarray, dt: float, vehicle: Vehicle
) -> Columns:
    """Every column, from signals (n,) or (n, draws) and commands (n, 4) or (n, 4, 1)."""
    p = {name: parameter.value for name, parameter in vehicle.parameters.items()}
    speeds = [
        signals[rpm] * math.pi / 30.0 if rpm in signals else command[:, i]
        for i, rpm in enumerate(("rpm_upper", "rpm_lower"))
    ]
    force, moment = scales(vehicle, speeds[0])
    tau, bar = p["flap_time_constant"], p["flybar_time_constant"]
    delta_lon, delta_lat = command[:, 2], command[:, 3]
    T_u, T_l, Q_u, Q_l = thrusts(vehicle, speeds[0], speeds[1])
    alpha_u = p["flybar_to_rotor_lon"] * flapping(signals["q"], 0.0, dt, bar, 0.0)
    beta_u = p["flybar_to_rotor_lat"] * flapping(signals["p"], 0.0, dt, bar, 0.0)
    alpha_l = flapping(signals["q"], delta_lon, dt, tau, p["swash_to_flap"])
    beta_l = flapping(signals["p"], delta_lat, dt, tau, p["swash_to_flap"])
    tilted = {"T_u": T_u, "T_l": T_l, "alpha_u": alpha_u, "alpha_l": alpha_l,
              "beta_u": beta_u, "beta_l": beta_l}  # fmt: skip
    turning = momentum(tilted, vehicle)
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
        "T_u": T_u,
        "T_l": T_l,
        "Q_u": Q_u,
        "Q_l": Q_l,
        "C_X": p["mass"] * signals["ax"] / force,
        "C_Y": p["mass"] * signals["ay"] / force,
        "C_Z": -p["mass"] * signals["az"] / force,
        "C_l": moment_x / moment,
        "C_m": moment_y / moment,
        "C_n": moment_z / moment,
        # the same in newtons and with what ties them pooled: PHYSICS
        "weight": -p["mass"] * signals["az"],
        "lift_u": T_u * (_upright(alpha_u, beta_u) - download(vehicle)),
        "lift_l": T_l * _upright(alpha_l, beta_l),
        "moment_z": moment_z,
        "against_l": -Q_l,
        "moment_y": moment_y,
        "driven_y": side_moment(tilted, vehicle, "alpha_u", "alpha_l") + signals["p"] * turning,
        "moment_x": moment_x,
        "driven_x": side_moment(tilted, vehicle, "beta_u", "beta_l") - signals["q"] * turning,
    }


def _upright(alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Share of a tilted thrust that lifts, (13)-(14)."""
    return 1.0 / np.sqrt(1.0 + np.tan(alpha) ** 2 + np.tan(beta) ** 2)


def _thrust_factor(vehicle: Vehicle) -> float:
    """k_T = rho pi R^4 [kg m], of (15)-(20)."""
    return float(vehicle["air_density"].value * math.pi * vehicle["rotor_radius"].value ** 4)


def scales(vehicle: Vehicle, omega_u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """1/2 rho pi R^4 w^2 [N] and 1/2 rho pi R^5 w^2 [N m] with w = omega_u, (61)-(63)."""
    force = 0.5 * _thrust_factor(vehicle) * omega_u**2
    return force, force * vehicle["rotor_radius"].value


def thrusts(
    vehicle: Vehicle, omega_u: np.ndarray, omega_l: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """T_u, T_l [N], Q_u, Q_l [N m] of the vehicle file, (15)-(20)."""
    p = {name: parameter.value for name, parameter in vehicle.parameters.items()}
    k_T = _thrust_factor(vehicle)
    k_Q = k_T * p["rotor_radius"]
    return (
        p["thrust_coefficient_upper"] * k_T * omega_u**2,
        p["thrust_coefficient_lower"] * k_T * omega_l**2,
        p["torque_coefficient_upper"] * k_Q * omega_u**2,
        p["torque_coefficient_lower"] * k_Q * omega_l**2,
    )


# --- what the physics gives ---------------------------------------------------------------------------


def expectation(
    mode: Mode, rows: Rows, vehicle: Vehicle, regressors: Sequence[str]
) -> dict[str, float]:
    """Coefficients that the vehicle file's equations give: their value along the rows, regressed.

    So what is nonlinear in them (lift over thrust, the tilt's cosine) falls where the data let it.
    """
    names = ["1", *regressors, *mode.completed]
    X = np.column_stack([rows.columns[n] for n in names])
    law = _LAWS[mode.response](rows.columns, vehicle)
    values, *_ = np.linalg.lstsq(X / (size := np.abs(X).max(axis=0)), law, rcond=1e-10)
    return dict(zip(names, (values / size).tolist(), strict=True))


Law = Callable[[Columns, Vehicle], np.ndarray]


def _speed(x: Columns, vehicle: Vehicle) -> np.ndarray:
    """Upper rotor's speed from its thrust."""
    k_T = _thrust_factor(vehicle)
    return np.sqrt(x["T_u"] / (vehicle["thrust_coefficient_upper"].value * k_T))


def _force_law(tilt_u: str, tilt_l: str, sign: float) -> Law:
    def law(x: Columns, vehicle: Vehicle) -> np.ndarray:
        force, _ = scales(vehicle, _speed(x, vehicle))
        return sign * (x["T_u"] * np.tan(x[tilt_u]) + x["T_l"] * np.tan(x[tilt_l])) / force

    return law


def _lift_law(x: Columns, vehicle: Vehicle) -> np.ndarray:
    force, _ = scales(vehicle, _speed(x, vehicle))
    upper = _upright(x["alpha_u"], x["beta_u"]) - download(vehicle)
    return (x["T_u"] * upper + x["T_l"] * _upright(x["alpha_l"], x["beta_l"])) / force


def _moment_law(tilt_u: str, tilt_l: str, turn: str, sign: float) -> Law:
    """I w' = arms times side forces, and the gyroscopic moment, (35)-(36)."""

    def law(x: Columns, vehicle: Vehicle) -> np.ndarray:
        _, moment = scales(vehicle, _speed(x, vehicle))
        turning = sign * x[turn] * momentum(x, vehicle)
        return (side_moment(x, vehicle, tilt_u, tilt_l) + turning) / moment

    return law


def side_moment(x: Columns, vehicle: Vehicle, tilt_u: str, tilt_l: str) -> np.ndarray:
    """Moment of the tilted thrusts about the centre of gravity [N m]."""
    upper = vehicle["arm_upper"].value * x["T_u"] * np.tan(x[tilt_u])
    return upper + vehicle["arm_lower"].value * x["T_l"] * np.tan(x[tilt_l])


def momentum(x: Columns, vehicle: Vehicle) -> np.ndarray:
    """H = J_l w_l - (J_u + J_f) w_u [kg m2/s]."""
    k_T = _thrust_factor(vehicle)
    omega_l = np.sqrt(x["T_l"] / (vehicle["thrust_coefficient_lower"].value * k_T))
    upper = vehicle["rotor_inertia_upper"].value + vehicle["flybar_inertia"].value
    return vehicle["rotor_inertia_lower"].value * omega_l - upper * _speed(x, vehicle)


def _yaw_law(x: Columns, vehicle: Vehicle) -> np.ndarray:
    _, moment = scales(vehicle, _speed(x, vehicle))
    return (x["Q_u"] - x["Q_l"]) / moment


def download(vehicle: Vehicle) -> float:
    """Share of the upper thrust that its wake on the fuselage takes back, (21)."""
    area = vehicle["fuselage_length"].value * vehicle["fuselage_width"].value
    area *= vehicle["fuselage_drag_coefficient"].value
    return float(area / (4.0 * math.pi * vehicle["rotor_radius"].value ** 2))


_LAWS: dict[str, Law] = {
    "C_X": _force_law("alpha_u", "alpha_l", -1.0),
    "C_Y": _force_law("beta_u", "beta_l", 1.0),
    "C_Z": _lift_law,
    "C_m": _moment_law("alpha_u", "alpha_l", "p", 1.0),
    "C_l": _moment_law("beta_u", "beta_l", "q", -1.0),
    "C_n": _yaw_law,
}
