"""The study of onsets: how it flies, what a change is worth, and whether the counting is right."""

import numpy as np
import pytest
from study import onset_worth, onsets

from coax_env.estimation.quadratic import Linearised, Quadratic
from coax_env.estimation.state_space import FreeParameter

SINCE = {"run": "lat_3211", "t": 5.3, "std": 0.2, "grown": None}
GROWN = SINCE | {"grown": {"run": "heave_3211", "t": 5.0, "std": 0.3}}


def row(kind, causes, worth=None, others=()):
    fault = {} if kind == "clean" else {"gyro_bias": {"x": 0.02}}
    plan = {"kind": kind, "number": 3, "fault": fault, "others": {e: {} for e in others},
            "since": ["lat_3211", 5.0], "air": {"gusts": "none"}}  # fmt: skip
    named = [{"effect": e, "since": since, "evidence": 20.0} for e, since in causes]
    return {"plan": plan, "causes": named, **({} if worth is None else {"worth": worth})}


def test_kinds_differ_in_when_the_fault_is_there_alone():
    """Of one number and seed: the plans of a kind are its own, those of old kinds as they were."""
    for kind in onsets.KINDS:
        plan = onsets.planned(kind, 4, 8)
        before, after = onsets.stages(plan)
        (effect,) = plan.fault or [None]
        there = {e for e, sizes in before.items() if any(sizes.values())}
        at_last = {e for e, sizes in after.items() if any(sizes.values())}
        assert there == ({effect} if kind in ("constant", "ends") else set())
        assert at_last == ({effect} if kind in ("begins", "grows", "constant") else set())
    begins = onsets.planned("begins", 13, 8)
    assert begins.fault["torque_balance"]["scale"] == pytest.approx(-0.042747877270685714)


def test_whole_flights_begin_in_the_middle_of_a_middle_run():
    """And the others where they did before there were whole ones."""
    runs = onsets.lengths(True)
    assert len(runs) == 12 and sum(runs.values()) == 210.0
    names = list(runs)
    for number in range(40):
        plan = onsets.planned("begins", number, 8, whole=True)
        run, t = plan.since
        assert 3 <= names.index(run) < 9 and 3.0 <= t <= runs[run] - 3.0
        assert plan.name == f"onset-begins-{number:04d}-whole"
    assert onsets.planned("begins", 13, 8).since == ("lat_3211", 5.83)


def test_a_moment_of_a_whole_flight_is_judged_in_its_own_flown_time():
    """The end of a heave of 14 s and the start of the yaw behind it."""
    whole = row("begins", [("gyro_bias", SINCE | {"run": "yaw_3211", "t": 0.1})])
    whole["plan"] |= {"whole": True, "since": ["heave_3211", 13.8]}
    j = onsets.judged(whole)
    assert j["error"] == pytest.approx(0.3) and j["held"]


@pytest.mark.parametrize(
    ("t", "std", "run", "held"),
    [(5.3, 0.2, "lat_3211", True), (5.3, 0.15, "lat_3211", False), (0.1, 4.0, "heave_3211", True)],
)
def test_a_moment_is_judged_in_flown_time(t, std, run, held):
    since = {"run": run, "t": t, "std": std, "grown": None}
    j = onsets.judged(row("begins", [("gyro_bias", since), ("wind", None)], 29.0))
    assert j["named"] and j["since"] and j["should_show"] and j["held"] == held
    assert j["error"] == pytest.approx(0.3 if run == "lat_3211" else 7.1)
    assert j["false"] == ["wind"] and j["false_since"] == []


def test_a_moment_of_what_is_constant_is_false():
    j = onsets.judged(row("constant", [("gyro_bias", SINCE)]))
    assert j["named"] and not j["since"] and j["false_since"] == ["gyro_bias"]
    j = onsets.judged(row("ends", [("gyro_bias", None), ("servo_lag", SINCE)], 27.0, ["servo_lag"]))
    assert j["named"] and not j["since"] and not j["should_show"]
    assert j["false_since"] == ["servo_lag"] and j["false"] == []


def test_those_that_should_show_are_counted_beside_all():
    rows = [
        row("begins", [("gyro_bias", SINCE)], 100.0),
        row("begins", [], 10.0),
        row("begins", [("gyro_bias", None)], 40.0),
        row("grows", [("gyro_bias", SINCE)]),
        row("grows", [("gyro_bias", GROWN)]),
        row("constant", [("gyro_bias", None)]),
        row("clean", []),
        {"plan": {}, "error": "lost"},
    ]
    text = onsets.text_of(rows)
    for line in (
        "| begins: named | 2 | 3 | 67 % |", "| begins: with its moment | 1 | 3 | 33 % |",
        "| begins, should show: named | 2 | 2 | 100 % |",
        "| begins, should show: with its moment | 1 | 2 | 50 % |",
        "| begins: the moment within its 95 % interval | 1 | 1 | 100 % |",
        "| grows: with its moment | 2 | 2 | 100 % |",
        "| grows: said to grow | 1 | 2 | 50 % |", "| begins: said to grow | 0 | 1 | 0 % |",
        "| constant: a moment | 0 | 1 | 0 % |",
        "begins: median error of the moment 0.300 s, largest 0.30 s.", "1 failed.",
    ):  # fmt: skip
        assert line in text, line
    assert (
        "ends" not in text
        and text.count("- begins 3") == 2
        and text.count("- grows 3") == 1
        and "worth 40 nats" in text
    )


def test_what_a_change_is_worth_beside_a_constant_one():
    """Two stretches with information a and b on one number: the change has ab / (a + b) of it."""
    names = ("gyro_bias.x", "gyro_bias.x@before", "mass")
    free = [FreeParameter(n, 0.0, 10.0, -np.inf, np.inf, 1.0) for n in names]
    a, b = 900.0, 300.0
    lin = Linearised(names, np.diag([a, b, 5.0])[None], np.zeros((1, 3)), np.ones((1, 3, 1)),
                     np.zeros((1, 3)))  # fmt: skip
    quadratic = Quadratic.of(lin, free, dict.fromkeys(names, 0.0))
    nats = onset_worth.expected_nats(quadratic, list(names), "gyro_bias", {"gyro_bias.x": 0.5})
    assert nats == pytest.approx(0.5 * 0.25 * a * b / (a + b), rel=1e-6)
