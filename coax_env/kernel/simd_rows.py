"""Arrays of SIMD registers: over the memory of others, on the stack; and rows in and out of them."""

from collections.abc import Callable, Sequence
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


def _mixed(builder: Any, a: Any, b: Any, places: Sequence[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(I32, len(places)), list(places)))


_EVEN, _ODD = (0, 8, 2, 10, 4, 12, 6, 14), (1, 9, 3, 11, 5, 13, 7, 15)
"""Of two registers, in turns, the numbers at even places, and those at odd ones."""


def _lanes_of_rows(builder: Any, rows: list) -> list:
    """Eight rows of four numbers as four registers: a row in each lane."""
    pairs = [_mixed(builder, rows[i], rows[i + 2], range(8)) for i in (0, 1, 4, 5)]
    return [
        _mixed(
            builder,
            _mixed(builder, pairs[0], pairs[1], turns),
            _mixed(builder, pairs[2], pairs[3], turns),
            [k, k + 1, k + 4, k + 5, k + 8, k + 9, k + 12, k + 13],
        )
        for k in (0, 2)
        for turns in (_EVEN, _ODD)
    ]


def _rows_of_lanes(builder: Any, registers: list) -> list:
    """Four registers as eight rows of four numbers: `_lanes_of_rows` backwards."""
    even, odd = (
        [_mixed(builder, registers[i], registers[i + 1], turns) for i in (0, 2)]
        for turns in (_EVEN, _ODD)
    )
    return [
        _mixed(builder, low, high, [k, k + 1, k + 8, k + 9])
        for k in (0, 2, 4, 6)
        for low, high in (even, odd)
    ]


def _eight_by_eight(builder: Any, rows: list) -> list:
    """Eight vectors of eight, transposed: pairs of rows, pairs of pairs, halves."""
    pairs = [
        [_mixed(builder, rows[i], rows[i + 1], turns) for i in range(0, 8, 2)]
        for turns in (_EVEN, _ODD)
    ]
    fours = [
        [_mixed(builder, of[i], of[i + 1], [k, k + 1, k + 8, k + 9, k + 4, k + 5, k + 12, k + 13])
         for i in (0, 2)]
        for k in (0, 2)
        for of in pairs
    ]  # fmt: skip
    return [
        _mixed(builder, low, high, [k, k + 1, k + 2, k + 3, k + 8, k + 9, k + 10, k + 11])
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


def _four_columns(builder: Any, data: Any, starts: list, column: Any) -> list:
    """Pointers to four neighbours from a column on, in the rows that start at these places."""
    four = ir.VectorType(data.type.pointee, 4).as_pointer()
    first = builder.gep(data, [column])
    return [builder.bitcast(builder.gep(first, [start]), four) for start in starts]


@intrinsic
def _gather_columns(typingctx, rows, starts, column, block):
    """Four columns of eight rows, which start at these places of a flat array, into a block."""
    signature_ = types.void(rows, starts, column, block)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = array_data(context, builder, rows, args[0])
        places = unpack_tuple(builder, args[1], SIMD_WIDTH)
        found = [
            builder.load(place, align=8) for place in _four_columns(builder, data, places, args[2])
        ]
        to = _registers_of(context, builder, block, args[3], args[2])
        for register, place in zip(_lanes_of_rows(builder, found), to, strict=True):
            builder.store(register, place, align=8)
        return context.get_dummy_value()

    return signature_, emit


@intrinsic
def _scatter_columns(typingctx, block, column, rows, starts):
    """Four registers of a block into four columns of eight rows: `_gather_columns` backwards."""
    signature_ = types.void(block, column, rows, starts)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        found = [
            builder.load(place, align=8)
            for place in _registers_of(context, builder, block, args[0], args[1])
        ]
        data = array_data(context, builder, rows, args[2])
        to = _four_columns(builder, data, unpack_tuple(builder, args[3], SIMD_WIDTH), args[1])
        for numbers, place in zip(_rows_of_lanes(builder, found), to, strict=True):
            if rows.dtype != types.float64:
                numbers = builder.fptrunc(numbers, place.type.pointee)
            builder.store(numbers, place, align=rows.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return signature_, emit


def _registers_of(context: Any, builder: Any, kind: types.Array, block: Any, column: Any) -> list:
    """Pointers to four registers of a block (n, SIMD_WIDTH) from this one on."""
    data = array_data(context, builder, kind, block)
    first = builder.bitcast(data, SIMD_FLOAT64.vector.as_pointer())
    return [
        builder.gep(first, [builder.add(column, ir.Constant(column.type, k))]) for k in range(4)
    ]


@compiled()
def _starts(which, stride):
    """Where the eight rows of a group start in a flat array of rows of this length."""
    length = np.uint64(stride)
    a, b, c, d = (np.uint64(which[0]) * length, np.uint64(which[1]) * length,
                  np.uint64(which[2]) * length, np.uint64(which[3]) * length)  # fmt: skip
    e, f, g, h = (np.uint64(which[4]) * length, np.uint64(which[5]) * length,
                  np.uint64(which[6]) * length, np.uint64(which[7]) * length)  # fmt: skip
    return a, b, c, d, e, f, g, h


@compiled(forceinline=True)
def gather(rows, which, block):
    """A group's rows into a SIMD block, one row a lane.

    Args:
        rows: (count, at least n). which: the group's rows (SIMD_WIDTH,).
        block: (n, SIMD_WIDTH), out.
    """
    n = len(block)
    if n < 4:
        for j in range(SIMD_WIDTH):
            for k in range(n):
                block[k, j] = rows[which[j], k]
        return
    starts = _starts(which, rows.shape[1])
    for k in range(0, n - 4, 4):
        _gather_columns(rows, starts, k, block)
    _gather_columns(rows, starts, n - 4, block)  # may overlap those before


@compiled(forceinline=True)
def scatter(block, which, some, rows):
    """The first lanes of a SIMD block back into their rows.

    Args:
        block: (n, SIMD_WIDTH). which: the group's rows (SIMD_WIDTH,).
        some: how many of the lanes count. rows: (count, at least n), out.
    """
    n = len(block)
    if some < SIMD_WIDTH or n < 4:
        for j in range(some):
            for k in range(n):
                rows[which[j], k] = block[k, j]
        return
    starts = _starts(which, rows.shape[1])
    for k in range(0, n - 4, 4):
        _scatter_columns(block, k, rows, starts)
    _scatter_columns(block, n - 4, rows, starts)


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
