"""The paper's method on a flight: filter, reconstruct, regress; and what it makes of the vehicle.

Data flow::

    flight -> each run on an even grid -> low-pass, spectral filter, check by integration (IV.C)
                                       -> Kalman filter and smoother of (46)-(57)          (V.A)
           -> runs that excite a mode  -> regressions (64)-(69)                            (V.B)
           -> all runs                 -> pooled physical regressions -> vehicle file

The vehicle takes its numbers from the pooled regressions, not from the table: the table's entries
are tied to each other (regression.py, `collinearity`), the pooled ones are not. Each is joined with
the file's own value and std by their precisions.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.errors import InputError
from coax_env.estimation.helicopter_noise import sensor_std
from coax_env.identification.two_step.columns import joined, rows_of
from coax_env.identification.two_step.modes import (
    LEAST_MOVEMENT,
    MODES,
    PHYSICS,
    ModeFit,
    Physics,
    excites,
    fit_mode,
    fit_physics,
    movement,
)
from coax_env.identification.two_step.processing import (
    CUTOFF,
    even_grid,
    integrated,
    low_pass,
    spectral_amplitude_filter,
)
from coax_env.identification.two_step.reconstruction import Longitudinal, longitudinal
from coax_env.identification.two_step.regression import Regression
from coax_env.logs.flight import Flight, Run
from coax_env.model.layout import INERTIAL, ROTOR_SPEEDS
from coax_env.model.sensors import suite
from coax_env.model.vehicle import Parameter, Vehicle
from coax_env.progress import Progress

TABLE_V = {sensor.name: sensor.noise for sensor in suite("paper")}
"""Std of the sensors as the paper assumes them; used where the card says nothing and the data show no
noise at all."""
QUIET = 1.0
"""Seconds at a run's start, before its maneuver, that serve as the noise record where no run hovers."""


@dataclass(frozen=True)
class Reconstructed:
    """Sections IV.C and V.A of one run, on its even time grid.

    raw, smooth, spectral: channel -> (n,) as read, low-passed, and through the spectral-amplitude
    filter after that. integrated: the paper's check. states: step 1.
    """

    run: str
    t: np.ndarray
    raw: Mapping[str, np.ndarray]
    smooth: Mapping[str, np.ndarray]
    spectral: Mapping[str, np.ndarray]
    integrated: Mapping[str, np.ndarray]
    states: Longitudinal


@dataclass(frozen=True)
class PhysicalFit:
    """A pooled regression and the vehicle's numbers before, by it alone, and joined."""

    physics: Physics
    regression: Regression
    found: tuple[Parameter, ...]


@dataclass(frozen=True)
class TwoStep:
    """Result of `two_step`."""

    flight: Flight
    before: Vehicle
    after: Vehicle
    noise: Mapping[str, float]
    cutoff: float
    reconstructed: tuple[Reconstructed, ...]
    modes: tuple[ModeFit, ...]
    physical: tuple[PhysicalFit, ...]
    remarks: tuple[str, ...]

    @property
    def fitted(self) -> tuple[str, ...]:
        """Names of the vehicle's numbers that changed."""
        return tuple(name for fit in self.physical for name in fit.physics.parameters)


def two_step(
    flight: Flight, vehicle: Vehicle, cutoff: float = CUTOFF, progress: Progress | None = None
) -> TwoStep:
    """The paper's identification of a vehicle from a flight.

    Args:
        flight: whose runs. vehicle: to start from; its numbers are the priors.
        cutoff: of the low-pass [Hz]. progress: is given a line of text now and then.

    Raises:
        InputError: no run has gyros, accelerometers and a height.
    """
    report_progress = progress or (lambda text: None)
    usable = [run for run in flight.runs if all(c in run.measured for c in INERTIAL)]
    if not usable:
        raise InputError(
            "the paper's method needs gyros and accelerometers (p q r ax ay az); this flight has "
            + (" ".join(flight.channels) or "none")
        )
    noise = {
        c: flight.noise.get(c) or _noise_of(flight, c)
        for c in (*INERTIAL, "h", *ROTOR_SPEEDS)
        if c in flight.channels
    }
    remarks = []
    left_out = [run.name for run in flight.runs if run not in usable]
    if left_out:
        remarks.append(f"without gyros or accelerometers, left out: {', '.join(left_out)}")
    report_progress("filtering and reconstructing the states")
    reconstructed = _reconstruct_all(usable, vehicle, noise, cutoff)
    if not reconstructed:
        remarks.append("no height was logged: the states of step 1 are not reconstructed")
    report_progress("regressing the coefficients")
    moving = [run for run in usable if any(excites(run, axis) for axis in LEAST_MOVEMENT)]
    parts = {run.name: rows_of(run, vehicle, noise, cutoff, k) for k, run in enumerate(moving)}
    modes = [fit_mode(mode, moving, parts, vehicle) for mode in MODES]
    remarks += _not_excited(modes)
    report_progress("fitting the vehicle's numbers")
    physical, after = _physical(moving, vehicle, noise, cutoff, flight)
    return TwoStep(
        flight,
        vehicle,
        after,
        noise,
        cutoff,
        reconstructed,
        tuple(fit for fit in modes if fit),
        physical,
        tuple(remarks),
    )


def _not_excited(modes: Sequence[ModeFit | None]) -> list[str]:
    """A remark for every axis that no run moves enough for its modes."""
    idle: dict[str, list[str]] = {}
    for mode, fit in zip(MODES, modes, strict=True):
        if fit is None:
            idle.setdefault(mode.axis, []).append(mode.name)
    return [
        f"no run moves {axis} enough (std {LEAST_MOVEMENT[axis]}): "
        f"no regression of {', '.join(names)}"
        for axis, names in idle.items()
    ]


def _noise_of(flight: Flight, channel: str) -> float:
    return sensor_std(flight, channel) or TABLE_V.get(channel, 1.0)


# --- section IV.C and step 1 --------------------------------------------------------------------------


def _noise_record(runs: Sequence[Run]) -> Run:
    """The run in which the commands move least: the paper's hover record."""
    return min(
        runs,
        key=lambda run: sum(movement(run, axis) / std for axis, std in LEAST_MOVEMENT.items()),
    )


def _still(run: Run, cutoff: float, seconds: float = math.inf) -> dict[str, np.ndarray]:
    """The IMU of a run's first so many seconds, low-passed: what it reads while nothing is flown."""
    dt, t, raw = even_grid(run, INERTIAL)
    kept = t - t[0] <= seconds + dt
    return {c: low_pass(values[kept], dt, cutoff) for c, values in raw.items()}


def _reconstruct_all(
    runs: Sequence[Run], vehicle: Vehicle, noise: Mapping[str, float], cutoff: float
) -> tuple[Reconstructed, ...]:
    """Of the runs that have a height; the noise record is the quietest run, of itself its start."""
    quiet = _noise_record(runs)
    hover = _still(quiet, cutoff)
    return tuple(
        _reconstruct(
            run, _still(run, cutoff, QUIET) if run is quiet else hover, vehicle, noise, cutoff
        )
        for run in runs
        if "h" in run.measured
    )


def _reconstruct(
    run: Run,
    still: Mapping[str, np.ndarray],
    vehicle: Vehicle,
    noise: Mapping[str, float],
    cutoff: float,
) -> Reconstructed:
    dt, t, raw = even_grid(run, (*INERTIAL, "h", "theta"))
    smooth = {c: low_pass(values, dt, cutoff) for c, values in raw.items()}
    spectral = {}
    for c in INERTIAL:
        try:
            spectral[c] = spectral_amplitude_filter(smooth[c], still[c], dt)
        except InputError:  # no noise record of a segment's length
            spectral[c] = smooth[c]
    g = vehicle["gravity"].value
    places = np.clip(np.round((run.t - t[0]) / dt).astype(int), 0, len(t) - 1)  # the nearest
    sonar = np.full(len(t), np.nan)
    there = np.isfinite(run.measured["h"])
    sonar[places[there]] = run.measured["h"][there]
    states = longitudinal(
        raw["q"], raw["ax"], raw["az"], sonar, dt, g, (noise["q"], noise["az"], noise["h"])
    )
    path = integrated(smooth["q"], smooth["ax"], smooth["az"], dt, g, float(smooth["h"][0]))
    return Reconstructed(run.name, t - t[0], raw, smooth, spectral, path, states)


# --- the vehicle --------------------------------------------------------------------------------------


def _physical(
    runs: Sequence[Run],
    vehicle: Vehicle,
    noise: Mapping[str, float],
    cutoff: float,
    flight: Flight,
) -> tuple[tuple[PhysicalFit, ...], Vehicle]:
    where = flight.name
    fits, after = [], vehicle
    for physics in PHYSICS:  # thrusts first: the moments are theirs
        used = [run for run in runs if any(excites(run, axis) for axis in physics.axes)]
        if not used:
            continue
        parts = [rows_of(run, after, noise, cutoff, k) for k, run in enumerate(used)]
        regression = fit_physics(physics, joined(parts))
        if regression is None:
            continue
        found = _parameters(physics, regression, after, f"identified from {where} (two steps)")
        after = after.with_parameters(dict(zip(physics.parameters, found, strict=True)))
        fits.append(PhysicalFit(physics, regression, found))
    return tuple(fits), replace(
        after.seen(flight.hashes.values()),
        description=f"{vehicle.description}; identified from {where} by the paper's two steps",
    )


def _parameters(
    physics: Physics, regression: Regression, vehicle: Vehicle, source: str
) -> tuple[Parameter, ...]:
    """The file's numbers joined with what the regression says, by their precisions.

    A number without std is exact and stays. Logs of the factors, so that a power of -1 is a sign.
    """
    k = len(physics.parameters)
    index = [regression.names.index(n) for n in physics.regressors]
    factors = regression.values[index]
    old = [vehicle[name] for name in physics.parameters]
    if np.any(factors <= 0.0):
        return tuple(old)
    C = regression.covariance[np.ix_(index, index)] / np.outer(factors, factors)
    prior = np.array([p.std / p.value for p in old])
    free = prior > 0.0
    if not free.any():
        return tuple(old)
    logs, spread = np.zeros(k), np.zeros((k, k))
    weight = np.linalg.inv(C)
    A = weight[np.ix_(free, free)] + np.diag(prior[free] ** -2)
    spread[np.ix_(free, free)] = np.linalg.inv(A)
    logs[free] = spread[np.ix_(free, free)] @ (weight @ (physics.power * np.log(factors)))[free]
    return tuple(
        replace(p, value=p.value * math.exp(log), std=p.value * math.exp(log) * std, source=source)
        if p.std > 0.0
        else p
        for p, log, std in zip(old, logs, np.sqrt(np.diag(spread)), strict=True)
    )
