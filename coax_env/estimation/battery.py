"""What the battery does to the rotors' speeds, as the log itself shows it.

Where no rotor speed is read, the thrust that accelerometers feel asks for one. Beside thrust
coefficients that are not known well, and gusts as long as a run, the likelihood hardly sees it. On a
real helicopter (second CoaX) two flights at 10.9 V and two at 12.1 V have commands 11 % apart for the
same thrust; it was worth 15 nats, a motor's droop in its place 113, and beside that nothing. The thrust
of each second, by a straight line in command and voltage, says 50 nats, speeds that follow the voltage
in proportion (0.97 +- 0.10 of it), and the same without any one run. So it is known before the search,
as a vibration is. In mere hover a droop would look the same: commands must change.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from coax_env.logs.flight import Flight, Run
from coax_env.model.effects import CATALOGUE
from coax_env.model.layout import ROTOR_SPEEDS, RPM_PER_RAD_S
from coax_env.model.vehicle import Parameter, Vehicle

VOLTAGE = "battery_voltage"
PER_VOLT = f"{VOLTAGE}.per_volt"
VARYING = 0.1
"""Volts from the lowest to the highest battery voltage, more than a reading's noise; ours."""
FARTHEST = 0.5
"""Share of the mean voltage that a nominal one may be away from it; ours."""
STEEPEST = 1.5
"""Times that speeds may follow the voltage more than in proportion, by the felt thrust: more is
something else that changes in flight; ours."""
LEAST_POINTS = 6
"""Seconds of flight for a line of four numbers; ours."""
WIDE = 0.5
"""Prior std of what a line has without a voltage, about the speeds as commanded; ours."""
MOST_ALIKE = 0.9
"""Correlation of neighbouring seconds beyond which it is not believed; ours."""

Points = np.ndarray
"""(3, s): of each second the battery's voltage [V], and rotor speed over hover's, as the felt thrust
asks for it and as commanded."""


@dataclass(frozen=True)
class FeltVoltage:
    """How speeds follow the battery's voltage by the felt thrust, where no speed is read.

    What is felt, over hover's speed, is a + b c + d (c - 1)^2 + m c (V - mean): of what is commanded c
    and the voltage V. A motor's droop about hover, or its lag, makes b less than one and a what is
    missing of one; speeds follow the voltage by m / b a volt. A battery sags with its load, so that a
    thrust of another law would look like it without d. Priors of a, b and d are wide, that of m the
    catalogue's usual size.

    points: by run.
    """

    points: Mapping[str, Points]

    @cached_property
    def line(self) -> "Line | None":
        """Through all points; None where these tell none."""
        return Line.through(list(self.points.values()))

    @property
    def evidence(self) -> float:
        """Log Bayes factor of a slope in the voltage [nats]."""
        return self.line.evidence if self.line else -math.inf

    def of(self, runs: Iterable[str]) -> "FeltVoltage":
        """The same of some runs. runs: their names."""
        return FeltVoltage({name: self.points[name] for name in runs})

    @property
    def within_runs(self) -> "FeltVoltage":
        """The same with voltages that are alike in the mean of each run."""
        mean = float(np.mean([own[0].mean() for own in self.points.values()]))
        level = {name: own[0] - own[0].mean() + mean for name, own in self.points.items()}
        return FeltVoltage({n: np.stack((level[n], *own[1:])) for n, own in self.points.items()})

    def is_shown(self, least: float) -> bool:
        """Whether it is worth enough, and as a battery does it. least: nats."""
        line = self.line
        if line is None or line.evidence < least:
            return False
        return 0.0 < line.slope * line.mean < STEEPEST and line.is_near

    def known(self, vehicle: Vehicle, source: str) -> Vehicle:
        """The vehicle whose speeds follow the voltage so.

        Args:
            vehicle: without that. source: of the numbers.
        """
        assert self.line is not None
        units = {p.name: p.unit for p in CATALOGUE[VOLTAGE].parameters}
        numbers = {
            "per_volt": (self.line.per_volt, self.line.std),
            "nominal": (self.line.nominal, 0.0),
        }
        return vehicle.with_parameters(
            {
                f"{VOLTAGE}.{name}": Parameter(value, std, units[name], source)
                for name, (value, std) in numbers.items()
            }
        )


@dataclass(frozen=True)
class Line:
    """A line through points, by least squares with priors.

    share: a, what is felt at no command. gain: b. mean: voltage [V]. slope: m / b [1/V], at it.
    std: of `per_volt` [1/V]. evidence: log Bayes factor of the slope [nats].
    """

    share: float
    gain: float
    mean: float
    slope: float
    std: float
    evidence: float

    @classmethod
    def through(cls, points: Sequence[Points]) -> "Line | None":
        """Through the points of some runs; None where these are too few, or all alike."""
        volts, felt, command = np.concatenate([np.empty((3, 0)), *points], axis=1)
        if volts.size < LEAST_POINTS or np.ptp(volts) == 0.0 or np.ptp(command) == 0.0:
            return None
        mean = float(volts.mean())
        bend = (command - 1.0) ** 2
        X = np.stack((np.ones_like(volts), command, bend, command * (volts - mean)), axis=1)
        numbers, *_ = np.linalg.lstsq(X, felt, rcond=None)
        left = np.split(felt - X @ numbers, np.cumsum([own.shape[1] for own in points])[:-1])
        variance = _variance(left, volts.size - X.shape[1])
        usual = CATALOGUE[VOLTAGE].parameters[0].usual
        prior = np.array([WIDE, WIDE, WIDE, usual])
        curvature = X.T @ X / variance + np.diag(prior**-2)
        pull = X.T @ felt / variance + np.array([0.0, WIDE**-2, 0.0, 0.0])
        share, gain, _, m = np.linalg.solve(curvature, pull).tolist()
        if gain <= 0.0 or share >= 1.0:
            return None
        covariance = np.linalg.inv(curvature)
        of_m = math.sqrt(float(covariance[3, 3]))
        evidence = math.log(of_m / usual) + 0.5 * (m / of_m) ** 2  # by Savage and Dickey
        by_numbers = np.array([m / (1.0 - share), 0.0, 0.0, 1.0]) / (1.0 - share)
        std = math.sqrt(float(by_numbers @ covariance @ by_numbers))
        return cls(share, gain, mean, m / gain, std, evidence)

    @property
    def level(self) -> float:
        """Speed over what is asked for, at the mean voltage."""
        return self.gain / (1.0 - self.share)

    @property
    def nominal(self) -> float:
        """Voltage at which speeds are as commanded [V]."""
        return self.mean + (1.0 / self.level - 1.0) / self.slope

    @property
    def per_volt(self) -> float:
        """Change of speed over command [1/V]."""
        return self.level * self.slope

    @property
    def is_near(self) -> bool:
        """Whether the nominal voltage is one that the battery may have."""
        return abs(self.nominal - self.mean) < FARTHEST * self.mean


def _variance(left: Sequence[np.ndarray], freedom: int) -> float:
    """Variance of what a line leaves of each run, as many times larger as neighbours are alike."""
    own = sum(float(e @ e) for e in left)
    if own == 0.0:
        return math.ulp(1.0)
    alike = sum(float(e[1:] @ e[:-1]) for e in left) / own
    alike = min(max(alike, 0.0), MOST_ALIKE)
    return own / freedom * (1.0 + alike) / (1.0 - alike)


def felt_voltage(flight: Flight, vehicle: Vehicle) -> FeltVoltage:
    """How speeds follow the battery's voltage by the felt thrust; of no points where a rotor's speed is
    read, or no battery or vertical acceleration is.

    Args:
        flight: any. vehicle: its mass and thrust coefficients, in its air.
    """
    if any(c in run.measured for run in flight.runs for c in ROTOR_SPEEDS):
        return FeltVoltage({})
    parts: dict[str, list[Points]] = {}
    for run in flight.runs:
        if run.battery is not None and "az" in run.measured:
            parts.setdefault(run.whole, []).append(_seconds(run, run.battery, vehicle))
    return FeltVoltage({name: np.concatenate(own, axis=1) for name, own in parts.items()})


def stated(flight: Flight, vehicle: Vehicle) -> dict[str, float]:
    """Values that effects take from a flight as stated: the battery's nominal voltage.

    Where a rotor's speed is measured, the voltage at which it is what was commanded, by a line through
    speed over command against voltage; where the felt thrust shows a slope, by that; else the mean, to
    0.1 V: thrust coefficients take up the rest.

    Args:
        flight, vehicle: as of `felt_voltage`.
    """
    logged = _voltages(flight.runs)
    if not logged.size:
        return {}
    mean = float(np.mean(logged))
    nominal = round(mean, 1)
    if voltage_varies(flight):
        followed, felt = _followed(flight, mean), felt_voltage(flight, vehicle)
        if followed is not None:
            slope, at_mean = followed
            if slope > 0.0 and abs(1.0 - at_mean) < FARTHEST * mean * slope:
                nominal = mean + (1.0 - at_mean) / slope
        elif felt.line and felt.is_shown(0.0):
            nominal = felt.line.nominal
    return {f"{VOLTAGE}.nominal": nominal}


def voltage_varies(flight: Flight) -> bool:
    """Whether the flight's battery is logged and its voltage shows more than noise.

    Args:
        flight: any.
    """
    logged = _voltages(flight.runs)
    return bool(logged.size) and float(np.ptp(logged)) > VARYING


def _voltages(runs: Iterable[Run]) -> np.ndarray:
    """All that are logged [V]."""
    return np.concatenate([np.empty(0), *(r.battery for r in runs if r.battery is not None)])


def _followed(flight: Flight, mean: float) -> tuple[float, float] | None:
    """Measured over commanded rotor speed: slope [1/V], and value at the mean voltage [V]; None where
    none is measured."""
    volts, ratio = [np.empty(0)], [np.empty(0)]
    for run in flight.runs:
        for k, channel in enumerate(ROTOR_SPEEDS):
            if run.battery is None or channel not in run.measured:
                continue
            command = run.command[:, k] * RPM_PER_RAD_S
            read = np.isfinite(run.measured[channel]) & (command > 0.0)
            volts.append(run.battery[read])
            ratio.append(run.measured[channel][read] / command[read])
    there = np.concatenate(volts)
    if not there.size:
        return None
    slope, at_mean = np.polyfit(there - mean, np.concatenate(ratio), 1)
    return float(slope), float(at_mean)


def _seconds(run: Run, battery: np.ndarray, vehicle: Vehicle) -> Points:
    """Of each second in which thrust is felt and asked for."""
    of = vehicle.values()
    upper, lower = run.command[:, :2].T
    lift = of["thrust_coefficient_upper"] * upper**2 + of["thrust_coefficient_lower"] * lower**2
    lift *= of["air_density"] * math.pi * of["rotor_radius"] ** 4 / of["mass"]
    read = np.isfinite(run.measured["az"])
    second = np.floor(run.t - run.t[0]).astype(np.int64)[read]
    rows = np.stack((np.ones(len(run.t)), battery, -run.measured["az"], lift))[:, read]
    count, volts, felt, asked = (np.bincount(second, own) for own in rows)
    there = (felt > 0.0) & (asked > 0.0)
    weight = of["gravity"] * count[there]
    return np.stack(
        (volts[there] / count[there], np.sqrt(felt[there] / weight), np.sqrt(asked[there] / weight))
    )
