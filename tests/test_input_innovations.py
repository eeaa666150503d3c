"""Input innovations: the regression, the correction of the filter, and what it is good for."""

import math
from dataclasses import replace
from types import SimpleNamespace

import injector
import numpy as np
import pytest

from coax_env import read_flight
from coax_env.diagnosis import input_innovations
from coax_env.diagnosis.fits import converged, fitted, linearise, start
from coax_env.diagnosis.input_innovations import (
    has_command_gains,
    with_command_gains,
    with_input_innovations,
)
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation import compiled_model
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.input_innovations import clipped_residual, command_gains, innovations
from coax_env.estimation.prediction import replay_runs
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.model import parameters as P
from coax_env.model.layout import CHANNELS, GUSTS, N_FULL
from coax_env.model.vehicle_file import load_vehicle

LAMA = load_vehicle("lama400d")


def problem_on(folder, candidates=()) -> tuple[Problem, Fit]:
    flight = read_flight(folder)
    model = HeliModel(LAMA.in_air(flight.air))
    problem = Problem.of(model, [record_of(run) for run in flight.runs], candidates)
    return problem, start(problem, starting_noise(flight, model.vehicle))


def test_the_residual_is_what_is_not_predicted():
    """Planted: a linear pilot, white innovations, and a maneuver's steps, which are none."""
    rng = np.random.default_rng(1)
    known = rng.standard_normal((3000, 6)) * [1.0, 0.1, 10.0, 1e-3, 1.0, 1.0]
    planted = 0.01 * rng.standard_normal(3000)
    change = known @ [0.02, -0.5, 0.003, 20.0, 0.0, -0.01] + 0.3 + planted
    steps = rng.choice(3000, 40, replace=False)
    change[steps] += rng.choice([-0.5, 0.5], 40)
    found = clipped_residual(known, change)
    quiet = np.setdiff1d(np.flatnonzero(np.abs(planted) < 0.015), steps)
    assert np.corrcoef(found[quiet], planted[quiet])[0, 1] > 0.98
    assert np.abs(found).max() < 0.025  # two standard deviations and a little


def test_a_command_that_is_held_has_no_innovation():
    """A radio at a third of the log's rate says nothing in the rows between."""
    rng = np.random.default_rng(2)
    known = rng.standard_normal((900, 4))
    change = np.zeros(900)
    change[::3] = (known @ [0.1, 0.2, 0.0, 0.0] + 0.05 * rng.standard_normal(900))[::3]
    found = clipped_residual(known, change)
    assert not found[change == 0.0].any()
    assert np.std(found[::3]) > 0.03
    assert not clipped_residual(known, np.zeros(900)).any()


def made_pass(u: np.ndarray, states: np.ndarray, covariances: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(
        states=states, record=SimpleNamespace(command=u), start_covariances=covariances
    )


def test_a_pilot_sees_ahead_and_to_the_right_whatever_his_heading():
    """He turns twice round while he steers back by where he is from his nose: one pilot all the way."""
    rng = np.random.default_rng(3)
    ahead, right = np.cumsum(0.1 * rng.standard_normal((2, 900)), axis=1)
    heading = 4.0 * np.pi * np.arange(900) / 900
    planted = 0.01 * rng.standard_normal((900, 4))
    u = np.zeros((900, 4))
    for k in range(2, 900):
        seen = np.array([0.0, 0.0, ahead[k], right[k]])
        u[k] = 0.8 * u[k - 1] + 0.1 * u[k - 2] - 0.02 * seen + planted[k]
    states = 1e-9 * rng.standard_normal((900, N_FULL))
    states[:, 12] = heading
    states[:, 13] = np.cos(heading) * ahead - np.sin(heading) * right
    states[:, 14] = np.sin(heading) * ahead + np.cos(heading) * right
    (e,) = innovations([made_pass(u, states, np.zeros((1, N_FULL, N_FULL)))])
    assert e.shape == (900, 4) and not e[:2].any()
    for j in range(4):
        quiet = np.abs(planted[:, j]) < 0.015
        quiet[:2] = False
        assert np.corrcoef(e[quiet, j], planted[quiet, j])[0, 1] > 0.95


def test_runs_are_regressed_together_and_each_gets_its_own_back():
    rng = np.random.default_rng(4)
    parts = []
    for n, level in ((400, 5.0), (300, -2.0)):
        u = level + 0.05 * np.cumsum(rng.standard_normal((n, 4)), axis=0)
        parts.append(made_pass(u, rng.standard_normal((n, N_FULL)), np.zeros((1, N_FULL, N_FULL))))
    both = innovations(parts)
    assert [e.shape for e in both] == [(400, 4), (300, 4)]
    swapped = innovations(parts[::-1])
    np.testing.assert_allclose(both[0], swapped[1], atol=1e-9)
    np.testing.assert_allclose(both[1], swapped[0], atol=1e-9)


def test_a_gain_s_prior_is_what_the_filter_does_not_know_over_what_commands_show():
    """Std of the states that it corrects over that of the tilts, or the rotors' difference or sum."""
    rng = np.random.default_rng(5)
    std = rng.uniform(0.5, 2.0, N_FULL)
    covariances = np.array([0.5, 1.5])[:, None, None] * np.diag(std**2)  # of mean 1
    e = rng.standard_normal((4000, 4)) * [1.0, 2.0, 0.01, 0.03]
    run = made_pass(np.zeros((4000, 4)), np.zeros((4000, N_FULL)), covariances)
    gains = {f.name: f for f in command_gains([run], [e])}
    assert list(gains) == list(P.COMMAND_GAINS) and all(f.value == 0.0 for f in gains.values())
    tilt, rotors = math.sqrt(0.5 * (0.01**2 + 0.03**2)), math.sqrt(5.0)
    for name, states, commands in (
        ("rate_xy", (3, 4), tilt), ("moment_xy", (23, 24), tilt), ("force_xy", (20, 21), tilt),
        ("rate_z", (5,), rotors), ("moment_z", (25,), rotors), ("speed_z", (2,), rotors),
        ("force_z", (22,), rotors),
    ):  # fmt: skip
        expected = np.mean(std[list(states)]) / commands
        assert gains[f"command_gain.{name}"].std == pytest.approx(expected, rel=0.05), name
    tied = e.copy()
    tied[:, 1] = tied[:, 0]  # the rotors are only moved together
    names = [f.name for f in command_gains([run], [tied])]
    assert not any(n.endswith(("rate_z", "moment_z")) for n in names) and len(names) == 5
    short = made_pass(np.zeros((90, 4)), np.zeros((90, N_FULL)), covariances[:0])
    assert command_gains([short], [e[:90]]) == [], "the filter's transient is all there is"


@pytest.mark.parametrize(
    ("fallen", "taken"), [(6.1, True), (5.9, False), (-3.0, False), (np.nan, False)]
)
def test_gains_are_fitted_where_that_is_worth_more_than_a_tie(monkeypatch, fallen, taken):
    """And only beside white innovations: what a model gets wrong follows the commands too."""
    first, *others = P.COMMAND_GAINS
    gains = [FreeParameter(first, 0.0, 0.1)]
    asked = []

    def fitted(problem, fit, tolerance):
        asked.append((dict(fit.values), tolerance))
        return replace(fit, objective=300.0 - fallen)

    monkeypatch.setattr(input_innovations, "sampled_passes", lambda engine, values, noise: [])
    monkeypatch.setattr(input_innovations, "shown_by_commands", lambda engine, passes: ([], gains))
    monkeypatch.setattr(input_innovations, "fitted", fitted)
    made = Problem(HeliModel(LAMA), Engine(HeliModel(LAMA), []), (), {})
    fit = Fit((), {"mass": 0.8, first: 0.2}, Noise({}), objective=300.0)
    for white in (True, False):
        monkeypatch.setattr(input_innovations, "is_white", lambda p, c, white=white: white)
        wider, found = input_innovations.with_command_gains(made, fit)
        if white and taken:
            assert wider.added == tuple(gains) and found.objective == 300.0 - fallen
        else:
            assert wider is made and found is fit
    ((values, tolerance),) = asked
    assert tolerance == 3.0 and values[first] == 0.2, "from where they stand"
    assert {values[n] for n in others} == {0.0}


@pytest.mark.slow
def test_without_gains_innovations_change_nothing_and_a_gain_moves_its_state(tmp_path):
    injector.fly(tmp_path, {}, gusts=True, sensors="onboard", seed=5, runs=("hover",))
    problem, fit = problem_on(tmp_path)
    before = problem.engine.log_likelihood(fit.values, fit.noise)
    engine = with_input_innovations(problem.engine, fit)
    record = engine.records[0]
    assert record.input_innovations.shape == (record.t.size, 4)
    assert problem.engine.records[0].input_innovations is None, "the problem stays as it was"
    assert engine.log_likelihood(fit.values, fit.noise) == pytest.approx(before)
    for name in P.COMMAND_GAINS:
        moved = engine.log_likelihood({**fit.values, name: 1e-3}, fit.noise)
        assert moved != pytest.approx(before, abs=1e-9), name


@pytest.mark.slow
def test_a_replay_has_no_innovations_in_its_open_loop(tmp_path):
    """They correct the state that a replay starts from, and nothing after: the future is not seen."""
    injector.fly(tmp_path, {}, gusts=True, sensors="onboard", seed=5, runs=("hover",))
    problem, fit = problem_on(tmp_path)
    engine = with_input_innovations(problem.engine, fit)
    plain, same = (replay_runs(e, fit.values, fit.noise)[0] for e in (problem.engine, engine))
    gains = {**fit.values, "command_gain.moment_xy": 5e-3}
    moved = replay_runs(engine, gains, fit.noise)[0]
    (run,) = engine.filter(gains, fit.noise)
    for channel in ("phi", "h"):
        np.testing.assert_array_equal(plain.channels[channel].predicted,
                                      same.channels[channel].predicted)  # fmt: skip
    assert not np.array_equal(plain.channels["phi"].predicted, moved.channels["phi"].predicted)
    # the last start's prediction by hand, from the filtered state with the bare inputs
    first = moved_start(engine.records[0].t)
    out = np.full((1, len(CHANNELS)), np.nan)
    x = run.states[[first]]
    x[:, GUSTS] = 0.0
    inputs = engine.model.inputs(problem.engine.records[0], engine.model.vector(gains))
    targets = np.full((1, len(CHANNELS)), -1, np.int64)
    phi = CHANNELS.index("phi")
    t_end = moved.channels["phi"].t[-1]
    targets[0, phi] = int(np.argmin(np.abs(engine.records[0].t - t_end)))
    compiled_model.fly_open_loop(
        engine.compiled,
        engine.intervals[0],
        inputs,
        x,
        engine.model.vector(gains),
        np.array([first]),
        targets,
        out,
    )
    assert out[0, phi] == pytest.approx(moved.channels["phi"].predicted[-1], abs=1e-12)


def moved_start(t: np.ndarray, horizon: float = 1.0) -> int:
    """Row of a replay's last start: every 0.25 s after 1 s (contract.md)."""
    times = np.arange(t[0] + 1.0, t[-1] - horizon + 1e-9, 0.25)
    return int(np.searchsorted(t, times[-1] - 1e-6))


@pytest.mark.slow
def test_in_still_air_the_commands_carry_no_information(tmp_path):
    injector.fly(tmp_path, {}, gusts=False, sensors="full", seed=3, runs=("lon_3211", "hover"))
    problem, fit = problem_on(tmp_path)
    fit = fitted(problem, fit)
    after, same = with_command_gains(problem, fit)
    assert after is problem and same is fit
    assert not has_command_gains(after)


@pytest.mark.slow
def test_a_pilot_who_sees_the_gusts_is_not_taken_for_a_late_servo(tmp_path):
    """The generator's pilot flies on the true state. There is no delay and the inertias are right."""
    injector.fly(tmp_path, {}, gusts=True, sensors="onboard", seed=11)
    problem, fit = problem_on(tmp_path, ("servo_delay",))

    def sigmas(problem: Problem, fit: Fit) -> dict[str, float]:
        with_delay = replace(fit.at({"servo_delay.time": 0.01}), active=("servo_delay",))
        found, _, quadratic = linearise(problem, converged(problem, with_delay))
        names = problem.free_names(["servo_delay"])
        std = np.sqrt(np.diag(quadratic.covariance(names)))
        return {
            f.name: (found.values[f.name] - f.value) / std[names.index(f.name)]
            for f in problem.free(["servo_delay"])
        }

    fit = converged(problem, fit)
    without = sigmas(problem, fit)
    wider, fit = with_command_gains(problem, fit)
    assert has_command_gains(wider)
    with_gains = sigmas(wider, converged(wider, fit))
    assert without["servo_delay.time"] > 3.0 and without["inertia_zz"] > 1.0
    assert with_gains["servo_delay.time"] < 3.0 and abs(with_gains["inertia_zz"]) < 2.0
    assert with_gains["command_gain.rate_xy"] < -3.0  # the pilot steers against what he sees
