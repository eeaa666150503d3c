"""Pictures of the env's flights: kept in step with the fleet, drawn where they are wanted."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from coax_env.env.fleet import Fleet
from coax_env.errors import InputError

RENDER_MODES = ("human", "rgb_array")


def checked_render_mode(render_mode: str | None) -> str | None:
    """The mode itself.

    Raises:
        InputError: there is no such mode.
    """
    if render_mode not in (None, *RENDER_MODES):
        wanted = " or ".join(RENDER_MODES)
        raise InputError(f"render_mode must be None, {wanted}, found {render_mode!r}")
    return render_mode


class Screen:
    """Pictures of a fleet, where they are wanted; drawing is imported with the first of them."""

    def __init__(self, fleet: Fleet, render_mode: str | None) -> None:
        self._fleet, self._mode = fleet, render_mode
        self._renderer: Any = None
        self._traces: Any = None
        if render_mode is not None:
            from coax_env.env.rendering import Renderer
            from coax_env.env.scene import Traces

            self._renderer, self._traces = Renderer(), Traces(fleet)

    def update(self) -> None:
        """After a reset or a row flown: keep the positions, and show them on a screen now and then."""
        if self._mode is None:
            return
        from coax_env.env.rendering import HUMAN_EVERY

        self._traces.record()
        if self._mode == "human" and self._fleet.rows[0] % HUMAN_EVERY == 0:
            self._renderer.show(self._traces.view(0))

    def pictures(self, rows: Iterable[int]) -> tuple[np.ndarray, ...]:
        """One picture of each row."""
        return tuple(self._renderer.picture(self._traces.view(row)) for row in rows)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
