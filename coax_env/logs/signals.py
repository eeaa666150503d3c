"""Signals of an autopilot's log, ``topic.field``, as the channels of a flight.

What an autopilot does not know is how its outputs move this machine: rotor speeds and swash tilt are
named by the caller, ``rpm_upper_cmd = actuator_outputs.output[0] * 2.1 - 1800``. Rotor speeds that the
motor controllers report are found without.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coax_env.errors import InputError
from coax_env.logs.columns import Guess, guesses
from coax_env.logs.units import BATTERY, ROTOR_COMMANDS, SWASH_COMMANDS
from coax_env.model.layout import CHANNELS

Signal = tuple[np.ndarray, np.ndarray]
"""Times [s] and values, both (n,)."""

COMMANDS = (*ROTOR_COMMANDS, *SWASH_COMMANDS)
MOST_NAMED = 12
DEGREE = np.pi / 180.0

_NUMBER = r"\d*\.?\d+(?:[eE][-+]?\d+)?"
_TAKE = re.compile(
    r"^\s*(?P<signal>[A-Za-z0-9_.\[\]]+?)\s*(?:\*\s*(?P<scale>-?" + _NUMBER + r"))?\s*"
    r"(?P<offset>[-+]\s*" + _NUMBER + r")?\s*$"
)


@dataclass(frozen=True)
class Taken:
    """A channel from a signal: value = scale * signal + offset, in the channel's unit."""

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


def channels_of(
    signals: Mapping[str, Signal],
    table: Mapping[str, tuple[str, ...]],
    take: Mapping[str, Taken],
    path: Path,
) -> dict[str, Signal]:
    """Canonical channels and commands among a log's signals.

    Args:
        signals: ``topic.field`` -> its readings, in the autopilot's units.
        table: channel -> signals that hold it, the best first; angles of ``ATT`` are in degrees.
        take: channel or command -> the signal it comes from, which wins over the table.
        path: of the log, for messages.

    Raises:
        InputError: no rotor speed and no other sensor, or a signal or channel that does not exist.
    """
    found: dict[str, Signal] = {}
    for channel, sources in table.items():
        source = next((s for s in sources if s in signals), None)
        if source is not None:
            t, values = signals[source]
            found[channel] = (t, values * DEGREE if source.startswith("ATT.") else values)
    for channel, taken in take.items():
        _check_taken(channel, taken, signals, path)
        t, values = signals[taken.signal]
        found[channel] = (t, taken.scale * values + taken.offset)
    for which in ("upper", "lower"):
        if f"rpm_{which}" not in found and f"rpm_{which}_cmd" not in found:
            outputs = sorted(s for s in signals if _may_be_output(s))
            raise InputError(
                f"{path}: no speed of the {which} rotor; take it from a signal, for instance "
                f"--take rpm_{which}_cmd={(outputs or ['topic.field'])[0]}*2.1-1800; signals are"
                f" {', '.join(sorted(outputs or signals)[:MOST_NAMED])}"
            )
    if not any(c in found for c in ("p", "ax", "phi")):
        raise InputError(f"{path}: neither gyros nor accelerometers nor attitude in it")
    return found


def untaken(signals: Mapping[str, Signal], taken: Collection[str]) -> list[Guess]:
    """Signals that a missing channel may be in, by the name of their field; nothing is read by a
    guess."""
    last: dict[str, list[str]] = {}
    for name in signals:
        last.setdefault(name.rpartition(".")[2], []).append(name)
    found = guesses(field for field, names in last.items() if len(names) == 1)
    return [
        Guess(channel, last[guess.name][0], guess.unit)
        for channel, guess in found.items()
        if channel not in taken and channel != "t"
    ]


def _may_be_output(signal: str) -> bool:
    words = ("output[", "motor", "servo", "actuator", "rpm", "rotor", "esc")
    return signal.startswith("RCOU.C") or any(word in signal.lower() for word in words)


def _check_taken(channel: str, taken: Taken, signals: Mapping[str, Signal], path: Path) -> None:
    """Refuse a channel that no flight has, or a signal that this log has not."""
    if channel not in (*CHANNELS, *COMMANDS, BATTERY):
        known = ", ".join([*COMMANDS, *CHANNELS, BATTERY])
        raise InputError(f"no channel {channel!r} to take; there are {known}")
    if taken.signal not in signals:
        topic = taken.signal.split(".")[0]
        near = sorted(s for s in signals if s.split(".")[0] == topic)[:12]
        topics = sorted({s.split(".")[0] for s in signals})
        raise InputError(
            f"{path}: no signal {taken.signal!r}; there are {', '.join(near or topics)}"
        )
