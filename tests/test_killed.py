"""kill -9 at random moments: what has a name is whole, and what can go on goes on.

The work runs in a forked child, so that a kill falls into the work and not into seconds of imports.
"""

import errno
import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from autopilot_files import ulog
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
    wait = time.monotonic() - begun  # for one rollout and its checkpoint
    rng = random.Random(2)
    out = tmp_path / "killed"
    kills = 0
    while kills < 5 or path.parent != out:
        assert killed(partial(train, out, steps=10**9, resume=path), rng.uniform(0.2, 3.0) * wait)
        assert named(out) in (set(), {"policy.zip"})
        if named(out):
            path = out / "policy.zip"
            load_controller(path)
        kills += 1
        wait *= 1.0 if named(out) else 1.5
        assert kills < 20, "never a checkpoint"
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

    def is_killed() -> bool:
        """Sooner at first: beside other work what is usual may be far too long."""
        seconds = rng.uniform(0.05, 0.4) * usual * 0.2 * (1 + kills)
        return killed(partial(study, tmp_path / "killed"), seconds)

    while is_killed():
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


# --- other writers of results ---------------------------------------------------------------------


def imports(place: Path) -> dict[str, Path]:
    """A log in each form that import_log writes a flight from."""
    from scipy.io import savemat

    run = read_flight(short_flight(place / "flight")).runs[0]
    columns = {
        "time": run.t, "rpm_u": 9.549 * run.command[:, 0], "rpm_l": 9.549 * run.command[:, 1],
        "dlon": run.command[:, 2], "dlat": run.command[:, 3], "roll": run.measured["phi"],
    }  # fmt: skip
    savemat(place / "log.mat", columns)
    lines = [
        ",".join(columns),
        *(",".join(map(repr, row)) for row in zip(*columns.values(), strict=True)),
    ]
    (place / "log.csv").write_text("\n".join(lines))
    topics = {"rotors": ([*columns][1:5], 100.0, np.stack(list(columns.values())[1:5], 1))}
    gyro = np.stack([np.nan_to_num(run.measured[c]) for c in "pqr"], 1)
    topics["sensor_combined"] = ([f"gyro_rad[{k}]" for k in range(3)], 100.0, gyro)
    (place / "log.ulg").write_bytes(ulog(topics))
    return {form: place / f"log.{form}" for form in ("mat", "csv", "ulg")}


TAKE = [w for c, f in (("rpm_upper_cmd", "rpm_u"), ("rpm_lower_cmd", "rpm_l"), ("delta_lon", "dlon"),
                       ("delta_lat", "dlat")) for w in ("--take", f"{c}=rotors.{f}")]  # fmt: skip


@pytest.mark.parametrize("form", ["mat", "csv", "ulg"])
def test_an_import(form, tmp_path, monkeypatch):
    """A flight folder with all its files, or none; and one that is replaced is old or new."""
    if form == "ulg":
        pytest.importorskip("pyulog")
    import import_log

    log = imports(tmp_path)[form]
    words = ["import_log", str(log), "--overwrite", *(TAKE if form == "ulg" else [])]
    monkeypatch.setattr(sys, "argv", [*words, "--out", str(tmp_path / "whole")])
    import_log.main()
    begun = time.monotonic()
    import_log.main()
    usual = time.monotonic() - begun
    whole = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()}
    rng = random.Random(5)
    for number in range(12):
        out = tmp_path / "out" / f"f_{number // 2}"
        monkeypatch.setattr(sys, "argv", [*words, "--out", str(out)])
        killed(import_log.main, rng.uniform(0.3, 1.1) * usual)
        assert named(out) in (set(), set(whole))
        assert all((out / name).read_bytes() == whole[name] for name in named(out))


def content_of_a_comparison() -> Any:
    """What compare gives, as far as it is written."""
    changes = {"verdict": "same", "changes": [], "unexplained": [], "remarks": ["x" * 300_000]}
    return SimpleNamespace(changes=changes)


def slow_writers(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """Scripts whose work is done at once, and writes much: script -> names of what it writes."""
    import compare
    import diagnose
    import logbook

    import coax_env
    from coax_env import report

    page = "<html>" + "y" * 300_000 + "</html>"
    kept = {"vehicle": None, "links": [], "flights": [], "changes": [], "text": "z" * 300_000}
    row = {"flight": "f", "folder": "f", "error": "", "verdict": "v" * 300_000, "sure": [],
           "doubtful": [], "removed": None, "seconds": 1.0}  # fmt: skip

    def grown(*words: Any) -> dict[str, Any]:
        for _ in range(5):
            words[5](kept)
        return kept

    monkeypatch.setattr(
        coax_env, "compare", lambda *a, **k: content_of_a_comparison(), raising=False
    )
    monkeypatch.setattr(coax_env, "logbook", grown, raising=False)
    monkeypatch.setattr(diagnose, "_one_of_many", lambda *a: row)
    monkeypatch.setattr(diagnose, "flights_in", lambda paths: [Path("a"), Path("b")])
    for name in ("comparison_page", "logbook_page", "many_flights_page"):
        monkeypatch.setattr(report, name, lambda *a: page)
    assert compare and logbook
    return {
        "compare": ["changes.json", "report.html"],
        "logbook": ["logbook.json", "logbook.html"],
        "diagnose": ["summary.json", "summary.html"],
    }


@pytest.mark.parametrize("name", ["compare", "logbook", "diagnose"])
def test_results_that_are_written_again_and_again(name, tmp_path, monkeypatch):
    """First the results, then the page, each whole, whenever it was killed."""
    import importlib

    result, page = slow_writers(monkeypatch)[name]
    script = importlib.import_module(name)
    out = tmp_path / "out"
    words = [name, "a", *(["--jobs", "1"] if name != "compare" else []), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    script.main()
    begun = time.monotonic()
    script.main()
    usual = time.monotonic() - begun
    for path in out.iterdir():
        path.unlink()
    rng = random.Random(6)
    for _ in range(25):
        killed(script.main, rng.uniform(0.0, 1.0) * usual)
        assert named(out) in (set(), {result}, {result, page})
        for path in out.glob("[!.]*.json"):
            json.loads(path.read_text())
        for path in out.glob("[!.]*.html"):
            assert path.read_text().endswith("</html>")


@pytest.mark.parametrize("name", ["compare", "logbook", "diagnose"])
@pytest.mark.parametrize("stop", ["full", "interrupted"])
def test_a_full_disk_and_ctrl_c_leave_what_was_there(name, stop, tmp_path, monkeypatch):
    """The old results stay as they were; nothing half-written, and one line says why."""
    import importlib

    from coax_env import files
    from coax_env.errors import InputError

    slow_writers(monkeypatch)
    script = importlib.import_module(name)
    out = tmp_path / "out"
    words = [name, "a", *(["--jobs", "1"] if name != "compare" else []), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    script.main()
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    fails = (
        OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) if stop == "full" else KeyboardInterrupt()
    )

    class Full:
        def __init__(self, file: Any) -> None:
            self.file = file

        def __enter__(self) -> "Full":
            return self

        def __exit__(self, *said: object) -> None:
            self.file.close()

        def write(self, content: bytes) -> None:
            self.file.write(content[:1000])
            raise fails

    fdopen = os.fdopen
    monkeypatch.setattr(files.os, "fdopen", lambda handle, mode: Full(fdopen(handle, mode)))
    expected = InputError if stop == "full" else KeyboardInterrupt
    with pytest.raises(expected, match="No space left" if stop == "full" else None):
        script.main()
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
