"""Numbers and effects in words that a colleague who was not there understands."""

import math
import re
from collections.abc import Callable, Mapping

from coax_env import effects
from coax_env.heli_model import UNUSUAL
from coax_env.vehicle import Vehicle

Values = Mapping[str, float]

CHANNEL_NAMES = {
    "rpm_upper": "upper rotor speed", "rpm_lower": "lower rotor speed",
    "p": "roll rate", "q": "pitch rate", "r": "yaw rate",
    "ax": "forward acceleration", "ay": "sideways acceleration", "az": "vertical acceleration",
    "phi": "roll", "theta": "pitch", "psi": "heading", "h": "height",
    "vn": "velocity north", "ve": "velocity east", "vd": "velocity down",
    "pn": "position north", "pe": "position east", "v": "speed",
}  # fmt: skip

UNITS = {"m/s2": "m/s²", "kg m2": "kg m²", "m2": "m²", "1": "", "N m": "N m", "rev/min": "rpm"}


def plain(name: str) -> str:
    """``ground_effect`` as ``ground effect``, ``imu_tilt`` as ``IMU tilt``."""
    words = name.replace(".", " ").replace("_", " ")
    return re.sub(r"\b(imu|cg)\b", lambda m: m.group().upper(), words)


def title(name: str) -> str:
    """``ground_effect`` as ``Ground effect``."""
    return capital(plain(name))


def capital(text: str) -> str:
    """With a capital first letter, the rest as it is."""
    return text[:1].upper() + text[1:]


def channel_name(channel: str) -> str:
    """``h`` as ``height``; a name that is no channel as it is."""
    return CHANNEL_NAMES.get(channel, channel)


def unit_name(unit: str) -> str:
    """``m/s2`` as ``m/s²``."""
    return UNITS.get(unit, unit)


def seconds(time: float) -> str:
    """``1 s``, ``0.5 s``."""
    return f"{time:g} s"


def and_list(words: list[str]) -> str:
    """``a, b and c``."""
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]


def number(value: float | None, digits: int = 3) -> str:
    """A number to so many significant digits, with a real minus; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    size = math.floor(math.log10(abs(value)))
    if -4 <= size < 6:
        text = f"{value:.{max(digits - 1 - size, 0)}f}"
    else:
        text = f"{value:.{digits - 1}e}"
    return text.replace("-", "−")


def with_std(value: float, std: float | None, unit: str) -> str:
    """``0.50 ± 0.02 m``, both to the place of the std's second digit."""
    shown = UNITS.get(unit, unit)
    if not std or not math.isfinite(std):
        return f"{number(value)} {shown}".strip()
    place = max(1 - math.floor(math.log10(abs(std))), 0)
    if place > 5:
        power = math.floor(math.log10(max(abs(value), std)))
        scale = 10.0**-power
        return f"({value * scale:.2f} ± {std * scale:.2f})·10^{power} {shown}".replace(
            "-", "−"
        ).strip()
    return f"{value:.{place}f} ± {std:.{place}f} {shown}".replace("-", "−").strip()


def whole_percent(value: float | None) -> str:
    """``71 %`` from 71.2; a dash for none."""
    return "–" if value is None else f"{round(value) + 0:d} %".replace("-", "−")


def percent(share: float) -> str:
    """``+9 %``."""
    return f"{100.0 * share:+.{0 if abs(share) >= 0.095 else 1}f} %".replace("-", "−")


def _deg(radians: float) -> str:
    return number(math.degrees(radians), 2) + "°"


def _ms(seconds: float) -> str:
    return f"{1000.0 * seconds:.0f} ms"


def _sides(x: float, y: float, show: Callable[[float], str]) -> str:
    forward = f"{show(abs(x))} {'forward' if x > 0 else 'back'}"
    right = f"{show(abs(y))} to the {'right' if y > 0 else 'left'}"
    return f"{forward}, {right}"


def _wind(e: Values, v: Values) -> str:
    towards = math.degrees(math.atan2(e["east"], e["north"])) % 360.0
    speed = math.hypot(e["north"], e["east"])
    return f"the air moves at {number(speed, 2)} m/s towards {towards:.0f}° (0° is north)"


def _ground(e: Values, v: Values) -> str:
    rise = [e["gain"] * math.exp(-e["decay"] * h / v["rotor_radius"]) for h in (0.25, 0.5)]
    return f"{percent(rise[0])} thrust at 0.25 m, {percent(rise[1])} at 0.5 m"


def _rotor_drag(e: Values, v: Values) -> str:
    k = e["coefficient"] * 2.0 * _hover_speed(v)
    return f"brakes by {number(k / v['mass'], 2)} m/s² at 1 m/s sideways or forward"


def _hover_speed(v: Values) -> float:
    k_T = v["air_density"] * math.pi * v["rotor_radius"] ** 4
    lift = v["thrust_coefficient_upper"] + v["thrust_coefficient_lower"]
    return math.sqrt(v["mass"] * v["gravity"] / (k_T * lift))


def _airframe(e: Values, v: Values) -> str:
    brake = [0.5 * v["air_density"] * e[f"area_{a}"] * 9.0 / v["mass"] for a in "xyz"]
    return f"brakes by {', '.join(number(b, 2) for b in brake)} m/s² (x, y, z) at 3 m/s"


def _hub(e: Values, v: Values) -> str:
    thrust = 0.5 * v["mass"] * v["gravity"]
    share = e["lower"] / (thrust * v["arm_lower"])
    return f"the lower hub adds {percent(share)} to the moment of its thrust"


_CONSEQUENCES: dict[str, Callable[[Values, Values], str]] = {
    "ground_effect": _ground,
    "axial_damping": lambda e, v: f"{percent(-e['coefficient'])} thrust in a climb at 1 m/s",
    "rotor_drag": _rotor_drag,
    "airframe_drag": _airframe,
    "wind": _wind,
    "hub_stiffness": _hub,
    "motor_lag": lambda e, v: (
        f"the upper rotor follows in {_ms(e['upper'])}, the lower in {_ms(e['lower'])}"
    ),
    "servo_lag": lambda e, v: f"the swash plate follows in {_ms(e['time'])}",
    "servo_delay": lambda e, v: f"the swash plate moves {_ms(e['time'])} late",
    "swash_offset": lambda e, v: (
        f"the plate stands {_deg(e['lon'])} back and {_deg(e['lat'])} right at zero command"
    ),
    "swash_phase": lambda e, v: f"the plate is turned by {_deg(e['angle'])} about the mast",
    "swash_gain": lambda e, v: f"{percent(e['scale'])} disc tilt per command",
    "cg_offset": lambda e, v: (
        "the centre of gravity lies " + _sides(e["x"], e["y"], lambda m: f"{1000 * m:.1f} mm")
    ),
    "added_mass": lambda e, v: f"{1000 * e['mass']:.0f} g more than the vehicle file says",
    "thrust_scale": lambda e, v: f"{percent(e['scale'])} thrust on both rotors",
    "torque_balance": lambda e, v: f"{percent(e['scale'])} torque on the lower rotor",
    "yaw_inertia": lambda e, v: f"{percent(e['scale'])} inertia in yaw",
    "flybar_time_constant": lambda e, v: (
        f"the fly-bar follows in {number(v['flybar_time_constant'] * (1 + e['scale']), 2)} s"
    ),
    "yaw_damping": lambda e, v: (
        f"yaw dies out in {number(v['inertia_zz'] / e['coefficient'], 2)} s"
        if e["coefficient"]
        else ""
    ),
    "flap_blowback": lambda e, v: f"the lower disc tilts {_deg(e['gain'])} back per m/s",
    "wake_interference": lambda e, v: (
        f"the lower rotor loses about {percent(-0.55 * e['gain']).lstrip('−')} of its thrust"
    ),
    "spin_up_reaction": lambda e, v: (
        f"{number(e['gain'], 2)} of the rotors' acceleration torque reaches the body"
    ),
    "battery_sag": lambda e, v: f"rotor speed falls by {number(6000 * e['rate'], 2)} % a minute",
    "gyro_bias": lambda e, v: (
        "the gyros add "
        + ", ".join(f"{_deg(e[a])}/s to {c}" for c, a in zip("pqr", "xyz", strict=True))
    ),
    "accel_bias": lambda e, v: (
        "the accelerometers add " + ", ".join(f"{number(e[a], 2)} m/s² to a{a}" for a in "xyz")
    ),
    "attitude_bias": lambda e, v: (
        f"the attitude reads off by: roll {_deg(e['x'])}, pitch {_deg(e['y'])}, heading {_deg(e['z'])}"
    ),
    "imu_lever_arm": lambda e, v: (
        ", ".join(f"{a} {1000 * e[a]:.0f} mm" for a in "xyz") + " off the centre of gravity"
    ),
    "sonar_delay": lambda e, v: f"the height reading is {_ms(e['time'])} late",
    "sonar_scale": lambda e, v: f"the height reads {percent(e['scale'])}",
    "vibration": lambda e, v: f"the accelerometers shake by ±{number(e['amplitude'])} m/s²",
}
"""Effect -> what its values mean, from its own values and the vehicle's."""


def consequence(effect: str, values: Values, vehicle: Vehicle) -> str:
    """What an effect's values mean in flight, in a few words; empty where there is no phrase.

    Args:
        values: parameter's own name (``gain``) -> value; absent ones are at their off-value.
    """
    if effect not in _CONSEQUENCES:
        return ""
    own = {p.name: p.off for p in effects.CATALOGUE[effect].parameters} | dict(values)
    return _CONSEQUENCES[effect](own, vehicle.values())


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
