"""The wheel: what is in it, and that it flies where there is no checkout."""

import json
import os
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import coax_env
from coax_env.errors import DISTRIBUTION

Done = subprocess.CompletedProcess
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
    assert "would be ignored" not in done.stdout + done.stderr, "data that setuptools may leave out"
    return next(folder.glob("*.whl"))


def test_every_package_is_declared() -> None:
    """A new folder, of code or data, would be left out of the wheel, and nobody would notice here."""
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    declared = tools["setuptools"]["packages"]
    there = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for top in ("coax_env", "controllers")
        for path in (ROOT / top).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert there <= set(declared), there - set(declared)
    gone = [
        p for p in declared if p != "coax_commands" and not (ROOT / p.replace(".", "/")).is_dir()
    ]
    assert not gone, gone
    assert len(declared) == len(set(declared))


def test_every_requirement_is_pinned() -> None:
    """Also of the extras that scripts/set_up.sh leaves out, and each pin is one that is asked for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    asked = [Requirement(text) for part in (project["dependencies"], *extras) for text in part]
    pins = {}
    for line in (ROOT / "scripts" / "constraints.txt").read_text().splitlines():
        if not line.startswith("#"):
            name, version = line.split("==")
            pins[canonicalize_name(name)] = version
    for requirement in asked:
        assert pins[canonicalize_name(requirement.name)] in requirement.specifier, requirement
    assert not [name for name in pins if name.startswith(("nvidia", "cuda", "triton"))]


@pytest.mark.slow
def test_the_wheel_has_every_file_of_the_packages(wheel):
    """All that lies in the packages, data too: an editable install would hide what is missing."""
    found = set(zipfile.ZipFile(wheel).namelist())
    src = wheel.parent / "src"
    wanted = {
        path.relative_to(src).as_posix()
        for package in ("coax_env", "controllers")
        for path in (src / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.name != "README.md"
    }
    assert wanted <= found, wanted - found
    assert {f"coax_commands/{p.name}" for p in (src / "scripts").glob("*.py")} <= found
    assert not [name for name in found if name.startswith(("tests/", "scripts/", "study/"))]
    assert wheel.name.startswith(f"{DISTRIBUTION}-{coax_env.__version__}-")


@pytest.fixture(scope="module")
def coax(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Done]:
    """`coax WORDS`, or a Python text, in an environment that has the wheel and not the checkout.

    The packages that coax needs are lent by this environment, so that nothing is downloaded.
    """
    place = tmp_path_factory.mktemp("clean")
    venv.create(place, with_pip=False, symlinks=True)
    site = next(place.glob("lib/python*/site-packages"))
    (site / "lent.pth").write_text(sysconfig.get_path("purelib"))  # its own .pth files do not count
    python = place / "bin" / "python"
    subprocess.run(
        [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-deps",
         "--no-index", "--ignore-installed", str(wheel)],
        check=True, timeout=120, capture_output=True,
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("work")
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}

    def call(*words: str, code: int = 0, text: str = "") -> Done:
        command = [python, "-c", text] if text else [place / "bin" / "coax", *words]
        done = subprocess.run(
            command, cwd=folder, env=env, capture_output=True, text=True, timeout=900, check=False
        )
        assert done.returncode == code, done.stderr[-1500:]
        return done

    return call


@pytest.mark.slow
def test_it_works_where_there_is_no_checkout(coax):
    """One test: apart, two workers would each compile the kernel for an environment of its own."""
    the_verbs_work(coax)
    data_files_have_come(coax)
    what_is_missing_is_named_with_its_extra(coax)


def the_verbs_work(coax: Callable[..., Done]) -> None:
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
    coax("simulate", "--maneuver", "lon_3211,heave_3211", "--out", "my")
    assert "next: coax diagnose" in coax("check_flight", "my/flight").stdout
    assert coax("diagnose", "my/flight").stdout.startswith("verdict: consistent\n")


def data_files_have_come(coax: Callable[..., Done]) -> None:
    found = coax(
        text="import json, coax_env; from pathlib import Path\n"
        "from coax_env.model.vehicle_file import shipped_vehicles\n"
        "from coax_env.identification.two_step.published import table_viii\n"
        "from controllers.loading import make_controller\n"
        "here = Path(coax_env.__file__).parent\n"
        "flight = coax_env.read_flight('windy')\n"
        "print(json.dumps([str(here), len(flight.runs), list(shipped_vehicles()),"
        " len(table_viii()), make_controller('ppo').kind]))"
    )
    here, runs, vehicles, printed, kind = json.loads(found.stdout)
    assert not Path(here).is_relative_to(ROOT) and "site-packages" in here
    assert (runs, printed, kind) == (12, 3, "ppo") and {"lama400d", "skybotix_coax"} <= set(
        vehicles
    )


def what_is_missing_is_named_with_its_extra(coax: Callable[..., Done]) -> None:
    refused = coax(code=1, text="from coax_env.errors import require; require('pigame', 'render')")
    assert refused.stderr.splitlines()[-1] == (
        "coax_env.errors.MissingPackage: this needs pigame, which is not installed: pip install"
        " 'coaxheli[render]', or what it consists of: pip install 'moviepy>=1.0' 'pygame>=2.6'"
    )


@pytest.mark.slow
@pytest.mark.parametrize("python", os.environ.get("COAX_PYTHONS", "").split())
def test_it_works_under_another_python(wheel, python):
    """``COAX_PYTHONS="/path/to/python3.12 /path/to/python3.13"``: each takes what it needs from the
    package index. wheel_elsewhere.py says how to get a Python that the machine lacks."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    script = Path(__file__).with_name("wheel_elsewhere.py")
    done = subprocess.run(
        [python, script, wheel], env=env, capture_output=True, text=True, timeout=3000, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "the wheel flies, checks and diagnoses" in done.stdout
