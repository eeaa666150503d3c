"""When measured rotor speeds are taken to come late: the decisions, on fits that are stood in for."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import injector
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from coax_env.diagnosis import late_rotor_speeds
from coax_env.diagnosis.diagnose import diagnose
from coax_env.diagnosis.late_rotor_speeds import (
    LAG,
    ByOthers,
    behind_low_pass,
    by_speeds_alone,
    come_late,
    with_less_lag,
    without_rotor_speeds,
)
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.low_pass import NONE, LowPass
from coax_env.estimation.state_space import Noise, Record

CHANNELS = ("rpm_upper", "rpm_lower", "az")
OWN = tuple(SimpleNamespace(name=f"{LAG}.{rotor}") for rotor in ("upper", "lower"))


def lag_of(seconds: float, active: tuple[str, ...] = (LAG,), objective: float = 0.0) -> Fit:
    """A fit whose rotors lag so much."""
    values = dict.fromkeys([own.name for own in OWN], seconds)
    return Fit(active, values, Noise({}), objective)


def problem_of(nats: dict[float, float], aboard: Any = CHANNELS, slow: bool = False) -> Any:
    """A problem whose other readings have a likelihood by the lag alone."""
    engine = SimpleNamespace(
        records=[], threads=1, filter=lambda values, noise: [],
        log_likelihood=lambda values, noise: nats[values[OWN[0].name]],
    )  # fmt: skip
    return SimpleNamespace(
        engine=engine, model=SimpleNamespace(channels=CHANNELS), settings=SETTINGS,
        aboard=frozenset(aboard), own={LAG: OWN}, report=lambda text: None,
        sees_poses_alone="az" not in aboard, has_slow_rows=slow,
        with_records=lambda records: problem_of(nats, {"az"} & set(aboard), slow),
        off_values=lambda effect: {own.name: 0.0 for own in OWN}, file_values=lambda effect: {},
    )  # fmt: skip


def test_readings_of_rotor_speeds_alone_are_left_out():
    t = 0.01 * np.arange(4)
    record = Record("r", t, np.zeros((4, 4)), np.arange(12.0).reshape(4, 3))
    (left,) = without_rotor_speeds([record], CHANNELS)
    assert np.isnan(left.z[:, :2]).all()
    assert_array_equal(left.z[:, 2], record.z[:, 2])
    assert np.isfinite(record.z).all(), "the log's own stay"


@pytest.mark.parametrize(
    ("gained", "by_others", "active", "aboard", "slow", "asked"),
    [
        (3.1, 0.01, (LAG,), CHANNELS, False, True),
        (2.9, 0.01, (LAG,), CHANNELS, False, False),  # by chance
        (50.0, 0.04, (LAG,), CHANNELS, False, False),  # thrust later than speeds: no sensor does so
        (50.0, 0.01, ("wind",), CHANNELS, False, False),
        (50.0, 0.01, (LAG,), ("az",), False, False),  # no speed is read
        (50.0, 0.01, (LAG,), ("rpm_upper",), False, False),  # no accelerometer or gyro is
        (50.0, 0.01, (LAG,), CHANNELS, True, False),  # commands changed unseen between the rows
    ],
)
def test_speeds_may_be_late_where_all_else_has_less_of_a_lag(
    monkeypatch, gained, by_others, active, aboard, slow, asked
):
    trial = lag_of(by_others, active)
    monkeypatch.setattr(late_rotor_speeds, "fitted", lambda problem, fit: trial)
    problem = problem_of({0.02: 0.0, by_others: gained}, aboard, slow)
    found = with_less_lag(problem, lag_of(0.02, active))
    assert (found and found.fit) == (trial if asked else None)
    assert found is None or found.gained == gained


@pytest.mark.parametrize(
    ("shown", "active", "aboard", "slow", "alone"),
    [
        (13.9, (LAG,), CHANNELS, False, True),
        (14.1, (LAG,), CHANNELS, False, False),
        (-50.0, (LAG,), CHANNELS, False, True),
        (math.nan, (LAG,), CHANNELS, False, False),  # the filter diverges without it
        (0.0, ("wind",), CHANNELS, False, False),
        (0.0, (LAG,), ("az",), False, False),  # no speed is read: something else shows it
        (0.0, (LAG,), ("rpm_upper",), False, False),  # poses alone are not asked
        (0.0, (LAG,), CHANNELS, True, False),
    ],
)
def test_a_lag_may_be_shown_by_rotor_speeds_alone(shown, active, aboard, slow, alone):
    problem = problem_of({0.02: shown, 0.0: 0.0}, aboard, slow)
    assert by_speeds_alone(problem, lag_of(0.02, active)) == alone


@pytest.mark.slow
@pytest.mark.parametrize(("run", "named"), [("hover", False), ("yaw_3211", True)])
def test_a_lag_is_named_where_torque_shows_it(tmp_path, run, named):
    """60 ms, one run of 14 s in gusts: in hover nobody can tell the motors from what reads speeds."""
    lag = {"motor_lag": {"upper": 0.06, "lower": 0.06}}
    injector.fly(tmp_path, lag, gusts=True, seed=11, runs=[run], longest=14.0)
    (tmp_path / "truth.json").unlink()
    found = diagnose(tmp_path).findings
    assert [cause["effect"] for cause in found["causes"]] == [LAG] * named
    assert [term.get("like") for term in found["unexplained"]] == [LAG] * (not named)


@pytest.mark.parametrize(
    ("gained", "left", "coloured", "inflation", "late"),
    [
        (1.1, 0.9, False, 1.0, True),  # nothing is left of the lag
        (1.1, 1.1, False, 1.0, False),  # a lag of the motors, and thrust ahead of its inflow
        (1.1, 1.1, True, 1.0, True),  # no lag of the motors leaves speeds coloured
        (0.9, 0.1, True, 1.0, False),
        (1.1, 0.1, True, 2.0, False),  # other readings are coloured too: they say less
    ],
)
def test_speeds_come_late_where_nothing_is_left_of_a_lag_or_they_stay_coloured(
    monkeypatch, gained, left, coloured, inflation, late
):
    """`gained`, `left`: thresholds by which other readings are likelier so, and less likely without."""
    trial = lag_of(0.01, objective=100.0)
    off = replace(lag_of(0.0, ()), objective=100.0 + left * SETTINGS.evidence)
    monkeypatch.setattr(late_rotor_speeds, "fitted", lambda problem, fit: off)
    shown = {"az": SimpleNamespace(inflation=inflation)}
    monkeypatch.setattr(late_rotor_speeds, "whiteness", lambda passes, channels: shown)
    assert come_late(ByOthers(problem_of({}), trial, gained * SETTINGS.evidence), coloured) == late


@pytest.mark.parametrize(
    ("low_pass", "white", "nats", "taken"),
    [
        (LowPass(0.02), True, 15.0, True),
        (LowPass(0.02), True, 13.0, False),
        (LowPass(0.02), False, 900.0, False),
        (NONE, True, 900.0, False),  # other noise levels are likelier, and no low-pass is
    ],
)
def test_a_low_pass_stands_for_a_lag_where_speeds_are_white_behind_it_and_it_is_likelier(
    monkeypatch, low_pass, white, nats, taken
):
    problem = problem_of({0.02: 0.0, 0.0: nats})
    problem.behind = lambda passes, records: problem
    monkeypatch.setattr(late_rotor_speeds, "fitted", lambda problem, fit: fit)
    monkeypatch.setattr(
        late_rotor_speeds, "likeliest", lambda problem, fit, noise, *rest: (low_pass, noise)
    )
    shown = dict.fromkeys(CHANNELS, SimpleNamespace(white=white))
    monkeypatch.setattr(late_rotor_speeds, "whiteness", lambda passes, channels: shown)
    others: Any = SimpleNamespace(fit=lag_of(0.0), show_lag=False)
    found = behind_low_pass(problem, lag_of(0.02), others, Noise({}))
    assert found is (problem if taken else None)


@pytest.mark.parametrize(
    ("by_others", "shown", "beside"),
    [(0.05, False, []), (0.05, True, [(0.05, 0.03)]), (0.075, True, [(0.075, 0.01)])],
)
def test_a_low_pass_is_looked_for_beside_the_lag_that_all_other_readings_show(
    monkeypatch, by_others, shown, beside
):
    """In the place of the lag, and beside theirs from the time that is left, a row at least."""
    begun = []

    def behind(problem: Any, trial: Fit, low_pass: LowPass) -> None:
        begun.append((trial.values[OWN[0].name], round(low_pass.time, 9), low_pass.order))

    monkeypatch.setattr(late_rotor_speeds, "_behind", behind)
    problem = problem_of({0.08: 0.0})
    problem.row = 0.01
    others: Any = SimpleNamespace(fit=lag_of(by_others), show_lag=shown)
    assert behind_low_pass(problem, lag_of(0.08), others, Noise({})) is None
    assert begun == [(*at, order) for at in [(0.0, 0.08), *beside] for order in (1, 2)]
