"""What begins in flight: scored at every moment, named with its moment, and nowhere else."""

import csv
from dataclasses import replace
from pathlib import Path

import injector
import numpy as np
import pytest
from causes import check_causes, truth_of
from test_estimation import NOISE, TRUTH, Pendulum, prior, swing

from coax_env.diagnosis.diagnose import diagnose
from coax_env.diagnosis.onset import _Table, rows_of
from coax_env.estimation.beginnings import Beginning
from coax_env.estimation.changing_model import BEFORE, ChangingModel, before
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, Moment, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.parted_engine import of_part
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.rotor_jitter import JitteryModel, with_jitter
from coax_env.logs.flight import read_flight
from coax_env.model.vehicle_file import load_vehicle

RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")


# --- every moment at once ---------------------------------------------------------------------------


def test_a_steps_gain_is_that_of_the_refit_without_it():
    # a gyro's bias from a row on is a log with that bias taken off from there on
    record, row = swing(3, n=200), 120
    late = np.arange(200) >= row
    record = replace(record, z=record.z + 0.15 * late[:, None] * [0.0, 1.0, 0.0])

    def without(bias: float) -> float:
        z = record.z - bias * late[:, None] * [0.0, 1.0, 0.0]
        return Engine(Pendulum(), [replace(record, z=z)]).log_likelihood(TRUTH, NOISE)

    # in the bias the log-likelihood of a linear model is a parabola
    here, ahead, back = without(0.0), without(0.1), without(-0.1)
    slope, bend = 5.0 * (ahead - back), 100.0 * (2.0 * here - ahead - back)
    engine = Engine(Pendulum(), [record])
    free = [prior("stiffness", 1.0), prior("bias", 1.0)]
    (found,) = engine.beginnings(
        TRUTH, NOISE, free, [np.array([60, row])], lambda b: (b.row, b.slope[1], b.own[1, 1])
    )
    assert found[1][0] == row
    assert found[1][1:] == pytest.approx((-slope, bend), rel=1e-4)
    assert 0.5 * slope**2 / bend > 10.0  # and it is seen


def test_the_best_of_all_moments_is_the_planted_one():
    record = swing(4, n=300)
    row, late = 170, np.arange(300) >= 170
    record = replace(record, z=record.z + 0.3 * late[:, None] * [0.0, 1.0, 0.0])
    rows = np.arange(50, 280)
    (gains,) = Engine(Pendulum(), [record]).beginnings(
        TRUTH, NOISE, [prior("bias", 1.0)], [rows], lambda b: 0.5 * b.slope[0] ** 2 / b.own[0, 0]
    )
    assert abs(rows[int(np.argmax(gains))] - row) <= 3


@pytest.fixture(scope="module")
def short():
    """Two short runs of the bundled flight, its vehicle's model and noise to start from."""
    folder = Path(__file__).parents[1] / "coax_env" / "logs" / "flights" / "windy"
    flight = read_flight(folder)
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    records = []
    for run in flight.runs[:2]:
        record = record_of(run)
        rows = record.t < record.t[0] + 4.0
        records.append(
            replace(record, t=record.t[rows], command=record.command[rows], z=record.z[rows])
        )
    return HeliModel(vehicle), records, starting_noise(flight, vehicle)


def changing(model, records, effects, row):
    moment = Moment(records[1].whole, float(records[1].t[row]))
    return ChangingModel(model, dict.fromkeys(effects, moment), [r.whole for r in records])


def test_moved_from_a_row_on_is_the_model_that_changes_there(short):
    model, records, noise = short
    names, row = ("swash_offset", "gyro_bias", "accel_scale", "torque_balance"), 200
    own = [f for e in names for f in model.effect_parameters(e)]
    free = [*model.base_parameters()[:3], *own]
    values = {**model.bare_values, **{f.name: f.value for f in own}}
    _, (b,) = Engine(model, records).beginnings(
        values, noise, free, [np.empty(0, np.int64), np.array([row])], lambda b: b
    )
    there = Engine(changing(model, records, names, row), records)
    _, lin = there.linearise(values, noise, free)
    unit = 1.0 / np.sqrt(np.diag(b.own)[3:])
    assert lin.slope[1, 3:] * unit == pytest.approx(b.slope[3:] * unit, abs=0.02)
    exact = lin.information[1, 3:, 3:] * np.outer(unit, unit)
    assert b.own[3:, 3:] * np.outer(unit, unit) == pytest.approx(exact, abs=0.01)


@pytest.mark.parametrize("least", [-np.inf, -0.01])
def test_a_changes_worth_is_what_the_joint_quadratic_gains(least):
    """Beside three numbers that are free, two that begin; their least move bounds them."""
    rng = np.random.default_rng(5)
    always, begins = rng.standard_normal((2, 5, 40))
    e, prior, rest, own = 3.0 * rng.standard_normal(40), np.full(5, 0.7), [0, 1, 2], [3, 4]
    quadratic = Quadratic(
        tuple("abcde"), np.zeros((5, 5)), np.zeros(5), np.zeros(5), np.zeros(5), prior,
        np.full(5, least), np.full(5, np.inf), np.zeros((1, 5)), np.zeros((5, 1)),
    )  # fmt: skip
    both = np.vstack([always[rest], begins[own]])
    H, h = both @ both.T + 0.7 * np.eye(5), both @ e
    alone, pull = H[:3, :3], h[:3]
    table = _Table(
        quadratic, [np.zeros((5, 5))], [np.zeros(5)], np.array(rest), np.linalg.inv(alone), pull,
        [np.array(own)], [np.zeros(2)], (np.array([3, 3, 4, 4]), np.array([3, 4, 3, 4])),
    )  # fmt: skip
    row = table.row_of(Beginning(0, 7, begins @ e, begins @ always.T, begins @ begins.T))
    (nats,), (move,) = table.worth(0, *(np.array([part]) for part in row))
    gained = 0.5 * (h @ np.linalg.solve(H, h) - pull @ np.linalg.solve(alone, pull))
    occam = 0.5 * (np.linalg.slogdet(H)[1] - np.linalg.slogdet(alone)[1] - 2.0 * np.log(0.7))
    if np.isinf(least):
        assert nats == pytest.approx(gained - occam)
        assert move == pytest.approx(-np.linalg.solve(H, h)[3:])
    else:
        assert np.all(move >= least) and nats < gained - occam


def test_every_row_of_a_log_at_100_hz_is_a_moment(short):
    """A jump of a reading shows at its own row, and a row beside it no more."""
    _, records, _ = short
    of_second = rows_of(records)[1]
    assert np.all(np.diff(of_second[1:]) == 1)


def test_nothing_begins_at_the_ends_of_a_flight(short):
    _, records, _ = short
    first, last = rows_of(records)
    assert records[0].t[first[0]] > records[0].t[0] + 1.4
    assert last[0] == 0  # between runs it may
    assert records[1].t[last[-1]] < records[1].t[-1] - 1.4


# --- the model that changes -------------------------------------------------------------------------


@pytest.mark.parametrize("jitter", [False, True])
def test_with_the_same_numbers_before_it_is_the_model_itself(short, jitter):
    model, records, noise = short
    if jitter:
        model = JitteryModel.like(model)
        noise = with_jitter(noise, model)
    there = changing(model, records, ["swash_offset"], 150)
    values = {**model.bare_values, "swash_offset.lon": 0.01, "swash_offset.lat": -0.01}
    same = {of_part(n, BEFORE): values[n] for n in ("swash_offset.lon", "swash_offset.lat")}
    expected = Engine(model, records).log_likelihood(values, noise)
    assert Engine(there, records).log_likelihood({**values, **same}, noise) == expected
    assert Engine(there, records).log_likelihood(values, noise) != expected


def test_before_and_after_together_are_the_constant_column(short):
    model, records, noise = short
    effects = ("swash_offset", "command_delay", "accel_scale")
    own = [f for e in effects for f in model.effect_parameters(e)]
    values = {**model.bare_values, **{f.name: f.value + 0.5 * f.std for f in own}}
    _, expected = Engine(model, records).linearise(values, noise, own)
    same = {of_part(f.name, BEFORE): values[f.name] for f in own}
    there = Engine(changing(model, records, effects, 150), records)
    _, lin = there.linearise({**values, **same}, noise, [*own, *map(before, own)])
    k, unit = len(own), np.sqrt(np.einsum("rkk->k", expected.information))
    assert np.all(lin.information[0, :k, :k] == 0.0)  # the first run is all before
    both = lin.slope[:, :k] + lin.slope[:, k:]
    assert both / unit == pytest.approx(expected.slope / unit, abs=1e-3)


def test_a_model_that_moves_in_another_way_has_no_derivatives_of_registers(short):
    model, records, _ = short
    assert model.side_by_side is not None
    assert JitteryModel.like(model).side_by_side is None
    assert changing(JitteryModel.like(model), records, ["swash_offset"], 150).side_by_side is None


def test_later_runs_and_held_out_thirds_are_flown_as_after_the_moment(short):
    model, records, _ = short
    there = changing(model, records, ["swash_offset"], 150)
    assert np.all(there.stretches(records[0]) == 1.0)
    own = there.stretches(records[1])
    assert np.all(own[:150] == 1.0) and np.all(own[150:] == 0.0)
    third = replace(records[1], name="x", run=f"{records[1].whole} (last third)")
    assert np.array_equal(there.stretches(third), own)


# --- hidden by other code ---------------------------------------------------------------------------


def test_the_injector_changes_nothing_before_its_moment(tmp_path):
    def log(name, **later):
        folder = injector.fly(tmp_path / name, {}, gusts=True, seed=5, runs=RUNS[:3], longest=6.0,
                              **later)  # fmt: skip
        return [list(csv.DictReader((folder / f"{run}.csv").open())) for run in RUNS[:3]]

    plain = log("plain")
    changed = log("changed", later={"gyro_bias": {"x": 0.03}}, since=(RUNS[1], 2.5))
    for run, moment in ((0, 99.0), (1, 2.5), (2, -1.0)):
        for a, b in zip(plain[run], changed[run], strict=True):
            rest = {c: v for c, v in a.items() if c != "p"}
            assert {c: b[c] for c in rest} == rest
            if a["p"]:
                jump = float(b["p"]) - float(a["p"])
                assert jump == pytest.approx(0.03 if float(a["t"]) >= moment else 0.0, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "later",
    [{"swash_offset": {"lon": 0.02, "lat": -0.012}}, {"torque_balance": {"scale": 0.07}},
     {"gyro_bias": {"x": 0.03, "y": 0.02, "z": -0.03}}],
    ids=lambda later: next(iter(later)),
)  # fmt: skip
def test_what_begins_in_flight_is_named_with_its_moment(tmp_path, later):
    constant = {"motor_lag": {"upper": 0.1, "lower": 0.1}}
    # in these gusts a plate 0.02 rad off is not seen at all, a torque that begins is worth 8 nats
    injector.fly(tmp_path, constant, gusts="gyro_bias" in later, seed=8, runs=RUNS,
                 later=later, since=("heave_3211", 6.0), longest=9.0)  # fmt: skip
    causes = diagnose(tmp_path, hold_out=[]).findings["causes"]
    assert {c["effect"] for c in causes} == {*constant, *later}
    for cause in causes:
        if cause["effect"] in later:
            assert cause["since"]["run"] == "heave_3211"
            assert abs(cause["since"]["t"] - 6.0) <= max(3.0 * cause["since"]["std"], 0.05)
        else:
            assert cause["since"] is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "later",
    [{"swash_offset": {"lon": -0.02, "lat": -0.016}}, {"cg_offset": {"x": -6e-4, "y": -1.2e-3}},
     {"thrust_scale": {"scale": 0.1}}],
    ids=lambda later: next(iter(later)),
)  # fmt: skip
def test_what_stands_in_its_place_is_not_named(tmp_path, later):
    """A cause found first as one that was always there; thrust in gusts that hide all but its jump."""
    injector.fly(tmp_path, {}, gusts="thrust_scale" in later, seed=21, runs=RUNS, later=later,
                 since=("lat_3211", 4.0), longest=12.0)  # fmt: skip
    (cause,) = diagnose(tmp_path, hold_out=[]).findings["causes"]
    assert cause["effect"] in later
    assert cause["since"]["run"] == "lat_3211"
    assert abs(cause["since"]["t"] - 4.0) <= max(3.0 * cause["since"]["std"], 0.05)


@pytest.mark.slow
def test_nothing_begins_where_a_cause_is_constant(tmp_path):
    hidden = {"swash_offset": {"lon": 0.02, "lat": -0.012}}
    injector.fly(tmp_path, hidden, gusts=False, seed=9, runs=RUNS, longest=9.0)
    findings = diagnose(tmp_path, hold_out=[]).findings
    check_causes(findings, *truth_of(tmp_path))
    assert all(c["since"] is None for c in findings["causes"])
