"""A flight to be replayed on a page: the measured machine and the simulated ones, in three dimensions.

Drawn by flight_view.js on a canvas and not by plotly: it shows attitudes, prints, leaves a finger free
to scroll the page, and needs no WebGL.
"""

from collections.abc import Collection, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from coax_env.estimation.trajectories import Trajectory
from coax_env.report.figures import MEASURED, numbers
from coax_env.report.page import data_script, inline

LEAST_ROOM = 1.8  # m from the camera to the machine
SPEEDS = ("0.25", "0.5", "1", "2", "4")


def flight_view(
    flown: Sequence[Trajectory],
    colours: Mapping[str, str],
    radius: float,
    marked: Collection[str],
    caption: str,
) -> str:
    """A player of runs, each shown first where the simulations part most.

    Args:
        colours: of the simulations, by their name in `flown`.
        radius: of the rotors [m]. marked: runs that were held out.
    """
    content = {
        "runs": [_run(one, list(colours)) for one in flown],
        "names": list(colours),
        "colours": list(colours.values()),
        "measured": MEASURED,
        "radius": radius,
    }
    runs = "".join(
        f"<option>{escape(one.run)}{' (held out of the fit)' if one.run in marked else ''}</option>"
        for one in flown
    )
    speeds = "".join(
        f'<option value="{s}"{" selected" if s == "1" else ""}>{s}×</option>' for s in SPEEDS
    )
    boxes = "".join(
        f'<label style="--mark:{colour}"><input type="checkbox" data-model="{k}" checked> '
        f"{escape(name)}</label>"
        for k, (name, colour) in enumerate(colours.items())
    )
    below = f'<figcaption>{inline(caption)} <span class="hint">Drag to turn.</span></figcaption>'
    return (
        '<figure class="flight"><div class="lists">'
        f'<label>run <select data-part="run">{runs}</select></label>'
        f'<span class="keys"><span style="--mark:{MEASURED}">measured</span>{boxes}</span></div>'
        '<canvas class="scene" role="img" aria-label="The flight in three dimensions"></canvas>'
        '<div class="zoom"><button type="button" data-zoom="1.25" aria-label="nearer">+</button>'
        '<button type="button" data-zoom="0.8" aria-label="farther">−</button></div>'
        '<canvas class="strip" role="img" aria-label="Distance of the simulations from the measured '
        'place over time"></canvas>'
        '<input type="range" step="0.01" data-part="time" aria-label="time">'
        '<div class="lists"><button type="button" data-part="play">Play</button>'
        f'<label>speed <select data-part="speed">{speeds}</select></label>'
        '<output data-part="clock"></output><output data-part="words"></output></div>'
        f"{data_script(content)}{below}</figure>"
    )


def _run(one: Trajectory, names: list[str]) -> dict[str, Any]:
    """One run as flight_view.js reads it."""
    astray = np.array([one.astray(name) for name in names])
    most = float(np.nanmax(astray, initial=0.0))
    return {
        "t": numbers(one.t)["bdata"],
        "begins": np.flatnonzero(one.begins).tolist(),
        "measured": numbers(one.measured.ravel())["bdata"],
        "models": [numbers(one.simulated[name].ravel())["bdata"] for name in names],
        "start": float(one.t[int(np.argmax(one.parted()))]),
        "most": max(most, 0.05),
        "room": max(LEAST_ROOM, 2.2 * min(most, 3.0)),
    }
