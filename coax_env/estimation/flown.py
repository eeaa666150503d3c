"""What of a flight was flown: runs cut where nothing is known, or something else moves the machine.

- A gap: the last command is held for so long, and no longer; a new part begins behind it. So it does
  where a command jumped in a gap of some rows: nobody knows when.
- A position, height or heading that was set anew (logs/resets.py): a new part begins behind the jump.
- Commands that freeze, where they otherwise change all the time: the machine obeys others, or none.
- Rotors that carry less than half the weight: it stands on the ground, or is carried.
- What lasts long is flown in equal parts, so that an hour takes the memory of some minutes.

A part keeps its run's name, from the second on with a number. All that fits or flies again (diagnosis,
identification, replay, check) asks for the parts here, since only a vehicle says what carries it.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coax_env.logs.flight import Flight, Run
from coax_env.logs.held import MISSING
from coax_env.logs.held_signal import integral_of_held
from coax_env.logs.packets import stretches
from coax_env.logs.repairs import GAP, hold_last
from coax_env.logs.resets import reset_rows
from coax_env.model.layout import RPM_PER_RAD_S
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import and_list, channel_name

LONGEST_BELIEVED = 0.25
"""Time [s] for which the last command is believed, and not less than BELIEVED_STEPS usual steps.

A swash command that is 0.05 rad off turns a machine of this size by half a radian in that time. Gaps of
radio links that are shorter cost less by a held command than by a filter that starts anew; ours.
"""
BELIEVED_STEPS = 5.0
JUMP = 3.0
"""Times the rms of what a command does in the time of a gap, over all runs, from which on it jumped.

Held, it is wrong by the jump for a part of the gap: such steps of 0.1 rad were worth 106 nats to
whatever made the machine answer sooner, on a clean synthetic flight by telemetry. Ours.
"""
SHORTEST_PART = 2.0
"""A part that is shorter [s] is left out: the filter needs the first second to settle; ours."""
LONGEST_PART = 300.0
"""[s] from which on a stretch is flown in equal parts. What a pass holds of each row, 3.5 kB and in the
search for what begins up to 2 kB for each effect asked, it then holds for one of them; ours."""

FROZEN = 1.0
"""Time [s] through which all four commands stay the same to the last digit..."""
FROZEN_TIMES = 10.0
"""...if that is so many times longer than nearly all (95 %) of the times between two changes; ours."""
FEWEST_CHANGES = 20  # of the commands, so that their usual time is known; ours

CARRIES = 0.5
"""Share of the weight, as mean over MEAN_TIME, below which the rotors carry nothing; ours."""
MEAN_TIME = 0.5  # [s]; ours
FLIES = 0.9
"""Share of the run's usual thrust from which on it flies again: between them it may stand; ours."""
MOST_GROUNDED = 0.8
"""Share of all rows beyond which the vehicle is another one, and nothing is cut; ours."""


def flown_parts(flight: Flight, vehicle: Vehicle) -> Flight:
    """The flight with every run cut into what was flown, and with notes of what was left out.

    Args:
        flight: as read.
        vehicle: whose rotors carry its weight.
    """
    grounded = _grounded_rows(flight, vehicle)
    jumps = jumps_in_gaps([run.t for run in flight.runs], [run.command for run in flight.runs])
    counts: Counter[str] = Counter(flight.counts)
    notes: list[str] = []
    taken = set(flight.run_names)
    parts: list[Run] = []
    for run, on_ground, jumped in zip(flight.runs, grounded, jumps, strict=True):
        frozen = frozen_rows(run)
        for what, mask in (("commands frozen", frozen), ("rotors too slow to fly", on_ground)):
            for first, stop in stretches(mask):
                last = run.t[min(stop, run.t.size - 1)]
                notes.append(f"{run.name}: {run.t[first]:.1f} to {last:.1f} s left out: {what}")
                counts[f"stretches left out: {what}"] += 1
        parts += _parts(run, frozen | on_ground, jumped, taken, counts, notes)
    if not parts:
        too_short = (
            f"no run has {SHORTEST_PART:g} s of flight without a gap: all are used as they are"
        )
        return replace(flight, notes=(*flight.notes, too_short))
    if not notes:
        return flight
    return replace(flight, runs=tuple(parts), notes=(*flight.notes, *notes), counts=dict(counts))


def _parts(
    run: Run,
    left_out: np.ndarray,
    jumped: np.ndarray,
    taken: set[str],
    counts: Counter[str],
    notes: list[str],
) -> list[Run]:
    """What is left of a run, cut at its gaps too; `taken`: names of runs that there are."""
    step = np.diff(run.t)
    long = np.concatenate([[False], step > longest_believed(run.t)])
    gap = long | jumped
    set_anew = reset_rows(run)
    for row in sorted(set().union(*(rows.tolist() for rows in set_anew.values()))):
        if not gap[row] and not left_out[row - 1 : row + 1].any():
            which = and_list([channel_name(c) for c, rows in set_anew.items() if row in rows])
            notes.append(f"{run.name}: cut at {run.t[row]:.1f} s, where {which} jumped and stayed")
            counts["jumps of position, height or heading at which a run is cut"] += 1
    for row in np.flatnonzero(gap):
        if not left_out[row - 1 : row + 1].any():
            why = "" if long[row] else ", in which a command jumped"
            notes.append(
                f"{run.name}: cut at a gap of {step[row - 1]:.2f} s, {run.t[row]:.1f} s{why}"
            )
            counts["gaps at which a run is cut"] += 1
    for rows in set_anew.values():
        gap[rows] = True
    if not (gap.any() or left_out.any() or _equal_parts(run.t) > 1):
        return [run]
    pieces = np.cumsum(gap | np.diff(left_out, prepend=left_out[:1]))
    kept = []
    for piece in np.unique(pieces[~left_out]):
        rows = np.flatnonzero(pieces == piece)
        if run.t[rows[-1]] - run.t[rows[0]] < SHORTEST_PART:
            counts[f"parts of less than {SHORTEST_PART:g} s left out"] += 1
            notes.append(
                f"{run.name}: {run.t[rows[0]]:.1f} to {run.t[rows[-1]]:.1f} s left out: shorter"
                f" than {SHORTEST_PART:g} s"
            )
        else:
            count = _equal_parts(run.t[rows])
            if count > 1:
                lasts = run.t[rows[-1]] - run.t[rows[0]]
                notes.append(f"{run.name}: flown in {count} parts of {lasts / count:.0f} s")
            kept += np.array_split(rows, count)
    names = [run.name]
    while len(names) < len(kept):
        names.append(_free_name(run.name, taken))
    return [_part(run, rows, name) for rows, name in zip(kept, names, strict=False)]


def _equal_parts(t: np.ndarray) -> int:
    """In how many a stretch with rows at these times is flown."""
    return max(math.ceil((t[-1] - t[0]) / LONGEST_PART), 1)


def _free_name(name: str, taken: set[str]) -> str:
    number = 2
    while f"{name} ({number})" in taken:
        number += 1
    taken.add(f"{name} ({number})")
    return f"{name} ({number})"


def _part(run: Run, rows: np.ndarray, name: str) -> Run:
    return replace(run.of_rows(rows), name=name, part_of=run.whole, began=run.beginning)


def longest_believed(t: np.ndarray) -> float:
    """Time [s] for which a run's last command is believed; t: (n,) its rows."""
    return max(LONGEST_BELIEVED, BELIEVED_STEPS * float(np.median(np.diff(t))))


def jumps_in_gaps(times: Sequence[np.ndarray], commands: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Rows (n,) of each run before which rows are missing for GAP or longer and a command jumped.

    Args:
        times: (n,) of each run [s]. commands: (n, 4) of each.
    """
    usual = float(np.median(np.concatenate([np.diff(t) for t in times])))
    found = [np.zeros(t.size, bool) for t in times]
    moved: dict[int, np.ndarray] = {}  # rms of each command's change, by rows
    for t, command, jumped in zip(times, commands, found, strict=True):
        step = np.diff(t)
        for row in np.flatnonzero(step > max(GAP, MISSING * usual)):
            rows = round(step[row] / usual)
            if rows not in moved:
                changes = [np.zeros((0, 4)), *(c[rows:] - c[:-rows] for c in commands)]
                squares = np.square(np.concatenate(changes)).sum(axis=0)
                moved[rows] = np.sqrt(squares / max(sum(map(len, changes)), 1))
            change = np.abs(command[row + 1] - command[row])
            jumped[row + 1] = bool(np.any(change > JUMP * moved[rows]))
    return found


# --- commands that freeze ------------------------------------------------------------------------


def frozen_rows(run: Run) -> np.ndarray:
    """Rows (n,) in which all commands stand still, in a run in which they otherwise change."""
    found = np.zeros(run.t.size, bool)
    changes = np.flatnonzero((np.diff(run.command, axis=0) != 0.0).any(axis=1)) + 1
    if changes.size < FEWEST_CHANGES:
        return found
    edges = np.concatenate([[0], changes, [run.t.size - 1]])
    lasted = np.diff(run.t[edges])
    usual = float(np.quantile(lasted, 0.95))
    for k in np.flatnonzero(lasted > max(FROZEN, FROZEN_TIMES * usual)):
        found[edges[k] + 1 : edges[k + 1]] = True
    if lasted[-1] > max(FROZEN, FROZEN_TIMES * usual):
        found[-1] = True
    return found


# --- rotors that carry nothing -------------------------------------------------------------------


def _grounded_rows(flight: Flight, vehicle: Vehicle) -> list[np.ndarray]:
    """Rows of each run in which the rotors are too slow to fly; none where they never are fast."""
    found = [grounded_rows(run, vehicle) for run in flight.runs]
    share = sum(int(mask.sum()) for mask in found) / sum(mask.size for mask in found)
    return found if share <= MOST_GROUNDED else [np.zeros(mask.size, bool) for mask in found]


def grounded_rows(run: Run, vehicle: Vehicle) -> np.ndarray:
    """Rows (n,) of a run in which the rotors carry less than half the weight, and until they fly."""
    thrust = _mean(run.t, thrust_share(run, vehicle))
    low = thrust < CARRIES
    if not low.any() or low.all():
        return low
    not_flying = thrust < FLIES * float(np.median(thrust[~low]))
    found = np.zeros(run.t.size, bool)
    for first, stop in stretches(not_flying | low):
        if low[first:stop].any():
            found[first:stop] = True
    return found


def thrust_share(run: Run, vehicle: Vehicle) -> np.ndarray:
    """Thrust over weight (n,) at a run's rotor speeds, the measured ones where they are logged."""
    p = {name: number.value for name, number in vehicle.parameters.items()}
    per_speed2 = p["air_density"] * math.pi * p["rotor_radius"] ** 4
    lift = np.zeros(run.t.size)
    for column, rotor in enumerate(("upper", "lower")):
        lift += per_speed2 * p[f"thrust_coefficient_{rotor}"] * _speed(run, column, rotor) ** 2
    return lift / (p["mass"] * p["gravity"])


def _speed(run: Run, column: int, rotor: str) -> np.ndarray:
    """A rotor's speed [rad/s], (n,): as measured, else as commanded."""
    measured = run.measured.get(f"rpm_{rotor}")
    if measured is None or np.isnan(measured).all():
        return run.command[:, column]
    return hold_last(measured) / RPM_PER_RAD_S


def _mean(t: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Mean of a held signal over MEAN_TIME around each row, (n,)."""
    integral = integral_of_held(t, held)
    first = np.maximum(t - 0.5 * MEAN_TIME, t[0])
    last = np.minimum(t + 0.5 * MEAN_TIME, t[-1])
    return (integral(last) - integral(first)) / (last - first)
