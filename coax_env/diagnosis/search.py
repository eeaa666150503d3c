"""Which effects do these flights show? Stepwise selection: forward, backward and swap moves.

At each point the log-posterior is quadratic in all parameters at once, bare ones and candidates
(estimation/quadratic.py). An effect is added when its score (scores.py) passes the threshold and one
of its parameters is large enough to matter in prediction; everything is re-linearised after each move,
and what is active is dropped or swapped where the data no longer carry it (Miller 2002, Subset
Selection in Regression, ch. 3; with log Bayes factors in place of F).

On the way from one addition to the next only those candidates are linearised that were near the
threshold the time before. Before anything else is tried, and at the end, all of them are.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace

from coax_env.diagnosis.fits import (
    fitted,
    from_steady_noise,
    linearise,
    noise_fitted,
    noise_may_hide,
    stepped,
    with_latent_noise,
)
from coax_env.diagnosis.from_afar import RunnersUp, exchanged, runners_up
from coax_env.diagnosis.moves import (
    Proposal,
    accepted,
    add,
    drop,
    dropped_in_brief_gusts,
    late_rotors,
    swaps,
    trials,
    with_noise_anew,
)
from coax_env.diagnosis.problem import (
    LATE_ROTORS,
    SERVO_FORMS,
    WEAK_OR_LATE,
    Fit,
    Problem,
)
from coax_env.diagnosis.scores import Score, loss, most_gains, scores, threshold
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.run_passes import RunPass
from coax_env.model.layout import ROTOR_SPEEDS

UNDECIDED = 3.0
"""Thresholds below which the best score does not decide yet: noise may hide a better cause; ours."""
MOST_ROTORED = 2
"""Sets of effects beside which one search tries rotors that follow late: each takes as long as some
additions; ours."""


def search(problem: Problem, fit: Fit) -> tuple[Fit, Quadratic]:
    """Add, drop and swap effects from a fitted model until nothing is gained.

    Args:
        problem, fit: what may be free, and where.

    Returns:
        the fit, and the quadratic at it.
    """
    chosen = problem.settings
    memory = _Memory()
    near = problem  # with the candidates that are linearised
    complete = False  # nothing is left to add
    just_fitted = False
    for _ in range(4 * chosen.most_causes):
        fit, passes, quadratic = linearise(near, fit)
        step_gain = -quadratic.best(near.free_names(fit.active))[0]
        candidates = scores(near, fit, quadratic, memory.banned)
        fit = _noting_strongest(fit, ((c.evidence, c.effect) for c in candidates))
        least = threshold(near, quadratic, fit.active)
        strong = _lag_first([c for c in candidates if c.evidence > least])
        clear = strong and strong[0].nats > chosen.add_before_fitted * step_gain
        converged = step_gain <= chosen.step_gain or just_fitted
        if not converged and (complete or not clear):
            fit = stepped(near, fit, passes, quadratic)
            del passes  # gains of every row: gone before others are made
            fit = fitted(near, fit, chosen.most_steps, chosen.step_gain)
            near = near if strong else problem
            just_fitted = True
            continue
        just_fitted = False
        moved = None
        if not complete:
            moved = _backward(near, fit, quadratic, memory) if converged else None
            moved = moved or _forward(near, fit, passes, quadratic, candidates, strong, memory)
        del passes
        if moved is None and near is not problem:
            near, just_fitted = problem, converged
            continue
        if not complete:
            moved = moved or _steadier(problem, fit, memory)
            moved = moved or _swap(problem, fit, quadratic, memory)
            moved = moved or _exchanged(problem, fit, quadratic, memory)
            moved = moved or _trial(problem, fit, quadratic, candidates, memory)
            moved = moved or _with_late_rotors(problem, fit, quadratic, memory)
            moved = moved or with_latent_noise(problem, fit)
            moved = moved or _with_noise_anew(problem, fit, quadratic, candidates, memory)
            moved = moved or _in_brief_gusts(problem, fit, quadratic, memory)
        if moved is None:  # what is active must also stand against coloured innovations
            complete = True
            moved = drop(problem, fit, quadratic, coloured=True)
        if moved is None:
            return fit, quadratic
        near = _nearest(near, fit, quadratic, moved.active)
        fit = noise_fitted(problem, moved)
    fit, _, quadratic = linearise(problem, fit)
    return fit, quadratic


def added(problem: Problem, fit: Fit) -> tuple[Fit, Quadratic]:
    """Effects added to a fitted model one after the other, as long as one passes the threshold.

    What `search` does first; nothing is dropped, swapped or tried.

    Args:
        problem: with the candidates. fit: fitted.

    Returns:
        the fit, and the quadratic at it.
    """
    chosen = problem.settings
    while True:
        fit, passes, quadratic = linearise(problem, fit)
        least = threshold(problem, quadratic, fit.active)
        strong = [c for c in scores(problem, fit, quadratic) if c.evidence > least]
        moved = add(problem, fit, passes, quadratic, strong)
        if moved is None:
            return fit, quadratic
        fit = fitted(problem, noise_fitted(problem, moved), chosen.most_steps, chosen.step_gain)


def _lag_first(strong: Sequence[Score]) -> list[Score]:
    """The best first, but a servo's delay behind its lag: it has to explain more by more than a tie.

    Every servo lags; that its command is late as well, beside what delays all commands, is the more to
    be shown.
    """
    lag, delay = SERVO_FORMS
    names = [c.effect for c in strong]
    if lag not in names or delay not in names:
        return list(strong)
    rest = [c for c in strong if c.effect != lag]
    rest.insert(min(names.index(lag), names.index(delay)), strong[names.index(lag)])
    return rest


def _nearest(problem: Problem, fit: Fit, quadratic: Quadratic, kept: Collection[str]) -> Problem:
    """The problem with those of its candidates alone that may gain more than a tie, and some others.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        kept: effects that stay candidates.
    """
    _, most = most_gains(problem, quadratic, fit.active, {})
    near = {e for e, gain in most.items() if gain > problem.settings.tie}.union(kept)
    return problem.of_candidates(near)


@dataclass
class _Memory:
    """What one search must not do again.

    banned: effects dropped since an addition last held. tried: sets of effects that were fitted.
    renewed: sets of effects that were fitted with the noise.
    steadied: sets of effects beside which steadier noise was asked for. briefed: and brief gusts.
    rotored: beside which rotors that follow late were tried.
    behind: effects that were added -> their runners-up. exchanged: sets of effects in which these were
        tried.
    drops: how often each effect was dropped. failures: additions in a row that did not hold.
    most: effects that were active together and held.
    """

    banned: set[str] = field(default_factory=set)
    tried: set[tuple[str, ...]] = field(default_factory=set)
    renewed: set[tuple[str, ...]] = field(default_factory=set)
    steadied: set[tuple[str, ...]] = field(default_factory=set)
    briefed: set[tuple[str, ...]] = field(default_factory=set)
    rotored: set[tuple[str, ...]] = field(default_factory=set)
    behind: dict[str, RunnersUp] = field(default_factory=dict)
    exchanged: set[tuple[str, ...]] = field(default_factory=set)
    drops: Counter[str] = field(default_factory=Counter)
    failures: int = 0
    most: int = 0


def _backward(problem: Problem, fit: Fit, quadratic: Quadratic, memory: _Memory) -> Fit | None:
    moved = drop(problem, fit, quadratic, coloured=False)
    gone = set(fit.active) - set(moved.active) if moved else set()
    if gone:
        memory.drops.update(gone)
        memory.banned |= gone
        memory.failures += 1
    return moved


def _forward(
    problem: Problem,
    fit: Fit,
    passes: Sequence[RunPass],
    quadratic: Quadratic,
    candidates: Sequence[Score],
    strong: Sequence[Score],
    memory: _Memory,
) -> Fit | None:
    if memory.failures >= problem.settings.most_failures:
        return None
    moved = None
    if strong and strong[0].nats < UNDECIDED * threshold(problem, quadratic, fit.active):
        moved = _with_noise_anew(problem, fit, quadratic, candidates, memory)
    if moved is None:
        moved = add(problem, fit, passes, quadratic, strong)
        if moved:
            memory.behind[strong[0].effect] = runners_up(problem, fit, quadratic, strong)
    if moved and len(moved.active) > memory.most + 1:  # the addition before this one held
        memory.most, memory.failures = len(moved.active) - 1, 0
        memory.banned = {e for e, count in memory.drops.items() if count > 1}
    return moved


def _steadier(problem: Problem, fit: Fit, memory: _Memory) -> Fit | None:
    """With steadier noise, if that is likelier: what it had taken up may have a name by now."""
    if fit.active in memory.steadied:
        return None
    memory.steadied.add(fit.active)
    steady = from_steady_noise(problem, fit)
    if steady is None or steady.objective >= fit.objective - problem.settings.tie:
        return None
    problem.report("searching on from steadier noise")
    return steady


def _in_brief_gusts(
    problem: Problem, fit: Fit, quadratic: Quadratic, memory: _Memory
) -> Fit | None:
    """Without weak effects that gusts may hide, all but what was worth most when it came."""
    if len(fit.active) < 2 or fit.active in memory.briefed:
        return None
    memory.briefed.add(fit.active)
    came = {move.removeprefix("+ "): nats for move, nats in fit.history}
    first = max(fit.active, key=lambda e: came.get(e, 0.0))
    clear = problem.settings.clear
    others = [e for e in fit.active if e != first and e in WEAK_OR_LATE]
    weak = [e for e in others if loss(problem, quadratic, fit.active, e, 1.0) < clear]
    enough = threshold(problem, quadratic, fit.active)
    return dropped_in_brief_gusts(problem, fit, quadratic, weak, enough)


def _swap(problem: Problem, fit: Fit, quadratic: Quadratic, memory: _Memory) -> Fit | None:
    return _first_accepted(problem, fit, swaps(problem, fit, quadratic, memory.tried), memory)


def _exchanged(problem: Problem, fit: Fit, quadratic: Quadratic, memory: _Memory) -> Fit | None:
    """With the runner-up of an effect in its place; the other way round is not tried again."""
    if fit.active in memory.exchanged:
        return None
    memory.exchanged.add(fit.active)
    for effect in fit.active:
        moved = exchanged(problem, fit, quadratic, effect, memory.behind.get(effect, {}))
        if moved:
            return moved
    return None


def _trial(
    problem: Problem, fit: Fit, quadratic: Quadratic, candidates: Sequence[Score], memory: _Memory
) -> Fit | None:
    proposals, evaluated = trials(problem, fit, quadratic, candidates, memory.banned, memory.tried)
    memory.tried |= {(*fit.active, effect) for effect in evaluated}
    moved = _first_accepted(problem, fit, proposals, memory)
    return _noting_added(moved) if moved else None


def _with_noise_anew(
    problem: Problem, fit: Fit, quadratic: Quadratic, candidates: Sequence[Score], memory: _Memory
) -> Fit | None:
    """With the best of what noise may hide."""
    if not noise_may_hide(problem, fit):
        return None
    moved, asked = with_noise_anew(problem, fit, quadratic, candidates, memory.renewed)
    memory.renewed |= {(*fit.active, effect) for effect in asked}
    return _noting_added(moved) if moved else None


def _with_late_rotors(
    problem: Problem, fit: Fit, quadratic: Quadratic, memory: _Memory
) -> Fit | None:
    """Rotors that follow late, where something late or weak is named and no rotor's speed is read."""
    rotors = set(LATE_ROTORS)
    done = fit.active in memory.rotored or len(memory.rotored) == MOST_ROTORED
    if done or rotors <= set(fit.active) or not set(fit.active) & {*WEAK_OR_LATE, *rotors}:
        return None
    if rotors & set(fit.active) and any(memory.drops[e] for e in rotors):
        return None  # beside the one that is there a slope shows the other, which was dropped
    may_be = rotors <= set(problem.candidates) and not rotors & set(problem.model.moments)
    if not may_be or not problem.aboard.isdisjoint(ROTOR_SPEEDS):
        return None
    memory.rotored.add(fit.active)
    return late_rotors(problem, fit, quadratic)


def _first_accepted(
    problem: Problem, fit: Fit, proposals: Iterable[Proposal], memory: _Memory
) -> Fit | None:
    for proposal in proposals:
        memory.tried.add(proposal.begin.active)
        moved = accepted(problem, fit, proposal)
        if moved:
            return moved
    return None


def _noting_strongest(fit: Fit, found: Iterable[tuple[float, str]]) -> Fit:
    return replace(fit, strongest=max([fit.strongest, *found]))


def _noting_added(fit: Fit) -> Fit:
    """The fit whose last move added an effect, which may be the strongest so far."""
    move, nats = fit.history[-1]
    return _noting_strongest(fit, [(nats, move.removeprefix("+ "))])
