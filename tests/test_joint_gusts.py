"""Gusts that push and turn at once: what the filter makes of them, and what is named."""

from dataclasses import replace
from types import SimpleNamespace

import injector
import injector_air
import numpy as np
import pytest
from injector_air import Air
from injector_craft import COAX
from numpy.testing import assert_allclose
from scipy.linalg import expm

from coax_env import diagnose, load_vehicle
from coax_env.diagnosis import joint_gusts as asking
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.helicopter_noise import AXES, JOINT, PAIRS_OF_GUSTS
from coax_env.estimation.joint_gusts import (
    LEVER,
    PAIRS,
    SHARES,
    JointModel,
    free_shares,
    is_joint,
    score_slopes,
)
from coax_env.estimation.lasting_errors import ErringModel
from coax_env.estimation.rotor_jitter import JitteryModel
from coax_env.estimation.state_space import Noise
from coax_env.estimation.swinging_gusts import SwingingModel
from coax_env.estimation.wrapping_model import with_innermost
from coax_env.model import dynamics
from coax_env.model import parameters as P
from coax_env.model.layout import GUSTS, N_CHANNELS, N_FULL

LAMA = load_vehicle("lama400d")
PLAIN = HeliModel(LAMA)
MODEL = JointModel(PLAIN)
LIFT = "joint_gusts.force_z_per_force_x"
TURN = "joint_gusts.moment_z_per_force_y"
JOINED = {LEVER: -0.03, LIFT: 0.5, TURN: 0.01}
MEMORY = dict(zip(AXES, (0.4, 0.8, 0.2, 1.5), strict=True))
NOISE = Noise({f"memory_{axes}": seconds for axes, seconds in MEMORY.items()})
HOVER, COMMAND = dynamics.hover_trim(LAMA)
INPUT = np.append(np.tile(dynamics.kernel_input(COMMAND), 2), [0.0, 0.0])
SHOWN = np.append(INPUT, [0.3, -0.2, 0.1, 0.2, 0.0, 0.0])  # innovations of rotors and swash plate
GAINS = {name: 0.01 * (1.0 + k) for k, name in enumerate(P.COMMAND_GAINS)}
GUST = np.array([0.2, -0.1, 0.3, 0.004, -0.002, 0.001])
FELT = np.array([0.2, -0.1, 0.3 + 0.1, 0.004 - 0.003, -0.002 - 0.006, 0.001 - 0.001])
"""By hand: half of the push along x lifts, both tilt by 3 cm, that to the right turns by 1 cm."""


def state(gust: np.ndarray = GUST) -> np.ndarray:
    x = dynamics.full_state(HOVER, COMMAND, LAMA)
    x[GUSTS] = gust
    return x


def stepped(model: HeliModel, x: np.ndarray, values: dict, u: np.ndarray = INPUT, dt: float = 0.01):
    out, work = np.zeros(x.size), np.zeros(model.work_size)
    model.step.__wrapped__(x, u, dt, model.vector(values, NOISE), work, out)
    return out


def test_a_push_turns_by_its_arm_in_step_and_readings():
    """As the plain helicopter in the gusts that it feels, worked out by hand."""
    rest = np.r_[0 : GUSTS.start, GUSTS.stop : N_FULL]
    ours, plain = stepped(MODEL, state(), JOINED), stepped(PLAIN, state(FELT), {})
    assert_allclose(ours[rest], plain[rest], rtol=1e-13)
    read = []
    for model, x, values in ((MODEL, state(), JOINED), (PLAIN, state(FELT), {})):
        out, work = np.zeros(N_CHANNELS), np.zeros(model.work_size)
        model.measure.__wrapped__(x, INPUT, model.vector(values, NOISE), work, out)
        read.append(out)
    assert_allclose(read[0], read[1], rtol=1e-13)


def test_each_gusts_own_state_fades_by_its_own_memory():
    later = stepped(MODEL, state(), JOINED, dt=0.05)
    memory = [MEMORY[axes] for axes in ("force_xy",) * 2 + ("force_z",) + ("moment_xy",) * 2]
    fading = -np.diag([1.0 / m for m in (*memory, MEMORY["moment_z"])])
    assert_allclose(later[GUSTS], expm(0.05 * fading) @ GUST, rtol=1e-12)


def test_without_shares_it_is_the_model_inside():
    for u in (INPUT, SHOWN):
        ours, plain = stepped(MODEL, state(), GAINS, u), stepped(PLAIN, state(), GAINS, u)
        assert_allclose(ours, plain, rtol=1e-13)
    vector, noise = MODEL.vector({}, NOISE), MODEL.process_noise(NOISE, MODEL.vector({}, NOISE))
    assert np.array_equal(vector[:-15], PLAIN.vector({}, NOISE)) and not vector[-15:].any()
    for ours, plain in zip(noise, PLAIN.process_noise(NOISE, vector[:-15]), strict=True):
        assert np.array_equal(ours, plain)
    assert np.array_equal(MODEL.noise_places, PLAIN.noise_places)
    assert np.array_equal(MODEL.start_noise(NOISE), PLAIN.start_noise(NOISE))


def test_what_commands_show_of_a_gust_is_of_its_own_state():
    """The body feels it with what it has a share in; rates and speeds take theirs once."""
    ours = stepped(MODEL, state(), {**JOINED, **GAINS}, SHOWN)
    seen = stepped(PLAIN, state(), GAINS, SHOWN, dt=0.0)[GUSTS]
    felt = seen.copy()
    felt[2] += 0.5 * seen[0]
    felt[3] += 0.03 * seen[1]
    felt[4] -= 0.03 * seen[0]
    felt[5] += 0.01 * seen[1]
    taken = stepped(PLAIN, state(), GAINS, SHOWN, dt=0.0)
    taken[GUSTS] = felt
    plain = stepped(PLAIN, taken, {})
    rest = np.r_[0 : GUSTS.start, GUSTS.stop : N_FULL]
    assert_allclose(ours[rest], plain[rest], rtol=1e-12)


def test_the_drift_is_what_the_step_adds():
    """To first order, what commands show apart; of the gusts exactly."""
    for values, u in ((JOINED, INPUT), ({**JOINED, **GAINS}, SHOWN)):
        out, work = np.zeros(N_FULL + N_CHANNELS), np.zeros(MODEL.work_size)
        MODEL.drift_and_readings.__wrapped__(
            state(), u, 1e-4, MODEL.vector(values, NOISE), work, out
        )
        added = stepped(MODEL, state(), values, u, 1e-4) - state()
        assert_allclose(out[GUSTS], added[GUSTS], rtol=1e-3, atol=1e-9)
        if u is INPUT:
            assert_allclose(out[:N_FULL], added, rtol=2e-2, atol=1e-6)


def test_every_pair_of_gusts_has_one_share_and_a_push_to_any_side_one_arm():
    pairs = [pair for of in SHARES.values() for pair in of]
    assert sorted(pairs) == sorted(PAIRS) == sorted((i, j) for j in range(6) for i in range(j))
    assert SHARES[LEVER] == {(0, 4): 1.0, (1, 3): -1.0} and len(SHARES) == 14
    free = {f.name: f for f in free_shares(list(SHARES), LAMA)}
    radius = LAMA.values()["rotor_radius"]
    assert free[LEVER].std == free[TURN].std == radius and free[LIFT].std == 1.0
    assert all(f.value == 0.0 for f in free.values())


def test_it_stands_around_the_helicopter_or_one_whose_rotors_jitter():
    model = ErringModel(SwingingModel(JitteryModel.like(PLAIN), (0.5,) * 6)).reading_after(0.02)
    joint = with_innermost(model, JointModel)
    assert not is_joint(model) and is_joint(joint)
    assert isinstance(joint, ErringModel) and isinstance(joint.inner, SwingingModel)
    assert isinstance(joint.inner.inner, JointModel) and joint.read_delay == 0.02
    assert isinstance(joint.inner.inner.inner, JitteryModel)
    other = with_innermost(JointModel(PLAIN), JitteryModel)
    assert isinstance(other, JointModel) and isinstance(other.inner, JitteryModel)
    assert other.vector({LEVER: 0.1}).size == JitteryModel.like(PLAIN).vector({}).size + 15


def test_the_score_of_a_correlation_is_the_slope_in_its_covariance():
    """By blocks, with what drives both gusts; a lever's is that of both its pairs."""
    rng = np.random.default_rng(3)
    in_noise = rng.standard_normal((4, MODEL.noise_places.shape[0]))
    driven = np.array([0.04, 0.04, 0.09, 1e-6, 1e-6, 4e-6])
    slopes = score_slopes(in_noise, driven)
    of_gusts = {pair: in_noise[:, JOINT][:, k] for k, pair in enumerate(PAIRS_OF_GUSTS)}
    assert_allclose(slopes[LIFT], of_gusts[0, 2] * 0.2 * 0.3)
    assert_allclose(slopes[LEVER], (of_gusts[0, 4] - of_gusts[1, 3]) * 0.2 * 1e-3)
    places = PLAIN.noise_places[JOINT] - GUSTS.start
    assert [tuple(pair) for pair in places.tolist()] == list(PAIRS_OF_GUSTS)


@pytest.mark.parametrize(
    ("score", "gain", "used"),
    [
        (4.0, 100.0, True),
        (-4.0, 100.0, True),
        (2.0, 100.0, False),  # nothing asks
        (4.0, 10.0, False),  # not worth the threshold
    ],
)
def test_joint_gusts_are_asked_for_where_they_are_worth_it(monkeypatch, score, gain, used):
    """The fits are stand-ins, which gain at once what they may; one share asks for as many std."""
    rng = np.random.default_rng(1)
    even = rng.standard_normal(400)
    even = (even - even.mean()) / even.std()
    parts = {LEVER: even + score / 20.0, TURN: even}
    monkeypatch.setattr(asking, "score_slopes", lambda in_noise, driven: parts)
    gained = lambda problem, fit: replace(fit, objective=500.0 - gain)  # noqa: E731
    monkeypatch.setattr(asking, "fitted", gained)
    monkeypatch.setattr(asking, "noise_fitted", lambda problem, fit: fit)
    engine = SimpleNamespace(
        noise_score=lambda values, noise: SimpleNamespace(in_noise=None),
        log_likelihood=lambda values, noise: 0.0,
    )
    problem = SimpleNamespace(
        engine=engine, model=PLAIN, settings=SETTINGS, report=lambda text: None, added=()
    )
    problem.with_model = lambda model: SimpleNamespace(**{**vars(problem), "model": model})
    freed = []
    with_model = problem.with_model
    problem.with_model = lambda model: SimpleNamespace(
        engine=engine, model=model, with_free=lambda free: freed.extend(free) or with_model(model)
    )
    found = asking.in_joint_gusts(problem, Fit((), {}, NOISE, objective=500.0))
    assert (found is not None) == used
    if found is not None:
        assert is_joint(found[0].model) and [f.name for f in freed] == [LEVER]
        assert found[1].values == {LEVER: 0.0}
    joint = SimpleNamespace(**{**vars(problem), "model": MODEL})
    assert asking.in_joint_gusts(joint, Fit((), {}, NOISE, objective=500.0)) is None


@pytest.mark.slow
def test_shares_are_found_and_nothing_is_named(tmp_path):
    """By poses alone, nine tenths of the moments those of the side force. **Synthetic**."""
    air = Air("together", force=0.16, moment_xy=0.0048, moment_z=0.0024, memory=(0.36, 3.7))
    runs = ("lon_3211", "lat_3211", "heave_3211")
    injector.fly(
        tmp_path, {}, gusts=air, sensors="pose", seed=8, runs=runs, longest=8.0, craft=COAX
    )
    found = diagnose(tmp_path)
    assert found.findings["causes"] == []
    said = [line for line in found.remarks if line.startswith("gusts push and turn at once")]
    assert len(said) == 1
    arm = float(said[0].split("moment xy per force xy ")[1].split(" m")[0])
    levels = injector_air._levels(air, COAX)
    assert arm == pytest.approx(-0.9 * levels[4] / levels[0], rel=0.15)
