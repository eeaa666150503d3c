"""A user's own effects: a small Python file that adds to the catalogue (effects.py).

The file imports from `coax_env.model.effects` and decorates a function, as the catalogue itself does::

    from coax_env.model import state as S
    from coax_env.model import workspace as F
    from coax_env.model.effects import LOAD, EffectParameter, effect

    @effect(LOAD, EffectParameter("k", "N m", usual=0.02, smallest=0.002),
            channels="q theta", source="seen on the bench")
    def heading_moment(x, f, p, e):
        "A pitching moment that follows the heading, k sin(3 psi)."
        f[F.MOMENT_Y] += p[e] * math.sin(3.0 * x[S.PSI])

In a batch of envs an effect is flown for several helicopters at once (kernel/simd.py) where it has no
``if`` on their states; `coax_env.kernel.simd.select` stands for one.
"""

import importlib.util
import sys
from pathlib import Path
from typing import Any

from numba import float64, int64

from coax_env.errors import InputError
from coax_env.kernel import compilation
from coax_env.model import effects

_A = float64[::1]


def load_effect(path: str | Path) -> tuple[str, ...]:
    """Add the effects of a Python file to the catalogue; their names.

    The kernel is compiled with the catalogue as it stands when it is first needed, so this comes
    before any flight is flown, filtered or read.

    Raises:
        InputError: no such file, not Python, no effect in it, a name that is taken, or too late.
    """
    path = Path(path).resolve()
    if "coax_env.model.dynamics" in sys.modules:
        raise InputError(f"{path}: load_effect must come before the model is first used")
    if not path.is_file():
        raise InputError(f"no effect file {str(path)!r}")
    known = dict(effects.GROUPS)
    compilation.include(path)
    try:
        _run(path)
        added = tuple(name for name in effects.GROUPS if name not in known)
        if not added:
            raise InputError(f"{path}: no function under @effect(...) in it")
        for name in added:
            _check(path, name)
    except InputError:
        effects.forget(set(effects.GROUPS) - set(known))
        raise
    return added


def _run(path: Path) -> None:
    spec = importlib.util.spec_from_file_location(f"coax_effect_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: not a Python file (its name should end in .py)")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # numba's cache looks a function's module up by name
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise InputError(f"{path}: line {error.lineno}: {error.msg}") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # whatever a user's file may raise
        raise InputError(f"{path}: {type(error).__name__}: {error}") from error


def _check(path: Path, name: str) -> None:
    """Compile an effect by itself, so that its faults are its own and not the kernel's."""
    try:
        function: Any = effects.GROUPS[name].function
        function.compile((_A, _A, _A, int64))
    except Exception as error:  # numba raises its own errors and, for unknown names, Python's
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise InputError(
            f"{path}: effect {name!r} does not compile: {' '.join(lines[:2])}"
        ) from error
