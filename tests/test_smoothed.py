"""Readings that software has smoothed are read as often as they say something new."""

from collections import Counter
from types import SimpleNamespace

import injector
import numpy as np
import pytest
from injector_air import GUSTY
from injector_craft import COAX
from scipy.signal import butter, filtfilt, lfilter

from coax_env import diagnose
from coax_env.diagnosis.confounding import alike_by_poses_alone
from coax_env.diagnosis.problem import Problem
from coax_env.diagnosis.settings import SETTINGS
from coax_env.logs.flight import read_flight
from coax_env.logs.repairs import Repaired
from coax_env.logs.smoothed import read_apart, steepness
from coax_env.model.layout import CHANNELS

RNG = np.random.default_rng(4)
T = 0.01 * np.arange(3000)
WHITE = RNG.standard_normal(T.size)
MOTION = np.sin(0.6 * T) + 0.2 * np.sin(5.0 * T + 1.0)


def run_of(t: np.ndarray = T, **measured: np.ndarray) -> Repaired:
    return Repaired(t, np.zeros((t.size, 4)), measured, None)


def kept(run: Repaired, channel: str, holds: dict[str, bool] | None = None) -> int:
    """Readings of which one is kept, with the count that is said."""
    counts: Counter[str] = Counter()
    (found,) = read_apart([run], counts, holds or {})
    left = int(np.isfinite(found.measured[channel]).sum())
    gone = int(np.isfinite(run.measured[channel]).sum()) - left
    assert sum(counts.values()) == gone and bool(counts) == (gone > 0)
    read = np.isfinite(found.measured[channel])
    assert np.array_equal(found.measured[channel][read], run.measured[channel][read])
    return round(run.t.size / left)


@pytest.mark.parametrize(("cut_off", "rows"), [(7.0, (5, 8)), (10.0, (4, 6)), (20.0, (2, 3))])
def test_as_seldom_as_the_cut_off_asks(cut_off, rows):
    """Of a low-pass at f readings 1 / 2f apart are nearly each its own: 7, 5 and 2.5 rows."""
    b, a = butter(2, cut_off, fs=100.0)
    for smooth in (filtfilt(b, a, WHITE), lfilter(*butter(4, cut_off, fs=100.0), WHITE)):
        assert rows[0] <= kept(run_of(theta=MOTION + 0.01 * smooth), "theta") <= rows[1]


def test_where_motion_is_louder_than_noise_below_the_cut_off():
    """Pushes make it steep at any distance, ten times, and less so than a low-pass does."""
    pushed = 0.05 * T[1] * np.cumsum(np.cumsum(RNG.standard_normal(T.size)) * 0.01)
    pushed += 5e-5 * RNG.standard_normal(T.size)
    smooth = filtfilt(*butter(2, 7.0, fs=100.0), pushed) + 1e-7 * WHITE
    assert 4 <= kept(run_of(phi=smooth), "phi") <= 8


@pytest.mark.parametrize(("cut_off", "loud"), [(6.0, 1e-3), (10.0, 3e-4)])
def test_a_fast_log_is_read_as_seldom_as_its_cut_off_asks_though_its_last_digit_is_white(
    cut_off, loud
):
    """At 240 Hz two rows apart are flat by rounding alone: 1 / 2f is 20 and 12 rows."""
    fast = np.arange(12_000) / 240.0
    noise = filtfilt(
        *butter(2, cut_off, fs=240.0), np.random.default_rng(6).standard_normal(fast.size)
    )
    smooth = np.sin(0.6 * fast) + 0.2 * np.sin(5.0 * fast + 1.0) + loud * noise
    rounded = run_of(fast, theta=np.round(smooth, 5))
    assert steepness([rounded.measured["theta"]], 2) < 2.5, "which is what hides it"
    assert 90.0 / cut_off <= kept(rounded, "theta") <= 180.0 / cut_off


def test_motion_that_swings_is_no_smoothing():
    """A heading that a stabiliser has swing at 5.5 Hz, read at 50 Hz: two rows apart that is the middle
    band, and 150 times as dense."""
    slow = T[::2]
    swings = 0.3 * np.sin(2.0 * np.pi * 5.5 * slow + 0.8 * np.sin(3.0 * slow))
    heading = run_of(slow, psi=swings + 0.013 * WHITE[::2])
    assert steepness([heading.measured["psi"]], 2) > 40.0
    assert kept(heading, "psi") == 1


@pytest.mark.parametrize(
    "values",
    [
        MOTION + 0.01 * WHITE,  # a sensor's
        MOTION,  # none
        MOTION + 1e-5 * np.round(100.0 * WHITE),  # in steps
        MOTION + 0.01 * lfilter([0.4], [1.0, -0.6], WHITE),  # lasts, and is not smooth
        np.cumsum(np.cumsum(WHITE)) * 1e-5,  # moves as white pushes do, without noise
        np.cumsum(np.cumsum(lfilter([0.02], [1.0, -0.98], WHITE))) * 1e-4,  # as gusts do
    ],
)
def test_others_stay_as_they_are(values):
    assert kept(run_of(h=values), "h") == 1


@pytest.mark.parametrize("uneven", [0.05, 0.2])
def test_software_smooths_from_reading_to_reading_however_uneven_its_clock(uneven):
    """Rows lost and outliers, too; what moves on such a clock and is not smoothed stays."""
    rng = np.random.default_rng(int(100 * uneven))
    t = T + np.clip(uneven * 0.01 * rng.standard_normal(T.size), -0.0045, 0.0045)
    motion = np.sin(0.6 * t) + 0.2 * np.sin(5.0 * t + 1.0)
    smooth = filtfilt(*butter(2, 10.0, fs=100.0), motion + 0.01 * WHITE)
    smooth[rng.random(T.size) < 0.002] += 0.05
    smooth[rng.random(T.size) < 0.005] = np.nan
    assert 4 <= kept(run_of(t, pn=smooth), "pn") <= 7
    assert kept(run_of(t, pn=motion + 0.01 * WHITE), "pn") == 1


def test_gyros_and_a_card_that_says_so_stay_as_they_are():
    b, a = butter(2, 10.0, fs=100.0)
    smooth = MOTION + 0.01 * filtfilt(b, a, WHITE)
    assert kept(run_of(p=smooth), "p") == 1
    assert kept(run_of(pn=smooth), "pn", {"pn": False}) == 1
    assert kept(run_of(pn=smooth), "pn") > 1


def test_beside_smoothed_channels_one_without_noise_is_read_as_they_are():
    b, a = butter(2, 10.0, fs=100.0)
    smooth = MOTION + 0.01 * filtfilt(b, a, WHITE)
    counts: Counter[str] = Counter()
    (found,) = read_apart([run_of(phi=MOTION, theta=smooth, h=MOTION + 0.01 * WHITE)], counts, {})
    read = {c: int(np.isfinite(x).sum()) for c, x in found.measured.items()}
    assert read["phi"] == read["theta"] < 0.3 * T.size and read["h"] == T.size
    assert "phi and theta" in next(iter(counts))


def test_an_angle_that_turns_is_no_jump():
    b, a = butter(2, 10.0, fs=100.0)
    turning = 3.0 * T + 0.01 * filtfilt(b, a, WHITE)
    wrapped = (turning + np.pi) % (2.0 * np.pi) - np.pi
    assert 4 <= kept(run_of(psi=wrapped), "psi") <= 5


def test_white_noise_is_flat_and_too_little_says_nothing():
    assert steepness([WHITE], 1) == pytest.approx(1.0, abs=0.15)
    assert steepness([WHITE], 4) == pytest.approx(1.0, abs=0.3)
    assert steepness([WHITE[:200]], 1) == 0.0


@pytest.mark.parametrize(("every", "seldom"), [(1, False), (2, False), (5, True)])
def test_readings_are_seldom_whatever_the_rows_are(every, seldom):
    """Rotor speeds show commands and no gust: theirs do not count."""
    z = np.full((T.size, len(CHANNELS)), np.nan)
    z[:, CHANNELS.index("rpm_upper")] = 0.0
    z[::every, CHANNELS.index("phi")] = 0.0
    engine = SimpleNamespace(records=[SimpleNamespace(t=T, z=z)])
    model = SimpleNamespace(channels=CHANNELS)
    problem = Problem(model, engine, (), {}, SETTINGS)  # type: ignore[arg-type]
    assert problem.between_readings == pytest.approx(0.01 * every)
    assert problem.reads_seldom == seldom and not problem.has_slow_rows


@pytest.mark.slow
def test_nothing_is_named_where_poses_were_smoothed(tmp_path):
    """Each taken for news: three to seven false causes, of up to 748 nats. **Synthetic**."""
    runs = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211", "forward_run")
    injector.fly(
        tmp_path, {}, gusts=GUSTY, sensors="pose_steadied", craft=COAX, seed=3, runs=runs,
        card_noise=None, longest=12.0,
    )  # fmt: skip
    (note,) = [note for note in read_flight(tmp_path).notes if note.startswith("smoothed readings")]
    assert "all but one in 5 of phi, theta, psi, h, pn and pe" in note
    found = diagnose(tmp_path)
    assert found.findings["causes"] == []
    (said,) = [line for line in found.remarks if "readings 50 ms apart" in line]
    assert "5 times as much" in said


@pytest.mark.parametrize(
    ("effect", "aboard", "alike"),
    [
        ("command_delay", ("phi", "pn"), ["pose_delay"]),
        ("pose_delay", ("phi", "pn"), ["command_delay"]),
        ("command_delay", ("phi", "az"), []),  # an accelerometer feels when a command acts
        ("swash_phase", ("phi", "pn"), ["frame_yaw"]),
        ("frame_yaw", ("phi", "pn"), ["swash_phase"]),
        ("frame_yaw", ("phi", "az"), []),
        ("wind", ("phi", "pn"), []),
    ],
)
def test_by_poses_alone_commands_and_poses_are_late_as_one_and_turned_as_one(effect, aboard, alike):
    problem = SimpleNamespace(
        sees_poses_alone="az" not in aboard,
        candidates=("command_delay", "pose_delay", "wind", "swash_phase", "frame_yaw"),
    )
    assert alike_by_poses_alone(problem, effect) == alike  # type: ignore[arg-type]
