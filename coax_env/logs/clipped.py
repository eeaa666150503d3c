"""Readings at the end of a sensor's range: they say "at least so much", and are not readings of it.

Taken for readings they pull the filter there: a gyro of 500 deg/s that clips in 56 of 1601 rows cost a
synthetic flight 5,000 nats, and made three causes that were not there.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from coax_env.logs.packets import stretches

FEWEST = 3
"""Equal readings in a row, at the largest or least value of a run, that are no chance; ours."""
MOST_REPEATED = 0.05
"""Share of readings elsewhere that are equal to the one before, up to which a channel never repeats by
chance: a coarse sensor does; ours."""
LEAST_STEP = 0.5
"""Usual steps by which one of the two readings before, and of the two behind, is off the end; ours."""
MOST = 0.5
"""Share of the readings that may be at the ends: what shows little else moves between them; ours."""
BESIDE = 3  # readings before and behind one, by which it is known what it should be; ours
NEAR = 3.0
"""Std of the noise from an end, up to which readings are pulled away from it; ours."""
STEP_OF_NOISE = 0.954
"""Median step of white noise over its std: of a normal number times the root of 2."""


def clipped(values: np.ndarray) -> np.ndarray:
    """Where a channel reads an end of its range, (n,) bool.

    An end shows as a level stretch at the largest or least value that is entered and left abruptly: a
    machine at rest leaves its place slowly.

    Args:
        values: (n,) readings, NaN where there is none.
    """
    found = np.zeros(values.size, bool)
    present = np.flatnonzero(~np.isnan(values))
    y = values[present]
    if y.size < 2 * FEWEST:
        return found
    ends = (y.max(), y.min())
    steps = np.abs(np.diff(y))
    inside = steps[~np.isin(y[1:], ends) | (steps > 0.0)]
    if not inside.size or np.mean(inside == 0.0) > MOST_REPEATED:
        return found
    abrupt = LEAST_STEP * float(np.median(inside))
    real = [end for end in ends if _is_reached(y, end, abrupt)]
    at_end = np.isin(y, [*real, *np.negative(real)])
    if np.mean(at_end) <= MOST:
        found[present] = at_end
    return found


def _is_reached(y: np.ndarray, end: float, abrupt: float) -> bool:
    """Whether readings stay at a value for a while, entered and left by such steps at least."""
    off = np.abs(y - end)
    return any(
        first > 0
        and behind < y.size
        and behind - first >= FEWEST
        and off[max(first - 2, 0) : first].max() >= abrupt
        and off[behind : behind + 2].max() >= abrupt
        for first, behind in stretches(y == end)
    )


def near_an_end(values: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Where a reading is at an end of its range, or near it by those beside it, (n,) bool.

    Near the end only those readings are left that noise took inward. Of a gyro that was there for a
    fifth of a clean **synthetic** flight they made a scale of 25 nats. The reading itself must not
    say: that would be an end, too.

    Args:
        values: (n,) readings, NaN where there is none. ends: (n,) where one is at an end.
    """
    found = np.zeros(values.size, bool)
    present = np.flatnonzero(~np.isnan(values))
    y, there = values[present], ends[present]
    steps = np.abs(np.diff(y))
    noise = float(np.median(steps[steps > 0.0])) / STEP_OF_NOISE
    padded = np.pad(y, BESIDE, mode="edge")
    around = np.delete(sliding_window_view(padded, 2 * BESIDE + 1), BESIDE, axis=1)
    expected = np.median(around, axis=1)
    for end in np.unique(y[there]):
        inwards = np.sign(np.median(y) - end)
        there = there | ((expected - end) * inwards < NEAR * noise)
    found[present] = there
    return found
