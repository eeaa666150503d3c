"""Common to all scripts: shared arguments, exit codes, one-line errors."""

import argparse
import os
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

try:
    from coax_env.errors import InputError, MissingPackage
    from coax_env.files import read_toml, write_text
    from coax_env.progress import shown
    from coax_env.workers import BACKENDS
except ModuleNotFoundError as missing:  # a Python that is not the one of .venv
    print(
        f"error: {sys.executable} has no {missing.name}: scripts/demo or scripts/test sets up "
        f".venv once, then .venv/bin/python {sys.argv[0]}",
        file=sys.stderr,
    )
    sys.exit(2)  # BAD_INPUT

progress = shown
"""A bar with the step and the time; one plain line a step where output is a file."""
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


def add_waive(parser: Parser) -> None:
    """``--waive``, for a log that contradicts itself and is right all the same."""
    parser.add_argument(
        "--waive", action=Waived, default=[], metavar="CHECK,CHECK",
        help="checks of the log with itself to pass over (check_flight names those that fail)",
    )  # fmt: skip


def add_since(parser: Parser) -> None:
    """``--since``, of an edit of a log."""
    parser.add_argument(
        "--since", type=lambda text: named_number(text, ":", "RUN:T"), metavar="RUN:T",
        help="from this moment on [s]: earlier runs and earlier rows stay",
    )  # fmt: skip


def named_number(text: str, separator: str, form: str) -> tuple[str, float]:
    """A name and a number, as one word of the command line.

    Args:
        text: as typed. separator: the last one parts them. form: how it should read.

    Raises:
        ArgumentTypeError: it does not.
    """
    name, parted, number = text.rpartition(separator)
    try:
        return (name if parted else text), float(number if parted else "")
    except ValueError:
        raise argparse.ArgumentTypeError(f"should be {form}, found {text!r}") from None


class Waived(argparse.Action):
    """Names parted by commas; the option may be given several times."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[object] | None,
        option_string: str | None = None,
    ) -> None:
        """Add the names."""
        names = [name.strip() for name in str(values).split(",") if name.strip()]
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), *names])


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


def numbers(words: Sequence[str], option: str) -> dict[str, float]:
    """Numbers by name, from NAME=VALUE and TOML files of such lines.

    Args:
        words: of the command line.
        option: they were given to, for what is said where they are wrong.
    """
    found: dict[str, float] = {}
    for word in words:
        name, sign, value = word.partition("=")
        items = {name: value}.items() if sign else read_toml(word).items()
        for key, number in items:
            try:
                if isinstance(number, bool):
                    raise TypeError
                found[key] = float(number)
            except (TypeError, ValueError) as error:
                place = option if sign else f"{option} {word}"
                raise InputError(f"{place}: {key} must be a number, found {number!r}") from error
    return found


def add_air(parser: Parser) -> None:
    """``--wind`` and ``--turbulence``, for `air`."""
    parser.add_argument(
        "--wind", nargs="+", metavar="M/S",
        help="north east; a speed from anywhere; or LOWEST..HIGHEST, drawn for every flight; it acts on"
        " vehicles with drag or blow-back, as lama400d_outdoor",
    )  # fmt: skip
    parser.add_argument("--turbulence", help="Dryden's: light, moderate, severe, or m/s at 6 m")


def air(options: argparse.Namespace) -> dict[str, Any]:
    """The env's ``wind`` and ``turbulence``, where they were asked for."""
    found: dict[str, Any] = {}
    if options.wind:
        low, dots, high = options.wind[0].partition("..")
        words = [low, high] if dots else options.wind
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if not numbers or len(numbers) > 2 or (dots and len(options.wind) > 1):
            raise InputError(
                f"--wind is NORTH EAST, a speed, or LOWEST..HIGHEST, found {' '.join(options.wind)!r}"
            )
        found["wind"] = {"speed": tuple(numbers)} if dots else numbers
    if options.turbulence:
        try:
            found["turbulence"] = float(options.turbulence)
        except ValueError:
            found["turbulence"] = options.turbulence
    return found


def _jobs(text: str) -> int:
    if not re.fullmatch(r"[+-]?\d+", text) or int(text) == 0:
        raise argparse.ArgumentTypeError(f"must be a whole number and not 0, found {text!r}")
    return int(text)


def as_called(text: str) -> str:
    """Text that names scripts, with `coax diagnose` for `scripts/diagnose.py` where that was called."""
    if not called_as_verb:
        return text
    return re.sub(r"\bscripts/(\w+)\.py", r"coax \1", text)


def typed(name: str) -> str:
    """The command line as it was typed: what makes the results again.

    Args:
        name: of the script.
    """
    return as_called(f"scripts/{name}.py {shlex.join(sys.argv[1:])}")


def print_columns(rows: Sequence[Sequence[str]]) -> None:
    """Rows of words in aligned columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        print("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip())


def write_report(path: Path, make: Callable[[], str]) -> str:
    """Write a report after all other results, and say where; or why there is none.

    Args:
        path: of the page.
        make: the page; what it needs may not be installed.
    """
    try:
        write_text(path, make())
    except MissingPackage as error:
        return f"no report: {error}"
    return f"report {path}"


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
