"""Controllers: closed-form cost, filter statistics, hover on noisy sensors, files, scores."""

import json
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import coax_env
from coax_env import hover
from coax_env.dynamics import WORK_SIZE, kernel_input, step
from coax_env.errors import InputError
from coax_env.fleet import DT
from coax_env.linear import sampled
from controllers import load_controller, lqr
from controllers.estimator import Tracker, design_estimator, integrated_readings
from controllers.evaluation import evaluate

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
    assert design.states[:20] == tuple(n for n, _ in coax_env.layout.FULL_STATES[:20])
    *_, trim, command = sampled(LAMA, DT)
    _, _, Q, R = lqr.regulator_problem(design)
    places = [design.readings.index(name) for name in integrated_readings(design)]
    rng = np.random.default_rng(0)
    x = trim.copy()
    x[:16] += 1e-4 * rng.standard_normal(16)
    known = np.concatenate([x[: len(design.states)] - trim, np.zeros(len(places))])
    predicted, simulated, work = known @ exact.cost_to_go @ known, 0.0, np.zeros(WORK_SIZE)
    for _ in range(6000):
        known[: len(trim)] = x - trim
        action = -exact.gain @ known
        simulated += known @ Q @ known + action @ R @ action
        known[len(trim) :] += DT * known[places]
        step(x, kernel_input(command + design.action_scale * action), DT, LAMA.vector, work, x)
    assert simulated == pytest.approx(predicted, rel=1e-3)


def test_the_regulators_weights_are_the_cost_every_controller_is_judged_by(exact):
    rng = np.random.default_rng(1)
    _, _, Q, R = lqr.regulator_problem(exact.estimator)
    states, action = np.zeros(26), rng.standard_normal(4)
    states[:16] = rng.standard_normal(16)
    states[10:13] *= 0.1
    deviation = np.zeros(len(Q))
    deviation[:16] = states[:16]
    states[15] -= hover.HEIGHT
    cost = deviation @ Q @ deviation + action @ R @ action
    assert hover.cost(states, action) == pytest.approx(cost)


def test_the_closed_loop_is_stable_and_has_the_margins_it_states(onboard):
    import control

    loop = lqr.loop(onboard)
    margins, disk = lqr.margins(onboard)

    def stable(gains):
        closed = control.feedback(loop * control.ss([], [], [], np.diag(gains), DT), np.eye(4))
        return bool(np.abs(closed.poles()).max() < 1.0)

    for k, one in enumerate(margins):
        for factor in (1.0, 0.95, 1.05):
            gains = np.ones(4)
            gains[k] = one.gain_up * factor if factor != 1.0 else 1.0
            assert stable(gains) is (factor <= 1.0), one.input
    assert min(m.phase_deg for m in margins) > 35.0 and disk > 0.5
    factor = (2.0 - 0.99 * disk) / (2.0 + 0.99 * disk)
    rng = np.random.default_rng(0)
    for _ in range(8):  # any mix of gains inside the disk margin leaves it stable
        assert stable(factor ** rng.choice([-1.0, 1.0], 4))


# --- filter ---------------------------------------------------------------------------------------


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
    names = [n for n, _ in coax_env.layout.FULL_STATES]
    found = truth - trim
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
    width = len(coax_env.sensors.SUITES["onboard"]) + 3
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
    score = evaluate(onboard, LAMA, episodes=20, seconds=20.0)
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


def test_a_design_on_the_mended_model_flies_a_lagging_machine_better(onboard):
    late = LAMA.with_effect("motor_lag", upper=0.1, lower=0.1).with_effect("servo_lag", time=0.04)
    bare = evaluate(onboard, late, episodes=10, seconds=10.0)
    mended = evaluate(lqr.design(late), late, episodes=10, seconds=10.0)
    assert mended["mean_cost"] < 0.5 * bare["mean_cost"]


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
    def call(name, *words):
        return subprocess.run(
            [sys.executable, SCRIPTS / name, *words], capture_output=True, text=True, cwd=tmp_path
        )

    made = call("design_lqr.py", "--out", "design")
    assert made.returncode == 0, made.stderr
    assert "disk margin" in made.stdout
    assert "<html" in (tmp_path / "design" / "report.html").read_text(encoding="utf-8")
    flown = call("evaluate.py", "--controller", "design/controller.json", "--episodes", "5")
    assert flown.returncode == 0, flown.stderr
    score = json.loads((tmp_path / "runs" / "evaluate" / "score.json").read_text())
    assert score["success_rate"] == 1.0
    missing = call("evaluate.py", "--controller", "nothing.json")
    assert (missing.returncode, len(missing.stderr.splitlines())) == (2, 1)
    assert call("evaluate.py", "--episodes", "0", "--out", "none").returncode == 2
    assert not (tmp_path / "none").exists()


# --- PPO ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_ppo_hands_each_env_its_own_end(tmp_path):
    pytest.importorskip("stable_baselines3")
    from controllers.ppo import hover_vec_env

    design = design_estimator(LAMA)
    env = hover_vec_env(LAMA, design, 3, episode_s=0.3)
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
    path = ppo.train(LAMA, tmp_path, steps=2048, seed=1, progress=lambda n, _: seen.append(n))
    again = ppo.train(LAMA, tmp_path / "more", steps=1024, resume=path)
    assert seen == [1024, 2048]
    score = evaluate(load_controller(again), LAMA, episodes=2, seconds=4.0)
    assert set(score) >= CONTRACT_KEYS and score["controller"] == "ppo"
    one = load_controller(path)
    env = gymnasium.make("CoaxHeli-v0")
    assert one.act(env.reset(seed=0)[0]).shape == (4,)


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
