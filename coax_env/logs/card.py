"""The flight test card: ``card.toml`` of a flight folder, checked. README.md here shows one.

Own checks instead of pydantic's or msgspec's: theirs quote no value or take several lines, and a run's
file, a channel's unit and its factor would have to be checked by hand all the same.
"""

import difflib
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from coax_env.errors import InputError, shown
from coax_env.files import read_toml
from coax_env.logs.card_columns import (
    COLUMN_KEYS,
    LARGEST_SCALE,
    LATEST,
    SMALLEST_SCALE,
    Column,
    Quaternion,
)
from coax_env.logs.frames import frames_of
from coax_env.logs.units import LOG_UNITS, PLACE_UNITS, PLACES, factor_to_canonical
from coax_env.model.layout import CHANNELS

CARD = "card.toml"
SECTIONS = ("date", "synthetic", "vehicle", "air", "noise", "columns", "checks", "run")
AIR = ("density", "gravity")
RUN_KEYS = ("name", "file", "maneuver", "note", "part")
QUATERNION_KEYS = ("names", "from")
PARTS = ("A", "B")


@dataclass(frozen=True)
class RunEntry:
    """One [[run]] of a card."""

    name: str
    file: str
    maneuver: str
    note: str
    part: str = ""
    """"A" or "B": of a flight whose parts are to be compared."""


@dataclass(frozen=True)
class Card:
    """What a card holds.

    Attributes:
        vehicle: name of a shipped vehicle file, or a path.
        air: density [kg/m3], gravity [m/s2], where the card has them.
        noise: channel -> std in the channel's unit.
        columns: channel, lat or lon -> the column that holds it, where that is not as the channel.
        quaternion: columns of the attitude, where it is logged as a quaternion.
        runs: in the card's order.
        waived: checks of the log that the card says to pass over.
        synthetic: whether a simulator flew it; reports say so.
    """

    vehicle: str
    air: Mapping[str, float]
    noise: Mapping[str, float]
    columns: Mapping[str, Column]
    quaternion: Quaternion | None
    runs: tuple[RunEntry, ...]
    waived: tuple[str, ...]
    synthetic: bool

    @property
    def holds(self) -> dict[str, bool]:
        """Channels of which the card says whether their repeats are new readings."""
        return {c: column.hold for c, column in self.columns.items() if column.hold is not None}

    @property
    def late(self) -> dict[str, float]:
        """Channels and commands that are written late, and by how much [s]."""
        late = {c: column.late for c, column in self.columns.items() if column.late}
        return {PLACES.get(c, c): seconds for c, seconds in late.items()}


def read_card(path: Path) -> Card:
    """Read a card.

    Raises:
        InputError: one line naming the file, section and field at fault; of a key or section that
            there is none of, also the nearest one.
    """
    table = _Table(path, read_toml(path))
    table.check_keys(table.content, SECTIONS, "section", "")
    section = table.section("vehicle", required=True)
    table.check_keys(section, ("name",), "key", "[vehicle] ")
    vehicle = table.text(section, "name", "[vehicle]")
    air = table.positive_numbers("air", AIR)
    noise = table.positive_numbers("noise", CHANNELS)
    columns, quaternion = _columns(table)
    runs, waived, synthetic = _runs(table), _waived(table), _synthetic(table)
    return Card(vehicle, air, noise, columns, quaternion, runs, waived, synthetic)


@dataclass(frozen=True)
class _Table:
    """The card as TOML gives it, and what is asked of any part of it."""

    path: Path
    content: Mapping[str, Any]

    def fault(self, message: str) -> InputError:
        return InputError(f"{self.path}: {message}")

    def check_keys(
        self, table: Mapping[str, Any], known: Iterable[str], what: str, where: str
    ) -> None:
        """Refuse a key that means nothing, and name the nearest one that does."""
        known = tuple(known)
        for key in table:
            if key not in known:
                raise self.fault(f"{where}unknown {what} {key!r}{nearest(key, known)}")

    def section(self, name: str, required: bool = False) -> dict[str, Any]:
        if required and name not in self.content:
            raise self.fault(f"no [{name}] section")
        section = self.content.get(name, {})
        if not isinstance(section, dict):
            raise self.fault(f"[{name}] should be a section, found {shown(section)}")
        return section

    def text(self, table: dict[str, Any], key: str, where: str, default: str | None = None) -> str:
        value = table.get(key, default)
        if value is None:
            raise self.fault(f"{where} has no {key}")
        if not isinstance(value, str) or not (value.strip() or default is not None):
            raise self.fault(f"{where} {key} should be text, found {shown(value)}")
        if key != "note" and not value.isprintable():
            raise self.fault(f"{where} {key} should be one printable line, found {shown(value)}")
        return value

    def texts(self, table: dict[str, Any], key: str, where: str) -> tuple[str, ...]:
        value = table.get(key, [])
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise self.fault(f"{where} {key} should be a list of texts, found {shown(value)}")
        return tuple(value)

    def number(self, value: Any, where: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fault(f"{where} should be a number, found {shown(value)}")
        if not abs(value) <= sys.float_info.max:
            raise self.fault(f"{where} should be finite, found {shown(value)}")
        return float(value)

    def positive_numbers(self, section: str, known: tuple[str, ...]) -> dict[str, float]:
        self.check_keys(self.section(section), known, "key", f"[{section}] ")
        numbers = {}
        for key, value in self.section(section).items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise self.fault(f"[{section}] {key} should be a number, found {shown(value)}")
            if not 0.0 < value <= sys.float_info.max:
                raise self.fault(
                    f"[{section}] {key} should be positive and finite, found {shown(value)}"
                )
            numbers[key] = float(value)
        return numbers


def nearest(key: str, known: Iterable[str]) -> str:
    """What a wrong key probably was meant to be, as the end of a message."""
    known = tuple(known)
    lower = {name.lower(): name for name in known}
    close = difflib.get_close_matches(key.lower()[:60], lower, n=1, cutoff=0.5)
    if close:
        return f": {lower[close[0]]!r} is meant? there are {', '.join(known)}"
    return f"; there are {', '.join(known)}"


# --- columns --------------------------------------------------------------------------------------


def _columns(table: _Table) -> tuple[dict[str, Column], Quaternion | None]:
    columns: dict[str, Column] = {}
    quaternion = None
    known = (*LOG_UNITS, *PLACE_UNITS, "quaternion")
    for channel, entry in table.section("columns").items():
        where = f"[columns] {channel}"
        if channel not in known:
            raise table.fault(f"[columns] unknown channel {channel!r}{nearest(channel, known)}")
        if channel == "quaternion":
            quaternion = _quaternion(table, entry)
            continue
        if isinstance(entry, str):
            entry = {"name": entry}
        if not isinstance(entry, dict):
            raise table.fault(f"{where} should be {{ name, unit, ... }}, found {shown(entry)}")
        table.check_keys(entry, COLUMN_KEYS, "key", f"{where}: ")
        columns[channel] = _column(table, channel, entry, where)
    _check_taken_once(table, columns, quaternion)
    return columns, quaternion


def _column(table: _Table, channel: str, entry: dict[str, Any], where: str) -> Column:
    name = table.text(entry, "name", where, default=channel).strip()
    unit = table.text(entry, "unit", where, default={**LOG_UNITS, **PLACE_UNITS}[channel])
    try:
        factor = factor_to_canonical(channel, unit)
    except InputError as error:
        raise table.fault(f"[columns] {error}") from error
    hold = entry.get("hold")
    if hold is not None and not isinstance(hold, bool):
        raise table.fault(f"{where} hold should be true or false, found {shown(hold)}")
    scale = entry.get("scale", 1.0)
    number = isinstance(scale, int | float) and not isinstance(scale, bool)
    if not number or not SMALLEST_SCALE < abs(scale) < LARGEST_SCALE:
        raise table.fault(f"{where} scale should be a number, not 0, found {shown(scale)}")
    sign = entry.get("sign", 1)
    if isinstance(sign, bool) or sign not in (1, -1):
        raise table.fault(f"{where} sign should be 1 or -1, found {shown(sign)}")
    offset = table.number(entry.get("offset", 0.0), f"{where} offset")
    calibration = _calibration(table, entry.get("calibration"), where)
    if calibration and ("scale" in entry or "offset" in entry):
        raise table.fault(
            f"{where}: a calibration says what scale and offset would: leave them out"
        )
    late = _late(table, channel, entry, where)
    return Column(
        name, unit.strip(), factor, int(sign), float(scale), offset, calibration, hold, late
    )  # fmt: skip


def _late(table: _Table, channel: str, entry: dict[str, Any], where: str) -> float:
    late = table.number(entry.get("late", 0.0), f"{where} late")
    if late and channel == "t":
        raise table.fault(f"{where}: time itself is not late: say it of the columns that are")
    if not 0.0 <= late <= LATEST:
        raise table.fault(f"{where} late should be seconds, 0 to {LATEST:g}, found {shown(late)}")
    return late


def _calibration(table: _Table, points: Any, where: str) -> tuple[tuple[float, float], ...]:
    """Points (raw, value), raw rising."""
    if points is None:
        return ()
    form = f"{where} calibration should be points [[raw, value], ...], raw rising, two at least"
    if not isinstance(points, list) or len(points) < 2:
        raise table.fault(f"{form}, found {shown(points)}")
    found = []
    for point in points:
        if not isinstance(point, list) or len(point) != 2:
            raise table.fault(f"{form}, found {shown(point)}")
        raw, value = (table.number(x, f"{where} calibration") for x in point)
        found.append((raw, value))
    if any(b[0] <= a[0] for a, b in pairwise(found)):
        raise table.fault(f"{form}, found {shown(points)}")
    if len({value for _, value in found}) == 1:
        raise table.fault(f"{where} calibration makes one value of all, found {shown(points)}")
    return tuple(found)


def _quaternion(table: _Table, entry: Any) -> Quaternion:
    where = "[columns] quaternion"
    if not isinstance(entry, dict):
        raise table.fault(
            f'{where} should be {{ names = ["qw", "qx", "qy", "qz"], from = "body to NED" }},'
            f" found {shown(entry)}"
        )
    table.check_keys(entry, QUATERNION_KEYS, "key", f"{where}: ")
    names = table.texts(entry, "names", where)
    if len(names) != 4 or len(set(names)) != 4:
        raise table.fault(f"{where} names should be four columns: w, x, y, z; found {shown(names)}")
    words = table.text(entry, "from", where)
    try:
        frames_of(words)
    except InputError as error:
        raise table.fault(f"{where} from: {error}") from error
    return Quaternion((names[0], names[1], names[2], names[3]), words)


def _check_taken_once(
    table: _Table, columns: Mapping[str, Column], quaternion: Quaternion | None
) -> None:
    """Refuse a column that would be read as two channels, and an attitude that is there twice."""
    for name, times in Counter(column.name for column in columns.values()).items():
        if times > 1:
            both = " and ".join(c for c, column in columns.items() if column.name == name)
            raise table.fault(f"[columns] {both} both read the column {name!r}")
    if quaternion is not None:
        for channel in ("phi", "theta", "psi"):
            if channel in columns:
                raise table.fault(f"[columns] has both quaternion and {channel}: leave one out")
    if ("lat" in columns) != ("lon" in columns):
        raise table.fault("[columns] lat and lon make a position together: name both")
    for place, channel in PLACES.items():
        if place in columns and channel in columns:
            raise table.fault(f"[columns] has both {place} and {channel}: leave one out")


# --- checks and runs ------------------------------------------------------------------------------


def _waived(table: _Table) -> tuple[str, ...]:
    section = table.section("checks")
    table.check_keys(section, ("waive",), "key", "[checks] ")
    return table.texts(section, "waive", "[checks]")


def _synthetic(table: _Table) -> bool:
    value = table.content.get("synthetic", False)
    if not isinstance(value, bool):
        raise table.fault(f"synthetic should be true or false, found {shown(value)}")
    return value


def _runs(table: _Table) -> tuple[RunEntry, ...]:
    entries = table.content.get("run", [])
    if not isinstance(entries, list) or not entries:
        raise table.fault("no [[run]] entry")
    runs = tuple(_run(table, entry, f"[[run]] {k}") for k, entry in enumerate(entries, 1))
    for name, times in Counter(run.name for run in runs).items():
        if times > 1:
            raise table.fault(f"{times} runs are named {name!r}")
    return runs


def _run(table: _Table, entry: Any, where: str) -> RunEntry:
    if not isinstance(entry, dict):
        raise table.fault(f"{where} should be a section, found {shown(entry)}")
    table.check_keys(entry, RUN_KEYS, "key", f"{where}: ")
    file = table.text(entry, "file", where)
    part = table.text(entry, "part", where, default="")
    if part and part not in PARTS:
        raise table.fault(f'{where} part should be "A" or "B", found {shown(part)}')
    return RunEntry(
        file=file,
        name=table.text(entry, "name", where, default=Path(file).stem),
        maneuver=table.text(entry, "maneuver", where, default=""),
        note=table.text(entry, "note", where, default=""),
        part=part,
    )
