"""One simulated flight of the identification study: do its 95 % intervals hold the truth?

"tls": the paper's doublet, open loop, in gusts, Table V noise; coefficients of (64)-(66), the moment
with its gyroscopic term, against what the vehicle's equations give. "ml": a vehicle drawn from the
file's spread, maneuvers with a pilot, in gusts; the file's numbers under their priors. "AeroID": the
nearest open tool's output-error fit of PEER on the doublet's rates, and ours on the same readings.
In an arm (arms.py): a clean flight by other code, in closed loop, with the file right; numbers that it
determines.
"""

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coax_env import derivative, hover_trim, identify, load_vehicle, simulate
from coax_env.errors import require
from coax_env.identification.two_step.method import two_step
from coax_env.identification.two_step.regression import Regression
from coax_env.logs.flight import Flight
from coax_env.model.layout import COMMANDS, STATES
from coax_env.model.vehicle import Vehicle
from coax_env.simulation.simulate import Gusts
from study import arms
from study.one_flight import hide

METHODS = ("tls", "ls", "ml", "ml on p, q", "AeroID on p, q")
GUSTS = Gusts()
ML_RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
LEVEL = 0.95
PEER = ("inertia_xx", "inertia_yy", "swash_to_flap", "flap_time_constant")
Z = 1.959964
ALL_ARMS, READINGS_ALONE = "all arms", "all arms, by the readings alone"
DETERMINED = 0.5
"""Share of its prior's std within which the readings alone determine a number; ours."""


def fly_and_identify(
    number: int, peer: bool = False, vehicle: str = "lama400d"
) -> dict[str, list[dict[str, Any]]]:
    """method -> intervals of one flight: name, low, high, truth.

    Args:
        number: of the flight; the seed of its gusts, noise and drawn vehicle.
        peer: AeroID too.
        vehicle: shipped name or file.
    """
    file = load_vehicle(vehicle)
    flight = simulate(file, "lon_doublet", sensors="paper", seed=number, gusts=GUSTS)
    result: dict[str, list[dict[str, Any]]] = {"tls": [], "ls": []}
    for fit in two_step(flight, file).modes:
        wanted = {"tls": fit.completed or fit.total, "ls": fit.ordinary}
        for method, regression in wanted.items():
            result[method] += _intervals(regression, fit.expected, fit.mode.response)
    truth = file.draw(np.random.default_rng(number))
    found = identify(simulate(truth, ML_RUNS, seed=number, gusts=GUSTS), file)
    result["ml"] = [
        _about(n, found.after[n].value, found.after[n].std, truth) for n in found.fitted
    ]
    if peer:
        rates = identify(flight, file, channels=("p", "q"))
        result["ml on p, q"] = [
            _about(n, rates.after[n].value, rates.after[n].std, file) for n in PEER
        ]
        values, std = output_error(flight, file)
        result["AeroID on p, q"] = [_about(n, values[n], std[n], file) for n in PEER]
    return result


def identify_in_arm(piece: tuple[str, int, int]) -> dict[str, list[dict[str, Any]]]:
    """The intervals of one clean flight of an arm, by its name and twice together: as they are stated,
    and without what commands show of the gusts.

    None where the vehicle is not as its file says: what its numbers are in our model is not known.

    Args:
        piece: the arm's name, the flight's number, the study's seed.
    """
    os.environ["COAX_THREADS"] = "1"  # the study's workers share the cores
    arm, number, seed = piece
    planned = arms.planned(arm, "clean", number, seed)
    if planned.craft == "spread":
        return {}
    with tempfile.TemporaryDirectory(prefix="coax-study-") as folder:
        hide(planned, Path(folder) / "flight")
        found = identify(Path(folder) / "flight")
    alone = found.estimate.std
    shown = [n for n in found.fitted if alone[n] < DETERMINED * found.before[n].std]

    def intervals(std: Mapping[str, float]) -> list[dict[str, Any]]:
        return [_about(n, found.after[n].value, std[n], found.before) for n in shown]

    stated = intervals({n: found.after[n].std for n in shown})
    return {arm: stated, ALL_ARMS: stated, READINGS_ALONE: intervals(alone)}


def output_error(flight: Flight, file: Vehicle) -> tuple[dict[str, float], dict[str, float]]:
    """AeroID's default identification of PEER on p and q: values and standard errors."""
    aeroid = require("aeroid", "study")
    run = flight.runs[0]
    state, _ = hover_trim(file, height=float(run.measured["h"][0]))
    names = [name for name, _ in STATES]
    inputs = [name for name, _ in COMMANDS]
    vehicles: dict[tuple[float, ...], Vehicle] = {}

    def dynamics(t: float, x: Any, u: Any, p: Any) -> Any:
        key = tuple(p[n] for n in PEER)
        if key not in vehicles:
            vehicles[key] = file.with_values(dict(zip(PEER, key, strict=True)))
        return derivative(x, u, vehicles[key])

    model = aeroid.Model(
        states=names,
        controls=inputs,
        parameters={n: file[n].value for n in PEER},
        dynamics=dynamics,
    )
    channels = dict(zip(inputs, run.command.T, strict=True))
    data = aeroid.FlightData(run.t, {**channels, "p": run.measured["p"], "q": run.measured["q"]})
    weight = 1.0 / flight.noise["q"]
    found = aeroid.identify(
        model, data, list(PEER), outputs=["p", "q"], weights={"p": weight, "q": weight},
        x0=dict(zip(names, state, strict=True)),
    )  # fmt: skip
    return dict(found.parameters), dict(found.stderr)


def _about(name: str, value: float, std: float, truth: Vehicle) -> dict[str, Any]:
    low, high = value - Z * std, value + Z * std
    return {"name": name, "low": low, "high": high, "truth": truth[name].value}


def _intervals(
    regression: Regression, expected: dict[str, float], response: str
) -> list[dict[str, Any]]:
    return [
        {
            "name": f"{response}, {name}",
            "low": float(low),
            "high": float(high),
            "truth": float(expected[name]),
        }
        for name, (low, high) in zip(regression.names, regression.interval(LEVEL), strict=True)
    ]
