"""What a rate of false alarms was measured on, and so for which flights it holds.

Each arm is a class of its own: what its clean flights show of themselves - sensors, rates, gaps, size,
the gusts that were fitted - is what a flight must show to have the arm's rate.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from study import judge, threshold
from study.arms import ARMS
from study.judge import Row

WIDER = 1.15
"""Factor by which a range is wider than what was seen; ours."""
SLACK = 0.005
"""The same, added, in the figure's own unit: a share of gaps of none should hold for hardly any."""
JUDGED = ("calibrated", "why")
"""Of a finding's class: what it was found to be, not what was seen."""


def calibrations(rows: Sequence[Row], command: str) -> list[dict[str, Any]]:
    """The calibration of each class with enough clean flights; see threshold.py.

    Args:
        rows: of a study. command: that made them.
    """
    flown = [arm for arm in ARMS if any(row["plan"]["arm"] == arm for row in rows)]
    arms = [arm for arm in flown if ARMS[arm].size == 1.0]  # without an effect no size matters
    if not flown:
        measured = threshold.calibration(rows, command)
        return [measured] if measured else []
    result = []
    for arm in arms:
        part = [
            r for r in judge.finished(rows) if r["plan"]["arm"] == arm and not r["plan"]["effects"]
        ]
        measured = threshold.calibration(part, command)
        if measured:
            seen = [row["class"] for row in part if row.get("class")]
            result.append({**measured, "class": described(arm, ARMS[arm].words, seen)})
    return result


def described(name: str, words: str, seen: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A class by what its flights showed: the ends of a range, or a list of what there was.

    Args:
        name, words: of the class. seen: `class` of the findings, one per flight.
    """
    result: dict[str, Any] = {"name": name, "data": f"tests/injector.py: {words}"}
    for key in dict.fromkeys(key for flight in seen for key in flight if key not in JUDGED):
        values = [flight[key] for flight in seen if flight.get(key) is not None]
        if not values:
            continue
        if isinstance(values[0], int | float) and not isinstance(values[0], bool):
            low, high = min(values) / WIDER - SLACK, max(values) * WIDER + SLACK
            result[key] = [round(max(low, 0.0), 4), round(high, 4)]
        else:
            result[key] = sorted(set(values))
    return result
