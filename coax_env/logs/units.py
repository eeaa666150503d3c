"""Units a flight log may come in, and the factor to the canonical one.

A channel has a dimension; a unit is looked up within it, so that rad/s may mean a gyro or a rotor.
"""

from math import pi

from coax_env.errors import InputError
from coax_env.model.layout import CHANNEL_UNITS

STANDARD_GRAVITY = 9.80665
"""What accelerometers call one g [m/s2], whatever the local gravity."""

ROTOR_COMMANDS = ("rpm_upper_cmd", "rpm_lower_cmd")
SWASH_COMMANDS = ("delta_lon", "delta_lat")


def without(command: str) -> str:
    """Under which the runs of a flight are counted that have no such command."""
    return f"runs without {command}, taken as 0"


BATTERY = "battery_v"
"""Battery voltage: no reading of the model's, but what drives the rotors."""

LOG_UNITS: dict[str, str] = {
    "t": "s",
    **dict.fromkeys(ROTOR_COMMANDS, "rev/min"),
    **dict.fromkeys(SWASH_COMMANDS, "rad"),
    BATTERY: "V",
    **CHANNEL_UNITS,
}
"""Canonical unit of every column a flight can have."""

PLACES: dict[str, str] = {"lat": "pn", "lon": "pe"}
"""Latitude and longitude, which a card may name -> the channel that they are in place of."""
PLACE_UNITS: dict[str, str] = dict.fromkeys(PLACES, "deg")
"""Canonical unit of each."""

_RPM = 30.0 / pi
_LENGTH = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "in": 0.0254}

# dimension (named by its canonical unit) -> unit -> factor to the canonical unit
_FACTORS: dict[str, dict[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0},
    "rev/min": {
        "rev/min": 1.0, "rpm": 1.0, "1/min": 1.0, "rev/s": 60.0, "hz": 60.0, "1/s": 60.0,
        "rad/s": _RPM, "deg/s": 1.0 / 6.0,
    },
    "rad": {
        "rad": 1.0, "mrad": 1e-3, "deg": pi / 180.0, "degree": pi / 180.0, "degrees": pi / 180.0,
        "°": pi / 180.0, "rev": 2.0 * pi,
    },
    "rad/s": {
        "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": pi / 180.0, "dps": pi / 180.0, "°/s": pi / 180.0,
        "rev/min": 1.0 / _RPM, "rpm": 1.0 / _RPM,
    },
    "m/s2": {
        **{f"{unit}/s2": factor for unit, factor in _LENGTH.items()},
        "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY,
    },
    "m": _LENGTH,
    "deg": {"deg": 1.0, "degree": 1.0, "degrees": 1.0, "°": 1.0, "rad": 180.0 / pi, "1e-7deg": 1e-7},
    "V": {"v": 1.0, "mv": 1e-3, "volt": 1.0, "volts": 1.0},
    "m/s": {
        **{f"{unit}/s": factor for unit, factor in _LENGTH.items()},
        "km/h": 1.0 / 3.6, "kph": 1.0 / 3.6, "kmh": 1.0 / 3.6, "mph": 0.44704, "ft/min": 0.00508,
        "kt": 1852.0 / 3600.0, "kn": 1852.0 / 3600.0, "knot": 1852.0 / 3600.0,
        "knots": 1852.0 / 3600.0, "kts": 1852.0 / 3600.0,
    },
}  # fmt: skip


def factor_to_canonical(channel: str, unit: str) -> float:
    """What a reading in ``unit`` is multiplied by to be in the channel's canonical unit.

    Raises:
        InputError: the unit is unknown, or measures something else than this channel.
    """
    canonical = LOG_UNITS.get(channel) or PLACE_UNITS[channel]
    known = _FACTORS[canonical]
    plain = unit.strip().lower().replace(" ", "").replace("²", "2").replace("^", "")
    plain = plain.replace("sec", "s").replace("**", "").replace("s-2", "s2")
    if plain not in known:
        if any(plain in units for units in _FACTORS.values()):
            raise InputError(f"channel {channel}: unit {unit!r} is no unit for it, {canonical} is")
        raise InputError(f"channel {channel}: unknown unit {unit!r}; known: {', '.join(known)}")
    return known[plain]


def units_of(channel: str) -> dict[str, float]:
    """Units that a channel may come in, and the factor of each to its own."""
    return dict(_FACTORS[LOG_UNITS[channel]])
