"""What a real log brings along, repaired and counted: outliers, gaps, stalls, repeated time stamps.

Nothing is put right in silence: every repair adds to the counts, in words that `Flight.notes` shows.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from coax_env.errors import InputError
from coax_env.logs.clipped import clipped, near_an_end
from coax_env.logs.coarse import at_changes
from coax_env.logs.columns import advice, time_advice
from coax_env.logs.csv_log import BEYOND_ALL, CsvLog
from coax_env.logs.held import interpolated, repeats
from coax_env.logs.outliers import (
    are_answers,
    find_averaged_headings,
    find_leaps,
    find_miscounts,
    find_outliers,
    off_median,
)
from coax_env.logs.packets import broken_packets
from coax_env.logs.units import BATTERY, ROTOR_COMMANDS, SWASH_COMMANDS, without
from coax_env.model.layout import ANGLES, CHANNELS, ROTOR_SPEEDS, RPM_PER_RAD_S

SHORTEST_RUN = 2.0
"""A run must last this long [s]."""
LONGEST_RUN = 24 * 3600.0  # [s]
SLOWEST_ROWS = 0.5
"""A run that lasts longer, or whose rows come more seldom [s], has its time in another unit."""
GAP = 0.1
"""Time without a row, or without any reading, that counts as a gap [s]."""

STALL = 2.2
"""A step this many times the usual one is a gap, and one that many times shorter is catching up."""
CATCH_UP_ROWS = 12  # most rows in which a logger catches up after a stall

POSE = (*ANGLES, "h", "pn", "pe")
WHOLE = 0.9
"""Share of the rows with any of a pose that have all of it, where one tracker says it; ours."""


@dataclass(frozen=True)
class Repaired:
    """A run's data as a flight has them: the fields of `Run` (flight.py)."""

    t: np.ndarray
    command: np.ndarray
    measured: Mapping[str, np.ndarray]
    battery: np.ndarray | None


def repaired(
    log: CsvLog,
    noise: Mapping[str, float],
    counts: Counter[str],
    holds: Mapping[str, bool] | None = None,
) -> Repaired:
    """A log's data without what no sensor measured.

    Args:
        log: one run's CSV.
        noise: channel -> std of its sensor, in the channel's unit, where it is known.
        counts: what was repaired -> how often; this log's repairs are added.
        holds: channel -> whether its repeats are no new readings, where the card says so.

    Raises:
        InputError: time that cannot be a run's, or no rotor speed.
    """
    if log.unknown:
        counts["unknown columns ignored"] += len(log.unknown)
    if log.beyond:
        counts[f"readings beyond {BEYOND_ALL:g} dropped"] += log.beyond
    check_time(log)
    data, repeated = merge_repeated_times(log.data)
    if repeated:
        counts["rows with a repeated time stamp merged"] += repeated
    data = _without_blank_rows(data, counts)
    data = _without_broken_packets(data, counts)
    data = _without_clipped(data, counts)
    data = _without_repeats(data, holds or {}, counts)
    t = data["t"]
    measured = _without_outliers(data, noise, counts)
    stalled = beside_stalls(t)
    if stalled.any():
        counts["rows beside a stalled clock, readings left out"] += int(np.count_nonzero(stalled))
        measured = {c: np.where(stalled, np.nan, values) for c, values in measured.items()}
    command, driving = _commands(log, data, measured, counts)
    measured = {c: values for c, values in measured.items() if c not in driving}
    _count_gaps(t, measured, counts)
    return Repaired(t, command, measured, _battery(data))


# --- time ------------------------------------------------------------------------------------


def check_time(log: CsvLog) -> None:
    """Refuse a log whose time is not that of one run.

    Raises:
        InputError: a row has no time, time runs backwards, or the run is too short or too long.
    """
    t = log.data["t"]
    if np.isnan(t).any():
        line = log.lines[int(np.argmax(np.isnan(t)))]
        raise InputError(f"{log.path}, line {line}: a row without a time")
    step = np.diff(t)
    if (step < 0.0).any():
        after = int(np.argmax(step < 0.0)) + 1
        raise InputError(
            f"{log.path}, line {log.lines[after]}:"
            f" time runs backwards, from {t[after - 1]:.6g} to {t[after]:.6g} s;"
            " where a log starts anew, cut it there into two files, a [[run]] each"
        )
    length = t[-1] - t[0]
    if not length >= SHORTEST_RUN:
        raise InputError(
            f"{log.path}: the run lasts {length:.3g} s, at least {SHORTEST_RUN:g} needed"
        )
    usual = float(np.median(step))
    if length > LONGEST_RUN or usual > SLOWEST_ROWS:
        raise InputError(
            f"{log.path}: the run lasts {length:.3g} s with a row every {usual:.3g} s;"
            f" {time_advice(log.time_column, usual)}"
        )


def merge_repeated_times(data: Mapping[str, np.ndarray]) -> tuple[Mapping[str, np.ndarray], int]:
    """The same data with one row per time stamp, later readings winning; how many rows went.

    Args:
        data: channel, ``t`` among them -> (n,), NaN where there is no reading; t never falls.
    """
    rises = np.diff(data["t"]) > 0.0
    repeated = int(np.count_nonzero(~rises))
    if not repeated:
        return data, 0
    group = np.concatenate([[0], np.cumsum(rises)])
    merged = {}
    for channel, values in data.items():
        given = ~np.isnan(values)
        merged[channel] = np.full(group[-1] + 1, np.nan)
        merged[channel][group[given]] = values[given]  # numpy lets the last one win
    return merged, repeated


def beside_stalls(t: np.ndarray) -> np.ndarray:
    """Rows (n,) whose time stamp cannot be trusted: the logger stalled and then caught up.

    A stall is a gap followed by rows that come too fast: they were taken while the clock stood, so
    that their stamps are delayed by up to the gap. An even gap (lost rows) is none.
    """
    dt = np.diff(t)
    usual = float(np.median(dt))
    mask = np.zeros(t.size, bool)
    for gap in np.flatnonzero(dt > STALL * usual):
        after = dt[gap + 1 : gap + 1 + CATCH_UP_ROWS]
        if np.count_nonzero(after < usual / STALL) >= 1:
            unsure = (t > t[gap] - 2.0 * usual) & (t < t[gap + 1] + dt[gap] + 2.0 * usual)
            mask |= unsure
    return mask


def _count_gaps(t: np.ndarray, measured: Mapping[str, np.ndarray], counts: Counter[str]) -> None:
    rows = int(np.count_nonzero(np.diff(t) > GAP))
    if rows:
        counts[f"gaps of more than {GAP:g} s between rows"] += rows
    if not measured:
        counts["runs without any reading"] += 1
        return
    read = ~np.isnan(np.stack(list(measured.values()))).all(axis=0)
    silent = int(np.count_nonzero(np.diff(t[read]) > GAP)) - rows
    if silent > 0:
        counts[f"gaps of more than {GAP:g} s without any reading"] += silent


# --- rows and cells that say nothing ---------------------------------------------------------


def _without_blank_rows(
    data: Mapping[str, np.ndarray], counts: Counter[str]
) -> Mapping[str, np.ndarray]:
    """Without rows that hold nothing but a time: a gap of the log, filled in by whoever wrote it."""
    given = [~np.isnan(values) for channel, values in data.items() if channel != "t"]
    if not given:
        return data
    blank = ~np.logical_or.reduce(given)
    if not blank.any() or blank.all():
        return data
    counts["rows with nothing but a time, left out"] += int(np.count_nonzero(blank))
    return {channel: values[~blank] for channel, values in data.items()}


def _without_broken_packets(
    data: Mapping[str, np.ndarray], counts: Counter[str]
) -> Mapping[str, np.ndarray]:
    """With holes in place of everything that came in a broken packet."""
    broken = broken_packets(data)
    if not broken.any():
        return data
    counts["rows of broken packets, nothing in them believed"] += int(np.count_nonzero(broken))
    return {
        c: values if c == "t" else np.where(broken, np.nan, values) for c, values in data.items()
    }


def _without_clipped(
    data: Mapping[str, np.ndarray], counts: Counter[str]
) -> Mapping[str, np.ndarray]:
    """With holes where a sensor reads an end of its range, or would near it."""
    found = dict(data)
    for channel in CHANNELS:
        if channel in data and (ends := clipped(data[channel])).any():
            near = near_an_end(data[channel], ends)
            told = f"readings of {channel} at an end of its range or near it, left out"
            counts[told] += int(near.sum())
            found[channel] = np.where(near, np.nan, data[channel])
    return found


def _without_repeats(
    data: Mapping[str, np.ndarray], holds: Mapping[str, bool], counts: Counter[str]
) -> Mapping[str, np.ndarray]:
    """With holes where a sensor's last reading was written again, or a line was drawn to the next."""
    found = dict(data)
    for channel in CHANNELS:
        if channel in data:
            again = repeats(data[channel], holds.get(channel), data["t"])
            if again.any():
                counts[f"held samples of {channel}, no new readings"] += int(again.sum())
                found[channel] = np.where(again, np.nan, data[channel])
            if holds.get(channel) is False:
                continue
            values = found[channel]
            between = interpolated(data["t"], values, channel in ANGLES)
            if between.any():
                counts[f"interpolated samples of {channel}, no readings"] += int(between.sum())
                found[channel] = np.where(between, np.nan, values)
            changes = at_changes(found[channel], data.get(f"{channel}_cmd"))
            if changes is not None:
                counts[f"readings of {channel} in coarse steps, of use as they change"] += int(
                    np.isfinite(changes).sum()
                )
                found[channel] = changes
    return found


# --- readings and commands -------------------------------------------------------------------


def _without_outliers(
    data: Mapping[str, np.ndarray], noise: Mapping[str, float], counts: Counter[str]
) -> dict[str, np.ndarray]:
    """Channels with any reading, NaN in place of outliers."""
    measured, flagged = {}, {}
    for channel in CHANNELS:
        values = data.get(channel)
        if values is None:
            continue
        if np.isnan(values).all():
            counts[f"empty columns {channel} dropped"] += 1
            continue
        if channel in ROTOR_SPEEDS and (miscounted := _miscounted(channel, data)).any():
            told = f"readings of {channel} at half or twice its speed, left out"
            counts[told] += int(miscounted.sum())
            values = np.where(miscounted, np.nan, values)
        if channel == "psi" and (averaged := find_averaged_headings(data["t"], values)).any():
            counts["headings averaged across half a turn, left out"] += int(averaged.sum())
            values = np.where(averaged, np.nan, values)
        outlier = find_outliers(channel, values, noise.get(channel))
        outlier |= find_leaps(channel, data["t"], values)
        if outlier.any():
            flagged[channel] = outlier
        measured[channel] = values
    causes = _off_medians(data) if flagged else {}
    for channel, outlier in flagged.items():
        others = [cause for name, cause in causes.items() if name != channel]
        outlier &= ~are_answers(channel, measured[channel], others, outlier)
        if outlier.any():
            counts[f"outliers in {channel} removed"] += int(np.count_nonzero(outlier))
    if flagged.keys() & set(POSE) and _comes_whole(measured):
        wrong: np.ndarray = np.any([flagged[c] for c in POSE if c in flagged], axis=0)
        if wrong.any():
            counts["poses of a tracker left out whole for an outlier in them"] += int(wrong.sum())
        flagged |= dict.fromkeys(POSE, wrong)
    for channel, outlier in flagged.items():
        measured[channel] = np.where(outlier, np.nan, measured[channel])
    return measured


def _miscounted(channel: str, data: Mapping[str, np.ndarray]) -> np.ndarray:
    """Where a rotor's speed is half or twice what it is, by its command; nowhere without one."""
    command = data.get(f"{channel}_cmd")
    if command is None or np.isnan(command).all():
        return np.zeros(data[channel].size, bool)
    return find_miscounts(data[channel], hold_last(command))


def _comes_whole(measured: Mapping[str, np.ndarray]) -> bool:
    """Whether attitudes, height and position are read in the same rows, as one tracker says them.

    A frame whose markers were mixed up is wrong in all of these, and in some by less than moves on
    their own: 4 mm that stayed in a position made a marker offset that began, 49 nats, sure, on a
    **synthetic** flight by poses alone.
    """
    if not measured.keys() >= set(POSE):
        return False
    read = np.array([~np.isnan(measured[channel]) for channel in POSE])
    return bool(read.all(axis=0).sum() >= WHOLE * read.any(axis=0).sum())


def _off_medians(data: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """How far commands and measured rotor speeds are off their running medians, (n,) each."""
    return {
        name: off_median(hold_last(data[name]))
        for name in (*ROTOR_COMMANDS, *SWASH_COMMANDS, *ROTOR_SPEEDS)
        if name in data and not np.isnan(data[name]).all()
    }


def _commands(
    log: CsvLog,
    data: Mapping[str, np.ndarray],
    measured: Mapping[str, np.ndarray],
    counts: Counter[str],
) -> tuple[np.ndarray, set[str]]:
    """(n, 4) commands [rad/s, rad/s, rad, rad], and the channels that stand in for one.

    Where a rotor's command was not logged its measured speed drives the model, and is no reading.
    """
    columns, driving = [], set()
    for name, stand_in in zip(ROTOR_COMMANDS, ROTOR_SPEEDS, strict=True):
        speed = data.get(name)
        if speed is None or np.isnan(speed).all():
            if stand_in not in measured:
                raise InputError(
                    f"{log.path}: no rotor speed: neither {name} nor {stand_in};"
                    f" {advice(log.header, (name, stand_in))}"
                )
            speed = measured[stand_in]
            driving.add(stand_in)
            counts[f"runs in which measured {stand_in} stands for the command"] += 1
        negative = int(np.count_nonzero(speed < 0.0))
        if negative:
            counts[f"negative {name} clipped at 0"] += negative
        columns.append(np.maximum(hold_last(speed), 0.0) / RPM_PER_RAD_S)
    for name in SWASH_COMMANDS:
        tilt = data.get(name)
        if tilt is None or np.isnan(tilt).all():
            counts[without(name)] += 1
            tilt = np.zeros(len(data["t"]))
        columns.append(hold_last(tilt))
    return np.column_stack(columns), driving


def _battery(data: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Battery voltage (n,) [V], the last sample held; None where none was logged."""
    voltage = data.get(BATTERY)
    if voltage is None or np.isnan(voltage).all():
        return None
    return hold_last(voltage)


def hold_last(values: np.ndarray) -> np.ndarray:
    """(n,) of finite numbers: each hole takes the one before it, leading holes the first one given."""
    given = np.isfinite(values)
    first = int(np.argmax(given))
    index = np.maximum.accumulate(np.where(given, np.arange(len(values)), first))
    return values[index]
