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

FLOORS = (
    "errors plain_words",
    "files progress workers",
    "kernel",
    "model",
    "env logs",
    "simulation consistency",
    "estimation",
    "design",
    "identification diagnosis",
    "comparison inspection",
    "report",
)
"""Rooms of coax_env from the ground up: a room may import from the floors below it, and from itself.

Rooms on one floor are siblings: neither imports the other.
"""
FLOOR = {room: level for level, rooms in enumerate(FLOORS) for room in rooms.split()}


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def modules() -> dict[str, Path]:
    return {module_name(p): p for package in PACKAGES for p in (ROOT / package).rglob("*.py")}


@cache
def imported(path: Path) -> set[str]:
    """Names that a file imports: also inside functions, and for type checkers only."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(a.name for a in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: import by full names"
            found.update(f"{node.module}.{a.name}" for a in node.names)
    return found


@cache
def direct(name: str) -> frozenset[str]:
    """Modules of the project that one imports."""
    result = set()
    for target in imported(modules()[name]):
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


def room(name: str) -> str:
    """The room of a module of coax_env; the front door and the controllers are none."""
    parts = name.split(".")
    return parts[1] if parts[0] == "coax_env" and len(parts) > 1 else ""


def test_every_room_is_on_a_floor():
    assert {room(name) for name in modules()} - {""} == set(FLOOR)


def test_imports_point_down():
    for name in modules():
        for target in direct(name):
            here, there = room(name), room(target)
            if here and there and here != there:
                assert FLOOR[there] < FLOOR[here], f"{name} imports {target}"


def test_flights_are_read_without_a_model():
    """Names and units of the channels are all that the reader knows of the helicopter."""
    for name in modules():
        if room(name) == "logs":
            for target in reached(name):
                assert room(target) != "model" or target == "coax_env.model.layout", (
                    f"{name} reaches {target}"
                )


ENGINE = (
    "compiled_model engine filter_arrays frozen_gains kalman linearised_runs noise_levels noise_score"
    " pass_data quadratic run_passes sparse state_space transition whiteness"
)


@pytest.mark.parametrize("name", ENGINE.split())
def test_the_engine_knows_no_helicopter(name):
    for target in reached(f"coax_env.estimation.{name}"):
        assert room(target) in ("estimation", "kernel", "progress"), f"{name} reaches {target}"


def test_the_package_knows_neither_controllers_nor_scripts_nor_tests():
    outside = {p.stem for folder in ("scripts", "tests") for p in (ROOT / folder).glob("*.py")}
    for name, path in modules().items():
        forbidden = outside | ({"controllers"} if name.startswith("coax_env") else set())
        for target in imported(path):
            assert target.split(".")[0] not in forbidden, f"{name} imports {target}"


def test_no_circle():
    """Of any imports, inside functions and in annotations too."""
    done: set[str] = set()

    def follow(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            for target in direct(name):
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


# --- docstrings -------------------------------------------------------------------------------------


def public_functions(path: Path) -> list[ast.FunctionDef]:
    """A file's functions and methods whose name says that others may call them."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name[0] != "_"]
    bodies = [tree.body, *(node.body for node in classes)]
    found = [node for body in bodies for node in body if isinstance(node, ast.FunctionDef)]
    return [node for node in found if node.name[0] != "_"]


def test_public_functions_say_what_their_arguments_are():
    """From three on; not effects, whose arguments are all the same, nor what a base class describes."""
    silent = []
    for name, path in modules().items():
        for node in public_functions(path):
            arguments = [a.arg for a in (*node.args.args, *node.args.kwonlyargs)]
            text = ast.get_docstring(node) or ""
            marks = " ".join(ast.unparse(mark) for mark in node.decorator_list)
            if (
                len({*arguments} - {"self", "cls"}) >= 3
                and not re.search(r"Args:|arguments as", text)
                and not re.search(r"effect\(|overload", marks)
                and not text.startswith("As ")
            ):
                silent.append(f"{name}.{node.name}")
    assert not silent
