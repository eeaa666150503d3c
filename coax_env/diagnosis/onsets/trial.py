"""One change, fitted, and what it is worth beside models without it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.diagnosis.confounding import channels_of
from coax_env.diagnosis.fits import converged, fitted, noise_fitted, quadratic_at
from coax_env.diagnosis.onsets.changing import Changing, Onset, before_names, beginning
from coax_env.diagnosis.onsets.ends import at_an_end
from coax_env.diagnosis.onsets.every_moment import Scored
from coax_env.diagnosis.onsets.moment import grown_or_step, moved_to_best
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.changing_model import BEFORE, Lap
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.parted_engine import AT, of_part
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.whiteness import are_white, whiteness

CLEAR = 3.0
"""Thresholds by which a change is likelier than a model without it, to need no closer fit of that: a
name's, what numbers and moment cost, and what a close fit finds; ours."""
MADE_UP = 300.0
"""nats that a change, fitted as a step, may still gain beyond what the best so far gained from then on.
Measured on eight synthetic flights (study_changes.py, seed 40): 260 at most, of 15 rivals; ours."""
LEFT = 0.5
"""Share of a channel's colour that a step may leave where it shows: what leaves more is not what
colours the channel, as a step or growing, and growth takes three times as long to fit; ours."""
ROWS_APART = 2.0 * math.sqrt(2.0 / 12.0)
"""Rows by which a lag or delay must change: two std of a difference, each time being known to a row
over the root of 12 (fitted_vehicle.with_timing). At 25 Hz a step of the commands acts up to a row
before it is logged, in each run elsewhere: a late command of 8 ms "ended" after two runs, 99 nats
(**synthetic**)."""
OF_GROWTH = 0.5
"""Of what must change, what a step must be to be fitted as growing: that ends at twice its mean."""
OVER = (0.5, 1.5)
"""s before and after a moment in which a gust may have made the evidence; ours."""


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


def fitted_change(
    state: Changing,
    steady: Changing,
    candidate: Scored,
    clock: Mapping[str, Lap],
    best: Trial | None,
) -> Trial | None:
    """A change fitted at its best moment, and what it is worth beside the state without it.

    None where the filter diverges with it, where it is out of the best's reach, where it leaves most of
    the colour where it shows, or comes as the flight begins or ends.

    It is fitted from the steady noise in which it was seen. What ends has numbers after it too. The
    quadratic is that of what is free.

    Args:
        state: without the change. steady: the same in steady noise, from which it was scored.
        candidate: what changes, and when. clock: of all runs, in the order in which they were flown.
        best: the best so far.
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
    problem, found = moved_to_best(problem, trial, effect)
    trial = step = fitted(problem, noise_fitted(problem, trial), steps=2)
    if best is not None and best.is_out_of_reach(state, step):
        return None
    if not _matters(problem, step, effect, OF_GROWTH):
        return None
    problem, found = moved_to_best(problem, trial, effect)
    if _leaves_colour(state, problem, trial, effect):
        return None
    problem, trial, found = grown_or_step(problem, trial, found)
    if at_an_end(problem.engine.records, found.moment):
        return None
    trial = _with_noise_of(problem, trial, state.fit)
    trial, rivals = _compared(state, problem, trial, effect)
    trial, quadratic = quadratic_at(problem, trial, problem.free(trial.active))
    gained = rivals.nearest() - trial.objective
    if gained > problem.settings.tie and _is_coloured(problem, trial, quadratic, effect):
        trial = converged(problem, trial)  # or its noise, on the way, is what is coloured
        trial, quadratic = quadratic_at(problem, trial, problem.free(trial.active))
    onset = _worth(state, problem, trial, rivals, quadratic, found)
    changing_state = Changing(problem, trial, quadratic, {**state.onsets, effect: onset})
    return Trial(changing_state, onset, step.objective - trial.objective)


def _leaves_colour(state: Changing, problem: Problem, trial: Fit, effect: str) -> bool:
    """Whether a channel that shows a change stays coloured with it, by more than LEFT of what it was.

    Args:
        state: without the change. problem, trial: with it, as a step. effect: that changes.
    """
    without = whiteness(
        state.problem.engine.filter(state.fit.values, state.fit.noise), problem.model.channels
    )
    _, quadratic = quadratic_at(problem, trial, problem.own[effect])
    shown = channels_of(problem, trial, quadratic, effect)
    shows = [c for c in shown if c in without and not without[c].white]  # few readings: unjudged
    if not shows:
        return False
    with_it = [
        whiteness(problem.engine.filter(trial.values, noise), problem.model.channels)
        for noise in (trial.noise, state.fit.noise)
    ]
    return any(
        all(
            not left[c].white and left[c].coloured_share > LEFT * without[c].coloured_share
            for left in with_it
        )
        for c in shows
    )


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
        was = before_names(problem, effect) or problem.acting_names(effect)
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
    was = before_names(problem, effect)
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
    beside = min(nats, beside_constant)
    lasting = _lasting(without, with_it, found.moment) / inflation
    if (
        min(lasting, beside_constant) < problem.settings.tie
        or not _matters(problem, trial, effect)
        or _is_coloured(problem, trial, quadratic, effect)
    ):
        nats = -math.inf
    return replace(found, nats=nats, beside=beside)


def _is_coloured(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str) -> bool:
    """Whether a channel that shows the effect is."""
    white = whiteness(problem.engine.filter(fit.values, fit.noise), problem.model.channels)
    return not are_white(white, channels_of(problem, fit, quadratic, effect))


def _matters(problem: Problem, fit: Fit, effect: str, share: float = 1.0) -> bool:
    """Whether what changes is large enough to matter in prediction, a time to be seen between rows.

    Args:
        problem, fit: with the change. effect: that changes. share: of that size that is enough.
    """
    for p in problem.model.sized(effect):
        name = f"{effect}.{p.name}"
        was = fit.values.get(of_part(name, BEFORE), p.off)
        least = max(p.smallest, ROWS_APART * problem.row) if p.timing else p.smallest
        if p.smallest > 0.0 and abs(fit.values[name] - was) >= share * least:
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
