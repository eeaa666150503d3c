"""What is known of an effect's other numbers beside one of unusual size."""

from types import SimpleNamespace

import numpy as np
import pytest

from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.large_numbers import beside_large_axes, less_sure_beside_large_numbers
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.quadratic import Linearised, Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.model.vehicle_file import load_vehicle

LAMA = load_vehicle("lama400d")


def problem_with(own: dict[str, tuple[FreeParameter, ...]]) -> Problem:
    """Effects with their numbers, on no flight."""
    engine = SimpleNamespace(records=[])
    model = SimpleNamespace(bare_values={}, moments={})
    return Problem(model, engine, (), own)  # type: ignore[arg-type]


def test_beside_a_large_axis_the_others_are_as_wide():
    model = HeliModel(LAMA)
    own = {e: tuple(model.effect_parameters(e)) for e in ("gyro_bias", "ground_effect")}
    usual = {f.name: f.std for group in own.values() for f in group}
    problem = problem_with(own)
    values = {f.name: f.value for group in own.values() for f in group}
    values["gyro_bias.x"] = 4.0 * usual["gyro_bias.x"]
    wider = beside_large_axes(problem, Fit(tuple(own), values, Noise({})))
    for f in (*wider.own["gyro_bias"], *wider.own["ground_effect"]):
        factor = 4.0 if f.name.startswith("gyro_bias") else 1.0
        assert f.std == pytest.approx(factor * usual[f.name]), f.name
    values["gyro_bias.x"] = 2.0 * usual["gyro_bias.x"]
    same = beside_large_axes(problem, Fit(tuple(own), values, Noise({})))
    assert same.own == problem.own


@pytest.mark.parametrize(
    ("size", "told", "factor"), [(4.0, 0.0, 4.0), (4.0, 1e6, 1.0), (2.0, 0.0, 1.0)]
)
def test_beside_a_large_number_those_of_other_units_may_be_as_large(size, told, factor):
    """A swash phase's angle is known; its change with rotor speed as the flights tell it, or not.

    told: the data's information on it as a multiple of its prior's.
    """
    effect, names = "swash_phase", ("swash_phase.angle", "swash_phase.per_rpm")
    parameters = tuple(HeliModel(LAMA).effect_parameters(effect))
    usual = {f.name: f.std for f in parameters}
    problem = problem_with({effect: parameters})
    assert (
        beside_large_axes(problem, Fit((effect,), dict.fromkeys(names, 1e3), Noise({}))) == problem
    )
    information = np.diag([1e6 / usual[names[0]] ** 2, told / usual[names[1]] ** 2])
    values = {names[0]: size * usual[names[0]], names[1]: 0.0}
    slope = np.zeros((1, 2))  # of the data: it is at their best
    lin = Linearised(names, information[None], slope, np.zeros((1, 1, 2)), np.zeros((4, 2)))
    quadratic = Quadratic.of(lin, problem.parameters, values)
    fit = Fit((effect,), values, Noise({}))
    weighed = {effect: Evidence(100.0, 1.0)}
    wider = less_sure_beside_large_numbers(problem, fit, quadratic, weighed)
    std = quadratic.std(names)
    assert wider.spread(names[1], std[names[1]], 1.0) == pytest.approx(
        factor * std[names[1]], rel=1e-3
    )
    assert wider.spread(names[0], std[names[0]], 1.0) == pytest.approx(std[names[0]], rel=1e-2)
    assert wider.values == values
