"""Least squares and total least squares, with intervals that hold for coloured residuals.

y = X b, rows in time. Some columns of X are exact (the intercept, a command), the others and y carry
errors whose covariance from column to column is known up to a factor. Least squares takes all of X as
exact; total least squares takes the exact columns out by projection and minimises

    sum of (y - x b)^2 / [b; -1]' S [b; -1]

over the rest (Van Huffel and Vandewalle 1991, ch. 3 and 8: mixed, generalised), S the covariance of
a row's errors. Filtering leaves rows dependent, so the covariance of b is the sandwich of an
M-estimator with the scores' covariance summed over lags (Newey and West 1987; for least squares that
is the correction of Klein and Morelli 2006, ch. 5).

Sums over lags fail on a short record: the fit has taken from the residuals just what they remember
longest. Where draws of the errors are at hand, the scores' covariance is that of the draws, and
what the residuals have beyond them (gusts) counts as noise with a first-order memory, whose size and
memory are those of largest restricted likelihood (Patterson and Thompson 1971: the fit's share is
given back).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import eigh, solve, toeplitz
from scipy.signal import lfilter
from scipy.stats import t as student

LAGS_PER_MEMORY = 4.0
"""Lags summed, per row that residuals remember."""
GUST_SIZES = np.geomspace(0.02, 3.0, 24)
"""Variances of a gust that are tried, in those of the residual."""
GUST_MEMORIES = 7
"""How many memories of a gust are tried."""
LEAST_DISTANCE = 3.0
"""Standard errors by which the weakest direction must stand out of its own errors for total least
squares to be trusted: (r^2 - 1) sqrt(rows / 2), r = smin(X) / smin([X y])."""


@dataclass(frozen=True)
class Regression:
    """Result of a regression.

    names, values: (k,) coefficients. covariance: (k, k), coloured residuals counted. residual: (n,).
    rows: how many independent ones the residuals amount to. weakest: see LEAST_DISTANCE;
    infinite for least squares. method: "least squares" or "total least squares".
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    residual: np.ndarray
    rows: float
    weakest: float
    method: str

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (k,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def trusted(self) -> bool:
        """Whether the weakest direction stands out of the errors."""
        return self.weakest > LEAST_DISTANCE

    def interval(self, level: float = 0.95) -> np.ndarray:
        """Two-sided intervals (k, 2), Student's with as many degrees as independent rows are left."""
        degrees = max(self.rows - len(self.names), 1.0)
        reach = student.ppf(0.5 + 0.5 * level, degrees) * self.std
        return np.column_stack([self.values - reach, self.values + reach])


def least_squares(
    X: np.ndarray, y: np.ndarray, names: Sequence[str], runs: Sequence[int] = ()
) -> Regression:
    """Ordinary least squares.

    Args:
        X: (n, k). y: (n,). runs: rows of each run, in order; none: one run.
    """
    values, *_ = np.linalg.lstsq(X, y, rcond=None)
    residual = y - X @ values
    return _finished(X, residual, values, X.T @ X, names, runs, math.inf, "least squares")


def total_least_squares(
    X: np.ndarray,
    y: np.ndarray,
    names: Sequence[str],
    errors: np.ndarray,
    exact: Sequence[bool],
    runs: Sequence[int] = (),
    draws: np.ndarray | None = None,
) -> Regression:
    """Mixed, generalised total least squares.

    Args:
        X: (n, k). y: (n,). exact: (k,) True for columns without error.
        errors: covariance of a row's errors in the other columns and, last, in y; a factor common to
            all does not matter. Positive definite.
        runs: rows of each run, in order; none: one run.
        draws: (d, n, m) of those errors in the order of `errors`, for the covariance.
    """
    known = np.asarray(exact, bool)
    noisy = np.flatnonzero(~known)
    if noisy.size == 0:
        return least_squares(X, y, names, runs)
    k = X.shape[1]
    Z = np.column_stack([X[:, noisy], y])
    if known.any():
        basis, _ = np.linalg.qr(X[:, known])
        Z = Z - basis @ (basis.T @ Z)
    gram = Z.T @ Z
    levels, vectors = eigh(gram, errors)
    level, direction = levels[0], vectors[:, 0]
    values = np.zeros(k)
    values[noisy] = -direction[:-1] / direction[-1]
    if known.any():
        left = y - X[:, noisy] @ values[noisy]
        values[known] = np.linalg.lstsq(X[:, known], left, rcond=None)[0]
    residual = y - X @ values
    # what the criterion's slope makes of a row: x - (y - x b) S [b; -1] / ([b; -1]' S [b; -1])
    signed = np.append(values[noisy], -1.0)
    spread = errors @ signed
    instruments = X.astype(float).copy()
    instruments[:, noisy] += np.outer(residual, spread[:-1]) / float(signed @ spread)
    bread = X.T @ X
    bread[np.ix_(noisy, noisy)] -= level * errors[:-1, :-1]
    without_y = eigh(gram[:-1, :-1], errors[:-1, :-1], eigvals_only=True)[0]
    standing = without_y / max(level, 1e-300) - 1.0
    meat = None
    if draws is not None:
        off = draws @ -signed  # (d, n): what the errors make of y - x b
        meat = _from_draws(draws, off, instruments, noisy, spread / float(signed @ spread))
        meat = meat + _gusts(residual, instruments, off, list(runs) or [len(y)])
    return _finished(
        instruments, residual, values, bread, names, runs, standing, "total least squares", meat
    )


def _from_draws(
    draws: np.ndarray,
    off: np.ndarray,
    instruments: np.ndarray,
    noisy: np.ndarray,
    share: np.ndarray,
) -> np.ndarray:
    """Covariance of the scores that the errors make, from draws of them.

    The instruments at hand hold errors of their own already, which are independent of those drawn:
    what one draw's instruments make of another's errors is taken off again.
    """
    own = np.zeros((len(draws), *instruments.shape))
    own[:, :, noisy] = draws[:, :, :-1] + off[:, :, None] * share[:-1]
    whole = np.cov(np.einsum("dnk,dn->dk", instruments + own, off).T)
    foreign = np.cov(np.einsum("dnk,dn->dk", np.roll(own, 1, axis=0), off).T)
    whole, foreign = np.atleast_2d(whole), np.atleast_2d(foreign)
    kept, axes = eigh(whole - foreign, whole)
    back = whole @ axes  # axes' whole axes = 1
    return np.asarray(back @ np.diag(np.maximum(kept, 0.1)) @ back.T)


def _gusts(
    residual: np.ndarray, instruments: np.ndarray, off: np.ndarray, lengths: Sequence[int]
) -> np.ndarray:
    """Covariance of the scores from what shakes the residuals beyond their errors `off` (d, n)."""
    # rows so far apart that the filter no longer ties them: gusts in between are not filtered here
    step = max(1, math.ceil(1.3 * _memory(off[0], lengths)))
    edges = np.concatenate([[0], np.cumsum(lengths)])
    blocks = [np.arange(edges[k], edges[k + 1], step) for k in range(len(lengths))]
    most = max(len(block) for block in blocks)
    shape = _autocovariance(off, lengths, step * most)[::step]
    size = float(residual.var())
    levels = size * GUST_SIZES
    # beyond a quarter of a run, what is remembered is confounded with the offset
    memories = np.geomspace(step, max(min(lengths) / 4.0, 2.0 * step), GUST_MEMORIES)
    best, level, memory = -math.inf, 0.0, 1.0
    for tau in memories:
        parts = []
        for block in blocks:
            lag = np.arange(len(block))
            D = toeplitz(shape[: len(block)]) + 1e-3 * shape[0] * np.eye(len(block))
            w, turn = eigh(toeplitz(np.exp(-step * lag / tau)), D)
            parts.append((w, turn.T @ residual[block], turn.T @ instruments[block]))
        for s in (0.0, *levels):
            log_likelihood = 0.0
            A = np.zeros((instruments.shape[1],) * 2)
            c = np.zeros(instruments.shape[1])
            for w, y, X in parts:
                v = 1.0 + s * w
                log_likelihood -= 0.5 * float(np.sum(np.log(v)) + np.sum(y**2 / v))
                A += X.T @ (X / v[:, None])
                c += X.T @ (y / v)
            log_likelihood += 0.5 * float(c @ np.linalg.lstsq(A, c, rcond=None)[0])
            log_likelihood -= 0.5 * float(np.linalg.slogdet(A)[1])
            if log_likelihood > best:
                best, level, memory = log_likelihood, s, float(tau)
    keep = math.exp(-1.0 / memory)
    total = np.zeros((instruments.shape[1],) * 2)
    for start, stop in pairwise(edges):
        part = instruments[start:stop]
        ahead = lfilter([1.0], [1.0, -keep], part, axis=0)
        behind = lfilter([1.0], [1.0, -keep], part[::-1], axis=0)[::-1]
        total += part.T @ (ahead + behind - part)
    return level * total


def _finished(
    instruments: np.ndarray,
    residual: np.ndarray,
    values: np.ndarray,
    bread: np.ndarray,
    names: Sequence[str],
    runs: Sequence[int],
    standing: float,
    method: str,
    meat: np.ndarray | None = None,
) -> Regression:
    lengths = list(runs) or [len(residual)]
    memory = _memory(residual, lengths)
    rows = len(residual) / memory
    if meat is None:
        lags = math.ceil(LAGS_PER_MEMORY * memory)
        meat = _over_lags(instruments * residual[:, None], lengths, lags)
    meat *= rows / max(rows - len(values), 1.0)
    inverse = solve(bread, np.eye(len(values)))
    return Regression(
        tuple(names),
        values,
        inverse @ meat @ inverse.T,
        residual,
        rows,
        standing * math.sqrt(rows / 2.0) if math.isfinite(standing) else math.inf,
        method,
    )


def _memory(residual: np.ndarray, lengths: Sequence[int]) -> float:
    """Rows that a residual remembers: 1 + 2 times the sum of its squared autocorrelation.

    Squares, since what counts for a covariance is that of products (Bartlett 1946).
    """
    total = _autocovariance(residual[None], lengths, max(2, min(lengths) // 4))
    shape = total / max(total[0], 1e-300)
    small = np.flatnonzero(np.abs(shape) < 0.05)
    end = int(small[0]) if small.size else len(shape)
    return float(1.0 + 2.0 * np.sum(shape[1:end] ** 2))


def _autocovariance(values: np.ndarray, lengths: Sequence[int], lags: int) -> np.ndarray:
    """Mean over the rows of `values` (d, n) and over runs, lags 0 .. lags - 1, biased as usual."""
    total = np.zeros(lags)
    for part in np.split(values, np.cumsum(lengths)[:-1], axis=1):
        part = part - values.mean()
        size = 1 << (2 * part.shape[1] - 1).bit_length()
        power = np.mean(np.abs(np.fft.rfft(part, size, axis=1)) ** 2, axis=0)
        shape = np.fft.irfft(power, size)[:lags]
        total[: len(shape)] += shape
    return total / values.shape[1]


def _over_lags(scores: np.ndarray, lengths: Sequence[int], lags: int) -> np.ndarray:
    """Sum over lags of the scores' covariance, within runs, weights falling to 0 (Parzen's)."""
    k = scores.shape[1]
    total = np.zeros((k, k))
    for part in np.split(scores, np.cumsum(lengths)[:-1]):
        total += part.T @ part
        for lag, weight in enumerate(_parzen(min(lags, len(part) - 1))[1:], 1):
            across = part[lag:].T @ part[:-lag]
            total += weight * (across + across.T)
    return total


def _parzen(lags: int) -> np.ndarray:
    x = np.arange(max(lags, 1)) / max(lags, 1)
    return np.where(x < 0.5, 1.0 - 6.0 * x**2 + 6.0 * x**3, 2.0 * (1.0 - x) ** 3)


# --- collinearity -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Direction:
    """A combination of columns that hardly moves: sum of weights times columns is nearly constant.

    weights: (k,) in the columns' own units, the largest share made 1. share: its rms over that of the
    largest part in it.
    """

    names: tuple[str, ...]
    weights: np.ndarray
    share: float

    def words(self) -> str:
        """``alpha_l - 0.91 delta_lon + 0.05 q``."""
        text = ""
        for name, weight in sorted(
            zip(self.names, self.weights, strict=True), key=lambda part: part[1] != 1.0
        ):
            size = "" if abs(abs(weight) - 1.0) < 5e-3 else f"{abs(weight):.2g} "
            sign = (" - " if weight < 0.0 else " + ") if text else ("-" if weight < 0.0 else "")
            text += f"{sign}{size}{name}"
        return text


@dataclass(frozen=True)
class Collinearity:
    """What a set of regressors does not determine, the intercept aside.

    inflation: name -> how much larger its variance is than were it alone (VIF). singular: singular
    values of the columns about their means, each scaled to length 1. directions: the weak ones.
    """

    inflation: dict[str, float]
    singular: np.ndarray
    directions: tuple[Direction, ...]


MOST_INFLATION = 5.0
"""Variance inflation from which a direction counts as undetermined (Belsley 1991: 5 to 10)."""
WORTH_NAMING = 0.1
"""Share of a direction below which a column is left out of its words."""


def collinearity(X: np.ndarray, names: Sequence[str]) -> Collinearity:
    """Variance inflation, singular values and weak directions of regressors (n, k), no intercept."""
    spread = X.std(axis=0)
    moving = spread > 1e-12 * np.maximum(np.abs(X).max(axis=0), 1e-300)
    centred = (X - X.mean(axis=0))[:, moving]
    kept = [n for n, m in zip(names, moving, strict=True) if m]
    length = np.linalg.norm(centred, axis=0)
    unit = centred / length
    singular, right = np.linalg.svd(unit, full_matrices=False)[1:]
    inverse = (right.T / np.maximum(singular, 1e-12) ** 2) @ right
    directions = []
    for value, vector in zip(singular[::-1], right[::-1], strict=True):
        if 1.0 / max(value, 1e-12) ** 2 < MOST_INFLATION:
            break
        part = vector / np.abs(vector).max()
        named = np.abs(part) > WORTH_NAMING
        weights = part / length
        largest = int(np.argmax(np.abs(part)))
        directions.append(
            Direction(
                tuple(n for n, keep in zip(kept, named, strict=True) if keep),
                (weights / weights[largest])[named],
                float(value / np.abs(vector).max()),
            )
        )
    return Collinearity(
        dict(zip(kept, np.diag(inverse).tolist(), strict=True)), singular, tuple(directions)
    )
