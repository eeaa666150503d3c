"""Matrices that are mostly zero, in compiled code: their values, and where these are not zero.

The Jacobians of a flight model are such: a reading follows a few states, a state a few others. What
is zero is skipped row by row; what is left of a row is multiplied with whole rows of the other matrix,
so that the compiler can use vectors.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import float32, float64, int64, types

from coax_env.kernel.compilation import compiled

REORDER: dict[str, Any] = {"fastmath": {"reassoc", "contract"}}
"""Sums may be taken in the order that is fastest."""
ROW_MULTIPLE = 16
"""Rows of matrices are as long as a multiple of this, zeros at the end: no loop has a scalar rest."""


class Sparse(NamedTuple):
    """A matrix and its non-zeros.

    values: (rows, at least columns). places: (rows, columns) the columns of what is not zero in each
    row, first in it; counts: (rows,) how many.
    """

    values: Any
    places: Any
    counts: Any


SPARSE = types.NamedTuple([float64[:, ::1], int64[:, ::1], int64[::1]], Sparse)


@compiled(int64(int64))
def padded(count):
    """The least multiple of ROW_MULTIPLE that is not less."""
    return (count + ROW_MULTIPLE - 1) // ROW_MULTIPLE * ROW_MULTIPLE


@compiled(SPARSE(float64[:, ::1], int64), makes_arrays=True)
def with_places(values, columns):
    """A matrix with room for the places of its non-zeros, which are not yet found."""
    rows = values.shape[0]
    return Sparse(
        values, np.zeros((rows, columns), dtype=np.int64), np.zeros(rows, dtype=np.int64)
    )  # fmt: skip


@compiled(types.void(SPARSE))
def find_non_zeros(A):
    """Note, in place, where the values of A are not zero."""
    for i in range(A.counts.size):
        count = 0
        for a in range(A.places.shape[1]):
            A.places[i, count] = a
            count += A.values[i, a] != 0.0
        A.counts[i] = count


@compiled(types.void(SPARSE, float64[:, ::1], float64[:, ::1]), **REORDER)
def multiply(A, B, out):
    """A B, with what is not zero in A alone.

    Args:
        A: Sparse, its non-zeros found. B: (columns of A, width). out: (rows of A, width).
    """
    width = out.shape[1]
    for i in range(A.counts.size):
        for j in range(width):
            out[i, j] = 0.0
        for c in range(A.counts[i]):
            a = A.places[i, c]
            weight = A.values[i, a]
            for j in range(width):
                out[i, j] += weight * B[a, j]


@compiled(types.void(float32[:, :, ::1], int64, SPARSE))
def unpack(stored, slot, A):
    """One of the stored matrices back into a Sparse one, with its non-zeros.

    Args:
        stored: (slots, rows, columns). slot: which. A: Sparse, out.
    """
    for i in range(stored.shape[1]):
        for j in range(stored.shape[2]):
            A.values[i, j] = stored[slot, i, j]
    find_non_zeros(A)
