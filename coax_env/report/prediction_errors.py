"""Where the bare model is wrong: its predictions against the held-out runs, the worst channel first."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from coax_env.estimation.prediction import RunReplay, rms
from coax_env.plain_words import and_list, channel_name, seconds, with_unit
from coax_env.report.flight_data import ordered, points_each, prediction_figure
from coax_env.report.page import callout, chooser, prose
from coax_env.report.plot_style import Figure

if TYPE_CHECKING:
    from coax_env.diagnosis.diagnose import Diagnosis

Findings = Mapping[str, Any]


def error_blocks(result: "Diagnosis") -> list[str]:
    """Predictions of the bare and of the corrected model on the held-out runs; nothing without any."""
    bare = {run.name: run for run in result.replay_before}
    if not bare:
        return []
    corrected = {run.name: run for run in result.replay_after}
    diverged = [name for name, run in bare.items() if run.diverged]
    return [
        prose(_worst_in_words(result.findings)),
        chooser(
            _figures(result, bare, corrected),
            "Held-out runs. Each point of a line is where the model, started a second earlier from "
            "the estimated state and flown with the recorded commands, predicts the reading. Below: "
            "its error, with the sensor's noise as a band.",
        ),
        callout(
            f"The bare model diverges in {and_list(diverged)}: where its line ends it has left the "
            "figure.",
            "warning",
        )
        if diverged
        else "",
    ]


def _figures(
    result: "Diagnosis", bare: Mapping[str, RunReplay], corrected: Mapping[str, RunReplay]
) -> dict[tuple[str, str], Figure]:
    """Figures by run and channel, those first in which the corrected model improves most."""
    channels = ordered({c for run in bare.values() for c in run.channels})
    improved = {
        (run, c): _improvement(bare[run], corrected.get(run), c) for run in bare for c in channels
    }
    compared = (result.findings["gain"] or {}).get("channels", {})
    candidates = [c for c in channels if c in compared] or channels
    best = max(candidates, key=lambda c: sum(improved[run, c] for run in bare))
    runs = sorted(bare, key=lambda run: -improved[run, best])
    return {
        (run, channel_name(c)): prediction_figure(
            result.flight,
            run,
            c,
            {"bare": bare[run], "corrected": corrected.get(run)},
            result.noise.get(c),
            points_each(len(runs) * len(channels)),
        )
        for run in runs
        for c in [best, *(c for c in channels if c != best)]
        if c in bare[run].channels
    }


def _improvement(bare: RunReplay, corrected: RunReplay | None, channel: str) -> float:
    """Share by which the error of a channel fell in a run; 0 where that has no meaning."""
    if corrected is None or channel not in bare.channels or channel not in corrected.channels:
        return 0.0
    errors = [run.channels[channel].error for run in (bare, corrected)]
    if not all(np.isfinite(e).any() for e in errors):
        return 0.0
    old, new = (rms(e) for e in errors)
    return 1.0 - new / old if old > 0.0 else 0.0


def _worst_in_words(findings: Findings) -> str:
    """The three channels in which the bare model's error exceeds the sensor's noise most."""
    gain = findings.get("gain")
    if not gain:
        return ""
    errors = {c: e for c, e in gain["channels"].items() if e["before"] is not None and e["noise"]}
    ratio = {c: e["before"] / e["noise"] for c, e in errors.items()}
    worst = [c for c in sorted(errors, key=lambda c: -ratio[c])[:3] if ratio[c] > 1.1]
    if not worst:
        return "On the held-out runs its error nowhere exceeds the sensors' noise."
    words = [
        f"{channel_name(c)} {_missed(errors[c])} ({_times(ratio[c])} the sensor's noise)"
        for c in worst
    ]
    return f"Within {seconds(gain['horizon_s'])} the bare model misses {and_list(words)}."


SPIN = math.radians(90.0)
"""Error of an angle [rad] beyond which a model has turned away: the number says nothing more."""


def _missed(entry: Mapping[str, Any]) -> str:
    """By how much a channel is missed; that the model spins, where an angle is gone altogether."""
    if entry["unit"] == "rad" and entry["before"] > SPIN:
        return "altogether: it spins"
    return f"by {with_unit(entry['before'], entry['unit'], 2)}"


def _times(ratio: float) -> str:
    return f"{ratio:.1f} times" if ratio < 20.0 else "far above"
