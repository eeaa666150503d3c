"""The injector itself: it shares nothing with the package, flies, and hides what it says."""

import ast
import json
import math
from pathlib import Path

import injector
import numpy as np
import pytest
from shared_flights import shared_flight

import coax_env
from coax_env.logs.flight import read_flight


def test_it_shares_no_code_with_the_package() -> None:
    tree = ast.parse(Path(injector.__file__).read_text())
    modules = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import)
               for alias in node.names}  # fmt: skip
    modules |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not [name for name in modules if name.split(".")[0] == "coax_env"]


def test_bare_physics_are_the_packages_at_random_states() -> None:
    """Quaternion, hub forces and inertial velocity against eqs (26)-(44) in body axes."""
    rng = np.random.default_rng(4)
    vehicle = coax_env.load_vehicle("lama400d")
    for _ in range(50):
        state = rng.normal(0, 1, 16) * [2, 2, 2, 1, 1, 1, *[0.1] * 4, 0.4, 0.4, 2, 1, 1, 0.3]
        state[15] -= 5.0
        command = np.array([*rng.uniform(180, 250, 2), *rng.normal(0, 0.05, 2)])
        phi, theta, psi = state[10:13]
        half = [
            np.array([math.cos(angle / 2), *(math.sin(angle / 2) * np.eye(3)[axis])])
            for axis, angle in ((2, psi), (1, theta), (0, phi))
        ]
        s = np.zeros(injector.N_STATE)
        s[0:3] = state[13:16]
        s[6:10] = _product(_product(half[0], half[1]), half[2])
        R = injector._rotation(s)
        s[3:6] = R @ state[0:3]
        s[10:13] = state[3:6]
        s[13:17] = state[6:10]
        s[17:21] = command
        ds = injector._derivative(s, command, np.zeros(6), injector.Hidden(), np.zeros(6))
        expected = coax_env.derivative(state, command, vehicle)
        body_acceleration = R.T @ ds[3:6] - np.cross(state[3:6], state[0:3])
        np.testing.assert_allclose(body_acceleration, expected[0:3], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ds[10:13], expected[3:6], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ds[13:17], expected[6:10], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ds[0:3], expected[13:16], rtol=1e-9, atol=1e-9)
        h = 1e-6
        turn = injector._euler(injector._rotation(s + h * ds)) - injector._euler(
            injector._rotation(s - h * ds)
        )
        np.testing.assert_allclose(turn / (2 * h), expected[10:13], rtol=1e-5, atol=1e-6)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion product."""
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:]
                                                   + np.cross(a[1:], b[1:]))])  # fmt: skip


@pytest.mark.slow
@pytest.mark.needs_shared_flights
def test_a_flight_of_it_looks_like_open_none(tmp_path: Path) -> None:
    """Same noise reading to reading, and the same order of motion."""
    ours = read_flight(injector.fly(tmp_path / "none", {}, seed=3))
    theirs = read_flight(shared_flight("open_none"))
    assert ours.run_names == theirs.run_names
    assert ours.channels == theirs.channels
    assert (ours.air, ours.noise) == (theirs.air, theirs.noise)
    for name in ours.run_names:
        for channel in ours.channels:
            a, b = ours.run(name).measured[channel], theirs.run(name).measured[channel]
            jitter = np.median(abs(np.diff(a, 2))) / np.median(abs(np.diff(b, 2)))
            assert jitter == pytest.approx(1.0, abs=0.2), (name, channel)
        assert ours.run(name).measured["h"].min() > -0.1
        assert 0.3 < ours.run(name).command[:, 2].std() / theirs.run(name).command[:, 2].std() < 3


@pytest.mark.parametrize("effect", injector.EFFECTS)
def test_every_effect_can_be_flown_with(tmp_path: Path, effect: str) -> None:
    flight = read_flight(
        injector.fly(tmp_path, {effect: {}}, runs=["lon_doublet", "yaw_3211", "heading_turn"])
    )
    for run in flight.runs:
        assert np.nanmax(abs(run.measured["theta"])) < 0.4
        assert 0.8 < np.nanmedian(run.measured["h"]) < 2.5
    assert json.loads((tmp_path / "truth.json").read_text())["hidden"] == [effect]


def test_gusts_sensors_and_dropouts(tmp_path: Path) -> None:
    folder = injector.fly(
        tmp_path, {"rotor_drag": 5e-4, "wind": {"north": 1.0}}, gusts=True, sensors="onboard",
        lost_echoes=True, radio_gaps=True, seed=2,
    )  # fmt: skip
    flight = read_flight(folder)
    assert flight.counts["outliers in h removed"] > 0
    assert flight.counts["gaps of more than 0.1 s without any reading"] > 0
    hover = flight.run("hover")
    share = {c: np.mean(~np.isnan(hover.measured[c])) for c in ("p", "theta", "h", "vn")}
    assert share == pytest.approx({"p": 0.98, "theta": 0.49, "h": 0.195, "vn": 0.098}, abs=0.02)
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["values"] == {
        "rotor_drag.coefficient": 5e-4, "wind.north": 1.0, "wind.east": 0.0,
    }  # fmt: skip


def test_same_seed_same_flight(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        injector.fly(tmp_path / name, {}, gusts=True, seed=seed, runs=["lat_3211"])
    a, b, c = ((tmp_path / name / "lat_3211.csv").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_what_is_not_in_the_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyError):
        injector.fly(tmp_path, {"gremlins": {}})
    with pytest.raises(KeyError):
        injector.fly(tmp_path, {"wind": {"up": 1.0}})
