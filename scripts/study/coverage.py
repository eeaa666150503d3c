"""One simulated flight of the identification study: do its 95 % intervals hold the truth?

"tls": the paper's doublet, open loop, in gusts, Table V noise; coefficients of (64)-(66), the moment
with its gyroscopic term, against what the vehicle's equations give. "ml": a vehicle drawn from the
file's spread, maneuvers with a pilot, in gusts; the file's numbers under their priors. "AeroID": the
nearest open tool's output-error fit of PEER on the doublet's rates, and ours on the same readings.
"""

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

METHODS = ("tls", "ls", "ml", "ml on p, q", "AeroID on p, q")
GUSTS = Gusts()
ML_RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
LEVEL = 0.95
PEER = ("inertia_xx", "inertia_yy", "swash_to_flap", "flap_time_constant")
Z = 1.959964


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
