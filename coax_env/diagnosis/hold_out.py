"""Which runs to hold out: chosen from commands and signatures, never from residuals."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from coax_env.diagnosis.settings import Settings
from coax_env.diagnosis.unlisted import excitations
from coax_env.errors import InputError
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.state_space import Noise, Record, part

FAIR_SHARE = 0.25  # of the information on each effect that should be held out (contract: a quarter)
MOST_LOST = 0.7  # share of it beyond which the rest no longer determines the effect; ours
LEAST_SEEN = 0.1  # share below which its gain cannot be measured on the held-out runs; ours
UNFAIR = 10.0  # what one of those costs, in squared shares; ours


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
            [r for r in records if r.name not in hold_out],
            [r for r in records if r.name in hold_out],
        )
    if len(records) < settings.fewest_runs:
        return [_third(r, False) for r in records], [_third(r, True) for r in records]
    chosen = _fair_share(model, records, noise, candidates)
    return (
        [r for i, r in enumerate(records) if i not in chosen],
        [r for i, r in enumerate(records) if i in chosen],
    )


def _third(record: Record, last: bool) -> Record:
    cut = record.t[0] + (record.t[-1] - record.t[0]) * 2.0 / 3.0
    rows = record.t >= cut if last else record.t < cut
    return replace(part(record, rows), name=f"{record.name} (last third)" if last else record.name)


def _fair_share(
    model: HeliModel, records: Sequence[Record], noise: Noise, candidates: Sequence[str]
) -> tuple[int, ...]:
    """The quarter of the runs that holds out about a quarter of the information on each effect.

    Information is that of each effect's first parameter, and of a moment that follows the heading,
    about the vehicle as given and with the starting noise, so that no residual decides. An effect
    that would lose most of its excitation counts heavily; one that the held-out runs do not show at
    all counts too, since its gain could not be measured on them.
    """
    free = [model.effect_parameters(e)[0] for e in candidates] + excitations(model)
    values = {**model.bare_values, **{f.name: f.value for f in free}}
    _, lin = Engine(model, records).linearise(values, noise, free)
    information = np.einsum("rkk->rk", lin.information)
    total = information.sum(0)
    share = information[:, total > 0.0] / total[total > 0.0]
    count = max(1, round(FAIR_SHARE * len(records)))

    def unfairness(chosen: tuple[int, ...]) -> float:
        held = share[list(chosen)].sum(0)
        lost, unseen = np.maximum(held - MOST_LOST, 0.0), np.maximum(LEAST_SEEN - held, 0.0)
        return float(np.sum((held - FAIR_SHARE) ** 2) + UNFAIR * np.sum(lost + unseen))

    return min(combinations(range(len(records)), count), key=unfairness)
