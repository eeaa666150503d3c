"""One run's CSV as arrays by channel, in canonical units; what is in no cell is NaN."""

import csv
import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coax_env.errors import InputError
from coax_env.files import read_text
from coax_env.logs.card_columns import Column, Quaternion
from coax_env.logs.columns import advice, header_of
from coax_env.logs.frames import attitude
from coax_env.logs.units import LOG_UNITS, PLACE_UNITS, PLACES

BEYOND_ALL = 1e20
"""No reading in any unit is larger; what is, is a bit error and dropped."""


@dataclass(frozen=True)
class CsvLog:
    """A CSV, read.

    Attributes:
        data: channel or command, ``t`` among them -> (n,) in its canonical unit (units.py); also lat
            and lon [deg] where the card names them.
        lines: the line of the file that each row ends on, n of them.
        header: names of all columns.
        time_column: the name of the one with the time.
        renamed: channels that were found under the name that the card gives; "quaternion" too.
        unknown: columns that are no channel.
        beyond: readings dropped because no reading is so large.
    """

    path: Path
    data: Mapping[str, np.ndarray]
    lines: Sequence[int]
    header: Sequence[str]
    time_column: str
    renamed: frozenset[str]
    unknown: Sequence[str]
    beyond: int


@dataclass(frozen=True)
class _Cells:
    """A CSV as text: the header, the columns of the rows that hold anything, and the line each row
    ends on."""

    path: Path
    header: list[str]
    columns: list[tuple[str, ...]]
    lines: list[int]


def read_csv(
    path: Path, columns: Mapping[str, Column], quaternion: Quaternion | None = None
) -> CsvLog:
    """Read one run's CSV.

    Args:
        path: the file; comma, semicolon or tab between cells, names in the first row.
        columns: channel -> its column, where that has another name or unit than the channel.
        quaternion: the attitude's columns, where it is one.

    Raises:
        InputError: one line naming the file, and the line or column at fault.
    """
    cells = _split(path, read_text(path))
    index = {name: k for k, name in enumerate(cells.header) if name}
    asked = _asked(columns, quaternion)
    found = {channel: column for channel, column in asked.items() if column.name in index}
    if "t" not in found:
        raise InputError(f"{path}: no time column {asked['t'].name!r}; {advice(index, ['t'])}")
    data: dict[str, np.ndarray] = {}
    beyond = 0
    for channel, column in found.items():
        values = _numbers(cells, index[column.name], column.name)
        far = np.abs(values) > BEYOND_ALL
        if channel == "t" and far.any():
            row = int(np.argmax(far))
            raise InputError(f"{path}, line {cells.lines[row]}: {values[row]:.3g} is no time")
        values[far] = np.nan
        beyond += int(np.count_nonzero(far))
        data[channel] = column.read(values)
    taken = {column.name for column in found.values()}
    renamed = found.keys() & columns.keys()
    if quaternion is not None and index.keys() >= set(quaternion.names):
        q = np.stack([_numbers(cells, index[name], name) for name in quaternion.names], axis=1)
        data |= dict(zip(("phi", "theta", "psi"), attitude(q, quaternion.frames), strict=True))
        taken |= set(quaternion.names)
        renamed = renamed | {"quaternion"}
    return CsvLog(
        path=path,
        data=data,
        lines=cells.lines,
        header=cells.header,
        time_column=found["t"].name,
        renamed=frozenset(renamed),
        unknown=[name for name in index if name not in taken],
        beyond=beyond,
    )


def _asked(columns: Mapping[str, Column], quaternion: Quaternion | None) -> dict[str, Column]:
    """Channel -> the column to look for: the card's, else its namesake where no other channel has
    that."""
    claimed = {column.name for column in columns.values()}
    asked = dict(columns)
    if quaternion is not None:
        claimed |= {*quaternion.names, "phi", "theta", "psi"}
    for place, channel in PLACES.items():
        if place in columns:
            claimed.add(channel)
    for channel in LOG_UNITS:
        if channel not in asked and channel not in claimed:
            asked[channel] = Column.own(channel)
    asked.setdefault("t", Column.own("t"))
    return {c: asked[c] for c in (*LOG_UNITS, *PLACE_UNITS) if c in asked}


def _split(path: Path, text: str) -> _Cells:
    first, delimiter = header_of(text)
    if any(first) and all(_is_finite_number(cell) for cell in first if cell):
        raise InputError(f"{path}, line 1: numbers, no header: the first row must name the columns")
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True)
    header: list[str] = []
    rows, lines = [], []
    blanks = re.search(r"[^\S\r\n]", text) is not None
    try:
        for row in reader:
            cells = [cell.strip() for cell in row] if blanks else row
            if not any(cells):
                continue
            if not header:
                header = cells
                continue
            if len(cells) != len(header):
                raise InputError(
                    f"{path}, line {reader.line_num}: {len(cells)} cells"
                    f" where the header has {len(header)} (cells parted by {delimiter!r})"
                )
            rows.append(cells)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: {error}") from error
    if not header:
        raise InputError(f"{path}: the file is empty")
    for name, times in Counter(header).items():
        if name and times > 1:
            raise InputError(f"{path}: {times} columns are named {name!r}")
    if not rows:
        raise InputError(f"{path}: a header and no rows")
    return _Cells(path, header, list(zip(*rows, strict=True)), lines)


def _numbers(cells: _Cells, column: int, name: str) -> np.ndarray:
    """A column's numbers (n,), NaN where a cell is empty."""
    texts = cells.columns[column]
    try:
        filled = [text or "nan" for text in texts] if "" in texts else texts
        values = np.fromiter(map(float, filled), float, len(texts))
        if not np.isinf(values).any() and "_" not in "".join(texts):
            return values
    except ValueError:
        pass
    bad = next(k for k, text in enumerate(texts) if text and not _is_finite_number(text))
    where, text = f"{cells.path}, line {cells.lines[bad]}", texts[bad]
    if bad == 0 and not any(_is_finite_number(texts[0]) for texts in cells.columns):
        raise InputError(
            f"{where}: {text[:40]!r} and no number in the row: if"
            " it holds the units, delete it, and name them in card.toml under [columns]"
        )
    raise InputError(f"{where}, column {name!r}: {text[:40]!r} is not a finite number{_hint(text)}")


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
