"""Common to all scripts: shared arguments, exit codes, one-line errors."""

import argparse
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from tqdm import tqdm

from coax_env.errors import InputError
from coax_env.workers import BACKENDS

BAD_INPUT = 2
INTERRUPTED = 130
called_as_verb = False
"""Whether `coax diagnose` was called, and not scripts/diagnose.py (coax.py sets it)."""


class Parser(argparse.ArgumentParser):
    """An argument parser that complains in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"error: {message} (see --help)\n")


def parser(name: str, description: str, *, seed: bool = False) -> Parser:
    """A parser with ``--out`` and, where numbers are drawn, ``--seed``.

    Args:
        name: of the script; ``--out`` defaults to ``runs/NAME``.
        description: what ``--help`` shows first.
        seed: whether there is a ``--seed``.
    """
    result = Parser(prog=as_called(f"scripts/{name}.py"), description=description)
    result.add_argument(
        "--out", type=Path, default=Path("runs") / name, metavar="DIR",
        help="folder for the results (default: %(default)s)",
    )  # fmt: skip
    if seed:
        result.add_argument(
            "--seed", type=int, default=0, help="of the random numbers (default: 0)"
        )
    return result


def add_flight(parser: Parser) -> None:
    """A flight folder, and ``--vehicle`` where not the card's."""
    parser.add_argument("flight", type=Path, help="flight folder")
    parser.add_argument("--vehicle", help="shipped name or TOML file (default: the card's)")


def add_workers(parser: Parser, what: str, default: int) -> None:
    """``--jobs`` and ``--backend``, for `coax_env.workers.each`.

    Args:
        parser: to which they are added.
        what: is worked on at once, such as ``"seeds"``.
        default: of ``--jobs``; -1: all cores.
    """
    usual = "all cores" if default < 0 else f"{default}; -1: all cores"
    parser.add_argument(
        "--jobs", type=_jobs, default=default, help=f"{what} at once (default: {usual})"
    )
    parser.add_argument(
        "--backend", choices=BACKENDS, default="loky",
        help="joblib's own processes, or a Ray cluster (RAY_ADDRESS; else a local one)",
    )  # fmt: skip


def _jobs(text: str) -> int:
    if not re.fullmatch(r"[+-]?\d+", text) or int(text) == 0:
        raise argparse.ArgumentTypeError(f"must be a whole number and not 0, found {text!r}")
    return int(text)


def as_called(text: str) -> str:
    """Text that names scripts, with `coax diagnose` for `scripts/diagnose.py` where that was called."""
    if not called_as_verb:
        return text
    return re.sub(r"\bscripts/(\w+)\.py", r"coax \1", text)


def print_columns(rows: Sequence[Sequence[str]]) -> None:
    """Rows of words in aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        print("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip())


@contextmanager
def progress(name: str) -> Iterator[Callable[[str], None]]:
    """A spinner with the time and what is being done; one plain line a step where output is a file."""
    if not sys.stderr.isatty():
        yield lambda text: print(f"{name}: {text}", file=sys.stderr, flush=True)
        return
    with tqdm(bar_format="{desc} [{elapsed}]", desc=name) as bar:
        stop = threading.Event()

        def tick() -> None:
            while not stop.wait(0.5):
                bar.refresh()

        thread = threading.Thread(target=tick, daemon=True)
        thread.start()
        try:
            yield lambda text: bar.set_description_str(f"{name}: {text}")
        finally:
            stop.set()
            thread.join()


def run(main: Callable[[], None]) -> NoReturn:
    """Call ``main`` and leave with the project's exit codes: 0, 2 bad input, 130 Ctrl-C, else 1."""
    try:
        main()
    except InputError as error:
        print("error:", as_called(str(error)), file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except BrokenPipeError:  # whoever read our output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    sys.exit(0)
