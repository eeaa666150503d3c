"""The engine on a pendulum: it knows no helicopter, and its answers are known without it.

Truth is simulated here in numpy; likelihoods are compared with the stacked Gaussian of the whole
record, signatures with differences of the innovations, fits with what was planted.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from numba import types
from scipy.optimize import lsq_linear
from scipy.signal import lfilter
from scipy.stats import binom, multivariate_normal

from coax_env.estimation import transition
from coax_env.estimation.engine import Engine, Estimate
from coax_env.estimation.noise_levels import fit_noise
from coax_env.estimation.quadratic import Linearised, Quadratic, bounded_solve
from coax_env.estimation.run_passes import REFRESH, Buffers, RunPass
from coax_env.estimation.sparse import padded, with_places
from coax_env.estimation.state_space import FreeParameter, Noise, ProcessNoise, Record
from coax_env.estimation.whiteness import whiteness
from coax_env.kernel.angles import wrap_angle, wrap_angles
from coax_env.kernel.compilation import pointer

# --- a pendulum with a motor: state angle, rate; input a torque; read by an encoder and two gyros --

ANGLE, RATE = 0, 1
STIFFNESS, DAMPING, SINE, BIAS = 0, 1, 2, 3  # 1/s2, 1/s, 1: sin(angle) instead of angle, rad/s
CHANNELS = ("angle", "gyro", "second gyro")
DT = 0.02
TRUTH = {"stiffness": 9.0, "damping": 0.6, "sine": 0.0, "bias": 0.0}
NOISE = Noise(
    process={"torque": 0.3}, reading={"angle": 0.03, "gyro": 0.1, "second gyro": 0.2},
    floor={"torque": 1e-3},
)  # fmt: skip

_A = types.float64[::1]


@pointer(types.void(_A, _A, types.float64, _A, _A, _A))
def _step(x, u, dt, p, work, out):
    """One symplectic Euler step: linear in the state where `sine` is 0."""
    pull = (1.0 - p[SINE]) * x[ANGLE] + p[SINE] * math.sin(x[ANGLE])
    rate = x[RATE] + dt * (u[0] - p[STIFFNESS] * pull - p[DAMPING] * x[RATE])
    out[RATE] = rate
    out[ANGLE] = x[ANGLE] + dt * rate


@pointer(types.void(_A, _A, _A, _A, _A))
def _measure(x, u, p, work, out):
    out[0] = x[ANGLE]
    out[1] = x[RATE] + p[BIAS]
    out[2] = x[RATE]


@pointer(types.void(_A, _A, types.float64, _A, _A, _A))
def _drift_and_readings(x, u, dt, p, work, out):
    pull = (1.0 - p[SINE]) * x[ANGLE] + p[SINE] * math.sin(x[ANGLE])
    out[RATE] = dt * (u[0] - p[STIFFNESS] * pull - p[DAMPING] * x[RATE])
    out[ANGLE] = dt * (x[RATE] + out[RATE])
    out[2] = x[ANGLE]
    out[3] = x[RATE] + p[BIAS]
    out[4] = x[RATE]


class Pendulum:
    """The model, through the engine's protocol."""

    channels = CHANNELS
    wraps = np.array([True, False, False])
    state_scale = np.array([1e-4, 1e-4])
    step = _step
    measure = _measure
    drift_and_readings = _drift_and_readings
    exact = np.array([True, True])
    work_size = 1
    noise_places = np.array([[0, 0], [1, 1]])
    start_at = np.array([0.2, 0.0])
    start_std = np.array([0.3, 0.5])

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        return np.array([{**TRUTH, **values}[name] for name in TRUTH])

    def inputs(self, record: Record, vector: np.ndarray) -> np.ndarray:
        changes = np.diff(record.command, axis=0, append=record.command[-1:])
        return record.command + record.of_next * changes

    def between(self, record: Record, vector: np.ndarray) -> np.ndarray:
        return record.between * np.diff(record.command, axis=0, append=record.command[-1:]) ** 2

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        return self.start_at.copy(), np.diag(self.start_std**2)

    def start_noise(self, noise: Noise) -> np.ndarray:
        return np.zeros(2)

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        return ProcessNoise(np.array([0.0, noise.process["torque"] ** 2]), np.zeros(2))


def swing(
    seed: int,
    n: int = 500,
    values: Mapping[str, float] = TRUTH,
    noise: Noise = NOISE,
    torque: float = 3.0,
    start: np.ndarray | None = None,
) -> Record:
    """A record of the true pendulum: its own equations in numpy, noise as the engine assumes it."""
    rng = np.random.default_rng(seed)
    p = {**TRUTH, **values}
    t = DT * np.arange(n)
    push = torque * np.sign(np.sin(2.0 * t) + 0.3 * np.sin(5.1 * t))
    angle, rate = Pendulum.start_at + Pendulum.start_std * rng.standard_normal(2)
    if start is not None:
        angle, rate = start
    z = np.empty((n, 3))
    for k in range(n):
        z[k] = angle, rate + p["bias"], rate
        pull = math.sin(angle) if p["sine"] else angle
        rate += DT * (push[k] - p["stiffness"] * pull - p["damping"] * rate)
        angle += DT * rate
        rate += noise.process["torque"] * math.sqrt(DT) * rng.standard_normal()
    z += rng.standard_normal(z.shape) * [noise.reading[c] for c in CHANNELS]
    z[:, 0] = (z[:, 0] + np.pi) % (2.0 * np.pi) - np.pi
    return Record(f"swing {seed}", t, push[:, None], z)


def prior(name: str, std: float, value: float | None = None, **more: float) -> FreeParameter:
    return FreeParameter(name, TRUTH[name] if value is None else value, std, **more)


# --- likelihood ----------------------------------------------------------------------------------


def exact_log_likelihood(record: Record, noise: Noise) -> float:
    """All readings of a record as one Gaussian vector."""
    n = record.t.size
    k, d = TRUTH["stiffness"], TRUTH["damping"]
    dt = np.append(np.diff(record.t), DT)
    F = [np.array([[1.0 - h * h * k, h - h * h * d], [-h * k, 1.0 - h * d]]) for h in dt]
    H = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    mean = [Pendulum.start_at]
    for row in range(n - 1):
        pushed = np.array([dt[row] ** 2, dt[row]]) * record.command[row, 0]
        mean.append(F[row] @ mean[-1] + pushed)
    blocks = np.zeros((n, 2, n, 2))
    P = np.diag(Pendulum.start_std**2)
    for row in range(n):
        cross = P
        for later in range(row, n):
            blocks[later, :, row, :] = cross
            blocks[row, :, later, :] = cross.T
            cross = F[later] @ cross
        Q = np.diag([0.0, noise.process["torque"] ** 2 * dt[row]])
        P = F[row] @ P @ F[row].T + Q
    stacked = np.kron(np.eye(n), H)
    R = np.diag(np.tile([noise.reading[c] ** 2 for c in CHANNELS], n))
    covariance = stacked @ blocks.reshape(2 * n, 2 * n) @ stacked.T + R
    z, expected = record.z.ravel(), stacked @ np.concatenate(mean)
    there = np.isfinite(z)
    return float(
        multivariate_normal.logpdf(z[there], expected[there], covariance[np.ix_(there, there)])
    )


def with_holes(record: Record, share: float, seed: int) -> Record:
    lost = np.random.default_rng(seed).random(record.z.shape) < share
    return replace(record, z=np.where(lost, np.nan, record.z))


@pytest.mark.parametrize("holes", [0.0, 0.4])
def test_likelihood_is_that_of_the_stacked_gaussian(holes):
    record = with_holes(swing(1, n=70, torque=1.0), holes, seed=7)
    engine = Engine(Pendulum(), [record])
    assert engine.log_likelihood(TRUTH, NOISE) == pytest.approx(
        exact_log_likelihood(record, NOISE), abs=1e-4
    )
    wrong = replace(NOISE, process={"torque": 2.0})
    assert engine.log_likelihood(TRUTH, wrong) == pytest.approx(
        exact_log_likelihood(record, wrong), abs=1e-4
    )


def test_likelihood_of_uneven_rows():
    """A clock that jitters, between new Jacobians too: each row's own step, to first order."""
    record = swing(1, n=70, torque=1.0)
    jitter = np.random.default_rng(2).uniform(0.7, 1.3, 70)
    record = replace(record, t=DT * np.cumsum(jitter))
    engine = Engine(Pendulum(), [record])
    loud = replace(NOISE, process={"torque": 2.0})
    assert engine.log_likelihood(TRUTH, loud) == pytest.approx(
        exact_log_likelihood(record, loud), abs=0.02
    )


def test_records_add_up():
    records = [swing(seed, n=200) for seed in range(3)]
    whole = Engine(Pendulum(), records)
    parts = [Engine(Pendulum(), [r]).log_likelihood(TRUTH, NOISE) for r in records]
    assert whole.log_likelihood(TRUTH, NOISE) == pytest.approx(sum(parts))
    assert whole.log_likelihood(TRUTH, NOISE, which=[2]) == pytest.approx(parts[2])


def with_gaps(seed: int) -> Record:
    """A record whose second channel has three readings in ten."""
    record = swing(seed, n=400)
    z = record.z.copy()
    z[np.arange(400) % 10 > 2, 1] = np.nan
    return replace(record, z=z)


def test_channels_add_up():
    """To the likelihood, but for the constant of each reading's normal density."""
    records = [with_gaps(seed) for seed in range(2)]
    engine = Engine(Pendulum(), records)
    found = engine.likelihood_by_channel(TRUTH, NOISE)
    readings = np.sum([np.isfinite(r.z).sum(axis=0) for r in records], axis=0)
    assert readings.tolist() == [800, 240, 800]
    found = found - 0.5 * math.log(2.0 * math.pi) * readings
    assert found.sum() == pytest.approx(engine.log_likelihood(TRUTH, NOISE), rel=1e-9)


def test_the_channel_of_a_sensor_in_error_has_most_of_the_loss():
    records = [with_gaps(seed) for seed in range(2)]
    error = np.array([0.0, 0.0, 0.5])
    spoilt = [replace(r, z=r.z + error * np.sin(9.0 * r.t)[:, None]) for r in records]
    sound, wrong = (
        Engine(Pendulum(), own).likelihood_by_channel(TRUTH, NOISE) for own in (records, spoilt)
    )
    loss = sound - wrong
    assert loss[2] > 100.0 and loss[2] > 2.0 * abs(loss[:2]).sum()


@pytest.mark.parametrize("threads", [2, 3])
def test_runs_worked_on_side_by_side_are_those_worked_on_one_by_one(threads):
    """To the last bit, whichever thread took which run, over and over."""
    records = [swing(seed, n=n) for seed, n in enumerate((700, 90, 400, 1100, 20))]
    free = [prior("stiffness", 1.0), prior("damping", 0.3)]
    alone = Engine(Pendulum(), records, threads=1)
    _, lin = alone.linearise(TRUTH, NOISE, free)
    score = alone.noise_score(TRUTH, NOISE)
    for _ in range(5):
        beside = Engine(Pendulum(), records, threads=threads)
        _, other = beside.linearise(TRUTH, NOISE, free)
        np.testing.assert_array_equal(other.information, lin.information)
        np.testing.assert_array_equal(other.slope, lin.slope)
        again = beside.noise_score(TRUTH, NOISE)
        np.testing.assert_array_equal(again.in_noise, score.in_noise)
        assert again.log_likelihood == score.log_likelihood


def test_the_clock_may_start_anywhere():
    """A log that begins in the middle of a flight: same likelihood, slopes and blocks."""
    record = with_holes(swing(4), 0.2, 6)
    found = []
    for start in (0.0, 137.0):
        engine = Engine(Pendulum(), [replace(record, t=record.t + start)])
        score = engine.noise_score(TRUTH, NOISE)
        _, lin = engine.linearise(TRUTH, NOISE, [prior("damping", 0.3)])
        found.append((*(np.array(part) for part in vars(score).values()), lin.slope, lin.blocks))
    for first, later in zip(*found, strict=True):
        np.testing.assert_allclose(first, later, rtol=1e-6, atol=1e-6)


def test_innovations_of_the_truth_are_white_with_unit_variance():
    passes = Engine(Pendulum(), [swing(seed, n=2000) for seed in range(4)]).filter(TRUTH, NOISE)
    e = np.stack([run.innovations for run in passes])
    assert sum(run.deweighted for run in passes) == 0
    assert e.mean((0, 1)) == pytest.approx(0.0, abs=4.0 / math.sqrt(e[:, :, 0].size))
    together = np.corrcoef(e.reshape(-1, 3).T)
    assert e.std((0, 1)) == pytest.approx(1.0, abs=0.04)
    assert together == pytest.approx(np.eye(3), abs=0.05)
    for lag in (1, 2, 5, 20):
        assert (e[:, lag:] * e[:, :-lag]).mean((0, 1)) == pytest.approx(0.0, abs=0.05)
    assert all(w.white for w in whiteness(passes, CHANNELS).values())


def test_an_empty_channel_is_no_channel():
    """NaN everywhere in a channel: what is found does not depend on that channel's noise level."""
    record = swing(3)
    z = record.z.copy()
    z[:, 2] = np.nan
    engine = Engine(Pendulum(), [replace(record, z=z)])
    other = replace(NOISE, reading={**NOISE.reading, "second gyro": 1e-4})
    a, b = (engine.filter(TRUTH, noise, keep=True)[0] for noise in (NOISE, other))
    assert a.log_likelihood == b.log_likelihood
    np.testing.assert_array_equal(a.states, b.states)
    assert np.isnan(a.innovations[:, 2]).all() and not np.isnan(a.innovations[:, :2]).any()
    np.testing.assert_array_equal(a.gains, b.gains)
    assert a.per_sigma.size == np.isfinite(z).sum()


def test_a_useless_channel_changes_nothing():
    record = swing(3)
    z = record.z.copy()
    z[:, 2] = np.nan
    vague = replace(NOISE, reading={**NOISE.reading, "second gyro": 1e5})
    with_it = Engine(Pendulum(), [record]).filter(TRUTH, vague)[0].states
    without = Engine(Pendulum(), [replace(record, z=z)]).filter(TRUTH, NOISE)[0].states
    np.testing.assert_allclose(with_it, without, atol=1e-7)


def test_a_wild_reading_hardly_counts_but_a_lasting_one_is_believed():
    record = swing(4)
    z = record.z.copy()
    z[100, 0] += 2.0
    run = Engine(Pendulum(), [replace(record, z=z)]).filter(TRUTH, NOISE)[0]
    assert run.deweighted == 1
    clean = Engine(Pendulum(), [record]).filter(TRUTH, NOISE)[0]
    np.testing.assert_allclose(run.states[200:], clean.states[200:], atol=1e-4)
    assert run.log_likelihood < clean.log_likelihood - 20.0, "a wild reading must not pay"
    z = record.z.copy()
    z[100:, 0] += 1.0  # the encoder slipped
    slipped = Engine(Pendulum(), [replace(record, z=z)]).filter(TRUTH, NOISE)[0]
    assert 0 < slipped.deweighted <= 100
    np.testing.assert_allclose(slipped.states[300:, 0], clean.states[300:, 0] + 1.0, atol=0.1)


@pytest.mark.slow
def test_the_gate_is_no_step():
    """Likelihood and its slope are continuous in a reading that crosses the gate."""
    record = swing(4)

    def log_likelihood(error: float) -> float:
        z = record.z.copy()
        z[100, 0] += error
        return Engine(Pendulum(), [replace(record, z=z)]).log_likelihood(TRUTH, NOISE)

    errors = np.linspace(0.0, 0.4, 401)
    value = np.array([log_likelihood(e) for e in errors])
    slope = np.diff(value)
    assert np.abs(np.diff(slope)).max() < 0.1 * np.abs(slope).max()


def test_noise_score_is_the_gradient_of_the_likelihood():
    """In the process noise, exact: the model is nearly linear along the filter's path."""
    engine = Engine(Pendulum(), [with_holes(swing(7), 0.2, 3)])
    model = Pendulum()

    def at(factor: float) -> Noise:
        return replace(NOISE, process={**NOISE.process, "torque": factor * NOISE.process["torque"]})

    for level in (0.5, 1.0, 2.0):
        by_noise = engine.noise_score(TRUTH, at(level)).in_noise
        more, less = at(level * 1.01), at(level / 1.01)
        p = model.vector(TRUTH)
        change = model.process_noise(more, p).intensity - model.process_noise(less, p).intensity
        found = float(np.sum(by_noise @ change))
        exact = engine.log_likelihood(TRUTH, more) - engine.log_likelihood(TRUTH, less)
        assert found == pytest.approx(exact, rel=0.02, abs=0.02)


def stacked(record: Record, q: np.ndarray, first: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Covariance of all readings of a linear record that there are, one after the other.

    Args:
        q: (2,) or, by row, (n, 2) intensities of the noise. first: (2,) variances of the first state.
        R: (3,).
    """
    n, H = record.t.size, np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    k, d = TRUTH["stiffness"], TRUTH["damping"]
    F = np.array([[1.0 - DT**2 * k, DT - DT**2 * d], [-DT * k, 1.0 - DT * d]])
    blocks, P = np.zeros((n, 2, n, 2)), np.diag(first)
    for row in range(n):
        cross = P
        for later in range(row, n):
            blocks[later, :, row, :], blocks[row, :, later, :] = cross, cross.T
            cross = F @ cross
        P = F @ P @ F.T + np.diag(np.broadcast_to(q, (n, 2))[row] * DT)
    H_all = np.kron(np.eye(n), H)
    V = H_all @ blocks.reshape(2 * n, 2 * n) @ H_all.T + np.diag(np.tile(R, n))
    there = np.isfinite(record.z.ravel())
    return V[np.ix_(there, there)]


def test_what_is_expected_of_a_variance_is_half_a_trace():
    """Of N(0, V) the slope in a number a of V is half z' W V_a W z less half tr(W V_a), W = 1/V."""
    record = with_holes(swing(7, n=60), 0.2, 3)
    score = Engine(Pendulum(), [record]).noise_score(TRUTH, NOISE)
    q = np.array([0.0, NOISE.process["torque"] ** 2])
    R = np.array([NOISE.reading[c] ** 2 for c in CHANNELS])
    first = Pendulum.start_std**2
    W = np.linalg.inv(stacked(record, q, first, R))
    nothing = stacked(record, 0.0 * q, 0.0 * first, 0.0 * R)

    def half_trace(**one: np.ndarray) -> float:
        given = {"q": 0.0 * q, "first": 0.0 * first, "R": 0.0 * R} | one
        return 0.5 * float(np.sum(W * (stacked(record, **given) - nothing)))

    for i, axis in enumerate(np.eye(2)):
        assert score.noise_expected[i] == pytest.approx(half_trace(q=axis), rel=1e-3)
        assert score.start_expected[0, i] == pytest.approx(half_trace(first=axis), rel=1e-3)
    for i, axis in enumerate(np.eye(3)):
        assert score.reading_expected[i] == pytest.approx(half_trace(R=axis), rel=1e-3)


@pytest.mark.parametrize("state", [ANGLE, RATE])
def test_start_score_is_the_gradient_in_the_first_variances(state):
    """Exact too, where the pendulum is linear; with uncertain starts too small, right and too large."""
    record = with_holes(swing(9, n=120), 0.2, 5)

    def engine_at(std: float) -> Engine:
        model = Pendulum()
        model.start_std = Pendulum.start_std.copy()
        model.start_std[state] = std
        return Engine(model, [record])

    for std in Pendulum.start_std[state] * np.array([0.3, 1.0, 3.0]):
        by_start = engine_at(std).noise_score(TRUTH, NOISE).in_start
        more, less = 1.02 * std, std / 1.02
        found = by_start[0, state] * (more**2 - less**2)
        exact = engine_at(more).log_likelihood(TRUTH, NOISE)
        exact -= engine_at(less).log_likelihood(TRUTH, NOISE)
        assert found == pytest.approx(exact, rel=0.02, abs=2e-4)


class Shaken(Pendulum):
    """Whose first rate is the less certain, the more noise there is: as a gust's is."""

    def start_noise(self, noise: Noise) -> np.ndarray:
        return np.array([0.0, 2.0 * noise.process["torque"] ** 2])


def test_what_noise_adds_to_the_first_state_is_added():
    record = swing(9, n=60)
    wider = Pendulum()
    spread = math.sqrt(Pendulum.start_std[RATE] ** 2 + 2.0 * NOISE.process["torque"] ** 2)
    wider.start_std = np.array([Pendulum.start_std[ANGLE], spread])
    assert Engine(Shaken(), [record]).log_likelihood(TRUTH, NOISE) == pytest.approx(
        Engine(wider, [record]).log_likelihood(TRUTH, NOISE), rel=1e-12
    )


def test_a_fitted_level_has_the_largest_likelihood_where_first_states_depend_on_it_too():
    """Sixty short flights, of which the first states say nearly as much as the rest."""
    rng = np.random.default_rng(11)
    level = 1.5
    loud = replace(NOISE, process={"torque": level})
    starts = Pendulum.start_at + rng.standard_normal((60, 2)) * [0.3, math.hypot(0.5, 1.4 * level)]
    records = [swing(k, n=12, noise=loud, start=at) for k, at in enumerate(starts)]
    engine = Engine(Shaken(), records)
    found = fit_noise(engine, TRUTH, NOISE, ["torque"], tolerance=0.02).process["torque"]

    def at(factor: float) -> float:
        return engine.log_likelihood(TRUTH, replace(NOISE, process={"torque": factor * found}))

    slope = (at(1.02) - at(1.0 / 1.02)) / (2.0 * math.log(1.02))
    curvature = (2.0 * at(1.0) - at(1.02) - at(1.0 / 1.02)) / math.log(1.02) ** 2
    assert curvature > 0.0 and abs(slope) < 0.2 * math.sqrt(curvature), "within a fifth of its std"


def test_some_seconds_of_flight_are_whole_runs_evenly_picked_wherever_clocks_start():
    """Twenty of thirty seconds: the first and the last of three runs."""
    quiet, loud = NOISE, replace(NOISE, process={"torque": 1.2})
    records = [swing(1, noise=loud), swing(2, noise=quiet), swing(3, noise=loud)]
    late = [replace(r, t=r.t + 1e3) for r in records]

    def found(runs: list[Record], seconds: float = math.inf) -> float:
        return fit_noise(
            Engine(Pendulum(), runs), TRUTH, NOISE, ["torque"], seconds=seconds
        ).process["torque"]

    picked = found([records[0], records[2]])
    assert found(records, 19.9) == picked == pytest.approx(1.2, rel=0.25)
    assert found(late, 19.9) == pytest.approx(picked, rel=1e-6)
    assert found(records, 25.0) == found(records) < 0.9 * picked


def test_angles_wrap():
    """A pendulum that goes over the top many times is followed as if its encoder never jumped."""
    values = {**TRUTH, "sine": 1.0, "damping": 0.05}
    model = Pendulum()
    model.start_at = np.array([0.2, 12.0])
    record = swing(5, values=values, start=model.start_at)
    run = Engine(model, [record]).filter(values, NOISE)[0]
    assert np.abs(run.states[:, ANGLE]).max() > 4.0 * np.pi
    assert np.abs(np.diff(record.z[:, 0])).max() > 6.0
    assert run.deweighted <= 2
    assert np.nanstd(run.innovations[20:, 0]) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("angle", [-9.0, -math.pi, -0.1, 0.0, 3.0, math.pi, 100.0])
def test_wrap_angle(angle):
    wrapped = wrap_angle(angle)
    assert wrapped == wrap_angles(np.array([angle]))[0]
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0)


def test_uneven_rows_are_followed():
    """Rows left out of an even record cost accuracy, not balance."""
    record = swing(6, n=1500)
    keep = np.random.default_rng(0).random(1500) < 0.6
    keep[0] = True
    lost = replace(record, z=np.where(keep[:, None], record.z, np.nan))
    rows = np.flatnonzero(keep)
    thin = replace(record, t=record.t[rows], command=record.command[rows], z=record.z[rows])
    full = Engine(Pendulum(), [lost]).filter(TRUTH, NOISE)[0]
    run = Engine(Pendulum(), [thin]).filter(TRUTH, NOISE)[0]
    assert run.deweighted <= full.deweighted + 3
    # the command inside a longer row is not known, so only the state is compared, loosely
    error = run.states - full.states[rows]
    assert np.sqrt(np.mean(error[50:] ** 2, 0)) == pytest.approx(0.0, abs=0.25)


@pytest.mark.parametrize("rate", [0.1, 3.0])
def test_jacobian_of_a_step_is_the_exponential_of_that_of_the_drift(rate):
    """To third order; rows that the drift takes exactly are I + A; none of a row that is too stiff."""
    nx = 3
    exact = np.array([False, True, False])
    A = with_places(np.zeros((nx, padded(nx))), nx)
    A.values[:, :nx] = [[-rate, 0.4, 0.0], [0.0, 0.1, 0.2], [0.3, 0.0, -0.2]]
    F = with_places(np.zeros_like(A.values), nx)
    done = transition.exponential(exact, A, np.zeros_like(A.values), F)
    assert done == (rate <= transition.MOST_DECAY)
    if not done:
        assert not F.values.any()
        return
    a = A.values[:, :nx]
    expected = np.eye(nx) + a + a @ a / 2.0 + a @ a @ a / 6.0
    expected[exact] = (np.eye(nx) + a)[exact]
    np.testing.assert_allclose(F.values[:, :nx], expected, rtol=1e-9, atol=1e-12)
    for i in range(nx):
        assert set(F.places[i, : F.counts[i]]) == set(np.flatnonzero(F.values[i]))


def test_a_stiff_row_has_the_jacobian_of_the_step():
    """Where the drift's series is no longer good, the step itself is differenced, in the pass too."""
    stiff = Pendulum()
    stiff.exact = np.array([False, False])
    values = {**TRUTH, "damping": 40.0}
    record = swing(1, n=40, values=values)
    assert values["damping"] * DT > transition.MOST_DECAY
    _, along = Engine(stiff, [record]).filter_run(
        0,
        stiff.vector(values),
        replace(NOISE, reading=dict.fromkeys(CHANNELS, 0.1)),
        Buffers(),
        Buffers(),
    )
    k, d = values["stiffness"], values["damping"]
    F = [[1.0 - DT * DT * k, DT - DT * DT * d], [-DT * k, 1.0 - DT * d]]
    np.testing.assert_allclose(along.F[0], F, atol=1e-6)


# --- signatures ----------------------------------------------------------------------------------


def test_signatures_are_derivatives_of_the_mean_pass_with_the_gains_frozen():
    record = with_holes(swing(8, values={**TRUTH, "sine": 1.0}), 0.2, seed=1)
    values = {**TRUTH, "sine": 1.0}
    model = Pendulum()
    engine = Engine(model, [record])
    free = [prior("stiffness", 0.5), prior("damping", 0.2), prior("bias", 0.05)]
    passes, lin = engine.linearise(values, NOISE, free)
    run = passes[0]

    def mean(x0: np.ndarray, named: Mapping[str, float]) -> np.ndarray:
        """Whitened innovations with the kept gains, written out with numpy."""
        p, out = model.vector(named), np.zeros((record.t.size, 3))
        x, nxt, h, reading = x0.copy(), np.zeros(2), np.zeros(3), 0
        for k in range(record.t.size):
            h[:] = x[ANGLE], x[RATE] + p[BIAS], x[RATE]
            nu = record.z[k] - h
            nu[0] = (nu[0] + np.pi) % (2.0 * np.pi) - np.pi
            nu = np.where(np.isfinite(nu), nu, 0.0)
            H = run.H[k // REFRESH]
            moved = np.zeros(2)
            for i in np.flatnonzero(np.isfinite(record.z[k])):
                residual = nu[i] - H[i] @ moved
                out[k, i] = run.per_sigma[reading] * residual
                moved = moved + run.gains[reading] * residual
                reading += 1
            x = x + moved
            pull = math.sin(x[ANGLE])
            nxt[RATE] = x[RATE] + DT * (
                record.command[k, 0] - p[STIFFNESS] * pull - p[DAMPING] * x[RATE]
            )
            nxt[ANGLE] = x[ANGLE] + DT * nxt[RATE]
            x = nxt.copy()
        return out

    x0 = model.start_at
    base = mean(x0, values)
    there = np.isfinite(run.innovations)
    np.testing.assert_allclose(base[there], run.innovations[there], atol=2e-5)
    J = []
    for f in free:
        h = 1e-4
        ahead = mean(x0, {**values, f.name: values[f.name] + h})
        behind = mean(x0, {**values, f.name: values[f.name] - h})
        J.append((ahead - behind) / (2.0 * h))
    J = np.array(J)
    J[:, ~there] = 0.0
    gram = np.einsum("anm,bnm->ab", J, J)
    size = np.sqrt(np.diag(gram))
    np.testing.assert_allclose(
        lin.information[0] / np.outer(size, size), gram / np.outer(size, size), atol=0.01
    )
    np.testing.assert_allclose(
        lin.slope[0], np.einsum("anm,nm->a", J, np.where(there, base, 0.0)), rtol=0.05, atol=1.0
    )
    np.testing.assert_allclose(lin.by_channel[0].sum(1), np.diag(lin.information[0]), rtol=1e-9)
    np.testing.assert_allclose(lin.blocks.sum(0), lin.slope[0], rtol=1e-9, atol=1e-9)


def test_slope_is_the_gradient_of_the_likelihood():
    """At the truth's gains the frozen slope is close to the whole derivative."""
    engine = Engine(Pendulum(), [swing(seed, n=800) for seed in (1, 2)])
    free = [prior("damping", 0.2), prior("bias", 0.05)]
    values = {**TRUTH, "damping": 0.9, "bias": 0.05}
    _, lin = engine.linearise(values, NOISE, free)
    for i, f in enumerate(free):
        h = 1e-4
        change = engine.log_likelihood({**values, f.name: values[f.name] + h}, NOISE)
        change -= engine.log_likelihood({**values, f.name: values[f.name] - h}, NOISE)
        assert -lin.slope.sum(0)[i] == pytest.approx(change / (2.0 * h), rel=0.05)


def test_a_parameter_without_effect_has_no_signature():
    engine = Engine(Pendulum(), [swing(1)])
    z = engine.records[0].z.copy()
    z[:, 1] = np.nan
    engine = Engine(Pendulum(), [replace(engine.records[0], z=z)])
    _, lin = engine.linearise(TRUTH, NOISE, [prior("bias", 0.05)])
    assert lin.information[0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("parameter", [prior("bias", 0.05), prior("sine", 0.5, probe=0.5)])
def test_a_run_without_readings_has_no_signature(parameter):
    record = swing(1)
    silent = replace(record, z=np.full_like(record.z, np.nan))
    both, alone = Engine(Pendulum(), [record, silent]), Engine(Pendulum(), [record])
    _, lin = both.linearise(TRUTH, NOISE, [parameter])
    _, linearised = alone.linearise(TRUTH, NOISE, [parameter])
    assert linearised.information[0, 0, 0] > 0.0
    assert lin.information[0] == pytest.approx(linearised.information[0])
    assert not lin.information[1].any()


def test_a_finite_step_finds_the_slope_of_what_is_linear():
    """A gyro's bias, probed by half a radian a second: the derivative itself, in every channel."""
    engine = Engine(Pendulum(), [with_holes(swing(3), 0.2, 1), swing(4, n=200)])
    free = [prior("bias", 0.05)]
    _, lin = engine.linearise(TRUTH, NOISE, free)
    _, probed = engine.linearise(TRUTH, NOISE, [replace(free[0], probe=0.5)])
    for name in ("information", "slope", "by_channel", "blocks"):
        np.testing.assert_allclose(getattr(probed, name), getattr(lin, name), rtol=1e-4, atol=1e-6)


def test_a_step_stays_within_its_bound():
    """One that stands at its upper bound is moved the other way: the slope is the same."""
    engine = Engine(Pendulum(), [swing(3)])
    for more in ({}, {"probe": 0.5}):
        (_, lin), (_, fenced) = (
            engine.linearise(TRUTH, NOISE, [prior("bias", 0.05, upper=upper, **more)])
            for upper in (math.inf, 0.0)
        )
        np.testing.assert_allclose(fenced.slope, lin.slope, rtol=1e-4)
        np.testing.assert_allclose(fenced.information, lin.information, rtol=1e-4)


def test_scores_are_summed_over_blocks_of_two_seconds():
    """A filter looks back alone: the first blocks are the slope of a record that ends there."""
    record = with_holes(replace(swing(3, n=430), t=11.0 + DT * np.arange(430)), 0.2, 4)
    free = [prior("bias", 0.05), prior("damping", 0.2)]
    _, lin = Engine(Pendulum(), [record]).linearise(TRUTH, NOISE, free)
    assert lin.blocks.shape == (5, 2)
    for k in range(1, 5):
        rows = slice(0, 100 * k)
        first = replace(record, t=record.t[rows], z=record.z[rows], command=record.command[rows])
        _, alone = Engine(Pendulum(), [first]).linearise(TRUTH, NOISE, free)
        np.testing.assert_allclose(lin.blocks[:k].sum(0), alone.slope[0], rtol=1e-6)

    in_noise = Engine(Pendulum(), [record]).noise_score(TRUTH, NOISE).in_noise
    assert in_noise.shape == (5, 2) and in_noise.any(axis=1).all()


def test_a_step_is_shortened_until_the_cost_falls():
    """Four times too long on a parabola: half of it gains nothing, a quarter is the optimum."""
    engine = Engine(Pendulum(), [swing(1, n=600, values={**TRUTH, "bias": 0.1})])
    free = [prior("bias", 1.0)]
    passes, lin = engine.linearise(TRUTH, NOISE, free)
    change, step = Quadratic.of(lin, free, TRUTH).best(["bias"])
    for times, share in ((1.0, 1.0), (4.05, 0.25), (12.0, 0.1)):
        move = {"bias": times * float(step[0])}
        found, gained = engine.descend(passes, free, TRUTH, NOISE, move)
        assert found["bias"] == pytest.approx(share * times * step[0], rel=1e-6)
        cost = [engine.frozen_cost(passes, free, at, NOISE) for at in (TRUTH, found)]
        assert 0.0 < gained == pytest.approx(cost[0] - cost[1])
    assert gained < -change
    far = [replace(free[0], value=3.0, std=0.5)]
    costs = [engine.frozen_cost(passes, some, TRUTH, NOISE) for some in (far, [])]
    assert costs[0] - costs[1] == pytest.approx(18.0), "six widths of the prior"
    stays, gained = engine.descend(passes, free, TRUTH, NOISE, {"bias": -float(step[0])})
    assert (stays, gained) == (TRUTH, 0.0)
    fenced = [replace(free[0], upper=0.5 * float(step[0]))]
    found, _ = engine.descend(passes, fenced, TRUTH, NOISE, {"bias": float(step[0])})
    assert found["bias"] == pytest.approx(0.5 * step[0])


def test_one_step_is_one_step():
    """Of a parameter that is linear: a second one has nothing left to do."""
    engine = Engine(Pendulum(), [swing(1, n=600, values={**TRUTH, "bias": 0.1})])
    once, again = (engine.fit([prior("bias", 1.0)], TRUTH, NOISE, n, 1e-9) for n in (1, 2))
    assert once.iterations == 1
    assert once.values["bias"] == pytest.approx(again.values["bias"], abs=1e-3)
    assert once.values["bias"] == pytest.approx(0.1, abs=0.03)


# --- what is not flown twice -----------------------------------------------------------------------


@pytest.fixture
def flown(monkeypatch) -> list[int]:
    """Grows by one with every filter pass over a record."""
    passes: list[int] = []
    filter_run = Engine.filter_run

    def counted(self, i, *args, **more):
        passes.append(i)
        return filter_run(self, i, *args, **more)

    monkeypatch.setattr(Engine, "filter_run", counted)
    return passes


def test_what_was_linearised_is_remembered_at_its_point_for_its_parameters(flown):
    record = swing(1, n=200)
    engine, free = Engine(Pendulum(), [record]), [prior("stiffness", 3.0), prior("bias", 0.3)]
    wider, louder = [replace(f, std=2.0 * f.std) for f in free], NOISE.with_levels({"torque": 0.4})
    _, first = engine.linearise(TRUTH, NOISE, free)
    for at, noise, of, passes in (
        (TRUTH, NOISE, free, 1), (TRUTH, NOISE, free[:1], 2), (TRUTH, NOISE, wider, 3),
        (TRUTH, louder, free, 4), (PLANTED, NOISE, free, 5), (PLANTED, NOISE, free, 5),
    ):  # fmt: skip
        _, again = engine.linearise(at, noise, of, gains=False)
        _, fresh = Engine(Pendulum(), [record]).linearise(at, noise, of)
        flown.pop()
        assert len(flown) == passes
        np.testing.assert_array_equal(again.information, fresh.information)
    (run,), last = engine.linearise(PLANTED, NOISE, free)  # its gains are wanted
    assert len(flown) == 6 and run.gains.size and not np.array_equal(last.slope, first.slope)


def test_a_fit_goes_on_from_what_was_linearised(flown):
    """As one from the start: with the gains that are not remembered."""
    record = swing(1, n=600, values={**TRUTH, "bias": 0.1})
    free, known = [prior("bias", 1.0)], Engine(Pendulum(), [record])
    known.linearise(TRUTH, NOISE, free)
    again, fresh = (
        engine.fit(free, TRUTH, NOISE, 3, 1e-9) for engine in (known, Engine(Pendulum(), [record]))
    )
    assert again.values == fresh.values and again.objective == fresh.objective
    settled = known.fit(free, again.values, NOISE, 3, 1e-2)
    flown.clear()
    known.linearise(settled.values, NOISE, free, gains=False)
    assert settled.converged and not flown


def test_the_noise_is_scored_once_at_a_point(flown):
    engine = Engine(Pendulum(), [swing(1, n=200)])
    louder = NOISE.with_levels({"torque": 0.4})
    first = engine.noise_score(TRUTH, NOISE)
    assert engine.noise_score(TRUTH, NOISE) is first and len(flown) == 1
    other = engine.noise_score(TRUTH, louder)
    assert len(flown) == 2 and other.log_likelihood != first.log_likelihood


# --- fits ----------------------------------------------------------------------------------------

FREE = [prior("stiffness", 3.0, 10.5, lower=1.0), prior("damping", 0.5, 0.3, lower=0.0),
        prior("bias", 0.3, 0.0)]  # fmt: skip
PLANTED = {"stiffness": 9.0, "damping": 0.6, "bias": 0.08, "sine": 1.0}


@pytest.fixture(scope="module")
def estimates() -> list[Estimate]:
    found = []
    for seed in range(30):
        engine = Engine(Pendulum(), [swing(100 + seed, n=600, values=PLANTED)])
        start = {"stiffness": 10.5, "damping": 0.3, "bias": 0.0, "sine": 1.0}
        found.append(engine.fit(FREE, start, NOISE, iterations=8))
    return found


def test_planted_values_are_found(estimates):
    for found in estimates[:6]:
        assert found.converged
        for name in found.names:
            assert abs(found.values[name] - PLANTED[name]) < 3.5 * found.std[name]
            assert found.std[name] < 0.3 * next(f.std for f in FREE if f.name == name)


def test_intervals_cover(estimates):
    """95 % intervals of three parameters on thirty records: about 95 % of them hold the truth."""
    inside = sum(
        abs(found.values[name] - PLANTED[name]) < 1.96 * found.std[name]
        for found in estimates
        for name in found.names
    )
    low, high = binom.ppf([0.001, 0.9999], 90, 0.95)
    assert low <= inside <= high
    for name in estimates[0].names:  # and the std is the scatter
        z = [(found.values[name] - PLANTED[name]) / found.std[name] for found in estimates]
        assert 0.65 < np.std(z) < 1.45


def test_the_fit_stands_at_the_top_of_the_likelihood(estimates):
    found = estimates[0]
    engine = Engine(Pendulum(), [swing(100, n=600, values=PLANTED)])

    def cost(values: Mapping[str, float]) -> float:
        gap = sum(((values[f.name] - f.value) / f.std) ** 2 for f in FREE)
        return 0.5 * gap - engine.log_likelihood({"sine": 1.0, **values}, NOISE)

    best = cost(found.values)
    assert found.objective == pytest.approx(best, rel=1e-9)
    for name, std in found.std.items():
        for side in (-1.0, 1.0):
            moved = {**found.values, name: found.values[name] + side * 2.0 * std}
            assert cost(moved) > best + 0.5


def test_a_strong_prior_holds_and_a_bound_stops():
    engine = Engine(Pendulum(), [swing(1, n=600)])
    sure = [prior("damping", 1e-4, 0.8)]
    held = engine.fit(sure, {**TRUTH, "damping": 0.8}, NOISE)
    assert held.values["damping"] == pytest.approx(0.8, abs=1e-3)
    fenced = [prior("damping", 0.5, 0.9, lower=0.8)]
    stopped = engine.fit(fenced, {**TRUTH, "damping": 0.9}, NOISE)
    assert stopped.values["damping"] == pytest.approx(0.8)


@pytest.mark.parametrize("level", [0.1, 1.0])
def test_process_noise_level_is_found(level):
    truth = replace(NOISE, process={"torque": level})
    engine = Engine(Pendulum(), [swing(seed, n=1200, noise=truth) for seed in range(2)])
    found = fit_noise(engine, TRUTH, NOISE, ["torque"])
    assert found.process["torque"] == pytest.approx(level, rel=0.25)
    assert found.reading == NOISE.reading


def test_noise_level_stops_at_its_floor():
    still = replace(NOISE, process={"torque": 0.0})
    engine = Engine(Pendulum(), [swing(1, n=1200, noise=still)])
    floored = replace(NOISE, floor={"torque": 0.2})
    found = fit_noise(engine, TRUTH, floored, ["torque"])
    assert found.process["torque"] == pytest.approx(0.2, rel=0.01)


def test_a_diverging_model_has_no_likelihood_and_does_not_crash():
    mad = {**TRUTH, "stiffness": -1e9}
    engine = Engine(Pendulum(), [swing(1)])
    assert engine.log_likelihood(mad, NOISE) < -1e6
    _, lin = engine.linearise(mad, NOISE, [prior("damping", 0.2)])
    assert np.isfinite(lin.information).all()


# --- the small solvers ---------------------------------------------------------------------------


def test_bounded_solve_is_scipys():
    rng = np.random.default_rng(0)
    for _ in range(200):
        k = int(rng.integers(1, 7))
        M = rng.standard_normal((k + 3, k))
        y = 3.0 * rng.standard_normal(k + 3)
        lower, upper = -rng.exponential(0.5, k), rng.exponential(0.5, k)
        x = bounded_solve(M.T @ M, M.T @ y, lower, upper)
        best = lsq_linear(M, y, (lower, upper), tol=1e-13, method="bvls").x
        assert np.all(x >= lower - 1e-12) and np.all(x <= upper + 1e-12)

        def cost(v: np.ndarray, M: np.ndarray = M, y: np.ndarray = y) -> float:
            return 0.5 * float(np.sum((M @ v - y) ** 2))

        assert cost(x) <= cost(best) + 1e-9 * (1.0 + cost(best))


def test_a_newton_step_gains_what_the_quadratic_predicts():
    """One step of a linear-Gaussian parameter lands on the optimum."""
    engine = Engine(Pendulum(), [swing(1, n=600, values={**TRUTH, "bias": 0.1})])
    free = [prior("bias", 1.0)]
    passes, lin = engine.linearise(TRUTH, NOISE, free)
    change, step = Quadratic.of(lin, free, TRUTH).best(["bias"])
    moved = {**TRUTH, "bias": float(step[0])}
    gained = engine.frozen_cost(passes, free, TRUTH, NOISE)
    gained -= engine.frozen_cost(passes, free, moved, NOISE)
    assert gained == pytest.approx(-change, rel=1e-4)
    assert step[0] == pytest.approx(0.1, abs=0.02)


def test_a_newton_step_weighs_the_data_against_the_prior():
    """Two Gaussians: the optimum is their mean by precision, wherever the step starts."""
    information, slope, start = 4.0, 3.0, 2.5
    lin = Linearised(
        ("bias",), np.full((1, 1, 1), information), np.full((1, 1), slope), np.empty((1, 1, 1)),
        np.empty((1, 1)),
    )  # fmt: skip
    change, step = Quadratic.of(lin, [prior("bias", 0.4, 1.0)], {"bias": start}).best(["bias"])
    data, precision = start - slope / information, 0.4**-2
    best = (information * data + precision * 1.0) / (information + precision)

    def cost(bias: float) -> float:
        return 0.5 * information * (bias - data) ** 2 + 0.5 * precision * (bias - 1.0) ** 2

    assert start + step[0] == pytest.approx(best)
    assert change == pytest.approx(cost(best) - cost(start))


# --- whiteness -----------------------------------------------------------------------------------


def a_pass(e: np.ndarray) -> RunPass:
    """A run whose innovations are given."""
    n = len(e)
    record = Record("made", 0.01 * np.arange(n), np.zeros((n, 1)), e)
    none = np.empty(0)
    return RunPass(record, none, 0.0, e, none, 0, none, none, none, none, none.astype(int), none)


def test_white_noise_is_white():
    for seed in range(20):
        e = np.random.default_rng(seed).standard_normal((1500, 2))
        e[::3, 1] = np.nan
        judged = whiteness([a_pass(e)], ("a", "b"))
        assert judged["a"].white and judged["b"].white


def test_p_values_of_white_noise_are_uniform():
    """Also of eighty readings, where Box and Pierce's statistic would be an eighth too small."""
    draws = np.random.default_rng(5).standard_normal((400, 181, 1))
    p_values = [whiteness([a_pass(e)], ("a",))["a"].p_value for e in draws]
    assert np.mean(p_values) == pytest.approx(0.5, abs=0.05)
    assert np.mean(np.array(p_values) < 0.25) == pytest.approx(0.25, abs=0.07)


@pytest.mark.parametrize("pole", [0.4, -0.4, 0.9])
def test_coloured_noise_is_not_white(pole):
    shock = np.random.default_rng(1).standard_normal((2000, 2))
    shock[:, 0] = math.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], shock[:, 0])
    judged = whiteness([a_pass(shock)], ("a", "b"))
    assert not judged["a"].white and judged["b"].white
    assert judged["a"].p_value < 1e-5 and judged["a"].coloured_share > 0.1


def test_noise_that_is_too_large_is_not_white():
    e = 1.6 * np.random.default_rng(2).standard_normal((1500, 1))
    assert not whiteness([a_pass(e)], ("a",))["a"].white


def test_a_short_part_is_as_wide_as_chance_makes_it():
    """Sixty readings have a std above 1.25 once in 300 times: with 100 of them, every third flight."""
    draws = np.random.default_rng(4).standard_normal((400, 162, 1))
    assert max(float(e[101:].std()) for e in draws) > 1.25
    assert all(whiteness([a_pass(e)], ("a",))["a"].white for e in draws)
    assert not whiteness([a_pass(2.0 * draws[0])], ("a",))["a"].white


def test_an_empty_channel_is_not_judged():
    e = np.random.default_rng(3).standard_normal((500, 2))
    e[:, 1] = np.nan
    assert set(whiteness([a_pass(e)], ("a", "b"))) == {"a"}


def test_a_channel_with_few_readings_is_not_judged():
    """Twenty lags of fifty readings are no statistic, whatever they look like."""
    e = 3.0 * np.random.default_rng(4).standard_normal((1000, 2))
    e[150:, 1] = np.nan  # fifty are left after the first second
    assert set(whiteness([a_pass(e)], ("a", "b"))) == {"a"}


@pytest.mark.parametrize("pole", [0.3, 0.6, 0.8])
def test_what_an_autoregression_predicts_of_itself_is_its_pole_squared(pole):
    """And what its innovations carry falls as much: n of them are worth n (1 - pole^2), to a fifth."""
    rng = np.random.default_rng(6)
    e = lfilter([math.sqrt(1.0 - pole**2)], [1.0, -pole], rng.standard_normal(60_000))
    found = whiteness([a_pass(e[1000:, None])], ("a",))["a"]
    assert found.coloured_share == pytest.approx(pole**2, abs=0.015)
    assert found.inflation == pytest.approx(1.0 / (1.0 - pole**2), rel=0.05)
    drift = whiteness([a_pass(np.cumsum(rng.standard_normal((20_000, 1)), axis=0))], ("a",))["a"]
    assert drift.inflation == pytest.approx(5.0)


def test_white_noise_predicts_nothing_of_itself_however_short_the_record():
    """Twenty correlations fitted to a hundred readings look like a fifth: that much is taken off."""
    draws = np.random.default_rng(7).standard_normal((300, 201, 1))
    judged = [whiteness([a_pass(e)], ("a",))["a"] for e in draws]
    shares = np.array([w.coloured_share for w in judged])
    assert np.median(shares) < 0.02 and shares.mean() < 0.05
    assert all(w.white for w in judged)
    assert np.mean([w.inflation for w in judged]) == pytest.approx(1.0, abs=0.06)


def test_the_worst_run_is_judged_and_many_runs_have_many_chances():
    """Bonferroni: of six p values the least is six times likelier; a coloured run comes first."""
    rng = np.random.default_rng(8)
    alone = [a_pass(e) for e in rng.standard_normal((6, 900, 1))]
    p_values = [whiteness([run], ("a",))["a"].p_value for run in alone]
    together = whiteness(alone, ("a",))["a"]
    assert any(together.p_value == pytest.approx(min(6.0 * p, 1.0)) for p in p_values)
    assert together.white and together.p_value <= 1.0
    pole = 0.7
    red = math.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], rng.standard_normal(900))
    coloured = replace(alone[0], record=replace(alone[0].record, name="red"))
    coloured = replace(coloured, innovations=red[:, None])
    draws = rng.standard_normal((6, 8, 400, 1))
    p_values = [whiteness([a_pass(e) for e in runs], ("a",))["a"].p_value for runs in draws]
    assert 0.3 < max(p_values) <= 1.0, "a probability, however many runs"
    for runs in ([coloured, *alone], [*alone, coloured]):
        found = whiteness(runs, ("a",))["a"]
        assert found.run == "red" and not found.white
    redder = replace(alone[1], record=replace(alone[1].record, name="redder"))
    more = math.sqrt(1.0 - 0.9**2) * lfilter([1.0], [1.0, -0.9], rng.standard_normal(900))
    redder = replace(redder, innovations=more[:, None])
    for runs in ([coloured, redder], [redder, coloured]):
        assert whiteness(runs, ("a",))["a"].run == "redder"


def test_colour_far_below_the_assumed_noise_does_not_matter():
    """The same correlation in innovations a tenth as large is a hundredth of the variance."""
    pole = 0.7
    red = lfilter([1.0], [1.0, -pole], np.random.default_rng(9).standard_normal((2000, 1)), axis=0)
    red *= math.sqrt(1.0 - pole**2)
    assert not whiteness([a_pass(red)], ("a",))["a"].white
    faint = whiteness([a_pass(0.1 * red)], ("a",))["a"]
    assert faint.white and faint.p_value < 1e-5
    loud = whiteness([a_pass(1.1 * red)], ("a",))[
        "a"
    ]  # louder than assumed is no worse than as loud
    assert loud.coloured_share == pytest.approx(faint.coloured_share)


def test_the_first_second_is_not_judged():
    """A filter that has not settled says nothing of the model, wherever the clock starts."""
    e = np.random.default_rng(10).standard_normal((1500, 1))
    run = a_pass(e)
    wild = e.copy()
    wild[:100] *= 50.0
    late = replace(run, record=replace(run.record, t=run.record.t + 60.0), innovations=wild)
    assert whiteness([late], ("a",))["a"] == whiteness([run], ("a",))["a"]
    wild[110:130] *= 50.0
    assert whiteness([replace(late, innovations=wild)], ("a",))["a"].spread > 2.0
