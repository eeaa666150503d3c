"""Matrices that are mostly zero, in compiled code: their values, and where these are not zero.

The Jacobians of a flight model are such: a reading follows a few states, a state a few others. What
is zero is skipped row by row; what is left of a row is multiplied with whole rows of the other matrix,
in SIMD registers of neighbours in a row.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import float32, float64, int64, types

from coax_env.kernel.compilation import compiled
from coax_env.kernel.simd import SIMD_WIDTH, lanes, negated, simd_blocks

REORDER: dict[str, Any] = {"fastmath": {"reassoc", "contract"}}
"""Sums may be taken in the order that is fastest."""
ROW_MULTIPLE = 16
"""Rows of matrices are as long as a multiple of this, zeros at the end: no loop has a scalar rest."""
ONE, TWO = np.uint64(1), np.uint64(2)
"""Indices without a sign: a signed one is looked at each time whether it counts from the end."""


class Sparse(NamedTuple):
    """A matrix and its non-zeros.

    values: (rows, at least columns). places: (rows, columns) the columns of what is not zero in each
    row, first in it; counts: (rows,) how many. seen: (rows, registers of a row or none) the lanes that
    were not zero when places were last noted.
    """

    values: Any
    places: Any
    counts: Any
    seen: Any


SPARSE = types.NamedTuple([float64[:, ::1], int64[:, ::1], int64[::1], int64[:, ::1]], Sparse)


@compiled(int64(int64))
def padded(count):
    """The least multiple of ROW_MULTIPLE that is not less."""
    return (count + ROW_MULTIPLE - 1) // ROW_MULTIPLE * ROW_MULTIPLE


@compiled(SPARSE(float64[:, ::1], int64), makes_arrays=True)
def with_places(values, columns):
    """A matrix with room for the places of its non-zeros, which are not yet found."""
    rows, width = values.shape
    registers = width // SIMD_WIDTH if width % SIMD_WIDTH == 0 else 0
    return Sparse(
        values, np.zeros((rows, columns), dtype=np.int64), np.zeros(rows, dtype=np.int64),
        np.full((rows, registers), -1),
    )  # fmt: skip


@compiled(types.float64[:, ::1](int64, int64), makes_arrays=True)
def aligned(rows, width):
    """Zeros (rows, width), each row at the beginning of a line of the cache where `width` allows it."""
    line = 8  # doubles
    memory = np.zeros(rows * width + line)
    first = (line - memory.ctypes.data // 8 % line) % line
    return memory[first : first + rows * width].reshape(rows, width)


@compiled(types.void(SPARSE))
def find_non_zeros(A):
    """Note, in place, where the values of A are not zero."""
    blocks = A.seen.shape[1]
    values = simd_blocks(A.values)
    for i in range(A.counts.size):
        changed = blocks == 0
        for b in range(blocks):
            now = lanes(negated(values[i * blocks + b] == 0.0))
            changed |= now != A.seen[i, b]
            A.seen[i, b] = now
        if not changed:
            continue
        count = 0
        for a in range(A.places.shape[1]):
            A.places[i, count] = a
            count += A.values[i, a] != 0.0
        A.counts[i] = count


@compiled(types.void(SPARSE, float64[:, ::1], float64[:, ::1]), **REORDER)
def multiply(A, B, out):
    """A B, with what is not zero in A alone.

    Args:
        A: Sparse, its non-zeros found. B: (columns of A, padded). out: (rows of A, padded).
    """
    blocks = np.uint64(out.shape[1] // SIMD_WIDTH)
    rows, product = simd_blocks(B), simd_blocks(out)
    for i in range(np.uint64(A.counts.size)):
        at = i * blocks
        for b in range(np.uint64(0), blocks, TWO):
            left, right = 0.0, 0.0
            for c in range(np.uint64(A.counts[i])):
                a = np.uint64(A.places[i, c])
                weight = A.values[i, a]
                left += weight * rows[a * blocks + b]
                right += weight * rows[a * blocks + b + ONE]
            product[at + b] = left
            product[at + b + ONE] = right


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
