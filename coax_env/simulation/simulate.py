"""Simulated flights: a maneuver flown by the env's own control period, logged as a flight folder."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.env import period
from coax_env.errors import InputError
from coax_env.logs.clipped import clipped
from coax_env.logs.flight import Flight, Run
from coax_env.logs.repairs import SHORTEST_RUN
from coax_env.model import dynamics
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.actuators import limits
from coax_env.model.effect_registry import GUST_MEMORY
from coax_env.model.layout import (
    CHANNELS,
    GUSTS,
    N_CHANNELS,
    N_COMMANDS,
    N_FULL,
    N_INPUTS,
    STATES,
)
from coax_env.model.sensors import Sensor, log_suite
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.simulation.log import log_readings
from coax_env.simulation.maneuvers import Maneuver, maneuver
from coax_env.simulation.pilot import CORNER, Pilot, rounded

STEP = 0.01  # [s] the paper's
_TOO_FAR = 1.4  # [rad] of roll or pitch that ends a run


@dataclass(frozen=True)
class Gusts:
    """Gusts as the estimator models them: force and moment in body axes, exponential memory."""

    force_N: tuple[float, float, float] = (0.05, 0.05, 0.08)
    moment_Nm: tuple[float, float, float] = (1e-3, 1e-3, 3e-4)
    memory_s: float = 0.5

    def levels(self) -> np.ndarray:
        """Std of the six gust states, shape (6,)."""
        return np.array([*self.force_N, *self.moment_Nm])


@dataclass(frozen=True)
class Track:
    """The truth of one simulated run.

    Attributes:
        t: (n,) [s]; state: (n, 29) full state; command: (n, 4); readings: (n, 18) without noise.
        ended: why the run ended before its time, in words; empty where it did not.
    """

    maneuver: Maneuver
    t: np.ndarray
    state: np.ndarray
    command: np.ndarray
    readings: np.ndarray
    ended: str = ""

    def __getitem__(self, name: str) -> np.ndarray:
        """History of a state of the paper by its name, SI, shape (n,)."""
        return self.state[:, [n for n, _ in STATES].index(name)]

    def reading(self, channel: str) -> np.ndarray:
        """True readings of a channel in its unit, shape (n,)."""
        return self.readings[:, CHANNELS.index(channel)]


def fly(
    vehicle: Vehicle | str,
    plan: Maneuver | str,
    *,
    seed: int | np.random.SeedSequence = 0,
    closed_loop: bool | None = None,
    gusts: Gusts | None = None,
    tremor: float = 0.0,
    dt: float = STEP,
) -> Track:
    """Fly one maneuver from the vehicle's own trim; the truth, without sensors.

    Args:
        vehicle: what `load_vehicle` takes; its effects are flown.
        plan: name of `maneuvers.MANEUVERS`, or a maneuver.
        seed: of tremor and gusts.
        closed_loop: whether a pilot flies; None leaves it to the maneuver.
        gusts: None for none.
        tremor: size of the pilot's tremor, 1 is usual.
        dt: seconds per row.

    Raises:
        InputError: no such maneuver or vehicle, no hover, or the run ends within two seconds.
    """
    vehicle = load_vehicle(vehicle)
    plan = maneuver(plan)
    piloted = plan.closed_loop if closed_loop is None else closed_loop
    rng = np.random.default_rng(seed)
    pilot = Pilot(vehicle, plan.height, dt, tremor) if piloted else None
    start, trim = dynamics.hover_trim(vehicle, plan.height)
    t = np.arange(round(plan.duration / dt) + 1) * dt
    plan_command = trim + plan.injection(t, trim)
    reference = rounded(plan.asked_for(t), round(CORNER / dt))
    reference_rate = np.gradient(reference, dt, axis=0)

    machine = _Machine(vehicle, start, trim, dt, gusts)
    states, commands = np.empty((len(t), N_FULL)), np.empty((len(t), N_COMMANDS))
    readings = np.empty((len(t), N_CHANNELS))
    rows, ended = len(t), ""
    for row in range(len(t)):
        machine.disturb(rng)
        x = machine.x
        command = plan_command[row].copy()
        if pilot is not None:
            command += pilot.correction(x, reference[row], reference_rate[row], dt, rng)
            command[:2] = np.maximum(command[:2], 0.0)
        states[row], commands[row] = x, command
        machine.give(command, readings[row])
        ended = _why_it_ends(x)
        if ended:
            rows = row
            break
        machine.fly()
    if rows and t[rows - 1] < SHORTEST_RUN:
        raise InputError(f"maneuver {plan.name!r} ends after {t[rows - 1]:.2f} s: {ended}")
    note = f"ended at {t[rows - 1]:.2f} s: {ended}" if ended else ""
    return Track(plan, t[:rows], states[:rows], commands[:rows], readings[:rows], note)


class _Machine:
    """One helicopter flown row by row, by the parts of the env's control period (env/period.py).

    A log's reading is taken just after its row's command has been given; the env's just before the
    next. So `give` measures, with the command that is then in force.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        start: np.ndarray,
        trim: np.ndarray,
        dt: float,
        gusts: Gusts | None,
    ) -> None:
        """From a paper state (16,) at a command (4,); ``dt``: seconds per row."""
        self.x = dynamics.full_state(start, trim, vehicle)
        self._p = vehicle.vector.copy()
        self._u, self._last, self._limits = np.zeros(N_INPUTS), trim.copy(), limits(vehicle)
        values = vehicle.values()
        slots = period.delay_slots(sum(values.get(name, 0.0) for name in period.DELAYS), dt)
        self._ring = np.tile(trim, (slots, 1))
        self._row, self._azimuth, self._dt = 0, 0.0, dt
        self._work = np.empty(dynamics.WORK_SIZE)
        self._gust = np.zeros(6) if gusts is None else gusts.levels()
        self._memory = GUST_MEMORY if gusts is None else gusts.memory_s
        if gusts is not None:
            self._p[P.GUST_MEMORIES] = gusts.memory_s

    def disturb(self, rng: np.random.Generator) -> None:
        """The gusts of the coming row; in the first, those of a wind that has always blown."""
        if self._gust.any():
            growth = period.gust_growth(self._dt, self._memory) if self._row else 1.0
            self.x[GUSTS] += growth * self._gust * rng.standard_normal(6)

    def give(self, command: np.ndarray, readings: np.ndarray) -> None:
        """Give the row's command (4,); the true readings then, (18,), into `readings`."""
        u, p, ring, row = self._u, self._p, self._ring, self._row
        u[:N_COMMANDS] = command
        period.give_command(u, self._last, self._limits, ring, row, self._dt)
        period.apply_delays(u, p, ring, row, self._dt)
        period.true_readings(self.x, u, p, self._azimuth, self._work, readings)

    def fly(self) -> None:
        """Fly the row under the command that was given."""
        period.fly_period(
            self.x, self._u, self._p, self._ring, self._row, self._dt, self._work
        )  # fmt: skip
        self._azimuth = period.next_azimuth(self._azimuth, self.x[S.OMEGA_U], self._dt)
        self._row += 1


def _why_it_ends(x: np.ndarray) -> str:
    if not math.isfinite(x.sum()):
        return "the simulation diverged"
    if max(abs(x[S.PHI]), abs(x[S.THETA])) > _TOO_FAR:
        return "the helicopter tipped over"
    if x[S.Z] > 0.0:
        return "the helicopter hit the ground"
    return ""


def simulate(
    vehicle: Vehicle | str,
    maneuvers: str | Maneuver | Iterable[str | Maneuver],
    *,
    sensors: str = "onboard",
    noise: bool = True,
    seed: int = 0,
    closed_loop: bool | None = None,
    gusts: Gusts | None = None,
    tremor: float = 1.0,
    dt: float = STEP,
) -> Flight:
    """Fly maneuvers and log them as the sensors see them.

    Args:
        vehicle: what `load_vehicle` takes; its effects are flown.
        maneuvers: names of `maneuvers.MANEUVERS`, or maneuvers; one run each.
        sensors: suite of `sensors.SUITES`; ``state`` logs every channel, exactly.
        noise: whether chance plays in the readings: noise, drawn bias and lost samples. Rates,
            limits and delays stay.
        seed: of noise, tremor and gusts; the same seed gives the same flight.
        closed_loop, gusts, tremor, dt: as in `fly`.

    Raises:
        InputError: as `fly`.
    """
    vehicle = load_vehicle(vehicle)
    suite = log_suite(sensors, vehicle)
    tracks = fly_all(
        vehicle, maneuvers, seed=seed, closed_loop=closed_loop, gusts=gusts, tremor=tremor, dt=dt
    )
    return log_flight(vehicle, tracks, suite, noise=noise, seed=seed)


def fly_all(
    vehicle: Vehicle | str,
    maneuvers: str | Maneuver | Iterable[str | Maneuver],
    *,
    seed: int = 0,
    closed_loop: bool | None = None,
    gusts: Gusts | None = None,
    tremor: float = 1.0,
    dt: float = STEP,
) -> tuple[Track, ...]:
    """The truth behind `simulate`: one track per maneuver, each with its own random numbers.

    Args:
        vehicle, maneuvers, seed: as in `simulate`.
        closed_loop, gusts, tremor, dt: as in `fly`.
    """
    plans = [maneuvers] if isinstance(maneuvers, str | Maneuver) else list(maneuvers)
    if not plans:
        raise InputError("simulate needs at least one maneuver")
    return tuple(
        fly(vehicle, plan, seed=flight, closed_loop=closed_loop, gusts=gusts, tremor=tremor, dt=dt)
        for plan, (flight, _) in zip(plans, _seeds(seed, len(plans)), strict=True)
    )


def log_flight(
    vehicle: Vehicle,
    tracks: Sequence[Track],
    suite: Sequence[Sensor],
    *,
    noise: bool = True,
    seed: int = 0,
) -> Flight:
    """Tracks as a flight folder holds them, seen through sensors.

    Args:
        vehicle: what flew. tracks: from `fly_all`. suite: from `log_suite`.
        noise, seed: as in `simulate`.
    """
    if not noise:
        suite = [replace(sensor, noise=0.0, bias_std=0.0, dropout=0.0) for sensor in suite]
    runs = [
        _log_run(track, suite, np.random.default_rng(readings))
        for track, (_, readings) in zip(tracks, _seeds(seed, len(tracks)), strict=True)
    ]
    names = [run.name for run in runs]
    for k, name in enumerate(names):
        if name in names[:k]:  # flown again
            runs[k] = replace(runs[k], name=f"{name}_{names[:k].count(name) + 1}")
    return Flight(
        vehicle=vehicle.name,
        runs=tuple(runs),
        air={"density": vehicle["air_density"].value, "gravity": vehicle["gravity"].value},
        noise={s.name: s.noise for s in suite if s.noise > 0.0},
        synthetic=True,
    )


def _seeds(seed: int, runs: int) -> list[list[np.random.SeedSequence]]:
    """Per run a seed for gusts and tremor, and one for the readings."""
    if seed < 0:
        raise InputError(f"the seed should not be negative, found {seed}")
    return [source.spawn(2) for source in np.random.SeedSequence(seed).spawn(runs)]


def _log_run(track: Track, suite: Sequence[Sensor], rng: np.random.Generator) -> Run:
    """What the sensors of a suite write down of a track, and a reader of it takes for readings."""
    measured = log_readings(track.readings, track.t, tuple(suite), rng)
    return Run(
        name=track.maneuver.name,
        t=track.t,
        command=track.command,
        measured={c: np.where(clipped(y), np.nan, y) for c, y in measured.items()},
        maneuver=track.maneuver.name,
        note=track.ended,
    )
