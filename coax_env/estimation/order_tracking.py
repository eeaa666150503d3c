"""Readings followed along a rotor's turns: what its sines explain of them, second by second.

Order tracking with the phase free in each second (Fyfe and Munck 1997, Mech. Syst. Signal Process. 11),
at the times of the samples (the least-squares periodogram of Lomb 1976 for uneven times).
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from coax_env.logs.flight import Run
from coax_env.model.layout import ANGLES

ROTOR_NAMES = ("upper", "lower")
SEGMENT = 1.0  # s
LEAST_SAMPLES = 12  # of a channel in a segment
TREND = 3  # order of the polynomial that stands for the motion within a segment
NEIGHBOURS = np.array([-5.0, -4.0, -3.0, -2.0, 2.0, 3.0, 4.0, 5.0])
"""Frequencies beside a line [Hz]; those nearer than 1 Hz to the other rotor's are left out."""
NEAREST = np.array([-1.5, -0.75, 0.75, 1.5])
"""Nearer ones [Hz], at which a line in a second has a tenth of its power at most: what is louder there
than at the line itself is no line of the rotor; ours."""
BESIDE = np.concatenate([[0.0], NEAREST, NEIGHBOURS])
AT_ONCE = 64  # seconds whose waves are made at once: some megabytes at 100 Hz; ours
HELD = (1, 2, 4, 8, 16, 32)
"""Seconds for which a sine's phase and amplitude may stay; ours."""
ALIKE = 1e-7
"""Least eigenvalue, over the largest, of the products of waves that are told from each other; ours."""


@dataclass(frozen=True)
class Part:
    """Seconds of a run in which some channels have n readings each, at the same rows.

    number: (s,) of the seconds in the run. rows: theirs, (s, n). t: their times in the second, (s, n).
    y: the channels' readings, (s, c, n).
    """

    channels: tuple[str, ...]
    number: np.ndarray
    rows: np.ndarray
    t: np.ndarray
    y: np.ndarray

    @cached_property
    def rate(self) -> np.ndarray:
        """Readings in a second, as most are apart, (s,) [Hz]."""
        return np.asarray(1.0 / np.median(np.diff(self.t), axis=1))

    @cached_property
    def trend(self) -> np.ndarray:
        """Orthonormal polynomials, (s, n, TREND + 1)."""
        return np.linalg.qr((self.t[..., None] / SEGMENT) ** np.arange(TREND + 1))[0]

    def powers(self, azimuth: np.ndarray, orders: Sequence[int]) -> np.ndarray:
        """Sums of squares of the readings that sines explain beyond the trend: at each order of a
        rotor's frequency, then NEAREST to it, then at its NEIGHBOURS, (s, c, o, f).

        Args:
            azimuth: (s, n) of the rotor. orders: o of them, cycles a turn.
        """
        s, n = self.t.shape
        turn = np.exp(1j * azimuth)[:, None]
        beside = np.exp(2j * np.pi * BESIDE[:, None] * self.t[:, None])
        waves = np.concatenate([turn**k * beside for k in orders], axis=1)
        beyond = self.y - (self.y @ self.trend) @ self.trend.swapaxes(1, 2)
        explained = _squares_explained(
            waves @ beyond.swapaxes(1, 2), (waves * waves).sum(2), n, waves @ self.trend
        )
        return explained.swapaxes(1, 2).reshape(s, len(self.channels), len(orders), -1)

    def waves(self, angles: Sequence[np.ndarray]) -> np.ndarray:
        """Sines and cosines of some angles (s, n), (s, 2 a, n); 0 where there is no angle."""
        waves = [np.stack([np.sin(a), np.cos(a)], axis=1) for a in angles]
        return np.nan_to_num(np.concatenate(waves, axis=1))

    def products(self, waves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of waves (s, w, n) beyond the trend, with each other (s, w, w) and the readings (s, c, w)."""
        beyond = waves - (waves @ self.trend) @ self.trend.swapaxes(1, 2)
        return beyond @ beyond.swapaxes(1, 2), self.y @ beyond.swapaxes(1, 2)


def fitted(
    some: Sequence[Part], angles: Sequence[Sequence[np.ndarray]], noise: np.ndarray
) -> list[np.ndarray]:
    """What sines of some angles explain together of the readings, of each part (s, c, n).

    Phase and amplitude stay for as many seconds as is likeliest: a speed that is measured well holds
    them together for a whole run, one that is commanded hardly for a second. What is fitted anew in
    each second takes the noise at that frequency away with it, and leaves what looks like a filter. And
    of what is fitted only that share is a line's which is more than noise would make it (James and
    Stein 1961).

    Args:
        some: parts of a run with the same channels. angles: of each part (s, n), NaN: none.
        noise: (c,) mean sum of squares that noise alone leaves to each sine.
    """
    waves = [part.waves(own) for part, own in zip(some, angles, strict=True)]
    of_parts = [part.products(w) for part, w in zip(some, waves, strict=True)]
    squares, answers = (np.concatenate(each) for each in zip(*of_parts, strict=True))
    number = np.concatenate([part.number for part in some])
    best = 0.0, np.zeros_like(answers)
    for seconds in HELD:
        place = np.unique(number // seconds, return_inverse=True)[1]
        A, b = _sums(squares, place), _sums(answers, place)
        sizes = b @ np.linalg.pinv(A, hermitian=True, rcond=ALIKE)
        explained = float(((sizes * b).sum((0, 2)) / noise).sum())
        share = 1.0 - sizes.size / explained if explained > sizes.size else 0.0
        if share**2 * explained > best[0]:
            best = share**2 * explained, share * sizes[place]
    ends = np.cumsum([part.number.size for part in some])[:-1]
    return [sizes @ w for sizes, w in zip(np.split(best[1], ends), waves, strict=True)]


def _sums(matrices: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Of matrices (s, ...) those with the same place (s,) added up, in the order of the places."""
    total = np.zeros((place.max() + 1, *matrices.shape[1:]))
    np.add.at(total, place, matrices)
    return total


def _squares_explained(
    answers: np.ndarray, doubled: np.ndarray, n: int, in_trend: np.ndarray
) -> np.ndarray:
    """Sums of squares that each wave's cosine and sine explain together, (s, w, c).

    Args:
        answers: (s, w, c) sums of the complex waves times what is beyond the trend of each channel.
        doubled: (s, w) sums of their squares. n: readings. in_trend: (s, w, k) what is trend of them.
    """
    cc = 0.5 * (n + doubled.real) - (in_trend.real**2).sum(2)
    ss = 0.5 * (n - doubled.real) - (in_trend.imag**2).sum(2)
    cs = 0.5 * doubled.imag - (in_trend.real * in_trend.imag).sum(2)
    whole, det = cc + ss, cc * ss - cs * cs
    # at half the readings' rate the one is all of the other; of what is all trend nothing is left
    both, any_is = det > ALIKE * whole**2, whole > ALIKE * n
    one = np.where(any_is, whole**2, np.inf)
    weights = (
        np.where(both, x, y) / np.where(both, det, one)
        for x, y in ((ss, cc), (-2.0 * cs, 2.0 * cs), (cc, ss))
    )
    of_cc, of_cs, of_ss = (w[..., None] for w in weights)
    a, b = answers.real, answers.imag
    return np.asarray(of_cc * a**2 + of_cs * a * b + of_ss * b**2)


class Turning:
    """A rotor in a run, as measured, else as commanded times a slip.

    measured: whether its speed is. azimuth: (rows,) [rad].
    """

    def __init__(self, run: Run, rotor: str, slip: float) -> None:
        self.measured = is_measured(run, rotor)
        self._speed, self._other = (
            slip * _speed(run, r) for r in (rotor, *(r for r in ROTOR_NAMES if r != rotor))
        )
        self.azimuth = np.concatenate([[0.0], np.cumsum(self._speed[:-1] * np.diff(run.t))])

    def ahead(self, part: Part) -> np.ndarray:
        """How much faster the other rotor turns in each second, (s,) [Hz]."""
        faster = np.median(self._other[part.rows] - self._speed[part.rows], axis=1)
        return np.asarray(faster / (2.0 * np.pi))

    def shows(self, part: Part, order: int, motion: float) -> np.ndarray:
        """Seconds (s,) in which readings can show what shakes at an order of the rotor's frequency.

        More than two a cycle show it, by a cycle in all: nearer to two a sine is hardly read, and one
        reading that is off is a line.

        Args:
            part: the seconds. order: cycles a turn.
            motion: frequency [Hz] from which on an alias is no motion, and so a line, too; not of a
                speed that is not measured beyond the second order: with all the slips that may be,
                some alias fits anything.
        """
        n = part.rows.shape[1]
        azimuth = self.azimuth[part.rows[:, [0, -1]]]
        cycles = order * (azimuth[:, 1] - azimuth[:, 0]) / (2.0 * np.pi)
        resolved = 2.0 * (cycles + 1.0) < n - 1
        if not self.measured and order > 2:
            return np.asarray(resolved)
        f = cycles / (part.t[:, -1] - part.t[:, 0])
        alias = np.abs(f - part.rate * np.round(f / part.rate))
        return np.asarray(resolved | (alias > motion))

    def angle(self, part: Part, order: int, motion: float) -> np.ndarray:
        """What turns at an order of the rotor's frequency, (s, n) [rad]; NaN where it does not show.

        Args:
            part, order, motion: as of `shows`.
        """
        shown = self.shows(part, order, motion)[:, None]
        return np.where(shown, order * self.azimuth[part.rows], np.nan)


def parts(run: Run, channels: Collection[str]) -> Iterator[Part]:
    """The seconds of a run in which some channels are read often enough to show a line."""
    alike = defaultdict(list)
    for channel in (c for c in channels if c in run.measured):
        alike[np.isfinite(run.measured[channel]).tobytes()].append(channel)
    for own in alike.values():
        there = np.isfinite(run.measured[own[0]])
        values = np.array(
            [_unwrapped(run.measured[c], there) if c in ANGLES else run.measured[c] for c in own]
        )
        for rows in _seconds(run.t, np.flatnonzero(there)):
            t = run.t[rows]
            number = np.floor((t[:, 0] - run.t[0]) / SEGMENT).astype(int)
            t = t - t[:, :1] - 0.5 * SEGMENT
            yield Part(tuple(own), number, rows, t, values[:, rows].swapaxes(0, 1))


def _seconds(t: np.ndarray, rows: np.ndarray) -> Iterator[np.ndarray]:
    """Rows (s, n) of AT_ONCE seconds at most that have as many; t: (n,) time [s]."""
    which = np.floor((t[rows] - t[0]) / SEGMENT)
    as_many = defaultdict(list)
    for own in np.split(rows, np.flatnonzero(np.diff(which)) + 1):
        if own.size >= LEAST_SAMPLES:
            as_many[own.size].append(own)
    for seconds in as_many.values():
        for k in range(0, len(seconds), AT_ONCE):
            yield np.array(seconds[k : k + AT_ONCE])


def _unwrapped(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Angles without jumps of a turn, (n,)."""
    values = values.copy()
    values[there] = np.unwrap(values[there])
    return values


def is_measured(run: Run, rotor: str) -> bool:
    """Whether a rotor's speed is, in a run."""
    measured = run.measured.get(f"rpm_{rotor}")
    return measured is not None and int(np.isfinite(measured).sum()) >= 2


def _speed(run: Run, rotor: str) -> np.ndarray:
    """Rotor speed at every row [rad/s]: as measured, else as commanded."""
    if not is_measured(run, rotor):
        return run.command[:, ROTOR_NAMES.index(rotor)]
    measured = run.measured[f"rpm_{rotor}"]
    there = np.isfinite(measured)
    return np.interp(run.t, run.t[there], measured[there]) * (2.0 * np.pi / 60.0)
