"""A vehicle: named numbers with value, std, unit and source, in one TOML form.

The form::

    name = "lama400d"
    description = "..."
    [parameters]
    mass = { value = 0.8, std = 0.008, unit = "kg", source = "Table I" }
    [effects.ground_effect]
    gain = { value = 0.1, std = 0.02, unit = "1", source = "..." }
    [sensors.h]                          # optional: what differs from the sensor suite's numbers
    noise = { value = 0.03, std = 0.0, unit = "m", source = "..." }
    bias = { value = 0.0, std = 0.02, unit = "m", source = "..." }  # std: drawn for every flight
    delay = { value = 0.08, std = 0.0, unit = "s", source = "..." }
    dropout = { value = 0.05, std = 0.0, unit = "1", source = "..." }  # also: rate, low, high
    [actuators]                          # optional: travel, speed range, rates (actuators.py)
    swash_travel = { value = 0.25, std = 0.0, unit = "rad", source = "..." }
    [covariance]                         # optional: parameters identified together
    names = ["mass", "ground_effect.gain"]
    correlation = [[1.0, 0.2], [0.2, 1.0]]
    [provenance]                         # optional: what the file was made from
    flights = ["sha256 of card.toml", ...]

A vehicle without an effect's group is without the effect.
"""

import os
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError, shown
from coax_env.files import read_toml
from coax_env.model import effects, parameters
from coax_env.model.file_numbers import ACTUATOR_NUMBERS, SENSOR_NUMBERS, sensor_number_fault
from coax_env.model.layout import CHANNEL_UNITS

SHIPPED = Path(__file__).parent / "vehicles"


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
        """A copy with numbers of its own for a channel, for instance ``"h", dropout=0.1``."""
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

    def without_effects(self) -> "Vehicle":
        """The bare model."""
        keep = [name for name in self.correlated if "." not in name]
        index = [self.correlated.index(name) for name in keep]
        corner = None if self.correlation is None else self.correlation[np.ix_(index, index)]
        return replace(self, effects={}, correlated=tuple(keep), correlation=corner)

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
        spread = self.spread()
        values = spread.at(rng.standard_normal(len(spread.names)))
        drawn = {
            name: value
            for name, value, std in zip(spread.names, values, spread.std, strict=True)
            if std > 0.0
        }
        return self.with_values(drawn, "drawn from the vehicle's spread")


def shipped_vehicles() -> list[str]:
    """Names that `load_vehicle` knows without a path."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def load_vehicle(source: "str | Path | Vehicle") -> Vehicle:
    """Read a vehicle by shipped name or path; a Vehicle is returned as it is.

    Raises:
        InputError: unknown name, unreadable file, or a field missing or out of its range.
    """
    if isinstance(source, Vehicle):
        return source
    path = Path(source)
    if str(source) in shipped_vehicles():
        path = SHIPPED / f"{source}.toml"
    elif not os.path.exists(path):
        known = ", ".join(shipped_vehicles())
        raise InputError(f"no vehicle {str(source)!r}: neither a file nor one of {known}")
    elif path.is_dir():
        raise InputError(f"{path}: is a folder, a vehicle is one TOML file")
    return _vehicle_from(read_toml(path), path)


def _vehicle_from(document: dict[str, Any], path: Path) -> Vehicle:
    base = _table(document.get("parameters"), path, "parameters")
    for name, unit in parameters.BASE.items():
        if name not in base:
            raise InputError(f"{path}: parameters.{name} is missing")
        _check_unit(base[name], unit, path, f"parameters.{name}")
    for name in base:
        if name not in parameters.BASE:
            raise InputError(f"{path}: parameters.{name} is not a parameter of the model")
    for name in POSITIVE:
        if base[name].value <= 0.0:
            raise InputError(
                f"{path}: parameters.{name} must be positive, found {base[name].value}"
            )
    groups = {}
    raw = document.get("effects", {})
    if not isinstance(raw, dict):
        raise InputError(f"{path}: [effects] must hold one table per effect")
    for effect, content in raw.items():
        if effect not in effects.GROUPS:
            raise InputError(f"{path}: effects.{effect} is not in the catalogue of effects")
        table = _table(content, path, f"effects.{effect}")
        known = {p.name: p for p in effects.GROUPS[effect].parameters}
        for name, parameter in table.items():
            if name not in known:
                raise InputError(f"{path}: effects.{effect}.{name} is not a parameter of it")
            _check_unit(parameter, known[name].unit, path, f"effects.{effect}.{name}")
        groups[effect] = effects.completed(effect, table, Parameter)
    names, correlation = _covariance(document.get("covariance"), path)
    provenance = document.get("provenance", {})
    if not isinstance(provenance, dict) or not isinstance(provenance.get("flights", []), list):
        raise InputError(f"{path}: [provenance] must be a table, its flights a list of hashes")
    vehicle = Vehicle(
        name=str(document.get("name", path.stem)),
        parameters=base,
        effects=groups,
        description=str(document.get("description", "")),
        correlated=names,
        correlation=correlation,
        provenance=provenance,
        sensors=_sensors(document.get("sensors", {}), path),
        actuators=_actuators(document.get("actuators", {}), path),
    )
    flat = vehicle.values()
    for name in names:
        if name not in flat:
            raise InputError(f"{path}: covariance.names has {name!r}, which the file does not")
    return vehicle


POSITIVE = tuple(
    name
    for name in parameters.BASE
    if name not in ("fuselage_drag_coefficient", "flap_coupling_lon", "flap_coupling_lat")
)
"""Base parameters that mean nothing at zero or below."""


def _table(content: Any, path: Path, where: str) -> dict[str, Parameter]:
    if not isinstance(content, dict):
        raise InputError(f"{path}: [{where}] is missing or not a table")
    result = {}
    for name, entry in content.items():
        if not isinstance(entry, dict):
            raise InputError(f"{path}: {where}.{name} must have value, std, unit and source")
        for key in ("value", "std", "unit", "source"):
            if key not in entry:
                raise InputError(f"{path}: {where}.{name} has no {key}")
        for key in ("value", "std"):
            number = entry[key]
            if isinstance(number, bool) or not isinstance(number, int | float):
                raise InputError(
                    f"{path}: {where}.{name}.{key} must be a number, found {shown(number)}"
                )
            if not abs(number) <= sys.float_info.max:
                raise InputError(
                    f"{path}: {where}.{name}.{key} must be finite, found {shown(number)}"
                )
        if entry["std"] < 0.0:
            raise InputError(f"{path}: {where}.{name}.std must not be negative")
        result[name] = Parameter(
            float(entry["value"]), float(entry["std"]), str(entry["unit"]), str(entry["source"])
        )
    return result


def _sensors(content: Any, path: Path) -> dict[str, dict[str, Parameter]]:
    if not isinstance(content, dict):
        raise InputError(f"{path}: [sensors] must hold one table per channel")
    result = {}
    for channel, entries in content.items():
        where = f"sensors.{channel}"
        if channel not in CHANNEL_UNITS:
            raise InputError(f"{path}: {where} is not a channel")
        table = _table(entries, path, where)
        for key, parameter in table.items():
            if key not in SENSOR_NUMBERS:
                known = ", ".join(SENSOR_NUMBERS)
                raise InputError(f"{path}: {where}.{key} is none of {known}")
            unit = SENSOR_NUMBERS[key] or CHANNEL_UNITS[channel]
            _check_unit(parameter, unit, path, f"{where}.{key}")
            fault = sensor_number_fault(key, parameter.value)
            if fault:
                raise InputError(f"{path}: {where}.{key} must {fault}, found {parameter.value:g}")
        if "low" in table and "high" in table and table["low"].value >= table["high"].value:
            raise InputError(f"{path}: {where}.low must be below {where}.high")
        result[channel] = table
    return result


def _actuators(content: Any, path: Path) -> dict[str, Parameter]:
    table = _table(content, path, "actuators")
    for name, parameter in table.items():
        if name not in ACTUATOR_NUMBERS:
            known = ", ".join(ACTUATOR_NUMBERS)
            raise InputError(f"{path}: actuators.{name} is none of {known}")
        _check_unit(parameter, ACTUATOR_NUMBERS[name], path, f"actuators.{name}")
        if parameter.value <= 0.0:
            raise InputError(
                f"{path}: actuators.{name} must be positive, found {parameter.value:g}"
            )
    slowest, fastest = table.get("rotor_speed_lowest"), table.get("rotor_speed_highest")
    if slowest and fastest and slowest.value >= fastest.value:
        raise InputError(f"{path}: actuators.rotor_speed_lowest must be below rotor_speed_highest")
    return table


def _check_unit(parameter: Parameter, unit: str, path: Path, where: str) -> None:
    if parameter.unit != unit:
        raise InputError(f"{path}: {where} must be in {unit!r}, found {parameter.unit!r}")


def _covariance(content: Any, path: Path) -> tuple[tuple[str, ...], np.ndarray | None]:
    if content is None:
        return (), None
    try:
        names = tuple(content["names"])
        matrix = np.array(content["correlation"], dtype=float)
        if not all(isinstance(name, str) for name in names):
            raise TypeError("a name that is no text")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: [covariance] needs names and a square correlation") from error
    if matrix.shape != (len(names), len(names)):
        raise InputError(f"{path}: covariance.correlation must be {len(names)} x {len(names)}")
    if len(set(names)) != len(names):
        raise InputError(f"{path}: covariance.names has a name twice")
    if not np.allclose(matrix, matrix.T, atol=1e-6) or not np.allclose(np.diag(matrix), 1.0):
        raise InputError(f"{path}: covariance.correlation must be symmetric with a unit diagonal")
    if len(names) and np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise InputError(f"{path}: covariance.correlation is not positive definite")
    return names, matrix


def vehicle_toml(vehicle: Vehicle) -> str:
    """The vehicle as TOML text, which `load_vehicle` reads back exactly."""
    import tomlkit

    document = tomlkit.document()
    document["name"] = vehicle.name
    document["description"] = vehicle.description
    document["parameters"] = _toml_table(vehicle.parameters.items())
    if vehicle.effects:
        groups = tomlkit.table(is_super_table=True)
        for effect, table in vehicle.effects.items():
            groups[effect] = _toml_table(table.items())
        document["effects"] = groups
    if vehicle.sensors:
        channels = tomlkit.table(is_super_table=True)
        for channel, numbers in vehicle.sensors.items():
            channels[channel] = _toml_table(numbers.items())
        document["sensors"] = channels
    if vehicle.actuators:
        document["actuators"] = _toml_table(vehicle.actuators.items())
    if vehicle.correlation is not None and len(vehicle.correlated):
        covariance = tomlkit.table()
        covariance["names"] = list(vehicle.correlated)
        covariance["correlation"] = [[float(c) for c in row] for row in vehicle.correlation]
        document["covariance"] = covariance
    if vehicle.provenance:
        document["provenance"] = dict(vehicle.provenance)
    return tomlkit.dumps(document)


def _toml_table(items: Iterable[tuple[str, Parameter]]) -> Any:
    import tomlkit

    table = tomlkit.table()
    for name, parameter in items:
        entry = tomlkit.inline_table()
        entry.update(
            {
                "value": float(parameter.value),
                "std": float(parameter.std),
                "unit": parameter.unit,
                "source": parameter.source,
            }
        )
        table[name] = entry
    return table
