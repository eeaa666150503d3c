"""Which changes do two flights show? Forward by the quadratic, accepted by a refit, and backward."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from coax_env.comparison.candidates import Numbers, Score, best_first, scored
from coax_env.comparison.shared import with_pilots, without_pilots
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

    def with_only(self, effects: Collection[str]) -> "Changed":
        """With no others; nothing is fitted."""
        kept = self
        for effect in set(self.effects) - set(effects):
            kept = kept.without(effect)
        return kept

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

    def converged(self) -> "Changed":
        """Noise levels and what is free by turns until neither gains."""
        return replace(self, fit=converged(self.problem, self.fit))

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
    asked = [score for score in found[:TRIED] if score.nats > WORTH_A_FIT]
    trials = {s.effect: _fitted_with(state, quadratic, s) for s in asked}
    gains = {s.effect: _gained(state, trials[s.effect], s) for s in asked}
    enough = state.problem.settings.evidence
    if asked and max(gains.values()) <= enough < asked[0].nats:  # noise began too far away
        best = max(asked, key=lambda s: gains[s.effect])
        trials[best.effect] = trials[best.effect].converged()
        gains[best.effect] = _gained(state.converged(), trials[best.effect], best)
    effect = max(gains, key=gains.__getitem__, default=None)
    if effect is None or gains[effect] <= enough:
        return None
    state.problem.report(f"{effect} changed: {gains[effect]:.1f} nats")
    return trials[effect]


def _fitted_with(state: Changed, quadratic: Quadratic, score: Score) -> Changed:
    """With one more change and noise levels of its own, from short memories on."""
    begin = state.with_change(score.effect).at_optimum(quadratic)
    return begin.shaken_shortly().fitted().with_noise()


def _gained(state: Changed, trial: Changed, score: Score) -> float:
    return state.fit.objective - trial.fit.objective - score.occam


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


def standing(state: Changed) -> tuple[Changed, Quadratic, dict[str, Weighed]]:
    """The changes that stand by the readings alone and with what commands show of the gusts.

    As the names of a diagnosis do (diagnosis/evidence.py): alone, two pilots who see the gusts look
    like two machines, of which one answers late; with the gains of their commands, like a damping.

    Args:
        state: after the search, its command gains free where they are to be stated.

    Returns:
        `pruned`, and of each change the lesser evidence.
    """
    while True:
        first, quadratic, evidence = pruned(state)
        for other in _asked_otherwise(first):
            asked, _, again = pruned(other, clear=evidence)
            if asked.effects != first.effects:
                state = first.with_only(asked.effects)
                break
            evidence |= {e: min(evidence[e], w, key=lambda w: w.nats) for e, w in again.items()}
        else:
            return first, quadratic, evidence


def _asked_otherwise(state: Changed) -> list[Changed]:
    """The same changes, commands taken as given, and with all that they show, where that is more."""
    if not state.effects:
        return []
    found = []
    for problem, fit in (
        without_pilots(state.problem, state.fit),
        with_pilots(state.problem, state.fit, coloured=True),
    ):
        if len(problem.added) != len(state.problem.added):
            found.append(replace(state, problem=problem, fit=fit))
    return found


def weighed(
    state: Changed, quadratic: Quadratic, clear: Mapping[str, Weighed] = MappingProxyType({})
) -> dict[str, Weighed]:
    """Each change against the refit without it: the less of that and of what the quadratic says.

    Args:
        state: converged.
        quadratic: linearised there.
        clear: evidence known before; what is worth several thresholds by it is not asked again, unless
            the quadratic doubts it.
    """
    chosen = state.problem.settings
    enough = chosen.clear

    def one(effect: str, score: Score) -> Weighed:
        rest = state.without(effect).fitted().with_noise()
        lost = rest.fit.objective - state.fit.objective
        if lost < 3.0 * chosen.evidence * score.inflation:
            rest = rest.converged()
            lost = rest.fit.objective - state.fit.objective
        return Weighed(
            min(lost, score.gained) / score.inflation - score.occam, score.inflation, lost
        )

    scores = {e: worth_of(state, quadratic, e) for e in state.effects}
    asked = (
        e for e, s in scores.items() if s.nats < enough or e not in clear or clear[e].nats < enough
    )
    return {e: one(e, scores[e]) for e in asked}


def pruned(
    state: Changed, clear: Mapping[str, Weighed] = MappingProxyType({})
) -> tuple[Changed, Quadratic, dict[str, Weighed]]:
    """Converged, without the changes whose evidence is gone by then.

    Args:
        state: after the search. clear: as `weighed`.
    """
    while True:
        state, quadratic = state.converged().linearised()
        evidence = weighed(state, quadratic, clear)
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
