"""A warning where wind is asked for and nothing of the vehicle feels it."""

from collections.abc import Sequence

import numpy as np
from gymnasium import logger

from coax_env.model.dynamics import full_derivative, full_state, hover_trim, kernel_input
from coax_env.model.vehicle import Vehicle

_WIND = 1.0  # [m/s] from the north-east: any that is not nothing
_FELT = 1e-6  # [m/s2, rad/s2] ours: rounding leaves 1e-12, a usual drag 0.1
TILTED = "axial_damping"
"""What feels a horizontal wind as soon as the machine tilts, and turbulence at once."""


def feels_wind(vehicle: Vehicle) -> bool:
    """Whether moving air moves the vehicle; the bare model has no force that feels it."""
    if TILTED in vehicle.effects:
        return True
    state, command = hover_trim(vehicle)
    x, u = full_state(state, command, vehicle), kernel_input(command)
    calm = vehicle.without_effects(("wind",))
    blown = calm.with_effect("wind", north=_WIND, east=_WIND)
    difference = full_derivative(x, u, blown) - full_derivative(x, u, calm)
    return bool(np.abs(difference).max() > _FELT)


def warn_where_wind_cannot_act(vehicles: Sequence[Vehicle], wind: bool, turbulence: bool) -> None:
    """Say so, by Gymnasium's logger.

    Args:
        vehicles: that may fly. wind, turbulence: whether there is any.
    """
    if not (wind or turbulence) or any(feels_wind(vehicle) for vehicle in vehicles):
        return
    what = " and ".join(["wind"] * wind + ["turbulence"] * turbulence)
    logger.warn(
        f"{what} cannot act on {vehicles[0].name!r}: it has no drag, damping or blow-back; fly a"
        " vehicle that has (effects rotor_drag, airframe_drag, flap_blowback), or ask for gusts="
    )
