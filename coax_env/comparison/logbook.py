"""A machine's logbook: each number over many flights, with what changed between two of them.

Neighbouring flights are compared (compare.py), in parallel; of each flight is kept what it says of the
machine's numbers (information.py). The numbers over time are then a filter over flights: the posterior
of the last is the prior of the next, opened by a usual size where a change is named. So a new flight
costs one comparison with the one before it, and nothing old is fitted again.
"""

import hashlib
import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coax_env import workers
from coax_env.comparison.compare import of_two_flights
from coax_env.comparison.information import Information, information_of
from coax_env.comparison.shared import parts_of
from coax_env.comparison.two_flights import ROTOR_SPEED, read_two
from coax_env.consistency.agreement import refuse_disagreement
from coax_env.errors import InputError
from coax_env.estimation.flown import flown_parts
from coax_env.files import read_toml
from coax_env.logs.card import CARD
from coax_env.logs.flight import Flight, read_flight
from coax_env.model import effects
from coax_env.model.parameters import BASE
from coax_env.model.vehicle_file import load_vehicle

Content = dict[str, Any]
"""What logbook.json holds."""
DETERMINED = 0.7
"""Posterior std over the prior's from which on a number is one that the flights know (settings.py)."""


@dataclass(frozen=True)
class Entry:
    """One flight of the logbook. order: its date, else its name. mark: hash of its content."""

    name: str
    folder: Path
    order: str
    mark: str


def logbook(
    folder: str | Path,
    vehicle: str | None = None,
    kept: Mapping[str, Any] | None = None,
    jobs: int = 1,
    backend: str = "loky",
    done: Callable[[Content], None] | None = None,
    waive: Collection[str] = (),
) -> Content:
    """The logbook of all flights in a folder.

    Args:
        folder: whose folders with a card are the flights, in the order of the cards' ``date``, else by
            name.
        vehicle: shipped name or path; None: the cards', which must then agree.
        kept: an earlier logbook; flights that it has are not fitted again.
        jobs, backend: of `workers.each`.
        done: called with the logbook so far after every comparison.
        waive: checks of a log with itself (consistency/) that are passed over, beside the cards'.

    Raises:
        InputError: fewer than two flights, two of one name, of two vehicles, or a log that contradicts
            itself: none is compared then.
    """
    entries = _entries(Path(folder))
    kept = kept or {}
    if kept and kept.get("vehicle") != vehicle:
        raise InputError(
            f"the logbook there is of vehicle {kept.get('vehicle')}, not of {vehicle}: give it --out"
            " another folder"
        )
    known = {(link["a"], link["b"]): link for link in kept.get("links", [])}
    pairs = list(itertools.pairwise(entries))
    links = {(a.mark, b.mark): known[a.mark, b.mark] for a, b in pairs if (a.mark, b.mark) in known}
    missing = [(a, b) for a, b in pairs if (a.mark, b.mark) not in links]
    for entry in dict.fromkeys(entry for pair in missing for entry in pair):
        _refuse(entry, vehicle, waive)
    report = done or (lambda content: None)
    for (a, b), link in workers.each(partial(_link, vehicle, waive), missing, jobs, backend):
        links[a.mark, b.mark] = link
        report(_content(entries, links, vehicle))
    return _content(entries, links, vehicle)


def _entries(folder: Path) -> list[Entry]:
    """The flights, in order."""
    found = []
    if not folder.is_dir():
        raise InputError(f"no folder of flights at {folder}")
    for path in sorted(p for p in folder.iterdir() if (p / CARD).exists()):
        date = read_toml(path / CARD).get("date")
        order = f"{date} {path.name}" if date is not None else path.name
        found.append(Entry(path.name, path, order, mark_of(read_flight(path))))
    if len(found) < 2:
        raise InputError(
            f"{folder}: {len(found)} flights; a logbook needs two folders with a {CARD}"
        )
    for a in found:
        twin = next((b for b in found if b.mark == a.mark and b is not a), None)
        if twin:
            raise InputError(f"{twin.folder}: the same flight as {a.folder}")
    return sorted(found, key=lambda entry: entry.order)


def mark_of(flight: Flight) -> str:
    """Hash of a flight's content."""
    lines = [f"{name} {mark}" for name, mark in sorted(flight.hashes.items())]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _refuse(entry: Entry, vehicle: str | None, waive: Collection[str]) -> None:
    """Refuse a flight whose log contradicts itself, before hours of comparisons and not after."""
    flight = read_flight(entry.folder)
    machine = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    refuse_disagreement(flown_parts(flight, machine), machine, waive)


def _link(vehicle: str | None, waive: Collection[str], pair: tuple[Entry, Entry]) -> Content:
    """Two neighbours compared, and what each of them says."""
    a, b = pair
    result = of_two_flights(read_two(a.folder, b.folder, vehicle, waive))
    assert result.state is not None
    says = [
        information_of(result.state, part, flight).as_json()
        for part, flight in zip(parts_of(result.state.problem), result.flights, strict=True)
    ]
    kept = ("verdict", "changes", "unexplained", "circumstances", "shared")
    return {
        "a": a.mark, "b": b.mark, **{key: result.changes[key] for key in kept}, "information": says
    }  # fmt: skip


# --- numbers over time ------------------------------------------------------------------------------


def _content(
    entries: Sequence[Entry], links: Mapping[tuple[str, str], Content], vehicle: str | None
) -> Content:
    """The logbook of the comparisons that are done, from the first flight on."""
    chain = []
    for a, b in itertools.pairwise(entries):
        if (a.mark, b.mark) not in links:
            break
        chain.append(links[a.mark, b.mark])
    shown = entries[: len(chain) + 1] if chain else []
    return {
        "vehicle": vehicle,
        "flights": [{"name": e.name, "order": e.order, "hash": e.mark} for e in shown],
        "numbers": over_time(chain),
        "changes": [
            {"since": e.name, "after": before.name, **change}
            for before, e, link in zip(shown, shown[1:], chain, strict=False)
            for change in link["changes"]
        ],
        "links": list(links.values()),
    }


def over_time(chain: Sequence[Content]) -> dict[str, Content]:
    """Each number flight by flight: by all flights so far, and by that flight alone.

    Args:
        chain: comparisons of neighbours, in order.
    """
    if not chain:
        return {}
    says = [Information.of_json(chain[0]["information"][0])]
    says += [Information.of_json(link["information"][1]) for link in chain]
    named = {e for link in chain for e in link["shared"]}
    named |= {c["effect"] for link in chain for c in link["changes"]}
    names = [n for n in says[0].names if n in BASE or n.partition(".")[0] in named]
    at = [says[0].names.index(n) for n in names]
    mean, std = says[0].mean[at], says[0].std[at]
    prior = np.diag(1.0 / std**2)
    covariance, value = np.diag(std**2), mean
    rows: dict[str, list[Content]] = {n: [] for n in names}
    for k, of_flight in enumerate(says):
        if k:
            covariance = covariance + np.diag(_opened(chain[k - 1], names))
        precision, weighted = of_flight.on(names)
        before = np.linalg.inv(covariance)
        covariance = np.linalg.inv(before + precision)
        value = covariance @ (before @ value + weighted)
        alone = np.linalg.inv(prior + precision)
        own = alone @ (prior @ mean + weighted)
        for i, n in enumerate(names):
            rows[n].append(
                {
                    "value": float(value[i]),
                    "std": float(np.sqrt(covariance[i, i])),
                    "alone": float(own[i]),
                    "alone_std": float(np.sqrt(alone[i, i])),
                }
            )
    return {
        n: {
            "unit": unit_of(n),
            "prior": float(mean[i]),
            "prior_std": float(std[i]),
            "flights": rows[n],
        }
        for i, n in enumerate(names)
        if rows[n][-1]["std"] < DETERMINED * std[i]
    }


def _opened(link: Content, names: Sequence[str]) -> np.ndarray:
    """Variances by which the numbers of what changed may have moved, (n,)."""
    changed = {n for c in link["changes"] for n in c["parameters"]}
    usual = {
        f"{e}.{p.name}": p.usual for e, entry in effects.CATALOGUE.items() for p in entry.parameters
    }
    return np.array([usual[n] ** 2 if n in changed else 0.0 for n in names])


def unit_of(name: str) -> str:
    """Unit of a number of the vehicle, or of an effect."""
    if name in BASE:
        return BASE[name]
    if name == ROTOR_SPEED:
        return "1"
    effect, _, own = name.partition(".")
    return next(p.unit for p in effects.CATALOGUE[effect].parameters if p.name == own)
