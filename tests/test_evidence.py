"""A cause must be worth the threshold by the readings alone, and with what commands show of the gusts.

What each likelihood would say is given here as a table, so that what must be left is known beforehand.
Two clean flights of the study had names that stood by one of the two alone.
"""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest
from study import arms, one_flight

from coax_env import diagnose
from coax_env.diagnosis import evidence
from coax_env.diagnosis.evidence import Evidence, weighed
from coax_env.diagnosis.problem import Fit
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.state_space import Noise

CLEAR = 10.0 * SETTINGS.evidence


@dataclass(frozen=True)
class Tables:
    """Nats of each effect by set of names, with gains of the commands or not; stands for a problem."""

    alone: dict[frozenset[str], dict[str, float]]
    joint: dict[frozenset[str], dict[str, float]]
    worth_it: bool = True
    white: bool = True
    gains: bool = False
    settings: Any = SETTINGS
    asked: list[bool] = field(default_factory=list)

    def off_values(self, effect: str) -> dict[str, float]:
        return {}

    file_values = off_values

    def report(self, text: str) -> None:
        """Nobody listens."""

    def worth(self, active: tuple[str, ...]) -> dict[str, Evidence]:
        table = self.joint if self.gains else self.alone
        of_set = table[frozenset(active)] if active else {}
        return {e: Evidence(of_set[e], 1.0) for e in active}


def named(monkeypatch: pytest.MonkeyPatch, tables: Tables, *active: str) -> tuple[str, ...]:
    def gained(problem: Tables, fit: Fit, coloured: bool = False) -> tuple[Tables, Fit]:
        if not problem.worth_it or not (problem.white or coloured):
            return problem, fit
        return Tables(problem.alone, problem.joint, gains=True), fit

    nothing = SimpleNamespace()
    monkeypatch.setattr(evidence, "with_command_gains", gained)
    monkeypatch.setattr(evidence, "has_command_gains", lambda problem: problem.gains)
    monkeypatch.setattr(evidence, "converged", lambda problem, fit: fit)
    monkeypatch.setattr(evidence, "refined", lambda problem, fit: fit)
    monkeypatch.setattr(evidence, "linearise", lambda problem, fit: (fit, [], nothing))
    monkeypatch.setattr(evidence, "weigh", lambda problem, fit, _: problem.worth(fit.active))
    problem, fit, _, found = weighed(tables, Fit(active, {}, Noise({})))
    assert problem.gains == (tables.worth_it and tables.white) and set(found) == set(fit.active)
    return fit.active


def of(**nats: float) -> dict[frozenset[str], dict[str, float]]:
    return {frozenset(nats): nats}


def test_a_cause_stands_by_both_likelihoods_or_is_not_named(monkeypatch):
    for alone, joint, stands in (
        (CLEAR, CLEAR, True), (CLEAR, 2.0, False), (-3.0, CLEAR, False), (2.0, 3.0, False),
    ):  # fmt: skip
        found = named(monkeypatch, Tables(of(damping=alone), of(damping=joint)), "damping")
        assert found == (("damping",) if stands else ()), (alone, joint)


def test_names_are_asked_so_where_colour_keeps_the_gains_out_of_the_model(monkeypatch):
    for joint, stands in ((CLEAR, True), (2.0, False)):
        tables = Tables(of(play=CLEAR), of(play=joint), white=False)
        assert named(monkeypatch, tables, "play") == (("play",) if stands else ())


def test_where_commands_show_nothing_the_readings_decide(monkeypatch):
    tables = Tables(of(damping=CLEAR), of(damping=0.0), worth_it=False)
    assert named(monkeypatch, tables, "damping") == ("damping",)


def test_what_stood_beside_a_cause_that_fell_is_asked_again_without_it(monkeypatch):
    """As a damping was that, alone, was worth 25 nats beside a false delay and nothing without it."""
    alone = of(delay=50.0, damping=25.0, drag=60.0) | of(damping=-3.0, drag=60.0) | of(drag=60.0)
    joint = of(delay=2.0, damping=40.0, drag=70.0) | of(damping=37.0, drag=70.0) | of(drag=70.0)
    found = named(monkeypatch, Tables(alone, joint), "delay", "damping", "drag")
    assert found == ("drag",)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arm", "number", "seed"), [("telemetry", 1, 17), ("one_minus_cosine", 2, 0)]
)
def test_nothing_is_named_that_one_of_them_alone_carries(tmp_path, arm, number, seed):
    """Before, a rate damping (37 nats), and a servo's play that was sure (15) beside one (18)."""
    one_flight.hide(arms.planned(arm, "clean", number, seed), tmp_path)
    assert [c["effect"] for c in diagnose(tmp_path).findings["causes"]] == []
