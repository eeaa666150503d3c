"""The final refinement on a likelihood that is known: a Gaussian that signatures do not quite show.

The engine is a stand-in whose likelihood is written down here, with a slope and a curvature that its
own linearisation lacks, as a filter's gains make them; the best and its std follow by hand.
"""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env.diagnosis import refinement
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation import rough_numbers
from coax_env.estimation.engine import Estimate
from coax_env.estimation.quadratic import Linearised, Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.identification.maximum_likelihood import OwnNumbers, over_roughness

NAMES = ("mass", "gyro_bias.x", "gyro_bias.y")
PRIOR = np.array([0.5, 2.0, 2.0])
NOISE = Noise({"force": 1.0})


@dataclass
class Made:
    """An engine with log L = -(x - best)' curvature (x - best) / 2.

    Its linearisation has another information, and a slope that is off by `beyond`.
    """

    best: np.ndarray
    curvature: np.ndarray
    information: np.ndarray
    beyond: np.ndarray
    model: Any = None
    filtered: int = 0

    def at(self, values: dict[str, float]) -> np.ndarray:
        return np.array([values[n] for n in NAMES]) - self.best

    def filter(self, values: dict[str, float], noise: Noise) -> list[SimpleNamespace]:
        self.filtered += 1
        away = self.at(values)
        return [SimpleNamespace(log_likelihood=-0.5 * away @ self.curvature @ away)]

    def linearise(
        self, values: dict[str, float], noise: Noise, free: Any, gains: bool = True
    ) -> tuple[Any, Linearised]:
        slope = self.curvature @ self.at(values) - self.beyond
        lin = Linearised(
            NAMES, self.information[None], slope[None], np.ones((1, 3, 1)), slope[None]
        )  # fmt: skip
        return self.filter(values, noise), lin


def problem(
    curvature: np.ndarray,
    information: np.ndarray | None = None,
    beyond: tuple[float, float, float] = (0.0, 0.0, 0.0),
    upper: float = np.inf,
) -> tuple[Problem, Fit, np.ndarray]:
    """A problem with one base number and one effect of two, the fit at nothing, and its optimum."""
    best = np.array([0.3, -0.8, 0.6])
    engine = Made(best, curvature, curvature if information is None else information,
                  np.array(beyond))  # fmt: skip
    engine.model = SimpleNamespace(channels=("p",), moments={})
    free = [FreeParameter(n, 0.0, s) for n, s in zip(NAMES, PRIOR, strict=True)]
    free[2] = replace(free[2], upper=upper)
    made = Problem(engine.model, engine, (free[0],), {"gyro_bias": tuple(free[1:])})
    fit = Fit(("gyro_bias",), dict.fromkeys(NAMES, 0.0), NOISE)
    posterior = curvature + np.diag(PRIOR**-2.0)
    return made, fit, np.linalg.solve(posterior, curvature @ best)


@pytest.fixture(autouse=True)
def white(monkeypatch):
    monkeypatch.setattr(refinement, "is_white", lambda passes, channels: True)


CURVATURE = np.array([[30.0, 8.0, 0.0], [8.0, 50.0, -10.0], [0.0, -10.0, 40.0]])


def at(values: dict[str, float]) -> np.ndarray:
    return np.array([values[n] for n in NAMES])


def cost(made: Problem, values: dict[str, float]) -> float:
    gap = 0.5 * np.sum((at(values) / PRIOR) ** 2)
    return float(gap - made.engine.filter(values, NOISE)[0].log_likelihood)


def test_a_slope_that_signatures_lack_is_found():
    """What the gains do to the likelihood is in its differences: the fit ends at the true optimum."""
    made, fit, optimum = problem(CURVATURE, beyond=(0.0, 6.0, -4.0))
    found = refinement.refined(made, fit)
    std = np.sqrt(np.diag(np.linalg.inv(CURVATURE + np.diag(PRIOR**-2.0))))
    assert np.abs(at(found.values) - optimum).max() < 0.01 * std.min()
    assert found.objective == pytest.approx(cost(made, found.values), abs=1e-9)
    assert found.std_ratio == pytest.approx(dict.fromkeys(NAMES[1:], 1.0), rel=1e-6)


def test_one_whose_number_stands_at_its_bound_too():
    """There the difference is taken to one side, and says nothing of the curvature."""
    apart = CURVATURE.copy()
    apart[1, 2] = apart[2, 1] = 0.0
    made, fit, optimum = problem(apart, beyond=(0.0, 5.0, 0.0), upper=0.0)
    found = refinement.refined(made, fit)
    assert found.values["gyro_bias.y"] == 0.0
    np.testing.assert_allclose(at(found.values)[:2], optimum[:2], atol=2e-3)
    assert set(found.std_ratio) == {"gyro_bias.x"}


@pytest.mark.parametrize("share", [0.5, 2.0, 30.0])
def test_the_std_is_that_of_the_likelihoods_own_curvature(share):
    """Signatures of `share` times the information: intervals sqrt(share) too narrow, within bounds."""
    scaled = np.array([1.0, 5.0, 5.0])
    prior = np.diag(PRIOR**-2.0)
    own = 100.0 * np.diag(scaled)
    made, fit, _ = problem(own, share * own)
    found = refinement.refined(made, fit)
    ratio = (share * own + prior)[1, 1] / (own + prior)[1, 1]
    expected = np.clip(np.sqrt(ratio), *SETTINGS.std_ratio_bounds)
    for name in NAMES[1:]:
        assert found.std_ratio[name] == pytest.approx(expected, rel=1e-3)


def test_steps_go_on_until_they_gain_nothing():
    """Signatures of 1.6 times the information go 5/8 of the way: 3/8 to the fourth is left, or less.

    Where the first step arrives, no second one is taken but to see that it gains nothing.
    """
    made, fit, optimum = problem(CURVATURE, 1.6 * CURVATURE)
    found = refinement.refined(made, fit)
    left = (at(found.values) - optimum) / (at(fit.values) - optimum)
    assert np.abs(left).max() < 0.03
    assert found.objective == pytest.approx(cost(made, found.values), abs=1e-9)
    there, _, _ = problem(CURVATURE)
    refinement.refined(there, fit)
    assert there.engine.filtered < made.engine.filtered


def test_coloured_innovations_leave_the_slope_alone(monkeypatch):
    """Then the gains are not those of the true noise: the fit with the gains held is all there is."""
    monkeypatch.setattr(refinement, "is_white", lambda passes, channels: False)
    asked = []
    monkeypatch.setattr(refinement, "fitted", lambda *given: asked.append(given) or given[1])
    made, fit, _ = problem(CURVATURE)
    found = refinement.refined(made, replace(fit, std_ratio={"gyro_bias.x": 1.7}))
    assert len(asked) == 1 and found.std_ratio == {}


# --- the line search --------------------------------------------------------------------------------


def searched(move: float, curvature: float = 50.0) -> tuple[float, float, int]:
    """Where a move ends, as a share of the way to the optimum; its gain; how many filter passes."""
    made, fit, optimum = problem(curvature * np.eye(3))
    start = {**dict(zip(NAMES, optimum.tolist(), strict=True)), "gyro_bias.x": 0.0}
    fit = replace(fit.at(start), objective=cost(made, start))
    free = made.free(fit.active)
    _, lin = made.engine.linearise(fit.values, NOISE, free)
    quadratic = Quadratic.of(lin, free, fit.values)
    step = move * optimum[1] * np.array([0.0, 1.0, 0.0])
    made.engine.filtered = 0
    there, gained = refinement._line_search(made, fit, quadratic, free, step)
    assert gained == pytest.approx(fit.objective - cost(made, there.values))
    return there.values["gyro_bias.x"] / optimum[1], gained, made.engine.filtered - 1


def test_a_newton_step_on_a_parabola_is_taken_whole():
    share, gained, passes = searched(1.0)
    assert share == pytest.approx(1.0) and gained > 0.0 and passes == 1


def test_a_step_twice_too_long_and_more_is_shortened_once():
    """Past the parabola's other side nothing is gained; what gains then lies near the optimum."""
    share, gained, passes = searched(2.4)
    assert gained > 0.0 and passes == 2 and 0.5 < share < 1.5


def test_a_step_the_wrong_way_gains_nothing():
    _, gained, passes = searched(-1.0)
    assert gained < 0.0 and passes == 2


# --- a likelihood that is rough over less than a std ------------------------------------------------


@dataclass
class Rough(Made):
    """As `Made`, with waves along the second number: `height` nats, `length` from crest to crest."""

    height: float = 1.0
    length: float = 0.05

    def filter(self, values: dict[str, float], noise: Noise) -> list[SimpleNamespace]:
        (smooth,) = super().filter(values, noise)
        wave = self.height * np.cos(2.0 * np.pi * values[NAMES[1]] / self.length)
        return [SimpleNamespace(log_likelihood=smooth.log_likelihood + wave)]


def rough(monkeypatch: pytest.MonkeyPatch, **waves: float) -> tuple[Problem, Fit, float, float]:
    """A problem whose signatures have nine times the information on a rough number of std 0.14."""
    monkeypatch.setattr(rough_numbers, "ROUGH", ("gyro_bias",))
    apart = np.diag([30.0, 50.0, 40.0])
    made, fit, optimum = problem(apart, np.diag([30.0, 450.0, 360.0]))
    engine = Rough(**{**vars(made.engine), **waves})
    made = replace(made, engine=engine)
    fit = replace(fit.at(dict(zip(NAMES, optimum.tolist(), strict=True))), std_ratio={})
    std = float((50.0 + PRIOR[1] ** -2.0) ** -0.5)
    return made, fit, float(optimum[1]), std


def std_of(found: Fit) -> float:
    """Of the rough number."""
    return found.std_ratio[NAMES[1]] * float((450.0 + PRIOR[1] ** -2.0) ** -0.5)


@pytest.mark.parametrize("white", [True, False])
def test_over_roughness_the_std_is_that_of_a_parabola(monkeypatch, white):
    """Waves of 0.3 nats have 60 times the curvature of what they stand on; coloured or not."""
    monkeypatch.setattr(refinement, "is_white", lambda passes, channels: white)
    monkeypatch.setattr(
        refinement, "fitted", lambda made, fit, *limits: replace(fit, objective=0.0)
    )
    made, fit, _, std = rough(monkeypatch, height=0.3, length=0.02)
    assert std_of(refinement.refined(made, fit)) == pytest.approx(std, rel=0.25)


@pytest.mark.parametrize("off", [-2.0, 1.3, 2.4])
def test_a_fit_that_is_stuck_in_roughness_leaves_for_what_is_likelier(monkeypatch, off):
    """From so many std beside the top, on a crest; it ends within a wave and a third of a std of it."""
    made, fit, top, std = rough(monkeypatch, height=0.2, length=0.03)
    start = round((top + off * std) / 0.03) * 0.03
    found = refinement._over_roughness(made, fit.at({NAMES[1]: start}))
    assert abs(found.values[NAMES[1]] - top) < 0.33 * std + 0.03
    assert found.objective == pytest.approx(cost(made, found.values), abs=1e-9)
    assert std_of(found) == pytest.approx(std, rel=0.4)


def test_a_fit_that_stays_on_a_spike_is_as_unsure_as_the_top_is_far(monkeypatch):
    """A spike of 3 nats, narrower than any step: the likeliest place of all, 1.5 std off."""
    made, fit, top, std = rough(monkeypatch, height=0.0)
    start = top + 1.5 * std
    plain = made.engine.filter

    def spiked(values: dict[str, float], noise: Noise) -> list[SimpleNamespace]:
        (smooth,) = plain(values, noise)
        on_it = abs(values[NAMES[1]] - start) < 1e-3 * std
        return [SimpleNamespace(log_likelihood=smooth.log_likelihood + 3.0 * on_it)]

    monkeypatch.setattr(made.engine, "filter", spiked)
    found = refinement._over_roughness(made, fit.at({NAMES[1]: start}))
    assert found.values[NAMES[1]] == start
    assert std_of(found) == pytest.approx(std * np.hypot(1.0, 1.5), rel=0.1)


def test_what_is_not_rough_is_left_as_it_was(monkeypatch):
    made, fit, _, _ = rough(monkeypatch)
    monkeypatch.setattr(rough_numbers, "ROUGH", ("servo_play",))
    assert refinement._over_roughness(made, fit) is fit


def test_an_identified_number_is_taken_over_roughness_too(monkeypatch):
    """Two std beside its top, with a third of its std: `identify` has what the diagnosis has."""
    made, fit, top, std = rough(monkeypatch, height=0.2, length=0.03)
    start = fit.at({NAMES[1]: round((top + 2.0 * std) / 0.03) * 0.03}).values
    free = made.free(fit.active)
    narrow = np.diag((np.array([30.0, 450.0, 360.0]) + PRIOR**-2.0) ** -1.0)
    estimate = Estimate(NAMES, start, narrow, 0.0, 0.0, 1, True)
    found = over_roughness(made.engine, OwnNumbers(list(free), estimate, NOISE, 1.0), start).estimate
    assert abs(found.values[NAMES[1]] - top) < 0.33 * std + 0.03
    assert found.std[NAMES[1]] == pytest.approx(std, rel=0.4)
    assert found.std[NAMES[0]] == estimate.std[NAMES[0]]
