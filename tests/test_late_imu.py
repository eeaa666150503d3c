"""Gyros and accelerometers that are read later than all else: when that is seen, and what is done."""

from types import SimpleNamespace
from typing import Any

import injector
import numpy as np
import pytest
from csv_edits import written_later
from numpy.testing import assert_array_equal

from coax_env import diagnose
from coax_env.diagnosis.late_imu import on_time, remark, rows_late, worth_left_out
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.state_space import Noise, Record
from coax_env.model.layout import ACCELEROMETERS, CHANNELS, GYROS

ROW = 0.01
FIT = Fit((), {}, Noise({}))


def logged(gyros: int = 0, accelerometers: int = 0) -> Record:
    """Every channel counts the rows since it was on time; some come so many rows late."""
    t = ROW * np.arange(60)
    z = np.tile(np.arange(60.0)[:, None], len(CHANNELS))
    for channels, rows in ((GYROS, gyros), (ACCELEROMETERS, accelerometers)):
        z[:, np.isin(CHANNELS, channels)] -= rows
    return Record("a", t, np.zeros((60, 4)), z)


def test_late_readings_go_back_to_when_they_were_and_others_stay():
    (found,) = on_time([logged(gyros=2, accelerometers=3)], {"gyros": 2, "accelerometers": 3}, ROW)
    there = np.isfinite(found.z)
    assert_array_equal(found.z[there], np.tile(np.arange(60.0)[:, None], len(CHANNELS))[there])
    lost = dict(zip(CHANNELS, (~there).sum(0), strict=True))
    assert {lost[c] for c in GYROS} == {2} and {lost[c] for c in ACCELEROMETERS} == {3}
    assert sum(lost.values()) == 15
    assert found.late is None


def problem_of(gyros: int, accelerometers: int, nats: float = 300.0, row: float = ROW) -> Any:
    """A stand-in in which a row's readings are the likelier the nearer they are to it."""

    def likelihood(records: Any) -> float:
        off = records[0].z - np.arange(60.0)[:, None]
        each = -0.5 * off**2 + 1.0  # also of what would be left out
        return float(nats / 180.0 * np.nansum(each))

    def with_records(records: Any) -> Any:
        engine = SimpleNamespace(
            records=records, log_likelihood=lambda values, noise: likelihood(records)
        )
        return SimpleNamespace(
            engine=engine, row=row, settings=SETTINGS, with_records=with_records,
            aboard=frozenset(CHANNELS),
        )  # fmt: skip

    return with_records([logged(gyros, accelerometers)])


@pytest.mark.parametrize(
    ("gyros", "accelerometers", "nats", "row", "found"),
    [
        (2, 0, 300.0, ROW, {"gyros": 2}),
        (0, 3, 300.0, ROW, {"accelerometers": 3}),
        (2, 1, 300.0, ROW, {"gyros": 2, "accelerometers": 1}),
        (0, 0, 300.0, ROW, {}),
        (-1, 0, 300.0, ROW, {}),
        (2, 0, 10.0, ROW, {}),  # worth too little
        (2, 0, 300.0, 0.2, {}),  # rows are too far apart to say
    ],
)
def test_each_group_is_late_by_the_likeliest_rows(gyros, accelerometers, nats, row, found):
    problem = problem_of(gyros, accelerometers, nats, row)
    rows, gained = rows_late(problem, FIT)
    assert rows == found and (gained > 0.0) == bool(found)


def test_what_cannot_be_moved_is_worth_what_it_was():
    problem = problem_of(0, 0, nats=180.0)
    assert worth_left_out(problem, FIT, {"gyros": 4}) == pytest.approx(3 * 4 * 1.0)
    assert worth_left_out(problem, FIT, {}) == 0.0


@pytest.mark.slow
def test_a_clean_flight_whose_imu_comes_late_has_no_cause(tmp_path):
    """It had a servo's delay at first; what poses show was not explained. What was done is said."""
    runs = ("lon_3211", "yaw_3211")
    injector.fly(tmp_path, {}, gusts=True, seed=5, runs=runs, sensors="lab")
    result = diagnose(written_later(tmp_path, (*GYROS, *ACCELEROMETERS), 2), hold_out=[])
    assert (result.findings["causes"], result.findings["unexplained"]) == ([], [])
    said = [text for text in result.remarks if "later than all else" in text]
    assert len(said) == 1 and "gyros 0.02 s" in said[0]
    assert "accelerometers 0.02 s" in said[0]
    assert remark({"gyros": 2}, 0.01).startswith("read later than all else: gyros 0.02 s.")
