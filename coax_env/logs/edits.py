"""Edits of a real log: what it says is changed, and nothing else. The machine flew as it flew.

So the truth of the *difference* of two diagnoses is known, on real noise and with all that the model
lacks. The machine seems to have changed the other way round: where the logged swash commands are
multiplied by 1.25, its linkage seems to have 1/1.25 of its gain.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from coax_env.errors import InputError
from coax_env.logs.flight import Flight, Run
from coax_env.logs.held_signal import integral_of_held

UPPER, LOWER, LON, LAT = range(4)
"""Columns of `Run.command`."""
ATTITUDE = ("phi", "theta", "psi")


@dataclass(frozen=True)
class Edit:
    """A kind of edit: what it does to a run's arrays, and how its size is given.

    apply: ``apply(run, size, rows)`` -> the run, with rows (n,) True from which on it holds.
    """

    unit: str
    summary: str
    apply: Callable[[Run, float, np.ndarray], Run]


def _commands(run: Run, command: np.ndarray, rows: np.ndarray) -> Run:
    return replace(run, command=np.where(rows[:, None], command, run.command))


def _phase(run: Run, size: float, rows: np.ndarray) -> Run:
    cosine, sine = np.cos(size), np.sin(size)
    command = run.command.copy()
    lon, lat = run.command[:, LON], run.command[:, LAT]
    command[:, LON] = cosine * lon - sine * lat
    command[:, LAT] = sine * lon + cosine * lat
    return _commands(run, command, rows)


def _sooner(run: Run, size: float, columns: slice) -> np.ndarray:
    """Commands (n, 4), some columns logged sooner: each row has the mean over its own interval."""
    t = run.t
    ends = np.append(t[1:], t[-1] + (t[-1] - t[-2]))
    command = run.command.copy()
    for k in range(4)[columns]:
        integral = integral_of_held(t, run.command[:, k])
        command[:, k] = (integral(ends + size) - integral(t + size)) / (ends - t)
    return command


def _delay(run: Run, size: float, rows: np.ndarray) -> Run:
    return _commands(run, _sooner(run, size, slice(LON, None)), rows)


def _command_delay(run: Run, size: float, rows: np.ndarray) -> Run:
    return _commands(run, _sooner(run, size, slice(None)), rows)


def _added(column: int) -> Callable[[Run, float, np.ndarray], Run]:
    def apply(run: Run, size: float, rows: np.ndarray) -> Run:
        command = run.command.copy()
        command[:, column] += size
        return _commands(run, command, rows)

    return apply


def _scaled(columns: slice) -> Callable[[Run, float, np.ndarray], Run]:
    def apply(run: Run, size: float, rows: np.ndarray) -> Run:
        command = run.command.copy()
        command[:, columns] *= size
        return _commands(run, command, rows)

    return apply


def _reading(channel: str, *, times: bool = False) -> Callable[[Run, float, np.ndarray], Run]:
    def apply(run: Run, size: float, rows: np.ndarray) -> Run:
        if channel not in run.measured:
            raise InputError(f"run {run.name!r} has no {channel} to edit")
        values = run.measured[channel]
        changed = values * size if times else values + size
        return replace(run, measured={**run.measured, channel: np.where(rows, changed, values)})

    return apply


EDITS: dict[str, Edit] = {
    "phase": Edit("rad", "swash commands turned by this angle, as swash_phase turns them", _phase),
    "delay": Edit("s", "swash commands logged this much sooner", _delay),
    "command_delay": Edit("s", "the same for all four commands", _command_delay),
    "offset_lon": Edit("rad", "this is added to delta_lon", _added(LON)),
    "offset_lat": Edit("rad", "this is added to delta_lat", _added(LAT)),
    "gain": Edit("1", "swash commands are multiplied by this", _scaled(slice(LON, None))),
    "rotor_scale": Edit("1", "rotor speed commands are multiplied by this", _scaled(slice(LON))),
    **{
        angle: Edit("rad", f"this is added to {angle}", _reading(angle)) for angle in ATTITUDE
    },
    "h": Edit("m", "this is added to h", _reading("h")),
    "h_scale": Edit("1", "h is multiplied by this", _reading("h", times=True)),
    **{
        f"{gyro}_bias": Edit("rad/s", f"this is added to {gyro}", _reading(gyro)) for gyro in "pqr"
    },
}  # fmt: skip
"""Every edit by its name."""


def edited(
    flight: Flight, edits: Mapping[str, float], since: tuple[str, float] | None = None
) -> Flight:
    """The flight as it would read, had its log said something else.

    Args:
        flight: as read.
        edits: name of EDITS -> size.
        since: run and time [s] from which on: earlier runs, and earlier rows of this one, stay.

    Raises:
        InputError: no such edit, run or channel, or a size that is none.
    """
    for name, size in edits.items():
        if name not in EDITS:
            raise InputError(f"no edit {name!r}; there are {', '.join(EDITS)}")
        if EDITS[name].unit == "1" and size <= 0.0:
            raise InputError(f"edit {name} is a factor and should be positive, found {size:g}")
    begun = since is None
    runs = []
    if since is not None:
        flight.run(since[0])
    for run in flight.runs:
        rows = np.full(run.t.size, begun)
        if since is not None and run.whole == since[0]:
            rows, begun = run.t >= since[1], True
        for name, size in edits.items():
            if rows.any():
                run = EDITS[name].apply(run, size, rows)
        runs.append(run)
    return replace(flight, runs=tuple(runs))
