"""The parameter vector: the base model's numbers first, the effects' after them.

A vehicle becomes one vector of doubles, which is all the compiled kernel knows of it. Effects are
appended in the order of the catalogue, see effects.py.
"""

BASE = {
    "mass": "kg",
    "gravity": "m/s2",
    "air_density": "kg/m3",
    "rotor_radius": "m",
    "fuselage_length": "m",
    "fuselage_width": "m",
    "fuselage_drag_coefficient": "1",
    "arm_upper": "m",
    "arm_lower": "m",
    "inertia_xx": "kg m2",
    "inertia_yy": "kg m2",
    "inertia_zz": "kg m2",
    "rotor_inertia_upper": "kg m2",
    "rotor_inertia_lower": "kg m2",
    "flybar_inertia": "kg m2",
    "thrust_coefficient_upper": "1",
    "thrust_coefficient_lower": "1",
    "torque_coefficient_upper": "1",
    "torque_coefficient_lower": "1",
    "flap_time_constant": "s",
    "flybar_time_constant": "s",
    "swash_to_flap": "1",
    "flybar_to_rotor_lon": "1",
    "flybar_to_rotor_lat": "1",
    "flap_coupling_lon": "1",
    "flap_coupling_lat": "1",
}
"""Name and unit of the numbers every vehicle file must have."""

(
    MASS, GRAVITY, AIR_DENSITY, ROTOR_RADIUS,
    FUSELAGE_LENGTH, FUSELAGE_WIDTH, FUSELAGE_DRAG,
    ARM_U, ARM_L, INERTIA_XX, INERTIA_YY, INERTIA_ZZ,
    ROTOR_INERTIA_U, ROTOR_INERTIA_L, FLYBAR_INERTIA,
    C_TU, C_TL, C_QU, C_QL,
    FLAP_TIME, FLYBAR_TIME, SWASH_TO_FLAP, FLYBAR_TO_ROTOR_LON, FLYBAR_TO_ROTOR_LAT,
    FLAP_COUPLING_LON, FLAP_COUPLING_LAT,
) = range(len(BASE))  # fmt: skip

# Gusts act on the machine as it is in the file: fitting a mass or an inertia must not change how much
# acceleration the gusts are allowed, or the fit would hide misfit in it.
GUST_MASS, GUST_INERTIA_XX, GUST_INERTIA_YY, GUST_INERTIA_ZZ = range(len(BASE), len(BASE) + 4)
"""Reference mass and inertias of the gust states [kg, kg m2]."""
GUST_REFERENCE = {
    GUST_MASS: MASS,
    GUST_INERTIA_XX: INERTIA_XX,
    GUST_INERTIA_YY: INERTIA_YY,
    GUST_INERTIA_ZZ: INERTIA_ZZ,
}

(
    MEMORY_FORCE_XY, MEMORY_FORCE_Z, MEMORY_MOMENT_XY, MEMORY_MOMENT_Z,
) = range(GUST_INERTIA_ZZ + 1, GUST_INERTIA_ZZ + 5)  # fmt: skip
"""Correlation times of the gust states [s], by group of axes."""
GUST_MEMORIES = slice(MEMORY_FORCE_XY, MEMORY_MOMENT_Z + 1)

AIR_DOWN = MEMORY_MOMENT_Z + 1
"""Velocity of the air downwards [m/s], beside the effect `wind`: zero but in turbulence.py's air."""

COMMAND_GAINS = {
    "command_gain.rate_xy": "rad/s per rad",
    "command_gain.moment_xy": "N m per rad",
    "command_gain.force_xy": "N per rad",
    "command_gain.rate_z": "1",
    "command_gain.moment_z": "N m per rad/s",
    "command_gain.speed_z": "m/s per rad/s",
    "command_gain.force_z": "N per rad/s",
}
"""Gains by which input innovations correct the filter's state (input_innovations.py); zero in a
simulation."""
COMMAND_GAIN = AIR_DOWN + 1
(
    COMMAND_GAIN_RATE_XY, COMMAND_GAIN_MOMENT_XY, COMMAND_GAIN_FORCE_XY,
    COMMAND_GAIN_RATE_Z, COMMAND_GAIN_MOMENT_Z, COMMAND_GAIN_SPEED_Z, COMMAND_GAIN_FORCE_Z,
) = range(COMMAND_GAIN, COMMAND_GAIN + len(COMMAND_GAINS))  # fmt: skip

N_FIXED = COMMAND_GAIN + len(COMMAND_GAINS)
# after it: one switch per stage, then the effects' parameters
