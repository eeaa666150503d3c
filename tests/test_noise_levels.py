"""Noise levels of the helicopter: their slopes, and what is found where something else was flown.

Slopes are held against differences of the log-likelihood itself; levels against gusts that were
planted by simulating them here.
"""

from dataclasses import replace

import numpy as np
import pytest

from coax_env import load_vehicle, simulate
from coax_env.diagnosis.findings import noise_levels
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import (
    LATENT_START,
    fitted_levels,
    starting_noise,
)
from coax_env.estimation.noise_levels import fit_noise, level_slopes
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


def test_every_level_is_reported_with_its_unit_and_whether_it_stands_at_a_bound(flown):
    _, noise = flown
    found = noise_levels(noise)
    assert set(found) == {*noise.process, *noise.reading}
    assert found["force_xy"]["unit"] == "N" and found["memory_moment_z"]["unit"] == "s"
    assert found["p"] == {"value": noise.reading["p"], "unit": "rad/s", "at_bound": False}
    assert found["trim_moment_z"]["at_bound"] and not found["moment_z"]["at_bound"]
    most = noise.with_levels({"memory_force_z": noise.ceiling["memory_force_z"]})
    assert noise_levels(most)["memory_force_z"]["at_bound"]


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.05, 2.0])
def test_the_memory_of_the_gusts_is_found(memory):
    """Planted by the simulator, from the usual half second: within a factor that a minute allows."""
    flight = simulate(
        LAMA, ["lon_doublet", "climb_descend", "heading_turn"], seed=5, sensors="onboard",
        gusts=Gusts((0.2, 0.2, 0.2), (4e-3, 4e-3, 2e-3), memory),
    )  # fmt: skip
    model = HeliModel(LAMA)
    noise = starting_noise(flight, LAMA)
    engine = Engine(model, [record_of(run) for run in flight.runs])
    found = fit_noise(engine, model.bare_values, noise, fitted_levels(noise), evaluations=40)
    for axes, level in (("force_xy", 0.2), ("moment_xy", 4e-3)):
        assert found.level(axes) == pytest.approx(level, rel=0.35), axes
        assert abs(np.log(found.level(f"memory_{axes}") / memory)) < np.log(1.8), axes
    assert found.level("p") == pytest.approx(noise.level("p"), rel=0.1)
