"""What an action may be: held for longer, body rates, a velocity."""

import gymnasium
import numpy as np
import pytest

from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.errors import InputError
from controllers.action_levels import LEVELS, ActionLevel, VectorActionLevel


def batch(count, **arguments):
    return CoaxVectorEnv(count, **arguments)


@pytest.mark.parametrize("arguments", [{}, {"task": "waypoints", "sensors": "mocap"}])
def test_a_step_at_25_hz_is_four_at_100(arguments):
    slow, fast = batch(3, control_rate=25, **arguments), batch(3, **arguments)
    observations, _ = slow.reset(seed=5)
    assert np.array_equal(observations, fast.reset(seed=5)[0])
    flags = [k for k, name in enumerate(slow.observation_names) if name.startswith("new_")]
    rng = np.random.default_rng(0)
    for _ in range(12):
        action = rng.uniform(-0.2, 0.2, (3, 4))
        seen, reward, *_, info = slow.step(action)
        parts = [fast.step(action) for _ in range(4)]
        assert np.array_equal(info["state"], parts[-1][4]["state"])
        assert reward == pytest.approx(np.sum([part[1] for part in parts], axis=0))
        new = np.max([part[0][:, flags] for part in parts], axis=0)
        assert np.array_equal(seen[:, flags], new)
        rest = np.setdiff1d(np.arange(seen.shape[1]), flags)
        assert np.array_equal(seen[:, rest], parts[-1][0][:, rest])


def test_a_flight_that_ends_within_a_step_stays_as_it_ended():
    slow, fast = batch(2, control_rate=10), batch(2)
    action = np.array([[-1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    slow.reset(seed=1), fast.reset(seed=1)
    over, count = np.zeros(2, dtype=bool), 0
    while not over[0]:
        _, _, over, _, info = slow.step(action)
    while not (done := fast.step(action))[2][0]:
        count += 1
    assert np.array_equal(info["state"][0], done[4]["state"][0])
    assert slow.fleet.rows.tolist()[0] == count + 1 <= slow.fleet.rows[1]


def test_the_time_limit_counts_steps():
    env = batch(2, control_rate=50, max_episode_steps=10)
    env.reset(seed=0)
    ends = [env.step(np.zeros((2, 4)))[3].any() for _ in range(10)]
    assert ends == [False] * 9 + [True]


@pytest.mark.parametrize("rate", [0, -50, 60, 200, "fast", float("nan")])
def test_no_such_rate(rate):
    with pytest.raises(InputError, match="control_rate"):
        batch(1, control_rate=rate)


def test_a_velocity_is_flown():
    env = VectorActionLevel(batch(4), "velocity")
    env.reset(seed=0)
    asked = np.array([0.6, 0.0, 0.2, 0.0])
    found = [env.step(np.tile(asked, (4, 1)))[4]["state"][:, :3].copy() for _ in range(900)]
    mean = np.mean(found[500:], axis=(0, 1))
    assert mean == pytest.approx([0.6, 0.0, -0.1], abs=0.06)


@pytest.mark.parametrize("axis", range(3))
def test_a_rate_is_reached(axis):
    env = VectorActionLevel(batch(4), "rates")
    env.reset(seed=0)
    asked = np.zeros((4, 4))
    asked[:, 1 + axis] = 0.4
    found = [env.step(asked)[4]["state"][:, 3:6].copy() for _ in range(40)]
    rates = np.mean(found[15:], axis=(0, 1))
    wanted = 0.4 * env.level.REACH[axis]
    assert rates[axis] == pytest.approx(wanted, rel=0.3)
    assert np.abs(np.delete(rates, axis)).max() < 0.2 * wanted


@pytest.mark.parametrize("level", LEVELS)
def test_a_row_of_a_batch_is_a_single_env(level):
    many = VectorActionLevel(batch(2, max_episode_steps=30, autoreset_mode="SameStep"), level)
    one = ActionLevel(gymnasium.make("CoaxHeli-v0"), level)
    seen, _ = many.reset(seed=8)
    assert np.array_equal(one.reset(seed=9)[0], seen[1])
    rng = np.random.default_rng(0)
    for k in range(60):
        actions = rng.uniform(-0.3, 0.3, (2, 4))
        if k == 30:
            assert np.array_equal(one.reset()[0], seen[1])
        seen = many.step(actions)[0]
        mine = one.step(actions[1])[0]
        if k % 30 != 29:
            assert np.array_equal(mine, seen[1])


def test_what_a_level_cannot_have_gets_one_line():
    for arguments, level in (({}, "thrust"), ({"sensors": "paper"}, "velocity"),
                             ({"control_rate": 50}, "rates")):  # fmt: skip
        with pytest.raises(InputError) as error:
            ActionLevel(gymnasium.make("CoaxHeli-v0", **arguments), level)
        assert "\n" not in str(error.value)
