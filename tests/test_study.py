"""The study of the diagnosis: plan, folder, judgement on rows written by hand, baselines.

No flight is diagnosed here but one, marked slow; what is asked is whether the counting is right.
"""

import argparse
import csv
import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import injector
import numpy as np
import pytest
import study_diagnosis
from injector_air import GUSTS, GUSTY, Air
from injector_craft import COAX, LAMA, draw
from injector_sensors import kit
from study import (
    arm_table,
    arms,
    baselines,
    classes,
    coverage,
    judge,
    one_flight,
    plan,
    store,
    table,
    threshold,
)
from study import expected as expecting
from study.baselines import Gram, by_bic, by_f, sparse, stepwise
from study.expected import catalogue_values, expected_evidence, gust_levels, true_noise
from study.likelier import likelier_than_nothing
from study.one_flight import fly_and_diagnose, hide
from study.plan import PlannedFlight

from coax_env import load_vehicle, read_flight
from coax_env.diagnosis import calibration
from coax_env.diagnosis.fits import converged, start
from coax_env.diagnosis.problem import Problem
from coax_env.diagnosis.settings import SETTINGS
from coax_env.errors import InputError
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.model.effects import CATALOGUE

# --- the plan ---------------------------------------------------------------------------------------


def test_the_plan_is_the_same_every_time_and_grows_without_changing() -> None:
    small, large = plan.plan(10, 20, seed=3), plan.plan(20, 60, seed=3)
    assert small == plan.plan(10, 20, seed=3)
    assert {f.name: f for f in small}.items() <= {f.name: f for f in large}.items()
    assert {f.name: f for f in small} != {f.name: f for f in plan.plan(10, 20, seed=4)}
    assert len({f.seed for f in large}) == len(large) == 80


@pytest.mark.parametrize(("clean", "effects"), [(200, 400), (8, 16), (0, 1), (1, 0), (7, 33)])
def test_the_plan_has_as_many_flights_as_asked(clean: int, effects: int) -> None:
    flights = plan.plan(clean, effects)
    kinds = [f.kind for f in flights]
    assert sum(k in ("still", "gusty") for k in kinds) == clean
    assert len(kinds) == clean + effects
    assert all(bool(f.effects) == (f.kind not in ("still", "gusty")) for f in flights)


def test_a_full_study_has_every_effect_with_both_sensor_sets() -> None:
    flights = plan.plan(200, 400)
    ones = {(next(iter(f.effects)), f.sensors) for f in flights if f.kind == "one"}
    assert ones == {(e, s) for e in plan.ALONE for s in ("full", "onboard")}
    weather = {(e, f.sensors, f.gusts) for f in flights if f.kind == "one" for e in f.effects}
    assert len(weather) > 3 * len(plan.ALONE), "in gusts and in still air"
    assert all(f.gusts == (f.kind == "gusty") for f in flights if not f.effects)
    for kind, count in (("two", 2), ("three", 3)):
        assert {len(f.effects) for f in flights if f.kind == kind} == {count}
    for flight in flights:
        assert "wind" not in flight.effects or "rotor_drag" in flight.effects
        names = list(flight.effects)
        assert not any(judge.tied(a, b) for a in names for b in names if a != b)


def test_flights_for_the_intervals_shake_and_hide_what_both_sides_write_alike() -> None:
    flights = plan.plan(2, 2, many=30)
    many = [f for f in flights if f.kind == "many"]
    assert len(many) == 30 and len(flights) == 34
    assert [f for f in flights if f.kind != "many"] == plan.plan(2, 2)
    other_form = {name.partition(".")[0] for name in injector.OTHER_FORM}
    for flight in many:
        assert flight.gusts and len(flight.effects) == plan.MANY
        assert not other_form & set(flight.effects)


def test_any_part_of_the_plan_is_a_fair_sample() -> None:
    flights = plan.plan(200, 400)
    early = [f.kind for f in flights[:60]]
    for kind in plan.KINDS:
        expected = 0.1 * sum(f.kind == kind for f in flights)
        assert abs(early.count(kind) - expected) <= 1.0, kind


def test_what_is_in_no_list_takes_every_form_in_turn() -> None:
    flights = [f for f in plan.plan(0, 600) if f.kind == "outside"]
    assert {e for f in flights for e in f.effects} == set(plan.OUTSIDE)
    assert not set(plan.OUTSIDE) & set(CATALOGUE)
    assert set(plan.FOREIGN) < set(plan.OUTSIDE), "one is a generic term"


def test_the_plan_knows_all_that_the_generator_hides_and_the_catalogue_has() -> None:
    """An effect new to either must be given a size here."""
    assert set(plan.SIZES) == set(injector.EFFECTS)
    for effect, sizes in plan.SIZES.items():
        assert set(sizes) == set(injector.EFFECTS[effect])
        assert all(0.0 < least <= most for least, most, _ in sizes.values())
    assert set(CATALOGUE) <= set(plan.SIZES)


# --- the folder --------------------------------------------------------------------------------------


def row_of(flight: PlannedFlight, causes: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """A row as one_flight.py writes it."""
    hidden = list(flight.effects)
    named = [{"confusable_with": [], "parameters": {}, "evidence": 50.0} | c for c in causes]
    return {
        "plan": flight.as_json(),
        "code": "abc",
        "hidden": hidden,
        "values": {f"{e}.{p}": v for e, t in flight.effects.items() for p, v in t.items()},
        "comparable": {},
        "expected": dict.fromkeys(hidden, 100.0 * SETTINGS.evidence),
        "methods": {"coax": {"verdict": "explained", "causes": named, "unexplained": []}},
        "gain": None,
        "strongest": {"evidence": 1.0, "effect": "wind"},
        "seconds": 1.0,
        "flown_s": 100.0,
    } | more


def flight_with(*effects: str, kind: str = "one", number: int = 0) -> PlannedFlight:
    sizes = {e: {p: low for p, (low, _, _) in plan.SIZES[e].items()} for e in effects}
    return PlannedFlight(kind, number, sizes, kind != "still", "full", 1, plan.RICH)


@pytest.fixture
def study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[list[str], list[PlannedFlight]]]:
    """The script with a diagnosis that always names the truth; returns what it had to fly."""

    def call(
        *words: str, fails: str = "", stops: str = ""
    ) -> tuple[list[str], list[PlannedFlight]]:
        flown: list[str] = []

        def stub(flight: PlannedFlight, only_own: bool) -> dict[str, Any]:
            flown.append(flight.name)
            if flight.name == stops:
                raise KeyboardInterrupt
            if flight.name == fails:
                return {"plan": flight.as_json(), "code": "abc", "error": "lost"}
            return row_of(flight, [{"effect": e} for e in flight.effects if e in CATALOGUE])

        monkeypatch.setattr(study_diagnosis, "fly_and_diagnose", stub)
        out = ["--out", str(tmp_path), "--jobs", "1"]
        monkeypatch.setattr(sys, "argv", ["study_diagnosis.py", "--quick", *out, *words])
        study_diagnosis.main()
        return flown, plan.plan(8, 16)

    return call


def test_a_study_goes_on_where_it_stopped(study: Callable, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        study(stops=plan.plan(8, 16)[10].name)
    assert (tmp_path / "table.md").exists(), "what there is is written at any stop"
    flown, flights = study()
    assert flown == [f.name for f in flights[10:]]
    assert study()[0] == []


def test_half_a_file_and_another_plan_are_flown_again(study: Callable, tmp_path: Path) -> None:
    _, flights = study()
    first, second, third = (store.path_of(tmp_path, f) for f in flights[:3])
    first.write_text(first.read_text()[:200])
    second.write_text("[]")
    row = json.loads(third.read_text())
    row["plan"]["seed"] += 1
    third.write_text(json.dumps(row))
    assert study()[0] == [f.name for f in flights[:3]]
    assert store.missing(tmp_path, flights) == []


def test_a_failure_is_told_counted_and_tried_again(study: Callable, tmp_path: Path) -> None:
    name = plan.plan(8, 16)[5].name
    study(fails=name)
    assert json.loads((tmp_path / "summary.json").read_text())["failed"] == 1
    assert f"- {name}: lost" in (tmp_path / "table.md").read_text()
    assert study()[0] == [name]
    assert "Flights that failed" not in (tmp_path / "table.md").read_text()


def test_what_a_study_writes(study: Callable, tmp_path: Path) -> None:
    """The stub is never wrong where the truth has a name: all of its figures say so."""
    _, flights = study()
    summary = json.loads((tmp_path / "summary.json").read_text())
    figures = {f["figure"]: f for f in summary["methods"]["coax"]}
    assert figures["false alarms, clean flights"]["percent"] == 0.0
    assert figures["exact cause, one effect"]["percent"] == 100.0
    assert figures["exact cause, one effect"]["count"] == sum(f.kind == "one" for f in flights)
    assert figures["exact set, two effects"]["percent"] == 100.0
    assert figures["hover only: wrongly certain"]["percent"] == 0.0
    matrix = list(csv.reader((tmp_path / "confusion.csv").read_text().splitlines()))
    for name, *shares in matrix[1:]:
        assert shares[matrix[0].index(name) - 1] == "1.000"
    assert "plotly" in (tmp_path / "confusion.html").read_text().lower()


def test_calibration_flies_clean_flights_alone(study: Callable, tmp_path: Path) -> None:
    flown, _ = study("--calibrate")
    assert len(flown) == 8 and all(name.startswith(("still", "gusty")) for name in flown)


@pytest.mark.parametrize("words", [["--clean", "-1"], ["--clean", "0", "--effects", "0"]])
def test_a_study_of_nothing_is_refused(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["study_diagnosis.py", *words])
    with pytest.raises(InputError):
        study_diagnosis.main()


# --- the judgement -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hidden", "found", "exact"),
    [
        ([], [], True),
        ([], ["wind"], False),
        (["wind"], ["wind"], True),
        (["wind"], [], False),
        (["wind"], ["wind", "rotor_drag"], False),
        (["wind"], ["rotor_drag"], False),
        (["servo_lag"], ["servo_delay"], True),
        (["servo_lag"], ["servo_delay", "servo_lag"], False),
        (["wind", "servo_lag"], ["servo_delay", "wind"], True),
        (["wind", "servo_lag"], ["servo_delay", "servo_lag"], False),
        (["added_mass"], ["thrust_scale"], True),
    ],
)
def test_exact_is_the_truth_or_its_tie_and_nothing_else(
    hidden: list[str], found: list[str], exact: bool
) -> None:
    assert judge.is_exact(hidden, found) is exact


def test_groups_and_wrong_certainty() -> None:
    flight = flight_with("wind", kind="hover")
    right = row_of(flight, [{"effect": "wind"}])
    within = row_of(flight, [{"effect": "cg_offset", "confusable_with": ["wind", "swash_offset"]}])
    unsure = row_of(flight, [{"effect": "cg_offset", "confusable_with": ["swash_offset"]}])
    wrong = row_of(flight, [{"effect": "cg_offset"}])
    two = row_of(flight, [{"effect": "cg_offset"}, {"effect": "wind"}])
    nothing = row_of(flight, [])
    rows = [right, within, unsure, wrong, two, nothing]
    assert [judge.group_with_truth(r) for r in rows] == [1, 3, 0, 0, 1, 0]
    assert [judge.is_wrongly_certain(r) for r in rows] == [False] * 3 + [True, False, False]


def test_an_effect_that_cannot_show_is_counted_apart() -> None:
    faint = row_of(flight_with("wind", number=1), [], expected={"wind": 1.9 * SETTINGS.evidence})
    unknown = row_of(flight_with("vibration", number=2), [], expected={"vibration": None})
    shown = row_of(flight_with("rotor_drag"), [{"effect": "rotor_drag"}])
    figures = {f.name: f for f in table.all_figures([faint, unknown, shown])}
    exact = figures["exact cause, one effect"]
    assert (exact.good, exact.count) == (1, 1) and exact.apart.startswith("0 of 2")


def test_the_unexplained_counts_on_its_axis_and_without_blame() -> None:
    flight = flight_with("outside", kind="outside")
    right = row_of(flight, [])
    right["methods"]["coax"]["unexplained"] = [{"channel": "q"}]
    elsewhere = row_of(flight, [])
    elsewhere["methods"]["coax"]["unexplained"] = [{"channel": "r"}]
    blamed = row_of(flight, [{"effect": "wind"}])
    blamed["methods"]["coax"]["unexplained"] = [{"channel": "q"}]
    assert [judge.reports_unexplained(r, "q") for r in (right, elsewhere, blamed)] == [
        True,
        False,
        False,
    ]


def test_intervals_are_of_true_effects_in_the_same_form() -> None:
    said = {"value": 0.03, "std": 0.01, "unit": "rad"}
    parameters = {"swash_offset.lon": said, "swash_offset.lat": said}
    row = row_of(
        flight_with("swash_offset"),
        [{"effect": "swash_offset", "parameters": parameters},
         {"effect": "cg_offset", "parameters": {"cg_offset.x": said}}],
        comparable={"swash_offset.lon": 0.03 + 0.0195, "swash_offset.lat": 0.03 - 0.0197},
    )  # fmt: skip
    assert judge.intervals(row) == [("swash_offset.lon", True), ("swash_offset.lat", False)]


def test_intervals_beside_what_cannot_be_seen_are_counted_apart() -> None:
    def row(number: int, expected: float, error: float) -> dict[str, Any]:
        flight = flight_with("swash_offset", number=number)
        said = {"value": error, "std": 1.0, "unit": "rad"}
        cause = {"effect": "swash_offset", "parameters": {"swash_offset.lon": said}}
        return row_of(
            flight, [cause], expected={"swash_offset": expected},
            comparable={"swash_offset.lon": 0.0},
        )  # fmt: skip

    sure, faint = 2.1 * SETTINGS.evidence, 1.9 * SETTINGS.evidence
    rows = [row(0, sure, 1.0), row(1, sure, 1.9), row(2, sure, 2.1), row(3, faint, 9.0)]
    figure = next(f for f in table.all_figures(rows) if "cover, in gusts" in f.name)
    assert (figure.good, figure.count) == (2, 3)
    assert figure.apart == (
        "swash_offset.lon 2/3; 0 of 1 beside an effect that was not expected to show"
    )


def test_effects_that_cannot_show_are_left_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until all that are left can be: what carried another may have gone."""
    flown: list[list[str]] = []

    def fly(planned: PlannedFlight, folder: Path) -> dict[str, Any]:
        flown.append(list(planned.effects))
        return {}

    def expected(planned: PlannedFlight, *_: Any) -> dict[str, float]:
        carried = 4.0 if "rotor_drag" in planned.effects else 0.0
        worth = {"wind": carried, "rotor_drag": 2.9, "gyro_bias": 3.1}
        return {e: SETTINGS.evidence * worth[e] for e in planned.effects}

    monkeypatch.setattr(one_flight, "hide", fly)
    monkeypatch.setattr(one_flight, "read_flight", lambda folder: None)
    monkeypatch.setattr(one_flight, "expected_evidence", expected)
    effects: dict[str, dict[str, float]] = {e: {} for e in ("wind", "rotor_drag", "gyro_bias")}
    flight = PlannedFlight("many", 0, effects, True, "full", 5, ("hover",))
    planned, folder, _ = one_flight.showing(flight, tmp_path)
    assert list(planned.effects) == ["gyro_bias"] and folder.parent == tmp_path
    assert flown == [["wind", "rotor_drag", "gyro_bias"], ["wind", "gyro_bias"], ["gyro_bias"]]


def test_the_gain_is_a_share_of_what_the_truth_removes() -> None:
    def with_gain(own: float, truth: float) -> dict[str, Any]:
        return row_of(
            flight_with("wind"), [], gain={"error_removed_percent": own},
            true_structure={"error_removed_percent": truth},
        )  # fmt: skip

    rows = [with_gain(40.0, 50.0), with_gain(30.0, 30.0), with_gain(0.0, 1.0)]
    gain = next(f for f in table.all_figures(rows) if "held-out" in f.name)
    assert gain.percent == pytest.approx(100.0 * 70.0 / 80.0) and gain.count == 2


@pytest.mark.parametrize(
    ("good", "count", "low", "high"),
    [  # Newcombe, Statistics in Medicine 17 (1998) 857-872, Table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_against_published_intervals(good: int, count: int, low: float, high: float) -> None:
    assert judge.wilson(good, count) == pytest.approx((low, high), abs=5e-5)
    mirrored = judge.wilson(count - good, count)
    assert mirrored == pytest.approx((1.0 - high, 1.0 - low), abs=5e-5)


def test_the_threshold_of_an_exponential_tail() -> None:
    """Evidence that exceeds e with probability exp(-e/3) passes 3 ln 100 once in a hundred."""
    rng = np.random.default_rng(1)
    drawn = [threshold.tail_quantile(rng.exponential(3.0, 200)) for _ in range(100)]
    assert np.mean(drawn) == pytest.approx(3.0 * math.log(100.0), rel=0.04)
    assert math.isnan(threshold.tail_quantile(np.full(50, -np.inf)))


def test_a_calibration_says_what_made_it() -> None:
    rows = [
        row_of(
            flight_with(kind="gusty", number=i), [],
            strongest={"evidence": None if i % 2 else float(i), "effect": ""},
        )
        for i in range(60)
    ]  # fmt: skip
    result = threshold.calibration(rows, "the command")
    assert result is not None and result["clean_flights"] == 60 and result["code"] == ["abc"]
    assert result["threshold_nats_for_1_percent"] > 50.0 and result["false_alarms_at_it"] == 0
    json.dumps(result, allow_nan=False)
    assert threshold.calibration(rows[:10], "too few") is None
    assert result["false_alarm_rate"] == pytest.approx(1 / 62, abs=1e-4), "weighed, none had a name"


CLEAN = {
    "sensors": "accelerometers, attitude, gyros, heading, height, rotor speeds, velocity",
    "rate_hz": 100.0, "gap_share": 0.0, "card_noise": True, "mass_kg": 0.8, "gust_force": 0.02,
    "gust_moment": 0.004, "gust_memory_s": 0.5, "white_noise": False,
}  # fmt: skip
"""The class of the study's own flights."""


def test_the_threshold_in_use_is_calibrated() -> None:
    """Change SETTINGS.evidence and this asks for `study_diagnosis.py --calibrate --adopt`."""
    rate = calibration.calibrated(SETTINGS.evidence, CLEAN).rate
    assert rate is not None and rate <= 0.02
    other = calibration.calibrated(SETTINGS.evidence, CLEAN | {"rate_hz": 25.0})
    assert other.rate is None and "rows per second 25" in other.why
    heavy = calibration.calibrated(SETTINGS.evidence, CLEAN | {"rate_hz": 25.0, "mass_kg": 3.0})
    assert heavy.why.startswith("not like drawn_vehicles: rows per second 25"), "the nearest class"
    assert ";" not in heavy.why


def test_the_share_beyond_a_threshold() -> None:
    rng = np.random.default_rng(2)
    shares = [threshold.share_beyond(rng.exponential(3.0, 200), 12.0) for _ in range(100)]
    assert np.mean(shares) == pytest.approx(math.exp(-4.0), rel=0.15)
    assert threshold.share_beyond(np.full(50, -np.inf), 12.0) == 0.0


def test_an_adopted_calibration_is_void_for_another_threshold(
    study: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "package" / "calibration.json"
    kept.parent.mkdir()
    monkeypatch.setattr(calibration, "PATH", kept)
    assert calibration.calibrated(SETTINGS.evidence, CLEAN).rate is None
    with pytest.raises(InputError, match="takes 20 clean flights"):
        study("--calibrate", "--adopt")
    monkeypatch.setitem(study_diagnosis.QUICK, "clean", 24)
    study("--calibrate", "--adopt")
    rate = calibration.calibrated(SETTINGS.evidence, CLEAN).rate
    assert rate is not None and 0.0 <= rate <= 1.0
    assert calibration.calibrated(SETTINGS.evidence + 1.0, CLEAN).rate is None
    study("--calibrate", "--adopt")
    assert len(json.loads(kept.read_text())["classes"]) == 1, "of one class there is one rate"


# --- the arms -----------------------------------------------------------------------------------------


def test_an_arm_is_the_same_every_time_and_beside_any_others() -> None:
    small = arms.plan_arms(["gusty", "dryden"], 4, 6, seed=3)
    large = arms.plan_arms(list(arms.ARMS), 10, 24, seed=3)
    assert {f.name: f for f in small}.items() <= {f.name: f for f in large}.items()
    assert len({f.seed for f in large}) == len({f.name for f in large}) == len(large)
    assert len(large) == 34 * len(arms.ARMS)
    assert not {f.seed for f in large} & {f.seed for f in arms.plan_arms(["gusty"], 9, 9, seed=4)}


def test_a_study_may_begin_with_any_number() -> None:
    whole = {f.name: f for f in arms.plan_arms(["gusty", "dryden"], 6, 4, seed=3)}
    later = {f.name: f for f in arms.plan_arms(["gusty", "dryden"], 2, 1, seed=3, first=3)}
    assert later.items() <= whole.items()
    assert sorted({f.number for f in later.values()}) == [3, 4]


@pytest.mark.slow
def test_any_part_of_the_arms_is_a_fair_sample() -> None:
    flights = arms.plan_arms(list(arms.ARMS), 50, 60)
    early = [f.arm for f in flights[: len(flights) // 10]]
    assert {early.count(arm) for arm in arms.ARMS} <= {10, 11, 12}


@pytest.mark.slow
def test_every_arm_hides_every_effect_that_its_sensors_can_see() -> None:
    for name, arm in arms.ARMS.items():
        flights = arms.plan_arms([name], 4, 200)
        hidden = {e for f in flights if f.kind == "one" for e in f.effects}
        if not arm.listed:
            assert {e for f in flights for e in f.effects} == set(plan.FOREIGN)
            continue
        channels = set.intersection(*(set(kit(s, 0).noise) for s in arm.sensors))
        blind = {e for e in plan.ALONE if e not in hidden}
        assert ("gyro_bias" in blind) == ("p" not in channels)
        assert ("accel_bias" in blind) == ("ax" not in channels)
        assert ("sonar_delay" in blind) == ("pn" in channels)
        assert {"swash_offset", "servo_lag", "added_mass", "ground_effect"} <= hidden
        assert {f.sensors for f in flights} == set(arm.sensors)
        assert {f.card_noise for f in flights} == set(arm.card)
        assert {f.pilot for f in flights} == set(arm.pilots)
        for flight in flights:
            assert len(flight.effects) == {"clean": 0, "one": 1, "two": 2, "three": 3}[flight.kind]


def test_the_arms_airs_are_what_they_are_called() -> None:
    for flight in arms.plan_arms(["memory_short", "memory_long"], 40, 0):
        memories = one_flight.air_of(flight).memory
        low, high = arms.ARMS[flight.arm].memory or (math.nan, math.nan)
        assert all(low <= m <= high for m in memories) and memories[0] != memories[1]
    flown = {f.arm: one_flight.air_of(f) for f in arms.plan_arms(list(arms.ARMS), 1, 0)}
    assert flown["still"].gusts == "none" and flown["gusty"] == GUSTY
    assert {air.gusts for air in flown.values()} == {"none", *GUSTS}


def test_sizes_are_so_many_times_the_usual() -> None:
    for name, factor in (("sizes_small", 0.3), ("sizes_large", 3.0)):
        for flight in arms.plan_arms([name], 0, 90):
            for effect, sizes in flight.effects.items():
                for parameter, value in sizes.items():
                    least, most, _ = plan.SIZES[effect][parameter]
                    scale = 1.0 if effect == "sonar_tilt" else factor
                    assert abs(value) <= scale * most * (1 + 1e-12)
                    assert value == arms.LEAST_SCALE or abs(value) >= scale * least * (1 - 1e-12)
                    assert value >= arms.LEAST_SCALE or parameter not in ("scale", "excess")


def test_sizes_on_another_craft_do_what_they_do_on_the_papers() -> None:
    """The same angular or linear acceleration, in multiples of g, as on the paper's vehicle."""
    rng = np.random.default_rng(2)
    for craft in (LAMA, COAX, draw(rng), draw(rng)):
        roll = plan.size_on(craft, "rate_damping.coefficient") / craft.inertia_x
        assert roll == pytest.approx(1.0 / LAMA.inertia_x)
        yaw = plan.size_on(craft, "yaw_damping.coefficient") / craft.inertia_z
        assert yaw == pytest.approx(1.0 / LAMA.inertia_z)
        assert plan.size_on(craft, "added_mass.mass") == pytest.approx(craft.mass / LAMA.mass)
        assert plan.size_on(craft, "servo_lag.time") == 1.0
    for parameter in plan.SCALES:
        assert plan.size_on(LAMA, parameter) == 1.0
        effect, _, name = parameter.partition(".")
        assert name in plan.SIZES[effect]


@pytest.mark.slow
def test_the_levels_of_an_air_are_its_own() -> None:
    levels = gust_levels(GUSTY, LAMA)
    known = {"force_xy": 0.2, "force_z": 0.2, "moment_xy": 0.006, "moment_z": 0.003}
    for group, std in known.items():
        assert levels[group] == pytest.approx(std, rel=0.2)
    for group in known:
        assert levels[f"memory_{group}"] == pytest.approx(0.5, rel=0.35)
    light = gust_levels(GUSTY, COAX)["force_z"] / levels["force_z"]
    assert light == pytest.approx(0.302 * 9.81 / (0.8 * 9.804))
    lasting = gust_levels(Air("markov", memory=(3.0, 0.1)), LAMA)
    assert lasting["memory_force_xy"] > 1.5 and lasting["memory_moment_xy"] < 0.15


def arm_rows() -> list[dict[str, Any]]:
    """Two arms, right and wrong in known numbers."""

    def row(arm: str, kind: str, number: int, hidden: str, *named: str, **more: Any) -> dict:
        sizes = {e: plan.sizes_of(e, np.random.default_rng(0)) for e in hidden.split()}
        flight = PlannedFlight(kind, number, sizes, True, "full", 1, plan.RICH, arm=arm)
        return row_of(
            flight, [{"effect": n.strip("?")} | ({"trust": "doubtful"} if "?" in n else {})
                     for n in named], **more,
        )  # fmt: skip

    return [
        row("gusty", "clean", 0, ""),
        row("gusty", "clean", 1, "", "wind"),
        row("gusty", "clean", 2, "", "wind?"),
        row("gusty", "one", 0, "servo_lag", "servo_delay"),
        row("gusty", "one", 1, "gyro_bias", "gyro_bias", "motor_lag?"),
        row("gusty", "one", 2, "gyro_bias", expected={"gyro_bias": 0.0}),
        row("gusty", "two", 0, "gyro_bias wind", "wind", "gyro_bias"),
        row("foreign_forms", "outside", 0, "outside_cable", "yaw_damping"),
        row("foreign_forms", "outside", 1, "outside_wake"),
    ]


def test_the_arms_table_counts_what_it_says() -> None:
    counted = arm_table.figures(arm_rows())
    gusty = counted["gusty"]
    assert gusty["false_clean"] == [2, 3] and gusty["false_clean_sure"] == [1, 3]
    assert gusty["exact_one"] == [1, 2] and gusty["exact_one_strict"] == [0, 2]
    assert gusty["exact_one_all"] == [1, 3] and gusty["exact_more"] == [1, 1]
    assert gusty["false_beside"] == [1, 4] and gusty["false_beside_sure"] == [0, 4]
    assert gusty["sure_false"] == [1, 5]
    foreign = counted["foreign_forms"]
    assert foreign["blamed"] == [1, 2] and foreign["unexplained"] == [0, 2]
    assert counted[arm_table.ALL]["sure_false"] == [2, 6]
    assert list(counted) == ["gusty", "foreign_forms", arm_table.ALL]


def test_a_study_of_arms_writes_its_table(study: Callable, tmp_path: Path) -> None:
    """The stub names the truth wherever it has a name."""
    flown, _ = study("--arms", "gusty,foreign_forms")
    assert len(flown) == 48 and all(name.startswith(("gusty", "foreign")) for name in flown)
    assert study("--arms", "gusty,foreign_forms")[0] == []
    counted = json.loads((tmp_path / "arms.json").read_text())["arms"]
    assert counted["gusty"]["false_clean"] == [0, 8]
    assert counted["gusty"]["exact_one_all"] == [12, 12]
    assert counted["foreign_forms"]["blamed"] == [0, 24]
    text = (tmp_path / "table.md").read_text()
    assert "| gusty | 0/8 = 0 % (0-32) |" in text and "| all arms |" in text


def test_a_class_is_what_its_flights_showed() -> None:
    seen = [
        {"sensors": "gyros", "rate_hz": 100.0, "gap_share": 0.0, "card_noise": True,
         "gust_memory_s": None, "calibrated": None, "why": "nothing has been measured"},
        {"sensors": "gyros, height", "rate_hz": 110.0, "gap_share": 0.0, "card_noise": True,
         "gust_memory_s": 0.4, "calibrated": None, "why": "nothing has been measured"},
    ]  # fmt: skip
    said = classes.described("gusty", "gusts", seen)
    assert said["name"] == "gusty" and "gusts" in said["data"]
    assert said["sensors"] == ["gyros", "gyros, height"] and said["card_noise"] == [True]
    low, high = said["rate_hz"]
    assert 80.0 < low < 100.0 and 110.0 < high < 140.0
    assert said["gap_share"][0] == 0.0 < said["gap_share"][1] < 0.01
    assert 0.3 < said["gust_memory_s"][0] < 0.4 < said["gust_memory_s"][1] < 0.5
    assert not set(said) & {"calibrated", "why"}


def test_every_arm_has_its_own_rate() -> None:
    """One arm's alarms are not another's; one with too few clean flights has no rate."""

    def rows(arm: str, count: int, alarms: int) -> list[dict[str, Any]]:
        flights = [
            PlannedFlight("clean", i, {}, True, "full", 1, plan.RICH, arm=arm) for i in range(count)
        ]
        return [
            row_of(
                f, [{"effect": "wind"}] if f.number < alarms else [],
                strongest={"evidence": 50.0 if f.number < alarms else 1.0, "effect": "wind"},
                **{"class": {"rate_hz": 100.0}},
            )
            for f in flights
        ]  # fmt: skip

    measured = classes.calibrations(
        [*rows("gusty", 40, 0), *rows("dryden", 40, 8), *rows("still", 10, 0)], "command"
    )
    rates = {m["class"]["name"]: m["false_alarm_rate"] for m in measured}
    assert set(rates) == {"gusty", "dryden"}
    assert rates["gusty"] == threshold.FALSE_ALARMS and rates["dryden"] >= 0.2
    json.dumps(measured, allow_nan=False)


def test_an_arm_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["study_diagnosis.py", "--arms", "gusty,stormy"])
    with pytest.raises(InputError, match="no arm 'stormy'"):
        study_diagnosis.main()


# --- the baselines -----------------------------------------------------------------------------------

GROUPS = {"thrust_scale": [1], "wind": [2, 3], "yaw_damping": [4], "rotor_drag": [5]}
"""Effects with made-up regressors: the pickers know columns alone."""


def planted(noise: float, seed: int = 0) -> Gram:
    """y = 3 + thrust_scale - 2 wind_east, and noise."""
    rng = np.random.default_rng(seed)
    X = np.column_stack([np.ones(2000), rng.standard_normal((2000, 5))])
    y = 3.0 + X[:, 1] - 2.0 * X[:, 3] + noise * rng.standard_normal(2000)
    return Gram(X, y, always=1)


@pytest.mark.parametrize("rule", [by_f(20.0), by_bic])
def test_stepwise_regression_finds_what_is_planted(rule: baselines.Rule) -> None:
    assert set(stepwise(planted(1.0), GROUPS, rule)) == {"thrust_scale", "wind"}


def test_stepwise_regression_takes_nothing_out_of_noise() -> None:
    rng = np.random.default_rng(2)
    X = np.column_stack([np.ones(2000), rng.standard_normal((2000, 5))])
    gram = Gram(X, 3.0 + rng.standard_normal(2000), always=1)
    assert stepwise(gram, GROUPS, by_f(20.0)) == []


def test_the_gram_matrix_gives_the_least_squares_fit() -> None:
    rng = np.random.default_rng(3)
    X, y = rng.standard_normal((50, 4)), rng.standard_normal(50)
    coefficients, left = Gram(X, y, always=1).fit([2, 3])
    expected, residual, *_ = np.linalg.lstsq(X[:, [0, 2, 3]], y, rcond=None)
    np.testing.assert_allclose(coefficients, expected[1:])
    assert left == pytest.approx(residual[0])


def test_sparse_regression_finds_what_is_planted() -> None:
    pytest.importorskip("pysindy")
    assert sparse(planted(1.0), GROUPS) == ["thrust_scale", "wind"]


def test_without_pysindy_there_is_no_sparse_regression(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is left out and said to be, never replaced by something of our own."""
    monkeypatch.setitem(sys.modules, "pysindy", None)
    assert sparse(planted(1.0), GROUPS) is None
    assert "PySINDy is not installed" in table.table_text([row_of(flight_with("wind"), [])], "c")


@pytest.fixture(scope="module")
def damped(tmp_path_factory: pytest.TempPathFactory) -> tuple[PlannedFlight, Path, dict[str, Any]]:
    """One short still run with strong yaw damping."""
    folder = tmp_path_factory.mktemp("study") / "flight"
    effects = {"yaw_damping": {"coefficient": 0.006}}
    flight = PlannedFlight("still", 0, effects, False, "full", 5, ("yaw_3211",))
    return flight, folder, hide(flight, folder)


def test_the_wrench_is_what_the_model_says(damped: tuple) -> None:
    """Along the filter's states, yaw damping changes the yaw axis alone, by -k r / I_zz."""
    _, folder, truth = damped
    assert truth["values"] == {"yaw_damping.coefficient": 0.006}
    assert not (folder / "truth.json").exists(), "the package must not find the truth"
    flight = read_flight(folder)
    vehicle = load_vehicle("lama400d").in_air(flight.air)
    model = HeliModel(vehicle)
    noise = starting_noise(flight, vehicle)
    bare = dict(model.bare_values)
    run = Engine(model, [record_of(flight.runs[0])]).filter(bare, noise)[0]
    change = baselines.wrench(model, run, {**bare, "yaw_damping.coefficient": 0.004})
    change -= baselines.wrench(model, run, bare)
    expected = np.zeros_like(change)
    expected[:, 5] = -0.004 * run.states[:, 5] / vehicle["inertia_zz"].value
    np.testing.assert_allclose(change, expected, atol=1e-9)


def test_the_usual_way_finds_yaw_damping_in_still_air(damped: tuple) -> None:
    named = baselines.name_causes(read_flight(damped[1]))
    assert "yaw_damping" in [c["effect"] for c in named["F > 20"]["causes"]]


@pytest.mark.slow
def test_expected_evidence_grows_with_the_square_of_the_size(damped: tuple) -> None:
    """Four times as much at twice the size, but for the Occam factor. Of small sizes: the flight itself
    has another one, and is less and less that of the size asked."""
    planned, folder, truth = damped
    flight = read_flight(folder)

    def worth(factor: float) -> float:
        values = {n: factor * v for n, v in truth["values"].items()}
        nats = expected_evidence(planned, flight, truth | {"values": values}, ())["yaw_damping"]
        assert nats is not None
        return nats

    none, one, two = worth(0.0), worth(0.1), worth(0.2)
    assert none < 0.0 and one > none
    assert (two - none) / (one - none) == pytest.approx(4.0, rel=0.15)


@pytest.mark.slow
def test_far_from_the_truth_an_effect_is_worth_what_its_slopes_say_at_most(
    damped: tuple, monkeypatch
) -> None:
    """An unbalanced torque was expected to be worth 5e60 nats; of a damping both say much the same."""
    planned, folder, truth = damped
    flight = read_flight(folder)
    near = expected_evidence(planned, flight, truth, ())["yaw_damping"]
    assert near is not None and near > 20.0
    monkeypatch.setattr(expecting, "GATE", 0.0)
    by_slopes = expected_evidence(planned, flight, truth, ())["yaw_damping"]
    assert by_slopes == pytest.approx(near, rel=0.3) and by_slopes <= near


@pytest.mark.slow
def test_a_deadband_is_expected_to_be_worth_what_the_play_that_names_it_is(damped: tuple) -> None:
    """By its own jumps it was expected to be worth 8,500 nats on a flight, and was called missed."""
    planned, folder, _ = damped
    flight = read_flight(folder)
    dead, play = (
        expected_evidence(planned, flight, {"hidden": [e], "values": {f"{e}.width": 0.02}}, ())[e]
        for e in ("servo_deadband", "servo_play")
    )
    assert dead == play != 0.0


@pytest.mark.slow
def test_expected_evidence_is_what_the_likelihood_has_in_gusts(tmp_path: Path) -> None:
    """Of a damping, most of which a filter with its gains held would promise is not there."""
    expected, had = [], []
    for seed in (21, 22):
        flight = arms.planned("gusty", "one", 0, seed)
        effects = {"axial_damping": {"coefficient": 0.11}}
        flight = replace(flight, effects=effects, runs=("lat_3211", "heave_3211", "low_hover"))
        folder = tmp_path / str(seed)
        truth = hide(flight, folder)
        log = read_flight(folder)
        nats = expected_evidence(flight, log, truth, ())["axial_damping"]
        assert nats is not None
        vehicle = load_vehicle(log.vehicle).in_air(log.air)
        engine = Engine(HeliModel(vehicle), [record_of(run) for run in log.runs])
        noise = true_noise(flight, log, vehicle, {})
        bare = engine.model.bare_values
        with_it = engine.log_likelihood({**bare, **truth["values"]}, noise)
        expected.append(nats)
        had.append(with_it - engine.log_likelihood(bare, noise))
    assert 0.5 * sum(had) < sum(expected) < 2.0 * sum(had), (expected, had)


@pytest.mark.slow
def test_the_truth_is_likelier_than_nothing_by_what_two_whole_fits_say(damped: tuple) -> None:
    """Of a damping that is there, by hand; of one that nobody hid nothing but the Occam factor."""
    _, folder, truth = damped
    flight = read_flight(folder)
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    records = [record_of(run) for run in flight.runs]
    candidates = ("yaw_damping", "rate_damping")
    problem = Problem.of(HeliModel(vehicle), records, candidates)
    nothing = converged(problem, start(problem, starting_noise(flight, vehicle)))
    hidden = {"yaw_damping.coefficient": 0.006, "rate_damping.coefficient": 0.0}
    both = {"hidden": [*candidates, "servo_lag"], "values": hidden}
    found = likelier_than_nothing(problem, nothing, both)
    assert found["servo_lag"] is None  # no candidate
    there = replace(nothing.at({"yaw_damping.coefficient": 0.006}), active=("yaw_damping",))
    gained = nothing.objective - converged(problem, there).objective
    assert gained > 100.0
    one = likelier_than_nothing(problem, nothing, truth)["yaw_damping"]
    assert one == pytest.approx(gained, rel=0.1) and one < gained  # less the Occam factor
    assert found["rate_damping"] is not None and found["rate_damping"] < 2.0
    assert found["yaw_damping"] == pytest.approx(one, rel=0.2)


def test_a_row_shows_what_the_likelihood_has_and_an_old_one_does_not_say() -> None:
    row = {"hidden": ["wind"], "likelier": {"wind": 28.0}}
    assert judge.is_likelier(row, 14.0)
    for other in ({}, {"wind": None}, {"wind": 27.9}):
        assert not judge.is_likelier(row | {"likelier": other}, 14.0)
    assert not judge.is_likelier({"hidden": ["wind"]}, 14.0)
    two = {"hidden": ["wind", "servo_lag"], "likelier": {"wind": 28.0, "servo_lag": 20.0}}
    assert not judge.is_likelier(two, 14.0)


def test_sizes_in_the_catalogues_form() -> None:
    """The ground's lift by Cheeseman and Bennett and by the catalogue's exponential agree."""
    values = catalogue_values({"ground_effect.gain": 1.0, "outside.heading_moment": 0.02})
    assert set(values) == {"ground_effect.gain", "ground_effect.decay"}
    for ratio in (1.2, 1.6, 2.0, 2.4):  # z/R
        rise = 1.0 / (1.0 - (0.25 / ratio) ** 2) - 1.0
        ours = values["ground_effect.gain"] * math.exp(-values["ground_effect.decay"] * ratio)
        assert ours == pytest.approx(rise, rel=0.15)


@pytest.mark.slow
def test_one_flight_from_plan_to_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A strong gyro bias: found, worth about what was expected, and reported in every file."""
    monkeypatch.setenv("COAX_THREADS", "1")
    effects = {"gyro_bias": {"x": 0.05, "y": -0.04, "z": 0.03}}
    flight = PlannedFlight("one", 0, effects, True, "full", 5, ("lon_3211", "yaw_3211"))
    row = fly_and_diagnose(flight)
    assert "error" not in row, row["error"]
    assert judge.is_exact_row(row)
    evidence = row["methods"]["coax"]["causes"][0]["evidence"]
    # without the cause the levels of the readings are fitted anew, and take up part of it
    assert 0.3 < evidence / row["expected"]["gyro_bias"] < 2.0
    assert {"F > 4", "F > 20", "BIC"} <= set(row["methods"])
    store.store(tmp_path, flight, row)
    assert store.stored(tmp_path, flight) == row
    study_diagnosis.write_results(tmp_path, [row], "command")
    assert (
        "| exact cause, one effect | >= 95 % | 100.0 % | 1/1 |"
        in (tmp_path / "table.md").read_text()
    )


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["loky", "ray"])
def test_two_workers_do_what_one_does(backend: str) -> None:
    """joblib's processes and a local Ray of two workers: every flight comes back, once."""
    if backend == "ray":
        pytest.importorskip("ray")
    flights = [
        PlannedFlight("still", i, {}, False, "full", 5, ("lon_3211",)) for i in range(3)
    ]  # fmt: skip
    options = argparse.Namespace(jobs=2, backend=backend, no_baselines=True)
    rows = {flight.name: row for flight, row in study_diagnosis.each(flights, options)}
    assert set(rows) == {f.name for f in flights}
    for row in rows.values():
        assert "error" not in row, row["error"]
        assert row["methods"]["coax"] == rows["still-0000"]["methods"]["coax"], "the same seed"


@pytest.mark.slow
def test_identification_is_counted_by_arm_as_stated_and_by_the_readings_alone():
    """What commands show can only widen an interval; where the file is not the truth nothing counts."""
    found = coverage.identify_in_arm(("camera", 0, 771))
    assert set(found) == {"camera", coverage.ALL_ARMS, coverage.READINGS_ALONE}
    assert found["camera"] == found[coverage.ALL_ARMS] and found["camera"]
    for stated, alone in zip(found["camera"], found[coverage.READINGS_ALONE], strict=True):
        assert stated["name"] == alone["name"] and stated["truth"] == alone["truth"]
        assert stated["low"] < alone["low"] and alone["high"] < stated["high"]
    assert coverage.identify_in_arm(("spread_vehicles", 0, 771)) == {}
