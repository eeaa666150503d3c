"""Hidden-effect tests: an independent simulator hides something in a flight, the package finds it.

`injector` shares no code and, where two forms are sensible, no formula with the package, which gets
the folder and nothing else; truth.json is read by the test alone. Then the contract of what
`diagnose`, `replay` and `identify` return.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import injector
import numpy as np
import pytest
from causes import check_all_sure, check_causes, say_what_was_found, truth_of
from shared_flights import shared_flight

import coax_env
from coax_env import diagnose, identify, load_vehicle, read_flight, replay
from coax_env.design.candidates import candidates
from coax_env.design.loop_oscillation import Oscillation, remark
from coax_env.diagnosis.corrected_vehicle import with_held_out
from coax_env.diagnosis.diagnose import Diagnosis
from coax_env.diagnosis.fits import at_optimum, converged, fitted, linearise, noise_fitted, start
from coax_env.diagnosis.hold_out import split
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.refinement import refined
from coax_env.diagnosis.scores import gain_by_likelihood, score
from coax_env.diagnosis.search import search
from coax_env.diagnosis.settings import SETTINGS
from coax_env.errors import InputError
from coax_env.estimation.engine import Engine, objective
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.files import write_text
from coax_env.logs.flight import Flight
from coax_env.model import effects
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle_file import vehicle_toml

ON_AXES = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
LAMA = load_vehicle("lama400d")


def all_but(*names: str) -> list[str]:
    """What to exclude so that only a few effects are left to look for (and the test is short)."""
    return [name for name in effects.CATALOGUE if name not in names]


def find(folder: Path, **options: Any) -> Diagnosis:
    """Diagnose a copy of the folder's flight that does not know where its truth lies."""
    (folder / "truth.json").rename(folder.parent / "truth.json")
    try:
        return diagnose(folder, **options)
    finally:
        (folder.parent / "truth.json").rename(folder / "truth.json")


# --- signatures ----------------------------------------------------------------------------------

ACTIVE = {"motor_lag.upper": 0.06, "motor_lag.lower": 0.08, "rotor_drag.coefficient": 3e-4,
          "wind.north": -1.0, "wind.east": 1.5, "axial_damping.coefficient": 0.07}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("also", [{}, ACTIVE], ids=["bare", "with effects"])
def test_signatures_are_what_moving_the_parameter_does(tmp_path, also):
    """Information and slope, against differences of the mean pass with the gains frozen."""
    folder = injector.fly(tmp_path / "flight", {}, runs=("lon_3211", "yaw_3211"), seed=5)
    flight = read_flight(folder)
    model = HeliModel(LAMA)
    engine = Engine(model, [record_of(run) for run in flight.runs])
    noise = starting_noise(flight, LAMA)
    free = model.base_parameters()
    free += [
        f
        for effect in effects.CATALOGUE
        for f in model.effect_parameters(effect)
        if f.probe == 0.0 or f.name in also
    ]
    values = {**model.bare_values, **{f.name: f.value for f in free}, **also}
    passes, lin = engine.linearise(values, noise, free)

    def innovations(name: str, change: float) -> np.ndarray:
        vector = model.vector({**values, name: values[name] + change})
        e = [np.zeros(run.record.z.shape) for run in passes]
        for i, run in enumerate(passes):
            assert engine.frozen(i, run, vector, e[i])
        return np.concatenate(e)

    e = innovations("mass", 0.0)
    shown = 0
    for i, f in enumerate(free):
        information, slope = lin.information.sum(0)[i, i], lin.slope.sum(0)[i]
        h = 0.3 / np.sqrt(max(information, f.std**-2))  # a third of a standard deviation
        if information * f.std**2 < 0.1 or not f.lower < values[f.name] - h:
            continue
        J = (innovations(f.name, h) - innovations(f.name, -h)) / (2.0 * h)
        size = np.sqrt(np.sum(J**2))
        # what decays within a row is taken to first order only
        rough = f.name == "flap_time_constant" or f.name.startswith("motor_lag")
        assert np.sqrt(information) == pytest.approx(size, rel=0.1 if rough else 0.02), f.name
        allowed = (0.02 if rough else 0.005) * size * np.linalg.norm(e)
        assert abs(slope - np.sum(J * e)) < allowed, f.name
        shown += 1
    assert shown > 30


def problem_of(folder: Path, effect: str) -> tuple[Problem, Fit]:
    """The problem of finding one effect on all runs of a flight, and the first fit."""
    flight = read_flight(folder)
    model = HeliModel(LAMA)
    problem = Problem.of(model, [record_of(run) for run in flight.runs], (effect,))
    return problem, start(problem, starting_noise(flight, LAMA))


@pytest.mark.slow
def test_a_refined_fit_is_at_the_top_of_the_likelihood(tmp_path):
    """Also in gusts, where holding the gains still leaves a slope in the lever arm."""
    folder = injector.fly(
        tmp_path / "flight",
        {"imu_lever_arm": {}},
        gusts=True,
        runs=("lon_3211", "yaw_3211"),
        seed=7,
    )
    problem, fit = problem_of(folder, "imu_lever_arm")
    engine = problem.engine
    fit = refined(problem, converged(problem, replace(fit, active=("imu_lever_arm",))))
    free = problem.free(fit.active)
    _, _, quadratic = linearise(problem, fit)
    names = [f.name for f in free]
    std = dict(zip(names, np.sqrt(np.diag(quadratic.covariance(names))), strict=True))

    def cost(name: str, change: float) -> float:
        values = {**fit.values, name: fit.values[name] + change * std[name]}
        return objective(engine.filter(values, fit.noise), free, values)

    for name in problem.acting_names("imu_lever_arm"):
        slope = (cost(name, 0.5) - cost(name, -0.5)) / 1.0  # nats per standard deviation
        assert abs(slope) < 0.35, name

    def profile(name: str, change: float) -> float:
        there = {name: fit.values[name] + change}
        moved = at_optimum(problem, fit, quadratic, fit.active, there).values
        return objective(engine.filter(moved, fit.noise), free, moved)

    for name in problem.acting_names("imu_lever_arm"):
        own = fit.std_ratio[name] * std[name]
        risen = profile(name, own) + profile(name, -own) - 2.0 * profile(name, 0.0)
        assert risen == pytest.approx(1.0, rel=0.05), name  # half a nat either way


@pytest.mark.slow
def test_what_the_quadratic_nearly_carries_is_fitted_as_a_trial(tmp_path):
    """A damping in gusts is worth more than its slope at nothing predicted: found all the same."""
    folder = injector.fly(
        tmp_path / "flight", {"axial_damping": 0.055}, gusts=True, sensors="onboard",
        runs=("heave_3211", "climb_descend"), seed=1,
    )  # fmt: skip
    problem, bare = problem_of(folder, "axial_damping")
    bare = fitted(problem, noise_fitted(problem, fitted(problem, bare)))
    bare, _, quadratic = linearise(problem, bare)
    predicted = score(problem, quadratic, (), "axial_damping").nats
    full = fitted(problem, at_optimum(problem, bare, quadratic, ("axial_damping",), {}))
    occam = quadratic.occam(["axial_damping.coefficient"], problem.free_names([]))
    worth = bare.objective - full.objective - occam
    assert worth > predicted + 0.5

    def found(threshold: float) -> tuple[str, ...]:
        settings = replace(SETTINGS, evidence=threshold)
        return search(replace(problem, settings=settings), bare)[0].active

    assert found(0.5 * (predicted + worth)) == ("axial_damping",)
    assert found(1.05 * worth) == ()


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [0.1, 0.0])
def test_the_predicted_gain_of_a_damping_is_what_the_likelihood_says(tmp_path, hidden):
    """Nearer to what the fit finds than the quadratic, which holds the gains still; never more."""
    folder = injector.fly(
        tmp_path / "flight", {"axial_damping": hidden} if hidden else {}, gusts=True,
        runs=("heave_3211", "climb_descend"), seed=3,
    )  # fmt: skip
    problem, bare = problem_of(folder, "axial_damping")
    bare = fitted(problem, noise_fitted(problem, fitted(problem, bare)), 4, 0.1)
    bare, _, quadratic = linearise(problem, bare)
    held = score(problem, quadratic, (), "axial_damping").nats
    predicted, at = gain_by_likelihood(problem, bare, quadratic, "axial_damping")
    full = at_optimum(problem, bare, quadratic, ("axial_damping",), at)
    full = fitted(problem, full, 10, 0.02)
    occam = quadratic.occam(["axial_damping.coefficient"], problem.free_names([]))
    worth = bare.objective - full.objective - occam
    if hidden:
        assert held < predicted < worth + 0.5
        assert worth - predicted < 0.7 * (worth - held)
    else:
        assert predicted < 0.0 and worth < 0.0


# --- hidden effects ------------------------------------------------------------------------------


def test_a_hidden_effect_is_found_among_all(tmp_path):
    """The short case of every test run: rigging, the whole catalogue to choose from."""
    folder = injector.fly(tmp_path / "flight", {"swash_offset": {}}, runs=ON_AXES[:3], seed=1)
    result = find(folder)
    check_causes(result.findings, *truth_of(folder))
    check_form(result)
    check_vehicle_flies(result, tmp_path)


@pytest.mark.slow
def test_what_an_unseen_effect_would_change_is_said(tmp_path):
    """Near 1 g a scale of the accelerometer is a bias: 0.02 of it 0.02 times gravity."""
    folder = injector.fly(
        tmp_path / "flight", {"accel_bias": {"x": 0.2, "y": -0.2, "z": 0.15}},
        runs=("hover", "lon_3211"), longest=8.0, seed=3,
    )  # fmt: skip
    only = all_but("accel_bias", "accel_scale", "gyro_bias")
    result = find(folder, exclude=only)
    assert [cause["effect"] for cause in result.findings["causes"]] == ["accel_bias"]
    (said,) = [remark for remark in result.remarks if "cannot be seen here" in remark]
    assert said.startswith("accel_bias.z = ") and "holds without accel_scale" in said
    moved = float(said.rpartition(" ")[2])
    assert moved == pytest.approx(0.02 * LAMA["gravity"].value, rel=0.1)
    beside = find(folder, exclude=[*only, "accel_scale"])
    assert not any("cannot be seen here" in remark for remark in beside.remarks)


SHORT = 9.0  # s of each run, where that shows the effect
HIDDEN: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "nothing": ({}, dict(runs=(*ON_AXES, "heading_turn"), seed=2)),
    "nothing, in gusts": ({}, dict(runs=(*ON_AXES, "heading_turn"), gusts=True, seed=3)),
    "nothing, thin sensors": (
        {}, dict(runs=(*ON_AXES, "hover"), sensors="onboard", longest=SHORT, seed=12)
    ),
    "motors": ({"motor_lag": {}}, dict(runs=("lon_3211", *ON_AXES[2:]), longest=SHORT, seed=6)),
    "swash, in gusts": (
        # one degree drowns in a minute of these gusts
        {"swash_offset": {"lon": 0.03, "lat": -0.02}},
        dict(runs=(*ON_AXES, "heading_turn"), gusts=True, seed=7),
    ),
    "servo and yaw": (
        {"servo_lag": {}, "yaw_damping": {}},
        dict(runs=("lon_3211", "yaw_3211", "heading_turn"), longest=SHORT, seed=8),
    ),
    "a damping that its slope at nothing hides, in gusts": (
        {"axial_damping": {"coefficient": 0.1}},
        dict(runs=("lon_3211", "heave_3211", "climb_descend", "low_hover"), gusts=True,
             longest=12.0, seed=500),
    ),
    "wind, thin sensors": (
        {"wind": {}, "rotor_drag": {}},
        dict(runs=("lon_3211", "lat_3211", "forward_run", "side_run", "heading_turn", "hover"),
             sensors="onboard", lost_echoes=True, radio_gaps=True, longest=SHORT, seed=9),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", HIDDEN)
def test_hidden_effects_are_found(tmp_path, case):
    hidden, options = HIDDEN[case]
    folder = injector.fly(tmp_path / "flight", hidden, **options)
    check_causes(find(folder).findings, *truth_of(folder))


@pytest.mark.slow
def test_the_gain_is_measured_where_the_effect_shows(tmp_path):
    """Drag hidden: on runs the fit has not seen most of what can be removed is removed."""
    runs = ("lon_3211", "lat_3211", "forward_run", "side_run", "heading_turn")
    folder = injector.fly(tmp_path / "flight", {"rotor_drag": 6e-4}, runs=runs, seed=11)
    gain = find(folder, hold_out=["side_run"]).findings["gain"]
    assert gain["held_out"] == ["side_run"]
    assert gain["error_removed_percent"] > 40.0
    assert gain["error_removed_percent"] > gain["refitted_base_percent"] + 10.0
    low, high = gain["ci95"]
    assert low <= gain["error_removed_percent"] <= high


LABELLED: dict[str, tuple[list[str], dict[str, float]]] = {
    "open_none": ([], {}),
    "open_rigging": (
        ["swash_offset", "swash_phase", "servo_lag"],
        {"swash_offset.lon": -0.015, "swash_offset.lat": 0.0, "swash_phase.angle": 0.1,
         "servo_lag.time": 0.045},
    ),
    "open_near_ground": (
        ["ground_effect", "axial_damping"],
        {"ground_effect.gain": 0.5, "ground_effect.decay": 2.1, "axial_damping.coefficient": 0.07},
    ),
}  # fmt: skip
"""Truths of their README, in the catalogue's names: another simulator than the injector flew them."""


@pytest.mark.slow
@pytest.mark.needs_shared_flights
@pytest.mark.parametrize("name", LABELLED)
def test_labelled_flights(name):
    hidden, values = LABELLED[name]
    findings = diagnose(shared_flight(name)).findings
    check_causes(findings, hidden, values)
    check_all_sure(findings)


# --- what is handed over -------------------------------------------------------------------------


def check_form(result: Diagnosis) -> None:
    """findings.json as contract.md has it."""
    findings = result.findings
    assert json.loads(json.dumps(findings, allow_nan=False)) == findings
    assert set(findings) == {
        "verdict", "causes", "gusts", "unexplained", "gain", "next_maneuver", "false_alarm_rate",
        "class", "model_check", "noise",
    }  # fmt: skip
    assert findings["verdict"] in ("consistent", "explained", "partly explained", "unexplained")
    strength = [(cause["trust"] == "sure", cause["evidence"]) for cause in findings["causes"]]
    assert strength == sorted(strength, reverse=True), "sure ones first, each the strongest first"
    for cause in findings["causes"]:
        assert set(cause) >= {"effect", "parameters", "evidence", "confusable_with", "channels"}
        entry = effects.CATALOGUE[cause["effect"]]
        assert set(cause["parameters"]) == set(entry.names())
        for full, parameter in zip(entry.names(), entry.parameters, strict=True):
            said = cause["parameters"][full]
            assert said["unit"] == parameter.unit
            assert isinstance(said["value"], float) and said["std"] > 0.0
            assert isinstance(said["determined"], bool)
        robust = cause["robust"]
        assert isinstance(robust["noise"], bool) and 0.0 <= robust["runs"] <= 1.0
        assert robust["kept"] is None or 0.0 <= robust["kept"] <= 1.0
        assert cause["trust"] == ("doubtful" if cause["doubts"] else "sure")
        assert cause["since"] is None
        assert set(cause["confusable_with"]) <= set(effects.CATALOGUE) - {cause["effect"]}
        assert cause["channels"] and set(cause["channels"]) <= set(CHANNELS)
    gusts = findings["gusts"]
    assert len(gusts["force_N"]) == len(gusts["moment_Nm"]) == 3 and gusts["memory_s"] > 0.0
    for left in findings["unexplained"]:
        assert set(left) >= {"channel", "depends_on", "share", "form"}
        assert left["channel"] in CHANNELS
    if findings["gain"] is not None:
        check_gain(findings["gain"], result.flight)
    following = findings["next_maneuver"]
    if following is not None:
        assert following["maneuver"] in {plan.name for plan in candidates()}
        assert "nats" in following["why"]
        assert set(following["separates"]) <= set(effects.CATALOGUE)


def check_gain(gain: Mapping[str, Any], flight: Flight) -> None:
    assert gain["horizon_s"] == 1.0
    assert {name.removesuffix(" (last third)") for name in gain["held_out"]} <= set(
        flight.run_names
    )
    compared = set(flight.channels) - {"rpm_upper", "rpm_lower", "ax", "ay", "az"}
    assert set(gain["channels"]) == compared
    for entry in gain["channels"].values():
        assert set(entry) >= {"before", "before_refitted", "after", "noise", "unit", "ci95"}
        low, high = entry["ci95"]
        assert 0.0 < low <= entry["after"] <= high
    percent = ("error_removed_percent", "refitted_base_percent", "noise_floor_percent")
    for key in (*percent, "persistence_percent"):
        assert isinstance(gain[key], float)
    assert len(gain["ci95"]) == 2


def check_vehicle_flies(result: Diagnosis, folder: Path) -> None:
    """The extended vehicle, through its file, in the env."""
    path = write_text(folder / "vehicle.toml", vehicle_toml(result.vehicle_after))
    vehicle = load_vehicle(path)
    assert set(vehicle.effects) == {c["effect"] for c in result.findings["causes"]}
    for table in vehicle.effects.values():
        for parameter in table.values():
            assert parameter.std > 0.0 and parameter.source.startswith("diagnosed")
    assert set(vehicle.provenance["flights"]) == set(result.flight.hashes.values())
    fly_in_env(path)


def fly_in_env(path: Path) -> None:
    env = gymnasium.make("CoaxHeli-v0", vehicle=str(path))
    env.reset(seed=0)
    for _ in range(5):
        observation, reward, *_ = env.step(np.zeros(4, np.float32))
        assert np.isfinite(observation).all() and np.isfinite(reward)
    env.close()


@pytest.fixture(scope="module")
def still(tmp_path_factory) -> Flight:
    """A short flight of the bare model."""
    folder = tmp_path_factory.mktemp("still") / "flight"
    return read_flight(injector.fly(folder, {}, runs=ON_AXES, seed=21))


def only(flight: Flight, *names: str) -> Flight:
    return replace(flight, runs=tuple(flight.run(name) for name in names))


FEW = all_but("gyro_bias", "swash_offset", "rotor_drag")


@pytest.mark.slow
def test_a_short_still_flight(still):
    """Two runs: the last third of each is held out; nothing is found in them."""
    result = diagnose(only(still, "lon_3211", "lat_3211"), exclude=FEW)
    check_form(result)
    check_causes(result.findings, [], {})
    assert len(result.findings["gain"]["held_out"]) == 2
    assert set(result.innovations_after) == {"lon_3211", "lat_3211"}
    last = max(t["t"][-1] for t in result.innovations_after.values())
    assert 7.0 < last < 9.0, "the fit must not see the last third"


@pytest.mark.slow
def test_hold_out_none_fits_everything(still):
    result = diagnose(only(still, "lon_3211", "lat_3211"), hold_out=[], exclude=FEW)
    check_form(result)
    assert result.findings["gain"] is None and not result.replay_after
    assert result.innovations_after["lon_3211"]["t"][-1] > 11.0


@pytest.mark.slow
def test_hold_out_as_told(still):
    result = diagnose(still, hold_out=["lat_3211", "yaw_3211"], exclude=FEW)
    assert set(result.findings["gain"]["held_out"]) == {"lat_3211", "yaw_3211"}
    assert set(result.innovations_after) == {"lon_3211", "heave_3211"}
    assert {run.name for run in result.replay_after} == {"lat_3211", "yaw_3211"}


@pytest.mark.slow
def test_the_held_out_runs_are_taken_in_at_the_end(still):
    """What the vehicle file gets is what a fit on all runs finds, not that on the others alone."""
    model = HeliModel(LAMA)
    records = [record_of(run) for run in still.runs]
    noise = starting_noise(still, LAMA)
    problem = Problem.of(model, records[:2])
    few = Fit((), start(problem, noise).values, noise)
    few, _, quadratic = linearise(problem, fitted(problem, few, steps=6, tolerance=0.01))
    values, covariance = with_held_out(problem, few, quadratic, records[2:])
    whole = Engine(model, records).fit(problem.free([]), few.values, noise, 6, 0.01)
    std = np.array(list(whole.std.values()))
    off = np.array([(values[n] - whole.values[n]) / whole.std[n] for n in whole.names])
    before = np.array([(few.values[n] - whole.values[n]) / whole.std[n] for n in whole.names])
    assert np.abs(off).max() < 0.25 < np.abs(before).max()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), std, rtol=0.1)
    alone = np.sqrt(np.diag(quadratic.covariance(whole.names)))
    assert (std / alone).min() < 0.9


@pytest.mark.slow
def test_the_choice_of_the_hold_out_does_not_look_at_residuals(still, monkeypatch):
    """With every innovation and slope blotted out, the same runs are chosen."""

    def chosen() -> list[str]:
        model = HeliModel(LAMA)
        records = [record_of(run) for run in still.runs]
        noise = starting_noise(still, LAMA)
        candidates = tuple(effects.CATALOGUE)
        fit, held = split(model, records, noise, None, candidates, SETTINGS)
        assert sorted(r.name for r in (*fit, *held)) == sorted(ON_AXES)
        return [r.name for r in held]

    def blind(engine: Engine, *arguments: Any) -> Any:
        passes, lin = looking(engine, *arguments)
        passes = [replace(run, innovations=np.nan * run.innovations) for run in passes]
        return passes, replace(lin, slope=np.nan * lin.slope, blocks=np.nan * lin.blocks)

    looking = Engine.linearise
    before = chosen()
    monkeypatch.setattr(Engine, "linearise", blind)
    assert len(before) == 1
    assert chosen() == before


@pytest.mark.slow
def test_an_excluded_effect_is_not_named(tmp_path):
    folder = injector.fly(tmp_path / "flight", {"gyro_bias": {}}, runs=["lon_3211"], seed=22)
    flight = read_flight(folder)
    named = diagnose(flight, hold_out=[], exclude=FEW).findings
    assert [c["effect"] for c in named["causes"]] == ["gyro_bias"]
    assert named["verdict"] == "explained"
    most = named["causes"][0]["where_most"]  # a bias is there all the time, of one size
    assert 0.3 < most["share"] <= 0.6 and abs(most["size"] - 1.0) < 4.0 * most["std"] < 1.0
    forbidden = diagnose(flight, hold_out=[], exclude=[*FEW, "gyro_bias"]).findings
    assert "gyro_bias" not in say_what_was_found(forbidden)
    for cause in forbidden["causes"]:
        assert "gyro_bias" not in cause["confusable_with"]
    every = diagnose(flight, hold_out=[], exclude=list(effects.CATALOGUE)).findings
    assert (every["causes"], every["verdict"]) == ([], "unexplained")


@pytest.mark.slow
def test_where_the_control_loop_oscillates_it_is_said(tmp_path, monkeypatch):
    folder = injector.fly(tmp_path / "flight", {}, runs=["lon_3211"], seed=22)
    swings = (Oscillation("yaw", 6.5, 3.7),)
    monkeypatch.setattr("coax_env.diagnosis.diagnose.oscillations", lambda runs: swings)
    assert remark(swings) in diagnose(folder, hold_out=[], exclude=FEW).remarks


@pytest.mark.slow
def test_an_effect_that_the_vehicle_has_is_no_finding(tmp_path):
    """The extended vehicle on the same flight: consistent, and a warning of double counting."""
    folder = injector.fly(tmp_path / "flight", {"gyro_bias": {}}, runs=["lon_3211"], seed=22)
    first = diagnose(folder, hold_out=[], exclude=FEW)
    again = diagnose(folder, first.vehicle_after, hold_out=[], exclude=FEW)
    check_causes(again.findings, [], {})
    assert any("twice" in remark for remark in again.remarks)
    assert not any("twice" in remark for remark in first.remarks)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (dict(exclude=["gremlins"]), "gremlins"),
        (dict(hold_out=["loop"]), "loop"),
        (dict(hold_out=list(ON_AXES)), "nothing is left"),
        (dict(vehicle="lama500"), "lama500"),
    ],
)
def test_bad_requests_are_refused_in_one_line(still, options, words):
    with pytest.raises(InputError, match=words) as caught:
        diagnose(still, **options)
    assert "\n" not in str(caught.value)


# --- replay ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_true_model_predicts_as_well_as_the_sensors_see(still):
    result = replay(still)
    assert set(result.findings["runs"]) == set(ON_AXES)
    json.dumps(result.findings, allow_nan=False)
    gathered: dict[str, list[float]] = {}
    for table in result.findings["runs"].values():
        assert set(table) == set(still.channels)
        for channel, entry in table.items():
            assert entry["noise_rms"] == still.noise[channel] and "diverged" not in entry
            gathered.setdefault(channel, []).append(entry["rms"] / entry["noise_rms"])
    for channel, ratios in gathered.items():
        assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.35, (channel, ratios)


@pytest.mark.slow
def test_the_horizon_is_the_callers(still):
    """A wrong model is worse the further it looks."""
    wrong = LAMA.with_values({"thrust_coefficient_upper": 0.95 * 0.00718})
    flight = only(still, "heave_3211")
    rms = [
        replay(flight, wrong, horizon).findings["runs"]["heave_3211"]["h"]["rms"]
        for horizon in (0.1, 1.0, 3.0)
    ]
    assert rms[2] > 3.0 * rms[1] > 3.0 * rms[0]


ROTOR_RANGES = ("rpm_upper_cmd-range", "rpm_lower_cmd-range")
"""Checks of a log that a vehicle with an impossible thrust fails."""


@pytest.mark.parametrize(
    "wrong", [{"inertia_xx": 5e-6}, {"inertia_yy": 5e-6, "thrust_coefficient_upper": 0.1}]
)
def test_a_model_that_runs_away_says_so(still, wrong):
    runs = only(still, "lon_3211", "yaw_3211")
    findings = replay(runs, LAMA.with_values(wrong), waive=ROTOR_RANGES).findings
    json.dumps(findings, allow_nan=False)
    entries = [e for table in findings["runs"].values() for e in table.values()]
    assert any(e.get("diverged") for e in entries)
    assert all((e["rms"] is None) == bool(e.get("diverged")) for e in entries)


@pytest.mark.slow
def test_a_very_wrong_model_does_not_crash(still):
    wrong = LAMA.with_values({"thrust_coefficient_upper": 8.0 * 0.00718})
    table = replay(only(still, "lon_3211"), wrong, waive=ROTOR_RANGES).findings["runs"]["lon_3211"]
    assert table["vd"]["rms"] is None or table["vd"]["rms"] > 5.0


# --- identification --------------------------------------------------------------------------------


@pytest.mark.slow
def test_moved_parameters_return(still, tmp_path):
    names = ["thrust_coefficient_upper", "torque_coefficient_lower", "swash_to_flap"]
    moved = LAMA.with_values({name: 1.03 * LAMA[name].value for name in names})
    result = identify(still, moved)
    for name in names:
        true, before, after = (v[name] for v in (LAMA, moved, result.after))
        assert abs(after.value - true.value) < 3.0 * after.std, name
        assert abs(after.value - true.value) < 0.8 * abs(before.value - true.value), name
        assert after.std < before.std
    held = [n for n in LAMA.parameters if n not in result.fitted]
    assert {n: result.after[n].value for n in held} == {n: moved[n].value for n in held}
    path = write_text(tmp_path / "vehicle.toml", vehicle_toml(result.after))
    assert set(load_vehicle(path).provenance["flights"]) == set(still.hashes.values())
    fly_in_env(path)


@pytest.mark.slow
def test_identification_knows_when_it_counts_twice(still):
    flight = only(still, "lon_3211")
    first = identify(flight)
    again = identify(flight, first.after)
    assert not any("twice" in remark for remark in first.remarks)
    assert any("twice" in remark for remark in again.remarks)


def test_methods_that_are_not_there():
    with pytest.raises(InputError, match="guess"):
        identify("nowhere", method="guess")


def test_the_python_names_of_the_contract():
    for name in ("read_flight", "simulate", "replay", "identify", "diagnose", "load_vehicle"):
        assert callable(getattr(coax_env, name))
