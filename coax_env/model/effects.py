"""The catalogue of effects: what a real small coaxial helicopter has and the bare model lacks.

An effect is a group of parameters of the one model; at its off-value it is not there. **To add one,
write one function under an** `@effect(...)` **entry below; nothing else changes**: the vehicle files,
the kernel, the estimator, the diagnosis and the reports all read the catalogue.

The function gets ``(x, f, p, e)``: full state (layout.py), the kernel's workspace (workspace.py), the
parameter vector, and the index ``e`` of the effect's first parameter in it. It changes the workspace
in place. It runs at its *stage* of the kernel (dynamics.py):

- ``PROPERTY``, once a step: mass, inertia, gains, lags of the actuators;
- ``AIR``: the velocity through the air;
- ``SWASH``: the swash plate's tilt;
- ``ROTOR``: thrust and torque of the two rotors;
- ``LOAD``: forces, moments and flap rates;
- ``UNLISTED``: the generic terms of what no effect here explains (generic_terms.py);
- ``SENSOR``: readings.

The same function flies one helicopter and, handed registers, SIMD_WIDTH of them (kernel/simd.py):
where helicopters differ there is no ``if`` but `select`. ``if p[e] != 0.0`` may stay: it asks whether
the effect is on in any, so what follows must change nothing where it is zero.

An effect with a memory of its own uses one: rotor speeds and the plate's tilt are states of the
kernel (MOTOR_LAG_*, SERVO_*, discretised exactly, so that zero is a limit and not a branch); a
pure delay of the commands is a shift of the input (helicopter.py), of a reading its rate of change.

A stage whose effects are all off is skipped by one test, so that the bare model pays nothing.
Signs and usual sizes are stated with each effect; "usual" is also the width of the prior. They are
those of the 0.8 kg lama400d; what belongs to the machine scales with it (usual_sizes.py), what is
bought (servos, radio, sensors, batteries) and the weather do not, nor do the blade grips' springs:
what is known of them comes from a machine of 0.3 kg and is as much there.
What physics gives one sign only (drag, damping, stiffness, lag) is bounded at zero: a fit that wants
the other sign is explaining something else.
"""

import math

from coax_env.kernel.compilation import compiled
from coax_env.kernel.simd import any_lane, select
from coax_env.model import channels as Z
from coax_env.model import generic_terms
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model import workspace as F
from coax_env.model.effect_registry import (
    AIR,
    CATALOGUE,
    GROUPS,
    LOAD,
    PROPERTY,
    ROTOR,
    SENSOR,
    STAGES,
    SWASH,
    SWITCHES,
    UNLISTED,
    Effect,
    EffectParameter,
    acting,
    completed,
    effect,
    forget,
    found_by_the_name_of,
    n_parameters,
    off_vector,
    pack,
    parameter_index,
    set_switches,
    stage_function,
    stage_source,
    switched_on,
)
from coax_env.model.layout import RPM_PER_RAD_S

__all__ = [
    "AIR",
    "CATALOGUE",
    "GROUPS",
    "LOAD",
    "PROPERTY",
    "ROTOR",
    "SENSOR",
    "STAGES",
    "SWASH",
    "SWITCHES",
    "UNLISTED",
    "Effect",
    "EffectParameter",
    "acting",
    "completed",
    "effect",
    "forget",
    "found_by_the_name_of",
    "n_parameters",
    "off_vector",
    "pack",
    "parameter_index",
    "set_switches",
    "stage_function",
    "stage_source",
    "switched_on",
]

DEGREE = math.pi / 180.0
INFLOW_GAIN = 1.2
"""Relative rise of thrust over that of its square law, per relative rise of rotor speed at held inflow.

By blade elements C_T = sigma a / 2 (theta / 3 - lambda / 2), lambda = v / (Omega R) = sqrt(C_T / 2) in
hover. With v held, d ln T / d ln Omega = 2 + e, e = (lambda / 2) / (theta / 3 - lambda / 2) = sigma a /
(4 sqrt(2 C_T)): 1.2 at solidity 0.1, lift slope 5.3, C_T 0.006. Vehicle files have no solidity; thrust
shows e times the time constant, so that 10 % here are 10 % there.
"""
NO_RATE_LIMIT = 10.0
"""Rate of the swash plate [rad/s] that counts as none; ours."""


# --- properties -----------------------------------------------------------------------------------


@effect(
    PROPERTY,
    EffectParameter("mass", "kg", usual=0.05, smallest=0.01, scale="mass"),
    channels="az vd h",
    source="Newton; a payload at the centre of gravity",
    replaces=("mass",),
)
def added_mass(x, f, p, e):
    """Mass m + dm: something is carried that the scale did not see."""
    f[F.MASS] += p[e]


@effect(
    PROPERTY,
    EffectParameter("scale", "1", usual=0.07, smallest=0.02, lower=-0.3, upper=0.5),
    channels="az vd h",
    source="eqs (15)-(16)",
    replaces=("thrust_coefficient_upper",),
)
def thrust_scale(x, f, p, e):
    """Both thrust coefficients times (1 + s)."""
    f[F.THRUST_FACTOR_U] *= 1.0 + p[e]
    f[F.THRUST_FACTOR_L] *= 1.0 + p[e]


@effect(
    PROPERTY,
    EffectParameter("scale", "1", usual=0.07, smallest=0.02, lower=-0.3, upper=0.5),
    channels="r psi",
    source="eqs (19)-(20)",
    replaces=("torque_coefficient_lower",),
)
def torque_balance(x, f, p, e):
    """Torque coefficient of the lower rotor times (1 + s)."""
    f[F.TORQUE_FACTOR_L] *= 1.0 + p[e]


@effect(
    PROPERTY,
    EffectParameter("scale", "1", usual=0.2, smallest=0.05, lower=-0.8),
    channels="r psi",
    source="eq (37)",
    replaces=("inertia_zz",),
)
def yaw_inertia(x, f, p, e):
    """Yaw inertia I_zz (1 + s)."""
    f[F.INERTIA_ZZ] *= 1.0 + p[e]


@effect(
    PROPERTY,
    EffectParameter("scale", "1", usual=0.15, smallest=0.03, lower=-0.9),
    channels="p q phi theta",
    source="eqs (26)-(27)",
    replaces=("swash_to_flap",),
)
def swash_gain(x, f, p, e):
    """Linkage gain K_b (1 + s)."""
    f[F.SWASH_TO_FLAP] *= 1.0 + p[e]


@effect(
    PROPERTY,
    EffectParameter("scale", "1", usual=0.35, smallest=0.1, lower=-0.9),
    channels="p q phi theta",
    source="eqs (28)-(29)",
    replaces=("flybar_time_constant",),
)
def flybar_time_constant(x, f, p, e):
    """Following time of the stabiliser bar, tau_ff (1 + s)."""
    f[F.FLYBAR_TIME] *= 1.0 + p[e]


@effect(
    PROPERTY,
    EffectParameter(
        "upper",
        "s",
        usual=0.1,
        smallest=0.01,
        lower=0.0,
        upper=1.0,
        timing=True,
        probe=0.03,
        scale="time",
    ),
    EffectParameter(
        "lower",
        "s",
        usual=0.1,
        smallest=0.01,
        lower=0.0,
        upper=1.0,
        timing=True,
        probe=0.03,
        scale="time",
    ),
    channels="rpm_upper rpm_lower az r",
    source="first-order motor and speed controller, Beard and McLain 2012, ch. 4",
)
def motor_lag(x, f, p, e):
    """Rotor speeds follow their commands with first-order lags."""
    f[F.MOTOR_LAG_U] = p[e]
    f[F.MOTOR_LAG_L] = p[e + 1]


@effect(
    PROPERTY,
    EffectParameter(
        "time", "s", usual=0.04, smallest=0.008, lower=0.0, upper=0.5, timing=True, probe=0.02
    ),
    channels="p q",
    source="first-order servo, Mettler 2003, ch. 3",
)
def servo_lag(x, f, p, e):
    """Swash plate servos follow their commands with a first-order lag."""
    f[F.SERVO_LAG] = p[e]


@effect(
    PROPERTY,
    EffectParameter(
        "time", "s", usual=0.03, smallest=0.008, lower=0.0, upper=0.3, timing=True, probe=0.02
    ),
    channels="p q",
    source="transport delay; the commands are shifted in time and the step is split",
    input_shift=True,
)
def servo_delay(x, f, p, e):
    """Swash plate commands arrive after a pure delay (the input is shifted, see helicopter.py)."""


@effect(
    PROPERTY,
    EffectParameter("rate", "1/s", usual=0.002, smallest=0.0003, lower=0.0),
    channels="rpm_upper rpm_lower az r",
    source="falling battery voltage, to first order in time",
)
def battery_sag(x, f, p, e):
    """Rotor speed per command falls with time: omega = (1 - rate t) command."""
    f[F.SPEED_SCALE] *= 1.0 - p[e] * f[F.TIME]


@effect(
    PROPERTY,
    EffectParameter("per_volt", "1/V", usual=0.05, smallest=0.01, lower=0.0, upper=0.5),
    EffectParameter("nominal", "V", usual=3.0, smallest=0.0, off=11.1, lower=1.0, held=True),
    channels="rpm_upper rpm_lower az r",
    source="open-loop drive: speed follows the battery's voltage, to first order about the nominal one",
)
def battery_voltage(x, f, p, e):
    """Rotor speed per command times 1 + k (V - nominal), with the battery's logged voltage V.

    Off: the usual 3 cells of 3.7 V. Where no rotor speed is measured the nominal voltage is one column
    with the thrust coefficients: it is stated, not fitted (battery.stated). No more than speed
    proportional to voltage is to be expected: k = 1/nominal.
    """
    f[F.SPEED_SCALE] *= 1.0 + p[e] * f[F.BATTERY]


@effect(
    PROPERTY,
    EffectParameter(
        "time", "s", usual=0.03, smallest=0.008, lower=0.0, upper=0.3, timing=True, probe=0.02
    ),
    channels="p q az r",
    source="transport delay of radio, motion capture and firmware, as servo_delay",
    input_shift=True,
)
def command_delay(x, f, p, e):
    """All four commands arrive after a pure delay; the swash plate's after servo_delay's too."""


@effect(
    PROPERTY,
    EffectParameter("upper", "1", usual=0.2, smallest=0.04, lower=0.0, upper=0.9),
    EffectParameter("lower", "1", usual=0.2, smallest=0.04, lower=0.0, upper=0.9),
    channels="rpm_upper rpm_lower az r",
    source="proportional speed control of a loaded motor; Mohan, Undeland and Robbins 2003, ch. 13",
)
def motor_droop(x, f, p, e):
    """Rotors follow a share of a speed command: hover + (1 - d) (command - hover), per rotor.

    Hover is the bare model's: what a rotor with droop needs to hover is in the bench line or trim.
    """
    if p[e] != 0.0 or p[e + 1] != 0.0:
        hover_u, hover_l = generic_terms.hover_speeds(p)
        f[F.SPEED_SHARE_U] = 1.0 - p[e]
        f[F.SPEED_REST_U] = p[e] * hover_u
        f[F.SPEED_SHARE_L] = 1.0 - p[e + 1]
        f[F.SPEED_REST_L] = p[e + 1] * hover_l


@effect(
    PROPERTY,
    EffectParameter("width", "rad", usual=0.015, smallest=0.004, lower=0.0, upper=0.1, probe=0.01),
    channels="p q",
    source="backlash (play operator); Nordin and Gutman, Automatica 38, 2002",
)
def servo_play(x, f, p, e):
    """Play between servo and swash plate: the plate trails its command within +- width / 2."""
    f[F.SERVO_PLAY] = p[e]


@effect(
    PROPERTY,
    EffectParameter("width", "rad", usual=0.01, smallest=0.003, lower=0.0, upper=0.1),
    channels="p q",
    source="servo electronics: errors under the deadband are not driven",
    named_as="servo_play",
)
def servo_deadband(x, f, p, e):
    """A servo does not move while its command is within the width of where it stands.

    Without a lag or a limited rate it then goes all the way; else it stops where the deadband begins.
    When it goes depends on the last digit of the command: its likelihood over the width is as rough as
    noise (0.012 rad hidden: 1 mrad up or down is worth +-50 nats), where play of the same width, which
    trails as far on average, is smooth and worth 40. So the one name stands for both.
    """
    f[F.SERVO_DEADBAND] = p[e]


@effect(
    PROPERTY,
    EffectParameter(
        "limit",
        "rad/s",
        usual=4.0,
        smallest=3.0,
        off=NO_RATE_LIMIT,
        lower=0.2,
        upper=NO_RATE_LIMIT,
        probe=-9.0,
    ),
    channels="p q",
    source="no-load speed of a servo, about 0.1 s for 60 degrees, times its linkage",
)
def servo_rate(x, f, p, e):
    """The swash plate's tilt changes no faster than the limit; NO_RATE_LIMIT and above: at once.

    There is no slope at the off-value: a tenth of a radian takes 10 ms at it, a row of a log, and what
    is faster no flight shows. Its signature is that of 1 rad/s, two and a quarter usual sizes off.
    """
    f[F.SERVO_RATE] = select(p[e] < NO_RATE_LIMIT, p[e], 0.0)


# --- air ------------------------------------------------------------------------------------------


@compiled()
def _in_body_axes(f, north, east, down):
    """A vector of the world's axes in those of the body."""
    forward = north * f[F.COS_PSI] + east * f[F.SIN_PSI]
    right = -north * f[F.SIN_PSI] + east * f[F.COS_PSI]
    return (
        f[F.COS_THETA] * forward - f[F.SIN_THETA] * down,
        f[F.SIN_PHI] * f[F.SIN_THETA] * forward
        + f[F.COS_PHI] * right
        + f[F.SIN_PHI] * f[F.COS_THETA] * down,
        f[F.COS_PHI] * f[F.SIN_THETA] * forward
        - f[F.SIN_PHI] * right
        + f[F.COS_PHI] * f[F.COS_THETA] * down,
    )


@effect(
    AIR,
    EffectParameter("north", "m/s", usual=1.5, smallest=0.2),
    EffectParameter("east", "m/s", usual=1.5, smallest=0.2),
    channels="ax ay p q",
    source="V_a = V - R^T w; acts only through a drag or blow-back",
)
def wind(x, f, p, e):
    """Steady wind: the air's velocity towards north and east (turbulence adds to it in the env)."""
    u, v, w = _in_body_axes(f, p[e], p[e + 1], p[P.AIR_DOWN])
    f[F.AIR_U] -= u
    f[F.AIR_V] -= v
    f[F.AIR_W] -= w


# --- swash plate ----------------------------------------------------------------------------------


@effect(
    SWASH,
    EffectParameter("angle", "rad", usual=0.2, smallest=0.03),
    EffectParameter("per_rpm", "rad per rev/min", usual=2e-4, smallest=5e-5),
    channels="p q",
    source="control phase angle, Bramwell 2001, ch. 5; a lag of T seconds adds T per rad/s of rotor",
)
def swash_phase(x, f, p, e):
    """Swash plate turned about the mast: lon and lat commands mix by an angle.

    angle + per_rpm (lower rotor's speed less the bare model's hover). A teetering rotor on a delay of T
    seconds between plate and blade turns by T Omega: 2 ms are 2e-4 rad per rev/min.
    """
    angle = p[e]
    if p[e + 1] != 0.0:
        _, hover = generic_terms.hover_speeds(p)
        angle += p[e + 1] * RPM_PER_RAD_S * (x[S.OMEGA_L] - hover)
    cosine, sine = math.cos(angle), math.sin(angle)
    lon, lat = f[F.DELTA_LON], f[F.DELTA_LAT]
    f[F.DELTA_LON] = cosine * lon - sine * lat
    f[F.DELTA_LAT] = sine * lon + cosine * lat


@effect(
    SWASH,
    EffectParameter("lon", "rad", usual=DEGREE, smallest=0.003),
    EffectParameter("lat", "rad", usual=DEGREE, smallest=0.003),
    channels="p q ax ay",
    source="rigging error, added to the plate's tilt",
)
def swash_offset(x, f, p, e):
    """Swash plate not level at zero command."""
    f[F.DELTA_LON] += p[e]
    f[F.DELTA_LAT] += p[e + 1]


# --- rotors ---------------------------------------------------------------------------------------


@effect(
    ROTOR,
    EffectParameter("gain", "1", usual=0.4, smallest=0.05, lower=0.0),
    EffectParameter(
        "decay", "1", usual=0.6, smallest=0.0, off=2.0, lower=0.5, upper=6.0, shape=True
    ),
    channels="az h vd",
    source="exponential fit to Cheeseman and Bennett, ARC R&M 3021, 1955; z is the height of the CG",
)
def ground_effect(x, f, p, e):
    """Thrust times 1 + gain exp(-decay z/R) near the ground."""
    height = max(f[F.HEIGHT], 0.0)
    rise = 1.0 + p[e] * math.exp(-p[e + 1] * height / p[P.ROTOR_RADIUS])
    f[F.THRUST_U] *= rise
    f[F.THRUST_L] *= rise


@effect(
    ROTOR,
    EffectParameter(
        "coefficient", "s/m", usual=0.1, smallest=0.015, lower=0.0, scale="1 / tip_speed"
    ),
    channels="az h vd",
    source="blade-element theory, climb inflow; Leishman 2006, ch. 3",
    damps=True,
)
def axial_damping(x, f, p, e):
    """Thrust times (1 + k w_air): a climb loses thrust, a descent gains it."""
    rise = max(1.0 + p[e] * f[F.AIR_W], 0.0)
    f[F.THRUST_U] *= rise
    f[F.THRUST_L] *= rise


@effect(
    ROTOR,
    EffectParameter("gain", "1", usual=0.27, smallest=0.06, lower=0.0, upper=1.5),
    channels="az r",
    source="lower rotor in the upper one's wake; Leishman and Ananthan, AHS J. 2008",
)
def wake_interference(x, f, p, e):
    """Lower thrust times 1 - gain (share of the load on the upper rotor)."""
    total = f[F.THRUST_U] + f[F.THRUST_L]
    f[F.THRUST_L] *= select(total > 0.0, 1.0 - p[e] * f[F.THRUST_U] / total, 1.0)


@effect(
    ROTOR,
    EffectParameter("excess", "1", usual=0.2, smallest=0.05, lower=-1.5, upper=2.0),
    channels="az",
    source="measured propeller curves depart from the square of speed; about hover",
)
def thrust_exponent(x, f, p, e):
    """Thrust goes as speed to the power 2 + excess, unchanged at the bare model's hover speed."""
    if p[e] != 0.0:
        hover_u, hover_l = generic_terms.hover_speeds(p)
        turning = (f[F.OMEGA_U] > 0.0) & (f[F.OMEGA_L] > 0.0)
        f[F.THRUST_U] *= select(turning, (f[F.OMEGA_U] / hover_u) ** p[e], 1.0)
        f[F.THRUST_L] *= select(turning, (f[F.OMEGA_L] / hover_l) ** p[e], 1.0)


@effect(
    ROTOR,
    EffectParameter("time", "s", usual=0.03, smallest=0.008, lower=0.0, upper=0.3, probe=0.02),
    channels="az",
    source="Leishman 2006, sec. 3.3 and 10.7; Pitt and Peters, Vertica 5, 1981",
)
def dynamic_inflow(x, f, p, e):
    """Thrust times 1 + INFLOW_GAIN (s - v): it overshoots until the inflow v has followed the rotors.

    s: mean rotor speed over that of hover, v: induced velocity over that of hover (state `inflow`),
    which follows s with the time constant; both less one. Small changes (|s - v| below 0.2), slow
    climbs, and one inflow for both rotors.
    """
    if any_lane(p[e] > 0.0):
        speed = 0.5 * (f[F.OMEGA_U] / f[F.HOVER_U] + f[F.OMEGA_L] / f[F.HOVER_L])
        ahead = speed - 1.0 - x[S.INFLOW]
        rise = select(p[e] > 0.0, max(1.0 + INFLOW_GAIN * ahead, 0.0), 1.0)
        f[F.THRUST_U] *= rise
        f[F.THRUST_L] *= rise


@effect(
    ROTOR,
    EffectParameter(
        "gain", "rad per m/s", usual=0.0075, smallest=0.001, lower=0.0, scale="1 / tip_speed"
    ),
    channels="p q ax ay",
    source="as flap_blowback, of a disc that follows at once: its bar, not its hinge, is slow",
    damps=True,
)
def upper_blowback(x, f, p, e):
    """The upper disc tilts back from the airflow: alpha_u + k u, beta_u - k v."""
    f[F.ALPHA_U] += p[e] * f[F.AIR_U]
    f[F.BETA_U] -= p[e] * f[F.AIR_V]


# --- forces, moments, flap rates ------------------------------------------------------------------


@effect(
    LOAD,
    EffectParameter("area_x", "m2", usual=0.02, smallest=0.003, lower=0.0, scale="length * length"),
    EffectParameter("area_y", "m2", usual=0.02, smallest=0.003, lower=0.0, scale="length * length"),
    EffectParameter("area_z", "m2", usual=0.02, smallest=0.003, lower=0.0, scale="length * length"),
    channels="ax ay az vn ve vd",
    source="Hoerner 1965: quadratic drag, per axis",
)
def airframe_drag(x, f, p, e):
    """Drag of the airframe, -1/2 rho area_i |V_a| V_a,i."""
    u, v, w = f[F.AIR_U], f[F.AIR_V], f[F.AIR_W]
    pressure = 0.5 * p[P.AIR_DENSITY] * math.sqrt(u * u + v * v + w * w)
    f[F.FORCE_X] -= pressure * p[e] * u
    f[F.FORCE_Y] -= pressure * p[e + 1] * v
    f[F.FORCE_Z] -= pressure * p[e + 2] * w


@effect(
    LOAD,
    EffectParameter(
        "coefficient",
        "N s/m per rad/s",
        usual=4e-4,
        smallest=5e-5,
        lower=0.0,
        scale="weight / tip_speed / rotor_speed",
    ),
    channels="ax ay vn ve",
    source="rotor H-force and induced drag; Martin and Salaun, ICRA 2010",
    damps=True,
)
def rotor_drag(x, f, p, e):
    """Drag in the rotor plane, -k (omega_u + omega_l) V_perp."""
    k = p[e] * (f[F.OMEGA_U] + f[F.OMEGA_L])
    f[F.FORCE_X] -= k * f[F.AIR_U]
    f[F.FORCE_Y] -= k * f[F.AIR_V]


@effect(
    LOAD,
    EffectParameter(
        "gain", "rad per m/s", usual=0.0075, smallest=0.001, lower=0.0, scale="1 / tip_speed"
    ),
    channels="p q",
    source="longitudinal flapping with speed; Prouty 1986, ch. 3",
    damps=True,
)
def flap_blowback(x, f, p, e):
    """The lower disc tilts back from the airflow: alpha_l' + k u/tau, beta_l' - k v/tau."""
    f[F.ALPHA_L_DOT] += p[e] * f[F.AIR_U] / f[F.FLAP_TIME]
    f[F.BETA_L_DOT] -= p[e] * f[F.AIR_V] / f[F.FLAP_TIME]


@effect(
    LOAD,
    EffectParameter(
        "coefficient",
        "N m s",
        usual=0.004,
        smallest=0.0005,
        lower=0.0,
        scale="torque / rotor_speed",
    ),
    channels="r psi",
    source="aerodynamic yaw damping, to first order",
    damps=True,
)
def yaw_damping(x, f, p, e):
    """Yaw moment -k r."""
    f[F.MOMENT_Z] -= p[e] * x[S.R]


@effect(
    LOAD,
    EffectParameter(
        "coefficient",
        "N m s",
        usual=0.004,
        smallest=0.0008,
        lower=0.0,
        scale="weight * arm / rotor_speed",
    ),
    channels="p q",
    source="aerodynamic rate damping, to first order",
    damps=True,
)
def rate_damping(x, f, p, e):
    """Roll and pitch moments -k p and -k q."""
    f[F.MOMENT_X] -= p[e] * x[S.P]
    f[F.MOMENT_Y] -= p[e] * x[S.Q]


@effect(
    LOAD,
    EffectParameter("x", "m", usual=1.5e-3, smallest=2e-4, scale="length"),
    EffectParameter("y", "m", usual=1.5e-3, smallest=2e-4, scale="length"),
    channels="p q r",
    source="statics: r x F of both rotors with r = (-x, -y, 0)",
)
def cg_offset(x, f, p, e):
    """Centre of gravity beside the mast: M - T x, L + T y, N + X y - Y x (x forward, y right)."""
    f[F.MOMENT_X] -= p[e + 1] * f[F.ROTOR_Z]
    f[F.MOMENT_Y] += p[e] * f[F.ROTOR_Z]
    f[F.MOMENT_Z] += p[e + 1] * f[F.ROTOR_X] - p[e] * f[F.ROTOR_Y]


@effect(
    LOAD,
    EffectParameter("upper", "N m/rad", usual=0.2, smallest=0.03, lower=0.0, scale="weight * arm"),
    EffectParameter("lower", "N m/rad", usual=0.2, smallest=0.03, lower=0.0, scale="weight * arm"),
    channels="p q",
    source="spring at the flap hinge, Johnson 1980, ch. 5",
)
def hub_stiffness(x, f, p, e):
    """Each hub passes a moment k (tilt of its disc) beside its thrust's."""
    f[F.MOMENT_X] += p[e] * f[F.BETA_U] + p[e + 1] * f[F.BETA_L]
    f[F.MOMENT_Y] += p[e] * f[F.ALPHA_U] + p[e + 1] * f[F.ALPHA_L]


@effect(
    LOAD,
    EffectParameter("gain", "1", usual=1.0, smallest=0.25, lower=0.0),
    channels="r psi",
    source="angular momentum along z; the paper's (37) leaves it out",
)
def spin_up_reaction(x, f, p, e):
    """Reaction to rotor acceleration, N + g ((J_u + J_f) omega_u' - J_l omega_l')."""
    f[F.MOMENT_Z] += p[e] * (
        (p[P.ROTOR_INERTIA_U] + p[P.FLYBAR_INERTIA]) * f[F.OMEGA_U_DOT]
        - p[P.ROTOR_INERTIA_L] * f[F.OMEGA_L_DOT]
    )


@effect(
    LOAD,
    EffectParameter("gain", "1", usual=1.0, smallest=0.25, lower=0.0),
    channels="p q",
    source="Euler's equations; the paper's (35)-(37) leave it out, so the bare model must: a real"
    " machine has it with gain 1",
)
def gyroscopic_coupling(x, f, p, e):
    """The body's own gyroscopic moment, -g omega x I omega, beside its rotors'."""
    wx, wy, wz = x[S.P], x[S.Q], x[S.R]
    hx, hy, hz = f[F.INERTIA_XX] * wx, f[F.INERTIA_YY] * wy, f[F.INERTIA_ZZ] * wz
    f[F.MOMENT_X] -= p[e] * (wy * hz - wz * hy)
    f[F.MOMENT_Y] -= p[e] * (wz * hx - wx * hz)
    f[F.MOMENT_Z] -= p[e] * (wx * hy - wy * hx)


@effect(
    LOAD,
    EffectParameter(
        "stiffness", "N/m", usual=0.1, smallest=0.02, lower=0.0, scale="weight / length"
    ),
    EffectParameter("north", "m", usual=1.0, smallest=0.0, shape=True),
    EffectParameter("east", "m", usual=1.0, smallest=0.0, shape=True),
    channels="pn pe vn ve",
    source="a tether or cable, to first order: a horizontal spring to its anchor",
)
def position_spring(x, f, p, e):
    """A tether pulls horizontally towards its anchor, -k (position - anchor)."""
    north, east = p[e] * (p[e + 1] - x[S.X]), p[e] * (p[e + 2] - x[S.Y])
    pull_x, pull_y, pull_z = _in_body_axes(f, north, east, 0.0)
    f[F.FORCE_X] += pull_x
    f[F.FORCE_Y] += pull_y
    f[F.FORCE_Z] += pull_z


# --- sensors --------------------------------------------------------------------------------------
# Places of the readings in the workspace.
_GYRO, _ACCEL, _ATTITUDE = F.READING + Z.P, F.READING + Z.AX, F.READING + Z.PHI
_HEIGHT, _SINK = F.READING + Z.H, F.READING + Z.VD
_NORTH, _EAST = F.READING + Z.PN, F.READING + Z.PE
_SPEED_NORTH, _SPEED_EAST = F.READING + Z.VN, F.READING + Z.VE

# Readings of a pose come about in this order: late, of a point beside the centre of gravity, in the
# axes of the markers; biases are added last.


@compiled()
def _attitude_late(x, f, delay):
    """Attitude readings by a delay [s] earlier: their rates (38)-(40) and second derivatives."""
    turn = x[S.Q] * f[F.SIN_PHI] + x[S.R] * f[F.COS_PHI]
    slope = f[F.SIN_THETA] / f[F.COS_THETA]
    theta_dot = x[S.Q] * f[F.COS_PHI] - x[S.R] * f[F.SIN_PHI]
    phi_dot, psi_dot = x[S.P] + turn * slope, turn / f[F.COS_THETA]
    turn_dot = f[F.Q_DOT] * f[F.SIN_PHI] + f[F.R_DOT] * f[F.COS_PHI] + phi_dot * theta_dot
    phi_dot_dot = f[F.P_DOT] + turn_dot * slope + psi_dot * theta_dot / f[F.COS_THETA]
    theta_dot_dot = f[F.Q_DOT] * f[F.COS_PHI] - f[F.R_DOT] * f[F.SIN_PHI] - phi_dot * turn
    psi_dot_dot = turn_dot / f[F.COS_THETA] + psi_dot * theta_dot * slope
    half = 0.5 * delay * delay
    f[_ATTITUDE] += half * phi_dot_dot - delay * phi_dot
    f[_ATTITUDE + 1] += half * theta_dot_dot - delay * theta_dot
    f[_ATTITUDE + 2] += half * psi_dot_dot - delay * psi_dot


@compiled()
def _in_world_axes(attitude, x, y, z):
    """A vector of the body's axes in those of the world, by Euler angles (3,)."""
    sin_phi, cos_phi = math.sin(attitude[0]), math.cos(attitude[0])
    sin_theta, cos_theta = math.sin(attitude[1]), math.cos(attitude[1])
    sin_psi, cos_psi = math.sin(attitude[2]), math.cos(attitude[2])
    forward = x * cos_theta + (y * sin_phi + z * cos_phi) * sin_theta
    right = y * cos_phi - z * sin_phi
    down = -x * sin_theta + (y * sin_phi + z * cos_phi) * cos_theta
    return forward * cos_psi - right * sin_psi, forward * sin_psi + right * cos_psi, down


@compiled()
def _acceleration(x, f, p):
    """Of the centre of gravity, north, east and down [m/s2]."""
    mass = f[F.MASS]
    north, east, down = _in_world_axes(
        x[S.PHI : S.PSI + 1], f[F.FORCE_X] / mass, f[F.FORCE_Y] / mass, f[F.FORCE_Z] / mass
    )
    return north, east, down + p[P.GRAVITY]


@effect(
    SENSOR,
    EffectParameter("time", "s", usual=0.03, smallest=0.008, lower=0.0, upper=0.3, timing=True),
    channels="pn pe h phi theta psi",
    source="motion capture and its network, to second order: z - d z' + d2/2 z''",
)
def pose_delay(x, f, p, e):
    """Position, height and attitude readings are late; the velocity readings are not."""
    delay = p[e]
    if delay != 0.0:
        half = 0.5 * delay * delay
        north, east, down = _acceleration(x, f, p)
        f[_NORTH] += half * north - delay * f[_SPEED_NORTH]
        f[_EAST] += half * east - delay * f[_SPEED_EAST]
        f[_HEIGHT] += delay * f[_SINK] - half * down
        _attitude_late(x, f, delay)


@effect(
    SENSOR,
    EffectParameter("time", "s", usual=0.03, smallest=0.008, lower=0.0, upper=0.3, timing=True),
    channels="phi theta psi",
    source="attitude electronics' own filter, to second order: z - d z' + d2/2 z''",
)
def attitude_delay(x, f, p, e):
    """The attitude readings are late."""
    if p[e] != 0.0:
        _attitude_late(x, f, p[e])


@effect(
    SENSOR,
    EffectParameter("x", "m", usual=0.12, smallest=0.005, scale="length"),
    EffectParameter("y", "m", usual=0.12, smallest=0.005, scale="length"),
    EffectParameter("z", "m", usual=0.12, smallest=0.005, scale="length"),
    channels="pn pe h",
    source="rigid-body kinematics: p + R r, V + R (omega x r); whoever tracks the position"
    " differentiates it",
)
def marker_offset(x, f, p, e):
    """Position, height and velocity are those of a point beside the centre of gravity.

    A motion capture's point is anywhere on the frame its markers stand on: half a rotor's radius is
    usual.
    """
    rx, ry, rz = p[e], p[e + 1], p[e + 2]
    if rx != 0.0 or ry != 0.0 or rz != 0.0:
        attitude = f[_ATTITUDE : _ATTITUDE + 3]
        north, east, down = _in_world_axes(attitude, rx, ry, rz)
        f[_NORTH] += north
        f[_EAST] += east
        f[_HEIGHT] -= down
        wx, wy, wz = x[S.P], x[S.Q], x[S.R]
        north, east, down = _in_world_axes(
            attitude, wy * rz - wz * ry, wz * rx - wx * rz, wx * ry - wy * rx
        )
        f[_SPEED_NORTH] += north
        f[_SPEED_EAST] += east
        f[_SINK] += down


@effect(
    SENSOR,
    EffectParameter("angle", "rad", usual=0.2, smallest=0.03),
    channels="phi theta psi",
    source="a motion capture's body is drawn through its markers: R_body R_z(angle), exactly",
)
def frame_yaw(x, f, p, e):
    """The markers' body axes are turned about the mast: the attitude is theirs."""
    if p[e] != 0.0:
        sine, cosine = math.sin(p[e]), math.cos(p[e])
        sin_phi, cos_phi = math.sin(f[_ATTITUDE]), math.cos(f[_ATTITUDE])
        sin_theta, cos_theta = math.sin(f[_ATTITUDE + 1]), math.cos(f[_ATTITUDE + 1])
        across = cos_theta * sin_phi
        ahead = cosine * cos_theta + sine * sin_phi * sin_theta
        f[_ATTITUDE] = math.atan2(cosine * across + sine * sin_theta, cos_theta * cos_phi)
        f[_ATTITUDE + 1] = math.asin(cosine * sin_theta - sine * across)
        f[_ATTITUDE + 2] += math.atan2(sine * cos_phi, ahead)


@effect(
    SENSOR,
    EffectParameter("x", "1", usual=0.07, smallest=0.01),
    EffectParameter("y", "1", usual=0.07, smallest=0.01),
    channels="psi",
    source="hard iron: a field fixed to the body, in parts of the earth's horizontal one;"
    " Titterton and Weston 2004",
)
def magnetic_field(x, f, p, e):
    """The compass' error goes with the heading: about -x sin psi - y cos psi (x ahead, y right)."""
    sine, cosine = f[F.SIN_PSI], f[F.COS_PSI]
    f[_ATTITUDE + 2] += math.atan2(
        -p[e] * sine - p[e + 1] * cosine, 1.0 + p[e] * cosine - p[e + 1] * sine
    )


@effect(
    SENSOR,
    EffectParameter("x", "1", usual=0.05, smallest=0.01, lower=-0.5),
    EffectParameter("y", "1", usual=0.05, smallest=0.01, lower=-0.5),
    EffectParameter("z", "1", usual=0.05, smallest=0.01, lower=-0.5),
    channels="p q r",
    source="measured = true (1 + s)",
)
def gyro_scale(x, f, p, e):
    """Scale error of the gyros."""
    for i in range(3):
        f[_GYRO + i] *= 1.0 + p[e + i]


@effect(
    SENSOR,
    EffectParameter("x", "m", usual=0.03, smallest=0.008, scale="length"),
    EffectParameter("y", "m", usual=0.03, smallest=0.008, scale="length"),
    EffectParameter("z", "m", usual=0.03, smallest=0.008, scale="length"),
    channels="ax ay az",
    source="rigid-body kinematics, all in body axes; Titterton and Weston 2004",
)
def imu_lever_arm(x, f, p, e):
    """Accelerometers off the centre of gravity: f + omega' x r + omega x (omega x r)."""
    rx, ry, rz = p[e], p[e + 1], p[e + 2]
    wx, wy, wz = x[S.P], x[S.Q], x[S.R]
    along = wx * rx + wy * ry + wz * rz
    square = wx * wx + wy * wy + wz * wz
    f[_ACCEL] += f[F.Q_DOT] * rz - f[F.R_DOT] * ry + wx * along - square * rx
    f[_ACCEL + 1] += f[F.R_DOT] * rx - f[F.P_DOT] * rz + wy * along - square * ry
    f[_ACCEL + 2] += f[F.P_DOT] * ry - f[F.Q_DOT] * rx + wz * along - square * rz


@effect(
    SENSOR,
    EffectParameter("x", "rad", usual=0.02, smallest=0.003),
    EffectParameter("y", "rad", usual=0.02, smallest=0.003),
    channels="ax ay",
    source="rotation of the sensor's axes against the body's; Rodrigues' formula",
)
def imu_tilt(x, f, p, e):
    """IMU turned by the rotation vector t = (x, y, 0): f - t x f (1 - t^2/6) + t x (t x f) / 2."""
    tx, ty = p[e], p[e + 1]
    once = 1.0 - (tx * tx + ty * ty) / 6.0
    for first in (_GYRO, _ACCEL):
        a, b, c = f[first], f[first + 1], f[first + 2]
        turn = tx * b - ty * a  # z of t x f; x and y are ty c, -tx c
        f[first] = a - once * ty * c + 0.5 * ty * turn
        f[first + 1] = b + once * tx * c - 0.5 * tx * turn
        f[first + 2] = c - once * turn - 0.5 * (tx * tx + ty * ty) * c


@effect(
    SENSOR,
    EffectParameter("x", "1", usual=0.02, smallest=0.005),
    EffectParameter("y", "1", usual=0.02, smallest=0.005),
    EffectParameter("z", "1", usual=0.02, smallest=0.005),
    channels="ax ay az",
    source="measured = true (1 + s)",
)
def accel_scale(x, f, p, e):
    """Scale error of the accelerometers."""
    for i in range(3):
        f[_ACCEL + i] *= 1.0 + p[e + i]


@effect(
    SENSOR,
    EffectParameter("x", "m/s2", usual=0.15, smallest=0.02),
    EffectParameter("y", "m/s2", usual=0.15, smallest=0.02),
    EffectParameter("z", "m/s2", usual=0.15, smallest=0.02),
    channels="ax ay az",
    source="measured = true + b",
)
def accel_bias(x, f, p, e):
    """Bias of the accelerometers."""
    for i in range(3):
        f[_ACCEL + i] += p[e + i]


@effect(
    SENSOR,
    EffectParameter("x", "rad/s", usual=0.03, smallest=0.002),
    EffectParameter("y", "rad/s", usual=0.03, smallest=0.002),
    EffectParameter("z", "rad/s", usual=0.03, smallest=0.002),
    channels="p q r",
    source="measured = true + b",
)
def gyro_bias(x, f, p, e):
    """Bias of the gyros."""
    for i in range(3):
        f[_GYRO + i] += p[e + i]


@effect(
    SENSOR,
    EffectParameter("x", "rad", usual=0.025, smallest=0.003),
    EffectParameter("y", "rad", usual=0.025, smallest=0.003),
    EffectParameter("z", "rad", usual=0.025, smallest=0.003),
    channels="phi theta psi",
    source="compass or mounting: measured = true + b",
)
def attitude_bias(x, f, p, e):
    """Bias of the attitude readings."""
    for i in range(3):
        f[_ATTITUDE + i] += p[e + i]


@effect(
    SENSOR,
    EffectParameter("on", "1", usual=1.0, smallest=0.3),
    channels="h",
    source="slant range of a sonar fixed to the body, h/(cos phi cos theta)",
)
def sonar_tilt(x, f, p, e):
    """The height reading is the slant range (on = 1), not the height (on = 0)."""
    slant = f[F.COS_PHI] * f[F.COS_THETA]
    f[_HEIGHT] *= select(slant > 0.1, 1.0 + p[e] * (1.0 / slant - 1.0), 1.0)


@effect(
    SENSOR,
    EffectParameter("scale", "1", usual=0.035, smallest=0.007),
    channels="h",
    source="speed of sound off its calibration: measured = true (1 + s)",
)
def sonar_scale(x, f, p, e):
    """Scale error of the height reading."""
    f[_HEIGHT] *= 1.0 + p[e]


@effect(
    SENSOR,
    EffectParameter("time", "s", usual=0.1, smallest=0.02, lower=0.0, upper=0.5, timing=True),
    channels="h",
    source="delayed echo, to second order: h - d h' + d2/2 h''",
)
def sonar_delay(x, f, p, e):
    """The height reading is delayed."""
    delay = p[e]
    if delay != 0.0:
        _, _, down = _acceleration(x, f, p)
        f[_HEIGHT] += delay * f[_SINK] - 0.5 * delay * delay * down


@effect(
    SENSOR,
    EffectParameter("amplitude", "m/s2", usual=0.5, smallest=0.1, lower=0.0),
    EffectParameter("rate", "rad/s", usual=0.3, smallest=0.05, lower=0.0),
    EffectParameter("tilt", "rad", usual=2e-3, smallest=2e-4, lower=0.0),
    EffectParameter("heave", "m", usual=5e-4, smallest=5e-5, lower=0.0),
    channels="ax ay az p q phi theta h",
    source="a rotor out of balance; a line at its speed and the aliases that sampling makes of it",
    line=True,
)
def vibration(x, f, p, e):
    """The body shakes at rotor speed: accelerometers, gyros, roll and pitch, height (vibration.py)."""


# --- what no list explains --------------------------------------------------------------------------

for _group, (_unit, _) in generic_terms.AXES.items():
    effect(
        UNLISTED,
        *(
            EffectParameter(
                term.key,
                generic_terms.unit_of(_group, term),
                usual=generic_terms.USUAL[_unit] / term.usual,
                smallest=0.1 * generic_terms.USUAL[_unit] / term.usual,
                scale=generic_terms.SCALES[_group] + term.per,
            )
            for term in generic_terms.TERMS
        ),
        channels="",
        source="low-order terms, Morelli and Klein 2016, ch. 5",
        generic=True,
        name=_group,
    )(generic_terms.AXIS_FUNCTIONS[_group])
