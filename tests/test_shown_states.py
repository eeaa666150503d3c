"""Covariances of the states that any reading shows alone, against those of all states."""

import math

import numpy as np
import pytest
from bundled_flight import bundled
from numba import types
from numpy.testing import assert_allclose
from test_estimation import Pendulum

from coax_env.estimation import frozen_gains, noise_score
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.linearised_runs import moves_of, signatures_of
from coax_env.estimation.run_passes import GATE, Buffers, trace_of
from coax_env.estimation.sparse import aligned, padded
from coax_env.estimation.state_space import STEADY, Noise, Record, part
from coax_env.kernel.compilation import pointer
from coax_env.model.layout import N_FULL, POSITION, SWASH
from coax_env.model.vehicle_file import load_vehicle

_A = types.float64[::1]


@pytest.fixture(scope="module")
def passes():
    """A pass of three seconds of a flight without and with covariances asked for, with its engine."""
    flight = bundled()
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    record = record_of(flight.runs[0])
    engine = Engine(HeliModel(vehicle), [part(record, record.t < record.t[0] + 3.0)])
    noise = starting_noise(flight, vehicle)
    p = engine.model.vector(engine.model.bare_values, noise)
    decay = engine.model.process_noise(noise, p).decay[: engine.model.exact.size]
    decaying = np.flatnonzero(decay > 0.0)
    both = [
        engine.filter_run(0, p, noise, Buffers(), Buffers(), rows, decaying)
        for rows in (None, np.array([50]))
    ]
    return engine, p, noise, both


def test_what_no_reading_shows_is_left_out_and_the_pass_is_the_same(passes):
    """North and east without a position, a swash plate without a lag."""
    _, _, _, ((few, at_few), (every, at_every)) = passes
    shown = few.shown[few.shown >= 0]
    assert not set(range(N_FULL)[POSITION][:2]) & set(shown)
    assert not set(range(N_FULL)[SWASH]) & set(shown)
    assert list(every.shown) == list(range(N_FULL)) and shown.size < N_FULL - 3
    assert few.log_likelihood == pytest.approx(every.log_likelihood, abs=1e-7)
    assert_allclose(few.innovations, every.innovations, atol=1e-9)
    assert_allclose(few.states[:, shown], every.states[:, shown], rtol=1e-9, atol=1e-9)
    r = shown.size
    assert_allclose(few.gains[:, :r], every.gains[:, shown], rtol=1e-5, atol=1e-9)
    assert_allclose(few.H[:, :, :r], every.H[:, :, shown], atol=1e-6)
    used = at_few.F_of[:-1].max() + 1
    assert_allclose(at_few.F[:used, :r, :r], at_every.F[:used][:, shown][:, :, shown], atol=1e-6)
    assert_allclose(at_few.P[:, :, :r], at_every.P[:, :, shown], rtol=1e-5, atol=1e-12)


def test_slopes_in_the_noise_are_the_same(passes):
    engine, p, noise, both = passes
    q, decay = engine.model.process_noise(noise, p)
    nx, m, t = N_FULL, len(engine.model.channels), engine.records[0].t
    block = ((t - t[0]) / 2.0).astype(np.int64)
    found = []
    for run, at in both:
        slopes = noise_score.Slopes(
            np.zeros((2, q.size)), np.zeros((2, q.size)), np.zeros(nx), np.zeros((2, m)),
            np.zeros((2, q.size)), np.zeros(nx), np.zeros(m),
        )  # fmt: skip
        noise_score.score_pass(
            engine.intervals[0], STEADY, trace_of(run, at), engine.compiled.noise_places, q, decay,
            GATE, engine.refresh[0], block, slopes,
        )  # fmt: skip
        found.append(slopes)
    for few, every in zip(*found, strict=True):
        assert_allclose(few, every, rtol=1e-4, atol=1e-5 * np.abs(every).max())


def test_signatures_are_the_same(passes):
    engine, p, noise, both = passes
    free = engine.model.base_parameters() + engine.model.effect_parameters("wind")
    values = {f.name: f.value for f in free} | engine.model.bare_values
    moves = moves_of(engine.model, values, noise, free)
    found = []
    for run, at in both:
        by_channel = np.zeros((len(free), run.innovations.shape[1]))
        J = aligned(run.per_sigma.size, padded(len(free) + 1))
        whole = frozen_gains.Portion(0, run.innovations.shape[0], 0)
        none = frozen_gains.Kept(np.zeros((0, 0, 0), np.float32), np.zeros(0, np.int64))
        signatures_of(engine, 0, run, at, p, moves, by_channel)(whole, J, none)
        found.append(J)
    few, every = found
    assert_allclose(few, every, atol=1e-5 * np.abs(every).max())


@pointer(types.void(_A, _A, types.float64, _A, _A, _A))
def _step(x, u, dt, p, work, out):
    first = x[0] + dt * u[0] * x[1]
    out[1] = x[1] * math.exp(-dt)
    out[0] = first


@pointer(types.void(_A, _A, _A, _A, _A))
def _measure(x, u, p, work, out):
    out[0] = x[0]


@pointer(types.void(_A, _A, types.float64, _A, _A, _A))
def _drift_and_readings(x, u, dt, p, work, out):
    out[0] = dt * u[0] * x[1]
    out[1] = -dt * x[1]
    out[2] = x[0]


class Coupled(Pendulum):
    """A second state that drives the first while the input is not zero."""

    channels = ("first",)
    wraps = np.array([False])
    step = _step
    measure = _measure
    drift_and_readings = _drift_and_readings
    exact = np.array([True, False])

    def vector(self, values, noise=None):
        return np.zeros(1)


@pytest.mark.parametrize("begins", [30, 200])
def test_a_state_that_comes_to_be_shown_is_in_from_the_start(begins):
    """Shown by what happens later, or never: the likelihood is that of all states."""
    rng = np.random.default_rng(4)
    t = 0.02 * np.arange(100)
    u = np.where(np.arange(100) >= begins, 1.0, 0.0)[:, None]
    record = Record("coupled", t, u, rng.standard_normal((100, 1)))
    noise = Noise({"torque": 0.5}, {"first": 1.0})
    engine = Engine(Coupled(), [record])
    (few,) = engine.filter({}, noise)
    (every,) = engine.filter({}, noise, start_rows=[np.array([0])])
    assert list(few.shown) == ([0, 1] if begins < 100 else [0, -1])
    assert few.log_likelihood == pytest.approx(every.log_likelihood, abs=1e-9)
    assert_allclose(few.innovations, every.innovations, atol=1e-10)


@pytest.mark.parametrize("row", [0, 50])
def test_a_jacobian_that_is_not_finite_ends_the_pass(row):
    """It would show any state, and the pass begin again and again."""
    t = 0.02 * np.arange(100)
    u = np.zeros((100, 1))
    u[row : row + 8] = np.nan
    record = Record("astray", t, u, np.zeros((100, 1)))
    (run,) = Engine(Coupled(), [record]).filter({}, Noise({"torque": 0.5}, {"first": 1.0}))
    assert run.log_likelihood == -np.inf
