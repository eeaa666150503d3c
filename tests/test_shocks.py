"""Gusts that come in shocks: what is known of the kurtosis of a few distributions."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from study import arms
from study.one_flight import hide

from coax_env.diagnosis.diagnose import diagnose
from coax_env.diagnosis.settings import SETTINGS
from coax_env.diagnosis.shocks import gust_kurtosis, only_shock
from coax_env.estimation.helicopter_noise import GUST_LEVELS
from coax_env.estimation.state_space import Noise
from coax_env.model.layout import GUSTS, N_FULL

DT = 0.01


def flown(increments: np.ndarray, level: float = 0.2, own_air: bool = False) -> tuple[Any, Any]:
    """Of two runs, the first of 100 s, whose gusts move so from tenth to tenth of a second."""
    cut = [increments[:1000], increments[1000:]]
    states = [np.zeros((10 * (len(own) + 1), N_FULL)) for own in cut]
    for own, there in zip(cut, states, strict=True):
        walk = np.concatenate([np.zeros((1, own.shape[1])), np.cumsum(own, axis=0)])
        there[:, GUSTS] = np.repeat(walk, 10, axis=0)
    records = [
        SimpleNamespace(
            t=5.0 + DT * np.arange(len(there)), whole=name, air={"force_xy": 1.0} if own_air else {}
        )
        for there, name in zip(states, "ab", strict=True)
    ]
    passes = [SimpleNamespace(states=there) for there in states]
    engine = SimpleNamespace(records=records, filter=lambda values, noise: passes)
    noise = Noise(dict.fromkeys(GUST_LEVELS, level), floor=dict.fromkeys(GUST_LEVELS, 0.01))
    problem = SimpleNamespace(engine=engine, row=DT, settings=SETTINGS)
    return problem, SimpleNamespace(values={}, noise=noise)


def fitted(increments: np.ndarray, level: float = 0.2) -> float:
    return gust_kurtosis(*flown(increments, level))


def draw(kind: str) -> np.ndarray:
    return getattr(np.random.default_rng(3), kind)(size=(20_000, 6))


def test_the_kurtosis_is_that_of_the_distribution() -> None:
    assert fitted(draw("normal")) == pytest.approx(0.0, abs=0.2)
    assert fitted(draw("laplace")) == pytest.approx(3.0, rel=0.25)


def test_one_axis_in_shocks_is_enough() -> None:
    increments = draw("normal")
    increments[::500, 4] *= 20.0
    assert fitted(increments) > 10.0 * SETTINGS.shocks


def test_a_rough_run_is_no_shock_where_each_has_air_of_its_own() -> None:
    """The first of two runs, a twentieth of all, is shaken five times as much: a mixture."""
    increments = draw("normal")
    increments[:1000] *= 5.0
    share, rough = 0.05, 25.0
    mixed = 3.0 * (1.0 + share * (rough**2 - 1.0)) / (1.0 + share * (rough - 1.0)) ** 2 - 3.0
    assert fitted(increments) == pytest.approx(mixed, rel=0.1)
    assert gust_kurtosis(*flown(increments, own_air=True)) == pytest.approx(0.0, abs=0.2)
    increments[7_000, 2] = 60.0
    assert gust_kurtosis(*flown(increments, own_air=True)) > 10.0 * SETTINGS.shocks


def test_the_only_shock_is_where_the_jump_was() -> None:
    increments = draw("normal")
    increments[7_000:7_003, 2] = 40.0, 25.0, -25.0
    assert fitted(increments) > 10.0 * SETTINGS.shocks
    shock = only_shock(*flown(increments))
    assert shock is not None and shock.run == "b"
    assert shock.t == pytest.approx(5.0 + 0.1 * (7_000 - 1_000), abs=0.11)
    increments[12_000, 5] = 40.0
    assert only_shock(*flown(increments)) is None, "there are two"


def test_gusts_at_their_floor_are_none() -> None:
    assert fitted(draw("standard_cauchy"), level=0.01) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "kind", "number"),
    [
        ("one_minus_cosine", "clean", 0),  # a rate damping without strengths
        ("heavy_tails", "two", 0),
    ],
)
def test_with_strengths_nothing_is_sure_that_is_not_there(arm, kind, number, tmp_path):
    """Gusts of another form than the filter's, in closed loop, by other code."""
    flight = arms.planned(arm, kind, number, 52)
    flight = replace(flight, runs=flight.runs[:4], longest=6.0)
    hidden = set(hide(flight, tmp_path / "flight")["hidden"])
    found = diagnose(tmp_path / "flight").findings["causes"]
    sure = {c["effect"] for c in found if c["trust"] == "sure"}
    assert sure <= hidden and bool(sure) == bool(found) == bool(hidden)
