"""Slow tests begin first, and those of a minute, ``slow(first=True)``, before them: no worker is left
with a long one while the others have nothing to do."""

import os
from collections.abc import Sequence
from itertools import pairwise

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow ones first in each worker's share, which is a part of the list (xdist's worksteal)."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    kinds: tuple[list[pytest.Item], ...] = ([], [], [])
    for item in items:
        slow = item.get_closest_marker("slow")
        kinds[2 if slow is None else 0 if slow.kwargs.get("first") else 1].append(item)
    first, others, quick = kinds
    dealt = [first[k::workers] for k in range(workers)]
    shares = zip(dealt, parts(others, workers), parts(quick, workers), strict=True)
    items[:] = [item for share in shares for part in share for item in part]


def parts(items: Sequence[pytest.Item], count: int) -> list[Sequence[pytest.Item]]:
    """So many parts in their order, as even as can be."""
    ends = [len(items) * k // count for k in range(count + 1)]
    return [items[a:b] for a, b in pairwise(ends)]


@pytest.fixture
def one_by_one(monkeypatch):
    """Helicopters fly one by one: no variant is compiled for some steps (test_simd.py has those)."""
    monkeypatch.setattr("coax_env.env.fleet.SIMD_VARIANT_FROM", 10**9)
