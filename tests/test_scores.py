"""What effects are worth by a quadratic alone: evidences of Gaussians, integrated in closed form.

The quadratic is a random one over a real vehicle's numbers and a few effects of the catalogue; what a
set of parameters is worth is the integral of likelihood times prior over it, by determinants.
"""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.diagnosis import confounding, remarks
from coax_env.diagnosis.confounding import channels_of
from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.findings import mixtures_as_one
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.scores import (
    exchanges,
    gain_by_likelihood,
    inflation,
    is_large,
    loss,
    most_gains,
    score,
    scores,
    swap,
    threshold,
)
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.changing_model import BEFORE, before
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.helicopter_noise import WHITE_LEVELS
from coax_env.estimation.parted_engine import of_part
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Noise
from coax_env.model.effects import CATALOGUE
from coax_env.model.layout import CHANNELS

LAMA = load_vehicle("lama400d")
MODEL = HeliModel(LAMA)
BASE = ("mass", "inertia_zz", "swash_to_flap")
EFFECTS = ("gyro_bias", "swash_offset", "yaw_damping", "yaw_inertia", "swash_gain", "ground_effect")
NOISE = Noise({})


def problem(engine: Any = None) -> Problem:
    base = tuple(f for f in MODEL.base_parameters() if f.name in BASE)
    own = {e: tuple(MODEL.effect_parameters(e)) for e in EFFECTS}
    return Problem(MODEL, engine, base, own)


PROBLEM = problem()
FREE = PROBLEM.parameters
NAMES = tuple(f.name for f in FREE)
STD = np.array([f.std for f in FREE])
OFF = {f.name: f.value for f in FREE}


def quadratic(seed: int = 0, size: float = 2.0, **at: float) -> Quadratic:
    """A random one, without bounds, effects off unless told otherwise; slopes of `size` nats a std."""
    rng = np.random.default_rng(seed)
    k = len(NAMES)
    A = rng.standard_normal((k + 8, k)) * 1.5 / STD
    g = size * rng.standard_normal(k) / STD
    point = np.array([{**OFF, **at}[n] for n in NAMES])
    none = np.full(k, np.inf)
    return Quadratic(NAMES, A.T @ A, g, point, np.array([f.value for f in FREE]), STD**-2.0,
                     -none, none, rng.standard_normal((40, k)) / STD, np.ones((k, 18)))  # fmt: skip


def log_evidence(q: Quadratic, free: list[str], fixed: dict[str, float] | None = None) -> float:
    """log of the integral of likelihood times prior over `free`, others at their values."""
    x = np.zeros(len(NAMES))
    for name, value in (fixed or {}).items():
        x[NAMES.index(name)] = value - q.at[NAMES.index(name)]
    i = [NAMES.index(n) for n in free]
    away = q.at + x - q.mean
    held = 0.5 * x @ q.G @ x + q.g @ x + 0.5 * np.sum(q.precision * away**2)
    A = q.G[np.ix_(i, i)] + np.diag(q.precision[i])
    b = (q.g + q.G @ x + q.precision * away)[i]
    logs = np.linalg.slogdet(np.diag(q.precision[i]))[1] - np.linalg.slogdet(A)[1]
    return float(0.5 * b @ np.linalg.solve(A, b) - held + 0.5 * logs)


def own(effect: str) -> list[str]:
    return [n for n in NAMES if n.startswith(effect + ".")]


SIMPLE = ("gyro_bias", "swash_offset", "yaw_damping")


@pytest.mark.parametrize("active", [(), ("swash_offset",)])
@pytest.mark.parametrize("effect", ["gyro_bias", "yaw_damping"])
def test_a_score_is_the_log_of_the_ratio_of_two_evidences(effect, active):
    for seed in range(3):
        q = quadratic(seed)
        rest = [*BASE, *(n for e in active for n in own(e))]
        expected = log_evidence(q, rest + own(effect)) - log_evidence(q, rest)
        found = score(PROBLEM, q, active, effect)
        assert found.nats == pytest.approx(expected, abs=1e-9)
        assert found.evidence == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("effect", "base"), [("yaw_inertia", "inertia_zz"), ("swash_gain", "swash_to_flap")]
)
def test_what_replaces_a_number_is_weighed_against_that_number_in_the_file(effect, base):
    """Evidence: beside the file's value. Its score: what the objective gains over the fitted number."""
    q = replace(quadratic(1), at=quadratic(1).at * np.where(np.array(NAMES) == base, 1.1, 1.0))
    file = {base: LAMA[base].value}
    rest = [n for n in BASE if n != base]
    found = score(PROBLEM, q, (), effect)
    expected = log_evidence(q, rest + own(effect), file) - log_evidence(q, rest, file)
    assert found.evidence == pytest.approx(expected, abs=1e-9)
    assert found.nats == pytest.approx(q.best(BASE)[0] - q.best(rest + own(effect), file)[0])


def test_an_effect_loses_what_it_has_gained_and_a_swap_is_the_difference_of_two():
    q = quadratic(2)
    worth = {e: score(PROBLEM, q, (), e).nats for e in SIMPLE}
    for effect in SIMPLE:
        assert loss(PROBLEM, q, (effect,), effect, 1.0) == pytest.approx(worth[effect])
    for old, new in itertools.permutations(SIMPLE, 2):
        change, move = swap(PROBLEM, q, (old,), old, new)
        assert change == pytest.approx(worth[old] - worth[new])
        np.testing.assert_allclose(move, q.best([*BASE, *own(new)])[1], atol=1e-12)


@pytest.mark.parametrize("size", [2.0, 30.0, 2000.0])
def test_where_causes_explain_very_much_another_must_be_worth_more(size):
    """A form that is right to 1 % leaves 1e-4 of what it explains; usually the threshold is more."""
    q = quadratic(4, size=size)
    rest, both = [*BASE], [*BASE, *own("gyro_bias"), *own("swash_offset")]
    parts = (q.best([*rest, *own(other)])[0] for other in ("swash_offset", "gyro_bias"))
    explained = sum(parts) - 2.0 * q.best(both)[0]
    needed = max(SETTINGS.evidence, 1e-4 * explained)
    assert threshold(PROBLEM, q, ("gyro_bias", "swash_offset")) == pytest.approx(needed)
    assert (needed > SETTINGS.evidence) == (size > 1000.0)
    assert threshold(PROBLEM, q, ()) == SETTINGS.evidence


def test_coloured_innovations_make_a_loss_smaller_by_their_inflation():
    q = quadratic(3, size=6.0)
    once, thrice = (loss(PROBLEM, q, ("gyro_bias",), "gyro_bias", by) for by in (1.0, 3.0))
    occam = q.occam(own("gyro_bias"), BASE)
    assert thrice + occam == pytest.approx((once + occam) / 3.0)
    found = inflation(PROBLEM, q, ("gyro_bias", "swash_offset"), "gyro_bias")
    free = [*BASE, *own("gyro_bias"), *own("swash_offset")]
    assert found == q.variance_inflation(own("gyro_bias"), free)


def test_a_swap_with_what_replaces_a_number_takes_it_back_to_the_file():
    """The number's own std stands for the Occam factor: none is taken off for such an effect."""
    q = replace(
        quadratic(4), at=quadratic(4).at * np.where(np.array(NAMES) == "inertia_zz", 1.2, 1.0)
    )
    change, move = swap(PROBLEM, q, ("gyro_bias",), "gyro_bias", "yaw_inertia")
    rest, file = ["mass", "swash_to_flap"], {"inertia_zz": LAMA["inertia_zz"].value}
    then, expected = q.best(
        rest + own("yaw_inertia"), {**file, **dict.fromkeys(own("gyro_bias"), 0.0)}
    )
    occam = q.occam(own("gyro_bias"), rest)
    assert change == pytest.approx(then - q.best([*BASE, *own("gyro_bias")])[0] - occam)
    np.testing.assert_allclose(move, expected, atol=1e-12)
    moved = q.moved(move)
    assert moved["inertia_zz"] == pytest.approx(file["inertia_zz"])


@pytest.mark.parametrize("seed", range(12))
def test_exchanges_are_all_swaps_that_gain_more_than_a_tie(seed):
    """The bound by which pairs are passed over loses none."""
    q, active = quadratic(seed, size=15.0), ("gyro_bias", "swash_gain", "ground_effect")
    found = {(old, new): change for change, old, new, _ in exchanges(PROBLEM, q, active, active)}
    every = {
        (old, new): swap(PROBLEM, q, active, old, new)[0]
        for old in active
        for new in set(EFFECTS) - set(active)
    }
    tie = PROBLEM.settings.tie
    assert found == {pair: pytest.approx(c) for pair, c in every.items() if c < -tie}


@pytest.mark.parametrize("active", [(), ("swash_offset",)])
def test_the_most_that_an_effect_could_gain_is_its_evidence_where_nothing_bounds_it(active):
    """All at once, and the least value without any of them; a file's number is not gone back to."""
    q = quadratic(11, size=5.0)
    free = [*BASE, *(n for e in active for n in own(e))]
    value, gains = most_gains(PROBLEM, q, active, {})
    assert value == pytest.approx(q.best(free)[0])
    assert set(gains) == set(EFFECTS) - set(active)
    for effect in set(SIMPLE) - set(active):
        assert gains[effect] == pytest.approx(score(PROBLEM, q, active, effect).nats, abs=1e-9)
    beside = q.best(free)[0] - q.best(free + own("yaw_inertia"))[0]
    assert gains["yaw_inertia"] == pytest.approx(beside)


def test_only_what_may_be_added_and_gains_something_that_matters_is_listed():
    q = quadratic(5, size=8.0)
    fit = Fit(("gyro_bias",), OFF, NOISE)
    found = scores(PROBLEM, fit, q, banned=("swash_offset",))
    assert {c.effect for c in found} <= set(EFFECTS) - {"gyro_bias", "swash_offset"}
    nats = [c.nats for c in found]
    assert nats == sorted(nats, reverse=True) and min(nats, default=1.0) > 0.0
    listed = {c.effect for c in found}
    for effect in set(EFFECTS) - {"gyro_bias", "swash_offset"} - listed:
        one = score(PROBLEM, q, ("gyro_bias",), effect)
        assert one.nats <= 0.0 or not one.large
    assert not scores(PROBLEM, fit, quadratic(5, size=1e-6))


def test_an_effect_matters_from_its_smallest_size_on_either_side():
    """The largest of its numbers counts, each by its own measure; what is only a shape does not."""
    for e in SIMPLE:
        for f in PROBLEM.own[e]:
            smallest = next(
                p.smallest for p in CATALOGUE[e].parameters if f"{e}.{p.name}" == f.name
            )  # fmt: skip
            for value, large in ((1.01, True), (-1.01, True), (0.99, False), (-0.99, False)):
                assert is_large(PROBLEM, e, {**OFF, f.name: value * smallest}) == large, f.name
    assert not is_large(PROBLEM, "ground_effect", {**OFF, "ground_effect.decay": 3.5})
    assert is_large(PROBLEM, "ground_effect", {**OFF, "ground_effect.gain": 0.3})


def test_what_replaces_a_number_must_move_it_by_two_of_its_std():
    """The contract's words; for a mass in kilograms as for a scale."""
    own_std = LAMA["inertia_zz"].std / LAMA["inertia_zz"].value
    least = max(2.0 * own_std, 0.05)
    for factor, large in ((1.02, True), (-1.02, True), (0.98, False)):
        assert is_large(PROBLEM, "yaw_inertia", {"yaw_inertia.scale": factor * least}) == large
    std = LAMA["mass"].std
    assert 2.0 * std > 0.01, "or the smallest size decides"
    for factor, large in ((2.05, True), (1.95, False)):
        assert is_large(PROBLEM, "added_mass", {"added_mass.mass": factor * std}) == large


def test_what_changes_matters_by_what_it_was_and_by_how_much():
    """A number that is half its smallest size on either side of zero changes by all of it."""
    for effect, name in (("torque_balance", "scale"), ("added_mass", "mass")):
        full = f"{effect}.{name}"
        (f,) = MODEL.effect_parameters(effect)
        made = replace(PROBLEM, own={**PROBLEM.own, effect: (f, before(f))})
        (p,) = (p for p in made.model.sized(effect) if p.name == name)
        for last, was, large in ((0.55, -0.55, True), (0.45, -0.45, False), (0.0, 1.01, True),
                                 (1.01, 1.01, True), (0.9, 0.9, False)):  # fmt: skip
            values = {**OFF, full: last * p.smallest, of_part(full, BEFORE): was * p.smallest}
            assert is_large(made, effect, values) == large, (effect, last, was)


class Parabola:
    """An engine whose log-likelihood is that of a quadratic, but with a slope of its own."""

    def __init__(self, q: Quadratic, g: np.ndarray) -> None:
        self.q, self.g = q, g

    def filter(self, values: dict[str, float], noise: Noise) -> list[SimpleNamespace]:
        x = np.array([values[n] for n in NAMES]) - self.q.at
        return [SimpleNamespace(log_likelihood=-0.5 * x @ self.q.G @ x - self.g @ x)]


@pytest.mark.parametrize("pull", [-40.0, -8.0, 5.0])
def test_a_damping_is_weighed_by_the_likelihoods_slope(pull):
    """The quadratic has another slope: worth and size are those of the Gaussian, never negative."""
    q = quadratic(6)
    k = NAMES.index("yaw_damping.coefficient")
    g = q.g.copy()
    g[k] = pull / STD[k]
    made = problem(Parabola(q, g))
    fit = Fit((), OFF, NOISE, objective=0.0)
    nats, at = gain_by_likelihood(made, fit, q, "yaw_damping")
    true = replace(q, g=g)
    (value,) = at.values()
    best = true.moved(true.best([*BASE, *own("yaw_damping")])[1])["yaw_damping.coefficient"]
    upper = next(f.upper for f in FREE if f.name == "yaw_damping.coefficient")
    expected = log_evidence(true, [*BASE, *own("yaw_damping")]) - log_evidence(true, list(BASE))
    if 0.0 < best < upper:
        assert nats == pytest.approx(expected, rel=1e-6, abs=1e-9)
        assert value == pytest.approx(best, rel=1e-6)
    else:
        assert value == (0.0 if best < 0.0 else upper)
        assert best > 0.0 or nats == pytest.approx(-q.occam(own("yaw_damping"), BASE))


def test_a_damping_that_the_flight_does_not_show_is_worth_nothing():
    q = quadratic(7)
    G, k = q.G.copy(), NAMES.index("yaw_damping.coefficient")
    G[k] = G[:, k] = 0.0
    nats, at = gain_by_likelihood(PROBLEM, Fit((), OFF, NOISE), replace(q, G=G), "yaw_damping")
    assert nats == -math.inf and at == {}


# --- alternatives in a cause's place --------------------------------------------------------------


@pytest.fixture
def refits(monkeypatch):
    """Refits that end so many nats above a fit of 1000, by the effect in the cause's place."""
    above: dict[str, float] = {}

    def ended(made: Problem, fit: Fit, steps: int = 3) -> Fit:
        return replace(fit, objective=1000.0 + above[fit.active[-1]])

    monkeypatch.setattr(confounding, "fitted", ended)
    monkeypatch.setattr(confounding, "converged", lambda problem, fit: fit)
    return above


SERVO = replace(
    PROBLEM, own={e: tuple(MODEL.effect_parameters(e)) for e in ("servo_lag", "servo_delay")}
)
vars(SERVO)["sees_poses_alone"] = False  # there is no engine to ask for the channels of a flight


@pytest.mark.parametrize(
    ("inflation", "lost", "tie"),
    [(1.0, 100.0, 10.0), (1.0, 50.0, 6.0), (1.0, 2.0, 6.0), (1.0, 400.0, 40.0),
     (5.0, 100.0, 30.0), (5.0, 40.0, 20.0), (5.0, 8.0, 6.0)],
)  # fmt: skip
def test_a_lags_delay_stands_for_it_within_a_tie_of_the_refit(refits, inflation, lost, tie):
    """Ties are as many nats as the innovations' colour makes of six, but half of what is lost; and a
    tenth of that, whatever the colour: a real servo is neither lag nor delay."""
    names = tuple(f.name for f in SERVO.parameters)
    k, std = len(names), np.array([f.std for f in SERVO.parameters])
    at = np.array([f.value for f in SERVO.parameters])
    G = np.diag(50.0 / std**2)
    q = Quadratic(names, G, np.zeros(k), at, at, std**-2.0, np.full(k, -np.inf), np.full(k, np.inf),
                  np.zeros((4, k)), np.ones((k, 18)))  # fmt: skip
    fit = Fit(("servo_lag",), dict(zip(names, at.tolist(), strict=True)), NOISE, objective=1000.0)
    for off, there in ((0.97 * tie, True), (1.03 * tie, False), (-3.0, True)):
        refits["servo_delay"] = off
        found = confounding._of_one(SERVO, fit, q, "servo_lag", inflation, lost)
        assert (set(found) == {"servo_delay"}) == there, off
    # beside the lag it is needed too: both are there, whatever one alone would do
    slope = np.zeros(k)
    slope[names.index("servo_delay.time")] = -50.0 / std[names.index("servo_delay.time")]
    found = confounding._of_one(SERVO, fit, replace(q, g=slope), "servo_lag", inflation, lost)
    assert set(found) == {"servo_delay"}


@pytest.mark.parametrize(
    ("alone", "off", "there"),
    [(True, 15.0, True), (True, 18.0, False), (False, 15.0, False), (False, 5.0, True)],
)
def test_by_poses_alone_a_turned_frame_stands_for_a_swash_phase_within_a_tenth(
    monkeypatch, refits, alone, off, there
):
    """Of 166 nats of a phase 8 to 14 were between them where a frame was turned by that angle."""
    pair = ("swash_phase", "frame_yaw")
    problem = replace(PROBLEM, own={e: tuple(MODEL.effect_parameters(e)) for e in pair})
    vars(problem)["sees_poses_alone"] = alone
    monkeypatch.setattr(confounding, "_near", lambda *given: [])
    monkeypatch.setattr(confounding, "swap", lambda *given: (0.0, np.zeros(0)))
    monkeypatch.setattr(confounding, "score", lambda *given: SimpleNamespace(evidence=0.0))
    q: Any = SimpleNamespace(moved=lambda move: {})
    refits["frame_yaw"] = off
    fit = Fit(pair[:1], {}, NOISE, objective=1000.0)
    assert set(confounding._of_one(problem, fit, q, "swash_phase", 1.0, 166.0)) == (
        {"frame_yaw"} if there else set()
    )


@pytest.mark.parametrize(
    ("judged", "factor"), [({"p": 2.0, "phi": 3.0}, 3.0), ({"p": 2.0}, 2.0), ({}, 1.5)]
)
def test_a_channel_of_few_readings_has_no_colour(monkeypatch, judged, factor):
    """Whiteness is judged from 60 readings of a run on: GNSS once a second has none in a minute."""
    white = {channel: SimpleNamespace(inflation=own) for channel, own in judged.items()}
    monkeypatch.setattr(confounding, "channels_of", lambda *given: ["p", "phi"])
    monkeypatch.setattr(confounding, "_of_one", lambda *given: {"used": given[-2]})
    problem = SimpleNamespace(for_each=lambda work, of: {e: work(e) for e in of})
    found = confounding.alternatives(
        problem, SimpleNamespace(active=("wind",)), None, {"wind": Evidence(50.0, 1.5)}, white
    )  # type: ignore[arg-type, call-overload]
    assert found == {"wind": {"used": factor}}


def test_a_servo_that_lags_and_is_late_is_one_cause():
    """By the name of the stronger; the other one's number is told, and the name is in doubt."""

    def entry(effect: str, evidence: float, *alike: str) -> dict[str, Any]:
        return {
            "effect": effect, "evidence": evidence, "parameters": {f"{effect}.time": {"value": 0.02}},
            "confusable_with": list(alike), "channels": ["q"], "trust": "sure", "doubts": [],
        }  # fmt: skip

    lag, delay, wind = entry("servo_lag", 40.0), entry("servo_delay", 60.0), entry("wind", 50.0)
    found = mixtures_as_one([lag, wind, delay])
    assert [c["effect"] for c in found] == ["servo_delay", "wind"]
    assert found[0]["confusable_with"] == ["servo_lag"] and found[0]["trust"] == "doubtful"
    assert set(found[0]["parameters"]) == {"servo_delay.time"}
    assert found[0]["mixture"] == lag["parameters"]
    assert found[1] == wind  # what is no mixture is as it was
    alone = mixtures_as_one([entry("servo_lag", 40.0, "servo_delay")])
    assert "mixture" not in alone[0] and alone[0]["trust"] == "sure"


# --- what is said beside the findings ---------------------------------------------------------------


def test_channels_are_those_that_carry_a_tenth_of_the_signature():
    """By the square of the size: 60, 30 and 8 per cent, strongest first."""
    q = quadratic(8)
    by_channel = np.zeros((len(NAMES), 18))
    k = NAMES.index("gyro_bias.y")
    for channel, share in (("q", 0.3), ("theta", 0.6), ("vn", 0.08), ("az", 0.02)):
        by_channel[k, CHANNELS.index(channel)] = share
    by_channel[NAMES.index("mass"), CHANNELS.index("h")] = 50.0
    fit = Fit(("gyro_bias",), {**OFF, "gyro_bias.y": -0.02}, NOISE)
    found = channels_of(PROBLEM, fit, replace(q, by_channel=by_channel), "gyro_bias")
    assert found == ["theta", "q"]
    assert channels_of(PROBLEM, fit, replace(q, by_channel=0.0 * by_channel), "gyro_bias") == []


def test_a_base_number_is_said_to_have_moved_from_two_sigmas_on():
    for sigmas, count in ((1.9, 0), (2.1, 1), (-2.1, 1), (-1.9, 0)):
        value = LAMA["mass"].value + sigmas * LAMA["mass"].std
        texts = remarks._moved_base(PROBLEM, Fit((), {**OFF, "mass": value}, NOISE))
        assert len(texts) == count
        assert all(f"mass moved {sigmas:+.1f} prior sigmas" in text for text in texts)


def test_white_noise_is_said_where_it_is_well_above_its_floor():
    floor = dict.fromkeys(WHITE_LEVELS, 1e-3)
    least = PROBLEM.settings.white_noise_reported
    for factor, count in ((0.95, 0), (1.05, 1)):
        process = {**floor, "white_moment_z": factor * least * 1e-3}
        fit = Fit((), OFF, Noise(process, {}, floor))
        assert len(remarks._white_noise(PROBLEM, fit)) == count


def test_an_unseen_effect_is_said_where_it_would_move_a_cause_by_many_std():
    """A number that is one column with the cause's and that the data do not tell apart from it."""
    size = {n: i for i, n in enumerate(NAMES)}
    usual = dict(zip(NAMES, STD, strict=True))
    cause, other = "gyro_bias.x", "swash_offset.lon"
    tie = 4.0 * usual[cause] / usual[other]  # a usual other one is worth four usual causes

    def texts(information: float, tie: float = tie) -> list[str]:
        q = quadratic(9)
        G = np.diag(1e-6 * STD**-2.0)
        for a, b, w in (
            (cause, cause, 1.0), (cause, other, tie), (other, cause, tie), (other, other, tie**2),
        ):  # fmt: skip
            G[size[a], size[b]] = w * information / usual[cause] ** 2
        fit = Fit(("gyro_bias",), {**OFF, cause: 0.02}, NOISE)
        return remarks._resting_on_unseen(PROBLEM, fit, replace(q, G=G), {"gyro_bias": {}})

    (text,) = texts(100.0)
    assert text.startswith("gyro_bias.x = 0.02 holds without swash_offset")
    moved = 4.0 * usual[cause] * 100.0 / 101.0
    assert text.endswith(f"would move it by {moved:.2g}")
    # four usual sizes are 0.4 of the std that so little information leaves
    assert texts(0.001) == []
    assert texts(100.0, 0.1 * tie) == [], "moved by four std, and five are needed"
    assert len(texts(100.0, 0.14 * tie)) == 1
