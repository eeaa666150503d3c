"""Paths in time: their mathematics, the task in the env and in the batch, and who follows them."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import coax_env
from coax_env.env import hover, paths, tasks
from coax_env.env.period import DT
from coax_env.errors import InputError
from controllers import lqr, pid
from controllers.evaluation import evaluate

LAMA = coax_env.load_vehicle("lama400d")
X, Y, Z, PSI = range(4)
BETWEEN = ("gust_Y", "gust_Z", "gust_L", "gust_M")  # what "gust_X .. gust_N" stands for
TABLE = "t,north,east,height\n0,0,0,1.5\n2,1,0,2\n4,1,1,1.5\n"


def batch(count, **arguments):
    return gymnasium.make_vec(
        "CoaxHeli-v0", num_envs=count, vectorization_mode="vector_entry_point", sensors="mocap",
        task="trajectory", **{"max_episode_steps": None, **arguments},
    )  # fmt: skip


@pytest.mark.parametrize("shape", paths.SHAPES)
def test_velocity_and_acceleration_are_the_places_derivatives(shape):
    path, again = paths.path({"shape": shape, "size": 1.3, "period": 9.0})
    round_again = np.vstack([path, path[again : again + 3]])
    place, velocity, acceleration = round_again[:, :3], round_again[:, 4:7], round_again[:, 8:]
    slopes = (place[2:] - place[:-2]) / (2.0 * DT)
    assert np.abs(slopes - velocity[1:-1]).max() < 1e-4  # over the seam too
    slopes = (velocity[2:] - velocity[:-2]) / (2.0 * DT)
    assert np.abs(slopes - acceleration[1:-1]).max() < 2e-3
    assert np.abs(path[0, [0, 1, 4, 5]]).max() < 1e-9 and path[0, Z] == -hover.HEIGHT
    assert np.abs(path[:, :2]).max() <= 2.0 * 1.3 + 1e-9


def test_a_circle_has_its_radius_and_its_period():
    path, again = paths.path({"shape": "circle", "size": 0.8, "period": 7.0})
    assert np.hypot(path[:, X], path[:, Y] - 0.8) == pytest.approx(np.full(len(path), 0.8))
    assert len(path) - again == 700
    speed = np.hypot(path[again:, 4], path[again:, 5])
    assert speed == pytest.approx(np.full(700, 2.0 * np.pi * 0.8 / 7.0), rel=1e-5)


def test_lemniscates_are_the_curves_of_their_names():
    x, y = paths.path("lemniscate")[0][:, :2].T
    assert (x**2 + y**2) ** 2 == pytest.approx(x**2 - y**2, abs=1e-9), "Bernoulli's"
    x, y = paths.path("figure_eight")[0][:, :2].T
    assert x**4 == pytest.approx(x**2 - y**2, abs=1e-9), "Gerono's"


def test_a_table_is_gone_through_and_its_end_is_held(tmp_path):
    (tmp_path / "p.csv").write_text(TABLE)
    path, again = paths.path(str(tmp_path / "p.csv"))
    assert path[[0, 200, 400], :3] == pytest.approx(
        np.array([[0.0, 0.0, -1.5], [1.0, 0.0, -2.0], [1.0, 1.0, -1.5]])
    )
    assert not path[[0, -1], 4:8].any() and again == len(path) - 1 == 400
    rows = [[0, 0, 0, 1.5, 0], [2, 1, 0, 2, 0], [4, 1, 1, 1.5, 0]]
    assert np.array_equal(paths.path(rows)[0], path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TABLE.replace("height", "up"), "line 1"),
        (TABLE.replace("2,1,0,2", "2,1,0"), "line 3"),
        (TABLE.replace("2,1,0,2", "2,one,0,2"), "line 3"),
        (TABLE.replace("2,1,0,2", "5,1,0,2"), "t must rise"),
        (TABLE.replace("2,1,0,2", "2,nan,0,2"), "finite"),
        (TABLE.replace("2,1,0,2", "2,1,0,9"), "6 m high"),
        ("", "line 1"),
    ],
)
def test_a_table_that_is_none_gets_one_line(text, words, tmp_path):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(InputError, match=words) as error:
        paths.path(str(tmp_path / "p.csv"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "target", ["square", 3, {"shape": "circle", "radius": 1}, {"size": -1}, {"period": "x"}]
)
def test_no_such_path(target):
    with pytest.raises(InputError):
        paths.path(target)


def test_check_env_passes():
    env = gymnasium.make("CoaxHeli-v0", task="trajectory", sensors="mocap", target="figure_eight")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.unwrapped.observation_names[-11:] == tuple(n for n, *_ in tasks.WAY + tasks.MOTION)


def test_the_target_is_where_the_path_is_in_every_flight():
    """In a batch whose rows start anew at their own times, and in a single env."""
    path, again = paths.path("circle")
    env = batch(3, max_episode_steps=40)
    env.reset(seed=0)
    env.step(np.tile([-1.0, -1.0, 0.0, 0.0], (3, 1)))
    single = gymnasium.make("CoaxHeli-v0", task="trajectory", sensors="mocap").unwrapped
    _, first = single.reset(seed=0)
    assert np.array_equal(first["target"], path[0, :4])
    for k in range(1, 90):
        _, _, _, _, info = env.step(np.zeros((3, 4)))
        rows = env.unwrapped.fleet.rows
        assert np.array_equal(info["target"], path[rows, :4])
        assert np.array_equal(info["target_rates"], path[rows, 4:8])
        _, _, _, _, alone = single.step(np.zeros(4))
        assert np.array_equal(alone["target"], path[k, :4])
    assert again > 90


def test_the_way_and_the_motion_are_observed_in_the_headings_axes():
    env = gymnasium.make("CoaxHeli-v0", task="trajectory", sensors="state").unwrapped
    observation, info = env.reset(seed=3)
    for _ in range(150):
        observation, _, _, _, info = env.step(np.zeros(4))
    x, goal, rates = info["state"], info["target"], info["target_rates"]
    psi = x[12]
    turn = np.array([[np.cos(psi), np.sin(psi)], [-np.sin(psi), np.cos(psi)]])
    way, motion = observation[-11:-7], observation[-7:]
    assert way[:2] == pytest.approx(turn @ (goal[:2] - x[13:15]), abs=1e-5)
    assert motion[:2] == pytest.approx(turn @ rates[:2], abs=1e-5)
    assert motion[2] == pytest.approx(-rates[2]) and motion[3] == rates[3]
    acceleration = paths.path("circle")[0][env.fleet.rows[0], 8:10]
    assert motion[4:6] == pytest.approx(turn @ acceleration, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("design", "most"), [(lqr.design, 0.05), (pid.design, 0.7)])
def test_a_circle_is_followed(design, most):
    more = {"limits": lqr.BRISK} if design is lqr.design else {}
    controller = design(LAMA, sensors="mocap", **more)
    score = evaluate(controller, LAMA, 4, 12.0, task="trajectory", target="circle")
    assert score["survival_rate"] == 1.0
    assert score["distance_rms_m"] < most


def test_one_who_flies_along_is_at_rest_relative_to_the_path():
    """Squared errors of a state that moves as the target does are none, at any attitude."""
    rng = np.random.default_rng(0)
    states, targets, rates = (
        np.zeros((5, 29)),
        rng.uniform(-1, 1, (5, 4)),
        rng.uniform(-1, 1, (5, 4)),
    )
    states[:, 13:16], states[:, 12] = targets[:, :3], targets[:, 3]
    states[:, 10:12] = rng.uniform(-0.5, 0.5, (5, 2))
    from coax_env.env.scene import body_to_world

    for k in range(5):
        states[k, :3] = body_to_world(states[k, 10:13]).T @ rates[k, :3]
    errors = hover.squared_errors(states, targets, rates)
    assert max(errors[name].max() for name in ("height", "position", "speed", "heading")) < 1e-20
    flight, goal = states[:1].repeat(500, 0), targets[:1].repeat(500, 0)
    assert tasks.succeeded("trajectory", flight, goal, 500, rates=rates[:1].repeat(500, 0))
    assert not tasks.succeeded("trajectory", flight, goal, 500)


def test_the_env_says_what_everything_means():
    """The docstring's weights are the tasks', its states in order, every entry explained."""
    from coax_env.env.gym_env import CoaxEnv
    from coax_env.model.layout import FULL_STATES
    from coax_env.model.sensors import SUITES

    text = CoaxEnv.__doc__
    for term in ("alive", *tasks.TASKS["hover"].scales):
        row = next(line for line in text.splitlines() if line.strip().startswith(f"| {term} | 0"))
        found = [float(cell.split()[0]) for cell in row.split("|")[2:-1]]
        assert found == [task.weights[term] for task in tasks.TASKS.values()], term
    layout = text[text.index("| state |") : text.index("## Version History")]
    cells = [line.split("|")[2].split(":")[0] for line in layout.splitlines() if ": " in line]
    named = [word for cell in cells for word in cell.replace(",", " ").replace("..", " ").split()]
    assert named == [name for name, _ in FULL_STATES if name not in BETWEEN]
    meanings = text[text.index("| entry | meaning |") : text.index("An instrument slower")]
    names = {s.name for suite in ("onboard", "paper", "mocap") for s in SUITES[suite]}
    words = set(meanings.replace(",", " ").split())
    assert not (names | {name for name, *_ in tasks.WAY}) - words
