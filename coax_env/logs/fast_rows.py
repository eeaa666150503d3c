"""Logs with more rows than a body of this size moves by: fewer rows, and nothing lost.

A fit costs so much for every row, and 500 rows a second tell nothing of a flight that their means over
a hundredth of a second do not. So rows are kept every hundredth of a second, and besides all rows with
a reading of a sensor slower than the log, untouched. Of a sensor with a reading in every row the mean
of the rows around a kept row stands there, at that row's time: what changes evenly stays as it is, and
white noise white. Of a rotor's speed that follows its command at once it is the mean until the next
kept row, as of a command. Of a command the mean of what was held until the next kept row stands, whose
effect is the same.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from coax_env.kernel.angles import wrap_angles
from coax_env.logs.flight import Flight, Run
from coax_env.logs.held_signal import integral_of_held
from coax_env.model.layout import ANGLES, ROTOR_SPEEDS, RPM_PER_RAD_S
from coax_env.plain_words import and_list

ENOUGH_RATE = 100.0
"""Rows per second that a fit needs [Hz]: ten times what the shipped vehicles' rates turn over by, and
the rate that all was measured at; ours."""
IN_EVERY_ROW = 0.9
"""Share of the rows from which on a sensor is as fast as the log; ours."""
AT_ONCE = 0.5
"""Share of a command's jump in its own row; a motor that lags by 20 ms follows by none, and by a fifth
in the next one at 200 Hz; ours."""


def decimated(flight: Flight) -> Flight:
    """The flight with no more than about ENOUGH_RATE rows per second, and a note of it.

    A flight of less than twice that rate is returned as it is. The stated noise of what was averaged
    becomes that of the means.

    Args:
        flight: its runs as flown, without gaps.
    """
    factors = [_factor(run.t) for run in flight.runs]
    if max(factors, default=1) < 2:
        return flight
    fast = [_fast_channels(run) for run in flight.runs]
    runs = tuple(
        _decimated_run(run, k, own) if k > 1 else run
        for run, k, own in zip(flight.runs, factors, fast, strict=True)
    )
    averaged = [c for c in flight.channels if any(c in own for own in fast)]
    least = min(k for k in factors if k > 1)
    rows = sum(run.t.size for run in flight.runs), sum(run.t.size for run in runs)
    counts = Counter(flight.counts) + Counter({"rows averaged": rows[0] - rows[1]})
    return replace(
        flight, runs=runs, noise=_of_means(flight.noise, averaged, least), counts=dict(counts),
        notes=(*flight.notes, _note(averaged, max(factors), *rows)),
    )  # fmt: skip


def _factor(t: np.ndarray) -> int:
    """Rows of a run whose time one row may stand for."""
    if t.size < 3:
        return 1
    return max(1, int(1.001 / (ENOUGH_RATE * float(np.median(np.diff(t))))))


def _fast_channels(run: Run) -> frozenset[str]:
    return frozenset(
        c for c, values in run.measured.items() if np.isfinite(values).mean() > IN_EVERY_ROW
    )


def _decimated_run(run: Run, factor: int, fast: frozenset[str]) -> Run:
    """A run with a row for `factor`, and those of readings of channels that are not `fast`."""
    slow = [np.isfinite(values) for c, values in run.measured.items() if c not in fast]
    kept = _kept_rows(run.t.size, factor, _rows_with(slow))
    commands = dict(zip(ROTOR_SPEEDS, RPM_PER_RAD_S * run.command[:, :2].T, strict=True))

    def taken(channel: str, values: np.ndarray) -> np.ndarray:
        if channel not in fast:
            return values[kept]
        if channel in commands and _follows_at_once(values, commands[channel]):
            return _mean_of_rows(values, kept, np.append(kept[1:], kept[-1:] + 1))
        return _means(channel, values, run.t, kept)

    measured = {channel: taken(channel, values) for channel, values in run.measured.items()}
    battery = None if run.battery is None else run.battery[kept]
    return replace(
        run, t=run.t[kept], command=_held_means(run, kept), measured=measured, battery=battery,
        began=run.beginning,
    )  # fmt: skip


def _rows_with(readings: Sequence[np.ndarray]) -> np.ndarray:
    """Rows in which one of some channels has a reading; (n,) of each whether it has."""
    return np.flatnonzero(np.any(readings, axis=0)) if readings else np.empty(0, np.int64)


def _kept_rows(count: int, factor: int, needed: np.ndarray) -> np.ndarray:
    """Rows no more than `factor` apart, evenly between those needed; half as many lie at either end."""
    first, last = factor // 2, count - 1 - factor // 2
    needed = needed[(needed >= first) & (needed <= last)]
    if not needed.size:
        return np.arange(first, last + 1, factor)
    between = [
        np.linspace(a, b, math.ceil((b - a) / factor) + 1)[1:].round() for a, b in pairwise(needed)
    ]
    before = np.arange(needed[0], first - 1, -factor)[::-1]
    behind = np.arange(needed[-1], last + 1, factor)[1:]
    return np.concatenate([before, *between, behind]).astype(np.int64)


def _means(channel: str, values: np.ndarray, t: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Means around the rows kept, at the times of these.

    Where rows are uneven, or of an even number, the mean of their times is another one: a millisecond
    beside it is 3 mm at 3 m/s.
    """
    there = np.flatnonzero(np.isfinite(values))
    smooth = values.copy()
    if channel in ANGLES:
        smooth[there] = np.unwrap(values[there])
    windows = _around(kept)
    found = _mean_of_rows(smooth, *windows)
    at = _mean_of_rows(np.where(np.isfinite(values), t, np.nan), *windows)
    read = np.flatnonzero(np.isfinite(found))
    if read.size > 1:
        found[read] += np.gradient(found[read], at[read]) * (t[kept] - at)[read]
    return wrap_angles(found) if channel in ANGLES else found


def _around(kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First row of those around each kept one, and the row behind the last; each row is in one alone.

    As many on either side as half the way to the nearer neighbour has; where that is a row itself, it
    belongs to the row kept before it, whose command acts there. Taken by half into both means it made
    neighbours' noise alike by a sixth at 200 to 299 rows a second: innovations stayed coloured, and
    readings were believed less.
    """
    apart = np.diff(kept)
    spacing = np.minimum(np.append(apart[:1], apart), np.append(apart, apart[-1:]))
    return kept - (spacing - 1) // 2, kept + spacing // 2 + 1


def _mean_of_rows(values: np.ndarray, first: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Means of the readings that some rows have, NaN where none has one.

    Args:
        values: (n,). first: of each, (k,). behind: the row after the last of each, (k,).
    """
    finite = np.isfinite(values)
    sums = np.append(0.0, np.cumsum(np.where(finite, values, 0.0)))
    counts = np.append(0, np.cumsum(finite))
    weight = (counts[behind] - counts[first]).astype(float)
    found = np.full(first.size, np.nan)
    np.divide(sums[behind] - sums[first], weight, out=found, where=weight > 0.0)
    return found


def _follows_at_once(speed: np.ndarray, command: np.ndarray) -> bool:
    """Whether a rotor's measured speed jumps from row to row as its command does, or half so far.

    Args:
        speed, command: (n,), both in one unit.
    """
    jump, told = np.diff(speed), np.diff(command)
    both = np.isfinite(jump)
    return float(jump[both] @ told[both]) > AT_ONCE * float(told[both] @ told[both])


def _held_means(run: Run, kept: np.ndarray) -> np.ndarray:
    """Of each command the mean from a kept row to the next, (rows, 4); at the last what it is there."""
    t = run.t[kept]
    means = [
        np.append(np.diff(integral_of_held(run.t, column)(t)) / np.diff(t), column[kept[-1]])
        for column in run.command.T
    ]
    return np.array(means).T


def _of_means(noise: Mapping[str, float], averaged: Sequence[str], rows: int) -> dict[str, float]:
    return {c: std / np.sqrt(rows) if c in averaged else std for c, std in noise.items()}


def _note(averaged: Sequence[str], factor: int, before: int, after: int) -> str:
    said = f"{before} rows taken as {after}, about {ENOUGH_RATE:g} a second"
    if not averaged:
        return said
    return (
        f"{said}: means over {factor} of {and_list(list(averaged))}, and their noise is the means'"
    )
