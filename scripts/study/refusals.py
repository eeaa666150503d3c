"""Whether sound logs are refused: flights of the study, whole and in parts, asked for nothing else.

Every flight here is sound, whatever its machine's faults, so that each refusal is a false one.
"""

import tempfile
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from coax_env.consistency.agreement import agreement
from coax_env.errors import InputError
from coax_env.estimation.flown import flown_parts
from coax_env.logs.flight import Flight, Run, read_flight
from coax_env.model.vehicle_file import load_vehicle
from study.one_flight import hide
from study.plan import PlannedFlight

PARTS = ("whole", "half", "run", "run's half")


def fly_and_check(planned: PlannedFlight) -> dict[str, Any]:
    """The row of a flight: how many logs it made of each kind, and which were refused; or `error`."""
    row: dict[str, Any] = {"plan": planned.as_json()}
    try:
        with tempfile.TemporaryDirectory(prefix="coax-study-") as folder:
            truth = hide(planned, Path(folder) / "flight")
            flight = read_flight(Path(folder) / "flight")
            return row | {"hidden": truth["hidden"]} | checked(flight)
    except Exception as error:  # a crash on one flight is a result too
        where = traceback.extract_tb(error.__traceback__)[-1]
        return row | {"error": f"{type(error).__name__}: {error} ({where.name}:{where.lineno})"}


def check_log(folder: Path) -> dict[str, Any]:
    """The same row of a sound log that is there, of a real machine, say."""
    plan = {"arm": folder.name, "kind": "as it is", "number": 0}
    return {"plan": plan, "hidden": []} | checked(read_flight(folder))


def checked(flight: Flight) -> dict[str, Any]:
    """Logs by their kind, and the refused ones: kind, run, check and what was found."""
    logs: Counter[str] = Counter()
    refused = []
    for number, (kind, log) in enumerate(parts_of(flight)):
        try:
            vehicle = load_vehicle(log.vehicle).in_air(log.air)
            flown = flown_parts(log, vehicle)
        except InputError:  # nothing of it was flown: no log of a flight
            continue
        logs[kind] += 1
        for fault in agreement(flown, vehicle).faults:
            run = log.run_names[0] if len(log.runs) == 1 else ""
            said = {"check": fault.check, "words": fault.words}
            refused.append({"log": number, "of": kind, "run": run, **said})
    return {"logs": dict(logs), "refused": refused}


def parts_of(flight: Flight) -> Iterator[tuple[str, Flight]]:
    """The flight, the halves of its runs, each run, and the halves of each run."""
    yield "whole", flight
    for half in (0, 1):
        yield "half", replace(flight, runs=tuple(half_of(run, half) for run in flight.runs))
    if len(flight.runs) == 1:
        return
    for run in flight.runs:
        yield "run", replace(flight, runs=(run,))
        for half in (0, 1):
            yield "run's half", replace(flight, runs=(half_of(run, half),))


def half_of(run: Run, half: int) -> Run:
    """The first or the second half of a run's rows."""
    middle = len(run.t) // 2
    return run.of_rows(slice(middle) if half == 0 else slice(middle, None))


def table_text(rows: Sequence[dict[str, Any]], command: str) -> str:
    """The rows as a table by arm and kind of log, then every refusal."""
    sound = [row for row in rows if "error" not in row]
    arms = list(dict.fromkeys(row["plan"]["arm"] or "study" for row in rows))
    lines = [
        "# Sound logs that are refused: none should be",
        "",
        f"`{command}`: {len(sound)} flights, {len(rows) - len(sound)} failed. What the study flies is"
        " synthetic.",
        "",
        f"| arm | {' | '.join(PARTS)} |",
        "|---" * (1 + len(PARTS)) + "|",
        *(_line(arm, [r for r in sound if (r["plan"]["arm"] or "study") == arm]) for arm in arms),
        _line("all", sound),
        "",
    ]
    for row in sound:
        name, hidden = row["plan"]["arm"] or "study", ", ".join(row["hidden"]) or "nothing"
        for r in row["refused"]:
            lines.append(
                f"- {name}, {row['plan']['kind']} {row['plan']['number']}, {hidden} hidden,"
                f" {r['of']} {r['run']}: {r['check']}: {r['words']}"
            )
    lines += [f"- failed: {row['error']}" for row in rows if "error" in row]
    return "\n".join(lines) + "\n"


def _line(name: str, rows: Sequence[dict[str, Any]]) -> str:
    """Refused of all, of each kind of log."""
    cells = []
    for kind in PARTS:
        asked = sum(row["logs"].get(kind, 0) for row in rows)
        refused = {
            (k, r["log"]) for k, row in enumerate(rows) for r in row["refused"] if r["of"] == kind
        }
        cells.append(f"{len(refused)} of {asked}")
    return f"| {name} | {' | '.join(cells)} |"
