"""Does the fitted model, its noise with it, make such flights? Where it does not, its noise is wrong.

Three things that a right model fixes whoever flies, with their distribution:

- *Prediction errors.* From a start at which the readings are taken away, the filter predicts readings
  and their variances with its fitted noise. Whatever the commands answer to, the error of a prediction
  with the recorded commands comes of the error of the start and of the noise since (to first order the
  commands move machine and prediction alike), so that the errors over their std have an rms of 1.
- *Spectrum of the innovations.* Flat: in every band the mean periodogram is that of white noise.
- *Innovations and commands.* An innovation is what could not be known: it is correlated with no command
  before it. Where it is foretold by its own past, as coloured ones are, so is what the pilot did about
  that: only what is beyond its past counts.

That is what a parametric bootstrap of the fitted model flown in closed loop would give, in closed form
and without a model of the pilot. Starts are so far apart that their errors are independent.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2, norm

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation import compiled_model
from coax_env.estimation.prediction import TAIL
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import Noise, Record, part
from coax_env.estimation.whiteness import beyond_its_past, correlation
from coax_env.model.layout import ANGLES, CHANNELS
from coax_env.plain_words import channel_name

HORIZONS = (0.25, 0.5, 1.0, 2.0, 3.0)
"""Seconds ahead that are predicted."""
SEEN = 2.0
"""Seconds of readings before each start, enough to settle; ours."""
LEAD = 8.0
"""Seconds of readings before it at most; ours. A filter that was blind before is not settled by 2 s:
one whose place is unknown to meters believes its first reading of half a millimetre, and its slope
there, and was 77 std off at the next start of a clean **synthetic** flight."""
PHASES = 2
"""Sets of starts, each of them far enough from the last; ours."""
MOST_STARTS = 100
"""Of a set, evenly picked: a ratio is known to 7 % then; ours, a bound on time."""
BANDS = ((0.0, 0.5), (0.5, 2.0), (2.0, 8.0), (8.0, 25.0))
"""Bands of the innovations' spectrum [Hz]."""
LAGS = (0.02, 0.05, 0.1, 0.2, 0.5)
"""Seconds from a command to the innovation that may follow it."""
COMMANDS = ("upper rotor", "lower rotor", "longitudinal swash", "lateral swash")
CHANCE = 1e-5
"""Probability of a figure beyond which it is no chance: some hundred are looked at; ours."""
LARGE = 1.25
"""Ratio of standard deviations below which a difference does not matter; ours (whiteness.py)."""
CORRELATED = 0.1
"""Correlation below which it does not matter; ours."""
FEWEST = 8
"""Starts, or readings in a band, that are judged at least; ours."""


@dataclass(frozen=True)
class ModelCheck:
    """What the fitted model does not make: findings.json's `model_check`, and remarks in words."""

    prediction: list[dict[str, Any]]
    spectrum: list[dict[str, Any]]
    commands: list[dict[str, Any]]

    @property
    def entry(self) -> dict[str, Any]:
        """For findings.json."""
        return {
            "prediction": self.prediction,
            "spectrum": self.spectrum,
            "commands": self.commands,
            "words": self.remarks,
        }

    @property
    def remarks(self) -> list[str]:
        """The worst of each kind, in a sentence."""
        texts = []
        for worst in _first(self.prediction, "ratio"):
            texts.append(
                f"{channel_name(worst['channel'])}: its {worst['horizon_s']:g} s error is"
                f" {worst['ratio']:.1f} times what the fitted model's own noise makes:"
                " the noise model is wrong there"
            )
        for worst in _first(self.spectrum, "ratio"):
            low, high = worst["band_hz"]
            texts.append(
                f"{channel_name(worst['channel'])}: from {low:g} to {high:g} Hz the innovations are"
                f" {worst['ratio']:.1f} times as loud as the model has them"
            )
        for worst in _first(self.commands, "correlation"):
            texts.append(
                f"{channel_name(worst['channel'])}: {worst['lag_s']:g} s after the command of the"
                f" {worst['command']} the innovations follow it (correlation"
                f" {worst['correlation']:.2f}): the model's answer to it is not right"
            )
        return texts


def _first(found: Sequence[dict[str, Any]], key: str) -> list[dict[str, Any]]:
    return sorted(found, key=lambda entry: -abs(entry[key]))[:1]


def model_check(problem: Problem, fit: Fit, passes: Sequence[RunPass]) -> ModelCheck:
    """Where the flights are not what the fitted model and its noise would make.

    Args:
        problem, fit: after the diagnosis.
        passes: of the filter at the fit.
    """
    return ModelCheck(
        list(_predictions(problem, fit)), list(_spectra(passes)), list(_answers(passes))
    )


# --- prediction errors ------------------------------------------------------------------------------


def _predictions(problem: Problem, fit: Fit) -> Iterable[dict[str, Any]]:
    """Channels and horizons whose errors are larger than the fitted noise makes them."""
    phases = [scaled_errors(problem, fit, phase / PHASES) for phase in range(PHASES)]
    for h, horizon in enumerate(HORIZONS):
        for c, channel in enumerate(CHANNELS):
            e = np.concatenate([errors[:, h, c] for errors in phases])
            e = e[np.isfinite(e)]
            independent = e.size / PHASES
            if independent >= FEWEST:
                ratio = math.sqrt(float(np.mean(e**2)))
                by_chance = math.sqrt(chi2.isf(CHANCE, independent) / independent)
                if ratio > max(LARGE, by_chance):
                    yield {"channel": channel, "horizon_s": horizon, "ratio": round(ratio, 2)}


def scaled_errors(problem: Problem, fit: Fit, phase: float) -> np.ndarray:
    """Prediction errors over the std that the fitted noise gives them, (starts, horizons, 18).

    Args:
        problem, fit: the model, its values and noise.
        phase: where the first start lies, as a share of the time from one to the next.
    """
    every = [(r, start) for r in problem.engine.records for start in _starts(r, phase).tolist()]
    picked = np.linspace(0, len(every) - 1, min(len(every), MOST_STARTS)).round().astype(int)
    pieces = [(_about(*every[i]), every[i][1]) for i in picked.tolist()]
    if not pieces:
        return np.empty((0, len(HORIZONS), len(CHANNELS)))
    blind = problem.with_records([_unseen(*piece) for piece in pieces]).engine
    rows = [_rows_ahead(record.t, start) for record, start in pieces]
    passes = blind.filter(fit.values, fit.noise, start_rows=[np.unique(r[r >= 0]) for r in rows])
    return np.array(
        [
            _scaled(problem, fit, run, record.z, own)
            for run, (record, _), own in zip(passes, pieces, rows, strict=True)
        ]
    )


def _starts(record: Record, phase: float) -> np.ndarray:
    """Times of the starts [s]."""
    between = SEEN + HORIZONS[-1]
    first = record.t[0] + SEEN + phase * between
    return np.arange(first, record.t[-1] - HORIZONS[0], between)


def _about(record: Record, start: float) -> Record:
    """The record's rows from LEAD s before a start to the last horizon."""
    t = record.t
    return part(record, (t > start - LEAD) & (t <= start + HORIZONS[-1] + 1e-6))


def _unseen(record: Record, start: float) -> Record:
    """The record without readings, and what commands show of them, from a start on."""
    z = record.z.copy()
    shown = None if record.input_innovations is None else record.input_innovations.copy()
    rows = record.t > start
    z[rows] = np.nan
    if shown is not None:
        shown[rows] = 0.0
    return replace(record, z=z, input_innovations=shown)


def _rows_ahead(t: np.ndarray, start: float) -> np.ndarray:
    """Row at each horizon from a start, (horizons,); -1 beyond the end."""
    times = start + np.array(HORIZONS)
    rows = np.searchsorted(t, times + 1e-6) - 1
    return np.where(times <= t[-1] + 1e-6, rows, -1)


def _scaled(
    problem: Problem, fit: Fit, run: RunPass, z: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """Errors of one start's predictions over their std, (horizons, 18)."""
    engine = problem.engine
    p = engine.model.vector(fit.values, fit.noise)
    inputs = engine.model.inputs(replace(run.record, input_innovations=None), p)
    scale = engine.model.state_scale
    reading = _reading_std(fit.noise)
    slot = {int(row): k for k, row in enumerate(run.start_rows)}
    result = np.full((*rows.shape, len(CHANNELS)), np.nan)

    def read(states: np.ndarray, row: int) -> np.ndarray:
        out = np.full((len(states), len(CHANNELS)), np.nan)
        compiled_model.read(engine.compiled, states, inputs[row], p, out)
        return out

    for h in np.flatnonzero(rows >= 0):
        row = int(rows[h])
        x, P = run.states[row], run.start_covariances[slot[row]]
        known, *moved = read(np.vstack([x, x + np.diag(scale)]), row)
        with np.errstate(invalid="ignore"):  # a model that ran away reads infinity: none here
            H = (np.array(moved) - known).T / scale
        blur = 0.0 if run.record.blur is None else run.record.blur[row]
        std = np.sqrt(np.einsum("ij,jk,ik->i", H, P, H) + reading**2 + blur)
        late = _late_rows(run.record.t, z, row)
        last = {int(k): read(run.states[k : k + 1], k)[0] for k in np.unique(late[late >= 0])}
        for c in np.flatnonzero(late >= 0):
            error = z[late[c], c] - last[int(late[c])][c]
            if CHANNELS[c] in ANGLES:
                error = math.remainder(error, 2.0 * math.pi)
            result[h, c] = error / std[c]
    return result


def _reading_std(noise: Noise) -> np.ndarray:
    return np.array([noise.reading.get(c, np.nan) for c in CHANNELS])


def _late_rows(t: np.ndarray, z: np.ndarray, row: int) -> np.ndarray:
    """Row of each channel's last reading by a row, at most TAIL before it; -1 for none, (18,)."""
    first = int(np.searchsorted(t, t[row] - TAIL))
    there = np.isfinite(z[first : row + 1])
    last = there.shape[0] - 1 - np.argmax(there[::-1], axis=0)
    return np.where(there.any(axis=0), first + last, -1)


# --- innovations ------------------------------------------------------------------------------------


def _spectra(passes: Sequence[RunPass]) -> Iterable[dict[str, Any]]:
    """Channels and bands in which the innovations are louder than white noise of std 1."""
    for c, channel in enumerate(CHANNELS):
        for low, high in BANDS:
            power = np.concatenate([_power(run, c, low, high) for run in passes])
            if power.size >= FEWEST:
                ratio = math.sqrt(float(power.mean()))
                by_chance = math.sqrt(chi2.isf(CHANCE, 2 * power.size) / (2 * power.size))
                if ratio > max(LARGE, by_chance):
                    yield {
                        "channel": channel,
                        "band_hz": [low, high],
                        "ratio": round(ratio, 2),
                    }


def _power(run: RunPass, c: int, low: float, high: float) -> np.ndarray:
    """Periodogram of a channel's innovations in a band, of mean 1 for white ones of std 1."""
    settled = run.record.t > run.record.t[0] + SEEN
    there = settled & np.isfinite(run.innovations[:, c])
    e, t = run.innovations[there, c], run.record.t[there]
    if e.size < 4 * FEWEST:
        return np.empty(0)
    frequency = np.fft.rfftfreq(e.size, (t[-1] - t[0]) / (e.size - 1))
    power = np.abs(np.fft.rfft(e)) ** 2 / e.size
    inside = (frequency > max(low, 0.0)) & (frequency <= high) & (frequency < frequency[-1])
    return np.asarray(power[inside])


def _answers(passes: Sequence[RunPass]) -> Iterable[dict[str, Any]]:
    """Channels whose innovations follow a command, and after what time most."""
    changes = [_changes_before(run.record) for run in passes]
    for c, channel in enumerate(CHANNELS):
        found, count = _correlations(passes, changes, c)
        by_chance = norm.isf(CHANCE) / math.sqrt(max(count, 1))
        for command, of_command in zip(COMMANDS, found, strict=True):
            most = int(np.argmax(np.abs(of_command)))
            if abs(of_command[most]) > max(CORRELATED, by_chance):
                yield {
                    "channel": channel,
                    "command": command,
                    "lag_s": LAGS[most],
                    "correlation": round(float(of_command[most]), 3),
                }


def _correlations(
    passes: Sequence[RunPass], changes: Sequence[np.ndarray], c: int
) -> tuple[np.ndarray, int]:
    """Correlations of a channel's innovations, beyond their own past, with each command's changes
    before them, (4, lags); and their number.

    Args:
        passes: of the runs. changes: `_changes_before` of each. c: the channel's place.
    """
    e, before = [], []
    for run, change in zip(passes, changes, strict=True):
        t = run.record.t
        there = (t > t[0] + SEEN) & np.isfinite(run.innovations[:, c])
        e.append(beyond_its_past(run.innovations[there, c]))
        before.append(change[..., there])
    innovations = np.concatenate(e)
    found = np.apply_along_axis(correlation, 2, np.concatenate(before, axis=2), innovations)
    return found, innovations.size


def _changes_before(record: Record) -> np.ndarray:
    """Each command's change over the first of LAGS, LAGS before each row, (4, lags, n)."""
    t = record.t
    return np.array(
        [
            [np.interp(t - lag, t, u) - np.interp(t - lag - LAGS[0], t, u) for lag in LAGS]
            for u in record.command.T
        ]
    )
