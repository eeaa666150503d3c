"""Which effects would do as well in a cause's place: its confounded alternatives, by refits."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from coax_env.design.discrimination import Alternative, logged_rates
from coax_env.design.next_maneuver import Design, design
from coax_env.diagnosis.evidence import (
    Evidence,
    Removal,
    as_far_apart,
    as_named,
    inflation_of,
    is_denied_where_it_shows,
    less_sure,
    weighed,
)
from coax_env.diagnosis.fits import (
    converged,
    fitted,
    is_much_coloured,
    noise_fitted,
    noise_may_hide,
)
from coax_env.diagnosis.from_afar import FAR, TURNED, in_place_of
from coax_env.diagnosis.problem import LATE_SERVO, PURE_DELAYS, Fit, Problem, exclusive_with
from coax_env.diagnosis.scores import cost, inflation, is_large, score, swap
from coax_env.diagnosis.search import search
from coax_env.estimation.prediction import mean_log_ratio, pooled_rms, replay_runs
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import FreeParameter
from coax_env.estimation.whiteness import Whiteness, whiteness
from coax_env.logs.flight import Flight
from coax_env.model.layout import CHANNELS

CHANNEL_SHARE = 0.1
"""Share of a signature above which a channel is said to show the effect; ours."""
NEAR_TIES = 3.0
"""Ties by the quadratic within which an alternative is refitted; ours."""
TWIN_STEPS = 6
"""Gauss-Newton steps from a lag to a delay of nothing, which is far; ours."""
UNCONVERGED = 2.0
"""Times what may be between them within which a twin's noise is fitted, too; ours."""

LATE = frozenset({"command_delay", "pose_delay"})
"""By poses alone one lateness: what was commanded is seen so much later. The likelihood prefers one
only because a late pose is taken from the state that a row has, to second order in its delay, where
what gusts did since is lost. All of four late poses were named late commands (**synthetic**)."""

ONE_BY_POSES = (LATE, frozenset(TURNED))
"""Effects that are one where poses alone are read. Turned markers and a turned swash plate are one
turn: in the markers' axes the same machine has its plate turned by as much, and two inertias alone say
otherwise. On 18 **synthetic** flights, by a camera and at 150 Hz, the plate is 2 to 11 nats likelier
whichever is true."""

GYRO_SCALE, FIELD = "gyro_scale", "magnetic_field"

KNOWN = 2.0
"""Std that a number must be away from nothing to be known to be another: of a 95 % interval."""

Alternatives = Mapping[str, Mapping[str, Fit]]
"""Cause -> its confounded alternatives -> the fit with each in the cause's place."""


class Settled(NamedTuple):
    """What `evidence.weighed` has of the causes, the passes with them, and their alternatives."""

    problem: Problem
    fit: Fit
    quadratic: Quadratic
    evidence: dict[str, Evidence]
    passes: list[RunPass]
    found: dict[str, dict[str, Fit]]


def alike_by_poses_alone(problem: Problem, effect: str) -> list[str]:
    """What a cause cannot be told from where neither gyros nor accelerometers are read."""
    if not problem.sees_poses_alone:
        return []
    groups = (group - {effect} for group in ONE_BY_POSES if effect in group)
    return sorted(other for group in groups for other in group & set(problem.candidates))


def twins_of(problem: Problem, effect: str) -> set[str]:
    """What is always tried in a cause's place where it is not in the model, however far it is.

    By poses alone a command that answers a gust before these show it makes rotors late, too: where the
    swash plate alone was, a late command was 38 nats likelier than that, of 800 (**synthetic**).
    """
    late = PURE_DELAYS if effect in PURE_DELAYS and problem.sees_poses_alone else frozenset()
    return exclusive_with(effect) | late


def alike_unturned(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str) -> list[str]:
    """What the scale of the gyro of r cannot be told from where headings hardly turn.

    A magnetic field bends them, as though that gyro were off by a share, and is not asked there. On two
    **synthetic** flights of 26 s it went by that name, sure.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit. effect: one of them.
    """
    asked = FIELD in problem.candidates or FIELD in problem.model.vehicle.effects
    if effect != GYRO_SCALE or asked or not {"psi", "r"} <= problem.aboard:
        return []
    std = quadratic.std(problem.free_names(fit.active))
    tilting = [f for f in problem.own[effect] if not f.name.endswith(".z")]
    shown = any(abs(fit.values[f.name] - f.value) > KNOWN * std[f.name] for f in tilting)
    return [] if shown else [FIELD]


def untold(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str) -> list[str]:
    """What no fit can tell from a cause on such flights; arguments as `alike_unturned`."""
    turned = alike_unturned(problem, fit, quadratic, effect)
    return [*alike_by_poses_alone(problem, effect), *turned]


def turn_that_tells(causes: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """`next_maneuver` of findings.json where a gyro's scale may be a magnetic field, else None.

    Args:
        causes: entries of findings.json.
    """
    alike = (c for c in causes if c["effect"] == GYRO_SCALE and FIELD in c["confusable_with"])
    if next(alike, None) is None:
        return None
    return {
        "maneuver": "heading_turn",
        "separates": [GYRO_SCALE, FIELD],
        "why": "a full turn on the spot: a field bends headings to one side, then to the other; a scale"
        " goes on to the same",
    }


def channels_of(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str) -> list[str]:
    """Channels that carry most of an active effect's signature, strongest first.

    Args:
        problem, fit: with the effect.
        quadratic: linearised at the fit.
        effect: its name.
    """
    return channels_of_numbers(fit, quadratic, problem.own[effect])


def channels_of_numbers(
    fit: Fit, quadratic: Quadratic, numbers: Sequence[FreeParameter]
) -> list[str]:
    """Channels that carry most of what some numbers do beyond their priors' means, strongest first.

    Args:
        fit: with the numbers. quadratic: linearised at the fit. numbers: free ones.
    """
    size = np.array([fit.values[f.name] - f.value for f in numbers])
    strength = size**2 @ quadratic.by_channel[quadratic.index([f.name for f in numbers])]
    order = np.argsort(-strength)
    total = strength.sum()
    return [CHANNELS[i] for i in order if total > 0.0 and strength[i] > CHANNEL_SHARE * total]


def alternatives(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    white: Mapping[str, Whiteness],
    of: Sequence[str] | None = None,
) -> dict[str, dict[str, Fit]]:
    """The confounded alternatives of every cause.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit.
        evidence: of each cause.
        white: whiteness of the innovations, by channel.
        of: the causes; default all.
    """

    def of_one(effect: str) -> dict[str, Fit]:
        shown_by = channels_of(problem, fit, quadratic, effect)
        judged = [white[c].inflation for c in shown_by if c in white]  # not of a few readings
        factor = max([evidence[effect].inflation, *judged])
        others = _of_one(problem, fit, quadratic, effect, factor, evidence[effect].lost)
        rest = evidence[effect].rest
        return {
            name: other
            for name, other in others.items()
            if rest is None or not _is_denied(problem, other, quadratic, name, rest)
        }

    return problem.for_each(of_one, fit.active if of is None else of)


def settled(problem: Problem, fit: Fit) -> Settled:
    """Causes weighed, and their alternatives; once more with a likelier one in its cause's place.

    Args:
        problem, fit: after the search.
    """

    def at(fit: Fit, denied: Collection[str] = ()) -> Settled:
        asked = problem.of_candidates(set(problem.candidates) - set(denied))
        own, there, quadratic, evidence = weighed(asked, fit)
        own = own.of_candidates(set(own.candidates) - there.denied)
        passes = own.engine.filter(there.values, there.noise)
        white = whiteness(passes, CHANNELS)
        found = alternatives(own, there, quadratic, evidence, white)
        return Settled(own, there, quadratic, evidence, passes, found)

    first = at(fit)
    denied = first.fit.denied
    again = searched_again(problem, fit, first.fit)
    if again is not None:
        second = at(again, denied)
        if set(first.fit.active) < set(second.fit.active) and not _flies_a_run_worse(second, first):
            fit, first = again, second
    other = likelier(first.problem, first.fit, first.quadratic, first.evidence, first.found)
    if other is None:
        return first
    second = at(as_named(problem, fit, other), denied)
    # what is not there in the end explained nothing: another optimum did
    return second if set(second.fit.active) == set(other.active) else first


def _flies_a_run_worse(found: Settled, other: Settled) -> bool:
    """Whether much is coloured, and one flies one of the fitted runs worse than the other.

    What acts does so in all of them. On a real helicopter (second CoaX, held out `15ft_1`) an added
    mass of 18 nats was found once a hub stiffness was denied: heights of two runs on a low battery came
    half as wrong, of the one on a full battery 2.4 times, and 55 % of the error was removed for 63. On
    another one (first CoaX) a thrust exponent of 22 nats makes both runs nearer: 54 % for 50.
    """
    if not is_much_coloured(other.problem, other.fit):
        return False
    horizon = other.problem.settings.horizon
    ours, theirs = (
        replay_runs(of.problem.engine, of.fit.values, of.fit.noise, horizon)
        for of in (found, other)
    )
    return any(
        own.diverged or mean_log_ratio(pooled_rms([own]), pooled_rms([run])) > 0.0
        for own, run in zip(ours, theirs, strict=True)
    )


def searched_again(problem: Problem, fit: Fit, left: Fit) -> Fit | None:
    """What a search adds once causes fell that stood for it, where noise may hide it; or once one fell
    that was denied, whose nats are something else's.

    Beside late rotors, which fell, nothing showed of a sonar that is late and worth 58 nats
    (`study_diagnosis.py --arms telemetry --seed 846`, one 380).

    Args:
        problem, fit: after the search. left: with the causes that stand.
    """
    fallen = set(fit.active) - set(left.active)
    if not left.denied and not (fallen and noise_may_hide(problem, fit)):
        return None
    rest = as_named(problem, fit, left)
    rest = fitted(problem, noise_fitted(problem, fitted(problem, rest)))
    problem.report("searching again without what fell")
    again, _ = search(problem.of_candidates(set(problem.candidates) - fallen), rest)
    return again if set(again.active) - set(left.active) else None


def likelier(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    found: Alternatives,
) -> Fit | None:
    """The fit with an alternative in a cause's place that is worth more than it, if any is.

    The search exchanges by the quadratic, which does not reach from a large number of one form to
    that of another: a thrust exponent of 4.4 usual sizes stood for a dynamic inflow that is true and
    was 14 nats likelier once refitted (**synthetic**). By how much does not matter: in six pairs that
    could not be told apart the true one was likelier by 0.3 to 3.9 nats (**synthetic**). What makes a
    servo late has an exchange of its own (from_afar.far_swap), whose fits converge: by 2.9 nats a
    limited rate took the place of a lag where a delay was true. Colour is never less of what comes than
    of what goes: it is read where that is.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit, the candidates in it.
        evidence: of the causes. found: their alternatives.
    """
    now = cost(problem, fit, quadratic)

    def gained(effect: str, name: str, other: Fit) -> float:
        own = evidence[effect]
        colour = max(own.inflation, inflation_of(problem, other, quadratic, name))
        return (own.lost + now - cost(problem, other, quadratic)) / colour - own.nats

    options = [
        (gained(effect, name, other), effect, name, other)
        for effect, others in found.items()
        if not problem.changes(effect)
        for name, other in others.items()
        if is_large(problem, name, other.values) and not {effect, name} <= set(LATE_SERVO)
    ]
    gain, effect, name, other = max(options, key=lambda o: o[0], default=(0.0, "", "", fit))
    if gain <= 0.0:
        return None
    problem.report(f"{name} explains it better than {effect}, by {gain:.1f} nats once refitted")
    return other.noted(f"{effect} -> {name}", gain)


def beside_alternatives(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    found: Alternatives,
) -> Fit:
    """The fit whose std of each number has in it what an alternative in another's place makes of it.

    Beside a yaw inertia that a yaw damping does as well as, a spin-up reaction was 1.72 +- 0.10, sure;
    beside the damping it is 1.1, and 1 is true (`tests/blade_element.py`, **synthetic**).

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit.
        evidence: of the causes. found: their alternatives.
    """
    for effect, others in found.items():
        rest = [n for n in problem.free_names(fit.active) if n.partition(".")[0] != effect]
        for other in others.values():
            fit = as_far_apart(problem, fit, quadratic, evidence, other, rest)
    return fit


def undecided(
    problem: Problem, fit: Fit, quadratic: Quadratic
) -> dict[str, tuple[float, np.ndarray]]:
    """What effects that these flights may neither show nor rule out would make of the free numbers.

    Each at its own best fit beside the causes, before any look as likely as not (Bayesian model
    averaging: Hoeting, Madigan, Raftery and Volinsky 1999, Statistical Science 14). A hub stiffness was
    worth -0.3 nats beside inertias 17 % off; with it a spin-up reaction of 1.21 +- 0.04 is 0.93, and 1
    is true (`tests/blade_element.py`, **synthetic**).

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit, the candidates in it.

    Returns:
        by effect its probability and the move in the order of `problem.free_names`, (k,); none without
        a cause.
    """
    if not fit.active:
        return {}
    free = problem.free_names(fit.active)
    beside = {e for active in fit.active for e in exclusive_with(active)}.union(fit.active)
    others = [e for e in problem.candidates if e not in beside and not problem.file_values(e)]
    at = quadratic.index(free)
    _, now = quadratic.best(free)
    found = {}
    for effect in others:
        nats = score(problem, quadratic, fit.active, effect).nats
        _, move = quadratic.best([*free, *problem.acting_names(effect)])
        found[effect] = (float(expit(nats)), (move - now)[at])
    return found


def of_undecided(problem: Problem, fit: Fit, quadratic: Quadratic) -> np.ndarray:
    """Covariance (k, k) of the free numbers by effects that are undecided; zero without a cause.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit, the candidates in it.
    """
    count = len(problem.free_names(fit.active))
    moves = undecided(problem, fit, quadratic).values()
    return sum((p * np.outer(move, move) for p, move in moves), np.zeros((count, count)))


def beside_undecided(
    problem: Problem, fit: Fit, quadratic: Quadratic, evidence: Mapping[str, Evidence]
) -> Fit:
    """The fit whose std of each number has in it what undecided effects make of it.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit, the candidates in it.
        evidence: of the causes, with the inflation of their variances.
    """
    spread = np.sqrt(np.diag(of_undecided(problem, fit, quadratic)))
    names = problem.free_names(fit.active)
    apart = dict(zip(names, spread.tolist(), strict=True))
    return less_sure(problem, fit, quadratic, evidence, apart)


def _of_one(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    effect: str,
    inflation: float,
    lost: float,
) -> dict[str, Fit]:
    """Effects that would do as well in this one's place, by refitted likelihood, and those refits.

    Coloured innovations carry less information than they seem to: the tie widens by their variance
    inflation, up to half of what is `lost` (nats) with nothing in the effect's place.
    """
    chosen = problem.settings
    tie = min(chosen.tie * inflation, max(0.5 * lost, chosen.tie))

    def refit(other: str, move: np.ndarray, steps: int) -> Fit:
        begun = replace(fit.at(quadratic.moved(move)), active=fit.instead(effect, other))
        return fitted(problem, begun, steps)

    found = {}
    for other, move in _near(problem, fit, quadratic, effect, NEAR_TIES * tie):
        trial = refit(other, move, steps=2)
        if trial.objective - fit.objective < tie:
            found[other] = trial
    # a lag is far from a delay of nothing: the quadratic does not reach there, and both may be there
    absent = set(problem.candidates) - set(found) - set(fit.active)
    # a real servo is late, and limited when it has far to go
    alike = max(tie, chosen.form_share * lost if effect in LATE_SERVO else 0.0)
    for other in sorted(FAR.get(effect, frozenset()) & absent):
        if problem.changes(effect) or problem.changes(other):
            continue  # it has two sizes, and no likeliest one
        trial = in_place_of(problem, fit, quadratic, effect, other)
        if trial.objective - fit.objective < alike:
            found[other] = trial
    for twin in sorted(twins_of(problem, effect) & absent - set(found)):
        _, move = swap(problem, quadratic, fit.active, effect, twin)
        trial = refit(twin, move, steps=TWIN_STEPS)
        mixed = score(problem, quadratic, fit.active, twin).evidence > chosen.evidence
        most = max(alike, chosen.form_share * lost if problem.sees_poses_alone else 0.0)
        if most < trial.objective - fit.objective < UNCONVERGED * most:
            trial = converged(problem, trial)
        if mixed or trial.objective - fit.objective < most:
            found[twin] = trial
    return found


def _is_denied(problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, rest: Fit) -> bool:
    """Whether an alternative does not act where it should show, as no cause may.

    Args:
        problem, fit: with it in a cause's place. quadratic: linearised with the cause.
        effect: the alternative. rest: with neither.
    """
    colour = inflation(problem, quadratic, fit.active, effect)
    removal = Removal(Evidence(rest.objective - fit.objective, colour), rest)
    return is_denied_where_it_shows(problem, fit, removal)


def _near(
    problem: Problem, fit: Fit, quadratic: Quadratic, effect: str, most: float
) -> list[tuple[str, np.ndarray]]:
    """Effects that lose less than `most` nats in this one's place by the quadratic, best first.

    They must do something there: at least half of what the effect itself gains.
    """
    now, _ = quadratic.best(problem.free_names(fit.active))
    nothing, _ = quadratic.best(problem.free_names(fit.rest(effect)), problem.off_values(effect))
    near = []
    for other in problem.candidates:
        if other not in fit.active:
            change, move = swap(problem, quadratic, fit.active, effect, other)
            does_something = nothing - now - change > 0.5 * (nothing - now)
            if change < most and does_something:
                near.append((change, other, move))
    best = sorted(near, key=lambda n: n[0])[: problem.settings.most_trials]
    return [(other, move) for _, other, move in best]


def separating_maneuver(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    found: Alternatives,
    strongest_first: Sequence[str],
    flight: Flight,
) -> Design | None:
    """The maneuvers that separate the strongest confounded cause from its alternatives.

    What the flights determine of the alternatives' numbers is taken from the final quadratic.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit.
        found: the confounded alternatives.
        strongest_first: the causes.
        flight: whose sensors' rates are assumed.
    """
    confounded = next((effect for effect in strongest_first if found[effect]), None)
    if confounded is None:
        return None
    problem.report("designing the next maneuver")
    described = []
    for name, refit in {confounded: fit, **found[confounded]}.items():
        free = problem.free_of_vehicle(refit.active)
        i = quadratic.index([f.name for f in free])
        described.append(
            Alternative.of(
                name, problem.model.vehicle, free, refit.values, quadratic.G[np.ix_(i, i)]
            )
        )
    return design(described, fit.noise, logged_rates(flight))
