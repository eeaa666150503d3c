"""The flight that the package brings along, or some of its runs, as a folder to be changed."""

import json
import shutil
from functools import cache
from pathlib import Path

import coax_env
from coax_env.logs.flight import Flight, read_flight

BUNDLED = Path(coax_env.__file__).parent / "logs" / "flights" / "windy"


@cache
def bundled() -> Flight:
    """As read: once, for all tests of a process."""
    return read_flight(BUNDLED)


def what_it_hides() -> tuple[list[str], dict[str, float]]:
    """Names of its effects, and every number of theirs by the catalogue's names."""
    planted = json.loads((BUNDLED / "truth.json").read_text())
    values = planted["values"]
    gyro = dict(zip("xyz", values["gyro_bias"], strict=True))
    return planted["hidden"], {
        "rotor_drag.coefficient": values["kdrag"],
        "wind.north": values["wn"], "wind.east": values["we"],
        "motor_lag.upper": values["motor_tau"], "motor_lag.lower": values["motor_tau"],
        **{f"gyro_bias.{axis}": bias for axis, bias in gyro.items()},
    }  # fmt: skip


def copied(folder: Path, *runs: str, sound: Path = BUNDLED) -> Path:
    """A copy of a flight whose card names these runs alone, or all; to read few is quicker."""
    shutil.copytree(sound, folder)
    card = folder / "card.toml"
    head, *each = card.read_text().split("[[run]]")
    asked = [run for run in each if not runs or any(f'"{name}"' in run for name in runs)]
    card.write_text("[[run]]".join([head, *asked]))
    return folder
