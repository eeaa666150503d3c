"""The scripts as a user runs them: help, bad input in one line with exit code 2, results where asked.

A process of its own costs seconds of imports, so most calls run the script's file inside this one;
each kind of refusal is also seen once from outside.
"""

import importlib
import json
import os
import runpy
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import injector
import pytest
import tomlkit

from coax_env import load_vehicle, read_flight
from coax_env.model.effects import CATALOGUE
from coax_env.model.vehicle_file import vehicle_toml

ROOT = Path(__file__).resolve().parents[1]
PYTHON_SCRIPTS = sorted(
    path.name for path in (ROOT / "scripts").glob("*.py") if path.name != "command_line.py"
)
LINE = "lon_3211.csv"


def script(
    name: str, *words: object, cwd: Path, timeout: float = 240.0
) -> subprocess.CompletedProcess:
    """Run one of the scripts from an empty folder."""
    return subprocess.run(
        [sys.executable, str(ROOT / "scripts" / name), *map(str, words)],
        cwd=cwd, capture_output=True, text=True, timeout=timeout,
        env={**os.environ, "PYTHONWARNINGS": "default::DeprecationWarning:__main__"},
    )  # fmt: skip


@pytest.fixture
def here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., subprocess.CompletedProcess]:
    """`script`, in this process."""

    def call(name: str, *words: object) -> subprocess.CompletedProcess:
        path = str(ROOT / "scripts" / name)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [path, *map(str, words)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            runpy.run_path(path, run_name="__main__")
        out, err = capsys.readouterr()
        return subprocess.CompletedProcess([name, *words], left.value.code or 0, out, err)

    return call


@pytest.mark.parametrize("name", PYTHON_SCRIPTS)
def test_help(name, here, tmp_path):
    done = here(name, "--help")
    assert done.returncode == 0 and not done.stderr
    assert done.stdout.startswith("usage: ") and "--out" in done.stdout
    assert not list(tmp_path.iterdir())


def test_help_of_the_tests(tmp_path):
    done = subprocess.run(
        ["bash", str(ROOT / "scripts" / "test"), "--help"], cwd=tmp_path,
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0 and "scripts/test --quick" in done.stdout


# --- bad input -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound_text(tmp_path_factory) -> dict[str, bytes]:
    """The files of a sound flight of one run."""
    folder = injector.fly(tmp_path_factory.mktemp("sound"), {}, runs=["lon_3211"], seed=31)
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.name != "truth.json"}


def cell(row: int, column: str, text: str) -> Callable[[dict[str, bytes]], None]:
    """Spoil one cell of the log; row 0 is the first below the header."""

    def spoil(files: dict[str, bytes]) -> None:
        lines = files[LINE].decode().splitlines()
        cells = lines[row + 1].split(",")
        cells[lines[0].split(",").index(column)] = text
        lines[row + 1] = ",".join(cells)
        files[LINE] = "\n".join(lines).encode()

    return spoil


def shortened(files: dict[str, bytes]) -> None:
    files[LINE] = b"\n".join(files[LINE].splitlines()[:150])


def ragged(files: dict[str, bytes]) -> None:
    lines = files[LINE].splitlines()
    lines[7] += b",1.0,2.0"
    files[LINE] = b"\n".join(lines)


def without_rotors(files: dict[str, bytes]) -> None:
    files[LINE] = files[LINE].replace(b"rpm_", b"tail_", 4)


def binary(files: dict[str, bytes]) -> None:
    files[LINE] = bytes(range(256)) * 40


def broken_card(files: dict[str, bytes]) -> None:
    files["card.toml"] += b"\n[[run\n"


def unknown_unit(files: dict[str, bytes]) -> None:
    files["card.toml"] += b'\n[columns]\np = { name = "p", unit = "furlongs/s" }\n'


def missing_run(files: dict[str, bytes]) -> None:
    del files[LINE]


# what is spoilt -> how, and words that the error must have
SPOILT: dict[str, tuple[Callable[[dict[str, bytes]], None], tuple[str, ...]]] = {
    "card is no TOML": (broken_card, ("card.toml",)),
    "time runs backwards": (cell(300, "t", "1.0"), (LINE, "302")),
    "text for a number": (cell(40, "q", "fast"), (LINE, "42", "fast")),
    "infinity": (cell(40, "az", "inf"), (LINE, "az")),
    "ragged row": (ragged, (LINE, "8")),
    "unknown unit": (unknown_unit, ("furlongs/s",)),
    "binary": (binary, (LINE, "binary")),
    "too short": (shortened, (LINE, "2")),
    "no rotor speeds": (without_rotors, (LINE, "rpm_upper")),
    "no log": (missing_run, (LINE,)),
}


def check_refused(done: subprocess.CompletedProcess, folder: Path, *words: str) -> None:
    """One line that says what was found, exit code 2, nothing written."""
    assert done.returncode == 2, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ") and len(lines[0]) < 1000
    for word in words:
        assert word in lines[0], (word, lines[0])
    assert not done.stdout
    left = {path.name for path in folder.iterdir()}
    assert left <= {"flight", "poor.toml"}, left


def put(folder: Path, files: dict[str, bytes]) -> None:
    """A flight folder, and a vehicle whose mass lacks its std."""
    (folder / "flight").mkdir()
    for name, content in files.items():
        (folder / "flight" / name).write_bytes(content)
    document = tomlkit.parse(vehicle_toml(load_vehicle("lama400d")))
    del document["parameters"]["mass"]["std"]
    (folder / "poor.toml").write_text(tomlkit.dumps(document))


@pytest.mark.parametrize("what", SPOILT)
def test_a_spoilt_flight_is_refused(what, sound_text, here, tmp_path):
    spoil, words = SPOILT[what]
    files = dict(sound_text)
    spoil(files)
    put(tmp_path, files)
    check_refused(here("replay.py", "flight", "--out", "out"), tmp_path, *words)


# script, words, what the error must say; flight is a sound one, poor.toml lacks a std
REQUESTS: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "no flight": (["diagnose.py", "nowhere"], ("nowhere",)),
    "no such vehicle": (["identify.py", "flight", "--vehicle", "lama500"], ("lama500", "lama400d")),
    "vehicle without a std": (
        ["replay.py", "flight", "--vehicle", "poor.toml"],
        ("poor.toml", "mass", "std"),
    ),
    "negative horizon": (["replay.py", "flight", "--horizon", "-1"], ("--horizon", "-1")),
    "horizon in words": (["replay.py", "flight", "--horizon", "long"], ("--horizon", "long")),
    "no card": (["check_flight.py", "."], ("card.toml", "--draft")),
    "a file for a folder": (["check_flight.py", "flight/card.toml/x.csv"], ("no flight folder",)),
    "no CSV to draft for": (["check_flight.py", ".", "--draft"], ("no CSV",)),
    "no such run": (["diagnose.py", "flight", "--hold-out", "loop"], ("loop", "lon_3211")),
    "no such effect": (["diagnose.py", "flight", "--exclude", "gremlins"], ("gremlins",)),
    "no such method": (["identify.py", "flight", "--method", "guess"], ("guess",)),
    "no such channel": (["identify.py", "flight", "--channels", "q,lift"], ("lift", "rpm_upper")),
    "no such effect to fit": (["identify.py", "flight", "--also", "gremlins"], ("gremlins",)),
    "nothing of that name to learn": (["plan_flight.py", "--learn", "charm"], ("charm", "mass")),
    "no such log": (["import_log.py", "log.ulg"], ("log.ulg",)),
    "a log of no kind": (["import_log.py", "poor.toml"], ("poor.toml", ".ulg")),
    "a cut in words": (["import_log.py", "poor.toml", "--cut", "early"], ("early", "FROM-TO")),
    "no such edit": (["edit_log.py", "flight", "--edit", "gian=1.2"], ("gian", "gain")),
    "an edit in words": (["edit_log.py", "flight", "--edit", "gain=much"], ("NAME=SIZE",)),
    "no such moment": (
        ["edit_log.py", "flight", "--edit", "gain=1.2", "--since", "end"],
        ("RUN:T", "end"),
    ),
    "no such edit to check": (["check_edits.py", "flight", "--edit", "sun=1"], ("sun", "phase")),
    "nothing to compare with": (["compare.py", "flight"], ("flight", 'part = "A"')),
    "a logbook of nowhere": (["logbook.py", "nowhere"], ("nowhere",)),
    "no pairs": (["study_changes.py", "--same", "0", "--changed", "0"], ("pair",)),
    "no such maneuver": (["simulate.py", "--maneuver", "looping"], ("looping",)),
    "no such sensors": (["simulate.py", "--sensors", "radar"], ("radar",)),
    "no such controller": (["evaluate.py", "--controller", "none.json"], ("none.json",)),
    "no episodes": (["evaluate.py", "--episodes", "0"], ("episode",)),
    "no such weight": (["design_lqr.py", "--weights", "charm=1"], ("charm", "height")),
    "a weight in words": (["design_lqr.py", "--weights", "height=much"], ("height", "much")),
    "no weight for the effort": (["design_lqr.py", "--weights", "effort=0"], ("effort",)),
    "no such file of limits": (["design_lqr.py", "--limits", "l.toml"], ("l.toml",)),
    "speeds that fall": (["design_lqr.py", "--speeds", "0", "2", "1"], ("speeds",)),
    "nothing to export as C": (["export.py", "lqi"], ("lqi", "lqg")),
    "no flight to compare": (["export.py", "pid", "--seconds", "0"], ("--seconds",)),
    "no such option": (["design_lqr.py", "--fast"], ("--fast",)),
}


@pytest.mark.parametrize("what", REQUESTS)
def test_a_bad_request_is_refused(what, sound_text, here, tmp_path):
    (name, *words), said = REQUESTS[what]
    put(tmp_path, sound_text)
    check_refused(here(name, *words), tmp_path, *said)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["no flight", "no such controller", "no such option"])
def test_it_is_refused_in_a_process_of_its_own(what, tmp_path):
    (name, *words), said = REQUESTS[what]
    check_refused(script(name, *words, cwd=tmp_path), tmp_path, *said)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(PYTHON_SCRIPTS) - {"coax.py"}))
def test_a_python_without_the_package_is_told_what_to_run(name, tmp_path):
    """All scripts import `command_line` before any package; ``-S`` hides what is installed. coax.py
    is installed with the package."""
    without = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        [sys.executable, "-S", str(ROOT / "scripts" / name), "x"], cwd=tmp_path, env=without,
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 2 and not done.stdout
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ") and "scripts/demo" in line and name in line


def test_a_name_that_is_taken_is_left_alone(sound_text, here, tmp_path):
    put(tmp_path, sound_text)
    (tmp_path / "taken").write_text("a file")
    done = here("replay.py", "flight", "--out", "taken")
    assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith("error: ")
    assert (tmp_path / "taken").read_text() == "a file"


# --- good input ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_simulate_then_replay_then_identify(here, tmp_path):
    """A simulated flight goes through the other scripts as a measured one does."""
    done = script("simulate.py", "--maneuver", "lon_3211,heave_3211", "--out", "sim", "--seed", "3",
                  cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (tmp_path / "sim").iterdir()} == {"flight", "report.html"}
    assert read_flight(tmp_path / "sim/flight").run_names == ("lon_3211", "heave_3211")

    done = script("replay.py", "sim/flight", "--horizon", "0.5", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = json.loads((tmp_path / "runs/replay/replay.json").read_text())
    assert table["horizon_s"] == 0.5 and set(table["runs"]) == {"lon_3211", "heave_3211"}
    for entry in table["runs"]["lon_3211"].values():
        assert {"rms", "noise_rms", "unit"} <= set(entry)

    done = script("identify.py", "sim/flight", "--out", "fitted", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (tmp_path / "fitted").iterdir()} == {"vehicle.toml", "report.html"}
    path = tmp_path / "fitted" / "vehicle.toml"
    assert load_vehicle(path)["mass"].std <= load_vehicle("lama400d")["mass"].std
    gymnasium.make("CoaxHeli-v0", vehicle=str(path)).close()

    done = here("identify.py", "sim/flight", "--method", "paper", "--out", "steps")
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (tmp_path / "steps").iterdir()} == {"vehicle.toml", "report.html"}
    assert "Table VIII examined" in (tmp_path / "steps" / "report.html").read_text()


@pytest.mark.slow
def test_without_plotly_the_results_are_there_and_it_says_what_to_install(
    sound_text, tmp_path, monkeypatch, capsys
):
    import replay

    put(tmp_path, sound_text)
    page = importlib.import_module("coax_env.report.page")  # the room has a function of that name
    page._packed_plotly.cache_clear()  # of tests before
    for module in ("plotly", "plotly.offline"):
        monkeypatch.setitem(sys.modules, module, None)  # importing it is an ImportError
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["replay", str(tmp_path / "flight"), "--out", str(out)])
    replay.main()
    assert json.loads((out / "replay.json").read_text())["runs"]
    assert not (out / "report.html").exists()
    last = capsys.readouterr().out.splitlines()[-1]
    assert "no report: this needs plotly" in last and "pip install 'coaxheli[report]'" in last


@pytest.mark.slow
def test_a_planned_flight_is_a_flight_folder(tmp_path):
    done = script("plan_flight.py", "--runs", "2", "--learn", "inertia_yy", "--out", "plan",
                  cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len(read_flight(tmp_path / "plan").runs) == 2
    assert {"asked_01.csv", "asked_02.csv"} <= {p.name for p in (tmp_path / "plan").iterdir()}
    assert "inertia_yy" in done.stdout


@pytest.mark.slow
def test_diagnose_writes_what_the_contract_says(tmp_path):
    flight = injector.fly(tmp_path / "flight", {"gyro_bias": {}}, runs=["lon_3211", "lat_3211"])
    done = script("diagnose.py", flight, "--hold-out", "lat_3211", "--fly", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "runs" / "diagnose"
    assert {p.name for p in out.iterdir()} == {"findings.json", "vehicle.toml", "report.html"}
    findings = json.loads((out / "findings.json").read_text())
    assert findings["gain"]["held_out"] == ["lat_3211"]
    assert "gyro_bias" in {c["effect"] for c in findings["causes"]}
    assert done.stdout.startswith(f"verdict: {findings['verdict']}")
    assert "gyro_bias" in load_vehicle(out / "vehicle.toml").effects
    page = (out / "report.html").read_text()
    assert "gyro bias" in page.lower() and 'src="http' not in page
    assert "Controllers of both models" in page


@pytest.mark.slow
def test_diagnose_writes_the_next_flight_of_a_tie(here, tmp_path):
    """On a hover a scale of az is confounded with a bias; what an earlier one wrote is replaced."""
    flight = injector.fly(tmp_path / "flight", {"accel_scale": {}}, runs=["hover"], seed=4)
    others = [name for name in CATALOGUE if name not in ("accel_scale", "accel_bias")]
    out = tmp_path / "runs" / "diagnose"
    (out / "next_flight").mkdir(parents=True)
    (out / "next_flight" / "card.toml").write_text("of an earlier diagnosis")
    done = here("diagnose.py", flight, "--exclude", ",".join(others))
    assert done.returncode == 0, done.stderr
    following = json.loads((out / "findings.json").read_text())["next_maneuver"]
    assert set(following["separates"]) == {"accel_scale", "accel_bias"}
    assert f"fly next: {following['maneuver']}" in done.stdout
    assert read_flight(out / "next_flight").run_names == (following["maneuver"],)


class Counted:
    """A vector env of three that counts its steps and takes a millisecond for each."""

    def __init__(self):
        self.steps = 0

    def step(self, action):
        self.steps += 1
        time.sleep(1e-3)


def test_a_rate_counts_every_env_and_no_warm_up():
    from speed import timing

    env = Counted()
    flown = timing.Flown(env.step, [0] * timing.BATCHES, 3, 100.0, 1, "0")
    rate = timing.steps_per_second(flown, 0.05)
    assert 0 < rate <= 3 / 1e-3
    assert env.steps % timing.BATCHES == 0 and env.steps > timing.BATCHES


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["one", "many", "kernel", "start"])
def test_our_program_flies_in_every_mode(mode):
    import benchmark

    ours = benchmark.Contender("coax", Path(sys.executable), "fly_coax.py")
    found = benchmark.fly(ours, mode, 5, 0.0)
    assert found["value"] > 0.0 and found["count"] == (5 if mode in ("many", "kernel") else 1)


def test_vehicles_take_turns_and_the_first_turn_does_not_count(monkeypatch):
    from speed import fly_vehicles

    assert not next(iter(fly_vehicles.worlds().values()))  # the bare one: others are held to it
    assert fly_vehicles.flying(3, {})() == 3 * fly_vehicles.STEPS
    clock, taken = [0.0], []
    monkeypatch.setattr(fly_vehicles.time, "perf_counter", lambda: clock[0])

    def turn(name: str, seconds: list[float]) -> Callable[[], int]:
        def fly() -> int:
            taken.append(name)
            clock[0] += seconds.pop(0)
            return 8

        return fly

    turns = {"bare": turn("bare", [1.0, 4.0, 2.0]), "laden": turn("laden", [1.0, 8.0, 16.0])}
    assert fly_vehicles.best_of(turns, 2) == {"bare": 4.0, "laden": 1.0}
    assert taken == ["bare", "laden"] * 3


def test_every_peer_has_its_program_and_its_pins():
    from speed import peers

    for peer in peers.PEERS:
        words = [word for step in peer.steps for word in step]
        assert all("==" in w for w in words if w.startswith((peer.name, "torch", "numpy==")))
        assert not peer.program or (ROOT / "scripts/speed" / peer.program).is_file()
        if peer.program:
            compile((ROOT / "scripts/speed" / peer.program).read_text(), peer.program, "exec")


@pytest.mark.slow
def test_a_peer_that_cannot_be_installed_has_a_reason_and_no_number(tmp_path):
    from speed import peers

    absent = peers.Peer("absent", "fly_absent.py", (("--no-index", "no-such-package==1.0"),))
    with pytest.raises(peers.Unavailable, match="no-such-package"):
        peers.install(absent, tmp_path, None)
    assert not (tmp_path / "absent" / "installed").exists()


def test_the_benchmarks_table():
    """Ratios are ours over theirs for speeds, theirs over ours for times; a failure has no figure."""
    import benchmark

    def found(value):
        facts = {"count": 8, "control_hz": 100.0, "physics_steps": 1, "note": ""}
        return {"value": value, **facts}

    speeds = {"coax": found(600.0), "slow": found(200.0), "lame": {"failed": "no wheel"}}
    result = {
        "rows": {
            row.title: {"coax": found(2.0), "late": found(3.0)} if row.fewer else speeds
            for row in benchmark.ROWS
        },
        "kernel": found(1000.0), "cold_start_s": 12.0, "effects_off_ratio": 1.02,
        "vehicles": {"bare": 400.0, "four effects": 300.0}, "training": {},
        "diagnoses": [{
            "hidden": ["a", "b"], "named": ["a"], "runs": 12, "seconds": 11.0, "flown_s": 220.0,
            "before": 44.0, "memory_mb": 512.3,
        }],
    }  # fmt: skip
    lines = benchmark.table(result)
    assert all(len(line) == len(lines[0]) for line in lines)
    text = ["|".join(line) for line in lines]
    assert sum("slow|200 /s|3 x faster" in line for line in text) == 2
    assert sum("late|3 s|1.5 x quicker" in line for line in text) == 1
    assert sum("lame|-|" in line and "no wheel" in line for line in text) == 2
    assert any("0.60 of it in the env" in line for line in text)
    assert text[-4].startswith("effects off, against cut out|coax|+2.0 %")
    assert text[-2] == "env-steps, four effects|coax|300 /s|||||0.75 of bare"
    told = "50 ms per second flown, 0.25 of before, 512 MB"
    assert text[-1] == f"diagnosis of 12 runs, 2 hidden, 1 named|coax|11 s|||||{told}"


def test_the_better_of_two_rounds_counts(monkeypatch):
    import benchmark

    values = iter([3.0, 5.0, 4.0, 3.0, 5.0, 4.0])
    monkeypatch.setattr(benchmark, "fly", lambda *_: {"value": next(values)})
    options = SimpleNamespace(rounds=3, envs=1, seconds=0.0)
    ours = [benchmark.Contender("coax", Path(), "")]
    for fewer, best in ((False, 5.0), (True, 3.0)):
        row = benchmark.Row("", "one", fewer=fewer)
        assert benchmark.in_turns(ours, row, options, str)["coax"]["value"] == best
