"""Sine, cosine, exponential, logarithm and powers of SIMD registers, and of numbers where it is faster;
what is seldom needed lane by lane.
"""

import math
import operator
from collections.abc import Callable

import numba
import numpy as np

from coax_env.kernel.simd_operators import (
    INLINE,
    any_lane,
    bits_of,
    by_type,
    from_bits,
    is_register,
    lane,
    select,
    with_lane,
)
from coax_env.kernel.simd_types import SIMD_FLOAT64, SIMD_UINT64, SIMD_WIDTH

# --- angles ----------------------------------------------------------------------------------------

# pi/2 in three parts (Cody and Waite): the first two have zeros behind, so that n times them is exact
_PI_1 = float.fromhex("0x1.921fb54400000p+0")
_PI_2 = float.fromhex("0x1.0b4611a600000p-34")
_PI_3 = float.fromhex("0x1.3198a2e037073p-69")
_ROUNDING = 1.5 * 2.0**52  # added to a number, leaves it whole in the last bits
_TO_SIGN, _TO_SIGN_2 = np.uint64(63), np.uint64(62)  # from the last bit, and from the one before
_SIGN, _ONE = np.uint64(0x8000000000000000), np.uint64(1)
_HALF = np.uint64(0x3FE0000000000000)  # the exponent of [0.5, 1)
_FARTHEST = 1e6  # [quarter turns]; beyond it, n times the parts is not exact


_EIGHTH = 0.25 * math.pi
_SMALL = 0.25  # [rad]: attitude and tilts in most flights


def sine_and_cosine(x):
    """Sine and cosine [rad] of a number, or of each lane."""
    return math.sin(x), math.cos(x)


def sines_and_cosines(x, y):
    """Sine and cosine of one angle [rad], and of another: of numbers, or of each lane."""
    return sine_and_cosine(x), sine_and_cosine(y)


@by_type(sine_and_cosine)
def _sine_and_cosine_of(x):
    def of_registers(x):
        return _wound(x) if any_lane(abs(x) > _EIGHTH) else _within_an_eighth(x)

    def of_numbers(x):
        return _within_an_eighth(x) if abs(x) <= _EIGHTH else (math.sin(x), math.cos(x))

    return of_registers if x == SIMD_FLOAT64 else of_numbers


@by_type(sines_and_cosines)
def _sines_and_cosines_of(x, y):
    def of_registers(x, y):
        farther = max(abs(x), abs(y))
        if any_lane(farther > _SMALL):
            if any_lane(farther > _EIGHTH):
                return _wound(x), _wound(y)
            return _within_an_eighth(x), _within_an_eighth(y)
        return _of_small(x), _of_small(y)

    return (
        of_registers if x == SIMD_FLOAT64 else lambda x, y: (sine_and_cosine(x), sine_and_cosine(y))
    )


@numba.njit(error_model="numpy", **INLINE)
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


@numba.njit(error_model="numpy", **INLINE)
def _of_small(r):
    """Sine and cosine to 1e-15 up to _SMALL: polynomials of least largest error (Remez)."""
    z = r * r
    s = 2.7519573458930775e-06 * z - 0.00019841250320814258
    s = s * z + 0.008333333329390031
    s = s * z - 0.16666666666664243
    c = 2.4801570239861958e-05 - 2.752506954858584e-07 * z
    c = c * z - 0.0013888888885418402
    c = c * z + 0.04166666666666469
    return s * z * r + r, c * z * z - 0.5 * z + 1.0


@numba.njit(error_model="numpy", **INLINE)
def _wound(x):
    """Sine and cosine to 1e-15 of angles however many turns; NaN beyond a million quarter turns."""
    rounded = x * (2.0 / math.pi) + _ROUNDING
    n = rounded - _ROUNDING
    n = select(abs(n) < _FARTHEST, n, math.nan)
    s, c = _within_an_eighth(((x - n * _PI_1) - n * _PI_2) - n * _PI_3)
    quarters = bits_of(rounded)
    swapped = from_bits((quarters << _TO_SIGN) | _HALF) < 0.0  # after an odd number of quarters
    s, c = select(swapped, c, s), select(swapped, s, c)
    s = from_bits(bits_of(s) ^ ((quarters << _TO_SIGN_2) & _SIGN))
    return s, from_bits(bits_of(c) ^ (((quarters + _ONE) << _TO_SIGN_2) & _SIGN))


@by_type(math.sin)
def _sine(x):
    return (lambda x: sine_and_cosine(x)[0]) if x == SIMD_FLOAT64 else None


@by_type(math.cos)
def _cosine(x):
    return (lambda x: sine_and_cosine(x)[1]) if x == SIMD_FLOAT64 else None


# --- roots ---------------------------------------------------------------------------------------

_NEAR_ONE = 2.0**-10
"""Up to here five terms of 1/sqrt(1 - d) are right to 3e-16."""


def over_root(x, y):
    """x / sqrt(y), of numbers or of each lane; where all lanes' y are near one, without dividing."""
    return x / math.sqrt(y)


@by_type(over_root)
def _over_root_of(x, y):
    def of_registers(x, y):
        d = 1.0 - y
        if any_lane(abs(d) > _NEAR_ONE):
            return x / math.sqrt(y)
        root = 0.2734375 * d + 0.3125
        root = root * d + 0.375
        root = root * d + 0.5
        return x * d * root + x

    return of_registers if is_register(y) else lambda x, y: x / math.sqrt(y)


# --- exponential and logarithm -------------------------------------------------------------------

_WHOLE = np.uint64(0x4330000000000000)  # the bits of 2^52: under them a whole number fits
_MANTISSA = np.uint64(0x000FFFFFFFFFFFFF)
_EXPONENT = np.uint64(52)
_LN2_HIGH, _LN2_LOW = 0.693145751953125, 1.42860682030941723212e-6


@by_type(float)
def _whole_number(bits):
    """64-bit numbers under 2^52 as doubles."""
    if bits != SIMD_UINT64:
        return None
    return lambda bits: from_bits(bits | _WHOLE) - 2.0**52


@by_type(math.exp)
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

    return exponential if x == SIMD_FLOAT64 else None


@by_type(math.log)
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

    return logarithm if x == SIMD_FLOAT64 else None


@by_type(operator.pow)
def _power(x, y):
    """Powers of positive numbers, to a few 1e-16 times y ln x; NaN of what is not positive."""
    return (lambda x, y: math.exp(y * math.log(x))) if is_register(x) else None


# --- seldom needed: lane by lane --------------------------------------------------------------------


@by_type(math.atan2)
def _angle(y, x):
    def angle(y, x):
        out = 0.0 * x
        for k in range(SIMD_WIDTH):
            out = with_lane(out, k, math.atan2(lane(y, k), lane(x, k)))
        return out

    return angle if is_register(x) and is_register(y) else None


def _lane_by_lane(function: Callable) -> None:
    """Enter a function of one number for registers too."""

    @by_type(function)
    def _choose(x):
        def of_lanes(x):
            out = 0.0 * x
            for k in range(SIMD_WIDTH):
                out = with_lane(out, k, function(lane(x, k)))
            return out

        return of_lanes if is_register(x) else None


_lane_by_lane(math.asin)
_lane_by_lane(math.tanh)
