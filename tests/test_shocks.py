"""Gusts that come in shocks: what is known of the kurtosis of a few distributions."""

from types import SimpleNamespace

import numpy as np
import pytest
from study import arms
from study.one_flight import hide

from coax_env.diagnosis.diagnose import diagnose
from coax_env.diagnosis.settings import SETTINGS
from coax_env.diagnosis.shocks import gust_kurtosis
from coax_env.estimation.helicopter_noise import GUST_LEVELS
from coax_env.estimation.state_space import Noise
from coax_env.model.layout import GUSTS, N_FULL

DT = 0.01


def fitted(increments: np.ndarray, level: float = 0.2, but_one: bool = False) -> float:
    """Of a flight whose gusts move so from tenth to tenth of a second, on one axis after the other."""
    states = np.zeros((10 * (len(increments) + 1), N_FULL))
    walk = np.concatenate([np.zeros((1, increments.shape[1])), np.cumsum(increments, axis=0)])
    states[:, GUSTS] = np.repeat(walk, 10, axis=0)
    record = SimpleNamespace(t=DT * np.arange(len(states)))
    engine = SimpleNamespace(
        records=[record], filter=lambda values, noise: [SimpleNamespace(states=states)]
    )
    noise = Noise(dict.fromkeys(GUST_LEVELS, level), floor=dict.fromkeys(GUST_LEVELS, 0.01))
    fit = SimpleNamespace(values={}, noise=noise)
    return gust_kurtosis(SimpleNamespace(engine=engine, row=DT), fit, but_one)


def draw(kind: str) -> np.ndarray:
    return getattr(np.random.default_rng(3), kind)(size=(20_000, 6))


def test_the_kurtosis_is_that_of_the_distribution() -> None:
    assert fitted(draw("normal")) == pytest.approx(0.0, abs=0.2)
    assert fitted(draw("laplace")) == pytest.approx(3.0, rel=0.25)


def test_one_axis_in_shocks_is_enough() -> None:
    increments = draw("normal")
    increments[::500, 4] *= 20.0
    assert fitted(increments) > 10.0 * SETTINGS.shocks


def test_one_jump_is_a_shock_and_none_without_its_moment() -> None:
    increments = draw("normal")
    increments[7_000:7_003, 2] = 40.0, 25.0, -25.0
    assert fitted(increments) > 10.0 * SETTINGS.shocks
    assert fitted(increments, but_one=True) == pytest.approx(0.0, abs=0.2)
    increments[12_000, 5] = 40.0
    assert fitted(increments, but_one=True) > 10.0 * SETTINGS.shocks


def test_gusts_at_their_floor_are_none() -> None:
    assert fitted(draw("standard_cauchy"), level=0.01) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "kind", "number"),
    [
        ("heavy_tails", "clean", 1),  # a servo delay and a gyro scale without strengths
        ("one_minus_cosine", "clean", 0),  # a rate damping
        ("heavy_tails", "three", 0),
    ],
)
def test_with_strengths_nothing_is_sure_that_is_not_there(arm, kind, number, tmp_path):
    """Gusts of another form than the filter's, in closed loop, by other code."""
    hidden = set(hide(arms.planned(arm, kind, number, 52), tmp_path / "flight")["hidden"])
    found = diagnose(tmp_path / "flight").findings["causes"]
    sure = {c["effect"] for c in found if c["trust"] == "sure"}
    assert sure <= hidden and bool(sure) == bool(found) == bool(hidden)
