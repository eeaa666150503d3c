"""What goes into the env and what comes out: one table each, with names, units and bounds.

The spaces are made from these tables, and so are the tables in the docstring of `CoaxEnv`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gymnasium.spaces import Box

from coax_env.env.actions import ROTOR_RANGE, SWASH_RANGE
from coax_env.env.fleet import Fleet


@dataclass(frozen=True)
class Entry:
    """One number of the action or the observation; noise (std) and rate [Hz] of a reading."""

    name: str
    unit: str
    low: float
    high: float
    noise: float | None = None
    rate: float | None = None


@dataclass(frozen=True)
class Command:
    """One number of the action: what it sets, and how far from the nominal trim at -1 and 1."""

    name: str
    meaning: str
    reach: str


ACTIONS = (
    Command("omega_u", "speed of the upper rotor", f"trim -+ {100 * ROTOR_RANGE:g} %"),
    Command("omega_l", "speed of the lower rotor", f"trim -+ {100 * ROTOR_RANGE:g} %"),
    Command(
        "delta_lon", "swash tilt, positive tilts the thrust back", f"trim -+ {SWASH_RANGE:g} rad"
    ),
    Command(
        "delta_lat", "swash tilt, positive tilts the thrust right", f"trim -+ {SWASH_RANGE:g} rad"
    ),
)


def observed(fleet: Fleet) -> tuple[Entry, ...]:
    """Every number of the observation: readings, ``new_INSTRUMENT`` flags, the way to the target."""
    named = [
        *((s.name, s.unit, s.noise, s.rate) for s in fleet.sensors),
        *((f"new_{flag}", "1", None, None) for flag in fleet.flags),
        *((name, unit, None, None) for name, unit, _ in fleet.task.shown),
    ]
    bounds = zip(fleet.low.tolist(), fleet.high.tolist(), strict=True)
    return tuple(
        Entry(name, unit, low, high, noise, rate)
        for (name, unit, noise, rate), (low, high) in zip(named, bounds, strict=True)
    )


def action_space() -> Box:
    """Four commands in [-1, 1] about the nominal hover trim."""
    return Box(-1.0, 1.0, (len(ACTIONS),), np.float32)


def observation_space(entries: Sequence[Entry]) -> Box:
    """The observation's box, float32."""
    low = np.array([entry.low for entry in entries], dtype=np.float32)
    high = np.array([entry.high for entry in entries], dtype=np.float32)
    return Box(low, high, dtype=np.float32)


def action_table() -> list[str]:
    """The action as lines of a Markdown table, as in the docstring of `CoaxEnv`."""
    lines = ["| number | command | meaning | -1 .. 1 |", "|---|---|---|---|"]
    for k, command in enumerate(ACTIONS):
        lines.append(f"| {k} | {command.name} | {command.meaning} | {command.reach} |")
    return lines


def observation_table(entries: Sequence[Entry]) -> list[str]:
    """An observation as lines of a Markdown table, as in the docstring of `CoaxEnv`."""
    lines = [
        "| number | entry | unit | low | high | noise | rate |",
        "|---|---|---|---|---|---|---|",
    ]
    for k, entry in enumerate(entries):
        noise = "" if entry.noise is None else f"{entry.noise:.3g}"
        rate = "" if entry.rate is None else f"{entry.rate:g} Hz"
        bounds = f"{entry.low:.4g} | {entry.high:.4g}"
        lines.append(f"| {k} | {entry.name} | {entry.unit} | {bounds} | {noise} | {rate} |")
    return lines
