"""Right or wrong: what was named against what was hidden, on one stored flight.

A row is what one_flight.py stores; a method ("coax" or a baseline) has named `causes` in it, each with
its effect and the confounded alternatives that it reports.
"""

from collections.abc import Collection, Iterable, Mapping
from itertools import permutations
from typing import Any

from scipy.stats import binomtest

TIES: tuple[frozenset[str], ...] = (
    # first-order lag and pure delay differ above 3 Hz only, where gusts and gyro noise are
    frozenset({"servo_lag", "servo_delay"}),
    # a deadband's jumps follow the last digit of a command; play trails as far, on average
    frozenset({"servo_play", "servo_deadband"}),
    # the same acceleration; they part by the moments' gain alone, which K_b, I_xx, I_yy cover (3-5 %)
    frozenset({"added_mass", "thrust_scale"}),
)
"""Effects declared one finding before the study: naming either is exact."""

OWN = "coax"
Row = Mapping[str, Any]


def tied(a: str, b: str) -> bool:
    """Whether two names are one finding."""
    return a == b or any({a, b} <= tie for tie in TIES)


def named(row: Row, method: str = OWN) -> list[str]:
    """Effects that a method named."""
    return [cause["effect"] for cause in row["methods"][method]["causes"]]


def surely_named(row: Row) -> list[str]:
    """Effects that the package named and called sure; findings that do not say are all sure."""
    causes = row["methods"][OWN]["causes"]
    return [cause["effect"] for cause in causes if cause.get("trust", "sure") == "sure"]


def false_names(hidden: Collection[str], found: Iterable[str]) -> list[str]:
    """Names that are neither a hidden effect nor tied to one."""
    return [name for name in found if not any(tied(truth, name) for truth in hidden)]


def is_exact(hidden: Collection[str], found: Collection[str]) -> bool:
    """Whether the names are the hidden effects or their ties, one for one, and nothing else."""
    if len(hidden) != len(found):
        return False
    return any(
        all(tied(a, b) for a, b in zip(hidden, order, strict=True)) for order in permutations(found)
    )


def is_strictly_exact(row: Row) -> bool:
    """Whether the package named what is hidden by its own name, no tie counted."""
    return sorted(row["hidden"]) == sorted(named(row))


def is_exact_row(row: Row, method: str = OWN) -> bool:
    """Whether a method named exactly what is hidden in a flight."""
    return is_exact(list(row["hidden"]), named(row, method))


def group_with_truth(row: Row, method: str = OWN) -> int:
    """Size of the smallest reported group that holds the one hidden effect; 0 where none does."""
    truth = next(iter(row["hidden"]))
    sizes = []
    for cause in row["methods"][method]["causes"]:
        group = {cause["effect"], *cause.get("confusable_with", ())}
        if any(tied(truth, member) for member in group):
            sizes.append(len(group))
    return min(sizes, default=0)


def is_wrongly_certain(row: Row, method: str = OWN) -> bool:
    """One cause, no confounded alternative, and it is wrong."""
    causes = row["methods"][method]["causes"]
    if len(causes) != 1 or causes[0].get("confusable_with"):
        return False
    return not any(tied(truth, causes[0]["effect"]) for truth in row["hidden"])


def is_shown(row: Row, threshold: float) -> bool:
    """Whether every hidden effect was expected to show: twice the threshold on this flight."""
    expected = [row["expected"].get(effect) for effect in row["hidden"]]
    return all(e is not None and e >= 2.0 * threshold for e in expected)


def is_likelier(row: Row, threshold: float) -> bool:
    """Whether the truth is likelier by so much with every hidden effect than without it."""
    found = [row.get("likelier", {}).get(effect) for effect in row["hidden"]]
    return all(nats is not None and nats >= 2.0 * threshold for nats in found)


def reports_unexplained(row: Row, channel: str, method: str = OWN) -> bool:
    """Whether no catalogue effect is named and the hidden one's channel is reported as unexplained.

    Args:
        row: of a flight whose hidden effect is in no catalogue.
        channel: the one that the effect disturbs.
        method: whose findings.
    """
    finding = row["methods"][method]
    return not finding["causes"] and any(
        left["channel"] == channel for left in finding.get("unexplained", ())
    )


def intervals(row: Row) -> list[tuple[str, bool]]:
    """(parameter, its 95 % interval holds the truth) of named, truly hidden, same-form effects."""
    result = []
    for cause in row["methods"][OWN]["causes"]:
        for name, estimate in cause["parameters"].items():
            if cause["effect"] in row["hidden"] and name in row["comparable"]:
                error = estimate["value"] - row["comparable"][name]
                result.append((name, abs(error) <= 1.96 * estimate["std"]))
    return result


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share; of none, which SciPy refuses: anything."""
    if count == 0:
        return 0.0, 1.0
    interval = binomtest(successes, count).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def finished(rows: Iterable[Row]) -> list[Row]:
    """Rows of flights that came to an end."""
    return [row for row in rows if "error" not in row]
