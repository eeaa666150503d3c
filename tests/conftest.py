"""Slow tests begin first: no worker is left with a long one while the others have nothing to do."""

import os
from collections.abc import Sequence
from itertools import pairwise

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow ones first in each worker's share, which is a part of the list (xdist's worksteal)."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    slow = [item for item in items if item.get_closest_marker("slow")]
    quick = [item for item in items if not item.get_closest_marker("slow")]
    shares = zip(parts(slow, workers), parts(quick, workers), strict=True)
    items[:] = [item for share in shares for part in share for item in part]


def parts(items: Sequence[pytest.Item], count: int) -> list[Sequence[pytest.Item]]:
    """So many parts in their order, as even as can be."""
    ends = [len(items) * k // count for k in range(count + 1)]
    return [items[a:b] for a, b in pairwise(ends)]
