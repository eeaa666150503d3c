"""The hover task: stay at 1.5 m over the start, heading north. Start, end, reward and cost.

Reward and cost can be taken about another target: the other tasks (tasks.py) do.

Controllers are compared by a quadratic cost: squared errors in units of LIMITS, the success
conditions (tasks.py). The reward has a term 1/(1 + |error|/scale) per error, in (0, 1]: sharp
at the goal, and with a slope far from it, so that a policy can be learnt from nothing.
"""

import math
from collections.abc import Mapping

import numpy as np

from coax_env.kernel.angles import wrap_angle
from coax_env.kernel.compilation import compiled
from coax_env.kernel.random_streams import uniform
from coax_env.kernel.simd import negated, select
from coax_env.model import inputs as U
from coax_env.model import state as S
from coax_env.model.layout import N_COMMANDS, N_FULL, PLACE, RATE, VELOCITY

HEIGHT = 1.5  # [m] of the centre of gravity above ground; ours
CONTROL_PERIOD = 0.01  # [s], the paper's

_DEGREE = math.pi / 180.0

LIMITS = {
    "height": 0.10,  # [m]
    "position": 2.0,  # [m] horizontal distance from the start
    "speed": 0.25,  # [m/s]
    "heading": 10.0 * _DEGREE,
    "rates": 30.0 * _DEGREE,  # [rad/s], of the whole rate vector; ours
    "effort": 0.5,  # [1], of the whole action vector; ours
}
"""An error of this size counts 1. The first four are the success conditions."""

COST_WEIGHTS = {
    "height": 1.0, "position": 1.0, "speed": 1.0, "heading": 1.0, "rates": 0.1, "effort": 0.1,
}  # fmt: skip
"""Weights of the quadratic cost, the same for every controller."""

REWARD_SCALES = {
    "height": 0.25,  # [m]
    "position": 2.0,  # [m]
    "speed": 1.0,  # [m/s]
    "heading": 20.0 * _DEGREE,
    "rates": 60.0 * _DEGREE,  # [rad/s]
    "effort": 0.5,  # [1]
}
"""An error of this size halves its reward term."""

REWARD_WEIGHTS = {
    "alive": 0.1, "height": 0.2, "position": 0.1, "speed": 0.3, "heading": 0.15,
    "rates": 0.05, "effort": 0.1,
}  # fmt: skip
"""Weights of the reward terms; they sum to 1, so a step's reward lies in (0, 1]."""

REWARD_TERMS = tuple(REWARD_WEIGHTS)
N_TERMS = len(REWARD_TERMS)
CRASHED_COST = 1000.0
"""Cost of every step that an episode ended too early to fly: more than any hover has; ours."""

START = {
    "tilt": 5.0 * _DEGREE, "heading": 20.0 * _DEGREE, "rate": 10.0 * _DEGREE,
    "velocity": 0.3, "height": 0.3,
}  # fmt: skip
"""Half widths of the uniform start, per axis, about hover. SI."""

LOWEST = 0.05  # [m] centre of gravity: the skids touch
HIGHEST = 6.0  # [m] the sonar's range ends soon after
FARTHEST = 25.0  # [m] from the start; ours
FASTEST = 15.0  # [m/s]; ours
STEEPEST = 60.0 * _DEGREE  # of the rotor axis from the vertical; ours

NORTH, EAST, DOWN, HEADING = range(4)
"""Columns of a target [m, m, m, rad]: the state's x y z psi."""
HORIZONTAL = slice(0, 2)

(
    ALIVE, HEIGHT_ERROR, POSITION_ERROR, SPEED_ERROR, HEADING_ERROR, RATES_ERROR, EFFORT,
) = range(N_TERMS)  # fmt: skip
"""Places of the reward's terms, in REWARD_TERMS' order."""

_LIMITS = np.array(list(LIMITS.values()))
_COST_WEIGHTS = np.array(list(COST_WEIGHTS.values()))
_COS_STEEPEST = math.cos(STEEPEST)
_START_TILT, _START_HEADING = START["tilt"], START["heading"]
_START_RATE, _START_VELOCITY, _START_RISE = START["rate"], START["velocity"], START["height"]


@compiled()
def random_start(stream, command, x):
    """A random start into the full state `x` (29,): rotors and swash settled on `command` (4,).

    Args:
        stream: key and counter, (2,) uint64. command: [rad/s, rad/s, rad, rad], (4,).
        x: full state, (29,), is put here.
    """
    for i in range(N_FULL):
        x[i] = 0.0
    for i in range(3):
        x[S.U + i] = uniform(stream, -_START_VELOCITY, _START_VELOCITY)
        x[S.P + i] = uniform(stream, -_START_RATE, _START_RATE)
    x[S.PHI] = uniform(stream, -_START_TILT, _START_TILT)
    x[S.THETA] = uniform(stream, -_START_TILT, _START_TILT)
    x[S.PSI] = uniform(stream, -_START_HEADING, _START_HEADING)
    x[S.Z] = -HEIGHT - uniform(stream, -_START_RISE, _START_RISE)
    for i in range(N_COMMANDS):
        x[S.OMEGA_U + i] = command[i]


@compiled()
def reward(x, action, target, weights, scales, terms):
    """Sum of the weighted reward terms; they are all zero where the state is not finite.

    Args:
        x: full state, (29,). action: (4,). target: x y z psi, (4,).
        weights, scales: in REWARD_TERMS' order, (N_TERMS,) or more.
        terms: the weighted terms are put here, (N_TERMS,) or more.
    """
    north, east = x[S.X] - target[NORTH], x[S.Y] - target[EAST]
    heading = wrap_angle(x[S.PSI] - target[HEADING])
    down = x[S.Z] - target[DOWN]
    # errors squared
    terms[ALIVE] = 0.0
    terms[HEIGHT_ERROR] = down * down
    terms[POSITION_ERROR] = north * north + east * east
    terms[SPEED_ERROR] = x[S.U] * x[S.U] + x[S.V] * x[S.V] + x[S.W] * x[S.W]
    terms[HEADING_ERROR] = heading * heading
    terms[RATES_ERROR] = x[S.P] * x[S.P] + x[S.Q] * x[S.Q] + x[S.R] * x[S.R]
    terms[EFFORT] = (
        action[U.OMEGA_U] * action[U.OMEGA_U] + action[U.OMEGA_L] * action[U.OMEGA_L]
        + action[U.DELTA_LON] * action[U.DELTA_LON] + action[U.DELTA_LAT] * action[U.DELTA_LAT]
    )  # fmt: skip
    total = 0.0 * down
    for k in range(N_TERMS):
        terms[k] = weights[k] * scales[k] / (scales[k] + math.sqrt(terms[k]))
        total += terms[k]
    finite = math.isfinite(total)
    for k in range(N_TERMS):
        terms[k] = select(finite, terms[k], 0.0)
    return select(finite, total, 0.0)


@compiled()
def is_over(x):
    """Whether the flight has ended: ground, tilt, too fast, too far, too high, or not a number."""
    return is_over_at_tilt(x, math.cos(x[S.PHI]) * math.cos(x[S.THETA]))


@compiled()
def is_over_at_tilt(x, upright):
    """`is_over`, where the cosine of the tilt is known.

    Args:
        x: full state, (29,). upright: cosine of the rotor axis's angle to the vertical.
    """
    nought = 0.0 * x[S.U]
    for i in range(S.V, N_FULL):
        nought += 0.0 * x[i]  # NaN where a state is not finite
    inside = (
        (nought == 0.0)
        & (-x[S.Z] > LOWEST)
        & (-x[S.Z] < HIGHEST)
        & (upright > _COS_STEEPEST)
        & (x[S.X] * x[S.X] + x[S.Y] * x[S.Y] < FARTHEST * FARTHEST)
        & (x[S.U] * x[S.U] + x[S.V] * x[S.V] + x[S.W] * x[S.W] < FASTEST * FASTEST)
    )
    return negated(inside)  # a comparison with NaN is false


def in_world(states: np.ndarray) -> np.ndarray:
    """Velocities north, east and down [m/s], shape (..., 3), of states (..., >=16)."""
    # here, since the import takes as long as all of an env's
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("ZYX", states[..., [S.PSI, S.THETA, S.PHI]].reshape(-1, 3))
    velocities = np.array(states[..., VELOCITY].reshape(-1, 3))  # SciPy takes no read-only array
    return turn.apply(velocities).reshape(*states.shape[:-1], 3)


def squared_errors(
    states: np.ndarray, targets: np.ndarray | None = None, rates: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Squares of the errors that LIMITS names, but for the effort, of every state; SI.

    Args:
        states: full or paper states, shape (..., >=16).
        targets: x y z psi, shape (..., 4); None: hover's.
        rates: of the targets, shape (..., 4), where they move: the speed is then relative to theirs.

    Returns:
        height, position (horizontal), speed, heading, rates: each of shape (...).
    """
    goal = np.array([0.0, 0.0, -HEIGHT, 0.0]) if targets is None else targets
    speed = (states[..., VELOCITY] ** 2).sum(-1)
    if rates is not None:
        speed = ((in_world(states) - rates[..., :3]) ** 2).sum(-1)
    heading = (states[..., S.PSI] - goal[..., HEADING] + math.pi) % (2.0 * math.pi) - math.pi
    return {
        "height": (states[..., S.Z] - goal[..., DOWN]) ** 2,
        "position": ((states[..., PLACE] - goal[..., HORIZONTAL]) ** 2).sum(-1),
        "speed": speed,
        "heading": heading**2,
        "rates": (states[..., RATE] ** 2).sum(-1),
    }


def cost(
    states: np.ndarray,
    actions: np.ndarray,
    targets: np.ndarray | None = None,
    limits: Mapping[str, float] | None = None,
    rates: np.ndarray | None = None,
) -> np.ndarray:
    """Quadratic cost of every step: COST_WEIGHTS times the squared errors in units of LIMITS.

    Args:
        states: full or paper states, shape (..., >=16). actions: shape (..., 4).
        targets: x y z psi, shape (..., 4); None: hover's.
        limits: other errors that count 1, where not LIMITS.
        rates: of the targets, shape (..., 4), where they move.

    Returns:
        shape (...).
    """
    errors = squared_errors(states, targets, rates) | {"effort": (np.asarray(actions) ** 2).sum(-1)}
    squares = np.stack([errors[name] for name in LIMITS], axis=-1)
    scale = _LIMITS if limits is None else np.array(list((LIMITS | dict(limits)).values()))
    return squares @ (_COST_WEIGHTS / scale**2)
