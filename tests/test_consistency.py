"""A log that contradicts itself is refused with the line of its card to change; a sound one never is.

Errors are planted as the card of a sound log would bring them, so that the right line is known: the
entry without the error.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import injector
import numpy as np
import pytest
from bundled_flight import bundled, copied
from shared_flights import read

from coax_env.comparison.two_flights import read_two
from coax_env.consistency.agreement import Agreement, agreement, refuse_disagreement
from coax_env.consistency.checks import names
from coax_env.consistency.even_rows import STEP, even_rows, weak
from coax_env.errors import InputError
from coax_env.estimation.flown import flown_parts
from coax_env.logs.card import read_card
from coax_env.logs.card_columns import Column
from coax_env.logs.flight import Flight, Run, read_flight, write_flight
from coax_env.logs.units import ROTOR_COMMANDS, SWASH_COMMANDS
from coax_env.model.layout import RPM_PER_RAD_S
from coax_env.model.sensors import log_suite
from coax_env.model.vehicle_file import load_vehicle
from coax_env.simulation.simulate import fly_all, log_flight

RUNS = ("forward_run", "side_run", "heading_turn", "climb_descend")
"""Of a flight, that its errors are planted into: every axis."""
MANEUVERS = ("lon_3211", "lat_3211", "heading_turn", "climb_descend")
COMMANDS = (*ROTOR_COMMANDS, *SWASH_COMMANDS)


def checked(flight: Flight, waive: tuple[str, ...] = ()) -> Agreement:
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    return agreement(flown_parts(flight, vehicle), vehicle, waive)


@cache
def with_positions(folder: Path) -> Flight:
    """A simulated flight with motion capture beside the default sensors."""
    lama = load_vehicle("lama400d")
    flown = fly_all(lama, MANEUVERS, seed=5)
    flight = log_flight(lama, flown, log_suite("mocap"), noise=True, seed=5)
    return read_flight(write_flight(flight, folder))


def planted(folder: Path, columns: str) -> Path:
    """The bundled flight with these lines under [columns] of its card."""
    card = copied(folder, *RUNS) / "card.toml"
    card.write_text(card.read_text().replace("[[run]]", f"[columns]\n{columns}\n[[run]]", 1))
    return folder


def erring(folder: Path, columns: str, sound: Flight | None = None) -> Flight:
    """The same, or another flight, without reading it anew: its readings as such a card has them."""
    sound = sound or bundled().select(RUNS)
    folder.mkdir()
    card = folder / "card.toml"
    run = '[[run]]\nname = "a"\nfile = "a.csv"\n'
    card.write_text(f'[vehicle]\nname = "{sound.vehicle}"\n[columns]\n{columns}\n{run}')
    named = read_card(card).columns
    return replace(sound, runs=tuple(_erring(run, named) for run in sound.runs), columns=named)


def _erring(run: Run, named: Mapping[str, Column]) -> Run:
    units = {name: RPM_PER_RAD_S if name in ROTOR_COMMANDS else 1.0 for name in COMMANDS}
    raw = {name: units[name] * run.command[:, k] for k, name in enumerate(COMMANDS)}
    raw |= run.measured
    found = {c: named[c].read(raw[named[c].name]) if c in named else raw[c] for c in raw}
    command = [found.pop(name) / units[name] for name in COMMANDS]
    return replace(run, command=np.stack(command, axis=1), measured=found)


# --- errors of a card -----------------------------------------------------------------------------


def flipped(channel: str) -> tuple[str, str]:
    return f"{channel} = {{ sign = -1 }}", own(channel)


def own(channel: str, column: str = "") -> str:
    return f'{channel} = {{ name = "{column or channel}" }}'


def in_unit(unit: str, *channels: str) -> tuple[str, str]:
    lines = "\n".join(f'{c} = {{ unit = "{unit}" }}' for c in channels)
    return lines, "|".join(own(c) for c in channels)


def swapped(*pairs: tuple[str, str]) -> tuple[str, str]:
    both = [(a, b) for pair in pairs for a, b in (pair, pair[::-1])]
    lines = "\n".join(own(a, b) for a, b in both)
    return lines, "|".join(own(a) for a, _ in both)


SIGNS = "p q r ax ay az phi theta psi h vn ve vd delta_lon delta_lat"
PULSES = "delta_lon = { scale = 2500.0, offset = 0.6 }"
ROTORS = (("rpm_upper_cmd", "rpm_lower_cmd"), ("rpm_upper", "rpm_lower"))
ERRORS: Mapping[str, tuple[str, str]] = {
    **{f"{channel} turned": flipped(channel) for channel in SIGNS.split()},
    "gyros taken for deg/s": in_unit("deg/s", "p", "q", "r"),
    "one gyro taken for deg/s": in_unit("deg/s", "q"),
    "roll taken for deg": in_unit("deg", "phi"),
    "attitude taken for deg": in_unit("deg", "phi", "theta", "psi"),
    "attitude in turns": in_unit("rev", "theta"),
    "accelerometers taken for g": in_unit("g", "ax", "ay", "az"),
    "down accelerometer taken for g": in_unit("g", "az"),
    "height in cm": in_unit("cm", "h"),
    "velocities in km/h": in_unit("km/h", "vn", "ve", "vd"),
    "swash in deg": in_unit("deg", "delta_lon", "delta_lat"),
    "rotors in rev/s": in_unit("rev/s", "rpm_upper_cmd", "rpm_lower_cmd"),
    "a rotor in rad/s": in_unit("rad/s", "rpm_upper_cmd"),
    "a measured rotor in rad/s": in_unit("rad/s", "rpm_upper"),
    "rotors swapped": swapped(*ROTORS),
    "rotor commands swapped": swapped(ROTORS[0]),
    "gyros swapped": swapped(("p", "q")),
    "roll and pitch swapped": swapped(("phi", "theta")),
    "accelerometers swapped": swapped(("ax", "ay")),
    "velocities swapped": swapped(("vn", "ve")),
    "swash commands swapped": swapped(("delta_lon", "delta_lat")),
    "z up, y left": (
        "\n".join(flipped(c)[0] for c in ("q", "r", "ay", "az")),
        "|".join(own(c) for c in ("q", "r", "ay", "az")),
    ),
    "heading half a turn off": ("psi = { offset = 3.14159 }", "psi = {"),
    "swash as pulse widths": (PULSES, "delta_lon reaches|calibration = [["),
    "rotor as pulse widths": (
        "rpm_upper_cmd = { scale = 0.25, offset = 4000.0 }",
        "rpm_upper_cmd-range|calibration = [[",
    ),
}
ERRORS_OF_POSITIONS: Mapping[str, tuple[str, str]] = {
    "pn turned": flipped("pn"),
    "pe turned": flipped("pe"),
    "positions swapped": swapped(("pn", "pe")),
    "positions in feet": in_unit("ft", "pn", "pe"),
    "position taken for cm": in_unit("cm", "pe"),
    "psi turned": flipped("psi"),
    "ve turned": flipped("ve"),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", ERRORS)
def test_an_error_of_a_card_is_refused_with_the_line_to_change(tmp_path, what):
    columns, right = ERRORS[what]
    said_right(erring(tmp_path / "f", columns), right)


@pytest.mark.slow
def test_an_error_is_planted_as_a_card_with_it_is_read(tmp_path):
    """Of each kind; no reading of these is an outlier in one unit and not in another."""
    kinds = ("z up, y left", "roll taken for deg", "rotors swapped", "velocities swapped",
             "swash as pulse widths")  # fmt: skip
    columns = "\n".join(ERRORS[kind][0] for kind in kinds)
    read, made = read_flight(planted(tmp_path / "f", columns)), erring(tmp_path / "g", columns)
    assert read.columns == made.columns
    for expected, run in zip(read.runs, made.runs, strict=True):
        np.testing.assert_allclose(run.command, expected.command, rtol=1e-12)
        assert run.measured.keys() == expected.measured.keys()
        for channel, values in expected.measured.items():
            np.testing.assert_allclose(run.measured[channel], values, rtol=1e-12, err_msg=channel)


@pytest.mark.slow
@pytest.mark.parametrize("what", ERRORS_OF_POSITIONS)
def test_and_where_positions_are_logged(tmp_path, tmp_path_factory, what):
    columns, right = ERRORS_OF_POSITIONS[what]
    sound = with_positions(tmp_path_factory.getbasetemp() / "positions")
    said_right(erring(tmp_path / "f", columns, sound), right)


@pytest.mark.slow
def test_a_log_of_another_world_gets_all_its_lines_at_once(tmp_path):
    """Body x forward, y left, z up; yaw from the east, counted the other way round: as ROS has it."""
    turned = ("q", "r", "ay", "az", "theta")
    lines = [f"{c} = {{ sign = -1 }}" for c in turned]
    flight = erring(tmp_path / "f", "\n".join([*lines, YAW_FROM_THE_EAST]))
    found = checked(flight)
    assert found.advice is not None and not found.advice.left
    said = "\n".join(found.advice.lines)
    mended, sound = read_flight(planted(tmp_path / "g", said)), bundled().select(RUNS)
    assert checked(mended).faults == ()
    for run, expected in zip(mended.runs, sound.runs, strict=True):
        for c in turned:
            np.testing.assert_allclose(run.measured[c], expected.measured[c])
        off = run.measured["psi"] - expected.measured["psi"]
        np.testing.assert_allclose(np.cos(off[np.isfinite(off)]), 1.0, atol=1e-6)


YAW_FROM_THE_EAST = "psi = { sign = -1, offset = -1.5707963 }"


def said_right(flight: Flight, right: str) -> None:
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    with pytest.raises(InputError) as caught:
        refuse_disagreement(flown_parts(flight, vehicle), vehicle)
    message = str(caught.value)
    assert "\n" not in message
    for words in right.split("|"):
        assert words in message, message


# --- sound logs -----------------------------------------------------------------------------------


def test_the_bundled_flight_is_sound():
    found = checked(bundled())
    assert found.faults == () and found.advice is None and found.unseen == ()


@pytest.mark.needs_shared_flights
@pytest.mark.parametrize(
    "name",
    [
        "open_none",
        *(pytest.param(f"open_{w}", marks=pytest.mark.slow) for w in ("near_ground", "rigging")),
        pytest.param("open_outside", marks=pytest.mark.slow),
        pytest.param("skybotix_coax", marks=pytest.mark.slow),
        "skybotix_second",
    ],
)
def test_no_shared_flight_is_refused(name):
    assert checked(read(name)).faults == ()


FAULTS_OF_MACHINES = {
    "swash phase of half a radian": {"swash_phase": {"angle": 0.5, "per_rpm": 0.0}},
    "swash phase the other way": {"swash_phase": {"angle": -0.5, "per_rpm": 0.0}},
    "turned markers": {"frame_yaw": 0.5},
    "gyro bias": {"gyro_bias": {"x": 0.15, "y": -0.15, "z": 0.15}},
    "weak swash": {"swash_gain": -0.5},
    "slow motors and servos": {"motor_lag": {"upper": 0.3, "lower": 0.3}, "servo_lag": 0.1},
    "soft motors": {"motor_droop": {"upper": 0.84, "lower": 0.4}},
    "late poses": {"pose_delay": 0.15},
    "wind on a draggy rotor": {"wind": {"north": 3.0, "east": -3.0}, "rotor_drag": 7e-4},
    "bent sensors": {
        "imu_tilt": {"x": 0.1, "y": -0.1},
        "attitude_bias": {"x": 0.08, "y": 0.08, "z": 0.3},
    },
    "wrong torques": {"torque_balance": 0.2, "yaw_inertia": 0.6, "yaw_damping": 0.01},
}


SEEN_QUICKLY = ("bent sensors",)


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(f, marks=() if f in SEEN_QUICKLY else pytest.mark.slow)
        for f in FAULTS_OF_MACHINES
    ],
)
def test_a_fault_of_the_machine_is_none_of_the_log(tmp_path, fault):
    """Strong ones, in gusts, with positions: each is for the diagnosis to find."""
    effects = FAULTS_OF_MACHINES[fault]
    runs = ("lon_3211", "lat_3211", "yaw_3211", "forward_run")
    folder = injector.fly(
        tmp_path / "f", effects, gusts=True, sensors="pose" if "pose_delay" in effects else "full",
        runs=runs, seed=11,
    )  # fmt: skip
    assert checked(read_flight(folder)).faults == ()


# --- what is asked --------------------------------------------------------------------------------


def test_a_weak_derivative_is_the_derivative():
    """Of a cubic, whose mean derivatives over a symmetric window are known; noise is averaged."""
    t = STEP * np.arange(500)
    starts = np.array([0, 50, 120])
    middle = t[starts] + 1.0
    spread = 1.0 / 9.0  # variance of the weight (1 - s^2)^3
    np.testing.assert_allclose(
        weak(t**3, starts, 2.0, 0), middle**3 + 3 * middle * spread, atol=1e-3
    )
    np.testing.assert_allclose(weak(t**3, starts, 2.0, 1), 3 * (middle**2 + spread), rtol=2e-3)
    np.testing.assert_allclose(weak(t**3, starts, 2.0, 2), 6.0 * middle, rtol=2e-3)


def test_a_clipped_peak_is_not_known():
    """A straight line over it is below it all along; over one lost reading it is as good as any."""
    t = np.arange(0.0, 20.0, 0.01)
    r = 4.0 * np.sin(2.0 * np.pi * t)
    r[np.abs(r) > 3.3] = np.nan  # holes of 0.19 s
    r[105] = np.nan
    flight = Flight("lama400d", (Run("spin", t, np.zeros((t.size, 4)), {"r": r}),))
    rows = even_rows(flight)
    found = rows.signals["r"]
    away = np.abs(found - 4.0 * np.sin(2.0 * np.pi * STEP * np.arange(found.size)))
    assert np.isnan(r).mean() > 0.3 and away.max() > 0.5
    assert away[rows.known["r"]].max() < 0.2 and rows.known["r"][105]


@pytest.mark.slow
def test_a_column_that_was_written_in_another_unit_is_found():
    """Not by the card: the roll column itself is in degrees already divided by 57.3 once too often."""
    flight = bundled().select(RUNS)
    runs = tuple(
        replace(r, measured={c: y / 57.29578 if c == "phi" else y for c, y in r.measured.items()})
        for r in flight.runs
    )
    found = checked(replace(flight, runs=runs))
    assert found.advice is not None and found.advice.left == ()
    assert found.advice.lines == ("phi = { scale = 57.2958 }",)


def test_of_a_few_windows_no_noise_makes_a_unit():
    """In 12 s of hover a vertical velocity of 2 m/s of noise says nothing of the height: once in 40 it
    seemed to go 0.06 +- 0.03 times as far."""
    flight = bundled()
    hover = flight.run("hover")
    rows = slice(0, 1200)
    short = {c: y[rows] for c, y in hover.measured.items()}
    for seed in range(31, 40):
        noise = 2.0 * np.random.default_rng(seed).standard_normal(1200)
        noisy = replace(
            hover, t=hover.t[rows], command=hover.command[rows],
            measured=short | {"vd": short["vd"] + noise},
        )  # fmt: skip
        assert checked(replace(flight, runs=(noisy,))).faults == ()


@pytest.mark.slow
def test_of_a_few_windows_no_chance_exchanges_a_pair(tmp_path):
    """Accelerometers that felt next to nothing: two coefficients of one std had them swapped."""
    folder = injector.fly(
        tmp_path / "f", {}, gusts=False, seed=21, runs=("lon_3211", "lat_3211", "heave_3211"),
        longest=9.0, later={"cg_offset": {"x": -6e-4, "y": -1.2e-3}}, since=("lat_3211", 4.0),
    )  # fmt: skip
    assert checked(read_flight(folder)).faults == ()


@pytest.mark.slow
def test_a_check_can_be_waived(tmp_path):
    flight = read_flight(planted(tmp_path / "f", "h = { sign = -1 }"))
    vehicle = load_vehicle("lama400d").in_air(flight.air)
    assert {f.check for f in checked(flight).faults} == {"h-vd", "h-range"}
    remarks = refuse_disagreement(flight, vehicle, ("h-vd", "h-range"))
    assert [r.partition(":")[0] for r in remarks] == ["check h-vd waived", "check h-range waived"]
    card = tmp_path / "f" / "card.toml"
    card.write_text(card.read_text() + '\n[checks]\nwaive = ["h-vd"]\n')
    assert {f.check for f in checked(read_flight(tmp_path / "f")).faults} == {"h-range"}
    with pytest.raises(InputError, match=r"no check 'theta-qq' to waive: 'theta-q' is meant\?"):
        refuse_disagreement(flight, vehicle, ("theta-qq",))


@pytest.mark.slow
def test_every_fault_can_be_waived_by_its_name(tmp_path):
    known = names()
    for what in ("down accelerometer taken for g", "swash as pulse widths", "rotors swapped"):
        flight = erring(tmp_path / what, ERRORS[what][0])
        failed = tuple(f.check for f in checked(flight).faults)
        assert failed and set(failed) <= set(known)
        assert checked(flight, failed).faults == ()


@pytest.mark.slow
def test_air_of_another_planet_and_unlogged_swash_are_refused(tmp_path):
    card = copied(tmp_path / "f", "forward_run", "hover") / "card.toml"
    card.write_text(card.read_text().replace("density = 1.14", "density = 1140"))
    assert [f.check for f in checked(read_flight(tmp_path / "f")).faults] == ["density-range"]
    card.write_text(card.read_text().replace("density = 1140", "density = 1.14"))
    csv = tmp_path / "f" / "hover.csv"
    csv.write_text(csv.read_text().replace("delta_lat", "aileron_pwm", 1))
    (swash,) = checked(read_flight(tmp_path / "f")).faults
    assert swash.check == "swash-logged" and "aileron_pwm" in swash.words


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "check"),
    [
        ({"theta": -1.0}, "theta-q"), ({"delta_lon": -1.0}, "q-delta_lon"), ({"rpm": 0.1047},
        "cmd-range"),
    ],
)  # fmt: skip
def test_a_run_whose_file_is_unlike_the_others_is_named(change, check):
    """Pooled with sound runs it only weakens them; no line of the card would be right for all."""
    flight = bundled()
    odd = flight.run("lon_3211")
    speed = change.get("rpm", 1.0)
    odd = replace(
        odd,
        measured={c: change.get(c, 1.0) * y for c, y in odd.measured.items()},
        command=odd.command * [speed, speed, change.get("delta_lon", 1.0), 1.0],
    )
    runs = tuple(odd if run.name == odd.name else run for run in flight.runs)
    found = checked(replace(flight, runs=runs))
    assert any(f.check.endswith(check) and "in run lon_3211" in f.words for f in found.faults)
    assert all("correct the file of that run" in f.hint for f in found.faults)


WORDS = {"compare": ("sound", "f"), "logbook": (".",)}
"""Of scripts that take another thing than the one flight."""


@pytest.mark.parametrize("script", ["diagnose", *(
    pytest.param(s, marks=pytest.mark.slow) for s in ("identify", "replay", "compare", "logbook")
)])  # fmt: skip
def test_the_scripts_refuse_in_one_line(tmp_path, monkeypatch, script):
    """What ran for 290 s before and gave false causes; nothing is written."""
    import importlib

    planted(tmp_path / "f", "theta = { sign = -1 }")
    planted(tmp_path / "sound", "")
    module = importlib.import_module(script)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [f"{script}.py", *WORDS.get(script, ("f",)), "--out", "out"])
    with pytest.raises(InputError, match=r'theta = \{ name = "theta" \}.*--waive theta-q,vn-theta'):
        module.main()
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_waived_check_is_a_remark_of_the_comparison(tmp_path):
    flight = erring(tmp_path / "f", "h = { sign = -1 }").select(["forward_run", "climb_descend"])
    with pytest.raises(InputError, match="h-range"):
        read_two(flight, flight, None)
    for one in read_two(flight, flight, None, ["h-vd", "h-range"]):
        assert any("h-range waived" in remark for remark in one.remarks)
