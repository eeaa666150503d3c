"""From somebody's log to a finding, by the commands alone, in ten formats.

    python tests/foreign_trial.py OUT [FORMAT,FORMAT] [--coax /path/to/coax]

One flight is flown by other code (injector.py) with a swash phase hidden, written in each format as
others write them, and taken through ``coax import_log``, ``check_flight`` and ``diagnose`` in an empty
folder. What its owner types is in `FORMATS`: the options of the import, and the lines that replace
the draft's. Prints a row for each: how often it was refused on the way, what was named.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import injector
import numpy as np
from autopilot_files import dataflash_binary, ulog
from scipy.spatial.transform import Rotation

from coax_env.logs.flight import Run, read_flight
from coax_env.model.layout import RPM_PER_RAD_S

HIDDEN = {"swash_phase": {"angle": 0.35, "per_rpm": 0.0}}
RUNS = ("lon_3211", "lat_3211")
BREAK = 3.0  # s between two maneuvers, in which nothing is logged
DEGREE = np.pi / 180.0
HOME = (48.0, 11.0)
"""Latitude and longitude of the origin [deg]."""

Columns = dict[str, np.ndarray]


@cache
def flown(folder: Path) -> Run:
    """All runs as one log, with breaks."""
    injector.fly(
        folder, HIDDEN, gusts=True, sensors="onboard",
        runs=RUNS, seed=5, longest=9.0,
    )  # fmt: skip
    (folder / "truth.json").unlink()
    runs = read_flight(folder).runs
    begin, times = 0.0, []
    for run in runs:
        times.append(begin + run.t - run.t[0])
        begin = float(times[-1][-1]) + BREAK
    names = runs[0].measured
    return replace(
        runs[0],
        name="all",
        t=np.concatenate(times),
        command=np.concatenate([run.command for run in runs]),
        measured={c: np.concatenate([run.measured[c] for run in runs]) for c in names},
    )


@dataclass(frozen=True)
class Log:
    """The flight, as what writes it needs it."""

    run: Run

    @property
    def t(self) -> np.ndarray:
        """Rows' times [s]."""
        return self.run.t

    def held(self, channel: str) -> np.ndarray:
        """On every row, the reading before held."""
        y = self.run.measured[channel]
        given = np.isfinite(y)
        return y[np.maximum.accumulate(np.where(given, np.arange(y.size), int(np.argmax(given))))]

    def line(self, channel: str) -> np.ndarray:
        """On every row, by straight lines, as a resampled log has it."""
        given = np.isfinite(self.run.measured[channel])
        y = self.run.measured[channel][given]
        return np.interp(self.t, self.t[given], np.unwrap(y) if channel in ANGLES else y)

    def own(self, *channels: str) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) at which the first of them has a reading, and theirs (n, channels)."""
        given = np.isfinite(self.run.measured[channels[0]])
        return self.t[given], np.stack([self.held(c)[given] for c in channels], axis=1)

    @property
    def commands(self) -> Columns:
        """Rotor speeds [rev/min] and swash tilt [rad]."""
        upper, lower, lon, lat = self.run.command.T
        return {
            "upper": upper * RPM_PER_RAD_S,
            "lower": lower * RPM_PER_RAD_S,
            "lon": lon,
            "lat": lat,
        }

    def quaternion(self, frames: str, channels: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) and attitude (n, 4), w first: "FRD to NED", or "FLU to ENU"."""
        t, angles = self.own(*channels)
        turn = Rotation.from_euler("ZYX", angles[:, ::-1])
        if frames == "FLU to ENU":
            earth = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
            turn = earth * turn * Rotation.from_matrix(np.diag([1, -1, -1]))
        return t, turn.as_quat()[:, [3, 0, 1, 2]]


ANGLES = ("phi", "theta", "psi")
GYROS, FORCES, SPEEDS = ("p", "q", "r"), ("ax", "ay", "az"), ("vn", "ve", "vd")


# --- the formats ----------------------------------------------------------------------------------


def pulses(log: Log) -> np.ndarray:
    """Four outputs (n, 4) [us], as a mixer sends them."""
    c = log.commands
    return np.stack(
        [1000 + 0.25 * c["upper"], 1000 + 0.25 * c["lower"], 1500 + 2000 * c["lon"],
         1500 - 2000 * c["lat"]], axis=1,
    )  # fmt: skip


def px4(path: Path, log: Log) -> None:
    imu_t, imu = log.own(*GYROS, *FORCES)
    q_t, q = log.quaternion("FRD to NED", ANGLES)
    h_t, h = log.own("h")
    v_t, v = log.own(*SPEEDS)
    names = [f"{n}[{k}]" for n in ("gyro_rad", "accelerometer_m_s2") for k in range(3)]
    path.write_bytes(ulog({
        "sensor_combined": (names, imu_t, imu),
        "vehicle_attitude": ([f"q[{k}]" for k in range(4)], q_t, q),
        "distance_sensor": (["current_distance"], h_t, h),
        "vehicle_local_position": (["vx", "vy", "vz"], v_t, v),
        "actuator_outputs": ([f"output[{k}]" for k in range(4)], log.t, pulses(log)),
    }))  # fmt: skip


def ardupilot_messages(log: Log) -> dict[str, tuple[list[str], np.ndarray, np.ndarray]]:
    imu_t, imu = log.own(*GYROS, *FORCES)
    att_t, att = log.own(*ANGLES)
    h_t, h = log.own("h")
    v_t, v = log.own(*SPEEDS)
    return {
        "IMU": (["GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"], imu_t, imu),
        "ATT": (["Roll", "Pitch", "Yaw"], att_t, att / DEGREE),
        "RFND": (["Dist"], h_t, h),
        "XKF1": (["VN", "VE", "VD"], v_t, v),
        "RCOU": (["C1", "C2", "C3", "C4"], log.t, pulses(log)),
    }


def ardupilot_bin(path: Path, log: Log) -> None:
    path.write_bytes(dataflash_binary(ardupilot_messages(log)))


def ardupilot_log(path: Path, log: Log) -> None:
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    rows = []
    for kind, (name, (fields, times, values)) in enumerate(ardupilot_messages(log).items(), 129):
        lines.append(f"FMT, {kind}, 40, {name}, Q{'f' * len(fields)}, TimeUS,{','.join(fields)}")
        for t, row in zip(times, values, strict=True):
            cells = ", ".join(f"{x:.8g}" for x in row)
            rows.append((t, f"{name}, {round(1e6 * (t + 5.0))}, {cells}"))
    lines += [text for _, text in sorted(rows, key=lambda one: one[0])]
    path.write_text("\n".join(lines) + "\n")


def ros(kind: str) -> Callable[[Path, Log], None]:
    """A writer of a bag: "ros1", "ros2" (a folder with a .db3) or "mcap"."""

    def write(path: Path, log: Log) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_typestore

        types = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        pack: Any = types.serialize_ros1 if kind == "ros1" else types.serialize_cdr
        folder = path if kind != "mcap" else path.with_suffix("")
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer: Any = Writer1(path) if kind == "ros1" else Writer2(
            folder, version=9, storage_plugin=plugin
        )  # fmt: skip
        with writer:
            lines: dict[str, Any] = {}
            for topic, name, stamp, message in sorted(messages(types, log), key=lambda m: m[2]):
                if topic not in lines:
                    lines[topic] = writer.add_connection(topic, name, typestore=types)
                writer.write(lines[topic], stamp, pack(message, name))
        if kind == "mcap":
            next(folder.glob("*.mcap")).rename(path)

    return write


def messages(types: Any, log: Log) -> list[tuple[str, str, int, Any]]:
    """Topic, type, time [ns], message: Imu, pose, velocity of an Odometry, Range, outputs."""
    T = types.types
    vector, q4 = T["geometry_msgs/msg/Vector3"], T["geometry_msgs/msg/Quaternion"]
    header, time = T["std_msgs/msg/Header"], T["builtin_interfaces/msg/Time"]
    seq = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    zero = np.zeros(9)

    def head(t: float) -> tuple[int, Any]:
        stamp = round(1e9 * (t + 100.0))
        made = time(sec=stamp // 10**9, nanosec=stamp % 10**9)
        return stamp, header(stamp=made, frame_id="", **seq)

    found = []
    for t, (p, q, r, ax, ay, az) in zip(*log.own(*GYROS, *FORCES), strict=True):
        stamp, top = head(t)
        found.append(("/imu", "sensor_msgs/msg/Imu", stamp, T["sensor_msgs/msg/Imu"](
            header=top, orientation=q4(x=0.0, y=0.0, z=0.0, w=1.0), orientation_covariance=zero,
            angular_velocity=vector(x=p, y=-q, z=-r), angular_velocity_covariance=zero,
            linear_acceleration=vector(x=ax, y=-ay, z=-az), linear_acceleration_covariance=zero,
        )))  # fmt: skip
    times, turns = log.quaternion("FLU to ENU", ANGLES)
    _, earth = log.own(*SPEEDS)
    _, angles = log.own(*ANGLES)
    places = np.stack([log.line(c) for c in SPEEDS], axis=1)
    places = np.cumsum(places * np.gradient(log.t)[:, None], axis=0)
    at = np.searchsorted(log.t, times)
    speeds = np.stack(
        [np.interp(times, log.own(*SPEEDS)[0], earth[:, k]) for k in range(3)], axis=1
    )
    body = Rotation.from_euler("ZYX", angles[:, ::-1]).inv().apply(speeds) * [1.0, -1.0, -1.0]
    height = np.interp(times, *(x.ravel() for x in log.own("h")))
    Range = T["sensor_msgs/msg/Range"]
    more = {"variance": 0.0} if "variance" in Range.__dataclass_fields__ else {}
    for t, h in zip(*(x.ravel() for x in log.own("h")), strict=True):
        stamp, top = head(t)
        echo = Range(
            header=top, radiation_type=0, field_of_view=0.3, min_range=0.0, max_range=6.0, range=h,
            **more,
        )  # fmt: skip
        found.append(("/sonar", "sensor_msgs/msg/Range", stamp, echo))
    for k, t in enumerate(times):
        stamp, top = head(t)
        w, x, y, z = turns[k]
        point = T["geometry_msgs/msg/Point"](x=places[at[k], 1], y=places[at[k], 0], z=height[k])
        pose = T["geometry_msgs/msg/Pose"](position=point, orientation=q4(x=x, y=y, z=z, w=w))
        twist = T["geometry_msgs/msg/Twist"](
            linear=vector(*body[k]), angular=vector(x=0.0, y=0.0, z=0.0)
        )
        found.append(("/odom", "nav_msgs/msg/Odometry", stamp, T["nav_msgs/msg/Odometry"](
            header=top, child_frame_id="body",
            pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
            twist=T["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
        )))  # fmt: skip
    layout = T["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    for t, row in zip(log.t, np.stack(list(log.commands.values()), axis=1), strict=True):
        array = T["std_msgs/msg/Float64MultiArray"](layout=layout, data=row)
        found.append(("/rotors", "std_msgs/msg/Float64MultiArray", head(t)[0], array))
    return found


def matlab(path: Path, log: Log) -> None:
    """Resampled to one clock by straight lines, as interp1 does it."""
    from scipy.io import savemat

    c = log.commands
    savemat(path, {"log": {
        "time": log.t, "gyro": np.stack([log.line(x) for x in GYROS], 1),
        "acc": np.stack([log.line(x) for x in FORCES], 1), "roll": log.line("phi"),
        "pitch": log.line("theta"), "heading": log.line("psi"), "alt": log.line("h"),
        "vel": np.stack([log.line(x) for x in SPEEDS], 1), "rpm_u": c["upper"], "rpm_l": c["lower"],
        "dlon": c["lon"], "dlat": c["lat"], "comment": "third flight of the day",
    }})  # fmt: skip


def parquet(path: Path, log: Log) -> None:
    """Stamps of the day, empty cells between readings."""
    import pyarrow
    from pyarrow import parquet as format_

    c, y = log.commands, log.run.measured
    columns = {
        "time": np.datetime64("2026-05-01T10:00:00") + (1e9 * log.t).astype("timedelta64[ns]"),
        "rpm_u": c["upper"], "rpm_l": c["lower"], "dlon": c["lon"], "dlat": c["lat"],
        "rollrate": y["p"], "pitchrate": y["q"], "yawrate": y["r"], "accx": y["ax"], "accy": y["ay"],
        "accz": y["az"] / 9.80665, "roll": y["phi"], "pitch": y["theta"], "heading": y["psi"],
        "altitude": y["h"], "velocity_north": y["vn"], "velocity_east": y["ve"],
        "velocity_down": y["vd"], "pilot": ["A"] * log.t.size,
    }  # fmt: skip
    format_.write_table(pyarrow.table(columns), path)


def write_csv(path: Path, columns: Columns, delimiter: str = ",") -> None:
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [delimiter.join(columns), *(delimiter.join(f"{x:.10g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


def csv_flu(path: Path, log: Log) -> None:
    """Degrees, milliseconds; body x forward, y left, z up, earth east, north, up; held."""
    c = log.commands
    write_csv(path, {
        "timestamp_ms": 1e3 * log.t, "motor1_cmd": c["upper"], "motor2_cmd": c["lower"],
        "elevator": c["lon"], "aileron": c["lat"],
        "gyro_x_dps": log.held("p") / DEGREE, "gyro_y_dps": -log.held("q") / DEGREE,
        "gyro_z_dps": -log.held("r") / DEGREE, "acc_x": log.held("ax"), "acc_y": -log.held("ay"),
        "acc_z": -log.held("az"), "roll_deg": log.held("phi") / DEGREE,
        "pitch_deg": -log.held("theta") / DEGREE,
        "yaw_deg": np.degrees(np.angle(np.exp(1j * (0.5 * np.pi - log.held("psi"))))),
        "altitude": log.held("h"), "vel_east": log.held("ve"), "vel_north": log.held("vn"),
        "vel_up": -log.held("vd"), "mode": 0.0 * log.t,
    }, ";")  # fmt: skip


def csv_pulses(path: Path, log: Log) -> None:
    """Pulse widths, latitude and longitude, a quaternion."""
    us = pulses(log)
    q_t, q = log.quaternion("FRD to NED", ANGLES)
    rows = np.clip(np.searchsorted(q_t, log.t, side="right") - 1, 0, None)
    north, east = (
        np.cumsum(log.line(c) * np.gradient(np.minimum(log.t, np.inf))) for c in ("vn", "ve")
    )
    fix = np.arange(log.t.size) // 20 * 20  # five fixes a second
    write_csv(path, {
        "time": log.t, **{f"out{k + 1}": us[:, k] for k in range(4)},
        **{f"g{a}": log.held(n) for a, n in zip("xyz", GYROS, strict=True)},
        **{f"a{a}": log.held(n) for a, n in zip("xyz", FORCES, strict=True)},
        **{f"q{a}": q[rows, k] for k, a in enumerate("wxyz")},
        "lat": HOME[0] + north[fix] / 111_194.0,
        "lon": HOME[1] + east[fix] / (111_319.0 * np.cos(HOME[0] * DEGREE)),
        "range": log.held("h"),
    })  # fmt: skip


# --- what their owner types -----------------------------------------------------------------------

OF_PULSES = ("*4-4000", "*4-4000", "*0.0005-0.75", "*-0.0005+0.75")
TAKEN = ("rpm_upper_cmd", "rpm_lower_cmd", "delta_lon", "delta_lat")


def taken(form: str, scales: tuple[str, ...] = OF_PULSES, first: int = 0) -> tuple[str, ...]:
    """``--take`` of each command; form: of the signal's name."""
    names = [form.format(k + first) + s for k, s in enumerate(scales)]
    return tuple(w for c, n in zip(TAKEN, names, strict=True) for w in ("--take", f"{c}={n}"))


@dataclass(frozen=True)
class Format:
    """A log's file name, what writes it, options of the import, and lines for its card's [columns]."""

    file: str
    write: Callable[[Path, Log], None]
    options: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()


OF_ROS = (*taken("rotors.data[{}]", ("",) * 4), "--leave", "pn,pe,vn,ve,vd")
"""The odometry is an estimator's: smooth, and no reading (check_flight says so)."""

FORMATS = {
    "px4": Format("flight.ulg", px4, taken("actuator_outputs.output[{}]")),
    "ardupilot_bin": Format("flight.bin", ardupilot_bin, taken("RCOU.C{}", first=1)),
    "ardupilot_log": Format("flight.log", ardupilot_log, taken("RCOU.C{}", first=1)),
    "ros1": Format("flight.bag", ros("ros1"), OF_ROS),
    "ros2": Format("flight", ros("ros2"), OF_ROS),
    "mcap": Format("flight.mcap", ros("mcap"), OF_ROS),
    "matlab": Format("flight.mat", matlab, (), (
        *(f'{c} = {{ name = "gyro_{k}" }}' for k, c in enumerate(GYROS, 1)),
        *(f'{c} = {{ name = "acc_{k}" }}' for k, c in enumerate(FORCES, 1)),
        *(f'{c} = {{ name = "vel_{k}" }}' for k, c in enumerate(SPEEDS, 1)),
    )),
    "parquet": Format("flight.parquet", parquet, (), ('az = { name = "accz", unit = "g" }',)),
    "csv_flu": Format("flight.csv", csv_flu, (), (
        'q = { name = "gyro_y_dps", unit = "deg/s", sign = -1 }',
        'r = { name = "gyro_z_dps", unit = "deg/s", sign = -1 }',
        'ay = { name = "acc_y", sign = -1 }', 'az = { name = "acc_z", sign = -1 }',
        'theta = { name = "pitch_deg", unit = "deg", sign = -1 }',
        'psi = { name = "yaw_deg", unit = "deg", sign = -1, offset = -90 }',
        'vd = { name = "vel_up", sign = -1 }',
    )),
    "csv_pulses": Format("flight.csv", csv_pulses, (), (
        'rpm_upper_cmd = { name = "out1", calibration = [[1000, 0], [2000, 4000]] }',
        'rpm_lower_cmd = { name = "out2", calibration = [[1000, 0], [2000, 4000]] }',
        'delta_lon = { name = "out3", calibration = [[1000, -0.25], [2000, 0.25]] }',
        'delta_lat = { name = "out4", calibration = [[1000, -0.25], [2000, 0.25]], sign = -1 }',
        'quaternion = { names = ["qw", "qx", "qy", "qz"], from = "body to NED" }',
        'lat = "lat"', 'lon = "lon"',
    )),
}  # fmt: skip


# --- the way --------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("formats", nargs="?", default=",".join(FORMATS))
    parser.add_argument("--coax", default="coax", help="the command")
    parser.add_argument("--no-diagnosis", action="store_true", help="stop after check_flight")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    log = Log(flown(options.out / "truth"))
    for name in options.formats.split(","):
        print("|", " | ".join([name, *walked(name, log, options)]), "|", flush=True)


def walked(name: str, log: Log, options: argparse.Namespace) -> list[str]:
    """What was said on the way, in cells."""
    form = FORMATS[name]
    place = options.out.resolve() / name
    place.mkdir()
    form.write(place / form.file, log)

    def coax(*words: str) -> tuple[int, str]:
        done = subprocess.run(
            [*options.coax.split(), *words], cwd=place, capture_output=True, text=True, check=False
        )
        with (place / "said.txt").open("a") as file:
            file.write(f"$ coax {' '.join(words)}\n{done.stdout}{done.stderr}\n")
        return done.returncode, done.stdout + done.stderr

    code, said = coax("import_log", form.file, "--out", "f")
    first = "imported" if code == 0 else "asks for --take"
    if form.options:
        code, said = coax("import_log", form.file, "--out", "f", *form.options)
    if code:
        return [first, said.strip()]
    before = after = suspicions(coax("check_flight", "f")[1])
    if form.lines:
        edit(place / "f" / "card.toml", form.lines)
        after = suspicions(coax("check_flight", "f")[1])
    if options.no_diagnosis:
        return [first, f"{before} suspicions", f"{after} after the edits"]
    code, said = coax("diagnose", "f", "--out", "d")
    if code:
        return [first, f"{before} suspicions", said.strip()[-200:]]
    found = json.loads((place / "d" / "findings.json").read_text())
    named = "; ".join(map(in_words, found["causes"])) or "nothing"
    said = f"{before} suspicions, {after} after the edits"
    return [first, said, found["verdict"], named]


def suspicions(said: str) -> int:
    """Of check_flight; an error counts as one."""
    return said.count("SUSPICIOUS") + said.startswith("error")


def edit(card: Path, lines: tuple[str, ...]) -> None:
    """Put these lines in place of the draft's for the same channels."""
    channels = [line.split(" = ")[0] for line in lines]
    kept = [line for line in card.read_text().splitlines() if line.split(" = ")[0] not in channels]
    where = next(k for k, line in enumerate(kept) if line.startswith("[columns]")) + 1
    card.write_text("\n".join([*kept[:where], *lines, *kept[where:]]) + "\n")


def in_words(cause: dict[str, Any]) -> str:
    """A cause with its values, how far it may be believed, and what it is confounded with."""
    values = ", ".join(
        f"{n.split('.')[1]} {p['value']:.3g} +- {p['std']:.2g}"
        for n, p in cause["parameters"].items()
    )
    other = f" ({', '.join(cause['confusable_with'])})" if cause["confusable_with"] else ""
    return f"{cause['effect']}{other} {values}, {cause['trust']}"


if __name__ == "__main__":
    sys.exit(main())
