"""The full state's places by name: ``x[S.Q]`` is the pitch rate. Units: layout.FULL_STATES."""

from coax_env.model.layout import N_FULL

(
    U, V, W,  # velocity in body axes
    P, Q, R,  # body rates
    ALPHA_L, BETA_L,  # tilt of the lower disc
    ALPHA_F, BETA_F,  # tilt of the fly-bar
    PHI, THETA, PSI,
    X, Y, Z,  # position: north, east, down
    OMEGA_U, OMEGA_L, SWASH_LON, SWASH_LAT,  # actuators, where they are
    GUST_X, GUST_Y, GUST_Z,  # force
    GUST_L, GUST_M, GUST_N,  # moment
    TRIM_Z, TRIM_N,  # drift of thrust and torque
    INFLOW,
) = range(N_FULL)  # fmt: skip
