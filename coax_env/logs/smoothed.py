"""Readings that software has smoothed: by a motion capture, or by whoever prepared the log.

Behind a low-pass a reading is much what the one before it was, noise included, and an estimator that
takes each for news believes them many times over: on clean **synthetic** flights whose poses came
through a low-pass of 10 Hz, forwards and back, three to seven false causes of up to 748 nats each. Its
noise has no more power above the cut-off, and falls there by a power of the frequency, where that of a
sensor is flat. Readings so far apart that their noise is flat again say all that there is.

A log without noise is steep at any distance, and stays as it is. A channel that is steep at any
distance beside some that are not is read as often as these. Gyros and accelerometers are not asked:
their low-passes are found with the model, which feels their delay (diagnosis/sensor_low_pass.py).
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import periodogram

from coax_env.logs.packets import stretches
from coax_env.logs.repairs import Repaired
from coax_env.model.layout import ANGLES, MOTION
from coax_env.plain_words import and_list

PIECE = 64
"""Readings of which a spectrum is taken; ours."""
PIECES = 4
"""Spectra at least, that it is a median of; ours."""
MIDDLE, TOP = (0.2, 0.3), (0.4, 0.49)
"""Bands, in shares of the rate, whose densities are compared; ours."""
STEEP, SLOPING, FLAT = 40.0, 5.0, 2.5
"""Times as dense in the middle as at the top: where it is smoothed, where it is beside one that is, as
steps of the readings may hide it, and where noise is flat enough. A sensor's has 1; the real first
CoaX up to 20, a vibration at 40 Hz; **synthetic** ones behind 10 Hz at a rate of 100 Hz have 700 to
2,800."""
OF_PUSHES = 12.0
"""The same where none is flat enough: a cut-off so low that below it motion is louder than noise.
White pushes make motion 10 times as dense in the middle, gusts with a memory 34; ours."""
NEAR = 0.03
"""s that readings are apart at most where it is asked whether they are smoothed: farther apart the real
first CoaX's vibration makes them 60 times as dense, and motion more than noise does; ours. A heading
that swings at 5.5 Hz, read at 50 Hz, has 0.9 one row apart and 157 two apart (**synthetic**)."""
BEYOND = 0.25
"""Of a row that the last of these may be farther: 60 Hz are asked two rows apart, too; ours."""
FARTHEST = 0.1
"""s that readings may be apart at most; ours."""
LOST = 1.9
"""Usual steps from which a row is missing between two; ours. Software smooths from reading to reading,
however uneven their clock is: asked of even rows alone, four clean **synthetic** flights behind 8 to
16 Hz were not seen to be smoothed, and had false names."""


def read_apart(
    runs: Sequence[Repaired], counts: Counter[str], holds: Mapping[str, bool]
) -> list[Repaired]:
    """Runs whose smoothed channels have no more readings than say something new.

    Args:
        runs: of one flight.
        counts: what was repaired -> how often; what is left out is added.
        holds: channel -> what the card says; one that never holds stays as it is.
    """
    pieces = {c: pieces_of(runs, c) for c in MOTION if holds.get(c) is not False}
    near = {c: _nearby(*own) for c, own in pieces.items()}
    steep = [c for c, times in near.items() if max(times) > STEEP]
    rows = max((_apart(*pieces[c], near[c]) for c in steep), default=1)
    if rows == 1:
        return list(runs)
    smooth = [c for c, times in near.items() if max(times) > SLOPING]  # one software, one cut-off
    found, left_out = [], 0
    for run in runs:
        measured = dict(run.measured)
        for channel in measured.keys() & set(smooth):
            values = measured[channel].copy()
            gone = np.delete(np.flatnonzero(np.isfinite(values)), np.s_[::rows])
            values[gone] = np.nan
            left_out += gone.size
            measured[channel] = values
        found.append(replace(run, measured=measured))
    counts[f"smoothed readings left out, all but one in {rows} of {and_list(smooth)}"] += left_out
    return found


def are_steep(runs: Sequence[Repaired]) -> bool:
    """Whether a channel is smoothed, or has no noise at all.

    Args:
        runs: of one flight.
    """
    return any(max(_nearby(*pieces_of(runs, channel))) > STEEP for channel in MOTION)


def _nearby(pieces: Sequence[np.ndarray], step: float) -> list[float]:
    """Steepness of readings one row apart, two, and so on up to NEAR, and just beyond.

    The most of these counts: nearer, the last digit of a fast log hides it.

    Args:
        pieces: readings, one after the other. step: between two [s].
    """
    most = max(int(NEAR / step + BEYOND), 1) if step > 0.0 else 1
    return [steepness(pieces, rows) for rows in range(1, most + 1)]


def _apart(pieces: Sequence[np.ndarray], step: float, near: Sequence[float]) -> int:
    """Readings of which one says as much as all do; 1 where they are steep at any distance.

    Beyond where they are steepest: nearer, what is flat is the last digit's noise.

    Args:
        pieces: readings, one after the other. step: between two [s]. near: `_nearby` of them.
    """
    nearest = max(1 + int(np.argmax(near)), 2)
    every = range(nearest, int(FARTHEST / step + 1e-6) + 1)
    found = {rows: steepness(pieces, rows) for rows in every}
    for enough in (FLAT, OF_PUSHES):
        for rows, times in found.items():
            if 0.0 < times < enough:
                return rows
    return 1


def pieces_of(runs: Sequence[Repaired], channel: str) -> tuple[list[np.ndarray], float]:
    """Readings of a channel between which none is missing, and the usual time between two [s]."""
    steps, series = [], []
    for run in runs:
        values = run.measured.get(channel, np.empty(0))
        present = np.flatnonzero(np.isfinite(values))
        if present.size > PIECE:
            own = values[present]
            series.append((run.t[present], np.unwrap(own) if channel in ANGLES else own))
            steps.append(np.diff(run.t[present]))
    if not series:
        return [], 0.0
    step = float(np.median(np.concatenate(steps)))
    return [
        values[first : behind + 1]
        for t, values in series
        for first, behind in stretches(np.diff(t) < LOST * step)
    ], step


def steepness(pieces: Sequence[np.ndarray], rows: int) -> float:
    """Density of a spectrum in the MIDDLE of its band over that at the TOP; 0 where it is too short.

    Args:
        pieces: readings, one after the other. rows: of which every so many-th is taken.
    """
    middle, top = densities(pieces, rows)
    return middle / top if top > 0.0 else 0.0


def densities(pieces: Sequence[np.ndarray], rows: int) -> tuple[float, float]:
    """Of a spectrum in the MIDDLE of its band and at the TOP, per share of the rate; 0 where too short.

    Of second differences, which keep slow motion out of the window's leakage, and back. Medians over
    pieces, whatever outliers do: white noise has ln 2 times twice its variance.

    Args:
        pieces: readings, one after the other. rows: of which every so many-th is taken.
    """
    taken = [np.diff(piece[::rows], 2) for piece in pieces if piece[::rows].size >= PIECE + 2]
    if sum(piece.size for piece in taken) < PIECES * PIECE:
        return 0.0, 0.0
    windows = np.vstack([sliding_window_view(piece, PIECE)[:: PIECE // 2] for piece in taken])
    frequency, spectra = periodogram(windows, window="hann")
    frequency, density = frequency[1:], np.median(spectra, axis=0)[1:]
    density = density / (2.0 * np.sin(np.pi * frequency)) ** 4
    middle, top = (
        float(np.mean(density[(frequency > low) & (frequency < high)]))
        for low, high in (MIDDLE, TOP)
    )
    return middle, top
