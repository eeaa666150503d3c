"""The house: one direction of imports, and a README whose tree is the real one."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("coax_env", "controllers")

GROUND = "errors files layout log_units workers"
MODEL = "parameters flow effects dynamics generic_terms jit late random_streams"
RECORDS = "flight foreign_columns outliers autopilot_logs"
MACHINE = "vehicle maneuvers multisine sensors"
ENVIRONMENT = "env fleet hover"
FITTING = (
    "heli_model prediction gain search diagnosis next_maneuver unlisted vibration identification "
    "flight_plan flight_check two_step closed_loop calibration trajectories"
)
SHOWN = "figures report"
WORDS = "plain_words consequences"

# what may not be reached from what, over any number of imports, those inside functions too
ARROWS: tuple[tuple[str, str, str], ...] = (
    ("the ground knows nothing above it",
     GROUND, f"{MODEL} {RECORDS} {MACHINE} {ENVIRONMENT} {FITTING} {SHOWN} {WORDS} engine"),
    ("the model knows no flight, no task, no fit",
     MODEL, f"{RECORDS} {ENVIRONMENT} {FITTING} {SHOWN} {WORDS} engine simulation pilot"),
    ("flights are read without the model",
     "flight foreign_columns outliers log_units", f"{MODEL} {FITTING} {ENVIRONMENT} vehicle engine"),
    ("a vehicle is a file, not a flight", "vehicle", f"{ENVIRONMENT} {FITTING} {SHOWN} engine"),
    ("the environment does not know how it was identified",
     ENVIRONMENT, f"{FITTING} {SHOWN} {WORDS} engine flight"),
    ("fits do not fly the environment", FITTING, "env fleet"),
    ("numbers do not know how they are shown",
     f"{FITTING} {ENVIRONMENT} engine simulation linear pilot", SHOWN),
)  # fmt: skip


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def modules() -> dict[str, Path]:
    return {module_name(p): p for package in PACKAGES for p in (ROOT / package).rglob("*.py")}


def imported(path: Path, also_later: bool = True) -> set[str]:
    """Names that a file imports; `also_later`: inside functions too. Not those for type checkers."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                continue
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) and not also_later:
                continue
            if isinstance(child, ast.Import):
                found.update(a.name for a in child.names)
            elif isinstance(child, ast.ImportFrom) and child.module:
                assert child.level == 0, f"{path}: import by full names"
                found.update(f"{child.module}.{a.name}" for a in child.names)
            visit(child)

    visit(ast.parse(path.read_text(encoding="utf-8")))
    return found


@cache
def direct(name: str, also_later: bool = True) -> frozenset[str]:
    """Modules of the project that one imports."""
    result = set()
    for target in imported(modules()[name], also_later):
        while target and target not in modules():
            target = target.rpartition(".")[0]
        if target and target not in (name, "coax_env"):  # the front door imports on demand
            result.add(target)
    return frozenset(result)


def reached(name: str) -> dict[str, str]:
    """Modules that one needs, directly or not -> the one through which it was first met."""
    found: dict[str, str] = {}
    todo = [name]
    while todo:
        here = todo.pop()
        for target in direct(here):
            if target not in found:
                found[target] = here
                todo.append(target)
    return found


def within(name: str, group: str) -> bool:
    own = name.removeprefix("coax_env.").split(".")[0]
    return name.startswith("coax_env.") and own in group.split()


def test_the_groups_name_what_there_is():
    top = {name.split(".")[1] for name in modules() if name.startswith("coax_env.")}
    for _, lower, upper in ARROWS:
        assert set(f"{lower} {upper}".split()) <= top, set(f"{lower} {upper}".split()) - top


@pytest.mark.parametrize(("rule", "lower", "upper"), ARROWS, ids=[a[0] for a in ARROWS])
def test_imports_point_one_way(rule, lower, upper):
    for name in modules():
        if within(name, lower):
            for target, by in reached(name).items():
                assert not within(target, upper), f"{name} reaches {target} by {by}: {rule}"


def test_the_engine_knows_no_helicopter():
    for name in modules():
        if within(name, "engine"):
            for target in reached(name):
                assert within(target, "engine jit"), f"{name} reaches {target}"


def test_the_package_knows_neither_controllers_nor_scripts_nor_tests():
    outside = {p.stem for folder in ("scripts", "tests") for p in (ROOT / folder).glob("*.py")}
    for name, path in modules().items():
        forbidden = outside | ({"controllers"} if name.startswith("coax_env") else set())
        for target in imported(path):
            assert target.split(".")[0] not in forbidden, f"{name} imports {target}"


def test_no_circle():
    """Of imports at the top of files; those inside functions may look back."""
    done: set[str] = set()

    def follow(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            for target in direct(name, False):
                follow(target, (*path, name))
            done.add(name)

    for name in modules():
        follow(name, ())


def test_importing_the_package_is_light():
    """Neither torch nor plotly nor control, and no kernel is compiled."""
    code = (
        "import coax_env, sys; heavy = {'torch', 'plotly', 'control', 'stable_baselines3', 'numba',"
        " 'scipy', 'matplotlib'} & set(sys.modules); assert not heavy, heavy"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


# --- README ---------------------------------------------------------------------------------------

UNNAMED = {"__init__.py", "py.typed", "__pycache__"}


def trees() -> dict[str, set[str]]:
    """Folder -> what README's tree says lies in it."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").partition("## The tree")[2]
    block = text.partition("\n\n")[2].partition("\n\n")[0]
    found: dict[str, set[str]] = {}
    folder = ""
    for line in block.splitlines():
        names = re.split(r" {2,}", line.strip())[0].split()
        if line.startswith("      "):
            found[folder].update(name.rstrip("/") for name in names)
        else:
            folder = names[0].rstrip("/")
            found[folder] = set()
    return found


def test_the_readmes_tree_is_the_real_one():
    written = trees()
    folders = {
        p.name for p in ROOT.iterdir() if p.is_dir() and p.name[0] != "." and p.name != "runs"
    }
    folders -= {name for name in folders if name.endswith((".egg-info", "build", "__pycache__"))}
    assert set(written) == folders
    real = {p.name for p in (ROOT / "coax_env").iterdir()} - UNNAMED
    assert written["coax_env"] == real, (
        f"not in README: {sorted(real - written['coax_env'])},"
        f" not there: {sorted(written['coax_env'] - real)}"
    )
