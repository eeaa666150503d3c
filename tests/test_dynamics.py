"""The model against physics written a second time: vectors, cross products, rotation matrices.

The formulas here come from the paper (design/paper.md, design/effects.md), not from the code.
"""

import gc
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from scipy.spatial.transform import Rotation

from coax_env import derivative, hover_trim, load_vehicle
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.lasting_errors import ErringModel
from coax_env.estimation.rotor_jitter import JitteryModel
from coax_env.estimation.swinging_gusts import SwingingModel
from coax_env.kernel import compilation
from coax_env.model import channels as Z
from coax_env.model import dynamics, effects
from coax_env.model import inputs as U
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.layout import (
    CHANNELS,
    COMMANDS,
    FULL_STATES,
    N_CHANNELS,
    N_FULL,
    N_STATES,
    STATES,
)

LAMA = load_vehicle("lama400d")
COUPLED = LAMA.with_values(
    {
        "flap_coupling_lon": 0.2, "flap_coupling_lat": -0.3, "flybar_to_rotor_lat": 0.43,
        "rotor_inertia_lower": 6e-4,
    }
)  # fmt: skip
"""No two of its numbers are the same, so that none can stand in another's place."""
NAMES = [name for name, _ in STATES]
SEEDS = range(5)


def random_state(seed):
    """A state far from hover, a command near it."""
    rng = np.random.default_rng(seed)
    size = [3, 3, 3, 2, 2, 2, 0.2, 0.2, 0.2, 0.2, 1.2, 1.2, 3.1, 5, 5, 0]
    state = rng.uniform(-1, 1, 16) * size
    state[15] = -rng.uniform(0.1, 0.8)
    command = np.array([209.0, 224.0, 0.0, 0.0]) * rng.uniform(0.8, 1.2, 4)
    command[2:] = rng.uniform(-0.2, 0.2, 2)
    return state, command


def body_to_world(state):
    return Rotation.from_euler("ZYX", state[[12, 11, 10]]).as_matrix()


def unit_thrust(alpha, beta):
    """(13)-(14) as the paper prints them, not as the code computes them."""
    sa, ca, sb, cb = math.sin(alpha), math.cos(alpha), math.sin(beta), math.cos(beta)
    return np.array([-sa * cb, sb * ca, -ca * cb]) / math.sqrt(1 - sa**2 * sb**2)


class Second:
    """The model written again in vectors. Effects enter through the attributes a test changes."""

    def __init__(self, state, command, vehicle):
        self.x, self.u, self.v = state, command, vehicle.values()
        v, (w_u, w_l) = self.v, command[:2]
        k = v["air_density"] * math.pi * v["rotor_radius"] ** 4
        self.R = body_to_world(state)
        self.V, self.omega = state[0:3], state[3:6]
        self.mass, self.inertia = v["mass"], [v[f"inertia_{a}"] for a in ("xx", "yy", "zz")]
        self.thrust = k * np.array(
            [v["thrust_coefficient_upper"] * w_u**2, v["thrust_coefficient_lower"] * w_l**2]
        )
        self.torque = k * v["rotor_radius"] * np.array(
            [v["torque_coefficient_upper"] * w_u**2, v["torque_coefficient_lower"] * w_l**2]
        )  # fmt: skip
        linkage = np.array([v["flybar_to_rotor_lon"], v["flybar_to_rotor_lat"]])
        self.tilt_upper = linkage * state[8:10]
        self.swash = command[2:4].copy()
        self.force, self.moment, self.flap_rate = np.zeros(3), np.zeros(3), np.zeros(2)
        self.hubs = np.zeros(3)  # their shift against the centre of gravity
        self.gain, self.flybar_time = v["swash_to_flap"], v["flybar_time_constant"]
        self.air = self.V.copy()

    def forces(self):
        """Forces but gravity [N] and moments [N m], body axes."""
        v = self.v
        upper = self.thrust[0] * unit_thrust(*self.tilt_upper)
        lower = self.thrust[1] * unit_thrust(*self.x[6:8])
        induced2 = self.thrust[0] / (2 * v["air_density"] * math.pi * v["rotor_radius"] ** 2)
        area = v["fuselage_length"] * v["fuselage_width"]
        download = 0.5 * v["air_density"] * induced2 * area * v["fuselage_drag_coefficient"]
        force = upper + lower + [0, 0, download] + self.force
        momentum = np.array([0, 0, v["rotor_inertia_lower"] * self.u[1]])
        momentum[2] -= (v["rotor_inertia_upper"] + v["flybar_inertia"]) * self.u[0]
        moment = np.cross(self.hubs + [0, 0, -v["arm_upper"]], upper)
        moment += np.cross(self.hubs + [0, 0, -v["arm_lower"]], lower)
        # a hub's lateral tilt gives L > 0: r x F; the rotors' torques act about z only
        moment = moment - np.cross(self.omega, momentum)
        moment[2] += self.torque[0] - self.torque[1]
        return force, moment + self.moment

    def rates(self):
        force, moment = self.forces()
        v, x = self.v, self.x
        dx = np.empty(16)
        gravity = self.R.T @ [0, 0, v["gravity"]]
        dx[0:3] = -np.cross(self.omega, self.V) + gravity + force / self.mass
        dx[3:6] = moment / self.inertia
        p, q = self.omega[:2]
        flap = np.array([-q, -p]) + (self.gain * self.swash - x[6:8]) / v["flap_time_constant"]
        flap[0] -= v["flap_coupling_lon"] * x[7] / v["flap_time_constant"]
        flap[1] += v["flap_coupling_lat"] * x[6] / v["flap_time_constant"]
        dx[6:8] = flap + self.flap_rate
        dx[8:10] = -x[8:10] / self.flybar_time - [q, p]
        dx[10:13] = euler_rates(x[10:13], self.omega)
        dx[13:16] = self.R @ self.V
        return dx


def euler_rates(angles, omega):
    """Euler rates from omega = sum of each rate about its own axis, solved as a linear system."""
    phi, theta, _ = angles
    about_x = np.array([1.0, 0, 0])
    about_y = Rotation.from_euler("x", phi).as_matrix().T @ [0, 1, 0]
    about_z = Rotation.from_euler("YX", [theta, phi]).as_matrix().T @ [0, 0, 1]
    return np.linalg.solve(np.column_stack([about_x, about_y, about_z]), omega)


def close(a, b, tolerance=1e-9):
    np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * max(1.0, np.abs(b).max()))


# --- the bare model ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", NAMES)
def test_each_equation(name, seed):
    state, command = random_state(seed)
    i = NAMES.index(name)
    found = derivative(state, command, COUPLED)[i]
    assert found == pytest.approx(Second(state, command, COUPLED).rates()[i], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_attitude_turns_as_the_body_rates_say(seed):
    """(38)-(40) by differencing the rotation matrix: R' = R [omega x]."""
    state, command = random_state(seed)
    rate = derivative(state, command, LAMA)
    h = 1e-6
    plus, minus = state + h * rate, state - h * rate
    slope = (body_to_world(plus) - body_to_world(minus)) / (2 * h)
    cross = body_to_world(state).T @ slope
    np.testing.assert_allclose([cross[2, 1], cross[0, 2], cross[1, 0]], state[3:6], atol=1e-7)


@pytest.mark.parametrize("seed", SEEDS)
def test_gyroscopic_moment_does_no_work(seed):
    state, command = random_state(seed)
    still = dict.fromkeys(("rotor_inertia_upper", "rotor_inertia_lower", "flybar_inertia"), 0.0)
    inertia = np.array([LAMA[f"inertia_{a}"].value for a in ("xx", "yy", "zz")])
    with_rotors = derivative(state, command, LAMA)[3:6]
    without = derivative(state, command, LAMA.with_values(still))[3:6]
    moment = inertia * (with_rotors - without)
    assert np.linalg.norm(moment) > 1e-3
    assert abs(state[3:6] @ moment) < 1e-12 * np.linalg.norm(moment)


def test_gyroscopic_moment_turns_the_right_way():
    """Upper rotor dominant: H points up (-z). Rolling right (p > 0) then pitches: M = p H < 0."""
    state, command = np.zeros(16), np.array([220.0, 0.0, 0.0, 0.0])
    level = derivative(state, command, LAMA)
    state[3] = 1.0
    assert derivative(state, command, LAMA)[4] < level[4]


@pytest.mark.parametrize("seed", SEEDS)
def test_mirror_symmetry(seed):
    """The mirror image of a helicopter (its rotors turn the other way) flies the mirrored flight.

    Reflected in the x-z plane: v p r, lateral flaps, phi psi y and delta_lat change sign. The
    image's rotors carry the opposite angular momentum and torque: their sizes are exchanged.
    """
    state, command = random_state(seed)
    flip = np.ones(16)
    flip[[NAMES.index(n) for n in ("v", "p", "r", "beta_l", "beta_f", "phi", "psi", "y")]] = -1
    v, (w_u, w_l) = COUPLED.values(), command[:2]
    upper = v["rotor_inertia_upper"] + v["flybar_inertia"]
    image = COUPLED.with_values(
        {
            "rotor_inertia_upper": v["rotor_inertia_lower"] * w_l / w_u,
            "flybar_inertia": 0.0,
            "rotor_inertia_lower": upper * w_u / w_l,
            "torque_coefficient_upper": v["torque_coefficient_lower"] * (w_l / w_u) ** 2,
            "torque_coefficient_lower": v["torque_coefficient_upper"] * (w_u / w_l) ** 2,
            "flap_coupling_lon": -v["flap_coupling_lon"],
            "flap_coupling_lat": -v["flap_coupling_lat"],
        }
    )
    mirrored = derivative(flip * state, command * [1, 1, 1, -1], image)
    close(mirrored, flip * derivative(state, command, COUPLED))


@pytest.mark.parametrize("seed", SEEDS)
def test_heading_and_place_do_not_matter(seed):
    """Turned about the vertical and moved: the same body rates, the velocity turned along."""
    state, command = random_state(seed)
    moved = state + np.array([0] * 12 + [0.7, 3, -2, -1])
    here, there = derivative(state, command, LAMA), derivative(moved, command, LAMA)
    close(there[:13], here[:13])
    close(there[13:16], Rotation.from_euler("z", 0.7).as_matrix() @ here[13:16])


@pytest.mark.parametrize("seed", SEEDS)
def test_free_fall(seed):
    """Rotors off: the world sees gravity and nothing else, at any attitude and rate."""
    state, command = random_state(seed)
    command[:2] = 0.0
    rate = derivative(state, command, LAMA)
    R = body_to_world(state)
    close(R @ (rate[0:3] + np.cross(state[3:6], state[0:3])), np.array([0, 0, 9.804]))
    np.testing.assert_allclose(rate[3:6], 0.0, atol=1e-15)


def test_free_fall_flown():
    """A tumbling second of free fall is a parabola."""
    state, _ = random_state(2)
    start = np.zeros(N_FULL)
    start[:16] = state
    start[3:5] = 0.5  # slow enough to stay away from theta = 90 deg
    start[10:12] = 0.3
    velocity = body_to_world(start[:16]) @ start[0:3]
    flown = fly(start, np.zeros(4), 1.0, 0.01, LAMA)
    fallen = start[13:16] + velocity + [0, 0, 0.5 * 9.804]
    np.testing.assert_allclose(flown[13:16], fallen, atol=1e-7)


@pytest.mark.parametrize("seed", SEEDS)
def test_thrust_direction(seed):
    """With equal tilt of both discs the force is the thrust along [-tan a, tan b, -1]."""
    state, command = random_state(seed)
    alpha, beta = state[6:8]
    state[8:10] = alpha / 0.54, beta / 0.54
    no_fuselage = LAMA.with_values({"fuselage_drag_coefficient": 0.0})
    found = dynamics.readings(state, command, no_fuselage)
    force = 0.8 * np.array([found["ax"], found["ay"], found["az"]])
    along = np.array([-math.tan(alpha), math.tan(beta), -1.0])
    close(force / np.linalg.norm(force), along / np.linalg.norm(along))
    assert np.linalg.norm(force) == pytest.approx(Second(state, command, LAMA).thrust.sum())


def test_trim_is_the_one_of_the_tables():
    _, command = hover_trim("lama400d")
    np.testing.assert_allclose(command[:2] * 30 / math.pi, [1994, 2139], rtol=1e-3)


@pytest.mark.parametrize("name", ["lama400d", "skybotix_coax"])
def test_nothing_moves_at_trim(name):
    state, command = hover_trim(name)
    np.testing.assert_allclose(derivative(state, command, name), 0.0, atol=1e-9)


def test_trim_finds_the_tilt_that_offsets_ask_for():
    vehicle = (
        LAMA.with_effect("cg_offset", x=0.002, y=-0.001)
        .with_effect("wind", north=1.0, east=-0.5)
        .with_effect("rotor_drag", coefficient=4e-4)
        .with_effect("ground_effect", gain=0.4)
    )
    state, command = hover_trim(vehicle, height=0.3)
    np.testing.assert_allclose(derivative(state, command, vehicle), 0.0, atol=1e-7)
    assert command[0] < hover_trim(LAMA)[1][0]  # the ground carries a part


def test_balance_is_found_in_few_looks():
    """Newton's method doubles the right digits at each step; a kink's solver would look on."""
    looks = []

    def residual(z):
        looks.append(z)
        return np.array([math.exp(z[0]) - z[1], z[0] + z[1] ** 2 - 1.0])

    found = dynamics._balance(residual, np.array([0.3, 1.6]))
    assert found == pytest.approx([0.0, 1.0], abs=1e-9)
    assert len(looks) <= 6 * (2 * 2 + 2)


def test_a_vehicle_that_cannot_hover_says_so():
    from coax_env import InputError

    with pytest.raises(InputError, match="no hover"):
        hover_trim(LAMA.with_effect("rotor_drag", coefficient=1.0).with_effect("wind", north=200.0))


def test_wrong_shapes_are_told():
    from coax_env import InputError

    with pytest.raises(InputError, match="state"):
        derivative(np.zeros(12), np.zeros(4), LAMA)


def test_specific_force_at_hover():
    state, command = hover_trim(LAMA)
    found = dynamics.readings(state, command, LAMA)
    np.testing.assert_allclose([found["ax"], found["ay"], found["az"]], [0, 0, -9.804], atol=1e-9)
    assert found["h"] == pytest.approx(1.5)
    assert found["rpm_upper"] == pytest.approx(1994.16, abs=0.1)


@pytest.mark.parametrize("seed", SEEDS)
def test_readings_of_the_bare_model(seed):
    """(45), and the channels of the contract."""
    state, command = random_state(seed)
    found = dynamics.readings(state, command, LAMA)
    second = Second(state, command, LAMA)
    velocity = second.R @ state[:3]
    expected = {
        "rpm_upper": command[0] * 30 / math.pi, "rpm_lower": command[1] * 30 / math.pi,
        "p": state[3], "q": state[4], "r": state[5],
        **dict(zip(("ax", "ay", "az"), second.forces()[0] / 0.8, strict=True)),
        "phi": state[10], "theta": state[11], "psi": state[12], "h": -state[15],
        "vn": velocity[0], "ve": velocity[1], "vd": velocity[2],
        "pn": state[13], "pe": state[14], "v": np.linalg.norm(state[:3]),
    }  # fmt: skip
    assert set(found) == set(expected) == set(CHANNELS)
    for channel, value in expected.items():
        assert found[channel] == pytest.approx(value, rel=1e-9, abs=1e-9), channel


# --- time ---------------------------------------------------------------------------------------


def fly(start, command, seconds, dt, vehicle):
    """The full state after `seconds` of held command."""
    x, work = start.copy(), np.zeros(dynamics.WORK_SIZE)
    for k in range(round(seconds / dt)):
        dynamics.step(x, dynamics.kernel_input(command, k * dt), dt, vehicle.vector, work, x)
    return x


def settled_state(seed):
    state, command = random_state(seed)
    start = dynamics.full_state(state, command, LAMA)
    start[3:6] *= 0.3
    start[10:12] *= 0.3
    return start, command


@pytest.mark.parametrize("lag", [0.0, 0.07])
def test_rk4_is_of_fourth_order(lag):
    start, command = settled_state(1)
    start[20:26] = [0.1, -0.1, 0.2, 1e-3, -1e-3, 1e-4]
    start[16] += 20.0 if lag else 0.0
    vehicle = LAMA.with_effect("motor_lag", upper=lag, lower=lag)
    exact = fly(start, command, 0.4, 0.4 / 2048, vehicle)
    steps = np.array([0.02, 0.01, 0.005])
    errors = [np.abs(fly(start, command, 0.4, dt, vehicle) - exact)[:16].max() for dt in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 3.7 < slope < 4.5, (slope, errors)


@pytest.mark.parametrize("lag", [0.0, 0.07])
def test_drift_is_a_step_to_first_order(lag):
    """Actuators and gusts exactly; the rest with an error that falls with the square of the row."""
    start, command = settled_state(2)
    start[16:26] = [1990.0, 2150.0, 0.02, -0.01, 0.1, -0.1, 0.2, 1e-3, -1e-3, 1e-4]
    vehicle = LAMA.with_effect("motor_lag", upper=lag, lower=lag)
    work, out = np.zeros(dynamics.WORK_SIZE), np.zeros(N_FULL + len(CHANNELS))
    errors = []
    steps = np.array([4e-3, 2e-3, 1e-3])
    for dt in steps:
        u = dynamics.kernel_input(command)
        dynamics.drift_and_readings(start, u, dt, vehicle.vector, work, out)
        error = start + out[:N_FULL] - fly(start, command, dt, dt, vehicle)
        np.testing.assert_allclose(error[16:], 0.0, atol=1e-10)
        errors.append(np.abs(error[:16]).max())
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 1.8 < slope < 2.2, (slope, errors)


@pytest.mark.parametrize("dt", [0.0, 0.01])
@pytest.mark.parametrize(
    "effect", [{}, {"motor_lag": {"upper": 0.05, "lower": 0.07}}, {"rotor_drag": {"coefficient": 3e-4},
               "gyro_bias": {"x": 0.02}, "imu_lever_arm": {"x": 0.03}}],
)  # fmt: skip
def test_readings_beside_the_drift_are_the_readings(dt, effect):
    start, command = settled_state(4)
    start[16:20] = [1990.0, 2150.0, 0.02, -0.01]
    vehicle = LAMA
    for name, values in effect.items():
        vehicle = vehicle.with_effect(name, **values)
    work, out = np.zeros(dynamics.WORK_SIZE), np.zeros(N_FULL + len(CHANNELS))
    dynamics.drift_and_readings(
        start, dynamics.kernel_input(command), dt, vehicle.vector, work, out
    )
    expected = dynamics.readings(start, command, vehicle)
    np.testing.assert_allclose(out[N_FULL:], list(expected.values()), rtol=1e-12, atol=1e-14)
    if dt == 0.0:
        assert not out[:16].any() and not out[20:26].any()


def test_a_long_row_is_split():
    start, command = settled_state(3)
    whole = fly(start, command, 0.1, 0.1, LAMA)
    np.testing.assert_array_equal(whole, fly_with_time_of_row(start, command, 0.1, 0.02))


def fly_with_time_of_row(start, command, seconds, dt):
    x, work = start.copy(), np.zeros(dynamics.WORK_SIZE)
    for _ in range(round(seconds / dt)):
        dynamics.step(x, dynamics.kernel_input(command), 0.1 / 5, LAMA.vector, work, x)
    return x


def test_lags_follow_their_closed_form():
    vehicle = LAMA.with_effect("motor_lag", upper=0.07, lower=0.13).with_effect(
        "servo_lag", time=0.04
    )
    start = np.zeros(N_FULL)
    start[16:20] = 200.0, 230.0, 0.05, -0.05
    command = np.array([220.0, 210.0, -0.1, 0.1])
    lags = np.array([0.07, 0.13, 0.04, 0.04])
    for seconds, dt in ((0.1, 0.01), (0.2, 0.005), (0.06, 0.06)):
        found = fly(start, command, seconds, dt, vehicle)[16:20]
        close(found, command + (start[16:20] - command) * np.exp(-seconds / lags))


def test_no_lag_is_the_limit_of_a_short_one():
    start, command = settled_state(4)
    start[16:20] += [10, -10, 0.1, -0.1]
    none = fly(start, command, 0.2, 0.01, LAMA)
    gap = []
    for tau in (1e-2, 1e-3, 1e-4, 1e-6, 1e-12):
        lagging = LAMA.with_effect("motor_lag", upper=tau, lower=tau).with_effect(
            "servo_lag", time=tau
        )
        gap.append(np.abs(fly(start, command, 0.2, 0.01, lagging) - none)[:16].max())
    assert gap[0] > gap[1] > gap[2] > gap[3]
    assert gap[2] < 0.1 * gap[0]  # RK4 sees a lag under a fifth of the step as at most h/6 of delay
    assert gap[3] < 1e-9 and gap[4] == 0.0


def test_derivative_takes_lags_at_their_static_limit():
    state, command = random_state(0)
    lagging = LAMA.with_effect("motor_lag", upper=0.1, lower=0.1).with_effect(
        "servo_lag", time=0.05
    )
    np.testing.assert_array_equal(
        derivative(state, command, lagging), derivative(state, command, LAMA)
    )


def test_a_reading_sees_the_command_of_its_own_row_where_nothing_lags():
    state, command = hover_trim(LAMA)
    x = dynamics.full_state(state, command, LAMA)
    out, work = np.empty(N_CHANNELS), np.zeros(dynamics.WORK_SIZE)
    for vehicle, share in ((LAMA, 1.0), (LAMA.with_effect("motor_lag", upper=0.1, lower=0.1), 0.0)):
        u = dynamics.kernel_input(command * [1.1, 1.1, 1, 1])
        dynamics.measure(x, u, vehicle.vector, work, out)
        rpm = dict(zip(CHANNELS, out, strict=True))["rpm_upper"]
        assert rpm == pytest.approx(1994.16 * (1 + 0.1 * share), rel=2e-4)


def test_gusts_push_and_fade():
    start = np.zeros(N_FULL)
    start[20:26] = [0.1, -0.2, 0.3, 1e-3, 2e-3, -3e-3]
    x = fly(start, np.zeros(4), 0.3, 0.01, LAMA)
    close(x[20:26], start[20:26] * math.exp(-0.3 / 0.5), 1e-12)
    rate = dynamics.full_derivative(start, dynamics.kernel_input(np.zeros(4)), LAMA)
    close(rate[0:3], np.array([0.1, -0.2, 0.3]) / 0.8 + [0, 0, 9.804])
    inertia = np.array([LAMA[f"inertia_{a}"].value for a in ("xx", "yy", "zz")])
    close(rate[3:6] * inertia, start[23:26])


@pytest.mark.parametrize("axis", range(6))
def test_each_gust_fades_by_its_own_memory_and_pushes_meanwhile(axis):
    """Rotors at rest: of g exp(-t/T) / m the speed is g T (1 - exp(-t/T)) / m, axis by axis."""
    memories = np.array([0.2, 0.2, 0.5, 0.9, 0.9, 1.7])
    p = LAMA.vector.copy()
    p[P.GUST_MEMORIES] = memories[[0, 2, 3, 5]]
    v = LAMA.values()
    inertia = [v["mass"]] * 3 + [v[f"inertia_{a}"] for a in ("xx", "yy", "zz")]
    gust = np.array([0.3, 0.3, 0.3, 1e-3, 1e-3, 1e-3])[axis]
    x, still, work = np.zeros(N_FULL), np.zeros(N_FULL), np.zeros(dynamics.WORK_SIZE)
    x[20 + axis] = gust
    u = dynamics.kernel_input(np.zeros(4))
    out = np.zeros(N_FULL + N_CHANNELS)
    dynamics.drift_and_readings(x, u, 0.02, p, work, out)
    assert out[20 + axis] == pytest.approx(gust * math.expm1(-0.02 / memories[axis]), rel=1e-9)
    for _ in range(20):
        dynamics.step(x, u, 0.02, p, work, x)
        dynamics.step(still, u, 0.02, p, work, still)
    left = math.exp(-0.4 / memories[axis])
    assert x[20 + axis] == pytest.approx(gust * left)
    pushed = gust * memories[axis] * (1.0 - left) / inertia[axis]
    assert x[axis] - still[axis] == pytest.approx(pushed, rel=1e-5)


# --- the catalogue ------------------------------------------------------------------------------


def all_stages_on(vehicle):
    vector = vehicle.vector.copy()
    vector[P.N_FIXED : P.N_FIXED + len(effects.STAGES)] = 1.0
    return vector


@pytest.mark.parametrize("seed", SEEDS)
def test_effects_at_their_off_value_change_no_bit(seed):
    """Even where their stage runs: rates and readings are those of the bare model."""
    state, command = random_state(seed)
    x, u = dynamics.full_state(state, command, LAMA), dynamics.kernel_input(command, 3.0)
    work = np.zeros(dynamics.WORK_SIZE)
    results = []
    for vector in (LAMA.vector, all_stages_on(LAMA)):
        rates, out, flown = np.zeros(N_FULL), np.empty(N_CHANNELS), np.empty(N_FULL)
        dynamics._derivative(x, u, vector, work, rates)
        dynamics.measure(x, u, vector, work, out)
        dynamics.step(x, u, 0.01, vector, work, flown)
        results.append(np.concatenate([rates, out, flown]))
    np.testing.assert_array_equal(*results)


@pytest.mark.parametrize("name", list(effects.CATALOGUE))
def test_off_leaves_the_stage_switched_off(name):
    off = {p.name: p.off for p in effects.CATALOGUE[name].parameters}
    np.testing.assert_array_equal(LAMA.with_effect(name, **off).vector, LAMA.vector)


def _thrusts(s, factor):
    s.thrust = s.thrust * factor


def _drag(s, e):
    area = np.array([e["area_x"], e["area_y"], e["area_z"]])
    s.force += -0.5 * 1.14 * area * np.linalg.norm(s.air) * s.air


def _swash_phase(s, e):
    angle = e["angle"] + e["per_rpm"] * 30.0 / math.pi * (s.u[1] - _hover(s.v)[1])
    s.swash = Rotation.from_euler("z", angle).as_matrix()[:2, :2] @ s.swash


def _wake(s, e):
    s.thrust = s.thrust * [1, 1 - e["gain"] * s.thrust[0] / s.thrust.sum()]


def _hover(v):
    """Speeds at which the bare rotors balance."""
    k = v["air_density"] * math.pi * v["rotor_radius"] ** 4
    ratio2 = v["torque_coefficient_upper"] / v["torque_coefficient_lower"]
    lift = v["thrust_coefficient_upper"] + v["thrust_coefficient_lower"] * ratio2
    return np.sqrt(v["mass"] * v["gravity"] / (k * lift) * np.array([1, ratio2]))


def _exponent(s, e):
    """T = k w_h^2 (w/w_h)^(2+e) with w_h the hover speeds."""
    s.thrust = s.thrust * (s.u[:2] / _hover(s.v)) ** e["excess"]


def _hub(s, e):
    tilt = e["upper"] * s.tilt_upper + e["lower"] * s.x[6:8]
    s.moment += [tilt[1], tilt[0], 0]


def _blowback(s, e):
    s.flap_rate += e["gain"] / s.v["flap_time_constant"] * s.air[:2] * [1, -1]


def _cg(s, e):
    """The hubs seen from a centre of gravity beside the mast."""
    s.hubs = np.array([-e["x"], -e["y"], 0.0])


def _tether(s, e):
    s.force += s.R.T @ [*(e["stiffness"] * ([e["north"], e["east"]] - s.x[13:15])), 0.0]


def _euler(s, e):
    s.moment -= e["gain"] * np.cross(s.omega, np.multiply(s.inertia, s.omega))


ON_RATES = {
    "added_mass": (dict(mass=0.06), lambda s, e: setattr(s, "mass", s.mass + e["mass"])),
    "thrust_scale": (dict(scale=-0.05), lambda s, e: _thrusts(s, 0.95)),
    "torque_balance": (
        dict(scale=0.07),
        lambda s, e: setattr(s, "torque", s.torque * [1, 1.07]),
    ),
    "yaw_inertia": (
        dict(scale=0.2),
        lambda s, e: setattr(s, "inertia", np.multiply(s.inertia, [1, 1, 1.2])),
    ),
    "swash_gain": (dict(scale=-0.1), lambda s, e: setattr(s, "gain", s.gain * 0.9)),
    "flybar_time_constant": (
        dict(scale=0.3),
        lambda s, e: setattr(s, "flybar_time", s.flybar_time * 1.3),
    ),
    "swash_phase": (dict(angle=0.15, per_rpm=3e-4), _swash_phase),
    "swash_offset": (
        dict(lon=0.02, lat=-0.01),
        lambda s, e: setattr(s, "swash", s.swash + [e["lon"], e["lat"]]),
    ),
    "ground_effect": (
        dict(gain=0.5, decay=2.1),
        lambda s, e: _thrusts(s, 1 + 0.5 * math.exp(2.1 * s.x[15] / 0.25)),
    ),
    "axial_damping": (dict(coefficient=0.08), lambda s, e: _thrusts(s, 1 + 0.08 * s.x[2])),
    "wake_interference": (dict(gain=0.25), _wake),
    "thrust_exponent": (dict(excess=0.2), _exponent),
    "airframe_drag": (dict(area_x=0.02, area_y=0.03, area_z=0.01), _drag),
    "rotor_drag": (
        dict(coefficient=4e-4),
        lambda s, e: setattr(s, "force", -4e-4 * s.u[:2].sum() * s.air * [1, 1, 0]),
    ),
    "flap_blowback": (dict(gain=0.008), _blowback),
    "yaw_damping": (
        dict(coefficient=0.004),
        lambda s, e: setattr(s, "moment", -0.004 * s.omega * [0, 0, 1]),
    ),
    "rate_damping": (
        dict(coefficient=0.004),
        lambda s, e: setattr(s, "moment", -0.004 * s.omega * [1, 1, 0]),
    ),
    "upper_blowback": (
        dict(gain=0.009),
        lambda s, e: setattr(s, "tilt_upper", s.tilt_upper + 0.009 * s.air[:2] * [1, -1]),
    ),
    "gyroscopic_coupling": (dict(gain=0.9), _euler),
    "position_spring": (dict(stiffness=0.3, north=1.5, east=-2.0), _tether),
    "cg_offset": (dict(x=0.0015, y=-0.001), _cg),
    "hub_stiffness": (dict(upper=0.2, lower=0.3), _hub),
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", list(ON_RATES))
def test_effect_on_the_rates(name, seed):
    """One independent formula per effect, at a random state."""
    values, change = ON_RATES[name]
    state, command = random_state(seed)
    second = Second(state, command, COUPLED)
    change(second, values)
    found = derivative(state, command, COUPLED.with_effect(name, **values))
    close(found, second.rates())
    assert np.abs(found - derivative(state, command, COUPLED)).max() > 1e-4


@pytest.mark.parametrize("rotor", ["upper", "lower"])
def test_a_rotor_that_droops_alone_follows_a_share_of_its_command(rotor):
    """About the bare model's hover, the other one as commanded."""
    state, command = random_state(3)
    free = COUPLED.with_values({"fuselage_drag_coefficient": 0.0})
    i = ("upper", "lower").index(rotor)
    hover = hover_trim(free)[1][i]
    followed = command.copy()
    followed[i] = hover + 0.8 * (command[i] - hover)
    vehicle = COUPLED.with_effect("motor_droop", upper=0.2 * (i == 0), lower=0.2 * (i == 1))
    found = derivative(state, command, vehicle)
    close(found, Second(state, followed, COUPLED).rates(), 1e-7)
    assert np.abs(found - derivative(state, command, COUPLED)).max() > 1e-2


ALONE = [
    (name, key)
    for name in ("swash_phase", "swash_offset", "airframe_drag", "cg_offset", "hub_stiffness")
    for key in ON_RATES[name][0]
]
"""Numbers of an effect that act each by itself."""


@pytest.mark.parametrize(("name", "key"), ALONE)
def test_each_number_of_an_effect_acts_alone(name, key):
    """The same formula, with all but one of its numbers at nothing."""
    values, change = ON_RATES[name]
    values = {k: v if k == key else 0.0 for k, v in values.items()}
    state, command = random_state(2)
    second = Second(state, command, COUPLED)
    change(second, values)
    found = derivative(state, command, COUPLED.with_effect(name, **values))
    close(found, second.rates())
    assert np.abs(found - derivative(state, command, COUPLED)).max() > 1e-6


@pytest.mark.parametrize("seed", SEEDS)
def test_the_bodys_own_gyroscopic_moment_does_no_work(seed):
    """omega . (omega x I omega) = 0, and a body alone keeps its momentum in the world's axes."""
    state, command = random_state(seed)
    inertia = np.array([LAMA[f"inertia_{a}"].value for a in ("xx", "yy", "zz")])
    whole = LAMA.with_effect("gyroscopic_coupling", gain=1.0)
    moment = inertia * (derivative(state, command, whole) - derivative(state, command, LAMA))[3:6]
    assert np.linalg.norm(moment) > 1e-3
    assert abs(state[3:6] @ moment) < 1e-12 * np.linalg.norm(moment)
    state[6:10] = 0.0
    alone = whole.with_values({"mass": 1.0})
    still = derivative(state, np.zeros(4), alone)  # rotors stand: no moment is left
    spin = inertia * state[3:6]
    close(inertia * still[3:6] + np.cross(state[3:6], spin), np.zeros(3), 1e-12)


@pytest.mark.parametrize(
    "carrier", ["airframe_drag", "rotor_drag", "flap_blowback", "upper_blowback"]
)
@pytest.mark.parametrize("seed", SEEDS)
def test_wind_acts_through_the_velocity_in_the_air(carrier, seed):
    state, command = random_state(seed)
    wind = np.array([1.5, -2.0, 0.0])
    values, change = ON_RATES[carrier]
    second = Second(state, command, COUPLED)
    second.air = state[:3] - second.R.T @ wind
    change(second, values)
    vehicle = COUPLED.with_effect(carrier, **values).with_effect("wind", north=1.5, east=-2.0)
    close(derivative(state, command, vehicle), second.rates())


def test_wind_alone_does_nothing():
    state, command = random_state(1)
    windy = LAMA.with_effect("wind", north=2.0, east=1.0)
    np.testing.assert_array_equal(
        derivative(state, command, windy), derivative(state, command, LAMA)
    )


def test_battery_sag_slows_the_rotors_with_time():
    sagging = LAMA.with_effect("battery_sag", rate=0.002)
    x, work = np.zeros(N_FULL), np.zeros(dynamics.WORK_SIZE)
    u = dynamics.kernel_input(np.array([200.0, 210.0, 0, 0]), time=50.0)
    dynamics.step(x, u, 0.01, sagging.vector, work, x)
    close(x[16:18], 0.9 * u[:2])


def test_spin_up_reaction_keeps_the_angular_momentum():
    """N = g ((J_u + J_f) w_u' - J_l w_l'): at gain 1 the body takes what the rotors gain."""
    vehicle = COUPLED.with_values(
        {"torque_coefficient_upper": 0.0, "torque_coefficient_lower": 0.0}
    ).with_effect("motor_lag", upper=0.1, lower=0.06)
    vehicle = vehicle.with_effect("spin_up_reaction", gain=1.0)
    start = np.zeros(N_FULL)
    start[16:18] = 200.0, 220.0
    command = np.array([230.0, 215.0, 0.0, 0.0])
    end = fly(start, command, 0.3, 0.01, vehicle)
    v = COUPLED.values()
    upper = v["rotor_inertia_upper"] + v["flybar_inertia"]

    def momentum(x):
        return v["inertia_zz"] * x[5] - upper * x[16] + v["rotor_inertia_lower"] * x[17]

    assert abs(end[5]) > 1.0
    assert momentum(end) == pytest.approx(momentum(start), rel=1e-9)


@pytest.mark.parametrize("lag", [0.0, 1e-4, 0.004, 0.03, 0.5])
@pytest.mark.parametrize("row", [0.01, 1.0 / 60.0, 0.1])
def test_the_heading_is_the_integral_of_the_rate_that_a_spin_up_makes(lag, row):
    """J / I of what the rotor gains, (1 - exp(-t / lag)) of its jump: its integral over a row is in the
    heading at the row's end, all of it, also where a rotor jumps as the row begins."""
    free = {"torque_coefficient_upper": 0.0, "torque_coefficient_lower": 0.0}
    vehicle = COUPLED.with_values(free).with_effect("motor_lag", upper=lag, lower=lag)
    vehicle = vehicle.with_effect("spin_up_reaction", gain=1.0)
    start, command = np.zeros(N_FULL), np.array([230.0, 220.0, 0.0, 0.0])
    start[16:18] = 200.0, 220.0
    end, work = np.zeros(N_FULL), np.zeros(dynamics.WORK_SIZE)
    dynamics.step(start, dynamics.kernel_input(command), row, vehicle.vector, work, end)
    v = COUPLED.values()
    gained = 30.0 * (v["rotor_inertia_upper"] + v["flybar_inertia"]) / v["inertia_zz"]
    left = math.exp(-row / lag) if lag else 0.0
    assert end[5] == pytest.approx(gained * (1.0 - left), rel=1e-6)
    assert end[12] == pytest.approx(gained * (row - lag * (1.0 - left)), rel=2e-3)


def test_a_reading_sees_the_rotors_speed_up_each_with_its_own_lag():
    """Off the axis, the accelerometer reads the yaw that N = g ((J_u + J_f) w_u' - J_l w_l') makes."""
    arm, lags = 0.2, np.array([0.06, 0.11])
    vehicle = COUPLED.with_effect("motor_lag", upper=lags[0], lower=lags[1])
    vehicle = vehicle.with_effect("imu_lever_arm", x=arm, y=0.0, z=0.0)
    x, command = dynamics.full_state(*hover_trim(COUPLED), COUPLED), hover_trim(COUPLED)[1]
    x[16:18] += -20.0, 15.0
    ay = []
    for gain in (0.0, 1.0):
        out, work = np.zeros(len(CHANNELS)), np.zeros(dynamics.WORK_SIZE)
        values = vehicle.with_effect("spin_up_reaction", gain=gain).vector
        dynamics.measure(x, dynamics.kernel_input(command), values, work, out)
        ay.append(out[list(CHANNELS).index("ay")])
    v = COUPLED.values()
    speeding = (command[:2] - x[16:18]) / lags
    moment = (v["rotor_inertia_upper"] + v["flybar_inertia"]) * speeding[0]
    moment -= v["rotor_inertia_lower"] * speeding[1]
    assert ay[1] - ay[0] == pytest.approx(arm * moment / v["inertia_zz"], rel=0.02)


def test_servo_delay_is_a_shift_of_the_input_not_of_the_kernel():
    state, command = random_state(0)
    late = LAMA.with_effect("servo_delay", time=0.05)
    np.testing.assert_array_equal(
        derivative(state, command, late), derivative(state, command, LAMA)
    )
    assert effects.CATALOGUE["servo_delay"].input_shift


LEVEL = dict(zip(NAMES, np.zeros(16), strict=True)) | {"z": -1.0}
SIGNS = [
    # effect, values, state, rate that changes, its sign
    ("airframe_drag", dict(area_x=0.02, area_y=0.02, area_z=0.02), dict(u=2.0), "u", -1),
    ("airframe_drag", dict(area_x=0.02, area_y=0.02, area_z=0.02), dict(v=-2.0), "v", 1),
    ("airframe_drag", dict(area_x=0.02, area_y=0.02, area_z=0.02), dict(w=2.0), "w", -1),
    ("rotor_drag", dict(coefficient=4e-4), dict(u=-2.0), "u", 1),
    ("rotor_drag", dict(coefficient=4e-4), dict(v=2.0), "v", -1),
    ("ground_effect", dict(gain=0.5), dict(z=-0.2), "w", -1),  # lifts
    ("axial_damping", dict(coefficient=0.1), dict(w=1.0), "w", -1),  # a descent gains thrust
    ("axial_damping", dict(coefficient=0.1), dict(w=-1.0), "w", 1),
    ("wake_interference", dict(gain=0.2), {}, "w", 1),  # sinks
    ("added_mass", dict(mass=0.1), {}, "w", 1),
    ("yaw_damping", dict(coefficient=4e-3), dict(r=1.0), "r", -1),
    ("rate_damping", dict(coefficient=4e-3), dict(p=1.0), "p", -1),
    ("rate_damping", dict(coefficient=4e-3), dict(q=-1.0), "q", 1),
    ("torque_balance", dict(scale=0.1), {}, "r", -1),
    ("cg_offset", dict(x=2e-3), {}, "q", -1),  # nose heavy
    ("cg_offset", dict(y=2e-3), {}, "p", 1),  # right side heavy
    ("hub_stiffness", dict(lower=0.2), dict(alpha_l=0.05), "q", 1),
    ("flap_blowback", dict(gain=7e-3), dict(u=2.0), "alpha_l", 1),  # tilts back: slows
    ("flap_blowback", dict(gain=7e-3), dict(v=2.0), "beta_l", -1),  # tilts left: slows
    ("upper_blowback", dict(gain=7e-3), dict(u=2.0), "u", -1),
    ("upper_blowback", dict(gain=7e-3), dict(v=2.0), "v", -1),
    ("upper_blowback", dict(gain=7e-3), dict(u=2.0), "q", 1),  # nose up
    ("position_spring", dict(stiffness=0.1, north=2.0), {}, "u", 1),
    ("position_spring", dict(stiffness=0.1, east=-2.0), {}, "v", -1),
    ("cg_offset", dict(y=2e-3), dict(alpha_l=-0.2), "r", 1),  # forward force, left of the CG
    ("swash_offset", dict(lon=0.02), {}, "alpha_l", 1),
    ("swash_offset", dict(lat=0.02), {}, "beta_l", 1),
]


@pytest.mark.parametrize(("name", "values", "where", "rate", "sign"), SIGNS)
def test_effect_pushes_the_right_way(name, values, where, rate, sign):
    state = np.array(list((LEVEL | where).values()))
    _, command = hover_trim(LAMA)
    i = NAMES.index(rate)
    change = derivative(state, command, LAMA.with_effect(name, **values)) - derivative(
        state, command, LAMA
    )
    assert sign * change[i] > 1e-3


def test_cheeseman_and_bennett_at_one_radius():
    """effects.md: z/R = 1 gives 7-9 %; gain 0.5 and decay 2 are of that size."""
    state, command = np.array(list((LEVEL | {"z": -0.25}).values())), hover_trim(LAMA)[1]
    plain = dynamics.readings(state, command, LAMA.with_values({"fuselage_drag_coefficient": 0.0}))
    near = dynamics.readings(
        state,
        command,
        LAMA.with_values({"fuselage_drag_coefficient": 0.0}).with_effect("ground_effect", gain=0.5),
    )
    assert 0.06 < near["az"] / plain["az"] - 1 < 0.09


# --- sensors ------------------------------------------------------------------------------------

ACCEL, GYRO, ANGLE = ("ax", "ay", "az"), ("p", "q", "r"), ("phi", "theta", "psi")


def vector(readings, channels):
    return np.array([readings[c] for c in channels])


def sensor_case(name, values, seed):
    state, command = random_state(seed)
    bare = dynamics.readings(state, command, LAMA)
    biased = dynamics.readings(state, command, LAMA.with_effect(name, **values))
    return state, command, bare, biased


@pytest.mark.parametrize("seed", SEEDS)
def test_sensor_biases_and_scales(seed):
    for name, channels in (("gyro_bias", GYRO), ("accel_bias", ACCEL), ("attitude_bias", ANGLE)):
        _, _, bare, biased = sensor_case(name, dict(x=0.1, y=-0.2, z=0.3), seed)
        close(vector(biased, channels), vector(bare, channels) + [0.1, -0.2, 0.3])
        assert {c for c in CHANNELS if bare[c] != biased[c]} == set(channels)
    _, _, bare, biased = sensor_case("accel_scale", dict(x=0.01, y=-0.02, z=0.03), seed)
    close(vector(biased, ACCEL), vector(bare, ACCEL) * [1.01, 0.98, 1.03])


@pytest.mark.parametrize("seed", SEEDS)
def test_imu_lever_arm(seed):
    arm = np.array([0.03, -0.02, 0.04])
    state, command, bare, biased = sensor_case("imu_lever_arm", dict(x=0.03, y=-0.02, z=0.04), seed)
    omega, alpha = state[3:6], derivative(state, command, LAMA)[3:6]
    extra = np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
    close(vector(biased, ACCEL), vector(bare, ACCEL) + extra)


def test_imu_lever_arm_is_the_acceleration_of_its_own_place():
    """Differencing the sensor's track through the world, at a random attitude and rate."""
    arm = np.array([0.03, -0.02, 0.04])
    start, command = settled_state(0)
    h, x, track, states = 1e-3, start.copy(), [], []
    work = np.zeros(dynamics.WORK_SIZE)
    for _ in range(3):
        states.append(x.copy())
        track.append(x[13:16] + body_to_world(x[:16]) @ arm)
        dynamics.step(x, dynamics.kernel_input(command), h, LAMA.vector, work, x)
    acceleration = (track[0] - 2 * track[1] + track[2]) / h**2
    felt = body_to_world(states[1][:16]).T @ (acceleration - [0, 0, 9.804])
    vehicle = LAMA.with_effect("imu_lever_arm", x=0.03, y=-0.02, z=0.04)
    np.testing.assert_allclose(
        vector(dynamics.readings(states[1], command, vehicle), ACCEL), felt, atol=2e-3
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_imu_tilt_turns_all_six_axes(seed):
    """The readings are those of axes turned by the rotation vector, not to first order alone."""
    tilt = np.array([0.05, -0.03, 0.0])
    _, _, bare, biased = sensor_case("imu_tilt", dict(x=0.05, y=-0.03), seed)
    turned = Rotation.from_rotvec(tilt).as_matrix().T
    for channels in (ACCEL, GYRO):
        want = turned @ vector(bare, channels)
        np.testing.assert_allclose(vector(biased, channels), want, atol=1e-6 * np.linalg.norm(want))


@pytest.mark.parametrize("seed", SEEDS)
def test_sonar_effects(seed):
    state, _, bare, biased = sensor_case("sonar_tilt", dict(on=1.0), seed)
    down = body_to_world(state)[2, 2]  # cosine between body z and the vertical
    assert biased["h"] == pytest.approx(bare["h"] / down)
    _, _, bare, biased = sensor_case("sonar_scale", dict(scale=0.04), seed)
    assert biased["h"] == pytest.approx(1.04 * bare["h"])


@pytest.mark.parametrize("seed", SEEDS)
def test_gyro_scale(seed):
    _, _, bare, biased = sensor_case("gyro_scale", dict(x=0.1, y=-0.05, z=0.2), seed)
    close(vector(biased, GYRO), vector(bare, GYRO) * [1.1, 0.95, 1.2])
    assert {c for c in CHANNELS if bare[c] != biased[c]} == set(GYRO)


POSE = ("pn", "pe", "h", "phi", "theta", "psi")
LATE = {"pose_delay": POSE, "attitude_delay": ANGLE, "sonar_delay": ("h",)}


@pytest.mark.parametrize("name", list(LATE))
@pytest.mark.parametrize("seed", SEEDS)
def test_a_late_reading_is_that_of_a_moment_ago(name, seed):
    """To second order: half the delay leaves an eighth of the error."""
    late = LATE[name]
    start, command = settled_state(seed)
    start[12] += 6.0  # a heading that has gone round
    end = fly(start, command, 0.04, 0.001, LAMA)
    bare = dynamics.readings(end, command, LAMA)
    errors = []
    for delay in (0.004, 0.002):  # the height alone has a fourth order to be seen at 0.02
        then = dynamics.readings(fly(start, command, 0.04 - delay, 0.001, LAMA), command, LAMA)
        found = dynamics.readings(end, command, LAMA.with_effect(name, time=delay))
        assert {c for c in CHANNELS if bare[c] != found[c]} == set(late)
        errors.append(np.linalg.norm(vector(found, late) - vector(then, late)))
        assert errors[-1] < 0.1 * np.linalg.norm(vector(bare, late) - vector(then, late))
    assert errors[0] / errors[1] == pytest.approx(8.0, rel=0.15)


@pytest.mark.parametrize("seed", SEEDS)
def test_marker_offset(seed):
    """Place and velocity of a point of the body, by rotation matrix."""
    arm = np.array([0.03, -0.02, 0.05])
    values = dict(x=0.03, y=-0.02, z=0.05)
    state, _, bare, biased = sensor_case("marker_offset", values, seed)
    R, omega = body_to_world(state), state[3:6]
    place = vector(bare, ("pn", "pe", "h")) + (R @ arm) * [1, 1, -1]
    close(vector(biased, ("pn", "pe", "h")), place)
    velocity = ("vn", "ve", "vd")
    close(vector(biased, velocity), vector(bare, velocity) + R @ np.cross(omega, arm))
    assert {c for c in CHANNELS if bare[c] != biased[c]} == {"pn", "pe", "h", *velocity}


@pytest.mark.parametrize("axis", range(3))
def test_a_marker_beside_the_centre_along_one_axis_alone(axis):
    arm = 0.04 * np.eye(3)[axis]
    values = dict(zip("xyz", arm.tolist(), strict=True))
    state, _, bare, biased = sensor_case("marker_offset", values, 1)
    place = vector(bare, ("pn", "pe", "h")) + (body_to_world(state) @ arm) * [1, 1, -1]
    close(vector(biased, ("pn", "pe", "h")), place)


@pytest.mark.parametrize("angle", [0.3, -1.2])
@pytest.mark.parametrize("seed", SEEDS)
def test_frame_yaw_is_a_rotation_about_the_mast(seed, angle):
    state, _, bare, biased = sensor_case("frame_yaw", dict(angle=angle), seed)
    seen = Rotation.from_euler("ZYX", vector(biased, ("psi", "theta", "phi"))).as_matrix()
    close(seen, body_to_world(state) @ Rotation.from_euler("z", angle).as_matrix())
    assert {c for c in CHANNELS if bare[c] != biased[c]} == set(ANGLE)


def test_headings_that_have_gone_round_stay_there():
    state, command = random_state(0)
    for name, values in (("frame_yaw", dict(angle=0.3)), ("magnetic_field", dict(x=0.2, y=0.3))):
        vehicle = LAMA.with_effect(name, **values)
        state[12] = 0.5
        once = dynamics.readings(state, command, vehicle)["psi"]
        state[12] += 6.0 * math.pi
        assert dynamics.readings(state, command, vehicle)["psi"] - once == pytest.approx(
            6 * math.pi
        )


@pytest.mark.parametrize("seed", SEEDS)
def test_a_field_of_the_body_turns_the_compass(seed):
    """The heading of earth's horizontal field and the body's own, in level axes."""
    values = dict(x=0.2, y=-0.3)
    state, _, bare, biased = sensor_case("magnetic_field", values, seed)
    north = Rotation.from_euler("z", state[12]).as_matrix().T @ [1, 0, 0] + [0.2, -0.3, 0]
    error = math.remainder(biased["psi"] + math.atan2(north[1], north[0]), 2 * math.pi)
    assert abs(error) < 1e-12
    assert {c for c in CHANNELS if bare[c] != biased[c]} == {"psi"}


# --- every effect is tested here ----------------------------------------------------------------

TESTED_APART = {
    "wind", "motor_lag", "servo_lag", "servo_delay", "battery_sag", "spin_up_reaction",
    # in test_actuator_effects.py
    "command_delay", "motor_droop", "battery_voltage", "dynamic_inflow", "servo_play",
    "servo_deadband", "servo_rate",
    "imu_lever_arm", "imu_tilt", "accel_scale", "accel_bias", "gyro_bias", "attitude_bias",
    "sonar_tilt", "sonar_scale", "sonar_delay", "vibration", "gyro_scale", "pose_delay",
    "attitude_delay", "marker_offset", "frame_yaw", "magnetic_field",
}  # fmt: skip


def test_no_effect_without_a_test():
    missing = set(effects.CATALOGUE) - TESTED_APART - set(ON_RATES)
    assert not missing, f"add a formula for {sorted(missing)}"


@pytest.mark.parametrize("name", list(effects.CATALOGUE))
def test_entries_are_complete(name):
    entry = effects.CATALOGUE[name]
    assert entry.summary and entry.source and set(entry.channels) <= set(CHANNELS)
    for parameter in entry.parameters:
        assert parameter.usual > 0.0 and parameter.unit
        assert parameter.lower <= parameter.off <= parameter.upper
        assert parameter.smallest < parameter.usual


# --- the cache of compiled code -----------------------------------------------------------------


def test_no_two_compiled_functions_share_a_name():
    """Else one's machine code runs as the other's, where a process loads what two have compiled."""
    plain = HeliModel(load_vehicle("lama400d"))
    nested = ErringModel(SwingingModel(JitteryModel.like(plain)))
    assert ErringModel(plain).step and SwingingModel(plain).step and nested.step
    names = {}
    gc.collect()
    for thing in gc.get_objects():
        # its type, not isinstance: that asks a weak reference, whose object may be gone
        if not issubclass(type(thing), Dispatcher):
            continue
        module = thing.py_func.__module__ or ""  # None: no module of ours
        if module.startswith("coax_env"):
            name = (module, thing.py_func.__qualname__)
            assert names.setdefault(name, thing) is thing, name
    assert len(names) > 50


LAZY_PROGRAM = """
import sys
import numpy as np
import coax_env
from coax_env.model import dynamics
from coax_env.kernel import lazy

compiled = []
make = lazy.pointer
lazy.pointer = lambda kind: lambda f: (compiled.append(f.__name__), make(kind)(f))[1]
x, work = np.zeros(29), np.zeros(dynamics.WORK_SIZE)
bare = coax_env.load_vehicle("lama400d")

def fly(vehicle):
    dynamics.step(x, dynamics.kernel_input(np.full(4, 200.0)), 0.01, vehicle.vector, work, x)

fly(bare)
print(*compiled, end=";")
def interrupt(kind):
    raise KeyboardInterrupt
counting, lazy.pointer = lazy.pointer, interrupt
loaded = bare.with_effect("added_mass", mass=0.1)
try:
    fly(loaded)
except KeyboardInterrupt:
    print("interrupted", end=";")
lazy.pointer = counting
for _ in range(2):
    fly(loaded)
print(*compiled)
"""


@pytest.mark.slow
def test_effects_are_compiled_when_first_flown():
    """None for a bare vehicle; an interrupt reaches the caller, and the next call compiles."""
    done = subprocess.run(
        [sys.executable, "-c", LAZY_PROGRAM], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == ";interrupted;_step _property_effects"


@pytest.mark.slow
def test_an_edited_callee_is_compiled_anew(tmp_path):
    """numba alone would still run the old machine code (numerics.md, traps)."""
    package = Path(compilation.__file__).parents[1]
    shutil.copytree(package, tmp_path / "coax_env", ignore=shutil.ignore_patterns("__pycache__"))
    program = (
        "import numpy as np, coax_env, coax_env.kernel.compilation as j;"
        "v = coax_env.load_vehicle('lama400d').with_effect('yaw_damping', coefficient=0.0025);"
        "x = np.zeros(16); x[5] = 1.0;"
        "print(j.source_hash(), coax_env.derivative(x, np.zeros(4), v)[5])"
    )
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "COAX_CACHE_DIR": str(tmp_path / "c")}

    # the copy is the package to the last byte, and may have what that has compiled
    derivative(np.zeros(16), np.zeros(4), LAMA.with_effect("yaw_damping", coefficient=0.0025))
    digest = compilation.source_hash()
    compiled = compilation.CACHE_DIR.parent / digest
    for file in (*compiled.rglob("*.nbi"), *compiled.rglob("*.nbc")):
        if file.parent.name in ("coax_env_kernel", "coax_env_model"):
            copy = tmp_path / "c" / digest / file.relative_to(compiled)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(file, copy)

    def run():
        done = subprocess.run(
            [sys.executable, "-c", program],
            env=environment, cwd=tmp_path, capture_output=True, text=True, check=True,
        )  # fmt: skip
        digest, value = done.stdout.split()
        return digest, float(value)

    first = run()
    assert first == (digest, pytest.approx(-1.0))
    assert run() == first
    callee = tmp_path / "coax_env" / "model" / "effects.py"
    text = callee.read_text()
    line = "f[F.MOMENT_Z] -= p[e] * x[S.R]"
    assert line in text
    callee.write_text(text.replace(line, "f[F.MOMENT_Z] -= 3.0 * p[e] * x[S.R]"))
    second = run()
    assert second[0] != first[0]
    assert second[1] == pytest.approx(-3.0)


@pytest.mark.slow
def test_no_index_leaves_its_array(tmp_path):
    """Compiled code does not look; with numba's bounds checks it does.

    Nor does numba notice an array that is returned by what only borrows its arrays (BORROWING).
    """
    program = (
        "import gc, numpy as np, coax_env; from coax_env.model import dynamics as d;"
        "from numba.core.dispatcher import Dispatcher;"
        "u, lama = d.kernel_input(np.full(4, 200.0)), coax_env.load_vehicle('lama400d')\n"
        "for lag in (0.0, 0.1):\n"  # in one process: checked code takes long to compile
        " v = lama.with_effect('motor_lag', upper=lag, lower=lag)\n"
        " x, work, readings = np.ones(29), np.zeros(d.WORK_SIZE), np.zeros(18)\n"
        " d.step(x, u, 0.03, v.vector, work, x); d.measure(x, u, v.vector, work, readings)\n"
        " print(np.isfinite(x).all() and np.isfinite(readings).all())\n"
        "own = [f for f in gc.get_objects() if isinstance(f, Dispatcher) and f.overloads"
        " and not f.targetoptions.get('_nrt', True)];"
        "of = [str(o.signature.return_type) for f in own for o in f.overloads.values()];"
        "print(len(of) > 8, [r for r in of if 'rray' in r])"
    )
    checked = os.environ | {"NUMBA_BOUNDSCHECK": "1", "COAX_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", program], env=checked, capture_output=True, text=True
    )
    assert done.stdout.split() == ["True", "True", "True", "[]"], done.stderr


def test_paper_states_are_the_first_sixteen():
    assert N_STATES == 16 and NAMES[:3] == ["u", "v", "w"] and NAMES[-1] == "z"


def test_places_have_the_names_of_the_layout():
    for places, names in (
        (S, [name for name, _ in FULL_STATES]),
        (U, [name for name, _ in COMMANDS] + ["time", "battery"]),
        (Z, CHANNELS),
    ):
        assert [getattr(places, name.upper()) for name in names] == list(range(len(names)))
