"""Hides effects in a flight: an independent simulator, sharing no physics with the package.

The helicopter of the paper written another way - quaternion attitude, velocity in the inertial
frame, hub forces as vectors, Heun's method at 2 ms - flown in closed loop by a pilot with tremor,
with effects in other functional forms than the catalogue's wherever two forms are sensible. It
writes a flight folder as any logger would, and ``truth.json`` beside it for the test to read.

    python tests/injector.py DIR --effect ground_effect --effect swash_offset.lon=-0.015 --gusts
"""

import argparse
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit

# --- the vehicle: Tables I-VI, C_Dfus 1 -----------------------------------------------------------
MASS, RADIUS, RHO, GRAVITY = 0.8, 0.25, 1.14, 9.804
HUB_U, HUB_L = 0.185, 0.105
I_XX, I_YY, I_ZZ = 5.33e-3, 6.26e-3, 2.50e-3
J_U, J_L, J_F = 7.66e-4, 7.66e-4, 2.55e-4
TAU_FLAP, TAU_BAR = 0.05, 3.0
K_B, K_Q, K_P = 0.91, 0.54, 0.54
K_T, K_QQ = RHO * math.pi * RADIUS**4, RHO * math.pi * RADIUS**5
T_U, T_L = 7.18e-3 * K_T, 4.98e-3 * K_T  # T / w^2
Q_U, Q_L = 5.98e-4 * K_QQ, 5.20e-4 * K_QQ
DOWNWASH = 0.14 * 0.04 / (4.0 * math.pi * RADIUS**2)  # fuselage load per upper thrust
_RATIO = math.sqrt(Q_U / Q_L)
HOVER_U = math.sqrt(MASS * GRAVITY / (T_U * (1.0 - DOWNWASH) + T_L * _RATIO**2))
HOVER_L = HOVER_U * _RATIO
RPM = 30.0 / math.pi

STEP, SUBSTEPS = 0.01, 5
SETTLE = 6.0  # s flown before the log starts


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
    heading_moment: float = 0.0


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
    "swash_phase": {"angle": ("swash_phase", 0.15)},
    "swash_gain": {"scale": ("swash_gain", -0.15)},
    "servo_lag": {"time": ("servo_lag", 0.04)},
    "servo_delay": {"time": ("servo_delay", 0.03)},
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
    "outside": {"heading_moment": ("heading_moment", 0.02)},  # in no catalogue: M = a sin(3 psi)
}  # fmt: skip

OTHER_FORM = frozenset({"ground_effect.gain", "airframe_drag.area_x", "airframe_drag.area_y",
                        "airframe_drag.area_z", "wake_interference.gain",
                        "rate_damping.coefficient", "vibration.amplitude", "battery_sag.rate",
                        "outside.heading_moment"})  # fmt: skip
"""Parameters whose number means something else here than in the catalogue."""


# --- physics --------------------------------------------------------------------------------------
# State: 0-2 position, 3-5 velocity (both inertial), 6-9 quaternion body to inertial, 10-12 p q r,
# 13-16 alpha_l beta_l alpha_f beta_f, 17-18 rotor speeds, 19-20 swash, 21-22 swash rates.
N_STATE = 23
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
def _derivative(s, command, gust, hidden, out):
    """ds/dt; ``out`` gets specific force and angular acceleration."""
    R = _rotation(s)
    omega = s[10:13]
    wu, wl = s[17], s[18]
    air = R.T @ (s[3:6] - np.array([hidden.wind_north, hidden.wind_east, 0.0]))
    ds = np.zeros(N_STATE)

    # rotors
    thrust_u = T_U * wu * wu * (1.0 + hidden.thrust_scale) * (wu / HOVER_U) ** hidden.thrust_excess
    thrust_l = T_L * wl * wl * (1.0 + hidden.thrust_scale) * (wl / HOVER_L) ** hidden.thrust_excess
    thrust_l -= hidden.wake * 0.5 * math.sqrt(thrust_u * thrust_l)
    height = max(-s[2], 0.4 * RADIUS)
    rise = 1.0 / (1.0 - hidden.ge_gain * (RADIUS / (4.0 * height)) ** 2)  # Cheeseman-Bennett
    rise *= 1.0 + hidden.axial * air[2] / math.sqrt(1.0 + (air[2] / 4.2) ** 2)
    thrust_u *= rise
    thrust_l *= rise
    torque_u = Q_U * wu * wu
    torque_l = Q_L * wl * wl * (1.0 + hidden.torque_scale)

    # discs
    alpha_l, beta_l = s[13], s[14]
    alpha_u, beta_u = K_Q * s[15], K_P * s[16]
    F_u = _thrust_vector(thrust_u, alpha_u, beta_u)
    F_l = _thrust_vector(thrust_l, alpha_l, beta_l)
    moment = _cross(np.array([0.0, 0.0, -HUB_U]), F_u) + _cross(np.array([0.0, 0.0, -HUB_L]), F_l)
    force = F_u + F_l
    centre = np.array([hidden.cg_x, hidden.cg_y, 0.0])
    moment -= _cross(centre, force)
    moment[0] += hidden.stiffness_upper * math.sin(beta_u) + hidden.stiffness_lower * math.sin(
        beta_l
    )
    moment[1] += hidden.stiffness_upper * math.sin(alpha_u)
    moment[1] += hidden.stiffness_lower * math.sin(alpha_l)

    # fuselage and air
    force[2] += DOWNWASH * thrust_u
    speed = math.sqrt(air[0] ** 2 + air[1] ** 2 + air[2] ** 2 + 0.3**2)
    force[0] -= 0.5 * RHO * hidden.area_x * speed * air[0]
    force[1] -= 0.5 * RHO * hidden.area_y * speed * air[1]
    force[2] -= 0.5 * RHO * hidden.area_z * speed * air[2]
    disc_drag = 2.0 * hidden.rotor_drag * math.sqrt(wu * wl)
    force[0] -= disc_drag * air[0]
    force[1] -= disc_drag * air[1]
    moment[0] -= hidden.rate_damping * omega[0] * (0.8 + 0.4 * abs(omega[0]))
    moment[1] -= hidden.rate_damping * omega[1] * (0.8 + 0.4 * abs(omega[1]))
    moment[2] -= hidden.yaw_damping * omega[2] * (0.85 + 0.15 * abs(omega[2]))
    moment[2] += torque_u - torque_l
    force += gust[:3]
    moment += gust[3:]
    heading = math.atan2(R[1, 0], R[0, 0])
    moment[1] += hidden.heading_moment * math.sin(3.0 * heading)

    # actuators
    _actuate(s, command, hidden, ds)
    moment[2] += hidden.spin_up * ((J_U + J_F) * ds[17] - J_L * ds[18])

    # rigid body; the paper's rotational equations have no omega x I omega
    H = J_L * wl - (J_U + J_F) * wu
    moment -= _cross(omega, np.array([0.0, 0.0, H]))
    out[0:3] = force / (MASS + hidden.added_mass)
    out[3] = moment[0] / I_XX
    out[4] = moment[1] / I_YY
    out[5] = moment[2] / (I_ZZ * (1.0 + hidden.yaw_inertia))
    ds[0:3] = s[3:6]
    ds[3:6] = R @ out[0:3]
    ds[5] += GRAVITY
    p, q, r = omega[0], omega[1], omega[2]
    ds[6] = 0.5 * (-s[7] * p - s[8] * q - s[9] * r)
    ds[7] = 0.5 * (s[6] * p + s[8] * r - s[9] * q)
    ds[8] = 0.5 * (s[6] * q - s[7] * r + s[9] * p)
    ds[9] = 0.5 * (s[6] * r + s[7] * q - s[8] * p)
    ds[10:13] = out[3:6]

    # flaps
    cos, sin = math.cos(hidden.swash_phase), math.sin(hidden.swash_phase)
    lon = cos * s[19] - sin * s[20] + hidden.swash_lon
    lat = sin * s[19] + cos * s[20] + hidden.swash_lat
    gain = K_B * (1.0 + hidden.swash_gain)
    back = hidden.blowback / math.sqrt(1.0 + (air[0] ** 2 + air[1] ** 2) / 64.0)
    ds[13] = (gain * lon - alpha_l + back * air[0]) / TAU_FLAP - q
    ds[14] = (gain * lat - beta_l - back * air[1]) / TAU_FLAP - p
    bar = TAU_BAR * (1.0 + hidden.bar_time)
    ds[15] = -s[15] / bar - q
    ds[16] = -s[16] / bar - p
    return ds


@njit(cache=True)
def _actuate(s, command, hidden, ds):
    """Motors pull towards the commanded speed by torque; servos are critically damped."""
    if hidden.motor_upper > 0.0:
        ds[17] = (command[0] ** 2 - s[17] ** 2) / (2.0 * s[17] * hidden.motor_upper)
    if hidden.motor_lower > 0.0:
        ds[18] = (command[1] ** 2 - s[18] ** 2) / (2.0 * s[18] * hidden.motor_lower)
    if hidden.servo_lag > 0.0:
        n = 2.0 / hidden.servo_lag
        for i in range(2):
            ds[19 + i] = s[21 + i]
            ds[21 + i] = n * n * (command[2 + i] - s[19 + i]) - 2.0 * n * s[21 + i]


@njit(cache=True)
def _follow_at_once(s, command, hidden):
    """Actuators without a lag jump with the command; angular momentum is kept where asked."""
    if hidden.motor_upper == 0.0:
        jump = command[0] - s[17]
        s[12] += hidden.spin_up * (J_U + J_F) * jump / (I_ZZ * (1.0 + hidden.yaw_inertia))
        s[17] = command[0]
    if hidden.motor_lower == 0.0:
        jump = command[1] - s[18]
        s[12] -= hidden.spin_up * J_L * jump / (I_ZZ * (1.0 + hidden.yaw_inertia))
        s[18] = command[1]
    if hidden.servo_lag == 0.0:
        s[19:21] = command[2:4]


@njit(cache=True)
def _euler(R):
    return np.array(
        [math.atan2(R[2, 1], R[2, 2]), -math.asin(R[2, 0]), math.atan2(R[1, 0], R[0, 0])]
    )


@njit(cache=True)
def _pilot(seen, target, memory, trust, swash_gain):
    """Commands from what the pilot sees.

    ``seen``: position, velocity (inertial), attitude, rates. ``target``: north, east, height,
    heading and the rate of each. ``memory``: integrals of the errors, forward, right, up, heading.
    ``trust``: 1 flies on position, 0 keeps attitude only.
    """
    cos, sin = math.cos(seen[8]), math.sin(seen[8])
    north, east = target[0] - seen[0], target[1] - seen[1]
    forward = cos * north + sin * east
    right = -sin * north + cos * east
    u = cos * seen[3] + sin * seen[4]
    v = -sin * seen[3] + cos * seen[4]
    want_u = 0.1 * forward + cos * target[4] + sin * target[5]
    want_v = 0.1 * right - sin * target[4] + cos * target[5]
    turn = _wrap(target[3] - seen[8])
    up = target[2] + seen[2]
    climb = target[6] + seen[5]
    error = np.array([want_u - u, want_v - v, up, turn])
    limit = np.array([0.08, 0.08, 0.15, 0.15])
    rate = np.array([0.012, 0.012, 0.03, 0.006])
    for i in range(4):
        if i >= 2 or trust > 0.5:
            memory[i] += STEP * rate[i] * error[i]
        memory[i] = min(max(memory[i], -limit[i]), limit[i])
    theta_want = min(max(-0.25 * trust * error[0], -0.3), 0.3)
    phi_want = min(max(0.25 * trust * error[1], -0.3), 0.3)
    lon = swash_gain * (0.4 * (theta_want - seen[7]) - 0.05 * seen[10]) - memory[0]
    lat = swash_gain * (0.4 * (phi_want - seen[6]) - 0.05 * seen[9]) + memory[1]
    lift = 0.10 * up + 0.11 * climb + memory[2]
    lift = min(max(lift, -0.12), 0.12)
    yaw = 0.015 * turn + 0.017 * (target[7] - seen[11]) + memory[3]
    yaw = min(max(yaw, -0.06), 0.06)
    return np.array([HOVER_U * (1.0 + lift + yaw), HOVER_L * (1.0 + lift - yaw), lon, lat])


@njit(cache=True)
def _wrap(angle):
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True)
def _fly(n, settle, target, trust, extra, tremor, shake, gust_std, gust_memory, hidden):
    """Fly ``settle + n`` rows; returns the commands and true readings of the last n.

    Readings: 0-1 rotor speeds, 2-4 rates, 5-7 accelerometers, 8-10 attitude, 11-13 position,
    14-16 velocity, 17 heights per row in slant and delayed as the sonar would (height).
    ``tremor``: (rows, 4) added to the commands; ``shake``: (rows, SUBSTEPS, 6) white, unit.
    """
    commands = np.empty((n, 4))
    readings = np.empty((n, 18))
    s = np.zeros(N_STATE)
    s[0], s[1], s[2] = target[0, 0], target[0, 1], -target[0, 2]
    s[6], s[9] = math.cos(target[0, 3] / 2.0), math.sin(target[0, 3] / 2.0)
    s[17], s[18] = HOVER_U, HOVER_L
    gust = np.zeros(6)
    out = np.zeros(6)
    out2 = np.zeros(6)
    memory = np.zeros(4)
    seen = np.zeros(12)
    flown = np.zeros((settle + n, 4))
    sunk = np.zeros(settle + n)
    h = STEP / SUBSTEPS
    decay = math.exp(-h / gust_memory)
    drive = math.sqrt(1.0 - decay * decay)
    for k in range(settle + n):
        row = max(k - settle, 0)
        R = _rotation(s)
        attitude = _euler(R)
        if k == 0:
            seen[:3] = s[:3]
            seen[8] = attitude[2]
        for i in range(3):  # the pilot's own senses lag by 40 ms
            seen[i] += 0.22 * (s[i] - seen[i])
            seen[3 + i] += 0.22 * (s[3 + i] - seen[3 + i])
            seen[6 + i] += 0.22 * _wrap(attitude[i] - seen[6 + i])
            seen[9 + i] += 0.22 * (s[10 + i] - seen[9 + i])
        command = _pilot(seen, target[row], memory, trust[row], 0.4 + 0.6 * trust[row])
        command += tremor[k]
        if k >= settle:
            command += extra[row]
        # what is logged is what is flown, to the last digit
        command[0] = round(command[0] * RPM * 10.0) / 10.0 / RPM
        command[1] = round(command[1] * RPM * 10.0) / 10.0 / RPM
        command[2] = round(min(max(command[2], -0.25), 0.25) * 1e5) / 1e5
        command[3] = round(min(max(command[3], -0.25), 0.25) * 1e5) / 1e5
        flown[k] = command
        rates = s[10:13].copy()  # a gyro does not see the jump of this very instant
        actual = _delayed(flown, k, 0, hidden)
        sag = math.exp(-hidden.sag * max(k - settle, 0) * STEP)
        actual[0] *= sag
        actual[1] *= sag
        _follow_at_once(s, actual, hidden)
        ds = _derivative(s, actual, gust, hidden, out)
        sunk[k] = -s[2]
        if k >= settle:
            commands[row] = command
            readings[row, 0:2] = s[17:19]
            readings[row, 2:5] = rates
            lever = np.array([hidden.lever_x, hidden.lever_y, hidden.lever_z])
            readings[row, 5:8] = (
                out[0:3] + _cross(out[3:6], lever) + _cross(rates, _cross(rates, lever))
            )
            readings[row, 8:11] = attitude
            readings[row, 11:14] = s[0:3]
            readings[row, 14:17] = s[3:6]
            past = k - int(round(hidden.sonar_delay / STEP))
            slant = 1.0 + hidden.sonar_tilt * (1.0 / R[2, 2] - 1.0)
            readings[row, 17] = sunk[max(past, 0)] * slant
        for j in range(SUBSTEPS):
            if hidden.servo_delay > 0.0:
                delayed = _delayed(flown, k, j, hidden)
                actual[2:4] = delayed[2:4]
                _follow_at_once(s, actual, hidden)
            ds = _derivative(s, actual, gust, hidden, out2)
            middle = s + h * ds
            ds2 = _derivative(middle, actual, gust, hidden, out2)
            s = s + 0.5 * h * (ds + ds2)
            s[6:10] /= math.sqrt(s[6] ** 2 + s[7] ** 2 + s[8] ** 2 + s[9] ** 2)
            for i in range(6):
                gust[i] = decay * gust[i] + drive * gust_std[i] * shake[k, j, i]
    return commands, readings


@njit(cache=True)
def _delayed(flown, k, j, hidden):
    """The command that acts now: swash commands are shifted by the pure delay."""
    actual = flown[k].copy()
    behind = hidden.servo_delay / STEP - j / SUBSTEPS
    back = max(int(math.ceil(behind - 1e-9)), 0)
    actual[2:4] = flown[max(k - back, 0), 2:4]
    return actual


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


def _plan(name: str, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Target (n, 8) north, east, height, heading, their rates; trust (n,); extra command (n, 4)."""
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
        extra[:, :2] = 0.035 * _steps(t, 2.0, 0.6, T3211)[:, None] * [HOVER_U, HOVER_L]
    elif kind == "yaw":
        extra[:, :2] = 0.022 * _steps(t, 2.0, 0.5, T3211)[:, None] * [HOVER_U, -HOVER_L]
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
    window = np.ones(81) / 81.0
    smooth = [np.convolve(np.pad(x, 40, mode="edge"), window, "valid") for x in target.T]
    rates = [np.gradient(x, STEP) for x in smooth]
    return np.column_stack(smooth + rates), trust, extra


# --- sensors and files --------------------------------------------------------------------------

NOISE = {
    "rpm_upper": 2.0, "rpm_lower": 2.0, "p": 0.0349, "q": 0.0349, "r": 0.0349,
    "ax": 0.1, "ay": 0.1, "az": 0.1, "phi": 0.0087, "theta": 0.0087, "psi": 0.0087,
    "h": 0.05, "vn": 0.5, "ve": 0.5, "vd": 0.5,
}  # fmt: skip
SENSORS = {
    "full": (NOISE, {}),
    "onboard": (
        NOISE | {"vn": 0.2, "ve": 0.2, "vd": 0.2},
        {"h": 5, "phi": 2, "theta": 2, "psi": 2, "vn": 10, "ve": 10, "vd": 10},
    ),
}
"""name -> (std per channel, rows between readings where more than one)."""

_FORMATS = {"h": "%.3f", "vn": "%.3f", "ve": "%.3f", "vd": "%.3f"} | dict.fromkeys(
    ("rpm_upper_cmd", "rpm_lower_cmd", "rpm_upper", "rpm_lower"), "%.1f"
)


def fly(
    folder: str | Path,
    effects: Mapping[str, Mapping[str, float] | float],
    *,
    gusts: bool = False,
    sensors: str = "full",
    seed: int = 0,
    runs: Iterable[str] | None = None,
    lost_echoes: bool = False,
    radio_gaps: bool = False,
) -> Path:
    """Write a flight with these effects hidden, and what they were in ``truth.json``.

    Args:
        effects: name -> parameters; ``{}`` takes the usual size, a number sets the first one.
        gusts: force (0.2 N) and moment (6 mN m) with a memory of 0.5 s.
        sensors: a key of ``SENSORS``.
        runs: names in ``MANEUVERS``; all where None.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    values = chosen_values(effects)
    hidden = Hidden(**{EFFECTS[e][p][0]: value for (e, p), value in values.items()})
    noise, every = SENSORS[sensors]
    names = list(MANEUVERS) if runs is None else list(runs)
    for name in names:
        rng = np.random.default_rng([seed, list(MANEUVERS).index(name)])
        columns = _fly_run(name, hidden, gusts, rng)
        _add_noise(columns, noise, hidden, rng)
        _thin(columns, every, lost_echoes, radio_gaps, rng)
        (folder / f"{name}.csv").write_text(_csv(columns))
    (folder / "card.toml").write_text(_card(names, noise))
    full = {f"{effect}.{parameter}": value for (effect, parameter), value in values.items()}
    truth = {
        "hidden": list(effects),
        "values": full,
        "comparable": {name: value for name, value in full.items() if name not in OTHER_FORM},
        "gusts": gusts,
        "sensors": sensors,
        "seed": seed,
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return folder


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


def _fly_run(
    name: str, hidden: Hidden, gusts: bool, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    n = round(MANEUVERS[name] / STEP)
    settle = round(SETTLE / STEP)
    target, trust, extra = _plan(name, STEP * np.arange(n))
    rows = settle + n
    tremor = np.empty((rows, 4))
    for i, (std, memory) in enumerate(((0.4, 0.12), (0.4, 0.12), (0.003, 0.25), (0.003, 0.25))):
        tremor[:, i] = _wander(rng.standard_normal(rows), std, memory)
    gust_std = np.array([0.2, 0.2, 0.2, 0.006, 0.006, 0.003]) * gusts
    shake = rng.standard_normal((rows, SUBSTEPS, 6)) if gusts else np.zeros((rows, SUBSTEPS, 6))
    commands, readings = _fly(n, settle, target, trust, extra, tremor, shake, gust_std, 0.5, hidden)
    if not np.isfinite(readings).all() or abs(readings[:, 8:10]).max() > 0.8:
        raise RuntimeError(f"the pilot lost the helicopter in {name}: {hidden}")
    columns = {"t": STEP * np.arange(n)}
    columns["rpm_upper_cmd"], columns["rpm_lower_cmd"] = RPM * commands[:, 0], RPM * commands[:, 1]
    columns["rpm_upper"], columns["rpm_lower"] = RPM * readings[:, 0], RPM * readings[:, 1]
    columns["delta_lon"], columns["delta_lat"] = commands[:, 2], commands[:, 3]
    for i, channel in enumerate(("p", "q", "r", "ax", "ay", "az", "phi", "theta", "psi")):
        columns[channel] = readings[:, 2 + i]
    columns["h"] = readings[:, 17]
    columns["vn"], columns["ve"], columns["vd"] = readings[:, 14:17].T
    return columns


def _wander(white: np.ndarray, std: float, memory: float) -> np.ndarray:
    """Noise with an exponential memory."""
    decay = math.exp(-STEP / memory)
    drive = std * math.sqrt(1.0 - decay * decay)
    out = np.empty_like(white)
    state = 0.0
    for k, shock in enumerate(white):
        state = decay * state + drive * shock
        out[k] = state
    return out


def _add_noise(
    columns: dict[str, np.ndarray],
    noise: Mapping[str, float],
    hidden: Hidden,
    rng: np.random.Generator,
) -> None:
    """What the sensors make of the truth, in place."""
    for first, x, y in (("p", "q", "r"), ("ax", "ay", "az")):  # turned axes: Rodrigues, both triads
        turned = _turn(np.stack([columns[c] for c in (first, x, y)]), hidden.tilt_x, hidden.tilt_y)
        columns[first], columns[x], columns[y] = turned
    wobble = np.cumsum(columns["rpm_upper"]) / 60.0 * STEP * 2.0 * np.pi
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
    for channel, std in noise.items():
        columns[channel] = columns[channel] + std * rng.standard_normal(len(columns["t"]))
    columns["psi"] = (columns["psi"] + np.pi) % (2.0 * np.pi) - np.pi


def _turn(vectors: np.ndarray, tilt_x: float, tilt_y: float) -> np.ndarray:
    """(3, n) in axes turned by the rotation vector (tilt_x, tilt_y, 0)."""
    angle = math.hypot(tilt_x, tilt_y)
    if angle == 0.0:
        return vectors
    axis = np.array([tilt_x, tilt_y, 0.0]) / angle
    skew = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    back = np.eye(3) - math.sin(angle) * skew + (1 - math.cos(angle)) * skew @ skew
    return back @ vectors


def _thin(
    columns: dict[str, np.ndarray],
    every: Mapping[str, int],
    lost_echoes: bool,
    radio_gaps: bool,
    rng: np.random.Generator,
) -> None:
    """Leave the readings that a real log would have, in place; NaN elsewhere."""
    n = len(columns["t"])
    if lost_echoes:
        columns["h"] = np.where(rng.random(n) < 0.005, 6.5, columns["h"])
    for channel, step in every.items():
        columns[channel] = np.where(np.arange(n) % step == 0, columns[channel], np.nan)
    if radio_gaps:
        for _ in range(2):
            start = int(rng.integers(200, n - 100))
            gap = slice(start, start + int(rng.integers(5, 25)))
            for channel in NOISE:
                columns[channel][gap] = np.nan


def _csv(columns: Mapping[str, np.ndarray]) -> str:
    texts = []
    for channel, values in columns.items():
        form = "%.2f" if channel == "t" else _FORMATS.get(channel, "%.5f")
        texts.append(["" if x != x else form % x for x in values.tolist()])
    rows = [",".join(columns), *(",".join(row) for row in zip(*texts, strict=True))]
    return "\n".join(rows) + "\n"


def _card(names: Iterable[str], noise: Mapping[str, float]) -> str:
    lines = ["[vehicle]", 'name = "lama400d"', "[air]"]
    lines += [f"density = {RHO}", f"gravity = {GRAVITY}", "[noise]"]
    lines += [f"{channel} = {std}" for channel, std in noise.items()]
    for name in names:
        lines += ["[[run]]", f'name = "{name}"', f'file = "{name}.csv"', f'maneuver = "{name}"']
    return "\n".join(lines) + "\n"


def _main() -> None:
    parser = argparse.ArgumentParser(description="Write a flight with effects hidden in it.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--effect", action="append", default=[], metavar="NAME[.PARAMETER=VALUE]")
    parser.add_argument("--gusts", action="store_true")
    parser.add_argument("--sensors", choices=SENSORS, default="full")
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
    fly(
        args.folder, effects, gusts=args.gusts, sensors=args.sensors, seed=args.seed,
        lost_echoes=args.lost_echoes, radio_gaps=args.radio_gaps,
    )  # fmt: skip
    print((args.folder / "truth.json").read_text())


if __name__ == "__main__":
    _main()
