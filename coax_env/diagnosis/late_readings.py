"""Late readings moved back by whole rows, once a search has found that they are late.

What is found beside a delay that the model has only to second order may stand for what that lacks
(estimation/late_readings.py): of attitudes 55 ms late beside rotors that jitter the heading stayed
coloured, and the delay doubtful; moved back, all was explained in a third of the time. Echoes 0.3 s
late were 0.26 to 0.29 s late by it, 2.4 to 4.7 std off, on eight flights; moved back 0.29 to 0.30
(**synthetic**).
So the search is done again from the delay alone.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.fits import fitted, noise_fitted, only
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.clock_errors import rates
from coax_env.estimation.late_readings import left_out
from coax_env.estimation.state_space import Late, Record
from coax_env.model.effects import CATALOGUE, parameter_index
from coax_env.model.layout import CHANNELS

DELAYS = ("attitude_delay", "pose_delay", "sonar_delay")
"""Effects that are one time by which all readings of a sensor are late."""


def delay_in(active: Collection[str]) -> str | None:
    """The effect by which readings are late, if any."""
    return next((e for e in DELAYS if e in active), None)


def with_late(record: Record, late: Late | None) -> Record:
    """The record, whose late readings are moved back where the parameters have them late.

    Args:
        record: as logged. late: of any record; None: of none.
    """
    return replace(record, late=None if late is None else late._replace(rates=rates(record)))


def moved_as_in(problem: Problem, records: Sequence[Record]) -> list[Record]:
    """Records of a problem's runs in its order, with the readings moved back that are in it."""
    pairs = zip(records, problem.engine.records, strict=True)
    return [replace(r, late=own.late) for r, own in pairs]


def moved_back(problem: Problem, fit: Fit) -> tuple[Problem, Fit] | None:
    """The problem with late readings moved back, and a fit to it of their delay alone.

    Args:
        problem, fit: after a search.

    Returns:
        None where nothing is late by another number of rows than readings are moved by, or they are no
        likelier so.
    """
    delay = delay_in(fit.active)
    if delay is None or delay in problem.model.moments:
        return None
    (time,) = problem.own[delay]
    rows = round(fit.values[time.name] / problem.row)
    channels = np.isin(CHANNELS, CATALOGUE[delay].channels)
    late = Late(parameter_index(time.name), channels, rows, rows * problem.row)
    if rows == 0 or _same(late, problem.late):
        return None
    moving = _moving_back(problem, fit, late)
    trial = fitted(moving, noise_fitted(moving, fitted(moving, fit)))
    gained = fit.objective - trial.objective
    problem.report(f"late readings moved back by {rows} rows: {gained:.1f} nats")
    if not math.isfinite(gained) or (problem.late is None and gained < problem.settings.tie):
        return None  # no likelier, or a filter that diverges
    return moving, fitted(moving, noise_fitted(moving, only(moving, trial, {delay})))


def _same(late: Late, known: Late | None) -> bool:
    """Whether these readings are moved by so many rows already."""
    return known is not None and (late.place, late.rows) == (known.place, known.rows)


def _moving_back(problem: Problem, fit: Fit, late: Late) -> Problem:
    """The problem with readings moved back; those without a row to go to count as they do as logged.

    Args:
        problem, fit: with the delay. late: what is moved.
    """
    as_logged = problem.as_logged
    logged = as_logged.engine.records
    left = problem.with_records([replace(left_out(with_late(r, late)), late=None) for r in logged])
    of_all, of_moved = (p.engine.filter(fit.values, fit.noise) for p in (as_logged, left))
    return problem.with_records(
        [
            with_late(r, late._replace(nats=a.log_likelihood - b.log_likelihood))
            for r, a, b in zip(logged, of_all, of_moved, strict=True)
        ]
    )
