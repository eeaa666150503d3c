"""H-infinity control of the hover, which holds for lags at the inputs that the model lacks.

Slycot's SB10AD (Glover and Doyle 1988; python-control's `hinfsyn` calls it too) makes the controller
that keeps the largest gain of two channels below gamma, all frequencies and directions taken together:

- from what comes in at the actuators to what is asked of them, weighed by tau s / (tau s + 1): with a
  gain below 1 the loop stands every lag up to tau, at each input by itself (small gain);
- from gusts and sensor noise, in units of the filter's stds, to LQG's cost, times PERFORMANCE.

It is made for the single-rate equivalent of the sensors, in the bilinear image of the discrete plant,
which keeps gains and states. Its states are an estimate of the plant's: a slow reading is used when it
is new, as in the filter, and clipped actions are taken for what they are. It hovers; the setpoint of a
target comes in as an error of the readings.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.env.actions import Nominal
from coax_env.env.period import DT
from coax_env.errors import InputError, require
from coax_env.kernel.angles import wrap_angles
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from controllers.estimator import WINDUP
from controllers.estimator_design import (
    EstimatorDesign,
    NoiseLevels,
    design_estimator,
    horizontal_pairs,
    integrated_readings,
    noise_levels,
)
from controllers.feedback import Designed, Feedback
from controllers.lqr import quadratic_cost, regulator_problem
from controllers.target import TargetView, turned

LAGS = (0.08, 0.08, 0.03, 0.03)
"""[s] of the rotors and the swash plate, that the loop is to stand: the catalogue's usual sizes."""
PERFORMANCE = 0.1
"""Weight of noise-to-cost: more of it (0.3) takes gamma far above 1, less (0.03) gains nothing."""
RELAXED = (1.25, 1.5, 2.0, 3.0)
"""Above the least gamma: next to it the equations are nearly singular, and the noise is felt more."""
_STARTS = (3.0, 4.0, 8.0, 16.0, 30.0, 100.0)
"""Gammas from which the least is looked for by bisection: from some SB10AD finds none."""
_TOLERANCE = 0.02  # of it
_EXACT = 1e-3  # std of an integral that is known, of what counts 1 of it
_DRIFT = 1e-4  # and what a period adds to it

Matrices = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""A, B, C, D."""
_ARRAYS = ("A", "B", "C", "D", "expected", "windup", "ratio")


@dataclass
class HInfinity(Feedback, Designed):
    """x+ = A x + B v + windup (clipped - asked), action = feedforward + C x + D v; SI.

    v (m + i,): readings and integrals, deviations from trim. x (k,) begins with the estimator's states.
    """

    vehicle: str
    estimator: EstimatorDesign  # of the same suite: names, trims, and the first reading's gain
    A: np.ndarray  # (k, k)
    B: np.ndarray  # (k, m + i)
    C: np.ndarray  # (4, k)
    D: np.ndarray  # (4, m + i)
    expected: np.ndarray  # (m + i, k): v as x has it
    windup: np.ndarray  # (k, 4)
    ratio: np.ndarray  # (m + i,), by which a new reading's innovation counts more
    gamma: float
    least_gamma: float

    kind = "hinf"

    def __post_init__(self) -> None:
        design = self.estimator
        self.sensors = design.sensors
        self.action_trim, self.action_scale = design.action_trim, design.action_scale
        integrated = integrated_readings(design)
        self._integrated = [design.readings.index(name) for name in integrated]
        self._most = WINDUP * np.array(list(integrated.values()))
        self._feedforward = (design.command_trim - design.action_trim) / design.action_scale
        self._pairs = horizontal_pairs(design)
        self._view = TargetView(self.sensors)

    def begin(self) -> None:
        """New flights of `count` helicopters."""
        self.state = np.zeros((self.count, len(self.A)))
        self.integrals = np.zeros((self.count, len(self._integrated)))
        self._first = True

    def compute_actions(self, observations: np.ndarray) -> np.ndarray:
        """Actions (count, 4), clipped, to observations (count, n_obs)."""
        seen, there = self._view.as_hover(observations)
        deviations = self._deviations(seen)
        n, m = len(self.estimator.states), deviations.shape[1]
        if self._first:
            self.state[:, :n] = np.nan_to_num(deviations) @ self.estimator.first_gain.T
        expected = self.state @ self.expected.T
        innovation = np.hstack([deviations, self.integrals]) - expected
        innovation[:, :m] *= self._new(observations) & np.isfinite(deviations) & (not self._first)
        v = expected + self.ratio * np.nan_to_num(innovation)
        asked = self._feedforward + self.state @ self.C.T + v @ self.D.T
        action = np.clip(asked, -1.0, 1.0)
        self.state = self.state @ self.A.T + v @ self.B.T + (action - asked) @ self.windup.T
        known = np.where(np.isfinite(deviations), deviations, expected[:, :m])
        self.integrals += DT * there[:, None] * known[:, self._integrated]
        np.clip(self.integrals, -self._most, self._most, out=self.integrals)
        self._first = False
        return action

    def _new(self, observations: np.ndarray) -> np.ndarray:
        """Which readings are new, (count, m)."""
        flags = self.estimator.flag_places
        return np.where(flags < 0, True, observations[:, np.maximum(flags, 0)] > 0.5)

    def _deviations(self, seen: np.ndarray) -> np.ndarray:
        """Readings (count, m) as deviations from trim, horizontal ones turned into the heading."""
        design = self.estimator
        y = seen[:, design.reading_places].astype(float)
        psi = design.readings.index("psi")
        for a, b in self._pairs:
            y[:, [a, b]] = turned(y[:, [a, b]], -y[:, psi])
        y -= design.reading_trim
        y[:, psi] = wrap_angles(y[:, psi])
        return y

    def as_system(self) -> Any:
        """From readings to minus the actions, integrals included: a discrete ``control.StateSpace``."""
        import control

        k, i, m = len(self.A), len(self._integrated), len(self.estimator.readings)
        integrate = np.zeros((i, m))
        integrate[range(i), self._integrated] = DT
        return control.ss(
            np.block([[self.A, self.B[:, m:]], [np.zeros((i, k)), np.eye(i)]]),
            np.vstack([self.B[:, :m], integrate]),
            -np.hstack([self.C, self.D[:, m:]]),
            -self.D[:, :m],
            DT,
        )

    def content(self) -> dict[str, Any]:
        """What a file of this kind has of its own."""
        return {
            "control_period_s": DT,
            "estimator": self.estimator.to_dict(),
            "gamma": self.gamma,
            "least_gamma": self.least_gamma,
            **{name: getattr(self, name).tolist() for name in _ARRAYS},
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "HInfinity":
        """From a JSON file."""
        arrays = {name: np.array(content[name], dtype=float) for name in _ARRAYS}
        return cls(
            vehicle=str(content["vehicle"]), gamma=float(content["gamma"]),
            least_gamma=float(content["least_gamma"]),
            estimator=EstimatorDesign.from_dict(content["estimator"]), **arrays,
        )  # fmt: skip


def design(
    vehicle: str | Vehicle,
    nominal: Nominal = None,
    sensors: str = "onboard",
    limits: Mapping[str, float] | None = None,
    weights: Mapping[str, float] | None = None,
) -> HInfinity:
    """Design an H-infinity hover controller on a vehicle; arguments as of `lqr.design`.

    Raises:
        MissingPackage: without slycot.
        InputError: no controller was found.
    """
    vehicle = load_vehicle(vehicle)
    estimator = design_estimator(vehicle, nominal, sensors)
    if "psi" not in estimator.readings:
        raise InputError(f"H-infinity needs sensors that show the heading, not {sensors!r}")
    cost = quadratic_cost(limits, weights)
    plant = weighted_plant(vehicle, estimator, cost)
    (A, B, C, D), gamma, least = _controller(plant)
    x, v = plant.state_scale, plant.measured_scale
    ratio = noise_levels(vehicle, estimator).ratio
    return HInfinity(
        vehicle.name, estimator,
        A * x[:, None] / x, B * x[:, None] / v, C / x, D / v,
        expected=plant.matrices[2][-len(v) :] * v[:, None] / x,
        windup=plant.matrices[1][:, -4:] * x[:, None],
        ratio=np.append(ratio, np.ones(len(v) - len(ratio))),
        gamma=gamma, least_gamma=least,
    )  # fmt: skip


@dataclass(frozen=True)
class WeightedPlant:
    """From disturbances, then actions (4,), to what is to be small, then what is measured; discrete."""

    matrices: Matrices
    state_scale: np.ndarray  # (k,): the states are in these units
    measured_scale: np.ndarray  # (m + i,)


def weighted_plant(
    vehicle: Vehicle, estimator: EstimatorDesign, cost: Mapping[str, Mapping[str, float]]
) -> WeightedPlant:
    """The plant with the weights of both channels, see the module.

    States: the estimator's, integrals of readings, the action in force (4,), low-passes of LAGS (4,).

    Args:
        vehicle: the filter was designed on.
        estimator: the filter, whose noise and single-rate sensors are taken.
        cost: limits and weights, of `lqr.quadratic_cost`.
    """
    noise = noise_levels(vehicle, estimator)
    A_held, B_held, Q, R = regulator_problem(estimator, cost["limits"], cost["weights"])
    integrals = np.array(list(integrated_readings(estimator).values()))
    n, m, i = len(estimator.states), len(estimator.readings), len(integrals)
    lowpass = np.exp(-DT / np.array(LAGS))
    held, k = n + i, n + i + 8
    x = np.concatenate(
        [np.maximum(noise.first, 1e-6), integrals, estimator.action_scale, np.ones(4)]
    )
    v = np.concatenate([noise.reading, integrals])
    A = np.zeros((k, k))
    A[:held, :held], A[-4:, -4:] = A_held, np.diag(lowpass)
    B_in = np.vstack([B_held, np.diag(estimator.action_scale), np.zeros((4, 4))])
    B_asked = B_in + np.vstack([np.zeros((k - 4, 4)), np.diag(1.0 - lowpass)])
    C_cost = np.zeros((held + 8, k))
    C_cost[:held, :held] = np.linalg.cholesky(Q + 1e-12 * np.eye(held)).T
    C_cost[-4:, -4:] = -np.eye(4)
    D_cost = np.vstack([np.zeros((held, 4)), np.sqrt(R), np.eye(4)])
    C_seen = np.zeros((m + i, k))
    C_seen[:m, :n], C_seen[:m, held : held + 4] = estimator.C, estimator.D
    C_seen[m:, n:held] = np.eye(i)
    B_noise, D_noise = _disturbances(estimator, noise, integrals)
    B = np.hstack([PERFORMANCE * B_noise, B_in, B_asked]) / x[:, None]
    C = np.vstack([C_cost, C_seen / v[:, None]]) * x
    D = np.zeros((len(C), B.shape[1]))
    D[: len(D_cost), -4:] = D_cost
    D[len(D_cost) :, : D_noise.shape[1]] = PERFORMANCE * D_noise / v[:, None]
    return WeightedPlant((A * x / x[:, None], B, C, D), x, v)


def _disturbances(
    estimator: EstimatorDesign, noise: NoiseLevels, integrals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What unit noise does to the states (k, n + m + 2 i) and to what is measured (m + i, same).

    An integral is one of the noisy reading, and known as such: it tells nothing more than that.
    """
    n, m, i = len(estimator.states), len(estimator.readings), len(integrals)
    B, D = np.zeros((n + i + 8, n + m + 2 * i)), np.zeros((m + i, n + m + 2 * i))
    B[:n, :n] = np.diag(noise.process)
    D[:m, n : n + m] = np.diag(noise.reading)
    for k, name in enumerate(integrated_readings(estimator)):
        at = estimator.readings.index(name)
        B[n + k, n + at] = DT * noise.reading[at]
    B[n : n + i, n + m : n + m + i] = np.diag(_DRIFT * integrals)
    D[m:, n + m + i :] = np.diag(_EXACT * integrals)
    return B, D


def _controller(plant: WeightedPlant) -> tuple[Matrices, float, float]:
    """The central controller of a gamma a little above the least, discrete; both gammas."""
    slycot = require("slycot", "robust")
    A, B, C, D = continuous(plant.matrices)
    sizes = len(A), B.shape[1], len(C), 4, len(plant.measured_scale)

    def synthesised(gamma: float, job: int) -> tuple[Any, ...] | None:
        try:
            return tuple(slycot.sb10ad(*sizes, gamma, A, B, C, D, job=job, gtol=_TOLERANCE))
        except slycot.exceptions.SlycotError:
            return None

    best = next((found for start in _STARTS if (found := synthesised(start, job=1))), None)
    if best is None:
        raise InputError(f"no H-infinity controller with gamma below {_STARTS[-1]:g} was found")
    for factor in RELAXED:
        found = synthesised(factor * best[0], job=4)
        if found is not None:
            return discrete(found[1:5]), float(found[0]), float(best[0])
    return discrete(best[1:5]), float(best[0]), float(best[0])


def continuous(matrices: Matrices) -> Matrices:
    """The bilinear image of a discrete system: the same gains, states in the same coordinates."""
    A, B, C, D = matrices
    M = np.linalg.inv(A + np.eye(len(A)))
    root = 2.0 / math.sqrt(DT)
    return 2.0 / DT * M @ (A - np.eye(len(A))), root * M @ B, root * C @ M, D - C @ M @ B


def discrete(matrices: Matrices) -> Matrices:
    """What `continuous` undoes."""
    A, B, C, D = matrices
    M = np.linalg.inv(np.eye(len(A)) - 0.5 * DT * A)
    root = math.sqrt(DT)
    return M @ (np.eye(len(A)) + 0.5 * DT * A), root * M @ B, root * C @ M, D + 0.5 * DT * C @ M @ B
