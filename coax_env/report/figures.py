"""Figures: data in, plotly figure out, in one house style.

A figure is a plain dict ``{"data": [...], "layout": {...}}``, plotly's own form: `plotly.io.show`
takes it as it is, report pages embed it, and making one needs no import and no time.

Colours read on light and dark ground alike and by colour-blind eyes (after Okabe and Ito); ground,
ink and grid come from `template`, by the reader's scheme.
"""

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coax_env.model.layout import CHANNEL_UNITS
from coax_env.plain_words import CHANNEL_NAMES, UNITS, number

Figure = dict[str, Any]

MEASURED = "#8b929c"
BEFORE = "#e07b16"
AFTER = "#2f8fd6"
REFITTED = "#b583d6"
NOISE = "#1fa187"
WHEEL = (AFTER, BEFORE, NOISE, REFITTED, "#d0558f", "#a58b2a")
DASHES = ("solid", "dash", "dot")

MOST_POINTS = 1200
"""A curve with more points is thinned: a screen has no more."""


def template(dark: bool = False) -> dict[str, Any]:
    """The house style as a plotly template."""
    ink, grid = ("#d7dbe0", "#353b43") if dark else ("#2b3036", "#e3e6ea")
    axis = {
        "gridcolor": grid, "zerolinecolor": grid, "linecolor": grid, "automargin": True,
        "ticks": "", "title": {"standoff": 6, "font": {"size": 14}}, "zerolinewidth": 1.5,
    }  # fmt: skip
    return {
        "layout": {
            "font": {"family": "system-ui, sans-serif", "size": 14, "color": ink},
            "paper_bgcolor": "rgba(0,0,0,0)",
            "plot_bgcolor": "rgba(0,0,0,0)",
            "colorway": list(WHEEL),
            "xaxis": axis,
            "yaxis": axis,
            "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"},
            "margin": {"l": 48, "r": 10, "t": 34, "b": 36},
            "hovermode": "x unified",
            "hoverlabel": {"bgcolor": "#22262b" if dark else "#ffffff", "font": {"color": ink}},
        }
    }


# --- parts ----------------------------------------------------------------------------------------


def _figure(data: list[dict[str, Any]], height: int, **layout: Any) -> Figure:
    return {"data": data, "layout": {"height": height, "autosize": True, **layout}}


def numbers(values: Any) -> Any:
    """Numbers as plotly's typed arrays in single precision: small, and more than a screen shows."""
    array = np.ascontiguousarray(values, "<f4")
    return {"dtype": "f4", "bdata": base64.b64encode(array.tobytes()).decode()}


def _curve(x: Any, y: Any, name: str, colour: str, row: int = 1, **more: Any) -> dict[str, Any]:
    every = max(1, math.ceil(len(x) / MOST_POINTS))
    trace = {
        "type": "scatter", "mode": "lines", "x": numbers(np.asarray(x)[::every]),
        "y": numbers(np.asarray(y)[::every]), "name": name, "legendgroup": name,
        "hovertemplate": "%{y:.3~g}", **_axes(row),
    }  # fmt: skip
    if more.get("mode") == "markers":
        return trace | {"marker": {"color": colour, "size": 3.5, "opacity": 0.75}} | more
    return trace | {"line": {"color": colour, "width": 1.7}} | more


def _axes(row: int) -> dict[str, str]:
    """A trace's axes in a stack: all rows share the last x axis unless they have their own."""
    return {} if row == 1 else {"yaxis": f"y{row}"}


def _stack(heights: Sequence[float], titles: Sequence[str], spacing: float) -> dict[str, Any]:
    """Layout of rows over one x axis, from above."""
    free = 1.0 - spacing * (len(heights) - 1)
    layout: dict[str, Any] = {}
    top = 1.0
    for row, (height, title) in enumerate(zip(heights, titles, strict=True), 1):
        bottom = max(top - free * height / sum(heights), 0.0)
        name = "yaxis" if row == 1 else f"yaxis{row}"
        layout[name] = {"domain": [bottom, top], "title": {"text": title}}
        top = bottom - spacing
    last = "y" if len(heights) == 1 else f"y{len(heights)}"
    layout["xaxis"] = {"anchor": last, "title": {"text": "time [s]"}}
    return layout


def _band(low: float, high: float, yref: str, xref: str = "paper") -> dict[str, Any]:
    return {
        "type": "rect", "xref": xref, "yref": yref, "x0": 0, "x1": 1, "y0": low, "y1": high,
        "fillcolor": NOISE, "opacity": 0.18, "line": {"width": 0},
    }  # fmt: skip


def _upright(x: float) -> dict[str, Any]:
    return {
        "type": "line", "xref": "x", "yref": "paper", "x0": x, "x1": x, "y0": 0, "y1": 1,
        "line": {"color": NOISE, "width": 2},
    }  # fmt: skip


def axis_title(channel: str) -> str:
    """``height [m]``."""
    unit = CHANNEL_UNITS[channel]
    return f"{CHANNEL_NAMES[channel]} [{UNITS.get(unit, unit)}]"


def _labels(channels: Sequence[str]) -> list[str]:
    return [CHANNEL_NAMES.get(c, c) for c in channels]


def bode(omega: np.ndarray, responses: Mapping[str, np.ndarray]) -> Figure:
    """Gain [dB] and phase [deg] of named frequency responses, complex (w,), over Hz."""
    layout = _stack([1.0, 1.0], ["gain [dB]", "phase [deg]"], spacing=0.08)
    layout["xaxis"] |= {"type": "log", "title": {"text": "frequency [Hz]"}}
    data = []
    for k, (name, values) in enumerate(responses.items()):
        phase = np.degrees(np.unwrap(np.angle(values)))
        phase -= 360.0 * np.round((phase[len(phase) // 2] + 180.0) / 360.0)
        for row, curve in ((1, 20.0 * np.log10(np.abs(values) + 1e-12)), (2, phase)):
            more = {"showlegend": row == 1, "line": {
                "color": WHEEL[k % len(WHEEL)], "width": 1.7, "dash": DASHES[k % 3]}}  # fmt: skip
            data.append(_curve(omega / (2.0 * math.pi), curve, name, "", row, **more))
    return _figure(data, 400, **layout)


# --- histories ------------------------------------------------------------------------------------


def histories(
    t: np.ndarray,
    panels: Sequence[tuple[str, Mapping[str, np.ndarray]]],
    points: int = MOST_POINTS,
) -> Figure:
    """Panels over one time axis; each has an axis title and named curves (n,)."""
    rows = len(panels)
    every = max(1, math.ceil(len(t) / points))
    layout = _stack([1.0] * rows, [title for title, _ in panels], spacing=0.24 / rows)
    data = []
    for row, (_, curves) in enumerate(panels, 1):
        legend = "legend" if row == 1 else f"legend{row}"
        axis = layout["yaxis" if row == 1 else f"yaxis{row}"]
        layout[legend] = {
            "orientation": "h", "x": 1, "xanchor": "right", "y": axis["domain"][1],
            "yanchor": "bottom", "bgcolor": "rgba(0,0,0,0)",
        }  # fmt: skip
        for k, (name, values) in enumerate(curves.items()):
            line = {"color": WHEEL[k % len(WHEEL)], "width": 1.7, "dash": DASHES[k % 3]}
            data.append(
                _curve(
                    t[::every],
                    values[::every],
                    name,
                    "",
                    row,
                    legend=legend,
                    line=line,
                    showlegend=True,
                )
                | {"legendgroup": f"{row} {name}"}
            )
    return _figure(data, 60 + 155 * rows, **layout)


def plan_view(north: np.ndarray, east: np.ndarray, height: np.ndarray) -> Figure:
    """The flight from above, coloured by height; east to the right, north up."""
    every = max(1, math.ceil(len(north) / MOST_POINTS))
    north, east, height = (a[::every] for a in (north, east, height))
    track = {
        "type": "scatter", "mode": "lines+markers", "x": numbers(east), "y": numbers(north),
        "line": {"color": MEASURED, "width": 1},
        "marker": {
            "size": 4, "color": numbers(height), "colorscale": "Viridis", "showscale": True,
            "colorbar": {"title": {"text": "h [m]"}, "thickness": 12},
        },
        "customdata": numbers(height),
        "hovertemplate": "E %{x:.2f} m, N %{y:.2f} m, h %{customdata:.2f} m<extra></extra>",
    }  # fmt: skip
    return _figure(
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
        measured: times (n,) and readings (n,).
        predicted: model's name -> times (m,) at the horizon's end, predictions (m,), errors (m,);
            the first is drawn as *before*, the second as *after*.
        noise: std of the reading, shown as a band about zero error.
        points: at most so many per curve.
    """
    layout = _stack([0.64, 0.36], [axis_title(channel), "error"], spacing=0.07)
    t, y = measured
    keep = np.isfinite(y)
    every = max(1, math.ceil(np.count_nonzero(keep) / points))
    t, y = t[keep][::every], y[keep][::every]
    data = [_curve(t, y, "measured", MEASURED, mode="markers")]
    for (name, (times, values, error)), colour in zip(
        predicted.items(), (BEFORE, AFTER), strict=False
    ):
        every = max(1, math.ceil(len(times) / points))
        times, values, error = times[::every], values[::every], error[::every]
        data.append(_curve(times, values, name, colour))
        data.append(_curve(times, error, name, colour, 2, showlegend=False))
    if noise:
        layout["shapes"] = [_band(-noise, noise, "y2")]
    return _figure(data, 400, **layout)


def gain_bars(channels: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Prediction error per channel in per cent of the bare model's: refitted, extended, noise.

    Args:
        channels: findings.json's ``gain.channels``.
    """
    names = [c for c in channels if channels[c].get("before")][::-1]
    labels = _labels(names)

    def share(key: str) -> list[float | None]:
        return [_percent(channels[c].get(key), channels[c]["before"]) for c in names]

    def trace(key: str, name: str, **more: Any) -> dict[str, Any]:
        words = [f"{number(channels[c].get(key))} {channels[c].get('unit', '')}" for c in names]
        return {
            "y": labels, "x": share(key), "name": name, "customdata": words,
            "hovertemplate": "%{y}: %{customdata}<extra>" + name + "</extra>", **more,
        }  # fmt: skip

    bar = {"type": "bar", "orientation": "h"}
    after = share("after")
    low, high = [], []
    for c, middle in zip(names, after, strict=True):
        ends = [_percent(e, channels[c]["before"]) for e in channels[c].get("ci95") or (None, None)]
        low.append(0.0 if middle is None or ends[0] is None else max(middle - ends[0], 0.0))
        high.append(0.0 if middle is None or ends[1] is None else max(ends[1] - middle, 0.0))
    whisker = {
        "type": "data", "symmetric": False, "array": high, "arrayminus": low, "color": AFTER,
        "thickness": 2, "width": 4,
    }  # fmt: skip
    dot = {"type": "scatter", "mode": "markers"}
    upright = {"symbol": "line-ns", "size": 20}
    data = [
        trace("noise", "sensor noise, out of reach", marker={"color": NOISE, "opacity": 0.3}, **bar),
        {
            "y": labels, "x": [None if a is None else 100.0 - a for a in after], "base": after,
            "width": 0.28, "name": "removed", "marker": {"color": AFTER, "opacity": 0.3},
            "hoverinfo": "skip", "showlegend": False, **bar,
        },
        trace("before", "bare", marker={
            **upright, "color": BEFORE, "line": {"color": BEFORE, "width": 4}}, **dot),
        trace("before_refitted", "bare, refitted", marker={
            "color": REFITTED, "symbol": "diamond", "size": 9}, **dot),
        trace("after", "extended", marker={"color": AFTER, "size": 11}, error_x=whisker, **dot),
    ]  # fmt: skip
    reach = [a + h for a, h in zip(after, high, strict=True) if a is not None]
    top = max([100.0, *reach, *(x for x in share("before_refitted") if x is not None)])
    return _figure(
        data,
        110 + 34 * max(len(names), 2),
        barmode="overlay",
        bargap=0.35,
        hovermode="closest",
        xaxis={
            "title": {"text": "error, % of the bare model's"},
            "range": [0, min(1.05 * top, 400)],
        },
        yaxis={"ticklabelstandoff": 6},
    )


def _percent(part: float | None, whole: float) -> float | None:
    return None if part is None else 100.0 * part / whole


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
    """A table as colours with its numbers in the cells; ``centred`` runs from -1 to 1."""
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
    return _figure(
        [cells],
        100 + max(30 * len(rows), 60),
        hovermode="closest",
        margin={"l": 10, "r": 0, "t": 60, "b": 8},
        xaxis={"side": "top", "showgrid": False, "tickangle": -45 if len(columns) > 4 else 0},
        yaxis={"autorange": "reversed", "showgrid": False},
    )


_HEAT = [[0.0, "#6cc3b2"], [0.14, "#b9ded6"], [0.3, "#f3e2c0"], [0.6, "#eb9a4a"], [1.0, "#dd5a35"]]
_TWO_SIDED = [[0.0, "#e0894a"], [0.5, "#f1f2f4"], [1.0, "#5fa6dc"]]


# --- innovations ----------------------------------------------------------------------------------


def rolling_rms(t: np.ndarray, values: np.ndarray, at: np.ndarray, window: float) -> np.ndarray:
    """Root mean square within half a window [s] of each time `at`, NaN where nothing is."""
    good = np.isfinite(values)
    total = np.concatenate([[0.0], np.cumsum(np.where(good, values, 0.0) ** 2)])
    count = np.concatenate([[0], np.cumsum(good)])
    first = np.searchsorted(t, at - 0.5 * window)
    last = np.searchsorted(t, at + 0.5 * window, side="right")
    n = count[last] - count[first]
    return np.where(n > 0, np.sqrt((total[last] - total[first]) / np.maximum(n, 1)), np.nan)


def autocorrelation(values: np.ndarray, lags: int) -> np.ndarray:
    """Autocorrelation at lags 0 .. lags of the samples that are there, shape (lags + 1,)."""
    y = values[np.isfinite(values)]
    y = y - y.mean() if len(y) else y
    power = float(y @ y)
    if len(y) < 2 * lags or power == 0.0:
        return np.full(lags + 1, np.nan)
    return np.array([float(y[k:] @ y[: len(y) - k]) / power for k in range(lags + 1)])


def innovations(t: np.ndarray, before: np.ndarray, after: np.ndarray, lags: int = 40) -> Figure:
    """Whitened innovations of a channel: rms over one second, autocorrelation over lag.

    A model that misses nothing has rms 1 and no autocorrelation.
    """
    at = np.linspace(t[0], t[-1], 150)
    limit = 1.96 / math.sqrt(max(int(np.isfinite(after).sum()), 1))
    data = []
    for name, values, colour in (("before", before, BEFORE), ("after", after, AFTER)):
        data.append(_curve(at, rolling_rms(t, values, at, 1.0), name, colour))
        correlation = autocorrelation(values, lags)[1:]
        data.append(
            _curve(np.arange(1, lags + 1), correlation, name, colour, 2, showlegend=False)
            | {"xaxis": "x2"}
        )
    return _figure(
        data,
        420,
        xaxis={"anchor": "y", "title": {"text": "time [s]"}},
        xaxis2={"anchor": "y2", "title": {"text": "lag [samples]"}},
        yaxis={"domain": [0.58, 1], "title": {"text": "rms over 1 s"}, "rangemode": "tozero"},
        yaxis2={"domain": [0, 0.4], "title": {"text": "autocorrelation"}},
        shapes=[_band(-limit, limit, "y2")],
    )


def whiteness_bars(shares: Mapping[str, tuple[float, float]], threshold: float) -> Figure:
    """Share of each channel's innovations that their own past predicts, before and after.

    Args:
        shares: channel -> (before, after), 0 to 1.
        threshold: share up to which a channel counts as white.
    """
    names = list(shares)[::-1]
    data = [
        {
            "type": "bar", "orientation": "h", "name": name, "marker": {"color": colour},
            "y": _labels(names), "x": [100.0 * shares[c][k] for c in names],
            "hovertemplate": "%{y}: %{x:.1f} %<extra>" + name + "</extra>",
        }
        for k, name, colour in ((1, "after", AFTER), (0, "before", BEFORE))
    ]  # fmt: skip
    return _figure(
        data,
        96 + 26 * max(len(names), 2),
        barmode="group",
        bargap=0.25,
        hovermode="closest",
        legend={"traceorder": "reversed"},
        xaxis={"title": {"text": "predictable from its own past [%]"}, "rangemode": "tozero"},
        yaxis={"ticklabelstandoff": 6},
        shapes=[_upright(100.0 * threshold)],
    )


def side_by_side(
    groups: Sequence[str],
    values: Mapping[str, Sequence[float | None]],
    title: str,
    log: bool = False,
    colours: Sequence[str] = WHEEL,
) -> Figure:
    """Bars of several contestants in every group; None leaves a gap.

    Args:
        values: contestant -> one value per group.
        title: of the value axis. log: whether that is logarithmic.
    """
    data = [
        {
            "type": "bar", "name": name, "marker": {"color": colours[k % len(colours)]},
            "x": list(groups), "y": list(bars),
            "hovertemplate": "%{x}: %{y:.3g}<extra>" + name + "</extra>",
        }
        for k, (name, bars) in enumerate(values.items())
    ]  # fmt: skip
    return _figure(
        data,
        300,
        barmode="group",
        bargap=0.3,
        hovermode="closest",
        yaxis={"title": {"text": title}, **({"type": "log", "dtick": 1} if log else {})},
    )


def evidence_steps(steps: Sequence[tuple[str, float]]) -> Figure:
    """Gain in log-likelihood of each step of the search, in order from above."""
    gains = [float(gain) for _, gain in steps][::-1]
    bars = {
        "type": "bar", "orientation": "h", "marker": {"color": AFTER}, "x": gains,
        "y": [f"{k}. {name}" for k, (name, _) in enumerate(steps, 1)][::-1],
        "text": [number(g) for g in gains], "textposition": "auto",
        "hovertemplate": "%{y}: %{x:.1f} nats<extra></extra>",
    }  # fmt: skip
    return _figure(
        [bars],
        76 + 32 * max(len(steps), 2),
        hovermode="closest",
        showlegend=False,
        margin={"t": 10},
        xaxis={"title": {"text": "gain in log-likelihood [nats]"}, "rangemode": "tozero"},
        yaxis={"ticklabelstandoff": 6},
    )


def parameter_moves(moves: Mapping[str, tuple[float, float]]) -> Figure:
    """Fitted parameters: how far each moved, and its std now, both in stds of its prior."""
    names = list(moves)[::-1]
    dots = {
        "type": "scatter", "mode": "markers", "marker": {"color": AFTER, "size": 9},
        "y": names, "x": [moves[n][0] for n in names],
        "error_x": {"type": "data", "array": [moves[n][1] for n in names], "color": AFTER},
        "hovertemplate": "%{y}: moved %{x:.2f} prior stds<extra></extra>",
    }  # fmt: skip
    band = {
        "type": "rect", "xref": "x", "yref": "paper", "x0": -1, "x1": 1, "y0": 0, "y1": 1,
        "fillcolor": NOISE, "opacity": 0.15, "line": {"width": 0},
    }  # fmt: skip
    return _figure(
        [dots],
        76 + 26 * max(len(names), 2),
        hovermode="closest",
        showlegend=False,
        margin={"t": 10},
        xaxis={"title": {"text": "move from the prior, in its std (bar: std after the fit)"}},
        yaxis={"ticklabelstandoff": 6},
        shapes=[band],
    )


def repeatability(
    joint: Mapping[str, tuple[float, float]],
    runs: Mapping[str, Mapping[str, tuple[float, float]]],
) -> Figure:
    """Each parameter as each run alone has it, in percent of the joint estimate.

    Args:
        joint: parameter -> value and std of all runs together. runs: run -> the same, where it tells.
    """
    names = [n for n in joint if any(n in found for found in runs.values())][::-1]
    place = {name: k for k, name in enumerate(names)}
    data = []
    for k, (run, found) in enumerate(runs.items()):
        told = [n for n in names if n in found]
        aside = 0.6 * ((k + 0.5) / len(runs) - 0.5)
        percent = [100.0 / abs(joint[n][0]) for n in told]
        dots = {
            "type": "scatter", "mode": "markers", "name": run,
            "marker": {"color": WHEEL[k % len(WHEEL)], "size": 6, "symbol": k // len(WHEEL)},
            "x": [(found[n][0] - joint[n][0]) * p for n, p in zip(told, percent, strict=True)],
            "y": [place[n] + aside for n in told],
            "error_x": {
                "type": "data", "thickness": 1, "width": 0,
                "array": [found[n][1] * p for n, p in zip(told, percent, strict=True)],
            },
            "customdata": told,
            "hovertemplate": "%{customdata}: %{x:+.1f} %",
        }  # fmt: skip
        data.append(dots)
    bands = [
        {
            "type": "rect", "xref": "x", "yref": "y", "fillcolor": NOISE, "opacity": 0.2,
            "line": {"width": 0}, "y0": place[n] - 0.4, "y1": place[n] + 0.4,
            "x0": -100.0 * joint[n][1] / abs(joint[n][0]),
            "x1": 100.0 * joint[n][1] / abs(joint[n][0]),
        }
        for n in names
    ]  # fmt: skip
    return _figure(
        data,
        120 + 46 * max(len(names), 2),
        hovermode="closest",
        xaxis={"title": {"text": "from the joint estimate [%] (green: its std)"}},
        yaxis={"tickvals": list(range(len(names))), "ticktext": names, "zeroline": False},
        shapes=bands,
    )
