"""The helicopter as the engine sees it: the compiled kernel, its parameters with priors, its noise.

Delays of the commands enter here: with command_delay, and for the swash plate servo_delay on top, they
are looked up late and, where a row's interval holds two of them, replaced by their mean over it (the
step is split to second order).

A reading is taken as the row begins: it sees the one command that is in force then, and so an input of
the model has two halves, that of the step and that of the readings. With a delay between k and k + 1
rows that is the command of k + 1 rows ago, wherever in between the delay is: a likelihood with steps.
It is searched along the line through their middles, off by half a row at most; where a delay was found
so, that of the readings is held (`reading_after`), and that of the step fitted by itself.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, Self

import numba
import numpy as np
from numba import float64, types

from coax_env.estimation import helicopter_noise
from coax_env.estimation.compiled_model import LANES_MEASURE, LANES_STEP
from coax_env.estimation.state_space import FreeParameter, Noise, ProcessNoise, Record
from coax_env.kernel.compilation import compiled, pointer
from coax_env.kernel.simd import any_lane, simd_view
from coax_env.kernel.variants import under_names
from coax_env.logs.flight import Run
from coax_env.logs.held_signal import row_means
from coax_env.model import dynamics, effects, usual_sizes
from coax_env.model import inputs as U
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model import workspace as F
from coax_env.model.layout import (
    ACTUATORS,
    ANGLES,
    ATTITUDE,
    CHANNELS,
    FLYBAR,
    GUST_FORCE,
    GUST_MOMENT,
    LOWER_FLAP,
    N_FULL,
    N_INPUTS,
    N_STATES,
    POSITION,
    RATE,
    ROTOR_SPEED,
    SWASH,
    TIME,
    VELOCITY,
)
from coax_env.model.vehicle import Vehicle

MOST_USUAL_SIZES = 5.0
"""Usual sizes that an effect may have at most; ours."""

UNUSUAL_FROM = 2.5
"""Usual sizes beyond which an effect's name is to be taken with care; ours."""

HELD = (
    "gravity", "air_density", "rotor_radius",
    "fuselage_length", "fuselage_width", "fuselage_drag_coefficient", "flybar_inertia",
    "flap_coupling_lon", "flap_coupling_lat",
)  # fmt: skip
"""Base parameters that are never fitted: exact, or one column with others that are."""

READ = slice(N_INPUTS, 2 * N_INPUTS)
"""Columns of the input that the readings see."""
RISE = slice(READ.stop, READ.stop + 2)
"""Columns of the input with what both rotors' commands are beyond their means as the row ends."""
_INNOVATIONS = RISE.stop
"""Column of the input at which input innovations begin, where it has them."""

_LAG_U, _LAG_L = (effects.parameter_index(f"motor_lag.{rotor}") for rotor in ("upper", "lower"))
_REACTION = effects.parameter_index("spin_up_reaction.gain")

_A = float64[::1]
STEP = types.void(_A, _A, float64, _A, _A, _A)
MEASURE = types.void(_A, _A, _A, _A, _A)


@compiled()
def _take_in_innovations(u: Any, p: Any, x: Any) -> None:
    """Correct a state (29,) in place by the innovations after the input; see input_innovations.py."""
    if u.size == _INNOVATIONS:
        return
    upper, lower = u[_INNOVATIONS + U.OMEGA_U], u[_INNOVATIONS + U.OMEGA_L]
    lon, lat = u[_INNOVATIONS + U.DELTA_LON], u[_INNOVATIONS + U.DELTA_LAT]
    turn, lift = upper - lower, upper + lower
    x[S.P] += p[P.COMMAND_GAIN_RATE_XY] * lat
    x[S.Q] += p[P.COMMAND_GAIN_RATE_XY] * lon
    x[S.GUST_L] += p[P.COMMAND_GAIN_MOMENT_XY] * lat
    x[S.GUST_M] += p[P.COMMAND_GAIN_MOMENT_XY] * lon
    x[S.GUST_X] += p[P.COMMAND_GAIN_FORCE_XY] * lon
    x[S.GUST_Y] -= p[P.COMMAND_GAIN_FORCE_XY] * lat
    x[S.R] += p[P.COMMAND_GAIN_RATE_Z] * turn
    x[S.GUST_N] += p[P.COMMAND_GAIN_MOMENT_Z] * turn
    x[S.W] += p[P.COMMAND_GAIN_SPEED_Z] * lift
    x[S.GUST_Z] += p[P.COMMAND_GAIN_FORCE_Z] * lift


@compiled()
def _reads_another(u: Any) -> bool:
    """Whether the readings see another input than the step, of registers in any lane."""
    for i in range(N_INPUTS):  # noqa: SIM110, numba has no any()
        if any_lane(u[i] != u[N_INPUTS + i]):
            return True
    return False


@compiled()
def _start_of_step(x: Any, u: Any, p: Any, out: Any) -> None:
    """A state (29,) with the input innovations taken in."""
    for i in range(N_FULL):
        out[i] = x[i]
    _take_in_innovations(u, p, out)


kernel_step = dynamics.step  # `side_by_side` puts those of registers in their places
kernel_measure = dynamics.measure
kernel_drift = dynamics.drift_and_readings


@compiled()
def _slower(u: Any, dt: Any, p: Any) -> tuple[Any, Any]:
    """By how much rotors begin a row slower and end it faster than with the means of their commands.

    Exact for commands that rise evenly, with a lag or none: such a rotor is as fast in the mean, and
    gains what it gains, which the body feels (`spin_up_reaction`): 459 nats of that had been a yaw
    damping at 25 Hz (**synthetic**). What the slower beginning would give to the heading of that
    reaction, `_turn_back` takes out.
    """
    upper, lower = u[RISE.start], u[RISE.start + 1]
    if not (any_lane(upper != 0.0) or any_lane(lower != 0.0)):
        return upper, lower
    return upper * dynamics.earliness(dt, p[_LAG_U]), lower * dynamics.earliness(dt, p[_LAG_L])


@compiled()
def _speed_up(x: Any, upper: Any, lower: Any) -> None:
    """Rotors of a state by so much [rad/s], in place."""
    x[S.OMEGA_U] += upper
    x[S.OMEGA_L] += lower


@compiled()
def _turn_back(x: Any, work: Any, dt: Any, p: Any, upper: Any, lower: Any) -> None:
    """The heading of a state, in place, by what rotors that begin so much slower turn the body before.

    Args:
        work: the kernel's, after its step. upper, lower: of `_slower`.
    """
    angular = (p[P.ROTOR_INERTIA_U] + p[P.FLYBAR_INERTIA]) * upper - p[P.ROTOR_INERTIA_L] * lower
    x[S.PSI] -= dt * p[_REACTION] * angular / work[F.INERTIA_ZZ]


def _step(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The kernel's step after the input innovations are taken in, in the engine's form."""
    upper, lower = _slower(u, dt, p)
    _start_of_step(x, u, p, out)
    _speed_up(out, -upper, -lower)
    kernel_step(out, u, dt, p, work, out)
    _speed_up(out, upper, lower)
    _turn_back(out, work, dt, p, upper, lower)


def _measure(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    """The kernel's readings, in the form in which the engine takes a model."""
    kernel_measure(x, u[READ], p, work, out)


def _drift_and_readings(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The kernel's drift and readings with the input innovations, in the engine's form."""
    upper, lower = _slower(u, dt, p)
    omega_u, omega_l = x[S.OMEGA_U], x[S.OMEGA_L]  # put back below: the state is the caller's
    _speed_up(x, -upper, -lower)
    kernel_drift(x, u, dt, p, work, out)
    x[S.OMEGA_U], x[S.OMEGA_L] = omega_u, omega_l
    if _reads_another(u):
        kernel_measure(x, u[READ], p, work, out[N_FULL:])
    _take_in_innovations(u, p, out)


class Motion(NamedTuple):
    """A model's `step`, `measure` and `drift_and_readings`, not compiled.

    inner: those of the model that they call as `inner_step` and its like, if they call one.
    """

    step: Any
    measure: Any
    drift_and_readings: Any
    inner: "Motion | None" = None


def _around(motion: Motion, names: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """The inner model's three, compiled, by the names that a motion calls them by.

    Args:
        motion: with an inner one or without. names, kind: as of `compiled_motion`.
    """
    if motion.inner is None:
        return {}
    inner = compiled_motion(motion.inner, names, kind)
    return dict(zip(("inner_step", "inner_measure", "inner_drift"), inner, strict=True))


def compiled_motion(motion: Motion, names: Mapping[str, Any], kind: str) -> tuple[Any, Any, Any]:
    """A model's three, compiled, for other compiled code to call.

    Args:
        motion: the model's. names: what some global names mean in them. kind: see `under_names`.
    """
    known = {**names, **_around(motion, names, f"in_{kind}")}
    step, measure, drift = (compiled()(under_names(f, known, kind)) for f in motion[:3])
    return step, measure, drift


@cache
def pointers(motion: Motion, kind: str) -> tuple[Any, Any, Any]:
    """A model's three, as the engine takes them: compiled when a model of its kind is first made.

    Args:
        motion: the model's. kind: what tells it from others.
    """
    step, measure, drift = motion[:3]
    if motion.inner is not None:
        known = _around(motion, {}, f"in_{kind}")
        step, measure, drift = (under_names(f, known, "around") for f in motion[:3])
    return pointer(STEP)(step), pointer(MEASURE)(measure), pointer(STEP)(drift)


@dataclass(frozen=True)
class Moment:
    """When something begins: at `t` [s] of a run, and it lasts through all later ones.

    grows: s of flight over which it comes evenly; 0: at once.
    """

    run: str
    t: float
    grows: float = 0.0


step_of: Any = None  # a model's own, put in by `side_by_side`
measure_of: Any = None
drift_of: Any = None


def _step_of_lanes(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """A step of SIMD_WIDTH states, inputs and vehicles, a column each."""
    step_of(simd_view(x), simd_view(u), dt, simd_view(p), simd_view(work), simd_view(out))


def _measure_of_lanes(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    """Readings of as many."""
    measure_of(simd_view(x), simd_view(u), simd_view(p), simd_view(work), simd_view(out))


def _drift_of_lanes(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """Drift and readings of as many."""
    drift_of(simd_view(x), simd_view(u), dt, simd_view(p), simd_view(work), simd_view(out))


OF_LANES = Motion(_step_of_lanes, _measure_of_lanes, _drift_of_lanes)


@cache
def side_by_side(motion: Motion, kind: str, of_lanes: Motion = OF_LANES) -> Any:
    """Pointers to `step`, `measure` and `drift_and_readings` of SIMD_WIDTH at once.

    Args:
        motion: a model's, not compiled, which calls the kernel as `kernel_step` and its like.
        kind: what tells it from others.
        of_lanes: what calls it as `step_of` and its like.

    Returns:
        the three; None where a user's effect does not compile for registers.
    """
    signatures = (LANES_STEP, LANES_MEASURE, LANES_STEP)
    try:
        step, measure, drift = dynamics.motion_of_registers()
        kernel = {"kernel_step": step, "kernel_measure": measure, "kernel_drift": drift}
        own = compiled_motion(motion, kernel, f"of_registers_{kind}")
        names = dict(zip(("step_of", "measure_of", "drift_of"), own, strict=True))
        return tuple(
            pointer(signature.signature)(under_names(f, names, kind))
            for signature, f in zip(signatures, of_lanes[:3], strict=True)
        )
    except numba.core.errors.NumbaError:
        return None


def _small_changes() -> np.ndarray:
    """Size of a small change of each state, for differences (29,)."""
    size = np.empty(N_FULL)
    size[VELOCITY] = size[RATE] = size[POSITION] = size[GUST_FORCE] = 1e-4
    size[LOWER_FLAP] = size[FLYBAR] = size[ATTITUDE] = size[SWASH] = size[GUST_MOMENT] = 1e-5
    size[ROTOR_SPEED] = 1e-2
    size[S.TRIM_Z], size[S.TRIM_N], size[S.INFLOW] = 1e-4, 1e-5, 1e-5
    return size


class HeliModel:
    """A vehicle, through the engine's protocol."""

    channels = CHANNELS
    wraps = np.array([c in ANGLES for c in CHANNELS])
    motion = Motion(_step, _measure, _drift_and_readings)
    read_delay: float | None = None  # [s] of commands to the readings; None: follows the steps'
    frequencies: Sequence[float] = ()  # [Hz] of gusts that swing; see swinging_gusts.py
    moments: Mapping[str, Moment] = {}  # when effects begin or change; see changing_model.py
    air = np.arange(GUST_FORCE.start, GUST_MOMENT.stop)  # states of the gusts
    exact = np.arange(N_FULL) >= N_STATES
    of_noise = np.zeros(N_FULL, bool)
    work_size = dynamics.WORK_SIZE
    noise_places = helicopter_noise.NOISE_PLACES
    state_scale = _small_changes()

    @property
    def base(self) -> "HeliModel":
        """Itself; of a model that changes in flight the one that it is at any time."""
        return self

    @property
    def side_by_side(self) -> Any:
        """`step`, `measure` and `drift_and_readings` of SIMD_WIDTH at once, or None."""
        return side_by_side(self.motion, self.kind)

    @property
    def kind(self) -> str:
        """The name by which numba's cache tells its compiled functions from another model's."""
        return type(self).__name__

    def __init__(self, vehicle: Vehicle, held: Mapping[str, float] | None = None) -> None:
        """Of a vehicle; ``held``: values that effects which it does not have would take as stated."""
        self.vehicle = vehicle
        self.bare_values = {**(held or {}), **vehicle.values()}
        self.size_ratios = usual_sizes.ratios(vehicle)
        self.step, self.measure, self.drift_and_readings = pointers(self.motion, self.kind)

    @classmethod
    def like(cls, model: "HeliModel") -> Self:
        """Of the same vehicle, whose readings see the same commands."""
        own = cls(model.vehicle, model.bare_values)
        own.read_delay = model.read_delay
        return own

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """Parameter vector of the vehicle with some values changed, effects included.

        Args:
            values: by name. noise: whose memories the gusts have; None: usual ones.
        """
        vector = effects.pack({**self.bare_values, **values})
        for reference, own in P.GUST_REFERENCE.items():
            vector[reference] = self.vehicle.vector[own]
        if noise is not None:
            helicopter_noise.with_memories(vector, noise)
        return vector

    @property
    def input_places(self) -> np.ndarray:
        """Places in the parameter vector of what `inputs` follows."""
        return np.array([_COMMAND_DELAY, _SERVO_DELAY, _NOMINAL_VOLTAGE])

    def inputs(self, record: Record, vector: np.ndarray) -> np.ndarray:
        """The kernel's inputs (inputs.py) of steps and of readings, (n, 14), input innovations behind.

        A command is its mean over the row to the step, that in force as it begins to the readings. Then
        follows by how much the rotors' end the row above their means.
        """
        rise = record.of_next * np.diff(record.command, axis=0, append=record.command[-1:])
        flown = record.command + rise
        u = np.zeros((record.t.size, 2, N_INPUTS))
        u[:, 0, :TIME], u[:, 1, :TIME] = flown, record.command
        u[:, :, U.TIME] = (record.t - record.origin)[:, None]
        if record.battery is not None:
            u[:, :, U.BATTERY] = (record.battery - vector[_NOMINAL_VOLTAGE])[:, None]
        for column, delay in enumerate(_delays(vector)):
            if delay > 0.0:
                u[:, 0, column] = row_means(record.t, flown[:, column], -delay)
                u[:, 1, column] = self._read(record.t, record.command[:, column], delay)
                rise[:, column] = row_means(record.t, rise[:, column], -delay)
        both = np.hstack([u.reshape(record.t.size, -1), rise[:, ROTORS]])
        if record.input_innovations is None:
            return both
        return np.hstack([both, record.input_innovations])

    def between(self, record: Record, vector: np.ndarray) -> np.ndarray:
        """Variance of each command's mean over a row (n, 4), which comes as late as the command."""
        changes = np.diff(record.command, axis=0, append=record.command[-1:])
        columns = zip(changes.T, _delays(vector), strict=True)
        means = [row_means(record.t, change**2, -delay) for change, delay in columns]
        return record.between * np.column_stack(means)

    def _read(self, t: np.ndarray, command: np.ndarray, delay: float) -> np.ndarray:
        """A late command (n,) as readings at the rows' times `t` see it."""
        held = delay if self.read_delay is None else self.read_delay
        return row_means(t, command, -_to_the_middle(t, held))

    def reading_after(self, delay: float) -> "HeliModel":
        """The same, whose readings see commands this much later [s], once any delay is there."""
        model = copy(self)
        model.read_delay = delay
        return model

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """First state from the medians of the first half second, with a wide covariance."""
        early = record.t <= record.t[0] + 0.5

        def first(channel: str, otherwise: float, spread: float) -> tuple[float, float]:
            values = record.z[early, CHANNELS.index(channel)]
            values = values[np.isfinite(values)]
            if values.size == 0:
                return otherwise, spread
            if channel in ANGLES:
                values = np.unwrap(values[:3])
            return float(np.median(values)), 0.5 if channel in ("h", "pn", "pe") else spread

        x = np.zeros(N_FULL)
        spread = np.zeros(N_FULL)
        for i, channel in ((S.PHI, "phi"), (S.THETA, "theta"), (S.PSI, "psi")):
            x[i], spread[i] = first(channel, 0.0, 0.2)
        height, spread[S.Z] = first("h", 1.0, 1.0)
        x[S.Z] = -height
        x[S.X], spread[S.X] = first("pn", 0.0, 1e-3)
        x[S.Y], spread[S.Y] = first("pe", 0.0, 1e-3)
        spread[VELOCITY] = 1.0
        spread[RATE] = 0.6
        spread[LOWER_FLAP] = spread[FLYBAR] = 0.06
        x[ACTUATORS] = record.command[0]
        spread[ROTOR_SPEED] = 4.0
        spread[SWASH] = spread[S.INFLOW] = 0.03
        return x, np.diag(spread**2 + 1e-12)

    def start_noise(self, noise: Noise) -> np.ndarray:
        """Variances of gusts and trims at the start of a run (29,)."""
        return helicopter_noise.start_noise(noise)

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        """What the noise adds to the covariance; see helicopter_noise.py."""
        return helicopter_noise.process_noise(noise, vector)

    # --- what may be fitted -------------------------------------------------------------------------

    def base_parameters(self) -> list[FreeParameter]:
        """The vehicle's own numbers under their priors."""
        return [
            FreeParameter(name, p.value, p.std, lower=0.3 * p.value, upper=3.0 * p.value)
            for name, p in self.vehicle.parameters.items()
            if p.std > 0.0 and name not in HELD
        ]

    def sized(self, effect: str) -> tuple[effects.EffectParameter, ...]:
        """An effect's parameters with their sizes on this vehicle, generic groups' too."""
        return usual_sizes.scaled(effects.GROUPS[effect].parameters, self.size_ratios)

    def effect_parameters(self, effect: str) -> list[FreeParameter]:
        """An effect's parameters that may be fitted; the prior is centred on its off-value.

        Nothing is taken to be more than MOST_USUAL_SIZES usual sizes: beyond that it is another effect.
        """
        entry = effects.CATALOGUE[effect]
        return [
            FreeParameter(
                f"{effect}.{p.name}",
                p.off,
                p.usual,
                max(p.lower, p.off - MOST_USUAL_SIZES * p.usual),
                min(p.upper, p.off + MOST_USUAL_SIZES * p.usual),
                p.probe,
                entry.stage == effects.SENSOR,
            )
            for p in self.sized(effect)
            if not p.held
        ]


_COMMAND_DELAY = effects.parameter_index("command_delay.time")
_SERVO_DELAY = effects.parameter_index("servo_delay.time")
_NOMINAL_VOLTAGE = effects.parameter_index("battery_voltage.nominal")
ROTORS, SWASH_PLATE = (U.OMEGA_U, U.OMEGA_L), (U.DELTA_LON, U.DELTA_LAT)
"""Columns of the input that command_delay alone and that servo_delay too make late."""


def _delays(vector: np.ndarray) -> list[float]:
    """Delay of each command [s]: command_delay makes all late, servo_delay the swash plate's, too."""
    late, swash_later = max(vector[_COMMAND_DELAY], 0.0), max(vector[_SERVO_DELAY], 0.0)
    return [late + swash_later if column in SWASH_PLATE else late for column in range(TIME)]


def _to_the_middle(t: np.ndarray, delay: float) -> np.ndarray:
    """Delay (n,) [s] whose mean over a row is what readings see where a delay is k + 1/2 rows.

    That is half a row more; the line to no delay, where they see the row's own, is twice as steep.

    Args:
        t: (n,) times of the rows [s]. delay: of the command [s].
    """
    rows = np.diff(t, prepend=2.0 * t[0] - t[1])
    return delay + np.minimum(delay, 0.5 * rows)


def record_of(run: Run) -> Record:
    """A run as the engine sees it."""
    z = np.full((run.t.size, len(CHANNELS)), np.nan)
    for channel, values in run.measured.items():
        z[:, CHANNELS.index(channel)] = values
    return Record(
        run.name, run.t, run.command, z, origin=run.beginning, run=run.whole, battery=run.battery
    )
