"""A flight: a folder with a test card (``card.toml``) and one CSV log per run, read and written.

Bad input raises :class:`InputError`, one line naming file, line or channel. What a real log brings
along - outliers, gaps, dropouts, repeated time stamps, impossible commands - is handled, counted
and told in :attr:`Flight.notes`.
"""

import csv
import hashlib
import io
import os
import re
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from coax_env.errors import InputError, shown
from coax_env.files import read_bytes, read_text, read_toml, staged_folder, write_text
from coax_env.logs.columns import advice, header_of, time_advice
from coax_env.logs.outliers import find_outliers
from coax_env.logs.units import LOG_UNITS, ROTOR_COMMANDS, SWASH_COMMANDS, factor_to_canonical
from coax_env.model.layout import CHANNELS, RPM_PER_RAD_S

CARD = "card.toml"
SHORTEST_RUN = 2.0
"""A run must last this long [s]."""
LONGEST_RUN = 24 * 3600.0
SLOWEST_ROWS = 0.5
"""A run that lasts longer, or whose rows come more seldom [s], has its time in another unit."""
BEYOND_ALL = 1e20
"""No reading in any unit is larger; what is, is a bit error and dropped."""
GAP = 0.1
"""Time without a row, or without any reading, that counts as a gap [s]."""

STALL = 2.2
"""A step this many times the usual one is a gap, and one that many times shorter is catching up."""
CATCH_UP_ROWS = 12

AIR = ("density", "gravity")
_MEASURED_ROTOR = ("rpm_upper", "rpm_lower")


@dataclass(frozen=True)
class Run:
    """One maneuver's log on its own time stamps.

    Row k's command holds over [t_k, t_{k+1}); a reading in row k is taken at t_k.

    Attributes:
        t: (n,) time, strictly increasing [s].
        command: (n, 4) omega_u, omega_l [rad/s], delta_lon, delta_lat [rad], without holes.
        measured: channel -> (n,) readings in the contract's units, NaN where there is no new one.
    """

    name: str
    t: np.ndarray
    command: np.ndarray
    measured: Mapping[str, np.ndarray]
    maneuver: str = ""
    note: str = ""

    @property
    def duration(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.t[-1] - self.t[0])


@dataclass(frozen=True)
class Flight:
    """Runs flown by one vehicle in one air.

    Attributes:
        vehicle: name of a shipped vehicle file, or a path.
        air: what the card says instead of the vehicle file: density [kg/m3], gravity [m/s2].
        noise: channel -> std in the channel's unit; a channel not named is to be estimated.
        notes: what was done to the data while reading, in words, with counts.
        counts: the same as numbers, e.g. ``{"outliers in h": 12}``.
        hashes: file name -> SHA-256, to recognise data that was used before.
        unread: columns of the files that are no channel and were ignored.
    """

    vehicle: str
    runs: tuple[Run, ...]
    air: Mapping[str, float] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)
    path: Path | None = None
    notes: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    hashes: Mapping[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()

    @property
    def run_names(self) -> tuple[str, ...]:
        """Names of the runs, in the card's order."""
        return tuple(run.name for run in self.runs)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels measured in at least one run, in the contract's order."""
        return tuple(c for c in CHANNELS if any(c in run.measured for run in self.runs))

    def run(self, name: str) -> Run:
        """The run of that name."""
        for run in self.runs:
            if run.name == name:
                return run
        raise InputError(f"no run {name!r} in this flight; it has {', '.join(self.run_names)}")

    def select(self, names: Iterable[str]) -> "Flight":
        """The same flight with these runs only, in the flight's own order."""
        wanted = {self.run(name).name for name in names}
        return replace(self, runs=tuple(run for run in self.runs if run.name in wanted))


# --- reading ---------------------------------------------------------------------------------


def read_flight(path: str | Path) -> Flight:
    """Read a flight folder.

    Raises:
        InputError: one line naming the file and line, channel or field at fault.
    """
    folder = Path(path)
    if folder.name == CARD:
        folder = folder.parent
    _check_folder(folder)
    card = _Card(folder / CARD)
    hashes = {CARD: _hash(folder / CARD)}
    counts: Counter[str] = Counter(card.counts)
    used: set[str] = set()
    unread: dict[str, None] = {}
    runs = []
    for entry in card.runs:
        log = _Log(folder / entry["file"], card.columns)
        hashes[entry["file"]] = _hash(folder / entry["file"])
        used |= log.renamed
        unread |= dict.fromkeys(log.unknown)
        runs.append(_make_run(entry, log, card.noise, counts))
    for channel, (name, _) in card.columns.items():
        if channel not in used:
            raise InputError(
                f"{folder / CARD}: channel {channel}: no run has a column {name!r}; not read:"
                f" {', '.join(unread) or 'none'}"
            )
    return Flight(
        vehicle=card.vehicle,
        runs=tuple(runs),
        air=card.air,
        noise=card.noise,
        path=folder,
        notes=tuple(f"{what}: {count}" for what, count in counts.items()),
        counts=dict(counts),
        hashes=hashes,
        unread=tuple(unread),
    )


def _check_folder(folder: Path) -> None:
    """Refuse what is no flight folder, and say how to make one."""
    if os.path.isfile(folder):
        if folder.suffix.lower() in (".ulg", ".bin", ".log"):
            step = f"import it: scripts/import_log.py {folder}"
        else:
            step = "put it in a folder of its own, then scripts/check_flight.py FOLDER --draft"
        raise InputError(f"no flight folder at {folder}: found a file there; {step}")
    if not os.path.isdir(folder):
        raise InputError(f"no flight folder at {folder}: found nothing there")
    if not (folder / CARD).exists():
        raise InputError(
            f"cannot read {folder / CARD}: No such file or directory; a flight folder needs one:"
            f" scripts/check_flight.py {folder} --draft writes a first one for the CSVs in it"
        )


def _hash(path: Path) -> str:
    return hashlib.sha256(read_bytes(path)).hexdigest()


class _Card:
    """The flight test card, checked."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: dict[str, int] = {}
        self.table = read_toml(path)
        self.vehicle = self._text(self._section("vehicle", required=True), "name", "[vehicle]")
        self.air = self._positive_numbers("air", AIR)
        self.noise = self._positive_numbers("noise", CHANNELS)
        self.columns = self._read_columns()
        self.runs = self._read_runs()

    def _fail(self, message: str) -> InputError:
        return InputError(f"{self.path}: {message}")

    def _section(self, name: str, required: bool = False) -> dict[str, Any]:
        if required and name not in self.table:
            raise self._fail(f"no [{name}] section")
        section = self.table.get(name, {})
        if not isinstance(section, dict):
            raise self._fail(f"[{name}] should be a section, found {shown(section)}")
        return section

    def _text(self, table: dict[str, Any], key: str, where: str, default: str | None = None) -> str:
        value = table.get(key, default)
        if value is None:
            raise self._fail(f"{where} has no {key}")
        if not isinstance(value, str) or not (value.strip() or default is not None):
            raise self._fail(f"{where} {key} should be text, found {shown(value)}")
        if key != "note" and not value.isprintable():
            raise self._fail(f"{where} {key} should be one printable line, found {shown(value)}")
        return value

    def _positive_numbers(self, section: str, known: tuple[str, ...]) -> dict[str, float]:
        numbers = {}
        for key, value in self._section(section).items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise self._fail(f"[{section}] {key} should be a number, found {shown(value)}")
            if not 0.0 < value <= sys.float_info.max:
                raise self._fail(
                    f"[{section}] {key} should be positive and finite, found {shown(value)}"
                )
            if key in known:
                numbers[key] = float(value)
            else:
                self.counts[f"unknown entry {key!r} in [{section}] ignored"] = 1
        return numbers

    def _read_columns(self) -> dict[str, tuple[str, float]]:
        """channel -> its column's name in the files, and the factor to the canonical unit."""
        columns = {}
        for channel, entry in self._section("columns").items():
            if channel not in LOG_UNITS:
                raise self._fail(
                    f"[columns] unknown channel {channel!r}; channels are {', '.join(LOG_UNITS)}"
                )
            if isinstance(entry, str):
                entry = {"name": entry}
            if not isinstance(entry, dict):
                raise self._fail(
                    f"[columns] {channel} should be {{ name, unit, scale }}, found {shown(entry)}"
                )
            name = self._text(entry, "name", f"[columns] {channel}", default=channel)
            unit = self._text(entry, "unit", f"[columns] {channel}", default=LOG_UNITS[channel])
            try:
                factor = factor_to_canonical(channel, unit)
            except InputError as error:
                raise self._fail(f"[columns] {error}") from error
            columns[channel] = (name.strip(), factor * self._scale(channel, entry))
        return columns

    def _scale(self, channel: str, entry: dict[str, Any]) -> float:
        """What else the column is multiplied by: -1 turns an axis round."""
        scale = entry.get("scale", 1.0)
        number = isinstance(scale, int | float) and not isinstance(scale, bool)
        if not number or not 1e-12 < abs(scale) < 1e12:
            raise self._fail(
                f"[columns] {channel} scale should be a number, not 0, found {shown(scale)}"
            )
        return float(scale)

    def _read_runs(self) -> list[dict[str, str]]:
        entries = self.table.get("run", [])
        if not isinstance(entries, list) or not entries:
            raise self._fail("no [[run]] entry")
        runs = []
        for number, entry in enumerate(entries, 1):
            where = f"[[run]] {number}"
            if not isinstance(entry, dict):
                raise self._fail(f"{where} should be a section, found {shown(entry)}")
            file = self._text(entry, "file", where)
            runs.append(
                {
                    "file": file,
                    "name": self._text(entry, "name", where, default=Path(file).stem),
                    "maneuver": self._text(entry, "maneuver", where, default=""),
                    "note": self._text(entry, "note", where, default=""),
                }
            )
        for name, times in Counter(run["name"] for run in runs).items():
            if times > 1:
                raise self._fail(f"{times} runs are named {name!r}")
        return runs


class _Log:
    """One CSV as arrays by channel, in canonical units, NaN where a cell is empty."""

    def __init__(self, path: Path, columns: dict[str, tuple[str, float]]) -> None:
        self.path = path
        self.header, self.rows, self.lines = self._split(read_text(path))
        by_name = {name: index for index, name in enumerate(self.header) if name}
        self.renamed: set[str] = set()
        self.data: dict[str, np.ndarray] = {}
        self.beyond = 0
        self.time_column = "t"
        taken = set()
        for channel in LOG_UNITS:
            name, factor = columns.get(channel, (channel, 1.0))
            if name in by_name:
                taken.add(name)
                if channel in columns:
                    self.renamed.add(channel)
                values = self._numbers(by_name[name], name)
                if channel == "t":
                    self.time_column = name
                    self._check_times(values)
                else:
                    beyond = np.abs(values) > BEYOND_ALL
                    values[beyond] = np.nan
                    self.beyond += int(np.count_nonzero(beyond))
                self.data[channel] = factor * values
            elif channel == "t":
                raise InputError(f"{path}: no time column {name!r}; {advice(by_name, ['t'])}")
        self.unknown = [name for name in by_name if name not in taken]

    def _split(self, text: str) -> tuple[list[str], list[list[str]], list[int]]:
        """Header, rows that hold anything, and the line each row ends on."""
        first, delimiter = header_of(text)
        if any(first) and all(_is_finite_number(cell) for cell in first if cell):
            raise InputError(
                f"{self.path}, line 1: numbers, no header: the first row must name the columns"
            )
        reader = csv.reader(
            io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True
        )
        header: list[str] = []
        rows, lines = [], []
        try:
            for row in reader:
                cells = [cell.strip() for cell in row]
                if not any(cells):
                    continue
                if not header:
                    header = cells
                    continue
                if len(cells) != len(header):
                    raise InputError(
                        f"{self.path}, line {reader.line_num}: {len(cells)} cells"
                        f" where the header has {len(header)} (cells parted by {delimiter!r})"
                    )
                rows.append(cells)
                lines.append(reader.line_num)
        except csv.Error as error:
            raise InputError(f"{self.path}, line {reader.line_num}: {error}") from error
        if not header:
            raise InputError(f"{self.path}: the file is empty")
        for name, times in Counter(header).items():
            if name and times > 1:
                raise InputError(f"{self.path}: {times} columns are named {name!r}")
        if not rows:
            raise InputError(f"{self.path}: a header and no rows")
        return header, rows, lines

    def _numbers(self, column: int, name: str) -> np.ndarray:
        cells = [row[column] for row in self.rows]
        try:
            values = np.array([float(cell) if cell else np.nan for cell in cells])
            if not np.isinf(values).any() and "_" not in "".join(cells):
                return values
        except ValueError:
            pass
        bad = next(k for k, cell in enumerate(cells) if cell and not _is_finite_number(cell))
        if bad == 0 and not any(map(_is_finite_number, self.rows[0])):
            raise InputError(
                f"{self.path}, line {self.lines[0]}: {cells[0][:40]!r} and no number in the row: if"
                " it holds the units, delete it, and name them in card.toml under [columns]"
            )
        raise InputError(
            f"{self.path}, line {self.lines[bad]}, column {name!r}:"
            f" {cells[bad][:40]!r} is not a finite number{_hint(cells[bad])}"
        )

    def _check_times(self, t: np.ndarray) -> None:
        far = np.abs(t) > BEYOND_ALL
        if far.any():
            row = int(np.argmax(far))
            raise InputError(f"{self.path}, line {self.lines[row]}: {t[row]:.3g} is no time")

    def merge_repeated_times(self) -> int:
        """Make rows with one time stamp one row, later readings winning; how many rows went.

        Raises:
            InputError: a row has no time, time runs backwards, or the run is too short.
        """
        t = self.data["t"]
        if np.isnan(t).any():
            line = self.lines[int(np.argmax(np.isnan(t)))]
            raise InputError(f"{self.path}, line {line}: a row without a time")
        step = np.diff(t)
        if (step < 0.0).any():
            late = int(np.argmax(step < 0.0)) + 1
            raise InputError(
                f"{self.path}, line {self.lines[late]}:"
                f" time runs backwards, from {t[late - 1]:.6g} to {t[late]:.6g} s;"
                " where a log starts anew, cut it there into two files, a [[run]] each"
            )
        length = t[-1] - t[0]
        if not length >= SHORTEST_RUN:
            raise InputError(
                f"{self.path}: the run lasts {length:.3g} s, at least {SHORTEST_RUN:g} needed"
            )
        if length > LONGEST_RUN or np.median(step) > SLOWEST_ROWS:
            raise InputError(
                f"{self.path}: the run lasts {length:.3g} s with a row every {np.median(step):.3g} s;"
                f" {time_advice(self.time_column, float(np.median(step)))}"
            )
        last = np.append(step > 0.0, True)
        repeated = int(np.count_nonzero(~last))
        if repeated:
            group = np.concatenate([[0], np.cumsum(step > 0.0)])
            for channel, values in self.data.items():
                merged = np.full(group[-1] + 1, np.nan)
                given = ~np.isnan(values)
                merged[group[given]] = values[given]  # numpy lets the last one win
                self.data[channel] = merged
        return repeated


def _make_run(
    entry: dict[str, str], log: _Log, noise: Mapping[str, float], counts: Counter[str]
) -> Run:
    """Turn a log into a run and add what had to be done to ``counts``."""
    if log.unknown:
        counts["unknown columns ignored"] += len(log.unknown)
    if log.beyond:
        counts[f"readings beyond {BEYOND_ALL:g} dropped"] += log.beyond
    repeated = log.merge_repeated_times()
    if repeated:
        counts["rows with a repeated time stamp merged"] += repeated
    t = log.data["t"]
    measured = {}
    for channel in CHANNELS:
        values = log.data.get(channel)
        if values is None:
            continue
        if np.isnan(values).all():
            counts[f"empty columns {channel} dropped"] += 1
            continue
        outlier = find_outliers(channel, values, noise.get(channel))
        if outlier.any():
            values = np.where(outlier, np.nan, values)
            counts[f"outliers in {channel} removed"] += int(np.count_nonzero(outlier))
        measured[channel] = values
    stalled = beside_stalls(t)
    if stalled.any():
        counts["rows beside a stalled clock, readings left out"] += int(np.count_nonzero(stalled))
        measured = {c: np.where(stalled, np.nan, values) for c, values in measured.items()}
    command = _commands(log, measured, counts)
    _count_gaps(t, measured, counts)
    return Run(entry["name"], t, command, measured, entry["maneuver"], entry["note"])


def _commands(log: _Log, measured: dict[str, np.ndarray], counts: Counter[str]) -> np.ndarray:
    """(n, 4) commands [rad/s, rad/s, rad, rad].

    Where a rotor's command was not logged its measured speed drives, and leaves ``measured``.
    """
    columns = []
    for name, stand_in in zip(ROTOR_COMMANDS, _MEASURED_ROTOR, strict=True):
        speed = log.data.get(name)
        if speed is None or np.isnan(speed).all():
            if stand_in not in measured:
                raise InputError(
                    f"{log.path}: no rotor speed: neither {name} nor {stand_in};"
                    f" {advice(log.header, (name, stand_in))}"
                )
            speed = measured.pop(stand_in)
            counts[f"runs in which measured {stand_in} stands for the command"] += 1
        negative = int(np.count_nonzero(speed < 0.0))
        if negative:
            counts[f"negative {name} clipped at 0"] += negative
        columns.append(np.maximum(hold_last(speed), 0.0) / RPM_PER_RAD_S)
    for name in SWASH_COMMANDS:
        tilt = log.data.get(name)
        if tilt is None or np.isnan(tilt).all():
            counts[f"runs without {name}, taken as 0"] += 1
            tilt = np.zeros(len(log.data["t"]))
        columns.append(hold_last(tilt))
    return np.column_stack(columns)


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


def beside_stalls(t: np.ndarray) -> np.ndarray:
    """Rows (n,) whose time stamp cannot be trusted: the logger stalled and then caught up.

    A stall is a gap followed by rows that come too fast: they were taken while the clock stood, so
    that their stamps are late by up to the gap. An even gap (lost rows) is none.
    """
    dt = np.diff(t)
    usual = float(np.median(dt))
    mask = np.zeros(t.size, bool)
    for gap in np.flatnonzero(dt > STALL * usual):
        after = dt[gap + 1 : gap + 1 + CATCH_UP_ROWS]
        if np.count_nonzero(after < usual / STALL) >= 1:
            late = (t > t[gap] - 2.0 * usual) & (t < t[gap + 1] + dt[gap] + 2.0 * usual)
            mask |= late
    return mask


def hold_last(values: np.ndarray) -> np.ndarray:
    """(n,) of finite numbers: each hole takes the one before it, leading holes the first one given."""
    given = np.isfinite(values)
    first = int(np.argmax(given))
    index = np.maximum.accumulate(np.where(given, np.arange(len(values)), first))
    return values[index]


def _hint(cell: str) -> str:
    """What to do about a cell that is no number, where that is known."""
    if re.fullmatch(r"[-+]?\d+,\d+", cell):
        return ": write numbers with a decimal point"
    if cell.strip().lower() in ("na", "n/a", "null", "none", "-", "--", "?"):
        return ": leave the cell empty where there is no reading"
    if re.match(r"\d+[-/:.]\d+[-/:.]\d+", cell):
        return ": time is needed in seconds, from any beginning"
    return ""


def _is_finite_number(cell: str) -> bool:
    try:
        return "_" not in cell and not np.isinf(float(cell))
    except ValueError:
        return False


# --- writing ---------------------------------------------------------------------------------


def write_flight(flight: Flight, path: str | Path) -> Path:
    """Write a flight folder that :func:`read_flight` reads back: all files or none.

    Readings keep nine significant digits. ``notes``, ``counts`` and ``hashes`` are not written.
    """
    path = Path(path)
    card = tomlkit.document()
    card["vehicle"] = {"name": flight.vehicle}
    for section, numbers in (("air", flight.air), ("noise", flight.noise)):
        if numbers:
            card[section] = {key: float(value) for key, value in numbers.items()}
    entries = tomlkit.aot()
    with staged_folder(path) as stage:
        for run, file in zip(flight.runs, _file_names(flight.run_names), strict=True):
            entry = {"name": run.name, "file": file, "maneuver": run.maneuver}
            entries.append(tomlkit.item(entry | ({"note": run.note} if run.note else {})))
            write_text(stage / file, _csv_text(run))
        card["run"] = entries
        write_text(stage / CARD, tomlkit.dumps(card))
    return path


def _csv_text(run: Run) -> str:
    columns = [[repr(float(t)) for t in np.round(run.t, 9)]]
    header = ["t", *ROTOR_COMMANDS, *SWASH_COMMANDS]
    to_log = (RPM_PER_RAD_S, RPM_PER_RAD_S, 1.0, 1.0)
    columns += [[f"{x:.12g}" for x in run.command[:, i] * to_log[i]] for i in range(4)]
    for channel in CHANNELS:
        if channel in run.measured:
            header.append(channel)
            columns.append(["" if x != x else f"{x:.9g}" for x in run.measured[channel].tolist()])
    lines = [",".join(header), *(",".join(cells) for cells in zip(*columns, strict=True))]
    return "\n".join(lines) + "\n"


def _file_names(run_names: Iterable[str]) -> list[str]:
    """One safe, distinct file name per run."""
    names: list[str] = []
    for run_name in run_names:
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", run_name).strip("_") or "run"
        name, number = f"{stem}.csv", 2
        while name.lower() in {other.lower() for other in names}:
            name, number = f"{stem}_{number}.csv", number + 1
        names.append(name)
    return names
