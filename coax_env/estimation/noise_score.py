"""Slope of the log-likelihood in the process noise, by the disturbance smoother."""

import math

import numpy as np
from numba import int64, types

from coax_env.estimation.kalman import _A, _M, _N, TRACE
from coax_env.estimation.sparse import (
    REORDER,
    find_non_zeros,
    multiply,
    padded,
    unpack,
    with_places,
)
from coax_env.kernel.compilation import compiled


@compiled(**REORDER)
def _row_back(F, r, N, r_next, B, NF):
    """Across a row: r = F' r, N = F' (F' N)'.

    Args:
        F: the transposed Jacobian, Sparse. r, N: slope and its variance, in place.
        r_next, B, NF: scratch.
    """
    nx = r.size
    for i in range(nx):
        r_next[i] = 0.0
        for c in range(F.counts[i]):
            r_next[i] += F.values[i, F.places[i, c]] * r[F.places[i, c]]
    multiply(F, N, B)
    for i in range(nx):
        r[i] = r_next[i]
        for j in range(nx):
            NF[j, i] = B[i, j]
    multiply(F, NF, N)


@compiled(**REORDER)
def _reading_back(b, e, per_sigma, gain, H, K, NK, r, N):
    """Across reading `b`: with A = I - K H, r = A' r + H' e / s and N = A' N A + H' H / s^2.

    N loses the symmetric part of twice H' w, w = N K - H' (K' N K + 1 / s^2) / 2.

    Args:
        e, per_sigma, gain: of this reading: whitened innovation, 1 / s and K.
        H: Jacobian of the readings, Sparse. K, NK: scratch.
        r, N: slope and its variance, in place.
    """
    nx, width = r.size, NK.size
    pull = e * per_sigma
    curve = per_sigma * per_sigma
    for j in range(width):
        NK[j] = 0.0
    for i in range(nx):
        K[i] = gain[i]
        pull -= K[i] * r[i]
        for j in range(width):
            NK[j] += K[i] * N[i, j]
    for j in range(width):
        curve += K[j] * NK[j]
    for c in range(H.counts[b]):
        j = H.places[b, c]
        NK[j] -= 0.5 * curve * H.values[b, j]
        r[j] += H.values[b, j] * pull
    for c in range(H.counts[b]):
        a = H.places[b, c]
        weight = H.values[b, a]
        for j in range(width):
            N[a, j] -= weight * NK[j]
        for i in range(nx):
            N[i, a] -= weight * NK[i]


@compiled(types.void(_A, TRACE, int64, _N, _M, _A), makes_arrays=True, **REORDER)
def score_pass(dt, trace, refresh, block, by_noise, by_start):
    """Slope of the log-likelihood in the process noise, backwards over a run.

    With r the slope in the predicted state and N its variance, the slope in a variance added to
    state i is (r_i^2 - N_ii) / 2 (Koopman and Shephard 1992, Biometrika 79: the exact score of a
    linear model; here of the model as linearised along the filter's path).

    Args:
        dt: (n,) seconds from each row to the next. trace: of the filter pass, with gains and path.
        refresh: as in the filter pass. block: (n,) which block of time each row is in.
        by_noise: (blocks, nx) slope in each state's growth of variance per second, out.
        by_start: (nx,) slope in each variance of the first state, out.
    """
    e, gains, path = trace.e, trace.gains, trace.path
    n, m = e.shape
    nx = by_start.size
    width = padded(nx)
    r = np.zeros(nx)
    N = np.zeros((nx, width))
    NF = np.zeros((nx, width))
    B = np.zeros((nx, width))
    r_next = np.zeros(nx)
    NK = np.zeros(width)
    K = np.zeros(width)
    F = with_places(np.zeros((nx, nx)), nx)
    H = with_places(np.zeros((m, nx)), nx)
    F_slot = H_slot = -1
    reading = gains.per_sigma.size
    by_noise[:, :] = 0.0
    for k in range(n - 1, -1, -1):
        if k < n - 1:
            for i in range(nx):
                by_noise[block[k], i] += 0.5 * dt[k] * (r[i] * r[i] - N[i, i])
            if path.F_of[k] != F_slot:
                F_slot = path.F_of[k]
                for i in range(nx):
                    for j in range(nx):
                        F.values[j, i] = path.F[F_slot, i, j]
                find_non_zeros(F)
            _row_back(F, r, N, r_next, B, NF)
        if k // refresh != H_slot:
            H_slot = k // refresh
            unpack(gains.H, H_slot, H)
        for b in range(m - 1, -1, -1):
            if not math.isnan(e[k, b]):
                reading -= 1
                _reading_back(
                    b, e[k, b], gains.per_sigma[reading], gains.K[reading], H, K, NK, r, N
                )  # fmt: skip
    for i in range(nx):
        by_start[i] = 0.5 * (r[i] * r[i] - N[i, i])
