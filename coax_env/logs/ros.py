"""ROS bags (1 and 2) and MCAP as signals, through rosbags and mcap.

Messages of a known type follow REP 103 and 105: bodies are x forward, y left, z up, the earth is
east, north, up; what they hold is turned into ours. Whatever else is in a bag can be named
by the caller, ``topic.field``.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError, require
from coax_env.logs.frames import attitude, turned_to_earth
from coax_env.logs.signals import Signal

MOST_ELEMENTS = 32
"""Elements of an array that are read, each a signal of its own; an image has more."""
FLU = (1.0, -1.0, -1.0)
"""Signs of x, y, z from forward, left, up to ours."""

CHANNEL_SIGNALS: dict[str, tuple[str, ...]] = {
    c: (f"ros.{c}",)
    for c in ("p", "q", "r", "ax", "ay", "az", "phi", "theta", "psi", "h", "vn", "ve", "vd", "pn", "pe",
              "battery_v")
}  # fmt: skip
"""Channel -> the signal that `ros_signals` makes of messages of a known type, in our frames and
units."""

POSES = ("PoseStamped", "PoseWithCovarianceStamped", "Odometry")
KNOWN = ("Imu", "Range", "BatteryState", *POSES)
"""Types of messages that are read, those of sensors first: an odometry is an estimator's."""

Message = tuple[str, str, float, Mapping[str, Any]]
"""Topic, type, time [s], and the content by field."""


def ros_signals(path: Path) -> dict[str, Signal]:
    """Every numeric field of a bag as ``topic.field``, and ``ros.CHANNEL`` of messages of a known type.

    Args:
        path: .bag (ROS 1), a folder or .db3 (ROS 2), or .mcap with ROS 2 or JSON messages.

    Raises:
        InputError: a package is missing, or it is no such file.
    """
    read = _mcap if path.suffix.lower() == ".mcap" else _bag
    columns: dict[str, tuple[list[float], list[float]]] = {}
    kinds: dict[str, str] = {}
    try:
        for topic, kind, t, content in read(path):
            kinds[topic] = kind
            for name, value in _numbers(content):
                times, values = columns.setdefault(f"{topic.strip('/')}.{name}", ([], []))
                times.append(t)
                values.append(value)
    except InputError:
        raise
    except Exception as error:  # the readers raise whatever they stumble over
        raise InputError(f"{path}: not a bag that can be read ({error})") from None
    signals = {}
    for name, (times, values) in columns.items():
        if len(times) > 1:
            order = np.argsort(times, kind="stable")
            signals[name] = (np.array(times)[order], np.array(values)[order])
    if not signals:
        raise InputError(f"{path}: no numbers in it")
    return {**signals, **_known(signals, kinds)}


def _numbers(content: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Numbers of a message, each by its way through the fields."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            yield from _numbers(value, f"{name}.{key}" if name else str(key))
    elif isinstance(content, bool | int | float | np.number):
        yield name, float(content)
    elif isinstance(content, list | tuple | np.ndarray) and len(content) <= MOST_ELEMENTS:
        for k, value in enumerate(content):
            yield from _numbers(value, f"{name}[{k}]")


# --- files ----------------------------------------------------------------------------------------


def _bag(path: Path) -> Iterator[Message]:
    highlevel = require("rosbags.highlevel", "logs")
    typesys = require("rosbags.typesys", "logs")
    types = typesys.get_typestore(typesys.Stores.LATEST)
    with highlevel.AnyReader([path], default_typestore=types) as reader:
        for connection, stamp, raw in reader.messages():
            content = _fields(reader.deserialize(raw, connection.msgtype))
            yield connection.topic, connection.msgtype, _time(content, stamp), content


def _mcap(path: Path) -> Iterator[Message]:
    reader = require("mcap.reader", "logs")
    types = _McapTypes()
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            kind = schema.name if schema is not None else ""
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            elif channel.message_encoding == "cdr" and schema is not None:
                content = types.read(schema, message.data)
            else:
                continue
            if isinstance(content, dict):
                yield channel.topic, kind, _time(content, message.log_time), content


class _McapTypes:
    """Types of ROS 2 messages, as the schemas in the file say."""

    def __init__(self) -> None:
        self._typesys = require("rosbags.typesys", "logs")
        self._store = self._typesys.get_typestore(self._typesys.Stores.EMPTY)

    def read(self, schema: Any, data: bytes) -> dict[str, Any]:
        """A message by field."""
        name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)
        if name not in self._store.types:
            text = schema.data.decode()
            parse = (
                self._typesys.get_types_from_idl
                if schema.encoding == "ros2idl"
                else self._typesys.get_types_from_msg
            )
            found = parse(text) if schema.encoding == "ros2idl" else parse(text, name)
            self._store.register({k: v for k, v in found.items() if k not in self._store.types})
        return _fields(self._store.deserialize_cdr(data, name))


def _fields(message: Any) -> Any:
    if is_dataclass(message):
        return {f.name: _fields(getattr(message, f.name)) for f in fields(message)}
    return message


def _time(content: Mapping[str, Any], stamp: int) -> float:
    """When a message was made [s]: its header's stamp, else when it was written [ns]."""
    made = content.get("header", {})
    made = made.get("stamp", {}) if isinstance(made, Mapping) else {}
    if isinstance(made, Mapping):
        seconds = made.get("sec", made.get("secs", 0))
        parts = made.get("nanosec", made.get("nsec", made.get("nsecs", 0)))
        if seconds or parts:
            return float(seconds) + 1e-9 * float(parts)
    return 1e-9 * stamp


# --- messages of a known type ---------------------------------------------------------------------


def _known(signals: Mapping[str, Signal], kinds: Mapping[str, str]) -> dict[str, Signal]:
    """Channels of the first topic of each known type; a sensor's own before an estimator's."""
    found: dict[str, Signal] = {}
    types = {topic: kind.rpartition("/")[2] for topic, kind in kinds.items()}
    for topic in sorted(
        (t for t in types if types[t] in KNOWN), key=lambda t: (KNOWN.index(types[t]), t)
    ):
        name, last = topic.strip("/"), types[topic]
        if last == "Imu":
            new = _imu(signals, name)
        elif last in POSES:
            new = _pose(signals, name, "pose." if last == "PoseStamped" else "pose.pose.")
        elif last == "Range":
            new = {"h": signals.get(f"{name}.range")}
        else:
            new = {"battery_v": signals.get(f"{name}.voltage")}
        for channel, signal in new.items():
            if signal is not None:
                found.setdefault(f"ros.{channel}", signal)
    return found


def _imu(signals: Mapping[str, Signal], name: str) -> dict[str, Signal | None]:
    found: dict[str, Signal | None] = {}
    for field, channels in (
        ("angular_velocity", "pqr"),
        ("linear_acceleration", ("ax", "ay", "az")),
    ):
        for axis, sign, channel in zip("xyz", FLU, channels, strict=True):
            signal = signals.get(f"{name}.{field}.{axis}")
            found[channel] = signal and (signal[0], sign * signal[1])
    return found | _angles(signals, f"{name}.orientation")


def _pose(signals: Mapping[str, Signal], name: str, way: str) -> dict[str, Signal | None]:
    found = {
        channel: signals.get(f"{name}.{way}position.{axis}")
        for axis, channel in (("x", "pe"), ("y", "pn"), ("z", "h"))
    }
    found |= _angles(signals, f"{name}.{way}orientation")
    velocity = [signals.get(f"{name}.twist.twist.linear.{axis}") for axis in "xyz"]
    q = _quaternion(signals, f"{name}.{way}orientation")
    if q is not None and all(v is not None and v[0].size == q[0].size for v in velocity):
        body = np.stack([v[1] for v in velocity if v is not None], axis=1)
        for channel, values in zip(("vn", "ve", "vd"), turned_to_earth(q[1], body).T, strict=True):
            found[channel] = (q[0], values)
    return found


def _quaternion(signals: Mapping[str, Signal], name: str) -> Signal | None:
    """Times (n,) and quaternions (n, 4), w first; None where there are none, or all are unset."""
    parts = [signals.get(f"{name}.{axis}") for axis in "wxyz"]
    given = [part for part in parts if part is not None]
    if len(given) < 4 or not any(part[1].any() for part in given):
        return None
    q = np.stack([part[1] for part in given], axis=1)
    return given[0][0], q


def _angles(signals: Mapping[str, Signal], name: str) -> dict[str, Signal | None]:
    q = _quaternion(signals, name)
    if q is None or (np.abs(q[1][:, 1:]).max() == 0.0 and (q[1][:, 0] == 1.0).all()):
        return {}  # a sensor without attitude leaves it at one
    angles: Iterable[np.ndarray] = attitude(q[1], "FLU to ENU")
    return {c: (q[0], values) for c, values in zip(("phi", "theta", "psi"), angles, strict=True)}
