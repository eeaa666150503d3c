"""How strong process noise is and when, where it is not the same all along: gusts in single shocks.

A likelihood of Gaussian noise with one level per flight takes a shock for a push that some effect must
explain. Here each block of time has a factor on the noise's intensity, with a log-normal prior; the
factors are those of largest posterior. Held fixed, they leave the filter a Gaussian one, which believes
its prediction less where the air was rough (stochastic volatility: Harvey, Ruiz and Shephard 1994, Rev.
Econ. Stud. 61; a scale mixture of Gaussians, as Student's t is one).

With what a block's noise shows, S, and what was expected of it, E, both half the sum of its whitened
squares, the log-posterior of the logarithm l of its factor is never below

    - E exp(l - l0) - S exp(l0 - l) - l^2 / (2 SPREAD^2)

and touches it at l0, where S and E were taken (minorisation-maximisation: Zhou, Hu, Zhou and Lange
2019, J. Comput. Graph. Stat. 28). That is one number at a time, whatever the others do.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.estimation.engine import Engine
from coax_env.estimation.linearised_runs import blocks_of
from coax_env.estimation.state_space import Noise, Record, Strength

BLOCK = 0.25
"""s that have one strength: shorter than a gust that moves a machine of this size; ours."""
SPREAD = 2.0
"""Std of the logarithm of the factor. Log chi-square of 3 degrees of freedom has 0.97, which makes the
noise Student's t with as many; single gusts are many times as strong as the calm between; ours."""
TURNS = 8
"""Of the fixed point: the last of them gains a nat in a hundred; ours."""
NEWTON_STEPS = 8
"""Of a number at a time: from anywhere within a thousandth; ours."""


def with_strengths(
    engine: Engine, values: Mapping[str, float], noise: Noise, entries: np.ndarray
) -> list[Record]:
    """The engine's records with the strength of some of their process noise, by blocks of time.

    Args:
        engine: model and records, whose strengths are where it begins.
        values: of the parameters, held. noise: levels, held.
        entries: (k,) of the process noise's entries whose strength may change with time.
    """
    records = [_parted(record, len(engine.model.noise_places)) for record in engine.records]
    for _ in range(TURNS):
        there = Engine(engine.model, records, engine.threads)
        _, shown, expected = there.strength_slopes(values, noise)
        records = [_moved(*of, entries) for of in zip(records, shown, expected, strict=True)]
    return records


def prior_cost(records: Sequence[Record]) -> float:
    """Minus the log prior of the records' strengths, but for a constant [nats]; 0 where all are 1."""
    steps = (np.log(record.strength.factor) for record in records if not record.strength.steady)
    return sum(float(np.sum(logs**2)) for logs in steps) / (2.0 * SPREAD**2)


def _parted(record: Record, entries: int) -> Record:
    if not record.strength.steady:
        return record
    block = blocks_of(record.t, BLOCK)
    return replace(record, strength=Strength(block, np.ones((int(block[-1]) + 1, entries))))


def _moved(record: Record, shown: np.ndarray, expected: np.ndarray, entries: np.ndarray) -> Record:
    factor = record.strength.factor.copy()
    before = np.log(factor[:, entries])
    logs = _largest(before, shown[:, entries], expected[:, entries])
    factor[:, entries] = np.exp(logs)
    return replace(record, strength=record.strength._replace(factor=factor))


def _largest(before: np.ndarray, shown: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Where the bound of the module's docstring is largest: Newton, element by element.

    From where the larger of its two exponentials alone would end, the bound's slope being concave
    beyond it.
    """
    logs = before + np.arcsinh(0.5 * (shown - expected) / np.sqrt(shown * expected + 1e-12))
    logs = np.clip(logs, before - 3.0, before + 3.0)
    for _ in range(NEWTON_STEPS):
        less = expected * np.exp(logs - before)
        more = shown * np.exp(before - logs)
        logs = logs + (more - less - logs / SPREAD**2) / (more + less + 1.0 / SPREAD**2)
    return logs
