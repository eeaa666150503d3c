"""The filter's Jacobians, and which states any reading shows.

F is the exponential of the drift's Jacobian A, or taken by differences of the step itself. States that
no reading shows, neither by itself nor through others, do nothing to the likelihood and have no
covariance: `order` puts them behind the others.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import boolean, types

from coax_env.estimation.compiled_model import MATRIX, differences, in_every_lane, lanes_of
from coax_env.estimation.sparse import (
    REORDER,
    SPARSE,
    aligned,
    find_non_zeros,
    multiply,
    padded,
    with_places,
)
from coax_env.kernel.compilation import compiled
from coax_env.kernel.simd import SIMD_WIDTH, negated, simd_blocks
from coax_env.kernel.simd import lanes as lanes_that

MOST_DECAY = 0.5
"""Share of a state that may decay in a row for the series of the exponential to be used."""


class FilterArrays(NamedTuple):
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


@compiled(makes_arrays=True)
def arrays_of(model, run, assumed, p, shown, channels):
    """The arrays of a pass, at the run's first row.

    Args:
        model: a CompiledModel. run: RunData. assumed: Variances. p: (np,) the parameters.
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
    w = FilterArrays(
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


@compiled(**REORDER)
def linearise(model, u, dt, p, w):
    """Jacobians of the drift and of the readings at the mean, one under the other, into AH.

    Args:
        model: a CompiledModel. u: (nu,) input. dt: [s] to the next row. p: (np,) the parameters.
        w: FilterArrays, whose AH is written.
    """
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


@compiled(**REORDER)
def _linearise_in_lanes(model, u, dt, w):
    """`linearise` with SIMD_WIDTH states moved at once; after the last comes one that is not."""
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


@compiled()
def take_shown(first, w, A):
    """Into A those rows of AH from `first` on, and of them the states that any reading shows.

    Args:
        first: row of AH. w: FilterArrays. A: Sparse, out; its non-zeros are yet to be found.
    """
    long, wide = np.uint64(w.AH.shape[1] // SIMD_WIDTH), np.uint64(A.values.shape[1] // SIMD_WIDTH)
    rows, taken = simd_blocks(w.AH), simd_blocks(A.values)
    for i in range(np.uint64(A.counts.size)):
        since = (np.uint64(first) + i) * long
        for b in range(wide):
            taken[i * wide + b] = rows[since + b]


@compiled()
def find_shown(AH, order, channels, shown):
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
def shows_more(w):
    """Whether a reading shows a state that none did before; w: FilterArrays, with AH of the row."""
    nx, r, blocks = w.x.size, w.K.size, np.uint64(w.AH.shape[1] // SIMD_WIDTH)
    rows, found = simd_blocks(w.AH), 0
    for b in range(r // SIMD_WIDTH, blocks):
        there = 0
        for i in range(w.AH.shape[0]):
            if i < r or (i >= nx and w.channels[i - nx]):
                there |= lanes_that(negated(rows[np.uint64(i) * blocks + np.uint64(b)] == 0.0))
        found |= there >> max(r - SIMD_WIDTH * b, 0)
    return found != 0


@compiled(types.boolean(boolean[::1], SPARSE, MATRIX, SPARSE), **REORDER)
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
def transition(model, u, dt, p, w):
    """F of a row: by the series of the exponential, else by differences of the step itself.

    Args:
        model: a CompiledModel. u: (nu,) input. dt: [s] to the next row. p: (np,) the parameters.
        w: FilterArrays, with AH of the row; x_next is the step from its mean.
    """
    take_shown(0, w, w.A)
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
def rescaled(F, ratio):
    """The same Jacobian for another step: rows of slow states follow the step to first order."""
    nx = F.counts.size
    for i in range(nx):
        if F.values[i, i] > 0.5:
            for j in range(nx):
                own = 1.0 if i == j else 0.0
                F.values[i, j] = own + ratio * (F.values[i, j] - own)
