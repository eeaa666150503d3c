"""Logs of many rows a second: what their means keep, in closed form, and what is found in them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from causes import check_causes, truth_of
from injector import fly
from injector_sensors import FAST, SENSORS

import coax_env
from coax_env.logs.fast_rows import ENOUGH_RATE, decimated
from coax_env.logs.flight import Flight, Run, read_flight
from coax_env.model.layout import RPM_PER_RAD_S

RNG = np.random.default_rng(3)


def log(rate: float, seconds: float = 4.0, **channels: np.ndarray) -> Flight:
    """A flight of one run with these channels and commands that change in every row."""
    t = np.arange(round(rate * seconds)) / rate
    command = RNG.normal(size=(t.size, 4))
    return Flight(
        "lama400d", (Run("hover", t, command, channels),), noise=dict.fromkeys(channels, 0.1)
    )


def times(rate: float, seconds: float = 4.0) -> np.ndarray:
    return np.arange(round(rate * seconds)) / rate


@pytest.mark.parametrize("rate", [25.0, 100.0, 150.0, 199.0])
def test_a_log_of_usual_rate_is_left_alone(rate):
    flight = log(rate, p=RNG.normal(size=times(rate).size))
    assert decimated(flight) is flight


@pytest.mark.parametrize("rate", [200.0, 333.0, 400.0, 500.0, 1000.0])
def test_what_changes_evenly_stays_as_it_is(rate):
    t = times(rate)
    flight = log(rate, p=3.0 - 2.0 * t, psi=(3.0 + 5.0 * t + np.pi) % (2 * np.pi) - np.pi)
    run = decimated(flight).runs[0]
    assert ENOUGH_RATE <= 1.001 / np.median(np.diff(run.t)) < 2.0 * ENOUGH_RATE
    assert np.isin(run.t, t).all()
    np.testing.assert_allclose(run.measured["p"], 3.0 - 2.0 * run.t, atol=1e-11)
    turned = run.measured["psi"] - (3.0 + 5.0 * run.t)
    np.testing.assert_allclose(np.exp(1j * turned), 1.0, atol=1e-11)
    assert np.abs(run.measured["psi"]).max() <= np.pi
    assert run.beginning == 0.0


@pytest.mark.parametrize("missing", [0.0, 0.05])
@pytest.mark.parametrize("rate", [240.0, 500.0])
def test_what_changes_evenly_stays_so_on_an_uneven_clock(rate, missing):
    """A mean stands at its row's time, not at that of the rows that it is of: 2 mm off at 3 m/s."""
    rng = np.random.default_rng(6)
    t = times(rate) + np.clip(rng.normal(0.0, 0.2, times(rate).size), -0.4, 0.4) / rate
    place, heading = 3.0 * t, (3.0 + 5.0 * t + np.pi) % (2 * np.pi) - np.pi
    place[rng.random(t.size) < missing] = np.nan
    command = RNG.normal(size=(t.size, 4))
    flight = Flight("lama400d", (Run("dash", t, command, {"pn": place, "psi": heading}),))
    run = decimated(flight).runs[0]
    assert run.t.size < 0.6 * t.size
    read = np.isfinite(run.measured["pn"])
    np.testing.assert_allclose(run.measured["pn"][read], 3.0 * run.t[read], atol=1e-9)
    turned = run.measured["psi"] - (3.0 + 5.0 * run.t)
    np.testing.assert_allclose(np.exp(1j * turned), 1.0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("slow", [0, 7])
@pytest.mark.parametrize(("rate", "rows"), [(500.0, 5), (400.0, 4), (240.0, 2), (200.0, 2)])
def test_white_noise_stays_white_and_is_that_of_the_means(rate, rows, slow):
    """To move a mean of two to its row is 3 % of it; where a slower sensor has its rows kept, more."""
    size = round(rate * 400.0)
    seldom = np.where(np.arange(size) % 7 == 0, 1.0, np.nan)
    flight = log(rate, 400.0, q=RNG.normal(size=size), **({"h": seldom} if slow else {}))
    kept = decimated(flight)
    q = kept.runs[0].measured["q"]
    if not slow:
        assert np.var(q) == pytest.approx(1.0 / rows, rel=0.035 + 5 * np.sqrt(2 / q.size))
    alike = [np.corrcoef(q[apart:], q[:-apart])[0, 1] for apart in (1, 2, 3)]
    assert np.abs(alike).max() < (0.05 if slow else 0.02) + 4 / np.sqrt(q.size)
    assert kept.noise["q"] == pytest.approx(0.1 / np.sqrt(rows))


def test_readings_of_slower_sensors_stay_where_and_what_they_were():
    t = times(500.0)
    slow = np.full(t.size, np.nan)
    slow[3::8] = RNG.normal(size=slow[3::8].size)
    flight = log(500.0, p=np.sin(3.0 * t), h=slow)
    kept = decimated(flight)
    run = kept.runs[0]
    inside = (t >= run.t[0]) & (t <= run.t[-1]) & np.isfinite(slow)
    assert np.count_nonzero(inside) >= np.count_nonzero(np.isfinite(slow)) - 2
    there = np.isfinite(run.measured["h"])
    np.testing.assert_array_equal(run.t[there], t[inside])
    np.testing.assert_array_equal(run.measured["h"][there], slow[inside])
    assert np.diff(run.t).max() <= 5.001 / 500.0
    assert np.diff(run.t).min() >= 3.999 / 500.0  # evenly between them
    assert kept.noise == {"p": pytest.approx(0.1 / np.sqrt(5.0)), "h": 0.1}


def test_a_missing_reading_is_no_zero():
    t = times(500.0)
    p = 2.0 + 0.0 * t
    p[RNG.random(t.size) < 0.05] = np.nan
    p[1000:1012] = np.nan
    found = decimated(log(500.0, p=p)).runs[0].measured["p"]
    assert np.isnan(found).sum() in (1, 2)
    np.testing.assert_allclose(found[np.isfinite(found)], 2.0, atol=1e-9)


def test_commands_bring_the_same_in_all():
    """The integral of a held command from a kept row to any other is that of the log."""
    flight = log(500.0, p=np.zeros(2000))
    whole, run = flight.runs[0], decimated(flight).runs[0]
    rows = np.searchsorted(whole.t, run.t)
    before = np.vstack([np.zeros(4), np.cumsum(whole.command[:-1] * 0.002, axis=0)])[rows]
    after = np.vstack([np.zeros(4), np.cumsum(run.command[:-1] * np.diff(run.t)[:, None], axis=0)])
    np.testing.assert_allclose(after, before - before[0], atol=1e-12)
    np.testing.assert_array_equal(run.command[-1], whole.command[rows[-1]])


@pytest.mark.parametrize("slow", [0, 7])
@pytest.mark.parametrize("rate", [200.0, 400.0, 500.0])
def test_a_speed_that_follows_at_once_stays_that_of_its_command(rate, slow):
    """Commands that change in every row: a mean of other rows was coloured, and thrust seemed to follow
    the speed less. What lags does not jump, and stands at its row's time as all else."""
    t = times(rate)
    seldom = {"h": np.where(np.arange(t.size) % slow == 0, 1.0, np.nan)} if slow else {}
    flight = log(rate, rpm_lower=2000.0 + 100.0 * t, **seldom)
    at_once = RPM_PER_RAD_S * flight.runs[0].command[:, 0]
    (run,) = flight.runs
    run = replace(run, measured={**run.measured, "rpm_upper": at_once})
    found = decimated(replace(flight, runs=(run,))).runs[0]
    np.testing.assert_allclose(found.measured["rpm_upper"], RPM_PER_RAD_S * found.command[:, 0])
    np.testing.assert_allclose(found.measured["rpm_lower"], 2000.0 + 100.0 * found.t, rtol=1e-12)


def test_what_was_done_is_said():
    t = times(500.0)
    slow = np.where(np.arange(t.size) % 10 == 0, 1.0, np.nan)
    flight = decimated(log(500.0, p=np.sin(t), q=np.cos(t), h=slow))
    (note,) = flight.notes
    rows = flight.runs[0].t.size
    assert note.startswith(
        f"2000 rows taken as {rows}, about 100 a second: means over 5 of p and q"
    )
    assert flight.counts == {"rows averaged": 2000 - rows}


RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")


@pytest.mark.slow
def test_a_log_of_500_hz_gives_up_what_is_hidden_in_it(tmp_path: Path):
    hidden = {"motor_lag": {"upper": 0.08, "lower": 0.08}, "gyro_bias": {"x": 0.02}}
    folder = fly(tmp_path, hidden, gusts=True, sensors="fast", seed=5, runs=RUNS, longest=10.0)
    result = coax_env.diagnose(read_flight(folder))
    assert any("rows taken as" in remark for remark in result.remarks)
    check_causes(result.findings, *truth_of(folder))
    assert result.noise["p"] == pytest.approx(SENSORS["fast"].noise["p"] / np.sqrt(5.0), rel=0.05)
    assert set(FAST) <= set(result.flight.channels)
