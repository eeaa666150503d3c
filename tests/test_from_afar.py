"""Another effect in the place of one: what makes a servo late, and what was the runner-up."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import injector
import pytest
from test_moves import FIT
from test_moves import problem as problem_of

from coax_env import load_vehicle
from coax_env.diagnosis import from_afar
from coax_env.diagnosis import search as searching
from coax_env.diagnosis.fits import converged, fitted, quadratic_at, start
from coax_env.diagnosis.from_afar import FAR_OFF, exchanged, far_swap, runners_up
from coax_env.diagnosis.problem import LATE_SERVO, Fit, Problem
from coax_env.diagnosis.scores import Score
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.logs.flight import read_flight

# --- what was the runner-up ---------------------------------------------------------------------------

PLATE, MARKERS, DRAG = "swash_phase", "frame_yaw", "rotor_drag"
NUMBERS = {PLATE: "swash_phase.angle", MARKERS: "frame_yaw.angle", DRAG: "rotor_drag.coefficient"}
OWN = {effect: (FreeParameter(name, 0.0, 1.0),) for effect, name in NUMBERS.items()}


@pytest.fixture
def problem(monkeypatch) -> Any:
    """Fits end where `ends` says, by their effects, and in `asked` is what was fitted, in order."""
    said: list[str] = []
    made = SimpleNamespace(
        settings=SETTINGS, own=OWN, candidates=tuple(OWN), report=said.append, said=said, ends={},
        asked=[], large=True, occam={}, worth=2.0 * FAR_OFF, changing=(),
        changes=lambda effect: effect in made.changing, file_values=lambda effect: {},
        off_values=lambda effect: {NUMBERS[effect]: 0.0},
    )  # fmt: skip

    def fitted(problem: Any, fit: Fit, *steps: int) -> Fit:
        made.asked.append(fit)
        return Fit(fit.active, fit.values, fit.noise, made.ends[fit.active])

    monkeypatch.setattr(from_afar, "fitted", fitted)
    monkeypatch.setattr(from_afar, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(from_afar, "converged", lambda problem, fit: fit)
    monkeypatch.setattr(from_afar, "is_large", lambda problem, effect, values: made.large)
    monkeypatch.setattr(from_afar, "quadratic_at", lambda problem, fit: (fit, None))
    monkeypatch.setattr(
        from_afar,
        "cost",
        lambda problem, fit, q: fit.objective + made.occam.get(fit.active[-1], 0.0),
    )
    monkeypatch.setattr(from_afar, "loss", lambda problem, q, active, effect, inflation: made.worth)
    return made


def fit_of(*active: str) -> Fit:
    values = {**dict.fromkeys(NUMBERS.values(), 0.0), NUMBERS[PLATE]: 0.145}
    return Fit(active, values, Noise({}), objective=100.0)


def test_those_that_explain_half_as_much_as_the_first_are_kept_with_their_numbers(
    problem, monkeypatch
):
    def at_optimum(problem: Any, fit: Fit, quadratic: Any, active: Any, fixed: Any) -> Fit:
        return fit.at({NUMBERS[active[-1]]: 0.14})

    monkeypatch.setattr(from_afar, "at_optimum", at_optimum)
    strong = [
        Score(e, nats, nats, True) for e, nats in ((PLATE, 286.0), (MARKERS, 264.0), (DRAG, 142.0))
    ]
    assert runners_up(problem, fit_of(), None, strong) == {MARKERS: {NUMBERS[MARKERS]: 0.14}}
    assert runners_up(problem, fit_of(), None, strong[2:]) == {}


@pytest.mark.parametrize(("first", "other"), [(PLATE, MARKERS), (MARKERS, PLATE)])
def test_what_turns_alike_is_a_runner_up_however_little_it_explains(
    problem, monkeypatch, first, other
):
    """And is begun at the other's angle. What is in the model, or may not be named, is none."""
    monkeypatch.setattr(from_afar, "at_optimum", lambda p, fit, q, a, fixed: fit)
    strong = [Score(first, 286.0, 286.0, True)]
    others = runners_up(problem, fit_of(), None, strong)
    assert set(others) == {other}
    problem.ends = {(DRAG, other): 50.0}
    fit = fit_of(DRAG, first).at({NUMBERS[first]: -0.1})
    found = exchanged(problem, fit, None, first, others)
    assert found is not None and found.active == (DRAG, other)
    begun = problem.asked[0].values
    assert (begun[NUMBERS[first]], begun[NUMBERS[other]]) == (0.0, -0.1)
    assert runners_up(problem, fit_of(other), None, strong) == {}
    problem.candidates = (first, DRAG)
    assert runners_up(problem, fit_of(), None, strong) == {}


@pytest.mark.parametrize(
    ("end", "occam", "worth", "large", "taken"),
    [
        (91.0, 2.0, 2.0 * FAR_OFF, True, True),
        (91.0, 4.0, 2.0 * FAR_OFF, True, False),  # a tie is 6
        (91.0, 2.0, 0.9 * FAR_OFF, True, False),  # the quadratic reaches that far
        (91.0, 2.0, 2.0 * FAR_OFF, False, False),
    ],
)
def test_the_likelier_one_takes_its_place(problem, end, occam, worth, large, taken):
    """By its evidence: what has more numbers pays for them."""
    problem.ends, problem.occam = {(DRAG, MARKERS): end}, {MARKERS: occam}
    problem.worth, problem.large = worth, large
    others = {MARKERS: {NUMBERS[MARKERS]: 0.14}}
    found = exchanged(problem, fit_of(DRAG, PLATE), None, PLATE, others)
    assert (found is not None) == taken
    if found is not None:
        assert found.active == (DRAG, MARKERS) and found.history == (
            (f"{PLATE} -> {MARKERS}", 7.0),
        )
        first = problem.asked[0].values
        assert (first[NUMBERS[PLATE]], first[NUMBERS[MARKERS]]) == (0.0, 0.145)
        assert problem.said == [
            "frame_yaw explains it better than swash_phase, by 7.0 nats in the end"
        ]


def test_what_is_in_the_model_by_now_or_cannot_be_beside_it_is_not_asked(problem):
    others = {MARKERS: {NUMBERS[MARKERS]: 0.14}}
    assert exchanged(problem, fit_of(MARKERS, PLATE), None, PLATE, others) is None
    for changing in ((PLATE,), (MARKERS,)):
        problem.changing = changing
        assert exchanged(problem, fit_of(PLATE), None, PLATE, others) is None
    problem.changing, problem.candidates = (), (PLATE, DRAG)
    assert exchanged(problem, fit_of(PLATE), None, PLATE, others) is None
    assert problem.asked == []


def test_a_set_of_effects_is_asked_once(problem, monkeypatch):
    memory = searching._Memory(behind={PLATE: {MARKERS: {NUMBERS[MARKERS]: 0.14}}})
    problem.ends = {(MARKERS,): 100.0}
    for _ in range(2):
        assert searching._exchanged(problem, fit_of(PLATE), None, memory) is None  # type: ignore[arg-type]
    assert len(problem.asked) == 4, "of one trial"


# --- what makes a servo late --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("had", "candidates", "tried"),
    [
        ("servo_lag", ("servo_rate", "servo_delay"), ["servo_rate"]),
        ("servo_rate", ("servo_lag", "servo_delay"), ["servo_lag", "servo_delay"]),
        ("servo_lag", ("servo_delay",), []),
        ("wind", ("servo_lag", "servo_rate"), []),
    ],
)
def test_what_makes_a_servo_late_is_fitted_in_the_place_of_what_else_does(
    monkeypatch, had, candidates, tried
):
    """From its likeliest size, and taken where it is likelier by more than a tie and large."""
    peak = {"servo_rate": 2.2, "servo_lag": 0.03, "servo_delay": 0.011}

    def likelihood(values: dict[str, float], noise: Noise) -> float:
        sizes = {e: values[f.name] for e in tried for f in own.own[e]}
        return -sum(math.log(x / peak[e]) ** 2 for e, x in sizes.items() if x > 0.0)

    own = problem_of(had, *candidates)
    engine: Any = SimpleNamespace(threads=1, records=[], log_likelihood=likelihood)
    own = replace(own, engine=engine)
    begun: list[tuple[str, dict[str, float]]] = []
    gained = 0.0

    def without(problem: Problem, fit: Fit, quadratic: object, old: str) -> Fit:
        return replace(fit, active=fit.rest(old))

    def fitted(problem: Problem, fit: Fit) -> Fit:
        (new,) = fit.active
        begun.append((new, {f.name: fit.values[f.name] for f in own.own[new]}))
        return replace(fit, objective=500.0 - gained)

    for name, stand_in in (("without", without), ("fitted", fitted)):
        monkeypatch.setattr(from_afar, name, stand_in)
    monkeypatch.setattr(from_afar, "converged", lambda problem, fit: fit)
    fit = replace(FIT, active=(had,), values={f.name: f.value for f in own.parameters})
    quadratic: Any = None
    assert far_swap(own, fit, quadratic) is None
    assert list(dict.fromkeys(e for e, _ in begun)) == tried
    for e, values in begun:
        assert list(values.values()) == [pytest.approx(peak[e], rel=0.03)]
    gained = SETTINGS.tie + 0.1
    found = far_swap(own, fit, quadratic)
    assert (found.active if found else ()) == tuple(tried[:1])
    begun.clear()
    with monkeypatch.context() as patch:
        patch.setattr(Problem, "changes", lambda problem, effect: True)
        assert far_swap(own, fit, quadratic) is None and not begun, "it has two sizes"
    monkeypatch.setattr(from_afar, "is_large", lambda *given: False)
    assert far_swap(own, fit, quadratic) is None


def test_no_delay_stands_in_a_limited_rates_place_beside_a_lag():
    """One servo has a lag or a delay; either may stand for the rate where it is alone."""
    own = problem_of(*LATE_SERVO)
    fit = replace(FIT, active=("servo_lag", "servo_rate"))
    assert from_afar._late_pairs(own, fit) == []
    alone = replace(FIT, active=("servo_rate",))
    assert [new for _, new in from_afar._late_pairs(own, alone)] == ["servo_lag", "servo_delay"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "named"),
    [
        ({"servo_rate": {"limit": 1.33}}, "servo_lag"),
        ({"servo_lag": {"time": 0.06}}, "servo_rate"),
        ({"servo_lag": {"time": 0.06}}, "servo_lag"),
    ],
)
def test_a_limited_rate_and_a_lag_are_told_apart_in_gusts(tmp_path, hidden, named):
    """A servo of each kind, beside play, named as the other: what it is takes its place."""
    effects = hidden | {"servo_play": {"width": 0.02}}
    folder = injector.fly(
        tmp_path / "f", effects, gusts=True, runs=("lon_3211", "lat_3211", "forward_run"), seed=4
    )
    flight = read_flight(folder)
    model = HeliModel(load_vehicle("lama400d"))
    made = Problem.of(model, [record_of(run) for run in flight.runs], (*LATE_SERVO, "servo_play"))
    fit = start(made, starting_noise(flight, model.vehicle))
    usual = {f.name: f.value + f.probe for e in (named, "servo_play") for f in made.own[e]}
    fit = replace(fit.at(usual), active=(named, "servo_play"))
    fit, quadratic = quadratic_at(made, converged(made, fitted(made, fit)))
    found = far_swap(made, fit, quadratic)
    (true,) = hidden
    assert (found is None) == (named == true)
    if found is not None:
        assert found.active == (true, "servo_play")
        ((number, size),) = hidden[true].items()
        assert found.values[f"{true}.{number}"] == pytest.approx(size, rel=0.15)
