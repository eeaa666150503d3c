"""Figures of estimates: innovations, evidence, parameters."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coax_env.plain_words import number
from coax_env.report.plot_style import (
    AFTER,
    BEFORE,
    CYCLE,
    NOISE,
    Figure,
    channel_labels,
    curve,
    figure_of,
    horizontal_band,
    vertical_line,
)


def rolling_rms(t: np.ndarray, values: np.ndarray, at: np.ndarray, window: float) -> np.ndarray:
    """Root mean square in a window about each time `at`, (k,); NaN where it holds no sample.

    Args:
        t: times [s], rising, (n,).
        values: (n,), NaN where there is no sample.
        at: middles of the windows [s], (k,).
        window: their width [s].
    """
    good = np.isfinite(values)
    total = np.concatenate([[0.0], np.cumsum(np.where(good, values, 0.0) ** 2)])
    count = np.concatenate([[0], np.cumsum(good)])
    first = np.searchsorted(t, at - 0.5 * window)
    last = np.searchsorted(t, at + 0.5 * window, side="right")
    n = count[last] - count[first]
    return np.where(n > 0, np.sqrt((total[last] - total[first]) / np.maximum(n, 1)), np.nan)


def autocorrelation(values: np.ndarray, lags: int) -> np.ndarray:
    """Autocorrelation at lags 0 .. lags of the finite samples, (lags + 1,)."""
    y = values[np.isfinite(values)]
    y = y - y.mean() if len(y) else y
    power = float(y @ y)
    if len(y) < 2 * lags or power == 0.0:
        return np.full(lags + 1, np.nan)
    return np.array([float(y[k:] @ y[: len(y) - k]) / power for k in range(lags + 1)])


def innovations(t: np.ndarray, before: np.ndarray, after: np.ndarray, lags: int = 40) -> Figure:
    """Normalised innovations of a channel: rms over one second, autocorrelation over lag.

    Those of a true model have rms 1 and no autocorrelation: the band is +-1.96/sqrt(n).

    Args:
        t: times [s], (n,).
        before: innovations of the bare model in their own stds, (n,), NaN where none.
        after: those of the corrected model.
        lags: largest lag [samples].
    """
    at = np.linspace(t[0], t[-1], 150)
    limit = 1.96 / math.sqrt(max(int(np.isfinite(after).sum()), 1))
    data = []
    for name, values, colour in (("bare", before, BEFORE), ("corrected", after, AFTER)):
        data.append(curve(at, rolling_rms(t, values, at, 1.0), name, colour))
        correlation = autocorrelation(values, lags)[1:]
        data.append(
            curve(np.arange(1, lags + 1), correlation, name, colour, 2, showlegend=False)
            | {"xaxis": "x2"}
        )
    return figure_of(
        data,
        420,
        xaxis={"anchor": "y", "title": {"text": "time [s]"}},
        xaxis2={"anchor": "y2", "title": {"text": "lag [samples]"}},
        yaxis={"domain": [0.58, 1], "title": {"text": "rms over 1 s"}, "rangemode": "tozero"},
        yaxis2={"domain": [0, 0.4], "title": {"text": "autocorrelation"}},
        shapes=[horizontal_band(-limit, limit, "y2")],
    )


def whiteness_bars(shares: Mapping[str, tuple[float, float]], threshold: float) -> Figure:
    """Share of each channel's innovations that their own past predicts, bare and corrected.

    Args:
        shares: channel -> (bare, corrected), 0 to 1.
        threshold: share up to which a channel counts as white.
    """
    names = list(shares)[::-1]
    data = [
        {
            "type": "bar", "orientation": "h", "name": name, "marker": {"color": colour},
            "y": channel_labels(names), "x": [100.0 * shares[c][k] for c in names],
            "hovertemplate": "%{y}: %{x:.1f} %<extra>" + name + "</extra>",
        }
        for k, name, colour in ((1, "corrected", AFTER), (0, "bare", BEFORE))
    ]  # fmt: skip
    return figure_of(
        data,
        96 + 26 * max(len(names), 2),
        barmode="group",
        bargap=0.25,
        hovermode="closest",
        legend={"traceorder": "reversed"},
        xaxis={"title": {"text": "predictable from its own past [%]"}, "rangemode": "tozero"},
        yaxis={"ticklabelstandoff": 6},
        shapes=[vertical_line(100.0 * threshold)],
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
    return figure_of(
        [bars],
        76 + 32 * max(len(steps), 2),
        hovermode="closest",
        showlegend=False,
        margin={"t": 10},
        xaxis={"title": {"text": "gain in log-likelihood [nats]"}, "rangemode": "tozero"},
        yaxis={"ticklabelstandoff": 6},
    )


def parameter_moves(moves: Mapping[str, tuple[float, float]]) -> Figure:
    """Fitted parameters: how far each moved, and its std after the fit, both in its prior's std."""
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
    return figure_of(
        [dots],
        76 + 26 * max(len(names), 2),
        hovermode="closest",
        showlegend=False,
        margin={"t": 10},
        xaxis={"title": {"text": "move / prior std"}},
        yaxis={"ticklabelstandoff": 6},
        shapes=[band],
    )


def repeatability(
    joint: Mapping[str, tuple[float, float]],
    runs: Mapping[str, Mapping[str, tuple[float, float]]],
) -> Figure:
    """Each parameter as each run alone has it, in percent of the joint estimate.

    Args:
        joint: parameter -> value and std of all runs together.
        runs: run -> the same, of the parameters that it determines.
    """
    names = [n for n in joint if any(n in alone for alone in runs.values())][::-1]
    places = {name: place for place, name in enumerate(names)}
    data = []
    for k, (run, alone) in enumerate(runs.items()):
        offset = 0.6 * ((k + 0.5) / len(runs) - 0.5)
        data.append(_run_dots(run, k, joint, alone, {n: places[n] + offset for n in names}))
    return figure_of(
        data,
        120 + 46 * max(len(names), 2),
        hovermode="closest",
        xaxis={"title": {"text": "from the joint estimate [%] (green: its std)"}},
        yaxis={"tickvals": list(range(len(names))), "ticktext": names, "zeroline": False},
        shapes=[_std_box(*joint[name], place) for name, place in places.items()],
    )


def _run_dots(
    run: str,
    k: int,
    joint: Mapping[str, tuple[float, float]],
    alone: Mapping[str, tuple[float, float]],
    heights: Mapping[str, float],
) -> dict[str, Any]:
    """The k-th run's estimates with their stds, at the given heights."""
    names = [n for n in heights if n in alone]
    percent = {n: 100.0 / abs(joint[n][0]) for n in names}
    return {
        "type": "scatter", "mode": "markers", "name": run,
        "marker": {"color": CYCLE[k % len(CYCLE)], "size": 6, "symbol": k // len(CYCLE)},
        "x": [(alone[n][0] - joint[n][0]) * percent[n] for n in names],
        "y": [heights[n] for n in names],
        "error_x": {
            "type": "data", "thickness": 1, "width": 0,
            "array": [alone[n][1] * percent[n] for n in names],
        },
        "customdata": names,
        "hovertemplate": "%{customdata}: %{x:+.1f} %",
    }  # fmt: skip


def _std_box(value: float, std: float, place: float) -> dict[str, Any]:
    """The joint estimate's std in percent of its value, as a box about zero."""
    percent = 100.0 * std / abs(value)
    return {
        "type": "rect", "xref": "x", "yref": "y", "fillcolor": NOISE, "opacity": 0.2,
        "line": {"width": 0}, "y0": place - 0.4, "y1": place + 0.4, "x0": -percent, "x1": percent,
    }  # fmt: skip
