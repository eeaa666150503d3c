"""When a search is done again: with readings believed less, where that flies better."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from coax_env import load_vehicle
from coax_env.diagnosis import fits
from coax_env.diagnosis import problem as problem_module
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.searches import once, readings, rotors, searched, unrest
from coax_env.diagnosis.searches.once import Searched
from coax_env.diagnosis.sensor_errors import LastingErrors
from coax_env.diagnosis.sensor_low_pass import hidden_behind
from coax_env.diagnosis.settings import SETTINGS
from coax_env.estimation import whiteness
from coax_env.estimation.helicopter import HeliModel, Moment
from coax_env.estimation.helicopter_noise import JITTER_LEVEL, JITTER_MEMORY, LEAST_READING_STD
from coax_env.estimation.low_pass import LowPass
from coax_env.estimation.rotor_jitter import with_jitter
from coax_env.estimation.state_space import FreeParameter, Noise, Record
from coax_env.model.layout import ACCELEROMETERS, GYROS, ROTOR_SPEEDS, RPM_PER_RAD_S

MODULES = (once, rotors, readings, unrest, searched)


def stand_in(monkeypatch: pytest.MonkeyPatch, name: str, instead: Any) -> None:
    """Something else of that name wherever a search is done."""
    having = [module for module in MODULES if hasattr(module, name)]
    assert having, f"no search has {name!r}"
    for module in having:
        monkeypatch.setattr(module, name, instead)


@pytest.fixture(autouse=True)
def _one_air(monkeypatch):
    """On all runs, but where a test says otherwise."""
    stand_in(monkeypatch, "with_own_air", lambda problem, fit: None)


@pytest.fixture(autouse=True)
def _steady_rotors(monkeypatch):
    """Whose speeds are their commands, read as they are, but where a test says otherwise."""
    stand_in(monkeypatch, "_rotors_stray", lambda problem: False)
    stand_in(monkeypatch, "with_late_speeds", lambda *asked, coloured=False: None)


@pytest.fixture(autouse=True)
def _commands_on_time(monkeypatch):
    """Written when they act, held between the rows, gyros on time, but where a test says otherwise."""
    stand_in(monkeypatch, "likeliest_between", lambda problem, noise: problem)
    stand_in(monkeypatch, "are_held", lambda problem: True)
    stand_in(monkeypatch, "from_reaction", lambda first: first)
    stand_in(monkeypatch, "commands_late", lambda first: 0.0)
    stand_in(monkeypatch, "with_imu_on_time", lambda first, smoothed, noise: None)


IMU_ON_TIME = readings.with_imu_on_time


def test_readings_much_finer_than_a_rigid_body_are_made_coarser():
    """Twice as fine and more; those that are coarser already are left alone."""
    reading = {"phi": 0.0029, "theta": 0.0031, "h": 0.0024, "q": 0.5}
    found = unrest._coarser(Noise({}, reading))
    assert found == {"phi": LEAST_READING_STD["phi"], "h": LEAST_READING_STD["h"]}


@pytest.mark.parametrize(
    ("ours", "better"),
    [({"h": 0.5, "q": 1.9}, True), ({"h": 0.5, "q": 2.1}, False), ({"h": 1.1, "q": 0.9}, True),
     ({"h": 1.0, "q": 1.0}, False), ({"h": 0.9, "ax": 9.0}, True), ({"ax": 0.1}, False)],
)  # fmt: skip
def test_errors_are_compared_by_their_geometric_mean(monkeypatch, ours, better):
    """Half of one error and twice another is no better; channels that the other lacks do not count."""
    theirs = {"h": 1.0, "q": 1.0, "ax": 0.0}
    stand_in(monkeypatch, "flown_errors", lambda problem, fit: fit.values["rms"])
    problem: Any = SimpleNamespace(settings=SETTINGS, engine=None)
    fits: Any = [Fit((), {"rms": rms}, Noise({})) for rms in (ours, theirs)]  # type: ignore
    found, other = (Searched(problem, f, f, f, None) for f in fits)  # type: ignore[arg-type]
    assert once.flies_nearer(found, other) == better


def test_runs_are_flown_over_the_settings_horizon_by_the_fits_numbers_and_noise(monkeypatch):
    asked = []
    run = SimpleNamespace(
        diverged=False, channels={"h": SimpleNamespace(error=np.array([3.0, -4.0]))}
    )
    monkeypatch.setattr(fits, "replay_runs", lambda *given: asked.append(given) or [run])
    settings = replace(SETTINGS, horizon=0.7)
    problem: Any = SimpleNamespace(settings=settings, engine="engine")
    fit = Fit((), {"mass": 0.4}, Noise({"force": 1.0}))
    assert fits.flown_errors(problem, fit) == {"h": pytest.approx(np.sqrt(12.5))}
    assert asked == [("engine", fit.values, fit.noise, 0.7)]


FINE = Noise({}, {"phi": 0.001})


@pytest.mark.parametrize(
    ("white", "flies", "stds", "kept"),
    [
        (True, [], [0.001], 0),
        (False, [False, False], [0.001, 0.006, 0.018], 0),
        (False, [True, False], [0.001, 0.006, 0.018], 1),
        (False, [False, True], [0.001, 0.006, 0.018], 2),
        (False, [True, True], [0.001, 0.006, 0.018], 2),
    ],
)
def test_readings_are_believed_less_where_that_flies_better(monkeypatch, white, flies, stds, kept):
    """At most what a rigid body is, then three times that; white innovations need nothing."""
    asked, answers = [], list(flies)

    def one(problem: Any, noise: Noise, coarse: bool = False) -> Any:
        asked.append(noise.reading["phi"])
        fit = Fit((), {}, noise)
        return Searched(problem, fit, fit, fit, None, coarse)  # type: ignore[arg-type]

    stand_in(monkeypatch, "searched_once", one)
    believes_its_sensors(monkeypatch)
    stand_in(monkeypatch, "low_passes", lambda problem, fit, noise: {})
    stand_in(monkeypatch, "with_swings", lambda problem, fit: None)
    stand_in(monkeypatch, "is_coloured", lambda found, channels: False)
    stand_in(monkeypatch, "in_shocks", lambda problem, fit: False)
    stand_in(monkeypatch, "is_all_white", lambda problem, fit: white)
    stand_in(monkeypatch, "flies_nearer", lambda *found: answers.pop(0))
    engine = SimpleNamespace(filter=lambda values, noise: [])
    problem = SimpleNamespace(
        engine=engine, model=SimpleNamespace(channels=()), report=lambda text: None, smoothed=False
    )
    found = searched.searched(problem, FINE, {})  # type: ignore[arg-type]
    assert asked == pytest.approx(stds) and found.coarse == (kept > 0)
    assert found.fit.noise.reading["phi"] == pytest.approx(stds[kept])


def test_readings_that_are_coarse_enough_are_held_as_they_were_fitted(monkeypatch):
    """Not as the card has them: with angles at half their noise a **synthetic** flight by poses alone
    had an attitude delay of 1,596 nats and a swash phase, and inertias at 0.3 of theirs."""
    asked = []

    def one(problem: Any, noise: Noise, coarse: bool = False) -> Any:
        asked.append(dict(noise.reading))
        fit = Fit((), {}, noise if coarse else Noise({}, {"phi": 0.01, "h": 0.0004}))
        return Searched(problem, fit, fit, fit, None, coarse)  # type: ignore[arg-type]

    believes_its_sensors(monkeypatch)
    stand_in(monkeypatch, "searched_once", one)
    stand_in(monkeypatch, "in_shocks", lambda problem, fit: False)
    stand_in(monkeypatch, "with_swings", lambda problem, fit: None)
    stand_in(monkeypatch, "is_all_white", lambda problem, fit: False)
    stand_in(monkeypatch, "flies_nearer", lambda *found: False)
    problem: Any = SimpleNamespace(
        engine=SimpleNamespace(filter=lambda values, noise: []), report=lambda text: None,
        model=SimpleNamespace(channels=()),
    )  # fmt: skip
    given = Noise({}, {"phi": 0.005, "h": 0.0002})
    best = one(problem, given)
    unrest.in_unrest(best, given, {}, erring=False)
    assert asked[1] == {"phi": 0.01, "h": LEAST_READING_STD["h"]}


# --- rotors first -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("memory", "read", "strays"),
    [(0.0, True, False), (0.5, True, True), (0.5, False, False)],
)
def test_rotors_stray_where_what_parts_them_from_their_commands_has_a_memory(
    monkeypatch, memory, read, strays
):
    """White readings about the command do not, nor does a scale that is wrong by a constant."""
    monkeypatch.undo()
    rng = np.random.default_rng(3)
    white = 0.2 * rng.standard_normal(1000)
    apart = lfilter([1.0], [1.0, -memory], white) + 5.0
    command = np.full((1000, 4), 210.0)
    z = np.full((1000, 2), np.nan)
    if read:
        z[:, 1] = RPM_PER_RAD_S * (command[:, 1] + apart)
    record = Record("hover", 0.01 * np.arange(1000), command, z)
    problem: Any = SimpleNamespace(
        model=SimpleNamespace(channels=ROTOR_SPEEDS), engine=SimpleNamespace(records=[record])
    )
    assert rotors._rotors_stray(problem) == strays


LAGGING = 0.03


@pytest.mark.parametrize(
    ("lagging", "commanded", "found", "unshown"),
    [
        (True, True, LAGGING, False),
        (False, True, LAGGING, True),  # jitter with that memory
        (True, False, LAGGING, True),  # of shaken rotors under one command nothing is told
        (False, True, 0.004, True),  # shorter than a row
    ],
)
def test_a_lag_must_be_shown_by_answers_to_commands(lagging, commanded, found, unshown):
    """Rotors that are shaken, in both with the memory of the lag; readings 2 rev/min off."""
    rng = np.random.default_rng(5)
    n, dt = 2000, 0.01
    steps = 210.0 + 4.0 * np.repeat(rng.standard_normal((n // 20, 1)), 20, axis=0)
    command = np.tile(steps if commanded else np.full((n, 1), 210.0), (1, 4))
    stays = np.exp(-dt / LAGGING)
    shaken = lfilter([1.0], [1.0, -stays], 0.2 * rng.standard_normal(n))
    speed = command[:, 0].copy()
    if lagging:
        for k in range(n - 1):
            speed[k + 1] = command[k, 0] + stays * (speed[k] - command[k, 0])
    read = RPM_PER_RAD_S * (speed + shaken) + 2.0 * rng.standard_normal(n)
    record = Record(
        "hover", dt * np.arange(n), command, np.stack([read, np.full(n, np.nan)], axis=1)
    )
    names = [FreeParameter(f"motor_lag.{rotor}", 0.0, 0.1) for rotor in ("upper", "lower")]
    problem: Any = SimpleNamespace(
        row=dt, own={"motor_lag": names}, aboard=frozenset(ROTOR_SPEEDS[:1]),
        model=SimpleNamespace(channels=ROTOR_SPEEDS), engine=SimpleNamespace(records=[record]),
    )  # fmt: skip
    fit = Fit(("motor_lag",), {f.name: found for f in names}, FINE)
    asked: Any = SimpleNamespace(problem=problem, fit=fit)
    assert rotors.is_lag_unshown(asked) == unshown
    assert not rotors.is_lag_unshown(SimpleNamespace(problem=problem, fit=replace(fit, active=())))
    problem.aboard = frozenset({"r"})
    assert not rotors.is_lag_unshown(asked), "no speed is read"


@pytest.mark.parametrize(
    ("coloured", "unshown", "asked"),
    [(False, False, False), (True, False, True), (False, True, True)],
)
def test_jitter_is_asked_where_speeds_are_coloured_or_a_lag_is_not_shown(
    monkeypatch, coloured, unshown, asked
):
    levels = Noise({"rotor_jitter": 0.2})

    def one(problem: Any, noise: Noise) -> Any:
        fit = Fit(("motor_lag",), {}, noise)
        return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]

    def jittery(found: Searched, noise: Noise) -> Any:
        return replace(found, fit=Fit((), {}, levels)), levels

    for name, instead in {
        "searched_once": one, "jittery": jittery, "is_lag_unshown": lambda found: unshown,
        "is_coloured": lambda found, channels: coloured and found.fit.active != (),
        "with_true_times": lambda found, noise: found, "in_own_air": lambda found, noise: found,
        "before_low_passes": lambda first, noise: None,
        "with_errors": lambda found, noise, clock: (found, noise),
        "in_unrest": lambda best, noise, clock, erring: best,
    }.items():  # fmt: skip
        stand_in(monkeypatch, name, instead)
    problem: Any = SimpleNamespace(smoothed=False)
    found = searched.searched(problem, FINE, {})
    assert found.fit.active == (() if asked else ("motor_lag",))


@pytest.mark.parametrize(
    ("white", "gained", "jitters", "begins"),
    [
        ("at once", 900.0, False, ("motor_lag",)),
        ("beside a drift", 900.0, False, ("motor_lag",)),  # 3,898 nats of jitter that is not there
        ("never", 900.0, True, ()),  # at once, and everything is searched for in it
        ("never", 139.0, False, ("motor_lag",)),  # asked after the search, as ever
        ("never", None, False, ("motor_lag",)),
    ],
)
def test_what_moves_the_rotors_comes_first_and_plain_jitter_with_it(
    monkeypatch, white, gained, jitters, begins
):
    lag = Fit(("motor_lag",), {}, FINE, objective=1000.0)
    drifting = replace(lag, noise=FINE.with_levels({"trim_force_z": 0.1}))
    wider: Any = SimpleNamespace(model="wider", report=lambda text: None)
    asked: list[tuple[Any, tuple[str, ...]]] = []

    def jitter(problem: Any, fit: Fit, quadratic: object) -> Any:
        assert fit is drifting
        return None if gained is None else (wider, replace(fit, objective=1000.0 - gained))

    def from_there(problem: Any, bare: Fit, refitted: Fit, begin: Fit) -> Any:
        assert begin is (lag if white == "at once" else drifting)
        asked.append((problem, begin.active))
        return "found"

    def whole(problem: Any, noise: Noise) -> Any:
        asked.append((problem, ()))
        return "found"

    problem: Any = SimpleNamespace(
        settings=SETTINGS, of_candidates=lambda names: names, report=lambda text: None,
        engine=SimpleNamespace(filter=lambda values, noise: []), model=SimpleNamespace(channels=()),
    )  # fmt: skip
    bare = Fit((), {}, FINE)
    given = {
        "_rotors_stray": lambda problem: True, "as_given": lambda problem, noise: (bare, bare),
        "added": lambda problem, fit: (lag, None),
        "is_coloured": lambda found, channels: white == "never" or (
            white == "beside a drift" and found.fit is lag),
        "_in_noise_anew": lambda problem, fit, noise: drifting,
        "in_jitter": jitter, "searched_once": whole, "nothing_forgotten": lambda best, fit: best,
        "searched_from": from_there, "_with_levels_of_jitter": lambda noise, wider, fit: "begun",
    }  # fmt: skip
    for name, instead in given.items():
        stand_in(monkeypatch, name, instead)
    found = rotors.rotors_first(problem, FINE)
    assert found == ("found", "begun" if jitters else FINE)
    assert asked == [(wider if jitters else problem, begins)]
    stand_in(monkeypatch, "_rotors_stray", lambda problem: False)
    assert rotors.rotors_first(problem, FINE) is None


@pytest.mark.parametrize("nats", [999.0, 1001.0])
def test_noise_from_the_first_guess_stands_where_that_is_likelier(monkeypatch, nats):
    """What was fitted beside rotors that do not lag may have no way back."""
    lag = Fit(("motor_lag",), {}, FINE.with_levels({"white_force_z": 9.0}), objective=1000.0)

    def from_guess(problem: Any, fit: Fit, noise: Noise) -> Fit:
        assert fit is lag and noise is FINE
        return replace(fit, noise=noise)

    stand_in(monkeypatch, "in_noise_from", from_guess)
    stand_in(monkeypatch, "noise_fitted", lambda problem, fit: fit)
    stand_in(monkeypatch, "fitted", lambda problem, fit: replace(fit, objective=nats))
    found = rotors._in_noise_anew(None, lag, FINE)  # type: ignore[arg-type]
    assert found.noise is (FINE if nats < 1000.0 else lag.noise)


def believes_its_sensors(monkeypatch) -> None:
    """No errors that last, times that are right, white rotor speeds, gusts that push or turn."""
    stand_in(monkeypatch, "lasting_errors", lambda problem, fit, noise: None)
    stand_in(monkeypatch, "with_clock_errors", lambda problem, fit: None)
    stand_in(monkeypatch, "in_joint_gusts", lambda problem, fit: None)
    stand_in(monkeypatch, "_may_hide_jitter", lambda found: False)
    stand_in(monkeypatch, "is_much_coloured", lambda problem, fit: False)
    stand_in(monkeypatch, "is_coloured", lambda found, channels: False)


@pytest.mark.parametrize(
    ("had", "costs", "active"),
    [
        ((), {}, ("wind",)),  # nothing had been found: one search
        (("accel_bias",), {"wind": 90.0, "accel_bias": 100.0}, ("wind",)),
        (("accel_bias",), {"wind": 90.0, "accel_bias": 80.0}, ("accel_bias",)),
    ],
)
def test_errors_that_last_take_up_no_cause_that_had_been_found(monkeypatch, had, costs, active):
    """From it, and from none: the likelier end stands; readings are not believed less then."""
    plain, wider = (
        SimpleNamespace(name=name, report=lambda text: None, low_passes={}, smoothed=False)
        for name in ("plain", "wider")
    )
    asked: list[Any] = []

    def one(problem: Any, noise: Noise, coarse: bool = False) -> Searched:
        fit = Fit(("wind",) if problem is wider else had, {}, noise)
        return Searched(problem, fit, fit, fit, None, coarse)  # type: ignore[arg-type]

    stand_in(monkeypatch, "searched_once", one)
    believes_its_sensors(monkeypatch)
    lasting = Noise({"error_gyros": 0.1}, {"phi": 0.2})
    errors = lambda problem, fit, noise: LastingErrors(wider, fit, lasting, 90.0, True)  # noqa: E731
    stand_in(monkeypatch, "lasting_errors", errors)
    stand_in(monkeypatch, "_white_since", lambda best, clock, gained: None)
    stand_in(monkeypatch, "search", lambda problem, fit: (fit, None))
    stand_in(monkeypatch, "is_coloured", lambda found, channels: False)
    stand_in(monkeypatch, "with_swings", lambda problem, fit: asked.append(problem))
    stand_in(monkeypatch, "cost", lambda problem, fit, quadratic: costs[fit.active[0]])
    stand_in(monkeypatch, "low_passes", lambda problem, fit, noise: {})
    stand_in(monkeypatch, "in_shocks", lambda problem, fit: False)
    found = searched.searched(plain, FINE, {})  # type: ignore[arg-type]
    assert found.problem is wider and found.fit.active == active
    assert found.refitted.noise is lasting and asked == [wider]


@pytest.mark.parametrize(
    ("onsets", "white", "worth", "used"),
    [
        ({"gyro_bias": None}, True, 90.0, True),
        ({"gyro_bias": None}, False, 90.0, False),
        ({}, True, 90.0, False),
        ({"gyro_bias": None}, True, 10.0, False),  # errors are worth ten times as much
    ],
)
def test_what_changed_once_is_no_error_that_lasts(monkeypatch, onsets, white, worth, used):
    """Where it leaves nothing coloured; such errors take up a gyro that drifts off and stays."""
    engine = SimpleNamespace(filter=lambda values, noise: [])
    problem = SimpleNamespace(engine=engine, model=SimpleNamespace(channels=()))
    fit = Fit((), {}, FINE)
    state = SimpleNamespace(problem=problem, fit=fit, onsets=onsets)
    stand_in(monkeypatch, "with_onsets", lambda *given: state)
    stand_in(monkeypatch, "is_all_white", lambda problem, fit: white)
    first = Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]
    stand_in(monkeypatch, "most_by_change", lambda *found: worth)
    changed = readings._white_since(first, {}, 100.0)
    assert (changed is not None) == used and (changed is None or changed.changing is state)


@pytest.mark.parametrize("white", [True, False])
def test_gusts_with_a_frequency_are_searched_beside_from_their_own_levels(monkeypatch, white):
    """Nothing is coloured then, and nothing else is asked; what a model lacks may swing, too."""
    asked: list[tuple[Any, float]] = []

    def one(problem: Any, noise: Noise, coarse: bool = False) -> Searched:
        asked.append((problem, noise.level("force_xy")))
        fit = Fit((), {}, noise)
        return Searched(problem, fit, fit, fit, None, coarse)  # type: ignore[arg-type]

    engine, model = SimpleNamespace(filter=lambda values, noise: []), SimpleNamespace(channels=())
    fading, swinging = (
        SimpleNamespace(report=lambda text: None, engine=engine, model=model, smoothed=False)
        for _ in range(2)
    )
    stand_in(monkeypatch, "is_all_white", lambda problem, fit: white)
    stand_in(monkeypatch, "searched_once", one)
    believes_its_sensors(monkeypatch)
    stand_in(monkeypatch, "low_passes", lambda problem, fit, noise: {})
    stand_in(monkeypatch, "in_shocks", lambda problem, fit: False)
    stand_in(monkeypatch, "is_coloured", lambda found, channels: False)
    stand_in(monkeypatch, "with_swings", lambda problem, fit: (swinging, {"force_xy": 0.7}))
    stand_in(monkeypatch, "with_other_swings", lambda problem, fit: None)
    found = searched.searched(fading, Noise({"force_xy": 0.2}), {})  # type: ignore[arg-type]
    assert asked == [(fading, 0.2), (swinging, 0.7)]
    assert found.problem is (swinging if white else fading)


@pytest.mark.parametrize(("costs", "used"), [((5.0, 3.0), True), ((3.0, 5.0), False)])
def test_a_swing_that_what_was_found_had_hidden_is_searched_beside_where_that_is_likelier(
    monkeypatch, costs, used
):
    engine = SimpleNamespace(filter=lambda values, noise: [])
    model = SimpleNamespace(channels=())
    fading, swinging, other = (
        SimpleNamespace(name=name, report=lambda text: None, engine=engine, model=model)
        for name in ("fading", "swinging", "other")
    )
    worth = dict(zip(("swinging", "other"), costs, strict=True))

    def of(problem: Any, noise: Noise) -> Searched:
        fit = Fit((), {}, noise)
        return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]

    stand_in(monkeypatch, "with_swings", lambda problem, fit: (swinging, {"force_xy": 0.7}))
    stand_in(monkeypatch, "with_other_swings", lambda p, fit: (other, {"force_xy": 0.9}))
    stand_in(monkeypatch, "searched_once", of)
    stand_in(monkeypatch, "cost", lambda problem, fit, quadratic: worth[problem.name])
    stand_in(monkeypatch, "is_all_white", lambda problem, fit: True)
    noise = Noise({"force_xy": 0.2})
    found = unrest._in_swings(of(fading, noise), noise)
    assert found is not None and found.problem is (other if used else swinging)
    assert found.fit.noise.level("force_xy") == (0.9 if used else 0.7)


@pytest.mark.parametrize(
    ("left", "white", "likelier", "asked", "ends"),
    [
        (False, True, False, ["swings"], "swinging"),
        (True, True, False, ["swings", "shocks"], "shaken"),
        (False, False, False, ["swings", "shocks"], "shaken"),
        (True, True, True, ["swings", "shocks"], "swinging"),
        (False, False, True, ["swings", "shocks"], "swinging"),
    ],
)
def test_swings_are_asked_before_shocks_and_stand_where_none_are_left_or_they_are_likelier(
    monkeypatch, left, white, likelier, asked, ends
):
    """A model of gusts that fade sees shocks in them."""
    done: list[str] = []
    fit = Fit((), {}, FINE)
    found = {
        name: Searched(SimpleNamespace(name=name), fit, fit, fit, None)  # type: ignore[arg-type]
        for name in ("fading", "swinging", "shaken")
    }

    def of(name: str, found: Searched) -> Searched:
        done.append(name)
        return found

    believes_its_sensors(monkeypatch)
    stand_in(monkeypatch, "in_shocks", lambda problem, fit: problem.name == "fading" or left)
    stand_in(monkeypatch, "_in_swings", lambda best, noise: of("swings", found["swinging"]))
    stand_in(monkeypatch, "is_all_white", lambda problem, fit: white)
    stand_in(monkeypatch, "_are_swings", lambda swung, shaken: likelier)
    stand_in(monkeypatch, "_changed", lambda best, clock: None)
    stand_in(monkeypatch, "_searched_in_shocks", lambda best, noise: of("shocks", found["shaken"]))
    end = unrest.in_unrest(found["fading"], FINE, {}, erring=True)
    assert done == asked and end is found[ends]


@pytest.mark.parametrize(
    ("gained", "coloured", "changed", "swings"),
    [
        (42.1, False, False, True),
        (41.9, False, False, False),
        (900.0, True, False, False),  # the model lacks something else
        (900.0, False, True, False),  # a change looked like a shock
    ],
)
def test_gusts_swing_where_that_is_likelier_than_shocks_by_what_makes_a_name_sure(
    monkeypatch, gained, coloured, changed, swings
):
    """Strengths cost their prior."""
    fit = Fit((), {}, FINE)
    swinging, shocks = (
        SimpleNamespace(settings=SETTINGS, cost=cost, engine=SimpleNamespace(records=[]))
        for cost in (-1000.0, gained - 1030.0)
    )
    stand_in(monkeypatch, "is_much_coloured", lambda problem, fit: coloured)
    stand_in(monkeypatch, "cost", lambda problem, fit, quadratic: problem.cost)
    stand_in(monkeypatch, "prior_cost", lambda records: 30.0)
    swung = Searched(swinging, fit, fit, fit, None)  # type: ignore[arg-type]
    shaken = Searched(shocks, fit, fit, fit, None)  # type: ignore[arg-type]
    changing: Any = SimpleNamespace() if changed else None
    assert unrest._are_swings(swung, replace(shaken, changing=changing)) == swings


@pytest.mark.parametrize(
    ("rotors", "rate", "gained", "order"),
    [
        (
            True,
            True,
            True,
            ["jitter", "low-passes", "swings"],
        ),  # rotor speeds tell it by themselves
        (False, True, True, ["low-passes", "swings", "jitter", "swings"]),
        (
            False,
            True,
            False,
            ["low-passes", "swings", "jitter"],
        ),  # rotors do not: nothing new to ask
        (False, False, False, ["low-passes", "swings"]),
    ],
)
def test_jitter_is_asked_first_where_rotor_speeds_show_it_and_gusts_beside_it(
    monkeypatch, rotors, rate, gained, order
):
    asked: list[str] = []
    engine, model = SimpleNamespace(filter=lambda values, noise: []), SimpleNamespace(channels=())
    stand_in(monkeypatch, "is_all_white", lambda problem, fit: True)
    plain, jittery, swinging = (
        SimpleNamespace(
            name=name, report=lambda text: None, engine=engine, model=model, smoothed=False
        )
        for name in ("p", "j", "s")
    )

    def of(problem: Any, noise: Noise) -> Searched:
        fit = Fit((), {}, noise)
        return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]

    def with_swings(problem: Any, fit: Fit) -> Any:
        asked.append("swings")
        return (swinging, {"force_xy": 0.7}) if problem is jittery else None

    def with_jitter(found: Searched, noise: Noise) -> tuple[Searched, Noise]:
        asked.append("jitter")
        return (of(jittery, noise), noise) if gained else (found, noise)

    def coloured(found: Searched, channels: Any) -> bool:
        return found.problem is plain and (rate if "r" in channels else rotors)

    stand_in(monkeypatch, "in_shocks", lambda problem, fit: False)
    stand_in(monkeypatch, "with_swings", with_swings)
    stand_in(monkeypatch, "with_other_swings", lambda problem, fit: None)
    stand_in(monkeypatch, "jittery", with_jitter)
    stand_in(monkeypatch, "searched_once", of)
    stand_in(monkeypatch, "before_low_passes", lambda first, noise: asked.append("low-passes"))
    believes_its_sensors(monkeypatch)
    stand_in(monkeypatch, "is_coloured", coloured)
    found = searched.searched(plain, Noise({"force_xy": 0.2}), {})  # type: ignore[arg-type]
    assert asked == order
    assert found.problem is (swinging if gained else plain)
    assert found.fit.noise.level("force_xy") == (0.7 if gained else 0.2)


@pytest.mark.parametrize(("wrong", "problem"), [(True, "wrong"), (False, "right")])
def test_where_times_are_wrong_all_is_searched_so(monkeypatch, wrong, problem):
    """Before anything else is asked that readings show."""
    right, other = (
        SimpleNamespace(name=name, report=lambda text: None, smoothed=False)
        for name in ("right", "wrong")
    )
    asked = []

    def one(problem: Any, noise: Noise) -> Searched:
        asked.append(problem.name)
        fit = Fit((), {}, noise)
        return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]

    believes_its_sensors(monkeypatch)
    stand_in(monkeypatch, "searched_once", one)
    stand_in(monkeypatch, "with_clock_errors", lambda problem, fit: other if wrong else None)
    stand_in(monkeypatch, "before_low_passes", lambda first, noise: None)
    stand_in(monkeypatch, "in_unrest", lambda best, noise, clock, erring: best)
    found = searched.searched(right, FINE, {})  # type: ignore[arg-type]
    assert found.problem.name == problem and asked == (["right", "wrong"] if wrong else ["right"])


@pytest.mark.parametrize(
    ("costs", "before", "after", "used"),
    [
        ((100.0, 90.0), 0.09, 0.09, True),
        ((90.0, 100.0), 0.0, 0.0, False),
        ((100.0, 90.0), 0.05, 0.11, False),
        ((100.0, 90.0), 0.11, 0.05, False),
    ],
)
def test_joint_gusts_stand_where_they_are_likelier_and_leave_little_coloured(
    monkeypatch, costs, before, after, used
):
    """From the search that ended likelier."""
    plain, joint = (
        SimpleNamespace(
            name=name, model=SimpleNamespace(channels=tuple("abcd")), report=lambda text: None,
            engine=SimpleNamespace(filter=lambda values, noise, name=name: name),
        )
        for name in ("plain", "joint")
    )  # fmt: skip
    fit = Fit((), {}, FINE)
    first = Searched(plain, fit, fit, fit, None)  # type: ignore[arg-type]
    mean = {"plain": before, "joint": after}
    shown = lambda name, channels: {  # noqa: E731
        "a": SimpleNamespace(coloured_share=2.0 * mean[name]),
        "b": SimpleNamespace(coloured_share=0.0),
    }
    stand_in(monkeypatch, "in_joint_gusts", lambda problem, fit: (joint, fit))
    stand_in(
        monkeypatch, "searched_once", lambda problem, noise, coarse: replace(first, problem=problem)
    )
    stand_in(monkeypatch, "cost", lambda problem, fit, quadratic: costs[problem.name == "joint"])
    monkeypatch.setattr(whiteness, "whiteness", shown)
    found = unrest._with_joint_gusts(first, FINE)
    assert (found.problem is joint) == used
    assert found is first or used


@pytest.mark.parametrize(
    ("had", "then", "used"),
    [
        ({}, {"accel_bias": 4.9}, True),
        ({}, {"accel_bias": 5.0}, False),
        ({"accel_bias": 5.0}, {"accel_bias": 5.0}, True),  # not by them
        ({"accel_bias": 5.0}, {"wind": 1.0}, True),
    ],
)
def test_joint_gusts_stand_where_they_need_no_name_at_its_limit(monkeypatch, had, then, used):
    """Sizes are usual ones, of which five are the most."""
    plain, joint = (SimpleNamespace(report=lambda text: None) for _ in range(2))
    first, other = (
        Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]
        for problem, fit in (
            (plain, Fit(tuple(had), had, FINE)),
            (joint, Fit(tuple(then), then, FINE)),
        )
    )
    stand_in(monkeypatch, "is_much_coloured", lambda problem, fit: False)
    stand_in(monkeypatch, "in_joint_gusts", lambda problem, fit: (joint, other.fit))
    stand_in(monkeypatch, "searched_once", lambda problem, noise, coarse: other)
    stand_in(monkeypatch, "likelier", lambda best, fit: best)
    stand_in(monkeypatch, "cost", lambda problem, fit, _: 9.0 if problem is joint else 10.0)
    stand_in(monkeypatch, "sizes", lambda problem, fit, effect: {effect: fit.values[effect]})
    assert (unrest._with_joint_gusts(first, FINE).problem is joint) == used


@pytest.mark.parametrize(
    ("alone", "aboard", "active", "coloured", "may"),
    [
        (True, {"psi"}, ("yaw_damping",), False, True),
        (True, {"psi"}, (), False, False),
        (True, {"psi", "rpm_upper"}, ("yaw_damping",), False, False),  # rotor speeds would show it
        (False, {"r"}, ("yaw_damping",), False, False),  # so would a gyro
        (True, {"psi"}, ("yaw_damping",), True, False),  # the model lacks something else
    ],
)
def test_jitter_is_asked_by_poses_alone_where_something_is_named(
    monkeypatch, alone, aboard, active, coloured, may
):
    stand_in(monkeypatch, "is_much_coloured", lambda problem, fit: coloured)
    problem = SimpleNamespace(sees_poses_alone=alone, aboard=frozenset(aboard))
    found = SimpleNamespace(problem=problem, fit=Fit(active, {}, FINE))
    assert rotors._may_hide_jitter(found) == may  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("cost", "aboard", "coloured", "used"),
    [
        (90.0, {"rpm_upper"}, False, True),
        (110.0, {"rpm_upper"}, False, False),
        (90.0, {"rpm_upper"}, True, True),  # rotor speeds show it
        (90.0, {"r"}, True, False),  # the model lacks something else
        (90.0, {"r"}, False, True),
    ],
)
def test_jitter_stands_where_the_search_in_it_ends_likelier(
    monkeypatch, cost, aboard, coloured, used
):
    """With the level and memory from which that search began; and where it is what is seen."""
    stand_in(monkeypatch, "is_much_coloured", lambda problem, fit: coloured)
    noise = with_jitter(FINE, HeliModel(load_vehicle("lama400d")))
    there = Fit((), {}, noise.with_levels({JITTER_LEVEL: 0.4, JITTER_MEMORY: 0.07}))
    wider = SimpleNamespace(report=lambda text: None, model=HeliModel(load_vehicle("lama400d")))
    costs = {"found": 100.0, "wider": cost}
    stand_in(monkeypatch, "in_jitter", lambda problem, fit, quadratic: (wider, there))
    stand_in(
        monkeypatch,
        "cost",
        lambda problem, fit, quadratic: costs["wider" if problem is wider else "found"],
    )

    def of(problem: Any, noise: Noise) -> Searched:
        fit = Fit((), {}, noise)
        return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]

    stand_in(monkeypatch, "searched_once", of)
    found = of(SimpleNamespace(aboard=frozenset(aboard)), FINE)
    again, begun = rotors.jittery(found, FINE)
    assert (again.problem is wider) == used and (again is found) != used
    if used:
        assert (begun.level(JITTER_LEVEL), begun.level(JITTER_MEMORY)) == (0.4, 0.07)
    else:
        assert begun is FINE


@pytest.mark.parametrize(
    ("had", "costs", "active", "searches"),
    [
        (("motor_lag",), {"motor_droop": 100.0, "motor_lag": 90.0}, "motor_lag", 1),
        (("motor_lag",), {"motor_droop": 90.0, "motor_lag": 100.0}, "motor_droop", 1),
        (("motor_droop",), {}, "motor_droop", 0),  # nothing was forgotten
        ((), {}, "motor_droop", 0),
    ],
)
def test_a_cause_that_jitter_was_found_beside_is_not_forgotten(
    monkeypatch, had, costs, active, searches
):
    """In jitter a droop came first where motors lag, 6,700 nats less likely (**synthetic**)."""
    begun: list[tuple[str, ...]] = []

    def search(problem: Any, fit: Fit) -> tuple[Fit, None]:
        begun.append(fit.active)
        return fit, None

    stand_in(monkeypatch, "search", search)
    stand_in(monkeypatch, "cost", lambda problem, fit, quadratic: costs[fit.active[0]])
    droop = Fit(("motor_droop",), {}, FINE)
    best = Searched(SimpleNamespace(), droop, droop, droop, None)  # type: ignore[arg-type]
    found = once.nothing_forgotten(best, replace(droop, active=had))
    assert found.fit.active == (active,) and begun == [had] * searches


@pytest.mark.parametrize(("costs", "stands"), [((9.0, 5.0), True), ((5.0, 9.0), False)])
def test_causes_of_another_problem_are_where_a_second_search_begins(monkeypatch, costs, stands):
    """With their numbers there, but for what the problem does not name; the likelier end stands."""
    begun: list[Fit] = []

    def search(problem: Any, fit: Fit) -> tuple[Fit, None]:
        begun.append(fit)
        return fit, None

    stand_in(monkeypatch, "search", search)
    stand_in(monkeypatch, "cost", lambda problem, fit, quadratic: costs["motor_lag" in fit.active])
    stand_in(monkeypatch, "fitted", lambda problem, fit: fit)
    stand_in(monkeypatch, "noise_fitted", lambda problem, fit: fit)
    own = {"motor_lag": [SimpleNamespace(name="motor_lag.upper")], "wind": []}
    said: list[str] = []
    problem: Any = SimpleNamespace(candidates=tuple(own), own=own, report=said.append)
    wind = Fit(("wind",), {"motor_lag.upper": 0.0, "mass": 1.0}, FINE)
    nothing = replace(wind, active=())
    best = Searched(problem, nothing, nothing, wind, None)  # type: ignore[arg-type]
    values = {"motor_lag.upper": 0.1, "battery_voltage.per_volt": 0.3, "mass": 2.0}
    other = replace(best, fit=Fit(("motor_lag", "battery_voltage"), values, replace(FINE)))
    found = once.from_causes_of(best, other)
    assert [fit.active for fit in begun] == [("motor_lag",)]
    assert begun[0].values == {"motor_lag.upper": 0.1, "mass": 1.0} and begun[0].noise is FINE
    assert (found.fit.active == ("motor_lag",)) == stands
    assert said == [f"from the causes found so: {4.0 if stands else 0.0:.1f} nats"]


@pytest.mark.parametrize("coloured", [True, False])
def test_air_of_each_runs_own_stands_where_little_is_coloured_in_it(monkeypatch, coloured):
    """What is coloured without it says nothing: such air colours innovations itself."""
    own = SimpleNamespace(name="own", report=lambda text: None)
    there = Fit(("motor_lag",), {}, FINE)
    asked = []

    def with_own_air(problem: Any, fit: Fit) -> Any:
        asked.append(problem)
        return own, there

    stand_in(monkeypatch, "with_own_air", with_own_air)
    stand_in(
        monkeypatch,
        "is_much_coloured",
        lambda problem, fit: coloured or (problem, fit) != (own, there),
    )
    stand_in(monkeypatch, "searched_once", lambda problem, noise: (problem.name, noise))
    fit = Fit((), {}, FINE)
    found = Searched(SimpleNamespace(), fit, fit, fit, None)  # type: ignore[arg-type]
    again: Any = unrest.in_own_air(found, FINE)
    if coloured:
        assert again == replace(found, air_asked=True)
        assert unrest.in_own_air(again, FINE) == again and len(asked) == 1, "once is enough"
    else:
        assert again == ("own", FINE)


def problem_on(monkeypatch: Any, model: Any, records: Any, candidates: tuple[str, ...]) -> Problem:
    """A problem whose engine has records, and flies nothing."""

    def engine(model: Any, records: Any, threads: int) -> Any:
        return SimpleNamespace(records=records, threads=threads)

    monkeypatch.setattr(problem_module, "Engine", engine)
    return Problem(model, engine(model, records, 1), (), dict.fromkeys(candidates, ()))


def test_readings_behind_a_low_pass_are_searched_as_they_were_before_it(monkeypatch):
    """Without what cannot be told from what is left of it."""
    t, smooth = 0.01 * np.arange(30), np.linspace(0.0, 1.0, 30)
    record = Record("a", t, np.zeros((30, 4)), np.stack([smooth, smooth], axis=1))
    model = SimpleNamespace(channels=("ax", "h"), vehicle=SimpleNamespace(effects=()))

    asked = []

    def one(problem: Any, noise: Noise, coarse: bool = False) -> Searched:
        asked.append(problem)
        fit = Fit(("thrust_exponent",), {}, noise)
        return Searched(problem, fit, fit, fit, None, coarse)  # type: ignore[arg-type]

    stand_in(monkeypatch, "searched_once", one)
    believes_its_sensors(monkeypatch)
    stand_in(monkeypatch, "in_unrest", lambda best, noise, clock, erring: best)
    stand_in(monkeypatch, "is_coloured", lambda found, channels: False)
    stand_in(monkeypatch, "low_passes", lambda problem, fit, noise: {"ax": LowPass(0.008)})
    problem = problem_on(monkeypatch, model, [record], ("thrust_exponent", "wind"))
    found = searched.searched(problem, FINE, {})
    assert found.problem.low_passes == {"ax": LowPass(0.008)}
    assert asked[0] is problem and asked[1].candidates == ("wind",)
    assert asked[1].smoothed
    searched_on = asked[1].engine.records[0].z
    share = np.exp(-0.01 / 0.008)
    ahead = smooth[2:] + share / (1.0 - share) / 29.0  # of a ramp, by its slope times the delay
    np.testing.assert_allclose(searched_on[2:, 0], ahead)
    np.testing.assert_allclose(searched_on[:, 1], smooth)


@pytest.mark.parametrize(
    ("active", "own", "smoothed", "hidden"),
    [
        ((), (), ("ax",), {"thrust_exponent"}),
        ((), (), ("p",), {"attitude_delay"}),  # no command acts on a rate within its row
        ((), (), ("p", "ax"), {"attitude_delay", "thrust_exponent"}),
        (("motor_lag",), (), ("ax",), set()),
        ((), ("motor_lag",), ("ax",), set()),
    ],
)
def test_what_hides_behind_a_low_pass(active, own, smoothed, hidden):
    problem = SimpleNamespace(model=SimpleNamespace(vehicle=SimpleNamespace(effects=own)))
    fit = Fit(active, {}, FINE)
    passes = dict.fromkeys(smoothed, LowPass(0.008))
    assert hidden_behind(passes, fit, problem) == hidden  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("late", "gyros", "hides"),
    [
        (0.048, LowPass(0.004), False),
        (0.012, LowPass(0.026), True),  # taken back too far, gyros are ahead
        (0.007, LowPass(0.004), True),
        (0.011, LowPass(0.004, 2), True),  # late by 5.7 ms
        (0.012, LowPass(0.004, 2), False),
    ],
)
def test_attitudes_that_come_later_than_a_low_pass_do_so_by_themselves(late, gyros, hides):
    problem = SimpleNamespace(model=SimpleNamespace(vehicle=SimpleNamespace(effects=())))
    fit = Fit(("attitude_delay",), {"attitude_delay.time": late}, FINE)
    passes = {"p": LowPass(0.002), "q": gyros, "ax": LowPass(0.05)}
    found = hidden_behind(passes, fit, problem)  # type: ignore[arg-type]
    assert found - {"thrust_exponent"} == ({"attitude_delay"} if hides else set())


@pytest.mark.parametrize(
    ("white", "found", "nats", "beside", "taken"),
    [
        (False, ("wind",), 0.0, ["wind"], "steady"),  # not white with strengths: none are used
        # stands them, and its own
        (True, ("wind",), 90.0, ["wind", "refitted", "wind"], "strengths 3"),
        (True, (), 30.0, ["wind", "refitted"], "strengths 2"),  # what shocks took up stays so
        (True, (), 90.0, ["wind", "refitted"], "strengths 1"),  # but where it is likelier, surely
        (True, ("cg_offset",), 90.0, ["wind", "refitted", "cg_offset"], "strengths 1"),
    ],
)
def test_strengths_of_gusts_are_fitted_beside_what_stood_them(
    monkeypatch, white, found, nats, beside, taken
):
    """The engine's likelihoods are no part of this: which model's strengths are asked, and used."""
    asked: list[str] = []

    def shaken(problem: Any, fit: Any) -> Any:
        asked.append(fit.active[0] if fit.active else "refitted")
        return problem_of(f"strengths {len(asked)}"), fit

    def problem_of(name: str) -> Any:
        records = [
            SimpleNamespace(strength=SimpleNamespace(steady=False, factor=np.full((2, 3), 4.0)))
        ]
        engine = SimpleNamespace(filter=lambda values, noise: [], records=records)
        return SimpleNamespace(
            name=name, engine=engine, model=SimpleNamespace(channels=()), settings=SETTINGS,
            report=lambda text: None,
        )  # fmt: skip

    def search(problem: Any, noise: Noise) -> Any:
        first = problem.name == "strengths 1"
        active = ("wind",) if first else found
        return SimpleNamespace(
            problem=problem, fit=Fit(active, {}, noise), cost=-nats if first else 0.0
        )

    stand_in(monkeypatch, "with_shocks", shaken)
    stand_in(monkeypatch, "searched_once", search)
    stand_in(monkeypatch, "is_all_white", lambda problem, fit: white)
    first: Any = SimpleNamespace(
        problem=problem_of("steady"), fit=Fit(("wind",), {}, FINE), refitted=Fit((), {}, FINE)
    )
    best: Any = unrest._searched_in_shocks(first, FINE)
    assert asked == beside and best.problem.name == taken


@pytest.mark.parametrize(
    ("shock", "onsets", "shaken", "changed"),
    [
        (None, {"wind": 0}, False, False),  # there are others: nothing is asked
        (Moment("a", 3.0), {}, False, False),
        (Moment("a", 3.0), {"wind": 0}, True, False),  # it did not take the shock away
        (Moment("a", 3.0), {"wind": 0}, False, True),
    ],
)
def test_one_shock_may_be_what_changed_in_flight(monkeypatch, shock, onsets, shaken, changed):
    """Then no strengths are used, which would believe the model less just where it changed."""
    asked: list[Any] = []

    def with_onsets(*of: Any) -> Any:
        asked.append(of[-1])
        return SimpleNamespace(problem=None, fit=None, onsets=onsets)

    stand_in(monkeypatch, "only_shock", lambda problem, fit: shock)
    stand_in(monkeypatch, "with_onsets", with_onsets)
    stand_in(monkeypatch, "in_shocks", lambda problem, fit: shaken)
    none: Any = None
    state = unrest._changed(Searched(none, none, none, none, none), {})
    assert (state is not None) == changed and (state is None or state.changing.onsets == onsets)
    assert asked == ([shock] if shock else [])


@pytest.mark.parametrize(
    ("white", "names", "lost", "erring", "taken"),
    [
        (True, (), 10.0, True, "behind"),
        (False, (), 10.0, True, "without"),  # errors of every memory look like a low-pass
        (False, (), 10.0, False, "without"),  # such errors are told, and not in the model
        (False, (), 90.0, True, "behind"),
        (False, ("thrust_exponent",), 10.0, True, "behind"),  # likelier by a name alone
        (False, ("wind",), 10.0, True, "without"),
    ],
)
def test_errors_of_every_memory_may_stand_in_a_low_passs_place(
    monkeypatch, white, names, lost, erring, taken
):
    """Where gyros and accelerometers stay coloured behind it, and nothing more is named."""
    levels, wider = Noise({}, {"phi": 0.1}), Noise({"error_gyros": 0.1}, {"phi": 0.1})

    def one(name: str, active: tuple[str, ...]) -> Searched:
        fit = Fit(active, {}, levels)
        problem = SimpleNamespace(name=name, smoothed=name == "behind")
        return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]

    behind, without = one("behind", ("wind",)), one("without", names)
    stand_in(monkeypatch, "searched_once", lambda problem, noise: one("first", ()))
    stand_in(monkeypatch, "with_true_times", lambda first, noise: first)
    stand_in(monkeypatch, "before_low_passes", lambda first, noise: behind)
    stand_in(monkeypatch, "with_errors",
        lambda found, noise, clock: (
            (behind, wider) if found is behind else (without, wider if erring else noise)
        ),
    )  # fmt: skip
    stand_in(monkeypatch, "is_coloured", lambda found, channels: "ax" in channels and not white)
    stand_in(
        monkeypatch,
        "behind_other_low_passes",
        lambda problem, found, noise: asked.append("again") or found,
    )
    of_each = {"behind": 50.0, "without": lost}
    stand_in(monkeypatch, "lost", lambda problem, found: of_each[found.problem.name])
    asked: list[Any] = []

    def in_unrest(best: Searched, noise: Noise, clock: Any, erring: bool) -> Searched:
        asked.append((noise is wider, erring))
        return best

    stand_in(monkeypatch, "in_unrest", in_unrest)
    found = searched.searched("as given", levels, {})  # type: ignore[arg-type]
    assert found.problem.name == taken  # type: ignore[attr-defined]
    assert asked == (["again", (True, True)] if erring else [(False, False)])


@pytest.mark.parametrize(
    ("likelier", "coloured", "nearer", "names"),
    [
        (False, False, False, ["on the way"]),
        (True, False, False, ["on the way", "held"]),  # whatever is flown
        (False, True, True, ["on the way", "held"]),
        (False, True, False, ["on the way", "held", "on the way"]),
        (False, False, True, ["on the way"]),  # where little is coloured the likelihood is believed
    ],
)
def test_what_commands_do_between_rows_is_asked_first_and_again_beside_what_was_found(
    monkeypatch, likelier, coloured, nearer, names
):
    """The last name is that of what is taken."""

    def held(problem: Any) -> Any:
        return problem.called("held")

    stand_in(monkeypatch, "is_much_coloured", lambda problem, fit: coloured)
    stand_in(monkeypatch, "likeliest_between", lambda problem, noise: problem.called("on the way"))
    stand_in(monkeypatch, "are_held", lambda problem: problem.name == "held")
    stand_in(monkeypatch, "with_held", held)
    stand_in(monkeypatch, "held_after_all", lambda first: held(first.problem) if likelier else None)
    stand_in(monkeypatch, "flies_nearer",
        lambda found, other: nearer and (found.problem.name, other.problem.name) == tuple(names[::-1])
    )  # fmt: skip
    assert searched_names(monkeypatch) == names


def test_the_search_is_done_again_with_commands_when_they_act(monkeypatch):
    """From the levels that were given, and from there on that problem is the one as given."""
    stand_in(
        monkeypatch, "commands_late", lambda first: 0.03 if first.problem.name == "logged" else 0.0
    )
    assert searched_names(monkeypatch) == ["logged", "0.03 sooner"]


def searched_names(monkeypatch) -> list[str]:
    """What a log called "logged" is called at each search, each from the levels given.

    And what is taken, if not the last.
    """
    levels, asked = Noise({}, {"phi": 0.1}), []

    def once_more(problem: Any, noise: Noise) -> Searched:
        asked.append(problem.name)
        assert noise is levels
        fit = Fit((), {}, noise)
        return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]

    def of(name: str) -> Any:
        return SimpleNamespace(
            name=name, report=lambda text: None, smoothed=False, called=of,
            with_commands_sooner=lambda seconds: of(f"{seconds:g} sooner"),
        )  # fmt: skip

    stand_in(monkeypatch, "rotors_first", lambda problem, noise: None)
    stand_in(monkeypatch, "searched_once", once_more)
    stand_in(monkeypatch, "is_coloured", lambda found, channels: False)
    stand_in(monkeypatch, "is_lag_unshown", lambda found: False)
    stand_in(monkeypatch, "with_true_times", lambda first, noise: first)
    stand_in(monkeypatch, "before_low_passes", lambda first, noise: None)
    stand_in(monkeypatch, "with_errors", lambda found, noise, clock: (found, noise))
    stand_in(monkeypatch, "in_unrest", lambda best, noise, clock, erring: best)
    found = searched.searched(of("logged"), levels, {})
    taken = found.problem.name  # type: ignore[attr-defined]
    return asked if taken == asked[-1] else [*asked, taken]


@pytest.mark.parametrize(
    ("active", "coloured", "rows", "behind", "after", "taken"),
    [
        (("wind",), False, {"gyros": 2}, None, 40.0, True),
        ((), True, {"gyros": 2}, None, 40.0, True),
        ((), False, {"gyros": 2}, None, 0.0, False),  # nothing named or coloured: not asked
        (("wind",), True, {}, None, 0.0, False),  # none comes late
        (("wind",), True, {}, 120.0, 0.0, False),  # though low-passes made things worse
        (("wind",), True, {"gyros": 2}, 20.0, 0.0, False),  # a low-pass explains more
        (("wind",), True, {"gyros": 2}, 60.0, 40.0, True),
        (("wind",), True, {"gyros": 2}, None, 70.0, False),  # the search did not end as likely
    ],
)
def test_gyros_that_come_late_are_moved_back_where_that_is_likelier(
    monkeypatch, active, coloured, rows, behind, after, taken
):
    """Cost 100 as logged; moved they are worth 60 nats at that fit, and lose 5 that cannot be moved."""
    levels = Noise({})

    def of(name: str) -> Any:
        return SimpleNamespace(
            name=name, row=0.01, settings=SETTINGS, report=lambda text: None, late_imu={},
            model=SimpleNamespace(channels=("p",)), engine=SimpleNamespace(records="logged"),
        )  # fmt: skip

    def one(problem: Any, cost: float) -> Any:
        fit = Fit(active, {}, levels)
        return SimpleNamespace(problem=problem, fit=fit, cost=cost)

    imu = readings.late_imu
    monkeypatch.setattr(imu, "rows_late", lambda problem, fit: (rows, 60.0 if rows else 0.0))
    monkeypatch.setattr(imu, "on_time", lambda records, rows, row: "moved")
    monkeypatch.setattr(imu, "worth_left_out", lambda problem, fit, rows: 5.0)
    monkeypatch.setattr(readings, "replace", lambda problem, late_imu: problem)
    stand_in(monkeypatch, "is_coloured", lambda found, channels: coloured)
    stand_in(monkeypatch, "lost", lambda problem, found: found.cost)
    asked: list[Any] = []
    stand_in(
        monkeypatch,
        "searched_once",
        lambda problem, noise: asked.append(problem) or one(problem, after),
    )
    logged = of("logged")
    logged.with_records = lambda records: of(records)
    smoothed = None if behind is None else one(logged, behind)
    found = IMU_ON_TIME(one(logged, 100.0), smoothed, levels)
    assert (found is not None) == taken
    assert [problem.name for problem in asked] == ["moved"] * (taken or after == 70.0)


HAD = {"p": LowPass(0.01)}
OF_ROTORS = {"rpm_upper": LowPass(0.02)}


@pytest.mark.parametrize(
    ("had", "active", "passes", "lost", "groups", "taken"),
    [
        (HAD, "wind", {"p": LowPass(0.0105)}, 10.0, [GYROS], "found"),  # as it was
        (HAD, "wind", {"p": LowPass(0.006)}, 10.0, [GYROS], "again"),
        (HAD, "wind", {"p": LowPass(0.010, 2)}, 10.0, [GYROS], "again"),
        (HAD, "wind", {}, 10.0, [GYROS], "again"),
        (HAD, "wind", {"p": LowPass(0.006)}, 90.0, [GYROS], "found"),
        ({}, "wind", {}, 10.0, None, "found"),  # nothing looks like one: not asked
        ({}, "thrust_exponent", {"ax": LowPass(0.005)}, 10.0, [ACCELEROMETERS], "again"),
        ({}, "thrust_exponent", {}, 10.0, [ACCELEROMETERS], "found"),
    ],
)
def test_low_passes_are_fitted_once_more_beside_errors_that_last(
    monkeypatch, had, active, passes, lost, groups, taken
):
    """Of groups that have one or whose like is named, to readings as logged, from the levels that the
    search began with; what cannot be told from them is no candidate then."""
    levels = Noise({"error_gyros": 0.1})

    def of(problem: Any, noise: Noise) -> Searched:
        fit = Fit((active,), {}, noise)
        return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]

    asked: list[Any] = []

    def low_passes(problem: Any, fit: Fit, noise: Noise, groups: Any) -> dict[str, LowPass]:
        asked.append((problem.engine.records, noise, groups))
        return passes

    model = SimpleNamespace(channels=("p",), vehicle=SimpleNamespace(effects={}))
    given = problem_on(monkeypatch, model, "logged", ("thrust_exponent", "wind"))
    monkeypatch.setattr(
        problem_module, "records_before", lambda logged, channels, those: (logged, those)
    )
    stand_in(monkeypatch, "low_passes", low_passes)
    stand_in(monkeypatch, "moved_as_in", lambda problem, records: records)
    found = of(given.behind({**had, **OF_ROTORS}, "logged"), levels)
    stand_in(monkeypatch, "searched_once", of)
    stand_in(monkeypatch, "lost", lambda problem, it: 50.0 if it is found else lost)
    best = readings.behind_other_low_passes(given, found, levels)
    assert asked == ([("logged", levels, groups)] if groups else [])
    assert (best is found) == (taken == "found")
    if best is not found:
        assert best.problem.low_passes == {**passes, **OF_ROTORS}
        assert best.problem.engine.records == ("logged", passes)
        assert best.problem.smoothed == bool(passes)
        assert ("thrust_exponent" in best.problem.candidates) == ("ax" not in passes)


@pytest.mark.parametrize(
    ("behind", "as_logged", "lost", "taken"),
    [
        (True, False, 10.0, "as logged"),
        (True, False, 90.0, "behind"),
        (True, True, 10.0, "behind"),  # something is amiss either way
        (False, False, 10.0, "behind"),
    ],
)
def test_gusts_that_are_known_may_leave_nothing_of_a_low_pass(
    monkeypatch, behind, as_logged, lost, taken
):
    """Asked where inertial sensors stay coloured behind it, whatever gusts are."""
    coloured = {"behind": behind, "as logged": as_logged}
    worth = {"behind": 50.0, "as logged": lost}
    noise = Noise({}, {"phi": 0.1})

    def one(name: str) -> Searched:
        fit = Fit((), {}, noise)
        problem = SimpleNamespace(name=name, report=lambda text: None, smoothed=name == "behind")
        return Searched(problem, fit, fit, fit, None)  # type: ignore[arg-type]

    first = one("as logged")
    stand_in(monkeypatch, "rotors_first", lambda problem, noise: (first, noise))
    stand_in(monkeypatch, "is_coloured",
        lambda found, channels: "ax" in channels and coloured[found.problem.name],
    )  # fmt: skip
    stand_in(monkeypatch, "with_true_times", lambda first, noise: first)
    stand_in(monkeypatch, "before_low_passes", lambda first, noise: one("behind"))
    stand_in(monkeypatch, "with_errors", lambda found, noise, clock: (found, noise))
    stand_in(monkeypatch, "in_unrest", lambda best, noise, clock, erring: best)
    stand_in(monkeypatch, "lost", lambda problem, found: worth[found.problem.name])
    found = searched.searched(first.problem, noise, {})
    assert found.problem.name == taken  # type: ignore[attr-defined]
