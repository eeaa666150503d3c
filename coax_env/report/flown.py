"""What every report shows of a flight: its data, and predictions against measurements."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from coax_env.estimation.prediction import RunReplay
from coax_env.logs.flight import Flight, Run
from coax_env.model.layout import ANGLES, CHANNEL_UNITS, CHANNELS
from coax_env.plain_words import channel_name, number, unit_name
from coax_env.report import figures
from coax_env.report.page import bullets, details, prose, table

POINTS_PER_PAGE = 30_000
"""Readings shown on one page, all its figures together."""

_FIRST = ("h", "phi", "theta", "psi", "pn", "pe", "vn", "ve", "vd", "v", "p", "q", "r")


def ordered(channels: Iterable[str]) -> list[str]:
    """Channels from what a pilot sees first; the rest in the contract's order."""
    have = set(channels)
    return [c for c in (*_FIRST, *(c for c in CHANNELS if c not in _FIRST)) if c in have]


def prediction_figure(
    flight: Flight,
    run: str,
    channel: str,
    replays: Mapping[str, RunReplay | None],
    noise: float | None,
    points: int = figures.MOST_POINTS,
) -> figures.Figure:
    """One channel of one run, measured and as each model expects it.

    Args:
        replays: model's name -> the run flown again by it; None where it was not.
        noise: std of the reading. points: at most so many per curve, see `points_each`.
    """
    logged = _logged(flight, run)
    times = np.concatenate([r.channels[channel].t for r in replays.values() if r is not None])
    times = times[np.isfinite(times)]
    near = np.ones(len(logged.t), bool)
    if times.size:  # a run held out in part is shown in part
        near = (logged.t >= times.min() - 2.0) & (logged.t <= times.max() + 1.0)
    t = logged.t[near]
    measured = logged.measured.get(channel, np.full(len(logged.t), np.nan))[near].copy()
    good = np.isfinite(measured)
    if channel in ANGLES:
        measured[good] = np.unwrap(measured[good])
    lines = {}
    for name, replay in replays.items():
        if replay is None or channel not in replay.channels:
            continue
        flown = replay.channels[channel]
        there = np.isfinite(flown.t) & np.isfinite(flown.error)
        at, error = flown.t[there], flown.error[there]
        predicted = flown.predicted[there]
        if channel in ANGLES and good.any():
            predicted = np.interp(at, t[good], measured[good]) + error
        inside = _near(error, measured[good])
        lines[name] = at, np.where(inside, predicted, np.nan), np.where(inside, error, np.nan)
    return figures.prediction(channel, (t, measured), lines, noise, points)


def points_each(count: int) -> int:
    """Points per curve where a page has so many figures and is to stay under 6 MB."""
    return max(120, min(figures.MOST_POINTS, POINTS_PER_PAGE // max(count, 1)))


def _logged(flight: Flight, run: str) -> Run:
    """The run of that name, or the one of which a part was held out."""
    for logged in flight.runs:
        if run == logged.name or run.startswith(f"{logged.name} ("):
            return logged
    return flight.run(run)


def _near(error: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Which errors to show: one start that runs away must not hide the others."""
    if not error.size:
        return np.ones(0, bool)
    span = float(np.ptp(measured)) if measured.size else 0.0
    return np.abs(error) <= max(2.0 * span, 5.0 * float(np.median(np.abs(error))))


def data_blocks(
    flight: Flight, remarks: Sequence[str] = (), noise: Mapping[str, float] | None = None
) -> list[str]:
    """How the data were handled, and what there was.

    Args:
        remarks: instead of the flight's own notes.
        noise: estimated std by channel; the card's where absent.
    """
    notes = list(remarks or flight.notes) or ["Nothing had to be mended while reading."]
    rows = [
        [
            run.name,
            run.maneuver or "–",
            f"{run.duration:.1f} s",
            str(len(run.t)),
            str(sum(bool(np.isfinite(v).any()) for v in run.measured.values())),
        ]
        for run in flight.runs
    ]
    stds = noise or flight.noise
    levels = [
        [
            channel_name(c),
            f"{number(stds[c])} {unit_name(CHANNEL_UNITS[c])}",
            "the card" if c in flight.noise else "estimated",
        ]
        for c in ordered(stds)
        if c in flight.channels
    ]
    return [
        bullets(notes),
        details("The runs", table(["run", "maneuver", "time", "rows", "channels"], rows)),
        details("Sensor noise", table(["channel", "std", "from"], levels))
        if levels
        else prose("The card gives no sensor noise."),
    ]
