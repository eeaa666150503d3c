"""A vehicle's own numbers by maximum likelihood under priors: the engine of the diagnosis, no search.

Priors are the file's values with their std. Where the flights contradict those by far, all priors are
widened together, unless that makes no innovations white: then the model lacks something that its
numbers should not answer for.

Who flies answers gusts, and a machine whose gusts are flown out looks slow. How far the numbers are
where commands show the gusts, too (estimation/input_innovations.py), is a part of their std. On 18
**synthetic** flights of nine classes, in gusts and with the file right, errors over std (root mean
square of a flight's determined numbers) were 0.35 to 2.7 without that, 0.34 to 1.1 with it; the worst,
a yaw inertia by a camera, 5.2 and 2.7.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.errors import InputError
from coax_env.estimation.engine import Engine, Estimate
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.helicopter_noise import fitted_levels
from coax_env.estimation.input_innovations import sampled_passes, shown_by_commands
from coax_env.estimation.noise_levels import fit_noise
from coax_env.estimation.quadratic import Linearised
from coax_env.estimation.rough_numbers import is_rough, top_of
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.estimation.whiteness import is_white
from coax_env.model.effects import CATALOGUE
from coax_env.progress import Progress

MOST_TURNS = 8  # of numbers and noise levels, fitted in turn
LEAST_GAIN = 1.0
"""nats that another turn of numbers and noise levels must gain; ours."""
CONFLICT = 4.0
"""Times the expected squared move, in prior std, from which the file's std count as too small; ours."""
MARGIN = 2.0
"""Times what would do on average by which priors are widened then: errors are not all alike; ours."""
MOST_WIDENING = 30.0  # factor on a prior's std; ours
STEPS, TOLERANCE = 4, 0.3  # of one fit of the numbers; nats
NOISE_EVALUATIONS = 8


@dataclass(frozen=True)
class OwnNumbers:
    """A fit of a vehicle's own numbers.

    Attributes:
        free: parameters under the priors that were used.
        estimate: their values and covariance.
        noise: fitted levels.
        widened: factor on the priors' std, 1 where the file's were believed.
        remark: on a contradiction between flights and file; empty without one.
    """

    free: list[FreeParameter]
    estimate: Estimate
    noise: Noise
    widened: float
    remark: str = ""


@dataclass(frozen=True)
class RunEstimate:
    """What one run alone determines: value and std by name.

    chi_square: of those about the joint estimate, in `degrees` degrees of freedom.
    """

    run: str
    values: dict[str, float]
    std: dict[str, float]
    chi_square: float
    degrees: int


def free_parameters(model: HeliModel, also: Collection[str] = ()) -> list[FreeParameter]:
    """Base parameters with a std, and those of the effects that the vehicle file has or are `also`."""
    free = model.base_parameters()
    for effect, table in model.vehicle.effects.items():
        for f in model.effect_parameters(effect):
            own = table[f.name.split(".")[1]]
            if own.std > 0.0:
                free.append(replace(f, value=own.value, std=own.std, probe=0.0))
    for effect in also:
        if effect not in CATALOGUE or CATALOGUE[effect].line:
            raise InputError(
                f"no effect {effect!r} to fit; the catalogue has {', '.join(CATALOGUE)}"
            )
        if effect not in model.vehicle.effects:
            replaced = CATALOGUE[effect].replaces
            free = [f for f in free if f.name not in replaced]
            free += model.effect_parameters(effect)
    return free


def own_numbers(
    engine: Engine,
    free: list[FreeParameter],
    start: Mapping[str, float],
    noise: Noise,
    progress: Progress,
) -> OwnNumbers:
    """Numbers and noise levels, priors widened where that is what the flights ask for.

    Args:
        engine: model and records.
        free: what is fitted, under the file's priors.
        start: values of all parameters to begin from.
        noise: levels to begin from.
        progress: called with a line of text.
    """
    found = _by_turns(engine, free, start, noise, progress, MOST_WIDENING)
    if found.widened == 1.0:
        return found
    contradiction = "the flights contradict the file's values by far more than its std"
    at = {**start, **found.estimate.values}
    if is_white(engine.filter(at, found.noise), engine.model.channels):
        words = f"{contradiction}: priors taken {found.widened:.1f} times as wide"
        return replace(found, remark=words)
    progress("the model lacks something: back to the file's priors")
    found = _by_turns(engine, free, start, noise, progress, 1.0)
    words = (
        f"{contradiction}, and no values make the innovations white: the model lacks "
        "something that its numbers should not answer for; see scripts/diagnose.py"
    )
    return replace(found, remark=words)


def over_roughness(engine: Engine, found: OwnNumbers, values: Mapping[str, float]) -> OwnNumbers:
    """Numbers with those whose likelihood is rough where it is best over several std, and their std.

    Args:
        engine: model and records. found: as fitted. values: of all parameters there, by name.
    """
    estimate = found.estimate
    for k, name in enumerate(estimate.names):
        if is_rough(name):
            top = top_of(engine, found.free, values, found.noise, name)
            values = top.values
            ratio = np.ones(len(estimate.names))
            ratio[k] = top.std_ratio or 1.0
            estimate = replace(
                estimate,
                values={n: values[n] for n in estimate.names},
                covariance=estimate.covariance * np.outer(ratio, ratio),
            )
    return replace(found, estimate=estimate)


def _by_turns(
    engine: Engine,
    free: list[FreeParameter],
    start: Mapping[str, float],
    noise: Noise,
    progress: Progress,
    most_widening: float,
) -> OwnNumbers:
    """Numbers and noise levels by turns; priors widened together where the flights contradict them.

    A squared move of d times the prior variance is expected of a number of which the flights determine
    the share d (their posterior variance being 1 - d of the prior's). Far more means that the file's
    std are too small, all by the same factor for want of a better guess.
    """
    values, widened = dict(start), 1.0
    best = math.inf
    for _ in range(MOST_TURNS):
        estimate = engine.fit(free, values, noise, STEPS, TOLERANCE, progress)
        values = {**values, **estimate.values}
        ratio = _squared_moves(free, values, estimate.covariance)
        if ratio > CONFLICT and widened < most_widening:
            factor = min(MARGIN * math.sqrt(ratio), most_widening / widened)
            widened *= factor
            free = [replace(f, std=factor * f.std) for f in free]
            progress(f"the file's std are too small: {widened:.1f} times as wide")
            best = math.inf
        elif best - estimate.objective < LEAST_GAIN:
            break
        else:
            best = estimate.objective
        noise = fit_noise(
            engine, values, noise, fitted_levels(noise), NOISE_EVALUATIONS, LEAST_GAIN
        )
    return OwnNumbers(free, estimate, noise, widened)


def _squared_moves(
    free: Sequence[FreeParameter], values: Mapping[str, float], covariance: np.ndarray
) -> float:
    """Squared moves from the priors' means in prior std, over what is expected of them."""
    determined = 1.0 - np.diag(covariance) / np.array([f.std**2 for f in free])
    moved = sum(((values[f.name] - f.value) / f.std) ** 2 for f in free)
    return moved / max(float(determined.sum()), 1.0)


def beside_commands(
    engine: Engine, found: OwnNumbers, values: Mapping[str, float], progress: Progress
) -> np.ndarray:
    """How far each number moves where the commands show the gusts, (k,).

    Args:
        engine: model and records.
        found: the fit by the readings alone. values: of all parameters there.
        progress: called with a line of text.
    """
    records, gains = shown_by_commands(engine, sampled_passes(engine, values, found.noise))
    joint = Engine(engine.model, records, engine.threads)
    begun = {**values, **{f.name: f.value for f in gains}}
    there = joint.fit([*found.free, *gains], begun, found.noise, STEPS, TOLERANCE, progress)
    return np.array([there.values[f.name] - values[f.name] for f in found.free])


def each_run(
    engine: Engine,
    free: Sequence[FreeParameter],
    lin: Linearised,
    values: Mapping[str, float],
    inflation: np.ndarray,
) -> tuple[RunEstimate, ...]:
    """One Newton step of each run alone from the joint estimate, priors in.

    Args:
        engine: model and records.
        free: the k parameters.
        lin: linearised at the joint estimate.
        values: the joint estimate.
        inflation: variance inflation of each parameter by coloured innovations, (k,).
    """
    names = [f.name for f in free]
    prior = np.array([f.std for f in free])
    at = np.array([values[n] for n in names])
    pull = (at - [f.value for f in free]) / prior**2
    joint = np.linalg.inv(lin.information.sum(0) + np.diag(prior**-2.0))
    found = []
    for record, information, slope in zip(engine.records, lin.information, lin.slope, strict=True):
        alone = np.linalg.inv(information + np.diag(prior**-2.0))
        move = -alone @ (slope + pull)
        spread = np.sqrt(np.diag(alone) * inflation)
        # a run that is nearly all there is agrees with the joint fit, up to how far that was taken
        apart = np.sqrt(np.maximum(np.diag(alone - joint), 0.1 * np.diag(alone)) * inflation)
        known = spread < 0.5 * prior
        found.append(
            RunEstimate(
                record.name,
                {n: float(at[i] + move[i]) for i, n in enumerate(names) if known[i]},
                {n: float(spread[i]) for i, n in enumerate(names) if known[i]},
                float(np.sum((move / apart)[known] ** 2)),
                int(known.sum()),
            )
        )
    return tuple(found)
