"""Writing files whole, and the exit codes of the scripts."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from coax_env.errors import InputError
from coax_env.files import staged_folder, write_json, write_text

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    target = write_text(tmp_path / "new" / "a.txt", "first\n")
    assert target.read_text() == "first\n"
    with pytest.raises(ValueError):
        write_json(target, {"x": float("nan")})
    with pytest.raises(UnicodeEncodeError):
        write_text(target, "\ud800")
    assert target.read_text() == "first\n"
    assert [p.name for p in target.parent.iterdir()] == ["a.txt"]


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot make the folder"):
        write_text(tmp_path / "file" / "a.txt", "")
    with pytest.raises(InputError, match="a file has that name"), staged_folder(tmp_path / "file"):
        pass
    with pytest.raises(InputError, match="cannot write"):
        write_text(tmp_path, "")


def test_a_staged_folder_vanishes_on_failure(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), staged_folder(tmp_path / "out") as stage:
        (stage / "half").write_text("")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("body", "code", "stderr"),
    [
        ("pass", 0, ""),
        ("raise InputError('no such\\nthing')", 2, "error: no such thing\n"),
        ("raise KeyboardInterrupt", 130, "interrupted\n"),
        ("1 / 0", 1, None),
        ("parser('x', '').parse_args(['--bad'])", 2, None),
    ],
)
def test_exit_codes(body: str, code: int, stderr: str | None) -> None:
    program = f"""
from command_line import parser, run
from coax_env.errors import InputError
def main():
    {body}
run(main)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=SCRIPTS, capture_output=True, text=True, check=False
    )
    assert done.returncode == code
    if stderr is not None:
        assert done.stderr == stderr
    if code == 2:
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("name", sorted(p.stem for p in SCRIPTS.glob("*.py")))
def test_every_report_is_written_after_the_results(name: str) -> None:
    """By command_line.write_report, which says what to install where a page cannot be made."""
    text = (SCRIPTS / f"{name}.py").read_text()
    assert not re.search(r"write_text\([^)]*\.html", text), "not by command_line.write_report"
