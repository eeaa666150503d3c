"""Gyros or accelerometers that are read later than all else: another clock, a bus, a driver's queue.

No effect makes these late alone, and what makes the machine late stands for it: with gyros 20 ms late
two of five **synthetic** flights with one effect hidden had a servo's delay of 22 and 54 nats; poses
beside such gyros stayed coloured. Moved back by a row, at the fit that there is, gyros were 1,000 to
1,600 nats likelier; where sensors are on time, whatever else was late, they were 370 to 530 less so.
So where something is named or coloured it is asked, and the search done again with readings moved back
by the likeliest whole rows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.late_readings import left_out, moved_back
from coax_env.estimation.state_space import Late, Record
from coax_env.model.layout import ACCELEROMETERS, CHANNELS, GYROS
from coax_env.plain_words import and_list, seconds

GROUPS = {"gyros": GYROS, "accelerometers": ACCELEROMETERS}
"""Sensors that may be late, each by itself."""
MOST = 0.1
"""s by which they are taken to be late at most; ours."""

Rows = Mapping[str, int]
"""Group -> whole rows by which its readings are late."""


def remark(rows: Rows, row: float) -> str:
    """What was done to the readings, for who reads the findings.

    Args:
        rows: by which they are late. row: between two [s].
    """
    said = [f"{group} {seconds(count * row)}" for group, count in rows.items()]
    lines = [f"late = {count * row:.3g} on {'/'.join(GROUPS[g])}" for g, count in rows.items()]
    return (
        f"read later than all else: {and_list(said)}. They were moved back; the simulation has them on"
        " time. Look for another clock, or a queue. For identify, replay and compare write"
        f" {and_list(lines)} of the card, under [columns]"
    )


def on_time(records: Sequence[Record], rows: Rows, row: float) -> list[Record]:
    """Records with late readings at the rows to which they belong.

    Args:
        records: as logged. rows: by which they are late. row: between two [s].
    """
    found = list(records)
    for group, count in rows.items():
        found = [replace(moved_back(_late(r, group, count, row)), late=r.late) for r in found]
    return found


def rows_late(problem: Problem, fit: Fit) -> tuple[dict[str, int], float]:
    """By how many rows each group is late, and how much likelier its readings are moved back [nats].

    Args:
        problem, fit: after a search.
    """
    found, gained = {}, 0.0
    for group, channels in GROUPS.items():
        if problem.aboard.isdisjoint(channels) or problem.row > MOST:
            continue
        rows, best = 0, 0.0
        while (rows + 1) * problem.row <= MOST:
            further = _gained(problem, fit, group, rows + 1)
            if not further > best:
                break
            rows, best = rows + 1, further
        if best > problem.settings.sure_evidence:
            found[group] = rows
            gained += best
    return found, gained


def worth_left_out(problem: Problem, fit: Fit, rows: Rows) -> float:
    """Log-likelihood of the readings that cannot be moved back, as logged [nats].

    Args:
        problem, fit: as logged. rows: by which they are moved.
    """
    return problem.engine.log_likelihood(fit.values, fit.noise) - _unmoved(problem, fit, rows)


def _gained(problem: Problem, fit: Fit, group: str, rows: int) -> float:
    """nats by which a group's readings are likelier moved back by so many rows, at a fit."""
    records, row = problem.engine.records, problem.row
    moved = problem.with_records(on_time(records, {group: rows}, row)).engine
    return moved.log_likelihood(fit.values, fit.noise) - _unmoved(problem, fit, {group: rows})


def _unmoved(problem: Problem, fit: Fit, rows: Rows) -> float:
    """Log-likelihood of the readings that can be moved back by so many rows, as logged [nats]."""
    records = list(problem.engine.records)
    for group, count in rows.items():
        records = [
            replace(left_out(_late(r, group, count, problem.row)), late=r.late) for r in records
        ]
    return problem.with_records(records).engine.log_likelihood(fit.values, fit.noise)


def _late(record: Record, group: str, rows: int, row: float) -> Record:
    """The record with a group late by whole rows, by no parameter; of no motion, thus without rates."""
    channels = np.isin(CHANNELS, GROUPS[group])
    return replace(record, late=Late(0, channels, rows, rows * row, np.zeros(record.z.shape)))
