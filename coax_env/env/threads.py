"""Rows of a fleet shared out among threads."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

_POOLS: dict[tuple[int, int], ThreadPoolExecutor] = {}


def in_threads(function: Callable[[int, int], None], count: int, threads: int) -> None:
    """Call function(first, last) on equal shares; the compiled kernel lets other threads run.

    The calling thread flies the first share itself: waking one that sleeps takes as long as many rows.

    Args:
        function: of the first row and of the one after the last. count: of rows. threads: of shares.
    """
    if threads == 1:
        function(0, count)
        return
    key = (os.getpid(), threads)  # a forked child has no threads of its parent
    if key not in _POOLS:
        _POOLS[key] = ThreadPoolExecutor(threads - 1)
    edges = [count * k // threads for k in range(threads + 1)]
    futures = [_POOLS[key].submit(function, a, b) for a, b in pairwise(edges[1:])]
    function(0, edges[1])
    for future in futures:
        future.result()
