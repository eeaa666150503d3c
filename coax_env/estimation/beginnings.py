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
from typing import Any

import numpy as np
from numba import int64, types

from coax_env.estimation.frozen_gains import PORTION
from coax_env.estimation.kalman import _A, _M, TRACE
from coax_env.estimation.sparse import REORDER
from coax_env.kernel.compilation import compiled


@dataclass(frozen=True)
class Beginning:
    """Parameters that move from one row of a run on, to second order in them.

    Sums over that run alone. record: its index. row: the first with the parameters moved.
    slope: (k,) of minus the log-likelihood. across: (k, k) information of those that begin, by row, and
    of those that always were, by column. own: (k, k) of those that begin.
    """

    record: int
    row: int
    slope: np.ndarray
    across: np.ndarray
    own: np.ndarray


class Answers:
    """The innovations' answers to the state at a row, in sums over all rows from it on.

    to_e: (nx,) C' e. to_J: (nx, k) C' J. to_C: (nx, nx) C' C.
    """

    def __init__(self, nx: int, k: int) -> None:
        self.to_e, self.to_J, self.to_C = np.zeros(nx), np.zeros((nx, k)), np.zeros((nx, nx))

    def back(self, trace: Any, refresh: int, portion: Any, J: np.ndarray) -> None:
        """To the first row of a portion, from the row behind its last.

        Args:
            trace: kalman.Trace of the filter pass, with gains and path. refresh: as there.
            portion: frozen_gains.Portion. J: (readings, k) its signatures.
        """
        _back(trace, refresh, portion, J, self.to_e, self.to_J, self.to_C)

    def since(self, s: np.ndarray, slope: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, ...]:
        """Slope, information across and own of parameters that begin here.

        Args:
            s: (nx, k) derivatives of the state at this row, of parameters that always were.
            slope: (k,) and own: (k, k) of those, over the rows from here on.
        """
        crossed = s.T @ self.to_J
        both = own - crossed - crossed.T + s.T @ self.to_C @ s
        return slope - s.T @ self.to_e, own - crossed, both


@compiled(types.void(TRACE, int64, PORTION, _M, _A, _M, _M), makes_arrays=True, **REORDER)
def _back(trace, refresh, portion, J, to_e, to_J, to_C):
    """`Answers.back`."""
    n, m = trace.e.shape
    nx, k = to_J.shape
    e_new, J_new = np.zeros(nx), np.zeros((nx, k))
    half, C_new = np.zeros((nx, nx)), np.zeros((nx, nx))
    taken, turned = np.zeros(k), np.zeros(nx)
    reading = portion.reading + J.shape[0]
    for row in range(portion.last - 1, portion.first - 1, -1):
        if row < n - 1:  # the step to the next row: X <- F' X
            F = trace.path.F[trace.path.F_of[row]]
            e_new[:], J_new[:], half[:], C_new[:] = 0.0, 0.0, 0.0, 0.0
            for i in range(nx):
                for j in range(nx):
                    if F[i, j] != 0.0:
                        e_new[j] += F[i, j] * to_e[i]
                        for c in range(k):
                            J_new[j, c] += F[i, j] * to_J[i, c]
                        for c in range(nx):
                            half[j, c] += F[i, j] * to_C[i, c]
            for i in range(nx):
                for j in range(nx):
                    if F[i, j] != 0.0:
                        for c in range(nx):
                            C_new[c, j] += half[c, i] * F[i, j]
            to_e[:], to_J[:], to_C[:] = e_new, J_new, C_new
        for i in range(m - 1, -1, -1):  # readings: X <- (1 - K H)' X - H' (what it shows) / sigma
            if math.isnan(trace.e[row, i]):
                continue
            reading -= 1
            K, per_sigma = trace.gains.K[reading], trace.gains.per_sigma[reading]
            H = trace.gains.H[row // refresh, i]
            e_taken = per_sigma * trace.e[row, i]
            for c in range(k):
                taken[c] = per_sigma * J[reading - portion.reading, c]
            both = per_sigma * per_sigma
            turned[:] = 0.0
            for j in range(nx):
                if K[j] != 0.0:
                    e_taken += K[j] * to_e[j]
                    for c in range(k):
                        taken[c] += K[j] * to_J[j, c]
                    for c in range(nx):
                        turned[c] += K[j] * to_C[j, c]
            for j in range(nx):
                both += K[j] * turned[j]
            for j in range(nx):
                if H[j] != 0.0:
                    to_e[j] -= H[j] * e_taken
                    for c in range(k):
                        to_J[j, c] -= H[j] * taken[c]
                    for c in range(nx):
                        to_C[j, c] -= H[j] * turned[c]
                        to_C[c, j] -= turned[c] * H[j]
                    for c in range(nx):
                        to_C[j, c] += H[j] * H[c] * both
