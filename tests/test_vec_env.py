"""The batch as Stable-Baselines3 wants it."""

import warnings
from importlib.util import find_spec

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from coax_env.env.vector_env import CoaxVectorEnv

pytestmark = [  # imports torch, but not before it is run
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("stable_baselines3") is None, reason="no stable_baselines3"),
]


def fleet(count: int, **arguments):
    from controllers.vec_env import FleetVecEnv

    return FleetVecEnv(count, **arguments)


def actions(seed: int, *shape: int, size: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-size, size, shape).astype(np.float32)


def test_each_row_gets_its_own_end():
    n = 6
    env = fleet(n, max_episode_steps=150)
    env.seed(4)
    twin = CoaxVectorEnv(n, max_episode_steps=150, autoreset_mode=AutoresetMode.NEXT_STEP)
    first, _ = twin.reset(seed=4)
    assert np.array_equal(env.reset(), first)
    kinds = set()
    pending = np.zeros(n, dtype=bool)
    for action in actions(0, 300, n, 4):
        action[0] = -1.0, -1.0, 0.0, 0.0  # sinks to the ground
        # NEXT_STEP spends a step on a reset: rows are compared until they have ended once
        observations, rewards, done, infos = env.step(action)
        theirs, their_rewards, terminated, truncated, _ = twin.step(action)
        for i in np.flatnonzero(~pending):
            assert rewards[i] == np.float32(their_rewards[i])
            assert done[i] == (terminated[i] or truncated[i])
            if done[i]:
                assert np.array_equal(infos[i]["terminal_observation"], theirs[i])
                assert infos[i]["TimeLimit.truncated"] == (truncated[i] and not terminated[i])
                assert not np.array_equal(observations[i], theirs[i])
                assert infos[i]["state"].shape == (29,)
                kinds.add(infos[i]["TimeLimit.truncated"])
            else:
                assert np.array_equal(observations[i], theirs[i]) and not infos[i]
        pending |= done
        if pending.all():
            break
    assert pending.all() and kinds == {False, True}


def test_a_time_limit_is_told_apart_from_an_end():
    env = fleet(2, max_episode_steps=20, vehicle="lama400d")
    env.seed(0)
    env.reset()
    bad = np.zeros((2, 4), np.float32)
    for step in range(20):
        bad[0, 0] = np.nan if step == 19 else 0.0
        _, _, done, infos = env.step(bad)
    assert done.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, True]
    assert [info["episode"]["l"] for info in infos] == [20, 20]
    assert not np.array_equal(infos[0]["terminal_observation"], infos[1]["terminal_observation"])


def test_returns_are_summed_before_scaling_and_vehicles_are_told():
    env = fleet(3, max_episode_steps=10, reward_scale=0.01, randomize={"mass": (0.7, 0.9)})
    env.seed(1)
    env.reset()
    assert 0.7 < env.reset_infos[1]["vehicle"]["mass"] < 0.9
    total = np.zeros(3)
    for action in actions(1, 10, 3, 4, size=0.1):
        _, rewards, _, infos = env.step(action)
        total += rewards
    assert np.allclose([info["episode"]["r"] for info in infos], 100.0 * total, rtol=1e-5)


def test_stable_baselines_trains_on_it_without_a_warning():
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = VecNormalize(VecMonitor(fleet(8, max_episode_steps=50)))
        model = PPO("MlpPolicy", env, n_steps=64, batch_size=128, n_epochs=1, device="cpu", seed=0)
        model.learn(1024)
        mean, _ = evaluate_policy(model, env, n_eval_episodes=4, warn=False)
    assert np.isfinite(mean) and len(model.ep_info_buffer) > 0


def test_its_pictures_are_tiled():
    pytest.importorskip("pygame")
    env = fleet(2, render_mode="rgb_array")
    env.reset()
    assert env.render().ndim == 3 and env.render_mode == "rgb_array"
    env.close()


def test_a_subclass_decides_what_the_policy_sees():
    from gymnasium.spaces import Box

    from controllers.vec_env import FleetVecEnv

    class Stacked(FleetVecEnv):
        """Rows since the start beside the readings."""

        def begin(self, which):
            self.seen = np.where(which, 0.0, getattr(self, "seen", np.zeros(len(which))))

        def acted(self, actions):
            self.seen = self.seen + 1.0

        def view(self, observations, which=None):
            return np.column_stack([observations, self.seen]).astype(np.float32)

    env = Stacked(2, 5, observation_space=Box(-np.inf, np.inf, (19,), np.float32))
    assert env.reset()[:, -1].tolist() == [0.0, 0.0]
    last = [env.step(np.zeros((2, 4))) for _ in range(5)][-1]
    assert last[0][:, -1].tolist() == [0.0, 0.0]
    assert last[3][0]["terminal_observation"][-1] == 5.0
