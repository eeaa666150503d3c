"""What the actuators cannot do: travel of the swash plate, range of rotor speeds, and their rates.

A vehicle file may have these numbers; without them nothing is limited. They act on the command, once
a control period, before the lags and delays of the catalogue's effects.
"""

import numpy as np

from coax_env.kernel.compilation import compiled
from coax_env.kernel.simd import select
from coax_env.model.layout import N_COMMANDS
from coax_env.model.vehicle import Vehicle

LOWEST, HIGHEST, FASTEST = range(3)
"""Rows of the array of limits: of each command the lowest, the highest, and the rate per second."""


def limits(vehicle: Vehicle) -> np.ndarray:
    """Limits of the four commands, shape (3, 4); infinite where the vehicle file has none."""
    found = np.empty((3, N_COMMANDS))
    number = {name: parameter.value for name, parameter in vehicle.actuators.items()}
    found[LOWEST, :2] = number.get("rotor_speed_lowest", -np.inf)
    found[HIGHEST, :2] = number.get("rotor_speed_highest", np.inf)
    found[FASTEST, :2] = number.get("rotor_acceleration", np.inf)
    found[LOWEST, 2:] = -number.get("swash_travel", np.inf)
    found[HIGHEST, 2:] = number.get("swash_travel", np.inf)
    found[FASTEST, 2:] = number.get("swash_rate", np.inf)
    return found


@compiled()
def limit(command, before, limits, dt):
    """Hold a command (4,), in place, within the limits (3, 4), coming from the one `before`.

    The limited command is kept in `before` (4,). A command that is not a number stays so.

    Args:
        command: [rad/s, rad/s, rad, rad], (4,), in place. before: of the period before, (4,), in place.
        limits: of the function of that name, (3, 4). dt: control period [s].
    """
    for k in range(N_COMMANDS):
        most = limits[FASTEST, k] * dt
        value = command[k]
        value = select(value > before[k] + most, before[k] + most, value)
        value = select(value < before[k] - most, before[k] - most, value)
        value = select(value < limits[LOWEST, k], limits[LOWEST, k], value)
        value = select(value > limits[HIGHEST, k], limits[HIGHEST, k], value)
        command[k] = before[k] = value
