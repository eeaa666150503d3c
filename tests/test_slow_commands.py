"""Commands between slow rows: held, or on straight lines, and what that makes of the numbers."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.diagnosis import slow_commands as module
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.remarks import _seen_late
from coax_env.diagnosis.searches.once import Searched
from coax_env.diagnosis.settings import SETTINGS
from coax_env.diagnosis.slow_commands import (
    ON_LINES,
    SHARES,
    beside_straight_lines,
    between_known,
    likelier_on_the_way,
    on_the_way,
)
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.state_space import Noise, Record
from coax_env.model.layout import CHANNELS

LAG = "motor_lag"


def ramp(rows: int = 5) -> Record:
    """Commands that rise by 1, 2, 3 and 4 a row."""
    command = np.outer(np.arange(rows), [1.0, 2.0, 3.0, 4.0])
    return Record("a", 0.04 * np.arange(rows), command, np.zeros((rows, 1)))


def problem_of(slow: bool = True, row: float = 0.04) -> Any:
    said: list[str] = []
    engine = SimpleNamespace(records=[ramp()])
    made = SimpleNamespace(
        engine=engine, has_slow_rows=slow, row=row, settings=SETTINGS, report=said.append, said=said
    )

    def with_records(records: Any) -> Any:
        other = SimpleNamespace(**vars(made))
        other.engine = SimpleNamespace(records=records)
        return other

    made.with_records = with_records
    return made


def fit_of(*active: str, objective: float = 100.0) -> Fit:
    return Fit(active, {}, Noise({}), objective=objective)


def test_a_rows_command_is_the_mean_of_the_line_to_the_next():
    """Of a ramp that of its middle; the last row's has no next. Readings and times stay."""
    sound = ramp()
    (found,) = on_the_way([sound], ON_LINES)
    np.testing.assert_allclose(
        found.command[:-1], np.outer(np.arange(4) + 0.5, [1.0, 2.0, 3.0, 4.0])
    )
    np.testing.assert_array_equal(found.command[-1], sound.command[-1])
    assert found.t is sound.t and found.z is sound.z
    np.testing.assert_array_equal(sound.command, ramp().command, "the log itself stays")


@pytest.mark.parametrize("step", [1, 2, 4])
def test_of_commands_between_rows_the_mean_is_a_share_of_the_next(step):
    """One of two that were logged, on a line, has a quarter of the next; of very many a half."""
    fine = np.linspace(0.0, 1.0, step + 1)[:step]
    record = ramp(2)
    (found,) = on_the_way([record], (step - 1) / (2 * step))
    np.testing.assert_allclose(found.command[0], fine.mean() * record.command[1])


@pytest.mark.parametrize(
    ("row", "active", "changing", "ends", "taken"),
    [
        (0.04, (LAG,), None, (99.0, 97.0, 93.0), 0.5),
        (0.02, (LAG,), None, (93.0, 97.0, 99.0), 0.125),
        (0.02, (LAG,), None, (95.0, 97.0, 99.0), 0.0),  # a tie is 6
        (0.04, (), None, (50.0, 50.0, 50.0), 0.0),  # there is no cause that commands may have hidden
        (0.04, (LAG,), object(), (50.0, 50.0, 50.0), 0.0),  # something changed in flight
        (0.01, (LAG,), None, (50.0, 50.0, 50.0), 0.0),
    ],
)
def test_commands_are_on_the_way_where_that_is_likelier_beside_a_cause(
    monkeypatch, row, active, changing, ends, taken
):
    """`ends`: minus the likelihoods with each share; 100 with none."""
    of_share = dict(zip(SHARES, ends, strict=True))

    def end(problem: Any, fit: Fit) -> Fit:
        share = problem.engine.records[0].command[0, 0]
        return fit_of(*fit.active, objective=of_share[share])

    monkeypatch.setattr(module, "fitted", lambda problem, fit, steps: fit)
    monkeypatch.setattr(module, "converged", end)
    monkeypatch.setattr(module, "quadratic_at", lambda problem, fit: (fit, "there"))
    problem, fit = problem_of(row=row), fit_of(*active)
    before: Any = Searched(problem, fit, fit, fit, None, changing=changing)  # type: ignore[arg-type]
    found = likelier_on_the_way(before)
    assert found.of_next == taken
    if taken:
        np.testing.assert_allclose(
            found.problem.engine.records[0].command[0], taken * np.array([1.0, 2.0, 3.0, 4.0])
        )
        assert (found.fit.active, found.fit.objective) == (active, min(ends))
        assert found.quadratic == "there" and found.bare is fit
        assert problem.said == [f"commands at {taken:g} of the way to the next row's: 7.0 nats"]
    else:
        assert found is before


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
    for problem, same in ((problem_of(slow=False), fit), (problem_of(), fit_of())):
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
