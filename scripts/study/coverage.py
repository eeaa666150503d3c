"""One simulated flight of the identification study: do its 95 % intervals hold the truth?

"tls": the paper's doublet, open loop, in gusts, Table V noise; coefficients of (64)-(66), the moment
with its gyroscopic term, against what the vehicle's equations give. "ml": a vehicle drawn from the
file's spread, maneuvers with a pilot, in gusts; the file's numbers under their priors.
"""

from typing import Any

import numpy as np

from coax_env import identify, load_vehicle, simulate
from coax_env.simulation import Gusts
from coax_env.two_step.method import two_step
from coax_env.two_step.regression import Regression

METHODS = ("tls", "ls", "ml")
GUSTS = Gusts()
ML_RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
LEVEL = 0.95


def fly_and_identify(number: int, vehicle: str = "lama400d") -> dict[str, list[dict[str, Any]]]:
    """method -> intervals of one flight: name, low, high, truth."""
    file = load_vehicle(vehicle)
    flight = simulate(file, "lon_doublet", sensors="paper", seed=number, gusts=GUSTS)
    result: dict[str, list[dict[str, Any]]] = {"tls": [], "ls": []}
    for fit in two_step(flight, file).modes:
        wanted = {"tls": fit.completed or fit.total, "ls": fit.ordinary}
        for method, regression in wanted.items():
            result[method] += _intervals(regression, fit.expected, fit.mode.response)
    truth = file.draw(np.random.default_rng(number))
    flown = simulate(truth, ML_RUNS, seed=number, gusts=GUSTS)
    found = identify(flown, file)
    z = 1.959964
    result["ml"] = [
        {
            "name": name,
            "low": found.after[name].value - z * found.after[name].std,
            "high": found.after[name].value + z * found.after[name].std,
            "truth": truth[name].value,
        }
        for name in found.fitted
    ]
    return result


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
