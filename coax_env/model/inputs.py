"""The kernel's input by name: ``u[U.DELTA_LON]``. The four commands, then the run's time."""

from coax_env.model.layout import N_INPUTS

OMEGA_U, OMEGA_L, DELTA_LON, DELTA_LAT, TIME = range(N_INPUTS)
