"""Rows whose times are wrong: what that makes of readings, when it is asked for, what is named then."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import injector
import numpy as np
import pytest
from injector_craft import COAX
from injector_sensors import POSE, SENSORS

from coax_env import diagnose
from coax_env.diagnosis import clock_errors as asking
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.clock_errors import rates, with_clock_error
from coax_env.estimation.state_space import Noise, Record, part
from coax_env.model.layout import CHANNELS

PLACE = {channel: CHANNELS.index(channel) for channel in CHANNELS}
STEP = 0.01


def flown(wrong: float = 0.0, seed: int = 0, every: int = 1) -> Record:
    """A dash back and forth at up to 3 m/s while turning on; rows at times that are off by so much."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(2000)
    read_at = t + wrong * rng.standard_normal(t.size)
    z = np.full((t.size, len(CHANNELS)), np.nan)
    z[:, PLACE["pn"]] = 2.0 * np.sin(1.5 * read_at)
    z[:, PLACE["psi"]] = (1.2 * read_at + np.pi) % (2.0 * np.pi) - np.pi
    z[:, PLACE["r"]] = 1.2 + 0.5 * np.sin(9.0 * read_at)
    z[np.arange(t.size) % every != 0, PLACE["pn"]] = np.nan
    return Record("dash", t, np.zeros((t.size, 4)), z)


@pytest.mark.parametrize("every", [1, 5])
def test_rates_are_those_of_the_motion(every):
    """Angles over a turn too; of a gyro none, whose rate is no motion; where nothing is read none."""
    record = flown(every=every)
    found, t = rates(record), record.t
    there = np.flatnonzero(np.isfinite(record.z[:, PLACE["pn"]]))[3:-3]
    np.testing.assert_allclose(found[there, PLACE["pn"]], 3.0 * np.cos(1.5 * t[there]), atol=0.02)
    np.testing.assert_allclose(found[3:-3, PLACE["psi"]], 1.2, rtol=1e-9)
    others = np.setdiff1d(np.arange(len(CHANNELS)), [PLACE["pn"], PLACE["psi"]])
    assert not found[:, others].any()
    assert not found[~np.isfinite(record.z[:, PLACE["pn"]]), PLACE["pn"]].any()


def test_the_variance_is_that_of_readings_at_clock_errors():
    """In a dash and at its ends, where the machine turns and stands: over 400 flights."""
    off = np.array([flown(2e-3, seed).z - flown().z for seed in range(400)])[:, :, PLACE["pn"]]
    (record,) = with_clock_error([flown()], 2e-3)
    assert record.blur is not None
    blur = record.blur[:, PLACE["pn"]]
    fast = blur > 0.5 * blur.max()
    assert np.mean(off[:, fast] ** 2 / blur[fast]) == pytest.approx(1.0, abs=0.02)
    assert (
        blur.max() == pytest.approx((2e-3 * 3.0) ** 2, rel=0.02) and blur.min() < 1e-3 * blur.max()
    )
    rows = np.arange(100, 300)
    np.testing.assert_array_equal(part(record, rows).blur, record.blur[rows])
    assert with_clock_error([record], 0.0)[0].blur is None


@pytest.mark.parametrize(
    ("before", "after", "gain", "used"),
    [
        (0.3, 0.1, 100.0, True),
        (0.0, 0.0, 100.0, False),  # nothing to explain
        (0.3, 0.25, 100.0, False),  # nor does it explain that
        (0.3, 0.1, 10.0, False),  # not worth the threshold
    ],
)
def test_clock_errors_are_asked_for_where_they_explain_the_colour(
    monkeypatch, before, after, gain, used
):
    """The likelihood is a parabola about 1.5 ms; whether readings are white is a stand-in."""

    def problem_with(std: float) -> SimpleNamespace:
        away = (np.log(max(std, 1e-9)) - np.log(1.5e-3)) ** 2
        engine = SimpleNamespace(
            log_likelihood=lambda values, noise: -50.0 * away, filter=lambda values, noise: std
        )
        return SimpleNamespace(
            engine=engine, clock_error=std, settings=SETTINGS, report=lambda text: None,
            with_clock_error=problem_with, model=SimpleNamespace(channels=CHANNELS),
        )  # fmt: skip

    def judged(std: float, channels: Sequence[str]) -> dict[str, SimpleNamespace]:
        share = after if std else before
        moves = SimpleNamespace(white=share < 0.04, coloured_share=share)
        return {"pn": moves, "p": SimpleNamespace(white=False, coloured_share=0.9)}

    monkeypatch.setattr(asking, "whiteness", judged)
    monkeypatch.setattr(asking, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(asking, "fitted", lambda problem, fit: replace(fit, objective=500.0 - gain))
    fit = Fit((), {}, Noise({}), objective=500.0)
    found = asking.with_clock_errors(problem_with(0.0), fit)
    assert (found is not None) == used
    if found is not None:
        assert found.clock_error == pytest.approx(1.5e-3, rel=0.15)
    assert asking.with_clock_errors(problem_with(1e-3), fit) is None  # known already


@pytest.mark.slow
def test_nothing_is_named_where_rows_are_smoothed_as_though_even(tmp_path, monkeypatch):
    """Rows 12 % of a step off, taken as even by what smooths them: positions half foreseen without."""
    uneven = SENSORS["pose_steadied"]._replace(noise=POSE, step=1.0 / 60.0, unrest=0.12)
    monkeypatch.setitem(SENSORS, "uneven", uneven)
    runs = ("lon_3211", "lat_3211", "yaw_3211")
    injector.fly(
        tmp_path, {}, gusts=True, sensors="uneven", seed=3, runs=runs, longest=14.0, craft=COAX
    )
    found = diagnose(tmp_path)
    assert found.findings["causes"] == []
    assert all(found.whiteness["after"][c].coloured_share < 0.2 for c in ("pn", "pe"))
    said = [
        line for line in found.remarks if line.startswith("the times of the log's rows are wrong")
    ]
    assert len(said) == 1 and 0.5 < float(said[0].split(" by ")[1].split()[0]) < 3.0  # ms
