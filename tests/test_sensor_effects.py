"""Effects of the sensors, hidden in a log by other code: what it says is changed, not what flew.

Attitudes are turned as rotation matrices, late readings interpolated in the true ones, places shifted
by rotated arms - before the noise is added, in the injector's own pipeline.
"""

from collections.abc import Callable
from pathlib import Path

import injector
import numpy as np
import pytest
from causes import say_what_was_found
from injector_sensors import NOISE, POSE, Sensors
from scipy.spatial.transform import Rotation

from coax_env import diagnose, load_vehicle
from coax_env.diagnosis.diagnose import namable
from coax_env.logs.flight import Flight, Run
from coax_env.model import effects

LAMA = load_vehicle("lama400d")
Columns = dict[str, np.ndarray]
ANGLES = ("psi", "theta", "phi")

# --- what may be named ------------------------------------------------------------------------------

POSITION = {"pose_delay", "marker_offset", "frame_yaw", "position_spring"}
SONAR = {"sonar_tilt", "sonar_scale", "sonar_delay"}


def flight_with(channels: str, turn: float = 0.0) -> Flight:
    """Two runs with these channels aboard; the second one's heading covers a turn."""
    t = np.arange(0.0, 3.0, 0.01)
    measured = {c: np.zeros(t.size) for c in channels.split()}
    turned = {c: turn * t / t[-1] if c == "psi" else x for c, x in measured.items()}
    runs = [Run(n, t, np.zeros((t.size, 4)), m) for n, m in (("a", measured), ("b", turned))]
    return Flight("lama400d", tuple(runs))


@pytest.mark.parametrize(
    ("channels", "absent"),
    [
        ("p q r phi theta psi h", POSITION),
        ("phi theta psi pn pe h", SONAR | {"attitude_delay", "magnetic_field"}),
        ("p q r phi theta psi pn pe h", SONAR),
    ],
)
def test_only_what_a_sensor_shows_may_be_named(channels, absent):
    """Of attitude and pose that come late, one; of the compass, none where cameras see the heading."""
    named = set(namable((), LAMA, flight_with(channels, turn=4.0)))
    assert set(effects.CATALOGUE) - named == absent | {"vibration"}


def test_a_compass_is_judged_where_the_heading_turns():
    for turn, may in ((0.0, False), (1.4, False), (1.8, True), (40.0, True), (-1.8, True)):
        found = namable((), LAMA, flight_with("p psi", turn))
        assert ("magnetic_field" in found) == may, turn


# --- recovered --------------------------------------------------------------------------------------

TRACKED = Sensors(NOISE | POSE, formats=dict.fromkeys(("h", "pn", "pe"), "%.5f"))
"""Table V's gyros and accelerometers, and a motion capture."""


def attitude(columns: Columns) -> Rotation:
    return Rotation.from_euler("ZYX", np.stack([columns[c] for c in ANGLES], axis=-1))


def late(columns: Columns, delay: float, channels: tuple[str, ...]) -> None:
    """Readings of a moment ago, by a spline through the true ones; before the log they stand."""
    from scipy.interpolate import CubicSpline

    t = columns["t"]
    for channel in channels:
        values = columns[channel]
        values = np.unwrap(values) if channel in ANGLES else values
        columns[channel] = CubicSpline(t, values)(np.maximum(t - delay, t[0]))


def turned_frame(columns: Columns) -> None:
    seen = attitude(columns) * Rotation.from_euler("z", 0.15)
    for channel, values in zip(ANGLES, seen.as_euler("ZYX").T, strict=True):
        columns[channel] = values


def shifted_markers(columns: Columns) -> None:
    north, east, down = attitude(columns).apply([0.04, -0.03, -0.06]).T
    columns["pn"] = columns["pn"] + north
    columns["pe"] = columns["pe"] + east
    columns["h"] = columns["h"] - down
    for channel, place, sign in (("vn", "pn", 1.0), ("ve", "pe", 1.0), ("vd", "h", -1.0)):
        columns[channel] = sign * np.gradient(columns[place], columns["t"])


def iron(columns: Columns) -> None:
    """A compass between magnets: the field that it sees, level, and the heading of that."""
    psi = columns["psi"]
    ahead, right = np.cos(psi) + 0.08, -np.sin(psi) - 0.06
    columns["psi"] = np.arctan2(-right, ahead)


def stretched_gyro(columns: Columns) -> None:
    for channel, scale in (("p", 1.06), ("q", 0.95), ("r", 1.08)):
        columns[channel] = scale * columns[channel]


EDITS: dict[str, tuple[str, Callable[[Columns], None], dict[str, float], set[str]]] = {
    "late attitude": (
        "full", lambda c: late(c, 0.03, ANGLES), {"attitude_delay.time": 0.03}, set(),
    ),
    "gyro scale": (
        "full", stretched_gyro, {"gyro_scale.x": 0.06, "gyro_scale.y": -0.05, "gyro_scale.z": 0.08},
        set(),
    ),
    "compass": (
        "full", iron, {"magnetic_field.x": 0.08, "magnetic_field.y": -0.06}, set(),
    ),
    "late pose": (
        "pose", lambda c: late(c, 0.04, (*ANGLES, "pn", "pe", "h")), {"pose_delay.time": 0.04},
        {"command_delay"},
    ),
    "markers' axes, gyros aboard": (
        "tracked", turned_frame, {"frame_yaw.angle": 0.15}, set(),
    ),
    "markers' axes": ("pose", turned_frame, {"frame_yaw.angle": 0.15}, {"swash_phase"}),
    "markers beside the centre of gravity": (
        "pose", shifted_markers,
        {"marker_offset.x": 0.04, "marker_offset.y": -0.03, "marker_offset.z": -0.06}, set(),
    ),
}  # fmt: skip
"""Sensors, what is done to the log, the truth, and effects that say the same of such a log."""
RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211", "heading_turn")


def edited(folder: Path, sensors: str, edit: Callable[[Columns], None], monkeypatch) -> Path:
    """A flight whose true readings are edited before the sensors add their noise."""
    read = injector._read

    def changed(columns, *rest):
        edit(columns)
        return read(columns, *rest)

    monkeypatch.setitem(injector.SENSORS, "tracked", TRACKED)
    monkeypatch.setattr(injector, "_read", changed)
    return injector.fly(folder, {}, sensors=sensors, runs=RUNS, seed=21)


@pytest.mark.slow
@pytest.mark.parametrize("case", EDITS)
def test_what_a_log_says_wrongly_is_named(tmp_path, monkeypatch, case):
    """Found by its name, or by another that says the same of such a log; nothing beside it."""
    sensors, edit, truth, same = EDITS[case]
    folder = edited(tmp_path / "f", sensors, edit, monkeypatch)
    (folder / "truth.json").unlink()
    findings = diagnose(folder, hold_out=[]).findings
    found = say_what_was_found(findings)
    name = next(iter(truth)).partition(".")[0]
    (cause,) = findings["causes"]
    if cause["effect"] != name:
        assert cause["effect"] in same and name in cause["confusable_with"], found
        return
    assert same <= set(cause["confusable_with"]) | (same - set(effects.CATALOGUE)), found
    for full, value in truth.items():
        reported = cause["parameters"][full]
        assert abs(reported["value"] - value) < 3.0 * reported["std"] + 0.02 * abs(value), found
        assert reported["std"] < 0.1 * max(map(abs, truth.values())), found
