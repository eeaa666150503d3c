"""The report of a replay: what the simulation gets wrong, per run and channel."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coax_env.estimation.prediction import Replay
from coax_env.plain_words import (
    and_list,
    capital,
    channel_name,
    number,
    number_in,
    seconds,
    unit_name,
    with_unit,
)
from coax_env.report import figures
from coax_env.report.flight_data import data_blocks, ordered, points_each, prediction_figure
from coax_env.report.page import Section, chooser, command, details, figure, page, table

Entry = Mapping[str, Any]
"""A channel of a run in replay.json."""


def replay_page(result: Replay, command_line: str = "") -> str:
    """The report of `coax_env.replay` as HTML text; `command_line` is what was typed."""
    tables = result.findings["runs"]
    channels = ordered({c for entries in tables.values() for c in entries})
    worst = max(
        ((run, c) for run, entries in tables.items() for c in entries),
        key=lambda pair: _error_over_noise(tables[pair[0]][pair[1]], missing=-1.0),
    )
    sections = [
        Section("Where it is wrong", _overview(tables, channels, seconds(result.horizon))),
        Section("Run by run", [_predictions(result, channels, *worst)]),
        Section("The data", data_blocks(result.flight, noise=result.noise.reading)),
    ]
    if command_line:
        sections.append(Section("How this was computed", [command(command_line)]))
    title, sentences = _summary(result, *worst)
    return page(
        title,
        sentences,
        sections,
        kicker=f"Replay · vehicle {result.vehicle.name} · {len(result.runs)} runs",
    )


def _summary(result: Replay, run: str, channel: str) -> tuple[str, list[str]]:
    """Title and lead, from the run and channel with the largest error."""
    horizon = seconds(result.horizon)
    diverged = [replay.name for replay in result.runs if replay.diverged]
    sentences = [
        f"The filtered state is simulated open loop for {horizon} with the recorded commands, from a "
        "start every quarter of a second, and compared with the measurement. A perfect "
        "model's error would be about the sensor's noise."
    ]
    if diverged:
        sentences.append(f"**The simulation diverges in {and_list(diverged)}.**")
    entry = result.findings["runs"][run][channel]
    title = f"Over {horizon} the simulation misses {channel_name(channel)} most"
    ratio = _error_over_noise(entry)
    if math.isfinite(ratio):
        title += f": by {with_unit(entry['rms'], entry['unit'], 2)} in {run}"
        sentences.append(
            f"That is {number(ratio, 2)} times the sensor's noise, the most of all runs and channels."
        )
    return capital(title), sentences


def _overview(
    tables: Mapping[str, Mapping[str, Entry]], channels: Sequence[str], horizon: str
) -> list[str]:
    """Errors of every run and channel, as colours and as numbers."""
    cells = [[entries.get(c) for c in channels] for entries in tables.values()]
    names = [channel_name(c) for c in channels]
    colours = figures.heat_map(
        list(tables),
        names,
        np.array([[_error_over_noise(e) for e in row] for row in cells]),
        [[_cell(e) for e in row] for row in cells],
        "error / noise",
        log=True,
    )
    units = {c: e["unit"] for entries in tables.values() for c, e in entries.items()}
    header = ["run", *(f"{channel_name(c)} [{unit_name(units[c])}]" for c in channels)]
    numbers = [
        [run, *("–" if e is None else number_in(e["rms"], e["unit"]) for e in row)]
        for run, row in zip(tables, cells, strict=True)
    ]
    return [
        figure(colours, f"Error after {horizon}, in units of the sensor's noise."),
        details("The same in numbers (rms)", table(header, numbers)),
    ]


def _predictions(result: Replay, channels: Sequence[str], first_run: str, first: str) -> str:
    """Predictions by run and channel, beginning with the given ones."""
    runs = sorted(result.runs, key=lambda run: run.name != first_run)
    points = points_each(len(runs) * len(channels))
    noise = result.noise.reading
    return chooser(
        {
            (run.name, channel_name(c)): prediction_figure(
                result.flight, run.name, c, {"simulation": run}, noise.get(c), points
            )
            for run in runs
            for c in [first, *(c for c in channels if c != first)]
            if c in run.channels
        }
    )


def _error_over_noise(entry: Entry | None, missing: float = math.nan) -> float:
    """Error in units of the sensor's noise; `missing` where there is none."""
    if entry is None or entry["rms"] is None or not entry["noise_rms"]:
        return missing
    return float(entry["rms"] / entry["noise_rms"])


def _cell(entry: Entry | None) -> str:
    if entry is None:
        return ""
    return "diverged" if entry["rms"] is None else number(_error_over_noise(entry), 2)
