"""The flight test card: ``card.toml`` of a flight folder, checked.

Own checks instead of pydantic's or msgspec's: theirs quote no value or take several lines, and a run's
file, a channel's unit and its factor would have to be checked by hand all the same.
"""

import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coax_env.errors import InputError, shown
from coax_env.files import read_toml
from coax_env.logs.units import LOG_UNITS, factor_to_canonical
from coax_env.model.layout import CHANNELS

CARD = "card.toml"
AIR = ("density", "gravity")
SMALLEST_SCALE, LARGEST_SCALE = 1e-12, 1e12
"""Between them lies the size of any factor that a card may ask for."""


@dataclass(frozen=True)
class Column:
    """A log's column: its name in the files, and what makes its numbers the channel's own unit."""

    name: str
    factor: float
    hold: bool | None = None
    """Whether a repeat is no new reading; None: as the pattern of repeats says (held.py)."""


@dataclass(frozen=True)
class RunEntry:
    """One [[run]] of a card."""

    name: str
    file: str
    maneuver: str
    note: str


@dataclass(frozen=True)
class Card:
    """What a card holds.

    Attributes:
        vehicle: name of a shipped vehicle file, or a path.
        air: density [kg/m3], gravity [m/s2], where the card has them.
        noise: channel -> std in the channel's unit.
        columns: channel -> the column that holds it, where that has another name or unit.
        counts: entries that mean nothing here and were ignored, in words.
    """

    vehicle: str
    air: Mapping[str, float]
    noise: Mapping[str, float]
    columns: Mapping[str, Column]
    runs: tuple[RunEntry, ...]
    counts: Mapping[str, int]

    @property
    def holds(self) -> dict[str, bool]:
        """Channels of which the card says whether their repeats are new readings."""
        return {c: column.hold for c, column in self.columns.items() if column.hold is not None}


def read_card(path: Path) -> Card:
    """Read a card.

    Raises:
        InputError: one line naming the file, section and field at fault.
    """
    table = _Table(path, read_toml(path))
    vehicle = table.text(table.section("vehicle", required=True), "name", "[vehicle]")
    air = table.positive_numbers("air", AIR)
    noise = table.positive_numbers("noise", CHANNELS)
    columns = _columns(table)
    return Card(vehicle, air, noise, columns, _runs(table), table.counts)


@dataclass(frozen=True)
class _Table:
    """The card as TOML gives it, and what is asked of any part of it."""

    path: Path
    content: Mapping[str, Any]
    counts: dict[str, int] = field(default_factory=dict)

    def fault(self, message: str) -> InputError:
        return InputError(f"{self.path}: {message}")

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

    def positive_numbers(self, section: str, known: tuple[str, ...]) -> dict[str, float]:
        numbers = {}
        for key, value in self.section(section).items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise self.fault(f"[{section}] {key} should be a number, found {shown(value)}")
            if not 0.0 < value <= sys.float_info.max:
                raise self.fault(
                    f"[{section}] {key} should be positive and finite, found {shown(value)}"
                )
            if key in known:
                numbers[key] = float(value)
            else:
                self.counts[f"unknown entry {key!r} in [{section}] ignored"] = 1
        return numbers


def _columns(table: _Table) -> dict[str, Column]:
    columns = {}
    for channel, entry in table.section("columns").items():
        if channel not in LOG_UNITS:
            raise table.fault(
                f"[columns] unknown channel {channel!r}; channels are {', '.join(LOG_UNITS)}"
            )
        if isinstance(entry, str):
            entry = {"name": entry}
        if not isinstance(entry, dict):
            raise table.fault(
                f"[columns] {channel} should be {{ name, unit, scale }}, found {shown(entry)}"
            )
        name = table.text(entry, "name", f"[columns] {channel}", default=channel)
        unit = table.text(entry, "unit", f"[columns] {channel}", default=LOG_UNITS[channel])
        try:
            factor = factor_to_canonical(channel, unit)
        except InputError as error:
            raise table.fault(f"[columns] {error}") from error
        hold = entry.get("hold")
        if hold is not None and not isinstance(hold, bool):
            raise table.fault(
                f"[columns] {channel} hold should be true or false, found {shown(hold)}"
            )
        columns[channel] = Column(name.strip(), factor * _scale(table, channel, entry), hold)
    return columns


def _scale(table: _Table, channel: str, entry: dict[str, Any]) -> float:
    """What else the column is multiplied by: -1 turns an axis round."""
    scale = entry.get("scale", 1.0)
    number = isinstance(scale, int | float) and not isinstance(scale, bool)
    if not number or not SMALLEST_SCALE < abs(scale) < LARGEST_SCALE:
        raise table.fault(
            f"[columns] {channel} scale should be a number, not 0, found {shown(scale)}"
        )
    return float(scale)


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
    file = table.text(entry, "file", where)
    return RunEntry(
        file=file,
        name=table.text(entry, "name", where, default=Path(file).stem),
        maneuver=table.text(entry, "maneuver", where, default=""),
        note=table.text(entry, "note", where, default=""),
    )
