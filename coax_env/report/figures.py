"""Figures of flights and of predictions: data in, plotly figure out."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coax_env.plain_words import with_unit
from coax_env.report.plot_style import (
    AFTER,
    BEFORE,
    CYCLE,
    DASHES,
    MEASURED,
    MOST_POINTS,
    NOISE,
    REFITTED,
    Figure,
    axis_title,
    channel_labels,
    curve,
    figure_of,
    horizontal_band,
    packed,
    stacked_axes,
    thinned,
)


def bode(omega: np.ndarray, responses: Mapping[str, np.ndarray]) -> Figure:
    """Gain [dB] and phase [deg] over frequency [Hz].

    Args:
        omega: [rad/s], (w,).
        responses: name -> complex frequency response (w,).
    """
    layout = stacked_axes([1.0, 1.0], ["gain [dB]", "phase [deg]"], spacing=0.08)
    layout["xaxis"] |= {"type": "log", "title": {"text": "frequency [Hz]"}}
    data = []
    for k, (name, values) in enumerate(responses.items()):
        phase = np.degrees(np.unwrap(np.angle(values)))
        phase -= 360.0 * np.round((phase[len(phase) // 2] + 180.0) / 360.0)
        for row, y in ((1, 20.0 * np.log10(np.abs(values) + 1e-12)), (2, phase)):
            more = {"showlegend": row == 1, "line": {
                "color": CYCLE[k % len(CYCLE)], "width": 1.7, "dash": DASHES[k % 3]}}  # fmt: skip
            data.append(curve(omega / (2.0 * math.pi), y, name, "", row, **more))
    return figure_of(data, 400, **layout)


def gains(omega: np.ndarray, curves: Mapping[str, np.ndarray]) -> Figure:
    """Gains [dB] over frequency [Hz].

    Args:
        omega: [rad/s], (w,).
        curves: name -> gain (w,).
    """
    layout = stacked_axes([1.0], ["gain [dB]"], spacing=0.0)
    layout["xaxis"] |= {"type": "log", "title": {"text": "frequency [Hz]"}}
    data = []
    for k, (name, values) in enumerate(curves.items()):
        line = {"color": CYCLE[k % len(CYCLE)], "width": 1.7, "dash": DASHES[k % 3]}
        decibels = 20.0 * np.log10(values + 1e-12)
        data.append(curve(omega / (2.0 * math.pi), decibels, name, "", 1, line=line))
    return figure_of(data, 280, **layout)


# --- histories ------------------------------------------------------------------------------------


def histories(
    t: np.ndarray,
    panels: Sequence[tuple[str, Mapping[str, np.ndarray]]],
    points: int = MOST_POINTS,
) -> Figure:
    """Panels over one time axis.

    Args:
        t: time [s], (n,).
        panels: axis title and curves (n,) by name, from above.
        points: at most so many per curve.
    """
    rows = len(panels)
    kept = thinned(len(t), points)
    layout = stacked_axes([1.0] * rows, [title for title, _ in panels], spacing=0.24 / rows)
    data = []
    for row, (_, curves) in enumerate(panels, 1):
        legend = "legend" if row == 1 else f"legend{row}"
        axis = layout["yaxis" if row == 1 else f"yaxis{row}"]
        layout[legend] = {
            "orientation": "h", "x": 1, "xanchor": "right", "y": axis["domain"][1],
            "yanchor": "bottom", "bgcolor": "rgba(0,0,0,0)",
        }  # fmt: skip
        for k, (name, values) in enumerate(curves.items()):
            line = {"color": CYCLE[k % len(CYCLE)], "width": 1.7, "dash": DASHES[k % 3]}
            more = {"line": line, "legend": legend, "legendgroup": f"{row} {name}"}
            data.append(curve(t[kept], values[kept], name, "", row, showlegend=True, **more))
    return figure_of(data, 60 + 155 * rows, **layout)


def plan_view(north: np.ndarray, east: np.ndarray, height: np.ndarray) -> Figure:
    """The flight from above, coloured by height; east to the right, north up.

    Args:
        north: [m], (n,).
        east: [m], (n,).
        height: [m], (n,).
    """
    kept = thinned(len(north))
    north, east, height = north[kept], east[kept], height[kept]
    track = {
        "type": "scatter", "mode": "lines+markers", "x": packed(east), "y": packed(north),
        "line": {"color": MEASURED, "width": 1},
        "marker": {
            "size": 4, "color": packed(height), "colorscale": "Viridis", "showscale": True,
            "colorbar": {"title": {"text": "h [m]"}, "thickness": 12},
        },
        "customdata": packed(height),
        "hovertemplate": "E %{x:.2f} m, N %{y:.2f} m, h %{customdata:.2f} m<extra></extra>",
    }  # fmt: skip
    return figure_of(
        [track],
        380,
        hovermode="closest",
        showlegend=False,
        xaxis={"title": {"text": "east [m]"}},
        yaxis={"title": {"text": "north [m]"}, "scaleanchor": "x", "scaleratio": 1},
    )


# --- prediction -----------------------------------------------------------------------------------


def prediction(
    channel: str,
    measured: tuple[np.ndarray, np.ndarray],
    predicted: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    noise: float | None = None,
    points: int = MOST_POINTS,
) -> Figure:
    """One channel of one run: measured and predicted above, the errors below.

    Args:
        channel: what is measured; numbers are in the unit in which it is read, angles in degrees.
        measured: times (n,) and readings (n,).
        predicted: model's name -> times (m,) at the horizon's end, predictions (m,), errors (m,);
            the first is drawn as *before*, the second as *after*.
        noise: std of the reading, shown as a band about zero error.
        points: at most so many per curve.
    """
    titles = [axis_title(channel), axis_title(channel, "error")]
    layout = stacked_axes([0.64, 0.36], titles, spacing=0.07)
    finite = np.isfinite(measured[1])
    kept = thinned(int(finite.sum()), points)
    t, y = (values[finite][kept] for values in measured)
    data = [curve(t, y, "measured", MEASURED, mode="markers")]
    for (name, (times, values, error)), colour in zip(
        predicted.items(), (BEFORE, AFTER), strict=False
    ):
        kept = thinned(len(times), points)
        at, line, below = _broken(times[kept], values[kept], error[kept])
        data.append(curve(at, line, name, colour))
        data.append(curve(at, below, name, colour, 2, showlegend=False))
    if noise:
        layout["shapes"] = [horizontal_band(-noise, noise, "y2")]
    return figure_of(data, 400, **layout)


BREAK = 4.0
"""Usual times between two predictions from which on no line joins them: something was cut out; ours."""


def _broken(t: np.ndarray, *lines: np.ndarray) -> list[np.ndarray]:
    """Times and lines (n,) with a hole wherever much more time than usual passes between two."""
    steps = np.diff(t)
    moving = steps[steps > 0.0]
    usual = float(np.median(moving)) if moving.size else 0.0
    behind = 1 + np.flatnonzero(steps > BREAK * usual)
    return [np.insert(t, behind, t[behind]), *(np.insert(y, behind, np.nan) for y in lines)]


def gain_bars(channels: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Prediction error per channel in per cent of the bare model's: refitted, corrected, noise.

    Args:
        channels: findings.json's ``gain.channels``.
    """
    names = [c for c in channels if channels[c].get("before")][::-1]
    labels = channel_labels(names)
    percent = {key: _percents(channels, names, key) for key in _BARS}
    after, below, above = percent["after"], *_whiskers(channels, names)

    def trace(key: str, **style: Any) -> dict[str, Any]:
        words = [with_unit(channels[c].get(key), channels[c].get("unit", "")) for c in names]
        return {
            "y": labels, "x": percent[key], "name": _BARS[key], "customdata": words,
            "hovertemplate": "%{y}: %{customdata}<extra>" + _BARS[key] + "</extra>", **style,
        }  # fmt: skip

    bar = {"type": "bar", "orientation": "h"}
    dot = {"type": "scatter", "mode": "markers"}
    upright = {"symbol": "line-ns", "size": 20, "line": {"color": BEFORE, "width": 4}}
    whisker = {
        "type": "data", "symmetric": False, "array": above, "arrayminus": below, "color": AFTER,
        "thickness": 2, "width": 4,
    }  # fmt: skip
    removed = {
        "y": labels, "x": [None if a is None else 100.0 - a for a in after], "base": after,
        "width": 0.28, "name": "removed", "marker": {"color": AFTER, "opacity": 0.3},
        "hoverinfo": "skip", "showlegend": False, **bar,
    }  # fmt: skip
    ends = [a + h for a, h in zip(after, above, strict=True) if a is not None]
    most = max([100.0, *ends, *(x for x in percent["before_refitted"] if x is not None)])
    return figure_of(
        [
            trace("noise", marker={"color": NOISE, "opacity": 0.3}, **bar),
            removed,
            trace("before", marker=upright | {"color": BEFORE}, **dot),
            trace(
                "before_refitted", marker={"color": REFITTED, "symbol": "diamond", "size": 9}, **dot
            ),
            trace("after", marker={"color": AFTER, "size": 11}, error_x=whisker, **dot),
        ],
        110 + 34 * max(len(names), 2),
        barmode="overlay",
        bargap=0.35,
        hovermode="closest",
        xaxis={
            "title": {"text": "error, % of the bare model's"},
            "range": [0, min(1.05 * most, 400)],
        },
        yaxis={"ticklabelstandoff": 6},
    )


_BARS = {
    "noise": "sensor noise, out of reach",
    "before": "bare",
    "before_refitted": "bare, refitted",
    "after": "corrected",
}
"""Keys of findings.json's ``gain.channels``, and what the legend calls them."""


def _percents(
    channels: Mapping[str, Mapping[str, Any]], names: Sequence[str], key: str
) -> list[float | None]:
    """An entry of each channel in per cent of the bare model's error."""
    return [_percent(channels[c].get(key), channels[c]["before"]) for c in names]


def _percent(part: float | None, whole: float) -> float | None:
    return None if part is None else 100.0 * part / whole


def _whiskers(
    channels: Mapping[str, Mapping[str, Any]], names: Sequence[str]
) -> tuple[list[float], list[float]]:
    """How far each 95 % interval reaches below and above its value, in per cent; 0 without one."""
    below, above = [], []
    for name, middle in zip(names, _percents(channels, names, "after"), strict=True):
        entry = channels[name]
        low, high = (_percent(end, entry["before"]) for end in entry.get("ci95") or (None, None))
        below.append(0.0 if middle is None or low is None else max(middle - low, 0.0))
        above.append(0.0 if middle is None or high is None else max(high - middle, 0.0))
    return below, above


def heat_map(
    rows: Sequence[str],
    columns: Sequence[str],
    values: np.ndarray,
    text: Sequence[Sequence[str]],
    legend: str,
    *,
    centred: bool = False,
    log: bool = False,
) -> Figure:
    """A table as colours with its numbers in the cells.

    Args:
        rows: their names, n.
        columns: their names, m.
        values: what the colours show, (n, m); NaN leaves a cell empty.
        text: of the cells, n rows of m.
        legend: title of the colours' scale.
        centred: colours run from -1 to 1.
        log: colours are logarithmic, 0.5 to 100.
    """
    values = np.asarray(values, float)
    bar: dict[str, Any] = {"title": {"text": legend, "side": "right"}, "thickness": 10}
    limits: dict[str, float] = {}
    if log:
        values = np.log10(np.maximum(values, 1e-3))
        marks = [0.5, 1, 2, 5, 10, 20, 50, 100]
        bar |= {"tickvals": np.log10(marks).tolist(), "ticktext": [str(m) for m in marks]}
        limits = {"zmin": -0.3, "zmax": 2.0}
    elif centred:
        limits = {"zmin": -1.0, "zmax": 1.0}
    cells = {
        "type": "heatmap", "x": list(columns), "y": list(rows), "text": [list(r) for r in text],
        "z": [[None if not math.isfinite(v) else float(v) for v in row] for row in values],
        "texttemplate": "%{text}", "textfont": {"color": "#1b1e22"}, "xgap": 2, "ygap": 2,
        "colorscale": _TWO_SIDED if centred else _HEAT, "colorbar": bar, **limits,
        "hovertemplate": "%{y}, %{x}: %{text}<extra></extra>",
    }  # fmt: skip
    return figure_of(
        [cells],
        100 + max(30 * len(rows), 60),
        hovermode="closest",
        margin={"l": 10, "r": 0, "t": 60, "b": 8},
        xaxis={"side": "top", "showgrid": False, "tickangle": -45 if len(columns) > 4 else 0},
        yaxis={"autorange": "reversed", "showgrid": False},
    )


_HEAT = [[0.0, "#6cc3b2"], [0.14, "#b9ded6"], [0.3, "#f3e2c0"], [0.6, "#eb9a4a"], [1.0, "#dd5a35"]]
_TWO_SIDED = [[0.0, "#e0894a"], [0.5, "#f1f2f4"], [1.0, "#5fa6dc"]]


def grouped_bars(
    groups: Sequence[str],
    values: Mapping[str, Sequence[float | None]],
    title: str,
    log: bool = False,
    colours: Sequence[str] = CYCLE,
) -> Figure:
    """Bars next to each other in every group.

    Args:
        groups: their names.
        values: name in the legend -> one value per group; None leaves a gap.
        title: of the value axis.
        log: whether that is logarithmic.
        colours: one per name.
    """
    data = [
        {
            "type": "bar", "name": name, "marker": {"color": colours[k % len(colours)]},
            "x": list(groups), "y": list(bars),
            "hovertemplate": "%{x}: %{y:.3g}<extra>" + name + "</extra>",
        }
        for k, (name, bars) in enumerate(values.items())
    ]  # fmt: skip
    return figure_of(
        data,
        300,
        barmode="group",
        bargap=0.3,
        hovermode="closest",
        yaxis={"title": {"text": title}, **({"type": "log", "dtick": 1} if log else {})},
    )
