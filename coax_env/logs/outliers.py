"""Isolated outliers in a sensor channel: lost echoes, bit errors, flipped markers.

A running-median test (Hampel's) on the readings that are there, whatever their spacing. It must
leave fast but real motion alone: real motion comes as ramps and steps, which a median follows.
"""

import numpy as np

from coax_env.model.layout import ANGLES

HALF_WINDOW = 7
"""Readings on either side that a reading is compared with."""
THRESHOLD = 8.0
"""How many standard deviations from the running median are too many."""
LONGEST_BURST = 4
"""More outliers in a row than this are something else, and stay."""

_NORMAL = 1.4826  # std of a normal variable per median absolute deviation


def find_outliers(channel: str, values: np.ndarray, noise: float | None = None) -> np.ndarray:
    """Where a channel's readings are isolated outliers.

    Args:
        channel: name; angles are unwrapped first.
        values: (n,) readings, NaN where there is none.
        noise: std of the sensor where it is known, in the channel's unit.

    Returns:
        (n,) bool.
    """
    flagged = np.zeros(len(values), dtype=bool)
    present = np.flatnonzero(~np.isnan(values))
    if len(present) < 2 * HALF_WINDOW + 1:
        return flagged
    y = values[present]
    if channel in ANGLES:
        y = np.unwrap(y)
    padded = np.pad(y, HALF_WINDOW, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * HALF_WINDOW + 1)
    centre = np.median(windows, axis=1)
    spread = _NORMAL * np.median(np.abs(windows - centre[:, None]), axis=1)
    scale = np.maximum(spread, noise if noise is not None else _noise_level(y))
    outlier = _short_bursts(np.abs(y - centre) > THRESHOLD * scale)
    flagged[present[outlier]] = True
    return flagged


def _noise_level(y: np.ndarray) -> float:
    """Std of the reading-to-reading jitter, and never less than the sensor's resolution."""
    step = np.abs(np.diff(y))
    moving = step[step > 0.0]
    if len(moving) == 0:
        return np.inf
    resolution = float(np.quantile(moving, 0.01))
    return max(_NORMAL * float(np.median(step)) / np.sqrt(2.0), resolution)


def _short_bursts(flagged: np.ndarray) -> np.ndarray:
    """The same flags without those that stand in rows longer than ``LONGEST_BURST``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flagged.view(np.int8), [0]])))
    kept = flagged.copy()
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start > LONGEST_BURST:
            kept[start:stop] = False
    return kept
