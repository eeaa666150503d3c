"""Causes weighed once the search has ended.

Data flow::

    search -> onsets -> generic terms -> evidence and confounded alternatives -> moments of onsets
        -> std that have in them what these flights do not tell -> numbers that fly nearest
"""

from collections.abc import Mapping
from dataclasses import dataclass

from coax_env.diagnosis import confounding, onboard_filter, slow_commands, unlisted
from coax_env.diagnosis.confounding import Settled
from coax_env.diagnosis.evidence import less_sure
from coax_env.diagnosis.flown_numbers import flying_nearest, numbers_apart
from coax_env.diagnosis.large_numbers import beside_large_axes, less_sure_beside_large_numbers
from coax_env.diagnosis.onsets.changing import Onset
from coax_env.diagnosis.onsets.moment import moments_of
from coax_env.diagnosis.onsets.search import beside_onsets, with_onsets
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.searches.searched import Searched
from coax_env.diagnosis.shock_evidence import in_own_strengths
from coax_env.diagnosis.unlisted import Candidate
from coax_env.estimation.changing_model import Lap
from coax_env.estimation.whiteness import Whiteness, whiteness
from coax_env.model.layout import CHANNELS


@dataclass(frozen=True)
class Weighed:
    """Causes weighed, and the model with them.

    Attributes:
        settled: the likeliest fit with them, their evidence and their alternatives.
        flown: the fit with the numbers that are stated (flown_numbers.py).
        white: whiteness of the innovations, by channel.
        onsets: of causes that began or changed in flight.
        terms: generic ones, for what no effect explains.
    """

    settled: Settled
    flown: Fit
    white: Mapping[str, Whiteness]
    onsets: Mapping[str, Onset]
    terms: list[Candidate]


def weighed_causes(first: Searched, clock: Mapping[str, Lap]) -> Weighed:
    """What a search has found, weighed.

    Args:
        first: the search. clock: of the flight's runs.
    """
    state = first.changing or with_onsets(
        first.problem, first.fit, first.quadratic, first.refitted, clock
    )
    problem, fit, quadratic, terms = unlisted.explain(state.problem, state.fit, state.quadratic)
    problem.report("weighing the causes against their confounded alternatives")
    settled = confounding.settled(beside_large_axes(problem, fit), fit)
    settled = settled._replace(
        evidence=in_own_strengths(settled.problem, settled.fit, settled.evidence)
    )
    white = whiteness(settled.passes, CHANNELS)
    problem, fit, quadratic, evidence, _, found = settled
    onsets = moments_of(problem, fit, quadratic, evidence, state.onsets)
    fit = _as_sure_as_told(settled, changing=bool(onsets))
    found = found | beside_onsets(problem, fit, evidence, white, onsets)
    problem.report("asking which numbers fly nearest")
    flown = flying_nearest(problem, fit)
    flown = less_sure(problem, flown, quadratic, evidence, numbers_apart(fit, flown))
    return Weighed(settled._replace(fit=fit, found=found), flown, white, onsets, terms)


def _as_sure_as_told(settled: Settled, changing: bool) -> Fit:
    """The fit whose std have in them what these flights do not tell."""
    problem, fit, quadratic, evidence, _, found = settled
    fit = confounding.beside_alternatives(problem, fit, quadratic, evidence, found)
    fit = confounding.beside_undecided(problem, fit, quadratic, evidence)
    fit = less_sure_beside_large_numbers(problem, fit, quadratic, evidence)
    if problem.of_onboard_filter:
        fit = less_sure(problem, fit, quadratic, evidence, onboard_filter.followed(problem, fit))
    if not changing:
        fit = slow_commands.beside_straight_lines(problem, fit, quadratic, evidence)
    return fit
