"""Pruning, on causes whose worth is written down here: which leave, in which order, and what is asked.

The refits are stand-ins: the objective of a set of causes is the worth of those that are missing, plus
what its noise levels have not converged by.
"""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from coax_env.diagnosis import evidence
from coax_env.diagnosis.evidence import prune
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.state_space import Noise

GOOD, POOR = Noise({"force": 1.0}), Noise({"force": 2.0})
THRESHOLD = SETTINGS.evidence
CLEAR = 100.0 * SETTINGS.clear_evidence * THRESHOLD


class Flights:
    """Causes' worth [nats]; with POOR noise all is worse by `lacking`, unless a refit mends it."""

    def __init__(self, worth: dict[str, float], lacking: float = 0.0, mends: str = "") -> None:
        self.worth, self.lacking, self.mends = worth, lacking, mends
        self.asked: list[str] = []

    def objective(self, fit: Fit) -> float:
        missing = sum(nats for e, nats in self.worth.items() if e not in fit.active)
        return missing + (self.lacking if fit.noise is POOR else 0.0)

    def converged(self, problem: Problem, fit: Fit, held: tuple[str, ...] = ()) -> Fit:
        """To GOOD noise only where the cause `mends` is missing."""
        noise = GOOD if self.mends and self.mends not in fit.active else fit.noise
        fit = replace(fit, noise=noise)
        return replace(fit, objective=self.objective(fit))

    def without(self, problem: Problem, fit: Fit, quadratic: object, effect: str) -> Fit:
        self.asked.append(effect)
        return replace(fit, active=fit.rest(effect))

    def pruned(
        self, monkeypatch: pytest.MonkeyPatch, noise: Noise
    ) -> tuple[Fit, dict[str, evidence.Evidence]]:
        def loss(problem, quadratic, active, effect, inflation):
            return self.worth[effect] / inflation

        stand_ins = {
            "converged": self.converged, "without": self.without, "loss": loss,
            "refined": lambda problem, fit: fit,
            "fitted": lambda problem, fit, steps, held: self.converged(problem, fit),
            "noise_fitted": lambda problem, fit: fit,
            "linearise": lambda problem, fit: (fit, [], None),
            "inflation": lambda problem, quadratic, active, effect: 1.0,
        }  # fmt: skip
        for name, stand_in in stand_ins.items():
            monkeypatch.setattr(evidence, name, stand_in)
        model = SimpleNamespace(moments={}, bare_values={})
        own: dict[str, tuple[()]] = dict.fromkeys(self.worth, ())
        problem = Problem(model, SimpleNamespace(threads=1), (), own)  # type: ignore[arg-type]
        fit, _, found = prune(problem, Fit(tuple(self.worth), {}, noise))
        return fit, found


def test_what_is_worth_less_than_the_threshold_leaves_the_weakest_first(monkeypatch):
    flights = Flights({
        "swash_offset": 0.9 * THRESHOLD, "gyro_bias": CLEAR, "yaw_damping": 0.1 * THRESHOLD,
        "ground_effect": 1.1 * THRESHOLD,
    })  # fmt: skip
    fit, found = flights.pruned(monkeypatch, GOOD)
    assert fit.active == ("gyro_bias", "ground_effect")
    assert [move for move, _ in fit.history] == ["- yaw_damping", "- swash_offset"]
    assert [nats for _, nats in fit.history] == pytest.approx([0.1 * THRESHOLD, 0.9 * THRESHOLD])
    assert {e: f.nats for e, f in found.items()} == pytest.approx(
        {"gyro_bias": CLEAR, "ground_effect": 1.1 * THRESHOLD}
    )


def test_what_is_clear_is_weighed_once(monkeypatch):
    """Its refit costs as much as any other, and it changes nothing of what leaves."""
    flights = Flights({"gyro_bias": CLEAR, "swash_offset": 0.0, "yaw_damping": 0.5 * THRESHOLD})
    flights.pruned(monkeypatch, GOOD)
    assert flights.asked.count("gyro_bias") == 1
    assert flights.asked[-1] == "gyro_bias"


@pytest.mark.parametrize("worth", [0.9 * THRESHOLD, 1.1 * THRESHOLD])
def test_a_cause_is_not_charged_with_noise_that_has_not_converged(monkeypatch, worth):
    """The refit without it finds better noise levels: they are taken, and the cause is asked again."""
    flights = Flights(
        {"gyro_bias": CLEAR, "swash_offset": worth}, lacking=60.0, mends="swash_offset"
    )
    fit, found = flights.pruned(monkeypatch, POOR)
    assert fit.noise is GOOD
    assert ("swash_offset" in fit.active) == (worth > THRESHOLD)
    if worth > THRESHOLD:
        assert found["swash_offset"].nats == pytest.approx(worth)
