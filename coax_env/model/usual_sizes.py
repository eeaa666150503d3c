"""Usual sizes on another machine: an effect's numbers are lama400d's, and scale with the vehicle.

`EffectParameter.scale` is a product of the quantities below, ``"weight * arm / rotor_speed"``. Each is
taken as a ratio to lama400d's, so that on that machine every size is the catalogue's to the last bit.
On a machine scaled dynamically - all lengths alike, all masses alike, gravity kept, so that times go
as the root of the length - the sizes are the same shares of its own weights, speeds and inertias.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache

from coax_env.model import effects
from coax_env.model.effect_registry import EffectParameter
from coax_env.model.generic_terms import hover_speeds
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

QUANTITIES: Mapping[str, Callable[[Mapping[str, float], float], float]] = {
    "mass": lambda v, omega: v["mass"],
    "weight": lambda v, omega: v["mass"] * v["gravity"],
    "length": lambda v, omega: v["rotor_radius"],
    "arm": lambda v, omega: v["arm_lower"],
    "inertia_zz": lambda v, omega: v["inertia_zz"],
    "time": lambda v, omega: math.sqrt(v["rotor_radius"] / v["gravity"]),
    "speed": lambda v, omega: math.sqrt(v["rotor_radius"] * v["gravity"]),
    "rotor_speed": lambda v, omega: omega,
    "tip_speed": lambda v, omega: omega * v["rotor_radius"],
    "torque": lambda v, omega: (
        v["torque_coefficient_upper"]
        * v["air_density"]
        * math.pi
        * v["rotor_radius"] ** 5
        * omega**2
    ),
}
"""What sizes go with, from a vehicle's numbers and the upper rotor's speed in hover [rad/s]. SI.

``time`` and ``speed`` are those of a fall through the rotor's radius, ``torque`` is the upper one's.
"""


def _quantities(vehicle: Vehicle) -> dict[str, float]:
    values, omega = vehicle.values(), hover_speeds(vehicle.vector)[0]
    return {name: quantity(values, omega) for name, quantity in QUANTITIES.items()}


@cache
def _reference() -> dict[str, float]:
    return _quantities(load_vehicle("lama400d"))


def ratios(vehicle: Vehicle) -> dict[str, float]:
    """Every quantity of a vehicle over lama400d's, by name."""
    return {name: own / _reference()[name] for name, own in _quantities(vehicle).items()}


def factor(scale: str, ratio: Mapping[str, float]) -> float:
    """What a scale comes to.

    Args:
        scale: quantities with ``*`` and ``/`` between them, read from left to right; empty: 1.
        ratio: of every quantity, see `ratios`.
    """
    words = ["*", *scale.split()] if scale else []
    result = 1.0
    for sign, name in zip(words[::2], words[1::2], strict=True):
        own = 1.0 if name == "1" else ratio[name]
        result = result * own if sign == "*" else result / own
    return result


def scaled(
    parameters: Iterable[EffectParameter], ratio: Mapping[str, float]
) -> tuple[EffectParameter, ...]:
    """Parameters with the sizes, bounds and probes of another machine.

    Args:
        parameters: as in the catalogue. ratio: of every quantity, see `ratios`.
    """
    return tuple(_scaled(p, factor(p.scale, ratio)) for p in parameters)


def _scaled(p: EffectParameter, by: float) -> EffectParameter:
    return replace(
        p,
        usual=by * p.usual,
        smallest=by * p.smallest,
        lower=by * p.lower,
        upper=by * p.upper,
        probe=by * p.probe,
    )


def sized_for(vehicle: Vehicle, effect: str) -> tuple[EffectParameter, ...]:
    """An effect's parameters with their sizes on a vehicle.

    Args:
        vehicle: bare or not: its effects do not matter.
        effect: its name in the catalogue, or a generic group's.
    """
    return scaled(effects.GROUPS[effect].parameters, ratios(vehicle))
