"""Rows of a fleet shared out among threads.

Threads of `concurrent.futures` take 30 to 50 us more to begin and to be waited for: a fifteenth of a
step of 4096 helicopters on two threads. So they are threads that wait for shares in a queue. Still one
that sleeps takes 20 to 50 us to wake, as long as several hundred rows: so the calling thread takes the
larger share, and is not itself put to sleep at the end (`Balance`).
"""

import os
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from queue import SimpleQueue
from threading import Thread

GROUP = 8
"""Rows that the SIMD batch flies at a time: a share that cuts a group flies it twice."""
WAITED, NOT_WAITED = 0.02, 0.001
"""Of all rows, by which the calling thread's share grows where it had to wait, which costs as much as
some hundred rows, and shrinks where not; ours."""
MOST_MORE = 0.25
"""Of all rows, beyond an equal share at most; ours."""

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


class Balance:
    """How many rows the calling thread takes: so many that the others end just before it does.

    Where it had to wait its share grows, else it shrinks a little, from call to call. Which thread
    flies a row changes nothing of its flight. On two processors of one core 4096 helicopters take 190
    us a step so, 218 in equal shares.
    """

    def __init__(self) -> None:
        self.more = 0.0
        """Of all rows, beyond an equal share."""

    def edges(self, count: int, threads: int) -> list[int]:
        """First rows of the shares, and the one after the last; the caller's is of whole groups.

        Args:
            count: of rows. threads: of shares.
        """
        own = min(GROUP * round((1.0 / threads + self.more) * count / GROUP), count)
        others = threads - 1
        return [0, *(own + (count - own) * k // others for k in range(threads))]

    def learn(self, waited: bool) -> None:
        """Move the share by whether the calling thread had to wait for the others."""
        change = WAITED if waited else -NOT_WAITED
        self.more = min(max(self.more + change, 0.0), MOST_MORE)


def in_threads(
    function: Callable[[int, int], None], count: int, threads: int, balance: Balance | None = None
) -> None:
    """Call function(first, last) on shares of the rows; the compiled kernel lets other threads run.

    The calling thread flies the first share itself. What a share raises is raised here, when all have
    ended.

    Args:
        function: of the first row and of the one after the last. count: of rows. threads: of shares.
        balance: of the shares, which learns; None: they are equal.
    """
    if threads == 1:
        function(0, count)
        return
    shares = _shares_of(os.getpid(), threads - 1)
    ends: Ends = SimpleQueue()
    if balance is None:
        edges = [count * k // threads for k in range(threads + 1)]
    else:
        edges = balance.edges(count, threads)
    for first, last in pairwise(edges[1:]):
        shares.put((function, first, last, ends))
    try:
        function(0, edges[1])
    finally:
        if balance is not None:
            balance.learn(waited=ends.qsize() < threads - 1)
        errors = [ends.get() for _ in range(threads - 1)]
    for error in errors:
        if error is not None:
            raise error
