"""What is asked of causes in gusts of single shocks; the likelihoods are in test_gust_strength.py."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from coax_env.diagnosis import shock_evidence
from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.diagnosis.shock_evidence import OFTEN, in_own_strengths
from coax_env.estimation.state_space import Noise


@pytest.mark.parametrize(
    ("stated", "own", "strengths", "nats"),
    [
        (166.0, 162.0, True, 81.0),
        (166.0, 340.0, True, 166.0),  # a fit that has not converged
        (166.0, 162.0, False, 166.0),  # gusts do not come in shocks
        (1.01 * OFTEN * SETTINGS.clear, 162.0, True, 1.01 * OFTEN * SETTINGS.clear),
    ],
)
def test_evidence_is_at_most_what_models_differ_by_with_strengths_of_their_own(
    monkeypatch, stated, own, strengths, nats
):
    """Half of what is lost is colour. Strengths of a model alone cost it 5 nats more than the other."""
    problem: Any = SimpleNamespace(
        settings=SETTINGS, report=lambda text: None, file_values=lambda effect: {"mass": 0.3},
        for_each=lambda work, of: {e: work(e) for e in of},
    )  # fmt: skip
    fit = Fit(("wind",), {}, Noise({}))
    held_at: list[Any] = []

    def with_shocks(problem: Any, fit: Fit, held: Any = ()) -> tuple[Any, Fit]:
        held_at.append(held)
        return SimpleNamespace(engine=SimpleNamespace(records=0.0 if fit.active else 5.0)), fit

    def converged(problem: Any, fit: Fit, held: Any = ()) -> Fit:
        return replace(fit, objective=7.0 if fit.active else own + 2.0)

    monkeypatch.setattr(shock_evidence, "has_strengths", lambda problem: strengths)
    monkeypatch.setattr(shock_evidence, "with_shocks", with_shocks)
    monkeypatch.setattr(shock_evidence, "converged", converged)
    monkeypatch.setattr(shock_evidence, "prior_cost", lambda records: records)
    evidence = {"wind": Evidence(2.0 * stated, 2.0, rest=replace(fit, active=()))}
    found = in_own_strengths(problem, fit, evidence)["wind"]
    assert found.nats == pytest.approx(nats)
    assert held_at in ([], [(), ("mass",)]), "what the effect replaced stays as in the file"
