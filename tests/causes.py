"""Are the causes right? What a diagnosis named against what was hidden: every name, value and std."""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import injector
from study.expected import catalogue_values

from coax_env.model import effects

WITHIN = 3.0  # standard deviations
DETERMINED = 0.33  # of the prior's width that a std may be: a wide interval holds every truth
FORM = 0.1  # of a value whose effect has another form in the injector than in the catalogue

_OTHER_FORM = {name.partition(".")[0] for name in injector.OTHER_FORM}
_PARAMETERS = {
    full: parameter
    for entry in effects.CATALOGUE.values()
    for full, parameter in zip(entry.names(), entry.parameters, strict=True)
}
_PRIOR = {full: parameter.usual for full, parameter in _PARAMETERS.items()}
_OFF = {full: parameter.off for full, parameter in _PARAMETERS.items()}


def say_what_was_found(findings: Mapping[str, Any]) -> dict[str, Any]:
    """Effect -> what it is confounded with, and its parameters."""
    return {
        cause["effect"]: [cause["confusable_with"], cause["parameters"]]
        for cause in findings["causes"]
    }


def check_causes(
    findings: Mapping[str, Any], hidden: Collection[str], values: Mapping[str, float]
) -> None:
    """Every hidden effect is named, and nothing else; every number agrees and is determined.

    A wrong name does not pass because it is declared to be confusable with the truth.

    Args:
        findings: of a diagnosis (contract.md). hidden: names of the hidden effects.
        values: truth of every parameter of theirs, by full name, in the catalogue's form and unit.
    """
    found = say_what_was_found(findings)
    assert set(found) == set(hidden), f"hidden: {sorted(hidden)}, found: {found}"
    assert len(findings["causes"]) == len(found), f"named twice: {found}"
    for cause in findings["causes"]:
        for full, reported in cause["parameters"].items():
            assert full in _OFF, f"no truth to check {full} by"
            truth = values.get(full, _OFF[full])  # an effect's other numbers are at their off-value
            allowed = WITHIN * reported["std"]
            if cause["effect"] in _OTHER_FORM:
                allowed += FORM * abs(truth)
            assert abs(reported["value"] - truth) < allowed, (full, truth, reported)
            determined = (
                DETERMINED if truth != _OFF[full] else 1.0
            )  # what is not there may be unseen
            assert 0.0 < reported["std"] < determined * _PRIOR[full], (full, reported)
    unchecked = set(values) - {full for _, parameters in found.values() for full in parameters}
    assert not unchecked, f"values that no cause reports: {unchecked}"
    assert findings["verdict"] == ("explained" if hidden else "consistent"), (
        findings["verdict"], findings["unexplained"],
    )  # fmt: skip


def check_all_sure(findings: Mapping[str, Any]) -> None:
    """No true name is doubted; a flight outside the calibrated class is said to be so, and why."""
    assert {c["effect"]: c["doubts"] for c in findings["causes"] if c["trust"] != "sure"} == {}
    in_class = findings["class"]["calibrated"] is not None
    assert (findings["false_alarm_rate"] is not None) == in_class == (not findings["class"]["why"])


def truth_of(folder: Path) -> tuple[list[str], dict[str, float]]:
    """What the injector hid in a flight: effects, and all their numbers in the catalogue's form."""
    truth = json.loads((folder / "truth.json").read_text())
    return truth["hidden"], catalogue_values(truth["values"])
