"""Missing, frozen, saturated and lying sensors: the estimate stays a number, and forgets them."""

from collections.abc import Callable
from functools import cache

import gymnasium
import numpy as np
import pytest

from controllers import lqr
from controllers.estimator import Tracker
from controllers.estimator_design import design_estimator

SECONDS, RATE = 8, 100
FAULT = slice(200, 300)
"""Rows in which a sensor is at fault."""


@cache
def flown() -> tuple[np.ndarray, np.ndarray]:
    """Observations and actions of a hover with sound sensors, (n, n_obs) and (n, 4)."""
    env = gymnasium.make("CoaxHeli-v0")
    controller = lqr.design("lama400d")
    controller.reset()
    observation, _ = env.reset(seed=4)
    observations, actions = [], []
    for _ in range(SECONDS * RATE):
        action = controller.act(observation)
        observations.append(observation)
        actions.append(action)
        observation, _, over, _, _ = env.step(action)
        assert not over
    return np.array(observations), np.array(actions)


@cache
def design():
    return design_estimator(load())


def load():
    from coax_env import load_vehicle

    return load_vehicle("lama400d")


def tracked(observations: np.ndarray) -> np.ndarray:
    """Estimates row by row, (n, states + integrals), under the actions that were flown."""
    tracker = Tracker(design())
    rows = []
    for observation, action in zip(observations, flown()[1], strict=True):
        rows.append(tracker.see(observation[None])[0].copy())
        tracker.acted(action[None])
    return np.array(rows)


@cache
def tracked_soundly() -> np.ndarray:
    """Estimates of the sound flight."""
    return tracked(flown()[0])


def place(name: str) -> int:
    return int(design().reading_places[design().readings.index(name)])


def spoilt(name: str, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The observations of the sound flight with one reading changed while it is at fault."""
    observations = flown()[0].copy()
    observations[FAULT, place(name)] = change(observations[FAULT, place(name)])
    return observations


FAULTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "missing": lambda y: np.full_like(y, np.nan),
    "infinite": lambda y: np.full_like(y, np.inf),
    "now and then": lambda y: np.where(np.arange(len(y)) % 3 == 0, np.nan, y),
    "frozen": lambda y: np.full_like(y, y[0]),
    "saturated": lambda y: np.full_like(y, 3.0),
    "lying": lambda y: y + 0.5,
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", ["p", "az", "phi", "psi", "h", "vn", "rpm_upper"])
def test_the_estimate_stays_finite_and_forgets(name, fault):
    """Its error dynamics are stable: what a second of nonsense leaves dies out."""
    if name == "rpm_upper" and fault == "saturated":
        pytest.skip("3 rev/min: a rotor that stands is another story")
    sound, faulty = tracked_soundly(), tracked(spoilt(name, FAULTS[fault]))
    assert np.isfinite(faulty).all()
    assert np.array_equal(sound[: FAULT.start], faulty[: FAULT.start])
    n = len(design().states)
    apart = (faulty - sound)[:, :n]
    apart = np.abs(apart) / design().spread
    worst = apart[FAULT].max()
    assert apart[-1].max() < max(0.35 * worst, 1e-3), (worst, apart[-1].max())


def test_a_missing_reading_is_one_that_is_not_new():
    """For a sensor with a flag it is the same, to single precision, as no flag."""
    column = design().readings.index("h")
    flag = int(design().flag_places[column])
    assert flag >= 0
    unflagged = flown()[0].copy()
    unflagged[FAULT, flag] = 0.0
    n = len(design().states)
    missing = tracked(spoilt("h", FAULTS["missing"]))[:, :n]
    assert (np.abs(missing - tracked(unflagged)[:, :n]) < 1e-3 * design().spread).all()


def test_nothing_but_holes_is_the_models_own_prediction():
    observations = flown()[0].copy()
    observations[FAULT, design().reading_places] = np.nan
    state = tracked(observations)[:, : len(design().states)]
    offset = design().action_trim - design().command_trim
    for row in range(FAULT.start, FAULT.stop - 1):
        command = offset + design().action_scale * flown()[1][row]
        expected = design().A @ state[row] + design().B @ command
        assert (np.abs(state[row + 1] - expected) < 1e-2 * design().spread).all()


def test_holes_in_one_helicopter_are_not_its_neighbours():
    observations, actions = flown()
    both, alone = Tracker(design(), 2), Tracker(design(), 1)
    for k in range(120):
        pair = np.repeat(observations[k][None], 2, axis=0)
        if k > 40:
            pair[0, design().reading_places] = np.nan
        seen = both.see(pair)[1]
        np.testing.assert_allclose(seen, alone.see(observations[k][None])[0], rtol=1e-9, atol=1e-12)
        both.acted(np.repeat(actions[k][None], 2, axis=0))
        alone.acted(actions[k][None])


@pytest.mark.parametrize("rows", [slice(0, 40), slice(100, 140)])
def test_the_controller_acts_on_holes(rows):
    """From the first row on, or in the middle: a number within the bounds, and the flight goes on."""
    env = gymnasium.make("CoaxHeli-v0")
    controller = lqr.design("lama400d")
    controller.reset()
    observation, _ = env.reset(seed=5)
    for row in range(400):
        if rows.start <= row < rows.stop and row % 2:
            observation = np.full_like(observation, np.nan)
        action = controller.act(observation)
        assert np.isfinite(action).all() and (np.abs(action) <= 1.0).all()
        observation, _, over, _, _ = env.step(action)
        assert not over, row


@pytest.mark.parametrize("sensors", ["onboard", "paper", "mocap"])
def test_sensors_saturate_at_the_bounds_of_the_space(sensors):
    """Whatever is flown, no reading leaves the space: a sensor reads its limit and not more."""
    env = gymnasium.make("CoaxHeli-v0", sensors=sensors)
    rng = np.random.default_rng(1)
    for seed in range(6):
        env.reset(seed=seed)
        action = rng.choice([-1.0, 1.0], 4).astype(np.float32)
        for _ in range(300):
            observation, _, over, _, _ = env.step(action)
            assert env.observation_space.contains(observation)
            if over:
                break
        assert over, "a helicopter under full deflection does not fly on"


def test_a_compass_that_lied_leaves_no_whole_turn_to_fly_back():
    """Five seconds after it was 3 rad off, the heading is back, and not 2 pi away."""
    sound, faulty = tracked(flown()[0]), tracked(spoilt("psi", lambda y: y + 3.0))
    psi = design().index("psi")
    assert np.abs(faulty[FAULT, psi]).max() > 1.0
    assert abs(faulty[-1, psi] - sound[-1, psi]) < 0.3
