"""A line at rotor speed, planted by hand: what it is worth is known without the code."""

import math
from dataclasses import replace

import injector
import numpy as np
import pytest
from csv_edits import Table, rewrite
from scipy.stats import ncx2

from coax_env import diagnose, identify, load_vehicle
from coax_env.estimation import order_tracking, vibration
from coax_env.logs.flight import Flight, Run

SPEEDS = {"upper": 209.0, "lower": 224.0}  # rad/s: 33.3 and 35.7 Hz
SIGMA = 0.1  # m/s2


def shaken(
    amplitudes: dict[str, float],
    rotor: str = "upper",
    seed: int = 0,
    seconds: int = 40,
    rate: float = 100.0,
    drift: float = 0.0,
    measured_speed: bool = True,
    off: float = 0.0,
) -> Flight:
    """White accelerometers on a slow motion, a sine of the rotor's azimuth in some of them.

    Args:
        amplitudes: of the sine by channel [m/s2]; every channel has a phase of its own.
        drift: of the rotor speeds [rad/s2], seen by the encoders only.
        off: by which the sine misses the rotor's frequency [Hz].
    """
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate)) / rate
    azimuth = (SPEEDS[rotor] + 2.0 * np.pi * off) * t + 0.5 * drift * t**2
    measured = {}
    for i, channel in enumerate(("ax", "ay", "az")):
        motion = 0.5 * np.sin(0.7 * t + i) - 9.8 * (channel == "az")
        line = amplitudes.get(channel, 0.0) * np.sin(azimuth + 1.3 * i)
        measured[channel] = motion + line + SIGMA * rng.standard_normal(t.size)
    if measured_speed:
        for name, speed in SPEEDS.items():
            measured[f"rpm_{name}"] = (speed + drift * t) * 30.0 / math.pi
    command = np.tile([*SPEEDS.values(), 0.0, 0.0], (t.size, 1))
    return Flight("lama400d", (Run("made up", t, command, measured),))


ALL = dict.fromkeys(("ax", "ay", "az"), 0.25)


def line_of(flight: Flight, rotor: str, order: int = 1) -> vibration.Line:
    """Of the accelerometers, at a multiple of a rotor's speed as measured, however weak."""
    found = vibration._lines_at(flight, rotor, 1.0, {"amplitude"})
    return next(line for line in found if line.order == order)


@pytest.mark.parametrize("rotor", ["upper", "lower"])
@pytest.mark.parametrize("rate", [100.0, 80.0, 27.0])
def test_the_planted_line_is_found_at_its_rotor(rotor, rate):
    """At 80 Hz nearly at half the rate, at 27 Hz as an alias."""
    (line,) = vibration.find(shaken(ALL, rotor, rate=rate))
    assert line is not None and line.rotor == rotor
    assert abs(line.amplitude - 0.25) < 3.0 * line.std < 0.05
    assert set(line.channels) == {"ax", "ay", "az"}


def test_the_amplitude_is_the_root_mean_square_over_the_axes_and_the_strongest_comes_first():
    (line,) = vibration.find(shaken({"ax": 0.2, "ay": 0.5}))
    assert line.amplitude == pytest.approx(math.sqrt((0.2**2 + 0.5**2) / 3.0), rel=0.05)
    assert line.channels == ("ay", "ax")


def test_it_is_followed_where_the_rotor_speeds_up():
    """A rotor that gains a revolution a second in forty seconds; the commands alone do not know."""
    (found,) = vibration.find(shaken(ALL, drift=0.15))
    assert found.amplitude == pytest.approx(0.25, rel=0.05)
    (steady,) = vibration.find(shaken(ALL, measured_speed=False))
    assert steady.amplitude == pytest.approx(0.25, rel=0.05)


def test_the_evidence_is_that_of_the_power_over_its_neighbours():
    """A sine of amplitude A in n readings of noise s: power A^2 n/2 + 2 s^2, neighbours 2 s^2.

    Log-likelihood of exponential powers whose mean is F and not 1: F - 1 - log F each.
    """
    amplitude, n = 0.06, 100
    F = 1.0 + amplitude**2 * n / (4.0 * SIGMA**2)
    expected = 3 * 40 * (F - 1.0 - math.log(F))
    evidence = [
        line_of(shaken(dict.fromkeys(ALL, amplitude), seed=seed), "upper").evidence
        for seed in range(6)
    ]
    assert np.mean(evidence) == pytest.approx(expected, rel=0.12)


def test_a_second_that_is_off_is_no_line():
    """Ten times as loud at the rotor's speed as a line of usual size, in one second of forty."""
    flight = shaken({})
    (run,) = flight.runs
    one = (run.t >= 12.0) & (run.t < 13.0)
    burst = 2.5 * one * np.sin(SPEEDS["upper"] * run.t)
    run = replace(run, measured=run.measured | {"ax": run.measured["ax"] + burst})
    line = line_of(replace(flight, runs=(run,)), "upper")
    assert line.evidence > 100.0 and line.amplitude > 0.1 and line.steady < 3.0
    assert vibration.find(replace(flight, runs=(run,))) == ()


def test_a_line_is_worth_as_much_by_its_median_second():
    """Of one channel: of a line as strong as noise is the median of noncentral chi-square."""
    lines = [line_of(shaken({"ay": 0.25}, seed=seed), "upper") for seed in range(6)]
    F = 1.0 + 0.25**2 * 100 / (4.0 * SIGMA**2)
    middle = ncx2.median(2, 2.0 * (F - 1.0)) / (2.0 * math.log(2.0))
    expected = 40 * (middle - 1.0 - math.log(middle))
    assert np.mean([line.steady for line in lines]) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("turns", [49.6, 49.2, 46.0])
def test_poses_show_no_line_nearly_at_half_their_rate(turns):
    """Of 100 a second: less than a turn in a second before it, a sine is hardly read."""
    flight = shaken({}, seconds=10)
    (run,) = flight.runs
    speed = np.full_like(run.command, 2.0 * np.pi * turns)
    measured = {"h": 1e-3 * np.random.default_rng(1).standard_normal(run.t.size)}
    run = replace(run, command=speed, measured=measured)
    (part,) = order_tracking.parts(run, ["h"])
    shown = order_tracking.Turning(run, "upper", 1.0).shows(part, 1, vibration.MOTION["heave"])
    assert shown.size == 10 and set(shown) == {turns < 48.0}


def test_a_clock_that_starts_late_changes_nothing():
    """Segments are seconds of a run, not of a clock."""
    flight = shaken(ALL, seconds=10)
    late = replace(flight, runs=tuple(replace(run, t=run.t + 40.375) for run in flight.runs))
    first, shifted = line_of(flight, "upper"), line_of(late, "upper")
    assert shifted.amplitude == pytest.approx(first.amplitude, rel=1e-9)
    assert shifted.evidence == pytest.approx(first.evidence, rel=1e-9)


def test_the_std_is_the_scatter():
    """Over flights, without what is allowed for the smearing of the phase."""
    lines = [line_of(shaken(ALL, seed=seed, seconds=10), "upper") for seed in range(40)]
    own = [math.sqrt(line.std**2 - (vibration.SMEAR * line.amplitude) ** 2) for line in lines]
    assert np.std([line.amplitude for line in lines]) == pytest.approx(np.mean(own), rel=0.3)
    assert np.mean([line.amplitude for line in lines]) == pytest.approx(0.25, rel=0.01)


def test_noise_adds_nothing_to_a_weak_lines_amplitude():
    """What white noise makes at the rotor's frequency it makes beside it too: squares are unbiased."""
    weak = dict.fromkeys(ALL, 0.04)
    lines = [line_of(shaken(weak, seed=seed, seconds=20), "upper") for seed in range(30)]
    assert np.mean([line.amplitude**2 for line in lines]) == pytest.approx(0.04**2, rel=0.1)


@pytest.mark.parametrize("off", [0.8, 1.0, -2.5, 4.0])
def test_what_shakes_beside_the_rotor_is_no_line_of_it(off):
    assert vibration.find(shaken(ALL, off=off)) == ()


def test_the_other_rotors_line_is_no_neighbour():
    """Both rotors shake, 2.4 Hz apart: the other's line costs only what leaks of it into one second."""
    both = shaken(ALL)
    for i, channel in enumerate(ALL):
        lower = 0.25 * np.sin(SPEEDS["lower"] * both.runs[0].t + 0.4 * i)
        both.runs[0].measured[channel] += lower
    clean = line_of(shaken(ALL), "upper").evidence
    assert line_of(both, "upper").evidence > 0.3 * clean


def test_a_vehicle_without_its_vibration_keeps_all_else():
    vehicle = load_vehicle("lama400d").with_effect("gyro_bias", x=0.01)
    shaking = vehicle.with_effect("vibration", amplitude=0.3)
    assert vibration.without(shaking).effects == vehicle.effects
    assert vibration.without(shaking).parameters == vehicle.parameters


def test_noise_is_no_line_and_a_small_line_is_taken_out_but_not_named():
    for seed in range(10):
        assert vibration.find(shaken({}, seed=seed)) == ()
    weak = shaken(dict.fromkeys(ALL, 0.5 * smallest()), seconds=120)
    lines = vibration.find(weak)
    assert [line.place for line in lines] == [("amplitude", "upper", 1)]
    assert vibration.large(lines) == {}
    assert vibration.find(vibration.taken_out(weak, lines)) == ()


def smallest() -> float:
    return vibration.CATALOGUE["vibration"].parameters[0].smallest


@pytest.mark.parametrize(("wanders", "seconds"), [(0.0, 32.0), (1.0, 1.0)])
def test_taking_it_out_leaves_the_motion_and_the_noise(wanders, seconds):
    """Sine and cosine take two readings' worth of noise in all the time for which a phase holds.

    A speed that is measured well holds it for the whole run; where it wanders a radian in a second, it
    is fitted anew in each.
    """
    quiet = shaken({})
    (run,) = quiet.runs
    rng = np.random.default_rng(3)
    phase = np.repeat(np.cumsum(wanders * rng.standard_normal(40)), 100)
    line = 0.25 * np.sin(SPEEDS["upper"] * run.t + phase)
    measured = {c: z + line * (c in ALL) for c, z in run.measured.items()}
    flight = replace(quiet, runs=(replace(run, measured=measured),))
    left = vibration.taken_out(flight, vibration.find(flight)).runs[0].measured
    for channel in ALL:
        rest = left[channel] - run.measured[channel]
        expected = SIGMA * math.sqrt(2.0 / (100.0 * seconds))
        assert rest.std() == pytest.approx(expected, rel=0.2 if wanders else 0.8)
    assert np.array_equal(left["rpm_upper"], run.measured["rpm_upper"])


def test_of_a_weak_line_a_share_is_taken_out():
    """Half as strong as the noise at its frequency, its phase anew in each second: what is taken out is
    nearer to it than nothing, and than all that is fitted there."""
    rng = np.random.default_rng(6)
    t = np.arange(20000) / 100.0
    phase = np.repeat(rng.uniform(0.0, 2.0 * np.pi, 200), 100)
    line = SIGMA * math.sqrt(0.5 * 4.0 / 100.0) * np.sin(SPEEDS["upper"] * t + phase)
    y = line + SIGMA * rng.standard_normal(t.size)
    command = np.tile([*SPEEDS.values(), 0.0, 0.0], (t.size, 1))
    run = Run("made up", t, command, {"ax": y})
    turning = order_tracking.Turning(run, "upper", 1.0)
    some = list(order_tracking.parts(run, ["ax"]))
    angles = [[turning.angle(part, 1, 5.0)] for part in some]
    taken = np.concatenate(
        [x[:, 0].ravel() for x in order_tracking.fitted(some, angles, np.array([SIGMA**2]))]
    )
    whole = np.concatenate([
        (part.products(waves)[1] @ np.linalg.inv(part.products(waves)[0]) @ waves)[:, 0].ravel()
        for part, own in zip(some, angles, strict=True)
        for waves in [part.waves(own)]
    ])  # fmt: skip
    off = np.mean((taken - line) ** 2)
    assert off < 0.8 * np.mean(line**2) and off < 0.5 * np.mean((whole - line) ** 2)


SOURCES = {("upper", 1): 0.4, ("upper", 2): 0.3, ("lower", 1): 0.25, ("lower", 2): 0.5}
"""Amplitude by rotor and times a turn [m/s2]; twice a turn is 66.5 and 71.3 Hz, read at 90 Hz."""


@pytest.mark.slow
@pytest.mark.parametrize("measured_speed", [True, False])
@pytest.mark.parametrize("without", [None, ("upper", 1), ("lower", 2)])
def test_both_rotors_shake_once_and_twice_a_turn(without, measured_speed):
    """Each line is found at its size, no other is, and all are taken out together."""
    planted = {source: size for source, size in SOURCES.items() if source != without}
    drift = 0.15 * measured_speed
    quiet = shaken({}, rate=90.0, drift=drift, measured_speed=measured_speed)
    (run,) = quiet.runs
    t = run.t
    measured = dict(run.measured)
    for k, ((rotor, order), size) in enumerate(planted.items()):
        azimuth = SPEEDS[rotor] * t + 0.5 * drift * t**2
        for i, channel in enumerate(ALL):
            measured[channel] = measured[channel] + size * np.sin(order * azimuth + k + 1.3 * i)
    flight = replace(quiet, runs=(replace(run, measured=measured),))
    lines = vibration.find(flight)
    assert {line.place[1:] for line in lines} == set(planted)
    for line in lines:
        size = planted[line.rotor, line.order]
        assert abs(line.amplitude - size) < 3.0 * line.std < 0.1 * size
    (amplitude, std), *_ = vibration.large(lines).values()
    every = math.sqrt(sum(size**2 for size in planted.values()))
    assert abs(amplitude - every) < 3.0 * std < 0.1 * every
    left = vibration.taken_out(flight, lines).runs[0].measured
    for channel in ALL:
        assert np.std(left[channel] - run.measured[channel]) < 0.5 * SIGMA


def test_an_alias_among_the_motion_is_no_line():
    """Three times a turn at 99.8 Hz, read at 100 Hz, would be 0.2 Hz: gusts are that, steady as they
    are; a gyro's alias counts from 10 Hz on."""
    rng = np.random.default_rng(2)
    t = np.arange(6000) / 100.0
    motion = np.cumsum(rng.standard_normal((6, t.size)), axis=1) * 0.05
    command = np.tile([*SPEEDS.values(), 0.0, 0.0], (t.size, 1))
    channels = ("ax", "ay", "az", "p", "q", "r")
    measured = dict(zip(channels, motion + 0.05 * rng.standard_normal(motion.shape), strict=True))
    for rotor, speed in SPEEDS.items():
        measured[f"rpm_{rotor}"] = np.full(t.size, speed * 30.0 / math.pi)
    run = Run("made up", t, command, measured)
    assert vibration.find(Flight("lama400d", (run,))) == ()
    (part,) = order_tracking.parts(run, channels)
    rotor = order_tracking.Turning(run, "upper", 1.0)
    assert {k: bool(rotor.shows(part, k, 5.0).all()) for k in vibration.ORDERS} == {
        1: True, 2: True, 3: False, 4: True,
    }  # fmt: skip
    rotor = order_tracking.Turning(run, "lower", 1.0)  # 107 Hz: read as 7 Hz
    assert rotor.shows(part, 3, 5.0).all() and not rotor.shows(part, 3, 10.0).any()


def test_powers_are_what_sines_explain_beyond_a_cubic():
    """By least squares with and without the sine, in uneven rows."""
    rng = np.random.default_rng(4)
    t = np.sort(rng.uniform(0.0, 1.0, 60))
    azimuth = 209.0 * t + 3.0 * t**2
    y = rng.standard_normal((2, 60))
    part = order_tracking.Part(
        ("ax", "ay"), np.zeros(1), np.arange(60)[None], t[None] - 0.5, y[None]
    )
    powers = part.powers(azimuth[None], (1, 2))[0]
    cubic = np.vander(t, 4)

    def left(columns: np.ndarray, of: np.ndarray) -> float:
        rest = of - columns @ np.linalg.lstsq(columns, of, rcond=None)[0]
        return float(rest @ rest)

    for c in range(2):
        for o, order in enumerate((1, 2)):
            for f, beside in enumerate(order_tracking.BESIDE):
                angle = order * azimuth + 2.0 * np.pi * beside * t
                wave = np.column_stack([cubic, np.sin(angle), np.cos(angle)])
                expected = left(cubic, y[c]) - left(wave, y[c])
                assert powers[c, o, f] == pytest.approx(expected, rel=1e-6)


def test_at_half_the_rate_a_sine_is_one_wave_and_a_turn_a_reading_is_none():
    """Where cosine and sine are alike the power is that of one of them; what is trend has none."""
    t = np.arange(100) / 100.0
    rng = np.random.default_rng(5)
    y = rng.standard_normal(100)
    part = order_tracking.Part(
        ("ax",), np.zeros(1), np.arange(100)[None], t[None] - 0.5, y[None, None]
    )
    trend = np.linalg.qr(np.vander(t, 4))[0]
    y = y - trend @ (trend.T @ y)
    wave = np.cos(np.pi * np.arange(100))
    wave -= trend @ (trend.T @ wave)
    azimuth = np.pi * np.arange(100.0)
    powers = part.powers(azimuth[None], (1, 2))[0, 0]
    assert powers[0, 0] == pytest.approx((wave @ y) ** 2 / (wave @ wave), rel=1e-6)
    assert powers[1, 0] == pytest.approx(0.0, abs=1e-12)
    as_sine = part.powers(azimuth[None] + 0.5 * np.pi, (1,))[0, 0]
    assert as_sine[0, 0] == pytest.approx(powers[0, 0], rel=1e-6)


def test_no_line_without_accelerometers():
    flight = shaken(ALL)
    bare = {c: z for c, z in flight.runs[0].measured.items() if c.startswith("rpm")}
    run = Run("made up", flight.runs[0].t, flight.runs[0].command, bare)
    assert vibration.find(Flight("lama400d", (run,))) == ()


@pytest.mark.parametrize(
    "slip",
    [pytest.param(0.992, marks=pytest.mark.slow), 1.0, pytest.param(1.01, marks=pytest.mark.slow)],
)
def test_a_tracked_pose_that_shakes_is_calmed(slip):
    """Roll, pitch and height of a motion capture, the speed commanded alone and a little off."""
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(0.8, 1.2, 6000)) / 150.0
    command = np.tile([216.0, 232.0, 0.0, 0.0], (t.size, 1))
    command[:, 0] += 4.0 * np.sin(0.5 * t)
    azimuth = np.concatenate([[0.0], np.cumsum(slip * command[:-1, 0] * np.diff(t))])
    sizes = {"phi": 2e-3, "theta": 2e-3, "h": 2e-4, "psi": 0.0}
    calm = {c: 0.05 * np.sin(2.0 * t + i) for i, c in enumerate(sizes)}
    noise = {c: 2e-4 if c != "h" else 5e-5 for c in sizes}
    measured = {
        c: calm[c] + size * np.sin(azimuth + i) + noise[c] * rng.standard_normal(t.size)
        for i, (c, size) in enumerate(sizes.items())
    }
    flight = Flight("lama400d", (Run("hover", t, command, measured),))
    lines = vibration.find(flight)
    assert {line.kind: line.rotor for line in lines} == {"tilt": "upper", "heave": "upper"}
    for line in lines:
        size = {"tilt": 2e-3, "heave": 2e-4}[line.kind]
        assert line.amplitude == pytest.approx(size, rel=0.05)
        assert line.slip == pytest.approx(slip, abs=0.003)
    left = vibration.taken_out(flight, lines).runs[0].measured
    for c in sizes:
        assert np.std(left[c] - calm[c]) < 1.3 * noise[c] + 0.1 * sizes[c], c


def test_a_pose_read_less_than_twice_a_turn_is_only_motion():
    """A motion of 8.3 Hz is the alias of 33.3 Hz at 25 Hz: in a pose it is what it looks like."""
    t = np.arange(1000) / 25.0
    rng = np.random.default_rng(0)
    alias = SPEEDS["upper"] - 2.0 * np.pi * 25.0
    phi = 0.01 * np.sin(alias * t) + 1e-3 * rng.standard_normal(t.size)
    command = np.tile([*SPEEDS.values(), 0.0, 0.0], (t.size, 1))
    flight = Flight("lama400d", (Run("made up", t, command, {"phi": phi}),))
    assert vibration.find(flight) == ()
    shaken_by_it = Flight("lama400d", (Run("made up", t, command, {"ax": phi / 0.01}),))
    assert [line.kind for line in vibration.find(shaken_by_it)] == ["amplitude"]


def shaking(table: Table) -> None:
    """Both rotors shake accelerometers and gyros once and twice a turn, at what the encoders say."""
    t = np.array(table["t"], float)
    for k, ((rotor, order), size) in enumerate(SOURCES.items()):
        rpm = np.array([float(cell or "nan") for cell in table[f"rpm_{rotor}"]])
        read = np.isfinite(rpm)
        speed = np.interp(t, t[read], rpm[read]) * math.pi / 30.0
        azimuth = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.diff(t))])
        for i, channel in enumerate(("ax", "ay", "az", "p", "q", "r")):
            share = 1.0 if channel.startswith("a") else 0.1
            wave = share * size * np.sin(order * azimuth + k + 1.3 * i)
            table[channel] = [
                f"{float(cell) + more:.5f}" if cell else cell
                for cell, more in zip(table[channel], wave, strict=True)
            ]


@pytest.mark.slow
def test_what_is_hidden_beside_rotors_that_shake_is_found(tmp_path):
    """With one line of one rotor taken out all inertial sensors stayed coloured (**synthetic**).

    At 100 rows a second what the upper rotor shakes twice a turn lies where once a turn does: of the
    sizes a tenth is missing there.
    """
    hidden = {"servo_lag": {"time": 0.06}}
    runs = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
    injector.fly(tmp_path, hidden, gusts=True, runs=runs, seed=9, longest=9.0)
    rewrite(tmp_path.glob("*.csv"), shaking)
    findings = diagnose(tmp_path, hold_out=[]).findings
    assert {cause["effect"] for cause in findings["causes"]} == {"vibration", *hidden}
    assert findings["verdict"] == "explained"
    found = next(c["parameters"] for c in findings["causes"] if c["effect"] == "vibration")
    every = math.sqrt(sum(size**2 for size in SOURCES.values()))
    assert found["vibration.amplitude"]["value"] == pytest.approx(every, rel=0.15)
    assert found["vibration.rate"]["value"] == pytest.approx(0.1 * every, rel=0.15)


@pytest.mark.slow
def test_what_shakes_moves_no_number_of_the_vehicle(tmp_path):
    """`identify` from the same flight, as it was and with both rotors shaking (**synthetic**)."""
    injector.fly(tmp_path, {}, gusts=True, runs=("lon_3211", "heave_3211"), seed=10, longest=9.0)
    still = identify(tmp_path)
    rewrite(tmp_path.glob("*.csv"), shaking)
    shaken_so = identify(tmp_path)
    assert any(remark.startswith("the body shakes") for remark in shaken_so.remarks)
    for name in still.fitted:
        before, after = still.after[name], shaken_so.after[name]
        assert abs(after.value - before.value) < 0.2 * before.std
        assert after.std == pytest.approx(before.std, rel=0.1)
