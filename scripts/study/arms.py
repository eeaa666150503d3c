"""Arms of the study: each is one class of flights, so that no class of test stands alone.

A flight is drawn from the study's seed, its arm's name, its kind and its number alone: an arm that is
added changes no other. Kinds: "clean", "one", "two", "three" effects, "outside" (in no list).
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from injector import PILOTS
from injector_air import GUSTS, GUSTY, STILL, Air
from injector_sensors import MIXED, MIXED_POSES, kit

from coax_env.errors import InputError
from study.plan import ALONE, FOREIGN, RICH, PlannedFlight, several, sizes_of

T = TypeVar("T")

LONGEST = 14.0
"""s at which a run ends: the eight runs are then 108 s, with a full turn, the ground and speed."""


@dataclass(frozen=True)
class Arm:
    """One class of flights. Where several options are given, flights take them in turn.

    words: what it is. air: its gusts; memory: s, bounds of log-uniform memories of forces and of
    moments. sensors, pilots, craft: the generator's. card: factors on the card's noise; None: none.
    size: factor on the effects' usual sizes. listed: whether the effects are in the catalogue.
    mixed: vehicles that are drawn from, and air of any kind with them; empty: as above.
    """

    words: str
    air: Air = GUSTY
    memory: tuple[float, float] | None = None
    sensors: tuple[str, ...] = ("full", "onboard")
    card: tuple[float | None, ...] = (1.0,)
    craft: str = "lama"
    pilots: tuple[str, ...] = ("usual",)
    size: float = 1.0
    listed: bool = True
    mixed: tuple[str, ...] = ()


ARMS = {
    "still": Arm("still air", STILL),
    "gusty": Arm("gusts with a memory of 0.5 s"),
    "memory_short": Arm("gusts with memories of 0.03-0.1 s", memory=(0.03, 0.1)),
    "memory_long": Arm("gusts with memories of 1.5-5 s", memory=(1.5, 5.0)),
    "dryden": Arm("Dryden turbulence, MIL-F-8785C at 1.6 m in 3 m/s of wind", Air("dryden")),
    "one_minus_cosine": Arm("single 1-cosine gusts of 0.3-3 s", Air("one_minus_cosine")),
    "heavy_tails": Arm("gusts shaken by Student's t, 3 degrees of freedom", Air("heavy_tails")),
    "card_wrong": Arm("the card's noise half or twice the true one", card=(0.5, 2.0)),
    "no_card": Arm("no noise on the card", card=(None,)),
    "pose_only": Arm(
        "CoaX class, motion capture alone: 150 Hz, uneven clock, no noise on the card or the right",
        sensors=("pose",), card=(None, 1.0), craft="coax",
    ),
    "telemetry": Arm(
        "CoaX class, telemetry at 26 Hz with gaps, sensors shaken by the rotors, no noise on the card",
        sensors=("telemetry",), card=(None,), craft="coax",
    ),
    "drawn_vehicles": Arm("vehicles drawn between 0.05 and 5 kg", craft="drawn"),
    "spread_vehicles": Arm("a vehicle within its file's spread, not as it says", craft="spread"),
    "other_pilots": Arm("a stabiliser 30 ms late; a slow hand", pilots=("stabiliser", "slow_human")),
    "restless": Arm(
        "trims that drift, rotor speeds that jitter with their reaction on the body",
        GUSTY._replace(trim_thrust=0.002, trim_torque=0.003, jitter=0.5),
    ),
    "sizes_small": Arm("effects at 0.3 of their usual size", size=0.3),
    "sizes_large": Arm("effects at 3 times their usual size", size=3.0),
    "shedding": Arm("gusts with a frequency, 0.3-1.5 Hz, lightly damped", Air("shedding")),
    "broad": Arm("gusts with memories of 0.05, 0.4 and 3 s at once", Air("broad")),
    "fitful": Arm("gusts of a third and of twice the strength in turns of 1-6 s", Air("fitful")),
    "wandering": Arm("errors of the readings that last 1-10 s", sensors=("wandering",)),
    "coarse": Arm("readings in steps of two std of their noise", sensors=("coarse",)),
    "spiky": Arm("outliers of up to 12 std on 0.3 % of rows", sensors=("spiky",)),
    "smooth": Arm(
        "gyros and accelerometers behind low-passes: 20 Hz, first order; 35 and 25 Hz, second",
        sensors=("smooth", "autopilot"),
    ),
    "one_sided": Arm("gusts that come from one side, log-normal", Air("one_sided")),
    "together": Arm("gusts that push, turn and lift at once", Air("together")),
    "days": Arm("runs of a quarter to twice the gusts, and other memories", Air("days")),
    "flicker": Arm("errors of the readings equal in each decade of 0.03-30 s", sensors=("flicker",)),
    "common": Arm("gyros, accelerometers and attitudes with noise in common", sensors=("common",)),
    "fused": Arm("attitudes, velocities and height of an onboard filter", sensors=("fused",)),
    "stamped": Arm("logged times wrong by 2 ms", sensors=("stamped",)),
    "fast": Arm("gyros and accelerometers at 500 Hz", sensors=("fast",)),
    "two_hundred": Arm("200 rows a second of all sensors", sensors=("two_hundred",)),
    "pose_two_hundred": Arm(
        "CoaX class, a motion capture at 200 Hz", sensors=("pose_two_hundred",), craft="coax"
    ),
    "resampled": Arm("readings of 10-50 Hz on one clock by straight lines", sensors=("resampled",)),
    "held": Arm("readings of 10-50 Hz, each written again until the next", sensors=("held",)),
    "fifty": Arm("every second row of 100 Hz", sensors=("fifty",)),
    "twenty_five": Arm("every fourth row of 100 Hz", sensors=("twenty_five",)),
    "lab_twenty_five": Arm(
        "the same of a motion capture beside inertial sensors, in still air", STILL,
        sensors=("lab_twenty_five",),
    ),
    "pose_steadied": Arm(
        "CoaX class, a motion capture whose software smooths at 10 Hz, forwards and back",
        sensors=("pose_steadied",), card=(None, 1.0), craft="coax",
    ),
    "lab": Arm("poses of a motion capture with gyros and accelerometers", sensors=("lab",)),
    "inertial": Arm("gyros, accelerometers and a sonar alone", sensors=("inertial",)),
    "camera": Arm(
        "CoaX class, a camera: poses at 33 Hz, 3 mm and 0.6 degrees",
        sensors=("camera",), card=(None, 1.0), craft="coax",
    ),
    "filtered_speeds": Arm(
        "rotor speeds behind low-passes of 8 Hz, first order", sensors=("filtered_speeds",)
    ),
    "by_radio": Arm("a radio that loses 3 % of the commands", pilots=("by_radio",)),
    "by_steps": Arm("commands that arrive in steps of 4 mrad and 0.4 %", pilots=("by_steps",)),
    "mixed": Arm(
        "air, sensors, pilot, card and vehicle of all other arms at once, each drawn",
        sensors=(MIXED,), card=(1.0, 0.5, 2.0, None), pilots=tuple(PILOTS),
        mixed=("lama", "lama", "spread", "drawn"),
    ),
    "mixed_poses": Arm(
        "motion captures of any rate and fault; air, pilot, card and vehicle drawn as well",
        sensors=(MIXED_POSES,), card=(None, 1.0, 0.5, 2.0), pilots=tuple(PILOTS),
        mixed=("coax", "coax", "drawn"),
    ),
    "foreign_forms": Arm("effects in no list and of no generic term's form", listed=False),
}  # fmt: skip

SENSED = {
    "gyro_bias": "p", "accel_bias": "ax", "accel_scale": "ax", "imu_lever_arm": "ax",
    "imu_tilt": "ax", "vibration": "ax", "gyro_scale": "p", "frame_yaw": "pn", "marker_offset": "pn",
    "pose_delay": "pn", "position_spring": "pn",
}  # fmt: skip
"""Effects of one sensor, and a channel of it; without the sensor they are not hidden."""
ECHO = frozenset({"sonar_scale", "sonar_tilt", "sonar_delay"})
"""Effects of a sonar: not of the height of a pose."""
LEAST_SCALE = -0.6
"""Of a scale: three times the usual size could turn a time constant's sign."""


def plan_arms(
    arms: Sequence[str], clean: int, effects: int, seed: int = 0, first: int = 0
) -> list[PlannedFlight]:
    """The flights of some arms, evenly mixed so that a part of the study is a fair sample.

    Args:
        arms: keys of ARMS. clean: flights without an effect, per arm. effects: with some, per arm;
            two thirds have one, one sixth two, one sixth three. An arm of unlisted ones has no others.
        seed: the study's. first: number of the first flight of each kind; effects that stand alone,
            sensors, pilots and cards follow from the number, whatever the seed.
    """
    flights = [
        (position, planned(arm, kind, first + number, seed))
        for arm in arms
        for kind, count in counts(ARMS[arm], clean, effects).items()
        for number, position in enumerate((np.arange(count) + 0.5) / max(count, 1))
    ]
    order = {arm: i for i, arm in enumerate(arms)}
    flights.sort(key=lambda pair: (pair[0], pair[1].kind, order[pair[1].arm]))
    return [flight for _, flight in flights]


def counts(arm: Arm, clean: int, effects: int) -> dict[str, int]:
    """Flights of each kind."""
    if not arm.listed:
        return {"outside": clean + effects}
    more = effects // 6
    return {"clean": clean, "one": effects - 2 * more, "two": more, "three": more}


def named(text: str) -> list[str]:
    """Names of arms, by commas, or "all".

    Args:
        text: as typed.
    """
    names = list(ARMS) if text == "all" else [name for name in text.split(",") if name]
    unknown = sorted(set(names) - set(ARMS))
    if unknown:
        raise InputError(f"no arm {unknown[0]!r}: there are {', '.join(ARMS)}")
    return names


def planned(name: str, kind: str, number: int, seed: int) -> PlannedFlight:
    """One flight of an arm.

    Args:
        name: of the arm. kind: of the flight. number: within its kind. seed: the study's.
    """
    arm = ARMS[name]
    of_arm = zlib.crc32(name.encode())
    rng = np.random.default_rng([seed, of_arm, zlib.crc32(kind.encode()), number])
    sensors = _turn(arm.sensors, number)
    unseen = _unseen(sensors)
    effects = _hidden(kind, number, of_arm, unseen, rng)
    air = arm.air
    if arm.memory is not None:
        low, high = (float(np.log(bound)) for bound in arm.memory)
        force, moment = np.exp(rng.uniform(low, high, 2)).tolist()
        air = air._replace(memory=(force, moment))
    craft = arm.craft
    if arm.mixed:
        air, craft = _mixed(arm.mixed, rng)
    if air.gusts == "shedding":
        swings = np.exp(rng.uniform(np.log(0.3), np.log(1.5), 6)).tolist()
        air = air._replace(frequency=tuple(swings))
    return PlannedFlight(
        kind=kind,
        number=number,
        effects={e: _scaled(e, sizes_of(e, rng), arm.size) for e in effects},
        gusts=air.gusts != "none",
        sensors=sensors,
        seed=int(rng.integers(2**31)),
        runs=RICH,
        arm=name,
        air=air._asdict(),
        craft=craft,
        pilot=_turn(arm.pilots, number // len(arm.sensors)),
        card_noise=_turn(arm.card, number // len(arm.sensors)),
        longest=LONGEST,
    )


def _mixed(crafts: Sequence[str], rng: np.random.Generator) -> tuple[Air, str]:
    """Air of any kind, from a third to one and a half times as strong as usual, beside drifting trims
    and jittering rotors in two of five each; and a vehicle."""
    memory = np.exp(rng.uniform(np.log(0.05), np.log(4.0), 2)).tolist()
    strength = float(np.exp(rng.uniform(np.log(0.3), np.log(1.5))))
    air = Air(
        str(rng.choice(list(GUSTS))),
        *(strength * level for level in (GUSTY.force, GUSTY.moment_xy, GUSTY.moment_z)),
        memory=(memory[0], memory[1]),
        wind=float(rng.uniform(1.5, 5.0)),
    )
    if rng.random() < 0.4:
        air = air._replace(
            trim_thrust=float(rng.uniform(0.0, 0.002)), trim_torque=float(rng.uniform(0.0, 0.003))
        )
    if rng.random() < 0.4:
        air = air._replace(jitter=float(rng.uniform(0.0, 0.5)))
    return air, str(rng.choice(crafts))


def _turn(options: Sequence[T], number: int) -> T:
    return options[number % len(options)]


def _unseen(sensors: str) -> set[str]:
    """Effects of sensors that are not on board."""
    channels = kit(sensors, 0).noise
    blind = {effect for effect, channel in SENSED.items() if channel not in channels}
    return blind | (ECHO if "pn" in channels else set())


def _hidden(
    kind: str, number: int, of_arm: int, unseen: set[str], rng: np.random.Generator
) -> list[str]:
    if kind == "clean":
        return []
    if kind == "outside":
        return [_turn(FOREIGN, number)]
    if kind == "one":  # every effect in turn
        seen = [e for e in ALONE if e not in unseen]
        return [seen[np.random.default_rng(of_arm).permutation(len(seen))[number % len(seen)]]]
    return several(2 if kind == "two" else 3, rng, unseen)


def _scaled(effect: str, sizes: dict[str, float], factor: float) -> dict[str, float]:
    """Sizes times a factor; a scale never falls below LEAST_SCALE, and what is on or off stays."""
    if effect == "sonar_tilt":
        return sizes
    scaled = {p: factor * v for p, v in sizes.items()}
    return {p: max(v, LEAST_SCALE) if p in ("scale", "excess") else v for p, v in scaled.items()}
