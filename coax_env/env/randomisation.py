"""Which vehicle flies: the given one, one from its spread, from ranges of numbers, or from a list.

Each flight draws from its own helicopter's random stream, so that it flies the same in a fleet of any
size. `Draws` turns streams into numbers by name; `Draws.vectors` those into parameter vectors.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError
from coax_env.kernel.compilation import compiled
from coax_env.kernel.random_streams import COUNTER, uniform
from coax_env.model import effects, parameters
from coax_env.model.vehicle import POSITIVE, Vehicle
from coax_env.model.vehicle_file import load_vehicle

Wind = float | Sequence[float] | Mapping[str, Sequence[float]] | None
"""None; (north, east) [m/s]; a speed from anywhere; or {"speed": (low, high)}, that is drawn too."""
Randomize = str | Mapping[str, Sequence[float]] | Sequence[str | Path | Vehicle] | None
"""None; ``"posterior"``; parameter -> (low, high); or a list of vehicles."""


class Draws:
    """What one ``randomize=`` draws.

    Attributes:
        names: of the numbers drawn, full names as ``ground_effect.gain``; none without chance.
        vehicles: those whose sensors and actuators fly; a draw is of one of them.
        places: in a parameter vector, of what flights may differ in, (k,) int64, in order.
        effects: full names of the parameters of every effect that may be on in some flight.
    """

    def __init__(self, vehicle: Vehicle, randomize: Randomize = None) -> None:
        self.vehicles = [vehicle]
        self.names: tuple[str, ...] = tuple(vehicle.values()) if randomize is not None else ()
        self._ranges = np.empty((0, 2))
        self._posterior = isinstance(randomize, str)
        if isinstance(randomize, str):
            if randomize != "posterior":
                raise InputError(
                    "randomize must be None, 'posterior', ranges by parameter, or a list of "
                    f"vehicles, found {randomize!r}"
                )
        elif isinstance(randomize, Mapping):
            vehicle = self._in_ranges(vehicle, randomize)
            self.vehicles = [vehicle]
        elif randomize is not None:
            self.vehicles = _from_list(randomize)
            self.names = tuple(dict.fromkeys(n for v in self.vehicles for n in v.values()))
        self._spread = vehicle.spread() if self._posterior else None
        self._columns = np.array([effects.parameter_index(n) for n in self.names], dtype=np.int64)
        self._vectors = np.array([v.vector for v in self.vehicles])
        self._place(self._varying())

    @property
    def random(self) -> bool:
        """Whether flights differ in what they fly."""
        return bool(self.names)

    def _in_ranges(self, vehicle: Vehicle, ranges: Mapping[str, Any]) -> Vehicle:
        limits = {name: _limits(name, pair) for name, pair in ranges.items()}
        for name, (low, high) in limits.items():
            group, _, own = name.rpartition(".")
            middle = 0.5 * (low + high)
            vehicle = (
                vehicle.with_effect(group, **{own: middle})
                if group
                else vehicle.with_values({name: middle})
            )
        values = vehicle.values()
        self.names = tuple(values)
        self._ranges = np.array([limits.get(n, (v, v)) for n, v in values.items()])
        return vehicle

    def draw(self, streams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Draw one vehicle per stream, (m, 2), which moves on.

        Returns:
            values of `names`, shape (m, n), and which of `vehicles`, shape (m,).
        """
        kinds = np.zeros(len(streams), dtype=np.int64)
        values = np.empty((len(streams), len(self.names)))
        if self._spread is not None:
            for stream, row in zip(streams, values, strict=True):
                row[:] = np.random.default_rng(stream).standard_normal(len(row))
                stream[COUNTER] += np.uint64(1)
            return self._spread.at(values), kinds
        if len(self._ranges):
            _draw_ranges(streams, self._ranges, values)
            return values, kinds
        _pick(streams, len(self.vehicles), kinds)
        return self._vectors[kinds][:, self._columns], kinds

    def _varying(self) -> np.ndarray:
        """Which of `names` may differ between flights, bool."""
        if self._spread is not None:
            return self._spread.std > 0.0
        if len(self._ranges):
            return self._ranges[:, 0] < self._ranges[:, 1]
        return np.ptp(self._vectors[:, self._columns], axis=0) > 0.0

    def _place(self, varying: np.ndarray) -> None:
        """Where in a parameter vector stands what `names` of this mask decide."""
        drawn = self._columns[varying]
        known = set(drawn.tolist())
        references = [r for r, own in parameters.GUST_REFERENCE.items() if own in known]
        switches = np.arange(effects.SWITCHES.start, effects.SWITCHES.stop)
        by_effects = drawn[drawn >= switches[-1] + 1]
        kinds = np.ptp(self._vectors, axis=0) > 0.0  # between the vehicles of a list
        thrown = switches if len(by_effects) else switches[kinds[effects.SWITCHES]]
        self.places = np.unique([*drawn, *references, *thrown, *np.flatnonzero(kinds)]).astype(
            np.int64
        )
        self.effects = effects.acting(self._vectors, known)
        self._own = self._vectors[:, self.places]
        self._values, self._drawn = np.flatnonzero(varying), np.searchsorted(self.places, drawn)
        self._references = np.searchsorted(self.places, references)
        self._referred = np.searchsorted(
            self.places, [parameters.GUST_REFERENCE[r] for r in references]
        )
        self._by_effects, self._at_effects = by_effects, np.searchsorted(self.places, by_effects)
        self._at_switches = np.searchsorted(self.places, switches) if len(by_effects) else None
        same = self._vectors.copy()
        same[:, by_effects] = effects.off_vector()[by_effects]
        effects.set_switches(same)
        self._always = same[:, effects.SWITCHES] > 0.0

    def numbers(self, values: np.ndarray, kinds: np.ndarray) -> np.ndarray:
        """What was drawn, as the parameters at `places`, shape (m, k).

        Args:
            values, kinds: as `draw` returns them.
        """
        own = self._own[kinds]
        own[:, self._drawn] = values[:, self._values]
        own[:, self._references] = own[:, self._referred]
        if self._at_switches is not None:
            thrown = effects.switched_on(own[:, self._at_effects], self._by_effects)
            own[:, self._at_switches] = thrown | self._always[kinds]
        return own

    def most(self, name: str) -> float:
        """The largest value a parameter can have (its upper limit where the spread has no end)."""
        index = effects.parameter_index(name)
        largest = float(self._vectors[:, index].max())
        if name in self.names and len(self._ranges):
            return max(largest, float(self._ranges[self.names.index(name), 1]))
        if name in self.names and self._posterior:
            group, _, own = name.partition(".")
            return next(p.upper for p in effects.CATALOGUE[group].parameters if p.name == own)
        return largest


def _limits(name: str, limits: Any) -> tuple[float, float]:
    """Low and high of a range, checked against what the model knows of the parameter."""
    group, _, own = name.partition(".")
    entry = effects.CATALOGUE.get(group)
    known = {p.name: p for p in entry.parameters} if entry else {}
    if name not in parameters.BASE and own not in known:
        raise InputError(f"randomize: {name!r} is neither a base parameter nor one of an effect")
    try:
        low, high = (float(limit) for limit in limits)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise InputError(
            f"randomize: {name!r} needs (low, high), finite and in order, found {limits!r}"
        )
    if name in POSITIVE and low <= 0.0:
        raise InputError(f"randomize: {name!r} must stay positive, found {limits!r}")
    if own in known and (low < known[own].lower or high > known[own].upper):
        raise InputError(
            f"randomize: {name!r} must stay in {known[own].lower:g} .. {known[own].upper:g}, "
            f"found {limits!r}"
        )
    return low, high


def _from_list(sources: Any) -> list[Vehicle]:
    if not isinstance(sources, Sequence) or not sources:
        raise InputError(f"randomize: a list of vehicles must have one at least, found {sources!r}")
    return [load_vehicle(source) for source in sources]


@compiled()
def _draw_ranges(streams, ranges, values):
    """Uniform numbers between the ranges (n, 2) into values (m, n); one draw for each with a width."""
    for i in range(len(streams)):
        for k in range(len(ranges)):
            low, high = ranges[k, 0], ranges[k, 1]
            values[i, k] = low if low == high else uniform(streams[i], low, high)


@compiled()
def _pick(streams, count, kinds):
    """One of `count`, each as likely, into kinds (m,)."""
    for i in range(len(streams)):
        kinds[i] = min(int(uniform(streams[i], 0.0, float(count))), count - 1)
