"""CPU seconds that a diagnosis takes, by flights of tests/injector.py in gusts, all sensors at 100 Hz.

A program too, so that each measurement has a process of its own, and another checkout its own code::

    diagnosis_times.py kinds    # twelve runs with nothing, one, two and three effects hidden
    diagnosis_times.py 48       # so many runs, with the memory that they took
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
HIDDEN: tuple[Mapping[str, Mapping[str, float]], ...] = (
    {},
    {"swash_offset": {"lon": 0.015}},
    {"servo_lag": {"time": 0.04}, "yaw_damping": {"coefficient": 0.004}},
    {
        "gyro_bias": {"x": 0.03},
        "motor_lag": {"upper": 0.1, "lower": 0.12},
        "axial_damping": {"coefficient": 0.1},
    },
)
COUNTS = (12, 48, 200)
"""Runs of the flights that show how a diagnosis grows: 210, 840 and 3,492 s."""
SEED = 40


def measure(
    report_progress: Callable[[str], None], before: Path | None = None
) -> list[dict[str, Any]]:
    """What was hidden and named, CPU seconds (warm, one thread) and those flown, by flight.

    Args:
        report_progress: called with a line of text.
        before: another checkout, whose diagnoses are timed after ours: `before` of each row.
    """
    report_progress("diagnoses of twelve runs")
    rows = _of_program("kinds", ROOT)
    if before is not None:
        report_progress(f"the same by {before}")
        for row, old in zip(rows, _of_program("kinds", before), strict=True):
            row["before"] = old["seconds"]
    return rows


def growth(report_progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """The same for flights of more and more runs, three effects hidden, with the memory [MB]."""
    rows = []
    for count in COUNTS:
        report_progress(f"a diagnosis of {count} runs")
        rows += _of_program(str(count), ROOT)
    return rows


def _of_program(mode: str, checkout: Path) -> list[dict[str, Any]]:
    done = subprocess.run(
        [sys.executable, __file__, mode], check=True, capture_output=True, text=True,
        env={**os.environ, "COAX_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(checkout)},
    )  # fmt: skip
    found: list[dict[str, Any]] = json.loads(done.stdout.splitlines()[-1])
    return found


def _kinds() -> list[dict[str, Any]]:
    _timed(HIDDEN[-1], 12)  # compiled now
    return [_timed(effects, 12) for effects in HIDDEN]


def _many(count: int) -> list[dict[str, Any]]:
    _timed(HIDDEN[-1], 12)
    row = _timed(HIDDEN[-1], count)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # [kB]; [bytes] on macOS
    return [row | {"memory_mb": peak / (1e6 if sys.platform == "darwin" else 1e3)}]


def _timed(effects: Mapping[str, Mapping[str, float]], count: int) -> dict[str, Any]:
    from coax_env.diagnosis.diagnose import diagnose

    flight = flown(effects, count)
    start = time.process_time()
    found = diagnose(flight)
    return {
        "hidden": sorted(effects),
        "named": sorted(cause["effect"] for cause in found.findings["causes"]),
        "runs": count,
        "seconds": time.process_time() - start,
        "flown_s": sum(run.duration for run in flight.runs),
    }


def flown(effects: Mapping[str, Mapping[str, float]], count: int) -> Any:
    """A Flight of so many runs with these effects hidden: the generator's twelve, again and again."""
    import injector

    from coax_env.logs.flight import read_flight

    runs: list[Any] = []
    while len(runs) < count:
        with tempfile.TemporaryDirectory() as folder:
            injector.fly(folder, effects, gusts=True, seed=SEED + len(effects) + len(runs))
            flight = read_flight(folder)
        turn = f"_{len(runs)}" if runs else ""
        runs += [replace(run, name=run.name + turn) for run in flight.runs]
    return replace(flight, runs=tuple(runs[:count]))


def main(arguments: Sequence[str]) -> None:
    sys.path.append(str(ROOT / "tests"))
    (mode,) = arguments
    print(json.dumps(_kinds() if mode == "kinds" else _many(int(mode))))


if __name__ == "__main__":
    main(sys.argv[1:])
