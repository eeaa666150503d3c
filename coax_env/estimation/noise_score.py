"""Slopes of the log-likelihood in the noise levels, by the disturbance smoother."""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import float64, int64, types

from coax_env.estimation.compiled_model import INDICES, MATRIX, VECTOR
from coax_env.estimation.kalman import SAME_STEP, growth
from coax_env.estimation.pass_data import STRENGTH, TRACE, how_many, strength_changes
from coax_env.estimation.sparse import (
    IN_ORDER,
    REORDER,
    aligned,
    along,
    combine,
    find_non_zeros,
    multiply,
    padded,
    unpack,
    with_places,
)
from coax_env.kernel.compilation import compiled, compiled_when_called
from coax_env.kernel.simd import SIMD_WIDTH, simd_blocks, transpose


@compiled(**REORDER)
def reading_back(b, e, per_sigma, gain, H, K, NK, r, N):
    """Across reading `b`: with A = I - K H, r = A' r + H' e / s and N = A' N A + H' H / s^2.

    N loses the symmetric part of twice H' w, w = N K - H' (K' N K + 1 / s^2) / 2.

    Args:
        e, per_sigma, gain: of this reading: whitened innovation, 1 / s and K.
        H: Jacobian of the readings, Sparse. K, NK: scratch.
        r, N: slope and its variance, in place.

    Returns:
        u^2 / 2 and D / 2, whose difference is the slope in the reading's variance: u is the smoothing
        error e / s - K' r and D its variance 1 / s^2 + K' N K.
    """
    nx, width = r.size, NK.size
    pull = e * per_sigma
    curve = per_sigma * per_sigma
    rows, product = simd_blocks(N), simd_blocks(NK)
    blocks = np.uint64(width // SIMD_WIDTH)
    for i in range(nx):
        K[i] = gain[i]
        pull -= K[i] * r[i]
    combine(K, N, nx, NK)
    for j in range(width):
        curve += K[j] * NK[j]
    for c in range(H.counts[b]):
        j = H.places[b, c]
        NK[j] -= 0.5 * curve * H.values[b, j]
        r[j] += H.values[b, j] * pull
    for c in range(H.counts[b]):
        a = H.places[b, c]
        weight = H.values[b, a]
        for block in range(blocks):
            rows[np.uint64(a) * blocks + block] -= weight * product[block]
    row, at = simd_blocks(H.values), np.uint64(b) * blocks
    for block in range(blocks):
        if H.seen[b, block] != 0:
            left = row[at + block]
            for i in range(np.uint64(nx)):
                rows[i * blocks + block] -= NK[i] * left
    return 0.5 * pull * pull, 0.5 * curve


class Slopes(NamedTuple):
    """Slopes of a run's log-likelihood, out.

    in_noise: (blocks, e) in the intensity of each entry of the process noise, by blocks of time, and
    in_decay: (blocks, e) in its decay. in_start: (nx,) in each variance of the first state.
    in_reading: (blocks, m) in the variance of each channel's readings. Those in variances are what the
    data show less what was expected; the latter is in
    noise_expected: (blocks, e), start_expected: (nx,), reading_expected: (m,).
    """

    in_noise: np.ndarray
    in_decay: np.ndarray
    in_start: np.ndarray
    in_reading: np.ndarray
    noise_expected: np.ndarray
    start_expected: np.ndarray
    reading_expected: np.ndarray


SLOPES = types.NamedTuple([MATRIX, MATRIX, VECTOR, MATRIX, MATRIX, VECTOR, VECTOR], Slopes)


def in_common(
    slopes: Slopes, drives: np.ndarray, fades: np.ndarray, begins: np.ndarray
) -> Slopes:
    """Slopes in the noise of all runs, of which that of this run is a multiple.

    Args:
        slopes: in that of the run. drives, fades: (e,) times that it has the intensity and the decay of
            each entry. begins: (nx,) each variance of the first state.
    """
    return slopes._replace(
        in_noise=slopes.in_noise * drives,
        in_decay=slopes.in_decay * fades,
        in_start=slopes.in_start * begins,
        noise_expected=slopes.noise_expected * drives,
        start_expected=slopes.start_expected * begins,
    )


class _Backward(NamedTuple):
    """The arrays that a pass works in, of the states that any reading shows, in their order."""

    r: Any  # slope in the state
    N: Any  # its variance
    r_next: Any  # r of a row later
    B: Any  # F' N
    NF: Any
    F: Any  # Sparse, transposed
    NFP: Any  # F' N times a row of the covariance
    grown: Any  # what noise of unit intensity adds in a row, by entry
    left: Any  # and dt exp(-2 decay dt)
    H: Any  # Sparse: Jacobian of the readings
    K: Any  # scratch of a reading
    NK: Any
    place_of: Any  # of a state in these, -1 of one that no reading shows


@compiled(**REORDER)
def turned_jacobian(path, slot, F):
    """A row's Jacobian of the step, transposed, into F (Sparse).

    Args:
        path: kalman.Path. slot: which of its Jacobians.
    """
    r = F.counts.size
    for i in range(r):
        for j in range(r):
            F.values[j, i] = path.F[slot, i, j]
    find_non_zeros(F)


@compiled(**REORDER)
def row_back(F, r, N, r_next, FN, NF):
    """Across a row: r = F' r, N = F' (F' N)'; what r was is in r_next, F' N in FN.

    Args:
        F: the row's Jacobian, Sparse, transposed. r, N: slope and its variance, in place.
        r_next, FN: out. NF: scratch. FN and NF have as many rows as they are wide.
    """
    nx = r.size
    for i in range(nx):
        r_next[i] = r[i]
    for i in range(nx):
        r[i] = along(F, i, r_next)
    multiply(F, N, FN)
    transpose(FN, NF)
    multiply(F, NF, N)


@compiled(**IN_ORDER)
def _decay_slope(g, x, P, dt, w):
    """Slope in the decay of state `g`, through the Jacobian of a row.

    The slope in F is r x' - N F P, with x the smoothed state (that of a linear model). A decaying
    state keeps exp(-decay dt) of itself, and moves others by its mean over the row, to first order.

    Args:
        g: the state. x: of it, filtered. P: (nx,) its row of the filtered covariance.
        dt: of the row [s]. w: with r before the row, r_next after it, and B.
    """
    smoothed = x
    for j in range(w.r.size):
        smoothed += P[j] * w.r[j]
    combine(P, w.B, w.r.size, w.NFP)
    total = 0.0
    for c in range(w.F.counts[g]):
        i = w.F.places[g, c]
        share = -dt if i == g else -0.5 * dt
        total += share * w.F.values[g, i] * (w.r_next[i] * smoothed - w.NFP[i])
    return total


@compiled(**REORDER)
def _grow(decay, dt, strength, k, w):
    """What row `k`, of `dt` seconds, adds, into `grown` and `left`."""
    for e in range(decay.size):
        w.grown[e] = growth(dt, decay[e])
        w.left[e] = dt * math.exp(-2.0 * decay[e] * dt)
        if strength.block.size:
            w.grown[e] *= strength.factor[strength.block[k], e]
            w.left[e] *= strength.factor[strength.block[k], e]


@compiled(**REORDER)
def _noise_slopes(places, q, decay, w, in_noise, in_decay, expected):
    """Slopes through what a row's process noise adds to the covariance."""
    for e in range(q.size):
        i, j = w.place_of[places[e, 0]], w.place_of[places[e, 1]]
        if i < 0 or j < 0:
            continue
        weight = 0.5 if i == j else 1.0
        slope = weight * (w.r[i] * w.r[j] - w.N[i, j])
        grown = w.grown[e]
        in_noise[e] += slope * grown
        expected[e] += weight * w.N[i, j] * grown
        if decay[e] > 0.0:
            in_decay[e] += slope * q[e] * (w.left[e] - grown) / decay[e]


@compiled(**REORDER)
def _score_rows(dt, strength, trace, places, q, decay, gate, refresh, block, out, w):
    """`score_pass` in arrays that are there."""
    e, gains, path = trace.e, trace.gains, trace.path
    n, m = e.shape
    dt_of_growth = -1.0
    F_slot = H_slot = -1
    reading = gains.per_sigma.size
    beyond = 0.5 * (gate * gate - 1.0)
    for k in range(n - 1, -1, -1):
        if k < n - 1:
            other = abs(dt[k] - dt_of_growth) > SAME_STEP * dt[k]
            if other or strength_changes(strength, k, k + 1):
                _grow(decay, dt[k], strength, k, w)
                dt_of_growth = dt[k]
            _noise_slopes(
                places, q, decay, w, out.in_noise[block[k]], out.in_decay[block[k]],
                out.noise_expected[block[k]],
            )  # fmt: skip
            if path.F_of[k] != F_slot:
                F_slot = path.F_of[k]
                turned_jacobian(path, F_slot, w.F)
            row_back(w.F, w.r, w.N, w.r_next, w.B, w.NF)
            for d in range(path.decaying.size):
                g = path.decaying[d]
                if w.place_of[g] >= 0:
                    out.in_decay[block[k], g] += _decay_slope(
                        w.place_of[g], trace.states[k, g], path.P[k, d], dt[k], w
                    )
        if k // refresh != H_slot:
            H_slot = k // refresh
            unpack(gains.H, H_slot, w.H)
        for b in range(m - 1, -1, -1):
            if not math.isnan(e[k, b]):
                reading -= 1
                shown, expected = reading_back(
                    b, e[k, b], gains.per_sigma[reading], gains.K[reading], w.H, w.K, w.NK, w.r, w.N
                )  # fmt: skip
                if path.beyond[reading] > 0.0:
                    shown, expected = beyond * path.beyond[reading], 0.0
                out.in_reading[block[k], b] += shown - expected
                out.reading_expected[b] += expected
    for i in range(w.r.size):
        j = gains.shown[i]
        out.in_start[j] = 0.5 * (w.r[i] * w.r[i] - w.N[i, i])
        out.start_expected[j] = 0.5 * w.N[i, i]


@compiled_when_called(
    types.void(VECTOR, STRENGTH, TRACE, int64[:, ::1], VECTOR, VECTOR, float64, int64, INDICES, SLOPES),
    makes_arrays=True, **REORDER,
)  # fmt: skip
def score_pass(dt, strength, trace, places, q, decay, gate, refresh, block, out):
    """Slopes of the log-likelihood in the noise levels, backwards over a run.

    With r the slope in the predicted state and N its variance, the slope in a variance added to
    state i is (r_i^2 - N_ii) / 2 (Koopman and Shephard 1992, Biometrika 79: the exact score of a
    linear model; here of the model as linearised along the filter's path). A reading beyond the gate
    has the slope of what the gate takes off the likelihood.

    Args:
        dt: (n,) seconds from each row to the next. strength: of the process noise, as in RunData.
        trace: of the filter pass, with gains and path.
        places: (e, 2) entries of the process noise. q, decay: (e,) as in the filter pass.
        gate, refresh: as in the filter pass. block: (n,) which block of time each row is in.
        out: Slopes, from zero.
    """
    m, place_of = trace.e.shape[1], np.full(out.in_start.size, -1)
    nx = how_many(trace.gains.shown)
    for i in range(nx):
        place_of[trace.gains.shown[i]] = i
    width = padded(nx)
    w = _Backward(
        r=np.zeros(nx), N=aligned(nx, width), r_next=np.zeros(nx), B=aligned(width, width),
        NF=aligned(width, width), F=with_places(aligned(nx, width), nx),
        NFP=aligned(1, width)[0], grown=np.zeros(q.size), left=np.zeros(q.size),
        H=with_places(aligned(m, width), nx), K=np.zeros(width), NK=aligned(1, width)[0],
        place_of=place_of,
    )  # fmt: skip
    _score_rows(dt, strength, trace, places, q, decay, gate, refresh, block, out, w)
