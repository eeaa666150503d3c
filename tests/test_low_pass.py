"""Readings behind a sensor's low-pass, taken back through it; how it is found in a flight."""

import math
from types import SimpleNamespace
from typing import Any

import injector
import numpy as np
import pytest
from csv_edits import written_later
from injector_air import GUSTY
from numpy.testing import assert_allclose
from scipy.signal import butter, lfilter
from scipy.stats import multivariate_normal

from coax_env.diagnosis import sensor_low_pass
from coax_env.diagnosis.diagnose import diagnose
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.low_pass import NONE, LowPass, before_low_pass
from coax_env.estimation.state_space import Noise, Record
from coax_env.model.layout import INERTIAL, ROTOR_SPEEDS

STEP = 0.01


def record(t: np.ndarray, p: np.ndarray) -> Record:
    return Record("r", t, np.zeros((t.size, 4)), np.stack([p, np.ones(t.size)], axis=1))


@pytest.mark.parametrize("low_pass", [LowPass(0.008), LowPass(0.007, 2), NONE])
def test_what_a_low_pass_smoothed_comes_back(low_pass):
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.7, 1.3, 300)) * STEP
    true, logged = rng.standard_normal(300), np.zeros(300)
    for k in range(2, 300):
        a, b = low_pass.shares(t[k : k + 1] - t[k - 1])[:, 0]
        logged[k] = a * logged[k - 1] + b * logged[k - 2] + (1.0 - a - b) * true[k]
    found, _ = before_low_pass(record(t, logged), ["p", "h"], {"p": low_pass})
    assert np.isnan(found.z[:2, 0]).all()
    assert_allclose(found.z[2:, 0], true[2:], atol=1e-12)
    assert_allclose(found.z[:, 1], 1.0)


def test_readings_that_are_missing_have_no_part():
    p = lfilter([1.0 - 0.3], [1.0, -0.3], np.random.default_rng(2).standard_normal(50))
    p[10:14] = np.nan
    found, _ = before_low_pass(record(STEP * np.arange(50), p), ["p", "h"], {"p": LowPass(0.008)})
    assert np.array_equal(np.isnan(found.z[2:, 0]), np.isnan(p[2:]))


@pytest.mark.parametrize("low_pass", [LowPass(0.008), LowPass(0.009, 2)])
def test_likelihoods_of_the_readings_as_logged_and_before_agree(low_pass):
    """Of white noise of std 0.7 before it: the density of what was logged, given its first two."""
    a, b = low_pass.shares(np.array([STEP]))[:, 0]
    n = 40
    back = np.eye(n) - a * np.eye(n, k=-1) - b * np.eye(n, k=-2)
    back[:2, :2] = np.eye(2)
    gain = np.diag([1.0, 1.0, *[0.7 * (1.0 - a - b)] * (n - 2)])
    covariance = np.linalg.inv(back) @ gain @ gain @ np.linalg.inv(back).T
    logged = np.linalg.inv(back) @ gain @ np.random.default_rng(3).standard_normal(n)
    whole = multivariate_normal(cov=covariance).logpdf(logged)
    first = multivariate_normal(cov=np.eye(2)).logpdf(logged[:2])
    found, nats = before_low_pass(record(STEP * np.arange(n), logged), ["p", "h"], {"p": low_pass})
    white = multivariate_normal(cov=0.49).logpdf(found.z[2:, 0]).sum()
    assert white + nats == pytest.approx(whole - first, rel=1e-9)


@pytest.mark.parametrize("low_pass", [LowPass(0.008), LowPass(0.009, 2)])
def test_how_much_noise_was_smoothed_away(low_pass):
    a, b = low_pass.shares(np.array([STEP]))[:, 0]
    white = np.random.default_rng(4).standard_normal(400_000)
    logged = lfilter([1.0 - a - b], [1.0, -a, -b], white)
    assert low_pass.noise_before(STEP) * logged.std() == pytest.approx(1.0, rel=0.01)


def test_poles_are_those_of_a_butterworth_low_pass():
    """That SciPy designs at 100 kHz, whose bilinear map then bends nothing, each 1000th step of it."""
    b = LowPass(1.0 / (2.0 * np.pi * 25.0), 2).shares(np.array([STEP]))[:, 0]
    _, a = butter(2, 25.0, fs=1000.0 / STEP)
    poles = np.roots(a) ** 1000
    assert_allclose(b, [poles.sum().real, -np.prod(poles).real], rtol=1e-3)


@pytest.mark.parametrize("low_pass", [LowPass(0.008), LowPass(0.009, 2)])
def test_what_changes_slowly_comes_late_by_its_delay(low_pass):
    """A ramp, in steps of a thousandth of it, once it has settled."""
    step = low_pass.time / 1000.0
    a, b = low_pass.shares(np.array([step]))[:, 0]
    ramp = step * np.arange(20_000)
    logged = lfilter([1.0 - a - b], [1.0, -a, -b], ramp)
    assert ramp[-1] - logged[-1] == pytest.approx(low_pass.delay, rel=2e-3)


@pytest.fixture(scope="module")
def smoothed(tmp_path_factory):
    """**Synthetic**: nothing is hidden, gyros and accelerometers are behind 20 Hz at 1 kHz."""
    folder = tmp_path_factory.mktemp("smooth") / "flight"
    runs = ("lon_3211", "lat_3211", "yaw_3211")
    injector.fly(folder, {}, gusts=GUSTY, sensors="smooth", seed=5, runs=runs, longest=8.0)
    return folder


@pytest.mark.slow
def test_a_low_pass_is_found_and_nothing_is_named(smoothed):
    found = diagnose(smoothed)
    assert found.findings["causes"] == []
    first, late = [line for line in found.remarks if "low-pass" in line]
    assert "forward acceleration" in first and "yaw rate" in first
    assert "3 times as much" in late


def test_the_remark_says_where_it_cuts_off_and_what_is_not_asked():
    passes = dict.fromkeys(("p", "q", "r"), LowPass(1.0 / (2.0 * np.pi * 20.0)))
    said = sensor_low_pass.remark(passes, {"thrust_exponent"})
    assert "roll rate, pitch rate and yaw rate of about 20 Hz (first order)" in said
    assert "thrust exponent" in said
    assert "thrust exponent" not in sensor_low_pass.remark(passes, ())


@pytest.mark.parametrize(
    ("alike", "of_one", "active", "aboard", "asked"),
    [
        (4.1, 0.0, (), INERTIAL, ["p", "ax"]),
        (-1.0, 4.1, (), INERTIAL, ["p", "ax"]),  # signs differ
        (3.9, 3.9, (), INERTIAL, []),
        (3.9, 3.9, ("thrust_exponent", "wind"), INERTIAL, ["ax"]),  # which looks like it
        (3.9, 3.9, ("attitude_delay",), INERTIAL, ["p"]),
        (4.1, 4.1, ("thrust_exponent",), ("h", "q"), ["p"]),  # accelerations are not read
        (4.1, 4.1, ("thrust_exponent", "attitude_delay"), ("h", "phi"), []),
    ],
)
def test_a_low_pass_is_asked_for_where_it_shows_or_what_looks_like_it_is_named(
    monkeypatch, alike, of_one, active, aboard, asked
):
    tried = []

    def likeliest(problem: Any, fit: Fit, noise: Noise, group: Any, found: Any) -> Any:
        tried.append(group[0])
        return NONE, noise

    def correlation(passes: Any, channels: Any, group: Any) -> float:
        return of_one if group == ["q"] else -9.0 if len(group) == 1 else alike

    monkeypatch.setattr(sensor_low_pass, "_alike", correlation)
    monkeypatch.setattr(sensor_low_pass, "likeliest", likeliest)
    monkeypatch.setattr(sensor_low_pass, "_refitted", lambda problem, fit, found: fit)
    problem: Any = SimpleNamespace(
        has_slow_rows=False,
        aboard=frozenset(aboard),
        engine=SimpleNamespace(filter=lambda values, noise: []),
        model=SimpleNamespace(channels=()),
    )
    fit = Fit(active, {}, Noise({}))
    assert sensor_low_pass.low_passes(problem, fit, Noise({})) == {} and tried == asked


def of_stand_ins(
    monkeypatch: pytest.MonkeyPatch,
    engine: Any,
    fit_noise: Any,
    before: Any = lambda record, channels, passes: (passes["p"], 0.0),
) -> Any:
    """A problem with one record, what `before` makes of that and `engine` of this; no fits."""
    monkeypatch.setattr(sensor_low_pass, "before_low_pass", before)
    monkeypatch.setattr(
        sensor_low_pass, "Engine", lambda model, records, threads: engine(records[0])
    )
    monkeypatch.setattr(sensor_low_pass, "fit_noise", fit_noise)
    return SimpleNamespace(
        row=0.01, settings=SETTINGS, noise_fit_seconds=60.0, report=lambda text: None,
        engine=SimpleNamespace(records=["logged"], threads=1),
        model=SimpleNamespace(channels=("p",)),
    )  # fmt: skip


@pytest.mark.parametrize(("from_search", "found"), [(-40.0, True), (-60.0, False)])
def test_a_low_pass_is_worth_what_it_is_at_the_likeliest_levels(monkeypatch, from_search, found):
    """Noise levels are fitted from two starts, which end 50 nats apart without a low-pass: what it is
    worth is the difference of the better ones. The fits are stand-ins."""
    searched, first = Noise({"force_xy": 1.0}, {"p": 0.1}), Noise({"force_xy": 2.0}, {"p": 0.1})
    ends = {("none", 1.0): -50.0, ("none", 2.0): -100.0, ("some", 1.0): from_search + 20.0}

    class Stand(SimpleNamespace):
        def log_likelihood(self, values: Any, noise: Noise) -> float:
            return ends.get((self.kind, noise.level("force_xy")), -70.0)

    def before(record: Any, channels: Any, passes: Any) -> tuple[str, float]:
        return ("none" if set(passes.values()) <= {NONE} else "some"), 0.0

    as_it_is = lambda engine, values, noise, *rest: noise  # noqa: E731
    problem = of_stand_ins(monkeypatch, lambda at: Stand(kind=at), as_it_is, before)
    low_pass, noise = sensor_low_pass.likeliest(problem, Fit((), {}, searched), first, ["p"], {})
    assert (low_pass != NONE) == found
    assert noise.level("force_xy") == (1.0 if found else 2.0)


@pytest.mark.parametrize(("had", "fits"), [(NONE, 8), (LowPass(0.012, 2), 1)])
def test_of_a_low_pass_that_was_found_the_time_alone_is_looked_for_anew(monkeypatch, had, fits):
    """The likelihood is highest at 13 ms; of one that was found the order stays. The first fit begins
    from the search's levels, each other one where the one before it ended."""
    begun: list[float] = []
    order = had.order if had != NONE else 1

    class Stand(SimpleNamespace):
        def log_likelihood(self, values: Any, noise: Noise) -> float:
            low_pass = self.low_pass
            if low_pass == NONE:
                return -1000.0
            wrong = 500.0 * (low_pass.order != order)
            return -wrong - 100.0 * math.log(low_pass.time / 0.013) ** 2

    def fit_noise(engine: Any, values: Any, noise: Noise, *rest: Any) -> Noise:
        begun.append(noise.level("force_xy"))
        return noise.with_levels({"force_xy": noise.level("force_xy") + 1.0})

    problem = of_stand_ins(monkeypatch, lambda at: Stand(low_pass=at), fit_noise)
    levels = Noise({"force_xy": 1.0}, {"p": 0.1})
    fit = Fit((), {}, levels)
    found, _ = sensor_low_pass.likeliest(problem, fit, levels, ["p"], {"p": had})
    assert found.order == order and found.time == pytest.approx(0.013, rel=0.02)
    assert begun[: fits + 1] == [1.0, 1.0, 2.0, 3.0, 4.0, 1.0, 2.0, 3.0, 4.0][: fits + 1]
    assert len(begun) == fits + 2  # without first, and at the likeliest time


def test_no_longer_low_pass_is_tried_once_two_were_worse_than_the_last(monkeypatch):
    """Of first order, from a first that is no better than none; of second order two are better."""
    tried: list[LowPass] = []
    worth = {1: (-1.0, -2.0, 50.0, 60.0), 2: (5.0, 20.0, 19.0, 18.0)}

    def engine(at: LowPass) -> SimpleNamespace:
        k = min(range(4), key=lambda k: abs(sensor_low_pass.TIMES[k] * 0.01 - at.time))
        nats = 0.0 if at == NONE else worth[at.order][k]
        return SimpleNamespace(low_pass=at, log_likelihood=lambda values, noise: nats)

    def fit_noise(at: Any, values: Any, noise: Noise, *rest: Any) -> Noise:
        tried.append(at.low_pass)
        return noise

    problem = of_stand_ins(monkeypatch, engine, fit_noise)
    levels = Noise({"force_xy": 1.0}, {"p": 0.1})
    found, _ = sensor_low_pass.likeliest(problem, Fit((), {}, levels), levels, ["p"], {})
    asked = [(x.order, round(x.time / 0.01, 3)) for x in tried[1:-1]]
    assert tried[0] == NONE and found.order == 2
    assert asked == [(1, 0.4), (1, 0.65), (2, 0.4), (2, 0.65), (2, 1.1), (2, 1.8)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("late", "effects", "names", "said"),
    [
        ("low-pass", {}, [], "low-pass: upper rotor speed and lower rotor speed of about 7 Hz"),
        ("low-pass", {"motor_droop": {}}, ["motor_droop"], "upper rotor speed"),
        ("rows", {}, [], "measured rotor speeds come later than the rotors turn"),
    ],
)
def test_rotor_speeds_that_come_late_are_no_late_motors(tmp_path, late, effects, names, said):
    """Thrust and torque follow at once; the speeds alone, which are read well, come 20 ms late."""
    sensors = "filtered_speeds" if late == "low-pass" else "full"
    folder = injector.fly(
        tmp_path / "flight", effects, gusts=True, sensors=sensors, seed=5, longest=9.0,
        runs=("lon_3211", "heave_3211", "yaw_3211"),
    )  # fmt: skip
    if late == "rows":
        written_later(folder, ROTOR_SPEEDS, 2)
    found = diagnose(folder, hold_out=[])
    assert [cause["effect"] for cause in found.findings["causes"]] == names
    assert found.findings["unexplained"] == []
    assert any(said in remark for remark in found.remarks), found.remarks
