"""A vehicle with numbers fitted to a flight: std, correlation, and what they were fitted on."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.estimation.parted_engine import AT
from coax_env.estimation.state_space import FreeParameter, Record
from coax_env.logs.flight import Flight
from coax_env.model import effects
from coax_env.model.vehicle import Parameter, Vehicle


def double_counting(flight: Flight, vehicle: Vehicle) -> list[str]:
    """A warning where the vehicle was already fitted on this flight."""
    used = set(vehicle.provenance.get("flights", ()))
    if used & set(flight.hashes.values()):
        return [f"{vehicle.name} was already fitted on this flight: its evidence counts twice"]
    return []


def median_step(records: Sequence[Record]) -> float:
    """Usual time between rows [s]."""
    return float(np.median(np.concatenate([np.diff(r.t) for r in records])))


def with_timing(parameter: FreeParameter, std: float, dt: float) -> float:
    """Std of a lag or delay with the half sample that a log cannot show.

    Within a row it is not known when the machine takes a command over, or when a reading was taken
    (zero-order hold against the simulator's or autopilot's own loop): uniform over a row, std
    dt/sqrt(12).

    Args:
        parameter: the number.
        std: of the fit.
        dt: seconds per row.
    """
    group, _, own = parameter.name.partition(AT)[0].rpartition(".")
    known = effects.GROUPS[group].parameters if group else ()
    if any(p.name == own and p.timing for p in known):
        return float(np.hypot(std, dt / np.sqrt(12.0)))
    return float(std)


def with_stated(
    vehicle: Vehicle, fitted: Iterable[str], values: Mapping[str, float], source: str
) -> Vehicle:
    """The vehicle with what effects took from the flight as stated: a battery's nominal voltage.

    Args:
        vehicle: with the effects. fitted: their names.
        values: of the fit. source: recorded with every value.
    """
    stated = {
        f"{effect}.{p.name}": Parameter(values[f"{effect}.{p.name}"], 0.0, p.unit, source)
        for effect in fitted
        for p in effects.CATALOGUE[effect].parameters
        if p.held
    }
    return vehicle.with_parameters(stated)


def fitted_vehicle(
    vehicle: Vehicle,
    free: Sequence[FreeParameter],
    values: Mapping[str, float],
    std: Mapping[str, float],
    covariance: np.ndarray,
    source: str,
    flight: Flight,
) -> Vehicle:
    """A vehicle with fitted values, their std and correlation, and what they were fitted on.

    Args:
        vehicle: as given.
        free: the k parameters that were fitted.
        values, std: of those, by name.
        covariance: whose correlation is recorded, (k, k).
        source: recorded with every value.
        flight: whose hashes are recorded.
    """
    changed = {}
    for f in free:
        group, _, own = f.name.rpartition(".")
        if group:
            unit = next(p.unit for p in effects.GROUPS[group].parameters if p.name == own)
        else:
            unit = vehicle[f.name].unit
        changed[f.name] = Parameter(float(values[f.name]), float(std[f.name]), unit, source)
    scale = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(scale, scale)
    correlation = 0.5 * (correlation + correlation.T)
    np.fill_diagonal(correlation, 1.0)
    return replace(
        vehicle.with_parameters(changed).seen(flight.hashes.values()),
        correlated=tuple(f.name for f in free),
        correlation=correlation,
    )
