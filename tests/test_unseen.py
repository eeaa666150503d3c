"""What a cause is worth on runs that were not fitted, on regressions whose truth is known.

Linear in white noise, drawn here: what it should be worth, and by how much that scatters, is then a
matter of the normal distribution.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from test_trust import EFFECTS, NAMES, drawn, fitted_to, problem_of

from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.fits import without
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.unseen import BY_CHANCE, Unseen, worth_unseen
from coax_env.estimation.engine import Engine
from coax_env.estimation.quadratic import Linearised, Quadratic
from coax_env.estimation.state_space import Noise

ONE, TWO = EFFECTS[:2]
ONE_OF = NAMES[0]
RUNS = 8


class Held(Engine):
    """An engine over a held-out run: readings y (n,) on columns X (n, 4) in white noise of std 1."""

    def __init__(self, X: np.ndarray, y: np.ndarray) -> None:
        self.X, self.y = X, y

    def linearise(self, values, noise, free, gains):
        G = self.X[:, self._which(free)].T @ self.X[:, self._which(free)]
        none = np.zeros((1, len(free)))
        return [], Linearised(tuple(f.name for f in free), G[None], none, none[..., None], none)

    def log_likelihood(self, values, noise):
        left = self.y - self.X @ np.array(list(values.values()))
        return -0.5 * float(left @ left)

    @staticmethod
    def _which(free) -> list[int]:
        every = [f.name for f in problem_of(1).parameters]
        return [every.index(f.name) for f in free]


def of_no_colour(
    problem: Problem, fit: Fit, quadratic: Quadratic, worth: dict[str, float]
) -> dict[str, Evidence]:
    """Evidence with the fits without each cause, by what is lost then."""
    found = {}
    for effect in fit.active:
        rest = without(problem, fit, quadratic, effect)
        rest = replace(rest, objective=worth[effect])
        found[effect] = Evidence(worth[effect], 1.0, rest=rest)
    return found


def worth(rng: np.random.Generator, size: float, size_unseen: float) -> Unseen:
    """Of the first of two effects, of one size on the fitted runs and another on the held-out one."""
    sizes = [size] * RUNS + [size_unseen]
    designs, y = drawn(rng, sizes, [1.0] * len(sizes), len(sizes))
    # a number that stays where it is, with the effect and without
    y = [target + 3.0 * X[:, 0] for X, target in zip(designs, y, strict=True)]
    problem = problem_of(RUNS)
    fit, quadratic, known = fitted_to(problem, designs[:RUNS], y[:RUNS], (ONE, TWO))
    evidence = of_no_colour(problem, fit, quadratic, known)
    return worth_unseen(problem, fit, quadratic, evidence, Held(designs[-1], y[-1]))[ONE]


def one_effect(seed: int) -> tuple[Problem, Fit, Quadratic, dict[str, float], Held]:
    """A fit with one effect, what it is worth, and a run like those that were fitted."""
    designs, y = drawn(np.random.default_rng(seed), [1.0] * RUNS, [1.0] * RUNS)
    problem = problem_of(RUNS)
    return problem, *fitted_to(problem, designs, y, (ONE,)), Held(designs[0], y[0])


def test_what_it_is_worth_scatters_as_said_about_what_it_should_be():
    """200 draws of a cause worth 100 nats on the eight runs that were fitted, 12.5 on the other."""
    rng = np.random.default_rng(4)
    size = math.sqrt(2.0 * 100.0 / (100.0 * RUNS))
    found = [worth(rng, size, size) for _ in range(200)]
    z = np.array([(one.nats - one.expected) / one.std for one in found])
    assert np.mean([one.expected for one in found]) == pytest.approx(12.5, rel=0.1)
    assert abs(z.mean()) < 3.0 / math.sqrt(z.size)
    assert z.std() == pytest.approx(1.0, abs=3.0 / math.sqrt(2.0 * z.size))
    assert np.mean([one.denied for one in found]) < norm.cdf(-BY_CHANCE) + 0.03


def test_what_is_not_there_is_denied_where_it_should_show():
    rng = np.random.default_rng(5)
    size = math.sqrt(2.0 * 250.0 / (100.0 * RUNS))  # 31 nats are to be expected
    found = [worth(rng, size, 0.0) for _ in range(50)]
    assert np.mean([one.denied for one in found]) > 0.9
    little = [worth(rng, 0.1 * size, 0.0) for _ in range(50)]
    assert not any(one.denied for one in little), "the run does not show it"


def test_of_two_causes_one_was_there_in_the_held_out_runs():
    rng = np.random.default_rng(6)
    designs, y = drawn(rng, [1.0] * (RUNS + 1), [1.0] * (RUNS + 1), RUNS + 1)
    y = [target + X[:, 2] for X, target in zip(designs, y, strict=True)]
    y[-1] = y[-1] - designs[-1][:, 2]  # the second one is gone
    problem = problem_of(RUNS)
    fit, quadratic, known = fitted_to(problem, designs[:RUNS], y[:RUNS], (ONE, TWO))
    evidence = of_no_colour(problem, fit, quadratic, known)
    found = worth_unseen(problem, fit, quadratic, evidence, Held(designs[-1], y[-1]))
    assert found[TWO].denied and found[TWO].likelier_without
    assert not found[ONE].denied and not found[ONE].likelier_without


@pytest.mark.parametrize(
    ("nats", "expected", "std", "denied"),
    [
        (0.9, 12.2, 5.2, True),  # a centre of gravity that is not there (**synthetic**, clean)
        (-6.3, 3.2, 2.7, True),  # another, for what is in no list
        (-1.6, 0.3, 0.8, False),  # a dynamic inflow that is: the run does not show it
        (0.7, 4.0, 2.9, False),  # an upper rotor's blow-back that is: by chance
        (4.0, 40.0, 5.0, False),  # it is worth something
    ],
)
def test_what_is_denied(nats, expected, std, denied):
    assert Unseen(nats, expected, std).denied == denied


def test_coloured_innovations_make_it_scatter_more():
    assert Unseen(-1.0, 12.0, 5.0).denied and not Unseen(-1.0, 12.0, 7.0).denied
    problem, fit, quadratic, known, held = one_effect(7)
    evidence = of_no_colour(problem, fit, quadratic, known)
    coloured = [{ONE: replace(evidence[ONE], inflation=factor)} for factor in (1.0, 4.0)]
    of = [worth_unseen(problem, fit, quadratic, one, held)[ONE] for one in coloured]
    assert of[0].std < of[1].std < 2.0 * of[0].std


def test_what_other_noise_takes_up_is_not_expected():
    """Noise levels without the cause are fitted, and leave a third of what it is worth."""
    problem, fit, quadratic, known, held = one_effect(8)
    worth_of = [{ONE: share * known[ONE]} for share in (1.0, 1.0 / 3.0, 2.0)]
    evidence = [of_no_colour(problem, fit, quadratic, worth) for worth in worth_of]
    of = [worth_unseen(problem, fit, quadratic, one, held)[ONE] for one in evidence]
    assert of[1].expected == pytest.approx(of[0].expected / 3.0) and of[1].std < of[0].std
    assert of[2].expected == pytest.approx(of[0].expected, rel=0.01), "no more than runs show"


@pytest.mark.parametrize("diverging", ["with", "without"])
def test_where_a_filter_diverges_nothing_is_said(monkeypatch, diverging):
    problem, fit, quadratic, known, held = one_effect(9)

    def log_likelihood(values, noise):
        return -math.inf if (values[ONE_OF] != 0.0) == (diverging == "with") else -1.0

    monkeypatch.setattr(held, "log_likelihood", log_likelihood)
    evidence = of_no_colour(problem, fit, quadratic, known)
    assert worth_unseen(problem, fit, quadratic, evidence, held) == {}


def test_of_what_explains_nothing_nothing_is_expected():
    problem, fit, quadratic, _, held = one_effect(10)
    evidence = of_no_colour(problem, fit, quadratic, {ONE: -1.0})
    found = worth_unseen(problem, fit, quadratic, evidence, held)[ONE]
    assert found.expected == found.std == 0.0 and not found.denied


def test_of_nothing_held_out_nothing_is_said():
    none = worth_unseen(problem_of(1), Fit((ONE,), {}, Noise({})), None, {}, None)  # type: ignore[arg-type]
    assert none == {}
