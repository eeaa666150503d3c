"""Rows whose times are wrong by a little: what that makes of readings that move.

A reading that was taken a millisecond sooner or later than its row says is off by its rate times that:
3 mm at 3 m/s, ten times a motion capture's noise, and nothing in hover. So does software that smooths
poses from row to row as though rows were even. Taken for readings as good in a dash as in hover, such
flights had late commands and a drag that is not there. Here each reading's variance has its rate times
the std of the times, squared, on top; in what a row reads at once the error is taken as independent.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from coax_env.estimation.state_space import Record
from coax_env.model.layout import ANGLES, CHANNELS, MOTION

ABOUT = 5
"""Readings over whose mean a rate is taken; ours."""


def with_clock_error(records: Sequence[Record], std: float) -> list[Record]:
    """Records whose readings of motion are believed as their times are.

    Args:
        records: of runs. std: of their rows' times [s]; 0: they are right.
    """
    if std == 0.0:
        return [replace(record, blur=None) for record in records]
    return [replace(record, blur=(std * rates(record)) ** 2) for record in records]


def rates(record: Record) -> np.ndarray:
    """Rate of each reading of motion [its unit per s], (n, m); 0 of others, and where there is none."""
    found = np.zeros(record.z.shape)
    for i, channel in enumerate(CHANNELS):
        rows = np.flatnonzero(np.isfinite(record.z[:, i]))
        if channel not in MOTION or rows.size < ABOUT:
            continue
        y = record.z[rows, i]
        y = np.unwrap(y) if channel in ANGLES else y
        found[rows, i] = uniform_filter1d(np.gradient(y, record.t[rows]), ABOUT, mode="nearest")
    return found
