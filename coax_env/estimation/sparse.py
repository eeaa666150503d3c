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
IN_ORDER: dict[str, Any] = {"fastmath": {"contract"}}
"""Sums are taken in their order: those of a few non-zeros, which take longer in registers."""
AT_ONCE = 4
"""Registers of a row that are summed side by side, since each sum by itself waits for what was added
last; three where a row ends with so many. Rows are padded with zeros until it does."""
ONE, TWO, THREE, FOUR = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
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
    """Length of a row of so many numbers: whole registers, the last ones four or three at once."""
    registers = (count + SIMD_WIDTH - 1) // SIMD_WIDTH
    last = registers % AT_ONCE
    if 0 < last < AT_ONCE - 1:
        registers += AT_ONCE - 1 - last
    return registers * SIMD_WIDTH


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


@compiled(forceinline=True, **IN_ORDER)
def along(A, i, vector):
    """Row `i` of A times a vector.

    Args:
        A: Sparse, its non-zeros found. i: of its rows. vector: (columns or more,).
    """
    total = 0.0
    for c in range(A.counts[i]):
        a = A.places[i, c]
        total += A.values[i, a] * vector[a]
    return total


@compiled(forceinline=True)
def in_fours(registers):
    """How many of so many registers are taken four at once; three are left, or none."""
    return registers // FOUR * FOUR


@compiled(forceinline=True)
def _three(registers, at):
    """Three neighbours."""
    return registers[at], registers[at + ONE], registers[at + TWO]


@compiled(forceinline=True)
def _set_three(registers, at, first, second, third):
    """Three neighbours set."""
    registers[at], registers[at + ONE], registers[at + TWO] = first, second, third


@compiled(forceinline=True)
def _four(registers, at):
    """Four neighbours."""
    return registers[at], registers[at + ONE], registers[at + TWO], registers[at + THREE]


@compiled(forceinline=True)
def _set_four(registers, at, first, second, third, fourth):
    """Four neighbours set."""
    registers[at], registers[at + ONE] = first, second
    registers[at + TWO], registers[at + THREE] = third, fourth


@compiled(forceinline=True, **REORDER)
def four_of_product(A, i, rows, at, blocks):
    """Row `i` of A times another matrix, of this the registers `at` to `at` + 3 of each row.

    Args:
        A: Sparse, its non-zeros found. i: of its rows. rows: registers of the other matrix.
        at: the first of four. blocks: registers of a row.
    """
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for c in range(np.uint64(A.counts[i])):
        a = np.uint64(A.places[i, c])
        weight = A.values[i, a]
        row = a * blocks + at
        first += weight * rows[row]
        second += weight * rows[row + ONE]
        third += weight * rows[row + TWO]
        fourth += weight * rows[row + THREE]
    return first, second, third, fourth


@compiled(forceinline=True, **REORDER)
def three_of_product(A, i, rows, at, blocks):
    """As `four_of_product`, the registers `at` to `at` + 2.

    Args:
        A, i, rows, blocks: as there. at: the first of three.
    """
    first, second, third = 0.0, 0.0, 0.0
    for c in range(np.uint64(A.counts[i])):
        a = np.uint64(A.places[i, c])
        weight = A.values[i, a]
        row = a * blocks + at
        first += weight * rows[row]
        second += weight * rows[row + ONE]
        third += weight * rows[row + TWO]
    return first, second, third


@compiled(forceinline=True, **REORDER)
def combine(weights, B, count, out):
    """Sum of the first `count` rows of B, each times its weight, into `out` (padded,).

    Args:
        weights: (count or more,). B: (rows, padded).
    """
    blocks = np.uint64(out.size // SIMD_WIDTH)
    rows, total = simd_blocks(B), simd_blocks(out)
    fours = in_fours(blocks)
    for b in range(np.uint64(0), fours, FOUR):
        first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
        for i in range(np.uint64(count)):
            weight = float64(weights[i])
            row = i * blocks + b
            first += weight * rows[row]
            second += weight * rows[row + ONE]
            third += weight * rows[row + TWO]
            fourth += weight * rows[row + THREE]
        _set_four(total, b, first, second, third, fourth)
    if fours < blocks:
        first, second, third = 0.0, 0.0, 0.0
        for i in range(np.uint64(count)):
            weight = float64(weights[i])
            row = i * blocks + fours
            first += weight * rows[row]
            second += weight * rows[row + ONE]
            third += weight * rows[row + TWO]
        _set_three(total, fours, first, second, third)


@compiled(forceinline=True, **REORDER)
def row_of_product(A, i, rows, blocks, product):
    """Row `i` of A times another matrix.

    Args:
        A: Sparse, its non-zeros found. i: of its rows. rows: registers of the other matrix.
        blocks: registers of a row. product: those of the result, out.
    """
    fours = in_fours(blocks)
    for b in range(np.uint64(0), fours, FOUR):
        first, second, third, fourth = four_of_product(A, i, rows, b, blocks)
        _set_four(product, b, first, second, third, fourth)
    if fours < blocks:
        first, second, third = three_of_product(A, i, rows, fours, blocks)
        _set_three(product, fours, first, second, third)


@compiled(types.void(SPARSE, float64[:, ::1], float64[:, ::1]), **REORDER)
def multiply(A, B, out):
    """A B, with what is not zero in A alone.

    Args:
        A: Sparse, its non-zeros found. B: (columns of A, padded). out: (rows of A, padded).
    """
    blocks = np.uint64(out.shape[1] // SIMD_WIDTH)
    rows, product = simd_blocks(B), simd_blocks(out)
    for i in range(np.uint64(A.counts.size)):
        row_of_product(A, i, rows, blocks, product[i * blocks :])


ROWS_AT_ONCE = np.uint64(32)
"""Rows of a tall matrix that stay in the nearest cache while all their products are summed; ours."""


@compiled(types.void(float64[:, ::1], int64, float64[:, ::1]), **REORDER)
def add_gram(J, count, G):
    """G += J' J, at and right of the diagonal, for the first `count` columns against all.

    Own, since a BLAS that shares such small products among threads takes longer for it. Two rows of G,
    four registers of each, are summed at a time.

    Args:
        J: (n, padded), its columns more than `count`. G: (padded, padded), in place.
    """
    blocks, n = np.uint64(J.shape[1] // SIMD_WIDTH), np.uint64(J.shape[0])
    rows, products = simd_blocks(J), simd_blocks(G)
    fours = in_fours(blocks)
    for since in range(np.uint64(0), n, ROWS_AT_ONCE):
        until = min(since + ROWS_AT_ONCE, n)
        for i in range(np.uint64(0), np.uint64(count), TWO):
            for b in range(in_fours(i // np.uint64(SIMD_WIDTH)), fours, FOUR):
                at, below = i * blocks + b, (i + ONE) * blocks + b
                p0, p1, p2, p3 = _four(products, at)
                q0, q1, q2, q3 = _four(products, below)
                for k in range(since, until):
                    weight, other = J[k, i], J[k, i + ONE]
                    r0, r1, r2, r3 = _four(rows, k * blocks + b)
                    p0, p1 = p0 + weight * r0, p1 + weight * r1
                    p2, p3 = p2 + weight * r2, p3 + weight * r3
                    q0, q1 = q0 + other * r0, q1 + other * r1
                    q2, q3 = q2 + other * r2, q3 + other * r3
                _set_four(products, at, p0, p1, p2, p3)
                _set_four(products, below, q0, q1, q2, q3)
            if fours < blocks:
                at, below = i * blocks + fours, (i + ONE) * blocks + fours
                p0, p1, p2 = _three(products, at)
                q0, q1, q2 = _three(products, below)
                for k in range(since, until):
                    weight, other = J[k, i], J[k, i + ONE]
                    r0, r1, r2 = _three(rows, k * blocks + fours)
                    p0, p1, p2 = p0 + weight * r0, p1 + weight * r1, p2 + weight * r2
                    q0, q1, q2 = q0 + other * r0, q1 + other * r1, q2 + other * r2
                _set_three(products, at, p0, p1, p2)
                _set_three(products, below, q0, q1, q2)


@compiled(types.void(float32[:, :, ::1], int64, SPARSE))
def unpack(stored, slot, A):
    """One of the stored matrices back into a Sparse one, with its non-zeros.

    Args:
        stored: (slots, rows or more, columns or more). slot: which.
        A: Sparse, out, with as many rows and columns as are to come back.
    """
    for i in range(A.counts.size):
        for j in range(A.places.shape[1]):
            A.values[i, j] = stored[slot, i, j]
    find_non_zeros(A)
