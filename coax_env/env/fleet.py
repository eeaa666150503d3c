"""Many helicopters flown at once: the batch kernel behind both envs.

A fleet is a set of arrays with one row per helicopter. One control period of a row reads::

    command (actuators.py) -> air (turbulence.py) -> fly (dynamics.step) -> judge (hover.py, tasks.py)
        -> sense (dynamics.measure, sensors.py)

Rows know nothing of each other: each has its own random stream, so a row flies the same in a fleet
of any size. Nothing here runs Python code per row but drawing from a vehicle's spread (`randomize`).
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.env import hover, tasks
from coax_env.env.period import BIAS, BIAS_STD, DT, LATE, blow, command, read, rest, seen, turned
from coax_env.env.randomisation import Draws, Randomize
from coax_env.env.threads import in_threads
from coax_env.env.turbulence import N_EDDIES, settle, stir, wind_at_6m
from coax_env.errors import InputError
from coax_env.kernel.compilation import compiled
from coax_env.kernel.random_streams import stream_key, two_normals, uniform
from coax_env.model import effects
from coax_env.model import parameters as P
from coax_env.model.actuators import limit, limits
from coax_env.model.dynamics import WORK_SIZE, hover_trim, measure, step
from coax_env.model.layout import N_CHANNELS, N_FULL, N_INPUTS, TIME
from coax_env.model.sensors import Sensor, shake, slow_instruments, suite
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import SHIPPED, load_vehicle

ROTOR_RANGE = 0.15  # of the nominal hover speed
SWASH_RANGE = 0.2  # [rad]
Nominal = str | Path | Vehicle | tuple[Any, Any] | None
"""What centres the action: a vehicle, or (trim, scale) as a controller stores them."""

ROWS_PER_THREAD = 256  # fewer are not worth a thread

LANES_FROM = 8
"""Fewer helicopters fly one by one: lanes take seconds to compile."""

_DELAY = effects.parameter_index("servo_delay.time")
_VIBRATION = effects.parameter_index("vibration.amplitude")
_WIND_NORTH = effects.parameter_index("wind.north")


@compiled()
def _advance(x, u, p, swash, at, work):
    """Fly one control period in place; `swash` (n, 2) is a ring of past swash commands.

    A pure delay of the servos is a look-up of the command that was given that long ago; where it is
    no whole number of periods, the period is split. Leaves in `u` the command in force at the end.
    """
    delay = p[_DELAY]
    slots = len(swash)
    if delay <= 0.0 or slots == 1:
        step(x, u, DT, p, work, x)
        return
    late = min(int(delay / DT + 1e-9), slots - 2)
    rest = min(max(delay - late * DT, 0.0), DT)
    if rest > 1e-9:
        u[2], u[3] = swash[(at - late - 1) % slots]
        step(x, u, rest, p, work, x)
        u[TIME] += rest
    u[2], u[3] = swash[(at - late) % slots]
    if DT - rest > 1e-9:
        step(x, u, DT - rest, p, work, x)


@compiled()
def _sense(
    x, u, p, row, azimuth, sensors, bias, flags, stream, past, held, readings, values, work, out
):
    """New readings where they are due, into `held` (float64) and as an observation into `out`.

    `held`: readings, this many flags, and the way to the target where the task has one.
    `past` (slots, n_sensors): ring of what the sensors would show without delay; no slots: none has.
    """
    measure(x, u, p, work, readings)
    if p[_VIBRATION] != 0.0:
        shake(readings, azimuth, p[_VIBRATION])
    seen(x, readings, sensors, values)
    n = len(sensors)
    if len(past) > 0:
        for k in range(n):
            values[k] = _late(values[k], past, row, k, sensors[k, LATE])
    read(values, row, sensors, bias, stream, flags, held)
    for k in range(len(held)):
        out[k] = held[k]


@compiled()
def _late(value, past, row, k, late):
    """Keep a value in the ring of column `k`, and return the one of `late` rows before, between rows
    by a straight line. Before the first row all was as in it."""
    slots = len(past)
    if row == 0:
        for slot in range(slots):
            past[slot, k] = value
    past[row % slots, k] = value
    whole = int(late)
    rest = late - whole
    newer = past[(row - whole) % slots, k]
    older = past[(row - whole - 1) % slots, k]
    return newer + rest * (older - newer)


@compiled()
def _stir(x, p, stream, eddies, breeze, wind, air):
    """Turbulence for the coming period, along and across the steady wind `breeze` (2,), into `p`."""
    stir(stream, eddies, -x[15], wind, DT, air)
    speed = math.sqrt(breeze[0] * breeze[0] + breeze[1] * breeze[1])
    north = breeze[0] / speed if speed > 0.0 else 1.0
    east = breeze[1] / speed if speed > 0.0 else 0.0
    p[_WIND_NORTH] = breeze[0] + north * air[0] - east * air[1]
    p[_WIND_NORTH + 1] = breeze[1] + east * air[0] + north * air[1]
    p[P.AIR_DOWN] = air[2]


@compiled(makes_arrays=True)
def _disturb_rows(first, last, active, params, gust, turbulence, x, streams, eddies, breeze):
    """Gusts and turbulence of the coming period for the active rows first..last-1. See Fleet."""
    air = np.empty(3)
    many = len(params) > 1
    for i in range(first, last):
        if active[i]:
            p = params[i] if many else params[0]
            if gust[0] > 0.0 or gust[1] > 0.0:
                blow(x[i], p, gust, streams[i])
            if turbulence > 0.0:
                _stir(x[i], p, streams[i], eddies[i], breeze[i], turbulence, air)


@compiled(makes_arrays=True)
def _fly_rows(
    first, last, active, actions, trim, scale, params, kinds, sensors, limits, flags, weights, scales,
    x, u, rows, azimuth, streams, swash, asked, bias, past, targets, held,
    observations, rewards, terms, over,
):  # fmt: skip
    """One control period of the active rows first..last-1. See Fleet for the arrays."""
    work = np.empty(WORK_SIZE)
    readings, values = np.empty(N_CHANNELS), np.empty(sensors.shape[1])
    many = len(params) > 1
    for i in range(first, last):
        for k in range(len(weights)):
            terms[i, k] = 0.0
        if not active[i]:
            rest(held[i], observations[i])
            rewards[i] = 0.0
            over[i] = False
            continue
        p = params[i] if many else params[0]
        kind = kinds[i]
        command(actions[i], trim, scale, u[i])
        limit(u[i], asked[i], limits[kind], DT)
        slots = swash.shape[1]
        at = rows[i] % slots
        swash[i, at, 0], swash[i, at, 1] = u[i, 2], u[i, 3]
        u[i, TIME] = rows[i] * DT
        _advance(x[i], u[i], p, swash[i], at, work)
        rows[i] += 1
        azimuth[i] = turned(azimuth[i], x[i, 16])
        u[i, TIME] = rows[i] * DT
        rewards[i] = hover.reward(x[i], actions[i], targets[i], weights, scales, terms[i])
        over[i] = hover.is_over(x[i])
        _sense(
            x[i], u[i], p, rows[i], azimuth[i], sensors[kind], bias[i], flags,
            streams[i], past[i], held[i], readings, values, work, observations[i],
        )  # fmt: skip


@compiled()
def _arrive_rows(
    first, last, active, weights, course, box, dwell, x, streams, targets, progress, rewards, terms
):
    """Pay the active rows first..last-1 that have reached their targets, and give them others."""
    for i in range(first, last):
        if active[i] and tasks.arrive(x[i], targets[i], dwell, progress[i], course):
            terms[i, hover.N_TERMS] = weights[hover.N_TERMS]
            rewards[i] += weights[hover.N_TERMS]
            tasks.aim(streams[i], course, box, progress[i, tasks.REACHED], targets[i])


@compiled()
def _point_rows(first, last, which, places, height_sign, targets, held, observations):
    """The way to the target, as the readings tell it, for the rows first..last-1 of a mask."""
    aim = held.shape[1] - tasks.N_AIM
    for i in range(first, last):
        if which[i]:
            tasks.point(held[i], places, height_sign, targets[i], held[i, aim:])
            for k in range(aim, held.shape[1]):
                observations[i, k] = held[i, k]


@compiled(makes_arrays=True)
def _restart_rows(
    first, last, which, keep_state, trim, params, kinds, sensors, limits, flags,
    wind_speed, turbulence, course, box,
    x, u, rows, azimuth, streams, swash, asked, bias, past, eddies, breeze, targets, progress, held,
    observations,
):  # fmt: skip
    """New flights for the rows first..last-1 of a mask; with `keep_state` from what stands in `x`."""
    work = np.empty(WORK_SIZE)
    readings, values = np.empty(N_CHANNELS), np.empty(sensors.shape[1])
    many = len(params) > 1
    for i in range(first, last):
        if not which[i]:
            continue
        if wind_speed > 0.0:
            angle = uniform(streams[i], -math.pi, math.pi)
            params[i, _WIND_NORTH] += wind_speed * math.cos(angle)
            params[i, _WIND_NORTH + 1] += wind_speed * math.sin(angle)
        p = params[i] if many else params[0]
        table = sensors[kinds[i]]
        for k in range(len(table)):
            bias[i, k] = table[k, BIAS]
            if table[k, BIAS_STD] > 0.0:
                bias[i, k] += table[k, BIAS_STD] * two_normals(streams[i])[0]
        if not keep_state:
            hover.start(streams[i], trim, x[i])
        if turbulence > 0.0:
            breeze[i, 0], breeze[i, 1] = p[_WIND_NORTH], p[_WIND_NORTH + 1]
            settle(streams[i], eddies[i])
        progress[i, tasks.WITHIN] = progress[i, tasks.REACHED] = 0
        tasks.aim(streams[i], course, box, progress[i, tasks.REACHED], targets[i])
        for k in range(4):
            u[i, k] = asked[i, k] = trim[k]
        limit(u[i], asked[i], limits[kinds[i]], DT)
        u[i, TIME] = 0.0
        rows[i] = 0
        azimuth[i] = 0.0
        for k in range(swash.shape[1]):
            swash[i, k, 0], swash[i, k, 1] = u[i, 2], u[i, 3]
        for k in range(held.shape[1]):
            held[i, k] = 0.0
        _sense(
            x[i], u[i], p, rows[i], azimuth[i], table, bias[i], flags,
            streams[i], past[i], held[i], readings, values, work, observations[i],
        )  # fmt: skip


@dataclass
class Outcome:
    """What one control period brought, one row per helicopter."""

    observations: np.ndarray  # (n, n_obs) float32
    rewards: np.ndarray  # (n,)
    terms: np.ndarray  # (n, number of the task's reward terms), weighted
    over: np.ndarray  # (n,) bool


class Fleet:
    """Arrays of ``count`` helicopters and the calls that fly them.

    Attributes:
        x: full states, shape (count, 26). u: commands in force and time, (count, 5).
        rows: control periods flown, (count,). azimuth: of the upper rotor, (count,) rad.
        streams: key and counter, (count, 2) uint64.
        params: parameter vectors, (count or 1, n). held: readings held, (count, n_observed).
        trim, scale: command = trim + scale * action, each (4,), of the nominal vehicle.
        targets: x y z psi in force, (count, 4). progress: see tasks.WITHIN, tasks.REACHED, (count, 2).
        drawn: the numbers drawn for each row, `draws.names`, (count, n_names).
        kinds: which of `draws.vehicles` each row flies, (count,): rows of the tables of sensors,
        (m, n_sensors, 12), and of limits, (m, 3, 4).
        asked: last commands after their limits, (count, 4). swash: ring of swash commands,
        (count, slots, 2). past: ring of readings, (count, slots, n_sensors). bias: (count,
        n_sensors). eddies: of turbulence, and breeze, the steady wind, (count, 5), (count, 2).
    """

    def __init__(
        self,
        count: int,
        vehicle: str | Vehicle = "lama400d",
        nominal: Nominal = None,
        sensors: str = "onboard",
        wind: float | Sequence[float] | None = None,
        gusts: tuple[float, float] | None = None,
        randomize: Randomize = None,
        threads: int | None = None,
        turbulence: float | str | None = None,
        task: str = "hover",
        target: Any = None,
    ) -> None:
        self.vehicle = load_vehicle(vehicle)
        self.draws = Draws(self.vehicle, randomize)
        self.trim, self.scale = action_map(self.vehicle, nominal)
        self._set_task(task, target, sensors)
        suites = [suite(sensors, flown) for flown in self.draws.vehicles]
        self.sensors = suites[0]
        self.flags = slow_instruments(self.sensors)
        self.low, self.high = _bounds(suites, self.flags, len(self._places))
        self.n_observed = len(self.low)
        self._table = np.array([_sensor_table(s, self.flags) for s in suites])
        self._limits = np.array([limits(flown) for flown in self.draws.vehicles])
        self._steady, self._wind_speed = _wind(wind)
        self._turbulence = wind_at_6m(turbulence)
        self._gust = np.array(gusts if gusts is not None else (0.0, 0.0), dtype=float)
        if self._gust.shape != (2,) or not (self._gust >= 0.0).all():
            raise InputError("gusts must be (force std in N, moment std in N m), both >= 0")
        self._disturbed = self._turbulence > 0.0 or bool(self._gust.any())
        self.count = count
        self._own = self.draws.random or self._wind_speed > 0.0 or self._turbulence > 0.0
        self._vector = self._in_wind(self.vehicle.vector)
        self.params = np.tile(self._vector, (count if self._own else 1, 1))
        self._switched_on = bool(self.params[:, effects.SWITCHES].any())
        self.drawn = np.zeros((count, len(self.draws.names)))
        self.kinds = np.zeros(count, dtype=np.int64)
        self._allocate()
        most = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        self._threads = max(1, min(threads or most or 1, count // ROWS_PER_THREAD))
        # enough rows, and nothing that lanes do not have
        self._fit_for_lanes = (
            count >= LANES_FROM
            and len(self._table) == 1
            and self.swash.shape[1] == 1
            and self.past.shape[1] == 0
            and not self._turbulence
        )

    def _set_task(self, task: str, target: Any, sensors: str) -> None:
        self.task = tasks.task(task)
        self._weights = np.array(list(self.task.weights.values()))
        self._scales = np.array([1.0, *self.task.scales.values()])
        self._course, self._box = tasks.course(task, target), tasks.box(task)
        self._dwell = tasks.dwell_rows(task)
        self._places = tasks.places(task, suite(sensors))
        self._height_sign = tasks.height_sign(task, suite(sensors))

    def _allocate(self) -> None:
        """The arrays of one row per helicopter; rings and the like only where something needs them."""
        count, width = self.count, len(self.sensors)
        delay = self.draws.most("servo_delay.time")
        late = self._table[:, :, LATE].max()
        windy = count if self._turbulence > 0.0 else 1
        self.x = np.zeros((count, N_FULL))
        self.u = np.zeros((count, N_INPUTS))
        self.rows = np.zeros(count, dtype=np.int64)
        self.azimuth = np.zeros(count)
        self.streams = np.zeros((count, 2), dtype=np.uint64)
        self.targets = np.zeros((count, 4))
        self.progress = np.zeros((count, 2), dtype=np.int64)
        self.asked = np.zeros((count, 4))
        self.swash = np.zeros((count, 2 + math.ceil(delay / DT) if delay > 0.0 else 1, 2))
        self.past = np.zeros((count, 2 + math.ceil(late) if late > 0.0 else 0, width))
        self.bias = np.zeros((count, width))
        self.eddies, self.breeze = np.zeros((windy, N_EDDIES)), np.zeros((windy, 2))
        self.held = np.zeros((count, self.n_observed))

    def seed(self, row: int, seed: int) -> None:
        """Give a row the stream of a seed, from its beginning."""
        self.streams[row] = stream_key(np.uint64(seed & 0xFFFFFFFFFFFFFFFF)), 0

    def restart(
        self,
        which: np.ndarray,
        states: np.ndarray | None = None,
        observations: np.ndarray | None = None,
    ) -> np.ndarray:
        """Start new flights in the rows of a mask and return all observations, float32.

        Args:
            which: bool, shape (count,).
            states: paper or full states to start from, (count, 16 or 26); random when None.
            observations: where to put the rows' observations, (count, n_observed).
        """
        self._draw(which)
        if states is not None:
            x = np.zeros((self.count, N_FULL))
            x[:, 16:20] = self.trim
            x[:, : states.shape[-1]] = states
            self.x[which] = x[which]
        if observations is None:
            observations = self.held.astype(np.float32)
        self._start(0, self.count, which, states is not None, observations)
        return observations

    def _draw(self, which: np.ndarray) -> None:
        """Vehicles for new flights in the rows of a mask, in still air or the env's steady wind."""
        if self.draws.random:
            streams = self.streams[which]
            self.drawn[which], self.kinds[which] = self.draws.draw(streams)
            self.streams[which] = streams
            vectors = self.draws.vectors(self.drawn[which], self.kinds[which])
            self.params[which] = self._in_wind(vectors)
            self._switched_on = bool(self.params[:, effects.SWITCHES].any())
        elif self._own:
            self.params[which] = self._vector

    def _start(
        self, first: int, last: int, which: np.ndarray, keep_state: bool, observations: np.ndarray
    ) -> None:
        _restart_rows(
            first, last, which, keep_state, self.trim, self.params, self.kinds, self._table,
            self._limits, len(self.flags), self._wind_speed, self._turbulence,
            self._course, self._box,
            self.x, self.u, self.rows, self.azimuth, self.streams, self.swash, self.asked, self.bias,
            self.past, self.eddies, self.breeze, self.targets, self.progress, self.held,
            observations,
        )  # fmt: skip
        if self.task.aims:
            self._point(first, last, which, observations)

    def _point(self, first: int, last: int, which: np.ndarray, observations: np.ndarray) -> None:
        _point_rows(
            first, last, which, self._places, self._height_sign, self.targets, self.held,
            observations,
        )  # fmt: skip

    def fly(
        self, actions: np.ndarray, active: np.ndarray, anew: np.ndarray | None = None
    ) -> Outcome:
        """One control period; `x` is a new array then, and the one before stays as it was.

        Args:
            actions: (count, 4) float64; whether they are clipped in place is left open.
            active: which rows fly, (count,). anew: which of the others start a new flight, (count,).
        """
        n = self.count
        outcome = Outcome(
            np.empty((n, self.n_observed), dtype=np.float32),
            np.empty(n),
            np.empty((n, len(self._weights))),
            np.empty(n, dtype=np.bool_),
        )
        if anew is not None:
            self._draw(anew)
        side_by_side = self._fit_for_lanes and not self._switched_on
        before = self.x
        self.x = np.empty_like(before) if side_by_side else before.copy()

        def rows(first: int, last: int) -> None:
            if side_by_side:
                self._fly_lanes(first, last, actions, active, before, outcome)
            else:
                self._fly_one_by_one(first, last, actions, active, outcome)
            if self._dwell:
                _arrive_rows(
                    first, last, active, self._weights, self._course, self._box, self._dwell,
                    self.x, self.streams, self.targets, self.progress, outcome.rewards,
                    outcome.terms,
                )  # fmt: skip
            if self.task.aims:
                self._point(first, last, active, outcome.observations)
            if anew is not None:
                self._start(first, last, anew, False, outcome.observations)

        in_threads(rows, n, self._threads)
        return outcome

    def _fly_one_by_one(
        self, first: int, last: int, actions: np.ndarray, active: np.ndarray, outcome: Outcome
    ) -> None:
        if self._disturbed:
            _disturb_rows(
                first, last, active, self.params, self._gust, self._turbulence,
                self.x, self.streams, self.eddies, self.breeze,
            )  # fmt: skip
        _fly_rows(
            first, last, active, actions, self.trim, self.scale, self.params, self.kinds,
            self._table, self._limits, len(self.flags), self._weights, self._scales,
            self.x, self.u, self.rows, self.azimuth, self.streams, self.swash, self.asked,
            self.bias, self.past, self.targets, self.held,
            outcome.observations, outcome.rewards, outcome.terms, outcome.over,
        )  # fmt: skip

    def _fly_lanes(
        self, first: int, last: int, actions: np.ndarray, active: np.ndarray, before: np.ndarray,
        outcome: Outcome,
    ) -> None:  # fmt: skip
        from coax_env.env import fleet_simd as fleet_lanes

        fly = fleet_lanes.fly_own if len(self.params) > 1 else fleet_lanes.fly_shared
        fly(
            first, last, active, actions, self.trim, self.scale, self.params,
            self._table[0], self._limits[0], self._gust, len(self.flags),
            self._weights, self._scales,
            before, self.u, self.rows, self.azimuth, self.streams, self.asked, self.bias,
            self.targets, self.held, self.x,
            outcome.observations, outcome.rewards, outcome.terms, outcome.over,
        )  # fmt: skip

    @property
    def air(self) -> np.ndarray:
        """Velocity of the air north, east and down [m/s], (count, 3); a vehicle without drag or
        blow-back does not feel it."""
        columns = self.params[:, [_WIND_NORTH, _WIND_NORTH + 1, P.AIR_DOWN]]
        return np.broadcast_to(columns, (self.count, 3))

    def _in_wind(self, vectors: np.ndarray) -> np.ndarray:
        """Parameter vectors (..., n) with the env's steady wind added, and its stage switched on."""
        vectors = vectors.copy()
        vectors[..., _WIND_NORTH : _WIND_NORTH + 2] += self._steady
        effects.set_switches(vectors)
        if self._wind_speed > 0.0 or self._turbulence > 0.0:
            vectors[..., effects.AIR] = 1.0
        return vectors


def nominal_for(vehicle: Vehicle) -> Vehicle:
    """The shipped bare vehicle of the same name, else the vehicle without its effects."""
    shipped = SHIPPED / f"{vehicle.name}.toml"
    return (load_vehicle(shipped) if shipped.exists() else vehicle).without_effects()


def action_map(vehicle: Vehicle, nominal: Nominal = None) -> tuple[np.ndarray, np.ndarray]:
    """Trim and scale, each (4,): command = trim + scale * action, about the nominal hover."""
    if isinstance(nominal, tuple):
        trim, scale = (np.array(part, dtype=float) for part in nominal)
        if trim.shape != (4,) or scale.shape != (4,):
            raise InputError("nominal as numbers must be (trim, scale) with four numbers each")
        return trim, scale
    source = nominal_for(vehicle) if nominal is None else load_vehicle(nominal)
    trim = hover_trim(source, hover.HEIGHT)[1]
    return trim, np.array([ROTOR_RANGE * trim[0], ROTOR_RANGE * trim[1], SWASH_RANGE, SWASH_RANGE])


def _sensor_table(sensors: Sequence[Sensor], flags: Sequence[str]) -> np.ndarray:
    instruments = [s.instrument for s in sensors]
    return np.array(
        [
            [
                s.index, s.noise, s.rate, s.low, s.high, float(s.wraps),
                len(sensors) + flags.index(s.instrument) if s.instrument in flags else -1,
                s.delay / DT, s.dropout, instruments.index(s.instrument), s.bias, s.bias_std,
            ]
            for s in sensors
        ],
        dtype=float,
    )  # fmt: skip


def _bounds(
    suites: Sequence[Sequence[Sensor]], flags: Sequence[str], aim: int
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the observation, (n_observed,) each, that hold for every suite flown."""
    far = [bound for *_, bound in tasks.AIM[:aim]]
    low = np.min([[s.low for s in sensors] for sensors in suites], axis=0)
    high = np.max([[s.high for s in sensors] for sensors in suites], axis=0)
    return (
        np.concatenate([low, np.zeros(len(flags)), np.negative(far)]),
        np.concatenate([high, np.ones(len(flags)), far]),
    )


def _wind(wind: float | Sequence[float] | None) -> tuple[np.ndarray, float]:
    """Steady wind (north, east) [m/s], and the speed of one of random direction."""
    try:
        values = np.atleast_1d(np.asarray(0.0 if wind is None else wind, dtype=float))
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if values.shape not in ((1,), (2,)) or not np.isfinite(values).all():
        raise InputError(f"wind must be None, a speed, or (north, east) in m/s, found {wind!r}")
    if values.shape == (2,):
        return values, 0.0
    if values[0] < 0.0:
        raise InputError(f"wind as a speed must not be negative, found {wind!r}")
    return np.zeros(2), float(values[0])
