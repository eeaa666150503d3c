"""Sensors, actuators and gusts one by one, without an env: what a row of numbers must become."""

import math
from dataclasses import replace

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.env import period
from coax_env.env.actions import action_map
from coax_env.kernel.random_streams import stream_key
from coax_env.model.actuators import limit, limits
from coax_env.model.layout import CHANNELS
from coax_env.model.parameters import MEMORY_FORCE_XY as GUST_MEMORY
from coax_env.model.sampling import add_vibration, is_new, measured_quantities, sensor_table
from coax_env.model.sensors import suite
from coax_env.simulation.log import log_readings

LAMA = load_vehicle("lama400d")
TIME = np.arange(0.0, 20.0, 0.01)


def stream(seed: int = 0) -> np.ndarray:
    return np.array([stream_key(np.uint64(seed)), 0], dtype=np.uint64)


def sensor(name: str, **numbers):
    (found,) = (s for s in suite("onboard") if s.name == name)
    return replace(found, **numbers)


def logged(name: str, truth: np.ndarray, **numbers) -> np.ndarray:
    readings = np.zeros((len(TIME), len(CHANNELS)))
    readings[:, CHANNELS.index(name)] = truth
    one = sensor(name, **numbers)
    return log_readings(readings, TIME, (one,), np.random.default_rng(0))[name]


# --- a log ----------------------------------------------------------------------------------------


def test_a_logged_heading_stays_within_a_turn_and_means_the_same():
    turning = 1.3 * TIME - 4.0
    log = logged("psi", turning, bias=0.05, rate=100.0)
    assert (np.abs(log) <= math.pi).all() and log.max() > 3.0 and log.min() < -3.0
    error = (log - turning - 0.05 + math.pi) % (2.0 * math.pi) - math.pi
    assert error.std() == pytest.approx(sensor("psi").noise, rel=0.06)
    assert abs(error.mean()) < 4.0 * sensor("psi").noise / math.sqrt(len(TIME))


def test_a_logged_reading_is_the_truth_with_noise_bias_delay_and_limits():
    truth = 2.0 + np.sin(TIME)
    still = logged("h", truth, noise=0.0, rate=100.0)
    np.testing.assert_allclose(still, truth)
    np.testing.assert_allclose(logged("h", truth, noise=0.0, rate=100.0, bias=0.3), truth + 0.3)
    late = logged("h", truth, noise=0.0, rate=100.0, delay=0.1)
    np.testing.assert_allclose(late[10:], truth[:-10], atol=1e-12)
    np.testing.assert_allclose(late[:10], truth[0])
    noisy = logged("h", truth, noise=0.2, rate=100.0, low=-9.0) - truth
    assert noisy.std() == pytest.approx(0.2, rel=0.06) and abs(noisy.mean()) < 0.02
    assert abs(np.corrcoef(noisy[1:], noisy[:-1])[0, 1]) < 0.08
    np.testing.assert_allclose(
        logged("h", truth, noise=0.0, rate=100.0, low=1.5, high=2.5), np.clip(truth, 1.5, 2.5)
    )


@pytest.mark.parametrize("rate", [10.0, 20.0, 40.0])
def test_a_slow_sensor_has_as_many_readings_as_its_rate_says(rate):
    fresh = np.isfinite(logged("h", np.ones_like(TIME), rate=rate))
    assert fresh[0] and fresh.sum() == 20 * rate
    assert np.diff(np.flatnonzero(fresh)).max() == math.ceil(100.0 / rate)
    lost = np.isfinite(logged("h", np.ones_like(TIME), rate=rate, dropout=0.4))
    assert lost[0] and not lost[~fresh].any()
    share = 1.0 - lost.sum() / fresh.sum()
    assert abs(share - 0.4) < 4.0 * math.sqrt(0.24 / fresh.sum())


def test_a_bias_of_its_flight_is_the_same_in_all_its_rows():
    found = []
    for seed in range(400):
        readings = np.zeros((3, len(CHANNELS)))
        one = sensor("p", noise=0.0, bias_std=0.2)
        rng = np.random.default_rng(seed)
        log = log_readings(readings, TIME[:3], (one,), rng)["p"]
        assert np.ptp(log) == 0.0
        found.append(log[0])
    assert np.std(found) == pytest.approx(0.2, rel=0.12) and abs(np.mean(found)) < 0.04


# --- an unbalance, a rate -------------------------------------------------------------------------


@pytest.mark.parametrize("azimuth", [0.0, 0.4, 2.0, -1.3])
def test_an_unbalance_turns_with_the_rotor(azimuth):
    """Its push lies in the rotor's plane, of one size, a quarter turn ahead in y; all else is still."""
    readings = np.arange(18.0)
    add_vibration(readings, azimuth, 0.3, 0.0, 0.0, 0.0)
    change = dict(zip(CHANNELS, readings - np.arange(18.0), strict=True))
    assert math.hypot(change["ax"], change["ay"]) == pytest.approx(0.3)
    assert math.atan2(change["ax"], change["ay"]) == pytest.approx(azimuth)
    assert change["az"] == pytest.approx(change["ax"])
    assert not any(value for name, value in change.items() if name not in ("ax", "ay", "az"))


def test_each_size_of_a_vibration_shakes_its_own_sensors():
    """Of a vehicle whose four sizes differ, and of one that has the last alone."""
    for sizes in (
        {"amplitude": 0.3, "rate": 0.02, "tilt": 0.004, "heave": 0.006},
        {"heave": 0.006},
    ):
        readings, by_hand = np.zeros(len(CHANNELS)), np.zeros(len(CHANNELS))
        period.shake(
            readings, 0.7, load_vehicle("lama400d").with_effect("vibration", **sizes).vector
        )
        four = (sizes.get(name, 0.0) for name in ("amplitude", "rate", "tilt", "heave"))
        add_vibration(by_hand, 0.7, *four)
        np.testing.assert_allclose(readings, by_hand, rtol=1e-12)
        assert readings[CHANNELS.index("h")] == pytest.approx(0.006 * math.sin(0.7))


def test_a_rotor_turns_by_its_speed_within_a_turn():
    azimuth, whole = 0.0, 0.0
    for _ in range(100):
        azimuth, whole = period.next_azimuth(azimuth, 210.0, 0.01), whole + 2.1
        assert 0.0 <= azimuth < 2.0 * math.pi
        assert math.cos(azimuth - whole) == pytest.approx(1.0)


@pytest.mark.parametrize("rate", [10.0, 20.0, 40.0, 50.0, 100.0])
def test_samples_come_at_their_rate(rate):
    new = np.flatnonzero([bool(is_new(row, rate)) for row in range(1000)])
    assert new[0] == 0 and len(new) == 10 * rate
    assert np.array_equal(new, np.ceil(np.arange(10 * rate) * 100.0 / rate - 1e-9))


# --- commands -------------------------------------------------------------------------------------


def test_an_action_is_clipped_and_scaled_about_the_trim():
    trim, scale = action_map(LAMA)
    action, u = np.array([0.5, -2.0, 3.0, math.nan]), np.zeros(5)
    period.command(action, trim, scale, u)
    np.testing.assert_array_equal(action, [0.5, -1.0, 1.0, math.nan])
    np.testing.assert_allclose(u[:4], trim + scale * action)
    np.testing.assert_allclose(scale, [0.15 * trim[0], 0.15 * trim[1], 0.2, 0.2])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_command_walks_at_its_rate_to_its_limit(sign):
    """Both ways, of each command: the rate from row to row, then the end of the travel."""
    slow = LAMA.with_actuators(
        swash_travel=0.1, swash_rate=2.0, rotor_speed_lowest=100.0, rotor_speed_highest=300.0,
        rotor_acceleration=900.0,
    )  # fmt: skip
    table = limits(slow)
    before = np.array([200.0, 200.0, 0.0, 0.0])
    for k in range(1, 30):
        command = np.array([200.0 + 500.0 * sign, 200.0, sign, -sign])
        limit(command, before, table, 0.01)
        expected = [
            200.0 + sign * min(9.0 * k, 100.0), 200.0,
            sign * min(0.02 * k, 0.1), -sign * min(0.02 * k, 0.1),
        ]  # fmt: skip
        np.testing.assert_allclose(command, expected)
        assert np.array_equal(command, before)
    free = np.array([1e9, -1e9, 1e9, -1e9])
    limit(free, np.zeros(4), limits(LAMA), 0.01)
    assert np.array_equal(free, [1e9, -1e9, 1e9, -1e9]), "a file without limits has none"


def test_gusts_are_stationary_with_their_memory():
    """Blown and faded by the kernel's memory: std as asked, correlation exp(-dt/memory)."""
    p = LAMA.vector.copy()
    fade = math.exp(-period.DT / p[GUST_MEMORY])
    x, own = np.zeros(29), stream(3)
    history = np.empty((60_000, 6))
    for row in history:
        x[20:26] *= fade
        period.add_gusts(x, p, np.array([0.3, 0.02]), own)
        row[:] = x[20:26]
    std = history.std(axis=0)
    np.testing.assert_allclose(std, [0.3] * 3 + [0.02] * 3, rtol=0.12)
    lag = round(p[GUST_MEMORY] / period.DT)
    for column in history.T:
        found = np.corrcoef(column[lag:], column[:-lag])[0, 1]
        assert found == pytest.approx(math.exp(-1.0), abs=0.1)
    assert np.abs(np.corrcoef(history.T) - np.eye(6)).max() < 0.15
    assert not x[:20].any() and not x[26:].any()
    still = np.zeros(29)
    period.add_gusts(still, p, np.array([0.0, 0.02]), own)
    assert not still[20:23].any() and still[23:26].all()


# --- readings -------------------------------------------------------------------------------------


def test_sensors_look_at_their_own_place():
    readings, x, out = np.arange(18.0), 100.0 + np.arange(29.0), np.zeros(2)
    (height,) = (s for s in suite("state") if s.name == "z")
    measured_quantities(x, readings, sensor_table((sensor("h"), height)), out)
    assert out.tolist() == [CHANNELS.index("h"), 115.0]


def test_a_reading_has_its_noise_and_its_bias_and_stays_until_the_next():
    """Two gyros, a sonar at 20 Hz with a flag, a heading that runs round."""
    sensors = (sensor("p", noise=0.3), sensor("q", noise=0.1), sensor("h", noise=0.0, low=-9.0),
               sensor("psi", noise=0.0, rate=100.0))  # fmt: skip
    table = sensor_table(sensors, ("sonar",))
    values, bias = np.array([1.0, -2.0, 1.5, 3.0]), np.array([0.5, 0.0, 0.25, 1.0])
    own, held = stream(1), np.zeros(5)
    history = np.empty((4000, 5))
    for row in range(4000):
        values[2] = row
        period.take_samples(values, row, table, bias, own, 1, held)
        history[row] = held
    noise = history[:, :2] - [1.5, -2.0]
    np.testing.assert_allclose(noise.std(axis=0), [0.3, 0.1], rtol=0.05)
    assert np.abs(noise.mean(axis=0)).max() < 0.02
    assert abs(np.corrcoef(noise.T)[0, 1]) < 0.06
    assert np.abs([np.corrcoef(n[1:], n[:-1])[0, 1] for n in noise.T]).max() < 0.06
    due = np.arange(4000) % 5 == 0
    assert np.array_equal(history[:, 4], due.astype(float))
    kept = np.minimum(np.arange(4000) // 5 * 5 + 0.25, sensor("h").high)
    np.testing.assert_allclose(history[:, 2], kept)
    np.testing.assert_allclose(history[:, 3], 4.0 - 2.0 * math.pi)


def test_lost_samples_are_held_and_not_new():
    one = sensor("h", noise=0.0, dropout=0.3, low=-1e9, high=1e9)
    table, held, own = sensor_table((one,), ("sonar",)), np.zeros(2), stream(2)
    fresh = []
    for row in range(20_000):
        before = held[0]
        period.take_samples(np.array([float(row)]), row, table, np.zeros(1), own, 1, held)
        assert held[0] == (row if held[1] else before)
        fresh.append(held[1])
    due = np.arange(20_000) % 5 == 0
    assert fresh[0] and not np.array(fresh)[~due].any()
    assert np.mean(np.array(fresh)[due]) == pytest.approx(0.7, abs=4 * math.sqrt(0.21 / 4000))


def test_a_reading_that_is_no_number_leaves_the_last():
    table, held, own = sensor_table((sensor("p", noise=0.0),)), np.zeros(1), stream(4)
    for value, shown in ((0.5, 0.5), (math.nan, 0.5), (1e9, sensor("p").high), (math.inf, None)):
        period.take_samples(np.array([value]), 0, table, np.zeros(1), own, 0, held)
        assert held[0] == (sensor("p").high if shown is None else shown)
