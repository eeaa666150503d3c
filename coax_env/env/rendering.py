"""Pictures of a flight: the machine from beside, the flight from above, both rotor discs, numbers.

Drawn with pygame, which is imported when the first picture is made and needs no screen for
``"rgb_array"``. Everything is drawn from a `View` (scene.py).
"""

import math
import os
import warnings
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from coax_env.env.period import DT
from coax_env.env.scene import (
    LOWER,
    PICTURE,
    STAGE,
    UPPER,
    Camera,
    View,
    body_to_world,
    discs,
    ellipse,
    flybar,
)
from coax_env.errors import InputError, require
from coax_env.kernel.angles import wrap_angle
from coax_env.model import parameters as P
from coax_env.model import state as S
from coax_env.model.layout import ATTITUDE, PLACE, POSITION, RPM_PER_RAD_S, VELOCITY

WIDTH, HEIGHT = PICTURE
HUMAN_EVERY = 4  # control periods per picture on a screen: 25 a second
_SMOOTH = 2  # drawn so much larger, then scaled down
_MAP, _DISCS = (640, 20, 300, 250), (640, 280, 300, 110)  # x, y, width, height [px]
_FADE = 20  # points of the trace of one colour
_EXAGGERATED = 3.0  # tilt of the discs in their own picture

_SKY_TOP, _SKY_LOW = (196, 216, 234), (236, 242, 247)
_GROUND, _GRID, _SHADOW = (222, 226, 216), (196, 202, 190), (150, 156, 146)
_PAPER, _INK, _FAINT = (250, 250, 248), (40, 46, 54), (140, 146, 154)
_BODY, _BODY_EDGE, _TAIL = (70, 84, 102), (40, 50, 64), (92, 106, 124)
_BAR = (120, 50, 20)
_TRACE, _TARGET, _WIND = (90, 60, 150), (20, 140, 80), (0, 130, 160)


class Renderer:
    """Draws views; opens a window where they are to be shown."""

    def __init__(self) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pygame's own, about its packaging
            self._pygame: Any = require("pygame", "render")
        self._pygame.font.init()
        self._fonts = {
            size: self._pygame.font.Font(None, size * _SMOOTH) for size in (15, 18, 21, 26)
        }
        size = (WIDTH * _SMOOTH, HEIGHT * _SMOOTH)
        self._sheet = self._pygame.Surface(size, depth=32)
        self._glass = self._pygame.Surface(size, self._pygame.SRCALPHA, 32)
        self._window: Any = None
        self._clock: Any = None

    def picture(self, view: View) -> np.ndarray:
        """One picture, uint8 of shape (HEIGHT, WIDTH, 3)."""
        pixels = self._pygame.image.tobytes(self._draw(view), "RGB")
        return np.frombuffer(pixels, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3).copy()

    def show(self, view: View) -> None:
        """Put a picture on the screen, at the speed at which it was flown.

        Raises:
            InputError: there is no screen.
        """
        pygame = self._pygame
        if self._window is None:
            try:
                pygame.display.init()
                self._window = pygame.display.set_mode((WIDTH, HEIGHT))
            except pygame.error as error:
                raise InputError(
                    f"render_mode 'human' needs a screen ({error}); 'rgb_array' needs none"
                ) from error
            pygame.display.set_caption("CoaxHeli-v0")
            self._clock = pygame.time.Clock()
        self._window.blit(self._draw(view), (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(1.0 / (HUMAN_EVERY * DT))

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._pygame.display.quit()
            self._window = None

    # --- the parts of a picture ---------------------------------------------------------------------

    def _draw(self, view: View) -> Any:
        self._sheet.fill(_PAPER)
        self._glass.fill((0, 0, 0, 0))
        camera = Camera(view)
        self._scenery(camera)
        self._paths(camera, view)
        self._helicopter(camera, view)
        self._sheet.blit(self._glass, (0, 0))
        edge = (STAGE, 0, WIDTH - STAGE, HEIGHT)
        self._pygame.draw.rect(self._sheet, _PAPER, [v * _SMOOTH for v in edge])
        self._wind(camera, view)
        self._scale_bar(camera)
        self._map(view)
        self._discs(view)
        self._numbers(view)
        return self._pygame.transform.smoothscale(self._sheet, (WIDTH, HEIGHT))

    def _scenery(self, camera: "Camera") -> None:
        horizon = camera.horizon()
        for k in range(12):
            share = k / 11.0
            colour = [a + share * (b - a) for a, b in zip(_SKY_TOP, _SKY_LOW, strict=True)]
            top = horizon * k / 12.0
            self._box(colour, 0, top, STAGE, horizon / 12.0 + 1.0)
        self._box(_GROUND, 0, horizon, STAGE, HEIGHT - horizon)
        north, east = np.round(camera.place[:2])
        for k in range(-12, 13):
            across = [(north + k, east - 12.0, 0.0), (north + k, east + 12.0, 0.0)]
            along = [(north - 12.0, east + k, 0.0), (north + 12.0, east + k, 0.0)]
            for ends in (across, along):
                self._line(_GRID, camera.seen_line(*ends), 1)

    def _paths(self, camera: "Camera", view: View) -> None:
        x, y, z = view.state[POSITION]
        self._blob(_SHADOW, camera, (x, y, 0.0), 0.22)
        self._line(_SHADOW, camera.seen_line((x, y, 0.0), (x, y, z)), 1)
        in_front = camera.depth(view.trace) > camera.near
        trace = camera.seen(view.trace[in_front])
        for first in range(0, len(trace), _FADE):
            fade = 0.25 + 0.75 * first / len(trace)
            colour = [255 - fade * (255 - c) for c in _TRACE]
            self._polyline(colour, trace[first : first + _FADE + 1], 2)
        if view.target is None:
            return
        tx, ty, tz, psi = view.target
        self._line(_TARGET, camera.seen_line((tx, ty, 0.0), (tx, ty, tz)), 1)
        self._blob(_TARGET, camera, (tx, ty, 0.0), 0.06)
        ring = [
            (tx + 0.12 * math.cos(a), ty + 0.12 * math.sin(a), tz)
            for a in np.linspace(0.0, 2.0 * math.pi, 25)
        ]
        for a, b in pairwise(ring):
            self._line(_TARGET, camera.seen_line(a, b), 2)
        nose = (tx + 0.3 * math.cos(psi), ty + 0.3 * math.sin(psi), tz)
        self._line(_TARGET, camera.seen_line((tx, ty, tz), nose), 3)

    def _helicopter(self, camera: "Camera", view: View) -> None:
        p, x = view.params, view.state
        turn, centre = body_to_world(x[ATTITUDE]), x[POSITION]

        def place(points: Any) -> list[tuple[float, float]]:
            return camera.seen(centre + np.atleast_2d(points) @ turn.T)

        radius, up, low = p[P.ROTOR_RADIUS], -p[P.ARM_U], -p[P.ARM_L]
        size = 0.55 * radius
        skid = np.array([[-0.5, 0.0, 0.0], [0.45, 0.0, 0.0]]) * size
        for side in (-0.28, 0.28):
            rail = skid + np.array([0.0, side * size, 0.42 * size])
            self._polyline(_BODY_EDGE, place(rail), 3)
            for end in rail * (0.6, 0.8, 0.2):
                self._polyline(_BODY_EDGE, place([rail.mean(axis=0) * (0, 1, 1) + (end[0], 0, 0),
                                                  (end[0], end[1], 0.1 * size)]), 2)  # fmt: skip
        self._polyline(_TAIL, place([(-0.4 * size, 0, 0), (-2.0 * size, 0, -0.05 * size)]), 5)
        fin = [(-1.75, 0, -0.05), (-2.1, 0, -0.5), (-2.2, 0, -0.5), (-2.05, 0, 0.1)]
        self._fill(_TAIL, place(np.array(fin) * size))
        body = ellipse((0.75 * size, 0.0, 0.0), (0.0, 0.0, 0.42 * size), 28)
        self._fill(_BODY, place(body))
        self._fill(_BODY, place(ellipse((0.75 * size, 0, 0), (0, 0.34 * size, 0), 28)))
        self._polyline(_BODY_EDGE, place(body), 2)
        glass = ellipse((0.28 * size, 0.0, 0.06 * size), (0.0, 0.0, 0.24 * size), 20)
        self._fill((176, 204, 224), place(glass + (0.4 * size, 0.0, -0.08 * size)))
        self._polyline(_INK, place([(0, 0, -0.3 * size), (0, 0, up - 0.12 * radius)]), 3)
        for disc in discs(view):
            hub = np.array([0.0, 0.0, low if disc.lower else up])
            rim = hub + radius * disc.rim()
            self._fill((*disc.colour, 70), place(rim), self._glass)
            self._polyline((*disc.colour, 230), place(rim), 2, self._glass)
            blades = hub + radius * disc.blades(view.azimuth)
            self._polyline((*disc.colour, 255), place(blades), 4, self._glass)
        bar = np.array([0.0, 0.0, up - 0.12 * radius]) + 0.6 * radius * flybar(view)
        self._polyline((*_BAR, 255), place(bar), 3, self._glass)
        for end in place(bar):
            self._dot(_BAR, end, 4.0, self._glass)

    def _wind(self, camera: "Camera", view: View) -> None:
        north, east = view.air[:2]
        speed = math.hypot(north, east)
        if speed < 0.05:
            self._write(f"air still ({speed:.1f} m/s)", 16, 14, 18, _FAINT)
            return
        length = min(0.25 + 0.12 * speed, 0.9)
        along = np.array([north, east, 0.0]) / speed * length
        tail = camera.place + (0.0, 0.0, -0.62) - 0.5 * along
        head = tail + along
        self._arrow(_WIND, camera.seen_line(tail, head), 3)
        where = camera.seen([tail])[0]
        self._write(f"wind {speed:.1f} m/s", where[0] + 8, where[1] - 26, 18, _WIND)

    def _scale_bar(self, camera: "Camera") -> None:
        length = 0.5 * camera.pixels_per_metre()
        self._box(_INK, 20, HEIGHT - 26, length, 3)
        self._write("0.5 m at the machine; grid 1 m", 20, HEIGHT - 20, 15, _INK)

    def _map(self, view: View) -> None:
        left, top, width, height = _MAP
        points = view.trace[:, :2]
        if view.target is not None:
            points = np.vstack([points, view.target[:2]])
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        room = max(float((points.max(axis=0) - points.min(axis=0)).max()) * 1.25, 2.0)
        scale = (height - 40) / room

        def spot(north: float, east: float) -> tuple[float, float]:
            return (
                left + width / 2.0 + (east - middle[1]) * scale,
                top + height / 2.0 - (north - middle[0]) * scale,
            )

        self._box((242, 244, 240), left, top, width, height)
        step = 1.0 if room < 7.0 else 5.0
        for k in range(*_whole(middle[0], 0.5 * height / scale, step)):
            _, y = spot(k * step, 0.0)
            self._line(_GRID, [(left, y), (left + width, y)], 1)
        for k in range(*_whole(middle[1], 0.5 * width / scale, step)):
            x, _ = spot(0.0, k * step)
            self._line(_GRID, [(x, top), (x, top + height)], 1)
        self._polyline(_TRACE, [spot(*point) for point in view.trace[:, :2]], 2)
        if view.target is not None:
            self._heading_mark(_TARGET, spot(*view.target[:2]), view.target[3], 9.0)
        self._heading_mark(_BODY, spot(*view.state[PLACE]), view.state[S.PSI], 12.0)
        north, east = view.air[:2]
        speed = math.hypot(north, east)
        if speed >= 0.05:
            reach = min(14.0 + 6.0 * speed, 46.0) / speed
            start = (left + width - 50.0, top + height - 40.0)
            self._arrow(_WIND, [start, (start[0] + reach * east, start[1] - reach * north)], 2)
        self._write("from above, north up", left + 8, top + 6, 15, _FAINT)
        self._box(_INK, left + 8, top + height - 12, step * scale, 3)
        self._write(f"{step:g} m", left + 10, top + height - 28, 15, _INK)

    def _discs(self, view: View) -> None:
        left, top, width, height = _DISCS
        self._box((242, 244, 240), left, top, width, height)
        self._write(f"discs on the body, tilt x {_EXAGGERATED:g}", left + 8, top + 6, 15, _FAINT)
        for column, name in enumerate(("from the right", "from behind")):
            middle = left + width * (0.25 + 0.5 * column)
            self._line(_FAINT, [(middle, top + 34), (middle, top + height - 22)], 1)
            for disc in discs(view):
                level = top + (72 if disc.lower else 46)
                tilt = disc.lon if column == 0 else disc.lat
                rise = 56.0 * math.sin(np.clip(_EXAGGERATED * tilt, -1.2, 1.2))
                run = math.sqrt(56.0**2 - rise * rise)
                # seen from the right the nose is right; tilted back, the front is up
                right = -rise
                if column == 1:
                    right = rise
                ends = [(middle - run, level - right), (middle + run, level + right)]
                self._line(disc.colour, ends, 4)
            self._write(name, middle - 42, top + height - 18, 15, _FAINT)

    def _numbers(self, view: View) -> None:
        x = view.state
        speed = float(np.linalg.norm(x[VELOCITY]))
        lines = [
            ("t", f"{view.seconds:.2f} s", "height", f"{-x[S.Z]:.2f} m"),
            ("speed", f"{speed:.2f} m/s", "heading", f"{round(math.degrees(wrap_angle(x[S.PSI])))}°"),
            (
                "roll", f"{math.degrees(x[S.PHI]):+.1f}°",
                "pitch", f"{math.degrees(x[S.THETA]):+.1f}°",
            ),
            (
                "upper", f"{x[S.OMEGA_U] * RPM_PER_RAD_S:.0f} rpm",
                "lower", f"{x[S.OMEGA_L] * RPM_PER_RAD_S:.0f} rpm",
            ),
        ]  # fmt: skip
        for k, (first, one, second, two) in enumerate(lines):
            y = 404 + 27 * k
            colours = {"upper": UPPER, "lower": LOWER}
            self._write(first, 644, y + 4, 18, colours.get(first, _FAINT))
            self._write(one, 694, y, 26, _INK)
            self._write(second, 792, y + 4, 18, colours.get(second, _FAINT))
            self._write(two, 848, y, 26, _INK)
        words = f"task: {view.task}"
        if view.target is not None:
            gap = x[POSITION] - view.target[:3]
            words += f"   to the target {float(np.linalg.norm(gap)):.2f} m"
        self._write(words, 644, 516, 18, _TARGET)

    # --- strokes, in picture pixels -----------------------------------------------------------------

    def _box(self, colour: Any, x: float, y: float, width: float, height: float) -> None:
        corners = [v * _SMOOTH for v in (x, y, width, height)]
        self._pygame.draw.rect(self._sheet, colour, corners)

    def _line(self, colour: Any, ends: Sequence[tuple[float, float]], width: int) -> None:
        if len(ends) == 2:
            self._polyline(colour, ends, width)

    def _polyline(
        self, colour: Any, points: Sequence[tuple[float, float]], width: int, sheet: Any = None
    ) -> None:
        if len(points) >= 2:
            large = [(x * _SMOOTH, y * _SMOOTH) for x, y in points]
            self._pygame.draw.lines(sheet or self._sheet, colour, False, large, width * _SMOOTH)

    def _fill(self, colour: Any, points: Sequence[tuple[float, float]], sheet: Any = None) -> None:
        if len(points) >= 3:
            large = [(x * _SMOOTH, y * _SMOOTH) for x, y in points]
            self._pygame.draw.polygon(sheet or self._sheet, colour, large)

    def _dot(self, colour: Any, spot: tuple[float, float], size: float, sheet: Any = None) -> None:
        large = (spot[0] * _SMOOTH, spot[1] * _SMOOTH)
        self._pygame.draw.circle(sheet or self._sheet, colour, large, size * _SMOOTH)

    def _blob(self, colour: Any, camera: "Camera", centre: Any, radius: float) -> None:
        flat = np.array(centre) + radius * np.column_stack(
            [ellipse((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), 24)[:, :2], np.zeros(24)]
        )
        self._fill(colour, camera.seen(flat))

    def _arrow(self, colour: Any, ends: Sequence[tuple[float, float]], width: int) -> None:
        if len(ends) != 2:
            return
        (x0, y0), (x1, y1) = ends
        self._line(colour, ends, width)
        angle = math.atan2(y1 - y0, x1 - x0)
        back = [
            (x1 - 13.0 * math.cos(angle + s), y1 - 13.0 * math.sin(angle + s)) for s in (0.4, -0.4)
        ]
        self._fill(colour, [(x1, y1), *back])

    def _heading_mark(
        self, colour: Any, spot: tuple[float, float], heading: float, size: float
    ) -> None:
        x, y = spot
        along = (math.sin(heading), -math.cos(heading))
        across = (-along[1], along[0])
        corners = [(1.3, 0.0), (-0.8, 0.7), (-0.4, 0.0), (-0.8, -0.7)]
        self._fill(
            colour,
            [
                (
                    x + size * (f * along[0] + s * across[0]),
                    y + size * (f * along[1] + s * across[1]),
                )
                for f, s in corners
            ],
        )

    def _write(self, text: str, x: float, y: float, size: int, colour: Any) -> None:
        ink = self._fonts[size].render(text, True, colour)
        self._sheet.blit(ink, (x * _SMOOTH, y * _SMOOTH))


def _whole(middle: float, half: float, step: float) -> tuple[int, int]:
    """Range of the multiples of `step` within `half` of the middle."""
    return math.ceil((middle - half) / step), math.floor((middle + half) / step) + 1
