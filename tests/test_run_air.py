"""Air of each run's own: what the engine makes of it, when it is asked for, what is named then."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import injector
import numpy as np
import pytest
from bundled_flight import bundled
from injector_air import Air
from injector_craft import COAX
from numpy.testing import assert_allclose
from study.plan import RICH
from test_estimation import NOISE, TRUTH, Pendulum, swing

from coax_env import diagnose, load_vehicle
from coax_env.diagnosis import run_air as asking
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation import run_air
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import AXES, MEMORIES, starting_noise
from coax_env.estimation.noise_levels import level_slopes
from coax_env.estimation.prediction import replay_runs
from coax_env.estimation.run_air import (
    APART,
    SPREAD,
    gain_promised,
    in_own_air,
    strength_and_memory,
    unlikely,
)
from coax_env.estimation.state_space import Noise, Record, part

LAMA = load_vehicle("lama400d")
MODEL = HeliModel(LAMA)
VALUES = MODEL.bare_values
OWN = {"force_xy": 2.0, "moment_z": 0.5, "memory_force_xy": 0.2, "memory_moment_z": 3.0}
FREE = [f for f in MODEL.base_parameters() if f.name in ("mass", "inertia_zz")]


@cache
def flown() -> tuple[Record, Record, Noise]:
    """Two pieces of a run of the bundled flight, and noise for it."""
    record, t = record_of(bundled().runs[0]), bundled().runs[0].t
    pieces = [part(record, (t >= t[0] + since) & (t < t[0] + since + 3.0)) for since in (0.0, 4.0)]
    return pieces[0], pieces[1], starting_noise(bundled(), LAMA)


def test_a_run_in_its_own_air_is_filtered_as_with_these_levels():
    """Everything that is asked of both runs is the sum of what each is with noise of its own."""
    rough, calm, noise = flown()
    rough = replace(rough, air=OWN)
    both = Engine(MODEL, [rough, calm])
    levels = noise.with_levels({name: f * noise.level(name) for name, f in OWN.items()})
    alone = [(Engine(MODEL, [replace(rough, air={})]), levels), (Engine(MODEL, [calm]), noise)]
    apart = [engine.log_likelihood(VALUES, own) for engine, own in alone]
    assert both.log_likelihood(VALUES, noise) == pytest.approx(sum(apart), rel=1e-12)
    assert abs(apart[0] - Engine(MODEL, [calm]).log_likelihood(VALUES, noise)) > 1.0
    _, lin = both.linearise(VALUES, noise, FREE)
    for i, (engine, own) in enumerate(alone):
        _, one = engine.linearise(VALUES, own, FREE)
        assert_allclose(lin.information[i], one.information[0], rtol=1e-12)
        assert_allclose(lin.slope[i], one.slope[0], rtol=1e-12)
    heavier = {**VALUES, "mass": 1.05 * VALUES["mass"]}
    passes = both.filter(VALUES, noise, keep=True)
    costs = [
        engine.frozen_cost(engine.filter(VALUES, own, keep=True), (), heavier, own)
        for engine, own in alone
    ]
    assert both.frozen_cost(passes, (), heavier, noise) == pytest.approx(sum(costs), rel=1e-12)
    (ours,) = replay_runs(both, VALUES, noise)  # of two pieces of one run
    theirs = [replay_runs(engine, VALUES, own)[0].channels["h"] for engine, own in alone]
    decaying = np.concatenate([piece.error_decaying for piece in theirs])
    assert_allclose(ours.channels["h"].error_decaying, decaying, rtol=1e-12)


@pytest.mark.parametrize("name", ["force_xy", "moment_z", "memory_force_xy", "memory_moment_z"])
def test_slopes_in_common_levels_are_the_gradient_of_the_likelihood(name):
    """Where each run is a multiple of them. Those in memories are as good as without (to a tenth)."""
    rough, calm, noise = flown()
    engine = Engine(MODEL, [replace(rough, air=OWN), calm])
    parts, _ = level_slopes(engine, VALUES, noise, name, engine.noise_score(VALUES, noise))
    sides = [
        engine.log_likelihood(VALUES, noise.with_levels({name: noise.level(name) * math.exp(h)}))
        for h in (0.02, -0.02)
    ]
    slope = (sides[0] - sides[1]) / 0.04
    assert float(parts.sum()) == pytest.approx(slope, rel=0.1, abs=0.2)


def in_air(strengths: list[float]) -> list[Record]:
    """Pendulums each of which is shaken so many times as much as is common."""
    shaken = [
        replace(NOISE, process={"torque": strength * NOISE.process["torque"]})
        for strength in strengths
    ]
    return [replace(swing(k, noise=noise), name=f"{k}") for k, noise in enumerate(shaken)]


def test_strengths_are_found_run_by_run():
    strengths = [0.3, 1.0, 3.0, 1.0]
    engine = Engine(Pendulum(), in_air(strengths))
    found = [r.air["torque"] for r in in_own_air(engine, TRUTH, NOISE, ["torque"])]
    assert_allclose(np.log(found), np.log(strengths), atol=0.25)  # of 500 rows each


def test_they_are_promised_where_they_are_and_not_by_chance():
    """By chance the promise is 0 in the mean: over 20 flights of 6 runs."""
    apart = Engine(Pendulum(), in_air([0.3, 1.0, 3.0, 1.0] * 3))
    assert gain_promised(apart, TRUTH, NOISE, ["torque"]) > SETTINGS.evidence
    by_chance = []
    for flight in range(20):
        runs = [replace(swing(100 + 6 * flight + k), name=f"{k}") for k in range(6)]
        by_chance.append(gain_promised(Engine(Pendulum(), runs), TRUTH, NOISE, ["torque"]))
    assert max(by_chance) < SETTINGS.evidence and abs(np.mean(by_chance)) < 1.0


def test_a_run_is_as_unlikely_as_its_levels_are_far_from_common_and_from_each_other():
    """By hand: the median of three strengths, and each strength about it."""
    air = {"force_xy": 2.0, "force_z": 2.0, "moment_z": 4.0, "memory_force_xy": 0.5}
    assert strength_and_memory(air) == pytest.approx((2.0, 0.5))
    two = math.log(2.0) ** 2
    by_hand = 0.5 * (2.0 * two / SPREAD**2 + two / APART**2)
    assert unlikely([replace(flown()[0], air=air), flown()[1]]) == pytest.approx(by_hand)
    assert strength_and_memory({}) == (1.0, 1.0)


def test_the_levels_of_a_run_are_drawn_to_those_of_its_kind(monkeypatch):
    """Of 3 s, in which little is known of each; the more the nearer they are believed to be."""
    _, calm, noise = flown()
    scatter = []
    for apart in (0.02, APART, 5.0):
        monkeypatch.setattr(run_air, "APART", apart)
        (found,) = in_own_air(Engine(MODEL, [calm]), VALUES, noise, (*AXES, *MEMORIES))
        scatter.append(
            [np.std([math.log(found.air[n]) for n in kind]) for kind in (AXES, MEMORIES)]
        )
    assert np.all(np.diff(scatter, axis=0) > 0.0) and np.max(scatter[0]) < 0.1


@pytest.mark.parametrize(
    ("factors", "gained", "used"),
    [
        ((4.0, 0.25), 100.0, True),
        ((4.0, 0.25), 17.0, False),
        ((1.2, 0.9), 100.0, False),  # too near to each other to be another air
    ],
)
def test_it_must_be_worth_its_numbers_beside_the_threshold(monkeypatch, factors, gained, used):
    """Two runs with a level each, four times the common one and a quarter: 14 + 2 + 1.9 nats."""
    rough, calm, _ = flown()
    noise = Noise({"force_xy": 1.0, **dict.fromkeys((*AXES[1:], *MEMORIES), 1e-9)},
                  floor=dict.fromkeys((*AXES[1:], *MEMORIES), 1e-9))  # fmt: skip

    def on(records):
        engine = SimpleNamespace(records=records)
        return SimpleNamespace(engine=engine, settings=SETTINGS, report=lambda text: None,
                               with_records=on)  # fmt: skip

    def found(engine, values, noise, levels):
        assert set(levels) == {"force_xy", "memory_force_xy"}, "axes without gusts have none"
        both = zip(engine.records, factors, strict=True)
        return [replace(record, air={"force_xy": factor}) for record, factor in both]

    monkeypatch.setattr(asking, "in_own_air", found)
    monkeypatch.setattr(asking, "gain_promised", lambda *of: 50.0)
    monkeypatch.setattr(asking, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(
        asking, "fitted", lambda problem, fit: replace(fit, objective=500.0 - gained)
    )
    fit = Fit((), {}, noise, objective=500.0)
    own = asking.with_own_air(on([rough, calm]), fit)
    assert (own is not None) == used
    assert asking.with_own_air(on([rough]), fit) is None, "of one run there is nothing to compare"
    if own is not None:
        assert asking.with_own_air(own[0], fit) is None, "known already"
        monkeypatch.setattr(asking, "gain_promised", lambda *of: 1.0)
        assert asking.with_own_air(on([rough, calm]), fit) is None


@pytest.mark.slow
def test_nothing_is_named_where_runs_are_flown_on_several_days(tmp_path):
    """By poses alone, gusts of a quarter to twice the strength and other memories. **Synthetic**."""
    air = Air("days", force=0.18, moment_xy=0.0055, moment_z=0.0028, memory=(0.07, 1.1))
    injector.fly(
        tmp_path, {}, gusts=air, sensors="pose", seed=12, runs=RICH[:5], longest=8.0, craft=COAX
    )
    found = diagnose(tmp_path)
    assert found.findings["causes"] == []
    assert any(line.startswith("each run has air of its own") for line in found.remarks)
