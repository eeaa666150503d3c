"""PX4's logs (ULog) as signals, through pyulog."""

import io
from pathlib import Path

import numpy as np

from coax_env.errors import InputError, require
from coax_env.logs.frames import attitude
from coax_env.logs.signals import Signal

MOST_READ = 20
"""How many times the size of a log a reader may read of it, before its end counts as broken."""

CHANNEL_SIGNALS: dict[str, tuple[str, ...]] = {
    "p": ("vehicle_angular_velocity.xyz[0]", "sensor_combined.gyro_rad[0]"),
    "q": ("vehicle_angular_velocity.xyz[1]", "sensor_combined.gyro_rad[1]"),
    "r": ("vehicle_angular_velocity.xyz[2]", "sensor_combined.gyro_rad[2]"),
    "ax": ("vehicle_acceleration.xyz[0]", "sensor_combined.accelerometer_m_s2[0]"),
    "ay": ("vehicle_acceleration.xyz[1]", "sensor_combined.accelerometer_m_s2[1]"),
    "az": ("vehicle_acceleration.xyz[2]", "sensor_combined.accelerometer_m_s2[2]"),
    "phi": ("vehicle_attitude.phi",),
    "theta": ("vehicle_attitude.theta",),
    "psi": ("vehicle_attitude.psi",),
    "h": ("distance_sensor.current_distance", "vehicle_local_position.height"),
    "vn": ("vehicle_local_position.vx",),
    "ve": ("vehicle_local_position.vy",),
    "vd": ("vehicle_local_position.vz",),
    "pn": ("vehicle_local_position.x",),
    "pe": ("vehicle_local_position.y",),
    "battery_v": ("battery_status.voltage_v",),
    "rpm_upper": ("esc_status.esc[0].esc_rpm",),
    "rpm_lower": ("esc_status.esc[1].esc_rpm",),
}
"""Channel -> signals of a PX4 log that hold it, the best first; SI and FRD already."""


class _Bounded(io.BufferedReader):
    """A file that can be read MOST_READ times over: at some broken ends pyulog goes round for ever."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._left = MOST_READ * path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """As a file's."""
        data = super().read(size)
        self._left -= len(data)
        if self._left < 0:
            raise RuntimeError("its end is broken")
        return data


def px4_signals(path: Path) -> dict[str, Signal]:
    """Every numeric field of a ULog as ``topic.field``; also phi theta psi and height.

    Of topics that were logged several times, the first instance.
    """
    pyulog = require("pyulog", "logs")
    try:
        with _Bounded(path) as file:
            log = pyulog.ULog(file)
    except Exception as error:  # pyulog raises whatever it stumbles over
        raise InputError(f"{path}: not a ULog that pyulog can read ({error})") from None
    signals: dict[str, Signal] = {}
    for topic in log.data_list:
        if topic.multi_id != 0 or "timestamp" not in topic.data:
            continue
        t = np.asarray(topic.data["timestamp"], float) * 1e-6
        order = np.argsort(t, kind="stable")
        with np.errstate(invalid="ignore"):  # a damaged log may have signalling NaNs
            doubles = {
                field: np.asarray(values, float)[order]
                for field, values in topic.data.items()
                if np.issubdtype(np.asarray(values).dtype, np.number) and field != "timestamp"
            }
        for field, values in doubles.items():
            signals[f"{topic.name}.{field}"] = (t[order], values)
        if topic.name == "vehicle_attitude" and all(f"q[{k}]" in doubles for k in range(4)):
            q = np.stack([doubles[f"q[{k}]"] for k in range(4)], 1)
            angles = attitude(q, "body to NED")
            for name, angle in zip(("phi", "theta", "psi"), angles, strict=True):
                signals[f"vehicle_attitude.{name}"] = (t[order], angle)
    if "vehicle_local_position.z" in signals:  # above where the log began
        t, down = signals["vehicle_local_position.z"]
        signals["vehicle_local_position.height"] = (t, -down)
    return {name: signal for name, signal in signals.items() if len(signal[0]) > 1}
