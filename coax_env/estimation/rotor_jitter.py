"""Rotor speeds that jitter: noise with a memory on top of the commanded speeds, and what it does.

Motors and their controllers hold a speed to some parts in a thousand, and lose it for tens of
milliseconds. Thrust and torque follow, measured speeds show it, and the body takes up the angular
momentum that a rotor gains. A rate that is shaken so and comes back looks like a damped one: taken for
the air's noise alone, such jitter was called yaw damping (and a gyro's scale) on clean flights.

What a motor does to a rotor the body feels at once. What the air does to it, as a wake that shakes its
torque, the body feels late, from the motor that brings the rotor back: J dw/dt = Q_motor - Q_air, and
the body takes up -Q_motor. Of a jitter w whose share s motors make, this is -(s J dw/dt - (1 - s) J w /
T), where T is the time of that return, a motor's lag; what a faster rotor's torque turns the body by is
the kernel's. Taken for motors', such jitter made a spin-up reaction of 1.77 +- 0.15 for 1, an inertia
35 % too large and a yaw damping on a flight of another simulator (`tests/blade_element.py`,
**synthetic**); 1.21 +- 0.08 since, and neither of these.

Two states more than the helicopter's own, in the filter alone, each with an exponential memory. The
rotors' speeds are the helicopter's plus these, and so no lag of a motor smooths them; the yaw rate is
the helicopter's plus what is taken up.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from coax_env.estimation import helicopter_noise
from coax_env.estimation.helicopter import (
    READ,
    HeliModel,
    Motion,
    _reads_another,
    _slower,
    _speed_up,
    _take_in_innovations,
    _turn_back,
    kernel_drift,
    kernel_measure,
    kernel_step,
)
from coax_env.estimation.helicopter_noise import (
    JITTER_LEVEL,
    JITTER_MEMORY,
    JITTER_REACTION,
    JITTER_RETURN,
)
from coax_env.estimation.state_space import Noise, ProcessNoise, Record
from coax_env.kernel.compilation import compiled
from coax_env.model import dynamics
from coax_env.model import inputs as U
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.generic_terms import hover_speeds
from coax_env.model.layout import N_CHANNELS, N_FULL, N_INPUTS

JITTER = slice(N_FULL, N_FULL + 2)
"""Of the upper and of the lower rotor [rad/s]."""
N_JITTERY = JITTER.stop

REACTION, REACTION_STD = 1.0, 0.5
"""Share of the jitter that motors make, and its std; above 1, rotors are heavier than the vehicle file
says. It is no parameter: gains that are held do not know what noise does (fitted so it ran to 2 where 1
was true, 700 nats downhill on a **synthetic** flight). Nor are rotors' inertias and motors' lags in it:
the inertias ran to 1.4 times their own, 81 nats downhill, where a spin-up reaction of 0.82 was 0.62;
ours."""
REACTION_BOUNDS = (0.05, 2.0)
JITTER_START = 1e-3
"""Share of the hover speeds with which a fit begins; ours."""
MEMORY_START, MEMORY_SPREAD = 0.05, 1.0
"""Median [s] of the jitter's memory and std of its logarithm; ours."""
MEMORY_BOUNDS = (0.015, 2.0)
"""[s]: below, it is white at 100 Hz; above, a trim."""

# behind the kernel's parameters
_MEMORY, _UPPER, _LOWER, _UPPER_BACK, _LOWER_BACK = -5, -4, -3, -2, -1

# of the scratch, behind the kernel's: the state without jitter, the input with it, drift and readings
_STATE = dynamics.WORK_SIZE
_INPUT = _STATE + N_FULL
_OUT = _INPUT + N_INPUTS
_WORK_SIZE = _OUT + N_FULL + N_CHANNELS


@compiled()
def _taken_up(x, p):
    """Yaw rate [rad/s] that the body has taken up of the rotors' jitter."""
    return p[p.size + _UPPER] * x[N_FULL] - p[p.size + _LOWER] * x[N_FULL + 1]


@compiled()
def _turned_back(x, p):
    """Yaw rate [rad/s] that motors give to the body until they have brought the rotors back."""
    return p[p.size + _LOWER_BACK] * x[N_FULL + 1] - p[p.size + _UPPER_BACK] * x[N_FULL]


@compiled()
def _shaken(x, u, p, work):
    """State and input as the helicopter's own model takes them, into the scratch; what is taken up.

    Speeds and commands alike are shifted: as if the commands were those that the rotors settle at with
    their jitter. So a lag brings the helicopter's own speeds where it would without, and a change of
    jitter is none of the commands: what `spin_up_reaction` gives to these is not counted twice.

    Args:
        x: (31,) state. u: (6,) the step's or the readings' part of the input. p, work: as everywhere.
    """
    taken = _taken_up(x, p)
    for i in range(N_FULL):
        work[_STATE + i] = x[i]
    work[_STATE + S.R] += taken
    work[_STATE + S.OMEGA_U] += x[N_FULL]
    work[_STATE + S.OMEGA_L] += x[N_FULL + 1]
    for i in range(N_INPUTS):
        work[_INPUT + i] = u[i]
    work[_INPUT + U.OMEGA_U] += x[N_FULL]
    work[_INPUT + U.OMEGA_L] += x[N_FULL + 1]
    return taken


def _step(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The helicopter's step with the jitter that a row begins with; jitter fades, motors turn it back.

    Not with the jitter of the row's mean: what shakes the rotors within a row is in the next row's, and
    of that the heading would never know. What motors turn back within the row it does.
    """
    for i in range(N_JITTERY):
        out[i] = x[i]
    _take_in_innovations(u, p, out)
    taken, (upper, lower) = _shaken(out, u, p, work), _slower(u, dt, p)
    state = work[_STATE:_INPUT]
    _speed_up(state, -upper, -lower)
    kernel_step(state, work[_INPUT:_OUT], dt, p, work, state)
    _speed_up(state, upper, lower)
    _turn_back(state, work, dt, p, upper, lower)
    for i in range(N_FULL):
        out[i] = state[i]
    out[S.R] -= taken
    out[S.OMEGA_U] -= out[N_FULL]
    out[S.OMEGA_L] -= out[N_FULL + 1]
    memory = p[p.size + _MEMORY]
    left = math.exp(-dt / memory)
    back = _turned_back(out, p)
    out[S.R] += (1.0 - left) * back
    out[S.PSI] += (dt - memory * (1.0 - left)) * back
    for i in range(N_FULL, N_JITTERY):
        out[i] *= left


def _measure(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    """The helicopter's readings."""
    _shaken(x, u[READ], p, work)
    kernel_measure(work[_STATE:_INPUT], work[_INPUT:_OUT], p, work, out)


def _drift_and_readings(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The helicopter's; jitter fades exactly, and what that does in a row the exponential knows."""
    own = work[_OUT:_WORK_SIZE]
    _shaken(x, u, p, work)
    upper, lower = _slower(u, dt, p)
    _speed_up(work[_STATE:_INPUT], -upper, -lower)
    kernel_drift(work[_STATE:_INPUT], work[_INPUT:_OUT], dt, p, work, own)
    if _reads_another(u):
        _shaken(x, u[READ], p, work)
        kernel_measure(work[_STATE:_INPUT], work[_INPUT:_OUT], p, work, own[N_FULL:])
    _take_in_innovations(u, p, own)
    left = math.exp(-dt / p[p.size + _MEMORY])
    for i in range(N_FULL):
        out[i] = own[i]
    out[S.R] += (1.0 - left) * _turned_back(x, p)
    for i in range(N_FULL, N_JITTERY):
        out[i] = (left - 1.0) * x[i]
    for i in range(N_CHANNELS):
        out[N_JITTERY + i] = own[N_FULL + i]


class JitteryModel(HeliModel):
    """A vehicle whose rotor speeds jitter, through the engine's protocol."""

    motion = Motion(_step, _measure, _drift_and_readings)
    exact = np.append(HeliModel.exact, [True, True])
    of_noise = np.append(HeliModel.of_noise, [True, True])
    work_size = _WORK_SIZE
    state_scale = np.append(HeliModel.state_scale, [1e-2, 1e-2])
    noise_places = np.insert(HeliModel.noise_places, N_FULL, [[N_FULL] * 2, [N_FULL + 1] * 2], 0)

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """The helicopter's parameter vector; behind it the jitter's memory and what the body takes up.

        With the vehicle file's inertias: a free one would be the reaction's parameter.
        """
        levels = {} if noise is None else noise.process
        memory = levels.get(JITTER_MEMORY, MEMORY_START)
        share = levels.get(JITTER_REACTION, REACTION)
        late = max(1.0 - share, 0.0) * memory / levels.get(JITTER_RETURN, MEMORY_START)
        file = self.vehicle.vector
        upper = (file[P.ROTOR_INERTIA_U] + file[P.FLYBAR_INERTIA]) / file[P.GUST_INERTIA_ZZ]
        lower = file[P.ROTOR_INERTIA_L] / file[P.GUST_INERTIA_ZZ]
        tail = [memory, share * upper, share * lower, late * upper, late * lower]
        return np.append(super().vector(values, noise), tail)

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """First state (31,) and its covariance, without what the noise levels add."""
        x, covariance = super().start(record)
        return np.append(x, [0.0, 0.0]), np.pad(covariance, (0, 2))

    def start_noise(self, noise: Noise) -> np.ndarray:
        """Variances that the noise levels add to the first state (31,)."""
        variance = noise.process.get(JITTER_LEVEL, 0.0) ** 2
        return np.append(super().start_noise(noise), [variance, variance])

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        """What the noise adds to the covariance, by entry of `noise_places`."""
        own = helicopter_noise.process_noise(noise, vector)
        memory = float(vector[_MEMORY])
        intensity = 2.0 * noise.process.get(JITTER_LEVEL, 0.0) ** 2 / memory
        return ProcessNoise(
            np.insert(own.intensity, N_FULL, [intensity] * 2),
            np.insert(own.decay, N_FULL, [1.0 / memory] * 2),
        )


def with_jitter(noise: Noise, model: HeliModel) -> Noise:
    """Noise levels with the jitter's, where their fit begins."""
    speed = float(np.mean(hover_speeds(model.vehicle.vector)))
    first = JITTER_START * speed
    return replace(
        noise,
        process={
            **noise.process,
            JITTER_LEVEL: first,
            JITTER_MEMORY: MEMORY_START,
            JITTER_REACTION: REACTION,
            JITTER_RETURN: MEMORY_START,
        },
        floor={
            **noise.floor,
            JITTER_LEVEL: 0.01 * first,
            JITTER_MEMORY: MEMORY_BOUNDS[0],
            JITTER_REACTION: REACTION_BOUNDS[0],
            JITTER_RETURN: MEMORY_BOUNDS[0],
        },
        ceiling={
            **noise.ceiling,
            JITTER_LEVEL: 50.0 * first,
            JITTER_MEMORY: MEMORY_BOUNDS[1],
            JITTER_REACTION: REACTION_BOUNDS[1],
            JITTER_RETURN: MEMORY_BOUNDS[1],
        },
        prior={**noise.prior, JITTER_MEMORY: (MEMORY_START, MEMORY_SPREAD)},
    )
