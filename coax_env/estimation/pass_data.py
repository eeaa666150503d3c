"""What the compiled passes over a run are given, and what they leave."""

from typing import NamedTuple

import numpy as np
from numba import float32, float64, types

from coax_env.estimation.compiled_model import INDICES, MATRIX, VECTOR
from coax_env.estimation.state_space import STEADY, Strength
from coax_env.kernel.compilation import compiled


class RunData(NamedTuple):
    """What a pass is given of a run.

    dt: (n,) seconds from each row to the next. u: (n, nu). z: (n, m), NaN where missing.
    strength: of its process noise, see state_space.Strength. blur: (n, m) variance of each reading
    beyond its channel's; (1, 0): none. between: (n, k) variance of what each of the first k inputs
    was in the mean over a row; (0, 0): it is known.
    """

    dt: np.ndarray
    u: np.ndarray
    z: np.ndarray
    strength: Strength = STEADY
    blur: np.ndarray = np.zeros((1, 0))
    between: np.ndarray = np.zeros((0, 0))


class Variances(NamedTuple):
    """What the filter believes at first, and how much it believes.

    x0: (nx,) first state. P0: (nx, nx) its covariance. R: (m,) variances of the readings.
    q: (e,) intensity of the process noise in each of its entries, decay: (e,) rate [1/s] at which
    what it has added decays; see state_space.ProcessNoise.
    """

    x0: np.ndarray
    P0: np.ndarray
    R: np.ndarray
    q: np.ndarray
    decay: np.ndarray


class Gains(NamedTuple):
    """K: (readings, nx) and per_sigma: (readings,) 1 / s, of each reading that there is, in the order
    of the innovations. H: (n / refresh, m, nx) Jacobians of the readings; empty: not to be stored.

    shown: (nx,) the r states that any reading shows (`find_shown`), then -1. States of K and H, and of
    F and P of the path, are these, r of nx and in this order; behind them is whatever was there.
    """

    K: np.ndarray
    per_sigma: np.ndarray
    H: np.ndarray
    shown: np.ndarray


class Path(NamedTuple):
    """What the filter linearised the model at; empty: not to be stored.

    F: (at most n, nx, nx) Jacobians of the step. F_of: (n,) which of them a row has.
    predicted: (n, nx) states before each row's readings.
    decaying: (d,) states whose rows of the filtered covariance are kept; P: (n, d, nx) those.
    beyond: (readings,) 1 / variance expected of a reading beyond the gate, 0 of one within it.
    """

    F: np.ndarray
    F_of: np.ndarray
    predicted: np.ndarray
    decaying: np.ndarray
    P: np.ndarray
    beyond: np.ndarray


class Trace(NamedTuple):
    """What a filter pass leaves, in arrays of its caller.

    states: (n, nx) filtered. e: (n, m) whitened innovations, NaN where there is no reading.
    """

    states: np.ndarray
    e: np.ndarray
    gains: Gains
    path: Path


class Covariances(NamedTuple):
    """Filtered covariances of some rows: P (slots, nx, nx), and each row's slot in it (n,), or -1."""

    P: np.ndarray
    slots: np.ndarray


STRENGTH = types.NamedTuple([INDICES, MATRIX], Strength)
RUN_DATA = types.NamedTuple([VECTOR, MATRIX, MATRIX, STRENGTH, MATRIX, MATRIX], RunData)
VARIANCES = types.NamedTuple([VECTOR, MATRIX, VECTOR, VECTOR, VECTOR], Variances)
GAINS = types.NamedTuple([float32[:, ::1], VECTOR, float32[:, :, ::1], INDICES], Gains)
PATH = types.NamedTuple(
    [float32[:, :, ::1], INDICES, MATRIX, INDICES, float32[:, :, ::1], VECTOR], Path
)
TRACE = types.NamedTuple([MATRIX, MATRIX, GAINS, PATH], Trace)
COVARIANCES = types.NamedTuple([float64[:, :, ::1], INDICES], Covariances)


@compiled()
def how_many(shown):
    """Of states that any reading shows; see Gains."""
    count = 0
    while count < shown.size and shown[count] >= 0:
        count += 1
    return count


@compiled()
def strength_changes(strength, k, other):
    """Whether process noise has another strength in row `k` than in the row `other`.

    Args:
        strength: of the process noise. k, other: rows.
    """
    return strength.block.size > 0 and strength.block[k] != strength.block[other]
