"""Errors a user can correct: one clear line that names the file, line, field or package."""

import importlib
import re
from importlib import metadata
from types import ModuleType

DISTRIBUTION = "coaxheli"
"""Name under which this project is installed; `coax` is another one on PyPI."""
LONGEST = 900
"""Characters of a message; a longer one loses its middle."""


class InputError(ValueError):
    """Bad input. The message is one line; scripts print it and exit with code 2."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class MissingPackage(InputError):
    """An optional package is not installed. The message says what to install."""


def one_line(text: str) -> str:
    """Text that quotes a file, whatever was in it, as one printable line."""
    line = " ".join(text.split())
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    if len(line) > LONGEST:
        line = f"{line[: LONGEST - 200]} ... {line[-190:]}"
    return line


def shown(value: object) -> str:
    """A value from somebody's file as a message quotes it."""
    try:
        text = repr(value)
    except ValueError:  # an integer too long to be written
        text = f"a {type(value).__name__}"
    return text if len(text) <= 100 else text[:100] + "..."


def require(module: str, extra: str) -> ModuleType:
    """Import an optional package, or say in one line what to install.

    Args:
        module: name to import, for instance ``"plotly.graph_objects"``.
        extra: the extra of this project that brings it, for instance ``"report"``.

    Raises:
        MissingPackage: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise MissingPackage(
            f"this needs {package}, which is not installed:"
            f" pip install '{DISTRIBUTION}[{extra}]'{_packages_of(extra)}"
        ) from error


def _packages_of(extra: str) -> str:
    """What an extra consists of, for whoever would rather install that; empty where not known."""
    try:
        declared = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:  # a checkout that is on the path, not installed
        return ""
    wanted = re.compile(rf"""(.+?)\s*;\s*extra == ["']{re.escape(extra)}["']""")
    packages = [match[1] for text in declared if (match := wanted.fullmatch(text))]
    words = " ".join(f"'{package}'" for package in packages)
    return f", or what it consists of: pip install {words}" if packages else ""
