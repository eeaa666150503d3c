"""The filter's mean with its gains frozen: the filter error method.

The mean pass repeats only the propagation of the mean with the gains of a filter pass: with a
parameter moved a little, the change of the whitened innovations e is that parameter's *signature*.
The signature pass gives the same to first order, for many parameters at once.

Maine and Iliff 1985 (NASA RP-1138).
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float32, float64, int64, types

from coax_env.estimation.compiled_model import (
    INDICES,
    MATRIX,
    MODEL,
    VECTOR,
    in_every_lane,
    lanes_of,
)
from coax_env.estimation.pass_data import GAINS, RUN_DATA, TRACE, how_many
from coax_env.estimation.sparse import (
    FOUR,
    ONE,
    REORDER,
    THREE,
    TWO,
    aligned,
    four_of_product,
    in_fours,
    padded,
    three_of_product,
    unpack,
    with_places,
)
from coax_env.kernel.angles import wrap_angle
from coax_env.kernel.compilation import compiled, compiled_when_called
from coax_env.kernel.simd import SIMD_WIDTH, simd_blocks


@compiled_when_called(
    boolean(MODEL, RUN_DATA, VECTOR, VECTOR, GAINS, int64, MATRIX), makes_arrays=True, **REORDER
)
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
    shown = gains.shown[: how_many(gains.shown)]
    H = with_places(np.zeros((m, padded(shown.size))), shown.size)
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
                    a = shown[H.places[i, c]]
                    residual -= H.values[i, H.places[i, c]] * (x[a] - x_next[a])
                e[k, i] = residual * gains.per_sigma[reading]
                for j in range(shown.size):
                    x[shown[j]] += gains.K[reading, j] * residual
                reading += 1
        if k < n - 1:
            model.step(x, run.u[k], run.dt[k], p, work, x_next)
            for j in range(nx):
                x[j] = x_next[j]
    return True


@compiled_when_called(
    types.void(MODEL, RUN_DATA, VECTOR, VECTOR, MATRIX, float64[:, :, ::1], GAINS, int64, MATRIX),
    makes_arrays=True, **REORDER,
)  # fmt: skip
def mean_passes(model, run, x0, p, moved, u, gains, refresh, e):
    """`mean_pass` of SIMD_WIDTH parameter vectors at once; not finite where one diverged.

    Args:
        model: a CompiledModel that has lanes. run: RunData. x0: (nx,) first state. p: (np,) the
            parameters of the filter pass.
        moved: (np, SIMD_WIDTH) parameters, a column each. u: (SIMD_WIDTH, n, nu) their inputs.
        gains, refresh: of the filter pass.
        e: (readings, SIMD_WIDTH) whitened innovations, out, in the order of the filter's.
    """
    n, m = run.z.shape
    nx, nu = x0.size, u.shape[2]
    lanes = lanes_of(nx, nu, p, model.work_size, m)
    x, out, found = simd_blocks(lanes.x), simd_blocks(lanes.out), simd_blocks(e)
    predicted = aligned(nx, SIMD_WIDTH)
    before = simd_blocks(predicted)
    in_every_lane(x0, lanes.x)
    shown = gains.shown[: how_many(gains.shown)]
    H = with_places(np.zeros((m, padded(shown.size))), shown.size)
    reading = np.uint64(0)
    for k in range(n):
        if k % refresh == 0:
            unpack(gains.H, k // refresh, H)
        for lane in range(SIMD_WIDTH):
            for i in range(nu):
                lanes.u[i, lane] = u[lane, k, i]
        model.measure_of_lanes(lanes.x, lanes.u, moved, lanes.work, lanes.out)
        for j in range(nx):
            before[j] = x[j]
        for i in range(m):
            if math.isnan(run.z[k, i]):
                continue
            residuals = run.z[k, i] - out[i]
            if model.wraps[i]:
                residuals = wrap_angle(residuals)
            for c in range(H.counts[i]):
                a = shown[H.places[i, c]]
                residuals -= H.values[i, H.places[i, c]] * (x[a] - before[a])
            found[reading] = residuals * gains.per_sigma[reading]
            for j in range(shown.size):
                x[shown[j]] += float64(gains.K[reading, j]) * residuals
            reading += ONE
        if k < n - 1:
            model.step_of_lanes(lanes.x, lanes.u, run.dt[k], moved, lanes.work, lanes.out)
            for j in range(nx):
                x[j] = out[j]


class Moves(NamedTuple):
    """The parameters whose signatures are wanted, k of them, each moved by itself.

    p: (k, np) parameters with one moved. steps: (k,) by how much. reading_only: (k,) those that add
    nothing to the state, best first. u: (sets, n, nu) inputs, the first those of no move; u_of: (k,)
    which of them a move has. columns: (k,) where in J and by_channel a parameter stands.
    """

    p: np.ndarray
    steps: np.ndarray
    reading_only: np.ndarray
    u: np.ndarray
    u_of: np.ndarray
    columns: np.ndarray


class Portion(NamedTuple):
    """Rows `first` to `last` - 1 of a run; `reading`: how many readings there are before them."""

    first: int
    last: int
    reading: int


class Kept(NamedTuple):
    """The state's derivatives at some rows, before their readings: s (rows kept, nx, k or more), of the
    states that any reading shows, in their order; and places: (n,) where in it a row's stand, or -1;
    empty: of none.
    """

    s: np.ndarray
    places: np.ndarray


class _Signatures(NamedTuple):
    """The arrays that a signature pass works in: a row for each state that any reading shows, or for
    each reading, a column for each parameter, as many as are `padded`.
    """

    shown: Any  # (r,) those states
    exact: Any  # (r,) the model's

    s: Any  # derivatives of the state (r, width)
    b: Any  # what the parameters add to the state over a row
    half: Any  # s + b / 2
    before: Any  # s, a row ago
    dv: Any  # derivatives of the row's innovations (m, width)
    base: Any  # drift and readings (nx + m,) of no move
    here: Any  # and of one
    h_base: Any  # readings (m,) of no move
    h_here: Any
    work: Any  # the model's scratch
    lanes: Any  # kalman.Lanes
    groups: (
        Any  # parameters of SIMD_WIDTH moves in a row (groups, np, SIMD_WIDTH); of none, none moved
    )
    per_step: Any  # (width,) 1 / steps, 0 beyond the last
    still: int  # groups at first that never move the state
    power: Any  # sums of squares of dv, whitened (m, width)
    F: Any  # Sparse (r, r)
    H: Any  # Sparse (m, r)
    K: Any  # gain of one reading (r,)


MOVES = types.NamedTuple(
    [MATRIX, VECTOR, boolean[::1], float64[:, :, ::1], INDICES, INDICES], Moves
)
KEPT = types.NamedTuple([float32[:, :, ::1], INDICES], Kept)
PORTION = types.NamedUniTuple(int64, 3, Portion)


@compiled(**REORDER)
def _effects_in_lanes(row, model, dt, trace, moves, w):
    """`_effects_of_moves`, SIMD_WIDTH at once; after the last parameter comes none moved."""
    count, blocks = moves.steps.size, np.uint64(w.per_step.size // SIMD_WIDTH)
    state, u, lanes = trace.states[row], moves.u[0, row], w.lanes
    out, dv, added = simd_blocks(lanes.out), simd_blocks(w.dv), simd_blocks(w.b)
    per_step = simd_blocks(w.per_step)
    m, r = np.uint64(w.dv.shape[0]), np.uint64(w.shown.size)
    in_every_lane(u, lanes.u)
    for drifts in range(2):
        in_every_lane(state if drifts else trace.path.predicted[row], lanes.x)
        for g in range(w.still if drifts else 0, w.groups.shape[0]):
            first = g * SIMD_WIDTH
            last = min(first + SIMD_WIDTH, count)
            same = True
            for k in range(first, last):
                same &= moves.u_of[k] == 0
            if not same:
                for k in range(first, last):
                    for i in range(u.size):
                        lanes.u[i, k - first] = moves.u[moves.u_of[k], row, i]
            at = np.uint64(g)
            if drifts:
                model.drift_of_lanes(lanes.x, lanes.u, dt, w.groups[g], lanes.work, lanes.out)
                for i in range(r):
                    added[i * blocks + at] = out[np.uint64(w.shown[i])]
            else:
                model.measure_of_lanes(lanes.x, lanes.u, w.groups[g], lanes.work, lanes.out)
                for i in range(m):
                    dv[i * blocks + at] = out[i]
            if not same:
                in_every_lane(u, lanes.u)
    for i in range(m):
        base = w.dv[i, count]
        for b in range(blocks):
            dv[i * blocks + b] = (base - dv[i * blocks + b]) * per_step[b]
    for i in range(r):
        base = w.b[i, count]
        for b in range(np.uint64(w.still), blocks):
            added[i * blocks + b] = (added[i * blocks + b] - base) * per_step[b]


@compiled(makes_arrays=True)
def _groups_of(moves, p):
    """Parameters of the moves and of none, (groups, np, SIMD_WIDTH), and the groups `still`."""
    count = moves.steps.size
    groups = np.zeros((count // SIMD_WIDTH + 1, p.size, SIMD_WIDTH))
    still = 0
    for g in range(groups.shape[0]):
        moving = False
        for lane in range(SIMD_WIDTH):
            k = g * SIMD_WIDTH + lane
            one = moves.p[k] if k < count else p
            moving |= k >= count or not moves.reading_only[k]
            for i in range(p.size):
                groups[g, i, lane] = one[i]
        if not moving and still == g:
            still = g + 1
    return groups, still


@compiled(**REORDER)
def _effects_of_moves(row, model, dt, trace, p, moves, w):
    """dv = -dh/dp at the predicted state and b at the filtered one, of one row."""
    predicted, state, u = trace.path.predicted[row], trace.states[row], moves.u[0, row]
    m = w.h_base.size
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
            for i in range(w.shown.size):
                w.b[i, k] = (w.here[w.shown[i]] - w.base[w.shown[i]]) * per_step


@compiled(**REORDER)
def _take_in(i, H, gain, w):
    """Reading `i`: dv = dv - H s, s = s + K dv."""
    for a in range(w.K.size):
        w.K[a] = gain[a]  # in doubles once, and not for each register
    blocks = np.uint64(w.s.shape[1] // SIMD_WIDTH)
    s, dv = simd_blocks(w.s), simd_blocks(w.dv)
    at = np.uint64(i) * blocks
    for b in range(blocks):
        change = dv[at + b]
        for c in range(H.counts[i]):
            j = np.uint64(H.places[i, c])
            change -= H.values[i, j] * s[j * blocks + b]
        dv[at + b] = change
        for a in range(np.uint64(w.shown.size)):
            s[a * blocks + b] += w.K[a] * change


@compiled(**REORDER)
def _propagate(F, w):
    """s = F (s + b/2) + b/2; of a state that the drift takes exactly F s + b."""
    r, blocks = np.uint64(w.shown.size), np.uint64(w.s.shape[1] // SIMD_WIDTH)
    s, added = simd_blocks(w.s), simd_blocks(w.b)
    half, before = simd_blocks(w.half), simd_blocks(w.before)
    fours = in_fours(blocks)
    for a in range(r * blocks):
        half[a] = s[a] + 0.5 * added[a]
        before[a] = s[a]
    for i in range(r):
        source = before if w.exact[i] else half
        own = 1.0 if w.exact[i] else 0.5
        for b in range(np.uint64(0), fours, FOUR):
            first, second, third, fourth = four_of_product(F, i, source, b, blocks)
            at = i * blocks + b
            s[at], s[at + ONE] = own * added[at] + first, own * added[at + ONE] + second
            s[at + TWO] = own * added[at + TWO] + third
            s[at + THREE] = own * added[at + THREE] + fourth
        if fours < blocks:
            first, second, third = three_of_product(F, i, source, fours, blocks)
            at = i * blocks + fours
            s[at], s[at + ONE] = own * added[at] + first, own * added[at + ONE] + second
            s[at + TWO] = own * added[at + TWO] + third


@compiled(**REORDER)
def _signature_rows(model, dt, trace, p, moves, refresh, portion, J, kept, w):
    """`signature_pass` in arrays that are there."""
    n, m = trace.e.shape
    k_all, width = moves.steps.size, w.s.shape[1]
    F_slot, reading = -1, portion.reading
    for row in range(portion.first, portion.last):
        at = kept.places[row] if kept.places.size else -1
        if at >= 0:
            for j in range(w.shown.size):
                for k in range(k_all):
                    kept.s[at, j, moves.columns[k]] = w.s[j, k]
        if row % refresh == 0 or row == portion.first:
            unpack(trace.gains.H, row // refresh, w.H)
        if model.has_lanes:
            _effects_in_lanes(row, model, dt[row], trace, moves, w)
        else:
            _effects_of_moves(row, model, dt[row], trace, p, moves, w)
        for i in range(m):
            if math.isnan(trace.e[row, i]):
                continue
            _take_in(i, w.H, trace.gains.K[reading], w)
            for k in range(width):
                w.dv[i, k] *= trace.gains.per_sigma[reading]
                w.power[i, k] += w.dv[i, k] * w.dv[i, k]
            for k in range(k_all):
                J[reading - portion.reading, moves.columns[k]] = w.dv[i, k]
            reading += 1
        if row == n - 1:
            break
        if trace.path.F_of[row] != F_slot:
            F_slot = trace.path.F_of[row]
            unpack(trace.path.F, F_slot, w.F)
        _propagate(w.F, w)


@compiled_when_called(
    types.void(MODEL, VECTOR, TRACE, VECTOR, MOVES, int64, PORTION, MATRIX, MATRIX, MATRIX, KEPT),
    makes_arrays=True, **REORDER,
)  # fmt: skip
def signature_pass(model, dt, trace, p, moves, refresh, portion, s, J, by_channel, kept):
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
        portion: Portion of the run. s: (nx, padded(k + 1)) the state's derivatives at its first row, on
            return at the one after its last; zeros where the run begins.
        J: derivatives, out, one row for each reading of the portion, in the order of the innovations.
        by_channel: (k or more, m) their squares, added.
        kept: Kept, out.
    """
    m, k_all = trace.e.shape[1], moves.steps.size
    nx, r, width = model.exact.size, how_many(trace.gains.shown), padded(k_all + 1)
    groups, still = _groups_of(moves, p)
    scratch = model.work_size if model.has_lanes else 0
    w = _Signatures(
        shown=trace.gains.shown[:r], exact=np.zeros(r, np.bool_),
        s=s, b=aligned(r, width), half=aligned(r, width),
        before=aligned(r, width), dv=aligned(m, width),
        base=np.zeros(nx + m), here=np.zeros(nx + m), h_base=np.zeros(m), h_here=np.zeros(m),
        work=np.zeros(model.work_size),
        lanes=lanes_of(nx, moves.u.shape[2], p, scratch, m),
        groups=groups, per_step=aligned(1, width)[0], still=still, power=aligned(m, width),
        F=with_places(aligned(r, padded(r)), r), H=with_places(aligned(m, padded(r)), r), K=np.zeros(r),
    )  # fmt: skip
    for i in range(r):
        w.exact[i] = model.exact[w.shown[i]]
    for k in range(k_all):
        w.per_step[k] = 1.0 / moves.steps[k]
    _signature_rows(model, dt, trace, p, moves, refresh, portion, J, kept, w)
    for k in range(k_all):
        for i in range(m):
            by_channel[moves.columns[k], i] += w.power[i, k]
