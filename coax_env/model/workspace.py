"""The kernel's workspace: every quantity between state and derivative has one named place.

The kernel (dynamics.py) fills it, effects (effects.py) read and change it. Body axes unless said.
"""

from coax_env.model.layout import N_CHANNELS

(
    TIME,  # since the start of the run [s]
    BATTERY,  # voltage over the nominal one [V]
    # properties, before any effect those of the vehicle file
    MASS, INERTIA_XX, INERTIA_YY, INERTIA_ZZ,
    SWASH_TO_FLAP, FLAP_TIME, FLYBAR_TIME,
    THRUST_FACTOR_U, THRUST_FACTOR_L,  # T / omega^2 [N s2]
    TORQUE_FACTOR_U, TORQUE_FACTOR_L,  # Q / omega^2 [N m s2]
    # actuators
    MOTOR_LAG_U, MOTOR_LAG_L, SERVO_LAG,  # [s]
    SPEED_SHARE_U, SPEED_REST_U, SPEED_SHARE_L, SPEED_REST_L,  # speed asked for: share command + rest
    SPEED_SCALE,  # rotor speed reached per speed asked for [1]
    SERVO_PLAY, SERVO_DEADBAND,  # [rad]
    SERVO_RATE,  # most that the plate's tilt changes [rad/s]; 0: no limit
    LON_STEP, LAT_STEP,  # by how much this row moves the swash plate's command on [rad]
    OMEGA_U, OMEGA_L, OMEGA_U_DOT, OMEGA_L_DOT,
    DELTA_LON, DELTA_LAT,  # swash plate tilt as the rotor feels it
    INFLOW_TIME, HOVER_U, HOVER_L,  # [s], [rad/s]; where an effect needs them
    # attitude and air
    SIN_PHI, COS_PHI, SIN_THETA, COS_THETA, SIN_PSI, COS_PSI,
    HEIGHT,
    AIR_U, AIR_V, AIR_W,  # velocity through the air
    # loads
    ALPHA_U, BETA_U, ALPHA_L, BETA_L,  # tilt of the two discs
    THRUST_U, THRUST_L, TORQUE_U, TORQUE_L,
    ROTOR_X, ROTOR_Y, ROTOR_Z,  # force of both rotors
    FORCE_X, FORCE_Y, FORCE_Z,  # all but gravity
    MOMENT_X, MOMENT_Y, MOMENT_Z,
    # rates of change
    ALPHA_L_DOT, BETA_L_DOT,
    P_DOT, Q_DOT, R_DOT,
    READING,  # first of the N_CHANNELS sensor readings
) = range(68)  # fmt: skip
N_FLOW = READING + N_CHANNELS
