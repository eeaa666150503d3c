"""Faults of real logs: each is planted into a sound flight, and what is left must be that flight's."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from bundled_flight import BUNDLED, copied
from csv_edits import Table, rewrite
from scipy.interpolate import Akima1DInterpolator, CubicSpline, PchipInterpolator
from scipy.signal import butter, filtfilt
from shared_flights import read

import coax_env
from coax_env.diagnosis.diagnose import diagnose
from coax_env.diagnosis.hold_out import split
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.engine import Engine
from coax_env.estimation.flown import flown_parts, jumps_in_gaps
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.prediction import replay_runs
from coax_env.logs.flight import Flight, Run, read_flight
from coax_env.logs.held import interpolated, repeats
from coax_env.logs.outliers import find_leaps
from coax_env.model.vehicle_file import load_vehicle

RUN = "hover"
RUNS = (RUN, "lon_doublet")
FIRST, RATE = 400, 100
"""First row at fault, and rows per second of the bundled flight."""


def edited(folder: Path, change: Callable[[Table], None], run: str = RUN) -> Flight:
    """RUNS of the bundled flight, or the one in the folder, with a run's CSV changed cell by cell."""
    if not folder.exists():
        copied(folder, *RUNS)
    rewrite([folder / f"{run}.csv"], change)
    return read_flight(folder)


@cache
def sound() -> Flight:
    """RUNS as they are."""
    with TemporaryDirectory() as folder:
        return read_flight(copied(Path(folder) / "f", *RUNS))


def parts(flight: Flight) -> Flight:
    return flown_parts(flight, load_vehicle(flight.vehicle).in_air(flight.air))


def same_but(found: Run, expected: Run, missing: slice) -> None:
    """Equal readings but for rows that are missing, and equal commands but there."""
    rows = np.ones(expected.t.size, bool)
    rows[missing] = False
    np.testing.assert_array_equal(found.t, expected.t)
    np.testing.assert_allclose(found.command[rows], expected.command[rows], rtol=1e-12)
    for channel, values in expected.measured.items():
        np.testing.assert_array_equal(found.measured[channel][rows], values[rows], channel)
        assert np.isnan(found.measured[channel][missing]).all(), channel


# --- a broken packet ------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("rows", [1, 4, 8])
def test_a_broken_packet_is_missing(tmp_path, rows):
    at = slice(FIRST, FIRST + rows)

    def broken(table: Table) -> None:
        table["rpm_upper_cmd"][at] = ["23512"] * rows
        table["delta_lon"][at] = ["-4.6"] * rows
        table["p"][at] = ["0.01"] * rows  # sound as a number, but it came in this packet

    found, expected = edited(tmp_path / "f", broken).run(RUN), sound().run(RUN)
    same_but(found, expected, at)
    np.testing.assert_array_equal(found.command[at], np.tile(found.command[FIRST - 1], (rows, 1)))


def test_a_broken_packet_is_counted(tmp_path):
    def broken(table: Table) -> None:
        table["delta_lat"][FIRST] = "5.0"

    flight = edited(tmp_path / "f", broken)
    assert flight.counts["rows of broken packets, nothing in them believed"] == 1


@pytest.mark.parametrize(
    ("column", "rows", "value"),
    [("delta_lon", 100, "-4.6"), ("rpm_upper_cmd", 4, "4000"), ("delta_lat", 4, "0.2")],
)
def test_what_stays_or_can_be_flown_is_believed(tmp_path, column, rows, value):
    """A second of it is no packet, and a sharp stick movement is one that the machine has seen."""

    def step(table: Table) -> None:
        table[column][FIRST : FIRST + rows] = [value] * rows

    flight = edited(tmp_path / "f", step)
    assert flight.counts == sound().counts
    commands = flight.run(RUN).command[FIRST : FIRST + rows]
    assert not np.allclose(commands, sound().run(RUN).command[FIRST : FIRST + rows])


@pytest.mark.parametrize("rate", [100, 150, 400])
@pytest.mark.parametrize(("channel", "nonsense"), [("theta", -4.6), ("q", 60.0), ("pn", 900.0)])
def test_40_ms_of_nonsense_are_found_at_any_rate(rate, channel, nonsense):
    rng = np.random.default_rng(rate)
    t = np.arange(0.0, 10.0, 1.0 / rate)
    y = 0.3 * np.sin(2.0 * t) + rng.normal(0.0, 0.01, t.size)
    burst = (t > 4.0) & (t < 4.04)
    spoilt = np.where(burst, nonsense, y)
    if channel != "theta":  # whose whole turns are taken out
        np.testing.assert_array_equal(find_leaps(channel, t, spoilt), burst)
    assert find_leaps(channel, t, spoilt)[burst].all()
    assert not find_leaps(channel, t, spoilt)[~burst].any()
    assert not find_leaps(channel, t, y).any()
    assert not find_leaps(channel, t, np.where(t > 4.0, nonsense, y)).any()


@pytest.mark.needs_shared_flights
@pytest.mark.parametrize(
    "name",
    [
        "open_none",
        *(
            pytest.param(f"open_{w}", marks=pytest.mark.slow)
            for w in ("near_ground", "rigging", "outside")
        ),
    ],
)
def test_no_sound_flight_is_repaired(name):
    flight = read(name)
    assert flight.counts == {}
    assert parts(flight) is flight


# --- carried, landed, frozen ----------------------------------------------------------------------


def test_a_carried_segment_with_frozen_commands_is_left_out(tmp_path):
    commands = ("rpm_upper_cmd", "rpm_lower_cmd", "delta_lon", "delta_lat")
    rows = slice(FIRST, FIRST + 5 * RATE)

    def carried(table: Table) -> None:
        for column in commands:
            table[column][rows] = [table[column][FIRST]] * (5 * RATE)
        for k in range(5 * RATE):
            if table["h"][FIRST + k]:
                table["h"][FIRST + k] = f"{1.0 + 0.5 * np.sin(2.0 * k / RATE):.4f}"

    flight = parts(edited(tmp_path / "f", carried))
    first, second = (run for run in flight.runs if run.whole == RUN)
    expected = sound().run(RUN)
    assert (first.name, second.name) == (RUN, f"{RUN} (2)")
    np.testing.assert_array_equal(first.t, expected.t[: FIRST + 1])
    np.testing.assert_array_equal(second.t, expected.t[rows.stop :])
    np.testing.assert_array_equal(second.measured["q"], expected.measured["q"][rows.stop :])
    assert flight.counts["stretches left out: commands frozen"] == 1
    assert any("4.0 to 9.0 s left out: commands frozen" in note for note in flight.notes)


@pytest.mark.parametrize("speed", [0.0, 900.0])
def test_standing_on_the_ground_is_left_out(tmp_path, speed):
    """Motors off, or at idle, with a second in which they run up: half a second is not flown yet."""
    rows = slice(0, FIRST)

    def landed(table: Table) -> None:
        rng = np.random.default_rng(0)
        for column in ("rpm_upper_cmd", "rpm_lower_cmd", "rpm_upper", "rpm_lower"):
            top = float(table[column][FIRST])
            rise = np.clip((np.arange(FIRST) - FIRST + RATE) / RATE, 0.0, 1.0)
            idle = speed + (top - speed) * rise + rng.uniform(0.0, 5.0, FIRST)
            table[column][rows] = [f"{x:.1f}" for x in idle]

    flight = parts(edited(tmp_path / "f", landed))
    (only,) = (run for run in flight.runs if run.whole == RUN)
    assert only.name == RUN
    assert 3.8 < only.t[0] < 4.3 and only.t[-1] == sound().run(RUN).t[-1]
    assert only.beginning == 0.0
    assert record_of(only).origin == 0.0
    assert flight.counts["stretches left out: rotors too slow to fly"] == 1


def test_another_machines_speeds_are_no_landing():
    """A vehicle that its rotors never carry is the wrong one: nothing is cut away to hide that."""
    heavy = load_vehicle("lama400d").with_values({"mass": 5.0})
    assert flown_parts(sound(), heavy) is sound()


def test_commands_that_seldom_change_are_not_frozen():
    """A doublet flown open loop: its commands stand still for seconds because that is the maneuver."""
    t = np.arange(0.0, 12.0, 0.01)
    run = sound().run(RUN)
    command = np.tile(run.command[0], (t.size, 1))
    for start, size in ((3.0, 0.1), (3.5, -0.1), (9.0, 0.05)):
        command[(t >= start) & (t < start + 0.5), 2] += size
    steps = replace(run, t=t, command=command, measured={"q": np.zeros(t.size)})
    flight = replace(sound(), runs=(steps,))
    assert flown_parts(flight, load_vehicle(flight.vehicle)) is flight


# --- commands that jump where rows are missing ------------------------------------------------------


def test_a_run_is_cut_where_a_command_jumped_in_a_gap():
    """A step within three missing rows of a 25 Hz log; other steps and other gaps cut nothing."""
    rng = np.random.default_rng(0)
    t = 0.04 * np.arange(300)
    command = 0.003 * rng.standard_normal((300, 4))
    command[100:150, 2] += 0.1
    command[200:250, 3] -= 0.1
    kept = np.ones(300, bool)
    kept[40:43] = kept[98:101] = False  # nothing happens; the first step
    kept[199:200] = False  # one row: 0.08 s
    (found,) = jumps_in_gaps([t[kept]], [command[kept]])
    assert t[kept][found].tolist() == pytest.approx([t[101]])
    (found,) = jumps_in_gaps([t], [command])
    assert not found.any()
    assert not any(jumped.any() for jumped in jumps_in_gaps([t[:0], t], [command[:0], command]))


# --- held samples ---------------------------------------------------------------------------------


def test_forward_filled_columns_become_what_they_were(tmp_path):
    """The compass at 50 Hz and the sonar at 20 Hz, their blanks filled with the reading before."""

    def filled(table: Table) -> None:
        for column in ("psi", "h", "vn"):
            for k in range(1, len(table[column])):
                table[column][k] = table[column][k] or table[column][k - 1]

    found, expected = edited(tmp_path / "f", filled).run(RUN), sound().run(RUN)
    for channel in ("psi", "h", "vn"):
        new = np.isfinite(found.measured[channel])
        known = np.isfinite(expected.measured[channel])
        assert np.count_nonzero(new & ~known) <= 0.02 * known.sum(), channel
        assert np.count_nonzero(known & ~new) <= 0.05 * known.sum(), channel


def test_a_coarse_or_quiet_sensor_is_not_held():
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 20.0, 0.01)
    ramp = np.round(0.25 * t, 2)  # a centimetre every four rows
    rest = np.where(t < 10.0, 0.5, np.round(0.5 + 0.3 * np.sin(t), 2))
    dithered = np.round(0.3 * np.sin(t) + rng.normal(0.0, 0.006, t.size), 2)
    for values in (ramp, rest, dithered, np.full(t.size, 0.3), rng.normal(0.0, 1.0, t.size)):
        assert not repeats(values).any()
    assert repeats(ramp, hold=True).sum() == t.size - np.unique(ramp).size


@pytest.mark.parametrize("rate", [20.0, 40.0, 60.0, 80.0])
def test_any_slower_sensor_written_on_every_row_is_held(rate):
    """Up to four of five rows have a new reading, so that most values show only once."""
    rng = np.random.default_rng(8)
    t = np.arange(0.0, 20.0, 0.01)
    number = np.floor(t * rate + 1e-9).astype(int)
    readings = np.round(np.sin(0.7 * np.arange(2000) / rate) + rng.normal(0.0, 0.01, 2000), 4)
    found = repeats(readings[number])
    again = np.concatenate([[False], np.diff(number) == 0])
    assert np.mean(found == again) > 0.99


@pytest.mark.parametrize("every", [2, 5, 10])
@pytest.mark.parametrize("step", [0.02, 0.1])
def test_a_slow_coarse_sensor_has_readings_when_it_may_change(every, step):
    """Most of its next readings are the last one again; a burst of rows is missing."""
    rng = np.random.default_rng(8)
    t = np.arange(0.0, 20.0, 0.01)
    readings = step * np.round(
        (0.2 * np.sin(t[::every]) + rng.normal(0.0, 0.03, t[::every].size)) / step
    )
    y = np.repeat(readings, every)[: t.size]
    kept = np.ones(t.size, bool)
    kept[[500, 501, 502, 1203]] = False
    new = np.arange(t.size) % every == 0
    found = repeats(y[kept], None, t[kept])
    assert np.mean(found == ~new[kept]) > 0.995
    coarse = step * np.round((0.2 * np.sin(t) + rng.normal(0.0, 0.03, t.size)) / step)
    assert not repeats(coarse, None, t).any()


def test_a_line_between_readings_on_a_clock_that_was_logged_wrong_is_none():
    rng = np.random.default_rng(9)
    t = np.arange(0.0, 20.0, 0.01)
    readings = np.sin(0.7 * t[::5]) + rng.normal(0.0, 0.02, t[::5].size)
    y = np.round(np.interp(t, t[::5], readings), 4)
    new = np.zeros(t.size, bool)
    new[::5] = True
    logged = t + rng.uniform(-0.003, 0.003, t.size)
    assert np.mean(interpolated(logged, y)[:-5] == ~new[:-5]) > 0.97


def with_outliers(y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One row of 250 off by up to 0.4."""
    return np.where(rng.random(y.size) < 0.004, y + rng.uniform(-0.4, 0.4, y.size), y)


@pytest.mark.parametrize("every", [2, 3, 5])
@pytest.mark.parametrize("digits", [None, 5])
def test_a_line_between_readings_is_none_where_it_is_as_coarse_as_half_their_noise(every, digits):
    """With outliers of its own, rows that are missing, and the steps written with more decimals."""
    rng = np.random.default_rng(12)
    t = np.arange(0.0, 15.0, 0.01)
    readings = 0.3 * np.sin(2.0 * t[::every]) + rng.normal(0.0, 0.03, t[::every].size)
    y = 0.0149 * np.round(with_outliers(np.interp(t, t[::every], readings), rng) / 0.0149)
    y = y if digits is None else np.round(y, digits)
    kept = np.ones(t.size, bool)
    kept[rng.integers(0, t.size, 10)] = False
    new = (np.arange(t.size) % every == 0)[kept]
    assert np.mean(interpolated(t[kept], y[kept]) == ~new) > 0.99
    alone = 0.3 * np.sin(2.0 * t) + rng.normal(0.0, 0.03, t.size)
    assert not interpolated(t, 0.0149 * np.round(with_outliers(alone, rng) / 0.0149)).any()


@pytest.mark.parametrize("digits", [None, 5])
@pytest.mark.parametrize("step", [0.012, 0.0175])
def test_a_coarse_sensor_on_every_second_row_has_all_its_readings(step, digits):
    """An onboard filter's angle, smooth between its steps. Where a row is missing the other rows have
    readings from then on: those before were taken for lines between these."""
    t = 0.01 * np.arange(1400)
    y = step * np.round(0.2 * np.sin(1.5 * t) / step)
    y = y if digits is None else np.round(y, digits)
    rows = np.arange(t.size)
    read = np.where(rows < 1300, rows % 2 == 0, rows % 2 == 1)
    assert not interpolated(t, np.where(read, y, np.nan)).any()


@pytest.mark.parametrize("steps", [0.8, 0.9, 1.1, 1.2])
def test_a_coarse_heading_that_turns_by_about_a_step_a_row_has_all_its_readings(steps):
    """Written with more decimals than its steps have: four of five rows lie on a line."""
    t = 0.01 * np.arange(1400)
    heading = 0.0174533 * np.round(steps * np.arange(t.size))
    assert not interpolated(t, np.round(heading, 5)).any()


@pytest.mark.parametrize("every", [2, 5])
def test_a_held_coarse_sensor_is_known_in_spite_of_outliers(every):
    rng = np.random.default_rng(13)
    t = np.arange(0.0, 15.0, 0.01)
    readings = 0.3 * np.sin(2.0 * t[::every]) + rng.normal(0.0, 0.03, t[::every].size)
    y = with_outliers(np.repeat(readings, every)[: t.size], rng)
    found = repeats(0.06 * np.round(y / 0.06), None, t)
    assert np.mean(found == (np.arange(t.size) % every != 0)) > 0.99


@pytest.mark.parametrize("rounded", [None, 4])
@pytest.mark.parametrize("every", [2, 5, 10])
def test_a_line_between_readings_is_no_reading(every, rounded):
    rng = np.random.default_rng(9)
    t = np.arange(0.0, 20.0, 0.01)
    readings = np.sin(0.7 * t[::every]) + rng.normal(0.0, 0.02, t[::every].size)
    y = np.interp(t, t[::every], readings)
    y = y if rounded is None else np.round(y, rounded)
    found = interpolated(t, y)
    new = np.zeros(t.size, bool)
    new[::every] = True
    assert np.mean(found[:-every] == ~new[:-every]) > 0.97


@pytest.mark.parametrize(("unit", "digits"), [(1.0, 4), (np.pi / 180.0, 2)])
def test_a_line_between_headings_is_no_reading_where_they_turn_through_north(unit, digits):
    """Rounded in rad or in deg, before the log's reader made rad of it."""
    rng = np.random.default_rng(9)
    t = np.arange(0.0, 20.0, 0.01)
    readings = 0.9 * t[::5] + rng.normal(0.0, 0.02, t[::5].size)
    logged = (
        np.round((np.interp(t, t[::5], readings) + np.pi) % (2.0 * np.pi) / unit, digits) * unit
    )
    new = np.zeros(t.size, bool)
    new[::5] = True
    assert np.ptp(logged) > 6.0
    assert np.mean(interpolated(t, logged, angle=True)[:-5] == ~new[:-5]) > 0.97


@pytest.mark.parametrize("curve", [CubicSpline, PchipInterpolator, Akima1DInterpolator])
@pytest.mark.parametrize(("every", "rounded"), [(4, None), (10, None), (10, 6)])
def test_a_cubic_between_readings_is_no_reading(curve, every, rounded):
    """As SciPy's and MATLAB's splines resample a slow sensor."""
    rng = np.random.default_rng(11)
    t = np.arange(2000) * 0.01
    readings = np.sin(0.7 * t[::every]) + rng.normal(0.0, 0.02, t[::every].size)
    last = (t[::every].size - 1) * every
    y = curve(t[::every], readings)(t[: last + 1])
    y = y if rounded is None else np.round(y, rounded)
    new = np.zeros(y.size, bool)
    new[::every] = True
    assert np.mean(interpolated(t[: last + 1], y) == ~new) > 0.97


@pytest.mark.parametrize("cut_off", [6.0, 12.0])
def test_a_fast_log_that_was_smoothed_is_on_no_lines(cut_off):
    """At 240 Hz half of all rows are on the line between their neighbours to the last digit."""
    rng = np.random.default_rng(5)
    t = np.arange(6000) / 240.0
    b, a = butter(2, cut_off, fs=240.0)
    y = 0.3 * np.sin(0.9 * t) + 2e-4 * filtfilt(b, a, rng.standard_normal(t.size))
    y[2000:4000] += 0.2 * np.sin(7.0 * t[2000:4000])
    y = np.round(y, 5)
    off = np.abs(y[1:-1] - 0.5 * (y[2:] + y[:-2]))
    assert np.mean(off <= 1.01e-5) > 0.3 and np.median(off[off > 1.01e-5]) > 3e-5, "as lines do"
    assert not interpolated(t, y).any()


def test_a_smooth_log_without_noise_is_on_no_cubic():
    """Rounded, quiet in parts, and as a simulation of a helicopter writes it."""
    t = np.arange(2000) * 0.01
    quiet = np.where(t < 8.0, 0.1, 0.1 + 0.02 * np.sin(9.0 * t) * np.exp(-0.3 * (t - 8.0)))
    for y in (quiet, np.sin(9.0 * t), np.sin(t) * np.sin(5.0 * t), np.sin(0.1 * t**2)):
        for digits in (3, 5, 7, 12):
            assert not interpolated(t, np.round(y, digits)).any(), digits


def test_a_line_over_a_gap_is_no_reading_and_a_sound_signal_has_none():
    rng = np.random.default_rng(10)
    t = np.arange(0.0, 20.0, 0.01)
    y = np.round(np.sin(t) + rng.normal(0.0, 0.03, t.size), 4)
    ramp = np.round(0.25 * t, 2)
    rest = np.round(np.where(t < 10.0, 0.5, 0.5 + 0.3 * np.sin(t)), 2)
    for sound in (y, ramp, rest, np.zeros(t.size), np.round(y, 1), np.sin(t), 0.1 * t):
        assert not interpolated(t, sound).any()
    y[700:730] = np.round(np.linspace(y[699], y[730], 32)[1:-1], 4)
    found = interpolated(t, y)
    assert found[700:730].all() and np.count_nonzero(found) < 40


def test_an_interpolated_log_becomes_what_it_was(tmp_path):
    """pandas' interpolate() over a log of sensors of several rates, at full precision."""

    def drawn(table: Table) -> None:
        t = np.array(table["t"], float)
        for column in ("psi", "h", "vn"):
            given = np.array([cell != "" for cell in table[column]])
            values = [float(cell) for cell in table[column] if cell]
            table[column] = [repr(float(x)) for x in np.interp(t, t[given], values)]

    found, expected = edited(tmp_path / "f", drawn).run(RUN), sound().run(RUN)
    for channel in ("psi", "h", "vn"):
        new, known = (np.isfinite(run.measured[channel]) for run in (found, expected))
        assert np.count_nonzero(new & ~known) <= 0.05 * known.sum(), channel
        assert np.count_nonzero(known & ~new) <= 0.05 * known.sum(), channel


def test_the_card_forces_and_forbids():
    rng = np.random.default_rng(4)
    held = np.repeat(rng.normal(0.0, 1.0, 400), 5)
    new = np.zeros(held.size, bool)
    new[::5] = True
    np.testing.assert_array_equal(repeats(held), ~new)
    assert not repeats(held, hold=False).any()
    np.testing.assert_array_equal(repeats(held, hold=True), ~new)


def test_a_sensor_that_froze_for_a_while_reads_nothing_there():
    values = np.random.default_rng(5).normal(0.0, 1.0, 2000)
    values[700:760] = values[700]
    found = repeats(values)
    assert found[701:760].all() and found.sum() == 59


def test_the_card_says_hold(tmp_path):
    card = copied(tmp_path / "f", RUN) / "card.toml"
    text = card.read_text()
    card.write_text(text.replace("[[run]]", '[columns]\np = { hold = "yes" }\n[[run]]', 1))
    with pytest.raises(coax_env.errors.InputError, match=r"p hold should be true or false"):
        read_flight(tmp_path / "f")
    card.write_text(text.replace("[[run]]", "[columns]\np = { hold = true }\n[[run]]", 1))
    read_flight(tmp_path / "f")


# --- gaps -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("blank", [False, True])
def test_a_gap_cuts_the_run(tmp_path, blank):
    """1.3 s of rows that are not there, or that hold nothing but their time."""
    gone = range(FIRST, FIRST + 130)

    def gap(table: Table) -> None:
        for column in list(table):
            if not blank:
                table[column] = [x for k, x in enumerate(table[column]) if k not in gone]
            elif column != "t":
                table[column] = ["" if k in gone else x for k, x in enumerate(table[column])]

    flight = parts(edited(tmp_path / "f", gap))
    first, second = (run for run in flight.runs if run.whole == RUN)
    expected = sound().run(RUN)
    np.testing.assert_array_equal(first.t, expected.t[:FIRST])
    np.testing.assert_array_equal(second.t, expected.t[gone.stop :])
    np.testing.assert_allclose(second.command, expected.command[gone.stop :], rtol=1e-12)
    assert second.beginning == expected.t[0]
    assert flight.counts["gaps at which a run is cut"] == 1


def test_a_short_gap_is_bridged_and_a_short_part_is_left_out():
    run = sound().run(RUN)

    def without(*gone: range) -> Flight:
        rows = [k for k in range(run.t.size) if not any(k in g for g in gone)]
        return parts(replace(sound(), runs=(run.of_rows(np.array(rows)),)))

    assert len(without(range(400, 420)).runs) == 1
    cut = without(range(400, 450), range(600, 650))
    assert [r.name for r in cut.runs] == [RUN, f"{RUN} (2)"]
    assert cut.counts["parts of less than 2 s left out"] == 1


def test_parts_are_held_out_and_flown_again_as_one_run():
    vehicle = load_vehicle("lama400d")
    flight = sound().select(["hover", "lon_doublet"])
    halves = []
    for run in flight.runs:
        for rows, name in ((slice(0, 500), run.name), (slice(560, 1200), f"{run.name} (2)")):
            part = run.of_rows(rows)
            halves.append(replace(part, name=name, part_of=run.name, began=float(run.t[0])))
    cut = replace(flight, runs=tuple(halves))
    model, records = HeliModel(vehicle), [record_of(run) for run in cut.runs]
    noise = starting_noise(cut, vehicle)
    used, held = split(model, records, noise, ["hover"], (), SETTINGS)
    assert [r.name for r in used] == ["lon_doublet", "lon_doublet (2)"]
    assert [r.name for r in held] == ["hover", "hover (2)"]
    (joined,) = replay_runs(Engine(model, held), model.bare_values, noise)
    single = [replay_runs(Engine(model, [r]), model.bare_values, noise)[0] for r in held]
    assert joined.name == "hover"
    for channel, replayed in joined.channels.items():
        error = np.concatenate([one.channels[channel].error for one in single])
        np.testing.assert_array_equal(replayed.error, error)


def test_a_start_before_a_gap_is_no_full_horizon():
    """What is compared at the horizon's end is measured there, within 0.15 s."""
    run = sound().run("lon_doublet")
    rows = np.r_[0:500, 520:1200]
    gapped = run.of_rows(rows)
    vehicle = load_vehicle("lama400d")
    model = HeliModel(vehicle)
    noise = starting_noise(replace(sound(), runs=(gapped,)), vehicle)
    (replayed,) = replay_runs(Engine(model, [record_of(gapped)]), model.bare_values, noise, 1.0)
    q = replayed.channels["q"]
    starts = np.arange(gapped.t[0] + 1.0, gapped.t[-1] - 1.0 + 1e-9, 0.25)
    seen = np.isfinite(q.t)
    began = gapped.t[np.unique(np.searchsorted(gapped.t, starts - 1e-6))]
    assert (q.t[seen] >= began[seen] + 1.0 - 0.15 - 1e-6).all()
    assert not seen.all()


# --- the diagnosis is not blind -------------------------------------------------------------------


@pytest.mark.slow
def test_the_causes_are_those_of_the_sound_flight(tmp_path):
    """Four causes are hidden in the bundled flight; all are named still with both faults."""
    rows = slice(FIRST, FIRST + 5 * RATE)

    def packet(table: Table) -> None:
        table["rpm_upper_cmd"][FIRST : FIRST + 4] = ["23512"] * 4
        table["delta_lat"][FIRST : FIRST + 4] = ["-4.6"] * 4

    def carried(table: Table) -> None:
        for column in ("rpm_upper_cmd", "rpm_lower_cmd", "delta_lon", "delta_lat"):
            table[column][rows] = [table[column][FIRST]] * (5 * RATE)
        for k in range(rows.start, rows.stop):
            if table["vn"][k]:
                table["vn"][k] = f"{float(table['vn'][k]) + 3.0 * np.sin(0.01 * k):.4f}"

    shows_all = ("forward_run", "heading_turn", "lat_3211", "lon_3211", "yaw_3211")
    copied(tmp_path / "f", *shows_all, "side_run")
    edited(tmp_path / "f", packet, "lat_3211")
    flight = edited(tmp_path / "f", carried, "side_run")
    hidden = json.loads((BUNDLED / "truth.json").read_text())["hidden"]
    assert {c["effect"] for c in diagnose(flight).findings["causes"]} == set(hidden)


@pytest.mark.slow
@pytest.mark.needs_shared_flights
def test_the_second_coax_is_read_cut_and_diagnosed():
    """25 Hz, 21 gaps, one of 1.3 s, which cuts its run in two; two of its four runs, for time."""
    flight = read("skybotix_second").select(("4x5ft_1", "15ft_1"))
    result = diagnose(flight, hold_out=["4x5ft_1"])
    assert result.findings["gain"]["held_out"] == ["4x5ft_1"]
    assert [run.name for run in result.flight.runs] == ["4x5ft_1", "4x5ft_1 (2)", "15ft_1"]
    assert "4x5ft_1: cut at a gap of 1.29 s, 20.3 s" in result.remarks
