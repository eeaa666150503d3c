"""What reports show of a flight: its data, and predictions against measurements."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.estimation.prediction import RunReplay
from coax_env.logs.flight import Flight, Run
from coax_env.model.layout import ANGLES, CHANNEL_UNITS, CHANNELS
from coax_env.plain_words import channel_name, read_factor, with_unit
from coax_env.report import figures
from coax_env.report.page import bullets, details, prose, table
from coax_env.report.plot_style import MOST_POINTS, Figure

POINTS_PER_PAGE = 30_000
"""Readings shown on one page, all its figures together."""

_PILOTS_ORDER = ("h", "phi", "theta", "psi", "pn", "pe", "vn", "ve", "vd", "v", "p", "q", "r")


def ordered(channels: Iterable[str]) -> list[str]:
    """Channels in a pilot's order: height, attitude, position first; the rest as in the log."""
    have = set(channels)
    return [
        c for c in (*_PILOTS_ORDER, *(c for c in CHANNELS if c not in _PILOTS_ORDER)) if c in have
    ]


def prediction_figure(
    flight: Flight,
    run: str,
    channel: str,
    replays: Mapping[str, RunReplay | None],
    noise: float | None,
    points: int = MOST_POINTS,
) -> Figure:
    """One channel of one run, measured and as each model predicts it.

    Args:
        flight: the measurements.
        run: name of the run, or of the part of it that was held out.
        channel: its name in the log.
        replays: model's name -> the run predicted by it; None where it was not.
        noise: std of the reading, in the channel's unit.
        points: at most so many per curve, see `points_each`.
    """
    logged = _logged(flight, run)
    there = {
        name: replay.channels[channel]
        for name, replay in replays.items()
        if replay is not None and channel in replay.channels
    }
    near = _rows_near(logged.t, np.concatenate([c.t for c in there.values()]))
    t = logged.t[near]
    measured = logged.measured.get(channel, np.full(len(logged.t), np.nan))[near].copy()
    good = np.isfinite(measured)
    if channel in ANGLES:
        measured[good] = np.unwrap(measured[good])
    curves = {}
    for name, replay in there.items():
        finite = np.isfinite(replay.t) & np.isfinite(replay.error)
        at, error, predicted = replay.t[finite], replay.error[finite], replay.predicted[finite]
        if channel in ANGLES and good.any():
            predicted = np.interp(at, t[good], measured[good]) + error
        drawn = _drawn(error, measured[good])
        curves[name] = at, np.where(drawn, predicted, np.nan), np.where(drawn, error, np.nan)
    by = read_factor(CHANNEL_UNITS[channel])
    shown = {name: (at, by * values, by * error) for name, (at, values, error) in curves.items()}
    band = noise and by * noise
    return figures.prediction(channel, (t, by * measured), shown, band, points)


def _rows_near(t: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Rows of a log about the times that were predicted: a run held out in part is drawn in part."""
    predicted = predicted[np.isfinite(predicted)]
    if not predicted.size:
        return np.ones(len(t), bool)
    return (t >= predicted.min() - 2.0) & (t <= predicted.max() + 1.0)


def points_each(count: int) -> int:
    """Points per curve where a page has so many figures and must stay under 5 MB."""
    return max(120, min(MOST_POINTS, POINTS_PER_PAGE // max(count, 1)))


def _logged(flight: Flight, run: str) -> Run:
    """The run of that name, all parts of it, or the one of which a part was held out."""
    for whole in dict.fromkeys(logged.whole for logged in flight.runs):
        if run == whole or run.startswith(f"{whole} ("):
            return _joined([logged for logged in flight.runs if logged.whole == whole])
    return flight.run(run)


def _joined(parts: Sequence[Run]) -> Run:
    """The parts of a run as one."""
    if len(parts) == 1:
        return parts[0]
    channels = dict.fromkeys(c for part in parts for c in part.measured)
    missing = {part.name: np.full(part.t.size, np.nan) for part in parts}
    return replace(
        parts[0],
        t=np.concatenate([part.t for part in parts]),
        command=np.concatenate([part.command for part in parts]),
        measured={
            c: np.concatenate([part.measured.get(c, missing[part.name]) for part in parts])
            for c in channels
        },
    )


def _drawn(error: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Which errors are drawn: one start from which the model diverges must not hide the others."""
    if not error.size:
        return np.ones(0, bool)
    span = float(np.ptp(measured)) if measured.size else 0.0
    return np.abs(error) <= max(2.0 * span, 5.0 * float(np.median(np.abs(error))))


def data_blocks(
    flight: Flight, remarks: Sequence[str] = (), noise: Mapping[str, float] | None = None
) -> list[str]:
    """What the flight contains, and what was repaired while reading.

    Args:
        flight: the measurements.
        remarks: instead of the flight's own notes.
        noise: estimated std by channel, in its unit; the card's where absent.
    """
    notes = list(remarks or flight.notes) or ["No reading had to be repaired."]
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
            with_unit(stds[c], CHANNEL_UNITS[c]),
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
