"""Readings whose errors last, and attitudes of an onboard filter: in the filter, and what is named.

Without errors the model is the helicopter's own; with them, readings are the helicopter's plus what
fades by its memory.
"""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import injector
import numpy as np
import pytest
from injector_air import GUSTY
from injector_sensors import SENSORS
from numpy.testing import assert_allclose

from coax_env import diagnose, load_vehicle, simulate
from coax_env.diagnosis import onboard_filter, sensor_errors
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import error_level, error_memory, starting_noise
from coax_env.estimation.lasting_errors import ERRING, ErringModel, with_errors, without_errors
from coax_env.estimation.noise_levels import fit_noise
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.rotor_jitter import JitteryModel
from coax_env.estimation.state_space import FreeParameter, Noise, Record
from coax_env.estimation.swinging_gusts import SwingingModel
from coax_env.estimation.wrapping_model import with_innermost
from coax_env.logs.flight import Run, read_flight
from coax_env.model import dynamics
from coax_env.model import state as S
from coax_env.model.layout import (
    ANGLES,
    CHANNELS,
    ERRING_GROUPS,
    GYROS,
    N_CHANNELS,
    N_FULL,
    SENSOR_GROUPS,
)

LAMA = load_vehicle("lama400d")
PLAIN = HeliModel(LAMA)
STD = {group: 0.1 * (k + 1) for k, group in enumerate(ERRING_GROUPS)}
MEMORY = {group: 0.5 * (k + 1) for k, group in enumerate(ERRING_GROUPS)}
NOISE = Noise(
    {error_level(g): s for g, s in STD.items()} | {error_memory(g): m for g, m in MEMORY.items()}
)
GROUP = {channel: group for group, channels in SENSOR_GROUPS.items() for channel in channels}
HOVER, COMMAND = dynamics.hover_trim(LAMA)
INPUT = np.append(np.tile(dynamics.kernel_input(COMMAND), 2), [0.0, 0.0])
ANGLE_PAIRS = list(zip(GYROS, ANGLES, strict=True))


def swinging(model: HeliModel) -> HeliModel:
    return SwingingModel(JitteryModel.like(model), (0.6, 1.2, 0.0, 0.5, 0.9, 0.7))


@pytest.fixture(params=[HeliModel.like, JitteryModel.like, swinging])
def model(request) -> ErringModel:
    """Errors around the helicopter, rotor speeds that jitter, and gusts that swing as well."""
    return ErringModel(request.param(PLAIN))


def state(model: ErringModel) -> np.ndarray:
    x = np.zeros(model.exact.size)
    x[:N_FULL] = dynamics.full_state(HOVER, COMMAND, LAMA)
    x[S.R], x[S.U] = 0.2, 0.5
    x[N_FULL : model.states] = 1.5
    x[model.added] = 0.01 * np.arange(1, len(ERRING) + 1)
    return x


def read(model: HeliModel, x: np.ndarray, p: np.ndarray) -> np.ndarray:
    out = np.zeros(N_CHANNELS)
    model.measure.__wrapped__(x, INPUT, p, np.zeros(model.work_size), out)
    return out


def stepped(model: HeliModel, x: np.ndarray, p: np.ndarray, dt: float = 0.01) -> np.ndarray:
    out = np.zeros(x.size)
    model.step.__wrapped__(x, INPUT, dt, p, np.zeros(model.work_size), out)
    return out


def test_every_reading_but_the_rotors_has_its_error(model):
    x, p, inner = state(model), model.vector({}, NOISE), model.inner
    more = read(model, x, p) - read(inner, x[: model.states], inner.vector({}, NOISE))
    own = x[model.added].tolist()
    expected = dict.fromkeys(CHANNELS, 0.0) | dict(zip(ERRING, own, strict=True))
    assert_allclose(more, list(expected.values()), atol=1e-12)
    assert set(CHANNELS) - set(ERRING) == {"rpm_upper", "rpm_lower", "v"}


def test_errors_fade_and_move_nothing(model):
    x, p, inner = state(model), model.vector({}, NOISE), model.inner
    later = stepped(model, x, p)
    left = [math.exp(-0.01 / MEMORY[GROUP[channel]]) for channel in ERRING]
    assert_allclose(later[model.added], left * x[model.added], rtol=1e-12)
    alone = stepped(inner, x[: model.states], inner.vector({}, NOISE))
    assert np.array_equal(later[: model.states], alone)


def test_the_drift_is_what_the_step_adds_to_first_order(model):
    x, p = state(model), model.vector({}, NOISE)
    out, dt = np.zeros(x.size + N_CHANNELS), 1e-4
    model.drift_and_readings.__wrapped__(x, INPUT, dt, p, np.zeros(model.work_size), out)
    assert_allclose(out[: x.size], stepped(model, x, p, dt) - x, rtol=2e-2, atol=1e-7)
    assert_allclose(out[x.size :], read(model, x, p), rtol=1e-9)


def test_every_error_has_its_levels_variance(model):
    """x' = -x / tau + w has variance q tau / 2; all else is the inner model's noise."""
    errors, p = model.added, model.vector({}, NOISE)
    q, decay = model.process_noise(NOISE, p)
    std = [STD[GROUP[channel]] for channel in ERRING]
    assert_allclose(np.sqrt(q[errors] / (2.0 * decay[errors])), std)
    assert_allclose(model.start_noise(NOISE)[errors], np.square(std))
    alone = model.inner.process_noise(NOISE, model.inner.vector({}, NOISE))
    assert np.array_equal(np.delete(q, np.r_[errors]), alone.intensity)
    assert model.noise_places.shape == (q.size, 2)
    assert_allclose(model.noise_places[errors], np.repeat(np.r_[errors], 2).reshape(-1, 2))


def test_another_motion_keeps_the_errors_and_when_commands_are_read():
    late = ErringModel(PLAIN).reading_after(0.03)
    other = with_innermost(late, JitteryModel)
    assert isinstance(other, ErringModel) and isinstance(other.inner, JitteryModel)
    assert other.read_delay == 0.03 and other.exact.size == late.exact.size + 2
    both = with_innermost(ErringModel(SwingingModel(PLAIN, (1.0,) * 6)), JitteryModel)
    assert isinstance(both.inner.inner, JitteryModel) and both.frequencies == (1.0,) * 6
    alone = with_innermost(PLAIN.reading_after(0.02), JitteryModel)
    assert isinstance(alone, JitteryModel) and alone.read_delay == 0.02


@pytest.fixture(scope="module")
def wandering(tmp_path_factory):
    """**Synthetic**: attitudes wrong by 0.01 rad for 2 s, velocities by 0.2 m/s for 1 s, and others."""
    folder = tmp_path_factory.mktemp("wandering") / "flight"
    runs = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
    hidden = {"imu_tilt": {"x": -0.03, "y": 0.04}}
    return injector.fly(
        folder, hidden, gusts=GUSTY, sensors="wandering", seed=4, runs=runs, longest=11.0
    )


@pytest.mark.slow
def test_without_errors_its_likelihood_is_the_helicopters_and_planted_ones_return(wandering):
    flight = read_flight(wandering)
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    model, noise = HeliModel(vehicle), starting_noise(flight, vehicle)
    values = dict(model.bare_values)
    records = [record_of(run) for run in flight.runs]
    own = Engine(model, records)
    wider = Engine(ErringModel(model), records)
    assert wider.log_likelihood(values, noise) == pytest.approx(
        own.log_likelihood(values, noise), abs=1e-6
    )
    tilted = values | {"imu_tilt.x": -0.03, "imu_tilt.y": 0.04}
    begun = with_errors(noise)
    found = fit_noise(wider, tilted, begun, list(begun.process | begun.reading), 40)
    for group, std, memory in (("attitude", 0.01, 2.0), ("velocity", 0.2, 1.0)):
        assert found.level(error_level(group)) == pytest.approx(std, rel=0.3)
        assert found.level(error_memory(group)) == pytest.approx(memory, rel=0.6)
    assert found.reading["vn"] == pytest.approx(0.5, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("inner", [HeliModel.like, JitteryModel.like])
def test_errors_that_nothing_shakes_are_as_if_they_were_next_to_nothing(inner):
    """Likelihood, slopes in numbers and in noise: of an error of 1e-9 of its reading's noise, whose
    states are carried along, and of none, whose states have no covariance."""
    flight = simulate(LAMA, "lat_doublet", seed=5, sensors="onboard")
    record = record_of(flight.runs[0])
    rows = slice(0, 250)
    short = replace(record, t=record.t[rows], command=record.command[rows], z=record.z[rows])
    model = ErringModel(inner(PLAIN))
    engine, values = Engine(model, [short]), dict(model.bare_values)
    noise = with_errors(starting_noise(flight, LAMA))
    gone = ("velocity", "accelerometers", "heading")
    least = noise.with_levels({error_level(g): 1e-9 * STD[g] for g in gone})
    none = without_errors(noise, gone)
    assert set(noise.process) - set(none.process) == {
        name(group) for group in gone for name in (error_level, error_memory)
    }
    found = [engine.log_likelihood(values, each) for each in (least, none)]
    assert found[0] == pytest.approx(found[1], abs=1e-5)
    free = [FreeParameter("mass", values["mass"], 0.01), FreeParameter("gyro_bias.x", 0.0, 0.01)]
    values = values | {"gyro_bias.x": 0.0}
    kinds = [
        Quadratic.of(engine.linearise(values, n, free)[1], free, values) for n in (least, none)
    ]
    assert_allclose(kinds[0].g, kinds[1].g, rtol=1e-6)
    assert_allclose(kinds[0].precision, kinds[1].precision)
    slopes = [engine.noise_score(values, n).in_noise.sum(axis=0) for n in (least, none)]
    carried = [k for k in range(slopes[0].size) if slopes[1][k] != 0.0]
    assert len(carried) > 6
    assert_allclose(slopes[0][carried], slopes[1][carried], rtol=1e-5)


@pytest.mark.slow
def test_numbers_hold_the_truth_where_errors_last(wandering):
    """Taken for errors of a row, readings moved the tilt by 3 to 4.5 std. **Synthetic**."""
    found = diagnose(wandering)
    (cause,) = found.findings["causes"]
    assert cause["effect"] == "imu_tilt"
    for name, truth in (("imu_tilt.x", -0.03), ("imu_tilt.y", 0.04)):
        number = cause["parameters"][name]
        assert abs(number["value"] - truth) < 2.5 * number["std"]
    assert found.findings["unexplained"] == []
    (said,) = [line for line in found.remarks if line.startswith("readings have errors that last")]
    assert "attitude" in said and "velocity" in said
    assert found.findings["noise"]["memory_error_attitude"]["unit"] == "s"


WHITE = SimpleNamespace(white=True)
COLOURED = SimpleNamespace(white=False)
ABOARD = frozenset({"p", "q", "r", "ax", "ay", "az", "phi", "vn", "h"})


@pytest.mark.parametrize(
    ("coloured", "aboard", "active", "gain", "left", "used"),
    [
        ("phi", ABOARD, (), 100.0, "", True),
        ("vn", ABOARD, (), 100.0, "", True),
        ("q", ABOARD, (), 100.0, "", False),  # nothing asks for it
        ("phi", ABOARD - {"p"}, (), 100.0, "", False),  # no gyro tells it from motion
        ("h", ABOARD - {"az"}, (), 100.0, "", False),  # no accelerometer does
        ("phi", ABOARD, (), 10.0, "", False),  # not worth the threshold
        ("phi", ABOARD, (), 100.0, "psi", False),  # what a model lacks may last, too
        ("phi", ABOARD, (), 100.0, "p", True),  # gusts of another law
        ("", frozenset(), ("attitude_bias",), 100.0, "", True),  # their mean has been named
        ("", frozenset(), ("attitude_bias",), 10.0, "", False),
        ("", frozenset(), ("rotor_drag",), 100.0, "", False),
        ("phi", frozenset(), (), 100.0, "", False),
        ("", ABOARD, ("attitude_bias",), 100.0, "", False),  # gyros would have shown them
        ("onboard filter", ABOARD, (), 100.0, "", True),  # read too seldom to look coloured
        ("onboard filter", ABOARD - {"p", "az"}, (), 100.0, "", False),
        ("", ABOARD, ("sonar_scale",), 100.0, "", False),
        ("white force", ABOARD, ("sonar_scale",), 100.0, "", True),  # named beside one
        ("white force", ABOARD, (), 100.0, "", False),
        ("white force", ABOARD - {"az"}, ("sonar_scale",), 100.0, "", False),  # nothing feels it
    ],
)
def test_errors_last_where_that_is_worth_it_and_no_motion_stays_coloured(
    monkeypatch, coloured, aboard, active, gain, left, used
):
    """The fits are stand-ins, which gain at once what they may."""
    process = {"force_xy": 1.0, "white_force_xy": 1.0 if coloured == "white force" else 2e-3}
    first = Noise(process, {"phi": 0.01, "vn": 0.5}, {"white_force_xy": 1e-3})
    fit = Fit(active, {}, first, objective=500.0)
    gained = lambda problem, fit: replace(fit, objective=500.0 - gain)  # noqa: E731
    answers = [
        {channel: COLOURED if channel == one else WHITE for channel in CHANNELS}
        for one in (coloured, left)
    ]
    monkeypatch.setattr(sensor_errors, "whiteness", lambda passes, channels: answers.pop(0))
    monkeypatch.setattr(sensor_errors, "noise_fitted", lambda problem, fit, evaluations: fit)
    monkeypatch.setattr(sensor_errors, "fitted", gained)
    monkeypatch.setattr(sensor_errors, "converged", gained)
    problem = SimpleNamespace(
        engine=SimpleNamespace(filter=lambda values, noise: []), aboard=aboard, model=PLAIN,
        settings=SETTINGS, noise_fit_seconds=60.0, report=lambda text: None,
        sees_poses_alone=not aboard, of_onboard_filter=coloured == "onboard filter",
    )  # fmt: skip
    problem.with_model = lambda model: SimpleNamespace(**{**vars(problem), "model": model})
    found = sensor_errors.lasting_errors(problem, fit, first)  # type: ignore[arg-type]
    assert (found is not None and found.whiten) == used
    if found is not None:
        assert isinstance(found.problem.model, ErringModel) and found.gained == gain
        names = {name(g) for g in ("attitude", "velocity") for name in (error_level, error_memory)}
        assert found.fit.objective == 400.0 and set(found.begun.process) == {*process, *names}
        assert found.begun.process[error_level("velocity")] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("share", "lost", "kept"), [(0.14, 1.0, False), (0.16, 0.0, True), (0.14, 3.0, True)]
)
def test_small_errors_are_left_out_where_that_costs_no_more_than_convergence(share, lost, kept):
    """Of groups that have less than 0.15 of their readings' own noise."""
    noise = with_errors(Noise({"force_xy": 1.0}, {"phi": 0.01, "theta": 0.03, "h": 0.05}))
    noise = noise.with_levels({error_level("height"): share * 0.05})
    height = {error_level("height"), error_memory("height")}
    every = (*noise.process, *noise.reading)
    worth = lambda values, n: -lost * (error_level("height") not in n.process)  # noqa: E731
    problem: Any = SimpleNamespace(engine=SimpleNamespace(log_likelihood=worth), settings=SETTINGS)
    found = sensor_errors._without_small(problem, Fit((), {}, noise, levels=every))
    gone = set() if kept else height
    assert set(found.levels) == set(every) - gone
    assert set(found.noise.process) == set(noise.process) - gone


def turning(seed: int, carried: str, every: int = 1, common: float = 0.0) -> Run:
    """A body that turns, its gyros, and angles: of a sensor of their own ("no"), or carried by the
    logged gyros, as a row begins ("begin") or by the "mean" of both ends, and back to it in 1 s.

    Attitudes stay small, so that each angle is the integral of its rate.
    """
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(1500)
    measured: dict[str, np.ndarray] = {}
    for k, (rate, angle) in enumerate(ANGLE_PAIRS):
        true = 0.02 * np.sin((1.0 + k) * t) + 0.01 * np.sin(7.0 * t)
        noise = rng.normal(0.0, 0.03, t.size)
        gyro = np.gradient(true, t) + noise
        own = true + rng.normal(0.0, 0.008, t.size) + common * noise
        if carried != "no":
            turns = 0.01 * (gyro[:-1] if carried == "begin" else 0.5 * (gyro[:-1] + gyro[1:]))
            aided = own.copy()
            for i in range(1, t.size):
                aided[i] = aided[i - 1] + turns[i - 1] + 0.01 * (own[i - 1] - aided[i - 1])
            own = aided
        own[np.arange(t.size) % every != 0] = np.nan
        measured |= {rate: gyro, angle: own}
    return Run("run", t, np.zeros((t.size, 4)), measured)


@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize("carried", ["begin", "mean"])
def test_attitudes_that_the_logged_gyros_carry_are_an_onboard_filters(carried, every):
    runs = [turning(seed, carried, every) for seed in (1, 2)]
    assert onboard_filter.of_onboard_filter(runs)
    blind = [
        replace(run, measured={c: x for c, x in run.measured.items() if c != "r"}) for run in runs
    ]
    assert not onboard_filter.of_onboard_filter(blind)


@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize("common", [0.0, 0.2])
def test_attitudes_of_a_sensor_of_their_own_are_not(every, common):
    """Nor where both have noise in common from row to row, as of one supply."""
    for seed in range(20):
        assert not onboard_filter.of_onboard_filter([turning(seed, "no", every, common)])


@pytest.mark.parametrize("carried", ["begin", "no"])
def test_an_onboard_filter_is_seen_through_coarse_angles(carried):
    """In steps of 0.3 degrees, where turns from row to row are 0 or whole steps."""
    runs = [turning(seed, carried) for seed in range(1, 7)]
    for run in runs:
        for _, angle in ANGLE_PAIRS:
            run.measured[angle][:] = 0.005 * np.round(run.measured[angle] / 0.005)
    assert onboard_filter.of_onboard_filter(runs) == (carried == "begin")


def test_an_onboard_filter_is_seen_beside_times_that_were_logged_wrong():
    run = turning(1, "begin")
    wrong = np.random.default_rng(2).uniform(-0.003, 0.003, run.t.size)
    assert onboard_filter.of_onboard_filter([replace(run, t=run.t + wrong)])


def test_a_run_without_readings_of_one_angle_says_nothing():
    """A column that is empty in one run is data: the other runs decide. So are uneven readings."""
    fused = turning(1, "begin")
    empty = {c: np.full(x.size, np.nan) if c == "phi" else x for c, x in fused.measured.items()}
    assert onboard_filter.of_onboard_filter([fused, replace(fused, measured=empty)])
    assert not onboard_filter.of_onboard_filter([replace(fused, measured=empty)])
    uneven = np.isin(np.arange(fused.t.size), np.cumsum(np.tile([1, 2, 3], 250)))
    thinned = {c: np.where(uneven, x, np.nan) if c in ("phi", "theta", "psi") else x
               for c, x in fused.measured.items()}  # fmt: skip
    assert not onboard_filter.of_onboard_filter([replace(fused, measured=thinned)])


def test_two_angles_of_three_are_no_onboard_filters():
    """Telemetry's heading turns as its gyro says, aliases and all; roll and pitch do not."""
    fused, own = turning(1, "begin"), turning(2, "no")
    mixed = {c: (own if c == "phi" else fused).measured[c] for c in fused.measured}
    assert not onboard_filter.of_onboard_filter([replace(fused, measured=mixed)])


def test_an_onboard_filters_states_are_read_once_a_second():
    """Rows of their own where readings are missing; gyros and accelerometers in every row."""
    t = 0.01 * np.arange(500)
    z = np.ones((500, N_CHANNELS))
    z[:30, CHANNELS.index("vn")] = np.nan
    (found,) = onboard_filter.read_seldom([Record("a", t, np.zeros((500, 4)), z)], CHANNELS)
    read = {c: np.flatnonzero(np.isfinite(found.z[:, i])) for i, c in enumerate(CHANNELS)}
    assert read["phi"].tolist() == read["h"].tolist() == [0, 100, 200, 300, 400]
    assert read["vn"].tolist() == [30, 130, 230, 330, 430]
    assert all(read[c].size == 500 for c in ("p", "az", "rpm_upper"))
    assert np.isfinite(z[30:]).all()


@pytest.mark.slow
def test_an_onboard_filters_drift_is_no_stabiliser_bars(tmp_path, monkeypatch):
    """Its gyros drift by a third of their noise and its attitudes, read once a second, cannot look
    coloured: errors that last are asked for all the same, and nothing is named. **Synthetic**."""
    sensors = SENSORS["fused"]._replace(flicker=dict.fromkeys(GYROS, 0.01))
    monkeypatch.setitem(SENSORS, "fused", sensors)
    runs = ("lon_3211", "lat_3211", "low_hover")
    injector.fly(tmp_path, {}, gusts=GUSTY, sensors="fused", seed=4, runs=runs, longest=14.0)
    found = diagnose(tmp_path)
    assert found.findings["causes"] == []
    (said,) = [line for line in found.remarks if line.startswith("readings have errors that last")]
    assert "gyros" in said


@pytest.mark.slow
def test_what_an_onboard_filter_follows_is_named_and_doubted(tmp_path):
    """Attitudes, velocities and height of a filter that the gyros' bias is in, in part. When every row
    of such states was read, six of eight had a gyro's scale that is not there. **Synthetic**."""
    runs = ("lon_3211", "heave_3211", "yaw_3211")
    hidden = {"motor_lag": {"upper": 0.08, "lower": 0.06}, "gyro_bias": {"x": 0.03, "z": -0.04}}
    injector.fly(tmp_path, hidden, gusts=GUSTY, sensors="fused", seed=3, runs=runs, longest=10.0)
    found = diagnose(tmp_path)
    causes = {cause["effect"]: cause for cause in found.findings["causes"]}
    assert set(causes) == set(hidden) and found.findings["verdict"] == "explained"
    assert causes["motor_lag"]["trust"] == "sure" and causes["gyro_bias"]["trust"] == "doubtful"
    assert any("onboard filter" in reason for reason in causes["gyro_bias"]["doubts"])
    for name, true in (("x", 0.03), ("y", 0.0), ("z", -0.04)):
        number = causes["gyro_bias"]["parameters"][f"gyro_bias.{name}"]
        assert abs(number["value"] - true) < 2.0 * number["std"]
        assert number["std"] > 0.3 * 0.04  # to a half
    (said,) = [line for line in found.remarks if "an onboard filter's" in line]
    assert "known to a half" in said
