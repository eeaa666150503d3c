"""Paths for replay, on a hover whose simulation is known by hand: too heavy, it falls as g t^2 / 2."""

import numpy as np
import pytest
from test_prediction import LAMA, G, hover

from coax_env.estimation import trajectories as paths
from coax_env.estimation.trajectories import FRAME, RESTART, SETTLED, trajectories
from coax_env.logs.flight import Flight, Run
from coax_env.model.dynamics import hover_trim
from coax_env.model.layout import CHANNELS

HEAVIER = 0.02


def flight(seconds: float, start: float = 0.0) -> Flight:
    """A perfect hover at 1.5 m, read without noise, some metres from its place of reference."""
    record = hover(seconds, start=start, pn=3.0, pe=-4.0)
    names = ("p", "q", "r", "phi", "theta", "psi", "h", "vn", "ve", "vd", "pn", "pe")
    measured = {c: record.z[:, CHANNELS.index(c)] for c in names}
    run = Run("hover", record.t, record.command, measured)
    return Flight("lama400d", (run,), noise=dict.fromkeys(names, 1e-3))


@pytest.fixture(scope="module")
def flown():
    heavy = LAMA.with_values({"mass": (1.0 + HEAVIER) * LAMA["mass"].value})
    return trajectories(flight(11.0, 7.0), LAMA, {"heavy": heavy, "right": LAMA})[0]


def test_frames_are_even_from_when_the_filter_has_settled_to_the_end(flown):
    expected = np.arange(7.0 + SETTLED, 18.0 + 1e-6, FRAME)
    assert flown.t == pytest.approx(expected, abs=1e-6)


def test_poses_are_north_east_height_and_angles(flown):
    roll = hover_trim(LAMA)[0][10]
    np.testing.assert_allclose(flown.measured[:, :3], np.tile([3.0, -4.0, 1.5], (flown.t.size, 1)),
                               atol=2e-3)  # fmt: skip
    np.testing.assert_allclose(flown.measured[:, 3], roll, atol=1e-3)


def test_a_model_that_is_too_heavy_falls_from_each_start(flown):
    """Put onto the measured path every three seconds: a parabola from each, and nothing before it."""
    since = (flown.t - flown.t[0] + 1e-6) % RESTART
    np.testing.assert_array_equal(flown.begins, since < 0.5 * FRAME)
    missing = G * HEAVIER / (1.0 + HEAVIER)
    fallen = 0.5 * missing * since**2
    np.testing.assert_allclose(flown.position_error("heavy"), fallen, rtol=0.02, atol=4e-3)
    drop = flown.measured[:, 2] - flown.simulated["heavy"][:, 2]
    np.testing.assert_allclose(drop, fallen, rtol=0.02, atol=4e-3)
    assert flown.position_error("right").max() < 5e-3
    np.testing.assert_allclose(flown.error_removed(), fallen, rtol=0.02, atol=9e-3)


def test_one_model_alone_has_its_error_and_a_lost_one_none(flown):
    lost = paths.Trajectory(
        "lost", flown.t, flown.begins, flown.measured,
        {"heavy": np.where(flown.t[:, None] > 10.0, np.nan, flown.simulated["heavy"])},
    )  # fmt: skip
    found = lost.error_removed()
    np.testing.assert_array_equal(found[flown.t > 10.0], 0.0)
    np.testing.assert_array_equal(
        found[flown.t <= 10.0], flown.position_error("heavy")[flown.t <= 10.0]
    )


def test_long_flights_have_fewer_frames_a_second(monkeypatch):
    """So many of all runs together; and put onto the path by the caller's time."""
    monkeypatch.setattr(paths, "MOST_FRAMES", 20)
    (found,) = trajectories(flight(8.0, 3.0), LAMA, {"right": LAMA}, restart=2.0)
    np.testing.assert_allclose(np.diff(found.t), 0.4, atol=0.011)
    assert found.t[0] == pytest.approx(3.0 + SETTLED, abs=0.011)
    np.testing.assert_array_equal(np.flatnonzero(found.begins), [0, 5, 10, 15])


def test_rows_of_frames_are_the_first_at_or_after_each():
    t = 2.0 + np.array([0.0, 0.4, 1.0, 1.5, 1.55, 1.61, 1.69, 1.7, 1.78, 1.9])
    assert list(paths._rows(t, 0.1)) == [3, 5, 7, 9]
    short = 2.0 + 0.1 * np.arange(6)  # ends before the filter has settled: its last frame
    assert list(paths._rows(short, 0.1)) == [4, 5]
