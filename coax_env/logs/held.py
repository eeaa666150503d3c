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
MOST_DIGITS = 9  # behind the point, in which a rounding is looked for
A_FEW = 32  # numbers that are asked first: where they have more decimals, so have all


def interpolated(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Where a channel's cells lie on a line or a cubic between readings, and are none, (n,) bool.

    Resampling that puts no row at a reading is found in part (a line) or not at all (a cubic).

    Args:
        t: (n,) time [s]. values: (n,) readings, angles without jumps of a turn, NaN where there is
        none.
    """
    found = np.zeros(values.size, bool)
    present = np.flatnonzero(~np.isnan(values))
    if present.size < 3 * FEWEST:
        return found
    at, y = t[present], values[present]
    share = (at[1:-1] - at[:-2]) / (at[2:] - at[:-2])
    off = np.abs(y[1:-1] - (1.0 - share) * y[:-2] - share * y[2:])
    rounding = max(_rounding(y), 1e-9 * float(np.abs(y).max()))
    # three numbers are rounded, each by half a unit at most
    straight = (off <= 1.01 * rounding) & (y[2:] != y[:-2])
    kinks = off[off > 1.01 * rounding]
    if kinks.size < FEWEST or np.median(kinks) <= LEAST_KINK * rounding:
        return found
    if np.mean(straight) >= LEAST_STRAIGHT:
        found[present[1:-1][straight]] = True
    elif (curved := _inside_cubics(at, y, rounding)).any():
        found[present[curved]] = True
    elif np.mean(straight) <= MOST_REPEATED:  # a line over a gap
        for first, behind in stretches(straight):
            if behind - first >= FROZEN:
                found[present[1 + first : 1 + behind]] = True
    return found


FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
"""Of five numbers on even rows: 0 where they lie on one cubic."""
AROUND_A_KNOT = 3
"""Fives that have one knot inside them, and so no cubic."""
LEAST_ON_CUBICS = 0.2  # share of the fives: a quarter, with a reading every four rows; ours
ALIKE = 0.8
"""Share of the breaks between cubics that are single knots. A smooth log without noise is on cubics in
quiet parts too, but breaks for long in others; ours."""
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
    """Unit of the last decimal that any number has; 0 where there are too many."""
    largest = float(np.abs(y).max())
    for digits in range(MOST_DIGITS + 1):
        most = 1e-6 * max(1.0, largest * 10.0**digits * 1e-6)
        if all(_off_whole(some * 10.0**digits) < most for some in (y[:A_FEW], y)):
            return float(10.0**-digits)
    return 0.0


def _off_whole(scaled: np.ndarray) -> float:
    """Largest distance of numbers from whole ones."""
    return float(np.abs(scaled - np.round(scaled)).max())
