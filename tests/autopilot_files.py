"""Autopilot logs written byte by byte from their specifications."""

import struct
from collections.abc import Mapping

import numpy as np

Topics = Mapping[str, tuple[list[str], float | np.ndarray, np.ndarray]]
"""Topic -> field names, rate [Hz] or times (n,) [s], rows (n, fields)."""


def ulog(topics: Topics) -> bytes:
    """A ULog (PX4 file format, version 1)."""

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<Hc", len(body), kind) + body

    content = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    content += message(b"B", bytes(40))
    for name, (fields, _, _) in topics.items():
        text = f"{name}:uint64_t timestamp;" + "".join(f"float {field};" for field in fields)
        content += message(b"F", text.encode())
    for k, name in enumerate(topics):
        content += message(b"A", struct.pack("<BH", 0, k) + name.encode())
    for k, (_, rate, rows) in enumerate(topics.values()):
        times = np.arange(len(rows)) / rate if isinstance(rate, float) else rate
        for t, row in zip(times, rows, strict=True):
            stamp = struct.pack("<Q", 1_000_000 + round(1e6 * t))
            content += message(
                b"D", struct.pack("<H", k) + stamp + struct.pack(f"<{len(row)}f", *row)
            )
    return content


def px4_flight(seconds: float = 6.0, share: float = 1.0) -> bytes:
    """Gyros at 250 Hz turning at 0.1 rad/s, heading 0.3, the rest slower; all rates times `share`."""
    half = 0.15
    topics: dict[str, tuple[list[str], float, list[float]]] = {
        "sensor_combined": (
            ["gyro_rad[0]", "gyro_rad[1]", "gyro_rad[2]", "accelerometer_m_s2[0]",
             "accelerometer_m_s2[1]", "accelerometer_m_s2[2]"],
            250.0, [0.0, 0.1, 0.0, 0.0, 0.0, -9.8],
        ),
        "vehicle_attitude": (
            ["q[0]", "q[1]", "q[2]", "q[3]"], 50.0, [np.cos(half), 0.0, 0.0, np.sin(half)],
        ),
        "vehicle_local_position": (
            ["x", "y", "z", "vx", "vy", "vz"], 20.0, [1.0, 2.0, -1.5, 0.1, 0.2, 0.0],
        ),
        "esc_status": (["esc[0].esc_rpm", "esc[1].esc_rpm"], 20.0, [2000.0, 2140.0]),
        "actuator_servos": (["control[0]"], 50.0, [0.5]),
    }  # fmt: skip
    return ulog({
        name: (fields, rate * share, np.tile([values], (round(seconds * rate * share), 1)))
        for name, (fields, rate, values) in topics.items()
    })  # fmt: skip


def dataflash(seconds: float = 4.0, rate: float = 100.0) -> str:
    """The text form of ArduPilot's DataFlash log: FMT lines, then messages; angles in degrees."""
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 129, 40, IMU, QBffffff, TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
        "FMT, 130, 30, ATT, Qfff, TimeUS,Roll,Pitch,Yaw",
        "FMT, 131, 30, RPM, Qff, TimeUS,rpm1,rpm2",
        "FMT, 132, 30, RFND, QBf, TimeUS,Instance,Dist",
    ]
    for k in range(round(seconds * rate)):
        stamp = 1_000_000 + round(1e6 * k / rate)
        lines.append(f"IMU, {stamp}, 0, 0.0, 0.2, 0.0, 0.1, 0.0, -9.8")
        lines.append(f"IMU, {stamp}, 1, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0")
        if k % 4 == 0:
            lines += [f"ATT, {stamp}, 1.0, -2.0, 90.0", f"RPM, {stamp}, 1990.0, 2130.0",
                      f"RFND, {stamp}, 0, 1.25"]  # fmt: skip
    return "\n".join(lines) + "\n"


def dataflash_binary(messages: Mapping[str, tuple[list[str], np.ndarray, np.ndarray]]) -> bytes:
    """The binary form of a DataFlash log, in the order of time.

    Args:
        messages: name -> fields, times (n,) [s], rows (n, fields).
    """
    head = b"\xa3\x95"

    def form(kind: int, length: int, name: str, types: str, fields: str) -> bytes:
        texts = (name.encode(), types.encode(), fields.encode())
        return head + struct.pack("<BBB4s16s64s", 128, kind, length, *texts)

    content = form(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    rows = []
    for kind, (name, (fields, times, values)) in enumerate(messages.items(), 129):
        length = 3 + 8 + 4 * len(fields)
        content += form(kind, length, name, "Q" + "f" * len(fields), ",".join(["TimeUS", *fields]))
        for t, row in zip(times, values, strict=True):
            stamp = round(1e6 * (t + 5.0))
            body = struct.pack(f"<BQ{len(row)}f", kind, stamp, *row)
            rows.append((stamp, head + body))
    return content + b"".join(row for _, row in sorted(rows, key=lambda one: one[0]))
