"""The mutation run on a toy tree: what is caught, what is not, and what is not tried twice."""

import ast
import json
import sys
from functools import cache
from pathlib import Path

import mutate
import pytest
from mutation import draw, score, trial
from mutation.sites import sites

from coax_env.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
TOY = '''import math

SCALE = 3.0  # no function's


def force(x, u, tilt: float = 2.0):
    """A sine - and not a cosine."""
    # a remark with a - in it
    pull = (x[0]  # - the first
            - u[1])
    if pull < 1e-9:
        raise ValueError("no" + " pull")
    pull *= 2.0
    return -pull * math.sin(tilt) + x[0] / 4.0
'''


@cache
def all_sites() -> tuple:
    """Of the code."""
    return tuple(draw.all_sites(ROOT))


def broken(kind: str) -> set[str]:
    return {m.after for m in sites("toy.py", TOY) if m.kind == kind}


def test_every_kind_of_site_is_found():
    assert broken("sign") == {
        "+ u[1])",
        "return -pull * math.sin(tilt) - x[0] / 4.0",
        "return pull * math.sin(tilt) + x[0] / 4.0",
    }
    assert broken("term") == {"pull = (x[0] # - the first)", "return -pull * math.sin(tilt)"}
    assert broken("product") == {
        "pull /= 2.0",
        "return -pull / math.sin(tilt) + x[0] / 4.0",
        "return -pull * math.sin(tilt) + x[0] * 4.0",
    }
    assert broken("comparison") == {"if pull >= 1e-9:"}
    assert broken("function") == {"return -pull * math.cos(tilt) + x[0] / 4.0"}
    assert broken("constant") == {"pull *= 4.0", "return -pull * math.sin(tilt) + x[0] / 8.0"}
    assert len(broken("index")) == 3


def test_axes_are_swapped_by_name():
    text = "def f(w):\n    w[F.FORCE_X] = w[F.MASS] * w[F.SIN_PHI]\n"
    after = {m.after for m in sites("toy.py", text) if m.kind == "index"}
    assert after == {
        "w[F.FORCE_Y] = w[F.MASS] * w[F.SIN_PHI]", "w[F.FORCE_X] = w[F.MASS] * w[F.SIN_THETA]",
    }  # fmt: skip


@pytest.mark.slow
def test_every_mutation_of_the_code_is_another_program_with_a_name_of_its_own():
    found = all_sites()
    assert len({m.name for m in found}) == len(found) > 2000
    for file in {m.file for m in found}:
        assert any((ROOT / name).exists() for name in trial.own_tests(file)), file
    for mutation in draw.draw(found, 60, seed=0):
        text = (ROOT / mutation.file).read_text(encoding="utf-8")
        changed = mutation.applied(text)
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(text)), mutation


@pytest.mark.slow
def test_a_draw_takes_every_part_in_turn_and_does_not_depend_on_other_code():
    found = all_sites()
    drawn = draw.draw(found, 60, seed=3)
    for part in draw.PARTS:
        assert sum(draw.part_of(m.file) == part for m in drawn) == 60 / len(draw.PARTS)
    assert draw.draw(found, 20, seed=3) == drawn[:20]
    assert draw.draw(found, 60, seed=4) != drawn
    without = [m for m in found if m.file != "coax_env/model/sensors.py"]
    kept, again = (
        [m for m in some if draw.part_of(m.file) == "diagnosis"]
        for some in (drawn, draw.draw(without, 60, seed=3))
    )
    assert kept and again == kept


@pytest.mark.slow
def test_every_file_with_numbers_of_its_own_can_be_broken():
    """The rooms that compute, and whatever is compiled but the kernel, which has no equations."""
    files = draw.files_of(ROOT)
    broken = {file for some in files.values() for file in some}
    rooms = ("model", "env", "simulation", "estimation", "identification", "diagnosis")
    for path in [*(ROOT / "coax_env").rglob("*.py"), *(ROOT / "controllers").rglob("*.py")]:
        file = path.relative_to(ROOT).as_posix()
        text = path.read_text(encoding="utf-8")
        counts = file.split("/")[1] in rooms or "\n@compiled" in text or "\n@pointer" in text
        if counts and not file.startswith("coax_env/kernel/") and file not in draw.LEFT_OUT:
            assert file in broken, file
    assert all((ROOT / file).exists() for file in draw.LEFT_OUT)


@pytest.mark.slow
def test_every_pattern_fits_a_file():
    broken = [file for some in draw.files_of(ROOT).values() for file in some]
    for pattern in (*trial.WHOLE_FLIGHTS, *(p for some in draw.PARTS.values() for p in some)):
        assert any(draw.matches(file, [pattern]) for file in broken), pattern
    left = set(broken)
    for pattern in trial.OWN:  # in their order: what an earlier one takes is gone
        taken = {file for file in left if draw.matches(file, [pattern])}
        assert taken, pattern
        left -= taken
    assert not left, f"without tests of their own: {sorted(left)}"


@pytest.mark.slow
def test_equivalent_mutations_are_mutations_and_have_a_reason():
    found = {(m.file, m.before, m.after) for m in all_sites()}
    for change, reason in draw.equivalents().items():
        assert change in found, change
        assert len(reason) > 20, change


def test_tests_that_belong_to_a_file_exist():
    for names in (*trial.OWN.values(), trial.APART):
        for name in names:
            assert (ROOT / name).exists(), name


# --- a run on a toy ---------------------------------------------------------------------------------

MODULE = """def area(width, height):
    return width * height + 0.0 * width
"""
TEST = """import sys
sys.path.insert(0, ".")
from coax_env.toy import area

def test_area():
    assert area(2.0, 3.0) == 6.0
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A tree of one module and one test, and a call of the script on it."""
    root = tmp_path / "root"
    for name, text in (
        ("coax_env/__init__.py", ""), ("coax_env/toy.py", MODULE), ("tests/test_toy.py", TEST),
        ("pyproject.toml", '[tool.pytest.ini_options]\nmarkers = ["slow: no"]\n'),
    ):  # fmt: skip
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    monkeypatch.setattr(draw, "PARTS", {"model": ("coax_env/toy.py",)})
    monkeypatch.setattr(score, "PARTS", draw.PARTS)
    monkeypatch.setattr(trial, "OWN", {"coax_env/*": ("tests/test_toy.py",)})
    monkeypatch.setattr(trial, "WHOLE_FLIGHTS", ("coax_env/*",))

    def call(*words: str) -> dict:
        out = tmp_path / "out"
        own = [] if "--rest" in words else ["--own"]
        monkeypatch.setattr(
            sys, "argv", ["mutate.py", "--root", str(root), "--out", str(out), *own]
        )
        try:
            mutate.main()
        except SystemExit as end:
            assert end.code == 1
        return json.loads((out / "score.json").read_text())

    return root, call


@pytest.mark.slow
def test_what_the_tests_ask_for_is_caught_and_the_rest_is_not(toy):
    root, call = toy
    result = call()
    rows = {row["after"]: row["caught"] for row in result["rows"]}
    assert rows == {
        "return width / height + 0.0 * width": True,
        "return width * height - 0.0 * width": False,
        "return width * height": False,
        "return width * height + 0.0 / width": False,
    }
    assert result["score"] == pytest.approx(0.25)
    assert (root / "coax_env/toy.py").read_text() == MODULE, "the tree itself is never broken"
    caught = next(row for row in result["rows"] if row["caught"])
    assert caught["by"] == "tests/test_toy.py::test_area"


@pytest.mark.slow
def test_a_run_goes_on_where_it_stopped(toy, monkeypatch):
    root, call = toy
    tried, most = [], [2]
    keep = trial.Tree.try_out

    def interrupted(self, mutation, rest):
        if len(tried) == most[0]:
            raise KeyboardInterrupt
        tried.append(mutation.after)
        return keep(self, mutation, rest)

    monkeypatch.setattr(trial.Tree, "try_out", interrupted)
    with pytest.raises(KeyboardInterrupt):
        call()
    done, most[0] = list(tried), 4
    tried.clear()
    assert len(call()["rows"]) == 4
    assert not set(done) & set(tried) and len(tried) == 2
    tried.clear()
    call()
    assert not tried, "nothing has changed"
    (root / "tests/test_toy.py").write_text(TEST + "    assert area(0.0, 1.0) == 0.0\n")
    tried.clear()
    rows = call()["rows"]
    assert len(tried) == 3, "what survived is tried again with better tests, what was caught is not"
    assert sum(row["caught"] for row in rows) == 2


@pytest.mark.slow
def test_the_rest_of_the_tests_catch_what_the_own_do_not(toy):
    """And what survived the own ones alone is tried again with the rest."""
    root, call = toy
    (root / "tests/test_zero.py").write_text(
        TEST.replace("area(2.0, 3.0) == 6.0", "area(0.0, 2.0) == 0.0")
    )
    assert sum(row["caught"] for row in call()["rows"]) == 1
    rows = call("--rest")["rows"]
    assert {row["by"] for row in rows if row["caught"]} == {
        "tests/test_toy.py::test_area", "tests/test_zero.py::test_area",
    }  # fmt: skip


@pytest.mark.slow
def test_where_whole_flights_judge_the_slow_tests_of_a_file_count(toy):
    root, call = toy
    slow = "\n@pytest.mark.slow\ndef test_zero():\n    assert area(0.0, 2.0) == 0.0\n"
    (root / "tests/test_toy.py").write_text("import pytest\n" + TEST + slow)
    rows = call()["rows"]
    assert {row["by"] for row in rows if row["caught"]} == {
        "tests/test_toy.py::test_area", "tests/test_toy.py::test_zero",
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("mark", "caught"), [("", True), ("@pytest.mark.slow\n", False)])
def test_quick_tests_without_end_are_a_catch_and_slow_ones_are_none(
    toy, tmp_path, monkeypatch, mark, caught
):
    root, _ = toy
    endless = f"import pytest, time\n\n{mark}def test_endless():\n    time.sleep(60)\n"
    (root / "tests/test_toy.py").write_text(endless)
    monkeypatch.setattr(trial, "LIMIT", 6.0)  # an interpreter starts in less
    (mutation, *_) = draw.all_sites(root)
    assert trial.Tree(root, tmp_path / "job").try_out(mutation, rest=False)["caught"] == caught


def test_a_tree_whose_tests_fail_as_it_is_has_no_score(toy):
    root, call = toy
    (root / "tests/test_toy.py").write_text(TEST.replace("6.0", "7.0"))
    with pytest.raises(InputError, match="before anything is broken"):
        call()
