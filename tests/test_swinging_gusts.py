"""Gusts with a frequency: what the filter's six partners do, how they are found, what is named then."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import injector
import numpy as np
import pytest
from injector_air import Air, remembered
from numpy.testing import assert_allclose
from scipy.linalg import expm, solve_continuous_lyapunov

from coax_env import diagnose, load_vehicle
from coax_env.diagnosis import swings as asking
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation import swinging_gusts
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.helicopter_noise import AXES, GUST_AXES
from coax_env.estimation.lasting_errors import ErringModel
from coax_env.estimation.rotor_jitter import JitteryModel
from coax_env.estimation.state_space import Noise
from coax_env.estimation.swinging_gusts import SwingingModel, clearly_swinging, swinging_at, swings
from coax_env.model import dynamics
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.layout import GUSTS, N_CHANNELS, N_FULL

LAMA = load_vehicle("lama400d")
PLAIN = HeliModel(LAMA)
FREQUENCIES = (0.6, 1.2, 0.0, 0.5, 0.9, 0.7)
MODEL = SwingingModel(PLAIN, FREQUENCIES)
SWINGS = MODEL.added
N_SWINGING = MODEL.exact.size
LEVELS = dict(zip(AXES, (0.2, 0.3, 0.006, 0.003), strict=True))
NOISE = Noise({**LEVELS, **{f"memory_{axes}": 0.8 for axes in AXES}})
HOVER, COMMAND = dynamics.hover_trim(LAMA)
INPUT = np.append(np.tile(dynamics.kernel_input(COMMAND), 2), [0.0, 0.0])
DT = 0.01


def memories() -> np.ndarray:
    """Those of x and y last as many swings each, 0.8 s in their geometric mean."""
    shared = {
        axes: [f for f, a in zip(FREQUENCIES, GUST_AXES, strict=True) if a == axes] for axes in AXES
    }
    swings_of = {axes: 0.8 * math.prod(f) ** (1.0 / len(f)) for axes, f in shared.items() if all(f)}
    return np.array(
        [swings_of[a] / f if f else 0.8 for f, a in zip(FREQUENCIES, GUST_AXES, strict=True)]
    )


def state() -> np.ndarray:
    x = np.zeros(N_SWINGING)
    x[:N_FULL] = dynamics.full_state(HOVER, COMMAND, LAMA)
    x[GUSTS] = [0.2, -0.1, 0.3, 0.004, -0.002, 0.001]
    x[SWINGS] = [0.1, 0.2, 0.4, -0.001, 0.003, 0.002]
    return x


def stepped(model: HeliModel, x: np.ndarray, dt: float) -> np.ndarray:
    out, work = np.zeros(x.size), np.zeros(model.work_size)
    model.step.__wrapped__(x, INPUT, dt, model.vector({}, NOISE), work, out)
    return out


def test_a_gust_and_its_partner_turn_and_fade():
    """As the matrix exponential of an oscillator; one without a frequency fades alone."""
    later, before = stepped(MODEL, state(), 0.05), state()
    for i, (frequency, memory) in enumerate(zip(FREQUENCIES, memories(), strict=True)):
        turn = 2.0 * math.pi * frequency
        there = expm(0.05 * np.array([[-1.0 / memory, turn], [-turn, -1.0 / memory]]))
        places = [S.GUST_X + i, N_FULL + i]
        assert_allclose(later[places], there @ before[places], rtol=1e-12, err_msg=str(i))


def test_the_helicopter_is_flown_and_read_as_without_partners():
    x = state()
    alone, beside = stepped(PLAIN, x[:N_FULL], DT), stepped(MODEL, x, DT)
    kept = np.r_[0 : GUSTS.start, GUSTS.stop : N_FULL]
    assert_allclose(beside[kept], alone[kept], rtol=1e-14)
    read = []
    for model, own in ((PLAIN, x[:N_FULL]), (MODEL, x)):
        out, work = np.zeros(N_CHANNELS), np.zeros(model.work_size)
        model.measure.__wrapped__(own, INPUT, model.vector({}, NOISE), work, out)
        read.append(out)
    assert_allclose(read[0], read[1], rtol=1e-14)


def test_the_drift_is_what_the_step_adds():
    """To first order; of gusts and partners exactly."""
    x, work = state(), np.zeros(MODEL.work_size)
    out, p = np.zeros(N_SWINGING + N_CHANNELS), MODEL.vector({}, NOISE)
    MODEL.drift_and_readings.__wrapped__(x, INPUT, 1e-4, p, work, out)
    added = stepped(MODEL, x, 1e-4) - x
    assert_allclose(out[:N_SWINGING], added, rtol=2e-2, atol=1e-7)
    exact = np.r_[GUSTS, SWINGS]
    assert_allclose(out[exact], added[exact], rtol=1e-9)


@pytest.mark.parametrize("axis", range(6))
def test_every_gust_has_its_levels_variance(axis):
    """Of the stochastic differential equation, by Lyapunov's; its covariance is the closed form."""
    p = MODEL.vector({}, NOISE)
    q, decay = MODEL.process_noise(NOISE, p)
    at = [GUSTS.start + axis, SWINGS.start + axis]
    turn, fade = 2.0 * math.pi * FREQUENCIES[axis], 1.0 / memories()[axis]
    assert decay[at] == pytest.approx([fade, fade])
    A = np.array([[-fade, turn], [-turn, -fade]])
    P = solve_continuous_lyapunov(A, -np.diag(q[at]))
    level = LEVELS[GUST_AXES[axis]]
    assert P[0, 0] == pytest.approx(level**2)
    for lag in (0.1, 0.5, 1.3):
        wave = math.cos(turn * lag) + (fade / turn * math.sin(turn * lag) if turn else 0.0)
        found = (expm(A * lag) @ P)[0, 0]
        assert found == pytest.approx(level**2 * math.exp(-fade * lag) * wave, abs=1e-9)


def test_all_other_noise_is_the_helicopters():
    p = MODEL.vector({}, NOISE)
    ours, plain = MODEL.process_noise(NOISE, p), PLAIN.process_noise(NOISE, PLAIN.vector({}, NOISE))
    others = np.delete(np.delete(ours.intensity, np.r_[SWINGS]), np.r_[GUSTS])
    assert_allclose(others, np.delete(plain.intensity, np.r_[GUSTS]))
    assert np.array_equal(np.delete(MODEL.noise_places, np.r_[SWINGS], 0), PLAIN.noise_places)
    assert_allclose(MODEL.start_noise(NOISE)[SWINGS], MODEL.start_noise(NOISE)[GUSTS])


def test_what_commands_show_of_gusts_turns_with_them():
    """By constant gains, before the step, in the drift that derivatives are taken of as in the step."""
    gains = {name: 0.01 * (1.0 + k) for k, name in enumerate(P.COMMAND_GAINS)}
    u = np.append(INPUT, [0.3, -0.2, 0.1, 0.2, 0.0, 0.0])  # innovations of rotors and swash plate
    p, x = MODEL.vector(gains, NOISE), state()
    work, later = np.zeros(MODEL.work_size), np.zeros(N_SWINGING)
    out = np.zeros(N_SWINGING + N_CHANNELS)
    MODEL.step.__wrapped__(x, u, 1e-4, p, work, later)
    MODEL.drift_and_readings.__wrapped__(x, u, 1e-4, p, work, out)
    exact = np.r_[GUSTS, SWINGS]
    assert_allclose(out[exact], (later - x)[exact], rtol=1e-9)
    shown = gains["command_gain.moment_xy"] * 0.2  # of the lateral one
    assert out[S.GUST_L] == pytest.approx(shown, rel=0.05)


def test_around_rotors_that_jitter_gusts_turn_alike_and_the_rest_is_theirs():
    """Also where commands show gusts, which the inner model takes in by itself."""
    inner = JitteryModel.like(PLAIN)
    model = SwingingModel(inner, FREQUENCIES)
    x = np.concatenate([state()[:N_FULL], [1.5, -2.0], state()[SWINGS]])
    u = np.append(INPUT, [0.3, -0.2, 0.1, 0.2, 0.0, 0.0])
    gains = {name: 0.01 * (1.0 + k) for k, name in enumerate(P.COMMAND_GAINS)}
    later, alone = np.zeros(x.size), np.zeros(N_FULL + 2)
    model.step.__wrapped__(x, u, DT, model.vector(gains, NOISE), np.zeros(model.work_size), later)
    inner.step.__wrapped__(
        x[: N_FULL + 2], u, DT, inner.vector(gains, NOISE), np.zeros(inner.work_size), alone
    )
    rest = np.r_[0 : GUSTS.start, GUSTS.stop : N_FULL + 2]
    assert np.array_equal(later[rest], alone[rest])
    without = np.zeros(N_SWINGING)
    MODEL.step.__wrapped__(
        state(), u, DT, MODEL.vector(gains, NOISE), np.zeros(MODEL.work_size), without
    )
    assert_allclose(later[GUSTS], without[GUSTS], rtol=1e-12)
    assert_allclose(later[model.added], without[SWINGS], rtol=1e-12)


def test_frequencies_are_changed_where_the_gusts_are():
    around = ErringModel(SwingingModel(JitteryModel.like(PLAIN), FREQUENCIES)).reading_after(0.02)
    other = swinging_at(around, (1.0,) * 6)
    assert isinstance(other, ErringModel) and isinstance(other.inner, SwingingModel)
    assert other.frequencies == other.inner.frequencies == (1.0,) * 6 and other.read_delay == 0.02
    assert isinstance(other.inner.inner, JitteryModel)
    assert swinging_at(PLAIN, FREQUENCIES).frequencies == FREQUENCIES


def passes(gust: np.ndarray) -> list[SimpleNamespace]:
    """Three runs whose gust along the second axis is this; the others are still."""
    states = np.zeros((gust.size, N_FULL))
    states[:, S.GUST_Y] = gust
    return [SimpleNamespace(states=part) for part in np.array_split(states, 3)]


@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_a_spectrum_shows_at_what_frequency_a_gust_comes(offset):
    """Also about what is no gust: a moment that a centre of gravity has made all the time."""
    t, rng = 0.01 * np.arange(4500), np.random.default_rng(1)
    wave = np.sin(2.0 * np.pi * 0.8 * t) + 0.3 * rng.standard_normal(t.size) + offset
    assert swings(passes(wave), 0.01) == pytest.approx([0.0, 0.8, 0.0, 0.0, 0.0, 0.0])
    assert clearly_swinging(passes(wave), 0.01) == ["force_xy"]


def test_the_clearest_group_of_gusts_is_asked_first(monkeypatch):
    """By its clearest axis; what is not clear is not asked."""
    clear = [2.0, 7.0, 30.0, 4.9, 0.0, 9.0]
    monkeypatch.setattr(swinging_gusts, "_strongest_of_all", lambda passes, row: ([0.5] * 6, clear))
    assert clearly_swinging([], 0.01) == ["force_z", "moment_z", "force_xy"]


def test_a_gust_that_only_fades_has_none():
    """Strongest at the lowest frequency, if not by chance, and nowhere three times as strong."""
    rng = np.random.default_rng(2)
    found = [
        swings(passes(remembered(rng.standard_normal(9000), 0.2, 2.0, 0.01)), 0.01)[1]
        for _ in range(20)
    ]
    assert not np.any(found)


def of_stand_ins(monkeypatch: pytest.MonkeyPatch, clear: list[str], **others: Any) -> Any:
    """A problem whose clear gusts swing at 0.8 Hz, and whose fits change nothing but by `others`."""
    stand_ins: dict[str, Any] = {
        "swings": lambda passes, row: [0.8] * 6,
        "clearly_swinging": lambda passes, row: clear,
        "with_latent_noise": lambda problem, fit: None,
        "noise_fitted": lambda problem, fit: fit,
        "_swinging": lambda problem, frequencies: problem,
        "_likeliest": lambda part, trial, found, *how: (found, trial),
        "evenly_picked": lambda records, seconds: records,
    }
    for name, stand_in in {**stand_ins, **others}.items():
        monkeypatch.setattr(asking, name, stand_in)
    return SimpleNamespace(
        engine=SimpleNamespace(filter=lambda values, noise: [], records=[]), row=0.01,
        model=SimpleNamespace(channels=()), settings=SETTINGS, noise_fit_seconds=60.0,
        report=lambda text: None, with_records=lambda records: None,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("clear", "times", "alone", "gain", "used"),
    [
        ("force_z", 2.1, 60.0, 100.0, True),
        ("", 2.1, 60.0, 100.0, False),  # no swings
        ("force_z", 1.9, 60.0, 100.0, False),  # hardly more than the least that gusts may be
        ("force_z", 2.1, 5.0, 100.0, False),  # none where they are clear
        ("moment_z force_z", 2.1, 60.0, 100.0, True),  # what is named has taken the clearest up
        ("moment_z", 2.1, 60.0, 100.0, False),
        ("force_z", 2.1, 60.0, 10.0, False),  # not worth the threshold
    ],
)
def test_swings_are_asked_for_where_they_are_worth_it(monkeypatch, clear, times, alone, gain, used):
    """The fits are stand-ins, which gain at once what they may; gusts are so many times their floor."""
    floor = {"force_z": NOISE.level("force_z") / times}
    fit = Fit((), {}, replace(NOISE, floor=floor), objective=500.0)
    gained = lambda problem, fit: replace(fit, objective=500.0 - gain)  # noqa: E731
    problem = of_stand_ins(
        monkeypatch, clear.split(), fitted=gained, noise_fitted=gained,
        _gained_by=lambda p, f, at, axes: alone * (axes == "force_z"),
    )  # fmt: skip
    found = asking.with_swings(problem, fit)
    assert (found is not None) == used
    if found is not None:
        levels = {**LEVELS, **{f"memory_{axes}": 1.25 for axes in AXES}}  # one swing at 0.8 Hz
        assert found[0] is problem and found[1] == pytest.approx(levels)


@pytest.mark.parametrize(("lost", "asked"), [(990.0, True), (1010.0, False)])
def test_swings_that_lose_far_more_at_first_than_one_gained_are_not_fitted(
    monkeypatch, lost, asked
):
    """Ten times what one group gained alone, 100 nats; the real first CoaX lost 124 times."""
    fit = Fit((), {}, NOISE, objective=500.0)
    turns = []
    problem = of_stand_ins(
        monkeypatch, ["force_z"],
        _gained_by=lambda *of: 100.0,
        fitted=lambda p, trial: replace(trial, objective=500.0 + lost),
        _likeliest=lambda part, trial, found, *how: turns.append(1) or (found, trial),
    )  # fmt: skip
    assert asking.with_swings(problem, fit) is None
    assert bool(turns) == asked


@pytest.mark.parametrize(("peak", "asked"), [(0.8, False), (0.71, True), (2.3, True), (0.0, False)])
def test_a_swing_far_from_its_spectrums_peak_is_fitted_from_there(monkeypatch, peak, asked):
    """It swings at 0.29 times, or 2 to 2.9 times the peak's frequency, but not at 1.6 times."""
    at = {0.8: 1.28, 0.71: 0.29, 2.3: 0.8, 0.0: 0.8}[peak]
    model = ErringModel(SwingingModel(PLAIN, (0.9, 0.0, 0.0, at, 0.0, 0.0)))
    problem: Any = SimpleNamespace(
        model=model, row=0.01, engine=SimpleNamespace(filter=lambda values, noise: [])
    )
    faint = lambda passes, row, least=0.0: [0.8, 0.5 * (least == 0.0), 0.0, peak, 0.0, 0.0]  # noqa: E731
    monkeypatch.setattr(asking, "swings", faint)
    monkeypatch.setattr(asking, "_fitted_from", lambda problem, fit, found: found)
    found = asking.with_other_swings(problem, Fit((), {}, NOISE))
    assert found == ([0.8, 0.5, 0.0, peak, 0.0, 0.0] if asked else None)


@pytest.mark.parametrize(("stands_out", "asked"), [(4.0, False), (6.0, True)])
def test_a_gust_that_only_fades_swings_where_its_spectrum_says_so_clearly(
    monkeypatch, stands_out, asked
):
    """Beside one that swings already: more than five times the density at the lowest frequency."""
    model = SwingingModel(PLAIN, (0.8, 0.0, 0.0, 0.0, 0.0, 0.0))
    problem: Any = SimpleNamespace(
        model=model, row=0.01, engine=SimpleNamespace(filter=lambda values, noise: [])
    )
    spectra = [0.8, 0.5, 0.0, 0.0, 0.0, 0.0], [40.0, stands_out, 1.0, 1.0, 1.0, 1.0]
    monkeypatch.setattr(swinging_gusts, "_strongest_of_all", lambda passes, row: spectra)
    monkeypatch.setattr(asking, "_fitted_from", lambda problem, fit, found: found)
    found = asking.with_other_swings(problem, Fit((), {}, NOISE))
    assert found == ([0.8, 0.5, 0.0, 0.0, 0.0, 0.0] if asked else None)


@pytest.mark.parametrize(("axes", "alone"), [("force_xy", [0.8, 0.9]), ("moment_z", [0.5])])
def test_one_group_swings_alone(monkeypatch, axes, alone):
    """The others only fade; what it gains is beside what the same flights are worth without."""
    worth = lambda nats: SimpleNamespace(  # noqa: E731
        engine=SimpleNamespace(log_likelihood=lambda values, noise: nats)
    )
    problem = SimpleNamespace(engine=SimpleNamespace(records=[]), noise_fit_seconds=60.0)
    problem.with_records = lambda records: worth(20.0)
    asked = []
    monkeypatch.setattr(asking, "evenly_picked", lambda records, seconds: records)
    monkeypatch.setattr(asking, "_swinging", lambda part, found: worth(33.0))
    monkeypatch.setattr(
        asking,
        "_likeliest",
        lambda part, trial, found, of, reach: asked.append((found, of)) or (found, trial),
    )
    frequencies = [0.8, 0.9, 0.0, 0.0, 0.0, 0.5]
    assert asking._gained_by(problem, Fit((), {}, NOISE), frequencies, axes) == 13.0
    (found, of), *_ = asked
    assert of == axes and [f for f in found if f] == alone


@pytest.mark.slow
def test_nothing_is_named_where_gusts_have_a_frequency(tmp_path):
    """Taken for gusts that fade: a servo's play, and inertias 10 to 30 % too large. **Synthetic**."""
    runs = ("lon_3211", "lat_3211", "heave_3211")
    injector.fly(tmp_path, {}, gusts=Air("shedding"), seed=6, runs=runs, longest=9.0)
    found = diagnose(tmp_path)
    assert found.findings["causes"] == []
    assert not found.findings["unexplained"]
    said = [line for line in found.remarks if line.startswith("gusts have a frequency [Hz]")]
    assert len(said) == 1
