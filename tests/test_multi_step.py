"""Numbers that fly nearest (estimation/multi_step.py), on records whose best numbers are known by hand.

A machine that hovers in perfect trim, and a model whose mass is wrong: it flies nearest at the true
one.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from test_prediction import LAMA, NOISE, hover

from coax_env.diagnosis import flown_numbers
from coax_env.diagnosis.flown_numbers import flying_nearest, numbers_apart
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS, Settings
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.multi_step import (
    BELIEVED,
    ENOUGH,
    LARGE,
    STRETCH,
    _held_down,
    _rms,
    fit_multi_step,
    some_of,
)
from coax_env.estimation.prediction import errors_ahead, replay_runs
from coax_env.estimation.state_space import FreeParameter
from coax_env.model.layout import CHANNELS

MASS = LAMA["mass"].value
FREE = FreeParameter("mass", MASS, 0.5 * MASS, 0.2 * MASS, 3.0 * MASS)
LOOSE = np.array([[MASS**2]])  # what a likelihood says that says nothing
CLOSE = np.array([[(0.002 * MASS) ** 2]])


def engine(*records):
    return Engine(HeliModel(LAMA), records or [hover(seconds=8.0)])


def noisy(seed: int, seconds: float = 8.0):
    """A hover whose readings have the noise that the filter takes them to have."""
    record = hover(seconds)
    z = record.z.copy()
    rng = np.random.default_rng(seed)
    for i, channel in enumerate(CHANNELS):
        if channel in NOISE.reading:
            z[:, i] += rng.normal(0.0, NOISE.reading[channel], len(z))
    return replace(record, z=z)


def fitted_mass(
    off: float, covariance: np.ndarray, free: FreeParameter = FREE, of: Engine | None = None
):
    values = {"mass": off * MASS}
    found = fit_multi_step(of or engine(), [free], values, NOISE, covariance, 1.0)
    assert list(found) == ["mass"]
    return found["mass"] / MASS


@pytest.mark.parametrize(("off", "left"), [(0.9, 3e-3), (1.03, 3e-3), (1.3, 0.02)])
def test_a_planted_mass_returns(off, left):
    """The likelihood has said nothing. Errors count by what they are at first: from far, less is left
    to gain at the end."""
    assert fitted_mass(off, LOOSE, of=engine(noisy(1))) == pytest.approx(1.0, abs=left)


def test_it_never_leaves_its_bounds():
    heavy = replace(FREE, lower=1.05 * MASS)
    assert fitted_mass(1.2, LOOSE, heavy) == pytest.approx(1.05, abs=1e-6)
    assert fitted_mass(1.05, LOOSE, heavy) == pytest.approx(1.05, abs=1e-6)


def test_it_comes_off_a_bound_that_it_stands_at():
    light = replace(FREE, lower=0.97 * MASS)
    assert fitted_mass(0.97, LOOSE, light, engine(noisy(1))) == pytest.approx(1.0, abs=3e-3)
    heavy = replace(FREE, upper=1.05 * MASS)
    assert fitted_mass(1.05, LOOSE, heavy, engine(noisy(1))) == pytest.approx(1.0, abs=3e-3)


def test_what_is_known_beforehand_holds_it():
    known = replace(FREE, value=1.02 * MASS, std=1e-5 * MASS)
    assert fitted_mass(1.03, LOOSE, known) == pytest.approx(1.02, abs=1e-4)


MARKER = FreeParameter("marker_offset.x", 0.0, 0.05, reading_only=True)


@pytest.mark.parametrize("horizon", [1.0, 2.0])
@pytest.mark.parametrize("alike", [0.0, 0.99])
def test_a_second_flown_is_one_reading_of_each_channel(horizon, alike):
    """Too heavy by 3 %, climb rate and height are wrong in proportion to what is left of it, z: each by
    its error over what it was at first. The likelihood pulls back as hard as both of them; the balance
    of (z - 1)^2 and the pseudo-Huber loss of z is at z = 0.508. What only a reading has stays, and what
    the likelihood says of the mass is what it says beside that.
    """
    nothing = dict.fromkeys(("p", "q", "r", "phi", "theta", "psi", "vn", "ve", "az"), np.nan)
    of = engine(hover(seconds=8.0, **nothing))
    starts = 1 + round((8.0 - 1.0 - horizon) / 0.25)
    readings = starts * 2 * np.mean([0.25 / (share * horizon) for share in (0.5, 1.0)])
    std = 0.03 * MASS * math.sqrt(BELIEVED / readings)  # with the marker where it is
    both = std / math.sqrt(1.0 - alike**2)
    across = alike * both * MARKER.std
    covariance = np.array([[both**2, across], [across, MARKER.std**2]])
    values = {"mass": 1.03 * MASS, MARKER.name: 0.01}
    found = fit_multi_step(of, [FREE, MARKER], values, NOISE, covariance, horizon)
    assert list(found) == ["mass"]
    assert (found["mass"] / MASS - 1.0) / 0.03 == pytest.approx(0.508, abs=0.01)


def test_numbers_that_only_readings_have_are_none_to_fly_by():
    values = {"mass": MASS, MARKER.name: 0.01}
    assert fit_multi_step(engine(), [MARKER], values, NOISE, np.array([[1e-4]])) == {}


def test_errors_count_by_channel_where_they_are():
    errors = np.array(
        [[3.0, np.nan, 0.0, np.inf], [4.0, np.nan, 0.0, 1.0], [np.nan, np.nan, 0.0, 1.0]]
    )
    np.testing.assert_allclose(_rms(errors), [math.sqrt(12.5), 1.0, 1.0, 1.0])


def test_a_likelihood_that_is_sure_holds_it_and_one_that_is_not_does_not():
    """A second flown counts as one reading; so where the likelihood's std is small, little moves."""
    rest = [fitted_mass(1.03, scale * CLOSE) - 1.0 for scale in (1e-6, 1.0, 1e6)]
    assert rest[0] == pytest.approx(0.03, rel=0.01)
    assert rest[0] > rest[1] > rest[2] - 1e-9
    assert rest[2] == pytest.approx(0.0, abs=3e-3)
    assert 0.0 < BELIEVED < 1.0


def test_what_no_prediction_shows_stays_where_the_likelihood_has_it():
    """In hover nothing rolls: the roll inertia stays, the mass does not."""
    roll = LAMA["inertia_xx"].value
    still = FreeParameter("inertia_xx", roll, roll)
    values = {"mass": 1.03 * MASS, "inertia_xx": 1.1 * roll}
    covariance = np.diag([LOOSE[0, 0], (0.05 * roll) ** 2])
    found = fit_multi_step(engine(), [FREE, still], values, NOISE, covariance, 1.0)
    assert found["mass"] == pytest.approx(MASS, rel=3e-3)
    assert found["inertia_xx"] == pytest.approx(1.1 * roll, rel=0.02)


def test_errors_ahead_are_those_of_the_replay():
    """By other code, channel by channel; the heading by whole turns, roll and pitch wrapped."""
    t = 0.01 * np.arange(801)
    record = hover(seconds=8.0, psi=np.angle(np.exp(1j * 3.0 * t)), r=3.0)
    flown, values = engine(record, hover(seconds=3.0)), {"mass": 1.02 * MASS}
    for horizon in (0.5, 1.0):
        (found,) = errors_ahead(flown, values, NOISE, [horizon])
        runs = replay_runs(flown, values, NOISE, horizon)
        for i, channel in enumerate(CHANNELS):
            same = [run.channels[channel].error for run in runs if channel in run.channels]
            expected = np.concatenate(same) if same else np.full(len(found), np.nan)
            np.testing.assert_allclose(found[:, i], expected, rtol=1e-9, atol=1e-12)


def test_horizons_are_flown_from_the_same_starts():
    both = errors_ahead(engine(), {"mass": MASS}, NOISE, [0.5, 1.0])
    assert both[0].shape == both[1].shape
    assert len(both[0]) == 1 + round((8.0 - 1.0 - 1.0) / 0.25)


def test_a_flight_that_diverges_is_no_good_one():
    """Where a reading is; elsewhere there is none."""
    (errors,) = errors_ahead(engine(), {"mass": 1e-9 * MASS}, NOISE, [1.0])
    lost = errors[:, CHANNELS.index("h")]
    assert np.isinf(lost).any() or np.abs(lost).max() > 1e3
    assert np.isnan(errors[:, CHANNELS.index("pe")]).all()


def test_large_errors_count_less_than_their_squares():
    small, large = np.array([1e-3, -1e-3]), np.array([50.0, -50.0])
    np.testing.assert_allclose(_held_down(small), small, rtol=1e-5)
    rho = 2.0 * LARGE**2 * (math.hypot(1.0, 50.0 / LARGE) - 1.0)
    np.testing.assert_allclose(_held_down(large), [math.sqrt(rho), -math.sqrt(rho)])


def test_long_flights_are_fitted_on_stretches_of_them():
    """Evenly picked, none longer than STRETCH by half, their clocks kept; short ones stay whole."""
    short = [hover(seconds=8.0)]
    assert some_of(short)[0] is short[0]
    just = [hover(seconds=290.0, dt=0.1, start=500.0), hover(seconds=9.0, dt=0.1, start=900.0)]
    assert [r.t.size for r in some_of(just)] == [r.t.size for r in just]
    long = [hover(400.0, dt=0.1, start=500.0), hover(seconds=90.0, dt=0.1, start=1000.0)]
    found = some_of(long)
    lengths = [r.t[-1] - r.t[0] for r in found]
    assert STRETCH / 1.5 < min(lengths) < max(lengths) < 1.5 * STRETCH
    assert ENOUGH - STRETCH < sum(lengths) < ENOUGH + STRETCH
    assert {r.whole for r in found} == {r.whole for r in long}
    assert (found[0].t[0], found[-1].t[-1]) == (long[0].t[0], long[-1].t[-1])


# --- the diagnosis ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Asked:
    """A problem with one number."""

    engine: Engine
    settings: Settings = SETTINGS

    def free(self, active):
        return [FREE]


def heavy(monkeypatch, coloured: bool) -> tuple[Asked, Fit]:
    """A machine that hovers, a fit 3 % too heavy, and whether much is coloured there."""
    monkeypatch.setattr(flown_numbers, "is_much_coloured", lambda problem, fit: coloured)
    return Asked(engine(noisy(1))), Fit((), {"mass": 1.03 * MASS, "gravity": 9.81}, NOISE)


def test_where_much_is_coloured_the_numbers_are_those_that_fly_nearest(monkeypatch):
    asked, fit = heavy(monkeypatch, coloured=True)
    flown = flying_nearest(asked, fit, LOOSE)
    assert flown.values["mass"] == pytest.approx(MASS, rel=3e-3)
    assert (flown.noise, flown.active) == (fit.noise, fit.active)
    apart = numbers_apart(fit, flown)
    assert apart == {"mass": pytest.approx(-0.03 * MASS, rel=0.1)}  # gravity has not moved


def test_where_little_is_coloured_the_likeliest_numbers_stay(monkeypatch):
    asked, fit = heavy(monkeypatch, coloured=False)
    assert flying_nearest(asked, fit, LOOSE) is fit
    assert numbers_apart(fit, fit) == {}


def test_numbers_that_fly_no_nearer_are_not_taken(monkeypatch):
    """What is made least is not the error alone: where that has not become smaller, the fit stays."""
    asked, fit = heavy(monkeypatch, coloured=True)
    monkeypatch.setattr(flown_numbers, "fit_multi_step", lambda *given: {"mass": 1.1 * MASS})
    assert flying_nearest(asked, fit, LOOSE) is fit
