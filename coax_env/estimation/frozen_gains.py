"""The filter's mean with its gains frozen: the filter error method.

The mean pass repeats only the propagation of the mean with the gains of a filter pass: with a
parameter moved a little, the change of the whitened innovations e is that parameter's *signature*.
The signature pass gives the same to first order, for many parameters at once.

Maine and Iliff 1985 (NASA RP-1138).
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types

from coax_env.estimation.kalman import (
    _A,
    _M,
    _N,
    GAINS,
    MODEL,
    RUN_DATA,
    TRACE,
)
from coax_env.estimation.sparse import REORDER, padded, unpack, with_places
from coax_env.kernel.angles import wrap_angle
from coax_env.kernel.compilation import compiled


@compiled(boolean(MODEL, RUN_DATA, _A, _A, GAINS, int64, _M), makes_arrays=True, **REORDER)
def mean_pass(model, run, x0, p, gains, refresh, e):
    """Whitened innovations of the mean with the gains of a filter pass.

    Args:
        model: a CompiledModel. run: RunData. x0: (nx,) first state. p: (np,) the parameters.
        gains, refresh: of the filter pass. e: (n, m) whitened innovations, out, 0 where missing.

    Returns:
        False where the mean diverged.
    """
    n, m = run.z.shape
    nx = x0.size
    x = x0.copy()
    x_next = np.zeros(nx)
    work = np.zeros(model.work_size)
    h = np.zeros(m)
    H = with_places(np.zeros((m, nx)), nx)
    reading = 0
    for k in range(n):
        if k % refresh == 0:
            unpack(gains.H, k // refresh, H)
        model.measure(x, run.u[k], p, work, h)
        for j in range(nx):
            x_next[j] = x[j]
        for i in range(m):
            e[k, i] = 0.0
            if not math.isnan(run.z[k, i]):
                residual = run.z[k, i] - h[i]
                if model.wraps[i]:
                    residual = wrap_angle(residual)
                if not math.isfinite(residual):
                    return False
                for c in range(H.counts[i]):
                    a = H.places[i, c]
                    residual -= H.values[i, a] * (x[a] - x_next[a])
                e[k, i] = residual * gains.per_sigma[reading]
                for j in range(nx):
                    x[j] += gains.K[reading, j] * residual
                reading += 1
        if k < n - 1:
            model.step(x, run.u[k], run.dt[k], p, work, x_next)
            for j in range(nx):
                x[j] = x_next[j]
    return True


class Moves(NamedTuple):
    """The parameters whose signatures are wanted, k of them, each moved by itself.

    p: (k, np) parameters with one moved. steps: (k,) by how much. reading_only: (k,) those that add
    nothing to the state. u: (sets, n, nu) inputs, the first those of no move; u_of: (k,) which of
    them a move has. columns: (k,) where in J and by_channel a parameter stands.
    """

    p: np.ndarray
    steps: np.ndarray
    reading_only: np.ndarray
    u: np.ndarray
    u_of: np.ndarray
    columns: np.ndarray


class _Signatures(NamedTuple):
    """The arrays that a signature pass works in: a row for each state or reading, a column for each
    parameter, as many as are `padded`.
    """

    s: Any  # derivatives of the state (nx, width)
    b: Any  # what the parameters add to the state over a row
    half: Any  # s + b / 2
    before: Any  # s, a row ago
    dv: Any  # derivatives of the row's innovations (m, width)
    base: Any  # drift and readings (nx + m,) of no move
    here: Any  # and of one
    h_base: Any  # readings (m,) of no move
    h_here: Any
    work: Any  # the model's scratch


MOVES = types.NamedTuple([_M, _A, boolean[::1], float64[:, :, ::1], _N, _N], Moves)


@compiled(**REORDER)
def _effects_of_moves(row, model, dt, trace, p, moves, w):
    """dv = -dh/dp at the predicted state and b at the filtered one, of one row."""
    predicted, state, u = trace.path.predicted[row], trace.states[row], moves.u[0, row]
    m, nx = w.h_base.size, state.size
    model.measure(predicted, u, p, w.work, w.h_base)
    model.drift_and_readings(state, u, dt, p, w.work, w.base)
    for k in range(moves.steps.size):
        per_step = 1.0 / moves.steps[k]
        u = moves.u[moves.u_of[k], row]
        model.measure(predicted, u, moves.p[k], w.work, w.h_here)
        for i in range(m):
            w.dv[i, k] = (w.h_base[i] - w.h_here[i]) * per_step
        if not moves.reading_only[k]:
            model.drift_and_readings(state, u, dt, moves.p[k], w.work, w.here)
            for i in range(nx):
                w.b[i, k] = (w.here[i] - w.base[i]) * per_step


@compiled(**REORDER)
def _take_in(i, H, K, w):
    """Reading `i`: dv = dv - H s, s = s + K dv."""
    width = w.s.shape[1]
    for c in range(H.counts[i]):
        j = H.places[i, c]
        weight = H.values[i, j]
        for k in range(width):
            w.dv[i, k] -= weight * w.s[j, k]
    for j in range(K.size):
        gain = float64(K[j])
        for k in range(width):
            w.s[j, k] += gain * w.dv[i, k]


@compiled(**REORDER)
def _propagate(exact, F, w):
    """s = F (s + b/2) + b/2; of a state that the drift takes exactly F s + b."""
    nx, width = w.s.shape
    for j in range(nx):
        for k in range(width):
            w.half[j, k] = w.s[j, k] + 0.5 * w.b[j, k]
            w.before[j, k] = w.s[j, k]
    for i in range(nx):
        source = w.before if exact[i] else w.half
        own = 1.0 if exact[i] else 0.5
        for k in range(width):
            w.s[i, k] = own * w.b[i, k]
        for c in range(F.counts[i]):
            j = F.places[i, c]
            weight = F.values[i, j]
            for k in range(width):
                w.s[i, k] += weight * source[j, k]


@compiled(types.void(MODEL, _A, TRACE, _A, MOVES, int64, _M, _M), makes_arrays=True, **REORDER)
def signature_pass(model, dt, trace, p, moves, refresh, J, by_channel):
    """Derivatives of the whitened innovations in many parameters at once, gains frozen.

    What `mean_pass` gives with a parameter moved a little, to first order: with s the state's
    derivative, and b what the parameter adds to the state over a row,

        dv = -(dh/dp + H s),   s += K dv  for one reading after the other,   s <- F (s + b/2) + b/2

    where `measure` at the predicted state gives dh/dp and the drift at the filtered one b (the
    sensitivity equations). A state that the drift takes exactly becomes F s + b.

    One state alone would not do for both: b at the predicted state lacks what the row's readings
    correct, and dh/dp at the filtered one would follow the innovation that it is compared with.

    Args:
        model: a CompiledModel. dt: (n,) seconds from each row to the next.
        trace: of the filter pass, with gains and path; refresh: as there.
        p: (np,) the parameters of the filter pass. moves: Moves.
        J: derivatives, out, one row for each reading that there is, in the order of the innovations.
        by_channel: (k or more, m) their squares summed, out.
    """
    n, m = trace.e.shape
    nx, k_all = model.exact.size, moves.steps.size
    width = padded(k_all)
    w = _Signatures(
        s=np.zeros((nx, width)), b=np.zeros((nx, width)), half=np.zeros((nx, width)),
        before=np.zeros((nx, width)), dv=np.zeros((m, width)),
        base=np.zeros(nx + m), here=np.zeros(nx + m), h_base=np.zeros(m), h_here=np.zeros(m),
        work=np.zeros(model.work_size),
    )  # fmt: skip
    power = np.zeros((m, width))
    F = with_places(np.zeros((nx, nx)), nx)
    H = with_places(np.zeros((m, nx)), nx)
    F_slot = -1
    reading = 0
    for row in range(n):
        if row % refresh == 0:
            unpack(trace.gains.H, row // refresh, H)
        _effects_of_moves(row, model, dt[row], trace, p, moves, w)
        for i in range(m):
            if math.isnan(trace.e[row, i]):
                continue
            _take_in(i, H, trace.gains.K[reading], w)
            for k in range(width):
                w.dv[i, k] *= trace.gains.per_sigma[reading]
                power[i, k] += w.dv[i, k] * w.dv[i, k]
            for k in range(k_all):
                J[reading, moves.columns[k]] = w.dv[i, k]
            reading += 1
        if row == n - 1:
            break
        if trace.path.F_of[row] != F_slot:
            F_slot = trace.path.F_of[row]
            unpack(trace.path.F, F_slot, F)
        _propagate(model.exact, F, w)
    for k in range(k_all):
        for i in range(m):
            by_channel[moves.columns[k], i] = power[i, k]
