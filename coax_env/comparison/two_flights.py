"""Two flights of one machine, ready to be compared: read, cut to what was flown, without vibration."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from coax_env.consistency.agreement import refuse_disagreement
from coax_env.errors import InputError
from coax_env.estimation import vibration
from coax_env.estimation.battery import stated
from coax_env.estimation.engine import Engine
from coax_env.estimation.flown import flown_parts
from coax_env.estimation.helicopter import RISE, ROTORS, HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.state_space import Noise, Record
from coax_env.logs.fast_rows import decimated
from coax_env.logs.flight import Flight, read_flight
from coax_env.model.layout import N_INPUTS
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

A, B = "A", "B"
ROTOR_SPEED = "rotor_speed.scale"
"""Rotor speed per command, both rotors alike, less 1: what a battery's state makes of it."""


class MachineModel(HeliModel):
    """The helicopter with one number more: how much faster its rotors turn per command."""

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """As `HeliModel.vector`, that number at its end."""
        plain = {name: value for name, value in values.items() if name != ROTOR_SPEED}
        return np.append(super().vector(plain, noise), values.get(ROTOR_SPEED, 0.0))

    @property
    def input_places(self) -> np.ndarray:
        """As `HeliModel.input_places`, and of that number."""
        return np.append(super().input_places, -1)

    def inputs(self, record: Record, vector: np.ndarray) -> np.ndarray:
        """As `HeliModel.inputs`, rotor commands times 1 + that number."""
        u = super().inputs(record, vector)
        for half in (0, N_INPUTS):
            u[:, [half + rotor for rotor in ROTORS]] *= 1.0 + vector[-1]
        u[:, RISE] *= 1.0 + vector[-1]
        return u


@dataclass(frozen=True)
class OneFlight:
    """One of the two.

    Attributes:
        name: "A" or "B".
        flight: what was flown, vibration taken out.
        lines: of that vibration.
        vehicle: in the flight's air, without vibration.
        noise: to start from.
        remarks: on checks of the log with itself that were passed over.
    """

    name: str
    flight: Flight
    lines: tuple[vibration.Line, ...]
    vehicle: Vehicle
    noise: Noise
    remarks: tuple[str, ...] = ()

    def engine(self, held: Mapping[str, float]) -> Engine:
        """Over its records. held: what effects take as stated."""
        model = MachineModel(self.vehicle, held)
        return Engine(model, [record_of(run) for run in self.flight.runs])


def read_two(
    a: Flight | str | Path,
    b: Flight | str | Path | None,
    vehicle: Vehicle | str | Path | None,
    waive: Collection[str] = (),
) -> tuple[OneFlight, OneFlight]:
    """Both flights, or both parts of one.

    Args:
        a: a Flight or its folder. b: the other one; None: of `a`, the runs whose card says part "A" and
            those that say "B".
        vehicle: a Vehicle, name or path; None: the cards'.
        waive: checks of a log with itself (consistency/) that are passed over, beside the cards'.

    Raises:
        InputError: no such parts, flights of two vehicles, or a log that contradicts itself.
    """
    first, second = (read(a), read(b)) if b is not None else parts_of(read(a))
    if vehicle is None and first.vehicle != second.vehicle:
        raise InputError(
            f"these are flights of two vehicles, {first.vehicle} and {second.vehicle}: say with"
            " --vehicle which machine it was"
        )
    machine = load_vehicle(vehicle or first.vehicle)
    return one_flight(A, first, machine, waive), one_flight(B, second, machine, waive)


def read(flight: Flight | str | Path) -> Flight:
    """A flight, read where it is a folder."""
    return flight if isinstance(flight, Flight) else read_flight(flight)


def parts_of(flight: Flight) -> tuple[Flight, Flight]:
    """A flight's runs of part "A", and of part "B" (card).

    Raises:
        InputError: one of them is not there.
    """
    found = []
    for name in (A, B):
        runs = tuple(run for run in flight.runs if run.part == name)
        if not runs:
            where = flight.path or "this flight"
            raise InputError(
                f'{where}: no [[run]] says part = "{name}"; compare takes two flights, or one whose'
                ' runs say part = "A" or part = "B"'
            )
        found.append(replace(flight, runs=runs))
    return found[0], found[1]


def one_flight(
    name: str, flight: Flight, machine: Vehicle, waive: Collection[str] = ()
) -> OneFlight:
    """A flight ready to be compared.

    Args:
        name: of the part.
        flight: as read.
        machine: in any air.
        waive: as of `read_two`.
    """
    vehicle = machine.in_air(flight.air)
    flown = flown_parts(flight, vehicle)
    remarks = refuse_disagreement(flown, vehicle, waive)
    lines, calm, still = vibration.calmed(flown, vehicle)
    still, calm = vibration.without(still), decimated(calm)
    return OneFlight(name, calm, lines, still, starting_noise(calm, still), remarks)


def nominal_voltage(flights: tuple[OneFlight, OneFlight]) -> dict[str, float]:
    """What effects take as stated, of both flights together: one machine has one."""
    first = flights[0]
    both = replace(first.flight, runs=tuple(run for f in flights for run in f.flight.runs))
    return stated(both, first.vehicle)
