"""Which mutations are tried: so many of all there are, by seed, every part in its turn."""

import hashlib
import tomllib
from collections.abc import Sequence
from fnmatch import fnmatchcase
from itertools import chain, zip_longest
from pathlib import Path

from mutation.sites import Mutation, sites

EQUIVALENT = Path(__file__).with_name("equivalent.toml")

PARTS: dict[str, tuple[str, ...]] = {
    "model": ("coax_env/model/*.py",),
    "env": ("coax_env/env/*.py", "coax_env/simulation/*.py"),
    "estimation": ("coax_env/estimation/*.py", "controllers/estimator*.py"),
    "identification": ("coax_env/identification/*.py",),
    "diagnosis": ("coax_env/diagnosis/*.py", "coax_env/comparison/two_logs/*.py"),
}
"""Part -> its files as patterns, whose * goes into folders too, so that a new file is in at once."""

LEFT_OUT = ("coax_env/env/rendering.py", "coax_env/env/scene.py")
"""Drawings: what they draw is looked at."""


def files_of(root: Path) -> dict[str, tuple[str, ...]]:
    """Part -> its files in a tree."""
    every = sorted(p.relative_to(root).as_posix() for p in root.glob("*/**/*.py"))
    return {part: tuple(file for file in every if part_of(file) == part) for part in PARTS}


def part_of(file: str) -> str | None:
    """The part that a file belongs to; None: it is not broken."""
    if file in LEFT_OUT:
        return None
    return next((part for part, patterns in PARTS.items() if matches(file, patterns)), None)


def matches(file: str, patterns: Sequence[str]) -> bool:
    """Whether a file fits one of the patterns."""
    return any(fnmatchcase(file, pattern) for pattern in patterns)


def all_sites(root: Path) -> list[Mutation]:
    """Every mutation of the parts' files."""
    files = [file for files in files_of(root).values() for file in files]
    return [m for file in files for m in sites(file, (root / file).read_text(encoding="utf-8"))]


def draw(found: Sequence[Mutation], count: int, seed: int) -> list[Mutation]:
    """So many of them, the parts in turns; a change elsewhere in the code leaves the order alone.

    Args:
        found: all there are. count: how many at most. seed: of their order within each part.
    """

    def place(mutation: Mutation) -> bytes:
        return hashlib.sha256(f"{seed} {mutation.name}".encode()).digest()

    parts = [sorted((m for m in found if part_of(m.file) == part), key=place) for part in PARTS]
    turns = chain.from_iterable(zip_longest(*parts))
    return [m for m in turns if m is not None][:count]


def equivalents(path: Path = EQUIVALENT) -> dict[tuple[str, str, str], str]:
    """(file, line, broken line) -> why no test can tell the two apart."""
    rows = tomllib.loads(path.read_text(encoding="utf-8")).get("mutation", [])
    return {(row["file"], row["before"], row["after"]): row["reason"] for row in rows}
