"""Which mutations are tried: so many of all there are, by seed, every part in its turn."""

import hashlib
import tomllib
from collections.abc import Sequence
from itertools import chain, zip_longest
from pathlib import Path

from mutation.sites import Mutation, sites

EQUIVALENT = Path(__file__).with_name("equivalent.toml")

_MODEL = "coax_env/model/"
_ENV = "coax_env/env/"
_ESTIMATION = "coax_env/estimation/"
_TWO_STEP = "coax_env/identification/two_step/"
_DIAGNOSIS = "coax_env/diagnosis/"
PARTS: dict[str, tuple[str, ...]] = {
    "model": (f"{_MODEL}dynamics.py", f"{_MODEL}effects.py", f"{_ENV}turbulence.py",
              f"{_MODEL}linear.py", f"{_MODEL}vehicle.py"),
    "sensors": (f"{_MODEL}sensors.py", f"{_MODEL}sampling.py", f"{_MODEL}actuators.py",
                f"{_ENV}period.py", f"{_ENV}flight_loop.py", f"{_ENV}fleet.py", f"{_ENV}hover.py",
                f"{_ENV}tasks.py"),
    "estimator": (f"{_ESTIMATION}kalman.py", f"{_ESTIMATION}helicopter.py",
                  "controllers/estimator.py"),
    "regression": (f"{_ESTIMATION}fit.py", f"{_ESTIMATION}whiteness.py", f"{_TWO_STEP}method.py",
                   f"{_TWO_STEP}columns.py", f"{_TWO_STEP}loads.py",
                   f"{_TWO_STEP}modes.py", f"{_TWO_STEP}processing.py",
                   f"{_TWO_STEP}reconstruction.py", f"{_TWO_STEP}regression.py"),
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
