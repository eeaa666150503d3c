"""The moves of the search: propose by the quadratic, accept by a fit. Each returns a fit or None."""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from coax_env.diagnosis.fits import (
    at_optimum,
    brief_memories,
    converged,
    fitted,
    gusts_last,
    is_much_coloured,
    noise_fitted,
    quadratic_at,
    stepped,
    with_latent_noise,
    without,
    without_drifts,
)
from coax_env.diagnosis.from_afar import BEHIND, STEPS, TURNS, likeliest
from coax_env.diagnosis.problem import (
    COMMAND_DELAY,
    LATE_ROTORS,
    SERVO_FORMS,
    SERVO_RATE,
    Fit,
    Problem,
    exclusive_with,
)
from coax_env.diagnosis.scores import (
    Score,
    cost,
    exchanges,
    gain_by_likelihood,
    inflation,
    is_large,
    loss,
    threshold,
)
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.run_passes import RunPass
from coax_env.plain_words import and_list

BRIEF_TURNS = 2
"""Of values and noise from brief gusts, before drifts and white noise are asked for; ours."""
TOO_SMALL = "too small to matter in prediction"


@dataclass(frozen=True)
class Proposal:
    """A model that may be better, to be fitted.

    Attributes:
        move: what it changes, for the history.
        effect: the effect that comes.
        begin: where its fit begins.
        occam: Occam factor of what it adds [nats].
        needed: nats that it must gain.
        words: the progress line, with a place for the nats gained.
    """

    move: str
    effect: str
    begin: Fit
    occam: float
    needed: float
    words: str


def accepted(problem: Problem, fit: Fit, proposal: Proposal) -> Fit | None:
    """The proposed model fitted, where it gains enough and its effect matters in prediction.

    Args:
        problem, fit: what may be free, and the fit that must be beaten.
        proposal: the model.
    """
    trial = fitted(problem, proposal.begin)
    if not math.isfinite(trial.objective):
        problem.report(f"refused {proposal.move}: with it the filter diverges")
        return None
    gained = fit.objective - trial.objective - proposal.occam
    if gained > proposal.needed and is_large(problem, proposal.effect, trial.values):
        problem.report(proposal.words.format(gained))
        return trial.noted(proposal.move, gained)
    return None


# --- forward ----------------------------------------------------------------------------------------


def add(
    problem: Problem,
    fit: Fit,
    passes: Sequence[RunPass],
    quadratic: Quadratic,
    strong: Sequence[Score],
) -> Fit | None:
    """Add the best effect that may be added.

    Args:
        problem, fit: what may be free, and where.
        passes: of the filter at the fit.
        quadratic: linearised at the fit.
        strong: effects with enough evidence, the best first.
    """
    if not strong or len(fit.active) >= problem.settings.most_causes:
        return None
    effect, nats = strong[0].effect, strong[0].nats
    problem.report(f"added {effect}: {nats:.1f} nats")
    active = (*fit.active, effect)
    fixed = problem.file_values(effect)
    if fixed:  # takes the base parameter's place: the same model, not a better one
        moved = at_optimum(problem, fit, quadratic, active, fixed)
    elif effect == SERVO_RATE and not problem.changes(effect):
        moved = likeliest(problem, replace(fit, active=active), effect)
    else:
        moved = stepped(problem, replace(fit, active=active), passes, quadratic)
    return moved.noted(f"+ {effect}", nats)


def trials(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    candidates: Sequence[Score],
    banned: Collection[str],
    tried: Collection[tuple[str, ...]],
) -> tuple[list[Proposal], list[str]]:
    """Effects that the quadratic nearly carries, and by the likelihood's own slope those gains hide.

    The quadratic at nothing is not that at the effect's size: a damping changes what the filter makes
    of gusts, and may be worth ten times what its slope predicted.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        candidates: scores of what may be added.
        banned: effects that may not be added now.
        tried: sets of effects that need no second trial.

    Returns:
        what is worth a fit, and what was asked by the likelihood's slope.
    """
    chosen = problem.settings
    enough = threshold(problem, quadratic, fit.active)
    least = chosen.trial_share * enough

    def untried(names: Iterable[str]) -> list[str]:
        return [e for e in names if (*fit.active, e) not in tried]

    weak = untried(
        c.effect
        for c in candidates
        if least < c.evidence <= enough and not problem.file_values(c.effect)
    )[: chosen.most_trials]
    begin: dict[str, Mapping[str, float]] = {effect: {} for effect in weak}
    hidden = untried(
        e
        for e in problem.candidates
        if problem.is_hidden_by_gains(e)
        and e not in {*fit.active, *banned, *weak, *problem.model.moments}
        and not exclusive_with(e) & set(fit.active)
    )
    gains = problem.for_each(lambda e: gain_by_likelihood(problem, fit, quadratic, e), hidden)
    begin |= {e: at for e, (nats, at) in gains.items() if nats > least}
    proposals = [
        Proposal(
            f"+ {effect}",
            effect,
            at_optimum(problem, fit, quadratic, (*fit.active, effect), at),
            quadratic.occam(problem.acting_names(effect), problem.free_names(fit.active)),
            enough,
            f"added {effect}: {{:.1f}} nats, once fitted",
        )
        for effect, at in begin.items()
    ]
    return proposals, hidden


def with_noise_anew(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    candidates: Sequence[Score],
    tried: Collection[tuple[str, ...]],
) -> tuple[Fit | None, list[str]]:
    """Add the best of what the quadratic nearly carries, each fitted with the noise.

    Noise that was fitted without an effect has taken a part of it up, gusts that last above all: from
    there neither a slope nor a fit of the effect's own numbers shows what it is worth.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        candidates: scores of what may be added.
        tried: sets of effects that need no second trial.

    Returns:
        the fit with that effect, where it gains enough, and which effects were asked.
    """
    chosen = problem.settings
    if len(fit.active) >= chosen.most_causes:
        return None, []
    enough = threshold(problem, quadratic, fit.active)
    least = chosen.noise_trial_share * enough
    share = {
        c.effect: c.evidence / problem.times_unseen(c.effect)
        for c in candidates
        if not problem.file_values(c.effect) and (*fit.active, c.effect) not in tried
    }
    near = sorted((e for e in share if share[e] > least), key=lambda e: -share[e])
    near = near[: chosen.most_noise_trials]
    free = problem.free_names(fit.active)
    occam = {e: quadratic.occam(problem.acting_names(e), free) for e in near}

    needed = {e: enough * problem.times_unseen(e) for e in near}

    def gained(effect: str, now: Fit, trial: Fit) -> float:
        return now.objective - trial.objective - occam[effect]

    def one(effect: str) -> Fit:
        begin = at_optimum(problem, fit, quadratic, (*fit.active, effect), {})
        trial = fitted(problem, begin, steps=1)
        if not gained(effect, fit, trial) >= least:
            return trial
        if gusts_last(fit.noise):  # short ones are far from there
            trial = fitted(problem, without_drifts(trial), steps=1)
        return fitted(problem, noise_fitted(problem, trial, math.inf), steps=1)

    def beyond(now: Fit) -> dict[str, float]:
        """Nats gained over those that are needed, of those that gain as much."""
        more = {e: gained(e, now, ends[e]) - needed[e] for e in near}
        return {e: nats for e, nats in more.items() if nats > 0.0}

    ends = problem.for_each(one, near)
    if not beyond(fit):
        return None, near
    now = converged(problem, fit)  # or an effect is credited with what its noise alone gains
    good = beyond(now)
    best = max(good, key=lambda e: good[e], default=None)
    if best is None or not is_large(problem, best, ends[best].values):
        return None, near
    nats = gained(best, now, ends[best])
    problem.report(f"added {best}: {nats:.1f} nats, once fitted with the noise")
    return ends[best].noted(f"+ {best}", nats), near


# --- swap -------------------------------------------------------------------------------------------


def swaps(
    problem: Problem, fit: Fit, quadratic: Quadratic, tried: Collection[tuple[str, ...]]
) -> Iterator[Proposal]:
    """Effects in the place of active ones that fit better by the quadratic, the best first.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        tried: sets of effects that need no second trial.
    """
    better = []
    for change, old, new, move in exchanges(problem, quadratic, fit.active, fit.active):
        active = fit.instead(old, new)
        if active not in tried:
            better.append((change, old, new, active, move))
    for _, old, new, active, move in sorted(better, key=lambda c: c[0])[
        : problem.settings.most_trials
    ]:
        begin = replace(fit.at(quadratic.moved(move)), active=active)
        words = f"{new} explains it better than {old}, by {{:.1f}} nats"
        yield Proposal(f"{old} -> {new}", new, begin, 0.0, problem.settings.tie, words)


# --- rotors that nobody sees --------------------------------------------------------------------------


def late_rotors(problem: Problem, fit: Fit, quadratic: Quadratic) -> Fit | None:
    """Rotors that follow late and what the body takes up meanwhile, both from their usual sizes.

    Where no rotor's speed is read a slope shows neither without the other: the lag alone takes from
    the heading what the reaction gives back. A late command and half the yaw inertia stood for them by
    poses alone, 320 nats less likely (`tests/blade_element.py`, another simulator).

    Args:
        problem, fit: what may be free, and where; converged.
        quadratic: linearised at the fit.
    """
    now = cost(problem, fit, quadratic)
    best, least = None, now - problem.settings.tie
    for begin in _with_late_rotors(problem, fit):
        trial = fitted(problem, begin, STEPS)
        for _ in range(TURNS):
            trial = fitted(problem, noise_fitted(problem, trial))
        if not trial.objective < fit.objective + BEHIND * problem.settings.tie:
            continue
        trial, at_trial = quadratic_at(problem, converged(problem, trial))
        nats = cost(problem, trial, at_trial)
        if nats < least and all(is_large(problem, e, trial.values) for e in LATE_ROTORS):
            best, least = trial, nats
    if best is None:
        return None
    gained = now - least
    problem.report(f"rotors that follow late, and their reaction: {gained:.1f} nats")
    return best.noted(f"+ {' and '.join(LATE_ROTORS)}", gained)


def _with_late_rotors(problem: Problem, fit: Fit) -> Iterator[Fit]:
    """Where fits with late rotors begin: beside what is late already, and with a late servo for a late
    command; the vehicle's own numbers, which may stand for them, at their file values."""
    own = [f for e in LATE_ROTORS for f in problem.own[e] if f.name in problem.acting_names(e)]
    usual = {f.name: f.value + f.std for f in own} | {f.name: f.value for f in problem.base}
    others = tuple(e for e in fit.active if e not in LATE_ROTORS)
    yield replace(fit.at(usual), active=(*others, *LATE_ROTORS))
    command, servo = COMMAND_DELAY, SERVO_FORMS[0]
    if command in others and servo in problem.candidates and not set(SERVO_FORMS) & set(others):
        late = {f"{servo}.time": fit.values[f"{command}.time"], **problem.off_values(command)}
        rest = tuple(servo if e == command else e for e in others)
        yield replace(fit.at(usual | late), active=(*rest, *LATE_ROTORS))


# --- backward ---------------------------------------------------------------------------------------


def drop(problem: Problem, fit: Fit, quadratic: Quadratic, coloured: bool) -> Fit | None:
    """Remove the effect that is worth least, if that is too little or it is too small.

    One that is worth much and small may be on its way, beside noise that had taken it up: a spin-up
    reaction of 0.77 stood at 0.23 after its first steps, worth 3,500 nats and 25,000 more in the end.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        coloured: whether evidence is divided by the variance inflation of coloured innovations.
    """
    inflations = {
        e: inflation(problem, quadratic, fit.active, e) if coloured else 1.0 for e in fit.active
    }
    worth = {
        e: loss(problem, quadratic, fit.active, e, inflations[e])
        if is_large(problem, e, fit.values)
        else -math.inf
        for e in fit.active
    }
    enough = threshold(problem, quadratic, fit.active)
    for effect in sorted(worth, key=lambda e: worth[e]):
        if worth[effect] >= enough:
            return None
        if not math.isfinite(worth[effect]):
            settled = _settled(problem, fit, quadratic, effect)
            if settled is not None:
                return settled
            why = TOO_SMALL
        elif _is_worthless(problem, fit, quadratic, effect, inflations[effect], enough):
            why = f"worth {worth[effect]:.1f} nats"
        else:
            continue
        problem.report(f"dropped {effect}: {why}")
        rest = at_optimum(problem, fit, quadratic, fit.rest(effect), problem.off_values(effect))
        return rest.noted(f"- {effect}", max(worth[effect], 0.0))
    return None


def _settled(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str) -> Fit | None:
    """The fit once noise and values have settled, where that makes large what is worth much."""
    chosen = problem.settings
    if loss(problem, quadratic, fit.active, effect, 1.0) < chosen.clear:
        return None
    fit = converged(problem, fit)
    if not is_large(problem, effect, fit.values):
        return None
    problem.report(f"{effect} grows as the noise settles")
    return fit


def _is_worthless(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, inflation: float, enough: float
) -> bool:
    """Whether a refit without the effect confirms that it is worth too little.

    The quadratic reaches from where the effect stands back to nothing, which is far for a lag.
    """
    held = tuple(problem.file_values(effect))
    rest = fitted(problem, without(problem, fit, quadratic, effect), held=held)
    occam = quadratic.occam(problem.acting_names(effect), problem.free_names(rest.active))
    return (rest.objective - fit.objective) / inflation - occam < enough


def dropped_in_brief_gusts(
    problem: Problem, fit: Fit, quadratic: Quadratic, gone: Sequence[str], enough: float
) -> Fit | None:
    """Without some effects, where these are worth too little together from brief gusts.

    Gusts that are fitted beside a wrong effect may stay long when it leaves: of a moment with a memory
    of 0.05 s, 1 s beside a yaw damping of 109 nats, sure, and a yaw inertia of 27 that nobody hid;
    without either 1.2 s, and from 0.1 s 86 nats likelier than with them (**synthetic**).

    Drifts and white noise that such an effect had stood for are asked for, too: a torque that drifts is
    next to a yaw inertia, which came out 40 % too large without. What a model lacks looks like drifts:
    on a real helicopter they stood for a yaw damping of 52 nats, with which 72 % of the error was
    removed, and 45 with them; so they are asked only where little of what is read is coloured.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        gone: the effects. enough: nats that they must be worth.
    """
    if not gone or is_much_coloured(problem, fit):
        return None
    rest = without(problem, fit, quadratic, *gone)
    rest = replace(rest, noise=brief_memories(rest.noise))
    for _ in range(BRIEF_TURNS):
        rest = fitted(problem, noise_fitted(problem, rest))
    rest = converged(problem, with_latent_noise(problem, rest) or rest)
    lost = rest.objective - fit.objective
    if lost >= enough:
        return None
    problem.report(f"dropped {and_list(list(gone))}: worth {lost:.1f} nats from brief gusts")
    for effect in gone:
        rest = rest.noted(f"- {effect}", max(lost, 0.0))
    return rest
