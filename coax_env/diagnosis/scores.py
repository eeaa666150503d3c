"""What adding, removing or swapping an effect is worth, by the quadratic alone.

A set of effects is scored by minimising the quadratic over the base parameters, the effects already
active and the candidate's, the base parameters always under their priors: no effect is credited with
what a better thrust coefficient would have done. The score is a log Bayes factor in nats: the gain of
the objective less the Laplace (Occam) factor of the added parameters, whose prior is their usual size.

An effect that is the same column as a base parameter (`replaces`) takes that parameter's place: the
base parameter goes back to its file value.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coax_env.diagnosis.fits import at_optimum
from coax_env.diagnosis.problem import Fit, Problem, exclusive_with
from coax_env.estimation.changing_model import BEFORE
from coax_env.estimation.engine import objective
from coax_env.estimation.parted_engine import of_part
from coax_env.estimation.quadratic import Quadratic
from coax_env.model import effects


@dataclass(frozen=True)
class Score:
    """What an effect that is not active would bring.

    Attributes:
        effect: its name.
        nats: log Bayes factor of adding it.
        evidence: what the threshold is compared with: for an effect that replaces base parameters,
            against those held at their file values.
        large: whether it matters in prediction at the size that it would have.
    """

    effect: str
    nats: float
    evidence: float
    large: bool


def score(problem: Problem, quadratic: Quadratic, active: Sequence[str], effect: str) -> Score:
    """Log Bayes factor of adding an effect.

    Args:
        problem: what may be free.
        quadratic: linearised at the fit.
        active: effects in the model.
        effect: the candidate.
    """
    free = problem.free_names(active)
    fixed = problem.file_values(effect)
    rest = [n for n in free if n not in fixed]
    own = problem.acting_names(effect)
    now, _ = quadratic.best(free)
    then, move = quadratic.best(rest + own, fixed)
    occam = quadratic.occam(own, rest)
    gain = now - then
    large = is_large(problem, effect, quadratic.moved(move))
    if not fixed:
        return Score(effect, gain - occam, gain - occam, large)
    held, _ = quadratic.best(rest, fixed)
    return Score(effect, gain, held - then - occam, large)


def scores(
    problem: Problem, fit: Fit, quadratic: Quadratic, banned: Collection[str] = ()
) -> list[Score]:
    """Effects that are not active, may be, and gain something that matters; the best first.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        banned: effects that may not be added now.
    """
    found = []
    _, most = most_gains(problem, quadratic, fit.active, {})
    for effect in (e for e, gain in most.items() if gain > 0.0):
        if effect not in banned and not ({effect} | exclusive_with(effect)) & set(fit.active):
            candidate = score(problem, quadratic, fit.active, effect)
            if candidate.large and candidate.nats > 0.0:
                found.append(candidate)
    return sorted(found, key=lambda candidate: -candidate.nats)


def is_large(problem: Problem, effect: str, values: Mapping[str, float]) -> bool:
    """Whether an effect at these values matters in prediction: what it is, was, or changed by.

    One that replaces a base parameter must move it by more than twice its prior std; one that changes
    in flight need not, since what the base parameter is does not change then.

    Args:
        problem: whose vehicle file the base parameter stands in.
        effect: of the catalogue.
        values: of all parameters.
    """
    entry = effects.CATALOGUE[effect]
    sizes = []
    for full, p in zip(entry.names(), problem.model.sized(effect), strict=True):
        if p.smallest > 0.0 and full in values:
            last, was = values[full], values.get(of_part(full, BEFORE), p.off)
            sizes += [abs(x) / p.smallest for x in (last - p.off, was - p.off, last - was)]
    for base in () if problem.changes(effect) else problem.file_values(effect):
        old = problem.model.vehicle.parameters[base]
        relative = abs(values[entry.names()[0]])
        relative /= 1.0 if entry.parameters[0].unit == "1" else old.value
        if relative < 2.0 * old.std / old.value:
            return False
    return max(sizes) >= 1.0


def lost(problem: Problem, quadratic: Quadratic, active: Sequence[str], effect: str) -> float:
    """Nats lost when an active effect leaves and the rest is refitted.

    Args:
        problem: what may be free.
        quadratic: linearised at the fit.
        active: effects in the model.
        effect: that leaves.
    """
    free = problem.free_names(active)
    now, _ = quadratic.best(free)
    rest = [n for n in free if not n.startswith(effect + ".")]
    fixed = problem.off_values(effect) | problem.file_values(effect)
    then, _ = quadratic.best(rest, fixed)
    return then - now


def loss(
    problem: Problem, quadratic: Quadratic, active: Sequence[str], effect: str, inflation: float
) -> float:
    """Nats lost when an active effect leaves and the rest is refitted, Occam factor returned.

    Args:
        problem: what may be free.
        quadratic: linearised at the fit.
        active: effects in the model.
        effect: that leaves.
        inflation: variance inflation by which the loss is divided; 1 for white innovations.
    """
    rest = [n for n in problem.free_names(active) if not n.startswith(effect + ".")]
    gone = lost(problem, quadratic, active, effect)
    return gone / inflation - quadratic.occam(problem.acting_names(effect), rest)


def threshold(problem: Problem, quadratic: Quadratic, active: Sequence[str]) -> float:
    """Nats that a cause must be worth: the settings', or more where causes explain very much.

    No form is exact: what one that explains a million nats is wrong by, another that is not there can
    explain.

    Args:
        problem: what may be free.
        quadratic: linearised at the fit.
        active: effects in the model.
    """
    explained = sum(lost(problem, quadratic, active, effect) for effect in active)
    return max(problem.settings.evidence, problem.settings.form_error * explained)


def cost(problem: Problem, fit: Fit, quadratic: Quadratic) -> float:
    """Minus the log evidence of a model, to second order [nats].

    Args:
        problem, fit: with its effects. quadratic: linearised at the fit.
    """
    own = [n for e in fit.active for n in problem.acting_names(e)]
    return fit.objective + (quadratic.occam(own, problem.base_names(fit.active)) if own else 0.0)


def inflation(problem: Problem, quadratic: Quadratic, active: Sequence[str], effect: str) -> float:
    """Variance inflation by coloured innovations in an active effect's direction, at least 1.

    Args:
        problem: what may be free.
        quadratic: linearised at the fit.
        active: effects in the model.
        effect: one of them.
    """
    own, free = problem.acting_names(effect), problem.free_names(active)
    return quadratic.variance_inflation(own, free)


def swap(
    problem: Problem, quadratic: Quadratic, active: Sequence[str], old: str, new: str
) -> tuple[float, np.ndarray]:
    """Change of the objective when one effect stands for another.

    Args:
        problem: what may be free.
        quadratic: linearised at the fit.
        active: effects in the model.
        old: the one that leaves.
        new: the one that comes.

    Returns:
        nats, Occam factors in, and the move of all parameters (k,).
    """
    now, _ = quadratic.best(problem.free_names(active))
    others = [e for e in active if e != old]
    rest = [n for n in problem.free_names(others) if n not in problem.file_values(new)]
    fixed = problem.off_values(old) | problem.file_values(new)
    then, move = quadratic.best(rest + problem.acting_names(new), fixed)

    def occam(effect: str) -> float:
        if problem.file_values(effect):
            return 0.0
        return quadratic.occam(problem.acting_names(effect), rest)

    return then + occam(new) - now - occam(old), move


def exchanges(
    problem: Problem, quadratic: Quadratic, active: Sequence[str], olds: Sequence[str]
) -> Iterator[tuple[float, str, str, np.ndarray]]:
    """Effects in the place of active ones that explain more by the quadratic, beyond a tie.

    A pair is looked at where the most that the new one could gain would do.

    Args:
        problem: what may be free.
        quadratic: linearised at the fit.
        active: effects in the model.
        olds: those of them that may leave.

    Yields:
        the change of the objective [nats], who leaves, who comes, and the move of all parameters (k,).
    """
    tie = problem.settings.tie
    now, _ = quadratic.best(problem.free_names(active))
    for old in olds:
        others = [e for e in active if e != old]
        without, gains = most_gains(problem, quadratic, others, problem.off_values(old))
        needed = tie + without - now
        needed -= quadratic.occam(problem.acting_names(old), problem.free_names(others))
        for new, gain in gains.items():
            if gain > needed and new != old:
                change, move = swap(problem, quadratic, active, old, new)
                if change < -tie:
                    yield change, old, new, move


def most_gains(
    problem: Problem, quadratic: Quadratic, active: Sequence[str], fixed: Mapping[str, float]
) -> tuple[float, dict[str, float]]:
    """The most [nats] that each other effect could gain beside some, its Occam factor deducted.

    All at once, bounds and the file values of base parameters that it replaces left out.

    Args:
        problem: what may be free.
        quadratic: linearised at the fit.
        active: the effects beside it.
        fixed: values that are held.

    Returns:
        the least value of the quadratic without any of them, and the gains.
    """
    free = problem.free_names(active)
    value, move = quadratic.best(free, fixed)
    names = {e: problem.acting_names(e) for e in problem.candidates if e not in active}
    own = [n for group in names.values() for n in group]
    if not own:
        return value, {}
    known, _ = quadratic.projected(own, free)
    i = quadratic.index(own)
    slope = quadratic.g[i] + quadratic.G[i] @ move
    known[np.diag_indices_from(known)] += quadratic.precision[i]
    log_prior = np.log(quadratic.precision[i])
    gains, at = {}, 0
    for effect, group in names.items():
        rows = slice(at, at + len(group))
        at = rows.stop
        gains[effect] = 0.5 * float(slope[rows] @ np.linalg.solve(known[rows, rows], slope[rows]))
        if not problem.file_values(effect):
            log_known = float(np.linalg.slogdet(known[rows, rows])[1])
            gains[effect] -= 0.5 * (log_known - float(log_prior[rows].sum()))
    return value, gains


def gain_by_likelihood(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str
) -> tuple[float, dict[str, float]]:
    """Predicted gain of an effect, by the slope of the likelihood itself, Occam factor deducted.

    From one filter pass with a little of it. Signatures hold the gains fixed, so that their slope lacks
    what the effect does to the gains.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        effect: of one parameter that acts, such as a damping.

    Returns:
        nats, and the effect's parameter at its optimum.
    """
    (f,) = (f for f in problem.own[effect] if f.name in problem.acting_names(effect))
    rest = problem.free_names(fit.active)
    information = float(quadratic.projected([f.name], rest)[0][0, 0])
    if information <= 0.0:
        return -math.inf, {}
    step = min(f.std, problem.settings.damping_probe / math.sqrt(information))
    there = at_optimum(problem, fit, quadratic, fit.active, {f.name: f.value + step})
    passes = problem.engine.filter(there.values, there.noise)
    gained = fit.objective - objective(passes, problem.free(fit.active), there.values)
    gained += quadratic.best(rest)[0]  # what the others would gain without it
    slope = gained / step + 0.5 * information * step
    size = min(max(slope / (information + 1.0 / f.std**2), 0.0), f.upper - f.value)
    return 0.5 * slope * size - quadratic.occam([f.name], rest), {f.name: f.value + size}
