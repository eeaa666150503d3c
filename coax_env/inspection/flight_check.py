"""What a flight folder contains, what is wrong with it, and what can be learned from it.

Data flow::

    flight -> runs and channels: rates, gaps, frozen and saturated sensors (readings.py)
           -> whether the log agrees with itself (consistency/)
           -> effects that would show, own numbers it determines (learnable.py)
           -> the next step, as a command
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from coax_env.consistency.agreement import Agreement, agreement, change_words
from coax_env.design.loop_oscillation import oscillations, remark
from coax_env.estimation.flown import flown_parts
from coax_env.inspection.learnable import EffectCheck, OwnNumber, learnable
from coax_env.inspection.readings import (
    ChannelCheck,
    RunCheck,
    channel_checks,
    run_check,
    sensor_faults,
)
from coax_env.logs.flight import Flight, read_flight
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.progress import Progress

NOT_BELIEVED = 0.02
"""Share of readings that no filter of this vehicle believes, above which something is wrong."""


@dataclass(frozen=True)
class FlightCheck:
    """Result of `check_flight`.

    missing: channels that no run has. repaired: what was done to the data while reading. suspicions: of
    units, signs and sensors, in words. waived: of them, those that the card passes over. unseen:
    channels whose sign no check could see. oscillating: that the control loop oscillates, in words.
    effects: of the catalogue, best shown first. undetermined: base parameters that these flights leave
    open, `directions` along what. not_believed: share of readings that the filter left out. next_step:
    in words, with a command.
    """

    flight: str
    vehicle: str
    runs: tuple[RunCheck, ...]
    channels: tuple[ChannelCheck, ...]
    missing: tuple[str, ...]
    repaired: tuple[str, ...]
    unread: tuple[str, ...]
    suspicions: tuple[str, ...]
    waived: tuple[str, ...]
    unseen: tuple[str, ...]
    oscillating: tuple[str, ...]
    effects: tuple[EffectCheck, ...]
    own_numbers: tuple[OwnNumber, ...]
    undetermined: tuple[str, ...]
    directions: tuple[str, ...]
    not_believed: float
    next_step: str

    def as_json(self) -> dict[str, Any]:
        """As check.json has it: a number that is not finite is null."""
        return _finite(asdict(self))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(content) for key, content in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(content) for content in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_flight(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    progress: Progress | None = None,
) -> FlightCheck:
    """Look through a flight before anything is fitted to it.

    Args:
        flight: a Flight or its folder.
        vehicle: a Vehicle, name or path; default the card's.
        progress: called with a line of text.

    Raises:
        InputError: the flight or the vehicle cannot be read; the message says what to do.
    """

    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    label = str(flight.vehicle if vehicle is None else getattr(vehicle, "name", vehicle))
    vehicle = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    flight = flown_parts(flight, vehicle)
    channels = channel_checks(flight)
    found = agreement(flight, vehicle)
    suspicions = [*contradictions(flight, found), *sensor_faults(channels)]
    if progress:
        progress("linearising along the records")
    learned = learnable(flight, vehicle)
    if learned.not_believed > NOT_BELIEVED and not suspicions:
        suspicions.append(
            f"{100 * learned.not_believed:.0f} % of the readings are too far from what {label} would"
            " read to be believed: is it this vehicle, and are signs and units those of"
            " the form (check_flight --form)?"
        )
    swinging = oscillations(flight.runs)
    where = str(flight.path or "FLIGHT")
    return FlightCheck(
        flight=where,
        vehicle=label,
        runs=tuple(run_check(run) for run in flight.runs),
        channels=channels,
        missing=tuple(c for c in CHANNELS if c not in flight.channels),
        repaired=flight.notes,
        unread=flight.unread,
        suspicions=tuple(suspicions),
        waived=tuple(f"{fault.check}: {fault.words}" for fault in found.waived),
        unseen=found.unseen,
        oscillating=(remark(swinging),) if swinging else (),
        effects=learned.effects,
        own_numbers=learned.own_numbers,
        undetermined=learned.undetermined,
        directions=learned.directions,
        not_believed=learned.not_believed,
        next_step=_next_step(where, label, bool(suspicions), learned.effects),
    )


def contradictions(flight: Flight, found: Agreement) -> list[str]:
    """What of a log contradicts itself, and what to change, in sentences."""
    if not flight.channels:
        unread = f" (not read: {', '.join(flight.unread)})" if flight.unread else ""
        return [f"no sensor in it{unread}: name the columns of the sensors under [columns]"]
    if not found.faults:
        return []
    said = [f"{fault.check}: {fault.words}" for fault in found.faults]
    names = ",".join(fault.check for fault in found.faults)
    return [*said, *change_words(found), f"If the log is right as it is: --waive {names}"]


def _next_step(where: str, vehicle: str, suspect: bool, found: Sequence[EffectCheck]) -> str:
    shown = [e.effect for e in found if e.verdict == "shows"]
    hidden = [e.effect for e in found if e.verdict == "hidden"]
    plan = f"scripts/plan_flight.py --vehicle {vehicle} --learn {','.join(hidden[:6])}"
    if suspect:
        return f"correct what is suspicious (card.toml), then scripts/check_flight.py {where} again"
    if not shown:
        return f"these flights are not informative enough; plan others: {plan}"
    diagnose = f"scripts/diagnose.py {where} --vehicle {vehicle}"
    return f"{diagnose}" + (f"; for what stays hidden, {plan}" if hidden else "")
