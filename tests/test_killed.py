"""kill -9 at random moments: what has a name is whole, and what can go on goes on.

The work runs in a forked child, so that a kill falls into the work and not into seconds of imports.
"""

import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from test_study import row_of

from coax_env import load_vehicle, read_flight
from coax_env.files import staged_folder, write_json, write_text
from coax_env.logs.flight import write_flight

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a forked child"),
]
LAMA = load_vehicle("lama400d")


def killed(work: Callable[[], Any], after: float) -> bool:
    """Let a child do the work and kill it after so many seconds; whether it was still at it."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            work()
            code = 0
        finally:
            os._exit(code)
    time.sleep(after)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0, "the work failed by itself"
    return os.WIFSIGNALED(status)


def named(folder: Path) -> set[str]:
    """What has a name there; temporary files begin with a dot."""
    return {p.name for p in folder.iterdir() if p.name[0] != "."} if folder.is_dir() else set()


def forever(work: Callable[[int], Any]) -> None:
    for number in range(10**9):
        work(number)


def test_writing_files_and_folders(tmp_path):
    """A file is all old or all new; a new folder has all its files or is not there."""
    body = "x" * 200_000

    def write(number: int) -> None:
        write_json(tmp_path / "one.json", {"number": number, "body": body})
        with staged_folder(tmp_path / f"folder_{number}") as stage:
            for name in "abc":
                write_text(stage / name, f"{number} {body} end")

    rng = random.Random(1)
    whole = 0
    for _ in range(25):
        assert killed(partial(forever, write), rng.uniform(0.01, 0.15))
        if (tmp_path / "one.json").exists():
            assert json.loads((tmp_path / "one.json").read_text())["body"] == body
        for folder in tmp_path.glob("folder_*"):
            number = folder.name.removeprefix("folder_")
            assert named(folder) == {"a", "b", "c"}
            assert all(p.read_text() == f"{number} {body} end" for p in folder.iterdir())
            whole += 1
    assert whole > 25


def test_training(tmp_path, monkeypatch):
    """policy.zip can be flown and trained on, whenever the training was killed."""
    pytest.importorskip("stable_baselines3")
    import torch

    from controllers import load_controller, ppo

    torch.set_num_threads(1)  # a forked child has no others
    small = {"n_envs": 16, "n_steps": 16, "batch_size": 128, "n_epochs": 1, "net_arch": [8]}
    for name, value in small.items():
        monkeypatch.setitem(ppo.SETTINGS, name, value)
    train = partial(ppo.train, LAMA, seed=1, checkpoint_steps=1)
    train(tmp_path / "warm", steps=1)
    begun = time.monotonic()
    path = train(tmp_path / "warm", steps=1)
    usual = time.monotonic() - begun  # of one rollout and its checkpoint
    rng = random.Random(2)
    out = tmp_path / "killed"
    for _ in range(5):
        assert killed(partial(train, out, steps=10**9, resume=path), rng.uniform(0.2, 3.0) * usual)
        assert named(out) in (set(), {"policy.zip"})
        if named(out):
            path = out / "policy.zip"
            load_controller(path)
    assert path.parent == out, "never a checkpoint"
    before = path.read_bytes()
    train(out, steps=1, resume=path)
    assert path.read_bytes() != before, "trained on"
    load_controller(path)


def test_the_study(tmp_path, monkeypatch):
    """What was stored is whole and is not flown again; in the end the figures are those of one go."""
    import study_diagnosis

    flown = tmp_path / "flown"
    flown.write_text("")

    def quick(flight: Any, only_own: bool = False) -> dict[str, Any]:
        time.sleep(0.005)
        with flown.open("a") as file:
            file.write(flight.name + "\n")
        return row_of(flight, [{"effect": e} for e in flight.effects])

    monkeypatch.setattr(study_diagnosis, "fly_and_diagnose", quick)

    def study(out: Path) -> None:
        words = ["study_diagnosis.py", "--clean", "40", "--effects", "80", "--jobs", "1"]
        monkeypatch.setattr(sys, "argv", [*words, "--out", str(out)])
        study_diagnosis.main()

    study(tmp_path / "at once")  # loads what it needs
    begun = time.monotonic()
    study(tmp_path / "again")
    usual = time.monotonic() - begun
    assert len(flown.read_text().splitlines()) == 240
    flown.write_text("")
    rng = random.Random(3)
    kills = 0
    while killed(
        partial(study, tmp_path / "killed"), rng.uniform(0.05, 0.4) * usual * (1 + kills / 5)
    ):
        kills += 1
        for path in (tmp_path / "killed" / "flights").glob("[!.]*"):
            assert json.loads(path.read_text())["plan"]
        assert kills < 40
    assert kills > 2
    again = flown.read_text().splitlines()
    assert len(again) <= 120 + kills, "one flight a kill at most is flown twice"
    for name in ("summary.json", "table.md"):
        texts = [(tmp_path / d / name).read_text() for d in ("at once", "killed")]
        assert texts[0].replace("at once", "killed").replace("'", "") == texts[1].replace("'", "")


def short_flight(folder: Path) -> Path:
    """Three seconds of a simulated doublet."""
    from dataclasses import replace

    from coax_env.model.sensors import log_suite
    from coax_env.simulation.simulate import fly_all, log_flight

    flight = log_flight(LAMA, fly_all(LAMA, ["lon_doublet"], seed=1), log_suite("onboard"), seed=1)
    run = flight.runs[0]
    rows = run.t < 3.0
    measured = {c: y[rows] for c, y in run.measured.items()}
    run = replace(run, t=run.t[rows], command=run.command[rows], measured=measured)
    return write_flight(replace(flight, runs=(run,)), folder)


@pytest.mark.parametrize("name", ["identify", "replay"])
def test_a_script_with_a_report(name, tmp_path, monkeypatch):
    """Results come whole or not at all, and after them the report, whole or not at all."""
    pytest.importorskip("plotly")
    import importlib

    script = importlib.import_module(name)
    flight = short_flight(tmp_path / "flight")
    result = {"identify": "vehicle.toml", "replay": "replay.json"}[name]
    monkeypatch.setattr(sys, "argv", [name, str(flight), "--out", str(tmp_path / "whole")])
    begun = time.monotonic()
    script.main()
    usual = time.monotonic() - begun
    rng = random.Random(4)
    for number in range(6):
        out = tmp_path / f"out_{number}"
        monkeypatch.setattr(sys, "argv", [name, str(flight), "--out", str(out)])
        killed(script.main, rng.uniform(0.5, 1.1) * usual)
        assert named(out) in (set(), {result}, {result, "report.html"})
        for path in out.glob("*"):
            if path.suffix == ".html":
                assert path.read_text().rstrip().endswith("</html>")
            elif path.suffix == ".toml":
                load_vehicle(path)
            else:
                json.loads(path.read_text())
    assert read_flight(flight).run_names == ("lon_doublet",)
