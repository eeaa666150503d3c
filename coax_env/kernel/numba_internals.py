"""All that this project uses of numba beyond its documented interface, behind a few functions.

numba lets users add types and functions, but not everything that a SIMD register needs: its private
names stand here and nowhere else (tests/test_simd.py), and pyproject.toml bounds numba to the versions
that the tests have run with. `context` and `builder` are those that numba hands to an intrinsic.
"""

import gc
import operator
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from llvmlite import ir
from llvmlite.binding import parse_bitcode
from numba import config, njit, types
from numba.core import caching, cgutils, event, targetconfig
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler_lock import global_compiler_lock
from numba.core.cpu import CPUContext
from numba.core.environment import lookup_environment
from numba.core.imputils import impl_ret_borrowed
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.core.typeconv import Conversion
from numba.core.typed_passes import NativeLowering
from numba.core.types.functions import BaseFunction
from numba.core.typing.context import Context
from numba.core.typing.templates import AbstractTemplate, Signature, infer_global, signature
from numba.extending import lower_builtin
from numba.np.arrayobj import make_array, populate_array

SAFE = Conversion.safe
"""A conversion of an argument that loses nothing."""
INTP = cgutils.intp_t
"""An integer as wide as a pointer."""
INT32 = cgutils.int32_t
unpack_tuple = cgutils.unpack_tuple
"""``unpack_tuple(builder, value, count)``: a tuple's elements."""
if_unlikely = cgutils.if_unlikely
"""``with if_unlikely(builder, condition):`` code for what hardly ever happens."""


PACKAGE = Path(__file__).parents[1]


class PackagedCacheLocator(caching.UserProvidedCacheLocator):
    """A function's place in the cache by its file's place in the package, wherever the package lies.

    numba's own has the folder's path in it: a copy, a wheel and a checkout would each compile what
    is the same to the last byte. A user's own file keeps numba's place.
    """

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """Folder within the cache.

        Args:
            py_file: path of the source.
        """
        folder = Path(py_file).resolve().parent
        if folder.is_relative_to(PACKAGE):
            return "_".join(folder.relative_to(PACKAGE.parent).parts)
        return super().get_suitable_cache_subpath(py_file)


@contextmanager
def cached_in(folder: str) -> Iterator[None]:
    """What is decorated meanwhile is cached there, each source in a folder of its own.

    One thread at a time, which may be compiling: numba's settings are the process's.

    Args:
        folder: named by the content of all sources.
    """
    here = {
        "CACHE_DIR": folder,
        "CACHE_LOCATOR_CLASSES": f"{__name__}.{PackagedCacheLocator.__name__}",
    }
    with global_compiler_lock, _changed(vars(config), **here):
        yield


@contextmanager
def _changed(names: dict[str, Any], **values: Any) -> Iterator[None]:
    """Names mean something else meanwhile."""
    before = {name: names[name] for name in values if name in names}
    names.update(values)
    try:
        yield
    finally:
        for name in values:
            del names[name]
        names.update(before)


class _Outermost(event.Listener):
    """What is done once for a function and all that are compiled for it.

    No garbage is collected meanwhile: it takes a tenth of the time and frees little. And numba looks
    into its registries once, not at every function.
    """

    depth, was_on = 0, True  # functions are compiled within one another, by one thread at a time

    def __init__(self) -> None:
        self.loaders = [
            _once_each(kind, "load_additional_registries") for kind in (CPUContext, Context)
        ]

    def on_start(self, event: Any) -> None:
        if self.depth == 0:
            self.was_on = gc.isenabled()
            gc.disable()
            for loader in self.loaders:
                loader.cache_clear()
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.depth == 0 and self.was_on:
            gc.enable()


def _once_each(kind: type, name: str) -> Any:
    """A method that is called once for each object, until its ``cache_clear`` is called."""
    once = cache(getattr(kind, name))
    setattr(kind, name, once)
    return once


def compile_quickly() -> None:
    """From now on, numba compiles all functions in two thirds of its time, to the same machine code."""
    event.register("numba:compile", _Outermost())
    _make_machine_code_of_what_is_called()
    _compare_flags_quickly()
    _remember_operators()


def _compare_flags_quickly() -> None:
    """From now on, numba compares two sets of options by what was set, not by 35 properties each.

    It compares them at every operator that it looks up, which took a tenth of the time to compile.
    """
    options = targetconfig.TargetConfig
    by_properties = options.__eq__

    def equal(self: Any, other: Any) -> Any:
        same = type(self) is type(other) and self._values == other._values
        return same or by_properties(self, other)

    options.__eq__ = equal
    options.__hash__ = lambda self: hash(type(self))


def _remember_operators() -> None:
    """From now on, numba looks for an operator's meaning once for the same types of arguments.

    It tries a dozen templates at every addition and every element of an array; what they find is kept
    where it is code of numba's own, the same whatever is being compiled.
    """
    look_up = BaseFunction.get_call_type
    known: dict[Any, Signature] = {}

    def get_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
        key = (self.key, tuple(args))
        if kws or key not in known:
            found = look_up(self, context, args, kws)
            if not kws and found and self.get_impl_key(found) is self.typing_key:
                known[key] = found
            return found
        self._impl_keys[known[key].args] = self.typing_key
        return known[key]

    BaseFunction.get_call_type = get_call_type  # type: ignore[method-assign]


class _Library(JITCodeLibrary):
    """LLVM's code of a function, and machine code of it where Python or a pointer calls it.

    What compiled code alone calls is linked, as LLVM's code, into all that call it. Machine code that
    was made of it by itself too, and never run, was a tenth of the time to compile.
    """

    only_linked = False

    def _finalize_final_module(self) -> None:
        if self.only_linked:
            self._verify_declare_only_symbols()
            self._finalized = True
        else:
            super()._finalize_final_module()

    def _finalize_specific(self) -> None:
        super()._finalize_specific()
        for variable in self._final_module.global_variables:  # of what was linked, too
            environment = lookup_environment(variable.name)
            if environment is not None:
                self._codegen.set_env(variable.name, environment)

    def get_pointer_to_function(self, name: str) -> int:
        return 0 if self.only_linked else super().get_pointer_to_function(name)

    def serialize_using_object_code(self) -> tuple:
        if self.only_linked:
            return self.name, "linked", self._get_module_for_linking().as_bitcode()
        return super().serialize_using_object_code()

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple) -> Any:
        name, kind, data = state
        if kind != "linked":
            return super()._unserialize(codegen, state)
        stored = codegen.create_library(name)
        stored.only_linked = stored._finalized = True
        stored._final_module = stored._shared_module = parse_bitcode(data)
        return stored


def _make_machine_code_of_what_is_called() -> None:
    """From now on, numba makes machine code of what has a wrapper, or is a pointer, and no other."""
    JITCPUCodegen._library_class = _Library
    lower, set_environment = NativeLowering.run_pass, JITCPUCodegen.set_env

    def run_pass(self: Any, state: Any) -> Any:
        if state.library is None:
            state.library = state.targetctx.codegen().create_library(state.func_id.func_qualname)
            state.library.enable_object_caching()
            flags = state.flags
            state.library.only_linked = flags.no_cpython_wrapper and flags.no_cfunc_wrapper
        return lower(self, state)

    def set_env(self: Any, name: str, environment: Any) -> None:
        if self._engine.get_global_value_address(name):  # it is in machine code
            set_environment(self, name, environment)

    NativeLowering.run_pass = run_pass
    JITCPUCodegen.set_env = set_env


class _WrappedWhenCalled(CPUDispatcher):
    """A compiled function that gets its wrapper, what Python calls, when Python calls it.

    Most functions are called by compiled code alone; their wrappers were a quarter of the time to
    compile. Where Python calls one that has been compiled without, it is compiled again with it.
    """

    asked_by_compiled = False

    def get_call_template(self, args: Any, kws: Any) -> Any:
        self.asked_by_compiled = True
        try:
            return super().get_call_template(args, kws)
        finally:
            self.asked_by_compiled = False

    def compile(self, sig: Any) -> Any:
        with global_compiler_lock:
            compile_now = super().compile
            if self.asked_by_compiled:
                self.asked_by_compiled = False  # it may call itself
                with _changed(self.targetoptions, no_cpython_wrapper=True):
                    return compile_now(sig)
            kind = tuple(normalize_signature(sig)[0])
            here = self.overloads.pop(kind, None)
            if here and _is_wrapped(here):
                self.overloads[kind] = here
                return here.entry_point
            stored = self._cache.load_overload(sig, self.targetctx)
            usable = stored if stored and _is_wrapped(stored) else None
            with _changed(self._cache.__dict__, load_overload=lambda *_: usable):
                return compile_now(sig)

    def add_overload(self, cres: Any) -> None:
        if _is_wrapped(cres):
            super().add_overload(cres)
        else:
            self.overloads[tuple(cres.signature.args)] = cres


def _is_wrapped(cres: Any) -> bool:
    return bool(cres.library.get_pointer_to_function(cres.fndesc.llvm_cpython_wrapper_name))


def njit_for_compiled(**options: Any) -> Callable[[Callable], Any]:
    """``numba.njit`` of a function that compiled code calls; Python may, and then waits for a wrapper.

    Args:
        options: of ``numba.njit``.
    """

    def decorate(function: Callable) -> Any:
        dispatcher = njit(**{"no_cfunc_wrapper": True, **options})(function)
        dispatcher.__class__ = _WrappedWhenCalled
        return dispatcher

    return decorate


def define_call(
    key: Any, result: types.Type, kinds: tuple[types.Type, ...],
    fits: Callable[[types.Type, types.Type], bool], emit: Callable,
) -> None:  # fmt: skip
    """Let compiled code call `key`, an operator or function, with arguments of new types.

    Args:
        key: what is called. result: type of what it returns. kinds: types of its arguments.
        fits: whether an argument of one type may stand for a kind; at least one must be its kind.
        emit: ``emit(context, builder, signature, values)`` writes the code.
    """

    class Typing(AbstractTemplate):
        def generic(self, args: tuple, kws: dict) -> Signature | None:
            meant = len(args) == len(kinds) and any(map(operator.eq, args, kinds))
            if meant and not kws and all(map(fits, args, kinds)):
                return signature(result, *kinds)
            return None

    infer_global(key)(Typing)
    lower_builtin(key, *kinds)(emit)


def external_function(builder: Any, name: str, result: ir.Type, kinds: list[ir.Type]) -> Any:
    """A function of LLVM or of the process.

    Args:
        builder: numba's. name: the function's symbol.
        result: type of what it returns. kinds: types of its arguments.
    """
    return cgutils.get_or_insert_function(builder.module, ir.FunctionType(result, kinds), name)


def pointer_at(context: Any, builder: Any, symbol: str) -> Any:
    """The address that a symbol of the process has, as a pointer to an INTP.

    Args:
        context, builder: numba's. symbol: its name, once given to llvmlite.binding.add_symbol.
    """
    return context.get_c_value(builder, INTP, symbol)


def raise_error(context: Any, builder: Any, error: type, *message: str) -> None:
    """Leave the compiled function with a Python exception.

    Args:
        context, builder: numba's. error: the exception's class. message: what it is called with.
    """
    context.call_conv.return_user_exc(builder, error, message)


def array_data(context: Any, builder: Any, kind: types.Array, array: Any) -> Any:
    """Pointer to an array's first element.

    Args:
        context, builder: numba's. kind, array: the array's type and value.
    """
    return make_array(kind)(context, builder, array).data


def view_rows(context: Any, builder: Any, source: types.Array, array: Any, row: types.Array,
              element: ir.Type, size: int) -> Any:  # fmt: skip
    """The memory of a two-dimensional contiguous array as a one-dimensional array, row by row.

    Args:
        context, builder: numba's. source, array: the array's type and value.
        row: type of the array that is returned. element: of one of its elements, of `size` bytes.
    """
    of = make_array(source)(context, builder, array)
    count, _ = unpack_tuple(builder, of.shape, 2)
    data = builder.bitcast(of.data, element.as_pointer())
    rows = _one_dimensional(context, builder, row, data, count, size, of.meminfo)
    return impl_ret_borrowed(context, builder, row, rows)


def view_flat(context: Any, builder: Any, source: types.Array, array: Any, row: types.Array,
              element: ir.Type, size: int) -> Any:  # fmt: skip
    """The memory of a contiguous array as a one-dimensional one of larger elements.

    Args:
        context, builder: numba's. source, array: the array's type and value.
        row: type of the array that is returned. element: of one of its elements, of `size` bytes.
    """
    of = make_array(source)(context, builder, array)
    per_element = context.get_constant(types.intp, size // 8)
    count = builder.udiv(of.nitems, per_element)
    data = builder.bitcast(of.data, element.as_pointer())
    rows = _one_dimensional(context, builder, row, data, count, size, of.meminfo)
    return impl_ret_borrowed(context, builder, row, rows)


def stack_array(context: Any, builder: Any, row: types.Array, element: ir.Type, count: int,
                size: int) -> Any:  # fmt: skip
    """A one-dimensional array on the stack, not set.

    Args:
        context, builder: numba's. row: type of the array. element: type of one of its elements.
        count: how many. size: bytes of one.
    """
    with builder.goto_entry_block():
        place = builder.alloca(ir.ArrayType(element, count))
    data = builder.bitcast(place, element.as_pointer())
    length = context.get_constant(types.intp, count)
    return _one_dimensional(context, builder, row, data, length, size, None)


def _one_dimensional(context: Any, builder: Any, row: types.Array, data: Any, count: Any, size: int,
                     owner: Any) -> Any:  # fmt: skip
    rows = make_array(row)(context, builder)
    stride = context.get_constant(types.intp, size)
    populate_array(
        rows, data, shape=[count], strides=[stride], itemsize=stride, meminfo=owner
    )  # fmt: skip
    return rows._getvalue()
