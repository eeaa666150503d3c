"""Whether measured rotor speeds come late, by a filter or a delay of their own that the model lacks.

Motor controllers report speeds averaged over a turn or more, and late. In the speeds that is a motor's
lag; thrust and torque, which follow at once, deny it. So where a lag is found the model is fitted to
all other readings alone. Speeds come late where these are likelier with less of it, by the threshold,
and nothing is left of it, or where speeds stay coloured beside it, with rotors that jitter too, as no
lag of the motors leaves them. Where speeds are white and a lag is left, it is theirs, and what the
other readings have less of it is another thing (thrust that is ahead of its inflow, say).
Speeds that a low-pass made late are taken back through it (sensor_low_pass.py) where that leaves them
white; others are not used. The search is done again so.

Of six **synthetic** flights whose speeds came through low-passes of 8 Hz, averages over 50 ms or 20 ms
late, four had a motor lag for 3,900 to 34,000 nats, doubtful or denied by the vertical acceleration,
and stayed unexplained; one of 60 ms was 81 +- 11 and 81 +- 15 ms.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.fits import fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.sensor_low_pass import likeliest
from coax_env.estimation.low_pass import NONE
from coax_env.estimation.state_space import Noise, Record
from coax_env.estimation.whiteness import are_white, whiteness
from coax_env.model.layout import ROTOR_SPEEDS

LAG = "motor_lag"
"""The effect that speeds which come late look like."""
REMARK = (
    "measured rotor speeds come later than the rotors turn: a filter or a delay of their own. They"
    " were not used"
)
"""For who reads the findings."""


def come_late(problem: Problem, fit: Fit, coloured: bool = False) -> bool:
    """Whether rotor speeds come later than a motor's lag, if there is one, has them.

    Args:
        problem, fit: after a search. coloured: whether rotor speeds stay so with rotors that jitter.
    """
    if LAG not in fit.active or problem.aboard.isdisjoint(ROTOR_SPEEDS):
        return False
    channels = problem.model.channels
    others = problem.with_records(without_rotor_speeds(problem.engine.records, channels))
    if not others.aboard:
        return False
    trial = fitted(others, fit)
    gained = others.engine.log_likelihood(trial.values, fit.noise)
    gained -= others.engine.log_likelihood(fit.values, fit.noise)
    problem.report(f"a motor's lag without the measured rotor speeds: {gained:.1f} nats")
    if sum(trial.values[f.name] - fit.values[f.name] for f in problem.own[LAG]) >= 0.0:
        return False
    shown = whiteness(others.engine.filter(trial.values, trial.noise), channels)
    inflation = max((judged.inflation for judged in shown.values()), default=1.0)
    enough = problem.settings.evidence * inflation
    if gained < enough or coloured:
        return gained > enough
    off = problem.off_values(LAG) | problem.file_values(LAG)
    at_once = replace(trial.at(off), active=trial.rest(LAG))
    return fitted(others, at_once).objective - trial.objective < enough


def behind_low_pass(problem: Problem, fit: Fit, levels: Noise) -> Problem | None:
    """The problem with rotor speeds as they were before their low-pass; None where that is not what
    makes them late.

    Args:
        problem: with readings as logged. fit: to all others. levels: of rotor speeds, to start from.
    """
    read = [channel for channel in ROTOR_SPEEDS if channel in problem.aboard]
    noise = fit.noise.with_levels({channel: levels.reading[channel] for channel in read})
    low_pass, noise = likeliest(problem, replace(fit, noise=noise), noise, read, {})
    if low_pass == NONE:
        return None
    behind = problem.behind(dict.fromkeys(read, low_pass), problem.engine.records)
    shown = whiteness(behind.engine.filter(fit.values, noise), problem.model.channels)
    return behind if are_white(shown, read) else None


def without_rotor_speeds(records: Sequence[Record], channels: Sequence[str]) -> list[Record]:
    """Records without readings of rotor speeds.

    Args:
        records: with or without. channels: of their columns.
    """
    of_speeds = np.isin(channels, ROTOR_SPEEDS)
    return [replace(record, z=np.where(of_speeds, np.nan, record.z)) for record in records]
