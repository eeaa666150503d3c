"""Maneuvers: what is put on the commands, what the pilot is asked for, and for how long.

A maneuver is data. ``injected`` are steps added to the trim commands; ``asked`` are what a pilot
holds meanwhile, straight lines between points. An open-loop maneuver has no pilot.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from coax_env.errors import InputError

DEGREE = math.pi / 180.0

AXES = {
    "delta_lon": "rad, > 0 tilts the thrust back",
    "delta_lat": "rad, > 0 tilts the thrust to the right",
    "collective": "fraction of the trim speed, both rotors",
    "differential": "fraction of the trim speed, upper rotor up and lower rotor down",
}
"""What can be injected, and its unit."""

ASKED = {
    "height": "m above ground",
    "forward": "m/s along the heading",
    "right": "m/s across the heading",
    "heading": "rad from north",
}
"""What the pilot can be asked for, and its unit."""

Steps = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Maneuver:
    """One run's plan.

    Attributes:
        injected: axis of AXES -> (time [s], level) from that time on.
        asked: quantity of ASKED -> (time [s], value) points, joined by straight lines.
        closed_loop: whether a pilot flies; without one only ``injected`` counts.
    """

    name: str
    duration: float
    summary: str
    injected: Mapping[str, Steps] = field(default_factory=dict)
    asked: Mapping[str, Steps] = field(default_factory=dict)
    closed_loop: bool = True
    height: float = 1.5

    def __post_init__(self) -> None:
        for names, known in ((self.injected, AXES), (self.asked, ASKED)):
            for name in names:
                if name not in known:
                    raise InputError(f"maneuver {self.name!r}: no {name!r}; known: {list(known)}")

    def injection(self, t: np.ndarray, trim: np.ndarray) -> np.ndarray:
        """Commands added to the trim at times t [s], shape (n, 4) [rad/s, rad/s, rad, rad]."""
        levels = {axis: _steps_at(t, steps) for axis, steps in self.injected.items()}
        none = np.zeros(len(t))
        collective = levels.get("collective", none)
        differential = levels.get("differential", none)
        return np.column_stack(
            [
                trim[0] * (collective + differential),
                trim[1] * (collective - differential),
                levels.get("delta_lon", none),
                levels.get("delta_lat", none),
            ]
        )

    def asked_for(self, t: np.ndarray) -> np.ndarray:
        """Height, forward, right, heading asked for at times t [s], shape (n, 4)."""
        still = {"height": self.height, "forward": 0.0, "right": 0.0, "heading": 0.0}
        columns = []
        for name in ASKED:
            points = self.asked.get(name, [(0.0, still[name])])
            columns.append(np.interp(t, *np.array(points, float).T))
        return np.column_stack(columns)

    def scaled(self, factor: float) -> "Maneuver":
        """The same with every injected step larger by a factor."""
        return replace(
            self,
            injected={
                axis: [(t, factor * level) for t, level in steps]
                for axis, steps in self.injected.items()
            },
        )


def _steps_at(t: np.ndarray, steps: Steps) -> np.ndarray:
    """Level of a staircase at times t, zero before its first step."""
    times, levels = np.array(steps, float).T
    index = np.searchsorted(times, t + 1e-9, side="right") - 1
    return np.where(index >= 0, levels[np.maximum(index, 0)], 0.0)


def doublet(amplitude: float, start: float = 2.0, side: float = 2.0) -> Steps:
    """One side, then the other, then nothing.

    Args:
        amplitude: of each side, in the input's unit. start: of the first [s]. side: its length [s].
    """
    return [(start, amplitude), (start + side, -amplitude), (start + 2 * side, 0.0)]


def steps_3211(amplitude: float, start: float = 2.0, unit: float = 0.5) -> Steps:
    """Sides of three, two, one and one unit: a broad spectrum in few seconds.

    Args:
        amplitude: of each side, in the input's unit. start: of the first [s]. unit: [s].
    """
    steps, time, level = [], start, amplitude
    for sides in (3, 2, 1, 1):
        steps.append((time, level))
        time, level = time + sides * unit, -level
    return [*steps, (time, 0.0)]


def pulses(amplitude: float, start: float, width: float, pause: float, count: int) -> Steps:
    """Short pulses of alternating sign with pauses between them.

    Args:
        amplitude: in the input's unit. start: of the first [s].
        width, pause: of and between pulses [s]. count: of pulses.
    """
    steps = []
    for k in range(count):
        begin = start + k * (width + pause)
        steps += [(begin, amplitude * (-1) ** k), (begin + width, 0.0)]
    return steps


def track(points: str) -> Steps:
    """Points to join by straight lines, from text: ``"time value, time value, ..."``."""
    pairs = (point.split() for point in points.split(","))
    return [(float(time), float(value)) for time, value in pairs]


_ALL = (
    Maneuver(
        "lon_doublet",
        10.0,
        "the paper's: longitudinal swash 5 deg nose-down for 2 s, nose-up for 2 s, rotors at trim",
        injected={"delta_lon": doublet(-5.0 * DEGREE)},
        closed_loop=False,
        height=2.0,
    ),
    Maneuver(
        "lat_doublet",
        10.0,
        "lateral swash 3 deg to the right for 1 s, to the left for 1 s, with a pilot",
        injected={"delta_lat": doublet(3.0 * DEGREE, side=1.0)},
    ),
    Maneuver(
        "lon_3211",
        12.0,
        "3-2-1-1 on the longitudinal swash, 4 deg",
        injected={"delta_lon": steps_3211(-4.0 * DEGREE)},
    ),
    Maneuver(
        "lat_3211",
        12.0,
        "3-2-1-1 on the lateral swash, 4 deg",
        injected={"delta_lat": steps_3211(4.0 * DEGREE)},
    ),
    Maneuver(
        "heave_3211",
        14.0,
        "3-2-1-1 on both rotor speeds, 5 %",
        injected={"collective": steps_3211(0.05, unit=0.7)},
    ),
    Maneuver(
        "yaw_3211",
        14.0,
        "3-2-1-1 on the difference of the rotor speeds, 3 %",
        injected={"differential": steps_3211(0.03, unit=0.4)},
    ),
    Maneuver("hover", 20.0, "hover at 1.5 m"),
    Maneuver(
        "low_hover",
        24.0,
        "hover while stepping down to a quarter of a metre and up again",
        asked={
            "height": track(
                "0 1.5, 3 1.5, 7 0.6, 10 0.6, 12 0.35, 15 0.35, 16.5 0.25, 19 0.25, 23 1.2"
            )
        },
    ),
    Maneuver(
        "climb_descend",
        20.0,
        "climb at 1 m/s, descend at 1 m/s, twice",
        asked={
            "height": track(
                "0 1.5, 2 1.5, 5 4.5, 6 4.5, 9 1.5, 10 1.5, 12 3.5, 14 1.2, 16 2.5, 20 1.5"
            )
        },
    ),
    Maneuver(
        "forward_run",
        20.0,
        "forward to 3 m/s, stop, back at 2 m/s",
        asked={"forward": track("0 0, 2 0, 5 3, 8 3, 10 0, 11 0, 13 -2, 16 -2, 18 0")},
    ),
    Maneuver(
        "side_run",
        20.0,
        "right to 2.5 m/s, stop, left at 2 m/s",
        asked={"right": track("0 0, 2 0, 5 2.5, 8 2.5, 10 0, 11 0, 13 -2, 16 -2, 18 0")},
    ),
    Maneuver(
        "heading_turn",
        24.0,
        "a full turn on the spot, a quarter at a time",
        asked={
            "heading": [
                (time, quarters * 90.0 * DEGREE)
                for time, quarters in track("0 0, 2 0, 4 1, 7 1, 9 2, 12 2, 14 3, 17 3, 19 4")
            ]
        },
    ),
    Maneuver(
        "differential_rpm",
        16.0,
        "short strong pulses on the difference of the rotor speeds, 8 %: parts the two rotors",
        injected={"differential": pulses(0.08, start=2.0, width=0.25, pause=1.75, count=6)},
    ),
)

MANEUVERS: dict[str, Maneuver] = {m.name: m for m in _ALL}
"""The maneuvers by name."""


def maneuver(name: "str | Maneuver", **changes: Any) -> Maneuver:
    """A maneuver of the table by name, with some fields replaced.

    Raises:
        InputError: there is none of that name.
    """
    if isinstance(name, Maneuver):
        return replace(name, **changes)
    if name not in MANEUVERS:
        raise InputError(f"no maneuver {name!r}: choose one of {', '.join(MANEUVERS)}")
    return replace(MANEUVERS[name], **changes)
