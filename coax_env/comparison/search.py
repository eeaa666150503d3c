"""Which changes do two flights show? Forward by the quadratic, accepted by a refit, and backward."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from coax_env.comparison.candidates import Numbers, Score, best_first, scored
from coax_env.diagnosis.fits import converged, fitted, linearise, noise_fitted, short_memories
from coax_env.diagnosis.problem import Fit, Problem, exclusive_with
from coax_env.diagnosis.scores import scores
from coax_env.estimation.engine import objective
from coax_env.estimation.quadratic import Quadratic

MOST_CHANGES = 5
"""Ours; a bound on time."""
TRIED = 3
"""Changes that are fitted at once, the best by the quadratic first; ours."""
WORTH_A_FIT = 2.0
"""nats by the quadratic from which a change is fitted; ours."""


@dataclass(frozen=True)
class Changed:
    """Two flights under one model and some changes.

    Attributes:
        problem: the changes' numbers are free in it.
        fit: of both flights.
        effects: that changed, in the order in which they came.
        candidates: all that may have changed.
    """

    problem: Problem
    fit: Fit
    effects: tuple[str, ...]
    candidates: Numbers

    def wider(self) -> Problem:
        """With the numbers of all changes, to be linearised in."""
        rest = [f for e, group in self.candidates.items() if e not in self.effects for f in group]
        return self.problem.with_free(rest)

    def with_change(self, effect: str) -> "Changed":
        """With one more, at nothing."""
        group = self.candidates[effect]
        values = {f.name: 0.0 for f in group}
        return replace(
            self,
            problem=self.problem.with_free(group),
            fit=self.fit.at(values | dict(self.fit.values)),
            effects=(*self.effects, effect),
        )

    def without(self, effect: str) -> "Changed":
        """With one less; nothing is fitted."""
        group = self.candidates[effect]
        return replace(
            self,
            problem=self.problem.with_fixed({f.name for f in group}),
            fit=self.fit.at({f.name: 0.0 for f in group}),
            effects=tuple(e for e in self.effects if e != effect),
        )

    def linearised(self) -> tuple["Changed", Quadratic]:
        """The quadratic over everything, and the fit with its objective."""
        wider = self.wider()
        zero = {f.name: self.fit.values.get(f.name, 0.0) for f in wider.added}
        fit, _, quadratic = linearise(wider, self.fit.at(zero))
        return replace(self, fit=fit), quadratic

    def at_optimum(self, quadratic: Quadratic) -> "Changed":
        """Where the quadratic has its least value with what is free."""
        free = self.problem.free_names(self.fit.active)
        _, move = quadratic.best(free)
        return replace(self, fit=self.fit.at(quadratic.moved(move)))

    def fitted(self, steps: int = 3) -> "Changed":
        """What is free fitted."""
        return replace(self, fit=fitted(self.problem, self.fit, steps))

    def evaluated(self) -> "Changed":
        """With its objective at the values and noise as they are."""
        fit = self.fit
        passes = self.problem.engine.filter(fit.values, fit.noise)
        nats = objective(passes, self.problem.free(fit.active), fit.values)
        return replace(self, fit=replace(fit, objective=nats))

    def shaken_shortly(self) -> "Changed":
        """With `short_memories`."""
        return replace(self, fit=replace(self.fit, noise=short_memories(self.fit.noise)))

    def with_noise(self) -> "Changed":
        """Noise levels fitted, and what is free once more."""
        return replace(self, fit=noise_fitted(self.problem, self.fit)).fitted(steps=1)


def changes_found(state: Changed, clearer_than_effects: bool = False) -> Changed:
    """Add changes while one pays, and drop those that another one has made worthless.

    Args:
        state: where to begin.
        clearer_than_effects: only those that are worth more than any effect of the shared model.
    """
    chosen = state.problem.settings
    refused: set[str] = set()
    for _ in range(2 * MOST_CHANGES):
        state = state.evaluated()
        _, quadratic = state.shaken_shortly().linearised()
        found = best_first(state.problem, quadratic, state.candidates, {*state.effects, *refused})
        found = [s for s in found if not exclusive_with(s.effect) & set(state.effects)]
        if not found or found[0].nats < WORTH_A_FIT or len(state.effects) >= MOST_CHANGES:
            break
        if clearer_than_effects:
            rivals = scores(state.problem, state.fit, quadratic)
            if found[0].nats < max([chosen.evidence, *(rival.nats for rival in rivals)]):
                break
        more = _accepted(state, quadratic, found)
        if more is None:
            break
        state = dropped(more, refused)
    return state


def _accepted(state: Changed, quadratic: Quadratic, found: Sequence[Score]) -> Changed | None:
    """The best few changes fitted, noise levels too; the best of them, where it pays."""
    best, most = None, state.problem.settings.evidence
    for score in found[:TRIED]:
        if score.nats > WORTH_A_FIT:
            begin = state.with_change(score.effect).at_optimum(quadratic)
            trial = begin.shaken_shortly().fitted().with_noise()
            gained = state.fit.objective - trial.fit.objective - score.occam
            if gained > most:
                best, most = trial, gained
    if best is not None:
        state.problem.report(f"{best.effects[-1]} changed: {most:.1f} nats")
    return best


def dropped(state: Changed, refused: set[str] | None = None) -> Changed:
    """Without the changes that are worth too little beside the others, for all the innovations' colour.

    Args:
        state: fitted.
        refused: gets the names of what is dropped.
    """
    while state.effects:
        state, quadratic = state.linearised()
        worth = {e: worth_of(state, quadratic, e) for e in state.effects}
        weakest = min(worth, key=lambda e: worth[e].nats)
        if worth[weakest].nats >= state.problem.settings.evidence:
            break
        state.problem.report(f"{weakest} did not change: worth {worth[weakest].nats:.1f} nats")
        if refused is not None:
            refused.add(weakest)
        state = state.without(weakest).fitted()
    return state


def worth_of(state: Changed, quadratic: Quadratic, effect: str) -> Score:
    """What an active change is worth by the quadratic, coloured innovations allowed for.

    Args:
        state: of the search. quadratic: linearised there. effect: an active change.
    """
    return scored(state.problem, quadratic, effect, state.candidates[effect], inflated=True)


@dataclass(frozen=True)
class Weighed:
    """What a change is worth once everything else is refitted without it. nats: log Bayes factor."""

    nats: float
    inflation: float
    lost: float


def weighed(state: Changed, quadratic: Quadratic) -> dict[str, Weighed]:
    """Each change against the refit without it: the less of that and of what the quadratic says.

    Args:
        state: converged.
        quadratic: linearised there.
    """

    def one(effect: str) -> Weighed:
        score = worth_of(state, quadratic, effect)
        rest = state.without(effect).fitted().with_noise()
        lost = rest.fit.objective - state.fit.objective
        if lost < 3.0 * state.problem.settings.evidence * score.inflation:
            rest = replace(rest, fit=converged(rest.problem, rest.fit))
            lost = rest.fit.objective - state.fit.objective
        return Weighed(
            min(lost, score.gained) / score.inflation - score.occam, score.inflation, lost
        )

    return {effect: one(effect) for effect in state.effects}


def pruned(state: Changed) -> tuple[Changed, Quadratic, dict[str, Weighed]]:
    """Converged, without the changes whose evidence is gone by then."""
    while True:
        state = replace(state, fit=converged(state.problem, state.fit))
        state, quadratic = state.linearised()
        evidence = weighed(state, quadratic)
        weakest = min(evidence, key=lambda e: evidence[e].nats, default=None)
        if weakest is None or evidence[weakest].nats >= state.problem.settings.evidence:
            return state, quadratic, evidence
        state.problem.report(f"{weakest} did not change in the end: {evidence[weakest].nats:.1f}")
        state = state.without(weakest)


def alternatives(
    state: Changed, quadratic: Quadratic, evidence: dict[str, Weighed]
) -> dict[str, dict[str, Changed]]:
    """Changes that would do as well in another one's place, refitted.

    Coloured innovations carry less than they seem to: the tie widens by their inflation, up to half of
    what is lost with nothing in the change's place.

    Args:
        state: converged. quadratic: linearised there. evidence: of each change.
    """
    return {e: _in_place_of(state, quadratic, e, evidence[e]) for e in state.effects}


def _in_place_of(
    state: Changed, quadratic: Quadratic, effect: str, worth: Weighed
) -> dict[str, Changed]:
    tie = state.problem.settings.tie
    tie = min(tie * worth.inflation, max(0.5 * worth.lost, tie))
    rest = state.without(effect)
    off = {f.name: 0.0 for f in state.candidates[effect]}
    free = rest.problem.free_names(rest.fit.active)
    now, _ = quadratic.best(state.problem.free_names(state.fit.active))
    near = []
    for other, group in state.candidates.items():
        if other not in state.effects:
            then, move = quadratic.best([*free, *(f.name for f in group)], off)
            near.append((then - now, other, move))
    found: dict[str, Changed] = {}
    twins = exclusive_with(effect)
    for change, other, move in sorted(near, key=lambda n: n[0]):
        close = change < 3.0 * tie and len(found) < TRIED
        if close or other in twins:
            begin = rest.with_change(other)
            begin = replace(begin, fit=begin.fit.at(quadratic.moved(move) | off))
            trial = begin.fitted(steps=6 if other in twins else 2)
            if trial.fit.objective - state.fit.objective < tie:
                found[other] = trial
    return found
