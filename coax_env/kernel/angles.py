"""Angles taken within a turn: of one number or one SIMD register in compiled code, and of arrays."""

import math

import numpy as np

from coax_env.kernel.compilation import compiled

TURN = 2.0 * math.pi


@compiled()
def wrap_angle(angle):
    """Angle [rad] in [-pi, pi)."""
    return angle - TURN * math.floor((angle + math.pi) / TURN)


def wrap_angles(angles: np.ndarray) -> np.ndarray:
    """Angles [rad] of any shape, each in [-pi, pi); the same arithmetic as `wrap_angle`."""
    return angles - TURN * np.floor((angles + math.pi) / TURN)
