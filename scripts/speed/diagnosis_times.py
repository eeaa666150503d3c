"""Seconds that a diagnosis takes: twelve runs of tests/injector.py in gusts, all sensors at 100 Hz."""

import tempfile
import time
from collections.abc import Callable, Mapping
from typing import Any

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
SEED = 40


def measure(report_progress: Callable[[str], None]) -> list[dict[str, Any]]:
    """What was hidden, what was named, the seconds that took (warm) and those flown, per flight."""
    from study.plan import injector

    from coax_env.diagnosis.diagnose import diagnose
    from coax_env.logs.flight import read_flight

    rows = []
    for effects in (HIDDEN[-1], *HIDDEN):  # the first one only warms up
        report_progress(f"a diagnosis with {' and '.join(effects) or 'nothing'} hidden")
        with tempfile.TemporaryDirectory() as folder:
            injector.fly(folder, effects, gusts=True, seed=SEED + len(effects))
            flight = read_flight(folder)
        start = time.perf_counter()
        found = diagnose(flight)
        rows.append({
            "hidden": sorted(effects),
            "named": sorted(cause["effect"] for cause in found.findings["causes"]),
            "seconds": time.perf_counter() - start,
            "flown_s": sum(run.duration for run in flight.runs),
        })  # fmt: skip
    return rows[1:]
