"""Arrays of SIMD registers: over the memory of others, on the stack; and rows in and out of them."""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from coax_env.kernel.compilation import compiled
from coax_env.kernel.numba_internals import (
    array_data,
    stack_array,
    unpack_tuple,
    view_flat,
    view_rows,
)
from coax_env.kernel.simd_types import I32, SIMD_FLOAT64, SIMD_UINT64, SIMD_WIDTH, SimdType

_REGISTER_BYTES = 8 * SIMD_WIDTH


def _row_of(kind: SimdType) -> types.Array:
    return types.Array(kind, 1, "C", aligned=False)


REGISTERS = _row_of(SIMD_FLOAT64)
"""numba's type of an array of registers."""


def _view(kind: SimdType, source: types.Array) -> tuple[Any, Callable]:
    """`simd_view` for one kind of register: numba's signature, and what writes the code."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return view_rows(
            context, builder, source, args[0], _row_of(kind), kind.vector, _REGISTER_BYTES
        )

    return _row_of(kind)(source), emit


@intrinsic
def simd_view(typingctx, array):
    """A contiguous array (n, SIMD_WIDTH) of doubles as n registers, the same memory."""
    return _view(SIMD_FLOAT64, array)


@intrinsic
def simd_view_uint64(typingctx, array):
    """A contiguous array (n, SIMD_WIDTH) of 64-bit numbers as n registers, the same memory."""
    return _view(SIMD_UINT64, array)


@intrinsic
def simd_blocks(typingctx, array):
    """A contiguous array of doubles as registers of SIMD_WIDTH neighbours, the same memory.

    What is left of a last register is not in it: rows are best a multiple of SIMD_WIDTH long.
    """
    row, vector = _row_of(SIMD_FLOAT64), SIMD_FLOAT64.vector

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return view_flat(context, builder, array, args[0], row, vector, _REGISTER_BYTES)

    return row(array), emit


@intrinsic
def simd_scratch(typingctx, n):
    """So many registers of doubles on the stack, not set; `n` is a constant.

    Where the code that uses them is inlined and its indices are constant, they stay in registers.
    """
    if not isinstance(n, types.IntegerLiteral):
        return None
    row, vector = _row_of(SIMD_FLOAT64), SIMD_FLOAT64.vector

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return stack_array(context, builder, row, vector, n.literal_value, _REGISTER_BYTES)

    return row(types.literal(n.literal_value)), emit


def _four_by_four(builder: Any, rows: list) -> list:
    """Four vectors of four, transposed."""

    def mixed(a: Any, b: Any, places: list[int]) -> Any:
        return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(I32, 4), places))

    low = [mixed(rows[i], rows[i + 1], [0, 4, 2, 6]) for i in (0, 2)]
    high = [mixed(rows[i], rows[i + 1], [1, 5, 3, 7]) for i in (0, 2)]
    return [
        mixed(pair[0], pair[1], half)
        for half in ([0, 1, 4, 5], [2, 3, 6, 7])
        for pair in (low, high)
    ]


def _eight_by_eight(builder: Any, rows: list) -> list:
    """Eight vectors of eight, transposed: pairs of rows, pairs of pairs, halves."""

    def mixed(a: Any, b: Any, places: list[int]) -> Any:
        return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(I32, 8), places))

    pairs = [
        [mixed(rows[i], rows[i + 1], [k, k + 8, k + 2, k + 10, k + 4, k + 12, k + 6, k + 14])
         for i in range(0, 8, 2)]
        for k in (0, 1)
    ]  # fmt: skip
    fours = [
        [mixed(of[i], of[i + 1], [k, k + 1, k + 8, k + 9, k + 4, k + 5, k + 12, k + 13])
         for i in (0, 2)]
        for k in (0, 2)
        for of in pairs
    ]  # fmt: skip
    return [
        mixed(low, high, [k, k + 1, k + 2, k + 3, k + 8, k + 9, k + 10, k + 11])
        for k in (0, 4)
        for low, high in fours
    ]


@intrinsic
def _transpose_registers(typingctx, source, first, step, target, to, stride):
    """Eight registers, `step` apart from `first` on, transposed to those from `to` on."""
    signature_ = types.void(source, first, step, target, to, stride)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        from_, since, step, into, to, stride = args

        def at(kind: Any, array: Any, start: Any, distance: Any, k: int) -> Any:
            place = builder.add(start, builder.mul(distance, ir.Constant(distance.type, k)))
            return builder.gep(array_data(context, builder, kind, array), [place])

        found = [builder.load(at(source, from_, since, step, k), align=8) for k in range(8)]
        for k, row in enumerate(_eight_by_eight(builder, found)):
            builder.store(row, at(target, into, to, stride, k), align=8)
        return context.get_dummy_value()

    return signature_, emit


@intrinsic
def _transpose(typingctx, source, places, target, targets):
    """Four times four numbers at these places of a flat array, transposed to those of another."""
    signature_ = types.void(source, places, target, targets)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        def at(array: Any, kind: Any, place: Any) -> Any:
            pointer = builder.gep(array_data(context, builder, kind, array), [place])
            element = context.get_value_type(kind.dtype)
            return builder.bitcast(pointer, ir.VectorType(element, 4).as_pointer())

        size = {t: t.bitwidth // 8 for t in (source.dtype, target.dtype)}
        found = [
            builder.load(at(args[0], source, place), align=size[source.dtype])
            for place in unpack_tuple(builder, args[1], 4)
        ]
        found = _four_by_four(builder, found)
        if target.dtype != source.dtype:
            narrow = ir.VectorType(context.get_value_type(target.dtype), 4)
            found = [builder.fptrunc(row, narrow) for row in found]
        for row, place in zip(found, unpack_tuple(builder, args[3], 4), strict=True):
            builder.store(row, at(args[2], target, place), align=size[target.dtype])
        return context.get_dummy_value()

    return signature_, emit


@compiled()
def gather(rows, which, block):
    """A group's rows into a SIMD block, one row a lane.

    Args:
        rows: (count, at least n). which: the group's rows (SIMD_WIDTH,).
        block: (n, SIMD_WIDTH), out.
    """
    n, stride = len(block), rows.shape[1]
    if n < 4:
        for j in range(SIMD_WIDTH):
            for k in range(n):
                block[k, j] = rows[which[j], k]
        return
    for j in range(0, SIMD_WIDTH, 4):
        a, b, c, d = (which[j] * stride, which[j + 1] * stride, which[j + 2] * stride,
                      which[j + 3] * stride)  # fmt: skip
        for i in range(0, n, 4):
            k = min(i, n - 4)  # the last four columns may overlap those before
            to = k * SIMD_WIDTH + j
            _transpose(
                rows, (a + k, b + k, c + k, d + k),
                block, (to, to + SIMD_WIDTH, to + 2 * SIMD_WIDTH, to + 3 * SIMD_WIDTH),
            )  # fmt: skip


@compiled()
def scatter(block, which, some, rows):
    """The first lanes of a SIMD block back into their rows.

    Args:
        block: (n, SIMD_WIDTH). which: the group's rows (SIMD_WIDTH,).
        some: how many of the lanes count. rows: (count, at least n), out.
    """
    n, stride = len(block), rows.shape[1]
    if some < SIMD_WIDTH or n < 4:
        for j in range(some):
            for k in range(n):
                rows[which[j], k] = block[k, j]
        return
    for j in range(0, SIMD_WIDTH, 4):
        a, b, c, d = (which[j] * stride, which[j + 1] * stride, which[j + 2] * stride,
                      which[j + 3] * stride)  # fmt: skip
        for i in range(0, n, 4):
            k = min(i, n - 4)
            to = k * SIMD_WIDTH + j
            _transpose(
                block, (to, to + SIMD_WIDTH, to + 2 * SIMD_WIDTH, to + 3 * SIMD_WIDTH),
                rows, (a + k, b + k, c + k, d + k),
            )  # fmt: skip


@compiled()
def transpose(matrix, out):
    """A square matrix of whole registers, transposed.

    Args:
        matrix: (n, n), n a multiple of SIMD_WIDTH. out: (n, n).
    """
    rows, turned = simd_blocks(matrix), simd_blocks(out)
    eight = np.uint64(SIMD_WIDTH)
    blocks = np.uint64(matrix.shape[1] // SIMD_WIDTH)
    for i in range(blocks):
        for j in range(blocks):
            since, to = i * eight * blocks + j, j * eight * blocks + i
            _transpose_registers(rows, since, blocks, turned, to, blocks)
