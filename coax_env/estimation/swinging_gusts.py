"""Gusts that swing: what is shed by a pillar, a fan or the walls of a hall comes back with a frequency.

Six states more than the helicopter's own, in the filter alone: each gust has a partner a quarter of a
swing before it, and both turn into each other as they fade. Noise drives the partner, so that the gust
has no jumps of its slope: an oscillator of second order, its covariance std^2 exp(-|t| / memory) (cos
wt + sin w|t| / (w memory)) with w = 2 pi frequency (Gelb, Applied Optimal Estimation, 1974, section
2.3). A gust without a frequency has the exponential one that it always has, and an idle partner. Taken
for that, a swing is foreseen by whoever flies better than by the filter: clean **synthetic** flights
had inertias 10 to 40 % too large, and plays and lags of the servos.
"""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
from scipy.signal import welch
from scipy.stats import gmean

from coax_env.estimation import helicopter_noise
from coax_env.estimation.helicopter import (
    READ,
    HeliModel,
    Motion,
    _reads_another,
    _take_in_innovations,
    kernel_drift,
    kernel_measure,
    kernel_step,
)
from coax_env.estimation.helicopter_noise import AXES, GUST_AXES
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import Noise, ProcessNoise, Record
from coax_env.kernel.compilation import compiled
from coax_env.model import dynamics
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.layout import GUSTS, N_CHANNELS, N_FULL

SWINGS = slice(N_FULL, N_FULL + 6)
"""Partners of the six gusts [N, N m]."""
N_SWINGING = SWINGS.stop
AXES_OF_GUSTS = ("force x", "force y", "force z", "moment x", "moment y", "moment z")
FASTEST = 5.0
"""Hz, of any swing: 20 rows of 100 Hz; ours."""
SPECTRUM_SECONDS = 5.0
"""s of the pieces whose spectra are averaged: 0.2 Hz apart; ours."""
STANDS_OUT, CLEARLY = 1.5, 5.0
"""Times the density at the lowest frequency that a swing's must be, and the clearest one's of the six.
Of four **synthetic** flights whose gusts swing, at 0.3 to 1.5 Hz, the clearest had 20 to 47 and the
least 3; gusts that only fade have up to 2.1, since the lowest frequency is half in a window's mean."""

# of the scratch, behind the kernel's: drift and readings
_OUT = dynamics.WORK_SIZE
_WORK_SIZE = _OUT + N_FULL + N_CHANNELS


@compiled()
def _turned(x, partner, memory, frequency, dt, out):
    """A gust and its partner `dt` seconds later, into the same places of `out`.

    Args:
        x, out: (35,) states. partner: place in them of the gust's. memory: [s]. frequency: [Hz].
    """
    gust = partner - N_FULL + S.GUST_X
    fade = math.exp(-dt / memory)
    ahead = 2.0 * math.pi * frequency * dt
    along, across = fade * math.cos(ahead), fade * math.sin(ahead)
    mine, other = x[gust], x[partner]
    out[gust] = along * mine + across * other
    out[partner] = along * other - across * mine


@compiled()
def _turned_all(x, dt, p, out):
    """All six, by what `p` ends with: their frequencies, then their memories. `out` may be `x`."""
    for i in range(6):
        _turned(x, N_FULL + i, p[p.size - 6 + i], p[p.size - 12 + i], dt, out)


def _step(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The helicopter's step; gusts turn."""
    for i in range(N_SWINGING):
        out[i] = x[i]
    _take_in_innovations(u, p, out)
    for i in range(6):  # the step reads them as they were
        work[_OUT + i] = out[S.GUST_X + i]
    kernel_step(out[:N_FULL], u, dt, p, work, out[:N_FULL])
    for i in range(6):
        out[S.GUST_X + i] = work[_OUT + i]
    _turned_all(out, dt, p, out)


def _measure(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    """The helicopter's readings."""
    kernel_measure(x[:N_FULL], u[READ], p, work, out)


def _drift_and_readings(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The helicopter's; gusts turn exactly."""
    own = work[_OUT:_WORK_SIZE]
    kernel_drift(x[:N_FULL], u, dt, p, work, own)
    if _reads_another(u):
        kernel_measure(x[:N_FULL], u[READ], p, work, own[N_FULL:])
    for i in range(N_SWINGING):
        out[i] = x[i]
    _take_in_innovations(u, p, out)
    _turned_all(out, dt, p, out)
    for i in range(N_SWINGING):
        out[i] -= x[i]
    for i in range(S.GUST_X):
        out[i] += own[i]
    for i in range(S.GUST_X + 6, N_FULL):
        out[i] += own[i]
    for i in range(N_CHANNELS):
        out[N_SWINGING + i] = own[N_FULL + i]


class SwingingModel(HeliModel):
    """A vehicle in gusts that swing, through the engine's protocol."""

    motion = Motion(_step, _measure, _drift_and_readings)
    air = np.append(HeliModel.air, np.arange(SWINGS.start, SWINGS.stop))
    exact = np.append(HeliModel.exact, np.ones(6, bool))
    work_size = _WORK_SIZE
    state_scale = np.append(HeliModel.state_scale, HeliModel.state_scale[GUSTS])
    noise_places = np.insert(
        HeliModel.noise_places, N_FULL, [[i, i] for i in range(SWINGS.start, SWINGS.stop)], 0
    )
    frequencies: Sequence[float] = (0.0,) * 6

    def swinging_at(self, frequencies: Sequence[float]) -> "SwingingModel":
        """The same in gusts with these frequencies.

        Args:
            frequencies: of forces along and of moments about the axes [Hz], 0 of one that only fades.
        """
        model = copy(self)
        model.frequencies = tuple(frequencies)
        return model

    def vector(self, values: Mapping[str, float], noise: Noise | None = None) -> np.ndarray:
        """The helicopter's parameter vector, and behind it six frequencies and memories."""
        own = super().vector(values, noise)
        return np.concatenate([own, self.frequencies, self._memories(own)])

    def _memories(self, vector: np.ndarray) -> np.ndarray:
        """Memories of the six gusts [s]: in a group those that swing last as many swings each."""
        memories = np.array([vector[P.GUST_MEMORIES][AXES.index(axes)] for axes in GUST_AXES])
        for axes in AXES:
            own = [i for i, f in enumerate(self.frequencies) if f > 0.0 and GUST_AXES[i] == axes]
            if own:
                mean = gmean([self.frequencies[i] for i in own])
                memories[own] *= mean / np.array([self.frequencies[i] for i in own])
        return memories

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        """First state (35,) and its covariance, without what the noise levels add."""
        x, covariance = super().start(record)
        return np.append(x, np.zeros(6)), np.pad(covariance, (0, 6))

    def start_noise(self, noise: Noise) -> np.ndarray:
        """Variances that the noise levels add to the first state (35,)."""
        return np.append(super().start_noise(noise), helicopter_noise.gust_levels(noise) ** 2)

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        """What the noise adds to the covariance, by entry of `noise_places`.

        Of a gust that swings it drives the partner, by 2 (1 + 1 / (w memory)^2) times what drives one
        that fades: its variance is then the same.
        """
        own = helicopter_noise.process_noise(noise, vector)
        fades = 1.0 / vector[-6:]
        fading = 2.0 * helicopter_noise.gust_levels(noise) ** 2 * fades
        swung = 2.0 * math.pi * vector[-12:-6] / fades
        swinging = swung > 0.0
        driven = np.zeros(6)
        driven[swinging] = 2.0 * (1.0 + 1.0 / swung[swinging] ** 2) * fading[swinging]
        intensity = np.insert(own.intensity, N_FULL, driven)
        decay = np.insert(own.decay, N_FULL, fades)
        intensity[GUSTS] = np.where(swinging, 0.0, fading)
        decay[GUSTS] = fades
        return ProcessNoise(intensity, decay)


def swings(passes: Sequence[RunPass], row: float) -> list[float]:
    """Frequencies [Hz] of the six gusts, 0 of one that only fades, as their spectra show them.

    Args:
        passes: of a filter whose gusts only fade. row: seconds between rows.
    """
    found = [_strongest([run.states[:, GUSTS.start + i] for run in passes], row) for i in range(6)]
    if max(clear for _, clear in found) < CLEARLY:
        return [0.0] * 6
    return [frequency if clear > STANDS_OUT else 0.0 for frequency, clear in found]


def _strongest(gusts: Sequence[np.ndarray], row: float) -> tuple[float, float]:
    """Frequency [Hz] at which a gust's spectrum is densest, and how many times as at the lowest."""
    piece = round(SPECTRUM_SECONDS / row)
    long = [gust for gust in gusts if gust.size >= piece]
    if not long:
        return 0.0, 0.0
    spectra = [welch(gust, 1.0 / row, nperseg=piece, detrend=False) for gust in long]
    frequency = spectra[0][0]
    density = np.average([d for _, d in spectra], axis=0, weights=[gust.size for gust in long])
    at = int(np.argmax(density * (frequency <= FASTEST)))
    return float(frequency[at]), float(density[at] / max(density[0], np.finfo(float).tiny))
