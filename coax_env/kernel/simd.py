"""Lanes: SIMD_WIDTH helicopters side by side in one register, flown by the same source as one.

A compiled function is compiled anew for every type of its arguments. So the kernel's functions, handed
arrays of `Lanes` (one double per helicopter) instead of arrays of doubles, become code that flies SIMD_WIDTH
helicopters with one instruction: one physics, two machine codes. What `dynamics.step` needs of a number
is defined here for `Lanes`: arithmetic, comparison and the functions of `math`.

Three types: `Lanes`, SIMD_WIDTH doubles; `Flags`, SIMD_WIDTH truths, what comparing lanes gives; `Words`,
SIMD_WIDTH unsigned 64-bit numbers. Where helicopters differ there is no branch but `select`; a branch on
flags does not compile. ``!=`` alone gives one truth, whether any lane differs: it asks whether an
effect is on.

Products and sums may be fused, so lanes agree with the scalar kernel to rounding, not to the bit.
"""

import functools
import itertools
import math
import operator
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, Signature, infer_global, signature
from numba.extending import (
    intrinsic,
    lower_builtin,
    lower_cast,
    models,
    overload,
    register_model,
)
from numba.np.arrayobj import make_array, populate_array

from coax_env.kernel.compilation import compiled, name_apart

SIMD_WIDTH = 8
"""Helicopters in one group, a multiple of four: the doubles of two AVX2 registers."""

_I32 = ir.IntType(32)

_LOOSE = ("contract", "arcp")  # products and sums fused, divisions by one divisor shared
_INLINE = {"forceinline": True}


# --- the types ------------------------------------------------------------------------------------


class _Vector(types.Type):
    """SIMD_WIDTH values of one kind in a register."""

    def __init__(self, name: str, element: ir.Type) -> None:
        self.element = element
        super().__init__(name=name)

    @property
    def vector(self) -> ir.Type:
        """The register's type."""
        return ir.VectorType(self.element, SIMD_WIDTH)


class LanesType(_Vector):
    """SIMD_WIDTH doubles."""

    def can_convert_from(self, typingctx: Any, other: types.Type) -> Conversion | None:
        """Any real number stands for itself in every lane."""
        return Conversion.safe if isinstance(other, types.Float | types.Integer) else None

    def unify(self, typingctx: Any, other: types.Type) -> types.Type | None:
        """A variable that is a number here and lanes there is lanes."""
        return self if isinstance(other, types.Float | types.Integer) else None


class FlagsType(_Vector):
    """SIMD_WIDTH truths."""


class WordsType(_Vector):
    """SIMD_WIDTH unsigned 64-bit numbers."""

    def can_convert_from(self, typingctx: Any, other: types.Type) -> Conversion | None:
        """Any whole number stands for itself in every lane."""
        return Conversion.safe if isinstance(other, types.Integer) else None


LANES = LanesType("Lanes", ir.DoubleType())
FLAGS = FlagsType("Flags", ir.IntType(1))
WORDS = WordsType("Words", ir.IntType(64))


@register_model(LanesType)
@register_model(FlagsType)
@register_model(WordsType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: _Vector) -> None:
        super().__init__(dmm, fe_type, fe_type.vector)


def _splat(builder: Any, value: Any) -> Any:
    vector = ir.VectorType(value.type, SIMD_WIDTH)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, _index(0))
    zeros = ir.Constant(ir.VectorType(_I32, SIMD_WIDTH), [0] * SIMD_WIDTH)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def _index(i: int) -> Any:
    return ir.Constant(_I32, i)


@lower_cast(types.Float, LanesType)
@lower_cast(types.Integer, LanesType)
def _number_as_lanes(context: Any, builder: Any, found: Any, wanted: Any, value: Any) -> Any:
    return _splat(builder, context.cast(builder, value, found, types.float64))


@lower_cast(types.Integer, WordsType)
def _number_as_words(context: Any, builder: Any, found: Any, wanted: Any, value: Any) -> Any:
    return _splat(builder, context.cast(builder, value, found, types.uint64))


# --- operators and functions ------------------------------------------------------------------------


def _define(key: Any, kinds: tuple[_Vector, ...], result: types.Type, emit: Callable) -> None:
    """What an operator or function does with arguments of these kinds; numbers are cast to them.

    ``emit(builder, *values)`` writes its code.
    """

    def fits(argument: types.Type, kind: _Vector) -> bool:
        numbers = {LANES: (types.Float, types.Integer), WORDS: (types.Integer,), FLAGS: ()}[kind]
        return argument == kind or isinstance(argument, numbers)

    class Typing(AbstractTemplate):
        def generic(self, args: tuple, kws: dict) -> Signature | None:
            meant = len(args) == len(kinds) and any(isinstance(a, _Vector) for a in args)
            if meant and not kws and all(map(fits, args, kinds)):
                return signature(result, *kinds)
            return None

    infer_global(key)(Typing)

    @lower_builtin(key, *kinds)
    def lowered(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = [
            ir.Constant(kind.vector, [kind.element(arg)] * SIMD_WIDTH)
            if isinstance(arg, int)
            else arg
            for arg, kind in zip(args, kinds, strict=True)
        ]
        return emit(builder, *values)


def _called(name: str) -> Callable:
    """Code that calls one of LLVM's own functions of lanes."""

    def emit(builder: Any, *values: Any) -> Any:
        kinds = [LANES.vector] * len(values)
        suffix = f"v{SIMD_WIDTH}f64"
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(LANES.vector, kinds), f"llvm.{name}.{suffix}"
        )
        return builder.call(function, values)

    return emit


def _any(builder: Any, flags: Any) -> Any:
    bits = builder.bitcast(flags, ir.IntType(SIMD_WIDTH))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


def _choose(sign: str) -> Callable:
    return lambda b, x, y: b.select(b.fcmp_ordered(sign, y, x), y, x)


_TWO = (LANES, LANES)
_fabs = _called("fabs")
_INFINITE = ir.Constant(LANES.vector, [math.inf] * SIMD_WIDTH)
for _name, _emit in {
    "add": lambda b, x, y: b.fadd(x, y, flags=_LOOSE),
    "sub": lambda b, x, y: b.fsub(x, y, flags=_LOOSE),
    "mul": lambda b, x, y: b.fmul(x, y, flags=_LOOSE),
    "truediv": lambda b, x, y: b.fdiv(x, y, flags=_LOOSE),
}.items():
    _define(getattr(operator, _name), _TWO, LANES, _emit)
    _define(getattr(operator, f"i{_name}"), _TWO, LANES, _emit)
for _name, _sign in {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "=="}.items():
    _define(
        getattr(operator, _name), _TWO, FLAGS,
        lambda b, x, y, _sign=_sign: b.fcmp_ordered(_sign, x, y),
    )  # fmt: skip
_define(operator.ne, _TWO, types.boolean, lambda b, x, y: _any(b, b.fcmp_unordered("!=", x, y)))
_define(operator.neg, (LANES,), LANES, lambda b, x: b.fneg(x))
_define(abs, (LANES,), LANES, _fabs)
_define(max, _TWO, LANES, _choose(">"))
_define(min, _TWO, LANES, _choose("<"))
_define(math.sqrt, (LANES,), LANES, _called("sqrt"))
_define(math.floor, (LANES,), LANES, _called("floor"))
_define(math.isfinite, (LANES,), FLAGS, lambda b, x: b.fcmp_ordered("<", _fabs(b, x), _INFINITE))
_define(operator.and_, (FLAGS, FLAGS), FLAGS, lambda b, x, y: b.and_(x, y))
_define(operator.or_, (FLAGS, FLAGS), FLAGS, lambda b, x, y: b.or_(x, y))

for _name, _emit in {
    "add": lambda b, x, y: b.add(x, y),
    "mul": lambda b, x, y: b.mul(x, y),
    "xor": lambda b, x, y: b.xor(x, y),
    "and_": lambda b, x, y: b.and_(x, y),
    "or_": lambda b, x, y: b.or_(x, y),
    "lshift": lambda b, x, y: b.shl(x, y),
    "rshift": lambda b, x, y: b.lshr(x, y),
}.items():
    _define(getattr(operator, _name), (WORDS, WORDS), WORDS, _emit)
    _define(getattr(operator, f"i{_name.strip('_')}"), (WORDS, WORDS), WORDS, _emit)


_versions = itertools.count()


def _by_kind(key: Any) -> Callable[[Callable], Callable]:
    """`numba.extending.overload`, inlined; each version under a name of its own (jit.name_apart)."""

    def enter(choose: Callable) -> Callable:
        @functools.wraps(choose)
        def version(*args: Any, **kws: Any) -> Callable | None:
            chosen = choose(*args, **kws)
            return chosen and name_apart(chosen, next(_versions))

        overload(key, jit_options=_INLINE)(version)
        return choose

    return enter


def select(flag: Any, yes: Any, no: Any) -> Any:
    """`yes` where the flag is true, else `no`: of one helicopter or of each lane."""
    return yes if flag else no


def negated(flag: Any) -> Any:
    """Not a flag: of one helicopter or of each lane."""
    return not flag


def anywhere(flag: Any) -> Any:
    """Whether a flag is true in any lane."""
    return flag


_define(select, (FLAGS, LANES, LANES), LANES, lambda b, c, x, y: b.select(c, x, y))
_define(negated, (FLAGS,), FLAGS, lambda b, x: b.not_(x))
_define(anywhere, (FLAGS,), types.boolean, _any)


@_by_kind(select)
def _select_one(flag, yes, no):
    if isinstance(flag, types.Boolean):
        return lambda flag, yes, no: yes if flag else no
    return None


@_by_kind(negated)
def _negated_one(flag):
    return (lambda flag: not flag) if isinstance(flag, types.Boolean) else None


@_by_kind(anywhere)
def _anywhere_one(flag):
    if isinstance(flag, types.Boolean):
        return lambda flag: flag
    return None


# --- angles ----------------------------------------------------------------------------------------

# pi/2 in three parts (Cody and Waite): the first two have zeros behind, so that n times them is exact
_PI_1 = float.fromhex("0x1.921fb54400000p+0")
_PI_2 = float.fromhex("0x1.0b4611a600000p-34")
_PI_3 = float.fromhex("0x1.3198a2e037073p-69")
_FARTHEST = 1e6  # [quarter turns]; beyond it, n times the parts is not exact


_EIGHTH = 0.25 * math.pi


def sine_and_cosine(x):
    """Sine and cosine of a number or of lanes [rad]."""
    return math.sin(x), math.cos(x)


def sines_and_cosines(x, y):
    """Sine and cosine of one angle [rad], and of another: of two numbers, or of lanes."""
    return sine_and_cosine(x), sine_and_cosine(y)


@_by_kind(sine_and_cosine)
def _sine_and_cosine_of(x):
    def of_lanes(x):
        return _wound(x) if anywhere(abs(x) > _EIGHTH) else _within_an_eighth(x)

    def of_numbers(x):
        return _within_an_eighth(x) if abs(x) <= _EIGHTH else (math.sin(x), math.cos(x))

    return of_lanes if x == LANES else of_numbers


@_by_kind(sines_and_cosines)
def _sines_and_cosines_of(x, y):
    def of_lanes(x, y):
        if anywhere(max(abs(x), abs(y)) > _EIGHTH):
            return _wound(x), _wound(y)
        return _within_an_eighth(x), _within_an_eighth(y)

    return of_lanes if x == LANES else lambda x, y: (sine_and_cosine(x), sine_and_cosine(y))


@numba.njit(error_model="numpy", **_INLINE)
def _within_an_eighth(r):
    """Sine and cosine to 1e-15 within an eighth of a turn: the polynomials of Cephes (Moshier 1989)."""
    z = r * r
    s = 1.58962301576546568060e-10 * z - 2.50507477628578072866e-8
    s = s * z + 2.75573136213857245213e-6
    s = s * z - 1.98412698295895385996e-4
    s = s * z + 8.33333333332211858878e-3
    s = s * z - 1.66666666666666307295e-1
    c = 2.08757008419747316778e-9 - 1.13585365213876817300e-11 * z
    c = c * z - 2.75573141792967388112e-7
    c = c * z + 2.48015872888517045348e-5
    c = c * z - 1.38888888888730564116e-3
    c = c * z + 4.16666666666665929218e-2
    return s * z * r + r, c * z * z - 0.5 * z + 1.0


@numba.njit(error_model="numpy", **_INLINE)
def _wound(x):
    """Sine and cosine to 1e-15 of angles however many turns; NaN beyond a million quarter turns."""
    n = math.floor(x * (2.0 / math.pi) + 0.5)
    n = select(abs(n) < _FARTHEST, n, math.nan)
    s, c = _within_an_eighth(((x - n * _PI_1) - n * _PI_2) - n * _PI_3)
    half = math.floor(0.5 * n)
    odd = n - 2.0 * half  # 0 or 1: quarter turns
    back = half - 2.0 * math.floor(0.5 * half)  # 0 or 1: half turns
    sign = 1.0 - 2.0 * back
    swapped = odd > 0.5
    return select(swapped, c, s) * sign, select(swapped, s, c) * (sign - 2.0 * sign * odd)


@_by_kind(math.sin)
def _sine(x):
    return (lambda x: sine_and_cosine(x)[0]) if x == LANES else None


@_by_kind(math.cos)
def _cosine(x):
    return (lambda x: sine_and_cosine(x)[1]) if x == LANES else None


# --- powers ----------------------------------------------------------------------------------------


def bits_of(x):
    """The bits of a double, or of lanes, as 64-bit numbers."""


def from_bits(words):
    """The double, or the lanes, of these bits."""


_define(bits_of, (LANES,), WORDS, lambda b, x: b.bitcast(x, WORDS.vector))
_define(from_bits, (WORDS,), LANES, lambda b, x: b.bitcast(x, LANES.vector))


def _same_bits(result: types.Type) -> Callable:
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(result))

    return lambda typingctx, x: (result(x), emit)


@intrinsic
def _bits_of_one(typingctx, x):
    return _same_bits(types.uint64)(typingctx, x)


@intrinsic
def _from_bits_of_one(typingctx, words):
    return _same_bits(types.float64)(typingctx, words)


@_by_kind(bits_of)
def _bits_of_number(x):
    return (lambda x: _bits_of_one(x)) if x == types.float64 else None


@_by_kind(from_bits)
def _number_of_bits(words):
    return (lambda words: _from_bits_of_one(words)) if words == types.uint64 else None


_WHOLE = np.uint64(0x4330000000000000)  # the bits of 2^52: under them a whole number fits
_MANTISSA = np.uint64(0x000FFFFFFFFFFFFF)
_HALF = np.uint64(0x3FE0000000000000)  # the exponent of [0.5, 1)
_EXPONENT = np.uint64(52)
_LN2_HIGH, _LN2_LOW = 0.693145751953125, 1.42860682030941723212e-6


@_by_kind(float)
def _whole_number(words):
    """Words under 2^52 as lanes."""
    if words != WORDS:
        return None
    return lambda words: from_bits(words | _WHOLE) - 2.0**52


@_by_kind(math.exp)
def _exponential(x):
    """exp, to 2e-16 of itself (Cephes, Moshier 1989); arguments are clipped to +-708."""

    def exponential(x):
        x = max(min(x, 708.0), -708.0)
        n = math.floor(x * 1.4426950408889634 + 0.5)
        r = (x - n * _LN2_HIGH) - n * _LN2_LOW
        z = r * r
        a = 1.26177193074810590878e-4 * z + 3.02994407707441961300e-2
        a = (a * z + 9.99999999999999999910e-1) * r
        b = 3.00198505138664455042e-6 * z + 2.52448340349684104192e-3
        b = (b * z + 2.27265548208155028766e-1) * z + 2.0
        scale = from_bits(bits_of(n + (1.5 * 2.0**52 + 1023.0)) << _EXPONENT)
        return (1.0 + 2.0 * (a / (b - a))) * scale

    return exponential if x == LANES else None


@_by_kind(math.log)
def _logarithm(x):
    """Natural logarithm of positive normal numbers, to 3e-16 (Cephes, Moshier 1989).

    NaN at what is not positive.
    """

    def logarithm(x):
        bits = bits_of(x)
        exponent = float(bits >> _EXPONENT) - 1022.0
        m = from_bits((bits & _MANTISSA) | _HALF)
        low = m < math.sqrt(0.5)
        exponent = select(low, exponent - 1.0, exponent)
        r = select(low, 2.0 * m, m) - 1.0
        z = r * r
        a = 1.01875663804580931796e-4 * r + 4.97494994976747001425e-1
        a = a * r + 4.70579119878881725854
        a = a * r + 1.44989225341610930846e1
        a = a * r + 1.79368678507819816313e1
        a = a * r + 7.70838733755885391666
        b = r + 1.12873587189167450590e1
        b = b * r + 4.52279145837532221105e1
        b = b * r + 8.29875266912776603211e1
        b = b * r + 7.11544750618563894466e1
        b = b * r + 2.31251620126765340583e1
        y = r * z * a / b - exponent * 2.121944400546905827679e-4 - 0.5 * z
        return select(x > 0.0, (r + y) + exponent * 0.693359375, math.nan)

    return logarithm if x == LANES else None


# --- rows ------------------------------------------------------------------------------------------


def _view(kind: _Vector) -> Callable:
    """`simd_view` for one kind: a contiguous array (n, SIMD_WIDTH) as n lanes, the same memory."""
    row = types.Array(kind, 1, "C", aligned=False)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        source = make_array(sig.args[0])(context, builder, args[0])
        rows = make_array(row)(context, builder)
        count, _ = cgutils.unpack_tuple(builder, source.shape, 2)
        size = context.get_constant(types.intp, 8 * SIMD_WIDTH)
        data = builder.bitcast(source.data, kind.vector.as_pointer())
        populate_array(
            rows, data, shape=[count], strides=[size], itemsize=size, meminfo=source.meminfo
        )  # fmt: skip
        return impl_ret_borrowed(context, builder, row, rows._getvalue())

    return lambda typingctx, array: (row(array), emit)


@intrinsic
def simd_view(typingctx, array):
    """An array (n, SIMD_WIDTH) of doubles, contiguous, as n `Lanes`, the same memory."""
    return _view(LANES)(typingctx, array)


@intrinsic
def simd_view_uint64(typingctx, array):
    """An array (n, SIMD_WIDTH) of 64-bit numbers, contiguous, as n `Words`, the same memory."""
    return _view(WORDS)(typingctx, array)


@intrinsic
def simd_scratch(typingctx, n):
    """So many `Lanes` on the stack, not set; `n` is a constant.

    Where the code that uses them is inlined and its indices are constant, they become registers.
    """
    if not isinstance(n, types.IntegerLiteral):
        return None
    row = types.Array(LANES, 1, "C", aligned=False)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        count, size = (
            context.get_constant(types.intp, k) for k in (n.literal_value, 8 * SIMD_WIDTH)
        )
        with builder.goto_entry_block():
            place = builder.alloca(ir.ArrayType(LANES.vector, n.literal_value))
        rows = make_array(row)(context, builder)
        data = builder.bitcast(place, LANES.vector.as_pointer())
        populate_array(rows, data, shape=[count], strides=[size], itemsize=size, meminfo=None)
        return rows._getvalue()

    return row(types.literal(n.literal_value)), emit


def _four_by_four(builder: Any, rows: list) -> list:
    """Four vectors of four, transposed."""

    def mixed(a: Any, b: Any, places: list[int]) -> Any:
        return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, 4), places))

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
            pointer = builder.gep(make_array(kind)(context, builder, array).data, [place])
            element = context.get_value_type(kind.dtype)
            return builder.bitcast(pointer, ir.VectorType(element, 4).as_pointer())

        size = {t: t.bitwidth // 8 for t in (source.dtype, target.dtype)}
        found = [
            builder.load(at(args[0], source, place), align=size[source.dtype])
            for place in cgutils.unpack_tuple(builder, args[1], 4)
        ]
        found = _four_by_four(builder, found)
        if target.dtype != source.dtype:
            narrow = ir.VectorType(context.get_value_type(target.dtype), 4)
            found = [builder.fptrunc(row, narrow) for row in found]
        for row, place in zip(found, cgutils.unpack_tuple(builder, args[3], 4), strict=True):
            builder.store(row, at(args[2], target, place), align=size[target.dtype])
        return context.get_dummy_value()

    return signature_, emit


@compiled()
def gather(rows, which, lanes):
    """A group's rows, `which` (SIMD_WIDTH,) of `rows` (count, >= n), into the lanes (n, SIMD_WIDTH)."""
    n, stride = len(lanes), rows.shape[1]
    if n < 4:
        for j in range(SIMD_WIDTH):
            for k in range(n):
                lanes[k, j] = rows[which[j], k]
        return
    for j in range(0, SIMD_WIDTH, 4):
        a, b, c, d = (which[j] * stride, which[j + 1] * stride, which[j + 2] * stride,
                      which[j + 3] * stride)  # fmt: skip
        for i in range(0, n, 4):
            k = min(i, n - 4)  # the last four columns may overlap those before
            to = k * SIMD_WIDTH + j
            _transpose(
                rows, (a + k, b + k, c + k, d + k),
                lanes, (to, to + SIMD_WIDTH, to + 2 * SIMD_WIDTH, to + 3 * SIMD_WIDTH),
            )  # fmt: skip


@compiled()
def scatter(lanes, which, some, rows):
    """The first `some` lanes of (n, SIMD_WIDTH) back into their rows, `which` (SIMD_WIDTH,) of (count, >= n)."""
    n, stride = len(lanes), rows.shape[1]
    if some < SIMD_WIDTH or n < 4:
        for j in range(some):
            for k in range(n):
                rows[which[j], k] = lanes[k, j]
        return
    for j in range(0, SIMD_WIDTH, 4):
        a, b, c, d = (which[j] * stride, which[j + 1] * stride, which[j + 2] * stride,
                      which[j + 3] * stride)  # fmt: skip
        for i in range(0, n, 4):
            k = min(i, n - 4)
            to = k * SIMD_WIDTH + j
            _transpose(
                lanes, (to, to + SIMD_WIDTH, to + 2 * SIMD_WIDTH, to + 3 * SIMD_WIDTH),
                rows, (a + k, b + k, c + k, d + k),
            )  # fmt: skip
