"""Does the fitted model make such flights? Gusty ones by other code, their noise known, then wrong."""

import math
from collections.abc import Mapping
from typing import Any

import injector
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2, norm

from coax_env import load_vehicle, read_flight
from coax_env.diagnosis import model_check as model_check_module
from coax_env.diagnosis.model_check import (
    LAGS,
    LARGE,
    SEEN,
    ModelCheck,
    _about,
    _answers,
    _changes_before,
    _correlations,
    _late_rows,
    _power,
    _rows_ahead,
    _spectra,
    _starts,
    _unseen,
    model_check,
)
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.remarks import (
    answered_gusts,
    held_out_before,
    one_step_against_a_second,
)
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.prediction import RunReplay
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import Noise, Record
from coax_env.model.layout import CHANNELS

RUNS = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
GUSTS = {"force_xy": 0.2, "force_z": 0.2, "moment_xy": 0.006, "moment_z": 0.003}
LAMA = load_vehicle("lama400d")


@pytest.fixture(scope="module")
def gusty(tmp_path_factory) -> tuple[Problem, Noise]:
    folder = tmp_path_factory.mktemp("gusty") / "flight"
    flight = read_flight(injector.fly(folder, {}, gusts=True, runs=RUNS, seed=5))
    noise = starting_noise(flight, LAMA)
    noise = at_floor(noise).with_levels(GUSTS)
    return Problem.of(HeliModel(LAMA), [record_of(run) for run in flight.runs]), noise


def at_floor(noise: Noise) -> Noise:
    """Every gust, drift and white level at its floor, the memories as they are."""
    levels = {n: v for n, v in noise.floor.items() if n in noise.process and "memory" not in n}
    return noise.with_levels(levels)


def checked(problem: Problem, noise: Noise) -> ModelCheck:
    fit = Fit((), problem.model.bare_values, noise)
    return model_check(problem, fit, problem.engine.filter(fit.values, fit.noise))


@pytest.mark.slow
def test_nothing_is_said_of_a_right_model(gusty):
    assert checked(*gusty).entry == {
        "prediction": [], "spectrum": [], "commands": [], "words": [],
    }  # fmt: skip


@pytest.mark.slow
def test_gusts_taken_for_too_weak_are_seen_a_second_ahead(gusty):
    """Yaw gusts a tenth of what they are: the heading's errors grow beyond what they should be."""
    problem, noise = gusty
    check = checked(problem, noise.with_levels({"moment_z": 3e-4}))
    heading = {e["horizon_s"]: e["ratio"] for e in check.prediction if e["channel"] == "psi"}
    assert heading[1.0] > 1.5 and min(heading.values()) > LARGE
    assert not {e["channel"] for e in check.prediction} & {"p", "q", "h", "phi", "theta"}
    assert any(text.startswith("heading: its") for text in check.remarks)


def test_a_sensor_louder_than_the_model_has_it_is_seen(gusty):
    problem, noise = gusty
    check = checked(problem, noise.with_levels({"r": 0.5 * noise.reading["r"]}))
    high = {e["channel"]: e["ratio"] for e in check.spectrum if e["band_hz"] == [8.0, 25.0]}
    assert set(high) == {"r"} and high["r"] > 1.5
    assert {e["channel"] for e in check.spectrum} <= {"r", "psi"}, (
        "the heading follows from the rate"
    )


def loud(rows: int, rate: float = 20.0) -> RunPass:
    """A pass of which one channel has innovations of power 2 at every frequency."""
    unseen = int(SEEN * rate) + 1
    t = np.arange(unseen + rows) / rate
    phases = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, rows // 2 + 1)
    innovations = np.full((t.size, len(CHANNELS)), np.nan)
    e = np.fft.irfft(np.sqrt(2.0 * rows) * np.exp(1j * phases), rows)
    innovations[unseen:, CHANNELS.index("q")] = e
    none = np.empty(0)
    record = Record("loud", t, np.zeros((t.size, 4)), innovations)
    return RunPass(record, none, 0.0, innovations, none, 0, none, none, none, none, none, none)


def test_a_band_is_loud_where_so_much_power_is_no_chance():
    """Of 8 lines of white noise a mean power of 2 is: 16 degrees of freedom, one in a hundred."""
    bands = [e["band_hz"] for e in _spectra([loud(108)])]
    assert [0.5, 2.0] not in bands and [2.0, 8.0] in bands
    entries = [e for e in _spectra([loud(108)] * 8) if e["band_hz"] == [0.5, 2.0]]
    assert entries == [{"channel": "q", "band_hz": [0.5, 2.0], "ratio": 1.41}]


def test_innovations_that_follow_a_command_are_seen(tmp_path):
    """Swash commands that come 80 ms late, which the model does not know."""
    flight = read_flight(
        injector.fly(tmp_path / "late", {"servo_delay": 0.08}, runs=RUNS[:2], seed=6)
    )
    noise = starting_noise(flight, LAMA)
    noise = at_floor(noise)
    problem = Problem.of(HeliModel(LAMA), [record_of(run) for run in flight.runs])
    check = checked(problem, noise)
    followed = {(e["channel"], e["command"]) for e in check.commands}
    assert ("q", "longitudinal swash") in followed and ("p", "lateral swash") in followed
    assert any("follow it" in text for text in check.remarks)


# --- one step against a second ----------------------------------------------------------------------


def flown(nats: float) -> list[RunReplay]:
    return [RunReplay("run", {}, False, {}, {}, nats)]


@pytest.mark.parametrize(
    ("better", "low", "said"), [(50.0, 0.45, True), (50.0, 0.35, False), (-5.0, 0.45, False)]
)
def test_a_better_likelihood_with_a_worse_second_is_said(better, low, said):
    entry: Mapping[str, Any] = {"before_refitted": 0.4, "ci95": [low, 0.6]}
    gain = {"channels": {"psi": entry}}
    texts = one_step_against_a_second(gain, flown(100.0), flown(100.0 + better), SETTINGS)
    assert bool(texts) == said
    assert not said or ("50 nats" in texts[0] and "heading" in texts[0])
    assert one_step_against_a_second(None, [], [], SETTINGS) == []


@pytest.mark.parametrize(("persistence", "said"), [(0.40, True), (0.50, False), (None, False)])
def test_where_nothing_moves_predicts_better_beyond_chance_it_is_said(persistence, said):
    entry: Mapping[str, Any] = {"persistence": persistence, "after": 0.54, "ci95": [0.45, 0.64]}
    other = {"persistence": 0.1, "after": 0.2, "ci95": [None, None]}
    texts = answered_gusts({"channels": {"psi": entry, "h": other}})
    assert ["heading" in text and "height" not in text for text in texts] == [True] * said
    assert answered_gusts(None) == []


@pytest.mark.parametrize(
    ("held_out", "since", "said"),
    [
        (["a"], "b", True),
        (["a"], "a", False),
        (["a", "c"], "b", False),
        (["a"], None, False),
        (["a (its last third)"], "b", False),
    ],
)
def test_a_gain_on_runs_before_a_cause_began_says_nothing_of_it(held_out, since, said):
    cause = {"effect": "swash_offset", "since": since and {"run": since, "t": 2.0}}
    texts = held_out_before({"held_out": held_out}, [cause], ["a", "b", "c"])
    assert ["swash offset" in text for text in texts] == [True] * said
    assert held_out_before(None, [cause], []) == []
    assert np.isnan(RunReplay("run", {}, False, {}).log_likelihood)


# --- where predictions start, and what they are compared with ---------------------------------------


T = 50.0 + 0.1 * np.arange(301)
"""30 s at 10 Hz, on a clock that started elsewhere."""


def record_at(t: np.ndarray, shown: bool = False) -> Record:
    ones = np.ones((t.size, len(CHANNELS)))
    innovations = np.ones((t.size, 4)) if shown else None
    return Record("a", t, np.zeros((t.size, 4)), ones, t[0], innovations)


def test_starts_are_five_seconds_apart_from_two_seconds_on():
    """Two seconds of readings and three of flight; a second set lies halfway; the last sees 0.25 s."""
    np.testing.assert_allclose(_starts(record_at(T), 0.0), [52.0, 57.0, 62.0, 67.0, 72.0, 77.0])
    np.testing.assert_allclose(_starts(record_at(T), 0.5), [54.5, 59.5, 64.5, 69.5, 74.5, 79.5])
    assert _starts(record_at(T[:22]), 0.0).size == 0


def test_three_seconds_from_a_start_are_unseen_and_eight_before_it_are_seen():
    """In the readings and in what commands show; the start's own row is seen."""
    for shown in (False, True):
        about = _about(record_at(T, shown), 60.0)
        assert (about.t[0], about.t[-1]) == pytest.approx((52.1, 63.0)) and about.origin == T[0]
        blind = _unseen(about, 60.0)
        hidden = about.t > 60.01
        np.testing.assert_array_equal(np.isfinite(blind.z).all(axis=1), ~hidden)
        assert np.isfinite(about.z).all()
        if shown:
            assert blind.input_innovations is not None
            np.testing.assert_array_equal(blind.input_innovations[:, 2], np.where(hidden, 0.0, 1.0))
        else:
            assert blind.input_innovations is None


def test_each_horizon_ends_at_its_row_or_not_at_all():
    assert _rows_ahead(T, 52.0).tolist() == [22, 25, 30, 40, 50]
    assert _rows_ahead(T, 78.6).tolist() == [288, 291, 296, -1, -1]


def test_the_last_reading_within_a_tail_counts():
    """0.15 s: of two rows before, and none of three."""
    z = np.full((T.size, 3), np.nan)
    z[38:41, 0] = 1.0
    z[39, 1] = 1.0
    z[38, 2] = 1.0
    assert _late_rows(T, z, 40).tolist() == [40, 39, -1]


@pytest.fixture
def errors(monkeypatch):
    """Predictions of one channel alone, whose scaled errors are given: by phase, (starts, horizon)."""

    def of(table: list[np.ndarray]) -> list[dict[str, Any]]:
        def made(problem: Any, fit: Any, phase: float) -> np.ndarray:
            own = table[round(phase * len(table))]
            result = np.full((*own.shape, len(CHANNELS)), np.nan)
            result[:, :, CHANNELS.index("psi")] = own
            return result

        monkeypatch.setattr(model_check_module, "scaled_errors", made)
        return list(model_check_module._predictions(None, None))

    return of


def test_errors_are_large_where_their_rms_is_no_chance(errors):
    """40 of 2 at each of two phases: 40 independent ones. By chance 1.66 are once in 10^5."""
    least = math.sqrt(chi2.isf(1e-5, 40) / 40)
    assert 1.4 < least < 1.7
    for size, said in ((1.02 * least, True), (0.98 * least, False)):
        table = np.full((40, 5), 0.5)
        table[:, 2] = size
        found = errors([table, table])
        assert bool(found) == said
        if said:
            (entry,) = found
            assert entry == {"channel": "psi", "horizon_s": 1.0, "ratio": round(size, 2)}
    few = np.full((7, 5), 9.0)
    assert errors([few, few]) == []
    assert len(errors([np.full((8, 5), 9.0)] * 2)) == 5
    many = np.full((4000, 5), 1.2)
    assert errors([many, many]) == [], "no chance, but less than a quarter"
    mixed = np.full((4000, 5), 0.0)
    mixed[::2] = 2.0
    assert {e["ratio"] for e in errors([mixed, 0.0 * mixed + 1.4])} == {1.41}


# --- spectra and answers ----------------------------------------------------------------------------


def passed(e: np.ndarray, t: np.ndarray, command: np.ndarray | None = None) -> RunPass:
    innovations = np.full((t.size, len(CHANNELS)), np.nan)
    innovations[:, CHANNELS.index("q")] = e
    none = np.empty(0)
    record = Record("a", t, np.zeros((t.size, 4)) if command is None else command, innovations)
    return RunPass(record, none, 0.0, innovations, none, 0, none, none, none, none, none, none)


def test_a_bands_power_is_that_of_its_frequencies():
    """A sine of amplitude a over n readings has a^2 n/4 at its own line, in its own band alone."""
    t = 7.0 + 0.05 * np.arange(441)  # the last 400 of them are looked at, from 9.05 s on
    wave = 0.3 * np.sin(2.0 * np.pi * 3.0 * (t - 9.05))
    run, c = passed(wave, t), CHANNELS.index("q")
    power = _power(run, c, 2.0, 8.0)
    assert power.size == 120 and power.max() == pytest.approx(0.09 * 400 / 4.0, rel=1e-6)
    assert power.sum() == pytest.approx(power.max(), rel=1e-6)
    assert _power(run, c, 0.5, 2.0).sum() == pytest.approx(0.0, abs=1e-9)
    assert _power(run, c, 0.0, 0.5).size == 10 and _power(run, c, 8.0, 25.0).size == 39
    few = wave.copy()
    few[-(441 - 41 - 31):] = np.nan  # fmt: skip
    assert _power(passed(few, t), c, 0.0, 25.0).size == 0


def correlations(*runs):
    """Of the pitch rate's innovations with changes of the longitudinal swash, by lag; their number."""
    changes = [_changes_before(run.record) for run in runs]
    found, count = _correlations(runs, changes, CHANNELS.index("q"))
    return dict(zip(LAGS, found[2], strict=True)), count


def test_a_correlation_is_with_what_the_command_did_in_the_twentieth_before():
    """Innovations that are that change, lag seconds late, of one run; nothing in the other."""
    rng = np.random.default_rng(6)
    t = 3.0 + 0.02 * np.arange(1000)
    command = np.zeros((t.size, 4))
    command[:, 2] = np.cumsum(rng.standard_normal(t.size))
    late = np.roll(np.diff(command[:, 2], prepend=0.0), 10)
    found, count = correlations(passed(late, t, command))
    assert count == 1000 - 101
    assert found[0.2] == pytest.approx(1.0, abs=0.02)  # white ones are foretold a little by chance
    assert max(abs(v) for lag, v in found.items() if lag != 0.2) < 0.15
    half = [passed(late, t, command), passed(np.where(t < 0, 1.0, 0.0), t, command)]
    of_half, count = correlations(*half)
    assert of_half[0.2] == pytest.approx(1.0 / math.sqrt(2.0), abs=0.05) and count == 2 * 899
    assert correlations(passed(late, t, 0.0 * command))[0][0.2] == 0.0
    (entry,) = _answers([passed(late, t, command)])
    assert entry.pop("correlation") == pytest.approx(1.0, abs=0.02)
    assert entry == {"channel": "q", "command": "longitudinal swash", "lag_s": 0.2}


@pytest.mark.parametrize(("answered", "said"), [(0.0, False), (0.3, True)])
def test_what_a_pilot_does_about_lasting_innovations_is_no_answer_of_the_model(answered, said):
    """Innovations of a memory of 0.2 s, to which the stick goes 20 ms late: what comes 0.1 s after the
    stick's move was there before it. An answer of the machine beyond that is found all the same."""
    rng = np.random.default_rng(8)
    t = 3.0 + 0.02 * np.arange(4000)
    pushed = lfilter([1.0], [1.0, -0.9], rng.standard_normal(t.size))
    stick = 2.0 * np.roll(pushed, 1) + 0.5 * np.cumsum(rng.standard_normal(t.size))
    command = np.zeros((t.size, 4))
    command[:, 2] = stick
    e = pushed + answered * np.roll(np.diff(stick, prepend=0.0), 5)
    found = correlations(passed(e, t, command))[0][0.1]
    plain = np.corrcoef(e[110:], (np.roll(stick, 5) - np.roll(stick, 6))[110:])[0, 1]
    assert abs(plain) > 0.1 and (abs(found) > 0.1) == said


@pytest.mark.parametrize(("size", "said"), [(0.16, True), (0.12, False)])
def test_a_weak_answer_is_said_from_where_it_is_no_chance(size, said, monkeypatch):
    """Of 900 readings a correlation of 0.142 is once in 10^5 by chance."""
    assert norm.isf(1e-5) / math.sqrt(900) == pytest.approx(0.142, abs=0.001)

    def found(passes, changes, c):
        return np.where(np.arange(4)[:, None] == 1, -size * (c == 4), np.zeros((4, len(LAGS)))), 900

    monkeypatch.setattr(model_check_module, "_correlations", found)
    assert bool(list(_answers([]))) == said


def test_the_worst_of_a_kind_is_in_the_words():
    loud = [{"channel": "q", "band_hz": [0.5, 2.0], "ratio": r} for r in (1.3, 1.9, 1.5)]
    follows = [{"channel": "p", "command": "upper rotor", "lag_s": 0.1, "correlation": r}
               for r in (0.2, -0.4)]  # fmt: skip
    spectrum, command = ModelCheck([], loud, follows).remarks
    assert (
        "1.9 times" in spectrum and "0.5 to 2 Hz" in spectrum and "(correlation -0.40)" in command
    )
