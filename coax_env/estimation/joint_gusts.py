"""Gusts that push and turn at once: one that meets the rotors above the centre of gravity also tilts.

A filter takes force and moment of the gusts for independent. Where they are not, it writes the one that
it sees worse to something else: by poses alone such gusts were a marker off the centre of gravity, or a
damping. Here each gust is its own state and shares of those before it, in the order of AXES_OF_GUSTS (a
lower triangle, which any covariance has as its root): a push turns the body by its arm, at once and as
long as it lasts. The shares are parameters, none of them another state.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coax_env.estimation.helicopter import HeliModel, Motion, _take_in_innovations
from coax_env.estimation.helicopter_noise import AXES, GUST_AXES, JOINT, PAIRS_OF_GUSTS
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.estimation.wrapping_model import WrappingModel
from coax_env.kernel.compilation import compiled
from coax_env.model import dynamics
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.layout import AXES_OF_GUSTS, N_CHANNELS, N_FULL
from coax_env.model.vehicle import Vehicle

PAIRS = PAIRS_OF_GUSTS
"""Of gusts, the first of which has a share in the second."""
LEVER = "joint_gusts.moment_xy_per_force_xy"
_OF_LEVER = {(0, 4): 1.0, (1, 3): -1.0}


def _share_name(first: int, second: int) -> str:
    words = f"{AXES_OF_GUSTS[second]} per {AXES_OF_GUSTS[first]}"
    return f"joint_gusts.{words.replace(' ', '_')}"


SHARES: dict[str, dict[tuple[int, int], float]] = {LEVER: _OF_LEVER} | {
    _share_name(*pair): {pair: 1.0} for pair in PAIRS if pair not in _OF_LEVER
}
"""Name of a share -> the pairs that have it, and its sign. A push to any side tilts by the same arm."""
_FIRST_MOMENT = 3

inner_step: Any = None  # the inner model's, put in by `WrappingModel` and `side_by_side`
inner_measure: Any = None
inner_drift: Any = None
INNER = N_FULL  # its number of states, put in by `WrappingModel`
WORK = dynamics.WORK_SIZE  # the size of its scratch; behind it the inner state, drift and readings
_COUNT = len(PAIRS)
_MEMORIES = P.GUST_MEMORIES.start + np.array([AXES.index(axes) for axes in GUST_AXES])


@compiled()
def _joined(x, states, p, out):
    """A state as the inner model takes it, into `out`: gusts with their shares of those before."""
    for i in range(states):
        out[i] = x[i]
    at = p.size - _COUNT
    for j in range(6):
        for i in range(j):
            out[S.GUST_X + j] += p[at] * x[S.GUST_X + i]
            at += 1


@compiled()
def _left(i, dt, p):
    """Share that is left of a gust's own state after `dt` seconds."""
    return math.exp(-dt / p[_MEMORIES[i]])


def _step(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The inner model's step in joint gusts; each gust's own state fades.

    Input innovations are of the states. What the inner model adds of them to the gusts is taken off
    what it is handed.
    """
    own, joint = work[WORK : WORK + INNER], work[WORK + INNER : WORK + 2 * INNER]
    for i in range(INNER):
        own[i] = x[i]
    _take_in_innovations(u, p, own)
    _joined(own, INNER, p, joint)
    for i in range(INNER):
        taken = own[i] - x[i]
        joint[i] -= taken
    inner_step(joint, u, dt, p[: p.size - _COUNT], work, out)
    for i in range(6):
        out[S.GUST_X + i] = own[S.GUST_X + i] * _left(i, dt, p)


def _measure(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    """The inner model's readings in joint gusts."""
    joint = work[WORK : WORK + INNER]
    _joined(x, INNER, p, joint)
    inner_measure(joint, u, p[: p.size - _COUNT], work, out)


def _drift_and_readings(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The inner model's in joint gusts; each gust's own state fades exactly."""
    own, joint = work[WORK : WORK + INNER], work[WORK + INNER : WORK + 2 * INNER]
    _joined(x, INNER, p, joint)
    inner_drift(joint, u, dt, p[: p.size - _COUNT], work, out)
    for i in range(INNER):
        own[i] = 0.0 * x[i]
    _take_in_innovations(u, p, own)
    for i in range(6):
        at = S.GUST_X + i
        out[at] = x[at] * (_left(i, dt, p) - 1.0) + own[at]


class JointModel(WrappingModel):
    """A model in gusts that push and turn at once, through the engine's protocol."""

    own = Motion(_step, _measure, _drift_and_readings)
    added_scale = np.zeros(0)
    tail = _COUNT
    word = "joint"

    def __init__(self, inner: HeliModel) -> None:
        super().__init__(inner)
        self.work_size = inner.work_size + 2 * self.states + N_CHANNELS

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """The inner model's parameter vector, and behind it the shares, by PAIRS."""
        inner = {name: value for name, value in values.items() if name not in SHARES}
        first, second = np.array(PAIRS).T
        return np.append(self.inner.vector(inner, noise), _shares(values)[second, first])

    def added_variances(self, noise: Noise) -> np.ndarray:
        """None."""
        return np.zeros(0)

    def added_noise(self, noise: Noise, tail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """None."""
        return np.zeros(0), np.zeros(0)


def is_joint(model: HeliModel) -> bool:
    """Whether a model is in joint gusts already."""
    if isinstance(model, WrappingModel):
        return isinstance(model, JointModel) or is_joint(model.inner)
    return False


def _shares(values: Mapping[str, float]) -> np.ndarray:
    """(6, 6) what each gust has of those before it, below the diagonal."""
    shares = np.zeros((6, 6))
    for name, pairs in SHARES.items():
        for (first, second), sign in pairs.items():
            shares[second, first] = sign * values.get(name, 0.0)
    return shares


def free_shares(names: Sequence[str], vehicle: Vehicle) -> list[FreeParameter]:
    """Shares as parameters that are free; none beforehand, give or take what is possible at all.

    Args:
        names: of SHARES. vehicle: a moment per force is an arm, of a rotor's radius or so.
    """
    arm = vehicle.values()["rotor_radius"]
    return [FreeParameter(name, 0.0, arm if is_arm(name) else 1.0) for name in names]


def is_arm(share: str) -> bool:
    """Whether a share is of a moment in a force, and so a length [m]."""
    first, second = next(iter(SHARES[share]))
    return first < _FIRST_MOMENT <= second


def felt_gusts(levels: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
    """Std of the six gusts as the body feels them, with their shares of those before (6,).

    Args:
        levels: (6,) std of each gust's own state. values: of the parameters, by name.
    """
    return np.sqrt((np.eye(6) + _shares(values)) ** 2 @ levels**2)


def score_slopes(in_noise: np.ndarray, driven: np.ndarray) -> dict[str, np.ndarray]:
    """Slope of the log-likelihood in each share's correlation at none, by blocks of time (blocks,).

    Args:
        in_noise: (blocks, e) in the intensity of each entry of the process noise.
        driven: (6,) intensity of what drives each gust.
    """
    joint = in_noise[:, JOINT]
    std = np.sqrt(driven)
    return {
        name: np.sum(
            [
                sign * std[i] * std[j] * joint[:, PAIRS.index((i, j))]
                for (i, j), sign in pairs.items()
            ],
            axis=0,
        )
        for name, pairs in SHARES.items()
    }
