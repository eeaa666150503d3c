"""PX4 (ULog) and ArduPilot (DataFlash) logs as flights: columns, units and time stamps of contract.md.

Data flow::

    log -> signals, "topic.field" -> (t, values)         pyulog or pymavlink, both optional
        -> channels: the autopilot's own (PX4, ARDUPILOT) and what the caller takes from it (Taken)
        -> one row per IMU reading, thinned to at most ROWS a second -> Flight

What an autopilot does not know is how its outputs move this machine: rotor speeds and swash tilt are
named by the caller, ``rpm_upper_cmd = actuator_outputs.output[0] * 2.1 - 1800``. Rotor speeds that the
motor controllers report are found without.
"""

import io
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError, require
from coax_env.logs.flight import Flight, Run
from coax_env.logs.repairs import LONGEST_RUN, SHORTEST_RUN, hold_last
from coax_env.logs.units import ROTOR_COMMANDS, SWASH_COMMANDS
from coax_env.model.layout import CHANNELS, RPM_PER_RAD_S

ROWS = 100.0  # a second
MOST_READ = 20  # times that a reader may read each byte of a log
DEGREE = np.pi / 180.0
Signal = tuple[np.ndarray, np.ndarray]
"""Times [s] and values, both (n,)."""

COMMANDS = (*ROTOR_COMMANDS, *SWASH_COMMANDS)

PX4: dict[str, tuple[str, ...]] = {
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
    "rpm_upper": ("esc_status.esc[0].esc_rpm",),
    "rpm_lower": ("esc_status.esc[1].esc_rpm",),
}
"""Channel -> signals of a PX4 log that hold it, the best first; SI and FRD already."""

ARDUPILOT: dict[str, tuple[str, ...]] = {
    "p": ("IMU.GyrX",), "q": ("IMU.GyrY",), "r": ("IMU.GyrZ",),
    "ax": ("IMU.AccX",), "ay": ("IMU.AccY",), "az": ("IMU.AccZ",),
    "phi": ("ATT.Roll",), "theta": ("ATT.Pitch",), "psi": ("ATT.Yaw",),
    "h": ("RFND.Dist", "RFND.Dist1"),
    "vn": ("XKF1.VN", "NKF1.VN"), "ve": ("XKF1.VE", "NKF1.VE"), "vd": ("XKF1.VD", "NKF1.VD"),
    "pn": ("XKF1.PN", "NKF1.PN"), "pe": ("XKF1.PE", "NKF1.PE"),
    "rpm_upper": ("RPM.rpm1", "ESC.RPM"), "rpm_lower": ("RPM.rpm2", "ESC.RPM[1]"),
}  # fmt: skip
"""The same of a DataFlash log; angles are in degrees there."""

_NUMBER = r"\d*\.?\d+(?:[eE][-+]?\d+)?"
_TAKE = re.compile(
    r"^\s*(?P<signal>[A-Za-z0-9_.\[\]]+?)\s*(?:\*\s*(?P<scale>-?" + _NUMBER + r"))?\s*"
    r"(?P<offset>[-+]\s*" + _NUMBER + r")?\s*$"
)


@dataclass(frozen=True)
class Taken:
    """A channel from a signal: value = scale * signal + offset, in the contract's unit."""

    signal: str
    scale: float = 1.0
    offset: float = 0.0

    @classmethod
    def of(cls, text: str) -> "Taken":
        """From ``topic.field``, ``topic.field * 2.1`` or ``topic.field * 2.1 - 1800``."""
        match = _TAKE.match(text)
        if match is None:
            raise InputError(
                f"{text!r} is not of the form topic.field, * scale and + offset optional"
            )
        offset = (match["offset"] or "0").replace(" ", "")
        return cls(match["signal"], float(match["scale"] or 1.0), float(offset))


def import_log(
    path: str | Path,
    vehicle: str,
    take: Mapping[str, Taken] | None = None,
    cuts: Sequence[tuple[float, float]] = (),
) -> Flight:
    """A flight from an autopilot's log.

    Args:
        path: ``.ulg`` (PX4), or ``.bin`` or ``.log`` (ArduPilot). vehicle: shipped name or file.
        take: channel -> where it comes from, for what the autopilot cannot know or is to be read
            otherwise. cuts: begin and end of each run, seconds of the log; none: the whole log.

    Raises:
        InputError: no such log, no rotor speeds in it, or a signal or channel that does not exist.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no log at {path}")
    readers: dict[str, tuple[Callable[[Path], dict[str, Signal]], dict[str, tuple[str, ...]]]] = {
        ".ulg": (px4_signals, PX4),
        ".bin": (ardupilot_signals, ARDUPILOT),
        ".log": (ardupilot_signals, ARDUPILOT),
    }
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: a log ends in {', '.join(readers)}, found {path.suffix!r}")
    read, table = readers[path.suffix.lower()]
    with _silence():
        signals = read(path)
    channels = channels_of(signals, table, take or {}, path)
    begin = min(t[0] for t, _ in channels.values())
    channels = {name: (t - begin, values) for name, (t, values) in channels.items()}
    end = max(t[-1] for t, _ in channels.values())
    if not end < LONGEST_RUN:
        raise InputError(f"{path}: its time stamps run over {end:.3g} s, which no flight lasts")
    runs = []
    for k, (start, stop) in enumerate(cuts or [(0.0, end)], 1):
        runs.append(_run(f"run_{k}" if cuts else path.stem, channels, start, min(stop, end), path))
    return Flight(vehicle, tuple(runs))


def channels_of(
    signals: Mapping[str, Signal],
    table: Mapping[str, tuple[str, ...]],
    take: Mapping[str, Taken],
    path: Path,
) -> dict[str, Signal]:
    """Canonical channels and commands among a log's signals."""
    found: dict[str, Signal] = {}
    for channel, sources in table.items():
        source = next((s for s in sources if s in signals), None)
        if source is not None:
            t, values = signals[source]
            found[channel] = (t, values * DEGREE if source.startswith("ATT.") else values)
    for channel, taken in take.items():
        if channel not in (*CHANNELS, *COMMANDS):
            known = ", ".join([*COMMANDS, *CHANNELS])
            raise InputError(f"no channel {channel!r} to take; there are {known}")
        if taken.signal not in signals:
            near = [s for s in signals if s.split(".")[0] == taken.signal.split(".")[0]]
            other = ", ".join(sorted(near)[:12]) or ", ".join(
                sorted({s.split(".")[0] for s in signals})
            )
            raise InputError(f"{path}: no signal {taken.signal!r}; there are {other}")
        t, values = signals[taken.signal]
        found[channel] = (t, taken.scale * values + taken.offset)
    for which in ("upper", "lower"):
        if f"rpm_{which}" not in found and f"rpm_{which}_cmd" not in found:
            outputs = sorted(s for s in signals if "output[" in s or s.startswith("RCOU.C"))
            raise InputError(
                f"{path}: no speed of the {which} rotor; take it from a signal, for instance "
                f"rpm_{which}_cmd={(outputs or ['topic.field'])[0]}*2.1-1800"
            )
    if not any(c in found for c in ("p", "ax", "phi")):
        raise InputError(f"{path}: neither gyros nor accelerometers nor attitude in it")
    return found


def _run(name: str, channels: Mapping[str, Signal], start: float, stop: float, path: Path) -> Run:
    """A stretch of a log on the rows of its fastest sensor, thinned to ROWS a second.

    A row's reading is the mean of what came since the row before (angles: the last of it).
    """
    if stop - start < SHORTEST_RUN:
        raise InputError(
            f"{path}: a run from {start:g} to {stop:g} s is shorter than {SHORTEST_RUN:g} s"
        )
    clock = channels.get("p") or channels.get("ax") or channels["phi"]
    rate = (len(clock[0]) - 1) / max(clock[0][-1] - clock[0][0], 1e-9)
    step = 1.0 / min(ROWS, rate)
    t = start + step * np.arange(int((stop - start) / step) + 1)
    measured = {}
    for channel in CHANNELS:
        if channel in channels:
            column = _binned(channels[channel], t, step, last=channel in ("phi", "theta", "psi"))
            if np.isfinite(column).any():
                measured[channel] = column
    command = np.zeros((len(t), 4))
    for k, name_of in enumerate(COMMANDS):
        source = channels.get(name_of) or channels.get(name_of.removesuffix("_cmd"))
        if source is None:
            continue
        place = np.clip(np.searchsorted(source[0], t, side="right") - 1, 0, len(source[0]) - 1)
        values = source[1][place]
        if not np.isfinite(values).any():
            raise InputError(f"{path}: no number among the values of {name_of} in run {name!r}")
        command[:, k] = hold_last(values)
    command[:, :2] /= RPM_PER_RAD_S
    return Run(name, t - t[0], command, measured, "imported", f"from {path.name}")


def _binned(signal: Signal, t: np.ndarray, step: float, last: bool) -> np.ndarray:
    """Readings of a signal row by row (n,), NaN where none came."""
    times, values = signal
    good = np.isfinite(values)
    row = np.ceil((times[good] - t[0]) / step - 1e-9).astype(int)
    inside = (row >= 0) & (row < len(t))
    row, values = row[inside], values[good][inside]
    column = np.full(len(t), np.nan)
    if last:
        column[row] = values
        return column
    count = np.bincount(row, minlength=len(t))
    total = np.bincount(row, values, minlength=len(t))
    column[count > 0] = total[count > 0] / count[count > 0]
    return np.where(np.isfinite(column), column, np.nan)  # a sum of huge numbers is none


@contextmanager
def _silence() -> Iterator[None]:
    """Without what the readers, compiled parts included, say on stdout and stderr by themselves."""
    saved = [os.dup(stream) for stream in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        yield
    finally:
        for stream, own in zip((1, 2), saved, strict=True):
            os.dup2(own, stream)
            os.close(own)
        os.close(nowhere)


# --- readers ------------------------------------------------------------------------------------------


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
    ulog = require("pyulog", "logs")
    try:
        with _Bounded(path) as file:
            log = ulog.ULog(file)
    except Exception as error:  # pyulog raises whatever it stumbles over
        raise InputError(f"{path}: not a ULog that pyulog can read ({error})") from None
    signals: dict[str, Signal] = {}
    for topic in log.data_list:
        if topic.multi_id != 0 or "timestamp" not in topic.data:
            continue
        t = np.asarray(topic.data["timestamp"], float) * 1e-6
        order = np.argsort(t, kind="stable")
        for field, values in topic.data.items():
            if np.issubdtype(np.asarray(values).dtype, np.number) and field != "timestamp":
                signals[f"{topic.name}.{field}"] = (t[order], np.asarray(values, float)[order])
        if topic.name == "vehicle_attitude" and all(f"q[{k}]" in topic.data for k in range(4)):
            q = [np.asarray(topic.data[f"q[{k}]"], float)[order] for k in range(4)]
            for name, angle in zip(("phi", "theta", "psi"), euler_angles(*q), strict=True):
                signals[f"vehicle_attitude.{name}"] = (t[order], angle)
    if "vehicle_local_position.z" in signals:  # above where the log began
        t, down = signals["vehicle_local_position.z"]
        signals["vehicle_local_position.height"] = (t, -down)
    return {name: signal for name, signal in signals.items() if len(signal[0]) > 1}


def euler_angles(
    w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roll, pitch, heading (3-2-1) [rad] of the quaternion body to earth, NED."""
    phi = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    theta = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    psi = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return phi, theta, psi


def _messages(log: Any) -> dict[str, tuple[list[float], list[float]]]:
    """Times [s] and values of every field, as the messages come."""
    columns: dict[str, tuple[list[float], list[float]]] = {}
    while (message := log.recv_msg()) is not None:
        fields = message.to_dict()
        stamp = fields.get("TimeUS")
        if stamp is None:
            continue
        instance = fields.get("I", fields.get("Instance", fields.get("C", 0)))
        suffix = f"[{instance}]" if isinstance(instance, int) and instance > 0 else ""
        for field, value in fields.items():
            if isinstance(value, int | float) and field != "TimeUS":
                name = f"{fields['mavpackettype']}.{field}{suffix}"
                t, values = columns.setdefault(name, ([], []))
                t.append(1e-6 * float(stamp))
                values.append(float(value))
    return columns


def ardupilot_signals(path: Path) -> dict[str, Signal]:
    """Every numeric field of a DataFlash log as ``MSG.field``; other instances as ``MSG.field[1]``."""
    DFReader = require("pymavlink.DFReader", "logs")

    try:
        if DFReader.DFReader_is_text_log(str(path)):
            log: Any = DFReader.DFReader_text(str(path))
        else:
            log = DFReader.DFReader_binary(str(path))
        with closing(log):
            columns = _messages(log)
    except InputError:
        raise
    except Exception as error:  # pymavlink raises whatever it stumbles over
        raise InputError(f"{path}: not a DataFlash log that pymavlink can read ({error})") from None
    signals = {}
    for name, (t, values) in columns.items():
        if len(t) > 1:
            order = np.argsort(t, kind="stable")
            signals[name] = (np.array(t)[order], np.array(values)[order])
    if not signals:
        raise InputError(f"{path}: no messages in it")
    return signals
