"""What each effect of the catalogue means in flight: words, and the formula of their number."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

Values = Mapping[str, float]
"""Parameter -> value, SI."""
Formula = Callable[[Values, Values], float]
"""The effect's own values and the vehicle's -> a number."""

TURN_RATE = 90.0  # deg/s at which the damping of a turn is given
SONAR_TILT = math.radians(15.0)  # at which the slant of a sonar is given
OVERSPEED = 1.05  # rotor speed over that of hover at which the exponent of thrust is given


@dataclass(frozen=True)
class Consequence:
    """One number in words.

    Attributes:
        words: ``"{} thrust at 0.25 m"``; the number with its unit stands for the braces.
        unit: of the number.
        compute: the number.
        words_if_negative: the words where it is negative, in which it then stands without its sign.
        signed: written with a plus where positive.
        direction: an angle around the compass, of which zero is no less than another.
    """

    words: str
    unit: str
    compute: Formula
    words_if_negative: str = ""
    signed: bool = False
    direction: bool = False


def _share(words: str, share: Formula) -> Consequence:
    """A share, in per cent with its sign."""
    return Consequence(words, "%", lambda e, v: 100.0 * share(e, v), signed=True)


def _own(words: str, unit: str, name: str, factor: float = 1.0, negative: str = "") -> Consequence:
    """A parameter itself, in a handier unit."""
    return Consequence(words, unit, lambda e, v: factor * e[name], negative)


def _axes(words: str, negative: str, unit: str, factor: float, **names: str) -> list[Consequence]:
    """One consequence per parameter; the words have ``AXIS`` where its name in `names` goes."""
    return [
        _own(words.replace("AXIS", name), unit, own, factor, negative.replace("AXIS", name))
        for own, name in names.items()
    ]


def _hover_speeds_squared(v: Values) -> tuple[float, float]:
    """Squared speeds of the upper and lower rotor in hover [rad2/s2]: torques cancel, (15)-(20)."""
    ratio = v["torque_coefficient_upper"] / v["torque_coefficient_lower"]
    k_T = v["air_density"] * math.pi * v["rotor_radius"] ** 4
    lift = v["thrust_coefficient_upper"] + ratio * v["thrust_coefficient_lower"]
    upper = v["mass"] * v["gravity"] / (k_T * lift)
    return upper, ratio * upper


def _rotor_deceleration(e: Values, v: Values) -> float:
    """Deceleration by the rotors' drag at 1 m/s [m/s2]."""
    return e["coefficient"] * sum(map(math.sqrt, _hover_speeds_squared(v))) / v["mass"]


def _upper_thrust_share(v: Values) -> float:
    """Share of the thrust that the upper rotor carries in hover."""
    upper, lower = _hover_speeds_squared(v)
    lift = v["thrust_coefficient_upper"] * upper
    return lift / (lift + v["thrust_coefficient_lower"] * lower)


def _ground_effect(height: float) -> Formula:
    """Share by which the ground raises the thrust at a height [m]."""
    return lambda e, v: e["gain"] * math.exp(-e["decay"] * height / v["rotor_radius"])


def _yaw_acceleration(e: Values, v: Values) -> float:
    """Yaw acceleration at the bare model's trim, to the left [deg/s2]; (20) and (36)."""
    k_Q = v["air_density"] * math.pi * v["rotor_radius"] ** 5 * v["torque_coefficient_lower"]
    return math.degrees(e["scale"] * k_Q * _hover_speeds_squared(v)[1] / v["inertia_zz"])


def _airframe_deceleration(axis: str) -> Formula:
    """Deceleration by the airframe's drag at 3 m/s along an axis [m/s2]."""
    return lambda e, v: 0.5 * v["air_density"] * e[f"area_{axis}"] * 9.0 / v["mass"]


def _turn_damping(inertia: str) -> Formula:
    """Deceleration by a damping at TURN_RATE about the axis of an inertia [deg/s2]."""
    return lambda e, v: e["coefficient"] / v[inertia] * TURN_RATE


def _hub_moment_share(rotor: str, share: Callable[[Values], float]) -> Formula:
    """Moment of a hub's spring over that of its rotor's tilted thrust."""
    return lambda e, v: e[rotor] / (share(v) * v["mass"] * v["gravity"] * v[f"arm_{rotor}"])


def _wind_course(e: Values, v: Values) -> float:
    """Where the wind blows to, clockwise from north [deg]."""
    return math.degrees(math.atan2(e["east"], e["north"])) % 360.0


CONSEQUENCES: dict[str, list[Consequence]] = {
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
        Consequence("at the bare model's trim it begins to turn left at {}", "°/s²",
                    _yaw_acceleration, "at the bare model's trim it begins to turn right at {}"),
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
    "battery_voltage": [
        _own("the rotors turn {} slower per volt below the nominal", "%", "per_volt", 100.0),
        _share("{} thrust one volt below it", lambda e, v: (1.0 - e["per_volt"]) ** 2 - 1.0),
    ],
    "command_delay": [
        _own("rotors and swash plate answer {} after their command", "ms", "time", 1000.0),
    ],
    "motor_droop": [
        _own("the upper rotor leaves out {} of a change of its speed command", "%", "upper", 100.0),
        _own("the lower {}", "%", "lower", 100.0),
    ],
    "servo_play": [
        _own("the swash plate has {} of play about its command", "°", "width", math.degrees(1.0)),
    ],
    "servo_deadband": [
        _own("the swash plate does not answer a change below {}", "°", "width", math.degrees(1.0)),
    ],
    "servo_rate": [
        _own("the swash plate tilts no faster than {}", "°/s", "limit", math.degrees(1.0)),
        Consequence("it takes {} for a step of 5°", "ms",
                    lambda e, v: 1000.0 * math.radians(5.0) / e["limit"]),
    ],
    "wind": [
        Consequence("the air moves at {}", "m/s", lambda e, v: math.hypot(e["north"], e["east"])),
        Consequence("towards {} clockwise from north", "°", _wind_course, direction=True),
    ],
    "swash_phase": [
        _own("the swash plate is turned by {} about the mast", "°", "angle", math.degrees(1.0),
             "the swash plate is turned back by {} about the mast"),
        Consequence("{} of a tilt back goes to the right", "%",
                    lambda e, v: 100.0 * math.sin(e["angle"]), "{} of a tilt back goes to the left"),
        _own("by {} more at 100 rpm more of the lower rotor", "°", "per_rpm", 100.0 * math.degrees(1.0),
             "by {} less at 100 rpm more of the lower rotor"),
    ],
    "swash_offset": [
        _own("the swash plate stands {} back at zero command", "°", "lon", math.degrees(1.0),
             "the swash plate stands {} forward at zero command"),
        _own("it stands {} to the right", "°", "lat", math.degrees(1.0),
             "it stands {} to the left"),
    ],
    "ground_effect": [
        _share("{} thrust at 0.25 m above the ground", _ground_effect(0.25)),
        _share("{} at 0.5 m", _ground_effect(0.5)),
    ],
    "axial_damping": [
        _share("{} thrust in a climb at 1 m/s", lambda e, v: -e["coefficient"]),
    ],
    "wake_interference": [
        _share("{} thrust of the lower rotor, in the wake of the upper",
               lambda e, v: -e["gain"] * _upper_thrust_share(v)),
    ],
    "dynamic_inflow": [
        _own("the inflow follows a change of rotor speed in {}", "ms", "time", 1000.0),
    ],
    "thrust_exponent": [
        Consequence("thrust goes as rotor speed to the power {}", "",
                    lambda e, v: 2.0 + e["excess"]),
        _share("{} thrust at 5 % more than hover speed, beside what the square gives",
               lambda e, v: OVERSPEED ** e["excess"] - 1.0),
    ],
    "airframe_drag": [
        Consequence("the airframe brakes by {} forward at 3 m/s", "m/s²", _airframe_deceleration("x")),
        Consequence("by {} sideways", "m/s²", _airframe_deceleration("y")),
        Consequence("by {} up and down", "m/s²", _airframe_deceleration("z")),
    ],
    "rotor_drag": [
        Consequence("the rotors brake it by {} at 1 m/s", "m/s²", _rotor_deceleration),
    ],
    "flap_blowback": [
        _own("the lower disc tilts back by {} at 1 m/s", "°", "gain", math.degrees(1.0)),
    ],
    "upper_blowback": [
        _own("the upper disc tilts back by {} at 1 m/s", "°", "gain", math.degrees(1.0)),
    ],
    "gyroscopic_coupling": [
        Consequence("{} of the body's own gyroscopic moment acts on it", "%",
                    lambda e, v: 100.0 * e["gain"]),
    ],
    "position_spring": [
        Consequence("a metre beside its anchor it is pulled back by {}", "m/s²",
                    lambda e, v: e["stiffness"] / v["mass"]),
        _own("the anchor lies {} north of the origin", "mm", "north", 1000.0,
             "the anchor lies {} south of the origin"),
        _own("{} east of it", "mm", "east", 1000.0, "{} west of it"),
    ],
    "yaw_damping": [
        Consequence(f"a turn at {TURN_RATE:g}°/s is braked by {{}}", "°/s²",
                    _turn_damping("inertia_zz")),
    ],
    "rate_damping": [
        Consequence(f"rolling at {TURN_RATE:g}°/s is braked by {{}}", "°/s²",
                    _turn_damping("inertia_xx")),
        Consequence("pitching by {}", "°/s²", _turn_damping("inertia_yy")),
    ],
    "cg_offset": [
        _own("the centre of gravity lies {} ahead of the mast", "mm", "x", 1000.0,
             "the centre of gravity lies {} behind the mast"),
        _own("{} to its right", "mm", "y", 1000.0, "{} to its left"),
    ],
    "hub_stiffness": [
        _share("{} moment per tilt of the lower disc",
               _hub_moment_share("lower", lambda v: 1 - _upper_thrust_share(v))),
        _share("{} of the upper", _hub_moment_share("upper", _upper_thrust_share)),
    ],
    "spin_up_reaction": [
        Consequence("{} of the torque that speeds a rotor up turns the body", "%",
                    lambda e, v: 100.0 * e["gain"]),
    ],
    "pose_delay": [_own("position and attitude readings are {} late", "ms", "time", 1000.0)],
    "attitude_delay": [_own("the attitude readings are {} late", "ms", "time", 1000.0)],
    "marker_offset": [
        _own("the tracked point lies {} ahead of the centre of gravity", "mm", "x", 1000.0,
             "the tracked point lies {} behind the centre of gravity"),
        _own("{} to its right", "mm", "y", 1000.0, "{} to its left"),
        _own("{} below it", "mm", "z", 1000.0, "{} above it"),
    ],
    "frame_yaw": [
        _own("the markers' axes are turned by {} to the right about the mast", "°", "angle",
             math.degrees(1.0), "the markers' axes are turned by {} to the left about the mast"),
    ],
    "magnetic_field": [
        Consequence("as it turns, the heading reads up to {} too high and too low", "°",
                    lambda e, v: math.degrees(math.asin(min(math.hypot(e["x"], e["y"]), 1.0)))),
    ],
    "gyro_scale": _axes("the AXIS gyro reads {} too high", "the AXIS gyro reads {} too low",
                        "%", 100.0, x="roll", y="pitch", z="yaw"),
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
               lambda e, v: e["on"] * (1.0 / math.cos(SONAR_TILT) - 1.0)),
    ],
    "sonar_scale": [_share("the height reads {}", lambda e, v: e["scale"])],
    "sonar_delay": [_own("the height reading is {} late", "ms", "time", 1000.0)],
    "vibration": [_own("the accelerometers shake by {} to either side", "m/s²", "amplitude")],
}  # fmt: skip
