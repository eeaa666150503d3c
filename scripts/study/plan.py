"""Which flights the study flies: kind, hidden effects and their sizes, gusts, sensors, runs.

A flight is planned from the study's seed, its kind and its number within the kind alone, so that a
larger study contains the smaller one and what is stored stays good.
"""

import json
import math
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import injector
import numpy as np
from injector_air import GUSTY, STILL, Air
from injector_craft import CRAFTS, LAMA, Craft, rotors_of, spread

from study.judge import TIES

DEGREE = math.pi / 180.0

RICH = (
    "lon_3211", "lat_3211", "heave_3211", "yaw_3211", "forward_run", "side_run", "low_hover",
    "heading_turn",
)  # fmt: skip
"""Eight of the generator's twelve runs, 136 s: every axis, speed, the ground, a full turn.

What is left out repeats it: two doublets, a second climb, thirty seconds of hover.
"""
HOVER = ("hover",)

KINDS = ("still", "gusty", "one", "two", "three", "outside", "hover", "many")
SHARES = {"one": 0.5, "two": 0.2, "three": 0.1, "outside": 0.1, "hover": 0.1}
"""Of the flights with effects."""
MANY = 5
"""Effects that a flight of kind "many" begins with, always in gusts: it is flown for its intervals.

Those that one cannot expect to show are left off before it is diagnosed (one_flight.py): an effect that
is there and cannot be seen is in other effects' numbers, and no interval knows of it.
"""

SIZES: dict[str, dict[str, tuple[float, float, bool]]] = {
    "ground_effect": {"gain": (0.7, 1.3, False)},
    "rotor_drag": {"coefficient": (1.5e-4, 7e-4, False)},
    "airframe_drag": dict.fromkeys(("area_x", "area_y", "area_z"), (0.01, 0.04, False)),
    "axial_damping": {"coefficient": (0.05, 0.15, False)},
    "flap_blowback": {"gain": (0.005, 0.01, False)},
    "wake_interference": {"gain": (0.15, 0.35, False)},
    "yaw_damping": {"coefficient": (0.002, 0.006, False)},
    "rate_damping": {"coefficient": (0.002, 0.006, False)},
    "thrust_exponent": {"excess": (0.1, 0.3, False)},
    "wind": dict.fromkeys(("north", "east"), (1.0, 2.0, True)),
    "swash_offset": dict.fromkeys(("lon", "lat"), (0.5 * DEGREE, 1.5 * DEGREE, True)),
    "cg_offset": dict.fromkeys(("x", "y"), (0.5e-3, 2e-3, True)),
    "swash_phase": {"angle": (5.0 * DEGREE, 20.0 * DEGREE, True), "per_rpm": (1e-4, 3e-4, True)},
    "swash_gain": {"scale": (0.05, 0.2, True)},
    "servo_lag": {"time": (0.02, 0.06, False)},
    "servo_delay": {"time": (0.01, 0.05, False)},
    "servo_play": {"width": (0.01, 0.03, False)},
    "servo_deadband": {"width": (0.007, 0.02, False)},
    "servo_rate": {"limit": (0.5, 1.5, False)},
    "command_delay": {"time": (0.015, 0.06, False)},
    "motor_droop": dict.fromkeys(("upper", "lower"), (0.1, 0.3, False)),
    "battery_voltage": {"per_volt": (0.03, 0.09, False)},
    "dynamic_inflow": {"time": (0.02, 0.08, False)},
    "motor_lag": dict.fromkeys(("upper", "lower"), (0.05, 0.2, False)),
    "battery_sag": {"rate": (0.001, 0.003, False)},
    "added_mass": {"mass": (0.02, 0.1, False)},
    "thrust_scale": {"scale": (0.03, 0.1, True)},
    "torque_balance": {"scale": (0.03, 0.1, True)},
    "yaw_inertia": {"scale": (0.1, 0.3, True)},
    "hub_stiffness": dict.fromkeys(("upper", "lower"), (0.05, 0.5, False)),
    "spin_up_reaction": {"gain": (0.8, 1.2, False)},
    "flybar_time_constant": {"scale": (0.2, 0.5, True)},
    "gyro_bias": dict.fromkeys("xyz", (0.01, 0.05, True)),
    "accel_bias": dict.fromkeys("xyz", (0.05, 0.3, True)),
    "accel_scale": dict.fromkeys("xyz", (0.01, 0.03, True)),
    "imu_lever_arm": dict.fromkeys("xyz", (0.01, 0.05, True)),
    "imu_tilt": dict.fromkeys("xy", (0.5 * DEGREE, 1.5 * DEGREE, True)),
    "attitude_bias": dict.fromkeys("xyz", (1.0 * DEGREE, 2.0 * DEGREE, True)),
    "sonar_scale": {"scale": (0.02, 0.05, True)},
    "sonar_tilt": {"on": (1.0, 1.0, False)},
    "sonar_delay": {"time": (0.08, 0.15, False)},
    "vibration": {"amplitude": (0.2, 1.0, False)},
    "upper_blowback": {"gain": (0.005, 0.01, False)},
    "gyroscopic_coupling": {"gain": (0.8, 1.2, False)},
    "position_spring": {
        "stiffness": (0.08, 0.3, False),
        "north": (0.3, 1.0, True),
        "east": (0.3, 1.0, True),
    },
    "pose_delay": {"time": (0.02, 0.06, False)},
    "attitude_delay": {"time": (0.02, 0.06, False)},
    "marker_offset": dict.fromkeys("xyz", (0.02, 0.06, True)),
    "frame_yaw": {"angle": (5.0 * DEGREE, 20.0 * DEGREE, True)},
    "magnetic_field": dict.fromkeys("xy", (0.04, 0.1, True)),
    "gyro_scale": dict.fromkeys("xyz", (0.03, 0.1, True)),
    "outside": {"heading_moment": (0.015, 0.03, False)},
    "outside_patch": {"lift": (0.3, 0.8, True)},
    "outside_sector": {"moment": (0.02, 0.05, True)},
    "outside_resonance": {"moment": (0.01, 0.03, True)},
    "outside_cable": {"moment": (0.004, 0.01, False)},
    "outside_stall": {"moment": (0.01, 0.03, True)},
    "outside_wake": {"moment": (0.01, 0.02, True)},
}
"""effect -> parameter of the generator -> least, most, either sign: the catalogue's usual sizes."""

CARRIERS = {"wind": "rotor_drag"}
"""Effects that act only through another one, which is then hidden with them."""
OWN_FORM = {name.partition(".")[0] for name in injector.OTHER_FORM}
"""Effects whose numbers mean something else in the generator than in the catalogue."""
OUTSIDE = {
    "outside": "q", "outside_patch": "az", "outside_sector": "q", "outside_resonance": "p",
    "outside_cable": "r", "outside_stall": "q", "outside_wake": "p",
}  # fmt: skip
"""Effects that are in no list, and the channel that each disturbs."""
FOREIGN = tuple(e for e in OUTSIDE if e != "outside")
"""Those that no generic term is either."""
ALONE = tuple(e for e in SIZES if e not in CARRIERS and e not in OUTSIDE)


def size_on(craft: Craft, parameter: str) -> float:
    """Size of an effect on a craft that does what size 1 does on the paper's vehicle.

    Forces go with the weight, moments with the inertia of their axis, lengths with the radius, and
    what is per airspeed with the rotors' tip speed.
    """
    now, paper = (_scales(c) for c in (craft, LAMA))
    return now[SCALES[parameter]] / paper[SCALES[parameter]] if parameter in SCALES else 1.0


def _scales(craft: Craft) -> dict[str, float]:
    speed = rotors_of(craft).hover_upper
    weight = craft.mass * craft.gravity
    return {
        "mass": craft.mass, "weight": weight, "length": craft.radius, "area": craft.radius**2,
        "roll": craft.inertia_x, "yaw": craft.inertia_z, "stiffness": weight * craft.hub_upper,
        "per_speed": 1.0 / (speed * craft.radius), "per_rotor_speed": weight / speed,
    }  # fmt: skip


SCALES = {
    "rotor_drag.coefficient": "per_rotor_speed", "airframe_drag.area_x": "area",
    "airframe_drag.area_y": "area", "airframe_drag.area_z": "area",
    "axial_damping.coefficient": "per_speed", "flap_blowback.gain": "per_speed",
    "yaw_damping.coefficient": "yaw", "rate_damping.coefficient": "roll",
    "added_mass.mass": "mass", "cg_offset.x": "length", "cg_offset.y": "length",
    "hub_stiffness.upper": "stiffness", "hub_stiffness.lower": "stiffness",
    "marker_offset.x": "length", "marker_offset.y": "length", "marker_offset.z": "length",
    "position_spring.stiffness": "weight", "upper_blowback.gain": "per_speed",
    "imu_lever_arm.x": "length", "imu_lever_arm.y": "length", "imu_lever_arm.z": "length",
    "outside.heading_moment": "roll", "outside_patch.lift": "weight",
    "outside_sector.moment": "roll", "outside_resonance.moment": "roll",
    "outside_cable.moment": "yaw", "outside_stall.moment": "roll", "outside_wake.moment": "roll",
}  # fmt: skip
"""Parameter -> what its size goes with; any other is the same on every vehicle."""


@dataclass(frozen=True)
class PlannedFlight:
    """One flight of the study.

    effects: name -> parameter -> size. gusts: the generator's usual air; `air`: fields of another one.
    arm: the class of tests that it belongs to, if any.
    craft: a name of the generator's; or from the seed, "drawn", or "spread": the paper's vehicle, not
        quite as its file says. pilot: a name of the generator's.
    card_noise: factor by which the card's noise is wrong; None: the card has none. longest: s of a run.
    """

    kind: str
    number: int
    effects: dict[str, dict[str, float]]
    gusts: bool
    sensors: str
    seed: int
    runs: tuple[str, ...] | None
    arm: str = ""
    air: dict[str, Any] | None = None
    craft: str = "lama"
    pilot: str = "usual"
    card_noise: float | None = 1.0
    longest: float | None = None

    @property
    def name(self) -> str:
        """Name of the flight, and of the file it is stored in."""
        of_arm = f"{self.arm}-" if self.arm else ""
        return f"{of_arm}{self.kind}-{self.number:04d}"

    def as_json(self) -> dict[str, Any]:
        """The plan as it is stored with the result."""
        return dict(json.loads(json.dumps(asdict(self))))


def plan(
    clean: int, effects: int, seed: int = 0, runs: Sequence[str] | None = RICH, many: int = 0
) -> list[PlannedFlight]:
    """The flights of a study, its kinds evenly mixed so that a part of it is a fair sample.

    Args:
        clean: flights without an effect. effects: flights with one or more.
        runs: of the flights that are not hover-only; None: all that the generator has.
        many: flights with up to MANY effects each.
    """
    counts = {"still": clean - clean // 2, "gusty": clean // 2}
    for kind, share in SHARES.items():
        counts[kind] = round(share * effects)
    counts["one"] += clean + effects - sum(counts.values())
    counts["many"] = many
    flights = [
        planned(kind, number, seed, tuple(runs) if runs is not None else None)
        for kind in KINDS
        for number in range(counts[kind])
    ]
    return sorted(flights, key=lambda f: ((f.number + 0.5) / counts[f.kind], f.kind))


def planned(kind: str, number: int, seed: int, runs: tuple[str, ...] | None) -> PlannedFlight:
    """One flight, drawn from the study's seed, its kind and its number alone.

    Args:
        kind: one of KINDS. number: within its kind. seed: the study's.
        runs: maneuvers that are flown, for all kinds but "hover"; None: all of the generator's.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind), number])
    names = _hidden(kind, number, rng)
    return PlannedFlight(
        kind=kind,
        number=number,
        effects={name: sizes_of(name, rng) for name in names},
        gusts=_gusty(kind, number),
        sensors="full" if number % 2 == 0 else "onboard",
        seed=int(rng.integers(2**31)),
        runs=HOVER if kind == "hover" else runs,
    )


def _gusty(kind: str, number: int) -> bool:
    """Half of all flights, with either set of sensors: an effect flown again changes its weather.

    In these gusts half of the effects cannot be seen at their usual size, so gusts alone would leave
    little to judge.
    """
    if kind in ("still", "gusty", "many"):
        return kind != "still"
    if kind == "one":
        return (number + number // (2 * len(ALONE))) % 2 == 1
    return (number // 2) % 2 == 1


def _hidden(kind: str, number: int, rng: np.random.Generator) -> list[str]:
    if kind in ("still", "gusty"):
        return []
    if kind == "outside":
        return [list(OUTSIDE)[(number // 4) % len(OUTSIDE)]]
    if kind in ("one", "hover"):  # every effect in turn, with both sets of sensors
        order = np.random.default_rng(KINDS.index(kind)).permutation(len(ALONE))
        return [ALONE[order[(number // 2) % len(ALONE)]]]
    if kind == "many":
        return several(MANY, rng, OWN_FORM)
    return several(2 if kind == "two" else 3, rng)


def several(count: int, rng: np.random.Generator, but: Collection[str] = ()) -> list[str]:
    """Different effects, no two of one tie group: of those one alone may be named.

    Args:
        count: of effects. rng: that draws them. but: effects that are not hidden.
    """
    names: list[str] = []
    while len(names) < count:
        name = str(rng.choice([e for e in SIZES if e not in OUTSIDE and e not in but]))
        carried = [name] if name not in CARRIERS else [name, CARRIERS[name]]
        if any(e in but for e in carried):
            continue
        new = [e for e in carried if e not in names]
        tied = any({a, b} <= tie for tie in TIES for a in new for b in names)
        if new and not tied and len(names) + len(new) <= count:
            names += new
    return names


def sizes_of(name: str, rng: np.random.Generator) -> dict[str, float]:
    """Sizes of an effect's parameters, drawn uniformly over the usual ones."""
    sizes = {}
    for parameter, (least, most, signed) in SIZES[name].items():
        sign = rng.choice([-1.0, 1.0]) if signed else 1.0
        sizes[parameter] = float(sign * rng.uniform(least, most))
    return sizes


def craft_of(planned: PlannedFlight) -> Craft:
    """What flies."""
    rng = np.random.default_rng(planned.seed)
    if planned.craft == "drawn":
        return injector.drawn(rng)
    if planned.craft == "spread":
        return spread(LAMA, rng)
    return CRAFTS[planned.craft]


def air_of(planned: PlannedFlight) -> Air:
    """What it flies in."""
    if planned.air is not None:
        return Air(**planned.air)
    return GUSTY if planned.gusts else STILL
