"""Isolated outliers in a sensor channel: lost echoes, bit errors, flipped markers.

A running-median test (Hampel's) on the readings that are there, whatever their spacing. It must
leave fast but real motion alone: real motion comes as ramps and steps, which a median follows. What
commands did to a reading does not: rotors whose speed jumps turn the body at once, and where a
command is taken back a row later the rate is a spike. What commands and rotor speeds foretell is none.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np

from coax_env.kernel.angles import wrap_angles
from coax_env.logs.packets import stretches
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

MISCOUNTED = (0.5, 2.0)
"""Times the speed that a counter reads which misses every other pulse, or sees each twice."""
NEAR = 0.1
"""Part of that by which the reading may be off, since rotors follow their commands late; ours."""
JUMP = 0.25
"""Share of what is commanded that no rotor gains or loses from one reading to the next; ours."""

AVERAGED_TIME = 0.3
"""Time [s] between a heading before an average across half a turn and one behind it, or that of two
rows where rows are slower; ours."""
MOST_AVERAGED = 15
"""Rows before, and behind, among which these two are; ours."""
NEAR_HALF_A_TURN = 0.5
"""[rad] of half a turn within which these two are; ours."""
AWAY, TURNS_AWAY = 0.3, 4.0
"""[rad] and [rad/s]: further or faster than either no heading turns away and back at once; ours."""

ANSWER_ROWS = 12
"""Rows back that a spike's cause may lie: 0.12 s at 100 Hz; ours."""
FORETOLD = 0.25
"""Share of a spike that its causes must foretell; ours. Of 82 of a yaw rate on a **synthetic** flight
whose commands arrive in steps finer than logged, all the rotors' reaction, 70 are; of what is chance
beside 8 std none."""
AT_ONCE = 10_000
"""Rows that are summed up at once."""
ITS_OWN = 0.5
"""Share of a row in its own fit (leverage) from which the fit foretells nothing of it; ours."""

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
    windows = _windows(y)
    centre = _median_of_each(windows)
    least = noise if noise is not None else _noise_level(y)
    far = np.abs(y - centre) > THRESHOLD * least  # few: their spread alone is asked for
    spread = _NORMAL * _median_of_each(np.abs(windows[far] - centre[far, None]))
    far[far] = np.abs(y - centre)[far] > THRESHOLD * spread
    outlier = _short_bursts(far)
    flagged[present[outlier]] = True
    return flagged


def off_median(values: np.ndarray) -> np.ndarray:
    """How far numbers (n,) are off their running median."""
    return values - _median_of_each(_windows(values))


def are_answers(
    channel: str, values: np.ndarray, causes: Sequence[np.ndarray], asked: np.ndarray
) -> np.ndarray:
    """Where a reading is off its running median by what its causes foretell.

    Deviations from the median follow those of the causes in the last ANSWER_ROWS rows, by least squares
    over the run; what is foretold of a row is by all others (Belsley, Kuh and Welsch, Regression
    Diagnostics, 1980, section 2.1).

    Args:
        channel: name; angles are unwrapped first.
        values: (n,) readings, NaN where there is none.
        causes: how far commands and measured rotor speeds are off theirs, (n,) each.
        asked: (n,) bool, rows to say it of.

    Returns:
        (n,) bool.
    """
    answers = np.zeros(len(values), dtype=bool)
    present, y = _present(channel, values)
    off = off_median(y)
    moved = np.stack([np.pad(c, (ANSWER_ROWS, 0)) for c in causes if c.any()] or [np.zeros(0)])
    if moved.size == 0:
        return answers
    back = ANSWER_ROWS - np.arange(ANSWER_ROWS + 1)

    def late(rows: np.ndarray) -> np.ndarray:
        """(r, columns): causes as they were in each of some rows, and in those before it."""
        return moved[:, rows[:, None] + back].transpose(1, 0, 2).reshape(rows.size, -1)

    products, with_off = 0.0, 0.0
    for first in range(0, present.size, AT_ONCE):  # a log may last an hour
        part = slice(first, first + AT_ONCE)
        columns = late(present[part])
        products, with_off = products + columns.T @ columns, with_off + columns.T @ off[part]
    inverse = np.linalg.pinv(products, rcond=1e-12, hermitian=True)
    which = np.flatnonzero(asked[present])
    columns = late(present[which])
    its_own = np.einsum("ij,jk,ik->i", columns, inverse, columns)
    left = off[which] - columns @ (inverse @ with_off)
    foretold = off[which] - left / np.maximum(1.0 - its_own, ITS_OWN)
    told = (its_own < ITS_OWN) & (foretold * off[which] > FORETOLD * off[which] ** 2)
    answers[present[which[told]]] = True
    return answers


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


def find_miscounts(speed: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Where a rotor's speed is read as half or twice what it is, from one reading to the next on.

    However long: it is told by what was commanded, since a rotor may idle at half of its speed. The
    reading itself jumps there and back, which no rotor does.

    Args:
        speed: (n,) readings, NaN where there is none. command: (n,) in the same unit.

    Returns:
        (n,) bool.
    """
    flagged = np.zeros(len(speed), dtype=bool)
    present = np.flatnonzero(np.isfinite(speed) & (command > 0.0))
    if present.size < 2:
        return flagged
    read, asked = speed[present], command[present]
    share = read / asked
    usual = float(np.median(share))
    # of the reading: a command that is lost for some rows moves the share, too
    jumps = np.abs(np.diff(read)) > JUMP * usual * np.minimum(asked[1:], asked[:-1])
    for times in MISCOUNTED:
        near = np.abs(share - times * usual) < NEAR * times * usual
        for first, behind in stretches(near):
            begins = first == 0 or jumps[first - 1]
            if begins and (behind == present.size or jumps[behind - 1]):
                flagged[present[first:behind]] = True
    return flagged


def find_averaged_headings(t: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Where a heading is an average of readings on either side of half a turn, as plain numbers.

    Who puts headings of 3.1 and -3.1 on other times by a straight line has 0 between them. Unwrapped as
    they are, such readings may lose a whole turn.

    Args:
        t: (n,) time [s], increasing. heading: (n,) [rad], NaN where there is none.

    Returns:
        (n,) bool.
    """
    flagged = np.zeros(len(heading), dtype=bool)
    while True:  # what was averaged hides its neighbours
        present = np.flatnonzero(np.isfinite(heading) & ~flagged)
        away = _turned_away(t[present], wrap_angles(heading[present]))
        if not away.any():
            return flagged
        flagged[present[away]] = True


def _turned_away(t: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Headings (n,) far from half a turn between two that are near it, before and behind them."""
    away = np.zeros(heading.size, dtype=bool)
    near = np.abs(heading) > np.pi - NEAR_HALF_A_TURN
    if heading.size < 3 or not near.any():
        return away
    row = float(np.median(np.diff(t)))
    longest = max(AVERAGED_TIME, 2.0 * row)
    rows = range(1, 1 + min(round(longest / row), MOST_AVERAGED))
    for before, behind in product(rows, rows):
        apart = before + behind
        if apart < heading.size:
            first, last = heading[:-apart], heading[apart:]
            within = slice(before, heading.size - behind)
            took = t[apart:] - t[:-apart]
            off = [np.abs(wrap_angles(heading[within] - other)) for other in (first, last)]
            far = np.minimum(*off) > np.maximum(AWAY, TURNS_AWAY * took)
            soon = took <= longest * (1.0 + 1e-9)
            away[within] |= near[:-apart] & near[apart:] & soon & far
    return away


def _windows(y: np.ndarray) -> np.ndarray:
    """Readings about each of some readings (n,), (n, 2 HALF_WINDOW + 1)."""
    padded = np.pad(y, HALF_WINDOW, mode="reflect")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * HALF_WINDOW + 1)


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
