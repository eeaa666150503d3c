"""Step 2 of the paper's method: force and moment coefficients as regressions, (61)-(69).

Data flow of a run::

    even grid -> rotor speeds, thrusts, flap angles, accelerations -> columns -> low-pass -> rows
              -> least squares, total least squares; what the vehicle file's equations give for each
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coax_env.identification.two_step.columns import EXACT, Rows, joined
from coax_env.identification.two_step.loads import coefficients
from coax_env.identification.two_step.regression import (
    Collinearity,
    Regression,
    collinearity,
    least_squares,
    total_least_squares,
)
from coax_env.logs.flight import Run
from coax_env.model.vehicle import Vehicle

LEAST_VARIANCE_RATIO = 4.0
"""A regressor whose variance is not so many times its error's did not move."""


@dataclass(frozen=True)
class Mode:
    """One regression of the paper's form.

    response: column that is explained. regressors: columns beside the intercept. completed: columns
    that the physics has and the paper's regression has not. axis: of
    LEAST_MOVEMENT, along which a run must move to be one for this mode.
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
    each regressor's coefficient multiplies (power 1) or divides (power -1). axes: of
    LEAST_MOVEMENT, along any of which a run must move to be one for it.
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
LEAST_MOVEMENT = {"delta_lon": 0.015, "delta_lat": 0.015, "collective": 0.01, "differential": 0.005}
"""Std of a command above which a run excites its mode: swash tilt [rad], half the sum and half the
difference of the rotor speeds over their means. Less is the pilot's own work, which follows the gusts
and so makes a poor regressor."""
_THROTTLE = ("collective", "differential")


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
    """A mode's regressions on the runs that excite it; None where none does.

    Args:
        mode: the regression. runs: of the flight. parts: rows by run. vehicle: what is expected of.
    """
    used = [run for run in runs if excites(run, mode.axis)]
    if not used:
        return None
    rows = joined([parts[run.name] for run in used])
    moving: list[str] = []
    still: list[str] = []
    throttled = any(excites(run, axis) for run in used for axis in _THROTTLE)
    for name in mode.regressors:
        error = rows.errors[name].var() if name not in EXACT else 0.0
        moved = _spread(rows, name) > max(LEAST_VARIANCE_RATIO * error, 1e-16)
        moved &= throttled or name not in ("T_l", "T_u")
        (moving if moved else still).append(name)
    if not moving:
        return None
    expected = expectation(mode, rows, vehicle, moving)
    return ModeFit(
        mode,
        rows,
        tuple(run.name for run in used),
        _regress(rows, mode.response, moving, total=False),
        _regress(rows, mode.response, moving),
        _regress(rows, mode.response, [*moving, *mode.completed]) if mode.completed else None,
        expected,
        tuple(still),
        collinearity(np.column_stack([rows.columns[n] for n in moving]), moving),
    )


def movement(run: Run, axis: str) -> float:
    """Std of a run's command along an axis of LEAST_MOVEMENT."""
    upper, lower = (run.command[:, i] / max(run.command[:, i].mean(), 1e-9) for i in (0, 1))
    moves = {
        "delta_lon": run.command[:, 2],
        "delta_lat": run.command[:, 3],
        "collective": 0.5 * (upper + lower),
        "differential": 0.5 * (upper - lower),
    }
    return float(moves[axis].std())


def excites(run: Run, axis: str) -> bool:
    """Whether a run's command moves enough along an axis of LEAST_MOVEMENT to regress on."""
    return movement(run, axis) > LEAST_MOVEMENT[axis]


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


def expectation(
    mode: Mode, rows: Rows, vehicle: Vehicle, regressors: Sequence[str]
) -> dict[str, float]:
    """Coefficients that the vehicle file's equations give: their value along the rows, regressed.

    So what is nonlinear in them (lift over thrust, the tilt's cosine) falls where the data let it.

    Args:
        mode: what is explained. rows: low-passed columns. vehicle: whose equations.
        regressors: those of the mode's that moved.
    """
    names = ["1", *regressors, *mode.completed]
    X = np.column_stack([rows.columns[n] for n in names])
    law = coefficients(rows.columns, vehicle)[mode.response]
    values, *_ = np.linalg.lstsq(X / (size := np.abs(X).max(axis=0)), law, rcond=1e-10)
    return dict(zip(names, (values / size).tolist(), strict=True))
