"""Causes in sentences: what an effect's values mean in flight, with numbers and intervals.

Each number comes with its unit and, to first order in the parameters' covariance, its 95 % interval.
The words and formulas stand in effect_meanings.py.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.model import effects
from coax_env.model.vehicle import Vehicle
from coax_env.plain_words import bounds
from coax_env.report.effect_meanings import CONSEQUENCES, Consequence, Values

NORMAL_95 = 1.96
"""Stds on either side that hold 95 %."""

DIFFERENCE = 1e-4  # of a parameter's usual size: step of the central differences


@dataclass(frozen=True)
class Evaluated:
    """A consequence with its number.

    Attributes:
        value: the number, in `unit`.
        half_width: of its 95 % interval.
        unit: of both.
        text: the words with the number in them.
        significant: whether the interval leaves out zero.
    """

    value: float
    half_width: float
    unit: str
    text: str
    significant: bool


def consequences(
    effect: str, values: Values, covariance: np.ndarray, vehicle: Vehicle
) -> list[Evaluated]:
    """What an effect's values mean in flight, each number with its unit and 95 % interval.

    Args:
        effect: its name in the catalogue.
        values: parameter's own name (``gain``) -> value; absent ones are at their off-value.
        covariance: of `values`, in their order, (k, k).
        vehicle: which has the effect.

    Returns:
        nothing for an effect that has no words: a user's own.
    """
    parameters = effects.CATALOGUE[effect].parameters
    at = {p.name: p.off for p in parameters} | dict(values)
    steps = {p.name: DIFFERENCE * p.usual for p in parameters}
    own = vehicle.values()
    result = []
    for consequence in CONSEQUENCES.get(effect, ()):
        slopes = np.array([_slope(consequence, at, own, name, steps[name]) for name in values])
        variance = max(float(slopes @ covariance @ slopes), 0.0)
        number = consequence.compute(at, own)
        result.append(_evaluated(consequence, number, NORMAL_95 * math.sqrt(variance)))
    return result


def _slope(consequence: Consequence, at: Values, own: Values, name: str, step: float) -> float:
    """Change of a consequence's number per unit of a parameter."""
    low, high = (consequence.compute({**at, name: at[name] + side * step}, own) for side in (-1, 1))
    change = math.remainder(high - low, 360.0) if consequence.direction else high - low
    return change / (2.0 * step)


def _evaluated(consequence: Consequence, value: float, half_width: float) -> Evaluated:
    """The number in its words."""
    reversed_ = bool(consequence.words_if_negative) and value < 0.0
    words = consequence.words_if_negative if reversed_ else consequence.words
    shown = abs(value) if reversed_ else value
    text = words.format(bounds(shown, half_width, consequence.unit, consequence.signed))
    significant = consequence.direction or abs(value) > half_width
    return Evaluated(value, half_width, consequence.unit, text, significant)


def sigmas(evidence: float) -> float:
    """Evidence [nats] as the standard deviations at which one number would bring as much."""
    return math.sqrt(2.0 * max(evidence, 0.0))


def covariance_of(cause: Mapping[str, Any], vehicle: Vehicle) -> np.ndarray:
    """Covariance of a cause's parameters (k, k): its own std, correlated as in a vehicle's file."""
    names = list(cause["parameters"])
    std = np.array([p["std"] for p in cause["parameters"].values()])
    correlation = np.eye(len(names))
    if vehicle.correlation is not None and set(names) <= set(vehicle.correlated):
        places = [vehicle.correlated.index(n) for n in names]
        correlation = vehicle.correlation[np.ix_(places, places)]
    return std[:, None] * correlation * std


def described(cause: Mapping[str, Any], bare: Vehicle, corrected: Vehicle) -> str:
    """What a cause of findings.json means in flight: words with numbers; empty for an unknown one.

    Of several numbers those whose interval leaves out zero; the first where none does.

    Args:
        cause: an entry of findings.json's ``causes``.
        bare: the vehicle as given.
        corrected: the vehicle with the causes in it.
    """
    effect = cause["effect"]
    if effect not in effects.CATALOGUE:
        return ""
    values = {name.rpartition(".")[2]: p["value"] for name, p in cause["parameters"].items()}
    found = consequences(effect, values, covariance_of(cause, corrected), bare)
    significant = [c for c in found if c.significant] or found[:1]
    return ", ".join(c.text for c in significant)
