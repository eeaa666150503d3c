"""Names under other noise, and on pieces of a flight: which runs are flown again, and what is asked.

Runs are stand-ins whose information on each cause is written down; what holds follows by hand.
"""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env.diagnosis import noise_variation, replication
from coax_env.diagnosis.noise_variation import Level, _Trial
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.replication import Asked, Known
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.quadratic import Linearised, Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise, Record

# --- runs that are flown again ------------------------------------------------------------------------


def picked(
    monkeypatch, known: list[list[float]], seconds: list[float], worth: list[float]
) -> list[int]:
    """Runs chosen where each has this information on each cause, and so many seconds."""
    table = np.array(known)
    effects = tuple(f"e{k}" for k in range(table.shape[1]))
    monkeypatch.setattr(
        noise_variation, "information",
        lambda problem, fit, part, effect: table[part, effects.index(effect)],
    )  # fmt: skip
    records = [SimpleNamespace(t=np.array([3.0, 3.0 + s])) for s in seconds]
    problem = SimpleNamespace(engine=SimpleNamespace(records=records), settings=SETTINGS)
    quadratic = SimpleNamespace(of_parts=lambda which: which[0])
    fit = Fit(effects, {}, Noise({}))
    nats = dict(zip(effects, worth, strict=True))
    return noise_variation._informative_runs(problem, fit, quadratic, nats)  # type: ignore[arg-type]


def test_runs_with_a_third_of_what_is_known_are_enough(monkeypatch):
    """35 of 100; the most of it in the least time."""
    even = [1.0] * 4
    assert picked(monkeypatch, [[20.0], [36.0], [30.0], [14.0]], even, [50.0]) == [1]
    slow = [3.0, 1.0, 1.0, 1.0]
    assert picked(monkeypatch, [[20.0], [34.0], [30.0], [16.0]], slow, [50.0]) == [1, 2]
    # the second is as rich for each second as the first is poor
    assert picked(monkeypatch, [[36.0], [40.0], [24.0]], [1.0, 3.0, 3.0], [50.0]) == [0]
    # more than is missing counts for nothing: a short run that has enough comes first
    assert picked(monkeypatch, [[64.0], [36.0]], [2.0, 1.1], [50.0]) == [1]


def test_every_cause_needs_its_third(monkeypatch):
    """The second run has enough of the one and a tenth of the other: it comes first, with the third."""
    known = [[60.0, 0.0], [40.0, 10.0], [0.0, 90.0]]
    assert picked(monkeypatch, known, [1.0] * 3, [50.0, 50.0]) == [1, 2]


def test_of_a_clear_cause_less_is_enough(monkeypatch):
    """Worth twice 14 thresholds: half of 35 per cent, so a run with a fifth of it will do."""
    known = [[20.0], [20.0], [20.0], [40.0]]
    seconds = [1.0, 2.0, 2.0, 2.5]
    clear = 2.0 * 14.0 * SETTINGS.evidence
    assert picked(monkeypatch, known, seconds, [0.9 * 14.0 * SETTINGS.evidence]) == [0, 1]
    assert picked(monkeypatch, known, seconds, [clear]) == [0]


# --- levels -------------------------------------------------------------------------------------------


def test_every_level_is_varied_and_sensors_of_one_kind_together():
    """Process noise level by level; of the sensors those that read and whose noise is known."""
    problem = SimpleNamespace(aboard=frozenset(("p", "q", "r", "h", "psi")))
    reading = dict.fromkeys(("p", "q", "r", "h", "vn"), 0.1)
    fit = Fit((), {}, Noise({"force_xy": 1.0, "memory_force_xy": 0.5}, reading))
    found = list(noise_variation._levels(problem, fit))  # type: ignore[arg-type]
    assert found == [
        Level(("force_xy",), "force xy"), Level(("memory_force_xy",), "memory force xy"),
        Level(("p", "q", "r"), "the noise of p, q, r"), Level(("h",), "the noise of h"),
    ]  # fmt: skip


def test_aboard_is_what_any_run_reads():
    z = np.full((2, 2, 3), np.nan)
    z[0, 1, 0] = z[1, 0, 2] = 1.0
    engine = SimpleNamespace(records=[SimpleNamespace(z=each) for each in z])
    model = SimpleNamespace(channels=("p", "q", "h"))
    problem = Problem(model, engine, (), {})  # type: ignore[arg-type]
    assert problem.aboard == {"p", "h"}


def passed(e: float) -> Any:
    return SimpleNamespace(innovations=np.full((10, 2), e), log_likelihood=0.0)


class Varied(_Trial):
    """Innovations that change by so much a level's logarithm, and causes that fall beyond a factor."""

    def _fallen(self, there: Fit) -> tuple[list[Any], list[str]]:
        change, falls = self.engine  # type: ignore[misc]
        log = math.log(there.noise.level("force_xy"))
        return [passed(1.0 + change * log)], [e for e, when in falls.items() if when(log)]


def failing(change: float, falls: dict[str, Any], level: float = 1.0, floor: float = 0.0) -> Any:
    noise = Noise({"force_xy": level}, {}, {"force_xy": floor})
    engine = (change, falls)
    problem = SimpleNamespace(settings=SETTINGS)
    passes = [passed(1.0 + change * math.log(level))]
    trial = Varied(problem, engine, Fit((), {}, noise), {}, passes)  # type: ignore[arg-type]
    return trial.failing(Level(("force_xy",), "force xy"))


def test_a_level_is_doubled_and_halved():
    falls = {"wind": lambda log: log > 0.6, "mass": lambda log: log < -0.6,
             "drag": lambda log: abs(log) > 0.6, "gain": lambda log: abs(log) > 0.8}  # fmt: skip
    assert failing(1.0, falls) == {
        "wind": ["twice force xy"], "drag": ["twice force xy", "half force xy"],
        "mass": ["half force xy"],
    }  # fmt: skip


def test_what_no_innovation_feels_is_not_varied():
    """Twice the level moves each of 20 innovations by log 2 times the change: squares of 1 in all."""
    all_of_them = {"wind": lambda log: True}
    least = 1.0 / (math.log(2.0) * math.sqrt(20.0))
    assert failing(0.99 * least, all_of_them) == {}
    assert failing(1.01 * least, all_of_them) != {}


# --- pieces of a run ----------------------------------------------------------------------------------


def test_pieces_are_as_even_as_can_be():
    """Of 12 s, 5 s each: two of six, every row once; when the clock starts does not matter."""
    t = 40.0 + 0.01 * np.arange(1201)
    record = Record("a", t, np.zeros((t.size, 4)), np.zeros((t.size, 3)), 40.0)
    pieces = replication._pieces(record, 5.0)
    assert [round(float(p.t[-1] - p.t[0]), 2) for p in pieces] == [5.99, 6.0]
    np.testing.assert_array_equal(np.concatenate([p.t for p in pieces]), t)
    assert len(replication._pieces(record, 30.0)) == 1
    assert (
        len(replication._pieces(record, 4.8)) == 2 and len(replication._pieces(record, 4.79)) == 3
    )


NAMES = ("mass", "gyro_bias.x", "gyro_bias.y")
STD = np.array([0.1, 0.01, 0.02])


def made(values: list[float], G: np.ndarray, best: list[float]) -> tuple[Any, Fit, Quadratic]:
    """A problem of one effect with two numbers, and a quadratic whose best (wide priors) is `best`."""
    own = tuple(FreeParameter(n, 0.0, s) for n, s in zip(NAMES[1:], STD[1:], strict=True))
    problem = SimpleNamespace(
        own={"gyro_bias": own}, acting_names=lambda effect: list(NAMES[1:]),
        free_names=lambda active: list(NAMES), off_values=lambda effect: dict.fromkeys(NAMES[1:], 0.0),
        settings=SETTINGS,
    )  # fmt: skip
    free = [FreeParameter("mass", 0.0, 1e9), *(FreeParameter(n, 0.0, 1e9) for n in NAMES[1:])]
    at = np.array(values)
    slope = G @ (at - np.array(best))
    lin = Linearised(NAMES, G[None], slope[None], np.zeros((1, 3, 1)), slope[None])
    known = dict(zip(NAMES, values, strict=True))
    return problem, Fit(("gyro_bias",), known, Noise({})), Quadratic.of(lin, free, known)


@pytest.mark.parametrize(
    ("best", "same"),
    [((0.0, 0.01, 0.0), True), ((0.0, -0.01, 0.0), False), ((0.0, -0.004, 0.03), True),
     ((0.0, -0.009, 0.03), False), ((5.0, 0.001, 0.0), True)],
)  # fmt: skip
def test_a_part_points_where_the_whole_does(best, same):
    """By the product of both in prior widths: (2, 1) on the whole, so 2 x + y decides."""
    problem, fit, quadratic = made([0.0, 0.02, 0.02], np.eye(3), list(best))
    assert replication.same_way(problem, fit, quadratic, ("gyro_bias",), "gyro_bias") == same


def test_information_is_what_an_effect_of_its_size_is_worth_doubled():
    """Its own columns' squares at its size, less what the mass could have explained."""
    G = np.array([[4.0, 2.0, 0.0], [2.0, 9.0, 1.0], [0.0, 1.0, 16.0]])
    problem, fit, quadratic = made([0.7, 3.0, -1.0], G, [0.0, 0.0, 0.0])
    found = replication.information(problem, fit, quadratic, "gyro_bias")
    size = np.array([3.0, -1.0])
    left = G[1:, 1:] - np.outer(G[1:, 0], G[0, 1:]) / G[0, 0]
    assert found == pytest.approx(size @ left @ size, rel=1e-9)


def test_a_part_is_asked_for_its_share_of_information_and_of_worth():
    """A quarter of the information; evidence is two thirds of what the quadratic loses."""
    G = np.diag([4.0, 9.0, 16.0])
    problem, fit, quadratic = made([0.0, 3.0, -1.0], G, [0.0, 0.0, 0.0])
    whole = float(9.0 * 9.0 + 16.0)
    known = Known("gyro_bias", 4.0 * whole, 90.0, 60.0)
    asked = Asked.of(problem, fit, known, quadratic)
    assert (asked.share, asked.scale, asked.worth) == pytest.approx((0.25, 2.0 / 3.0, 60.0))
    expected = math.sqrt(2.0 * 0.25 * 60.0) - 1.645 * math.sqrt(0.75)
    assert asked.expected(60.0) == pytest.approx(expected) and asked.can_tell
    assert asked.margin(30.0) == pytest.approx(20.0 - asked.needed)
    assert asked.needed == pytest.approx(0.5 * 2.0**2), "two std at least"
    assert (
        Asked.of(problem, fit, Known("gyro_bias", 0.5 * whole, 0.0, 60.0), quadratic).share == 1.0
    )
    nothing = Asked.of(problem, fit, Known("gyro_bias", 0.0, 0.0, 60.0), quadratic)
    assert (nothing.share, nothing.scale) == (0.0, 0.0)
