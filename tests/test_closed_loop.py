"""What the commands know: the regression, the correction of the filter, and what it is good for."""

from dataclasses import replace

import injector
import numpy as np
import pytest

from coax_env import read_flight
from coax_env.diagnosis import closed_loop
from coax_env.diagnosis.search import Search, State
from coax_env.estimation.fit import Engine
from coax_env.estimation.helicopter import HeliModel, record_of, starting_noise
from coax_env.model import parameters as P
from coax_env.model.vehicle_file import load_vehicle

LAMA = load_vehicle("lama400d")


def search_on(folder, candidates=()) -> tuple[Search, State]:
    flight = read_flight(folder)
    model = HeliModel(LAMA.in_air(flight.air))
    search = Search(Engine(model, [record_of(run) for run in flight.runs]), model, candidates)
    return search, search.begin(starting_noise(flight, model.vehicle))


def test_surprise_is_what_the_known_does_not_say():
    """Planted: a linear pilot, white news, and a maneuver's steps, which are no news."""
    rng = np.random.default_rng(1)
    known = rng.standard_normal((3000, 6)) * [1.0, 0.1, 10.0, 1e-3, 1.0, 1.0]
    news = 0.01 * rng.standard_normal(3000)
    change = known @ [0.02, -0.5, 0.003, 20.0, 0.0, -0.01] + 0.3 + news
    steps = rng.choice(3000, 40, replace=False)
    change[steps] += rng.choice([-0.5, 0.5], 40)
    found = closed_loop.surprise(known, change)
    quiet = np.setdiff1d(np.flatnonzero(np.abs(news) < 0.015), steps)
    assert np.corrcoef(found[quiet], news[quiet])[0, 1] > 0.98
    assert np.abs(found).max() < 0.025  # two standard deviations and a little


def test_a_command_that_is_held_has_no_news():
    """A radio at a third of the log's rate says nothing in the rows between."""
    rng = np.random.default_rng(2)
    known = rng.standard_normal((900, 4))
    change = np.zeros(900)
    change[::3] = (known @ [0.1, 0.2, 0.0, 0.0] + 0.05 * rng.standard_normal(900))[::3]
    found = closed_loop.surprise(known, change)
    assert not found[change == 0.0].any()
    assert np.std(found[::3]) > 0.03
    assert not closed_loop.surprise(known, np.zeros(900)).any()


@pytest.mark.slow
def test_without_gains_news_changes_nothing_and_a_gain_moves_its_state(tmp_path):
    injector.fly(tmp_path, {}, gusts=True, sensors="onboard", seed=5, runs=("hover",))
    search, state = search_on(tmp_path)
    before = search.engine.log_likelihood(state.values, state.noise)
    closed_loop.attach_news(search.engine, state)
    record = search.engine.records[0]
    assert record.news.shape == (record.t.size, 4)
    assert search.engine.log_likelihood(state.values, state.noise) == pytest.approx(before)
    for name in P.COMMAND_GAINS:
        moved = search.engine.log_likelihood({**state.values, name: 1e-3}, state.noise)
        assert moved != pytest.approx(before, abs=1e-9), name


def test_where_nothing_shakes_the_machine_the_commands_know_nothing(tmp_path):
    injector.fly(tmp_path, {}, gusts=False, sensors="full", seed=3, runs=("lon_3211", "hover"))
    search, state = search_on(tmp_path)
    state = search.settle(state)
    assert not closed_loop.listen(search, state)
    assert not any(f.name in P.COMMAND_GAINS for f in search.base)
    assert all(record.news is None for record in search.engine.records)


@pytest.mark.slow
def test_a_pilot_who_sees_the_gusts_is_not_taken_for_a_late_servo(tmp_path):
    """The generator's pilot flies on the true state. There is no delay and the inertias are right."""
    injector.fly(tmp_path, {}, gusts=True, sensors="onboard", seed=11)
    search, state = search_on(tmp_path, ("servo_delay",))

    def sigmas(state: State) -> dict[str, float]:
        start = {**state.values, "servo_delay.time": 0.01}
        fitted = search.converge(replace(state, active=["servo_delay"], values=start))
        _, quadratic = search.linearise(fitted)
        names = search.free_names(["servo_delay"])
        std = np.sqrt(np.diag(quadratic.covariance(names)))
        return {
            f.name: (fitted.values[f.name] - f.value) / std[names.index(f.name)]
            for f in search.free(["servo_delay"])
        }

    deaf = sigmas(search.converge(replace(state)))
    assert closed_loop.listen(search, state)
    assert closed_loop.listen(search, state)  # once more changes nothing
    heard = sigmas(search.converge(state))
    assert deaf["servo_delay.time"] > 3.0 and deaf["inertia_zz"] > 1.0
    assert heard["servo_delay.time"] < 3.0 and abs(heard["inertia_zz"]) < 2.0
    assert heard["command_gain.rate_xy"] < -3.0  # the pilot steers against what he sees
