"""The arrays that a filter pass works in."""

from typing import Any, NamedTuple

import numpy as np

from coax_env.estimation.compiled_model import lanes_of
from coax_env.estimation.sparse import aligned, padded, with_places
from coax_env.kernel.compilation import compiled


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
    u: Any  # inputs of a row with one moved
    answers: Any  # (k, nx) of the state a row later to each of the first inputs, see RunData.between
    work: Any  # the model's scratch
    lanes: Any  # Lanes of moved states
    per_change: Any  # (width,) 1 / how far a state is moved, 0 of one at rest and beyond the last


@compiled()
def _rests(j, model, assumed):
    """Whether a state is nothing, and known to be: one of noise alone that no noise shakes.

    It does nothing to any reading, and so has no covariance. Such are errors that last of readings that
    have none: with all of them a pass takes more than twice as long.

    Args:
        j: the state. model: a CompiledModel. assumed: Variances.
    """
    if not model.of_noise[j]:
        return False
    for i in range(assumed.x0.size):
        if assumed.P0[j, i] != 0.0:
            return False
    for e in range(model.noise_places.shape[0]):
        if model.noise_places[e, 0] == j and assumed.q[e] != 0.0:
            return False
    return True


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
        moved=np.zeros(nx + m), whole=np.zeros((nx + m, nx)), u=np.zeros(run.u.shape[1]),
        answers=np.zeros((run.between.shape[1], nx)), work=np.zeros(model.work_size),
        lanes=lanes_of(nx, run.u.shape[1], p, scratch, m), per_change=aligned(1, long)[0],
    )  # fmt: skip
    for j in range(nx):
        if not _rests(order[j], model, assumed):
            w.per_change[j] = 1.0 / model.scale[order[j]]
    for i in range(r):
        for j in range(r):
            w.P[i, j] = assumed.P0[order[i], order[j]]
    return w
