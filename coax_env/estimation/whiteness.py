"""Are innovations white? A Ljung-Box statistic per channel, with an effect size beside it.

Ljung and Box, Biometrika 65, 1978; own, because statsmodels' acorr_ljungbox takes the mean out first,
so that constant innovations pass for white. On long records the test alone finds correlations that
matter to nobody, so a channel counts as coloured only where the correlation is also large, against the
noise that was assumed.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.special import chdtrc

from coax_env.estimation.run_passes import RunPass

LAGS = 20  # readings back to which correlations are taken
SETTLING = 1.0  # [s] at the start of each run that are not counted
P_VALUE = 1e-5  # of all lags' chi square: long flights show correlations that do not matter
SHARE = 0.04  # of a channel's innovation variance that its own past predicts
SPREAD = 1.25  # std of whitened innovations (1 where model and noise are right), if no chance
MUCH = 0.1
"""Share of the innovations, in the mean of the channels, from which a model lacks something else than
its noise; ours. It is 0.02 to 0.05 on **synthetic** flights in joint gusts, 0.12 to 0.9 on the CoaX."""


@dataclass(frozen=True)
class Whiteness:
    """Of one channel's whitened innovations, the worst run's figures.

    coloured_share: share of the variance that its own past predicts. spread: std.
    """

    coloured_share: float
    p_value: float
    spread: float
    run: str
    white: bool

    @property
    def inflation(self) -> float:
        """How many coloured innovations carry what one white one does, at most 5."""
        return 1.0 / max(1.0 - self.coloured_share, 0.2)


def whiteness(passes: Sequence[RunPass], channels: Sequence[str]) -> dict[str, Whiteness]:
    """Whiteness by channel, for channels with readings.

    Missing innovations (NaN) are left out, the lags counted over what remains.
    """
    result = {}
    for i, channel in enumerate(channels):
        parts = []
        for run in passes:
            settled = run.record.t > run.record.t[0] + SETTLING
            e = run.innovations[settled, i]
            e = e[np.isfinite(e)]
            if e.size > 3 * LAGS:
                parts.append((run.record.name, e))
        if parts:
            result[channel] = _judge(parts)
    return result


def _judge(parts: Sequence[tuple[str, np.ndarray]]) -> Whiteness:
    worst = None
    for name, e in parts:
        n = e.size
        rho, predictor = _of_its_past(e)
        q = n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, LAGS + 1)))
        share = float(np.clip(predictor @ rho - LAGS / n, 0.0, 1.0))
        p = float(chdtrc(LAGS, q)) * len(parts)
        spread = float(e.std())
        wide = spread > SPREAD and chdtrc(n, n * spread**2) * len(parts) < P_VALUE
        white = not (wide or (p < P_VALUE and share * min(spread, 1.0) ** 2 > SHARE))
        judged = Whiteness(share, min(p, 1.0), spread, name, white)
        if worst is None or (worst.white, -worst.coloured_share) > (white, -share):
            worst = judged
    assert worst is not None
    return worst


def _of_its_past(e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Correlations of a series (n,) with itself LAGS back and less, and its predictor (Yule-Walker)."""
    rho = np.array([e[k:] @ e[:-k] for k in range(1, LAGS + 1)]) / (e @ e)
    return rho, solve_toeplitz(np.append(1.0, rho[:-1]), rho)


def beyond_its_past(e: np.ndarray) -> np.ndarray:
    """A series (n,) less what its own past predicts of it; white where that predicts it well."""
    if e.size <= 3 * LAGS or not e.any():
        return e
    _, predictor = _of_its_past(e)
    return e - np.convolve(e, np.append(0.0, predictor))[: e.size]


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Of two series (n,) about 0, as innovations are; 0 where one is 0 throughout."""
    power = float(one @ one) * float(other @ other)
    return float(one @ other) / math.sqrt(power) if power > 0.0 else 0.0


def colour(judged: Collection[Whiteness]) -> float:
    """Share of the innovations that their own past predicts, in the mean of some channels."""
    return float(np.mean([of.coloured_share for of in judged]))


def is_much_coloured(passes: Sequence[RunPass], channels: Sequence[str]) -> bool:
    """Whether more than MUCH of the innovations is foretold by their own past.

    Args:
        passes: of the filter. channels: of the model, as in `whiteness`.
    """
    return colour(whiteness(passes, channels).values()) > MUCH


def are_white(judged: Mapping[str, Whiteness], channels: Iterable[str]) -> bool:
    """Whether those of some channels that were judged are."""
    return all(judged[channel].white for channel in channels if channel in judged)


def is_white(passes: Sequence[RunPass], channels: Sequence[str]) -> bool:
    """Whether the innovations leave nothing to explain in any channel."""
    return all(judged.white for judged in whiteness(passes, channels).values())
