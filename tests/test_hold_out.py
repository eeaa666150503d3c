"""Which runs are held out, from information that is given by hand: nothing else may decide."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env import InputError, load_vehicle
from coax_env.diagnosis import hold_out
from coax_env.diagnosis.hold_out import check_hold_out, fair_part, split
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.state_space import Noise, Record

MODEL = HeliModel(load_vehicle("lama400d"))


def records(count: int, seconds: float = 6.0, start: float = 20.0) -> list[Record]:
    t = start + 0.01 * np.arange(round(seconds / 0.01) + 1)
    return [
        Record(f"run {k}", t, np.full((t.size, 4), float(k)), np.zeros((t.size, 18)), start)
        for k in range(count)
    ]


def held(information: list[list[float]]) -> list[int]:
    """Runs held out where each, of one length, has so much information on each effect."""
    table = np.array(information)
    n, k = table.shape
    return fair_part(table / table.sum(axis=0), np.ones(k), np.full(n, 1.0 / n))


def test_a_quarter_of_the_information_on_each_effect_is_held_out():
    """Two of eight runs whose shares add up to a quarter of either effect's, and no other two."""
    thin = [[1.0, 40.0], [40.0, 1.0], [1.0, 1.0], [1.0, 1.0], [1.0, 1.0], [1.0, 2.0]]
    fair = [[15.0, 9.0], [1.0, 7.0]]  # of 61 and 62
    assert held([*thin[:3], fair[0], *thin[3:], fair[1]]) == [3, 7]


def test_the_only_run_that_shows_an_effect_is_fitted():
    """Run 2 has a fair share of the one effect, but all of the other: it stays."""
    assert 2 not in held([[25.0, 0.0], [25.0, 0.0], [25.0, 100.0], [25.0, 0.0]])
    # a run with three quarters stays too: one with an eighth is held out
    assert held([[5.0], [75.0], [12.0], [8.0]]) == [2]


def test_an_effect_that_could_not_be_measured_is_held_out_rather_than_an_even_share():
    """Runs with a twentieth of the one effect are passed over for one with half of it."""
    assert held([[50.0, 20.0], [40.0, 40.0], [5.0, 25.0], [5.0, 15.0]])[0] in (0, 1)


def test_of_few_runs_the_last_third_of_each_is_held_out():
    """Split at two thirds of their own time, wherever the clock starts; every row once. A third that is
    too short for a second of prediction is fitted, too."""
    some, short = records(3, seconds=9.0), records(4, seconds=6.6)[3:]
    fit, out = split(
        MODEL, [*some, *short], Noise({}), None, ("gyro_bias",), replace(SETTINGS, fewest_runs=5)
    )
    assert [r.name for r in fit] == ["run 3", "run 0", "run 1", "run 2"] and fit[0] is short[0]
    assert [r.name for r in out] == [f"run {k} (last third)" for k in range(3)]
    fit, out = split(MODEL, some, Noise({}), None, ("gyro_bias",), SETTINGS)
    assert [r.name for r in fit] == ["run 0", "run 1", "run 2"]
    assert [r.name for r in out] == [f"run {k} (last third)" for k in range(3)]
    for whole, first, last in zip(some, fit, out, strict=True):
        np.testing.assert_array_equal(np.concatenate([first.t, last.t]), whole.t)
        assert last.t[0] == pytest.approx(26.0, abs=0.011)
        assert first.command.shape[0] == first.t.size and last.z.shape[0] == last.t.size
        assert first.origin == last.origin == whole.origin


def test_runs_that_are_named_are_held_out_and_not_all_may_be():
    fit, out = split(MODEL, records(5), Noise({}), ["run 1", "run 4"], (), SETTINGS)
    assert [r.name for r in fit] == ["run 0", "run 2", "run 3"]
    assert [r.name for r in out] == ["run 1", "run 4"]
    fit, out = split(MODEL, records(2), Noise({}), [], (), SETTINGS)
    assert len(fit) == 2 and out == []
    check_hold_out(["a"], ["a", "b"])
    check_hold_out(None, ["a"])
    with pytest.raises(InputError, match="nothing is left"):
        check_hold_out(["b", "a"], ["a", "b"])


class Told:
    """Stands for the engine: each run's information on one effect's numbers, whatever was flown."""

    table: np.ndarray

    def __init__(self, model: Any, records: list[Record]) -> None:
        self.records = records

    def linearise(self, values: Any, noise: Noise, free: Any) -> tuple[list[Any], Any]:
        own = self.table[[int(r.whole.split()[-1]) for r in self.records]]
        information = np.array([row * np.eye(len(free)) for row in own])
        return [], SimpleNamespace(information=information)


@pytest.mark.parametrize("clock", [0.0, 900.0])
def test_a_run_that_is_more_than_a_third_of_the_time_is_fitted(monkeypatch, clock):
    """However fair its information: the next fair one is held out, whatever the clocks say."""
    model = SimpleNamespace(
        effect_parameters=MODEL.effect_parameters, bare_values=MODEL.bare_values
    )  # fmt: skip
    monkeypatch.setattr(hold_out, "Engine", Told)
    monkeypatch.setattr(hold_out, "excitation", lambda model, values, passes: {})
    monkeypatch.setattr(Told, "table", np.array([25.0, 22.0, 23.0, 30.0]), raising=False)
    some = [records(1, seconds, start)[0] for seconds, start in
            ((9.0, clock), (5.0, 20.0), (5.0, clock), (5.0, 20.0))]  # fmt: skip
    named = [replace(r, name=f"run {k}") for k, r in enumerate(some)]
    _, out = split(model, named, Noise({}), None, ("gyro_bias",), SETTINGS)  # type: ignore[arg-type]
    assert [r.name for r in out] == ["run 2"], "of 24 s a third are 8"
    short = [replace(r, name=f"run {k}") for k, r in enumerate(records(4))]
    _, out = split(model, short, Noise({}), None, ("gyro_bias",), SETTINGS)  # type: ignore[arg-type]
    assert [r.name for r in out] == ["run 0"]


def test_shares_are_those_of_every_number_and_effects_count_alike():
    """Each group's columns share one weight; what no run shows is no column."""
    groups = [np.array([[1.0, 0.0, 2.0], [3.0, 0.0, 6.0]]), np.array([[5.0], [5.0]])]
    shares, weights = hold_out._shares(groups)
    np.testing.assert_allclose(shares, [[0.25, 0.25, 0.5], [0.75, 0.75, 0.5]])
    np.testing.assert_allclose(weights, [0.5, 0.5, 1.0])
    nothing, none = hold_out._shares([np.zeros((2, 3)), groups[1]])
    assert nothing.shape == (2, 1) and none.tolist() == [1.0]
