"""Identification: the vehicle's own numbers from flight data, by one of two methods.

"paper" is the two steps of the paper's section V (two_step/). "ml" is maximum likelihood on the full
model under priors: the same engine as in the diagnosis, with the base parameters (and the effects
the vehicle already has) free and nothing else. Priors are the file's values with their std. The
result is a vehicle file that `gymnasium.make("CoaxHeli-v0", vehicle=...)` takes as it is.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, overload

import numpy as np

from coax_env.errors import InputError
from coax_env.estimation.fit import Engine, Estimate, Linearised
from coax_env.estimation.fitted_vehicle import (
    double_counting,
    fitted_vehicle,
    median_step,
    with_timing,
)
from coax_env.estimation.helicopter import GUST_LEVELS, HeliModel, record_of, starting_noise
from coax_env.estimation.prediction import RunReplay, fly_again
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.estimation.whiteness import is_white
from coax_env.identification.two_step.method import TwoStep, two_step
from coax_env.logs.flight import Flight, read_flight
from coax_env.model.effects import CATALOGUE
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.plain_words import and_list, plain

METHODS = ("ml", "paper")
MOST_TURNS = 8
ENOUGH = 1.0
"""Nats that another turn of numbers and noise levels must gain."""
CONFLICT = 4.0
"""Times the expected squared move, in prior std, from which the file's std count as too small."""
ROOM = 2.0
"""Times what would do on average by which priors are widened then: errors are not all alike."""
MOST_WIDENING = 30.0
UNTOLD = 0.75
"""Share of its prior std that a combination keeps when the flights say nothing of it."""
WORTH_NAMING = 0.35
"""Share of an undetermined direction below which a number is left out of its words."""
Progress = Callable[[str], None]


@dataclass(frozen=True)
class RunEstimate:
    """What one run alone says: value and std by name, for the numbers that it determines at all.

    chi_square: of those about the joint estimate, in `degrees` degrees of freedom.
    """

    run: str
    values: dict[str, float]
    std: dict[str, float]
    chi_square: float
    degrees: int


@dataclass(frozen=True)
class Identification:
    """Result of `identify`: the fitted vehicle, what was free, and the runs flown again (`flight`).

    undetermined, directions: numbers and combinations that the flights leave open (`left_open`).
    by_run: each run alone. widened: factor on the priors' std, 1 where the file's were believed.
    """

    flight: Flight
    before: Vehicle
    after: Vehicle
    fitted: tuple[str, ...]
    estimate: Estimate
    noise: Noise
    replay_before: list[RunReplay]
    replay_after: list[RunReplay]
    remarks: tuple[str, ...]
    undetermined: tuple[str, ...] = ()
    directions: tuple[str, ...] = ()
    by_run: tuple[RunEstimate, ...] = ()
    widened: float = 1.0


@overload
def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    method: Literal["ml"] = "ml",
    progress: Progress | None = None,
    channels: Collection[str] | None = None,
    also: Collection[str] = (),
    hold_out: Collection[str] = (),
) -> Identification: ...


@overload
def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    *,
    method: Literal["paper"],
    progress: Progress | None = None,
    channels: Collection[str] | None = None,
    also: Collection[str] = (),
    hold_out: Collection[str] = (),
) -> TwoStep: ...


@overload
def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    method: str = "ml",
    progress: Progress | None = None,
    channels: Collection[str] | None = None,
    also: Collection[str] = (),
    hold_out: Collection[str] = (),
) -> Identification | TwoStep: ...


def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    method: str = "ml",
    progress: Progress | None = None,
    channels: Collection[str] | None = None,
    also: Collection[str] = (),
    hold_out: Collection[str] = (),
) -> Identification | TwoStep:
    """Fit a vehicle's numbers to a flight.

    Args:
        flight: a Flight or its folder. vehicle: a Vehicle, name or path; default the card's.
        method: "ml", maximum likelihood on the full model; "paper", its two steps.
        channels: to use; None: all that were measured. also: effects of the catalogue whose
            parameters are free too ("gyro_bias", say), for method "ml". hold_out: runs that are not
            fitted; with some, they alone are flown again.

    Raises:
        InputError: no such method, nothing to identify, or sensors missing that the method needs.
    """
    if method not in METHODS:
        raise InputError(f"no method {method!r}; there are {', '.join(METHODS)}")

    def say(text: str) -> None:
        if progress:
            progress(text)

    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    if channels is not None:
        flight = with_channels(flight, channels)
    held = flight.select(hold_out) if hold_out else flight
    if hold_out:
        fitted_on = [name for name in flight.run_names if name not in hold_out]
        if not fitted_on:
            raise InputError("all runs are held out: nothing is left to identify from")
        flight = flight.select(fitted_on)
    vehicle = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    known = (*flight.notes, *double_counting(flight, vehicle))
    if method == "paper":
        result = two_step(flight, vehicle, progress=say)
        return replace(result, remarks=(*known, *result.remarks))
    model = HeliModel(vehicle)
    engine = Engine(model, [record_of(run) for run in flight.runs])
    free = free_parameters(model, also)
    if not free:
        raise InputError(
            f"vehicle {vehicle.name!r} has no parameter with a std: nothing to identify"
        )
    say("estimating gusts and noise")
    start = {f.name: f.value for f in free}
    bare = {**model.bare_values, **start}
    first = engine.fit_noise(bare, starting_noise(flight, vehicle), GUST_LEVELS)
    remarks = list(known)
    own = free
    free, estimate, noise, widened = _fitted(engine, own, bare, first, say)
    if widened > 1.0:
        contradiction = "the flights contradict the file's values by far more than its std"
        at = {**model.bare_values, **estimate.values}
        if is_white(engine.filter(at, noise), engine.model.channels):
            remarks.append(f"{contradiction}: priors taken {widened:.1f} times as wide")
        else:
            say("the model lacks something: back to the file's priors")
            free, estimate, noise, widened = _fitted(engine, own, bare, first, say, most=1.0)
            remarks.append(
                f"{contradiction}, and no values make the innovations white: the model lacks "
                "something that its numbers should not answer for; see scripts/diagnose.py"
            )
    values = {**model.bare_values, **estimate.values}
    _, lin = engine.linearise(values, noise, free)
    quadratic = Quadratic.of(lin, free, values)
    names = [f.name for f in free]
    colour = np.array([quadratic.colour([name], names) for name in names])
    covariance = estimate.covariance * np.sqrt(np.outer(colour, colour))
    std = dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    dt = median_step(engine.records)
    where = flight.path.name if flight.path else "flight"
    after = fitted_vehicle(
        vehicle,
        free,
        estimate.values,
        {f.name: with_timing(f, std[f.name], dt) for f in free},
        covariance,
        f"identified from {where} (maximum likelihood)",
        flight,
    )
    say("flying again")
    again = Engine(model, [record_of(run) for run in held.runs])
    return Identification(
        held,
        vehicle,
        replace(after, description=f"{vehicle.description}; identified from {where}"),
        tuple(names),
        estimate,
        noise,
        fly_again(again, model.bare_values, first),
        fly_again(again, values, noise),
        tuple(remarks),
        *left_open(free, estimate.covariance),
        _each_run(engine, free, lin, values, colour),
        widened,
    )


def with_channels(flight: Flight, channels: Collection[str]) -> Flight:
    """The flight as if only these channels had been measured.

    Raises:
        InputError: one of them was not, or none is left.
    """
    for channel in channels:
        if channel not in flight.channels:
            raise InputError(
                f"no channel {channel!r} in this flight; it has {', '.join(flight.channels)}"
            )
    if not channels:
        raise InputError("no channel is left to identify from")
    runs = [
        replace(run, measured={c: v for c, v in run.measured.items() if c in channels})
        for run in flight.runs
    ]
    return replace(flight, runs=tuple(runs))


def _fitted(
    engine: Engine,
    free: list[FreeParameter],
    start: Mapping[str, float],
    noise: Noise,
    say: Progress,
    most: float = MOST_WIDENING,
) -> tuple[list[FreeParameter], Estimate, Noise, float]:
    """Numbers and noise levels by turns; priors widened together where the flights contradict them.

    A squared move of d times the prior variance is expected of a number of which the flights tell the
    share d (their posterior variance being 1 - d of the prior's). Far more means that the file's std
    are too small, all by the same factor for want of a better guess.
    """
    values, widened = dict(start), 1.0
    best = math.inf
    for _ in range(MOST_TURNS):
        estimate = engine.fit(free, values, noise, iterations=4, tolerance=0.3, progress=say)
        values = {**values, **estimate.values}
        told = 1.0 - np.diag(estimate.covariance) / np.array([f.std**2 for f in free])
        moved = sum(((values[f.name] - f.value) / f.std) ** 2 for f in free)
        ratio = moved / max(float(told.sum()), 1.0)
        if ratio > CONFLICT and widened < most:
            factor = min(ROOM * math.sqrt(ratio), most / widened)
            widened *= factor
            free = [replace(f, std=factor * f.std) for f in free]
            say(f"the file's std are too small: {widened:.1f} times as wide")
            best = math.inf
        elif best - estimate.objective < ENOUGH:
            break
        else:
            best = estimate.objective
        noise = engine.fit_noise(values, noise, GUST_LEVELS, 8, ENOUGH)
    return free, estimate, noise, widened


def left_open(
    free: Sequence[FreeParameter], covariance: np.ndarray
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Numbers that the flights do not determine, and the combinations they leave open, in words.

    Open is an eigenvector of the posterior covariance, in units of the priors, whose std is most of
    the prior's (UNTOLD). A number is undetermined where most of what is not known of it is along
    those: motion alone tells thrust over mass, not either.
    """
    scale = np.array([f.std for f in free])
    shares, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    left = shares > UNTOLD**2
    along = np.sum(vectors[:, left] ** 2 * shares[left], axis=1)
    whole = np.sum(vectors**2 * shares, axis=1)
    undetermined = [f.name for f, a, w in zip(free, along, whole, strict=True) if a > 0.5 * w]
    told = []
    for vector in vectors.T[left][::-1]:
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        parts = [(w, f.name) for w, f in zip(vector, free, strict=True) if abs(w) > WORTH_NAMING]
        if len(parts) > 1:
            up = [plain(name) for weight, name in parts if weight > 0.0]
            down = [plain(name) for weight, name in parts if weight < 0.0]
            told.append(
                and_list(up) + (" up with " + and_list(down) + " down" if down else " together")
            )
    return tuple(undetermined), tuple(told)


def _each_run(
    engine: Engine,
    free: Sequence[FreeParameter],
    lin: Linearised,
    values: Mapping[str, float],
    colour: np.ndarray,
) -> tuple[RunEstimate, ...]:
    """One Newton step of each run alone from the joint estimate, priors in."""
    names = [f.name for f in free]
    prior = np.array([f.std for f in free])
    at = np.array([values[n] for n in names])
    pull = (at - [f.value for f in free]) / prior**2
    joint = np.linalg.inv(lin.information.sum(0) + np.diag(prior**-2.0))
    found = []
    for record, information, slope in zip(engine.records, lin.information, lin.slope, strict=True):
        alone = np.linalg.inv(information + np.diag(prior**-2.0))
        move = -alone @ (slope + pull)
        spread = np.sqrt(np.diag(alone) * colour)
        # a run that is nearly all there is says what all say, up to how far the fit was taken
        apart = np.sqrt(np.maximum(np.diag(alone - joint), 0.1 * np.diag(alone)) * colour)
        told = spread < 0.5 * prior
        found.append(
            RunEstimate(
                record.name,
                {n: float(at[i] + move[i]) for i, n in enumerate(names) if told[i]},
                {n: float(spread[i]) for i, n in enumerate(names) if told[i]},
                float(np.sum((move / apart)[told] ** 2)),
                int(told.sum()),
            )
        )
    return tuple(found)


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
