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
from collections.abc import Callable, Collection
from functools import cache
from typing import Any

import numpy as np

from coax_env.errors import InputError
from coax_env.kernel.compilation import compiled
from coax_env.kernel.lazy import compiled_apart, lazily_compiled
from coax_env.kernel.simd import (
    REGISTERS,
    any_lane,
    by_type,
    is_register,
    over_root,
    select,
    sine_and_cosine,
    sines_and_cosines,
)
from coax_env.kernel.variants import WITH_EFFECTS, bare_and_with_effects, inlined, with_effects
from coax_env.model import channels as Z
from coax_env.model import effects
from coax_env.model import inputs as U
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model import workspace as F
from coax_env.model.generic_terms import hover_speeds
from coax_env.model.layout import (
    CHANNELS,
    LOWER_FLAP,
    N_CHANNELS,
    N_COMMANDS,
    N_FULL,
    N_INPUTS,
    N_STATES,
)
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

READING_DELAY = 1e-4  # [s] after the command of the same row
LONGEST_STEP = 0.02  # [s] a longer row is split
NEWTON_STEPS = 12
_INFLOW_TIME = effects.parameter_index("dynamic_inflow.time")
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


# scratch of `step` and `measure`: the workspace, then a full state, then two vectors of rates
_STATE = F.N_FLOW
_SLOPE = _STATE + N_FULL
_TOTAL = _SLOPE + N_STATES
WORK_SIZE = _TOTAL + N_STATES
"""Doubles of scratch that `step` and `measure` need."""


@compiled(forceinline=True)
def _acts(p, stage):
    """Whether a stage has an effect that is on."""
    return p[stage] != 0.0


@compiled(forceinline=True)
def _has_inflow(p):
    """Whether the inflow moves."""
    return any_lane(p[_INFLOW_TIME] > 0.0)


@bare_and_with_effects()
def _properties(x, u, p, f):
    """Vehicle file's numbers into the workspace, once a step. (15)-(20)."""
    f[F.TIME] = u[U.TIME]
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
    f[F.OMEGA_U_DOT] = 0.0
    f[F.OMEGA_L_DOT] = 0.0
    if WITH_EFFECTS:
        f[F.LON_STEP] = u[U.DELTA_LON] - x[S.SWASH_LON]
        f[F.LAT_STEP] = u[U.DELTA_LAT] - x[S.SWASH_LAT]
        f[F.BATTERY] = u[U.BATTERY]
        f[F.SPEED_SHARE_U] = f[F.SPEED_SHARE_L] = f[F.SPEED_SCALE] = 1.0
        f[F.SPEED_REST_U] = f[F.SPEED_REST_L] = 0.0
        f[F.SERVO_PLAY] = f[F.SERVO_DEADBAND] = f[F.SERVO_RATE] = 0.0
        f[F.INFLOW_TIME] = 0.0
        if _has_inflow(p):
            f[F.INFLOW_TIME] = p[_INFLOW_TIME]
            f[F.HOVER_U], f[F.HOVER_L] = hover_speeds(p)
        if _acts(p, effects.PROPERTY):
            _property_effects(x, f, p)


@compiled()
def _follow(start, command, time, lag):
    """Exact first-order response to a held command; without a lag it is its own limit."""
    slow = lag > SHORTEST_LAG
    if any_lane(slow):
        return select(slow, command + (start - command) * math.exp(-time / lag), command)
    return command


@compiled()
def _speeds_asked_for(u, f):
    """Rotor speeds [rad/s] at which the rotors would settle under the commands."""
    upper = f[F.SPEED_SHARE_U] * u[U.OMEGA_U] + f[F.SPEED_REST_U]
    lower = f[F.SPEED_SHARE_L] * u[U.OMEGA_L] + f[F.SPEED_REST_L]
    return f[F.SPEED_SCALE] * upper, f[F.SPEED_SCALE] * lower


@compiled()
def _servo(start, command, time, f):
    """Exact response of the plate's tilt to a held command; only effects make it another.

    With play the plate stands still until the command is half of it away, and follows at that
    distance. A servo with a limited rate runs at it until its lag is the slower. One with a deadband
    stands still within it; if it takes time on its way, it stops where the deadband begins.
    """
    half, dead, rate = 0.5 * f[F.SERVO_PLAY], f[F.SERVO_DEADBAND], f[F.SERVO_RATE]
    lag = f[F.SERVO_LAG]
    end = select(half == 0.0, command, min(max(start, command - half), command + half))
    reached = _follow(start, end, time, lag)
    limited = rate > 0.0
    if any_lane(limited):
        way = start - end
        knee = min(abs(way), rate * lag)  # what is left when the lag is the slower
        running = (abs(way) - knee) / rate
        at_rate = start - math.copysign(rate * time, way)
        slowing = _follow(end + math.copysign(knee, way), end, time - running, lag)
        reached = select(limited, select(time <= running, at_rate, slowing), reached)
    away = start - command
    if any_lane(dead > 0.0):
        slow = limited | (lag > SHORTEST_LAG)
        stops = (dead > 0.0) & slow & (abs(reached - command) < dead)
        reached = select(stops, command + math.copysign(dead, away), reached)
        reached = select(abs(away) <= dead, start, reached)
    return reached


@compiled()
def _lag_of_lag(time, lag, inflow_time):
    """What is left, through a lag of `inflow_time`, of one that decays with another `lag`."""
    alike = abs(lag - inflow_time) < 1e-6 * inflow_time
    fading = math.exp(-time / inflow_time)
    left = lag / select(alike, 1.0, lag - inflow_time) * (math.exp(-time / lag) - fading)
    return select(lag > SHORTEST_LAG, select(alike, time / inflow_time * fading, left), 0.0)


@compiled()
def _inflow(x, u, time, f):
    """Exact inflow `time` after the row's command: it follows the rotors, which follow theirs."""
    lag = f[F.INFLOW_TIME]
    upper, lower = _speeds_asked_for(u, f)
    settled = 0.5 * (upper / f[F.HOVER_U] + lower / f[F.HOVER_L]) - 1.0
    rest_u = 0.5 * (x[S.OMEGA_U] - upper) / f[F.HOVER_U]
    rest_l = 0.5 * (x[S.OMEGA_L] - lower) / f[F.HOVER_L]
    return (
        _follow(x[S.INFLOW], settled, time, lag)
        + rest_u * _lag_of_lag(time, f[F.MOTOR_LAG_U], lag)
        + rest_l * _lag_of_lag(time, f[F.MOTOR_LAG_L], lag)
    )


@bare_and_with_effects()
def _actuate(x, u, time, f, out):
    """Rotor speeds and swash tilt at `time` after the row's command, into the state `out`.

    Only effects part an actuator from its command.
    """
    if WITH_EFFECTS:
        moves = f[F.INFLOW_TIME] > 0.0
        if any_lane(moves):
            out[S.INFLOW] = select(moves, _inflow(x, u, time, f), out[S.INFLOW])
        upper, lower = _speeds_asked_for(u, f)
        out[S.OMEGA_U] = _follow(x[S.OMEGA_U], upper, time, f[F.MOTOR_LAG_U])
        out[S.OMEGA_L] = _follow(x[S.OMEGA_L], lower, time, f[F.MOTOR_LAG_L])
        out[S.SWASH_LON] = _servo(x[S.SWASH_LON], u[U.DELTA_LON], time, f)
        out[S.SWASH_LAT] = _servo(x[S.SWASH_LAT], u[U.DELTA_LAT], time, f)
    else:
        out[S.OMEGA_U], out[S.OMEGA_L] = u[U.OMEGA_U], u[U.OMEGA_L]
        out[S.SWASH_LON], out[S.SWASH_LAT] = u[U.DELTA_LON], u[U.DELTA_LAT]


@compiled()
def _mean_acceleration(start, asked, h, lag):
    """A rotor's over `h` seconds: angular momentum is kept exactly."""
    return (_follow(start, asked, h, lag) - start) / h


@compiled()
def earliness(h, lag):
    """How early in `h` seconds a rotor with a lag speeds up: 0 evenly, 1 all at first.

    Of what r gains by its reaction, times `h`, half is in the heading if it speeds up evenly, all
    of it if at once: 1 / (1 - exp(-h / lag)) - lag / h.
    """
    slow = lag > SHORTEST_LAG
    if any_lane(slow):
        times = h / select(slow, lag, h)
        share = 1.0 / (1.0 - math.exp(-times)) - 1.0 / times
        return select(slow, select(times > 1e-3, 2.0 * share - 1.0, times / 6.0), 1.0)
    return 1.0 + 0.0 * lag


@compiled()
def _of_stage(k, mean, early):
    """A rotor's acceleration in stage `k` of RK4: what comes early is in the first stages.

    Weighed as RK4 does, all stages together are the mean, and those that a heading sees of a rate, the
    first three, its integral. At 60 Hz a rotor that jumps, its mean in every stage, had its reaction on
    the heading 8 ms too late: a yaw inertia was 18 % too large, 7 std (**synthetic**).
    """
    return (1.0 + (2.0 - k if k < 3 else -4.0) * early) * mean


@compiled()
def _rotor_accelerations(x, u, f):
    """The rotors' accelerations now: a lagging rotor still speeds up, one without lag has arrived."""
    upper, lower = _speeds_asked_for(u, f)
    for rotor, lag, change, asked in (
        (S.OMEGA_U, F.MOTOR_LAG_U, F.OMEGA_U_DOT, upper),
        (S.OMEGA_L, F.MOTOR_LAG_L, F.OMEGA_L_DOT, lower),
    ):
        slow = f[lag] > 10.0 * READING_DELAY
        f[change] = select(slow, (asked - x[rotor]) / f[lag], f[change])


@compiled(forceinline=True)
def _thrust_vector(thrust, alpha, beta):
    """A rotor's thrust [N] in body axes: along [-tan a, tan b, -1], normalised. (13)-(14)."""
    (sin_a, cos_a), (sin_b, cos_b) = sines_and_cosines(alpha, beta)
    across = cos_a * sin_b  # all times cos a cos b
    along = over_root(thrust, cos_b * cos_b + across * across)
    return -sin_a * cos_b * along, across * along, -cos_a * cos_b * along


@bare_and_with_effects(lazily=True)
def _rates_in_flight(x, p, f, dx):
    """Rates of the paper's sixteen states, (26)-(44), shape (16,), into `dx`.

    Needs `_properties` before it. Leaves loads and rates in the workspace `f`.
    """
    p_, q_, r_ = x[S.P], x[S.Q], x[S.R]
    (sin_phi, cos_phi), (sin_theta, cos_theta) = sines_and_cosines(x[S.PHI], x[S.THETA])
    sin_psi, cos_psi = sine_and_cosine(x[S.PSI])
    f[F.SIN_PHI], f[F.COS_PHI] = sin_phi, cos_phi
    f[F.SIN_THETA], f[F.COS_THETA] = sin_theta, cos_theta
    f[F.SIN_PSI], f[F.COS_PSI] = sin_psi, cos_psi
    f[F.HEIGHT] = -x[S.Z]

    f[F.AIR_U], f[F.AIR_V], f[F.AIR_W] = x[S.U], x[S.V], x[S.W]
    if WITH_EFFECTS and _acts(p, effects.AIR):
        _air_effects(x, f, p)

    f[F.DELTA_LON], f[F.DELTA_LAT] = x[S.SWASH_LON], x[S.SWASH_LAT]
    if WITH_EFFECTS and _acts(p, effects.SWASH):
        _swash_effects(x, f, p)

    # (15)-(20); upper tilt by the fly-bar, (30)-(31)
    omega_u, omega_l = x[S.OMEGA_U], x[S.OMEGA_L]
    f[F.OMEGA_U], f[F.OMEGA_L] = omega_u, omega_l
    f[F.THRUST_U] = f[F.THRUST_FACTOR_U] * omega_u * omega_u
    f[F.THRUST_L] = f[F.THRUST_FACTOR_L] * omega_l * omega_l
    f[F.TORQUE_U] = f[F.TORQUE_FACTOR_U] * omega_u * omega_u
    f[F.TORQUE_L] = f[F.TORQUE_FACTOR_L] * omega_l * omega_l
    f[F.ALPHA_U] = p[P.FLYBAR_TO_ROTOR_LON] * x[S.ALPHA_F]
    f[F.BETA_U] = p[P.FLYBAR_TO_ROTOR_LAT] * x[S.BETA_F]
    alpha_l, beta_l = x[S.ALPHA_L], x[S.BETA_L]
    f[F.ALPHA_L], f[F.BETA_L] = alpha_l, beta_l
    if WITH_EFFECTS and _acts(p, effects.ROTOR):
        _rotor_effects(x, f, p)

    # (26)-(27)
    tau = f[F.FLAP_TIME]
    gain = f[F.SWASH_TO_FLAP]
    across_lon, across_lat = p[P.FLAP_COUPLING_LON] * beta_l, p[P.FLAP_COUPLING_LAT] * alpha_l
    f[F.ALPHA_L_DOT] = (gain * f[F.DELTA_LON] - alpha_l - across_lon) / tau - q_
    f[F.BETA_L_DOT] = (gain * f[F.DELTA_LAT] - beta_l + across_lat) / tau - p_

    # (13)-(14)
    x_u, y_u, z_u = _thrust_vector(f[F.THRUST_U], f[F.ALPHA_U], f[F.BETA_U])
    x_l, y_l, z_l = _thrust_vector(f[F.THRUST_L], f[F.ALPHA_L], f[F.BETA_L])

    # (21): the upper rotor's wake on the fuselage, V_i^2 = T_u / (2 rho pi R^2)
    area = p[P.FUSELAGE_LENGTH] * p[P.FUSELAGE_WIDTH] * p[P.FUSELAGE_DRAG]
    radius = p[P.ROTOR_RADIUS]
    download = f[F.THRUST_U] * area / (4.0 * math.pi * radius * radius)

    if WITH_EFFECTS:
        f[F.ROTOR_X], f[F.ROTOR_Y], f[F.ROTOR_Z] = x_u + x_l, y_u + y_l, z_u + z_l
    gust = f[F.MASS] / p[P.GUST_MASS]
    f[F.FORCE_X] = x_u + x_l + gust * x[S.GUST_X]
    f[F.FORCE_Y] = y_u + y_l + gust * x[S.GUST_Y]
    f[F.FORCE_Z] = z_u + z_l + download + gust * (x[S.GUST_Z] + x[S.TRIM_Z])

    # (35)-(37): hubs at (0, 0, -d); gyroscopic moment -omega x (0, 0, H), (23)-(25)
    momentum = (
        p[P.ROTOR_INERTIA_L] * omega_l - (p[P.ROTOR_INERTIA_U] + p[P.FLYBAR_INERTIA]) * omega_u
    )
    f[F.MOMENT_X] = p[P.ARM_U] * y_u + p[P.ARM_L] * y_l - q_ * momentum
    f[F.MOMENT_Y] = -p[P.ARM_U] * x_u - p[P.ARM_L] * x_l + p_ * momentum
    f[F.MOMENT_Z] = f[F.TORQUE_U] - f[F.TORQUE_L]
    f[F.MOMENT_X] += x[S.GUST_L] * f[F.INERTIA_XX] / p[P.GUST_INERTIA_XX]
    f[F.MOMENT_Y] += x[S.GUST_M] * f[F.INERTIA_YY] / p[P.GUST_INERTIA_YY]
    f[F.MOMENT_Z] += (x[S.GUST_N] + x[S.TRIM_N]) * f[F.INERTIA_ZZ] / p[P.GUST_INERTIA_ZZ]
    if WITH_EFFECTS and _acts(p, effects.LOAD):
        _load_effects(x, f, p)
    if WITH_EFFECTS and _acts(p, effects.UNLISTED):
        _unlisted_terms(x, f, p)

    # (32)-(34)
    g = p[P.GRAVITY]
    u_, v_, w_ = x[S.U], x[S.V], x[S.W]
    dx[S.U] = r_ * v_ - q_ * w_ - g * sin_theta + f[F.FORCE_X] / f[F.MASS]
    dx[S.V] = p_ * w_ - r_ * u_ + g * cos_theta * sin_phi + f[F.FORCE_Y] / f[F.MASS]
    dx[S.W] = q_ * u_ - p_ * v_ + g * cos_theta * cos_phi + f[F.FORCE_Z] / f[F.MASS]
    # (35)-(37)
    dx[S.P] = f[F.P_DOT] = f[F.MOMENT_X] / f[F.INERTIA_XX]
    dx[S.Q] = f[F.Q_DOT] = f[F.MOMENT_Y] / f[F.INERTIA_YY]
    dx[S.R] = f[F.R_DOT] = f[F.MOMENT_Z] / f[F.INERTIA_ZZ]
    # (26)-(29)
    dx[S.ALPHA_L] = f[F.ALPHA_L_DOT]
    dx[S.BETA_L] = f[F.BETA_L_DOT]
    dx[S.ALPHA_F] = -x[S.ALPHA_F] / f[F.FLYBAR_TIME] - q_
    dx[S.BETA_F] = -x[S.BETA_F] / f[F.FLYBAR_TIME] - p_
    # (38)-(40)
    turn = q_ * sin_phi + r_ * cos_phi
    dx[S.PHI] = p_ + turn * sin_theta / cos_theta
    dx[S.THETA] = q_ * cos_phi - r_ * sin_phi
    dx[S.PSI] = turn / cos_theta
    # (41)-(43)
    forward = u_ * cos_theta + (v_ * sin_phi + w_ * cos_phi) * sin_theta
    right = v_ * cos_phi - w_ * sin_phi
    dx[S.X] = forward * cos_psi - right * sin_psi
    dx[S.Y] = forward * sin_psi + right * cos_psi
    dx[S.Z] = -u_ * sin_theta + (v_ * sin_phi + w_ * cos_phi) * cos_theta


@compiled()
def _switched_on(p):
    """How many of the stages that act in flight have an effect; they are 0 or 1."""
    flown = p[effects.AIR] + p[effects.SWASH] + p[effects.ROTOR] + p[effects.LOAD]
    return flown + p[effects.UNLISTED]


_rates_bare, _rates_with_effects, _ = _rates_in_flight


@compiled()
def _rates_where_on(x, p, f, dx):
    """`_rates_in_flight`, with the effects if any acts in flight."""
    if _switched_on(p) != 0.0:
        _rates_with_effects(x, p, f, dx)
    else:
        _rates_bare(x, p, f, dx)


_rates: Any = _rates_in_flight._replace(with_effects=_rates_where_on)


_GUST_MEMORY = (
    P.MEMORY_FORCE_XY, P.MEMORY_FORCE_XY, P.MEMORY_FORCE_Z,
    P.MEMORY_MOMENT_XY, P.MEMORY_MOMENT_XY, P.MEMORY_MOMENT_Z,
)  # fmt: skip


@compiled(forceinline=True)
def _fade(time, p):
    """What is left of the gusts after `time` seconds, by group of axes: force xy, z, moment xy, z."""
    return (
        math.exp(-time / p[P.MEMORY_FORCE_XY]),
        math.exp(-time / p[P.MEMORY_FORCE_Z]),
        math.exp(-time / p[P.MEMORY_MOMENT_XY]),
        math.exp(-time / p[P.MEMORY_MOMENT_Z]),
    )


_STAYS = (1.0, 1.0, 1.0, 1.0)
"""What `_fade` is where nothing fades."""


@compiled(forceinline=True)
def _gusty(x):
    """Whether a full state has a gust."""
    return (
        x[S.GUST_X] != 0.0 or x[S.GUST_Y] != 0.0 or x[S.GUST_Z] != 0.0
        or x[S.GUST_L] != 0.0 or x[S.GUST_M] != 0.0 or x[S.GUST_N] != 0.0
    )  # fmt: skip


@compiled(forceinline=True)
def _fade_gusts(fade, x):
    """Let the gusts of a full state fade, in place."""
    x[S.GUST_X] *= fade[0]
    x[S.GUST_Y] *= fade[0]
    x[S.GUST_Z] *= fade[1]
    x[S.GUST_L] *= fade[2]
    x[S.GUST_M] *= fade[2]
    x[S.GUST_N] *= fade[3]


@compiled(forceinline=True)
def _copy(state, out):
    """A full state into another."""
    for i in range(N_FULL):
        out[i] = state[i]


def _parts(dt):
    """In how many parts a row of `dt` seconds is flown; where rows are of different lengths in a
    register, none is longer than LONGEST_STEP.
    """
    return max(1, math.ceil(dt / LONGEST_STEP - 1e-9))


@by_type(_parts)
def _parts_of(dt):
    if is_register(dt):
        return lambda dt: 1
    return lambda dt: max(1, math.ceil(dt / LONGEST_STEP - 1e-9))


@bare_and_with_effects(lazily=True)
def _step(x, u, dt, p, work, out):
    """`step`. RK4 on the paper's states; actuators and gusts exactly, at each stage's own time."""
    f, stage = work[:_STATE], work[_STATE:_SLOPE]
    slope, total = work[_SLOPE:_TOTAL], work[_TOTAL:WORK_SIZE]
    parts = _parts(dt)
    h = dt / parts
    _copy(x, out)
    _properties(out, u, p, f)
    gusty = _gusty(out)  # without one, nothing fades
    for _ in range(parts):
        if WITH_EFFECTS:
            upper, lower = _speeds_asked_for(u, f)
            lag_u, lag_l = f[F.MOTOR_LAG_U], f[F.MOTOR_LAG_L]
            mean_u, early_u = _mean_acceleration(out[S.OMEGA_U], upper, h, lag_u), earliness(h, lag_u)
            mean_l, early_l = _mean_acceleration(out[S.OMEGA_L], lower, h, lag_l), earliness(h, lag_l)
        half_fade = _fade(0.5 * h, p) if gusty else _STAYS
        for i in range(S.GUST_X, N_FULL):
            stage[i] = out[i]
        for k in range(4):
            time = 0.0 if k == 0 else (h if k == 3 else 0.5 * h)
            for i in range(N_STATES):
                stage[i] = out[i] if k == 0 else out[i] + time * slope[i]
            if gusty and (k == 1 or k == 3):
                _fade_gusts(half_fade, stage)
            if WITH_EFFECTS:
                f[F.OMEGA_U_DOT] = _of_stage(k, mean_u, early_u)
                f[F.OMEGA_L_DOT] = _of_stage(k, mean_l, early_l)
            _actuate(out, u, time + READING_DELAY, f, stage)
            _rates(stage, p, f, slope)
            weight = 1.0 if k == 0 or k == 3 else 2.0
            for i in range(N_STATES):
                total[i] = weight * slope[i] if k == 0 else total[i] + weight * slope[i]
        for i in range(N_STATES):
            out[i] += h / 6.0 * total[i]
        _actuate(out, u, h, f, out)
        for i in range(S.GUST_X, S.TRIM_Z):
            out[i] = stage[i]


step_bare, _step_with_effects, _ = _step
"""`step_bare`: `step` for a vehicle whose effects are all off: less to compile, and fit for SIMD
batches (kernel/simd.py)."""


@compiled()
def step(x, u, dt, p, work, out):
    """Fly one row of held input, with the effects that are on.

    Args:
        x: full state (29,), see state.py. u: commands, time and battery (6,), see inputs.py.
        dt: length of the row [s]; rows longer than LONGEST_STEP are split.
        p: parameter vector, see parameters.py. work: scratch (WORK_SIZE,).
        out: full state (29,) at the row's end; may be `x` itself.
    """
    if _switched_on(p) + p[effects.PROPERTY] != 0.0:
        _step_with_effects(x, u, dt, p, work, out)
    else:
        step_bare(x, u, dt, p, work, out)


@bare_and_with_effects()
def _read(x, now, slope, p, f, out):
    """Readings of every channel, in its unit, (18,), from what `f` holds. Eq. (45)."""
    z = f[F.READING :]
    z[Z.RPM_UPPER] = now[S.OMEGA_U] * (30.0 / math.pi)
    z[Z.RPM_LOWER] = now[S.OMEGA_L] * (30.0 / math.pi)
    z[Z.P], z[Z.Q], z[Z.R] = x[S.P], x[S.Q], x[S.R]
    z[Z.AX] = f[F.FORCE_X] / f[F.MASS]
    z[Z.AY] = f[F.FORCE_Y] / f[F.MASS]
    z[Z.AZ] = f[F.FORCE_Z] / f[F.MASS]
    z[Z.PHI], z[Z.THETA], z[Z.PSI] = x[S.PHI], x[S.THETA], x[S.PSI]
    z[Z.H] = -x[S.Z]
    z[Z.VN], z[Z.VE], z[Z.VD] = slope[S.X], slope[S.Y], slope[S.Z]
    z[Z.PN], z[Z.PE] = x[S.X], x[S.Y]
    z[Z.V] = math.sqrt(x[S.U] * x[S.U] + x[S.V] * x[S.V] + x[S.W] * x[S.W])
    if WITH_EFFECTS and _acts(p, effects.SENSOR):
        _sensor_effects(x, f, p)
    for i in range(N_CHANNELS):
        out[i] = z[i]


def _drift_and_readings(x, u, dt, p, work, out):
    """What a row adds to the full state, and the readings at its start, from one look at the rates.

    For derivatives with respect to states and parameters: the drift is first order in `dt` for the
    paper's states, exact for actuators and gusts. The rotors' acceleration is the row's mean, as in
    `step`, for the readings too.

    Args:
        x, u, dt, p, work: as in `step`.
        out: drift (29,) and readings (18,), one after the other (44,).
    """
    f, now, slope = work[:_STATE], work[_STATE:_SLOPE], work[_SLOPE:_TOTAL]
    _properties(x, u, p, f)
    _copy(x, now)
    _actuate(x, u, dt, f, now)
    inflow = now[S.INFLOW] - x[S.INFLOW]
    for i in range(N_STATES, S.GUST_X):
        out[i] = now[i] - x[i]
    if dt > 0.0:
        f[F.OMEGA_U_DOT] = out[S.OMEGA_U] / dt
        f[F.OMEGA_L_DOT] = out[S.OMEGA_L] / dt
    _actuate(x, u, READING_DELAY, f, now)
    _rates(now, p, f, slope)
    for i in range(N_STATES):
        out[i] = dt * slope[i]
    for i in range(S.GUST_X, N_FULL):
        out[i] = x[i]
    _fade_gusts(_fade(dt, p), out)
    for i in range(S.GUST_X, N_FULL):
        out[i] -= x[i]
    out[S.INFLOW] = inflow
    _read(x, now, slope, p, f, out[N_FULL:])


drift_and_readings = with_effects(_drift_and_readings)


@bare_and_with_effects(lazily=True)
def _measure(x, u, p, work, out):
    """`measure`."""
    f, now, slope = work[:_STATE], work[_STATE:_SLOPE], work[_SLOPE:_TOTAL]
    _copy(x, now)
    _properties(x, u, p, f)
    _actuate(x, u, READING_DELAY, f, now)
    if WITH_EFFECTS:
        _rotor_accelerations(now, u, f)
    _rates(now, p, f, slope)
    _read(x, now, slope, p, f, out)


measure_bare, _measure_with_effects, _ = _measure


@compiled()
def measure(x, u, p, work, out):
    """Readings of every canonical channel, with the effects that are on. Eq. (45).

    Args:
        x, u, p, work: as in `step`.
        out: readings (18,), see channels.py, each in its unit.
    """
    if _switched_on(p) + p[effects.PROPERTY] + p[effects.SENSOR] != 0.0:
        _measure_with_effects(x, u, p, work, out)
    else:
        measure_bare(x, u, p, work, out)


def _always(p, stage):
    """What `_acts` is where the stages hold those effects only that are on."""
    return True


def _never(p):
    """What `_has_inflow` is without the effect."""
    return False


def _stages_with(used: Collection[str] | None = None) -> dict[str, Any]:
    """Names of what differs where some effects alone are in the kernel, or all, and what they mean."""
    return {
        "WITH_EFFECTS": True,
        "_air_effects": effects.stage_source(effects.AIR, used),
        "_swash_effects": effects.stage_source(effects.SWASH, used),
        "_rotor_effects": effects.stage_source(effects.ROTOR, used),
        "_load_effects": effects.stage_source(effects.LOAD, used),
        "_unlisted_terms": effects.stage_source(effects.UNLISTED, used),
        "_sensor_effects": effects.stage_source(effects.SENSOR, used),
        "_property_effects": effects.stage_source(effects.PROPERTY, used),
    }


@cache
def motion_of_registers() -> tuple[Any, Any, Any]:
    """`step`, `measure`, `drift_and_readings` with every effect, to be called with SIMD registers."""
    motion = (_step, _measure, _drift_and_readings)
    made = inlined(motion, _stages_with(), "of_registers", forced=False)
    step, measure, drift = (compiled_apart(function.py_func, REGISTERS) for function in made)
    return step, measure, drift


def step_and_measure_with(used: Collection[str], kind: str) -> tuple[Any, Any]:
    """`step` and `measure` with some effects alone in them, all inlined: for SIMD batches.

    Args:
        used: full names of the parameters that may be away from their off-values.
        kind: one word that tells this choice from others.
    """
    names = _stages_with(used) | {"_acts": _always}
    if not any(name.startswith("dynamic_inflow.") for name in used):
        names["_has_inflow"] = _never
    step_with, measure_with = inlined((_step, _measure), names, kind)
    return step_with, measure_with


@bare_and_with_effects(lazily=True)
def _full_derivative(x, u, p, work, dx):
    """Rates of the full state at held input, lags as first-order states.

    Play, deadband and rate limit of the servos, which have no rate at a held command, are left out.
    """
    f, now = work[:_STATE], work[_STATE:_SLOPE]
    _properties(x, u, p, f)
    _copy(x, now)
    dx[N_STATES:] = 0.0
    if WITH_EFFECTS:
        upper, lower = _speeds_asked_for(u, f)
        targets = (upper, lower, u[U.DELTA_LON], u[U.DELTA_LAT])
        lags = (f[F.MOTOR_LAG_U], f[F.MOTOR_LAG_L], f[F.SERVO_LAG], f[F.SERVO_LAG])
        for i in range(N_COMMANDS):
            actuator = S.OMEGA_U + i
            if lags[i] > SHORTEST_LAG:
                dx[actuator] = (targets[i] - x[actuator]) / lags[i]
            else:
                now[actuator] = targets[i]
        f[F.OMEGA_U_DOT] = dx[S.OMEGA_U]
        f[F.OMEGA_L_DOT] = dx[S.OMEGA_L]
        if f[F.INFLOW_TIME] > 0.0:
            speed = 0.5 * (now[S.OMEGA_U] / f[F.HOVER_U] + now[S.OMEGA_L] / f[F.HOVER_L])
            dx[S.INFLOW] = (speed - 1.0 - x[S.INFLOW]) / f[F.INFLOW_TIME]
    else:
        _actuate(x, u, 0.0, f, now)
    for i, memory in enumerate(_GUST_MEMORY):
        dx[S.GUST_X + i] = -x[S.GUST_X + i] / p[memory]
    _rates(now, p, f, dx)


_derivative_bare, _derivative_with_effects, _ = _full_derivative


@compiled()
def _derivative(x, u, p, work, dx):
    """`_full_derivative`, with the effects if any is on."""
    if _switched_on(p) + p[effects.PROPERTY] != 0.0:
        _derivative_with_effects(x, u, p, work, dx)
    else:
        _derivative_bare(x, u, p, work, dx)


def full_state(state: np.ndarray, command: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """The full state (29,): the paper's sixteen, actuators and inflow settled on the command, no gust.

    Args:
        state: the paper's states (16,). command: commands (4,). vehicle: whose state it is.
    """
    x = np.zeros(N_FULL)
    x[:N_STATES] = state
    x[S.OMEGA_U : S.GUST_X] = command
    if "dynamic_inflow" in vehicle.effects:
        x[S.INFLOW] = np.mean(np.asarray(command)[:2] / hover_speeds(vehicle.vector)) - 1.0
    return x


def kernel_input(command: np.ndarray, time: float = 0.0) -> np.ndarray:
    """Commands (4,) and time [s] as the kernel's input (6,), the battery at its nominal voltage."""
    u = np.zeros(N_INPUTS)
    u[:N_COMMANDS] = command
    u[U.TIME] = time
    return u


def full_derivative(x: np.ndarray, u: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """Rates of the full state (29,); actuators as first-order states, the servos' play, deadband and
    rate limit left out.

    Args:
        x: full state (29,). u: commands, time and battery (6,). vehicle: its numbers and effects.
    """
    dx = np.zeros(N_FULL)
    _derivative(
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
    _derivative(
        full_state(state, command, vehicle), kernel_input(command), values, np.zeros(WORK_SIZE), dx
    )
    return dx[:N_STATES]


def readings(state: Any, command: Any, vehicle: Vehicle) -> dict[str, float]:
    """Noise-free readings of every canonical channel, in its unit (layout.CHANNEL_UNITS).

    Args:
        state: full state (29,), or the paper's (16,) with actuators settled on the command.
        command: commands (4,). vehicle: its numbers and effects.
    """
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
        state[S.PHI : S.PSI] = z[4:6]
        state[LOWER_FLAP] = z[6:8]
        state[S.Z] = -height
        return state, z[:4]

    def residual(z: np.ndarray) -> np.ndarray:
        state, command = unpack(z)
        return derivative(state, command, vehicle)[: S.ALPHA_F]  # the first eight rates

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
