"""What was found wrong with a log: done to the runs held out, and said; of a sound one nothing."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.diagnosis.log_faults import remarks, undone
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.searches.once import Searched
from coax_env.estimation.between_rows import EVENLY, Between, with_between
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.low_pass import LowPass
from coax_env.estimation.state_space import Noise, Record
from coax_env.model.layout import CHANNELS, ROTOR_SPEEDS

ROW = 0.01
MODEL = HeliModel(load_vehicle("lama400d"))


def logged(name: str) -> Record:
    rng = np.random.default_rng(len(name))
    t = ROW * np.arange(40)
    return Record(name, t, rng.random((40, 4)), rng.standard_normal((40, len(CHANNELS))))


GIVEN = Problem.of(MODEL, [logged("fitted")], ("wind", "thrust_exponent"))
UNREAD = np.isin(CHANNELS, ROTOR_SPEEDS)


def found(**but: Any) -> Searched:
    fit = Fit((), {}, Noise({}))
    records = but.pop("records", GIVEN.engine.records)
    between = but.pop("between", (0.0, 0.0))
    problem = replace(GIVEN.with_records(with_between(records, Between(*between))), **but)
    return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]


def test_of_a_sound_log_nothing_is_changed_or_said():
    (held,) = undone([logged("held out")], GIVEN, found())
    np.testing.assert_array_equal(held.z, logged("held out").z)
    np.testing.assert_array_equal(held.command, logged("held out").command)
    assert remarks(GIVEN, found()) == []


@pytest.mark.parametrize(
    ("fault", "words", "of_commands"),
    [
        ({"commands_late": 0.02}, "commands are written 0.02 s later", True),
        ({"late_imu": {"gyros": 2}}, "gyros 0.02 s", False),
        ({"low_passes": {"p": LowPass(0.01)}}, "come through a low-pass", False),
        ({"between": (0.5, 0.0)}, "0.5 of the way", True),
        ({"between": (0.0, EVENLY)}, "when is not known", True),
    ],
)
def test_each_fault_is_undone_and_said(fault, words, of_commands):
    before = logged("held out")
    (held,) = undone([before], GIVEN, found(**fault))
    as_written = np.array_equal(held.command, before.command)
    assert (as_written and (held.of_next, held.between) == (0.0, 0.0)) != of_commands
    assert (held.of_next, held.between) == fault.get("between", (0.0, 0.0))
    assert np.array_equal(held.z, before.z) == of_commands
    (said,) = remarks(GIVEN, found(**fault))
    assert words in said


def test_rotor_speeds_that_were_not_used_are_not_judged_by():
    unused = [
        replace(record, z=np.where(UNREAD, np.nan, record.z)) for record in GIVEN.engine.records
    ]
    (held,) = undone([logged("held out")], GIVEN, found(records=unused))
    assert np.isnan(held.z[:, UNREAD]).all() and np.isfinite(held.z[:, ~UNREAD]).all()
    (said,) = remarks(GIVEN, found(records=unused))
    assert "rotor speeds come later" in said
