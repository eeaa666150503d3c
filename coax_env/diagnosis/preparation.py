"""A log made ready for the search: what is fitted, what is held out, and what may be named.

Data flow::

    flight -> its flown parts -> does it agree with itself? -> vibration taken out
        -> rows at a rate that the filter has time for -> runs to fit, runs held out
        -> how speeds follow the battery -> effects that may be named -> problem
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.consistency.agreement import refuse_disagreement
from coax_env.diagnosis import onboard_filter, slow_commands
from coax_env.diagnosis.hold_out import check_hold_out, split
from coax_env.diagnosis.problem import WEAK_OR_LATE, Problem
from coax_env.diagnosis.settings import Settings
from coax_env.errors import InputError
from coax_env.estimation import vibration
from coax_env.estimation.battery import (
    VOLTAGE,
    FeltVoltage,
    felt_voltage,
    stated,
    voltage_varies,
)
from coax_env.estimation.fitted_vehicle import double_counting
from coax_env.estimation.flown import flown_parts
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.state_space import Noise, Record
from coax_env.logs.fast_rows import decimated
from coax_env.logs.flight import Flight
from coax_env.model import effects
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle import Vehicle
from coax_env.progress import Progress

TURN = 2.0 * math.pi
SONAR = frozenset({"sonar_tilt", "sonar_scale", "sonar_delay"})
"""Effects of a height that is an echo's."""
OF_POSITION = frozenset({"frame_yaw", "marker_offset", "pose_delay", "position_spring"})
"""Effects that only a measured position shows."""
YAW = frozenset({"r", "psi"})
"""Readings of which one at least shows how the heading turns."""


@dataclass(frozen=True)
class Prepared:
    """A log made ready for the search.

    Attributes:
        flight: its flown parts, rows at a rate that the filter has time for.
        vehicle: as given, in the air of the flight.
        problem: the runs to fit, and what may be named.
        held: the runs held out.
        noise: levels to start from.
        as_given: the model of the vehicle as given, where that of the problem knows how speeds follow
            the battery's voltage.
        felt: how they do, where the felt thrust shows it.
        lines: of a vibration that the vehicle file does not have.
        remarks: what was found on the way.
    """

    flight: Flight
    vehicle: Vehicle
    problem: Problem
    held: list[Record]
    noise: Noise
    as_given: HeliModel
    felt: FeltVoltage | None
    lines: tuple[vibration.Line, ...]
    remarks: tuple[str, ...]


def prepared(
    flight: Flight,
    vehicle: Vehicle,
    hold_out: Sequence[str] | None,
    exclude: Collection[str],
    settings: Settings,
    report: Progress,
    waive: Collection[str] = (),
) -> Prepared:
    """A log made ready for the search.

    Args:
        flight: as read. vehicle: in its air.
        hold_out: names of the runs to hold out; None chooses them; empty: all data fitted.
        exclude: effects of the catalogue that must not be named.
        settings: thresholds and limits.
        report: called with a line of text at every step.
        waive: checks of the log with itself that are passed over, beside the card's.

    Raises:
        InputError: a run or effect that does not exist, a log that contradicts itself, or nothing left
            to fit.
    """
    flight.select(hold_out or ())
    check_hold_out(hold_out, flight.run_names)
    flight = flown_parts(flight, vehicle)
    passed_over = refuse_disagreement(flight, vehicle, waive)
    lines, calm, calm_vehicle = (
        ((), flight, vehicle) if "vibration" in exclude else vibration.calmed(flight, vehicle)
    )
    circular = onboard_filter.of_onboard_filter(calm.runs)
    flight, calm = decimated(flight), decimated(calm)
    noise = starting_noise(calm, calm_vehicle)
    candidates = namable(exclude, vehicle, flight)
    report("choosing the runs to hold out")
    records = [record_of(run) for run in calm.runs]
    if circular:
        records = onboard_filter.read_seldom(records, CHANNELS)
    of_flight = HeliModel(vehicle, stated(flight, vehicle))
    used, held = split(of_flight, records, noise, hold_out, candidates, settings)
    fitted_on = flight.select(r.whole for r in used)
    model = as_given = HeliModel(vehicle, stated(fitted_on, vehicle))
    felt = felt_voltage(fitted_on, vehicle) if VOLTAGE in candidates else None
    if felt is not None and felt.is_shown(settings.evidence):
        report("speeds follow the battery's voltage, by the felt thrust")
        model = HeliModel(felt.known(vehicle, diagnosed_from(flight)))
        candidates = tuple(e for e in candidates if e != VOLTAGE)
    else:
        felt = None
    between = slow_commands.between_known(used)
    seldom = between > settings.unknown_commands
    if seldom:
        candidates = tuple(e for e in candidates if e not in WEAK_OR_LATE)
    problem = Problem.of(model, used, candidates, settings, report)
    problem = replace(problem, of_onboard_filter=circular, between_commands=between)
    remarks = (
        *flight.notes,
        *passed_over,
        *double_counting(flight, vehicle),
        *([vibration.remark(lines)] if lines else []),
        *([onboard_filter.remark()] if circular else []),
        *([slow_commands.of_seldom(between)] if seldom else []),
    )
    new_lines = lines if "vibration" not in vehicle.effects else ()
    return Prepared(flight, vehicle, problem, held, noise, as_given, felt, new_lines, remarks)


def diagnosed_from(flight: Flight) -> str:
    """The source of what a flight says. flight: any."""
    return f"diagnosed from {flight.name}"


def namable(exclude: Collection[str], vehicle: Vehicle, flight: Flight) -> tuple[str, ...]:
    """Effects that may be named: not excluded, not in the vehicle yet, and with their sensor aboard.

    Of sag by time and by voltage the one, of what goes by another's name the other.

    Args:
        exclude: effects of the catalogue.
        vehicle: as given.
        flight: whose channels are aboard.

    Raises:
        InputError: an effect to exclude that does not exist.
    """
    for name in exclude:
        if name not in effects.CATALOGUE:
            known = ", ".join(effects.CATALOGUE)
            raise InputError(f"no effect {name!r} to exclude; the catalogue has {known}")
    absent = set(exclude) | set(vehicle.effects) | _without_sensor(flight)
    absent.add("battery_sag" if voltage_varies(flight) else "battery_voltage")
    return tuple(
        e
        for e, entry in effects.CATALOGUE.items()
        if e not in absent and not entry.line and not entry.named_as
    )


def _without_sensor(flight: Flight) -> frozenset[str]:
    """Effects of readings that the flight does not have, or that another effect stands for.

    What only turns the heading is none where neither that nor its rate is read: velocities show where
    gusts have turned it, and four of four **synthetic** flights had a yaw inertia of 20 to 32 nats.
    Where a position is aboard, the height comes with it; where no gyro is either, so does the heading.
    Without a position a late attitude and a late pose are one effect.
    """
    tracked, gyros = {"pn", "pe"} <= set(flight.channels), {"p", "q", "r"} & set(flight.channels)
    absent = SONAR if tracked else OF_POSITION
    if YAW.isdisjoint(flight.channels):
        absent |= {e for e, entry in effects.CATALOGUE.items() if YAW.issuperset(entry.channels)}
    blind = (tracked and not gyros) or not _turns(flight)
    return absent | {"magnetic_field"} if blind else absent


def _turns(flight: Flight) -> bool:
    """Whether the headings of all runs together cover more than a quarter turn."""
    headings = [run.measured["psi"] for run in flight.runs if "psi" in run.measured]
    if not headings:
        return False
    around = np.sort(np.mod(np.concatenate(headings), TURN))
    around = around[np.isfinite(around)]
    gaps = np.diff(around, append=around[:1] + TURN)
    return bool(gaps.size) and TURN - float(gaps.max()) > TURN / 4.0
