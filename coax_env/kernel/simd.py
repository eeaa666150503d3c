"""SIMD batches: SIMD_WIDTH helicopters side by side in one register, flown by the same source as one.

A compiled function is compiled anew for every type of its arguments. So the kernel's functions, handed
arrays of registers (one double per helicopter) instead of arrays of doubles, become code that flies
SIMD_WIDTH helicopters with one instruction: one physics, two machine codes. One helicopter's place in
the registers is a lane. What `dynamics.step` needs of a number is defined for registers: arithmetic
and comparison (simd_operators.py), the functions of `math` (simd_math.py).

Three types (simd_types.py): SimdFloat64, SIMD_WIDTH doubles; SimdBoolean, what comparing them gives;
SimdUInt64, unsigned 64-bit numbers. Where helicopters differ there is no branch but `select`; a branch
on a SimdBoolean does not compile. ``!=`` alone gives one truth, whether any lane differs: it asks
whether an effect is on.

Products and sums may be fused, so lanes agree with the scalar kernel to rounding, not to the bit.
"""

from coax_env.kernel.simd_math import over_root, sine_and_cosine, sines_and_cosines
from coax_env.kernel.simd_operators import (
    any_lane,
    bits_of,
    by_type,
    from_bits,
    is_register,
    lane,
    lanes,
    negated,
    select,
)
from coax_env.kernel.simd_rows import (
    REGISTERS,
    gather,
    scatter,
    simd_blocks,
    simd_scratch,
    simd_view,
    simd_view_uint64,
    transpose,
)
from coax_env.kernel.simd_types import SIMD_WIDTH

__all__ = [
    "REGISTERS",
    "SIMD_WIDTH",
    "any_lane",
    "bits_of",
    "by_type",
    "from_bits",
    "gather",
    "is_register",
    "lane",
    "lanes",
    "negated",
    "over_root",
    "scatter",
    "select",
    "simd_blocks",
    "simd_scratch",
    "simd_view",
    "simd_view_uint64",
    "sine_and_cosine",
    "sines_and_cosines",
    "transpose",
]
