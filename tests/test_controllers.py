"""Controllers: closed-form cost, filter statistics, hover on noisy sensors, files, scores."""

import io
import json
import pickle
import subprocess
import sys
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import coax_env
from coax_env.env import hover, tasks
from coax_env.env.period import DT
from coax_env.errors import InputError
from coax_env.model.dynamics import WORK_SIZE, kernel_input, step
from coax_env.model.linear import sampled
from controllers import (
    comparison,
    load_controller,
    lqr,
    margins,
    model_comparison,
    pid,
    policy,
    state_feedback,
)
from controllers.estimator import Tracker
from controllers.estimator_design import design_estimator, integrated_readings
from controllers.evaluation import evaluate, evaluate_spread
from controllers.loading import make_controller
from controllers.policy import Network
from controllers.target import Approach, TargetView

SCRIPTS = Path(__file__).parents[1] / "scripts"
LAMA = coax_env.load_vehicle("lama400d")
CONTRACT_KEYS = {
    "controller", "vehicle", "episodes", "success_rate", "mean_cost", "mean_return",
    "height_rms_m", "velocity_rms_mps", "heading_rms_deg", "drift_m", "effort",
}  # fmt: skip


@pytest.fixture(scope="module")
def onboard():
    return lqr.design(LAMA)


@pytest.fixture(scope="module")
def exact():
    return lqr.design(LAMA, sensors="state")


# --- regulator ------------------------------------------------------------------------------------


def test_the_riccati_solution_is_the_simulated_cost(exact):
    """x'Px is the sum of all costs to come, flown with the kernel itself near trim."""
    design = exact.estimator
    assert design.states[:20] == tuple(n for n, _ in coax_env.model.layout.FULL_STATES[:20])
    *_, trim, command = sampled(LAMA, DT)
    _, _, Q, R = lqr.regulator_problem(design)
    places = [design.readings.index(name) for name in integrated_readings(design)]
    rng = np.random.default_rng(0)
    x = trim.copy()
    x[:16] += 1e-4 * rng.standard_normal(16)
    n = len(design.states)
    known = np.concatenate([x[:n] - trim[:n], np.zeros(len(places))])
    predicted, simulated, work = known @ exact.cost_to_go @ known, 0.0, np.zeros(WORK_SIZE)
    for _ in range(6000):
        known[:n] = x[:n] - trim[:n]
        action = -exact.gain @ known
        simulated += known @ Q @ known + action @ R @ action
        known[n:] += DT * known[places]
        step(x, kernel_input(command + design.action_scale * action), DT, LAMA.vector, work, x)
    assert simulated == pytest.approx(predicted, rel=1e-3)


def test_the_regulators_weights_are_the_cost_every_controller_is_judged_by(exact):
    rng = np.random.default_rng(1)
    _, _, Q, R = lqr.regulator_problem(exact.estimator)
    states, action = np.zeros(29), rng.standard_normal(4)
    states[:16] = rng.standard_normal(16)
    states[10:13] *= 0.1
    deviation = np.zeros(len(Q))
    deviation[:16] = states[:16]
    states[15] -= hover.HEIGHT
    cost = deviation @ Q @ deviation + action @ R @ action
    assert hover.cost(states, action) == pytest.approx(cost)


def test_the_closed_loop_is_stable_and_has_the_margins_it_states(onboard):
    import control

    loop = margins.open_loop(onboard)
    inputs, disk = margins.stability_margins(onboard)

    def stable(gains):
        closed = control.feedback(loop * control.ss([], [], [], np.diag(gains), DT), np.eye(4))
        return bool(np.abs(closed.poles()).max() < 1.0)

    for k, one in enumerate(inputs):
        for factor in (1.0, 0.95, 1.05):
            gains = np.ones(4)
            gains[k] = one.gain_up * factor if factor != 1.0 else 1.0
            assert stable(gains) is (factor <= 1.0), one.input
    assert min(m.phase_deg for m in inputs) > 35.0 and disk > 0.5
    factor = (2.0 - 0.99 * disk) / (2.0 + 0.99 * disk)
    rng = np.random.default_rng(0)
    for _ in range(8):  # any mix of gains inside the disk margin leaves it stable
        assert stable(factor ** rng.choice([-1.0, 1.0], 4))


def test_weights_and_limits_make_the_cost():
    """An error counts weight / limit^2: a double limit is a quarter of the weight."""
    wide = lqr.design(LAMA, limits={"height": 0.2})
    light = lqr.design(LAMA, weights={"height": 0.25})
    assert wide.gain == pytest.approx(light.gain)
    assert not np.allclose(wide.gain, lqr.design(LAMA).gain)
    assert wide.to_dict()["cost"]["limits"]["height"] == 0.2
    again = lqr.LQG.from_dict(wide.to_dict())
    assert again.cost == wide.cost


@pytest.mark.slow
def test_the_worst_vehicle_is_worse_than_any_drawn_and_no_farther_than_asked(onboard):
    worst = margins.worst_over_spread(onboard, LAMA, distance=2.0, rounds=2, draws=6)
    z = np.array(list(worst.moves.values()))
    assert np.linalg.norm(z) == pytest.approx(2.0)
    assert worst.disk == margins.disk_margin(onboard, worst.vehicle)
    rng = np.random.default_rng(8)
    spread = LAMA.spread()
    for _ in range(6):
        z = rng.standard_normal(len(spread.names)) * (spread.std > 0.0)
        assert worst.disk < margins.disk_margin(onboard, LAMA.at(2.0 * z / np.linalg.norm(z)))


def test_mu_is_that_of_slycot():
    """An upper bound by another way of scaling: AB13MD."""
    slycot = pytest.importorskip("slycot")
    rng = np.random.default_rng(3)
    matrices = rng.standard_normal((6, 4, 4)) + 1j * rng.standard_normal((6, 4, 4))
    ours = margins._mu_upper_bounds(matrices)
    theirs = [slycot.ab13md(m, np.ones(4, int), 2 * np.ones(4, int))[0] for m in matrices]
    assert ours == pytest.approx(theirs, rel=0.1)
    assert (ours >= np.array(theirs) * 0.999).all()


def test_sensitivities_add_up_to_one_and_peak_where_the_margin_is_least(onboard):
    _, L, _ = margins.frequency_responses(onboard)
    S, T = margins.sensitivities(L)
    assert (S + T >= 1.0 - 1e-9).all() and (np.abs(S - T) <= 1.0 + 1e-9).all()
    assert S[0] < 0.05 and T[0] == pytest.approx(1.0, abs=0.05)
    _, disk = margins.stability_margins(onboard)
    # |S| <= |S - 1/2| + 1/2, and the disk margin is one over what bounds the first
    assert S.max() >= 1.0 / disk - 0.5 - 0.2


@pytest.mark.slow
def test_a_step_is_followed():
    from controllers import steps

    found = {r.name: r for r in steps.step_responses(lqr.design(LAMA, sensors="mocap"))}
    assert set(found) == {"height", "heading", "north", "east"}
    for one in found.values():
        assert one.value[0] == pytest.approx(0.0, abs=1e-12)
        assert one.value[-1] == pytest.approx(one.size, rel=0.3), one.name
        assert 0.1 < one.rise_s < 15.0
    assert found["height"].unit == "m" and found["heading"].unit == "rad"
    assert {r.name for r in steps.step_responses(lqr.design(LAMA))} == {"height", "heading"}


def test_margins_on_a_vehicle_without_spread_are_those_of_the_design(onboard):
    exact = LAMA.with_parameters({n: replace(p, std=0.0) for n, p in LAMA.parameters.items()})
    _, disk = margins.stability_margins(onboard)
    assert margins.margins_over_spread(onboard, exact, draws=1) == pytest.approx([disk], rel=1e-6)
    drawn = margins.margins_over_spread(onboard, LAMA, draws=2)
    assert len(set(drawn)) == 2 and drawn.min() > 0.3


# --- filter ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_filters_error_has_the_spread_it_states(onboard):
    n = 40
    env = gymnasium.make_vec("CoaxHeli-v0", num_envs=n, vectorization_mode="vector_entry_point")
    observations, _ = env.reset(seed=0)
    onboard.reset(n)
    *_, trim, _ = sampled(LAMA, DT)
    design = onboard.estimator
    errors = []
    for k in range(1200):
        truth = env.unwrapped.fleet.x.copy()
        actions = onboard.act(observations)
        if k > 600 and k % 20 == 0:
            errors.append(onboard.known[:, :16] - _deviation(truth, trim, design))
        observations = env.step(actions)[0]
    rms = np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
    for name in ("u", "w", "p", "phi", "psi", "z"):
        at = design.index(name)
        assert 0.4 < rms[at] / design.spread[at] < 1.3, name


def _deviation(truth, trim, design):
    names = [n for n, _ in coax_env.model.layout.FULL_STATES]
    found = truth[:, : trim.size] - trim
    return np.stack([found[:, names.index(s)] for s in design.states[:16]], axis=1)


@pytest.mark.parametrize(
    ("sensors", "hidden"),
    [
        ("onboard", {"x", "y"}),
        ("mocap", set()),
        ("state", set()),
        ("paper", {"u", "v", "phi", "theta", "psi", "x", "y"}),
    ],
)
def test_what_a_suite_does_not_show_is_dropped_and_named(sensors, hidden):
    design = design_estimator(LAMA, sensors=sensors)
    assert set(design.unobserved) == hidden
    assert not hidden & set(design.states)


def test_rows_of_a_batch_are_tracked_alone(onboard):
    """Resetting one row leaves the others, and each is as if it flew alone."""
    design = onboard.estimator
    rng = np.random.default_rng(0)
    width = len(coax_env.model.sensors.SUITES["onboard"]) + 3
    rows = rng.uniform(0.0, 1.0, (50, 3, width))
    actions = rng.uniform(-0.1, 0.1, (50, 3, 4))
    batch, alone = Tracker(design, 3), Tracker(design, 1)
    for k in range(50):
        if k == 23:
            batch.reset(np.array([False, True, False]))
            alone.reset(np.array([True]))
        known = batch.see(rows[k])
        assert known[1] == pytest.approx(alone.see(rows[k, 1:2])[0], abs=1e-12)
        batch.acted(actions[k]), alone.acted(actions[k, 1:2])


# --- flights --------------------------------------------------------------------------------------


def test_lqg_hovers_on_noisy_sensors(onboard):
    score = evaluate(onboard, LAMA, episodes=8, seconds=20.0)
    assert set(score) >= CONTRACT_KEYS
    assert score["survival_rate"] == score["success_but_drift_rate"] == 1.0
    assert score["worst_height_rms_m"] < 0.05
    json.dumps(score, allow_nan=False)


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["lama400d", "skybotix_coax"])
def test_lqg_hovers_a_minute_a_hundred_times(vehicle):
    score = evaluate(lqr.design(vehicle), vehicle, episodes=100, seconds=60.0)
    assert score["survival_rate"] == score["success_but_drift_rate"] == 1.0
    assert score["worst_height_rms_m"] < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [
        {"thrust_scale": {"scale": -0.07}, "torque_balance": {"scale": 0.07}},
        {"cg_offset": {"x": 0.0015, "y": -0.001}, "swash_offset": {"lon": 0.02, "lat": -0.02}},
        {"gyro_bias": {"x": 0.03, "y": -0.03, "z": 0.03}, "attitude_bias": {"x": 0.025, "y": 0.02}},
    ],
    ids=["thrust and torque", "trim", "biases"],
)
def test_what_the_design_did_not_know_is_integrated_away(onboard, effects):
    vehicle = LAMA
    for name, values in effects.items():
        vehicle = vehicle.with_effect(name, **values)
    score = evaluate(onboard, vehicle, episodes=10, seconds=20.0)
    assert score["success_but_drift_rate"] == 1.0


def test_a_design_on_the_corrected_model_flies_a_lagging_machine_better(onboard):
    late = LAMA.with_effect("motor_lag", upper=0.1, lower=0.1).with_effect("servo_lag", time=0.04)
    bare = evaluate(onboard, late, episodes=10, seconds=10.0)
    corrected = evaluate(lqr.design(late), late, episodes=10, seconds=10.0)
    assert corrected["mean_cost"] < 0.5 * bare["mean_cost"]


def test_one_flight_or_a_batch_get_the_same_actions(onboard):
    env = gymnasium.make("CoaxHeli-v0")
    observations = [env.reset(seed=0)[0]] + [env.step(np.zeros(4))[0] for _ in range(15)]
    onboard.reset()
    one = [onboard.act(o) for o in observations]
    onboard.reset(2)
    two = [onboard.act(np.stack([o, o])) for o in observations]
    assert one[0].shape == (4,) and two[0].shape == (2, 4)
    assert np.stack(two)[:, 1] == pytest.approx(np.stack(one), abs=1e-6)


def test_a_crash_is_counted_and_costs():
    class Falling:
        kind, sensors, nominal = "falling", "state", None

        def reset(self, count=1):
            pass

        def act(self, observation):
            return np.tile([-1.0, -1.0, 0.0, 0.0], (len(observation), 1))

    score = evaluate(Falling(), LAMA, episodes=3, seconds=5.0)
    assert score["success_rate"] == score["survival_rate"] == 0.0
    assert score["height_rms_m"] is None and score["drift_m"] is None
    assert score["mean_cost"] > 0.5 * hover.CRASHED_COST
    json.dumps(score, allow_nan=False)


def test_a_score_counts_the_flights_that_succeed_one_by_one():
    """In wind, on a rotor with drag, some do: each recorded flight judged alone gives the share."""
    vehicle = LAMA.with_effect("rotor_drag", coefficient=3.5e-4)
    controller, count, steps, wind = pid.design(LAMA), 12, 500, (2.0, -1.0)
    score = evaluate(controller, vehicle, count, steps * DT, seed=3, wind=wind)
    env = gymnasium.make_vec(
        "CoaxHeli-v0", num_envs=count, vectorization_mode="vector_entry_point", vehicle=vehicle,
        wind=wind, autoreset_mode="Disabled", max_episode_steps=None,
    )  # fmt: skip
    observations, _ = env.reset(seed=3)
    controller.reset(count)
    states = []
    for _ in range(steps):
        observations, *_, info = env.step(controller.act(observations))
        states.append(info["state"])
    goal = np.tile([0.0, 0.0, -hover.HEIGHT, 0.0], (steps, 1))
    flights = np.swapaxes(states, 0, 1)
    found = [tasks.succeeded("hover", flight, goal, steps) for flight in flights]
    assert 0 < sum(found) < count
    assert score["success_rate"] == pytest.approx(np.mean(found))


# --- files ----------------------------------------------------------------------------------------


def test_a_controller_is_read_back_as_it_was(onboard, tmp_path):
    path = onboard.save(tmp_path / "controller.json")
    again = load_controller(path)
    content = json.loads(path.read_text())
    assert content["format"] == "coax-controller"
    assert content["cost"]["weights"] == hover.COST_WEIGHTS
    assert len(content["estimator"]["action_trim"]) == 4
    observation = np.linspace(0.0, 1.0, 18, dtype=np.float32)
    onboard.reset(), again.reset()
    for _ in range(5):
        assert np.array_equal(onboard.act(observation), again.act(observation))


@pytest.mark.parametrize(
    "text", ["", "{}", "[1]", '{"format": "coax-controller", "version": 1, "kind": "lqg"}', "\xff"]
)
def test_a_broken_controller_gets_one_line(text, tmp_path):
    path = tmp_path / "controller.json"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(InputError) as error:
        load_controller(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_controller_keeps_to_its_nominal_trim_on_another_vehicle(onboard):
    heavy = LAMA.with_effect("added_mass", mass=0.05)
    assert np.array_equal(onboard.nominal[0], coax_env.hover_trim(LAMA)[1])
    assert evaluate(onboard, heavy, episodes=3, seconds=10.0)["survival_rate"] == 1.0
    own = lqr.design(heavy)
    assert np.array_equal(own.estimator.action_trim, onboard.estimator.action_trim)
    assert own.estimator.command_trim[0] > own.estimator.action_trim[0]


def test_no_evaluation_on_sensors_the_controller_does_not_know(onboard):
    with pytest.raises(InputError, match="onboard"):
        evaluate(onboard, LAMA, sensors="mocap")


@pytest.mark.slow
def test_scripts_design_and_evaluate(tmp_path):
    """What they refuse is in test_scripts.py."""

    def call(name, *words):
        return subprocess.run(
            [sys.executable, SCRIPTS / name, *words], capture_output=True, text=True, cwd=tmp_path
        )

    made = call("design_lqr.py", "--vehicles", "2", "--out", "design")
    assert made.returncode == 0, made.stderr
    assert "disk margin" in made.stdout
    assert "<html" in (tmp_path / "design" / "report.html").read_text(encoding="utf-8")
    flown = call("evaluate.py", "--controller", "design/controller.json", "--episodes", "5")
    assert flown.returncode == 0, flown.stderr
    score = json.loads((tmp_path / "runs" / "evaluate" / "score.json").read_text())
    assert score["success_rate"] == 1.0


# --- other controllers, tasks and vehicles ------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("integral", [False, True])
def test_state_feedback_costs_what_its_riccati_solution_says(integral):
    """x'Px for LQR and LQI, flown with the kernel itself near trim."""
    design = state_feedback.design(LAMA, integral=integral)
    model = design_estimator(LAMA, sensors="state")
    _, _, Q, R = lqr.regulator_problem(model)
    kept = np.r_[0:20, len(model.states) : len(model.states) + len(design.integrated)]
    Q = Q[np.ix_(kept, kept)]
    *_, trim, command = sampled(LAMA, DT)
    x = trim.copy()
    x[:16] += 1e-4 * np.random.default_rng(0).standard_normal(16)
    known = np.concatenate([x[:20] - trim[:20], np.zeros(len(design.integrated))])
    predicted, simulated, work = known @ design.cost_to_go @ known, 0.0, np.zeros(WORK_SIZE)
    for _ in range(6000):
        action = design.act(x[:20])
        simulated += known @ Q @ known + action @ R @ action
        step(x, kernel_input(command + design.action_scale * action), DT, LAMA.vector, work, x)
        known = np.concatenate([x[:20] - trim[:20], design.integrals[0]])
    assert simulated == pytest.approx(predicted, rel=2e-3)


@pytest.mark.slow
def test_lqi_takes_away_the_offset_that_lqr_leaves():
    heavy = LAMA.with_effect("thrust_scale", scale=-0.05)
    rms = {}
    for integral in (False, True):
        score = evaluate(state_feedback.design(LAMA, integral=integral), heavy, 4, 15.0)
        rms[integral] = score["height_rms_m"]
    assert rms[True] < 0.3 * rms[False]


def test_the_exact_state_costs_less_than_noisy_sensors(onboard):
    exact = evaluate(state_feedback.design(LAMA), LAMA, 10, 10.0)
    noisy = evaluate(onboard, LAMA, 10, 10.0)
    assert exact["mean_cost"] < 0.7 * noisy["mean_cost"]


@pytest.mark.slow
@pytest.mark.parametrize("sensors", ["onboard", "mocap"])
def test_pid_hovers_on_raw_sensors(sensors):
    score = evaluate(pid.design(LAMA, sensors=sensors), LAMA, episodes=10, seconds=15.0)
    assert score["success_rate"] == 1.0


def test_pid_needs_attitude():
    with pytest.raises(InputError, match="pid needs"):
        pid.design(LAMA, sensors="paper")


@pytest.mark.slow
@pytest.mark.parametrize("design", [lqr.design, pid.design, state_feedback.design])
def test_hover_controllers_fly_to_a_target_and_stay(design):
    sensors = {} if design is state_feedback.design else {"sensors": "mocap"}
    more = {} if design is pid.design else {"limits": lqr.BRISK}
    controller = design(LAMA, **sensors, **more)
    env = gymnasium.make_vec(
        "CoaxHeli-v0", num_envs=4, vectorization_mode="vector_entry_point", task="position",
        target=(1.5, -1.0, 2.0, 1.0), sensors=controller.sensors, max_episode_steps=None,
    )  # fmt: skip
    observations, _ = env.reset(seed=0)
    controller.reset(4)
    for _ in range(1500):
        observations, *_, info = env.step(controller.act(observations))
    error = info["state"][:, [13, 14, 15, 12]] - [1.5, -1.0, -2.0, 1.0]
    assert np.abs(error).max() < 0.3


def test_a_target_seen_from_itself_is_a_hover():
    """At the target, heading as asked, the observation is that of a hover; the way there is kept."""
    view = TargetView("mocap")
    rng = np.random.default_rng(0)
    names = view.names
    for _ in range(20):
        psi, goal = rng.uniform(-3.0, 3.0), rng.uniform(-5.0, 5.0, 2)
        base = np.zeros((1, view.width))
        base[0, names.index("psi")] = psi
        base[0, [names.index("pn"), names.index("pe")]] = goal
        base[0, names.index("h")] = 2.2
        base[0, [names.index("vn"), names.index("ve")]] = np.cos(psi), np.sin(psi)
        seen, asked, there = view.relative_to_target(np.hstack([base, np.zeros((1, 4))]))
        assert asked[0] == pytest.approx([*goal, -2.2, psi]) and there.all()
        assert seen[0, [names.index(n) for n in ("pn", "pe", "psi")]] == pytest.approx(np.zeros(3))
        assert seen[0, names.index("h")] == pytest.approx(hover.HEIGHT)
        assert seen[0, [names.index("vn"), names.index("ve")]] == pytest.approx([1.0, 0.0])
        away = np.array([[0.2, -0.1, 0.05, 0.1]])
        seen, asked, there = view.relative_to_target(np.hstack([base, away]))
        cosine, sine = np.cos(psi), np.sin(psi)
        north, east = 0.2 * cosine + 0.1 * sine, 0.2 * sine - 0.1 * cosine
        assert asked[0] == pytest.approx([goal[0] + north, goal[1] + east, -2.25, psi + 0.1])
        there_again = np.hypot(*seen[0, [names.index("pn"), names.index("pe")]])
        assert there_again == pytest.approx(np.hypot(0.2, 0.1)) and there.all()
        far = view.relative_to_target(np.hstack([base, 10.0 * away * [1.0, 1.0, 1.0, 0.1]]))[2]
        assert far[0].tolist() == [False, False, True]  # the heading is within reach


def test_what_is_blown_back_returns_through_nearer_setpoints():
    """Not one that comes nearer, nor one that is given a farther target, nor in a new flight."""
    approach, every = Approach(2), np.array([True, True])

    def reach(*ahead: float, which: np.ndarray = every) -> list[float]:
        way = np.zeros((2, 4))
        way[:, 0] = ahead
        return approach.reach(way, which, np.full(2, 5.0))[:, 0].tolist()

    assert reach(1.0, 1.0) == [0.5, 0.5]
    for away in np.linspace(0.0, 0.5, 6):  # the first is blown back, the second comes nearer
        found = reach(1.0 + away, 1.0 - away)
    assert found == pytest.approx([0.1, 0.5])
    assert reach(1.25, 0.4) == pytest.approx([0.3, 0.5]), "half between"
    assert reach(3.0, 2.0) == [0.5, 0.5], "new targets"
    assert reach(3.1, 2.1) == pytest.approx([0.5, 0.5])
    assert reach(3.34, 2.34) == pytest.approx([0.18, 0.18])
    approach.reset(np.array([True, False]))
    assert reach(3.34, 2.34) == pytest.approx([0.5, 0.18])
    assert reach(9.0, 2.5, which=np.array([False, True]))[1] == pytest.approx(0.1)
    assert reach(3.4, 2.5) == pytest.approx([0.5, 0.1]), "the first saw nothing before"


def test_a_flight_begins_with_near_setpoints_in_its_own_heading():
    """Up to 0.7 s 0.1 m and no turn, from 1 s on all of the reach; nearer where blown back already, and
    none of it once the plate is no longer busy."""
    approach, one = Approach(1), np.array([True])

    def reach(distance: float, flown: float) -> list[float]:
        return approach.reach(np.array([[distance, 0.0, 0.0, 2.0]]), one, np.array([flown]))[0]

    assert reach(1.0, 0.0) == pytest.approx([0.1, 0.0])
    assert reach(1.0, 0.7) == pytest.approx([0.1, 0.0])
    assert reach(1.0, 0.85) == pytest.approx([0.3, np.radians(5.0)])
    assert reach(1.0, 1.0) == pytest.approx([0.5, np.radians(10.0)])
    assert reach(1.25, 0.85) == pytest.approx([0.2, np.radians(5.0)])
    for _ in range(100):
        approach.acted(np.array([[1.0, -1.0, 0.1, -0.2]]))
    assert reach(1.0, 0.3) == pytest.approx([0.5, np.radians(10.0)])
    for _ in range(100):
        approach.acted(np.array([[0.0, 0.0, 0.1, -0.7]]))
    assert reach(1.0, 0.3) == pytest.approx([0.3, np.radians(5.0)], rel=1e-3)


def test_drawn_vehicles_are_judged_by_the_worst(onboard):
    score = evaluate_spread(onboard, LAMA, vehicles=3, episodes=2, seconds=5.0)
    rates = [one["success_rate"] for one in score["vehicles"]]
    assert score["success_rate"] == min(rates) and len(rates) == 3
    assert len({one["values"]["mass"] for one in score["vehicles"]}) == 3
    json.dumps(score, allow_nan=False)


@pytest.mark.slow
def test_a_comparison_has_every_controller_in_every_condition():
    content = comparison.compare(LAMA, episodes=5, seconds=4.0, vehicles=2)
    for name, row in content["conditions"].items():
        assert set(row) == {"lqg", "ppo", "pid", "lqi"}
        assert (row["ppo"] is None) is (name in ("position", "waypoints"))
    starts = {row["lqg"]["seed"] for row in content["conditions"].values()}
    assert starts == {0}
    page = comparison.comparison_page(content)
    assert "waypoints" in page and len(comparison.rows(content["conditions"])) == 24
    json.dumps(content, allow_nan=False)


@pytest.mark.parametrize("name", ["lqr", "lqi", "lqg", "pid", "ppo"])
def test_controllers_come_by_name_and_from_their_files(name, tmp_path):
    controller = make_controller(name, LAMA)
    assert controller.sensors == ("state" if name == "lqi" else "onboard")
    if name == "ppo":
        return
    again = load_controller(controller.save(tmp_path / "controller.json"))
    env = gymnasium.make("CoaxHeli-v0", sensors=controller.sensors)
    observation = env.reset(seed=3)[0]
    for _ in range(5):
        action = controller.act(observation)
        assert np.array_equal(action, again.act(observation))
        observation = env.step(action)[0]


@pytest.mark.slow
def test_a_design_on_the_diagnosed_model_halves_the_cost_of_flying_the_machine():
    machine = model_comparison.default_machine(LAMA)
    flight = coax_env.simulate(machine, ("lon_3211", "forward_run"), seed=0)
    content, _, controllers = model_comparison.compare_models(flight=flight, episodes=5)
    assert content["hidden"] == ["motor_lag", "rotor_drag", "torque_balance"]
    assert {"motor_lag", "rotor_drag"} <= set(content["found"])
    assert content["cost_ratio"]["lqg"] > 2.0
    before, after = (controllers[f"lqg {model}"] for model in model_comparison.MODELS)
    assert np.array_equal(before.nominal[0], after.nominal[0])  # no trim is given away
    json.dumps(content, allow_nan=False)


# --- policies as plain arrays --------------------------------------------------------------------


@pytest.mark.slow
def test_the_shipped_policy_hovers_without_torch():
    code = """
import sys
from controllers.evaluation import evaluate
from controllers.loading import make_controller
score = evaluate(make_controller("ppo"), "lama400d", episodes=20, seconds=10.0)
assert not {"torch", "stable_baselines3"} & set(sys.modules)
print(score["success_rate"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "1.0\n"), done.stderr


def test_the_shipped_policy_holds_plain_members_and_its_command():
    with zipfile.ZipFile(policy.SHIPPED) as archive:
        assert set(archive.namelist()) == {policy.DESCRIPTION, policy.WEIGHTS}
        content = json.loads(archive.read(policy.DESCRIPTION))
    assert content["command"].startswith("scripts/train_ppo.py")
    assert policy.SHIPPED.stat().st_size < 300_000


def test_a_network_is_the_formula():
    rng = np.random.default_rng(0)
    W, b, V, c = (rng.standard_normal(shape) for shape in ((3, 5), (3,), (4, 3), (4,)))
    x = rng.standard_normal((2, 5))
    expected = np.tanh(x @ W.T + b) @ V.T + c
    assert Network([(W, b), (V, c)])(x) == pytest.approx(expected)


class _Bomb:
    """Something that runs code when it is unpickled."""

    def __reduce__(self):
        return (open, ("bombed", "w"))


@pytest.mark.parametrize("where", ["weights", "description", "data", "policy.pth", "npz"])
def test_a_strangers_policy_runs_no_code(where, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bomb = pickle.dumps(_Bomb())
    with zipfile.ZipFile(policy.SHIPPED) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    if where == "weights":
        members[policy.WEIGHTS] = bomb
    elif where == "description":
        members[policy.DESCRIPTION] = bomb
    elif where == "npz":
        buffer = io.BytesIO()
        arrays = {"weight_0": np.array([_Bomb()], dtype=object), "bias_0": np.zeros(4)}
        np.savez(buffer, **arrays)
        members[policy.WEIGHTS] = buffer.getvalue()
    else:
        members[where] = bomb
    with zipfile.ZipFile("policy.zip", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    if where in ("weights", "description", "npz"):
        with pytest.raises(InputError, match="not a policy"):
            load_controller("policy.zip")
    else:
        assert load_controller("policy.zip").kind == "ppo"
    assert not (tmp_path / "bombed").exists()


@pytest.mark.parametrize("change", ["shape", "activation", "scales", "version", "huge"])
def test_a_policy_that_does_not_fit_gets_one_line(change, tmp_path):
    known = policy.load_policy(policy.SHIPPED)
    layers, sizes, content = list(known.suites.network.layers), dict(known.content["features"]), {}
    sights = list(known.suites.sights.values())
    if change == "shape":
        layers[0] = (layers[0][0][:, :-1], layers[0][1])
    network = Network(layers, "exec" if change == "activation" else "tanh")
    if change == "scales":
        sizes.popitem()
    if change == "huge":
        content["note"] = "x" * (17 * 2**20)
    path = policy.save_policy(tmp_path / "p.zip", network, sights, sizes, content)
    if change == "version":
        path.write_bytes(_with_version(path, 7))
    with pytest.raises(InputError) as error:
        load_controller(path)
    assert "\n" not in str(error.value)


def _with_version(path, version):
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    content = json.loads(members[policy.DESCRIPTION]) | {"version": version}
    members[policy.DESCRIPTION] = json.dumps(content).encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, text in members.items():
            archive.writestr(name, text)
    return buffer.getvalue()


# --- PPO ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_ppo_hands_each_env_its_own_end(tmp_path):
    pytest.importorskip("stable_baselines3")
    from controllers.task_vec_env import TaskVecEnv

    design = design_estimator(LAMA)
    env = TaskVecEnv(LAMA, design, 3, episode_s=0.3)
    env.seed(4)
    env.reset()
    ends = 0
    for k in range(1, 61):
        features, rewards, done, infos = env.step(np.zeros((3, 4), np.float32))
        assert features.dtype == np.float32 and np.isfinite(features).all()
        assert (rewards > 0.0).all()
        for i in np.flatnonzero(done):
            ends += 1
            assert k % 30 == 0 and infos[i]["TimeLimit.truncated"]
            assert infos[i]["episode"]["l"] == 30
            assert not np.array_equal(infos[i]["terminal_observation"], features[i])
    assert ends == 6
    lasts = [info["terminal_observation"] for info in infos]
    assert not np.array_equal(lasts[0], lasts[1])


@pytest.mark.slow
def test_ppo_trains_saves_resumes_and_is_judged(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    from controllers import ppo

    monkeypatch.setitem(ppo.SETTINGS, "n_envs", 16)
    monkeypatch.setitem(ppo.SETTINGS, "batch_size", 256)
    seen = []
    path = ppo.train(LAMA, tmp_path, steps=4096, seed=1, progress=lambda n, _: seen.append(n))
    again = ppo.train(LAMA, tmp_path / "more", steps=1024, resume=path)
    assert seen == [2048, 4096]
    score = evaluate(load_controller(again), LAMA, episodes=2, seconds=4.0)
    assert set(score) >= CONTRACT_KEYS and score["controller"] == "ppo"
    one = load_controller(path)
    env = gymnasium.make("CoaxHeli-v0")
    assert one.act(env.reset(seed=0)[0]).shape == (4,)


@pytest.mark.slow
def test_a_held_action_earns_the_sum_of_its_periods_and_ends_in_its_own_flight():
    pytest.importorskip("stable_baselines3")
    from controllers.task_vec_env import TaskVecEnv

    design = design_estimator(LAMA)
    held, each = (TaskVecEnv(LAMA, design, 2, episode_s=0.1, hold=k) for k in (4, 1))
    for env in (held, each):
        env.seed(3)
        env.reset()
    action = np.array([[0.1, 0.1, 0.05, 0.0], [0.0, 0.0, 0.0, 0.1]], np.float32)
    for flown in (4, 4, 2):  # a flight of ten periods ends within the third action
        _, rewards, done, infos = held.step(action)
        singles = [each.step(action) for _ in range(flown)]
        assert rewards == pytest.approx(np.sum([r for _, r, *_ in singles], axis=0), rel=1e-5)
        assert done.all() == (flown == 2)
    for i in range(2):
        assert infos[i]["episode"]["l"] == 10
        last = singles[-1][3][i]["terminal_observation"]
        assert infos[i]["terminal_observation"] == pytest.approx(last, abs=1e-5)


@pytest.mark.slow
def test_the_plain_arrays_are_stable_baselines_policy(tmp_path, monkeypatch):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from controllers import ppo

    monkeypatch.setitem(ppo.SETTINGS, "n_envs", 16)
    path = ppo.train(LAMA, tmp_path, steps=2048)
    model = stable_baselines3.PPO.load(path, device="cpu")
    features = np.random.default_rng(0).normal(size=(7, 33)).astype(np.float32)
    expected = model.policy.predict(features, deterministic=True)[0]
    found = np.clip(policy.load_policy(path).network(features), -1.0, 1.0)
    assert found == pytest.approx(expected, abs=1e-5)
    with pytest.raises(InputError, match="plain arrays only"):
        ppo.train(LAMA, tmp_path / "more", steps=512, resume=policy.SHIPPED)


@pytest.mark.slow
def test_ppo_keeps_what_it_learnt_on_ctrl_c(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    from controllers import ppo

    monkeypatch.setitem(ppo.SETTINGS, "n_envs", 16)

    def interrupt(steps, _):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ppo.train(LAMA, tmp_path, steps=10_000, progress=interrupt)
    assert load_controller(tmp_path / "policy.zip").kind == "ppo"


def test_a_policy_that_is_none_gets_one_line(tmp_path):
    path = tmp_path / "policy.zip"
    path.write_bytes(b"PK")
    with pytest.raises(InputError, match="not a policy"):
        load_controller(path)


# --- many machines --------------------------------------------------------------------------------


def test_a_machine_is_its_seeds_and_hides_two_to_four_effects():
    from controllers import machines

    drawn = [machines.draw_machine(LAMA, seed) for seed in range(40)]
    counts = {len(one.effects) for one in drawn}
    assert counts == {2, 3, 4}
    assert drawn[7].values() == machines.draw_machine(LAMA, 7).values()
    assert len({one for m in drawn for one in m.effects}) > 15


def test_ratios_and_their_intervals_are_those_of_paired_flights():
    from controllers import machines

    costs = np.random.default_rng(0).uniform(1.0, 3.0, 50)
    scores = {
        "bare": {"flight_costs": costs.tolist()},
        "corrected": {"flight_costs": (costs / 2).tolist()},
    }
    assert machines.cost_ratio(scores) == pytest.approx((0.5, 0.5, 0.5))
    noisy = costs * np.random.default_rng(1).uniform(0.3, 0.7, 50)
    scores["corrected"]["flight_costs"] = noisy.tolist()
    ratio, low, high = machines.cost_ratio(scores)
    assert low < ratio < high and low > 0.4 and high < 0.6
    dear = {
        "seed": 3,
        "scores": {"lqg": {"bare": scores["corrected"], "corrected": scores["bare"]}},
    }
    cheap = {"seed": 4, "scores": {"lqg": scores}}
    found = machines.summary([dear, cheap, cheap])["lqg"]
    assert (found["machines"], found["dearer"], found["worst_seed"]) == (3, 1, 3)
    assert found["median_ratio"] == pytest.approx(ratio)


def test_a_correction_is_judged_by_what_the_truth_removes():
    from controllers import removable

    noise = np.random.default_rng(0).uniform(0.3, 0.4, 40)

    def scored(model, lost):
        return {
            "bare": {"flight_costs": (noise + 0.2).tolist()},
            model: {"flight_costs": (noise + lost).tolist()},
        }

    truth, found = scored("corrected", 0.0), scored("corrected", 0.05)
    floor = noise.mean() / (noise.mean() + 0.2)
    assert removable.floor_share(truth) == pytest.approx(floor)
    assert removable.share_removed(found, truth) == pytest.approx(0.75)
    assert removable.share_removed(truth, truth) == pytest.approx(1.0)
    shaken = {"corrected": {"flight_costs": (noise[::-1] + 0.2).tolist()}, "bare": truth["bare"]}
    assert removable.shows(truth) and not removable.shows(shaken)
    results, truths = (
        [{"seed": seed, "scores": {"lqg": one}} for seed in (4, 5)] for one in (found, truth)
    )
    assert "removes 75 % in the median of the 2 machines" in removable.in_words(results, truths)[0]
    assert removable.in_words([], truths) == [
        f"LQG: with the truth {floor:.2f} of the bare cost stays in the median"
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("one_by_one")
def test_policies_of_both_models_begin_alike_and_each_is_the_best_on_its_own(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    from controllers import machines, trainings

    few = partial(trainings.train_best, flights=20)
    monkeypatch.setattr(trainings, "train_best", few)
    for module in (machines, trainings):
        monkeypatch.setattr(module, "evaluate", partial(evaluate, seconds=5.0))
    found = machines.fly_machine(16, LAMA, tmp_path, 2, ppo_steps=2048, truth=True)
    assert set(found["scores"]["ppo"]) == {"bare", "corrected"}
    policies = tmp_path / "policies"
    first = (policies / "first" / "policy.zip").read_bytes()
    assert sorted(one.name for one in (policies / "first").glob("seed_*")) == [
        "seed_0", "seed_1", "seed_2",
    ]  # fmt: skip
    for side in ("bare", "corrected_16"):
        assert (policies / side / "start" / "policy.zip").read_bytes() == first
        scores = {
            path.parent.name: json.loads(path.read_text())
            for path in (policies / side).glob("*/score.json")
        }
        best = min(scores, key=lambda name: trainings.rank(scores[name]))
        kept = (policies / side / "policy.zip").read_bytes()
        assert kept == (policies / side / best / "policy.zip").read_bytes()
    made = {path: path.stat().st_mtime_ns for path in policies.rglob("score.json")}
    (tmp_path / "truth" / "000016.json").unlink()
    assert machines.fly_machine(16, LAMA, tmp_path, 2, ppo_steps=2048, truth=True) == found
    assert made == {path: path.stat().st_mtime_ns for path in policies.rglob("score.json")}


@pytest.mark.slow
def test_machines_are_flown_once(tmp_path):
    from controllers import machines

    short = {"episodes": 2, "truth": True, "seconds": 5.0}
    first = list(machines.fly_machines([2], LAMA, tmp_path, **short))
    said: list[str] = []
    again = list(machines.fly_machines([2], LAMA, tmp_path, progress=said.append, **short))
    assert again == first and not said
    assert (
        machines.rows(first)[0][0] == "2"
        and "LQG, 1 machines" in machines.in_words(machines.summary(first))[0]
    )
    assert "machine 2" in machines.machines_page(first)
    with pytest.raises(InputError, match="another world"):
        list(machines.fly_machines([2], LAMA, tmp_path, wind=2.0, **short))


@pytest.mark.slow
def test_a_machine_whose_flight_is_refused_flies_the_bare_model_on_both_sides(
    tmp_path, monkeypatch
):
    from controllers import machines

    def refuse(flight, bare):
        raise InputError("the log contradicts itself")

    monkeypatch.setattr(machines, "diagnose", refuse)
    found = machines.fly_machine(2, LAMA, tmp_path, 2, seconds=5.0)
    assert found["named"] == [] and "contradicts itself" in found["verdict"]
    assert found["scores"]["lqg"]["bare"] == found["scores"]["lqg"]["corrected"]


@pytest.mark.slow
def test_machines_fly_to_a_position_in_wind(tmp_path):
    """The same machine costs more there than hovering in still air, and the page says where it flew."""
    from controllers import machines

    out = {}
    for name, world in (("still", {}), ("windy", {"task": "position", "wind": 4.0})):
        flown = machines.fly_machines(
            [2], "lama400d_outdoor", tmp_path / name, 2, truth=True, **world, seconds=6.0
        )
        out[name] = list(flown)
    costs = {
        name: found[0]["scores"]["lqg"]["corrected"]["mean_cost"] for name, found in out.items()
    }
    assert costs["windy"] > costs["still"]
    assert "position, wind 4.0" in machines.machines_page(out["windy"])


@pytest.mark.slow
@pytest.mark.parametrize(("task", "sensors"), [("hover", "onboard"), ("position", "mocap")])
def test_the_outdoor_policy_flies_in_wind_on_two_suites(task, sensors):
    controller = make_controller("ppo_outdoor", sensors=sensors)
    arguments = {"task": task, "wind": 3.0, "turbulence": "light", "randomize": "posterior"}
    score = evaluate(controller, "lama400d_outdoor", 8, 10.0, **arguments)
    assert score["survival_rate"] == 1.0 and score["success_but_drift_rate"] > 0.8


def test_a_policy_flies_only_what_it_was_trained_on():
    with pytest.raises(InputError, match="onboard, mocap"):
        make_controller("ppo_outdoor", sensors="paper")


@pytest.mark.slow
def test_several_batches_are_flown_as_each_alone():
    pytest.importorskip("stable_baselines3")
    from controllers.policy import feature_sizes
    from controllers.task_vec_env import SeveralVecEnvs, TaskVecEnv

    designs = [design_estimator(LAMA, sensors=s) for s in ("onboard", "mocap")]
    sizes = policy.all_features(designs)

    def part(design):
        task = "hover" if design.sensors == "onboard" else "waypoints"
        return TaskVecEnv(LAMA, design, 2, 0.2, hold=4, sizes=sizes, task=task)

    parts, both = [part(d) for d in designs], SeveralVecEnvs([part(d) for d in designs])
    both.seed(3)
    for k, alone in enumerate(parts):
        alone.seed(3 + 2 * k)
    seen, each = both.reset(), np.concatenate([alone.reset() for alone in parts])
    assert np.array_equal(seen, each)
    lacking = [list(sizes).index(n) for n in sizes if n not in feature_sizes(designs[0])]
    assert lacking and not seen[:2, lacking].any()
    for action in np.random.default_rng(0).uniform(-0.1, 0.1, (7, 4, 4)):
        seen, rewards, done, infos = both.step(action)
        found = [alone.step(action[2 * k : 2 * k + 2]) for k, alone in enumerate(parts)]
        assert np.array_equal(seen, np.concatenate([one[0] for one in found]))
        assert np.array_equal(rewards, np.concatenate([one[1] for one in found]))
        assert np.array_equal(done, np.concatenate([one[2] for one in found]))
        assert len(infos) == 4
