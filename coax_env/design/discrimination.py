"""How well a maneuver separates two descriptions of a machine, and what it determines of one.

T-optimality (Atkinson and Fedorov 1975): one description flies the maneuver as the truth, another
one is fitted to what its sensors would read. What the fit leaves,

    min over the other's free numbers of  1/2 |e|^2 + 1/2 moves' known moves   [nats],

is the evidence that the flight is expected to bring; `e` are the whitened innovations of the engine
on readings without noise, `known` the information of earlier flights and priors on those numbers.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.quadratic import bounded_solve
from coax_env.estimation.state_space import FreeParameter, Noise, Record
from coax_env.logs.flight import Flight
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle import Vehicle
from coax_env.simulation.simulate import Track

ROW = 0.02
"""Seconds per row of a design; a faster sensor is logged at this rate with less noise, so that it
is as informative a second."""


@dataclass(frozen=True)
class Alternative:
    """One description that the flights allow: a corrected vehicle, and how well it is known.

    Attributes:
        name: the effect that is its own.
        vehicle: with it.
        free: the k parameters that may still move, with their bounds.
        known: inverse covariance of their fitted values, from flights so far and priors, (k, k).
    """

    name: str
    vehicle: Vehicle
    free: tuple[FreeParameter, ...]
    known: np.ndarray

    @classmethod
    def of(
        cls,
        name: str,
        vehicle: Vehicle,
        free: Sequence[FreeParameter],
        values: Mapping[str, float],
        information: np.ndarray | None = None,
    ) -> "Alternative":
        """From fitted values by name.

        Args:
            name: the effect that is its own.
            vehicle: the one the effects are added to.
            free: the k parameters that may still move.
            values: of those, by name.
            information: of the flights on them, (k, k); None: priors only.
        """
        own: dict[str, dict[str, float]] = {}
        base = {}
        for f in free:
            group, _, parameter = f.name.rpartition(".")
            if group:
                own.setdefault(group, {})[parameter] = values[f.name]
            else:
                base[f.name] = values[f.name]
        corrected = vehicle.with_values(base)
        for effect, table in own.items():
            corrected = corrected.with_effect(effect, **table)
        known = np.diag([f.std**-2.0 for f in free])
        if information is not None:
            known = known + information
        return cls(name, corrected, tuple(free), known)


class _FromHere(HeliModel):
    """The helicopter started from a known state, as uncertain as ever about it."""

    def __init__(self, vehicle: Vehicle, start: np.ndarray) -> None:
        super().__init__(vehicle)
        self.first = start

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        _, covariance = super().start(record)
        return self.first.copy(), covariance


def logged_rates(flight: Flight) -> dict[str, float]:
    """How often each channel of a flight was read [Hz], over the runs that have it."""
    rates = {}
    for channel in flight.channels:
        runs = [run for run in flight.runs if channel in run.measured]
        count = sum(int(np.isfinite(run.measured[channel]).sum()) for run in runs)
        rates[channel] = count / sum(run.duration for run in runs)
    return rates


def expected_information(
    flown: Track,
    vehicle: Vehicle,
    free: Sequence[FreeParameter],
    noise: Noise,
    rates: Mapping[str, float],
) -> np.ndarray:
    """Fisher information of a flown maneuver on some numbers, (k, k).

    Args:
        flown: simulated with `vehicle`.
        vehicle: at whose numbers.
        free: the k numbers.
        noise: of gusts and readings.
        rates: of the channels aboard [Hz].
    """
    noise = _for_rows(noise, rates, float(flown.t[1] - flown.t[0]))
    model = _FromHere(vehicle, flown.state[0])
    engine = Engine(model, [_as_logged(flown, rates)], threads=1)
    values = {**{f.name: f.value for f in free}, **vehicle.values()}
    _, lin = engine.linearise(values, noise, free)
    return lin.information[0]


def _as_logged(flown: Track, rates: Mapping[str, float]) -> Record:
    """A simulated run as the engine gets it: no noise, each channel at its own rate."""
    z = np.full(flown.readings.shape, np.nan)
    for channel, rate in rates.items():
        i = CHANNELS.index(channel)
        new = np.diff(np.floor(flown.t * rate + 1e-6), prepend=-1.0) > 0.0
        z[new, i] = flown.readings[new, i]
    return Record(flown.maneuver.name, flown.t, flown.command, z)


def _for_rows(noise: Noise, rates: Mapping[str, float], row: float) -> Noise:
    """Noise of readings averaged over a row where they come faster than rows do."""
    reading = {c: s * math.sqrt(min(1.0, 1.0 / (row * rates.get(c, 1.0))))
               for c, s in noise.reading.items()}  # fmt: skip
    return replace(noise, reading=reading)


def distance(
    flown: Track,
    other: Alternative,
    noise: Noise,
    rates: Mapping[str, float],
) -> float:
    """How far the best that `other` can do stays from a flown truth, nats.

    Args:
        flown: the truth, simulated.
        other: the description that is fitted to it.
        noise: of gusts and readings.
        rates: of the channels aboard [Hz].
    """
    noise = _for_rows(noise, rates, float(flown.t[1] - flown.t[0]))
    model = _FromHere(other.vehicle, flown.state[0])
    engine = Engine(model, [_as_logged(flown, rates)], threads=1)
    values = other.vehicle.values()
    passes, lin = engine.linearise(values, noise, other.free)
    at = np.array([values[f.name] for f in other.free])
    move = bounded_solve(
        lin.information[0] + other.known,
        -lin.slope[0],
        np.array([f.lower for f in other.free]) - at,
        np.array([f.upper for f in other.free]) - at,
    )
    moved = values | dict(zip(lin.names, (at + move).tolist(), strict=True))
    unmoved = engine.frozen_cost(passes, (), values, noise)
    fitted = engine.frozen_cost(passes, (), moved, noise) + 0.5 * float(move @ other.known @ move)
    return min(unmoved, fitted)
