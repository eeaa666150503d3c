"""Autopilot logs (autopilot_files.py) through the importers."""

import struct
from pathlib import Path

import numpy as np
import pytest
from autopilot_files import dataflash, px4_flight, ulog

from coax_env import read_flight
from coax_env.errors import InputError
from coax_env.logs.autopilot_logs import import_log
from coax_env.logs.flight import write_flight
from coax_env.logs.frames import attitude
from coax_env.logs.signals import Taken
from coax_env.model.layout import RPM_PER_RAD_S

TAKE = {"delta_lon": Taken("actuator_servos.control[0]", 0.2)}


def written(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_a_px4_log_becomes_a_flight_folder(tmp_path):
    pytest.importorskip("pyulog")
    flight = import_log(written(tmp_path / "log.ulg", px4_flight()), "lama400d", TAKE)
    again = read_flight(write_flight(flight, tmp_path / "flight"))
    (run,) = again.runs
    assert run.duration == pytest.approx(6.0, abs=0.05)
    assert np.median(np.diff(run.t)) == pytest.approx(0.01, abs=1e-6)
    expected = {"q": 0.1, "az": -9.8, "psi": 0.3, "phi": 0.0, "h": 1.5, "vn": 0.1, "pe": 2.0,
                "rpm_lower": 2140.0}  # fmt: skip
    for channel, value in expected.items():
        assert np.nanmean(run.measured[channel]) == pytest.approx(value, abs=1e-5), channel
    assert np.isfinite(run.measured["vn"]).sum() == pytest.approx(120, abs=2)
    np.testing.assert_allclose(run.command[10:-10, 2], 0.1, rtol=1e-6)
    np.testing.assert_allclose(run.command[10:-10, 0] * RPM_PER_RAD_S, 2000.0, rtol=1e-6)


def test_runs_are_cut_out_of_a_log(tmp_path):
    pytest.importorskip("pyulog")
    path = written(tmp_path / "log.ulg", px4_flight())
    flight = import_log(path, "lama400d", TAKE, [(0.5, 3.0), (3.0, 99.0)])
    assert [r.name for r in flight.runs] == ["run_1", "run_2"]
    assert flight.runs[0].duration == pytest.approx(2.5, abs=0.02)
    with pytest.raises(InputError, match="shorter"):
        import_log(path, "lama400d", TAKE, [(0.0, 1.0)])


def test_what_is_missing_is_said_in_one_line(tmp_path):
    pytest.importorskip("pyulog")
    topics = {
        "sensor_combined": (["gyro_rad[0]"], 100.0, np.zeros((500, 1))),
        "actuator_outputs": (["output[0]"], 50.0, np.ones((250, 1))),
    }
    bare = written(tmp_path / "bare.ulg", ulog(topics))
    with pytest.raises(InputError, match=r"speed of the upper rotor.*actuator_outputs.output\[0\]"):
        import_log(bare, "lama400d")
    with pytest.raises(InputError, match=r"no signal 'esc\.rpm'"):
        import_log(bare, "lama400d", {"rpm_upper": Taken("esc.rpm")})
    with pytest.raises(InputError, match="no channel 'rpm'"):
        import_log(bare, "lama400d", {"rpm": Taken("actuator_outputs.output[0]")})
    (tmp_path / "junk.ulg").write_bytes(b"not a log at all")
    with pytest.raises(InputError, match="not a ULog"):
        import_log(tmp_path / "junk.ulg", "lama400d")


def test_an_end_that_leads_back_into_the_log_is_an_end(tmp_path):
    """A last message that says to be longer than the file: pyulog steps back, and comes there again."""
    pytest.importorskip("pyulog")
    text = b"esc_status:uint64_t timestamp;"
    said, left = 3 + len(text) + 1 + 5, 5
    log = ulog({}) + struct.pack("<Hc", len(text), b"F") + text + struct.pack("<HB", said, 0)
    with pytest.raises(InputError, match="its end is broken"):
        import_log(written(tmp_path / "log.ulg", log + bytes(left)), "lama400d")


def test_a_speed_that_is_no_number_is_the_one_before(tmp_path):
    """Infinite, or too large for a number; a rotor without any number is refused."""
    pytest.importorskip("pymavlink")
    sound = dataflash()
    lines = sound.splitlines()
    speeds = [k for k, line in enumerate(lines) if line.startswith("RPM,")]
    for k in speeds[10:15]:
        lines[k] = lines[k].replace(", 2130.0", ", 1e999")
    assert "\n".join(lines).count("1e999") == 5
    (run,) = import_log(written(tmp_path / "log.log", "\n".join(lines)), "lama400d").runs
    assert run.command[:, 1] * RPM_PER_RAD_S == pytest.approx(2130.0)
    assert np.isfinite(run.measured["rpm_lower"]).mean() > 0.05
    assert not np.isinf(run.measured["rpm_lower"]).any()
    none = sound.replace(", 2130.0", ", nan")
    with pytest.raises(InputError, match="no number among the values of rpm_lower_cmd"):
        import_log(written(tmp_path / "none.log", none), "lama400d")


def test_a_log_of_another_kind_is_refused(tmp_path):
    (tmp_path / "log.csv").write_text("t\n")
    with pytest.raises(InputError, match="a log ends in"):
        import_log(tmp_path / "log.csv", "lama400d")
    with pytest.raises(InputError, match="no log at"):
        import_log(tmp_path / "none.ulg", "lama400d")


def test_an_ardupilot_log_becomes_a_flight(tmp_path):
    pytest.importorskip("pymavlink")
    path = written(tmp_path / "log.log", dataflash())
    (run,) = import_log(path, "lama400d").runs
    assert np.nanmean(run.measured["q"]) == pytest.approx(0.2)
    assert np.nanmean(run.measured["psi"]) == pytest.approx(np.pi / 2)
    assert np.nanmean(run.measured["theta"]) == pytest.approx(-2.0 * np.pi / 180.0)
    assert np.nanmean(run.measured["h"]) == pytest.approx(1.25)
    assert run.command[100, 1] * RPM_PER_RAD_S == pytest.approx(2130.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a.b[0]", Taken("a.b[0]")),
        ("a.b*2", Taken("a.b", 2.0)),
        ("a.b * -2.5e-3 - 7", Taken("a.b", -2.5e-3, -7.0)),
        ("a.b[1]*1.0-900", Taken("a.b[1]", 1.0, -900.0)),
        ("a.b + 3", Taken("a.b", 1.0, 3.0)),
    ],
)
def test_where_a_channel_comes_from_is_read(text, expected):
    assert Taken.of(text) == expected


@pytest.mark.parametrize("text", ["", "a.b *", "a.b * x", "2 * a.b", "a.b + 1 + 1"])
def test_and_refused_where_it_is_not_of_that_form(text):
    with pytest.raises(InputError, match=r"topic\.field"):
        Taken.of(text)


def test_euler_angles_of_a_quaternion():
    """Against the product of three rotations, at random attitudes."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        phi, theta, psi = rng.uniform([-3.0, -1.4, -3.0], [3.0, 1.4, 3.0])
        c, s = np.cos([phi / 2, theta / 2, psi / 2]), np.sin([phi / 2, theta / 2, psi / 2])
        q = (
            c[0] * c[1] * c[2] + s[0] * s[1] * s[2],
            s[0] * c[1] * c[2] - c[0] * s[1] * s[2],
            c[0] * s[1] * c[2] + s[0] * c[1] * s[2],
            c[0] * c[1] * s[2] - s[0] * s[1] * c[2],
        )
        found = np.ravel(attitude(np.array([q]), "body to NED"))
        np.testing.assert_allclose(found, (phi, theta, psi), atol=1e-9)
