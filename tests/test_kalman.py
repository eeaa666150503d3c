"""The filter pass against the textbook's, with dense matrices: predict, correct, nothing left out."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from test_estimation import (
    ANGLE,
    CHANNELS,
    DAMPING,
    DT,
    NOISE,
    RATE,
    SINE,
    STIFFNESS,
    TRUTH,
    Pendulum,
    swing,
    with_holes,
)

from coax_env.estimation import compiled_model, kalman, pass_data
from coax_env.estimation.engine import Engine
from coax_env.estimation.sparse import (
    aligned,
    combine,
    find_non_zeros,
    multiply,
    padded,
    unpack,
    with_places,
)
from coax_env.estimation.state_space import Record
from coax_env.kernel.angles import wrap_angles
from coax_env.kernel.simd import SIMD_WIDTH, transpose

GATE = 8.0
H = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
"""The pendulum's readings: its angle, and its rate twice."""
DECAY = np.array([0.0, 7.0])
"""1/s: of what the noise has added to each state."""


def step_of(x: np.ndarray, u: float, h: float, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pendulum a row later, and the Jacobian F of that, by hand."""
    pull = (1.0 - p[SINE]) * x[ANGLE] + p[SINE] * math.sin(x[ANGLE])
    stiffness = p[STIFFNESS] * (1.0 - p[SINE] + p[SINE] * math.cos(x[ANGLE]))
    rate = x[RATE] + h * (u - p[STIFFNESS] * pull - p[DAMPING] * x[RATE])
    F = np.array(
        [
            [1.0 - h * h * stiffness, h * (1.0 - h * p[DAMPING])],
            [-h * stiffness, 1.0 - h * p[DAMPING]],
        ]
    )
    return np.array([x[ANGLE] + h * rate, rate]), F


def dense_filter(record: Record, p: np.ndarray, R: np.ndarray, q: np.ndarray) -> dict[str, Any]:
    """Bar-Shalom, Li and Kirubarajan 2001, table 10.3.3-1; readings one after the other.

    And beside it all readings of a row at once, which must give the same.
    """
    x, P = Pendulum.start_at.copy(), np.diag(Pendulum.start_std**2)
    dt = np.append(np.diff(record.t), 0.0)
    found: dict[str, Any] = {
        name: [] for name in ("x", "P", "predicted", "F", "e", "K", "per_sigma", "outside")
    }
    log_likelihood = 0.0
    beyond = 0
    for k in range(record.t.size):
        found["predicted"].append(x)
        # innovation, and what the gate makes of R
        v = record.z[k] - H @ x
        v[0] = wrap_angles(v[:1])[0]
        there = np.flatnonzero(np.isfinite(v))
        R_k = R.copy() if record.blur is None else R + record.blur[k]
        for i in there:
            s2 = H[i] @ P @ H[i] + R_k[i]
            found["outside"].append(1.0 / s2 if v[i] ** 2 > GATE**2 * s2 else 0.0)
            if v[i] ** 2 > GATE**2 * s2:
                R_k[i] += v[i] ** 2 / GATE**2 - s2
                log_likelihood -= 0.5 * (GATE**2 - 1.0) * math.log(v[i] ** 2 / GATE**2 / s2)
                beyond += 1
        # correct, all at once
        S = H[there] @ P @ H[there].T + np.diag(R_k[there])
        gain = P @ H[there].T @ np.linalg.inv(S)
        x_joint, P_joint = x + gain @ v[there], P - gain @ H[there] @ P
        if there.size:
            log_likelihood += multivariate_normal.logpdf(v[there], cov=S)
        # correct, one after the other
        e, x_before = np.full(3, np.nan), x
        for i in there:
            residual = v[i] - H[i] @ (x - x_before)
            s2 = H[i] @ P @ H[i] + R_k[i]
            K = P @ H[i] / s2
            x, P = x + K * residual, (np.eye(2) - np.outer(K, H[i])) @ P
            e[i] = residual / math.sqrt(s2)
            found["K"].append(K)
            found["per_sigma"].append(1.0 / math.sqrt(s2))
        np.testing.assert_allclose(x, x_joint, atol=1e-10)
        np.testing.assert_allclose(P, P_joint, atol=1e-12)
        found["e"].append(e)
        found["x"].append(x)
        found["P"].append(P)
        # predict; F, as H, is that of the predicted state, the first one that of the corrected state
        F = step_of(x_before if k else x, record.command[k, 0], dt[k], p)[1]
        x = step_of(x, record.command[k, 0], dt[k], p)[0]
        grown = [(1.0 - math.exp(-2.0 * d * dt[k])) / (2.0 * d) if d else dt[k] for d in DECAY]
        P = F @ P @ F.T + np.diag(q * grown)
        if record.between and k < record.t.size - 1:
            answer = np.array([dt[k] ** 2, dt[k]])  # of angle and rate to the torque
            change = record.command[k + 1, 0] - record.command[k, 0]
            P += record.between * change**2 * np.outer(answer, answer)
        found["F"].append(F)
    return {
        **{name: np.array(rows) for name, rows in found.items()},
        "log_likelihood": log_likelihood, "beyond": beyond,
    }  # fmt: skip


def fast_filter(
    record: Record, p: np.ndarray, R: np.ndarray, q: np.ndarray, refresh: int = 1
) -> tuple[float, int, pass_data.Trace, pass_data.Covariances]:
    """`filter_pass` with new Jacobians every `refresh` rows, and all that it stores."""
    model = Pendulum()
    model.state_scale = np.full(2, 1e-7)  # so that differences are as good as derivatives
    (n, m), readings = record.z.shape, int(np.isfinite(record.z).sum())
    trace = pass_data.Trace(
        np.zeros((n, 2)), np.zeros((n, m)),
        pass_data.Gains(
            np.zeros((readings, 2), np.float32), np.zeros(readings),
            np.zeros((math.ceil(n / refresh), m, 2), np.float32), np.zeros(2, np.int64),
        ),
        pass_data.Path(np.zeros((n, 2, 2), np.float32), np.zeros(n, np.int64), np.zeros((n, 2)),
                    np.arange(2), np.zeros((n, 2, 2), np.float32), np.zeros(readings)),
    )  # fmt: skip
    kept = pass_data.Covariances(np.zeros((n, 2, 2)), np.arange(n))
    run = pass_data.RunData(np.append(np.diff(record.t), 0.0), record.command, record.z)
    run = run if record.blur is None else run._replace(blur=record.blur)
    run = run._replace(between=model.between(record, p)) if record.between else run
    start = pass_data.Variances(Pendulum.start_at, np.diag(Pendulum.start_std**2), R, q, DECAY)
    log_likelihood, beyond = kalman.filter_pass(
        compiled_model.CompiledModel.of(model), run, start, p, GATE, refresh, trace, kept
    )
    return log_likelihood, beyond, trace, kept


@pytest.mark.parametrize("sine", [0.0, 1.0], ids=["linear", "nonlinear"])
@pytest.mark.parametrize("clock", ["even", "jitters", "wrong", "between"])
def test_the_pass_is_the_textbooks_filter(sine, clock):
    """States, covariances, innovations, gains, Jacobians and likelihood; with holes and outliers.

    Where the clock is wrong, each reading has a variance of its own beside its channel's. Where the
    torque changes between the rows, its mean over a row has one.
    """
    values = {**TRUTH, "sine": sine}
    record = with_holes(swing(11, n=200, values=values), 0.3, seed=2)
    z = record.z.copy()
    z[50] += [2.0, 4.0, 4.0]
    z[120] -= [0.0, 5.0, 5.0]
    t = record.t
    if clock == "jitters":
        t = DT * np.cumsum(np.random.default_rng(3).uniform(0.3, 2.0, 200))
    R = np.array([NOISE.reading[c] for c in CHANNELS]) ** 2
    blur = R * np.random.default_rng(4).exponential(2.0, z.shape) if clock == "wrong" else None
    record = replace(record, z=z, t=t, blur=blur, between=0.1 if clock == "between" else 0.0)
    model = Pendulum()
    p = model.vector(values)
    q = model.process_noise(NOISE, p).intensity
    dense = dense_filter(record, p, R, q)
    log_likelihood, beyond, trace, kept = fast_filter(record, p, R, q)
    assert beyond == dense["beyond"] >= 2
    assert log_likelihood == pytest.approx(dense["log_likelihood"], abs=1e-6)
    for ours, theirs in (
        (trace.states, dense["x"]), (kept.P, dense["P"]), (trace.e, dense["e"]),
        (trace.path.predicted, dense["predicted"]), (trace.gains.K, dense["K"]),
        (trace.gains.per_sigma, dense["per_sigma"]), (trace.path.beyond, dense["outside"]),
        (trace.path.P, dense["P"]),
        (trace.path.F[trace.path.F_of[:-1]], dense["F"][:-1]),
        (trace.gains.H, np.broadcast_to(H, trace.gains.H.shape)),
    ):  # fmt: skip
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("known", [pytest.param(False, marks=pytest.mark.slow), True])
def test_what_changes_at_unknown_times_is_believed_as_little_as_it_deserves(known):
    """A torque that jumps once within each row, evenly anywhere: its mean is half of the next one's.

    Flown in a hundred steps a row; the covariance then says by how much each reading of the rate is
    missed, and would say far too little if the mean were taken to be known.
    """
    rng, rows, fine = np.random.default_rng(8), 4000, 100
    torque = 20.0 * rng.standard_normal(rows)
    x, z = np.zeros(2), np.empty((rows, 3))
    for k in range(rows):
        z[k] = x[ANGLE], x[RATE] + TRUTH["bias"], x[RATE]
        since = rng.uniform(0.0, fine)
        for i in range(fine):
            u = torque[k] if i < since else torque[min(k + 1, rows - 1)]
            rate = x[RATE] + DT / fine * (
                u - TRUTH["stiffness"] * math.sin(x[ANGLE]) - TRUTH["damping"] * x[RATE]
            )
            x = np.array([x[ANGLE] + DT / fine * rate, rate])
    z += rng.standard_normal(z.shape) * [NOISE.reading[c] for c in CHANNELS]
    z[:, 0] = wrap_angles(z[:, 0])
    record = Record(
        "jumps", DT * np.arange(rows), torque[:, None], z, of_next=0.5,
        between=0.0 if known else 1.0 / 12.0,
    )  # fmt: skip
    noise = NOISE.with_levels({"torque": 1e-3})
    (run,) = Engine(Pendulum(), [record]).filter({**TRUTH, "sine": 1.0}, noise)
    missed = float(np.mean(run.innovations[100:, 1:] ** 2))
    assert missed > 2.0 if known else missed == pytest.approx(1.0, abs=0.04)


@pytest.mark.parametrize("factor", [0.4, 3.0])
def test_a_step_that_changes_much_has_its_own_jacobian(factor):
    """Between refreshes too: a linear pendulum's F is known at every step, each its own."""
    values = {**TRUTH, "sine": 0.0}
    record = swing(11, n=60, values=values)
    steps = np.full(60, DT)
    steps[2::5] *= factor  # never where the Jacobians are refreshed alone
    record = replace(record, t=np.cumsum(steps))
    model = Pendulum()
    p = model.vector(values)
    q = model.process_noise(NOISE, p).intensity
    R = np.array([NOISE.reading[c] for c in CHANNELS]) ** 2
    _, _, trace, _ = fast_filter(record, p, R, q, refresh=4)
    for k, dt in enumerate(np.diff(record.t)):
        F = step_of(np.zeros(2), 0.0, dt, p)[1]
        found = trace.path.F[trace.path.F_of[k]]
        np.testing.assert_allclose(found, F, rtol=0, atol=1e-6, err_msg=f"row {k}, {dt:.4f} s")


# --- sparse matrices --------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_a_sparse_product_is_the_dense_one(share):
    rng = np.random.default_rng(5)
    values = rng.normal(size=(7, padded(5)))
    values[:, 5:] = 0.0
    values[rng.random(values.shape) >= share] = 0.0
    A = with_places(values, 5)
    find_non_zeros(A)
    for i in range(7):
        assert list(A.places[i, : A.counts[i]]) == list(np.flatnonzero(values[i]))
    B = rng.normal(size=(5, padded(9)))
    out = np.full((7, padded(9)), np.nan)
    multiply(A, B, out)
    np.testing.assert_allclose(out, values[:, :5] @ B, atol=1e-14)


@pytest.mark.parametrize(
    ("count", "length"),
    [(0, 0), (1, 24), (24, 24), (25, 32), (32, 32), (33, 56), (56, 56), (57, 64), (65, 88)],
)
def test_rows_end_with_three_or_four_registers(count, length):
    assert padded(count) == length


@pytest.mark.parametrize("width", [5, SIMD_WIDTH, SIMD_WIDTH + 3, 4 * SIMD_WIDTH])
def test_places_are_noted_anew_wherever_a_value_changes(width):
    """Rows of whole registers remember which lanes were not zero; others are looked through."""
    A = with_places(np.zeros((2, width)), width)
    assert A.seen.shape == (2, width // SIMD_WIDTH if width % SIMD_WIDTH == 0 else 0)
    find_non_zeros(A)
    assert list(A.counts) == [0, 0]
    for j in range(width):
        A.values[1, j] = -1.5
        find_non_zeros(A)
        assert list(A.counts) == [0, 1] and A.places[1, 0] == j
        A.values[1, j] = 0.0
    find_non_zeros(A)
    assert list(A.counts) == [0, 0]


@pytest.mark.parametrize("rows", [1, 3, 7])
def test_rows_begin_at_a_line_of_the_cache(rows):
    """64 bytes, wherever the memory was taken from; zeros, as many as asked for."""
    kept = [aligned(rows, width) for width in (8, 16, 40) for _ in range(6)]
    for k, A in enumerate(kept):
        assert A.shape == (rows, (8, 16, 40)[k // 6]) and not A.any()
        assert A.ctypes.data % 64 == 0
        A += k + 1.0
    for k, A in enumerate(kept):
        np.testing.assert_array_equal(A, k + 1.0, err_msg="one lies in another")


def test_rows_are_combined_by_their_weights():
    """The first so many of them; what is beyond counts for nothing."""
    rng = np.random.default_rng(7)
    B, weights = rng.normal(size=(6, padded(40))), rng.normal(size=8).astype(np.float32)
    out = np.full(padded(40), np.nan)
    combine(weights, B, 5, out)
    np.testing.assert_allclose(out, weights[:5].astype(float) @ B[:5], atol=1e-13)


@pytest.mark.parametrize("n", [8, 24, 32])
def test_a_matrix_is_transposed(n):
    A, out = np.random.default_rng(n).normal(size=(n, n)), np.full((n, n), 7.0)
    transpose(A, out)
    np.testing.assert_array_equal(out, A.T)


def test_a_stored_matrix_comes_back_with_its_non_zeros():
    stored = np.zeros((3, 2, 5), np.float32)
    stored[1] = [[0.0, 2.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 4.0]]
    A = with_places(np.ones((2, padded(5))), 5)
    A.values[:, 5:] = 0.0
    unpack(stored, 1, A)
    np.testing.assert_array_equal(A.values[:, :5], stored[1])
    assert list(A.counts) == [2, 1] and list(A.places[0, :2]) == [1, 3] and A.places[1, 0] == 4
