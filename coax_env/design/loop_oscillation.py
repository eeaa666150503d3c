"""Flights whose control loop oscillates: nearly all that they show is at one frequency.

A controller with too much gain for the lags of its machine swings with it: a limit cycle. At one
frequency the answer to a command is an amplitude and a phase, and a delay, a lag, an inertia and a
damping give the same two numbers: they are told apart by the form of the model alone, which no model
has right to a few percent. Lower gains show more.

Data flow::

    rate (a gyro's, or of a pose) and command about an axis, on even rows
        -> spectra and coherence, by Welch's method, run by run -> one peak that both have, in nearly
        all runs at the same frequency
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from coax_env.logs.flight import Run

WINDOW = 4.0
"""s of one of Welch's windows: a peak is known to half a hertz; ours."""
SLOWEST = 2.0
"""Hz under which a helicopter swings by itself, or is flown to and fro; ours."""
FASTEST = 0.2
"""Of the rate of the rows, over which a peak would have five rows a period and less; ours."""
PEAK = 2
"""Frequencies of a spectrum on each side of a peak that are its own: half a Hann window's main lobe."""
SHARE = 0.5
"""Of the power of rate and command, over 0.4 Hz, that is in the peak. Measured (**synthetic**, blade
elements): 0.6 to 1 of heading rates in a limit cycle, by gyros or 60 Hz poses; ours."""
COHERENCE = 0.95
"""Of rate and command there, from which the command is no answer to something else; 0.96 to 1 there."""
ALIKE = 0.1
"""Share by which frequencies of runs may be apart to be one: maneuvers that are flown by hand, whose
coherence is as large, are from run to run a quarter apart and more; ours."""
MOST_RUNS = 0.75
"""Share of the flown time, of the runs that are long enough, in which it swings so."""
LEAST_TIME = 2.0 * WINDOW
"""s of a run that is asked; a run without two windows has no coherence."""

AXES: Mapping[str, tuple[str, str]] = {
    "roll": ("p", "phi"),
    "pitch": ("q", "theta"),
    "yaw": ("r", "psi"),
}
"""Axis -> its rate and its angle."""


@dataclass(frozen=True)
class Oscillation:
    """A control loop that swings: the axis, at what frequency [Hz] and by what amplitude [rad/s]."""

    axis: str
    frequency: float
    amplitude: float

    def __str__(self) -> str:
        at = f"{self.frequency:.1f} Hz, by {self.amplitude:.2g} rad/s"
        return f"the {self.axis} rate swings with its command at {at}"


def oscillations(runs: Sequence["Run"]) -> tuple[Oscillation, ...]:
    """Axes about which a flight is a limit cycle of its control loop, the widest swing first.

    Args:
        runs: of the flight.
    """
    found = []
    for axis in AXES:
        asked = [(run.duration, _peak(run, axis)) for run in runs if run.duration > LEAST_TIME]
        swinging = [(time, peak) for time, peak in asked if peak is not None]
        if not swinging:
            continue
        usual = float(np.median([frequency for _, (frequency, _) in swinging]))
        alike = [(t, a) for t, (f, a) in swinging if abs(f - usual) <= ALIKE * usual]
        if sum(t for t, _ in alike) >= MOST_RUNS * sum(t for t, _ in asked):
            found.append(Oscillation(axis, usual, float(np.median([a for _, a in alike]))))
    return tuple(sorted(found, key=lambda o: -o.amplitude))


def remark(found: Sequence[Oscillation]) -> str:
    """What it means for a flight, and what to fly instead.

    Args:
        found: of `oscillations`, one at least.
    """
    swings = "; ".join(map(str, found))
    return (
        f"the control loop oscillates through the flight ({swings}): at one frequency a delay, a lag,"
        " an inertia and a damping are alike; fly again with lower gains"
    )


def _peak(run: "Run", axis: str) -> tuple[float, float] | None:
    """Frequency [Hz] and amplitude [rad/s] at which a rate and a command swing together, if they do."""
    from scipy.signal import coherence, welch

    dt = float(np.median(np.diff(run.t)))
    rate = _rate(run, axis, dt)
    if rate is None:
        return None
    t, y = rate
    row = np.clip(np.searchsorted(run.t, t, side="right") - 1, 0, len(run.t) - 1)
    rows = round(WINDOW / dt)
    if len(y) < 2 * rows:
        return None
    window: dict[str, Any] = {"fs": 1.0 / dt, "nperseg": rows, "detrend": "linear"}
    frequency, power = welch(y, **window)
    seen = frequency > 0.4
    asked = (frequency >= SLOWEST) & (frequency <= FASTEST / dt)
    peak = int(np.argmax(np.where(asked, power, 0.0)))
    near = np.abs(np.arange(len(frequency)) - peak) <= PEAK

    def share(spectrum: np.ndarray) -> float:
        total = float(spectrum[seen | near].sum())
        return float(spectrum[near].sum()) / total if total > 0.0 else 0.0

    if share(power) < SHARE:
        return None
    for command in _commands(run, axis):
        of_it = command[row]
        if np.ptp(of_it) == 0.0 or share(welch(of_it, **window)[1]) < SHARE:
            continue
        if coherence(y, of_it, **window)[1][peak] >= COHERENCE:
            amplitude = np.sqrt(2.0 * power[near].sum() * frequency[1])
            return float(frequency[peak]), float(amplitude)
    return None


def _commands(run: "Run", axis: str) -> list[np.ndarray]:
    """What turns about an axis: of the plate both tilts, whatever its phase."""
    upper, lower, lon, lat = run.command.T
    return [upper - lower] if axis == "yaw" else [lat, lon] if axis == "roll" else [lon, lat]


def _rate(run: "Run", axis: str, dt: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Even times [s] and the rate about an axis [rad/s], of its gyro or of its angle; None without."""
    gyro, angle = AXES[axis]
    for channel in (gyro, angle):
        read = np.isfinite(run.measured[channel]) if channel in run.measured else np.zeros(0, bool)
        if np.count_nonzero(read) < LEAST_TIME * SLOWEST / FASTEST:  # five a period of the slowest
            continue
        at, y = run.t[read], run.measured[channel][read]
        t = np.arange(at[0], at[-1], dt)
        if channel == angle:
            return t, np.gradient(np.interp(t, at, np.unwrap(y)), dt)
        return t, np.interp(t, at, y)
    return None
