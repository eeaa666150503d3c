"""Compiled functions that compiled code calls through their address, and does not have in it.

numba compiles every function that a compiled function might call, so that whoever flies a vehicle
without effects would wait for the code of them all. A lazily compiled function is called through its
address instead, which stands in a cell of memory; while the cell is empty, the call goes to Python
first and has the function compiled. What compiled code remembers is the cell's name, so it can be
cached.

And LLVM makes machine code of a function anew in each that it is linked into. A large one that many
call is compiled apart: at once, by itself, and its callers have its address.
"""

import ctypes
import threading
import traceback
from collections.abc import Callable
from typing import Any

import llvmlite.binding
from llvmlite import ir
from numba import float64, types
from numba.extending import intrinsic

from coax_env.kernel.compilation import name_apart, pointer
from coax_env.kernel.numba_internals import (
    INT32,
    INTP,
    external_function,
    if_unlikely,
    pointer_at,
    raise_error,
)

DONE, FAILED, INTERRUPTED = range(3)
_MAKER = ctypes.CFUNCTYPE(ctypes.c_int)
_ARRAY = float64[::1]
_compiling = threading.RLock()
_kept: list[Any] = []  # cells and makers: compiled code has their addresses


def lazily_compiled(function: Callable) -> Any:
    """Make a function of 3 to 6 arguments one that compiled code can call; see above.

    All are arrays of doubles, but for one called ``dt``, a number.
    """
    return _called_by_address(function, _ARRAY)[0]


def compiled_apart(function: Callable, arrays: types.Array) -> Any:
    """The same, compiled now, or loaded from the cache.

    Args:
        function: of 3 to 6 arguments, a number ``dt`` among them or none. arrays: type of the others.
    """
    called, compile_now = _called_by_address(function, arrays)
    compile_now()
    return called


def _called_by_address(function: Callable, arrays: types.Array) -> tuple[Any, Callable[[], None]]:
    """What compiled code calls, and what compiles it where that has not been done."""
    name = name_apart(function).__qualname__
    arguments = function.__code__.co_varnames[: function.__code__.co_argcount]
    signature = types.void(*(float64 if a == "dt" else arrays for a in arguments))
    cell = ctypes.c_size_t(0)

    def compile_now() -> None:
        with _compiling:
            if not cell.value:
                made = pointer(signature)(function)
                _kept.append(made)
                cell.value = made.address

    def compile_when_called() -> int:
        try:
            compile_now()
        except KeyboardInterrupt:
            return INTERRUPTED
        except Exception:  # Python cannot raise through compiled code: the caller there does
            traceback.print_exc()
            return FAILED
        return DONE

    maker = _MAKER(compile_when_called)
    _kept.extend((cell, maker))
    cell_symbol, maker_symbol = f"coax_env.kernel.lazy.{name}", f"coax_env.kernel.lazy.{name}.maker"
    llvmlite.binding.add_symbol(cell_symbol, ctypes.addressof(cell))
    llvmlite.binding.add_symbol(maker_symbol, ctypes.cast(maker, ctypes.c_void_p).value)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kinds = [context.get_value_type(kind) for kind in signature.args]
        function = ir.FunctionType(ir.VoidType(), kinds).as_pointer()
        place = pointer_at(context, builder, cell_symbol)
        empty = builder.icmp_unsigned("==", builder.load(place), INTP(0))
        with if_unlikely(builder, empty):
            outcome = builder.call(external_function(builder, maker_symbol, INT32, []), [])
            for code, error, message in (
                (INTERRUPTED, KeyboardInterrupt, ()),
                (FAILED, RuntimeError, (f"{name} did not compile",)),
            ):
                with if_unlikely(builder, builder.icmp_unsigned("==", outcome, INT32(code))):
                    raise_error(context, builder, error, *message)
        builder.call(builder.inttoptr(builder.load(place), function), args)
        return context.get_dummy_value()

    def of_three(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
        return signature, emit

    def of_four(typingctx: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
        return signature, emit

    def of_five(typingctx: Any, a: Any, b: Any, c: Any, d: Any, e: Any) -> Any:
        return signature, emit

    def of_six(typingctx: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any) -> Any:
        return signature, emit

    # numba takes no *args here
    of = {3: of_three, 4: of_four, 5: of_five, 6: of_six}[len(signature.args)]
    return intrinsic(of), compile_now
