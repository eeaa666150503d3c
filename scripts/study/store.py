"""The study's folder: one JSON file per flight, so that it goes on after any stop."""

import hashlib
import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from coax_env.files import write_json
from study.plan import PlannedFlight

ROOT = Path(__file__).resolve().parents[2]


@cache
def code_hash() -> str:
    """Twelve hex digits over all that a result depends on, as this process found it."""
    digest = hashlib.sha256()
    sources = [*(ROOT / "coax_env").rglob("*.py"), *(ROOT / "coax_env").rglob("*.toml")]
    sources += [*(ROOT / "tests").glob("injector*.py"), *(ROOT / "scripts" / "study").glob("*.py")]
    for path in sorted(sources):
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def path_of(folder: Path, flight: PlannedFlight) -> Path:
    """File of a flight's result."""
    return folder / "flights" / f"{flight.name}.json"


def stored(folder: Path, flight: PlannedFlight) -> dict[str, Any] | None:
    """The result of a flight; None where there is none, half of one, a failure or another plan's."""
    try:
        row = json.loads(path_of(folder, flight).read_text())
    except (OSError, ValueError):
        return None
    if not isinstance(row, dict) or row.get("plan") != flight.as_json():
        return None
    return None if "error" in row else row


def store(folder: Path, flight: PlannedFlight, row: dict[str, Any]) -> None:
    """Write a flight's result.

    Args:
        folder: the study's. flight: as planned. row: its result (one_flight.py), or its failure.
    """
    write_json(path_of(folder, flight), row)


def missing(folder: Path, flights: Iterable[PlannedFlight]) -> list[PlannedFlight]:
    """Flights that have no result yet."""
    return [flight for flight in flights if stored(folder, flight) is None]


def rows_of(folder: Path, flights: Iterable[PlannedFlight]) -> list[dict[str, Any]]:
    """Results of the flights that have one, failures included."""
    rows = []
    for flight in flights:
        row = stored(folder, flight)
        if row is None and path_of(folder, flight).exists():
            row = _failure(path_of(folder, flight), flight)
        if row is not None:
            rows.append(row)
    return rows


def _failure(path: Path, flight: PlannedFlight) -> dict[str, Any] | None:
    try:
        row = json.loads(path.read_text())
    except ValueError:
        return None
    return row if row.get("plan") == flight.as_json() and "error" in row else None
