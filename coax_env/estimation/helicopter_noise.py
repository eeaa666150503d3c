"""What the helicopter model does not say: its noise levels, with units, bounds and where they start.

No level is a constant that evidence could depend on: all are fitted by maximum likelihood together
(noise_levels.py), some under a prior. Process noise, by name:

- ``force_xy`` ..: std of gusts, states with an exponential memory, ``memory_force_xy`` ..
- ``white_force_xy`` ..: force and moment without a memory
- ``rotor_speed``: of the rotors' speeds, whose change the body feels where the model has that reaction
- ``rotor_jitter``: std of speeds with a memory of their own, ``memory_rotor_jitter``, where flights
  show them, and what the body takes up of these, ``reaction_rotor_jitter`` and
  ``return_rotor_jitter`` (rotor_jitter.py)
- ``trim_force_z``, ``trim_moment_z``: random walks of thrust and torque
- ``error_attitude`` ..: std of errors of the readings that last, ``memory_error_attitude`` .., where
  flights show them (lasting_errors.py)

and each channel's name for the std of its readings.
"""

import numpy as np

from coax_env.estimation.state_space import Noise, ProcessNoise
from coax_env.logs.flight import Flight
from coax_env.model import effects
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.effect_registry import GUST_MEMORY
from coax_env.model.generic_terms import hover_speeds
from coax_env.model.layout import (
    ANGLES,
    ATTITUDE,
    CHANNEL_UNITS,
    ERRING_GROUPS,
    FLYBAR,
    GUSTS,
    LOWER_FLAP,
    N_FULL,
    POSITION,
    RATE,
    ROTOR_SPEED,
    SENSOR_GROUPS,
    SWASH,
    TRIMS,
    VELOCITY,
)
from coax_env.model.vehicle import Vehicle

AXES = ("force_xy", "force_z", "moment_xy", "moment_z")
"""Groups of axes that share a level."""
GUST_LEVELS = AXES
"""Std of the gust states [N, N m]."""
MEMORIES = tuple(f"memory_{axes}" for axes in AXES)
"""Correlation times of the gust states [s]."""
WHITE_LEVELS = tuple(f"white_{axes}" for axes in AXES)
"""Intensity of the white process noise [N s^1/2, N m s^1/2]: force and moment without a memory.

Without it, real flights buy damping that is not there: a damped rate driven by a gust with memory is
how a likelihood with nothing else at hand writes a rate driven by white noise, and the gust states
then undo the damping in every prediction.
"""
ROTOR_LEVEL = "rotor_speed"
"""Intensity of the rotor speeds' noise [rad/s per s^1/2]."""
JITTER_LEVEL, JITTER_MEMORY = "rotor_jitter", "memory_rotor_jitter"
"""Std [rad/s] and correlation time [s] of what rotor_jitter.py adds to the rotor speeds."""
JITTER_REACTION = "reaction_rotor_jitter"
"""Share of its changes that the body takes up: all, where motors shake rotors (rotor_jitter.py)."""
JITTER_RETURN = "return_rotor_jitter"
"""Time [s] in which a motor brings back a rotor that the air has shaken, against the body."""
TRIM_LEVELS = ("trim_force_z", "trim_moment_z")
"""Intensity of the random walks of thrust and torque [N/s^1/2, N m/s^1/2] (effect `trim_drift`)."""
TRIM_AXES = ("force_z", "moment_z")


def error_level(group: str) -> str:
    """Name of the std of a group's lasting errors."""
    return f"error_{group}"


def error_memory(group: str) -> str:
    """Name of the correlation time of a group's lasting errors."""
    return f"memory_error_{group}"


ERROR_LEVELS = tuple(error_level(group) for group in ERRING_GROUPS)
ERROR_MEMORIES = tuple(error_memory(group) for group in ERRING_GROUPS)

_FORCE, _MOMENT = ("force_xy", "force_z"), ("moment_xy", "moment_z")
LEVEL_UNITS = {
    **dict.fromkeys(_FORCE, "N"),
    **dict.fromkeys(_MOMENT, "N m"),
    **dict.fromkeys(MEMORIES, "s"),
    **{f"white_{axes}": "N s^1/2" for axes in _FORCE},
    **{f"white_{axes}": "N m s^1/2" for axes in _MOMENT},
    ROTOR_LEVEL: "rad/s^3/2",
    JITTER_LEVEL: "rad/s",
    JITTER_MEMORY: "s",
    JITTER_REACTION: "1",
    JITTER_RETURN: "s",
    "trim_force_z": "N/s^1/2",
    "trim_moment_z": "N m/s^1/2",
    **{error_level(group): CHANNEL_UNITS[SENSOR_GROUPS[group][0]] for group in ERRING_GROUPS},
    **dict.fromkeys(ERROR_MEMORIES, "s"),
}
"""Unit of each level of the process noise."""

MEMORY_PRIOR = (GUST_MEMORY, 1.0)
"""Median [s] and std of the logarithm of a gust's memory: a factor of e either way; ours."""
MEMORY_BOUNDS = (0.015, 20.0)
"""[s]: below, a gust is white noise at 100 Hz; above, it is a trim of the flight."""
ROTOR_SHARE, ROTOR_PRIOR_STD = 5e-4, 1.5
"""Rotor-speed noise per hover speed [1/s^1/2], and the std of its logarithm; ours."""
TRIM_KNOWN_AFTER = 10.0
"""[s] of its own random walk by which a run's trim is unknown at its start; ours."""
LARGEST = 1e4
"""Times its floor that a level of process noise may have; ours."""
CARD_PRIOR_STD, SCATTER_PRIOR_STD = 0.7, 1.5
"""Std of the logarithm of a reading's std where the card states it (a card may be wrong by 2), and
where it comes from the readings' own scatter; ours."""
READING_RANGE = 20.0
"""Factor by which a reading's std may depart from where it starts; ours."""
LATENT_START = {
    **{f"white_{axes}": (axes, 0.2) for axes in AXES},
    "trim_force_z": ("force_z", 0.3),
    "trim_moment_z": ("moment_z", 0.3),
}
"""Levels that stand at their floor until asked for, and where they start then, per gust level: white
noise of 0.2 s^1/2 is a gust of 20 ms; a trim of 0.3 / s^1/2 is as large as the gusts in ten seconds."""

LEAST_READING_STD = {
    "rpm_upper": 1.0, "rpm_lower": 1.0, "p": 0.01, "q": 0.01, "r": 0.01,
    "ax": 0.05, "ay": 0.05, "az": 0.05, "phi": 0.006, "theta": 0.006, "psi": 0.008,
    "h": 0.005, "vn": 0.02, "ve": 0.02, "vd": 0.02, "pn": 0.004, "pe": 0.004, "v": 0.02,
}  # fmt: skip
"""Std taken for a reading that says nothing of its own, in units of CHANNEL_UNITS; ours."""

# --- in the filter ----------------------------------------------------------------------------------

_REACTING = np.array([[S.R, S.OMEGA_U], [S.R, S.OMEGA_L]])
PAIRS_OF_GUSTS = tuple((i, j) for j in range(6) for i in range(j))
_OF_GUSTS = np.array(PAIRS_OF_GUSTS) + GUSTS.start
NOISE_PLACES = np.vstack([np.repeat(np.arange(N_FULL)[:, None], 2, axis=1), _REACTING, _OF_GUSTS])
"""Entries of the process noise's covariance: the diagonal, yaw rate with each rotor's speed, gusts with
each other: these are none, but their score says whether there should be some (joint_gusts.py)."""
_REACTIONS = slice(N_FULL, N_FULL + len(_REACTING))
JOINT = slice(-len(_OF_GUSTS), None)
"""Places of the gusts with each other in NOISE_PLACES, and in those of models with more states."""
_SPIN_UP = effects.parameter_index("spin_up_reaction.gain")
GUST_AXES = ("force_xy", "force_xy", "force_z", "moment_xy", "moment_xy", "moment_z")
"""Group of each gust state."""


_USUAL = {
    **dict.fromkeys((*GUST_LEVELS, *WHITE_LEVELS, *TRIM_LEVELS, ROTOR_LEVEL), 0.0),
    **dict.fromkeys(MEMORIES, GUST_MEMORY),
}
"""What a level is that nobody speaks of."""


def process_noise(noise: Noise, p: np.ndarray) -> ProcessNoise:
    """What the noise adds to the covariance, by entry of NOISE_PLACES.

    A rotor that changes its speed by dw turns the body by g J dw / I_zz (effect `spin_up_reaction`).

    Args:
        noise: its levels. p: parameter vector.
    """
    level = {**_USUAL, **noise.process}
    q, decay = np.zeros(len(NOISE_PLACES)), np.zeros(len(NOISE_PLACES))
    q[VELOCITY] = 1e-4**2
    q[RATE] = 1e-3**2
    q[LOWER_FLAP] = q[FLYBAR] = 1e-4**2
    q[ATTITUDE] = q[POSITION] = 1e-5**2
    q[SWASH] = 1e-4**2
    q[[S.U, S.V]] += (level["white_force_xy"] / p[P.GUST_MASS]) ** 2
    q[S.W] += (level["white_force_z"] / p[P.GUST_MASS]) ** 2
    q[S.P] += (level["white_moment_xy"] / p[P.GUST_INERTIA_XX]) ** 2
    q[S.Q] += (level["white_moment_xy"] / p[P.GUST_INERTIA_YY]) ** 2
    q[S.R] += (level["white_moment_z"] / p[P.GUST_INERTIA_ZZ]) ** 2
    q[ROTOR_SPEED] = level[ROTOR_LEVEL] ** 2
    per_speed = p[_SPIN_UP] / p[P.GUST_INERTIA_ZZ] * np.array(
        [p[P.ROTOR_INERTIA_U] + p[P.FLYBAR_INERTIA], -p[P.ROTOR_INERTIA_L]]
    )  # fmt: skip
    q[S.R] += float(per_speed @ per_speed) * level[ROTOR_LEVEL] ** 2
    q[_REACTIONS] = per_speed * level[ROTOR_LEVEL] ** 2
    memory = np.array([level[f"memory_{axes}"] for axes in GUST_AXES])
    q[GUSTS] = 2.0 * gust_levels(noise) ** 2 / memory
    decay[GUSTS] = 1.0 / memory
    decay[JOINT] = decay[_OF_GUSTS].mean(axis=1)
    q[TRIMS] = [level[name] ** 2 for name in TRIM_LEVELS]
    return ProcessNoise(q, decay)


def start_noise(noise: Noise) -> np.ndarray:
    """Variances of gusts and trims at the start of a run (29,)."""
    variance = np.zeros(N_FULL)
    variance[GUSTS] = gust_levels(noise) ** 2
    variance[TRIMS] = [TRIM_KNOWN_AFTER * noise.process.get(name, 0.0) ** 2 for name in TRIM_LEVELS]
    return variance


def gust_levels(noise: Noise) -> np.ndarray:
    """Std of the six gust states [N, N m]."""
    return np.array([noise.process.get(axes, 0.0) for axes in GUST_AXES])


def with_memories(p: np.ndarray, noise: Noise) -> None:
    """Give a parameter vector the gusts' memories, in place."""
    p[P.GUST_MEMORIES] = [noise.process.get(name, GUST_MEMORY) for name in MEMORIES]


SHAKEN = {
    **dict.fromkeys(("ax", "ay", "az"), "amplitude"),
    **dict.fromkeys(("p", "q", "r"), "rate"),
    **dict.fromkeys(("phi", "theta"), "tilt"),
    "h": "heave",
}
"""Channel -> the parameter of `vibration` that shakes it."""

# --- where it starts ---------------------------------------------------------------------------------


def fitted_levels(noise: Noise) -> tuple[str, ...]:
    """Levels that are always fitted; white noise and trims are asked for first (noise_levels.py)."""
    some = (JITTER_LEVEL, JITTER_MEMORY, *ERROR_LEVELS, *ERROR_MEMORIES)
    asked = [name for name in some if name in noise.process]
    return (*GUST_LEVELS, *MEMORIES, ROTOR_LEVEL, *asked, *noise.reading)


def starting_noise(flight: Flight, vehicle: Vehicle) -> Noise:
    """Noise to start from: of readings by the card or their scatter, of gusts by guess.

    A vehicle's vibration is noise to the filter, on top of the card's: its phase is not known.
    """
    process, floor, ceiling = _starting_process(vehicle)
    prior = dict.fromkeys(MEMORIES, MEMORY_PRIOR)
    prior[ROTOR_LEVEL] = (process[ROTOR_LEVEL], ROTOR_PRIOR_STD)
    own = vehicle.values()
    reading = {}
    for c in flight.channels:
        std = sensor_std(flight, c)
        shake = own.get(f"vibration.{SHAKEN[c]}", 0.0) if c in SHAKEN else 0.0
        reading[c] = float(np.hypot(std, shake / np.sqrt(2.0)))
        prior[c] = (reading[c], CARD_PRIOR_STD if c in flight.noise else SCATTER_PRIOR_STD)
        floor[c], ceiling[c] = reading[c] / READING_RANGE, reading[c] * READING_RANGE
    return Noise(process, reading, floor, ceiling, prior)


def _starting_process(
    vehicle: Vehicle,
) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """Levels of the process noise to start from, their floors and ceilings.

    The floors are what no model is without, as accelerations: 5e-4 g, and an angular acceleration
    that goes as g over the machine's size.
    """
    own = vehicle.values()
    weight = own["mass"] * own["gravity"]
    arm, per_size = own["arm_upper"], own["gravity"] / own["rotor_radius"]
    start = {
        "force_xy": 0.01 * weight,
        "force_z": 0.01 * weight,
        "moment_xy": 0.005 * weight * arm,
        "moment_z": 0.003 * weight * arm,
    }
    floor = {
        "force_xy": 5e-4 * weight,
        "force_z": 5e-4 * weight,
        "moment_xy": 2e-3 * per_size * own["inertia_xx"],
        "moment_z": 1.5e-3 * per_size * own["inertia_zz"],
    }
    least = dict(floor)
    for axes in AXES:
        floor[f"white_{axes}"] = 0.1 * least[axes]
    for axes, name in zip(TRIM_AXES, TRIM_LEVELS, strict=True):
        floor[name] = 0.02 * least[axes]
    ceiling = {name: LARGEST * level for name, level in floor.items()}
    floor |= dict.fromkeys(MEMORIES, MEMORY_BOUNDS[0])
    ceiling |= dict.fromkeys(MEMORIES, MEMORY_BOUNDS[1])
    rotor = ROTOR_SHARE * float(np.mean(hover_speeds(vehicle.vector)))
    floor[ROTOR_LEVEL], ceiling[ROTOR_LEVEL] = 0.02 * rotor, 50.0 * rotor
    off = {name: floor[name] for name in (*WHITE_LEVELS, *TRIM_LEVELS)}
    memories = dict.fromkeys(MEMORIES, GUST_MEMORY)
    return {**start, **memories, **off, ROTOR_LEVEL: rotor}, floor, ceiling


def still_air(noise: Noise) -> Noise:
    """With gusts and white noise at their floors: what no model is without."""
    return noise.with_levels({name: noise.floor[name] for name in (*GUST_LEVELS, *WHITE_LEVELS)})


def sensor_std(flight: Flight, channel: str) -> float:
    """Std of a sensor: the card's, else from its scatter from sample to sample.

    Third differences, robustly: white noise stays, motion cancels. At least what its own steps say,
    a uniform error over the least difference between two readings.
    """
    if channel in flight.noise:
        return flight.noise[channel]
    parts = []
    steps = []
    for run in flight.runs:
        if channel in run.measured:
            values = run.measured[channel][np.isfinite(run.measured[channel])]
            if values.size > 8:
                steps.append(np.diff(np.unique(values)))  # a whole turn is none of them
                parts.append(np.diff(np.unwrap(values) if channel in ANGLES else values, 3))
    if not parts:
        return LEAST_READING_STD[channel]
    scatter = float(np.median(np.abs(np.concatenate(parts)))) / 0.6745 / float(np.sqrt(20.0))
    differences = np.concatenate(steps)
    least = float(differences.min()) / np.sqrt(12.0) if differences.size else 0.0
    return max(scatter, least, 1e-3 * LEAST_READING_STD[channel])


def level_unit(name: str) -> str:
    """Unit of a level, that of its channel for a reading's."""
    return LEVEL_UNITS.get(name) or CHANNEL_UNITS[name]
