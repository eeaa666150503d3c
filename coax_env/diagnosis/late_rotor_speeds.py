"""Whether measured rotor speeds come late, by a filter or a delay of their own that the model lacks.

Motor controllers report speeds averaged over a turn or more, and late. In the speeds that is a motor's
lag; thrust and torque, which follow at once, deny it. So where a lag is found the model is fitted to
all other readings alone. Where these have less of it, speeds are taken back through their likeliest
low-pass (sensor_low_pass.py), and stay so if that leaves them white and is likelier than the lag. Else
they come late where the other readings are likelier so by the threshold, and nothing is left of the
lag, or speeds stay coloured beside it, with rotors that jitter too, as no lag of the motors leaves
them: such speeds are not used. Where speeds are white and a lag is left, it is theirs, and what the
other readings have less of it is another thing (thrust that is ahead of its inflow, say). By poses
alone, and between slow rows, commands that answer gusts make a lag look shorter: not asked there.

A lag that no other reading shows has no name (`by_speeds_alone`, doubts.py).

Four clean **synthetic** flights whose speeds came through a low-pass of 8 Hz, one in steps of 10
rev/min beside, an average over 50 ms, or 20 ms late had a motor lag of 3,900 to 34,000 nats that the
vertical acceleration denied, and stayed unexplained. So nothing is named on them, and nothing left.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from coax_env.diagnosis.fits import fitted, only
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.sensor_low_pass import likeliest
from coax_env.estimation.low_pass import NONE, LowPass, before_low_pass
from coax_env.estimation.state_space import Noise, Record
from coax_env.estimation.whiteness import are_white, whiteness
from coax_env.model.layout import ROTOR_SPEEDS

LAG = "motor_lag"
"""The effect that speeds which come late look like."""
LEAST = 3.0
"""nats by which other readings must be likelier with less of a lag, or no more is asked; chance reaches
it once in 40 flights whose rotors lag."""
ORDERS = (1, 2)
"""Of low-passes that are tried."""
TURNS = 2
"""Of a low-pass and all numbers, the lag's too, at most; ours."""
REMARK = (
    "measured rotor speeds come later than the rotors turn: a filter or a delay of their own. They"
    " were not used"
)
"""For who reads the findings."""


@dataclass(frozen=True)
class ByOthers:
    """What all readings but rotor speeds say of a motor's lag.

    problem: with these readings. fit: to them. gained: nats by which they are likelier so than by the
    fit to all.
    """

    problem: Problem
    fit: Fit
    gained: float

    @cached_property
    def enough(self) -> float:
        """nats that they must say, by how coloured they are."""
        passes = self.problem.engine.filter(self.fit.values, self.fit.noise)
        shown = whiteness(passes, self.problem.model.channels)
        inflation = max((judged.inflation for judged in shown.values()), default=1.0)
        return self.problem.settings.evidence * inflation

    @cached_property
    def show_lag(self) -> bool:
        """Whether they show a lag."""
        at_once = fitted(self.problem, only(self.problem, self.fit, self.fit.rest(LAG)))
        return at_once.objective - self.fit.objective >= self.enough


def with_less_lag(problem: Problem, fit: Fit) -> ByOthers | None:
    """The fit to all readings but rotor speeds, where these are likelier with less of a motor's lag.

    Args:
        problem, fit: after a search.
    """
    others = _others(problem, fit)
    if others is None:
        return None
    trial = fitted(others, fit)
    likelihood = others.engine.log_likelihood
    gained = likelihood(trial.values, fit.noise) - likelihood(fit.values, fit.noise)
    problem.report(f"a motor's lag without the measured rotor speeds: {gained:.1f} nats")
    less = sum(trial.values[f.name] - fit.values[f.name] for f in problem.own[LAG])
    return ByOthers(others, trial, gained) if gained > LEAST and less < 0.0 else None


def by_speeds_alone(problem: Problem, fit: Fit) -> bool:
    """Whether a motor's lag is in the fit that no other reading shows.

    Then nobody can tell the motors from what reads their speeds: in two clean **synthetic** flights of
    12 and 28 s, whose speeds came through a low-pass of 8 Hz, such a lag was worth 967 and 3,320 nats.

    Args:
        problem, fit: with the causes.
    """
    others = _others(problem, fit)
    if others is None:
        return False
    at_once = fit.at(problem.off_values(LAG))
    likelihood = others.engine.log_likelihood
    shown = likelihood(fit.values, fit.noise) - likelihood(at_once.values, fit.noise)
    return shown < problem.settings.evidence


def _others(problem: Problem, fit: Fit) -> Problem | None:
    """The problem of all readings but rotor speeds, where these may say something of a motor's lag."""
    if LAG not in fit.active or problem.aboard.isdisjoint(ROTOR_SPEEDS):
        return None
    others = without_speeds(problem)
    return None if others.sees_poses_alone or others.has_slow_rows else others


def behind_low_pass(problem: Problem, fit: Fit, others: ByOthers, noise: Noise) -> Problem | None:
    """The problem with rotor speeds as they were before a low-pass, where that is what makes them late.

    In the place of the lag, and, where the other readings show one, beside theirs: a low-pass of 8 Hz
    beside a lag of 0.17 s, taken for one low-pass, was not found (**synthetic**; a command delay stood
    for it).

    Args:
        problem, fit: with readings as logged, and a motor's lag. others: what all others say of it.
        noise: levels to start from: those of the fit have taken up what is wrong with it.
    """
    logged = problem.engine.log_likelihood(fit.values, fit.noise)
    lag, own = (
        float(np.mean([at.values[f.name] for f in problem.own[LAG]])) for at in (fit, others.fit)
    )
    starts = [(fit.at(problem.off_values(LAG)), lag)]
    if others.show_lag:
        starts.append((others.fit, max(lag - own, problem.row)))
    best, most = None, problem.settings.evidence
    for (begun, time), order in product(starts, ORDERS):
        found = _behind(problem, replace(begun, noise=noise), LowPass(time, order))
        if found is None:
            continue
        behind, nats = found
        problem.report(f"a low-pass in the place of a motor's lag: {nats - logged:.1f} nats")
        if nats - logged > most:
            best, most = behind, nats - logged
    return best


def _behind(problem: Problem, trial: Fit, low_pass: LowPass) -> tuple[Problem, float] | None:
    """The problem behind a low-pass of the rotor speeds, and the likelihood of what was logged; None
    where there is none, or these are not white then.

    Args:
        problem: with readings as logged. trial: where a fit begins, the motors' lag in it.
        low_pass: where its time is looked for first, of its order.
    """
    records, channels = problem.engine.records, problem.model.channels
    read = [channel for channel in ROTOR_SPEEDS if channel in problem.aboard]
    for _ in range(TURNS):
        passes = dict.fromkeys(read, low_pass)
        low_pass, levels = likeliest(problem, trial, trial.noise, read, passes)
        if low_pass == NONE:
            return None
        passes = dict.fromkeys(read, low_pass)
        behind = problem.behind(passes, records)
        trial = fitted(behind, replace(trial, noise=levels))
        seen = behind.engine.filter(trial.values, trial.noise)
        if are_white(whiteness(seen, channels), read):
            nats = sum(before_low_pass(record, channels, passes)[1] for record in records)
            return behind, nats + behind.engine.log_likelihood(trial.values, trial.noise)
    return None


def come_late(others: ByOthers, coloured: bool) -> bool:
    """Whether rotor speeds come later than a motor's lag, if there is one, has them.

    Args:
        others: what all other readings say of the lag.
        coloured: whether rotor speeds stay so with rotors that jitter.
    """
    return others.gained >= others.enough and (coloured or not others.show_lag)


def without_speeds(problem: Problem) -> Problem:
    """The problem without readings of rotor speeds."""
    records = without_rotor_speeds(problem.engine.records, problem.model.channels)
    return problem.with_records(records)


def without_rotor_speeds(records: Sequence[Record], channels: Sequence[str]) -> list[Record]:
    """Records without readings of rotor speeds.

    Args:
        records: with or without. channels: of their columns.
    """
    of_speeds = np.isin(channels, ROTOR_SPEEDS)
    return [replace(record, z=np.where(of_speeds, np.nan, record.z)) for record in records]
