"""Random numbers for many envs at once: each env has its own stream, a key and a counter.

The n-th number of a stream depends on the key and n alone (splitmix64: Steele, Lea and Flood,
OOPSLA 2014), so an env flies the same in a batch of any size, in any order, on any thread.
"""

import math

import numpy as np

from coax_env.jit import compiled
from coax_env.lanes import sine_and_cosine

KEY, COUNTER = 0, 1
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11, _S32 = (np.uint64(n) for n in (30, 27, 31, 11, 32))
_ONE = np.uint64(1)
_LOW = np.uint64(0xFFFFFFFF)


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
    """Uniform in [low, high)."""
    return low + (high - low) * (next_bits(stream) >> _S11) * 2.0**-53


@compiled()
def bits_ahead(stream, ahead):
    """The random bits that come after `ahead` others; the stream stays where it is."""
    return scrambled(stream[KEY] + (stream[COUNTER] + np.uint64(ahead + 1)) * _GOLDEN)


@compiled()
def skip(stream, n):
    """Move a stream on by `n` numbers."""
    stream[COUNTER] += np.uint64(n)


@compiled()
def normals_of(bits):
    """Two independent standard normal numbers (Box and Muller 1958) from 64 random bits."""
    first = (float(bits >> _S32) + 0.5) * 2.0**-32
    sine, cosine = sine_and_cosine(float(bits & _LOW) * (2.0 * math.pi * 2.0**-32))
    radius = math.sqrt(-2.0 * math.log(first))
    return radius * cosine, radius * sine


@compiled()
def two_normals(stream):
    """Two independent standard normal numbers, from one draw of 64 bits."""
    return normals_of(next_bits(stream))


@compiled()
def chance_of(bits):
    """Uniform in [0, 1) from 64 random bits."""
    return float(bits >> _S32) * 2.0**-32
