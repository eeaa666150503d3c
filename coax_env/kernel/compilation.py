"""numba, with a cache that stays true.

numba's own cache looks at the file of the function being compiled, not at the files of the functions
it calls: edit a callee in another module and the old machine code still runs.
So the cache folder here is named by a hash over every source that takes part in the kernel; any edit
gives a new folder, and the old one is left to age. Where the package lies does not matter: copies that
are the same to the last byte share what was compiled.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache, wraps
from pathlib import Path
from typing import Any

import numba

from coax_env.kernel.numba_internals import (
    PACKAGE,
    cached_in,
    compile_quickly,
    njit_for_compiled,
)

compile_quickly()

COMPILED_ROOMS = ("kernel", "model")


def kernel_sources() -> list[Path]:
    """The files that take part in compiled code: two whole rooms, and what imports this one.

    Whole rooms, since compiled code takes constants and functions from files that compile nothing.
    """
    return [
        path
        for path in sorted(PACKAGE.rglob("*.py"))
        if path.parent.name in COMPILED_ROOMS
        or "coax_env.kernel" in path.read_text(encoding="utf-8")
    ]


def source_hash(extra: tuple[Path, ...] = ()) -> str:
    """Twelve hex digits over the kernel's sources, numba's version and files named by the caller."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in (*kernel_sources(), *extra):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def _cache_root() -> Path:
    root = os.environ.get("COAX_CACHE_DIR")
    if root:
        return Path(root)
    home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return (
        home / "coax" if os.access(home.parent, os.W_OK) else Path(tempfile.gettempdir()) / "coax"
    )


CACHE_DIR = OF_PACKAGE = _cache_root() / source_hash()
"""Of what is compiled from now on, a user's files in it; and of what no such file takes part in."""
_included: list[Path] = []


def include(path: Path) -> None:
    """Let a user's file take part in the kernel: what is compiled from now on has its own cache."""
    global CACHE_DIR
    _included.append(path)
    CACHE_DIR = _cache_root() / source_hash(tuple(_included))


def _own_cache(folder: Path | None = None) -> AbstractContextManager[None]:
    return cached_in(str(folder or CACHE_DIR))


def name_apart(function: Callable, *values: Any) -> Callable:
    """Give a closure a name with its values in it, or with those given.

    numba distinguishes functions by name and by a count of what this process has compiled so far,
    in the cache's index as in the machine code's symbols. Closures of one name can therefore be mixed
    up where one process loads what two have compiled, or one that was stopped half way and began
    again.
    """
    if not values:
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        values = tuple(v for v in cells if isinstance(v, bool | int | float | str))
    if values:
        function.__qualname__ += "_" + "_".join(map(str, values))
    return function


BORROWING = {"error_model": "numpy", "_nrt": False}
"""Options of what works on its callers' arrays, makes none and returns none.

References to arrays are then not counted, at every call of every function: two thirds of the kernel's
time. numba refuses to compile what makes an array all the same; what returns one it does not notice.
"""


def compiled(
    signature: Any = None, makes_arrays: bool = False, folder: Path | None = None, **options: Any
) -> Callable[[Callable], Any]:
    """``numba.njit`` that caches under CACHE_DIR and releases the GIL.

    Args:
        signature: numba's; None: compiled when first called with such arguments.
        makes_arrays: the function makes arrays or returns them, see BORROWING.
        folder: of the cache, or CACHE_DIR.
        options: of ``numba.njit``.
    """
    settings = {
        "cache": True, "nogil": True, "no_cfunc_wrapper": True,
        **BORROWING, "_nrt": makes_arrays, **options,
    }  # fmt: skip

    def decorate(function: Callable) -> Any:
        name_apart(function)
        with _own_cache(folder):
            if signature is None:
                return njit_for_compiled(**settings)(function)
            return numba.njit(signature, **settings)(function)

    return decorate


def compiled_when_called(signature: Any, **options: Any) -> Callable[[Callable], Any]:
    """As `compiled`, but at the first call, or at that of its attribute ``prepare``.

    For functions that Python alone calls, so that an import compiles only what others call. They have
    a model's functions by address: a user's effect changes nothing in them.
    """
    folder = OF_PACKAGE

    def decorate(function: Callable) -> Any:
        @cache
        def prepared() -> Any:
            return compiled(signature, folder=folder, **options)(function)

        @wraps(function)
        def call(*arguments: Any) -> Any:
            return prepared()(*arguments)

        call.prepare = prepared  # type: ignore[attr-defined]
        return call

    return decorate


def pointer(signature: Any) -> Callable[[Callable], Any]:
    """``numba.cfunc`` with the same cache: a compiled function that can be passed as an argument."""

    def decorate(function: Callable) -> Any:
        with _own_cache():
            settings = {"cache": True, "nopython": True, **BORROWING}
            return numba.cfunc(signature, **settings)(function)

    return decorate


def looked_up_once(function: Any) -> Callable:
    """A compiled function whose machine code is found at its first call and then called as it is.

    numba looks at the types of all arguments at every call: microseconds where they are tuples of many
    arrays. For functions that are always called with arguments of the same types (number of axes, type
    of numbers, contiguous): nothing checks them any more.
    """
    found: list[Callable] = []

    def call(*arguments: Any) -> Any:
        if not found:
            found.append(function.compile(tuple(numba.typeof(a) for a in arguments)))
        return found[0](*arguments)

    return call
