"""Rows that were read evenly and logged with other times: told by their readings, and mended."""

from collections import Counter

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

from coax_env.logs.clock import even_times, on_even_clock, slope_of
from coax_env.logs.flight import Flight, Run, read_flight, write_flight
from coax_env.logs.repairs import Repaired

STEP = 1.0 / 150.0
N = 2400


def scattered(rng: np.random.Generator, t: np.ndarray, share: float) -> np.ndarray:
    """Times off by a share of a step, in order."""
    return t + np.clip(share * STEP * rng.standard_normal(t.size), -0.45 * STEP, 0.45 * STEP)


def moved(t: np.ndarray, rng: np.random.Generator, noise: float = 1e-3) -> np.ndarray:
    """A position [m] of a machine at up to 3 m/s, read at some times."""
    motion = 2.0 * np.sin(1.4 * t) + 0.1 * np.sin(7.0 * t)
    return motion + noise * rng.standard_normal(t.size)


def run_of(t: np.ndarray, **measured: np.ndarray) -> Repaired:
    return Repaired(t, np.zeros((t.size, 4)), measured, None)


@pytest.mark.parametrize("lost", [0.0, 0.02])
@pytest.mark.parametrize("share", [0.05, 0.2])
def test_rows_of_an_even_clock_get_their_times_back(share, lost):
    """To 3 % of a step, but for an offset; a few rows beside a lost one may be a step off."""
    rng = np.random.default_rng(int(100 * share + 1000 * lost))
    read_at = STEP * np.arange(N)[rng.random(N) >= lost]
    logged = scattered(rng, read_at, share)
    counts: Counter[str] = Counter()
    (found,) = on_even_clock([run_of(logged, pn=moved(read_at, rng, 2e-4))], counts)
    off = found.t - read_at
    off -= np.median(off)
    assert np.std(off) < 0.03 * STEP and np.mean(np.abs(off) > 0.3 * STEP) < 1e-3
    assert sum(counts.values()) == read_at.size and "even clock" in next(iter(counts))


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_times_that_readings_follow_stay_as_they_are(share):
    rng = np.random.default_rng(int(100 * share))
    t = scattered(rng, STEP * np.arange(N), share)
    counts: Counter[str] = Counter()
    run = run_of(t, pn=moved(t, rng), h=moved(t, rng))
    slope, std = slope_of([run])
    assert abs(slope - 1.0) < 4.0 * std + 0.02 and std < 0.05
    (found,) = on_even_clock([run], counts)
    assert np.array_equal(found.t, t) and not counts


@pytest.mark.parametrize("right", [False, True])
def test_times_are_mended_where_coarse_readings_say_no_more_than_that_they_are_wrong(right):
    """Two std of the slope reach over what is wrong, and times that are right are six of them away."""
    rng = np.random.default_rng(8)
    even = STEP * np.arange(N)
    logged = scattered(rng, even, 0.2)
    run = run_of(logged, pn=moved(logged if right else even, rng, 0.012))
    slope, std = slope_of([run])
    assert 0.1 < std < 0.15 and abs(slope - right) < 3.0 * std
    (found,) = on_even_clock([run], Counter())
    assert np.array_equal(found.t, logged) == right


def test_what_stands_still_or_has_even_times_says_nothing():
    rng = np.random.default_rng(5)
    even = STEP * np.arange(N)
    still = run_of(scattered(rng, even, 0.15), pn=1e-3 * rng.standard_normal(N))
    on_time = run_of(even, pn=moved(even, rng))
    for run in (still, on_time, run_of(even)):
        counts: Counter[str] = Counter()
        (found,) = on_even_clock([run], counts)
        assert np.array_equal(found.t, run.t) and not counts


def test_rows_whose_places_are_not_clear_keep_their_times():
    """Scattered by half a step, or on a clock that is not even at all."""
    rng = np.random.default_rng(6)
    wild = np.cumsum(rng.uniform(0.3, 1.7, N)) * STEP
    for t in (np.sort(STEP * (np.arange(N) + 0.6 * rng.standard_normal(N))), wild, np.arange(10.0)):
        assert even_times(t) is t


@pytest.mark.parametrize("smooth", [False, True])
def test_a_flight_is_read_so_unless_software_smoothed_it(tmp_path, smooth):
    """Smoothed from row to row, poses follow an uneven clock no more, though it is right."""
    rng = np.random.default_rng(7)
    read_at = STEP * np.arange(N)
    logged = scattered(rng, read_at, 0.15)
    position = moved(logged if smooth else read_at, rng)
    if smooth:
        position = filtfilt(*butter(2, 10.0, fs=1.0 / STEP), position)
    command = np.tile([200.0, 224.0, 0.0, 0.0], (N, 1))
    run = Run("side", logged, command, {"pn": position})
    flight = read_flight(write_flight(Flight("lama400d", (run,)), tmp_path / "flight"))
    left = np.std(np.diff(flight.runs[0].t)) / STEP
    assert left > 0.15 if smooth else left < 0.01
