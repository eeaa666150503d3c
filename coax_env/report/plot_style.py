"""The style of every figure: colours, axes, curves.

A figure is a plain dict ``{"data": [...], "layout": {...}}``, plotly's own form: `plotly.io.show`
takes it as it is, report pages embed it, and making one needs no import and no time.

Colours read on light and dark ground alike and by colour-blind eyes (after Okabe and Ito); ground,
ink and grid come from `plotly_template`, by the reader's scheme.
"""

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from coax_env.model.layout import CHANNEL_UNITS
from coax_env.plain_words import CHANNEL_NAMES, UNITS

Figure = dict[str, Any]

MEASURED = "#8b929c"
BEFORE = "#e07b16"
AFTER = "#2f8fd6"
REFITTED = "#b583d6"
NOISE = "#1fa187"
CYCLE = (AFTER, BEFORE, NOISE, REFITTED, "#d0558f", "#a58b2a")
DASHES = ("solid", "dash", "dot")

MOST_POINTS = 1200
"""A curve with more points is thinned: a screen has no more."""


def plotly_template(dark: bool = False) -> dict[str, Any]:
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
            "colorway": list(CYCLE),
            "xaxis": axis,
            "yaxis": axis,
            "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom"},
            "margin": {"l": 48, "r": 10, "t": 34, "b": 36},
            "hovermode": "x unified",
            "hoverlabel": {"bgcolor": "#22262b" if dark else "#ffffff", "font": {"color": ink}},
        }
    }


# --- parts ----------------------------------------------------------------------------------------


def figure_of(data: list[dict[str, Any]], height: int, **layout: Any) -> Figure:
    """A figure of traces; height [px], further entries of plotly's layout."""
    return {"data": data, "layout": {"height": height, "autosize": True, **layout}}


def packed(values: Any) -> Any:
    """Numbers as plotly's typed arrays in single precision, base64: small, and exact enough."""
    array = np.ascontiguousarray(values, "<f4")
    return {"dtype": "f4", "bdata": base64.b64encode(array.tobytes()).decode()}


def thinned(count: int, points: int = MOST_POINTS) -> slice:
    """Slice that keeps at most `points` of `count` samples, evenly."""
    return slice(None, None, max(1, math.ceil(count / points)))


def curve(
    x: np.ndarray, y: np.ndarray, name: str, colour: str, row: int = 1, **more: Any
) -> dict[str, Any]:
    """A line, or points where ``mode="markers"``.

    Args:
        x: (n,).
        y: (n,), NaN where the line has a gap.
        name: in the legend.
        colour: as in HTML.
        row: of `stacked_axes`, from 1 above.
        more: further entries of plotly's trace.
    """
    kept = thinned(len(x))
    trace = {
        "type": "scatter", "mode": "lines", "x": packed(x[kept]),
        "y": packed(y[kept]), "name": name, "legendgroup": name,
        "hovertemplate": "%{y:.3~g}", **_row_axis(row),
    }  # fmt: skip
    if more.get("mode") == "markers":
        return trace | {"marker": {"color": colour, "size": 3.5, "opacity": 0.75}} | more
    return trace | {"line": {"color": colour, "width": 1.7}} | more


def _row_axis(row: int) -> dict[str, str]:
    """A trace's axes in a stack: all rows share the last x axis unless they have their own."""
    return {} if row == 1 else {"yaxis": f"y{row}"}


def stacked_axes(heights: Sequence[float], titles: Sequence[str], spacing: float) -> dict[str, Any]:
    """Layout of rows over one x axis, time [s].

    Args:
        heights: of the rows from above, relative.
        titles: of their y axes.
        spacing: between two rows, as a share of the figure's height.
    """
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


def horizontal_band(low: float, high: float, yref: str, xref: str = "paper") -> dict[str, Any]:
    """A shaded band from `low` to `high` across the whole row.

    Args:
        low: lower edge.
        high: upper edge.
        yref: the y axis in whose unit they are, such as ``"y2"``.
        xref: what it spans.
    """
    return {
        "type": "rect", "xref": xref, "yref": yref, "x0": 0, "x1": 1, "y0": low, "y1": high,
        "fillcolor": NOISE, "opacity": 0.18, "line": {"width": 0},
    }  # fmt: skip


def vertical_line(x: float) -> dict[str, Any]:
    """A line at `x` over the figure's whole height."""
    return {
        "type": "line", "xref": "x", "yref": "paper", "x0": x, "x1": x, "y0": 0, "y1": 1,
        "line": {"color": NOISE, "width": 2},
    }  # fmt: skip


def axis_title(channel: str, name: str = "") -> str:
    """``height [m]``, or ``NAME [m]``."""
    unit = CHANNEL_UNITS[channel]
    return f"{name or CHANNEL_NAMES[channel]} [{UNITS.get(unit, unit)}]"


def channel_labels(channels: Sequence[str]) -> list[str]:
    """Channels by their names in words."""
    return [CHANNEL_NAMES.get(c, c) for c in channels]
