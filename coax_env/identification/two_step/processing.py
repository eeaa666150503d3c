"""Filters of the paper's section IV.C, and its check that they leave the motion alone.

SciPy's Butterworth and short-time Fourier transform; records are on an even time grid.
"""

from functools import cache

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import ShortTimeFFT, butter, get_window, sosfiltfilt

from coax_env.errors import InputError
from coax_env.logs.flight import Run

CUTOFF = 5.0
"""Of the low-pass filter [Hz]. The paper gives none: above the flapping's 3 Hz, far below vibration."""
ORDER = 4
SEGMENT = 1.0
"""Length of the segments of the spectral-amplitude filter [s], the paper's."""


def even_grid(
    run: Run, channels: tuple[str, ...]
) -> tuple[float, np.ndarray, dict[str, np.ndarray]]:
    """A run's channels on an even time grid, straight lines between readings.

    Returns the step [s], the times (n,) and channel -> (n,); a channel that the run lacks is left out.
    """
    dt = float(np.median(np.diff(run.t)))
    t = run.t[0] + dt * np.arange(int(np.floor((run.t[-1] - run.t[0]) / dt + 1e-9)) + 1)
    columns = {}
    for channel in channels:
        values = run.measured.get(channel)
        if values is not None and np.isfinite(values).sum() > 3:
            there = np.isfinite(values)
            columns[channel] = np.interp(t, run.t[there], values[there])
    return dt, t, columns


@cache
def _butterworth(cutoff: float, rate: float) -> np.ndarray:
    """Second-order sections."""
    return np.asarray(butter(ORDER, cutoff, fs=rate, output="sos"))


def low_pass(values: np.ndarray, dt: float, cutoff: float = CUTOFF) -> np.ndarray:
    """Butterworth low-pass run forwards and backwards, so without phase, along axis 0.

    Args:
        values: (n,) or (n, k). dt: seconds between rows. cutoff: of one pass [Hz].

    Raises:
        InputError: the record is too short or too coarse for it.
    """
    if cutoff >= 0.5 / dt:
        raise InputError(
            f"a low-pass at {cutoff:g} Hz needs {2 * cutoff:g} readings a second or more"
        )
    sections = _butterworth(cutoff, round(1.0 / dt, 6))
    pad = 3 * (2 * len(sections) + 1)
    if len(values) <= pad:
        raise InputError(
            f"a run of {len(values)} rows is too short to filter: {pad + 1} are needed"
        )
    return np.asarray(sosfiltfilt(sections, values, axis=0))


def spectral_amplitude_filter(
    values: np.ndarray, noise: np.ndarray, dt: float, segment: float = SEGMENT
) -> np.ndarray:
    """The amplitude spectrum of a noise record taken from each segment's, phases kept, shape (n,).

    Segments overlap by half under a Hann window and are added up again, so that they leave no steps;
    a record without noise comes back as it was.

    Args:
        noise: (k,) the same sensor while nothing is flown (the paper: hover); its mean is taken off.
    """
    rows = max(8, round(segment / dt) // 2 * 2)
    if len(noise) < rows:
        raise InputError(
            f"the noise record of {len(noise)} rows is shorter than a segment of {rows}"
        )
    transform = ShortTimeFFT(get_window("hann", rows), rows // 2, 1.0 / dt, mfft=rows)
    floor = np.abs(transform.stft(noise - noise.mean()))
    inside = slice(transform.lower_border_end[1], transform.upper_border_begin(len(noise))[1])
    amplitude = floor[:, inside].mean(axis=1, keepdims=True) if floor[:, inside].size else 0.0
    mean = values.mean()
    spectrum = transform.stft(values - mean)
    size = np.abs(spectrum)
    kept = np.maximum(size - amplitude, 0.0) / np.maximum(size, 1e-300)
    return np.asarray(transform.istft(spectrum * kept, k1=len(values))).real + mean


def lagrange_derivative(values: np.ndarray, dt: float) -> np.ndarray:
    """Time derivative by the 4-point Lagrange formula, shape (n,); exact for a cubic.

    The four neighbours in the middle of the record, the four first or last readings at its ends.
    """
    if len(values) < 5:
        raise InputError("a derivative takes five readings at least")
    y = np.asarray(values, float)
    slope = np.empty_like(y)
    slope[2:-2] = (y[:-4] - 8.0 * y[1:-3] + 8.0 * y[3:-1] - y[4:]) / (12.0 * dt)
    for at, sign in ((0, 1.0), (-1, -1.0)):
        a, b, c, d = y[:4] if sign > 0.0 else y[:-5:-1]
        slope[at] = sign * (-11.0 * a + 18.0 * b - 9.0 * c + 2.0 * d) / (6.0 * dt)
        slope[at + (1 if sign > 0.0 else -1)] = (
            sign * (-2.0 * a - 3.0 * b + 6.0 * c - d) / (6.0 * dt)
        )
    return slope


def integrated(
    q: np.ndarray, ax: np.ndarray, az: np.ndarray, dt: float, gravity: float, height: float
) -> dict[str, np.ndarray]:
    """Pitch, velocity and height by integrating the IMU from rest, (46)-(49): the paper's check.

    Returns theta [rad], u, w [m/s], h [m], each (n,).

    Args:
        q: [rad/s], ax, az: [m/s2], (n,) each. dt: seconds between rows.
        gravity: [m/s2]. height: at the start [m].
    """
    theta = cumulative_trapezoid(q, dx=dt, initial=0.0)
    u, w = np.zeros(len(q)), np.zeros(len(q))
    gx, gz = -gravity * np.sin(theta), gravity * np.cos(theta)
    for k in range(len(q) - 1):
        rate = 0.5 * (q[k] + q[k + 1])
        push = 0.5 * (ax[k] + ax[k + 1] + gx[k] + gx[k + 1])
        sink = 0.5 * (az[k] + az[k + 1] + gz[k] + gz[k + 1])
        # midpoint: (u, w) turn with the body
        middle = u[k] + 0.5 * dt * (push - rate * w[k]), w[k] + 0.5 * dt * (sink + rate * u[k])
        u[k + 1] = u[k] + dt * (push - rate * middle[1])
        w[k + 1] = w[k] + dt * (sink + rate * middle[0])
    climb = u * np.sin(theta) - w * np.cos(theta)
    climbed = cumulative_trapezoid(climb, dx=dt, initial=0.0)
    return {"theta": theta, "u": u, "w": w, "h": height + climbed}
