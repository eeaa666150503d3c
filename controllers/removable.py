"""How much of a cost any model could remove, and how much of that a correction removes.

Most of what a hover costs is not the model's: the sensors' noise stays with the true one. A machine's
results of `machines.fly_machine` with the truth say what is left then; those with a diagnosis, from the
same seeds, are judged by the rest.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_RESAMPLES = 2000


def floor_share(truth: Mapping[str, Any]) -> float:
    """Share of the bare model's cost that stays with the truth; `truth`: a kind's scores with it."""
    bare, left = _costs(truth)
    return float(left.sum() / bare.sum())


def shows(truth: Mapping[str, Any], seed: int = 0) -> bool:
    """Whether the truth's gain is more than noise: the 95 % interval of its flights is above 0."""
    bare, left = _costs(truth)
    draws = np.random.default_rng(seed).integers(0, len(bare), (_RESAMPLES, len(bare)))
    return bool(np.percentile((bare - left)[draws].sum(1), 2.5) > 0.0)


def share_removed(corrected: Mapping[str, Any], truth: Mapping[str, Any]) -> float:
    """(bare - corrected) / (bare - truth): 1 where the correction gains what the truth does.

    Args:
        corrected: a kind's scores with the diagnosed model.
        truth: the same with the machine itself, from the same seeds.
    """
    (bare, left), (again, found) = _costs(truth), _costs(corrected)
    return float((again.mean() - found.mean()) / (bare.mean() - left.mean()))


def _costs(scores: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Costs of the flights with the bare and with the other model's controller."""
    bare, other = (np.array(scores[name]["flight_costs"]) for name in ("bare", "corrected"))
    return bare, other


def in_words(
    results: Sequence[Mapping[str, Any]], truths: Sequence[Mapping[str, Any]]
) -> list[str]:
    """One line per kind of controller that has flown with the truth.

    Args:
        results: of machines with diagnoses; none: the floor alone is told.
        truths: of machines with the truth, in any order.
    """
    found = []
    diagnosed = {result["seed"]: result["scores"] for result in results}
    for kind in dict.fromkeys(kind for truth in truths for kind in truth["scores"]):
        known = {t["seed"]: t["scores"][kind] for t in truths if kind in t["scores"]}
        floor = np.median([floor_share(one) for one in known.values()])
        words = f"{kind.upper()}: with the truth {floor:.2f} of the bare cost stays in the median"
        shares = [
            share_removed(diagnosed[seed][kind], one)
            for seed, one in known.items()
            if kind in diagnosed.get(seed, {}) and shows(one)
        ]
        if shares:
            words += (
                f"; of the rest the correction removes {100 * np.median(shares):.0f} % in the median "
                f"of the {len(shares)} machines where the truth gains more than noise"
            )
        found.append(words)
    return found
