"""A pilot for simulated flights: linear feedback about the vehicle's own hover, with a tremor.

He sees true states (his eyes are better than the log), holds height, velocity and heading, and is
slow on purpose: what is injected must still show in the flight. Not a controller design: that is
controllers/lqr.py, which sees sensors only.
"""

import math

import numpy as np

from coax_env.dynamics import derivative, hover_trim
from coax_env.layout import N_COMMANDS, N_STATES, PLACE
from coax_env.linear import slopes
from coax_env.vehicle import Vehicle

TREMOR_MEMORY = 0.2  # [s]
TREMOR = np.array([0.6, 0.6, 0.0035, 0.0035])
"""Std of the pilot's hands on the commands [rad/s, rad/s, rad, rad]."""

_HELD = [i for i in range(N_STATES) if i not in (13, 14)]  # all but the horizontal position
_TOLERATED = np.array(
    [0.6, 0.6, 0.5, 1.2, 1.2, 0.9, 1.0, 1.0, 1.0, 1.0, 0.2, 0.2, 0.5, np.inf, np.inf, 0.25]
)
"""Deviation of each state that costs as much as one unit of effort."""
_EFFORT = np.array([0.04, 0.04, 0.08, 0.08])  # rotor speeds as a fraction of trim; rad

CORNER = 1.0  # [s] over which the pilot rounds the corners of what he is asked for


def rounded(asked: np.ndarray, rows: int) -> np.ndarray:
    """What is asked for (n, k) with corners rounded over some rows: a centred running mean."""
    half = rows // 2
    padded = np.pad(asked, ((half, half), (0, 0)), mode="edge")
    window = np.ones(2 * half + 1) / (2 * half + 1)
    return np.column_stack([np.convolve(column, window, mode="valid") for column in padded.T])


class Pilot:
    """Feedback gains for one vehicle, and the state of his hands."""

    def __init__(self, vehicle: Vehicle, height: float, tremor: float = 0.0) -> None:
        """``tremor`` is the size of the tremor; 1 is usual, 0 none."""
        self.trim_state, self.trim = hover_trim(vehicle, height)
        self.gain = _gain(vehicle, self.trim_state, self.trim)
        self.tremor = tremor
        self.hands = np.zeros(N_COMMANDS)

    def correction(
        self,
        state: np.ndarray,
        asked: np.ndarray,
        asked_rate: np.ndarray,
        dt: float,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Commands (4,) to add to the trim.

        Args:
            state: paper's states (16,) or more.
            asked: height, forward, right, heading, shape (4,).
            asked_rate: the same, per second.
        """
        error = state[:N_STATES] - self.trim_state
        error[0] -= asked[1]
        error[1] -= asked[2]
        error[2] += asked_rate[0]
        error[5] -= asked_rate[3]
        error[12] = math.remainder(state[12] - self.trim_state[12] - asked[3], 2.0 * math.pi)
        error[15] = state[15] + asked[0]
        error[PLACE] = 0.0
        error = np.clip(error, -_REACH, _REACH)
        correction = -self.gain @ error
        if self.tremor:
            keep = math.exp(-dt / TREMOR_MEMORY)
            kick = math.sqrt(1.0 - keep * keep) * self.tremor * TREMOR
            self.hands = keep * self.hands + kick * rng.standard_normal(N_COMMANDS)
        return correction + self.hands


_REACH = np.array([2, 2, 2, 9, 9, 9, 1, 1, 1, 1, 1, 1, 0.8, 0, 0, 0.8], float)
"""Largest error of each state the pilot reacts to: he does not throw the sticks."""


def _gain(vehicle: Vehicle, state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Linear-quadratic gain (4, 16) about a trim, from differences of the one kernel."""
    from scipy.linalg import solve_continuous_are

    jacobian = slopes(
        lambda point: derivative(point[:N_STATES], point[N_STATES:], vehicle),
        np.concatenate([state, command]), np.ones(N_STATES + N_COMMANDS),
    )  # fmt: skip
    A = jacobian[np.ix_(_HELD, _HELD)]
    B = jacobian[_HELD, N_STATES:]
    effort = _EFFORT * [command[0], command[1], 1.0, 1.0]
    Q = np.diag(_TOLERATED[_HELD] ** -2.0)
    R = np.diag(effort**-2.0)
    P = solve_continuous_are(A, B, Q, R)
    gain = np.zeros((N_COMMANDS, N_STATES))
    gain[:, _HELD] = np.linalg.solve(R, B.T @ P)
    return gain
