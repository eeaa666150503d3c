"""What a flight can teach: effects that would show, confounded ones, own numbers it determines.

From one linearisation along the records with the vehicle as given; no effect is fitted.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from coax_env.diagnosis.fits import start
from coax_env.diagnosis.preparation import namable
from coax_env.diagnosis.problem import Problem
from coax_env.estimation import vibration
from coax_env.estimation.battery import stated
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.quadratic import Quadratic
from coax_env.identification.undetermined import left_open
from coax_env.logs.flight import Flight
from coax_env.model import effects
from coax_env.model.vehicle import Vehicle

SHOWN_FROM = 2.0
"""Times EVIDENCE that an effect of usual size must be worth to be expected to show; ours."""
ROUNDING_INFORMATION = 1e-6
"""Information below this, in units of usual sizes, is rounding."""


@dataclass(frozen=True)
class EffectCheck:
    """What these flights would determine of an effect, were it there at its usual size.

    nats: expected evidence. std, usual: by parameter, expected std where it is the only effect, and
    the usual size. verdict: "shows", "may show" or "hidden". run: that shows it best. alike: effects
    that would do in its place.
    """

    effect: str
    nats: float
    std: Mapping[str, float]
    usual: Mapping[str, float]
    unit: Mapping[str, str]
    verdict: str
    run: str
    alike: tuple[str, ...]


@dataclass(frozen=True)
class OwnNumber:
    """A base parameter: std in the vehicle file, and expected after a fit to these flights."""

    name: str
    unit: str
    std_before: float
    std_after: float


@dataclass(frozen=True)
class Learnable:
    """Result of `learnable`.

    Attributes:
        effects: of the catalogue, best shown first.
        own_numbers: base parameters, before and after a fit.
        undetermined: base parameters that these flights leave open, `directions` along what.
        not_believed: share of readings that the filter left out.
    """

    effects: tuple[EffectCheck, ...]
    own_numbers: tuple[OwnNumber, ...]
    undetermined: tuple[str, ...]
    directions: tuple[str, ...]
    not_believed: float


def learnable(flight: Flight, vehicle: Vehicle) -> Learnable:
    """What these flights would determine of effects and own numbers."""
    _, calm, calm_vehicle = vibration.calmed(flight, vehicle)
    model = HeliModel(calm_vehicle, stated(flight, calm_vehicle))
    records = [record_of(run) for run in calm.runs]
    problem = Problem.of(model, records, namable((), vehicle, flight))
    fit = start(problem, starting_noise(calm, model.vehicle))
    everything = problem.parameters
    passes, lin = problem.engine.linearise(fit.values, fit.noise, everything)
    quadratic = Quadratic.of(lin, everything, fit.values)
    readings = sum(int(np.isfinite(r.z).sum()) for r in records)
    not_believed = sum(run.deweighted for run in passes) / max(readings, 1)
    if not all(math.isfinite(run.log_likelihood) for run in passes):
        not_believed = 1.0
    base = problem.free(())
    covariance = quadratic.covariance([f.name for f in base])
    own_numbers = tuple(
        OwnNumber(f.name, vehicle[f.name].unit, f.std, float(s))
        for f, s in zip(base, np.sqrt(np.diag(covariance)), strict=True)
    )
    by_run = dict(
        zip((r.name for r in records), np.einsum("rkk->rk", lin.information), strict=True)
    )
    checks = _effect_checks(problem, quadratic, by_run)
    return Learnable(checks, own_numbers, *left_open(base, covariance), not_believed)


def _effect_checks(
    problem: Problem, quadratic: Quadratic, by_run: Mapping[str, np.ndarray]
) -> tuple[EffectCheck, ...]:
    """One per candidate; by_run: run -> information of each parameter (k,)."""
    evidence = problem.settings.evidence
    expected = {e: _nats(problem, quadratic, e) for e in problem.candidates}
    confounded = _confounded(problem, quadratic, [e for e in expected if expected[e] >= evidence])
    found = []
    for effect, nats in expected.items():
        own = problem.acting_names(effect)
        known = dict(
            zip(effects.CATALOGUE[effect].names(), problem.model.sized(effect), strict=True)
        )
        squares = [known[n].usual ** 2 for n in own]
        places = quadratic.index(own)
        found.append(
            EffectCheck(
                effect,
                nats,
                dict(zip(own, _stds(problem, quadratic, effect), strict=True)),
                {n: known[n].usual for n in own},
                {n: known[n].unit for n in own},
                _verdict(nats, evidence),
                max(by_run, key=lambda run: float(by_run[run][places] @ squares)),
                tuple(sorted(confounded.get(effect, ()))),
            )
        )
    return tuple(sorted(found, key=lambda e: -e.nats))


def _verdict(nats: float, evidence: float) -> str:
    if nats >= SHOWN_FROM * evidence:
        return "shows"
    return "may show" if nats >= evidence else "hidden"


def _usual(problem: Problem, effect: str) -> np.ndarray:
    names = problem.acting_names(effect)
    return np.array([f.std for f in problem.own[effect] if f.name in names])


def _nats(problem: Problem, quadratic: Quadratic, effect: str) -> float:
    """Evidence expected of an effect, every parameter at its usual size, Occam factor deducted."""
    own, rest = problem.acting_names(effect), problem.base_names([effect])
    information, _ = quadratic.projected(own, rest)
    worth = 0.5 * float(_usual(problem, effect) ** 2 @ np.diag(information))
    return worth - quadratic.occam(own, rest)


def _stds(problem: Problem, quadratic: Quadratic, effect: str) -> list[float]:
    """Std expected of an effect's parameters, no prior on them; infinite where none is determined."""
    own = problem.acting_names(effect)
    usual = _usual(problem, effect)
    information, _ = quadratic.projected(own, problem.base_names([effect]))
    shares, vectors = np.linalg.eigh(information * np.outer(usual, usual))
    known = shares > ROUNDING_INFORMATION
    variance = vectors[:, known] ** 2 @ (1.0 / shares[known])
    variance[(np.abs(vectors[:, ~known]) > ROUNDING_INFORMATION).any(axis=1)] = np.inf
    return (usual * np.sqrt(variance)).tolist()


def _confounded(
    problem: Problem, quadratic: Quadratic, shown: Sequence[str]
) -> dict[str, set[str]]:
    """Effects of usual size that another one's fit would leave less than a tie of."""
    usual = {e: _usual(problem, e) for e in shown}

    def left(truth: str, other: str) -> float:
        rest = problem.base_names([truth, other]) + problem.acting_names(other)
        information, _ = quadratic.projected(problem.acting_names(truth), rest)
        return 0.5 * float(usual[truth] ** 2 @ np.diag(information))

    found: dict[str, set[str]] = {e: set() for e in shown}
    for a, b in combinations(shown, 2):
        if min(left(a, b), left(b, a)) < problem.settings.tie:
            found[a].add(b)
            found[b].add(a)
    return found
