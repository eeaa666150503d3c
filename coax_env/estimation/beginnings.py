"""What parameters would do to the innovations if they moved from some row on: at every row at once.

A parameter that moves from row k on leaves what it does from the run's start on, less what its past
would have left in the state: with s_k the state's derivative at the row, J the signature,

    signature since k = J - C s_k     on the rows from k on,

C being the innovations' answer to the state at k, with the filter's gains held. Sums of that with
anything need C' J, C' e and C' C alone, which obey a recursion from the run's end back (the disturbance
smoother's of de Jong 1989; the matched filters of Willsky and Jones 1976, IEEE Trans. AC-21).
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import float64, int64, types

from coax_env.estimation.compiled_model import INDICES, MATRIX
from coax_env.estimation.frozen_gains import KEPT, Kept
from coax_env.estimation.noise_score import reading_back, row_back, turned_jacobian
from coax_env.estimation.pass_data import TRACE, how_many
from coax_env.estimation.sparse import (
    REORDER,
    aligned,
    combine,
    multiply,
    padded,
    unpack,
    with_places,
)
from coax_env.kernel.compilation import compiled, compiled_when_called
from coax_env.kernel.simd import SIMD_WIDTH, simd_blocks


@dataclass(frozen=True)
class Beginning:
    """Parameters that move from one row of a run on, to second order in them.

    Sums over that run alone, where `Asked` has asked for them. record: its index. row: the first with
    the parameters moved. slope: (k,) of minus the log-likelihood. across: (k, r) information of those
    that begin, by row, and of some that always were, by column. crossed: (p,) the same of pairs.
    own: (p,) of the pairs, both of those that begin.
    """

    record: int
    row: int
    slope: np.ndarray
    across: np.ndarray
    crossed: np.ndarray
    own: np.ndarray


class Asked(NamedTuple):
    """What is wanted of all that could be known of beginnings.

    beside: (r,) places of parameters that always were. first, second: (p,) those of pairs.
    """

    beside: np.ndarray
    first: np.ndarray
    second: np.ndarray


class Sums(NamedTuple):
    """`Beginning` of many rows, out: slope (a, k), across (a, r, k), crossed and own (a, p); of both
    the columns of `padded` width are k or more.
    """

    slope: np.ndarray
    across: np.ndarray
    crossed: np.ndarray
    own: np.ndarray


class Moved(NamedTuple):
    """What parameters do that always were: signatures J (readings, width), kept: frozen_gains.Kept,
    (a, nx, width), at the rows asked for.
    """

    J: np.ndarray
    kept: Kept


ASKED = types.NamedUniTuple(INDICES, 3, Asked)
SUMS = types.NamedTuple([MATRIX, float64[:, :, ::1], MATRIX, MATRIX], Sums)
MOVED = types.NamedTuple([MATRIX, KEPT], Moved)


class _Answers(NamedTuple):
    """The innovations' answers to the state at a row, in sums over all rows from it on, less than zero:
    to_e (nx,) -C' e, to_J (nx, width) -C' J; to_C (nx, width) C' C. Those of the signatures
    themselves: J' e (width,), J' J by those beside (r, width) and by pairs (p,).
    """

    to_e: Any
    to_J: Any
    to_C: Any
    e: Any
    beside: Any
    pairs: Any
    scratch: Any  # (nx, width) of to_J
    half: Any  # (width, width) of to_C
    turned: Any  # the same
    s: Any  # (nx, width) derivatives of the state at the row
    taken: Any  # (width,)
    K: Any
    NK: Any
    F: Any  # Sparse, transposed


@compiled(**REORDER)
def _step_back(w):
    """The step to the next row: X <- F' X, and F' X F of `to_C`."""
    row_back(w.F, w.to_e, w.to_C, w.K, w.half, w.turned)
    multiply(w.F, w.to_J, w.scratch)
    rows, results = simd_blocks(w.scratch), simd_blocks(w.to_J)
    for b in range(np.uint64(w.to_e.size * w.to_J.shape[1] // SIMD_WIDTH)):
        results[b] = rows[b]


@compiled(**REORDER)
def _signatures_back(i, J, e, per_sigma, gain, H, asked, w):
    """Reading `i`: X <- (1 - K H)' X + H' (what it shows) / sigma, of `to_J`; and sums of J itself."""
    blocks = np.uint64(w.taken.size // SIMD_WIDTH)
    answers, taken, shown = simd_blocks(w.to_J), simd_blocks(w.taken), simd_blocks(J)
    of_e, products = simd_blocks(w.e), simd_blocks(w.beside)
    combine(gain, w.to_J, w.to_e.size, w.taken)
    for b in range(blocks):
        taken[b] = per_sigma * shown[b] - taken[b]
        of_e[b] += e * shown[b]
    for c in range(H.counts[i]):
        j = np.uint64(H.places[i, c])
        weight = H.values[i, j]
        for b in range(blocks):
            answers[j * blocks + b] += weight * taken[b]
    for r in range(np.uint64(asked.beside.size)):
        weight = J[asked.beside[r]]
        for b in range(blocks):
            products[r * blocks + b] += weight * shown[b]
    for p in range(asked.first.size):
        w.pairs[p] += J[asked.first[p]] * J[asked.second[p]]


@compiled(**REORDER)
def _sum_up(at, asked, w, out):
    """What parameters would do that begin at the row that has been reached, as row `at` of `out`."""
    nx, width = w.to_e.size, w.taken.size
    combine(w.to_e, w.s, nx, w.taken)
    for c in range(width):
        out.slope[at, c] = w.e[c] + w.taken[c]
    for r in range(asked.beside.size):
        for j in range(nx):
            w.K[j] = w.to_J[j, asked.beside[r]]
        combine(w.K, w.s, nx, w.taken)
        for c in range(width):
            out.across[at, r, c] = w.beside[r, c] + w.taken[c]
    for j in range(nx):
        combine(w.to_C[j], w.s, nx, w.scratch[j])
    for p in range(asked.first.size):
        i, j = asked.first[p], asked.second[p]
        crossed = other = both = 0.0
        for a in range(nx):
            crossed += w.s[a, i] * w.to_J[a, j]
            other += w.s[a, j] * w.to_J[a, i]
            both += w.s[a, i] * w.scratch[a, j]
        out.crossed[at, p] = w.pairs[p] + crossed
        out.own[at, p] = w.pairs[p] + crossed + other + both


@compiled_when_called(types.void(TRACE, int64, MOVED, ASKED, SUMS), makes_arrays=True, **REORDER)
def beginnings_pass(trace, refresh, moved, asked, out):
    """Sums of what begins at some rows of a run, backwards over it.

    Args:
        trace: kalman.Trace of the filter pass, with gains and path. refresh: as there.
        moved: Moved. asked: Asked. out: Sums.
    """
    n, m = trace.e.shape
    nx, width = how_many(trace.gains.shown), moved.J.shape[1]
    narrow = padded(nx)
    w = _Answers(
        to_e=np.zeros(nx), to_J=aligned(nx, width), to_C=aligned(nx, narrow), e=aligned(1, width)[0],
        beside=aligned(asked.beside.size, width), pairs=np.zeros(asked.first.size),
        scratch=aligned(nx, width), half=aligned(narrow, narrow), turned=aligned(narrow, narrow),
        s=aligned(nx, width), taken=aligned(1, width)[0], K=np.zeros(narrow),
        NK=aligned(1, narrow)[0], F=with_places(aligned(nx, narrow), nx),
    )  # fmt: skip
    H = with_places(aligned(m, narrow), nx)
    F_slot = H_slot = -1
    reading = moved.J.shape[0]
    for row in range(n - 1, -1, -1):
        if row < n - 1:
            if trace.path.F_of[row] != F_slot:
                F_slot = trace.path.F_of[row]
                turned_jacobian(trace.path, F_slot, w.F)
            _step_back(w)
        if row // refresh != H_slot:
            H_slot = row // refresh
            unpack(trace.gains.H, H_slot, H)
        for i in range(m - 1, -1, -1):
            if not math.isnan(trace.e[row, i]):
                reading -= 1
                e, per_sigma = trace.e[row, i], trace.gains.per_sigma[reading]
                gain = trace.gains.K[reading]
                _signatures_back(i, moved.J[reading], e, per_sigma, gain, H, asked, w)
                reading_back(i, e, per_sigma, gain, H, w.K, w.NK, w.to_e, w.to_C)
        at = moved.kept.places[row]
        if at >= 0:
            for j in range(nx):
                for c in range(width):
                    w.s[j, c] = moved.kept.s[at, j, c]
            _sum_up(at, asked, w, out)
