"""Two logs of one flight: what one says that the other does not.

Another card, another unit, a servo trim entered later, a log edited to know the truth: the machine
flew as it flew, so that noise and all that the model lacks are the same in both and cancel exactly.
Compared as two flights would be, each with noise of its own, most of that would be lost.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from coax_env.comparison.two_logs.before import Before, calm, fitted_model
from coax_env.comparison.two_logs.changes import changes
from coax_env.diagnosis.settings import Settings
from coax_env.estimation.helicopter import record_of
from coax_env.logs.flight import Flight, Run
from coax_env.model.vehicle import Vehicle
from coax_env.progress import Progress

GUSTS = ("force_xy", "force_z", "moment_xy", "moment_z")


def of_one_flight(a: Flight, b: Flight) -> bool:
    """Whether two logs have the same rows, and most of their channels read the same in all of them.

    Args:
        a, b: as read.
    """
    if a.run_names != b.run_names or a.channels != b.channels or not a.channels:
        return False
    pairs = list(zip(a.runs, b.runs, strict=True))
    if not all(np.array_equal(one.t, other.t) for one, other in pairs):
        return False
    same = [
        all(_same(one.measured.get(c), other.measured.get(c)) for one, other in pairs)
        for c in a.channels
    ]
    return 2 * sum(same) > len(same)


def _same(one: np.ndarray | None, other: np.ndarray | None) -> bool:
    if one is None or other is None:
        return one is other
    return bool(np.array_equal(one, other, equal_nan=True))


def difference(
    a: Flight, b: Flight, vehicle: Vehicle, settings: Settings, report: Progress
) -> dict[str, Any]:
    """What changes.json holds of them.

    Args:
        a, b: as read, `of_one_flight`.
        vehicle: in any air.
        settings: thresholds and limits.
        report: called with a line of text at every step.
    """
    machine = vehicle.in_air(a.air)
    flight = calm(a, machine)
    before = Before.of(*fitted_model(flight, machine, settings, report))
    after = replace(flight, runs=tuple(_as_in(run, a, b) for run in flight.runs))
    report("searching for what the logs say differently")
    found = changes(before, [record_of(run) for run in after.runs], report)
    noise = before.fit.noise
    each = {"own": {}, "gusts": {n: float(noise.process[n]) for n in GUSTS}}
    when = (
        ""
        if found.since is None
        else f", the same until {found.since.t:.2f} s of {found.since.moment.run}"
    )
    return {
        **found.as_json(),
        "of_one_flight": True,
        "unexplained": [],
        "circumstances": {"A": each, "B": each},
        "shared": list(before.fit.active),
        "bounds": {},
        "remarks": [
            f"These are two logs of one flight{when}: their noise is the same, and they are compared"
            " row by row."
        ],
    }


def _as_in(run: Run, a: Flight, b: Flight) -> Run:
    """A run of the one log, cut and calmed, as the other has it: what differs as read."""
    one, other = a.run(run.whole), b.run(run.whole)
    rows = np.searchsorted(one.t, run.t)
    measured = {}
    for channel, values in run.measured.items():
        apart = (other.measured[channel] - one.measured[channel])[rows]
        measured[channel] = np.where(np.isfinite(apart), values + apart, values)
    command = run.command + (other.command - one.command)[rows]
    return replace(run, command=command, measured=measured)
