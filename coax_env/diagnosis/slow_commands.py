"""What commands did between slow rows: held until the next, or on the way to it.

A log at 25 Hz has one command of four. Held until the next, each acts 15 ms late in the mean, which a
lag or a delay of the machine gives back: on six **synthetic** flights by telemetry motor lags of 60 ms
were 25 to 52, and the body's reaction to them 0.3 to 0.7 of its size. On straight lines to the next
row those of four are 56 to 78 ms. But the next command answers what gusts do within the row, which on
a clean flight makes straight lines 17 to 49 nats less likely. A log at 50 Hz has one command of two: a
quarter of the next one in the mean. So beside the causes that were found a command is taken to have
the share of the next one that is likeliest, if that is likelier by a tie; else, between slow rows, how
far straight lines have each number elsewhere is a part of its std.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.evidence import Evidence, as_far_apart
from coax_env.diagnosis.fits import converged, fitted, quadratic_at
from coax_env.diagnosis.from_afar import STEPS
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.searches.once import Searched
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Record
from coax_env.logs.held import interpolated

SLOWER = 0.015
"""s between rows from which it is asked: between 100 Hz, at which small machines are flown, and 50 Hz;
ours."""
ON_LINES = 0.5
"""Share of the next command in a row's where commands are on a straight line."""
MOST_KNOWN = 0.6
"""Share of the rows that are on no line at most, where commands are on lines: one of two, and some;
ours."""
SHARES = (0.125, 0.25, ON_LINES)
"""That are tried. On two **synthetic** flights at 50 Hz whose motors lag by 60 ms the first is 60 and
65 nats likelier than none, with lags of 60 ms for 57; the second is 142 and 127 less likely."""


def between_known(records: Sequence[Record]) -> float:
    """Time from one known command to the next where those between lie on straight lines [s]; else 0.

    A log whose commands came at another rate was put on one clock so: what was commanded between is
    not known. At 20 Hz a clean **synthetic** flight had a servo's lag of 37 nats.

    Args:
        records: of all runs.
    """
    found = []
    for record in records:
        on_lines = [interpolated(record.t, column) for column in record.command.T]
        known = 1.0 - float(np.mean(on_lines, axis=1).max())
        found.append((record.t[-1] - record.t[0]) / max(known * (record.t.size - 1), 1.0))
        if known > MOST_KNOWN:
            return 0.0
    return float(np.median(found))


def of_seldom(between: float) -> str:
    """That commands are known too seldom for some effects, for who reads the findings.

    Args:
        between: one known command and the next [s].
    """
    return (
        f"commands are known every {1e3 * between:.0f} ms only, with straight lines between: what looks"
        " like a weak or late answer to them was not asked for. Log them as they are sent"
    )


def remark(share: float) -> str:
    """What was done between the rows, for who reads the findings.

    Args:
        share: of the next command in a row's.
    """
    return (
        "commands between the rows are taken to be, in the mean, at"
        f" {share:.3g} of the way from each to the next, which beside the causes is likelier than that"
        " they are held"
    )


def on_the_way(records: Sequence[Record], share: float) -> list[Record]:
    """Records whose commands have a share of the next row's.

    Args:
        records: with commands as logged. share: ON_LINES are the means of straight lines.
    """
    found = []
    for record in records:
        command = record.command.copy()
        command[:-1] += share * (record.command[1:] - record.command[:-1])
        found.append(replace(record, command=command))
    return found


def likelier_on_the_way(found: Searched) -> Searched:
    """The same causes with commands on the way to the next row's, where they are likelier so.

    Args:
        found: with commands that are held.
    """
    problem, fit = found.problem, found.fit
    if not problem.row > SLOWER or not fit.active or found.changing is not None:
        return found
    trials = {share: _fitted(problem, fit, share) for share in SHARES}
    share = min(trials, key=lambda s: trials[s][1].objective)
    between, other = trials[share]
    gained = fit.objective - other.objective
    if not gained > problem.settings.tie:
        return found
    problem.report(f"commands at {share:g} of the way to the next row's: {gained:.1f} nats")
    other, quadratic = quadratic_at(between, other)
    return replace(found, problem=between, fit=other, quadratic=quadratic, of_next=share)


def beside_straight_lines(
    problem: Problem, fit: Fit, quadratic: Quadratic, evidence: Mapping[str, Evidence]
) -> Fit:
    """The fit whose std of each number has in it what commands on straight lines make of it.

    Args:
        problem, fit: with the causes, and commands that are held. quadratic: linearised at the fit.
        evidence: of the causes.
    """
    if not problem.has_slow_rows or not fit.active:
        return fit
    _, other = _fitted(problem, fit, ON_LINES)
    return as_far_apart(problem, fit, quadratic, evidence, other)


def _fitted(problem: Problem, fit: Fit, share: float) -> tuple[Problem, Fit]:
    """The problem with commands on the way to the next row's, and the fit of the same effects to it."""
    between = problem.with_records(on_the_way(problem.engine.records, share))
    return between, converged(between, fitted(between, fit, STEPS))
