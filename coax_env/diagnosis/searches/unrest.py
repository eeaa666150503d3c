"""Searches in air of another kind, and with readings believed less.

Where runs have air of their own (run_air.py) the search is done again in that: after the first one, and
once more in the end. Where gusts have a frequency it is done again with that in the filter
(estimation/swinging_gusts.py), if nothing is coloured then: what a model lacks may swing, too.
Swings look like single shocks to a model of gusts that fade, so they are asked first, and stand where
no shocks are left; or, unless much is coloured, where they are likelier than strengths of shocks: by
poses alone strong swings had a motor lag of 148 nats in their place (**synthetic**, clean). Jitter
that the yaw rate alone shows is asked before strengths of single shocks take it up, and gusts once more
beside it. Then whether gusts push and turn at once (joint_gusts.py). Jitter by poses alone and joint
gusts are asked only where little of what is read is coloured, since what a model lacks looks like them,
too: on a real helicopter such gusts had an arm of 0.7 m.

A likelihood that no model in reach makes white is spent on what happens within a few rows: with the
readings of a motion capture it prefers numbers that fit the last tenth of a millimetre and fly the
next second worse. So where innovations stay coloured and readings are finer than a rigid body is
(LEAST_READING_STD), the search is done again with readings no finer than that, and with readings no
finer than three times that; what flies nearest to the fitted runs in open loop over the horizon stays
(the likelihood raised to a power less than 1, for a model that is wrong: Miller and Dunson 2019,
J. Am. Stat. Assoc. 114; from one step to output error, Ljung 1999, System Identification, ch. 8).
"""

from collections.abc import Mapping
from dataclasses import replace

from coax_env.diagnosis.doubts import has_limit, sizes
from coax_env.diagnosis.fits import is_all_white, is_much_coloured
from coax_env.diagnosis.joint_gusts import in_joint_gusts
from coax_env.diagnosis.onsets.search import with_onsets
from coax_env.diagnosis.run_air import with_own_air
from coax_env.diagnosis.searches.once import Searched, flies_nearer, likelier, searched_once
from coax_env.diagnosis.searches.rotors import jittery_if_asked
from coax_env.diagnosis.shocks import in_shocks, only_shock, with_shocks
from coax_env.diagnosis.swings import with_other_swings, with_swings
from coax_env.estimation.changing_model import Lap
from coax_env.estimation.gust_strength import prior_cost
from coax_env.estimation.helicopter_noise import LEAST_READING_STD
from coax_env.estimation.state_space import Noise

COARSENESS = (1.0, 3.0)
"""Times LEAST_READING_STD that readings are believed to at most, one search after the other; ours."""
FINER = 2.0
"""Times finer than LEAST_READING_STD that a channel must be for a second search; ours."""


def in_unrest(best: Searched, noise: Noise, clock: Mapping[str, Lap], erring: bool) -> Searched:
    """Again with shocks, jitter, swings, readings believed less, where the first search asks for it.

    Args:
        best: of the first search. noise: levels to start from.
        clock: of all runs in the order in which they were flown.
        erring: whether readings have errors that last; readings are not believed less then.
    """
    best = in_own_air(best, noise)
    shaken = in_shocks(best.problem, best.fit)
    swung = _in_swings(best, noise) if shaken else None
    if shaken:
        if swung is not None and _leave_nothing(swung):
            return swung
        best, noise = jittery_if_asked(best, noise)
        shaken = in_shocks(best.problem, best.fit)
    if shaken:
        best = _changed(best, clock) or _searched_in_shocks(best, noise)
        if swung is not None and _are_swings(swung, best):
            return swung
    asked = None
    while best is not asked:
        asked = best
        swung = None if shaken else _in_swings(best, noise)
        if swung is not None and is_all_white(swung.problem, swung.fit):
            return swung
        best, noise = jittery_if_asked(best, noise)
    best = _with_joint_gusts(best, noise)
    if erring:
        return best
    problem = best.problem
    coarser = _coarser(best.fit.noise)
    if not coarser or is_all_white(problem, best.fit):
        return best
    reading = best.fit.noise.reading
    as_fitted = {c: reading[c] for c in LEAST_READING_STD if c in reading}  # they are held, too
    for factor in COARSENESS:
        problem.report("the innovations stay coloured: searching again with readings believed less")
        levels = as_fitted | {channel: factor * std for channel, std in coarser.items()}
        other = searched_once(problem, noise.with_levels(levels), coarse=True)
        if flies_nearer(other, best):
            best = other
    return best


def in_own_air(found: Searched, noise: Noise) -> Searched:
    """The search in air of each run's own, where runs have such; what was found, where not.

    Args:
        found: in the same air on all runs. noise: levels that it started from.
    """
    own = None if found.air_asked else with_own_air(found.problem, found.fit)
    if own is None or is_much_coloured(*own):
        return replace(found, air_asked=True)
    problem, _ = own
    problem.report("searching again in air of each run's own")
    return searched_once(problem, noise)


def _in_swings(found: Searched, noise: Noise) -> Searched | None:
    """The search in gusts that swing, where they do.

    Args:
        found: in gusts that fade. noise: levels that it started from.
    """
    swinging = with_swings(found.problem, found.fit)
    if swinging is None:
        return None
    problem, levels = swinging
    problem.report("gusts have a frequency: searching again with that")
    other = searched_once(problem, noise.with_levels(levels))
    again = with_other_swings(problem, other.fit)
    if again is not None:
        problem, levels = again
        problem.report("a gust has another frequency: searching again with that")
        anew = searched_once(problem, noise.with_levels(levels))
        other = anew if anew.cost < other.cost else other
    return other


def _leave_nothing(swung: Searched) -> bool:
    """Whether gusts that swing leave nothing coloured, and no shocks."""
    problem, fit = swung.problem, swung.fit
    return is_all_white(problem, fit) and not in_shocks(problem, fit)


def _are_swings(swung: Searched, shaken: Searched) -> bool:
    """Whether gusts swing for what makes a name sure more than they come in shocks.

    Not where much stays coloured, or what changed is what looked like a shock.

    Args:
        swung: in gusts that swing. shaken: with strengths of single shocks, or what changed.
    """
    if shaken.changing is not None or is_much_coloured(swung.problem, swung.fit):
        return False
    gained = _cost_with_strengths(shaken) - swung.cost
    return gained > swung.problem.settings.sure_evidence


def _changed(found: Searched, clock: Mapping[str, Lap]) -> Searched | None:
    """With what changed in flight, where that is what looks like one shock.

    A thrust that falls by a tenth is a jump of the force. A strength at its moment would believe the
    model less just there, and the change were worth nothing; so it is asked before there are any.

    Args:
        found: without strengths. clock: of all runs in the order in which they were flown.
    """
    problem = found.problem
    shock = only_shock(problem, found.fit)
    if shock is None:
        return None
    state = with_onsets(problem, found.fit, found.quadratic, found.refitted, clock, shock)
    if not state.onsets or in_shocks(state.problem, state.fit):
        return None
    return replace(found, changing=state)


def _searched_in_shocks(first: Searched, noise: Noise) -> Searched:
    """The search with a strength of the gusts for each block of time.

    First with strengths of the model without a cause, which take what a shock may be for one; then, if
    causes stand that, with strengths beside these. What a model lacks looks like shocks too, and
    strengths would believe it less just there: they must make its innovations white, or none are used.

    What pushes all the time makes every block a stronger one, and may not stand strengths of the model
    without it: a centre of gravity off by 2 mm, of 97 nats. So what did not stand them is asked once
    more with strengths beside it, and taken where that is likelier by what makes a name sure.
    """
    problem = first.problem
    beside, with_causes = with_shocks(problem, first.fit)
    if not is_all_white(beside, with_causes):
        return first
    problem.report("gusts come in single shocks: searching again with a strength for each")
    shaken, _ = with_shocks(problem, first.refitted)
    best = searched_once(shaken, noise)
    if best.fit.active:
        problem.report("searching again with strengths beside what was found")
        shaken, _ = with_shocks(best.problem, best.fit)
        best = searched_once(shaken, noise)
    if set(first.fit.active) <= set(best.fit.active):
        return best
    problem.report("searching again with strengths beside what these took up")
    other = searched_once(beside, noise)
    gained = _cost_with_strengths(best) - _cost_with_strengths(other)
    return other if gained > problem.settings.sure_evidence else best


def _cost_with_strengths(found: Searched) -> float:
    """Minus the log evidence of what was found and of the strengths it was found in [nats]."""
    return found.cost + prior_cost(found.problem.engine.records)


def _with_joint_gusts(found: Searched, noise: Noise) -> Searched:
    """The search in gusts that push and turn at once, where it ends likelier.

    Not where it needs a name at the limit of what is believed: beside noise that channels have in
    common such gusts came with an accelerometer's bias of 0.75 m/s2 on a **synthetic** flight.

    Args:
        found: with such gusts already, or without. noise: levels that it started from.
    """
    if is_much_coloured(found.problem, found.fit):
        return found
    joint = in_joint_gusts(found.problem, found.fit)
    if joint is None:
        return found
    problem, fit = joint
    problem.report("searching again with gusts that push and turn at once")
    other = likelier(searched_once(problem, noise, found.coarse), fit)
    if not other.cost < found.cost or is_much_coloured(other.problem, other.fit):
        return found
    if _at_limits(other) - _at_limits(found):
        return found
    return other


def _at_limits(found: Searched) -> set[str]:
    """Effects that have a number at the limit of what is believed."""
    return {e for e in found.fit.active if has_limit(sizes(found.problem, found.fit, e))}


def _coarser(noise: Noise) -> dict[str, float]:
    """Levels of readings that are much finer than a rigid body, as coarse as that."""
    return {
        c: LEAST_READING_STD[c]
        for c, std in noise.reading.items()
        if FINER * std < LEAST_READING_STD[c]
    }
