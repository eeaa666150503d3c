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
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.signal import welch
from scipy.stats import gmean

from coax_env.estimation import helicopter_noise
from coax_env.estimation.helicopter import HeliModel, Motion, _take_in_innovations
from coax_env.estimation.helicopter_noise import AXES, GUST_AXES
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import Noise, ProcessNoise
from coax_env.estimation.wrapping_model import WrappingModel
from coax_env.kernel.compilation import compiled
from coax_env.model import dynamics
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.layout import GUSTS, N_CHANNELS, N_FULL

FASTEST = 5.0
"""Hz, of any swing: 20 rows of 100 Hz; ours."""
SPECTRUM_SECONDS = 5.0
"""s of the pieces whose spectra are averaged: 0.2 Hz apart; ours."""
STANDS_OUT, CLEARLY = 1.5, 5.0
"""Times the density at the lowest frequency that a swing's must be, and the clearest one's of the six.
Of four **synthetic** flights whose gusts swing, at 0.3 to 1.5 Hz, the clearest had 20 to 47 and the
least 3; gusts that only fade have up to 2.1, since the lowest frequency is half in a window's mean."""

inner_step: Any = None  # the inner model's, put in by `WrappingModel` and `side_by_side`
inner_measure: Any = None
inner_drift: Any = None
INNER = N_FULL  # its number of states, put in by `WrappingModel`
WORK = dynamics.WORK_SIZE  # the size of its scratch; behind it drift and readings
_TAIL = 12
"""Parameters behind the inner model's: frequencies [Hz] and memories [s] of the six gusts."""


@compiled()
def _turned(x, gust, partner, memory, frequency, dt, out):
    """A gust and its partner `dt` seconds later, into the same places of `out`.

    Args:
        x, out: states. gust, partner: places in them. memory: [s]. frequency: [Hz].
    """
    fade = math.exp(-dt / memory)
    ahead = 2.0 * math.pi * frequency * dt
    along, across = fade * math.cos(ahead), fade * math.sin(ahead)
    mine, other = x[gust], x[partner]
    out[gust] = along * mine + across * other
    out[partner] = along * other - across * mine


@compiled()
def _turned_all(x, states, dt, p, out):
    """All six, by what `p` ends with; partners are behind so many states. `out` may be `x`."""
    for i in range(6):
        _turned(x, S.GUST_X + i, states + i, p[p.size - 6 + i], p[p.size - _TAIL + i], dt, out)


def _step(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The inner model's step; gusts turn, from what commands show of them on."""
    for i in range(INNER + 6):
        out[i] = x[i]
    _take_in_innovations(u, p, out)
    for i in range(6):
        work[WORK + i] = out[S.GUST_X + i]
    inner_step(x[:INNER], u, dt, p[: p.size - _TAIL], work, out[:INNER])
    for i in range(6):
        out[S.GUST_X + i] = work[WORK + i]
    _turned_all(out, INNER, dt, p, out)


def _measure(x: Any, u: Any, p: Any, work: Any, out: Any) -> None:
    """The inner model's readings."""
    inner_measure(x[:INNER], u, p[: p.size - _TAIL], work, out)


def _drift_and_readings(x: Any, u: Any, dt: float, p: Any, work: Any, out: Any) -> None:
    """The inner model's; gusts turn exactly."""
    own = work[WORK : WORK + INNER + N_CHANNELS]
    inner_drift(x[:INNER], u, dt, p[: p.size - _TAIL], work, own)
    for i in range(INNER + 6):
        out[i] = x[i]
    _take_in_innovations(u, p, out)
    _turned_all(out, INNER, dt, p, out)
    for i in range(6):
        out[S.GUST_X + i] -= x[S.GUST_X + i]
        out[INNER + i] -= x[INNER + i]
    for i in range(S.GUST_X):
        out[i] = own[i]
    for i in range(S.GUST_X + 6, INNER):
        out[i] = own[i]
    for i in range(N_CHANNELS):
        out[INNER + 6 + i] = own[INNER + i]


class SwingingModel(WrappingModel):
    """A model in gusts that swing, through the engine's protocol.

    Attributes:
        frequencies: of forces along and of moments about the axes [Hz], 0 of one that only fades.
    """

    own = Motion(_step, _measure, _drift_and_readings)
    added_scale = HeliModel.state_scale[GUSTS]
    tail = _TAIL
    word = "swinging"

    def __init__(self, inner: HeliModel, frequencies: Sequence[float] = (0.0,) * 6) -> None:
        super().__init__(inner)
        self.air = np.append(inner.air, np.arange(self.added.start, self.added.stop))
        self.frequencies = tuple(frequencies)

    def around(self, inner: HeliModel) -> "SwingingModel":
        """The same around another model."""
        return SwingingModel(inner, self.frequencies)

    def added_parameters(self, inner: np.ndarray, noise: Noise | None) -> np.ndarray:
        """Frequencies [Hz] and memories [s] of the six gusts."""
        return np.append(self.frequencies, self._memories(inner))

    def _memories(self, vector: np.ndarray) -> np.ndarray:
        """Memories of the six gusts [s]: in a group those that swing last as many swings each."""
        memories = np.array([vector[P.GUST_MEMORIES][AXES.index(axes)] for axes in GUST_AXES])
        for axes in AXES:
            own = [i for i, f in enumerate(self.frequencies) if f > 0.0 and GUST_AXES[i] == axes]
            if own:
                mean = gmean([self.frequencies[i] for i in own])
                memories[own] *= mean / np.array([self.frequencies[i] for i in own])
        return memories

    def added_variances(self, noise: Noise) -> np.ndarray:
        """Of the partners [N^2, (N m)^2]: the gusts' own."""
        return helicopter_noise.gust_levels(noise) ** 2

    def added_noise(self, noise: Noise, tail: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the partners of gusts that swing: 2 (1 + 1 / (w memory)^2) times what drives one that
        fades, so that its variance is the same."""
        fades = 1.0 / tail[6:]
        fading = 2.0 * self.added_variances(noise) * fades
        swung = 2.0 * math.pi * tail[:6] / fades
        swinging = swung > 0.0
        driven = np.zeros(6)
        driven[swinging] = 2.0 * (1.0 + 1.0 / swung[swinging] ** 2) * fading[swinging]
        return driven, fades

    def process_noise(self, noise: Noise, vector: np.ndarray) -> ProcessNoise:
        """What the noise adds to the covariance; what swings is driven by its partner alone."""
        every = super().process_noise(noise, vector)
        fades = 1.0 / vector[-6:]
        every.decay[GUSTS] = fades
        every.intensity[GUSTS] = np.where(
            vector[-_TAIL:-6] > 0.0, 0.0, 2.0 * self.added_variances(noise) * fades
        )
        return every


def swinging_at(model: HeliModel, frequencies: Sequence[float]) -> HeliModel:
    """A model in gusts with these frequencies; errors of its readings that last stay around it.

    Args:
        model: with other frequencies or none. frequencies: of the six gusts [Hz].
    """
    if isinstance(model, SwingingModel):
        return SwingingModel(model.inner, frequencies)
    if isinstance(model, WrappingModel):
        return model.around(swinging_at(model.inner, frequencies))
    return SwingingModel(model, frequencies)


def swings(passes: Sequence[RunPass], row: float, least: float = STANDS_OUT) -> list[float]:
    """Frequencies [Hz] of the six gusts, 0 of one that only fades, as their spectra show them.

    Args:
        passes: of a filter, whether its gusts swing already or not. row: seconds between rows.
        least: times the density at the lowest frequency that a swing's must be.
    """
    frequencies, clear = _strongest_of_all(passes, row)
    if max(clear) < CLEARLY:
        return [0.0] * 6
    return [f if by > least else 0.0 for f, by in zip(frequencies, clear, strict=True)]


def clearly_swinging(passes: Sequence[RunPass], row: float) -> list[str]:
    """Groups of axes, of AXES, in whose gusts a swing stands out CLEARLY, the clearest first."""
    clear = _strongest_of_all(passes, row)[1]
    of_group: dict[str, float] = {}
    for axes, by in zip(GUST_AXES, clear, strict=True):
        of_group[axes] = max(by, of_group.get(axes, 0.0))
    found = [axes for axes, by in of_group.items() if by > CLEARLY]
    return sorted(found, key=lambda axes: -of_group[axes])


def _strongest_of_all(passes: Sequence[RunPass], row: float) -> tuple[list[float], list[float]]:
    """`_strongest` of the six gusts."""
    found = [_strongest([run.states[:, GUSTS.start + i] for run in passes], row) for i in range(6)]
    return [frequency for frequency, _ in found], [clear for _, clear in found]


def _strongest(gusts: Sequence[np.ndarray], row: float) -> tuple[float, float]:
    """Frequency [Hz] at which a gust's spectrum is densest, and how many times as at the lowest.

    About its mean over all runs, which is none of the air's: a centre of gravity that is off had hidden
    swings of the moments behind it, and those in turn its 400 nats.
    """
    piece = round(SPECTRUM_SECONDS / row)
    long = [gust for gust in gusts if gust.size >= piece]
    if not long:
        return 0.0, 0.0
    mean = float(np.mean(np.concatenate(long)))
    long = [gust - mean for gust in long]
    spectra = [welch(gust, 1.0 / row, nperseg=piece, detrend=False) for gust in long]
    frequency = spectra[0][0]
    density = np.average([d for _, d in spectra], axis=0, weights=[gust.size for gust in long])
    at = int(np.argmax(density * (frequency <= FASTEST)))
    return float(frequency[at]), float(density[at] / max(density[0], np.finfo(float).tiny))
