"""The simulator by blade elements is what it says; and what a search finds of it, which nobody hid."""

import math
from dataclasses import replace

import blade_element
import numpy as np
import pytest
from blade_element import LIFT_SLOPE, ON_LOWER, ON_UPPER, SOLIDITY
from injector_craft import COAX, LAMA, draw, rotors_of

from coax_env import diagnose, load_vehicle, read_flight
from coax_env.diagnosis.fits import fitted, noise_fitted, start
from coax_env.diagnosis.problem import Problem
from coax_env.diagnosis.search import search
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise

NEAR = (
    "motor_lag", "spin_up_reaction", "command_delay", "servo_lag", "yaw_damping", "yaw_inertia",
    "flap_blowback", "hub_stiffness",
)  # fmt: skip
"""Candidates of the test by poses alone: what acts there, and what looks like it."""
CRAFTS = {"lama": LAMA, "coax": COAX, "drawn": draw(np.random.default_rng(4))}


def hovering(craft):
    """State and command of a hover far from the ground."""
    rotors = rotors_of(craft)
    s = np.zeros(blade_element.N_STATE)
    s[2], s[6] = -100.0, 1.0
    s[17:19] = rotors.hover_upper, rotors.hover_lower
    thrust = np.array([rotors.thrust_upper, rotors.thrust_lower]) * s[17:19] ** 2
    s[19:21] = blade_element.induced(thrust, craft)
    return s, np.array([*s[17:19], 0.0, 0.0])


def derivative(craft, s, command, wind=(0.0, 0.0, 0.0)):
    out = np.zeros(6)
    ds = blade_element._derivative(
        s, command, np.array(wind), np.zeros(4), craft, blade_element.machine_of(craft),
        rotors_of(craft), out,
    )  # fmt: skip
    return ds, out


@pytest.mark.parametrize("craft", CRAFTS.values(), ids=CRAFTS)
def test_a_hover_that_the_bench_says_is_one(craft):
    """The file's thrust and torque coefficients hold it; the ground, 100 m below, does 1e-6."""
    ds, specific = derivative(craft, *hovering(craft))
    assert ds == pytest.approx(0.0, abs=1e-3)
    assert specific[:3] == pytest.approx([0.0, 0.0, -craft.gravity], abs=1e-3)


@pytest.mark.parametrize("craft", CRAFTS.values(), ids=CRAFTS)
def test_induced_velocities_are_those_of_momentum_theory(craft):
    """T = 2 rho A v times the air through the disc, of each rotor (Leishman 2006, ch. 2)."""
    s, _ = hovering(craft)
    upper, lower = s[19:21]
    area = 2.0 * craft.density * math.pi * craft.radius**2
    rotors = rotors_of(craft)
    thrust = np.array([rotors.thrust_upper, rotors.thrust_lower]) * s[17:19] ** 2
    through = [upper + ON_UPPER * lower, lower + ON_LOWER * upper]
    assert area * np.array([upper, lower]) * through == pytest.approx(thrust, rel=1e-9)


def test_thrust_rises_faster_than_the_square_of_speed_while_the_inflow_is_held():
    """d ln T / d ln w = 2 + sigma a lambda / (4 C_T)."""
    pitch, inflow, step = 0.17, 0.06, 1e-6
    thrust = blade_element._blades(pitch, 0.01, 0.0, inflow)[0]
    faster = (1.0 + step) ** 2 * blade_element._blades(pitch, 0.01, 0.0, inflow / (1.0 + step))[0]
    exponent = (faster / thrust - 1.0) / step
    assert exponent == pytest.approx(2.0 + 0.25 * SOLIDITY * LIFT_SLOPE * inflow / thrust, rel=1e-4)


@pytest.mark.parametrize(
    ("axis", "state", "sign"),
    [(5, 5, -1.0), (3, 3, -1.0), (4, 4, -1.0), (10, 16, 1.0), (11, 15, 1.0)],
)
def test_rotors_damp_climb_and_drift_and_the_bars_tilt_turns_the_body(axis, state, sign):
    """Of a hover with one state moved."""
    s, command = hovering(LAMA)
    s[state] += 0.1
    ds, _ = derivative(LAMA, s, command)
    assert math.copysign(1.0, ds[axis]) == sign


def test_the_airs_torque_damps_a_turn():
    """Blades of one rotor meet the air slower, of the other faster: Q goes as the square, nearly."""
    s, command = hovering(LAMA)
    s[12] = 0.1
    ds, _ = derivative(LAMA, s, command)
    taken = (LAMA.rotor_upper + LAMA.bar) * ds[17] - LAMA.rotor_lower * ds[18]
    rotors = rotors_of(LAMA)
    damping = 2.0 * (rotors.torque_upper * s[17] + rotors.torque_lower * s[18])
    assert (LAMA.inertia_z * ds[12] - taken) / -0.1 == pytest.approx(damping, rel=0.2)


def test_what_motors_give_the_rotors_they_take_from_the_body():
    """A step of a command, which leaves the air's torques as they are, turns the body the other way."""
    s, command = hovering(LAMA)
    ds, _ = derivative(LAMA, s, command + [2.0, 0.0, 0.0, 0.0])
    upper = LAMA.rotor_upper + LAMA.bar
    assert ds[17] > 0.0 and LAMA.inertia_z * ds[12] == pytest.approx(upper * ds[17], rel=1e-6)


def test_the_rotors_spin_does_no_work_on_the_body():
    s, command = hovering(LAMA)
    still, _ = derivative(LAMA, s, command)
    s[10:12] = 0.7, -0.4
    turning, _ = derivative(LAMA, s, command)
    inertia = np.array([LAMA.inertia_x, LAMA.inertia_y, LAMA.inertia_z])
    torque = inertia * (turning - still)[10:13]
    assert abs(torque[0]) > 1e-3 and s[10:13] @ torque == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_by_poses_alone_late_rotors_are_named_and_no_late_command(tmp_path):
    """Of a CoaX in moving air, from a late command and half the yaw inertia that stood for both."""
    folder = blade_element.fly(
        tmp_path / "f", craft=COAX, sensors="pose", turbulence=0.1, seed=2, longest=9.0,
        runs=("lon_3211", "lat_3211", "heave_3211", "yaw_3211"),
    )  # fmt: skip
    flight = read_flight(folder)
    model = HeliModel(load_vehicle("skybotix_coax"))
    problem = Problem.of(model, [record_of(run) for run in flight.runs], NEAR)
    fit = start(problem, starting_noise(flight, model.vehicle))
    halved = {"command_delay.time": 0.02, "inertia_zz": 0.5 * fit.values["inertia_zz"]}
    fit = fitted(problem, replace(fit.at(halved), active=("command_delay",)))
    found, _ = search(problem, noise_fitted(problem, fit))
    assert {"motor_lag", "spin_up_reaction"} <= set(found.active)
    assert not {"command_delay", "yaw_inertia"} & set(found.active)
    assert found.values["motor_lag.upper"] == pytest.approx(1.0 / 15.0, rel=0.25)
    assert found.values["spin_up_reaction.gain"] == pytest.approx(1.0, abs=0.35)


@pytest.mark.slow
def test_rotors_that_the_air_shakes_leave_the_reaction_and_the_yaw_inertia_what_they_are(tmp_path):
    """The body feels wakes late, from the motors. Taken for motors' own jitter, they made a reaction of
    1.51 +- 0.13, sure, a yaw inertia two prior std too large, and nothing was gained on other runs."""
    folder = blade_element.fly(
        tmp_path / "f", craft=COAX, sensors="onboard", seed=31, longest=10.0,
        runs=("yaw_3211", "heave_3211", "heading_turn"),
    )  # fmt: skip
    found = diagnose(folder)
    causes = {cause["effect"]: cause for cause in found.findings["causes"]}
    assert {"motor_lag", "spin_up_reaction"} <= set(causes) <= blade_element.ACTS
    number = causes["spin_up_reaction"]["parameters"]["spin_up_reaction.gain"]
    assert number["value"] == pytest.approx(1.0, abs=0.4)
    assert abs(number["value"] - 1.0) < 2.0 * number["std"]
    assert not any("inertia_zz moved" in remark for remark in found.remarks)
    assert found.findings["gain"]["error_removed_percent"] > 10.0
