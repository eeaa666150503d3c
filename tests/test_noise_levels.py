"""Noise levels of the helicopter: their slopes, and what is found where something else was flown.

Slopes are held against differences of the log-likelihood itself; levels against gusts that were
planted by simulating them here.
"""

from dataclasses import replace

import numpy as np
import pytest

from coax_env import load_vehicle, simulate
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import (
    LATENT_START,
    fitted_levels,
    starting_noise,
)
from coax_env.estimation.noise_levels import level_slopes
from coax_env.simulation.simulate import Gusts

LAMA = load_vehicle("lama400d")
SHAKEN = LAMA.with_effect("spin_up_reaction", gain=1.0).with_effect(
    "motor_lag", upper=0.1, lower=0.1
)


@pytest.fixture(scope="module")
def flown():
    """Six seconds in gusts of a short memory, every sensor at 100 Hz but a slow sonar."""
    flight = simulate(SHAKEN, "lon_doublet", seed=3, sensors="onboard",
                      gusts=Gusts(memory_s=0.15))  # fmt: skip
    record = record_of(flight.runs[0])
    rows = record.t < record.t[0] + 6.0
    z = record.z[rows].copy()
    z[np.arange(z.shape[0]) % 5 != 0, 11] = np.nan
    model = HeliModel(SHAKEN)
    engine = Engine(model, [replace(record, t=record.t[rows], command=record.command[rows], z=z)])
    return engine, starting_noise(flight, SHAKEN)


def test_slopes_are_those_of_the_likelihood(flown):
    """Of every level that there is: gusts and memories, white noise, rotors, trims and readings.

    The smoother's score is that of the model as linearised, so within some hundredths.
    """
    engine, noise = flown
    values = engine.model.bare_values
    noise = noise.with_levels(
        {name: max(share * noise.level(axes), 2.0 * noise.floor[name])
         for name, (axes, share) in LATENT_START.items()}
        | {"p": 2.0 * noise.reading["p"], "memory_moment_xy": 0.2, "rotor_speed": 0.5}
    )  # fmt: skip
    names = [*fitted_levels(noise), *LATENT_START]
    noise = replace(noise, prior={})
    score = engine.noise_score(values, noise)
    found = [level_slopes(engine, values, noise, name, score)[0].sum() for name in names]
    size = np.abs(found).max()
    for name, slope in zip(names, found, strict=True):
        sides = [
            engine.log_likelihood(values, noise.with_levels({name: f * noise.level(name)}))
            for f in (1.02, 1.0 / 1.02)
        ]
        exact = (sides[0] - sides[1]) / (2.0 * np.log(1.02))
        assert slope == pytest.approx(exact, rel=0.08, abs=2e-3 * size), name
