"""The flight folder: what is read, what is repaired and counted, what is refused and how."""

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from bundled_flight import BUNDLED
from csv_edits import Table, rewrite
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from shared_flights import read

from coax_env.errors import InputError
from coax_env.estimation.flown import flown_parts
from coax_env.kernel.angles import wrap_angles
from coax_env.logs.flight import Flight, Run, read_flight, write_flight
from coax_env.logs.outliers import (
    AWAY,
    are_answers,
    find_averaged_headings,
    find_miscounts,
    find_outliers,
    off_median,
)
from coax_env.logs.repairs import hold_last
from coax_env.model.layout import RPM_PER_RAD_S
from coax_env.model.vehicle_file import load_vehicle

CARD = """
[vehicle]
name = "lama400d"
[[run]]
name = "hover"
file = "hover.csv"
maneuver = "hover"
"""
COMMANDS = "rpm_upper_cmd,rpm_lower_cmd,delta_lon,delta_lat"


def log(header: str = f"t,{COMMANDS},q", row: str = "{t:.2f},2000,2140,0.01,,0.1", n: int = 301):
    """A CSV of n rows, 10 ms apart."""
    return "\n".join([header, *(row.format(t=0.01 * k) for k in range(n))]) + "\n"


def folder(tmp_path: Path, csv: str | bytes | None = None, card: str | bytes = CARD) -> Path:
    """A flight folder of one run."""
    csv = log() if csv is None else csv
    for name, content in (("card.toml", card), ("hover.csv", csv)):
        data = content.encode() if isinstance(content, str) else content
        (tmp_path / name).write_bytes(data)
    return tmp_path


def read_run(tmp_path: Path, csv: str | bytes | None = None, card: str = CARD) -> Run:
    return read_flight(folder(tmp_path, csv, card)).runs[0]


# --- what is read ------------------------------------------------------------------------------


def test_plain_log(tmp_path: Path) -> None:
    flight = read_flight(folder(tmp_path))
    run = flight.run("hover")
    assert flight.vehicle == "lama400d"
    assert flight.notes == ("runs without delta_lat, taken as 0: 1",)
    assert list(run.measured) == ["q"]
    np.testing.assert_allclose(run.t, 0.01 * np.arange(301))
    np.testing.assert_allclose(
        run.command[5], [2000 * math.pi / 30, 2140 * math.pi / 30, 0.01, 0.0], rtol=1e-12
    )
    assert set(flight.hashes) == {"card.toml", "hover.csv"}


def test_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    n = 500
    t = np.cumsum(rng.uniform(0.004, 0.02, n))
    runs = []
    for name in ("a run", "a_run", "Überflug/2"):
        height = np.where(rng.random(n) < 0.5, np.nan, rng.normal(1.0, 0.1, n))
        measured = {"q": rng.normal(size=n), "h": height}
        runs.append(Run(name, t, rng.uniform(0, 1, (n, 4)), measured, 'so "called"', "x,\ny"))
    flight = Flight("lama400d", tuple(runs), {"density": 1.1}, {"q": 0.035})
    again = read_flight(write_flight(flight, tmp_path / "new" / "flight"))
    assert again.run_names == flight.run_names
    assert (again.vehicle, again.air, again.noise) == (flight.vehicle, flight.air, flight.noise)
    for before, after in zip(flight.runs, again.runs, strict=True):
        assert (before.maneuver, before.note) == (after.maneuver, after.note)
        np.testing.assert_allclose(after.t, before.t, atol=1e-9)
        np.testing.assert_allclose(after.command, before.command, rtol=1e-10)
        for channel, values in before.measured.items():
            np.testing.assert_allclose(after.measured[channel], values, rtol=1e-8)


def test_writing_leaves_other_files_and_no_half_flight(tmp_path: Path) -> None:
    flight = read_flight(folder(tmp_path))
    target = tmp_path / "out"
    target.mkdir()
    (target / "figure.html").write_text("mine")
    write_flight(flight, target)
    assert sorted(p.name for p in target.iterdir()) == ["card.toml", "figure.html", "hover.csv"]
    broken = Run("hover", np.zeros(3), np.zeros((2, 4)), {})
    with pytest.raises(ValueError):
        write_flight(Flight("lama400d", (broken,)), tmp_path / "half")
    assert not (tmp_path / "half").exists()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_names_and_units_of_another_log(tmp_path: Path) -> None:
    card = (
        CARD
        + """
[columns]
t = { name = "time", unit = "ms" }
rpm_upper = { name = "w_u", unit = "rad/s" }
q = { name = "gyro y", unit = "deg/s" }
az = { name = "acc z", unit = "g" }
theta = { name = "pitch", unit = "deg" }
h = { name = "alt", unit = "ft" }
vn = { name = "north", unit = "km/h" }
pn = { name = "x", unit = "mm" }
"""
    )
    header = "time,w_u,rpm_lower_cmd,gyro y,acc z,pitch,alt,north,x,comment"
    lines = [header, *(f"{10 * k},210,2140,10,-1,5,10,36,1500,fine" for k in range(301))]
    flight = read_flight(folder(tmp_path, "\n".join(lines), card))
    run = flight.runs[0]
    expected = {
        "q": math.radians(10), "az": -9.80665, "theta": math.radians(5), "h": 3.048,
        "vn": 10.0, "pn": 1.5,
    }  # fmt: skip
    assert {c: pytest.approx(v[7]) for c, v in run.measured.items()} == expected
    assert run.t[-1] == pytest.approx(3.0)
    assert run.command[0, 0] == pytest.approx(210.0)
    assert flight.counts["unknown columns ignored"] == 1


def test_measured_speed_drives_where_no_command_was_logged(tmp_path: Path) -> None:
    run = read_run(tmp_path, log("t,rpm_upper,rpm_lower,q", "{t:.2f},2000,2140,0.1"))
    assert list(run.measured) == ["q"]
    np.testing.assert_allclose(run.command * RPM_PER_RAD_S, [[2000, 2140, 0, 0]] * 301)
    both = read_run(tmp_path, log(f"t,{COMMANDS},rpm_upper", "{t:.2f},2000,2140,0,0,1990"))
    assert list(both.measured) == ["rpm_upper"]


def test_windows_spreadsheet_habits(tmp_path: Path) -> None:
    text = log(row='{t:.2f}, "2000" ,2140 ,0.01,,0.1').replace("\n", "\r\n") + "\r\n,,,,,\r\n\r\n"
    run = read_run(tmp_path, b"\xef\xbb\xbf" + text.encode())
    assert len(run.t) == 301
    assert run.command[0, 0] == pytest.approx(2000 / RPM_PER_RAD_S)


def test_several_rates_and_held_commands(tmp_path: Path) -> None:
    rows = [f"t,{COMMANDS},q,h"]
    for k in range(400):
        sonar = f"{1 + 0.001 * k:.3f}" if k % 5 == 0 else ""
        upper = "2000" if k == 10 else "2010" if k == 20 else ""
        rows.append(f"{0.01 * k:.2f},{upper},2140,0,0,0.1,{sonar}")
    run = read_run(tmp_path, "\n".join(rows))
    assert np.count_nonzero(~np.isnan(run.measured["h"])) == 80
    upper = run.command[:, 0] * RPM_PER_RAD_S
    np.testing.assert_allclose(upper[:20], 2000)
    np.testing.assert_allclose(upper[20:], 2010)


def test_hold_last() -> None:
    nan = np.nan
    np.testing.assert_array_equal(hold_last(np.array([nan, 1, nan, 2, nan])), [1, 1, 1, 2, 2])


# --- what is repaired and counted ------------------------------------------------------------------


def test_repeated_time_stamps_are_merged(tmp_path: Path) -> None:
    text = log() + "3.00,,,0.02,,\n3.00,1990,,,,0.3\n3.01,2000,2140,,,0.4\n"
    flight = read_flight(folder(tmp_path, text))
    run = flight.runs[0]
    assert flight.counts["rows with a repeated time stamp merged"] == 2
    assert len(run.t) == 302
    assert run.measured["q"][-2:].tolist() == [0.3, 0.4]
    assert run.command[-2, 0] * RPM_PER_RAD_S == pytest.approx(1990)
    assert run.command[-2, 2] == 0.02


def test_impossible_commands_empty_columns_and_gaps(tmp_path: Path) -> None:
    rows = [f"t,{COMMANDS},q,ax"]
    for k in range(400):
        if 100 <= k < 130:
            continue
        speed = -50 if k in (3, 4) else 2000
        gyro = "" if 200 <= k < 230 else "0.1"
        rows.append(f"{0.01 * k:.2f},{speed},2140,0,0,{gyro},")
    flight = read_flight(folder(tmp_path, "\n".join(rows)))
    assert flight.counts == {
        "empty columns ax dropped": 1,
        "negative rpm_upper_cmd clipped at 0": 2,
        "gaps of more than 0.1 s between rows": 1,
        "gaps of more than 0.1 s without any reading": 1,
    }
    assert flight.runs[0].command.min() == 0.0
    assert flight.channels == ("q",)


@pytest.mark.parametrize("burst", [1, 2, 3])
@pytest.mark.parametrize("noise", [0.05, None])
@pytest.mark.parametrize("first", [0, 60, 97])
def test_lost_echoes_are_removed(burst: int, noise: float | None, first: int) -> None:
    rng = np.random.default_rng(burst)
    height = np.full(500, np.nan)
    height[::5] = 1.0 + 0.5 * np.sin(np.arange(100) / 15) + rng.normal(0, 0.05, 100)
    lost = np.arange(first, first + burst) * 5
    height[lost] = 6.5
    assert np.flatnonzero(find_outliers("h", height, noise)).tolist() == lost.tolist()


def test_real_motion_stays() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(0, 10, 0.01)
    pulse = np.where((t > 2) & (t < 2.2), 0.6, 0.0) - np.where((t > 2.2) & (t < 2.3), 0.6, 0.0)
    step = np.where(t > 5, 3.0, 0.0)
    for noise in (0.0, 1e-6, 0.035):
        for motion in (pulse, step, np.sin(12 * t), np.round(np.sin(t), 2)):
            reading = motion + rng.normal(0, noise, len(t)) if noise else motion
            assert not find_outliers("q", reading).any()
    heading = np.angle(np.exp(1j * (2 * t + rng.normal(0, 0.01, len(t)))))
    assert not find_outliers("psi", heading, 0.0087).any()


def test_what_commands_foretell_is_no_outlier(tmp_path: Path) -> None:
    """Rotors whose speed jumps turn the body; bit errors that come at any time are none of that."""
    rng = np.random.default_rng(4)
    n = 1200
    jumps = np.where(rng.random(n) < 0.05, rng.choice([-20.0, 20.0], n), 0.0)
    speed = 200.0 + jumps + rng.normal(0.0, 0.3, n)
    rate = 0.02 * np.roll(speed - 200.0, 3) + rng.normal(0.0, 0.01, n)
    broken = rng.choice(np.arange(20, n - 20), 12, replace=False)
    rate[broken] += rng.choice([-0.6, 0.6], 12)
    flagged = find_outliers("r", rate, 0.01)
    every = np.ones(n, dtype=bool)
    answers = are_answers("r", rate, [off_median(speed), np.zeros(n)], every)
    genuine = np.setdiff1d(np.flatnonzero(np.roll(jumps, 3)), broken)
    alone = np.setdiff1d(broken, np.flatnonzero(np.roll(jumps, 3)))
    assert flagged[broken].all() and flagged[genuine].mean() > 0.7
    assert answers[genuine].mean() > 0.98 and not answers[alone].any()
    command = np.tile([0.0, 224.0, 0.0, 0.0], (n, 1))
    command[:, 0] = speed
    run = Run("hover", 0.01 * np.arange(n), command, {"r": rate})
    flight = read_flight(write_flight(Flight("lama400d", (run,)), tmp_path / "flight"))
    left_out = np.flatnonzero(np.isnan(flight.run("hover").measured["r"]))
    assert set(alone) <= set(left_out) and not set(genuine[answers[genuine]]) & set(left_out)


@pytest.mark.parametrize(("every", "whole"), [(1, True), (5, False)])
def test_a_trackers_pose_with_an_outlier_in_it_is_left_out_whole(tmp_path, every, whole):
    """Not where position comes at another rate than attitudes, from a sensor of its own."""
    rng, n = np.random.default_rng(5), 600
    pose = {c: rng.normal(0.0, 1e-3, n) for c in ("phi", "theta", "psi", "h", "pn", "pe")}
    for channel in ("pn", "pe"):
        pose[channel][np.arange(n) % every > 0] = np.nan
    pose["theta"][205] += 0.1
    rates = {"q": rng.normal(0.0, 1e-2, n)}
    run = Run("hover", 0.01 * np.arange(n), np.tile([200.0, 200.0, 0.0, 0.0], (n, 1)), pose | rates)
    flight = read_flight(write_flight(Flight("lama400d", (run,)), tmp_path / "flight"))
    found = flight.run("hover").measured
    gone = {c for c in (*pose, "q") if np.isnan(found[c][205])}
    assert gone == (set(pose) if whole else {"theta"})
    assert {c: int(np.isnan(found[c]).sum()) for c in ("phi", "theta", "q")} == {
        "phi": int(whole), "theta": 1, "q": 0
    }  # fmt: skip
    said = "poses of a tracker left out whole for an outlier in them"
    assert flight.counts.get(said, 0) == int(whole) and flight.counts["outliers in theta removed"]


def test_one_jump_of_a_command_foretells_nothing() -> None:
    """What it alone would explain is not foretold by any other row."""
    rate = np.random.default_rng(0).normal(0.0, 0.01, 400)
    command = np.full(400, 200.0)
    command[150], rate[152] = 220.0, 1.0
    assert find_outliers("r", rate, 0.01)[152]
    every = np.ones(400, dtype=bool)
    assert not are_answers("r", rate, [off_median(command)], every)[152]
    assert not are_answers("r", rate, [], every).any()
    assert not are_answers("r", rate, [off_median(np.full(400, 200.0))], every).any()


@pytest.mark.slow
@pytest.mark.needs_shared_flights
def test_open_flights_lose_nothing_genuine() -> None:
    for name in ("open_none", "open_near_ground", "open_rigging", "open_outside"):
        flight = read(name)
        assert flight.notes == (), name
        assert len(flight.runs) == 12


@pytest.mark.slow
@pytest.mark.needs_shared_flights
def test_windy_flight_loses_its_lost_echoes_and_nothing_else() -> None:
    flight = read("open_windy")
    assert flight.counts == {
        "gaps of more than 0.1 s without any reading": 21,
        "outliers in h removed": 15,
    }


@pytest.mark.needs_shared_flights
def test_the_real_helicopter_is_read() -> None:
    flight = read("skybotix_coax")
    assert flight.run_names == ("hover", "vertical_sine", "circles")
    assert flight.channels == ("phi", "theta", "psi", "h", "pn", "pe")
    assert flight.counts["negative rpm_lower_cmd clipped at 0"] == 1
    assert flight.air == {"density": 1.2, "gravity": 9.81}


# --- what is refused ------------------------------------------------------------------------------

HEADER = f"t,{COMMANDS},q\n"
BAD_LOGS: dict[str, tuple[str | bytes, str]] = {
    "empty": (b"", "hover.csv: the file is empty"),
    "header only": (HEADER, "no rows"),
    "no time": (log().replace("t,", "when,", 1), "no time column 't'"),
    "time runs backwards": (log() + "0.5,2000,2140,0,0,0\n", "line 303: time runs backwards"),
    "row without time": (log() + ",2000,2140,0,0,0\n", "line 303: a row without a time"),
    "text": (log() + "3.01,2000,2140,zero,0,0\n", "line 303, column 'delta_lon': 'zero'"),
    "underscore": (log() + "3.01,2_000,2140,0,0,0\n", "'2_000' is not a finite number"),
    "infinite": (log() + "3.01,2000,2140,0,0,inf\n", "line 303, column 'q': 'inf'"),
    "overflowing": (log() + "3.01,2000,2140,0,0,1e999\n", "line 303, column 'q': '1e999'"),
    "ragged": (log() + "3.01,2000,2140\n", "line 303: 3 cells where the header has 6"),
    "ragged, long": (log() + "3.01,2000,2140,0,0,0,7\n", "line 303: 7 cells"),
    "short": (log(n=200), "the run lasts 1.99 s"),
    "one row": (log(n=1), "the run lasts 0 s"),
    "no rotor speed": (log("t,delta_lon,q", "{t:.2f},0,0"), "neither rpm_upper_cmd nor rpm_upper"),
    "empty rotor speed": (log(row="{t:.2f},,2140,0,0,0"), "no rotor speed"),
    "no header": (log().partition("\n")[2], "line 1: numbers, no header"),
    "units below the header": (
        HEADER + "s,rpm,rpm,rad,rad,1/s\n" + log().partition("\n")[2],
        "if it holds the units, delete it",
    ),
    "time in us": (
        HEADER + "".join(f"{k}e4,2000,2140,0,0,0\n" for k in range(301)),
        't = { name = "t", unit = "us" }',
    ),
    "time jumps": (log() + "1e9,2000,2140,0,0,0\n", "does its time jump?"),
    "no time at all": (log() + "1e30,2000,2140,0,0,0\n", "line 303: 1e+30 is no time"),
    "decimal comma": (
        log(HEADER.strip().replace(",", ";"), "{t:.2f};2000;2140;0;0;0,1"),
        "decimal point",
    ),
    "missing in words": (log() + "3.01,2000,2140,0,0,null\n", "leave the cell empty"),
    "time of day": (log(row="12:00:{t:05.2f},2000,2140,0,0,0"), "time is needed in seconds"),
    "foreign rotor speed": (
        log("t,motor1,motor2,q", "{t:.2f},2000,2140,0"),
        'rpm_upper = { name = "motor1"',
    ),
    "UTF-16": (log().encode("utf-16"), "save it as UTF-8"),
    "binary": (bytes(range(256)) * 20, "hover.csv: binary, not text"),
    "latin": (log().encode() + b"\xb0", "hover.csv: not UTF-8 text"),
    "twice the same column": (log(f"t,{COMMANDS},t"), "2 columns are named 't'"),
    "endless cell": (HEADER + "1" * 200_000, "line 2"),
}
BAD_CARDS: dict[str, tuple[str | bytes, str]] = {
    "broken TOML": ("[vehicle", "card.toml: not valid TOML"),
    "empty": ("", "no [vehicle] section"),
    "vehicle without name": (
        CARD.replace("name =", "nom =", 1),
        "unknown key 'nom': 'name' is meant",
    ),
    "vehicle is a number": (CARD.replace('"lama400d"', "4"), "should be text, found 4"),
    "no run": ('[vehicle]\nname = "x"', "no [[run]] entry"),
    "run is no list": ('run = "hover"\n[vehicle]\nname = "x"', "no [[run]] entry"),
    "run without file": (CARD.replace("file", "fil"), "unknown key 'fil': 'file' is meant"),
    "missing file": (CARD.replace("hover.csv", "gone.csv"), "gone.csv: No such file"),
    "file is a folder": (CARD.replace("hover.csv", "."), "Is a directory"),
    "runs of one name": (CARD + '[[run]]\nname = "hover"\nfile = "hover.csv"', "2 runs are named"),
    "noise is text": (CARD + '[noise]\nq = "low"', "[noise] q should be a number, found 'low'"),
    "noise is zero": (CARD + "[noise]\nq = 0", "[noise] q should be positive"),
    "noise is negative": (CARD + "[noise]\nq = -1.0", "[noise] q should be positive"),
    "noise is nan": (CARD + "[noise]\nq = nan", "[noise] q should be positive"),
    "noise is true": (CARD + "[noise]\nq = true", "[noise] q should be a number"),
    "no air": (CARD + "[air]\ndensity = 0", "[air] density should be positive"),
    "unknown unit": (CARD + '[columns]\nq = {unit = "furlong"}', "unknown unit 'furlong'"),
    "wrong dimension": (CARD + '[columns]\nq = {unit = "m"}', "channel q: unit 'm' is no unit"),
    "unknown channel": (CARD + '[columns]\nqq = {unit = "m"}', "unknown channel 'qq'"),
    "column in no file": (CARD + '[columns]\nh = {name = "alt"}', "no run has a column 'alt'"),
    "scale is zero": (CARD + "[columns]\nq = {scale = 0}", "q scale should be a number, not 0"),
    "scale is text": (CARD + '[columns]\nq = {scale = "-"}', "q scale should be a number"),
    "unknown section": (CARD + "[nois]\nq = 1.0", "unknown section 'nois': 'noise' is meant?"),
    "unknown noise": (CARD + "[noise]\nqq = 1.0", "[noise] unknown key 'qq'"),
    "unknown air": (CARD + "[air]\ndensty = 1.0", "'density' is meant?"),
    "unknown key of a run": (CARD.rstrip() + '\nmanoeuvre = "x"', "'maneuver' is meant?"),
    "unknown key of a column": (CARD + '[columns]\nq = {units = "m"}', "'unit' is meant?"),
    "unknown check key": (CARD + "[checks]\nwave = []", "'waive' is meant?"),
    "sign is 2": (CARD + "[columns]\nq = {sign = 2}", "q sign should be 1 or -1, found 2"),
    "offset is text": (CARD + '[columns]\nq = {offset = "1"}', "q offset should be a number"),
    "calibration of one point": (CARD + "[columns]\nq = {calibration = [[1, 2]]}", "two at least"),
    "calibration falls": (CARD + "[columns]\nq = {calibration = [[2, 2], [1, 3]]}", "raw rising"),
    "calibration is flat": (CARD + "[columns]\nq = {calibration = [[1, 2], [2, 2]]}", "one value"),
    "calibration and scale": (
        CARD + "[columns]\nq = {scale = 2.0, calibration = [[1, 2], [2, 3]]}",
        "leave them out",
    ),
    "quaternion of three": (
        CARD + '[columns]\nquaternion = {names = ["a", "b", "c"], from = "body to NED"}',
        "four columns",
    ),
    "quaternion from nowhere": (
        CARD + '[columns]\nquaternion = {names = ["a", "b", "c", "d"], from = "here to there"}',
        "'here to there' is not of the form",
    ),
    "two channels of one column": (
        CARD + '[columns]\np = {name = "q"}\nq = {name = "q"}',
        "p and q both read the column 'q'",
    ),
    "latitude alone": (CARD + '[columns]\nlat = "q"', "name both"),
    "part C": (CARD.rstrip() + '\npart = "C"', 'part should be "A" or "B"'),
    "column is a number": (CARD + "[columns]\nh = 3", "[columns] h should be"),
    "binary": (b"\x00\x01\x02", "card.toml: binary"),
}


def assert_refused(flight: Path, words: str) -> None:
    with pytest.raises(InputError) as caught:
        read_flight(flight)
    message = str(caught.value)
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize("case", BAD_LOGS)
def test_bad_log(tmp_path: Path, case: str) -> None:
    content, words = BAD_LOGS[case]
    assert_refused(folder(tmp_path, content), words)


@pytest.mark.parametrize("case", BAD_CARDS)
def test_bad_card(tmp_path: Path, case: str) -> None:
    content, words = BAD_CARDS[case]
    assert_refused(folder(tmp_path, card=content), words)


def test_no_folder(tmp_path: Path) -> None:
    assert_refused(tmp_path / "gone", "no flight folder")
    assert_refused(tmp_path, "card.toml: No such file")
    assert_refused(folder(tmp_path) / "hover.csv", "found a file there")


# --- nothing but InputError, whatever comes ----------------------------------------------------

FUZZ = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
CELLS = st.one_of(
    st.sampled_from(["", " ", "nan", "inf", "-1", "0", "2000", "1e308", '"', "t", "\r", "#"]),
    st.floats().map(repr),
    st.text(max_size=5),
)


@pytest.mark.slow
@FUZZ
@given(st.lists(st.lists(CELLS, min_size=5, max_size=7), max_size=6), st.integers(0, 300))
def test_any_rows_are_read_or_refused(tmp_path: Path, rows: list[list[str]], at: int) -> None:
    lines = log().split("\n")
    lines[at:at] = [",".join(row) for row in rows]
    read_or_refuse(folder(tmp_path, "\n".join(lines).encode("utf-8", "surrogatepass")))


@FUZZ
@given(st.binary(max_size=200), st.binary(max_size=200), st.booleans())
def test_any_bytes_are_read_or_refused(
    tmp_path: Path, csv: bytes, card: bytes, whole_card: bool
) -> None:
    read_or_refuse(folder(tmp_path, csv, CARD if whole_card else card))


def read_or_refuse(flight: Path) -> None:
    try:
        run = read_flight(flight).runs[0]
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(run.command).all()
        assert (np.diff(run.t) > 0).all()


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_a_counter_that_misses_pulses_reads_no_speed(times):
    """For a second and a half, on a speed that is not steady; a spin-up passes half speed and stays."""
    t = np.arange(1000) / 100.0
    command = 2000.0 + 100.0 * np.sin(t)
    speed = 1.03 * command
    speed[::9] = np.nan
    wrong = (t > 4.0) & (t < 5.5)
    found = find_miscounts(np.where(wrong, times * speed, speed), command)
    np.testing.assert_array_equal(found, wrong & ~np.isnan(speed))
    to_the_end = t > 8.0
    assert find_miscounts(np.where(to_the_end, times * speed, speed), command).sum() > 170
    spun_up = np.minimum(0.3 + t / 2.0, 1.0)
    assert not find_miscounts(speed * spun_up, command).any()
    idle = np.where(t < 6.0, 0.5, 1.0)  # the flight at twice the usual speed
    assert not find_miscounts(speed * idle, command * idle).any()
    for lost in (t < 0.04, (t > 4.0) & (t < 4.04), t > 9.96):  # a command, which the rotor survives
        assert not find_miscounts(speed, np.where(lost, command / times, command)).any()
    assert not find_miscounts(np.full(5, np.nan), np.full(5, 2000.0)).any()


@pytest.mark.parametrize(("hz", "left"), [(25.0, 0.6), (100.0, AWAY), (200.0, AWAY)])
@pytest.mark.parametrize("rate", [0.3, 1.0, 3.0])
def test_headings_averaged_across_half_a_turn_are_found(
    hz: float, left: float, rate: float
) -> None:
    """Put on other times by straight lines as plain numbers; no sound one is taken for such."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 12.0, 1.0 / hz)
    turned = np.pi + rate * (t - 3.0) + 0.1 * np.sin(2.0 * t) + 0.01 * rng.standard_normal(t.size)
    logged = wrap_angles(turned)
    assert not find_averaged_headings(t, logged).any()
    at = t[1:-1] + 0.41 / hz
    averaged = np.interp(at, t, logged)
    off = np.abs(wrap_angles(averaged - np.interp(at, t, turned)))
    found = find_averaged_headings(at, averaged)
    assert found.any() and not found[off < 1e-9].any() and off[~found].max() < left
    averaged[::7] = np.nan
    assert not find_averaged_headings(at, averaged)[::7].any()
    assert not find_averaged_headings(t[:2], logged[:2]).any()


@pytest.mark.slow
def test_no_run_is_cut_where_a_heading_was_averaged(tmp_path: Path) -> None:
    """A row's reading is missing there, and nothing else: unwrapped it would lose a turn."""
    shutil.copytree(BUNDLED, tmp_path, dirs_exist_ok=True)
    file = tmp_path / "heading_turn.csv"

    def averaged(table: Table) -> None:
        rows = [k for k, cell in enumerate(table["psi"]) if cell]
        t = np.array([float(table["t"][k]) for k in rows])
        psi = np.array([float(table["psi"][k]) for k in rows])
        psi = wrap_angles(psi + np.pi - psi[t.size // 2])
        for k, heading in zip(
            rows, np.interp(t + 0.4 * np.median(np.diff(t)), t, psi), strict=True
        ):
            table["psi"][k] = f"{heading:.5f}"

    rewrite([file], averaged)
    flight = read_flight(tmp_path)
    flight = flown_parts(flight, load_vehicle(flight.vehicle))
    (said,) = [note for note in flight.notes if "averaged across half a turn" in note]
    assert not [note for note in flight.notes if "jumped" in note], said


@pytest.mark.slow
def test_a_miscounted_speed_is_left_out_of_a_flight(tmp_path: Path) -> None:
    shutil.copytree(BUNDLED, tmp_path, dirs_exist_ok=True)
    file = sorted(tmp_path.glob("*.csv"))[0]

    def miscounted(table: Table) -> None:
        """The lower rotor's beside a command that is logged in every fifth row."""
        told = table["rpm_lower_cmd"]
        table["rpm_lower_cmd"] = [cell if k % 5 == 0 else "" for k, cell in enumerate(told)]
        for rotor, times, rows in (
            ("upper", 0.5, range(400, 550)),
            ("lower", 2.0, range(600, 700)),
        ):
            speed = table[f"rpm_{rotor}"]
            for row in (row for row in rows if speed[row]):
                speed[row] = f"{times * float(speed[row]):.1f}"

    rewrite([file], miscounted)
    flight = read_flight(tmp_path)
    run = next(run for run in flight.runs if run.name == file.stem)
    assert np.isnan(run.measured["rpm_upper"][400:550]).all()
    assert np.isnan(run.measured["rpm_lower"][600:700]).all()
    assert 50 < flight.counts["readings of rpm_upper at half or twice its speed, left out"] <= 150
