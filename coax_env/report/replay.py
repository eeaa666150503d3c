"""The report of a replay: what the simulation gets wrong, per run and channel."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from coax_env.estimation.prediction import Replay
from coax_env.plain_words import and_list, capital, channel_name, number, seconds, unit_name
from coax_env.report import figures
from coax_env.report.flown import data_blocks, ordered, points_each, prediction_figure
from coax_env.report.page import Section, chooser, command, details, figure, page, table


def replay_page(result: Replay, command_line: str = "") -> str:
    """The report of `coax_env.replay` as HTML text; `command_line` is what was typed."""
    tables = result.findings["runs"]
    channels = ordered({c for entries in tables.values() for c in entries})
    worst_run, worst = max(
        ((run, c) for run, entries in tables.items() for c in entries),
        key=lambda pair: _in_noise(tables[pair[0]][pair[1]], lost=-1.0),
    )
    horizon = seconds(result.horizon)
    lost = [run.name for run in result.runs if run.diverged]
    sentences = [
        f"The filtered state is flown open loop for {horizon} with the recorded commands, from a "
        "start every quarter of a second, and compared with the measurement. A perfect model would "
        "come out near 1."
    ]
    if lost:
        sentences.append(f"**The simulation runs away in {and_list(lost)}.**")
    entry = tables[worst_run][worst]
    top = f"Over {horizon} the simulation misses {channel_name(worst)} most"
    if math.isfinite(_in_noise(entry)):
        top += f": by {number(entry['rms'], 2)} {unit_name(entry['unit'])} in {worst_run}"
        sentences.append(
            f"In units of the sensor's noise that is {number(_in_noise(entry), 2)}, the largest "
            "of all runs and channels."
        )
    cells = [[entries.get(c) for c in channels] for entries in tables.values()]
    overview = figures.heat_map(
        list(tables),
        [channel_name(c) for c in channels],
        np.array([[_in_noise(e) for e in row] for row in cells]),
        [[_cell(e) for e in row] for row in cells],
        "error / noise",
        log=True,
    )
    numbers = [
        [run, *("–" if e is None else number(e["rms"]) for e in row)]
        for run, row in zip(tables, cells, strict=True)
    ]
    runs = sorted(result.runs, key=lambda run: run.name != worst_run)
    points = points_each(len(runs) * len(channels))
    options = {
        (run.name, channel_name(c)): prediction_figure(
            result.flight, run.name, c, {"simulation": run}, result.noise.reading.get(c), points
        )
        for run in runs
        for c in [worst, *(c for c in channels if c != worst)]
        if c in run.channels
    }
    parts = [
        Section(
            "Where it is wrong",
            [
                figure(overview, f"Error after {horizon}, in units of the sensor's noise."),
                details("The same in numbers (rms)", table(["run", *channels], numbers)),
            ],
        ),
        Section("Run by run", [chooser(options)]),
        Section("The data", data_blocks(result.flight, noise=result.noise.reading)),
    ]
    if command_line:
        parts.append(Section("How this was computed", [command(command_line)]))
    return page(
        capital(top),
        sentences,
        parts,
        kicker=f"Replay · vehicle {result.vehicle.name} · {len(result.runs)} runs",
    )


def _in_noise(entry: Mapping[str, Any] | None, lost: float = math.nan) -> float:
    """Error in units of the sensor's noise; `lost` where there is none."""
    if entry is None or entry["rms"] is None or not entry["noise_rms"]:
        return lost
    return float(entry["rms"] / entry["noise_rms"])


def _cell(entry: Mapping[str, Any] | None) -> str:
    if entry is None:
        return ""
    return "lost" if entry["rms"] is None else number(_in_noise(entry), 2)
