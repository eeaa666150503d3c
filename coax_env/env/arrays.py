"""The arrays of a batch of helicopters, by name, as its compiled loops take them.

Tuples, which compiled code takes apart at no cost. The first axis of `Helicopters` and `Outcome` is
the helicopter; `params` has one row for all where they do not differ.
"""

from typing import NamedTuple

import numpy as np


class Helicopters(NamedTuple):
    """What each helicopter is and has in flight, but for its state."""

    u: np.ndarray  # (n, 5) commands in force, and time
    rows: np.ndarray  # (n,) int64, control periods flown
    azimuth: np.ndarray  # (n,) of the upper rotor [rad]
    streams: np.ndarray  # (n, 2) uint64, key and counter of its random numbers
    params: np.ndarray  # (n or 1, n_parameters)
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

    trim: np.ndarray  # (4,) command = trim + scale * action
    scale: np.ndarray  # (4,)
    sensors: np.ndarray  # (m, n_sensors, 12) sampling.sensor_table of each kind
    limits: np.ndarray  # (m, 3, 4) actuators.limits of each kind
    flags: int  # how many, of slow instruments
    gust: np.ndarray  # (2,) std of force [N] and moment [N m]
    wind_speed: float  # [m/s] of a wind whose direction each flight draws
    turbulence: float  # mean wind at 6 m [m/s], zero for none


class Mission(NamedTuple):
    """The task, as numbers."""

    weights: np.ndarray  # (n_terms,) of the reward
    scales: np.ndarray  # (n_terms or fewer,)
    course: np.ndarray  # (k, 4) targets that are given; k = 0: drawn
    box: np.ndarray  # (2, 4) lowest and highest of those drawn
    dwell: int  # rows at a target that complete it; 0 for a task of one target
    places: np.ndarray  # (4,) or (0,) int64, where position and heading are observed
    height_sign: float


class Outcome(NamedTuple):
    """What one control period brought."""

    observations: np.ndarray  # (n, n_observed) float32
    rewards: np.ndarray  # (n,)
    terms: np.ndarray  # (n, number of the task's reward terms), weighted
    over: np.ndarray  # (n,) bool
