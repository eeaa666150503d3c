"""CoaxHeli-v0: Gymnasium's contract, reproducible flights, honest ends and observations."""

import math
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import numpy as np
import pytest
from corrected import NINE
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import coax_env
from coax_env.env import hover
from coax_env.env.actions import action_map, nominal_for
from coax_env.env.period import DT
from coax_env.env.spaces import action_table, observation_table, observed
from coax_env.env.threads import GROUP, MOST_MORE, Balance, in_threads
from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.errors import InputError
from coax_env.kernel.random_streams import stream_key, two_normals, uniform
from coax_env.kernel.simd_types import SIMD_WIDTH
from coax_env.model.dynamics import WORK_SIZE, kernel_input, step
from coax_env.model.sampling import is_new
from coax_env.model.sensors import SUITES, log_suite
from coax_env.simulation.log import log_readings

LAMA = coax_env.load_vehicle("lama400d")
DELAYED = LAMA.with_effect("servo_delay", time=0.027).with_effect("rotor_drag", coefficient=4e-4)


def actions(seed: int, *shape: int, size: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-size, size, shape).astype(np.float32)


# --- contract -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("sensors", SUITES)
def test_check_env_passes_without_a_warning(sensors):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make("CoaxHeli-v0", sensors=sensors).unwrapped)


def test_the_docstring_has_the_spaces_tables():
    env = coax_env.env.gym_env.CoaxEnv()
    doc = [line.strip() for line in coax_env.env.gym_env.CoaxEnv.__doc__.splitlines()]
    assert set(action_table()) <= set(doc)
    assert set(observation_table(observed(env.fleet))) <= set(doc)
    aimed = coax_env.env.gym_env.CoaxEnv(sensors="mocap", task="position")
    assert set(observation_table(observed(aimed.fleet))[-4:]) <= set(doc)
    assert len(env.observation_units) == len(env.observation_names) == 18
    assert env.observation_units[0] == "rev/min" and env.observation_units[-1] == "1"


def test_gymnasium_checks_the_vector_env_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make_vec(
            "CoaxHeli-v0", num_envs=3, vectorization_mode="vector_entry_point", sensors="mocap"
        )
    assert env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    observations, _ = env.reset(seed=0)
    assert observations in env.observation_space
    assert env.unwrapped.max_episode_steps == 2000


def test_import_is_light():
    code = (
        "import sys, coax_env, gymnasium; env = gymnasium.make('CoaxHeli-v0');"
        "env.reset(seed=0); env.step(env.action_space.sample());"
        "heavy = ('torch', 'plotly', 'control', 'stable_baselines3', 'scipy.interpolate',"
        " 'scipy.optimize', 'scipy.spatial');"
        "print([m for m in heavy if m in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "wrong",
    [
        {"sensors": "eyes"}, {"wind": "north"}, {"wind": -1.0}, {"wind": (1.0, 2.0, 3.0)},
        {"randomize": "prior"}, {"gusts": (1.0,)}, {"vehicle": "zeppelin"}, {"render_mode": "x"},
    ],
)  # fmt: skip
def test_a_wrong_argument_is_named_in_one_line(wrong):
    with pytest.raises(InputError) as error:
        coax_env.env.gym_env.CoaxEnv(**wrong)
    assert "\n" not in str(error.value)


# --- reproducible ---------------------------------------------------------------------------------


def test_the_same_seed_flies_the_same_flight():
    flights = []
    for _ in range(2):
        env = gymnasium.make("CoaxHeli-v0", gusts=(0.2, 0.005))
        flown = [env.reset(seed=5)[0]]
        flown += [env.step(a)[0] for a in actions(0, 150, 4, size=0.2)]
        flights.append(np.array(flown))
    assert np.array_equal(*flights)
    env.reset(seed=6)
    assert not np.array_equal(env.step(np.zeros(4))[0], flights[0][1])


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"vehicle": DELAYED, "wind": 2.0, "gusts": (0.3, 0.01)},
        {"randomize": "posterior", "sensors": "state"},
        {"vehicle": NINE, "sensors": "mocap", "task": "waypoints"},
        {"vehicle": NINE, "sensors": "paper", "wind": 2.0, "turbulence": "light"},
    ],
    ids=["plain", "delayed in wind and gusts", "randomized", "nine effects", "and turbulence"],
)
def test_a_row_flies_as_a_single_env_through_every_reset(arguments):
    n, seed = 3, 11
    rows = gymnasium.make_vec(
        "CoaxHeli-v0", num_envs=n, vectorization_mode="vector_entry_point",
        max_episode_steps=120, **arguments,
    )  # fmt: skip
    singles = [gymnasium.make("CoaxHeli-v0", max_episode_steps=120, **arguments) for _ in range(n)]
    observations, _ = rows.reset(seed=seed)
    for i, env in enumerate(singles):
        assert np.array_equal(env.reset(seed=seed + i)[0], observations[i])
    waiting, ends = np.zeros(n, dtype=bool), 0
    for action in actions(1, 400, n, 4, size=1.0):
        observations, rewards, terminated, truncated, info = rows.step(action)
        for i, env in enumerate(singles):
            if waiting[i]:
                observation, one = env.reset()
                reward, over, late = 0.0, False, False
            else:
                observation, reward, over, late, one = env.step(action[i])
            assert np.array_equal(observation, observations[i])
            assert (reward, over, late) == (rewards[i], terminated[i], truncated[i])
            assert np.array_equal(one["state"], info["state"][i])
            waiting[i] = over or late
            ends += waiting[i]
    assert ends >= 6


def test_rows_without_a_seed_of_their_own_fly_apart():
    env = CoaxVectorEnv(3)
    observations, _ = env.reset(seed=[7, None, None])
    assert np.array_equal(observations[0], gymnasium.make("CoaxHeli-v0").reset(seed=7)[0])
    assert not np.array_equal(observations[1], observations[2])
    with pytest.raises(InputError, match="seed must be one number or 3"):
        env.reset(seed=[1, 2])


@pytest.mark.parametrize("n", [3, 16], ids=["one by one", "in a SIMD batch"])
def test_the_order_of_actions_in_memory_changes_nothing(n):
    """Row by row, column by column, or every second of a larger array."""
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (n, 4))
    spread = np.zeros((2 * n, 8))
    spread[::2, ::2] = actions
    ends = []
    for given in (actions, np.asfortranarray(actions), spread[::2, ::2], actions.astype(">f8")):
        env = CoaxVectorEnv(n)
        env.reset(seed=1)
        for _ in range(5):
            observations, *_ = env.step(given)
        ends.append(observations)
    for end in ends[1:]:
        np.testing.assert_array_equal(end, ends[0])


def test_threads_change_nothing():
    flown = []
    for threads in (1, 3):
        env = CoaxVectorEnv(1024, threads=threads)
        env.reset(seed=3)
        for action in actions(2, 20, 1024, 4):
            observations, rewards, *_ = env.step(action)
        flown.append((observations, rewards))
    assert np.array_equal(flown[0][0], flown[1][0])
    assert np.array_equal(flown[0][1], flown[1][1])


def test_what_a_thread_raises_is_raised_when_all_have_ended():
    ended = []

    def share(first: int, last: int) -> None:
        if first in (0, 4):
            raise ValueError(f"share from {first}")
        time.sleep(0.02)
        ended.append(first)

    for _ in range(2):  # and the threads work on
        with pytest.raises(ValueError, match="share from"):
            in_threads(share, 12, 3)
    assert ended == [8, 8]


def test_calls_of_two_threads_share_workers_and_wait_for_their_own():
    def call(k: int) -> list[int]:
        shares: list[int] = []

        def share(first: int, last: int) -> None:
            time.sleep(0.001 * ((first + k) % 3))
            shares.append(first)

        for _ in range(20):
            in_threads(share, 9, 3)
            assert sorted(shares) == [0, 3, 6]
            shares.clear()
        return shares

    with ThreadPoolExecutor(4) as callers:
        assert list(callers.map(call, range(4))) == [[]] * 4


@pytest.mark.parametrize("count", [600, 4096, 5001])
@pytest.mark.parametrize("threads", [2, 3, 7])
@pytest.mark.parametrize("more", [0.0, 0.06, MOST_MORE])
def test_shares_hold_every_row_once_and_the_callers_is_the_larger(count, threads, more):
    balance = Balance()
    balance.more = more
    edges = balance.edges(count, threads)
    assert len(edges) == threads + 1 and edges[0] == 0 and edges[-1] == count
    sizes = np.diff(edges)
    assert min(sizes) > 0
    assert edges[1] % GROUP == 0 and abs(edges[1] - (1.0 / threads + more) * count) <= GROUP / 2
    assert max(sizes[1:]) - min(sizes[1:]) <= 1


def test_a_group_is_what_flies_side_by_side():
    assert GROUP == SIMD_WIDTH


@pytest.mark.parametrize("larger", [True, False])
def test_the_callers_share_grows_where_it_waits_and_falls_back_to_an_equal_one(larger):
    """The other thread ends once the caller has found it at work, or the caller once the other has."""
    found = threading.Event()

    class Told(Balance):
        def learn(self, waited: bool) -> None:
            super().learn(waited)
            found.set()

    balance = Told()
    balance.more = 0.0 if larger else MOST_MORE

    def share(first: int, last: int) -> None:
        if larger and first > 0:
            assert found.wait(60.0)
        elif not larger and first == 0:
            in_threads(lambda first, last: None, 2, 2)  # behind it in the one other thread

    for _ in range(3):
        found.clear()
        in_threads(share, 800, 2, balance)
    assert 0.0 <= balance.more <= MOST_MORE
    assert (balance.more > 0.0) if larger else (balance.more < MOST_MORE)
    for waited, bound in ((True, MOST_MORE), (False, 0.0)):
        for _ in range(1000):
            balance.learn(waited)
        assert balance.more == bound


@pytest.mark.parametrize("count", [3, 16])  # one by one; side by side
def test_actions_stay_as_they_were_given(count):
    env = CoaxVectorEnv(count, control_rate=50.0)
    env.reset(seed=0)
    given = np.full((count, 4), 1.5)  # clipped, but not in place
    env.step(given)
    assert (given == 1.5).all()


def test_streams_are_uniform_normal_and_unrelated():
    streams = np.array([(stream_key(np.uint64(s)), 0) for s in range(2)], dtype=np.uint64)
    draws = np.array([[uniform(s, 0.0, 1.0) for _ in range(20000)] for s in streams])
    assert np.allclose(draws.mean(axis=1), 0.5, atol=0.01)
    assert abs(np.corrcoef(draws)[0, 1]) < 0.03
    normals = np.array([two_normals(streams[0]) for _ in range(20000)])
    assert np.allclose(normals.std(axis=0), 1.0, atol=0.02)
    assert abs(np.corrcoef(normals.T)[0, 1]) < 0.03
    assert abs((normals**4).mean() - 3.0) < 0.2


# --- flights --------------------------------------------------------------------------------------


def test_a_step_is_the_kernels_step():
    env = gymnasium.make("CoaxHeli-v0", sensors="state").unwrapped
    _, info = env.reset(seed=1)
    action = actions(3, 4)
    trim, scale = action_map(LAMA)
    expected = np.empty(29)
    command = kernel_input(trim + scale * action.astype(float))
    step(info["state"], command, DT, LAMA.vector, np.zeros(WORK_SIZE), expected)
    assert np.array_equal(env.step(action)[4]["state"], expected)


def test_a_pure_delay_of_the_servos_shifts_the_swash_commands():
    late = LAMA.with_effect("servo_delay", time=0.03)
    flown = []
    moves = actions(4, 60, 4, size=0.3)
    moves[:, :2] = 0.0
    for vehicle, shift in ((LAMA, 3), (late, 0)):
        env = gymnasium.make("CoaxHeli-v0", vehicle=vehicle, nominal=LAMA).unwrapped
        env.reset(options={"state": np.r_[np.zeros(15), -1.5]})
        given = np.vstack([np.zeros((shift, 4), np.float32), moves])[:60]
        flown.append([env.step(a)[4]["state"][:16] for a in given])
    assert np.abs(np.array(flown[0]) - np.array(flown[1])).max() < 1e-9


def test_readings_have_their_noise_rate_and_flags():
    env = gymnasium.make("CoaxHeli-v0").unwrapped
    names = list(env.observation_names)
    trim = coax_env.hover_trim(LAMA)[0]
    env.reset(seed=0, options={"state": trim})
    rows = np.array([env.step(np.zeros(4))[0] for _ in range(1000)])
    truth = {"h": 1.5, "az": -9.8, "p": 0.0}
    for sensor in SUITES["onboard"]:
        column = rows[:, names.index(sensor.name)]
        flag = f"new_{sensor.instrument}"
        new = rows[:, names.index(flag)] > 0.5 if flag in names else np.ones(1000, bool)
        assert abs(new.mean() - sensor.rate / 100.0) < 0.02
        held = np.flatnonzero(~new[1:]) + 1
        assert np.array_equal(column[held], column[held - 1])
        if sensor.name in truth:
            count = new.sum()
            assert abs(column[new].std() / sensor.noise - 1.0) < 5.0 / math.sqrt(count)
            assert abs(column[new].mean() - truth[sensor.name]) < 0.1


@pytest.mark.parametrize("rate", [10.0, 20.0, 40.0, 100.0])
def test_rates_are_met_from_the_first_row(rate):
    new = [bool(is_new(row, rate)) for row in range(1000)]
    assert new[0] and sum(new) == 10 * rate


@pytest.mark.parametrize(
    ("state", "over"),
    [
        ({}, False),
        ({"z": -0.02}, True),
        ({"z": -7.0}, True),
        ({"phi": 1.2}, True),
        ({"theta": -0.9}, False),
        ({"x": 30.0}, True),
        ({"u": 20.0}, True),
        ({"psi": 40.0}, False),
        ({"alpha_f": math.nan}, True),
    ],
)
def test_flights_end_where_they_must(state, over):
    names = [name for name, _ in coax_env.model.layout.STATES]
    start = np.zeros(16)
    start[15] = -1.5
    for name, value in state.items():
        start[names.index(name)] = value
    env = gymnasium.make("CoaxHeli-v0").unwrapped
    env.reset(seed=0, options={"state": start})
    observation, reward, terminated, truncated, _ = env.step(np.zeros(4))
    assert terminated is over and truncated is False
    assert observation in env.observation_space
    assert math.isfinite(reward)


def test_an_action_that_is_not_a_number_ends_the_flight():
    env = gymnasium.make("CoaxHeli-v0").unwrapped
    env.reset(seed=0)
    observation, reward, terminated, _, _ = env.step(np.array([0.0, np.nan, 0.0, 0.0]))
    assert terminated and reward == 0.0 and observation in env.observation_space


def test_reward_is_the_sum_of_its_named_terms_and_best_at_the_goal():
    env = gymnasium.make("CoaxHeli-v0").unwrapped
    env.reset(seed=0, options={"state": coax_env.hover_trim(LAMA)[0]})
    best = env.step(np.zeros(4))
    assert best[1] == pytest.approx(1.0, abs=1e-3)
    env.reset(seed=0)
    for action in actions(5, 20, 4):
        _, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        assert tuple(info["reward_terms"]) == hover.REWARD_TERMS == tuple(hover.REWARD_WEIGHTS)
        assert 0.0 < reward < best[1]
    assert sum(hover.REWARD_WEIGHTS.values()) == pytest.approx(1.0)
    assert list(hover.LIMITS) == list(hover.COST_WEIGHTS) == list(hover.REWARD_SCALES)


def test_starts_fill_the_contracts_ranges():
    env = CoaxVectorEnv(4000)
    _, info = env.reset(seed=0)
    x = info["state"]
    degree = math.pi / 180.0
    half = [0.3] * 3 + [10 * degree] * 3 + [5 * degree] * 2 + [20 * degree]
    for column, width in zip((0, 1, 2, 3, 4, 5, 10, 11, 12), half, strict=True):
        assert np.abs(x[:, column]).max() <= width
        assert x[:, column].std() == pytest.approx(width / math.sqrt(3.0), rel=0.05)
    assert (np.abs(x[:, 15] + 1.5) <= 0.3).all()


# --- vector env -----------------------------------------------------------------------------------


def test_same_step_autoreset_hands_each_row_its_own_end():
    env = CoaxVectorEnv(4, max_episode_steps=50, autoreset_mode=AutoresetMode.SAME_STEP)
    twin = CoaxVectorEnv(4, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=2), twin.reset(seed=2)
    for action in actions(6, 50, 4, 4, size=0.1):
        observations, _, terminated, truncated, info = env.step(action)
        last, *_ = twin.step(action)
    assert truncated.all() and not terminated.any()
    assert np.array_equal(info["final_obs"], last)
    assert info["_final_obs"].all()
    assert not np.array_equal(observations, last)
    assert (env.fleet.rows == 0).all()


def test_disabled_autoreset_leaves_ended_rows_until_asked():
    env = CoaxVectorEnv(2, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    bad = np.zeros((2, 4))
    bad[0] = np.nan
    _, _, terminated, _, _ = env.step(bad)
    assert terminated.tolist() == [True, False]
    _, rewards, terminated, _, _ = env.step(np.zeros((2, 4)))
    assert terminated.tolist() == [True, False] and rewards[0] == 0.0 and rewards[1] > 0.0
    env.reset(options={"reset_mask": np.array([True, False])})
    assert env.fleet.rows.tolist() == [0, 2]
    assert not env.step(np.zeros((2, 4)))[2].any()


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("n", [3, 11])  # one by one, and in lanes
def test_states_once_told_stay_as_they_were(mode, n):
    env = CoaxVectorEnv(n, max_episode_steps=30, autoreset_mode=mode)
    states = [env.reset(seed=0)[1]["state"]]
    copies = [states[0].copy()]
    for action in actions(0, 80, n, 4):
        *_, truncated, info = env.step(action)
        states.append(info["state"])
        if "final_info" in info:
            states.append(info["final_info"]["state"])
        copies += [state.copy() for state in states[len(copies) :]]
        if mode == AutoresetMode.DISABLED and truncated.any():
            env.reset(options={"reset_mask": truncated})
    assert all(np.array_equal(*pair) for pair in zip(copies, states, strict=True))
    assert not np.array_equal(states[0], states[1])
    with pytest.raises(ValueError, match="read-only"):
        states[-1][0] = 0.0


def test_the_action_is_centred_on_the_nominal_vehicle_whatever_flies():
    heavy = LAMA.with_effect("added_mass", mass=0.1)
    for vehicle in (LAMA, heavy):
        env = gymnasium.make("CoaxHeli-v0", vehicle=vehicle).unwrapped
        assert np.array_equal(env.fleet.trim, coax_env.hover_trim(LAMA)[1])
    assert nominal_for(heavy).effects == {}
    own = gymnasium.make("CoaxHeli-v0", vehicle=heavy, nominal=heavy).unwrapped
    assert own.fleet.trim[0] > env.fleet.trim[0]


def test_a_drawn_vehicle_is_told_and_flown():
    env = gymnasium.make("CoaxHeli-v0", randomize="posterior").unwrapped
    masses = [env.reset(seed=s)[1]["vehicle"]["mass"] for s in (1, 2, 1)]
    assert masses[0] == masses[2] != masses[1]
    assert env.fleet.params_of(0)[0] == masses[2]


# --- logs -----------------------------------------------------------------------------------------


def test_a_log_has_the_suites_channels_rates_and_noise():
    time = np.arange(0.0, 20.0, 0.01)
    truth = np.zeros((len(time), 18))
    truth[:, coax_env.model.layout.CHANNELS.index("h")] = 1.5
    log = log_readings(truth, time, log_suite("onboard"), np.random.default_rng(0))
    assert set(log) == {s.name for s in SUITES["onboard"]}
    for sensor in log_suite("onboard"):
        fresh = np.isfinite(log[sensor.name])
        assert fresh[0] and fresh.sum() == pytest.approx(20.0 * sensor.rate, abs=1)
    assert log["h"][np.isfinite(log["h"])].std() == pytest.approx(0.05, rel=0.15)


# --- other people's tools -------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["sync", pytest.param("async", marks=pytest.mark.slow)])
def test_gymnasiums_own_batches_fly_the_same(mode):
    theirs = gymnasium.make_vec("CoaxHeli-v0", num_envs=2, vectorization_mode=mode)
    ours = gymnasium.make_vec("CoaxHeli-v0", num_envs=2, vectorization_mode="vector_entry_point")
    assert np.array_equal(theirs.reset(seed=3)[0], ours.reset(seed=3)[0])
    for action in actions(7, 5, 2, 4):
        assert np.array_equal(theirs.step(action)[0], ours.step(action)[0])
    theirs.close()


def test_gymnasiums_vector_wrappers_understand_the_infos():
    from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

    env = DictInfoToList(RecordEpisodeStatistics(CoaxVectorEnv(3, max_episode_steps=20)))
    env.reset(seed=0)
    for _ in range(20):
        *_, truncated, infos = env.step(np.zeros((3, 4)))
    assert truncated.all()
    assert [info["episode"]["l"] for info in infos] == [20, 20, 20]
    assert set(infos[0]["reward_terms"]) == set(hover.REWARD_TERMS)


@pytest.mark.slow
@pytest.mark.parametrize("sensors", SUITES)
def test_stable_baselines_check_passes_without_a_warning(sensors):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(gymnasium.make("CoaxHeli-v0", sensors=sensors).unwrapped)


@pytest.mark.slow
def test_gymnasiums_own_vector_env_flies_the_same():
    """AsyncVectorEnv, a process per helicopter, against the batch; without a warning."""
    program = (
        "import gymnasium, numpy as np, coax_env\n"
        "kinds = ('async', 'vector_entry_point')\n"
        "both = [gymnasium.make_vec('CoaxHeli-v0', num_envs=2, vectorization_mode=k) for k in kinds]\n"
        "seen = [env.reset(seed=3)[0] for env in both]\n"
        "for k in range(20):\n"
        "    action = np.full((2, 4), 0.01 * k, dtype=np.float32)\n"
        "    seen += [part for env in both for part in env.step(action)[:2]]\n"
        "assert np.array_equal(seen[0], seen[1])\n"
        "for k in range(2, len(seen), 4):\n"
        "    assert np.array_equal(seen[k], seen[k + 2]) and np.allclose(seen[k + 1], seen[k + 3])\n"
        "both[0].close()\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
