"""A model as the compiled passes fly it: functions, differences of them, flight without readings."""

from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, types
from numba.extending import typeof_impl

from coax_env.estimation.sparse import REORDER, aligned
from coax_env.kernel.compilation import compiled, compiled_when_called, pointer
from coax_env.kernel.simd import SIMD_WIDTH, simd_blocks

VECTOR = float64[::1]
MATRIX = float64[:, ::1]
INDICES = int64[::1]
STEP = types.FunctionType(types.void(VECTOR, VECTOR, float64, VECTOR, VECTOR, VECTOR))
MEASURE = types.FunctionType(types.void(VECTOR, VECTOR, VECTOR, VECTOR, VECTOR))
LANES_STEP = types.FunctionType(types.void(MATRIX, MATRIX, float64, MATRIX, MATRIX, MATRIX))
LANES_MEASURE = types.FunctionType(types.void(MATRIX, MATRIX, MATRIX, MATRIX, MATRIX))


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
    of_noise: np.ndarray
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
            np.array(getattr(model, "of_noise", np.zeros(len(model.exact))), bool),
            np.ascontiguousarray(model.wraps, bool),
            np.ascontiguousarray(model.state_scale, float),
            int(model.work_size),
            np.ascontiguousarray(model.noise_places, np.int64),
            side_by_side is not None,
            *(side_by_side or (_no_motion, _no_readings, _no_motion)),
        )


MODEL = types.NamedTuple(
    [STEP, MEASURE, STEP, boolean[::1], boolean[::1], boolean[::1], VECTOR, int64, int64[:, ::1],
     boolean, LANES_STEP, LANES_MEASURE, LANES_STEP], CompiledModel
)  # fmt: skip


@typeof_impl.register(CompiledModel)
def _type_of_model(model: CompiledModel, context: Any) -> types.Type:
    """MODEL, whatever numba would find out: to look at the functions costs 50 us a call."""
    return MODEL


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


@compiled(
    types.void(
        STEP, VECTOR, VECTOR, float64, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX
    ),
    **REORDER,
)
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


@compiled_when_called(types.void(MODEL, MATRIX, VECTOR, VECTOR, MATRIX), makes_arrays=True)
def read(model, states, u, p, out):
    """Readings of states, each by itself.

    Args:
        model: a CompiledModel. states: (s, nx). u: (nu,) the input of them all.
        p: (np,) the model's parameters. out: (s, m) readings.
    """
    work = np.zeros(model.work_size)
    for s in range(states.shape[0]):
        model.measure(states[s], u, p, work, out[s])


@compiled()
def _fly_from(model, dt, u, x, p, first, last, targets, work, x_next, h, out):
    """`fly_open_loop` from one row to the last target, in arrays that are there; whether it stayed
    finite.
    """
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


@compiled_when_called(
    boolean(MODEL, VECTOR, MATRIX, MATRIX, VECTOR, INDICES, int64[:, ::1], MATRIX),
    makes_arrays=True,
)
def fly_open_loop(model, dt, u, x, p, first, targets, out):
    """Predict alone: fly from some rows with the recorded inputs; read each channel at its own row.

    Args:
        model: a CompiledModel. dt, u: as in RunData. p: (np,) the model's parameters.
        x: (s, nx) states at the rows `first` (s,); on return those at the last targets.
        targets: (s, m) row at which each channel is read, or -1. out: (s, m) readings.

    Returns:
        False where a flight diverged.
    """
    work = np.zeros(model.work_size)
    x_next = np.zeros(x.shape[1])
    h = np.zeros(out.shape[1])
    finite = True
    for s in range(x.shape[0]):
        last = targets[s].max()
        finite &= _fly_from(
            model, dt, u, x[s], p, first[s], last, targets[s], work, x_next, h, out[s]
        )
    return finite
