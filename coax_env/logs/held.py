"""Held samples: a slow sensor's last reading, written again into every row until the next one comes.

Read as new, ten equal readings say that the machine stood still, ten times over. A channel that truly
repeats must not be mistaken for a held one: a coarse sensor (1 cm steps) of a machine at rest, or one
that moves by a step at a time. So what counts is the pattern over the whole run.
"""

import numpy as np

FEWEST = 10  # changes of value in a run, from which a pattern can be seen; ours
LEAST_HELD = 0.95
"""Share of the values that a held channel shows more than once; ours."""
COARSE_STEP = 1.5
"""Resolutions up to which a change is that of a coarse sensor, read at every row; ours."""
LEAST_LEAPS = 0.5
"""Share of a held channel's changes that are larger than that; ours."""
MOST_REPEATED = 0.05
"""Share of values shown more than once, up to which a channel never repeats by chance; ours."""
FROZEN = 5
"""Equal readings in such a channel that are no chance: less than one in a million; ours."""


def repeats(values: np.ndarray, hold: bool | None = None) -> np.ndarray:
    """Where a channel's cells hold no new reading, (n,) bool.

    Args:
        values: (n,) readings, NaN where there is none.
        hold: what the card says: every repeat is one, or none is; None: by the pattern.
    """
    found = np.zeros(values.size, bool)
    present = np.flatnonzero(~np.isnan(values))
    y = values[present]
    if hold is False or y.size < 2:
        return found
    again = np.concatenate([[False], y[1:] == y[:-1]])
    if hold:
        found[present[again]] = True
        return found
    starts = np.flatnonzero(~again)
    inner = np.diff(starts)[1:]  # times that each value shows, without the first and the last one
    if inner.size < FEWEST:
        return found
    if _is_held(inner, np.abs(np.diff(y[starts]))):
        found[present[again]] = True
    elif np.mean(inner > 1) <= MOST_REPEATED:
        for first, times in zip(starts[1:-1], inner, strict=True):
            if times >= FROZEN:
                found[present[first + 1 : first + times]] = True
    return found


def _is_held(times: np.ndarray, steps: np.ndarray) -> bool:
    """Whether nearly every value shows more than once, and the next one is not just a step away."""
    leaps = np.mean(steps > COARSE_STEP * steps.min())
    return bool(np.mean(times > 1) >= LEAST_HELD and leaps >= LEAST_LEAPS)
