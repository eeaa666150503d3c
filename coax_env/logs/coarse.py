"""Sensors whose steps are many times their noise: what they say is when they pass from one to the next.

A speed counted in steps of 30 rev/min, known to 2, reads the same for a tenth of a second and is off by
up to half a step all that time. Errors that last so look like physics: two clean **synthetic** flights
had a thrust exponent of 60 to 80 nats, one of them a yaw damping of 218. As a reading changes by a step
the true value is halfway between the two, to the sensor's own noise. So that is the reading, and all
others are none.
"""

import numpy as np

from coax_env.logs.held import grid_of

FEWEST = 10  # changes in a run; ours
MOST_CHANGED = 0.25
"""Share of the readings that differ from the one before, up to which steps are coarse: of a value that
stands still they are so from 5 std of the noise on; ours."""
LEAST_SINGLE = 0.8
"""Share of the changes that are by one step; ours."""


LEAP = 0.25
"""Of a step by which a command changes from row to row where what follows it may leap over the middle
between two; ours. In steps of 60 rev/min such leaps were a motor's droop of 83 nats, sure, on a clean
**synthetic** flight."""


def at_changes(values: np.ndarray, command: np.ndarray | None = None) -> np.ndarray | None:
    """A coarse sensor's readings, at their changes and NaN elsewhere; None where it is not that coarse.

    Args:
        values: (n,) readings, NaN where there is none.
        command: (n,) what they follow, in their unit; None: nothing that is known.
    """
    present = np.flatnonzero(~np.isnan(values))
    y = values[present]
    step = grid_of(y) if y.size > FEWEST else 0.0
    if step == 0.0:
        return None
    steps = np.abs(np.diff(y)) / step
    changed, single = steps > 0.5, (steps > 0.5) & (steps < 1.5)
    few = changed.sum() < FEWEST or single.sum() < LEAST_SINGLE * changed.sum()
    if few or changed.mean() > MOST_CHANGED:
        return None
    if command is not None:
        leaps = np.abs(np.diff(command, prepend=command[0])) > LEAP * step
        leaps[1:] |= leaps[:-1]
        single &= ~leaps[present[1:]]
    found = np.full(values.size, np.nan)
    found[present[1:][single]] = 0.5 * (y[1:] + y[:-1])[single]
    return found
