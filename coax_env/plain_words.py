"""Numbers and names in words that a colleague who was not there understands."""

import math
import re

CHANNEL_NAMES = {
    "rpm_upper": "upper rotor speed", "rpm_lower": "lower rotor speed",
    "p": "roll rate", "q": "pitch rate", "r": "yaw rate",
    "ax": "forward acceleration", "ay": "sideways acceleration", "az": "vertical acceleration",
    "phi": "roll", "theta": "pitch", "psi": "heading", "h": "height",
    "vn": "velocity north", "ve": "velocity east", "vd": "velocity down",
    "pn": "position north", "pe": "position east", "v": "speed",
}  # fmt: skip

UNITS = {
    "m/s2": "m/s²", "kg m2": "kg m²", "m2": "m²", "1": "", "rev/min": "rpm",
    "rad": "°", "rad/s": "°/s",
}  # fmt: skip
"""Units as files have them -> as they are read; angles and rates in degrees, see `read_factor`."""


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
    """``m/s2`` as ``m/s²``, ``rad`` as ``°``."""
    return UNITS.get(unit, unit)


def read_factor(unit: str) -> float:
    """What a number in a file's unit is multiplied by to be in `unit_name`'s: 57.3 for angles."""
    return math.degrees(1.0) if unit in ("rad", "rad/s") else 1.0


def with_unit(value: float | None, unit: str, digits: int = 3) -> str:
    """``0.30 m/s²``; an angle of 0.1 rad as ``5.73°``; a dash for none.

    Args:
        value: in `unit`.
        unit: as vehicle files write it, ``"m/s2"``.
        digits: significant ones.
    """
    if value is None or not math.isfinite(value):
        return number(None)
    return _joined(number_in(value, unit, digits), unit_name(unit))


def number_in(value: float | None, unit: str, digits: int = 3) -> str:
    """The number of `with_unit` alone, for where the unit stands elsewhere; arguments as there."""
    return number(None if value is None else read_factor(unit) * value, digits)


def _joined(text: str, shown: str) -> str:
    """A number and its unit: no space before the sign of a degree."""
    return f"{text}{shown}" if shown.startswith("°") else f"{text} {shown}".strip()


def seconds(time: float) -> str:
    """``1 s``, ``0.5 s``."""
    return f"{time:g} s"


def and_list(words: list[str]) -> str:
    """``a, b and c``."""
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]


def count_word(count: int) -> str:
    """``nine``; in digits from 13."""
    return _COUNTS[count] if count < len(_COUNTS) else str(count)


_COUNTS = (
    "no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven",
    "twelve",
)  # fmt: skip


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
    """``0.50 ± 0.02 m``, both to the place of the std's second digit.

    Args:
        value: the number, in `unit`.
        std: its standard deviation in the same unit; 0, None or not finite: the number alone.
        unit: as vehicle files write it, ``"m/s2"``.
    """
    shown = unit_name(unit)
    if not std or not math.isfinite(std):
        return with_unit(value, unit)
    value, std = read_factor(unit) * value, read_factor(unit) * std
    place = max(1 - math.floor(math.log10(abs(std))), 0)
    if place > 5:
        power = math.floor(math.log10(max(abs(value), std)))
        scale = 10.0**-power
        text = f"({value * scale:.2f} ± {std * scale:.2f})·10^{power}"
    else:
        text = f"{value:.{place}f} ± {std:.{place}f}"
    return _joined(text.replace("-", "−"), shown)


def whole_percent(value: float | None) -> str:
    """``71 %`` from 71.2; a dash for none."""
    return "–" if value is None else f"{round(value) + 0:d} %".replace("-", "−")


def error_change(removed: float | None, error: str = "the error", mark: str = "") -> str:
    """``71 % of the error is gone``; below zero, ``the error is 16 % larger``.

    Args:
        removed: share of it [%]. error: what it is the error of. mark: about the number.
    """
    if removed is not None and round(removed) < 0:
        return f"{error} is {mark}{whole_percent(-removed)}{mark} larger"
    return f"{mark}{whole_percent(removed)}{mark} of {error} is gone"


def bounds(value: float, half: float, unit: str, signed: bool = False) -> str:
    """``+9.0 % (8.5 to 9.6)``: a number with its interval, to the last place that the interval fixes.

    Args:
        value: the number, in `unit`.
        half: half of the interval's width; 0 where the number is exact.
        unit: as vehicle files write it, ``"m/s2"``.
        signed: with a plus where positive.
    """
    value, half = read_factor(unit) * value, read_factor(unit) * half
    shown = unit_name(unit)
    if not half or not math.isfinite(half):
        plus = "+" if signed and value > 0.0 else ""
        return _joined(f"{plus}{number(value)}", shown)
    power = math.floor(math.log10(half))
    place = max(-power if half >= 3.0 * 10.0**power else 1 - power, 0)
    ends = f"({_to_place(value - half, place)} to {_to_place(value + half, place)})"
    return f"{_joined(_to_place(value, place, signed), shown)} {ends}"


def _to_place(value: float, place: int, signed: bool = False) -> str:
    rounded = round(value, place) + 0.0  # no minus before a zero
    return f"{rounded:{'+' if signed and rounded else ''}.{place}f}".replace("-", "−")
