"""Broken packets: rows whose commands no machine can follow, for a few rows, and then all is well.

A true maneuver is a command too, and no command is touched because it is sudden. What gives a broken
packet away is a number far beyond what rotors and swash plates do, that is gone again at once; a
number that stays (a column in another unit, say) is left for `inspection` to find.
"""

from collections.abc import Mapping

import numpy as np

from coax_env.logs.units import ROTOR_COMMANDS, SWASH_COMMANDS

MOST_SPEED = 2.5
"""Times its usual value that a rotor speed may be: six times the thrust that carries it; ours."""
LEAST_SPEED = -0.5
"""The same downwards: a command somewhat below 0 is a controller's, and is clipped at 0; ours."""
MOST_TILT = 0.35
"""Tilt [rad] from its usual value that no swash plate of this size has (14 degrees on a CoaX); ours."""
MOST_SPANS = 3.0
"""The tilt is also so many times the range that holds all but a hundredth on either side; ours."""
LONGEST = 0.15
"""Time [s] from the last sound row to the next one; ours."""
LONGEST_ROWS = 3  # where rows come slowly


def broken_packets(data: Mapping[str, np.ndarray]) -> np.ndarray:
    """Rows (n,) of which nothing is believed, because a command in them is impossible.

    Args:
        data: channel or command, ``t`` among them -> (n,) in its canonical unit, NaN where empty.
    """
    t = data["t"]
    impossible = np.zeros(t.size, bool)
    for name in ROTOR_COMMANDS:
        if name in data:
            impossible |= _impossible_speed(data[name])
    for name in SWASH_COMMANDS:
        if name in data:
            impossible |= _impossible_tilt(data[name])
    return brief(t, impossible, LONGEST, LONGEST_ROWS)


def _impossible_speed(speed: np.ndarray) -> np.ndarray:
    turning = speed[speed > 0.0]
    if not turning.size:
        return np.zeros(speed.size, bool)
    usual = np.median(turning)
    return (speed > MOST_SPEED * usual) | (speed < LEAST_SPEED * usual)


def _impossible_tilt(tilt: np.ndarray) -> np.ndarray:
    given = tilt[~np.isnan(tilt)]
    if not given.size:
        return np.zeros(tilt.size, bool)
    low, usual, high = np.quantile(given, [0.01, 0.5, 0.99])
    return np.abs(tilt - usual) > max(MOST_TILT, MOST_SPANS * (high - low))


def brief(t: np.ndarray, mask: np.ndarray, seconds: float, rows: int) -> np.ndarray:
    """The stretches of a mask (n,) that last no longer than so many seconds or rows.

    Args:
        t: (n,) time [s].
        mask: (n,) bool.
        seconds: from the last row before a stretch to the first one behind it.
        rows: of a stretch, that are few however slowly they come.
    """
    kept = np.zeros(mask.size, bool)
    for first, stop in stretches(mask):
        around = t[min(stop, t.size - 1)] - t[max(first - 1, 0)]
        if around <= seconds or stop - first <= rows:
            kept[first:stop] = True
    return kept


def stretches(mask: np.ndarray) -> list[tuple[int, int]]:
    """First row and the row behind the last of every stretch in which a mask (n,) holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.view(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
