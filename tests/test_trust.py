"""When may a name be believed? Parts of the flights, on likelihoods whose truth is known.

The likelihoods are exactly quadratic: linear regressions with white noise, drawn here, run by run. What
a cause of given evidence does on a part of them is then a matter of the normal distribution.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binom, norm

from coax_env.diagnosis import moves, replication, trust, unlisted
from coax_env.diagnosis.doubts import (
    Against,
    doubts,
    has_limit,
    of_sizes,
    on_parts,
    sizes,
    under_noise,
    weak,
    without_name,
)
from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.hold_out import fair_part
from coax_env.diagnosis.moves import Proposal, accepted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.replication import Asked, Replication, halves_of, replications
from coax_env.diagnosis.scores import lost
from coax_env.diagnosis.sensor_low_pass import may_hide_behind
from coax_env.diagnosis.settings import SETTINGS
from coax_env.diagnosis.trust import (
    determined,
    may_be_none,
    moved_far,
    of_line,
    taken_back,
)
from coax_env.diagnosis.unseen import Unseen
from coax_env.diagnosis.where_shown import SizeWhereMost
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.quadratic import Linearised, Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.estimation.vibration import Line
from coax_env.model.generic_terms import TERMS
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle_file import load_vehicle

NAMES = ("axial_damping.coefficient", "rotor_drag.coefficient", "flap_blowback.gain")
EFFECTS = tuple(name.partition(".")[0] for name in NAMES)
WIDE = 1e3  # prior std: the data alone speak
LAMA = load_vehicle("lama400d")


def problem_of(runs: int) -> Problem:
    """Effects with one number each on runs that were never flown."""
    free = [FreeParameter(name, 0.0, WIDE) for name in NAMES]
    engine = SimpleNamespace(records=[SimpleNamespace(whole=f"run {i}") for i in range(runs)])
    model = SimpleNamespace(bare_values={}, moments={})
    base = (FreeParameter("mass", 0.0, WIDE),)
    own = {effect: (f,) for effect, f in zip(EFFECTS, free, strict=True)}
    return Problem(model, engine, base, own)  # type: ignore[arg-type]


def fitted_to(
    problem: Problem, designs: Sequence[np.ndarray], y: Sequence[np.ndarray], active: Sequence[str]
) -> tuple[Fit, Quadratic, dict[str, float]]:
    """A regression of y (n,) on columns (n, 4) run by run: the fit, its quadratic, the evidence."""
    parameters = problem.parameters
    at = dict.fromkeys((f.name for f in parameters), 0.0)

    def about() -> Quadratic:
        here = np.array([at[f.name] for f in parameters])
        left = [X @ here - target for X, target in zip(designs, y, strict=True)]
        lin = Linearised(
            tuple(at),
            np.array([X.T @ X for X in designs]),
            np.array([X.T @ e for X, e in zip(designs, left, strict=True)]),
            np.zeros((len(designs), len(at), 1)),
            np.array([e @ X for X, e in zip(designs, left, strict=True)]),
        )  # fmt: skip
        return Quadratic.of(lin, parameters, at)

    _, move = about().best(problem.free_names(active))
    at = about().moved(move)
    quadratic = about()
    fit = Fit(tuple(active), at, Noise({}), objective=0.0)
    return fit, quadratic, {e: lost(problem, quadratic, active, e) for e in active}


def drawn(
    rng: np.random.Generator, sizes: Sequence[float], shown: Sequence[float], runs: int = 8
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Runs of 100 readings in white noise: the first effect's size and its column's size, by run."""
    designs, y = [], []
    for i in range(runs):
        X = rng.standard_normal((100, 1 + len(NAMES)))
        X[:, 1] *= shown[i]
        designs.append(X)
        y.append(sizes[i] * X[:, 1] + rng.standard_normal(100))
    return designs, y


def asked_again(
    nats: float, made_by: Callable[[int], float], shown: Callable[[int], float], seed: int
) -> Replication | None:
    """How a name fares whose evidence was to be `nats`; None where it came out under the threshold."""
    runs = 8
    rng = np.random.default_rng(seed)
    columns = [shown(i) for i in range(runs)]
    made = np.array([made_by(i) for i in range(runs)])
    power = sum(100.0 * c**2 * m for c, m in zip(columns, made, strict=True))
    known = sum(100.0 * c**2 for c in columns)
    size = math.sqrt(2.0 * nats * known) / power  # so that the pooled estimate is worth that
    problem = problem_of(runs)
    designs, y = drawn(rng, list(size * made), columns, runs)
    fit, quadratic, worth = fitted_to(problem, designs, y, EFFECTS[:1])
    if worth[EFFECTS[0]] < SETTINGS.evidence:
        return None
    return replications(problem, fit, quadratic, worth)[EFFECTS[0]]


def believed(replication: Replication) -> bool:
    return not list(on_parts(replication, 8, SETTINGS))


@pytest.mark.slow
def test_a_cause_in_all_runs_returns():
    found = [asked_again(22.0, lambda i: 1.0, lambda i: 1.0, seed) for seed in range(40)]
    judged = [believed(r) for r in found if r]
    assert len(judged) > 25 and np.mean(judged) > 0.94
    strong = asked_again(80.0, lambda i: 1.0, lambda i: 1.0, 0)
    assert strong == Replication(1.0, 1.0, ())


@pytest.mark.slow
def test_what_one_run_made_does_not():
    """All runs could show it, one alone does: half of the halves have it."""
    found = [asked_again(30.0, lambda i: float(i == 3), lambda i: 1.0, seed) for seed in range(40)]
    judged = [r for r in found if r]
    assert len(judged) > 25
    assert np.mean([believed(r) for r in judged]) < 0.05
    assert all(r.rests_on == ("run 3",) for r in judged if len(r.rests_on) == 1)
    assert np.mean([r.kept for r in judged]) == pytest.approx(0.5, abs=0.12)


def test_what_one_run_alone_can_show_is_not_held_against_it():
    """Ground effect in the only low run: a half without that run is not asked."""
    low = lambda i: 1.0 if i == 5 else 0.0  # noqa: E731
    replication = asked_again(60.0, lambda i: 1.0, low, 1)
    assert replication == Replication(7 / 8, 1.0, ("run 5",))
    assert believed(replication)
    assert list(on_parts(Replication(0.5, 1.0, ("sine",)), 2, SETTINGS)) == [
        "it rests on sine alone"
    ]


def test_a_name_that_another_explains_better_on_a_part_has_not_returned():
    """Two columns nearly alike on four runs; on the four others the second alone explains."""
    rng = np.random.default_rng(3)
    problem = problem_of(8)
    designs, y = [], []
    for i in range(8):
        X = rng.standard_normal((100, 4))
        if i < 4:
            X[:, 1] = X[:, 2] + 0.02 * rng.standard_normal(100)
        designs.append(X)
        y.append(1.0 * X[:, 2] + rng.standard_normal(100))
    wrong = fitted_to(problem, designs, y, EFFECTS[:1])
    right = fitted_to(problem, designs, y, EFFECTS[1:2])
    assert replications(problem, *wrong)[EFFECTS[0]].kept < 0.2
    assert replications(problem, *right)[EFFECTS[1]].kept == 1.0


def test_what_changes_its_sign_has_not_returned():
    """Half of the runs say plus, as the whole does, and half nearly as much minus: no return."""
    rng = np.random.default_rng(4)
    problem = problem_of(8)
    designs, y = drawn(rng, [2.0] * 4 + [-1.6] * 4, [1.0] * 8)
    fit, quadratic, worth = fitted_to(problem, designs, y, EFFECTS[:1])
    assert worth[EFFECTS[0]] > SETTINGS.evidence
    assert not believed(replications(problem, fit, quadratic, worth)[EFFECTS[0]])


# --- what is asked ----------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.5, 0.7, 0.9])
def test_a_cause_at_the_threshold_returns_in_95_of_100(share):
    """Its z on a part, given the whole, is normal: mean sqrt(s) z, std sqrt(1 - s)."""
    asked = Asked(share, 1.0, SETTINGS.evidence, SETTINGS)
    z = math.sqrt(2.0 * SETTINGS.evidence)
    least = math.sqrt(2.0 * asked.needed)
    passed = norm.sf(least, math.sqrt(share) * z, math.sqrt(1.0 - share))
    assert passed == pytest.approx(0.95, abs=1e-3)
    assert asked.can_tell and norm.sf(least) < 0.025


def test_the_whole_must_be_worth_the_threshold_and_a_tenth_cannot_tell():
    assert Asked(1.0, 1.0, 14.0, SETTINGS).needed == pytest.approx(SETTINGS.evidence)
    assert not Asked(0.1, 1.0, 14.0, SETTINGS).can_tell
    assert Asked(0.1, 1.0, 200.0, SETTINGS).can_tell


def test_the_halves_that_are_asked_for_are_those_that_chance_allows():
    """20 halves: a cause at the threshold fails them once in 400; half of them is not enough."""
    needed = math.ceil(SETTINGS.least_kept * 2 * SETTINGS.splits)
    assert binom.cdf(needed - 1, 2 * SETTINGS.splits, 0.95) < 1 / 350
    assert 0.5 < SETTINGS.least_kept < 0.95


@pytest.mark.parametrize("groups", [[range(9)], [range(4)], [range(5), range(5, 12)]])
def test_halves_are_halves(groups):
    every = sorted(i for group in groups for i in group)
    halves = list(halves_of(groups, 10))
    assert 0 < len(halves) <= 20 and len(halves) % 2 == 0
    for first, second in zip(halves[::2], halves[1::2], strict=True):
        assert sorted((*first, *second)) == every
        for group in groups:
            assert abs(len(set(first) & set(group)) - len(group) / 2) <= 0.5


# --- a vibration --------------------------------------------------------------------------------------


def line_of(ratios: dict[str, list[float]]) -> Line:
    every = [r for own in ratios.values() for r in own]
    F = float(np.mean(every))
    nats = len(every) * (F - 1.0 - math.log(F))
    return Line("amplitude", "upper", 1, 1.0, 0.3, 0.01, nats, nats, ("ax",), ratios, {})


def test_a_line_in_every_run_is_sure_and_one_of_a_single_run_is_not():
    rng = np.random.default_rng(0)
    runs = [f"run {i}" for i in range(6)]
    everywhere = line_of({run: rng.exponential(2.5, 30).tolist() for run in runs})
    assert of_line(everywhere).word == "sure"
    once = line_of(
        {r: rng.exponential(12.0 if r == "run 2" else 1.0, 30).tolist() for r in runs[:3]}
    )
    assert of_line(once).doubts == ("it rests on run 2 alone",)


# --- numbers ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("told", "known"), [(0.5, False), (0.9, False), (1.2, True), (50.0, True)])
def test_a_number_is_determined_where_the_flights_say_more_than_the_prior(told, known):
    """The data's information as a multiple of the prior's; coloured noise takes from it."""
    problem = replace(
        problem_of(1), own={EFFECTS[0]: (FreeParameter(NAMES[0], 0.0, 0.1),)}, base=()
    )
    X = np.full((1, 1), math.sqrt(told) / 0.1)
    lin = Linearised(
        NAMES[:1], (X.T @ X)[None], np.zeros((1, 1)), np.zeros((1, 1, 1)), np.zeros((4, 1))
    )
    values = {NAMES[0]: 0.1}
    fit = Fit(EFFECTS[:1], values, Noise({}))
    quadratic = Quadratic.of(lin, problem.parameters, values)
    assert determined(problem, fit, quadratic, EFFECTS[0], 1.0) == {NAMES[0]: known}
    assert determined(problem, fit, quadratic, EFFECTS[0], 1e4) == {NAMES[0]: False}


@pytest.mark.parametrize(
    ("size", "words"),
    [
        (2.45, ""),
        (-2.6, "2.6 usual sizes"),
        (4.9, "4.9 usual sizes"),
        (4.97, "limit"),
        (-5.0, "limit"),
    ],
)
def test_a_size_is_unusual_from_two_and_a_half_on_and_a_limit_at_five(size, words):
    """Usual sizes are the vehicle's, however wide a prior has been made since."""
    model = HeliModel(LAMA)
    own = {
        "gyro_bias": tuple(
            replace(f, std=9.0 * f.std) for f in model.effect_parameters("gyro_bias")
        )
    }
    problem = replace(problem_of(1), model=model, own=own)
    usual = model.effect_parameters("gyro_bias")[1].std
    values = {"gyro_bias.x": 0.0, "gyro_bias.y": size * usual, "gyro_bias.z": 0.0}
    found = list(of_sizes(sizes(problem, Fit(("gyro_bias",), values, Noise({})), "gyro_bias")))
    assert bool(found) == bool(words) and all(words in text for text in found)


@pytest.mark.parametrize(("scale", "limited"), [(-0.8, True), (-0.7, False), (0.7, False)])
def test_what_a_machine_cannot_have_is_a_limit_too(scale, limited):
    """A yaw inertia of a fifth of the file's, which is four usual sizes."""
    problem = replace(problem_of(1), model=HeliModel(LAMA))
    own = {"yaw_inertia": tuple(problem.model.effect_parameters("yaw_inertia"))}
    fit = Fit(("yaw_inertia",), {"yaw_inertia.scale": scale}, Noise({}))
    found = sizes(replace(problem, own=own), fit, "yaw_inertia")
    assert has_limit(found) == limited


def known_of(channels: Sequence[str] = ("q",), **but) -> Against:
    """An effect against which nothing speaks but what is said here."""
    sound = Against(
        channels=tuple(channels), coloured=(), elsewhere=0.0, likelier_without={}, loud=(), falls_at=(),
        parts=Replication(1.0, 1.0, ()), runs=8, sizes={"gain": 1.0}, determined=True,
        may_be_none=False, flies_worse=False, unseen=None, within_form=False, alternatives=(),
        nats=100.0, of_moment=math.inf, shaken=False, poses_alone=False,
        clock_error=0.0, smoothed=False, errors_left=0.0, beside_terms=(), beside_moved=(),
        taken_back_by="", by_speeds_alone=False, followed=False,
    )  # fmt: skip
    return replace(sound, **but)


@pytest.mark.parametrize(
    ("size", "channels", "doubted"),
    [(5.0, ["q", "r"], True), (4.9, ["q", "r"], False), (5.0, ["r", "h"], False)],
)
def test_what_shows_where_another_stands_at_its_limit_is_doubted(size, channels, doubted):
    against = {
        "gyro_bias": known_of(["p", "q"], sizes={"gyro_bias.y": size}),
        "servo_delay": known_of(channels),
    }
    found = list(doubts("servo_delay", against, SETTINGS))
    assert bool(found) == doubted and all("gyro bias" in text for text in found)
    assert not any("beside it" in text for text in doubts("gyro_bias", against, SETTINGS))


@pytest.mark.parametrize(("size", "doubted"), [(1.6, True), (0.2, True), (1.1, False)])
def test_what_has_another_size_where_it_shows_most_is_doubted(size, doubted):
    """A limited rate was a servo's lag of 76 nats, sure, 1.6 times as long after large steps."""
    there = SizeWhereMost(0.016, size, 0.05)
    found = list(doubts("servo_lag", {"servo_lag": known_of(where_most=there)}, SETTINGS))
    assert bool(found) == doubted
    assert not found or f"in 1.6 % of the time, it has {size:.1f} times its size" in found[0]


def test_a_causes_size_is_asked_beside_the_fit_without_it(monkeypatch):
    asked = []

    def size_where_most(problem, fit, rest, inflation):
        asked.append((rest, inflation))
        return SizeWhereMost(0.1, 2.0, 0.01)

    monkeypatch.setattr(trust, "size_where_most", size_where_most)
    problem, rng = problem_of(8), np.random.default_rng(1)
    fit, _, worth = fitted_to(problem, *drawn(rng, [1.0] * 8, [1.0] * 8), EFFECTS[:2])
    rest = replace(fit, active=EFFECTS[1:2])
    evidence = {
        EFFECTS[0]: Evidence(worth[EFFECTS[0]], 12.0, rest=rest, times=3.0),  # of colour 4
        EFFECTS[1]: Evidence(worth[EFFECTS[1]], 1.0),  # not weighed: nothing is asked
    }
    assert trust.where_most(problem, fit, evidence[EFFECTS[0]]) == SizeWhereMost(0.1, 2.0, 0.01)
    assert trust.where_most(problem, fit, evidence[EFFECTS[1]]) is None
    known = trust.Trust(True, 1.0, None, {}, (), (), where_most=SizeWhereMost(0.1, 2.0, 0.01))
    assert known.entries()["where_most"] == {"share": 0.1, "size": 2.0, "std": 0.01}
    assert replace(known, where_most=None).entries()["where_most"] is None
    assert asked == [(rest, 4.0)]


def test_what_shows_where_something_unexplained_acts_is_doubted():
    """A yaw inertia of 92 nats was sure beside a term of the yaw moment (**synthetic**)."""
    (doubt,) = doubts(
        "yaw_inertia", {"yaw_inertia": known_of(["r"], beside_terms=("r",))}, SETTINGS
    )
    assert "no effect explains acts in yaw rate" in doubt
    model = HeliModel(load_vehicle("lama400d"))
    plain = replace(problem_of(1), model=model)
    terms = unlisted.parameters(model, "unlisted_N", [t for t in TERMS if t.form == "r"])
    assert len(terms) == 1
    assert unlisted.acted_on(plain) == set()
    assert unlisted.acted_on(plain.with_free(terms)) == {"r", "psi"}


def test_two_that_stand_for_each_other_are_not_exchanged_without_end(monkeypatch):
    problem, rng = problem_of(8), np.random.default_rng(1)
    fit, quadratic, worth = fitted_to(problem, *drawn(rng, [1.0] * 8, [1.0] * 8), EFFECTS[:1])
    other = {EFFECTS[0]: EFFECTS[1], EFFECTS[1]: EFFECTS[0]}
    monkeypatch.setattr(
        replication, "_exchange", lambda problem, part, active, names: (active[0], other[active[0]])
    )
    assert set(replications(problem, fit, quadratic, worth)) == {EFFECTS[0]}


def test_what_left_explains_nothing_any_more():
    """Two effects of one column share what it does; without the one, the other has it all."""
    problem, rng = problem_of(8), np.random.default_rng(2)
    designs, y = drawn(rng, [1.0] * 8, [1.0] * 8)
    for X in designs:
        X[:, 2] = X[:, 1]
    problem = replace(problem, own={e: (FreeParameter(n, 0.0, 1.0),) for e, n in
                                    zip(EFFECTS, NAMES, strict=True)})  # fmt: skip
    fit, quadratic, _ = fitted_to(problem, designs, y, EFFECTS[:2])
    assert (
        fit.values[NAMES[0]] == pytest.approx(fit.values[NAMES[1]]) == pytest.approx(0.5, abs=0.1)
    )
    left = quadratic.held_at(problem.off_values(EFFECTS[0]))
    _, move = left.best(problem.free_names(EFFECTS[1:2]))
    assert left.moved(move)[NAMES[1]] == pytest.approx(1.0, abs=0.1)
    assert left.moved(move)[NAMES[0]] == 0.0
    _, same = quadratic.best(problem.free_names(EFFECTS[1:2]), {NAMES[0]: 0.0})
    assert quadratic.moved(same) == pytest.approx(left.moved(move))
    assert lost(problem, left, EFFECTS[1:2], EFFECTS[1]) > 300.0  # 800 readings of 1 std


@pytest.mark.parametrize(
    ("limited", "coloured", "undetermined", "falls", "beside", "kept", "nats", "named"),
    [
        (False, False, False, False, False, 1.0, 100.0, True),
        (False, True, True, False, False, 1.0, 100.0, True),  # a doubtful name
        (True, False, False, False, False, 1.0, 1000.0, False),
        (False, False, False, True, False, 1.0, 100.0, True),
        (False, False, False, False, True, 1.0, 100.0, True),
        (False, False, False, False, False, 0.7, 100.0, True),  # 30 % of the halves are without it
        (False, True, False, False, False, None, 100.0, True),  # none could tell
        (False, False, False, False, False, 1.0, 30.0, True),
        (False, False, False, True, False, 1.0, 30.0, True),
        (False, True, False, False, False, 1.0, 30.0, False),
        (False, True, False, True, False, 1.0, 100.0, False),
        (False, True, False, False, True, 1.0, 100.0, False),
        (False, True, False, False, False, 0.7, 100.0, False),
        (False, False, False, True, True, 1.0, 100.0, False),
        (False, False, False, True, False, 0.7, 100.0, False),
        (True, False, True, False, False, 1.0, 100.0, False),
        (True, False, False, True, False, 1.0, 100.0, False),
    ],
)
def test_what_stands_for_something_else_has_no_name(
    limited, coloured, undetermined, falls, beside, kept, nats, named
):
    """An effect that shows in q, with another one, without a name, that shows there or elsewhere."""
    one, other = EFFECTS[:2]
    against = {
        one: known_of(
            coloured=("q",) * coloured,
            falls_at=("half of all",) * falls,
            parts=Replication(1.0, kept, ()),
            sizes={"gain": 5.0 if limited else 1.0},
            determined=not undetermined,
            nats=nats,
        ),
        other: known_of(["q" if beside else "h"], sizes={"gain": 5.0}, determined=False),
    }
    assert without_name(against, SETTINGS) == ({other} if named else {one, other})
    assert bool(list(doubts(one, against, SETTINGS))) == (
        not named or limited or coloured or undetermined or falls or beside or kept != 1.0
        or nats < SETTINGS.sure_evidence
    )  # fmt: skip


@pytest.mark.parametrize(
    ("nats", "beside", "size", "named"),
    [
        (110.0, "q", 5.0, False),
        (230.0, "q", 5.0, True),
        (110.0, "h", 5.0, True),
        (110.0, "q", 4.0, True),
    ],
)
def test_a_small_share_of_what_stands_at_its_limit_has_no_name(nats, beside, size, named):
    """A lag that is held to less than it is leaves a droop in the same rotor's speed: 2.25 % of it."""
    lag = known_of([beside], sizes={"upper": size}, nats=1e4)
    against = {"motor_droop": known_of(["q"], nats=nats), "motor_lag": lag}
    assert ("motor_droop" not in without_name(against, SETTINGS)) == named


@pytest.mark.parametrize(("coloured", "falls"), [(0, 0), (1, 0), (0, 1)])
def test_a_number_that_may_be_none_is_doubted_and_with_one_thing_more_has_no_name(coloured, falls):
    one = EFFECTS[0]
    of = known_of(may_be_none=True, coloured=("q",) * coloured, falls_at=("half of all",) * falls)
    assert without_name({one: of}, SETTINGS) == ({one} if coloured or falls else set())
    assert any("may as well be none" in text for text in doubts(one, {one: of}, SETTINGS))


@pytest.mark.parametrize(("more", "named"), [({}, True), ({"coloured": ("q",)}, False)])
def test_what_is_none_only_with_another_in_its_place_is_one_of_the_two(more, named):
    """A blow-back of the lower rotor may be the upper's: one of them is there, and both are stated."""
    one, other = EFFECTS[:2]
    of = known_of(may_be_none=True, falls_at=("half of all",), alternatives=(other,), **more)
    assert (one not in without_name({one: of}, SETTINGS)) == named
    alone = known_of(may_be_none=True, falls_at=("half of all",))
    assert without_name({one: alone}, SETTINGS) == {one}
    said = list(doubts(one, {one: of}, SETTINGS))
    assert any("cannot distinguish" in text for text in said)
    assert any("may as well be none" in text for text in said)


@pytest.mark.parametrize(("nats", "named"), [(13.9, False), (14.1, True)])
def test_what_is_in_the_model_by_what_it_flies_alone_has_no_name(nats, named):
    of = known_of(nats=nats)
    assert (not without_name({EFFECTS[0]: of}, SETTINGS)) == named


def test_what_a_channel_is_likelier_without_has_no_name():
    """Rotor speeds read through a filter: a motor lag that the accelerometer denies."""
    of = known_of(likelier_without={"az": 276.0})
    assert without_name({"motor_lag": of}, SETTINGS) == {"motor_lag"}
    (doubt,) = doubts("motor_lag", {"motor_lag": of}, SETTINGS)
    assert "vertical acceleration are 276 nats likelier without it" in doubt


@pytest.mark.parametrize(
    ("share", "alike"), [(1.0, True), (0.95, True), (0.85, False), (-1.0, False)]
)
def test_a_tilt_and_a_bias_that_do_nothing_at_rest_are_doubted(share, alike):
    """What a turned sensor feels of gravity, by SciPy's rotations, is what the bias takes."""
    x, y = -0.0186, 0.0195
    felt = Rotation.from_rotvec([x, y, 0.0]).inv().apply([0.0, 0.0, -9.81])
    values = {
        "gravity": 9.81, "imu_tilt.x": x, "imu_tilt.y": y,
        "accel_bias.x": -share * felt[0], "accel_bias.y": -share * felt[1],
    }  # fmt: skip
    found = taken_back(Fit(("imu_tilt", "accel_bias"), values, Noise({})))
    assert found == ({"imu_tilt": "accel_bias", "accel_bias": "imu_tilt"} if alike else {})
    assert not taken_back(Fit(("imu_tilt",), values, Noise({})))
    of = known_of(taken_back_by="accel_bias")
    (doubt,) = doubts("imu_tilt", {"imu_tilt": of}, SETTINGS)
    assert "accel bias beside it" in doubt and not without_name({"imu_tilt": of}, SETTINGS)


def test_a_lag_that_rotor_speeds_alone_show_has_no_name():
    of = known_of(by_speeds_alone=True)
    assert without_name({"motor_lag": of}, SETTINGS) == {"motor_lag"}
    (doubt,) = doubts("motor_lag", {"motor_lag": of}, SETTINGS)
    assert "rotors' speeds" in doubt


def test_what_an_onboard_filter_follows_is_doubted():
    of = known_of(followed=True)
    assert not without_name({"gyro_bias": of}, SETTINGS)
    (doubt,) = doubts("gyro_bias", {"gyro_bias": of}, SETTINGS)
    assert "onboard filter" in doubt


@pytest.mark.parametrize("none", [False, True])
@pytest.mark.parametrize(
    ("nats", "expected", "worse", "denied"),
    [
        (-0.3, 13.0, False, True),  # they should show it
        (-0.3, 9.0, False, False),  # by chance
        (-22.0, 1.0, True, True),  # and are flown worse
        (3.0, 13.0, True, False),  # by a gust: they are likelier with it
    ],
)
def test_what_the_held_out_runs_deny_is_doubted_and_with_one_thing_more_has_no_name(
    nats, expected, worse, denied, none
):
    one = EFFECTS[0]
    much = SETTINGS.clear + 1.0
    of = known_of(
        unseen=Unseen(nats, expected, 5.0), flies_worse=worse, may_be_none=none, nats=much
    )
    said = [text for text in doubts(one, {one: of}, SETTINGS) if "held-out runs" in text]
    assert bool(said) == denied and len(said) == denied * (1 + worse)
    assert not denied or f"worth {nats:z.0f} nats" in said[0]
    assert without_name({one: of}, SETTINGS) == ({one} if denied and none else set())
    assert not list(doubts(one, {one: known_of(flies_worse=True)}, SETTINGS)), "none were asked"


@pytest.mark.parametrize(
    ("nats", "unseen", "named"),
    [
        (81.0, Unseen(-0.3, 13.0, 5.0), False),
        (81.0, Unseen(-0.3, 9.0, 5.0), True),
        (141.0, Unseen(-0.3, 13.0, 5.0), True),
    ],
)
def test_what_is_not_clear_and_denied_by_the_held_out_runs_has_no_name(nats, unseen, named):
    """A centre of gravity on a clean flight in gusts from one side (**synthetic**)."""
    of = known_of(nats=nats, unseen=unseen)
    assert without_name({"cg_offset": of}, SETTINGS) == (set() if named else {"cg_offset"})


@pytest.mark.parametrize("coloured", [(), ("q",)])
def test_what_a_form_may_be_wrong_by_at_one_frequency_is_doubted_and_with_one_thing_more_has_no_name(
    coloured,
):
    """A rate damping, 0.2 % of what all explained, beside a heading that swung (**synthetic**)."""
    one = EFFECTS[0]
    of = known_of(within_form=True, coloured=coloured)
    assert without_name({one: of}, SETTINGS) == ({one} if coloured else set())
    assert any("wrong by 15 %" in text for text in doubts(one, {one: of}, SETTINGS))


@pytest.mark.parametrize(
    ("of_moment", "shaken", "falls", "named"),
    [(26.0, True, True, False), (26.0, True, False, True), (26.0, False, True, True),
     (43.0, True, True, True), (math.inf, True, True, True)],
)  # fmt: skip
def test_a_change_that_a_shock_may_have_made_has_no_name_with_one_thing_more(
    of_moment, shaken, falls, named
):
    """A hub stiffness that ended, and did not hold under other noise (**synthetic**, clean)."""
    of = known_of(of_moment=of_moment, shaken=shaken, falls_at=("half of all",) * falls)
    assert without_name({"hub_stiffness": of}, SETTINGS) == (set() if named else {"hub_stiffness"})


@pytest.mark.parametrize(
    ("nats", "falls", "named"), [(27.0, True, False), (27.0, False, True), (29.0, True, True)]
)
def test_what_is_worth_little_and_does_not_hold_under_other_noise_has_no_name(nats, falls, named):
    """An accelerometer's bias of 16 nats, gone at half a gust's memory (**synthetic**, clean).

    So is a rotor drag of 19 for an airframe's, with which a held-out run was flown worse.
    """
    of = known_of(nats=nats, falls_at=("half of all",) * falls)
    assert without_name({"accel_bias": of}, SETTINGS) == (set() if named else {"accel_bias"})
    of = known_of(nats=nats, unseen=Unseen(-2.0, 3.0, 2.4), flies_worse=falls)
    few = without_name({"rotor_drag": of}, SETTINGS)
    assert few == (set() if named else {"rotor_drag"})


@pytest.mark.parametrize(
    ("nats", "of_moment", "named"),
    [(41.0, 21.0, False), (43.0, 21.0, True), (27.0, 43.0, True), (27.0, math.inf, True)],
)
@pytest.mark.parametrize("poses_alone", [False, True])
def test_what_changed_in_flight_by_little_has_no_name(nats, of_moment, named, poses_alone):
    """A centre of gravity that moved by 0.8 mm, by poses alone a swash offset (**synthetic**, clean);
    what was always so has its own threshold, and a moment may be clear where the cause is weak."""
    of = known_of(nats=nats, of_moment=of_moment, poses_alone=poses_alone)
    assert without_name({"cg_offset": of}, SETTINGS) == (set() if named else {"cg_offset"})


@pytest.mark.parametrize(
    ("away", "ratio", "inflation", "none"),
    [(2.1, 1.0, 1.0, False), (1.9, 1.0, 1.0, True), (3.0, 2.0, 1.0, True), (3.0, 1.0, 4.0, True),
     (5.0, 2.0, 1.0, False)],
)  # fmt: skip
def test_nothing_is_in_the_interval_of_a_number_within_two_of_its_std(away, ratio, inflation, none):
    """With what models that do as well make of it (`ratio`), and what colour does."""
    problem = problem_of(8)
    fit, quadratic, _ = fitted_to(
        problem, *drawn(np.random.default_rng(3), [1.0] * 8, [1.0] * 8), EFFECTS[:1]
    )
    name = problem.own[EFFECTS[0]][0].name
    std = quadratic.std(problem.free_names(fit.active))[name]
    fit = replace(fit.at({name: -away * std}), std_ratio={name: ratio})
    assert may_be_none(problem, fit, quadratic, EFFECTS[0], inflation) == none


@pytest.mark.parametrize(
    ("poses_alone", "nats", "falls", "named"),
    [(True, 30.0, True, False), (True, 30.0, False, True), (True, 50.0, True, True),
     (False, 30.0, True, True)],
)  # fmt: skip
def test_by_poses_alone_little_evidence_speaks_against_a_name(poses_alone, nats, falls, named):
    """Beside it one thing more takes the name; by itself it does not."""
    of = known_of(nats=nats, falls_at=("half of all",) * falls, poses_alone=poses_alone)
    assert without_name({"yaw_damping": of}, SETTINGS) == (set() if named else {"yaw_damping"})


@pytest.mark.parametrize(
    ("nats", "falls", "named"), [(17.0, True, False), (17.0, False, True), (50.0, True, True)]
)
def test_what_a_low_pass_too_fast_to_be_seen_would_do_needs_more_evidence(nats, falls, named):
    """A thrust exponent of 17 nats, of accelerometers behind 79 Hz (**synthetic**)."""
    of = known_of(nats=nats, falls_at=("half of all",) * falls, smoothed=True)
    found = without_name({"thrust_exponent": of}, SETTINGS)
    assert found == (set() if named else {"thrust_exponent"})


@pytest.mark.parametrize(
    ("none", "moved", "named"),
    [(True, ("inertia_xx",), False), (True, (), True), (False, ("inertia_xx",), True)],
)
def test_what_may_be_none_beside_a_number_that_went_too_far_has_no_name(none, moved, named):
    """Of poses alone, a clean flight: a late command of 100 nats, 2 std from none, beside two inertias
    4 std too small (**synthetic**).
    """
    of = known_of(may_be_none=none, beside_moved=moved)
    assert without_name({"command_delay": of}, SETTINGS) == (set() if named else {"command_delay"})


@pytest.mark.parametrize(("share", "doubted"), [(0.5, False), (0.6, True)])
def test_nothing_is_sure_where_the_model_leaves_colour_in_most_channels(share, doubted):
    """Though what shows the effect is white; it keeps its name."""
    against = {"servo_play": known_of(elsewhere=share)}
    found = list(doubts("servo_play", against, SETTINGS))
    assert bool(found) == doubted and all("most of what was read" in text for text in found)
    assert not without_name(against, SETTINGS)
    shown = {"servo_play": known_of(elsewhere=share, coloured=("q",))}
    assert len(list(doubts("servo_play", shown, SETTINGS))) == 1


@pytest.mark.parametrize(
    ("effect", "aboard", "excess", "said"),
    [
        ("thrust_exponent", {"az", "h"}, -0.4, True),
        ("thrust_exponent", {"az", "h"}, 0.4, False),  # a lag makes it less
        ("thrust_exponent", {"h"}, -0.4, False),  # no accelerometer
        ("axial_damping", {"az", "h"}, -0.4, False),
    ],
)
def test_thrust_that_follows_less_may_be_a_low_pass_too_fast_to_be_seen(
    effect, aboard, excess, said
):
    problem: Any = SimpleNamespace(aboard=frozenset(aboard))
    fit = Fit((effect,), {f"{effect}.excess": excess}, Noise({}))
    assert may_hide_behind(problem, fit, effect) == said
    against = {effect: known_of(smoothed=said)}
    assert any("low-pass" in doubt for doubt in doubts(effect, against, SETTINGS)) == said


def test_nothing_is_sure_where_rows_have_clock_errors():
    """Errors of neighbouring rows are taken for independent; what smooths them makes them one."""
    against = {"marker_offset": known_of(clock_error=6.9e-4)}
    (text,) = doubts("marker_offset", against, SETTINGS)
    assert text == "the times of the log's rows are wrong by 0.69 ms"
    assert not without_name(against, SETTINGS)


@pytest.mark.parametrize(("off", "said"), [(3.1, True), (-3.1, True), (2.9, False)])
def test_what_shows_where_a_vehicles_own_number_went_far_is_doubted(off, said):
    """By prior std from its file's; the mass shows in az, the wind in ax and ay."""
    mass = FreeParameter("mass", 0.8, 0.01)
    by_channel = np.zeros((1, len(CHANNELS)))
    by_channel[0, CHANNELS.index("az")] = 1.0
    problem: Any = SimpleNamespace(base=(mass,), base_names=lambda active: ["mass"])
    quadratic: Any = SimpleNamespace(by_channel=by_channel, index=lambda names: [0])
    fit = Fit(("wind",), {"mass": 0.8 + off * 0.01}, Noise({}))
    assert moved_far(problem, fit, quadratic) == ({"mass": {"az"}} if said else {})
    against = {"wind": known_of(["ax"], beside_moved=("mass",) if said else ())}
    assert any("mass had to go far" in text for text in doubts("wind", against, SETTINGS)) == said


@pytest.mark.parametrize(("worth", "left", "said"), [(65.0, 14725.0, True), (65.0, 60.0, False)])
def test_a_bias_is_doubted_where_errors_that_last_are_worth_more(worth, left, said):
    """Of an accelerometer that drifts: 65 nats, sure, since 12 s of a run, on a clean flight."""
    against = {"accel_bias": known_of(["ax"], nats=worth, errors_left=left)}
    assert any("last" in text for text in doubts("accel_bias", against, SETTINGS)) == said


def test_nothing_is_sure_where_a_run_is_much_louder_than_its_noise():
    against = {"servo_play": known_of(loud=("pe", "pn"))}
    (text,) = doubts("servo_play", against, SETTINGS)
    assert "position east and position north" in text and "2 times as loud" in text
    assert not without_name(against, SETTINGS)


def test_a_size_is_that_beyond_the_off_value():
    """A decay of the ground effect of 2 per radius is what it is when nothing is known of it."""
    model = HeliModel(LAMA)
    own = {"ground_effect": tuple(model.effect_parameters("ground_effect"))}
    problem = replace(problem_of(1), model=model, own=own)
    usual = {f.name: f.std for f in own["ground_effect"]}
    for size, words in ((0.0, ""), (3.0, "3.0 usual sizes"), (-2.6, "")):
        decay = 2.0 + size * usual["ground_effect.decay"]
        values = {"ground_effect.gain": 0.1, "ground_effect.decay": decay}
        fit = Fit(("ground_effect",), values, Noise({}))
        found = " ".join(of_sizes(sizes(problem, fit, "ground_effect")))
        assert words in found and (size != 0.0 or not found)


def test_doubts_name_three_variations_and_count_the_rest():
    one, many = ["twice force xy"], [f"half level {k}" for k in range(5)]
    assert list(under_noise([])) == []
    assert list(under_noise(one)) == ["it does not hold at twice force xy"]
    (text,) = under_noise(many)
    assert "half level 2" in text and "half level 3" not in text
    assert text.endswith("2 more changes of the noise")
    (three,) = under_noise(many[:3])
    assert "more" not in three


@pytest.mark.parametrize(
    ("runs", "kept", "of", "words"),
    [(0.75, 0.8, 4, []), (0.74, 0.8, 4, ["gone without a or without b"]), (0.75, 0.79, 4, ["79 %"]),
     (0.75, None, 4, ["no half"]), (0.0, 1.0, 1, ["one run alone"])],
)  # fmt: skip
def test_shares_of_runs_and_halves_that_a_name_needs(runs, kept, of, words):
    found = list(on_parts(Replication(runs, kept, ("a", "b")), of, SETTINGS))
    assert len(found) == len(words)
    assert all(word in text for word, text in zip(words, found, strict=True))


# --- the hold-out -----------------------------------------------------------------------------------


@pytest.mark.parametrize("runs", [4, 12, 48, 200])
def test_the_hold_out_is_fair_quick_and_no_more_than_a_third_of_the_time(runs):
    """Random excitation: every column's held share is near a quarter, however many runs there are."""
    rng = np.random.default_rng(runs)
    shares = rng.gamma(2.0, 1.0, (runs, 40))
    shares /= shares.sum(0)
    seconds = rng.uniform(5.0, 30.0, runs)
    chosen = fair_part(shares, np.ones(40), seconds / seconds.sum())
    assert chosen and len(set(chosen)) == len(chosen)
    assert seconds[chosen].sum() <= seconds.sum() / 3.0
    if runs >= 48:
        assert shares[chosen].sum(0).mean() == pytest.approx(0.25, abs=0.04)


def test_what_two_runs_alone_show_is_neither_lost_nor_unseen():
    shares = np.full((8, 2), 1 / 8)
    shares[:, 1] = [0.5, 0.5, 0, 0, 0, 0, 0, 0]
    chosen = fair_part(shares, np.ones(2), np.full(8, 1 / 8))
    assert len({0, 1} & set(chosen)) == 1


# --- the search ------------------------------------------------------------------------------------


def test_a_trial_that_diverges_is_refused_and_says_so(monkeypatch):
    said: list[str] = []
    problem = replace(problem_of(1), progress=said.append)
    fit = Fit((), dict.fromkeys(NAMES, 0.0), Noise({}), objective=10.0)
    proposal = Proposal(f"+ {EFFECTS[0]}", EFFECTS[0], fit, 0.0, 14.0, "added")
    monkeypatch.setattr(moves, "fitted", lambda problem, fit: replace(fit, objective=math.inf))
    assert accepted(problem, fit, proposal) is None
    assert said == [f"refused + {EFFECTS[0]}: with it the filter diverges"]


@pytest.mark.parametrize(
    ("nats", "in_shocks", "words"),
    [
        (2.9 * SETTINGS.evidence, False, "in no list"),
        (3.1 * SETTINGS.evidence, False, ""),
        (3.1 * SETTINGS.evidence, True, "single shocks"),
        (11.0 * SETTINGS.evidence, True, ""),
    ],
)
def test_little_evidence_leaves_a_doubt_and_more_of_it_is_asked_in_shocks(nats, in_shocks, words):
    found = list(weak(nats, in_shocks, SETTINGS))
    assert bool(found) == bool(words) and all(words in text for text in found)


@pytest.mark.parametrize("nats", [21.7, 41.9, 42.0])
def test_a_moment_worth_little_beside_no_change_leaves_a_doubt(nats):
    """An axial damping that grows in a forward run: of blade elements, where it is always there."""
    found = list(doubts("axial_damping", {"axial_damping": known_of(of_moment=nats)}, SETTINGS))
    assert [f"worth {nats:.0f} nats only" in text for text in found] == [True] * (nats < 42.0)
