"""READMEs: what they print is printed, what they name is there, and the first one stays short."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from bundled_flight import what_it_hides
from causes import check_all_sure, check_causes

from coax_env.model.effects import CATALOGUE

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
ALL = sorted(
    p for p in ROOT.rglob("README.md") if not {"runs", ".venv"} & set(p.relative_to(ROOT).parts)
)
LONGEST = 200  # lines of the first README


def folded(text: str) -> str:
    """Without regard to how lines are wrapped and columns set."""
    return " ".join(text.split())


def test_the_first_readme_is_short():
    assert README.count("\n") < LONGEST


@pytest.mark.parametrize("path", ALL, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_and_scripts_are_there(path):
    text = path.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if "://" not in target:
            assert (path.parent / target).exists(), target
    for script in re.findall(r"scripts/[a-z_]+\.py", text):
        assert (ROOT / script).exists(), script
    for name in re.findall(r"`((?:coax_env|controllers|tests|scripts)/[a-z0-9_/.]+)`", text):
        assert (ROOT / name).exists(), name


def test_every_script_is_in_the_readme():
    shared = {
        "coax.py",
        "command_line.py",
        "demo.py",
    }  # the entry, what all share, scripts/demo's own
    for path in (ROOT / "scripts").glob("*.py"):
        assert path.name in shared or f"scripts/{path.name}" in README, path.name


def test_every_test_named_as_a_proof_is_there():
    text = (ROOT / "tests" / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"`(test_\w+\.py)::(\w+)`", text)
    assert len(named) > 50
    texts = {file: (ROOT / "tests" / file).read_text(encoding="utf-8") for file, _ in named}
    for file, name in named:
        assert f"\ndef {name}(" in texts[file], f"{file}::{name}"


BOTH = """
import coax_env
import coax_env.diagnosis.diagnose as room
diagnoses = {{}}
whole = room.diagnose
def once(flight, vehicle=None, **named):
    if isinstance(flight, str):
        flight = coax_env.read_flight(flight)
    vehicle = coax_env.load_vehicle(vehicle or flight.vehicle)
    asked = flight.run_names, flight.runs[0].command.tobytes(), vehicle.vector.tobytes()
    if not diagnoses:
        diagnoses[asked] = whole(flight, vehicle, **named)
    return diagnoses[asked]
room.diagnose = once
import demo
demo.main()
print({between!r})
exec({lines!r})
"""
BETWEEN = "--- the lines of Python"


@pytest.mark.slow(first=True)
def test_the_demo_and_the_lines_of_python_print_what_readme_says(tmp_path):
    """Word by word and number by number; [...] stands for what README leaves out.

    And what is found is what the bundled flight hides, four effects at once, each sure. Both diagnose
    that flight: the lines are given what the demo has found, if it is the same flight and vehicle.
    """
    block = README.partition("prints (the bundled flight")[2].partition("\n\n")[2]
    block = block.partition("\n\nand where")[0]
    lines, printed = ten_lines()
    done = subprocess.run(
        [sys.executable, "-c", BOTH.format(lines=lines, between=BETWEEN), "--no-real", "--out",
         str(tmp_path)],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=600,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "scripts"), *sys.path])},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-1500:]
    of_demo, _, of_lines = done.stdout.partition(BETWEEN)
    pattern = ".*?".join(re.escape(part) for part in folded(block).split("[...]"))
    assert re.search(pattern, folded(of_demo)), of_demo
    assert folded(of_lines) == printed
    findings = json.loads((tmp_path / "findings.json").read_text())
    check_causes(findings, *what_it_hides())
    check_all_sure(findings)


def ten_lines() -> tuple[str, str]:
    """README's lines of Python, and what it says they print."""
    found = re.search(r"```python\n(.*?)```\s+prints\s+(.*?)\n\n(?=\S)", README, re.DOTALL)
    assert found
    return found[1], folded(found[2])


def effects_table() -> str:
    """The catalogue as the model's README shows it."""
    rows = ["| effect | what it is | parameters, usual size | shows in |", "|---|---|---|---|"]
    for effect in CATALOGUE.values():
        sizes = ", ".join(
            f"{p.name} {p.usual:.3g}" + (f" {p.unit}" if p.unit != "1" else "")
            for p in effect.parameters
        )
        summary = (
            " ".join(effect.summary.split()).partition(". ")[0].rstrip(".").replace("|", "\\|")
        )
        rows.append(f"| `{effect.name}` | {summary} | {sizes} | {', '.join(effect.channels)} |")
    return "\n".join(rows) + "\n"


def test_the_models_readme_has_every_effect():
    assert (ROOT / "coax_env/model/README.md").read_text(encoding="utf-8").endswith(effects_table())
