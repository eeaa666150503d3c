"""Effects of sensors and body that the injector hides in other form: found, and nothing beside them."""

import injector
import numpy as np
import pytest
from causes import check_causes, say_what_was_found, truth_of
from injector_sensors import NOISE, POSE, Sensors

from coax_env import diagnose, load_vehicle
from coax_env.diagnosis.preparation import namable
from coax_env.logs.flight import Flight, Run
from coax_env.model import effects

LAMA = load_vehicle("lama400d")

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
        ("phi theta psi pn pe h", SONAR | {"magnetic_field"}),
        ("p q r phi theta psi pn pe h", SONAR),
    ],
)
def test_only_what_a_sensor_shows_may_be_named(channels, absent):
    """Of attitude and pose that come late, one; of the compass, none where cameras see the heading."""
    named = set(namable((), LAMA, flight_with(channels, turn=4.0)))
    assert set(effects.CATALOGUE) - named == absent | {
        "vibration",
        "servo_deadband",
        "battery_voltage",
    }


def test_a_compass_is_judged_where_the_heading_turns():
    for turn, may in ((0.0, False), (1.4, False), (1.8, True), (40.0, True), (-1.8, True)):
        found = namable((), LAMA, flight_with("p psi", turn))
        assert ("magnetic_field" in found) == may, turn


def test_headings_on_both_sides_of_north_are_not_a_turn():
    """The quarter turn is that of all runs together, wherever around the circle they lie."""
    t = np.arange(0.0, 3.0, 0.01)

    def may(*spans: tuple[float, float]) -> bool:
        runs = tuple(
            Run(
                f"r{k}", t, np.zeros((t.size, 4)), {"p": 0.0 * t, "psi": np.linspace(*span, t.size)}
            )
            for k, span in enumerate(spans)
        )
        return "magnetic_field" in namable((), LAMA, Flight("lama400d", runs))

    assert not may((-0.7, 0.7)) and may((-0.8, 0.8))
    assert not may((6.0, 6.5), (-0.2, 1.1)) and may((6.0, 6.5), (-0.2, 1.4))
    assert not may((3.0, 3.5)) and may((3.0, 3.5), (0.0, 0.1))
    nan = {"p": 0.0 * t, "psi": np.full(t.size, np.nan)}
    blind = Flight("lama400d", (Run("r", t, np.zeros((t.size, 4)), nan),))
    assert "magnetic_field" not in namable((), LAMA, blind)


# --- recovered --------------------------------------------------------------------------------------

TRACKED = Sensors(NOISE | POSE, formats=dict.fromkeys(("h", "pn", "pe"), "%.5f"))
"""Table V's gyros and accelerometers, and a motion capture."""
SLOW = TRACKED._replace(every_row=(4,))
"""The same at 25 Hz: of four commands one is logged."""
ON_AXES = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211", "heading_turn")
SWASH_AND_YAW = ("lon_3211", "lat_3211", "yaw_3211")
FAST = ("lon_3211", "lat_3211", "forward_run", "side_run", "heading_turn", "yaw_3211")

SHORT = 9.0  # s of each run, where that shows the effect
HIDDEN = {
    "late attitude": ({"attitude_delay": {}}, "full", SWASH_AND_YAW, SHORT),
    "gyro scale and compass": ({"gyro_scale": {}, "magnetic_field": {}}, "full", ON_AXES, SHORT),
    "markers' axes, gyros aboard": (
        {"frame_yaw": {}}, "tracked", ("lon_3211", "lat_3211", "heading_turn"), SHORT
    ),
    "markers' axes at 25 Hz": ({"frame_yaw": -0.1}, "slow", ON_AXES, SHORT),
    "markers beside the centre of gravity": ({"marker_offset": {}}, "pose", SWASH_AND_YAW, SHORT),
    "tether": ({"position_spring": {}}, "tracked", ("forward_run", "side_run"), 16.0),
    "upper blow-back": (
        {"upper_blowback": {}}, "full", ("forward_run", "side_run", "yaw_3211"), SHORT
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("channels", "seen"), [("p q vn ve h", False), ("r vn", True), ("psi", True), ("p q psi", True)]
)
def test_what_only_turns_the_heading_is_asked_where_that_is_read(channels, seen):
    """Or its rate; velocities alone show where gusts have turned it."""
    yaw = {"torque_balance", "yaw_inertia", "yaw_damping", "spin_up_reaction"}
    found = yaw & set(namable((), LAMA, flight_with(channels, turn=4.0)))
    assert found == (yaw if seen else set())


@pytest.mark.slow
@pytest.mark.parametrize("case", HIDDEN)
def test_a_sensor_or_body_effect_is_named_alone(tmp_path, monkeypatch, case):
    hidden, sensors, runs, longest = HIDDEN[case]
    monkeypatch.setitem(injector.SENSORS, "tracked", TRACKED)
    monkeypatch.setitem(injector.SENSORS, "slow", SLOW)
    folder = injector.fly(
        tmp_path / "f", hidden, sensors=sensors, runs=runs, longest=longest, seed=21
    )
    truth = truth_of(folder)
    (folder / "truth.json").unlink()
    check_causes(diagnose(folder, hold_out=[]).findings, *truth)


@pytest.mark.slow
def test_the_bodys_own_gyroscopic_moment_misleads_nobody(tmp_path):
    """Every real body has it; flown gently it does not show, and no other effect is blamed."""
    hidden = {"gyroscopic_coupling": {}}
    folder = injector.fly(tmp_path / "f", hidden, runs=FAST, longest=SHORT, seed=21)
    (folder / "truth.json").unlink()
    assert diagnose(folder, hold_out=[]).findings["verdict"] == "consistent"


@pytest.mark.slow
def test_turned_markers_are_named_or_among_the_alternatives(tmp_path):
    """A pose alone hardly tells turned markers from a turned swash plate, and then says so."""
    folder = injector.fly(
        tmp_path / "f",
        {"frame_yaw": {}},
        sensors="pose",
        runs=SWASH_AND_YAW,
        longest=SHORT,
        seed=22,
    )
    (folder / "truth.json").unlink()
    findings = diagnose(folder, hold_out=[]).findings
    (cause,) = findings["causes"]
    if cause["effect"] != "frame_yaw":
        assert "frame_yaw" in cause["confusable_with"], say_what_was_found(findings)
        assert cause["trust"] == "doubtful"
    angle = cause["parameters"][f"{cause['effect']}.angle"]
    assert abs(angle["value"] - 0.15) < 3.0 * angle["std"] + 0.005
