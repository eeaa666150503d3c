"""The wheel: what is in it, and that it flies where there is no checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import coax_env

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "coax_env", "controllers", "scripts")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, so that nothing is left in the tree."""
    folder = tmp_path_factory.mktemp("wheel")
    tree = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", *SOURCES],
        cwd=ROOT, capture_output=True, text=True, check=False,
    ).stdout.split()  # fmt: skip
    if not tree:
        pytest.skip("not a git checkout: what belongs to the project is not known")
    for name in tree:
        if (ROOT / name).exists():
            (folder / "src" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "src" / name).write_bytes((ROOT / name).read_bytes())
    done = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation",
         "--no-index", "-w", str(folder), str(folder / "src")],
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return next(folder.glob("*.whl"))


@pytest.mark.slow
def test_the_wheel_has_every_file_of_the_packages(wheel):
    """All that lies in the packages, data too: an editable install would hide what is missing."""
    found = set(zipfile.ZipFile(wheel).namelist())
    src = wheel.parent / "src"
    wanted = {
        path.relative_to(src).as_posix()
        for package in ("coax_env", "controllers")
        for path in (src / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert wanted <= found, wanted - found
    assert {f"coax_commands/{p.name}" for p in (src / "scripts").glob("*.py")} <= found
    assert not [name for name in found if name.startswith(("tests/", "scripts/", "study/"))]
    assert wheel.name.startswith(f"coax-{coax_env.__version__}-")


@pytest.mark.slow
def test_the_verbs_work_from_the_wheel(wheel, tmp_path):
    """`coax`, the quick start and the shipped data, with the wheel in the place of the checkout."""
    target = tmp_path / "installed"
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index",
         "--target", str(target), str(wheel)],
        check=True, timeout=120, capture_output=True,
    )  # fmt: skip
    env = {**os.environ, "PYTHONPATH": str(target)}

    def coax(*words: str, code: int = 0) -> subprocess.CompletedProcess:
        call = "import sys; from coax_commands.coax import main; sys.exit(main())"
        done = subprocess.run(
            [sys.executable, "-c", call, *words],
            cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        assert done.returncode == code, done.stderr[-1500:]
        return done

    said = coax("--help").stdout
    for verb in (
        "simulate",
        "check_flight",
        "diagnose",
        "identify",
        "design_lqr",
        "compare_models",
    ):
        assert f"\n  {verb} " in said
    assert coax("--version").stdout == f"coax {coax_env.__version__}\n"
    assert coax("diagnose", "--help").stdout.startswith("usage: coax diagnose")
    refused = coax("check-flight", "nowhere", code=2)
    assert refused.stderr.startswith("error: no flight folder")
    assert len(coax("fly", code=2).stderr.splitlines()) == 1
    coax("simulate", "--maneuver", "lon_3211,heave_3211", "--out", "sim")
    assert "next: coax diagnose" in coax("check_flight", "sim/flight").stdout
    coax("identify", "sim/flight", "--method", "paper", "--out", "steps")  # reads published.toml
    quick = (
        "import coax_env, gymnasium; from pathlib import Path; from coax_env.flight import *;"
        "here = Path(coax_env.__file__).parent;"
        "assert 'installed' in here.parts, here;"
        "assert len(read_flight(here / 'flights' / 'windy').runs) == 12;"
        "env = gymnasium.make('CoaxHeli-v0', vehicle='lama400d'); env.reset(seed=1);"
        "env.step(env.action_space.sample())"
    )
    done = subprocess.run(
        [sys.executable, "-c", quick], cwd=tmp_path, env=env, capture_output=True, text=True,
        timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-1500:]
