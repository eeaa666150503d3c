"""Many helicopters flown at once: the arrays behind both envs, and the calls that fly them.

One control period of a row reads::

    command (actions.py) -> air (turbulence.py) -> fly, sense (period.py) -> judge (hover.py, tasks.py)

Rows know nothing of each other: each has its own random stream, so a row flies the same in a fleet
of any size. The loops over the rows are compiled (flight_loop.py, fleet_simd.py); nothing runs Python
code per row but drawing from a vehicle's spread (`randomize`).
"""

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from coax_env.env import flight_loop, paths, tasks
from coax_env.env.actions import Nominal, action_map
from coax_env.env.air_check import warn_where_wind_cannot_act
from coax_env.env.arrays import Helicopters, Makeup, Mission, Outcome, World
from coax_env.env.period import DELAYS, delay_slots
from coax_env.env.randomisation import Draws, Randomize, Wind
from coax_env.env.threads import Balance, in_threads
from coax_env.env.turbulence import N_FILTERS, wind_at_6m
from coax_env.errors import InputError
from coax_env.kernel.compilation import looked_up_once
from coax_env.kernel.random_streams import stream_key
from coax_env.model import effects, sampling
from coax_env.model import parameters as P
from coax_env.model.actuators import limits
from coax_env.model.layout import N_COMMANDS, N_FULL, N_INPUTS, N_STATES
from coax_env.model.sensors import BASE_RATE, Sensor, slow_instruments, suite
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle

_WIND = [effects.parameter_index(name) for name in ("wind.north", "wind.east")]
_AIR = [*_WIND, P.AIR_DOWN]
ROWS_PER_THREAD = 256  # fewer are not worth a thread

SIMD_FROM = 8
"""Fewer helicopters fly one by one: the SIMD batch takes seconds to compile."""

SIMD_VARIANT_FROM = 128
"""The same where they have effects, air or numbers of their own: that variant is theirs alone and takes
6 to 15 s to compile, as long as 100 of them fly ten minutes each one by one."""

_fly_rows = looked_up_once(flight_loop.fly_rows)
_restart_rows = looked_up_once(flight_loop.restart_rows)
_disturb_rows = looked_up_once(flight_loop.disturb_rows)
_pay_waypoints = looked_up_once(flight_loop.pay_waypoints)
_move_targets = looked_up_once(flight_loop.move_targets)
_observe_targets = looked_up_once(flight_loop.observe_targets)


class Fleet:
    """Arrays of ``count`` helicopters and the calls that fly them.

    Attributes:
        x: full states, shape (count, 29).
        helicopters, world, mission: all other arrays by name, arrays.py; of the first also as
            attributes: rows, azimuth, streams, own, kinds, targets, progress, held.
        trim, scale: command = trim + scale * action, each (4,), of the nominal vehicle.
        drawn: the numbers drawn for each row, `draws.names`, (count, n_names).
        makeup: what the SIMD batch is compiled for.
        sensors: of the first kind of vehicle; flags: their instruments that have a "new" flag.
        low, high: bounds of the observation, (n_observed,).
    """

    def __init__(
        self,
        count: int,
        vehicle: str | Vehicle = "lama400d",
        nominal: Nominal = None,
        sensors: str = "onboard",
        wind: Wind = None,
        gusts: tuple[float, float] | None = None,
        randomize: Randomize = None,
        threads: int | None = None,
        turbulence: float | str | None = None,
        task: str = "hover",
        target: Any = None,
        control_rate: float = BASE_RATE,
    ) -> None:
        """As CoaxEnv, and:

        Args:
            count: how many helicopters.
            threads: at most so many; None: one per ROWS_PER_THREAD rows and processor.
        """
        self.count = count
        self.periods = _periods(control_rate)
        self.vehicle = load_vehicle(vehicle)
        self.draws = Draws(self.vehicle, randomize)
        self.trim, self.scale = action_map(self.vehicle, nominal)
        self.task = tasks.task(task)
        self.mission = _mission(task, target, sensors)
        suites = [suite(sensors, flown) for flown in self.draws.vehicles]
        self.sensors = suites[0]
        self.flags = slow_instruments(self.sensors)
        self.low, self.high = _bounds(suites, self.flags, self.task)
        self.n_observed = len(self.low)
        self._steady, (wind_slowest, wind_speed) = _wind(wind)
        wind_at = wind_at_6m(turbulence)
        self._changing_air = wind_speed > 0.0 or wind_at > 0.0
        if not any("." in name for name in self.draws.names):  # drawn effects may feel it
            blows = bool(self._steady.any() or wind_speed > 0.0)
            warn_where_wind_cannot_act(self.draws.vehicles, blows, wind_at > 0.0)
        params, own, used = self._parameters()
        self.world = World(
            params,
            own,
            _read_by_batch(used),
            self.trim,
            self.scale,
            np.array([sampling.sensor_table(s, self.flags) for s in suites]),
            np.array([limits(flown) for flown in self.draws.vehicles]),
            len(self.flags),
            _gusts(gusts),
            wind_speed,
            wind_slowest,
            wind_at,
        )
        self._disturbed = self.world.turbulence > 0.0 or bool(self.world.gust.any())
        self._allocate()
        self.makeup = self._what_flies(used)
        most = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        self._threads = max(1, min(threads or most or 1, count // ROWS_PER_THREAD))
        self._balance = Balance()
        fewest = SIMD_VARIANT_FROM if any(self.makeup) else SIMD_FROM
        self._side_by_side = count >= fewest and _fit_for_simd(used)

    def _parameters(self) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
        """The parameter vector, the places that each row has of its own, and what may be on in it."""
        air = _AIR if self._changing_air else []
        drawn = self.draws.places
        own = np.array([*air, *drawn[~np.isin(drawn, air)]], dtype=np.int64)
        vector = self.draws.vehicles[0].vector.copy()
        vector[_WIND] += self._steady
        effects.set_switches(vector)
        windy = self._changing_air or bool(self._steady.any())
        if windy:
            vector[effects.AIR] = 1.0
        self._own_air_switch = np.flatnonzero(own == effects.AIR) if windy else np.empty(0, int)
        self._drawn_at = np.array([np.flatnonzero(own == place)[0] for place in drawn], dtype=int)
        self._wind_on_drawn = np.where(drawn == _WIND[0], self._steady[0], 0.0)
        self._wind_on_drawn += np.where(drawn == _WIND[1], self._steady[1], 0.0)
        wind = tuple(effects.CATALOGUE["wind"].names()) if windy else ()
        return vector, own, tuple(dict.fromkeys((*self.draws.effects, *wind)))

    def _what_flies(self, used: tuple[str, ...]) -> Makeup:
        """What the SIMD batch is compiled for."""
        own, heli = self.world.own, self.helicopters
        return Makeup(
            used,
            own=len(own) > 0,
            turbulent=self.world.turbulence > 0.0,
            delayed=heli.command_ring.shape[1] > 1,
            own_delays=any(effects.parameter_index(name) in own for name in DELAYS),
            late=heli.past.shape[1] > 0,
        )

    def _allocate(self) -> None:
        """The arrays of one row per helicopter; rings and the like only where something needs them."""
        n, width = self.count, len(self.sensors)
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
            own=np.tile(self.world.params[self.world.own], (n, 1)),
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
        self.own, self.kinds = self.helicopters.own, self.helicopters.kinds
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
        which = np.ascontiguousarray(which, dtype=np.bool_)
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
        if not len(self.world.own):
            return
        own = np.tile(self.world.params[self.world.own], (int(np.count_nonzero(which)), 1))
        if self.draws.random:
            streams = self.streams[which]
            drawn, kinds = self.draws.draw(streams)
            self.streams[which], self.drawn[which], self.kinds[which] = streams, drawn, kinds
            own[:, self._drawn_at] = self.draws.numbers(drawn, kinds) + self._wind_on_drawn
            own[:, self._own_air_switch] = 1.0
        self.own[which] = own

    def _start(
        self, first: int, last: int, which: np.ndarray, keep_state: bool, observations: np.ndarray
    ) -> None:
        heli, world, mission = self.helicopters, self.world, self.mission
        _restart_rows(first, last, which, keep_state, self.x, heli, world, mission, observations)
        if self.task.shows_target:
            flight_loop.observe_targets(first, last, which, heli, mission, observations)

    @cached_property
    def _simd_loop(self) -> Any:
        """The SIMD batch's loop, imported with the first fleet that flies by it."""
        from coax_env.env import fleet_simd

        return fleet_simd.fly_of(self.makeup)

    def fly_held(
        self, actions: np.ndarray, active: np.ndarray, anew: np.ndarray | None = None
    ) -> Outcome:
        """`periods` control periods under one action: rewards are summed until a row's flight ends.

        The flag of a slow instrument is 1 where one of the periods had a new reading.

        Args:
            actions, active, anew: as in `fly`.
        """
        total = self.fly(actions, active, anew)
        if self.periods == 1:
            return total
        flags = slice(len(self.sensors), len(self.sensors) + len(self.flags))
        for _ in range(self.periods - 1):
            active = active & ~total.over
            if not active.any():
                break
            one = self.fly(actions, active)
            one.observations[:, flags] = np.where(
                active[:, None],
                np.maximum(one.observations[:, flags], total.observations[:, flags]),
                total.observations[:, flags],
            )
            total.observations[:] = one.observations
            for sums, more in ((total.rewards, one.rewards), (total.terms, one.terms)):
                sums += more
            total.over[:] |= one.over
        return total

    def fly(
        self, actions: np.ndarray, active: np.ndarray, anew: np.ndarray | None = None
    ) -> Outcome:
        """One control period; `x` is a new array then, and the one before stays as it was.

        Args:
            actions: (count, 4), numbers of any type; not changed.
            active: which rows fly, (count,). anew: which of the others start a new flight, (count,).
        """
        n = self.count
        simd = self._side_by_side
        # the loops are looked up once: from here on no type and no order in memory is checked
        commands = np.empty((n, 4)) if simd else np.array(actions, dtype=np.float64, order="C")
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
        before = self.x
        self.x = x = np.empty_like(before) if simd else before.copy()

        fly = self._simd_loop if simd else None

        def rows(first: int, last: int) -> None:
            if fly:
                commands[first:last] = actions[first:last]
                fly(first, last, active, commands, before, x, heli, world, mission, outcome)
            else:
                if self._disturbed:
                    _disturb_rows(first, last, active, x, heli, world)
                _fly_rows(first, last, active, commands, x, heli, world, mission, outcome)
            if mission.dwell:
                _pay_waypoints(first, last, active, x, heli, mission, outcome)
            if self.task.follows_path:
                _move_targets(first, last, active, heli, mission)
            if self.task.shows_target:
                _observe_targets(first, last, active, heli, mission, outcome.observations)
            if anew is not None:
                self._start(first, last, anew, False, outcome.observations)

        in_threads(rows, n, self._threads, self._balance)
        return outcome

    @property
    def target_rates(self) -> np.ndarray:
        """Rates of the targets' x y z psi [m/s, rad/s], (count, 4); zero where they rest."""
        path, again = self.mission.path, self.mission.again
        if not len(path):
            return np.zeros((self.count, 4))
        past = again + (self.rows - again) % (len(path) - again)
        return np.array(path[np.where(self.rows < len(path), self.rows, past), 4:8])

    @property
    def air(self) -> np.ndarray:
        """Velocity of the air north, east and down [m/s], (count, 3); a vehicle without drag or
        blow-back does not feel it."""
        air = np.tile(self.world.params[_AIR], (self.count, 1))
        for k, place in enumerate(_AIR):
            if place in self.world.own:
                air[:, k] = self.own[:, np.flatnonzero(self.world.own == place)[0]]
        return air

    def params_of(self, row: int) -> np.ndarray:
        """The parameter vector that a row flies with, (n_parameters,)."""
        vector = self.world.params.copy()
        vector[self.world.own] = self.own[row]
        return vector


def _periods(control_rate: float) -> int:
    """Periods of 100 Hz that an action is held for."""
    try:
        rate = float(control_rate)
        periods = round(BASE_RATE / rate) if math.isfinite(rate) and rate > 0.0 else 0
    except (TypeError, ValueError):
        periods = 0
    if periods < 1 or abs(BASE_RATE / periods - rate) > 1e-9 * rate:
        raise InputError(
            f"control_rate must be 100 Hz over a whole number, as 50 or 25, found {control_rate!r}"
        )
    return periods


def _read_by_batch(used: Sequence[str]) -> np.ndarray:
    """Places of the parameters that the SIMD batch reads: the base's, these effects', the delays."""
    own = [effects.parameter_index(name) for name in {*used, *DELAYS}]
    return np.array([*range(P.N_FIXED), *sorted(own)], dtype=np.int64)


def _fit_for_simd(used: Sequence[str]) -> bool:
    """Whether effects can fly side by side: all can, but for a user's own with an ``if`` in it."""
    names = dict.fromkeys(name.partition(".")[0] for name in used)
    users = [name for name in names if effects.GROUPS[name].users]
    if not users:
        return True
    from coax_env.env.fleet_simd import takes_registers

    for name in users:
        if not takes_registers(effects.GROUPS[name].function):
            warnings.warn(
                f"effect {name!r} does not compile for several helicopters at once: they fly one by "
                "one, several times slower; coax_env.kernel.simd.select stands for an if",
                stacklevel=4,
            )
            return False
    return True


def _mission(task: str, target: Any, sensors: str) -> Mission:
    own, seen = tasks.task(task), suite(sensors)
    rests = np.empty((0, paths.N_PATH)), 0
    path, again = paths.path(target) if own.follows_path else rests
    return Mission(
        np.array(list(own.weights.values())),
        np.array([1.0, *own.scales.values()]),
        tasks.course(task, target),
        tasks.box(task),
        tasks.dwell_rows(task),
        tasks.places(task, seen),
        tasks.height_sign(task, seen),
        path,
        again,
    )


def _bounds(
    suites: Sequence[Sequence[Sensor]], flags: Sequence[str], task: tasks.Task
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the observation, (n_observed,) each, that hold for every suite flown."""
    far = [bound for *_, bound in task.shown]
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


def _wind(wind: Wind) -> tuple[np.ndarray, tuple[float, float]]:
    """Steady wind (north, east), and lowest and highest speed of one from anywhere [m/s]."""
    drawn = isinstance(wind, Mapping)
    try:
        if isinstance(wind, Mapping):
            values = np.array(wind["speed"] if set(wind) == {"speed"} else np.nan, dtype=float)
        else:
            values = np.atleast_1d(np.asarray(0.0 if wind is None else wind, dtype=float))
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    shapes = ((2,),) if drawn else ((1,), (2,))
    if values.shape not in shapes or not np.isfinite(values).all():
        raise InputError(
            "wind must be None, a speed, (north, east) or {'speed': (low, high)} in m/s, "
            f"found {wind!r}"
        )
    if values.shape == (2,) and not drawn:
        return values, (0.0, 0.0)
    low, high = float(values[0]), float(values[-1])
    if not 0.0 <= low <= high:
        raise InputError(f"wind as a speed must not be negative, nor out of order, found {wind!r}")
    return np.zeros(2), (low, high)
