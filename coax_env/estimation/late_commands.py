"""Commands that a log has later than they act: written as they are echoed, or by a clock that is late.

Then a machine answers before it is told to, which no effect does: of two clean **synthetic** flights
whose commands were written 30 ms late one had a thrust exponent of 98 nats, the other that, a motor's
droop of 598 and a yaw damping. With commands one row sooner they are 3,500 nats likelier; sound flights
are 200 to 10,600 less so. So commands are taken to act as much sooner as is likeliest.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from coax_env.estimation.engine import Engine
from coax_env.estimation.fitted_vehicle import median_step
from coax_env.estimation.state_space import Noise, Record
from coax_env.logs.held_signal import row_means
from coax_env.progress import Progress

MOST = 0.5
"""s by which commands are taken to act sooner at most; ours."""
FIRST = (1, 2, 4, 8, 16)
"""Rows by which they are at first; ours."""
ENOUGH = 42.0
"""nats that it must be worth: three thresholds of a cause (diagnosis/settings.py)."""
TIE = 6.0
"""nats within which times are as likely: odds of 400 to 1, ours."""
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
        f" logged. For replay and compare write late = {seconds:.3g} on the commands' lines of the"
        " card, under [columns]"
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


def written_late(
    engine: Engine,
    values: Mapping[str, float],
    noise: Noise,
    report: Progress,
    enough: float = ENOUGH,
    tie: float = TIE,
) -> float:
    """Time by which commands are written later than they act [s], 0 where they are not.

    Args:
        engine: model and records. values, noise: the model's own numbers and levels, fitted.
        report: called with a line of text.
        enough: nats that it must be worth. tie: nats within which times are as likely.
    """
    row = median_step(engine.records)

    def likelihood(seconds: float) -> float:
        sooner = acting_sooner(engine.records, seconds)
        return Engine(engine.model, sooner, engine.threads).log_likelihood(values, noise)

    known = engine.log_likelihood(values, noise)
    nats: dict[int, float] = {}
    for rows in FIRST:
        if rows * row > MOST or min(nats.values(), default=0.0) < -tie:
            break
        nats[rows] = likelihood(rows * row) - known
    rows = max(nats, key=lambda rows: nats[rows], default=0)
    if not nats or not nats[rows] > enough:
        return 0.0
    report(f"commands about {rows * row:.3g} s sooner: {nats[rows]:.1f} nats")
    found = minimize_scalar(
        lambda seconds: -likelihood(seconds), bounds=(0.5 * rows * row, 2.0 * rows * row),
        method="bounded", options={"xatol": WITHIN * row},
    )  # fmt: skip
    whole = max(round(float(found.x) / row), 1) * row
    return whole if likelihood(whole) > -found.fun - tie else float(found.x)
