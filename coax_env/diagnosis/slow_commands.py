"""What commands did between slow rows (estimation/between_rows.py), of a machine that lacks something.

Held until the next, each command acts half a row late in the mean: on six **synthetic** flights by
telemetry motor lags of 60 ms were 25 to 52, and the body's reaction to them 0.3 to 0.7 of its size. On
straight lines to the next row those of four are 56 to 78 ms. But the next command answers what gusts do
within the row, which on a clean flight makes straight lines 17 to 49 nats less likely. Without the
variance of a command that changes anywhere in a row, at 25 Hz in still air, a turned swash plate had a
thrust exponent beside it, 44 and 64 nats (**synthetic**).

So before anything is named a command is taken to have the share of the next one, and that variance or
none, that are likeliest together, if that is likelier by a tie; beside the causes that were found the
share is asked again. A model that is wrong looks like rows believed less, too: where innovations stay
much coloured commands are held if the fitted runs are flown nearer so. On a **real** helicopter at
25 Hz "changing at unknown times" is worth 30 to 38 nats by the model as given on three of four choices
of the held-out run; held on two of these it removes 63 % of the error on `15ft_1` (43 to 70) where it
removed 21 % (-21 to 47), and as much as before on the other. Between slow rows where neither is
likelier how far straight lines have each number elsewhere is a part of its std.

A rotor without lag turns the body as a command is sent: what it ends a row above its mean is given to
the step (`HeliModel.inputs`), and the search is done from that reaction, too (`from_reaction`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.evidence import Evidence, as_far_apart
from coax_env.diagnosis.fits import converged, fitted, noise_fitted, quadratic_at
from coax_env.diagnosis.from_afar import STEPS
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.searches.once import Searched, as_given, likelier
from coax_env.estimation.between_rows import (
    HELD,
    ON_LINES,
    SLOWER,
    TRIED,
    Between,
    likelihoods,
    of_rows,
    with_between,
)
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Noise, Record
from coax_env.logs.held import interpolated

MOST_KNOWN = 0.6
"""Share of the rows that are on no line at most, where commands are on lines: one of two, and some;
ours."""
REACTION = "spin_up_reaction"


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


def likeliest_between(problem: Problem, noise: Noise) -> Problem:
    """The problem whose commands are between the rows as is likeliest by the model as given.

    Args:
        problem: with commands that are held. noise: levels to start from.
    """
    if not problem.row > SLOWER:
        return problem
    return likeliest_at(problem, as_given(problem, noise)[1])


def likeliest_at(problem: Problem, fit: Fit) -> Problem:
    """The problem whose commands are between the rows as is likeliest at a fit.

    Args:
        problem: with commands that are held, of slow rows. fit: of anything.
    """
    fits = [fit, *_with_reaction(problem, fit)]
    nats = [likelihoods(problem.engine, f.values, f.noise) for f in fits]
    of_fit = max(nats, key=lambda of_fit: max(of_fit.values()))
    likeliest = max(of_fit, key=lambda of: of_fit[of])
    gained = of_fit[likeliest] - of_fit[HELD]
    if not gained > problem.settings.tie:
        return problem
    problem.report(f"{likeliest}: {gained:.1f} nats")
    return _between(problem, likeliest)


def _with_reaction(problem: Problem, fit: Fit) -> list[Fit]:
    """A fit whose rotors react on the body as they must, if it is to be found whether they do.

    That a rotor without lag turns the body as a command is sent shows when commands were sent.
    """
    if REACTION not in problem.candidates or REACTION in fit.active:
        return []
    return [replace(fit.at({f"{REACTION}.gain": 1.0}), active=(*fit.active, REACTION))]


def from_reaction(found: Searched) -> Searched:
    """The search again from rotors that react as they must, where the model as given is likelier so.

    Between slow rows a reaction that no model has looks like a large gust in each, in which a yaw
    damping explains more: 304 nats, where the reaction ends 375 likelier than three such causes
    (**synthetic**, at 50 Hz).

    Args:
        found: the first search.
    """
    problem = found.problem
    if not problem.row > SLOWER or REACTION in found.fit.active:
        return found
    for begun in _with_reaction(problem, found.refitted):
        trial = converged(problem, fitted(problem, noise_fitted(problem, begun)))
        if trial.objective < found.fit.objective - problem.settings.tie:
            problem.report("searching again from rotors that react on the body as they must")
            return likelier(found, trial)
    return found


def held_after_all(found: Searched) -> Problem | None:
    """The problem with commands that are held, where that is likelier by a tie beside what was found.

    What is late looks, before it is found, like commands that changed within the rows.

    Args:
        found: with commands that are on the way or not known, or not.
    """
    if are_held(found.problem) or not found.fit.active:
        return None
    held = with_held(found.problem)
    ends = [fitted(p, noise_fitted(p, found.fit)).objective for p in (found.problem, held)]
    return held if ends[1] < ends[0] - found.problem.settings.tie else None


def are_held(problem: Problem) -> bool:
    """Whether commands are taken to be held between the rows."""
    return of_rows(problem.engine.records) == HELD


def with_held(problem: Problem) -> Problem:
    """The problem with commands that are held between the rows."""
    return _between(problem, HELD)


def _between(problem: Problem, between: Between) -> Problem:
    return problem.with_records(with_between(problem.engine.records, between))


def likelier_on_the_way(found: Searched) -> Searched:
    """The same causes with another share of the next row's command, where they are likelier so.

    Args:
        found: with what was likeliest before they were found.
    """
    problem, fit = found.problem, found.fit
    if not problem.row > SLOWER or not fit.active or found.changing is not None:
        return found
    now = of_rows(problem.engine.records)
    trials = {
        of: _fitted(problem, fit, of) for of in TRIED if of.variance == now.variance if of != now
    }
    likeliest = min(trials, key=lambda of: trials[of][1].objective)
    between, other = trials[likeliest]
    gained = fit.objective - other.objective
    if not gained > problem.settings.tie:
        return found
    problem.report(f"{likeliest}: {gained:.1f} nats")
    other, quadratic = quadratic_at(between, other)
    return replace(found, problem=between, fit=other, quadratic=quadratic)


def beside_straight_lines(
    problem: Problem, fit: Fit, quadratic: Quadratic, evidence: Mapping[str, Evidence]
) -> Fit:
    """The fit whose std of each number has in it what commands on straight lines make of it.

    Args:
        problem, fit: with the causes, and commands that are held. quadratic: linearised at the fit.
        evidence: of the causes.
    """
    now = of_rows(problem.engine.records)
    if not problem.has_slow_rows or not fit.active or now.share:
        return fit
    _, other = _fitted(problem, fit, now._replace(share=ON_LINES))
    return as_far_apart(problem, fit, quadratic, evidence, other)


def _fitted(problem: Problem, fit: Fit, between: Between) -> tuple[Problem, Fit]:
    """The problem with other commands between the rows, and the fit of the same effects to it."""
    other = _between(problem, between)
    return other, converged(other, fitted(other, fit, STEPS))
