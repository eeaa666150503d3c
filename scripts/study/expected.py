"""What the effects hidden in a flight should be worth on it: from its truth, and from no residual.

Filter passes at the truth, and with one thing changed, say how far apart the two predictions are: half
the sum of squares of that is what the likelihood between them is expected to be (Kullback and Leibler
1951, Ann. Math. Stat. 22, to second order). The passes are whole, since an effect may change what the
filter expects of gusts. What else would be fitted in the effect's place takes up a part of it: the
vehicle's own numbers, under their priors, the other hidden effects, and the levels of the noise.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from injector_air import Air, disturbances
from injector_craft import Craft
from injector_sensors import kit

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.shocks import in_shocks, with_shocks
from coax_env.diagnosis.slow_commands import likeliest_at
from coax_env.estimation.between_rows import SLOWER
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import fitted_levels, starting_noise, still_air
from coax_env.estimation.run_passes import GATE, RunPass
from coax_env.estimation.state_space import Noise
from coax_env.logs.flight import Flight
from coax_env.model.effects import CATALOGUE
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from study.plan import PlannedFlight, air_of, craft_of

GROUPS = {"force_xy": [0, 1], "force_z": [2], "moment_xy": [3, 4], "moment_z": [5]}
"""Axes of the generator's gusts."""

SIZE_IN_CATALOGUE = {
    # Cheeseman-Bennett between z/R 1.2 and 2.4 is 0.22 exp(-1.3 z/R)
    "ground_effect.gain": 0.22,
    "rate_damping.coefficient": 0.9,  # (0.8 + 0.4 |rate|) at 0.25 rad/s
    "yaw_damping.coefficient": 0.89,  # (0.85 + 0.15 |rate|) at 0.25 rad/s
}
"""Size of the catalogue's form per size of the generator's, where the two differ."""
SHAPES = {"ground_effect.decay": 1.3}

PRIOR_SHARE = 0.1
"""Of a number's prior std: the step of its differences."""
EMPTY: Mapping[str, float] = MappingProxyType({})
LEVEL_STEP = 0.1
"""Step of the logarithm of a level of the noise."""


def catalogue_values(values: Mapping[str, float]) -> dict[str, float]:
    """The generator's sizes as the catalogue would have them; effects it does not list left out."""
    result = {}
    for name, value in values.items():
        if name.partition(".")[0] in CATALOGUE:
            result[name] = value * SIZE_IN_CATALOGUE.get(name, 1.0)
    groups = {name.partition(".")[0] for name in result}
    return result | {n: v for n, v in SHAPES.items() if n.partition(".")[0] in groups}


def expected_evidence(
    planned: PlannedFlight, flight: Flight, truth: Mapping[str, Any], held: Collection[str]
) -> dict[str, float | None]:
    """Nats each hidden effect should be worth on the runs that are fitted; None: not in the catalogue.

    Args:
        planned: how it was flown. flight: its log. truth: of the generator, `hidden` and `values`.
        held: names of the runs that are not fitted.
    """
    names, values = as_listed(truth)
    listed = list(names.values())
    result: dict[str, float | None] = dict.fromkeys(truth["hidden"])
    if not listed:
        return result
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    model = HeliModel(vehicle)
    records = [record_of(run) for run in flight.runs if run.name not in held]
    problem = Problem.of(model, records, listed)
    off = {n: v for effect in listed for n, v in problem.off_values(effect).items()}
    noise = true_noise(planned, flight, vehicle, values)
    fit = Fit(tuple(listed), {**model.bare_values, **off, **values}, noise)
    if problem.row > SLOWER:  # what was commanded between slow rows nobody knows
        problem = likeliest_at(problem, fit)
    if in_shocks(problem, fit):  # the level beside the strengths is another
        problem, shaken = with_shocks(problem, replace(fit, levels=fitted_levels(noise)))
        noise = shaken.noise
    about = _Truth(problem, fit.values, noise, listed)
    return result | {effect: about.worth(name) for effect, name in names.items()}


def as_listed(truth: Mapping[str, Any]) -> tuple[dict[str, str], dict[str, float]]:
    """Hidden effects that the catalogue has, and the names by which they go there; their values there.

    Args:
        truth: of the generator, `hidden` and `values`.
    """
    names = {e: CATALOGUE[e].named_as or e for e in truth["hidden"] if e in CATALOGUE}
    return names, _by_names(catalogue_values(truth["values"]))


def _by_names(values: Mapping[str, float]) -> dict[str, float]:
    """Values of effects that go by the name of another, as that one's.

    A deadband's plate jumps with the last digit of a command, so that two predictions with it are far
    apart wherever either is: what it is worth by them (8,500 nats) no likelihood shows.
    """
    result = {}
    for name, value in values.items():
        effect, _, parameter = name.partition(".")
        result[f"{CATALOGUE[effect].named_as or effect}.{parameter}"] = value
    return result


def true_noise(
    planned: PlannedFlight, flight: Flight, vehicle: Vehicle, values: Mapping[str, float]
) -> Noise:
    """The generator's noise as the model has it.

    Args:
        planned: how it was flown. flight: its log. vehicle: its file's.
        values: of the hidden effects: gusts shake what is heavier than the file says less.
    """
    own = kit(planned.sensors, planned.seed).noise
    noise = still_air(starting_noise(replace(flight, noise=dict(own)), vehicle))
    if not planned.gusts:
        return noise
    levels = dict(gust_levels(air_of(planned), craft_of(planned)))
    heavier = 1.0 + values.get("added_mass.mass", 0.0) / vehicle["mass"].value
    levels["force_xy"] /= heavier
    levels["force_z"] /= heavier
    levels["moment_z"] /= 1.0 + values.get("yaw_inertia.scale", 0.0)
    return noise.with_levels(levels)


@cache
def gust_levels(air: Air, craft: Craft) -> dict[str, float]:
    """Std [N, N m] of an air's gusts on a craft, and correlation times [s], by two minutes of it."""
    step = 0.002
    history = disturbances(air, craft, 12_000, 5, step, np.random.default_rng(0))
    history[:, 0:3] += history[:, 10:13]
    levels = {group: float(history[:, axes].std()) for group, axes in GROUPS.items()}
    memories = {
        f"memory_{group}": float(np.mean([_correlation_time(history[:, i], step) for i in axes]))
        for group, axes in GROUPS.items()
    }
    return levels | memories


def _correlation_time(x: np.ndarray, step: float) -> float:
    """s after which a history is alike to 1/e."""
    x = x - x.mean()
    spectrum = np.abs(np.fft.rfft(x, 2 * len(x))) ** 2
    alike = np.fft.irfft(spectrum)[: len(x)]
    return step * max(int(np.argmax(alike < alike[0] / math.e)), 1)


@dataclass(frozen=True)
class _Prediction:
    """What a filter expects of every reading: innovations and std, (readings,) each."""

    innovations: np.ndarray
    std: np.ndarray

    @staticmethod
    def of(passes: Sequence[RunPass]) -> "_Prediction":
        whitened = [run.innovations[~np.isnan(run.record.z)] for run in passes]
        std = 1.0 / np.concatenate([run.per_sigma for run in passes])
        return _Prediction(np.concatenate(whitened) * std, std)

    def beside(self, other: "_Prediction") -> np.ndarray:
        """How far the other is away, (2 readings,): half its sum of squares is in nats."""
        mean = (self.innovations - other.innovations) / np.sqrt(self.std * other.std)
        away = np.concatenate([mean, math.sqrt(2.0) * np.log(self.std / other.std)])
        return np.nan_to_num(away, nan=0.0, posinf=0.0, neginf=0.0)  # of a run that diverges: none


@dataclass(frozen=True)
class _Truth:
    """A flight's truth, to be asked what is expected near it.

    problem: of the fitted runs. values, noise: the true ones. listed: hidden effects of the catalogue.
    """

    problem: Problem
    values: Mapping[str, float]
    noise: Noise
    listed: Sequence[str]

    def worth(self, effect: str) -> float:
        """Nats of an effect, less the Occam factor.

        Where a prediction without it is beyond the filter's gate, at most what its slopes say: the way
        there is not straight, and what is free beside it would not let it come so far. An unbalanced
        torque, which the torque coefficients take up, was expected to be worth 5,500 to 5e60 nats.
        """
        off = self.problem.off_values(effect)
        away = self._as_it_is.beside(self._changed(values=off))
        worth = self._nats(effect, away)
        if np.abs(away).max(initial=0.0) < GATE:
            return worth
        moved = [(off[name] - self.values[name]) * self._slopes[name] for name in off]
        return min(worth, self._nats(effect, np.sum(moved, axis=0)))

    def _nats(self, effect: str, away: np.ndarray) -> float:
        """The same by how far predictions without it are away, (2 readings,)."""
        problem = self.problem
        own = problem.acting_names(effect)
        mine = np.array([self._slopes[name] for name in own])
        rest = problem.free([e for e in self.listed if e != effect])
        levels, known = self._of_levels
        R = np.array([*(self._slopes[f.name] for f in rest), *levels])
        precision = np.diag([*(f.std**-2 for f in rest), *known])
        asked = np.vstack([away, mine])
        left = asked - (asked @ R.T) @ np.linalg.solve(R @ R.T + precision, R)
        prior = np.array([f.std for f in problem.own[effect] if f.name in own])
        posterior = np.outer(prior, prior) * (mine @ left[1:].T) + np.eye(len(own))
        return float(0.5 * away @ left[0] - 0.5 * np.linalg.slogdet(posterior)[1])

    def _changed(
        self, values: Mapping[str, float] = EMPTY, levels: Mapping[str, float] = EMPTY
    ) -> _Prediction:
        """Of the truth with some values and levels of the noise changed."""
        passes = self.problem.engine.filter(
            {**self.values, **values}, self.noise.with_levels(levels), keep=True
        )
        return _Prediction.of(passes)

    @cached_property
    def _as_it_is(self) -> _Prediction:
        return self._changed()

    @cached_property
    def _slopes(self) -> dict[str, np.ndarray]:
        """Of the predictions in every parameter, (2 readings,) each."""
        result = {}
        for f in self.problem.parameters:
            step = PRIOR_SHARE * f.std
            if self.values[f.name] + step > f.upper:
                step = -step
            there = self._changed(values={f.name: self.values[f.name] + step})
            result[f.name] = self._as_it_is.beside(there) / step
        return result

    @cached_property
    def _of_levels(self) -> tuple[list[np.ndarray], list[float]]:
        """Slopes in the logarithm of every level that is fitted, and what is known of it beforehand."""
        slopes, known = [], []
        for name in fitted_levels(self.noise):
            there = self._changed(levels={name: self.noise.level(name) * math.exp(LEVEL_STEP)})
            slopes.append(self._as_it_is.beside(there) / LEVEL_STEP)
            known.append(self.noise.prior.get(name, (1.0, math.inf))[1] ** -2)
        return slopes, known
