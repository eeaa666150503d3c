"""The log-posterior to second order in many parameters at once: scores and covariances."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from coax_env.estimation.fit import Linearised, bounded_solve
from coax_env.estimation.state_space import FreeParameter


@dataclass(frozen=True)
class Quadratic:
    """The objective to second order about `at`, over every parameter that might be free."""

    names: tuple[str, ...]
    G: np.ndarray
    g: np.ndarray
    at: np.ndarray
    mean: np.ndarray
    precision: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    stretches: np.ndarray
    by_channel: np.ndarray

    @classmethod
    def of(
        cls, lin: Linearised, free: Sequence[FreeParameter], values: dict[str, float]
    ) -> "Quadratic":
        """The quadratic of a linearisation, summed over its runs."""
        return cls(
            lin.names,
            lin.information.sum(0),
            lin.slope.sum(0),
            np.array([values[f.name] for f in free]),
            np.array([f.value for f in free]),
            np.array([1.0 / f.std**2 for f in free]),
            np.array([f.lower for f in free]),
            np.array([f.upper for f in free]),
            lin.stretches,
            lin.by_channel.sum(0),
        )

    def index(self, names: Collection[str]) -> np.ndarray:
        """Places of parameters."""
        return np.array([self.names.index(n) for n in names], dtype=int)

    def best(
        self, free: Collection[str], pinned: dict[str, float] | None = None
    ) -> tuple[float, np.ndarray]:
        """Least change of the objective with `free` loose and `pinned` moved to given values.

        Returns the change [nats] and the move of every parameter.
        """
        move = np.zeros(len(self.names))
        pinned = pinned or {}
        fixed = self.index(pinned.keys())
        if fixed.size:
            move[fixed] = np.array(list(pinned.values())) - self.at[fixed]
        loose = self.index(free)
        if loose.size:
            A = self.G[np.ix_(loose, loose)] + np.diag(self.precision[loose])
            b = -(
                self.g[loose]
                + self.G[loose] @ move
                + self.precision[loose] * (self.at - self.mean)[loose]
            )
            move[loose] = bounded_solve(
                A, b, (self.lower - self.at)[loose], (self.upper - self.at)[loose]
            )
        away = self.at - self.mean
        change = (
            0.5 * move @ self.G @ move
            + self.g @ move
            + 0.5 * float(self.precision @ ((away + move) ** 2 - away**2))
        )
        return float(change), move

    def projected(
        self, own: Collection[str], rest: Collection[str]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Information of `own`, what `rest` could stand for taken out (priors on `rest`), (k, k).

        And how `rest` answers each of `own`, (r, k).
        """
        c, r = self.index(own), self.index(rest)
        across = self.G[np.ix_(r, c)]
        weights = np.linalg.solve(self.G[np.ix_(r, r)] + np.diag(self.precision[r]), across)
        return self.G[np.ix_(c, c)] - across.T @ weights, weights

    def covariance(self, free: Collection[str]) -> np.ndarray:
        """Posterior covariance of the loose parameters, (k, k)."""
        i = self.index(free)
        return np.linalg.inv(self.G[np.ix_(i, i)] + np.diag(self.precision[i]))

    def colour(self, own: Collection[str], free: Collection[str]) -> float:
        """How much more the slope of `own` scatters from stretch to stretch than white noise lets it.

        At a fitted point the projected slopes of separate stretches are independent with covariance
        equal to the information, where the innovations are white. What is above 1 is colour: the
        evidence is that many times too large, the variance that many times too small (the sandwich
        of Huber 1967, in the direction of one effect).
        """
        c = self.index(own)
        rest = [n for n in free if n not in set(own)]
        schur, weights = self.projected(own, rest)
        scores = self.stretches[:, c] - self.stretches[:, self.index(rest)] @ weights
        per_stretch = np.einsum(
            "sc,sc->s", scores, np.linalg.lstsq(schur, scores.T, rcond=None)[0].T
        )
        kept = np.sort(per_stretch)[
            : math.ceil(0.9 * per_stretch.size)
        ]  # a bad second is no colour
        value = kept.mean() * per_stretch.size / c.size
        return max(1.0, float(value)) if np.isfinite(value) else 1.0

    def occam(self, added: Collection[str], free: Collection[str]) -> float:
        """Laplace factor of `added` beside `free`: half log det (posterior over prior precision)."""
        precision = self.precision[self.index(added)]
        posterior = self.projected(added, free)[0] + np.diag(precision)
        scaled = posterior / np.sqrt(np.outer(precision, precision))
        return 0.5 * float(np.linalg.slogdet(scaled)[1])
