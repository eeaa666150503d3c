"""The form of a flight: one text in docstring, README and --form; its signs are the model's."""

import inspect
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

import coax_env
from coax_env.logs import flight
from coax_env.logs.card import CARD, read_card
from coax_env.logs.units import LOG_UNITS
from coax_env.model.dynamics import derivative, hover_trim
from coax_env.model.layout import ATTITUDE, RATE, VELOCITY
from coax_env.model.vehicle_file import load_vehicle

LOGS = Path(coax_env.__file__).parent / "logs"
README = (LOGS / "README.md").read_text()
FORM = inspect.cleandoc(flight.__doc__ or "")


def docstring_rows() -> list[tuple[str, str, str]]:
    """Columns, unit and meaning of each row."""
    table = re.split(r"=+ =+ =+\n", FORM)[2]
    units = "|".join(sorted(set(LOG_UNITS.values()), key=len, reverse=True))
    rows = [re.match(rf"(.+?) +({units}) +(.+)", line.strip()) for line in table.splitlines()]
    return [row.groups() for row in rows if row]  # type: ignore[misc]


def test_the_table_has_every_column_and_its_unit():
    rows = docstring_rows()
    found = {name: unit for names, unit, _ in rows for name in names.split(", ")}
    assert found == LOG_UNITS


def test_readme_has_the_same_table_and_card(tmp_path):
    rows = [
        "| {} | {} | {} |".format(", ".join(f"`{n}`" for n in names.split(", ")), unit, words)
        for names, unit, words in docstring_rows()
    ]
    assert "\n".join(rows) in README
    card = inspect.cleandoc(FORM.partition("::\n")[2].partition("Bad input")[0])
    assert re.findall(r"```toml\n(.*?)```", README, re.DOTALL)[0].strip() == card
    (tmp_path / CARD).write_text(card)
    assert read_card(tmp_path / CARD).runs[0].name == "hover"


def test_the_script_prints_it(monkeypatch, capsys):
    import check_flight

    monkeypatch.setattr("sys.argv", ["check_flight.py", "--form"])
    check_flight.main()
    assert capsys.readouterr().out.strip() == FORM
    monkeypatch.setattr("sys.argv", ["check_flight.py"])
    with pytest.raises(SystemExit, match="2"):
        check_flight.main()
    assert "which flight folder?" in capsys.readouterr().err


def test_the_picture_is_there_with_every_sign():
    words = " ".join(ET.parse(LOGS.parents[1] / ".github" / "signs.svg").getroot().itertext())
    for name in (
        "x forward",
        "y right",
        "z down",
        "p >",
        "q >",
        "r >",
        "phi >",
        "theta >",
        "psi >",
    ):
        assert name in words, name
    assert "](../../.github/signs.svg)" in README


MOVES = {  # command, and its change -> rate and angle that follow, and their sign
    "upper rotor faster": (0, 5.0, 2, 1.0),
    "lower rotor faster": (1, 5.0, 2, -1.0),
    "delta_lon": (2, 0.02, 1, 1.0),
    "delta_lat": (3, 0.02, 0, 1.0),
}


@pytest.mark.parametrize("move", MOVES)
def test_the_model_turns_as_the_picture_says(move):
    """Flown for a fifth of a second from hover."""
    column, change, axis, sign = MOVES[move]
    lama = load_vehicle("lama400d")
    state, command = hover_trim(lama)
    command[column] += change
    for _ in range(100):
        state = state + 0.002 * derivative(state, command, lama)
    assert sign * state[RATE][axis] > 1e-3 and sign * state[ATTITUDE][axis] > 0.0
    if column == 2:
        assert state[VELOCITY][0] < 0.0, "thrust back"
    if column == 3:
        assert state[VELOCITY][1] > 0.0, "thrust to the right"
