"""How far long work is: a line of text at every step, or a bar (tqdm) with the time that is left."""

import inspect
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

from tqdm import tqdm

Progress = Callable[[str], None]
"""Called with a line of text at every step."""
Shares = Mapping[str, float]
"""How a step's line begins -> share of the whole time that has passed when it comes."""

TICK = 0.5  # s between two drawings of a bar

P = ParamSpec("P")
R = TypeVar("R")


def reporter(progress: Progress | bool | None) -> Progress:
    """What is called with a line of text: what was given, or nothing that shows."""
    return progress if callable(progress) else _quiet


def _quiet(text: str) -> None:
    """Show nothing."""


@contextmanager
def bar(name: str, shares: Shares | None = None) -> Iterator[Progress]:
    """A bar on stderr: the step, the time it has taken and, where shares are known, what is left.

    Args:
        name: of the work.
        shares: of the time, by how a step's line begins; None: only the time that has passed.
    """
    form = "{desc} |{bar}| {elapsed}, about {remaining} left" if shares else "{desc} [{elapsed}]"
    total = 1.0 if shares else None
    # smoothing=0: what is left is reckoned from all the time so far, not from the last step
    with tqdm(total=total, desc=name, bar_format=form, smoothing=0.0) as shown:
        stop = threading.Event()

        def tick() -> None:
            while not stop.wait(TICK):
                shown.refresh()

        def report(text: str) -> None:
            passed = [share for begins, share in (shares or {}).items() if text.startswith(begins)]
            shown.n = max([shown.n, *passed])
            shown.set_description_str(f"{name}: {text}")

        thread = threading.Thread(target=tick, daemon=True)
        thread.start()
        try:
            yield report
            shown.n = shown.total or shown.n
        finally:
            stop.set()
            thread.join()


def shows_progress(
    name: str, shares: Shares | None = None
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let ``progress=True`` show a bar; everything else that ``progress`` may be stays as it is.

    Args:
        name: of the work.
        shares: as of `bar`.
    """

    def decorate(work: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(work)

        @wraps(work)
        def with_bar(*args: P.args, **kwargs: P.kwargs) -> R:
            given = signature.bind(*args, **kwargs)
            if given.arguments.get("progress") is not True:
                return work(*args, **kwargs)
            with bar(name, shares) as report:
                given.arguments["progress"] = report
                return work(*given.args, **given.kwargs)

        return with_bar

    return decorate


@contextmanager
def shown(name: str, shares: Shares | None = None) -> Iterator[Progress]:
    """A bar where stderr is a terminal, else one plain line a step.

    Args:
        name: of the work.
        shares: as of `bar`.
    """
    if not sys.stderr.isatty():
        yield lambda text: print(f"{name}: {text}", file=sys.stderr, flush=True)
        return
    with bar(name, shares) as report:
        yield report
