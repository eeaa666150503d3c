"""Fits of a problem: what is handed to the fit of the noise, and what is done to it by hand."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env.diagnosis import evidence, fits
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.helicopter_noise import (
    LATENT_START,
    MEMORIES,
    TRIM_LEVELS,
    WHITE_LEVELS,
)
from coax_env.estimation.state_space import Noise
from coax_env.model.effect_registry import GUST_MEMORY

GUSTS = {"force_xy": 0.3, "force_z": 0.2, "moment_xy": 5e-3, "moment_z": 2e-3}
FLOOR = {**dict.fromkeys(WHITE_LEVELS, 1e-6), **dict.fromkeys(TRIM_LEVELS, 1e-7)}


def noise(**levels: float) -> Noise:
    """Gusts of usual memory, all else at its floor, but for what is given."""
    process = {**GUSTS, **dict.fromkeys(MEMORIES, GUST_MEMORY), **FLOOR}
    return Noise({**process, **levels}, {"p": 0.01}, FLOOR)


# --- white noise and drifts -------------------------------------------------------------------------


@pytest.fixture
def asked(monkeypatch):
    """What `fit_noise` is called with, where the score asks for some levels; it gains so many nats."""
    seen: dict[str, Any] = {"scores": {}, "nats": 100.0}

    def fit_noise(engine: Any, values: Any, start: Noise, levels: Any, *rest: Any) -> Noise:
        seen["start"], seen["levels"] = start, levels
        return replace(start, process={**start.process, "fitted": 1.0})

    monkeypatch.setattr(fits, "fit_noise", fit_noise)
    monkeypatch.setattr(fits, "_score", lambda p, fit, score, name: seen["scores"].get(name, 0.0))
    return seen


def latent(seen: dict[str, Any], fit: Fit) -> Fit | None:
    engine = SimpleNamespace(
        noise_score=lambda values, noise: None,
        log_likelihood=lambda values, noise: seen["nats"] if "fitted" in noise.process else 0.0,
    )
    problem = SimpleNamespace(
        engine=engine, settings=SETTINGS, report=lambda text: None, noise_fit_seconds=60.0
    )
    return fits.with_latent_noise(problem, fit)


def test_latent_noise_begins_at_its_share_of_the_gusts(asked):
    """White noise at 0.2 s^1/2 of its own axes' gusts, a trim at 0.3 / s^1/2; the rest stays."""
    asked["scores"] = {"white_moment_xy": 2.1, "trim_force_z": 9.0, "white_force_z": 1.9}
    found = latent(asked, Fit((), {}, noise(), levels=("force_xy",)))
    assert found is not None and found.levels == ("force_xy", "white_moment_xy", "trim_force_z")
    assert asked["levels"] == found.levels
    expected = {"white_moment_xy": 0.2 * 5e-3, "trim_force_z": 0.3 * 0.2}
    assert asked["start"].process == pytest.approx({**noise().process, **expected})


def test_latent_noise_begins_above_its_floor(asked):
    """Where gusts are next to nothing: twice the floor, or its logarithm would have no slope."""
    asked["scores"] = {"white_force_xy": 3.0}
    found = latent(asked, Fit((), {}, noise(force_xy=1e-7)))
    assert found is not None
    assert asked["start"].process["white_force_xy"] == pytest.approx(2e-6)


def test_latent_noise_must_pay_more_than_a_tie_and_is_asked_for_once(asked):
    asked["scores"] = dict.fromkeys(LATENT_START, 50.0)
    fit = Fit((), {}, noise())
    for nats, there in ((SETTINGS.tie + 0.1, True), (SETTINGS.tie - 0.1, False)):
        asked["nats"] = nats
        assert (latent(asked, fit) is not None) == there
    asked["nats"] = 100.0
    assert latent(asked, replace(fit, levels=tuple(LATENT_START))) is None
    asked["scores"] = dict.fromkeys(LATENT_START, SETTINGS.latent_noise_score - 0.1)
    assert latent(asked, fit) is None


@pytest.mark.parametrize("slopes", [[1.0, 3.0, 2.0, 4.0], [-2.0, 1.0, 1.0]])
def test_a_levels_score_is_its_slope_over_the_scatter_from_block_to_block(monkeypatch, slopes):
    """A sum of n independent ones has a std of sqrt(n) times that of one."""
    monkeypatch.setattr(fits, "level_slopes", lambda *given: (np.array(slopes), 0.0))
    found = fits._score(SimpleNamespace(engine=None), Fit((), {}, noise()), None, "force_xy")
    mean = sum(slopes) / len(slopes)
    variance = sum((s - mean) ** 2 for s in slopes) / len(slopes)
    assert found == pytest.approx(sum(slopes) / math.sqrt(len(slopes) * variance))


# --- noise that takes up no change ------------------------------------------------------------------


def test_gusts_of_long_memory_get_a_short_one_and_shake_as_much_each_second():
    """2 sigma^2 / T is what a gust is driven with; short memories stay as they are."""
    long = {"memory_force_xy": 9.0 * GUST_MEMORY, "memory_moment_z@B": 4.0 * GUST_MEMORY}
    there = noise(**long, **{"moment_z@B": 1e-3, "memory_force_z": 0.5 * GUST_MEMORY})
    found = fits.short_memories(there)
    assert found.process["force_xy"] == pytest.approx(GUSTS["force_xy"] / 3.0)
    assert found.process["moment_z@B"] == pytest.approx(0.5e-3)
    assert found.process["memory_force_xy"] == found.process["memory_moment_z@B"] == GUST_MEMORY
    same = set(there.process) - {*long, "force_xy", "moment_z@B"}
    assert {n: found.process[n] for n in same} == {n: there.process[n] for n in same}


def test_without_drifts_trims_stand_at_their_floor_and_are_not_fitted():
    there = Fit((), {"mass": 0.4}, noise(trim_force_z=0.1), levels=("force_xy", "trim_force_z"))
    found = fits.without_drifts(there)
    assert found.levels == ("force_xy",) and found.values == there.values
    assert found.noise.process == noise().process


@pytest.mark.parametrize("short", [True, False])
def test_noise_that_took_up_a_push_is_fitted_again_from_steady_noise(monkeypatch, short):
    """The likelier of the two ends is kept; noise that is steady as it is asks for no second fit."""
    there = Fit((), {}, noise(memory_force_z=7.7, force_z=0.6), 0.0)
    monkeypatch.setattr(fits, "noise_fitted", lambda problem, fit: fit)

    def fitted(problem: None, fit: Fit) -> Fit:
        is_short = fit.noise.process["memory_force_z"] == GUST_MEMORY
        return replace(fit, objective=-30.0 if is_short == short else -10.0)

    monkeypatch.setattr(fits, "fitted", fitted)
    found = fits.steadied(None, there)  # type: ignore[arg-type]
    assert found.objective == -30.0
    assert found.noise.process["memory_force_z"] == (GUST_MEMORY if short else 7.7)
    steady = Fit((), {}, noise(), 0.0)
    assert fits.steadied(None, steady) is steady  # type: ignore[arg-type]


# --- turns until nothing is gained --------------------------------------------------------------------


@pytest.mark.parametrize(("gains", "turns"), [((5.0, 1.0, 9.0), 2), ((5.0, 2.5, 0.0), 3)])
def test_noise_and_numbers_are_fitted_by_turns_until_a_turn_gains_little(monkeypatch, gains, turns):
    """Less than a step's gain, 2 nats, ends it; every turn is one of both on all of the flight."""
    left = list(gains)

    def fitted(problem: Any, fit: Fit, steps: int = 3, held: Any = ()) -> Fit:
        assert steps == 1 and held == ("mass",)
        return replace(fit, objective=fit.objective - left.pop(0))

    monkeypatch.setattr(fits, "fitted", fitted)
    seconds = []
    monkeypatch.setattr(
        fits, "noise_fitted", lambda problem, fit, given: seconds.append(given) or fit
    )
    problem = SimpleNamespace(settings=SETTINGS)
    found = fits.converged(problem, Fit((), {}, noise(), objective=50.0), ("mass",))
    assert seconds == [math.inf] * turns and len(gains) - len(left) == turns
    assert found.objective == 50.0 - sum(gains[:turns])


@pytest.mark.parametrize(
    ("seconds", "slow", "promised"),
    [(math.inf, True, 0.2), (math.inf, False, 2.0), (None, True, 2.0), (90.0, True, 2.0)],
)
def test_on_all_of_a_flight_with_slow_rows_noise_is_fitted_where_less_is_promised(
    monkeypatch, seconds, slow, promised
):
    """A fifth of a nat; else what a step of the numbers must gain."""
    asked: list[tuple[float, float]] = []

    def fit_noise(*given: Any, tolerance: float, seconds: float, **other: Any) -> Noise:
        asked.append((tolerance, seconds))
        return noise()

    monkeypatch.setattr(fits, "fit_noise", fit_noise)
    problem: Any = SimpleNamespace(
        settings=SETTINGS, engine=None, noise_fit_seconds=60.0, has_slow_rows=slow
    )
    fits.noise_fitted(problem, Fit((), {}, noise()), seconds)
    assert asked == [(promised, 60.0 if seconds is None else seconds)]


@pytest.mark.parametrize(
    ("slow", "poses", "memory", "coloured", "hides"),
    [
        (True, False, 0.5, False, True),
        (True, False, 0.5, True, False),
        (False, True, 0.5, False, True),
        (False, True, 0.5, True, False),
        (False, False, 0.5, False, False),
        (False, False, 1.9, False, False),
        (False, False, 2.1, False, True),
        (False, False, 2.1, True, False),
    ],
)
def test_noise_may_hide_what_acts_between_slow_rows_by_poses_alone_or_in_gusts_that_last(
    monkeypatch, slow, poses, memory, coloured, hides
):
    """But not where a model lacks much."""
    monkeypatch.setattr(fits, "is_much_coloured", lambda problem, fit: coloured)
    problem: Any = SimpleNamespace(has_slow_rows=slow, sees_poses_alone=poses)
    of_flights, of_parts = (
        replace(noise(), process={**noise().process, f"memory_force_z{part}": memory})
        for part in ("", "@late")
    )
    assert fits.noise_may_hide(problem, Fit((), {}, of_flights)) == hides
    assert fits.gusts_last(of_parts) == (memory > 2.0)


# --- what a cause is worth ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("factor", "lost", "foretold", "close"),
    [
        (1.0, 139.0, 139.0, True),
        (1.0, 141.0, 139.0, False),
        (3.0, 300.0, 300.0, True),
        (1.0, 2000.0, 1001.0, False),
        (1.0, 2000.0, 999.0, True),  # it lost far more than was foretold: it has not converged
    ],
)
def test_evidence_is_what_a_refit_without_it_loses_over_the_inflation(
    monkeypatch, factor, lost, foretold, close
):
    """Within ten thresholds the refit goes on until it has converged, a nat less here."""
    monkeypatch.setattr(evidence, "loss", lambda *given: foretold)
    monkeypatch.setattr(evidence, "inflation", lambda *given: factor)
    monkeypatch.setattr(evidence, "without", lambda problem, fit, quadratic, effect: fit)
    monkeypatch.setattr(evidence, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(
        evidence, "fitted", lambda problem, fit, steps, held: replace(fit, objective=1000.0 + lost)
    )
    monkeypatch.setattr(
        evidence, "converged", lambda problem, fit, held: replace(fit, objective=999.0 + lost)
    )
    problem = SimpleNamespace(
        sees_poses_alone=False, answers_unseen=False,
        settings=SETTINGS, file_values=lambda effect: {},
        for_each=lambda work, of: {e: work(e) for e in of},
    )  # fmt: skip
    weighed = evidence.weigh(
        problem, Fit(("wind",), {}, noise(), objective=1000.0), None, ("wind",)
    )
    found = weighed["wind"].evidence
    assert found.lost == lost - close
    assert found.nats == pytest.approx((lost - close) / factor)
