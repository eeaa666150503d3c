"""Two flights of one machine: what changed is named, and "the same" is the answer where nothing did."""

from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bundled_flight import bundled
from shared_flights import read
from study import pairs

from coax_env.comparison import search
from coax_env.comparison.candidates import Score, scored
from coax_env.comparison.compare import compare
from coax_env.comparison.information import Information
from coax_env.comparison.logbook import logbook, over_time
from coax_env.comparison.search import Changed
from coax_env.comparison.two_flights import ROTOR_SPEED, MachineModel, read_two
from coax_env.comparison.two_logs.difference import of_one_flight
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.settings import SETTINGS
from coax_env.errors import InputError
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import RISE, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.parted_engine import Part, PartedEngine, joint_noise
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.logs.edits import edited
from coax_env.logs.flight import Flight, Run, read_flight, write_flight
from coax_env.model.vehicle_file import load_vehicle
from coax_env.report import change_headline


@cache
def flight() -> Flight:
    """Two runs, four seconds each."""
    runs = []
    for run in bundled().select(("lon_3211", "yaw_3211")).runs:
        rows = run.t < run.t[0] + 4.0
        measured = {c: values[rows] for c, values in run.measured.items()}
        runs.append(replace(run, t=run.t[rows], command=run.command[rows], measured=measured))
    return replace(bundled(), runs=tuple(runs))


# --- two logs of one flight -------------------------------------------------------------------------


@pytest.mark.slow
def test_two_logs_of_one_flight_are_told_from_two_flights():
    log = flight()
    (first, second), rng = log.runs, np.random.default_rng(1)
    noisy = {c: v + 0.01 * rng.standard_normal(v.size) for c, v in first.measured.items()}
    assert of_one_flight(log, edited(log, {"theta": 0.03, "gain": 1.25}))
    assert not of_one_flight(log, replace(log, runs=(replace(first, measured=noisy), second)))
    assert not of_one_flight(log, replace(log, runs=(replace(first, t=first.t + 0.001), second)))
    assert not of_one_flight(log, replace(log, runs=log.runs[:1]))


@pytest.mark.slow
def test_what_one_log_says_differently_is_found_from_its_row_on(tmp_path):
    """Too little for two flights with noise of their own: 0.01 rad, in half of a run."""
    log = bundled().select(("lon_3211", "lat_3211"))
    logs = (log, edited(log, {"theta": 0.01}, ("lat_3211", 6.0)))
    folders = [write_flight(one, tmp_path / name) for one, name in zip(logs, "ab", strict=True)]
    found = compare(*folders).changes
    (change,) = found["changes"]
    p = change["parameters"]["attitude_bias.y"]
    assert change["effect"] == "attitude_bias" and abs(p["change"] - 0.01) < 2.0 * p["std"] < 2e-3
    assert found["since"]["run"] == "lat_3211" and abs(found["since"]["t"] - 6.0) < 0.05
    assert "two logs of one flight" in found["remarks"][0]
    assert change_headline(found) == "Two logs of one flight differ by attitude bias"


# --- one likelihood of two flights ------------------------------------------------------------------


@cache
def two() -> tuple[PartedEngine, dict[str, float], object, list[FreeParameter]]:
    """A run each, the second one's mass a number of its own."""
    vehicle = load_vehicle("lama400d").in_air(flight().air)
    model = MachineModel(vehicle)
    engines = [Engine(model, [record_of(run)]) for run in flight().runs]
    engine = PartedEngine([Part(n, e) for n, e in zip("AB", engines, strict=True)])
    noise = starting_noise(flight(), vehicle)
    values = {**vehicle.values(), "added_mass.mass": 0.0, "added_mass.mass@B": -0.03}
    free = [
        FreeParameter("added_mass.mass", 0.0, 0.05),
        FreeParameter("added_mass.mass@B", 0.0, 0.05),
    ]
    return engine, values, joint_noise({"A": noise, "B": noise}), free


def test_the_joint_likelihood_is_the_parts_sum():
    engine, values, noise, _ = two()
    apart = [
        part.engine.log_likelihood(
            {n: v for n, v in values.items() if "@" not in n}
            | {"added_mass.mass": -0.03 if part.name == "B" else 0.0},
            part.noise(noise),
        )
        for part in engine.parts
    ]
    assert engine.log_likelihood(values, noise) == pytest.approx(sum(apart), rel=1e-12)


def test_a_change_is_the_second_flights_share_of_a_number():
    """Its column is the number's own in B, and nothing in A."""
    engine, values, noise, free = two()
    _, lin = engine.linearise(values, noise, free)
    of_a, of_b = lin.information
    np.testing.assert_allclose(of_b, of_b[0, 0], rtol=1e-9)
    assert of_a[0, 0] > 0.0 and not of_a[1].any() and not of_a[:, 1].any()
    np.testing.assert_allclose(lin.slope[1], lin.slope[1, 0], rtol=1e-9)


def test_rotors_that_turn_faster_per_command_are_commands_that_are_larger():
    """What the rotors end slow rows above the means of theirs is larger, too."""
    vehicle = load_vehicle("lama400d")
    run = flight().runs[0]
    values = vehicle.values()
    model = MachineModel(vehicle)
    sent = replace(record_of(run), of_next=0.375)
    faster = model.inputs(sent, model.vector({**values, ROTOR_SPEED: 0.04}))
    larger = record_of(edited(flight(), {"rotor_scale": 1.04}).runs[0])
    larger = replace(larger, of_next=0.375)
    expected = model.inputs(larger, model.vector(values))
    commands = slice(RISE.start)
    np.testing.assert_allclose(faster[:, commands], expected[:, commands], rtol=1e-12)
    # differences of commands: to their own rounding
    np.testing.assert_allclose(faster[:, RISE], expected[:, RISE], rtol=1e-12, atol=1e-10)


def test_a_changes_score_is_its_log_bayes_factor():
    """One number x under N(0, s2), data N(x, 1/information): closed form, Jeffreys 1961."""
    information, z, s = 400.0, 0.3, 0.2
    quadratic = Quadratic(
        ("x@B",), np.array([[information]]), np.array([-information * z]), np.zeros(1), np.zeros(1),
        np.array([1.0 / s**2]), np.array([-10.0]), np.array([10.0]),
        np.zeros((1, 1)), np.zeros((1, 1)),
    )  # fmt: skip
    group = (FreeParameter("x@B", 0.0, s),)
    problem = Problem(None, None, (), {})
    score = scored(problem, quadratic, "x", group)
    spread = s**2 + 1.0 / information  # of z under the change; without it 1 / information
    exact = 0.5 * z**2 * (information - 1.0 / spread) - 0.5 * np.log(spread * information)
    assert score.nats == pytest.approx(exact, rel=1e-12)


# --- a change stands by both likelihoods --------------------------------------------------------------


@dataclass(frozen=True)
class Numbers:
    """Stands for a problem: what is free in it."""

    added: tuple[str, ...]

    def with_fixed(self, names: set[str]) -> "Numbers":
        return self


def standing_of(monkeypatch, effects: tuple[str, ...], alone, joint, stated: bool) -> Any:
    """The changes that `standing` leaves, with evidence by set of changes of each likelihood [nats]."""

    def pruned(state: Changed, clear=()):
        table = alone if state.problem.added == ("own",) else joint
        while state.effects:
            nats = table[frozenset(state.effects)]
            weakest = min(state.effects, key=nats.__getitem__)
            if nats[weakest] >= 14.0:
                return state, None, {e: search.Weighed(nats[e], 1.0, nats[e]) for e in nats}
            state = state.with_only(set(state.effects) - {weakest})
        return state, None, {}

    def with_gains(problem, fit, coloured=False):
        return Numbers(("own", "gain")), fit

    def without_gains(problem, fit):
        return Numbers(("own",)), fit

    monkeypatch.setattr(search, "pruned", pruned)
    monkeypatch.setattr(search, "with_pilots", with_gains)
    monkeypatch.setattr(search, "without_pilots", without_gains)
    problem, fit = (with_gains if stated else without_gains)(None, Fit((), {}, Noise({})))
    state, _, evidence = search.standing(Changed(problem, fit, effects, dict.fromkeys(effects, ())))
    assert state.problem.added == problem.added and set(evidence) == set(state.effects)
    return {e: evidence[e].nats for e in state.effects}


@pytest.mark.parametrize("stated", [False, True])
def test_a_change_stands_by_the_readings_and_by_what_commands_show(monkeypatch, stated):
    """A late servo that one of them does not carry leaves; the other change is asked again."""
    alone = {frozenset({"servo_delay", "mass"}): {"servo_delay": 18.0, "mass": 90.0}}
    joint = {frozenset({"servo_delay", "mass"}): {"servo_delay": -3.0, "mass": 70.0}}
    for table, mass in ((alone, 87.0), (joint, 77.0)):
        table[frozenset({"mass"})] = {"mass": mass}
    for tables in ((alone, joint), (joint, alone)):
        found = standing_of(monkeypatch, ("servo_delay", "mass"), *tables, stated)
        assert found == {"mass": 77.0}


@pytest.mark.parametrize(
    ("begun", "ended", "worth", "named"),
    [(-50.0, -80.0, 60.0, True), (-50.0, -30.0, 60.0, False), (-50.0, -80.0, 10.0, False)],
)
def test_a_change_is_refused_with_its_noise_fitted_to_the_end(
    monkeypatch, begun, ended, worth, named
):
    """Noise levels begin far from where they end: a centre of gravity worth 52 nats was refused so."""
    problem = SimpleNamespace(settings=SETTINGS, report=lambda text: None)
    turn = Fit((), {}, Noise({}))

    class Begun(Changed):
        def converged(self) -> Changed:
            return replace(self, fit=replace(self.fit, objective=ended if self.effects else -45.0))

    def proposed(state: Changed, quadratic, score: Score) -> Changed:
        return Begun(problem, replace(turn, objective=begun + 20.0), (score.effect,), {})

    monkeypatch.setattr(search, "_fitted_with", proposed)
    state = Begun(problem, replace(turn, objective=-40.0), (), {})
    found = search._accepted(state, None, [Score("cg_offset", worth + 5.0, 5.0, {}, {})])
    assert (found is not None) == named


# --- what is refused --------------------------------------------------------------------------------


def test_parts_of_one_flight_are_named_by_its_card(tmp_path):
    first, second = flight().runs
    both = replace(flight(), runs=(replace(first, part="A"), replace(second, part="B")))
    write_flight(both, tmp_path / "f")
    a, b = read_two(tmp_path / "f", None, None)
    assert (a.flight.run_names, b.flight.run_names) == (("lon_3211",), ("yaw_3211",))
    with pytest.raises(InputError, match=r'no \[\[run\]\] says part = "A"'):
        read_two(flight(), None, None)
    card = tmp_path / "f" / "card.toml"
    card.write_text(card.read_text().replace('part = "B"', 'part = "C"'))
    with pytest.raises(InputError, match=r'run\]\] 2 part should be "A" or "B", found \'C\''):
        read_flight(tmp_path / "f")


def test_flights_of_two_vehicles_are_refused():
    with pytest.raises(InputError, match="flights of two vehicles, lama400d and skybotix_coax"):
        read_two(flight(), replace(flight(), vehicle="skybotix_coax"), None)


def test_a_logbook_needs_two_flights(tmp_path):
    write_flight(flight(), tmp_path / "one")
    with pytest.raises(InputError, match="1 flights; a logbook needs two"):
        logbook(tmp_path)
    write_flight(flight(), tmp_path / "two")
    with pytest.raises(InputError, match="the same flight as"):
        logbook(tmp_path)


# --- numbers over flights ---------------------------------------------------------------------------


def says(value: float, std: float) -> Information:
    """A flight that knows one number."""
    return Information(
        ("mass",), np.array([value]), np.zeros(1), np.array([[1.0 / std**2]]), np.array([0.8]),
        np.array([0.1]), 1.0,
    )  # fmt: skip


def link(a: Information, b: Information, changes: list[dict]) -> dict:
    return {"information": [a.as_json(), b.as_json()], "changes": changes, "shared": []}


def test_the_posterior_of_the_last_flight_is_the_prior_of_the_next():
    first, second = says(0.78, 0.02), says(0.80, 0.01)
    rows = over_time([link(first, second, [])])["mass"]["flights"]
    precision = 1.0 / np.array([0.1, 0.02, 0.01]) ** 2
    told = np.cumsum(precision * [0.8, 0.78, 0.80])
    for row, k in zip(rows, (1, 2), strict=True):
        assert row["value"] == pytest.approx(told[k] / precision[: k + 1].sum())
        assert row["std"] == pytest.approx(precision[: k + 1].sum() ** -0.5)
    alone = (precision[0] * 0.8 + precision[2] * 0.80) / (precision[0] + precision[2])
    assert rows[1]["alone"] == pytest.approx(alone)


def test_what_a_flight_says_is_kept_to_the_last_digit():
    rng = np.random.default_rng(0)
    square = rng.normal(size=(3, 3))
    kept = Information(
        ("a", "b", "c"), *rng.normal(size=(2, 3)), square @ square.T, *rng.normal(size=(2, 3)), 1.3
    )
    back = Information.of_json(kept.as_json())
    for name in ("at", "slope", "matrix", "mean", "std"):
        np.testing.assert_array_equal(getattr(back, name), getattr(kept, name))
    assert (back.names, back.inflation) == (kept.names, kept.inflation)


# --- planted changes --------------------------------------------------------------------------------


def pair(change: dict[str, dict[str, float]], seed: int) -> pairs.Pair:
    """Still air, other densities, pilots and batteries; the same faults in both."""
    return pairs.Pair(
        0, change, pairs.FAULTS[0], ({"gusts": "none"}, {"gusts": "none"}), (1.2, 1.09),
        ("usual", "slow_human"), 0.98, seed,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("change", [{}, {"added_mass": {"mass": -0.06}}])
def test_what_changed_is_named_and_nothing_else(change, tmp_path, monkeypatch):
    monkeypatch.setattr(pairs, "LONGEST", 4.0)  # s of each of four runs
    a, b = pairs.fly(pair(change, 5), tmp_path)
    found = compare(a, b).changes
    assert [c["effect"] for c in found["changes"]] == list(change), found["changes"]
    assert found["verdict"] == ("changed" if change else "same")
    for c in found["changes"]:
        for name, p in c["parameters"].items():
            planted = change[c["effect"]].get(name.partition(".")[2], 0.0)
            assert abs(p["change"] - planted) < 3.0 * p["std"], name
            # known better than if all that neither flight shows were free
            assert p["std"] < 0.9 * found["bounds"][name]["std"], name


@pytest.mark.slow
def test_a_logbook_grows_by_one_comparison(tmp_path, monkeypatch):
    monkeypatch.setattr(pairs, "LONGEST", 4.0)
    monkeypatch.setattr(pairs, "RUNS", ("lon_3211", "heave_3211"))
    pairs.fly(pair({}, 20), tmp_path)
    first = logbook(tmp_path)
    assert first["changes"] == [] and len(first["links"]) == 1
    again = logbook(tmp_path, kept=first, done=lambda content: pytest.fail("compared again"))
    assert again["numbers"] == first["numbers"]


@pytest.mark.slow
@pytest.mark.needs_shared_flights
def test_halves_of_a_real_flight_are_the_same():
    """The second CoaX, 20 s against the next 20 s: coloured innovations, and no change."""
    log = read("skybotix_second").select(["4x5ft_2"])
    a, b = (replace(log, runs=tuple(_half(run, late) for run in log.runs)) for late in (0, 1))
    assert compare(a, b).changes["changes"] == []


def _half(run: Run, late: int) -> Run:
    """The first half of a run, or the second."""
    return run.of_rows((run.t >= 0.5 * (run.t[0] + run.t[-1])) == bool(late))
