"""What no signature of the catalogue finds: generic terms, a user's own effect, a spectral line.

The flights come from `injector`, which shares no code with the package.
"""

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import injector
import numpy as np
import pytest

from coax_env import InputError, derivative, diagnose, load_vehicle, read_flight
from coax_env.diagnosis import unlisted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation import vibration
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.state_space import Noise, Record
from coax_env.model import effects
from coax_env.model import inputs as U
from coax_env.model import state as S
from coax_env.model.dynamics import WORK_SIZE, full_state, hover_trim, kernel_input
from coax_env.model.dynamics import step as dynamics_step
from coax_env.model.generic_terms import AXES, DIRECTION_STEP, TERMS, hover_speeds
from coax_env.model.layout import CHANNELS, N_FULL, N_STATES, STATES
from coax_env.model.layout import COMMANDS as COMMAND_UNITS
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import vehicle_toml
from coax_env.simulation.simulate import Gusts, simulate

ROOT = Path(__file__).resolve().parents[1]
LAMA = load_vehicle("lama400d")
NAMES = [name for name, _ in STATES]
COMMANDS = [name for name, _ in COMMAND_UNITS]
TURNING = ("lon_3211", "heading_turn")


def all_but(*names: str) -> list[str]:
    return [name for name in effects.CATALOGUE if name not in names]


FEW = all_but("gyro_bias", "swash_offset", "rotor_drag")


@pytest.mark.parametrize("ends", [250.0, math.inf])
def test_generic_terms_with_which_the_filter_diverges_are_refused(monkeypatch, ends):
    """A search beside two of them ended so: every cause was worth nan nats, and left."""
    term = ("unlisted_N", TERMS[:1])
    found = iter([(term, 20.0), None])
    given: Any = Problem(HeliModel(LAMA), SimpleNamespace(threads=1, records=[]), (), {})  # type: ignore[arg-type]
    fit, wider, quadratic = Fit((), {}, Noise({}), objective=300.0), replace(given, base=()), Any
    monkeypatch.setattr(unlisted, "_screened", lambda *asked: None)
    monkeypatch.setattr(unlisted, "_best", lambda *asked: next(found))
    monkeypatch.setattr(unlisted, "_with", lambda *asked: (wider, fit))
    monkeypatch.setattr(
        unlisted, "search", lambda problem, fit: (replace(fit, objective=ends), quadratic)
    )
    monkeypatch.setattr(unlisted, "_pruned", lambda *left: left)
    problem, after, _, taken = unlisted.explain(given, fit, quadratic)  # type: ignore[arg-type]
    stands = math.isfinite(ends)
    assert (problem is wider, after is fit, list(taken)) == (stands, not stands, [term] * stands)


# --- the terms themselves ---------------------------------------------------------------------------


def with_terms(**coefficients: float) -> Vehicle:
    """The bare vehicle with coefficients such as ``M__sin_3psi``."""
    vehicle = LAMA
    for key, value in coefficients.items():
        axis, term = key.split("__")
        vehicle = vehicle.with_effect(f"unlisted_{axis}", **{term: value})
    return vehicle


def expected(term: str, s: dict[str, float], command: np.ndarray) -> float:
    """A term's value by its formula, from the named state."""
    hover = hover_speeds(LAMA.vector)
    known = {
        "sin_phi": math.sin(s["phi"]), "sin_theta": math.sin(s["theta"]),
        "cos_phi": 1.0 - math.cos(s["phi"]), "cos_theta": 1.0 - math.cos(s["theta"]),
        "omega_u": command[0] - hover[0], "omega_l": command[1] - hover[1],
        "delta_lon": command[2], "delta_lat": command[3],
        "omega_u_rate": 0.0, "omega_l_rate": 0.0,  # rotors without a lag have arrived
        "north": s["x"], "east": s["y"], "height": -s["z"] - 6.0 * LAMA["rotor_radius"].value,
        "omega_u_2": (command[0] - hover[0]) ** 2, "omega_l_2": (command[1] - hover[1]) ** 2,
        "omega_u_l": (command[0] - hover[0]) * (command[1] - hover[1]),
        "lon_direction": 0.0, "lat_direction": 0.0,  # nor does the plate move on
    }  # fmt: skip
    if term in known:
        return known[term]
    if term.endswith("psi"):
        wave, _, harmonic = term.partition("_")
        angle = float(harmonic.removesuffix("psi") or 1) * s["psi"]
        return math.sin(angle) if wave == "sin" else math.cos(angle)
    if term.startswith("abs_"):
        return abs(s[term[4]]) * s[term[4]]
    return math.prod(s[name] for name in term.split("_"))


def test_a_terms_std_has_its_colour_in_it():
    """Variance 9, inflated by 2.25 as its own direction is: 4.5."""
    quadratic = SimpleNamespace(
        covariance=lambda names: np.diag([4.0, 9.0]),
        variance_inflation=lambda asked, names: 2.25 if asked == ["own"] else 1.0,
    )
    problem = SimpleNamespace(free_names=lambda active: ["mass", "own"])
    fit = SimpleNamespace(active=())
    assert unlisted.standard_deviation(problem, fit, quadratic, "own") == 4.5
    assert unlisted.standard_deviation(problem, fit, quadratic, "mass") == 2.0


@pytest.mark.parametrize("term", [t.key for t in TERMS])
def test_every_term_is_its_formula(term):
    rng = np.random.default_rng(3)
    state = 0.3 * rng.standard_normal(N_STATES)
    command = np.array([205.0, 221.0, 0.03, -0.02])
    values = dict(zip(NAMES, state, strict=True))
    bare = derivative(state, command, LAMA)
    inertia = [LAMA[n].value for n in ("mass",) * 3 + ("inertia_xx", "inertia_yy", "inertia_zz")]
    for i, axis in enumerate("XYZLMN"):
        change = derivative(state, command, with_terms(**{f"{axis}__{term}": 0.01})) - bare
        wanted = np.zeros(N_STATES)
        wanted[i] = 0.01 * expected(term, values, command) / inertia[i]
        np.testing.assert_allclose(change, wanted, atol=1e-11)


@pytest.mark.parametrize("axis", ["lon", "lat"])
def test_a_direction_is_that_in_which_the_row_moves_the_plate(axis):
    """Its moment has the sign of the command's last step, whatever its size, and none without one."""
    vehicle = with_terms(**{f"M__{axis}_direction": 0.01})
    state, command = hover_trim(LAMA)
    for step, sign in ((0.02, 1.0), (0.005, 1.0), (-0.004, -1.0), (0.0, 0.0)):
        turned = []
        for flown in (vehicle, LAMA):
            x = full_state(state, command, LAMA)
            u = kernel_input(command)
            u[COMMANDS.index(f"delta_{axis}")] += step
            work, end = np.zeros(WORK_SIZE), np.empty(x.size)
            dynamics_step(x, u, 0.001, flown.vector, work, end)
            turned.append(end[4])
        wanted = sign * 0.01 / LAMA["inertia_yy"].value
        assert (turned[0] - turned[1]) / 0.001 == pytest.approx(wanted, rel=1e-3, abs=1e-9)


def test_terms_of_a_place_need_a_position():
    def terms(*channels: str) -> set[str]:
        t = np.arange(0.0, 3.0, 0.01)
        z = np.full((t.size, len(CHANNELS)), np.nan)
        z[::5, [CHANNELS.index(c) for c in channels]] = 1.0
        record = Record("a", t, np.full((t.size, 4), 200.0), z)
        problem = Problem.of(HeliModel(LAMA), [record])
        return {t.key for t in unlisted.measured_terms(problem)}

    every = {t.key for t in TERMS}
    assert terms("phi", "h") == every - {"north", "east"}
    assert terms("phi", "pn", "pe", "h") == every
    assert terms("phi", "vn") == every - {"north", "east", "height"}


def test_hover_speeds_hold_the_bare_model():
    """Without the download on the fuselage, the trim of the bare vehicle."""
    free = LAMA.with_values({"fuselage_drag_coefficient": 0.0})
    np.testing.assert_allclose(hover_speeds(free.vector), hover_trim(free)[1][:2], rtol=1e-9)


def test_only_what_is_not_zero_is_written(tmp_path):
    vehicle = with_terms(M__sin_3psi=0.02, X__abs_u_u=-0.1, M__u=0.0)
    path = tmp_path / "v.toml"
    path.write_text(vehicle_toml(vehicle), encoding="utf-8")
    back = load_vehicle(path)
    assert {g: list(t) for g, t in back.effects.items()} == {
        "unlisted_M": ["sin_3psi"], "unlisted_X": ["abs_u_u"],
    }  # fmt: skip
    assert back["unlisted_X.abs_u_u"].unit == "N per (m/s)2"
    np.testing.assert_array_equal(back.vector, vehicle.vector)
    assert np.count_nonzero(vehicle.vector != LAMA.vector) == 3, "two numbers and one switch"


def test_terms_are_no_part_of_the_catalogue():
    assert set(AXES) <= set(effects.GROUPS) and not set(AXES) & set(effects.CATALOGUE)


# --- found in flight --------------------------------------------------------------------------------


@pytest.mark.parametrize(("gusts", "size"), [(False, 0.01), (True, 0.02)])
@pytest.mark.slow
def test_a_force_in_no_list_becomes_part_of_the_model(tmp_path, gusts, size):
    """M = a sin(3 psi), hidden: the right axis, form and size, and no effect of the list is blamed."""
    runs = (*TURNING, "lat_3211", "yaw_3211")
    folder = injector.fly(tmp_path / "f", {"outside": size}, gusts=gusts, runs=runs, seed=41)
    result = diagnose(folder, hold_out=[], exclude=FEW)
    findings = result.findings
    assert findings["verdict"] == "unexplained" and not findings["causes"]
    (left,) = findings["unexplained"]
    assert left["channel"] == "q" and left["depends_on"] == ["psi"]
    assert left["form"].endswith("sin(3 psi) [N m]") and left["share"] > 0.2
    found = result.vehicle_after["unlisted_M.sin_3psi"]
    assert found.unit == "N m" and abs(found.value - size) < 3.0 * found.std < 0.3 * size
    again = load_vehicle(_written(result.vehicle_after, tmp_path))
    assert set(again.effects) == {"unlisted_M"}


def _written(vehicle: Vehicle, folder: Path) -> Path:
    path = folder / "vehicle.toml"
    path.write_text(vehicle_toml(vehicle), encoding="utf-8")
    return path


@pytest.mark.slow
def test_an_unlisted_term_is_worth_its_gain(tmp_path):
    """On a turn that the fit has not seen, most of the pitch error goes."""
    folder = injector.fly(
        tmp_path / "f", {"outside": 0.02}, runs=(*TURNING, "lat_3211", "yaw_3211"), seed=42
    )
    flight = read_flight(folder)
    turn = flight.run("heading_turn")
    other = read_flight(
        injector.fly(tmp_path / "g", {"outside": 0.02}, runs=["heading_turn"], seed=43)
    ).runs[0]
    flight = replace(flight, runs=(*flight.runs, replace(other, name="second_turn")))
    assert not np.array_equal(turn.measured["q"], other.measured["q"])
    gain = diagnose(flight, hold_out=["second_turn"], exclude=FEW, ceiling=True).findings["gain"]
    for channel in ("q", "theta"):
        entry = gain["channels"][channel]
        before, after = (
            max(entry[k] ** 2 - entry["noise"] ** 2, 0.0) ** 0.5 for k in ("before", "after")
        )
        assert after < 0.4 * before, entry
    black_box, named = gain["black_box_percent"], gain["error_removed_percent"]
    assert 0.6 * named < black_box < named + 10.0, "the one true term does at least as well as 270"


@pytest.mark.slow
def test_nothing_unlisted_in_clean_gusts(tmp_path):
    folder = injector.fly(
        tmp_path / "f", {}, gusts=True, runs=(*TURNING, "lat_3211", "forward_run"), seed=44
    )
    result = diagnose(folder, hold_out=[], exclude=FEW)
    assert result.findings["verdict"] == "consistent" and not result.vehicle_after.effects


@pytest.mark.slow
def test_a_listed_effect_comes_before_unlisted_terms(tmp_path):
    """A drag is a drag, though terms in u and v would do as well."""
    folder = injector.fly(
        tmp_path / "f", {"rotor_drag": 6e-4}, runs=("forward_run", "side_run", "lon_3211"), seed=45
    )
    findings = diagnose(folder, hold_out=[], exclude=FEW).findings
    assert [c["effect"] for c in findings["causes"]] == ["rotor_drag"]
    assert findings["verdict"] == "explained"


# --- a user's own effect ----------------------------------------------------------------------------

HEADING_MOMENT = '''
import math
import numpy as np
from coax_env.model import workspace as F
from coax_env.model.effects import LOAD, EffectParameter, effect

@effect(LOAD, EffectParameter("k", "N m", usual=0.02, smallest=0.002),
        channels="q theta", source="seen on the bench")
def heading_moment(x, f, p, e):
    """A pitching moment that follows the heading, k sin(3 psi)."""
    along = np.array([math.sin(3.0 * x[12])])  # a user may make arrays
    f[F.MOMENT_Y] += p[e] * along[0]
'''


def run_diagnose(*words: object, cwd: Path) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "diagnose.py"), *map(str, words)],
        cwd=cwd, capture_output=True, text=True, timeout=500, env=os.environ.copy(),
    )  # fmt: skip


@pytest.mark.slow(first=True)
def test_an_effect_of_ones_own_is_named(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(HEADING_MOMENT)
    folder = injector.fly(tmp_path / "f", {"outside": 0.02}, runs=TURNING, seed=46)
    done = run_diagnose(
        folder, "--effect", file, "--hold-out", "none", "--exclude", ",".join(FEW), "--out", "o",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    findings = json.loads((tmp_path / "o" / "findings.json").read_text())
    (cause,) = findings["causes"]
    assert cause["effect"] == "heading_moment" and findings["verdict"] == "explained"
    found = cause["parameters"]["heading_moment.k"]
    assert abs(found["value"] - 0.02) < 3.0 * found["std"] < 0.006 and found["unit"] == "N m"
    assert "heading_moment" in (tmp_path / "o" / "report.html").read_text().replace(" ", "_")


BAD_EFFECTS = {
    "no effect file": None,
    "no function under @effect": "x = 1\n",
    "line 2": "import math\ndef broken(:\n",
    "already": HEADING_MOMENT.replace("def heading_moment", "def rotor_drag"),
    "no channel": HEADING_MOMENT.replace("q theta", "q speed"),
    "NameError": HEADING_MOMENT.replace("import LOAD, EffectParameter", "import EffectParameter"),
    "is wanted": HEADING_MOMENT.replace("@effect(LOAD, ", "@effect("),
    "one parameter": HEADING_MOMENT.replace(
        "smallest=0.002),", 'smallest=0.002), EffectParameter("l", "N m", 0.02, 0.002), damps=True,'
    ),
    "does not compile": HEADING_MOMENT.replace("math.sin(", "math.sine("),
}


ONE_BY_ONE = """
import contextlib, io, json, sys, command_line, diagnose
found = []
for file in sys.argv[1:]:
    sys.argv, said = ["diagnose.py", ".", "--effect", file], io.StringIO()
    with contextlib.redirect_stderr(said):
        try:
            command_line.run(diagnose.main)
        except SystemExit as left:
            found.append((left.code, said.getvalue()))
print(json.dumps(found))
"""
"""What a script says of one file after another; a program of its own, since a kernel takes no more
effects once it is compiled."""


@pytest.mark.slow
def test_a_bad_effect_file_is_refused_in_one_line(tmp_path):
    for number, text in enumerate(BAD_EFFECTS.values()):
        if text is not None:
            (tmp_path / f"mine_{number}.py").write_text(text)
    done = subprocess.run(
        [sys.executable, "-c", ONE_BY_ONE, *(f"mine_{k}.py" for k in range(len(BAD_EFFECTS)))],
        cwd=tmp_path, capture_output=True, text=True, timeout=500,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "scripts"), *sys.path])},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for words, (code, said) in zip(BAD_EFFECTS, json.loads(done.stdout), strict=True):
        assert code == 2 and words in said, said
        assert said.count("\n") == 1 and "Traceback" not in said
    assert not (tmp_path / "runs").exists()


def test_an_effect_cannot_be_added_to_a_compiled_kernel(tmp_path):
    from coax_env import load_effect

    file = tmp_path / "mine.py"
    file.write_text(HEADING_MOMENT)
    with pytest.raises(InputError, match="before the model is first used"):
        load_effect(file)


# --- vibration --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_vibration_is_named_and_explains_the_accelerometers(tmp_path):
    folder = injector.fly(
        tmp_path / "f", {"vibration": 0.5}, gusts=True, runs=("lon_3211", "lat_3211"), seed=47
    )
    result = diagnose(folder, hold_out=[], exclude=[e for e in FEW if e != "vibration"])
    assert [c["effect"] for c in result.findings["causes"]] == ["vibration"]
    assert result.findings["verdict"] == "explained", result.findings["unexplained"]
    found = result.findings["causes"][0]["parameters"]["vibration.amplitude"]
    assert abs(found["value"] - 0.5) < 3.0 * found["std"] < 0.05
    assert result.vehicle_after["vibration.amplitude"].value == found["value"]
    forbidden = diagnose(folder, hold_out=[], exclude=[*FEW, "vibration"]).findings
    assert "vibration" not in [c["effect"] for c in forbidden["causes"]]
    assert {u["channel"] for u in forbidden["unexplained"]} >= {"ax", "ay", "az"}


@pytest.mark.slow
@pytest.mark.parametrize("loud", [1.0, 2.0])
def test_louder_noise_is_no_vibration(tmp_path, loud):
    flight = read_flight(injector.fly(tmp_path / "f", {}, gusts=True, runs=TURNING, seed=48))
    rng = np.random.default_rng(0)
    extra = math.sqrt(loud**2 - 1.0) * 0.1
    runs = [
        replace(
            run,
            measured={
                c: z + extra * rng.standard_normal(z.size) * (c in vibration.KINDS["amplitude"])
                for c, z in run.measured.items()
            },
        )
        for run in flight.runs
    ]
    assert vibration.find(replace(flight, runs=tuple(runs))) == ()


@pytest.mark.parametrize("sensors", ["onboard", pytest.param("paper", marks=pytest.mark.slow)])
def test_our_own_vibration_is_found_and_taken_out(sensors):
    """The simulation's line at 33.2 Hz, read at 100 Hz and, aliased to 8.2 Hz, at 25 Hz."""
    shaking = LAMA.with_effect("vibration", amplitude=0.3)
    flight = simulate(
        shaking, ["lon_3211", "heave_3211"], sensors=sensors, seed=3, gusts=Gusts(), tremor=1.0
    )
    for every in (1, 4):
        runs = [
            replace(run, measured={
                c: np.where(np.arange(z.size) % every == 0, z, np.nan)
                if c in vibration.KINDS["amplitude"] else z
                for c, z in run.measured.items()
            })
            for run in flight.runs
        ]  # fmt: skip
        thin = replace(flight, runs=tuple(runs))
        (line,) = vibration.find(thin)
        assert line is not None and line.rotor == "upper"
        assert abs(line.amplitude - 0.3) < 3.0 * line.std < 0.1
        assert vibration.find(vibration.taken_out(thin, [line])) == ()


def test_vibration_is_reading_noise_to_the_filter():
    from coax_env.estimation.helicopter_noise import starting_noise

    flight = simulate(LAMA, "hover", seed=1)
    shaking = LAMA.with_effect("vibration", amplitude=0.4)
    bare, loud = (starting_noise(flight, v).reading for v in (LAMA, shaking))
    for channel, std in bare.items():
        more = 0.4**2 / 2.0 if channel in vibration.KINDS["amplitude"] else 0.0
        assert loud[channel] ** 2 == pytest.approx(std**2 + more)


@pytest.mark.parametrize("lag", [0.0, 0.05])
def test_where_a_row_moves_the_plate_to_is_known_of_every_vehicle(lag):
    """Also of a bare one, for which the kernel does not work it out: that was whatever memory had, and
    once in twenty times other runs were held out."""
    rng = np.random.default_rng(5)
    lama = load_vehicle("lama400d")
    model = HeliModel(lama.with_effect("servo_lag", time=lag) if lag else lama)
    states = 1e-3 * rng.standard_normal((4, N_FULL))
    states[:, S.OMEGA_U], states[:, S.OMEGA_L] = 209.0, 224.0
    inputs = np.zeros((4, 12))
    inputs[:, [U.OMEGA_U, U.OMEGA_L]] = 209.0, 224.0
    inputs[:, [U.DELTA_LON, U.DELTA_LAT]] = 1e-3 * rng.standard_normal((4, 2))
    steps = inputs[:, [U.DELTA_LON, U.DELTA_LAT]] - states[:, [S.SWASH_LON, S.SWASH_LAT]]
    out = np.empty((4, len(TERMS)))
    unlisted._evaluate(states, inputs, model.vector(model.bare_values), out)
    places = [i for i, term in enumerate(TERMS) if term.key in ("lon_direction", "lat_direction")]
    assert out[:, places] == pytest.approx(np.tanh(steps / DIRECTION_STEP))
