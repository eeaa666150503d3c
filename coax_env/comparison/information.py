"""What one flight says of a machine's numbers, to second order: enough to go on without its log.

The log-likelihood about a point, air, battery and ground projected out under their priors. Flights are
independent, so that of many is the sum; a prior and a change are added to it as they are.
"""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.comparison.candidates import plain
from coax_env.comparison.circumstances import BATTERY_SPEED, GUESSED_DENSITY, battery_is_logged
from coax_env.comparison.search import Changed
from coax_env.comparison.two_flights import ROTOR_SPEED, OneFlight
from coax_env.estimation.parted_engine import Part
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter


@dataclass(frozen=True)
class Information:
    """Of one flight on k numbers.

    Attributes:
        names: of the numbers.
        at: where it was taken, (k,).
        slope: of minus the log-likelihood there, (k,).
        matrix: (k, k).
        mean, std: of the numbers' priors, (k,).
        inflation: of variances by coloured innovations.
    """

    names: tuple[str, ...]
    at: np.ndarray
    slope: np.ndarray
    matrix: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    inflation: float

    def on(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Precision (n, n) and precision times mean (n,) of some numbers, the others at `at`.

        What the flight has no number for it knows nothing of.
        """
        there = [n for n in names if n in self.names]
        i = np.array([self.names.index(n) for n in there], int)
        to = np.array([list(names).index(n) for n in there], int)
        precision, weighted = np.zeros((len(names), len(names))), np.zeros(len(names))
        own = self.matrix[np.ix_(i, i)] / self.inflation
        precision[np.ix_(to, to)] = own
        weighted[to] = own @ self.at[i] - self.slope[i] / self.inflation
        return precision, weighted

    def as_json(self) -> dict[str, Any]:
        """As logbook.json keeps it; arrays as base64 of little-endian doubles."""
        lower = self.matrix[np.tril_indices(len(self.names))]
        return {
            "names": list(self.names),
            "inflation": self.inflation,
            **{
                name: base64.b64encode(np.ascontiguousarray(values, "<f8").tobytes()).decode()
                for name, values in (
                    ("at", self.at), ("slope", self.slope), ("lower", lower),
                    ("mean", self.mean), ("std", self.std),
                )
            },
        }  # fmt: skip

    @classmethod
    def of_json(cls, kept: Mapping[str, Any]) -> "Information":
        """From what `as_json` made."""

        def array(name: str) -> np.ndarray:
            return np.frombuffer(base64.b64decode(kept[name]), "<f8")

        k = len(kept["names"])
        matrix = np.zeros((k, k))
        matrix[np.tril_indices(k)] = array("lower")
        matrix = matrix + np.tril(matrix, -1).T
        return cls(
            tuple(kept["names"]), array("at"), array("slope"), matrix, array("mean"), array("std"),
            float(kept["inflation"]),
        )  # fmt: skip


def information_of(state: Changed, part: Part, flight: OneFlight) -> Information:
    """What one of two compared flights says, about where the comparison ended.

    Args:
        state: of the comparison. part: the flight in it. flight: the same, as flown.
    """
    problem = state.problem
    numbers = [*problem.base, *(f for group in problem.own.values() for f in group)]
    names = [f.name for f in numbers]
    beside = _circumstances(state, part, flight, names)
    values = part.values(state.fit.values) | {
        f.name: part.values(state.fit.values).get(f.name, 0.0) for f in beside
    }
    everything = [*numbers, *beside]
    _, lin = part.engine.linearise(values, part.noise(state.fit.noise), everything)
    quadratic = Quadratic.of(lin, everything, values)
    rest = [f.name for f in beside]
    matrix, weights = quadratic.projected(names, rest)
    slope = quadratic.g[quadratic.index(names)] - weights.T @ quadratic.g[quadratic.index(rest)]
    told = [n for n, m, f in zip(names, np.diag(matrix), numbers, strict=True) if m * f.std**2 > 1]
    inflation = [quadratic.variance_inflation([n], [f.name for f in everything]) for n in told]
    return Information(
        tuple(names),
        np.array([values[n] for n in names]),
        slope,
        matrix,
        np.array([f.value for f in numbers]),
        np.array([f.std for f in numbers]),
        float(np.mean(inflation)) if inflation else 1.0,
    )


def _circumstances(
    state: Changed, part: Part, flight: OneFlight, but: Sequence[str]
) -> list[FreeParameter]:
    """Air, battery and pilot of one flight alone, absolute."""
    found = {
        plain(f.name): FreeParameter(plain(f.name), 0.0, f.std)
        for f in state.problem.added
        if f.name.endswith(f"@{part.name}") and plain(f.name) not in but
    }
    if not battery_is_logged([flight]):
        found[ROTOR_SPEED] = FreeParameter(ROTOR_SPEED, 0.0, BATTERY_SPEED)
    density = flight.vehicle["air_density"].value
    found["air_density"] = FreeParameter("air_density", density, GUESSED_DENSITY * density)
    return list(found.values())
