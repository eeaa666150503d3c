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

LEAP_TIME = 0.1
"""Time [s] from the last reading before a leap to the first one behind it; ours."""
LEAP_NOISE = 20.0
"""Standard deviations of the noise that a leap has at least; ours."""
LEAP_REST = 0.3
"""Share of a leap by which what was before and what comes behind may differ; ours."""
FASTEST = {
    **dict.fromkeys(("h", "pn", "pe"), 30.0),
    **dict.fromkeys(("phi", "theta", "psi"), 35.0),
}  # fmt: skip
"""What no such machine exceeds: 30 m/s, and 35 rad/s, the range of usual gyros; ours."""

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
    present, y = _present(channel, values)
    if len(present) < 2 * HALF_WINDOW + 1:
        return flagged
    padded = np.pad(y, HALF_WINDOW, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * HALF_WINDOW + 1)
    centre = _median_of_each(windows)
    least = noise if noise is not None else _noise_level(y)
    far = np.abs(y - centre) > THRESHOLD * least  # few: their spread alone is asked for
    spread = _NORMAL * _median_of_each(np.abs(windows[far] - centre[far, None]))
    far[far] = np.abs(y - centre)[far] > THRESHOLD * spread
    outlier = _short_bursts(far)
    flagged[present[outlier]] = True
    return flagged


def find_leaps(channel: str, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Where a channel leaps out in one step and back in one step, within LEAP_TIME.

    For bursts that are too long for the running median: 40 ms of nonsense are four rows at 100 Hz and
    sixteen at 400 Hz. Each leap is beyond the noise and beyond the range of the whole run, or the speed
    of any such machine; a step that stays is no leap.

    Args:
        channel: name; angles are unwrapped first.
        t: (n,) time [s].
        values: (n,) readings, NaN where there is none.

    Returns:
        (n,) bool.
    """
    flagged = np.zeros(len(values), dtype=bool)
    present, y = _present(channel, values)
    if len(present) < 2 * HALF_WINDOW + 1:
        return flagged
    at = t[present]
    low, high = np.quantile(y, [0.01, 0.99])
    step = np.diff(y)
    allowed = np.minimum(high - low, FASTEST.get(channel, np.inf) * np.diff(at))
    leaps = np.flatnonzero(np.abs(step) > LEAP_NOISE * _noise_level(y) + allowed)
    for k, out in enumerate(leaps):
        for back in leaps[k + 1 :]:
            if at[back + 1] - at[out] > LEAP_TIME:
                break
            least = min(abs(step[out]), abs(step[back]))
            if abs(y[back + 1] - y[out]) < LEAP_REST * least:
                flagged[present[out + 1 : back + 1]] = True
    return flagged


def _median_of_each(windows: np.ndarray) -> np.ndarray:
    """np.median of an odd number of readings (n, 2 HALF_WINDOW + 1), in a quarter of its time."""
    middle: np.ndarray = np.partition(windows, HALF_WINDOW, axis=1)[:, HALF_WINDOW]
    return middle


def _present(channel: str, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the readings that are there, and the readings, angles without jumps of whole turns."""
    present = np.flatnonzero(~np.isnan(values))
    y = values[present]
    return present, np.unwrap(y) if channel in ANGLES else y


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
