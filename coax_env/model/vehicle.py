"""A vehicle: named numbers with value, std, unit and source (vehicle_file.py reads and writes them).

A vehicle without an effect's group is without the effect.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from coax_env.model import effects, parameters
from coax_env.model.file_numbers import ACTUATOR_NUMBERS, SENSOR_NUMBERS
from coax_env.model.layout import CHANNEL_UNITS

POSITIVE = tuple(
    name
    for name in parameters.BASE
    if name not in ("fuselage_drag_coefficient", "flap_coupling_lon", "flap_coupling_lat")
)
"""Base parameters that mean nothing at zero or below."""


@dataclass(frozen=True)
class Parameter:
    """One number of a vehicle, in SI units. ``std`` is 0 where the number is exact."""

    value: float
    std: float
    unit: str
    source: str


@dataclass(frozen=True)
class Spread:
    """From what a vehicle's numbers are drawn; positive base parameters are log-normal."""

    names: tuple[str, ...]
    value: np.ndarray
    std: np.ndarray
    lognormal: np.ndarray  # bool
    correlated: np.ndarray  # places of the jointly identified ones
    factor: np.ndarray  # Cholesky factor of their correlation

    def at(self, z: np.ndarray) -> np.ndarray:
        """Numbers at independent standard normal ones, both of shape (..., n)."""
        z = np.array(z)
        if len(self.correlated):
            joint = z[..., self.correlated]  # summed row by row: alike in a batch of any size
            z[..., self.correlated] = (joint[..., None, :] * self.factor).sum(axis=-1)
        ratio = np.where(self.lognormal, self.std / np.where(self.lognormal, self.value, 1.0), 0.0)
        spread = np.log1p(ratio**2)
        logarithmic = self.value * np.exp(np.sqrt(spread) * z - spread / 2.0)
        return np.where(self.lognormal, logarithmic, self.value + self.std * z)


@dataclass(frozen=True)
class Vehicle:
    """Numbers of one machine. Immutable; `with_values` and `with_effect` give changed copies."""

    name: str
    parameters: Mapping[str, Parameter]
    effects: Mapping[str, Mapping[str, Parameter]] = field(default_factory=dict)
    description: str = ""
    correlated: tuple[str, ...] = ()
    correlation: np.ndarray | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    sensors: Mapping[str, Mapping[str, Parameter]] = field(default_factory=dict)
    actuators: Mapping[str, Parameter] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Parameter:
        """The parameter called ``"mass"`` or ``"ground_effect.gain"``."""
        group, _, own = name.rpartition(".")
        table = self.effects.get(group, {}) if group else self.parameters
        if own not in table:
            raise KeyError(f"vehicle {self.name!r} has no parameter {name!r}")
        return table[own]

    def values(self) -> dict[str, float]:
        """Every value by its full name, effects as ``effect.parameter``."""
        flat = {name: p.value for name, p in self.parameters.items()}
        for group, table in self.effects.items():
            flat |= {f"{group}.{name}": p.value for name, p in table.items()}
        return flat

    @cached_property
    def vector(self) -> np.ndarray:
        """The kernel's parameter vector, shape (effects.n_parameters(),)."""
        return effects.pack(self.values())

    def with_values(self, values: Mapping[str, float], source: str | None = None) -> "Vehicle":
        """A copy with some values changed; std, unit (and source unless given) stay."""
        changed = {}
        for name, value in values.items():
            old = self[name]
            changed[name] = replace(old, value=float(value), source=source or old.source)
        return self.with_parameters(changed)

    def with_parameters(self, changed: Mapping[str, Parameter]) -> "Vehicle":
        """A copy with some parameters replaced or, in effects of the catalogue, added."""
        base = dict(self.parameters)
        groups = {group: dict(table) for group, table in self.effects.items()}
        for name, parameter in changed.items():
            group, _, own = name.rpartition(".")
            if group:
                groups.setdefault(group, {})[own] = parameter
            elif own in base:
                base[own] = parameter
            else:
                raise KeyError(f"vehicle {self.name!r} has no parameter {name!r}")
        for group, table in groups.items():
            groups[group] = effects.completed(group, table, Parameter)
        return replace(self, parameters=base, effects=groups)

    def with_effect(self, effect: str, **values: float) -> "Vehicle":
        """A copy with an effect of the catalogue switched on, for instance ``gain=0.3``."""
        known = effects.GROUPS[effect].parameters
        unknown = set(values) - {p.name for p in known}
        if unknown:
            raise KeyError(f"effect {effect!r} has no parameter {sorted(unknown)[0]!r}")
        table = {
            f"{effect}.{p.name}": Parameter(float(values[p.name]), 0.0, p.unit, "set by hand")
            for p in known
            if p.name in values
        }
        return self.with_parameters(table)

    def with_sensor(self, channel: str, *, bias_std: float = 0.0, **values: float) -> "Vehicle":
        """A copy with numbers of its own for a channel, for instance ``"h", dropout=0.1``.

        Args:
            channel: whose, by its name.
            bias_std: of the bias that every flight draws, in the channel's unit.
            values: noise, bias, delay and so on (`SENSOR_NUMBERS`), in its unit or the channel's.

        Raises:
            KeyError: no such channel or number.
        """
        table = dict(self.sensors.get(channel, {}))
        if bias_std and "bias" not in values:
            values["bias"] = table["bias"].value if "bias" in table else 0.0
        for key, value in values.items():
            if channel not in CHANNEL_UNITS or key not in SENSOR_NUMBERS:
                raise KeyError(f"sensors have no {channel}.{key}")
            unit = SENSOR_NUMBERS[key] or CHANNEL_UNITS[channel]
            std = bias_std if key == "bias" else 0.0
            table[key] = Parameter(float(value), std, unit, "set by hand")
        return replace(self, sensors={**self.sensors, channel: table})

    def with_actuators(self, **values: float) -> "Vehicle":
        """A copy with limits of its actuators, for instance ``swash_travel=0.25`` (actuators.py)."""
        table = dict(self.actuators)
        for name, value in values.items():
            if name not in ACTUATOR_NUMBERS:
                raise KeyError(f"actuators have no limit {name!r}")
            table[name] = Parameter(float(value), 0.0, ACTUATOR_NUMBERS[name], "set by hand")
        return replace(self, actuators=table)

    def without_effects(self, names: Iterable[str] | None = None) -> "Vehicle":
        """A copy without some effects; None: without any, the bare model."""
        gone = set(self.effects if names is None else names)
        keep = [name for name in self.correlated if name.rpartition(".")[0] not in gone]
        index = [self.correlated.index(name) for name in keep]
        corner = None if self.correlation is None else self.correlation[np.ix_(index, index)]
        left = {name: own for name, own in self.effects.items() if name not in gone}
        return replace(self, effects=left, correlated=tuple(keep), correlation=corner)

    def in_air(self, air: Mapping[str, float]) -> "Vehicle":
        """A copy with a flight card's ``density`` and ``gravity`` instead of the file's."""
        names = {"density": "air_density", "gravity": "gravity"}
        return (
            self.with_values({names[k]: v for k, v in air.items()}, "flight card") if air else self
        )

    def seen(self, hashes: Iterable[str]) -> "Vehicle":
        """A copy that remembers the files it was fitted on, by their hashes."""
        flights = [*self.provenance.get("flights", ()), *hashes]
        return replace(self, provenance={**self.provenance, "flights": flights})

    def spread(self) -> Spread:
        """The distribution of this vehicle's numbers, in the order of `values`."""
        flat = dict(self.parameters) | {
            f"{g}.{n}": p for g, table in self.effects.items() for n, p in table.items()
        }
        names = tuple(flat)
        value = np.array([p.value for p in flat.values()])
        joint = self.correlated if self.correlation is not None else ()
        return Spread(
            names=names,
            value=value,
            std=np.array([p.std for p in flat.values()]),
            lognormal=np.array(["." not in name for name in names]) & (value > 0.0),
            correlated=np.array([names.index(name) for name in joint], dtype=int),
            factor=np.empty((0, 0))
            if self.correlation is None
            else np.linalg.cholesky(self.correlation),
        )

    def draw(self, rng: np.random.Generator) -> "Vehicle":
        """A vehicle drawn from this one's spread; positive base parameters are log-normal."""
        return self.at(rng.standard_normal(len(self.spread().names)))

    def at(self, z: np.ndarray) -> "Vehicle":
        """The vehicle at independent standard normal numbers (n,), in the order of `values`."""
        spread = self.spread()
        values = spread.at(z)
        drawn = {
            name: value
            for name, value, std in zip(spread.names, values, spread.std, strict=True)
            if std > 0.0
        }
        return self.with_values(drawn, "drawn from the vehicle's spread")
