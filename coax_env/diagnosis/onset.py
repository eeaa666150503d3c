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
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from coax_env.diagnosis.confounding import alternatives, channels_of
from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.fits import (
    converged,
    fitted,
    linearise,
    noise_fitted,
    quadratic_at,
    without_drifts,
)
from coax_env.diagnosis.growth import Growth, changing, growing, profiled, with_moment
from coax_env.diagnosis.input_innovations import has_command_gains, with_command_gains
from coax_env.diagnosis.problem import Fit, Problem, exclusive_with
from coax_env.diagnosis.search import search
from coax_env.diagnosis.settings import Settings
from coax_env.estimation.beginnings import Asked, Beginning
from coax_env.estimation.changing_model import BEFORE, ChangingModel, Lap, before
from coax_env.estimation.engine import Engine, RunPass, objective
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.parted_engine import AT, of_part
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Record
from coax_env.estimation.whiteness import Whiteness, whiteness

NEVER_BEGINS = frozenset(
    {"wind", "battery_sag", "ground_effect", "battery_voltage", "trim_drift", "wake_interference",
     "gyroscopic_coupling", "spin_up_reaction", "dynamic_inflow", "sonar_tilt", "thrust_exponent"}
)  # fmt: skip
"""What belongs to air, ground and battery, and laws of motion and flow that no damage changes."""
SPACING = 0.01
"""s between the moments that are scored at once: every row of a log at 100 Hz. What jumps in a reading,
as thrust does in specific force, shows at its own row and is gone 0.02 s beside it; ours."""
MOST_MOMENTS = 6000
"""On long flights they are farther apart than that; ours, a bound on time."""
MARGIN = 1.5
"""s from the first row of all, and to the last, in which nothing begins: the filter settles in one, and
what lasts a second cannot be told from a gust; ours."""
SETTLED = 1.0
"""s of a run after which a change in it can be told from its start; ours."""
MOST_ONSETS = 2
"""Changes that are looked for, one after the other; ours, a bound on time."""
NEAR = 1.0
"""s to both sides of a moment in which the likelihood is asked for a better one first; ours."""
AFAR = 20
"""Other moments of its run that it is asked for, evenly spaced; ours, a bound on time."""
FADED = 10.0
"""nats under the best moment's from which on another has no share in the interval; ours."""
SMOOTH = 0.5
"""nats by which two moments may differ for a line between them to do; ours."""
CLEAR = 3.0
"""Thresholds by which a change is likelier than a model without it, to need no closer fit of that: a
name's, what numbers and moment cost, and what a close fit finds; ours."""
MADE_UP = 300.0
"""nats that a change, fitted as a step, may still gain beyond what the best so far gained from then on.
Measured on eight synthetic flights (study_changes.py, seed 40): 260 at most, of 15 rivals; ours."""
OVER = (0.5, 1.5)
"""s before and after a moment in which a gust may have made the evidence; ours."""


@dataclass(frozen=True)
class Onset:
    """When a cause began, or changed.

    Attributes:
        effect: the cause.
        moment: the best by likelihood; it is the model's.
        t, std: mean and std of its posterior in that run [s].
        width: s that this posterior is wide; of what grows, `Growth.width`.
        nats: what it is worth to have the change, its price paid.
        growth: as what grows, where that was fitted.
        at_once: probability that it came at once, and did not grow.
        grown: when it had its size, and the std of that [s]; None where the model has a step.
        run: in which t is, where that is not the moment's.
    """

    effect: str
    moment: Moment
    t: float
    std: float
    width: float
    nats: float
    growth: Growth | None = None
    at_once: float = 1.0
    grown: tuple[Moment, float] | None = None
    run: str = ""

    def entry(self) -> dict[str, Any]:
        """findings.json's `since`."""
        until = None
        if self.grown is not None:
            moment, std = self.grown
            until = {"run": moment.run, "t": moment.t, "std": std}
        return {"run": self.run or self.moment.run, "t": self.t, "std": self.std,
                "at_once": round(self.at_once, 4), "grown": until}  # fmt: skip


@dataclass(frozen=True)
class Changing:
    """A problem in which some causes begin or change, the fit, the quadratic at it, and the onsets."""

    problem: Problem
    fit: Fit
    quadratic: Quadratic
    onsets: Mapping[str, Onset]


def with_onsets(
    problem: Problem, fit: Fit, quadratic: Quadratic, bare: Fit, clock: Mapping[str, Lap]
) -> Changing:
    """The model with what begins or changes in flight, where that pays; as it is where nothing does.

    Args:
        problem, fit: after the search.
        quadratic: linearised at the fit.
        bare: the fit without any cause, from which a search begins again.
        clock: of all runs in the order in which they were flown.
    """
    state = Changing(problem, fit, quadratic, {})
    for _ in range(MOST_ONSETS):
        problem.report("asking whether something began in flight")
        found = _next(state, clock)
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


# --- every moment at once ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Scored:
    """What a change of one effect is worth, by the quadratic. nats: over all moments. moment: the best.

    move: name -> what changes there, or where it ends, what was there before. beside: what it is worth
    beside the same cause that was always there.
    """

    effect: str
    nats: float
    moment: Moment
    move: Mapping[str, float]
    ends: bool
    beside: float


def scored(state: Changing) -> tuple[Changing, list[Scored]]:
    """Effects that may have begun, changed or ended, by what that is worth at any moment, best first.

    Args:
        state: a fit, wherever its quadratic was taken.

    Returns:
        the state with its objective and the quadratic at it, and the effects.
    """
    problem, fit = state.problem, state.fit
    names = {e: _own(problem, e) for e in may_begin(problem, fit, state.onsets)}
    records = problem.engine.records
    rows = rows_of(records)
    everything = problem.parameters
    passes, lin, found = problem.engine.beginnings(
        fit.values, fit.noise, everything, rows, _asked(problem, fit, names)
    )
    fit = replace(fit, objective=objective(passes, problem.free(fit.active), fit.values))
    state = replace(state, fit=fit, quadratic=Quadratic.of(lin, everything, fit.values))
    table = _Table.of(state, names)
    every = [
        (Moment(record.whole, float(record.t[b.row])), table.row_of(b))
        for record, of_run in zip(records, found, strict=True)
        for b in of_run
    ]
    if not every:
        return state, []
    slopes, information, crossed = (
        np.array(part) for part in zip(*(r for _, r in every), strict=True)
    )
    ended = table.ended(slopes, information, crossed)
    best = []
    for k, (effect, own) in enumerate(names.items()):
        forms, always = [(False, *table.worth(k, slopes, information))], 0.0
        if effect not in fit.active:
            forms.append((True, *table.worth(k, *ended)))
            always = max(0.0, table.worth_of_constant(k))
        of_effect = []
        for ends, nats, moves in forms:
            if np.isfinite(nats).any():
                at = int(np.argmax(nats))
                total = float(logsumexp(nats)) - math.log(len(every))  # each as likely as any other
                move = dict(zip(own, moves[at].tolist(), strict=True))
                moment = every[at][0]
                of_effect.append(Scored(effect, total, moment, move, ends, total - always))
        best += sorted(of_effect, key=lambda s: -s.nats)[:1]
    return state, sorted(best, key=lambda s: -s.nats)


def may_begin(problem: Problem, fit: Fit, onsets: Collection[str]) -> list[str]:
    """Effects that the machine may get or lose in flight, and that have no moment yet.

    Args:
        problem, fit: with what was found so far. onsets: effects that have a moment.
    """
    others = [e for e in problem.candidates if e not in NEVER_BEGINS and e not in onsets]
    active = set(fit.active)
    return [e for e in others if e in active or not exclusive_with(e) & active]


def _own(problem: Problem, effect: str) -> list[str]:
    """Plain names of an effect's numbers that act."""
    return [n for n in problem.acting_names(effect) if not n.endswith(BEFORE)]


def rows_of(records: Sequence[Record]) -> list[np.ndarray]:
    """Rows of each record at which something may begin: its first one, and every SPACING later on."""
    spacing = max(SPACING, sum(float(r.t[-1] - r.t[0]) for r in records) / MOST_MOMENTS)
    found = []
    for i, record in enumerate(records):
        t = record.t
        times = np.arange(t[0] + SETTLED, t[-1], spacing)
        if i > 0:
            times = np.append(t[0], times)
        else:
            times = times[times > t[0] + MARGIN]
        if i == len(records) - 1:
            times = times[times < t[-1] - MARGIN]
        found.append(np.unique(np.searchsorted(t, times - 1e-9)).astype(np.int64))
    return found


def _asked(problem: Problem, fit: Fit, names: Mapping[str, Sequence[str]]) -> Asked:
    """What a score takes of every row: beside what is free, and pairs of each effect's numbers."""
    places = {f.name: k for k, f in enumerate(problem.parameters)}
    groups = [np.array([places[n] for n in own], np.int64) for own in names.values()]
    return Asked(
        np.array([places[n] for n in problem.free_names(fit.active)], np.int64),
        np.concatenate([np.repeat(c, c.size) for c in groups]),
        np.concatenate([np.tile(c, c.size) for c in groups]),
    )


@dataclass(frozen=True)
class _Table:
    """What the score of a change takes that does not depend on its moment.

    later: information (k, k) and slope_later: slope (k,) of all records behind each one. rest: places
    of what is free beside a change, inverse: (r, r) of its information and prior, pull: (r,) its slope.
    groups: places of each effect's numbers, smallest: sizes that matter of these, pairs: places of the
    groups' matrices.

    Variances are not inflated by the colour of the innovations: what changed and is not in the model
    yet colours them itself, and most of all the scores of its own numbers.
    """

    quadratic: Quadratic
    later: Sequence[np.ndarray]
    slope_later: Sequence[np.ndarray]
    rest: np.ndarray
    inverse: np.ndarray
    pull: np.ndarray
    groups: Sequence[np.ndarray]
    smallest: Sequence[np.ndarray]
    pairs: tuple[np.ndarray, np.ndarray]
    swapped: np.ndarray

    @classmethod
    def of(cls, state: Changing, names: Mapping[str, Sequence[str]]) -> "_Table":
        """At a fit, for effects with these numbers."""
        problem, quadratic = state.problem, state.quadratic
        assert quadratic.parts is not None
        asked = _asked(problem, state.fit, names)
        rest = asked.beside
        pull = quadratic.g + quadratic.precision * (quadratic.at - quadratic.mean)
        known = quadratic.G[np.ix_(rest, rest)] + np.diag(quadratic.precision[rest])
        groups = [quadratic.index(own) for own in names.values()]
        firsts = np.cumsum([0, *(c.size**2 for c in groups)])
        sizes = {
            f"{e}.{p.name}": max(p.smallest, 1e-12) for e in names for p in problem.model.sized(e)
        }
        return cls(
            quadratic,
            _behind(quadratic.parts.information),
            _behind(quadratic.parts.slope),
            rest,
            cho_solve(cho_factor(known), np.eye(rest.size)),
            pull[rest],
            groups,
            [np.array([sizes[n] for n in own]) for own in names.values()],
            (asked.first, asked.second),
            np.concatenate(
                [first + np.arange(c.size**2).reshape(c.size, c.size).T.ravel()
                 for first, c in zip(firsts, groups, strict=False)]
            ),
        )  # fmt: skip

    def row_of(self, b: Beginning) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slope and information of every effect's numbers that move from there on, and information
        across them and those that always were, what is free beside them projected out: (k,) of all
        numbers, and the groups' matrices, row by row.
        """
        later = self.later[b.record]
        across = b.across + later[:, self.rest]
        weights = across @ self.inverse
        slope = b.slope + self.slope_later[b.record] - weights @ self.pull
        i, j = self.pairs
        of_rest, behind = across[i], later[i, j]
        own = b.own + behind - np.einsum("pr,pr->p", of_rest, weights[j])
        crossed = b.crossed + behind - np.einsum("pr,pr->p", of_rest, self.always[1][j])
        return slope, own, crossed

    @cached_property
    def always(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slope (k,) of numbers that always were, their weights on what is free beside them (k, r), and
        the groups' information.
        """
        across = self.quadratic.G[:, self.rest]
        weights = across @ self.inverse
        i, j = self.pairs
        own = self.quadratic.G[i, j] - np.einsum("pr,pr->p", across[i], weights[j])
        return self.quadratic.g - weights @ self.pull, weights, own

    def ended(
        self, slopes: np.ndarray, information: np.ndarray, crossed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Slopes and information of what was there up to each row: of what always was, less what moves
        from there on.

        Args:
            slopes, information, crossed: `row_of` all rows, stacked.
        """
        slope, _, own = self.always
        return slope - slopes, own - crossed - crossed[:, self.swapped] + information

    def worth_of_constant(self, k: int) -> float:
        """What one effect is worth that was always there [nats]; k: its place."""
        slope, _, own = self.always
        return float(self.worth(k, slope[None], own[None])[0][0])

    def worth(
        self, k: int, slopes: np.ndarray, information: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """What a change of one effect is worth from each row on [nats], and how its numbers move.

        Where bounds are met the move is cut off there: it is worth that at least.

        Args:
            k: the effect's place. slopes, information: `row_of` all rows, stacked.
        """
        q, c = self.quadratic, self.groups[k]
        first = sum(group.size**2 for group in self.groups[:k])
        prior = q.precision[c]
        A = information[:, first : first + c.size**2].reshape(-1, c.size, c.size) + np.diag(prior)
        slope = slopes[:, c]
        x = np.linalg.solve(A, -slope[:, :, None])[:, :, 0]
        x = np.clip(x, (q.lower - q.at)[c], (q.upper - q.at)[c])
        gained = -np.sum((slope + 0.5 * np.einsum("nij,nj->ni", A, x)) * x, axis=1)
        occam = 0.5 * np.linalg.slogdet(A / np.sqrt(np.outer(prior, prior)))[1]
        large = np.any(np.abs(x) >= self.smallest[k], axis=1)
        return np.where(large, gained - occam, -math.inf), x


def _behind(parts: np.ndarray) -> list[np.ndarray]:
    """Sums over the records behind each one; parts: (records, ...)."""
    total = parts.sum(0)
    return list(total - np.cumsum(parts, axis=0))


# --- one change, fitted -----------------------------------------------------------------------------


def _next(state: Changing, clock: Mapping[str, Lap]) -> tuple[Changing, Onset] | None:
    """The change that is worth most once fitted, where it pays."""
    chosen = state.problem.settings
    best = None
    steady, found = scored(replace(state, fit=without_drifts(state.fit)))
    near = _standing(found, chosen)
    if near and near[0].nats < chosen.clear_evidence * chosen.evidence:
        near = _beside_commands(steady, near)
    for candidate in near[: chosen.most_trials]:
        trial = _fitted(state, steady, candidate, clock, best)
        if trial is None:
            continue
        onset = trial.onset
        state.problem.report(f"{onset.effect} since {onset.t:.2f} s: {onset.nats:.1f} nats, fitted")
        if onset.nats > (best.onset.nats if best else _least(state, onset.effect)):
            best = trial
    return (best.state, best.onset) if best else None


@dataclass(frozen=True)
class Trial:
    """A change that was fitted. gained: nats by all that was fitted after its step."""

    state: Changing
    onset: Onset
    gained: float

    def is_out_of_reach(self, state: Changing, step: Fit) -> bool:
        """Whether another change cannot come to be worth as much any more, fitted as a step so far.

        It is worth what its likelihood gains, at most: a price is paid of that, and without a change
        the model is as likely as the state's at least.

        Args:
            state: without either change. step: the other one, in the noise that this one's step had.
        """
        missing = self.onset.nats - (state.fit.objective - step.objective)
        return missing > max(self.gained, 0.0) + MADE_UP


def _standing(found: Sequence[Scored], chosen: Settings) -> list[Scored]:
    """Those that are worth a fit: beside no change, and beside a cause that was always there."""
    least, tie = chosen.trial_share * chosen.evidence, chosen.trial_share * chosen.tie
    return [s for s in found if s.nats > least and s.beside > tie]


def _beside_commands(steady: Changing, near: Sequence[Scored]) -> list[Scored]:
    """Those that stand where commands show the gusts, too.

    A pilot who flies gusts out looks like a servo that gets late (input_innovations.py).
    """
    wider, fit = with_command_gains(steady.problem, steady.fit, coloured=True)
    if not has_command_gains(wider):
        return list(near)
    _, again = scored(replace(steady, problem=wider, fit=fit))
    stand = {s.effect for s in _standing(again, steady.problem.settings)}
    return [s for s in near if s.effect in stand]


def _least(state: Changing, effect: str) -> float:
    """nats that a change is worth at least: as a name, or beside one that stands already, a tie."""
    chosen = state.problem.settings
    return chosen.tie if effect in state.fit.active else chosen.evidence


def beginning(
    problem: Problem, fit: Fit, moments: Mapping[str, Moment], clock: Mapping[str, Lap]
) -> Problem:
    """The problem in which effects begin at moments of theirs, or change where they are active.

    Args:
        problem, fit: with what was found so far. moments: of the effects.
        clock: of all runs, in the order in which they were flown.
    """
    model = ChangingModel(problem.model.base, {**problem.model.moments, **moments}, clock)
    own = dict(problem.own)
    for effect in moments:
        if effect in fit.active and not problem.changes(effect):
            acting = set(problem.acting_names(effect))
            own[effect] += tuple(before(f) for f in own[effect] if f.name in acting)
    return replace(problem, own=own).with_model(model)


def _fitted(
    state: Changing,
    steady: Changing,
    candidate: Scored,
    clock: Mapping[str, Lap],
    best: Trial | None,
) -> Trial | None:
    """A change fitted at its best moment, and what it is worth beside the state without it.

    None where the filter diverges with it, or where it is out of the best's reach.

    It is fitted from the steady noise in which it was seen. What ends has numbers after it too. The
    quadratic is that of what is free.
    """
    effect, fit = candidate.effect, steady.fit
    active = fit.active if effect in fit.active else (*fit.active, effect)
    there = replace(fit, active=active) if candidate.ends else fit
    problem = beginning(state.problem, there, {effect: candidate.moment}, clock)
    before_it = {of_part(n, BEFORE): fit.values[n] for n in candidate.move}
    moved = [of_part(n, BEFORE) if candidate.ends else n for n in candidate.move]
    values = {**fit.values, **before_it}
    values |= {n: values[n] + x for n, x in zip(moved, candidate.move.values(), strict=True)}
    trial = fitted(problem, replace(fit.at(values), active=active))
    if not math.isfinite(trial.objective):
        return None
    problem, found = _moved(problem, trial, effect)
    trial = step = fitted(problem, noise_fitted(problem, trial), steps=2)
    if best is not None and best.is_out_of_reach(state, step):
        return None
    problem, found = _moved(problem, trial, effect)
    problem, trial, found = _grown(problem, trial, found)
    trial = _with_noise_of(problem, trial, state.fit)
    trial, rivals = _compared(state, problem, trial, effect)
    trial, quadratic = quadratic_at(problem, trial, problem.free(trial.active))
    onset = _worth(state, problem, trial, rivals, quadratic, found)
    changing_state = Changing(problem, trial, quadratic, {**state.onsets, effect: onset})
    return Trial(changing_state, onset, step.objective - trial.objective)


def _with_noise_of(problem: Problem, trial: Fit, fit: Fit) -> Fit:
    """A change beside the noise of the fit without it, drifts too, where that is likelier.

    A machine whose trims do drift would else lose more by their absence than any change can gain.

    Args:
        problem, trial: with the change, fitted in steady noise.
        fit: without it.
    """
    if trial.noise.process == fit.noise.process:
        return trial
    other = fitted(problem, replace(trial, noise=fit.noise, levels=fit.levels), steps=2)
    other = fitted(problem, noise_fitted(problem, other), steps=1)
    return other if other.objective < trial.objective else trial


@dataclass(frozen=True)
class Rivals:
    """Models without a change. same: with what there was. always: with the effect always there; None
    where it was.
    """

    same: Fit
    always: Fit | None

    def nearest(self) -> float:
        """The lesser objective [nats]."""
        return min(fit.objective for fit in (self.same, self.always) if fit is not None)

    def by(self, work: Callable[[Fit], Fit]) -> "Rivals":
        """Something done to both."""
        return Rivals(work(self.same), self.always and work(self.always))


def _compared(state: Changing, problem: Problem, trial: Fit, effect: str) -> tuple[Fit, Rivals]:
    """A change and its rivals, refitted with noise levels of their own: until nothing is gained where
    their difference may decide. One that had not converged would lose by it, or its rival.
    """
    always = None
    if effect not in state.fit.active:
        was = _before(problem, effect) or problem.acting_names(effect)
        own = {n.removesuffix(AT + BEFORE): trial.values[n] for n in was}
        always = replace(state.fit.at(own), active=trial.active, noise=trial.noise)

    def refitted(fit: Fit) -> Fit:
        return fitted(state.problem, noise_fitted(state.problem, fit), steps=2)

    rivals = Rivals(replace(state.fit, noise=trial.noise), always).by(refitted)
    if state.fit.objective < rivals.same.objective:
        rivals = replace(rivals, same=state.fit)
    if 0.0 < rivals.nearest() - trial.objective < CLEAR * problem.settings.evidence:
        trial = converged(problem, trial)
        rivals = rivals.by(lambda fit: converged(state.problem, fit))
    return trial, rivals


def _worth(
    state: Changing,
    problem: Problem,
    trial: Fit,
    rivals: Rivals,
    quadratic: Quadratic,
    found: Onset,
) -> Onset:
    """An onset with its evidence: beside no change, its numbers and its moment paid for.

    Minus infinity where it is within a tie of a cause that was always there, where a gust could have
    made it, where it is too small to matter, and where the channels that show it stay coloured: a model
    that is wrong there always finds a moment.
    """
    effect, same = found.effect, rivals.same
    was = _before(problem, effect)
    extra = problem.acting_names(effect) if rivals.always else was
    others = [n for n in problem.free_names(trial.active) if n not in extra]
    inflation = quadratic.variance_inflation(extra, [*others, *extra])
    of_moment = math.log(problem.seconds / found.width)
    nats = (
        (same.objective - trial.objective) / inflation - quadratic.occam(extra, others) - of_moment
    )
    beside_constant = nats
    if rivals.always is not None:
        alike = [n for n in problem.free_names(trial.active) if n not in was]
        beside_constant = (rivals.always.objective - trial.objective) / inflation - of_moment
        beside_constant -= quadratic.occam(was, alike) if was else 0.0
    without = state.problem.engine.filter(same.values, trial.noise)
    with_it = problem.engine.filter(trial.values, trial.noise)
    lasting = _lasting(without, with_it, found.moment) / inflation
    white = whiteness(with_it, problem.model.channels)
    shows = channels_of(problem, trial, quadratic, effect)
    if (
        min(lasting, beside_constant) < problem.settings.tie
        or not _matters(problem, trial, effect)
        or any(c in white and not white[c].white for c in shows)
    ):
        nats = -math.inf
    return replace(found, nats=nats)


def _before(problem: Problem, effect: str) -> list[str]:
    """An effect's numbers before its moment, none where it begins."""
    return [n for n in problem.acting_names(effect) if n.endswith(BEFORE)]


def _matters(problem: Problem, fit: Fit, effect: str) -> bool:
    """Whether what changes is large enough to matter in prediction."""
    for p in problem.model.sized(effect):
        name = f"{effect}.{p.name}"
        was = fit.values.get(of_part(name, BEFORE), p.off)
        if p.smallest > 0.0 and abs(fit.values[name] - was) >= p.smallest:
            return True
    return False


def _lasting(without: Sequence[RunPass], with_it: Sequence[RunPass], moment: Moment) -> float:
    """nats of a change on the rows outside OVER, where a gust at its moment has been forgotten."""
    total = 0.0
    for a, b in zip(without, with_it, strict=True):
        kept = np.ones(a.record.t.size, bool)
        if a.record.whole == moment.run:
            since = a.record.t - moment.t
            kept = (since < -OVER[0]) | (since > OVER[1])
        total += 0.5 * float(np.nansum(a.innovations[kept] ** 2 - b.innovations[kept] ** 2))
    return total


# --- the moment -------------------------------------------------------------------------------------


def _moved(problem: Problem, fit: Fit, effect: str) -> tuple[Problem, Onset]:
    """The problem with an effect's moment where the likelihood is largest, and the interval of it."""
    found = moment_of(problem, fit, effect)
    return with_moment(problem, effect, found.moment), found


def moment_of(problem: Problem, fit: Fit, effect: str, inflation: float = 1.0) -> Onset:
    """The best moment of a change in its run, with mean, std and width of its posterior.

    From the likelihood of its run with the change at each row, all else as it is.

    Args:
        problem, fit: with the change.
        effect: that changes.
        inflation: of variances, by coloured innovations.
    """
    moment = problem.model.moments[effect]
    records = [r for r in problem.engine.records if r.whole == moment.run]
    t = np.concatenate([r.t for r in records])
    nats = _profile(problem, fit, effect, records, t) / inflation
    share = np.exp(nats - nats.max())
    step = np.gradient(t) if t.size > 1 else np.ones(1)
    weight = share * step / float(share @ step)
    mean = float(weight @ t)
    spread = math.hypot(math.sqrt(float(weight @ (t - mean) ** 2)), float(np.median(step)))
    best = Moment(moment.run, float(t[int(np.argmax(nats))]))
    return Onset(effect, best, mean, spread, float(share @ step), 0.0)


def _profile(
    problem: Problem, fit: Fit, effect: str, records: Sequence[Record], times: np.ndarray
) -> np.ndarray:
    """Log-likelihood of records with an effect's moment at each of these times (n,).

    At every tenth near where it stands and at some others first, then between any two of which one has
    a share in the interval and that differ, and by a line between the others.
    """
    model = changing(problem)

    def nats_at(k: int) -> float:
        moments = {**model.moments, effect: Moment(model.moments[effect].run, float(times[k]))}
        other = ChangingModel(model.base, moments, model.clock)
        return Engine(other, records, problem.engine.threads).log_likelihood(fit.values, fit.noise)

    known: dict[int, float] = {}
    near = np.flatnonzero(np.abs(times - model.moments[effect].t) <= NEAR)
    afar = np.linspace(0, times.size - 1, AFAR).astype(int)
    asked = {*near[::10].tolist(), *near[-1:].tolist(), *afar.tolist()}
    while asked:
        known |= {k: nats_at(k) for k in asked}
        best = max(known.values())
        asked = {
            (a + b) // 2
            for a, b in pairwise(sorted(known))
            if b > a + 1
            and max(known[a], known[b]) > best - FADED
            and (abs(known[a] - known[b]) > SMOOTH or best in (known[a], known[b]))
        }
    places = sorted(known)
    return np.interp(np.arange(times.size), places, [known[k] for k in places])


def moments_of(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    onsets: Mapping[str, Onset],
) -> dict[str, Onset]:
    """The onsets of causes that are still there, each with its interval at the final fit.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit.
        evidence: of each cause.
        onsets: as they were found.
    """
    found = {}
    for effect, onset in onsets.items():
        if effect in fit.active:
            inflation = evidence[effect].inflation
            if onset.grown is not None:
                assert onset.growth is not None
                own = profiled(problem, fit, quadratic, effect, onset.growth.nats, inflation)
                found[effect] = _as_growth(problem, replace(onset, growth=own))
            else:
                step = moment_of(problem, fit, effect, inflation)
                step = replace(step, nats=onset.nats, growth=onset.growth)
                found[effect] = _as_step(problem, step, inflation)
    return found


def _grown(problem: Problem, step: Fit, found: Onset) -> tuple[Problem, Fit, Onset]:
    """A change as one that grows, where that is worth more than a tie beside the step; else the step.

    Args:
        problem, step: with the change at its moment, fitted. found: its moment.
    """
    effect = found.effect
    tried = growing(problem, step, effect, found.moment, found.width)
    if tried is None:
        return problem, step, found
    wider, fit, own = tried
    problem.report(f"{effect} grows for {own.grown - own.begins:.2f} s:"
                   f" {own.nats:.1f} nats beside a step")  # fmt: skip
    found = replace(found, growth=own)
    if own.nats < problem.settings.tie:
        return problem, step, _as_step(problem, found)
    found = replace(_as_growth(wider, found), width=own.width(problem.seconds))
    return with_moment(wider, effect, found.moment), fit, found


def _as_growth(problem: Problem, onset: Onset) -> Onset:
    """The onset of what grows: its moment is when it begins to."""
    model, own = changing(problem), onset.growth
    assert own is not None
    moment = replace(model.moment(own.begins), grows=own.grown - own.begins)
    std = np.sqrt(np.diag(own.covariance))
    return replace(
        onset, moment=moment, t=moment.t, std=float(std[0]), at_once=own.at_once(),
        grown=(model.moment(own.grown), float(std[1])),
    )  # fmt: skip


def _as_step(problem: Problem, onset: Onset, inflation: float = 1.0) -> Onset:
    """The onset of a step; where it may as well have grown, from when on is in its interval."""
    model, own = changing(problem), onset.growth
    if own is None:
        return onset
    p = own.at_once(inflation)
    step = model.time(replace(onset.moment, t=onset.t))
    mean = p * step + (1.0 - p) * own.begins
    spread = p * (onset.std**2 + (step - mean) ** 2)
    spread += (1.0 - p) * (inflation * float(own.covariance[0, 0]) + (own.begins - mean) ** 2)
    there = model.moment(mean)
    return replace(onset, t=there.t, run=there.run, std=math.sqrt(spread), at_once=p)


# --- beside a change --------------------------------------------------------------------------------


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
    fit, quadratic = min(ended, key=lambda e: _cost(problem, *e))
    kept = {e: onset for e, onset in onsets.items() if e in fit.active}
    return Changing(problem, fit, quadratic, kept)


def _cost_of(state: Changing) -> float:
    return _cost(state.problem, state.fit, state.quadratic)


def _cost(problem: Problem, fit: Fit, quadratic: Quadratic) -> float:
    """Minus the log evidence of a model, to second order [nats]."""
    own = [n for e in fit.active for n in problem.acting_names(e)]
    return fit.objective + (quadratic.occam(own, problem.base_names(fit.active)) if own else 0.0)


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
        then = beginning(problem, fit, moments, changing(problem).clock)
        there, _, quadratic = linearise(then, fit)
        found |= alternatives(then, there, quadratic, evidence, white, [effect])
    return found
