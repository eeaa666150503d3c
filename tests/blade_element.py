"""Another simulator of a small coaxial helicopter, by blade elements: every effect acts at once.

Nothing is hidden in it and nothing can be switched off: thrust, torque, drag, dampings and flapping are
what blades, an inflow of its own momentum, motors and moving air make of them. A vehicle file of it
has what its owner could measure on a bench: masses, and thrust and torque in hover. What a diagnosis
names is right where it is in `ACTS`, and false where it is not.

Its maneuvers, pilot and sensors are the injector's, its physics is not. Sources: Leishman, Principles
of Helicopter Aerodynamics (2006), ch. 2-4; Pitt and Peters (1981) for the air's apparent mass.

    python tests/blade_element.py DIR --craft coax --sensors pose --wind 0.5 --seed 3
"""

import argparse
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import injector
import numpy as np
from injector import (
    _as_logged,
    _cross,
    _euler,
    _log_motion,
    _notice,
    _pilot,
    _rotation,
    _see,
    _thrust_vector,
)
from injector_craft import CRAFTS, LAMA, SHIPPED, Craft, rotors_of, write_vehicle
from injector_sensors import MIXED, MIXED_POSES, SENSORS, clock, kit, thin
from numba import njit
from scipy.optimize import brentq

ACTS = frozenset({
    "motor_lag", "spin_up_reaction", "axial_damping", "dynamic_inflow", "ground_effect",
    "wake_interference", "rotor_drag", "airframe_drag", "flap_blowback", "upper_blowback",
    "hub_stiffness", "yaw_damping", "gyroscopic_coupling", "servo_lag",
})  # fmt: skip
"""What the simulator does, by the catalogue's names; not all of it shows in every flight."""

SUBSTEPS = 10
SETTLE = 6.0  # s flown before the log starts
LIFT_SLOPE = 5.3  # per rad, at the Reynolds number of such blades
SOLIDITY = 0.10
ON_LOWER, ON_UPPER = 0.6, 0.1  # share of a rotor's induced velocity that the other one is in
CONING = 0.03  # rad
N_STATE = 25
# 0-2 position, 3-5 velocity, 6-9 quaternion, 10-12 p q r, 13-16 alpha_l beta_l alpha_f beta_f, 17-18
# rotor speeds, 19-20 induced velocities, 21-24 the plate's tilts and their rates.


class Machine(NamedTuple):
    """What blades and motors add to a craft. pitch [rad], profile drag, of each rotor; motor: 1/s of a
    rotor's speed control; servo: s; stiffness: N m/rad of each hub; area: m2 of the fuselage; wander:
    share of thrust and torque by which each rotor's own wake shakes it; wander_memory: s, of that."""

    pitch_upper: float
    pitch_lower: float
    drag_upper: float
    drag_lower: float
    stiffness: float
    area: float
    motor: float = 14.0
    servo: float = 0.02
    wander: float = 0.01
    wander_memory: float = 0.15


@njit(cache=True)
def _blades(pitch, drag, advance, inflow):
    """C_T and C_Q of a rotor with blades of constant chord and pitch (Leishman 3.3, 5.2)."""
    thrust = 0.5 * SOLIDITY * LIFT_SLOPE * (pitch / 3.0 * (1.0 + 1.5 * advance**2) - 0.5 * inflow)
    return thrust, inflow * thrust + 0.125 * SOLIDITY * drag * (1.0 + 4.6 * advance**2)


def machine_of(craft: Craft, **changes: float) -> Machine:
    """Blades that make the thrust and torque that a craft's file says, in hover."""
    rotors = rotors_of(craft)
    tips = np.array([rotors.hover_upper, rotors.hover_lower]) * craft.radius
    wanted = np.array([craft.thrust_upper, craft.thrust_lower])
    area = math.pi * craft.radius**2
    thrust = wanted * craft.density * area * tips**2
    upper, lower = induced(thrust, craft)
    inflow = np.array([upper + ON_UPPER * lower, lower + ON_LOWER * upper]) / tips
    pitch = 3.0 * (2.0 * wanted / (SOLIDITY * LIFT_SLOPE) + 0.5 * inflow)
    profile = (
        (np.array([craft.torque_upper, craft.torque_lower]) - inflow * wanted) * 8.0 / SOLIDITY
    )
    stiffness = 0.1 * craft.inertia_x / LAMA.inertia_x
    return Machine(
        *pitch.tolist(), *profile.tolist(),
        **({"stiffness": stiffness, "area": 0.13 * craft.radius**2} | changes),
    )  # fmt: skip


def induced(thrust: np.ndarray, craft: Craft) -> tuple[float, float]:
    """Induced velocities [m/s] at which both rotors' air takes up these thrusts [N] in hover."""
    area = math.pi * craft.radius**2

    def lower_of(upper: float) -> float:
        load = thrust[1] / (2.0 * craft.density * area)
        through = ON_LOWER * upper
        return 0.5 * (math.sqrt(through**2 + 4.0 * load) - through)

    def left(upper: float) -> float:
        through = upper + ON_UPPER * lower_of(upper)
        return 2.0 * craft.density * area * upper * through - thrust[0]

    upper = brentq(left, 0.1, 20.0)
    return upper, lower_of(upper)


@njit(cache=True)
def _rotor(speed, air, own, other_share, pitch, drag, craft, height):
    """Thrust, torque, in-plane force per air speed, and air through the disc, of one rotor.

    `speed`: of its blades through the air [rad/s]. `own`: its induced velocity; the ground holds it up.
    """
    tip = speed * craft.radius
    area = math.pi * craft.radius**2
    across = math.sqrt(air[0] ** 2 + air[1] ** 2)
    near = 1.0 - (craft.radius / (4.0 * max(height, 0.4 * craft.radius))) ** 2
    through = (own + other_share) * near - air[2]
    inflow, advance = through / tip, across / tip
    c_t, c_q = _blades(pitch, drag, advance, inflow)
    load = craft.density * area * tip * tip
    in_plane = (
        craft.density * area * tip * SOLIDITY * (0.25 * drag + 0.25 * LIFT_SLOPE * inflow * pitch)
    )
    return load * c_t, load * craft.radius * c_q, in_plane, through


@njit(cache=True)
def _derivative(s, command, wind, shake, craft, machine, rotors, out):
    """ds/dt; ``out`` gets specific force and angular acceleration."""
    R = _rotation(s)
    omega = s[10:13]
    air = R.T @ (s[3:6] - wind)
    ds = np.zeros(N_STATE)
    height = -s[2]
    area = math.pi * craft.radius**2

    # blades turn against the body: the upper one left, the lower one right, seen from above
    T_u, Q_u, H_u, through_u = _rotor(
        s[17] - omega[2],
        air,
        s[19],
        ON_UPPER * s[20],
        machine.pitch_upper,
        machine.drag_upper,
        craft,
        height,
    )
    T_l, Q_l, H_l, through_l = _rotor(
        s[18] + omega[2],
        air,
        s[20],
        ON_LOWER * s[19],
        machine.pitch_lower,
        machine.drag_lower,
        craft,
        height,
    )
    across2 = air[0] ** 2 + air[1] ** 2
    apparent = 8.0 / 3.0 * craft.density * craft.radius**3
    ds[19] = (
        T_u - 2.0 * craft.density * area * s[19] * math.sqrt(through_u**2 + across2)
    ) / apparent
    ds[20] = (
        T_l - 2.0 * craft.density * area * s[20] * math.sqrt(through_l**2 + across2)
    ) / apparent
    T_u, T_l = T_u * (1.0 + shake[0]), T_l * (1.0 + shake[1])
    Q_u, Q_l = Q_u * (1.0 + shake[2]), Q_l * (1.0 + shake[3])

    # discs tilt back from the air, and across by their coning, each its own way round
    tip_u, tip_l = s[17] * craft.radius, s[18] * craft.radius
    back_u = (8.0 / 3.0 * machine.pitch_upper - 2.0 * through_u / tip_u) / tip_u
    back_l = (8.0 / 3.0 * machine.pitch_lower - 2.0 * through_l / tip_l) / tip_l
    side_u, side_l = 4.0 / 3.0 * CONING / tip_u, -4.0 / 3.0 * CONING / tip_l
    alpha_u = craft.bar_lon * s[15] + 0.5 * (back_u * air[0] + side_u * air[1])
    beta_u = craft.bar_lat * s[16] - 0.5 * (back_u * air[1] - side_u * air[0])
    alpha_l, beta_l = s[13], s[14]
    follows = craft.flap_time * rotors.hover_lower / s[18]
    gain = craft.swash_gain
    ds[13] = (gain * s[21] + back_l * air[0] + side_l * air[1] - alpha_l) / follows - omega[1]
    ds[14] = (gain * s[22] - back_l * air[1] + side_l * air[0] - beta_l) / follows - omega[0]
    ds[15] = -s[15] / craft.bar_time - omega[1]
    ds[16] = -s[16] / craft.bar_time - omega[0]

    F_u = _thrust_vector(T_u, alpha_u, beta_u)
    F_l = _thrust_vector(T_l, alpha_l, beta_l)
    for i in range(2):
        F_u[i] -= H_u * air[i]
        F_l[i] -= H_l * air[i]
    force = F_u + F_l
    moment = _cross(np.array([0.0, 0.0, -craft.hub_upper]), F_u)
    moment = moment + _cross(np.array([0.0, 0.0, -craft.hub_lower]), F_l)
    moment[0] += machine.stiffness * (beta_u + beta_l)
    moment[1] += machine.stiffness * (alpha_u + alpha_l)
    force[2] += rotors.downwash * T_u
    quick = math.sqrt(air[0] ** 2 + air[1] ** 2 + air[2] ** 2)
    for i in range(3):
        force[i] -= 0.5 * craft.density * machine.area * quick * air[i]

    # motors: what the bench needed at that speed, and a control of the speed; the body takes it up
    upper = craft.rotor_upper + craft.bar
    drive_u = rotors.torque_upper * command[0] ** 2 + upper * machine.motor * (command[0] - s[17])
    drive_l = rotors.torque_lower * command[1] ** 2 + craft.rotor_lower * machine.motor * (
        command[1] - s[18]
    )
    ds[17] = (drive_u - Q_u) / upper
    ds[18] = (drive_l - Q_l) / craft.rotor_lower
    moment[2] += drive_u - drive_l
    n = 2.0 / machine.servo
    for i in range(2):
        ds[21 + i] = s[23 + i]
        ds[23 + i] = n * n * (command[2 + i] - s[21 + i]) - 2.0 * n * s[23 + i]

    inertia = np.array([craft.inertia_x, craft.inertia_y, craft.inertia_z])
    spin = np.array([0.0, 0.0, craft.rotor_lower * s[18] - upper * s[17]])
    ds[10:13] = (moment - _cross(omega, inertia * omega + spin)) / inertia
    specific = force / craft.mass
    ds[3:6] = R @ specific + np.array([0.0, 0.0, craft.gravity])
    ds[0:3] = s[3:6]
    a, b, c, d = s[6], s[7], s[8], s[9]
    p, q, r = omega[0], omega[1], omega[2]
    ds[6] = 0.5 * (-b * p - c * q - d * r)
    ds[7] = 0.5 * (a * p + c * r - d * q)
    ds[8] = 0.5 * (a * q + d * p - b * r)
    ds[9] = 0.5 * (a * r + b * q - c * p)
    out[0:3] = specific
    out[3:6] = ds[10:13]
    return ds


@njit(cache=True)
def _fly(clock, dt, step, targets, trusts, extra, tremor, winds, shakes, pilot, craft, machine, rotors,
         start):  # fmt: skip
    """Commands and true readings of all rows, as the injector's; classical Runge-Kutta."""
    rows = len(clock)
    commands = np.empty((rows, 4))
    readings = np.empty((rows, 18))
    s = start.copy()
    s[0], s[1], s[2] = targets[0, 0], targets[0, 1], -targets[0, 2]
    s[6], s[9] = math.cos(targets[0, 3] / 2.0), math.sin(targets[0, 3] / 2.0)
    out, out2 = np.zeros(6), np.zeros(6)
    memory, seen = np.zeros(4), np.zeros(12)
    saw = np.empty((rows, 12))
    behind = int(round(pilot.delay / step))
    wanted = np.zeros(4)
    for k in range(rows):
        R = _rotation(s)
        attitude = _euler(R)
        _see(s, attitude, saw[k])
        if k == 0:
            seen[:] = saw[0]
        _notice(saw[max(k - behind, 0)], pilot.senses * dt[k], seen)
        if k % pilot.hold == 0:
            trust = trusts[k]
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
        rates = s[10:13].copy()
        wind = winds[k * SUBSTEPS]
        _derivative(s, command, wind, shakes[k * SUBSTEPS], craft, machine, rotors, out)
        readings[k, 0:2] = s[17:19]
        readings[k, 2:5] = rates
        readings[k, 5:8] = out[0:3]
        _log_motion(s, attitude, R, readings[k])
        h = dt[k] / SUBSTEPS
        for j in range(SUBSTEPS):
            wind, shake = winds[k * SUBSTEPS + j], shakes[k * SUBSTEPS + j]
            k1 = _derivative(s, command, wind, shake, craft, machine, rotors, out2)
            k2 = _derivative(s + 0.5 * h * k1, command, wind, shake, craft, machine, rotors, out2)
            k3 = _derivative(s + 0.5 * h * k2, command, wind, shake, craft, machine, rotors, out2)
            k4 = _derivative(s + h * k3, command, wind, shake, craft, machine, rotors, out2)
            s = s + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            s[6:10] /= math.sqrt(s[6] ** 2 + s[7] ** 2 + s[8] ** 2 + s[9] ** 2)
    return commands, readings


def fly(
    folder: str | Path,
    *,
    craft: Craft = LAMA,
    sensors: str = "onboard",
    wind: float = 0.0,
    turbulence: float = 0.0,
    pilot: str = "usual",
    seed: int = 0,
    runs: Iterable[str] | None = None,
    longest: float = math.inf,
    **changes: float,
) -> Path:
    """Write a flight folder.

    Args:
        wind: m/s, steady, from the south-west. turbulence: m/s, std of each of its components, with
            memories that go with 2 m/s of air (Dryden, first order).
        changes: fields of `Machine`.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    aboard = kit(sensors, seed)
    machine = machine_of(craft, **changes)
    names = list(injector.MANEUVERS) if runs is None else list(runs)
    for i, name in enumerate(names):
        rng = np.random.default_rng([seed, 77, list(injector.MANEUVERS).index(name)])
        length = min(injector.MANEUVERS[name], longest)
        columns = _fly_run(name, length, aboard, craft, machine, wind, turbulence, pilot, rng)
        columns = injector._read(columns, aboard, injector.Hidden(), rng)
        columns = thin(columns, aboard, rng, lost_echoes=False, radio_gaps=False, first=i == 0)
        (folder / f"{name}.csv").write_text(injector.csv_text(columns, aboard))
    vehicle = SHIPPED.get(craft)
    if vehicle is None:
        write_vehicle(craft, folder / "vehicle.toml")
        vehicle = str(folder.resolve() / "vehicle.toml")
    card = injector.card_text(names, vehicle, (craft.density, craft.gravity), dict(aboard.noise))
    (folder / "card.toml").write_text(card)
    (folder / "truth.json").write_text(json.dumps({"hidden": sorted(ACTS)}) + "\n")
    return folder


def _fly_run(name, length, sensors, craft, machine, wind, turbulence, pilot, rng):
    hand = injector.PILOTS[pilot]
    rotors = rotors_of(craft)
    times = clock(sensors, SETTLE, length, rng)
    dt = np.full(len(times) - 1, sensors.step) if sensors.unrest == 0.0 else np.diff(times)
    rows = len(dt)
    whole = injector.STEP * np.arange(round(injector.MANEUVERS[name] / injector.STEP))
    target, trust, extra = injector._plan(name, whole, craft)
    at = np.clip(np.round(times[:-1] / injector.STEP).astype(int), 0, len(target) - 1)
    tremor = injector._tremor(hand, craft, rows, sensors.step, rng)
    fine, steps = sensors.step / SUBSTEPS, rows * SUBSTEPS + 1
    winds = np.empty((steps, 3))
    for i, (mean, memory) in enumerate(((0.7, 0.9), (0.7, 0.9), (0.0, 0.3))):
        gust = injector._wander(rng.standard_normal(steps), turbulence, memory, fine)
        winds[:, i] = mean * wind + gust
    shakes = np.empty((steps, 4))
    for i in range(4):
        share = machine.wander * (1.0 if i < 2 else 0.5)
        shakes[:, i] = injector._wander(
            rng.standard_normal(steps), share, machine.wander_memory, fine
        )
    start = np.zeros(N_STATE)
    start[17:19] = rotors.hover_upper, rotors.hover_lower
    thrust = np.array([rotors.thrust_upper, rotors.thrust_lower]) * start[17:19] ** 2
    start[19:21] = induced(thrust, craft)
    commands, readings = _fly(
        times[:-1], dt, sensors.step, target[at], trust[at], extra[at], tremor, winds, shakes,
        injector._suited(hand, craft), craft, machine, rotors, start,
    )  # fmt: skip
    first = int(np.searchsorted(times, -1e-12))
    logged = readings[first:]
    if not np.isfinite(logged).all() or abs(logged[:, 8:10]).max() > 0.8:
        raise RuntimeError(f"the pilot lost the helicopter in {name}")
    columns = {"t": times[first:-1]}
    columns["rpm_upper_cmd"], columns["rpm_lower_cmd"] = injector.RPM * commands[first:, :2].T
    columns["rpm_upper"], columns["rpm_lower"] = injector.RPM * logged[:, :2].T
    columns["delta_lon"], columns["delta_lat"] = commands[first:, 2:].T
    for i, channel in enumerate(("p", "q", "r", "ax", "ay", "az", "phi", "theta", "psi")):
        columns[channel] = logged[:, 2 + i]
    columns["h"] = -logged[:, 13]
    columns["vn"], columns["ve"], columns["vd"] = logged[:, 14:17].T
    columns["pn"], columns["pe"] = logged[:, 11:13].T
    return columns


def _main() -> None:
    parser = argparse.ArgumentParser(description="Write a flight of a simulator by blade elements.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sensors", choices=[*SENSORS, MIXED, MIXED_POSES], default="onboard")
    parser.add_argument("--craft", choices=CRAFTS, default="lama")
    parser.add_argument("--pilot", choices=injector.PILOTS, default="usual")
    parser.add_argument("--wind", type=float, default=0.0, help="m/s")
    parser.add_argument("--turbulence", type=float, default=0.0, help="m/s")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    fly(
        args.folder, craft=CRAFTS[args.craft], sensors=args.sensors, wind=args.wind,
        turbulence=args.turbulence, pilot=args.pilot, seed=args.seed,
    )  # fmt: skip


if __name__ == "__main__":
    _main()
