"""The linearisation: closed-form entries, the kernel at other step sizes, names, lags."""

import math

import numpy as np
import pytest

import coax_env
from coax_env.model.dynamics import WORK_SIZE, full_state, kernel_input, step
from coax_env.model.layout import CHANNELS, COMMANDS, STATES
from coax_env.model.linear import FASTEST_LAG, N_SAMPLED, sampled, with_lags

LAMA = coax_env.load_vehicle("lama400d")
LAGGING = (
    LAMA.with_effect("motor_lag", upper=0.1, lower=0.08)
    .with_effect("servo_lag", time=0.04)
    .with_effect("rotor_drag", coefficient=4e-4)
    .with_effect("cg_offset", x=0.001, y=-0.002)
)
X = {name: i for i, (name, _) in enumerate(STATES)}
U = {name: i for i, (name, _) in enumerate(COMMANDS)}
Y = {name: i for i, name in enumerate(CHANNELS)}


def test_closed_form_entries():
    """Derivatives of (26)-(44) at hover by hand."""
    v = LAMA.values()
    system = coax_env.linearize(LAMA)
    A, B = np.asarray(system.A), np.asarray(system.B)
    k_T = v["air_density"] * math.pi * v["rotor_radius"] ** 4
    k_Q = k_T * v["rotor_radius"]
    omega_u, omega_l = coax_env.hover_trim(LAMA)[1][:2]
    lift_u = v["thrust_coefficient_upper"] * k_T * omega_u**2
    lift_l = v["thrust_coefficient_lower"] * k_T * omega_l**2
    H = (
        v["rotor_inertia_lower"] * omega_l
        - (v["rotor_inertia_upper"] + v["flybar_inertia"]) * omega_u
    )
    expected = {
        ("u", "theta"): -v["gravity"],
        ("v", "phi"): v["gravity"],
        ("u", "alpha_l"): -lift_l / v["mass"],
        ("u", "alpha_f"): -v["flybar_to_rotor_lon"] * lift_u / v["mass"],
        ("p", "beta_l"): v["arm_lower"] * lift_l / v["inertia_xx"],
        ("q", "alpha_f"): v["arm_upper"] * v["flybar_to_rotor_lon"] * lift_u / v["inertia_yy"],
        ("p", "q"): -H / v["inertia_xx"],
        ("q", "p"): H / v["inertia_yy"],
        ("alpha_l", "alpha_l"): -1.0 / v["flap_time_constant"],
        ("alpha_f", "q"): -1.0,
        ("x", "u"): 1.0,
        ("z", "w"): 1.0,
    }
    for (row, column), value in expected.items():
        assert A[X[row], X[column]] == pytest.approx(value, rel=1e-7), (row, column)
    assert B[X["alpha_l"], U["delta_lon"]] == pytest.approx(
        v["swash_to_flap"] / v["flap_time_constant"]
    )
    assert B[X["r"], U["omega_u"]] == pytest.approx(
        2.0 * v["torque_coefficient_upper"] * k_Q * omega_u / v["inertia_zz"]
    )
    assert np.asarray(system.D)[Y["rpm_upper"], U["omega_u"]] == pytest.approx(30.0 / math.pi)


@pytest.mark.parametrize("vehicle", [LAMA, LAGGING], ids=["bare", "with effects"])
@pytest.mark.parametrize("size", [1e-3, 1e-4])
def test_it_is_the_kernels_slope_at_any_step(vehicle, size):
    state, command = coax_env.hover_trim(vehicle)
    system = coax_env.linearize(vehicle)
    rng = np.random.default_rng(0)
    for _ in range(5):
        dx, du = size * rng.standard_normal(16), size * rng.standard_normal(4)
        change = (
            coax_env.derivative(state + dx, command + du, vehicle)
            - coax_env.derivative(state - dx, command - du, vehicle)
        ) / 2.0
        linear = np.asarray(system.A) @ dx + np.asarray(system.B) @ du
        assert np.abs(change - linear).max() < 60.0 * size**2 + 1e-7 * size


def test_names_and_sizes():
    system = coax_env.linearize(LAMA)
    assert system.state_labels == [name for name, _ in STATES]
    assert system.input_labels == [name for name, _ in COMMANDS]
    assert system.output_labels == list(CHANNELS)
    full = coax_env.linearize("skybotix_coax", full=True)
    assert (full.nstates, full.ninputs, full.noutputs) == (20, 4, 18)
    assert full.state_labels[16:] == ["omega_u", "omega_l", "swash_lon", "swash_lat"]
    assert not any("." in label for label in full.state_labels + full.output_labels)


def test_lags_are_states_when_asked_for_and_static_otherwise():
    full = np.asarray(coax_env.linearize(LAGGING, full=True).A)
    assert np.diag(full)[16:] == pytest.approx([-10.0, -12.5, -25.0, -25.0])
    bare = np.asarray(coax_env.linearize(LAMA, full=True).A)
    assert np.diag(bare)[16:] == pytest.approx([-1.0 / FASTEST_LAG] * 4)
    # at zero frequency the lags have died out: same answers to a held command
    static = coax_env.linearize(LAGGING)
    A, B = (
        np.asarray(coax_env.linearize(LAGGING, full=True).A),
        np.asarray(coax_env.linearize(LAGGING, full=True).B),
    )
    settled = A[:16, :16], A[:16, 16:] @ np.linalg.solve(-A[16:, 16:], B[16:]) + B[:16]
    assert settled[0] == pytest.approx(np.asarray(static.A), abs=1e-6)
    assert settled[1] == pytest.approx(np.asarray(static.B), abs=1e-6)
    assert with_lags(LAGGING, 0.0)["servo_lag.time"].value == 0.0


def test_the_sampled_system_is_the_kernels_step():
    A, B, _, _, x, u = sampled(LAGGING, 0.01)
    rng = np.random.default_rng(1)
    dx, du = 1e-5 * rng.standard_normal(N_SAMPLED), 1e-5 * rng.standard_normal(4)
    sides = []
    for sign in (1.0, -1.0):
        start, end = np.zeros(29), np.empty(29)
        start[:] = x
        start[:N_SAMPLED] += sign * dx
        u_there = kernel_input(u + sign * du)
        step(start, u_there, 0.01, LAGGING.vector, np.zeros(WORK_SIZE), end)
        sides.append(end[:N_SAMPLED])
    assert (sides[0] - sides[1]) / 2.0 == pytest.approx(A @ dx + B @ du, abs=1e-11)


def test_the_sampled_system_agrees_with_the_exact_discretisation():
    from scipy.linalg import expm

    system = coax_env.linearize(LAGGING, full=True)
    A, B = np.asarray(system.A), np.asarray(system.B)
    exact = expm(np.block([[A, B], [np.zeros((4, 24))]]) * 0.01)
    A_d, B_d, *_ = sampled(LAGGING, 0.01)
    assert np.abs(A_d[:16, :16] - exact[:16, :16]).max() < 2e-5
    # RK4's stages see the actuators READING_DELAY, a hundredth of the period, ahead
    assert np.abs(B_d[:20] - exact[:20, 20:]).max() < 5e-4


def test_trim_is_an_equilibrium_of_the_step():
    x, command = coax_env.hover_trim(LAGGING)
    out = np.empty(29)
    start = full_state(x, command, LAGGING)
    step(start, kernel_input(command), 0.01, LAGGING.vector, np.zeros(WORK_SIZE), out)
    assert out == pytest.approx(start, abs=1e-9)
