"""CSVs of a flight folder, changed as text: what a log says, and nothing else."""

from collections.abc import Callable, Iterable
from pathlib import Path

Table = dict[str, list[str]]
"""Columns of a CSV, as text."""


def rewrite(files: Iterable[Path], change: Callable[[Table], None]) -> None:
    """Each file with its columns changed in place."""
    for file in files:
        header, *lines = (line.split(",") for line in file.read_text().splitlines())
        table = {name: [line[k] for line in lines] for k, name in enumerate(header)}
        change(table)
        rows = zip(*table.values(), strict=True)
        file.write_text("\n".join([",".join(table), *(",".join(row) for row in rows)]) + "\n")


def written_later(folder: Path, columns: Iterable[str], rows: int) -> Path:
    """The flight with some columns written so many rows later; the first cell is there until then."""

    def change(table: Table) -> None:
        for name in columns:
            table[name] = [*table[name][:1] * rows, *table[name][:-rows]]

    rewrite(folder.glob("*.csv"), change)
    return folder
