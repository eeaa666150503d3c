"""Many pieces of work at once: what comes back is what one worker alone would have made."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

import coax_env
from coax_env.errors import InputError
from coax_env.workers import each
from controllers import pid, policy
from controllers.evaluation import evaluate_spread

BACKENDS = ("loky", pytest.param("ray", marks=pytest.mark.slow))  # a cluster takes a while to start
SCRIPTS = Path(__file__).parents[1] / "scripts"
LAMA = coax_env.load_vehicle("lama400d")
DRAGGED = LAMA.with_effect("rotor_drag", coefficient=4e-4)  # so that the wind acts


@pytest.fixture(params=BACKENDS)
def backend(request):
    if request.param == "ray":
        pytest.importorskip("ray")
    return request.param


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_every_piece_comes_back_once_with_its_own_result(jobs, backend):
    pieces = list(range(11))  # more than a portion of two workers
    found = list(each(math.factorial, pieces, jobs, backend))
    assert sorted(found) == [(n, math.factorial(n)) for n in pieces]


def test_one_job_works_piece_by_piece_in_this_process():
    done = []
    results = each(done.append, [1, 2, 3])
    next(results)
    assert done == [1]
    assert [piece for piece, _ in results] == [2, 3]


@pytest.mark.parametrize(("jobs", "name"), [(0, "loky"), (2, "threads")])
def test_no_workers_are_refused(jobs, name):
    with pytest.raises(InputError, match=name):
        next(each(math.factorial, [1], jobs, name))


@pytest.mark.slow
def test_drawn_vehicles_are_judged_alike_by_two_workers(backend):
    controller = pid.design(LAMA)
    alone, both = (
        evaluate_spread(controller, DRAGGED, 3, 2, 4.0, seed=5, jobs=jobs, backend=where, wind=1.0)
        for jobs, where in ((1, "loky"), (2, backend))
    )
    assert both == alone
    assert len({one["mean_cost"] for one in alone["vehicles"]}) == 3


@pytest.mark.slow
def test_seeds_trained_side_by_side_are_those_trained_alone(backend, tmp_path):
    pytest.importorskip("stable_baselines3")
    from controllers import ppo, trainings

    small = {"steps": 2048, "settings": {"n_envs": 16, "batch_size": 256}}
    _, scores = trainings.train_best(
        LAMA, tmp_path, (3, 4), jobs=2, backend=backend, flights=2, **small
    )
    assert set(scores) == {"seed_3", "seed_4"}
    found = {seed: tmp_path / f"seed_{seed}" / "policy.zip" for seed in (3, 4)}
    for seed, path in found.items():
        alone = ppo.train(LAMA, tmp_path / f"alone_{seed}", seed=seed, **small)
        theirs, ours = policy.load_policy(path), policy.load_policy(alone)
        assert theirs.content["seed"] == seed
        for a, b in zip(theirs.network.layers, ours.network.layers, strict=True):
            assert (a[0] == b[0]).all() and (a[1] == b[1]).all()
    assert found[3].read_bytes() != found[4].read_bytes()


@pytest.mark.slow
def test_the_best_of_several_seeds_is_judged_on_flights_it_was_not_chosen_on(tmp_path):
    pytest.importorskip("stable_baselines3")
    words = ["--seeds", "2", "--seed", "5", "--steps", "2048", "--out", "out"]
    done = subprocess.run(
        [sys.executable, SCRIPTS / "train_ppo.py", *words, "--set", "n_envs=16", "batch_size=256"],
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    out = tmp_path / "out"
    scores = {s: json.loads((out / f"seed_{s}" / "score.json").read_text()) for s in (5, 6)}
    best = min(scores, key=lambda s: (-scores[s]["success_rate"], scores[s]["mean_cost"]))
    assert (out / "policy.zip").read_bytes() == (out / f"seed_{best}/policy.zip").read_bytes()
    seeds = {s["seed"] for s in scores.values()}
    assert len(seeds) == 1 and json.loads((out / "score.json").read_text())["seed"] not in seeds
    assert f"the best, seed {best}," in done.stdout
