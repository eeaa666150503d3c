"""What each cause is worth once everything else, noise levels too, is refitted without it.

A cause must be worth the threshold twice: to the likelihood of the readings alone, and where commands
show the gusts (input_innovations.py) with that too. Alone, a pilot who flies the gusts out looks like a
late servo. With it, a damping: the gains are constant and the filter's covariances do not know of them,
so that readings correct once more what the commands have corrected, and a rate that is damped takes
half of it back. `rate_damping` was worth 44 and 50 nats so on clean synthetic flights by telemetry
where, alone, it was worth less than nothing.

The numbers are those with the gains where these are stated: innovations white, gyros or accelerometers
aboard, rows not slow. By poses alone a gust shows long after the command that answers it, which no
constant gain says: of nine **synthetic** flights five had a number 2.5 to 6.5 std off with the gains, a
motor lag of 72 ms as 49 +- 5 and an exponent of the wrong sign; without, two, 2.4 and 2.5. Nor between
slow rows: a servo's delay of 35 ms was 14 +- 3 with them, 28 +- 3 without. How far the two are apart is
a part of the std there: a spin-up reaction of 1.00 was 0.77 +- 0.05 without, 0.91 +- 0.06 with them,
one of 1.20 0.85 +- 0.05 and 0.65 +- 0.04. Where the gains are stated it is a part of the std of the
vehicle's own numbers: where a stabiliser flew, a flap's time constant was 18 and 24 % off with them,
5.5 and 8 std, and 1 and 0 % without (**synthetic**, clean).

Neither likelihood knows what the commands did between rows that are far apart, nor what a pilot saw
coming of gusts that are not as the filter has them (with a frequency, say); and what is left of a
sensor's low-pass, taken back by its likeliest form, is itself a late answer. What looks like a weak or
late answer must be worth several times as much there (`Settings.unseen_inflation`). So must a weak one
by poses alone, where colour takes no more than that from it already: a command that answers a gust
before poses show it makes an answer weak or slow, and none late by a constant time. Unless it gains its
nats where the flights show it and not all the time, as such answers do (where_shown.py).
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from coax_env.diagnosis.fits import (
    converged,
    fitted,
    flown_errors,
    is_all_white,
    is_much_coloured,
    noise_fitted,
    only,
    quadratic_at,
    with_latent_noise,
    without,
)
from coax_env.diagnosis.from_afar import far_swap
from coax_env.diagnosis.input_innovations import has_command_gains, with_command_gains
from coax_env.diagnosis.moves import TOO_SMALL, dropped_in_brief_gusts
from coax_env.diagnosis.problem import (
    OWN_WEAK_OR_LATE,
    WEAK_OR_LATE,
    Fit,
    Problem,
)
from coax_env.diagnosis.refinement import refined
from coax_env.diagnosis.scores import inflation, is_large, loss, threshold
from coax_env.diagnosis.where_shown import beyond_even_spread, size_where_most
from coax_env.estimation.parted_engine import PartedEngine
from coax_env.estimation.prediction import mean_log_ratio
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.whiteness import whiteness
from coax_env.model.effects import CATALOGUE
from coax_env.model.layout import ACCELEROMETERS

WEAK = 3.0
"""Thresholds below which a cause is weighed before stronger ones: most of what is removed is; ours."""
AMISS = 2.0
"""Times what the quadratic foretells that a refit without a cause may lose and be believed at once. One
that had not converged lost 3,706 nats where 182 were foretold, and 2 in the end: a play, sure, on a
clean **synthetic** flight; ours."""


@dataclass(frozen=True)
class Evidence:
    """What a cause is worth. lost: nats without it. inflation: variance inflation in its direction.
    against: channels that should show it and whose readings are likelier without it, beyond chance, and
    by how many nats. rest: the fit without it. times: what of the inflation is by commands that answer
    what the filter does not see. where_shown: whether it gains its nats where it shows, and so in spite
    of them."""

    lost: float
    inflation: float
    against: Mapping[str, float] = field(default_factory=dict)
    rest: Fit | None = None
    times: float = 1.0
    where_shown: bool = False

    @property
    def nats(self) -> float:
        """What colour, and commands for what the filter does not see, leave of what is lost."""
        return self.lost / (self.colour if self.where_shown else self.inflation)

    @property
    def colour(self) -> float:
        """What of the inflation is by coloured innovations."""
        return self.inflation / self.times

    def lesser(self, other: "Evidence") -> "Evidence":
        """This, worth no more than another."""
        least = min(self, other, key=lambda of: of.nats)
        return replace(least, against=self.against, rest=self.rest)


@dataclass(frozen=True)
class Removal:
    """What a cause is worth, and the fit without it."""

    evidence: Evidence
    rest: Fit


def weigh(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    which: Sequence[str],
    enough: float = -math.inf,
) -> dict[str, Removal]:
    """Evidence of active effects, each from a refit without it.

    Args:
        problem, fit: what may be free, and where.
        quadratic: linearised at the fit.
        which: the effects.
        enough: nats that a cause must be worth; a refit that loses less need not converge.
    """
    chosen = problem.settings

    def one(effect: str) -> Removal:
        held = tuple(problem.file_values(effect))
        factor = inflation_of(problem, fit, quadratic, effect)
        colour = inflation(problem, quadratic, fit.active, effect)
        tells = factor > colour and problem.tells_by_spread(effect)
        rest = noise_fitted(problem, without(problem, fit, quadratic, effect))
        rest = fitted(problem, rest, steps=1, held=held)
        lost = rest.objective - fit.objective
        foretold = loss(problem, quadratic, fit.active, effect, 1.0)
        clear = chosen.clear * factor
        least = enough * (colour if tells else factor)
        if least < lost < clear or lost > AMISS * foretold:
            rest = converged(problem, rest, held)
        lost = float(rest.objective - fit.objective)
        where_shown = (
            tells
            and lost / colour >= chosen.evidence
            and beyond_even_spread(problem, fit, rest) >= chosen.beyond_even_spread
        )
        worth = Evidence(lost, factor, times=factor / colour, where_shown=where_shown)
        return Removal(worth, rest)

    return problem.for_each(one, which)


def prune(
    problem: Problem, fit: Fit, again: bool = False
) -> tuple[Fit, Quadratic, dict[str, Evidence]]:
    """Remove, one at a time, causes whose evidence is gone once the noise levels are fitted too.

    What is in doubt is weighed first, by what it was worth before or the quadratic: the clear ones wait
    until nothing is removed. What has no evidence by the quadratic is weighed before the fit is
    refined, which takes as long as all else here.

    Args:
        problem, fit: what may be free, and where.
        again: whether these causes were weighed, and asked from brief gusts, in another model of the
            commands: only those that the quadratic has as weak are weighed in this one, too.

    Returns:
        the fit, refined where something was weighed, the quadratic at it, with the candidates then, and
        the evidence of what is left and was weighed.
    """
    worth: dict[str, float] = {}  # as weighed beside other causes
    while True:
        fit = _without_small(problem, converged(problem, fit))
        alone = problem.of_candidates(fit.active)
        fit, quadratic = quadratic_at(alone, fit)
        better = _without_hopeless(problem, fit, quadratic)
        if better is not None:
            fit = with_latent_noise(problem, better) or better
            continue
        if fit.active and not _asked(problem, fit, quadratic, again, worth):
            return fit, quadratic, {}
        beside = problem if fit.active else alone  # for whom could the candidates stand?
        fit, quadratic = quadratic_at(beside, refined(problem, fit))
        enough = threshold(problem, quadratic, fit.active)
        removals: dict[str, Removal] = {}
        for which in _asked(problem, fit, quadratic, again, worth):
            removals |= weigh(problem, fit, quadratic, which, enough)
            worth |= {e: removals[e].evidence.nats for e in which}
            better = _better(problem, fit, enough, removals)
            if better is not None:
                break
        else:
            better = None if again else _in_brief_gusts(problem, fit, quadratic, enough, removals)
            if better is None:
                left = {e: removals[e] for e in fit.active if e in removals}
                if again:
                    return fit, quadratic, {e: removal.evidence for e, removal in left.items()}
                return fit, quadratic, beside_channels(problem, fit, left)
        fit = with_latent_noise(problem, better) or better


def beside_channels(
    problem: Problem, fit: Fit, removals: Mapping[str, Removal]
) -> dict[str, Evidence]:
    """The evidence of each cause, and which channels speak against it.

    What acts makes no channel less likely that should show it: of 40 true causes on **synthetic**
    flights by two simulators none lost more than 6 nats in one. A sensor that is late, or in error, may
    look like a cause in its own readings and in no other's: rotor speeds that were averaged over 50 ms
    were a motor lag of 21 ms, sure, for 10,000 nats, that the vertical acceleration was 276 nats
    likelier without. In other channels, by what the filter makes of it, true ones lost up to 203.
    A rest has other noise levels, by which one channel may gain what another loses: heading 527 nats
    without an attitude that is late by 54 ms and worth 12,769, a yaw rate 154 without a motor's droop
    of 1,814 beside rotors that jitter. So a channel must be likelier at the levels with the cause, too.

    Args:
        problem, fit: with the causes. removals: of each.
    """
    chosen = problem.settings
    with_it = problem.engine.likelihood_by_channel(fit.values, fit.noise) if removals else 0.0
    found = {}
    for effect, removal in removals.items():
        rest, worth = removal.rest, removal.evidence
        gained = np.minimum(
            *(problem.engine.likelihood_by_channel(rest.values, n) for n in (rest.noise, fit.noise))
        )
        least = max(chosen.evidence, chosen.against_share * worth.lost) * worth.inflation
        named = dict(zip(problem.model.channels, (gained - with_it).tolist(), strict=True))
        shown = [c for c in CATALOGUE[effect].channels if named.get(c, 0.0) > least]
        against = {c: named[c] / worth.inflation for c in shown}
        found[effect] = replace(worth, against=against, rest=rest)
    return found


def _without_small(problem: Problem, fit: Fit) -> Fit:
    """Without causes that have become too small to matter in prediction.

    A refit without one may end elsewhere, and call it worth what lies between: a hub stiffness of
    nothing was worth 83 nats (**synthetic**).
    """
    for effect in fit.active:
        if not is_large(problem, effect, fit.values):
            problem.report(f"dropped {effect}: {TOO_SMALL}")
            fit = only(problem, fit, fit.rest(effect)).noted(f"- {effect}", 0.0)
    return fit


def _in_brief_gusts(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    enough: float,
    removals: Mapping[str, Removal],
) -> Fit | None:
    """The fit without weak causes that gusts may hide or stand for, where these are worth too little
    from brief ones.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit.
        enough: nats that causes must be worth.
        removals: of causes that stand, each from the fit's own gusts.
    """
    clear = problem.settings.clear
    worth = {e: removal.evidence.nats for e, removal in removals.items()}
    weak = [e for e in worth if worth[e] < clear and e in WEAK_OR_LATE]
    if len(weak) > 1 and len(weak) == len(fit.active):
        weak.remove(max(weak, key=lambda e: worth[e]))
    for gone in [weak, *([e] for e in weak if len(weak) > 1)]:
        rest = dropped_in_brief_gusts(problem, fit, quadratic, gone, enough)
        if rest is not None:
            return rest
    return None


def _asked(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    again: bool,
    worth: Mapping[str, float],
) -> list[list[str]]:
    """Causes that are to be weighed together: weak ones, others in doubt, the rest.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit. again: as of `prune`.
        worth: of those that were weighed beside other causes [nats]; of the others the quadratic says.
    """
    by_quadratic = {e: _worth(problem, fit, quadratic, e) for e in fit.active}
    most = WEAK * problem.settings.evidence
    doubt = most if again else problem.settings.clear
    doubtful = [e for e in fit.active if by_quadratic[e] < doubt]
    rest = [] if again else [e for e in fit.active if e not in doubtful]
    weak = [e for e in doubtful if worth.get(e, by_quadratic[e]) < most]
    other = [e for e in doubtful if e not in weak]
    return [which for which in (weak, other, rest) if which]


def _without_hopeless(problem: Problem, fit: Fit, quadratic: Quadratic) -> Fit | None:
    """As `_better`, of causes that lack more than a tie both by the quadratic and by a refit."""
    enough = threshold(problem, quadratic, fit.active)
    most = enough - problem.settings.tie
    asked = [e for e in fit.active if _worth(problem, fit, quadratic, e) < most]
    removals = weigh(problem, fit, quadratic, asked, most)
    hopeless = {e: r for e, r in removals.items() if r.evidence.nats < most}
    return _better(problem, fit, enough, hopeless)


def weighed(problem: Problem, fit: Fit) -> tuple[Problem, Fit, Quadratic, dict[str, Evidence]]:
    """The causes that stand by the readings alone and with the gains of the commands, where those are.

    Args:
        problem, fit: after the search, without such gains.

    Returns:
        the problem, with the gains where they are worth it and innovations white, what `prune` has of
        it, and the lesser evidence of the two.
    """
    problem = replace(problem, unlike_gusts=_unlike_gusts(problem, fit))
    exchanged = False  # at most once
    while True:
        wider, trial = with_command_gains(problem, fit, coloured=True)
        # colour, and gusts that no reading feels in time, spoil them for a model, not to ask with
        stated = has_command_gains(wider) and _feels_gusts(problem) and is_all_white(problem, fit)
        joint, alone = (wider, trial), (problem, fit)
        (first, start), (second, again) = (joint, alone) if stated else (alone, joint)
        pruned, quadratic, evidence = prune(first, start)
        swapped = None if exchanged else far_swap(first, pruned, quadratic)
        if swapped is not None:
            fit, exchanged = as_named(problem, fit, swapped), True
            continue
        if not has_command_gains(wider):
            return first, pruned, quadratic, evidence
        rest = only(second, again, pruned.active)
        if pruned.active:
            asked, _, other = prune(second, rest, again=True)
        else:
            asked, other = fitted(second, rest), {}
        if asked.active == pruned.active:
            lesser = {e: own.lesser(other.get(e, own)) for e, own in evidence.items()}
            if not _feels_gusts(problem):
                pruned = beside_unseen_answers(problem, pruned, quadratic, evidence, asked)
            elif stated:
                own = problem.base_names(pruned.active)
                pruned = as_far_apart(problem, pruned, quadratic, evidence, asked, own)
            return first, pruned, quadratic, lesser
        denied = pruned.denied | asked.denied
        fit = replace(only(problem, fit, asked.active), denied=denied)


def beside_unseen_answers(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    other: Fit,
) -> Fit:
    """The fit whose std of each number has in it what commands that answer unseen gusts make of it.

    How far their gains move it; and what comes of the vehicle's own numbers that make it weak or late,
    whose variance is as many times larger than it seems as such an effect's worth is smaller
    (`Settings.unseen_inflation`). On 28 **synthetic** flights by poses alone, fresh, with the causes
    given, errors over std were 1.6, 1.7, 2.3 and 3.0 (root mean square: inertias about x, y and z, time
    constant of the flaps); with the first 1.4, 1.4, 1.5 and 1.5, with both 0.9, 0.9, 1.0 and 1.3.

    Args:
        problem, fit: by the readings alone. quadratic: linearised at the fit.
        evidence: of the causes, with the inflation of their variances. other: with the gains.
    """
    fit = as_far_apart(problem, fit, quadratic, evidence, other)
    names = problem.free_names(fit.active)
    covariance = quadratic.covariance(names)
    slack = [i for i, name in enumerate(names) if name in OWN_WEAK_OR_LATE]
    across = covariance[:, slack]
    share = np.einsum("ij,ij->i", across, np.linalg.solve(across[slack], across.T).T)
    more = np.sqrt((problem.settings.unseen_inflation - 1.0) * np.maximum(share, 0.0))
    return less_sure(
        problem, fit, quadratic, evidence, dict(zip(names, more.tolist(), strict=True))
    )


def as_far_apart(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    other: Fit,
    names: Collection[str] | None = None,
) -> Fit:
    """The fit whose std of some numbers has in it how far they are from the other fit's.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit.
        evidence: of the causes, with the inflation of their variances. other: of the same numbers.
        names: of the numbers; default all that are free.
    """
    names = problem.free_names(fit.active) if names is None else names
    apart = {name: other.values[name] - fit.values[name] for name in names}
    return less_sure(problem, fit, quadratic, evidence, apart)


def less_sure(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    apart: Mapping[str, float],
) -> Fit:
    """The fit whose std of some numbers has in it how far they may be from where they are.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit.
        evidence: of the causes, with the inflation of their variances.
        apart: number -> how far, in its unit.
    """
    std = quadratic.std(problem.free_names(fit.active))
    ratios = dict(fit.std_ratio)
    for name, far in apart.items():
        known = evidence.get(name.partition(".")[0])
        stated = std[name] * math.sqrt(known.inflation if known else 1.0)
        ratios[name] = math.hypot(ratios.get(name, 1.0), far / stated)
    return replace(fit, std_ratio=ratios)


def _unlike_gusts(problem: Problem, fit: Fit) -> bool:
    """Whether no accelerometer's innovations are white: forces of every axis come otherwise."""
    passes = problem.engine.filter(fit.values, fit.noise)
    seen = whiteness(passes, problem.model.channels)
    logged = [seen[channel].white for channel in ACCELEROMETERS if channel in seen]
    return len(logged) == len(ACCELEROMETERS) and not any(logged)


def _feels_gusts(problem: Problem) -> bool:
    """Whether gyros or accelerometers are aboard, and read before a command answers what they feel."""
    return not problem.has_slow_rows and not problem.sees_poses_alone


def as_named(problem: Problem, fit: Fit, other: Fit) -> Fit:
    """The fit with the causes of another one, those that it does not have at their numbers there.

    Args:
        problem, fit: before anything was weighed. other: with the causes.
    """
    rest = only(problem, fit, other.active)
    new = [f.name for e in other.active if e not in fit.active for f in problem.own[e]]
    there = rest.at({name: other.values[name] for name in new})
    return replace(there, active=other.active, denied=other.denied)


def inflation_of(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str) -> float:
    """What colour, and commands for what the filter does not see, make of a cause's variance.

    Args:
        problem, fit: with the cause. quadratic: with its numbers. effect: the cause.
    """
    colour = inflation(problem, quadratic, fit.active, effect)
    if effect not in WEAK_OR_LATE:
        return colour
    times = problem.times_unseen(effect)
    # what poses show late colours them, where they are fine enough to show it
    return colour * times if problem.answers_unseen else max(colour, times)


def _worth(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str) -> float:
    """Nats of a cause by the quadratic, colour and slow rows allowed for."""
    factor = inflation_of(problem, fit, quadratic, effect)
    return loss(problem, quadratic, fit.active, effect, factor)


def _better(
    problem: Problem, fit: Fit, enough: float, removals: Mapping[str, Removal]
) -> Fit | None:
    """A fit to go on from: with noise levels of larger likelihood, else without the weakest cause, if
    that is worth too little or denied where the flights show most of it.

    A model with one cause less cannot be likelier but by its noise levels: the fit's have then not
    converged, and the cause has its say beside better ones before it may be removed.
    """
    if not removals:
        return None
    weakest_first = sorted(removals.items(), key=lambda item: item[1].evidence.nats)
    _, weakest = weakest_first[0]
    if weakest.evidence.lost < -problem.settings.tie:
        again = converged(problem, replace(fit, noise=weakest.rest.noise))
        if again.objective < fit.objective - problem.settings.tie:
            return again
    for effect, removal in weakest_first:
        nats = removal.evidence.nats
        if nats >= enough:
            break
        if not stays_without_a_name(problem, fit, removal, enough):
            problem.report(f"dropped {effect}: worth {nats:.1f} nats in the end")
            return removal.rest.noted(f"- {effect}", max(nats, 0.0))
    for effect, removal in weakest_first:
        if is_denied_where_it_shows(problem, fit, removal):
            problem.report(f"dropped {effect}: where most of it should show it does not act")
            rest = removal.rest.noted(f"- {effect}", removal.evidence.nats)
            return replace(rest, denied=rest.denied | {effect})
    return None


def is_denied_where_it_shows(problem: Problem, fit: Fit, removal: Removal) -> bool:
    """Whether a cause that is not clear does not act where the flights should show most of it.

    On a real helicopter (first CoaX) a motor's droop of 63 nats had half its size there: speeds that
    were commanded as a run began, 0.8 % of the time, spoke for half of it, and against it. Without it a
    late command has one size, 0.97 where most of it shows for 1.25, and the heading of the run held out
    is 0.49 rad wrong after a second for 0.54. Where much is coloured the model is wrong elsewhere, and
    that may speak against it: on another one (second CoaX, held out `15ft_2`) a gyro that turns 1.2
    times as much as the heading was denied so, and 14 % of the error removed for 27. So it stays there
    if the fitted runs are flown worse without it.

    Args:
        problem, fit: with the cause. removal: of the cause.
    """
    worth = removal.evidence
    if not problem.settings.evidence <= worth.nats < problem.settings.clear:
        return False
    there = size_where_most(problem, fit, removal.rest, worth.colour)
    if there is None or not there.is_denied:
        return False
    return not (is_much_coloured(problem, fit) and _flies_worse_without(problem, fit, removal))


def stays_without_a_name(problem: Problem, fit: Fit, removal: Removal, enough: float) -> bool:
    """Whether a cause stays in the model though colour takes its evidence: it is worth enough without,
    and the fitted runs are flown worse without the cause.

    Where much is coloured, the noise stands for what the model lacks, and takes a cause up that leaves;
    the next one has less evidence then. On a real helicopter (first CoaX, held out `circles`), noise
    fitted a little further, a yaw damping of 33 nats had 13 left, a nat too few, and fell; so did a
    swash offset and a blow-back of 61; 2 % of the error was removed, where 51 had been.

    Args:
        problem, fit: with the cause. removal: of the cause. enough: nats that it must be worth.
    """
    chosen, worth = problem.settings, removal.evidence
    if not worth.nats < chosen.evidence <= enough <= worth.lost:
        return False  # with more evidence it would have a name
    if isinstance(problem.engine, PartedEngine) or not is_much_coloured(problem, fit):
        return False
    return _flies_worse_without(problem, fit, removal)


def _flies_worse_without(problem: Problem, fit: Fit, removal: Removal) -> bool:
    """Whether the fitted runs are flown worse without a cause."""
    flown, without_it = (flown_errors(problem, f) for f in (fit, removal.rest))
    return mean_log_ratio(flown, without_it) < 0.0
