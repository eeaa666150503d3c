"""What the columns of somebody else's log probably are: guesses, put as lines of a card's [columns].

Nothing is ever read by a guess. The reader's errors and `draft_card` show them, and whoever knows the
log keeps what is right.
"""

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from coax_env.errors import InputError
from coax_env.files import read_bytes, write_text
from coax_env.logs.card_columns import quoted
from coax_env.logs.units import LOG_UNITS, factor_to_canonical

DELIMITERS = ",;\t"
MOST_SHOWN = 12  # columns in an error message
LONGEST_NAME = 60  # characters; of a longer one this many are looked at and shown
SLOW_ROWS = 0.2  # [s] between rows; what is slower has its time in another unit

USUAL_NAMES: Mapping[str, str] = {
    "t": "t time timestamp seconds sec stamp elapsed timestart timesinceboot",
    "rpm_upper_cmd": "rpmuppercmd rpmuppercommand uppercmd uppercommand rpmucmd omegaucmd motor1cmd",
    "rpm_lower_cmd": "rpmlowercmd rpmlowercommand lowercmd lowercommand rpmlcmd omegalcmd motor2cmd",
    "rpm_upper": "rpmupper upperrpm rpmu omegau wu rotorupper upperrotor motor1 rpm1",
    "rpm_lower": "rpmlower lowerrpm rpml omegal wl rotorlower lowerrotor motor2 rpm2",
    "delta_lon": "deltalon dlon swashlon cycliclon longitudinalcyclic swashpitch elevator",
    "delta_lat": "deltalat dlat swashlat cycliclat lateralcyclic swashroll aileron",
    "battery_v": "batteryv batteryvoltage vbat vbatt battv voltage battery",
    "p": "p gyrox gyro1 gyrx gx omegax wx rollrate rollspeed angularvelocityx",
    "q": "q gyroy gyro2 gyry gy omegay wy pitchrate pitchspeed angularvelocityy",
    "r": "r gyroz gyro3 gyrz gz omegaz wz yawrate yawspeed angularvelocityz",
    "ax": "ax accelx accel1 acc1 accx accelerationx accelerometerx linearaccelerationx",
    "ay": "ay accely accel2 acc2 accy accelerationy accelerometery linearaccelerationy",
    "az": "az accelz accel3 acc3 accz accelerationz accelerometerz linearaccelerationz",
    "phi": "phi roll rollangle", "theta": "theta pitch pitchangle",
    "psi": "psi yaw heading yawangle azimuth",
    "h": "h alt altitude height sonar range agl baroalt",
    "vn": "vn vnorth velocitynorth velnorth veln", "ve": "ve veast velocityeast veleast vele",
    "vd": "vd vdown velocitydown veldown veld",
    "pn": "pn x north posnorth positionnorth posn", "pe": "pe y east poseast positioneast pose",
    "v": "v speed airspeed groundspeed",
}  # fmt: skip
"""Channel -> names it goes by, without case, blanks and punctuation."""

_SHORT_UNITS = {
    "mps": "m/s", "mps2": "m/s2", "ms2": "m/s2", "rads": "rad/s", "degs": "deg/s", "radps": "rad/s",
    "mss": "m/s2", "degps": "deg/s",
}  # fmt: skip


@dataclass(frozen=True)
class Guess:
    """A column that may be a channel. unit: the one in its name, else the channel's own."""

    channel: str
    name: str
    unit: str

    def line(self) -> str:
        """As an entry of a card's [columns]."""
        return f'{self.channel} = {{ name = {quoted(self.name)}, unit = "{self.unit}" }}'


def guesses(header: Iterable[str]) -> dict[str, Guess]:
    """Channels that the columns of a log may hold, by their names; each column and channel once."""
    found: dict[str, Guess] = {}
    for name in header:
        for channel, usual in USUAL_NAMES.items():
            unit = _unit_of(name, channel, usual.split())
            if unit and channel not in found:
                found[channel] = Guess(channel, name, unit)
                break
    return {channel: found[channel] for channel in USUAL_NAMES if channel in found}


def _unit_of(name: str, channel: str, usual: list[str]) -> str:
    """Unit in a column's name where it is one of a channel's; empty where it is not."""
    words, bracket = name[:LONGEST_NAME].strip(), ""
    if words.endswith((")", "]")):
        words, _, bracket = words[:-1].replace("[", "(").rpartition("(")
    plain = re.sub(r"[^a-z0-9]", "", words.lower())
    if plain in usual:
        return _known(bracket, channel) or LOG_UNITS[channel]
    for length in range(len(plain) - 1, 0, -1):
        if plain[:length] in usual and (unit := _known(plain[length:], channel)):
            return unit
    return ""


def _known(unit: str, channel: str) -> str:
    unit = _SHORT_UNITS.get(unit, unit)
    try:
        factor_to_canonical(channel, unit)
    except InputError:
        return ""
    return unit


def advice(header: Iterable[str], wanted: Iterable[str]) -> str:
    """What to write into the card so that wanted channels are found, after what was found instead."""
    header, wanted = list(header), list(wanted)
    shown = ", ".join(repr(name[:LONGEST_NAME]) for name in header[:MOST_SHOWN])
    more = f" and {len(header) - MOST_SHOWN} more" if len(header) > MOST_SHOWN else ""
    guessed = guesses(header)
    first = next((guessed[c] for c in wanted if c in guessed), None)
    example = first or Guess(wanted[0], "the column's name", LOG_UNITS[wanted[0]])
    return (
        f"found the columns {shown}{more}; if it has another name, put it into card.toml,"
        f" under [columns]: {example.line()}" + ("" if first else ", and likewise for the others")
    )


def time_advice(name: str, step: float) -> str:
    """What to write into the card where a log's rows come every so many "seconds"."""
    for unit in ("ms", "us", "ns"):
        if step * factor_to_canonical("t", unit) < SLOW_ROWS < step:
            line = Guess("t", name, unit).line()
            return f"if its time is in {unit}, put that into card.toml, under [columns]: {line}"
    return "does its time jump? cut the log there into two files, a [[run]] each"


def header_of(text: str) -> tuple[list[str], str]:
    """Names in the first row of a log that has any, and the character between its cells."""
    first = next((line for line in text.splitlines() if line.strip(" ,;\t\r")), "")
    delimiter = max(DELIMITERS, key=first.count)
    try:
        cells = next(csv.reader([first], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return [], delimiter
    return [cell.strip() for cell in cells], delimiter


def draft_card(folder: str | Path, vehicle: str) -> tuple[Path, list[Guess]]:
    """A first card.toml for a folder of CSVs: a run per file, and every column, guessed or
    commented out.

    Returns:
        the card, and the guesses in it, which somebody must look at.

    Raises:
        InputError: the folder has a card already, or no CSV.
    """
    folder = Path(folder)
    card = folder / "card.toml"
    if card.exists():
        raise InputError(f"{card} is there already; edit it, or move it away")
    files = sorted(p for p in folder.glob("*") if p.suffix.lower() in (".csv", ".tsv", ".txt"))
    if not files:
        raise InputError(f"no CSV in {folder}: put one in for every run, then draft its card")
    headers = {f.name: header_of(read_bytes(f).decode("utf-8-sig", "replace"))[0] for f in files}
    text, guessed = draft_text(vehicle, headers)
    write_text(card, text)
    return card, guessed


def draft_text(vehicle: str, headers: Mapping[str, Sequence[str]]) -> tuple[str, list[Guess]]:
    """A first card: a run per file, and every column found, guessed or commented out.

    Args:
        vehicle: shipped name or file.
        headers: file -> its columns.

    Returns:
        the card's text, and the guesses in it where a column is not as the channel.
    """
    names = list(dict.fromkeys(name for header in headers.values() for name in header if name))
    found = guesses(names)
    drawn = [g for g in found.values() if (g.name, g.unit) != (g.channel, _own(g))]
    taken = {g.name for g in found.values()}
    missing = [c for c in LOG_UNITS if c not in found]
    lines = ["[vehicle]", f"name = {quoted(vehicle)}", ""]
    lines += [
        "[columns]  # guessed from the names: look at every line, at the units and signs above all"
    ]
    for channel, guess in found.items():
        own = guess not in drawn
        lines.append(f"# {channel}: as it is, in {_own(guess)}" if own else guess.line())
    lines += [
        f"# CHANNEL = {{ name = {quoted(n)} }}  # not recognised" for n in names if n not in taken
    ]
    lines += [f'# {c} = {{ name = "..." }}  # not found, in {LOG_UNITS[c]}' for c in missing]
    lines += [
        "# a key each, where needed: unit, sign = -1, offset, scale, calibration = [[raw, value], ...]",
        "",
    ]
    for file in headers:
        stem = Path(file).stem
        lines += [
            "[[run]]",
            f"name = {quoted(stem)}",
            f"file = {quoted(file)}",
            'maneuver = ""',
            "",
        ]
    return "\n".join(lines), drawn


def _own(guess: Guess) -> str:
    return LOG_UNITS[guess.channel]
