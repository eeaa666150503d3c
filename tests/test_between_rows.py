"""Commands between slow rows: a row's mean, how sure it is, and what is identified beside it."""

from dataclasses import replace
from typing import Any

import injector
import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.estimation import between_rows
from coax_env.estimation.between_rows import (
    EVENLY,
    HELD,
    ON_LINES,
    TRIED,
    Between,
    likeliest,
    next_larger,
    remarks,
    with_between,
)
from coax_env.estimation.helicopter import READ, HeliModel
from coax_env.estimation.state_space import Noise, Record
from coax_env.identification import identify as module
from coax_env.identification.identify import identify
from coax_env.logs.flight import read_flight

LAMA = load_vehicle("lama400d")


def ramp(rows: int = 5) -> Record:
    """Commands that rise by 1, 2, 3 and 4 a row."""
    command = np.outer(np.arange(rows), [1.0, 2.0, 3.0, 4.0])
    return Record("a", 0.04 * np.arange(rows), command, np.zeros((rows, 1)))


def test_a_rows_command_is_on_the_way_to_the_next_and_readings_see_it_as_written():
    """Of a ramp that of its middle; the last row's has no next. The log itself stays."""
    sound = ramp()
    (found,) = with_between([sound], Between(ON_LINES, 0.0))
    u = HeliModel(LAMA).inputs(found, LAMA.vector)
    np.testing.assert_allclose(u[:-1, :4], np.outer(np.arange(4) + 0.5, [1.0, 2.0, 3.0, 4.0]))
    np.testing.assert_array_equal(u[-1, :4], sound.command[-1])
    np.testing.assert_array_equal(u[:, READ][:, :4], sound.command)
    assert found.command is sound.command and found.z is sound.z


@pytest.mark.parametrize("step", [1, 2, 4])
def test_of_commands_between_rows_the_mean_is_a_share_of_the_next(step):
    """One of two that were logged, on a line, has a quarter of the next; of very many a half."""
    fine = np.linspace(0.0, 1.0, step + 1)[:step]
    record = ramp(2)
    (found,) = with_between([record], Between((step - 1) / (2 * step), 0.0))
    u = HeliModel(LAMA).inputs(found, LAMA.vector)
    np.testing.assert_allclose(u[0, :4], fine.mean() * record.command[1])


def test_a_step_within_a_row_comes_anywhere_in_it():
    """Its mean over the row is that of a share that is uniform from 0 to 1, of variance 1 / 12."""
    rng = np.random.default_rng(0)
    size, where = 0.3, rng.uniform(0.0, 1.0, 200_000)
    command = np.zeros((6, 4))
    command[3:] = size * np.array([1.0, -1.0, 2.0, 0.0])
    record = Record("a", 0.04 * np.arange(6), command, np.zeros((6, 1)), between=EVENLY)
    variance = HeliModel(LAMA).between(record, LAMA.vector)
    assert np.flatnonzero(variance.any(axis=1)).tolist() == [2]
    np.testing.assert_allclose(
        variance[2], np.var(size * where) * np.array([1.0, 1.0, 4.0, 0.0]), rtol=0.01
    )


@pytest.mark.parametrize(
    ("delay", "share"), [(0.0, (1.0, 0.0)), (0.04, (0.0, 1.0)), (0.01, (0.75, 0.25))]
)
def test_it_comes_as_late_as_the_command(delay, share):
    """By servos' delay the swash plate's alone; all of it is there."""
    record = Record(
        "a", 0.04 * np.arange(5), np.repeat([[0.0], [0.0], [1.0], [1.0], [1.0]], 4, axis=1),
        np.zeros((5, 1)), between=1.0,
    )  # fmt: skip
    late = LAMA.with_effect("servo_delay", time=delay) if delay else LAMA
    variance = HeliModel(late).between(record, late.vector)
    np.testing.assert_allclose(
        variance[:, :2], [[0.0] * 2, [1.0] * 2, *[[0.0] * 2] * 3], atol=1e-12
    )
    np.testing.assert_allclose(variance[1:3, 2], share, atol=1e-12)
    np.testing.assert_allclose(variance[:, 2].sum(), 1.0)


@pytest.mark.parametrize(
    ("share", "variance", "words"),
    [
        (0.0, 0.0, []),
        (0.25, 0.0, ["0.25 of the way"]),
        (0.0, EVENLY, ["when is not known"]),
        (0.375, EVENLY, ["0.375 of the way", "when is not known"]),
    ],
)
def test_what_was_done_between_the_rows_is_said(share, variance, words):
    found = remarks(Between(share, variance))
    assert len(found) == len(words)
    assert all(word in text for word, text in zip(words, found, strict=True))


@pytest.mark.parametrize(
    ("row", "nats", "found"),
    [
        (0.04, {Between(0.25, EVENLY): 7.0}, Between(0.25, EVENLY)),
        (0.02, {Between(0.25, EVENLY): 7.0, Between(0.5, 0.0): 8.0}, Between(0.5, 0.0)),
        (0.04, {Between(0.25, EVENLY): 5.0}, HELD),  # a tie is 6
        (0.01, {Between(0.25, EVENLY): 7.0}, HELD),
    ],
)
def test_the_likeliest_is_taken_between_slow_rows(monkeypatch, row, nats, found):
    monkeypatch.setattr(
        between_rows, "likelihoods", lambda *at: {of: nats.get(of, 0.0) for of in TRIED}
    )
    engine: Any = type("Engine", (), {"records": [replace(ramp(), t=row * np.arange(5))]})
    said: list[str] = []
    assert likeliest(engine, {}, Noise({}), said.append) == found
    assert len(said) == (found != HELD)


def test_shares_grow_to_straight_lines():
    """Whether the mean is known stays."""
    assert next_larger(Between(0.25, EVENLY)) == Between(0.375, EVENLY)
    assert next_larger(HELD) == Between(0.125, 0.0)
    assert next_larger(Between(ON_LINES, 0.0)) == Between(ON_LINES, 0.0)


@pytest.mark.slow
def test_a_lag_is_identified_from_one_command_of_four(tmp_path, monkeypatch):
    """60 ms of the upper rotor, at 25 Hz in gusts; with commands held it is far too small, as sure."""
    folder = injector.fly(
        tmp_path / "flight", {"motor_lag": 0.06}, gusts=True, seed=5, sensors="twenty_five",
        runs=["heave_3211", "yaw_3211"],
    )  # fmt: skip
    found = identify(read_flight(folder), also=["motor_lag"])
    lag = found.estimate.values["motor_lag.upper"]
    assert lag == pytest.approx(0.06, abs=0.004)
    assert any("of the way from each to the next" in text for text in found.remarks)
    monkeypatch.setattr(module.between_rows, "likeliest", lambda *asked: HELD)
    held = identify(read_flight(folder), also=["motor_lag"])
    assert held.estimate.values["motor_lag.upper"] < 0.055
