"""What the simulation gets wrong: the filtered state flown open loop over a horizon.

From starts every quarter of a second, after one second of filtering, the filtered state is flown
with the recorded commands and compared with the measurement at the horizon's end. The gust states are
set to zero; the version in which they decay is computed beside it. Where a channel has no reading at
the end itself, its last one within the final TAIL seconds is used, at its own time.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from coax_env.consistency.agreement import refuse_disagreement
from coax_env.errors import InputError
from coax_env.estimation import compiled_model
from coax_env.estimation.engine import Engine
from coax_env.estimation.flown import flown_parts
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import (
    AXES,
    fitted_levels,
    gust_levels,
    sensor_std,
    starting_noise,
)
from coax_env.estimation.joint_gusts import felt_gusts
from coax_env.estimation.noise_levels import fit_noise
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import Noise
from coax_env.logs.flight import Flight, read_flight
from coax_env.model import state as S
from coax_env.model.layout import CHANNEL_UNITS, CHANNELS, GUSTS
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.progress import Progress

NO_VALUES: Mapping[str, float] = MappingProxyType({})
HEADING = CHANNELS.index("psi")
ROLL_AND_PITCH = [CHANNELS.index("phi"), CHANNELS.index("theta")]
WARM_UP = 1.0  # [s] of filtering before the first start
EVERY = 0.25  # [s] between starts
TAIL = 0.15  # [s] before the horizon's end in which a reading counts as at it
FLOOR_EVERY = 4  # starts; each floor takes as many flights as there are states
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
    """One run flown open loop from many starts."""

    name: str
    channels: Mapping[str, ChannelReplay]
    diverged: bool
    floor: Mapping[str, float]
    """Std by channel that the uncertainty of the start alone gives at the end; empty unless asked."""
    still: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Errors by channel, (s,), of the prediction that nothing changes from the start on."""
    log_likelihood: float = math.nan
    """Of the run's readings, each predicted from those before it [nats]."""


def replay_runs(
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
    p = engine.model.vector(values, noise)
    parts: dict[str, list[RunReplay]] = {}
    for i, (run, dt) in enumerate(zip(passes, engine.intervals, strict=True)):
        own, _ = engine.of_run(i, values, noise, p)
        parts.setdefault(run.record.whole, []).append(
            _replay_run(engine, run, dt, own, horizon, floor)
        )
    return [_joined(name, of_run) for name, of_run in parts.items()]


def errors_ahead(
    engine: Engine, values: Mapping[str, float], noise: Noise, horizons: Sequence[float]
) -> list[np.ndarray]:
    """Open-loop errors of every record after each of some horizons, as `replay_runs` has them.

    Args:
        engine: model and records.
        values: of all parameters, by name.
        noise: levels of process and reading noise.
        horizons: seconds flown open loop, from the same starts.

    Returns:
        (starts, channels) a horizon, NaN where there is no reading, infinite where a flight diverged.
    """
    starts = [_starts(r.t, max(horizons)) for r in engine.records]
    passes = engine.filter(values, noise, start_rows=starts)
    p = engine.model.vector(values, noise)
    found: list[list[np.ndarray]] = [[] for _ in horizons]
    for i, (run, dt) in enumerate(zip(passes, engine.intervals, strict=True)):
        own, _ = engine.of_run(i, values, noise, p)
        inputs = engine.model.inputs(replace(run.record, input_innovations=None), own)
        for errors, horizon in zip(found, horizons, strict=True):
            targets = _targets(run, horizon)
            _, measured = _readings_at(run, targets)
            predicted, _ = _fly(engine, run, inputs, dt, own, targets, gusts=0.0)
            lost = ~np.isfinite(predicted) | ~np.isfinite(run.log_likelihood)
            off = predicted - measured
            off[:, ROLL_AND_PITCH] = _wrapped(off[:, ROLL_AND_PITCH])
            errors.append(np.where(np.isfinite(measured) & lost, np.inf, off))
    return [np.concatenate(errors) for errors in found]


def _joined(name: str, parts: Sequence[RunReplay]) -> RunReplay:
    """The parts of a run as one."""
    if len(parts) == 1:
        return replace(parts[0], name=name)
    columns = [f.name for f in fields(ChannelReplay)]
    channels, floor, still = {}, {}, {}
    for channel in dict.fromkeys(c for part in parts for c in part.channels):
        there = [part for part in parts if channel in part.channels]
        channels[channel] = ChannelReplay(
            *(np.concatenate([getattr(p.channels[channel], c) for p in there]) for c in columns)
        )
        floors = [p.floor[channel] for p in there if channel in p.floor]
        if floors:
            floor[channel] = float(np.sqrt(np.mean(np.square(floors))))
        still[channel] = np.concatenate([p.still[channel] for p in there])
    nats = sum(part.log_likelihood for part in parts)
    return RunReplay(name, channels, any(part.diverged for part in parts), floor, still, nats)


def _replay_run(
    engine: Engine, run: RunPass, dt: np.ndarray, p: np.ndarray, horizon: float, floor: bool
) -> RunReplay:
    # open loop: the input innovations, which know the state, are no part of the prediction
    inputs = engine.model.inputs(replace(run.record, input_innovations=None), p)
    targets = _targets(run, horizon)
    used = np.flatnonzero(np.isfinite(run.record.z).any(axis=0))
    t, measured = _readings_at(run, targets)
    predicted, finite = _fly(engine, run, inputs, dt, p, targets, gusts=0.0)
    decaying, decayed = _fly(engine, run, inputs, dt, p, targets, gusts=1.0)
    here = np.tile(run.start_rows[:, None], len(CHANNELS))
    unmoved, _ = _fly(engine, run, inputs, dt, p, here, gusts=1.0)
    diverged = not (finite and decayed and np.isfinite(run.log_likelihood))
    return RunReplay(
        run.record.name,
        {
            CHANNELS[i]: _channel(
                CHANNELS[i], t[:, i], measured[:, i], predicted[:, i], decaying[:, i]
            )
            for i in used
        },
        diverged,
        _floor(engine, run, inputs, dt, p, targets, used) if floor and not diverged else {},
        {CHANNELS[i]: _error(CHANNELS[i], unmoved[:, i] - measured[:, i]) for i in used},
        run.log_likelihood,
    )


def _fly(
    engine: Engine,
    run: RunPass,
    inputs: np.ndarray,
    dt: np.ndarray,
    p: np.ndarray,
    targets: np.ndarray,
    gusts: float,
) -> tuple[np.ndarray, bool]:
    """Readings (s, 18) flown to from every start, and whether every flight stayed finite.

    gusts: share of them that is there at the start.
    """
    flown = np.full(targets.shape, np.nan)
    x = run.states[run.start_rows]
    x[:, engine.model.air] *= gusts
    finite = compiled_model.fly_open_loop(
        engine.compiled, dt, inputs, x, p, run.start_rows, targets, flown
    )
    return flown, bool(finite)


def _readings_at(run: RunPass, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time and value of the readings at the targets, (s, 18); the heading with the state's turns."""
    there = targets >= 0
    t = np.where(there, run.record.t[targets], np.nan)
    unwrapped = _unwrapped(run.record.z)
    measured = np.where(there, np.take_along_axis(unwrapped, targets, axis=0), np.nan)
    rows = run.start_rows
    turns = np.round((run.states[rows, S.PSI] - unwrapped[rows, HEADING]) / (2.0 * np.pi))
    measured[:, HEADING] += np.where(np.isfinite(turns), 2.0 * np.pi * turns, 0.0)
    return t, measured


def _floor(
    engine: Engine,
    run: RunPass,
    inputs: np.ndarray,
    dt: np.ndarray,
    p: np.ndarray,
    targets: np.ndarray,
    used: np.ndarray,
) -> dict[str, float]:
    """Std by channel that the uncertainty of every fourth start alone gives at the end."""
    every = range(0, len(targets), FLOOR_EVERY)
    variance = np.zeros((len(every), len(CHANNELS)))
    for row, s in zip(variance, every, strict=True):
        row[:] = _spread(engine, run, inputs, dt, p, targets[s], s)
    return {CHANNELS[i]: float(np.sqrt(variance[:, i].mean())) for i in used}


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


def _targets(run: RunPass, horizon: float) -> np.ndarray:
    """Row of each channel's last reading within TAIL of each start's horizon, (s, 18); -1 for none."""
    t, present = run.record.t, np.isfinite(run.record.z)
    ends = np.searchsorted(t, t[run.start_rows] + horizon + 1e-6) - 1
    begins = np.searchsorted(t, t[run.start_rows] + horizon - TAIL - 1e-6)
    latest = np.maximum.accumulate(np.where(present, np.arange(t.size)[:, None], -1), axis=0)
    found = latest[ends]
    return np.ascontiguousarray(np.where(found >= begins[:, None], found, -1), dtype=np.int64)


def _channel(
    name: str, t: np.ndarray, measured: np.ndarray, predicted: np.ndarray, decaying: np.ndarray
) -> ChannelReplay:
    error, error_decaying = (_error(name, flown - measured) for flown in (predicted, decaying))
    return ChannelReplay(t, measured, predicted, error, error_decaying)


def _error(name: str, difference: np.ndarray) -> np.ndarray:
    """Prediction less measurement, wrapped for roll and pitch."""
    return _wrapped(difference) if name in ("phi", "theta") else difference


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """Within half a turn."""
    return np.asarray(np.mod(angle + np.pi, 2.0 * np.pi) - np.pi)


def _spread(
    engine: Engine,
    run: RunPass,
    inputs: np.ndarray,
    dt: np.ndarray,
    p: np.ndarray,
    targets: np.ndarray,
    s: int,
) -> np.ndarray:
    """Variance by channel of a perfect model's prediction: start s's covariance flown forward."""
    moved_by = engine.model.state_scale[: GUSTS.start]
    x = np.tile(run.states[run.start_rows[s]], (1 + moved_by.size, 1))
    x[:, engine.model.air] = 0.0
    x[1:, : moved_by.size] += np.diag(moved_by)
    flown = np.full((len(x), len(CHANNELS)), np.nan)
    first = np.full(len(x), run.start_rows[s])
    compiled_model.fly_open_loop(
        engine.compiled, dt, inputs, x, p, first, np.tile(targets, (len(x), 1)), flown
    )
    sensitivity = np.zeros((len(CHANNELS), x.shape[1]))
    sensitivity[:, : moved_by.size] = ((flown[1:] - flown[0]) / moved_by[:, None]).T
    sensitivity[~np.isfinite(sensitivity)] = 0.0
    return np.einsum("ij,jk,ik->i", sensitivity, run.start_covariances[s], sensitivity)


# --- what the scripts call -------------------------------------------------------------------------


@dataclass(frozen=True)
class Replay:
    """Result of `replay`: the content of `replay.json`, and the traces behind it."""

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
    waive: Collection[str] = (),
) -> Replay:
    """What the simulation of this vehicle gets wrong on this flight, per run and channel.

    Args:
        flight: a Flight or its folder.
        vehicle: a Vehicle, name or path; default the card's.
        horizon: seconds flown open loop.
        progress: called with a line of text.
        waive: checks of the log with itself (consistency/) that are passed over, beside the card's.

    Raises:
        InputError: a log that contradicts itself, or no run that is long enough.
    """
    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    vehicle = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    flight = flown_parts(flight, vehicle)
    refuse_disagreement(flight, vehicle, waive)
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
    noise = fit_noise(engine, model.bare_values, noise, fitted_levels(noise))
    if progress:
        progress("flying the runs open loop")
    runs = replay_runs(engine, model.bare_values, noise, horizon)
    sensors = {c: sensor_std(flight, c) for c in flight.channels}
    findings = {
        "horizon_s": horizon,
        "vehicle": vehicle.name,
        "gusts": gusts_of(noise),
        "runs": {run.name: run_table(run, sensors) for run in runs},
    }
    return Replay(findings, runs, noise, flight, vehicle, horizon)


def gusts_of(noise: Noise, values: Mapping[str, float] = NO_VALUES) -> dict[str, Any]:
    """Gust levels as findings.json has them; the memory is that of the axes that move a state most.

    Args:
        noise: levels. values: of the parameters, in which shares of joint gusts may be.
    """
    level = noise.process
    strongest = max(AXES, key=lambda axes: level[axes] / noise.floor.get(axes, 1.0))
    std = felt_gusts(gust_levels(noise), values).tolist()
    return {"force_N": std[:3], "moment_Nm": std[3:], "memory_s": level[f"memory_{strongest}"]}


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


def mean_log_ratio(ours: Mapping[str, float], theirs: Mapping[str, float]) -> float:
    """Mean over channels of the log of one's rms over another's; 0 where they have none in common.

    Args:
        ours, theirs: as of `pooled_rms`.
    """
    logs = [math.log(ours[c] / theirs[c]) for c in ours if theirs.get(c, 0.0) > 0.0 < ours[c]]
    return float(np.mean(logs)) if logs else 0.0
