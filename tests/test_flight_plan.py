"""Flight plans: multisines by their definition, plans by what physics says must be flown, safety."""

import numpy as np
import pytest

from coax_env import identify, load_vehicle, read_flight, simulate
from coax_env.design.candidates import Envelope
from coax_env.design.flight_plan import multisine_maneuvers, plan_flight, write_plan
from coax_env.errors import InputError
from coax_env.simulation.multisine import UPDATE, harmonics, multisines, relative_peak_factor
from coax_env.simulation.simulate import fly

LAMA = load_vehicle("lama400d")


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
