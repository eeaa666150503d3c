"""The vectors of the model: what stands where, under which name and in which unit.

Everything that indexes a state, a command, a parameter vector or a measurement takes its index from
here. Axes: body x forward, y right, z down; inertial x north, y east, z down; height h = -z.
"""

# --- state: the paper's sixteen, then actuators, then gusts -------------------------------------
STATES = (
    ("u", "m/s"), ("v", "m/s"), ("w", "m/s"),
    ("p", "rad/s"), ("q", "rad/s"), ("r", "rad/s"),
    ("alpha_l", "rad"), ("beta_l", "rad"),
    ("alpha_f", "rad"), ("beta_f", "rad"),
    ("phi", "rad"), ("theta", "rad"), ("psi", "rad"),
    ("x", "m"), ("y", "m"), ("z", "m"),
)  # fmt: skip
"""Name and unit of the paper's states (1)-(44), in order."""

ACTUATOR_STATES = (
    ("omega_u", "rad/s"), ("omega_l", "rad/s"), ("swash_lon", "rad"), ("swash_lat", "rad"),
)  # fmt: skip
"""What the actuators really do: they follow the commands, lagging where an effect says so."""

GUST_STATES = (
    ("gust_X", "N"), ("gust_Y", "N"), ("gust_Z", "N"),
    ("gust_L", "N m"), ("gust_M", "N m"), ("gust_N", "N m"),
)  # fmt: skip
"""Force and moment in body axes that decay with an exponential memory; zero outside the estimator."""

TRIM_STATES = (("trim_Z", "N"), ("trim_N", "N m"))
"""Force and yaw moment that drift: a random walk of thrust and torque; zero outside the estimator."""

INFLOW_STATES = (("inflow", "1"),)
"""Induced velocity over that at hover, less one; settled where it is the rotors' mean speed over
theirs, less one. It moves with the effect dynamic_inflow alone."""

FULL_STATES = STATES + ACTUATOR_STATES + GUST_STATES + TRIM_STATES + INFLOW_STATES
N_STATES = len(STATES)
N_FULL = len(FULL_STATES)

VELOCITY = slice(0, 3)
RATE = slice(3, 6)
LOWER_FLAP = slice(6, 8)
FLYBAR = slice(8, 10)
ATTITUDE = slice(10, 13)
POSITION = slice(13, 16)
PLACE = slice(13, 15)  # north and east of it
ROTOR_SPEED = slice(16, 18)
SWASH = slice(18, 20)
ACTUATORS = slice(16, 20)
GUST_FORCE = slice(20, 23)
GUST_MOMENT = slice(23, 26)
GUSTS = slice(20, 26)
AXES_OF_GUSTS = ("force x", "force y", "force z", "moment x", "moment y", "moment z")
TRIMS = slice(26, 28)

# --- command --------------------------------------------------------------------------------------
COMMANDS = (
    ("omega_u", "rad/s"), ("omega_l", "rad/s"), ("delta_lon", "rad"), ("delta_lat", "rad"),
)  # fmt: skip
N_COMMANDS = len(COMMANDS)
# the kernel's input is the four commands, and beside them
TIME = 4  # since the run's start [s]
BATTERY = 5  # voltage over the nominal one [V]; 0 where none is known
N_INPUTS = N_COMMANDS + 2

# --- measurement channels -----------------------------------------------------------------------
CHANNEL_UNITS = {
    "rpm_upper": "rev/min", "rpm_lower": "rev/min",
    "p": "rad/s", "q": "rad/s", "r": "rad/s",
    "ax": "m/s2", "ay": "m/s2", "az": "m/s2",
    "phi": "rad", "theta": "rad", "psi": "rad",
    "h": "m", "vn": "m/s", "ve": "m/s", "vd": "m/s", "pn": "m", "pe": "m",
    "v": "m/s",
}  # fmt: skip
CHANNELS = tuple(CHANNEL_UNITS)
N_CHANNELS = len(CHANNELS)
ANGLES = ("phi", "theta", "psi")
"""Channels whose innovations wrap."""
GYROS, ACCELEROMETERS = ("p", "q", "r"), ("ax", "ay", "az")
INERTIAL = (*GYROS, *ACCELEROMETERS)
ROTOR_SPEEDS = ("rpm_upper", "rpm_lower")
"""Channels that show commands, and no gust."""
SENSOR_GROUPS = {
    "rotor speeds": ROTOR_SPEEDS, "gyros": GYROS, "accelerometers": ACCELEROMETERS,
    "attitude": ("phi", "theta"), "heading": ("psi",), "height": ("h",),
    "velocity": ("vn", "ve", "vd"), "position": ("pn", "pe"), "speed": ("v",),
}  # fmt: skip
"""Sensor -> its channels: their noise has one cause."""
MOTION_GROUPS = ("attitude", "heading", "height", "velocity", "position")
"""Sensors that say how the machine moves, as inertial ones feel it."""
MOTION = tuple(channel for group in MOTION_GROUPS for channel in SENSOR_GROUPS[group])
ERRING_GROUPS = (*MOTION_GROUPS, "gyros", "accelerometers")
"""Sensors whose readings may have errors that last (lasting_errors.py)."""

RPM_PER_RAD_S = 60.0 / (2.0 * 3.141592653589793)
