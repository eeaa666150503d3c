"""The log-posterior to second order: least values, covariances and factors known without the code.

Least values by scipy.optimize, Occam's factor by numerical integration, covariances by linear
regression, the variance inflation by the long-run variance of an AR(1) process.
"""

import math

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.stats import chi2

from coax_env.estimation.quadratic import Linearised, Quadratic, penalty
from coax_env.estimation.state_space import FreeParameter

NAMES = ("a", "b", "c", "d", "e")
variance_inflation = Quadratic.variance_inflation
KEPT = 0.9  # share of the blocks that it looks at, the smallest


def quadratic(seed: int = 0, bound: float = np.inf, **other: object) -> Quadratic:
    """A random one in five parameters, away from the priors' means."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((9, 5))
    at = rng.standard_normal(5)
    given = {
        "names": NAMES, "G": A.T @ A, "g": 3.0 * rng.standard_normal(5), "at": at,
        "mean": at + rng.standard_normal(5), "precision": rng.uniform(0.5, 3.0, 5),
        "lower": at - bound, "upper": at + bound, "scores": np.zeros((4, 5)),
        "by_channel": np.zeros((5, 2)),
    } | other  # fmt: skip
    return Quadratic(*given.values())


def objective(q: Quadratic, x: np.ndarray) -> np.ndarray:
    """Minus log-likelihood to second order and the priors' penalty, at parameters x (..., n)."""
    away = x - q.at
    likelihood = 0.5 * np.sum((away @ q.G) * away, axis=-1) + away @ q.g
    return likelihood + 0.5 * np.sum(q.precision * (x - q.mean) ** 2, axis=-1)


# --- least values ---------------------------------------------------------------------------------


@pytest.mark.parametrize("bound", [np.inf, 0.3])
@pytest.mark.parametrize("free", [("a", "c", "d"), NAMES, ("e",), ()])
@pytest.mark.parametrize("pinned", [{}, {"b": 0.7}])
def test_the_best_is_scipys(bound, free, pinned):
    """Free parameters at their best within bounds, pinned ones where they are put, others held."""
    free = [name for name in free if name not in pinned]
    for seed in range(3):
        q = quadratic(seed, bound)
        x0 = q.at.copy()
        for name, value in pinned.items():
            x0[NAMES.index(name)] = value
        freed = [NAMES.index(name) for name in free]

        def cost(y, q=q, x0=x0, freed=freed):
            x = x0.copy()
            x[freed] = y
            return objective(q, x)

        least = cost(x0[freed])
        expected = x0.copy()
        if freed:
            bounds = list(zip(q.lower[freed], q.upper[freed], strict=True))
            found = minimize(cost, x0[freed], method="L-BFGS-B", bounds=bounds,
                             options={"ftol": 1e-15, "gtol": 1e-10})  # fmt: skip
            least, expected[freed] = found.fun, found.x
        change, move = q.best(free, pinned)
        assert change == pytest.approx(least - objective(q, q.at), abs=1e-7)
        np.testing.assert_allclose(q.at + move, expected, atol=1e-4)


def test_it_is_summed_over_the_runs_of_a_linearisation():
    rng = np.random.default_rng(1)
    lin = Linearised(
        names=("a", "b"), information=rng.standard_normal((3, 2, 2)),
        slope=rng.standard_normal((3, 2)), by_channel=rng.standard_normal((3, 2, 4)),
        **{name: rng.standard_normal((7, 2)) for name in list(Linearised.__annotations__)[4:]},
    )  # fmt: skip
    free = [FreeParameter("a", 1.0, 0.5, -2.0, 2.0), FreeParameter("b", 3.0, 4.0)]
    q = Quadratic.of(lin, free, {"a": 0.2, "b": 0.3})
    np.testing.assert_allclose(q.G, sum(lin.information))
    np.testing.assert_allclose(q.g, sum(lin.slope))
    np.testing.assert_allclose(q.by_channel, sum(lin.by_channel))
    np.testing.assert_allclose(q.at, [0.2, 0.3])
    np.testing.assert_allclose(q.mean, [1.0, 3.0])
    np.testing.assert_allclose(q.precision, [4.0, 1.0 / 16.0])
    np.testing.assert_allclose(q.lower, [-2.0, -np.inf])
    np.testing.assert_allclose(q.upper, [2.0, np.inf])
    assert q.names == ("a", "b")


def test_a_move_is_added_to_where_it_was_taken():
    q = quadratic(4)
    move = np.array([0.5, 0.0, -1.0, 2.0, 0.1])
    assert q.moved(move) == pytest.approx(dict(zip(NAMES, q.at + move, strict=True)))


def test_a_penalty_is_half_the_squared_distance_in_prior_widths():
    free = [FreeParameter("a", 1.0, 0.5), FreeParameter("b", -3.0, 4.0)]
    assert penalty(free, {"a": 2.5, "b": 1.0, "other": 9.0}) == pytest.approx(0.5 * (9.0 + 1.0))


# --- what the data determine -------------------------------------------------------------------------


@pytest.mark.slow
def test_the_covariance_is_the_error_of_a_bayesian_regression():
    """Truths drawn from the prior, data from them: the best differs from the truth by as much."""
    rng = np.random.default_rng(2)
    prior_std = np.array([0.5, 1.0, 2.0])
    X = rng.standard_normal((8, 3)) @ np.array([[1, 0.7, 0], [0, 1, 0.5], [0, 0, 1]])
    errors = []
    for _ in range(4000):
        truth = prior_std * rng.standard_normal(3)
        y = X @ truth + rng.standard_normal(8)
        q = quadratic(names=("a", "b", "c"), G=X.T @ X, g=-X.T @ y, at=np.zeros(3),
                      mean=np.zeros(3), precision=prior_std**-2, lower=np.full(3, -np.inf),
                      upper=np.full(3, np.inf))  # fmt: skip
        errors.append(q.best(("a", "b", "c"))[1] - truth)
    covariance = q.covariance(("a", "b", "c"))
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(np.cov(np.array(errors).T) / scale, covariance / scale, atol=0.06)
    stacked = np.vstack([X, np.diag(1.0 / prior_std)])  # the priors as readings of their own
    np.testing.assert_allclose(covariance, np.linalg.inv(stacked.T @ stacked), rtol=1e-9)
    swapped = q.covariance(("c", "a"))
    np.testing.assert_allclose(
        swapped,
        covariance[np.ix_([2, 0], [2, 0])]
        - np.outer(covariance[[2, 0], 1], covariance[1, [2, 0]]) / covariance[1, 1],
    )  # fmt: skip  - b held: conditioned on it


def test_projected_information_is_that_beside_the_rest_under_its_priors():
    """The inverse of the own block of the inverse; the weights are how the rest answers."""
    q = quadratic(5)
    own, rest = ["b", "d"], ["e", "a"]
    information, weights = q.projected(own, rest)
    i = [1, 3, 4, 0]
    whole = q.G[np.ix_(i, i)] + np.diag([0.0, 0.0, q.precision[4], q.precision[0]])
    np.testing.assert_allclose(information, np.linalg.inv(np.linalg.inv(whole)[:2, :2]), rtol=1e-9)
    flat = quadratic(5, g=np.zeros(5), mean=q.at)  # at its own least
    for column, name in enumerate(own):
        _, move = flat.best(rest, {name: q.at[NAMES.index(name)] + 1.0})
        np.testing.assert_allclose(move[[4, 0]], -weights[:, column], rtol=1e-9)
    alone, none = q.projected(own, [])
    np.testing.assert_allclose(alone, q.G[np.ix_([1, 3], [1, 3])])
    assert none.shape == (0, 2)


@pytest.mark.slow
def test_occams_factor_is_the_integral_over_the_prior():
    """log of the ratio of the evidences is what the fit gains less the factor: all is Gaussian."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        A = rng.standard_normal((4, 2)) * 1.5
        q = quadratic(names=("a", "b"), G=A.T @ A, g=rng.standard_normal(2), at=np.zeros(2),
                      mean=np.zeros(2), precision=np.array([2.0, 0.7]),
                      lower=np.full(2, -np.inf), upper=np.full(2, np.inf))  # fmt: skip

        # by rectangles, exact of a Gaussian a few steps wide
        step = 0.04
        places = np.arange(-12.0, 12.0, step)
        x = np.stack(np.meshgrid(places, places), axis=-1)
        prior = math.sqrt(np.prod(q.precision)) / (2.0 * math.pi)
        both = math.log(prior * step**2 * np.exp(-objective(q, x)).sum())
        gained = -q.best(("a", "b"))[0]
        assert gained - q.occam(("a", "b"), ()) == pytest.approx(both, abs=1e-6)
        # beside a parameter that is fitted in either case: the ratio of the two evidences
        alone = 0.5 * q.g[1] ** 2 / (q.G[1, 1] + 0.7) - 0.5 * math.log(1.0 + q.G[1, 1] / 0.7)
        beside = q.best(("b",))[0] - q.best(("a", "b"))[0]
        assert beside - q.occam(("a",), ("b",)) == pytest.approx(both - alone, abs=1e-6)


def test_what_the_data_do_not_see_costs_nothing_and_what_they_do_costs_its_narrowing():
    """An interval that becomes k times narrower than the prior costs log k."""
    G = np.diag([0.0, 99.0, 3.0, 0.0, 0.0])
    q = quadratic(G=G, precision=np.array([1.0, 1.0, 1.0, 5.0, 5.0]))
    assert q.occam(["a"], ["d"]) == pytest.approx(0.0, abs=1e-12)
    assert q.occam(["b"], []) == pytest.approx(math.log(10.0))
    assert q.occam(["b", "c"], ["e"]) == pytest.approx(math.log(20.0))


# --- coloured innovations ----------------------------------------------------------------------------


def scored(rho: float, blocks: int = 3000, length: int = 200, seed: int = 0) -> Quadratic:
    """Scores of two parameters seen through regressors, the noise AR(1) of unit variance.

    The second parameter's regressor is partly the first's: their scores go together.
    """
    rng = np.random.default_rng(seed)
    n = blocks * length
    noise = math.sqrt(1.0 - rho**2) * rng.standard_normal(n)
    noise = lfilter([1.0], [1.0, -rho], noise)
    X = np.column_stack([np.ones(n), 0.8 * np.ones(n) + 0.6 * np.tile([1.0, -1.0], n // 2)])
    scores = (X * noise[:, None]).reshape(blocks, length, 2).sum(1)
    none = np.zeros(2)
    return Quadratic(("a", "b"), X.T @ X, none, none, none, np.full(2, 1e-9), none - 9, none + 9,
                     scores, np.zeros((2, 1)))  # fmt: skip


def trimmed(k: int) -> float:
    """Mean of the smallest nine tenths of chi-squared values with k degrees of freedom, over k."""
    return float(chi2.cdf(chi2.ppf(KEPT, k), k + 2)) / KEPT


@pytest.mark.parametrize("rho", [0.5, 0.8])
def test_the_inflation_is_the_long_run_variance_of_the_scores(rho):
    """(1 + rho)/(1 - rho) for a constant regressor, the other way round for an alternating one."""
    q = scored(rho)
    slow = (1.0 + rho) / (1.0 - rho)
    assert variance_inflation(q, ["a"], ["a"]) == pytest.approx(slow * trimmed(1), rel=0.1)
    # beside the first one only the alternating part of the second's is left: its scores are quiet
    assert variance_inflation(q, ["b"], ["a", "b"]) == 1.0
    # and beside nothing both parts count, each by its share of the information
    fast = 1.0 / slow
    both = 0.64 * slow + 0.36 * fast
    assert variance_inflation(q, ["b"], ["b"]) == pytest.approx(both * trimmed(1), rel=0.1)
    together = variance_inflation(q, ["a", "b"], ["a", "b"])
    assert 0.3 * slow < together < 0.6 * slow  # half of two directions is slow; trimmed


def test_white_scores_are_not_inflated_and_one_bad_block_is_no_correlation():
    q = scored(0.0)
    assert variance_inflation(q, ["a"], ["a", "b"]) == 1.0
    q = scored(0.5, blocks=300)
    before = variance_inflation(q, ["a"], ["a"])
    scores = list(vars(q).values())[8]
    scores[:10] *= 100.0
    assert variance_inflation(q, ["a"], ["a"]) == pytest.approx(before, rel=0.15)


def test_scores_that_are_no_numbers_inflate_nothing():
    q = scored(0.5, blocks=20)
    list(vars(q).values())[8][:] = np.inf
    with np.errstate(invalid="ignore"):
        assert variance_inflation(q, ["a"], ["a"]) == 1.0


def test_the_inflation_does_not_depend_on_how_a_group_is_written():
    q = scored(0.7, blocks=400)
    T = np.array([[1.0, 0.4], [-2.0, 3.0]])
    fields = list(vars(q).values())
    fields[1], fields[8] = T.T @ q.G @ T, fields[8] @ T
    turned = Quadratic(*fields)
    assert variance_inflation(turned, ["a", "b"], ["a", "b"]) == pytest.approx(
        variance_inflation(q, ["a", "b"], ["a", "b"]), rel=1e-9
    )
