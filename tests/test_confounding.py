"""What effects that are neither shown nor ruled out make of the numbers, against closed forms."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coax_env.diagnosis import confounding, evidence, remarks
from coax_env.diagnosis.confounding import (
    Settled,
    alike_unturned,
    beside_undecided,
    likelier,
    of_undecided,
    settled,
    turn_that_tells,
    undecided,
)
from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.where_shown import SizeWhereMost
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.prediction import RunReplay
from coax_env.estimation.quadratic import Linearised, Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.model.vehicle_file import load_vehicle
from coax_env.simulation.maneuvers import MANEUVERS

MASS, DAMPING, DRAG, LAG = (
    "mass", "axial_damping.coefficient", "rotor_drag.coefficient", "servo_lag.time"
)  # fmt: skip
STD = {MASS: 0.5, DAMPING: 2.0, DRAG: 3.0}
COUPLED = np.array([[9.0, 2.0, 3.0], [2.0, 8.0, -4.0], [3.0, -4.0, 6.0]])
"""Information on mass, a damping in the model and a drag that is not."""


def fitted_with(slope: float) -> tuple[Problem, Fit, Quadratic]:
    """Mass and damping at their best, all priors about where they stand; a slope in the drag."""
    free = {name: FreeParameter(name, 0.0, std) for name, std in STD.items()}
    own = {"axial_damping": (free[DAMPING],), "rotor_drag": (free[DRAG],)}
    model = HeliModel(load_vehicle("lama400d"))
    problem = Problem(model, None, (free[MASS],), own)  # type: ignore[arg-type]
    lin = Linearised(
        tuple(STD),
        COUPLED[None],
        np.array([[0.0, 0.0, slope]]),
        np.zeros((1, 3, 2)),
        np.zeros((4, 3)),
    )
    values = dict.fromkeys(STD, 0.0)
    fit = Fit(("axial_damping",), values, Noise({}))
    return problem, fit, Quadratic.of(lin, problem.parameters, values)


@pytest.mark.parametrize("slope", [0.0, -1.0, -8.0, 5.0])
def test_an_undecided_effect_is_as_likely_as_its_evidence_and_moves_the_rest_to_its_own_fit(slope):
    """Least squares of all three numbers, and the evidence by Gaussian integrals, written out."""
    problem, fit, quadratic = fitted_with(slope)
    prior = np.diag([STD[name] ** -2 for name in STD])
    whole, rest = COUPLED + prior, (COUPLED + prior)[:2, :2]
    best = np.linalg.solve(whole, [0.0, 0.0, -slope])
    gained = 0.5 * best @ whole @ best
    nats = gained - 0.5 * math.log(np.linalg.det(whole) / np.linalg.det(rest) * STD[DRAG] ** 2)
    probability = 1.0 / (1.0 + math.exp(-nats))
    (found,) = undecided(problem, fit, quadratic).items()
    assert found[0] == "rotor_drag" and found[1][0] == pytest.approx(probability)
    np.testing.assert_allclose(found[1][1], best[:2], atol=1e-12)
    np.testing.assert_allclose(
        of_undecided(problem, fit, quadratic),
        probability * np.outer(best[:2], best[:2]),
        atol=1e-12,
    )
    inflation = {"axial_damping": Evidence(50.0, 4.0)}
    begun = replace(fit, std_ratio={DAMPING: 1.5})
    ratios = beside_undecided(problem, begun, quadratic, inflation).std_ratio
    variance = np.diag(np.linalg.inv(rest))
    assert ratios[MASS] == pytest.approx(
        math.hypot(1.0, best[0] * (probability / variance[0]) ** 0.5)
    )
    moved = best[1] * (probability / variance[1]) ** 0.5 / 2.0  # colour doubles the std
    assert ratios[DAMPING] == pytest.approx(math.hypot(1.5, moved))


def occam(effect: str) -> float:
    """Of a damping or a drag beside the mass, by determinants."""
    i = list(STD).index(effect)
    whole = COUPLED + np.diag([std**-2 for std in STD.values()])
    both = np.linalg.det(whole[np.ix_([0, i], [0, i])])
    return 0.5 * math.log(both / whole[0, 0] * STD[effect] ** 2)


@pytest.mark.parametrize(
    ("more", "colour", "begun", "exchanged"),
    [
        (0.1, 1.0, False, True),
        (-0.1, 1.0, False, False),
        (0.1, 4.0, False, True),
        (9.0, 1.0, True, False),
    ],
)
def test_what_is_likelier_once_refitted_takes_a_causes_place(
    monkeypatch, more, colour, begun, exchanged
):
    """By its evidence, not its fit alone: colour, no less than of what goes, and Occam's factors."""
    problem, fit, quadratic = fitted_with(0.0)
    monkeypatch.setattr(Problem, "changes", lambda self, effect: begun)
    fit = replace(fit, objective=1000.0)
    evidence = {"axial_damping": Evidence(50.0 * colour, colour)}  # worth 50 nats
    gain = colour * more + occam(DRAG) - occam(DAMPING)
    other = replace(fit.at({DRAG: 1.0}), active=("rotor_drag",), objective=1000.0 - gain)
    there = likelier(problem, fit, quadratic, evidence, {"axial_damping": {"rotor_drag": other}})
    assert (there is not None) == exchanged
    if there is not None:
        assert there.active == ("rotor_drag",)
        (move, nats) = there.history[-1]
        assert move == "axial_damping -> rotor_drag"
        assert nats == pytest.approx(more)
    assert likelier(problem, fit, quadratic, evidence, {"axial_damping": {}}) is None
    small = {"rotor_drag": other.at({DRAG: 0.0})}  # another optimum explained it, not the drag
    assert likelier(problem, fit, quadratic, evidence, {"axial_damping": small}) is None
    monkeypatch.setattr(confounding, "LATE_SERVO", ("axial_damping", "rotor_drag"))
    late = {"axial_damping": {"rotor_drag": other}}  # from_afar.far_swap exchanges these
    assert likelier(problem, fit, quadratic, evidence, late) is None


@pytest.mark.parametrize("begins", [(), ("thrust_exponent",), ("dynamic_inflow",)])
def test_what_begins_in_flight_has_no_alternative_from_afar(monkeypatch, begins):
    """It has a size before and one after; that of an inflow would be looked for as one."""
    names = ("thrust_exponent.excess", "dynamic_inflow.time")
    own = {n.partition(".")[0]: (FreeParameter(n, 0.0, 1.0),) for n in names}
    model = HeliModel(load_vehicle("lama400d"))
    problem = Problem(model, None, (), own)  # type: ignore[arg-type]
    fit = Fit(("thrust_exponent",), dict.fromkeys(names, 0.0), Noise({}), objective=0.0)
    monkeypatch.setattr(Problem, "changes", lambda self, effect: effect in begins)
    monkeypatch.setattr(confounding, "_near", lambda *given: [])
    monkeypatch.setattr(confounding, "in_place_of", lambda *given: fit)
    found = confounding._of_one(problem, fit, None, "thrust_exponent", 1.0, 50.0)  # type: ignore[arg-type]
    assert list(found) == ([] if begins else ["dynamic_inflow"])


@pytest.mark.parametrize(
    ("lost", "behind", "begins", "alike"),
    [
        (300.0, 29.0, (), True),  # a tenth of what it is worth
        (300.0, 31.0, (), False),
        (20.0, 5.0, (), True),  # a tie
        (20.0, 7.0, (), False),
        (300.0, 29.0, ("servo_rate",), False),  # it has two sizes
    ],
)
def test_a_limited_rate_is_no_surer_than_a_servo_is_late(monkeypatch, lost, behind, begins, alike):
    names = ("servo_rate.limit", "servo_delay.time")
    own = {n.partition(".")[0]: (FreeParameter(n, 0.0, 1.0),) for n in names}
    problem = Problem(HeliModel(load_vehicle("lama400d")), None, (), own)  # type: ignore[arg-type]
    fit = Fit(("servo_rate",), dict.fromkeys(names, 0.0), Noise({}), objective=0.0)
    monkeypatch.setattr(Problem, "changes", lambda self, effect: effect in begins)
    monkeypatch.setattr(confounding, "_near", lambda *given: [])
    monkeypatch.setattr(confounding, "in_place_of", lambda *given: replace(fit, objective=behind))
    found = confounding._of_one(problem, fit, None, "servo_rate", 1.0, lost)  # type: ignore[arg-type]
    assert list(found) == (["servo_delay"] if alike else [])


@pytest.mark.parametrize(
    ("effect", "poses_alone", "behind", "alike"),
    [
        ("command_delay", True, 79.0, ["servo_delay"]),  # a tenth of what it is worth
        ("command_delay", True, 81.0, []),
        ("command_delay", False, 5.0, []),  # gyros show what the swash plate does
        ("servo_delay", True, 79.0, ["command_delay"]),
        ("servo_play", True, 79.0, []),
    ],
)
def test_by_poses_alone_a_late_command_and_a_late_servo_stand_for_each_other(
    monkeypatch, effect, poses_alone, behind, alike
):
    names = ("command_delay.time", "servo_delay.time", "servo_play.width")
    own = {n.partition(".")[0]: (FreeParameter(n, 0.0, 1.0),) for n in names}
    problem = Problem(HeliModel(load_vehicle("lama400d")), None, (), own)  # type: ignore[arg-type]
    fit = Fit((effect,), dict.fromkeys(names, 0.0), Noise({}), objective=0.0)
    behind_it = replace(fit, objective=behind)
    monkeypatch.setattr(Problem, "sees_poses_alone", poses_alone)
    monkeypatch.setattr(confounding, "FAR", {})
    monkeypatch.setattr(confounding, "_near", lambda *given: [])
    monkeypatch.setattr(confounding, "swap", lambda *given: (0.0, None))
    monkeypatch.setattr(confounding, "score", lambda *given: SimpleNamespace(evidence=0.0))
    for name in ("fitted", "converged"):
        monkeypatch.setattr(confounding, name, lambda *given: behind_it)
    quadratic = SimpleNamespace(moved=lambda move: {})
    found = confounding._of_one(problem, fit, quadratic, effect, 1.0, 800.0)  # type: ignore[arg-type]
    assert sorted(found) == alike


@pytest.mark.parametrize(
    ("size", "lost", "known", "left"),
    [
        (0.5, 60.0, True, ["command_delay"]),
        (0.9, 60.0, True, ["command_delay", "motor_droop"]),
        (0.5, 300.0, True, ["command_delay", "motor_droop"]),  # clear: something acts
        (0.5, 60.0, False, ["command_delay", "motor_droop"]),
    ],
)
def test_what_does_not_act_where_it_should_show_is_no_alternative(
    monkeypatch, size, lost, known, left
):
    """Against the fit with neither; of each other effect's own size there, as colour has it."""
    problem, fit, quadratic = fitted_with(0.0)
    problem = replace(problem, engine=SimpleNamespace(threads=1))
    rest = replace(fit, active=(), objective=lost)
    others = {e: replace(fit, active=(e,), objective=0.0) for e in ("command_delay", "motor_droop")}

    def there(problem: Problem, fit: Fit, without: Fit, colour: float) -> SizeWhereMost:
        assert without is rest and colour == 1.5
        return SizeWhereMost(0.01, size if fit.active == ("motor_droop",) else 1.0, 0.02)

    monkeypatch.setattr(evidence, "size_where_most", there)
    monkeypatch.setattr(evidence, "is_much_coloured", lambda problem, fit: False)
    monkeypatch.setattr(confounding, "inflation", lambda *given: 1.5)
    monkeypatch.setattr(confounding, "channels_of", lambda *given: [])
    monkeypatch.setattr(confounding, "_of_one", lambda *given: others)
    worth = {"axial_damping": Evidence(lost, 1.5, rest=rest if known else None)}
    found = confounding.alternatives(problem, fit, quadratic, worth, {})
    assert sorted(found["axial_damping"]) == left


@pytest.mark.parametrize("kept", [True, False])
def test_a_likelier_alternative_stays_where_it_stands_once_weighed(monkeypatch, kept):
    problem, fit, quadratic = fitted_with(0.0)
    other = replace(fit, active=("rotor_drag",))
    asked = []

    def weighed(problem: Problem, fit: Fit) -> tuple[Any, ...]:
        asked.append(fit.active)
        there = fit if fit.active == ("axial_damping",) or kept else replace(fit, active=())
        return problem, there, quadratic, {}

    engine = SimpleNamespace(filter=lambda values, noise: [])
    monkeypatch.setattr(confounding, "weighed", weighed)
    monkeypatch.setattr(confounding, "whiteness", lambda passes, channels: {})
    monkeypatch.setattr(confounding, "alternatives", lambda *given: {})
    monkeypatch.setattr(confounding, "likelier", lambda *given: other)
    monkeypatch.setattr(confounding, "as_named", lambda problem, fit, other: other)
    there = settled(replace(problem, engine=engine), fit).fit
    assert asked == [("axial_damping",), ("rotor_drag",)]
    assert there.active == (("rotor_drag",) if kept else ("axial_damping",))


@pytest.mark.parametrize(
    ("hides", "denied", "adds", "stands", "named"),
    [
        (True, False, "sonar_delay", True, ("wind", "sonar_delay")),
        (True, False, "sonar_delay", False, ("wind",)),  # it does not stand, nor what stood before
        (True, False, None, True, ("wind",)),
        (False, False, "sonar_delay", True, ("wind",)),
        (False, True, "sonar_delay", True, ("wind", "sonar_delay")),
        (False, True, "worse", True, ("wind",)),  # with it runs are flown worse
    ],
)
def test_what_stood_for_a_cause_may_fall_and_the_cause_be_found(
    monkeypatch, hides, denied, adds, stands, named
):
    """Where noise may hide it, or what fell was denied; what fell is not looked for again, nor what was
    denied put in another's place."""
    problem, fit, quadratic = fitted_with(0.0)
    every = ("wind", "motor_lag", "sonar_delay", "worse")
    problem = replace(problem, own={e: (FreeParameter(f"{e}.time", 0.0, 1.0),) for e in every})
    fit = replace(fit, active=("wind", "motor_lag"))
    asked: list[tuple[str, ...]] = []
    looked: list[set[str]] = []

    def weighed(problem: Problem, fit: Fit) -> tuple[Any, ...]:
        assert ("motor_lag" in problem.candidates) == (not asked or not denied)
        asked.append(fit.active)
        kept = [e for e in fit.active if e != "motor_lag"]
        if "sonar_delay" in kept and not stands:
            kept = ["sonar_delay"]
        gone = frozenset({"motor_lag"} if denied else set())
        return problem, replace(fit, active=tuple(kept), denied=gone), quadratic, {}

    def search(problem: Problem, fit: Fit) -> tuple[Fit, Quadratic]:
        assert fit.active == ("wind",) and set(problem.candidates) == {*every} - {"motor_lag"}
        return replace(fit, active=(*fit.active, adds) if adds else fit.active), quadratic

    monkeypatch.setattr(confounding, "noise_may_hide", lambda problem, fit: hides)
    monkeypatch.setattr(confounding, "weighed", weighed)
    monkeypatch.setattr(confounding, "search", search)
    monkeypatch.setattr(confounding, "as_named", lambda problem, fit, other: other)
    monkeypatch.setattr(confounding, "fitted", lambda problem, fit: fit)
    monkeypatch.setattr(confounding, "noise_fitted", lambda problem, fit: fit)
    monkeypatch.setattr(confounding, "whiteness", lambda passes, channels: {})
    monkeypatch.setattr(
        confounding, "alternatives", lambda problem, *_: looked.append({*problem.candidates}) or {}
    )
    monkeypatch.setattr(confounding, "likelier", lambda *given: None)
    monkeypatch.setattr(
        confounding, "_flies_a_run_worse", lambda found, other: "worse" in found.fit.active
    )
    engine = SimpleNamespace(filter=lambda values, noise: [])
    assert settled(replace(problem, engine=engine), fit).fit.active == named
    assert len(asked) == (2 if (hides or denied) and adds else 1)
    assert all(("motor_lag" in own) != denied for own in looked)


@pytest.mark.parametrize(
    ("coloured", "heights", "worse"),
    [
        (True, (0.4, 1.1), True),  # in the mean nearer
        (True, (0.4, 0.9), False),
        (True, (0.4, math.nan), True),  # it diverges
        (False, (0.4, 1.1), False),
    ],
)
def test_where_much_is_coloured_every_run_must_be_flown_no_worse(
    monkeypatch, coloured, heights, worse
):
    problem, fit, quadratic = fitted_with(0.0)
    problem = replace(problem, engine=SimpleNamespace(threads=1))
    more = replace(fit, active=(*fit.active, "rotor_drag"))
    found, other = (
        Settled(problem, of.at({"is": len(of.active)}), quadratic, {}, [], {}) for of in (more, fit)
    )

    def flown(engine: Any, values: Any, noise: Noise, horizon: float) -> list[RunReplay]:
        errors = heights if values["is"] == len(more.active) else (1.0, 1.0)
        return [
            RunReplay("", {"h": SimpleNamespace(error=np.full(9, e))}, math.isnan(e), {})  # type: ignore[dict-item]
            for e in errors
        ]

    monkeypatch.setattr(confounding, "is_much_coloured", lambda problem, fit: coloured)
    monkeypatch.setattr(confounding, "replay_runs", flown)
    assert confounding._flies_a_run_worse(found, other) == worse


def test_nothing_is_averaged_over_without_a_cause_nor_what_no_model_has_beside_it():
    problem, fit, quadratic = fitted_with(-8.0)
    none = replace(fit, active=())
    assert undecided(problem, none, quadratic) == {}
    np.testing.assert_array_equal(of_undecided(problem, none, quadratic), np.zeros((1, 1)))
    delay = FreeParameter("servo_delay.time", 0.0, 0.02)
    lag = FreeParameter(LAG, 0.0, 0.04)
    servo = replace(problem, own={"servo_lag": (lag,), "servo_delay": (delay,)})
    there: Any = SimpleNamespace(index=lambda names: [0], best=lambda names: (0.0, np.zeros(1)))
    assert undecided(servo, replace(fit, active=("servo_lag",)), there) == {}


def test_what_an_undecided_effect_would_make_of_a_number_is_said():
    """A drag as likely as not, with which the damping is 0.4 of what it is without."""
    problem, fit, quadratic = fitted_with(-8.0)
    fit = fit.at({DAMPING: 10.0})
    (probability, move) = undecided(problem, fit, quadratic)["rotor_drag"]
    far = math.sqrt(probability) * abs(move[1]) / quadratic.std([MASS, DAMPING])[DAMPING]
    assert far > problem.settings.moved_by_undecided
    (said,) = remarks._resting_on_undecided(problem, fit, quadratic, {"axial_damping": {}})
    assert said.startswith(f"{DAMPING} = 10 holds without rotor_drag")
    assert said.endswith(f"with it {10.0 + move[1]:.3g} fits as well")
    problem, fit, quadratic = fitted_with(-0.1)
    assert remarks._resting_on_undecided(problem, fit, quadratic, {"axial_damping": {}}) == []


@pytest.mark.parametrize(
    ("effect", "across", "aboard", "asked", "alike"),
    [
        ("gyro_scale", 0.01, ("psi", "r"), False, ["magnetic_field"]),
        # a gyro that no heading is read by is off, too
        ("gyro_scale", 0.05, ("psi", "r"), False, []),
        ("gyro_scale", 0.01, ("psi", "r"), True, []),  # headings turn: it is tried in its place
        ("gyro_scale", 0.01, ("r",), False, []),
        ("gyro_bias", 0.01, ("psi", "r"), False, []),
    ],
)
def test_where_headings_hardly_turn_a_gyros_scale_may_be_a_magnetic_field(
    effect, across, aboard, asked, alike
):
    """Two flights that hid a magnetic field had a gyro's scale, sure (**synthetic**)."""
    free = [FreeParameter(f"{effect}.{axis}", 0.0, 0.1) for axis in "xyz"]
    problem: Any = SimpleNamespace(
        candidates=("magnetic_field",) if asked else (), aboard=frozenset(aboard),
        own={effect: free}, model=SimpleNamespace(vehicle=SimpleNamespace(effects={})),
        free_names=lambda active: [f.name for f in free],
    )  # fmt: skip
    values = dict(zip([f.name for f in free], (across, 0.0, 0.08), strict=True))
    quadratic: Any = SimpleNamespace(std=lambda names: dict.fromkeys(names, 0.02))
    fit = Fit((effect,), values, Noise({}))
    assert alike_unturned(problem, fit, quadratic, effect) == alike


def test_a_turn_tells_a_gyros_scale_from_a_magnetic_field():
    alike = {"effect": "gyro_scale", "confusable_with": ["magnetic_field"]}
    advice = turn_that_tells([{"effect": "wind", "confusable_with": []}, alike])
    assert advice is not None and advice["maneuver"] in MANEUVERS
    assert advice["separates"] == ["gyro_scale", "magnetic_field"]
    assert turn_that_tells([alike | {"confusable_with": []}]) is None
