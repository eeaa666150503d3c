"""Rows that a log lost, put back: without readings, commands on a line between the rows beside them.

Held until the next row that there is, a command that moves fast is wrong by what it moved: two gaps of
3 and 6 rows in a heave doublet at 60 Hz cost 48 nats (**synthetic**).
"""

import numpy as np

from coax_env.logs.held import MISSING

LONGEST_BELIEVED = 0.25
"""Time [s] for which the last command is believed, and not less than BELIEVED_STEPS usual steps.

A swash command that is 0.05 rad off turns a machine of this size by half a radian in that time. Gaps of
radio links that are shorter cost less by a held command than by a filter that starts anew; ours.
"""
BELIEVED_STEPS = 5.0
EVEN = 0.25
"""Usual steps by which the rows of an even clock may be off a whole number of these; ours."""
NEARLY_ALL = 0.95
"""Share of the rows that must be on it: a loop that is late now and then has lost nothing; ours."""


def longest_believed(t: np.ndarray) -> float:
    """Time [s] for which a run's last command is believed; t: (n,) its rows."""
    return max(LONGEST_BELIEVED, BELIEVED_STEPS * float(np.median(np.diff(t))))


def lost_rows(t: np.ndarray, longest: float) -> np.ndarray:
    """Times of rows that are missing from an even clock [s].

    Args:
        t: (n,) of the rows that there are [s]. longest: s of a gap, at most, that is filled.
    """
    step = np.diff(t)
    if step.size == 0:
        return np.empty(0)
    times = step / np.median(step)
    whole = np.round(times)
    if np.mean(np.abs(times - whole) < EVEN) < NEARLY_ALL:
        return np.empty(0)
    gaps = np.flatnonzero((times > MISSING) & (step <= longest))
    between = [t[k] + step[k] * np.arange(1, whole[k]) / whole[k] for k in gaps]
    return np.concatenate([np.empty(0), *between])
