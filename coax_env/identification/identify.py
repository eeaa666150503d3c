"""Identification: the vehicle's own numbers from flight data, by one of two methods.

"paper" is the two steps of the paper's section V (two_step/). "ml" is maximum likelihood on the full
model under priors (maximum_likelihood.py): the same engine as in the diagnosis, with the base
parameters (and the effects the vehicle already has) free and nothing else but how rotor speeds follow
the battery's voltage, where the felt thrust shows it (estimation/battery.py): else masses and thrust
coefficients answer for it. The result is a vehicle file that `gymnasium.make("CoaxHeli-v0",
vehicle=...)` takes as it is.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, overload

import numpy as np

from coax_env.consistency.agreement import refuse_disagreement
from coax_env.errors import InputError
from coax_env.estimation import between_rows, late_commands, vibration
from coax_env.estimation.battery import PER_VOLT, VOLTAGE, felt_voltage, stated
from coax_env.estimation.engine import Engine, Estimate
from coax_env.estimation.fitted_vehicle import (
    double_counting,
    fitted_vehicle,
    median_step,
    with_stated,
    with_timing,
)
from coax_env.estimation.flown import flown_parts
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import fitted_levels, starting_noise
from coax_env.estimation.noise_levels import fit_noise
from coax_env.estimation.prediction import RunReplay, replay_runs
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Noise
from coax_env.identification.maximum_likelihood import (
    OwnNumbers,
    RunEstimate,
    beside_commands,
    each_run,
    free_parameters,
    over_roughness,
    own_numbers,
)
from coax_env.identification.two_step.method import TwoStep, two_step
from coax_env.identification.undetermined import left_open
from coax_env.logs.fast_rows import decimated
from coax_env.logs.flight import Flight, read_flight
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.plain_words import and_list, plain
from coax_env.progress import Progress, reporter, shows_progress

METHODS = ("ml", "paper")

VOLTAGE_SHOWN = 14.0
"""nats from which speeds are taken to follow the battery's voltage: those of a name in a diagnosis."""


@dataclass(frozen=True)
class Identification:
    """Result of `identify` by maximum likelihood.

    Attributes:
        flight: the runs flown again. before, after: the vehicle as given and fitted.
        fitted: names of what was free. estimate: values and covariance. noise: fitted levels.
        replay_before, replay_after: those runs, replayed with either vehicle.
        remarks: on the data and the file.
        undetermined, directions: numbers and combinations that the flights leave open.
        by_run: each run alone.
        widened: factor on the priors' std, 1 where the file's were believed.
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
    progress: Progress | bool | None = None,
    channels: Collection[str] | None = None,
    also: Collection[str] = (),
    hold_out: Collection[str] = (),
    waive: Collection[str] = (),
) -> Identification: ...


@overload
def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    *,
    method: Literal["paper"],
    progress: Progress | bool | None = None,
    channels: Collection[str] | None = None,
    also: Collection[str] = (),
    hold_out: Collection[str] = (),
    waive: Collection[str] = (),
) -> TwoStep: ...


@overload
def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    method: str = "ml",
    progress: Progress | bool | None = None,
    channels: Collection[str] | None = None,
    also: Collection[str] = (),
    hold_out: Collection[str] = (),
    waive: Collection[str] = (),
) -> Identification | TwoStep: ...


@shows_progress("identification")
def identify(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    method: str = "ml",
    progress: Progress | bool | None = None,
    channels: Collection[str] | None = None,
    also: Collection[str] = (),
    hold_out: Collection[str] = (),
    waive: Collection[str] = (),
) -> Identification | TwoStep:
    """Fit a vehicle's numbers to a flight.

    Args:
        flight: a Flight or its folder.
        vehicle: a Vehicle, name or path; default the card's.
        method: "ml", maximum likelihood on the full model; "paper", its two steps.
        progress: called with a line of text at every step; True: a bar on stderr.
        channels: to use; None: all that were measured.
        also: effects of the catalogue whose parameters are free too ("gyro_bias", say); for "ml".
        hold_out: runs that are not fitted; with some, they alone are flown again.
        waive: checks of the log with itself (consistency/) that are passed over, beside the card's.

    Raises:
        InputError: no such method, nothing to identify, a log that contradicts itself, or sensors
            missing that the method needs.
    """
    if method not in METHODS:
        raise InputError(f"no method {method!r}; there are {', '.join(METHODS)}")
    report = reporter(progress)
    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    if channels is not None:
        flight = with_channels(flight, channels)
    vehicle = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    flight = flown_parts(flight, vehicle)
    passed_over = refuse_disagreement(flight, vehicle, waive)
    known = (*flight.notes, *passed_over, *double_counting(flight, vehicle))
    if method == "paper":
        result = two_step(_split(flight, hold_out)[0], vehicle, progress=report)
        return replace(result, remarks=(*known, *result.remarks))
    lines, calm, still = vibration.calmed(flight, vehicle)
    known = (*known, *([vibration.remark(lines)] if lines else []))
    flight, held = _split(decimated(calm), hold_out)
    start = starting_noise(flight, still)
    return _by_maximum_likelihood(flight, held, vehicle, start, also, known, report)


def _by_maximum_likelihood(
    flight: Flight,
    held: Flight,
    vehicle: Vehicle,
    start: Noise,
    also: Collection[str],
    known: tuple[str, ...],
    report: Progress,
) -> Identification:
    given, vehicle = vehicle, _in_voltage(vehicle, flight, also)
    as_given = {}  # what the model flies with as the vehicle was given
    if vehicle is not given:
        known = (*known, _voltage_remark(vehicle))
        as_given = {PER_VOLT: 0.0}
    model = HeliModel(vehicle, stated(flight, vehicle))
    engine = Engine(model, [record_of(run) for run in flight.runs])
    free = [f for f in free_parameters(model, also) if f.name not in as_given]
    if not free:
        raise InputError(
            f"vehicle {vehicle.name!r} has no parameter with a std: nothing to identify"
        )
    bare = {**model.bare_values, **{f.name: f.value for f in free}}

    def fitted(engine: Engine) -> tuple[Noise, OwnNumbers, dict[str, float]]:
        """Noise of the model as given, its own numbers, and all values with these."""
        first = fit_noise(engine, bare, start, fitted_levels(start))
        found = own_numbers(engine, free, bare, first, report)
        return first, found, {**model.bare_values, **found.estimate.values}

    report("estimating gusts and noise")
    first, found, values = fitted(engine)
    late = late_commands.written_late(engine, values, found.noise, report)
    if late > 0.0:
        report("estimating again with commands when they act")
        engine = Engine(model, late_commands.acting_sooner(engine.records, late))
        first, found, values = fitted(engine)
        known = (*known, late_commands.remark(late))
    between = between_rows.likeliest(engine, values, found.noise, report)
    while between != between_rows.of_rows(engine.records):
        report("estimating again with commands as they are between the rows")
        other = Engine(model, between_rows.with_between(engine.records, between))
        trial = fitted(other)
        if not trial[1].estimate.objective < found.estimate.objective:
            break
        engine, (first, found, values) = other, trial
        between = between_rows.next_larger(between)
    between = between_rows.of_rows(engine.records)
    known = (*known, *between_rows.remarks(between))
    found = over_roughness(engine, found, values)
    values = {**model.bare_values, **found.estimate.values}
    _, lin = engine.linearise(values, found.noise, found.free)
    quadratic = Quadratic.of(lin, found.free, values)
    names = [f.name for f in found.free]
    inflation = np.array([quadratic.variance_inflation([name], names) for name in names])
    report("fitting the numbers where the commands show the gusts, too")
    apart = beside_commands(engine, found, values, report)
    dt = median_step(engine.records)
    after = _identified_vehicle(vehicle, found, inflation, apart, dt, flight)
    after = with_stated(after, set(also) - set(vehicle.effects), values, _source(flight))
    if as_given:
        first = fit_noise(engine, {**bare, **as_given}, start, fitted_levels(start))
    report("flying the runs open loop")
    sooner = late_commands.acting_sooner([record_of(run) for run in held.runs], late)
    again = Engine(model, between_rows.with_between(sooner, between))
    return Identification(
        held,
        given,
        after,
        tuple(names),
        found.estimate,
        found.noise,
        replay_runs(again, {**model.bare_values, **as_given}, first),
        replay_runs(again, values, found.noise),
        (
            *known,
            *([found.remark] if found.remark else []),
            *_answered_gusts(found, apart),
            *_at_limits(found),
        ),
        *left_open(found.free, found.estimate.covariance),
        each_run(engine, found.free, lin, values, inflation),
        found.widened,
    )


def _in_voltage(vehicle: Vehicle, flight: Flight, also: Collection[str]) -> Vehicle:
    """The vehicle whose speeds follow the battery's voltage, where the felt thrust shows it and the
    vehicle does not know it; else as it is."""
    felt = felt_voltage(flight, vehicle)
    if VOLTAGE in {*vehicle.effects, *also} or not felt.is_shown(VOLTAGE_SHOWN):
        return vehicle
    return felt.known(vehicle, f"{_source(flight)} (felt thrust)")


def _voltage_remark(vehicle: Vehicle) -> str:
    """What is to be said of a voltage that was added. vehicle: with it."""
    of_voltage = vehicle[PER_VOLT]
    nominal = vehicle[f"{VOLTAGE}.nominal"]
    return (
        "by the felt thrust the rotors turn slower on a low battery, by"
        f" {100.0 * of_voltage.value:.1f} +- {100.0 * of_voltage.std:.1f} % for each volt below"
        f" {nominal.value:.1f} V: {plain(VOLTAGE)} was added to the vehicle"
    )


def _identified_vehicle(
    vehicle: Vehicle,
    found: OwnNumbers,
    inflation: np.ndarray,
    apart: np.ndarray,
    dt: float,
    flight: Flight,
) -> Vehicle:
    """The vehicle with what was found.

    Args:
        vehicle: as given. found: its numbers. flight: where they are from.
        inflation: of their variances, by coloured innovations, (k,).
        apart: how far another likelihood has each, which is in its std, (k,).
        dt: seconds between rows.
    """
    covariance = found.estimate.covariance * np.sqrt(np.outer(inflation, inflation))
    stds = np.hypot(np.sqrt(np.diag(covariance)), apart).tolist()
    source = _source(flight)
    after = fitted_vehicle(
        vehicle,
        found.free,
        found.estimate.values,
        {f.name: with_timing(f, std, dt) for f, std in zip(found.free, stds, strict=True)},
        covariance,
        f"{source} (maximum likelihood)",
        flight,
    )
    return replace(after, description=f"{vehicle.description}; {source}")


def _source(flight: Flight) -> str:
    """What a number that is found has as its source, or the beginning of it."""
    return f"identified from {flight.name}"


def _answered_gusts(found: OwnNumbers, apart: np.ndarray) -> list[str]:
    """What is to be said of numbers that are elsewhere where the commands show the gusts, by more than
    the readings alone leave them."""
    std = found.estimate.std
    moved = [f.name for f, far in zip(found.free, apart, strict=True) if abs(far) > std[f.name]]
    if not moved:
        return []
    names = and_list([plain(name) for name in moved])
    return [
        f"the commands answer gusts: where they show these, {names} would be elsewhere by more than"
        " the readings alone leave open; how far is a part of the std"
    ]


def _at_limits(found: OwnNumbers) -> list[str]:
    """What is to be said of numbers that stand at the limit of what is believed."""
    there = [plain(f.name) for f in found.free if f.is_at_limit(found.estimate.values[f.name])]
    if not there:
        return []
    stand = "stand" if len(there) > 1 else "stands"
    return [
        f"{and_list(there)} {stand} at a limit of what is believed (of a vehicle's number 0.3 to 3"
        " times the file's): what the flights show may be something else"
    ]


def _split(flight: Flight, hold_out: Collection[str]) -> tuple[Flight, Flight]:
    """The runs to fit, and those to fly again: the held-out ones, or all."""
    if not hold_out:
        return flight, flight
    held = flight.select(hold_out)
    used = [run.name for run in flight.runs if not {run.name, run.whole} & set(hold_out)]
    if not used:
        raise InputError("all runs are held out: nothing is left to identify from")
    return flight.select(used), held


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
