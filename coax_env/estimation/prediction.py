"""What the simulation gets wrong: the filtered state flown open loop over a horizon (contract.md).

From starts every quarter of a second, after one second of filtering, the filtered state is flown
with the recorded commands and compared with the measurement at the horizon's end. The gust states are
set to zero; the version in which they decay is computed beside it. Where a channel has no reading at
the end itself, its last one within the final TAIL seconds is used, at its own time.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError
from coax_env.estimation import kalman
from coax_env.estimation.engine import Engine, Progress, RunPass
from coax_env.estimation.helicopter import (
    GUST_LEVELS,
    HeliModel,
    record_of,
    sensor_std,
    starting_noise,
)
from coax_env.estimation.noise_levels import fit_noise
from coax_env.estimation.state_space import Noise
from coax_env.logs.flight import Flight, read_flight
from coax_env.model import state as S
from coax_env.model.layout import CHANNEL_UNITS, CHANNELS, GUSTS, N_FULL
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

HEADING = CHANNELS.index("psi")
WARM_UP = 1.0  # s of filtering before the first start
EVERY = 0.25  # s between starts
TAIL = 0.15  # s
COMPARED = ("p", "q", "r", "phi", "theta", "psi", "h", "vn", "ve", "vd", "pn", "pe", "v")
"""Channels of the gain: attitude, rates, velocity, position and height."""


@dataclass(frozen=True)
class ChannelReplay:
    """One channel over all starts of a run; NaN where there was nothing to compare with.

    t: (s,) time of the reading. measured, predicted: (s,). error: (s,), wrapped for roll and pitch;
    heading counts whole turns, since both are followed from the start.
    error_decaying: (s,) the same with gusts that decay instead of vanishing.
    """

    t: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    error: np.ndarray
    error_decaying: np.ndarray


@dataclass(frozen=True)
class RunReplay:
    """One run flown again from many starts."""

    name: str
    channels: Mapping[str, ChannelReplay]
    diverged: bool
    floor: Mapping[str, float]
    """Std by channel that the uncertainty of the start alone gives at the end; empty unless asked."""


def fly_again(
    engine: Engine,
    values: Mapping[str, float],
    noise: Noise,
    horizon: float = 1.0,
    floor: bool = False,
) -> list[RunReplay]:
    """Replay every record of an engine.

    Args:
        engine: model and records.
        values: of all parameters, by name.
        noise: levels of process and reading noise.
        horizon: seconds flown open loop.
        floor: also the error of a perfect model from the same starts.
    """
    starts = [_starts(r.t, horizon) for r in engine.records]
    passes = engine.filter(values, noise, start_rows=starts)
    p = engine.model.vector(values)
    result = []
    for run, dt in zip(passes, engine.intervals, strict=True):
        record = run.record
        # open loop: what a command shows of the state is no part of the prediction
        inputs = engine.model.inputs(replace(record, input_innovations=None), p)
        present = np.isfinite(record.z)
        used = [i for i in range(len(CHANNELS)) if present[:, i].any()]
        rows = run.start_rows
        shape = (rows.size, len(CHANNELS))
        t, measured, predicted, decaying = (np.full(shape, np.nan) for _ in range(4))
        diverged = not np.isfinite(run.log_likelihood)
        variance = np.zeros(shape)
        turns = _unwrapped(record.z)
        for s, first in enumerate(rows):
            last = int(np.searchsorted(record.t, record.t[first] + horizon + 1e-6) - 1)
            targets = _targets(present, record.t, last, used)
            for gust, out in ((0.0, predicted), (1.0, decaying)):
                x = run.states[first].copy()
                x[GUSTS] *= gust
                ok = kalman.fly_open_loop(engine.compiled, dt, inputs, x, p, first, targets, out[s])
                diverged |= not ok
            for i in used:
                if targets[i] >= 0:
                    t[s, i] = record.t[targets[i]]
                    measured[s, i] = turns[targets[i], i]
            turn = (
                2.0
                * np.pi
                * np.round((run.states[first, S.PSI] - turns[first, HEADING]) / (2.0 * np.pi))
            )
            if np.isfinite(turn):
                measured[s, HEADING] += turn
            if floor and not diverged and s % 4 == 0:
                variance[s] = _spread(engine, run, inputs, dt, p, first, targets, s)
        result.append(
            RunReplay(
                record.name,
                {
                    CHANNELS[i]: _channel(
                        CHANNELS[i], *(a[:, i] for a in (t, measured, predicted, decaying))
                    )
                    for i in used
                },
                diverged,
                {CHANNELS[i]: float(np.sqrt(variance[::4, i].mean())) for i in used} if floor else {},
            )
        )  # fmt: skip
    return result


def _unwrapped(z: np.ndarray) -> np.ndarray:
    """Readings with the heading made continuous and held where there is no new one."""
    z = z.copy()
    heading = z[:, HEADING]
    there = np.isfinite(heading)
    if there.any():
        rows = np.maximum(np.cumsum(there) - 1, 0)
        z[:, HEADING] = np.unwrap(heading[there])[rows]
    return z


def _starts(t: np.ndarray, horizon: float) -> np.ndarray:
    times = np.arange(t[0] + WARM_UP, t[-1] - horizon + 1e-9, EVERY)
    rows = np.searchsorted(t, times - 1e-6)
    return np.unique(rows[rows < t.size]).astype(np.int64)


def _targets(present: np.ndarray, t: np.ndarray, last: int, used: Sequence[int]) -> np.ndarray:
    """Row of each channel's last reading within TAIL before `last`, or -1."""
    targets = np.full(len(CHANNELS), -1, np.int64)
    first = int(np.searchsorted(t, t[last] - TAIL))
    for i in used:
        rows = np.flatnonzero(present[first : last + 1, i])
        if rows.size:
            targets[i] = first + rows[-1]
    return targets


def _channel(
    name: str, t: np.ndarray, measured: np.ndarray, predicted: np.ndarray, decaying: np.ndarray
) -> ChannelReplay:
    error, error_decaying = predicted - measured, decaying - measured
    if name in ("phi", "theta"):
        error, error_decaying = (
            np.mod(e + np.pi, 2.0 * np.pi) - np.pi for e in (error, error_decaying)
        )
    return ChannelReplay(t, measured, predicted, error, error_decaying)


def _spread(
    engine: Engine,
    run: RunPass,
    inputs: np.ndarray,
    dt: np.ndarray,
    p: np.ndarray,
    first: int,
    targets: np.ndarray,
    slot: int,
) -> np.ndarray:
    """Variance by channel of a perfect model's prediction: the start's covariance flown forward."""
    base = np.full(len(CHANNELS), np.nan)
    moved = np.full(len(CHANNELS), np.nan)
    sensitivity = np.zeros((len(CHANNELS), N_FULL))
    x0 = run.states[first].copy()
    x0[GUSTS] = 0.0

    def fly(x: np.ndarray, out: np.ndarray) -> None:
        kalman.fly_open_loop(engine.compiled, dt, inputs, x, p, first, targets, out)

    fly(x0.copy(), base)
    for j in range(GUSTS.start):
        x = x0.copy()
        x[j] += engine.model.state_scale[j]
        fly(x, moved)
        sensitivity[:, j] = (moved - base) / engine.model.state_scale[j]
    sensitivity[~np.isfinite(sensitivity)] = 0.0
    return np.einsum("ij,jk,ik->i", sensitivity, run.start_covariances[slot], sensitivity)


# --- what the scripts call -------------------------------------------------------------------------


@dataclass(frozen=True)
class Replay:
    """Result of `replay`: what `replay.json` says, and the traces behind it."""

    findings: dict[str, Any]
    runs: list[RunReplay]
    noise: Noise
    flight: Flight
    vehicle: Vehicle
    horizon: float


def replay(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    horizon: float = 1.0,
    progress: Progress | None = None,
) -> Replay:
    """What the simulation of this vehicle gets wrong on this flight, per run and channel.

    Args:
        flight: a Flight or its folder.
        vehicle: a Vehicle, name or path; default the card's.
        horizon: seconds flown open loop.
        progress: called with a line of text.
    """
    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    vehicle = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    longest = max(run.duration for run in flight.runs)
    if longest < WARM_UP + horizon:
        raise InputError(
            f"a horizon of {horizon:g} s after {WARM_UP:g} s of filtering is longer than every run"
            f" (at most {longest:.1f} s)"
        )
    model = HeliModel(vehicle)
    engine = Engine(model, [record_of(run) for run in flight.runs])
    noise = starting_noise(flight, vehicle)
    if progress:
        progress("estimating gusts and noise")
    noise = fit_noise(engine, model.bare_values, noise, GUST_LEVELS)
    if progress:
        progress("flying again")
    runs = fly_again(engine, model.bare_values, noise, horizon)
    sensors = {c: sensor_std(flight, c) for c in flight.channels}
    findings = {
        "horizon_s": horizon,
        "vehicle": vehicle.name,
        "gusts": gusts_of(noise),
        "runs": {run.name: run_table(run, sensors) for run in runs},
    }
    return Replay(findings, runs, noise, flight, vehicle, horizon)


def gusts_of(noise: Noise) -> dict[str, Any]:
    """Gust levels as findings.json has them."""
    level = noise.process
    return {
        "force_N": [level["force_xy"], level["force_xy"], level["force_z"]],
        "moment_Nm": [level["moment_xy"], level["moment_xy"], level["moment_z"]],
        "memory_s": level["memory"],
    }


def run_table(run: RunReplay, noise: Mapping[str, float]) -> dict[str, Any]:
    """One run of replay.json; `noise` is the sensors' std by channel."""
    table: dict[str, Any] = {}
    for name, channel in run.channels.items():
        good = np.isfinite(channel.error)
        lost = run.diverged or not good.any()
        entry: dict[str, Any] = {
            "rms": None if lost else rms(channel.error),
            "rms_gusts_decaying": None if lost else rms(channel.error_decaying),
            "noise_rms": noise[name],
            "unit": CHANNEL_UNITS[name],
        }
        if run.diverged:
            entry["diverged"] = True
        table[name] = entry
    return table


def rms(error: np.ndarray) -> float:
    """Root mean square of what is there."""
    return float(np.sqrt(np.nanmean(error**2)))


def pooled_rms(runs: Iterable[RunReplay]) -> dict[str, float]:
    """RMS by channel over runs that did not diverge."""
    gathered: dict[str, list[np.ndarray]] = {}
    for run in runs:
        if not run.diverged:
            for name, channel in run.channels.items():
                gathered.setdefault(name, []).append(channel.error)
    joined = {name: np.concatenate(parts) for name, parts in gathered.items()}
    return {name: rms(e) for name, e in joined.items() if np.isfinite(e).any()}
