"""A policy on another model, and the best of several trainings."""

import inspect
import json
import pickle
import sys
import zipfile
from functools import partial

import numpy as np
import pytest

import coax_env
from coax_env.errors import InputError
from coax_env.model.vehicle_file import load_vehicle
from controllers import policy
from controllers.estimator_design import design_estimator
from controllers.evaluation import evaluate
from controllers.policy import Network, Sight, load_policy, save_policy
from controllers.policy_transfer import joined_features, transferred

LAMA = load_vehicle("lama400d")
UNBALANCED = LAMA.with_effect("torque_balance", scale=0.07)
LATE = LAMA.with_effect("motor_lag", upper=0.06, lower=0.06)
SMALL = {"steps": 2048, "settings": {"n_envs": 16, "batch_size": 256}}


def random_policy(path, size=0.1):
    """A policy with a random network on lama400d's filter."""
    sight = Sight(design_estimator(LAMA, LAMA))
    sizes = policy.all_features([sight.estimator])
    rng = np.random.default_rng(3)
    shapes = ((8, len(sizes)), (4, 8))
    layers = [
        ((size * rng.standard_normal(s)).astype(np.float32), np.zeros(s[0], np.float32))
        for s in shapes
    ]
    content = {"vehicle": LAMA.name, "settings": {"base": "none", "learning_rate": 1e-2}}
    return save_policy(path, Network(layers), [sight], sizes, content)


def flown(one, vehicle, steps=50):
    """Actions (steps, 4) of a policy in one flight, centred on lama400d's trim."""
    import gymnasium

    env = gymnasium.make("CoaxHeli-v0", vehicle=vehicle, nominal=LAMA)
    observation, actions = env.reset(seed=5)[0], []
    one.reset()
    for _ in range(steps):
        actions.append(one.act(observation))
        observation = env.step(actions[-1])[0]
    return np.array(actions)


def test_a_policy_on_its_own_model_is_the_same(tmp_path):
    from controllers import trainings

    again = trainings.transfer(policy.SHIPPED, LAMA, tmp_path)
    assert np.array_equal(flown(load_policy(policy.SHIPPED), LAMA), flown(load_policy(again), LAMA))


def test_a_network_that_asks_for_nothing_holds_the_trim_of_the_model_it_is_on(tmp_path):
    from controllers import trainings

    path = trainings.transfer(
        random_policy(tmp_path / "policy.zip", 0.0), UNBALANCED, tmp_path / "on"
    )
    one = load_policy(path)
    trim, scale = one.nominal
    _, command = coax_env.trim(UNBALANCED)
    ((_, _), (_, bias)) = one.network.layers
    assert trim + scale * bias == pytest.approx(command, rel=1e-5, abs=1e-6)
    assert trim != pytest.approx(command, rel=1e-3)


def test_what_a_policy_has_not_met_does_not_change_its_action(tmp_path):
    """A policy for ``onboard`` has met no place: on ``mocap`` too it does not look at it."""
    old = load_policy(random_policy(tmp_path / "policy.zip"))
    sights = [Sight(design_estimator(LAMA, LAMA, sensors)) for sensors in ("onboard", "mocap")]
    names = list(joined_features(old, sights))
    known = list(old.content["features"])
    assert names[: len(known)] == known and "beyond_up" in names[len(known) :]
    seen = np.random.default_rng(0).standard_normal((5, len(names))).astype(np.float32)
    expected = old.suites.network(seen[:, : len(known)])
    assert transferred(old, sights)(seen) == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
def test_where_the_trim_alone_is_off_a_policy_flies_as_on_its_own_model_without_training(tmp_path):
    from controllers import trainings

    path = trainings.transfer(policy.SHIPPED, UNBALANCED, tmp_path, LAMA)
    own, before, after = (
        evaluate(load_policy(one), machine, 50)["mean_cost"]
        for one, machine in (
            (policy.SHIPPED, LAMA), (policy.SHIPPED, UNBALANCED), (path, UNBALANCED),
        )
    )  # fmt: skip
    assert after == pytest.approx(own, rel=0.05)
    assert before > 1.2 * own


@pytest.mark.slow
@pytest.mark.parametrize("with_critic", [True, False])
def test_training_begins_with_what_the_policy_does(with_critic, tmp_path):
    pytest.importorskip("stable_baselines3")
    from controllers import ppo, trainings

    start = policy.SHIPPED
    if with_critic:
        start = ppo.train(LAMA, tmp_path / "first", seed=1, **SMALL)
    unlearnt = {**SMALL["settings"], "learning_rate": 0.0}
    path = ppo.train(LATE, tmp_path, 2048, nominal=LAMA, start=start, settings=unlearnt)
    expected = load_policy(trainings.transfer(start, LATE, tmp_path / "moved", LAMA))
    found = load_policy(path)
    assert found.content["features"] == expected.content["features"]
    for ours, theirs in zip(found.network.layers, expected.network.layers, strict=True):
        assert ours[0] == pytest.approx(theirs[0]) and ours[1] == pytest.approx(theirs[1])


@pytest.mark.slow
def test_the_policy_kept_is_the_best_and_no_worse_than_the_one_there_was(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    from controllers import trainings

    short = partial(evaluate, seconds=5.0)
    monkeypatch.setattr(trainings, "evaluate", short)
    arguments = {"start": policy.SHIPPED, "flights": 4, "nominal": LAMA, **SMALL}
    best, scores = trainings.train_best(UNBALANCED, tmp_path / "a", (3,), **arguments)
    assert set(scores) == {"start", "transferred", "trained", "seed_3"}
    assert all(trainings.rank(scores[best]) <= trainings.rank(one) for one in scores.values())
    kept = (tmp_path / "a" / "policy.zip").read_bytes()
    assert kept == (tmp_path / "a" / best / "policy.zip").read_bytes()
    as_it_is = short(load_policy(policy.SHIPPED), UNBALANCED, 4, seed=scores[best]["seed"])
    assert scores["start"]["mean_cost"] == as_it_is["mean_cost"]

    made: list[str] = []
    again = trainings.train_best(
        UNBALANCED, tmp_path / "a", (3,), done=lambda name, _: made.append(name), **arguments
    )
    assert again == (best, scores) and not made
    other = trainings.train_best(UNBALANCED, tmp_path / "b", (3,), **arguments)
    assert other == (best, scores)
    for name in scores:
        ours, theirs = (load_policy(tmp_path / one / name / "policy.zip") for one in "ab")
        for a, b in zip(ours.network.layers, theirs.network.layers, strict=True):
            assert np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1])
    arguments["steps"] = 4096
    trainings.train_best(
        UNBALANCED, tmp_path / "a", (3,), done=lambda name, _: made.append(name), **arguments
    )
    assert {"trained", "seed_3"} <= set(made)


@pytest.mark.slow
def test_no_candidate_is_refused(tmp_path):
    pytest.importorskip("stable_baselines3")
    from controllers import ppo, trainings

    with pytest.raises(InputError, match="nothing to train"):
        trainings.train_best(LAMA, tmp_path, ())
    with pytest.raises(InputError, match="not both"):
        ppo.train(LAMA, tmp_path, resume=policy.SHIPPED, start=policy.SHIPPED)


class _Bomb:
    """Something that runs code when it is unpickled."""

    def __reduce__(self):
        return (open, ("bombed", "w"))


@pytest.mark.slow
@pytest.mark.parametrize("content", [b"PK", pickle.dumps(_Bomb())])
def test_a_start_runs_no_code(content, tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    from controllers import ppo

    monkeypatch.chdir(tmp_path)
    start = random_policy(tmp_path / "policy.zip")
    with zipfile.ZipFile(start, "a") as archive:
        archive.writestr("policy.pth", content)
    settings = {**SMALL["settings"], "net_arch": {"pi": [8], "vf": [8]}}
    with pytest.raises(InputError, match="broken"):
        ppo.train(LAMA, tmp_path / "on", 2048, start=start, settings=settings)
    assert not (tmp_path / "bombed").exists()


@pytest.mark.slow
def test_networks_of_another_shape_are_no_start(tmp_path):
    pytest.importorskip("stable_baselines3")
    from controllers import ppo

    settings = {**SMALL["settings"], "net_arch": {"pi": [16], "vf": [8]}}
    with pytest.raises(InputError, match="do not fit"):
        ppo.train(LAMA, tmp_path, 2048, start=policy.SHIPPED, settings=settings)


@pytest.mark.slow
def test_a_shipped_policy_is_brought_to_a_vehicle_on_the_command_line(
    tmp_path, monkeypatch, capsys
):
    """In this process; test_workers.py starts one of its own."""
    pytest.importorskip("stable_baselines3")
    import train_ppo

    from controllers import trainings

    assert inspect.signature(trainings.train_best).parameters["flights"].default == 200
    monkeypatch.setattr(trainings, "train_best", partial(trainings.train_best, flights=20))
    out = tmp_path / "out"
    words = ["--start", str(policy.SHIPPED), "--seeds", "0", "--steps", "2048", "--out", str(out)]
    words += ["--set", "n_envs=16", "batch_size=256"]
    monkeypatch.setattr(sys, "argv", ["train_ppo", *words])
    train_ppo.main()
    said = capsys.readouterr().out
    assert "the best, " in said and "transferred: 20 flights" in said
    assert json.loads((out / "score.json").read_text())["success_rate"] == 1.0
