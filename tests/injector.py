"""Hides effects in a flight: an independent simulator, sharing no physics with the package.

The helicopter of the paper written another way - quaternion attitude, velocity in the inertial
frame, hub forces as vectors, Heun's method at 2 ms - flown in closed loop by a pilot with tremor,
with effects in other functional forms than the catalogue's wherever two forms are sensible. It
writes a flight folder as any logger would, and ``truth.json`` beside it for the test to read.

What flies and in what is an input: the vehicle (injector_craft.py), the air (injector_air.py), the
sensors (injector_sensors.py), the pilot (``PILOTS``).

To hide something new: a field of ``Hidden``, its off-value the default; an entry of ``EFFECTS`` (and of
``OTHER_FORM`` where its number is another one than the catalogue's); and a line where it acts:

- commands, before motors and servos: ``_acting`` (late ones: ``_late_row``, and ``_is_late``);
- motors and servos: ``_actuate``, ``_follow_at_once``; a state more: ``N_STATE``;
- forces, moments, flaps, mass: ``_derivative``;
- readings of another time: ``_fly_run``, which has all rows, those before the log too (``_late``);
- what a sensor makes of a reading, and another channel: ``_read``.

Its usual sizes belong in ``scripts/study/plan.py``.

    python tests/injector.py DIR --effect ground_effect --effect swash_offset.lon=-0.015 --gusts
"""

import argparse
import copy
import json
import math
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from injector_air import GUSTS, GUSTY, STILL, Air, disturbances
from injector_craft import (
    CRAFTS,
    LAMA,
    SHIPPED,
    Craft,
    draw,
    rotors_of,
    tilt_authority,
    write_vehicle,
    yaw_authority,
)
from injector_sensors import (
    MIXED,
    MIXED_POSES,
    SENSORS,
    Sensors,
    blunt,
    card_text,
    clock,
    csv_text,
    err,
    kit,
    smoothed,
    thin,
)
from numba import njit
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

RPM = 30.0 / math.pi
STEP, SUBSTEPS = 0.01, 5
SETTLE = 6.0  # s flown before the log starts
BLADES = 1.2  # rise of thrust with rotor speed at held inflow, over the square law's
GIVE = 0.005  # s in which a linkage's stop, or a servo near its command, gives way
FULL = 12.3  # V of the battery as a log starts, in hover


class Hidden(NamedTuple):
    """Everything that may be hidden, and its off-value."""

    ge_gain: float = 0.0
    rotor_drag: float = 0.0
    area_x: float = 0.0
    area_y: float = 0.0
    area_z: float = 0.0
    axial: float = 0.0
    blowback: float = 0.0
    wake: float = 0.0
    yaw_damping: float = 0.0
    rate_damping: float = 0.0
    thrust_excess: float = 0.0
    wind_north: float = 0.0
    wind_east: float = 0.0
    swash_lon: float = 0.0
    swash_lat: float = 0.0
    cg_x: float = 0.0
    cg_y: float = 0.0
    swash_phase: float = 0.0
    swash_gain: float = 0.0
    servo_lag: float = 0.0
    servo_delay: float = 0.0
    servo_play: float = 0.0
    servo_deadband: float = 0.0
    servo_rate: float = 0.0
    command_delay: float = 0.0
    phase_slope: float = 0.0
    droop_upper: float = 0.0
    droop_lower: float = 0.0
    per_volt: float = 0.0
    inflow_time: float = 0.0
    motor_upper: float = 0.0
    motor_lower: float = 0.0
    sag: float = 0.0
    added_mass: float = 0.0
    thrust_scale: float = 0.0
    torque_scale: float = 0.0
    yaw_inertia: float = 0.0
    stiffness_upper: float = 0.0
    stiffness_lower: float = 0.0
    spin_up: float = 0.0
    bar_time: float = 0.0
    gyro_x: float = 0.0
    gyro_y: float = 0.0
    gyro_z: float = 0.0
    accel_x: float = 0.0
    accel_y: float = 0.0
    accel_z: float = 0.0
    scale_x: float = 0.0
    scale_y: float = 0.0
    scale_z: float = 0.0
    lever_x: float = 0.0
    lever_y: float = 0.0
    lever_z: float = 0.0
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    attitude_x: float = 0.0
    attitude_y: float = 0.0
    attitude_z: float = 0.0
    sonar_scale: float = 0.0
    sonar_tilt: float = 0.0
    sonar_delay: float = 0.0
    vibration: float = 0.0
    upper_blowback: float = 0.0
    coupling: float = 0.0
    tether: float = 0.0
    tether_north: float = 0.0
    tether_east: float = 0.0
    pose_delay: float = 0.0
    attitude_delay: float = 0.0
    marker_x: float = 0.0
    marker_y: float = 0.0
    marker_z: float = 0.0
    frame_yaw: float = 0.0
    iron_x: float = 0.0
    iron_y: float = 0.0
    gyro_scale_x: float = 0.0
    gyro_scale_y: float = 0.0
    gyro_scale_z: float = 0.0
    heading_moment: float = 0.0
    patch_lift: float = 0.0
    sector_moment: float = 0.0
    resonance_moment: float = 0.0
    cable_moment: float = 0.0
    stall_moment: float = 0.0
    wake_moment: float = 0.0


_FIELDS = ", ".join(f"a.{name} + share * (b.{name} - a.{name})" for name in Hidden._fields)
_between = njit(eval(f"lambda a, b, share: Hidden({_FIELDS})", {"Hidden": Hidden}))
"""Every field between those of two Hidden, by its share of the second."""

# effect -> parameter -> (field of Hidden, size where none is given)
EFFECTS: dict[str, dict[str, tuple[str, float]]] = {
    "ground_effect": {"gain": ("ge_gain", 1.0)},
    "rotor_drag": {"coefficient": ("rotor_drag", 4e-4)},
    "airframe_drag": {
        "area_x": ("area_x", 0.03), "area_y": ("area_y", 0.03), "area_z": ("area_z", 0.03)
    },
    "axial_damping": {"coefficient": ("axial", 0.08)},
    "flap_blowback": {"gain": ("blowback", 0.0075)},
    "wake_interference": {"gain": ("wake", 0.25)},
    "yaw_damping": {"coefficient": ("yaw_damping", 0.004)},
    "rate_damping": {"coefficient": ("rate_damping", 0.005)},
    "thrust_exponent": {"excess": ("thrust_excess", 0.25)},
    "wind": {"north": ("wind_north", 1.2), "east": ("wind_east", -1.0)},
    "swash_offset": {"lon": ("swash_lon", 0.015), "lat": ("swash_lat", -0.010)},
    "cg_offset": {"x": ("cg_x", 1.5e-3), "y": ("cg_y", -1.0e-3)},
    "swash_phase": {"angle": ("swash_phase", 0.15), "per_rpm": ("phase_slope", 0.0)},
    "swash_gain": {"scale": ("swash_gain", -0.15)},
    "servo_lag": {"time": ("servo_lag", 0.04)},
    "servo_delay": {"time": ("servo_delay", 0.03)},
    "servo_play": {"width": ("servo_play", 0.02)},
    "servo_deadband": {"width": ("servo_deadband", 0.012)},
    "servo_rate": {"limit": ("servo_rate", 0.8)},
    "command_delay": {"time": ("command_delay", 0.04)},
    "motor_droop": {"upper": ("droop_upper", 0.25), "lower": ("droop_lower", 0.2)},
    "battery_voltage": {"per_volt": ("per_volt", 0.06)},
    "dynamic_inflow": {"time": ("inflow_time", 0.05)},
    "motor_lag": {"upper": ("motor_upper", 0.08), "lower": ("motor_lower", 0.08)},
    "battery_sag": {"rate": ("sag", 0.002)},
    "added_mass": {"mass": ("added_mass", 0.06)},
    "thrust_scale": {"scale": ("thrust_scale", -0.07)},
    "torque_balance": {"scale": ("torque_scale", 0.07)},
    "yaw_inertia": {"scale": ("yaw_inertia", 0.3)},
    "hub_stiffness": {"upper": ("stiffness_upper", 0.2), "lower": ("stiffness_lower", 0.2)},
    "spin_up_reaction": {"gain": ("spin_up", 1.0)},
    "flybar_time_constant": {"scale": ("bar_time", -0.4)},
    "gyro_bias": {"x": ("gyro_x", 0.02), "y": ("gyro_y", -0.015), "z": ("gyro_z", 0.01)},
    "accel_bias": {"x": ("accel_x", 0.15), "y": ("accel_y", -0.12), "z": ("accel_z", 0.2)},
    "accel_scale": {"x": ("scale_x", 0.0), "y": ("scale_y", 0.0), "z": ("scale_z", 0.03)},
    "imu_lever_arm": {
        "x": ("lever_x", 0.03), "y": ("lever_y", -0.03), "z": ("lever_z", 0.04)
    },
    "imu_tilt": {"x": ("tilt_x", 0.02), "y": ("tilt_y", -0.02)},
    "attitude_bias": {
        "x": ("attitude_x", 0.02), "y": ("attitude_y", -0.02), "z": ("attitude_z", 0.0)
    },
    "sonar_scale": {"scale": ("sonar_scale", 0.04)},
    "sonar_tilt": {"on": ("sonar_tilt", 1.0)},
    "sonar_delay": {"time": ("sonar_delay", 0.12)},
    "vibration": {"amplitude": ("vibration", 0.5)},
    "upper_blowback": {"gain": ("upper_blowback", 0.0075)},
    "gyroscopic_coupling": {"gain": ("coupling", 1.0)},
    "position_spring": {
        "stiffness": ("tether", 0.15), "north": ("tether_north", 0.8), "east": ("tether_east", -0.5)
    },
    "pose_delay": {"time": ("pose_delay", 0.04)},
    "attitude_delay": {"time": ("attitude_delay", 0.03)},
    "marker_offset": {
        "x": ("marker_x", 0.04), "y": ("marker_y", -0.03), "z": ("marker_z", -0.06)
    },
    "frame_yaw": {"angle": ("frame_yaw", 0.15)},
    "magnetic_field": {"x": ("iron_x", 0.08), "y": ("iron_y", -0.06)},
    "gyro_scale": {
        "x": ("gyro_scale_x", 0.06), "y": ("gyro_scale_y", -0.05), "z": ("gyro_scale_z", 0.08)
    },
    # in no catalogue: M = a sin(3 psi), which a generic term is
    "outside": {"heading_moment": ("heading_moment", 0.02)},
    # and what no generic term is: pitch moment in one sector of the heading
    "outside_sector": {"moment": ("sector_moment", 0.03)},
    # lift over a place: half a meter wide, 0.4 m north of where flights begin
    "outside_patch": {"lift": ("patch_lift", 0.5)},
    # roll moment near one speed of the upper rotor, which meets a natural frequency there
    "outside_resonance": {"moment": ("resonance_moment", 0.02)},
    # yaw moment of a cable that twists and slips (Dahl): it depends on the way there
    "outside_cable": {"moment": ("cable_moment", 0.006)},
    # pitch moment that is all there from a slow walk on, and forwards only
    "outside_stall": {"moment": ("stall_moment", 0.02)},
    # roll moment of the side speed of a while ago
    "outside_wake": {"moment": ("wake_moment", 0.015)},
}  # fmt: skip

OTHER_FORM = frozenset({"ground_effect.gain", "airframe_drag.area_x", "airframe_drag.area_y",
                        "airframe_drag.area_z", "wake_interference.gain",
                        "rate_damping.coefficient", "yaw_damping.coefficient",
                        "vibration.amplitude", "battery_sag.rate",
                        "battery_voltage.per_volt", "dynamic_inflow.time", "command_delay.time",
                        "servo_rate.limit",
                        "motor_droop.upper", "motor_droop.lower",
                        "servo_play.width", "servo_deadband.width",
                        "position_spring.stiffness", "position_spring.north",
                        "position_spring.east", "upper_blowback.gain",
                        "outside.heading_moment", "outside_patch.lift", "outside_sector.moment",
                        "outside_resonance.moment", "outside_cable.moment",
                        "outside_stall.moment", "outside_wake.moment"})  # fmt: skip
"""Parameters whose number means something else here than in the catalogue."""


# --- pilots -------------------------------------------------------------------------------------


class Pilot(NamedTuple):
    """Gains from what is seen to commands: swash in rad, lift and yaw as shares of the hover speeds.

    home: m/s per m. speed: rad per m/s. tilt, rate: rad per rad, per rad/s. height, climb, turn,
    yaw_rate: share per m, m/s, rad, rad/s. side_trim, lift_trim, yaw_trim: the same per s, integrals.
    lost: share of rows whose command is lost on the way, in bursts of 1 to 4; the one before stays.
    grain: steps in which commands arrive, shares of the hover speeds and rad of the paper's swash.
    most_tilt [rad], most_yaw: limits. senses: 1/s, of their lag. delay: s before what is seen is
    acted on. hold: rows between decisions. tremor_rotor [rad/s], tremor_swash [rad]: std, memory [s].
    """

    home: float = 0.1
    speed: float = 0.25
    tilt: float = 0.4
    rate: float = 0.05
    height: float = 0.10
    climb: float = 0.11
    turn: float = 0.015
    yaw_rate: float = 0.017
    side_trim: float = 0.012
    lift_trim: float = 0.03
    yaw_trim: float = 0.006
    most_tilt: float = 0.08
    most_yaw: float = 0.06
    senses: float = 22.0
    delay: float = 0.0
    hold: int = 1
    tremor_rotor: tuple[float, float] = (0.4, 0.12)
    tremor_swash: tuple[float, float] = (0.003, 0.25)
    lost: float = 0.0
    grain: tuple[float, float] = (0.0, 0.0)


USUAL = Pilot()
PILOTS = {
    "usual": USUAL,
    "stabiliser": Pilot(
        home=0.3, speed=0.2, tilt=0.5, rate=0.10, height=0.16, climb=0.15, turn=0.03, yaw_rate=0.03,
        senses=60.0, delay=0.03, hold=2, tremor_rotor=(0.3, 0.05), tremor_swash=(0.002, 0.05),
    ),
    "slow_human": Pilot(
        home=0.06, speed=0.14, tilt=0.22, rate=0.04, height=0.06, climb=0.10, turn=0.009,
        yaw_rate=0.012, side_trim=0.006, senses=12.0, delay=0.1, tremor_rotor=(0.6, 0.4),
        tremor_swash=(0.004, 0.5),
    ),
    "by_radio": USUAL._replace(lost=0.03),
    "by_steps": USUAL._replace(grain=(0.004, 0.004)),
}  # fmt: skip
"""Beside the usual one: a full-state stabiliser at half the rate, 30 ms late; a slow hand; the usual
one by a radio that loses commands, and by servos and motors of 7 bits."""


class Reach(NamedTuple):
    """What a craft's commands do, against the paper's: factors on the commands that do the same."""

    tilt: float
    yaw: float
    speed: float


def _reach(craft: Craft) -> Reach:
    return Reach(
        tilt_authority(LAMA) / tilt_authority(craft),
        yaw_authority(LAMA) / yaw_authority(craft),
        rotors_of(craft).hover_upper / rotors_of(LAMA).hover_upper,
    )


def _suited(pilot: Pilot, craft: Craft) -> Pilot:
    """The pilot with gains for what a craft's commands do.

    Torques out of balance need the same share of speed on every craft: the trim goes with the root.
    """
    tilt, yaw, _ = _reach(craft)
    return pilot._replace(
        tilt=tilt * pilot.tilt, rate=tilt * pilot.rate, side_trim=tilt * pilot.side_trim,
        most_tilt=tilt * pilot.most_tilt, turn=yaw * pilot.turn, yaw_rate=yaw * pilot.yaw_rate,
        yaw_trim=math.sqrt(yaw) * pilot.yaw_trim, most_yaw=max(yaw, 1.0) * pilot.most_yaw,
    )  # fmt: skip


# --- physics --------------------------------------------------------------------------------------
# State: 0-2 position, 3-5 velocity (both inertial), 6-9 quaternion body to inertial, 10-12 p q r,
# 13-16 alpha_l beta_l alpha_f beta_f, 17-18 rotor speeds, 19-20 swash, 21-22 swash rates, 23 a cable's
# twist in units of its greatest, 24 side speed as the wake remembers it, 25-26 the plate behind a
# linkage's play, 27 induced velocity over that in hover.
N_STATE = 28
CABLE = 0.3  # rad of turn after which a cable slips
WAKE = 0.8  # s that a wake lasts
# Out: 0-2 specific force, 3-5 angular acceleration (body axes).


@njit(cache=True)
def _rotation(s):
    a, b, c, d = s[6], s[7], s[8], s[9]
    R = np.empty((3, 3))
    R[0, 0] = a * a + b * b - c * c - d * d
    R[0, 1] = 2.0 * (b * c - a * d)
    R[0, 2] = 2.0 * (b * d + a * c)
    R[1, 0] = 2.0 * (b * c + a * d)
    R[1, 1] = a * a - b * b + c * c - d * d
    R[1, 2] = 2.0 * (c * d - a * b)
    R[2, 0] = 2.0 * (b * d - a * c)
    R[2, 1] = 2.0 * (c * d + a * b)
    R[2, 2] = a * a - b * b - c * c + d * d
    return R


@njit(cache=True)
def _cross(a, b):
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


@njit(cache=True)
def _thrust_vector(thrust, alpha, beta):
    """Thrust along [-tan a, tan b, -1], eqs (13)-(14)."""
    n = np.array([-math.tan(alpha), math.tan(beta), -1.0])
    return thrust / math.sqrt(n[0] * n[0] + n[1] * n[1] + 1.0) * n


@njit(cache=True)
def _derivative(s, command, push, hidden, craft, rotors, out):
    """ds/dt; ``out`` gets specific force and angular acceleration. ``push``: injector_air.py."""
    R = _rotation(s)
    omega = s[10:13]
    wu, wl = s[17] + push[8], s[18] + push[9]
    air = R.T @ (s[3:6] - np.array([hidden.wind_north, hidden.wind_east, 0.0]))
    ds = np.zeros(N_STATE)

    # rotors
    stronger = 1.0 + hidden.thrust_scale
    thrust_u = rotors.thrust_upper * wu * wu * stronger
    thrust_l = rotors.thrust_lower * wl * wl * stronger
    thrust_u *= (wu / rotors.hover_upper) ** hidden.thrust_excess
    thrust_l *= (wl / rotors.hover_lower) ** hidden.thrust_excess
    thrust_l -= hidden.wake * 0.5 * math.sqrt(thrust_u * thrust_l)
    if (
        hidden.inflow_time > 0.0
    ):  # blades at an inflow of its own momentum, which air's mass holds up
        faster = 0.5 * (wu / rotors.hover_upper + wl / rotors.hover_lower)
        stronger = 1.0 + BLADES * (1.0 - s[27] / faster)
        thrust_u *= stronger
        thrust_l *= stronger
        ds[27] = (faster**2 * stronger - s[27] ** 2) / ((2.0 + BLADES) * hidden.inflow_time)
    height = max(-s[2], 0.4 * craft.radius)
    rise = 1.0 / (1.0 - hidden.ge_gain * (craft.radius / (4.0 * height)) ** 2)  # Cheeseman-Bennett
    rise *= 1.0 + hidden.axial * air[2] / math.sqrt(1.0 + (air[2] / 4.2) ** 2)
    rise *= 1.0 + push[6]
    thrust_u *= rise
    thrust_l *= rise
    torque_u = rotors.torque_upper * wu * wu * (1.0 + push[7])
    torque_l = rotors.torque_lower * wl * wl * (1.0 + hidden.torque_scale)

    # discs
    alpha_l, beta_l = s[13], s[14]
    alpha_u, beta_u = craft.bar_lon * s[15], craft.bar_lat * s[16]
    slide = hidden.upper_blowback / math.sqrt(1.0 + (air[0] ** 2 + air[1] ** 2) / 64.0)
    alpha_u += slide * air[0]
    beta_u -= slide * air[1]
    F_u = _thrust_vector(thrust_u, alpha_u, beta_u)
    F_l = _thrust_vector(thrust_l, alpha_l, beta_l)
    moment = _cross(np.array([0.0, 0.0, -craft.hub_upper]), F_u)
    moment = moment + _cross(np.array([0.0, 0.0, -craft.hub_lower]), F_l)
    force = F_u + F_l
    centre = np.array([hidden.cg_x, hidden.cg_y, 0.0])
    moment -= _cross(centre, force)
    moment[0] += hidden.stiffness_upper * math.sin(beta_u) + hidden.stiffness_lower * math.sin(
        beta_l
    )
    moment[1] += hidden.stiffness_upper * math.sin(alpha_u)
    moment[1] += hidden.stiffness_lower * math.sin(alpha_l)

    # fuselage and air
    force[2] += rotors.downwash * thrust_u
    speed = math.sqrt(air[0] ** 2 + air[1] ** 2 + air[2] ** 2 + 0.3**2)
    half = 0.5 * craft.density
    force[0] -= half * hidden.area_x * speed * air[0]
    force[1] -= half * hidden.area_y * speed * air[1]
    force[2] -= half * hidden.area_z * speed * air[2]
    disc_drag = 2.0 * hidden.rotor_drag * math.sqrt(wu * wl)
    force[0] -= disc_drag * air[0]
    force[1] -= disc_drag * air[1]
    moment[0] -= hidden.rate_damping * omega[0] * (0.8 + 0.4 * abs(omega[0]))
    moment[1] -= hidden.rate_damping * omega[1] * (0.8 + 0.4 * abs(omega[1]))
    moment[2] -= hidden.yaw_damping * omega[2] * (0.85 + 0.15 * abs(omega[2]))
    moment[2] += torque_u - torque_l
    cable = np.array([hidden.tether_north - s[0], hidden.tether_east - s[1], 0.0])
    stretch = math.sqrt(1.0 + (cable[0] ** 2 + cable[1] ** 2) / 900.0)
    force += hidden.tether / stretch * (R.T @ cable)
    force += push[:3]
    force += R.T @ push[10:13]
    moment += push[3:6]
    heading = math.atan2(R[1, 0], R[0, 0])
    _unlisted(s, air, heading, wu / rotors.hover_upper, hidden, force, moment)
    ds[23] = (omega[2] - abs(omega[2]) * s[23]) / CABLE
    ds[24] = (air[1] - s[24]) / WAKE

    # actuators
    _actuate(s, command, hidden, ds)
    upper = craft.rotor_upper + craft.bar
    moment[2] += hidden.spin_up * (upper * ds[17] - craft.rotor_lower * ds[18])

    # rigid body; the paper's rotational equations have no omega x I omega
    turned = np.array([craft.inertia_x, craft.inertia_y, craft.inertia_z])
    turned[2] *= 1.0 + hidden.yaw_inertia
    moment -= hidden.coupling * _cross(omega, turned * omega)
    H = craft.rotor_lower * wl - upper * wu
    moment -= _cross(omega, np.array([0.0, 0.0, H]))
    out[0:3] = force / (craft.mass + hidden.added_mass)
    out[3] = moment[0] / craft.inertia_x
    out[4] = moment[1] / craft.inertia_y
    out[5] = moment[2] / (craft.inertia_z * (1.0 + hidden.yaw_inertia))
    ds[0:3] = s[3:6]
    ds[3:6] = R @ out[0:3]
    ds[5] += craft.gravity
    p, q, r = omega[0], omega[1], omega[2]
    ds[6] = 0.5 * (-s[7] * p - s[8] * q - s[9] * r)
    ds[7] = 0.5 * (s[6] * p + s[8] * r - s[9] * q)
    ds[8] = 0.5 * (s[6] * q - s[7] * r + s[9] * p)
    ds[9] = 0.5 * (s[6] * r + s[7] * q - s[8] * p)
    ds[10:13] = out[3:6]

    # flaps
    phase = hidden.swash_phase + hidden.phase_slope * RPM * (wl - rotors.hover_lower)
    cos, sin = math.cos(phase), math.sin(phase)
    plate = s[25:27] if hidden.servo_play > 0.0 else s[19:21]
    lon = cos * plate[0] - sin * plate[1] + hidden.swash_lon
    lat = sin * plate[0] + cos * plate[1] + hidden.swash_lat
    gain = craft.swash_gain * (1.0 + hidden.swash_gain)
    back = hidden.blowback / math.sqrt(1.0 + (air[0] ** 2 + air[1] ** 2) / 64.0)
    ds[13] = (gain * lon - alpha_l + back * air[0]) / craft.flap_time - q
    ds[14] = (gain * lat - beta_l - back * air[1]) / craft.flap_time - p
    bar = craft.bar_time * (1.0 + hidden.bar_time)
    ds[15] = -s[15] / bar - q
    ds[16] = -s[16] / bar - p
    return ds


@njit(cache=True)
def _unlisted(s, air, heading, speed, hidden, force, moment):
    """Adds what is in no catalogue. ``speed``: of the upper rotor, against hover's."""
    away = ((s[0] - 0.4) ** 2 + s[1] ** 2) / 0.5**2
    force[2] -= hidden.patch_lift * math.exp(-0.5 * away)
    moment[0] += hidden.resonance_moment / (1.0 + ((speed - 1.01) / 0.006) ** 2)
    moment[0] += hidden.wake_moment * s[24]
    moment[1] += hidden.heading_moment * math.sin(3.0 * heading)
    moment[1] += hidden.sector_moment * math.exp(6.0 * (math.cos(heading - 2.0) - 1.0))
    moment[1] += hidden.stall_moment * (0.5 + 0.5 * math.tanh((air[0] - 0.3) / 0.1))
    moment[2] -= hidden.cable_moment * s[23]


@njit(cache=True)
def _actuate(s, command, hidden, ds):
    """Motors pull towards the commanded speed by torque; servos are critically damped.

    A plate with play is pushed by stops that give way; a servo runs at full speed or in proportion.
    """
    if hidden.motor_upper > 0.0:
        ds[17] = (command[0] ** 2 - s[17] ** 2) / (2.0 * s[17] * hidden.motor_upper)
    if hidden.motor_lower > 0.0:
        ds[18] = (command[1] ** 2 - s[18] ** 2) / (2.0 * s[18] * hidden.motor_lower)
    for i in range(2):
        wanted = command[2 + i]
        if abs(wanted - s[19 + i]) < hidden.servo_deadband:
            wanted = s[19 + i]
        if hidden.servo_lag > 0.0:
            n = 2.0 / hidden.servo_lag
            ds[19 + i] = s[21 + i]
            ds[21 + i] = n * n * (wanted - s[19 + i]) - 2.0 * n * s[21 + i]
        elif hidden.servo_rate > 0.0:
            ds[19 + i] = (wanted - s[19 + i]) / GIVE
        if hidden.servo_rate > 0.0:
            ds[19 + i] = min(max(ds[19 + i], -hidden.servo_rate), hidden.servo_rate)
        error = s[19 + i] - s[25 + i]
        ds[25 + i] = math.copysign(max(abs(error) - 0.5 * hidden.servo_play, 0.0), error) / GIVE


@njit(cache=True)
def _follow_at_once(s, command, hidden, craft):
    """Actuators without a lag jump with the command; angular momentum is kept where asked."""
    if hidden.motor_upper == 0.0:
        jump = command[0] - s[17]
        upper = craft.rotor_upper + craft.bar
        s[12] += hidden.spin_up * upper * jump / (craft.inertia_z * (1.0 + hidden.yaw_inertia))
        s[17] = command[0]
    if hidden.motor_lower == 0.0:
        jump = command[1] - s[18]
        lower = craft.rotor_lower
        s[12] -= hidden.spin_up * lower * jump / (craft.inertia_z * (1.0 + hidden.yaw_inertia))
        s[18] = command[1]
    if hidden.servo_lag == 0.0 and hidden.servo_rate == 0.0:
        for i in range(2):
            if abs(command[2 + i] - s[19 + i]) >= hidden.servo_deadband:
                s[19 + i] = command[2 + i]


@njit(cache=True)
def _euler(R):
    return np.array(
        [math.atan2(R[2, 1], R[2, 2]), -math.asin(R[2, 0]), math.atan2(R[1, 0], R[0, 0])]
    )


@njit(cache=True)
def _pilot(seen, target, memory, trust, swash_gain, dt, pilot, rotors):
    """Commands from what the pilot sees.

    ``seen``: position, velocity (inertial), attitude, rates. ``target``: north, east, height,
    heading and the rate of each. ``memory``: integrals of the errors, forward, right, up, heading.
    ``trust``: 1 flies on position, 0 keeps attitude only. ``dt``: s since the last look.
    """
    cos, sin = math.cos(seen[8]), math.sin(seen[8])
    north, east = target[0] - seen[0], target[1] - seen[1]
    forward = cos * north + sin * east
    right = -sin * north + cos * east
    u = cos * seen[3] + sin * seen[4]
    v = -sin * seen[3] + cos * seen[4]
    want_u = pilot.home * forward + cos * target[4] + sin * target[5]
    want_v = pilot.home * right - sin * target[4] + cos * target[5]
    turn = _wrap(target[3] - seen[8])
    up = target[2] + seen[2]
    climb = target[6] + seen[5]
    error = np.array([want_u - u, want_v - v, up, turn])
    limit = np.array([pilot.most_tilt, pilot.most_tilt, 0.15, 0.15])
    rate = np.array([pilot.side_trim, pilot.side_trim, pilot.lift_trim, pilot.yaw_trim])
    for i in range(4):
        if i >= 2 or trust > 0.5:
            memory[i] += dt * rate[i] * error[i]
        memory[i] = min(max(memory[i], -limit[i]), limit[i])
    theta_want = min(max(-pilot.speed * trust * error[0], -0.3), 0.3)
    phi_want = min(max(pilot.speed * trust * error[1], -0.3), 0.3)
    lon = pilot.tilt * (theta_want - seen[7]) - pilot.rate * seen[10]
    lat = pilot.tilt * (phi_want - seen[6]) - pilot.rate * seen[9]
    lift = pilot.height * up + pilot.climb * climb + memory[2]
    lift = min(max(lift, -0.12), 0.12)
    yaw = pilot.turn * turn + pilot.yaw_rate * (target[7] - seen[11]) + memory[3]
    yaw = min(max(yaw, -pilot.most_yaw), pilot.most_yaw)
    return np.array(
        [
            rotors.hover_upper * (1.0 + lift + yaw),
            rotors.hover_lower * (1.0 + lift - yaw),
            swash_gain * lon - memory[0],
            swash_gain * lat + memory[1],
        ]
    )


@njit(cache=True)
def _wrap(angle):
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True)
def _fly(
    clock,
    dt,
    step,
    targets,
    trusts,
    extra,
    tremor,
    arrives,
    pushes,
    pilot,
    early,
    craft,
    rotors,
    at_last,
    shares,
):
    """Fly the rows of a clock; returns the commands and true readings of all of them.

    Hidden is ``early``, and by ``shares`` (rows,), 0 to 1, what is there ``at_last``.

    Readings: 0-1 rotor speeds, 2-4 rates, 5-7 accelerometers, 8-10 attitude, 11-13 position,
    14-16 velocity, 17 cosine of the tilt. ``clock``: (rows,) s, the log begins at 0. ``dt``: (rows,)
    s to the next row; ``step``: s, what it usually is. ``targets`` (rows, 8), ``trusts`` (rows,):
    the pilot's. ``extra``, ``tremor``: (rows, 4) added to the commands. ``arrives``: (rows,) whether
    a command does. ``pushes``:
    (rows * SUBSTEPS + 1, DISTURBANCES).
    """
    rows = len(clock)
    commands = np.empty((rows, 4))
    arrived = np.empty((rows, 4))
    readings = np.empty((rows, 18))
    s = np.zeros(N_STATE)
    s[0], s[1], s[2] = targets[0, 0], targets[0, 1], -targets[0, 2]
    s[6], s[9] = math.cos(targets[0, 3] / 2.0), math.sin(targets[0, 3] / 2.0)
    s[17], s[18] = rotors.hover_upper, rotors.hover_lower
    s[27] = 1.0
    out = np.zeros(6)
    out2 = np.zeros(6)
    memory = np.zeros(4)
    seen = np.zeros(12)
    saw = np.empty((rows, 12))
    behind = int(round(pilot.delay / step))
    wanted = np.zeros(4)
    for k in range(rows):
        hidden = early if shares[k] == 0.0 else at_last
        if 0.0 < shares[k] < 1.0:
            hidden = _between(early, at_last, shares[k])
        inertia = craft.inertia_z * (1.0 + hidden.yaw_inertia)
        R = _rotation(s)
        attitude = _euler(R)
        _see(s, attitude, saw[k])
        if k == 0:
            seen[:3] = s[:3]
            seen[8] = attitude[2]
        _notice(saw[max(k - behind, 0)], pilot.senses * dt[k], seen)
        trust = trusts[k]
        if k % pilot.hold == 0:
            wanted = _pilot(
                seen,
                targets[k],
                memory,
                trust,
                0.4 + 0.6 * trust,
                pilot.hold * dt[k],
                pilot,
                rotors,
            )
        command = wanted + tremor[k]
        if clock[k] >= 0.0:
            command += extra[k]
        _as_logged(command)
        commands[k] = command
        if arrives[k] or k == 0:
            arrived[k, :2] = _in_steps(command[:2], pilot.grain[0] * rotors.hover_upper)
            arrived[k, 2:] = _in_steps(command[2:], pilot.grain[1])
        else:
            arrived[k] = arrived[k - 1]
        rates = s[10:13].copy()  # a gyro does not see the jump of this very instant
        push = pushes[k * SUBSTEPS]
        actual = _acting(arrived, clock, dt, k, 0, hidden, rotors)
        _follow_at_once(s, actual, hidden, craft)
        ds = _derivative(s, actual, push, hidden, craft, rotors, out)
        readings[k, 0:2] = s[17:19] + push[8:10]
        readings[k, 2:5] = rates
        lever = np.array([hidden.lever_x, hidden.lever_y, hidden.lever_z])
        readings[k, 5:8] = out[0:3] + _cross(out[3:6], lever) + _cross(rates, _cross(rates, lever))
        _log_motion(s, attitude, R, readings[k])
        h = dt[k] / SUBSTEPS
        for j in range(SUBSTEPS):
            push, later = pushes[k * SUBSTEPS + j], pushes[k * SUBSTEPS + j + 1]
            if j > 0 and _is_late(hidden):
                actual = _acting(arrived, clock, dt, k, j, hidden, rotors)
                _follow_at_once(s, actual, hidden, craft)
            ds = _derivative(s, actual, push, hidden, craft, rotors, out2)
            middle = s + h * ds
            ds2 = _derivative(middle, actual, push, hidden, craft, rotors, out2)
            s = s + 0.5 * h * (ds + ds2)
            s[6:10] /= math.sqrt(s[6] ** 2 + s[7] ** 2 + s[8] ** 2 + s[9] ** 2)
            taken = (craft.rotor_upper + craft.bar) * (later[8] - push[8])
            taken -= craft.rotor_lower * (later[9] - push[9])
            s[12] += taken / inertia
    return commands, readings


@njit(cache=True)
def _see(s, attitude, there):
    """What of a state a pilot may see (12,): place, velocity, attitude, rates."""
    there[0:6] = s[0:6]
    there[6:9] = attitude
    there[9:12] = s[10:13]


@njit(cache=True)
def _log_motion(s, attitude, R, reading):
    """A row's true readings of attitude, place, velocity and tilt, into their places (18,)."""
    reading[8:11] = attitude
    reading[11:14] = s[0:3]
    reading[14:17] = s[3:6]
    reading[17] = R[2, 2]


@njit(cache=True)
def _notice(there, keen, seen):
    """What is there goes into what the pilot has seen, whose senses lag; in place."""
    for i in range(12):
        error = there[i] - seen[i]
        seen[i] += keen * (_wrap(error) if 6 <= i < 9 else error)


@njit(cache=True)
def _as_logged(command):
    """What is logged is what is flown, to the last digit; in place."""
    for i in range(2):
        command[i] = round(command[i] * RPM * 10.0) / 10.0 / RPM
        command[2 + i] = round(min(max(command[2 + i], -0.25), 0.25) * 1e5) / 1e5


@njit(cache=True)
def _in_steps(values, step):
    """Values to the nearest of equal steps; all of them where these are 0."""
    return np.round(values / step) * step if step > 0.0 else values.copy()


@njit(cache=True)
def _is_late(hidden):
    """Whether a command may begin to act between two rows."""
    return hidden.servo_delay > 0.0 or hidden.command_delay > 0.0


@njit(cache=True)
def _acting(commands, clock, dt, k, j, hidden, rotors):
    """The command that acts in substep j of row k: delays and supply, before motors and servos."""
    common = 0.0
    if hidden.command_delay > 0.0:  # packets come sooner or later by 3 ms
        common = hidden.command_delay + 0.003 * math.sin(2.4 * k)
    actual = commands[_late_row(clock, dt, k, j, common)].copy()
    late = commands[_late_row(clock, dt, k, j, common + hidden.servo_delay)]
    actual[2], actual[3] = late[2], late[3]
    actual[0] = _drooped(actual[0], hidden.droop_upper, rotors.hover_upper)
    actual[1] = _drooped(actual[1], hidden.droop_lower, rotors.hover_lower)
    if hidden.per_volt > 0.0:
        weaker = volts(commands[k, 0] * commands[k, 1], clock[k], rotors) / FULL
        actual[0] *= weaker ** (FULL * hidden.per_volt)
        actual[1] *= weaker ** (FULL * hidden.per_volt)
    sag = math.exp(-hidden.sag * max(clock[k], 0.0))
    actual[0] *= sag
    actual[1] *= sag
    return actual


@njit(cache=True)
def _drooped(command, droop, hover):
    """Speed at which a proportional speed control balances a torque that grows as its square."""
    if droop == 0.0:
        return command
    stiff = 2.0 / hover * (1.0 - droop) / droop  # torque of hover, per rad/s of error
    load = 4.0 * (1.0 + stiff * command) / hover**2
    return 0.5 * hover**2 * (math.sqrt(stiff**2 + load) - stiff)


@njit(cache=True)
def volts(product, time, rotors):
    """Battery voltage [V] at a product of commanded rotor speeds, by charge drawn and by load."""
    load = product / (rotors.hover_upper * rotors.hover_lower) - 1.0
    return FULL - 0.015 * max(time, 0.0) - 0.8 * load


@njit(cache=True)
def _late_row(clock, dt, k, j, delay):
    """The row whose command, ``delay`` s late, acts in substep j of row k."""
    behind = delay - j / SUBSTEPS * dt[k]
    row = k
    while row > 0 and clock[k] - clock[row] < behind - 1e-9 * dt[k]:
        row -= 1
    return row


# --- maneuvers ------------------------------------------------------------------------------------

MANEUVERS: dict[str, float] = {
    "lon_doublet": 12.0, "lat_doublet": 12.0, "lon_3211": 12.0, "lat_3211": 12.0,
    "heave_3211": 14.0, "yaw_3211": 14.0, "forward_run": 20.0, "side_run": 20.0,
    "low_hover": 24.0, "climb_descend": 20.0, "heading_turn": 20.0, "hover": 30.0,
}  # fmt: skip
"""Name and length [s] of every run."""


def _steps(t: np.ndarray, at: float, unit: float, pattern: Iterable[tuple[float, float]]):
    """A signal of (duration in units, level) pieces from ``at`` on."""
    signal = np.zeros_like(t)
    for duration, level in pattern:
        signal[(t >= at - 1e-9) & (t < at + duration * unit - 1e-9)] = level
        at += duration * unit
    return signal


T3211 = ((3, 1.0), (2, -1.0), (1, 1.0), (1, -1.0))


def _plan(name: str, t: np.ndarray, craft: Craft) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Target (n, 8) north, east, height, heading, their rates; trust (n,); extra command (n, 4)."""
    upper, lower = rotors_of(craft)[-2:]
    reach = _reach(craft)
    n = len(t)
    target = np.tile([0.0, 0.0, 1.6, 0.0], (n, 1))
    trust = np.ones(n)
    extra = np.zeros((n, 4))
    kind, _, form = name.partition("_")
    if form == "doublet":
        trust[(t >= 2.0) & (t < 6.0)] = 0.0
        extra[:, 2 if kind == "lon" else 3] = _steps(t, 2.0, 2.0, ((1, -0.045), (1, 0.05)))
    elif kind in ("lon", "lat"):
        trust[(t >= 2.0) & (t < 5.0)] = 0.2
        extra[:, 2 if kind == "lon" else 3] = 0.07 * _steps(t, 2.0, 0.4, T3211)
    elif kind == "heave":
        extra[:, :2] = 0.035 * _steps(t, 2.0, 0.6, T3211)[:, None] * [upper, lower]
    elif kind == "yaw":
        extra[:, :2] = 0.022 * _steps(t, 2.0, 0.5, T3211)[:, None] * [upper, -lower]
        extra[:, :2] *= reach.yaw
    elif form == "run":
        speed = np.interp(t, [2, 4, 6, 9, 10, 13, 15, 17], [0, 2.6, 2.6, 0, 0, -2.6, -2.6, 0])
        target[:, 0 if kind == "forward" else 1] = np.cumsum(speed) * STEP
    elif kind == "low":
        target[:, 2] = np.interp(
            t, [3.0, 7.0, 12.0, 13.0, 17.0, 18.0, 22.0], [1.6, 0.3, 0.3, 0.5, 0.5, 0.3, 1.2]
        )
    elif kind == "climb":
        target[:, 2] = np.interp(t, [2.0, 5.0, 8.0, 12.0, 14.0, 18.0], [1.4, 4.2, 4.2, 0.8, 0.8, 3])
    elif kind == "heading":
        target[:, 3] = np.interp(t, [2.0, 14.0], [0.0, 2.0 * math.pi])
        target[:, 0] = np.interp(t, [4.0, 9.0], [0.0, 1.0])
    extra[:, 2:] *= reach.tilt
    window = np.ones(81) / 81.0
    smooth = [np.convolve(np.pad(x, 40, mode="edge"), window, "valid") for x in target.T]
    rates = [np.gradient(x, STEP) for x in smooth]
    return np.column_stack(smooth + rates), trust, extra


# --- a flight ------------------------------------------------------------------------------------


def fly(
    folder: str | Path,
    effects: Mapping[str, Mapping[str, float] | float],
    *,
    gusts: bool | Air = False,
    sensors: str = "full",
    seed: int = 0,
    runs: Iterable[str] | None = None,
    lost_echoes: bool = False,
    radio_gaps: bool = False,
    craft: Craft = LAMA,
    pilot: str = "usual",
    known_as: Craft | None = None,
    card_noise: float | None = 1.0,
    longest: float = math.inf,
    later: Mapping[str, Mapping[str, float] | float] | None = None,
    since: tuple[str, float] = ("", 0.0),
    growing: float = 0.0,
) -> Path:
    """Write a flight with these effects hidden, and what they were in ``truth.json``.

    Args:
        effects: name -> parameters; ``{}`` takes the usual size, a number sets the first one.
        gusts: True: force (0.2 N) and moment (6 mN m) with a memory of 0.5 s; or any air.
        sensors: a key of ``SENSORS``; ``MIXED`` and ``MIXED_POSES`` are drawn from the seed.
        runs: names in ``MANEUVERS``; all where None.
        craft: what flies. known_as: what its vehicle file says; the same where None. One that is
            not shipped gets a file beside the card.
        pilot: a key of ``PILOTS``.
        card_noise: factor by which the card's noise is wrong; None: the card has none.
        longest: s at which a run ends.
        later, since: effects that are there from a moment (run, s) on, to the end of the last run, with
            sizes of 0 what ends then; of readings and of what acts at once, not of a pose that is late.
        growing: s of flight over which they come or go evenly; 0: at once.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    air = gusts if isinstance(gusts, Air) else GUSTY if gusts else STILL
    values = chosen_values(effects)
    hidden = Hidden(**{EFFECTS[e][p][0]: value for (e, p), value in values.items()})
    values |= chosen_values(later or {})
    at_last = Hidden(**{EFFECTS[e][p][0]: value for (e, p), value in values.items()})
    aboard = kit(sensors, seed)
    names = list(MANEUVERS) if runs is None else list(runs)
    for i, name in enumerate(names):
        rng = np.random.default_rng([seed, list(MANEUVERS).index(name)])
        length = min(MANEUVERS[name], longest)
        begins = math.inf
        if since[0] and i >= names.index(since[0]):
            flown = names[names.index(since[0]) : i]
            begins = since[1] - sum(min(MANEUVERS[run], longest) for run in flown)
        course = Course(hidden, at_last, begins, growing)
        columns = _fly_run(name, length, course, air, aboard, craft, PILOTS[pilot], rng)
        columns = _read_along(columns, aboard, course, rng)
        columns = thin(
            columns, aboard, rng, lost_echoes=lost_echoes, radio_gaps=radio_gaps, first=i == 0
        )
        (folder / f"{name}.csv").write_text(csv_text(columns, aboard))
    known_as = known_as or craft
    vehicle = SHIPPED.get(known_as)
    if vehicle is None:
        write_vehicle(known_as, folder / "vehicle.toml")
        vehicle = str(folder.resolve() / "vehicle.toml")
    said = {} if card_noise is None else {c: card_noise * std for c, std in aboard.noise.items()}
    card = card_text(names, vehicle, (known_as.density, known_as.gravity), said)
    (folder / "card.toml").write_text(card)
    full = {f"{effect}.{parameter}": value for (effect, parameter), value in values.items()}
    truth = {
        "hidden": list(dict.fromkeys([*effects, *(later or {})])),
        "since": list(since) if later else None,
        "values": full,
        "comparable": {name: value for name, value in full.items() if name not in OTHER_FORM},
        "gusts": air.gusts != "none",
        "sensors": sensors,
        "seed": seed,
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return folder


def drawn(rng: np.random.Generator) -> Craft:
    """A vehicle between 0.05 and 5 kg that the pilot can fly: one that is lost is drawn anew."""
    while True:
        craft = draw(rng)
        try:
            for name in ("lat_3211", "yaw_3211"):
                noise = np.random.default_rng(0)
                _fly_run(name, 8.0, Course(), GUSTY, SENSORS["full"], craft, USUAL, noise)
        except RuntimeError:
            continue
        return craft


def chosen_values(
    effects: Mapping[str, Mapping[str, float] | float],
) -> dict[tuple[str, str], float]:
    """(effect, parameter) -> value; parameters not given are 0 once one of the effect's is."""
    values = {}
    for effect, given in effects.items():
        table = EFFECTS[effect]
        if isinstance(given, int | float):
            given = {next(iter(table)): float(given)}
        unknown = set(given) - set(table)
        if unknown:
            raise KeyError(f"{effect} has no {unknown}")
        for parameter, (_, usual) in table.items():
            values[effect, parameter] = float(given.get(parameter, 0.0) if given else usual)
    return values


class Course(NamedTuple):
    """What is hidden while a run is flown: `early`, and what is there `at_last` from `begins` [s] on.

    growing: s over which it comes evenly.
    """

    early: Hidden = Hidden()
    at_last: Hidden = Hidden()
    begins: float = math.inf
    growing: float = 0.0

    def shares(self, t: np.ndarray) -> np.ndarray:
        """Of what is there at last, at times of the log [s]; before it, as at its first row."""
        past = np.maximum(t, 0.0) - self.begins
        if self.growing == 0.0:
            return (past >= -1e-9).astype(float)
        return np.clip(past / self.growing, 0.0, 1.0)


def _fly_run(
    name: str,
    length: float,
    course: Course,
    air: Air,
    sensors: Sensors,
    craft: Craft,
    pilot: Pilot,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """True readings of a run, `length` s of it, on the sensors' clock."""
    hidden = course.early
    times = clock(sensors, SETTLE, length, rng)
    dt = np.full(len(times) - 1, sensors.step) if sensors.unrest == 0.0 else np.diff(times)
    rows = len(dt)
    target, trust, extra = _plan(name, STEP * np.arange(round(MANEUVERS[name] / STEP)), craft)
    at = np.clip(np.round(times[:-1] / STEP).astype(int), 0, len(target) - 1)
    tremor = _tremor(pilot, craft, rows, sensors.step, rng)
    pushes = disturbances(air, craft, rows, SUBSTEPS, sensors.step / SUBSTEPS, rng)
    if sensors.unrest > 0.0:
        pushes = _on(pushes, times, sensors.step)
    pushes = np.ascontiguousarray(pushes)
    commands, readings = _fly(
        times[:-1], dt, sensors.step, target[at], trust[at], extra[at], tremor,
        _arrives(rows, pilot.lost, rng), pushes,
        _suited(pilot, craft), hidden, craft, rotors_of(craft), course.at_last,
        course.shares(times[:-1]),
    )  # fmt: skip
    first = int(np.searchsorted(times, -1e-12))
    logged = readings[first:]
    buried = np.median(logged[:, 13]) > 0.0  # most of the time below the ground
    if not np.isfinite(logged).all() or abs(logged[:, 8:10]).max() > 0.8 or buried:
        raise RuntimeError(f"the pilot lost the helicopter in {name}: {hidden}")
    columns = {"t": times[first:-1]}
    columns["rpm_upper_cmd"], columns["rpm_lower_cmd"] = RPM * commands[first:, :2].T
    columns["rpm_upper"], columns["rpm_lower"] = RPM * logged[:, :2].T
    columns["delta_lon"], columns["delta_lat"] = commands[first:, 2:].T
    for i, channel in enumerate(("p", "q", "r", "ax", "ay", "az")):
        columns[channel] = logged[:, 2 + i]
    late = partial(_late, times[:-1], first)
    unwrapped = np.unwrap(readings[:, 8:11], axis=0)
    attitude = late(unwrapped, hidden.attitude_delay + hidden.pose_delay)
    columns["phi"], columns["theta"] = attitude[:, :2].T
    columns["psi"] = (attitude[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
    height = -late(readings[:, 13], hidden.sonar_delay + hidden.pose_delay)
    columns["h"] = height * (1.0 + hidden.sonar_tilt * (1.0 / logged[:, 17] - 1.0))
    columns["vn"], columns["ve"], columns["vd"] = logged[:, 14:17].T
    columns["pn"], columns["pe"] = late(readings[:, 11:13], hidden.pose_delay).T
    if hidden.per_volt > 0.0:
        product = commands[first:, 0] * commands[first:, 1]
        rotors = rotors_of(craft)
        columns["battery_v"] = np.array(
            [volts(p, t, rotors) for p, t in zip(product, times[first:-1], strict=True)]
        )
    return columns


def _tremor(
    pilot: Pilot, craft: Craft, rows: int, step: float, rng: np.random.Generator
) -> np.ndarray:
    """What the pilot's hand adds to the commands (rows, 4)."""
    reach = _reach(craft)
    tremor = np.empty((rows, 4))
    rotor, memory = pilot.tremor_rotor
    rotor *= reach.speed * min(reach.yaw, 1.0)
    swash, swash_memory = pilot.tremor_swash
    swash *= min(reach.tilt, 1.0)
    for i, (std, lasting) in enumerate([(rotor, memory)] * 2 + [(swash, swash_memory)] * 2):
        tremor[:, i] = _wander(rng.standard_normal(rows), std, lasting, step)
    return tremor


def _arrives(rows: int, lost: float, rng: np.random.Generator) -> np.ndarray:
    """Whether each row's command does; where none is lost no number is drawn."""
    arrives = np.ones(rows, dtype=bool)
    if lost > 0.0:
        for start in rng.integers(rows, size=round(lost * rows / 2.5)):
            arrives[start : start + int(rng.integers(1, 5))] = False
    return arrives


def _late(times: np.ndarray, first: int, shown: np.ndarray, delay: float) -> np.ndarray:
    """What a sensor shows at the logged rows, from `first` on, of what was there `delay` s before."""
    if delay == 0.0:
        return shown[first:]
    return CubicSpline(times, shown)(np.maximum(times[first:] - delay, times[0]))


def _on(pushes: np.ndarray, times: np.ndarray, step: float) -> np.ndarray:
    """A history on an even clock, at the substeps of an uneven one."""
    even = times[0] + step / SUBSTEPS * np.arange(len(pushes))
    shares = np.arange(SUBSTEPS) / SUBSTEPS
    at = (times[:-1, None] + np.diff(times)[:, None] * shares).ravel()
    at = np.append(at, times[-1])
    return np.column_stack([np.interp(at, even, column) for column in pushes.T])


def _wander(white: np.ndarray, std: float, memory: float, step: float) -> np.ndarray:
    """Noise with an exponential memory [s]; `step`: s between values."""
    decay = math.exp(-step / memory)
    drive = std * math.sqrt(1.0 - decay * decay)
    out = np.empty_like(white)
    state = 0.0
    for k, shock in enumerate(white):
        state = decay * state + drive * shock
        out[k] = state
    return out


COMMANDED = ("t", "rpm_upper_cmd", "rpm_lower_cmd", "delta_lon", "delta_lat", "battery_v")


def _read(
    columns: dict[str, np.ndarray], sensors: Sensors, hidden: Hidden, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """What the sensors make of the truth; channels that they lack are left out."""
    _misplace(columns, hidden)
    if (
        hidden.iron_x or hidden.iron_y
    ):  # a compass between magnets: level, the field it points along
        ahead, right = (
            np.cos(columns["psi"]) + hidden.iron_x,
            hidden.iron_y - np.sin(columns["psi"]),
        )
        columns["psi"] = np.arctan2(-right, ahead)
    for i, axis in enumerate("xyz"):
        columns["pqr"[i]] = columns["pqr"[i]] * (1.0 + getattr(hidden, f"gyro_scale_{axis}"))
    for first, x, y in (("p", "q", "r"), ("ax", "ay", "az")):  # turned axes: Rodrigues, both triads
        turned = _turn(np.stack([columns[c] for c in (first, x, y)]), hidden.tilt_x, hidden.tilt_y)
        columns[first], columns[x], columns[y] = turned
    wobble = np.cumsum(columns["rpm_upper"]) / 60.0 * sensors.step * 2.0 * np.pi
    for i, axis in enumerate("xyz"):
        shake = hidden.vibration * np.sin(wobble + 2.1 * i)
        accel = columns["a" + axis] + shake
        columns["a" + axis] = accel * (1 + getattr(hidden, f"scale_{axis}")) + getattr(
            hidden, f"accel_{axis}"
        )
        columns["pqr"[i]] = columns["pqr"[i]] + getattr(hidden, f"gyro_{axis}")
        angle = ("phi", "theta", "psi")[i]
        columns[angle] = columns[angle] + getattr(hidden, f"attitude_{axis}")
    columns["h"] = columns["h"] * (1.0 + hidden.sonar_scale)
    for channel, std in sensors.noise.items():
        if channel in sensors.common:
            std *= math.sqrt(0.5)
        if channel in sensors.smooth:
            columns[channel] = smoothed(
                columns[channel], std, sensors, sensors.smooth[channel], rng
            )
        else:
            columns[channel] = columns[channel] + std * rng.standard_normal(len(columns["t"]))
    err(columns, sensors, rng)
    blunt(columns, sensors, rng)
    columns["psi"] = (columns["psi"] + np.pi) % (2.0 * np.pi) - np.pi
    return {c: x for c, x in columns.items() if c in COMMANDED or c in sensors.noise}


def _read_along(
    columns: dict[str, np.ndarray], sensors: Sensors, course: Course, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """`_read` along a course; between its two ends, readings are as far between theirs."""
    shares = course.shares(columns["t"])
    if not shares.any():
        return _read(columns, sensors, course.early, rng)
    same_noise = copy.deepcopy(rng)
    early = _read({c: x.copy() for c, x in columns.items()}, sensors, course.early, same_noise)
    late = _read(columns, sensors, course.at_last, rng)
    whole = (shares == 0.0) | (shares == 1.0)
    return {
        c: np.where(whole, np.where(shares == 0.0, early[c], x), early[c] + shares * (x - early[c]))
        for c, x in late.items()
    }


def _misplace(columns: dict[str, np.ndarray], hidden: Hidden) -> None:
    """Place and velocity of the markers, attitude in their axes, in place."""
    arm = [hidden.marker_x, hidden.marker_y, hidden.marker_z]
    if not any(arm) and not hidden.frame_yaw:
        return
    angles = ("psi", "theta", "phi")
    body = Rotation.from_euler("ZYX", np.stack([columns[c] for c in angles], axis=-1))
    shift = body.apply(arm) * [1.0, 1.0, -1.0]
    for i, (place, speed) in enumerate((("pn", "vn"), ("pe", "ve"), ("h", "vd"))):
        columns[place] = columns[place] + shift[:, i]
        sign = -1.0 if place == "h" else 1.0
        columns[speed] = columns[speed] + sign * np.gradient(shift[:, i], columns["t"])
    seen = body * Rotation.from_euler("z", hidden.frame_yaw)
    for channel, values in zip(angles, seen.as_euler("ZYX").T, strict=True):
        columns[channel] = values


def _turn(vectors: np.ndarray, tilt_x: float, tilt_y: float) -> np.ndarray:
    """(3, n) in axes turned by the rotation vector (tilt_x, tilt_y, 0)."""
    angle = math.hypot(tilt_x, tilt_y)
    if angle == 0.0:
        return vectors
    axis = np.array([tilt_x, tilt_y, 0.0]) / angle
    skew = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    back = np.eye(3) - math.sin(angle) * skew + (1 - math.cos(angle)) * skew @ skew
    return back @ vectors


def compile_ahead() -> None:
    """Compile what flies, into the cache beside this file, before several processes would at once."""
    with TemporaryDirectory() as folder:
        fly(folder, {}, runs=["hover"], longest=1.0)


def _main() -> None:
    parser = argparse.ArgumentParser(description="Write a flight with effects hidden in it.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--effect", action="append", default=[], metavar="NAME[.PARAMETER=VALUE]")
    parser.add_argument("--gusts", action="store_true")
    parser.add_argument("--air", choices=GUSTS, help="other gusts than --gusts flies in")
    parser.add_argument("--memory", type=float, default=0.5, help="s, of the gusts")
    parser.add_argument("--sensors", choices=[*SENSORS, MIXED, MIXED_POSES], default="full")
    parser.add_argument("--craft", choices=CRAFTS, default="lama")
    parser.add_argument("--pilot", choices=PILOTS, default="usual")
    parser.add_argument("--card-noise", type=float, default=1.0, help="factor; 0: not on the card")
    parser.add_argument("--lost-echoes", action="store_true")
    parser.add_argument("--radio-gaps", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    effects: dict[str, dict[str, float]] = {}
    for text in args.effect:
        name, _, value = text.partition("=")
        effect, _, parameter = name.partition(".")
        table = effects.setdefault(effect, {})
        if value:
            table[parameter or next(iter(EFFECTS[effect]))] = float(value)
    air = Air(args.air or ("markov" if args.gusts else "none"), memory=(args.memory, args.memory))
    fly(
        args.folder, effects, gusts=air, sensors=args.sensors, seed=args.seed,
        lost_echoes=args.lost_echoes, radio_gaps=args.radio_gaps, craft=CRAFTS[args.craft],
        pilot=args.pilot, card_noise=args.card_noise or None,
    )  # fmt: skip
    print((args.folder / "truth.json").read_text())


if __name__ == "__main__":
    _main()
