"""Step 1 of the paper's method: the helicopter's states from gyro, accelerometers and sonar.

Longitudinal, five states theta u w h lambda_az, (46)-(57): the IMU is the input, the sonar the only
measurement, the bias of a_z a state. The height alone hardly observes u, which is dead reckoned from
rest: its std says so. Beside the filter the fixed-interval smoother of Rauch, Tung and Striebel 1965.

Flapping (50)-(51) is integrated apart, from the swash command and the filtered rate. The paper prints
tau_f,f for the lower rotor in (50); it must be tau_f,l. The same with beta, p and delta_lat.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

THETA, U, W, H, BIAS = range(5)
START_STD = np.array([0.02, 0.05, 0.05, 0.05, 0.1])
"""Of the first state, from rest: 1 deg, 5 cm/s, the sonar's reading, 0.1 m/s2. Ours."""


@dataclass(frozen=True)
class Longitudinal:
    """States theta [rad], u, w [m/s], h [m], bias of a_z [m/s2], each with its std, (n, 5).

    smoothed, smoothed_std: the same from the whole record. residual: (n,) sonar less the filtered
    height [m], NaN where the sonar was silent.
    """

    states: np.ndarray
    std: np.ndarray
    smoothed: np.ndarray
    smoothed_std: np.ndarray
    residual: np.ndarray


def longitudinal(
    q: np.ndarray,
    ax: np.ndarray,
    az: np.ndarray,
    sonar: np.ndarray,
    dt: float,
    gravity: float,
    noise: tuple[float, float, float],
) -> Longitudinal:
    """Extended Kalman filter of (46)-(57) and its smoother, over one run.

    Args:
        q, ax, az: (n,) the IMU [rad/s, m/s2]. sonar: (n,) height [m], NaN where silent.
        noise: std of the gyro [rad/s], the accelerometers [m/s2] and the sonar [m]. The paper gives no
            Q, R or P0: Q is the IMU's noise through the model, R the sonar's, both of Table V.
    """
    n = len(q)
    gyro, accelerometer, echo = noise
    inputs = np.diag([gyro**2, accelerometer**2, accelerometer**2])
    heard = sonar[np.isfinite(sonar)]
    x = np.array([0.0, 0.0, 0.0, float(np.median(heard[:20])) if heard.size else 0.0, 0.0])
    P = np.diag(START_STD**2)
    predicted, filtered = np.empty((n, 5)), np.empty((n, 5))
    P_predicted, P_filtered = np.empty((n, 5, 5)), np.empty((n, 5, 5))
    transition = np.empty((n, 5, 5))
    residual = np.full(n, np.nan)
    for k in range(n):
        predicted[k], P_predicted[k] = x, P
        if np.isfinite(sonar[k]):
            gain = P[:, H] / (P[H, H] + echo**2)
            x = x + gain * (sonar[k] - x[H])
            P = P - np.outer(gain, P[H])
            P = 0.5 * (P + P.T)
        filtered[k], P_filtered[k] = x, P
        residual[k] = sonar[k] - x[H]
        u = np.array([q[k], ax[k], az[k]])
        after = np.array([q[min(k + 1, n - 1)], ax[min(k + 1, n - 1)], az[min(k + 1, n - 1)]])
        middle = x + 0.5 * dt * _rates(x, u, gravity)
        x, F, G = (
            x + dt * _rates(middle, 0.5 * (u + after), gravity),
            _jacobian(middle, u, gravity),
            _input_jacobian(middle),
        )
        transition[k] = F = np.eye(5) + dt * F + 0.5 * dt**2 * F @ F
        P = F @ P @ F.T + dt**2 * G @ inputs @ G.T
    smooth, P_smooth = filtered.copy(), P_filtered.copy()
    for k in range(n - 2, -1, -1):
        back = np.linalg.solve(P_predicted[k + 1], transition[k] @ P_filtered[k]).T
        smooth[k] += back @ (smooth[k + 1] - predicted[k + 1])
        P_smooth[k] += back @ (P_smooth[k + 1] - P_predicted[k + 1]) @ back.T
    return Longitudinal(filtered, _std(P_filtered), smooth, _std(P_smooth), residual)


def _rates(x: np.ndarray, u: np.ndarray, g: float) -> np.ndarray:
    q, ax, az = u
    sin, cos = np.sin(x[THETA]), np.cos(x[THETA])
    return np.array(
        [
            q,
            ax - q * x[W] - g * sin,
            az - x[BIAS] + q * x[U] + g * cos,
            x[U] * sin - x[W] * cos,
            0.0,
        ]
    )


def _jacobian(x: np.ndarray, u: np.ndarray, g: float) -> np.ndarray:
    q = u[0]
    sin, cos = np.sin(x[THETA]), np.cos(x[THETA])
    F = np.zeros((5, 5))
    F[U, THETA], F[U, W] = -g * cos, -q
    F[W, THETA], F[W, U], F[W, BIAS] = -g * sin, q, -1.0
    F[H, THETA], F[H, U], F[H, W] = x[U] * cos + x[W] * sin, sin, -cos
    return F


def _input_jacobian(x: np.ndarray) -> np.ndarray:
    G = np.zeros((5, 3))
    G[THETA, 0], G[U, 0], G[W, 0] = 1.0, -x[W], x[U]
    G[U, 1] = G[W, 2] = 1.0
    return G


def _std(P: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("kii->ki", P), 0.0))


def flapping(
    rate: np.ndarray, tilt: np.ndarray | float, dt: float, time_constant: float, gain: float
) -> np.ndarray:
    """A rotor's or fly-bar's flap angle by (26)-(29) without coupling, (n,) [rad], from rest.

    a' = (gain tilt - a) / time_constant - rate: the tilt held from row to row, exactly; the rate by the
    trapezoidal rule. Columns of an (n, k) `rate` are followed each on its own.
    """
    half = 0.5 * dt / time_constant
    turning = lfilter([0.5 * dt, 0.5 * dt], [1.0 + half, half - 1.0], rate, axis=0)
    keep = np.exp(-dt / time_constant)
    following = lfilter([0.0, gain * (1.0 - keep)], [1.0, -keep], np.atleast_1d(tilt), axis=0)
    return np.asarray(following - turning)
