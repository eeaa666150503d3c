"""Readings at the end of a sensor's range are no readings; what only looks so stays."""

import numpy as np
import pytest

from coax_env.logs.clipped import clipped

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
