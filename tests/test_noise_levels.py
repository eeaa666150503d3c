"""Noise levels of the helicopter: their slopes, and what is found where something else was flown.

Slopes are held against differences of the log-likelihood itself; levels against gusts that were
planted by simulating them here.
"""

from dataclasses import replace

import numpy as np
import pytest

from coax_env import load_vehicle, simulate
from coax_env.diagnosis.findings import noise_levels
from coax_env.estimation import noise_levels as noise_fits
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import (
    LATENT_START,
    fitted_levels,
    starting_noise,
)
from coax_env.estimation.noise_levels import fit_noise, level_slopes
from coax_env.estimation.state_space import Noise
from coax_env.simulation.simulate import Gusts

LAMA = load_vehicle("lama400d")
SHAKEN = LAMA.with_effect("spin_up_reaction", gain=1.0).with_effect(
    "motor_lag", upper=0.1, lower=0.1
)


@pytest.fixture(scope="module")
def flown():
    """Six seconds in gusts of a short memory, every sensor at 100 Hz but a slow sonar."""
    flight = simulate(SHAKEN, "lon_doublet", seed=3, sensors="onboard",
                      gusts=Gusts(memory_s=0.15))  # fmt: skip
    record = record_of(flight.runs[0])
    rows = record.t < record.t[0] + 6.0
    z = record.z[rows].copy()
    z[np.arange(z.shape[0]) % 5 != 0, 11] = np.nan
    model = HeliModel(SHAKEN)
    engine = Engine(model, [replace(record, t=record.t[rows], command=record.command[rows], z=z)])
    return engine, starting_noise(flight, SHAKEN)


def test_slopes_are_those_of_the_likelihood(flown):
    """Of every level that there is: gusts and memories, white noise, rotors, trims and readings.

    The smoother's score is that of the model as linearised, so within some hundredths.
    """
    engine, noise = flown
    values = engine.model.bare_values
    noise = noise.with_levels(
        {name: max(share * noise.level(axes), 2.0 * noise.floor[name])
         for name, (axes, share) in LATENT_START.items()}
        | {"p": 2.0 * noise.reading["p"], "memory_moment_xy": 0.2, "rotor_speed": 0.5}
    )  # fmt: skip
    names = [*fitted_levels(noise), *LATENT_START]
    noise = replace(noise, prior={})
    score = engine.noise_score(values, noise)
    found = [level_slopes(engine, values, noise, name, score)[0].sum() for name in names]
    size = np.abs(found).max()
    for name, slope in zip(names, found, strict=True):
        sides = [
            engine.log_likelihood(values, noise.with_levels({name: f * noise.level(name)}))
            for f in (1.02, 1.0 / 1.02)
        ]
        exact = (sides[0] - sides[1]) / (2.0 * np.log(1.02))
        assert slope == pytest.approx(exact, rel=0.08, abs=2e-3 * size), name


def test_every_level_is_reported_with_its_unit_and_whether_it_stands_at_a_bound(flown):
    _, noise = flown
    found = noise_levels(noise)
    assert set(found) == {*noise.process, *noise.reading}
    assert found["force_xy"]["unit"] == "N" and found["memory_moment_z"]["unit"] == "s"
    assert found["p"] == {"value": noise.reading["p"], "unit": "rad/s", "at_bound": False}
    assert found["trim_moment_z"]["at_bound"] and not found["moment_z"]["at_bound"]
    most = noise.with_levels({"memory_force_z": noise.ceiling["memory_force_z"]})
    assert noise_levels(most)["memory_force_z"]["at_bound"]


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.05, 2.0])
def test_the_memory_of_the_gusts_is_found(memory):
    """Planted by the simulator, from the usual half second: within a factor that a minute allows."""
    flight = simulate(
        LAMA, ["lon_doublet", "climb_descend", "heading_turn"], seed=5, sensors="onboard",
        gusts=Gusts((0.2, 0.2, 0.2), (4e-3, 4e-3, 2e-3), memory),
    )  # fmt: skip
    model = HeliModel(LAMA)
    noise = starting_noise(flight, LAMA)
    engine = Engine(model, [record_of(run) for run in flight.runs])
    found = fit_noise(engine, model.bare_values, noise, fitted_levels(noise), evaluations=40)
    for axes, level in (("force_xy", 0.2), ("moment_xy", 4e-3)):
        assert found.level(axes) == pytest.approx(level, rel=0.35), axes
        assert abs(np.log(found.level(f"memory_{axes}") / memory)) < np.log(1.8), axes
    assert found.level("p") == pytest.approx(noise.level("p"), rel=0.1)


# --- the steps of a fit, on a posterior that is known -------------------------------------------------


def point(**changed: object) -> noise_fits._Point:
    """Three levels at 1, 2 and 3, with slopes and scales, between a tenth and ten times."""
    noise = Noise({"a": 1.0, "b": 2.0, "c": 3.0}, {}, {}, {})
    logs = np.log([1.0, 2.0, 3.0])
    given = dict(
        names=("a", "b", "c"), noise=noise, logs=logs, lower=logs - np.log(10.0),
        upper=logs + np.log(10.0), value=-50.0, slope=np.array([3.0, -2.0, 0.5]),
        scale=np.array([1.0, 4.0, 2.0]), lean=np.zeros(3), ratio=np.ones(3),
    )  # fmt: skip
    return noise_fits._Point(**{**given, **changed})


def test_a_level_promises_half_the_square_of_its_slope_in_std():
    """But nothing at a bound that it wants to cross; at the other bound it does."""
    gains = 0.5 * np.array([9.0, 0.25, 0.0625])
    one = point()
    np.testing.assert_allclose(one.predicted_gains(), gains)
    top = point(upper=one.logs)
    np.testing.assert_allclose(top.predicted_gains(), gains * [0.0, 1.0, 0.0])
    bottom = point(lower=one.logs)
    np.testing.assert_allclose(bottom.predicted_gains(), gains * [1.0, 0.0, 1.0])


SCATTER = np.array([[6000.0, -2850.0], [-2850.0, 1370.0]])
"""Of the slopes in a level and in its memory where gusts last long: their correlation is -0.994."""


def coupled(**changed: object) -> noise_fits._Point:
    """A level, another one and the first one's memory; the slopes of the first and last scatter so."""
    noise = Noise({"a": 1.0, "b": 2.0, "memory_a": 3.0}, {}, {}, {})
    (own, across), (_, memory) = SCATTER
    lean = across / own
    given = dict(
        names=("a", "b", "memory_a"), noise=noise, slope=np.array([-55.0, 4.0, -8.0]),
        scale=np.sqrt([own, 16.0, memory - lean * across]), lean=np.array([0.0, 0.0, lean]),
    )  # fmt: skip
    return point(**{**given, **changed})


def test_a_level_and_its_memory_promise_what_both_together_do():
    """Half s' V^-1 s of both, however little each alone; both are moved where one of them asks."""
    one = coupled()
    gains = one.predicted_gains()
    slope = one.slope[[0, 2]]
    assert gains[[0, 2]].sum() == pytest.approx(0.5 * slope @ np.linalg.solve(SCATTER, slope))
    assert (0.5 * slope**2 / np.diag(SCATTER) < 0.3).all() and gains[2] > 30.0
    assert list(coupled(slope=np.array([0.0, 0.0, 4.0])).asking()) == [0, 2]
    assert list(coupled(slope=np.array([0.0, 4.0, 0.0])).asking()) == [1]
    longest = coupled(upper=one.logs, slope=np.array([0.0, 0.0, 8.0]))
    assert longest.predicted_gains()[2] == 0.0


@pytest.mark.parametrize("bounded", [False, True])
def test_a_level_is_moved_with_its_memory(monkeypatch, bounded):
    """To the best of a normal posterior in whose valley neither slope shows much, in six evaluations.

    No level is evaluated beyond its bounds.
    """
    asked = []

    def moved(own: noise_fits._Point, engine: object, values: object, logs: np.ndarray):
        logs = np.clip(logs, own.lower, own.upper)
        asked.append(logs)
        slope, value = np.array(own.slope), -50.0
        away = (logs - best)[[0, 2]]
        slope[[0, 2]] = -SCATTER @ away
        slope[1] = -16.0 * (logs[1] - best[1])
        value = -0.5 * away @ SCATTER @ away - 8.0 * (logs[1] - best[1]) ** 2
        return replace(own, logs=logs, slope=slope, value=value)

    monkeypatch.setattr(noise_fits._Point, "moved", moved)
    start = coupled()
    best = start.logs + [-1.0, 0.4, -2.0]
    least = start.lower if not bounded else start.logs - 0.1
    begin = moved(replace(start, lower=least), None, None, start.logs)
    found = noise_fits._quasi_newton(None, {}, begin, 6, 0.1)
    assert all((logs >= least).all() and (logs <= start.upper).all() for logs in asked)
    if bounded:
        assert found.value > begin.value + 5.0
    else:
        assert begin.value < -15.0 and found.value > -0.5


def test_gusts_are_found_from_longer_ones_that_shake_as_much(flown):
    """Gusts four times as long and twice as strong shake as much a second: neither slope shows much.

    The fit ends where one from the usual memory does.
    """
    engine, noise = flown
    values = engine.model.bare_values
    noise = replace(noise, prior={})
    axes = ["moment_xy", "memory_moment_xy"]
    best = fit_noise(engine, values, noise, axes, 30, 0.01)
    longer = {axes[0]: 2.0 * best.level(axes[0]), axes[1]: 4.0 * best.level(axes[1])}
    found = fit_noise(engine, values, best.with_levels(longer), axes, 12, 0.1)
    assert found.level(axes[1]) == pytest.approx(best.level(axes[1]), rel=0.2)
    likelihoods = [engine.log_likelihood(values, of) for of in (found, best)]
    assert likelihoods[0] > likelihoods[1] - 0.5


def test_apart_each_level_promises_what_it_alone_does():
    one = coupled()
    alone = one.apart()
    own = np.array([*np.diag(SCATTER), 16.0])[[0, 2, 1]]
    np.testing.assert_allclose(alone.predicted_gains(), 0.5 * one.slope**2 / own)
    assert list(coupled(slope=np.array([0.0, 0.0, 20.0])).apart().asking()) == [2]


def test_where_much_is_coloured_each_level_is_moved_alone(monkeypatch, flown):
    """Along the valley less is promised then, and levels stay that ask for more."""
    engine, noise = flown
    values = engine.model.bare_values
    axes = ["moment_xy", "memory_moment_xy"]
    best = fit_noise(engine, values, noise, axes, 30, 0.01)
    longer = {axes[0]: 2.0 * best.level(axes[0]), axes[1]: 4.0 * best.level(axes[1])}
    there = best.with_levels(longer)
    first = noise_fits._Point.at(engine, values, there, axes)
    between = first.predicted_gains().sum(), first.apart().predicted_gains().sum()
    assert between[0] > 1.2 * between[1]
    tolerance = sum(between) / 2.0
    assert fit_noise(engine, values, there, axes, 12, tolerance) is not there
    monkeypatch.setattr(noise_fits, "is_much_coloured", lambda passes, channels: True)
    assert fit_noise(engine, values, there, axes, 12, tolerance) is there


def test_a_prior_is_normal_in_the_logarithm():
    """Its value, slope and information; a level without one has none."""
    noise = Noise({"a": 2.0, "b": 0.5}, {}, prior={"a": (1.0, 0.7)})
    value, slope, information = noise_fits._log_prior(noise, ["a", "b"])
    away = np.log(2.0)
    assert value == pytest.approx(-0.5 * (away / 0.7) ** 2)
    np.testing.assert_allclose(slope, [-away / 0.49, 0.0])
    np.testing.assert_allclose(information, [1.0 / 0.49, 0.0])


class Climb:
    """Points whose ratio is (best / level)^power, evaluated so many times."""

    def __init__(self, monkeypatch, best: float, falls: bool = False) -> None:
        self.asked: list[float] = []

        def moved(own: noise_fits._Point, engine: object, values: object, logs: np.ndarray):
            self.asked.append(float(np.exp(logs[0])))
            value = own.value + (-1.0 if falls else 1.0)
            ratio = np.array([(best / np.exp(logs[0])) ** 2.0])
            return replace(own, logs=np.array(logs), value=value, ratio=ratio)

        monkeypatch.setattr(noise_fits._Point, "moved", moved)
        self.begin = replace(
            point().only(np.array([0])), lower=np.array([-20.0]), upper=np.array([20.0]),
            ratio=np.array([best**2.0]),
        )  # fmt: skip

    def climbed(self, evaluations: int = 16) -> tuple[float, int]:
        there, left = noise_fits._from_afar(None, {}, self.begin, evaluations)
        return float(np.exp(there.logs[0])), left


def test_from_afar_a_variance_is_taken_times_what_is_shown_of_it(monkeypatch):
    """A level 9 times too small is right after one step; none where it asks for less than e^0.4."""
    near = Climb(monkeypatch, 9.0)
    assert near.climbed() == (pytest.approx(9.0), 15)
    assert near.asked == [pytest.approx(9.0)]
    for factor, steps in ((1.45, 0), (1.55, 1), (1.0 / 1.45, 0), (1.0 / 1.55, 1)):
        small = Climb(monkeypatch, factor)
        small.climbed()
        assert len(small.asked) == steps, factor
    far = Climb(monkeypatch, 1e3)
    assert far.climbed() == (pytest.approx(1e3), 13)
    np.testing.assert_allclose(far.asked, [np.exp(3.0), np.exp(6.0), 1e3])
    assert Climb(monkeypatch, 1e3).climbed(2)[1] == 0
    worse = Climb(monkeypatch, 9.0, falls=True)
    assert worse.climbed() == (pytest.approx(1.0), 15)


def test_levels_that_ask_for_nothing_stay(flown):
    """Only those that promise something are moved; no fit where all of them promise too little."""
    engine, noise = flown
    values = engine.model.bare_values
    first = noise_fits._Point.at(engine, values, noise, ["p", "q", "force_xy"])
    assert fit_noise(engine, values, noise, ["p", "q"], tolerance=1e6) is noise
    loud = noise.with_levels({"p": 4.0 * noise.reading["p"]})
    assert noise_fits._Point.at(engine, values, loud, ["p"]).ratio[0] < 0.5
    found = fit_noise(engine, values, replace(loud, prior={}), ["p"], evaluations=6)
    assert found.reading["p"] == pytest.approx(noise.reading["p"], rel=0.2)
    assert found.process == loud.process
    assert noise_fits._Point.at(engine, values, noise, []).predicted_gains().size == 0
    np.testing.assert_allclose(first.lower[0], np.log(noise.floor["p"]))
    np.testing.assert_allclose(first.upper[0], np.log(noise.ceiling["p"]))
