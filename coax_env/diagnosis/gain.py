"""What correcting the model gains: prediction error before and after, on runs it has not seen.

Per channel e^2 = max(rms^2 - noise_rms^2, 0); the share removed is one minus the mean of
e_after/e_before. Intervals by a block bootstrap over runs and blocks of starts. A channel whose bare
error is not told from its sensor's noise has a ratio by chance, which may be 3: what is removed is
given without such channels, too.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coax_env.estimation.prediction import COMPARED, RunReplay
from coax_env.model.layout import CHANNEL_UNITS

BLOCK = 8  # starts, 2 s
DRAWS = 400
LEAST_BLOCKS = 4
"""Blocks of few starts are shorter, down to one each, for so many: of one block every draw is the same,
as though nothing were by chance; ours."""
TOO_SHORT = "what was held out is too short, or has too many gaps, to be flown: no gain is measured"
"""For who reads the findings."""


def gain_of(
    before: Sequence[RunReplay],
    refitted: Sequence[RunReplay],
    after: Sequence[RunReplay],
    noise: Mapping[str, float],
    horizon: float,
    black_box: Sequence[RunReplay] = (),
) -> dict[str, Any] | None:
    """The `gain` of findings.json, without the names of the held-out runs; None where none was flown.

    Args:
        before, refitted, after: the held-out runs flown by the bare, refitted and corrected model.
        noise: the sensors' std by channel.
        horizon: seconds flown.
        black_box: the same runs flown by a flexible model.
    """
    block = _block_of(before)
    sums = [_block_sums(runs, block) for runs in (before, refitted, after)]
    channels = [c for c in COMPARED if all(c in s for s in sums)]
    if not channels:
        return None
    rng = np.random.default_rng(0)
    # own: arch's block bootstrap needs one evenly sampled series, and pandas; these are runs of blocks
    blocks = len(sums[0][channels[0]])
    draws = rng.integers(0, blocks, (DRAWS, blocks))
    noise_rms = {c: noise[c] for c in channels}
    rms = [{c: _rms(s[c]) for c in channels} for s in sums]
    unmoved = {
        c: _rms(s) for c, s in _block_sums(after, block, still=True).items() if c in channels
    }
    drawn = [{c: _rms(s[c][draws].transpose(1, 0, 2)) for c in channels} for s in sums]
    table = {
        c: {
            "before": _number(rms[0][c]),
            "before_refitted": _number(rms[1][c]),
            "after": _number(rms[2][c]),
            "persistence": _number(unmoved.get(c, np.nan)),
            "noise": float(noise_rms[c]),
            "unit": CHANNEL_UNITS[c],
            "ci95": _interval(drawn[2][c]),
        }
        for c in channels
    }
    floor = {
        c: np.hypot(noise_rms[c], np.sqrt(np.mean([r.floor.get(c, 0.0) ** 2 for r in after])))
        for c in channels
    }
    gained = removed(rms[0], rms[2], noise_rms)
    further: dict[str, Any] = {}
    if black_box:
        boxed = _block_sums(black_box, block)
        flexible = removed(rms[0], {c: _rms(boxed[c]) for c in channels}, noise_rms)
        further = {"black_box_percent": _number(flexible)}
    told = {c: level for c, level in noise_rms.items() if _is_told(drawn[0][c], level)}
    by_chance = [c for c in channels if rms[0][c] > noise_rms[c] and c not in told]
    if told and by_chance:
        further["beyond_noise"] = {
            "without": by_chance,
            "error_removed_percent": _number(removed(rms[0], rms[2], told)),
            "ci95": _interval(removed(drawn[0], drawn[2], told)),
        }
    return {
        "held_out": [],
        "horizon_s": horizon,
        "channels": table,
        "error_removed_percent": _number(gained),
        "ci95": _interval(removed(drawn[0], drawn[2], noise_rms)),
        "refitted_base_percent": _number(removed(rms[0], rms[1], noise_rms)),
        # an expectation beside a sample: a lucky gain may be above it, and is reported as it is
        "noise_floor_percent": _number(removed(rms[0], floor, noise_rms)),
        "persistence_percent": _number(
            removed(rms[0], unmoved, {c: noise_rms[c] for c in unmoved})
        ),
        **further,
    }


def flies_worse(gain: Mapping[str, Any] | None, begun: bool) -> bool:
    """Whether the corrected model flies the held-out runs worse than the bare one, beyond chance.

    Not where a cause began in flight: they may have been flown before.

    Args:
        gain: as of `gain_of`; None: nothing was held out. begun: whether a cause did.
    """
    most = None if gain is None else gain.get("beyond_noise", gain)["ci95"][1]
    return most is not None and most < 0.0 and not begun


def removed(before: Mapping[str, Any], after: Mapping[str, Any], noise: Mapping[str, float]) -> Any:
    """Percent of the error removed, averaged over channels that had any.

    Args:
        before, after: rms by channel, numbers or arrays of draws.
        noise: the sensors' rms by channel.
    """
    ratios = []
    for channel, level in noise.items():
        e_before = np.sqrt(np.maximum(np.square(before[channel]) - level**2, 0.0))
        e_after = np.sqrt(np.maximum(np.square(after[channel]) - level**2, 0.0))
        with np.errstate(invalid="ignore", divide="ignore"):
            ratios.append(np.where(e_before > 0.0, e_after / e_before, np.nan))
    if not ratios:
        return np.nan
    with np.errstate(invalid="ignore"):
        table = np.array(ratios)
        return 100.0 * (1.0 - _nanmean(table))


def _nanmean(table: np.ndarray) -> Any:
    there = np.isfinite(table)
    count = there.sum(0)
    total = np.where(there, table, 0.0).sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _starts(run: RunReplay) -> int:
    return max((f.error.size for f in run.channels.values()), default=0)


def _block_of(runs: Sequence[RunReplay]) -> int:
    """How many starts a block has."""
    return min(max(sum(map(_starts, runs)) // LEAST_BLOCKS, 1), BLOCK)


def _block_sums(
    runs: Sequence[RunReplay], block_of: int, still: bool = False
) -> dict[str, np.ndarray]:
    """Per channel: (blocks, 2) of summed squared error and count, over all runs that flew.

    The blocks are the same of every channel: one that a run does not read has nothing in its blocks.

    Args:
        runs: flown open loop. block_of: starts that a block has.
        still: the errors of the prediction that nothing changes.
    """
    flown = [run.still if still else {c: f.error for c, f in run.channels.items()} for run in runs]
    every = dict.fromkeys(channel for errors in flown for channel in errors)
    sums: dict[str, list[tuple[float, float]]] = {}
    for run, errors in zip(runs, flown, strict=True):
        size = max((error.size for error in errors.values()), default=0)
        for channel in every:
            error = errors.get(channel, np.full(size, np.nan))
            for first in range(0, size, block_of):
                block = error[first : first + block_of]
                block = block[np.isfinite(block)]
                if run.diverged:
                    block = block[:0]
                sums.setdefault(channel, []).append((float(np.sum(block**2)), float(block.size)))
    return {c: np.array(rows) for c, rows in sums.items()}


def _rms(sums: np.ndarray) -> Any:
    """RMS from (blocks, ..., 2) sums."""
    total = sums.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(total[..., 0] / total[..., 1])


def _is_told(drawn: np.ndarray, noise: float) -> bool:
    """Whether an error, (DRAWS,) of its rms, is more than the sensor's noise, by 97.5 % of them."""
    low, _ = _interval(drawn)
    return low is not None and low > noise


def _number(value: Any) -> float | None:
    value = float(value)
    return value if np.isfinite(value) else None


def _interval(draws: np.ndarray) -> list[float | None]:
    draws = draws[np.isfinite(draws)]
    if draws.size < DRAWS // 2:
        return [None, None]
    return [float(x) for x in np.percentile(draws, [2.5, 97.5])]
