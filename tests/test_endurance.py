"""The env for ever: numbers stay numbers, and what is not one harms nobody else."""

import endurance
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from test_world import WORLDS

from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.model.effects import CATALOGUE

NO_NUMBERS = (np.nan, np.inf, -np.inf)


@pytest.mark.slow
def test_a_hundred_thousand_steps_in_every_world():
    rows = endurance.fly(100_000, 64, seed=0)
    assert sum(row["steps"] for row in rows) >= 100_000
    assert len(rows) == len(endurance.worlds())
    assert sum(row["flights"] for row in rows) > 50, "flights end, and others begin"
    for row in rows:
        assert row["farthest"]["p"] > 1.0 and row["farthest"]["z"] > 1.5


def test_the_vehicle_with_everything_has_every_effect():
    assert set(endurance.everything().effects) == set(CATALOGUE)
    assert {world.sensors for world in endurance.worlds()} == {"onboard", "paper", "mocap", "state"}


@pytest.mark.parametrize(("column", "what"), [(0, "observation"), (3, "state")])
def test_a_fault_is_seen(column, what, monkeypatch):
    flying = endurance.Flying(endurance.World("bare", {}), 8, seed=1)
    flying.step()
    keep = flying.env.step

    def spoilt(actions):
        observation, reward, terminated, truncated, info = keep(actions)
        results = {"observation": observation, "state": info["state"].copy()}
        results[what][5, column] = np.nan
        return (
            results["observation"],
            reward,
            terminated,
            truncated,
            info | {"state": results["state"]},
        )

    monkeypatch.setattr(flying.env, "step", spoilt)
    with pytest.raises(
        endurance.Fault, match=rf"bare: after 8 steps {what} \(5, {column}\) is nan"
    ):
        flying.step()


def test_every_kind_of_flier_acts_as_it_is_described():
    flying = endurance.Flying(endurance.World("bare", {}), 8, seed=1)
    first, flying.steps = flying.actions(), 8
    second = flying.actions()
    assert np.array_equal(first[2::4], second[2::4]) and (np.abs(first[2::4]) < 1.0).all()
    assert (np.abs(first[3::4]) == 1.0).all()
    assert not np.array_equal(first[1::4], second[1::4])


# --- actions that are no numbers ------------------------------------------------------------------


@pytest.mark.parametrize("count", [5, 19], ids=["one by one", "in lanes"])
@pytest.mark.parametrize("wrong", NO_NUMBERS)
@pytest.mark.parametrize("column", range(4))
def test_an_action_that_is_no_number_ends_its_own_flight_only(count, wrong, column):
    """NaN ends the flight, unpaid, with an observation in the space; infinity is full deflection."""
    sound, faulty = CoaxVectorEnv(count), CoaxVectorEnv(count)
    sound.reset(seed=3), faulty.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (30, count, 4))
    for k, action in enumerate(actions):
        spoilt, clipped = action.copy(), action.copy()
        if k == 10:
            spoilt[2, column] = wrong
            clipped[2, column] = np.clip(np.nan_to_num(wrong, posinf=1.0, neginf=-1.0), -1.0, 1.0)
        ours, theirs = sound.step(clipped), faulty.step(spoilt)
        others = np.arange(count) != 2
        same = others | (not np.isnan(wrong)) | (k < 10)
        assert np.array_equal(ours[0][same], theirs[0][same])
        assert np.array_equal(ours[1][same], theirs[1][same])
        assert np.array_equal(ours[4]["state"][same], theirs[4]["state"][same])
        assert np.isfinite(theirs[0]).all() and np.isfinite(theirs[1]).all()
        assert theirs[0] in faulty.observation_space
        if k == 10 and np.isnan(wrong):
            assert theirs[2].tolist() == [row == 2 for row in range(count)]
            assert theirs[1][2] == 0.0
        if k == 11:
            assert np.isfinite(theirs[4]["state"]).all(), "the next flight has forgotten it"


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("world", WORLDS)
def test_nothing_of_a_lost_flight_is_left_in_the_next(world, mode):
    """Rings, limits, turbulence and held readings too: every row gets NaN, and all fly on."""
    env = CoaxVectorEnv(3, autoreset_mode=mode, **WORLDS[world])
    env.reset(seed=4)
    for k in range(30):
        action = np.zeros((3, 4))
        if k == 5:
            action[:, k % 4] = np.nan
        observations, rewards, terminated, _, info = env.step(action)
        assert terminated.all() == (k == 5) or mode == AutoresetMode.DISABLED
        assert np.isfinite(observations).all() and np.isfinite(rewards).all()
        if k == 5 and mode == AutoresetMode.DISABLED:
            env.reset(options={"reset_mask": terminated})
        elif k > 5:
            assert np.isfinite(info["state"]).all() and not terminated.any()
