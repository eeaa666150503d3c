"""Orthogonal multisines with optimised phases: every input excited at once, and separated after.

Each input gets its own harmonics of the record's base frequency, interleaved with the others', so that
over a whole record the inputs are orthogonal in time and in frequency whatever their phases (Morelli
2003, AIAA 2003-5466; Klein and Morelli 2006, ch. 9). Phases start at Schroeder's (1970) and are
moved to lower the peak for the same power.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from coax_env.errors import InputError

UPDATE = 0.05
"""Seconds between the steps by which an input follows its sum of sines."""
LOWEST = 0.2  # [Hz] ours: slower, and the machine drifts away
HIGHEST = 2.5  # [Hz] flapping and attitude answer below


def harmonics(
    inputs: int, duration: float, lowest: float = LOWEST, highest: float = HIGHEST
) -> list:
    """Harmonic numbers of each input, interleaved: input i gets every `inputs`-th one.

    Args:
        inputs: how many. duration: of the record [s]. lowest, highest: ends of the band [Hz].

    Raises:
        InputError: the record is too short to give each input two.
    """
    first, last = math.ceil(lowest * duration - 1e-9), math.floor(highest * duration + 1e-9)
    numbers = np.arange(max(first, 1), last + 1)
    if len(numbers) < 2 * inputs:
        raise InputError(
            f"a multisine of {duration:g} s has {len(numbers)} harmonics in its band: "
            f"too few for {inputs} inputs"
        )
    return [numbers[i::inputs] for i in range(inputs)]


def multisines(inputs: int, duration: float, seed: int = 0) -> np.ndarray:
    """Histories of peak 1, one per input, each UPDATE seconds: shape (n, inputs).

    They begin and end near 0, where a run begins at trim.

    Args:
        inputs: how many. duration: of the record [s]. seed: of the second set of first phases.
    """
    t = np.arange(0.0, duration, UPDATE)
    rng = np.random.default_rng(seed)
    columns = []
    for numbers in harmonics(inputs, duration):
        angle = 2.0 * math.pi * np.outer(t / duration, numbers)
        schroeder = -math.pi * np.arange(len(numbers)) ** 2 / len(numbers)
        best = min(
            (
                minimize(_peak, start, (angle,), method="Powell", options={"maxfev": 600})
                for start in (schroeder, schroeder + rng.normal(0.0, 0.5, len(numbers)))
            ),
            key=lambda found: found.fun,
        )
        wave = np.sin(angle + best.x).sum(axis=1)
        columns.append(_from_zero(wave / np.abs(wave).max()))
    return np.column_stack(columns)


def relative_peak_factor(wave: np.ndarray) -> float:
    """Range over rms, scaled so that a single sine has 1."""
    return float((wave.max() - wave.min()) / (2.0 * math.sqrt(2.0) * wave.std()))


def steps(wave: np.ndarray, size: float, start: float) -> Sequence[tuple[float, float]]:
    """A history as the (time, level) steps of a maneuver, from `start` on, back to 0 at its end.

    Args:
        wave: one level each UPDATE seconds, (n,). size: level of 1, in the input's unit.
        start: [s].
    """
    levels = [(start + UPDATE * k, size * float(v)) for k, v in enumerate(wave)]
    return [*levels, (start + UPDATE * len(wave), 0.0)]


def _peak(phases: np.ndarray, angle: np.ndarray) -> float:
    return relative_peak_factor(np.sin(angle + phases).sum(axis=1))


def _from_zero(wave: np.ndarray) -> np.ndarray:
    """The same record begun where it crosses zero upwards: it is periodic."""
    crossings = np.flatnonzero((wave <= 0.0) & (np.roll(wave, -1) > 0.0))
    return np.roll(wave, -int(crossings[0]) - 1) if crossings.size else wave
