"""Errors a user can mend: one clear line that names the file, line, field or package."""

import importlib
from types import ModuleType


class InputError(ValueError):
    """Bad input. The message is one line; scripts print it and exit with code 2."""


def require(module: str, extra: str) -> ModuleType:
    """Import an optional package, or say in one line what to install.

    Args:
        module: name to import, for instance ``"plotly.graph_objects"``.
        extra: the extra of this project that brings it, for instance ``"report"``.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise InputError(
            f"this needs {package}, which is not installed: pip install 'coax[{extra}]'"
        ) from error
