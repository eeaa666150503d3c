"""Does a cause begin, or change, while the machine flies? Its moment, with interval and worth.

A change at every moment is scored at once, at the gains of the filter without it (a generalised
likelihood ratio; Willsky and Jones 1976; Basseville and Nikiforov 1993, ch. 7; beginnings.py).
What stands out is fitted, noise levels too, at the moment that the likelihood itself prefers, and must
pay: for its numbers by their Occam factor, and for its moment, which could have been any, by the share
of the flown time that the data leave for it. No change is preferred to one that pays less than the
evidence of a name, a cause that was always there to one that pays less than a tie beside it. A gust
that is over within a second is no change.

What comes may come at once or grow evenly to its size. It is said to grow where that is worth more than
a tie beside a step; where it is not worth that, the interval of the moment has both in it (growth.py).

Changes last to the end of the last run: the machine is what it is then. Where one is found, causes are
searched for again beside it: without it, others may have stood in its place.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from coax_env.diagnosis.confounding import alternatives
from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.fits import fitted, linearise, without_drifts
from coax_env.diagnosis.input_innovations import has_command_gains, with_command_gains
from coax_env.diagnosis.onsets.changing import Changing, Onset, beginning, may_begin
from coax_env.diagnosis.onsets.every_moment import Scored, scored
from coax_env.diagnosis.onsets.growth import changing_model
from coax_env.diagnosis.onsets.trial import fitted_change
from coax_env.diagnosis.problem import WEAK_OR_LATE, Fit, Problem, exclusive_with
from coax_env.diagnosis.scores import cost
from coax_env.diagnosis.search import search
from coax_env.diagnosis.shocks import ABOUT
from coax_env.estimation.changing_model import Lap
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.whiteness import Whiteness

DRIFTED = 0.5
"""Share of what drifts and long gusts are worth that a change must be without them, where it is worth
nothing beside them. Fitted without a change, they take some of it up: on eight synthetic flights of
test_onset.py the true ones were worth 0.28 to 1.4 of it, and 21 nats at least beside them; on three
without a change nothing was worth more than 0.19, and 5 nats; ours."""
MOST_ONSETS = 2
"""Changes that are looked for, one after the other; ours, a bound on time."""


def with_onsets(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    bare: Fit,
    clock: Mapping[str, Lap],
    first: Moment | None = None,
) -> Changing:
    """The model with what begins or changes in flight, where that pays; as it is where nothing does.

    Args:
        problem, fit: after the search.
        quadratic: linearised at the fit.
        bare: the fit without any cause, from which a search begins again.
        clock: of all runs in the order in which they were flown.
        first: where the first change is looked for; default anywhere.
    """
    state = Changing(problem, fit, quadratic, {})
    for _ in range(MOST_ONSETS):
        problem.report("asking whether something began in flight")
        found = _next(state, clock, None if state.onsets else first)
        if found is None:
            break
        trial, onset = found
        problem.report(f"{onset.effect} since {onset.t:.2f} s of {onset.moment.run}:"
                       f" {onset.nats:.1f} nats")  # fmt: skip
        after = _searched_again(trial, bare, {**state.onsets, onset.effect: onset})
        if onset.effect not in after.onsets:
            break  # it was another cause's work
        if not set(after.onsets) >= set(state.onsets) and _cost_of(state) < _cost_of(after):
            break  # it would stand in an earlier one's place, and do worse
        state = after
    return state


def most_by_change(problem: Problem, fit: Fit, quadratic: Quadratic) -> float:
    """nats that any one change is worth at most by its score, as a step, before it is fitted.

    Args:
        problem, fit: after the search. quadratic: linearised at the fit.
    """
    _, found = scored(Changing(problem, fit, quadratic, {}))
    return max((s.nats for s in found), default=0.0)


def _next(
    state: Changing, clock: Mapping[str, Lap], about: Moment | None
) -> tuple[Changing, Onset] | None:
    """The change that is worth most once fitted, where it pays; about a moment, if one is given."""
    chosen = state.problem.settings
    best = None
    steady, found = scored(replace(state, fit=without_drifts(state.fit)))
    near = [s for s in _standing(state.problem, found) if about is None or _is_about(s.moment, about)]
    near = _beyond_drifts(state, steady, near)
    if near and near[0].nats < chosen.clear:
        near = _beside_commands(steady, near)
    for candidate in near[: chosen.most_trials]:
        trial = fitted_change(state, steady, candidate, clock, best)
        if trial is None:
            continue
        onset = trial.onset
        worth = f"{onset.nats:.1f} nats" if math.isfinite(onset.nats) else "does not hold"
        state.problem.report(f"{onset.effect} since {onset.t:.2f} s: {worth}, fitted")
        if onset.nats > (best.onset.nats if best else _least(state, onset.effect)):
            best = trial
    return (best.state, best.onset) if best else None


def _is_about(moment: Moment, other: Moment) -> bool:
    return moment.run == other.run and abs(moment.t - other.t) <= ABOUT


def _standing(problem: Problem, found: Sequence[Scored]) -> list[Scored]:
    """Those that are worth a fit: beside no change, and beside a cause that was always there."""
    share, tie = problem.settings.trial_share, problem.settings.tie
    return [
        s for s in found if s.nats > share * _evidence(problem, s.effect) and s.beside > share * tie
    ]


def _evidence(problem: Problem, effect: str) -> float:
    """nats that a change must be worth to be named.

    More of what looks like a weak or late answer where commands answer what is not seen: a servo that
    got late in flight, behind a low-pass that was not there, was worth 28 nats on a clean **synthetic**
    flight in gusts with a frequency. By poses alone a constant delay, too: from some moment on it has
    but a part of the flight to stand on.
    """
    unseen = effect in WEAK_OR_LATE and (problem.sees_poses_alone or problem.answers_unseen)
    return problem.settings.evidence * (problem.unseen_times if unseen else 1.0)


def _beyond_drifts(state: Changing, steady: Changing, near: Sequence[Scored]) -> list[Scored]:
    """Those that the noise as it was fitted, drifts too, does not explain as well.

    Args:
        state: in that noise. steady: the same in steady noise. near: changes scored in that.
    """
    if not near or steady.fit.noise.process == state.fit.noise.process:
        return list(near)
    drifting, stand = _still_standing(replace(state, problem=_asking(state, near)))
    explained = steady.fit.objective - drifting.fit.objective
    return [s for s in near if s.nats > DRIFTED * explained or s.effect in stand]


def _beside_commands(steady: Changing, near: Sequence[Scored]) -> list[Scored]:
    """Those that stand where commands show the gusts, too.

    A pilot who flies gusts out looks like a servo that gets late (input_innovations.py).
    """
    wider, fit = with_command_gains(_asking(steady, near), steady.fit, coloured=True)
    if not has_command_gains(wider):
        return list(near)
    _, stand = _still_standing(replace(steady, problem=wider, fit=fit))
    return [s for s in near if s.effect in stand]


def _asking(state: Changing, near: Sequence[Scored]) -> Problem:
    """The problem with no other candidates than what is active and these."""
    return state.problem.of_candidates({*state.fit.active, *(s.effect for s in near)})


def _still_standing(state: Changing) -> tuple[Changing, set[str]]:
    """The state scored, and the effects whose change is worth a fit in it."""
    state, found = scored(state)
    return state, {s.effect for s in _standing(state.problem, found)}


def _least(state: Changing, effect: str) -> float:
    """nats that a change is worth at least: as a name, or beside one that stands already, a tie.

    Of what is weak or late as a name there, too: its form is never quite the machine's, and one run
    shows another time than the next (a constant delay of 40 ms, **synthetic**, "changed" by 9 ms: 10
    nats).
    """
    if effect not in state.fit.active:
        return _evidence(state.problem, effect)
    chosen = state.problem.settings
    return chosen.evidence if effect in WEAK_OR_LATE else chosen.tie


def _searched_again(trial: Changing, bare: Fit, onsets: Mapping[str, Onset]) -> Changing:
    """Causes searched for beside a change: from those that there are, and from none; the better."""
    problem = trial.problem
    begun = [trial.fit]
    if set(trial.fit.active) > set(onsets):
        own = {n: v for n, v in trial.fit.values.items() if n.partition(".")[0] in onsets}
        alone = replace(bare.at(own), active=tuple(onsets), noise=trial.fit.noise,
                        levels=trial.fit.levels)  # fmt: skip
        begun.append(fitted(problem, alone))
    ended = [search(problem, fit) for fit in begun]
    fit, quadratic = min(ended, key=lambda e: cost(problem, *e))
    kept = {e: onset for e, onset in onsets.items() if e in fit.active}
    return Changing(problem, fit, quadratic, kept)


def _cost_of(state: Changing) -> float:
    return cost(state.problem, state.fit, state.quadratic)


def beside_onsets(
    problem: Problem,
    fit: Fit,
    evidence: Mapping[str, Evidence],
    white: Mapping[str, Whiteness],
    onsets: Mapping[str, Onset],
) -> dict[str, dict[str, Fit]]:
    """The confounded alternatives of causes that began or changed: effects that begin when they do.

    Args:
        problem, fit: with the causes.
        evidence: of each cause.
        white: whiteness of the innovations, by channel.
        onsets: of causes that began or changed.
    """
    found: dict[str, dict[str, Fit]] = {}
    for effect, onset in onsets.items():
        others = [e for e in may_begin(problem, fit, onsets) if e not in fit.active]
        others += [e for e in exclusive_with(effect) if e in problem.candidates]
        moments = {e: onset.moment for e in others if e not in fit.active}
        then = beginning(problem, fit, moments, changing_model(problem).clock)
        there, _, quadratic = linearise(then, fit)
        found |= alternatives(then, there, quadratic, evidence, white, [effect])
    return found
