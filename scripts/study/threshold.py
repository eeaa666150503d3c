"""The evidence that a share of clean flights reaches: what the search's threshold is calibrated to.

Each clean flight gives the evidence of the candidate that came nearest to being named
(`Fit.strongest`), all of them false. The tail above its upper quartile is taken as exponential, which
is what a likelihood ratio's tail is; the interval is a bootstrap's over flights.

What a search finds must still stand once it is weighed (diagnosis/evidence.py), which that evidence
does not know. So the rate of false alarms is no more than Laplace's estimate from their count,
(k + 1) / (n + 2).
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from coax_env.diagnosis.settings import SETTINGS
from study import judge
from study.judge import Row

FALSE_ALARMS = 0.01
FEWEST = 20  # clean flights
TAIL = 0.25
DRAWS = 2000
CLASS = {
    "name": "synthetic flights of the study",
    "data": "tests/injector.py, a lama400d, still or in gusts of 0.2 N and 6 mN m",
    "sensors": ["accelerometers, attitude, gyros, heading, height, rotor speeds, velocity"],
    "rate_hz": [95.0, 105.0],
    "gap_share": [0.0, 0.01],
    "card_noise": [True],
    "mass_kg": [0.7, 0.9],
    "gust_force": [0.0, 0.05],  # of the weight
    "gust_moment": [0.0, 0.01],  # of the weight at the upper hub's arm
    "gust_memory_s": [0.2, 1.2],
    "white_noise": [False],
}
"""What the clean flights are like: what may be seen of a flight of theirs, or the ends of a range."""


def calibration(rows: Sequence[Row], command: str) -> dict[str, Any] | None:
    """The threshold for 1 % false alarms and how it was found; None with too few clean flights."""
    clean = [r for r in judge.finished(rows) if not r["plan"]["effects"]]
    if len(clean) < FEWEST:
        return None
    evidence = np.array(
        [
            -np.inf if r["strongest"]["evidence"] is None else r["strongest"]["evidence"]
            for r in clean
        ]
    )
    rng = np.random.default_rng(0)  # scipy.stats.bootstrap gives up where one resample is NaN
    draws = [tail_quantile(rng.choice(evidence, evidence.size)) for _ in range(DRAWS)]
    low, high = np.nanpercentile(np.array(draws), [2.5, 97.5])
    alarms = sum(bool(judge.named(row)) for row in clean)
    beyond = share_beyond(evidence, SETTINGS.evidence)
    estimate = max(alarms / len(clean), min(beyond, (alarms + 1) / (len(clean) + 2)))
    finite = np.sort(evidence[np.isfinite(evidence)])[::-1]
    return {
        "class": CLASS,
        "false_alarm_rate": round(max(estimate, FALSE_ALARMS), 4),  # less is not claimed
        "estimated_rate": round(estimate, 4),
        "threshold_nats_for_1_percent": _number(tail_quantile(evidence)),
        "ci95": [_number(low), _number(high)],
        "clean_flights": len(clean),
        "threshold_used_nats": SETTINGS.evidence,
        "false_alarms_at_it": alarms,
        "wilson95_at_it": list(judge.wilson(alarms, len(clean))),
        "largest_nats": [round(float(e), 2) for e in finite[:20]],
        "code": sorted({row["code"] for row in clean}),
        "command": command,
    }


def tail_quantile(evidence: np.ndarray, exceeded_by: float = FALSE_ALARMS) -> float:
    """Evidence that a share of clean flights exceeds, by an exponential tail above the quartile.

    Flights without any candidate have -inf. NaN where fewer than a tenth of the tail is finite.
    """
    finite = _tail(evidence)
    if finite.size < 5:
        return math.nan
    start = finite[-1]
    share = (finite.size - 1) / evidence.size
    return float(start + np.mean(finite[:-1] - start) * max(math.log(share / exceeded_by), 0.0))


def share_beyond(evidence: np.ndarray, threshold: float) -> float:
    """Share of clean flights with evidence beyond a threshold, by the same tail."""
    finite = _tail(evidence)
    if finite.size < 5:
        return finite.size / evidence.size if np.any(finite > threshold) else 0.0
    start = finite[-1]
    if threshold <= start:
        return float(np.mean(evidence > threshold))
    mean = max(float(np.mean(finite[:-1] - start)), 1e-9)
    return float((finite.size - 1) / evidence.size * np.exp(-(threshold - start) / mean))


def _tail(evidence: np.ndarray) -> np.ndarray:
    """The finite evidences of the uppermost quarter of the flights, largest first."""
    ordered = np.sort(evidence)[::-1]
    tail = ordered[: max(2, math.ceil(TAIL * ordered.size))]
    return tail[np.isfinite(tail)]


def _number(value: float) -> float | None:
    return round(float(value), 3) if math.isfinite(value) else None
