"""Where the flights beside the repository lie, and how a test says that it needs them."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from coax_env.logs.flight import Flight, Run, read_flight

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


def with_rows(run: Run, rows: np.ndarray) -> Run:
    """A run of these rows alone, (n,) true for each that stays."""
    return replace(
        run,
        t=run.t[rows],
        command=run.command[rows],
        measured={channel: values[rows] for channel, values in run.measured.items()},
        battery=None if run.battery is None else run.battery[rows],
    )
