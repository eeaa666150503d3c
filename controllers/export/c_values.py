"""Numbers as C99 writes them: floats, and arrays of them by name."""

from collections.abc import Mapping, Sequence

import numpy as np

Fields = Mapping[str, np.ndarray]


def literal(value: float) -> str:
    """A float32 with all its digits, such as ``0.1f``."""
    if not np.isfinite(value):
        raise ValueError(f"no finite number: {value}")
    text = f"{np.float32(value):.9g}"
    return text + ("f" if "." in text or "e" in text else ".0f")


def braces(array: np.ndarray) -> str:
    """An array's numbers in nested braces, row by row."""
    array = np.asarray(array)
    if array.ndim == 1:
        write = str if array.dtype.kind in "iu" else literal
        return "{" + ", ".join(write(value) for value in array.tolist()) + "}"
    return "{" + ",\n ".join(braces(row) for row in array) + "}"


def constant(name: str, array: np.ndarray) -> str:
    """A constant array of ints or floats; one that is empty gets a row that nobody reads."""
    array = np.asarray(array)
    if not len(array):
        array = np.zeros((1, *array.shape[1:]), dtype=array.dtype)
    kind = "int" if array.dtype.kind in "iu" else "float"
    return f"static const {kind} {name}{_extent(array)} = {braces(array)};"


def structure(name: str, fields: Fields) -> str:
    """A struct type whose members are float arrays."""
    members = "\n".join(f"    float {key}{_extent(array)};" for key, array in fields.items())
    return f"typedef struct {{\n{members}\n}} {name};"


def structures(kind: str, name: str, rows: Sequence[Fields]) -> str:
    """A constant array of such structs.

    Args:
        kind: name of the struct. name: of the array. rows: a struct's fields each.
    """
    body = ",\n".join(
        "{\n" + ",\n".join(f".{key} = {braces(array)}" for key, array in row.items()) + "}"
        for row in rows
    )
    return f"static const {kind} {name}[{len(rows)}] = {{\n{body}\n}};"


def macro(name: str, value: int | float) -> str:
    """A constant by name."""
    text = str(value) if isinstance(value, int | np.integer) else literal(value)
    return f"#define {name} {'(' + text + ')' if text.startswith('-') else text}"


def _extent(array: np.ndarray) -> str:
    return "".join(f"[{size}]" for size in np.shape(array))
