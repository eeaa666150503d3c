"""How often the diagnosis names a cause where there is none, as measured on clean flights of a class.

A rate holds for flights like those that it was measured on: the same sensors, rates, kind of noise and
size of vehicle. `calibration.json` beside this file has one entry per class, written by
``scripts/study_diagnosis.py --calibrate --adopt`` with the command, the code and the threshold that it
was measured with. A threshold that has been changed since makes it void.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.diagnosis.problem import Fit
from coax_env.estimation.helicopter_noise import GUST_LEVELS, WHITE_LEVELS
from coax_env.estimation.prediction import gusts_of
from coax_env.files import write_json
from coax_env.logs.flight import Flight, Run
from coax_env.model.layout import SENSOR_GROUPS
from coax_env.model.vehicle import Vehicle

PATH = Path(__file__).with_name("calibration.json")
GAP = 0.1  # [s] without any reading that is a gap
FELT = 3.0
"""Times its floor from which a level of gusts is there; ours."""


@dataclass(frozen=True)
class Calibrated:
    """The rate of false alarms that a flight's class has, if it has one.

    Attributes:
        rate: share of clean flights of the class on which something is named; None outside every one.
        seen: the flight's class.
        name: of the calibrated class that it is in, or None.
        why: in what it is not of the class that is nearest, in words; "" where there is a rate.
    """

    rate: float | None
    seen: Mapping[str, Any]
    name: str | None
    why: str

    @property
    def entry(self) -> dict[str, Any]:
        """findings.json's `class`."""
        return {**self.seen, "calibrated": self.name, "why": self.why}


def calibrated(threshold: float, seen: Mapping[str, Any]) -> Calibrated:
    """What is known of false alarms on flights of a class; of several that it is in, the first's.

    Args:
        threshold: evidence [nats] from which causes are named.
        seen: of the flight, by `class_of`.
    """
    outside: list[tuple[int, str]] = []
    for measured in _classes():
        name = measured["class"]["name"]
        if measured["threshold_used_nats"] != threshold:
            outside.append((len(seen), f"{name}: measured with another threshold"))
            continue
        beyond = differences(seen, measured["class"])
        if not beyond:
            return Calibrated(float(measured["false_alarm_rate"]), seen, name, "")
        outside.append((len(beyond), f"not like {name}: {', '.join(beyond)}"))
    if not outside:
        return Calibrated(None, seen, None, "nothing has been measured yet")
    return Calibrated(None, seen, None, min(outside, key=lambda other: other[0])[1])


def differences(seen: Mapping[str, Any], described: Mapping[str, Any]) -> list[str]:
    """In what a flight is not of a class.

    Args:
        seen: of the flight, by `class_of`.
        described: of the class: a list of what may be seen, or the ends of a range. What a flight does
            not show (None) speaks for no class and against none.
    """
    found = []
    for key, value in seen.items():
        allowed = described.get(key)
        if value is None or allowed is None:
            continue
        number = isinstance(value, int | float) and not isinstance(value, bool)
        inside = allowed[0] <= value <= allowed[1] if number else value in allowed
        if not inside:
            words = CLASS_WORDS.get(key, key.replace("_", " "))
            there = f" ({_words(allowed[0])} to {_words(allowed[1])} there)" if number else ""
            found.append(f"{words} {_words(value)}{there}")
    return found


CLASS_WORDS = {
    "rate_hz": "rows per second", "gap_share": "share of the time in gaps",
    "card_noise": "sensor noise on the card:", "mass_kg": "mass in kg",
    "gust_force": "gust forces per weight", "gust_moment": "gust moments per weight and radius",
    "gust_memory_s": "memory of the gusts in s", "white_noise": "white noise above its floor:",
}  # fmt: skip
"""What a class is described by, in words where the key does not say it."""


def _words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def adopt(measured: Mapping[str, Any]) -> None:
    """Make a measured rate the package's, in the place of the one of the same class.

    Args:
        measured: as in calibration.json, its `class` with it.
    """
    others = [m for m in _classes() if m["class"]["name"] != measured["class"]["name"]]
    write_json(PATH, {"classes": [*others, dict(measured)]})


def _classes() -> list[dict[str, Any]]:
    if not PATH.exists():
        return []
    classes: list[dict[str, Any]] = json.loads(PATH.read_text(encoding="utf-8"))["classes"]
    return classes


def _read(run: Run) -> np.ndarray:
    """Rows with a reading, (n,)."""
    return np.any([np.isfinite(values) for values in run.measured.values()], axis=0)


def class_of(flight: Flight, vehicle: Vehicle, fit: Fit) -> dict[str, Any]:
    """What kind of flight this is, as far as its log and its noise show.

    Args:
        flight: the log.
        vehicle: as given.
        fit: whose noise levels were fitted.
    """
    steps = np.concatenate([np.diff(run.t) for run in flight.runs])
    read: dict[str, list[np.ndarray]] = {}
    for run in flight.runs:
        read.setdefault(run.whole, []).append(run.t[_read(run)])
    between = np.concatenate([np.diff(np.concatenate(times)) for times in read.values()])
    level, floor = fit.noise.process, fit.noise.floor
    weight = vehicle["mass"].value * vehicle["gravity"].value
    arm = vehicle["arm_upper"].value
    felt = [name for name in GUST_LEVELS if level[name] > FELT * floor[name]]
    aboard = [s for s, channels in SENSOR_GROUPS.items() if set(channels) & set(flight.channels)]
    return {
        "sensors": ", ".join(sorted(aboard)),
        "rate_hz": round(1.0 / float(np.median(steps)), 1),
        "gap_share": round(float(between[between > GAP].sum() / between.sum()), 4),
        "card_noise": all(c in flight.noise for c in flight.channels),
        "mass_kg": vehicle["mass"].value,
        "gust_force": round(max(level[n] for n in GUST_LEVELS if "force" in n) / weight, 4),
        "gust_moment": round(
            max(level[n] for n in GUST_LEVELS if "moment" in n) / (weight * arm), 4
        ),
        "gust_memory_s": gusts_of(fit.noise)["memory_s"] if felt else None,
        "white_noise": any(level[n] > FELT * floor[n] for n in WHITE_LEVELS),
    }
