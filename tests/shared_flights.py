"""Where the flights beside the repository lie, and how a test says that it needs them."""

from functools import cache
from pathlib import Path

import pytest

from coax_env.logs.flight import Flight, read_flight

SHARED_FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"


def shared_flight(name: str) -> Path:
    """The folder of a shared flight, or skip the test, saying so."""
    folder = SHARED_FLIGHTS / name
    if not folder.is_dir():
        pytest.skip(f"the flight {folder} is not on this machine")
    return folder


@cache
def read(name: str) -> Flight:
    """A shared flight as read: once, for all tests of a process."""
    return read_flight(shared_flight(name))
