"""Identification: the vehicle's own numbers from flight data, by one of two methods.

"paper" is the two steps of the paper's section V (two_step/). "ml" is maximum likelihood on the full
model under priors: the same engine as in the diagnosis, with the base parameters (and the effects
the vehicle already has) free and nothing else. Priors are the file's values with their std. The
result is a vehicle file that `gymnasium.make("CoaxHeli-v0", vehicle=...)` takes as it is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, overload

from coax_env.diagnosis import double_counting, fitted_vehicle, median_step, with_timing
from coax_env.engine.fit import Engine, Estimate
from coax_env.engine.model import FreeParameter, Noise
from coax_env.errors import InputError
from coax_env.flight import Flight, read_flight
from coax_env.heli_model import GUST_LEVELS, HeliModel, record_of, starting_noise
from coax_env.prediction import RunReplay, fly_again
from coax_env.two_step.method import TwoStep, two_step
from coax_env.vehicle import Vehicle, load_vehicle

METHODS = ("ml", "paper")
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Identification:
    """Result of `identify`: the fitted vehicle, what was free, and the runs flown again."""

    flight: Flight
    before: Vehicle
    after: Vehicle
    fitted: tuple[str, ...]
    estimate: Estimate
    noise: Noise
    replay_before: list[RunReplay]
    replay_after: list[RunReplay]
    remarks: tuple[str, ...]


@overload
def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    method: Literal["ml"] = "ml",
    progress: Progress | None = None,
) -> Identification: ...


@overload
def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    *,
    method: Literal["paper"],
    progress: Progress | None = None,
) -> TwoStep: ...


@overload
def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    method: str = "ml",
    progress: Progress | None = None,
) -> Identification | TwoStep: ...


def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    method: str = "ml",
    progress: Progress | None = None,
) -> Identification | TwoStep:
    """Fit a vehicle's numbers to a flight.

    Args:
        flight: a Flight or its folder. vehicle: a Vehicle, name or path; default the card's.
        method: "ml", maximum likelihood on the full model; "paper", its two steps.

    Raises:
        InputError: no such method, nothing to identify, or sensors missing that the method needs.
    """
    if method not in METHODS:
        raise InputError(f"no method {method!r}; there are {', '.join(METHODS)}")

    def say(text: str) -> None:
        if progress:
            progress(text)

    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    vehicle = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    if method == "paper":
        result = two_step(flight, vehicle, progress=say)
        known = (*flight.notes, *double_counting(flight, vehicle))
        return replace(result, remarks=(*known, *result.remarks))
    model = HeliModel(vehicle)
    engine = Engine(model, [record_of(run) for run in flight.runs])
    free = free_parameters(model)
    if not free:
        raise InputError(
            f"vehicle {vehicle.name!r} has no parameter with a std: nothing to identify"
        )
    say("estimating gusts and noise")
    first = engine.fit_noise(model.bare_values, starting_noise(flight, vehicle), GUST_LEVELS)
    estimate = engine.fit(free, model.bare_values, first, progress=say)
    noise = engine.fit_noise({**model.bare_values, **estimate.values}, first, GUST_LEVELS)
    start = {**model.bare_values, **estimate.values}
    estimate = engine.fit(free, start, noise, iterations=3, progress=say)
    dt = median_step(engine.records)
    where = flight.path.name if flight.path else "flight"
    after = fitted_vehicle(
        vehicle,
        free,
        estimate.values,
        {f.name: with_timing(f, estimate.std[f.name], dt) for f in free},
        estimate.covariance,
        f"identified from {where} (maximum likelihood)",
        flight,
    )
    say("flying again")
    return Identification(
        flight,
        vehicle,
        replace(after, description=f"{vehicle.description}; identified from {where}"),
        tuple(f.name for f in free),
        estimate,
        noise,
        fly_again(engine, model.bare_values, first),
        fly_again(engine, {**model.bare_values, **estimate.values}, noise),
        (*flight.notes, *double_counting(flight, vehicle)),
    )


def free_parameters(model: HeliModel) -> list[FreeParameter]:
    """Base parameters with a std, and those of the effects that the vehicle file has."""
    free = model.base_parameters()
    for effect, table in model.vehicle.effects.items():
        for f in model.effect_parameters(effect):
            own = table[f.name.split(".")[1]]
            if own.std > 0.0:
                free.append(replace(f, value=own.value, std=own.std, probe=0.0))
    return free
