"""The scripts as a user runs them: help, bad input in one line and exit code 2, results where told."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium
import injector
import pytest
import tomlkit

from coax_env import load_vehicle, read_flight
from coax_env.vehicle import vehicle_toml

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


@pytest.mark.parametrize("name", PYTHON_SCRIPTS)
def test_help(name, tmp_path):
    done = script(name, "--help", cwd=tmp_path)
    assert done.returncode == 0 and not done.stderr
    assert done.stdout.startswith("usage: ") and "--out" in done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["demo", "test"])
def test_help_of_the_shell_scripts(name, tmp_path):
    done = subprocess.run(
        ["bash", str(ROOT / "scripts" / name), "--help"], cwd=tmp_path,
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0 and f"scripts/{name}" in done.stdout


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


def check_refused(done: subprocess.CompletedProcess, cwd: Path, *words: str) -> None:
    """One line that says what was found, exit code 2, nothing written."""
    assert done.returncode == 2, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ") and len(lines[0]) < 400
    for word in words:
        assert word in lines[0], (word, lines[0])
    assert not done.stdout
    assert not (cwd / "runs").exists() and not (cwd / "out").exists()


@pytest.mark.parametrize("what", SPOILT)
def test_a_spoilt_flight_is_refused(what, sound_text, tmp_path):
    spoil, words = SPOILT[what]
    files = dict(sound_text)
    spoil(files)
    (tmp_path / "flight").mkdir()
    for name, content in files.items():
        (tmp_path / "flight" / name).write_bytes(content)
    done = script("replay.py", "flight", "--out", "out", cwd=tmp_path)
    check_refused(done, tmp_path, *words)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["flight"]


# script, words, what the error must say; FLIGHT is a sound flight, POOR a vehicle without a std
REQUESTS: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "no flight": (["diagnose.py", "nowhere"], ("nowhere",)),
    "no such vehicle": (["identify.py", "FLIGHT", "--vehicle", "lama500"], ("lama500", "lama400d")),
    "vehicle without a std": (
        ["replay.py", "FLIGHT", "--vehicle", "POOR"],
        ("POOR", "mass", "std"),
    ),
    "negative horizon": (["replay.py", "FLIGHT", "--horizon", "-1"], ("--horizon", "-1")),
    "horizon in words": (["replay.py", "FLIGHT", "--horizon", "long"], ("--horizon", "long")),
    "horizon longer than the run": (["replay.py", "FLIGHT", "--horizon", "50"], ("50",)),
    "no such run": (["diagnose.py", "FLIGHT", "--hold-out", "loop"], ("loop", "lon_3211")),
    "no such effect": (["diagnose.py", "FLIGHT", "--exclude", "gremlins"], ("gremlins",)),
    "no such method": (["identify.py", "FLIGHT", "--method", "guess"], ("guess",)),
    "no such maneuver": (["simulate.py", "--maneuver", "looping"], ("looping",)),
    "no such sensors": (["simulate.py", "--sensors", "radar"], ("radar",)),
    "no such controller": (["evaluate.py", "--controller", "none.json"], ("none.json",)),
    "no episodes": (["evaluate.py", "--episodes", "0"], ("episodes",)),
    "no such option": (["design_lqr.py", "--fast"], ("--fast",)),
}


@pytest.mark.parametrize("what", REQUESTS)
def test_a_bad_request_is_refused(what, sound_text, tmp_path):
    (name, *words), said = REQUESTS[what]
    (tmp_path / "FLIGHT").mkdir()
    for file, content in sound_text.items():
        (tmp_path / "FLIGHT" / file).write_bytes(content)
    document = tomlkit.parse(vehicle_toml(load_vehicle("lama400d")))
    del document["parameters"]["mass"]["std"]
    (tmp_path / "POOR").write_text(tomlkit.dumps(document))
    check_refused(script(name, *words, cwd=tmp_path), tmp_path, *said)


def test_a_name_that_is_taken_is_refused_before_the_work(sound_text, tmp_path):
    (tmp_path / "FLIGHT").mkdir()
    for file, content in sound_text.items():
        (tmp_path / "FLIGHT" / file).write_bytes(content)
    (tmp_path / "taken").write_text("a file")
    done = script("replay.py", "FLIGHT", "--out", "taken", cwd=tmp_path)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: ")
    assert (tmp_path / "taken").read_text() == "a file"


# --- good input ------------------------------------------------------------------------------------


def test_simulate_then_replay_then_identify(tmp_path):
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


@pytest.mark.slow
def test_diagnose_writes_what_the_contract_says(tmp_path):
    flight = injector.fly(tmp_path / "flight", {"gyro_bias": {}}, runs=["lon_3211", "lat_3211"])
    done = script("diagnose.py", flight, "--hold-out", "lat_3211", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "runs" / "diagnose"
    assert {p.name for p in out.iterdir()} == {"findings.json", "vehicle.toml", "report.html"}
    findings = json.loads((out / "findings.json").read_text())
    assert findings["gain"]["held_out"] == ["lat_3211"]
    assert "gyro_bias" in {c["effect"] for c in findings["causes"]}
    assert done.stdout.startswith(f"verdict: {findings['verdict']}")
    assert "gyro_bias" in load_vehicle(out / "vehicle.toml").effects
    page = (out / "report.html").read_text()
    assert "gyro_bias" in page and 'src="http' not in page


@pytest.mark.slow
def test_design_then_evaluate(tmp_path):
    done = script("design_lqr.py", "--out", "lqr", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = script("evaluate.py", "--controller", "lqr/controller.json", "--episodes", "10",
                  "--seconds", "8", cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    score = json.loads((tmp_path / "runs/evaluate/score.json").read_text())
    assert score["episodes"] == 10 and score["success_rate"] > 0.5
