"""What explained about as much as an effect when it came, in its place in the end."""

from types import SimpleNamespace
from typing import Any

import pytest

from coax_env.diagnosis import runners_up as module
from coax_env.diagnosis import search as searching
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.runners_up import FAR_OFF, exchanged, runners_up
from coax_env.diagnosis.scores import Score
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.state_space import FreeParameter, Noise

PLATE, MARKERS, DRAG = "swash_phase", "frame_yaw", "rotor_drag"
NUMBERS = {PLATE: "swash_phase.angle", MARKERS: "frame_yaw.angle", DRAG: "rotor_drag.coefficient"}
OWN = {effect: (FreeParameter(name, 0.0, 1.0),) for effect, name in NUMBERS.items()}


@pytest.fixture
def problem(monkeypatch) -> Any:
    """Fits end where `ends` says, by their effects, and in `asked` is what was fitted, in order."""
    said: list[str] = []
    made = SimpleNamespace(
        settings=SETTINGS, own=OWN, candidates=tuple(OWN), report=said.append, said=said, ends={},
        asked=[], large=True, worth=2.0 * FAR_OFF,
        file_values=lambda effect: {}, off_values=lambda effect: {NUMBERS[effect]: 0.0},
    )  # fmt: skip

    def fitted(problem: Any, fit: Fit, *steps: int) -> Fit:
        made.asked.append(fit)
        return Fit(fit.active, fit.values, fit.noise, made.ends[fit.active])

    monkeypatch.setattr(module, "fitted", fitted)
    monkeypatch.setattr(module, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(module, "converged", lambda problem, fit: fit)
    monkeypatch.setattr(module, "is_large", lambda problem, effect, values: made.large)
    monkeypatch.setattr(module, "loss", lambda problem, q, active, effect, inflation: made.worth)
    return made


def fit_of(*active: str) -> Fit:
    values = {**dict.fromkeys(NUMBERS.values(), 0.0), NUMBERS[PLATE]: 0.145}
    return Fit(active, values, Noise({}), objective=100.0)


def test_those_that_explain_half_as_much_as_the_first_are_kept_with_their_numbers(
    problem, monkeypatch
):
    def at_optimum(problem: Any, fit: Fit, quadratic: Any, active: Any, fixed: Any) -> Fit:
        return fit.at({NUMBERS[active[-1]]: 0.14})

    monkeypatch.setattr(module, "at_optimum", at_optimum)
    strong = [
        Score(e, nats, nats, True) for e, nats in ((PLATE, 286.0), (MARKERS, 264.0), (DRAG, 142.0))
    ]
    assert runners_up(problem, fit_of(), None, strong) == {MARKERS: {NUMBERS[MARKERS]: 0.14}}
    assert runners_up(problem, fit_of(), None, strong[:1]) == {}


@pytest.mark.parametrize(
    ("end", "worth", "large", "taken"),
    [
        (93.0, 2.0 * FAR_OFF, True, True),
        (95.0, 2.0 * FAR_OFF, True, False),  # a tie is 6
        (93.0, 0.9 * FAR_OFF, True, False),  # the quadratic reaches that far
        (93.0, 2.0 * FAR_OFF, False, False),
    ],
)
def test_the_likelier_one_takes_its_place(problem, end, worth, large, taken):
    problem.ends = {(DRAG, MARKERS): end}
    problem.worth, problem.large = worth, large
    others = {MARKERS: {NUMBERS[MARKERS]: 0.14}}
    found = exchanged(problem, fit_of(DRAG, PLATE), None, PLATE, others)
    assert (found is not None) == taken
    if found is not None:
        assert found.active == (DRAG, MARKERS) and found.history == (
            (f"{PLATE} -> {MARKERS}", 7.0),
        )
        first = problem.asked[0].values
        assert (first[NUMBERS[PLATE]], first[NUMBERS[MARKERS]]) == (0.0, 0.14)
        assert problem.said == [
            "frame_yaw explains it better than swash_phase, by 7.0 nats in the end"
        ]


def test_what_is_in_the_model_by_now_or_cannot_be_beside_it_is_not_asked(problem):
    others = {MARKERS: {NUMBERS[MARKERS]: 0.14}}
    assert exchanged(problem, fit_of(MARKERS, PLATE), None, PLATE, others) is None
    problem.candidates = (PLATE, DRAG)
    assert exchanged(problem, fit_of(PLATE), None, PLATE, others) is None
    assert problem.asked == []


def test_a_set_of_effects_is_asked_once(problem, monkeypatch):
    memory = searching._Memory(behind={PLATE: {MARKERS: {NUMBERS[MARKERS]: 0.14}}})
    problem.ends = {(MARKERS,): 100.0}
    for _ in range(2):
        assert searching._exchanged(problem, fit_of(PLATE), None, memory) is None  # type: ignore[arg-type]
    assert len(problem.asked) == 4, "of one trial"
