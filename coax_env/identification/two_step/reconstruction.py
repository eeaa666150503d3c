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

from coax_env.kernel.compilation import compiled

THETA, U, W, H, BIAS = range(5)
GYRO, AX, AZ = range(3)
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
    gyro, accelerometer, sonar_std = noise
    heights = sonar[np.isfinite(sonar)]
    start = np.array([0.0, 0.0, 0.0, float(np.median(heights[:20])) if heights.size else 0.0, 0.0])
    process_noise = np.array([gyro, accelerometer, accelerometer]) ** 2
    columns = [np.ascontiguousarray(column, float) for column in (q, ax, az, sonar)]
    predicted, P_predicted, filtered, P_filtered, transition = _filter(
        *columns, float(dt), float(gravity), process_noise, float(sonar_std) ** 2,
        start, START_STD**2,
    )  # fmt: skip
    smooth, P_smooth = _smooth(predicted, P_predicted, filtered, P_filtered, transition)
    return Longitudinal(
        filtered, _std(P_filtered), smooth, _std(P_smooth), columns[3] - filtered[:, H]
    )


@compiled(makes_arrays=True)
def _filter(
    q: np.ndarray, ax: np.ndarray, az: np.ndarray, sonar: np.ndarray, dt: float, g: float,
    process_noise: np.ndarray, sonar_variance: float, start: np.ndarray, spread: np.ndarray,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Forward pass: predicted and filtered states (n, 5), covariances (n, 5, 5), transitions.

    Products are written out: numba compiles those of whole matrices for ten seconds.
    """
    n = q.size
    predicted, filtered = np.zeros((n, 5)), np.zeros((n, 5))
    P_predicted, P_filtered = np.zeros((n, 5, 5)), np.zeros((n, 5, 5))
    transition = np.zeros((n, 5, 5))
    x, slope, middle, gain = np.zeros(5), np.zeros(5), np.zeros(5), np.zeros(5)
    A, F, FP, P = np.zeros((5, 5)), np.zeros((5, 5)), np.zeros((5, 5)), np.zeros((5, 5))
    G = np.zeros((5, 3))
    for i in range(5):
        x[i], P[i, i] = start[i], spread[i]
    for k in range(n):
        _store_row(x, predicted[k])
        _store_matrix(P, P_predicted[k])
        if np.isfinite(sonar[k]):
            residual = sonar[k] - x[H]
            for i in range(5):
                gain[i] = P[i, H] / (P[H, H] + sonar_variance)
                x[i] += gain[i] * residual
            for i in range(5):
                for j in range(i, 5):  # both halves, of what rounding may have parted
                    left = P_predicted[k, i, j] - gain[i] * P_predicted[k, H, j]
                    right = P_predicted[k, j, i] - gain[j] * P_predicted[k, H, i]
                    P[i, j] = P[j, i] = 0.5 * (left + right)
        _store_row(x, filtered[k])
        _store_matrix(P, P_filtered[k])
        after = min(k + 1, n - 1)
        _rates(x, q[k], ax[k], az[k], g, slope)
        for i in range(5):
            middle[i] = x[i] + 0.5 * dt * slope[i]
        q_half, ax_half = 0.5 * (q[k] + q[after]), 0.5 * (ax[k] + ax[after])
        az_half = 0.5 * (az[k] + az[after])
        _rates(middle, q_half, ax_half, az_half, g, slope)
        for i in range(5):
            x[i] += dt * slope[i]
        sin, cos = np.sin(middle[THETA]), np.cos(middle[THETA])
        A[U, THETA], A[U, W] = -g * cos, -q[k]
        A[W, THETA], A[W, U], A[W, BIAS] = -g * sin, q[k], -1.0
        A[H, THETA] = middle[U] * cos + middle[W] * sin
        A[H, U], A[H, W] = sin, -cos
        G[THETA, GYRO], G[U, GYRO], G[W, GYRO] = 1.0, -middle[W], middle[U]
        G[U, AX] = G[W, AZ] = 1.0
        for i in range(5):
            for j in range(5):
                squared = 0.0
                for a in range(5):
                    squared += A[i, a] * A[a, j]
                F[i, j] = (i == j) + dt * A[i, j] + 0.5 * dt * dt * squared
        _store_matrix(F, transition[k])
        for i in range(5):
            for j in range(5):
                FP[i, j] = 0.0
                for a in range(5):
                    FP[i, j] += F[i, a] * P[a, j]
        for i in range(5):
            for j in range(5):
                total = 0.0
                for a in range(5):
                    total += FP[i, a] * F[j, a]
                for a in range(3):
                    total += dt * dt * G[i, a] * process_noise[a] * G[j, a]
                P[i, j] = total
    return predicted, P_predicted, filtered, P_filtered, transition


@compiled()
def _store_row(row: np.ndarray, out: np.ndarray) -> None:
    """One row of numbers into another: an assignment to a slice takes a second to compile."""
    for k in range(len(row)):
        out[k] = row[k]


@compiled()
def _store_matrix(A: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(A)):
        _store_row(A[i], out[i])


@compiled()
def _rates(x: np.ndarray, q: float, ax: float, az: float, g: float, out: np.ndarray) -> None:
    """(46)-(49) with (54)-(55)."""
    sin, cos = np.sin(x[THETA]), np.cos(x[THETA])
    out[THETA] = q
    out[U] = ax - q * x[W] - g * sin
    out[W] = az - x[BIAS] + q * x[U] + g * cos
    out[H] = x[U] * sin - x[W] * cos
    out[BIAS] = 0.0


def _smooth(
    predicted: np.ndarray, P_predicted: np.ndarray, filtered: np.ndarray,
    P_filtered: np.ndarray, transition: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Backward pass of Rauch, Tung and Striebel."""
    smooth, P_smooth = filtered.copy(), P_filtered.copy()
    back = np.linalg.solve(P_predicted[1:], transition[:-1] @ P_filtered[:-1]).swapaxes(1, 2)
    for k in range(len(filtered) - 2, -1, -1):
        smooth[k] += back[k] @ (smooth[k + 1] - predicted[k + 1])
        P_smooth[k] += back[k] @ (P_smooth[k + 1] - P_predicted[k + 1]) @ back[k].T
    return smooth, P_smooth


def _std(P: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(np.einsum("kii->ki", P), 0.0))


def flapping(
    rate: np.ndarray, tilt: np.ndarray | float, dt: float, time_constant: float, gain: float
) -> np.ndarray:
    """A rotor's or fly-bar's flap angle by (26)-(29) without coupling, (n,) [rad], from rest.

    a' = (gain tilt - a) / time_constant - rate: the tilt held from row to row, exactly; the rate by the
    trapezoidal rule. Columns of an (n, k) `rate` are followed each on its own.

    Args:
        rate: of the body, (n,) or (n, k) [rad/s]. tilt: of the swash plate, (n,) or one [rad].
        dt: seconds between rows. time_constant: [s]. gain: flap per swash tilt [1].
    """
    half = 0.5 * dt / time_constant
    turning = lfilter([0.5 * dt, 0.5 * dt], [1.0 + half, half - 1.0], rate, axis=0)
    keep = np.exp(-dt / time_constant)
    following = lfilter([0.0, gain * (1.0 - keep)], [1.0, -keep], np.atleast_1d(tilt), axis=0)
    return np.asarray(following - turning)
