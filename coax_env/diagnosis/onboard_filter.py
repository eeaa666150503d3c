"""Whether attitudes are those of an onboard filter, which has the noise of the logged gyros in them.

A filter on board carries its attitudes from row to row by the gyros, velocities and height by the
accelerometers. What they say of each other is then said twice, and no evidence: of eight clean
**synthetic** flights whose log had such a filter's states, six had a false name, a gyro's scale of 15
to 45 nats. It shows in the innovations: where the noise of a rate is in its angle too, the two are
correlated in one row, while two sensors of their own never are. Then the filter's states are read once
a second, sensors' effects that rest on them are not asked for, and a remark says so.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import Record
from coax_env.estimation.whiteness import correlation
from coax_env.model.layout import MOTION
from coax_env.plain_words import and_list, plain, seconds

CARRIED = 0.2
"""Correlation of the innovations of a rate and of its angle in a row, all three at least. Four such
flights had 0.31 and more; others, **synthetic** and real, 0.15 and less."""
CIRCULAR = frozenset({
    "gyro_scale", "gyro_bias", "attitude_bias", "magnetic_field", "imu_tilt", "accel_scale",
    "accel_bias", "sonar_scale", "sonar_tilt", "sonar_delay",
})  # fmt: skip
"""Effects that show in what the sensors of such a filter and its states say of each other."""
ANGLE_OF = {"p": "phi", "q": "theta", "r": "psi"}
APART = 1.0
"""s between two readings of such a filter that are taken. From row to row it says what gyros and
accelerometers say; with all its readings inertias were 15 to 20 % too large on three clean
**synthetic** flights and six channels coloured, with one in 0.3 s or 1 s neither; ours."""


def of_onboard_filter(problem: Problem, fit: Fit) -> bool:
    """Whether attitudes have the noise of the gyros.

    Args:
        problem, fit: after a search.
    """
    if not problem.aboard.issuperset({*ANGLE_OF, *ANGLE_OF.values()}):
        return False
    passes = problem.engine.filter(fit.values, fit.noise)
    channels = problem.model.channels
    return all(_carried(passes, channels, c, angle) for c, angle in ANGLE_OF.items())


def _carried(passes: Sequence[RunPass], channels: Sequence[str], rate: str, angle: str) -> bool:
    """Whether a gyro read too much where the filter foresaw too little of its angle, and back."""
    pairs = [run.innovations[:, [channels.index(rate), channels.index(angle)]] for run in passes]
    both = np.concatenate([pair[np.isfinite(pair).all(axis=1)] for pair in pairs])
    return correlation(*both.T) < -CARRIED


def read_seldom(records: Sequence[Record], channels: Sequence[str]) -> list[Record]:
    """Records with readings of MOTION that are APART at least.

    Args:
        records: as logged. channels: of their columns.
    """
    found = []
    for record in records:
        z = record.z.copy()
        for channel in MOTION:
            column, last = z[:, channels.index(channel)], -math.inf
            for row in np.flatnonzero(np.isfinite(column)).tolist():
                if record.t[row] < last + APART - 1e-6:
                    column[row] = math.nan
                else:
                    last = float(record.t[row])
        found.append(replace(record, z=z))
    return found


def remark(unasked: Collection[str]) -> str:
    """That attitudes are an onboard filter's, for who reads the findings.

    Args:
        unasked: effects that were not asked for, therefore.
    """
    text = (
        "the logged attitudes have the noise of the logged gyros in them: an onboard filter's."
        f" They, velocities, height and position are read once in {seconds(APART)}"
    )
    if not unasked:
        return text
    return (
        f"{text}, and what sensors say of each other is no evidence:"
        f" {and_list([plain(effect) for effect in sorted(unasked)])} were not looked for"
    )
