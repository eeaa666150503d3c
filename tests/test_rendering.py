"""Pictures of CoaxHeli-v0, without a screen."""

import importlib.util
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import coax_env
from coax_env.env import scene
from coax_env.env.gym_env import CoaxEnv
from coax_env.env.vector_env import CoaxVectorEnv
from coax_env.errors import InputError

pygame = pytest.importorskip("pygame")
rendering = pytest.importorskip("coax_env.env.rendering")

LAMA = coax_env.load_vehicle("lama400d")
TRIM = coax_env.hover_trim(LAMA)[0]


@pytest.fixture(autouse=True)
def no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def picture(**state: float) -> np.ndarray:
    names = [name for name, _ in coax_env.model.layout.STATES]
    start = np.array(TRIM)
    for name, value in state.items():
        start[names.index(name)] = value
    env = CoaxEnv(render_mode="rgb_array", task="position", sensors="state", target=(1, 1, 1.5, 0))
    env.reset(seed=0, options={"state": start})
    return env.render()


def changed(one: np.ndarray, other: np.ndarray, box: tuple[int, int, int, int]) -> float:
    """Share of the pixels of a box (x, y, width, height) in which two pictures differ."""
    x, y, width, height = box
    part = (one != other).any(axis=2)[y : y + height, x : x + width]
    return float(part.mean())


@pytest.mark.parametrize("mode", ["rgb_array", "human"])
def test_gymnasium_checks_the_pictures_without_a_warning(mode):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make("CoaxHeli-v0", render_mode=mode).unwrapped)


@pytest.mark.slow
def test_a_picture_has_its_shape_and_is_reproducible():
    one, other = picture(), picture()
    assert one.shape == (rendering.HEIGHT, rendering.WIDTH, 3) and one.dtype == np.uint8
    assert np.array_equal(one, other)
    assert len(np.unique(one.reshape(-1, 3), axis=0)) > 100


def test_each_disc_is_drawn_with_its_own_tilt():
    still = picture()
    lower, upper = picture(alpha_l=0.1), picture(alpha_f=0.1)
    x, y, width, _ = rendering._DISCS
    above, below = (x, y + 20, width, 38), (x, y + 60, width, 28)
    assert changed(still, lower, below) > 0.01 > changed(still, lower, above)
    assert changed(still, upper, above) > 0.01 > changed(still, upper, below)
    machine = (200, 170, 220, 130)
    assert changed(still, lower, machine) > 0.005 and changed(still, upper, machine) > 0.005


def test_a_disc_tilts_as_its_thrust():
    # (13)-(14): thrust along [-tan a, tan b, -1]; every point of the disc is square to it
    disc = scene.Disc(0.1, -0.2, True, (0, 0, 0))
    thrust = np.array([-np.tan(0.1), np.tan(-0.2), -1.0])
    assert np.allclose(disc.rim() @ thrust, 0.0, atol=1e-12)
    assert np.allclose(np.linalg.norm(disc.rim(), axis=1), 1.0)
    front = disc.rim()[np.argmax(disc.rim()[:, 0])]
    assert front[2] < 0.0  # tilted back: the front edge is up


def test_the_map_shows_where_the_machine_is_and_looks():
    still = picture()
    assert changed(still, picture(x=0.5), rendering._MAP) > 0.001
    assert changed(still, picture(psi=1.0), rendering._MAP) > 0.001
    assert changed(still, picture(p=0.1), rendering._MAP) == 0.0


def test_the_trace_grows_with_the_flight_and_is_forgotten_with_it():
    env = CoaxVectorEnv(2, render_mode="rgb_array", max_episode_steps=30)
    env.reset(seed=0)
    lengths = []
    for _ in range(40):
        env.step(np.zeros((2, 4)))
        lengths.append(len(env._screen._traces.view(1).trace))
    assert lengths[24] == 7 and lengths[4] == 3 and max(lengths) == 8
    assert lengths[30] <= 2  # the row has started anew


def test_the_view_is_of_the_state_the_wind_and_the_target():
    vehicle = LAMA.with_effect("airframe_drag", area_x=0.01)  # so that the wind acts
    env = CoaxEnv(vehicle, render_mode="rgb_array", wind=(1.0, 2.0))
    _, info = env.reset(seed=3)
    view = env._screen._traces.view(0)
    assert np.array_equal(view.state, info["state"]) and np.allclose(view.air, [1.0, 2.0, 0.0])
    assert np.allclose(view.target, [0.0, 0.0, -1.5, 0.0]) and view.task == "hover"


def test_a_state_that_is_not_a_number_can_be_drawn():
    env = CoaxEnv(render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.full(4, np.nan))
    assert env.render().shape == (rendering.HEIGHT, rendering.WIDTH, 3)


def test_without_a_mode_nothing_is_drawn_and_without_a_screen_it_is_said(monkeypatch):
    env = CoaxEnv()
    env.reset(seed=0)
    assert env.render() is None and env._screen._renderer is None
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "no such driver")
    with pytest.raises(InputError, match="'human' needs a screen"):
        CoaxEnv(render_mode="human").reset(seed=0)


def test_the_vector_env_draws_every_row():
    env = gymnasium.make_vec(
        "CoaxHeli-v0", num_envs=2, vectorization_mode="vector_entry_point", render_mode="rgb_array"
    )
    env.reset(seed=0)
    pictures = env.render()
    assert len(pictures) == 2 and not np.array_equal(*pictures)
    env.close()


@pytest.mark.skipif(importlib.util.find_spec("moviepy") is None, reason="moviepy is not installed")
@pytest.mark.slow
def test_record_video_writes_a_film(tmp_path):
    env = gymnasium.wrappers.RecordVideo(
        gymnasium.make("CoaxHeli-v0", render_mode="rgb_array"),
        str(tmp_path / "film"),
        video_length=10,
    )
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.zeros(4))
    env.close()
    assert list((tmp_path / "film").glob("*.mp4"))


def test_there_is_a_picture_per_step():
    env = gymnasium.wrappers.RenderCollection(
        gymnasium.make("CoaxHeli-v0", render_mode="rgb_array"), pop_frames=False
    )
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros(4))
    frames = env.render()
    assert len(frames) == 5 and not np.array_equal(frames[0], frames[-1])
    assert env.metadata["render_fps"] == 100  # one picture per control period
    env.close()
    assert gymnasium.make("CoaxHeli-v0", control_rate=25).metadata["render_fps"] == 25
