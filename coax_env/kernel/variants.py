"""One source, two machine codes: of the bare model, and of the model with effects.

A call that might change the workspace costs the bare model a fifth of its speed even when it is never
made (scripts/benchmark.py). So a function of the kernel is written once, asks WITH_EFFECTS where the
two differ, and is compiled twice: numba drops a branch on a constant before it looks inside. What a
function calls by the name of such a pair is, in each of its two variants, the pair's own.
"""

from collections.abc import Callable
from types import FunctionType
from typing import Any, NamedTuple

from coax_env.kernel.compilation import compiled
from coax_env.kernel.lazy import lazily_compiled

WITH_EFFECTS = True
"""In a variant's source: whether it is the one with effects."""


class Variants(NamedTuple):
    """Two compiled functions of one meaning."""

    bare: Any
    with_effects: Any


def bare_and_with_effects(lazily: bool = False) -> Callable[[Callable], Any]:
    """Compile a function twice, into `Variants`; the bare one is inlined where it is called.

    Args:
        lazily: compile the variant with effects when it is first called (lazy.py).
    """

    def decorate(function: Callable) -> Any:
        bare, full = _variant(function, False), _variant(function, True)
        return Variants(
            compiled(forceinline=True)(bare),
            lazily_compiled(full) if lazily else compiled()(full),
        )

    return decorate


def with_effects(function: Callable) -> Any:
    """Compile a function once, calling the variants with effects."""
    return compiled()(_variant(function, True))


def _variant(function: Callable, on: bool) -> FunctionType:
    """A copy of a function that sees WITH_EFFECTS as `on` and one of each pair's two variants."""
    assert isinstance(function, FunctionType)
    seen = {
        name: (value.with_effects if on else value.bare) if isinstance(value, Variants) else value
        for name, value in function.__globals__.items()
    }
    seen["WITH_EFFECTS"] = on
    copy = FunctionType(function.__code__, seen, function.__name__, function.__defaults__)
    copy.__doc__ = function.__doc__
    copy.__qualname__ = f"{function.__qualname__}_{'with_effects' if on else 'bare'}"
    return copy
