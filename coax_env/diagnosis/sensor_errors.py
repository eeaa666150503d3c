"""Whether errors of readings last, as those of an onboard filter, a compass or GNSS do.

Asked after a search, where innovations of attitudes, height, velocities or position stay coloured and
gyros and accelerometers are aboard that feel the motion itself: by poses alone an error that lasts and
what moves the body are one. But for an attitude, whose tilt the position feels, and whose mean has been
named: a bias of 59 nats, sure, was errors that lasted 20 s on a clean **synthetic** flight.

And where something is named while a white force stands beside the gusts: to a model whose sensors do
not err an accelerometer that drifts feels one, and its innovations are white then. A sonar's scale of
20 nats was that (`--arms mixed`, seed 631, one 4), where such errors are worth 180.

And always where attitudes are an onboard filter's, which are read once a second (onboard_filter.py) and
cannot look coloured then: gyros that drift by 0.01 rad/s were taken for a stabiliser bar with half its
following time, of 17 and 28 nats on clean **synthetic** flights (`--arms mixed`, seed 611, clean 6 and
9). Such errors are worth 670 and 120 nats there.

Levels and memories of all readings' errors are fitted then, those of gyros and accelerometers too
(estimation/lasting_errors.py). What a model lacks lasts as well: no reading of the motion may be
coloured then, or none is used. A bias that is worth less than such errors is doubtful then, since a
sensor that drifts has one: accelerometers of 0.04 m/s2 and 7 s, beside readings with noise in common
and a wrong clock, had a bias since 12 s of a run, 65 nats, sure, on a clean **synthetic** flight
(`--arms mixed`, seed 650, clean 2). Gyros and accelerometers may be coloured, which feel gusts of
another law, or are smoothed: asked of them too, errors that were worth 1,700 nats were not used beside
one-sided gusts, and a clean **synthetic** flight had a false name (`--arms mixed`, seed 100).
"""

from dataclasses import dataclass, replace

from coax_env.diagnosis.fits import converged, fitted, noise_fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.helicopter_noise import ERROR_LEVELS, ERROR_MEMORIES, error_level
from coax_env.estimation.lasting_errors import (
    ErringModel,
    reading_std,
    with_errors,
    without_errors,
)
from coax_env.estimation.state_space import Noise
from coax_env.estimation.whiteness import are_white, whiteness
from coax_env.model.layout import (
    ACCELEROMETERS,
    ERRING_GROUPS,
    GYROS,
    MOTION,
    SENSOR_GROUPS,
)
from coax_env.plain_words import and_list

FELT_BY = {"attitude": GYROS, "heading": GYROS} | dict.fromkeys(
    ("height", "velocity", "position"), ACCELEROMETERS
)
"""Sensors that tell a group's motion from errors of its readings."""
BIAS = "attitude_bias"
"""The mean of errors of attitudes that last; by poses alone they are asked where it is named."""
FORCES = ("white_force_xy", "white_force_z")
WHITE = 100.0
"""Times the floor of its level from which a white force stands for something: 0.05 N s^1/2 of a machine
of 1 kg; ours."""
SMALL = 0.15
"""Of their readings' own noise, up to which a group's lasting errors may be left out together, if that
costs no more than convergence does; ours."""
LEVELS_OF_ERRORS = (*ERROR_LEVELS, *ERROR_MEMORIES)


@dataclass(frozen=True)
class LastingErrors:
    """A model whose readings have errors that last, worth more than a cause must be.

    Attributes:
        problem: with such errors. fit: in it, with what had been found.
        begun: levels to start a search from.
        gained: what they are worth [nats]. whiten: whether no reading of the motion is coloured then.
    """

    problem: Problem
    fit: Fit
    begun: Noise
    gained: float
    whiten: bool


def lasting_errors(problem: Problem, fit: Fit, noise: Noise) -> LastingErrors | None:
    """Errors of readings that last, where something asks for them and they are worth it.

    Args:
        problem, fit: after a search. noise: levels that it started from.
    """
    channels = problem.model.channels
    seen = whiteness(problem.engine.filter(fit.values, fit.noise), channels)
    asked = [
        group
        for group, felt_by in FELT_BY.items()
        if problem.aboard.issuperset(felt_by)
        and not problem.aboard.isdisjoint(SENSOR_GROUPS[group])
        and (problem.of_onboard_filter or not are_white(seen, SENSOR_GROUPS[group]))
    ]
    if problem.sees_poses_alone and BIAS in fit.active:
        asked.append("attitude")
    if not asked and fit.active and _feels_white_forces(problem, fit):
        asked.append("accelerometers")
    if not asked:
        return None
    wider, trial = _erring(problem, fit)
    gained = fit.objective - trial.objective
    problem.report(f"errors of {and_list(asked)} that last: {gained:.1f} nats")
    if gained < problem.settings.evidence:
        return None
    left = whiteness(wider.engine.filter(trial.values, trial.noise), channels)
    levels = {name: trial.noise.level(name) for name in trial.levels if name in LEVELS_OF_ERRORS}
    begun = with_errors(noise)
    none = [group for group in ERRING_GROUPS if error_level(group) not in levels]
    begun = without_errors(begun, none).with_levels(levels)
    return LastingErrors(wider, trial, begun, gained, are_white(left, MOTION))


def _feels_white_forces(problem: Problem, fit: Fit) -> bool:
    """Whether white forces that are no part of the gusts stand for what accelerometers feel."""
    white = (
        fit.noise.level(name) > WHITE * fit.noise.floor[name]
        for name in FORCES
        if name in fit.noise.process
    )
    return problem.aboard.issuperset(ACCELEROMETERS) and any(white)


def _erring(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """With errors that last, all levels and numbers fitted."""
    wider = problem.with_model(ErringModel(problem.model))
    begun = with_errors(fit.noise)
    own = [name for name in LEVELS_OF_ERRORS if name in begun.process]
    trial = replace(fit, noise=begun, levels=(*own, *fit.levels))
    trial = noise_fitted(wider, trial, evaluations=wider.settings.first_noise_evaluations)
    return wider, converged(wider, _without_small(wider, fitted(wider, trial)))


def _without_small(problem: Problem, fit: Fit) -> Fit:
    """Without errors of groups that have next to none: passes are quicker without their states."""
    small = [
        group
        for group in ERRING_GROUPS
        if error_level(group) in fit.levels
        and fit.noise.level(error_level(group)) < SMALL * reading_std(fit.noise, group)
    ]
    if not small:
        return fit
    rest = without_errors(fit.noise, small)
    lost = problem.engine.log_likelihood(fit.values, fit.noise)
    lost -= problem.engine.log_likelihood(fit.values, rest)
    if lost > problem.settings.step_gain:
        return fit
    levels = tuple(n for n in fit.levels if n in rest.process or n in rest.reading)
    return replace(fit, noise=rest, levels=levels)
