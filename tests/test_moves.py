"""Moves of the search, and the refit on everything, where scores and likelihoods are given."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.diagnosis import black_box as black_box_module
from coax_env.diagnosis import confounding, corrected_vehicle, moves
from coax_env.diagnosis.black_box import PRIOR_WIDTHS, black_box
from coax_env.diagnosis.moves import Proposal
from coax_env.diagnosis.problem import LATE_ROTORS, Fit, Problem
from coax_env.diagnosis.scores import Score
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.quadratic import Linearised, Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.model.effect_registry import GUST_MEMORY
from coax_env.model.generic_terms import AXES, TERMS

MODEL = HeliModel(load_vehicle("lama400d"))
NOISE = Noise({})


def problem(*effects: str) -> Problem:
    own = {e: tuple(MODEL.effect_parameters(e)) for e in effects}
    mass = next(f for f in MODEL.base_parameters() if f.name == "mass")
    engine = SimpleNamespace(threads=1, records=[])
    return Problem(MODEL, engine, (mass,), own)  # type: ignore[arg-type]


PROBLEM = problem("gyro_bias", "wind", "yaw_damping", "servo_lag")
OCCAM = SimpleNamespace(occam=lambda own, rest: 3.0)
FIT = Fit(
    ("gyro_bias", "wind"), {f.name: f.value for f in PROBLEM.parameters}, NOISE, objective=500.0
)


# --- rotors that nobody sees --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("had", "candidates", "tried"),
    [
        (("yaw_damping",), (), [{"yaw_damping"}]),
        (("motor_lag",), (), [set()]),
        (("command_delay",), ("servo_lag",), [{"command_delay"}, {"servo_lag"}]),
        (("command_delay",), (), [{"command_delay"}]),
        (("command_delay", "servo_delay"), ("servo_lag",), [{"command_delay", "servo_delay"}]),
    ],
)
def test_late_rotors_and_their_reaction_are_tried_from_their_usual_sizes(had, candidates, tried):
    """Beside what is late, and with a late servo for a late command; the machine's own numbers anew."""
    own = problem(*LATE_ROTORS, *had, *candidates)
    values = {f.name: 1.1 * f.value for f in own.base} | {"command_delay.time": 0.04}
    fit = replace(FIT, active=had).at(values)
    begun = list(moves._with_late_rotors(own, fit))
    assert [set(begin.active) - {*LATE_ROTORS} for begin in begun] == tried
    usual = {f.name: f.std for e in LATE_ROTORS for f in own.own[e]}
    for begin in begun:
        assert set(LATE_ROTORS) <= set(begin.active)
        assert {name: begin.values[name] for name in usual} == usual
        assert begin.values["mass"] == own.base[0].value
    if tried[-1] == {"servo_lag"}:
        assert begun[-1].values["servo_lag.time"] == 0.04
        assert begun[-1].values["command_delay.time"] == 0.0


@pytest.mark.parametrize(
    ("gains", "large", "taken"),
    [
        ((6.5, -100.0), True, 0),
        ((6.5, 7.0), True, 1),
        ((5.5, -100.0), True, None),
        ((100.0, 100.0), False, None),
        ((math.inf, -math.inf), True, None),
    ],
)
def test_the_likelier_late_rotors_stand_by_more_than_a_tie(monkeypatch, gains, large, taken):
    own = problem(*LATE_ROTORS, "command_delay", "servo_lag")
    fit = replace(FIT, active=("command_delay",)).at({f.name: f.value for f in own.parameters})

    def fitted(problem: Problem, begin: Fit, steps: int = 3) -> Fit:
        late = "servo_lag" in begin.active
        return replace(
            begin, objective=500.0 - gains[late] if math.isfinite(gains[late]) else math.nan
        )

    monkeypatch.setattr(moves, "fitted", fitted)
    monkeypatch.setattr(moves, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(moves, "converged", lambda problem, fit: fit)
    monkeypatch.setattr(moves, "quadratic_at", lambda problem, fit: (fit, None))
    monkeypatch.setattr(moves, "cost", lambda problem, fit, quadratic: fit.objective)
    monkeypatch.setattr(moves, "is_large", lambda *given: large)
    quadratic: Any = None
    found = moves.late_rotors(own, fit, quadratic)
    assert (found is None) == (taken is None)
    if found is not None:
        assert ("servo_lag" in found.active) == bool(taken)
        assert found.history[-1] == ("+ motor_lag and spin_up_reaction", gains[taken])


# --- a proposal, fitted -------------------------------------------------------------------------------


@pytest.mark.parametrize(("fallen", "taken"), [(17.1, True), (16.9, False)])
def test_a_proposal_must_gain_what_is_needed_beyond_occam(monkeypatch, fallen, taken):
    monkeypatch.setattr(
        moves, "fitted", lambda problem, fit: replace(fit, objective=500.0 - fallen)
    )
    for large in (True, False):
        monkeypatch.setattr(moves, "is_large", lambda *given, large=large: large)
        said: list[str] = []
        proposal = Proposal("+ wind", "wind", FIT, 3.0, 14.0, "added wind: {:.1f} nats")
        found = moves.accepted(replace(PROBLEM, progress=said.append), FIT, proposal)
        assert (found is not None) == (taken and large)
        if found is not None:
            assert found.history[-1] == ("+ wind", pytest.approx(fallen - 3.0))
            assert said == [f"added wind: {fallen - 3.0:.1f} nats"]


@pytest.fixture
def usual(monkeypatch):
    """What causes explain is not so much that another must be worth more than usual."""
    monkeypatch.setattr(moves, "threshold", lambda problem, quadratic, active: SETTINGS.evidence)


def test_trials_are_those_nearly_strong_and_dampings_with_half_the_evidence(monkeypatch, usual):
    """From 7 to 14 nats; those that take a number's place are none, nor what was tried."""
    monkeypatch.setattr(
        moves, "at_optimum", lambda problem, fit, q, active, at: replace(fit, active=active)
    )
    gains = {"yaw_damping": (7.1, {"yaw_damping.coefficient": 0.1})}
    monkeypatch.setattr(
        moves, "gain_by_likelihood", lambda problem, fit, q, e: gains.get(e, (-math.inf, {}))
    )
    made = problem("gyro_bias", "wind", "yaw_damping", "servo_lag", "added_mass", "swash_offset")
    fit = replace(FIT, active=("gyro_bias",))

    def tried(nats: dict[str, float], known: set[Any] = frozenset(), banned: Any = ()) -> Any:
        candidates = [Score(e, n, n, True) for e, n in nats.items()]
        found, dampings = moves.trials(made, fit, OCCAM, candidates, banned, known)
        assert all(p.occam == 3.0 and p.needed == 14.0 for p in found)
        return [p.effect for p in found], dampings

    weak = {"wind": 7.1, "servo_lag": 6.9, "added_mass": 10.0, "swash_offset": 14.0}
    assert tried(weak) == (["wind", "swash_offset", "yaw_damping"], ["yaw_damping"])
    assert tried({"wind": 14.1}) == (["yaw_damping"], ["yaw_damping"])
    assert tried(weak, {("gyro_bias", "wind")})[0] == ["swash_offset", "yaw_damping"]
    assert tried({}, banned=("yaw_damping",)) == ([], [])
    gains["yaw_damping"] = (6.9, {})
    assert tried({}) == ([], ["yaw_damping"])


@pytest.fixture
def hidden_by_noise(monkeypatch, usual):
    """Nats by which effects gain once their numbers are fitted, and by how many more with the noise."""
    gains: dict[str, tuple[float, float]] = {}
    base: list[float] = [0.0]  # what noise alone gains without an effect
    asked: list[str] = []

    def fitted(problem: Problem, fit: Fit, steps: int) -> Fit:
        numbers, noise = gains[fit.active[-1]]
        if fit.active[-1] not in asked:
            asked.append(fit.active[-1])
            return replace(fit, objective=500.0 - numbers)
        return replace(fit, objective=500.0 - numbers - noise)

    monkeypatch.setattr(
        moves, "at_optimum", lambda problem, fit, q, active, at: replace(fit, active=active)
    )
    monkeypatch.setattr(moves, "fitted", fitted)
    monkeypatch.setattr(moves, "noise_fitted", lambda problem, fit, seconds: fit)
    monkeypatch.setattr(
        moves, "converged", lambda problem, fit: replace(fit, objective=500.0 - base[0])
    )
    monkeypatch.setattr(moves, "is_large", lambda *given: True)
    return gains, base, asked


def anew(nats: dict[str, float], tried: Any = (), made: Problem = PROBLEM) -> Any:
    """What is added of candidates of so many nats."""
    fit = replace(FIT, active=("gyro_bias",))
    candidates = [Score(e, n, n, True) for e, n in nats.items()]
    return moves.with_noise_anew(made, fit, OCCAM, candidates, tried)  # type: ignore[arg-type]


def test_the_best_with_its_own_noise_is_added_whatever_its_score(hidden_by_noise):
    """Of those from 3.5 nats on that gain as much once fitted; 3 nats are the Occam factor."""
    gains, _, _ = hidden_by_noise
    made = problem("gyro_bias", "wind", "swash_offset", "yaw_inertia", "thrust_exponent")
    gains |= {"wind": (20.0, 1.0), "swash_offset": (8.0, 30.0), "thrust_exponent": (6.4, 900.0)}
    scores = {"wind": 17.0, "swash_offset": 3.6, "thrust_exponent": 5.0, "yaw_inertia": 3.4}
    found, asked = anew(scores, made=made)
    assert found.active == ("gyro_bias", "swash_offset")
    assert found.history[-1] == ("+ swash_offset", 35.0)
    assert asked == ["wind", "thrust_exponent", "swash_offset"]


@pytest.mark.parametrize(("with_noise", "alone", "taken"), [
    (9.1, 0.0, True), (8.9, 0.0, False), (12.0, 2.9, True), (12.0, 3.1, False),
])  # fmt: skip
def test_no_effect_is_credited_with_what_noise_gains_alone(
    hidden_by_noise, with_noise, alone, taken
):
    gains, base, _ = hidden_by_noise
    gains["wind"], base[0] = (8.0, with_noise), alone
    found, asked = anew({"wind": 4.0})
    assert (found is not None) == taken and asked == ["wind"]
    if found is not None:
        assert found.history[-1] == ("+ wind", pytest.approx(8.0 + with_noise - 3.0 - alone))


@pytest.mark.parametrize(("memory", "begins"), [(0.7, 0.7), (18.0, GUST_MEMORY)])
def test_in_gusts_that_last_an_effect_is_fitted_from_short_ones(
    monkeypatch, hidden_by_noise, memory, begins
):
    gains, _, _ = hidden_by_noise
    gains["wind"] = (8.0, 30.0)
    begun = []

    def noise_fitted(problem: Problem, fit: Fit, seconds: float) -> Fit:
        begun.append(fit.noise.process["memory_force_z"])
        return fit

    monkeypatch.setattr(moves, "noise_fitted", noise_fitted)
    noise = replace(FIT.noise, process={"force_z": 1.0, "memory_force_z": memory})
    fit = replace(FIT, active=("gyro_bias",), noise=noise)
    candidates = [Score("wind", 4.0, 4.0, True)]
    found, _ = moves.with_noise_anew(PROBLEM, fit, OCCAM, candidates, ())  # type: ignore[arg-type]
    assert found is not None and found.active[-1] == "wind"
    assert begun == [pytest.approx(begins)]


def test_what_looks_like_a_weak_answer_must_gain_three_times_as_much_unseen(
    monkeypatch, hidden_by_noise
):
    gains, _, _ = hidden_by_noise
    monkeypatch.setattr(Problem, "answers_unseen", True)
    monkeypatch.setattr(Problem, "sees_poses_alone", False)
    gains |= {"servo_lag": (40.0, 4.9), "wind": (10.0, 7.1)}
    assert anew({"servo_lag": 40.0, "wind": 4.0})[0].active[-1] == "wind"
    assert anew({"servo_lag": 10.4})[1] == [], "a third of its score is under 3.5"
    gains["servo_lag"] = (40.0, 50.0)
    assert anew({"servo_lag": 40.0, "wind": 4.0})[0].active[-1] == "servo_lag"


def test_what_is_too_small_or_takes_a_numbers_place_is_not_added_with_its_noise(
    monkeypatch, hidden_by_noise
):
    gains, _, _ = hidden_by_noise
    made = problem("gyro_bias", "wind", "added_mass")
    gains |= {"wind": (20.0, 9.0), "added_mass": (20.0, 9.0)}
    assert anew({"added_mass": 20.0}, made=made) == (None, [])
    monkeypatch.setattr(moves, "is_large", lambda problem, effect, values: effect != "wind")
    assert anew({"wind": 20.0}, made=made) == (None, ["wind"])


def test_a_trial_whose_filter_diverges_is_none_and_hides_no_other(hidden_by_noise):
    gains, _, asked = hidden_by_noise
    gains |= {"wind": (math.nan, 0.0), "swash_offset": (8.0, 30.0)}
    made = problem("gyro_bias", "wind", "swash_offset")
    found, _ = anew({"wind": 20.0, "swash_offset": 5.0}, made=made)
    assert found.active == ("gyro_bias", "swash_offset")
    asked.clear()
    assert anew({"wind": 20.0}, made=made)[0] is None


def test_what_was_tried_with_its_noise_is_not_again_nor_beside_too_many(hidden_by_noise):
    gains, _, _ = hidden_by_noise
    gains["wind"] = (20.0, 0.0)
    assert anew({"wind": 20.0}, {("gyro_bias", "wind")}) == (None, [])
    full = replace(PROBLEM, settings=replace(SETTINGS, most_causes=1))
    assert anew({"wind": 20.0}, made=full) == (None, [])


def test_no_more_causes_than_are_allowed(monkeypatch):
    strong = [Score("yaw_damping", 30.0, 30.0, True)]
    monkeypatch.setattr(moves, "stepped", lambda problem, fit, passes, q: fit)
    most = replace(PROBLEM, settings=replace(SETTINGS, most_causes=3))
    added = moves.add(most, FIT, [], None, strong)  # type: ignore[arg-type]
    assert added is not None and added.active == ("gyro_bias", "wind", "yaw_damping")
    assert added.history == (("+ yaw_damping", 30.0),)
    full = replace(PROBLEM, settings=replace(SETTINGS, most_causes=2))
    assert moves.add(full, FIT, [], None, strong) is None  # type: ignore[arg-type]
    assert moves.add(most, FIT, [], None, []) is None  # type: ignore[arg-type]


# --- a cause dropped ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("worth", "large", "confirmed", "gone"),
    [
        ({"gyro_bias": 13.9, "wind": 50.0}, True, True, "gyro_bias"),
        ({"gyro_bias": 13.9, "wind": 50.0}, True, False, None),
        ({"gyro_bias": 14.1, "wind": 50.0}, True, True, None),
        ({"gyro_bias": 13.0, "wind": -4.0}, True, True, "wind"),
        ({"gyro_bias": 90.0, "wind": 50.0}, False, False, "gyro_bias"),
    ],
)
def test_the_cause_worth_least_is_dropped_where_a_refit_confirms_it(
    monkeypatch, usual, worth, large, confirmed, gone
):
    """One too small to matter goes, if settled noise makes it no larger."""
    monkeypatch.setattr(moves, "converged", lambda problem, fit: fit)
    monkeypatch.setattr(moves, "inflation", lambda *given: 2.0)
    monkeypatch.setattr(
        moves, "loss", lambda problem, q, active, e, by: worth[e] + (0.0 if by == 2.0 else 1e3)
    )
    monkeypatch.setattr(
        moves, "is_large", lambda problem, e, values: large or e != "gyro_bias"
    )  # fmt: skip
    monkeypatch.setattr(moves, "_is_worthless", lambda *given: confirmed)
    monkeypatch.setattr(
        moves, "at_optimum", lambda problem, fit, q, active, at: replace(fit, active=active)
    )
    found = moves.drop(PROBLEM, FIT, None, coloured=True)  # type: ignore[arg-type]
    assert (found is None) == (gone is None)
    if found is not None:
        assert set(found.active) == {"gyro_bias", "wind"} - {gone}
        nats = 0.0 if not large else max(worth[gone], 0.0)
        assert found.history == ((f"- {gone}", nats),)
    if large and confirmed:
        assert moves.drop(PROBLEM, FIT, None, coloured=False) is None, "white ones are not inflated"


@pytest.mark.parametrize(
    ("worth", "grows", "stays"), [(141.0, True, True), (139.0, True, False), (141.0, False, False)]
)
def test_what_is_worth_ten_thresholds_may_grow_as_the_noise_settles(
    monkeypatch, usual, worth, grows, stays
):
    """Small beside noise that had taken it up, and worth much: it stands if it is large in the end."""
    at_last = FIT.at({"gyro_bias.x": 1.0})
    monkeypatch.setattr(moves, "converged", lambda problem, fit: at_last)
    monkeypatch.setattr(moves, "inflation", lambda *given: 1.0)
    monkeypatch.setattr(moves, "loss", lambda problem, q, active, e, by: worth)
    monkeypatch.setattr(
        moves, "is_large",
        lambda problem, e, values: e != "gyro_bias" or (grows and values is at_last.values),
    )  # fmt: skip
    monkeypatch.setattr(
        moves, "at_optimum", lambda problem, fit, q, active, at: replace(fit, active=active)
    )
    found = moves.drop(PROBLEM, FIT, None, coloured=False)  # type: ignore[arg-type]
    assert found is not None and (found is at_last) == stays
    assert ("gyro_bias" in found.active) == stays


@pytest.mark.parametrize(("risen", "gone"), [(33.9, True), (34.1, False)])
def test_a_refit_says_what_a_cause_is_worth(monkeypatch, risen, gone):
    """What the objective rises without it, half as much by its inflation, less Occam's 3 nats."""
    monkeypatch.setattr(moves, "without", lambda problem, fit, q, e: fit)
    monkeypatch.setattr(
        moves, "fitted", lambda problem, fit, held: replace(fit, objective=500.0 + risen)
    )
    found = moves._is_worthless(PROBLEM, FIT, OCCAM, "wind", 2.0, 14.0)  # type: ignore[arg-type]
    assert found == gone


# --- what would do as well ----------------------------------------------------------------------------


def test_what_is_near_does_something_in_a_causes_place(monkeypatch):
    """Of the 40 nats that the cause gains, more than half; and within what is asked, best first."""
    changes = {"yaw_damping": 19.0, "servo_lag": 21.0}
    monkeypatch.setattr(
        confounding, "swap", lambda problem, q, active, old, new: (changes[new], np.zeros(1))
    )
    q = SimpleNamespace(best=lambda free, fixed=None: (-60.0 if fixed is None else -20.0, None))

    def near(most: float) -> list[str]:
        found = confounding._near(PROBLEM, FIT, q, "wind", most)  # type: ignore[arg-type]
        return [other for other, _ in found]

    assert near(30.0) == ["yaw_damping"] and near(18.0) == []
    changes.update(servo_lag=-5.0)
    assert near(30.0) == ["servo_lag", "yaw_damping"]


# --- all runs together --------------------------------------------------------------------------------

NAMES = ("mass", "yaw_damping.coefficient")


class Runs:
    """An engine over runs each of whose likelihoods is a parabola: its curvature and its best."""

    def __init__(self, model: Any, records: Any, threads: int = 1) -> None:
        self.model, self.records, self.threads = model, tuple(records), threads

    def filter(self, values: dict[str, float], noise: Noise) -> list[Any]:
        x = np.array([values[n] for n in NAMES])
        return [
            SimpleNamespace(log_likelihood=-0.5 * (x - r.best) @ r.G @ (x - r.best))
            for r in self.records
        ]

    def linearise(self, values: dict[str, float], noise: Noise, free: Any) -> Any:
        x = np.array([values[n] for n in NAMES])
        slope = np.array([r.G @ (x - r.best) for r in self.records])
        G = np.array([r.G for r in self.records])
        lin = Linearised(NAMES, G, slope, np.ones((len(G), 2, 1)), slope)
        return self.filter(values, noise), lin


def run(seed: int) -> Any:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4, 2)) * [40.0, 900.0]
    return SimpleNamespace(G=A.T @ A, best=np.array([0.42, 0.004]) + rng.normal(0, [0.01, 5e-4]))


def test_with_the_held_out_runs_it_is_the_posterior_of_all(monkeypatch):
    """Two runs were fitted; two more are taken in: best and covariance of all four and the prior."""
    monkeypatch.setattr(corrected_vehicle, "Engine", Runs)
    monkeypatch.setattr(
        corrected_vehicle, "engine_as_fitted", lambda problem, records, fit: Runs(MODEL, records)
    )
    made = problem("yaw_damping")
    free = made.free(("yaw_damping",))
    runs = [run(k) for k in range(4)]
    prior = np.diag([f.std**-2.0 for f in free])
    mean = np.array([f.value for f in free])

    def best(some: list[Any]) -> tuple[np.ndarray, np.ndarray]:
        A = sum(r.G for r in some) + prior
        return np.linalg.solve(A, sum(r.G @ r.best for r in some) + prior @ mean), np.linalg.inv(A)

    made = replace(made, engine=Runs(MODEL, runs[:2]))
    at, _ = best(runs[:2])
    values = dict(zip(NAMES, at.tolist(), strict=True))
    passes, lin = made.engine.linearise(values, NOISE, free)
    away = 0.5 * float((at - mean) @ prior @ (at - mean))
    cost = away - sum(p.log_likelihood for p in passes)
    fit = Fit(("yaw_damping",), values, NOISE, objective=cost)
    quadratic = Quadratic.of(lin, free, values)
    found, covariance = corrected_vehicle.with_held_out(made, fit, quadratic, runs[2:])  # type: ignore
    expected, spread = best(runs)
    np.testing.assert_allclose([found[n] for n in NAMES], expected, rtol=1e-6)
    np.testing.assert_allclose(covariance, spread, rtol=1e-9)
    alone, own = corrected_vehicle.with_held_out(made, fit, quadratic, [])
    assert alone == values
    np.testing.assert_allclose(own, best(runs[:2])[1], rtol=1e-9)


def test_what_is_left_of_a_slope_where_it_is_fitted_is_what_signatures_lack():
    """But at a bound, where a slope is left whatever they show."""
    at = np.array([1.0, 2.0, 0.0])
    lower, upper = np.array([-9.0, -9.0, 0.0]), np.array([9.0, 2.0, 9.0])
    g, mean, precision = np.array([3.0, 5.0, 7.0]), np.array([0.5, 0.0, 0.0]), np.full(3, 4.0)
    q = Quadratic(("a", "b", "c"), np.eye(3), g, at, mean, precision, lower, upper,
                  np.zeros((1, 3)), np.ones((3, 1)))  # fmt: skip
    found = corrected_vehicle._beyond_signatures(q, np.array([0, 1, 2]))
    np.testing.assert_allclose(found, [-(3.0 + 4.0 * 0.5), 0.0, 0.0])


@pytest.mark.parametrize(("far", "share"), [(1.5, 1.0), (3.0, 0.5), (6.0, 0.25), (12.0, 0.0)])
def test_a_step_on_all_runs_is_shortened_until_it_gains(far, share):
    """On a parabola what is less than twice too long gains."""
    one = SimpleNamespace(G=np.diag([100.0, 1e4]), best=np.array([0.5, 0.002]))
    engine = Runs(MODEL, [one])
    free = [FreeParameter(n, 0.0, 1e9) for n in NAMES]
    values = {"mass": 0.4, NAMES[1]: 0.002}
    cost = -engine.filter(values, NOISE)[0].log_likelihood
    fit = Fit((), values, NOISE, objective=cost)
    _, lin = engine.linearise(values, NOISE, free)
    q = Quadratic.of(lin, free, values)
    there, gained = corrected_vehicle._moved(engine, fit, q, free, np.array([0.1 * far, 0.0]))  # type: ignore
    assert there.values["mass"] == pytest.approx(0.4 + 0.1 * far * share)
    after = -engine.filter(there.values, NOISE)[0].log_likelihood
    assert gained == pytest.approx(cost - after) and (gained > 0.0) == (share > 0.0)
    assert there.objective == pytest.approx(after)


# --- every term at once -------------------------------------------------------------------------------


def test_a_black_box_shrinks_each_axis_by_its_own_evidence(monkeypatch):
    """Independent coefficients: the width of largest evidence axis by axis, values shrunk by it."""
    known = [t for t in TERMS if t.key in ("u", "v")]
    monkeypatch.setattr(black_box_module, "measured_terms", lambda problem: known)
    sizes = dict(zip(AXES, (0.0, 0.02, 0.08, 0.25, 1.0, 3.0), strict=True))  # in usual sizes

    def linearise(box: Problem, fit: Fit) -> Any:
        free = box.parameters
        std = np.array([f.std for f in free])
        own = np.array([sizes.get(f.name.partition(".")[0], 0.0) for f in free])
        G = np.diag(4e4 / std**2)
        at = np.array([fit.values[f.name] for f in free])
        q = Quadratic(tuple(f.name for f in free), G, -G @ (own * std), at,
                      np.array([f.value for f in free]), std**-2.0, np.full(len(free), -np.inf),
                      np.full(len(free), np.inf), np.zeros((1, len(free))),
                      np.ones((len(free), 18)))  # fmt: skip
        return fit, [], q

    monkeypatch.setattr(black_box_module, "linearise", linearise)
    made = problem("gyro_bias")
    refitted = Fit(("gyro_bias",), {f.name: f.value for f in made.parameters}, NOISE)
    found = black_box(made, refitted)
    assert found.active == ()
    for axis, size in sizes.items():

        def evidence(width: float, size: float = size) -> float:
            spread = width**2 + 1.0 / 4e4
            return -0.5 * size**2 / spread - 0.5 * math.log(spread)

        width = max(PRIOR_WIDTHS, key=evidence)
        shrunk = size * width**2 / (width**2 + 1.0 / 4e4)
        for t in known:
            (f,) = black_box_module.parameters(MODEL, axis, [t])
            assert found.values[f.name] == pytest.approx(shrunk * f.std, rel=1e-6, abs=1e-15)


def test_a_black_boxs_widths_stand_beside_the_vehicles_own_numbers(monkeypatch):
    """A coefficient that shares most of its column with the mass, which stands off its prior's mean."""
    known = [t for t in TERMS if t.key == "u"]
    monkeypatch.setattr(black_box_module, "measured_terms", lambda problem: known)
    size, shared = 0.3, 0.999

    def linearise(box: Problem, fit: Fit) -> Any:
        free = box.parameters
        std = np.array([f.std for f in free])
        names = [f.name for f in free]
        mean = np.array([f.value for f in free])
        at = np.array([fit.values[n] for n in names])
        at[0] = mean[0] + 0.5 * std[0]
        G = 4e4 * np.eye(len(free))
        k = names.index("unlisted_Z.u")
        G[0, k] = G[k, 0] = 4e4 * shared
        g = np.zeros(len(free))
        g[k] = -4e4 * (1.0 - shared**2) * size
        g[0] = -0.5  # where it is fitted, data and prior pull as much
        none = np.full(len(free), np.inf)
        q = Quadratic(tuple(names), G / np.outer(std, std), g / std, at, mean, std**-2.0, -none, none,
                      np.zeros((1, len(free))), np.ones((len(free), 18)))  # fmt: skip
        return fit.at(dict(zip(names, at.tolist(), strict=True))), [], q

    monkeypatch.setattr(black_box_module, "linearise", linearise)
    made = problem("gyro_bias")
    refitted = Fit(("gyro_bias",), {f.name: f.value for f in made.parameters}, NOISE)
    found = black_box(made, refitted)
    left = 4e4 - (4e4 * shared) ** 2 / (4e4 + 1.0)  # information beside the mass
    slope = 4e4 * (1.0 - shared**2) * size

    def evidence(width: float) -> float:
        return 0.5 * slope**2 / (left + width**-2) - 0.5 * math.log(1.0 + left * width**2)

    width = max(PRIOR_WIDTHS, key=evidence)
    assert PRIOR_WIDTHS[0] > width > PRIOR_WIDTHS[-1], "neither end"
    (f,) = black_box_module.parameters(MODEL, "unlisted_Z", known)
    assert found.values[f.name] == pytest.approx(slope / (left + width**-2) * f.std, rel=1e-6)
