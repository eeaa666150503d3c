"""What there is to see of a flight, and from where: the truth at one instant, camera, rotor discs."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from coax_env.env.fleet import Fleet
from coax_env.env.period import DT
from coax_env.env.tasks import TASKS
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.layout import POSITION

PICTURE = (960, 540)  # [px] width and height of a picture
STAGE = 620  # [px] width of the part that the camera sees; map, discs and numbers are beside it
UPPER, LOWER = (214, 96, 50), (40, 116, 178)  # colours of the rotors
_TRACE_EVERY, _TRACE_LENGTH = 5, 400  # rows, points: the last 20 s


@dataclass(frozen=True)
class View:
    """What a picture shows of one helicopter.

    ``state`` full, (29,); ``params`` the parameter vector; ``air`` its velocity north east down [m/s];
    ``target`` x y z psi, or None; ``trace`` past positions x y z, (n, 3), oldest first.
    """

    state: np.ndarray
    params: np.ndarray
    air: np.ndarray
    azimuth: float
    seconds: float
    task: str
    trace: np.ndarray
    target: np.ndarray | None = None


class Traces:
    """Where every helicopter of a fleet has been, kept while pictures are wanted."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._points = np.zeros((fleet.count, _TRACE_LENGTH, 3))
        self._kept = np.zeros(fleet.count, dtype=np.int64)

    def record(self) -> None:
        """Keep the positions, every few rows; a row's new flight forgets the last."""
        rows = self._fleet.rows
        self._kept[rows == 0] = 0
        due = np.flatnonzero(rows % _TRACE_EVERY == 0)
        self._points[due, self._kept[due] % _TRACE_LENGTH] = self._fleet.x[due, POSITION]
        self._kept[due] += 1

    def view(self, row: int) -> View:
        """What there is to see of a row now."""
        fleet, kept = self._fleet, int(self._kept[row])
        order = np.arange(max(kept - _TRACE_LENGTH, 0), kept) % _TRACE_LENGTH
        state = np.nan_to_num(fleet.x[row], posinf=0.0, neginf=0.0)
        return View(
            state=state,
            params=fleet.params_of(row),
            air=fleet.air[row],
            azimuth=float(fleet.azimuth[row]),
            seconds=float(fleet.rows[row] * DT),
            task=next(name for name, task in TASKS.items() if task is fleet.task),
            trace=np.vstack([np.nan_to_num(self._points[row, order]), state[POSITION]]),
            target=fleet.targets[row].copy(),
        )


class Camera:
    """Looks north-west at the machine from a little above, wherever it flies."""

    distance = 2.6  # [m]
    focus = 700.0  # [px]
    near = 0.2  # [m]

    def __init__(self, view: View) -> None:
        self.place = view.state[POSITION]
        away = np.array([-0.80, 0.52, -0.20])
        self.eye = self.place + self.distance * away / np.linalg.norm(away)
        self.forward = (self.place - self.eye) / self.distance
        right = np.cross([0.0, 0.0, 1.0], self.forward)
        self.right = right / np.linalg.norm(right)
        self.down = np.cross(self.forward, self.right)
        self.middle = (STAGE / 2.0, 0.5 * PICTURE[1])

    def pixels_per_metre(self) -> float:
        """At the machine."""
        return self.focus / self.distance

    def horizon(self) -> float:
        """Its height in the picture [px]."""
        flat = self.forward * (1.0, 1.0, 0.0)
        far = flat / np.linalg.norm(flat)
        y = self.middle[1] + self.focus * (far @ self.down) / (far @ self.forward)
        return float(np.clip(y, 0.0, PICTURE[1]))

    def depth(self, points: Any) -> np.ndarray:
        """How far in front of the eye world points (n, 3) are [m], shape (n,)."""
        return (np.asarray(points, dtype=float) - self.eye) @ self.forward

    def seen(self, points: Any) -> list[tuple[float, float]]:
        """World points (n, 3) as picture points; none if one lies behind the eye."""
        rays = np.asarray(points, dtype=float) - self.eye
        depth = rays @ self.forward
        if (depth < self.near).any():
            return []
        x = self.middle[0] + self.focus * (rays @ self.right) / depth
        y = self.middle[1] + self.focus * (rays @ self.down) / depth
        return list(zip(x.tolist(), y.tolist(), strict=True))

    def seen_line(self, start: Any, end: Any) -> list[tuple[float, float]]:
        """A line's two ends, cut where it passes the eye; none where all of it is behind."""
        a, b = np.array(start, dtype=float), np.array(end, dtype=float)
        depth_a, depth_b = (a - self.eye) @ self.forward, (b - self.eye) @ self.forward
        if max(depth_a, depth_b) <= self.near:
            return []
        if depth_a < self.near:
            a = a + (b - a) * (1.001 * self.near - depth_a) / (depth_b - depth_a)
        elif depth_b < self.near:
            b = b + (a - b) * (1.001 * self.near - depth_b) / (depth_a - depth_b)
        return self.seen([a, b])


@dataclass(frozen=True)
class Disc:
    """One rotor disc, tilted back by ``lon`` and to the right by ``lat`` [rad]."""

    lon: float
    lat: float
    lower: bool
    colour: tuple[int, int, int]

    def _plane(self) -> tuple[np.ndarray, np.ndarray]:
        """Two unit vectors in the disc: its thrust is along [-tan lon, tan lat, -1], (13)-(14)."""
        normal = np.array([-math.tan(self.lon), math.tan(self.lat), -1.0])
        forward = np.cross([0.0, 1.0, 0.0], normal)
        forward /= np.linalg.norm(forward)
        across = np.cross(normal, forward)
        return -forward, across / np.linalg.norm(across)

    def rim(self) -> np.ndarray:
        """Points of its edge, radius 1, body axes, (n, 3)."""
        return ellipse(*self._plane(), 40)

    def blades(self, azimuth: float) -> np.ndarray:
        """Tip to tip, (2, 3); the rotors turn against each other."""
        first, second = self._plane()
        angle = -azimuth if self.lower else azimuth
        tip = math.cos(angle) * first + math.sin(angle) * second
        return np.array([tip, -tip])


def discs(view: View) -> tuple[Disc, Disc]:
    """Lower disc as the swash plate has tilted it, upper as the fly-bar has, (30)-(31)."""
    p, x = view.params, view.state
    lower = Disc(float(x[S.ALPHA_L]), float(x[S.BETA_L]), True, LOWER)
    upper = Disc(
        float(p[P.FLYBAR_TO_ROTOR_LON] * x[S.ALPHA_F]),
        float(p[P.FLYBAR_TO_ROTOR_LAT] * x[S.BETA_F]),
        False,
        UPPER,
    )
    return lower, upper


def flybar(view: View) -> np.ndarray:
    """The stabiliser bar, tip to tip, across the upper blades, (2, 3)."""
    bar = Disc(float(view.state[S.ALPHA_F]), float(view.state[S.BETA_F]), False, UPPER)
    return bar.blades(view.azimuth + 0.5 * math.pi)


def ellipse(first: Any, second: Any, count: int) -> np.ndarray:
    """Closed curve cos(t) first + sin(t) second, (count, 3).

    Args:
        first, second: conjugate half axes, (3,) each [m]. count: of points; the last is the first.
    """
    t = np.linspace(0.0, 2.0 * math.pi, count)[:, None]
    return np.cos(t) * np.asarray(first, dtype=float) + np.sin(t) * np.asarray(second, dtype=float)


def body_to_world(attitude: np.ndarray) -> np.ndarray:
    """R_WB of roll, pitch, heading, (3, 3): v_W = R_WB v_B."""
    (cf, ct, cp), (sf, st, sp) = np.cos(attitude), np.sin(attitude)
    return np.array(
        [
            [ct * cp, sf * st * cp - cf * sp, cf * st * cp + sf * sp],
            [ct * sp, sf * st * sp + cf * cp, cf * st * sp - sf * cp],
            [-st, sf * ct, cf * ct],
        ]
    )
