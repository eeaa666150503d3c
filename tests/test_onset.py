"""What begins in flight: scored at every moment, named with its moment, and nowhere else."""

import csv
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import injector
import numpy as np
import pytest
from causes import check_causes, truth_of
from test_estimation import NOISE, TRUTH, Pendulum, prior, swing

from coax_env.diagnosis.diagnose import diagnose
from coax_env.diagnosis.onsets import changing as changes
from coax_env.diagnosis.onsets import every_moment, growth, search
from coax_env.diagnosis.onsets import moment as moments
from coax_env.diagnosis.onsets import trial as trials
from coax_env.diagnosis.onsets.changing import Changing
from coax_env.diagnosis.onsets.ends import at_an_end
from coax_env.diagnosis.onsets.every_moment import Table, rows_of
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.scores import cost
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.beginnings import Asked, Beginning
from coax_env.estimation.changing_model import (
    BEFORE,
    ChangingModel,
    before,
    clock_of,
    times_of_growth,
)
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, Moment, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.parted_engine import of_part
from coax_env.estimation.quadratic import Linearised, Quadratic
from coax_env.estimation.rotor_jitter import JitteryModel, with_jitter
from coax_env.estimation.state_space import Noise, Record
from coax_env.logs.flight import read_flight
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle_file import load_vehicle

RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")


# --- every moment at once ---------------------------------------------------------------------------


def all_of(k: int) -> Asked:
    """Every column and every pair of k parameters, row by row."""
    return Asked(np.arange(k), np.repeat(np.arange(k), k), np.tile(np.arange(k), k))


def known(found: Table, record: int, slope, across, own=None) -> Beginning:
    """What a table takes of a beginning, of full matrices; own: as across where it is left out."""
    own = across if own is None else own
    return Beginning(record, 5, slope, across[:, found.rest], across[found.pairs], own[found.pairs])


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
    *_, ((_, found),) = engine.beginnings(TRUTH, NOISE, free, [np.array([60, row])], all_of(2))
    assert found.row == row
    assert (found.slope[1], found.own[3]) == pytest.approx((-slope, bend), rel=1e-4)
    assert 0.5 * slope**2 / bend > 10.0  # and it is seen


def test_the_best_of_all_moments_is_the_planted_one():
    record = swing(4, n=300)
    row, late = 170, np.arange(300) >= 170
    record = replace(record, z=record.z + 0.3 * late[:, None] * [0.0, 1.0, 0.0])
    rows = np.arange(50, 280)
    engine = Engine(Pendulum(), [record])
    *_, (found,) = engine.beginnings(TRUTH, NOISE, [prior("bias", 1.0)], [rows], all_of(1))
    gains = [0.5 * b.slope[0] ** 2 / b.own[0] for b in found]
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
    return ChangingModel(model, dict.fromkeys(effects, moment), clock_of(records))


@pytest.mark.slow
def test_moved_from_a_row_on_is_the_model_that_changes_there(short):
    model, records, noise = short
    names, row = ("swash_offset", "gyro_bias", "accel_scale", "torque_balance"), 200
    own = [f for e in names for f in model.effect_parameters(e)]
    free = [*model.base_parameters()[:3], *own]
    values = {**model.bare_values, **{f.name: f.value for f in own}}
    *_, (_, (b,)) = Engine(model, records).beginnings(
        values, noise, free, [np.empty(0, np.int64), np.array([row])], all_of(len(free))
    )
    information = b.own.reshape(len(free), len(free))
    there = Engine(changing(model, records, names, row), records)
    _, lin = there.linearise(values, noise, free)
    unit = 1.0 / np.sqrt(np.diag(information)[3:])
    assert lin.slope[1, 3:] * unit == pytest.approx(b.slope[3:] * unit, abs=0.02)
    exact = lin.information[1, 3:, 3:] * np.outer(unit, unit)
    assert information[3:, 3:] * np.outer(unit, unit) == pytest.approx(exact, abs=0.01)


@pytest.mark.slow
def test_what_begins_and_what_always_was_share_the_rows_from_there_on(short):
    """Information across: the column of what begins, times that before and after together."""
    model, records, noise = short
    names, row = ("swash_offset", "gyro_bias"), 200
    own = [f for e in names for f in model.effect_parameters(e)]
    values = {**model.bare_values, **{f.name: f.value for f in own}}
    *_, (_, (b,)) = Engine(model, records).beginnings(
        values, noise, own, [np.empty(0, np.int64), np.array([row])], all_of(len(own))
    )
    same = {of_part(f.name, BEFORE): values[f.name] for f in own}
    there = Engine(changing(model, records, names, row), records)
    _, lin = there.linearise({**values, **same}, noise, [*own, *map(before, own)])
    k, information = len(own), lin.information[1]
    across = information[:k, :k] + information[:k, k:]
    whole = across + information[k:, :k] + information[k:, k:]
    unit = np.outer(np.diag(information[:k, :k]) ** -0.5, np.diag(whole) ** -0.5)
    assert b.across * unit == pytest.approx(across * unit, abs=0.02)
    assert b.crossed.reshape(k, k) == pytest.approx(b.across)
    assert np.abs(information[:k, k:] * unit).max() > 0.05, "and the past is felt"


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
    table = Table(
        quadratic, [np.zeros((5, 5))], [np.zeros(5)], np.array(rest), np.linalg.inv(alone), pull,
        [np.array(own)], [np.zeros(2)], (np.array([3, 3, 4, 4]), np.array([3, 4, 3, 4])),
        np.array([0, 2, 1, 3]),
    )  # fmt: skip
    begun = known(table, 0, begins @ e, begins @ always.T, begins @ begins.T)
    slopes, information, _ = table.rows([[begun]])
    (nats,), (move,) = table.worth(0, slopes, information)
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


def test_models_that_change_or_jitter_are_flown_side_by_side(short):
    """What does not compile for registers would be flown one by one, and slowly, without a word."""
    model, records, _ = short
    for base in (model, JitteryModel.like(model)):
        assert base.side_by_side is not None
        assert changing(base, records, ["swash_offset"], 150).side_by_side is not None


def test_later_runs_and_held_out_thirds_are_flown_as_after_the_moment(short):
    model, records, _ = short
    there = changing(model, records, ["swash_offset"], 150)
    assert np.all(there.stretches(records[0]) == 1.0)
    own = there.stretches(records[1])
    assert np.all(own[:150] == 1.0) and np.all(own[150:] == 0.0)
    third = replace(records[1], name="x", run=f"{records[1].whole} (last third)")
    assert np.array_equal(there.stretches(third), own)


def test_what_changes_has_numbers_before_and_what_begins_has_none(short):
    """Under the same priors; with the moments that there were, over the same records."""
    model, records, noise = short
    first, second = (Moment(records[1].whole, float(records[1].t[k])) for k in (100, 200))
    runs = clock_of(records)
    made = Problem.of(model, records, ("swash_offset", "gyro_bias", "wind"))
    fit = Fit(("swash_offset",), model.bare_values, noise)
    made = changes.beginning(made, fit, {"wind": first}, runs)
    begun = changes.beginning(made, fit, {"swash_offset": second, "gyro_bias": second}, runs)
    names = [f.name for f in begun.own["swash_offset"]]
    plain = ["swash_offset.lon", "swash_offset.lat"]
    assert names == [*plain, *(of_part(n, BEFORE) for n in plain)]
    assert begun.own["gyro_bias"] == made.own["gyro_bias"] and begun.own["wind"] == made.own["wind"]
    own = begun.own["swash_offset"]
    assert [(f.value, f.std) for f in own[2:]] == [(f.value, f.std) for f in own[:2]]
    assert begun.model.moments == {"wind": first, "swash_offset": second, "gyro_bias": second}
    assert begun.engine.records == made.engine.records and begun.engine.model is begun.model
    again = changes.beginning(begun, fit, {"swash_offset": first}, runs)
    assert again.own["swash_offset"] == own, "its numbers before are there already"


# --- the model in which something grows -------------------------------------------------------------


def growing(model, records, effects, begins, grows):
    """Effects that grow from a time of the second run on."""
    moment = Moment(records[1].whole, begins, grows)
    return ChangingModel(model, dict.fromkeys(effects, moment), clock_of(records))


def test_the_clock_counts_flown_time():
    """From run to run, whatever time their logs begin at, a row between; parts of a run are one."""
    parts = [("a", 20.0, 25.0), ("b", 0.0, 3.0), ("b", 4.0, 9.0), ("c", -1.0, 1.0)]
    none = np.zeros((0, 4))
    runs = [Record(f"{w} {k}", np.arange(a, z + 1e-9, 0.5), none, none, run=w)
            for k, (w, a, z) in enumerate(parts)]  # fmt: skip
    clock = clock_of(runs)
    assert [(name, lap.start, lap.first) for name, lap in clock.items()] == [
        ("a", 0.0, 20.0), ("b", 5.5, 0.0), ("c", 15.0, -1.0)
    ]  # fmt: skip
    model = ChangingModel(HeliModel(load_vehicle("lama400d")), {}, clock)
    assert model.time(Moment("b", 4.5)) == 10.0 and model.moment(10.0) == Moment("b", 4.5)
    assert model.moment(5.4) == Moment("a", 25.4) and model.moment(15.0) == Moment("c", -1.0)
    assert model.times(runs[2])[0] == 9.5


def test_growth_of_no_length_is_the_step(short):
    model, records, noise = short
    values = {**model.bare_values, "swash_offset.lon": 0.01, "swash_offset.lat": -0.01}
    step = Engine(changing(model, records, ["swash_offset"], 150), records)
    at = float(records[1].t[150])
    grown = Engine(growing(model, records, ["swash_offset"], at - 2e-3, 1e-3), records)
    assert grown.log_likelihood(values, noise) == step.log_likelihood(values, noise)


def test_what_grows_has_every_size_between(short):
    """A gyro's bias that grows is a log with as much taken off, row by row; before it, its own."""
    model, records, noise = short
    was, last = 0.01, 0.05
    own = {"gyro_bias.x": last, of_part("gyro_bias.x", BEFORE): was}
    second = records[1]
    begins = float(second.t[100])
    there = growing(model, records, ["gyro_bias"], begins, 2.0)
    share = np.clip((second.t - begins) / 2.0, 0.0, 1.0)
    z = [records[0].z.copy(), second.z.copy()]
    z[0][:, CHANNELS.index("p")] -= was
    z[1][:, CHANNELS.index("p")] -= was + share * (last - was)
    without = [replace(record, z=own) for record, own in zip(records, z, strict=True)]
    expected = Engine(model, without).log_likelihood(model.bare_values, noise)
    found = Engine(there, records).log_likelihood({**model.bare_values, **own}, noise)
    assert found == pytest.approx(expected, abs=1e-6)
    times = {"gyro_bias.moment@begins": there.time(there.moments["gyro_bias"]),
             "gyro_bias.moment@grown": there.time(there.moments["gyro_bias"]) + 2.0}  # fmt: skip
    other = growing(model, records, ["gyro_bias"], begins + 0.3, 0.1)  # values say when
    said = Engine(other, records).log_likelihood({**model.bare_values, **own, **times}, noise)
    assert said == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("registers", [True, False])
def test_when_it_grows_is_a_number_with_a_slope(short, monkeypatch, registers):
    """Of what moves the machine and of a reading: as by differences of the likelihood."""
    model, records, noise = short
    if not registers:
        monkeypatch.setattr(ChangingModel, "side_by_side", None)
    effects = ("swash_offset", "gyro_bias")
    there = growing(model, records, effects, float(records[1].t[100]), 1.5)
    begins = there.time(there.moments["gyro_bias"])
    values = {**model.bare_values, "swash_offset.lon": 0.02, "gyro_bias.x": 0.03}
    free = [f for e in effects for f in times_of_growth(e, begins, begins + 1.5, 8.0)]
    values |= {f.name: f.value for f in free}
    engine = Engine(there, records)
    _, lin = engine.linearise(values, noise, free)
    for k, f in enumerate(free):
        step = 0.02 * f.std  # as the engine's
        ahead = engine.log_likelihood({**values, f.name: f.value + step}, noise)
        here = engine.log_likelihood(values, noise)
        expected = -(ahead - here) / step  # one-sided, as the engine's, and half the bend with it
        information = lin.information[:, k, k].sum()
        bent = lin.slope[:, k].sum() + 0.5 * step * information
        held = 0.02 if f.reading_only else 0.2  # signatures hold the gains fixed
        assert abs(bent - expected) < held * math.sqrt(information), f.name


def test_two_changes_at_once_are_flown_with_both(short):
    """One grows, in its midst another comes at once: blocks from the last back."""
    model, records, _ = short
    second = records[1]
    moments = {
        "swash_offset": Moment(second.whole, 1.0, 2.0),
        "gyro_bias": Moment(second.whole, 2.0),
    }
    there = ChangingModel(model, moments, clock_of(records))
    values = {**model.bare_values, "swash_offset.lon": 0.02, "gyro_bias.x": 0.03}
    knots = there.knots(values)
    assert [k.at for k in knots] == [3, 2, 1, 0]
    own = [there.values_at(k, values) for k in knots]
    assert [o["swash_offset.lon"] for o in own] == pytest.approx([0.0, 0.01, 0.01, 0.02])
    assert [o["gyro_bias.x"] for o in own] == [0.0, 0.0, 0.03, 0.03]
    t = second.t - second.t[0]
    where = there.stretches(second, values)
    expected = np.interp(t, [1.0, 2.0 - 1e-9, 2.0, 3.0], [3.0, 2.0, 1.0, 0.0])
    np.testing.assert_allclose(where, expected, atol=1e-6)


# --- hidden by other code ---------------------------------------------------------------------------


def biased(folder, effects, **later):
    """Logs with a gyro's bias, which the flight does not feel, in three runs of 6 s."""
    injector.fly(folder, effects, gusts=True, seed=5, runs=RUNS[:3], longest=6.0, **later)
    return [list(csv.DictReader((folder / f"{run}.csv").open())) for run in RUNS[:3]]


@pytest.fixture(scope="module")
def unbiased(tmp_path_factory):
    return biased(tmp_path_factory.mktemp("plain"), {})


@pytest.mark.parametrize(
    ("early", "late", "growing"), [(0.0, 0.03, 0.0), (0.03, 0.0, 0.0), (0.0, 0.03, 6.0)],
    ids=["begins", "ends", "grows"],
)  # fmt: skip
def test_the_injector_changes_nothing_but_from_its_moment_on(
    tmp_path, unbiased, early, late, growing
):
    changed = biased(tmp_path, {"gyro_bias": {"x": early}}, later={"gyro_bias": {"x": late}},
                     since=(RUNS[1], 2.5), growing=growing)  # fmt: skip
    for run in range(3):
        for a, b in zip(unbiased[run], changed[run], strict=True):
            rest = {c: v for c, v in a.items() if c != "p"}
            assert {c: b[c] for c in rest} == rest
            past = 6.0 * (run - 1) + float(a["t"]) - 2.5
            share = min(max(past / growing, 0.0), 1.0) if growing else float(past >= -1e-9)
            if a["p"]:
                jump = float(b["p"]) - float(a["p"])
                assert jump == pytest.approx(early + share * (late - early), abs=2e-5)


@pytest.mark.slow
def test_what_grows_is_flown_with_every_size_between():
    """All fields alike; before the log begins as at its first row."""
    some = {"swash_lon": 0.02, "cg_x": -1e-3, "per_volt": 0.04}
    early = injector.Hidden(swash_lon=0.01)
    late = injector.Hidden(**{name: x for name, x in some.items() if name in early._fields})
    middle = injector._between(early, late, 0.25)
    expected = [a + 0.25 * (b - a) for a, b in zip(early, late, strict=True)]
    assert list(middle) == pytest.approx(expected)
    t = np.array([-2.0, 0.0, 1.0, 4.0, 9.0])
    grown = injector.Course(early, late, -1.0, 4.0).shares(t)
    assert grown.tolist() == [0.25, 0.25, 0.5, 1.0, 1.0]
    assert injector.Course(early, late, 4.0).shares(t).tolist() == [0.0, 0.0, 0.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("without", "with_it", "other_noise", "left"),
    [
        (0.4, 0.3, 0.3, True),
        (0.4, 0.15, 0.3, False),  # in its own noise it takes most of the colour
        (0.4, 0.3, 0.15, False),  # in that without the change
        (0.4, 0.0, 0.0, False),
        (0.0, 0.3, 0.3, False),  # noise had made it white: nothing is known by colour
    ],
)
def test_a_step_that_leaves_most_of_the_colour_is_no_change(
    monkeypatch, without, with_it, other_noise, left
):
    """Shares of the colour of q, where the effect shows; r is coloured whatever is done.

    It shows in psi, too, of which there are too few readings to judge.
    """
    shares = iter([without, with_it, other_noise])

    def whiteness(passes, channels):
        of = {"q": next(shares), "r": 0.5}
        return {c: SimpleNamespace(white=x == 0.0, coloured_share=x) for c, x in of.items()}

    monkeypatch.setattr(trials, "whiteness", whiteness)
    monkeypatch.setattr(trials, "quadratic_at", lambda *of: (None, None))
    monkeypatch.setattr(trials, "channels_of", lambda *of: ["psi", "q"])
    problem = SimpleNamespace(
        engine=SimpleNamespace(filter=lambda *of: []), model=SimpleNamespace(channels=("q", "r")),
        own={"cg_offset": ()},
    )  # fmt: skip
    fit = Fit((), {}, Noise({}))
    state = Changing(problem, fit, None, {})  # type: ignore[arg-type]
    assert trials._leaves_colour(state, problem, fit, "cg_offset") == left  # type: ignore[arg-type]


@pytest.mark.slow
def test_what_begins_in_flight_is_named_with_its_moment(tmp_path):
    """In still air: in gusts this torque is worth 8 nats."""
    constant, later = (
        {"gyro_bias": {"x": 0.03}},
        {"torque_balance": {"scale": 0.07}},
    )
    injector.fly(tmp_path, constant, gusts=False, seed=8, runs=RUNS[:3],
                 later=later, since=("heave_3211", 6.0), longest=9.0)  # fmt: skip
    causes = diagnose(tmp_path, hold_out=[]).findings["causes"]
    assert {c["effect"] for c in causes} == {*constant, *later}
    for cause in causes:
        if cause["effect"] in later:
            assert cause["since"]["run"] == "heave_3211"
            assert abs(cause["since"]["t"] - 6.0) <= max(3.0 * cause["since"]["std"], 0.05)
            assert cause["since"]["grown"] is None
        else:
            assert cause["since"] is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "later",
    [{"cg_offset": {"x": -6e-4, "y": -1.2e-3}}, {"thrust_scale": {"scale": 0.1}}],
    ids=lambda later: next(iter(later)),
)  # fmt: skip
def test_what_stands_in_its_place_is_not_named(tmp_path, later):
    """A cause found first as one that was always there; thrust in gusts that hide all but its jump."""
    gusts = "thrust_scale" in later
    runs = RUNS[:3] if gusts else RUNS
    injector.fly(tmp_path, {}, gusts=gusts, seed=21, runs=runs, later=later,
                 since=("lat_3211", 4.0), longest=9.0)  # fmt: skip
    (cause,) = diagnose(tmp_path, hold_out=[]).findings["causes"]
    assert cause["effect"] in later
    assert cause["since"]["run"] == "lat_3211"
    assert abs(cause["since"]["t"] - 4.0) <= max(3.0 * cause["since"]["std"], 0.05)
    assert cause["since"]["grown"] is None


@pytest.mark.slow
def test_what_ends_in_flight_is_named_with_its_moment(tmp_path):
    """Its numbers are those at last, none; before it, what was hidden."""
    hidden = {"swash_offset": {"lon": -0.02, "lat": 0.015}}
    injector.fly(tmp_path, hidden, gusts=False, seed=31, runs=RUNS[:3], longest=9.0,
                 later={"swash_offset": {"lon": 0.0, "lat": 0.0}}, since=("lat_3211", 6.0))  # fmt: skip
    (cause,) = diagnose(tmp_path, hold_out=[]).findings["causes"]
    assert cause["effect"] == "swash_offset" and cause["since"]["run"] == "lat_3211"
    assert abs(cause["since"]["t"] - 6.0) <= max(3.0 * cause["since"]["std"], 0.05)
    for name, size in hidden["swash_offset"].items():
        full = f"swash_offset.{name}"
        assert cause["before"][full]["value"] == pytest.approx(size, abs=0.005)
        assert cause["parameters"][full]["value"] == pytest.approx(0.0, abs=0.005)


@pytest.mark.slow
def test_what_grows_is_named_as_what_it_is(tmp_path):
    """A gyro that drifts off in gusts: for seven seconds, in two runs."""
    hidden = {"gyro_bias": {"y": 0.04, "z": -0.03}}
    injector.fly(tmp_path, {}, gusts=True, seed=41, runs=RUNS[:3], longest=9.0,
                 later=hidden, since=("lat_3211", 5.0), growing=7.0)  # fmt: skip
    (cause,) = diagnose(tmp_path, hold_out=[]).findings["causes"]
    assert cause["effect"] in hidden
    since, grown = cause["since"], cause["since"]["grown"]
    assert since["run"] == "lat_3211" and grown["run"] == "heave_3211"
    assert abs(since["t"] - 5.0) <= 3.0 * since["std"] < 3.0
    assert abs(grown["t"] - 3.0) <= 3.0 * grown["std"] < 3.0
    for name, size in hidden[cause["effect"]].items():
        own = cause["parameters"][f"{cause['effect']}.{name}"]
        assert abs(own["value"] - size) <= 3.0 * own["std"]


@pytest.mark.slow
def test_nothing_begins_where_a_cause_is_constant(tmp_path):
    hidden = {"swash_offset": {"lon": 0.02, "lat": -0.012}}
    injector.fly(tmp_path, hidden, gusts=False, seed=9, runs=RUNS, longest=9.0)
    findings = diagnose(tmp_path, hold_out=[]).findings
    check_causes(findings, *truth_of(tmp_path))
    assert all(c["since"] is None for c in findings["causes"])


# --- what a change is worth, and when it was --------------------------------------------------------


def test_on_long_flights_moments_are_farther_apart():
    """Eight hundred seconds in two runs: some six thousand moments, from a second after a start on."""
    t = np.arange(0.0, 400.005, 0.01)
    none = np.zeros((t.size, 4))
    first, last = rows_of([Record(name, t + 7.0, none, none) for name in "ab"])
    spacing = 800.0 / 6000.0
    np.testing.assert_allclose(np.diff(first), 100.0 * spacing, atol=1.01)
    assert t[first[0]] == pytest.approx(1.0 + 4.0 * spacing, abs=0.011)  # past 1.5 s
    np.testing.assert_allclose(np.diff(last[1:]), 100.0 * spacing, atol=1.01)
    assert t[last[1]] == pytest.approx(1.0, abs=0.011) and last[0] == 0
    assert t[last[-1]] < 398.5 < t[last[-1]] + spacing + 0.01
    short = rows_of([Record("a", t[:1001], none[:1001], none[:1001])])[0]
    assert 1.49 < t[short[0]] < 1.53 and set(np.diff(short)) == {1}


@pytest.mark.parametrize(
    ("run", "t", "end"),
    [("a", 8.4, True), ("a", 8.6, False), ("a", 16.9, False), ("b", 7.1, False), ("b", 15.4, False),
     ("b", 15.6, True)],
)  # fmt: skip
def test_what_a_flight_begins_or_ends_with_is_no_change(run, t, end):
    """Within 1.5 s of its first and last row, not of each run's: a moment may have moved there."""
    own = np.arange(7.0, 17.005, 0.01)
    none = np.zeros((own.size, 4))
    records = [Record(name, own, none, none) for name in "ab"]
    assert at_an_end(records, Moment(run, t)) == end


NAMES = ("mass", "gyro_bias.x", "gyro_bias.y", "gyro_bias.z", "yaw_damping.coefficient")


def table(at: dict[str, float], slope: np.ndarray):
    """The table of two effects at a fit whose slopes are these, of three runs, and its quadratic."""
    model = HeliModel(load_vehicle("lama400d"))
    own = {e: tuple(model.effect_parameters(e)) for e in ("gyro_bias", "yaw_damping")}
    mass = next(f for f in model.base_parameters() if f.name == "mass")
    problem = Problem(model, None, (mass,), own)
    free = problem.parameters
    assert tuple(f.name for f in free) == NAMES
    std = np.array([f.std for f in free])
    rng = np.random.default_rng(1)
    A = 2.0 * rng.standard_normal((3, 12, len(free))) / std
    information = np.einsum("rni,rnj->rij", A, A)
    lin = Linearised(
        NAMES, information, slope / std, np.ones((3, len(free), 1)), rng.standard_normal((30, 5))
    )
    values = {f.name: f.value + at.get(f.name, 0.0) * f.std for f in free}
    quadratic = Quadratic.of(lin, free, values)
    state = Changing(problem, Fit((), values, NOISE_OF_ALL), quadratic, {})
    found = Table.of(state, {e: [f.name for f in own[e]] for e in own})
    return found, quadratic, std


def worths(found: Table, there: Beginning, ends: bool = False) -> list[tuple[float, np.ndarray]]:
    """What a change of each effect there is worth, or its end, and how its numbers move."""
    rows = found.rows([[there]])
    of_form = found.ended(*rows) if ends else rows[:2]
    return [(nats[0], moves[0]) for nats, moves in (found.worth(k, *of_form) for k in range(2))]


NOISE_OF_ALL = Noise({})
SLOPES = np.array([[0.4, 9.0, -7.0, 5.0, -30.0], [-0.2, 3.0, 4.0, 8.0, -20.0],
                   [0.1, 6.0, -5.0, 2.0, -9.0]])  # fmt: skip


def log_evidence(G, g, precision, away) -> float:
    """log of the integral of exp(-g'x - x'Gx/2) times the normal priors of x + away."""
    P = np.diag(precision)
    pull = g + precision * away
    logs = np.linalg.slogdet(P)[1] - np.linalg.slogdet(G + P)[1]
    return float(0.5 * pull @ np.linalg.solve(G + P, pull) + 0.5 * logs)


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("row", [0, 1])
def test_a_changes_score_is_the_log_of_the_ratio_of_two_evidences(row, ends):
    """What begins in the second run acts on a part of it and on all of the third; what ends there on
    the first and on the rest of the second; all else on all runs.
    """
    found, q, _ = table({"mass": 0.3}, SLOPES)
    parts = q.parts
    assert parts is not None
    share = (0.7, 0.2)[row]
    here = known(found, 1, share * parts.slope[1], share * parts.information[1])
    acts = np.array([1.0, 1.0 - share, 0.0] if ends else [0.0, share, 1.0])
    information = np.einsum("r,rij->ij", acts, parts.information)
    slope = acts @ parts.slope
    both = zip(worths(found, here, ends), (NAMES[1:4], NAMES[4:]), strict=True)
    for (nats, x), names in both:
        c = q.index(names)
        across = information[np.ix_(c, [0])]
        G = np.block([[q.G[:1, :1], across.T], [across, information[np.ix_(c, c)]]])
        g = np.concatenate([q.g[:1], slope[c]])
        precision = np.concatenate([q.precision[:1], q.precision[c]])
        away = np.concatenate([(q.at - q.mean)[:1], np.zeros(len(c))])
        alone = log_evidence(q.G[:1, :1], q.g[:1], q.precision[:1], away[:1])
        best = np.linalg.solve(G + np.diag(precision), -(g + precision * away))[1:]
        np.testing.assert_allclose(x, best, atol=1e-9 * np.abs(best).max())
        assert nats == pytest.approx(log_evidence(G, g, precision, away) - alone, rel=1e-9)


def test_a_constant_causes_score_is_that_of_what_ends_behind_the_flight():
    """All of its information: what ends in the last run, with nothing of it left from there on."""
    found, _, _ = table({"mass": 0.3}, SLOPES)
    size = len(NAMES)
    nothing = known(found, 2, np.zeros(size), np.zeros((size, size)))
    for k, (nats, _) in enumerate(worths(found, nothing, ends=True)):
        assert found.worth_of_constant(k) == pytest.approx(nats, rel=1e-9)


def test_a_change_that_is_too_small_to_matter_is_worth_nothing():
    found, q, _ = table({}, 1e-6 * SLOPES)
    parts = q.parts
    assert parts is not None
    here = known(found, 2, parts.slope[2], parts.information[2])
    assert [nats for nats, _ in worths(found, here)] == [-math.inf, -math.inf]


def test_a_change_stays_within_what_physics_gives():
    """A damping that wants to be negative is at nothing: no change, and no worth."""
    found, q, _ = table({}, -SLOPES)
    parts = q.parts
    assert parts is not None
    here = known(found, 0, parts.slope[0], parts.information[0])
    nats, x = worths(found, here)[1]
    assert x == pytest.approx([0.0], abs=1e-12) and nats == -math.inf


def test_what_lies_behind_a_run_is_the_sum_of_the_later_ones():
    parts = np.array([[1.0, 2.0], [3.0, 5.0], [7.0, 11.0]])
    np.testing.assert_allclose(every_moment._behind(parts), [[10.0, 16.0], [7.0, 11.0], [0.0, 0.0]])


def flown(t: np.ndarray, e: float, whole: str):
    return SimpleNamespace(
        record=SimpleNamespace(t=t, whole=whole), innovations=np.full((t.size, 2), e)
    )


def test_what_a_gust_may_have_made_counts_for_nothing():
    """Half a second before a moment and one and a half behind it, in its own run alone."""
    t = 20.0 + 0.1 * np.arange(100)
    without = [flown(t, 3.0, "a"), flown(t, 2.0, "b")]
    with_it = [flown(t, 1.0, "a"), flown(t, 1.0, "b")]
    found = trials._lasting(without, with_it, Moment("b", 25.04))
    rows = 100 - 20  # 24.6 to 26.5 s are left out
    assert found == pytest.approx(0.5 * 2 * (100 * (9.0 - 1.0) + rows * (4.0 - 1.0)))
    with_it[0].innovations[7, 1] = np.nan
    assert trials._lasting(without, with_it, Moment("b", 25.04)) == pytest.approx(found - 4.0)


def test_a_change_matters_from_its_smallest_size_on():
    """Against what it was before: its number then, or off."""
    model = HeliModel(load_vehicle("lama400d"))
    problem = SimpleNamespace(model=model, row=0.01)
    p = next(p for p in model.sized("gyro_bias") if p.name == "y")
    name = "gyro_bias.y"
    off = {"gyro_bias.x": 0.0, "gyro_bias.z": 0.0}
    for change, matters in ((1.01, True), (-1.01, True), (0.99, False), (-0.99, False)):
        fit = Fit((), {**off, name: change * p.smallest}, NOISE_OF_ALL)
        assert trials._matters(problem, fit, "gyro_bias") == matters
        was = {of_part(n, BEFORE): 0.0 for n in off} | {of_part(name, BEFORE): 5.0 * p.smallest}
        moved = fit.at({name: (5.0 + change) * p.smallest, **was})
        assert trials._matters(problem, moved, "gyro_bias") == matters
        assert trials._matters(problem, fit, "gyro_bias", 0.5), "half of that is half of it"


@pytest.mark.parametrize(
    ("row", "change", "matters"),
    [(0.04, 0.034, True), (0.04, 0.030, False), (0.01, 0.009, True), (0.005, 0.007, False)],
)
def test_a_delay_has_changed_where_rows_show_it(row, change, matters):
    """By two std of a difference of two times, each uniform within a row; and by its smallest size."""
    times = np.random.default_rng(1).uniform(0.0, row, (2, 100_000))
    assert trials.ROWS_APART * row == pytest.approx(2.0 * np.std(times[0] - times[1]), rel=0.01)
    problem = SimpleNamespace(model=HeliModel(load_vehicle("lama400d")), row=row)
    name = "servo_delay.time"
    values = {name: 0.05, of_part(name, BEFORE): 0.05 - change}
    assert trials._matters(problem, Fit((), values, NOISE_OF_ALL), "servo_delay") == matters


@pytest.fixture
def profile(monkeypatch):
    """A problem whose likelihood of a moment is a function of its time, and where it was asked."""
    asked: list[float] = []

    def of(nats, t: np.ndarray, moment: float) -> Any:
        class Model:
            def __init__(self, base: Any, moments: dict[str, Moment], runs: Any) -> None:
                self.base, self.moments, self.clock = base, moments, runs

        class Likelihood:
            def __init__(self, model: Model, records: Any, threads: int) -> None:
                self.t = model.moments["wind"].t
                assert [r.whole for r in records] == ["b", "b"]

            def log_likelihood(self, values: Any, noise: Any) -> float:
                asked.append(self.t)
                return float(nats(self.t))

        monkeypatch.setattr(moments, "ChangingModel", Model)
        monkeypatch.setattr(growth, "ChangingModel", Model)
        monkeypatch.setattr(moments, "Engine", Likelihood)
        half = t.size // 2
        records = [SimpleNamespace(whole=w, t=own)
                   for w, own in (("a", t), ("b", t[:half]), ("b", t[half:]))]  # fmt: skip
        model = Model(None, {"wind": Moment("b", moment)}, ("a", "b"))
        return SimpleNamespace(model=model, engine=SimpleNamespace(records=records, threads=1))

    return of, asked


@pytest.mark.parametrize("inflation", [1.0, 4.0])
def test_the_interval_of_a_moment_is_its_posteriors(profile, inflation):
    """A normal one: mean, std beside half a row's doubt, and width sqrt(2 pi) std."""
    of, asked = profile
    t, best, std = 30.0 + 0.01 * np.arange(900), 33.613, 0.08
    problem = of(lambda s: -0.5 * ((s - best) / std) ** 2 - 700.0, t, 33.3)
    found = moments.moment_of(problem, Fit((), {}, NOISE_OF_ALL), "wind", inflation)
    wide = math.sqrt(inflation) * std
    assert found.moment == Moment("b", pytest.approx(33.61)) and found.effect == "wind"
    assert found.t == pytest.approx(best, abs=0.003)
    assert found.std == pytest.approx(math.hypot(wide, 0.01), rel=0.01)
    assert found.width == pytest.approx(math.sqrt(2.0 * math.pi) * wide, rel=0.01)
    assert len([s for s in asked if abs(s - 33.3) > 1.0 + 1e-9]) <= moments.AFAR
    assert found.entry() == {"run": "b", "t": found.t, "std": found.std, "at_once": 1.0,
                             "grown": None}  # fmt: skip


def ambiguous(short, nats: float):
    """A step at 2.0 s of the second run, +- 0.1, that may as well grow from 1 s to 2.5 s there."""
    model, records, _ = short
    moment = Moment(records[1].whole, 2.0)
    there = ChangingModel(model, {"gyro_bias": moment}, clock_of(records))
    problem = SimpleNamespace(model=there)
    covariance = np.array([[0.09, 0.03], [0.03, 0.16]])
    times = there.time(moment) - 1.0, there.time(moment) + 0.5
    own = growth.Growth(*times, covariance, nats)
    found = changes.Onset("gyro_bias", moment, 2.0, 0.1, 0.25, 20.0, own)
    return problem, found


@pytest.mark.parametrize("inflation", [1.0, 4.0])
def test_where_a_step_may_be_growth_its_interval_has_both(short, inflation):
    """The mixture of both, as likely as the evidence has them; all of the step where it is clear."""
    problem, found = ambiguous(short, 0.0)
    mixed = moments._as_step(problem, found, inflation)
    both = [2.0, 1.0], [0.1**2, inflation * 0.09]
    assert mixed.at_once == 0.5 and mixed.t == pytest.approx(np.mean(both[0]))
    expected = np.mean(both[1]) + np.var(both[0])
    assert mixed.std == pytest.approx(math.sqrt(expected)) and mixed.grown is None
    clear = moments._as_step(problem, replace(found, growth=replace(found.growth, nats=-60.0)))
    assert (clear.t, clear.std) == (pytest.approx(2.0), pytest.approx(0.1))
    assert clear.entry()["at_once"] == 1.0 and clear.entry()["grown"] is None


def test_what_grows_says_from_when_to_when(short):
    problem, found = ambiguous(short, 7.5)
    grows = moments._as_growth(problem, found)
    run = found.moment.run
    assert grows.moment == Moment(run, pytest.approx(1.0), pytest.approx(1.5))
    entry = grows.entry()
    assert entry["t"] == pytest.approx(1.0) and entry["std"] == pytest.approx(0.3)
    assert entry["at_once"] == pytest.approx(math.exp(-7.5), abs=1e-4)
    assert entry["grown"] == {"run": run, "t": pytest.approx(2.5), "std": pytest.approx(0.4)}


@pytest.mark.parametrize("inflation", [1.0, 2.0])
def test_the_interval_of_growth_is_that_of_its_likelihoods_profile(short, monkeypatch, inflation):
    """One that falls evenly to both sides, where a parabola would know better: Laplace's law.

    What is grown follows at half the pace; its own spread, at a given first time, is known.
    """
    problem, found = ambiguous(short, 30.0)
    names = [f"gyro_bias.{name}" for name in ("moment@begins", "moment@grown")]
    peak, scale = 3.0, 0.25
    free = times_of_growth("gyro_bias", 3.2, 5.0, 8.0)

    def fitted(of: Any, fit: Fit, tolerance: float, held: list[str]) -> Fit:
        begins = fit.values[names[0]]
        there = fit.at({names[1]: 5.0 + 0.5 * (begins - peak)})
        prior = sum(0.5 * ((there.values[f.name] - f.value) / f.std) ** 2 for f in free)
        return replace(there, objective=abs(begins - peak) / scale + prior)

    problem.free = lambda active: free
    own = replace(found.growth, covariance=np.array([[0.01, 0.005], [0.005, 0.0425]]))
    monkeypatch.setattr(growth, "growth_at", lambda *given: own)
    monkeypatch.setattr(growth, "fitted", fitted)
    fit = Fit(("gyro_bias",), {names[0]: 3.2, names[1]: 5.0}, NOISE_OF_ALL)
    said = growth.profiled(problem, fit, None, "gyro_bias", 30.0, inflation)  # type: ignore[arg-type]
    variance = 2.0 * (inflation * scale) ** 2
    assert said.begins == pytest.approx(peak, abs=0.1 * scale)
    assert said.covariance[0, 0] == pytest.approx(variance, rel=0.25)
    assert said.covariance[1, 1] == pytest.approx(0.25 * variance + inflation * 0.04, rel=0.25)
    assert said.nats == 30.0 / inflation


def test_a_profile_that_falls_from_its_end_has_the_spread_of_that_fall():
    """A nat for each second, asked every ten: the exponential law, not the one point that is best."""
    begins = np.array([20.0, 0.0, 10.0])
    mean, covariance = growth._moments(np.column_stack([begins, 100.0 - 2.0 * begins]), -begins)
    assert mean == pytest.approx([1.0, 98.0], abs=0.03)
    assert covariance == pytest.approx(np.array([[1.0, -2.0], [-2.0, 4.0]]), abs=0.1)


def test_two_times_pay_as_one_that_is_as_rare():
    """A normal posterior's area over that of all pairs, the later one second."""
    own = growth.Growth(10.0, 20.0, np.array([[0.09, 0.0], [0.0, 0.16]]), 0.0)
    share = 2.0 * math.pi * 0.3 * 0.4 / (0.5 * 100.0**2)
    assert own.width(100.0) == pytest.approx(100.0 * share)
    assert replace(own, covariance=1e9 * np.eye(2)).width(100.0) == 100.0
    assert own.at_once() == 0.5 and replace(own, nats=2.0).at_once(2.0) == 1.0 / (1.0 + math.e)


@pytest.mark.parametrize(("begins", "nats"), [(None, 5.0), (1.4, 15.0)])
def test_growth_is_not_credited_with_what_a_step_would_gain_as_well(
    short, monkeypatch, begins, nats
):
    """Both are taken until nothing is gained: 15 nats beside a step that had ten to gain are five. But
    not where it begins with the flight: it is no change then.
    """
    problem, found = ambiguous(short, 0.0)
    problem.engine = SimpleNamespace(records=short[1])
    own = found.growth if begins is None else replace(found.growth, begins=begins)
    problem.settings, problem.seconds = SETTINGS, 8.0
    gained = {"step": 10.0, "grows": 0.0}

    def converged(of: Any, fit: Fit) -> Fit:
        return replace(fit, objective=fit.objective - gained[fit.active[0]])

    step, grows = (
        Fit((e,), {}, NOISE_OF_ALL, nats) for e, nats in (("step", 100.0), ("grows", 85.0))
    )
    wider = SimpleNamespace(free=lambda active: [], model=problem.model)
    monkeypatch.setattr(growth, "_starts", lambda *given: [(wider, grows)])
    monkeypatch.setattr(growth, "_about", lambda of, effect, own: of)
    monkeypatch.setattr(growth, "noise_fitted", lambda of, fit: fit)
    monkeypatch.setattr(growth, "fitted", lambda of, fit, steps: fit)
    monkeypatch.setattr(growth, "converged", converged)
    monkeypatch.setattr(growth, "quadratic_at", lambda of, fit, free: (fit, None))
    monkeypatch.setattr(growth, "growth_at", lambda *given: own)
    width = own.width(8.0)  # of a step that is known as well, and pays the same price
    tried = growth.growing(problem, step, "gyro_bias", found.moment, width)
    assert tried is not None and tried[2].nats == pytest.approx(nats)


@pytest.mark.parametrize(("nats", "grows"), [(5.9, False), (6.1, True), (None, False)])
def test_it_is_said_to_grow_where_that_is_worth_more_than_a_tie(short, monkeypatch, nats, grows):
    problem, found = ambiguous(short, nats or 0.0)
    own, found = found.growth, replace(found, growth=None)
    problem.settings, problem.seconds, problem.report = SETTINGS, 8.0, lambda text: None
    step, other = Fit((), {}, NOISE_OF_ALL), Fit(("gyro_bias",), {}, NOISE_OF_ALL)
    wider = SimpleNamespace(model=problem.model, with_model=lambda model: model)
    tried = None if nats is None else (wider, other, own)
    monkeypatch.setattr(moments, "growing", lambda *given: tried)
    then, fit, said = moments.grown_or_step(problem, step, found)
    assert (said.grown is not None) == grows and fit is (other if grows else step)
    if grows:
        assert then.moments["gyro_bias"] == said.moment and said.width == own.width(8.0)
    else:
        assert then is problem and said.moment == found.moment
        assert said.std == found.std if nats is None else said.std > found.std


def test_a_moments_likelihood_is_asked_where_it_has_a_share(profile):
    """Every tenth row and some others at first, then only within ten nats of the best."""
    of, asked = profile
    t = 0.01 * np.arange(1000)
    problem = of(lambda s: -50.0 * abs(s - 5.037) / 0.1, t, 5.0)
    records = problem.engine.records[1:]
    near = t[400:601]
    found = moments._profile(problem, Fit((), {}, NOISE_OF_ALL), "wind", records, near)
    exact = -50.0 * np.abs(near - 5.037) / 0.1
    close = exact > -9.0
    np.testing.assert_allclose(found[close], exact[close], atol=1e-9)
    assert int(np.argmax(found)) == int(np.argmax(exact))
    far = [s for s in asked if abs(s - 5.037) > 0.15]
    assert len(far) <= 20 + moments.AFAR and len(asked) < 45 + moments.AFAR


def test_where_runs_are_short_all_of_the_flown_time_is_asked_for():
    records = [
        SimpleNamespace(t=np.array([4.0, 5.0, 9.0])),
        SimpleNamespace(t=np.array([1.0, 3.5])),
    ]
    made = Problem(None, SimpleNamespace(records=records), (), {})  # type: ignore[arg-type]
    assert made.seconds == 7.5


def test_a_models_cost_is_its_objective_and_occams_factor():
    _, q, _ = table({}, SLOPES)
    model = HeliModel(load_vehicle("lama400d"))
    mass = next(f for f in model.base_parameters() if f.name == "mass")
    own = {e: tuple(model.effect_parameters(e)) for e in ("gyro_bias", "yaw_damping")}
    problem = Problem(model, None, (mass,), own)
    fit = Fit(("yaw_damping",), {}, NOISE_OF_ALL, objective=80.0)
    expected = 80.0 + q.occam(["yaw_damping.coefficient"], ["mass"])
    assert cost(problem, fit, q) == pytest.approx(expected)
    assert cost(problem, replace(fit, active=()), q) == 80.0


def weighed(form: str, inflation: float):
    """A change of 100 nats in 100 s, its state at 170: what `_worth` takes, but for the rivals.

    Of what was there and changes, of what begins, or of what ends; Occam's factor 5 nats a number.
    """
    clock = 0.01 * np.arange(10_000)
    record = Record("a", clock, np.zeros((clock.size, 4)), np.zeros((clock.size, 2)))
    engine = SimpleNamespace(filter=lambda values, noise: [], records=[record])
    names = ["gyro_bias.x", *([] if form == "begins" else [of_part("gyro_bias.x", BEFORE)])]
    problem = SimpleNamespace(
        engine=engine, model=SimpleNamespace(channels=("p", "q")), settings=SETTINGS, seconds=100.0,
        sees_poses_alone=False, answers_unseen=False, acting_names=lambda effect: names,
        free_names=lambda active: ["mass", *names],
    )  # fmt: skip
    extra = names if form == "ends" else names[-1:]

    def variance_inflation(own: Any, free: Any) -> float:
        assert own == extra and set(free) == {"mass", *names}
        return inflation

    def occam(own: Any, rest: Any) -> float:
        assert {*own, *rest} == {"mass", *names}
        return 5.0 * len(own)

    quadratic = SimpleNamespace(variance_inflation=variance_inflation, occam=occam)
    active = ("gyro_bias",) if form == "changes" else ()
    fit = Fit(active, {"gyro_bias.x": 0.0}, NOISE_OF_ALL, objective=170.0)
    trial = replace(fit, active=("gyro_bias",), objective=100.0, values=dict.fromkeys(names, 0.01))
    return SimpleNamespace(problem=problem, fit=fit), problem, trial, quadratic


@pytest.mark.parametrize("form", ["changes", "begins", "ends"])
@pytest.mark.parametrize("inflation", [1.0, 2.0])
def test_a_change_pays_for_its_numbers_and_for_its_moment(monkeypatch, form, inflation):
    """Beside no change; and beside a cause that was always there it must be worth a tie, the moment
    paid for. None is worth anything that a gust made, that is small, or where channels stay coloured.
    """
    made = {"lasting": 12.1, "matters": True, "white": True}
    monkeypatch.setattr(trials, "_lasting", lambda without, with_it, moment: made["lasting"])
    monkeypatch.setattr(trials, "_matters", lambda problem, fit, effect: made["matters"])
    monkeypatch.setattr(trials, "channels_of", lambda *given: ["p"])
    monkeypatch.setattr(
        trials, "whiteness", lambda passes, channels: {
            "p": SimpleNamespace(white=made["white"]), "q": SimpleNamespace(white=False)}
    )  # fmt: skip
    state, problem, trial, quadratic = weighed(form, inflation)
    found = changes.Onset("gyro_bias", Moment("a", 9.0), 9.0, 0.5, 2.0, 0.0)
    of_moment = math.log(100.0 / 2.0)

    def onset(always: float = 900.0, same: float = 160.0) -> changes.Onset:
        rivals = trials.Rivals(
            replace(state.fit, objective=same),
            None if form == "changes" else replace(trial, objective=always),
        )
        return trials._worth(state, problem, trial, rivals, quadratic, found)  # type: ignore[arg-type]

    def worth(**rivals: float) -> float:
        return onset(**rivals).nats

    expected = 60.0 / inflation - (10.0 if form == "ends" else 5.0) - of_moment
    assert worth() == pytest.approx(expected)
    tie = 100.0 + inflation * (SETTINGS.tie + of_moment + (5.0 if form == "ends" else 0.0))
    if form == "changes":
        assert worth(same=tie + 5.0 * inflation - 0.1) == -math.inf
        assert worth(same=tie + 5.0 * inflation + 0.1) == pytest.approx(6.0 + 0.1 / inflation)
    else:
        assert worth(always=tie - 0.1) == -math.inf
        assert worth(always=tie + 0.1) == pytest.approx(expected)
        assert onset(always=tie + 0.1).beside == pytest.approx(SETTINGS.tie + 0.1 / inflation)
    assert onset().beside == pytest.approx(expected)
    for key, wrong in (("lasting", 6.0 * inflation - 0.1), ("matters", False), ("white", False)):
        kept, made[key] = made[key], wrong
        assert worth() == -math.inf, key
        made[key] = kept
    made["lasting"] = 6.0 * inflation + 0.1
    assert worth() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("same", "form", "closer"),
    [(900.0, "changes", False), (130.0, "changes", True), (99.0, "changes", False),
     (900.0, "begins", True), (900.0, "ends", True)],
)  # fmt: skip
def test_what_may_decide_is_refitted_until_nothing_is_gained(monkeypatch, same, form, closer):
    """The change as well as what it is beside: 100 nats; a cause always there 131, from the size that
    it had while it was there.
    """
    was_there = form == "changes"
    state, problem, trial, _ = weighed(form, 1.0)
    if form == "ends":
        was = {"gyro_bias.x": 0.0, of_part("gyro_bias.x", BEFORE): 0.01}
        trial = replace(trial, values=was)
    state.fit = replace(state.fit, objective=1000.0)

    def fitted(of: Any, fit: Fit, steps: int) -> Fit:
        assert of is state.problem and fit.noise is trial.noise
        begun = not was_there and fit.active == trial.active
        assert not begun or fit.values["gyro_bias.x"] == 0.01
        return replace(fit, objective=131.0 if begun else same)

    monkeypatch.setattr(trials, "fitted", fitted)
    monkeypatch.setattr(trials, "noise_fitted", lambda of, fit: fit)
    monkeypatch.setattr(
        trials, "converged", lambda of, fit: replace(fit, objective=fit.objective - 7.0)
    )
    after, rivals = trials._compared(state, problem, trial, "gyro_bias")
    less = 7.0 if closer else 0.0
    assert after.objective == 100.0 - less and rivals.same.objective == same - less
    assert (rivals.always is None) == was_there
    assert was_there or rivals.always.objective == 131.0 - less
    state.fit = replace(state.fit, objective=90.0)  # better without another noise
    assert trials._compared(state, problem, trial, "gyro_bias")[1].same is state.fit


def scores(**worth: tuple[float, float]) -> list[every_moment.Scored]:
    """Changes with what each is worth, and worth beside a constant cause of its name."""
    moment = Moment("a", 9.0)
    return [
        every_moment.Scored(e, nats, moment, {}, False, beside)
        for e, (nats, beside) in worth.items()
    ]


def test_what_a_constant_cause_does_as_well_is_not_worth_a_fit():
    found = scores(wind=(7.1, 3.1), servo_lag=(6.9, 6.9), cg_offset=(60.0, 2.9))
    problem: Any = SimpleNamespace(settings=SETTINGS, sees_poses_alone=False, answers_unseen=False)
    assert [s.effect for s in search._standing(problem, found)] == ["wind"]


@pytest.mark.parametrize("poses", [True, False])
def test_a_late_answer_must_be_worth_more_from_some_moment_on_where_answers_are_unseen(poses):
    """As many times by poses alone, or where commands answer what the filter does not see; a constant
    delay too; what is no answer to a command as much as else."""
    found = scores(wind=(7.1, 7.1), command_delay=(20.0, 20.0), motor_lag=(22.0, 22.0))
    problem: Any = SimpleNamespace(
        settings=SETTINGS, sees_poses_alone=poses, answers_unseen=not poses, unseen_times=3.0
    )
    assert [s.effect for s in search._standing(problem, found)] == ["wind", "motor_lag"]
    state: Any = SimpleNamespace(
        problem=problem, fit=SimpleNamespace(active=("servo_lag", "gyro_bias"))
    )
    assert search._least(state, "command_delay") == 3.0 * SETTINGS.evidence
    assert search._least(state, "wind") == SETTINGS.evidence
    assert search._least(state, "servo_lag") == SETTINGS.evidence
    assert search._least(state, "gyro_bias") == SETTINGS.tie


@pytest.mark.parametrize("gains", [True, False])
def test_what_commands_explain_is_not_worth_a_fit(monkeypatch, gains):
    """Asked again with their gains where they carry something on the gusts."""
    found = scores(servo_delay=(27.9, 17.7), swash_gain=(20.0, 20.0))
    with_gains = scores(swash_gain=(8.0, 8.0), rate_damping=(9.0, 9.0), servo_delay=(0.1, 0.1))
    monkeypatch.setattr(search, "with_command_gains", lambda p, fit, coloured: (p, fit))
    monkeypatch.setattr(search, "has_command_gains", lambda p: gains)
    monkeypatch.setattr(search, "linearise", lambda p, fit: (fit, [], None))
    monkeypatch.setattr(search, "scored", lambda state: (state, with_gains))
    fit = Fit((), {}, NOISE_OF_ALL)
    problem = SimpleNamespace(settings=SETTINGS, sees_poses_alone=False, answers_unseen=False)
    problem.of_candidates = lambda names: problem
    steady = Changing(problem, fit, None, {})  # type: ignore[arg-type]
    kept = search._beside_commands(steady, found)
    assert kept == (found[1:] if gains else found)


@pytest.mark.parametrize(
    ("drifts", "kept"),
    [(30.0, {"servo_lag", "cg_offset", "wind"}), (90.0, {"servo_lag", "wind"}), (500.0, {"wind"})],
)
def test_what_drifts_explain_as_well_is_not_worth_a_fit(monkeypatch, drifts, kept):
    """Less than half of what drifts are worth, and nothing beside them; wind stands beside them."""
    found = scores(servo_lag=(50.0, 50.0), cg_offset=(40.0, 40.0), wind=(30.0, 30.0))
    beside = scores(wind=(21.0, 5.5), servo_lag=(4.7, 4.7), cg_offset=(9.0, 2.0))
    fit = Fit((), {}, Noise({"trim_force_z": 0.01}), objective=100.0)
    problem = SimpleNamespace(
        settings=SETTINGS,
        sees_poses_alone=False,
        answers_unseen=False,
        of_candidates=lambda names: problem,
    )
    state = Changing(problem, fit, None, {})  # type: ignore[arg-type]
    calm = replace(fit, noise=Noise({"trim_force_z": 1e-6}), objective=100.0 + drifts)
    monkeypatch.setattr(search, "scored", lambda state: (state, beside))
    steady = replace(state, fit=calm)
    assert {s.effect for s in search._beyond_drifts(state, steady, found)} == kept
    assert search._beyond_drifts(state, state, found) == found  # nothing drifts


@pytest.mark.parametrize(
    ("gained", "coloured", "closer"),
    [(500.0, True, True), (500.0, False, False), (5.0, True, False)],
)
def test_colour_is_asked_of_a_fit_that_has_converged(monkeypatch, gained, coloured, closer):
    """Its noise may be what is coloured on the way; what gains less than a tie is not asked. What comes
    as the flight begins is no change.
    """
    state, problem, trial, quadratic = weighed("begins", 1.0)
    problem.free = lambda active: []
    found, at = changes.Onset("gyro_bias", Moment("a", 9.0), 9.0, 0.5, 2.0, 0.0), [9.0]
    rivals = trials.Rivals(replace(trial, objective=100.0 + gained), None)
    stand_ins = {
        "beginning": lambda *given: problem, "fitted": lambda of, fit, steps=3: trial,
        "noise_fitted": lambda of, fit: fit, "moved_to_best": lambda *given: (problem, found),
        "grown_or_step": lambda of, fit, found: (of, fit, replace(found, moment=Moment("a", at[0]))),
        "_with_noise_of": lambda of, fit, other: fit, "_compared": lambda *given: (trial, rivals),
        "converged": lambda of, fit: replace(fit, objective=90.0),
        "quadratic_at": lambda of, fit, free: (fit, quadratic),
        "_leaves_colour": lambda *given: False, "_matters": lambda *given: True,
        "_is_coloured": lambda of, fit, q, effect: coloured and fit.objective > 95.0,
        "_worth": lambda state, of, fit, rivals, q, found: replace(found, nats=-fit.objective),
    }  # fmt: skip
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(trials, name, stand_in)
    moment = Moment("a", 9.0)
    candidate = every_moment.Scored("gyro_bias", 20.0, moment, {"gyro_bias.x": 0.01}, False, 20.0)
    steady = SimpleNamespace(fit=state.fit)
    changing_state = Changing(problem, state.fit, quadratic, {})  # type: ignore[arg-type]
    after = trials.fitted_change(changing_state, steady, candidate, {}, None)  # type: ignore[arg-type]
    assert after is not None
    ended = 90.0 if closer else 100.0
    assert after.state.fit.objective == ended and after.onset.nats == -ended
    at[:] = [1.4]
    assert trials.fitted_change(changing_state, steady, candidate, {}, None) is None  # type: ignore[arg-type]


def trial_worth(nats: float, gained: float) -> trials.Trial:
    """A change that was fitted, and what it gained after its step."""
    best = changes.Onset("servo_lag", Moment("a", 9.0), 9.0, 0.1, 0.1, nats)
    return trials.Trial(None, best, gained)  # type: ignore[arg-type]


def test_a_step_is_out_of_reach_where_it_lacks_more_than_can_be_made_up():
    """600 nats; the best gained 50 after its step, and the other may so too."""
    state = SimpleNamespace(fit=Fit((), {}, NOISE_OF_ALL, objective=1000.0))
    for gained, step, out in (
        (50.0, 1000.0, True), (50.0, 751.0, True), (50.0, 749.0, False), (250.0, 951.0, True),
        (250.0, 949.0, False), (-80.0, 701.0, True), (-80.0, 699.0, False), (0.0, 100.0, False),
    ):  # fmt: skip
        best, fit = trial_worth(600.0, gained), Fit((), {}, NOISE_OF_ALL, objective=step)
        assert best.is_out_of_reach(state, fit) == out, (gained, step)  # type: ignore[arg-type]


def test_what_is_out_of_reach_could_not_have_become_the_best():
    """But for more than MADE_UP beyond what the best gained: nats are what the likelihood gains, less a
    price, over an inflation.
    """
    rng = np.random.default_rng(4)
    for _ in range(2000):
        nats, gained, step, more, price = rng.exponential([400.0, 60.0, 900.0, 200.0, 12.0])
        state = SimpleNamespace(fit=Fit((), {}, NOISE_OF_ALL, objective=1000.0))
        more = min(more, gained + trials.MADE_UP)
        worth = (1000.0 - (step - more)) / rng.uniform(1.0, 3.0) - price
        fit = Fit((), {}, NOISE_OF_ALL, objective=step)
        if worth > nats:
            assert not trial_worth(nats, gained).is_out_of_reach(state, fit)  # type: ignore[arg-type]


@pytest.mark.parametrize(("reach", "large"), [(True, True), (True, False), (False, True)])
def test_a_step_out_of_reach_or_too_small_is_not_fitted_further(monkeypatch, reach, large):
    """Neither is its moment looked for again, nor whether it grew; that ends at twice a step."""
    state, problem, trial, _ = weighed("begins", 1.0)
    moment, looked = Moment("a", 9.0), []
    candidate = every_moment.Scored("gyro_bias", 20.0, moment, {"gyro_bias.x": 0.01}, False, 20.0)
    monkeypatch.setattr(trials, "beginning", lambda *given: problem)
    monkeypatch.setattr(trials, "fitted", lambda of, fit, steps=3: replace(fit, objective=900.0))
    monkeypatch.setattr(trials, "noise_fitted", lambda of, fit: fit)
    monkeypatch.setattr(
        trials, "moved_to_best", lambda of, fit, effect: looked.append(effect) or (problem, None)
    )

    def grown(*given: Any) -> Any:
        raise InterruptedError

    monkeypatch.setattr(trials, "grown_or_step", grown)
    monkeypatch.setattr(trials, "_leaves_colour", lambda *given: False)
    shares = []
    monkeypatch.setattr(trials, "_matters", lambda *given: shares.append(given[-1]) or large)
    monkeypatch.setattr(trials.Trial, "is_out_of_reach", lambda self, of, step: not reach)
    state.fit = trial
    best = trial_worth(50.0, 0.0)
    if reach and large:
        with pytest.raises(InterruptedError):
            trials.fitted_change(state, state, candidate, {}, best)
    else:
        assert trials.fitted_change(state, state, candidate, {}, best) is None
    assert len(looked) == 1 + (reach and large)
    assert shares == [0.5] * reach


def test_a_cause_that_stands_may_change_for_less_than_a_name():
    state, *_ = weighed("changes", 1.0)
    assert search._least(state, "gyro_bias") == SETTINGS.tie
    assert search._least(state, "servo_lag") == SETTINGS.evidence
