"""Random numbers for many envs at once: each env has its own stream, a key and a counter.

The n-th number of a stream depends on the key and n alone (splitmix64: Steele, Lea and Flood,
OOPSLA 2014), so an env flies the same in a batch of any size, in any order, on any thread.
"""

import math

import numpy as np

from coax_env.kernel.compilation import compiled
from coax_env.kernel.simd import bits_of, from_bits

KEY, COUNTER = 0, 1
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11, _S32, _S52 = (np.uint64(n) for n in (30, 27, 31, 11, 32, 52))
_ONE = np.uint64(1)
_LOW = np.uint64(0x7FFFFFFF)
_SIGN = np.uint64(0x8000000000000000)
_MANTISSA = np.uint64(0x000FFFFFFFFFFFFF)
_HALF = np.uint64(0x3FE0000000000000)  # the exponent of [0.5, 1)


@compiled()
def scrambled(z):
    """splitmix64's finaliser: 64 bits to 64 well mixed bits, one to one."""
    z = (z ^ (z >> _S30)) * _FIRST
    z = (z ^ (z >> _S27)) * _SECOND
    return z ^ (z >> _S31)


@compiled()
def stream_key(seed):
    """Key of the stream of a seed; neighbouring seeds have unrelated streams."""
    return scrambled(scrambled(np.uint64(seed) + _GOLDEN) ^ _GOLDEN)


@compiled()
def next_bits(stream):
    """The next 64 random bits of a stream (key, counter), which moves on by one."""
    stream[COUNTER] += _ONE
    return scrambled(stream[KEY] + stream[COUNTER] * _GOLDEN)


@compiled()
def uniform(stream, low, high):
    """Uniform in [low, high), the next number of a stream.

    Args:
        stream: key and counter (2,), which moves on by one. low, high: bounds.
    """
    return low + (high - low) * (next_bits(stream) >> _S11) * 2.0**-53


@compiled()
def place_of(stream):
    """Where a stream stands; see `bits_ahead`."""
    return stream[KEY] + stream[COUNTER] * _GOLDEN


@compiled()
def bits_ahead(place, ahead):
    """The random bits that come after `ahead` others from a stream's place on."""
    return scrambled(place + np.uint64(ahead + 1) * _GOLDEN)


@compiled()
def skip(stream, n):
    """Move a stream on by `n` numbers."""
    stream[COUNTER] += np.uint64(n)


@compiled()
def normals_of(bits):
    """Two independent standard normal numbers (Box and Muller 1958) from 64 random bits.

    The radius is sqrt(-2 ln((n + 1/2) / 2^32)), n the upper half of the bits, and the angle the
    lower half's share of a turn; both to 1e-11, by polynomials of least largest error (Remez), which
    are the same for one stream and for a SIMD batch of them.
    """
    number = bits_of(float(bits >> _S32) + 0.5)  # m 2^e with m in [1/2, 1)
    e = float(number >> _S52) - (1022.0 + 32.0)
    m = from_bits((number & _MANTISSA) | _HALF)
    s = (m - 1.0) / (m + 1.0)
    z = s * s  # ln m = 2 artanh s
    a = 0.10944773218708849 * z + 0.085564439814173857
    a = a * z + 0.11153165925691157
    a = a * z + 0.14284038240612933
    a = a * z + 0.20000031610719504
    a = a * z + 0.33333333110412616
    a = a * z + 1.0000000000025643
    radius = math.sqrt(-2.0 * math.log(2.0) * e - 4.0 * s * a)
    # half a turn by the lower 31 bits, seen from its middle; the other half by the sign
    y = float(bits & _LOW) * (math.pi * 2.0**-31) - 0.5 * math.pi
    z = y * y
    a = 1.5411426882680125e-10 * z - 2.5030283522171313e-8
    a = a * z + 2.7556953338509914e-6
    a = a * z - 1.9841266688576841e-4
    a = a * z + 8.3333333203898467e-3
    a = a * z - 0.16666666666467338
    a = a * z + 0.99999999999994988
    b = 1.9907856888886656e-9 * z - 2.7524696392333704e-7
    b = b * z + 2.4801040648863016e-5
    b = b * z - 1.3888884180012417e-3
    b = b * z + 4.1666666473385238e-2
    b = b * z - 0.49999999997024033
    b = b * z + 0.99999999999925183
    radius = from_bits(bits_of(radius) | ((bits << _S32) & _SIGN))
    return -radius * y * a, radius * b


@compiled()
def two_normals(stream):
    """Two independent standard normal numbers, from one draw of 64 bits."""
    return normals_of(next_bits(stream))


@compiled()
def chance_of(bits):
    """Uniform in [0, 1) from 64 random bits."""
    return float(bits >> _S32) * 2.0**-32
