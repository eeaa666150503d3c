"""Air of each run's own: gusts of another strength and memory than those of the other runs.

Flights are flown on several days, in several places, near walls and far from them. Noise of one level
believes the model too little on a calm run, and takes each strong gust of a rough one for what an
effect has to explain; with a memory that is wrong it does so all along. Here each run has its own
levels, times the common ones, each under a log-normal prior: the ones of largest posterior. Air that is
rougher pushes more along every axis and turns more about each, so that a level is looked for about what
the run's levels of its kind, strengths or memories, are in the median.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter_noise import MEMORIES
from coax_env.estimation.linearised_runs import blocks_of
from coax_env.estimation.noise_levels import fit_noise, level_slopes
from coax_env.estimation.state_space import Noise, Record

Air = Mapping[str, float]  # level -> times the common one

SPREAD = 1.0
"""Std of the logarithm of a run's level about the common one: a factor of 2.7, between a room and a
windy day; ours."""
APART = 0.5
"""Std of the logarithm of a run's level about those of its kind; ours."""
EVALUATIONS = 12
"""Of a run's likelihood, at most; ours."""
TOLERANCE = 0.5
"""Gain that ends a run's fit [nats]; ours."""


def gain_promised(
    engine: Engine, values: Mapping[str, float], noise: Noise, levels: Sequence[str]
) -> float:
    """What levels of each run's own promise beyond chance, by their score at the common ones [nats].

    A score is taken to scatter from block to block as it does over all runs. Rough ones make that more,
    so that less is promised than there is: 100 to 180 nats of 460 to 5,200 on four **synthetic**
    flights in such air, -12 to 7 on six in other air.

    Args:
        engine: model and records. values: of the parameters. noise: of all runs.
        levels: which a run may have of its own. Each promises half a nat by chance.
    """
    score = engine.noise_score(values, noise)
    run_of = np.repeat(np.arange(len(engine.records)), [blocks_of(r.t)[-1] + 1 for r in engine.records])
    promised = 0.0
    for name in levels:
        parts, _ = level_slopes(engine, values, noise, name, score)
        slope, count = np.bincount(run_of, parts), np.bincount(run_of)
        information = count * parts.var() + 1.0 / SPREAD**2
        promised += float(np.sum(0.5 * slope**2 / information - 0.5))
    return promised


def in_own_air(
    engine: Engine, values: Mapping[str, float], noise: Noise, levels: Sequence[str]
) -> list[Record]:
    """The engine's records, each with levels of its own.

    Args:
        engine: model and records, whose own levels are where it begins.
        values: of the parameters, held. noise: of all runs, held. levels: which a run has of its own.
    """

    def of_run(i: int) -> Record:
        record = engine.records[i]
        alone = Engine(engine.model, [replace(record, air={})], threads=1)

        def fitted(begun: Air, median: Air, spread: float) -> Air:
            prior = {n: (median.get(n, 1.0) * noise.level(n), spread) for n in levels}
            start = replace(noise.times(begun), prior=prior)
            own = fit_noise(alone, values, start, levels, EVALUATIONS, TOLERANCE)
            return {n: own.level(n) / noise.level(n) for n in levels}

        median = _by_level(fitted(record.air, {}, SPREAD))
        return replace(record, air=fitted(median, median, APART))

    return engine.each(of_run)


def strength_and_memory(air: Air) -> tuple[float, float]:
    """Times that a run's gusts are as strong, and last as long, as common ones, in the median.

    Args:
        air: of the run. Of a kind of which it has no level: 1.
    """
    logs: tuple[list[float], list[float]] = ([], [])
    for name, factor in air.items():
        logs[name in MEMORIES].append(math.log(factor))
    strength, memory = (math.exp(np.median(kind)) if kind else 1.0 for kind in logs)
    return strength, memory


def _by_level(air: Air) -> Air:
    """What each level's kind is in the median."""
    kinds = strength_and_memory(air)
    return {name: kinds[name in MEMORIES] for name in air}


def unlikely(records: Sequence[Record]) -> float:
    """What the levels of the runs' own cost under their prior [nats]."""
    return sum(_unlikely(record.air) for record in records)


def _unlikely(air: Air) -> float:
    medians = _by_level(air)
    apart = [math.log(factor / medians[name]) / APART for name, factor in air.items()]
    usual = [math.log(factor) / SPREAD for factor in strength_and_memory(air)]
    return 0.5 * float(np.sum(np.square([*apart, *usual])))
