"""Sensors whose steps are many times their noise: when they are seen, and what is read of them."""

import injector
import numpy as np
import pytest
from csv_edits import Table, rewrite

from coax_env import diagnose
from coax_env.logs.coarse import at_changes
from coax_env.logs.flight import read_flight

STEP = 30.0


def read(noise: float, step: float = STEP, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A rotor speed that wanders by 40 rev/min, and what is read of it."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(3000)
    true = 2000.0 + 40.0 * np.sin(0.7 * t) + 20.0 * np.sin(2.3 * t)
    y = true + noise * rng.standard_normal(t.size)
    return true, y if step == 0.0 else step * np.round(y / step)


def test_at_a_change_the_true_value_is_halfway_to_the_sensors_noise():
    """All readings are off by 8.7 rev/min (a step over the root of 12), these by their own 2."""
    true, y = read(noise=2.0)
    found = at_changes(y)
    assert found is not None
    there = np.isfinite(found)
    assert 30 < there.sum() < 400
    assert np.std(y - true) == pytest.approx(STEP / 12**0.5, rel=0.15)
    off = found[there] - true[there]
    assert np.std(off) == pytest.approx(2.0, rel=0.25) and abs(off.mean()) < 0.6


@pytest.mark.parametrize(
    ("noise", "step"),
    [
        (2.0, 0.0),  # as fine as numbers are
        (2.0, 4.0),  # two std, as `coarse` flies it
        (8.0, STEP),
        (2.0, 500.0),  # never changes
    ],
)
def test_steps_that_noise_crosses_all_the_time_are_as_they_were(noise, step):
    assert at_changes(read(noise, step)[1]) is None


def test_a_speed_that_leaps_by_many_steps_is_as_it_was():
    """One that is set to one of three values, say: it is never seen on its way."""
    assert at_changes(np.repeat([2000.0, 2150.0, 1850.0] * 10, 100)) is None


def test_holes_and_leaps_have_no_reading():
    _, y = read(noise=2.0)
    y[500:600] = np.nan
    y[2000:] += 10 * STEP
    found = at_changes(y)
    assert found is not None
    assert np.isnan(found[[*range(500, 600), 2000]]).all()


def test_what_leaps_with_its_command_is_not_halfway():
    """Of two leaps by a step neither has a reading, nor has the row behind it."""
    _, y = read(noise=2.0)
    command = np.full(y.size, 2000.0)
    command[1000:2000] += STEP
    y[1000:2000] += STEP
    free, found = at_changes(y), at_changes(y, command)
    assert free is not None and found is not None
    assert np.isfinite(free[[1000, 2000]]).all() and np.isnan(found[[1000, 1001, 2000, 2001]]).all()
    rest = np.setdiff1d(np.arange(y.size), [1000, 1001, 2000, 2001])
    np.testing.assert_array_equal(found[rest], free[rest])


@pytest.mark.slow
def test_a_clean_flight_whose_rotor_speeds_are_coarse_has_no_cause(tmp_path):
    """A thrust exponent of 63 and 77 nats on two, with a yaw damping of 218 on one."""
    runs = ("heave_3211", "yaw_3211", "lon_3211")
    injector.fly(tmp_path, {}, gusts=True, seed=4, runs=runs, longest=9.0)

    def in_steps(table: Table) -> None:
        for name in ("rpm_upper", "rpm_lower"):
            table[name] = [f"{STEP * round(float(cell) / STEP):g}" for cell in table[name]]

    rewrite(tmp_path.glob("*.csv"), in_steps)
    notes = read_flight(tmp_path).notes
    assert sum("coarse steps" in note for note in notes) == 2
    assert diagnose(tmp_path, hold_out=[]).findings["causes"] == []
