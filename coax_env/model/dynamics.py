"""The model, equations (1)-(44) of the paper, as one compiled kernel, and its Python faces.

Data flow of one step::

    properties(p) -> actuators(x, u, dt) -> rates(x) four times (RK4) -> x at the row's end
                                            |
                              AIR, SWASH, ROTOR, LOAD effects of effects.py

`measure` runs the same flow once and turns it into readings of every canonical channel. The env, the
batch env, the estimator, identification, diagnosis and linearisation all call `step`, `rates` and
`measure`; there is no second copy of the physics.

Time: the command of a row holds until the next row (zero-order hold). Actuators are discretised
exactly over the step. A reading at a row is taken just after the row's command has been given
(READING_DELAY), so that an actuator without lag has already moved.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from coax_env.errors import InputError
from coax_env.kernel.compilation import compiled
from coax_env.kernel.lazy import lazily_compiled
from coax_env.kernel.simd import sine_and_cosine, sines_and_cosines
from coax_env.model import effects
from coax_env.model import parameters as P
from coax_env.model import workspace as F
from coax_env.model.layout import CHANNELS, N_CHANNELS, N_COMMANDS, N_FULL, N_INPUTS, N_STATES, TIME
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

READING_DELAY = 1e-4  # [s] after the command of the same row
LONGEST_STEP = 0.02  # [s] a longer row is split
NEWTON_STEPS = 12
BALANCED = 1e-11  # [m/s2, rad/s2] left over at a hover
SHORTEST_LAG = 1e-9  # [s] below it exp(-READING_DELAY/lag) is zero: the command itself

_air_effects = effects.stage_function(effects.AIR)
_swash_effects = effects.stage_function(effects.SWASH)
_rotor_effects = effects.stage_function(effects.ROTOR)
_load_effects = effects.stage_function(effects.LOAD)
_unlisted_terms = effects.stage_function(effects.UNLISTED)
_every_sensor_effect = effects.stage_function(effects.SENSOR)
_every_property_effect = effects.stage_function(effects.PROPERTY)


@lazily_compiled
def _sensor_effects(x, f, p):
    """The SENSOR effects of the catalogue."""
    _every_sensor_effect(x, f, p)


@lazily_compiled
def _property_effects(x, f, p):
    """The PROPERTY effects of the catalogue."""
    _every_property_effect(x, f, p)


WORK_SIZE = F.N_FLOW + N_FULL + 2 * N_STATES
"""Doubles of scratch that `step` and `measure` need."""


def _properties_of(with_effects):
    """`_properties` compiled with the effects' call, or without it; see `_rates_of`."""

    def properties(x, u, p, f):
        """Vehicle file's numbers into the workspace, once a step. (15)-(20)."""
        f[F.TIME] = u[TIME]
        f[F.MASS] = p[P.MASS]
        f[F.INERTIA_XX] = p[P.INERTIA_XX]
        f[F.INERTIA_YY] = p[P.INERTIA_YY]
        f[F.INERTIA_ZZ] = p[P.INERTIA_ZZ]
        f[F.SWASH_TO_FLAP] = p[P.SWASH_TO_FLAP]
        f[F.FLAP_TIME] = p[P.FLAP_TIME]
        f[F.FLYBAR_TIME] = p[P.FLYBAR_TIME]
        radius = p[P.ROTOR_RADIUS]
        k_T = p[P.AIR_DENSITY] * math.pi * radius * radius * radius * radius
        k_Q = k_T * radius
        f[F.THRUST_FACTOR_U] = p[P.C_TU] * k_T
        f[F.THRUST_FACTOR_L] = p[P.C_TL] * k_T
        f[F.TORQUE_FACTOR_U] = p[P.C_QU] * k_Q
        f[F.TORQUE_FACTOR_L] = p[P.C_QL] * k_Q
        f[F.MOTOR_LAG_U] = 0.0
        f[F.MOTOR_LAG_L] = 0.0
        f[F.SERVO_LAG] = 0.0
        f[F.SPEED_SCALE] = 1.0
        f[F.OMEGA_U_DOT] = 0.0
        f[F.OMEGA_L_DOT] = 0.0
        if with_effects and p[effects.PROPERTY] != 0.0:
            _property_effects(x, f, p)

    return compiled(forceinline=not with_effects)(properties)


_properties = _properties_of(True)
_properties_bare = _properties_of(False)


@compiled()
def _follow(start, command, time, lag):
    """Exact first-order response to a held command; without a lag it is its own limit."""
    if lag <= SHORTEST_LAG:
        return command
    return command + (start - command) * math.exp(-time / lag)


def _actuate_of(with_effects):
    """`_actuate` compiled with the lags, or for vehicles without effects, which have none."""

    def actuate(x, u, time, f, out):
        """Rotor speeds and swash tilt at `time` after the row's command, into the state `out`."""
        if with_effects:
            out[16] = _follow(x[16], u[0] * f[F.SPEED_SCALE], time, f[F.MOTOR_LAG_U])
            out[17] = _follow(x[17], u[1] * f[F.SPEED_SCALE], time, f[F.MOTOR_LAG_L])
            out[18] = _follow(x[18], u[2], time, f[F.SERVO_LAG])
            out[19] = _follow(x[19], u[3], time, f[F.SERVO_LAG])
        else:
            for i in range(4):
                out[16 + i] = u[i]

    return compiled(forceinline=not with_effects)(actuate)


_actuate = _actuate_of(True)
_actuate_bare = _actuate_of(False)


def _rates_of(with_effects):
    """`_rates` compiled with the effects' calls, or without them for a vehicle that has none.

    One source, two machine codes: a call that might change the workspace costs the bare model a
    fifth of its speed even when it is never made (scripts/benchmark.py).
    """

    def rates(x, p, f, dx):
        """Rates of the paper's sixteen states, (26)-(44), shape (16,), into `dx`.

        Needs `_properties` before it. Leaves loads and rates in the workspace `f`.
        """
        p_, q_, r_ = x[3], x[4], x[5]
        (sin_phi, cos_phi), (sin_theta, cos_theta) = sines_and_cosines(x[10], x[11])
        sin_psi, cos_psi = sine_and_cosine(x[12])
        f[F.SIN_PHI], f[F.COS_PHI] = sin_phi, cos_phi
        f[F.SIN_THETA], f[F.COS_THETA] = sin_theta, cos_theta
        f[F.SIN_PSI], f[F.COS_PSI] = sin_psi, cos_psi
        f[F.HEIGHT] = -x[15]

        f[F.AIR_U], f[F.AIR_V], f[F.AIR_W] = x[0], x[1], x[2]
        if with_effects and p[effects.AIR] != 0.0:
            _air_effects(x, f, p)

        f[F.DELTA_LON], f[F.DELTA_LAT] = x[18], x[19]
        if with_effects and p[effects.SWASH] != 0.0:
            _swash_effects(x, f, p)

        # (15)-(20); upper tilt by the fly-bar, (30)-(31)
        omega_u, omega_l = x[16], x[17]
        f[F.OMEGA_U], f[F.OMEGA_L] = omega_u, omega_l
        f[F.THRUST_U] = f[F.THRUST_FACTOR_U] * omega_u * omega_u
        f[F.THRUST_L] = f[F.THRUST_FACTOR_L] * omega_l * omega_l
        f[F.TORQUE_U] = f[F.TORQUE_FACTOR_U] * omega_u * omega_u
        f[F.TORQUE_L] = f[F.TORQUE_FACTOR_L] * omega_l * omega_l
        f[F.ALPHA_U] = p[P.FLYBAR_TO_ROTOR_LON] * x[8]
        f[F.BETA_U] = p[P.FLYBAR_TO_ROTOR_LAT] * x[9]
        f[F.ALPHA_L], f[F.BETA_L] = x[6], x[7]
        if with_effects and p[effects.ROTOR] != 0.0:
            _rotor_effects(x, f, p)

        # (26)-(27)
        tau = f[F.FLAP_TIME]
        gain = f[F.SWASH_TO_FLAP]
        f[F.ALPHA_L_DOT] = (gain * f[F.DELTA_LON] - x[6] - p[P.FLAP_COUPLING_LON] * x[7]) / tau - q_
        f[F.BETA_L_DOT] = (gain * f[F.DELTA_LAT] - x[7] + p[P.FLAP_COUPLING_LAT] * x[6]) / tau - p_

        # (13)-(14): thrust along [-tan a, tan b, -1], normalised; here times cos a cos b
        (sin_a, cos_a), (sin_b, cos_b) = sines_and_cosines(f[F.ALPHA_U], f[F.BETA_U])
        across = cos_a * sin_b
        along = f[F.THRUST_U] / math.sqrt(cos_b * cos_b + across * across)
        x_u, y_u, z_u = -sin_a * cos_b * along, across * along, -cos_a * cos_b * along
        (sin_a, cos_a), (sin_b, cos_b) = sines_and_cosines(f[F.ALPHA_L], f[F.BETA_L])
        across = cos_a * sin_b
        along = f[F.THRUST_L] / math.sqrt(cos_b * cos_b + across * across)
        x_l, y_l, z_l = -sin_a * cos_b * along, across * along, -cos_a * cos_b * along

        # (21): the upper rotor's wake on the fuselage, V_i^2 = T_u / (2 rho pi R^2)
        area = p[P.FUSELAGE_LENGTH] * p[P.FUSELAGE_WIDTH] * p[P.FUSELAGE_DRAG]
        radius = p[P.ROTOR_RADIUS]
        download = f[F.THRUST_U] * area / (4.0 * math.pi * radius * radius)

        gust = f[F.MASS] / p[P.GUST_MASS]
        f[F.FORCE_X] = x_u + x_l + gust * x[20]
        f[F.FORCE_Y] = y_u + y_l + gust * x[21]
        f[F.FORCE_Z] = z_u + z_l + download + gust * x[22]

        # (35)-(37): hubs at (0, 0, -d); gyroscopic moment -omega x (0, 0, H), (23)-(25)
        momentum = (
            p[P.ROTOR_INERTIA_L] * omega_l - (p[P.ROTOR_INERTIA_U] + p[P.FLYBAR_INERTIA]) * omega_u
        )
        f[F.MOMENT_X] = p[P.ARM_U] * y_u + p[P.ARM_L] * y_l - q_ * momentum
        f[F.MOMENT_Y] = -p[P.ARM_U] * x_u - p[P.ARM_L] * x_l + p_ * momentum
        f[F.MOMENT_Z] = f[F.TORQUE_U] - f[F.TORQUE_L]
        f[F.MOMENT_X] += x[23] * f[F.INERTIA_XX] / p[P.GUST_INERTIA_XX]
        f[F.MOMENT_Y] += x[24] * f[F.INERTIA_YY] / p[P.GUST_INERTIA_YY]
        f[F.MOMENT_Z] += x[25] * f[F.INERTIA_ZZ] / p[P.GUST_INERTIA_ZZ]
        if with_effects and p[effects.LOAD] != 0.0:
            _load_effects(x, f, p)
        if with_effects and p[effects.UNLISTED] != 0.0:
            _unlisted_terms(x, f, p)

        # (32)-(34)
        g = p[P.GRAVITY]
        u_, v_, w_ = x[0], x[1], x[2]
        dx[0] = r_ * v_ - q_ * w_ - g * sin_theta + f[F.FORCE_X] / f[F.MASS]
        dx[1] = p_ * w_ - r_ * u_ + g * cos_theta * sin_phi + f[F.FORCE_Y] / f[F.MASS]
        dx[2] = q_ * u_ - p_ * v_ + g * cos_theta * cos_phi + f[F.FORCE_Z] / f[F.MASS]
        # (35)-(37)
        dx[3] = f[F.P_DOT] = f[F.MOMENT_X] / f[F.INERTIA_XX]
        dx[4] = f[F.Q_DOT] = f[F.MOMENT_Y] / f[F.INERTIA_YY]
        dx[5] = f[F.R_DOT] = f[F.MOMENT_Z] / f[F.INERTIA_ZZ]
        # (26)-(29)
        dx[6] = f[F.ALPHA_L_DOT]
        dx[7] = f[F.BETA_L_DOT]
        dx[8] = -x[8] / f[F.FLYBAR_TIME] - q_
        dx[9] = -x[9] / f[F.FLYBAR_TIME] - p_
        # (38)-(40)
        turn = q_ * sin_phi + r_ * cos_phi
        dx[10] = p_ + turn * sin_theta / cos_theta
        dx[11] = q_ * cos_phi - r_ * sin_phi
        dx[12] = turn / cos_theta
        # (41)-(43)
        forward = u_ * cos_theta + (v_ * sin_phi + w_ * cos_phi) * sin_theta
        right = v_ * cos_phi - w_ * sin_phi
        dx[13] = forward * cos_psi - right * sin_psi
        dx[14] = forward * sin_psi + right * cos_psi
        dx[15] = -u_ * sin_theta + (v_ * sin_phi + w_ * cos_phi) * cos_theta

    return rates


_rates_with_effects = lazily_compiled(_rates_of(True))
_rates_bare = compiled(forceinline=True)(_rates_of(False))


@compiled()
def _switched_on(p):
    """How many of the stages that act in flight have an effect; they are 0 or 1."""
    flown = p[effects.AIR] + p[effects.SWASH] + p[effects.ROTOR] + p[effects.LOAD]
    return flown + p[effects.UNLISTED]


@compiled()
def _rates(x, p, f, dx):
    """Rates of the paper's sixteen states, (26)-(44), shape (16,), into `dx`."""
    if _switched_on(p) != 0.0:
        _rates_with_effects(x, p, f, dx)
    else:
        _rates_bare(x, p, f, dx)


def _step_of(with_effects):
    """`step` compiled with the effects, or for vehicles that have none."""

    def step(x, u, dt, p, work, out):
        """Fly one row: full state (26,) after `dt` seconds of held input, into `out`.

        RK4 on the paper's states; actuators and gusts exactly, at each stage's own time.

        Args:
            x: full state, shape (26,). u: commands and time since the run's start, shape (5,).
            dt: seconds; rows longer than LONGEST_STEP are split. p: parameter vector.
            work: scratch, shape (WORK_SIZE,). out: full state, shape (26,); may be `x` itself.
        """
        f = work[: F.N_FLOW]
        stage = work[F.N_FLOW : F.N_FLOW + N_FULL]
        slope = work[F.N_FLOW + N_FULL : F.N_FLOW + N_FULL + N_STATES]
        total = work[F.N_FLOW + N_FULL + N_STATES : WORK_SIZE]
        parts = max(1, math.ceil(dt / LONGEST_STEP - 1e-9))
        h = dt / parts
        for i in range(N_FULL):
            out[i] = x[i]
        if with_effects:
            _properties(out, u, p, f)
        else:
            _properties_bare(out, u, p, f)
        for _ in range(parts):
            if with_effects:
                # rotor acceleration: the mean over the step, so that angular momentum is kept exactly
                f[F.OMEGA_U_DOT] = (
                    _follow(out[16], u[0] * f[F.SPEED_SCALE], h, f[F.MOTOR_LAG_U]) - out[16]
                ) / h
                f[F.OMEGA_L_DOT] = (
                    _follow(out[17], u[1] * f[F.SPEED_SCALE], h, f[F.MOTOR_LAG_L]) - out[17]
                ) / h
            half_gust = math.exp(-0.5 * h / p[P.GUST_MEMORY])
            for k in range(4):
                time = 0.0 if k == 0 else (h if k == 3 else 0.5 * h)
                fade = 1.0 if k == 0 else (half_gust * half_gust if k == 3 else half_gust)
                for i in range(N_STATES):
                    stage[i] = out[i] if k == 0 else out[i] + time * slope[i]
                for i in range(20, N_FULL):
                    stage[i] = fade * out[i]
                if with_effects:
                    _actuate(out, u, time + READING_DELAY, f, stage)
                    _rates(stage, p, f, slope)
                else:
                    _actuate_bare(out, u, time + READING_DELAY, f, stage)
                    _rates_bare(stage, p, f, slope)
                weight = 1.0 if k == 0 or k == 3 else 2.0
                for i in range(N_STATES):
                    total[i] = weight * slope[i] if k == 0 else total[i] + weight * slope[i]
            for i in range(N_STATES):
                out[i] += h / 6.0 * total[i]
            if with_effects:
                _actuate(out, u, h, f, out)
            else:
                _actuate_bare(out, u, h, f, out)
            for i in range(20, N_FULL):
                out[i] *= half_gust * half_gust

    return lazily_compiled(step) if with_effects else compiled(forceinline=True)(step)


_step_with_effects = _step_of(True)
step_bare = _step_of(False)
"""`step` for a vehicle whose effects are all off: less to compile, and fit for lanes (simd.py)."""


@compiled()
def step(x, u, dt, p, work, out):
    """Fly one row, with the effects that are on; arguments as in `_step_of`."""
    if _switched_on(p) + p[effects.PROPERTY] != 0.0:
        _step_with_effects(x, u, dt, p, work, out)
    else:
        step_bare(x, u, dt, p, work, out)


def _read_of(with_effects):
    """`_read` compiled with the effects, or for vehicles that have none."""

    def read(x, now, slope, p, f, out):
        """Readings of every channel, contract units, (18,), from what `f` holds. Eq. (45)."""
        z = f[F.READING :]
        z[0] = now[16] * (30.0 / math.pi)
        z[1] = now[17] * (30.0 / math.pi)
        z[2], z[3], z[4] = x[3], x[4], x[5]
        z[5] = f[F.FORCE_X] / f[F.MASS]
        z[6] = f[F.FORCE_Y] / f[F.MASS]
        z[7] = f[F.FORCE_Z] / f[F.MASS]
        z[8], z[9], z[10] = x[10], x[11], x[12]
        z[11] = -x[15]
        z[12], z[13], z[14] = slope[13], slope[14], slope[15]
        z[15], z[16] = x[13], x[14]
        z[17] = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
        if with_effects and p[effects.SENSOR] != 0.0:
            _sensor_effects(x, f, p)
        for i in range(N_CHANNELS):
            out[i] = z[i]

    return compiled(forceinline=not with_effects)(read)


_read = _read_of(True)
_read_bare = _read_of(False)


@compiled()
def drift_and_readings(x, u, dt, p, work, out):
    """What a row adds to the full state, and the readings at its start, from one look at the rates.

    For derivatives with respect to states and parameters: the drift is first order in `dt` for the
    paper's states, exact for actuators and gusts. The rotors' acceleration is the row's mean, as in
    `step`, for the readings too.

    Args:
        x, u, dt, p, work: as in `step`. out: drift (26,) and readings (18,), shape (44,).
    """
    f = work[: F.N_FLOW]
    now = work[F.N_FLOW : F.N_FLOW + N_FULL]
    slope = work[F.N_FLOW + N_FULL : F.N_FLOW + N_FULL + N_STATES]
    _properties(x, u, p, f)
    for i in range(N_FULL):
        now[i] = x[i]
    _actuate(x, u, dt, f, now)
    for i in range(N_STATES, N_STATES + 4):
        out[i] = now[i] - x[i]
    if dt > 0.0:
        f[F.OMEGA_U_DOT] = out[16] / dt
        f[F.OMEGA_L_DOT] = out[17] / dt
    _actuate(x, u, READING_DELAY, f, now)
    _rates(now, p, f, slope)
    for i in range(N_STATES):
        out[i] = dt * slope[i]
    fade = math.exp(-dt / p[P.GUST_MEMORY]) - 1.0
    for i in range(20, N_FULL):
        out[i] = fade * x[i]
    _read(x, now, slope, p, f, out[N_FULL:])


def _measure_of(with_effects):
    """`measure` compiled with the effects, or for vehicles that have none."""

    def measure(x, u, p, work, out):
        """Readings of every canonical channel, contract units, shape (18,), into `out`. Eq. (45)."""
        f = work[: F.N_FLOW]
        now = work[F.N_FLOW : F.N_FLOW + N_FULL]
        slope = work[F.N_FLOW + N_FULL : F.N_FLOW + N_FULL + N_STATES]
        for i in range(N_FULL):
            now[i] = x[i]
        if with_effects:
            _properties(x, u, p, f)
            _actuate(x, u, READING_DELAY, f, now)
            # a lagging rotor still accelerates; one without lag has arrived
            if f[F.MOTOR_LAG_U] > 10.0 * READING_DELAY:
                f[F.OMEGA_U_DOT] = (u[0] * f[F.SPEED_SCALE] - now[16]) / f[F.MOTOR_LAG_U]
            if f[F.MOTOR_LAG_L] > 10.0 * READING_DELAY:
                f[F.OMEGA_L_DOT] = (u[1] * f[F.SPEED_SCALE] - now[17]) / f[F.MOTOR_LAG_L]
            _rates(now, p, f, slope)
        else:
            _properties_bare(x, u, p, f)
            _actuate_bare(x, u, READING_DELAY, f, now)
            _rates_bare(now, p, f, slope)
        if with_effects:
            _read(x, now, slope, p, f, out)
        else:
            _read_bare(x, now, slope, p, f, out)

    return lazily_compiled(measure) if with_effects else compiled(forceinline=True)(measure)


_measure_with_effects = _measure_of(True)
measure_bare = _measure_of(False)


@compiled()
def measure(x, u, p, work, out):
    """Readings of every canonical channel, with the effects that are on; as in `_measure_of`."""
    if _switched_on(p) + p[effects.PROPERTY] + p[effects.SENSOR] != 0.0:
        _measure_with_effects(x, u, p, work, out)
    else:
        measure_bare(x, u, p, work, out)


@compiled()
def _full_derivative(x, u, p, work, dx):
    """Rates of the full state at held input, lags as first-order states."""
    f = work[: F.N_FLOW]
    _properties(x, u, p, f)
    targets = (u[0] * f[F.SPEED_SCALE], u[1] * f[F.SPEED_SCALE], u[2], u[3])
    lags = (f[F.MOTOR_LAG_U], f[F.MOTOR_LAG_L], f[F.SERVO_LAG], f[F.SERVO_LAG])
    now = work[F.N_FLOW : F.N_FLOW + N_FULL]
    for i in range(N_FULL):
        now[i] = x[i]
    for i in range(4):
        if lags[i] > SHORTEST_LAG:
            dx[16 + i] = (targets[i] - x[16 + i]) / lags[i]
        else:
            now[16 + i] = targets[i]
            dx[16 + i] = 0.0
    f[F.OMEGA_U_DOT] = dx[16]
    f[F.OMEGA_L_DOT] = dx[17]
    for i in range(20, N_FULL):
        dx[i] = -x[i] / p[P.GUST_MEMORY]
    _rates(now, p, f, dx)


def full_state(state: np.ndarray, command: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """The full state (26,): the paper's sixteen, actuators settled on the command, no gust."""
    x = np.zeros(N_FULL)
    x[:N_STATES] = state
    x[16:20] = command
    return x


def kernel_input(command: np.ndarray, time: float = 0.0) -> np.ndarray:
    """Commands (4,) and time [s] as the kernel's input (5,)."""
    u = np.empty(N_INPUTS)
    u[:N_COMMANDS] = command
    u[TIME] = time
    return u


def full_derivative(x: np.ndarray, u: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """Rates of the full state (26,) for an input (5,); actuators as first-order states."""
    dx = np.zeros(N_FULL)
    _full_derivative(
        np.ascontiguousarray(x, float), np.ascontiguousarray(u, float), vehicle.vector,
        np.zeros(WORK_SIZE), dx,
    )  # fmt: skip
    return dx


def derivative(state: Any, command: Any, vehicle: Vehicle | str) -> np.ndarray:
    """Rates of the paper's states, equations (26)-(44), actuator lags at their static limit.

    Args:
        state: shape (16,), u v w p q r alpha_l beta_l alpha_f beta_f phi theta psi x y z, SI.
        command: shape (4,), omega_u omega_l [rad/s], delta_lon delta_lat [rad].
        vehicle: a Vehicle, or what `load_vehicle` takes.

    Returns:
        shape (16,), in the state's order and units per second.
    """
    vehicle = load_vehicle(vehicle)
    state = np.asarray(state, float)
    command = np.asarray(command, float)
    if state.shape != (N_STATES,) or command.shape != (N_COMMANDS,):
        raise InputError(
            f"derivative needs a state (16,) and a command (4,), found {state.shape}, {command.shape}"
        )
    values = vehicle.vector.copy()
    for lag in ("motor_lag", "servo_lag"):
        entry = effects.CATALOGUE[lag]
        values[entry.index : entry.index + len(entry.parameters)] = 0.0
    dx = np.zeros(N_FULL)
    _full_derivative(
        full_state(state, command, vehicle), kernel_input(command), values, np.zeros(WORK_SIZE), dx
    )
    return dx[:N_STATES]


def readings(state: Any, command: Any, vehicle: Vehicle) -> dict[str, float]:
    """Noise-free readings of every canonical channel at a full or a paper state."""
    state = np.asarray(state, float)
    command = np.asarray(command, float)
    x = full_state(state, command, vehicle) if state.size == N_STATES else state.copy()
    out = np.empty(N_CHANNELS)
    measure(x, kernel_input(command), vehicle.vector, np.zeros(WORK_SIZE), out)
    return dict(zip(CHANNELS, out.tolist(), strict=True))


def hover_trim(vehicle: Vehicle | str, height: float = 1.5) -> tuple[np.ndarray, np.ndarray]:
    """State (16,) and command (4,) that hold the vehicle still over the ground, heading north.

    Args:
        height: of the centre of gravity above ground [m]; matters near the ground only.

    Raises:
        InputError: where the vehicle cannot hover.
    """
    vehicle = load_vehicle(vehicle)
    values = vehicle.values()
    k_T = values["air_density"] * math.pi * values["rotor_radius"] ** 4
    ratio = math.sqrt(values["torque_coefficient_upper"] / values["torque_coefficient_lower"])
    lift = values["thrust_coefficient_upper"] + values["thrust_coefficient_lower"] * ratio**2
    omega = math.sqrt(values["mass"] * values["gravity"] / (k_T * lift))
    scale = np.array([omega, omega, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])

    def unpack(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z = z * scale
        state = np.zeros(N_STATES)
        state[10:12] = z[4:6]
        state[6:8] = z[6:8]
        state[15] = -height
        return state, z[:4]

    def residual(z: np.ndarray) -> np.ndarray:
        state, command = unpack(z)
        return derivative(state, command, vehicle)[:8]

    found = _balance(residual, np.array([1.0, ratio, 0, 0, 0, 0, 0, 0]))
    state, command = unpack(found)
    if np.abs(residual(found)).max() > 1e-6 or command[:2].min() <= 0.0:
        raise InputError(f"vehicle {vehicle.name!r} has no hover: its forces do not balance")
    return state, command


def _balance(residual: Callable[[np.ndarray], np.ndarray], start: np.ndarray) -> np.ndarray:
    """Where as many residuals as unknowns vanish, or come nearest to it.

    Newton's method; least squares where that does not arrive, as near a stage's kink. SciPy alone
    would do, but to import its optimisers takes longer than all else that an env needs.
    """
    z = start.copy()
    step = 1e-6 * np.eye(start.size)
    for _ in range(NEWTON_STEPS):
        slope = np.array([residual(z + d) - residual(z - d) for d in step]).T / 2e-6
        try:
            z = z - np.linalg.solve(slope, residual(z))
        except np.linalg.LinAlgError:
            break
        if np.abs(residual(z)).max() < BALANCED:
            return z
    from scipy.optimize import least_squares

    return least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
