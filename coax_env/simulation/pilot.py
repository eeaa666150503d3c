"""A pilot for simulated flights: linear feedback about the vehicle's own hover, with a tremor.

He sees true states (his eyes are better than the log), holds height, velocity and heading, and is
slow on purpose: what is injected must still show in the flight. Not a controller design: that is
controllers/lqr.py, which sees sensors only.
"""

import math

import numpy as np

from coax_env.kernel.angles import wrap_angle
from coax_env.model import state as S
from coax_env.model.dynamics import full_state, hover_trim
from coax_env.model.layout import N_COMMANDS, N_STATES, PLACE
from coax_env.model.linear import N_FLOWN, sampled
from coax_env.model.vehicle import Vehicle

TREMOR_MEMORY = 0.2  # [s]; ours
TREMOR = np.array([0.6, 0.6, 0.0035, 0.0035])
"""Std of the pilot's hands on the commands [rad/s, rad/s, rad, rad]; ours."""

_HELD = [i for i in range(N_FLOWN) if i not in (S.X, S.Y)]  # all but the horizontal position
_TOLERATED = np.array(
    [0.6, 0.6, 0.5, 1.2, 1.2, 0.9, 1.0, 1.0, 1.0, 1.0, 0.2, 0.2, 0.5, np.inf, np.inf, 0.25]
)
"""Deviation of each state that costs as much as one unit of effort [SI]; ours."""
_EFFORT = np.array([0.04, 0.04, 0.08, 0.08])
"""One unit of effort: rotor speeds as a fraction of trim, swash tilts in rad; ours."""

CORNER = 1.0  # [s] over which the pilot rounds the corners of what he is asked for


def rounded(reference: np.ndarray, rows: int) -> np.ndarray:
    """What is asked for (n, k) with corners rounded over some rows: a centred running mean."""
    half = rows // 2
    padded = np.pad(reference, ((half, half), (0, 0)), mode="edge")
    window = np.ones(2 * half + 1) / (2 * half + 1)
    return np.column_stack([np.convolve(column, window, mode="valid") for column in padded.T])


class Pilot:
    """Feedback gains for one vehicle, and the state of his hands."""

    def __init__(self, vehicle: Vehicle, height: float, dt: float, tremor: float = 0.0) -> None:
        """A pilot for one maneuver.

        Args:
            vehicle: what he flies. height: of its hover [m]. dt: seconds per row.
            tremor: size of the tremor; 1 is usual, 0 none.
        """
        state, self.trim = hover_trim(vehicle, height)
        self.trim_state = full_state(state, self.trim, vehicle)[:N_FLOWN]
        self.gain = _gain(vehicle, dt)
        self.tremor = tremor
        self.hands = np.zeros(N_COMMANDS)

    def correction(
        self,
        state: np.ndarray,
        reference: np.ndarray,
        reference_rate: np.ndarray,
        dt: float,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Commands (4,) to add to the trim.

        Args:
            state: full state (20,) or more.
            reference: height, forward, right, heading asked for, shape (4,).
            reference_rate: the same, per second.
            dt: seconds per row. rng: of the tremor.
        """
        error = state[:N_FLOWN] - self.trim_state
        error[S.U] -= reference[1]
        error[S.V] -= reference[2]
        error[S.W] += reference_rate[0]
        error[S.R] -= reference_rate[3]
        error[S.PSI] = wrap_angle(state[S.PSI] - self.trim_state[S.PSI] - reference[3])
        error[S.Z] = state[S.Z] + reference[0]
        error[PLACE] = 0.0
        error[:N_STATES] = error[:N_STATES].clip(-_REACH, _REACH)
        correction = -self.gain @ error
        if self.tremor:
            keep = math.exp(-dt / TREMOR_MEMORY)
            kick = math.sqrt(1.0 - keep * keep) * self.tremor * TREMOR
            self.hands = keep * self.hands + kick * rng.standard_normal(N_COMMANDS)
        return correction + self.hands


_REACH = np.array([2, 2, 2, 9, 9, 9, 1, 1, 1, 1, 1, 1, 0.8, 0, 0, 0.8], float)
"""Largest error of each state the pilot reacts to: he does not throw the sticks."""


def _gain(vehicle: Vehicle, dt: float) -> np.ndarray:
    """Linear-quadratic gain (4, 20) about hover, of the kernel's own rows of `dt` seconds.

    Row by row, since what he does may act within one: rotors that react on the body (spin_up_reaction)
    undo a yaw rate at once, and a gain that does not know of it swings from row to row.
    """
    from scipy.linalg import solve_discrete_are

    A, B, _, _, _, trim = sampled(vehicle, dt)
    A, B = A[np.ix_(_HELD, _HELD)], B[_HELD]
    effort = _EFFORT * [trim[0], trim[1], 1.0, 1.0]
    Q = np.diag(np.append(_TOLERATED**-2.0, np.zeros(N_FLOWN - N_STATES))[_HELD])
    R = np.diag(effort**-2.0)
    P = solve_discrete_are(A, B, Q, R)
    gain = np.zeros((N_COMMANDS, N_FLOWN))
    gain[:, _HELD] = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return gain
