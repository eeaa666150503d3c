"""Where a cause is worth its nats, on regressions whose truth is known.

Readings are one column times a size, in white noise drawn here; the column is large in a few rows, as
where commands are. What acts has one size; what a pilot's answers look like is in quiet rows alone.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.where_shown import (
    BLOCK,
    BY_CHANCE,
    FORM,
    HALF,
    MOST,
    SizeWhereMost,
    beyond_even_spread,
    size_where_most,
)
from coax_env.estimation.engine import ByReading
from coax_env.estimation.parted_engine import PartedEngine
from coax_env.estimation.state_space import Noise

NOISE, OTHER = Noise({"force": 1.0}), Noise({"force": 2.0})
ROW = 0.01  # s
RUNS, ROWS = 4, 1000
QUIET, LOUD = 0.2, 1.0
LOUD_ROWS = slice(200, 250)  # one block of each run


class Runs:
    """An engine over runs whose readings are `y` (n,); a model foretells size times `column` (n,).

    `offset`: nats that the noise without the cause gives each row, or each of a run's.
    """

    def __init__(
        self, columns: list[np.ndarray], y: list[np.ndarray], offset: float | np.ndarray = 0.0
    ) -> None:
        self.columns, self.y, self.offset = columns, y, offset
        self.records = [SimpleNamespace(t=5.0 + ROW * np.arange(c.size)) for c in columns]

    def by_reading(self, values: Any, noise: Noise) -> list[ByReading]:
        found = []
        for column, y in zip(self.columns, self.y, strict=True):
            e = y - values["size"] * column
            more = self.offset if noise is OTHER else 0.0
            e = np.where(np.isnan(more), np.nan, e)
            missing = np.full(e.shape, np.nan)  # a channel that is not read
            pair = (np.stack((e, missing), 1), np.stack((more - 0.5 * e * e, missing), 1))
            found.append(ByReading(*pair))
        return found


def column() -> np.ndarray:
    """Loud in one block of twenty, and quiet elsewhere."""
    found = np.full(ROWS, QUIET)
    found[LOUD_ROWS] = LOUD
    return found


def flown(
    seed: int, quiet: float = 1.0, loud: float = 1.0, offset: float | np.ndarray = 0.0
) -> tuple[Any, Fit, Fit, float]:
    """Of one size in quiet rows and one in loud ones: the problem, the fit, that without, and the nats
    of the cause."""
    rng = np.random.default_rng(seed)
    columns = [column() for _ in range(RUNS)]
    sizes = np.full(ROWS, quiet)
    sizes[LOUD_ROWS] = loud
    y = [sizes * c + rng.standard_normal(ROWS) for c in columns]
    along = float(sum(c @ own for c, own in zip(columns, y, strict=True)))
    square = float(sum(c @ c for c in columns))
    problem = SimpleNamespace(engine=Runs(columns, y, offset))
    fit = Fit(("one",), {"size": along / square}, NOISE)
    return problem, fit, Fit((), {"size": 0.0}, OTHER), 0.5 * along**2 / square


def test_the_size_where_most_is_shown_scatters_as_said_about_one():
    """Of 400 flights on which the cause has one size: as the normal distribution, but that it is
    fitted. A few loud rows show more than half."""
    found = [size_where_most(*flown(seed)[:3], 1.0) for seed in range(400)]
    of = np.array([(one.size - 1.0) / one.std for one in found if one])
    assert of.size == 400
    assert abs(of.mean()) < 4.0 / np.sqrt(400) and abs(of.std() - 1.0) < 4.0 / np.sqrt(800)
    assert {one.share for one in found if one} == {1.0 / 20.0}
    assert not any(one.is_another for one in found if one)


@pytest.mark.parametrize(("loud", "another"), [(0.0, True), (3.0, True), (1.05, False)])
def test_another_size_where_most_is_shown_is_found(loud, another):
    """A lag of large steps alone, and what only quiet rows have."""
    for seed in range(20):
        one = size_where_most(*flown(seed, 1.0, loud)[:3], 1.0)
        assert one is not None and one.is_another == another
        assert not another or (one.size > 1.0) == (loud > 1.0)


def test_a_coloured_cause_is_less_sure_of_its_size():
    problem, fit, rest, _ = flown(1)
    one, coloured = (size_where_most(problem, fit, rest, x) for x in (1.0, 4.0))
    assert one and coloured
    assert coloured.size == one.size and coloured.std == pytest.approx(2.0 * one.std)


@pytest.mark.parametrize(
    ("size", "std", "another"),
    [
        (1.0 + 1.01 * FORM, 0.01, True),
        (1.0 + 0.99 * FORM, 0.01, False),  # a form is a little wrong
        (1.0 - 1.01 * FORM, 0.01, True),
        (1.0 + 3.9 * 0.2, 0.2, False),  # by chance
        (1.0 + 1.01 * BY_CHANCE * 0.2, 0.2, True),
    ],
)
def test_a_size_is_another_beyond_chance_and_form(size, std, another):
    assert SizeWhereMost(0.1, size, std).is_another == another


@pytest.mark.parametrize(
    ("size", "std", "denied"),
    [(0.69, 0.01, True), (0.71, 0.01, False), (0.55, 0.2, False), (1.5, 0.01, False)],
)
def test_what_is_much_smaller_where_it_should_show_is_denied(size, std, denied):
    assert SizeWhereMost(0.1, size, std).is_denied == denied


def test_what_acts_gains_its_nats_where_it_shows_and_answers_do_not():
    """Three quarters of its nats in a few blocks, less the share of so much time; what is alike in all
    rows gains less than that share, whatever it is worth in all."""
    gained, evenly = [], []
    for seed in range(60):
        problem, fit, rest, nats = flown(seed)
        gained.append(beyond_even_spread(problem, fit, rest) / nats)
        problem, fit, rest, nats = flown(seed, 2.0, 0.0)
        evenly.append(beyond_even_spread(problem, fit, rest))
        assert nats > 5.0
    of_loud = 50 * LOUD**2 / (50 * LOUD**2 + 950 * QUIET**2)
    assert HALF < of_loud < MOST
    quiet_blocks = ROWS * ROW / BLOCK - 1  # of a run
    time = (1 + np.ceil((MOST - of_loud) / (1.0 - of_loud) * quiet_blocks)) / (1 + quiet_blocks)
    assert np.mean(gained) == pytest.approx(MOST - time, abs=0.04)
    assert max(evenly) < 0.0


def test_noise_of_its_own_without_a_cause_is_spread_evenly():
    """What the noise levels give every row alike is in no block's favour; what they give loud rows
    is not gained by the cause."""
    problem, fit, rest, _ = flown(3)
    level = beyond_even_spread(problem, fit, rest)
    problem, fit, rest, _ = flown(3, offset=0.02)
    assert beyond_even_spread(problem, fit, rest) == pytest.approx(level, abs=1e-9)
    problem, fit, rest, _ = flown(3, offset=np.where(column() == LOUD, 0.02, 0.0))
    assert beyond_even_spread(problem, fit, rest) < level - 0.5 * RUNS * 50 * 0.02
    problem, fit, rest, _ = flown(3, offset=np.nan)  # a filter that diverges in that noise
    assert beyond_even_spread(problem, fit, rest) == -np.inf


def test_a_prior_that_holds_all_of_a_cause_back_makes_no_size_another():
    """It is as much too small everywhere."""
    problem, fit, rest, _ = flown(5)
    one = size_where_most(problem, fit, rest, 1.0)
    held = size_where_most(problem, fit.at({"size": 0.8 * fit.values["size"]}), rest, 1.0)
    assert one and held
    assert held.size - 1.0 == pytest.approx((one.size - 1.0) / 0.8, abs=1e-9)


def test_nothing_is_said_of_two_machines_of_what_is_not_shown_and_of_one_block():
    problem, fit, rest, _ = flown(4)
    parted = SimpleNamespace(engine=PartedEngine.__new__(PartedEngine))
    assert size_where_most(parted, fit, rest, 1.0) is None
    assert beyond_even_spread(parted, fit, rest) == -np.inf
    assert size_where_most(problem, fit, fit, 1.0) is None
    assert beyond_even_spread(problem, fit, fit) == -np.inf
    alone = np.zeros(ROWS)
    alone[LOUD_ROWS] = 1.0
    one_block = SimpleNamespace(engine=Runs([alone], [alone]))
    assert size_where_most(one_block, fit, rest, 1.0) is None
    diverging = Fit((), {"size": np.nan}, NOISE)
    assert size_where_most(problem, fit, diverging, 1.0) is None
    assert beyond_even_spread(problem, fit, diverging) == -np.inf
