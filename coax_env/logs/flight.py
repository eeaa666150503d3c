"""A flight: a folder with a test card (``card.toml``) and one CSV log per run.

A CSV has a row of names, then a row per time stamp; comma, semicolon or tab between cells, an empty
cell where there is no new reading (an empty command holds the last one). Only ``t``, both rotor speeds
- commanded or measured - and both swash commands are needed; of the rest any subset:

    ============================ ======= =============================================================
    column                       unit    what it is
    ============================ ======= =============================================================
    t                            s       time, from any beginning, never backwards
    rpm_upper_cmd, rpm_lower_cmd rev/min commanded rotor speeds
    rpm_upper, rpm_lower         rev/min measured rotor speeds
    delta_lon                    rad     swash tilt: > 0 tilts the thrust back, nose up
    delta_lat                    rad     swash tilt: > 0 tilts the thrust to the right, right side down
    battery_v                    V       battery voltage
    p, q, r                      rad/s   gyros: body x forward, y right, z down
    ax, ay, az                   m/s2    accelerometers, specific force: az = -g in hover
    phi, theta, psi              rad     roll to the right, nose up, heading from north over east
    h                            m       height of the centre of gravity above ground, up
    vn, ve, vd                   m/s     velocity north, east, down
    pn, pe                       m       position north, east
    v                            m/s     speed, unsigned
    ============================ ======= =============================================================

The card says the vehicle, the runs, and how the columns differ from that. One with every key; only
``[vehicle]`` and the runs' files are needed::

    date = "2026-05-01"               # optional: the order of a logbook
    synthetic = true                  # optional: a simulator flew it, and reports say so

    [vehicle]
    name = "lama400d"                 # shipped, or the path of a vehicle file

    [air]                             # optional, in place of the vehicle file's
    density = 1.14
    gravity = 9.804

    [noise]                           # optional: std of a sensor, in the channel's unit; else estimated
    p = 0.03

    [columns]                         # channel = where it is, and what makes its numbers ours
    t = { name = "time_ms", unit = "ms" }
    rpm_upper_cmd = { name = "esc1", calibration = [[1100, 0], [1500, 1450], [1900, 2900]] }
    rpm_lower_cmd = { name = "esc2", calibration = [[1100, 0], [1500, 1450], [1900, 2900]] }
    delta_lon = { name = "servo1", calibration = [[1000, -0.25], [2000, 0.25]] }
    delta_lat = { name = "servo2", calibration = [[1000, -0.25], [2000, 0.25]], sign = -1 }
    q = { name = "gyro_y", unit = "deg/s", sign = -1 }   # a body with y to the left
    az = { name = "acc_z", unit = "g", sign = -1 }       # and z up
    h = { name = "range_mm", unit = "mm", offset = -35 } # sign * scale * (raw + offset), then the unit
    battery_v = { name = "adc", scale = 0.0123 }
    psi = { name = "yaw", hold = true }                  # a repeat is no reading; false: each is one
    r = { name = "gyro_z", late = 0.02 }                 # written 0.02 s later than it was read
    lat = "gps_lat"                                      # in place of pn and pe, in deg
    lon = "gps_lon"

    [checks]
    waive = ["q-delta_lon"]           # a check of the log with itself to pass over

    [[run]]
    name = "hover"
    file = "hover.csv"
    maneuver = "hover"                # optional, as is note = "..."; part = "A" or "B" for a comparison

Bad input is refused in one line (InputError) naming file, line or channel. What a real log brings along
- outliers, gaps, dropouts, repeated time stamps, impossible commands, held and interpolated samples -
is repaired, counted and reported (Flight.notes).
"""

import hashlib
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tomlkit

from coax_env.errors import InputError
from coax_env.files import read_bytes, staged_folder, write_text
from coax_env.logs.card import CARD, Card, read_card
from coax_env.logs.card_columns import Column, Quaternion
from coax_env.logs.clock import on_even_clock
from coax_env.logs.csv_log import CsvLog, read_csv
from coax_env.logs.derived import without_derived
from coax_env.logs.frames import place
from coax_env.logs.late import in_their_place
from coax_env.logs.repairs import repaired
from coax_env.logs.smoothed import read_apart
from coax_env.logs.units import BATTERY, ROTOR_COMMANDS, SWASH_COMMANDS, without
from coax_env.model.layout import CHANNELS, RPM_PER_RAD_S

IMPORTED = (".ulg", ".bin", ".log", ".bag", ".db3", ".mcap", ".mat", ".parquet", ".pq")
"""How files end that scripts/import_log.py makes a flight folder of."""
FLIGHTS = Path(__file__).parent / "flights"
"""Where shipped flights lie, each a folder."""


@dataclass(frozen=True)
class Run:
    """One maneuver's log on its own time stamps.

    Row k's command holds over [t_k, t_{k+1}); a reading in row k is taken at t_k.

    Attributes:
        t: (n,) time, strictly increasing [s].
        command: (n, 4) omega_u, omega_l [rad/s], delta_lon, delta_lat [rad], without holes.
        measured: channel -> (n,) readings in the units above, NaN where there is no new one.
        part_of: the card's run of which it is a part (estimation/flown.py); empty where it is whole.
        began: time at which that one began [s]; None: with the first row.
        battery: (n,) voltage, the last sample held [V]; None where none was logged.
        part: "A" or "B", of a flight whose parts are to be compared; else empty.
    """

    name: str
    t: np.ndarray
    command: np.ndarray
    measured: Mapping[str, np.ndarray]
    maneuver: str = ""
    note: str = ""
    part_of: str = ""
    began: float | None = None
    battery: np.ndarray | None = None
    part: str = ""

    @property
    def whole(self) -> str:
        """Name of the card's run."""
        return self.part_of or self.name

    @property
    def beginning(self) -> float:
        """Time at which the card's run began [s]."""
        return float(self.t[0]) if self.began is None else self.began

    @property
    def duration(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.t[-1] - self.t[0])

    def of_rows(self, rows: np.ndarray | slice) -> "Run":
        """The run of some of its rows alone: a slice, their places, or (n,) true where one stays."""
        return replace(
            self,
            t=self.t[rows],
            command=self.command[rows],
            measured={channel: values[rows] for channel, values in self.measured.items()},
            battery=None if self.battery is None else self.battery[rows],
        )


@dataclass(frozen=True)
class Flight:
    """Runs flown by one vehicle in one air.

    Attributes:
        vehicle: name of a shipped vehicle file, or a path.
        air: what the card says instead of the vehicle file: density [kg/m3], gravity [m/s2].
        noise: channel -> std in the channel's unit; a channel not named is to be estimated.
        notes: what was done to the data while reading, in words, with counts.
        counts: the same as numbers, e.g. ``{"outliers in h": 12}``.
        hashes: file name -> SHA-256, to recognise data that was used before.
        unread: columns of the files that are no channel and were ignored.
        columns: channel -> the column that the card names for it.
        quaternion: the attitude's columns, where it was logged as one.
        waived: checks of the log with itself (consistency/) that the card passes over.
        synthetic: whether a simulator flew it, as the card says.
    """

    vehicle: str
    runs: tuple[Run, ...]
    air: Mapping[str, float] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)
    path: Path | None = None
    notes: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    hashes: Mapping[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    columns: Mapping[str, Column] = field(default_factory=dict)
    quaternion: Quaternion | None = None
    waived: tuple[str, ...] = ()
    synthetic: bool = False

    @property
    def name(self) -> str:
        """Its folder's name; of one without a folder "flight"."""
        return self.path.name if self.path else "flight"

    @property
    def run_names(self) -> tuple[str, ...]:
        """Names of the runs, in the card's order."""
        return tuple(run.name for run in self.runs)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels measured in at least one run, in the table's order."""
        return tuple(c for c in CHANNELS if any(c in run.measured for run in self.runs))

    def run(self, name: str) -> Run:
        """The run of that name, or its first part."""
        for run in self.runs:
            if name in (run.name, run.whole):
                return run
        raise InputError(f"no run {name!r} in this flight; it has {', '.join(self.run_names)}")

    def select(self, names: Iterable[str]) -> "Flight":
        """The same flight with these runs only, all parts of each, in the flight's own order."""
        wanted = {self.run(name) and name for name in names}
        return replace(self, runs=tuple(run for run in self.runs if wanted & {run.name, run.whole}))


# --- reading ---------------------------------------------------------------------------------


def read_flight(path: str | Path) -> Flight:
    """Read a flight folder, or a shipped one by its name (``"windy"``).

    Raises:
        InputError: one line naming the file and line, channel or field at fault.
    """
    folder = Path(path)
    if len(folder.parts) == 1 and not folder.exists() and (FLIGHTS / folder).is_dir():
        folder = FLIGHTS / folder
    if folder.name == CARD:
        folder = folder.parent
    _check_folder(folder)
    card = read_card(folder / CARD)
    hashes = {CARD: _hash(folder / CARD)}
    counts: Counter[str] = Counter()
    renamed: set[str] = set()
    unread: dict[str, None] = {}  # in the order of the files
    logs = []
    origin: tuple[float, float] | None = None
    for entry in card.runs:
        file = folder / entry.file
        log = read_csv(file, card.columns, card.quaternion)
        log, origin = _with_position(log, origin)
        hashes[entry.file] = _hash(file)
        renamed |= log.renamed
        unread |= dict.fromkeys(log.unknown)
        read = repaired(log, card.noise, counts, card.holds)
        logs.append(in_their_place(read, card.late, counts))
    _check_columns(folder, card, renamed, unread)
    logs = without_derived(logs, counts, card.holds)
    logs = read_apart(on_even_clock(logs, counts), counts, card.holds)
    runs = tuple(
        Run(
            entry.name,
            data.t,
            data.command,
            data.measured,
            entry.maneuver,
            entry.note,
            battery=data.battery,
            part=entry.part,
        )
        for entry, data in zip(card.runs, logs, strict=True)
    )
    return Flight(
        vehicle=card.vehicle,
        runs=runs,
        air=card.air,
        noise=card.noise,
        path=folder,
        notes=tuple(f"{what}: {count}" for what, count in counts.items()),
        counts=dict(counts),
        hashes=hashes,
        unread=tuple(unread),
        columns=card.columns,
        quaternion=card.quaternion,
        waived=card.waived,
        synthetic=card.synthetic,
    )


def _with_position(
    log: CsvLog, origin: tuple[float, float] | None
) -> tuple[CsvLog, tuple[float, float] | None]:
    """With pn and pe in place of lat and lon; the origin is the flight's first place."""
    if not {"lat", "lon"} <= log.data.keys():
        return log, origin
    data = dict(log.data)
    lat, lon = (np.radians(data.pop(name)) for name in ("lat", "lon"))
    known = np.isfinite(lat) & np.isfinite(lon)
    if origin is None and known.any():
        first = int(np.argmax(known))
        origin = (float(lat[first]), float(lon[first]))
    data["pn"], data["pe"] = place(lat, lon, origin or (0.0, 0.0))
    return replace(log, data=data), origin


def _check_columns(folder: Path, card: Card, renamed: Iterable[str], unread: Iterable[str]) -> None:
    """Refuse a card that names columns which no run has."""
    asked = {channel: repr(column.name) for channel, column in card.columns.items()}
    if card.quaternion is not None:
        asked["quaternion"] = ", ".join(map(repr, card.quaternion.names))
    for channel, name in asked.items():
        if channel not in renamed:
            raise InputError(
                f"{folder / CARD}: channel {channel}: no run has a column {name}; not read:"
                f" {', '.join(unread) or 'none'}"
            )


def _check_folder(folder: Path) -> None:
    """Refuse what is no flight folder, and say how to make one."""
    if os.path.isfile(folder):
        if folder.suffix.lower() in IMPORTED:
            step = f"import it: scripts/import_log.py {folder}"
        else:
            step = "put it in a folder of its own, then scripts/check_flight.py FOLDER --draft"
        raise InputError(f"no flight folder at {folder}: found a file there; {step}")
    if not os.path.isdir(folder):
        raise InputError(f"no flight folder at {folder}: found nothing there")
    if not (folder / CARD).exists():
        if (folder / "metadata.yaml").exists():
            raise InputError(f"{folder} is a ROS 2 bag: import it: scripts/import_log.py {folder}")
        raise InputError(
            f"cannot read {folder / CARD}: No such file or directory; a flight folder needs one:"
            f" scripts/check_flight.py {folder} --draft writes a first one for the CSVs in it"
        )


def _hash(path: Path) -> str:
    return hashlib.sha256(read_bytes(path)).hexdigest()


# --- writing ---------------------------------------------------------------------------------


def write_flight(flight: Flight, path: str | Path) -> Path:
    """Write a flight folder that :func:`read_flight` reads back: all files or none.

    Readings keep nine significant digits. ``notes``, ``counts`` and ``hashes`` are not written; a swash
    command that no run has (by its count) gets no column.
    """
    path = Path(path)
    missing = [
        name
        for k, name in enumerate(SWASH_COMMANDS, 2)
        if flight.counts.get(without(name), 0) >= len(flight.runs)
        and not any(run.command[:, k].any() for run in flight.runs)
    ]
    card = tomlkit.document()
    if flight.synthetic:
        card["synthetic"] = True
    card["vehicle"] = {"name": flight.vehicle}
    for section, numbers in (("air", flight.air), ("noise", flight.noise)):
        if numbers:
            card[section] = {key: float(value) for key, value in numbers.items()}
    entries = tomlkit.aot()
    with staged_folder(path) as stage:
        for run, file in zip(flight.runs, _file_names(flight.run_names), strict=True):
            entry = {"name": run.name, "file": file, "maneuver": run.maneuver}
            said = {"note": run.note, "part": run.part}
            entries.append(tomlkit.item(entry | {key: text for key, text in said.items() if text}))
            write_text(stage / file, _csv_text(run, missing))
        card["run"] = entries
        write_text(stage / CARD, tomlkit.dumps(card))
    return path


def _csv_text(run: Run, missing: Collection[str]) -> str:
    """A run as a CSV; missing: commands of which nothing is known."""
    columns = [[repr(float(t)) for t in np.round(run.t, 9)]]
    header = ["t"]
    to_log = (RPM_PER_RAD_S, RPM_PER_RAD_S, 1.0, 1.0)
    for i, name in enumerate((*ROTOR_COMMANDS, *SWASH_COMMANDS)):
        if name not in missing:
            header.append(name)
            columns.append([f"{x:.12g}" for x in run.command[:, i] * to_log[i]])
    if run.battery is not None:
        header.append(BATTERY)
        columns.append([f"{x:.9g}" for x in run.battery.tolist()])
    for channel in CHANNELS:
        if channel in run.measured:
            header.append(channel)
            columns.append(["" if x != x else f"{x:.9g}" for x in run.measured[channel].tolist()])
    lines = [",".join(header), *(",".join(cells) for cells in zip(*columns, strict=True))]
    return "\n".join(lines) + "\n"


def _file_names(run_names: Iterable[str]) -> list[str]:
    """One safe, distinct file name per run."""
    names: list[str] = []
    for run_name in run_names:
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", run_name).strip("_") or "run"
        name, number = f"{stem}.csv", 2
        while name.lower() in {other.lower() for other in names}:
            name, number = f"{stem}_{number}.csv", number + 1
        names.append(name)
    return names
