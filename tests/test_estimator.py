"""The controllers' Kalman filter: spreads, gains and readings against what they must be.

Where a variance has a closed form (uniform starts, stationary processes, Bayes' rule) that is asked
for; where it has none, the linear system is simulated and its errors are counted.
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from coax_env import hover_trim, load_vehicle
from coax_env.env import hover
from coax_env.env.period import DT
from coax_env.kernel.random_streams import stream_key
from coax_env.model.dynamics import derivative
from coax_env.model.layout import CHANNELS, FULL_STATES, N_FULL
from coax_env.model.linear import N_SAMPLED
from coax_env.model.sampling import is_new
from coax_env.model.sensors import suite
from controllers import estimator_design
from controllers.estimator import Tracker
from controllers.estimator_design import BIAS_STD, delay_as_lag, design_estimator

LAMA = load_vehicle("lama400d")
X = {name: i for i, (name, _) in enumerate(FULL_STATES[:N_SAMPLED])}
TRIM = hover_trim(LAMA)


@pytest.fixture(scope="module")
def onboard():
    return design_estimator(LAMA)


@pytest.fixture(scope="module")
def spreads():
    return estimator_design._spreads(LAMA, TRIM[1])


def noise_of(design) -> np.ndarray:
    known = {s.name: s.noise for s in suite(design.sensors)}
    return np.array([max(known[name], 1e-4) for name in design.readings])


# --- spreads --------------------------------------------------------------------------------------


def test_the_first_spread_is_that_of_the_tasks_starts(spreads):
    stream = np.array([stream_key(np.uint64(1)), 0], dtype=np.uint64)
    starts = np.zeros((4000, N_FULL))
    for x in starts:
        hover.random_start(stream, TRIM[1], x)
    found = (starts - starts.mean(axis=0)).std(axis=0)
    drawn = [X[n] for n in ("u", "v", "w", "p", "q", "r", "phi", "theta", "psi", "z")]
    np.testing.assert_allclose(spreads[0][drawn], found[drawn], rtol=0.05)
    others = [i for i in range(20) if i not in drawn]
    assert (spreads[0][others] >= found[others]).all() and (spreads[0][others] > 0.0).all()
    assert (spreads[0][others] <= 0.02).all(), "all else starts as in hover"


def test_disturbances_and_biases_stay_at_their_spread(spreads, onboard):
    """x[k+1] = a x[k] + w is stationary where a^2 s^2 + q^2 = s^2; a is the design's own."""
    first, process = spreads
    names = [n for n in onboard.states if n.startswith(("gust_", "bias_"))]
    assert len(names) == 6 + len(BIAS_STD)
    everything = (*X, *(f"bias_{n}" for n in BIAS_STD))
    for name in names:
        i, k = onboard.index(name), everything.index(name)
        a = onboard.A[i, i]
        assert 0.99 < a < 1.0
        assert a**2 * first[k] ** 2 + process[k] ** 2 == pytest.approx(first[k] ** 2), name
        memory = -DT / math.log(a)
        assert memory == pytest.approx(30.0 if name.startswith("bias_") else 5.0)


def test_disturbances_are_shares_of_what_holds_the_machine_up(spreads):
    weight = LAMA["mass"].value * LAMA["gravity"].value
    one_rotor = TRIM[1] * [1, 0, 0, 0]
    torque = LAMA["inertia_zz"].value * derivative(TRIM[0], one_rotor, LAMA)[5]
    first = dict(zip(X, spreads[0], strict=False))
    for name in ("gust_X", "gust_Y", "gust_Z"):
        assert first[name] == pytest.approx(0.05 * weight)
    assert first["gust_L"] == first["gust_M"] == pytest.approx(0.002 * weight)
    assert first["gust_N"] == pytest.approx(0.07 * torque, rel=1e-6)
    assert spreads[0][26:] == pytest.approx(list(BIAS_STD.values()))


# --- the model ------------------------------------------------------------------------------------


def test_a_bias_is_in_its_own_reading_and_nowhere_else(onboard):
    for name in BIAS_STD:
        column = onboard.C[:, onboard.index(f"bias_{name}")]
        own = np.array([reading == name for reading in onboard.readings], dtype=float)
        assert np.array_equal(column, own), name


def test_a_force_on_the_centre_of_gravity_accelerates_by_newton(onboard):
    A = onboard.A
    v = LAMA.values()
    for gust, rate, inertia in (
        ("gust_X", "u", v["mass"]), ("gust_Y", "v", v["mass"]), ("gust_Z", "w", v["mass"]),
        ("gust_L", "p", v["inertia_xx"]), ("gust_M", "q", v["inertia_yy"]),
        ("gust_N", "r", v["inertia_zz"]),
    ):  # fmt: skip
        found = A[onboard.index(rate), onboard.index(gust)]
        assert found == pytest.approx(DT / inertia, rel=0.03), gust


@pytest.mark.parametrize("sensors", ["onboard", "paper", "mocap", "state"])
def test_trim_readings_are_those_of_a_hover(sensors):
    design = design_estimator(LAMA, sensors=sensors)
    hovering = {
        "az": -LAMA["gravity"].value, "h": 1.5, "z": -1.5,
        "rpm_upper": TRIM[1][0] * 30.0 / math.pi, "rpm_lower": TRIM[1][1] * 30.0 / math.pi,
        "omega_u": TRIM[1][0], "omega_l": TRIM[1][1],
    }  # fmt: skip
    for name, value in zip(design.readings, design.reading_trim, strict=True):
        assert value == pytest.approx(hovering.get(name, 0.0), abs=1e-8), name
    assert "v" not in design.readings or sensors == "state", "the unsigned speed has no slope"
    assert np.array_equal(design.command_trim, TRIM[1])


def test_a_delay_becomes_a_lag_of_the_same_length():
    late = LAMA.with_effect("servo_delay", time=0.03)
    both = late.with_effect("servo_lag", time=0.02)
    for vehicle, lag in ((late, 0.03), (both, 0.05)):
        found = delay_as_lag(vehicle).values()
        assert found["servo_lag.time"] == pytest.approx(lag)
        assert found["servo_delay.time"] == 0.0
    radio = both.with_effect("command_delay", time=0.01).with_effect(
        "motor_lag", upper=0.1, lower=0.08
    )
    found = delay_as_lag(radio).values()
    assert found["servo_lag.time"] == pytest.approx(0.06)
    assert found["motor_lag.upper"] == pytest.approx(0.11)
    assert found["motor_lag.lower"] == pytest.approx(0.09)
    assert found["command_delay.time"] == found["servo_delay.time"] == 0.0
    lagging = LAMA.with_effect("servo_lag", time=0.02)
    assert delay_as_lag(lagging).values() == lagging.values()
    assert delay_as_lag(LAMA) is LAMA


# --- gains ----------------------------------------------------------------------------------------


def test_the_first_gain_is_bayes_rule(onboard, spreads):
    """In information form: (P0^-1 + C' R^-1 C)^-1 is what is left of P0 after one reading of all."""
    everything = (*X, *(f"bias_{n}" for n in BIAS_STD))
    prior = np.array([spreads[0][everything.index(n)] for n in onboard.states]) ** 2
    C, R = onboard.C, noise_of(onboard) ** 2
    left = np.linalg.inv(np.diag(1.0 / prior) + C.T @ (C / R[:, None]))
    np.testing.assert_allclose(
        onboard.first_gain, left @ C.T / R, rtol=1e-6, atol=1e-9 * np.abs(onboard.first_gain).max()
    )


def test_gains_act_on_what_is_new_in_their_row(onboard):
    rates = {s.name: s.rate for s in suite("onboard")}
    assert len(onboard.gains) == 10, "40 Hz and 100 Hz meet every ten rows, 20 and 10 Hz too"
    for row, gain in enumerate(onboard.gains):
        for k, name in enumerate(onboard.readings):
            has_sample = bool(is_new(row + 10, rates[name])) and not name.startswith("rpm")
            assert gain[:, k].any() == has_sample, (row, name)  # a rotor without lag is its command


@pytest.mark.slow
def test_the_errors_of_the_linear_system_have_the_spread_that_is_stated(onboard, spreads):
    """Three hundred errors under the filter's own gains, with the noise that was assumed."""
    rng = np.random.default_rng(0)
    everything = (*X, *(f"bias_{n}" for n in BIAS_STD))
    process = np.array([spreads[1][everything.index(n)] for n in onboard.states])
    noise, (A, C) = noise_of(onboard), (onboard.A, onboard.C)
    error = rng.standard_normal((300, len(process))) * onboard.spread
    squares = []
    for k in range(1, 7001):
        error = error @ A.T + process * rng.standard_normal(error.shape)
        innovation = error @ C.T + noise * rng.standard_normal((300, len(noise)))
        error = error - innovation @ onboard.gains[k % 10].T
        if k > 2000 and k % 100 == 0:
            squares.append((error**2).mean(axis=0))
    found = np.sqrt(np.mean(squares, axis=0))
    np.testing.assert_allclose(found, onboard.spread, rtol=0.12)


def test_where_every_reading_is_fast_the_single_rate_gain_is_the_gain():
    design = design_estimator(LAMA, sensors="paper")
    assert len(design.gains) == 1
    scale = 1.0 / design.spread[:, None] * noise_of(design)
    np.testing.assert_allclose(design.single_rate_gain * scale, design.gains[0] * scale, atol=2e-3)


def test_slow_readings_are_taken_as_fast_and_noisier_ones(onboard):
    """The same information a second: at the gain of the mean row, to a few per cent."""
    mean = onboard.gains.mean(axis=0)
    for state, reading in (("z", "h"), ("u", "vn"), ("phi", "phi"), ("p", "p"), ("w", "vd")):
        i, k = onboard.index(state), onboard.readings.index(reading)
        assert onboard.single_rate_gain[i, k] == pytest.approx(mean[i, k], rel=0.2), state


# --- the running filter ---------------------------------------------------------------------------


def observation_of(design, **readings) -> np.ndarray:
    """A row of the env's observation at trim, everything new, with some readings changed."""
    names = [s.name for s in suite(design.sensors)]
    seen = np.ones(len(names) + 3)
    for k, name in enumerate(design.readings):
        seen[names.index(name)] = design.reading_trim[k] + readings.get(name, 0.0)
    return seen[None]


def test_the_first_reading_moves_the_estimate_by_the_first_gain(onboard):
    tracker = Tracker(onboard)
    offset = tracker.state.copy()
    shift = {"h": 0.1, "p": 0.2, "az": -0.3}
    known = tracker.see(observation_of(onboard, **shift))[:, : len(onboard.states)]
    y = np.array([shift.get(name, 0.0) for name in onboard.readings])
    expected = onboard.C @ offset[0] + onboard.D @ tracker.offset
    np.testing.assert_allclose(known[0], offset[0] + onboard.first_gain @ (y - expected), atol=1e-9)


@pytest.mark.parametrize("psi", [0.0, 0.7, -2.5, math.pi])
def test_velocity_is_turned_into_the_heading(psi, onboard):
    """A machine that flies ahead is seen to fly ahead, whatever its heading."""
    tracker = Tracker(onboard)
    ahead = dict(vn=math.cos(psi), ve=math.sin(psi), psi=psi)
    tracker.see(observation_of(onboard, **ahead))
    read = dict(zip(onboard.readings, tracker._readings[0], strict=True))
    assert read["vn"] == pytest.approx(1.0) and read["ve"] == pytest.approx(0.0, abs=1e-9)
    assert math.cos(read["psi"] - psi) == pytest.approx(1.0)


def test_a_heading_that_is_missing_is_the_one_expected():
    """Also of a compass that is off: its reading in trim is not zero."""
    biased = design_estimator(LAMA.with_effect("attitude_bias", z=0.2))
    assert biased.reading_trim[biased.readings.index("psi")] == pytest.approx(0.2)
    seen = [Tracker(biased).see(observation_of(biased, psi=psi))[0] for psi in (math.nan, 0.0)]
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-9)


def test_integrals_add_up_what_is_read_and_stop(onboard):
    tracker = Tracker(onboard)
    integrated = list(estimator_design.integrated_readings(onboard))
    for _ in range(100):
        known = tracker.see(observation_of(onboard, h=0.02, psi=0.01))
        tracker.acted(np.zeros((1, 4)))
    found = dict(zip(integrated, tracker.integrals[0], strict=True))
    assert found["h"] == pytest.approx(0.02) and found["psi"] == pytest.approx(0.01)
    assert found["vn"] == pytest.approx(0.0, abs=1e-9)
    assert known.shape == (1, len(onboard.states) + len(integrated))
    tracker.integrals[:] = 1e6
    tracker.acted(np.zeros((1, 4)))
    most = dict(zip(integrated, tracker.integrals[0], strict=True))
    assert most["h"] == pytest.approx(20.0 * hover.LIMITS["height"] * 1.5)
    assert most["vn"] == pytest.approx(20.0 * hover.LIMITS["position"])


def test_channels_of_the_log_are_the_readings_of_the_filter(onboard):
    assert set(onboard.readings) <= set(CHANNELS)
    names = [s.name for s in suite("onboard")]
    assert [names[k] for k in onboard.reading_places] == list(onboard.readings)


def seen_from(design, place: np.ndarray, psi: float, target: np.ndarray) -> np.ndarray:
    """What a machine that hangs level at x y z with this heading sees (``mocap``), its target too."""
    names = [s.name for s in suite("mocap")]
    row = np.ones(len(names) + 3 + 4)
    for k, name in enumerate(design.readings):
        row[names.index(name)] = design.reading_trim[k]
    north, east = target[:2] - place[:2]
    row[[names.index(n) for n in ("pn", "pe", "h", "psi")]] = *place[:2], -place[2], psi
    ahead = north * math.cos(psi) + east * math.sin(psi)
    right = east * math.cos(psi) - north * math.sin(psi)
    row[-4:] = ahead, right, place[2] - target[2], target[3] - psi
    return row[None]


@pytest.mark.slow
@pytest.mark.parametrize("psi", [0.0, 0.8, -2.0])
def test_where_the_target_moves_the_estimate_moves_and_the_machine_does_not(psi):
    """In the heading's axes, from one target to the next: a machine at rest brings no surprise."""
    design = design_estimator(LAMA, sensors="mocap")
    tracker = Tracker(design)
    place = np.array([2.0, -1.0, -1.4])
    known = []
    for target in ([2.1, -1.2, -1.5, psi + 0.1], [1.85, -0.9, -1.3, psi - 0.15]):
        for _ in range(400 if not known else 1):
            estimate = tracker.see(seen_from(design, place, psi, np.array(target)))
            found = dict(zip(design.states, estimate[0], strict=False))
            tracker.acted(-tracker.offset[None] / design.action_scale)
        away = place - target[:3]
        known.append((found, {
            "x": away[0] * math.cos(psi) + away[1] * math.sin(psi),
            "y": away[1] * math.cos(psi) - away[0] * math.sin(psi),
            "z": away[2], "psi": psi - target[3],
        }))  # fmt: skip
    for found, expected in known:
        for name, value in expected.items():
            assert found[name] == pytest.approx(value, abs=2e-3), name
    for name in ("u", "v", "w", "p", "q", "r", "phi", "theta"):
        assert abs(known[1][0][name] - known[0][0][name]) < 1e-4, name


def test_what_flies_with_the_target_is_told_to_be_at_rest():
    """Its velocity and turn, and the tilt of its acceleration over g: a lean ahead speeds it up."""
    design = design_estimator(LAMA, sensors="mocap")
    tracker = Tracker(design, 2)
    motion = np.array([[1.0, -0.5, 0.3, 0.7, 0.9, -0.4, 8.0], np.zeros(7)])
    found = tracker._reference(motion)
    expected = {"u": 1.0, "v": -0.5, "w": -0.3, "r": 0.7, "theta": -0.9 / 9.80665,
                "phi": -0.4 / 9.80665}  # fmt: skip
    for j, name in enumerate(design.states):
        assert found[0, j] == pytest.approx(expected.get(name, 0.0), rel=1e-2), name
    assert not found[1].any()


def test_a_heading_that_crosses_the_seam_brings_no_surprise(onboard):
    """From just east of south to just west of it: the estimate goes on, within a turn."""
    tracker = Tracker(onboard)
    at = onboard.index("psi")
    for k in range(300):
        psi = (3.0 + 0.001 * k + math.pi) % (2.0 * math.pi) - math.pi
        known = tracker.see(observation_of(onboard, psi=psi))[0, at]
        tracker.acted(-tracker.offset[None] / onboard.action_scale)
        assert -math.pi <= tracker.state[0, at] < math.pi
        assert abs((known - psi + math.pi) % (2.0 * math.pi) - math.pi) < 0.1, k


def test_a_machine_that_yaws_is_predicted_as_the_model_flies_it():
    """Drifting and tilted while it turns by 0.6 rad: what is fixed in the world turns in its axes."""
    design = design_estimator(LAMA, sensors="mocap")
    tracker = Tracker(design)
    start = dict(u=0.02, v=0.03, r=2.0, phi=0.01, theta=-0.006, x=0.2, y=0.1)
    flown = TRIM[0].copy()
    for name, value in start.items():
        flown[X[name]] += value
        tracker.state[0, design.index(name)] = value
    for _ in range(30):
        tracker.acted(-tracker.offset[None] / design.action_scale)
    flown = solve_ivp(
        lambda _, x: derivative(x, TRIM[1], LAMA), (0.0, 0.3), flown, rtol=1e-9, atol=1e-12
    ).y[:, -1]
    moved = flown - TRIM[0]
    psi = moved[X["psi"]]
    north, east = moved[X["x"]], moved[X["y"]]
    moved[X["x"]] = math.cos(psi) * north + math.sin(psi) * east
    moved[X["y"]] = math.cos(psi) * east - math.sin(psi) * north
    assert psi == pytest.approx(0.6, abs=0.01)
    for name in ("u", "v", "phi", "theta", "x", "y", "psi"):
        assert tracker.state[0, design.index(name)] == pytest.approx(
            moved[X[name]], rel=0.02, abs=5e-4
        ), name


@pytest.mark.parametrize(("share", "named"), [(0.03, False), (0.07, True), (0.6, True)])
def test_a_blind_direction_is_told_by_the_states_it_runs_along(share, named):
    """One direction across two states that nothing reads, and that stays: both are unobserved."""
    n = len(estimator_design._NAMES)
    blind = np.zeros(n)
    blind[3], blind[7] = math.sqrt(1.0 - share**2), share
    C = np.linalg.svd(blind[None])[2][1:]  # reads all that is across it
    found = estimator_design._unobserved(np.eye(n), C, np.ones(n), np.ones(n - 1))
    assert found == tuple(estimator_design._NAMES[i] for i in ((3, 7) if named else (3,)))
    assert not estimator_design._unobserved(
        0.9 * np.eye(n), C, np.ones(n), np.ones(n - 1)
    )  # it heals
