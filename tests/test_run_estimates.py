"""What one run says of a vehicle's numbers, and how far all have moved: Gaussians, known by Bayes."""

from types import SimpleNamespace

import numpy as np
import pytest

from coax_env.estimation.quadratic import Linearised
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.identification import maximum_likelihood
from coax_env.identification.maximum_likelihood import OwnNumbers, _squared_moves, each_run
from coax_env.identification.undetermined import left_open
from coax_env.plain_words import plain

NAMES = ("mass", "inertia_zz", "arm_upper")
WIDTHS = np.array([0.5, 2.0, 1.0])
MEANS = np.array([1.0, -3.0, 0.2])


def gaussian_runs(rng: np.random.Generator, inform: list[np.ndarray]):
    """A truth of the prior, each run's own best value about it, and the best of all with the prior.

    Returns:
        values by run (r, k), the joint estimate (k,) and its linearisation.
    """
    truth = MEANS + WIDTHS * rng.standard_normal(3)
    own = [rng.multivariate_normal(truth, np.linalg.inv(info)) for info in inform]
    prior = np.diag(WIDTHS**-2.0)
    pull = sum(info @ x for info, x in zip(inform, own, strict=True)) + prior @ MEANS
    joint = np.linalg.solve(sum(inform) + prior, pull)
    slopes = np.array([info @ (joint - x) for info, x in zip(inform, own, strict=True)])
    lin = Linearised(NAMES, np.array(inform), slopes, np.empty(0), np.empty(0))
    return own, joint, lin


def test_a_run_alone_has_its_own_posterior_and_differs_from_all_as_its_std_says():
    """Bayes for one run, and a chi-square that is as large as its degrees on average."""
    rng = np.random.default_rng(3)
    free = [FreeParameter(n, m, s) for n, m, s in zip(NAMES, MEANS, WIDTHS, strict=True)]
    inform = []
    for scale in (1.0, 2.0, 0.7):
        A = rng.standard_normal((6, 3)) * scale * 6.0 / WIDTHS
        inform.append(A.T @ A)
    inform[2] *= np.outer([1.0, 1e-3, 1.0], [1.0, 1e-3, 1.0])  # it says nothing of the second
    engine = SimpleNamespace(records=[SimpleNamespace(name=f"run {k}") for k in range(3)])
    squares, degrees = np.zeros(3), np.zeros(3)
    for draw in range(400):
        own, joint, lin = gaussian_runs(rng, inform)
        found = each_run(engine, free, lin, dict(zip(NAMES, joint, strict=True)), np.ones(3))
        squares += [one.chi_square for one in found]
        degrees += [one.degrees for one in found]
        if draw:
            continue
        for one, info, x in zip(found, inform, own, strict=True):
            posterior = np.linalg.inv(info + np.diag(WIDTHS**-2.0))
            alone = posterior @ (info @ x + MEANS / WIDTHS**2)
            for i, name in enumerate(NAMES):
                std = np.sqrt(posterior[i, i])
                assert (name in one.values) == (std < 0.5 * WIDTHS[i])
                if name in one.values:
                    assert one.values[name] == pytest.approx(alone[i])
                    assert one.std[name] == pytest.approx(std)
        assert [one.degrees for one in found] == [3, 3, 2]
        wide = each_run(engine, free, lin, dict(zip(NAMES, joint, strict=True)), np.full(3, 1.4))
        assert wide[0].std["mass"] == pytest.approx(np.sqrt(1.4) * found[0].std["mass"])
        assert wide[0].chi_square == pytest.approx(found[0].chi_square / 1.4)
    np.testing.assert_allclose(squares / degrees, 1.0, atol=0.15)


def test_a_run_that_is_all_there_is_agrees_with_all():
    """Its difference from the joint fit is then no more than how far that was taken."""
    free = [FreeParameter(n, m, s) for n, m, s in zip(NAMES, MEANS, WIDTHS, strict=True)]
    info = 400.0 * np.diag(WIDTHS**-2.0)
    engine = SimpleNamespace(records=[SimpleNamespace(name="only")])
    off = 0.1 * WIDTHS / np.sqrt(401.0)  # a tenth of a std short of the top
    joint = MEANS + off
    lin = Linearised(NAMES, info[None], (info @ off)[None], np.empty(0), np.empty(0))
    (one,) = each_run(engine, free, lin, dict(zip(NAMES, joint, strict=True)), np.ones(3))
    assert one.chi_square == pytest.approx(3 * 0.1**2 / 0.1) and one.degrees == 3


def test_moves_are_as_large_as_the_flights_determine_them_to_be():
    """Truths of the prior: on average one. Truths of three times its width: nine."""
    rng = np.random.default_rng(4)
    free = [FreeParameter(n, m, s) for n, m, s in zip(NAMES, MEANS, WIDTHS, strict=True)]
    A = rng.standard_normal((5, 3)) * np.array([5.0, 1.0, 0.2]) / WIDTHS
    info, prior = A.T @ A, np.diag(WIDTHS**-2.0)
    posterior = np.linalg.inv(info + prior)
    for wider in (1.0, 3.0):
        ratios = []
        for _ in range(4000):
            away = wider * WIDTHS * rng.standard_normal(3)
            data = info @ away + wider * A.T @ rng.standard_normal(5)
            values = dict(zip(NAMES, MEANS + posterior @ data, strict=True))
            ratios.append(_squared_moves(free, values, posterior))
        assert np.mean(ratios) == pytest.approx(wider**2, rel=0.08)
    half = dict(zip(NAMES, MEANS + 0.5 * WIDTHS, strict=True))
    hardly = _squared_moves(free, half, np.linalg.inv(prior))
    assert hardly == pytest.approx(0.75), "of nothing determined one number's worth is expected"


# --- what is left open ----------------------------------------------------------------------------


def posterior(free: list[FreeParameter], *seen: tuple[np.ndarray, float]) -> np.ndarray:
    """Covariance after readings of combinations, weights in units of the priors, with this std."""
    std = np.array([f.std for f in free])
    rows = [np.outer(w / std, w / std) / spread**2 for w, spread in seen]
    return np.linalg.inv(sum(rows) + np.diag(std**-2.0))


def test_motion_alone_determines_thrust_over_mass_and_neither():
    """Their difference is read to a hundredth: their sum keeps its prior, and so do both numbers."""
    free = [FreeParameter(n, 1.0, s) for n, s in zip(NAMES, WIDTHS, strict=True)]
    tied, alone = np.array([1.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
    undetermined, words = left_open(free, posterior(free, (tied, 0.01), (alone, 0.01)))
    assert undetermined == ("mass", "arm_upper")
    (one,) = words
    assert one.endswith(" together") and plain("mass") in one and plain("arm_upper") in one
    _, words = left_open(free, posterior(free, (np.abs(tied), 0.01), (alone, 0.01)))
    assert " up with " in words[0] and words[0].endswith(" down")


def test_what_all_flights_see_leaves_nothing_open_and_what_none_sees_stays():
    """A number by itself is named, but is no combination; three quarters of the prior is the line."""
    free = [FreeParameter(n, 1.0, s) for n, s in zip(NAMES, WIDTHS, strict=True)]
    axes = np.eye(3)
    assert left_open(free, posterior(free, *((w, 0.05) for w in axes))) == ((), ())
    assert left_open(free, posterior(free, (axes[0], 0.05), (axes[2], 0.05))) == (
        ("inertia_zz",),
        (),
    )
    for kept, named in ((0.72, ()), (0.78, ("mass",))):
        spread = kept / np.sqrt(
            1.0 - kept**2
        )  # of a reading that leaves so much of the prior's std
        seen = [(axes[0], spread), (axes[1], 0.05), (axes[2], 0.05)]
        assert left_open(free, posterior(free, *seen)) == (named, ())


# --- priors that are contradicted -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("widened", "white", "words", "believed"),
    [
        (1.0, True, "", 1.0),
        (1.0, False, "", 1.0),
        (6.5, True, "priors taken 6.5 times as wide", 6.5),
        (6.5, False, "the model lacks something", 1.0),
    ],
)
def test_what_is_said_where_flights_contradict_the_file(
    monkeypatch, widened, white, words, believed
):
    """Nothing where they do not; wide priors only where they leave nothing to explain."""
    asked = []

    def by_turns(engine, free, start, noise, progress, most):
        asked.append(most)
        estimate = SimpleNamespace(values={})
        return OwnNumbers(free, estimate, noise, min(widened, most))

    monkeypatch.setattr(maximum_likelihood, "_by_turns", by_turns)
    monkeypatch.setattr(maximum_likelihood, "is_white", lambda passes, channels: white)
    engine = SimpleNamespace(
        filter=lambda values, noise: [], model=SimpleNamespace(channels=("p",))
    )  # fmt: skip
    found = maximum_likelihood.own_numbers(engine, [], {}, Noise({}), lambda text: None)
    assert found.widened == believed
    assert words in found.remark and bool(found.remark) == bool(words)
    assert len(asked) == (2 if believed < widened else 1)


class Stubborn:
    """An engine whose fits end so many prior std from the file, with given objectives, one by one."""

    def __init__(
        self, moves: list[float], objectives: list[float], determined: float = 1.0
    ) -> None:
        self.moves, self.objectives, self.determined = list(moves), list(objectives), determined
        self.stds: list[float] = []

    def fit(self, free, values, noise, steps, tolerance, progress):
        (f,) = free
        self.stds.append(f.std)
        value = f.value + self.moves.pop(0)
        return SimpleNamespace(
            values={f.name: value}, objective=self.objectives.pop(0),
            covariance=np.array([[(1.0 - self.determined) * f.std**2]]),
        )  # fmt: skip


def by_turns(engine: Stubborn, monkeypatch, most: float = 30.0) -> tuple[OwnNumbers, int]:
    """The numbers, and how often the noise was fitted."""
    fits = []
    monkeypatch.setattr(maximum_likelihood, "fitted_levels", lambda noise: ())
    monkeypatch.setattr(
        maximum_likelihood, "fit_noise", lambda engine, values, noise, *rest: fits.append(1) or noise
    )  # fmt: skip
    free = [FreeParameter("mass", 0.5, 0.01)]
    found = maximum_likelihood._by_turns(
        engine, free, {"mass": 0.5}, Noise({}), lambda text: None, most
    )  # fmt: skip
    return found, len(fits)


def test_numbers_and_noise_take_turns_until_a_turn_gains_less_than_a_nat(monkeypatch):
    engine = Stubborn([0.01, 0.012, 0.012, 0.0], [90.0, 88.9, 88.0, 0.0])
    found, noise_fits = by_turns(engine, monkeypatch)
    assert found.widened == 1.0 and found.estimate.objective == 88.0 and noise_fits == 2


def test_priors_are_widened_to_twice_what_the_moves_are(monkeypatch):
    """A move of three std where one is expected: six times as wide, and the turns begin anew."""
    engine = Stubborn([0.03, 0.03, 0.03], [90.0, 200.0, 199.5])
    found, _ = by_turns(engine, monkeypatch)
    assert found.widened == pytest.approx(6.0)
    assert engine.stds == pytest.approx([0.01, 0.06, 0.06])
    assert found.free[0].std == pytest.approx(0.06)


@pytest.mark.parametrize(("move", "widened"), [(0.0199, 1.0), (0.0201, 4.02)])
def test_twice_the_expected_move_is_still_believed(monkeypatch, move, widened):
    """A square of four: from there on the file's std count as too small."""
    found, _ = by_turns(Stubborn([move] * 4, [9.0] * 4), monkeypatch)
    assert found.widened == pytest.approx(widened)


def test_priors_are_widened_no_farther_than_allowed(monkeypatch):
    found, _ = by_turns(Stubborn([0.5] * 8, [9.0] * 8), monkeypatch, most=5.0)
    assert found.widened == pytest.approx(5.0)
    believed, _ = by_turns(Stubborn([0.5] * 8, [9.0] * 8), monkeypatch, most=1.0)
    assert believed.widened == 1.0
