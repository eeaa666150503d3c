"""What two logs of one flight differ in, on differences that are written down here.

The logs are stand-ins: the difference of their innovations is a known function of the numbers that
changed, so that what a search must find, and how well it is known, follows by hand.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.comparison.two_logs import changes, stated, trials
from coax_env.comparison.two_logs.before import Before
from coax_env.comparison.two_logs.coordinates import (
    ROTOR_SCALE,
    Coordinate,
    coordinates,
    effective,
    moved,
    scale_of,
)
from coax_env.comparison.two_logs.logs import Logs
from coax_env.comparison.two_logs.stated import Changes
from coax_env.comparison.two_logs.trials import Trial
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.state_space import Noise, Record

ROOM = "coax_env.comparison.two_logs"
MODEL = HeliModel(load_vehicle("lama400d"))
FILE = MODEL.bare_values
NAMES = ("gyro_bias.x", "gyro_bias.y", "wind.north")
USUAL = (0.01, 0.01, 1.5)
KNOWN = {
    effect: [
        Coordinate(effect, name, "1", usual, -5.0 * usual, 5.0 * usual, 0.05 * usual)
        for name, usual in zip(NAMES, USUAL, strict=True)
        if name.startswith(effect)
    ]
    for effect in ("gyro_bias", "wind")
}
BLOCKS, PER_BLOCK = 20, 10
COUNT = BLOCKS * PER_BLOCK
SLOPES = np.random.default_rng(2).standard_normal((COUNT, 3)) / USUAL


@dataclass
class Made:
    """Logs whose difference is `of` the moves from the fit, blocks of PER_BLOCK readings."""

    of: Callable[[np.ndarray], np.ndarray]
    fit: Fit
    asked: int = 0

    @property
    def block(self) -> np.ndarray:
        return np.repeat(np.arange(BLOCKS), PER_BLOCK)

    def difference(self, values: Mapping[str, float]) -> np.ndarray:
        self.asked += 1
        return self.of(np.array([values[n] - self.fit.values[n] for n in NAMES]))

    def slopes(self, at: Mapping[str, float], of: Sequence[Coordinate]) -> np.ndarray:
        return Logs.slopes(self, at, of)  # type: ignore[arg-type]


FIT = Fit((), {"gyro_bias.x": 0.002, "gyro_bias.y": 0.0, "wind.north": 1.0}, Noise({}))
LEFT = 0.05 * np.random.default_rng(3).standard_normal(COUNT)


def linear(true: Sequence[float]) -> Made:
    """Logs whose difference is gone, but for LEFT, where the numbers have moved by these."""
    return Made(lambda x: SLOPES @ (x - np.array(true)) + LEFT, FIT)


# --- worth --------------------------------------------------------------------------------------------


def test_a_set_of_changes_is_worth_how_many_times_smaller_it_makes_the_difference():
    """A tenth of the square left: n/2 log(1.03 / 0.13), less half log n for each number (Schwarz)."""
    nothing = np.full(100, 2.0)
    residual = nothing * math.sqrt(0.1)
    found = trials.worth(nothing, residual, 3, 40)
    expected = 20.0 * math.log(1.03 / 0.13) - 1.5 * math.log(40.0)
    assert found == pytest.approx(expected)
    assert trials.worth(nothing, nothing, 0, 40) == pytest.approx(0.0)


def trial(nats: float, left: float) -> Trial:
    """So many nats by the logs, with a residual worth so many in a flight's own noise."""
    return Trial(("a",), {}, nats, np.array([math.sqrt(2.0 * left)]), np.zeros((1, 0)))


@pytest.mark.parametrize(
    ("nats", "left", "holds"),
    [
        (14.1, 1000.0, True), (13.9, 1000.0, False),  # by the logs
        (0.0, 900.0, True), (0.0, 911.0, False),  # by the flight's noise, beyond three form errors
        (-20.0, 80.0, True),
    ],
)  # fmt: skip
def test_a_change_holds_by_the_logs_or_by_the_flights_own_noise(nats, left, holds):
    """Nothing changed is worth 1000 nats: nine of a hundred must go, and more than a threshold."""
    nothing = trial(0.0, 1000.0)
    found = trials.holds(trial(nats, left), nothing, nothing.residual, SETTINGS)
    assert found == holds


def test_where_little_differs_a_flights_noise_would_not_show_it():
    """Half of 20 nats is a large share, and less than a threshold."""
    nothing = trial(0.0, 20.0)
    assert not trials.holds(trial(0.0, 10.0), nothing, nothing.residual, SETTINGS)
    assert trials.holds(trial(0.0, 5.0), nothing, nothing.residual, SETTINGS)


# --- fits ---------------------------------------------------------------------------------------------


def fitted(logs: Made, *effects: str, begin: Mapping[str, float] | None = None) -> Trial:
    nothing = logs.difference(FIT.values)
    return trials.fitted(logs, KNOWN, effects, begin or {}, nothing)  # type: ignore[arg-type]


def test_moves_are_those_of_least_squares():
    """The prior is a hundred usual sizes wide: it moves nothing."""
    logs = linear((0.02, -0.013, 0.0))
    found = fitted(logs, "gyro_bias")
    exact = np.linalg.lstsq(SLOPES[:, :2], SLOPES[:, :2] @ [0.02, -0.013] - LEFT, rcond=None)[0]
    moves = [found.moves[n] for n in NAMES[:2]]
    np.testing.assert_allclose(moves, exact, rtol=1e-4)
    assert set(found.moves) == set(NAMES[:2])
    np.testing.assert_allclose(found.residual, logs.of(np.array([*moves, 0.0])), atol=1e-9)
    nothing = logs.difference(FIT.values)
    assert found.nats == trials.worth(nothing, found.residual, 2, BLOCKS)
    np.testing.assert_allclose(found.slopes, SLOPES[:, :2], rtol=1e-6)


def test_a_fit_that_stands_at_the_best_takes_no_second_step():
    """One look where it begins, slopes, a step and slopes again; from the best on, no step more."""
    logs = linear((0.02, -0.013, 0.0))
    first = fitted(logs, "gyro_bias")
    assert logs.asked <= 12
    again = linear((0.02, -0.013, 0.0))
    found = fitted(again, "gyro_bias", begin=first.moves)
    assert again.asked < logs.asked
    assert found.moves == pytest.approx(first.moves, rel=1e-6)


def test_a_step_too_far_is_shortened_and_moves_stop_at_their_bounds():
    """A difference that saturates: a whole step goes beyond it, and is halved until it gains."""
    bent = Made(lambda x: np.tanh(SLOPES[:, 2] * (x[2] - 3.0)) + 0.0 * LEFT, FIT)
    found = fitted(bent, "wind", begin={"wind.north": 1.6})
    assert found.moves["wind.north"] == pytest.approx(3.0, rel=1e-3)
    far = fitted(linear((0.0, 0.0, 11.0)), "wind")
    assert far.moves["wind.north"] == pytest.approx(7.5)


def test_effects_are_tried_from_the_best_on_and_the_hopeless_not_at_all():
    """By half b' A^-1 b, what the derivatives promise; less than half of the best is not fitted."""
    logs = linear((0.02, 0.0, 0.0))
    nothing = logs.difference(FIT.values)
    none = Trial((), {}, 0.0, nothing, np.zeros((COUNT, 0)))
    slopes = {"gyro_bias": SLOPES[:, :2], "wind": SLOPES[:, 2:]}

    def tried(made: Made, begin: Trial) -> list[tuple[str, ...]]:
        found = trials.best_trials(made, KNOWN, slopes, begin, nothing)  # type: ignore[arg-type]
        nats = [t.nats for t in found]
        assert nats == sorted(nats, reverse=True)
        return [t.effects for t in found]

    assert tried(logs, none) == [("gyro_bias",)]
    both = linear((0.02, 0.0, 3.0))
    nothing = both.difference(FIT.values)
    assert set(tried(both, replace(none, residual=nothing))) == {("gyro_bias",), ("wind",)}
    there = fitted(both, "gyro_bias")
    assert tried(both, there) == [("gyro_bias", "wind")]


def test_what_stood_for_a_later_change_is_dropped():
    """The wind alone explains what the gyro was taken for; both together keep both."""
    alone, both = linear((0.0, 0.0, 3.0)), linear((0.02, 0.0, 3.0))
    for logs, left in ((alone, ("wind",)), (both, ("gyro_bias", "wind"))):
        nothing = logs.difference(FIT.values)
        best = fitted(logs, "gyro_bias", "wind")
        found = trials.without_worthless(logs, KNOWN, best, nothing, SETTINGS)  # type: ignore
        assert found.effects == left


@pytest.mark.parametrize(
    ("true", "found"), [((0.02, 0.0, 3.0), {"gyro_bias", "wind"}), ((0.0, 0.0, 3.0), {"wind"}),
                        ((0.0, 0.0, 0.0), set())],
)  # fmt: skip
def test_changes_are_found_one_by_one_until_none_holds(monkeypatch, true, found):
    """Of two logs alike nothing is asked; another effect of the same column is its alternative."""
    quiet = Made(lambda x: SLOPES @ (x - np.array(true)) + 1e-3 * LEFT, FIT)
    known = KNOWN | {"twin": [replace(c, effect="twin") for c in KNOWN["wind"]]}
    slopes = {"gyro_bias": SLOPES[:, :2], "wind": SLOPES[:, 2:], "twin": 0.999 * SLOPES[:, 2:]}
    monkeypatch.setattr(changes, "Logs", lambda *given: quiet)
    monkeypatch.setattr(changes, "_of_readings", lambda before, there: slopes)
    monkeypatch.setattr(
        changes,
        "stated",
        lambda problem, logs, known, best, alike, nothing: Changes((best, alike), 0.0, 0.0),
    )
    one = record("a", 2.0, 0.0)
    made = SimpleNamespace(
        settings=SETTINGS, model=None, engine=SimpleNamespace(records=[one], threads=1)
    )
    monkeypatch.setattr(changes, "Engine", Echo)
    before = Before(made, FIT, [], [np.ones((4, 18), bool)], known, slopes)  # type: ignore
    best, alike = changes.changes(before, [one]).changes  # type: ignore[misc]
    names = {"wind" if e == "twin" else e for e in best.effects}
    assert names == found
    for effect, others in alike.items():
        twins = {"wind", "twin"} - {effect} if effect != "gyro_bias" else set()
        assert twins <= set(others)
        if len(found) == 1:  # of two that are needed one nearly does what the other does
            assert twins == set(others)


# --- how well a change is known -----------------------------------------------------------------------


def test_a_std_is_that_of_the_residuals_scores_block_by_block():
    """Independent residuals: s^2 (J'J)^-1; with one sign through each block ten times the variance."""
    own = KNOWN["wind"]
    J = np.full((COUNT, 1), 40.0)
    rng = np.random.default_rng(5)
    logs = SimpleNamespace(block=np.repeat(np.arange(BLOCKS), PER_BLOCK))
    sign = np.repeat(rng.choice([-1.0, 1.0], BLOCKS), PER_BLOCK)
    best = Trial(("wind",), {"wind.north": 0.0}, 0.0, 0.3 * sign, J)
    found = stated.std_of(logs, own, best, 0.01, 0.01)["wind.north"]  # type: ignore[arg-type]
    expected = 0.3 / (40.0 * math.sqrt(COUNT)) * math.sqrt(PER_BLOCK * BLOCKS / (BLOCKS - 1))
    assert found == pytest.approx(expected, rel=1e-5)
    assert stated.std_of(logs, [], best, 0.01, 0.01) == {}  # type: ignore[arg-type]


def test_a_std_is_at_least_a_share_of_the_effects_change_and_lags_know_half_a_row():
    """The largest axis counts, in usual sizes; a uniform error of a row has a std of dt / sqrt 12."""
    logs = SimpleNamespace(block=np.repeat(np.arange(BLOCKS), PER_BLOCK))
    lag = Coordinate("servo_lag", "servo_lag.time", "s", 0.04, 0.0, 0.2, 0.02, timing=True)
    own = [*KNOWN["gyro_bias"], lag]
    moves = {"gyro_bias.x": -0.04, "gyro_bias.y": 0.01, "servo_lag.time": 0.008}
    best = Trial(("gyro_bias", "servo_lag"), moves, 0.0, np.zeros(COUNT), SLOPES)
    found = stated.std_of(logs, own, best, 0.012, 0.05)  # type: ignore[arg-type]
    assert found["gyro_bias.x"] == found["gyro_bias.y"] == pytest.approx(0.05 * 0.04)
    assert found["servo_lag.time"] == pytest.approx(math.hypot(0.05 * 0.008, 0.012 / math.sqrt(12)))


# --- logs ---------------------------------------------------------------------------------------------


def record(name: str, seconds: float, start: float) -> Record:
    t = start + 0.5 * np.arange(round(2 * seconds))
    return Record(
        name, t, np.tile([200.0, 210.0, 0.03, -0.02], (t.size, 1)), np.zeros((t.size, 18))
    )


class Echo:
    """An engine whose innovations are the commands and a number."""

    def __init__(self, model: Any, records: Sequence[Record], threads: int = 1) -> None:
        self.model, self.records, self.threads = model, list(records), threads

    def filter(self, values: Mapping[str, float], noise: Any) -> list[SimpleNamespace]:
        assert ROTOR_SCALE not in values
        return [
            SimpleNamespace(record=r, innovations=r.command + values["wind.north"])
            for r in self.records
        ]


def logs_of(records: Sequence[Record], there: list[np.ndarray]) -> Logs:
    before = [0.5 * r.command for r in records]
    return Logs(Echo(None, records), FIT, before, there)  # type: ignore[arg-type]


def test_blocks_are_two_seconds_of_a_run_and_of_one_run_alone():
    """Numbered on through the runs, by each reading's time since its own run began."""
    records = [record("a", 5.0, 30.0), record("b", 3.0, 4.0)]
    there = [np.ones((10, 4), bool), np.zeros((6, 4), bool)]
    there[0][3] = False
    there[1][1:, 2] = True
    found = logs_of(records, there).block
    expected = [*np.repeat([0, 0, 0, 1, 1, 1, 1, 2, 2], 4), 3, 3, 3, 4, 4]
    assert found.tolist() == expected


def test_faster_rotors_are_flown_as_larger_commands(monkeypatch):
    """Of both rotors and of nothing else; what is missing in one of the logs counts for nothing."""
    monkeypatch.setattr(f"{ROOM}.logs.Engine", Echo)
    records = [record("a", 2.0, 0.0)]
    there = [np.ones((4, 4), bool)]
    there[0][2, 1] = False
    logs = logs_of(records, there)
    still = logs.difference({"wind.north": 1.0})
    faster = logs.difference({"wind.north": 1.0, ROTOR_SCALE: 0.04})
    row = np.array([101.0, 106.0, 1.015, 0.99])
    assert still.size == 15
    np.testing.assert_allclose(still[:4], row)
    np.testing.assert_allclose((faster - still)[:4], [8.0, 8.4, 0.0, 0.0], atol=1e-12)
    own = [Coordinate("rotor_speed", ROTOR_SCALE, "1", 0.035, -1.0, 1.0, 0.002),
           Coordinate("wind", "wind.north", "m/s", 1.5, -9.0, 9.0, 0.1)]  # fmt: skip
    slopes = logs.slopes({"wind.north": 1.0}, own)
    np.testing.assert_allclose(slopes[:4], [[200, 1], [210, 1], [0, 1], [0, 1]], atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, -0.5])
def test_rotors_of_any_speed_are_flown(monkeypatch, scale):
    """Twice and half as fast; and where they are as fast as before no engine is made anew."""
    monkeypatch.setattr(f"{ROOM}.logs.Engine", Echo)
    records = [record("a", 1.0, 0.0)]
    logs = logs_of(records, [np.ones((2, 4), bool)])
    found = logs.difference({"wind.north": 0.0, ROTOR_SCALE: scale})[:4]
    faster = 1.0 + scale
    np.testing.assert_allclose(found, [200 * (faster - 0.5), 210 * (faster - 0.5), 0.015, -0.01])
    monkeypatch.setattr(f"{ROOM}.logs.Engine", None)
    assert logs.difference({"wind.north": 0.0})[0] == 100.0


def test_readings_of_a_filters_first_second_do_not_count(monkeypatch):
    """By each run's own clock, from one second on; nor do those that are missing."""
    monkeypatch.setattr(f"{ROOM}.before.coordinates", lambda problem, fit: KNOWN["wind"])
    records = [record("a", 3.0, 30.0), record("b", 2.0, 4.0)]
    engine = Echo(None, records)
    records[1].command[3, 2] = np.nan
    said: list[str] = []
    made = SimpleNamespace(engine=engine, report=said.append)
    found = Before.of(made, FIT)  # type: ignore[arg-type]
    expected = [np.repeat([[False] * 4, [True] * 4], [2, n - 2], axis=0) for n in (6, 4)]
    expected[1][3, 2] = False
    for there, wanted in zip(found.there, expected, strict=True):
        np.testing.assert_array_equal(there, wanted)
    assert found.slopes["wind"].shape == (16 + 7, 1)
    np.testing.assert_allclose(found.slopes["wind"], 1.0)
    assert said == ["what 1 numbers change of the innovations"]


def test_logs_of_other_rows_are_of_another_flight():
    one, late = record("a", 5.0, 0.0), record("a", 5.0, 0.1)
    changes._check_same_rows([one], [replace(one, z=one.z + 1.0)])
    for other in ([late], [replace(one, name="b")], [one, one], []):
        with pytest.raises(changes.InputError, match="not two logs"):
            changes._check_same_rows([one], other)


# --- coordinates --------------------------------------------------------------------------------------


def problem(*effects: str) -> Problem:
    own = {e: tuple(MODEL.effect_parameters(e)) for e in effects}
    return Problem(MODEL, None, tuple(MODEL.base_parameters()), own)  # type: ignore[arg-type]


def of(values: Mapping[str, float], *effects: str) -> dict[str, Coordinate]:
    made = problem(*effects)
    return {c.name: c for c in coordinates(made, Fit((), values, Noise({})))}


def test_a_number_moves_five_usual_sizes_and_no_farther_than_physics():
    """About its value in the fit: a lag of 0.1 s may lose that, and gain five usual ones."""
    found = of({"servo_lag.time": 0.1, "wind.north": 2.0}, "servo_lag", "wind", "ground_effect")
    lag, north = found["servo_lag.time"], found["wind.north"]
    assert (lag.lower, lag.upper) == (pytest.approx(-0.1), pytest.approx(0.2)) and lag.timing
    assert (north.lower, north.upper) == (-7.5, 7.5) and north.step == pytest.approx(0.075)
    assert "ground_effect.decay" not in found, "a shape is none"
    near = of({"servo_lag.time": 0.45}, "servo_lag")["servo_lag.time"]
    assert (near.lower, near.upper) == (pytest.approx(-0.2), pytest.approx(0.05))
    scale = found[ROTOR_SCALE]
    assert scale.upper == -scale.lower == pytest.approx(0.175)
    assert scale.step == pytest.approx(0.00175)


def test_a_derivative_is_taken_by_the_probe_at_nothing_and_inwards_at_a_bound():
    """What has no slope at nothing needs a finite step; elsewhere a twentieth of a usual size."""
    for value, step in ((0.0, 0.02), (0.004, 0.02), (0.006, 0.002), (0.4999, -0.002)):
        found = of({"servo_lag.time": value}, "servo_lag")["servo_lag.time"]
        assert found.step == pytest.approx(step), value


def test_a_swash_offset_keeps_the_tilt_that_it_makes():
    """A linkage of 1.25 times: the offset is 0.8 times, beside its own move; a scale multiplies."""
    values = {**FILE, "swash_offset.lon": 0.02, "swash_offset.lat": -0.01, "swash_gain.scale": 0.2}
    found = moved(values, {"swash_gain.scale": 0.25, "swash_offset.lat": 0.003})
    assert found["swash_gain.scale"] == pytest.approx(1.2 * 1.25 - 1.0)
    assert found["swash_offset.lon"] == pytest.approx(0.016)
    assert found["swash_offset.lat"] == pytest.approx(-0.008 + 0.003)
    plain = moved(values, {"swash_offset.lon": 0.004, "wind.north": -1.0})
    assert plain["swash_offset.lon"] == pytest.approx(0.024) and plain["wind.north"] == -1.0
    assert plain["swash_offset.lat"] == -0.01
    assert moved({ROTOR_SCALE: 0.1}, {ROTOR_SCALE: -0.1})[ROTOR_SCALE] == pytest.approx(-0.01)


def test_a_mass_is_one_number_wherever_a_fit_put_it():
    """In kilograms: what the fit moved the file's by, and what the effect adds."""
    made = problem("added_mass")
    values = {**FILE, "mass": FILE["mass"] + 0.03, "added_mass.mass": 0.02}
    found = effective(made, values, "added_mass")
    assert found == {"added_mass.mass": pytest.approx(0.05)}
    assert effective(made, {**values, ROTOR_SCALE: 0.04}, "rotor_speed") == {ROTOR_SCALE: 0.04}


def test_a_move_of_a_scale_is_a_share_of_what_it_scales():
    """A linkage at 1.2 that moves by a tenth has moved by 0.12; masses and offsets by themselves."""
    for effect, name, before, expected in (
        ("swash_gain", "swash_gain.scale", 0.2, 1.2), ("rotor_speed", ROTOR_SCALE, -0.1, 0.9),
        ("added_mass", "added_mass.mass", 0.05, 1.0), ("wind", "wind.north", 3.0, 1.0),
    ):  # fmt: skip
        c = Coordinate(effect, name, "1", 1.0, -1.0, 1.0, 0.1)
        assert scale_of({name: before}, c) == pytest.approx(expected)


# --- what is stated -----------------------------------------------------------------------------------


def test_each_changes_evidence_is_what_a_flight_with_noise_would_lose_without_it():
    """Half the square of what is left without it, less that with it; the strongest first."""
    logs = linear((0.004, 0.0, 3.0))
    nothing = logs.difference(FIT.values)
    best = fitted(logs, "gyro_bias", "wind")
    made = replace(
        problem("gyro_bias", "wind"),
        engine=SimpleNamespace(records=[record("a", 5.0, 0.0)]),  # type: ignore[arg-type]
    )
    alike = {"gyro_bias": ("wind",), "wind": ()}
    found = stated.stated(made, logs, KNOWN, best, alike, nothing)  # type: ignore[arg-type]
    assert [c.effect for c in found.changes] == ["wind", "gyro_bias"]
    for c, other in zip(found.changes, ("gyro_bias", "wind"), strict=True):
        without = fitted(logs, other).residual
        expected = 0.5 * (without @ without - best.residual @ best.residual)
        assert c.evidence == pytest.approx(expected, rel=1e-6)
        for name, p in c.parameters.items():
            assert p.before == FIT.values.get(name, 0.0)
            assert p.change == pytest.approx(best.moves[name], rel=1e-9)
    assert found.changes[1].confusable_with == ("wind",)
    assert found.different == pytest.approx(0.5 * nothing @ nothing)
    assert found.left == pytest.approx(0.5 * best.residual @ best.residual)
    # known no better than it fits: the root of what is left of the difference's square
    north = found.changes[0].parameters["wind.north"]
    share = math.sqrt(found.left / found.different)
    assert 0.02 < share <= north.std / north.change < 1.05 * share
    entry = found.as_json()
    assert entry["verdict"] == "changed" and entry["left_nats"] == found.left
