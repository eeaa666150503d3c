"""What a flight folder is said to hold: planted units, signs and faults, and what is known of hover."""

import csv
import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from coax_env.consistency.agreement import agreement
from coax_env.design.loop_oscillation import Oscillation, remark
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.errors import InputError
from coax_env.estimation.state_space import Noise
from coax_env.inspection.flight_check import (
    FlightCheck,
    _next_step,
    check_flight,
    contradictions,
)
from coax_env.inspection.readings import channel_checks, sensor_faults
from coax_env.logs.columns import draft_card, guesses
from coax_env.logs.flight import Flight, read_flight, write_flight
from coax_env.model.sensors import log_suite
from coax_env.model.vehicle_file import load_vehicle
from coax_env.simulation.simulate import fly_all, log_flight

LAMA = load_vehicle("lama400d")


@cache
def flown(*names: str) -> Flight:
    """A simulated flight with the default sensors, as if logged."""
    return log_flight(LAMA, fly_all(LAMA, names, seed=3), log_suite("onboard"), noise=True, seed=3)


@cache
def checked(*names: str) -> FlightCheck:
    return check_flight(flown(*names), LAMA)


def changed(flight: Flight, **factors: float) -> Flight:
    """A flight whose channels were logged with another unit or sign."""
    runs = []
    for run in flight.runs:
        measured = {c: y * factors.get(c, 1.0) for c, y in run.measured.items()}
        speed = factors.get("rpm", 1.0)
        command = run.command * [speed, speed, 1.0, 1.0]
        runs.append(replace(run, measured=measured, command=command))
    return replace(flight, runs=tuple(runs))


@cache
def sound() -> Flight:
    """One that nothing is planted into, and of which nothing is suspected."""
    flight = flown("heading_turn", "climb_descend", "lon_3211", "lat_3211")
    assert suspicions(flight) == ""
    return flight


def suspicions(flight: Flight) -> str:
    found = contradictions(flight, agreement(flight, LAMA))
    return "; ".join([*found, *sensor_faults(channel_checks(flight))])


# --- what is there --------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_sound_flight_is_not_suspected():
    found = checked("hover", "lon_3211")
    assert found.suspicions == ()
    assert found.missing == ("pn", "pe", "v")
    assert [run.name for run in found.runs] == ["hover", "lon_3211"]
    rates = {c.channel: c.rate for c in found.channels}
    assert rates["p"] == pytest.approx(100.0, rel=0.01)
    assert rates["h"] == pytest.approx(20.0, rel=0.02)
    assert rates["vn"] == pytest.approx(10.0, rel=0.02)
    noise = {s.name: s.noise for s in log_suite("onboard")}
    for c in found.channels:
        assert c.std == pytest.approx(noise[c.channel], rel=0.25), c.channel
    json.dumps(found.as_json(), allow_nan=False)


PLANTED: dict[str, tuple[dict[str, float], tuple[str, ...]]] = {
    "rotors in rad/s": ({"rpm": math.pi / 30}, ("rpm_upper_cmd", '"rad/s"')),
    "rotors in rev/s": ({"rpm": 1 / 60}, ("rpm_lower_cmd", '"rev/s"')),
    "rotors stand": ({"rpm": 0.0}, ("rpm_upper_cmd is 0",)),
    "z up": ({"az": -1.0, "ay": -1.0}, ("ay = { sign = -1 }", "az = { sign = -1 }")),
    "acceleration in g": ({"az": 1 / 9.80665}, ("az is -1", '"g"')),
    "no gravity": ({"az": 3e-3}, ("Gravity has been taken out",)),
    "angles in degrees": ({"phi": 57.3, "theta": 57.3}, ("phi reaches", '"deg"')),
    "gyros in degrees": ({"p": 57.3, "q": 57.3, "r": 57.3}, ("q reaches", '"deg/s"')),
    "yaw gyro turned": ({"r": -1.0}, ("psi-r", "r = { sign = -1 }")),
    "height downward": ({"h": -1.0}, ("h is -", "h = { sign = -1 }")),
    "climb as velocity down": ({"vd": -1.0}, ("h-vd", "vd = { sign = -1 }")),
}


QUICK = ("z up",)


@pytest.mark.parametrize(
    "what", [w if w in QUICK else pytest.param(w, marks=pytest.mark.slow) for w in PLANTED]
)
def test_a_wrong_unit_or_sign_is_suspected(what):
    factors, words = PLANTED[what]
    found = suspicions(changed(sound(), **factors))
    for word in words:
        assert word in found, found


def test_a_frozen_and_a_saturated_sensor_are_told():
    run = flown("heave_3211").runs[0]
    still, limited = run.measured["p"].copy(), run.measured["az"].copy()
    still[300:500] = still[300]
    limited = np.clip(limited, np.nanquantile(limited, 0.05), None)
    flight = Flight(
        "lama400d", (replace(run, measured={**run.measured, "p": still, "az": limited}),)
    )
    found = suspicions(flight)
    assert "p reads one and the same value for 2.0 s" in found
    assert "az stands at its extreme value" in found
    assert "frozen" not in found.replace("p reads", "", 1).partition("frozen")[2]


# --- what can be learned --------------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_not_excited_stays_hidden():
    """At one height ground effect and a constant are confounded; a descent separates them."""
    hover = {e.effect: e for e in checked("hover").effects}
    both = {e.effect: e for e in checked("hover", "low_hover").effects}
    assert hover["ground_effect"].verdict == "hidden"
    assert both["ground_effect"].verdict == "shows" and both["ground_effect"].run == "low_hover"
    assert hover["thrust_exponent"].verdict == "hidden"
    assert hover["gyro_bias"].verdict == "shows"


def test_more_flight_tells_more(monkeypatch):
    """Information adds up: the same run twice has twice of it, where no noise level is fitted."""

    def as_given(problem: Problem, noise: Noise) -> Fit:
        off = {f.name: f.value for f in problem.parameters}
        return Fit((), {**off, **problem.model.bare_values}, noise)

    monkeypatch.setattr("coax_env.inspection.learnable.start", as_given)
    run = flown("lon_3211").runs[0]
    noise = {s.name: s.noise for s in log_suite("onboard")}
    once, again = (
        check_flight(Flight("lama400d", runs, noise=noise), LAMA)
        for runs in ((run,), (run, replace(run, name="again")))
    )
    for e in once.effects:
        other = next(o for o in again.effects if o.effect == e.effect)
        for name, std in e.std.items():
            assert std == math.inf or other.std[name] <= std * (1.0 + 1e-6), name
    for a, b in zip(once.own_numbers, again.own_numbers, strict=True):
        assert b.std_after <= a.std_after <= a.std_before * (1.0 + 1e-9)
    bias = [next(e for e in f.effects if e.effect == "gyro_bias") for f in (once, again)]
    ratio = bias[0].std["gyro_bias.x"] / bias[1].std["gyro_bias.x"]
    assert ratio == pytest.approx(math.sqrt(2.0), rel=0.02)


@pytest.mark.slow
def test_look_alikes_of_a_hover():
    """A scale error of az is a bias where nothing but gravity is felt."""
    found = {e.effect: e for e in checked("hover").effects}
    assert found["accel_scale"].verdict == "shows"
    assert "accel_bias" in found["accel_scale"].alike
    turned = {e.effect: e for e in checked("hover", "low_hover").effects}
    assert "ground_effect" not in turned["accel_bias"].alike


@pytest.mark.slow
def test_the_next_step_is_a_command():
    assert checked("hover", "lon_3211").oscillating == ()
    assert checked("hover", "lon_3211").next_step.startswith("scripts/diagnose.py FLIGHT")
    assert "scripts/check_flight.py F again" in _next_step("F", "V", True, ())
    assert "scripts/plan_flight.py --vehicle V" in _next_step("F", "V", False, ())


# --- somebody else's log --------------------------------------------------------------------------

FOREIGN = {  # channel: name there, and what its numbers are multiplied by
    "t": ("Time [ms]", 1e3), "rpm_upper_cmd": ("upper_cmd", 1.0), "rpm_lower_cmd": ("lower_cmd", 1.0),
    "p": ("gyro_x_dps", 57.29577951308232), "q": ("gyro_y_dps", 57.29577951308232),
    "r": ("gyro_z_dps", 57.29577951308232), "az": ("acc_z (g)", 1 / 9.80665),
    "phi": ("roll_deg", 57.29577951308232), "theta": ("Pitch", 1.0), "h": ("altitude_cm", 100.0),
}  # fmt: skip


def foreign(folder: Path, delimiter: str = ",") -> Flight:
    """A simulated flight written with other names and units, without a card."""
    flight = flown("lon_3211", "heave_3211")
    own = write_flight(flight, folder / "own")
    (folder / "theirs").mkdir()
    for path in own.glob("*.csv"):
        with path.open() as file:
            rows = list(csv.DictReader(file))
        with (folder / "theirs" / path.name).open("w", newline="") as file:
            writer = csv.writer(file, delimiter=delimiter)
            writer.writerow([name for name, _ in FOREIGN.values()] + ["mode"])
            for row in rows:
                cells = (row[c] and repr(float(row[c]) * k) for c, (_, k) in FOREIGN.items())
                writer.writerow([*cells, "7"])
    return read_flight(own)


@pytest.mark.slow
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_drafted_card_reads_a_foreign_log(tmp_path, delimiter):
    own = foreign(tmp_path, delimiter)
    with pytest.raises(InputError, match=r"check_flight\.py .*theirs --draft"):
        read_flight(tmp_path / "theirs")
    draft_card(tmp_path / "theirs", "lama400d")
    theirs = read_flight(tmp_path / "theirs")
    assert theirs.unread == ("mode",)
    for name in own.run_names:
        mine, other = own.run(name), theirs.run(name)
        np.testing.assert_allclose(other.t, mine.t, atol=1e-9)
        np.testing.assert_allclose(other.command[:, :2], mine.command[:, :2], rtol=1e-9)
        assert set(other.measured) == {"p", "q", "r", "az", "phi", "theta", "h"}
        for channel, values in other.measured.items():
            np.testing.assert_allclose(values, mine.measured[channel], rtol=1e-7, atol=1e-9)
    with pytest.raises(InputError, match="there already"):
        draft_card(tmp_path / "theirs", "lama400d")


def test_what_a_guess_knows_and_what_it_leaves():
    found = {g.channel: (g.name, g.unit) for g in guesses(
        ["TimeUS", "Roll (deg)", "GyrX", "wz", "accX_mss", "battery", "mode", "z", "rpm1"]
    ).values()}  # fmt: skip
    assert found == {
        "t": ("TimeUS", "us"), "phi": ("Roll (deg)", "deg"), "p": ("GyrX", "rad/s"),
        "r": ("wz", "rad/s"), "ax": ("accX_mss", "m/s2"), "rpm_upper": ("rpm1", "rev/min"),
        "battery_v": ("battery", "V"),
    }  # fmt: skip


def test_the_script_says_it_in_tables(tmp_path, monkeypatch, capsys):
    import importlib

    script = importlib.import_module("check_flight")
    folder = write_flight(flown("hover"), tmp_path / "flight")
    monkeypatch.setattr(
        "sys.argv", ["check_flight.py", str(folder), "--out", str(tmp_path / "out")]
    )
    swings = (Oscillation("yaw", 6.5, 3.7),)
    monkeypatch.setattr("coax_env.inspection.flight_check.oscillations", lambda runs: swings)
    script.main()
    said = capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "check.json").read_text())
    assert f"next: {written['next_step']}" in said
    assert {e["effect"] for e in written["effects"]} >= {"wind", "motor_lag"}
    for effect in written["effects"]:
        assert f"\n{effect['effect']} " in said and effect["verdict"] in said
    assert [remark(swings)] == written["oscillating"] and f"oscillates: {remark(swings)}" in said
    assert "not measured: pn pe v" in said
