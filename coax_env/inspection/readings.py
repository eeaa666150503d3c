"""Runs and channels of a flight: rates, gaps, frozen and saturated sensors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coax_env.design.discrimination import logged_rates
from coax_env.estimation.helicopter_noise import sensor_std
from coax_env.logs.flight import Flight, Run
from coax_env.logs.repairs import GAP
from coax_env.model.layout import CHANNEL_UNITS

FROZEN = 1.0  # [s] for which a channel may read one and the same value
QUIETEST = dict.fromkeys(("pn", "pe", "h"), 5e-5) | dict.fromkeys(("vn", "ve", "vd"), 2e-4)
"""Noise [m, m/s] below which no sensor of a place or a velocity is: motion capture has 1e-4 m; ours."""
SATURATED = 0.005
"""Share of the readings that may stand at one extreme value."""


@dataclass(frozen=True)
class RunCheck:
    """One run. rate: rows a second. gaps: longer than GAP without a row."""

    name: str
    seconds: float
    rows: int
    rate: float
    gaps: int
    channels: tuple[str, ...]


@dataclass(frozen=True)
class ChannelCheck:
    """One channel over the runs that have it.

    rate: readings a second. std: of its noise, the card's or from its scatter. longest_gap: s without
    a reading. frozen: longest time with one and the same reading [s], 0 where that is nothing unusual.
    saturated: readings at one extreme value.
    """

    channel: str
    unit: str
    runs: int
    rate: float
    std: float
    longest_gap: float
    frozen: float
    saturated: int


def run_check(run: Run) -> RunCheck:
    """Rows, rate and gaps of one run."""
    steps = np.diff(run.t)
    return RunCheck(
        run.name, run.duration, run.t.size, (run.t.size - 1) / run.duration,
        int(np.count_nonzero(steps > GAP)), tuple(run.measured),
    )  # fmt: skip


def channel_checks(flight: Flight) -> tuple[ChannelCheck, ...]:
    """Every channel over the runs that have it."""
    rates = logged_rates(flight)
    return tuple(_channel(flight, c, rates[c]) for c in flight.channels)


def _channel(flight: Flight, channel: str, rate: float) -> ChannelCheck:
    runs = [run for run in flight.runs if channel in run.measured]
    std = sensor_std(flight, channel)
    gap = frozen = 0.0
    everything = []
    for run in runs:
        values = run.measured[channel]
        given = np.isfinite(values)
        t, y = run.t[given], values[given]
        if y.size:
            gap = max(gap, float(np.diff(np.concatenate([run.t[:1], t, run.t[-1:]])).max()))
            frozen = max(frozen, _longest_constant(t, y))
            everything.append(y)
        else:
            gap = max(gap, run.duration)
    y = np.concatenate(everything) if everything else np.empty(0)
    return ChannelCheck(
        channel, CHANNEL_UNITS[channel], len(runs), rate, std, gap,
        frozen if frozen > FROZEN and std > 0.0 else 0.0, _saturated(y),
    )  # fmt: skip


def _longest_constant(t: np.ndarray, y: np.ndarray) -> float:
    """Longest time [s] through which a reading does not change at all."""
    changes = np.flatnonzero(np.diff(y) != 0.0)
    starts = np.concatenate([[0], changes + 1])
    ends = np.concatenate([changes, [y.size - 1]])
    return float((t[ends] - t[starts]).max())


def _saturated(y: np.ndarray) -> int:
    """Readings at the greatest or the least value, where these are too many for chance."""
    if np.unique(y).size < 50:  # a coarse sensor meets any of its values often
        return 0
    counts = [int(np.count_nonzero(y == extreme)) for extreme in (y.max(), y.min())]
    return max((c for c in counts if c > max(5.0, SATURATED * y.size)), default=0)


def sensor_faults(channels: Sequence[ChannelCheck]) -> list[str]:
    """Sensors that stood still or at their limit, or are none, in words."""
    found = [
        f"{c.channel} has hardly any noise ({c.std:.1g} {c.unit}): what an estimator made of other"
        f" sensors, and no reading? leave it out (import_log --leave {c.channel}, or rename its column)"
        for c in channels
        if 0.0 < c.std < QUIETEST.get(c.channel, 0.0)
    ]
    found += [
        f"{c.channel} reads one and the same value for {c.frozen:.1f} s: a frozen sensor? leave its"
        " cells empty there"
        for c in channels
        if c.frozen
    ]
    return found + [
        f"{c.channel} stands at its extreme value in {c.saturated} readings: saturated? leave those"
        " cells empty"
        for c in channels
        if c.saturated
    ]
