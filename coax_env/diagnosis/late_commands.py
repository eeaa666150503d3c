"""Commands that a log has later than they act: written as they are echoed, or by a clock that is late.

Then a machine answers before it is told to, which no effect does: of two clean **synthetic** flights
whose commands were written 30 ms late one had a thrust exponent of 98 nats, the other that, a motor's
droop of 598 and a yaw damping. With commands one row sooner they are 3,500 nats likelier; sound flights
are 200 to 10,600 less so. So commands are taken to act as much sooner as is likeliest.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.state_space import Record
from coax_env.logs.held_signal import row_means

MOST = 0.5
"""s by which commands are taken to act sooner at most; ours."""
FIRST = (1, 2, 4, 8, 16)
"""Rows by which they are at first; ours."""
WITHIN = 0.1
"""Rows to which that is looked for, and within which it is whole rows; ours."""


def remark(seconds: float) -> str:
    """What was done to the commands, for who reads the findings.

    Args:
        seconds: by which they are written late.
    """
    return (
        f"commands are written {seconds:.3g} s later than they act: the machine answers before them."
        " They were taken to act so much sooner; look for a clock that is late, or an echo that was"
        f" logged. For identify, replay and compare write late = {seconds:.3g} on the commands' lines"
        " of the card, under [columns]"
    )


def acting_sooner(records: Sequence[Record], seconds: float) -> list[Record]:
    """Records whose commands act so much sooner: of each row the mean over it.

    Args:
        records: with commands as logged. seconds: 0 and more.
    """
    if seconds == 0.0:
        return list(records)
    found = []
    for record in records:
        sooner = [row_means(record.t, column, seconds) for column in record.command.T]
        found.append(replace(record, command=np.column_stack(sooner)))
    return found


def with_commands_sooner(problem: Problem, seconds: float) -> Problem:
    """The problem whose commands act so much sooner than is written [s]."""
    records = acting_sooner(problem.engine.records, seconds)
    return replace(problem.with_records(records), commands_late=seconds)


def written_late(problem: Problem, fit: Fit) -> float:
    """Time by which commands are written later than they act [s], 0 where they are not.

    Args:
        problem, fit: the model as given, with its own numbers refitted.
    """
    row = problem.row

    def likelihood(seconds: float) -> float:
        sooner = problem.with_records(acting_sooner(problem.engine.records, seconds))
        return sooner.engine.log_likelihood(fit.values, fit.noise)

    known = problem.engine.log_likelihood(fit.values, fit.noise)
    nats: dict[int, float] = {}
    for rows in FIRST:
        if rows * row > MOST or min(nats.values(), default=0.0) < -problem.settings.tie:
            break
        nats[rows] = likelihood(rows * row) - known
    rows = max(nats, key=lambda rows: nats[rows], default=0)
    if not nats or not nats[rows] > problem.settings.sure_evidence:
        return 0.0
    problem.report(f"commands about {rows * row:.3g} s sooner: {nats[rows]:.1f} nats")
    found = minimize_scalar(
        lambda seconds: -likelihood(seconds), bounds=(0.5 * rows * row, 2.0 * rows * row),
        method="bounded", options={"xatol": WITHIN * row},
    )  # fmt: skip
    whole = max(round(float(found.x) / row), 1) * row
    return whole if likelihood(whole) > -found.fun - problem.settings.tie else float(found.x)
