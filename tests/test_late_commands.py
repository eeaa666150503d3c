"""Commands that a log has later than they act: when that is seen, and what is done."""

from typing import Any

import injector
import numpy as np
import pytest
from csv_edits import written_later
from injector_craft import COAX
from numpy.testing import assert_allclose

from coax_env import diagnose
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation import late_commands
from coax_env.estimation.late_commands import acting_sooner, remark, written_late
from coax_env.estimation.state_space import Noise, Record
from coax_env.identification.identify import identify
from coax_env.logs.units import ROTOR_COMMANDS, SWASH_COMMANDS

ROW = 0.01
COMMANDS = (*ROTOR_COMMANDS, *SWASH_COMMANDS)


def stairs(seconds: float = 0.0) -> Record:
    """Commands held from each row to the next, written so much later than they act."""
    t = ROW * np.arange(40)
    acting = np.sin(3.0 * np.floor((t - seconds) / ROW + 1e-9))
    return Record("a", t, np.column_stack([acting, 2.0 * acting]), np.zeros((t.size, 1)))


@pytest.mark.parametrize("rows", [0, 1, 3])
def test_commands_so_many_rows_sooner_are_those_that_were_written_later(rows):
    """The last ones, which nobody has seen, are the last that was written."""
    late = stairs(rows * ROW)
    (found,) = acting_sooner([late], rows * ROW)
    stop = late.t.size - rows
    assert_allclose(found.command[:stop], stairs().command[:stop], atol=1e-9)
    assert_allclose(found.command[stop:], late.command[-1:].repeat(rows, 0), atol=1e-9)
    assert found.z is late.z and found.t is late.t


def test_between_rows_a_command_is_its_mean_over_the_row():
    (found,) = acting_sooner([stairs()], 0.4 * ROW)
    command = stairs().command
    assert_allclose(found.command[:-1], 0.6 * command[:-1] + 0.4 * command[1:], atol=1e-9)


def found_late(monkeypatch: pytest.MonkeyPatch, likelihood: Any, row: float = ROW) -> float:
    """`written_late` of readings that are so likely with commands so much sooner [s]."""

    class Likelihood:
        """A stand-in for an engine, which reads off its commands how much sooner they come."""

        def __init__(self, model: Any, records: Any, threads: Any = None) -> None:
            self.model, self.records, self.threads = model, records, threads

        def log_likelihood(self, values: Any, noise: Any) -> float:
            rows = np.arange(100.0)
            return likelihood(float(np.interp(self.records[0].command[0, 0], rows, row * rows)))

    monkeypatch.setattr(late_commands, "Engine", Likelihood)
    ramp = Record("a", row * np.arange(100), np.arange(100.0)[:, None], np.zeros((100, 1)))
    return written_late(Likelihood(None, [ramp]), {}, Noise({}), lambda text: None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("true", "nats", "row", "found"),
    [
        (0.03, 500.0, 0.01, 0.03),
        (0.06, 500.0, 0.01, 0.06),
        (0.11, 500.0, 0.01, 0.11),
        (0.035, 5e4, 0.01, 0.035),  # between rows
        (0.03, 40.0, 0.01, 0.0),  # worth too little
        (-0.03, 500.0, 0.01, 0.0),  # they act late, as delays and lags have it
        (0.04, 500.0, 0.04, 0.04),
        (0.9, 500.0, 0.6, 0.0),  # no log has rows that far apart
    ],
)
def test_commands_act_as_much_sooner_as_is_likeliest(monkeypatch, true, nats, row, found):
    """The likelihood is a parabola about the truth."""

    def likelihood(seconds: float) -> float:
        return nats * (1.0 - ((seconds - true) / true) ** 2)

    assert found_late(monkeypatch, likelihood, row) == pytest.approx(found, abs=0.1 * row)


def test_where_commands_a_row_sooner_are_less_likely_no_more_is_asked(monkeypatch):
    asked: list[float] = []

    def likelihood(seconds: float) -> float:
        asked.append(seconds)
        return -1e4 * seconds

    assert found_late(monkeypatch, likelihood) == 0.0
    assert asked == [0.0, pytest.approx(ROW)]


def test_it_must_be_worth_what_a_sure_cause_is():
    assert (SETTINGS.sure_evidence, SETTINGS.tie) == (late_commands.ENOUGH, late_commands.TIE)


@pytest.mark.slow
def test_a_clean_flight_whose_commands_are_written_late_has_no_cause(tmp_path):
    """By all sensors one had three, of 598 nats at most; here by poses alone. What was done is said."""
    runs = ("lon_3211", "yaw_3211", "heave_3211")
    injector.fly(
        tmp_path, {}, gusts=True, seed=11, runs=runs, craft=COAX, sensors="pose", longest=9.0
    )
    result = diagnose(written_later(tmp_path, COMMANDS, 6), hold_out=[])
    assert result.findings["causes"] == []
    said = [text for text in result.remarks if "later than they act" in text]
    assert len(said) == 1 and float(said[0].split()[3]) == pytest.approx(6.0 / 150.0, abs=0.008)
    assert remark(0.03).startswith("commands are written 0.03 s later")


@pytest.mark.slow
def test_numbers_are_identified_with_commands_when_they_act(tmp_path):
    """As written, 40 ms late, the linkage had nine tenths of its gain, 4 std off; in gusts."""
    runs = ("lon_3211", "lat_3211")
    injector.fly(tmp_path / "f", {}, gusts=True, seed=11, runs=runs, longest=12.0)
    sound = identify(tmp_path / "f")
    assert not any("later than they act" in text for text in sound.remarks)
    late = identify(written_later(tmp_path / "f", COMMANDS, 4))
    (said,) = [text for text in late.remarks if "later than they act" in text]
    assert said.startswith("commands are written 0.04 s later")
    for name, std in sound.estimate.std.items():
        assert abs(late.estimate.values[name] - sound.estimate.values[name]) < 0.3 * std, name
