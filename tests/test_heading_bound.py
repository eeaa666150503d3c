"""What a yaw model can foretell from commands: less where they answer what they move."""

import numpy as np
import pytest
from study.heading_bound import HORIZON, ROW, Yaw, best, errors

from coax_env import load_vehicle

VEHICLE = load_vehicle("skybotix_coax")
TRUTH = np.array([1.0, 1.0, 0.0, 1.0, 0.0, 0.0])
ROWS = 1500


def flown(feedback: float, disturbance: float) -> Yaw:
    """Both rotors about their hover, against each other; heading by errors' own law, written out."""
    v = {name: p.value for name, p in VEHICLE.parameters.items()}
    per_speed2 = v["air_density"] * np.pi * v["rotor_radius"] ** 5 / v["inertia_zz"]
    kick = per_speed2 * np.array([v["torque_coefficient_upper"], v["torque_coefficient_lower"]])
    hover = np.array([200.0, 200.0 * np.sqrt(kick[0] / kick[1])])
    rng = np.random.default_rng(2)
    psi, rate, command = np.zeros(ROWS), np.zeros(ROWS), np.empty((ROWS, 2))
    asked = shaken = 0.0
    for k in range(ROWS):
        asked += 0.1 * (-asked + 3.0 * rng.standard_normal())
        shaken += 0.02 * (-shaken + 10.0 * disturbance * rng.standard_normal())
        change = (asked if feedback == 0.0 else 0.0) - feedback * (4.0 * psi[k] + rate[k])
        command[k] = hover + [change, -change]
        if k + 1 < ROWS:
            torque = command[k] ** 2 @ [kick[0], -kick[1]]
            psi[k + 1] = psi[k] + ROW * rate[k]
            rate[k + 1] = rate[k] + ROW * (torque + shaken - TRUTH[3] * rate[k])
    return Yaw(psi, rate, command)


def test_with_the_truth_nothing_is_left():
    yaw = flown(feedback=0.0, disturbance=0.0)
    left = errors(yaw, VEHICLE, TRUTH, 0.0)
    assert left.size == (ROWS - HORIZON) // 10 and np.abs(left).max() < 1e-9


@pytest.mark.slow
def test_commands_of_their_own_give_the_gain_back():
    error, gains, delay = best(flown(feedback=0.0, disturbance=0.0), VEHICLE, -2.0)
    assert error < 1e-3 and delay == 0.0
    assert gains[:2] == pytest.approx([1.0, 1.0], rel=0.02)


@pytest.mark.slow
def test_commands_that_answer_the_heading_have_less_than_their_gain():
    """Of models that turn the right way the least is best, and no better than that nothing moves."""
    yaw = flown(feedback=2.0, disturbance=3.0)
    apart = np.sqrt(np.mean((yaw.psi[HORIZON:] - yaw.psi[:-HORIZON]) ** 2))
    error, gains, _ = best(yaw, VEHICLE, 0.5)
    free, own, _ = best(yaw, VEHICLE, -2.0)
    assert gains[0] == pytest.approx(0.5, abs=0.01) and own[0] < 0.3
    assert free < error and error > 0.8 * apart
