"""Generic terms: a force or moment on one body axis as a sum of low-order terms of state and command.

What no effect of the catalogue explains can still be written down: coefficients of these terms, six
groups of them (`unlisted_X` .. `unlisted_N`), one per axis of the wrench. The groups are effects like
any other to the kernel and to the vehicle files; they have no name of their own to be blamed by, and
the catalogue's search never proposes them. unlisted.py does, for what the catalogue leaves.

Speeds are those of the body, not of the air; rotor speeds count from the bare model's hover, whose
torques balance and whose thrust carries the weight (15)-(20), the height from six rotor radii, where
the ground is no longer felt. A swash plate without a servo lag jumps and has no rate; what has one is
the direction in which this row moves it on, which is what play in its linkage answers to.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from coax_env.kernel.compilation import compiled
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model import workspace as F

HARMONICS = 4
"""Harmonics of the heading, sin(k psi) and cos(k psi)."""

AXES = {
    "unlisted_X": ("N", F.FORCE_X),
    "unlisted_Y": ("N", F.FORCE_Y),
    "unlisted_Z": ("N", F.FORCE_Z),
    "unlisted_L": ("N m", F.MOMENT_X),
    "unlisted_M": ("N m", F.MOMENT_Y),
    "unlisted_N": ("N m", F.MOMENT_Z),
}
"""Group -> unit and place in the kernel's workspace, in the order of the gust states."""

USUAL = {"N": 0.4, "N m": 0.02}
"""Usual size of an unlisted force and moment, the width of the prior: 5 % of the weight of the 0.8 kg
machine, and that times a quarter of the lower hub's arm, ours."""
SMALLEST = {"N": 0.04, "N m": 1.5e-3}
"""RMS on a flight under which a force or moment does not matter in prediction."""
SCALES = dict.fromkeys(("unlisted_X", "unlisted_Y", "unlisted_Z"), "weight")
SCALES |= dict.fromkeys(("unlisted_L", "unlisted_M"), "weight * arm")
SCALES["unlisted_N"] = "inertia_zz / time / time"
"""Group -> what both grow with on another machine (usual_sizes.py)."""
REFERENCE_HEIGHT = 6.0  # rotor radii from which the height counts
DIRECTION_STEP = 1e-3  # [rad] of a row that is surely a motion: well under a pilot's tremor; ours

_SPEEDS = (("u", "m/s", 1.0, " / speed"), ("v", "m/s", 1.0, " / speed"),
           ("w", "m/s", 0.5, " / speed"),
           ("p", "rad/s", 0.5, " * time"), ("q", "rad/s", 0.5, " * time"),
           ("r", "rad/s", 0.5, " * time"))  # fmt: skip
_PAIRS = tuple(combinations(range(6), 2))
_SPIN = " / rotor_speed"


@dataclass(frozen=True)
class Term:
    """One term. ``key`` names it in a vehicle file, ``form`` in a formula; ``usual`` is its usual size.

    ``follows``: the states or commands it depends on. ``kin``: terms that share it are one physical
    term in two columns (sine and cosine of one angle) and may be taken together. ``per``: with what
    its coefficient's usual size falls and grows beside the axis' (usual_sizes.py). ``needs``: channels
    without which the term is not known.
    """

    key: str
    form: str
    unit: str
    usual: float
    follows: tuple[str, ...]
    kin: str = ""
    per: str = ""
    needs: tuple[str, ...] = ()


def _heading(k: int) -> tuple[Term, Term]:
    key, angle = ("psi", "psi") if k == 1 else (f"{k}psi", f"{k} psi")
    return (
        Term(f"sin_{key}", f"sin({angle})", "1", 1.0, ("psi",), f"{key}"),
        Term(f"cos_{key}", f"cos({angle})", "1", 1.0, ("psi",), f"{key}"),
    )


TERMS: tuple[Term, ...] = (
    *(Term(n, n, unit, size, (n,), per=per) for n, unit, size, per in _SPEEDS),
    *(
        Term(f"abs_{n}_{n}", f"|{n}| {n}", f"({unit})2", size**2, (n,), per=per + per)
        for n, unit, size, per in _SPEEDS
    ),
    *(
        Term(
            f"{_SPEEDS[i][0]}_{_SPEEDS[j][0]}",
            f"{_SPEEDS[i][0]} {_SPEEDS[j][0]}",
            f"({_SPEEDS[i][1]})({_SPEEDS[j][1]})",
            _SPEEDS[i][2] * _SPEEDS[j][2],
            (_SPEEDS[i][0], _SPEEDS[j][0]),
            per=_SPEEDS[i][3] + _SPEEDS[j][3],
        )
        for i, j in _PAIRS
    ),
    Term("sin_phi", "sin(phi)", "1", 0.1, ("phi",)),
    Term("sin_theta", "sin(theta)", "1", 0.1, ("theta",)),
    Term("cos_phi", "(1 - cos(phi))", "1", 0.01, ("phi",)),
    Term("cos_theta", "(1 - cos(theta))", "1", 0.01, ("theta",)),
    *(term for k in range(1, HARMONICS + 1) for term in _heading(k)),
    Term("omega_u", "(omega_u - hover)", "rad/s", 10.0, ("omega_u",), per=_SPIN),
    Term("omega_l", "(omega_l - hover)", "rad/s", 10.0, ("omega_l",), per=_SPIN),
    Term("delta_lon", "delta_lon", "rad", 0.05, ("delta_lon",)),
    Term("delta_lat", "delta_lat", "rad", 0.05, ("delta_lat",)),
    Term("omega_u_rate", "omega_u'", "rad/s2", 50.0, ("omega_u",), per=_SPIN + " * time"),
    Term("omega_l_rate", "omega_l'", "rad/s2", 50.0, ("omega_l",), per=_SPIN + " * time"),
    Term("north", "x", "m", 1.0, ("x",), per=" / length", needs=("pn",)),
    Term("east", "y", "m", 1.0, ("y",), per=" / length", needs=("pe",)),
    Term("height", "(h - 6 R)", "m", 0.5, ("h",), per=" / length", needs=("h",)),
    Term("omega_u_2", "(omega_u - hover)2", "(rad/s)2", 100.0, ("omega_u",), per=_SPIN + _SPIN),
    Term("omega_l_2", "(omega_l - hover)2", "(rad/s)2", 100.0, ("omega_l",), per=_SPIN + _SPIN),
    Term("omega_u_l", "(omega_u - hover) (omega_l - hover)", "(rad/s)2", 100.0,
         ("omega_u", "omega_l"), per=_SPIN + _SPIN),
    Term("lon_direction", "sgn(delta_lon')", "1", 1.0, ("delta_lon",)),
    Term("lat_direction", "sgn(delta_lat')", "1", 1.0, ("delta_lat",)),
)  # fmt: skip
"""Every term, in the order of the coefficients in the parameter vector."""

_N_TERMS = len(TERMS)
_SQUARES, _PRODUCTS = 6, 12
_TILT = _PRODUCTS + len(_PAIRS)
_HEADING = _TILT + 4
_COMMAND = _HEADING + 2 * HARMONICS
_PLACE = _COMMAND + 6
_ROTORS = _PLACE + 3
_DIRECTION = _ROTORS + 3


@compiled()
def hover_speeds(p: np.ndarray) -> tuple[float, float]:
    """Rotor speeds [rad/s] at which the bare model hovers, its download on the fuselage left out."""
    weight = p[P.MASS] * p[P.GRAVITY]
    radius = p[P.ROTOR_RADIUS]
    k_T = p[P.AIR_DENSITY] * math.pi * radius * radius * radius * radius
    ratio2 = p[P.C_QU] / p[P.C_QL]  # (omega_l / omega_u)^2 where torques balance
    upper = math.sqrt(weight / (k_T * (p[P.C_TU] + p[P.C_TL] * ratio2)))
    return upper, upper * math.sqrt(ratio2)


@compiled()
def term_value(i: int, x: np.ndarray, f: np.ndarray, p: np.ndarray) -> float:
    """Value of the term TERMS[i], in its unit.

    Args:
        i: which. x: full state (29,). f: workspace (N_FLOW,). p: parameter vector.
    """
    if i < _SQUARES:
        return x[i]
    if i < _PRODUCTS:
        return abs(x[i - _SQUARES]) * x[i - _SQUARES]
    if i < _TILT:
        a, b = _PAIRS[i - _PRODUCTS]
        return x[a] * x[b]
    if i < _HEADING:
        which = i - _TILT
        angle = x[S.PHI + which % 2]
        return math.sin(angle) if which < 2 else 1.0 - math.cos(angle)
    if i < _COMMAND:
        which = i - _HEADING
        angle = (which // 2 + 1) * x[S.PSI]
        return math.sin(angle) if which % 2 == 0 else math.cos(angle)
    if i < _PLACE:
        which = i - _COMMAND
        if which < 2:
            upper, lower = hover_speeds(p)
            return f[F.OMEGA_U] - upper if which == 0 else f[F.OMEGA_L] - lower
        if which < 4:
            return x[S.SWASH_LON + which - 2]
        return f[F.OMEGA_U_DOT] if which == 4 else f[F.OMEGA_L_DOT]
    if i < _ROTORS:
        which = i - _PLACE
        return x[S.X + which] if which < 2 else -x[S.Z] - REFERENCE_HEIGHT * p[P.ROTOR_RADIUS]
    if i < _DIRECTION:
        upper, lower = hover_speeds(p)
        first = f[F.OMEGA_L] - lower if i == _ROTORS + 1 else f[F.OMEGA_U] - upper
        second = f[F.OMEGA_U] - upper if i == _ROTORS else f[F.OMEGA_L] - lower
        return first * second
    return math.tanh(f[F.LON_STEP + i - _DIRECTION] / DIRECTION_STEP)


def _axis(target: int, summary: str) -> Callable:
    def add(x: np.ndarray, f: np.ndarray, p: np.ndarray, e: int) -> None:
        total = 0.0
        for i in range(_N_TERMS):
            if p[e + i] != 0.0:
                total += p[e + i] * term_value(i, x, f, p)
        f[target] += total

    add.__doc__ = summary
    return add


AXIS_FUNCTIONS = {
    group: _axis(place, f"Whatever {group[-1]} [{unit}] no effect of the catalogue explains.")
    for group, (unit, place) in AXES.items()
}
"""Group -> the function that adds its axis' terms, for the kernel."""


def sum_of(group: str, which: Sequence[int], index: int) -> list[str]:
    """Source of some terms of an axis, a line each, for a function of (x, f, p).

    Args:
        group: of AXES. which: places in TERMS. index: of its first coefficient in `p`.
    """
    place = AXES[group][1]
    return [f"f[{place}] += p[{index + i}] * term_value({i}, x, f, p)" for i in which]


def unit_of(group: str, term: Term) -> str:
    """Unit of a term's coefficient on an axis."""
    axis = AXES[group][0]
    return axis if term.unit == "1" else f"{axis} per {term.unit}"
