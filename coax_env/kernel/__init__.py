"""Compilation by numba: a cache that stays true, lazy compilation, SIMD, random streams."""
