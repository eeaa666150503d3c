"""A vehicle with fitted numbers: what is written into its file, from a covariance that is known."""

import numpy as np
import pytest

from coax_env.diagnosis.findings import stated_std
from coax_env.diagnosis.problem import Fit
from coax_env.estimation.fitted_vehicle import fitted_vehicle, median_step, with_timing
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.state_space import FreeParameter, Noise, Record
from coax_env.logs.flight import Flight
from coax_env.model.vehicle_file import load_vehicle

LAMA = load_vehicle("lama400d")
FLIGHT = Flight("lama400d", ())


def test_values_std_and_correlation_are_those_of_the_fit():
    """Also for an effect that the vehicle did not have; the std may be wider than the covariance's."""
    free = [f for f in HeliModel(LAMA).base_parameters() if f.name in ("mass", "inertia_zz")]
    free += HeliModel(LAMA).effect_parameters("rotor_drag")
    spread = np.array([0.01, 2e-4, 3e-5])
    correlation = np.array([[1.0, 0.3, -0.6], [0.3, 1.0, 0.2], [-0.6, 0.2, 1.0]])
    covariance = correlation * np.outer(spread, spread)
    values = {f.name: 1.1 * LAMA.values().get(f.name, 3e-4) for f in free}
    std = dict(zip(values, (2.0 * spread).tolist(), strict=True))
    after = fitted_vehicle(LAMA, free, values, std, covariance, "a fit", FLIGHT)
    assert after.correlated == tuple(values)
    np.testing.assert_allclose(after.correlation, correlation, atol=1e-12)
    for name in values:
        group, _, own = name.rpartition(".")
        number = after.effects[group][own] if group else after[name]
        assert (number.value, number.std) == pytest.approx((values[name], std[name]))
        assert number.source == "a fit"
    assert after["arm_upper"] == LAMA["arm_upper"]


def test_a_lag_is_not_known_better_than_a_uniform_half_row():
    """Variance of a uniform distribution over a row: dt^2 / 12; other numbers keep their std."""
    lag = FreeParameter("servo_delay.time", 0.0, 0.02)
    assert with_timing(lag, 3e-3, 0.012) == pytest.approx(np.sqrt(9e-6 + 0.012**2 / 12.0))
    assert with_timing(FreeParameter("mass", 0.8, 0.01), 3e-3, 0.012) == 3e-3


def test_the_usual_step_is_the_median_over_all_runs():
    def record(dt: float, n: int) -> Record:
        return Record("run", dt * np.arange(n), np.zeros((n, 4)), np.zeros((n, 1)))

    assert median_step([record(0.01, 50), record(0.04, 20)]) == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("battery_sag.rate", 0.002, np.hypot(3e-6, 2e-5)),  # no form is right to better than 1 %
        ("gyro_bias.x", 1e-4, np.hypot(3e-6, 1e-6)),
        ("mass", 0.8, 3e-6),  # the vehicle's own are what they are
    ],
)
def test_an_effects_number_is_as_unsure_as_its_form(name, value, expected):
    fit = Fit((), {name: value}, Noise({}))
    assert stated_std(fit, FreeParameter(name, 0.0, 1.0), 3e-6, 1.0, 0.01) == pytest.approx(expected)
