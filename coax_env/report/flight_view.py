"""A flight to be replayed on a page: the measured machine and the simulated ones, in three dimensions.

Drawn by flight_view.js on a canvas and not by plotly: it shows attitudes, prints, leaves a finger free
to scroll the page, and needs no WebGL.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from coax_env.estimation.trajectories import Trajectory
from coax_env.report.page import Markup, rendered
from coax_env.report.plot_style import MEASURED, packed

NEAREST_CAMERA = 1.8  # m from the camera to the machine
LEAST_SCALE = 0.05  # m, of the strip that shows the distances
SPEEDS = ("0.25", "0.5", "1", "2", "4")


def flight_view(
    paths: Sequence[Trajectory],
    colours: Mapping[str, str],
    radius: float,
    held_out: Collection[str],
    caption: str,
) -> Markup:
    """A player of runs, each shown first where the simulations differ most.

    Args:
        paths: one per run, in the order of the list to choose from.
        colours: of the simulations, by their name in `paths`.
        radius: of the rotors [m].
        held_out: names of the runs that were not fitted.
        caption: a line below it.
    """
    content = {
        "runs": [_run(path, list(colours)) for path in paths],
        "names": list(colours),
        "colours": list(colours.values()),
        "measured": MEASURED,
        "radius": radius,
    }
    return rendered(
        "flight_view.html",
        runs=[path.run for path in paths],
        held_out=held_out,
        colours=colours,
        measured=MEASURED,
        speeds=SPEEDS,
        content=content,
        caption=caption,
    )


def _run(path: Trajectory, names: list[str]) -> dict[str, Any]:
    """One run as flight_view.js reads it."""
    errors = np.array([path.position_error(name) for name in names])
    most = float(np.nanmax(errors, initial=0.0))
    return {
        "t": packed(path.t)["bdata"],
        "begins": np.flatnonzero(path.begins).tolist(),
        "measured": packed(path.measured.ravel())["bdata"],
        "models": [packed(path.simulated[name].ravel())["bdata"] for name in names],
        "start": float(path.t[int(np.argmax(path.error_removed()))]),
        "most": max(most, LEAST_SCALE),
        "room": max(NEAREST_CAMERA, 2.2 * min(most, 3.0)),
    }
