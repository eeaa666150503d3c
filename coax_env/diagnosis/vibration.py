"""Vibration: a line at rotor speed, and its aliases, in the accelerometers.

Its phase drifts with every error of the rotor speed, so it has no signature over a run as other
effects have. It is looked for in the readings themselves, order-tracked: in segments of a second the
readings are fitted with sine and cosine of the rotor's azimuth, the phase free in each, at the times
of the samples, so that aliases need no thought (Fyfe and Munck 1997 for the order tracking; the
least-squares periodogram of Lomb 1976 for uneven times). The power there is compared with that at
neighbouring frequencies of the same segments: noise that is merely louder than assumed is louder
there too, and is no vibration.

This comes before the search. A line of usual size would make every accelerometer reading look several
sigmas off, and something else would be blamed for it; so it is taken out of the readings first,
segment by segment, and the search sees what is left.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.diagnosis.settings import SETTINGS
from coax_env.logs.flight import Flight, Run
from coax_env.model.effects import CATALOGUE
from coax_env.model.vehicle import Vehicle

ACCELEROMETERS = ("ax", "ay", "az")
ROTORS = ("upper", "lower")
SEGMENT = 1.0  # s
LEAST_SAMPLES = 12  # of a channel in a segment
TREND = 3  # order of the polynomial that stands for the motion within a segment
NEIGHBOURS = (-5.0, -4.0, -3.0, -2.0, 2.0, 3.0, 4.0, 5.0)
"""Frequencies beside the line [Hz]; those nearer than 1 Hz to the other rotor's are left out."""
SMEAR = 0.01
"""Part of the amplitude that phase errors within a segment and clipped peaks take away (measured)."""
SHOWS = 2.0  # times its neighbours that a line's power must be for a channel to be said to show it


@dataclass(frozen=True)
class Line:
    """A line found in the accelerometers.

    amplitude: [m/s2], root mean square over the axes, with its std. evidence: nats. channels: where it
    shows, strongest first. ratios: run -> power over its neighbours', segment by segment.
    """

    rotor: str
    amplitude: float
    std: float
    evidence: float
    channels: tuple[str, ...]
    ratios: Mapping[str, Sequence[float]]

    def evidence_of(self, ratios: Sequence[float]) -> float:
        """Evidence [nats] of some of the segments alone."""
        return _evidence(ratios) if ratios else 0.0


def find(flight: Flight) -> Line | None:
    """The line at one of the two rotor speeds, where the flight has one that matters."""
    lines = [line for rotor in ROTORS if (line := _line(flight, rotor))]
    smallest = CATALOGUE["vibration"].parameters[0].smallest
    lines = [x for x in lines if x.evidence > SETTINGS.evidence and x.amplitude > smallest]
    return max(lines, key=lambda x: x.evidence, default=None)


def taken_out(flight: Flight, line: Line) -> Flight:
    """The flight without the line in its accelerometers."""
    runs = []
    for run in flight.runs:
        measured = dict(run.measured)
        for channel in ACCELEROMETERS:
            if channel in measured:
                values = measured[channel].copy()
                for segment in _segments(run, channel, line.rotor):
                    values[segment.rows] -= segment.line()
                measured[channel] = values
        runs.append(replace(run, measured=measured))
    return replace(flight, runs=tuple(runs))


def without(vehicle: Vehicle) -> Vehicle:
    """The vehicle without its vibration."""
    rest = {name: table for name, table in vehicle.effects.items() if name != "vibration"}
    return replace(vehicle, effects=rest)


# --- one segment ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Segment:
    """Readings of one channel over a second, with the azimuth of the rotor at their times.

    ahead: how much faster the other rotor turns [Hz].
    """

    rows: np.ndarray
    t: np.ndarray
    y: np.ndarray
    azimuth: np.ndarray
    ahead: float

    def _waves(self, beside: np.ndarray) -> np.ndarray:
        """Sines and cosines beside the rotor's frequency by so much (f,) [Hz], shape (f, 2, n)."""
        angle = self.azimuth + 2.0 * np.pi * beside[:, None] * self.t
        return np.stack([np.sin(angle), np.cos(angle)], axis=1)

    def _trend(self) -> np.ndarray:
        return np.vander(self.t / SEGMENT, TREND + 1)

    def powers(self, beside: np.ndarray) -> np.ndarray:
        """Sums of squares that waves beside the rotor's frequency explain beyond the trend, (f,)."""
        trend, _ = np.linalg.qr(self._trend())
        waves = self._waves(beside)
        waves -= (waves @ trend) @ trend.T
        answer = waves @ self.y
        inverse = np.linalg.pinv(waves @ waves.transpose(0, 2, 1), hermitian=True, rcond=1e-9)
        return np.einsum("fi,fij,fj->f", answer, inverse, answer)

    def line(self) -> np.ndarray:
        """The wave at the rotor's frequency itself, (n,)."""
        waves = self._waves(np.zeros(1))[0].T
        fit = np.linalg.lstsq(np.column_stack([self._trend(), waves]), self.y, rcond=None)[0]
        return waves @ fit[-2:]


def _segments(run: Run, channel: str, rotor: str) -> Iterator[_Segment]:
    speed, other = (_speed(run, r) for r in (rotor, *(r for r in ROTORS if r != rotor)))
    azimuth = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.diff(run.t))])
    values = run.measured[channel]
    there = np.isfinite(values)
    which = np.floor((run.t - run.t[0]) / SEGMENT)
    for k in np.unique(which):
        rows = np.flatnonzero((which == k) & there)
        if rows.size >= LEAST_SAMPLES:
            ahead = float(np.median(other[rows] - speed[rows])) / (2.0 * np.pi)
            t = run.t[rows] - run.t[rows[0]] - 0.5 * SEGMENT
            yield _Segment(rows, t, values[rows], azimuth[rows], ahead)


def _speed(run: Run, rotor: str) -> np.ndarray:
    """Rotor speed at every row [rad/s]: as measured, else as commanded."""
    measured = run.measured.get(f"rpm_{rotor}")
    there = np.isfinite(measured) if measured is not None else np.zeros(0, bool)
    if measured is None or there.sum() < 2:
        return run.command[:, ROTORS.index(rotor)]
    return np.interp(run.t, run.t[there], measured[there]) * (2.0 * np.pi / 60.0)


# --- the test ---------------------------------------------------------------------------------------


def _line(flight: Flight, rotor: str) -> Line | None:
    """The line at one rotor's speed, however weak; None without accelerometers."""
    ratio: dict[str, list[float]] = {
        c: [] for c in ACCELEROMETERS
    }  # power over the neighbours' mean
    squares: list[float] = []  # amplitude squared, by segment and axis
    by_run: dict[str, list[float]] = {run.name: [] for run in flight.runs}
    for run in flight.runs:
        for channel in (c for c in ACCELEROMETERS if c in run.measured):
            segments = list(_segments(run, channel, rotor))
            powers, beside = (
                [],
                [],
            )  # at the rotor's own frequency; beside it, but not at the other's
            for segment in segments:
                own, *rest = segment.powers(np.array([0.0, *NEIGHBOURS])).tolist()
                powers.append(own)
                beside += [
                    p for f, p in zip(NEIGHBOURS, rest, strict=True) if abs(f - segment.ahead) > 1.0
                ]
            level = float(np.mean(beside)) if beside else 0.0
            if level > 0.0:
                ratio[channel] += [p / level for p in powers]
                by_run[run.name] += [p / level for p in powers]
                squares += [
                    2.0 * (p - level) / s.t.size for p, s in zip(powers, segments, strict=True)
                ]
    if len(squares) < 2:
        return None
    mean = float(np.mean(squares))
    amplitude = float(np.sqrt(max(mean, 0.0)))
    spread = float(np.std(squares, ddof=1) / np.sqrt(len(squares)))
    std = spread / max(2.0 * amplitude, float(np.sqrt(spread)))
    shown = {c: float(np.mean(r)) for c, r in ratio.items() if r}
    return Line(
        rotor=rotor,
        amplitude=amplitude,
        std=float(np.hypot(std, SMEAR * amplitude)),
        evidence=_evidence([r for own in ratio.values() for r in own]),
        channels=tuple(sorted((c for c in shown if shown[c] > SHOWS), key=lambda c: -shown[c]))
        or tuple(shown),
        ratios=by_run,
    )


def _evidence(ratios: Sequence[float]) -> float:
    """Log-likelihood [nats] that powers of two degrees of freedom are louder than their neighbours.

    Each is exponential, of mean 1 where there is no line: n (F - 1 - log F) with F their mean. That
    is what adding the line is worth to a filter whose noise level is right.
    """
    F = float(np.mean(ratios))
    return len(ratios) * (F - 1.0 - float(np.log(F))) if F > 1.0 else 0.0
