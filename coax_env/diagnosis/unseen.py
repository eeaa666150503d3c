"""What each cause is worth on the runs that were held out, beside what it should be worth there.

With a cause the parameters are elsewhere than without it, by d. If it acts as fitted, the held-out runs
are likelier with it by a number whose mean is d'Gd/2, G being their information, and whose variance is
d'Gd, times the inflation by coloured innovations, and d'GPGd, P being the covariance of what was
fitted; if it does not act, the mean is -d'Gd/2 (the log-likelihood ratio of two normal models: Cox and
Hinkley 1974, Theoretical Statistics, ch. 9). Noise levels that are fitted without a strong cause take
up most of it: what is to be expected is as many times less as on the runs that were fitted. Where the
held-out runs show little of a cause, nothing is said.

Of 19 true causes on fresh **synthetic** flights of 19 classes (`study_diagnosis.py --arms all --seed
843`) 18 were worth something there; one was not, of which 0.3 nats were to be expected. A centre of
gravity that is not there, of 166 nats on the seven runs that were fitted, should have been worth 12 +-
5 on the one held out, and was worth 1. What is far from a straight line, as a delay, may be worth many
times what is to be expected.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from coax_env.diagnosis.evidence import Evidence
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.engine import Engine
from coax_env.estimation.quadratic import Quadratic

BY_CHANCE = 2.0
"""Std that what is found may be below what is to be expected."""
LITTLE = 3.0
"""nats, odds of 20, that a cause is worth at most on runs that deny it, where it should be worth more;
ours."""


@dataclass(frozen=True)
class Unseen:
    """Of runs that were not fitted. nats: by which they are likelier with a cause. expected, std: what
    that should be, if it acts there as fitted."""

    nats: float
    expected: float
    std: float

    def entry(self) -> dict[str, float]:
        """findings.json's `unseen`."""
        return asdict(self)

    @property
    def likelier_without(self) -> bool:
        """Whether the runs are likelier without the cause."""
        return self.nats < 0.0

    @property
    def denied(self) -> bool:
        """Whether it is worth nothing there, although it should be, beyond chance."""
        least = self.expected - BY_CHANCE * self.std
        return self.expected > LITTLE and self.nats < min(LITTLE, least)


def worth_unseen(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    evidence: Mapping[str, Evidence],
    held: Engine | None,
) -> dict[str, Unseen]:
    """Of each cause, against the fit without it.

    Strengths and levels of the held-out runs' own air are those beside the causes.

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit.
        evidence: of the causes, with the fits without them and the inflation of their variances.
        held: of the runs held out, as fitted. Of none nothing is said, nor where a filter diverges.
    """
    if held is None or not fit.active:
        return {}
    free = problem.free(fit.active)
    names = [f.name for f in free]
    _, there = held.linearise(fit.values, fit.noise, free, gains=False)
    G, P = there.information.sum(0), quadratic.covariance(names)
    of_fitted = quadratic.G[np.ix_(*2 * [quadratic.index(names)])]
    likelihood = held.log_likelihood(fit.values, fit.noise)

    def of(rest: Fit, inflation: float) -> Unseen:
        d = np.array([fit.values[name] - rest.values[name] for name in names])
        shown, of_fit = float(d @ G @ d), float(d @ G @ P @ G @ d)
        lost = max(rest.objective - fit.objective, 0.0)
        left = 2.0 * lost / max(float(d @ of_fitted @ d), 2.0 * lost, 1.0)  # of nothing, nothing
        return Unseen(
            likelihood - held.log_likelihood(rest.values, rest.noise),
            0.5 * left * shown,
            math.sqrt(left * shown * inflation + left**2 * of_fit),
        )

    found = {effect: of(one.rest, one.inflation) for effect, one in evidence.items() if one.rest}
    return {effect: worth for effect, worth in found.items() if math.isfinite(worth.nats)}
