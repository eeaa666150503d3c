"""What the corrected model gains, on a page: in prediction, and in flight."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from coax_env.model.generic_terms import AXES, TERMS
from coax_env.plain_words import (
    and_list,
    channel_name,
    number_in,
    read_factor,
    seconds,
    unit_name,
    whole_percent,
)
from coax_env.report import figures
from coax_env.report.flight_data import ordered
from coax_env.report.page import Markup, datum, figure, folded_table, prose, table, tiles
from coax_env.report.plot_style import AFTER, BEFORE

BLACK_BOX_TERMS = len(AXES) * len(TERMS)
"""Coefficients of the black box that a diagnosis compares itself with."""


@dataclass(frozen=True)
class ControllerScores:
    """Controllers designed on the bare and on the corrected model, flown on one machine.

    Attributes:
        scores: ``"bare"`` and ``"corrected"`` -> score.json.
        machine: what they flew, in words.
        design: what they are, in words.
    """

    scores: Mapping[str, Mapping[str, Any]]
    machine: str
    design: str


def gain_tiles(findings: Mapping[str, Any]) -> str:
    """The gain in a few large numbers; nothing where no run was held out."""
    gain = findings.get("gain")
    if not gain:
        return ""
    low, high = gain["ci95"]
    interval: str = ""
    if low is not None:
        ends = [
            datum(f"{end:.0f}".replace("-", "−"), f"gain/ci95/{k}", end)
            for k, end in enumerate((low, high))
        ]
        interval = Markup(f"{' to '.join(ends)}&nbsp;%, 95&nbsp;% interval")
    items = [
        (_percent(gain, "error_removed_percent"), f"of the {seconds(gain['horizon_s'])} prediction "
         "error removed", interval),
        (_percent(gain, "noise_floor_percent"), "expected of a perfect model",
         "from the same starts, at these sensors' noise"),
        (_percent(gain, "refitted_base_percent"), "by refitting alone",
         "the bare model's own parameters"),
        (_percent(gain, "persistence_percent"), "by saying that nothing moves",
         "the least to beat; below zero: worse than the bare model"),
    ]  # fmt: skip
    if gain.get("black_box_percent") is not None:
        items.append(
            (
                _percent(gain, "black_box_percent"),
                "by a black box",
                f"of {BLACK_BOX_TERMS} generic terms",
            )
        )
    return tiles(items)


def _percent(gain: Mapping[str, Any], key: str) -> str:
    return datum(whole_percent(gain[key]), f"gain/{key}", gain[key])


def gain_blocks(findings: Mapping[str, Any]) -> list[str]:
    """Prediction errors per channel, before and after."""
    gain = findings.get("gain")
    if not gain:
        return [prose("No gain was measured: nothing was held out of the fit that could be flown.")]
    entries = gain["channels"]
    channels = {
        c: entries[c] for c in sorted(ordered(entries), key=lambda c: _error_left(entries[c]))
    }
    whiskers = "" if gain["ci95"][0] is None else "Whisker: 95 % interval. "
    caption = (
        f"Error of a {seconds(gain['horizon_s'])} prediction on the held-out runs "
        f"({and_list(gain['held_out'])}), as a share of the bare model's. {whiskers}"
        "Green: the sensor's noise, which is in every reading: no model gets below it but by chance. "
    )
    if gain.get("black_box_percent") is None:
        caption += "With `--ceiling` a black box is fitted too, for comparison."
    header = [
        "channel", "unit", "bare", "refitted", "corrected", "95 % interval", "nothing moves",
        "sensor noise",
    ]  # fmt: skip
    return [
        figure(figures.gain_bars(channels), caption, "Prediction error by channel"),
        folded_table(
            "The same in numbers (rms)", header, [_row(c, e) for c, e in channels.items()]
        ),
    ]


def _error_left(entry: Mapping[str, Any]) -> float:
    """Share of the bare model's error that is left; large where it is not known."""
    before, after = entry["before"], entry["after"]
    return after / before if before and after is not None else math.inf


def _row(channel: str, entry: Mapping[str, Any]) -> list[str]:
    """A channel of the gain in a table."""
    place, unit = f"gain/channels/{channel}", entry["unit"]
    by = read_factor(unit)

    def shown(key: str) -> str:
        value = entry[key]
        return datum(number_in(value, unit), f"{place}/{key}", value, by)

    ends = [
        datum(number_in(end, unit), f"{place}/ci95/{k}", end, by)
        for k, end in enumerate(entry.get("ci95") or ())
    ]
    return [
        channel_name(channel),
        unit_name(unit),
        shown("before"),
        shown("before_refitted"),
        shown("after"),
        Markup(" to ".join(ends)) or "–",
        shown("persistence"),
        shown("noise"),
    ]


_COLUMNS = (
    ("success", "success_rate", "{:.0f} %", 100.0),
    ("cost", "mean_cost", "{:.3g}", 1.0),
    ("height rms", "height_rms_m", "{:.1f} cm", 100.0),
    ("speed rms", "velocity_rms_mps", "{:.3f} m/s", 1.0),
    ("heading rms", "heading_rms_deg", "{:.2f}°", 1.0),
    ("drift", "drift_m", "{:.2f} m", 1.0),
)
"""Heading, key of score.json, format and factor."""


def controller_blocks(controllers: ControllerScores) -> list[str]:
    """Controllers of both models, on one machine from the same seeds."""
    scores = controllers.scores
    rows = [
        [name, *(_formatted(score.get(key), form, by) for _, key, form, by in _COLUMNS)]
        for name, score in scores.items()
    ]
    first_name, first = next(iter(scores.items()))
    bars = [(title, key) for title, key, *_ in _COLUMNS[1:] if first.get(key)]
    percent = {
        name: [100.0 * score[key] / first[key] for _, key in bars] for name, score in scores.items()
    }
    successes = [
        f"**{_formatted(score.get('success_rate'), '{:.0f} %', 100.0)}** with the {name} model's"
        for name, score in scores.items()
    ]
    return [
        prose(
            f"{controllers.design} Flown on {controllers.machine}, {first['episodes']} flights of "
            f"{first['seconds']:.0f} s each from the same seeds: success {and_list(successes)}."
        ),
        figure(
            figures.grouped_bars(
                [title for title, _ in bars],
                percent,
                f"% of {first_name}",
                colours=(BEFORE, AFTER),
            ),
            "Less is better.",
            "Controllers of the bare and of the corrected model",
        ),
        table(["designed on", *(title for title, *_ in _COLUMNS)], rows),
    ]


def _formatted(value: float | None, form: str, factor: float) -> str:
    return "–" if value is None else form.format(factor * value)
