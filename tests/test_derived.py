"""Readings that were computed from the logged poses are no sensors of their own."""

from collections import Counter

import numpy as np
import pytest
from scipy.signal import butter, lfilter, savgol_filter

from coax_env.logs.derived import derived, without_derived
from coax_env.logs.flight import Flight, Run, read_flight, write_flight
from coax_env.logs.repairs import Repaired

VELOCITIES, RATES = ["vn", "ve", "vd"], ["p", "q", "r"]
POSES = {"pn": 3e-4, "pe": 3e-4, "h": 5e-4, "phi": 2e-3, "theta": 2e-3, "psi": 1e-3}
"""Std of a motion capture's noise [m, rad]; ours."""
ROWS = 1200


def wave(t: np.ndarray, k: int) -> np.ndarray:
    """A motion of 0.3 and 0.9 Hz, of the k-th pose, and of the derivative where t is complex."""
    return 0.3 * np.sin(2.0 * np.pi * 0.3 * t + k) + 0.1 * np.sin(2.0 * np.pi * 0.9 * t + 2.0 * k)


def motion(t: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Poses without noise, and their slopes by a complex step."""
    poses = {c: wave(t, k) for k, c in enumerate(POSES)}
    return poses, {c: np.imag(wave(t + 1e-20j, k)) / 1e-20 for k, c in enumerate(POSES)}


def rates_of(poses, slopes) -> dict[str, np.ndarray]:
    """Gyros that turn the angles so fast, eq. (38)-(40) inverted."""
    phi, theta = poses["phi"], poses["theta"]
    roll, pitch, yaw = (slopes[c] for c in ("phi", "theta", "psi"))
    return {
        "p": roll - np.sin(theta) * yaw,
        "q": np.cos(phi) * pitch + np.sin(phi) * np.cos(theta) * yaw,
        "r": -np.sin(phi) * pitch + np.cos(phi) * np.cos(theta) * yaw,
    }


def clock(uneven: float, rng) -> np.ndarray:
    """Times of 150 Hz, the steps between which scatter."""
    return np.cumsum((1.0 + uneven * rng.uniform(-1.0, 1.0, ROWS)) / 150.0)


def noisy(values, std, rng) -> dict[str, np.ndarray]:
    return {c: x + std[c] * rng.standard_normal(x.size) for c, x in values.items()}


def by_differences(how: str, t: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """The slope of a pose as who prepares a log has it."""
    step = float(np.median(np.diff(t)))
    backward = np.append(0.0, np.diff(pose) / np.diff(t))
    if how == "central":
        return np.gradient(pose, t)
    if how == "backward":
        return backward
    if how == "savgol":
        return savgol_filter(pose, 15, 2, deriv=1, delta=step)
    return lfilter(*butter(2, 10.0, fs=1.0 / step), backward)


def computed(how: str, uneven: float, seed: int) -> Repaired:
    rng = np.random.default_rng(seed)
    t = clock(uneven, rng)
    poses = noisy(motion(t)[0], POSES, rng)
    slopes = {c: by_differences(how, t, pose) for c, pose in poses.items()}
    return logged(t, poses, slopes)


def logged(t, poses, slopes) -> Repaired:
    velocities = {"vn": slopes["pn"], "ve": slopes["pe"], "vd": -slopes["h"]}
    return Repaired(t, np.zeros((t.size, 4)), poses | velocities | rates_of(poses, slopes), None)


@pytest.mark.parametrize("uneven", [0.0, 0.2])
@pytest.mark.parametrize("how", ["central", "backward", "savgol", "low-pass"])
def test_what_was_computed_from_poses_is_seen(how, uneven):
    """By any filter, on a clock as even as it may be; a heading that was wrapped turns no less."""
    runs = [computed(how, uneven, seed) for seed in (1, 2)]
    assert list(derived(runs)) == [*VELOCITIES, *RATES]
    counts: Counter[str] = Counter()
    left = without_derived(runs, counts, {"vn": True})
    assert all(list(run.measured) == list(POSES) for run in left)
    assert set(counts) == {
        "vn, ve and vd computed from the logged positions, left out",
        "p, q and r computed from the logged attitudes, left out",
    }
    assert all(number == 6 * ROWS for number in counts.values())


@pytest.mark.parametrize("noise", [0.3, 0.003])
def test_sensors_of_their_own_stay(noise):
    """Noisier than the poses' differences, and far less noisy: both see the same motion."""
    runs = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        t = clock(0.1, rng)
        poses, slopes = motion(t)
        own = noisy(slopes, dict.fromkeys(POSES, noise), rng)
        runs.append(logged(t, noisy(poses, POSES, rng), own))
    counts: Counter[str] = Counter()
    assert derived(runs) == {}
    assert without_derived(runs, counts, {}) == runs and not counts


def test_the_card_may_say_that_each_value_is_a_reading():
    counts: Counter[str] = Counter()
    (left,) = without_derived([computed("central", 0.0, 8)], counts, {"ve": False, "h": False})
    assert list(left.measured) == [*POSES, "ve"]


def test_one_velocity_alone_is_left_out():
    """Of a sonar's height; the others are an optical flow's, the rates gyros'."""
    rng = np.random.default_rng(3)
    t = clock(0.1, rng)
    poses, slopes = motion(t)
    own = noisy(slopes, dict.fromkeys(POSES, 0.02), rng)
    poses = noisy(poses, POSES, rng)
    own["h"] = by_differences("central", t, poses["h"])
    assert derived([logged(t, poses, own)]) == {"vd": "h"}


@pytest.mark.parametrize("rule", ["begins", "trapezoid"])
def test_attitudes_that_the_gyros_carry_are_the_ones_computed(rule):
    """Their noise is the gyros', summed: the gyros are the sensors, and stay."""
    rng = np.random.default_rng(4)
    t = np.arange(6 * ROWS) / 150.0
    poses, slopes = motion(t)
    gyros = noisy(slopes, dict.fromkeys(POSES, 0.03), rng)
    read = noisy(poses, POSES, rng)
    for angle in ("phi", "theta", "psi"):
        rate = gyros[angle]
        mean = rate[:-1] if rule == "begins" else 0.5 * (rate[1:] + rate[:-1])
        read[angle] = np.append(0.0, np.cumsum(mean) / 150.0)
    assert derived([logged(t, read, gyros)]) == {}


@pytest.mark.parametrize("rows", [20, 100])
def test_too_little_to_say(rows):
    """And nothing at all: runs without poses, or without a reading beside them."""
    run = computed("central", 0.0, 5)
    short = Repaired(
        run.t[:rows], run.command[:rows], {c: v[:rows] for c, v in run.measured.items()}, None
    )
    empty = Repaired(run.t, run.command, {c: np.full(ROWS, np.nan) for c in run.measured}, None)
    bare = Repaired(run.t, run.command, {}, None)
    still = Repaired(run.t, run.command, {c: np.zeros(ROWS) for c in run.measured}, None)
    stuck = Repaired(run.t, run.command, {**run.measured, "vn": np.zeros(ROWS)}, None)
    assert derived([still]) == {} and "vn" not in derived([stuck])
    assert derived([short]) == derived([empty]) == derived([bare]) == derived([]) == {}


def test_poses_with_holes_are_asked_around_them():
    run = computed("savgol", 0.0, 6)
    for channel in ("pn", "phi"):
        run.measured[channel][200:1100:90] = np.nan
    gone = np.r_[0:500, 520:ROWS]  # and rows that are not in the log
    cut = Repaired(
        run.t[gone], run.command[gone], {c: v[gone] for c, v in run.measured.items()}, None
    )
    assert list(derived([cut])) == [*VELOCITIES, *RATES]


def test_poses_that_were_set_anew_afterwards_are_asked_beside_their_jumps():
    """By 0.3 m and 1 rad: a few slopes of 50 m/s would be all that weights are fitted to."""
    run = computed("savgol", 0.1, 9)
    for channel in POSES:
        run.measured[channel][400:] += 0.3
        run.measured[channel][900:] -= 1.0
    assert list(derived([run])) == [*VELOCITIES, *RATES]


def test_a_flight_is_read_without_them(tmp_path):
    """And says so; slower ones, in every third row of the poses, too."""
    run = computed("savgol", 0.0, 7)
    measured = {c: v.copy() for c, v in run.measured.items()}
    for channel in VELOCITIES:
        measured[channel][np.arange(ROWS) % 3 != 0] = np.nan
    command = np.tile([210.0, 230.0, 0.0, 0.0], (ROWS, 1))
    write_flight(Flight("skybotix_coax", (Run("a", run.t, command, measured),)), tmp_path / "f")
    flight = read_flight(tmp_path / "f")
    assert flight.channels == ("phi", "theta", "psi", "h", "pn", "pe")
    assert any(
        note.startswith("vn, ve and vd computed from the logged positions") for note in flight.notes
    )
