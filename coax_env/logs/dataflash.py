"""ArduPilot's logs (DataFlash, binary or text) as signals, through pymavlink."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError, require
from coax_env.logs.signals import Signal

HEAD = b"\xa3\x95"
"""With which every message of a binary log begins."""

CHANNEL_SIGNALS: dict[str, tuple[str, ...]] = {
    "p": ("IMU.GyrX",), "q": ("IMU.GyrY",), "r": ("IMU.GyrZ",),
    "ax": ("IMU.AccX",), "ay": ("IMU.AccY",), "az": ("IMU.AccZ",),
    "phi": ("ATT.Roll",), "theta": ("ATT.Pitch",), "psi": ("ATT.Yaw",),
    "h": ("RFND.Dist", "RFND.Dist1"),
    "vn": ("XKF1.VN", "NKF1.VN"), "ve": ("XKF1.VE", "NKF1.VE"), "vd": ("XKF1.VD", "NKF1.VD"),
    "pn": ("XKF1.PN", "NKF1.PN"), "pe": ("XKF1.PE", "NKF1.PE"),
    "battery_v": ("BAT.Volt", "CURR.Volt"),
    "rpm_upper": ("RPM.rpm1", "ESC.RPM"), "rpm_lower": ("RPM.rpm2", "ESC.RPM[1]"),
}  # fmt: skip
"""Channel -> signals of a log that hold it, the best first; SI and FRD, but ATT in degrees."""


def ardupilot_signals(path: Path) -> dict[str, Signal]:
    """Every numeric field of a DataFlash log as ``MSG.field``; other instances as ``MSG.field[1]``."""
    DFReader = require("pymavlink.DFReader", "logs")
    try:
        # pymavlink's own question reads a binary log as UTF-8, and fails
        binary = path.read_bytes()[: len(HEAD)] == HEAD
        reader = DFReader.DFReader_binary if binary else DFReader.DFReader_text
        log: Any = reader(str(path))
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
