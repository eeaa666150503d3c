"""What mending the model is worth, on a page: in prediction, and in flight."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from coax_env.model.generic_terms import AXES, TERMS
from coax_env.plain_words import and_list, channel_name, number, seconds, unit_name, whole_percent
from coax_env.report import figures
from coax_env.report.flown import ordered
from coax_env.report.page import Markup, datum, figure, numbers_table, prose, table, tiles

BLACK_BOX = len(AXES) * len(TERMS)
"""Numbers of the black box that a diagnosis compares itself with."""


@dataclass(frozen=True)
class FlownControllers:
    """Controllers of the bare and of the extended model, flown on one machine.

    scores: name -> score.json. machine: in words, what flew them. design: in words, what they are.
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
        interval = Markup(f"{ends[0]} to {ends[1]}&nbsp;%, 95&nbsp;% interval")
    items = [
        (_percent(gain, "error_removed_percent"), f"of the {seconds(gain['horizon_s'])} prediction "
         "error removed", interval),
        (_percent(gain, "noise_floor_percent"), "is the most possible", "with these sensors"),
        (_percent(gain, "refitted_base_percent"), "by refitting alone",
         "the bare model's own numbers"),
    ]  # fmt: skip
    if gain.get("black_box_percent") is not None:
        items.append(
            (_percent(gain, "black_box_percent"), "by a black box", f"of {BLACK_BOX} generic terms")
        )
    return tiles(items)


def _percent(gain: Mapping[str, Any], key: str) -> str:
    return datum(whole_percent(gain[key]), f"gain/{key}", gain[key])


def gain_blocks(findings: Mapping[str, Any]) -> list[str]:
    """Prediction errors per channel, before and after."""
    gain = findings.get("gain")
    if not gain:
        return [prose("All runs were fitted (nothing held out): no gain can be measured.")]
    entries = gain["channels"]
    channels = {c: entries[c] for c in sorted(ordered(entries), key=lambda c: _kept(entries[c]))}
    caption = (
        f"Error of a {seconds(gain['horizon_s'])} prediction on the held-out runs "
        f"({and_list(gain['held_out'])}), as a share of the bare model's. Whisker: 95 % interval. "
        "Green: the sensor's own noise, which is in every reading, so that no model gets below it. "
    )
    if gain.get("black_box_percent") is None:
        caption += "With `--ceiling` a black box is fitted too, for comparison."
    header = ["channel", "unit", "bare", "refitted", "extended", "95 % interval", "sensor noise"]
    return [
        figure(figures.gain_bars(channels), caption, "Prediction error by channel"),
        numbers_table(
            "The same in numbers (rms)", header, [_row(c, e) for c, e in channels.items()]
        ),
    ]


def _kept(entry: Mapping[str, Any]) -> float:
    """Share of the bare model's error that is left; large where it is not known."""
    before, after = entry["before"], entry["after"]
    return after / before if before and after is not None else math.inf


def _row(channel: str, entry: Mapping[str, Any]) -> list[str]:
    """A channel of the gain in a table."""
    where = f"gain/channels/{channel}"

    def shown(key: str) -> str:
        return datum(number(entry[key]), f"{where}/{key}", entry[key])

    ends = [
        datum(number(end), f"{where}/ci95/{k}", end)
        for k, end in enumerate(entry.get("ci95") or ())
    ]
    return [
        channel_name(channel),
        unit_name(entry["unit"]),
        shown("before"),
        shown("before_refitted"),
        shown("after"),
        Markup(" to ".join(ends)) or "–",
        shown("noise"),
    ]


_FIGURES = (
    ("success", "success_rate", "{:.0f} %", 100.0),
    ("cost", "mean_cost", "{:.3g}", 1.0),
    ("height rms", "height_rms_m", "{:.1f} cm", 100.0),
    ("speed rms", "velocity_rms_mps", "{:.3f} m/s", 1.0),
    ("heading rms", "heading_rms_deg", "{:.2f}°", 1.0),
    ("drift", "drift_m", "{:.2f} m", 1.0),
)
"""Heading, key of score.json, form and factor."""


def controller_blocks(flown: FlownControllers) -> list[str]:
    """Controllers before and after, on one machine from the same seeds."""
    scores = flown.scores
    rows = [
        [name, *(_score(score.get(key), form, by) for _, key, form, by in _FIGURES)]
        for name, score in scores.items()
    ]
    any_score = next(iter(scores.values()))
    times = f"{any_score['episodes']} flights of {any_score['seconds']:.0f} s"
    drawn = [
        (words, key) for words, key, *_ in _FIGURES if any_score.get(key) and key != "success_rate"
    ]
    bars = {
        name: [100.0 * score[key] / any_score[key] for _, key in drawn]
        for name, score in scores.items()
    }
    successes = [
        f"**{_score(score.get('success_rate'), '{:.0f} %', 100.0)}** with the {name} model's"
        for name, score in scores.items()
    ]
    return [
        prose(
            f"{flown.design} Flown on {flown.machine}, {times} each from the same seeds: success "
            f"{and_list(successes)}."
        ),
        figure(
            figures.side_by_side(
                [words for words, _ in drawn],
                bars,
                f"% of {next(iter(scores))}",
                colours=(figures.BEFORE, figures.AFTER),
            ),
            "Less is better.",
            "Controllers of the bare and of the extended model",
        ),
        table(["designed on", *(words for words, *_ in _FIGURES)], rows),
    ]


def _score(value: float | None, form: str, factor: float) -> str:
    return "–" if value is None else form.format(factor * value)
