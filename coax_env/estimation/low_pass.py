"""Readings behind a sensor's own low-pass, and what they were before it.

Inertial sensors and flight controllers smooth what they log, with cut-offs of 10 to 100 Hz. A reading
then holds shares of those before it, and so does its noise, which is white no more; and rotor speeds,
which nobody smooths, are ahead of the accelerations that they cause. The step from row to row is
inverted: new = (reading - shares . last readings) / (1 - sum of the shares), with the poles of a
first-order low-pass or of a Butterworth one of second order (Oppenheim and Schafer, Discrete-Time
Signal Processing, ch. 7: impulse invariance).
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from coax_env.estimation.state_space import Record


class LowPass(NamedTuple):
    """One low-pass. time: 1 / (2 pi cut-off) [s]; 0: none. order: 1 or 2."""

    time: float
    order: int = 1

    @property
    def cut_off(self) -> float:
        """Frequency [Hz] at which it lets half of the power through."""
        return 1.0 / (2.0 * math.pi * self.time)

    @property
    def delay(self) -> float:
        """Time [s] by which it makes late what changes slowly."""
        return self.time * (1.0 if self.order == 1 else math.sqrt(2.0))

    def shares(self, step: np.ndarray) -> np.ndarray:
        """Of the last reading and the one before it in a reading, (2, n).

        Args:
            step: (n,) from reading to reading [s].
        """
        if self.time <= 0.0:
            return np.zeros((2, step.size))
        if self.order == 1:
            return np.stack([np.exp(-step / self.time), np.zeros(step.size)])
        pole = np.exp(cmath.exp(0.75j * math.pi) * step / self.time)
        return np.stack([2.0 * pole.real, -(np.abs(pole) ** 2)])

    def noise_before(self, step: float) -> float:
        """Factor from the std of smoothed white noise to its own before it.

        Args:
            step: between readings [s].
        """
        a, b = self.shares(np.array([step]))[:, 0].tolist()
        return math.sqrt((1.0 + b) * ((1.0 - b) ** 2 - a * a) / (1.0 - b)) / (1.0 - a - b)


NONE = LowPass(0.0)


def before_low_pass(
    record: Record, channels: Sequence[str], passes: Mapping[str, LowPass]
) -> tuple[Record, float]:
    """A record with some channels' readings as they were before their low-pass.

    The first two readings of each have not two before them and are left out, where there is no low-pass
    too, so that likelihoods are of the same readings.

    Args:
        record: as logged. channels: of its columns. passes: by channel.

    Returns:
        The record, and what its log-likelihood has more of, as one of the readings as logged [nats]:
        minus the sum of ln(1 - sum of the shares).
    """
    z, nats = record.z.copy(), 0.0
    for channel, low_pass in passes.items():
        column = channels.index(channel)
        rows = np.flatnonzero(np.isfinite(z[:, column]))
        logged = z[rows, column]
        z[rows[:2], column] = np.nan
        if rows.size < 3:
            continue
        a, b = low_pass.shares(np.diff(record.t[rows])[1:])
        z[rows[2:], column] = (logged[2:] - a * logged[1:-1] - b * logged[:-2]) / (1.0 - a - b)
        nats -= float(np.sum(np.log(1.0 - a - b)))
    return replace(record, z=z), nats


def records_before(
    records: Sequence[Record], channels: Sequence[str], passes: Mapping[str, LowPass]
) -> list[Record]:
    """Each of some records with readings as they were before their low-pass.

    Args:
        records: as logged. channels: of their columns. passes: by channel.
    """
    return [before_low_pass(record, channels, passes)[0] for record in records]
