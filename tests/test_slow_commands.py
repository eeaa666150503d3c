"""Commands between slow rows: what the diagnosis takes them to do, and what numbers make of it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_between_rows import ramp

from coax_env import load_vehicle
from coax_env.diagnosis import slow_commands as module
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.remarks import _seen_late
from coax_env.diagnosis.searches.once import Searched
from coax_env.diagnosis.settings import SETTINGS
from coax_env.diagnosis.slow_commands import (
    REACTION,
    beside_straight_lines,
    between_known,
    from_reaction,
    held_after_all,
    likelier_on_the_way,
    likeliest_between,
)
from coax_env.estimation.between_rows import EVENLY, TRIED, Between, of_rows, with_between
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.state_space import Noise, Record
from coax_env.model.layout import CHANNELS

LAG = "motor_lag"
LAMA = load_vehicle("lama400d")


def problem_of(slow: bool = True, row: float = 0.04) -> Any:
    said: list[str] = []
    engine = SimpleNamespace(records=[ramp()])
    made = SimpleNamespace(
        engine=engine, has_slow_rows=slow, row=row, settings=SETTINGS, report=said.append, said=said,
        candidates=(),
    )  # fmt: skip

    def with_records(records: Any) -> Any:
        other = SimpleNamespace(**vars(made))
        other.engine = SimpleNamespace(records=records)
        return other

    made.with_records = with_records
    return made


def fit_of(*active: str, objective: float = 100.0) -> Fit:
    return Fit(active, {}, Noise({}), objective=objective)


@pytest.fixture
def ends(monkeypatch) -> dict[tuple[float, float], float]:
    """Minus the likelihoods by share and variance; 100 where none is said. Fits end there."""
    made: dict[tuple[float, float], float] = {}

    def end(problem: Any, fit: Fit, *steps: int) -> Fit:
        return fit_of(*fit.active, objective=made.get(of_rows(problem.engine.records), 100.0))

    monkeypatch.setattr(module, "fitted", end)
    monkeypatch.setattr(module, "converged", end)
    monkeypatch.setattr(module, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(module, "quadratic_at", lambda problem, fit: (fit, "there"))
    monkeypatch.setattr(module, "as_given", lambda problem, noise: (fit_of(), fit_of()))
    monkeypatch.setattr(
        module, "likelihoods", lambda *at: {of: -made.get(of, 100.0) for of in TRIED}
    )
    return made


@pytest.mark.parametrize(
    ("row", "likeliest", "worth", "taken"),
    [
        (0.04, (0.375, EVENLY), 93.0, (0.375, EVENLY)),
        (0.04, (0.0, EVENLY), 93.0, (0.0, EVENLY)),
        (0.02, (0.25, 0.0), 93.0, (0.25, 0.0)),
        (0.02, (0.25, 0.0), 95.0, (0.0, 0.0)),  # a tie is 6
        (0.01, (0.25, EVENLY), 50.0, (0.0, 0.0)),
    ],
)
def test_before_the_search_the_likeliest_of_shares_and_variances_is_taken(
    ends, row, likeliest, worth, taken
):
    ends[likeliest] = worth
    problem = problem_of(row=row)
    found = likeliest_between(problem, Noise({}))
    assert of_rows(found.engine.records) == taken
    assert len(problem.said) == (taken != (0.0, 0.0))


@pytest.mark.parametrize(
    ("worth", "taken"),
    [
        ({"plain": {(0.25, 0.0): 93.0}, "reacting": {(0.375, EVENLY): 50.0}}, (0.375, EVENLY)),
        ({"plain": {(0.25, 0.0): 93.0}, "reacting": {(0.375, EVENLY): 94.0}}, (0.25, 0.0)),
        ({"plain": {}, "reacting": {(0.0, 0.0): 50.0, (0.25, 0.0): 45.0}}, (0.0, 0.0)),  # a tie is 6
    ],
)
def test_rotors_that_react_may_tell_when_commands_were_sent(ends, monkeypatch, worth, taken):
    """Compared is with commands that are held, of rotors that react as well."""
    problem, refitted = problem_of(), fit_of()
    problem.candidates = (REACTION,)

    def likelihoods(engine: Any, values: Any, noise: Any) -> Any:
        kind = "reacting" if values.get(f"{REACTION}.gain") == 1.0 else "plain"
        return {of: -worth[kind].get(of, 100.0) for of in TRIED}

    monkeypatch.setattr(module, "likelihoods", likelihoods)
    assert of_rows(module.likeliest_at(problem, refitted).engine.records) == taken


@pytest.mark.parametrize(
    ("row", "active", "end", "again"),
    [
        (0.04, ("yaw_damping",), 93.0, True),
        (0.02, (), 93.0, True),
        (0.04, ("yaw_damping",), 95.0, False),  # a tie is 6
        (0.04, (REACTION,), 93.0, False),
        (0.01, ("yaw_damping",), 93.0, False),
    ],
)
def test_the_search_is_done_from_rotors_that_react_where_these_end_likelier(
    monkeypatch, row, active, end, again
):
    """Begun from the model as given, at the gain that physics has."""
    problem, fit, refitted = problem_of(row=row), fit_of(*active), fit_of(objective=200.0)
    problem.candidates = (REACTION,)

    def fitted(problem: Any, begun: Fit) -> Fit:
        assert (begun.active, begun.values) == ((REACTION,), {f"{REACTION}.gain": 1.0})
        return replace(begun, objective=end)

    monkeypatch.setattr(module, "noise_fitted", lambda problem, begun: begun)
    monkeypatch.setattr(module, "fitted", fitted)
    monkeypatch.setattr(module, "converged", lambda problem, begun: begun)
    monkeypatch.setattr(module, "likelier", lambda found, begun: replace(found, fit=begun))
    given: Any = None
    before = Searched(problem, refitted, refitted, fit, given)
    found = from_reaction(before)
    assert (found is not before) == again
    assert found.fit.active == ((REACTION,) if again else active)


@pytest.mark.parametrize(
    ("now", "held", "active", "again"),
    [
        ((0.0, EVENLY), 93.0, (LAG,), True),
        ((0.25, 0.0), 93.0, (LAG,), True),
        ((0.0, EVENLY), 95.0, (LAG,), False),  # a tie is 6
        ((0.0, EVENLY), 93.0, (), False),  # there is no cause that looked like them
        ((0.0, 0.0), 93.0, (LAG,), False),
    ],
)
def test_beside_what_was_found_commands_that_are_held_may_be_likelier(
    ends, now, held, active, again
):
    """Both are fitted alike from there."""
    problem = problem_of()
    problem = problem.with_records(with_between(problem.engine.records, Between(*now)))
    fit = fit_of(*active, objective=999.0)
    ends[0.0, 0.0] = held
    given: Any = None
    found = held_after_all(Searched(problem, fit, fit, fit, given))
    assert (found is not None) == again
    assert found is None or of_rows(found.engine.records) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("row", "active", "changing", "now", "likeliest", "worth", "taken"),
    [
        (0.04, (LAG,), None, 0.0, 0.5, 93.0, 0.5),
        (0.04, (LAG,), None, 0.5, 0.0, 93.0, 0.0),
        (0.02, (LAG,), None, 0.0, 0.125, 93.0, 0.125),
        (0.02, (LAG,), None, 0.0, 0.125, 95.0, None),  # a tie is 6
        (0.04, (), None, 0.0, 0.5, 50.0, None),  # there is no cause that commands may have hidden
        (0.04, (LAG,), object(), 0.0, 0.5, 50.0, None),  # something changed in flight
        (0.01, (LAG,), None, 0.0, 0.5, 50.0, None),
    ],
)
def test_commands_are_on_the_way_where_that_is_likelier_beside_a_cause(
    ends, row, active, changing, now, likeliest, worth, taken
):
    """Whether their means are known stays."""
    ends[likeliest, EVENLY] = worth
    problem, fit = problem_of(row=row), fit_of(*active)
    said = problem.said
    problem = problem.with_records(with_between(problem.engine.records, Between(now, EVENLY)))
    before: Any = Searched(problem, fit, fit, fit, None, changing=changing)  # type: ignore[arg-type]
    found = likelier_on_the_way(before)
    if taken is None:
        assert found is before
        return
    assert of_rows(found.problem.engine.records) == (taken, EVENLY)
    assert (found.fit.active, found.fit.objective) == (active, worth)
    assert found.quadratic == "there" and found.bare is fit
    when = ", changing at unknown times"
    assert said == [f"commands at {taken:g} of the way to the next row's{when}: 7.0 nats"]


def test_where_commands_are_held_the_other_fit_is_in_the_std(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "fitted", lambda problem, fit, steps: fit)
    monkeypatch.setattr(
        module, "converged", lambda problem, fit: fit_of(*fit.active, objective=7.0)
    )
    monkeypatch.setattr(module, "as_far_apart", lambda *given: asked.append(given) or given[1])
    quadratic: Any = None
    fit = fit_of(LAG)
    assert beside_straight_lines(problem_of(), fit, quadratic, {}) is fit
    ((_, _, _, _, other),) = asked
    assert other.objective == 7.0
    on_the_way = problem_of()
    on_the_way.engine.records = with_between(on_the_way.engine.records, Between(0.25, 0.0))
    for problem, same in (
        (problem_of(slow=False), fit), (problem_of(), fit_of()), (on_the_way, fit)
    ):  # fmt: skip
        assert beside_straight_lines(problem, same, quadratic, {}) is same
    assert len(asked) == 1


@pytest.mark.parametrize("every", [1, 2, 5, 10])
def test_commands_on_straight_lines_are_known_where_they_bend(every):
    """Of a log whose commands came at another rate; all are, where each row has its own."""
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(1201)
    knots = rng.standard_normal((t[::every].size, 4))
    command = np.column_stack([np.interp(t, t[::every], column) for column in knots.T])
    found = between_known([Record("a", t, np.round(command, 6), np.zeros((t.size, 1)))] * 2)
    assert found == pytest.approx(0.01 * every if every > 1 else 0.0, rel=0.02)


@pytest.mark.parametrize(("between", "rows", "unseen"), [(0.05, 0.01, True), (0.02, 0.01, False)])
def test_what_commands_did_between_seldom_ones_is_unseen(between, rows, unseen):
    model = HeliModel(load_vehicle("lama400d"))
    z = np.zeros((50, len(CHANNELS)))
    made = Problem.of(model, [Record("a", rows * np.arange(50), np.ones((50, 4)), z)])
    made = replace(made, between_commands=between)
    assert made.answers_unseen == unseen and not made.has_slow_rows
    said = [text for text in _seen_late(made) if "straight lines" in text]
    assert len(said) == unseen and all("50 ms" in text for text in said)
