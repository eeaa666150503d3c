"""What a cause means in flight: every effect of the catalogue in plain words, with numbers.

Each number comes with its unit and, to first order in the parameters' covariance, its 95 % interval.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.estimation.helicopter import UNUSUAL
from coax_env.model import effects
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import and_list, bounds, plain, title

Values = Mapping[str, float]

NORMAL_95 = 1.96
"""Stds on either side that hold 95 %."""

STEP = 1e-4  # of a parameter's usual size, for slopes
TURN = 90.0  # deg/s at which the damping of a turn is told
TILT = math.radians(15.0)  # at which the slant of a sonar is told
QUICKER = 1.05  # rotor speed at which the exponent of thrust is told, over that of hover


@dataclass(frozen=True)
class Consequence:
    """One number in words: ``"{} thrust at 0.25 m"``.

    of: the effect's own values and the vehicle's -> the number in `unit`. otherwise: the words where
    it is negative, in which it then stands without its sign. signed: with a plus where positive.
    direction: an angle around the compass, of which zero is no less than another.
    """

    words: str
    unit: str
    of: Callable[[Values, Values], float]
    otherwise: str = ""
    signed: bool = False
    direction: bool = False


@dataclass(frozen=True)
class Stated:
    """A consequence with its number: value in unit, half width of its 95 % interval, the words.

    shows: whether the interval leaves out zero.
    """

    value: float
    half: float
    unit: str
    words: str
    shows: bool


def _share(words: str, of: Callable[[Values, Values], float], otherwise: str = "") -> Consequence:
    """A share, told in per cent."""
    return Consequence(words, "%", lambda e, v: 100.0 * of(e, v), otherwise, signed=not otherwise)


def _own(words: str, unit: str, name: str, factor: float = 1.0, otherwise: str = "") -> Consequence:
    """A parameter itself, in a handier unit."""
    return Consequence(words, unit, lambda e, v: factor * e[name], otherwise)


def _axes(words: str, otherwise: str, unit: str, factor: float, **names: str) -> list[Consequence]:
    """One consequence per parameter; the words have ``AXIS`` where its name in `names` goes."""
    return [
        _own(words.replace("AXIS", name), unit, own, factor, otherwise.replace("AXIS", name))
        for own, name in names.items()
    ]


def _speeds_squared(v: Values) -> tuple[float, float]:
    """Of the upper and the lower rotor in hover [rad2/s2]: their torques cancel, (15)-(20)."""
    ratio = v["torque_coefficient_upper"] / v["torque_coefficient_lower"]
    k_T = v["air_density"] * math.pi * v["rotor_radius"] ** 4
    lift = v["thrust_coefficient_upper"] + ratio * v["thrust_coefficient_lower"]
    upper = v["mass"] * v["gravity"] / (k_T * lift)
    return upper, ratio * upper


def _drag_of_rotors(e: Values, v: Values) -> float:
    """Deceleration by the rotors' drag at 1 m/s [m/s2]."""
    return e["coefficient"] * sum(map(math.sqrt, _speeds_squared(v))) / v["mass"]


def _upper_share(v: Values) -> float:
    """Share of the thrust that the upper rotor carries in hover."""
    upper, lower = _speeds_squared(v)
    lift = v["thrust_coefficient_upper"] * upper
    return lift / (lift + v["thrust_coefficient_lower"] * lower)


def _ground(height: float) -> Callable[[Values, Values], float]:
    return lambda e, v: e["gain"] * math.exp(-e["decay"] * height / v["rotor_radius"])


def _left_turn(e: Values, v: Values) -> float:
    """Yaw acceleration at the bare model's trim, to the left [deg/s2]; (20) and (36)."""
    k_Q = v["air_density"] * math.pi * v["rotor_radius"] ** 5 * v["torque_coefficient_lower"]
    return math.degrees(e["scale"] * k_Q * _speeds_squared(v)[1] / v["inertia_zz"])


def _brake(axis: str) -> Callable[[Values, Values], float]:
    """Deceleration by the airframe's drag at 3 m/s along an axis [m/s2]."""
    return lambda e, v: 0.5 * v["air_density"] * e[f"area_{axis}"] * 9.0 / v["mass"]


def _slowed(inertia: str) -> Callable[[Values, Values], float]:
    return lambda e, v: e["coefficient"] / v[inertia] * TURN


def _hub(rotor: str, share: Callable[[Values], float]) -> Callable[[Values, Values], float]:
    """Moment of a hub's spring over that of its rotor's tilted thrust."""
    return lambda e, v: e[rotor] / (share(v) * v["mass"] * v["gravity"] * v[f"arm_{rotor}"])


def _towards(e: Values, v: Values) -> float:
    return math.degrees(math.atan2(e["east"], e["north"])) % 360.0


_CONSEQUENCES: dict[str, list[Consequence]] = {
    "added_mass": [
        _own("it weighs {} more than its file says", "g", "mass", 1000.0,
             "it weighs {} less than its file says"),
        _share("{} rotor speed to hover",
               lambda e, v: math.sqrt(max(1.0 + e["mass"] / v["mass"], 0.0)) - 1.0),
    ],
    "thrust_scale": [
        _share("{} thrust at the same rotor speeds", lambda e, v: e["scale"]),
        _share("{} rotor speed to hover", lambda e, v: 1.0 / math.sqrt(1.0 + e["scale"]) - 1.0),
    ],
    "torque_balance": [
        _share("{} torque on the lower rotor", lambda e, v: e["scale"]),
        Consequence("at the bare model's trim it begins to turn left at {}", "°/s²", _left_turn,
                    "at the bare model's trim it begins to turn right at {}"),
    ],
    "yaw_inertia": [
        _share("{} inertia in yaw", lambda e, v: e["scale"]),
        _share("{} yaw acceleration for the same torque", lambda e, v: 1.0 / (1.0 + e["scale"]) - 1),
    ],
    "swash_gain": [_share("{} tilt of the lower disc per command", lambda e, v: e["scale"])],
    "flybar_time_constant": [
        Consequence("the fly-bar follows in {}", "s",
                    lambda e, v: v["flybar_time_constant"] * (1.0 + e["scale"])),
        _share("{} following time", lambda e, v: e["scale"]),
    ],
    "motor_lag": [
        _own("the upper rotor follows its command in {}", "ms", "upper", 1000.0),
        _own("the lower in {}", "ms", "lower", 1000.0),
    ],
    "servo_lag": [_own("the swash plate follows its command in {}", "ms", "time", 1000.0)],
    "servo_delay": [_own("the swash plate moves {} after its command", "ms", "time", 1000.0)],
    "battery_sag": [
        _own("the rotors turn {} slower after a minute", "%", "rate", 6000.0),
        _share("{} thrust by then", lambda e, v: (1.0 - 60.0 * e["rate"]) ** 2 - 1.0),
    ],
    "wind": [
        Consequence("the air moves at {}", "m/s", lambda e, v: math.hypot(e["north"], e["east"])),
        Consequence("towards {} clockwise from north", "°", _towards, direction=True),
    ],
    "swash_phase": [
        _own("the swash plate is turned by {} about the mast", "°", "angle", math.degrees(1.0),
             "the swash plate is turned back by {} about the mast"),
        Consequence("{} of a tilt back goes to the right", "%",
                    lambda e, v: 100.0 * math.sin(e["angle"]), "{} of a tilt back goes to the left"),
    ],
    "swash_offset": [
        _own("the swash plate stands {} back at zero command", "°", "lon", math.degrees(1.0),
             "the swash plate stands {} forward at zero command"),
        _own("it stands {} to the right", "°", "lat", math.degrees(1.0),
             "it stands {} to the left"),
    ],
    "ground_effect": [
        _share("{} thrust at 0.25 m above the ground", _ground(0.25)),
        _share("{} at 0.5 m", _ground(0.5)),
    ],
    "axial_damping": [
        _share("{} thrust in a climb at 1 m/s", lambda e, v: -e["coefficient"]),
    ],
    "wake_interference": [
        _share("{} thrust of the lower rotor, in the wake of the upper",
               lambda e, v: -e["gain"] * _upper_share(v)),
    ],
    "thrust_exponent": [
        Consequence("thrust goes as rotor speed to the power {}", "",
                    lambda e, v: 2.0 + e["excess"]),
        _share("{} thrust at 5 % more than hover speed, beside what the square gives",
               lambda e, v: QUICKER ** e["excess"] - 1.0),
    ],
    "airframe_drag": [
        Consequence("the airframe brakes by {} forward at 3 m/s", "m/s²", _brake("x")),
        Consequence("by {} sideways", "m/s²", _brake("y")),
        Consequence("by {} up and down", "m/s²", _brake("z")),
    ],
    "rotor_drag": [
        Consequence("the rotors brake it by {} at 1 m/s", "m/s²", _drag_of_rotors),
    ],
    "flap_blowback": [
        _own("the lower disc tilts back by {} at 1 m/s", "°", "gain", math.degrees(1.0)),
    ],
    "yaw_damping": [
        Consequence(f"a turn at {TURN:g}°/s is braked by {{}}", "°/s²", _slowed("inertia_zz")),
    ],
    "rate_damping": [
        Consequence(f"rolling at {TURN:g}°/s is braked by {{}}", "°/s²", _slowed("inertia_xx")),
        Consequence("pitching by {}", "°/s²", _slowed("inertia_yy")),
    ],
    "cg_offset": [
        _own("the centre of gravity lies {} ahead of the mast", "mm", "x", 1000.0,
             "the centre of gravity lies {} behind the mast"),
        _own("{} to its right", "mm", "y", 1000.0, "{} to its left"),
    ],
    "hub_stiffness": [
        _share("{} moment per tilt of the lower disc", _hub("lower", lambda v: 1 - _upper_share(v))),
        _share("{} of the upper", _hub("upper", _upper_share)),
    ],
    "spin_up_reaction": [
        Consequence("{} of the torque that speeds a rotor up turns the body", "%",
                    lambda e, v: 100.0 * e["gain"]),
    ],
    "imu_lever_arm": [
        _own("the accelerometers sit {} ahead of the centre of gravity", "mm", "x", 1000.0,
             "the accelerometers sit {} behind the centre of gravity"),
        _own("{} to its right", "mm", "y", 1000.0, "{} to its left"),
        _own("{} below it", "mm", "z", 1000.0, "{} above it"),
    ],
    "imu_tilt": [
        Consequence("in a level hover the forward accelerometer reads {}", "m/s²",
                    lambda e, v: v["gravity"] * e["y"]),
        Consequence("the sideways one {}", "m/s²", lambda e, v: -v["gravity"] * e["x"]),
    ],
    "accel_scale": _axes("the AXIS accelerometer reads {} too high",
                         "the AXIS accelerometer reads {} too low", "%", 100.0,
                         x="forward", y="sideways", z="vertical"),
    "accel_bias": _axes("the AXIS accelerometer reads {} too high",
                        "the AXIS accelerometer reads {} too low", "m/s²", 1.0,
                        x="forward", y="sideways", z="vertical"),
    "gyro_bias": _axes("the AXIS gyro reads {} too high", "the AXIS gyro reads {} too low",
                       "°/s", math.degrees(1.0), x="roll", y="pitch", z="yaw"),
    "attitude_bias": _axes("AXIS reads {} too high", "AXIS reads {} too low",
                           "°", math.degrees(1.0), x="roll", y="pitch", z="heading"),
    "sonar_tilt": [
        _share("the height reads {} at 15° of tilt",
               lambda e, v: e["on"] * (1.0 / math.cos(TILT) - 1.0)),
    ],
    "sonar_scale": [_share("the height reads {}", lambda e, v: e["scale"])],
    "sonar_delay": [_own("the height reading is {} late", "ms", "time", 1000.0)],
    "vibration": [_own("the accelerometers shake by {} to either side", "m/s²", "amplitude")],
}  # fmt: skip


def consequences(
    effect: str, values: Values, covariance: np.ndarray, vehicle: Vehicle
) -> list[Stated]:
    """What an effect's values mean in flight, each number with its unit and 95 % interval.

    Args:
        values: parameter's own name (``gain``) -> value; absent ones are at their off-value.
        covariance: of `values`, in their order, (k, k).

    Returns nothing for an effect that has no words: a user's own.
    """
    known = effects.CATALOGUE[effect].parameters
    at = {p.name: p.off for p in known} | dict(values)
    usual = {p.name: p.usual for p in known}
    own = vehicle.values()
    result = []
    for told in _CONSEQUENCES.get(effect, ()):
        slope = np.array([_slope(told, at, own, name, STEP * usual[name]) for name in values])
        value = told.of(at, own)
        half = NORMAL_95 * math.sqrt(max(float(slope @ covariance @ slope), 0.0))
        turned = bool(told.otherwise) and value < 0.0
        text = bounds(abs(value) if turned else value, half, told.unit, told.signed)
        words = (told.otherwise if turned else told.words).format(text)
        shows = told.direction or abs(value) > half
        result.append(Stated(value, half, told.unit, words, shows))
    return result


def _slope(told: Consequence, at: Values, own: Values, name: str, step: float) -> float:
    """Change of a consequence's number per unit of a parameter."""
    ends = [told.of({**at, name: at[name] + side * step}, own) for side in (-1.0, 1.0)]
    change = ends[1] - ends[0]
    if told.direction:
        change = math.remainder(change, 360.0)
    return change / (2.0 * step)


def sigmas(evidence: float) -> float:
    """Evidence [nats] as the standard deviations at which one number would bring as much."""
    return math.sqrt(2.0 * max(evidence, 0.0))


def covariance_of(cause: Mapping[str, Any], vehicle: Vehicle) -> np.ndarray:
    """Covariance of a cause's parameters (k, k): its own std, correlated as in a vehicle's file."""
    names = list(cause["parameters"])
    std = np.array([p["std"] for p in cause["parameters"].values()])
    correlation = np.eye(len(names))
    if vehicle.correlation is not None and set(names) <= set(vehicle.correlated):
        place = [vehicle.correlated.index(n) for n in names]
        correlation = vehicle.correlation[np.ix_(place, place)]
    return std[:, None] * correlation * std


def told(cause: Mapping[str, Any], before: Vehicle, after: Vehicle) -> str:
    """What a cause of findings.json means in flight: words with numbers; empty for an unknown one.

    Of several numbers those whose interval leaves out zero; the first where none does.

    before, after: the vehicle as given and the extended one.
    """
    effect = cause["effect"]
    if effect not in effects.CATALOGUE:
        return ""
    values = {name.rpartition(".")[2]: p["value"] for name, p in cause["parameters"].items()}
    stated = consequences(effect, values, covariance_of(cause, after), before)
    telling = [s for s in stated if s.shows] or stated[:1]
    return ", ".join(s.words for s in telling)


def sentence(cause: Mapping[str, Any], before: Vehicle, after: Vehicle) -> str:
    """A cause in one sentence: name, what it does, how sure that is, what it may be taken for."""
    meaning = told(cause, before, after) or "named"
    twins = [plain(t) for t in cause["confusable_with"]]
    doubt = (
        f"these flights cannot tell it from {and_list(twins)}"
        if twins
        else "cannot be mistaken on these flights"
    )
    return f"{title(cause['effect'])}: {meaning}; {sigmas(cause['evidence']):.0f} sigma; {doubt}."


def outside_usual(effect: str, values: Values) -> bool:
    """Whether a value is beyond UNUSUAL times its usual size, or has no meaning."""
    known = {p.name: p for p in effects.CATALOGUE[effect].parameters}
    return any(
        name in known
        and not known[name].shape
        and (
            abs(value - known[name].off) > UNUSUAL * known[name].usual
            or not known[name].lower <= value <= known[name].upper
        )
        for name, value in values.items()
    )
