"""Which runs to hold out: chosen from commands and signatures, never from residuals."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from coax_env.diagnosis.settings import Settings
from coax_env.diagnosis.unlisted import excitation
from coax_env.errors import InputError
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.prediction import EVERY, WARM_UP
from coax_env.estimation.state_space import Noise, Record, part

FAIR_SHARE = 0.25  # of the information on each effect that should be held out: a quarter
MOST_LOST = 0.6  # share of it beyond which the rest no longer determines the effect; ours
LEAST_SEEN = 0.1  # share below which its gain cannot be measured on the held-out runs; ours
UNFAIR = 10.0  # what one of those costs, in squared shares; ours
UNDETERMINED = 1000.0
"""And what is lost beyond MOST_LOST: every effect stays excited; ours."""
MOST_TIME = 1.0 / 3.0  # of the flown time that is held out at most; ours
LEAST_FAIRER = 1e-9  # squared shares by which an exchange must be fairer: beyond rounding


def check_hold_out(names: Sequence[str] | None, runs: Sequence[str]) -> None:
    """Refuse to hold out every run.

    Raises:
        InputError: nothing would be left to fit on.
    """
    if names and set(names) == set(runs):
        raise InputError("all runs are held out: nothing is left to fit on")


def split(
    model: HeliModel,
    records: Sequence[Record],
    noise: Noise,
    hold_out: Sequence[str] | None,
    candidates: Sequence[str],
    settings: Settings,
) -> tuple[list[Record], list[Record]]:
    """Records to fit and records to hold out.

    Args:
        model: with the vehicle as given.
        records: all runs.
        noise: levels to start from.
        hold_out: names of runs; None chooses them; empty: all are fitted.
        candidates: effects that may be named.
        settings: what decides.
    """
    if hold_out is not None:
        return (
            [r for r in records if r.whole not in hold_out],
            [r for r in records if r.whole in hold_out],
        )
    if len({r.whole for r in records}) < settings.fewest_runs:
        # a third in which nothing could be predicted is fitted, too
        least = 3.0 * (WARM_UP + settings.horizon + EVERY)
        parted = [r for r in records if r.t[-1] - r.t[0] >= least]
        whole = [r for r in records if r.t[-1] - r.t[0] < least]
        return whole + [_third(r, False) for r in parted], [_third(r, True) for r in parted]
    chosen = _fair_share(model, records, noise, candidates)
    return (
        [r for r in records if r.whole not in chosen],
        [r for r in records if r.whole in chosen],
    )


def _third(record: Record, last: bool) -> Record:
    cut = record.t[0] + (record.t[-1] - record.t[0]) * 2.0 / 3.0
    rows = record.t >= cut if last else record.t < cut
    if not last:
        return part(record, rows)
    name, run = (f"{name} (last third)" for name in (record.name, record.whole))
    return replace(part(record, rows), name=name, run=run)


def _fair_share(
    model: HeliModel, records: Sequence[Record], noise: Noise, candidates: Sequence[str]
) -> list[str]:
    """Runs that hold out about a quarter of the information on each effect.

    Information is that of all an effect's parameters about the vehicle as given, with the starting
    noise, so that no residual decides; beside the effects counts how much the runs move each state and
    command, which something that no list has may follow. An effect that would lose most of its
    excitation counts heavily; one that the held-out runs do not show at all counts too, since its gain
    could not be measured on them.
    """
    own = {e: model.effect_parameters(e) for e in candidates}
    free = [f for group in own.values() for f in group]
    values = {**model.bare_values, **{f.name: f.value for f in free}}
    passes, lin = Engine(model, records).linearise(values, noise, free)
    runs = tuple(dict.fromkeys(r.whole for r in records))
    of_run = np.array([[float(r.whole == run) for r in records] for run in runs])
    information = of_run @ np.einsum("rkk->rk", lin.information)
    ends = np.cumsum([0, *(len(group) for group in own.values())])
    groups = [information[:, a:b] for a, b in pairwise(ends)]
    groups += [of_run @ moved for moved in excitation(model, values, passes).values()]
    shares, weights = _shares(groups)
    seconds = of_run @ np.array([r.t[-1] - r.t[0] for r in records])
    return [runs[i] for i in fair_part(shares, weights, seconds / seconds.sum())]


def _shares(groups: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Each run's share of every column, (runs, k), and the columns' weights (k,): one per group."""
    shares, weights = [], []
    for group in groups:
        there = group[:, group.sum(0) > 0.0]
        shares.append(there / there.sum(0))
        weights.append(np.full(there.shape[1], 1.0 / max(there.shape[1], 1)))
    return np.hstack(shares), np.concatenate(weights)


def fair_part(shares: np.ndarray, weights: np.ndarray, seconds: np.ndarray) -> list[int]:
    """Runs whose part of every column is fairest, taken and then exchanged one by one.

    Args:
        shares: of each run in every column, (runs, k).
        weights: of the columns, (k,).
        seconds: share of the flown time of each run, (runs,).
    """

    def unfairness(held: np.ndarray) -> np.ndarray:
        lost, unseen = np.maximum(held - MOST_LOST, 0.0), np.maximum(LEAST_SEEN - held, 0.0)
        return np.asarray(
            ((held - FAIR_SHARE) ** 2 + UNFAIR * unseen + UNDETERMINED * lost) @ weights
        )

    chosen: list[int] = []
    while True:
        rest = [i for i in range(len(seconds)) if i not in chosen]
        best, least = chosen, np.inf
        for out in (None, *chosen):  # one more, or one in the place of another
            kept = [j for j in chosen if j != out]
            costs = unfairness(shares[kept].sum(0) + shares[rest])
            costs[seconds[kept].sum() + seconds[rest] > MOST_TIME] = np.inf
            if rest and costs.min() < least:
                best, least = [*kept, rest[int(np.argmin(costs))]], float(costs.min())
        if chosen and least >= unfairness(shares[chosen].sum(0)) - LEAST_FAIRER:
            return sorted(chosen)
        chosen = best or [int(np.argmin(seconds))]
