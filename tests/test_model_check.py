"""Does the fitted model make such flights? Gusty ones by other code, their noise known, then wrong."""

from collections.abc import Mapping
from typing import Any

import injector
import numpy as np
import pytest

from coax_env import load_vehicle, read_flight
from coax_env.diagnosis.model_check import LARGE, SEEN, ModelCheck, _spectra, model_check
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.remarks import one_step_against_a_second
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.engine import RunPass
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.prediction import RunReplay
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


def test_nothing_is_said_of_a_right_model(gusty):
    assert checked(*gusty).entry == {
        "prediction": [], "spectrum": [], "commands": [], "words": [],
    }  # fmt: skip


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
    return RunPass(record, none, 0.0, innovations, none, 0, none, none, none, none, none)


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
    assert np.isnan(RunReplay("run", {}, False, {}).log_likelihood)
