"""Many helicopters flown at once: the arrays behind both envs, and the calls that fly them.

One control period of a row reads::

    command (actions.py) -> air (turbulence.py) -> fly, sense (period.py) -> judge (hover.py, tasks.py)

Rows know nothing of each other: each has its own random stream, so a row flies the same in a fleet
of any size. The loops over the rows are compiled (flight_loop.py, fleet_simd.py); nothing runs Python
code per row but drawing from a vehicle's spread (`randomize`).
"""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from coax_env.env import flight_loop, tasks
from coax_env.env.actions import Nominal, action_map
from coax_env.env.arrays import Helicopters, Mission, Outcome, World
from coax_env.env.flight_loop import WIND_EAST, WIND_NORTH
from coax_env.env.period import DELAYS, delay_slots
from coax_env.env.randomisation import Draws, Randomize
from coax_env.env.threads import in_threads
from coax_env.env.turbulence import N_FILTERS, wind_at_6m
from coax_env.errors import InputError
from coax_env.kernel.compilation import looked_up_once
from coax_env.kernel.random_streams import stream_key
from coax_env.model import effects, sampling
from coax_env.model import parameters as P
from coax_env.model.actuators import limits
from coax_env.model.layout import N_COMMANDS, N_FULL, N_INPUTS, N_STATES
from coax_env.model.sensors import Sensor, slow_instruments, suite
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

ROWS_PER_THREAD = 256  # fewer are not worth a thread

SIMD_FROM = 8
"""Fewer helicopters fly one by one: the SIMD batch takes seconds to compile."""

_fly_rows = looked_up_once(flight_loop.fly_rows)
_disturb_rows = looked_up_once(flight_loop.disturb_rows)
_pay_waypoints = looked_up_once(flight_loop.pay_waypoints)
_observe_targets = looked_up_once(flight_loop.observe_targets)


class Fleet:
    """Arrays of ``count`` helicopters and the calls that fly them.

    Attributes:
        x: full states, shape (count, 29).
        helicopters, world, mission: all other arrays by name, arrays.py; of the first also as
            attributes: rows, azimuth, streams, params, kinds, targets, progress, held.
        trim, scale: command = trim + scale * action, each (4,), of the nominal vehicle.
        drawn: the numbers drawn for each row, `draws.names`, (count, n_names).
        sensors: of the first kind of vehicle; flags: their instruments that have a "new" flag.
        low, high: bounds of the observation, (n_observed,).
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
        """As CoaxEnv, and:

        Args:
            count: how many helicopters.
            threads: at most so many; None: one per ROWS_PER_THREAD rows and processor.
        """
        self.count = count
        self.vehicle = load_vehicle(vehicle)
        self.draws = Draws(self.vehicle, randomize)
        self.trim, self.scale = action_map(self.vehicle, nominal)
        self.task = tasks.task(task)
        self.mission = _mission(task, target, sensors)
        suites = [suite(sensors, flown) for flown in self.draws.vehicles]
        self.sensors = suites[0]
        self.flags = slow_instruments(self.sensors)
        self.low, self.high = _bounds(suites, self.flags, len(self.mission.places))
        self.n_observed = len(self.low)
        self._steady, wind_speed = _wind(wind)
        self.world = World(
            self.trim,
            self.scale,
            np.array([sampling.sensor_table(s, self.flags) for s in suites]),
            np.array([limits(flown) for flown in self.draws.vehicles]),
            len(self.flags),
            _gusts(gusts),
            wind_speed,
            wind_at_6m(turbulence),
        )
        self._disturbed = self.world.turbulence > 0.0 or bool(self.world.gust.any())
        self._changing_air = wind_speed > 0.0 or self.world.turbulence > 0.0
        self._own = self.draws.random or self._changing_air
        self._allocate()
        self._switched_on = bool(self.params[:, effects.SWITCHES].any())
        most = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        self._threads = max(1, min(threads or most or 1, count // ROWS_PER_THREAD))
        # enough rows, and nothing that the SIMD batch does not have
        self._fit_for_simd = (
            count >= SIMD_FROM
            and len(self.world.sensors) == 1
            and self.helicopters.command_ring.shape[1] == 1
            and self.helicopters.past.shape[1] == 0
            and not self.world.turbulence
        )

    def _allocate(self) -> None:
        """The arrays of one row per helicopter; rings and the like only where something needs them."""
        n, width = self.count, len(self.sensors)
        self._vector = self._in_wind(self.vehicle.vector)
        windy = n if self.world.turbulence > 0.0 else 1
        readings_kept = sampling.delay_slots(self.world.sensors[:, :, sampling.DELAY].max())
        longest = sum(self.draws.most(name) for name in DELAYS)
        self.x = np.zeros((n, N_FULL))
        self.drawn = np.zeros((n, len(self.draws.names)))
        self.helicopters = Helicopters(
            u=np.zeros((n, N_INPUTS)),
            rows=np.zeros(n, dtype=np.int64),
            azimuth=np.zeros(n),
            streams=np.zeros((n, 2), dtype=np.uint64),
            params=np.tile(self._vector, (n if self._own else 1, 1)),
            kinds=np.zeros(n, dtype=np.int64),
            last_commands=np.zeros((n, N_COMMANDS)),
            command_ring=np.zeros((n, delay_slots(longest), N_COMMANDS)),
            bias=np.zeros((n, width)),
            past=np.zeros((n, readings_kept, width)),
            filters=np.zeros((windy, N_FILTERS)),
            steady_wind=np.zeros((windy, 2)),
            targets=np.zeros((n, 4)),
            progress=np.zeros((n, 2), dtype=np.int64),
            held=np.zeros((n, self.n_observed)),
        )
        self.rows, self.azimuth, self.streams = self.helicopters[1:4]
        self.params, self.kinds = self.helicopters.params, self.helicopters.kinds
        self.targets, self.progress, self.held = self.helicopters[-3:]

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
            states: paper or full states to start from, (count, 16 or 29); random when None.
            observations: where to put the rows' observations, (count, n_observed).
        """
        self._draw(which)
        if states is not None:
            x = np.zeros((self.count, N_FULL))
            x[:, N_STATES : N_STATES + N_COMMANDS] = self.trim
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
        heli, world, mission = self.helicopters, self.world, self.mission
        flight_loop.restart_rows(
            first, last, which, keep_state, self.x, heli, world, mission, observations
        )
        if self.task.shows_target:
            flight_loop.observe_targets(first, last, which, heli, mission, observations)

    def fly(
        self, actions: np.ndarray, active: np.ndarray, anew: np.ndarray | None = None
    ) -> Outcome:
        """One control period; `x` is a new array then, and the one before stays as it was.

        Args:
            actions: (count, 4); whether they are clipped in place is left open.
            active: which rows fly, (count,). anew: which of the others start a new flight, (count,).
        """
        n = self.count
        # the loops are looked up once: from here on no type and no order in memory is checked
        actions = np.ascontiguousarray(actions, dtype=np.float64)
        active = np.ascontiguousarray(active, dtype=np.bool_)
        heli, world, mission = self.helicopters, self.world, self.mission
        outcome = Outcome(
            np.empty((n, self.n_observed), dtype=np.float32),
            np.empty(n),
            np.empty((n, len(mission.weights))),
            np.empty(n, dtype=np.bool_),
        )
        if anew is not None:
            self._draw(anew)
        simd = self._fit_for_simd and not self._switched_on
        before = self.x
        self.x = x = np.empty_like(before) if simd else before.copy()

        def rows(first: int, last: int) -> None:
            if simd:
                fly = _simd_loop(len(heli.params) > 1)
                fly(first, last, active, actions, before, x, heli, world, mission, outcome)
            else:
                if self._disturbed:
                    _disturb_rows(first, last, active, x, heli, world)
                _fly_rows(first, last, active, actions, x, heli, world, mission, outcome)
            if mission.dwell:
                _pay_waypoints(first, last, active, x, heli, mission, outcome)
            if self.task.shows_target:
                _observe_targets(first, last, active, heli, mission, outcome.observations)
            if anew is not None:
                self._start(first, last, anew, False, outcome.observations)

        in_threads(rows, n, self._threads)
        return outcome

    @property
    def air(self) -> np.ndarray:
        """Velocity of the air north, east and down [m/s], (count, 3); a vehicle without drag or
        blow-back does not feel it."""
        columns = self.params[:, [WIND_NORTH, WIND_EAST, P.AIR_DOWN]]
        return np.broadcast_to(columns, (self.count, 3))

    def _in_wind(self, vectors: np.ndarray) -> np.ndarray:
        """Parameter vectors (..., n) with the env's steady wind added, and its stage switched on."""
        vectors = vectors.copy()
        vectors[..., WIND_NORTH : WIND_EAST + 1] += self._steady
        effects.set_switches(vectors)
        if self._changing_air:
            vectors[..., effects.AIR] = 1.0
        return vectors


def _simd_loop(own: bool) -> Any:
    """The SIMD batch's loop, imported with the first fleet that flies by it."""
    from coax_env.env import fleet_simd

    return fleet_simd.fly_own if own else fleet_simd.fly_shared


def _mission(task: str, target: Any, sensors: str) -> Mission:
    own, seen = tasks.task(task), suite(sensors)
    return Mission(
        np.array(list(own.weights.values())),
        np.array([1.0, *own.scales.values()]),
        tasks.course(task, target),
        tasks.box(task),
        tasks.dwell_rows(task),
        tasks.places(task, seen),
        tasks.height_sign(task, seen),
    )


def _bounds(
    suites: Sequence[Sequence[Sensor]], flags: Sequence[str], way: int
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the observation, (n_observed,) each, that hold for every suite flown."""
    far = [bound for *_, bound in tasks.WAY[:way]]
    low = np.min([[s.low for s in sensors] for sensors in suites], axis=0)
    high = np.max([[s.high for s in sensors] for sensors in suites], axis=0)
    return (
        np.concatenate([low, np.zeros(len(flags)), np.negative(far)]),
        np.concatenate([high, np.ones(len(flags)), far]),
    )


def _gusts(gusts: tuple[float, float] | None) -> np.ndarray:
    found = np.array(gusts if gusts is not None else (0.0, 0.0), dtype=float)
    if found.shape != (2,) or not (found >= 0.0).all():
        raise InputError("gusts must be (force std in N, moment std in N m), both >= 0")
    return found


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
