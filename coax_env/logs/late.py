"""Columns that a log has later than they happened, by so much as the card says: put in their place.

A command that is logged as it is echoed, a gyro whose driver has a queue, a clock that is late: no
machine does that, and no model of one has to. What is late by the machine itself is an effect
(`command_delay`, `attitude_delay`, `pose_delay`), and stays in the log.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from coax_env.logs.held_signal import row_means
from coax_env.logs.repairs import Repaired
from coax_env.logs.units import BATTERY, ROTOR_COMMANDS, SWASH_COMMANDS


def in_their_place(log: Repaired, late: Mapping[str, float], counts: Counter[str]) -> Repaired:
    """A run whose late columns are moved back.

    A command, held from row to row, becomes its mean over the time that the row's stands for. A
    reading goes to the row nearest to when it was taken, so that half a row is left at most; what
    belongs before the first row is left out.

    Args:
        log: as it was read. late: column of ours -> seconds by which it is written late.
        counts: what was done -> how often; this run's is added.
    """
    t = log.t
    command = log.command.copy()
    moved = []
    for k, name in enumerate((*ROTOR_COMMANDS, *SWASH_COMMANDS)):
        if name in late:
            command[:, k] = row_means(t, command[:, k], late[name])
            moved.append(name)
    battery = log.battery
    if battery is not None and BATTERY in late:
        battery = row_means(t, battery, late[BATTERY])
        moved.append(BATTERY)
    measured = dict(log.measured)
    for channel, readings in log.measured.items():
        if channel in late:
            measured[channel] = _moved_back(t, readings, late[channel])
            moved.append(channel)
            gone = np.isfinite(readings).sum() - np.isfinite(measured[channel]).sum()
            if gone:
                counts[f"late readings of {channel} without a row of their own, left out"] += int(
                    gone
                )
    for name in moved:
        counts[f"runs in which {name} was written {late[name]:g} s late, moved back"] += 1
    return replace(log, command=command, measured=measured, battery=battery)


def _moved_back(t: np.ndarray, readings: np.ndarray, late: float) -> np.ndarray:
    """Readings (n,) at the rows nearest to when they were taken; of two in one row the nearer."""
    written = np.flatnonzero(np.isfinite(readings))
    taken = t[written] - late
    written, taken = written[taken >= t[0]], taken[taken >= t[0]]
    after = np.clip(np.searchsorted(t, taken), 1, t.size - 1)
    rows = np.where(taken - t[after - 1] < t[after] - taken, after - 1, after)
    nearest_last = np.argsort(-np.abs(t[rows] - taken), kind="stable")
    moved = np.full(readings.shape, np.nan)
    moved[rows[nearest_last]] = readings[written[nearest_last]]
    return moved
