"""The batch of SIMD_WIDTH rows of the fleet at a time, compiled for what its helicopters have.

`fly_of` compiles the loops of simd_loops.py for a `Makeup`, with its effects alone in them
(kernel/variants.py). Machine code is kept on disk, a variant each.
"""

import hashlib
from functools import cache
from typing import Any

import numpy as np
from numba import int64

from coax_env.env import period, simd_loops
from coax_env.env.arrays import Makeup
from coax_env.env.period import DELAYS, DT, SHORTEST_PART
from coax_env.env.simd_loops import next_group
from coax_env.env.threads import in_threads
from coax_env.errors import InputError
from coax_env.kernel.compilation import compiled, looked_up_once
from coax_env.kernel.simd import (
    REGISTERS,
    SIMD_WIDTH,
    gather,
    lane,
    scatter,
    select,
    simd_scratch,
    simd_view,
)
from coax_env.kernel.variants import inlined, under_names
from coax_env.model import effects
from coax_env.model.dynamics import WORK_SIZE, step_and_measure_with, step_bare
from coax_env.model.layout import N_FULL, N_INPUTS
from coax_env.model.vehicle import Vehicle

_COMMAND_DELAY, _SERVO_DELAY = (effects.parameter_index(name) for name in DELAYS)
_step = step_bare  # in a variant: the one with its effects

# --- delayed commands -----------------------------------------------------------------------------
# What parts of period.fly_period are for registers; the ring is (command_ring, which, rows, u_block).


def _slots_of_lanes(ring):
    return ring[0].shape[1]


def _delays_of_lanes(p):
    """As period._delays, one for all lanes."""
    rotors = max(lane(p[_COMMAND_DELAY], 0), 0.0)
    return rotors, rotors + max(lane(p[_SERVO_DELAY], 0), 0.0)


def _take_lanes(ring, row, late, since, first, u):
    """As period._take, lane by lane."""
    commands, which, rows, block = ring
    whole, rest = late
    back = whole + select(since < rest, 1.0, 0.0) + 0.0 * row
    for j in range(SIMD_WIDTH):
        i = which[j]
        slot = (rows[i] - int(lane(back, j))) % commands.shape[1]
        block[first, j] = commands[i, slot, first]
        block[first + 1, j] = commands[i, slot, first + 1]


def _fly_part_of_lanes(x, u, length, p, work):
    """As period._fly_part; a lane whose part has no length stays where it is."""
    flown = simd_scratch(N_FULL)
    _step(x, u, length, p, work, flown)
    for k in range(N_FULL):
        x[k] = select(length > SHORTEST_PART, flown[k], x[k])


# --- variants -------------------------------------------------------------------------------------


@cache
def fly_of(makeup: Makeup) -> Any:
    """`simd_loops.fly` for what a batch has: compiled, or found on disk, when it is first called."""
    kind = "bare" if not any(makeup) else _name_of(makeup)
    names: dict[str, Any] = {
        "OWN": makeup.own, "TURBULENT": makeup.turbulent, "DELAYED": makeup.delayed,
        "LATE": makeup.late,
        "SHAKES": any(name.startswith("vibration.") for name in makeup.used),
    }  # fmt: skip
    if makeup.used:
        names["_step"], names["_measure"] = step_and_measure_with(makeup.used, kind)
    if makeup.delayed:
        lanes: dict[str, Any] = {
            "_slots": _slots_of_lanes, "_take": _take_lanes, "_fly_part": _fly_part_of_lanes,
            "_step": names["_step"],
        }  # fmt: skip
        if makeup.own and not makeup.own_delays:
            lanes["_delays"] = _delays_of_lanes
        (names["_fly_delayed"],) = inlined((period.fly_period,), lanes, kind)

    def of(function: Any) -> Any:
        return compiled(makes_arrays=True)(under_names(function, names, kind))

    names["fly_rows"] = of(simd_loops.fly_rows)
    return looked_up_once(of(simd_loops.fly))


def takes_registers(effect: Any) -> bool:
    """Whether a compiled effect can be compiled for registers: whether no branch asks one of them."""
    try:
        effect.compile((REGISTERS, REGISTERS, REGISTERS, int64))
    except Exception:  # numba raises its own errors and, for unknown names, Python's
        return False
    return True


def _name_of(makeup: Makeup) -> str:
    """A word that tells a makeup from others."""
    return hashlib.sha256(repr(makeup).encode()).hexdigest()[:16]


# --- the dynamics alone ---------------------------------------------------------------------------


@compiled(makes_arrays=True)
def _dynamics_rows(first, last, x, u, p):
    which, active = np.empty(SIMD_WIDTH, np.int64), np.ones(len(x), np.bool_)
    x_block, u_block = np.empty((N_FULL, SIMD_WIDTH)), np.zeros((N_INPUTS, SIMD_WIDTH))
    x_, u_ = simd_view(x_block), simd_view(u_block)
    work, flown_ = simd_scratch(WORK_SIZE), simd_scratch(N_FULL)
    n, after = next_group(first, last, active, which)
    while n > 0:
        gather(x, which, x_block)
        gather(u, which, u_block)
        step_bare(x_, u_, DT, p, work, flown_)
        for k in range(N_FULL):
            x_[k] = flown_[k]
        scatter(x_block, which, n, x)
        n, after = next_group(after, last, active, which)


def fly_dynamics(x: np.ndarray, u: np.ndarray, vehicle: Vehicle, threads: int = 1) -> None:
    """The dynamics alone, of one vehicle without effects, over one control period and in place.

    No sensors, no task, no ends: what the env's speed is measured against.

    Args:
        x: full states, (count, 29). u: commands and time, (count, 5).
    """
    if vehicle.vector[effects.SWITCHES].any():
        raise InputError(f"vehicle {vehicle.name!r} has effects: this is for those without")
    in_threads(lambda a, b: _dynamics_rows(a, b, x, u, vehicle.vector), len(x), threads)
