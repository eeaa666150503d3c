"""How generic terms are screened, weighed and stated, on histories and likelihoods made by hand."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env import load_vehicle
from coax_env.diagnosis import unlisted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.settings import SETTINGS
from coax_env.diagnosis.unlisted import PAIRS, SINGLES, TermHistory, name
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Noise
from coax_env.model.generic_terms import AXES, SMALLEST, TERMS

MODEL = HeliModel(load_vehicle("lama400d"))
NONE = Noise({})
KEYS = {t.key: k for k, t in enumerate(TERMS)}


def history(seed: int = 0, n: int = 4000) -> TermHistory:
    """Independent terms of std 1 about 3, and no gusts."""
    values = 3.0 + np.random.default_rng(seed).standard_normal((n, len(TERMS)))
    return TermHistory(values, np.zeros((n, 6)))


def with_gust(axis: str, load: np.ndarray, made: TermHistory) -> TermHistory:
    gusts = made.gusts.copy()
    gusts[:, list(AXES).index(axis)] = load
    return TermHistory(made.values, gusts)


# --- screened -----------------------------------------------------------------------------------------


def test_a_share_is_what_columns_explain_beside_a_constant():
    """R^2: 0.8 of it by one column, the offset by none."""
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, 20_000))
    y = 50.0 + 2.0 * a + b
    assert unlisted._share(a[:, None], y) == pytest.approx(0.8, abs=0.01)
    assert unlisted._share(np.column_stack([a, b]), y) == pytest.approx(1.0)


def test_terms_that_explain_most_of_an_axis_are_screened_best_first():
    """Four tenths at least; one of a pair is looked at with the other too; what is known is not."""
    made = history()
    u = made.values[:, KEYS["u"]]
    rest = np.random.default_rng(2).standard_normal(u.size)
    problem = SimpleNamespace(settings=SETTINGS)

    def found(gust: np.ndarray, known: tuple[str, ...] = ()) -> list[Any]:
        return unlisted._screen(problem, with_gust("unlisted_X", gust, made), "unlisted_X", known)

    assert ("unlisted_X", (TERMS[KEYS["u"]],)) == found(u + 0.5 * rest)[0]
    assert found(u + 1.3 * rest) == [], "R^2 of 0.37"
    assert found(u + 1.15 * rest) != [], "R^2 of 0.43"
    assert found(u + 0.5 * rest, ("unlisted_X.u",)) == []
    pair = next(pair for pair in PAIRS)
    both = sum(made.values[:, KEYS[t.key]] for t in pair)
    best = found(both)
    assert best[0] == ("unlisted_X", pair) and {("unlisted_X", (t,)) for t in pair} <= set(best)
    still = TermHistory(np.ones_like(made.values), made.gusts)
    assert unlisted._screen(problem, with_gust("unlisted_X", u, still), "unlisted_X", ()) == []
    assert len(SINGLES) == len(TERMS)


def test_the_first_second_of_a_run_is_not_screened(monkeypatch):
    """Terms at the filtered states and inputs of each row from then on, gusts beside them."""
    asked = []

    def evaluate(states: np.ndarray, inputs: np.ndarray, p: np.ndarray, out: np.ndarray) -> None:
        asked.append((len(states), len(inputs)))
        out[:] = states[:, :1]

    monkeypatch.setattr(unlisted, "_evaluate", evaluate)
    t = 8.0 + 0.1 * np.arange(31)
    states = np.arange(31.0)[:, None] + 0.01 * np.arange(29)
    run = SimpleNamespace(record=SimpleNamespace(t=t), states=states, inputs=np.zeros((31, 5)))
    problem = SimpleNamespace(model=SimpleNamespace(vector=lambda values: np.zeros(3)))
    made = TermHistory.of(problem, Fit((), {}, NONE), [run, run])
    assert asked == [(20, 20)] * 2 and made.values.shape == (40, len(TERMS))
    np.testing.assert_array_equal(made.values[:20, 0], np.arange(11.0, 31.0))
    np.testing.assert_allclose(made.gust("unlisted_Y"), made.values[:, 0] + 0.21)


def test_excitation_is_the_time_integral_of_squares_about_the_mean(monkeypatch):
    """Of every single term, run by run; about the mean over all runs, whatever follows several."""

    def evaluate(states: np.ndarray, inputs: np.ndarray, p: np.ndarray, out: np.ndarray) -> None:
        out[:] = states[:, :1] * (1.0 + np.arange(len(TERMS)))

    monkeypatch.setattr(unlisted, "_evaluate", evaluate)
    model = SimpleNamespace(vector=lambda values: None)
    runs = [
        SimpleNamespace(record=SimpleNamespace(t=start + 0.1 * np.arange(n)),
                        states=np.full((n, 1), size), inputs=None)
        for start, n, size in ((5.0, 30, 1.0), (90.0, 10, 5.0))
    ]  # fmt: skip
    found = unlisted.excitation(model, {}, runs)
    assert set(found) == {t.follows[0] for t in TERMS if len(t.follows) == 1}
    for followed, table in found.items():
        own = [
            k for k, t in enumerate(TERMS) if t.follows == (followed,) or t.follows == [followed]
        ]
        assert table.shape == (2, len(own))
        scale = (1.0 + np.array(own)) ** 2
        np.testing.assert_allclose(table[0], 3.0 * 1.0 * scale, rtol=1e-9)
        np.testing.assert_allclose(table[1], 1.0 * 9.0 * scale, rtol=1e-9)


# --- weighed ------------------------------------------------------------------------------------------

ONE, TWO = ("unlisted_M", (TERMS[KEYS["u"]],)), ("unlisted_M", (TERMS[KEYS["v"]],))


def weighed(slope: float, nats: float, white: bool = False) -> Any:
    """`_best` of two candidates whose slopes are a std's, the second's half as much."""
    mass = next(f for f in MODEL.base_parameters() if f.name == "mass")
    problem = Problem(MODEL, None, (mass,), {})  # type: ignore[arg-type]
    own = [f for c in (ONE, TWO) for f in unlisted.parameters(MODEL, *c)]
    free = [mass, *own]
    std = np.array([f.std for f in free])
    g = np.array([0.0, slope, 0.5 * slope]) / std
    G = np.diag([1e4, 99.0, 99.0]) / np.outer(std, std)
    at = np.array([f.value for f in free])
    none = np.full(3, np.inf)
    q = Quadratic(tuple(f.name for f in free), G, g, at, at, std**-2.0, -none, none,
                  np.zeros((4, 3)), np.ones((3, 18)))  # fmt: skip

    def linearise(wider: Problem, fit: Fit) -> Any:
        assert [f.name for f in wider.added] == [f.name for f in own]
        return fit, [], q

    keep = unlisted.linearise
    unlisted.linearise = linearise  # type: ignore[assignment]
    try:
        needed = {ONE: nats, TWO: 0.0 if white else nats}
        return unlisted._best(problem, Fit((), {}, NONE), needed)
    finally:
        unlisted.linearise = keep


def test_the_best_candidate_gains_most_beyond_what_it_needs():
    """A slope of s over an information of 99 and the prior's 1: s^2/200, less log(100)/2."""
    slope, occam = 100.0, 0.5 * np.log(100.0)
    gain = slope**2 / 200.0 - occam
    assert weighed(slope, gain - 0.01) == (ONE, pytest.approx(gain - 0.01))
    assert weighed(slope, gain + 0.01) is None
    assert weighed(slope, gain + 0.01, white=True) == (TWO, 0.0)
    assert unlisted._best(None, None, {}) is None  # type: ignore[arg-type]


def test_a_load_matters_from_its_smallest_size_on():
    """By its std over the flight: an offset is none."""
    made = history()
    smallest = SMALLEST[AXES["unlisted_M"][0]]
    column = made.values[:, KEYS["u"]]
    for share, matters in ((1.02, True), (0.98, False)):
        values = {"unlisted_M.u": share * smallest / column.std()}
        assert unlisted._matters(MODEL, made, ONE, values) == matters


@pytest.mark.parametrize(
    ("fallen", "inflation", "large", "taken"),
    [(40.0, 1.0, True, True), (40.0, 1.0, False, False), (40.0, 1.6, True, False),
     (33.5, 1.0, True, True), (32.5, 1.0, True, False)],
)  # fmt: skip
def test_a_term_is_taken_where_its_fit_gains_what_it_needs(
    monkeypatch, fallen, inflation, large, taken
):
    """What the objective falls, over the inflation, less Occam's 5 nats: 28 are needed."""
    q = SimpleNamespace(variance_inflation=lambda own, free: inflation, occam=lambda own, rest: 5.0)
    monkeypatch.setattr(
        unlisted, "fitted", lambda problem, fit, steps: replace(fit, objective=500.0 - fallen)
    )
    monkeypatch.setattr(unlisted, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(unlisted, "linearise", lambda problem, fit: (fit, [], q))
    monkeypatch.setattr(unlisted.TermHistory, "of", lambda *given: None)
    monkeypatch.setattr(unlisted, "_matters", lambda *given: large)
    problem = Problem(MODEL, None, (), {})  # type: ignore[arg-type]
    found = unlisted._with(problem, Fit((), {}, NONE, objective=500.0), ONE, 28.0)
    assert (found is not None) == taken
    if found is not None:
        wider, fit = found
        assert [f.name for f in wider.added] == ["unlisted_M.u"]
        assert fit.history[-1][1] == pytest.approx(fallen / inflation - 5.0)


@pytest.mark.parametrize(("loss", "kept"), [(34.0, True), (32.0, False)])
def test_a_term_that_causes_have_made_worthless_is_dropped(monkeypatch, loss, kept):
    """What the quadratic loses without it, half as much by its inflation, less 5 nats: 28 needed."""
    asked = []

    def best(free: Any, fixed: Any = None) -> tuple[float, None]:
        asked.append((list(free), fixed))
        return (2.0 * loss - 7.0 if fixed else -7.0), None

    q = SimpleNamespace(
        best=best, variance_inflation=lambda own, free: 2.0, occam=lambda own, rest: 5.0
    )  # fmt: skip
    monkeypatch.setattr(unlisted, "fitted", lambda problem, fit: fit)
    monkeypatch.setattr(unlisted, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(unlisted, "linearise", lambda problem, fit: (fit, [], q))
    problem = Problem(MODEL, None, (), {}).with_free(unlisted.parameters(MODEL, *ONE))  # type: ignore
    fit = Fit((), {"unlisted_M.u": 0.3}, NONE)
    left, after, _, taken = unlisted._pruned(problem, fit, q, [ONE])  # type: ignore[arg-type]
    assert asked == [(["unlisted_M.u"], None), ([], {"unlisted_M.u": 0.0})]
    assert (taken == [ONE]) == kept and bool(left.added) == kept
    assert after.values["unlisted_M.u"] == (0.3 if kept else 0.0)


# --- stated -------------------------------------------------------------------------------------------


def test_an_entry_says_which_share_of_the_disturbance_the_terms_are():
    """Load and rest independent, of variances 4 and 1: four fifths; channels and forms beside it."""
    made = history(n=200_000)
    rest = np.random.default_rng(5).standard_normal(200_000)
    made = with_gust("unlisted_M", rest, made)
    q = SimpleNamespace(
        covariance=lambda names: np.eye(2) * 0.01, variance_inflation=lambda *g: 1.0
    )
    names = [name(*("unlisted_M", t)) for t in (TERMS[KEYS["u"]], TERMS[KEYS["v"]])]
    problem = SimpleNamespace(free_names=lambda active: names)
    fit = Fit((), dict(zip(names, (1.6, -1.2), strict=True)), NONE)
    terms = [TERMS[KEYS["u"]], TERMS[KEYS["v"]]]
    entry = unlisted._entry(problem, fit, q, made, "unlisted_M", terms)
    assert entry["share"] == pytest.approx(0.8, abs=0.005)
    assert entry["channel"] == "q" and entry["depends_on"] == ["u", "v"]
    assert entry["form"] == "(1.6 ± 0.1) u + (-1.2 ± 0.1) v [N m]"
    worse = Fit((), dict(zip(names, (0.0, 0.0), strict=True)), NONE)
    assert unlisted._entry(problem, worse, q, made, "unlisted_M", terms)["share"] == 0.0


def test_coefficients_are_believed_up_to_five_usual_sizes():
    (f,) = unlisted.parameters(MODEL, *ONE)
    assert f.name == "unlisted_M.u" and f.value == 0.0
    assert f.upper == -f.lower == pytest.approx(5.0 * f.std)
