"""Logs of signals with clocks of their own - PX4's, ArduPilot's, ROS bags, MCAP - as flights.

Data flow::

    log -> signals, "topic.field" -> (t, values)         ulog.py, dataflash.py, ros.py
        -> channels: the autopilot's own and what the caller takes from it       signals.py
        -> one row per IMU reading, thinned to at most ROWS a second -> Flight
"""

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from coax_env.errors import InputError
from coax_env.logs import dataflash, ros, ulog
from coax_env.logs.flight import Flight, Run
from coax_env.logs.repairs import LONGEST_RUN, SHORTEST_RUN, hold_last
from coax_env.logs.signals import COMMANDS, Signal, Taken, channels_of
from coax_env.logs.units import BATTERY, SWASH_COMMANDS, without
from coax_env.model.layout import CHANNELS, RPM_PER_RAD_S

ROWS = 100.0
"""Most rows of a run per second."""

Reader = Callable[[Path], dict[str, Signal]]
READERS: dict[str, tuple[Reader, dict[str, tuple[str, ...]]]] = {
    ".ulg": (ulog.px4_signals, ulog.CHANNEL_SIGNALS),
    ".bin": (dataflash.ardupilot_signals, dataflash.CHANNEL_SIGNALS),
    ".log": (dataflash.ardupilot_signals, dataflash.CHANNEL_SIGNALS),
    ".bag": (ros.ros_signals, ros.CHANNEL_SIGNALS),
    ".db3": (ros.ros_signals, ros.CHANNEL_SIGNALS),
    ".mcap": (ros.ros_signals, ros.CHANNEL_SIGNALS),
    "": (ros.ros_signals, ros.CHANNEL_SIGNALS),
}
"""How a log's name ends -> what reads it, and which of its signals are a flight's channels.

A folder is a ROS 2 bag, whatever its name."""


def import_log(
    path: str | Path,
    vehicle: str,
    take: Mapping[str, Taken] | None = None,
    cuts: Sequence[tuple[float, float]] = (),
    leave: Collection[str] = (),
) -> Flight:
    """A flight from a log of signals.

    Args:
        path: ``.ulg`` (PX4), ``.bin`` or ``.log`` (ArduPilot), ``.bag``, ``.db3`` or the folder of
        a bag
            (ROS), or ``.mcap``.
        vehicle: shipped name or file.
        take: channel -> where it comes from, for what the autopilot cannot know or is to be read
            otherwise.
        cuts: begin and end of each run, seconds of the log; none: the whole log.
        leave: channels that are not taken: an estimator's output is no reading.

    Raises:
        InputError: no such log, no rotor speeds in it, or a signal or channel that does not exist.
    """
    path = Path(path)
    signals = signals_of(path)
    _, table = _reader(path)
    channels = channels_of(signals, table, take or {}, path)
    for name in leave:
        if name not in CHANNELS or name not in channels:
            raise InputError(
                f"{path}: no channel {name!r} to leave; there are {', '.join(channels)}"
            )
        del channels[name]
    begin = min(t[0] for t, _ in channels.values())
    channels = {name: (t - begin, values) for name, (t, values) in channels.items()}
    end = max(t[-1] for t, _ in channels.values())
    if not end < LONGEST_RUN:
        raise InputError(f"{path}: its time stamps run over {end:.3g} s, which no flight lasts")
    runs = []
    for k, (start, stop) in enumerate(cuts or [(0.0, end)], 1):
        runs.append(_run(f"run_{k}" if cuts else path.stem, channels, start, min(stop, end), path))
    missing = [c for c in SWASH_COMMANDS if c not in channels]
    return Flight(vehicle, tuple(runs), counts={without(c): len(runs) for c in missing})


def signals_of(path: Path) -> dict[str, Signal]:
    """Every signal of a log, ``topic.field``.

    Raises:
        InputError: no such log.
    """
    read, _ = _reader(path)
    with _silence():
        return read(path)


def _reader(path: Path) -> tuple[Reader, dict[str, tuple[str, ...]]]:
    if not path.exists():
        raise InputError(f"no log at {path}")
    if path.is_dir():
        if not (path / "metadata.yaml").exists():
            raise InputError(f"{path}: a folder, and no ROS 2 bag: no metadata.yaml in it")
        return READERS[""]
    ending = path.suffix.lower()
    if not ending or ending not in READERS:
        known = ", ".join(filter(None, READERS))
        raise InputError(f"{path}: a log ends in {known}, found {path.suffix!r}")
    return READERS[ending]


def _run(name: str, channels: Mapping[str, Signal], start: float, stop: float, path: Path) -> Run:
    """The part of a log from `start` to `stop` [s], on the rows of its fastest sensor, thinned to ROWS.

    A row's reading is the mean of what came since the row before (angles: the last of it).
    """
    if stop - start < SHORTEST_RUN:
        raise InputError(
            f"{path}: a run from {start:g} to {stop:g} s is shorter than {SHORTEST_RUN:g} s"
        )
    clock = channels.get("p") or channels.get("ax") or channels["phi"]
    step = max(1.0 / ROWS, float(np.median(np.diff(clock[0]))))  # whatever its gaps
    t = start + step * np.arange(int((stop - start) / step) + 1)
    measured = {}
    for channel in CHANNELS:
        if channel in channels:
            column = _binned(channels[channel], t, step, last=channel in ("phi", "theta", "psi"))
            if np.isfinite(column).any():
                measured[channel] = column
    command = np.zeros((len(t), 4))
    for k, name_of in enumerate(COMMANDS):
        source = channels.get(name_of) or channels.get(name_of.removesuffix("_cmd"))
        if source is None:
            continue
        values = _held(source, t)
        if not np.isfinite(values).any():
            raise InputError(f"{path}: no number among the values of {name_of} in run {name!r}")
        command[:, k] = hold_last(values)
    command[:, :2] /= RPM_PER_RAD_S
    battery = _held(channels[BATTERY], t) if BATTERY in channels else None
    if battery is not None and not np.isfinite(battery).all():
        battery = hold_last(battery) if np.isfinite(battery).any() else None
    note = f"from {path.name}"
    return Run(name, t - t[0], command, measured, "imported", note, battery=battery)


def _held(signal: Signal, t: np.ndarray) -> np.ndarray:
    """Values of a signal at times t (n,) [s]: each holds until the next."""
    times, values = signal
    return values[np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)]


def _binned(signal: Signal, t: np.ndarray, step: float, last: bool) -> np.ndarray:
    """Readings of a signal row by row (n,), NaN where none came."""
    times, values = signal
    good = np.isfinite(values)
    row = np.ceil((times[good] - t[0]) / step - 1e-9).astype(int)
    inside = (row >= 0) & (row < len(t))
    row, values = row[inside], values[good][inside]
    column = np.full(len(t), np.nan)
    if last:
        column[row] = values
        return column
    count = np.bincount(row, minlength=len(t))
    total = np.bincount(row, values, minlength=len(t))
    column[count > 0] = total[count > 0] / count[count > 0]
    return np.where(np.isfinite(column), column, np.nan)  # a sum of huge numbers is none


@contextmanager
def _silence() -> Iterator[None]:
    """Without what the readers, compiled parts included, print on stdout and stderr by themselves."""
    saved = [os.dup(stream) for stream in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        yield
    finally:
        for stream, own in zip((1, 2), saved, strict=True):
            os.dup2(own, stream)
            os.close(own)
        os.close(nowhere)
