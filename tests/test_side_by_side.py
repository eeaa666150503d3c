"""Derivatives by SIMD lanes, in portions of a run, against one move after the other."""

from dataclasses import replace

import numpy as np
import pytest
from bundled_flight import bundled
from numpy.testing import assert_allclose

from coax_env.estimation import engine as engines
from coax_env.estimation import run_passes
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import JITTER_REACTION, starting_noise
from coax_env.estimation.lasting_errors import ErringModel, with_errors
from coax_env.estimation.rotor_jitter import JitteryModel, with_jitter
from coax_env.estimation.sparse import add_gram, find_non_zeros, padded, with_places
from coax_env.estimation.state_space import part
from coax_env.estimation.swinging_gusts import SwingingModel
from coax_env.model import effects
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

ACTIVE = {"motor_lag.upper": 0.07, "motor_lag.lower": 0.06, "servo_rate.limit": 3.0,
          "wind.north": -1.0, "rotor_drag.coefficient": 3e-4, "gyro_bias.y": -0.01}  # fmt: skip


LATE = {"command_delay.time": 0.023, "hub_stiffness.lower": 0.2, "accel_bias.x": 0.05}


def one_by_one(model: HeliModel) -> HeliModel:
    """The same model, its derivatives taken one after the other."""
    kind = type(model)
    model.__class__ = type(f"{kind.__name__}OneByOne", (kind,), {"side_by_side": None})
    return model


def same(model: HeliModel) -> HeliModel:
    return model


def erring(vehicle: Vehicle) -> HeliModel:
    return ErringModel(HeliModel(vehicle))


def erring_and_jittery(vehicle: Vehicle) -> HeliModel:
    return ErringModel(JitteryModel(vehicle))


def swinging(vehicle: Vehicle) -> HeliModel:
    return SwingingModel(HeliModel(vehicle), (0.6, 0.8, 1.1, 0.5, 0.0, 0.7))


def of_everything(vehicle: Vehicle) -> HeliModel:
    return ErringModel(SwingingModel(JitteryModel(vehicle), (0.6, 0.8, 1.1, 0.5, 0.0, 0.7)))


@pytest.fixture(scope="module")
def flown():
    """A vehicle, three seconds of a flight, its noise, and every parameter that may be free."""
    flight = bundled()
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    record = record_of(flight.runs[0])
    record = replace(part(record, record.t < record.t[0] + 3.0), of_next=0.375)
    model = HeliModel(vehicle)
    free = model.base_parameters()
    for name, entry in effects.CATALOGUE.items():
        if not entry.line and not entry.named_as:
            free += model.effect_parameters(name)
    values = {f.name: f.value for f in free} | model.bare_values
    return vehicle, record, starting_noise(flight, vehicle), free, values


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "active"),
    [
        (HeliModel, {}),
        (HeliModel, ACTIVE),
        (HeliModel, LATE),
        (JitteryModel, ACTIVE),
        (JitteryModel, LATE),
        (swinging, ACTIVE),
        (erring, ACTIVE),
        (erring_and_jittery, LATE),
        (of_everything, ACTIVE),
    ],
    ids=[
        "bare",
        "six effects",
        "late commands",
        "jitter, six effects",
        "jitter, late commands",
        "swings, six effects",
        "errors that last, six effects",
        "errors that last and jitter, late commands",
        "errors that last in gusts that swing, and jitter",
    ],
)
def test_derivatives_in_lanes_are_those_one_by_one(flown, kind, active):
    """Likelihood and signatures to the rounding of their differences, effects on or off."""
    vehicle, record, noise, free, values = flown
    if kind in (JitteryModel, erring_and_jittery, of_everything):
        noise = with_jitter(noise, HeliModel(vehicle)).with_levels({JITTER_REACTION: 0.7})
    if kind in (erring, erring_and_jittery, of_everything):
        noise = with_errors(noise)
    both = []
    for lanes in (same, one_by_one):
        engine = Engine(lanes(kind(vehicle)), [record])
        assert engine.compiled.has_lanes == (lanes is same)
        (run,), lin = engine.linearise({**values, **active}, noise, free)
        both.append((run.log_likelihood, lin))
    (ours, lanes), (theirs, single) = both
    assert_allclose(ours, theirs, atol=1e-6)
    size = np.sqrt(np.diag(single.information[0])) + 1e-30
    scale = np.outer(size, size)
    assert_allclose(lanes.information[0] / scale, single.information[0] / scale, atol=1e-6)
    assert_allclose(lanes.blocks / size, single.blocks / size, atol=1e-5)
    assert_allclose(
        lanes.by_channel[0].sum(1), np.diag(lanes.information[0]), rtol=1e-9, atol=1e-30
    )


def test_portions_of_a_run_are_the_run(flown, monkeypatch):
    vehicle, record, noise, free, values = flown
    found = []
    for count in (1, 100):
        monkeypatch.setattr(engines, "BLOCKS_AT_ONCE", count)
        found.append(Engine(HeliModel(vehicle), [record]).linearise(values, noise, free)[1])
    for name in ("information", "blocks", "by_channel"):
        one, whole = getattr(found[0], name), getattr(found[1], name)
        assert_allclose(one, whole, rtol=1e-8, atol=1e-9 * np.abs(whole).max())


def test_rows_between_jacobians_follow_the_clock():
    """Every 40 ms on a log faster than 100 Hz, every fourth row of a slower one."""
    rows = [
        run_passes._rows_between_jacobians(np.full(50, 1.0 / rate)) for rate in (25, 100, 200, 500)
    ]
    assert rows == [4, 4, 8, 20]


def test_non_zeros_are_found_again_where_they_change():
    A = with_places(np.zeros((3, padded(20))), 20)
    rng = np.random.default_rng(0)
    for _ in range(20):
        A.values[:, :20] = rng.normal(size=(3, 20)) * (rng.random((3, 20)) < 0.3)
        A.values[1, 7] = np.nan
        find_non_zeros(A)
        for row, places, count in zip(A.values, A.places, A.counts, strict=True):
            assert list(places[:count]) == list(np.flatnonzero(row[:20] != 0.0))


@pytest.mark.parametrize("count", [1, 12, 32, 75])
def test_products_of_columns_are_added_up(count):
    """At and right of the diagonal, the column after the last with them, whatever G was before."""
    rng = np.random.default_rng(count)
    width = padded(count + 1)
    J, G = np.zeros((70, width)), np.zeros((width, width))
    J[:, : count + 1] = rng.normal(size=(70, count + 1))
    G[:count, : count + 1] = before = rng.normal(size=(count, count + 1))
    add_gram(J, count, G)
    upper = np.triu(np.ones((count, count + 1), bool))
    found, expected = G[:count, : count + 1], before + (J.T @ J)[:count, : count + 1]
    assert_allclose(found[upper], expected[upper], rtol=1e-12, atol=1e-12)
