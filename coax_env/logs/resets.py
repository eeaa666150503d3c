"""Where a position, height or heading was set anew: a jump between two readings that stays.

A motion capture that finds its markers again, a SLAM that closes a loop, an autopilot's filter that is
reset, a sonar over the edge of a table. No machine moves so, and a filter takes it for a push. One such
jump of 0.2 m a run left three channels of a clean **synthetic** flight unexplained, in 244 s of
diagnosis for 37; two of 0.15 rad beside a late attitude were a magnetic field. Runs are cut there
(estimation/flown.py): each part begins where its readings say.
"""

from collections.abc import Mapping

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from coax_env.logs.flight import Run
from coax_env.model.layout import ANGLES

FASTER: Mapping[str, float] = {"pn": 30.0, "pe": 30.0, "h": 30.0, "psi": 100.0}
"""m/s2, rad/s2: what no such machine exceeds, of the channels that are asked; ours."""
NOISE = 8.0
"""Times what noise makes of one, or the last digit, that a jump has at least; ours."""
AROUND = 6
"""Readings on either side, by whose medians it is a jump that stays; ours."""
LATEST = 0.5
"""s that AROUND readings may take: of slower ones motion says as much; ours."""
SELDOM = 4.0
"""s from one jump to the next, in the mean: what jumps more often is noise of another kind; ours."""


def reset_rows(run: Run) -> dict[str, np.ndarray]:
    """Rows of a run, by channel, whose reading is the first one behind a jump.

    Args:
        run: as read, isolated outliers left out.
    """
    found = {}
    for channel, fastest in FASTER.items():
        rows = np.flatnonzero(np.isfinite(run.measured.get(channel, np.empty(0))))
        if rows.size < 4 * AROUND or AROUND * np.median(np.diff(run.t[rows])) > LATEST:
            continue
        y = run.measured[channel][rows]
        jumps = _jumps(run.t[rows], np.unwrap(y) if channel in ANGLES else y, fastest)
        if 0 < jumps.size * SELDOM < run.duration:
            found[channel] = rows[jumps]
    return found


def _jumps(t: np.ndarray, y: np.ndarray, fastest: float) -> np.ndarray:
    """Places of readings that are the first ones behind a jump.

    Args:
        t, y: (n,) times [s] and readings. fastest: most that they are accelerated by.
    """
    took = np.diff(t)
    row = float(np.median(took))
    slopes = np.median(sliding_window_view(np.diff(y) / took, AROUND - 1), axis=1)
    ahead = np.arange(AROUND, slopes.size)  # behind a jump: AROUND readings on, as many before
    last, took = ahead - 1, took[ahead - 1]
    before, behind = slopes[ahead - AROUND], slopes[ahead]
    off = y[ahead] - y[last] - 0.5 * (before + behind) * took
    finest = float(np.min(np.abs(np.diff(y))[np.diff(y) != 0.0], initial=np.inf))
    usual = max(1.4826 * float(np.median(np.abs(off))), finest)
    # times may be off by a row, and slopes be those of either side
    unsure = np.maximum(np.abs(before), np.abs(behind)) * row + np.abs(behind - before) * took
    large = np.abs(off) > NOISE * usual + unsure + fastest * took**2
    within = np.arange(AROUND)
    levels = [
        np.median(y[rows] - slope[:, None] * (t[rows] - t[to][:, None]), axis=1)
        for rows, slope, to in (
            (last[:, None] - within, before, last),
            (ahead[:, None] + within, behind, ahead),
        )
    ]
    stays = levels[1] - levels[0] - 0.5 * (before + behind) * took
    return ahead[large & (stays * off > 0.5 * off**2)]
