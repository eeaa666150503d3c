"""Slow tests begin first: no worker is left with a long one while the others have nothing to do."""

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """In the order in which they were found otherwise."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)
