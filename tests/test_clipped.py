"""Readings at the end of a sensor's range are no readings; what only looks so stays."""

import math

import numpy as np
import pytest

from coax_env.logs.clipped import clipped, near_an_end

RATE = 100.0  # rows/s
T = np.arange(0.0, 10.0, 1.0 / RATE)


def swinging(noise: float, seed: int = 0) -> np.ndarray:
    """A yaw rate of 10 rad/s [rad/s], as a gyro with noise sees it."""
    return 10.0 * np.sin(2.0 * T) + noise * np.random.default_rng(seed).standard_normal(T.size)


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3])
@pytest.mark.parametrize("digits", [3, 12])
def test_a_clipped_gyro_reads_nothing_at_its_ends(noise, digits):
    true = np.round(swinging(noise), digits)
    end = 8.727
    np.testing.assert_array_equal(clipped(np.clip(true, -end, end)), np.abs(true) >= end)


def test_one_end_alone_and_holes_between_readings():
    true = swinging(0.05)
    true[::3] = np.nan
    np.testing.assert_array_equal(clipped(np.minimum(true, 9.0)), np.nan_to_num(true) >= 9.0)


def test_the_other_end_of_a_sensor_is_known_from_the_first():
    """A single reading at -8.727 is clipped where others show that 8.727 is the end."""
    y = swinging(0.02)
    y[y < 0.0] *= 0.5
    y[500] = -20.0
    assert clipped(np.clip(y, -8.727, 8.727))[500]


@pytest.mark.parametrize(
    "y",
    [
        swinging(0.02),
        np.round(swinging(0.02), 1),
        np.round(1.0 + 0.02 * np.sin(3.0 * T), 2),
        np.where(T < 3.0, 0.0, 1.0 - np.cos(T - 3.0)),
        np.where(T > 7.0, 0.0, 1.0 - np.cos(T - 7.0)),
        np.where(T % 4.0 < 2.0, 210.0, 220.0),
        np.repeat(swinging(0.1)[::5], 5),
        np.full(T.size, 1.0),
        np.full(T.size, np.nan),
    ],
    ids=["a gyro within its range", "coarse", "sonar in steps of 1 cm", "at rest, then off",
         "to rest", "a rotor between two speeds", "held samples", "constant", "nothing"],
)  # fmt: skip
def test_what_is_no_end_stays(y):
    assert not clipped(y).any()


@pytest.mark.parametrize("seed", range(20))
def test_chance_makes_no_end(seed):
    """White noise to three digits, as a gyro of a machine that stands has it."""
    rng = np.random.default_rng(seed)
    assert not clipped(np.round(0.02 * rng.standard_normal(4000), 3)).any()


def test_beside_an_end_noise_takes_what_is_left_to_either_side():
    """A gyro that passes its end slowly, in noise: by what is below the end it reads too little."""
    t = np.arange(4000) / 100.0
    true = 10.0 * np.sin(0.8 * t)
    y = np.clip(true + 0.5 * np.random.default_rng(0).standard_normal(t.size), -9.0, 9.0)
    y[::7] = np.nan
    at_ends = clipped(y)
    near = near_an_end(y, at_ends)
    read = ~np.isnan(y)
    off = np.sign(true) * (y - true)
    slow = np.abs(np.abs(true) - 9.0) < 0.5
    assert near[at_ends].all() and not near[~read].any()
    assert np.mean(off[slow & ~at_ends & read]) < -0.25 and near[slow & read].all()
    partly = (np.abs(true) > 7.0) & (np.abs(true) < 8.0) & ~near & read
    assert abs(np.mean(off[partly])) < 3.0 * 0.5 / math.sqrt(np.count_nonzero(partly))
    assert np.mean(near[np.abs(true) < 6.5]) == 0.0
    low = near_an_end(y - 40.0, at_ends)  # ends at -49 and -31
    np.testing.assert_array_equal(low, near)
