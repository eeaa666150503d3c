"""Operators of SIMD registers, and what stands for a branch where lanes differ.

Products and sums may be fused, so a register agrees with the scalar kernel to rounding, not to the bit.
"""

import functools
import itertools
import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from coax_env.kernel.compilation import name_apart
from coax_env.kernel.numba_internals import define_call, external_function
from coax_env.kernel.simd_types import (
    I32,
    SIMD_BOOLEAN,
    SIMD_FLOAT64,
    SIMD_UINT64,
    SIMD_WIDTH,
    SimdType,
    constant,
)

INLINE = {"forceinline": True}
_FUSED = ("contract", "arcp")  # products and sums fused, divisions by one divisor shared
_NUMBERS: dict[SimdType, tuple] = {
    SIMD_FLOAT64: (types.Float, types.Integer),
    SIMD_UINT64: (types.Integer,),
    SIMD_BOOLEAN: (),
}
"""What may stand for a register, and is cast to one."""


def _fits(argument: types.Type, kind: SimdType) -> bool:
    return argument == kind or isinstance(argument, _NUMBERS[kind])


def _define(key: Any, kinds: tuple[SimdType, ...], result: types.Type, emit: Callable) -> None:
    """What an operator or function does with registers of these kinds.

    ``emit(builder, *values)`` writes its code.
    """

    def lowered(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = [
            constant(kind, kind.element(arg)) if isinstance(arg, int) else arg
            for arg, kind in zip(args, kinds, strict=True)
        ]
        return emit(builder, *values)

    define_call(key, result, kinds, _fits, lowered)


def _llvm(name: str) -> Callable:
    """Code that calls one of LLVM's own functions of registers."""

    def emit(builder: Any, *values: Any) -> Any:
        vector = SIMD_FLOAT64.vector
        full_name = f"llvm.{name}.v{SIMD_WIDTH}f64"
        function = external_function(builder, full_name, vector, [vector] * len(values))
        return builder.call(function, values)

    return emit


def _any(builder: Any, flags: Any) -> Any:
    bits = builder.bitcast(flags, ir.IntType(SIMD_WIDTH))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


def _lanes(builder: Any, flags: Any) -> Any:
    return builder.zext(builder.bitcast(flags, ir.IntType(SIMD_WIDTH)), ir.IntType(64))


def _choose(sign: str) -> Callable:
    return lambda b, x, y: b.select(b.fcmp_ordered(sign, y, x), y, x)


_ONE, _TWO = (SIMD_FLOAT64,), (SIMD_FLOAT64, SIMD_FLOAT64)
_fabs = _llvm("fabs")
_INFINITE = constant(SIMD_FLOAT64, math.inf)
for _name, _emit in {
    "add": lambda b, x, y: b.fadd(x, y, flags=_FUSED),
    "sub": lambda b, x, y: b.fsub(x, y, flags=_FUSED),
    "mul": lambda b, x, y: b.fmul(x, y, flags=_FUSED),
    "truediv": lambda b, x, y: b.fdiv(x, y, flags=_FUSED),
}.items():
    _define(getattr(operator, _name), _TWO, SIMD_FLOAT64, _emit)
    _define(getattr(operator, f"i{_name}"), _TWO, SIMD_FLOAT64, _emit)
for _name, _sign in {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "=="}.items():
    _define(
        getattr(operator, _name), _TWO, SIMD_BOOLEAN,
        lambda b, x, y, _sign=_sign: b.fcmp_ordered(_sign, x, y),
    )  # fmt: skip
_define(operator.ne, _TWO, types.boolean, lambda b, x, y: _any(b, b.fcmp_unordered("!=", x, y)))
_define(operator.neg, _ONE, SIMD_FLOAT64, lambda b, x: b.fneg(x))
_define(abs, _ONE, SIMD_FLOAT64, _fabs)
_define(max, _TWO, SIMD_FLOAT64, _choose(">"))
_define(min, _TWO, SIMD_FLOAT64, _choose("<"))
_define(math.sqrt, _ONE, SIMD_FLOAT64, _llvm("sqrt"))
_define(math.floor, _ONE, SIMD_FLOAT64, _llvm("floor"))
_define(math.copysign, _TWO, SIMD_FLOAT64, _llvm("copysign"))
_define(
    math.isfinite, _ONE, SIMD_BOOLEAN, lambda b, x: b.fcmp_ordered("<", _fabs(b, x), _INFINITE)
)  # fmt: skip
_define(operator.and_, (SIMD_BOOLEAN, SIMD_BOOLEAN), SIMD_BOOLEAN, lambda b, x, y: b.and_(x, y))
_define(operator.or_, (SIMD_BOOLEAN, SIMD_BOOLEAN), SIMD_BOOLEAN, lambda b, x, y: b.or_(x, y))

for _name, _emit in {
    "add": lambda b, x, y: b.add(x, y),
    "mul": lambda b, x, y: b.mul(x, y),
    "xor": lambda b, x, y: b.xor(x, y),
    "and_": lambda b, x, y: b.and_(x, y),
    "or_": lambda b, x, y: b.or_(x, y),
    "lshift": lambda b, x, y: b.shl(x, y),
    "rshift": lambda b, x, y: b.lshr(x, y),
}.items():
    _define(getattr(operator, _name), (SIMD_UINT64, SIMD_UINT64), SIMD_UINT64, _emit)
    _define(
        getattr(operator, f"i{_name.strip('_')}"), (SIMD_UINT64, SIMD_UINT64), SIMD_UINT64, _emit
    )  # fmt: skip


_versions = itertools.count()


def by_type(key: Any) -> Callable[[Callable], Callable]:
    """`numba.extending.overload`, inlined; each version has a name of its own (`name_apart`)."""

    def enter(choose: Callable) -> Callable:
        @functools.wraps(choose)
        def version(*args: Any, **kws: Any) -> Callable | None:
            chosen = choose(*args, **kws)
            return chosen and name_apart(chosen, next(_versions))

        overload(key, jit_options=INLINE)(version)
        return choose

    return enter


def is_register(kind: types.Type) -> bool:
    """Whether a type is that of a register of doubles."""
    return kind == SIMD_FLOAT64


def select(flag: Any, yes: Any, no: Any) -> Any:
    """What stands for a branch: of one number, or of each lane by itself.

    Args:
        flag: truth, or register of truths. yes, no: what is chosen where it is true, and where not.
    """
    return yes if flag else no


def negated(flag: Any) -> Any:
    """Not a flag: of one or of each lane."""
    return not flag


def any_lane(flag: Any) -> Any:
    """Whether a flag is true in any lane."""
    return flag


def lanes(flag: Any) -> Any:
    """The lanes in which a flag is true, a bit each, as a number."""


_define(
    select, (SIMD_BOOLEAN, SIMD_FLOAT64, SIMD_FLOAT64), SIMD_FLOAT64,
    lambda b, c, x, y: b.select(c, x, y),
)  # fmt: skip
_define(negated, (SIMD_BOOLEAN,), SIMD_BOOLEAN, lambda b, x: b.not_(x))
_define(any_lane, (SIMD_BOOLEAN,), types.boolean, _any)
_define(lanes, (SIMD_BOOLEAN,), types.int64, _lanes)


@by_type(select)
def _select_one(flag, yes, no):
    if isinstance(flag, types.Boolean):
        return lambda flag, yes, no: yes if flag else no
    return None


@by_type(negated)
def _negated_one(flag):
    return (lambda flag: not flag) if isinstance(flag, types.Boolean) else None


@by_type(any_lane)
def _any_lane_one(flag):
    if isinstance(flag, types.Boolean):
        return lambda flag: flag
    return None


# --- lanes ---------------------------------------------------------------------------------------


@intrinsic
def lane(typingctx, register, k):
    """The number in the k-th lane of a register.

    Args:
        typingctx: numba's. register: SIMD_WIDTH numbers. k: the lane.
    """

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.extract_element(args[0], builder.trunc(args[1], I32))

    return types.float64(SIMD_FLOAT64, types.int64), emit


@intrinsic
def with_lane(typingctx, register, k, number):
    """A register with another number in its k-th lane.

    Args:
        typingctx: numba's. register: SIMD_WIDTH numbers. k: the lane. number: what it becomes.
    """

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.insert_element(args[0], args[2], builder.trunc(args[1], I32))

    return SIMD_FLOAT64(SIMD_FLOAT64, types.int64, types.float64), emit


# --- bits ----------------------------------------------------------------------------------------


def bits_of(x):
    """The bits of a double, or of each lane, as 64-bit numbers."""


def from_bits(bits):
    """The double of these 64 bits, or of each lane's."""


_define(bits_of, (SIMD_FLOAT64,), SIMD_UINT64, lambda b, x: b.bitcast(x, SIMD_UINT64.vector))
_define(from_bits, (SIMD_UINT64,), SIMD_FLOAT64, lambda b, x: b.bitcast(x, SIMD_FLOAT64.vector))


def _same_bits(result: types.Type) -> Callable:
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(result))

    return lambda typingctx, x: (result(x), emit)


@intrinsic
def _bits_of_one(typingctx, x):
    return _same_bits(types.uint64)(typingctx, x)


@intrinsic
def _from_bits_of_one(typingctx, bits):
    return _same_bits(types.float64)(typingctx, bits)


@by_type(bits_of)
def _bits_of_number(x):
    return (lambda x: _bits_of_one(x)) if x == types.float64 else None


@by_type(from_bits)
def _number_of_bits(bits):
    return (lambda bits: _from_bits_of_one(bits)) if bits == types.uint64 else None
