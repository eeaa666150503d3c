"""The extended Kalman filter over one run, as the textbook has it.

    predict   x = f(x, u),  P = F P F' + Q(dt)
    correct   v = z - h(x),  s^2 = H P H' + R,  K = P H' / s^2,  x = x + K v,  P = P - K H P

The readings of a row are taken in one after the other (their errors are independent), each with what
the ones before it have left open: its residual v, of variance s^2, gives a whitened innovation
e = v / s, and so the likelihood is

    -2 log L = sum over readings of  e^2 + log s^2 + log 2 pi.

F and H are mostly zero, and only what is not is multiplied (sparse.py); tests/test_kalman.py holds the
pass against the same filter with dense matrices. States that no reading shows, neither by itself nor
through others, have no covariance (`_find_shown`): the likelihood is the same.

One departure from the book: both Jacobians are those at the predicted state, from one look at the
rates, and serve some rows (`refresh`); that of the first step is taken where the first readings have
put the state. What it stores, its gains K, 1 / s and Jacobians, is what the passes of frozen_gains.py
and noise_score.py work with.

Bar-Shalom, Li and Kirubarajan 2001, ch. 5 and 10; Durbin and Koopman 2012, sec. 6.4 (one reading at a
time); Maybeck 1979.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float32, float64, int64, types
from numba.extending import typeof_impl

from coax_env.estimation.sparse import (
    REORDER,
    SPARSE,
    aligned,
    along,
    find_non_zeros,
    multiply,
    padded,
    row_of_product,
    with_places,
)
from coax_env.estimation.state_space import STEADY, Strength
from coax_env.kernel.angles import wrap_angle
from coax_env.kernel.compilation import compiled, compiled_when_called, pointer
from coax_env.kernel.simd import SIMD_WIDTH, negated, simd_blocks, transpose
from coax_env.kernel.simd import lanes as lanes_that

_A = float64[::1]
_M = float64[:, ::1]
_N = int64[::1]
STEP = types.FunctionType(types.void(_A, _A, float64, _A, _A, _A))
MEASURE = types.FunctionType(types.void(_A, _A, _A, _A, _A))
LANES_STEP = types.FunctionType(types.void(_M, _M, float64, _M, _M, _M))
LANES_MEASURE = types.FunctionType(types.void(_M, _M, _M, _M, _M))
MOST_DECAY = 0.5
"""Share of a state that may decay in a row for the series of the exponential to be used."""
SAME_STEP = 1e-6
"""Steps that differ by no more of themselves are the same: what is left of a clock's rounding."""
LEAST, MOST = 1e-100, 1e100
"""Of a product of variances before its logarithm is taken; far from the least and largest number."""
_LOG_2PI = math.log(2.0 * math.pi)


# --- what the passes are given and what they leave --------------------------------------------------


@pointer(LANES_STEP.signature)
def _no_motion(x, u, dt, p, work, out):
    """What stands for `step_of_lanes` and `drift_of_lanes` where a model has none."""


@pointer(LANES_MEASURE.signature)
def _no_readings(x, u, p, work, out):
    """What stands for `measure_of_lanes`."""


class CompiledModel(NamedTuple):
    """What compiled code needs of a model; see state_space.Model for each.

    has_lanes: whether it has `side_by_side`, the three `_of_lanes`.
    """

    step: Any
    measure: Any
    drift_and_readings: Any
    exact: np.ndarray
    wraps: np.ndarray
    scale: np.ndarray
    work_size: int
    noise_places: np.ndarray
    has_lanes: bool
    step_of_lanes: Any
    measure_of_lanes: Any
    drift_of_lanes: Any

    @classmethod
    def of(cls, model: Any) -> "CompiledModel":
        """That of a state_space.Model."""
        side_by_side = getattr(model, "side_by_side", None)
        return cls(
            model.step,
            model.measure,
            model.drift_and_readings,
            np.ascontiguousarray(model.exact, bool),
            np.ascontiguousarray(model.wraps, bool),
            np.ascontiguousarray(model.state_scale, float),
            int(model.work_size),
            np.ascontiguousarray(model.noise_places, np.int64),
            side_by_side is not None,
            *(side_by_side or (_no_motion, _no_readings, _no_motion)),
        )


class RunData(NamedTuple):
    """What a pass is given of a run.

    dt: (n,) seconds from each row to the next. u: (n, nu). z: (n, m), NaN where missing.
    strength: of its process noise, see state_space.Strength.
    """

    dt: np.ndarray
    u: np.ndarray
    z: np.ndarray
    strength: Strength = STEADY


class Variances(NamedTuple):
    """What the filter believes at first, and how much it believes.

    x0: (nx,) first state. P0: (nx, nx) its covariance. R: (m,) variances of the readings.
    q: (e,) intensity of the process noise in each of its entries, decay: (e,) rate [1/s] at which
    what it has added decays; see state_space.ProcessNoise.
    """

    x0: np.ndarray
    P0: np.ndarray
    R: np.ndarray
    q: np.ndarray
    decay: np.ndarray


class Gains(NamedTuple):
    """K: (readings, nx) and per_sigma: (readings,) 1 / s, of each reading that there is, in the order
    of the innovations. H: (n / refresh, m, nx) Jacobians of the readings; empty: not to be stored.

    shown: (nx,) the r states that any reading shows (`_find_shown`), then -1. States of K and H, and of
    F and P of the path, are these, r of nx and in this order; behind them is whatever was there.
    """

    K: np.ndarray
    per_sigma: np.ndarray
    H: np.ndarray
    shown: np.ndarray


class Path(NamedTuple):
    """What the filter linearised the model at; empty: not to be stored.

    F: (at most n, nx, nx) Jacobians of the step. F_of: (n,) which of them a row has.
    predicted: (n, nx) states before each row's readings.
    decaying: (d,) states whose rows of the filtered covariance are kept; P: (n, d, nx) those.
    beyond: (readings,) 1 / variance expected of a reading beyond the gate, 0 of one within it.
    """

    F: np.ndarray
    F_of: np.ndarray
    predicted: np.ndarray
    decaying: np.ndarray
    P: np.ndarray
    beyond: np.ndarray


class Trace(NamedTuple):
    """What a filter pass leaves, in arrays of its caller.

    states: (n, nx) filtered. e: (n, m) whitened innovations, NaN where there is no reading.
    """

    states: np.ndarray
    e: np.ndarray
    gains: Gains
    path: Path


class Covariances(NamedTuple):
    """Filtered covariances of some rows: P (slots, nx, nx), and each row's slot in it (n,), or -1."""

    P: np.ndarray
    slots: np.ndarray


class _Filter(NamedTuple):
    """The arrays that a pass works in; matrices are `padded` to the right.

    Of the r states that any reading shows, and in the order of `order`, are correction, P, K, H, F, A
    and what is as large; AH has the same order, the other states behind.
    """

    order: Any  # (nx,) states: those that any reading shows, then the others
    place_of: Any  # (nx,) a state's in it, -1 of the others
    places: Any  # (e, 2) of the process noise' entries in P, or -1
    exact: Any  # (r,) the model's
    channels: Any  # (m,) whether the run has any reading
    x: Any  # mean of all states
    P: Any  # covariance
    correction: Any  # what the row's readings have added to the mean
    x_next: Any  # mean a row later
    h: Any  # readings expected
    v: Any  # innovations, before any reading of the row
    noise: Any  # variances of the row's readings, larger beyond the gate
    beyond: Any  # 1 / variance expected where a reading is beyond it, else 0
    Q: Any  # growth of the covariance over the row
    K: Any  # gain of one reading
    HP: Any
    H: Any  # Sparse (m, r)
    F: Any  # Sparse (r, r)
    A: Any  # Sparse (r, r): Jacobian of the drift, from AH
    AA: Any
    AH: Any  # Jacobian of drift and readings (nx + m, nx)
    FP: Any
    PF: Any
    base: Any  # drift and readings (nx + m,) at the mean
    probe: Any  # a mean with one state moved
    moved: Any  # drift and readings there
    whole: Any  # a Jacobian of all states as they are (nx + m, nx)
    work: Any  # the model's scratch
    lanes: Any  # Lanes of moved states
    per_change: Any  # (width,) 1 / how far a state is moved, 0 beyond the last


class Lanes(NamedTuple):
    """What the model takes and gives of SIMD_WIDTH states, inputs and vehicles, a column each."""

    x: Any
    u: Any
    p: Any
    work: Any
    out: Any


@compiled()
def in_every_lane(values, out):
    """Numbers (n,) into (n, SIMD_WIDTH)."""
    rows = simd_blocks(out)
    for i in range(np.uint64(values.size)):
        rows[i] = values[i]


@compiled(makes_arrays=True)
def lanes_of(nx, nu, p, work_size, readings):
    """Lanes for so many states, inputs and readings, each with the parameters `p`.

    Args:
        nx, nu, readings: how many states, inputs, readings. p: parameter vector.
        work_size: of the model's scratch.
    """
    lanes = Lanes(
        aligned(nx, SIMD_WIDTH), aligned(nu, SIMD_WIDTH), aligned(p.size, SIMD_WIDTH),
        aligned(work_size, SIMD_WIDTH), aligned(nx + readings, SIMD_WIDTH),
    )  # fmt: skip
    in_every_lane(p, lanes.p)
    return lanes


MODEL = types.NamedTuple(
    [STEP, MEASURE, STEP, boolean[::1], boolean[::1], _A, int64, int64[:, ::1], boolean, LANES_STEP,
     LANES_MEASURE, LANES_STEP], CompiledModel
)  # fmt: skip
STRENGTH = types.NamedTuple([_N, _M], Strength)
RUN_DATA = types.NamedTuple([_A, _M, _M, STRENGTH], RunData)
VARIANCES = types.NamedTuple([_A, _M, _A, _A, _A], Variances)
GAINS = types.NamedTuple([float32[:, ::1], _A, float32[:, :, ::1], _N], Gains)
PATH = types.NamedTuple([float32[:, :, ::1], _N, _M, _N, float32[:, :, ::1], _A], Path)
TRACE = types.NamedTuple([_M, _M, GAINS, PATH], Trace)
COVARIANCES = types.NamedTuple([float64[:, :, ::1], _N], Covariances)


@typeof_impl.register(CompiledModel)
def _type_of_model(model: CompiledModel, context: Any) -> types.Type:
    """MODEL, whatever numba would find out: to look at the functions costs 50 us a call."""
    return MODEL


@compiled()
def how_many(shown):
    """Of states that any reading shows; see Gains."""
    count = 0
    while count < shown.size and shown[count] >= 0:
        count += 1
    return count


# --- linearise --------------------------------------------------------------------------------------


@compiled(types.void(STEP, _A, _A, float64, _A, _A, _A, _A, _A, _A, _M), **REORDER)
def differences(flow, x, u, dt, p, work, scale, base, probe, moved, out):
    """Jacobian in the state of a flow, or of its first values, by forward differences.

    Args:
        flow: ``(x, u, dt, p, work, out)``. x, u, dt, p, work: at what, with which scratch.
        scale: (nx,) how far each state is moved. base: what the flow gives at `x`.
        probe, moved: scratch, as long as `x` and as what the flow gives.
        out: (len(base), nx or more).
    """
    nx = x.size
    for j in range(nx):
        for i in range(nx):
            probe[i] = x[i]
        probe[j] += scale[j]
        flow(probe, u, dt, p, work, moved)
        per_change = 1.0 / scale[j]
        for i in range(base.size):
            out[i, j] = (moved[i] - base[i]) * per_change


@compiled(**REORDER)
def _linearise_in_lanes(model, u, dt, w):
    """`_linearise` with SIMD_WIDTH states moved at once; after the last comes one that is not."""
    nx, blocks = np.uint64(w.x.size), np.uint64(w.per_change.size // SIMD_WIDTH)
    out, table, per_change = simd_blocks(w.lanes.out), simd_blocks(w.AH), simd_blocks(w.per_change)
    in_every_lane(u, w.lanes.u)
    for b in range(w.x.size // SIMD_WIDTH + 1):
        first = b * SIMD_WIDTH
        in_every_lane(w.x, w.lanes.x)
        for j in range(first, min(first + SIMD_WIDTH, w.x.size)):
            w.lanes.x[w.order[j], j - first] += model.scale[w.order[j]]
        model.drift_of_lanes(w.lanes.x, w.lanes.u, dt, w.lanes.p, w.lanes.work, w.lanes.out)
        for i in range(nx):
            table[i * blocks + np.uint64(b)] = out[np.uint64(w.order[i])]
        for i in range(nx, np.uint64(w.base.size)):
            table[i * blocks + np.uint64(b)] = out[i]
    for i in range(np.uint64(w.base.size)):
        w.base[i] = base = w.AH[i, nx]
        for b in range(blocks):
            table[i * blocks + b] = (table[i * blocks + b] - base) * per_change[b]


@compiled(**REORDER)
def _linearise(model, u, dt, p, w):
    """Jacobians of the drift and of the readings at the mean, one under the other, into AH."""
    if model.has_lanes and w.per_change.size > w.x.size:
        _linearise_in_lanes(model, u, dt, w)
        return
    model.drift_and_readings(w.x, u, dt, p, w.work, w.base)
    differences(
        model.drift_and_readings,
        w.x,
        u,
        dt,
        p,
        w.work,
        model.scale,
        w.base,
        w.probe,
        w.moved,
        w.whole,
    )
    for i in range(w.base.size):
        row = w.order[i] if i < w.x.size else i
        for j in range(w.x.size):
            w.AH[i, j] = w.whole[row, w.order[j]]


@compiled()
def _take_shown(first, w, A):
    """Into A those rows of AH from `first` on, and of them the states that any reading shows."""
    long, wide = np.uint64(w.AH.shape[1] // SIMD_WIDTH), np.uint64(A.values.shape[1] // SIMD_WIDTH)
    rows, taken = simd_blocks(w.AH), simd_blocks(A.values)
    for i in range(np.uint64(A.counts.size)):
        since = (np.uint64(first) + i) * long
        for b in range(wide):
            taken[i * wide + b] = rows[since + b]


@compiled()
def _find_shown(AH, order, channels, shown):
    """Add to the states that any reading shows, itself or through what other states do with it.

    The others do nothing to the likelihood: their covariances and gains need not be known. Of a
    helicopter without a measured position these are north and east, and actuators without lags.

    Args:
        AH: (nx + m, nx or more) Jacobian of drift and readings. order: (nx,) of its states.
        channels: (m,) which of them have readings. shown: (nx,) truths, in place.
    """
    nx, more = shown.size, True
    while more:
        more = False
        for j in range(nx):
            for i in range(AH.shape[0]):
                counts = shown[order[i]] if i < nx else channels[i - nx]
                if counts and AH[i, j] != 0.0 and not shown[order[j]]:
                    shown[order[j]] = more = True


@compiled()
def _shows_more(w):
    """Whether a reading shows a state that none did before."""
    nx, r, blocks = w.x.size, w.K.size, np.uint64(w.AH.shape[1] // SIMD_WIDTH)
    rows, found = simd_blocks(w.AH), 0
    for b in range(r // SIMD_WIDTH, blocks):
        there = 0
        for i in range(w.AH.shape[0]):
            if i < r or (i >= nx and w.channels[i - nx]):
                there |= lanes_that(negated(rows[np.uint64(i) * blocks + np.uint64(b)] == 0.0))
        found |= there >> max(r - SIMD_WIDTH * b, 0)
    return found != 0


@compiled(types.boolean(boolean[::1], SPARSE, _M, SPARSE), **REORDER)
def exponential(exact, A, AA, F):
    """Jacobian F of a row as the exponential of that of its drift, A, to third order.

    F = I + A (I + A/2 (I + A/3)), a row at a time.

    Args:
        exact: (nx,) states that the drift takes exactly; their rows are I + A.
        A: Jacobian of the drift. AA: scratch (nx, padded). F: out.

    Returns:
        False where the row is too long for the series; F is not changed then.
    """
    nx = exact.size
    largest = 0.0
    for i in range(nx):
        if not exact[i]:
            largest = max(largest, abs(A.values[i, i]))
    if largest > MOST_DECAY:
        return False
    find_non_zeros(A)
    multiply(A, A.values, AA)
    blocks = np.uint64(F.values.shape[1] // SIMD_WIDTH)
    first, second, all_of_them = simd_blocks(A.values), simd_blocks(AA), simd_blocks(F.values)
    for i in range(np.uint64(nx)):
        for b in range(blocks):
            total = first[i * blocks + b]
            if not exact[i]:
                total += 0.5 * second[i * blocks + b]
                for c in range(A.counts[i]):
                    a = np.uint64(A.places[i, c])
                    total += A.values[i, a] / 6.0 * second[a * blocks + b]
            all_of_them[i * blocks + b] = total
        F.values[i, i] += 1.0
    find_non_zeros(F)
    return True


@compiled(**REORDER)
def _transition(model, u, dt, p, w):
    """F of a row: by the series of the exponential, else by differences of the step itself."""
    _take_shown(0, w, w.A)
    if not exponential(w.exact, w.A, w.AA, w.F):
        differences(
            model.step, w.x, u, dt, p, w.work, model.scale, w.x_next, w.probe, w.moved[: w.x.size],
            w.whole,
        )  # fmt: skip
        for i in range(w.K.size):
            for j in range(w.K.size):
                w.F.values[i, j] = w.whole[w.order[i], w.order[j]]
        find_non_zeros(w.F)


@compiled(inline="always", **REORDER)  # a call of its own rounds the last bit otherwise
def _rescaled(F, ratio):
    """The same Jacobian for another step: rows of slow states follow the step to first order."""
    nx = F.counts.size
    for i in range(nx):
        if F.values[i, i] > 0.5:
            for j in range(nx):
                own = 1.0 if i == j else 0.0
                F.values[i, j] = own + ratio * (F.values[i, j] - own)


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
def _gate(z, R, gate, log_likelihood, w):
    """Variances of a row's readings, before any of them has been taken in.

    One further than `gate` sigmas from its prediction gets the variance that puts it at the gate.

    Returns:
        The log-likelihood, less what that takes off it, and how many readings are beyond the gate.
    """
    beyond = 0
    for i in range(z.size):
        if not math.isnan(z[i]):
            w.noise[i] = R[i]
            w.beyond[i] = 0.0
            if w.v[i] * w.v[i] <= gate * gate * R[i]:
                continue  # however well the state is known
            variance = R[i]
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


@compiled()
def strength_changes(strength, k, other):
    """Whether process noise has another strength in row `k` than in the row `other`.

    Args:
        strength: of the process noise. k, other: rows.
    """
    return strength.block.size > 0 and strength.block[k] != strength.block[other]


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
    r = w.K.size
    keep, follow = trace.gains.H.shape[0] > 0, trace.path.predicted.shape[0] == n
    log_likelihood = 0.0
    product = 1.0  # of variances whose logarithm is not yet in the likelihood: one for many
    deweighted, reading, F_slot = 0, 0, -1
    dt_of_F = dt_now = dt_of_Q = -1.0  # steps at which F and Q were computed, and F is scaled to
    for k in range(n):
        z, u, dt = run.z[k], run.u[k], run.dt[k]
        fresh = k % refresh == 0
        if fresh:
            _make_symmetric(w.P, r)
            _linearise(model, u, dt, p, w)
            if _shows_more(w):
                return log_likelihood, deweighted, True
            _take_shown(w.x.size, w, w.H)
            find_non_zeros(w.H)
            if keep:
                _store_matrix(w.H.values, m, r, trace.gains.H[k // refresh])
        if follow:
            _store_row(w.x, trace.path.predicted[k])
        if not _innovations(model, z, u, p, fresh, w):
            return -np.inf, deweighted, False
        log_likelihood, beyond = _gate(z, assumed.R, gate, log_likelihood, w)
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
        model.step(w.x, u, dt, p, w.work, w.x_next)
        changed = True
        if fresh or abs(dt - dt_of_F) > 0.5 * dt_of_F:
            if not fresh or k == 0:  # the first readings move the mean far
                _linearise(model, u, dt, p, w)
                if _shows_more(w):
                    return log_likelihood, deweighted, True
            _transition(model, u, dt, p, w)
            dt_of_F = dt_now = dt
        elif abs(dt - dt_now) > SAME_STEP * dt_now:
            _rescaled(w.F, dt / dt_now)
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
        _predict(w)
    return log_likelihood - 0.5 * math.log(product), deweighted, False


@compiled(makes_arrays=True)
def _arrays_of(model, run, assumed, p, shown, channels):
    """The arrays of a pass, at the run's first row.

    Args:
        shown: (nx,) whether any reading shows a state. channels: (m,) whether the run has a reading.
    """
    nx, m = assumed.x0.size, assumed.R.size
    order, place_of, exact = np.zeros(nx, np.int64), np.full(nx, -1), np.zeros(nx, np.bool_)
    r = others = 0
    for j in range(nx):
        if shown[j]:
            order[r], place_of[j], exact[r] = j, r, model.exact[j]
            r += 1
        else:
            others += 1
            order[nx - others] = j
    places = np.zeros(model.noise_places.shape, np.int64)
    for e in range(places.shape[0]):
        places[e, 0] = place_of[model.noise_places[e, 0]]
        places[e, 1] = place_of[model.noise_places[e, 1]]
    long, wide = padded(nx), padded(r)
    scratch = model.work_size if model.has_lanes else 0
    w = _Filter(
        order=order, place_of=place_of, places=places, exact=exact[:r],
        channels=channels, x=assumed.x0.copy(), P=aligned(r, wide), correction=np.zeros(r),
        x_next=np.zeros(nx), h=np.zeros(m), v=np.zeros(m), noise=np.zeros(m),
        beyond=np.zeros(m), Q=aligned(r, wide), K=np.zeros(r), HP=aligned(1, wide)[0],
        H=with_places(aligned(m, wide), r), F=with_places(aligned(r, wide), r),
        A=with_places(aligned(r, wide), r), AA=aligned(r, wide), AH=aligned(nx + m, long),
        FP=aligned(wide, wide), PF=aligned(wide, wide), base=np.zeros(nx + m), probe=np.zeros(nx),
        moved=np.zeros(nx + m), whole=np.zeros((nx + m, nx)), work=np.zeros(model.work_size),
        lanes=lanes_of(nx, run.u.shape[1], p, scratch, m), per_change=aligned(1, long)[0],
    )  # fmt: skip
    for j in range(nx):
        w.per_change[j] = 1.0 / model.scale[order[j]]
    for i in range(r):
        for j in range(r):
            w.P[i, j] = assumed.P0[order[i], order[j]]
    return w


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
        MODEL, RUN_DATA, VARIANCES, _A, float64, int64, TRACE, COVARIANCES
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
        w = _arrays_of(model, run, assumed, p, shown, channels)
        _linearise(model, run.u[0], run.dt[0], p, w)
        shown[:] = False
        _find_shown(w.AH, w.order, channels, shown)
    while True:
        w = _arrays_of(model, run, assumed, p, shown, channels)
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
        _find_shown(w.AH, w.order, channels, shown)
        if shown.sum() == known:
            shown[:] = True


@compiled_when_called(types.void(MODEL, _M, _A, _A, _M), makes_arrays=True)
def read(model, states, u, p, out):
    """Readings of states, each by itself.

    Args:
        model: a CompiledModel. states: (s, nx). u: (nu,) the input of them all.
        p: (np,) the model's parameters. out: (s, m) readings.
    """
    work = np.zeros(model.work_size)
    for s in range(states.shape[0]):
        model.measure(states[s], u, p, work, out[s])


@compiled_when_called(boolean(MODEL, _A, _M, _A, _A, int64, _N, _A), makes_arrays=True)
def fly_open_loop(model, dt, u, x, p, first, targets, out):
    """Predict alone: fly from row `first` with the recorded inputs; read each channel at its own row.

    Args:
        model: a CompiledModel. dt, u: as in RunData. p: (np,) the model's parameters.
        x: (nx,) state at `first`; on return the state at the last target.
        targets: (m,) row at which each channel is read, or -1. out: (m,) readings.

    Returns:
        False where the flight diverged.
    """
    work = np.zeros(model.work_size)
    x_next = np.zeros(x.size)
    h = np.zeros(out.size)
    last = targets.max()
    for k in range(first, last + 1):
        wanted = False
        for i in range(out.size):
            if targets[i] == k:
                wanted = True
        if wanted:
            model.measure(x, u[k], p, work, h)
            for i in range(out.size):
                if targets[i] == k:
                    out[i] = h[i]
        if k < last:
            model.step(x, u[k], dt[k], p, work, x_next)
            for j in range(x.size):
                x[j] = x_next[j]
                if not abs(x[j]) < 1e4:
                    return False
    return True
