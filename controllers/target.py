"""Flying to a target with a controller that only hovers: the flight seen from the target.

In the tasks ``position`` and ``waypoints`` the observation ends with the vector to the target
(coax_env/env/tasks.py). Moved and rotated so that the target lies at the start's position, height
and heading, it is an observation of ``hover``, and a hover controller flies it. A distant target is
approached through setpoints on the way, no farther than REACH: a larger error would only saturate
a linear controller. What the wind blows back from where it has been returns through nearer ones, and
so does a flight begin that is busy with the wind.
"""

import math

import numpy as np

from coax_env.env import hover, tasks
from coax_env.env.hover import DOWN, HEADING, HORIZONTAL
from coax_env.env.period import DT
from coax_env.env.tasks import FORWARD, RIGHT, TURN, UP
from coax_env.model.sensors import slow_instruments, suite

REACH = {"place": 0.5, "height": 0.4, "heading": math.radians(10.0)}
"""Farthest setpoint at once [m, m, rad]."""
RETURN = 0.1
"""[m] the farthest place of a machine that was blown back: a brisk return is fast for long."""
BLOWN_BACK = (0.1, 0.4)
"""[m] farther from the target than it has been: the setpoint comes nearer from the first on, and is
RETURN's from the second."""
CALM = (0.7, 1.0)
"""[s] from the start: up to the first a machine whose swash plate is busy keeps its heading and goes no
farther than CALM_PLACE at once, from the second on REACH holds. A level machine must first lean into
the wind. In the model the stabiliser bar turns with a machine that yaws: what it remembers of the tilt
then points elsewhere."""
CALM_PLACE = 0.1  # [m]
BUSY = (0.5, 0.9)
"""Of the swash plate's range: smoothed use from which the plate is beginning to be busy, and is."""
BUSY_MEMORY = 0.1  # [s] of that use
NEW_TARGET = 0.3  # [m] a change of the distance in a control period that no flight makes
AXES = range(3)
PLACE_AXIS, HEIGHT_AXIS, HEADING_AXIS = AXES
"""Of a setpoint, which can be the target's in one and still on the way in another."""


class TargetView:
    """The observations of a sensor suite, seen from the target where they have one."""

    def __init__(self, sensors: str) -> None:
        own = suite(sensors)
        self.names = [sensor.name for sensor in own]
        self.width = len(own) + len(slow_instruments(own))
        aims = {"psi", "pn", "pe", "h"} <= set(self.names) or {"psi", "x", "y"} <= set(self.names)
        self.places = tasks.places("position", own) if aims else None
        self.up = -tasks.height_sign("position", own) if aims else 1.0
        self._speed = [self.names.index(n) for n in ("vn", "ve") if n in self.names]

    def has_target(self, observations: np.ndarray) -> bool:
        """Whether observations (count, n) have a target in them."""
        return observations.shape[1] >= self.width + tasks.N_WAY

    def motion(self, observations: np.ndarray) -> np.ndarray | None:
        """How the target moves, MOTION (count, 7), in the measured heading's axes; None: it rests."""
        end = self.width + tasks.N_WAY
        return observations[:, end:].astype(float) if observations.shape[1] > end else None

    def as_hover(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Observations (count, n), with or without a target, as those of a hover.

        Returns:
            observations (count, width), float; whether the setpoint is the target itself, or there is
            no target but to hover, (count,) bool.
        """
        if self.has_target(observations):
            seen, _, there = self.relative_to_target(observations)
            self._subtract_motion(seen, observations)
            return seen, np.asarray(there.all(axis=1))
        return observations.astype(float), np.ones(len(observations), dtype=bool)

    @property
    def aims(self) -> bool:
        """Whether the suite shows what a target is seen by: position and heading."""
        return self.places is not None

    def beyond(self, observations: np.ndarray) -> np.ndarray:
        """The way from the setpoint on to the target, WAY (count, 4); zero without a target."""
        if not self.has_target(observations):
            return np.zeros((len(observations), tasks.N_WAY))
        way = self.way(observations)
        return way - _within_reach(way)

    def way(self, observations: np.ndarray) -> np.ndarray:
        """The whole way to the target, WAY (count, 4), of observations that have one."""
        return np.array(observations[:, self.width : self.width + tasks.N_WAY], dtype=float)

    def _subtract_motion(self, seen: np.ndarray, observations: np.ndarray) -> None:
        """The target's velocity taken from the readings of velocity, in place."""
        motion = self.motion(observations)
        if motion is None:
            return
        level = motion[:, :2]
        if self._speed:  # north and east, turned to the target's heading by now
            level = turned(level, seen[:, self.names.index("psi")])
        for k, names in enumerate((("vn", "u"), ("ve", "v"), ("vd", "w"))):
            for name in set(names) & set(self.names):
                seen[:, self.names.index(name)] -= -motion[:, 2] if k == 2 else level[:, k]

    def relative_to_target(
        self, observations: np.ndarray, farthest: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Observations (count, width + 4) as those of a hover at the target, or on the way to it.

        Args:
            observations: with a target in them.
            farthest: how far the setpoint's place and heading may be away [m, rad], (count, 2);
                None: REACH's.

        Returns:
            observations (count, width); the setpoint, x y z psi (count, 4); whether it is
            the target itself in AXES, (count, 3) bool.
        """
        assert self.places is not None
        seen = np.array(observations[:, : self.width], dtype=float)
        whole = self.way(observations)
        way = _within_reach(whole, farthest)
        x, y, z, psi = self.places
        heading = seen[:, psi].copy()
        setpoint = np.empty((len(seen), 4))
        setpoint[:, HORIZONTAL] = seen[:, [x, y]] + turned(way[:, HORIZONTAL], heading)
        setpoint[:, DOWN] = -self.up * seen[:, z] - way[:, UP]
        setpoint[:, HEADING] = heading + way[:, TURN]
        seen[:, psi] = -way[:, TURN]
        seen[:, [x, y]] = -turned(way[:, HORIZONTAL], seen[:, psi])
        seen[:, z] = self.up * (hover.HEIGHT - way[:, UP])
        if self._speed:
            seen[:, self._speed] = turned(seen[:, self._speed], -setpoint[:, HEADING])
        same = way == whole
        there = np.column_stack([same[:, HORIZONTAL].all(axis=1), same[:, UP], same[:, TURN]])
        return seen, setpoint, there


class Approach:
    """How near each of many helicopters has come to its target, which tells who was blown back; and how
    far its setpoint may then be away."""

    def __init__(self, count: int) -> None:
        self._nearest, self._last = np.full(count, np.nan), np.full(count, np.nan)
        self._plate = np.ones(count)

    def reset(self, which: np.ndarray) -> None:
        """The rows of a mask (count,) begin new flights."""
        self._last[which], self._plate[which] = np.nan, 1.0

    def acted(self, actions: np.ndarray) -> None:
        """Take in the actions (count, 4) of a control period."""
        use = np.abs(actions[:, 2:]).max(axis=1)
        self._plate += DT / BUSY_MEMORY * (use - self._plate)

    def reach(self, way: np.ndarray, which: np.ndarray, flown: np.ndarray) -> np.ndarray:
        """How far the setpoint's place and heading may be away [m, rad], (count, 2): REACH's; down to
        RETURN where blown back, and to CALM_PLACE and nothing at a busy start.

        Args:
            way: to the target, (count, 4). which: rows whose way is new, (count,) bool.
            flown: time since each flight's start [s], (count,).
        """
        distance = np.hypot(way[:, FORWARD], way[:, RIGHT])
        goes_on = np.abs(distance - self._last) < NEW_TARGET
        nearest = np.where(goes_on, np.minimum(self._nearest, distance), distance)
        self._nearest[which], self._last[which] = nearest[which], distance[which]
        back = _share(distance - self._nearest, BLOWN_BACK)
        place = REACH["place"] + back * (RETURN - REACH["place"])
        calm = (1.0 - _share(flown, CALM)) * _share(self._plate, BUSY)
        place = place + calm * (np.minimum(place, CALM_PLACE) - place)
        return np.column_stack([place, (1.0 - calm) * REACH["heading"]])


def _share(values: np.ndarray, ends: tuple[float, float]) -> np.ndarray:
    """0 up to the first of two ends, 1 from the second on, linear between them."""
    return np.asarray(np.clip((values - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0))


def _within_reach(way: np.ndarray, farthest: np.ndarray | None = None) -> np.ndarray:
    """A way (count, 4), or its beginning where longer than REACH, or than `farthest` (count, 2)."""
    way = way.copy()
    distance = np.maximum(np.hypot(way[:, FORWARD], way[:, RIGHT]), 1e-9)
    place, turn = (REACH["place"], REACH["heading"]) if farthest is None else farthest.T
    way[:, HORIZONTAL] *= np.minimum(1.0, place / distance)[:, None]
    way[:, UP] = np.clip(way[:, UP], -REACH["height"], REACH["height"])
    way[:, TURN] = np.clip(way[:, TURN], -turn, turn)
    return way


def turned(vectors: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Horizontal vectors (count, 2) turned clockwise, seen from above, by angles [rad] (count,).

    By a heading: forward and right become north and east; by minus a heading, the other way round.
    """
    cosine, sine = np.cos(angle), np.sin(angle)
    forward, right = vectors[:, 0], vectors[:, 1]
    return np.column_stack([cosine * forward - sine * right, sine * forward + cosine * right])
