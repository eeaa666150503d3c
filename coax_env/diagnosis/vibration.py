"""Vibration: a line at rotor speed, and its aliases, in what the body shakes.

Its phase drifts with every error of the rotor speed, so it has no signature over a run as other
effects have. It is looked for in the readings themselves, order-tracked: in segments of a second the
readings are fitted with sine and cosine of the rotor's azimuth, the phase free in each, at the times
of the samples, so that aliases need no thought (Fyfe and Munck 1997 for the order tracking; the
least-squares periodogram of Lomb 1976 for uneven times). The power there is compared with that at
neighbouring frequencies of the same segments: noise that is merely louder than assumed is louder
there too, and is no vibration. Where no rotor speed is measured, the commanded one is taken, times the
one factor near 1 with which the line is strongest.

Accelerometers are shaken far beyond what the body moves, so that there an alias is a line as well.
Gyros and poses are not: below half of their readings' rate all is motion, and what looks like an alias
is that.

This comes before the search. A line of usual size would make every accelerometer reading look several
sigmas off, and something else would be blamed for it; in a tracked pose, whose noise is far below the
shaking, it would colour every innovation of attitude and height. So it is taken out of the readings
first, segment by segment, and the search sees what is left.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.helicopter_noise import SHAKEN
from coax_env.logs.flight import Flight, Run
from coax_env.model.effects import CATALOGUE
from coax_env.model.layout import ANGLES
from coax_env.model.vehicle import Vehicle

KINDS = {
    kind: tuple(c for c in SHAKEN if SHAKEN[c] == kind) for kind in dict.fromkeys(SHAKEN.values())
}
"""Parameter of the effect -> channels that share it as their root mean square."""
ROTORS = ("upper", "lower")
SEGMENT = 1.0  # s
LEAST_SAMPLES = 12  # of a channel in a segment
TREND = 3  # order of the polynomial that stands for the motion within a segment
NEIGHBOURS = (-5.0, -4.0, -3.0, -2.0, 2.0, 3.0, 4.0, 5.0)
"""Frequencies beside the line [Hz]; those nearer than 1 Hz to the other rotor's are left out."""
SMEAR = 0.01
"""Part of the amplitude that phase errors within a segment and clipped peaks take away (measured)."""
SLIPS = np.linspace(0.985, 1.015, 13)
"""Speeds over the commanded ones that are tried where none is measured: a bench line's error; ours."""
AT_ONCE = 64  # seconds whose waves are made at once: a megabyte at 100 Hz; ours
SHOWS = 2.0  # times its neighbours that a line's power must be for a channel to be said to show it


@dataclass(frozen=True)
class Line:
    """A line found in one kind of channels.

    kind: a key of KINDS. rotor: at whose speed, times slip. amplitude: root mean square over the
    channels, in their unit, with its std. evidence: nats. steady: nats of all channels, or of the one
    that shows it best, by their median segment: a rotor shakes in all of them. channels: where it
    shows, strongest first.
    ratios: run -> power over its neighbours', segment by segment.
    """

    kind: str
    rotor: str
    slip: float
    amplitude: float
    std: float
    evidence: float
    steady: float
    channels: tuple[str, ...]
    ratios: Mapping[str, Sequence[float]]

    def evidence_of(self, ratios: Sequence[float]) -> float:
        """Evidence [nats] of some of the segments alone."""
        return _evidence(ratios) if ratios else 0.0


def find(flight: Flight) -> tuple[Line, ...]:
    """The lines at one of the two rotor speeds, where the flight has some that matter, by kind."""
    smallest = {p.name: p.smallest for p in CATALOGUE["vibration"].parameters}

    def of(rotor: str) -> tuple[Line, ...]:
        lines = (_line(flight, rotor, kind) for kind in KINDS)
        return tuple(
            x
            for x in lines
            if x
            and min(x.evidence, x.steady) > SETTINGS.evidence
            and x.amplitude > smallest[x.kind]
        )

    return max(map(of, ROTORS), key=lambda lines: sum(x.evidence for x in lines))


def taken_out(flight: Flight, lines: Sequence[Line]) -> Flight:
    """The flight without the lines in its readings."""
    runs = []
    for run in flight.runs:
        measured = dict(run.measured)
        for line in lines:
            for channel in (c for c in KINDS[line.kind] if c in measured):
                values = measured[channel].copy()
                for seconds, readings in _Turning(run, line.rotor, line.slip).segments(channel):
                    values[seconds.rows] -= seconds.line(readings)
                measured[channel] = values
        runs.append(replace(run, measured=measured))
    return replace(flight, runs=tuple(runs))


def calmed(flight: Flight, vehicle: Vehicle) -> tuple[tuple[Line, ...], Flight, Vehicle]:
    """The lines, if the flight has some, and flight and vehicle without them.

    Args:
        flight: what was flown.
        vehicle: as given; its vibration is in the readings no longer once the lines are taken out.
    """
    lines = find(flight)
    return (lines, taken_out(flight, lines), without(vehicle)) if lines else ((), flight, vehicle)


def without(vehicle: Vehicle) -> Vehicle:
    """The vehicle without its vibration."""
    rest = {name: table for name, table in vehicle.effects.items() if name != "vibration"}
    return replace(vehicle, effects=rest)


# --- segments ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Seconds:
    """Seconds of a run in which a channel or several have n readings each.

    rows: theirs, (s, n). t: their times in the second, azimuth: of the rotor then. ahead: how much
    faster the other rotor turns in each second, (s,) [Hz]. resolved: whether the readings are more than
    two per turn of the rotor, by a turn in all. Nearer to two its sine is hardly read, and one reading
    that is off is a line.
    """

    rows: np.ndarray
    t: np.ndarray
    azimuth: np.ndarray
    ahead: np.ndarray
    resolved: bool

    def _waves(self, beside: np.ndarray) -> np.ndarray:
        """Sines and cosines beside the rotor's frequency by so much (f,) [Hz], shape (s, f, 2, n)."""
        angle = self.azimuth[:, None] + 2.0 * np.pi * beside[:, None] * self.t[:, None]
        return np.stack([np.sin(angle), np.cos(angle)], axis=2)

    @cached_property
    def _beyond_trend(self) -> tuple[np.ndarray, np.ndarray]:
        """Waves at the rotor's frequency and its NEIGHBOURS without their trend, (s, f, 2, n), and the
        inverse of their products, (s, f, 2, 2).
        """
        powers = (self.t[..., None] / SEGMENT) ** np.arange(TREND + 1)
        trend = np.linalg.qr(powers)[0][:, None]
        waves = self._waves(np.array([0.0, *NEIGHBOURS]))
        waves -= (waves @ trend) @ trend.swapaxes(2, 3)
        products = waves @ waves.swapaxes(2, 3)
        return waves, np.linalg.pinv(products, hermitian=True, rcond=1e-9)

    def powers(self, y: np.ndarray) -> np.ndarray:
        """Sums of squares of readings (s, n) that waves explain beyond the trend: at the rotor's
        frequency, then at its NEIGHBOURS, (s, f).
        """
        waves, inverse = self._beyond_trend
        answer = waves @ y[:, None, :, None]
        return np.asarray((answer.swapaxes(2, 3) @ inverse @ answer)[..., 0, 0])

    def line(self, y: np.ndarray) -> np.ndarray:
        """The wave at the rotor's frequency itself in readings (s, n), of that shape."""
        waves, inverse = (part[:, 0] for part in self._beyond_trend)
        sizes = inverse @ waves @ y[..., None]
        return np.asarray((sizes.swapaxes(1, 2) @ self._waves(np.zeros(1))[:, 0])[:, 0])


class _Turning:
    """A run with a rotor's azimuth; channels that are read at the same rows share their seconds."""

    def __init__(self, run: Run, rotor: str, slip: float) -> None:
        self.run = run
        self.speed, self.other = (
            slip * _speed(run, r) for r in (rotor, *(r for r in ROTORS if r != rotor))
        )
        self.azimuth = np.concatenate([[0.0], np.cumsum(self.speed[:-1] * np.diff(run.t))])
        self._seconds: dict[bytes, list[_Seconds]] = {}

    def segments(self, channel: str) -> Iterator[tuple[_Seconds, np.ndarray]]:
        """The seconds in which a channel can show a line, with its readings (s, n)."""
        values = self.run.measured[channel]
        there = np.isfinite(values)
        if channel in ANGLES:
            values = _unwrapped(values, there)
        at = there.tobytes()
        if at not in self._seconds:
            self._seconds[at] = list(self._seconds_of(there))
        for seconds in self._seconds[at]:
            if channel in KINDS["amplitude"] or seconds.resolved:
                yield seconds, values[seconds.rows]

    def _seconds_of(self, there: np.ndarray) -> Iterator[_Seconds]:
        rows = np.flatnonzero(there)
        which = np.floor((self.run.t[rows] - self.run.t[0]) / SEGMENT)
        alike = defaultdict(list)
        for own in np.split(rows, np.flatnonzero(np.diff(which)) + 1):
            if own.size >= LEAST_SAMPLES:
                turns = (self.azimuth[own[-1]] - self.azimuth[own[0]]) / (2.0 * np.pi)
                alike[own.size, bool(2.0 * (turns + 1.0) < own.size - 1)].append(own)
        for (_, resolved), seconds in alike.items():
            for k in range(0, len(seconds), AT_ONCE):
                at = np.array(seconds[k : k + AT_ONCE])
                t = self.run.t[at]
                ahead = np.median(self.other[at] - self.speed[at], axis=1) / (2.0 * np.pi)
                middle = t[:, :1] + 0.5 * SEGMENT
                yield _Seconds(at, t - middle, self.azimuth[at], ahead, resolved)


def _unwrapped(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Angles without jumps of a turn, (n,)."""
    values = values.copy()
    values[there] = np.unwrap(values[there])
    return values


def _is_measured(run: Run, rotor: str) -> bool:
    measured = run.measured.get(f"rpm_{rotor}")
    return measured is not None and int(np.isfinite(measured).sum()) >= 2


def _speed(run: Run, rotor: str) -> np.ndarray:
    """Rotor speed at every row [rad/s]: as measured, else as commanded."""
    if not _is_measured(run, rotor):
        return run.command[:, ROTORS.index(rotor)]
    measured = run.measured[f"rpm_{rotor}"]
    there = np.isfinite(measured)
    return np.interp(run.t, run.t[there], measured[there]) * (2.0 * np.pi / 60.0)


# --- the test ---------------------------------------------------------------------------------------


def _line(flight: Flight, rotor: str, kind: str = "amplitude") -> Line | None:
    """The line at one rotor's speed in one kind of channels, however weak; None without them."""
    if all(_is_measured(run, rotor) for run in flight.runs):
        return _line_at(flight, rotor, kind, 1.0)
    lines = [_line_at(flight, rotor, kind, float(slip)) for slip in SLIPS]
    return max((x for x in lines if x), key=lambda x: x.evidence, default=None)


def _line_at(flight: Flight, rotor: str, kind: str, slip: float) -> Line | None:
    """The line at the rotor's speed times a factor."""
    ratio: dict[str, list[float]] = {c: [] for c in KINDS[kind]}  # power over the neighbours' mean
    squares: list[float] = []  # amplitude squared, by segment and axis
    by_run: dict[str, list[float]] = {run.name: [] for run in flight.runs}
    for run in flight.runs:
        turning = _Turning(run, rotor, slip)
        for channel in (c for c in ratio if c in run.measured):
            segments = list(turning.segments(channel))
            powers, level = _powers(segments)
            if level > 0.0:
                ratio[channel] += (powers / level).tolist()
                by_run[run.name] += (powers / level).tolist()
                n = np.concatenate([np.full(len(y), y.shape[1]) for _, y in segments])
                squares += (2.0 * (powers - level) / n).tolist()
    if len(squares) < 2:
        return None
    amplitude = float(np.sqrt(max(float(np.mean(squares)), 0.0)))
    spread = float(np.std(squares, ddof=1) / np.sqrt(len(squares)))
    std = spread / max(2.0 * amplitude, float(np.sqrt(spread)))
    shown = {c: float(np.mean(r)) for c, r in ratio.items() if r}
    every = [r for own in ratio.values() for r in own]
    return Line(
        kind=kind,
        rotor=rotor,
        slip=slip,
        amplitude=amplitude,
        std=float(np.hypot(std, SMEAR * amplitude)),
        evidence=_evidence(every),
        steady=max(_steady_evidence(own) for own in (every, *ratio.values()) if own),
        channels=tuple(sorted((c for c in shown if shown[c] > SHOWS), key=lambda c: -shown[c]))
        or tuple(shown),
        ratios=by_run,
    )


def _powers(segments: Sequence[tuple[_Seconds, np.ndarray]]) -> tuple[np.ndarray, float]:
    """Each second's power at the rotor's own frequency, (s,), and the mean power beside it.

    Not where the other rotor's line is.
    """
    if not segments:
        return np.empty(0), 0.0
    powers = np.concatenate([seconds.powers(readings) for seconds, readings in segments])
    ahead = np.concatenate([seconds.ahead for seconds, _ in segments])
    beside = powers[:, 1:][np.abs(np.array(NEIGHBOURS) - ahead[:, None]) > 1.0]
    return powers[:, 0], float(beside.mean()) if beside.size else 0.0


def _steady_evidence(ratios: Sequence[float]) -> float:
    """As `_evidence`, with the median, which no single segment moves, for their mean: log 2 of it."""
    return _evidence([float(np.median(ratios)) / float(np.log(2.0))] * len(ratios))


def _evidence(ratios: Sequence[float]) -> float:
    """Log-likelihood [nats] that powers of two degrees of freedom are louder than their neighbours.

    Each is exponential, of mean 1 where there is no line: n (F - 1 - log F) with F their mean. That
    is what adding the line is worth to a filter whose noise level is right.
    """
    F = float(np.mean(ratios))
    return len(ratios) * (F - 1.0 - float(np.log(F))) if F > 1.0 else 0.0
