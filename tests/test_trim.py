"""Trim and linearisation in steady flight: what stays the same when seen from the moving air."""

import numpy as np
import pytest

import coax_env
from coax_env import InputError
from coax_env.model.dynamics import full_state, kernel_input, step
from coax_env.model.layout import N_FULL

LAMA = coax_env.load_vehicle("lama400d")
DRAGGED = LAMA.with_effect("rotor_drag", coefficient=3.5e-4).with_effect("cg_offset", x=0.001)
STEADY = slice(0, 10)


@pytest.mark.parametrize("flight", [((2.0, 0.0), 0.0), ((-1.0, 3.0), 0.5), ((0.0, 0.0), -1.0)])
def test_nothing_but_the_position_moves(flight):
    velocity, climb = flight
    state, command = coax_env.trim(DRAGGED, velocity, climb, wind=(1.0, -2.0))
    windy = DRAGGED.with_effect("wind", north=1.0, east=-2.0)
    rates = coax_env.derivative(state, command, windy)
    assert np.abs(rates[STEADY]).max() < 1e-6
    assert rates[13:16] == pytest.approx([*velocity, -climb], abs=1e-9)
    assert rates[10:13] == pytest.approx(0.0, abs=1e-9)


def test_wind_is_flight_the_other_way():
    """Galileo: what counts is the velocity through the air."""
    moving, command = coax_env.trim(DRAGGED, (-3.0, 1.0))
    blown, against = coax_env.trim(DRAGGED, wind=(3.0, -1.0))
    assert blown[3:13] == pytest.approx(moving[3:13], abs=1e-8)
    assert against == pytest.approx(command, rel=1e-8, abs=1e-8)
    flying = coax_env.linearize(DRAGGED, velocity=(-3.0, 1.0))
    standing = coax_env.linearize(DRAGGED, wind=(3.0, -1.0))
    assert np.asarray(flying.B) == pytest.approx(np.asarray(standing.B), abs=1e-6)
    # flap and attitude; accelerations also have w x V, which is that of the frame
    angles = np.s_[6:12, 3:12]
    assert np.asarray(flying.A)[angles] == pytest.approx(np.asarray(standing.A)[angles], abs=1e-6)


def test_drag_is_carried_by_the_tilt():
    """Of a drag alone: forward force = weight times the tangent of the nose down."""
    speed = 4.0
    dragged = LAMA.with_effect("rotor_drag", coefficient=3.5e-4)
    state, command = coax_env.trim(dragged, (speed, 0.0))
    drag = 3.5e-4 * command[:2].sum() * np.hypot(state[0], 0.0)
    weight = LAMA["mass"].value * LAMA["gravity"].value
    assert np.sin(-state[11]) == pytest.approx(drag / weight, rel=1e-6)


def test_at_rest_it_is_the_hovers():
    for found, wanted in zip(coax_env.trim(DRAGGED), coax_env.hover_trim(DRAGGED), strict=True):
        assert np.array_equal(found, wanted)
    hover, still = coax_env.linearize(DRAGGED), coax_env.linearize(DRAGGED, wind=(0.0, 0.0))
    assert np.array_equal(hover.A, still.A)


def test_the_speedometer_has_a_slope_in_flight():
    system = coax_env.linearize(LAMA, velocity=(2.0, 0.0))
    row = system.output_labels.index("v")
    assert np.asarray(system.C)[row, 0] == pytest.approx(1.0, abs=1e-6)
    assert not np.asarray(coax_env.linearize(LAMA).C)[row].any()


def test_a_sampled_flight_goes_on_as_the_kernel_does():
    from coax_env.model.dynamics import WORK_SIZE
    from coax_env.model.linear import N_SAMPLED, sampled

    A, _, _, _, x, u = sampled(DRAGGED, 0.01, (3.0, 0.0))
    start, end = x.copy(), np.empty(N_FULL)
    change = 1e-5 * np.random.default_rng(2).standard_normal(N_SAMPLED)
    start[:N_SAMPLED] += change
    step(start, kernel_input(u), 0.01, DRAGGED.vector, np.zeros(WORK_SIZE), end)
    gone = np.zeros(N_SAMPLED)
    gone[13] = 0.03
    assert end[:N_SAMPLED] == pytest.approx(x[:N_SAMPLED] + gone + A @ change, abs=1e-9)
    assert full_state(x[:16], u, DRAGGED) == pytest.approx(x)


def test_what_cannot_be_flown_is_refused():
    with pytest.raises(InputError, match="steady flight"):
        coax_env.trim(LAMA.with_effect("rotor_drag", coefficient=1.0), (200.0, 0.0))
    with pytest.raises(InputError, match="finite"):
        coax_env.trim(LAMA, (np.nan, 0.0))
    with pytest.raises(InputError, match="wind"):
        coax_env.trim(LAMA, wind=(np.inf, 0.0))
