"""Vibration: lines at multiples of the rotor speeds, and their aliases, in what the body shakes.

A rotor out of balance shakes it once a turn, two to four blades that pass as often as that, and either
rotor does. The phase drifts with every error of the rotor speed, so there is no signature over a run
as other effects have. Lines are looked for in the readings themselves, with the phase free in each
second (order_tracking.py), at the times of the samples, so that aliases need no thought. The power
there is compared with that at neighbouring frequencies of the same seconds: noise that is merely louder
than assumed is louder there too, and is no vibration. Where no rotor speed is measured, the commanded
one is taken, times the one factor near 1 with which the line is strongest.

The strongest line of each kind of sensor comes first; it is taken out, and the next is looked for in
what is left, until there is none.

Accelerometers are shaken far beyond what the body moves, and gyros where it cannot follow, so that
there an alias is a line as well where it does not lie among the motion. In a tracked pose all below
half of its rate is motion, and what looks like an alias is that.

This comes before the search. A line of usual size would make every accelerometer reading look several
sigmas off, and something else would be blamed for it; in a tracked pose, whose noise is far below the
shaking, it would colour every innovation of attitude and height. So it is taken out of the readings
first, second by second, and the search sees what is left.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np

from coax_env.estimation.helicopter_noise import SHAKEN
from coax_env.estimation.order_tracking import (
    NEAREST,
    NEIGHBOURS,
    ROTOR_NAMES,
    Part,
    Turning,
    fitted,
    is_measured,
    parts,
)
from coax_env.logs.flight import Flight, Run
from coax_env.model.effects import CATALOGUE
from coax_env.model.vehicle import Vehicle

KINDS = {
    kind: tuple(c for c in SHAKEN if SHAKEN[c] == kind) for kind in dict.fromkeys(SHAKEN.values())
}
"""Parameter of the effect -> channels that share it as their root mean square."""
MOTION = {"amplitude": 5.0, "rate": 10.0, "tilt": math.inf, "heave": math.inf}
"""Frequency [Hz] up to which sensors of a kind read motion, and an alias is not told from it; ours. A
pose is all motion; what a body shakes in it faster than half its rate is too small to see."""
ORDERS = (1, 2, 3, 4)
"""Cycles a turn: a rotor out of balance, and two to four blades."""
SMEAR = 0.01
"""Part of the amplitude that phase errors within a segment and clipped peaks take away (measured)."""
SLIPS = np.linspace(0.985, 1.015, 13)
"""Speeds over the commanded ones that are tried where none is measured: a bench line's error; ours."""
ENOUGH = 14.0
"""nats that a line must be worth, as a name in a diagnosis by default; ours."""
SHOWS = 2.0  # times its neighbours that a line's power must be for a channel to be said to show it


@dataclass(frozen=True)
class Line:
    """A line found in one kind of channels.

    kind: a key of KINDS. rotor: at whose speed, times slip; order: of ORDERS. amplitude: root mean
    square over the channels, in their unit, with its std. evidence: nats. steady: nats of all
    channels, or of the one that shows it best, by their median second: a rotor shakes in all of
    them. channels: where it shows, strongest first.
    ratios: run -> power over its neighbours', second by second. beside: (run, channel) -> mean power
    of these.
    """

    kind: str
    rotor: str
    order: int
    slip: float
    amplitude: float
    std: float
    evidence: float
    steady: float
    channels: tuple[str, ...]
    ratios: Mapping[str, Sequence[float]]
    beside: Mapping[tuple[str, str], float]

    def evidence_of(self, ratios: Sequence[float]) -> float:
        """Evidence [nats] of some of the seconds alone."""
        return _evidence(ratios) if ratios else 0.0

    @property
    def place(self) -> tuple[str, str, int]:
        """Which of all that may be looked for."""
        return self.kind, self.rotor, self.order

    def is_no_chance(self, tries: int = 1) -> bool:
        """Whether there is one, in most seconds, where so many were tried in its place."""
        return min(self.evidence, self.steady) > ENOUGH + math.log(tries)


def find(flight: Flight) -> tuple[Line, ...]:
    """The lines at multiples of the rotor speeds that the flight has, however small, by kind."""
    found: dict[tuple[str, str, int], Line] = {}
    asked = set(KINDS)
    while asked:
        rest = taken_out(flight, found.values()) if found else flight
        strongest = {}
        slips = {x.rotor: x.slip for x in sorted(found.values(), key=lambda x: x.evidence)}
        for line in sorted(_lines(rest, asked, slips), key=lambda x: x.evidence):
            if line.place not in found:
                strongest[line.kind] = line
        found |= {line.place: line for line in strongest.values()}
        asked = set(strongest)
    return tuple(
        _beside(flight, line, found.values())
        for line in sorted(found.values(), key=lambda x: list(KINDS).index(x.kind))
    )


def _beside(flight: Flight, line: Line, every: Collection[Line]) -> Line:
    """A line as it is without the others of its kind, if it still shows then."""
    others = [other for other in every if other.kind == line.kind and other is not line]
    if not others:
        return line
    again = _lines_at(taken_out(flight, others), line.rotor, line.slip, {line.kind})
    return next((x for x in again if x.place == line.place and x.is_no_chance()), line)


def large(lines: Sequence[Line]) -> dict[str, tuple[float, float]]:
    """Amplitude of the lines of each kind, as of the one sine that shakes as strongly, and its std.

    Of those kinds alone that shake enough to matter.
    """
    smallest = {p.name: p.smallest for p in CATALOGUE["vibration"].parameters}
    found = {}
    for kind in KINDS:
        own = [line for line in lines if line.kind == kind]
        amplitude = math.hypot(*(line.amplitude for line in own))
        if amplitude > smallest[kind]:
            std = math.hypot(*(line.amplitude * line.std for line in own)) / amplitude
            found[kind] = amplitude, std
    return found


def taken_out(flight: Flight, lines: Collection[Line]) -> Flight:
    """The flight without the lines in its readings, all of a kind fitted together."""
    runs = []
    for run in flight.runs:
        measured = dict(run.measured)
        for kind in dict.fromkeys(line.kind for line in lines):
            measured |= _calm(run, kind, [line for line in lines if line.kind == kind])
        runs.append(replace(run, measured=measured))
    return replace(flight, runs=tuple(runs))


def _calm(run: Run, kind: str, lines: Sequence[Line]) -> dict[str, np.ndarray]:
    """The readings of a kind of channels in a run without its lines, by channel."""
    turning = {(x.rotor, x.slip): Turning(run, x.rotor, x.slip) for x in lines}
    calm = {c: run.measured[c].copy() for c in KINDS[kind] if c in run.measured}
    for channels, alike in groupby(parts(run, KINDS[kind]), lambda part: part.channels):
        some = list(alike)
        angles = [
            [turning[x.rotor, x.slip].angle(part, x.order, MOTION[kind]) for x in lines]
            for part in some
        ]
        beside = [min(x.beside.get((run.name, c), math.inf) for x in lines) for c in channels]
        for part, shaken in zip(some, fitted(some, angles, 0.5 * np.array(beside)), strict=True):
            for c, channel in enumerate(channels):
                calm[channel][part.rows] -= shaken[:, c]
    return calm


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


def remark(lines: Sequence[Line]) -> str:
    """That a vibration was taken out of the readings."""
    units = {p.name: p.unit for p in CATALOGUE["vibration"].parameters}
    by_source: dict[str, list[str]] = {}
    for line in lines:
        source = f"{TIMES[line.order]} a turn of the {line.rotor} rotor"
        size = f"{' '.join(line.channels)} by {line.amplitude:.2g} {units[line.kind]}"
        by_source.setdefault(source, []).append(size)
    shakes = ", ".join(f"{source} ({', '.join(sizes)})" for source, sizes in by_source.items())
    return f"the body shakes {shakes}: taken out before anything else was looked for"


TIMES = {1: "once", 2: "twice", 3: "three times", 4: "four times"}
"""Orders of a line, in words."""


# --- the test ---------------------------------------------------------------------------------------


def _lines(flight: Flight, kinds: Collection[str], slips: Mapping[str, float]) -> Iterator[Line]:
    """All lines in some kinds of channels that are no chance, each at its best slip.

    Args:
        flight: in which. kinds: of channels. slips: of rotors, where they are known.
    """
    for rotor in ROTOR_NAMES:
        if all(is_measured(run, rotor) for run in flight.runs):
            tried = [1.0]
        else:
            tried = [slips[rotor]] if rotor in slips else SLIPS.tolist()
        best: dict[tuple[str, str, int], Line] = {}
        for slip in tried:
            for line in _lines_at(flight, rotor, slip, kinds):
                other = best.get(line.place)
                if other is None or line.evidence > other.evidence:
                    best[line.place] = line
        yield from (line for line in best.values() if line.is_no_chance(len(tried)))


@dataclass
class _Tally:
    """What the seconds say of one line.

    ratio: power over its neighbours' by channel, by_run: by run. beside: mean power of these by run and
    channel. squares: amplitude squared, by second and axis. peak: what is more at the line than NEAREST
    to it.
    """

    ratio: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    by_run: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    beside: dict[tuple[str, str], float] = field(default_factory=dict)
    squares: list[float] = field(default_factory=list)
    peak: np.ndarray = field(default_factory=lambda: np.zeros(NEAREST.size))


def _lines_at(flight: Flight, rotor: str, slip: float, kinds: Collection[str]) -> Iterator[Line]:
    """The lines at multiples of a rotor's speed times a factor, however weak, that are a peak there."""
    tallies: dict[tuple[str, int], _Tally] = defaultdict(_Tally)
    for run in flight.runs:
        turning = Turning(run, rotor, slip)
        powers: dict[tuple[str, int], list[_Powers]] = defaultdict(list)
        for part in parts(run, [c for c, kind in SHAKEN.items() if kind in kinds]):
            for channel, order, of_part in _powers(part, turning):
                powers[channel, order].append(of_part)
        for (channel, order), found in powers.items():
            own, near, beside, count = map(np.concatenate, zip(*found, strict=True))
            level = float(beside.mean()) if beside.size else 0.0
            if level > 0.0:
                tally = tallies[SHAKEN[channel], order]
                tally.peak += (own[:, None] - near).sum(0) / level
                tally.ratio[channel] += (own / level).tolist()
                tally.by_run[run.name] += (own / level).tolist()
                tally.beside[run.name, channel] = level
                tally.squares += (2.0 * (own - level) / count).tolist()
    for (kind, order), tally in tallies.items():
        if len(tally.squares) > 1 and tally.peak.min() > 0.0:
            yield _line_of(kind, rotor, order, slip, tally)


_Powers = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Power at a line in each second (s,), NEAREST to it (s, n), of NEIGHBOURS (any,); readings (s,)."""


def _powers(part: Part, turning: Turning) -> Iterator[tuple[str, int, _Powers]]:
    """The powers of each channel and order that some seconds can show.

    Not where the other rotor's line is.
    """
    ahead, n = turning.ahead(part)[:, None], part.t.shape[1]
    kinds = {SHAKEN[c] for c in part.channels}
    shown = {(k, kind): turning.shows(part, k, MOTION[kind]) for k in ORDERS for kind in kinds}
    orders = [k for k in ORDERS if any(shown[k, kind].any() for kind in kinds)]
    if not orders:
        return
    powers = part.powers(turning.azimuth[part.rows], orders)
    for o, order in enumerate(orders):
        apart = np.abs(NEIGHBOURS - order * ahead) > 1.0
        for c, channel in enumerate(part.channels):
            rows = shown[order, SHAKEN[channel]]
            of_line = powers[rows, c, o]
            own, near, beside = np.split(of_line, [1, 1 + NEAREST.size], axis=1)
            count = np.full(len(of_line), float(n))
            yield channel, order, (own[:, 0], near, beside[apart[rows]], count)


def _line_of(kind: str, rotor: str, order: int, slip: float, tally: _Tally) -> Line:
    squares = tally.squares
    amplitude = float(np.sqrt(max(float(np.mean(squares)), 0.0)))
    spread = float(np.std(squares, ddof=1) / np.sqrt(len(squares)))
    std = spread / max(2.0 * amplitude, float(np.sqrt(spread)))
    shown = {c: float(np.mean(r)) for c, r in tally.ratio.items()}
    every = [r for own in tally.ratio.values() for r in own]
    return Line(
        kind=kind,
        rotor=rotor,
        order=order,
        slip=slip,
        amplitude=amplitude,
        std=float(np.hypot(std, SMEAR * amplitude)),
        evidence=_evidence(every),
        steady=max(map(_steady_evidence, (every, *tally.ratio.values()))),
        channels=tuple(sorted((c for c in shown if shown[c] > SHOWS), key=lambda c: -shown[c]))
        or tuple(shown),
        ratios=dict(tally.by_run),
        beside=tally.beside,
    )


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
