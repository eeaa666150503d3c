"""A flight is refused where its log contradicts itself, with the line of its card to change.

Data flow::

    flight, vehicle -> even rows (even_rows.py) and the vehicle's hover (machine.py)
        -> coefficients that should be near 1 (relations.py), ranges -> faults (checks.py)
        -> the change of the card that puts them right (card_changes.py) -> one line, or nothing

A fault of the machine is none of the log: no check asks for more of the vehicle than a sign, and a
size within a
factor. What cannot be seen is not judged: a channel that takes part in no relation here may have
any sign.
"""

import difflib
from collections.abc import Collection
from dataclasses import dataclass

from coax_env.consistency import checks
from coax_env.consistency.card_changes import Advice, advice
from coax_env.consistency.checks import Checker, Fault
from coax_env.consistency.even_rows import even_rows
from coax_env.consistency.machine import machine_of
from coax_env.errors import InputError
from coax_env.logs.flight import Flight
from coax_env.logs.units import SWASH_COMMANDS, without
from coax_env.model.layout import CHANNELS, ROTOR_SPEEDS
from coax_env.model.vehicle import Vehicle

MOST_SAID = 3
"""Faults that a refusal quotes; it names all."""


@dataclass(frozen=True)
class Agreement:
    """What the checks say of a flight.

    Attributes:
        faults: that are not waived.
        advice: for the card; None without faults.
        waived: faults that are waived.
        unseen: channels whose sign no check could see.
    """

    faults: tuple[Fault, ...]
    advice: Advice | None
    waived: tuple[Fault, ...]
    unseen: tuple[str, ...]


def refuse_disagreement(
    flight: Flight, vehicle: Vehicle, waive: Collection[str] = ()
) -> tuple[str, ...]:
    """Remarks on a flight that agrees with itself.

    Args:
        flight: what of it was flown (estimation/flown.py).
        vehicle: in the flight's air.
        waive: names of checks to pass over, beside the card's.

    Raises:
        InputError: it does not; one line with the change of the card. Or no such check.
    """
    found = agreement(flight, vehicle, waive)
    if found.faults:
        raise InputError(_refusal(flight, found))
    return tuple(f"check {f.check} waived: {f.words}" for f in found.waived)


def agreement(flight: Flight, vehicle: Vehicle, waive: Collection[str] = ()) -> Agreement:
    """What all checks say of a flight; arguments as of `refuse_disagreement`."""
    waived = {*waive, *flight.waived}
    check_names(waived)
    said = [*_air(flight), *_swash_logged(flight)]
    of_card = tuple(f for f in said if f.check not in waived)
    passed_over = tuple(f for f in said if f.check in waived)
    if any(
        f.check in checks.AIR_CHECKS for f in of_card
    ):  # hover, and all that rests on it, is another
        return Agreement(of_card, Advice((), (), ()), passed_over, ())
    checker = Checker(even_rows(flight), machine_of(vehicle), waived)
    found = checker.found()
    faults = (*of_card, *found.faults)
    if not faults:  # of the whole; a run may be another
        faults = tuple(checker.of_runs(flight.run_names))
    return Agreement(
        faults,
        advice(flight, checker, found) if faults else None,
        (*passed_over, *found.waived),
        tuple(c for c in CHANNELS if c in checker.channels and c not in _seen(checker, found)),
    )


def check_names(names: Collection[str]) -> None:
    """Refuse what is the name of no check."""
    known = checks.names()
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
            meant = f": {close[0]!r} is meant?" if close else ""
            raise InputError(f"no check {name!r} to waive{meant}; there are {', '.join(known)}")


def _seen(checker: Checker, found: checks.Found) -> set[str]:
    """Channels that take part in a coefficient whose sign is clear."""
    seen = {*ROTOR_SPEEDS, "v"}
    for c in found.coefficients:
        if c.strength > checks.LEAST_STRENGTH:
            seen |= {c.left, c.part}
    return seen


def _air(flight: Flight) -> list[Fault]:
    """What the card says of the air."""
    found = []
    for name, unit, (low, high) in (
        ("gravity", "m/s2", checks.GRAVITIES),
        ("density", "kg/m3", checks.DENSITIES),
    ):
        value = flight.air.get(name)
        if value is not None and not low <= value <= high:
            words = (
                f"[air] {name} is {value:g} {unit}, and lies between {low:g} and {high:g} on earth"
            )
            hint = f"change [air] {name}"
            found.append(Fault(f"{name}-range", words, frozenset(), hint))
    return found


def _swash_logged(flight: Flight) -> list[Fault]:
    """Swash commands that are not there: a machine steered unseen has every fault there is."""
    missing = [c for c in SWASH_COMMANDS if flight.counts.get(without(c))]
    if not missing:
        return []
    unread = f" (columns not read: {', '.join(flight.unread)})" if flight.unread else ""
    return [
        Fault(
            "swash-logged",
            f"{' and '.join(missing)} not logged in every run, and would be taken as 0{unread}",
            frozenset(missing),
            f'name its column under [columns]: {missing[0]} = {{ name = "..." }}',
        )
    ]


def _refusal(flight: Flight, found: Agreement) -> str:
    where = flight.path / "card.toml" if flight.path else "the flight"
    said = "; ".join(f"{f.check}: {f.words}" for f in found.faults[:MOST_SAID])
    more = len(found.faults) - MOST_SAID
    text = f"{where}: the log contradicts itself: {said}"
    if more > 0:
        text += f"; and {more} more"
    steps = change_words(found)
    names = ",".join(f.check for f in found.faults)
    return f"{text}. {'. '.join(steps)}. If the log is right as it is: --waive {names}"


def change_words(found: Agreement) -> list[str]:
    """What to change, in sentences."""
    steps = []
    if found.advice and found.advice.lines:
        where = "Most of it would be right with, under" if found.advice.left else "Under"
        steps.append(f"{where} [columns] of its card: {', '.join(found.advice.lines)}")
        for other in found.advice.alternatives:
            steps.append(f"Or as well: {' or '.join(other)}")
    hints = dict.fromkeys(f.hint for f in found.faults if f.hint)
    steps += [hint[0].upper() + hint[1:] for hint in hints]
    if not steps:
        channels = sorted(frozenset().union(*(f.channels for f in found.faults)))
        steps.append(
            f"No single change of [columns] puts it right: look at {', '.join(channels)}, and"
            " whether it is this vehicle"
        )
    return steps
