"""The world of CoaxHeli-v0: sensors and actuators of the file, turbulence, tasks, drawn vehicles."""

import math
import warnings
from dataclasses import replace
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
from corrected import ASKEW, LATE_AND_ASKEW
from gymnasium.utils.env_checker import check_env

import coax_env
from coax_env.env import fleet, hover, tasks
from coax_env.env.gym_env import CoaxEnv
from coax_env.env.period import DT
from coax_env.env.randomisation import Draws
from coax_env.env.turbulence import dryden
from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.errors import InputError
from coax_env.kernel.simd import SIMD_WIDTH
from coax_env.model import dynamics, effects
from coax_env.model.actuators import limit, limits
from coax_env.model.layout import CHANNELS
from coax_env.model.sensors import SUITES, log_suite, suite
from coax_env.model.vehicle_file import load_vehicle, vehicle_toml
from coax_env.simulation.simulate import fly

LAMA = load_vehicle("lama400d")
DRAGGED = LAMA.with_effect("rotor_drag", coefficient=4e-4)
EYED = (
    LAMA.with_sensor("h", dropout=0.2, delay=0.085, bias_std=0.05)
    .with_sensor("p", bias=0.01, noise=0.0)
    .with_sensor("psi", rate=10.0)
)
TRIM = dynamics.hover_trim(LAMA)


def actions(seed: int, *shape: int, size: float = 0.4) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-size, size, shape).astype(np.float32)


def held_still(env: CoaxEnv, rows: int) -> tuple[list[str], np.ndarray]:
    """Names and observations of a helicopter that is put back to hover before every row."""
    observations = [env.reset(seed=1, options={"state": TRIM[0]})[0]]
    for _ in range(rows - 1):
        observations.append(env.step(np.zeros(4))[0])
        env.fleet.x[0, :16] = TRIM[0]
    return list(env.observation_names), np.array(observations)


# --- sensors of the vehicle file --------------------------------------------------------------------


def test_a_file_keeps_what_its_sensors_and_actuators_are(tmp_path):
    given = EYED.with_actuators(swash_travel=0.2, rotor_acceleration=300.0)
    path = tmp_path / "eyed.toml"
    path.write_text(vehicle_toml(given))
    found = load_vehicle(path)
    assert found.sensors == given.sensors and found.actuators == given.actuators
    assert found.sensors["h"]["bias"].std == 0.05 and found.sensors["h"]["bias"].unit == "m"
    assert found.without_effects().sensors == given.sensors


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (
            '[sensors.radar]\nnoise = {value=1, std=0, unit="m", source=""}',
            "radar is not a channel",
        ),
        ('[sensors.h]\ncolour = {value=1, std=0, unit="m", source=""}', "colour is none of"),
        ('[sensors.h]\nnoise = {value=1, std=0, unit="cm", source=""}', "must be in 'm'"),
        ('[sensors.h]\nnoise = {value=-1, std=0, unit="m", source=""}', "not be negative"),
        ('[sensors.h]\nrate = {value=0, std=0, unit="Hz", source=""}', "be positive"),
        ('[sensors.h]\ndropout = {value=1, std=0, unit="1", source=""}', "less than 1"),
        ('[sensors.h]\ndelay = {value=3, std=0, unit="s", source=""}', "0 .. 1 s"),
        ('[sensors.h]\nnoise = {value=1, std=0, unit="m"}', "has no source"),
        ("[sensors]\nh = 3", "sensors.h] is missing or not a table"),
        ('[actuators]\nmuscle = {value=1, std=0, unit="m", source=""}', "muscle is none of"),
        ('[actuators]\nswash_travel = {value=0, std=0, unit="rad", source=""}', "be positive"),
        ('[actuators]\nswash_rate = {value=1, std=0, unit="rad", source=""}', "in 'rad/s'"),
    ],
)
def test_a_wrong_sensor_or_actuator_is_named_in_one_line(tmp_path, lines, said):
    path = tmp_path / "wrong.toml"
    path.write_text(vehicle_toml(LAMA) + "\n" + lines + "\n")
    with pytest.raises(InputError) as error:
        load_vehicle(path)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_crossed_bounds_are_an_error_where_the_sensor_is_used():
    with pytest.raises(InputError, match=r"sensors\.h: low 7 is not below high 6\.5"):
        suite("onboard", LAMA.with_sensor("h", low=7.0))


def test_exact_suites_stay_exact():
    assert suite("state", EYED) == SUITES["state"]
    assert log_suite("state", EYED) == log_suite("state")


def test_lost_echoes_hold_the_reading_and_are_not_new():
    names, rows = held_still(CoaxEnv(LAMA.with_sensor("h", dropout=0.3)), 4000)
    new, h = rows[:, names.index("new_sonar")] > 0.5, rows[:, names.index("h")]
    due = np.arange(4000) % 5 == 0
    assert not new[~due].any()
    share, n = 1.0 - new[due].mean(), due.sum()
    assert abs(share - 0.3) < 4.0 * math.sqrt(0.3 * 0.7 / n)
    held = np.flatnonzero(~new)
    assert np.array_equal(h[held], h[held - 1])
    assert (h[new][1:] != h[new][:-1]).all()


def test_channels_of_one_instrument_are_lost_together():
    vehicle = LAMA
    for channel in ("vn", "ve", "vd"):
        vehicle = vehicle.with_sensor(channel, dropout=0.5)
    names, rows = held_still(CoaxEnv(vehicle), 600)
    moved = np.array([np.diff(rows[:, names.index(c)]) != 0.0 for c in ("vn", "ve", "vd")])
    assert (moved[0] == moved[1]).all() and (moved[0] == moved[2]).all()
    assert np.array_equal(moved[0], rows[1:, names.index("new_velocity")] > 0.5)
    flight = coax_env.simulate(vehicle, "hover", seed=1)
    lost = np.array([np.isnan(flight.runs[0].measured[c]) for c in ("vn", "ve", "vd")])
    assert (lost == lost[0]).all()
    fresh = (~lost[0]).sum() / (len(lost[0]) / 10)
    assert fresh == pytest.approx(0.5, abs=0.2)


def test_a_delayed_reading_is_the_earlier_truth():
    delay = 0.035
    vehicle = LAMA.with_sensor("q", delay=delay, noise=0.0)
    env = CoaxEnv(vehicle)
    env.reset(seed=3)
    truth, seen = [], []
    for action in actions(0, 60, 4):
        observation, *_, info = env.step(action)
        truth.append(info["state"][4])
        seen.append(observation[env.observation_names.index("q")])
    t = np.arange(60) * DT
    expected = np.interp(t - delay, t, truth)
    assert np.allclose(seen[4:], expected[4:], atol=1e-6)
    assert np.abs(np.array(seen) - truth).max() > 0.01


def test_a_flights_bias_is_drawn_once_with_its_std():
    env = CoaxVectorEnv(2000, LAMA.with_sensor("h", bias_std=0.1, noise=0.0, bias=0.2))
    place = env.observation_names.index("h")
    first = env.reset(seed=0, options={"state": TRIM[0]})[0][:, place] - 1.5
    assert first.mean() == pytest.approx(0.2, abs=4 * 0.1 / math.sqrt(2000))
    assert first.std() == pytest.approx(0.1, rel=0.07)
    for _ in range(5):
        *_, info = (step := env.step(np.zeros((2000, 4))))
    later = step[0][:, place] + info["state"][:, 15]
    assert np.allclose(later, first, atol=1e-5)


def test_the_sonar_reads_within_its_range_only():
    env = CoaxEnv(LAMA.with_sensor("h", high=2.0))
    place = env.observation_names.index("h")
    for height, reads in ((0.08, 0.15), (3.0, 2.0)):
        state = np.array(TRIM[0])
        state[15] = -height
        assert env.reset(seed=0, options={"state": state})[0][place] == pytest.approx(
            reads, abs=0.1
        )
    assert env.observation_space.high[place] == 2.0


def test_a_flight_folder_is_seen_by_the_same_tables():
    truth = fly(LAMA, "hover")
    log = coax_env.simulate(
        LAMA.with_sensor("h", dropout=0.25, delay=0.1, bias=0.3), "hover", tremor=0.0
    ).runs[0]
    fresh = np.isfinite(log.measured["h"])
    assert fresh[0]
    assert fresh.sum() == pytest.approx(0.75 * 20.0 * log.t[-1], rel=0.2)
    assert np.nanmean(log.measured["h"]) == pytest.approx(1.8, abs=0.03)
    clean = coax_env.simulate(
        LAMA.with_sensor("q", delay=0.05, dropout=0.5), "lon_doublet", noise=False
    ).runs[0]
    track = fly(LAMA, "lon_doublet")
    late = np.interp(track.t - 0.05, track.t, track.reading("q"))
    assert np.allclose(clean.measured["q"], late, atol=1e-12)
    assert np.isfinite(truth.readings).all()


def test_a_wind_of_random_direction_has_its_speed():
    env = CoaxVectorEnv(800, DRAGGED, wind=2.0)
    env.reset(seed=0)
    air = env.fleet.air
    np.testing.assert_allclose(np.hypot(air[:, 0], air[:, 1]), 2.0, rtol=1e-12)
    assert not air[:, 2].any()
    angle = np.arctan2(air[:, 1], air[:, 0])
    share = np.histogram(angle, bins=8, range=(-math.pi, math.pi))[0] / 800
    assert np.abs(share - 1 / 8).max() < 4.5 * math.sqrt(7 / 64 / 800)


def test_the_layout_of_observations_is_the_suites_whatever_the_file_says():
    assert CoaxEnv(EYED).observation_names == CoaxEnv(LAMA).observation_names


# --- actuators --------------------------------------------------------------------------------------


def test_commands_stay_within_travel_range_and_rate():
    table = limits(LAMA.with_actuators(swash_travel=0.1, swash_rate=2.0, rotor_speed_highest=300.0))
    before = np.zeros(4)
    asked = np.array([400.0, -5.0, 0.5, -0.5])
    command = asked.copy()
    limit(command, before, table, 0.01)
    assert np.allclose(command, [300.0, -5.0, 0.02, -0.02])
    for _ in range(20):
        command = asked.copy()
        limit(command, before, table, 0.01)
    assert np.allclose(command, [300.0, -5.0, 0.1, -0.1]) and np.array_equal(command, before)
    command = np.array([np.nan, 1.0, 0.0, 0.0])
    limit(command, before, table, 0.01)
    assert np.isnan(command[0])


def test_limits_fly_in_the_env_and_in_simulated_flights():
    slow = LAMA.with_actuators(swash_rate=0.5, swash_travel=0.05)
    env = CoaxEnv(slow, sensors="state")
    env.reset(seed=0)
    tilts = [env.step(np.array([0, 0, 1.0, 0]))[4]["state"][18] for _ in range(15)]
    assert np.allclose(tilts, np.minimum(0.005 * np.arange(1, 16), 0.05))
    free, held = fly(LAMA, "lon_doublet"), fly(slow, "lon_doublet")
    assert np.array_equal(free.command, held.command)  # what was asked for
    assert np.abs(held.state[:, 18]).max() == pytest.approx(0.05)
    assert np.abs(np.diff(held.state[:, 18])).max() <= 0.005 + 1e-12
    assert np.abs(free.state[:, 18]).max() > 0.08


# --- every effect flies -----------------------------------------------------------------------------


def usual(effect: str) -> coax_env.Vehicle:
    """A vehicle that feels every effect, with this one at its usual size."""
    base = LAMA.with_effect("rotor_drag", coefficient=2e-4) if effect == "wind" else LAMA
    entry = effects.CATALOGUE[effect]
    return base.with_effect(effect, **{p.name: p.at(1.0) for p in entry.parameters})


def flown_by_hand(x, commands, k, delays, begin, p, work) -> np.ndarray:
    """Fly row k in place: commands arrive `delays` later, (rotors', plate's); what holds at the end."""
    rests = (delay - math.floor(delay / DT + 1e-9) * DT for delay in delays)
    turns = sorted({0.0, DT, *(rest if rest > 1e-9 else 0.0 for rest in rests)})
    for first, last in pairwise(turns):
        held = np.empty(4)
        for columns, delay in ((slice(0, 2), delays[0]), (slice(2, 4), delays[1])):
            given = math.floor(
                (k * DT + 0.5 * (first + last) - delay) / DT
            )  # row whose command holds
            held[columns] = commands[given, columns]
        if last - first > 1e-9:
            dynamics.step(x, dynamics.kernel_input(held, begin + first), last - first, p, work, x)
            in_force = held
    return in_force


@pytest.mark.parametrize(
    "effect", [e for e in effects.CATALOGUE if e != "battery_voltage"]
)  # always nominal
def test_every_effect_flies_in_the_env_as_in_the_scalar_simulation(effect):
    vehicle = usual(effect)
    bare = vehicle.without_effects()
    sharp = dict.fromkeys(("p", "q", "r", "ax", "ay", "az", "phi", "theta", "psi", "h"), 0.0)
    flown = []
    for machine in (vehicle, bare):
        for channel in sharp:
            machine = machine.with_sensor(channel, noise=0.0)
        env = CoaxEnv(machine, nominal=LAMA)
        env.reset(seed=4)
        start = env.fleet.x[0].copy()
        start[15] = -0.4
        start[2], start[5] = 0.3, 0.5
        first = env.reset(seed=4, options={"state": start})[0]
        rows = [env.step(a) for a in actions(2, 100, 4, size=0.3)]
        flown.append(
            (np.array([r[4]["state"] for r in rows]), np.array([r[0] for r in rows]), first)
        )
    (states, observations, _), (bare_states, bare_observations, _) = flown
    assert not (
        np.array_equal(states, bare_states) and np.array_equal(observations, bare_observations)
    )
    x, work = start.copy(), np.zeros(dynamics.WORK_SIZE)
    given = np.vstack([np.zeros((4, 4)), actions(2, 100, 4, size=0.3)]).astype(float)
    commands = env.fleet.trim + env.fleet.scale * given
    common = vehicle.values().get("command_delay.time", 0.0)
    delays = common, common + vehicle.values().get("servo_delay.time", 0.0)
    readings = np.empty(len(CHANNELS))
    rates = [CHANNELS.index(c) for c in ("p", "q", "r")]
    seen = [env.observation_names.index(c) for c in ("p", "q", "r")]
    for row in range(100):
        held = flown_by_hand(x, commands, row + 4, delays, row * DT, vehicle.vector, work)
        assert np.allclose(states[row], x, rtol=1e-9, atol=1e-12)
        now = dynamics.kernel_input(held, (row + 1) * DT)
        dynamics.measure(x, now, vehicle.vector, work, readings)
        if effect != "vibration":  # its azimuth is not in the state
            assert np.allclose(observations[row, seen], readings[rates], atol=1e-5)


@pytest.mark.parametrize(
    ("common", "of_servos"),
    [
        (0.0, 0.004),
        (0.0, 0.01),
        (0.0, 0.027),
        (0.013, 0.0),
        (0.02, 0.0),
        (0.013, 0.009),
        (0.004, 0.01),
    ],
)
def test_delays_split_the_period_where_they_must(common, of_servos):
    """Flown by hand: each command arrives that much later, the plate's by the sum of both."""
    late = LAMA.with_effect("servo_delay", time=of_servos).with_effect("command_delay", time=common)
    env = CoaxEnv(late, nominal=LAMA, sensors="state")
    env.reset(seed=0, options={"state": TRIM[0]})
    fleet, work = env.fleet, np.zeros(dynamics.WORK_SIZE)
    x = dynamics.full_state(*TRIM, LAMA)
    given = np.vstack([np.zeros((4, 4)), actions(4, 40, 4, size=0.3)]).astype(float)
    commands = fleet.trim + fleet.scale * given
    for k in range(4, len(given)):
        state = env.step(given[k])[4]["state"]
        flown_by_hand(x, commands, k, (common, common + of_servos), 0.0, LAMA.vector, work)
        np.testing.assert_allclose(state[:16], x[:16], atol=1e-9)


LOGGED = (
    LAMA.with_effect("servo_delay", time=0.013)
    .with_effect("motor_lag", upper=0.1, lower=0.12)
    .with_actuators(swash_travel=0.06, swash_rate=1.0)
)


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", [LAMA, LOGGED], ids=["bare", "slow actuators"])
@pytest.mark.parametrize("name", ["lat_doublet", "climb_descend"])
def test_what_is_logged_is_what_is_flown(vehicle, name):
    """The commands of a simulated maneuver, given to the env row by row, fly the same flight."""
    track = fly(vehicle, name, closed_loop=True, tremor=0.5)
    env = CoaxEnv(vehicle, nominal=vehicle)
    env.reset(seed=0, options={"state": track.state[0]})
    given = (track.command - env.fleet.trim) / env.fleet.scale
    assert np.abs(given).max() < 1.0
    states = np.array([env.step(action)[4]["state"] for action in given[:-1]])
    np.testing.assert_allclose(states, track.state[1:], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "count", [3, pytest.param(19, marks=pytest.mark.slow)], ids=["one by one", "in lanes"]
)
def test_what_is_under_way_in_a_late_servo_at_reset_is_the_trim(monkeypatch, count):
    """A machine rigged askew hovers with its plate tilted: nothing moves before a command does."""
    monkeypatch.setattr(fleet, "SIMD_VARIANT_FROM", SIMD_WIDTH)
    env = CoaxVectorEnv(count, LATE_AND_ASKEW, nominal=ASKEW)
    trim, command = dynamics.hover_trim(ASKEW)
    assert np.abs(command[2:]).min() > 0.01
    env.reset(seed=0, options={"state": np.tile(trim, (count, 1))})
    for _ in range(6):
        state = env.step(np.zeros((count, 4)))[4]["state"]
    np.testing.assert_allclose(state[:, :16], np.tile(trim, (count, 1)), atol=1e-6)


@pytest.mark.parametrize("count", [3, 19], ids=["one by one", "in lanes"])
@pytest.mark.parametrize("gusts", [(0.2, 0.0), (0.0, 0.01)])
def test_gusts_of_force_or_of_moment_alone_blow(gusts, count):
    env = CoaxVectorEnv(count, gusts=gusts)
    env.reset(seed=0)
    for _ in range(5):
        state = env.step(np.zeros((count, 4)))[4]["state"]
    assert state[:, 20:23].any(axis=0).all() == (gusts[0] > 0.0)
    assert state[:, 23:26].any(axis=0).all() == (gusts[1] > 0.0)


# --- turbulence -------------------------------------------------------------------------------------


def test_turbulence_acts_through_drag_and_not_on_a_bare_vehicle():
    flown = {}
    for name, vehicle in (("bare", LAMA), ("dragged", DRAGGED)):
        for turbulence in (None, 6.0):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that it cannot act
                env = CoaxEnv(vehicle, turbulence=turbulence, sensors="state")
            state = env.reset(seed=2, options={"state": TRIM[0]})[1]["state"]
            for _ in range(100):
                state = env.step(np.zeros(4))[4]["state"]
            flown[name, turbulence] = state
    assert np.array_equal(flown["bare", None], flown["bare", 6.0])
    assert np.abs(flown["dragged", 6.0] - flown["dragged", None])[:3].max() > 0.05


@pytest.mark.usefixtures("one_by_one")
def test_turbulence_rides_on_the_steady_wind():
    env = CoaxVectorEnv(300, DRAGGED, wind=(0.0, 5.0), turbulence=5.0)
    env.reset(seed=0)
    air = []
    for _ in range(40):
        env.step(np.zeros((300, 4)))
        air.append(env.fleet.air)
    sigma, sigma_w, *_ = dryden(1.5, 5.0)
    assert np.allclose(np.mean(air, axis=(0, 1)), [0.0, 5.0, 0.0], atol=4 * sigma / math.sqrt(300))
    assert np.allclose(np.std(air[0], axis=0), [sigma, sigma, sigma_w], rtol=0.15)
    up = np.corrcoef(env.fleet.air[:, 2], env.fleet.x[:, 2])[0, 1]
    assert abs(up) < 0.2  # rotor drag lies in the rotor's plane


@pytest.mark.usefixtures("one_by_one")
def test_eddies_are_as_large_as_the_height_flown_at():
    """Dryden's lengths grow with height: what changes in a tenth of a second is a smaller part."""
    changes = []
    for height in (3.0, 5.7):
        env = CoaxVectorEnv(400, DRAGGED, turbulence=5.0)
        env.reset(seed=3)
        env.fleet.x[:, 15] = -height
        air = []
        for _ in range(11):
            env.step(np.zeros((400, 4)))
            air.append(env.fleet.air.copy())
        change = np.mean((air[-1] - air[0])[:, :2] ** 2)
        changes.append(change / np.mean(np.square(air)[..., :2]))
    (_, _, low, _), (_, _, high, _) = dryden(3.0, 5.0), dryden(5.7, 5.0)
    assert changes[0] / changes[1] == pytest.approx(high / low, rel=0.15)
    assert high / low > 1.4


def test_a_downdraught_pushes_a_vehicle_that_has_axial_damping():
    vehicle = LAMA.with_effect("axial_damping", coefficient=0.1)
    values = vehicle.vector.copy()
    values[effects.AIR] = 1.0
    values[effects.P.AIR_DOWN] = 1.0
    x = dynamics.full_state(*TRIM, LAMA)
    work, out = np.zeros(dynamics.WORK_SIZE), np.empty(29)
    dynamics.step(x, dynamics.kernel_input(TRIM[1]), 0.01, values, work, out)
    assert out[2] == pytest.approx(0.1 * 9.804 * 0.01, rel=0.02)  # thrust times 1 + k (w - 1)


# --- tasks ------------------------------------------------------------------------------------------

AIMED = [(task, sensors) for task in ("position", "waypoints") for sensors in ("mocap", "state")]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "sensors"), AIMED)
def test_check_env_passes_for_every_task_without_a_warning(task, sensors):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make("CoaxHeli-v0", task=task, sensors=sensors).unwrapped)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "sensors"), AIMED)
def test_stable_baselines_check_passes_for_every_task_without_a_warning(task, sensors):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(
            gymnasium.make("CoaxHeli-v0", task=task, sensors=sensors, vehicle=EYED).unwrapped
        )


def test_make_vec_takes_every_argument_and_its_own_time_limit():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make_vec(
            "CoaxHeli-v0", num_envs=2, vectorization_mode="vector_entry_point",
            vehicle=DRAGGED, autoreset_mode="SameStep", max_episode_steps=7,
            task="waypoints", sensors="state", turbulence="light", wind=1.0,
            randomize={"mass": (0.7, 0.9)},
        )  # fmt: skip
    assert env.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.SAME_STEP
    env.reset(seed=0)
    for _ in range(7):
        _, _, terminated, truncated, info = env.step(np.zeros((2, 4)))
    assert truncated.all() and not terminated.any()
    assert info["_vehicle"].all() and info["_final_obs"].all()
    assert (info["reached"] == 0).all()


@pytest.mark.parametrize(
    "wrong",
    [
        {"task": "race"}, {"task": "position"}, {"task": "waypoints", "sensors": "paper"},
        {"target": (0.0, 0.0, 1.0, 0.0)}, {"turbulence": "hurricane"}, {"turbulence": -1.0},
        {"task": "position", "sensors": "state", "target": [(0, 0, 1, 0), (1, 0, 1, 0)]},
        {"task": "waypoints", "sensors": "state", "target": [(0, 0, 1)]},
        {"task": "waypoints", "sensors": "state", "target": (0, 0, 99.0, 0)},
        {"task": "waypoints", "sensors": "state", "target": "home"},
        {"randomize": {"weight": (1.0, 2.0)}}, {"randomize": {"mass": (2.0, 1.0)}},
        {"randomize": {"mass": (0.0, 1.0)}}, {"randomize": {"mass": 1.0}},
        {"randomize": {"motor_lag.upper": (0.0, 9.0)}}, {"randomize": {"wind.up": (0.0, 1.0)}},
        {"randomize": []}, {"randomize": ["zeppelin"]}, {"randomize": 3},
    ],
)  # fmt: skip
def test_a_wrong_world_is_named_in_one_line(wrong):
    with pytest.raises(InputError) as error:
        CoaxEnv(**wrong)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("task", tasks.TASKS)
def test_rewards_are_the_sum_of_their_named_terms(task):
    env = CoaxEnv(task=task, sensors="state")
    env.reset(seed=0)
    weights = tasks.TASKS[task].weights
    assert sum(w for name, w in weights.items() if name != "reached") == pytest.approx(1.0)
    for action in actions(5, 20, 4):
        _, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        assert tuple(info["reward_terms"]) == tuple(weights)
        assert 0.0 < reward < 1.0


def test_the_observation_points_to_the_target():
    env = CoaxEnv(task="position", sensors="state", target=(2.0, 1.0, 2.0, 0.5))
    state = np.array(TRIM[0])
    state[12], state[13], state[14] = 0.3, 1.0, 1.0  # one metre south of it, heading 0.3
    observation, info = env.reset(seed=0, options={"state": state})
    way = dict(zip(env.observation_names, observation, strict=True))
    assert way["target_forward"] == pytest.approx(math.cos(0.3), abs=1e-6)
    assert way["target_right"] == pytest.approx(-math.sin(0.3), abs=1e-6)
    assert way["target_up"] == pytest.approx(0.5, abs=1e-6)
    assert way["heading_error"] == pytest.approx(0.2, abs=1e-6)
    assert np.allclose(info["target"], [2.0, 1.0, -2.0, 0.5])


def test_the_way_to_the_target_is_made_of_readings_not_of_truth():
    blind = LAMA.with_sensor("pn", bias=0.5).with_sensor("h", bias=0.2, noise=0.0)
    env = CoaxEnv(blind, sensors="mocap", task="position", target=(1.0, 0.0, 1.5, 0.0))
    observation, _ = env.reset(seed=0, options={"state": TRIM[0]})
    way = dict(zip(env.observation_names, observation, strict=True))
    assert way["target_forward"] == pytest.approx(0.5, abs=0.03)
    assert way["target_up"] == pytest.approx(-0.2, abs=1e-5)


def test_holding_the_target_is_worth_the_most_and_counts_as_success():
    target = (0.5, -0.5, 1.2, 0.4)
    env = CoaxEnv(task="position", sensors="state", target=target)
    goal = np.array(TRIM[0])
    goal[12:16] = 0.4, 0.5, -0.5, -1.2
    env.reset(seed=0, options={"state": goal})
    assert env.step(np.zeros(4))[1] == pytest.approx(1.0, abs=2e-3)
    steps = 600
    still, aims = np.tile(goal, (steps, 1)), np.tile((0.5, -0.5, -1.2, 0.4), (steps, 1))
    assert tasks.succeeded("position", still, aims, steps)
    assert not tasks.succeeded("position", still[:-1], aims[:-1], steps)
    for place, error in ((15, 0.11), (12, 0.2), (0, 0.26), (13, 2.1)):
        off = still.copy()
        off[:, place] += error
        assert not tasks.succeeded("position", off, aims, steps)
        early = np.vstack([off[:299], still[299:]])  # before three seconds nothing counts
        assert tasks.succeeded("position", early, aims, steps)


def test_waypoints_move_on_after_a_dwell_within_radius_and_heading():
    course = [(0.2, 0.0, 1.5, 0.1), (1.0, 0.0, 1.5, 0.0), (0.0, 1.0, 1.5, 0.0)]
    env = CoaxEnv(task="waypoints", sensors="state", target=course)
    env.reset(seed=0, options={"state": TRIM[0]})
    rewards, targets, reached = [], [], []
    for _ in range(60):
        observation, *_, info = env.step(np.zeros(4))
        env.fleet.x[0, :16] = TRIM[0]
        rewards.append(info["reward_terms"]["reached"])
        targets.append(info["target"])
        reached.append(info["reached"])
        assert observation[-4] == pytest.approx(info["target"][0], abs=1e-3)
    assert np.flatnonzero(rewards).tolist() == [49]  # half a second
    assert rewards[49] == tasks.TASKS["waypoints"].weights["reached"]
    assert reached[48:51] == [0, 1, 1]
    assert np.allclose(targets[48], [0.2, 0.0, -1.5, 0.1])
    assert np.allclose(targets[49], [1.0, 0.0, -1.5, 0.0])
    for place, value in ((13, 0.6), (15, -1.9), (12, 0.5)):
        outside = np.array(TRIM[0])
        outside[place] = value
        env.reset(seed=0, options={"state": outside})
        for _ in range(60):
            *_, info = env.step(np.zeros(4))
            env.fleet.x[0, :16] = outside
        assert info["reached"] == 0


def test_the_last_waypoint_stays_and_is_paid_once():
    env = CoaxEnv(task="waypoints", sensors="state", target=(0.0, 0.0, 1.5, 0.0))
    env.reset(seed=0, options={"state": TRIM[0]})
    paid = 0.0
    for _ in range(160):
        _, _, terminated, _, info = env.step(np.zeros(4))
        env.fleet.x[0, :16] = TRIM[0]
        paid += info["reward_terms"]["reached"]
    assert paid == 50.0 and info["reached"] == 1 and not terminated
    assert np.allclose(info["target"], [0.0, 0.0, -1.5, 0.0])


def test_drawn_targets_fill_their_box_and_follow_each_other():
    env = CoaxVectorEnv(3000, task="waypoints", sensors="state")
    _, info = env.reset(seed=0)
    drawn = info["target"] * (1.0, 1.0, -1.0, 1.0)
    own = tasks.TASKS["waypoints"]
    low, high = np.array(own.lowest), np.array(own.highest)
    assert (drawn >= low).all() and (drawn <= high).all()
    assert np.allclose(drawn.std(axis=0), (high - low) / math.sqrt(12.0), rtol=0.05)
    for _ in range(50):
        env.fleet.x[:, :16] = 0.0
        env.fleet.x[:, 12:16] = np.roll(info["target"], 1, axis=1)
        *_, step_info = env.step(np.zeros((3000, 4)))
    assert (step_info["reached"] == 1).all()
    assert (np.abs(step_info["target"] - info["target"]).max(axis=1) > 1e-6).all()


# --- drawn vehicles ---------------------------------------------------------------------------------


def test_ranges_draw_uniformly_and_fly():
    ranges = {"mass": (0.7, 0.9), "ground_effect.gain": (0.0, 0.3)}
    env = CoaxVectorEnv(3000, randomize=ranges)
    _, info = env.reset(seed=0)
    for name, (low, high) in ranges.items():
        drawn = info["vehicle"][name]
        assert low <= drawn.min() and drawn.max() <= high
        assert drawn.mean() == pytest.approx(0.5 * (low + high), rel=0.02)
        assert drawn.std() == pytest.approx((high - low) / math.sqrt(12.0), rel=0.05)
        flown = [env.fleet.params_of(i)[effects.parameter_index(name)] for i in range(3000)]
        assert np.array_equal(flown, drawn)
    assert (info["vehicle"]["ground_effect.decay"] == 2.0).all()
    assert (info["vehicle"]["gravity"] == LAMA["gravity"].value).all()
    assert info["_vehicle"].all()


def test_the_most_a_number_can_be_is_known_before_any_flight():
    """The end of its range, the largest of a list, its limit where a spread has no end."""
    late = LAMA.with_effect("servo_delay", time=0.04)
    drawn = Draws(LAMA, {"servo_delay.time": (0.0, 0.05)})
    assert drawn.most("servo_delay.time") == 0.05 and drawn.most("command_delay.time") == 0.0
    assert Draws(LAMA, [LAMA, late]).most("servo_delay.time") == 0.04
    assert Draws(late).most("servo_delay.time") == 0.04
    limit = effects.CATALOGUE["servo_delay"].parameters[0].upper
    assert Draws(late, "posterior").most("servo_delay.time") == limit


@pytest.mark.usefixtures("one_by_one")
def test_a_list_draws_each_vehicle_with_its_own_sensors_and_limits():
    heavy = LAMA.with_effect("added_mass", mass=0.1).with_actuators(swash_travel=0.01)
    heavy = heavy.with_sensor("h", bias=1.0, noise=0.0)
    env = CoaxVectorEnv(600, randomize=[LAMA, heavy])
    observations, info = env.reset(seed=0, options={"state": TRIM[0]})
    is_heavy = info["vehicle"]["added_mass.mass"] == 0.1
    assert abs(is_heavy.mean() - 0.5) < 0.1
    height = observations[:, env.observation_names.index("h")]
    assert np.allclose(height[is_heavy], 2.5) and (height[~is_heavy] < 2.0).all()
    *_, info = env.step(np.tile([0.0, 0.0, 1.0, 0.0], (600, 1)))
    assert np.allclose(info["state"][is_heavy, 18], 0.01)
    assert np.allclose(info["state"][~is_heavy, 18], 0.2)


def test_a_drawn_vehicle_flies_as_if_it_had_been_given():
    ranges = {
        "mass": (0.7, 0.9),
        "rotor_drag.coefficient": (1e-4, 5e-4),
        "motor_lag.upper": (0, 0.1),
    }
    env = CoaxEnv(randomize=ranges, nominal=LAMA, sensors="state")
    _, info = env.reset(seed=3)
    same = LAMA.with_values({"mass": info["vehicle"]["mass"]})
    for name in list(ranges)[1:]:
        effect, own = name.split(".")
        same = same.with_effect(effect, **{own: info["vehicle"][name]})
    twin = CoaxEnv(same, nominal=LAMA, sensors="state")
    twin.reset(options={"state": info["state"]})
    for action in actions(1, 50, 4):
        ours, theirs = env.step(action), twin.step(action)
        assert np.array_equal(ours[4]["state"], theirs[4]["state"])


def test_the_envs_wind_adds_to_a_drawn_one():
    env = CoaxVectorEnv(9, randomize={"wind.north": (1.0, 2.0)}, wind=(0.5, -1.0))
    drawn = env.reset(seed=0)[1]["vehicle"]["wind.north"]
    assert np.array_equal(env.fleet.air[:, 0], drawn + 0.5)
    assert (env.fleet.air[:, 1] == -1.0).all() and len(set(drawn)) == 9


def test_the_spread_of_a_file_is_drawn_jointly():
    joint = replace(
        LAMA,
        correlated=("mass", "arm_upper"),
        correlation=np.array([[1.0, -0.9], [-0.9, 1.0]]),
    )
    env = CoaxVectorEnv(1500, joint, randomize="posterior")
    drawn = env.reset(seed=0)[1]["vehicle"]
    assert np.corrcoef(drawn["mass"], drawn["arm_upper"])[0, 1] == pytest.approx(-0.9, abs=0.03)
    assert drawn["mass"].std() == pytest.approx(LAMA["mass"].std, rel=0.1)
    assert (drawn["mass"] > 0.0).all() and (drawn["gravity"] == LAMA["gravity"].value).all()


# --- rows -------------------------------------------------------------------------------------------

WORLDS = {
    "everything": {
        "vehicle": EYED.with_effect("rotor_drag", coefficient=4e-4)
        .with_effect("servo_delay", time=0.027)
        .with_actuators(swash_travel=0.1, swash_rate=2.0),
        "turbulence": 3.0, "wind": 2.0, "task": "waypoints", "sensors": "mocap",
    },
    "ranges": {"randomize": {"mass": (0.7, 0.9), "servo_delay.time": (0.0, 0.05)}},
    "list": {
        "randomize": [LAMA, EYED, "skybotix_coax"], "gusts": (0.1, 1e-3),
        "sensors": "mocap", "task": "position",
    },
    "course": {
        "task": "waypoints", "sensors": "state", "target": [(1, 1, 1.5, 0.3), (0, 0, 1, 0)],
    },
}  # fmt: skip


def same(one: object, many: dict, name: str, row: int) -> bool:
    """Whether a single env's info is what the batch's says of a row."""
    if isinstance(one, dict):
        return all(same(value, many[name], key, row) for key, value in one.items())
    return bool(many[f"_{name}"][row]) and np.array_equal(one, many[name][row])


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_a_row_flies_as_a_single_env_in_any_world(world):
    arguments, n, seed = WORLDS[world], 3, 5
    rows = CoaxVectorEnv(n, max_episode_steps=70, **arguments)
    singles = [gymnasium.make("CoaxHeli-v0", max_episode_steps=70, **arguments) for _ in range(n)]
    observations, info = rows.reset(seed=seed)
    for i, env in enumerate(singles):
        observation, one = env.reset(seed=seed + i)
        assert np.array_equal(observation, observations[i])
        assert all(same(value, info, key, i) for key, value in one.items())
    waiting, ends = np.zeros(n, dtype=bool), 0
    for action in actions(1, 200, n, 4):
        observations, rewards, terminated, truncated, info = rows.step(action)
        for i, env in enumerate(singles):
            fresh = waiting[i]
            if fresh:
                observation, one = env.reset()
                reward, over, late = 0.0, False, False
            else:
                observation, reward, over, late, one = env.step(action[i])
            assert np.array_equal(observation, observations[i])
            assert observation in env.observation_space
            assert (reward, over, late) == (rewards[i], terminated[i], truncated[i])
            assert all(same(value, info, key, i) for key, value in one.items())
            waiting[i] = over or late
            ends += waiting[i]
    assert ends >= 6


def test_an_unlimited_bare_world_costs_no_memory():
    fleet = CoaxVectorEnv(64).fleet
    own = fleet.helicopters
    assert own.past.size == 0 and own.command_ring.shape[1] == 1 and own.own.size == 0
    assert sum(array.nbytes for array in (fleet.x, *own) if len(array) == 64) / 64 < 1000
    assert len(tasks.TASKS["hover"].terms) == hover.N_TERMS


def test_a_drawn_vehicle_costs_what_is_drawn():
    fleet = CoaxVectorEnv(64, randomize="posterior").fleet
    assert fleet.own.shape[1] < 40  # of several hundred parameters
    arrays = (fleet.x, fleet.drawn, *fleet.helicopters)
    assert sum(array.nbytes for array in arrays if len(array) == 64) / 64 < 1500


@pytest.mark.parametrize(
    "hidden, arguments, warned",
    [
        ({}, {}, False),
        ({}, {"wind": (8.0, 0.0)}, True),
        ({}, {"wind": 3.0}, True),
        ({}, {"turbulence": "severe"}, True),
        ({"axial_damping": {"coefficient": 0.1}}, {"turbulence": "severe"}, False),
        ({"axial_damping": {"coefficient": 0.1}}, {"wind": (8.0, 0.0)}, False),
        ({"rotor_drag": {"coefficient": 1e-4}}, {"wind": (8.0, 0.0), "turbulence": "light"}, False),
    ],
)
def test_wind_that_cannot_act_is_warned_of(hidden, arguments, warned):
    """And rightly: where it warns, the flight is the one in still air."""
    vehicle = LAMA
    for name, values in hidden.items():
        vehicle = vehicle.with_effect(name, **values)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        env = CoaxEnv(vehicle, **arguments)
    assert any("cannot act on" in str(w.message) for w in said) == warned
    still = CoaxEnv(vehicle)
    flights = []
    for one in (env, still):
        one.reset(seed=3, options={"state": TRIM[0]})
        flights.append([one.step(np.full(4, 0.05))[4]["state"][:16] for _ in range(30)])
    same = np.allclose(flights[0], flights[1], atol=1e-12)
    assert same == (warned or not arguments)


def test_a_drawn_wind_has_its_speeds_and_comes_from_everywhere():
    env = CoaxVectorEnv(400, DRAGGED, wind={"speed": (1.0, 3.0)})
    env.reset(seed=0)
    north, east, down = env.fleet.air.T
    speed, angle = np.hypot(north, east), np.arctan2(east, north)
    assert 1.0 <= speed.min() < 1.1 and 2.9 < speed.max() <= 3.0 and not down.any()
    assert abs(np.mean(speed) - 2.0) < 0.1  # 3.5 std
    assert np.abs(np.mean(np.exp(1j * angle))) < 0.17
    fixed = CoaxVectorEnv(8, DRAGGED, wind=2.0)
    same = CoaxVectorEnv(8, DRAGGED, wind={"speed": (2.0, 2.0)})
    assert np.array_equal(fixed.reset(seed=1)[0], same.reset(seed=1)[0])
    assert np.array_equal(fixed.fleet.air, same.fleet.air)


@pytest.mark.parametrize("wind", [{"speed": (3, 1)}, {"speed": 2}, {"north": (0, 1)}, {}])
def test_a_drawn_wind_that_is_none_gets_one_line(wind):
    with pytest.raises(InputError, match="wind"):
        CoaxVectorEnv(1, wind=wind)
