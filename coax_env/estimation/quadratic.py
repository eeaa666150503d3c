"""The log-posterior to second order in many parameters at once: scores and covariances."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import lsq_linear

from coax_env.estimation.state_space import FreeParameter


@dataclass(frozen=True)
class Linearised:
    """Likelihood to second order about a point, per run.

    Attributes:
        names: of the k parameters.
        information: Gram matrices of the signatures, (runs, k, k).
        slope: signatures times innovations, (runs, k).
        by_channel: squared signatures summed per channel, (runs, k, m).
        blocks: the slope again, by blocks of time, (blocks, k).
    """

    names: tuple[str, ...]
    information: np.ndarray
    slope: np.ndarray
    by_channel: np.ndarray
    blocks: np.ndarray


@dataclass(frozen=True)
class Quadratic:
    """Minus the log-posterior to second order about `at`, over every parameter that might be free.

    Attributes:
        names: of the k parameters.
        G: Gram matrix of the signatures, the information of the data, (k, k).
        g: slope of minus the log-likelihood, (k,).
        at: the point, (k,). mean, precision: of the independent normal priors, (k,).
        lower, upper: bounds, (k,).
        blocks: g by blocks of time, (blocks, k).
        by_channel: squared signatures summed per channel, (k, m).
        parts: the linearisation that it sums, run by run.
    """

    names: tuple[str, ...]
    G: np.ndarray
    g: np.ndarray
    at: np.ndarray
    mean: np.ndarray
    precision: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    blocks: np.ndarray
    by_channel: np.ndarray
    parts: Linearised | None = None

    @classmethod
    def of(
        cls, lin: Linearised, free: Sequence[FreeParameter], values: Mapping[str, float]
    ) -> "Quadratic":
        """The quadratic of a linearisation, summed over its runs.

        Args:
            lin: the linearisation.
            free: its parameters, with priors and bounds.
            values: where it was taken.
        """
        return cls(
            lin.names,
            lin.information.sum(0),
            lin.slope.sum(0),
            np.array([values[f.name] for f in free]),
            np.array([f.value for f in free]),
            np.array([1.0 / f.std**2 for f in free]),
            np.array([f.lower for f in free]),
            np.array([f.upper for f in free]),
            lin.blocks,
            lin.by_channel.sum(0),
            lin,
        )

    def of_parts(self, which: Sequence[int]) -> "Quadratic":
        """That of some runs alone, about the same point and under the same priors.

        The blocks stay those of all runs: a few runs are too few to tell their scatter.

        Args:
            which: indices of the runs.
        """
        assert self.parts is not None, "the quadratic was not made of a linearisation"
        chosen = list(which)
        return replace(
            self,
            G=self.parts.information[chosen].sum(0),
            g=self.parts.slope[chosen].sum(0),
            by_channel=self.parts.by_channel[chosen].sum(0),
        )

    def held_at(self, values: Mapping[str, float]) -> "Quadratic":
        """The same parabola about a point at which some parameters have other values.

        Its least values differ from this one's by a constant. Its parts and blocks stay this one's.

        Args:
            values: of these parameters.
        """
        i = self.index(values.keys())
        move = np.zeros(len(self.names))
        move[i] = np.array(list(values.values())) - self.at[i]
        return replace(self, at=self.at + move, g=self.g + self.G @ move)

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def index(self, names: Collection[str]) -> np.ndarray:
        """Places of parameters."""
        return np.array([self._places[n] for n in names], dtype=int)

    def moved(self, move: np.ndarray) -> dict[str, float]:
        """Values of all parameters after a move (k,)."""
        return dict(zip(self.names, (self.at + move).tolist(), strict=True))

    def best(
        self, free: Collection[str], fixed: Mapping[str, float] | None = None
    ) -> tuple[float, np.ndarray]:
        """Least value of the quadratic with `free` free, `fixed` moved to given values, the rest held.

        Returns:
            the change of the objective [nats] and the move of every parameter (k,).
        """
        move = np.zeros(len(self.names))
        fixed = fixed or {}
        given = self.index(fixed.keys())
        if given.size:
            move[given] = np.array(list(fixed.values())) - self.at[given]
        i = self.index(free)
        if i.size:
            A = self.G[np.ix_(i, i)] + np.diag(self.precision[i])
            b = -(self.g[i] + self.G[i] @ move + self.precision[i] * (self.at - self.mean)[i])
            move[i] = bounded_solve(A, b, (self.lower - self.at)[i], (self.upper - self.at)[i])
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
        """Information of `own` with `rest` projected out under its priors, (k, k).

        And the regression of `own` on `rest`, (r, k).
        """
        c, r = self.index(own), self.index(rest)
        across = self.G[np.ix_(r, c)]
        weights = np.linalg.solve(self.G[np.ix_(r, r)] + np.diag(self.precision[r]), across)
        return self.G[np.ix_(c, c)] - across.T @ weights, weights

    def covariance(self, free: Collection[str]) -> np.ndarray:
        """Posterior covariance of the free parameters, (k, k)."""
        i = self.index(free)
        return np.linalg.inv(self.G[np.ix_(i, i)] + np.diag(self.precision[i]))

    def std(self, free: Collection[str]) -> dict[str, float]:
        """Posterior std of each free parameter, all of them free."""
        return dict(zip(free, np.sqrt(np.diag(self.covariance(free))).tolist(), strict=True))

    def variance_inflation(self, own: Collection[str], free: Collection[str]) -> float:
        """How much more the score of `own` scatters between blocks than white innovations allow.

        At a fitted point the projected scores of separate blocks are independent with covariance
        equal to the information, where the innovations are white. What is above 1 comes of coloured
        innovations: the evidence is that many times too large, the variance that many times too small
        (the sandwich of Huber 1967, in the direction of one effect).
        """
        c = self.index(own)
        rest = [n for n in free if n not in set(own)]
        schur, weights = self.projected(own, rest)
        scores = self.blocks[:, c] - self.blocks[:, self.index(rest)] @ weights
        per_block = np.einsum("sc,sc->s", scores, np.linalg.lstsq(schur, scores.T, rcond=None)[0].T)
        # one bad second is no correlation: the largest tenth is left out
        kept = np.sort(per_block)[: math.ceil(0.9 * per_block.size)]
        value = kept.mean() * per_block.size / c.size
        return max(1.0, float(value)) if np.isfinite(value) else 1.0

    def occam(self, added: Collection[str], free: Collection[str]) -> float:
        """Laplace factor of `added` beside `free`: half log det (posterior over prior precision)."""
        precision = self.precision[self.index(added)]
        posterior = self.projected(added, free)[0] + np.diag(precision)
        scaled = posterior / np.sqrt(np.outer(precision, precision))
        return 0.5 * float(np.linalg.slogdet(scaled)[1])


def penalty(free: Sequence[FreeParameter], values: Mapping[str, float]) -> float:
    """Half the squared distance to the priors, nats."""
    return 0.5 * sum(((values[f.name] - f.value) / f.std) ** 2 for f in free)


def bounded_solve(A: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Minimise 1/2 x'A x - b'x within bounds (A positive definite), shape (k,).

    Bounded least squares on the Cholesky factor, in units of A's diagonal (Stark and Parker 1995).

    Args:
        A: (k, k). b: (k,).
        lower, upper: bounds of x, (k,), infinite where there is none.
    """
    unit = 1.0 / np.sqrt(np.diag(A))
    factor = cholesky(A * np.outer(unit, unit))
    target = solve_triangular(factor, b * unit, trans="T")
    x = solve_triangular(factor, target) * unit
    if np.any(x < lower) or np.any(x > upper):
        bounds = (np.minimum(lower, 0.0) / unit, np.maximum(upper, 0.0) / unit)
        x = lsq_linear(factor, target, bounds, method="bvls", tol=1e-12).x * unit
    return np.clip(x, lower, upper)
