"""Readings that were computed from the logged poses: velocities and rates by differences of them.

Motion captures come without gyros, and who prepares their logs writes velocities and rates beside the
poses, by differences, a Savitzky-Golay filter or a low-pass. They hold the poses' noise and nothing
new, and an estimator that takes them for sensors of their own counts it twice. One **synthetic** flight
with such columns, a servo's deadband hidden, took 583 s of diagnosis for 29 and left twelve channels
unexplained; behind a low-pass of 20 Hz it named a play.

It shows in the log alone. The weights by which slopes of a pose, REACH on either side, make the other
reading are fitted to second differences of both, of which noise is nearly all. Of a sensor of its own
they leave its noise, and the pose's in what they make of it on top. Of a reading that was computed they
leave less than that, with the log's times or as though its rows were even, as many filters take them.

An onboard filter carries its attitudes by the gyros, noise and all, which is another matter
(diagnosis/onboard_filter.py): its poses are integrals of noise, twice as dense in the middle of their
band as at the top, where a motion capture's noise is flat.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from coax_env.logs.frames import euler_rates
from coax_env.logs.repairs import Repaired
from coax_env.logs.smoothed import LOST, densities, pieces_of, steepness
from coax_env.model.layout import ANGLES, GYROS
from coax_env.plain_words import and_list

REACH = 16
"""Slopes on either side: a Savitzky-Golay filter over 33 readings, a first-order low-pass of 5 Hz at
100 Hz but for a hundredth; ours."""
FEWEST = 10
"""Times as many second differences as weights that are enough; ours."""
MOST = 6000
"""Readings of a run that are asked, its first: a minute at 100 Hz; ours."""
OWN = 0.4
"""Of the pose's noise in what the weights make of it, that a sensor of its own leaves more than; ours.
Computed readings leave 0 to 0.24, sensors of their own 2.8 to 470 (**synthetic**), an onboard filter's
velocities 0.8."""
FLAT = 1.5
"""Times as dense in the middle of the band as at the top, up to which a pose's noise is its own. An
integral of white noise has 1.9; **synthetic** motion captures 0.9 to 1.2, headings of the real first
CoaX 1.2; ours."""
FAR = 6.0
"""Times its usual size from which what is left in a row is an outlier's; ours."""
JUMPS = 30.0
"""Times the median change of slope from which a reading of the pose is none of its motion or noise, of
which the largest of a million has 8; ours."""

OF_POSITION: Mapping[str, str] = {"vn": "pn", "ve": "pe", "vd": "h"}
"""Velocity -> the reading whose slope it may be, up to the sign."""


class Compared(NamedTuple):
    """Second differences of a reading, (n,), and of slopes of a pose around it, (n, 2 REACH).

    stride: readings of the pose from one reading to the next.
    """

    reading: np.ndarray
    slopes: np.ndarray
    stride: int


def without_derived(
    runs: Sequence[Repaired], counts: Counter[str], holds: Mapping[str, bool]
) -> list[Repaired]:
    """Runs without readings that were computed from their poses.

    Args:
        runs: of one flight, with times as logged.
        counts: what was repaired -> how often; what is left out is added.
        holds: channel -> what the card says; one each of whose values is a reading stays.
    """
    found = {c: pose for c, pose in derived(runs).items() if holds.get(c) is not False}
    for poses, words in ((tuple(OF_POSITION.values()), "positions"), (ANGLES, "attitudes")):
        gone = [channel for channel, pose in found.items() if pose in poses]
        if gone:
            own = (run.measured[c] for run in runs for c in gone if c in run.measured)
            number = sum(int(np.isfinite(values).sum()) for values in own)
            counts[f"{and_list(gone)} computed from the logged {words}, left out"] += number
    return [
        replace(run, measured={c: own for c, own in run.measured.items() if c not in found})
        for run in runs
    ]


def derived(runs: Sequence[Repaired]) -> dict[str, str]:
    """Channels that were computed from a pose, and from which.

    Args:
        runs: of one flight, with times as logged.
    """
    found = {}
    for channel, pose in OF_POSITION.items():
        own = [(run, run.measured[channel]) for run in runs if channel in run.measured]
        if _is_computed(own, pose):
            found[channel] = pose
    turning = [run for run in runs if run.measured.keys() >= {*GYROS, *ANGLES}]
    rates = [
        euler_rates([run.measured[c] for c in GYROS], run.measured["phi"], run.measured["theta"])
        for run in turning
    ]
    if all(
        _is_computed([(run, own[k]) for run, own in zip(turning, rates, strict=True)], angle)
        for k, angle in enumerate(ANGLES)
    ):
        found |= dict(zip(GYROS, ANGLES, strict=True))
    flat = any(steepness(pieces_of(runs, pose)[0], 1) < FLAT for pose in found.values())
    return found if flat else {}


def _is_computed(readings: Sequence[tuple[Repaired, np.ndarray]], pose: str) -> bool:
    """Whether weighted slopes of a pose leave less of a reading than a sensor of its own would.

    Args:
        readings: runs, and (n,) of the reading in each. pose: channel.
    """
    pieces, step = pieces_of([run for run, _ in readings], pose)
    noise = densities(pieces, 1)[1] / (2.0 * math.log(2.0))  # variance of a reading's
    return any(_left(readings, pose, step, as_even) < OWN * noise for as_even in (False, True))


def _left(
    readings: Sequence[tuple[Repaired, np.ndarray]], pose: str, step: float, as_even: bool
) -> float:
    """Variance that the likeliest weights leave, of a reading of the pose in what they make of it.

    Args:
        readings: runs, and (n,) of the reading in each. pose: channel. step: between its readings [s].
        as_even: whether times are taken as even.
    """
    asked = (_compared(run, reading, pose, as_even) for run, reading in readings)
    known = [own for own in asked if own is not None]
    if sum(own.reading.size for own in known) < FEWEST * 2 * REACH:
        return math.inf
    y, x = (np.concatenate([getattr(own, name) for own in known]) for name in ("reading", "slopes"))
    weights = np.linalg.lstsq(x, y)[0]
    left = np.abs(y - x @ weights)
    sound = left <= FAR * 1.4826 * np.median(left)
    weights = np.linalg.lstsq(x[sound], y[sound])[0]
    left = y[sound] - x[sound] @ weights
    of_readings = (np.append(0.0, weights) - np.append(weights, 0.0)) / step
    second = np.zeros(2 * known[0].stride + 1)
    second[[0, known[0].stride, -1]] = 1.0, -2.0, 1.0
    gained = float(np.sum(np.convolve(of_readings, second) ** 2))
    return float(np.mean(left**2)) / gained if gained > 0.0 else math.inf


def _compared(run: Repaired, reading: np.ndarray, pose: str, as_even: bool) -> Compared | None:
    """A reading beside slopes of a pose, where no reading of the pose is missing around it.

    Args:
        run: with times. reading: (n,). pose: channel. as_even: whether times are taken as even.
    """
    rows = np.flatnonzero(np.isfinite(run.measured.get(pose, np.empty(0))))[:MOST]
    if rows.size < 2 * REACH + 2:
        return None
    at, step = run.measured[pose][rows], np.diff(run.t[rows])
    usual = float(np.median(step))
    slopes = np.diff(np.unwrap(at) if pose in ANGLES else at) / (usual if as_even else step)
    bends = np.abs(np.diff(slopes))
    jumped = np.flatnonzero(bends > JUMPS * np.median(bends))  # set anew, or an outlier
    slopes[step > LOST * usual] = np.nan
    slopes[jumped] = slopes[jumped + 1] = np.nan
    around = sliding_window_view(slopes, 2 * REACH)
    there = reading[rows[REACH : REACH + around.shape[0]]]
    usable = np.flatnonzero(np.isfinite(there) & np.isfinite(around).all(axis=1))
    if usable.size < 3:
        return None
    apart = np.diff(usable)
    stride = int(np.median(apart))
    even = np.flatnonzero((apart[1:] == stride) & (apart[:-1] == stride)) + 1
    middle = usable[even]
    before, after = middle - stride, middle + stride
    return Compared(
        there[before] - 2.0 * there[middle] + there[after],
        around[before] - 2.0 * around[middle] + around[after],
        stride,
    )
