"""What commands did between slow rows: held until the next, or on a straight line to it.

A log at 25 Hz has one command of four. Held until the next, each acts 15 ms late in the mean, which a
lag or a delay of the machine gives back: on six **synthetic** flights by telemetry motor lags of 60 ms
were 25 to 52, and the body's reaction to them 0.3 to 0.7 of its size. On straight lines to the next
row those of four are 56 to 78 ms. But the next command answers what gusts do within the row, which on
a clean flight makes straight lines 17 to 49 nats less likely. So beside the causes that were found,
straight lines are taken where they are likelier by a tie; else how far they have each number elsewhere
is a part of its std.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from coax_env.diagnosis.evidence import Evidence, as_far_apart
from coax_env.diagnosis.fits import converged, fitted, quadratic_at
from coax_env.diagnosis.from_afar import STEPS
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.searched import Searched
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Record

REMARK = (
    "commands between the rows are taken to be on straight lines from each to the next, which beside"
    " the causes is likelier than that they are held"
)
"""For who reads the findings."""


def on_straight_lines(records: Sequence[Record]) -> list[Record]:
    """Records whose commands are the means over a row of straight lines from each row to the next."""
    found = []
    for record in records:
        command = record.command.copy()
        command[:-1] = 0.5 * (record.command[:-1] + record.command[1:])
        found.append(replace(record, command=command))
    return found


def likelier_on_lines(found: Searched) -> Searched:
    """The same causes with commands on straight lines between slow rows, where they are likelier so.

    Args:
        found: with commands that are held.
    """
    problem, fit = found.problem, found.fit
    if not problem.has_slow_rows or not fit.active or found.changing is not None:
        return found
    lines, other = _on_lines(problem, fit)
    gained = fit.objective - other.objective
    if not gained > problem.settings.tie:
        return found
    problem.report(f"commands on straight lines between slow rows: {gained:.1f} nats")
    other, quadratic = quadratic_at(lines, other)
    return replace(found, problem=lines, fit=other, quadratic=quadratic, on_lines=True)


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
    _, other = _on_lines(problem, fit)
    return as_far_apart(problem, fit, quadratic, evidence, other)


def _on_lines(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """The problem with commands on straight lines, and the fit of the same effects to it."""
    lines = problem.with_records(on_straight_lines(problem.engine.records))
    return lines, converged(lines, fitted(lines, fit, STEPS))
