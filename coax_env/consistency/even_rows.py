"""A run's signals on even rows, and their weak derivatives: slopes of noisy, slow, uneven readings.

A derivative is never formed. With a smooth weight w that vanishes at the ends of a window,
the mean of x' over it is -int(w' x) dt and that of x'' is int(w'' x) dt, so that noise is averaged
and not amplified.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise

import numpy as np

from coax_env.logs.flight import Flight, Run
from coax_env.logs.units import BATTERY, ROTOR_COMMANDS, SWASH_COMMANDS
from coax_env.model.layout import ANGLES, RPM_PER_RAD_S

STEP = 0.01
"""Time between even rows [s]: the fastest logs that are read come at about that."""
FEWEST_READINGS = 10
LONGEST_HOLE = 0.1
"""Time [s] without a reading over which a channel is not interpolated: a clipped peak is none of a
straight line (a gyro missing for 0.2 s at a time read a third of the turn); and not less than..."""
HOLE_STEPS = 3.0
"""...so many of its usual steps: GPS comes once a second; ours."""


@dataclass(frozen=True)
class EvenRows:
    """All runs of a flight on even rows, one behind the other.

    Attributes:
        edges: first row of each run, and the row behind the last.
        signals: channel or command -> (n,) in its canonical unit, angles without jumps of a turn; 0 in
            runs that have none of it.
        known: channel or command -> (n,) where it is neither absent nor bridged over a hole.
    """

    edges: tuple[int, ...]
    signals: Mapping[str, np.ndarray]
    known: Mapping[str, np.ndarray]
    _windows: dict[tuple[frozenset[str], float], "Windows"] = field(
        default_factory=dict, repr=False, compare=False
    )

    def windows(self, channels: frozenset[str], length: float) -> "Windows":
        """Those in which channels are known throughout; looked for once, also for other signals.

        Args:
            channels: names, of which those that are not there count as known.
            length: of a window [s].
        """
        asked = channels.intersection(self.known), length
        if asked not in self._windows:
            starts, run = window_starts(self.edges, length)
            sound = np.ones(starts.size, bool)
            for channel in asked[0]:
                sound &= all_known(self.known[channel], starts, length)
            self._windows[asked] = Windows(starts[sound], run[sound], len(self.edges) - 1)
        return self._windows[asked]

    def run(self, number: int) -> "EvenRows":
        """One run of them, with the channels that it has."""
        rows = slice(self.edges[number], self.edges[number + 1])
        there = [name for name, known in self.known.items() if known[rows].any()]
        return EvenRows(
            (0, rows.stop - rows.start),
            {name: self.signals[name][rows] for name in there},
            {name: self.known[name][rows] for name in there},
        )


@dataclass(frozen=True)
class Windows:
    """Windows of one length that follow each other at half of it.

    Attributes:
        starts: their first rows, (k,).
        run: the number of the run of each, (k,).
        runs: how many runs there are.
    """

    starts: np.ndarray
    run: np.ndarray
    runs: int

    def without_means(self, values: np.ndarray) -> np.ndarray:
        """Values (k, m) of the windows, less the mean of each run's own."""
        count = np.maximum(np.bincount(self.run, minlength=self.runs), 1)
        sums = np.stack(
            [np.bincount(self.run, column, minlength=self.runs) for column in values.T], axis=1
        )
        found: np.ndarray = values - (sums / count[:, None])[self.run]
        return found


def even_rows(flight: Flight) -> EvenRows:
    """The runs of a flight on even rows; a channel with a handful of readings is not there."""
    runs = [_even(run) for run in flight.runs]
    sizes = [known["delta_lon"].size for _, known in runs]
    names = dict.fromkeys(name for signals, _ in runs for name in signals)
    signals = {
        name: np.concatenate(
            [s.get(name, np.zeros(size)) for (s, _), size in zip(runs, sizes, strict=True)]
        )
        for name in names
    }
    known = {
        name: np.concatenate(
            [k.get(name, np.zeros(size, bool)) for (_, k), size in zip(runs, sizes, strict=True)]
        )
        for name in names
    }
    return EvenRows(tuple(np.cumsum([0, *sizes]).tolist()), signals, known)


def _even(run: Run) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Signals of one run, and where they are known."""
    t = np.arange(run.t[0], run.t[-1], STEP)
    rows = np.clip(np.searchsorted(run.t, t + 1e-9, side="right") - 1, 0, run.t.size - 1)
    signals: dict[str, np.ndarray] = {}
    known: dict[str, np.ndarray] = {}
    for k, name in enumerate((*ROTOR_COMMANDS, *SWASH_COMMANDS)):
        unit = RPM_PER_RAD_S if name in ROTOR_COMMANDS else 1.0
        signals[name] = unit * run.command[rows, k]
        known[name] = np.ones(t.size, bool)
    if run.battery is not None:
        signals[BATTERY] = run.battery[rows]
        known[BATTERY] = np.ones(t.size, bool)
    for channel, values in run.measured.items():
        given = np.isfinite(values)
        if np.count_nonzero(given) < FEWEST_READINGS:
            continue
        at, y = run.t[given], values[given]
        signals[channel] = np.interp(t, at, np.unwrap(y) if channel in ANGLES else y)
        steps = np.diff(at)
        longest = max(LONGEST_HOLE, HOLE_STEPS * float(np.median(steps)))
        after = np.clip(np.searchsorted(at, t), 1, at.size - 1)
        known[channel] = (steps[after - 1] <= longest) & (t >= at[0]) & (t <= at[-1])
    return signals, known


# --- weak derivatives -----------------------------------------------------------------------------


def window_starts(edges: tuple[int, ...], length: float) -> tuple[np.ndarray, np.ndarray]:
    """First rows (k,) of windows that follow each other at half their length, and the run of each."""
    n = _rows(length)
    starts = [np.arange(first, behind - n + 1, max(n // 2, 1)) for first, behind in pairwise(edges)]
    return np.concatenate(starts), np.repeat(np.arange(len(starts)), [s.size for s in starts])


def weak(values: np.ndarray, starts: np.ndarray, length: float, order: int) -> np.ndarray:
    """Mean of a signal's derivative over windows, (k,).

    Args:
        values: (n,) on even rows. starts: (k,) of `window_starts`. length: of a window [s].
        order: of the derivative, 0 to 2.
    """
    n = _rows(length)
    values = np.ascontiguousarray(values, dtype=float)
    # as sliding_window_view, which takes longer than the rest
    every: np.ndarray = np.ndarray(
        (values.size - n + 1, n), float, values, strides=2 * values.strides
    )
    found: np.ndarray = every[starts] @ _weights(n, order)
    return found


def all_known(known: np.ndarray, starts: np.ndarray, length: float) -> np.ndarray:
    """Windows (k,) in which a signal is known throughout; arguments as of `weak`."""
    count = np.concatenate([[0], np.cumsum(known)])
    n = _rows(length)
    found: np.ndarray = count[starts + n] - count[starts] == n
    return found


def _rows(length: float) -> int:
    return round(length / STEP) + 1


@cache
def _weights(n: int, order: int) -> np.ndarray:
    """w = (1 - s^2)^3 on s in [-1, 1], of mean 1 over the window, and its derivatives by t."""
    s = np.linspace(-1.0, 1.0, n)
    half = 0.5 * (n - 1) * STEP
    bump = 1.0 - s**2
    scale = 1.0 / float((bump**3).sum())
    if order == 0:
        return scale * bump**3
    if order == 1:
        return scale / half * 6.0 * s * bump**2
    return scale / half**2 * (24.0 * s**2 * bump - 6.0 * bump**2)
