"""Late readings moved back by whole rows: what the engine makes of them, and what is named then."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import injector
import numpy as np
import pytest
from bundled_flight import bundled
from injector_air import GUSTY
from numpy.testing import assert_allclose, assert_array_equal

from coax_env import diagnose, load_vehicle
from coax_env.diagnosis import late_readings as asking
from coax_env.diagnosis.late_readings import with_late
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.searches import once
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.changing_model import ChangingModel, clock_of
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, Moment, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.late_readings import left_out, moved_back
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Late, Noise, Record, part
from coax_env.model.effects import parameter_index
from coax_env.model.layout import CHANNELS

LAMA = load_vehicle("lama400d")
MODEL = HeliModel(LAMA)
DELAY = "attitude_delay.time"
ATTITUDE = np.isin(CHANNELS, ("phi", "theta", "psi"))
ROWS, ROW = 6, 0.01
LATE = Late(parameter_index(DELAY), ATTITUDE, ROWS, ROWS * ROW)
VALUES = {**MODEL.bare_values, DELAY: 0.0}
(TIME,) = MODEL.effect_parameters("attitude_delay")


@cache
def flown() -> tuple[Record, Record, Noise]:
    """Four seconds of the bundled flight as measured; the same with attitudes six rows late; noise."""
    record = record_of(bundled().runs[0])
    record = part(record, np.arange(400))
    z = record.z.copy()
    z[ROWS:, ATTITUDE] = record.z[:-ROWS, ATTITUDE]
    z[:ROWS, ATTITUDE] = np.nan
    cut = record.z.copy()
    cut[-ROWS:, ATTITUDE] = np.nan
    return replace(record, z=cut), replace(record, z=z), starting_noise(bundled(), LAMA)


@pytest.mark.slow
def test_readings_go_back_to_the_rows_that_they_are_of():
    """What was there before is there again; the variances of their clock errors go with them."""
    on_time, late, _ = flown()
    blur = np.arange(late.z.size, dtype=float).reshape(late.z.shape)
    moved = moved_back(with_late(replace(late, blur=blur), LATE))
    assert_allclose(moved.z, on_time.z, atol=1e-12)
    assert moved.late is not None and moved.late.done
    assert moved.blur is not None
    assert_array_equal(moved.blur[:-ROWS, ATTITUDE], blur[ROWS:, ATTITUDE])
    assert_array_equal(moved.blur[:, ~ATTITUDE], blur[:, ~ATTITUDE])


def test_readings_of_uneven_rows_go_to_the_nearest_by_their_rate():
    """Of a turn that quickens to 6 rad/s, each row a quarter early or late, and a gap."""
    rng = np.random.default_rng(1)
    t = ROW * (np.arange(600) + rng.uniform(-0.25, 0.25, 600))
    t[300:] += 0.355
    z = np.full((t.size, len(CHANNELS)), np.nan)
    psi = CHANNELS.index("psi")
    z[:, psi] = 0.5 * (t - ROWS * ROW) ** 2
    record = with_late(Record("turn", t, np.zeros((t.size, 4)), z), LATE)
    moved = moved_back(record)
    there = np.isfinite(moved.z[:, psi])
    assert_allclose(
        moved.z[there, psi], 0.5 * t[there] ** 2, atol=1e-3
    )  # a quarter of a row is 15e-3
    assert there.mean() > 0.8, "the nearest row is taken by another, at times"
    assert not there[[*range(t.size - ROWS + 1, t.size), *range(300 - ROWS + 1, 300)]].any()
    left = left_out(record)
    assert np.isfinite(left.z[:, psi]).sum() == there.sum()
    assert_array_equal(left.z[np.isfinite(left.z)], z[np.isfinite(left.z)])
    one = part(record, np.arange(100, 400))
    assert_allclose(moved_back(one).z[: 200 - ROWS, psi], moved.z[100 : 300 - ROWS, psi])


@pytest.mark.parametrize("changing", [False, True])
def test_a_delay_of_whole_rows_is_no_delay_of_readings_moved_back(changing):
    """Likelihood, innovations and states are those of a sensor that is on time, but for the readings
    that cannot be moved; without a delay those of the readings as logged.
    """
    on_time, late, noise = flown()
    model: HeliModel = MODEL
    if changing:
        moment = Moment(on_time.name, float(on_time.t[150]))
        model = ChangingModel(model, {"gyro_bias": moment}, clock_of([on_time]))
    moving = Engine(model, [with_late(late, LATE._replace(nats=7.0))])
    (moved,) = moving.filter({**VALUES, DELAY: ROWS * ROW}, noise)
    (sound,) = Engine(model, [on_time]).filter(VALUES, noise)
    assert moved.log_likelihood == pytest.approx(sound.log_likelihood + 7.0, rel=1e-12)
    assert_allclose(moved.states, sound.states, atol=1e-12)
    assert_allclose(moved.innovations, sound.innovations, atol=1e-9)
    (without,) = moving.filter(VALUES, noise)
    (logged,) = Engine(model, [replace(left_out(with_late(late, LATE)), late=None)]).filter(
        VALUES, noise
    )
    assert without.log_likelihood == pytest.approx(logged.log_likelihood + 7.0, rel=1e-12)


@pytest.mark.parametrize("rows", [0.0, ROWS - 0.4, ROWS + 0.3])
def test_the_slope_in_a_delay_is_that_of_the_cost(rows):
    """Where readings are moved, and where they are not."""
    _, late, noise = flown()
    engine = Engine(MODEL, [with_late(late, LATE)])
    values, step = {**VALUES, DELAY: rows * ROW}, 1e-5
    free = [replace(TIME, lower=-1.0)]
    passes, lin = engine.linearise(values, noise, free)
    sides = [
        engine.frozen_cost(passes, (), {**values, DELAY: values[DELAY] + h}, noise)
        for h in (-step, step)
    ]
    slope = (sides[1] - sides[0]) / (2.0 * step)
    assert Quadratic.of(lin, free, values).g[0] == pytest.approx(slope, rel=0.02)


def test_a_delay_is_found_from_none():
    """A fit that begins without a delay ends at it: readings are moved on the way."""
    _, late, noise = flown()
    engine = Engine(MODEL, [with_late(late, LATE)])
    found = engine.fit([TIME], VALUES, noise, iterations=10)
    assert found.values[DELAY] == pytest.approx(ROWS * ROW, abs=3.0 * found.std[DELAY] + 0.002)


# --- when it is asked for -------------------------------------------------------------------------


def problem_of(logged: float, moved: float, late: Late | None = None) -> Any:
    """A stand-in whose fit costs so much with readings as logged, and with readings moved."""
    record, _, _ = flown()

    def with_records(records: Any) -> Any:
        made = SimpleNamespace(
            model=SimpleNamespace(moments={}), row=ROW, settings=SETTINGS, late=records[0].late,
            own={"attitude_delay": (TIME,)}, report=lambda text: None, with_records=with_records,
            cost=logged if records[0].late is None else moved,
        )  # fmt: skip
        of_run = SimpleNamespace(log_likelihood=float(np.isfinite(records[0].z).sum()))
        made.as_logged = SimpleNamespace(
            engine=SimpleNamespace(
                records=[replace(r, late=None) for r in records], filter=lambda *at: [of_run]
            )
        )
        made.engine = SimpleNamespace(records=records, filter=lambda values, noise: [of_run])
        return made

    return with_records([with_late(record, late)])


@pytest.fixture(autouse=True)
def fits(monkeypatch):
    """Fits that end where the stand-in says."""
    fitted = lambda problem, fit: replace(fit, objective=getattr(problem, "cost", math.nan))  # noqa: E731
    monkeypatch.setattr(asking, "fitted", fitted)
    monkeypatch.setattr(asking, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(asking, "only", lambda problem, fit, kept: replace(fit, active=tuple(kept)))


@pytest.mark.parametrize(
    ("seconds", "moved", "late", "rows"),
    [
        (0.0561, 90.0, None, 6),
        (0.0561, 96.0, None, None),  # a tie is 6
        (0.004, 0.0, None, None),  # less than half a row
        (0.0561, math.nan, None, None),  # a filter diverges
        (0.0561, math.nan, LATE._replace(rows=5, seconds=0.05), None),
        (0.0561, 0.0, LATE, None),  # they are
        (0.0561, 99.0, LATE._replace(rows=5, seconds=0.05), 6),
    ],
)
def test_readings_are_moved_by_the_rows_nearest_to_their_delay(seconds, moved, late, rows):
    fit = Fit(("servo_lag", "attitude_delay"), {DELAY: seconds}, Noise({}), objective=100.0)
    found = asking.moved_back(problem_of(100.0, moved, late), fit)
    if rows is None:
        assert found is None
        return
    problem, begun = found
    assert (problem.late.rows, problem.late.seconds) == (rows, pytest.approx(rows * ROW))
    assert_array_equal(problem.late.channels, ATTITUDE)
    assert begun.active == ("attitude_delay",)
    unmoved = np.isfinite(flown()[0].z[:rows, ATTITUDE]).sum()
    assert problem.late.nats == unmoved > 0, "what cannot be moved counts as it did"


def test_without_a_delay_nothing_is_moved():
    fit = Fit(("servo_lag",), {DELAY: 0.0}, Noise({}), objective=100.0)
    assert asking.moved_back(problem_of(100.0, 0.0), fit) is None


@pytest.mark.parametrize(
    ("searches", "ends"),
    [
        ([("attitude_delay",)], 1),
        ([("attitude_delay", "wind"), ("attitude_delay",)], 2),
        ([("attitude_delay",), ("wind",)], 1),  # the delay is gone: as it was before
        ([("wind",)], 0),
    ],
)
def test_the_search_is_done_again_until_readings_are_where_they_belong(monkeypatch, searches, ends):
    found = [Fit(active, {}, Noise({})) for active in (("attitude_delay",), *searches)]
    moves = iter([*range(len(searches)), None])

    def moved(problem: Any, fit: Fit) -> Any:
        at = next(moves)
        return None if at is None else (SimpleNamespace(at=at + 1, report=problem.report), fit)

    monkeypatch.setattr(asking, "moved_back", moved)
    monkeypatch.setattr(once, "search", lambda problem, fit: (found[problem.at], problem.at))
    given: Any = SimpleNamespace(at=0, report=lambda text: None)
    problem, fit, quadratic = once._with_readings_moved_back(given, found[0], 0)  # type: ignore
    assert (problem.at, fit, quadratic) == (ends, found[ends], ends)


# --- what is named then ---------------------------------------------------------------------------


@pytest.mark.slow
def test_late_attitudes_beside_rotors_that_jitter(tmp_path, monkeypatch):
    """Second order in the delay left the heading coloured: 5,000 nats, doubtful."""
    monkeypatch.undo()
    injector.fly(
        tmp_path / "flight", {"attitude_delay": {"time": 0.06}},
        gusts=GUSTY._replace(trim_thrust=0.002, trim_torque=0.003, jitter=0.5), seed=3,
        runs=("yaw_3211", "lon_3211"), longest=9.0,
    )  # fmt: skip
    found = diagnose(tmp_path / "flight", hold_out=[]).findings
    assert [(c["effect"], c["trust"]) for c in found["causes"]] == [("attitude_delay", "sure")]
    time = found["causes"][0]["parameters"][DELAY]
    assert abs(time["value"] - 0.06) < 2.5 * time["std"]


@pytest.mark.slow
def test_late_echoes(tmp_path, monkeypatch):
    """By second order in the delay they were 0.277 +- 0.006 s late."""
    monkeypatch.undo()
    hidden = {"sonar_delay": {"time": 0.3}}
    runs = ("heave_3211", "climb_descend")
    injector.fly(tmp_path / "flight", hidden, gusts=True, seed=4, runs=runs, longest=12.0)
    (cause,) = diagnose(tmp_path / "flight", hold_out=[]).findings["causes"]
    assert cause["effect"] == "sonar_delay"
    time = cause["parameters"]["sonar_delay.time"]
    assert abs(time["value"] - 0.3) < 2.5 * time["std"] < 0.03
