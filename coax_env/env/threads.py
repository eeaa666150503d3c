"""Rows of a fleet shared out among threads.

Threads of `concurrent.futures` take 30 to 50 us more to begin and to be waited for: a fifteenth of a
step of 4096 helicopters on two threads. So they are threads that wait for shares in a queue.
"""

import os
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from queue import SimpleQueue
from threading import Thread

Ends = SimpleQueue[BaseException | None]
"""What a call waits for: of each share, None or what it raised."""

Shares = SimpleQueue[tuple[Callable[[int, int], None], int, int, Ends]]


@cache
def _shares_of(process: int, threads: int) -> Shares:
    """The queue from which so many threads fly; a forked child has none of its parent's."""
    shares: Shares = SimpleQueue()
    for _ in range(threads):
        Thread(target=_work, args=(shares,), name="coax-fleet", daemon=True).start()
    return shares


def _work(shares: Shares) -> None:
    while True:
        function, first, last, ends = shares.get()
        try:
            function(first, last)
        except BaseException as error:
            ends.put(error)
        else:
            ends.put(None)
        del function, ends  # nothing of the last call is kept while waiting


def in_threads(function: Callable[[int, int], None], count: int, threads: int) -> None:
    """Call function(first, last) on equal shares; the compiled kernel lets other threads run.

    The calling thread flies the first share itself: waking one that sleeps takes as long as many rows.
    What a share raises is raised here, when all have ended.

    Args:
        function: of the first row and of the one after the last. count: of rows. threads: of shares.
    """
    if threads == 1:
        function(0, count)
        return
    shares = _shares_of(os.getpid(), threads - 1)
    ends: Ends = SimpleQueue()
    edges = [count * k // threads for k in range(threads + 1)]
    for first, last in pairwise(edges[1:]):
        shares.put((function, first, last, ends))
    try:
        function(0, edges[1])
    finally:
        errors = [ends.get() for _ in range(threads - 1)]
    for error in errors:
        if error is not None:
            raise error
