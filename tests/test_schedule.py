"""The gain schedule: at one speed it is the LQG, between two speeds it blends both."""

import numpy as np
import pytest

from coax_env import InputError, load_vehicle
from controllers import lqr, schedule
from controllers.evaluation import evaluate
from controllers.loading import load_controller

LAMA = load_vehicle("lama400d")
DRAGGED = LAMA.with_effect("rotor_drag", coefficient=3.5e-4)


@pytest.fixture(scope="module")
def grid():
    return schedule.design(DRAGGED, LAMA, speeds=(0.0, 1.5, 3.0))


@pytest.mark.slow
def test_of_one_speed_it_is_the_lqg():
    one = schedule.design(DRAGGED, LAMA, speeds=(0.0,))
    same = lqr.design(DRAGGED, LAMA, "mocap", lqr.BRISK)
    flown = [evaluate(c, DRAGGED, 2, 4.0, task="waypoints") for c in (one, same)]
    assert flown[0]["mean_cost"] == pytest.approx(flown[1]["mean_cost"], rel=1e-9)


def test_shares_are_those_of_the_neighbours():
    found = schedule.shares(np.array([-1.0, 0.0, 0.75, 1.5, 2.0, 9.0]), np.array([0.0, 1.5, 3.0]))
    wanted = [[1, 0, 0], [1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0, 2 / 3, 1 / 3], [0, 0, 1]]
    assert found == pytest.approx(np.array(wanted))
    assert found.sum(axis=1) == pytest.approx(1.0)


@pytest.mark.slow
def test_a_far_target_is_reached_sooner_and_without_going_past(grid):
    same = lqr.design(DRAGGED, LAMA, "mocap", lqr.BRISK)
    target = [(12.0, 0.0, 1.5, 0.0)]
    reached = [
        evaluate(c, DRAGGED, 3, 16.0, seed=1, task="waypoints", target=target)["mean_reached"]
        for c in (grid, same)
    ]
    assert reached == [1.0, 0.0]
    there = evaluate(grid, DRAGGED, 3, 20.0, seed=1, task="position", target=target)
    assert there["survival_rate"] == 1.0 and there["height_rms_m"] < 0.05


def test_a_file_keeps_it(grid, tmp_path):
    again = load_controller(grid.save(tmp_path / "controller.json"))
    seen = np.random.default_rng(0).standard_normal((50, 2, 24)).astype(np.float32)
    grid.reset(2)
    again.reset(2)
    for row in seen:
        assert np.array_equal(again.act(row), grid.act(row))


@pytest.mark.parametrize("speeds", [(1.0, 2.0), (0.0, 2.0, 1.0), (), (0.0, np.nan)])
def test_a_grid_that_is_none_is_refused(speeds):
    with pytest.raises(InputError, match="speeds"):
        schedule.design(LAMA, speeds=speeds)
