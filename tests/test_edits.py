"""Edits of logs, whose truth is known: what they do to a log, and that a difference finds just that."""

import importlib
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bundled_flight import bundled
from shared_flights import read

from coax_env.comparison.two_logs.before import Before
from coax_env.comparison.two_logs.changes import changes, first_difference
from coax_env.comparison.two_logs.coordinates import coordinates, effective, moved
from coax_env.comparison.two_logs.logs import with_rotors
from coax_env.diagnosis.fits import start
from coax_env.diagnosis.problem import Problem
from coax_env.errors import InputError
from coax_env.estimation.helicopter import HeliModel, Moment, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.logs.edits import EDITS, LAT, LON, edited
from coax_env.logs.flight import Flight, read_flight, write_flight
from coax_env.model.vehicle_file import load_vehicle

RUNS = ("lon_3211", "lat_3211")


def flight() -> Flight:
    return bundled().select(RUNS)


# --- what an edit does to a log -------------------------------------------------------------------


@pytest.mark.parametrize("name", EDITS)
def test_an_edit_changes_what_it_says_and_nothing_else(name):
    rotors, swash = {"upper", "lower"}, {"lon", "lat"}
    touched = {
        "phase": swash, "delay": swash, "command_delay": rotors | swash, "offset_lon": {"lon"},
        "offset_lat": {"lat"}, "gain": swash, "rotor_scale": rotors, "h_scale": {"h"},
        "p_bias": {"p"}, "q_bias": {"q"}, "r_bias": {"r"},
    }.get(name, {name})  # fmt: skip
    size = 1.1 if EDITS[name].unit == "1" else 0.05
    for before, after in zip(flight().runs, edited(flight(), {name: size}).runs, strict=True):
        columns = dict(zip(("upper", "lower", "lon", "lat"), before.command.T, strict=True))
        changed = dict(zip(columns, after.command.T, strict=True))
        columns |= before.measured
        changed |= after.measured
        assert {c for c in columns if not np.array_equal(columns[c], changed[c], True)} == touched
        np.testing.assert_array_equal(before.t, after.t)


def test_a_phase_turns_and_a_gain_stretches():
    (run, *_) = flight().runs
    (turned, *_) = edited(flight(), {"phase": 0.15}).runs
    both = run.command[:, LON] + 1j * run.command[:, LAT]
    np.testing.assert_allclose(
        turned.command[:, LON] + 1j * turned.command[:, LAT], both * np.exp(0.15j), atol=1e-15
    )
    (stretched, *_) = edited(flight(), {"gain": 1.25}).runs
    np.testing.assert_allclose(stretched.command[:, LON:], 1.25 * run.command[:, LON:])


def test_a_shift_keeps_the_integral_of_the_command():
    """Logged sooner by whole rows, a command is its later rows; in between it is their mean."""
    (run, *_) = flight().runs
    (rows, *_) = edited(flight(), {"delay": 0.03}).runs
    np.testing.assert_allclose(rows.command[:-3, LON], run.command[3:, LON], atol=1e-12)
    (half, *_) = edited(flight(), {"delay": 0.035}).runs
    between = 0.5 * (run.command[3:-1, LON] + run.command[4:, LON])
    np.testing.assert_allclose(half.command[:-4, LON], between, atol=1e-12)


def test_from_a_moment_on():
    first, second = flight().runs
    one, other = edited(flight(), {"theta": 0.03}, (RUNS[1], 6.0)).runs
    assert one is first
    late = other.t >= 6.0
    known = np.isfinite(second.measured["theta"])
    apart = (other.measured["theta"] - second.measured["theta"])[known]
    np.testing.assert_allclose(apart, np.where(late[known], 0.03, 0.0), atol=1e-15)


@pytest.mark.parametrize(
    ("edits", "since", "words"),
    [
        ({"phse": 0.1}, None, "no edit 'phse'; there are phase"),
        ({"gain": 0.0}, None, "gain is a factor and should be positive"),
        ({"theta": 0.1}, ("no", 1.0), "no run 'no'"),
    ],
)
def test_what_cannot_be_edited(edits, since, words):
    with pytest.raises(InputError, match=words):
        edited(flight(), edits, since)


def test_an_edited_log_is_a_flight_of_its_own(tmp_path):
    write_flight(edited(flight(), {"gain": 1.25, "theta": 0.03}), tmp_path / "f")
    for before, after in zip(flight().runs, read_flight(tmp_path / "f").runs, strict=True):
        np.testing.assert_allclose(after.command[:, LON:], 1.25 * before.command[:, LON:])
        np.testing.assert_allclose(
            after.measured["theta"], before.measured["theta"] + 0.03, atol=1e-9
        )


# --- what a difference finds ----------------------------------------------------------------------


@cache
def before() -> Before:
    """The bare model of two runs that wind, drag and lags shook: none of which it has."""
    vehicle = load_vehicle("lama400d").in_air(flight().air)
    candidates = ("swash_phase", "swash_gain", "servo_lag", "cg_offset", "attitude_bias")
    records = [record_of(run) for run in flight().runs]
    problem = Problem.of(HeliModel(vehicle), records, candidates)
    return Before.of(problem, start(problem, starting_noise(flight(), vehicle)))


def difference(edits: dict[str, float]) -> dict[str, dict[str, tuple[float, float]]]:
    """Effect -> number -> (change, std)."""
    found = changes(before(), [record_of(run) for run in edited(flight(), edits).runs])
    return {
        c.effect: {name: (p.change, p.std) for name, p in c.parameters.items()}
        for c in found.changes
    }


def test_the_same_log_has_not_changed():
    assert difference({}) == {}


def test_an_edit_is_found_at_its_size_by_a_model_that_lacks_much():
    found = difference({"gain": 1.25})
    assert list(found) == ["swash_gain"]
    change, std = found["swash_gain"]["swash_gain.scale"]
    assert abs(change - (1.0 / 1.25 - 1.0)) < 2.0 * std < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edit", "number", "size"),
    [("gain", "swash_gain.scale", 1.0 / 1.25 - 1.0), ("theta", "attitude_bias.y", 0.03)],
)
def test_an_edit_from_a_moment_on_is_found_at_its_size_and_moment(edit, number, size):
    """In the second of two runs: half a row before its first edited row, known to that row."""
    log = edited(flight(), {edit: 1.25 if edit == "gain" else 0.03}, (RUNS[1], 6.0))
    found = changes(before(), [record_of(run) for run in log.runs])
    (change,) = found.changes
    p = change.parameters[number]
    assert abs(p.change - size) < 2.0 * p.std < 0.1
    assert found.since is not None and found.since.moment.run == RUNS[1]
    assert abs(found.since.t - 6.0) < math.sqrt(3.0) * found.since.std + 1e-9 < 0.02


def test_what_differs_from_the_first_row_on_has_no_moment():
    log = edited(flight(), {"gain": 1.25})
    records = [[record_of(run) for run in f.runs] for f in (flight(), log)]
    assert first_difference(*records) is None
    assert first_difference(records[0], records[0]) is None


def test_what_differs_from_a_run_on_does_so_from_its_first_row_on():
    log = edited(flight(), {"gain": 1.25}, (RUNS[1], 0.0))
    since = first_difference(*([record_of(run) for run in f.runs] for f in (flight(), log)))
    assert since is not None and since.moment.run == RUNS[1]
    assert since.t == flight().runs[1].t[0] and since.std == 0.0


def test_rotors_turn_faster_from_the_moment_on():
    """Of the commands, rows before the moment and the swash plate's stay."""
    late = before().since(Moment(RUNS[1], 6.0))
    faster = with_rotors(late.problem.engine, 1.04)
    for was, now in zip(late.problem.engine.records, faster.records, strict=True):
        after = (was.whole == RUNS[1]) & (was.t >= 6.0)
        expected = np.where(after[:, None], [1.04, 1.04, 1.0, 1.0], 1.0)
        np.testing.assert_allclose(now.command, was.command * expected)


@pytest.mark.slow
def test_two_edits_are_two_changes():
    found = difference({"phase": 0.15, "theta": 0.03})
    assert set(found) == {"swash_phase", "attitude_bias"}
    for name, size in (("swash_phase.angle", -0.15), ("attitude_bias.y", 0.03)):
        change, std = found[name.partition(".")[0]][name]
        assert abs(change - size) < 3.0 * std < 0.2 * abs(size), name


def test_logs_of_two_flights_are_refused():
    with pytest.raises(InputError, match="not two logs of one flight"):
        changes(before(), [record_of(run) for run in flight().runs[:1]])


def test_a_linkage_gain_is_one_number_wherever_a_fit_put_it():
    """Half in the base parameter, half in the effect: the same machine, the same number."""
    problem = before().problem
    file = problem.model.bare_values
    base = {**file, "swash_to_flap": 1.2 * file["swash_to_flap"], "swash_gain.scale": 0.0}
    own = {**file, "swash_gain.scale": 0.2}
    for values in (base, own):
        assert effective(problem, values, "swash_gain")["swash_gain.scale"] == pytest.approx(0.2)
        after = moved(values, {"swash_gain.scale": -0.2})
        assert effective(problem, after, "swash_gain")["swash_gain.scale"] == pytest.approx(-0.04)


def test_a_number_moves_within_what_physics_gives():
    """A lag of nothing cannot become less, and a derivative is taken on the side that there is."""
    of_lag = [c for c in coordinates(before().problem, before().fit) if c.effect == "servo_lag"]
    assert [(c.lower, c.step > 0.0) for c in of_lag] == [(0.0, True)]


@pytest.mark.slow
@pytest.mark.needs_shared_flights
@pytest.mark.parametrize(
    ("name", "runs", "since"),
    [("skybotix_coax", ["circles"], None), ("skybotix_second", None, ("4x5ft_2", 20.0))],
)
def test_edits_of_real_logs(name, runs, since):
    """Six edits of each, of the second set from 20 s on in one run: all found at their size, by the
    effect's own name, and moment, and nothing else changed.

    Of the first set 25 s of one run and no moment, for time; `scripts/check_edits.py` takes them all.
    """
    script = importlib.import_module("check_edits")
    log = read(name)
    log = _begun(log.select(runs), 25.0) if runs else log
    flight, model = script.before_edits(log, None, lambda text: None)
    rows = script.check(flight, model, script.STANDARD, lambda text: None, since)
    assert [row["edit"] for row in rows] == list(script.STANDARD)
    for row in rows:
        assert row["found"] and row["named"] == row["effect"], row
        assert not row["else"], row
        assert since is None or row["in_time"], row
        size = math.hypot(*(p["planted"] for p in row["parameters"].values()))
        assert all(p["std"] < 0.5 * size for p in row["parameters"].values()), row


def _begun(log: Flight, seconds: float) -> Flight:
    """The first seconds of every run."""
    return replace(log, runs=tuple(r.of_rows(r.t < r.t[0] + seconds) for r in log.runs))
