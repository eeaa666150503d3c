"""Paths in time for the task ``trajectory``: circle, figure eight, lemniscate, or a user's table.

A path is sampled once per control period: place, heading, and their first and second derivatives.
Shapes begin at hover.HEIGHT over the start, at rest, heading north; they reach their speed within
RAMP seconds and go round without end. A table (CSV) has the columns t, north, east, height and, if it
likes, heading [s, m, rad]; a cubic spline goes through it (at rest at both ends), and its last point is
held.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.env import hover
from coax_env.errors import InputError

RAMP = 3.0  # [s] from rest to the speed of a shape
SIZE, PERIOD = 1.0, 12.0  # [m] half width, [s] of one round: what a shape has when nothing is said
LONGEST = 600.0  # [s] of a table

PATH_COLUMNS = ("x", "y", "z", "psi", "vx", "vy", "vz", "turn_rate", "ax", "ay", "az")
"""Of a path: the world's axes (north, east, down) [m, rad, m/s, rad/s, m/s2]."""
N_PATH = len(PATH_COLUMNS)
_TABLE = ("t", "north", "east", "height", "heading")


def _circle(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.sin(s), 1.0 - np.cos(s)


def _figure_eight(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.sin(s), np.sin(s) * np.cos(s)


def _lemniscate(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.sin(s) / (1.0 + np.cos(s) ** 2), np.sin(s) * np.cos(s) / (1.0 + np.cos(s) ** 2)


SHAPES: Mapping[str, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "circle": _circle,
    "figure_eight": _figure_eight,
    "lemniscate": _lemniscate,
}
"""North and east of a shape of half width 1 at an angle that runs round: Gerono's, Bernoulli's."""


def path(target: Any = None) -> tuple[np.ndarray, int]:
    """A path as (k, N_PATH), one row per control period, and the row that follows the last.

    Args:
        target: a name of SHAPES; {"shape": name, "size": [m], "period": [s]}; the path of a CSV; or
            its rows (n, 4 or 5). None: the circle.

    Raises:
        InputError: none of these, or it leaves the space that may be flown in.
    """
    target = "circle" if target is None else target
    if isinstance(target, str) and target in SHAPES:
        target = {"shape": target}
    if isinstance(target, Mapping):
        found, again = _shape(target)
    else:
        found, again = _through(_rows(target))
    _check(found, target)
    return found, again


def _shape(wanted: Mapping[str, Any]) -> tuple[np.ndarray, int]:
    """RAMP seconds to its speed, then one round, which is flown again and again."""
    unknown = set(wanted) - {"shape", "size", "period"}
    name = wanted.get("shape", "circle")
    if unknown or name not in SHAPES:
        raise InputError(
            f"a path is {', '.join(SHAPES)}, a CSV, or {{'shape': name, 'size': m, 'period': s}}, "
            f"found {dict(wanted)!r}"
        )
    try:
        size, period = float(wanted.get("size", SIZE)), float(wanted.get("period", PERIOD))
    except (TypeError, ValueError):
        size = period = np.nan
    if not (0.0 < size < hover.FARTHEST and 1.0 <= period <= LONGEST):
        raise InputError(
            f"a path's size must be in 0 .. {hover.FARTHEST:g} m, and its period in "
            f"1 .. {LONGEST:g} s, found {dict(wanted)!r}"
        )
    dt = hover.CONTROL_PERIOD
    rows, ramp = round(period / dt), round(RAMP / dt)
    t = dt * np.arange(ramp + rows)
    rate = 2.0 * np.pi / (rows * dt)
    # the angle's rate rises as 3 r^2 - 2 r^3, r = t/RAMP
    r = np.minimum(t / RAMP, 1.0)
    angle = rate * (RAMP * (r**3 - 0.5 * r**4) + np.maximum(t - RAMP, 0.0))
    speed = rate * (3.0 * r**2 - 2.0 * r**3)
    growth = np.where(t < RAMP, rate * 6.0 * (r - r**2) / RAMP, 0.0)
    found = np.zeros((len(t), N_PATH))
    found[:, 2] = -hover.HEIGHT
    step = 1e-4  # [rad] of the central differences, good to 1e-7
    for axis in (0, 1):
        before, here, after = (SHAPES[name](angle + k * step)[axis] for k in (-1, 0, 1))
        slope, bend = (after - before) / (2.0 * step), (after - 2.0 * here + before) / step**2
        found[:, axis] = size * here
        found[:, 4 + axis] = size * slope * speed
        found[:, 8 + axis] = size * (bend * speed**2 + slope * growth)
    return found, ramp


def _rows(target: Any) -> np.ndarray:
    """The table's rows, (n, 5)."""
    if isinstance(target, str | Path):
        return _from_csv(Path(target))
    try:
        rows = np.array(target, dtype=float)
    except (TypeError, ValueError):
        rows = np.empty(0)
    if rows.ndim != 2 or rows.shape[1] not in (4, 5):
        raise InputError(f"a path has rows of {', '.join(_TABLE[:4])} and perhaps heading")
    return _checked(rows, "a path")


def _from_csv(file: Path) -> np.ndarray:
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        known = ", ".join(SHAPES)
        raise InputError(f"no path {str(file)!r}: neither a file nor one of {known}") from error
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    if names not in (list(_TABLE), list(_TABLE[:4])):
        raise InputError(
            f"{file}: line 1: columns must be {', '.join(_TABLE[:4])} and perhaps heading"
        )
    rows = []
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            row = []
        if len(row) != len(names):
            raise InputError(f"{file}: line {number}: must be {len(names)} numbers, found {line!r}")
        rows.append(row)
    return _checked(np.array(rows, dtype=float).reshape(-1, len(names)), str(file))


def _checked(rows: np.ndarray, what: str) -> np.ndarray:
    if len(rows) < 2 or not np.isfinite(rows).all():
        raise InputError(f"{what}: needs two rows at least, all finite")
    if rows[0, 0] != 0.0 or not (np.diff(rows[:, 0]) > 0.0).all() or rows[-1, 0] > LONGEST:
        raise InputError(f"{what}: t must rise from 0, to {LONGEST:g} s at most")
    return rows if rows.shape[1] == 5 else np.column_stack([rows, np.zeros(len(rows))])


def _through(rows: np.ndarray) -> tuple[np.ndarray, int]:
    """A cubic spline through the rows, at rest at both ends; the last point is held."""
    # here, since the import takes longer than an env's first step
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(rows[:, 0], rows[:, 1:] * (1.0, 1.0, -1.0, 1.0), bc_type="clamped")
    t = hover.CONTROL_PERIOD * np.arange(round(rows[-1, 0] / hover.CONTROL_PERIOD) + 1)
    t = np.minimum(t, rows[-1, 0])
    found = np.hstack([spline(t), spline(t, 1), spline(t, 2)[:, :3]])
    found[-1, 4:] = 0.0
    return found, len(found) - 1


def _check(found: np.ndarray, target: Any) -> None:
    height, away = -found[:, 2], np.hypot(found[:, 0], found[:, 1])
    if (
        height.min() <= hover.LOWEST
        or height.max() >= hover.HIGHEST
        or away.max() >= hover.FARTHEST
    ):
        raise InputError(
            f"a path must stay {hover.LOWEST:g} to {hover.HIGHEST:g} m high and within "
            f"{hover.FARTHEST:g} m of the start, which {target!r} does not"
        )
