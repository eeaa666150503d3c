"""Columns that the card says are written late: where they belong, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from csv_edits import Table, rewrite
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from coax_env.errors import InputError
from coax_env.logs.flight import Flight, Run, read_flight, write_flight
from coax_env.logs.held_signal import row_means

N = 400
COMMANDS = ("rpm_upper_cmd", "rpm_lower_cmd", "delta_lon", "delta_lat")


def a_run(t: np.ndarray, rng: np.random.Generator) -> Run:
    """Commands that change in every row, and two sensors without any repeat."""
    command = np.column_stack(
        [rng.normal(200.0, 5.0, (t.size, 2)), rng.normal(0, 0.05, (t.size, 2))]
    )
    measured = {"q": rng.normal(0.0, 0.1, t.size), "pn": np.cumsum(rng.normal(0.0, 0.01, t.size))}
    return Run("a", t, command, measured, battery=rng.normal(11.0, 0.1, t.size))


def written(folder: Path, run: Run, columns: str) -> Flight:
    """The run as a log, read with a card that has these lines."""
    write_flight(Flight("lama400d", (run,)), folder)
    card = folder / "card.toml"
    card.write_text(card.read_text() + f"\n[columns]\n{columns}\n")
    return read_flight(folder)


def later(values: np.ndarray, rows: int) -> np.ndarray:
    """A column that is written so many rows later."""
    return np.concatenate([values[:1].repeat(rows, 0), values[:-rows]])


def test_what_is_written_late_is_read_as_if_it_were_not(tmp_path):
    """Whole rows: everything but the last rows, which nobody saw, is as it was flown."""
    run = a_run(0.01 * np.arange(N), np.random.default_rng(1))
    late = Run(
        "a", run.t, later(run.command, 3), {"q": later(run.measured["q"], 2), "pn": run.measured["pn"]},
        battery=later(run.battery, 4),
    )  # fmt: skip
    lines = "\n".join(f"{name} = {{ late = 0.03 }}" for name in COMMANDS)
    flight = written(
        tmp_path, late, f"{lines}\nq = {{ late = 0.02 }}\nbattery_v = {{ late = 0.04 }}"
    )
    (found,) = flight.runs
    assert_allclose(found.command[: N - 3], run.command[: N - 3], rtol=1e-9)
    assert_allclose(found.command[N - 3 :], np.tile(late.command[-1], (3, 1)), rtol=1e-9)
    assert_allclose(found.battery[: N - 4], run.battery[: N - 4], rtol=1e-8)
    assert_allclose(found.measured["q"][: N - 2], run.measured["q"][: N - 2], atol=1e-8)
    assert np.isnan(found.measured["q"][N - 2 :]).all()
    assert_allclose(found.measured["pn"], run.measured["pn"], atol=1e-8)
    assert "runs in which q was written 0.02 s late, moved back: 1" in flight.notes
    assert flight.counts["late readings of q without a row of their own, left out"] == 2
    assert all(any(name in note for note in flight.notes) for name in (*COMMANDS, "battery_v"))


@pytest.mark.slow
@given(seed=st.integers(0, 10_000), late=st.floats(0.0, 0.2))
def test_a_held_command_keeps_its_area(seed: int, late: float):
    """Of uneven rows, too: what it adds up to by any row is what was held until so much later."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.002, 0.03, 60))
    values = rng.normal(size=t.size)
    fine = np.linspace(t[0] + late, t[-1] + late, 200_001)
    held = values[np.searchsorted(t, fine, side="right") - 1]
    steps = np.diff(t, append=2.0 * t[-1] - t[-2])
    added = float((row_means(t, values, late) * steps)[:-1].sum())
    assert added == pytest.approx(held.mean() * (t[-1] - t[0]), abs=2e-3)


@pytest.mark.parametrize("late", [0.004, 0.05, 0.213])
def test_a_reading_is_put_within_half_a_row_of_when_it_was_taken(tmp_path, late):
    """A reading that tells its time, on uneven rows; none is there twice, none in a row before."""
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.004, 0.016, N))
    run = a_run(t, rng)
    clock = Run("a", t, run.command, {"pn": t - late, "q": run.measured["q"]})
    (found,) = written(tmp_path, clock, f"pn = {{ late = {late} }}").runs
    there = np.isfinite(found.measured["pn"])
    taken = found.measured["pn"][there]
    assert (np.diff(taken) > 0.0).all()
    assert np.abs(taken - t[there]).max() <= 0.5 * np.diff(t).max() + 1e-9
    assert there.sum() > 0.7 * N  # two in a row, and rows before which none was taken, are fewer


def test_latitude_and_longitude_may_be_late(tmp_path):
    run = a_run(0.01 * np.arange(N), np.random.default_rng(5))
    north = np.sin(0.02 * np.arange(N)) + run.measured["pn"]
    write_flight(Flight("lama400d", (run,)), tmp_path)

    def as_places(table: Table) -> None:
        table["gone"] = table.pop("pn")
        table["gps_lat"] = [f"{x / 111_320.0:.12f}" for x in north]
        table["gps_lon"] = [f"{0.0001 * k:.9f}" for k in range(N)]

    rewrite(tmp_path.glob("*.csv"), as_places)
    card = tmp_path / "card.toml"

    def read(late: str) -> Any:
        plain = card.read_text().split("[columns]")[0]
        card.write_text(f'{plain}[columns]\nlat = {{ name = "gps_lat"{late} }}\nlon = "gps_lon"\n')
        return read_flight(tmp_path).runs[0].measured["pn"]

    assert_allclose(read(", late = 0.05")[: N - 5], read("")[5:], atol=1e-9)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("q = { late = -0.1 }", "[columns] q late should be seconds, 0 to 1, found -0.1"),
        ("q = { late = 3 }", "[columns] q late should be seconds, 0 to 1, found 3"),
        ('q = { late = "0.1" }', "[columns] q late should be a number"),
        ("q = { late = nan }", "[columns] q late should be finite"),
        ("t = { late = 0.1 }", "[columns] t: time itself is not late"),
        ("q = { lat = 0.1 }", "unknown key 'lat': 'late' is meant?"),
    ],
)
def test_a_wrong_delay_is_refused_by_name(tmp_path, line, words):
    run = a_run(0.01 * np.arange(N), np.random.default_rng(1))
    with pytest.raises(InputError) as error:
        written(tmp_path, run, line)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_a_column_that_is_late_keeps_that_in_the_line_that_checks_advise(tmp_path):
    """An advised sign or unit is the whole line of the card: nothing of it may be lost."""
    run = a_run(0.01 * np.arange(N), np.random.default_rng(1))
    flight = written(tmp_path, run, "q = { sign = -1, late = 0.02 }")
    assert flight.columns["q"].entry("q") == "q = { sign = -1, late = 0.02 }"
