"""The extended Kalman filter over one run, as the textbook has it.

    predict   x = f(x, u),  P = F P F' + Q(dt)
    correct   v = z - h(x),  s^2 = H P H' + R,  K = P H' / s^2,  x = x + K v,  P = P - K H P

The readings of a row are taken in one after the other (their errors are independent), each with what
the ones before it have left open: its residual v, of variance s^2, gives a whitened innovation
e = v / s, and so the likelihood is

    -2 log L = sum over readings of  e^2 + log s^2 + log 2 pi.

F and H are mostly zero, and only what is not is multiplied (sparse.py); tests/test_kalman.py holds the
pass against the same filter with dense matrices. States that no reading shows, neither by itself nor
through others, have no covariance (transition.py): the likelihood is the same.

One departure from the book: both Jacobians are those at the predicted state, from one look at the
rates, and serve some rows (`refresh`); that of the first step is taken where the first readings have
put the state. What it stores, its gains K, 1 / s and Jacobians, is what the passes of frozen_gains.py
and noise_score.py work with.

Bar-Shalom, Li and Kirubarajan 2001, ch. 5 and 10; Durbin and Koopman 2012, sec. 6.4 (one reading at a
time); Maybeck 1979.
"""

import math

import numpy as np
from numba import float64, int64, types

from coax_env.estimation.compiled_model import MODEL, VECTOR
from coax_env.estimation.filter_arrays import arrays_of
from coax_env.estimation.pass_data import (
    COVARIANCES,
    RUN_DATA,
    TRACE,
    VARIANCES,
    strength_changes,
)
from coax_env.estimation.sparse import REORDER, along, find_non_zeros, multiply, row_of_product
from coax_env.estimation.transition import (
    find_shown,
    linearise,
    rescaled,
    shows_more,
    take_shown,
    transition,
)
from coax_env.kernel.angles import wrap_angle
from coax_env.kernel.compilation import compiled, compiled_when_called
from coax_env.kernel.simd import SIMD_WIDTH, simd_blocks, transpose

SAME_STEP = 1e-6
"""Steps that differ by no more of themselves are the same: what is left of a clock's rounding."""
LEAST, MOST = 1e-100, 1e100
"""Of a product of variances before its logarithm is taken; far from the least and largest number."""
SMALL = 1e-4
"""Of one and an input, by which that is moved to see what it does; ours."""
_LOG_2PI = math.log(2.0 * math.pi)


# --- correct ----------------------------------------------------------------------------------------


@compiled()
def _store_row(x, out):
    """A vector into one of those that the pass leaves."""
    for j in range(x.size):
        out[j] = x[j]


@compiled()
def _all_finite(x):
    """Whether all of a vector is finite."""
    for j in range(x.size):  # noqa: SIM110, numba has no all()
        if not math.isfinite(x[j]):
            return False
    return True


@compiled(**REORDER)
def _innovations(model, z, u, p, fresh, w):
    """v = z - h(x) of a row's readings; whether all are finite. `fresh`: readings are in `base`."""
    if fresh:
        _store_row(w.base[w.x.size :], w.h)
    else:
        model.measure(w.x, u, p, w.work, w.h)
    for i in range(z.size):
        if not math.isnan(z[i]):
            w.v[i] = z[i] - w.h[i]
            if model.wraps[i]:
                w.v[i] = wrap_angle(w.v[i])
            if not math.isfinite(w.v[i]):
                return False
    return True


@compiled(**REORDER)
def _gate(z, R, blur, gate, log_likelihood, w):
    """Variances of a row's readings, before any of them has been taken in.

    One further than `gate` sigmas from its prediction gets the variance that puts it at the gate.

    Returns:
        The log-likelihood, less what that takes off it, and how many readings are beyond the gate.
    """
    beyond = 0
    for i in range(z.size):
        if not math.isnan(z[i]):
            variance = R[i]
            if blur.size > i:
                variance += blur[i]
            w.noise[i] = variance
            w.beyond[i] = 0.0
            if w.v[i] * w.v[i] <= gate * gate * variance:
                continue  # however well the state is known
            for c in range(w.H.counts[i]):
                a = w.H.places[i, c]
                total = 0.0
                for d in range(w.H.counts[i]):
                    b = w.H.places[i, d]
                    total += w.P[a, b] * w.H.values[i, b]
                variance += total * w.H.values[i, a]
            if w.v[i] * w.v[i] > gate * gate * variance:
                inflated = w.v[i] * w.v[i] / (gate * gate)
                log_likelihood -= 0.5 * (gate * gate - 1.0) * math.log(inflated / variance)
                w.noise[i] += inflated - variance
                w.beyond[i] = 1.0 / variance
                beyond += 1
    return log_likelihood, beyond


@compiled(forceinline=True, **REORDER)
def _correct(i, w):
    """Take in reading `i` of a row: x = x + K v, P = P - K H P; returns v, s^2 and 1 / s."""
    r, blocks = np.uint64(w.K.size), np.uint64(w.HP.size // SIMD_WIDTH)
    P, HP = simd_blocks(w.P), simd_blocks(w.HP)
    residual = w.v[i] - along(w.H, i, w.correction)
    row_of_product(w.H, i, P, blocks, HP)
    variance = w.noise[i] + along(w.H, i, w.HP)
    per_sigma = 0.0
    if variance > 0.0:
        per_sigma = 1.0 / math.sqrt(variance)
        per_variance = per_sigma * per_sigma  # 1 / variance would become a division for each state
        for a in range(r):
            w.K[a] = weight = w.HP[a] * per_variance
            w.correction[a] += weight * residual
        for b in range(blocks):
            left = HP[b]
            for a in range(r):
                P[a * blocks + b] -= w.K[a] * left
    return residual, variance, per_sigma


# --- predict ----------------------------------------------------------------------------------------


@compiled(forceinline=True)
def growth(dt, decay):
    """What noise of unit intensity has added after `dt` seconds, decaying all the while [s].

    The variance of an Ornstein-Uhlenbeck process from nothing: (1 - exp(-2 decay dt)) / (2 decay).
    """
    if decay * dt < 1e-6:
        return dt
    return -math.expm1(-2.0 * decay * dt) / (2.0 * decay)


@compiled(**REORDER)
def _grow(assumed, dt, strength, k, w):
    """Growth of the covariance over row `k`, of `dt` seconds, into Q."""
    for e in range(assumed.q.size):
        i, j = w.places[e, 0], w.places[e, 1]
        if i >= 0 and j >= 0:
            w.Q[i, j] = w.Q[j, i] = 0.0
    for e in range(assumed.q.size):
        i, j = w.places[e, 0], w.places[e, 1]
        if i >= 0 and j >= 0:
            grown = assumed.q[e] * growth(dt, assumed.decay[e])
            if strength.block.size:
                grown *= strength.factor[strength.block[k], e]
            w.Q[i, j] += grown
            w.Q[j, i] = w.Q[i, j]


@compiled(**REORDER)
def _take_answers(model, u, dt, p, w):
    """What each of the first inputs does to the state a row later, into `answers`, per its unit."""
    model.step(w.x, u, dt, p, w.work, w.x_next)
    _store_row(u, w.u)
    for j in range(w.answers.shape[0]):
        w.u[j] += SMALL * (1.0 + abs(u[j]))
        change = w.u[j] - u[j]
        model.step(w.x, w.u, dt, p, w.work, w.answers[j])
        w.u[j] = u[j]
        for i in range(w.x.size):
            w.answers[j, i] = (w.answers[j, i] - w.x_next[i]) / change


@compiled(**REORDER)
def _grow_by_inputs(between, rows, w):
    """What inputs whose mean over a row is not known add to the growth of the covariance.

    Args:
        between: (k,) variance of each. rows: how long the row is, in those of `answers`.
    """
    for j in range(between.size):
        variance = between[j] * rows * rows
        for a in range(w.K.size):
            share = variance * w.answers[j, w.order[a]]
            for b in range(w.K.size):
                w.Q[a, b] += share * w.answers[j, w.order[b]]


@compiled(**REORDER)
def _predict(w):
    """P = F P F' + Q as F (F P)', and the mean of the step."""
    multiply(w.F, w.P, w.FP)
    transpose(w.FP, w.PF)
    multiply(w.F, w.PF, w.P)
    rows, grown = simd_blocks(w.P), simd_blocks(w.Q)
    for b in range(np.uint64(w.P.size // SIMD_WIDTH)):
        rows[b] += grown[b]
    for i in range(w.x.size):
        w.x[i] = w.x_next[i]


@compiled(**REORDER)
def _make_symmetric(P, nx):
    """The lower half into the upper one: rounding parts them, and what differs may grow."""
    for i in range(nx):
        for j in range(i):
            P[j, i] = P[i, j]


# --- the pass ---------------------------------------------------------------------------------------


@compiled()
def _store_matrix(A, rows, columns, out):
    """The first rows and columns of a matrix into one of those that the pass leaves."""
    for i in range(rows):
        for j in range(columns):
            out[i, j] = A[i, j]


@compiled()
def _store_square(A, order, out):
    """A matrix of the states that any reading shows, in their `order`, into one of all states."""
    for i in range(order.size):
        for j in range(order.size):
            out[order[i], order[j]] = A[i, j]


@compiled(forceinline=True, **REORDER)
def _filter_rows(model, run, assumed, p, gate, refresh, trace, covariances, w):
    """`filter_pass` in arrays that are there; and whether a reading came to show more states."""
    n, m = run.z.shape
    last = run.blur.shape[0] - 1
    r = w.K.size
    keep, follow = trace.gains.H.shape[0] > 0, trace.path.predicted.shape[0] == n
    log_likelihood = 0.0
    product = 1.0  # of variances whose logarithm is not yet in the likelihood: one for many
    deweighted, reading, F_slot = 0, 0, -1
    dt_of_F = dt_now = dt_of_Q = -1.0  # steps at which F and Q were computed, and F is scaled to
    dt_of_answers = -1.0
    for k in range(n):
        z, u, dt = run.z[k], run.u[k], run.dt[k]
        fresh = k % refresh == 0
        if fresh:
            _make_symmetric(w.P, r)
            linearise(model, u, dt, p, w)
            if shows_more(w):
                return log_likelihood, deweighted, True
            take_shown(w.x.size, w, w.H)
            find_non_zeros(w.H)
            if keep:
                _store_matrix(w.H.values, m, r, trace.gains.H[k // refresh])
        if follow:
            _store_row(w.x, trace.path.predicted[k])
        if not _innovations(model, z, u, p, fresh, w):
            return -np.inf, deweighted, False
        log_likelihood, beyond = _gate(
            z, assumed.R, run.blur[min(k, last)], gate, log_likelihood, w
        )
        deweighted += beyond
        for a in range(r):
            w.correction[a] = 0.0
        for i in range(m):
            trace.e[k, i] = np.nan
            if math.isnan(z[i]):
                continue
            residual, variance, per_sigma = _correct(i, w)
            if not variance > 0.0:
                return -np.inf, deweighted, False
            e = residual * per_sigma
            log_likelihood -= 0.5 * (e * e + _LOG_2PI)
            product *= variance
            if not LEAST < product < MOST:
                log_likelihood -= 0.5 * math.log(product)
                product = 1.0
            trace.e[k, i] = e
            if keep:
                _store_row(w.K, trace.gains.K[reading])
                trace.gains.per_sigma[reading] = per_sigma
            if follow:
                trace.path.beyond[reading] = w.beyond[i]
            reading += 1
        for a in range(r):
            w.x[w.order[a]] += w.correction[a]
        _store_row(w.x, trace.states[k])
        if not _all_finite(w.x):
            return -np.inf, deweighted, False
        if covariances.slots[k] >= 0:
            _store_square(w.P, w.order, covariances.P[covariances.slots[k]])
        if follow:
            for d in range(trace.path.decaying.size):
                at = w.place_of[trace.path.decaying[d]]
                for j in range(r):
                    trace.path.P[k, d, j] = w.P[at, j] if at >= 0 else 0.0
        if k == n - 1:
            break
        if run.between.size and (fresh or abs(dt - dt_of_answers) > 0.5 * dt_of_answers):
            _take_answers(model, u, dt, p, w)
            dt_of_answers = dt
        model.step(w.x, u, dt, p, w.work, w.x_next)
        changed = True
        if fresh or abs(dt - dt_of_F) > 0.5 * dt_of_F:
            if not fresh or k == 0:  # the first readings move the mean far
                linearise(model, u, dt, p, w)
                if shows_more(w):
                    return log_likelihood, deweighted, True
            transition(model, u, dt, p, w)
            dt_of_F = dt_now = dt
        elif abs(dt - dt_now) > SAME_STEP * dt_now:
            rescaled(w.F, dt / dt_now)
            dt_now = dt
        else:
            changed = False
        if follow:
            if changed:
                F_slot += 1
                _store_matrix(w.F.values, r, r, trace.path.F[F_slot])
            trace.path.F_of[k] = F_slot
        if abs(dt - dt_of_Q) > SAME_STEP * dt or strength_changes(run.strength, k, k - 1):
            _grow(assumed, dt, run.strength, k, w)
            dt_of_Q = dt
        if run.between.size:
            _grow_by_inputs(run.between[k], dt / dt_of_answers, w)
        _predict(w)
        if run.between.size:
            w.Q[:, :] = 0.0  # of the next row, whose inputs change otherwise
            dt_of_Q = -1.0
    return log_likelihood - 0.5 * math.log(product), deweighted, False


@compiled(makes_arrays=True)
def _channels_read(z):
    """Which channels (m,) have any reading in z (n, m)."""
    found = np.zeros(z.shape[1], np.bool_)
    for k in range(z.shape[0]):
        for i in range(z.shape[1]):
            found[i] |= not math.isnan(z[k, i])
    return found


@compiled_when_called(
    types.Tuple((float64, int64))(
        MODEL, RUN_DATA, VARIANCES, VECTOR, float64, int64, TRACE, COVARIANCES
    ),
    makes_arrays=True,
    **REORDER,
)
def filter_pass(model, run, assumed, p, gate, refresh, trace, covariances):
    """Extended Kalman filter over one run.

    Covariances and gains are those of the states that any reading shows, of all where covariances are
    asked for. Which these are the first row says; where one more comes to be shown, the pass begins
    again.

    Args:
        model: a CompiledModel. run: RunData. assumed: Variances. p: (np,) the model's parameters.
        gate: readings further than this many sigmas from their prediction are believed less, as if
            their variance put them at the gate: beyond it the cost grows with the logarithm of the
            distance, without a jump (a heavy tail; Huber and Ronchetti 2009, ch. 7). A lasting one
            is followed all the same, slowly at first.
        refresh: rows between new Jacobians where dt does not change.
        trace: a Trace, out. covariances: Covariances, out.

    Returns:
        log-likelihood (-inf where the filter diverged) and the number of readings beyond the gate.
    """
    nx = assumed.x0.size
    shown = np.full(nx, True)
    channels = _channels_read(run.z)
    if covariances.P.shape[0] == 0:
        w = arrays_of(model, run, assumed, p, shown, channels)
        linearise(model, run.u[0], run.dt[0], p, w)
        shown[:] = False
        find_shown(w.AH, w.order, channels, shown)
    while True:
        w = arrays_of(model, run, assumed, p, shown, channels)
        for j in range(nx):
            trace.gains.shown[j] = w.order[j] if j < w.K.size else -1
        log_likelihood, beyond, more = _filter_rows(
            model, run, assumed, p, gate, refresh, trace, covariances, w
        )
        if not more:
            return log_likelihood, beyond
        if shown.all():  # a Jacobian that is not finite shows anything
            return -np.inf, beyond
        known = shown.sum()
        find_shown(w.AH, w.order, channels, shown)
        if shown.sum() == known:
            shown[:] = True
