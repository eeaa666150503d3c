"""What kind of flight it is, on flights and noise that are made up: rates, gaps, gusts over weight."""

from types import SimpleNamespace

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.diagnosis.calibration import class_of, differences
from coax_env.diagnosis.problem import Fit
from coax_env.estimation.helicopter_noise import GUST_LEVELS, MEMORIES, WHITE_LEVELS
from coax_env.estimation.state_space import Noise
from coax_env.logs.flight import Flight, Run

VEHICLE = load_vehicle("lama400d").with_values({"arm_upper": 0.2, "mass": 0.5})
WEIGHT = VEHICLE["mass"].value * VEHICLE["gravity"].value
FLOOR = {**dict.fromkeys(GUST_LEVELS, 1e-4), **dict.fromkeys(WHITE_LEVELS, 1e-5)}


def fit(**levels: float) -> Fit:
    """Gusts and white noise at their floors but for what is given; memories of half a second."""
    process = {**FLOOR, **dict.fromkeys(MEMORIES, 0.5), **levels}
    return Fit((), {}, Noise(process, {}, FLOOR))


def run(name: str, t: np.ndarray, silent: np.ndarray | None = None, whole: str = "") -> Run:
    """Gyros that are read on every row that is not silent, and a height on every fifth of them."""
    p = np.where(np.zeros(t.size, bool) if silent is None else silent, np.nan, 1.0)
    h = np.where(np.arange(t.size) % 5 == 0, p, np.nan)
    return Run(name, t, np.zeros((t.size, 4)), {"p": p, "h": h}, part_of=whole or None)


def seen(*runs: Run, noise: dict[str, float] | None = None, **levels: float) -> dict:
    flight = Flight("lama400d", runs, noise=noise or {})
    return class_of(flight, VEHICLE, fit(**levels))


T = 12.0 + 0.02 * np.arange(501)


def test_sensors_rate_and_card():
    found = seen(run("a", T), run("b", T), noise={"p": 0.1})
    assert found["sensors"] == "gyros, height" and found["rate_hz"] == 50.0
    assert found["gap_share"] == 0.0 and found["mass_kg"] == 0.5
    assert found["card_noise"] is False
    assert seen(run("a", T), noise={"p": 0.1, "h": 0.2})["card_noise"] is True


def test_gaps_are_times_without_any_reading_in_a_run_and_between_its_parts():
    """Of 10 s 1.02 are silent; and between two parts of a run 4 of 14; rows between are no gap."""
    silent = (T > 14.001) & (T < 15.001)
    assert seen(run("a", T, silent))["gap_share"] == pytest.approx(1.02 / 10.0, abs=6e-5)
    brief = (T > 14.001) & (T < 14.071)
    assert seen(run("a", T, brief))["gap_share"] == 0.0
    first, second = run("a", T[:251], whole="a"), run("a (2)", T[250:] + 4.0, whole="a")
    assert seen(first, second)["gap_share"] == pytest.approx(4.0 / 14.0, abs=6e-5)
    assert seen(first, run("b", T[250:] + 4.0))["gap_share"] == 0.0, "other runs are flown apart"


def test_gusts_are_over_the_weight_and_over_it_times_the_arm():
    """The largest of each kind; a level that is not three times its floor is not felt."""
    found = seen(run("a", T), force_z=0.02 * WEIGHT, force_xy=0.01 * WEIGHT,
                 moment_xy=0.004 * WEIGHT * 0.2)  # fmt: skip
    assert found["gust_force"] == pytest.approx(0.02, abs=6e-5)
    assert found["gust_moment"] == pytest.approx(0.004, abs=6e-5)
    assert found["gust_memory_s"] == 0.5
    assert seen(run("a", T))["gust_memory_s"] is None
    for times, felt in ((2.9, False), (3.1, True)):
        found = seen(run("a", T), moment_z=times * 1e-4, white_force_z=times * 1e-5)
        assert (found["gust_memory_s"] is not None) == felt and found["white_noise"] == felt


@pytest.mark.parametrize(
    ("value", "allowed", "beyond"),
    [(0.02, [0.0, 0.02], False), (0.021, [0.0, 0.02], True), (-0.1, [0.0, 0.02], True),
     (True, [True], False), (False, [True], True), ("gyros", ["height"], True), (None, [1, 2], False),
     (3.0, None, False)],
)  # fmt: skip
def test_a_flight_is_of_a_class_within_its_ends(value, allowed, beyond):
    assert bool(differences({"gust_force": value}, {"gust_force": allowed})) == beyond


def test_what_is_beyond_is_said_in_words():
    (text,) = differences({"gust_force": 0.05}, {"gust_force": [0.0, 0.02]})
    assert text == "gust forces per weight 0.05 (0 to 0.02 there)"
    assert differences({"rotor": SimpleNamespace}, {}) == []
