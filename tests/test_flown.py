"""What of a flight was flown, row by row: thrust over weight, means, frozen commands, jumps in gaps."""

import math
from dataclasses import replace

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.estimation.flown import (
    JUMP,
    _mean,
    flown_parts,
    frozen_rows,
    grounded_rows,
    jumps_in_gaps,
    longest_believed,
    thrust_share,
)
from coax_env.logs.flight import Flight, Run
from coax_env.model.dynamics import hover_trim

LAMA = load_vehicle("lama400d")
FREE = LAMA.with_values({"fuselage_drag_coefficient": 0.0})
HOVER = hover_trim(FREE)[1]
T = 30.0 + 0.02 * np.arange(601)


def run(command: np.ndarray | None = None, t: np.ndarray = T, **measured: np.ndarray) -> Run:
    """Commands of a hover that tremble on every row, unless given."""
    if command is None:
        command = HOVER + 1e-3 * np.random.default_rng(0).standard_normal((t.size, 4))
    return Run("a", t, command, {"q": np.zeros(t.size), **measured})


# --- what carries -------------------------------------------------------------------------------------


def test_at_hover_the_rotors_carry_the_weight():
    """As the trim says; with the square of each speed, measured where it is logged."""
    level = np.tile(HOVER, (T.size, 1))
    np.testing.assert_allclose(thrust_share(run(level), FREE), 1.0, rtol=1e-6)
    np.testing.assert_allclose(thrust_share(run(1.1 * level), FREE), 1.21, rtol=1e-6)
    upper = level * [0.0, 1.0, 1.0, 1.0]
    own = FREE.values()
    lift = own["thrust_coefficient_upper"] * HOVER[0] ** 2
    whole = lift + own["thrust_coefficient_lower"] * HOVER[1] ** 2
    np.testing.assert_allclose(thrust_share(run(upper), FREE), 1.0 - lift / whole, rtol=1e-6)
    rpm = np.full(T.size, HOVER[0] * 30.0 / math.pi)
    rpm[::3] = np.nan  # between readings the last one holds
    rpm[0] = rpm[1]
    np.testing.assert_allclose(thrust_share(run(upper, rpm_upper=rpm), FREE), 1.0, rtol=1e-6)
    blind = np.full(T.size, np.nan)
    np.testing.assert_allclose(thrust_share(run(level, rpm_upper=blind), FREE), 1.0, rtol=1e-6)


def test_a_mean_is_over_half_a_second_around_each_row():
    """Of a step: a ramp of half a second; at the ends over what there is."""
    step = (T >= 35.0).astype(float)
    found = _mean(T, step)
    np.testing.assert_allclose(found, np.clip((T - 34.75) / 0.5, 0.0, 1.0), atol=1e-9)
    ramp = T - T[0]
    assert _mean(T, ramp)[0] == pytest.approx(np.mean(ramp[:12]), abs=0.011)


def test_half_the_weight_is_carried_or_it_stands_until_it_flies():
    """Below a half of it, and on to nine tenths of the usual thrust; a dip in flight is a dip."""
    share = np.ones(T.size)
    share[:100], share[100:150] = 0.3, np.linspace(0.3, 1.0, 50)
    share[400:450] = 0.7
    command = np.tile(HOVER, (T.size, 1))
    command[:, :2] *= np.sqrt(share)[:, None]
    found = grounded_rows(run(command), FREE)
    mean = _mean(T, share)
    first = int(np.flatnonzero(mean >= 0.9)[0])
    assert found[:first].all() and not found[first:].any()
    command[400:450, :2] = 0.68 * HOVER[:2]
    assert grounded_rows(run(command), FREE)[420:430].all()
    steady = np.tile(HOVER * [0.72, 0.72, 1.0, 1.0], (T.size, 1))
    assert not grounded_rows(run(steady), FREE).any(), "0.52 of the weight"
    assert grounded_rows(run(0.7 * np.tile(HOVER, (T.size, 1))), FREE).all(), "0.49 of it"


# --- commands that freeze -----------------------------------------------------------------------------


@pytest.mark.parametrize(("seconds", "frozen"), [(0.9, False), (1.1, True)])
def test_commands_freeze_from_a_second_on(seconds, frozen):
    """In a run where they change on every row: from the row behind the last change on."""
    held = run()
    rows = round(seconds / 0.02)
    command = held.command.copy()
    command[200 : 200 + rows] = command[200]
    found = frozen_rows(replace(held, command=command))
    assert found.any() == frozen
    if frozen:
        np.testing.assert_array_equal(np.flatnonzero(found), np.arange(201, 200 + rows))
    late = held.command.copy()
    late[-rows - 1 :] = late[-rows - 1]
    found = frozen_rows(replace(held, command=late))
    assert found.any() == frozen and found[-1] == frozen


def test_commands_that_stand_still_for_long_as_a_rule_freeze_from_ten_times_that_on():
    """Steps every 0.2 s: 1.9 s are usual then, 2.1 s are not; fewer than twenty changes are no rule."""
    steps = np.repeat(np.arange(61), 10)[: T.size]
    for rows, frozen in ((95, False), (106, True)):
        level = steps.copy().astype(float)
        level[250 : 250 + rows] = level[250]
        command = np.tile(HOVER, (T.size, 1))
        command[:, 2] = 1e-3 * level
        assert frozen_rows(run(command)).any() == frozen, rows
    few = np.tile(HOVER, (T.size, 1))
    few[:300, 2] = 1e-3 * np.repeat(np.arange(19), 16)[:300]
    assert not frozen_rows(run(few)).any()


# --- gaps ---------------------------------------------------------------------------------------------


def test_the_last_command_is_believed_for_five_steps_and_a_quarter_second():
    assert longest_believed(0.01 * np.arange(50)) == 0.25
    assert longest_believed(0.08 * np.arange(50)) == pytest.approx(0.4)


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_jump_is_three_times_what_a_command_does_in_so_many_rows(share):
    """By the rms over all runs, of that command alone, over as many rows as are missing."""
    rng = np.random.default_rng(3)
    t = 7.0 + 0.04 * np.arange(500)
    walk = np.cumsum(rng.standard_normal((2, 500, 4)), axis=1) * [1.0, 2.0, 0.001, 0.002]
    kept = np.ones(500, bool)
    kept[301:304] = False  # four steps from row 300 to row 304
    whole, cut = walk[0], walk[1].copy()
    sides = [whole, np.concatenate([cut[:301], cut[304:]])]
    squares = [(side[4:] - side[:-4]) ** 2 for side in sides]
    usual = np.sqrt(np.concatenate(squares).mean(axis=0))
    for _ in range(60):  # the jump is in the rms itself: solved by repetition
        jump = share * JUMP * usual[2]
        cut[304:, 2] = cut[304:, 2] - cut[304, 2] + cut[300, 2] + jump
        sides[1] = np.concatenate([cut[:301], cut[304:]])
        squares = [(side[4:] - side[:-4]) ** 2 for side in sides]
        usual = np.sqrt(np.concatenate(squares).mean(axis=0))
    cut[304:, [0, 1, 3]] += cut[300, [0, 1, 3]] - cut[304, [0, 1, 3]]
    first, second = jumps_in_gaps([t, t[kept]], [whole, cut[kept]])
    assert not first.any() and second.any() == (share > 1.0)
    if share > 1.0:
        assert t[kept][second].tolist() == [t[304]]


def test_a_flight_without_two_seconds_in_a_piece_is_used_as_it_is():
    """Gaps of a second after every 1.5 s; and with one piece of 2.5 s that alone is left."""
    t = np.concatenate([30.0 + 2.5 * k + 0.02 * np.arange(76) for k in range(4)])
    flight = Flight("lama400d", (run(t=t),))
    found = flown_parts(flight, FREE)
    assert found.runs == flight.runs and "no run has 2 s" in found.notes[-1]
    longer = np.concatenate([t, 40.0 + 0.02 * np.arange(126)])
    found = flown_parts(Flight("lama400d", (run(t=longer),)), FREE)
    (only,) = found.runs
    assert only.t[0] == 40.0 and only.name == "a" and only.beginning == 30.0
    assert found.counts["gaps at which a run is cut"] == 4
    assert found.counts["parts of less than 2 s left out"] == 4


def test_a_long_run_is_flown_in_equal_parts():
    """One after the other they are the run; 299 s are left whole."""
    t = 30.0 + 0.05 * np.arange(14401)
    whole = run(t=t)
    found = flown_parts(Flight("lama400d", (whole,)), FREE)
    assert [part.name for part in found.runs] == ["a", "a (2)", "a (3)"]
    assert {part.whole for part in found.runs} == {"a"}
    assert {part.beginning for part in found.runs} == {30.0}
    assert np.array_equal(np.concatenate([part.t for part in found.runs]), t)
    assert np.array_equal(np.concatenate([part.command for part in found.runs]), whole.command)
    lasted = [part.t[-1] - part.t[0] for part in found.runs]
    assert lasted == pytest.approx([240.0] * 3, abs=0.1)
    assert found.notes == ("a: flown in 3 parts of 240 s",)
    short = Flight("lama400d", (run(t=t[:5981]),))
    assert flown_parts(short, FREE) is short
