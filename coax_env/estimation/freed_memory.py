"""What the C library keeps of the memory that passes have freed."""

import ctypes
from contextlib import suppress


def return_freed_memory() -> None:
    """Give back to the system what this process has freed, where its C library can (glibc).

    glibc keeps it: of 2.5 GB that a first fit to 200 runs took, 1.8 were free.
    """
    with suppress(OSError, TypeError, AttributeError):  # no such library, or no such function in it
        ctypes.CDLL(None).malloc_trim(0)
