"""Whether attitudes are those of an onboard filter, which has the noise of the logged gyros in them.

A filter on board carries its attitudes from row to row by the gyros, velocities and height by the
accelerometers. What they say of each other is then said twice, and no evidence: of eight clean
**synthetic** flights whose log had such a filter's states, six had a false name, a gyro's scale of 15
to 45 nats; where nothing but the gyros carried the attitudes, one had six false names, up to 750 nats.

It shows in the log alone, before any model: how far an angle turns from one reading to the next is the
integral of the gyros' readings between them *with their noise*. The two vary together by the motion,
and by as much more as the gyros' noise is in the angle, which of two sensors of their own is nothing.
Then the filter's states are read once a second, their errors last, and a remark says so.

What is wrong with the sensors that carry the states is in these as well, in part. So a name that says
it is doubtful, and its numbers are known to a half of the largest: on seven **synthetic** flights with
one such effect each 17 of 19 were 0.2 to 1.3 times the true ones, two had the other sign, and so 18 of
the intervals hold the truth.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.state_space import Record
from coax_env.logs.flight import Run
from coax_env.logs.frames import euler_rates
from coax_env.model.layout import ANGLES, GYROS, MOTION
from coax_env.plain_words import seconds

SHARES = (0.6, 1.4)
"""Of the gyros' noise that is in an angle carried by them, all three angles. Fused flights had 0.81 to
1.14; others, **synthetic** and real, 0.5 at most on one of the three at least; noise that gyros and
attitudes have in common from row to row 20 and more; ours."""
CERTAIN = 5.0
"""std of its own scatter that a share must be; ours."""
LIKELY = 2.0
"""std of that by which it may be more: of an angle in steps of 1.6 degrees 1.7 +- 0.2; ours."""
FEWEST = 100
"""Turns between readings that are enough; ours."""
ORDER = 2
"""Differences of turns that are compared: what lasts longer than two readings is gone; ours."""
OF_NOISE = 3
"""Differences of a gyro's readings that are nearly noise alone; ours."""
CIRCULAR = frozenset({
    "gyro_scale", "gyro_bias", "attitude_bias", "magnetic_field", "imu_tilt", "accel_scale",
    "accel_bias", "sonar_scale", "sonar_tilt", "sonar_delay",
})  # fmt: skip
"""Effects that show in what the sensors of such a filter and its states say of each other."""
FOLLOWED = 0.5
"""Share of the largest of an effect's numbers that each may be off, for the states follow it; ours."""
APART = 1.0
"""s between two readings of such a filter that are taken. From row to row it says what gyros and
accelerometers say; with all its readings inertias were 15 to 20 % too large on three clean
**synthetic** flights and six channels coloured, with one in 0.3 s or 1 s neither; ours."""


class Turns(NamedTuple):
    """Of one angle: differences of how far it turned, by its own readings and by the gyros', and the
    variance that the gyros' noise has in the latter."""

    read: np.ndarray
    carried: np.ndarray
    noise: float


def of_onboard_filter(runs: Iterable[Run]) -> bool:
    """Whether attitudes have the noise of the gyros.

    Args:
        runs: as logged.
    """
    timed = [run for run in runs if run.measured.keys() >= {*GYROS, *ANGLES}]
    even = [replace(run, t=_even(run.t)) for run in timed]  # where times were logged wrong
    return any(
        all(_has_noise([_turns(run, angle, begin, end) for run in own]) for angle in ANGLES)
        for own in (timed, even)
        for begin, end in ((1.0, 0.0), (0.0, 1.0), (0.5, 0.5))
    )


def _even(t: np.ndarray) -> np.ndarray:
    """Times of as many rows on an even clock."""
    return float(np.median(np.diff(t))) * np.arange(t.size)


def _has_noise(turns: Sequence[Turns | None]) -> bool:
    """Whether an angle has the gyros' noise: the share of it that is in both is nearly all."""
    known = [own for own in turns if own is not None and own.noise > 0.0]
    count = sum(own.read.size for own in known)
    if count < FEWEST:
        return False
    read, carried = (
        np.concatenate([getattr(own, which) / math.sqrt(own.noise) for own in known])
        for which in ("read", "carried")
    )
    share = 1.0 - float(carried @ (carried - read)) / count
    scatter = math.sqrt(float(read @ read) * float(carried @ carried)) / count**1.5
    return SHARES[0] < share < SHARES[1] + LIKELY * scatter and share > CERTAIN * scatter


def _turns(run: Run, angle: str, begin: float, end: float) -> Turns | None:
    """Turns of one angle between its readings.

    Args:
        run: as logged. angle: one of ANGLES.
        begin, end: weights of the gyro's readings as a row begins and ends, with which a filter
            carries its angle over the row.
    """
    if min(np.isfinite(run.measured[c]).sum() for c in (*GYROS, *ANGLES)) < FEWEST // 2:
        return None
    rows = np.flatnonzero(np.isfinite(run.measured[angle]))
    rate = _rate(run, angle)
    steps = np.diff(run.t)
    turned = np.append(0.0, np.cumsum((begin * rate[:-1] + end * rate[1:]) * steps))
    between = np.diff(rows)
    usual = int(np.median(between))
    read = np.diff(np.unwrap(run.measured[angle][rows]))
    carried = np.diff(turned[rows])
    whole = np.convolve(between == usual, np.ones(ORDER + 1), "valid") == ORDER + 1
    if not whole.any():
        return None
    weights = np.append(np.full(usual, begin), 0.0) + np.append(0.0, np.full(usual, end))
    for _ in range(ORDER):
        apart = np.zeros(usual)
        weights = np.append(apart, weights) - np.append(weights, apart)
    row = float(np.median(steps))
    noise = row**2 * _noise(run.measured[GYROS[ANGLES.index(angle)]]) * float(weights @ weights)
    read, carried = (np.diff(x, ORDER)[whole] for x in (read, carried))
    off = np.abs(read - carried)
    rounding = float(np.diff(np.unique(run.measured[angle][rows])).min(initial=math.inf))
    sound = off < 8.0 * np.median(off) + 0.5 * rounding * 2.0 ** (ORDER + 1) + 1e-12
    return Turns(read[sound], carried[sound], noise)


def _rate(run: Run, angle: str) -> np.ndarray:
    """How fast an angle turns by the gyros, (n,) [rad/s]."""
    *gyros, phi, theta = (_filled(run, c) for c in (*GYROS, "phi", "theta"))
    return euler_rates(gyros, phi, theta)[ANGLES.index(angle)]


def _filled(run: Run, channel: str) -> np.ndarray:
    values = run.measured[channel]
    there = np.isfinite(values)
    return np.interp(run.t, run.t[there], values[there])


def _noise(readings: np.ndarray) -> float:
    """Variance of the noise of a gyro, of which differences from row to row are nearly all."""
    differences = np.diff(readings, OF_NOISE)
    differences = differences[np.isfinite(differences)]
    if differences.size < FEWEST:
        return 0.0
    spread = 1.4826 * float(np.median(np.abs(differences)))  # outliers apart
    return spread**2 / math.comb(2 * OF_NOISE, OF_NOISE)


def read_seldom(records: Sequence[Record], channels: Sequence[str]) -> list[Record]:
    """Records with readings of MOTION that are APART at least.

    Args:
        records: as logged. channels: of their columns.
    """
    found = []
    for record in records:
        z = record.z.copy()
        for channel in MOTION:
            column, last = z[:, channels.index(channel)], -math.inf
            for row in np.flatnonzero(np.isfinite(column)).tolist():
                if record.t[row] < last + APART - 1e-6:
                    column[row] = math.nan
                else:
                    last = float(record.t[row])
        found.append(replace(record, z=z))
    return found


def remark() -> str:
    """That attitudes are an onboard filter's, for who reads the findings."""
    return (
        "the logged attitudes have the noise of the logged gyros in them: an onboard filter's."
        f" They, velocities, height and position are read once in {seconds(APART)}, and what is wrong"
        " with the sensors that carry them is known to a half"
    )


def followed(problem: Problem, fit: Fit) -> dict[str, float]:
    """How far the numbers of sensors' effects may be off, whose error such a filter's states follow.

    Args:
        problem, fit: with the causes.
    """
    apart: dict[str, float] = {}
    for effect in CIRCULAR.intersection(fit.active):
        names = problem.acting_names(effect)
        largest = max((abs(fit.values[name]) for name in names), default=0.0)
        apart |= dict.fromkeys(names, FOLLOWED * largest)
    return apart
