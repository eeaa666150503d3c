"""Where in the flights a cause is worth its nats, beside where they would show it.

With a cause the whitened innovations are e, without it, at the same noise, e + d: the flights show most
of it where d is large, after large commands and at speed, and that is often a small part of the time.
What acts is worth its nats there: |d|^2 / 2 in the mean. What a pilot's answers to gusts that no
reading has shown yet make look late or weak is there all the time, in quiet air and at rest, and a
large command denies it. On clean **synthetic** flights by a camera motor lags of 30 to 48 nats lost
15 to 24 where half of them should have been gained, in a sixteenth of the time; a true one, of 226,
gained 78.

Blocks of half a second are taken from the one that shows most on. In those that show three quarters of
a cause, the nats gained *beyond an even spread* are those that such answers do not gain: -23 to 2 for
32 such effects of 15 to 48 nats on nine clean flights, and 13, 22, 26, 77 and 115 for true ones of 42,
64, 175, 226 and 283.

In those that show half of it, its size there in parts of what was fitted is 1 + d'e / |d|^2, with a std
of 1 / |d|, less what they have in common. Another size says that something of another form acts: a
plate whose rate is limited was a servo's lag of 76 nats, sure, and 1.6 times as late after large steps
(Maine and Iliff 1985, NASA RP-1138: residuals that follow a sensitivity; a score test).
"""

import math
from dataclasses import asdict, dataclass

import numpy as np

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.parted_engine import PartedEngine

BLOCK = 0.5
"""s of flight taken together: an answer to a command, and as long as a gust; ours."""
HALF, MOST = 0.5, 0.75
"""Shares of what the flights show of a cause: for its size there, and for what it gains there; ours."""
BY_CHANCE = 4.0
"""Std by which a size there differs by chance: blocks are chosen, and forms a little wrong; ours."""
FORM = 0.25
"""Parts of its size that another form may differ there: 17 true causes of 18 arms differed by 0.10 at
most, but for servos that had another fault beside; ours."""
LEAST = 0.7
"""Parts of its size below which it does not act where it should show: true ones had 0.73 at least, lags
and delays that nobody hid 0.44 at most; ours."""


@dataclass(frozen=True)
class SizeWhereMost:
    """A cause's size where the flights show half of it, in parts of what was fitted.

    share: of the time, that it takes to show half. size, std: there; std allows for colour.
    """

    share: float
    size: float
    std: float

    def entry(self) -> dict[str, float]:
        """findings.json's `where_most`."""
        return asdict(self)

    @property
    def is_denied(self) -> bool:
        """Whether it is so much smaller there that what is there all the time stands for it."""
        return self.is_another and self.size < LEAST

    @property
    def is_another(self) -> bool:
        """Whether it differs, beyond chance and what a form may be wrong by."""
        return abs(self.size - 1.0) > max(BY_CHANCE * self.std, FORM)


@dataclass(frozen=True)
class _Blocks:
    """Of each block: what it shows of a cause |d|^2 / 2, d'e, and the nats that it gained."""

    shown: np.ndarray
    along: np.ndarray
    gained: np.ndarray

    def most(self, share: float) -> np.ndarray:
        """The blocks, fewest, that show this share of a cause."""
        order = np.argsort(-self.shown, kind="stable")
        told = np.cumsum(self.shown[order])
        return order[: 1 + int(np.searchsorted(told, share * told[-1]))]


def size_where_most(
    problem: Problem, fit: Fit, rest: Fit, inflation: float
) -> SizeWhereMost | None:
    """A cause's size where the flights show half of it; None where nothing is shown, or not of one
    machine.

    Args:
        problem, fit: with the cause. rest: without it.
        inflation: of its variance, by coloured innovations.
    """
    blocks = _blocks(problem, fit, rest)
    if blocks is None:
        return None
    there = blocks.most(HALF)
    shown = float(blocks.shown[there].sum())
    rest_of_it = 1.0 - shown / float(blocks.shown.sum())
    if rest_of_it <= 0.0:
        return None  # one block shows all
    in_all = float(blocks.along.sum() / blocks.shown.sum())
    size = 1.0 + 0.5 * (float(blocks.along[there].sum()) / shown - in_all)
    std = math.sqrt(inflation * rest_of_it / (2.0 * shown))
    return SizeWhereMost(there.size / blocks.shown.size, size, std)


def beyond_even_spread(problem: Problem, fit: Fit, rest: Fit) -> float:
    """Nats that a cause gains where the flights show most of it, less the share of all that so much
    time has; less than any where that is not known.

    Args:
        problem, fit: with the cause. rest: without it, with its own noise.
    """
    blocks = _blocks(problem, fit, rest, gained=True)
    if blocks is None:
        return -math.inf
    there = blocks.most(MOST)
    evenly = there.size / blocks.shown.size * float(blocks.gained.sum())
    return float(blocks.gained[there].sum()) - evenly


def _blocks(problem: Problem, fit: Fit, rest: Fit, gained: bool = False) -> _Blocks | None:
    """All runs' blocks; None where a filter diverges, nothing is shown, or machines are compared."""
    engine = problem.engine
    if isinstance(engine, PartedEngine):
        return None
    with_it = engine.by_reading(fit.values, fit.noise)
    without = engine.by_reading(rest.values, fit.noise)
    there = engine.by_reading(rest.values, rest.noise) if gained else without
    parts = []
    for record, own, other, free in zip(engine.records, with_it, without, there, strict=True):
        e = own.innovations
        read = np.isfinite(e)
        if not all((np.isfinite(of.innovations) == read).all() for of in (other, free)):
            return None
        d = other.innovations - e
        rows = np.stack((0.5 * d * d, d * e, own.nats - free.nats))
        parts.append(_summed(record.t, np.sum(rows, axis=2, where=read, initial=0.0)))
    blocks = _Blocks(*np.concatenate(parts, axis=1))
    return blocks if blocks.shown.sum() > 0.0 else None


def _summed(t: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Sums over the blocks of a run, (k, blocks), of what its rows (k, n) have."""
    block = np.floor((t - t[0]) / BLOCK).astype(np.int64)
    return np.stack([np.bincount(block, of_rows) for of_rows in rows])
