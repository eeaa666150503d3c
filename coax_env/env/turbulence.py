"""Dryden turbulence near the ground, MIL-F-8785C section 3.7.2 (low-altitude model).

Intensities and scale lengths follow from the height and from the mean wind W at 6 m (20 ft)::

    L_w = h,  L_u = L_v = h / (0.177 + 0.000823 h)^1.2                            [ft]
    sigma_w = 0.1 W,  sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4

and the forming filters of white noise, with tau = L/V, are::

    u: sigma sqrt(2 tau) / (1 + tau s)     v, w: sigma sqrt(tau) (1 + sqrt(3) tau s) / (1 + tau s)^2

u lies along the mean wind, v across it, w is vertical. The model is stated from 10 ft (3 m) up; below,
its values at 10 ft are taken. V is the speed at which the mean wind carries turbulence past: W by the
logarithmic law (roughness 0.15 ft, the standard's for take-off and landing); the machine's own speed
is left out. Each filter is a state of unit variance or two, discretised exactly over a period.
"""

import math

import numpy as np

from coax_env.errors import InputError
from coax_env.kernel.compilation import compiled
from coax_env.kernel.random_streams import two_normals

FOOT = 0.3048  # [m]
_KNOT = 1852.0 / 3600.0  # [m/s]
LOWEST, HIGHEST = 10.0 * FOOT, 1000.0 * FOOT  # [m] heights the low-altitude model is stated for
REFERENCE_HEIGHT = 20.0 * FOOT  # [m]
ROUGHNESS = 0.15 * FOOT  # [m]
SEVERITIES = {"light": 15.0 * _KNOT, "moderate": 30.0 * _KNOT, "severe": 45.0 * _KNOT}
"""Wind at 6 m [m/s] of MIL-F-8785C's three severities."""

N_FILTERS = 5
ALONG_FILTER, ACROSS_FILTER, DOWN_FILTER = 0, 1, 3
"""First states of the forming filters: one of u, two each of v and w."""
ALONG, ACROSS, DOWN = range(3)
"""Components of the turbulent velocity: u v w in the axes of the mean wind."""

_ROOT_3 = math.sqrt(3.0)


def wind_at_6m(turbulence: float | str | None) -> float:
    """What ``turbulence=`` means, as the mean wind at 6 m [m/s]; zero for none.

    Raises:
        InputError: not a severity, nor a speed that is finite and not negative.
    """
    if turbulence is None:
        return 0.0
    if isinstance(turbulence, str):
        speed = SEVERITIES.get(turbulence, math.nan)
    else:
        try:
            speed = float(turbulence)
        except (TypeError, ValueError):
            speed = math.nan
    if not math.isfinite(speed) or speed < 0.0:
        raise InputError(
            f"turbulence must be None, {', '.join(SEVERITIES)}, or the wind at 6 m in m/s, "
            f"found {turbulence!r}"
        )
    return speed


@compiled()
def dryden(height, wind):
    """Std and memory of turbulence at a height [m] with a mean wind at 6 m [m/s].

    Returns:
        sigma of u and v, and of w [m/s]; tau of u and v, and of w [s].
    """
    height = min(max(height, LOWEST), HIGHEST)
    shape = 0.177 + 0.000823 * height / FOOT
    sigma_w = 0.1 * wind
    carried = wind * math.log(height / ROUGHNESS) / math.log(REFERENCE_HEIGHT / ROUGHNESS)
    return sigma_w / shape**0.4, sigma_w, height / shape**1.2 / carried, height / carried


@compiled()
def draw_filters(stream, filters):
    """Draw the filters' states (N_FILTERS,) from their stationary distribution.

    A first-order state has variance 1; of a pair, the covariance is [[1, 1/2], [1/2, 1/2]].
    """
    filters[ALONG_FILTER], _ = two_normals(stream)
    for k in (ACROSS_FILTER, DOWN_FILTER):
        first, second = two_normals(stream)
        filters[k] = first
        filters[k + 1] = 0.5 * (first + second)


@compiled()
def turbulence_step(stream, filters, height, wind, dt, air):
    """Move the forming filters on by `dt` seconds.

    With z1' = (n - z1)/tau and z2' = (z1 - z2)/tau the second-order filter is
    sigma/sqrt(2) (sqrt(3) z1 + (1 - sqrt(3)) z2), n white so that z1 has variance 1.

    Args:
        stream: key and counter, (2,) uint64. filters: their states, (N_FILTERS,), in place.
        height: [m]. wind: mean wind at 6 m [m/s]. dt: seconds.
        air: the turbulent velocity u v w along, across and down [m/s], (3,), is put here.
    """
    sigma, sigma_w, tau, tau_w = dryden(height, wind)
    a, _ = two_normals(stream)
    keep = math.exp(-dt / tau)
    filters[ALONG_FILTER] = keep * filters[ALONG_FILTER] + math.sqrt(1.0 - keep * keep) * a
    air[ALONG] = sigma * filters[ALONG_FILTER]
    for axis, k in ((ACROSS, ACROSS_FILTER), (DOWN, DOWN_FILTER)):
        s = dt / (tau if axis == ACROSS else tau_w)
        a, b = two_normals(stream)
        keep = math.exp(-s)
        square = keep * keep
        l11 = math.sqrt(1.0 - square)
        l21 = (0.5 - square * (s + 0.5)) / l11
        l22 = math.sqrt(max(0.5 - square * (s * s + s + 0.5) - l21 * l21, 0.0))
        first, second = filters[k], filters[k + 1]
        filters[k] = keep * first + l11 * a
        filters[k + 1] = keep * (s * first + second) + l21 * a + l22 * b
        level = (sigma if axis == ACROSS else sigma_w) / math.sqrt(2.0)
        air[axis] = level * (_ROOT_3 * filters[k] + (1.0 - _ROOT_3) * filters[k + 1])


def spectrum(frequency: np.ndarray, sigma: float, tau: float, along: bool) -> np.ndarray:
    """One-sided Dryden spectrum at frequencies [Hz], (m/s)^2/Hz; `along` the wind, or across it.

    Args:
        frequency: [Hz], any shape. sigma: std [m/s]. tau: memory [s], see `dryden`.
        along: the wind, or across it and downwards.
    """
    square = (2.0 * math.pi * np.asarray(frequency, dtype=float) * tau) ** 2
    if along:
        return 4.0 * sigma**2 * tau / (1.0 + square)
    return 2.0 * sigma**2 * tau * (1.0 + 3.0 * square) / (1.0 + square) ** 2
