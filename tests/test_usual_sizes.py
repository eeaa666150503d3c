"""Usual sizes on other machines: dynamic similarity, which knows nothing of the code's formulas."""

import math
from dataclasses import replace

import injector
import numpy as np
import pytest

from coax_env import load_vehicle, read_flight
from coax_env.diagnosis.problem import Problem
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Noise, Record
from coax_env.model import effects
from coax_env.model.layout import CHANNEL_UNITS, CHANNELS, FULL_STATES, N_FULL
from coax_env.model.usual_sizes import QUANTITIES, factor, sized_for
from coax_env.model.vehicle import Vehicle

LAMA = load_vehicle("lama400d")
LENGTH, MASS = 0.6, 0.35
"""Of the scaled machine, in lama400d's; gravity is the same, so that times go as the root of length."""
TIME = math.sqrt(LENGTH)
DIMENSIONS = {
    "kg": MASS, "m/s2": 1.0, "kg/m3": MASS / LENGTH**3, "m": LENGTH, "kg m2": MASS * LENGTH**2,
    "1": 1.0, "s": TIME, "rad": 1.0, "m/s": LENGTH / TIME, "rad/s": 1.0 / TIME, "rad/s2": 1.0 / TIME**2,
    "rev/min": 1.0 / TIME, "m2": LENGTH**2, "s/m": TIME / LENGTH, "rad per m/s": TIME / LENGTH,
    "N s/m per rad/s": MASS, "N m s": MASS * LENGTH**2 / TIME, "N/m": MASS / LENGTH,
    "N": MASS, "N m": MASS * LENGTH, "N m/rad": MASS * LENGTH,
}  # fmt: skip
"""Unit -> what a number in it is multiplied with."""


def scaled_lama() -> Vehicle:
    """Every number with its std, as dimensional analysis has them."""
    return LAMA.with_parameters(
        {
            name: replace(p, value=p.value * DIMENSIONS[p.unit], std=p.std * DIMENSIONS[p.unit])
            for name, p in LAMA.parameters.items()
        }
    )


SMALL = scaled_lama()


def test_sizes_on_lama400d_are_the_catalogues():
    for name, entry in effects.GROUPS.items():
        assert sized_for(LAMA, name) == entry.parameters


def dimension(unit: str) -> float:
    """What a number in a unit is multiplied with, also ``N m per (m/s)(rad/s)``, ``N per (m/s)2``."""
    if unit in DIMENSIONS:
        return DIMENSIONS[unit]
    of, _, per = unit.partition(" per ")
    squared = per.endswith(")2")
    parts = per.removesuffix("2" if squared else "").strip("()").split(")(")
    return DIMENSIONS[of] / math.prod(DIMENSIONS[part] for part in parts) ** (2 if squared else 1)


@pytest.mark.parametrize(
    "name", [name for name, e in effects.GROUPS.items() if any(p.scale for p in e.parameters)]
)
def test_sizes_that_scale_have_their_dimension(name):
    """Whatever the scale is made of: it grows as the parameter's own unit does."""
    for own, other in zip(effects.GROUPS[name].parameters, sized_for(SMALL, name), strict=True):
        wanted = dimension(own.unit) if own.scale else 1.0
        for kind in ("usual", "smallest", "probe", "lower", "upper"):
            size = getattr(own, kind)
            assert getattr(other, kind) == pytest.approx(size * wanted if size else 0.0, rel=1e-9)
        assert other.off == own.off


def test_what_is_bought_does_not_scale():
    for name in ("servo_delay", "gyro_bias", "wind", "swash_offset"):
        assert sized_for(SMALL, name) == effects.GROUPS[name].parameters


def test_a_scale_is_read_from_left_to_right():
    ratio = dict.fromkeys(QUANTITIES, 1.0) | {"mass": 2.0, "arm": 3.0, "time": 5.0}
    assert factor("", ratio) == 1.0
    assert factor("1 / time", ratio) == pytest.approx(0.2)
    assert factor("mass / time * arm / time", ratio) == pytest.approx(6.0 / 25.0)


def scaled_record(record: Record) -> Record:
    """The same flight, flown by the scaled machine."""
    command = record.command * [1.0 / TIME, 1.0 / TIME, 1.0, 1.0]
    z = record.z * [DIMENSIONS[CHANNEL_UNITS[c]] for c in CHANNELS]
    return replace(record, t=record.t * TIME, origin=record.origin * TIME, command=command, z=z)


def scaled_noise(noise: Noise) -> Noise:
    def of(level: str) -> float:
        if "memory" in level:
            return TIME
        if level == "rotor_speed":
            return TIME**-1.5
        force = MASS if "force" in level else MASS * LENGTH
        root = 0.5 * level.startswith("white") - 0.5 * level.startswith("trim")
        return force * TIME**root

    return replace(
        noise,
        process={level: value * of(level) for level, value in noise.process.items()},
        reading={c: std * DIMENSIONS[CHANNEL_UNITS[c]] for c, std in noise.reading.items()},
    )


def evidence(
    vehicle: Vehicle, records: list[Record], noise: Noise, starts: np.ndarray
) -> dict[str, float]:
    """Nats expected of every effect that scales, at its usual size.

    starts: what the spreads of the filter's first states are multiplied with, (n,).
    """
    names = [e for e, x in effects.CATALOGUE.items() if any(p.scale for p in x.parameters)]
    problem = Problem.of(HeliModel(vehicle), records, names)
    engine = problem.engine  # whose first states are as wide on every machine
    engine.starts = [(x, P * np.outer(starts, starts)) for x, P in engine.starts]
    values = {**problem.model.bare_values, **{f.name: f.value for f in problem.parameters}}
    _, lin = problem.engine.linearise(values, noise, problem.parameters)
    quadratic = Quadratic.of(lin, problem.parameters, values)
    found = {}
    for name in names:
        own = problem.acting_names(name)
        usual = np.array([f.std for f in problem.own[name] if f.name in own])
        information, _ = quadratic.projected(own, problem.base_names([name]))
        found[name] = 0.5 * float(usual**2 @ np.diag(information))
    return found


def test_a_scaled_machine_gives_the_same_evidence(tmp_path):
    """The flight of a machine scaled dynamically is worth as many nats to every effect."""
    folder = injector.fly(tmp_path / "f", {}, gusts=True, runs=("lon_3211", "yaw_3211"), seed=3)
    flight = read_flight(folder)
    records = [record_of(run) for run in flight.runs]
    noise = starting_noise(flight, LAMA)
    here = evidence(LAMA, records, noise, np.ones(N_FULL))
    starts = np.array([DIMENSIONS[unit] for _, unit in FULL_STATES])
    there = evidence(SMALL, [scaled_record(r) for r in records], scaled_noise(noise), starts)
    assert sum(nats > 1.0 for nats in here.values()) > 5
    for name, nats in here.items():
        assert there[name] == pytest.approx(nats, rel=0.05, abs=0.1), name
