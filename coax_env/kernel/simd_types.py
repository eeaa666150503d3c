"""The types of SIMD registers: SIMD_WIDTH doubles, truths or 64-bit numbers in one value."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import lower_cast, models, register_model

from coax_env.kernel.numba_internals import SAFE

SIMD_WIDTH = 8
"""Helicopters in one group, a multiple of four: the doubles of two AVX2 registers."""

I32 = ir.IntType(32)


class SimdType(types.Type):
    """SIMD_WIDTH values of one kind in a register."""

    def __init__(self, name: str, element: ir.Type) -> None:
        self.element = element
        super().__init__(name=name)

    @property
    def vector(self) -> ir.Type:
        """The register's type."""
        return ir.VectorType(self.element, SIMD_WIDTH)


class SimdFloat64Type(SimdType):
    """SIMD_WIDTH doubles."""

    def can_convert_from(self, typingctx: Any, other: types.Type) -> Any:
        """Any real number stands for itself in every lane."""
        return SAFE if isinstance(other, types.Float | types.Integer) else None

    def unify(self, typingctx: Any, other: types.Type) -> types.Type | None:
        """A variable that is a number here and a register there is a register."""
        return self if isinstance(other, types.Float | types.Integer) else None


class SimdBooleanType(SimdType):
    """SIMD_WIDTH truths."""


class SimdUInt64Type(SimdType):
    """SIMD_WIDTH unsigned 64-bit numbers."""

    def can_convert_from(self, typingctx: Any, other: types.Type) -> Any:
        """Any whole number stands for itself in every lane."""
        return SAFE if isinstance(other, types.Integer) else None


SIMD_FLOAT64 = SimdFloat64Type("SimdFloat64", ir.DoubleType())
SIMD_BOOLEAN = SimdBooleanType("SimdBoolean", ir.IntType(1))
SIMD_UINT64 = SimdUInt64Type("SimdUInt64", ir.IntType(64))


@register_model(SimdFloat64Type)
@register_model(SimdBooleanType)
@register_model(SimdUInt64Type)
class _SimdModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: SimdType) -> None:
        super().__init__(dmm, fe_type, fe_type.vector)


def constant(kind: SimdType, value: Any) -> Any:
    """A register with the same constant in every lane."""
    return ir.Constant(kind.vector, [value] * SIMD_WIDTH)


def _in_every_lane(builder: Any, value: Any) -> Any:
    vector = ir.VectorType(value.type, SIMD_WIDTH)
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(I32, 0))
    zeros = ir.Constant(ir.VectorType(I32, SIMD_WIDTH), [0] * SIMD_WIDTH)
    return builder.shuffle_vector(first, undefined, zeros)


@lower_cast(types.Float, SimdFloat64Type)
@lower_cast(types.Integer, SimdFloat64Type)
def _from_number(context: Any, builder: Any, found: Any, wanted: Any, value: Any) -> Any:
    return _in_every_lane(builder, context.cast(builder, value, found, types.float64))


@lower_cast(types.Integer, SimdUInt64Type)
def _from_whole_number(context: Any, builder: Any, found: Any, wanted: Any, value: Any) -> Any:
    return _in_every_lane(builder, context.cast(builder, value, found, types.uint64))
