"""Controllers of a user's own: functions, classes, Stable-Baselines3 models, python-control systems."""

import control
import gymnasium
import numpy as np
import pytest

import coax_env
from coax_env.errors import InputError
from controllers import state_feedback
from controllers.evaluation import evaluate
from controllers.loading import make_controller
from controllers.own_controller import as_controller

LAMA = "lama400d"
SHORT = dict(episodes=3, seconds=4.0)


@pytest.fixture(scope="module")
def design() -> state_feedback.StateFeedback:
    return state_feedback.design(LAMA, integral=False)


def as_system(design: state_feedback.StateFeedback) -> control.StateSpace:
    """The same feedback as deviations in SI, as python-control has it."""
    return control.ss(
        [], [], [], -design.gain * design.action_scale[:, None],
        inputs=list(state_feedback.NAMES), outputs=["omega_u", "omega_l", "delta_lon", "delta_lat"],
    )  # fmt: skip


def test_a_system_flies_as_the_feedback_that_it_is_made_of(design):
    ours = evaluate(design, LAMA, **SHORT)
    system = evaluate(as_system(design), LAMA, sensors="state", **SHORT)
    # the feedback turns x and y into the heading's axes, the plain matrix does not: 0.1 % of the cost
    assert system["mean_cost"] == pytest.approx(ours["mean_cost"], rel=0.02)
    assert system["success_rate"] == ours["success_rate"] == 1.0


def test_signals_are_found_by_name(design):
    """The same system with inputs and outputs in another order gives the same flight."""
    system = as_system(design)
    order, commands = np.arange(len(state_feedback.NAMES))[::-1], [2, 0, 3, 1]
    turned = control.ss(
        [], [], [], system.D[np.ix_(commands, order)],
        inputs=[system.input_labels[k] for k in order],
        outputs=[system.output_labels[k] for k in commands],
    )  # fmt: skip
    scores = [evaluate(s, LAMA, sensors="state", **SHORT)["mean_cost"] for s in (system, turned)]
    assert scores[0] == pytest.approx(scores[1], rel=1e-9)


def test_a_continuous_system_is_sampled_at_the_envs_rate():
    """A lag of 0.1 s answers a step with 1 - exp(-t / 0.1)."""
    lag = control.tf([1.0], [0.1, 1.0])
    system = control.append(*[control.ss(lag)] * 4)
    system.set_inputs(["p", "q", "r", "phi"])
    controller = as_controller(system, LAMA)
    controller.reset(1)
    seen = np.zeros(18)
    start = controller.act(seen) * controller.action_scale
    seen[2:5] = 0.01, 0.01, 0.01
    for _ in range(21):  # 20 periods after the one that sees half of the step
        found = controller.act(seen) * controller.action_scale
    assert found[0] - start[0] == pytest.approx(0.01 * (1 - np.exp(-0.205 / 0.1)), rel=0.01)


class WithMemory:
    """Counts what it has seen since it was reset, so that a memory that is shared shows."""

    def reset(self) -> None:
        self.seen = 0

    def act(self, observation: np.ndarray) -> np.ndarray:
        self.seen += 1
        return np.full(4, self.seen / 100)


@pytest.mark.parametrize("source", [WithMemory, WithMemory()])
def test_every_helicopter_has_a_memory_of_its_own(source):
    controller = as_controller(source)
    controller.reset(3)
    controller.act(np.zeros((3, 18)))
    assert controller.act(np.zeros((3, 18))) == pytest.approx(np.full((3, 4), 0.02))
    controller.reset(3)
    assert controller.act(np.zeros((3, 18))) == pytest.approx(np.full((3, 4), 0.01))


def test_a_function_is_scored_as_the_controller_that_it_calls(design):
    one = evaluate(lambda seen: np.zeros(4), LAMA, **SHORT)
    assert one["controller"] == "<lambda>" and one["success_rate"] == 0.0
    pid = make_controller("pid", LAMA)
    assert evaluate(pid, LAMA, **SHORT)["controller"] == "pid"


@pytest.mark.slow  # imports torch
def test_a_model_of_stable_baselines_from_its_zip(tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    env = gymnasium.make("CoaxHeli-v0")
    for algorithm in (sb3.PPO, sb3.A2C, sb3.SAC):
        model = algorithm("MlpPolicy", env, seed=0, device="cpu")
        path = tmp_path / f"{algorithm.__name__}.zip"
        model.save(path)
        controller = make_controller(str(path), LAMA)
        controller.reset(2)
        seen, _ = env.reset(seed=1)
        both = controller.act(np.stack([seen, seen]))
        assert both[0] == pytest.approx(model.predict(seen, deterministic=True)[0], abs=1e-6)
        assert controller.kind == algorithm.__name__


def test_from_a_file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "import numpy as np\nclass Still:\n    sensors = 'mocap'\n"
        "    def act(self, seen):\n        assert seen.shape == (20,)\n        return np.zeros(4)\n"
    )
    controller = make_controller(f"{path}:Still", LAMA)
    assert evaluate(controller, LAMA, **SHORT)["sensors"] == "mocap"


@pytest.mark.parametrize(
    "source, message",
    [
        (7, "not int"),
        (control.ss([], [], [], np.ones((4, 1)), inputs=["pp"]), "'pp' is none of rpm_upper"),
        (control.ss([], [], [], np.ones((2, 1)), inputs=["p"]), "needs the outputs omega_u"),
        (control.ss(-1, [[1.0]], np.ones((4, 1)), np.zeros((4, 1)), 0.02), "period is 0.02 s"),
        (lambda seen: np.zeros(3), "gives an action of shape"),
    ],
)
def test_what_is_no_controller(source, message):
    with pytest.raises(InputError, match=message):
        evaluate(source, LAMA, **SHORT)


@pytest.mark.parametrize(
    "source, message",
    [
        ("nowhere.py:Mine", "no Python file"),
        ("{folder}/bad.py:Mine", "ZeroDivisionError while it was run"),
        ("{folder}/empty.py:Mine", "has no 'Mine'"),
        ("nowhere", "neither a file, nor my.py:NAME"),
    ],
)
def test_what_is_no_file_of_one(tmp_path, source, message):
    (tmp_path / "bad.py").write_text("1 / 0")
    (tmp_path / "empty.py").write_text("")
    with pytest.raises(InputError, match=message):
        make_controller(source.format(folder=tmp_path), LAMA)


def test_the_names_of_linearize_are_those_of_the_env():
    system = coax_env.linearize(LAMA, full=True)
    env = gymnasium.make("CoaxHeli-v0", sensors="state").unwrapped
    assert set(system.state_labels) <= set(env.observation_names)
