"""In which order a search moves: what it fits, adds, drops and tries, its moves given by hand."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from coax_env.diagnosis import search as module
from coax_env.diagnosis.problem import LATE_ROTORS, Fit, Problem
from coax_env.diagnosis.scores import Score
from coax_env.diagnosis.search import _forward, _Memory, search
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation.state_space import Noise

PROBLEM: Any = SimpleNamespace(settings=SETTINGS, free_names=lambda active: [])
FIT = Fit((), {}, Noise({}), objective=100.0)


@pytest.fixture
def moves(monkeypatch):
    """What a search does, in words; gains of a step and scores are given, moves end by themselves."""
    done: list[str] = []
    given: dict[str, Any] = {"gains": [], "scores": [], "add": [], "drop": [], "latent": []}

    def linearise(problem: Any, fit: Fit) -> Any:
        gain = given["gains"].pop(0) if given["gains"] else 0.0
        return fit, [], SimpleNamespace(best=lambda names: (-gain, None))

    def step(problem: Any, fit: Fit, passes: Any, quadratic: Any) -> Fit:
        done.append("step")
        return fit

    def fitted(problem: Any, fit: Fit, steps: int, tolerance: float) -> Fit:
        assert (steps, tolerance) == (SETTINGS.most_steps, SETTINGS.step_gain)
        done.append("fit")
        return fit

    def add(problem: Any, fit: Fit, passes: Any, quadratic: Any, strong: Any) -> Fit | None:
        if not strong or not given["add"]:
            return None
        done.append(f"add {strong[0].effect}")
        return replace(fit, active=(*fit.active, given["add"].pop(0)))

    def drop(problem: Any, fit: Fit, quadratic: Any, coloured: bool) -> Fit | None:
        done.append("drop, coloured" if coloured else "drop?")
        gone = given["drop"].pop(0) if given["drop"] else None
        return None if gone is None else replace(fit, active=fit.rest(gone))

    def latent(problem: Any, fit: Fit) -> Fit | None:
        done.append("latent?")
        return fit if given["latent"] and given["latent"].pop(0) else None

    def noise_fitted(problem: Any, fit: Fit) -> Fit:
        done.append("noise")
        return fit

    monkeypatch.setattr(module, "linearise", linearise)
    monkeypatch.setattr(module, "stepped", step)
    monkeypatch.setattr(module, "fitted", fitted)
    monkeypatch.setattr(module, "add", add)
    monkeypatch.setattr(module, "drop", drop)
    monkeypatch.setattr(module, "with_latent_noise", latent)
    monkeypatch.setattr(module, "noise_fitted", noise_fitted)
    monkeypatch.setattr(module, "_in_brief_gusts", lambda *given: None)
    monkeypatch.setattr(module, "noise_may_hide", lambda problem, fit: False)
    monkeypatch.setattr(module, "_nearest", lambda problem, *given: problem)
    monkeypatch.setattr(module, "threshold", lambda problem, q, active: SETTINGS.evidence)
    monkeypatch.setattr(module, "swaps", lambda *given: iter(()))
    monkeypatch.setattr(module, "trials", lambda *given: ([], []))
    monkeypatch.setattr(module, "runners_up", lambda *given: {})
    monkeypatch.setattr(module, "exchanged", lambda *given: None)
    monkeypatch.setattr(module, "scores", lambda p, fit, q, banned: [
        c for c in (given["scores"].pop(0) if given["scores"] else []) if c.effect not in banned
    ])  # fmt: skip
    return given, done


def score(effect: str, nats: float) -> Score:
    return Score(effect, nats, nats, True)


END = ["drop?", "latent?", "drop, coloured"]


def test_where_nothing_is_to_be_found_it_asks_once_and_ends(moves):
    _, done = moves
    fit, _ = search(PROBLEM, FIT)
    assert done == END and fit.active == ()


@pytest.mark.parametrize(("gain", "fits"), [(1.9, False), (2.1, True)])
def test_what_a_step_would_gain_two_nats_of_is_fitted_first(moves, gain, fits):
    given, done = moves
    given["gains"] = [gain]
    search(PROBLEM, FIT)
    assert done == (["step", "fit", *END] if fits else END)


@pytest.mark.parametrize(("nats", "at_once"), [(51.0, True), (49.0, False)])
def test_ten_times_what_a_step_gains_is_added_before_it(moves, nats, at_once):
    given, done = moves
    given["gains"] = [5.0]
    given["scores"] = [[score("wind", nats)]] * (1 if at_once else 2)
    given["add"] = ["wind"]
    fit, _ = search(PROBLEM, FIT)
    first = ["add wind"] if at_once else ["step", "fit", "drop?", "add wind"]
    assert done == [*first, "noise", *END] and fit.active == ("wind",)
    assert fit.strongest == (nats, "wind")


@pytest.mark.parametrize(("nats", "added"), [(14.1, True), (13.9, False)])
def test_what_has_evidence_is_added(moves, nats, added):
    given, _ = moves
    given["scores"], given["add"] = [[score("wind", nats)]], ["wind"]
    fit, _ = search(PROBLEM, FIT)
    assert (fit.active == ("wind",)) == added and fit.strongest == (nats, "wind")


@pytest.mark.parametrize(
    ("names", "order"),
    [
        (["wind", "servo_delay", "accel_bias", "servo_lag"],
         ["wind", "servo_lag", "servo_delay", "accel_bias"]),
        (["servo_lag", "wind", "servo_delay"], ["servo_lag", "wind", "servo_delay"]),
        (["servo_delay", "wind"], ["servo_delay", "wind"]),
        ([], []),
    ],
)  # fmt: skip
def test_a_servos_lag_is_tried_before_its_delay(names, order):
    strong = [SimpleNamespace(effect=name) for name in names]
    assert [c.effect for c in module._lag_first(strong)] == order  # type: ignore[arg-type]


def test_what_was_dropped_is_not_added_at_once_again(moves):
    """But once another has been added and has held."""
    given, done = moves
    wind, drag = score("wind", 30.0), score("rotor_drag", 40.0)
    given["scores"] = [[wind], [wind], [wind, drag]]
    given["add"], given["drop"] = ["wind", "rotor_drag"], [None, "wind"]
    fit, _ = search(PROBLEM, FIT)
    assert done[:5] == ["drop?", "add wind", "noise", "drop?", "noise"]
    assert done[5:7] == ["drop?", "add rotor_drag"] and fit.active == ("rotor_drag",)


@pytest.mark.parametrize("found", [True, False])
@pytest.mark.parametrize(
    ("nats", "hides", "first"), [(41.9, True, True), (42.1, True, False), (41.9, False, False)]
)
def test_a_weak_addition_waits_for_what_noise_may_hide(
    moves, monkeypatch, nats, hides, first, found
):
    """Under three thresholds, where it may; each set of effects is asked for once."""
    given, done = moves
    asked: list[tuple[str, ...]] = []

    def anew(problem: Any, fit: Fit, quadratic: Any, candidates: Any, tried: Any) -> Any:
        asked.append(tuple(c.effect for c in candidates if (*fit.active, c.effect) not in tried))
        done.append("noise anew")
        there = replace(fit, active=(*fit.active, "sonar_delay")).noted("+ sonar_delay", 58.0)
        return (there if found and not fit.active else None), ["wind", "sonar_delay"]

    monkeypatch.setattr(module, "with_noise_anew", anew)
    monkeypatch.setattr(module, "noise_may_hide", lambda problem, fit: hides)
    given["scores"] = [[score("wind", nats), score("sonar_delay", 4.3)]]
    given["add"] = ["wind"]
    fit, _ = search(PROBLEM, FIT)
    assert fit.active == (("sonar_delay",) if first and found else ("wind",))
    assert done[1] == ("noise anew" if first else "add wind")
    assert not first or asked[0] == ("wind", "sonar_delay")
    assert fit.strongest == ((58.0, "sonar_delay") if first and found else (nats, "wind"))


def test_before_the_search_ends_what_noise_may_hide_is_asked_for_once(moves, monkeypatch):
    given, done = moves
    tried_before: list[Any] = []

    def anew(problem: Any, fit: Fit, quadratic: Any, candidates: Any, tried: Any) -> Any:
        tried_before.append(set(tried))
        there = replace(fit, active=("wind",)).noted("+ wind", 20.0) if not fit.active else None
        return there, ["wind", "gyro_bias"]

    monkeypatch.setattr(module, "with_noise_anew", anew)
    monkeypatch.setattr(module, "noise_may_hide", lambda problem, fit: True)
    given["scores"] = [[score("wind", 5.0)]]
    fit, _ = search(PROBLEM, FIT)
    assert fit.active == ("wind",) and "add wind" not in done
    assert tried_before == [set(), {("wind",), ("gyro_bias",)}]


def test_a_coloured_drop_ends_the_additions(moves):
    given, done = moves
    begin = replace(FIT, active=("wind",))
    given["drop"] = [None, "wind"]
    given["scores"] = [[], [score("rotor_drag", 90.0)]]
    given["add"] = ["rotor_drag"]
    fit, _ = search(PROBLEM, begin)
    assert done == [*END, "noise", "drop, coloured"] and fit.active == ()


def test_few_candidates_are_linearised_between_additions_and_all_before_the_end(moves, monkeypatch):
    given, done = moves
    few: Any = SimpleNamespace(**vars(PROBLEM))
    seen: list[Any] = []
    linearise = module.linearise
    monkeypatch.setattr(module, "_nearest", lambda *given: few)
    monkeypatch.setattr(module, "linearise", lambda p, fit: seen.append(p) or linearise(p, fit))
    given["scores"] = [[score("wind", 30.0)], [], [score("rotor_drag", 20.0)]]
    given["add"] = ["wind", "rotor_drag"]
    fit, _ = search(PROBLEM, FIT)
    assert fit.active == ("wind", "rotor_drag")
    assert [p is few for p in seen] == [False, True, False, True, False]
    of_few = ["noise", "drop?", "drop?"]
    assert done == ["drop?", "add wind", *of_few, "add rotor_drag", *of_few, *END[1:]]


def test_near_are_those_that_may_gain_more_than_a_tie_and_what_is_kept(monkeypatch):
    gains = {"wind": 6.1, "rotor_drag": 5.9, "gyro_bias": -1.0}
    monkeypatch.setattr(module, "most_gains", lambda *given: (0.0, gains))
    problem = Problem(None, None, (), dict.fromkeys([*gains, "servo_lag"], ()))  # type: ignore[arg-type]
    near = module._nearest(problem, FIT, None, ["servo_lag"])  # type: ignore[arg-type]
    assert near.candidates == ("wind", "servo_lag")


def test_after_three_additions_that_did_not_hold_no_more_are_made(moves):
    """One that holds, with more beside it than ever held, begins the count anew."""
    given, _ = moves
    memory = _Memory(failures=2)
    strong = [score("wind", 30.0)]
    given["add"] = ["wind", "rotor_drag", "gyro_bias"]
    one = _forward(PROBLEM, FIT, [], None, strong, strong, memory)  # type: ignore[arg-type]
    assert one is not None and memory.failures == 2 and memory.most == 0
    memory.banned, memory.drops = {"a", "b"}, module.Counter({"a": 2, "b": 1})
    two = _forward(PROBLEM, one, [], None, strong, strong, memory)  # type: ignore[arg-type]
    assert two is not None and memory.failures == 0 and memory.most == 1
    assert memory.banned == {"a"}, "what was dropped twice stays banned"
    memory.failures = 3
    assert _forward(PROBLEM, two, [], None, strong, strong, memory) is None  # type: ignore[arg-type]


def test_in_brief_gusts_all_weak_effects_leave_but_what_was_worth_most_when_it_came(monkeypatch):
    """Once for each set of effects; what is worth ten thresholds is not asked to leave."""
    worth = {"yaw_damping": 99.0, "spin_up_reaction": 70.0, "servo_play": 268.0, "motor_lag": 5.0,
             "gyro_bias": 20.0}  # fmt: skip
    history = (("+ yaw_damping", 63.0), ("+ spin_up_reaction", 410.0), ("- yaw_damping", 900.0),
               ("+ servo_play", 51.0), ("+ motor_lag", 15.0))  # fmt: skip
    fit = Fit(tuple(worth), {}, Noise({}), history=history)
    asked: list[list[str]] = []
    monkeypatch.setattr(module, "loss", lambda problem, q, active, e, inflation: worth[e])
    monkeypatch.setattr(module, "threshold", lambda problem, q, active: SETTINGS.evidence)
    monkeypatch.setattr(module, "dropped_in_brief_gusts", lambda p, f, q, gone, enough:
                        asked.append(list(gone)))  # fmt: skip
    memory = _Memory()
    quadratic: Any = None
    for _ in range(2):
        module._in_brief_gusts(PROBLEM, fit, quadratic, memory)
    assert asked == [["yaw_damping", "motor_lag"]]
    module._in_brief_gusts(PROBLEM, replace(fit, active=("motor_lag",)), quadratic, memory)
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("active", "candidates", "aboard", "asked"),
    [
        (("yaw_damping",), LATE_ROTORS, {"phi"}, True),
        (("command_delay", "wind"), LATE_ROTORS, {"phi", "r"}, True),
        (("motor_lag",), LATE_ROTORS, {"phi"}, True),
        (("wind",), LATE_ROTORS, {"phi"}, False),  # nothing that is late or weak
        (("yaw_damping",), LATE_ROTORS[:1], {"phi"}, False),
        (("yaw_damping",), LATE_ROTORS, {"phi", "rpm_lower"}, False),  # they are seen
        (LATE_ROTORS, LATE_ROTORS, {"phi"}, False),
        ((), LATE_ROTORS, {"phi"}, False),
    ],
)
def test_late_rotors_are_asked_for_once_where_nobody_sees_them(
    monkeypatch, active, candidates, aboard, asked
):
    beside: list[tuple[str, ...]] = []
    monkeypatch.setattr(module, "late_rotors", lambda problem, fit, q: beside.append(fit.active))
    problem: Any = SimpleNamespace(
        candidates=candidates, model=SimpleNamespace(moments={}), aboard=frozenset(aboard)
    )
    memory, quadratic = _Memory(), SimpleNamespace()
    for _ in range(2):
        fit = replace(FIT, active=active)
        assert module._with_late_rotors(problem, fit, quadratic, memory) is None
    assert beside == [active] * asked


@pytest.mark.parametrize(
    ("active", "dropped", "asked"),
    [
        ("motor_lag", ["spin_up_reaction"], False),
        ("motor_lag", ["wind"], True),
        ("yaw_damping", ["spin_up_reaction"], True),  # neither is there
    ],
)
def test_late_rotors_are_not_asked_for_again_beside_one_when_the_other_was_dropped(
    monkeypatch, active, dropped, asked
):
    beside: list[tuple[str, ...]] = []
    monkeypatch.setattr(module, "late_rotors", lambda problem, fit, q: beside.append(fit.active))
    problem: Any = SimpleNamespace(
        candidates=LATE_ROTORS, model=SimpleNamespace(moments={}), aboard=frozenset({"phi"})
    )
    memory, quadratic = _Memory(), SimpleNamespace()
    memory.drops.update(dropped)
    module._with_late_rotors(problem, replace(FIT, active=(active,)), quadratic, memory)
    assert beside == [(active,)] * asked
