"""The kernel's input by name: ``u[U.DELTA_LON]``. The four commands, then time and battery (layout)."""

from coax_env.model.layout import N_INPUTS

OMEGA_U, OMEGA_L, DELTA_LON, DELTA_LAT, TIME, BATTERY = range(N_INPUTS)
