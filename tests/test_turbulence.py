"""Dryden turbulence: the standard's numbers, the variance it keeps, the spectrum it has."""

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import welch

from coax_env.env.period import DT
from coax_env.env.turbulence import (
    FOOT,
    SEVERITIES,
    draw_filters,
    dryden,
    spectrum,
    turbulence_step,
    wind_at_6m,
)
from coax_env.errors import InputError
from coax_env.kernel.random_streams import stream_key, two_normals


def turbulence_of(seed: int, rows: int, height: float, wind: float) -> np.ndarray:
    stream = np.array([stream_key(np.uint64(seed)), 0], dtype=np.uint64)
    state, air, history = np.zeros(5), np.zeros(3), np.empty((rows, 3))
    draw_filters(stream, state)
    for row in range(rows):
        turbulence_step(stream, state, height, wind, DT, air)
        history[row] = air
    return history


def test_intensities_and_lengths_are_the_standards():
    sigma, sigma_w, tau, tau_w = dryden(100 * FOOT, 10.0)
    shape = 0.177 + 0.0823
    assert sigma_w == pytest.approx(1.0) and sigma == pytest.approx(shape**-0.4)
    assert tau / tau_w == pytest.approx(shape**-1.2)
    assert dryden(1.0, 5.0) == dryden(10 * FOOT, 5.0)
    top = dryden(1000 * FOOT, 10.0)  # at 1000 ft turbulence is isotropic: L_u = L_w, sigma alike
    assert top[0] == pytest.approx(top[1]) and top[2] == pytest.approx(top[3])
    assert dryden(20 * FOOT, 8.0)[3] * 8.0 == pytest.approx(20 * FOOT)  # L_w = h, V = W at 6 m
    assert SEVERITIES["light"] == pytest.approx(7.717, abs=1e-3)


def test_turbulence_starts_and_stays_at_its_variance():
    sigma, sigma_w, *_ = dryden(2.0, 3.0)
    wanted = np.array([sigma, sigma, sigma_w])
    for rows in (1, 150):
        ends = np.array([turbulence_of(seed, rows, 2.0, 3.0)[-1] for seed in range(1500)])
        assert np.allclose(ends.std(axis=0) / wanted, 1.0, atol=0.08)
        assert np.abs(ends.mean(axis=0) / wanted).max() < 0.12
        assert np.abs(np.corrcoef(ends.T) - np.eye(3)).max() < 0.1


def test_turbulence_has_drydens_spectrum():
    history = turbulence_of(1, 300_000, 1.5, 4.0)
    sigma, sigma_w, tau, tau_w = dryden(1.5, 4.0)
    for axis, (s, t) in enumerate(((sigma, tau), (sigma, tau), (sigma_w, tau_w))):
        f, power = welch(history[:, axis], 1.0 / DT, nperseg=16384)
        for low, high in ((0.03, 0.15), (0.15, 1.0), (1.0, 8.0)):
            band = (f > low) & (f < high)
            assert np.mean(power[band] / spectrum(f[band], s, t, axis == 0)) == pytest.approx(
                1.0, abs=0.12
            )
    area = np.trapezoid(spectrum(f := np.linspace(0.0, 400.0, 400_000), 1.0, 0.5, False), f)
    assert area == pytest.approx(1.0, abs=0.01)


def moved_on(
    filters: np.ndarray, seed: int, height: float, wind: float, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The filters and the air a step later, and the five normal numbers that were drawn for it."""
    stream = np.array([stream_key(np.uint64(seed)), 0], dtype=np.uint64)
    own = stream.copy()
    pairs = [two_normals(own) for _ in range(3)]
    state, air = filters.copy(), np.zeros(3)
    turbulence_step(stream, state, height, wind, dt, air)
    assert np.array_equal(stream, own)
    return state, air, np.array([pairs[0][0], *pairs[1], *pairs[2]])


@pytest.mark.parametrize("dt", [0.01, 0.4])
def test_a_step_keeps_the_filters_covariance_to_the_last_digit(dt):
    """z' = F z + L n: F the exponential of the filters' own equations, F P F' + L L' = P."""
    height, wind = 4.0, 6.0
    sigma, sigma_w, tau, tau_w = dryden(height, wind)
    still = [moved_on(np.zeros(5), seed, height, wind, dt) for seed in range(12)]
    N = np.array([drawn for *_, drawn in still])
    L = np.linalg.lstsq(N, np.array([z for z, *_ in still]), rcond=None)[0].T
    np.testing.assert_allclose(N @ L.T, [z for z, *_ in still], atol=1e-12)
    F = np.array([moved_on(e, 3, height, wind, dt)[0] - still[3][0] for e in np.eye(5)]).T
    rates = np.zeros((5, 5))
    for first, memory, pair in ((0, tau, False), (1, tau, True), (3, tau_w, True)):
        rates[first, first] = -1.0 / memory
        if pair:
            rates[first + 1, first : first + 2] = 1.0 / memory, -1.0 / memory
    np.testing.assert_allclose(F, expm(rates * dt), atol=1e-12)
    P = np.zeros((5, 5))
    P[0, 0] = 1.0
    for k in (1, 3):
        P[k : k + 2, k : k + 2] = [[1.0, 0.5], [0.5, 0.5]]
    np.testing.assert_allclose(F @ P @ F.T + L @ L.T, P, atol=1e-12)
    # and of that covariance the air has the standard's std
    M = np.linalg.lstsq(np.array([z for z, *_ in still]), np.array([a for _, a, _ in still]),
                        rcond=None)[0].T  # fmt: skip
    np.testing.assert_allclose(M @ P @ M.T, np.diag([sigma**2, sigma**2, sigma_w**2]), atol=1e-9)


def test_filters_are_drawn_with_their_stationary_covariance():
    drawn, normals = [], []
    for seed in range(8):
        stream = np.array([stream_key(np.uint64(seed)), 0], dtype=np.uint64)
        own, state = stream.copy(), np.zeros(5)
        pairs = [two_normals(own) for _ in range(3)]
        draw_filters(stream, state)
        drawn.append(state)
        normals.append([pairs[0][0], *pairs[1], *pairs[2]])
    L = np.linalg.lstsq(np.array(normals), np.array(drawn), rcond=None)[0].T
    P = np.zeros((5, 5))
    P[0, 0] = 1.0
    for k in (1, 3):
        P[k : k + 2, k : k + 2] = [[1.0, 0.5], [0.5, 0.5]]
    np.testing.assert_allclose(L @ L.T, P, atol=1e-12)


def test_the_wind_at_six_metres_is_a_severity_or_a_speed():
    knots = {"light": 15.0, "moderate": 30.0, "severe": 45.0}
    for name, speed in knots.items():
        assert wind_at_6m(name) == pytest.approx(speed * 1852.0 / 3600.0)
    assert wind_at_6m(None) == 0.0 == wind_at_6m(0.0) and wind_at_6m(2.5) == 2.5
    for wrong in ("mild", -0.1, math.nan, math.inf, [1.0, 2.0]):
        with pytest.raises(InputError, match="turbulence must be"):
            wind_at_6m(wrong)
