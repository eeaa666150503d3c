"""Open-loop prediction over a horizon (contract.md), on records whose prediction is known by hand.

A machine that hovers in perfect trim, read without noise, and a model that is one per cent too heavy:
flown without the filter's help it must fall by g/101 t^2/2.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from coax_env import InputError, load_vehicle
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.helicopter_noise import GUST_LEVELS, MEMORIES
from coax_env.estimation.joint_gusts import LEVER
from coax_env.estimation.prediction import (
    ChannelReplay,
    RunReplay,
    gusts_of,
    mean_log_ratio,
    pooled_rms,
    replay,
    replay_runs,
    rms,
    run_table,
)
from coax_env.estimation.state_space import Noise, Record
from coax_env.logs.flight import Flight, Run
from coax_env.model.dynamics import hover_trim
from coax_env.model.layout import CHANNELS

LAMA = load_vehicle("lama400d")
G = LAMA["gravity"].value
MEMORY = 0.8  # s
NOISE = Noise(
    {"force_xy": 0.3, "force_z": 0.3, "moment_xy": 5e-3, "moment_z": 5e-3,
     **dict.fromkeys(MEMORIES, MEMORY)},
    {"phi": 1e-3, "theta": 1e-3, "psi": 1e-3, "h": 1e-3, "vn": 1e-3, "ve": 1e-3, "vd": 1e-3,
     "p": 1e-3, "q": 1e-3, "r": 1e-3, "pn": 1e-3, "az": 1e-2},
)  # fmt: skip
QUIET = NOISE.with_levels(dict.fromkeys(GUST_LEVELS, 1e-9))


def hover(seconds: float = 5.0, dt: float = 0.01, start: float = 0.0, **readings) -> Record:
    """A record of the bare machine in trim at 1.5 m; `readings` replace those of a channel."""
    state, command = hover_trim(LAMA)
    t = start + dt * np.arange(round(seconds / dt) + 1)
    z = np.full((t.size, len(CHANNELS)), np.nan)
    perfect = dict.fromkeys(("p", "q", "r", "vn", "ve", "vd"), 0.0) | {
        "phi": state[10], "theta": state[11], "psi": 0.0, "h": 1.5, "az": -G,
    }  # fmt: skip
    for channel, values in (perfect | readings).items():
        z[:, CHANNELS.index(channel)] = values
    return Record("hover", t, np.tile(command, (t.size, 1)), z, origin=start)


def flown(record: Record, noise: Noise = NOISE, horizon: float = 1.0, heavier: float = 0.0, **more):
    """The record's replay by the bare model, its mass so much too large."""
    engine = Engine(HeliModel(LAMA), [record])
    values = {"mass": LAMA["mass"].value * (1.0 + heavier)}
    (run,) = replay_runs(engine, values, noise, horizon, **more)
    assert not run.diverged
    return run


@pytest.mark.parametrize("horizon", [0.5, 1.0, 2.0])
def test_a_model_that_is_too_heavy_falls(horizon):
    """The force that the filter believes in is set to zero; where it decays, it holds for a while."""
    run = flown(hover(), horizon=horizon, heavier=0.01)
    missing = G * 0.01 / 1.01
    later = slice(8, None)  # the filter has found the force by then
    expected = {"vd": missing * horizon, "h": -missing * horizon**2 / 2.0}
    held = 1.0 - math.exp(-horizon / MEMORY)
    decaying = {
        "vd": missing * (horizon - MEMORY * held),
        "h": -missing * (horizon**2 / 2.0 - MEMORY * horizon + MEMORY**2 * held),
    }
    for channel in ("vd", "h"):
        trace = run.channels[channel]
        assert trace.error[later] == pytest.approx(expected[channel], rel=0.01, abs=2e-4)
        assert trace.error_decaying[later] == pytest.approx(decaying[channel], rel=0.03, abs=2e-3)
        np.testing.assert_allclose(trace.predicted - trace.measured, trace.error)
    assert abs(run.channels["phi"].error).max() < 1e-3


def test_the_right_model_is_right():
    run = flown(hover())
    for channel in ("h", "vn", "ve", "vd", "phi", "theta", "psi"):
        assert abs(run.channels[channel].error).max() < 2e-3, channel


def test_starts_are_every_quarter_second_after_the_first_second():
    """The last one a horizon before the end; wherever the clock starts, and where rows are uneven."""
    record = hover(seconds=4.0, start=7.0)
    expected = 7.0 + 1.0 + 0.25 * np.arange(9) + 1.0
    assert flown(record).channels["vd"].t == pytest.approx(expected, abs=1e-6)
    assert flown(record, horizon=2.0).channels["vd"].t == pytest.approx(expected[4:], abs=1e-6)
    kept = np.arange(record.t.size) % 7 != 3  # no row where a start should be: the next one
    uneven = replace(record, t=record.t[kept], z=record.z[kept], command=record.command[kept])
    assert abs(flown(uneven).channels["vd"].t - expected).max() <= 0.011


def test_a_slow_sensors_last_reading_counts_at_its_own_time():
    """One reading in 0.3 s: within the last 0.15 s of the horizon it counts, else there is none."""
    h = np.full(501, np.nan)
    h[::30] = 1.5
    trace = flown(hover(h=h), heavier=0.01).channels["h"]
    ends = 2.0 + 0.25 * np.arange(trace.t.size)
    ago = (ends + 1e-9) % 0.3
    there = ago < 0.15
    ago = ends - np.floor((ends + 1e-9) / 0.3) * 0.3
    clear = abs(ago - 0.15) > 0.02
    assert np.array_equal(np.isfinite(trace.error)[clear], there[clear]) and there.sum() > 0
    good = np.isfinite(trace.error) & (ends > 3.0)
    assert trace.t[good] == pytest.approx((ends - ago)[good])
    fallen = -G * 0.01 / 1.01 * (1.0 - ago[good]) ** 2 / 2.0
    assert trace.error[good] == pytest.approx(fallen, abs=2e-3)


def test_headings_are_compared_in_whole_turns():
    """Readings that jump from pi to -pi, and a model that turns on over the seam."""
    rate = 1.3
    t = 0.01 * np.arange(501)
    psi = (3.0 + rate * t + math.pi) % (2.0 * math.pi) - math.pi
    trace = flown(hover(psi=psi, r=rate)).channels["psi"]
    assert abs(np.diff(psi)).max() > 6.0
    assert np.diff(trace.measured) == pytest.approx(0.25 * rate, abs=1e-6)
    assert abs(trace.error).max() < 0.02


def test_a_turn_that_the_compass_did_not_see_is_still_a_turn():
    """Four seconds without a heading, the gyro turning on: readings alone would count one turn less."""
    rate = 1.3
    t = 0.01 * np.arange(901)
    psi = (rate * t + math.pi) % (2.0 * math.pi) - math.pi
    psi[(t > 1.5) & (t < 5.5)] = np.nan
    trace = flown(hover(seconds=9.0, psi=psi, r=rate)).channels["psi"]
    after = np.isfinite(trace.error) & (trace.t > 6.6)
    assert after.sum() > 5 and abs(trace.error[after]).max() < 0.02
    assert trace.measured[after] == pytest.approx(rate * trace.t[after], abs=1e-6)


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_a_roll_that_is_read_a_turn_away_is_no_error(turn):
    """A logger that writes 0 to 2 pi, or jumps on the way."""
    roll = hover_trim(LAMA)[0][10] + 2.0 * math.pi * turn * (np.arange(501) > 60)
    trace = flown(hover(phi=roll)).channels["phi"]
    assert abs(trace.error).max() < 1e-3 and abs(trace.error_decaying).max() < 1e-3


def test_the_floor_is_the_start_flown_forward():
    """In hover height is h - w t: its variance follows from the covariance of the first state."""
    record, horizon = hover(), 1.0
    run = flown(record, QUIET, horizon, floor=True)
    engine = Engine(HeliModel(LAMA), [record])
    rows = np.arange(100, 401, 100)  # every fourth start, 1 s apart
    (passed,) = engine.filter(dict(LAMA.values()), QUIET, start_rows=[rows])
    P = passed.start_covariances
    w, z = 2, 15
    fall = P[:, z, z] + horizon**2 * P[:, w, w] + 2.0 * horizon * P[:, z, w]
    assert run.floor["vd"] == pytest.approx(math.sqrt(P[:, w, w].mean()), rel=0.03)
    assert run.floor["h"] == pytest.approx(math.sqrt(fall.mean()), rel=0.03)
    assert flown(record, QUIET).floor == {}


def test_a_model_without_a_likelihood_has_diverged():
    engine = Engine(HeliModel(LAMA), [hover()])
    (run,) = replay_runs(engine, {"inertia_xx": 1e-7}, NOISE, 1.0)
    assert run.diverged


# --- tables of it ---------------------------------------------------------------------------------


def made_up(name: str, error: list[float], diverged: bool = False) -> RunReplay:
    e = np.array(error)
    return RunReplay(name, {"h": ChannelReplay(e, e, e, e, 2.0 * e)}, diverged, {})


def test_tables_are_root_mean_squares_of_what_is_there():
    assert rms(np.array([3.0, np.nan, 4.0])) == pytest.approx(math.sqrt(12.5))
    entry = run_table(made_up("a", [3.0, np.nan, 4.0]), {"h": 0.05})["h"]
    assert entry == {
        "rms": pytest.approx(math.sqrt(12.5)), "rms_gusts_decaying": pytest.approx(math.sqrt(50.0)),
        "noise_rms": 0.05, "unit": "m",
    }  # fmt: skip
    lost = run_table(made_up("a", [3.0], diverged=True), {"h": 0.05})["h"]
    assert lost["rms"] is None and lost["diverged"] is True
    assert run_table(made_up("a", [np.nan]), {"h": 0.05})["h"]["rms"] is None
    runs = [made_up("a", [3.0]), made_up("b", [4.0, np.nan]), made_up("c", [9.0], diverged=True)]
    assert pooled_rms(runs) == {"h": pytest.approx(math.sqrt(12.5))}
    assert pooled_rms([made_up("a", [np.nan])]) == {}


def test_gusts_are_reported_by_axis():
    levels = {
        "force_xy": 0.2, "force_z": 0.3, "moment_xy": 4e-3, "moment_z": 5e-3,
        **dict.fromkeys(MEMORIES, 0.8),
    }  # fmt: skip
    own = gusts_of(Noise(levels))
    assert own == {
        "force_N": [0.2, 0.2, 0.3], "moment_Nm": pytest.approx([4e-3, 4e-3, 5e-3]), "memory_s": 0.8,
    }  # fmt: skip
    arm = 0.015  # a push that also tilts adds 3 mN m
    joint = gusts_of(Noise(levels), {LEVER: -arm})
    assert joint == own | {"moment_Nm": pytest.approx([5e-3, 5e-3, 5e-3])}


def flight(seconds: float) -> Flight:
    """A hover as a flight, a little noise on its readings."""
    record = hover(seconds)
    rng = np.random.default_rng(0)
    measured = {
        c: record.z[:, CHANNELS.index(c)] for c in ("p", "q", "r", "phi", "theta", "h", "vd")
    }
    measured = {c: z + 0.01 * rng.standard_normal(z.size) for c, z in measured.items()}
    run = Run("hover", record.t, record.command, measured)
    return Flight("lama400d", (run,), noise=dict.fromkeys(measured, 0.01))


def test_a_horizon_longer_than_every_run_is_refused():
    with pytest.raises(InputError, match="longer than every run"):
        replay(flight(3.0), horizon=2.5)


def test_a_replay_says_what_it_was_made_with():
    result = replay(flight(4.0), LAMA.with_values({"mass": 1.02 * LAMA["mass"].value}))
    json.dumps(result.findings, allow_nan=False)
    assert result.findings["horizon_s"] == 1.0 and result.findings["vehicle"] == LAMA.name
    table = result.findings["runs"]["hover"]
    assert {c: e["noise_rms"] for c, e in table.items()} == dict.fromkeys(table, 0.01)
    expected = math.hypot(G * 0.02 / 1.02, 0.01)
    assert table["vd"]["rms"] == pytest.approx(expected, rel=0.1)
    assert result.findings["gusts"] == gusts_of(result.noise)


@pytest.mark.parametrize(
    ("ours", "theirs", "mean"),
    [
        ({"p": 2.0, "q": 1.0}, {"p": 1.0, "q": 1.0}, 0.5 * math.log(2.0)),
        ({"p": 1.0}, {"p": 4.0, "q": 9.0}, -2.0 * math.log(2.0)),  # q is one's alone
        ({"p": 0.0, "q": 3.0}, {"p": 1.0, "q": 1.0}, math.log(3.0)),  # of no error no ratio
        ({"p": 2.0}, {"p": 0.0}, 0.0),
        ({"p": 2.0}, {"q": 2.0}, 0.0),
    ],
)
def test_errors_of_all_channels_are_compared_by_their_ratios(ours, theirs, mean):
    assert mean_log_ratio(ours, theirs) == pytest.approx(mean, abs=1e-12)
