"""What a flight leaves open: numbers, and combinations of them, that it does not determine."""

from collections.abc import Sequence

import numpy as np

from coax_env.estimation.state_space import FreeParameter
from coax_env.plain_words import and_list, plain

OPEN_SHARE = 0.75
"""Share of its prior std that a combination keeps when the flights say nothing of it; ours."""
WORTH_NAMING = 0.35
"""Share of an undetermined direction below which a number is left out of its words; ours."""


def left_open(
    free: Sequence[FreeParameter], covariance: np.ndarray
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Numbers that the flights do not determine, and the combinations they leave open, in words.

    Open is an eigenvector of the posterior covariance, in units of the priors, whose std is most of
    the prior's. A number is undetermined where most of its variance is along those: motion alone
    determines thrust over mass, not either.

    Args:
        free: the k parameters that were fitted, with their priors.
        covariance: posterior, (k, k).
    """
    scale = np.array([f.std for f in free])
    shares, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    left = shares > OPEN_SHARE**2
    along = np.sum(vectors[:, left] ** 2 * shares[left], axis=1)
    whole = np.sum(vectors**2 * shares, axis=1)
    undetermined = [f.name for f, a, w in zip(free, along, whole, strict=True) if a > 0.5 * w]
    directions = [_in_words(free, vector) for vector in vectors.T[left][::-1]]
    return tuple(undetermined), tuple(words for words in directions if words)


def _in_words(free: Sequence[FreeParameter], vector: np.ndarray) -> str:
    """A direction as "mass up with thrust_coefficient down"; nothing for a single number."""
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    parts = [(w, f.name) for w, f in zip(vector, free, strict=True) if abs(w) > WORTH_NAMING]
    if len(parts) < 2:
        return ""
    up = [plain(name) for weight, name in parts if weight > 0.0]
    down = [plain(name) for weight, name in parts if weight < 0.0]
    return and_list(up) + (" up with " + and_list(down) + " down" if down else " together")
