"""What a change in flight is worth by the information of the flight from its moment on."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from coax_env.diagnosis.fits import linearise, noise_fitted, start, without_drifts
from coax_env.diagnosis.onsets.changing import beginning
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation import vibration
from coax_env.estimation.battery import stated
from coax_env.estimation.changing_model import BEFORE, Lap, clock_of
from coax_env.estimation.flown import flown_parts
from coax_env.estimation.helicopter import HeliModel, Moment, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.parted_engine import of_part
from coax_env.estimation.quadratic import Quadratic
from coax_env.logs.flight import read_flight
from coax_env.model.vehicle_file import load_vehicle

Sizes = Mapping[str, Mapping[str, float]]
UNKNOWN = 1e-9
"""Share of its prior's precision that what changes keeps: next to none."""


def worth_of_change(
    folder: Path, before: Sizes, after: Sizes, others: Sizes, since: Moment
) -> float:
    """Half the square of a true change over its variance [nats], beside a cause that was always there.

    By the information of the flight with half of the change, which is the midpoint rule for what all of
    it does, and noise levels fitted to the whole; the vehicle's own numbers and other faults are free
    under their priors, what was there before is free without one.

    Args:
        folder: of the flight. before, after: the effect, with its sizes then. others: that are there
            all the time. since: when it came, or began to grow.
    """
    (effect,) = after
    problem, fit, clock = _steady(folder, [effect, *others])
    fit = replace(fit.at(_values(others)), active=(effect, *others))
    problem = beginning(problem, fit, {effect: since}, clock)
    was = {of_part(name, BEFORE): value for name, value in _values(before).items()}
    fit = noise_fitted(problem, fit.at({**_values(after), **was}))
    change = {n: value - was[of_part(n, BEFORE)] for n, value in _values(after).items()}
    half = {n: was[of_part(n, BEFORE)] + 0.5 * d for n, d in change.items()}
    _, _, quadratic = linearise(problem, fit.at(half))
    return expected_nats(quadratic, problem.free_names(fit.active), effect, change)


def _steady(folder: Path, names: list[str]) -> tuple[Problem, Fit, dict[str, Lap]]:
    """The problem of these effects alone, noise fitted to the bare model, and the clock."""
    flight = read_flight(folder)
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    flight = flown_parts(flight, vehicle)
    _, calm, calm_vehicle = vibration.calmed(flight, vehicle)
    model = HeliModel(vehicle, stated(flight, vehicle))
    problem = Problem.of(model, [record_of(run) for run in calm.runs], names)
    fit = without_drifts(start(problem, starting_noise(calm, calm_vehicle)))
    return problem, fit, clock_of(flight.runs)


def _values(sizes: Sizes) -> dict[str, float]:
    return {f"{effect}.{p}": size for effect, own in sizes.items() for p, size in own.items()}


def expected_nats(
    quadratic: Quadratic, free: list[str], effect: str, change: Mapping[str, float]
) -> float:
    """Half a change's square over its variance [nats], everything else free.

    Args:
        quadratic: at the truth. free: names of all that is free, the effect's before and after.
        effect: that changes. change: name -> by how much its number changed.
    """
    places = quadratic.index(free)
    own = np.array([name.startswith(f"{effect}.") for name in free])
    prior = quadratic.precision[places] * np.where(own, UNKNOWN, 1.0)
    covariance = np.linalg.inv(quadratic.G[np.ix_(places, places)] + np.diag(prior))
    difference = np.zeros((len(change), len(free)))
    for row, name in enumerate(change):
        difference[row, free.index(name)] = 1.0
        difference[row, free.index(of_part(name, BEFORE))] = -1.0
    d = np.array(list(change.values()))
    return float(0.5 * d @ np.linalg.solve(difference @ covariance @ difference.T, d))
