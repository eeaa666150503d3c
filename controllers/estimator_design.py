"""A Kalman filter for the env's noisy, multi-rate sensors, designed on the linearised vehicle.

It tracks the sixteen states, what the actuators really do, a disturbing force and moment with a
memory of a few seconds, and slow biases of gyros, roll and pitch. The disturbances stand for gusts
and for everything in which the flown machine differs from the designed one, a trim that is off
above all: what they explain is steered against at once. States that the suite does not show are
left out and named in ``unobserved``. It runs in estimator.py.

Gains are those of the periodic steady state: the sensors' rates repeat every ten rows (or fewer),
so there is one gain per row of that cycle, and one for the first reading of a flight.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import schur

from coax_env.env import hover
from coax_env.env.actions import Nominal, action_map
from coax_env.env.period import DELAYS, DT
from coax_env.errors import InputError
from coax_env.model import inputs as U
from coax_env.model import state as S
from coax_env.model.effects import CATALOGUE
from coax_env.model.layout import (
    ACTUATORS,
    CHANNELS,
    FLYBAR,
    FULL_STATES,
    GUST_FORCE,
    GUSTS,
    LOWER_FLAP,
    N_COMMANDS,
    PLACE,
    RATE,
    ROTOR_SPEED,
    SWASH,
    VELOCITY,
)
from coax_env.model.linear import N_SAMPLED, sampled
from coax_env.model.sampling import is_new
from coax_env.model.sensors import BASE_RATE, Sensor, slow_instruments, suite
from coax_env.model.vehicle import Vehicle
from controllers.target import HEADING_AXIS, HEIGHT_AXIS, PLACE_AXIS

DISTURBANCE_MEMORY = 5.0  # [s] of force and moment; unlike the fly-bar's, to be distinguished
FORCE_SHARE = 0.05  # std of the disturbing force, of the weight
MOMENT_ARM = 0.002  # [m] std of the disturbing roll and pitch moment, of the weight
TORQUE_SHARE = 0.07  # std of the disturbing yaw moment, of one rotor's torque
GRAVITY = 9.81  # [m/s2] for the tilt that goes with an acceleration
BIAS_STD = {"p": 0.03, "q": 0.03, "r": 0.03, "phi": 0.02, "theta": 0.02}
"""Readings whose bias is estimated, and its std [rad/s, rad]."""
BIAS_MEMORY = 30.0  # [s]
INTEGRAL_TIME = {"height": 1.5, "heading": 1.5, "position": 6.0}
"""[s]: an error of its limit for so long counts as much as the limit itself."""
_FREE_OF_NOISE = 1e-4  # std given to exact sensors, of their unit
_ROWS_SEEN = 500
_RUNS_ALONG = 0.05  # component of a unit direction from which it runs along a state
_FIRST_STD = {"m": 1.0, "m/s": 1.0, "rad": 0.1, "rad/s": 0.5, "N": 1.0, "N m": 0.05}
_PROCESS_STD = {"m": 1e-5, "m/s": 1e-3, "rad": 2e-4, "rad/s": 2e-3, "N": 0.0, "N m": 0.0}
_PAIRS = (("vn", "ve"), ("pn", "pe"), ("x", "y"))
"""Horizontal pairs, which are turned into the heading before use: the design is for psi = 0."""
_TURNED = (("u", "v"), ("phi", "theta"), ("x", "y"))
"""Pairs of states that turn with the axes: of each, d/dt = r second and -r first by the yaw rate alone,
equations (32)-(33), (38)-(39), (41)-(42). A product of deviations: the linear model lacks it."""
_NAMES = (*(name for name, _ in FULL_STATES[:N_SAMPLED]), *(f"bias_{name}" for name in BIAS_STD))
_UNITS = dict(FULL_STATES)
_BIASES = slice(N_SAMPLED, None)
_SPEED = CHANNELS.index("v")  # the unsigned one, not the state


@dataclass(frozen=True)
class EstimatorDesign:
    """Plain numbers of one estimator; everything is a deviation from the design vehicle's trim.

    Shapes with n states, m readings, c rows of the sensors' cycle::

        x[k+1] = A x[k] + B du[k]           y[k] = y_trim + C x[k] + D du[k-1]
    """

    sensors: str
    states: tuple[str, ...]
    unobserved: tuple[str, ...]
    readings: tuple[str, ...]
    A: np.ndarray  # (n, n)
    B: np.ndarray  # (n, 4), per command [SI]
    C: np.ndarray  # (m, n)
    D: np.ndarray  # (m, 4)
    gains: np.ndarray  # (c, n, m)
    first_gain: np.ndarray  # (n, m)
    single_rate_gain: np.ndarray  # (n, m), of the equivalent filter with every reading at 100 Hz
    spread: np.ndarray  # (n,), std of the estimation error in the steady state
    reading_trim: np.ndarray  # (m,)
    command_trim: np.ndarray  # (4,), of the design vehicle
    action_trim: np.ndarray  # (4,), of the nominal vehicle: command = trim + scale action
    action_scale: np.ndarray  # (4,)

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "EstimatorDesign":
        """From a JSON file; shapes are checked."""
        values: dict[str, Any] = {f.name: content[f.name] for f in fields(cls)}
        for name, value in values.items():
            if name in ("states", "unobserved", "readings"):
                values[name] = tuple(value)
            elif name != "sensors":
                values[name] = np.array(value, dtype=float)
        design = cls(**values)
        n, m, c = len(design.states), len(design.readings), len(design.gains)
        shapes = {
            "A": (n, n), "B": (n, 4), "C": (m, n), "D": (m, 4), "gains": (c, n, m),
            "first_gain": (n, m), "single_rate_gain": (n, m), "spread": (n,),
            "reading_trim": (m,), "command_trim": (4,), "action_trim": (4,), "action_scale": (4,),
        }  # fmt: skip
        for name, shape in shapes.items():
            found = getattr(design, name).shape
            if found != shape:
                raise InputError(f"estimator.{name} must have shape {shape}, found {found}")
        return design

    def index(self, name: str) -> int:
        """Place of a state in the estimate."""
        return self.states.index(name)

    @cached_property
    def reading_places(self) -> np.ndarray:
        """Where the readings stand in the env's observation, (m,)."""
        names = [s.name for s in suite(self.sensors)]
        return np.array([names.index(r) for r in self.readings])

    @cached_property
    def flag_places(self) -> np.ndarray:
        """Where the "new" flag of each reading stands in the observation; -1 without one, (m,)."""
        sensors = suite(self.sensors)
        flags = slow_instruments(sensors)
        instrument = {s.name: s.instrument for s in sensors}
        return np.array(
            [
                len(sensors) + flags.index(instrument[r]) if instrument[r] in flags else -1
                for r in self.readings
            ]
        )

    @cached_property
    def first_state(self) -> np.ndarray:
        """The estimate before the first reading, (n,): the actuators stand at the nominal trim."""
        first = np.zeros(len(self.states))
        for name, offset in zip(
            _NAMES[ACTUATORS], self.action_trim - self.command_trim, strict=True
        ):
            if name in self.states:
                first[self.index(name)] = offset
        return first


def design_estimator(
    vehicle: Vehicle,
    nominal: Nominal = None,
    sensors: str = "onboard",
    velocity: Sequence[float] = (0.0, 0.0),
) -> EstimatorDesign:
    """The filter for a vehicle and a sensor suite. A pure delay is taken as a lag.

    Args:
        vehicle: the filter is designed on.
        nominal: whose trim and scale the actions have, see `action_map`.
        sensors: name of the suite.
        velocity: forward and right over ground [m/s], of the flight about which it is linear.
    """
    used = [s for s in suite(sensors, vehicle) if s.index != _SPEED]  # |V| has no slope at hover
    rows = [s.index for s in used]
    A, B, C_all, D_all, x_trim, u_trim = _linear(vehicle, velocity)
    y_trim = np.concatenate([_trim_readings(vehicle, x_trim, u_trim), x_trim[:N_SAMPLED]])[rows]

    first, process = _spreads(vehicle, u_trim)
    noise = np.array([max(s.noise, _FREE_OF_NOISE) for s in used])
    hidden = _unobserved(A, C_all[rows], first, noise)
    keep = [i for i in range(len(_NAMES)) if _NAMES[i] not in hidden]
    hidden = tuple(name for name in hidden if not name.startswith("bias_"))
    A, B = A[np.ix_(keep, keep)], B[keep]
    C, D = C_all[np.ix_(rows, keep)], D_all[rows]
    gains, first_gain, spread = _gains(A, C, first[keep], process[keep], noise, used)
    trim, scale = action_map(vehicle, nominal)
    return EstimatorDesign(
        sensors=sensors,
        states=tuple(_NAMES[i] for i in keep),
        unobserved=hidden,
        readings=tuple(s.name for s in used),
        A=A, B=B, C=C, D=D,
        gains=gains,
        first_gain=first_gain,
        single_rate_gain=_single_rate_gain(A, C, process[keep], noise, used),
        spread=spread,
        reading_trim=y_trim,
        command_trim=u_trim,
        action_trim=trim,
        action_scale=scale,
    )  # fmt: skip


def plant(vehicle: Vehicle, design: EstimatorDesign) -> tuple[np.ndarray, ...]:
    """A, B, C, D of a vehicle at hover with a design's states and readings, see EstimatorDesign."""
    A, B, C_all, D_all, *_ = _linear(vehicle, (0.0, 0.0))
    keep = [_NAMES.index(name) for name in design.states]
    place = {sensor.name: sensor.index for sensor in suite(design.sensors)}
    rows = [place[name] for name in design.readings]
    return A[np.ix_(keep, keep)], B[keep], C_all[np.ix_(rows, keep)], D_all[rows]


@dataclass(frozen=True)
class NoiseLevels:
    """What an estimator reckons with, as stds in the units of states and readings."""

    first: np.ndarray  # (n,), of the state at a flight's start
    process: np.ndarray  # (n,), of what a control period adds to it
    reading: np.ndarray  # (m,), of readings at 100 Hz that tell as much as the suite's
    ratio: np.ndarray  # (m,), periods from one sample to the next


def noise_levels(vehicle: Vehicle, design: EstimatorDesign) -> NoiseLevels:
    """The stds that a design was made with, every reading taken as one of 100 Hz.

    Args:
        vehicle: what it was designed on.
        design: the filter.
    """
    first, process = _spreads(vehicle, design.command_trim)
    keep = [_NAMES.index(name) for name in design.states]
    used = {sensor.name: sensor for sensor in suite(design.sensors, vehicle)}
    own = [used[name] for name in design.readings]
    ratio = np.array([BASE_RATE / sensor.rate for sensor in own])
    noise = np.array([max(sensor.noise, _FREE_OF_NOISE) for sensor in own])
    return NoiseLevels(first[keep], process[keep], noise * np.sqrt(ratio), ratio)


def _linear(vehicle: Vehicle, velocity: Sequence[float]) -> tuple[np.ndarray, ...]:
    """A, B, C, D of all states and readings, with disturbances and biases, and the trim."""
    A_flown, B_flown, C_channels, D_channels, x_trim, u_trim = sampled(
        delay_as_lag(vehicle), DT, velocity
    )
    A, B = np.eye(len(_NAMES)), np.zeros((len(_NAMES), N_COMMANDS))
    A[:N_SAMPLED, :N_SAMPLED], B[:N_SAMPLED] = A_flown, B_flown
    A[GUSTS, GUSTS] = np.eye(6) * math.exp(-DT / DISTURBANCE_MEMORY)
    A[N_SAMPLED:, N_SAMPLED:] *= math.exp(-DT / BIAS_MEMORY)
    # readings of the channels, then, for the suite ``state``, the states as they are
    C_all = np.eye(len(CHANNELS) + N_SAMPLED, len(_NAMES), k=-len(CHANNELS))
    C_all[: len(CHANNELS), :N_SAMPLED] = C_channels
    for k, name in enumerate(BIAS_STD):
        C_all[CHANNELS.index(name), N_SAMPLED + k] = 1.0
    D_all = np.vstack([D_channels, np.zeros((N_SAMPLED, N_COMMANDS))])
    return A, B, C_all, D_all, x_trim, u_trim


def delay_as_lag(vehicle: Vehicle) -> Vehicle:
    """The commands' pure delays, which have no finite state, added to the actuators' lags instead."""
    values = vehicle.values()
    late, swash_later = (max(values.get(name, 0.0), 0.0) for name in DELAYS)
    for name, delay in (("motor_lag", late), ("servo_lag", late + swash_later)):
        if delay > 0.0:
            own = [p.name for p in CATALOGUE[name].parameters]
            lags = {k: values.get(f"{name}.{k}", 0.0) + delay for k in own}
            vehicle = vehicle.with_effect(name, **lags)
    on = {name: 0.0 for name in DELAYS if values.get(name, 0.0) > 0.0}
    return vehicle.with_values(on) if on else vehicle


def integrated_readings(design: EstimatorDesign) -> dict[str, float]:
    """Readings whose integral a controller should feed back, and the integral that counts 1.

    Height and heading, so that no error of trim or sensor model stays in them; position, or the
    velocity where position is not measured, whose integral then stands for the position.
    """
    limit = {name: hover.LIMITS[name] * time for name, time in INTEGRAL_TIME.items()}
    place = next((pair for pair in (("pn", "pe"), ("x", "y")) if pair[0] in design.readings), ())
    found = dict.fromkeys(place, limit["position"])
    if not place and "vn" in design.readings:
        found = dict.fromkeys(("vn", "ve"), hover.LIMITS["position"])
    found |= {n: limit["height"] for n in ("h", "z") if n in design.readings}
    return found | {n: limit["heading"] for n in ("psi",) if n in design.readings}


def axis_of(reading: str) -> int:
    """The axis of the setpoint, see `target.AXES`, on the way in which a reading's integral stops."""
    return {"h": HEIGHT_AXIS, "z": HEIGHT_AXIS, "psi": HEADING_AXIS}.get(reading, PLACE_AXIS)


def horizontal_pairs(design: EstimatorDesign) -> np.ndarray:
    """Readings that are north and east of one vector, by their places, (k, 2)."""
    names = design.readings
    pairs = [(names.index(a), names.index(b)) for a, b in _PAIRS if a in names]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def turned_pairs(design: EstimatorDesign) -> np.ndarray:
    """Pairs of states that turn with the axes of a machine that yaws, by their places, (k, 2)."""
    names = design.states
    pairs = [(names.index(a), names.index(b)) for a, b in _TURNED if a in names and b in names]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _trim_readings(vehicle: Vehicle, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    from coax_env.model.dynamics import readings

    found = readings(x, u, vehicle)
    return np.array([found[name] for name in CHANNELS])


def _growth(memory: float) -> float:
    """What a state of this memory [s] and unit std gains in a control period, as a std."""
    return math.sqrt(1.0 - math.exp(-2.0 * DT / memory))


def _spreads(vehicle: Vehicle, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Std of every full state at a flight's start, and of what one period adds to it."""
    values = vehicle.values()
    weight = values["mass"] * values["gravity"]
    k_Q = values["air_density"] * math.pi * values["rotor_radius"] ** 5
    torque = values["torque_coefficient_upper"] * k_Q * command[U.OMEGA_U] ** 2
    first = np.array([_FIRST_STD.get(_UNITS.get(n, ""), 1.0) for n in _NAMES])
    process = np.array([_PROCESS_STD.get(_UNITS.get(n, ""), 0.0) for n in _NAMES])
    start = hover.START
    first[VELOCITY] = start["velocity"] / math.sqrt(3.0)
    first[RATE] = start["rate"] / math.sqrt(3.0)
    first[LOWER_FLAP] = first[FLYBAR] = 0.01
    first[[S.PHI, S.THETA]] = start["tilt"] / math.sqrt(3.0)
    first[S.PSI] = start["heading"] / math.sqrt(3.0)
    first[S.Z] = start["height"] / math.sqrt(3.0)
    first[PLACE] = 0.01
    first[ACTUATORS] = 1e-3
    first[GUST_FORCE] = FORCE_SHARE * weight
    first[[S.GUST_L, S.GUST_M]] = MOMENT_ARM * weight
    first[S.GUST_N] = TORQUE_SHARE * torque
    first[_BIASES] = list(BIAS_STD.values())
    process[ROTOR_SPEED], process[SWASH] = 0.2, 1e-4
    process[_BIASES] = first[_BIASES] * _growth(BIAS_MEMORY)
    process[GUSTS] = first[GUSTS] * _growth(DISTURBANCE_MEMORY)
    return first, process


def _unobserved(
    A: np.ndarray, C: np.ndarray, first: np.ndarray, noise: np.ndarray
) -> tuple[str, ...]:
    """States whose error the readings never show and that does not decay.

    From the information matrix sum (A^k)' C' R^-1 C A^k of five seconds, with states in units of
    their first std: its directions with next to no information that do not decay by themselves,
    and the states that these run along.
    """
    A_scaled = A * first / first[:, None]
    seen = (C * first) / noise[:, None]
    information = np.zeros_like(A)
    for _ in range(_ROWS_SEEN):
        information += seen.T @ seen
        seen = seen @ A_scaled
    values, directions = np.linalg.eigh(information)
    blind = directions[:, values < 1e-3]
    within = blind.T @ A_scaled @ blind  # the blind directions map onto themselves
    _, basis, lasts = schur(within, sort=lambda re, im=0.0: math.hypot(re, im) > 0.9995)
    lasting = blind @ basis[:, :lasts]
    shares = np.abs(lasting).max(axis=1, initial=0.0)
    return tuple(n for n, share in zip(_NAMES, shares, strict=True) if share > _RUNS_ALONG)


def _gains(
    A: np.ndarray,
    C: np.ndarray,
    first: np.ndarray,
    process: np.ndarray,
    noise: np.ndarray,
    sensors: list[Sensor],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kalman gains over the sensors' cycle, the first gain, and the steady error's std."""
    cycle = round(BASE_RATE / math.gcd(*(round(s.rate) for s in sensors)))
    new = [np.array([bool(is_new(row, s.rate)) for s in sensors]) for row in range(cycle)]
    seen = [(C[rows], np.diag(noise[rows] ** 2)) for rows in new]
    Q, eye = np.diag(process**2), np.eye(len(A))
    P = np.diag(first**2)
    first_gain = _gain(P, C, np.diag(noise**2))
    gains = np.zeros((cycle, *first_gain.shape))
    rounds = round(20.0 / DT / cycle)
    for row in range(rounds * cycle + 1):
        C_new, R = seen[row % cycle]
        K = _gain(P, C_new, R)
        joseph = eye - K @ C_new
        P = joseph @ P @ joseph.T + K @ R @ K.T
        if row >= (rounds - 1) * cycle:  # the last of each
            gains[row % cycle][:, new[row % cycle]] = K
            spread = np.sqrt(np.diag(P))
        P = A @ P @ A.T + Q
    return gains, first_gain, spread


def _gain(P: np.ndarray, C: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Of a filter with the error's covariance P, readings C x, and their noise R."""
    K: np.ndarray = np.linalg.solve(C @ P @ C.T + R, C @ P).T
    return K


def _single_rate_gain(
    A: np.ndarray, C: np.ndarray, process: np.ndarray, noise: np.ndarray, sensors: list[Sensor]
) -> np.ndarray:
    """The filter gain K (x += K innovation) if slow sensors were fast and as much noisier."""
    import control

    rate = np.array([s.rate for s in sensors])
    R = np.diag(noise**2 * (BASE_RATE / rate))
    _, P, _ = control.dlqe(A, np.eye(len(A)), C, np.diag(process**2), R, method="scipy")
    return _gain(np.asarray(P), C, R)
