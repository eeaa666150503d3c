"""Rows that were read evenly, and logged with times that were not.

A motion capture reads its markers by its own clock; the computer that logs them writes the times at
which they arrived, a millisecond or two sooner or later. At 3 m/s that is 3 mm on a position known to
one, and a filter that believes the times finds causes for it: on two clean **synthetic** flights a late
command and a motor lag of 400 to 4,000 nats, both sure.

The log says which it is. Where a row is off the middle between its neighbours in time, a reading that
was taken then is off their mean by its rate times that; one of even rows is not. The slope of the one
in the other, over all readings, is 1 for times that are right and 0 for times that are not (1.01 +-
0.01 and 0.00 +- 0.003 on **synthetic** flights). Then each row gets its time on an even clock.
Poses that software has smoothed from row to row have slopes between, and are not asked
(smoothed.py), nor are readings without noise.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import median_abs_deviation

from coax_env.logs.repairs import Repaired
from coax_env.logs.smoothed import are_steep
from coax_env.model.layout import ANGLES, MOTION

WRONG, UNSURE = 0.1, 0.15
"""Slope, and its std, up to which times are wrong; ours. Smoothed poses have 0.15 to 0.45; times that
are right are six such std away. (With two std within WRONG 0.00 +- 0.07 was not believed. A low-pass
does not come back from times 2.4 ms off: a ground effect of 798 nats had no name; **synthetic**.)"""
UNEVEN = 0.02
"""Share of the usual step by which times scatter where there is anything to mend; ours."""
LARGEST = 0.3
"""The same, beyond which a row's place on an even clock is not known; ours."""
FAR = 6.0
"""Times the usual scatter from which a reading says nothing, an outlier; ours."""
AHEAD = 8
"""Rows whose mean says whether one was lost before them; ours."""
LONG = 1.4
"""Usual steps between which one may be missing; ours."""
FOLLOWED = 0.1
"""Share of a row's scatter that the even clock follows, which drifts; ours."""
NEAR = 4
"""Rows by which it may have been lost sooner or later than that says; ours."""
SURE = 1.3
"""Times their scatter from row to row that times may be off the even clock: places are known; ours."""


def on_even_clock(runs: Sequence[Repaired], counts: Counter[str]) -> list[Repaired]:
    """Runs whose rows have the times at which they were read, where those logged are not.

    Args:
        runs: of one flight. counts: what was repaired -> how often; rows with other times are added.
    """
    if not any(_is_uneven(*_scatter_and_step(run.t)) for run in runs):  # the rest takes long
        return list(runs)
    slope, std = slope_of(runs)
    if not (slope < WRONG and std < UNSURE) or are_steep(runs):
        return list(runs)
    found = [replace(run, t=even_times(run.t)) for run in runs]
    others = sum(np.count_nonzero(a.t != b.t) for a, b in zip(found, runs, strict=True))
    if others:
        counts["rows read evenly whose logged times were not, put on an even clock"] += int(others)
    return found


def slope_of(runs: Sequence[Repaired]) -> tuple[float, float]:
    """How far readings follow the times of uneven rows, 1 wholly, and its std; infinite without any.

    Args:
        runs: of one flight.
    """
    pairs = [pair for run in runs for pair in _off_the_middle(run)]
    if not pairs:
        return 1.0, math.inf
    expected, seen = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    power = float(expected @ expected)
    slope = float(expected @ seen) / power
    return slope, math.sqrt(float(np.mean((seen - slope * expected) ** 2)) / power)


def _off_the_middle(run: Repaired) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """By channel, in std: how far readings would be off their neighbours' mean by time, and are."""
    for channel in run.measured.keys() & set(MOTION):
        present = np.flatnonzero(np.isfinite(run.measured[channel]))
        if present.size < 4 * AHEAD:
            continue
        t, y = run.t[present], run.measured[channel][present]
        y = np.unwrap(y) if channel in ANGLES else y
        steps = np.diff(t)
        usual = float(np.median(steps))
        rate = np.convolve(np.gradient(y) / usual, np.full(5, 0.2), "same")[1:-1]
        expected = rate * (t[1:-1] - 0.5 * (t[:-2] + t[2:]))
        seen = y[1:-1] - 0.5 * (y[:-2] + y[2:])
        beside = np.maximum(steps[:-1], steps[1:]) < LONG * usual  # no row is missing there
        scatter = median_abs_deviation(seen, scale="normal")
        kept = beside & (np.abs(seen) < FAR * (scatter + np.abs(expected)))
        if scatter > 0.0 and expected[kept].any():
            yield expected[kept] / scatter, seen[kept] / scatter


def _is_uneven(scatter: float, step: float) -> bool:
    """Whether times scatter so that there is something to mend, and it can be."""
    return UNEVEN * step < scatter < LARGEST * step


def _scatter_and_step(t: np.ndarray) -> tuple[float, float]:
    """By how much times of rows (n,) scatter, and how far rows are apart [s]; 0 where they are few."""
    scatter = float(median_abs_deviation(np.diff(t), scale="normal")) / math.sqrt(2.0)
    step = float(np.median(t[AHEAD:] - t[:-AHEAD])) / AHEAD if t.size > 2 * AHEAD else 0.0
    return scatter, step


def even_times(t: np.ndarray) -> np.ndarray:
    """Times of rows (n,) on an even clock, lost rows left out; as they are where it is not clear.

    Args:
        t: as logged [s].
    """
    scatter, step = _scatter_and_step(t)
    if not _is_uneven(scatter, step):
        return t
    for _ in range(3):  # the step's length, and where rows were lost, in turns
        place = _places(t, step)
        step, first = np.polyfit(place, t, 1)
        place = _refined(place, (t - first) / step)
    even = first + step * place
    return even if np.std(even - t) < SURE * scatter else t


def _places(t: np.ndarray, step: float) -> np.ndarray:
    """Places of rows (n,) on an even clock whose rows are `step` [s] apart.

    A row was lost where a step is long, and so late in their mean are the rows behind it, too.
    """
    place = np.zeros(t.size)
    now = t[0]  # of the row, on the even clock
    for row in range(1, t.size):
        late = t[row] - now
        if late > LONG * step:
            behind = t[row : row + AHEAD]
            late = min(late, float(np.mean(behind - step * np.arange(behind.size))) - now)
        moved = max(round(late / step), 1)
        place[row] = place[row - 1] + moved
        now += moved * step
        now += FOLLOWED * (t[row] - now)
    return place


def _refined(place: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Places of rows (n,) where each loss comes when it fits best, some rows sooner or later.

    Args:
        place: of each row. seen: where its time puts it.
    """
    place = place.copy()
    for row in (np.flatnonzero(np.diff(place) > 1.0) + 1).tolist():
        low, high = max(row - NEAR, 1), min(row + NEAR, place.size - 1)
        about = np.arange(low, high)
        lost = place[row] - place[row - 1] - 1.0
        plain = place[low:high] - lost * (about >= row)
        trials = plain + lost * (about >= np.arange(low, high + 1)[:, None])
        place[low:high] = trials[np.argmin(((trials - seen[low:high]) ** 2).sum(axis=1))]
    return place
