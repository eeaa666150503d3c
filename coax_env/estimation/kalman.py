"""The two passes over a run: the extended Kalman filter, and the mean pass with its gains frozen.

The readings of a row are taken in one after the other (their errors are independent), each with what
the ones before it have left open: its residual v, of variance s^2, gives a whitened innovation
e = v / s, the state moves by K v, and so the likelihood is

    -2 log L = sum over readings of  e^2 + log s^2 + log 2 pi.

It keeps its gains K, 1 / s and the Jacobians H of the readings. The mean pass repeats only the
propagation of the mean with those: with a parameter moved a little, the change of e is that
parameter's *signature*.

Bar-Shalom, Li and Kirubarajan 2001, ch. 5 and 10; Durbin and Koopman 2012, sec. 6.4 (one reading at a
time); Maybeck 1979; the frozen gains are the approximation of Maine and Iliff 1985 (NASA RP-1138,
filter error method).
"""

import math
from typing import Any

import numpy as np
from numba import boolean, float32, float64, int64, types

from coax_env.kernel.angles import wrap_angle
from coax_env.kernel.compilation import compiled

_A = float64[::1]
_M = float64[:, ::1]
_I = int64[:, ::1]
_N = int64[::1]
STEP = types.FunctionType(types.void(_A, _A, float64, _A, _A, _A))
MEASURE = types.FunctionType(types.void(_A, _A, _A, _A, _A))
REORDER: dict[str, Any] = {"fastmath": {"reassoc", "contract"}}
"""Sums may be taken in the order that is fastest."""
MOST_DECAY = 0.5
"""Share of a state that may decay in a row for the series of the exponential to be used."""
SAME_STEP = 1e-6
"""Steps that differ by no more of themselves are the same: what is left of a clock's rounding."""
BLOCK = 16
"""Rows of matrices are as long as a multiple of this, zeros at the end: no loop has a scalar rest."""
_LOG_2PI = math.log(2.0 * math.pi)


@compiled(int64(int64))
def _whole_blocks(count):
    """The least multiple of BLOCK that is not less."""
    return (count + BLOCK - 1) // BLOCK * BLOCK


@compiled(types.void(_M, _I, _N))
def _non_zeros(A, places, counts):
    """Columns of what is not zero in each row of A, into `places`, and how many."""
    for i in range(counts.size):
        count = 0
        for a in range(places.shape[1]):
            places[i, count] = a
            count += A[i, a] != 0.0
        counts[i] = count


@compiled(types.void(_M, _I, _N, _M, _M), **REORDER)
def _product(A, places, counts, B, out):
    """A B, row by row so that the compiler can use vectors, with what is not zero in A alone."""
    width = out.shape[1]
    for i in range(counts.size):
        for j in range(width):
            out[i, j] = 0.0
        for c in range(counts[i]):
            a = places[i, c]
            weight = A[i, a]
            for j in range(width):
                out[i, j] += weight * B[a, j]


@compiled(types.void(STEP, _A, _A, float64, _A, _A, _A, _A, _A, _A, _M), **REORDER)
def _differences(flow, x, u, dt, p, work, scale, base, x_probe, moved, out):
    """Jacobian in the state of a flow, or of its first values, from those at x, `base`, into `out`."""
    nx = x.size
    for j in range(nx):
        for i in range(nx):
            x_probe[i] = x[i]
        x_probe[j] += scale[j]
        flow(x_probe, u, dt, p, work, moved)
        for i in range(base.size):
            out[i, j] = (moved[i] - base[i]) / scale[j]


@compiled(makes_arrays=True, **REORDER)
def _transition(step, exact, x, u, dt, p, work, scale, x_next, x_probe, A, AA, places, counts, F):
    """Jacobian F of a step: the exponential of that of the drift, A, to third order; its non-zeros.

    A step too long for that has its own Jacobian taken, by differences of `step` (x_next at x).
    """
    nx = x.size
    largest = 0.0
    for i in range(nx):
        if not exact[i]:
            largest = max(largest, abs(A[i, i]))
    if largest > MOST_DECAY:
        _differences(step, x, u, dt, p, work, scale, x_next, x_probe, np.zeros(nx), F)
        _non_zeros(F, places, counts)
        return
    # F = I + A (I + A/2 (I + A/3)), a row at a time; exact rows are I + A
    _non_zeros(A, places, counts)
    _product(A, places, counts, A, AA)
    width = F.shape[1]
    for i in range(nx):
        if exact[i]:
            for j in range(width):
                F[i, j] = A[i, j]
        else:
            for j in range(width):
                F[i, j] = A[i, j] + 0.5 * AA[i, j]
            for c in range(counts[i]):
                a = places[i, c]
                weight = A[i, a] / 6.0
                for j in range(width):
                    F[i, j] += weight * AA[a, j]
        F[i, i] += 1.0
    _non_zeros(F, places, counts)


@compiled(
    types.Tuple((float64, int64))(
        STEP, MEASURE, STEP, boolean[::1], _A, _M, _M, boolean[::1], _A, _M, _A, _A, _A, _A, int64,
        float64, int64, boolean, _M, _M, float32[:, ::1], _A, float32[:, :, ::1], _N,
        float64[:, :, ::1], float32[:, :, ::1], _N, _M,
    ),
    makes_arrays=True,
    **REORDER,
)  # fmt: skip
def filter_pass(
    step, measure, both, exact, dt, u, z, wraps, x0, P0, R, q, p, scale, work_size, gate, refresh,
    keep, states, e, K_all, per_sigma_all, H_all, slots, P_all, F_all, F_of, predicted,
):  # fmt: skip
    """Extended Kalman filter over one run.

    Args:
        step, measure, both: the model's (state_space.py), `both` its `drift_and_readings`.
        dt: (n,) seconds from each row to the next. u: (n, nu). z: (n, m), NaN where missing.
        R: (m,) reading variances. q: (nx,) growth of state variance per second. p: parameters.
        gate: readings further than this many sigmas from their prediction are believed less, as if
            their variance put them at the gate: beyond it the cost grows with the logarithm of the
            distance, without a jump (a heavy tail; Huber and Ronchetti 2009, ch. 7). A lasting one
            is followed all the same, slowly at first.
        refresh: rows between new Jacobians where dt does not change.
        keep: also store gains, standard deviations and Jacobians of the readings.
        states: (n, nx) filtered states, out. e: (n, m) whitened innovations, out, NaN where missing.
        K_all: (readings, nx) gain and per_sigma_all: (readings,) 1 / s of each reading that there is,
            in the order of e; H_all: (n / refresh, m, nx) Jacobians, out, if `keep`.
        slots: (n,) place in P_all where a row's filtered covariance is stored, or -1.
        P_all: (slots, nx, nx), out.
        F_all: (<= n, nx, nx) Jacobians of the step, F_of: (n,) which of them a row has, predicted:
            (n, nx) states before each row's readings, out; not stored where `predicted` is empty.

    Returns:
        log-likelihood (-inf where the filter diverged) and the number of readings beyond the gate.
    """
    n, m = z.shape
    nx = x0.size
    width = _whole_blocks(nx)
    x = x0.copy()
    P = np.zeros((nx, width))
    P[:, :nx] = P0
    work = np.zeros(work_size)
    x_next = np.zeros(nx)
    x_probe = np.zeros(nx)
    base = np.zeros(nx + m)
    moved = np.zeros(nx + m)
    h = np.zeros(m)
    H = np.zeros((m, nx))
    H_places = np.zeros((m, nx), dtype=np.int64)
    H_counts = np.zeros(m, dtype=np.int64)
    F = np.zeros((nx, width))
    F_places = np.zeros((nx, nx), dtype=np.int64)
    F_counts = np.zeros(nx, dtype=np.int64)
    AH = np.zeros((nx + m, width))  # of the drift, and of the readings
    A = AH[:nx]
    AA = np.zeros((nx, width))
    dt_of_F = -1.0  # step at which F was computed, and the one it is scaled to
    dt_now = -1.0
    slot = -1
    HP = np.zeros(width)
    FP = np.zeros((nx, width))
    PF = np.zeros((nx, width))
    tell = predicted.shape[0] == n
    there = 0
    nu = np.zeros(m)
    noise = np.zeros(m)
    log_likelihood = 0.0
    deweighted = 0
    for k in range(n):
        fresh = k % refresh == 0
        # --- correct ---------------------------------------------------------------------------
        measure(x, u[k], p, work, h)
        if fresh:
            both(x, u[k], dt[k], p, work, base)
            _differences(both, x, u[k], dt[k], p, work, scale, base, x_probe, moved, AH)
            for i in range(m):
                for j in range(nx):
                    H[i, j] = AH[nx + i, j]
            _non_zeros(H, H_places, H_counts)
            if keep:
                for i in range(m):
                    for j in range(nx):
                        H_all[k // refresh, i, j] = H[i, j]
        for j in range(nx):
            x_probe[j] = x[j]
            if tell:
                predicted[k, j] = x[j]
        # how far each reading is believed, before any of the row has been
        for i in range(m):
            e[k, i] = np.nan
            if not math.isnan(z[k, i]):
                innovation = z[k, i] - h[i]
                if wraps[i]:
                    innovation = wrap_angle(innovation)
                if not math.isfinite(innovation):
                    return -np.inf, deweighted
                variance = R[i]
                for c in range(H_counts[i]):
                    a = H_places[i, c]
                    total = 0.0
                    for d in range(H_counts[i]):
                        total += P[a, H_places[i, d]] * H[i, H_places[i, d]]
                    variance += total * H[i, a]
                nu[i] = innovation
                noise[i] = R[i]
                if innovation * innovation > gate * gate * variance:
                    inflated = innovation * innovation / (gate * gate)
                    log_likelihood -= 0.5 * (gate * gate - 1.0) * math.log(inflated / variance)
                    noise[i] += inflated - variance
                    deweighted += 1
        for i in range(m):
            if math.isnan(z[k, i]):
                continue
            for j in range(width):
                HP[j] = 0.0
            variance = noise[i]
            residual = nu[i]
            for c in range(H_counts[i]):
                a = H_places[i, c]
                weight = H[i, a]
                residual -= weight * (x[a] - x_probe[a])
                for j in range(width):
                    HP[j] += weight * P[a, j]
            for c in range(H_counts[i]):
                variance += HP[H_places[i, c]] * H[i, H_places[i, c]]
            if not variance > 0.0:
                return -np.inf, deweighted
            per_sigma = 1.0 / math.sqrt(variance)
            e[k, i] = residual * per_sigma
            log_likelihood -= 0.5 * (e[k, i] * e[k, i] + math.log(variance) + _LOG_2PI)
            for a in range(nx):
                weight = HP[a] / variance
                x[a] += weight * residual
                for j in range(width):
                    P[a, j] -= weight * HP[j]
                if keep:
                    K_all[there, a] = weight
            if keep:
                per_sigma_all[there] = per_sigma
            there += 1
        for j in range(nx):
            states[k, j] = x[j]
            if not math.isfinite(x[j]):
                return -np.inf, deweighted
        if slots[k] >= 0:
            for i in range(nx):
                for j in range(nx):
                    P_all[slots[k], i, j] = P[i, j]
        # --- predict -----------------------------------------------------------------------------
        if k == n - 1:
            break
        step(x, u[k], dt[k], p, work, x_next)
        changed = False
        if fresh or abs(dt[k] - dt_of_F) > 0.5 * dt_of_F:
            if not fresh:
                both(x, u[k], dt[k], p, work, base)
                _differences(both, x, u[k], dt[k], p, work, scale, base, x_probe, moved, AH)
            dt_of_F = dt_now = dt[k]
            _transition(step, exact, x, u[k], dt[k], p, work, scale, x_next, x_probe, A, AA,
                        F_places, F_counts, F)  # fmt: skip
            changed = True
        elif abs(dt[k] - dt_now) > SAME_STEP * dt_now:
            # same Jacobian, other step: rows of slow states follow the step to first order
            ratio = dt[k] / dt_now
            dt_now = dt[k]
            for i in range(nx):
                if F[i, i] > 0.5:
                    for j in range(nx):
                        own = 1.0 if i == j else 0.0
                        F[i, j] = own + ratio * (F[i, j] - own)
            changed = True
        if tell:
            if changed:
                slot += 1
                for i in range(nx):
                    for j in range(nx):
                        F_all[slot, i, j] = F[i, j]
            F_of[k] = slot
        # P = F (F P)'
        _product(F, F_places, F_counts, P, FP)
        for i in range(nx):
            for j in range(nx):
                PF[j, i] = FP[i, j]
        _product(F, F_places, F_counts, PF, P)
        for i in range(nx):
            for j in range(i):
                P[j, i] = P[i, j]
            P[i, i] += q[i] * dt[k]
            x[i] = x_next[i]
    return log_likelihood, deweighted


@compiled(types.void(float32[:, :, ::1], int64, _M, _I, _N))
def _unpack(stored, slot, A, places, counts):
    """One of the stored matrices, and what is not zero in it."""
    for i in range(stored.shape[1]):
        for j in range(stored.shape[2]):
            A[i, j] = stored[slot, i, j]
    _non_zeros(A, places, counts)


@compiled(
    types.void(
        _A, _M, float32[:, ::1], _A, float32[:, :, ::1], float32[:, :, ::1], _N, int64, _N, _M, _A,
    ),
    makes_arrays=True,
    **REORDER,
)  # fmt: skip
def score_pass(
    dt, e, K_all, per_sigma_all, H_all, F_all, F_of, refresh, stretch, by_noise, by_start
):  # fmt: skip
    """Slope of the log-likelihood in the process noise, by the disturbance smoother, backwards.

    With r the slope in the predicted state and N its variance, the slope in a variance added to
    state i is (r_i^2 - N_ii) / 2 (Koopman and Shephard 1992, Biometrika 79: the exact score of a
    linear model; here of the model as linearised along the filter's path).

    Args:
        dt, e, K_all, per_sigma_all, H_all, F_all, F_of, refresh: of the filter pass.
        stretch: (n,) which stretch of time each row is in.
        by_noise: (stretches, nx) slope in each state's growth of variance per second, out.
        by_start: (nx,) slope in each variance of the first state, out.
    """
    n, m = e.shape
    nx = by_start.size
    width = _whole_blocks(nx)
    r = np.zeros(nx)
    N = np.zeros((nx, width))
    NF = np.zeros((nx, width))
    B = np.zeros((nx, width))
    moved = np.zeros(nx)
    NK = np.zeros(width)
    K = np.zeros(width)
    FT = np.zeros((nx, nx))
    F_places = np.zeros((nx, nx), dtype=np.int64)
    F_counts = np.zeros(nx, dtype=np.int64)
    H = np.zeros((m, nx))
    H_places = np.zeros((m, nx), dtype=np.int64)
    H_counts = np.zeros(m, dtype=np.int64)
    F_slot = H_slot = -1
    there = per_sigma_all.size
    by_noise[:, :] = 0.0
    for k in range(n - 1, -1, -1):
        if k < n - 1:
            for i in range(nx):
                by_noise[stretch[k], i] += 0.5 * dt[k] * (r[i] * r[i] - N[i, i])
            if F_of[k] != F_slot:
                F_slot = F_of[k]
                for i in range(nx):
                    for j in range(nx):
                        FT[j, i] = F_all[F_slot, i, j]
                _non_zeros(FT, F_places, F_counts)
            # r = F' r, N = F' (F' N)'
            for i in range(nx):
                moved[i] = 0.0
                for c in range(F_counts[i]):
                    moved[i] += FT[i, F_places[i, c]] * r[F_places[i, c]]
            _product(FT, F_places, F_counts, N, B)
            for i in range(nx):
                r[i] = moved[i]
                for j in range(nx):
                    NF[j, i] = B[i, j]
            _product(FT, F_places, F_counts, NF, N)
        if k // refresh != H_slot:
            H_slot = k // refresh
            _unpack(H_all, H_slot, H, H_places, H_counts)
        for b in range(m - 1, -1, -1):
            if math.isnan(e[k, b]):
                continue
            there -= 1
            # with A = I - K H: r = A' r + H' e / s, N = A' N A + H' H / s^2, where N loses the
            # symmetric part of twice H' w, w = N K - H' (K' N K + 1 / s^2) / 2
            pull = e[k, b] * per_sigma_all[there]
            curve = per_sigma_all[there] * per_sigma_all[there]
            for j in range(width):
                NK[j] = 0.0
            for i in range(nx):
                K[i] = K_all[there, i]
                pull -= K[i] * r[i]
                for j in range(width):
                    NK[j] += K[i] * N[i, j]
            for j in range(width):
                curve += K[j] * NK[j]
            for c in range(H_counts[b]):
                j = H_places[b, c]
                NK[j] -= 0.5 * curve * H[b, j]
                r[j] += H[b, j] * pull
            for c in range(H_counts[b]):
                a = H_places[b, c]
                weight = H[b, a]
                for j in range(width):
                    N[a, j] -= weight * NK[j]
                for i in range(nx):
                    N[i, a] -= weight * NK[i]
    for i in range(nx):
        by_start[i] = 0.5 * (r[i] * r[i] - N[i, i])


@compiled(
    boolean(
        STEP, MEASURE, _A, _M, _M, boolean[::1], _A, _A, int64,
        float32[:, ::1], _A, float32[:, :, ::1], int64, _M,
    ),
    makes_arrays=True,
    **REORDER,
)  # fmt: skip
def mean_pass(
    step, measure, dt, u, z, wraps, x0, p, work_size, K_all, per_sigma_all, H_all, refresh, e
):  # fmt: skip
    """Whitened innovations (n, m) of the mean with the gains of a filter pass; 0 where missing.

    Returns False where the mean diverged.
    """
    n, m = z.shape
    nx = x0.size
    x = x0.copy()
    x_next = np.zeros(nx)
    work = np.zeros(work_size)
    h = np.zeros(m)
    H = np.zeros((m, nx))
    H_places = np.zeros((m, nx), dtype=np.int64)
    H_counts = np.zeros(m, dtype=np.int64)
    there = 0
    for k in range(n):
        if k % refresh == 0:
            _unpack(H_all, k // refresh, H, H_places, H_counts)
        measure(x, u[k], p, work, h)
        for j in range(nx):
            x_next[j] = x[j]
        for i in range(m):
            e[k, i] = 0.0
            if not math.isnan(z[k, i]):
                residual = z[k, i] - h[i]
                if wraps[i]:
                    residual = wrap_angle(residual)
                if not math.isfinite(residual):
                    return False
                for c in range(H_counts[i]):
                    a = H_places[i, c]
                    residual -= H[i, a] * (x[a] - x_next[a])
                e[k, i] = residual * per_sigma_all[there]
                for j in range(nx):
                    x[j] += K_all[there, j] * residual
                there += 1
        if k < n - 1:
            step(x, u[k], dt[k], p, work, x_next)
            for j in range(nx):
                x[j] = x_next[j]
    return True


@compiled(
    types.void(
        STEP, MEASURE, _A, float64[:, :, ::1], _N, _M, _M, _M, _A, _M, _A, boolean[::1], boolean[::1],
        int64, float32[:, ::1], _A, float32[:, :, ::1], float32[:, :, ::1], _N, int64, _N, _M, _M,
    ),
    makes_arrays=True,
    **REORDER,
)  # fmt: skip
def signature_pass(
    both, measure, dt, u_sets, u_of, predicted, states, e, p, moved, steps, reading_only, exact,
    work_size, K_all, per_sigma_all, H_all, F_all, F_of, refresh, columns, J,
    by_channel,
):  # fmt: skip
    """Derivatives of the whitened innovations in many parameters at once, gains frozen.

    What `mean_pass` gives with a parameter moved a little, to first order: with s the state's
    derivative, and b what the parameter adds to the state over a row,

        dv = -(dh/dp + H s),   s += K dv  for one reading after the other,   s <- F (s + b/2) + b/2

    where `measure` at the predicted state gives dh/dp and the drift at the filtered one b (Maine and
    Iliff 1985, the sensitivity equations). A state that the drift takes exactly becomes F s + b.

    One look at one state would not do for both: b at the predicted state lacks what the row's readings
    told, and dh/dp at the filtered one would follow the innovation that it is compared with.

    Args:
        u_sets: (sets, n, nu) inputs, the first those of `p`; u_of: (k,) which of them a parameter has.
        predicted, states, e: of the filter pass. p: parameters; moved: (k, np) those with one moved,
            steps: (k,) by how much. reading_only: (k,) those that add nothing to the state.
        K_all, per_sigma_all, H_all, F_all, F_of, refresh: of the filter pass.
        columns: (k,) where in J and by_channel a parameter stands. J: derivatives, out, one row for
            each reading that there is, in the order of e. by_channel: (k or more, m) their squares
            summed, out.
    """
    n, m = e.shape
    k_all = steps.size
    there = 0
    nx = exact.size
    work = np.zeros(work_size)
    per_step = 1.0 / steps
    base = np.zeros(nx + m)
    here = np.zeros(nx + m)
    h_base = np.zeros(m)
    h_here = np.zeros(m)
    width = _whole_blocks(k_all)
    b = np.zeros((nx, width))
    dv = np.zeros((m, width))
    power = np.zeros((m, width))
    s = np.zeros((nx, width))
    half = np.zeros((nx, width))
    before = np.zeros((nx, width))
    F = np.zeros((nx, nx))
    F_places = np.zeros((nx, nx), dtype=np.int64)
    F_counts = np.zeros(nx, dtype=np.int64)
    H = np.zeros((m, nx))
    H_places = np.zeros((m, nx), dtype=np.int64)
    H_counts = np.zeros(m, dtype=np.int64)
    F_slot = -1
    for row in range(n):
        if row % refresh == 0:
            _unpack(H_all, row // refresh, H, H_places, H_counts)
        measure(predicted[row], u_sets[0, row], p, work, h_base)
        both(states[row], u_sets[0, row], dt[row], p, work, base)
        for k in range(k_all):
            measure(predicted[row], u_sets[u_of[k], row], moved[k], work, h_here)
            for i in range(m):
                dv[i, k] = (h_base[i] - h_here[i]) * per_step[k]
            if not reading_only[k]:
                both(states[row], u_sets[u_of[k], row], dt[row], moved[k], work, here)
                for i in range(nx):
                    b[i, k] = (here[i] - base[i]) * per_step[k]
        for i in range(m):
            if math.isnan(e[row, i]):
                continue
            for c in range(H_counts[i]):
                j = H_places[i, c]
                weight = H[i, j]
                for k in range(width):
                    dv[i, k] -= weight * s[j, k]
            for j in range(nx):
                gain = float64(K_all[there, j])
                for k in range(width):
                    s[j, k] += gain * dv[i, k]
            for k in range(width):
                dv[i, k] *= per_sigma_all[there]
                power[i, k] += dv[i, k] * dv[i, k]
            for k in range(k_all):
                J[there, columns[k]] = dv[i, k]
            there += 1
        if row == n - 1:
            break
        if F_of[row] != F_slot:
            F_slot = F_of[row]
            _unpack(F_all, F_slot, F, F_places, F_counts)
        for j in range(nx):
            for k in range(width):
                half[j, k] = s[j, k] + 0.5 * b[j, k]
                before[j, k] = s[j, k]
        for i in range(nx):
            source = before if exact[i] else half
            own = 1.0 if exact[i] else 0.5
            for k in range(width):
                s[i, k] = own * b[i, k]
            for c in range(F_counts[i]):
                j = F_places[i, c]
                weight = F[i, j]
                for k in range(width):
                    s[i, k] += weight * source[j, k]
    for k in range(k_all):
        for i in range(m):
            by_channel[columns[k], i] = power[i, k]


@compiled(boolean(STEP, MEASURE, _A, _M, _A, _A, int64, int64, int64[::1], _A), makes_arrays=True)
def fly_open_loop(step, measure, dt, u, x, p, work_size, first, targets, out):
    """Fly from row `first` with the recorded inputs; read each channel at its own row.

    Args:
        x: (nx,) state at `first`; on return the state at the last target.
        targets: (m,) row at which each channel is read, or -1. out: (m,) readings.

    Returns False where the flight diverged.
    """
    work = np.zeros(work_size)
    x_next = np.zeros(x.size)
    h = np.zeros(out.size)
    last = targets.max()
    for k in range(first, last + 1):
        wanted = False
        for i in range(out.size):
            if targets[i] == k:
                wanted = True
        if wanted:
            measure(x, u[k], p, work, h)
            for i in range(out.size):
                if targets[i] == k:
                    out[i] = h[i]
        if k < last:
            step(x, u[k], dt[k], p, work, x_next)
            for j in range(x.size):
                x[j] = x_next[j]
                if not abs(x[j]) < 1e4:
                    return False
    return True
