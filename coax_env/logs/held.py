"""Held samples: a slow sensor's last reading, written again into every row until the next one comes.

Read as new, ten equal readings say that the machine stood still, ten times over. A channel that truly
repeats must not be mistaken for a held one: a coarse sensor (1 cm steps) of a machine at rest, or one
that moves by a step at a time. So what counts is the pattern over the whole run.
"""

import numpy as np

from coax_env.logs.packets import stretches

FEWEST = 10  # changes of value in a run, from which a pattern can be seen; ours
LEAST_HELD = 0.95
"""Share of the values that a held channel shows more than once; ours."""
COARSE_STEP = 1.5
"""Resolutions up to which a change is that of a coarse sensor, read at every row; ours."""
LEAST_LEAPS = 0.5
"""Share of a held channel's changes that are larger than that; ours."""
MOST_REPEATED = 0.05
"""Share of values shown more than once, up to which a channel never repeats by chance; ours."""
MISSING = 1.8  # usual steps from which on a row is missing; ours
FROZEN = 5
"""Equal readings in such a channel that are no chance: less than one in a million; ours."""


def repeats(
    values: np.ndarray, hold: bool | None = None, t: np.ndarray | None = None
) -> np.ndarray:
    """Where a channel's cells hold no new reading, (n,) bool.

    Args:
        values: (n,) readings, NaN where there is none.
        hold: what the card says: every repeat is one, or none is; None: by the pattern.
        t: (n,) time [s]; None: no row is missing.
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
    off_beat = _off_beat(_row_numbers(present, t), starts[1:][~_is_spike(y)[starts[1:]]])
    if off_beat is not None:
        found[present[again & off_beat]] = True
        return found
    if _is_held(inner, np.abs(np.diff(y[starts]))) or _beyond_chance(y):
        found[present[again]] = True
    elif np.mean(inner > 1) <= MOST_REPEATED:
        # the last value too, and the first: interpolation beyond the ends repeats them
        times = np.diff(starts, append=y.size)
        for frozen in np.flatnonzero(times >= FROZEN):
            first = starts[frozen]
            found[present[first + 1 : first + times[frozen]]] = True
    return found


def _is_held(times: np.ndarray, steps: np.ndarray) -> bool:
    """Whether nearly every value shows more than once, and the next one is not just a step away."""
    leaps = np.mean(steps > COARSE_STEP * steps.min())
    return bool(np.mean(times > 1) >= LEAST_HELD and leaps >= LEAST_LEAPS)


ON_THE_BEAT = 0.95
"""Share of a channel's changes that come at the same one of every few rows, from which on nothing is
read at the others; ours."""
FEWEST_ON_IT = 25  # changes: of two rows in turn, chance makes so many in 3 million logs one; ours
SLOWEST_BEAT = 50  # rows from one reading to the next; ours


def _is_spike(y: np.ndarray) -> np.ndarray:
    """Where a row alone is off, (n,) bool, and the one that is back: an outlier, no new reading."""
    off = np.zeros(y.size, bool)
    alone = np.flatnonzero((y[1:-1] != y[:-2]) & (y[2:] == y[:-2])) + 1
    off[alone] = off[alone + 1] = True
    return off


def _row_numbers(present: np.ndarray, t: np.ndarray | None) -> np.ndarray:
    """Of each row with a reading, its number were none missing."""
    if t is None:
        return present
    step = np.diff(t)
    if not step.size or step.max() <= MISSING * step.min():  # none can be missing
        return present
    usual = float(np.median(step))
    missing = np.where(step > MISSING * usual, np.round(step / usual) - 1.0, 0.0)
    return present + np.append(0.0, np.cumsum(missing)).astype(int)[present]


def _off_beat(rows: np.ndarray, changes: np.ndarray) -> np.ndarray | None:
    """Rows at which a sensor that is read every so many rows has no reading; None: there is no beat.

    A coarse sensor's next reading is often the last one again, so that how long values show says
    little; when they change says all.

    Args:
        rows: (n,) numbers of the rows. changes: places of those with another value than the one before.
    """
    if changes.size < FEWEST_ON_IT:
        return None
    at = rows[changes]
    # every change that is off a beat spoils two steps at most: too many by one row, and there is none
    if np.count_nonzero(np.diff(at) == 1) > 2.0 * (1.0 - ON_THE_BEAT) * at.size:
        return None
    for beat in range(SLOWEST_BEAT, 1, -1):
        counts = np.bincount(at % beat, minlength=beat)
        if counts.max() >= ON_THE_BEAT * changes.size:
            return np.asarray(rows % beat != counts.argmax())
    return None


MOST_BY_CHANCE = 5.0
"""Times as many repeats as there would be by chance, from which on they are held samples; ours."""
NEARLY_ALL_LEAP = 0.9
"""Share of the changes that are more than a step away where this is asked; ours."""


def _beyond_chance(y: np.ndarray) -> bool:
    """Whether repeats are far more than a sensor of this resolution makes: 80 Hz held on rows at
    100 Hz.

    By chance a sensor's next reading is the same as often as it is a given one of the two next to it.
    """
    step = np.abs(np.diff(y))
    moved = step[step > 0.0]
    if moved.size < FEWEST:
        return False
    beside = int(np.count_nonzero(moved <= COARSE_STEP * moved.min()))
    same = step.size - moved.size
    many = same > MOST_BY_CHANCE * (0.5 * beside + FEWEST) and same > MOST_REPEATED * step.size
    return many and beside <= (1.0 - NEARLY_ALL_LEAP) * moved.size


# --- lines and cubics between readings --------------------------------------------------------------

LEAST_STRAIGHT = 0.3
"""Share of the rows that lie on the line between their neighbours, from which on a channel was
interpolated..."""
LEAST_KINK = 3.0
"""...if the others are off it by so many roundings; ours."""
AROUND_A_READING = 2  # rows that are off a line, where none is at the reading itself
MOST_DIGITS = 9  # behind the point, in which a rounding is looked for
MOST_APART = 8  # roundings between the two numbers that are next to each other
OFF_GRID = 0.05  # of a rounding: more is no number of that grid
SAME = 1e-6  # of the widest step between two levels: closer, they are one; ours
OFF_STEP = 0.2  # of a coarse sensor's step: its numbers are rounded once more; ours
A_FEW = 32  # numbers that are asked first: where they have more decimals, so have all


def interpolated(t: np.ndarray, values: np.ndarray, angle: bool = False) -> np.ndarray:
    """Where a channel's cells lie on a line or a cubic between readings, and are none, (n,) bool.

    Resampling that puts no row at a reading is found in part (a line) or not at all (a cubic).

    Args:
        t: (n,) time [s]. values: (n,) readings, NaN where there is none.
        angle: whether they are angles [rad], which may jump by a turn.
    """
    found = np.zeros(values.size, bool)
    present = np.flatnonzero(~np.isnan(values))
    if present.size < 3 * FEWEST:
        return found
    y = values[present]
    grid = grid_of(y)
    rounding = max(_rounding(y), grid, 1e-9 * float(np.abs(y).max()))
    y = np.unwrap(y) if angle else y
    inside = _on_lines_or_cubics(t[present], present, y, rounding)
    if not inside.any() and grid > 0.0:
        inside = _on_coarse_lines(_row_numbers(present, t), y, grid)
    found[present[inside]] = True
    return found


def _on_lines_or_cubics(
    at: np.ndarray, rows: np.ndarray, y: np.ndarray, rounding: float
) -> np.ndarray:
    """Where numbers that are far finer than their sensor lie on lines or cubics, (n,) bool.

    Args:
        at: (n,) time [s]. rows: (n,) places. y: (n,) numbers. rounding: unit of their last decimal.
    """
    found = np.zeros(y.size, bool)
    # by the times as they are logged, or by the even clock that there was before these were wrong
    off = min((_off_line(x, y) for x in (at, rows)), key=np.median)
    # three numbers are rounded, each by half a unit at most
    straight = (off <= 1.01 * rounding) & (y[2:] != y[:-2])
    kinks = off[off > 1.01 * rounding]
    if kinks.size < FEWEST or np.median(kinks) <= LEAST_KINK * rounding:
        return found
    if np.mean(straight) >= LEAST_STRAIGHT:
        if _share_alone(~straight) >= ALIKE:
            found[1:-1][straight] = True
    elif (curved := _inside_cubics(at, y, rounding)).any():
        found |= curved
    elif np.mean(straight) <= MOST_REPEATED:  # a line over a gap
        for first, behind in stretches(straight):
            if behind - first >= FROZEN:
                found[1 + first : 1 + behind] = True
    return found


def _share_alone(off: np.ndarray) -> float:
    """Share of the rows off a line, (n,) bool, that are alone, or two with the reading between them."""
    lengths = np.array([behind - first for first, behind in stretches(off)])
    return float(lengths[lengths <= AROUND_A_READING].sum() / max(lengths.sum(), 1))


SLOWEST_LINES = 20  # rows between the readings that coarse lines are looked for through; ours
LEAST_APART = 25  # rows that are off such lines wherever else the readings were; ours
MOST_OFF = 0.2
"""Share of these that may be off the lines through the readings: outliers, a clock's jump; ours."""


def _on_coarse_lines(rows: np.ndarray, y: np.ndarray, grid: float) -> np.ndarray:
    """Where numbers as coarse as their sensor's noise lie on lines between readings, (n,) bool.

    A line and a number on it are off by half a step each at most, if its ends are readings; if they are
    not, the noise of those that are is seen.

    Args:
        rows: (n,) numbers of the rows. y: (n,) numbers. grid: step between them.
    """
    own = np.round(np.diff(rows) / np.median(np.diff(rows)))  # a slow channel's rows are every so many
    rows = np.append(0, np.cumsum(np.maximum(own, 1.0)).astype(int))
    # of three rows on one line each is off by a step at most; a tenth are, if a fifth are on none
    if float(np.quantile(_off_line(rows, y), 0.1)) > 2.02 * grid:
        return np.zeros(y.size, bool)
    for every in range(SLOWEST_LINES, 1, -1):
        off = []
        for first in range(every):
            knots = rows % every == first
            if np.count_nonzero(knots) < FEWEST:
                break
            line = np.interp(rows, rows[knots], y[knots])
            off.append(int(np.count_nonzero(np.abs(y - line) > 1.01 * grid)))
        else:
            least, *others = sorted(off)
            if others[0] >= LEAST_APART and least <= MOST_OFF * others[0]:
                return np.asarray(rows % every != off.index(least))
    return np.zeros(y.size, bool)


def grid_of(y: np.ndarray) -> float:
    """Step between the numbers of a coarse sensor, rounded or not; 0 where there is none."""
    levels = np.unique(y)
    whole = float(np.ptp(levels))
    if whole == 0.0:
        return 0.0
    apart = np.diff(levels)
    step = whole / round(whole / float(apart[apart > SAME * apart.max()].min()))
    return step if _off_whole((levels - levels[0]) / step) < OFF_STEP else 0.0


def _off_line(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """How far each number is from the line between its neighbours, (n - 2,)."""
    share = (x[1:-1] - x[:-2]) / (x[2:] - x[:-2])
    return np.asarray(np.abs(y[1:-1] - (1.0 - share) * y[:-2] - share * y[2:]))


FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
"""Of five numbers on even rows: 0 where they lie on one cubic."""
AROUND_A_KNOT = 3
"""Fives that have one knot inside them, and so no cubic."""
LEAST_ON_CUBICS = 0.2  # share of the fives: a quarter, with a reading every four rows; ours
ALIKE = 0.8
"""Share of the breaks between cubics that are single knots, and of the rows off lines that are beside
one. A smooth log without noise is on both in quiet parts too, but breaks for long in others: of poses
at 240 Hz, smoothed at 6 Hz, up to 85 % of the rows had been left out; ours."""
EVEN = 1e-3  # most by which steps of even rows differ, over their length; ours


def _inside_cubics(t: np.ndarray, y: np.ndarray, rounding: float) -> np.ndarray:
    """Where numbers lie inside one cubic between readings four rows apart or more, (n,) bool.

    Args:
        t: (n,) time [s]. y: (n,) numbers. rounding: unit of their last decimal.
    """
    off = np.abs(np.convolve(y, FOURTH, "valid"))
    most = 0.51 * rounding * float(np.abs(FOURTH).sum())  # each is rounded by half a unit
    step = np.diff(t)
    even = np.abs(step - np.median(step)) < EVEN * np.median(step)
    on_one = (off <= most) & (np.convolve(even, np.ones(4), "valid") > 3.5)
    inside = np.zeros(y.size, bool)
    broken = [behind - first for first, behind in stretches(~on_one)]
    kinks = off[~on_one]
    if (
        np.mean(on_one) >= LEAST_ON_CUBICS
        and len(broken) >= FEWEST
        and np.mean(np.array(broken) == AROUND_A_KNOT) >= ALIKE
        and np.median(kinks) > LEAST_KINK * most
    ):
        for row in np.flatnonzero(on_one):
            inside[row + 1 : row + 4] = True
    return inside


def _rounding(y: np.ndarray) -> float:
    """Unit of the last decimal that any number has, in the unit it was logged in (deg: all numbers are
    multiples of one); 0 where there are too many."""
    largest = float(np.abs(y).max())
    for digits in range(MOST_DIGITS + 1):
        most = 1e-6 * max(1.0, largest * 10.0**digits * 1e-6)
        if all(_off_whole(some * 10.0**digits) < most for some in (y[:A_FEW], y)):
            return float(10.0**-digits)
    apart = np.diff(np.unique(y))
    apart = apart[apart > 1e-9 * largest]
    if not apart.size:
        return 0.0
    whole = float(np.ptp(y))
    for parts in range(1, MOST_APART + 1):
        unit = whole / round(parts * whole / float(apart.min()))
        if _off_whole((y - y.min()) / unit) < OFF_GRID:
            return unit
    return 0.0


def _off_whole(scaled: np.ndarray) -> float:
    """Largest distance of numbers from whole ones."""
    return float(np.abs(scaled - np.round(scaled)).max())
