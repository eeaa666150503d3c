"""Units and signs, by what must hold of two channels and of hover."""

import math

import numpy as np

from coax_env.logs.flight import Flight, Run
from coax_env.logs.units import LOG_UNITS, ROTOR_COMMANDS, unit_that_makes
from coax_env.model.dynamics import hover_trim
from coax_env.model.layout import ANGLES, RPM_PER_RAD_S
from coax_env.model.vehicle import Vehicle

LEAST_CORRELATION = 0.95
"""Correlation above which two channels are one quantity and its rate, in any units; ours."""
WINDOW = 1.0  # [s] over which a rate is summed: long beside its noise, short beside a maneuver
FEWEST_WINDOWS = 12  # that a correlation is taken of; ours
RATIOS_TAKEN_FOR_ONE = (0.7, 1.4)
"""Ratios that are taken for 1: between them no unit is another one; ours."""
RATE_OF = (
    ("phi", "p", 1.0), ("theta", "q", 1.0), ("psi", "r", 1.0),
    ("h", "vd", -1.0), ("pn", "vn", 1.0), ("pe", "ve", 1.0),
)  # fmt: skip
"""Channel, the one that is its rate near hover, and the sign between them."""
LARGEST_IN_FLIGHT = {"phi": 1.6, "theta": 1.6, "p": 15.0, "q": 15.0, "r": 15.0}
"""What a helicopter that flies on stays under [rad, rad/s]; degrees do not."""


def unit_and_sign_faults(flight: Flight, vehicle: Vehicle) -> list[str]:
    """What looks like a wrong unit or sign, each with the line of the card that would change it."""
    if not flight.channels:
        unread = f" (not read: {', '.join(flight.unread)})" if flight.unread else ""
        return [f"no sensor in it{unread}: name the columns of the sensors under [columns]"]
    found = _rotor_speeds(flight, vehicle) + _weight(flight, vehicle) + _sizes(flight)
    for channel, rate, sign in RATE_OF:
        slope = _slope(flight, channel, rate)
        if slope is None or _is_one(sign * slope):
            continue
        said = (
            f"{channel} and {rate} disagree: {channel} moves {sign * slope:+.3g} times as much as"
        )
        said += f" {rate} says"
        if _is_one(-sign * slope):
            found.append(f"{said}: one axis is turned, give one of them scale = -1 under [columns]")
        else:
            found.append(f"{said}: look at the units of both under [columns]")
    return found


def _is_one(ratio: float) -> bool:
    return RATIOS_TAKEN_FOR_ONE[0] < ratio < RATIOS_TAKEN_FOR_ONE[1]


def _slope(flight: Flight, channel: str, rate: str) -> float | None:
    """How far a channel moves per unit of its summed rate; None where it cannot be determined."""
    moved, summed = [], []
    for run in flight.runs:
        if channel not in run.measured or rate not in run.measured:
            continue
        edges = np.arange(run.t[0], run.t[-1], WINDOW)
        at = _interpolated(run, channel, edges)
        fine = np.arange(run.t[0], run.t[-1], 0.01)
        total = np.interp(edges, fine, np.cumsum(_interpolated(run, rate, fine)) * 0.01)
        moved.append(np.diff(at))
        summed.append(np.diff(total))
    if not moved:
        return None
    x, y = np.concatenate(summed), np.concatenate(moved)
    if x.size < FEWEST_WINDOWS or min(x.std(), y.std()) == 0.0:
        return None
    # with a bias of the rate, not of its changes
    correlation = float(np.corrcoef(x, y)[0, 1])
    if abs(correlation) <= LEAST_CORRELATION:
        return None
    return math.copysign(float(y.std() / x.std()), correlation)


def _interpolated(run: Run, channel: str, times: np.ndarray) -> np.ndarray:
    given = np.isfinite(run.measured[channel])
    values = run.measured[channel][given]
    if channel in ANGLES:
        values = np.unwrap(values)
    return np.interp(times, run.t[given], values) if values.size else np.zeros(times.size)


def _rotor_speeds(flight: Flight, vehicle: Vehicle) -> list[str]:
    """Whether the rotors turn about as fast as in hover."""
    found = []
    trim = hover_trim(vehicle)[1] * RPM_PER_RAD_S
    for k, channel in enumerate(ROTOR_COMMANDS):
        usual = RPM_PER_RAD_S * float(
            np.median(np.concatenate([r.command[:, k] for r in flight.runs]))
        )
        if usual <= 0.0:
            found.append(f"{channel} is 0 most of the time: nothing flies")
        elif not 0.6 < usual / trim[k] < 1.6:
            found.append(
                f"{channel} is {usual:.4g} rev/min most of the time, and {vehicle.name} hovers at"
                f" {trim[k]:.4g}{_perhaps(channel, usual, trim[k])}"
            )
    return found


def _weight(flight: Flight, vehicle: Vehicle) -> list[str]:
    """Whether the accelerometer that points down reads -g."""
    values = _all(flight, "az")
    if values.size == 0:
        return []
    usual, g = float(np.median(values)), vehicle["gravity"].value
    if _is_one(-usual / g):
        return []
    said = f"az is {usual:.3g} m/s2 most of the time, -{g:.3g} is expected (specific force, z down)"
    if _is_one(usual / g):
        return [f"{said}: z points up? then y points left, too: scale = -1 for ay, az, q and r"]
    if abs(usual) < 0.2 * g and not (hint := _perhaps("az", usual, -g)):
        return [f"{said}: gravity has been taken out, and is needed"]
    return [said + (hint if abs(usual) < 0.2 * g else _perhaps("az", usual, -g))]


def _sizes(flight: Flight) -> list[str]:
    """Angles and rates that are degrees, and heights that point down."""
    found = []
    for channel, most in LARGEST_IN_FLIGHT.items():
        values = np.abs(_all(flight, channel))
        if values.size and float(np.quantile(values, 0.99)) > most:
            unit = "deg" if LOG_UNITS[channel] == "rad" else "deg/s"
            found.append(
                f"{channel} reaches {np.quantile(values, 0.99):.3g} {LOG_UNITS[channel]}:"
                f' if it is in {unit}, say unit = "{unit}" under [columns]'
            )
    height = _all(flight, "h")
    if height.size and float(np.median(height)) < 0.0:
        found.append(
            f"h is {np.median(height):.3g} m most of the time: it is height, up: scale = -1"
        )
    return found


def _all(flight: Flight, channel: str) -> np.ndarray:
    parts = [run.measured[channel] for run in flight.runs if channel in run.measured]
    values = np.concatenate(parts) if parts else np.empty(0)
    return values[np.isfinite(values)]


def _perhaps(channel: str, found: float, expected: float) -> str:
    unit = unit_that_makes(channel, expected / found, RATIOS_TAKEN_FOR_ONE)
    return f': in {unit}? say unit = "{unit}" under [columns]' if unit else ""
