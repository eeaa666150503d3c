"""Many flights diagnosed at once: which, under what names, and one bad one among them."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from numpy.testing import assert_allclose

from coax_env.errors import InputError


@pytest.fixture
def diagnose_script():
    sys.modules.pop("diagnose", None)
    import diagnose

    return diagnose


def flight(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "card.toml").write_text("")
    return folder


def test_folders_of_folders_are_flights(tmp_path, diagnose_script):
    a, b = flight(tmp_path / "may" / "first"), flight(tmp_path / "june" / "first")
    c = flight(tmp_path / "alone")
    assert diagnose_script.flights_in([tmp_path / "may", c, b, c]) == [a, c, b]
    assert diagnose_script.flights_in([tmp_path]) == sorted([a, b, c])
    assert diagnose_script.flights_in([tmp_path / "none"]) == [tmp_path / "none"]
    assert diagnose_script.folder_names([a, b, c]) == ["may_first", "june_first", "alone"]


def test_a_bad_flight_does_not_stop_the_others(tmp_path, monkeypatch, diagnose_script, capsys):
    """Each has its row, and what it found is counted; the exit code tells of the bad one."""
    good = [flight(tmp_path / name) for name in ("one", "two", "four")]
    bad = flight(tmp_path / "three")

    causes = [{"effect": "wind", "trust": "sure"}, {"effect": "wind_2", "trust": "doubtful"}]
    gain = {"error_removed_percent": 50.0}
    findings = {"verdict": "explained", "causes": causes, "gain": gain}

    def diagnosed(folder, options, out, report_progress):
        if folder == bad:
            raise InputError("no rows <in> it")
        if folder == good[2]:
            raise ZeroDivisionError("of its own")
        return SimpleNamespace(findings=findings), "report"

    monkeypatch.setattr(diagnose_script, "diagnosed", diagnosed)
    out = tmp_path / "out"
    monkeypatch.setattr(
        sys, "argv", ["diagnose", *map(str, [*good, bad]), "--out", str(out), "--jobs", "1"]
    )
    with pytest.raises(InputError, match=r"of its own; so 1 more"):
        diagnose_script.main()
    rows = json.loads((out / "summary.json").read_text())["flights"]
    assert [row["flight"] for row in rows] == [str(f) for f in [*good, bad]]
    assert [bool(row["error"]) for row in rows] == [False, False, True, True]
    assert rows[0]["sure"] == ["wind"] and rows[0]["doubtful"] == ["wind_2"]
    assert_allclose([row["removed"] for row in rows[:2]], 50.0)
    page = (out / "summary.html").read_text()
    assert 'href="one/report.html"' in page and "no rows &lt;in&gt; it" in page
    printed = capsys.readouterr().out
    assert "wind_2" in printed and printed.count("explained") == 2


def test_runs_of_one_flight_are_not_those_of_another(tmp_path, monkeypatch, diagnose_script):
    folders = [str(flight(tmp_path / name)) for name in ("one", "two")]
    monkeypatch.setattr(sys, "argv", ["diagnose", *folders, "--hold-out", "hover"])
    with pytest.raises(InputError, match="one flight only"):
        diagnose_script.main()
