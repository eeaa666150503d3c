"""Maximum likelihood identification: planted numbers come back, and what cannot is said."""

from dataclasses import replace
from types import SimpleNamespace

import injector
import numpy as np
import pytest
from injector_craft import CRAFTS
from scipy.stats import chi2

from coax_env import identify, load_vehicle, simulate
from coax_env.errors import InputError
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.prediction import pooled_rms, replay_runs
from coax_env.estimation.state_space import FreeParameter
from coax_env.identification.identify import _at_limits

LAMA = load_vehicle("lama400d")
AXES = ("lon_3211", "lat_3211", "heave_3211", "yaw_3211")
NAMES = [f.name for f in HeliModel(LAMA).base_parameters()]


def off_by(factors):
    """The Lama's file with values wrong by factors, std as they were."""
    return LAMA.with_values({n: f * LAMA[n].value for n, f in zip(NAMES, factors, strict=True)})


@pytest.fixture(scope="module")
def flight():
    return simulate(LAMA, AXES, seed=4)


@pytest.mark.slow
@pytest.mark.parametrize("factors", ["up", "down", "mixed"])
def test_from_a_file_with_every_number_a_fifth_off(flight, factors):
    """Determined numbers come back within 3 std, the others are named, prediction is as good."""
    rng = np.random.default_rng(0)
    wrong = {"up": [1.2] * len(NAMES), "down": [0.8] * len(NAMES),
             "mixed": 1.0 + 0.2 * rng.choice([-1, 1], len(NAMES))}[factors]  # fmt: skip
    result = identify(flight, off_by(wrong))
    assert result.widened > 2.0
    assert any("times as wide" in remark for remark in result.remarks)
    determined = set(NAMES) - set(result.undetermined)
    assert {"flap_time_constant", "flybar_time_constant", "swash_to_flap"} <= determined
    assert {"mass", "thrust_coefficient_upper"} <= set(result.undetermined)
    for name in determined:
        new = result.after[name]
        assert abs(new.value - LAMA[name].value) < 3.0 * new.std < 0.45 * LAMA[name].value, name
    assert result.directions
    ratio = result.after["thrust_coefficient_upper"].value / result.after["mass"].value
    exact = LAMA["thrust_coefficient_upper"].value / LAMA["mass"].value
    assert ratio == pytest.approx(exact, rel=0.01)
    predicted = pooled_rms(result.replay_after)
    engine = _engine(flight)
    best = pooled_rms(replay_runs(engine, HeliModel(LAMA).bare_values, result.noise))
    for channel, rms in predicted.items():
        assert rms < 1.1 * best[channel], channel  # four runs; twelve give 1.05


@pytest.mark.slow
def test_numbers_are_unsure_where_the_pilot_flies_the_gusts_out(tmp_path):
    """By a camera, rows 30 ms apart, in closed loop by other code. By the readings alone each flight
    has a number, an inertia or the flaps', more than 2 std off (up to 5 on longer ones)."""
    worst = []
    for seed in (1, 2, 3):
        folder = injector.fly(
            tmp_path / str(seed), {}, gusts=True, sensors="camera", craft=CRAFTS["coax"],
            runs=(*AXES, "heading_turn"), longest=9.0, seed=seed,
        )  # fmt: skip
        (folder / "truth.json").unlink()
        result = identify(folder)
        off = {n: abs(result.after[n].value - result.before[n].value) for n in result.fitted}
        assert all(off[n] < 2.0 * result.after[n].std for n in off)
        assert any(result.after[n].std < 0.5 * result.before[n].std for n in off)
        assert any("the commands answer gusts" in remark for remark in result.remarks)
        worst.append(max(off[n] / result.estimate.std[n] for n in off))
    assert min(worst) > 2.0


def _engine(flight):
    from coax_env.estimation.engine import Engine
    from coax_env.estimation.helicopter import record_of

    return Engine(HeliModel(LAMA), [record_of(run) for run in flight.runs])


@pytest.mark.slow
def test_a_model_that_lacks_something_keeps_the_files_priors():
    """A delay that the file does not have must not be paid for by its inertias."""
    lagging = LAMA.with_effect("servo_delay", time=0.1)
    result = identify(simulate(lagging, ("lon_3211", "lat_3211"), seed=1), LAMA)
    assert result.widened == 1.0
    assert any("lacks something" in remark for remark in result.remarks)


@pytest.mark.slow
def test_runs_of_one_vehicle_agree_and_a_strange_one_stands_out(flight):
    same = identify(flight, LAMA)
    for run in same.by_run:
        assert run.degrees == 0 or chi2.sf(run.chi_square, run.degrees) > 1e-4, run.run
    loaded = LAMA.with_values({"inertia_yy": 1.25 * LAMA["inertia_yy"].value})
    strange = replace(simulate(loaded, "lon_3211", seed=2).runs[0], name="strange")
    more = simulate(LAMA, ("lon_doublet", "lat_doublet"), seed=5)
    mixed = identify(replace(flight, runs=(*flight.runs, *more.runs, strange)), LAMA)
    worst = max(mixed.by_run, key=lambda run: run.chi_square - run.degrees)
    assert worst.run == "strange"
    assert chi2.sf(worst.chi_square, worst.degrees) < 1e-3


def test_channels_are_chosen(flight):
    chosen = ("p", "q", "r", "phi", "theta", "psi", "rpm_upper", "rpm_lower")
    few = identify(flight.select(["lon_3211"]), LAMA, channels=chosen)
    assert few.flight.channels == tuple(c for c in flight.channels if c in chosen)
    for bad, words in ((("lift",), "no channel 'lift'"), ((), "no channel is left")):
        with pytest.raises(InputError, match=words):
            identify(flight, LAMA, channels=bad)


@pytest.mark.slow
def test_held_out_runs_are_flown_again_and_not_fitted(flight):
    result = identify(flight, LAMA, hold_out=["yaw_3211"])
    assert [run.name for run in result.replay_after] == ["yaw_3211"]
    assert "yaw_3211" not in [run.run for run in result.by_run]
    with pytest.raises(InputError, match="all runs are held out"):
        identify(flight, LAMA, hold_out=flight.run_names)


@pytest.mark.slow
def test_sensor_biases_are_fitted_on_request():
    biased = LAMA.with_effect("gyro_bias", x=0.02, y=-0.03, z=0.01)
    result = identify(simulate(biased, ("lon_3211", "hover"), seed=3), LAMA, also=["gyro_bias"])
    for name, value in (("gyro_bias.x", 0.02), ("gyro_bias.y", -0.03), ("gyro_bias.z", 0.01)):
        assert abs(result.after[name].value - value) < 3.5 * result.after[name].std
        assert result.after[name].std < 0.002
    with pytest.raises(InputError, match="no effect 'bias'"):
        identify(simulate(LAMA, "hover"), LAMA, also=["bias"])


@pytest.mark.parametrize(
    ("mass", "gain", "words"),
    [
        (2.9, 0.5, ""),
        (3.0, 0.5, "mass stands at a limit"),
        (0.303, 1.0, "mass and swash gain gain stand at a limit"),
        (1.0, 0.0, ""),  # none of an effect that may be none
    ],
)
def test_what_stands_at_a_limit_is_said(mass, gain, words):
    free = [
        FreeParameter("mass", 1.0, 0.1, lower=0.3, upper=3.0),
        FreeParameter("swash_gain.gain", 0.0, 0.2, lower=0.0, upper=1.0),
    ]
    values = {"mass": mass, "swash_gain.gain": gain}
    found = SimpleNamespace(free=free, estimate=SimpleNamespace(values=values))
    said = _at_limits(found)  # type: ignore[arg-type]
    assert [line.startswith(words) for line in said] == ([True] if words else [])
