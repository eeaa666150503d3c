"""Which mutations are tried: so many of all there are, by seed, every part in its turn."""

import hashlib
import tomllib
from collections.abc import Sequence
from itertools import chain, zip_longest
from pathlib import Path

from mutation.sites import Mutation, sites

EQUIVALENT = Path(__file__).with_name("equivalent.toml")

PARTS: dict[str, tuple[str, ...]] = {
    "model": ("coax_env/dynamics.py", "coax_env/effects.py", "coax_env/turbulence.py",
              "coax_env/linear.py", "coax_env/vehicle.py"),
    "sensors": ("coax_env/sensors.py", "coax_env/actuators.py", "coax_env/period.py",
                "coax_env/fleet.py", "coax_env/hover.py", "coax_env/tasks.py"),
    "estimator": ("coax_env/engine/kalman.py", "coax_env/heli_model.py",
                  "controllers/estimator.py"),
    "regression": ("coax_env/engine/fit.py", "coax_env/engine/whiteness.py",
                   "coax_env/two_step/method.py", "coax_env/two_step/modes.py",
                   "coax_env/two_step/processing.py", "coax_env/two_step/reconstruction.py",
                   "coax_env/two_step/regression.py"),
}  # fmt: skip
"""Part -> its files; ``sensors`` has all that lies between the state and what a policy sees."""


def all_sites(root: Path) -> list[Mutation]:
    """Every mutation of the parts' files."""
    files = [file for files in PARTS.values() for file in files]
    return [m for file in files for m in sites(file, (root / file).read_text(encoding="utf-8"))]


def draw(found: Sequence[Mutation], count: int, seed: int) -> list[Mutation]:
    """`count` of them, the parts in turns; a change elsewhere in the code leaves the order alone."""

    def place(mutation: Mutation) -> bytes:
        return hashlib.sha256(f"{seed} {mutation.name}".encode()).digest()

    parts = [sorted((m for m in found if m.file in files), key=place) for files in PARTS.values()]
    turns = chain.from_iterable(zip_longest(*parts))
    return [m for m in turns if m is not None][:count]


def equivalents(path: Path = EQUIVALENT) -> dict[tuple[str, str, str], str]:
    """(file, line, broken line) -> why no test can tell the two apart."""
    rows = tomllib.loads(path.read_text(encoding="utf-8")).get("mutation", [])
    return {(row["file"], row["before"], row["after"]): row["reason"] for row in rows}
