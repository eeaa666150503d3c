"""The model that both flights share: their joint likelihood, with some numbers of their own.

What the model gets wrong is in both flights. Its own numbers and effects are shared, noise levels are
each flight's, and so is what belongs to air, ground, battery and pilot (circumstances.py).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from coax_env.comparison import circumstances
from coax_env.comparison.two_flights import OneFlight, nominal_voltage
from coax_env.diagnosis.fits import fitted, noise_fitted, start, with_latent_noise
from coax_env.diagnosis.input_innovations import has_command_gains, with_command_gains
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.settings import Settings
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.parted_engine import AT, Part, PartedEngine, joint_noise, of_part
from coax_env.estimation.state_space import FreeParameter
from coax_env.model import parameters as P
from coax_env.progress import Progress

AIR = ("air_density", "gravity")
"""Numbers that are each flight's air's."""


def joint_problem(
    flights: tuple[OneFlight, OneFlight], settings: Settings, progress: Progress | None
) -> Problem:
    """Both flights under one set of numbers, and some of their own.

    Trims that drift are not asked for (`with_drifts`): they would take up whatever changed.

    Args:
        flights: both.
        settings: what decides.
        progress: called with a line of text.
    """
    held = nominal_voltage(flights)
    engines = [f.engine(held) for f in flights]
    model = machine(engines[0])
    candidates = circumstances.candidates(flights)
    own = {effect: tuple(model.effect_parameters(effect)) for effect in candidates}
    limits = {f.name: _limits(f) for group in own.values() for f in group}
    parts = [
        Part(f.name, engine, {n: f.vehicle[n].value for n in AIR}, limits)
        for f, engine in zip(flights, engines, strict=True)
    ]
    return Problem(
        model,
        PartedEngine(parts),
        tuple(model.base_parameters()),
        own,
        tuple(circumstances.of_flights(flights)),
        replace(settings, latent_noise_score=math.inf),
        progress,
    )


def _limits(f: FreeParameter) -> tuple[float, float]:
    """What physics gives a number: a bound at its off-value; others are usual sizes."""
    return (f.lower if f.lower == f.value else -float("inf"), float("inf"))


def parts_of(problem: Problem) -> tuple[Part, ...]:
    """The flights of a joint problem."""
    assert isinstance(problem.engine, PartedEngine)
    return problem.engine.parts


def joint_start(problem: Problem, flights: Sequence[OneFlight]) -> Fit:
    """The bare model with each flight's noise levels, its own numbers fitted to both.

    Args:
        problem: of both. flights: whose noise to start from.
    """
    fits = {}
    for part, flight in zip(parts_of(problem), flights, strict=True):
        alone = Problem(
            machine(part.engine), part.engine, problem.base, {}, settings=problem.settings
        )
        fits[part.name] = start(alone, flight.noise)
    values = dict(machine(problem.engine).bare_values)
    for f in problem.parameters:
        values.setdefault(f.name, f.value)
    noise = joint_noise({name: fit.noise for name, fit in fits.items()})
    levels = tuple(of_part(level, name) for name, fit in fits.items() for level in fit.levels)
    fit = Fit((), values, noise, levels=levels)
    return noise_fitted(problem, fitted(problem, fit))


def machine(engine: Engine) -> HeliModel:
    """An engine's model."""
    assert isinstance(engine.model, HeliModel)
    return engine.model


def with_drifts(problem: Problem, fit: Fit, settings: Settings) -> Fit:
    """With trims that drift and white process noise in each flight, where that pays.

    Args:
        problem, fit: with the changes. settings: those that ask for such noise.
    """
    return with_latent_noise(replace(problem, settings=settings), fit) or fit


def with_pilots(problem: Problem, fit: Fit, coloured: bool = False) -> tuple[Problem, Fit]:
    """What each flight's commands show of its gusts, where that gains more than a tie.

    A pilot who sees the gusts looks like a machine that answers late: two pilots like a change.

    Args:
        problem, fit: after a search.
        coloured: also of flights whose innovations are not white: to ask changes, not to be stated.
    """
    parts, added = [], []
    values: dict[str, float] = {}
    for part in parts_of(problem):
        if not _has_pilot(problem, part):
            gains, values_of_part, engine = _pilot(problem, fit, part, coloured)
            part = replace(part, engine=engine)
            added += gains
            values |= values_of_part
        parts.append(part)
    if not added:
        return problem, fit
    wider = replace(problem.with_free(added), engine=PartedEngine(parts))
    return wider, fitted(wider, fit.at(values))


def without_pilots(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """With the commands taken as given; nothing is fitted.

    Args:
        problem, fit: as `with_pilots` returns them, or without any.
    """
    gains = {f.name for f in problem.added if f.name.partition(AT)[0] in P.COMMAND_GAINS}
    return problem.with_fixed(gains), fit.at(dict.fromkeys(gains, 0.0))


def _has_pilot(problem: Problem, part: Part) -> bool:
    return any(of_part(n, part.name) in {f.name for f in problem.added} for n in P.COMMAND_GAINS)


def _pilot(
    problem: Problem, fit: Fit, part: Part, coloured: bool
) -> tuple[list[FreeParameter], dict[str, float], Engine]:
    """A flight's command gains, their values, its engine with input innovations; or none."""
    shared = {g.name for g in problem.parameters}
    own_numbers = [f for f in problem.added if f.name.endswith(of_part("", part.name))]
    alone = replace(
        problem,
        model=machine(part.engine),
        engine=part.engine,
        added=tuple(
            replace(f, name=plain, value=0.0)
            for f in own_numbers
            if (plain := f.name.partition(AT)[0]) not in shared
        ),
    )
    own = replace(fit, values=part.values(fit.values), noise=part.noise(fit.noise))
    wider, trial = with_command_gains(alone, fitted(alone, own), coloured)
    if not has_command_gains(wider):
        return [], {}, part.engine
    gains = [f for f in wider.added if f.name in P.COMMAND_GAINS]
    return (
        [replace(f, name=of_part(f.name, part.name)) for f in gains],
        {of_part(f.name, part.name): trial.values[f.name] for f in gains},
        wider.engine,
    )
