"""Arrays of SIMD registers: over the memory of others, on the stack; and rows in and out of them."""

from collections.abc import Callable
from typing import Any

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
def transpose(matrix, n, out):
    """The first n rows and columns of a matrix, transposed.

    Args:
        matrix: (n, at least n). n: how many. out: (n, at least n).
    """
    if n < 4:
        for i in range(n):
            for j in range(n):
                out[j, i] = matrix[i, j]
        return
    long, wide = matrix.shape[1], out.shape[1]
    for row in range(0, n, 4):
        i = min(row, n - 4)  # the last four may overlap those before
        for column in range(0, n, 4):
            j = min(column, n - 4)
            since, to = i * long + j, j * wide + i
            _transpose(
                matrix, (since, since + long, since + 2 * long, since + 3 * long),
                out, (to, to + wide, to + 2 * wide, to + 3 * wide),
            )  # fmt: skip
