"""Flight plans: multisines by their definition, plans by what physics says must be flown, safety."""

import numpy as np
import pytest

from coax_env import identify, load_vehicle, read_flight, simulate
from coax_env.design import candidates
from coax_env.design.candidates import Envelope
from coax_env.design.flight_plan import multisine_maneuvers, plan_flight, write_plan
from coax_env.errors import InputError
from coax_env.simulation.maneuvers import Maneuver
from coax_env.simulation.multisine import (
    UPDATE,
    harmonics,
    multisines,
    relative_peak_factor,
    steps,
)
from coax_env.simulation.simulate import fly

LAMA = load_vehicle("lama400d")


@pytest.fixture(scope="module", autouse=True)
def each_flown_once():
    """Plans of one vehicle fly the same maneuvers with the same draws of it: for all tests here."""
    tracks = {}

    def flown(vehicle, plan, dt):
        key = (vehicle.vector.tobytes(), repr(plan), dt)
        if key not in tracks:
            tracks[key] = fly(vehicle, plan, dt=dt)
        return tracks[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(candidates, "fly", flown)
        yield


def test_multisines_are_orthogonal_in_time_and_share_no_frequency():
    waves = multisines(4, 10.0)
    gram = waves.T @ waves
    size = np.sqrt(np.diag(gram))
    np.testing.assert_allclose(gram / np.outer(size, size), np.eye(4), atol=1e-9)
    spectra = np.abs(np.fft.rfft(waves, axis=0)) > 1e-6 * len(waves)
    assert np.all(spectra.sum(axis=1) <= 1)
    assert np.all(spectra.sum(axis=0) >= 2)
    frequency = np.fft.rfftfreq(len(waves), UPDATE)[spectra.any(axis=1)]
    assert frequency.min() > 0.19 and frequency.max() < 2.51


def test_phases_keep_the_peak_low():
    """A sum of equal cosines has a peak factor of sqrt(n); an optimised one is near a single sine's."""
    waves = multisines(2, 10.0)
    for wave in waves.T:
        assert relative_peak_factor(wave) < 1.4
    t = np.arange(0.0, 10.0, UPDATE)
    together = np.cos(2 * np.pi * np.outer(t, harmonics(2, 10.0)[0]) / 10.0).sum(axis=1)
    assert relative_peak_factor(together) > 1.9
    assert relative_peak_factor(np.sin(2 * np.pi * t)) == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(np.abs(waves).max(axis=0), 1.0)
    assert np.all(np.abs(waves[[0, -1]]) < 0.6)


def test_a_record_too_short_for_its_inputs_is_refused():
    with pytest.raises(InputError, match="too few"):
        harmonics(4, 2.0)


def test_harmonics_are_all_those_of_the_band_dealt_out_in_turn():
    """Of a record of 10 s, from 0.2 to 2.5 Hz: 2 to 25, each to one input; ends of a band count."""
    dealt = harmonics(3, 10.0)
    assert sorted(np.concatenate(dealt)) == list(range(2, 26))
    assert [list(numbers[:2]) for numbers in dealt] == [[2, 5], [3, 6], [4, 7]]
    assert sorted(np.concatenate(harmonics(2, 7.0, 0.5, 2.0))) == list(range(4, 15))
    assert min(harmonics(1, 2.0, 0.1, 3.0)[0]) == 1  # slower than the record is none
    assert len(np.concatenate(harmonics(2, 2.0, 0.5, 2.0))) == 4  # two each are enough
    with pytest.raises(InputError, match=r"multisine of 2 s has 3 harmonics"):
        harmonics(2, 2.0, 1.0, 2.0)


@pytest.mark.slow
def test_a_history_is_a_sum_of_sines_of_equal_power_that_starts_from_rest():
    """Equal amplitudes at its harmonics and none elsewhere; it begins where it crosses 0 upwards."""
    for wave, numbers in zip(multisines(2, 10.0).T, harmonics(2, 10.0), strict=True):
        power = np.abs(np.fft.rfft(wave)) / len(wave)
        expected = np.zeros_like(power)
        expected[numbers] = power[numbers[0]]
        np.testing.assert_allclose(power, expected, atol=1e-9)
        assert wave[0] > 0.0 >= wave[-1] and wave[0] - wave[-1] < 1.0
    again, other = multisines(2, 10.0), multisines(2, 10.0, seed=5)
    np.testing.assert_array_equal(again, multisines(2, 10.0, seed=0))
    assert other.shape == (round(10.0 / UPDATE), 2)


def test_a_peak_factor_has_no_unit_and_no_offset():
    """Range over 2 sqrt(2) rms: a square wave 1/sqrt(2), a triangle sqrt(3/2)."""
    phase = (np.arange(4000) + 0.5) / 4000
    square, triangle = np.where(phase < 0.5, 1.0, -1.0), np.abs(4.0 * phase - 2.0) - 1.0
    for wave, expected in ((square, 2.0**-0.5), (triangle, 1.5**0.5)):
        assert relative_peak_factor(wave) == pytest.approx(expected, rel=1e-3)
        assert relative_peak_factor(7.0 - 3.0 * wave) == pytest.approx(expected, rel=1e-3)


def test_steps_hold_each_level_for_an_update_and_end_at_nothing():
    wave = np.array([0.5, -1.0, 0.25])
    plan = Maneuver("m", 9.0, "", injected={"delta_lat": steps(wave, 0.04, 2.0)})
    between = 2.0 + UPDATE * (np.arange(-1, 5) + 0.5)
    found = plan.injection(between, np.ones(4))[:, 3]
    np.testing.assert_allclose(found, [0.0, 0.02, -0.04, 0.01, 0.0, 0.0], atol=1e-15)


def test_all_inputs_are_stirred_by_the_multisine():
    for option in multisine_maneuvers():
        flown = fly(LAMA, option, dt=0.02)
        assert not flown.ended and set(option.injected) == {
            "collective", "differential", "delta_lon", "delta_lat",
        }  # fmt: skip
        assert np.all(flown.command.std(axis=0) > 0)


@pytest.mark.slow
def test_what_is_learned_decides_what_is_flown():
    ground = plan_flight(LAMA, ["ground_effect"], runs=1)
    assert ground.runs[0].maneuver.name == "low_hover"
    assert set(ground.wanted) == {"ground_effect.gain", "ground_effect.decay"}
    yaw = plan_flight(LAMA, ["inertia_zz"], runs=1)
    assert "differential" in yaw.runs[0].maneuver.injected


@pytest.mark.slow
def test_the_expected_std_is_what_identification_then_reports(tmp_path):
    """Expected before, found after: fly the plan with noise and identify."""
    plan = plan_flight(LAMA, ["flap_time_constant", "swash_to_flap"], runs=3)
    folder = write_plan(plan, tmp_path / "plan")
    assert len(read_flight(folder).runs) == 3 and (folder / "asked_03.csv").exists()
    flight = simulate(LAMA, [run.maneuver for run in plan.runs], seed=1)
    result = identify(flight, LAMA)
    for name in plan.wanted:
        assert plan.std_after[name] < 0.7 * plan.std_before[name]
        assert result.after[name].std == pytest.approx(plan.std_after[name], rel=0.5), name


@pytest.mark.slow
def test_the_envelope_is_kept_by_every_vehicle_of_the_spread():
    tight = Envelope(tilt=np.radians(6.0), room=3.0)
    plan = plan_flight(LAMA, runs=2, envelope=tight)
    assert len(plan.refused) > 5
    for run in plan.runs:
        assert tight.breach(run.flown) == ""
    with pytest.raises(InputError, match="inside the envelope"):
        plan_flight(LAMA, envelope=Envelope(ceiling=0.5))


def test_an_unknown_name_is_refused_in_words():
    with pytest.raises(InputError, match="nothing called 'lift'"):
        plan_flight(LAMA, ["lift"])
    with pytest.raises(InputError, match="one run at least"):
        plan_flight(LAMA, runs=0)
