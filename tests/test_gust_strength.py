"""The strength of process noise by blocks of time, on a pendulum whose equations are its own."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from test_estimation import CHANNELS, DT, NOISE, RATE, TRUTH, Pendulum, stacked, swing

from coax_env.estimation import gust_strength
from coax_env.estimation.engine import Engine
from coax_env.estimation.gust_strength import BLOCK, SPREAD, prior_cost, with_strengths
from coax_env.estimation.state_space import STEADY, Record, Strength, part


def rough(factor: np.ndarray, n: int = 200, seed: int = 3) -> Record:
    """A record whose torque is shaken by variances of `factor` (blocks,), each for BLOCK seconds."""
    rng = np.random.default_rng(seed)
    block = (DT * np.arange(n) / BLOCK).astype(int)
    shaken = np.sqrt(factor[block] - 1.0) * NOISE.process["torque"] * math.sqrt(DT)
    F = np.array([[1.0 - DT**2 * TRUTH["stiffness"], DT - DT**2 * TRUTH["damping"]],
                  [-DT * TRUTH["stiffness"], 1.0 - DT * TRUTH["damping"]]])  # fmt: skip
    record, more = swing(seed, n), np.zeros((n, 2))
    for k in range(n - 1):  # what more noise adds to a linear pendulum
        more[k + 1] = F @ more[k]
        more[k + 1, 1] += shaken[k] * rng.standard_normal()
    return replace(record, z=record.z + more[:, [0, 1, 1]])


def of_blocks(record: Record, factor: np.ndarray) -> Record:
    block = ((record.t - record.t[0]) / BLOCK).astype(np.int64)
    factors = np.ones((len(factor), 2))
    factors[:, RATE] = factor
    return replace(record, strength=Strength(block, factors))


def test_the_likelihood_is_that_of_noise_of_each_rows_variance():
    """By the covariance of all readings of a linear pendulum, whose noise differs from row to row."""
    record = of_blocks(swing(7, n=36), np.array([1.0, 20.0, 0.2]))
    factor = record.strength.factor[record.strength.block]
    q = np.array([0.0, NOISE.process["torque"] ** 2])
    R = np.array([NOISE.reading[c] ** 2 for c in CHANNELS])
    V = stacked(record, q * factor, Pendulum.start_std**2, R)
    engine = Engine(Pendulum(), [record])
    e = engine.filter(TRUTH, NOISE)[0].innovations  # of variance one and independent of each other
    per_sigma = engine.filter(TRUTH, NOISE, keep=True)[0].per_sigma
    assert -2.0 * np.sum(np.log(per_sigma)) == pytest.approx(np.linalg.slogdet(V)[1], abs=1e-3)
    assert engine.log_likelihood(TRUTH, NOISE) == pytest.approx(
        -0.5 * (np.nansum(e**2) + np.linalg.slogdet(V)[1] + V.shape[0] * math.log(2.0 * math.pi)),
        abs=1e-3,
    )


def test_its_slopes_are_the_gradient_of_the_likelihood():
    record = of_blocks(rough(np.array([1.0, 1.0, 9.0, 1.0]), n=50), np.array([0.5, 1.0, 3.0, 2.0]))
    _, shown, expected = Engine(Pendulum(), [record]).strength_slopes(TRUTH, NOISE)
    for block in range(4):
        sides = []
        for change in (0.01, -0.01):
            factor = record.strength.factor.copy()
            factor[block] *= math.exp(change)
            there = replace(record, strength=record.strength._replace(factor=factor))
            sides.append(Engine(Pendulum(), [there]).log_likelihood(TRUTH, NOISE))
        slope = (sides[0] - sides[1]) / 0.02
        assert shown[0][block, RATE] - expected[0][block, RATE] == pytest.approx(slope, abs=0.02)


def test_strengths_are_found_where_they_are():
    """A factor of 100 in a fifth of the blocks, of which each has 12 rows of three readings."""
    truth = np.where(np.arange(80) % 5 == 2, 100.0, 1.0)
    record = rough(truth, n=1000)
    (found,) = with_strengths(Engine(Pendulum(), [record]), TRUTH, NOISE, np.array([RATE]))
    logs = np.log(found.strength.factor)
    assert np.all(logs[:, 1 - RATE] == 0.0), "the other entry is steady"
    assert logs[truth > 1.0, RATE].min() > 1.0 > logs[truth == 1.0, RATE].mean()
    assert abs(logs[truth == 1.0, RATE].mean()) < 0.3
    # the prior draws a factor of 100, 2.3 std out, towards one
    assert logs[truth > 1.0, RATE].mean() == pytest.approx(math.log(100.0), abs=SPREAD)


def test_every_turn_goes_up(monkeypatch):
    record = rough(np.where(np.arange(16) % 4 == 1, 30.0, 1.0))
    heights = []
    for turns in range(6):
        monkeypatch.setattr(gust_strength, "TURNS", turns)
        records = with_strengths(Engine(Pendulum(), [record]), TRUTH, NOISE, np.array([RATE]))
        logs = np.log(records[0].strength.factor) / SPREAD
        height = Engine(Pendulum(), records).log_likelihood(TRUTH, NOISE)
        heights.append(height - 0.5 * float(np.sum(logs**2)))
    assert np.all(np.diff(heights) > 0.0) and heights[-1] > heights[0] + 20.0


def test_the_prior_is_a_normal_of_the_logarithms():
    drawn = np.exp(SPREAD * np.random.default_rng(1).standard_normal((2, 4)))
    records = [of_blocks(swing(7, n=48), factor) for factor in drawn]
    log_density = norm.logpdf(np.log(drawn), scale=SPREAD).sum()
    at_one = drawn.size * norm.logpdf(0.0, scale=SPREAD)
    assert prior_cost([*records, swing(8)]) == pytest.approx(at_one - log_density)
    assert prior_cost([swing(8)]) == 0.0


@pytest.mark.parametrize("seed", [3, 5])
def test_strengths_believe_the_model_beside_which_they_were_taken(monkeypatch, seed):
    """Two stiffnesses: which is likelier, and by how much, with the strengths of one and of each.

    A bound that touches the posterior at one of them lies below it at the other.
    """
    monkeypatch.setattr(gust_strength, "TURNS", 60)
    record = rough(np.where(np.arange(40) % 5 == 2, 60.0, 1.0), n=500, seed=seed)
    values = (TRUTH, {**TRUTH, "stiffness": 1.3 * TRUTH["stiffness"]})
    taken = [with_strengths(Engine(Pendulum(), [record]), v, NOISE, np.array([RATE])) for v in values]

    def height(i: int, of: int) -> float:
        engine = Engine(Pendulum(), taken[of])
        return engine.log_likelihood(values[i], NOISE) - prior_cost(taken[of])

    beside, without = (height(0, of) - height(1, of) for of in (0, 1))
    each = height(0, 0) - height(1, 1)
    assert beside > each + 0.1 and each > without + 0.1


def test_steady_noise_has_hardly_any_strengths():
    (found,) = with_strengths(
        Engine(Pendulum(), [rough(np.ones(80), n=1000)]), TRUTH, NOISE, np.array([RATE])
    )
    assert np.abs(np.log(found.strength.factor)).max() < 2.0 * SPREAD


def test_a_part_keeps_the_strength_of_its_rows():
    record = of_blocks(swing(1, n=50), np.array([1.0, 5.0, 2.0, 3.0]))
    rows = np.arange(15, 40)
    cut = part(record, rows)
    np.testing.assert_array_equal(
        cut.strength.factor[cut.strength.block], record.strength.factor[record.strength.block][rows]
    )
    assert part(replace(record, strength=STEADY), rows).strength is STEADY
