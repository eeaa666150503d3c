"""Logs that are one table - MATLAB's .mat, Parquet, CSV - as a flight folder: the columns as they
are, and a card.

Nothing is read by a guess: the drafted card says what each column seems to be, and check_flight
asks the log itself.
"""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError, require
from coax_env.files import read_bytes, staged_folder, write_bytes, write_text
from coax_env.logs.card import CARD
from coax_env.logs.columns import Guess, draft_text, header_of

MOST_COLUMNS = 400
"""Columns of a table; what has more is none of signals."""
MOST_SIDE = 32
"""Columns of a matrix that are taken apart."""


def is_table(path: Path) -> bool:
    """Whether a log is one table, by how its name ends."""
    return path.suffix.lower() in (".mat", ".parquet", ".pq", ".csv", ".tsv", ".txt")


def import_table(path: Path, vehicle: str, folder: Path) -> list[Guess]:
    """Write a flight folder of one run: the table as a CSV, and a drafted card.

    Args:
        path: .mat, .parquet, .csv, .tsv or .txt.
        vehicle: shipped name or file.
        folder: to write; all of it or nothing.

    Returns:
        the guesses in the card, which somebody must look at.

    Raises:
        InputError: it cannot be read, or holds no table.
    """
    name = f"{path.stem}.csv"
    if path.suffix.lower() in (".csv", ".tsv", ".txt"):
        content = read_bytes(path)
        header = header_of(content.decode("utf-8-sig", "replace"))[0]
        if not header:
            raise InputError(f"{path}: no row of names in it")
    else:
        columns = mat_columns(path) if path.suffix.lower() == ".mat" else parquet_columns(path)
        header, content = list(columns), _csv(columns)
    card, guessed = draft_text(vehicle, {name: header})
    with staged_folder(folder) as stage:
        write_bytes(stage / name, content)
        write_text(stage / CARD, card)
    return guessed


def _csv(columns: Mapping[str, np.ndarray]) -> bytes:
    texts = [["" if x != x else repr(x) for x in values.tolist()] for values in columns.values()]
    names = (name.replace('"', "'") for name in columns)
    lines = [",".join(f'"{n}"' if {",", ";"} & {*n} else n for n in names)]
    lines += [",".join(cells) for cells in zip(*texts, strict=True)]
    return ("\n".join(lines) + "\n").encode()


# --- MATLAB ---------------------------------------------------------------------------------------


def mat_columns(path: Path) -> dict[str, np.ndarray]:
    """Variables of a .mat as columns of one length: vectors, columns of matrices, fields of structs.

    Of several lengths the one of the variable that may be time, else the most frequent; the others
    are left out.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(path, simplify_cells=True)
    except NotImplementedError:
        raise InputError(
            f"{path}: a MATLAB file of version 7.3 (HDF5); save it with -v7: save('log.mat', '-v7')"
        ) from None
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    except (MatReadError, ValueError, TypeError, IndexError, KeyError, EOFError) as error:
        raise InputError(f"{path}: not a MATLAB file that SciPy can read ({error})") from None
    except Exception as error:  # SciPy raises whatever it stumbles over
        raise InputError(f"{path}: not a MATLAB file that SciPy can read ({error})") from None
    found: dict[str, np.ndarray] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _take_apart(name, value, found)
    return _of_one_length(path, found)


def _take_apart(name: str, value: Any, found: dict[str, np.ndarray]) -> None:
    """Columns of whatever a variable holds."""
    if isinstance(value, dict):
        for key, content in value.items():
            _take_apart(f"{name}.{key}", content, found)
        return
    array = np.asarray(value)
    if array.dtype.kind not in "fiub" or array.ndim not in (1, 2) or array.size < 2:
        return
    if array.ndim == 1:
        found[name] = array.astype(float)
        return
    tall = array if array.shape[0] >= array.shape[1] else array.T
    if tall.shape[1] > MOST_SIDE:
        return
    for k in range(tall.shape[1]):
        found[name if tall.shape[1] == 1 else f"{name}_{k + 1}"] = tall[:, k].astype(float)


def _of_one_length(path: Path, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    if not columns:
        raise InputError(f"{path}: no column of numbers in it")
    lengths = Counter(values.size for values in columns.values())
    times = [v.size for n, v in columns.items() if n.rpartition(".")[2].lower() in ("t", "time")]
    length = times[0] if times else lengths.most_common(1)[0][0]
    kept = {name: values for name, values in columns.items() if values.size == length}
    if len(kept) > MOST_COLUMNS:
        raise InputError(f"{path}: {len(kept)} columns; at most {MOST_COLUMNS} are read")
    last = Counter(name.rpartition(".")[2] for name in kept)
    return {
        (name.rpartition(".")[2] if last[name.rpartition(".")[2]] == 1 else name): values
        for name, values in kept.items()
    }


# --- Parquet --------------------------------------------------------------------------------------


def parquet_columns(path: Path) -> dict[str, np.ndarray]:
    """Columns of numbers and times of a Parquet file; times are seconds since the first row."""
    parquet = require("pyarrow.parquet", "parquet")
    try:
        table = parquet.read_table(path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error}") from None
    except Exception as error:  # pyarrow raises its own kinds
        raise InputError(f"{path}: not a Parquet file that pyarrow can read ({error})") from None
    found = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        values = column.to_numpy()
        if values.dtype.kind == "M":
            since = (values - values[0]) / np.timedelta64(1, "ns")
            found[str(name)] = 1e-9 * since.astype(float)
        elif values.dtype.kind == "m":
            found[str(name)] = 1e-9 * (values / np.timedelta64(1, "ns")).astype(float)
        elif values.dtype.kind in "fiub":
            found[str(name)] = values.astype(float)
    return _of_one_length(path, found)
