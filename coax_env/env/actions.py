"""What an action means: commands about the hover trim of a nominal vehicle."""

from pathlib import Path
from typing import Any

import numpy as np

from coax_env.env import hover
from coax_env.errors import InputError
from coax_env.model.dynamics import hover_trim
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import SHIPPED, load_vehicle

ROTOR_RANGE = 0.15  # of the nominal hover speed: an action of 1; ours, some 30 % of thrust
SWASH_RANGE = 0.2  # [rad]: an action of 1; ours
Nominal = str | Path | Vehicle | tuple[Any, Any] | None
"""What centres the action: a vehicle, or (trim, scale) as a controller stores them."""


def nominal_for(vehicle: Vehicle) -> Vehicle:
    """The shipped bare vehicle of the same name, else the vehicle without its effects."""
    shipped = SHIPPED / f"{vehicle.name}.toml"
    return (load_vehicle(shipped) if shipped.exists() else vehicle).without_effects()


def action_map(vehicle: Vehicle, nominal: Nominal = None) -> tuple[np.ndarray, np.ndarray]:
    """Trim and scale, each (4,): command = trim + scale * action, about the nominal hover."""
    if isinstance(nominal, tuple):
        trim, scale = (np.array(part, dtype=float) for part in nominal)
        if trim.shape != (4,) or scale.shape != (4,):
            raise InputError("nominal as numbers must be (trim, scale) with four numbers each")
        return trim, scale
    source = nominal_for(vehicle) if nominal is None else load_vehicle(nominal)
    trim = hover_trim(source, hover.HEIGHT)[1]
    return trim, np.array([ROTOR_RANGE * trim[0], ROTOR_RANGE * trim[1], SWASH_RANGE, SWASH_RANGE])
