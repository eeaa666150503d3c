"""The corrected vehicle: the causes in it, refitted on all runs, structure unchanged."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.confounding import of_undecided
from coax_env.diagnosis.findings import stated_std
from coax_env.diagnosis.flown_numbers import flying_nearest
from coax_env.diagnosis.input_innovations import engine_as_fitted
from coax_env.diagnosis.preparation import diagnosed_from
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.engine import Engine, objective
from coax_env.estimation.fitted_vehicle import fitted_vehicle, median_step, with_stated
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter, Record
from coax_env.estimation.vibration import Line, large
from coax_env.logs.flight import Flight
from coax_env.model.effects import CATALOGUE
from coax_env.model.vehicle import Parameter, Vehicle


def corrected_vehicle(
    problem: Problem,
    fit: Fit,
    flown: Fit,
    quadratic: Quadratic,
    held: Sequence[Record],
    inflations: Mapping[str, float],
    lines: Sequence[Line],
    flight: Flight,
) -> Vehicle:
    """The vehicle with the causes in it.

    Args:
        problem, fit: with the causes.
        flown: with the numbers that are stated of the fitted runs (flown_numbers.py).
        quadratic: linearised at the fit.
        held: runs that were held out; they are used now.
        inflations: variance inflation, by effect.
        lines: of a vibration that the vehicle file does not have.
        flight: what is recorded as the source.
    """
    free = problem.free(fit.active)
    found, covariance = with_held_out(problem, fit, quadratic, held)
    values: Mapping[str, float] = found
    if flown.values != fit.values:
        there = _flying_all_nearest(problem, fit.at(found), held, covariance) if held else flown
        values = there.values
    dt = median_step([*problem.engine.records, *held])
    of_vehicle = problem.free_of_vehicle(fit.active)
    own = [free.index(f) for f in of_vehicle]
    spread = np.sqrt(np.diag(covariance))

    def std(f: FreeParameter) -> float:
        factor = inflations.get(f.name.partition(".")[0], 1.0)
        return stated_std(flown, f, float(spread[free.index(f)]), factor, dt)

    source = diagnosed_from(flight)
    vehicle = fitted_vehicle(
        problem.model.vehicle,
        of_vehicle,
        values,
        {f.name: std(f) for f in of_vehicle},
        (covariance + of_undecided(problem, fit, quadratic))[np.ix_(own, own)],
        source,
        flight,
    )
    vehicle = with_stated(vehicle, fit.active, fit.values, source)
    units = {p.name: p.unit for p in CATALOGUE["vibration"].parameters}
    return vehicle.with_parameters(
        {
            f"vibration.{kind}": Parameter(amplitude, std, units[kind], source)
            for kind, (amplitude, std) in large(lines).items()
        }
    )


def with_held_out(
    problem: Problem, fit: Fit, quadratic: Quadratic, held: Sequence[Record]
) -> tuple[dict[str, float], np.ndarray]:
    """Values of the free parameters, and their covariance, with the held-out runs taken in too.

    The posterior of the other runs is the prior of a first Gauss-Newton step; from there on all runs
    are linearised anew until a step gains nothing. Noise levels stay.

    Args:
        problem, fit: with the causes.
        quadratic: linearised at the fit.
        held: runs that were held out.
    """
    free = problem.free(fit.active)
    names = [f.name for f in free]
    if not held:
        return {name: fit.values[name] for name in names}, quadratic.covariance(names)
    engine = engine_as_fitted(problem, held, fit)
    passes, lin = engine.linearise(fit.values, fit.noise, free)
    taken_in = Quadratic.of(lin, free, fit.values)
    known = quadratic.index(names)
    # where they are fitted, the other runs and the priors have no slope
    beyond = _beyond_signatures(quadratic, known)
    both = replace(
        taken_in,
        G=taken_in.G + quadratic.G[np.ix_(known, known)],
        g=taken_in.g + quadratic.g[known] + beyond,
    )
    everything = Engine(problem.model, (*problem.engine.records, *engine.records))
    there = replace(fit, objective=fit.objective - sum(p.log_likelihood for p in passes))
    for _ in range(problem.settings.most_refinements):
        _, move = both.best(names)
        there, gained = _moved(everything, there, both, free, move)
        if gained < problem.settings.refinement_gain:
            break
        _, lin = everything.linearise(there.values, fit.noise, free)
        both = Quadratic.of(lin, free, there.values)
        both = replace(both, g=both.g + beyond)
        if -both.best(names)[0] < problem.settings.refinement_gain:
            break
    return {name: there.values[name] for name in names}, both.covariance(names)


def _flying_all_nearest(
    problem: Problem, fit: Fit, held: Sequence[Record], covariance: np.ndarray
) -> Fit:
    """With the numbers that fly all runs nearest; fit, covariance: of `with_held_out`."""
    engine = engine_as_fitted(problem, held, fit)
    everything = Engine(problem.model, (*problem.engine.records, *engine.records))
    return flying_nearest(replace(problem, engine=everything), fit, covariance)


def _beyond_signatures(quadratic: Quadratic, known: np.ndarray) -> np.ndarray:
    """What the slope of the fitted runs has beyond the signatures' (refinement.py), (k,).

    There they are fitted: what is left of the signatures' slope is that, but at a bound.
    """
    pull = (quadratic.g + quadratic.precision * (quadratic.at - quadratic.mean))[known]
    width = quadratic.precision[known] ** -0.5
    inside = np.minimum(quadratic.at - quadratic.lower, quadratic.upper - quadratic.at)[known]
    return np.where(inside > 1e-6 * width, -pull, 0.0)


def _moved(
    engine: Engine,
    fit: Fit,
    quadratic: Quadratic,
    free: Sequence[FreeParameter],
    move: np.ndarray,
) -> tuple[Fit, float]:
    """The fit after a move, shortened until it gains on all runs, and the gain [nats]."""
    for share in (1.0, 0.5, 0.25):
        values = {**fit.values, **quadratic.moved(share * move)}
        after = objective(engine.filter(values, fit.noise), free, values)
        if after < fit.objective:
            return replace(fit.at(values), objective=after), fit.objective - after
    return fit, 0.0
