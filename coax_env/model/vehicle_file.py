"""Vehicle files: one TOML form, read with every fault named in one line, and written.

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

Own checks instead of pydantic's or msgspec's: theirs quote no value or take several lines, and units,
ranges and names come from the catalogue of effects, not from a type.
"""

import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError, shown
from coax_env.files import read_toml
from coax_env.model import effects, parameters
from coax_env.model.file_numbers import ACTUATOR_NUMBERS, SENSOR_NUMBERS, sensor_number_fault
from coax_env.model.layout import CHANNEL_UNITS
from coax_env.model.vehicle import POSITIVE, Parameter, Vehicle

SHIPPED = Path(__file__).parent / "vehicles"


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


# --- reading ---------------------------------------------------------------------------------


def _vehicle_from(document: dict[str, Any], path: Path) -> Vehicle:
    base = _base_parameters(document.get("parameters"), path)
    groups = _effects(document.get("effects", {}), path)
    names, correlation = _covariance(document.get("covariance"), path)
    vehicle = Vehicle(
        name=str(document.get("name", path.stem)),
        parameters=base,
        effects=groups,
        description=str(document.get("description", "")),
        correlated=names,
        correlation=correlation,
        provenance=_provenance(document.get("provenance", {}), path),
        sensors=_sensors(document.get("sensors", {}), path),
        actuators=_actuators(document.get("actuators", {}), path),
    )
    flat = vehicle.values()
    for name in names:
        if name not in flat:
            raise InputError(f"{path}: covariance.names has {name!r}, which the file does not")
    return vehicle


def _base_parameters(content: Any, path: Path) -> dict[str, Parameter]:
    base = _table(content, path, "parameters")
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
    return base


def _effects(content: Any, path: Path) -> dict[str, Mapping[str, Parameter]]:
    if not isinstance(content, dict):
        raise InputError(f"{path}: [effects] must hold one table per effect")
    groups: dict[str, Mapping[str, Parameter]] = {}
    for effect, entries in content.items():
        if effect not in effects.GROUPS:
            raise InputError(f"{path}: effects.{effect} is not in the catalogue of effects")
        table = _table(entries, path, f"effects.{effect}")
        known = {p.name: p for p in effects.GROUPS[effect].parameters}
        for name, parameter in table.items():
            if name not in known:
                raise InputError(f"{path}: effects.{effect}.{name} is not a parameter of it")
            _check_unit(parameter, known[name].unit, path, f"effects.{effect}.{name}")
        groups[effect] = effects.completed(effect, table, Parameter)
    return groups


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


def _provenance(content: Any, path: Path) -> dict[str, Any]:
    if not isinstance(content, dict) or not isinstance(content.get("flights", []), list):
        raise InputError(f"{path}: [provenance] must be a table, its flights a list of hashes")
    return content


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


# --- writing ---------------------------------------------------------------------------------


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
