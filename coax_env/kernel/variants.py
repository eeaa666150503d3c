"""One source, several machine codes: of the bare model, of the model with effects, of some effects.

A call that might change the workspace costs the bare model a fifth of its speed even when it is never
made (scripts/benchmark.py). So a function of the kernel is written once, asks WITH_EFFECTS where the
two differ, and is compiled twice: numba drops a branch on a constant before it looks inside. What a
function calls by the name of such a pair is, in each of its two variants, the pair's own.

`under_names` and `inlined` do the same by other names: a copy of a function in which some of its global
names mean something else. So is the SIMD batch compiled for the effects that its vehicles have.
"""

from collections.abc import Callable, Mapping, Sequence
from types import FunctionType
from typing import Any, NamedTuple

from numba.extending import is_jitted

from coax_env.kernel.compilation import BORROWING, compiled
from coax_env.kernel.lazy import lazily_compiled
from coax_env.kernel.numba_internals import njit_for_compiled

WITH_EFFECTS = True
"""In a variant's source: whether it is the one with effects."""


class Variants(NamedTuple):
    """Two compiled functions of one meaning, and what they were compiled from."""

    bare: Any
    with_effects: Any
    source: Any


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
            function,
        )

    return decorate


def with_effects(function: Callable) -> Any:
    """Compile a function once, calling the variants with effects."""
    return compiled()(_variant(function, True))


def _variant(function: Callable, on: bool) -> FunctionType:
    """A copy of a function that sees WITH_EFFECTS as `on` and one of each pair's two variants."""
    assert isinstance(function, FunctionType)
    names = {
        name: value.with_effects if on else value.bare
        for name, value in function.__globals__.items()
        if isinstance(value, Variants)
    }
    return under_names(function, names | {"WITH_EFFECTS": on}, "with_effects" if on else "bare")


def under_names(function: Any, names: Mapping[str, Any], kind: str) -> FunctionType:
    """A copy of a function, not compiled, in which some global names mean something else.

    Args:
        function: or a compiled one. names: what they mean, by name; others are not looked at.
        kind: what the copy is of, in one word that tells it from others: its name ends in it, which is
            how numba's cache tells them apart.
    """
    plain = getattr(function, "py_func", function)
    copy = FunctionType(
        plain.__code__, {**plain.__globals__, **names}, plain.__name__, plain.__defaults__,
        plain.__closure__,
    )  # fmt: skip
    copy.__doc__ = plain.__doc__
    copy.__qualname__ = f"{plain.__qualname__}_{kind}"
    return copy


def inlined(
    functions: Sequence[Any], names: Mapping[str, Any], kind: str, forced: bool = True
) -> tuple[Any, ...]:
    """Functions and all that they call, under other names, inlined wherever they are called.

    Inlined, the arrays that one function hands to the next stay in registers (simd_scratch).

    Args:
        functions: plain, compiled, or Variants. names, kind: as of `under_names`, for every function
            called by a global name too; plain functions among them are compiled with it.
        forced: or where the compiler finds it worth its while: large ones compile sooner.
    """
    made: dict[int, Any] = {}

    def of(value: Any) -> Any:
        plain = value.source if isinstance(value, Variants) else getattr(value, "py_func", value)
        if id(plain) not in made:
            own = {}
            for name in plain.__code__.co_names:
                meant = names.get(name, plain.__globals__.get(name))
                calls = name in names and isinstance(meant, FunctionType)
                if calls or isinstance(meant, Variants) or is_jitted(meant):
                    own[name] = of(meant)
                elif name in names:
                    own[name] = meant
            options = {**BORROWING, "nogil": True, "forceinline": forced}
            if is_jitted(value):  # a user's effect may make arrays
                options["_nrt"] = value.targetoptions.get("_nrt", False)
            made[id(plain)] = njit_for_compiled(**options)(under_names(plain, own, kind))
        return made[id(plain)]

    return tuple(of(function) for function in functions)
