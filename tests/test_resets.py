"""A position, height or heading that was set anew is seen where it jumps, and the run cut there."""

from dataclasses import replace

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.estimation.flown import flown_parts
from coax_env.logs.flight import Flight, Run
from coax_env.logs.resets import reset_rows
from coax_env.model.dynamics import hover_trim

FREE = load_vehicle("lama400d").with_values({"fuselage_drag_coefficient": 0.0})
T = 20.0 + 0.01 * np.arange(1500)


def flown(noise: float, seed: int = 0, t: np.ndarray = T) -> Run:
    """A position that swings by 0.4 m and 3 m/s2, a heading with it, and a height in steps of 1 cm."""
    rng = np.random.default_rng(seed)
    swing = 0.4 * np.sin(2.0 * np.pi * 0.4 * (t - t[0]))
    measured = {
        "pn": swing + noise * rng.standard_normal(t.size),
        "psi": 2.0 + swing + noise * rng.standard_normal(t.size),
        "h": np.round(1.0 + 0.3 * swing + noise * rng.standard_normal(t.size), 2),
        "q": rng.standard_normal(t.size),
    }
    command = hover_trim(FREE)[1] + 1e-3 * rng.standard_normal((t.size, 4))
    return Run("a", t, command, measured)


def with_jump(run: Run, channel: str, size: float, row: int, until: int | None = None) -> Run:
    values = run.measured[channel].copy()
    values[row:until] += size
    return replace(run, measured={**run.measured, channel: values})


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("channel", "size"), [("pn", 0.1), ("psi", 0.15), ("psi", 3.0), ("h", 0.3)]
)
def test_a_jump_that_stays_is_seen(channel, size, sign):
    """At its row, whatever moves meanwhile; a heading beyond north as well."""
    run = with_jump(flown(0.005), channel, sign * size, 700)
    found = reset_rows(run)
    assert {c: rows.tolist() for c, rows in found.items()} == {channel: [700]}
    north = replace(
        run, measured={**run.measured, "psi": (run.measured["psi"] + 1.0) % (2 * np.pi)}
    )
    assert {c: rows.tolist() for c, rows in reset_rows(north).items()} == {channel: [700]}


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.03])
def test_motion_and_noise_are_none(noise):
    for seed in range(10):
        assert reset_rows(flown(noise, seed)) == {}


@pytest.mark.parametrize(("size", "rows"), [(0.1, 2), (5.0, 1)])
def test_what_comes_back_at_once_is_none(size, rows):
    """An outlier or two, however far."""
    assert reset_rows(with_jump(flown(0.005), "pn", size, 700, 700 + rows)) == {}


def test_what_comes_back_after_a_while_are_two():
    found = reset_rows(with_jump(flown(0.005), "pn", 0.2, 700, 800))
    assert found["pn"].tolist() == [700, 800]


def test_a_gyro_may_jump():
    """Rates are not set by anybody; gusts turn them at once."""
    run = flown(0.005)
    assert reset_rows(with_jump(run, "q", 50.0, 700)) == {}


def test_a_push_is_none():
    """2 g from one row to the next; the speed changes, not the place."""
    t = T - T[0]
    fast = 10.0 * np.maximum(t - 7.0, 0.0) ** 2 * (t < 7.5) + (t >= 7.5) * (2.5 + 10.0 * (t - 7.5))
    run = flown(0.001)
    assert reset_rows(replace(run, measured={"pn": run.measured["pn"] + fast})) == {}


def test_a_row_that_is_stamped_early_is_none():
    """At 2 m/s: the real first CoaX's rows come up to 6 ms from where they were read."""
    t = T.copy()
    t[700:] -= 0.006
    moving = replace(flown(0.0005), t=t)
    assert (
        reset_rows(replace(moving, measured={"pn": 2.0 * (T - T[0]) + moving.measured["pn"]})) == {}
    )


@pytest.mark.parametrize(("every", "seen"), [(5, True), (10, False)])
def test_a_slow_reading_may_have_moved_so_far(every, seen):
    """Ten readings a second say no more than motion does."""
    run = with_jump(flown(0.002), "pn", 0.5, 700)
    sparse = np.where(np.arange(T.size) % every == 0, run.measured["pn"], np.nan)
    assert bool(reset_rows(replace(run, measured={"pn": sparse}))) == seen


def test_what_jumps_all_the_time_is_noise_of_another_kind():
    run = flown(0.002)
    for row in range(100, 1400, 100):
        run = with_jump(run, "pn", 0.1 * (-1.0) ** row, row, row + 50)
    assert reset_rows(run) == {}


def test_runs_are_cut_where_something_was_set_anew():
    """In two channels at one row: once, and said; readings stay as they are."""
    run = with_jump(with_jump(flown(0.005), "pn", 0.4, 700), "psi", -0.3, 700)
    run = with_jump(run, "h", 0.5, 1400)
    flight = flown_parts(Flight("lama400d", (run,)), FREE)
    assert [part.t.size for part in flight.runs] == [700, 700]  # what is left is too short
    assert [part.whole for part in flight.runs] == ["a", "a"]
    assert np.array_equal(flight.runs[1].measured["pn"], run.measured["pn"][700:1400])
    assert flight.counts["jumps of position, height or heading at which a run is cut"] == 2
    assert flight.notes[0] == "a: cut at 27.0 s, where position north and heading jumped and stayed"
