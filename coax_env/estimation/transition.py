"""The filter's Jacobians, and which states any reading shows.

F is the exponential of the drift's Jacobian A, or taken by differences of the step itself. States that
no reading shows, neither by itself nor through others, do nothing to the likelihood and have no
covariance: `order` puts them behind the others.
"""

import numpy as np
from numba import boolean, types

from coax_env.estimation.compiled_model import MATRIX, differences, in_every_lane
from coax_env.estimation.sparse import REORDER, SPARSE, find_non_zeros, multiply
from coax_env.kernel.compilation import compiled
from coax_env.kernel.simd import SIMD_WIDTH, negated, simd_blocks
from coax_env.kernel.simd import lanes as lanes_that

MOST_DECAY = 0.5
"""Share of a state that may decay in a row for the series of the exponential to be used."""


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
        model.drift_and_readings, w.x, u, dt, p, w.work, model.scale, w.base, w.probe, w.moved,
        w.whole,
    )  # fmt: skip
    for i in range(w.base.size):
        row = w.order[i] if i < w.x.size else i
        for j in range(w.x.size):
            w.AH[i, j] = w.whole[row, w.order[j]] if w.per_change[j] > 0.0 else 0.0


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
