"""The helicopter as the engine sees it: noise, first states, delayed inputs, innovations.

Variances follow from stationary processes, delays from the command's own integral, first states from
readings that were made up here.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.estimation.helicopter import (
    HELD,
    MOST_USUAL_SIZES,
    READ,
    RISE,
    HeliModel,
    record_of,
)
from coax_env.estimation.helicopter_noise import (
    GUST_LEVELS,
    LEAST_READING_STD,
    MEMORIES,
    ROTOR_LEVEL,
    TRIM_LEVELS,
    WHITE_LEVELS,
    sensor_std,
    starting_noise,
)
from coax_env.estimation.state_space import Noise, Record
from coax_env.logs.flight import Flight, Run
from coax_env.model import dynamics, effects
from coax_env.model import parameters as P
from coax_env.model.layout import CHANNELS, FULL_STATES, N_FULL, N_INPUTS

LAMA = load_vehicle("lama400d")
MODEL = HeliModel(LAMA)
X = {name: i for i, (name, _) in enumerate(FULL_STATES)}
LEVELS = {
    "force_xy": 0.2, "force_z": 0.3, "moment_xy": 4e-3, "moment_z": 5e-3,
    **dict.fromkeys(MEMORIES, 0.8),
    "white_force_xy": 0.02, "white_force_z": 0.03, "white_moment_xy": 4e-4, "white_moment_z": 5e-4,
}  # fmt: skip
QUIET = dict.fromkeys(GUST_LEVELS, 0.0) | {ROTOR_LEVEL: 0.1}


# --- noise ----------------------------------------------------------------------------------------


def test_gust_states_are_stationary_at_their_levels():
    """x' = -x/tau + w has variance q tau / 2: what decays in a moment is what the noise brings."""
    q, decay = MODEL.process_noise(Noise(LEVELS), LAMA.vector)
    first = MODEL.start_noise(Noise(LEVELS))
    expected = {"gust_X": 0.2, "gust_Y": 0.2, "gust_Z": 0.3,
                "gust_L": 4e-3, "gust_M": 4e-3, "gust_N": 5e-3}  # fmt: skip
    for name, level in expected.items():
        assert q[X[name]] / (2.0 * decay[X[name]]) == pytest.approx(level**2), name
        assert decay[X[name]] == pytest.approx(1.0 / 0.8)
        assert first[X[name]] == pytest.approx(level**2), name
    assert not first[:20].any()


def test_white_noise_is_white_force_over_mass_and_moment_over_inertia():
    """Newton: a white force of intensity b makes the velocity's variance grow by (b/m)^2 a second."""
    gusts_alone = Noise({k: v for k, v in LEVELS.items() if k not in WHITE_LEVELS})
    extra = MODEL.process_noise(Noise(LEVELS), LAMA.vector).intensity
    extra = extra - MODEL.process_noise(gusts_alone, LAMA.vector).intensity
    v = LAMA.values()
    expected = np.zeros(extra.size)
    expected[[X["u"], X["v"], X["w"]]] = np.array([0.02, 0.02, 0.03]) / v["mass"]
    inertias = [v["inertia_xx"], v["inertia_yy"], v["inertia_zz"]]
    expected[[X["p"], X["q"], X["r"]]] = np.divide([4e-4, 4e-4, 5e-4], inertias)
    np.testing.assert_allclose(extra, expected**2, rtol=1e-6, atol=1e-15)


def test_without_gusts_the_model_is_nearly_believed():
    """What is left is far below what any sensor here sees in a second, but not zero."""
    q = np.sqrt(MODEL.process_noise(Noise(QUIET), LAMA.vector).intensity)
    assert (q[:20] > 0.0).all() and not q[20:].any()
    for states, least in (
        (("u", "v", "w"), 0.02), (("p", "q", "r"), 0.01), (("phi", "theta", "psi"), 0.006),
        (("x", "y", "z"), 0.004), (("alpha_l", "beta_l", "alpha_f", "beta_f"), 0.006),
        (("omega_u", "omega_l"), 1.1), (("swash_lon", "swash_lat"), 0.006),
    ):  # fmt: skip
        for name in states:
            assert q[X[name]] < 0.2 * least, name


# --- the start ------------------------------------------------------------------------------------


def record(seconds=2.0, dt=0.02, **readings) -> Record:
    """A record at hover commands with these readings, one number or an array each."""
    t = 5.0 + dt * np.arange(round(seconds / dt))
    z = np.full((t.size, len(CHANNELS)), np.nan)
    for channel, values in readings.items():
        z[:, CHANNELS.index(channel)] = values
    command = np.tile([210.0, 225.0, 0.01, -0.02], (t.size, 1))
    return Record("made up", t, command, z, origin=4.0)


def test_the_first_state_is_the_median_of_the_first_half_second():
    """What comes later, and a wild reading or two, do not matter."""
    t = np.arange(100) * 0.02
    height = np.where(t <= 0.5, 1.2, 50.0)
    height[3:5] = 9.0
    late = record(h=height, phi=0.1, theta=-0.05, psi=2.0, pn=3.0, pe=-4.0)
    x, P0 = MODEL.start(late)
    expected = {"phi": 0.1, "theta": -0.05, "psi": 2.0, "x": 3.0, "y": -4.0, "z": -1.2,
                "omega_u": 210.0, "omega_l": 225.0, "swash_lon": 0.01, "swash_lat": -0.02}  # fmt: skip
    for name, i in X.items():
        assert x[i] == pytest.approx(expected.get(name, 0.0)), name
    assert np.array_equal(P0, np.diag(np.diag(P0))) and (np.diag(P0)[:20] > 0.0).all()


def test_half_a_second_is_half_a_second_at_any_rate_and_commands_are_the_first():
    """Readings at 0, 0.25 and 0.5 s are early, one at 0.75 s is not: the median of three."""
    slow = record(seconds=2.0, dt=0.25, h=np.array([1.0, 2.0, 3.0, 9.0, 9.0, 9.0, 9.0, 9.0]))
    slow.command[1:] += 1.0
    x, _ = MODEL.start(slow)
    assert x[X["z"]] == pytest.approx(-2.0)
    np.testing.assert_array_equal(x[16:20], slow.command[0])


def test_a_heading_at_the_seam_starts_at_the_seam():
    psi = np.where(np.arange(100) % 2, math.pi - 0.01, 0.01 - math.pi)
    x, _ = MODEL.start(record(psi=psi))
    assert math.cos(x[X["psi"]]) == pytest.approx(math.cos(math.pi - 0.01), abs=1e-4)


def test_what_is_not_measured_starts_anywhere_a_hover_can_be():
    """A flown start (0.3 m/s, 5 deg, 10 deg/s) lies well within; a place counts from itself."""
    x, P0 = MODEL.start(record())
    std = np.sqrt(np.diag(P0))
    assert x[X["z"]] == pytest.approx(-1.0) and std[X["z"]] == pytest.approx(1.0, rel=1e-6)
    for states, least, most in (
        (("u", "v", "w"), 0.6, 2.0), (("p", "q", "r"), 0.35, 1.2),
        (("phi", "theta", "psi"), 0.15, 0.4), (("x", "y"), 0.0, 0.01),
        (("alpha_l", "beta_l", "alpha_f", "beta_f"), 0.03, 0.1),
        (("omega_u", "omega_l"), 2.0, 8.0), (("swash_lon", "swash_lat"), 0.02, 0.06),
    ):  # fmt: skip
        for name in states:
            assert least < std[X[name]] < most, name
    std = np.sqrt(np.diag(MODEL.start(record(h=1.0, pn=0.0, pe=0.0))[1]))
    assert std[[X["x"], X["y"], X["z"]]] == pytest.approx(0.5, rel=1e-6)


# --- inputs ---------------------------------------------------------------------------------------


def test_inputs_are_commands_time_and_innovations():
    one = record()
    u = MODEL.inputs(one, LAMA.vector)
    step, read = u[:, :N_INPUTS], u[:, READ]
    assert u.shape == (one.t.size, RISE.stop) and np.array_equal(step, read)
    assert not u[:, RISE].any()
    assert np.array_equal(step[:, :4], one.command)
    np.testing.assert_allclose(step[:, 4], one.t - 4.0)
    assert not step[:, 5].any()
    charged = replace(one, battery=12.0 - 0.01 * one.t)
    at = {"battery_voltage.per_volt": 0.05, "battery_voltage.nominal": 11.5}
    half = np.column_stack([step[:, :5], 0.5 - 0.01 * one.t])
    both = MODEL.inputs(charged, MODEL.vector(at))[:, : RISE.start]
    np.testing.assert_allclose(both, np.hstack([half, half]))
    innovations = np.random.default_rng(0).standard_normal((one.t.size, 4))
    with_innovations = Record(one.name, one.t, one.command, one.z, one.origin, innovations)
    assert np.array_equal(MODEL.inputs(with_innovations, LAMA.vector), np.hstack([u, innovations]))


@pytest.mark.parametrize(
    ("common", "of_servos"), [(0.0, 0.007), (0.0, 0.02), (0.0, 0.063), (0.05, 0.0), (0.017, 0.02)]
)
def test_late_commands_are_their_mean_over_the_row(common, of_servos):
    """Held commands that are shifted, averaged by counting a fine grid; the plate's by both delays."""
    rng = np.random.default_rng(1)
    t = 3.0 + np.cumsum(rng.uniform(0.01, 0.03, 60))
    command = rng.standard_normal((60, 4))
    late = LAMA.with_effect("servo_delay", time=of_servos).with_effect("command_delay", time=common)
    u = HeliModel(late).inputs(Record("", t, command, np.empty((60, 18)), float(t[0])), late.vector)
    for k in range(59):
        fine = np.linspace(t[k], t[k + 1], 20001)[:-1] + 0.5 * (t[k + 1] - t[k]) / 20000
        for columns, delay in ((slice(0, 2), common), (slice(2, 4), common + of_servos)):
            row = np.maximum(np.searchsorted(t, fine - delay, side="right") - 1, 0)
            assert u[k, columns] == pytest.approx(command[row, columns].mean(axis=0), abs=2e-4), k


@pytest.mark.parametrize(("rows", "per_row"), [(1, 2.0), (2, 1.0), (5, 1.0)])
def test_a_reading_sees_the_command_in_force_as_its_row_begins(rows, per_row):
    """Taken over in the middle between two rows, that of `rows` ago; before, on the line to the next.

    From no delay on, where it is the row's own, the line is twice as steep.
    """
    one = record(seconds=1.0)
    n, step = one.t.size, one.t[1] - one.t[0]
    changing = replace(one, command=np.random.default_rng(3).standard_normal((n, 4)))

    def read(late: float) -> np.ndarray:
        vector = MODEL.vector({"command_delay.time": late * step})
        return MODEL.inputs(changing, vector)[rows:-1, READ][:, :4]

    in_force, later = changing.command[: n - 1 - rows], changing.command[1 : n - rows]
    np.testing.assert_allclose(read(rows - 0.5), in_force, atol=1e-9)
    towards = in_force + 0.3 * per_row * (later - in_force)
    np.testing.assert_allclose(read(rows - 0.8), towards, atol=1e-9)


def test_readings_may_see_commands_later_than_steps_do():
    """That of three rows ago in the middle between two and three; none is late where nothing is."""
    one = record(seconds=1.0)
    step = one.t[1] - one.t[0]
    changing = replace(one, command=np.random.default_rng(4).standard_normal((one.t.size, 4)))
    model = MODEL.reading_after(2.5 * step)
    late = model.vector({"command_delay.time": 2.2 * step})
    u = model.inputs(changing, late)
    np.testing.assert_allclose(u[3:-1, READ][:, :4], changing.command[:-4], atol=1e-9)
    assert np.array_equal(u[:, :N_INPUTS], MODEL.inputs(changing, late)[:, :N_INPUTS])
    assert np.array_equal(model.inputs(changing, LAMA.vector), MODEL.inputs(changing, LAMA.vector))


def test_drift_is_that_of_the_step_and_readings_are_those_of_their_own_input():
    """With effects that use the rotors' acceleration and the tilt."""
    vector = LAMA.with_effect("spin_up_reaction", gain=1.0).with_effect("hub_stiffness", lower=0.2)
    p, rng = vector.vector, np.random.default_rng(7)
    x = 0.05 * rng.standard_normal(N_FULL)
    x[16:18] = 205.0, 215.0
    step = dynamics.kernel_input(np.array([210.0, 220.0, 0.02, -0.01]))
    read = dynamics.kernel_input(np.array([214.0, 217.0, -0.03, 0.02]))
    work, both = np.zeros(MODEL.work_size), np.zeros(N_FULL + len(CHANNELS))
    flown, shown = np.zeros_like(both), np.zeros(len(CHANNELS))
    u = np.concatenate([step, read, [0.0, 0.0]])
    MODEL.drift_and_readings.__wrapped__(x, u, 0.01, p, work, both)
    dynamics.drift_and_readings(x, step, 0.01, p, work, flown)
    dynamics.measure(x, read, p, work, shown)
    assert np.array_equal(both, np.append(flown[:N_FULL], shown))


@pytest.mark.parametrize("lag", [0.0, 0.002, 0.03, 0.2, 50.0])
def test_rotors_whose_commands_rise_through_rows_turn_the_body_as_in_many_small_ones(lag):
    """Eight rows of 40 ms, with a lag or none, reaction and all, against 0.1 ms of a command held."""
    heli = LAMA.with_effect("spin_up_reaction", gain=1.0).with_effect(
        "motor_lag", upper=lag, lower=lag
    )
    model, p, rows = HeliModel(heli), heli.vector, 8
    rng = np.random.default_rng(2)
    t = 0.04 * np.arange(rows + 1)
    scatter = rng.normal(0.0, [8.0, 8.0, 0.0, 0.0], (rows + 1, 4))
    command = np.array([210.0, 215.0, 0.0, 0.0]) + scatter
    log = Record("ramps", t, command, np.full((rows + 1, len(CHANNELS)), np.nan), of_next=0.5)
    u, work = model.inputs(log, p), np.zeros(model.work_size)
    start = np.zeros(N_FULL)
    start[X["z"]], start[[X["omega_u"], X["omega_l"]]] = -2.0, command[0, :2]
    shown = {True: start.copy(), False: start.copy()}
    fine, parts = start.copy(), 400
    off = {True: [], False: []}  # yaw rate and heading, by whether rises are known
    for row in range(rows):
        between = np.linspace(command[row], command[row + 1], 2 * parts + 1)[1::2]
        for now in between:
            dynamics.step(fine, dynamics.kernel_input(now), 0.04 / parts, p, work, fine)
        for known, x in shown.items():
            flown = u[row] if known else np.concatenate([u[row, : RISE.start], [0.0, 0.0]])
            model.step.__wrapped__(x, flown, 0.04, p, work, x)
            off[known].append((x - fine)[[X["r"], X["psi"]]])
    rotors, last = [X["omega_u"], X["omega_l"]], np.abs(np.diff(between, axis=0)[0, :2]).max()
    np.testing.assert_allclose(shown[True][rotors], fine[rotors], rtol=0.0, atol=last)
    worst, before = (np.abs(off[known]).max(axis=0) for known in (True, False))
    assert worst[0] < 0.004 * before[0]
    assert worst[1] < 1e-3  # rad; as they are flown with means alone, too, without a lag


@pytest.mark.parametrize("lag", [0.0, 0.02, 3.0])
def test_the_drift_of_rotors_whose_commands_rise_is_the_steps(lag):
    """Exactly, and the state that it is asked of stays."""
    heli = LAMA.with_effect("motor_lag", upper=lag, lower=2.0 * lag)
    model = HeliModel(heli)
    p, work = heli.vector, np.zeros(model.work_size)
    x, after, drift = np.zeros(N_FULL), np.zeros(N_FULL), np.zeros(N_FULL + len(CHANNELS))
    x[[X["omega_u"], X["omega_l"]]] = 205.0, 215.0
    rise = np.array([3.0, -2.0])
    step, read = (
        dynamics.kernel_input(np.append(speeds, [0.0, 0.0]))
        for speeds in (np.array([210.0, 212.0]), np.array([207.0, 214.0]))
    )
    u, before = np.concatenate([step, read, rise]), x.copy()
    model.step.__wrapped__(x, u, 0.04, p, work, after)
    model.drift_and_readings.__wrapped__(x, u, 0.04, p, work, drift)
    rotors = [X["omega_u"], X["omega_l"]]
    np.testing.assert_allclose(x[rotors] + drift[rotors], after[rotors], rtol=1e-14)
    assert np.array_equal(x, before)
    if lag == 0.0:
        np.testing.assert_allclose(after[rotors], np.array([210.0, 212.0]) + rise, rtol=1e-14)


def test_a_command_that_has_long_been_held_is_itself_however_late():
    """In every row, in the last too, whose end the log does not show; before the log the first held."""
    late = LAMA.with_effect("servo_delay", time=0.033)
    one = record(seconds=1.0)
    held = Record("", one.t, one.command.copy(), one.z, one.origin)
    held.command[:20, 2:4] = 0.3, -0.2
    u = HeliModel(late).inputs(held, late.vector)
    np.testing.assert_allclose(u[:20, 2:4], held.command[:20, 2:4], atol=1e-12)
    np.testing.assert_allclose(u[23:, 2:4], held.command[23:, 2:4], atol=1e-12)


@pytest.mark.parametrize("gain", P.COMMAND_GAINS)
def test_an_input_innovation_corrects_its_states(gain):
    """Tilts: a pilot who pulls (lon > 0, tilts back) has seen the nose low, or a push forward."""
    taken = {  # state -> how it takes (upper, lower, lon, lat)
        "command_gain.rate_xy": {"p": (0, 0, 0, 1), "q": (0, 0, 1, 0)},
        "command_gain.moment_xy": {"gust_L": (0, 0, 0, 1), "gust_M": (0, 0, 1, 0)},
        "command_gain.force_xy": {"gust_X": (0, 0, 1, 0), "gust_Y": (0, 0, 0, -1)},
        "command_gain.rate_z": {"r": (1, -1, 0, 0)},
        "command_gain.moment_z": {"gust_N": (1, -1, 0, 0)},
        "command_gain.speed_z": {"w": (1, 1, 0, 0)},
        "command_gain.force_z": {"gust_Z": (1, 1, 0, 0)},
    }[gain]
    rng = np.random.default_rng(2)
    x, work, out = 0.1 * rng.standard_normal(N_FULL), np.zeros(dynamics.WORK_SIZE), np.zeros(N_FULL)
    x[16:18] = 210.0
    command, innovations = np.array([210.0, 220.0, 0.02, -0.01]), rng.standard_normal(4)
    vector = MODEL.vector({gain: 0.01})
    corrected = x.copy()
    for state, weights in taken.items():
        corrected[X[state]] += 0.01 * np.dot(weights, innovations)
    expected = np.zeros(N_FULL)
    dynamics.step(corrected, dynamics.kernel_input(command), 0.01, LAMA.vector, work, expected)
    both_halves = np.append(np.tile(dynamics.kernel_input(command), 2), [0.0, 0.0])
    u_with_innovations = np.append(both_halves, innovations)
    MODEL.step.__wrapped__(x, u_with_innovations, 0.01, vector, work, out)
    np.testing.assert_allclose(out, expected, rtol=1e-12, atol=1e-14)
    # the drift is the same to first order: the correction comes on top of what is flown
    both, flown = np.zeros((2, N_FULL + len(CHANNELS)))
    MODEL.drift_and_readings.__wrapped__(x, u_with_innovations, 0.01, vector, work, both)
    dynamics.drift_and_readings(x, dynamics.kernel_input(command), 0.01, LAMA.vector, work, flown)
    drift = both - flown
    np.testing.assert_allclose(drift[:N_FULL], corrected - x, rtol=1e-9, atol=1e-13)
    assert not drift[N_FULL:].any()
    # and who hears nothing flies the kernel's own step
    MODEL.step.__wrapped__(x, both_halves, 0.01, vector, work, out)
    dynamics.step(x, dynamics.kernel_input(command), 0.01, LAMA.vector, work, expected)
    assert np.array_equal(out, expected)


def test_a_fit_does_not_change_what_gusts_do():
    """The gusts' reference is the file's: a fitted mass must not change the acceleration allowed."""
    vector = MODEL.vector({"mass": 1.6, "inertia_xx": 1.0})
    assert vector[P.MASS] == 1.6
    for reference, own in P.GUST_REFERENCE.items():
        assert vector[reference] == LAMA.vector[own]


# --- where a search starts ------------------------------------------------------------------------


def a_flight(noise=None, **measured) -> Flight:
    n = len(next(iter(measured.values())))
    t = 0.01 * np.arange(n)
    run = Run("made up", t, np.tile([210.0, 225.0, 0.0, 0.0], (n, 1)), measured)
    return Flight("lama400d", (run,), noise=noise or {})


def test_a_sensors_std_is_found_under_a_smooth_motion():
    """Planted noise; the motion is smooth at 100 Hz, and a heading that turns on is no scatter."""
    rng = np.random.default_rng(3)
    t = 0.01 * np.arange(6000)
    noisy = 3.0 * np.sin(2.0 * t) + 0.05 * rng.standard_normal(t.size)
    psi = 1.5 * t + 0.02 * rng.standard_normal(t.size)
    flight = a_flight(h=noisy, psi=(psi + math.pi) % (2.0 * math.pi) - math.pi)
    assert sensor_std(flight, "h") == pytest.approx(0.05, rel=0.06)
    assert sensor_std(flight, "psi") == pytest.approx(0.02, rel=0.06)
    assert sensor_std(flight, "p") == LEAST_READING_STD["p"], "never measured"
    assert sensor_std(a_flight({"h": 0.3}, h=noisy), "h") == 0.3, "the card knows"


def test_readings_start_from_the_card_or_from_their_scatter():
    rng = np.random.default_rng(4)
    loud, still = 0.4 * rng.standard_normal(4000), np.zeros(4000)
    flight = a_flight({"az": 0.3}, ax=loud, ay=still, az=loud)
    reading = starting_noise(flight, LAMA).reading
    assert reading["ax"] == pytest.approx(0.4, rel=0.08)
    assert 0.0 < reading["ay"] < 0.01 * LEAST_READING_STD["ay"] and reading["az"] == 0.3
    shaken = starting_noise(flight, LAMA.with_effect("vibration", amplitude=0.4)).reading
    assert shaken["az"] == pytest.approx(math.sqrt(0.3**2 + 0.4**2 / 2.0)), "a sine's rms is on top"


def test_gusts_start_small_and_end_at_a_floor_below():
    noise = starting_noise(a_flight(h=np.zeros(10)), LAMA)
    weight = LAMA["mass"].value * LAMA["gravity"].value
    for name in GUST_LEVELS:
        size = weight * (LAMA["arm_upper"].value if "moment" in name else 1.0)
        assert 1e-3 * size < noise.process[name] < 0.05 * size
        assert 5e-5 * size < noise.floor[name] < 0.2 * noise.process[name]
    for gust, white in zip(GUST_LEVELS, WHITE_LEVELS, strict=True):
        assert noise.process[white] == noise.floor[white] < noise.floor[gust]
    for name in TRIM_LEVELS:
        assert noise.process[name] == noise.floor[name]


OTHER = LAMA.with_values(
    {"mass": 0.61, "arm_upper": 0.14, "rotor_radius": 0.3, "inertia_xx": 4e-3, "inertia_zz": 3e-3}
)


@pytest.mark.parametrize("vehicle", [LAMA, OTHER], ids=["lama", "other"])
def test_gusts_begin_as_shares_of_weight_and_end_as_accelerations(vehicle):
    """A hundredth of the weight, at the rotor's arm half of that and a third; floors in g, and g per
    radius."""
    noise = starting_noise(a_flight(h=np.zeros(10)), vehicle)
    own = vehicle.values()
    weight, arm = own["mass"] * own["gravity"], own["arm_upper"]
    for name, share in (("force_xy", 0.01), ("force_z", 0.01), ("moment_xy", 0.005 * arm),
                        ("moment_z", 0.003 * arm)):  # fmt: skip
        assert noise.process[name] == pytest.approx(share * weight), name
    spin = own["gravity"] / own["rotor_radius"]
    floor = {"force_xy": 5e-4 * weight, "force_z": 5e-4 * weight,
             "moment_xy": 2e-3 * spin * own["inertia_xx"],
             "moment_z": 1.5e-3 * spin * own["inertia_zz"]}  # fmt: skip
    for axes, least in floor.items():
        assert noise.floor[axes] == pytest.approx(least)
        assert noise.floor[f"white_{axes}"] == pytest.approx(0.1 * least)
        assert noise.ceiling[axes] == pytest.approx(1e4 * least)
        assert noise.floor[f"memory_{axes}"] == 0.015 and noise.ceiling[f"memory_{axes}"] == 20.0
    assert noise.floor["trim_force_z"] == pytest.approx(0.02 * floor["force_z"])
    assert noise.floor["trim_moment_z"] == pytest.approx(0.02 * floor["moment_z"])
    rotor = noise.process[ROTOR_LEVEL]
    speeds = dynamics.hover_trim(vehicle.with_values({"fuselage_drag_coefficient": 0.0}))[1][:2]
    assert rotor == pytest.approx(5e-4 * speeds.mean(), rel=1e-6)
    assert noise.floor[ROTOR_LEVEL] == pytest.approx(0.02 * rotor)
    assert noise.ceiling[ROTOR_LEVEL] == pytest.approx(50.0 * rotor)


def test_a_readings_std_may_be_twenty_times_off():
    """Under a prior of 0.7 in its logarithm where the card states it, else of 1.5."""
    noise = starting_noise(a_flight({"az": 0.3}, az=np.zeros(10), h=np.arange(10.0) % 3), LAMA)
    for channel, spread in (("az", 0.7), ("h", 1.5)):
        std = noise.reading[channel]
        assert noise.floor[channel] == pytest.approx(std / 20.0)
        assert noise.ceiling[channel] == pytest.approx(std * 20.0)
        assert noise.prior[channel] == (std, spread)


def test_a_steplike_sensors_std_is_at_least_that_of_its_steps():
    """Uniform over the least step between two readings: step / sqrt 12."""
    ramp = 0.5 * np.floor(np.arange(400) / 40.0)
    assert sensor_std(a_flight(h=ramp), "h") == pytest.approx(0.5 / math.sqrt(12.0))


def test_a_whole_turn_is_no_step_of_a_heading():
    """A heading in steps of 0.02 rad that crosses south and comes back: 2 pi is no multiple of them."""
    turning = 2.6 + np.sin(0.001 * np.arange(4000))
    heading = np.round(np.round((np.mod(turning + np.pi, 2.0 * np.pi) - np.pi) / 0.02) * 0.02, 2)
    assert np.ptp(heading) > 6.0
    assert sensor_std(a_flight(psi=heading), "psi") == pytest.approx(0.02 / math.sqrt(12.0))


def test_record_of_puts_every_channel_in_its_column():
    flight = a_flight(h=np.arange(10.0), q=-np.arange(10.0))
    found = record_of(flight.runs[0])
    assert np.array_equal(found.z[:, CHANNELS.index("h")], np.arange(10.0))
    assert np.array_equal(found.z[:, CHANNELS.index("q")], -np.arange(10.0))
    assert np.isfinite(found.z).sum() == 20
    assert found.origin == found.t[0]


def test_what_may_be_fitted_lies_within_its_bounds():
    base = {f.name: f for f in MODEL.base_parameters()}
    assert set(base) == {n for n, p in LAMA.parameters.items() if p.std > 0.0} - set(HELD)
    for name, free in base.items():
        own = LAMA[name]
        assert (free.value, free.std) == (own.value, own.std)
        assert free.lower < own.value - 5.0 * own.std and own.value + 5.0 * own.std < free.upper
        assert 0.2 < free.lower / own.value < 0.5 and 2.0 < free.upper / own.value < 5.0, (
            "no other machine: neither a fifth nor five times as much"
        )
    for name, entry in effects.CATALOGUE.items():
        for free, own in zip(MODEL.effect_parameters(name), entry.fitted, strict=True):
            assert own.lower <= free.lower <= own.off <= free.upper <= own.upper
            assert free.reading_only == (entry.stage == effects.SENSOR)
            farthest = MOST_USUAL_SIZES * own.usual
            assert free.upper - own.off == pytest.approx(min(farthest, own.upper - own.off))
            assert own.off - free.lower == pytest.approx(min(farthest, own.off - own.lower))
