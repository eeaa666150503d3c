"""The arrays of a batch of helicopters, by name, as its compiled loops take them.

Tuples, which compiled code takes apart at no cost. The first axis of `Helicopters` and `Outcome` is
the helicopter. A parameter vector is `World.params`, with the helicopter's own numbers at `World.own`.
"""

from typing import NamedTuple

import numpy as np

AIR_NORTH, AIR_EAST, AIR_DOWN = range(3)
"""The first of a helicopter's own parameters where the air changes: its velocity [m/s]."""


class Helicopters(NamedTuple):
    """What each helicopter is and has in flight, but for its state."""

    u: np.ndarray  # (n, 5) commands in force, and time
    rows: np.ndarray  # (n,) int64, control periods flown
    azimuth: np.ndarray  # (n,) of the upper rotor [rad]
    streams: np.ndarray  # (n, 2) uint64, key and counter of its random numbers
    own: np.ndarray  # (n, k) parameters in which helicopters differ, those at World.own
    kinds: np.ndarray  # (n,) int64, which row of World.sensors and World.limits
    last_commands: np.ndarray  # (n, 4) after their limits
    command_ring: np.ndarray  # (n, slots, 4) of commands given
    bias: np.ndarray  # (n, n_sensors) of this flight
    past: np.ndarray  # (n, slots, n_sensors) ring of what delayed sensors measured
    filters: np.ndarray  # (n or 1, N_FILTERS) states of the turbulence's forming filters
    steady_wind: np.ndarray  # (n or 1, 2) north and east, under the turbulence [m/s]
    targets: np.ndarray  # (n, 4) x y z psi
    progress: np.ndarray  # (n, 2) int64, see tasks.WITHIN, tasks.REACHED
    held: np.ndarray  # (n, n_observed) readings, flags, and the way to the target


class World(NamedTuple):
    """What all helicopters of a batch share."""

    params: np.ndarray  # (n_parameters,)
    own: np.ndarray  # (k,) int64, places of the parameters that each helicopter has of its own
    read: np.ndarray  # (m,) int64, places of the parameters that the SIMD batch reads
    trim: np.ndarray  # (4,) command = trim + scale * action
    scale: np.ndarray  # (4,)
    sensors: np.ndarray  # (m, n_sensors, 12) sampling.sensor_table of each kind
    limits: np.ndarray  # (m, 3, 4) actuators.limits of each kind
    flags: int  # how many, of slow instruments
    gust: np.ndarray  # (2,) std of force [N] and moment [N m]
    wind_speed: float  # [m/s] of a wind whose direction each flight draws, and its speed where
    wind_slowest: float  # [m/s] this is less
    turbulence: float  # mean wind at 6 m [m/s], zero for none


class Makeup(NamedTuple):
    """What the helicopters of a batch have: the SIMD batch is compiled for it, and for nothing else."""

    used: tuple[str, ...]  # full names of the parameters of the effects that may be on
    own: bool  # parameters in which helicopters differ
    turbulent: bool
    delayed: bool  # commands
    own_delays: bool  # and the delay is one of the parameters in which they differ
    late: bool  # readings


class Mission(NamedTuple):
    """The task, as numbers."""

    weights: np.ndarray  # (n_terms,) of the reward
    scales: np.ndarray  # (n_terms or fewer,)
    course: np.ndarray  # (k, 4) targets that are given; k = 0: drawn
    box: np.ndarray  # (2, 4) lowest and highest of those drawn
    dwell: int  # rows at a target that complete it; 0 for a task of one target
    places: np.ndarray  # (4,) or (0,) int64, where position and heading are observed
    height_sign: float
    path: (
        np.ndarray
    )  # (k, paths.N_PATH) where the target is in every control period; k = 0: it rests
    again: int  # the row that follows the last of the path


class Outcome(NamedTuple):
    """What one control period brought."""

    observations: np.ndarray  # (n, n_observed) float32
    rewards: np.ndarray  # (n,)
    terms: np.ndarray  # (n, number of the task's reward terms), weighted
    over: np.ndarray  # (n,) bool
