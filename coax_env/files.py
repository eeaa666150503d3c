"""Writing files so that a reader never sees half of one, and reading those that a user wrote."""

import json
import os
import shutil
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from coax_env.errors import InputError


def read_bytes(path: str | Path) -> bytes:
    """A file's content, or in one line why it cannot be read."""
    try:
        path = Path(path)
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise InputError(f"cannot read {path}: not a file but a device or a pipe")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:  # InputError is one
        raise InputError(
            str(error) if isinstance(error, InputError) else f"cannot read {path!s:.200}: {error}"
        ) from error


def read_text(path: str | Path) -> str:
    """A text file, with or without a byte order mark, or in one line why it is none."""
    content = read_bytes(path)
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{path}: UTF-16 text, not UTF-8: save it as UTF-8")
    if b"\0" in content:
        raise InputError(f"{path}: binary, not text")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: not UTF-8 text (byte {error.start}): save it as UTF-8"
        ) from error


def read_toml(path: str | Path) -> dict[str, Any]:
    """A TOML file as a table, or in one line why it is none."""
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also of what tomllib does not foresee
        raise InputError(f"{path}: not valid TOML: {error}") from error


def write_bytes(path: str | Path, content: bytes) -> Path:
    """Write a file whole or not at all; missing folders are made."""
    path = Path(path)
    make_folder(path.parent)
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    finally:
        Path(temporary).unlink(missing_ok=True)
    return path


def write_text(path: str | Path, text: str) -> Path:
    """Write a text file in UTF-8, as `write_bytes`."""
    return write_bytes(path, text.encode("utf-8"))


def write_json(path: str | Path, content: Any) -> Path:
    """Write JSON that any reader understands: NaN and infinity are refused (``ValueError``)."""
    return write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def make_folder(path: str | Path) -> Path:
    """Make a folder and those above it, or say in one line why it cannot be."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {path}: {error.strerror}") from error
    return path


@contextmanager
def staged_folder(path: str | Path) -> Iterator[Path]:
    """A temporary folder that becomes ``path`` when the block ends well, and vanishes otherwise.

    Where ``path`` is already a folder, the new files join it one by one, each replacing its
    namesake; what else lies there is left alone.
    """
    path = Path(path)
    make_folder(path.parent)
    if path.exists() and not path.is_dir():
        raise InputError(f"cannot write the folder {path}: a file has that name")
    try:
        stage = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise InputError(f"cannot write in {path.parent}: {error.strerror}") from error
    try:
        yield stage
        _take_over(stage, path)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _take_over(stage: Path, path: Path) -> None:
    """Give the stage the folder's name, or its files to the folder that is there."""
    try:
        stage.chmod(0o777 & ~_umask())
        if path.is_dir():
            for file in sorted(stage.iterdir()):
                os.replace(file, path / file.name)
        else:
            os.rename(stage, path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
