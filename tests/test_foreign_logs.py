"""One flight in every form that other people log in: from file to a flight that agrees with the
original.

The files are written here, with their own names, units, frames and clocks, as their specifications say.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from autopilot_files import dataflash_binary, ulog
from bundled_flight import bundled

import coax_env
from coax_env.consistency.agreement import agreement
from coax_env.errors import InputError
from coax_env.logs.autopilot_logs import import_log
from coax_env.logs.card import CARD, read_card
from coax_env.logs.card_columns import COLUMN_KEYS
from coax_env.logs.columns import draft_card
from coax_env.logs.flight import Flight, Run, read_flight, write_flight
from coax_env.logs.frames import EQUATOR, attitude, place
from coax_env.logs.signals import Taken
from coax_env.logs.tables import import_table
from coax_env.model.layout import RPM_PER_RAD_S
from coax_env.model.vehicle_file import load_vehicle

DEGREE = np.pi / 180.0
PULSE = (1500.0, 2000.0)
"""Servo pulses [us]: at rest, and per radian of the plate."""

Columns = dict[str, np.ndarray]


def original() -> Run:
    return bundled().run("lat_3211")


def filled(channel: str) -> np.ndarray:
    """A channel on every row, the reading before held."""
    y = original().measured[channel]
    given = np.isfinite(y)
    at = np.maximum.accumulate(np.where(given, np.arange(y.size), int(np.argmax(given))))
    return y[at]


def commands() -> Columns:
    upper, lower, lon, lat = original().command.T
    return {"upper": upper * RPM_PER_RAD_S, "lower": lower * RPM_PER_RAD_S, "lon": lon, "lat": lat}


def quaternion(flu_to_enu: bool) -> np.ndarray:
    """(n, 4), w first: the attitude on every row."""
    a, b, c = (0.5 * filled(name) for name in ("phi", "theta", "psi"))
    w = np.cos(a) * np.cos(b) * np.cos(c) + np.sin(a) * np.sin(b) * np.sin(c)
    x = np.sin(a) * np.cos(b) * np.cos(c) - np.cos(a) * np.sin(b) * np.sin(c)
    y = np.cos(a) * np.sin(b) * np.cos(c) + np.sin(a) * np.cos(b) * np.sin(c)
    z = np.cos(a) * np.cos(b) * np.sin(c) - np.sin(a) * np.sin(b) * np.cos(c)
    ned = np.stack([w, x, y, z], axis=1)
    if not flu_to_enu:
        return ned
    # NED to ENU is half a turn about (1, 1, 0); FRD from FLU is half a turn about x
    half = np.sqrt(0.5)
    return product(product(np.array([0.0, half, half, 0.0]), ned), np.array([0.0, 1.0, 0.0, 0.0]))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    (aw, ax, ay, az), (bw, bx, by, bz) = a.T, b.T
    return np.stack(
        np.broadcast_arrays(
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        axis=-1,
    )


# --- the same flight as it was --------------------------------------------------------------------


def same(flight: Flight, channels: str, late: float = 0.011) -> None:
    """Commands and readings of the original, the rows perhaps a row apart; and it agrees with
    itself."""
    (run,) = flight.runs
    truth = original()
    t = np.arange(1.0, truth.duration - 1.0, 0.05)
    for k in range(4):
        known = np.interp(t, truth.t, truth.command[:, k])
        near = np.abs(np.diff(truth.command[:, k])).max() + 1e-6 * np.abs(known).max()
        assert (
            np.abs(np.interp(t, run.t - run.t[0], run.command[:, k]) - known).max() <= 2.1 * near
        ), k
    for channel in channels.split():
        assert channel in run.measured, channel
        y, x = run.measured[channel], truth.measured[channel]
        got, true = np.isfinite(y), np.isfinite(x)
        slow = [
            np.convolve(np.interp(t, at, values), np.full(20, 0.05), "valid")
            for at, values in (((run.t - run.t[0])[got], y[got]), (truth.t[true], x[true]))
        ]
        if channel in ("pn", "pe"):
            slow = [s - s[0] for s in slow]
        scale = float(np.std(slow[1])) + 1e-3
        assert np.abs(slow[0] - slow[1]).max() < 0.4 * scale + 0.01, channel
    vehicle = load_vehicle("lama400d")
    assert agreement(flight, vehicle).faults == ()


SENSORS = "p q r ax ay az phi theta psi h vn ve vd"


# --- text -----------------------------------------------------------------------------------------


def foreign_csv(path: Path, columns: Columns, delimiter: str = ",") -> None:
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [delimiter.join(columns), *(delimiter.join(f"{x:.9g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


def drafted(folder: Path, *lines: str) -> Flight:
    """The folder's flight by its drafted card, with these lines added as its user would."""
    if not (folder / CARD).exists():
        draft_card(folder, "lama400d")
    text = (folder / CARD).read_text()
    (folder / CARD).write_text(text.replace("[[run]]", "\n".join([*lines, "[[run]]"]), 1))
    return read_flight(folder)


def test_a_csv_with_degrees_and_milliseconds(tmp_path):
    c = commands()
    foreign_csv(tmp_path / "log.csv", {
        "timestamp_ms": 1e3 * original().t, "motor1_cmd": c["upper"], "motor2_cmd": c["lower"],
        "elevator": c["lon"], "aileron": c["lat"],
        **{f"gyro_{a}_dps": filled(n) / DEGREE for a, n in zip("xyz", "pqr", strict=True)},
        **{f"acc{a}": filled(f"a{a}") for a in "xyz"},
        "roll_deg": filled("phi") / DEGREE, "pitch_deg": filled("theta") / DEGREE,
        "yaw_deg": filled("psi") / DEGREE, "altitude_cm": 100.0 * filled("h"),
        "vel_n": filled("vn"), "vel_e": filled("ve"), "vel_d": filled("vd"), "mode": filled("h"),
    }, ";")  # fmt: skip
    flight = drafted(tmp_path)
    same(flight, SENSORS)
    assert flight.unread == ("mode",)
    assert '# CHANNEL = { name = "mode" }  # not recognised' in (tmp_path / CARD).read_text()


def test_a_csv_with_pulses_quaternions_and_places(tmp_path):
    """z up and y left, servo pulses by a calibration, latitude and longitude."""
    c = commands()
    north = np.cumsum(filled("vn")) * 0.01
    q = quaternion(flu_to_enu=False)
    foreign_csv(tmp_path / "log.csv", {
        "time": original().t, "rpm1": c["upper"], "rpm2": c["lower"],
        "ch1": PULSE[0] + PULSE[1] * c["lon"], "ch2": PULSE[0] - PULSE[1] * c["lat"],
        "p": filled("p"), "gy": -filled("q"), "gz": -filled("r"),
        "qw": q[:, 0], "qx": q[:, 1], "qy": q[:, 2], "qz": q[:, 3],
        "lat": 48.0 + north / 111_200.0, "lon": 11.0 + 0.0 * north, "h": filled("h"),
    })  # fmt: skip
    card = """[vehicle]
name = "lama400d"
[columns]
t = "time"
rpm_upper_cmd = "rpm1"
rpm_lower_cmd = "rpm2"
delta_lon = { name = "ch1", calibration = [[1000, -0.25], [2000, 0.25]] }
delta_lat = { name = "ch2", calibration = [[1000, -0.25], [2000, 0.25]], sign = -1 }
q = { name = "gy", sign = -1 }
r = { name = "gz", sign = -1 }
quaternion = { names = ["qw", "qx", "qy", "qz"], from = "body to NED" }
lat = { name = "lat" }
lon = { name = "lon" }
[[run]]
file = "log.csv"
"""
    (tmp_path / CARD).write_text(card)
    flight = read_flight(tmp_path)
    same(flight, "p q r phi theta psi h")
    pn = flight.runs[0].measured["pn"]
    assert np.nanmax(np.abs(pn - north)) < 0.01 * np.ptp(north) + 0.01
    (tmp_path / CARD).write_text(card.replace("body to NED", "body to ENU"))
    vehicle = load_vehicle("lama400d")
    assert agreement(read_flight(tmp_path), vehicle).faults


# --- MATLAB, Parquet ------------------------------------------------------------------------------


def test_matlab_structs_and_matrices(tmp_path):
    from scipy.io import savemat

    c, run = commands(), original()
    savemat(tmp_path / "log.mat", {"log": {
        "time": run.t, "gyro": np.stack([filled(x) for x in "pqr"], 1), "roll": filled("phi"),
        "pitch": filled("theta"), "heading": filled("psi"), "alt": filled("h"), "rpm_u": c["upper"],
        "rpm_l": c["lower"], "dlon": c["lon"], "dlat": c["lat"], "note": "hover",
        "gains": [1.0, 2.0, 3.0],
    }})  # fmt: skip
    guessed = import_table(tmp_path / "log.mat", "lama400d", tmp_path / "f")
    assert {g.channel for g in guessed} >= {
        "t",
        "phi",
        "theta",
        "psi",
        "h",
        "delta_lon",
        "delta_lat",
    }
    assert {g.line() for g in guessed} >= {
        f'{x} = {{ name = "gyro_{k}", unit = "rad/s" }}' for k, x in enumerate("pqr", 1)
    }
    same(drafted(tmp_path / "f"), "p q r phi theta psi h")
    (tmp_path / "bad.mat").write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    with pytest.raises(InputError, match="not a MATLAB file"):
        import_table(tmp_path / "bad.mat", "lama400d", tmp_path / "g")
    assert not (tmp_path / "g").exists()


def test_parquet_with_its_own_times(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    c = commands()
    stamps = np.datetime64("2026-05-01T10:00:00") + (1e9 * original().t).astype("timedelta64[ns]")
    columns = {
        "time": stamps, "rpm_u": c["upper"], "rpm_l": c["lower"], "dlon": c["lon"], "dlat": c["lat"],
        "roll": filled("phi"), "pitch": filled("theta"), "rollrate": filled("p"),
        "pitchrate": filled("q"),
        "yawrate": filled("r"), "pilot": ["A"] * stamps.size,
    }  # fmt: skip
    parquet.write_table(pyarrow.table(columns), tmp_path / "log.parquet")
    import_table(tmp_path / "log.parquet", "lama400d", tmp_path / "f")
    same(drafted(tmp_path / "f"), "p q r phi theta")


def test_without_pyarrow_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    (tmp_path / "log.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"needs pyarrow.*pip install 'coaxheli\[parquet\]'"):
        import_table(tmp_path / "log.parquet", "lama400d", tmp_path / "f")


# --- autopilots -----------------------------------------------------------------------------------


def test_px4(tmp_path):
    pytest.importorskip("pyulog")
    c = commands()

    def topic(*columns: np.ndarray, fields: str) -> tuple[list[str], float, np.ndarray]:
        return fields.split(), 100.0, np.stack(columns, axis=1)

    log = ulog({
        "sensor_combined": topic(
            *(filled(x) for x in ("p", "q", "r", "ax", "ay", "az")),
            fields=" ".join(
                f"{name}[{k}]" for name in ("gyro_rad", "accelerometer_m_s2") for k in range(3)
            ),
        ),
        "vehicle_attitude": topic(*quaternion(False).T, fields="q[0] q[1] q[2] q[3]"),
        "distance_sensor": topic(filled("h"), fields="current_distance"),
        "vehicle_local_position": topic(*(filled(x) for x in ("vn", "ve", "vd")), fields="vx vy vz"),
        "actuator_outputs": topic(
            0.25 * c["upper"] + 1000.0, 0.25 * c["lower"] + 1000.0,
            PULSE[0] + PULSE[1] * c["lon"], PULSE[0] + PULSE[1] * c["lat"],
            fields="output[0] output[1] output[2] output[3]",
        ),
    })  # fmt: skip
    (tmp_path / "log.ulg").write_bytes(log)
    take = [
        "rpm_upper_cmd=actuator_outputs.output[0]*4-4000",
        "rpm_lower_cmd=actuator_outputs.output[1]*4-4000",
        "delta_lon=actuator_outputs.output[2]*0.0005-0.75",
        "delta_lat=actuator_outputs.output[3]*0.0005-0.75",
    ]
    same(imported(tmp_path / "log.ulg", tmp_path / "f", take), SENSORS)


@pytest.mark.slow
def test_ardupilot(tmp_path):
    pytest.importorskip("pymavlink")
    c = commands()
    formats = {
        "IMU": "GyrX,GyrY,GyrZ,AccX,AccY,AccZ", "ATT": "Roll,Pitch,Yaw", "RFND": "Dist",
        "RCOU": "C1,C2,C3,C4",
    }  # fmt: skip
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    for k, (name, fields) in enumerate(formats.items(), 1):
        kinds = "Q" + "f" * len(fields.split(","))
        lines.append(f"FMT, {128 + k}, 40, {name}, {kinds}, TimeUS,{fields}")
    table = {
        "IMU": [filled(x) for x in ("p", "q", "r", "ax", "ay", "az")],
        "ATT": [filled(x) / DEGREE for x in ("phi", "theta", "psi")],
        "RFND": [filled("h")],
        "RCOU": [c["upper"], c["lower"], *(PULSE[0] + PULSE[1] * c[x] for x in ("lon", "lat"))],
    }
    for k, t in enumerate(original().t):
        for name, columns in table.items():
            cells = ", ".join(f"{column[k]:.8g}" for column in columns)
            lines.append(f"{name}, {round(1e6 * (t + 5.0))}, {cells}")
    (tmp_path / "log.log").write_text("\n".join(lines) + "\n")
    t = original().t
    (tmp_path / "log.bin").write_bytes(dataflash_binary({
        name: (formats[name].split(","), t, np.stack(columns, axis=1))
        for name, columns in table.items()
    }))  # fmt: skip
    take = [
        "rpm_upper_cmd=RCOU.C1", "rpm_lower_cmd=RCOU.C2",
        "delta_lon=RCOU.C3*0.0005-0.75", "delta_lat=RCOU.C4*0.0005-0.75",
    ]  # fmt: skip
    channels = "p q r ax ay az phi theta psi h"
    same(imported(tmp_path / "log.log", tmp_path / "f", take), channels)
    same(imported(tmp_path / "log.bin", tmp_path / "g", take), channels)


def test_rows_come_as_the_sensor_does_whatever_its_breaks_and_what_is_left_is_left(tmp_path):
    """An IMU at 100 Hz with ten seconds' break has rows at 100 Hz."""
    pytest.importorskip("pyulog")
    t = np.concatenate([np.arange(0.0, 8.0, 0.01), np.arange(18.0, 26.0, 0.01)])
    columns = np.stack([np.sin(t), np.cos(t), 0.1 * t, 2000.0 + t, 2100.0 + t], axis=1)
    fields = [*(f"gyro_rad[{k}]" for k in range(3)), "a", "b"]
    place = (["x", "y", "z"], t[::10], columns[::10, :3])
    log = ulog({"sensor_combined": (fields, t, columns), "vehicle_local_position": place})
    (tmp_path / "log.ulg").write_bytes(log)
    take = {
        f"rpm_{k}_cmd": Taken(f"sensor_combined.{c}") for k, c in (("upper", "a"), ("lower", "b"))
    }
    run = import_log(tmp_path / "log.ulg", "lama400d", take, leave=["pn", "h"]).runs[0]
    assert np.median(np.diff(run.t)) == pytest.approx(0.01)
    assert {"p", "q", "r", "pe"} == set(run.measured)
    with pytest.raises(InputError, match="no channel 'phi' to leave"):
        import_log(tmp_path / "log.ulg", "lama400d", take, leave=["phi"])


def test_a_log_without_swash_commands_is_no_machine_that_is_not_steered(
    tmp_path, monkeypatch, capsys
):
    """Their columns are left out, not 0: else every fault there is would be found."""
    pytest.importorskip("pyulog")
    import importlib

    c = commands()
    outputs = np.stack([0.25 * c["upper"] + 1000.0, 0.25 * c["lower"] + 1000.0], axis=1)
    gyros = np.stack([filled(x) for x in "pqr"], axis=1)
    (tmp_path / "log.ulg").write_bytes(ulog({
        "sensor_combined": ([f"gyro_rad[{k}]" for k in range(3)], 100.0, gyros),
        "actuator_outputs": (["output[0]", "output[1]"], 100.0, outputs),
    }))  # fmt: skip
    take = ["--take", "rpm_upper_cmd=actuator_outputs.output[0]*4-4000"]
    take += ["--take", "rpm_lower_cmd=actuator_outputs.output[1]*4-4000"]
    script = importlib.import_module("import_log")
    words = ["import_log.py", str(tmp_path / "log.ulg"), "--out", str(tmp_path / "f"), *take]
    monkeypatch.setattr("sys.argv", words)
    script.main()
    assert "Import it again with --take delta_lon=" in capsys.readouterr().out
    flight = read_flight(tmp_path / "f")
    assert [f.check for f in agreement(flight, load_vehicle("lama400d")).faults] == ["swash-logged"]
    with pytest.raises(InputError, match=r"import it: scripts/import_log\.py .*log\.ulg"):
        read_flight(tmp_path / "log.ulg")


def imported(log: Path, folder: Path, take: list[str]) -> Flight:
    """As scripts/import_log.py does it."""
    taken = {x.partition("=")[0]: Taken.of(x.partition("=")[2]) for x in take}
    return read_flight(write_flight(import_log(log, "lama400d", taken), folder))


# --- ROS and MCAP ---------------------------------------------------------------------------------

TAKE = [f"{c}=rotors.data[{k}]" for k, c in enumerate(
    ("rpm_upper_cmd", "rpm_lower_cmd", "delta_lon", "delta_lat")
)]  # fmt: skip


def messages(types: Any) -> list[tuple[str, str, int, Any]]:
    """Topic, type, time [ns] and message: an Imu with attitude, an Odometry, commands as an array."""
    T = types.types
    vector, q4 = T["geometry_msgs/msg/Vector3"], T["geometry_msgs/msg/Quaternion"]
    point, pose = T["geometry_msgs/msg/Point"], T["geometry_msgs/msg/Pose"]
    time, header = T["builtin_interfaces/msg/Time"], T["std_msgs/msg/Header"]
    c, q, zero = commands(), quaternion(flu_to_enu=True), np.zeros(9)
    earth = np.stack([filled("ve"), filled("vn"), -filled("vd")], axis=1)
    body = np.einsum("nji,nj->ni", matrices(q), earth)
    seq = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    found = []
    for k, t in enumerate(original().t):
        stamp = round(1e9 * (t + 100.0))
        head = header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="imu", **seq)
        turn = q4(w=q[k, 0], x=q[k, 1], y=q[k, 2], z=q[k, 3])
        imu = T["sensor_msgs/msg/Imu"](
            header=head, orientation=turn, orientation_covariance=zero,
            angular_velocity=vector(x=filled("p")[k], y=-filled("q")[k], z=-filled("r")[k]),
            angular_velocity_covariance=zero,
            linear_acceleration=vector(x=filled("ax")[k], y=-filled("ay")[k], z=-filled("az")[k]),
            linear_acceleration_covariance=zero,
        )  # fmt: skip
        twist = T["geometry_msgs/msg/Twist"](
            linear=vector(*body[k]), angular=vector(x=0.0, y=0.0, z=0.0)
        )
        odometry = T["nav_msgs/msg/Odometry"](
            header=head, child_frame_id="body",
            pose=T["geometry_msgs/msg/PoseWithCovariance"](
                pose=pose(position=point(x=0.0, y=0.0, z=filled("h")[k]), orientation=turn),
                covariance=np.zeros(36),
            ),
            twist=T["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip
        layout = T["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        array = T["std_msgs/msg/Float64MultiArray"](
            layout=layout, data=np.array([c[x][k] for x in ("upper", "lower", "lon", "lat")])
        )
        found += [("/imu", "sensor_msgs/msg/Imu", stamp, imu)]
        found += [("/rotors", "std_msgs/msg/Float64MultiArray", stamp, array)]
        if k % 5 == 0:
            found += [("/odom", "nav_msgs/msg/Odometry", stamp, odometry)]
    return found


def matrices(q: np.ndarray) -> np.ndarray:
    """(n, 3, 3) of quaternions, column by column: what they make of the axes."""
    inverse = q * [1.0, -1.0, -1.0, -1.0]
    axes = [product(product(q, np.eye(4)[k]), inverse)[:, 1:] for k in (1, 2, 3)]
    return np.stack(axes, axis=2)


@pytest.mark.parametrize(
    "kind", [*(pytest.param(k, marks=pytest.mark.slow) for k in ("ros1", "ros2")), "mcap"]
)
def test_ros(tmp_path, kind):
    """FLU and ENU, as REP 103 has them: ours come out."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    path = tmp_path / ("log.bag" if kind == "ros1" else "log")
    if kind == "ros1":
        writer: Any = Writer1(path)
    else:
        storage = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=storage)
    with writer:
        connections: dict[str, Any] = {}
        for topic, name, stamp, message in messages(types):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=types)
            serialize: Callable[..., Any] = (
                types.serialize_ros1 if kind == "ros1" else types.serialize_cdr
            )
            writer.write(connections[topic], stamp, serialize(message, name))
    if kind == "mcap":
        path = next(path.glob("*.mcap"))
    same(imported(path, tmp_path / "f", TAKE), SENSORS)


def test_mcap_with_json(tmp_path):
    """Topics of the user's own: everything is taken by name, and what it may be is told."""
    writers = pytest.importorskip("mcap.writer")
    c = commands()
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = writers.Writer(file)
        writer.start()
        schema = writer.register_schema(name="state", encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(topic="state", message_encoding="json", schema_id=schema)
        for k, t in enumerate(original().t):
            content = {
                "motors": [c["upper"][k], c["lower"][k]],
                "plate": {"lon": c["lon"][k], "lat": c["lat"][k]},
                "gyro": {a: filled(n)[k] for a, n in zip("xyz", "pqr", strict=True)},
                "roll": filled("phi")[k], "pitch": filled("theta")[k],
            }  # fmt: skip
            stamp = round(1e9 * t) + 10**18
            data = json.dumps(content).encode()
            writer.add_message(channel, log_time=stamp, data=data, publish_time=stamp)
        writer.finish()
    with pytest.raises(InputError, match=r"rpm_upper_cmd=state\.motors\[0\]"):
        import_log(tmp_path / "log.mcap", "lama400d")
    take = [
        "rpm_upper_cmd=state.motors[0]", "rpm_lower_cmd=state.motors[1]", "delta_lon=state.plate.lon",
        "delta_lat=state.plate.lat", "p=state.gyro.x", "q=state.gyro.y", "r=state.gyro.z",
        "phi=state.roll", "theta=state.pitch",
    ]  # fmt: skip
    same(imported(tmp_path / "log.mcap", tmp_path / "f", take), "p q r phi theta")


def test_a_broken_bag_is_refused_in_one_line(tmp_path):
    pytest.importorskip("rosbags")
    pytest.importorskip("mcap")
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"not a bag" * 20)
        with pytest.raises(InputError, match="not a bag that can be read") as caught:
            import_log(tmp_path / name, "lama400d")
        assert "\n" not in str(caught.value)
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"no metadata\.yaml"):
        import_log(tmp_path / "folder", "lama400d")


def test_the_readmes_card_is_read(tmp_path):
    """And every key of a column is in it."""
    text = (Path(coax_env.__file__).parent / "logs" / "README.md").read_text()
    content = text.split("```toml\n")[1].split("```")[0]
    (tmp_path / CARD).write_text(content)
    card = read_card(tmp_path / CARD)
    assert card.waived == ("q-delta_lon",) and card.columns["delta_lat"].sign == -1
    assert all(f"{key} = " in content for key in COLUMN_KEYS)
    np.testing.assert_allclose(
        card.columns["delta_lat"].read(np.array([1000.0, 1500.0, 2200.0])),
        [0.25, 0.0, -0.35],
        atol=1e-12,
    )
    np.testing.assert_allclose(card.columns["h"].read(np.array([1035.0])), [1.0])


def test_an_import_does_not_overwrite_and_says_what_next(tmp_path, monkeypatch, capsys):
    import importlib

    script = importlib.import_module("import_log")
    foreign_csv(tmp_path / "log.csv", {"time": original().t, "Roll (deg)": filled("phi") / DEGREE})
    arguments = ["import_log.py", str(tmp_path / "log.csv"), "--out", str(tmp_path / "f")]
    monkeypatch.setattr("sys.argv", arguments)
    script.main()
    said = capsys.readouterr().out
    assert 'guessed: phi = { name = "Roll (deg)", unit = "deg" }' in said
    assert f"next: scripts/check_flight.py {tmp_path / 'f'}" in said
    (tmp_path / "f" / CARD).write_text("mine")
    with pytest.raises(InputError, match="holds a flight already"):
        script.main()
    assert (tmp_path / "f" / CARD).read_text() == "mine"
    monkeypatch.setattr("sys.argv", [*arguments, "--overwrite"])
    script.main()
    assert "lama400d" in (tmp_path / "f" / CARD).read_text()


# --- frames and places ----------------------------------------------------------------------------

FRAMES = {"FRD": np.eye(3), "FLU": np.diag([1.0, -1.0, -1.0])}


@pytest.mark.parametrize(
    "frames", ["body to NED", "FLU to ENU", "ENU to FLU", "FRD to NWU", "NED to body"]
)
def test_a_quaternion_in_any_frames_is_the_same_attitude(frames):
    """Built from what it should do to vectors, at random attitudes, of any length."""
    rng = np.random.default_rng(2)
    earths = {
        "NED": np.eye(3),
        "ENU": np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]),
        "NWU": np.diag([1, -1, -1.0]),
    }
    a, _, b = frames.replace("body", "FRD").partition(" to ")
    for _ in range(20):
        phi, theta, psi = rng.uniform([-3.0, -1.4, -3.0], [3.0, 1.4, 3.0])
        c, s = np.cos([phi, theta, psi]), np.sin([phi, theta, psi])
        ours = (
            np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1.0]])
            @ np.array([[c[1], 0, s[1]], [0, 1.0, 0], [-s[1], 0, c[1]]])
            @ np.array([[1.0, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
        )
        inverse = a in earths
        body, earth = (b, a) if inverse else (a, b)
        turn = earths[earth] @ ours @ FRAMES[body].T
        if inverse:
            turn = turn.T
        q = quaternion_of(turn) * rng.uniform(0.5, 2.0)
        np.testing.assert_allclose(
            np.ravel(attitude(q[None], frames)), (phi, theta, psi), atol=1e-9
        )


def quaternion_of(turn: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return np.array([w, x, y, z])


def test_places_on_the_earth():
    """A minute of latitude is a nautical mile, and of longitude its cosine; the date line is no
    edge."""
    minute = np.radians(1.0 / 60.0)
    north, east = place(np.array([0.8 + minute]), np.array([1.0 + minute]), (0.8, 1.0))
    assert north[0] == pytest.approx(1852.0, rel=0.003)
    assert east[0] == pytest.approx(1852.0 * np.cos(0.8), rel=0.005)
    _, over = place(np.array([0.0]), np.array([-np.pi + minute]), (0.0, np.pi - minute))
    assert over[0] == pytest.approx(2.0 * minute * EQUATOR)
