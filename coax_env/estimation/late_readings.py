"""Readings of a late sensor, moved back by whole rows to where they belong.

A reading that is late by d is the model's of now less d times its rate, and so on to second order
(effects.attitude_delay). Over some rows of unsteady flight that is not what was measured: beside rotors
that jitter delays of 20, 40 and 60 ms were found as 16, 32 and 55, and the heading stayed coloured
(**synthetic**). So readings go back by the whole rows that are nearest to their delay, and the model is
asked for the rest of it. A row then has readings that were logged later; the likelihood of all readings
together is the same in any order.

Where rows are uneven a reading goes to the nearest row, by its rate. What the first rows show was
before them: such readings are left out where nothing is late, too, and what they are worth is added to
the likelihood, so that it is of all readings.
"""

from dataclasses import replace

import numpy as np

from coax_env.estimation.state_space import Late, Model, Record


def left_out(record: Record) -> Record:
    """The record without the late readings that have no row to go to."""
    late = _late_of(record)
    z = record.z.copy()
    since, _ = _moves(record.t, late)
    gone = np.setdiff1d(np.arange(record.t.size), since)
    z[np.ix_(gone, late.channels)] = np.nan
    return replace(record, z=z)


def moved_back(record: Record) -> Record:
    """The record with late readings at the rows to which they belong; `late.done` is True of it."""
    late = _late_of(record)
    since, to = _moves(record.t, late)
    from_rows, to_rows = np.ix_(since, late.channels), np.ix_(to, late.channels)
    beyond = record.t[to] - (record.t[since] - late.seconds)
    z = record.z.copy()
    z[:, late.channels] = np.nan
    z[to_rows] = record.z[from_rows] + beyond[:, None] * late.rates[from_rows]
    blur = record.blur
    if blur is not None:
        blur, logged = blur.copy(), blur
        blur[to_rows] = logged[from_rows]
    return replace(record, z=z, blur=blur, late=late._replace(done=True))


def as_flown(model: Model, record: Record, p: np.ndarray) -> tuple[Record, np.ndarray]:
    """A record and the parameters with which a pass flies it.

    Late readings are moved back where the parameters have them late, and left out where not.

    Args:
        model: whose parameters they are. record: as logged. p: (np,) the parameters.
    """
    if record.late is None:
        return record, p
    if p[_places(model, record.late)[0]] <= 0.0:
        return left_out(record), p
    record = moved_back(record)
    return record, rest_of(model, record, p)


def rest_of(model: Model, record: Record, p: np.ndarray) -> np.ndarray:
    """The parameters with what is left of a delay, where the readings of a flown record were moved.

    Args:
        model: whose parameters they are. record: of `as_flown`. p: (np,) the parameters.
    """
    if record.late is None or not record.late.done:
        return p
    p = p.copy()
    p[_places(model, record.late)] -= record.late.seconds
    return p


def _moves(t: np.ndarray, late: Late) -> tuple[np.ndarray, np.ndarray]:
    """Rows whose readings are moved, and the rows nearest to what they show, one for each."""
    shown = t - late.seconds
    after = np.clip(np.searchsorted(t, shown), 1, t.size - 1)
    nearest = np.where(shown - t[after - 1] < t[after] - shown, after - 1, after)
    within = np.abs(t[nearest] - shown) < 0.51 * late.seconds / late.rows
    since = np.flatnonzero(within)
    to, first = np.unique(nearest[since], return_index=True)
    return since[first], to


def _late_of(record: Record) -> Late:
    assert record.late is not None
    return record.late


def _places(model: Model, late: Late) -> np.ndarray:
    """Places of the delay in the model's parameter vector."""
    of_blocks = getattr(model, "in_blocks", None)
    return np.array([late.place]) if of_blocks is None else np.asarray(of_blocks(late.place))
