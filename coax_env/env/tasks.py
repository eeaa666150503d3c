"""What a flight of the env is for: hover, hold a position, follow waypoints or a path in time.

A task is one entry of TASKS: its reward's weights and scales, where its targets are drawn, and whether
it moves on from one target to the next. All tasks start, end and are rewarded by hover.py about the
target in force; ``hover`` has its target fixed over the start. A target is (north, east, height,
heading) [m, rad] for the user, and x y z psi of the state in the kernel.

Success is SUCCESS's, about the target: see `judge`, and `succeeded` for one recorded flight.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from coax_env.env import hover, paths
from coax_env.env.hover import DOWN, EAST, HEADING, HORIZONTAL, NORTH
from coax_env.errors import InputError
from coax_env.kernel.angles import wrap_angle
from coax_env.kernel.compilation import compiled
from coax_env.kernel.random_streams import uniform
from coax_env.model import state as S
from coax_env.model.layout import PLACE
from coax_env.model.sensors import Sensor

_DEGREE = math.pi / 180.0

RADIUS = 0.3  # [m] from a waypoint, of the whole distance,
HEADING_TOLERANCE = 15.0 * _DEGREE  # and from its heading:
DWELL = 0.5  # [s] so long within both, and the waypoint is reached

SETTLED = 3.0  # [s] from here on success is judged:
FIRST_JUDGED = round(SETTLED / hover.CONTROL_PERIOD)
"""The state after so many control periods is the first that counts."""
SUCCESS = {
    "height": hover.LIMITS["height"],
    "speed": hover.LIMITS["speed"],
    "heading": hover.LIMITS["heading"],
    "drift": hover.LIMITS["position"],
}
"""Ours: rms of the errors of height [m], speed [m/s] and heading [rad]; farthest drift [m]."""


@dataclass(frozen=True)
class Task:
    """One task. Weights and scales have the same keys, but for ``alive`` and ``reached``.

    ``lowest`` and ``highest``: the box targets are drawn from, (north, east, height, heading).
    ``shows_target``: whether the way to the target is observed; ``moves_on``: whether one target
    follows the other; ``follows_path``: whether the target moves in time (paths.py), whose velocity and
    acceleration are observed too. ``success``: limits of the errors, see `judge`.
    """

    summary: str
    weights: Mapping[str, float]
    scales: Mapping[str, float]
    lowest: tuple[float, float, float, float]
    highest: tuple[float, float, float, float]
    shows_target: bool = True
    moves_on: bool = False
    follows_path: bool = False
    success: Mapping[str, float] = field(default_factory=lambda: SUCCESS)

    @property
    def shown(self) -> tuple[tuple[str, str, float], ...]:
        """Name, unit and bound of what is observed of the target."""
        if not self.shows_target:
            return ()
        return WAY + MOTION if self.follows_path else WAY

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the reward terms."""
        return tuple(self.weights)


HOVER_TARGET = (0.0, 0.0, hover.HEIGHT, 0.0)

TASKS: dict[str, Task] = {
    "hover": Task(
        "stay at 1.5 m over the start, heading north",
        hover.REWARD_WEIGHTS, hover.REWARD_SCALES, HOVER_TARGET, HOVER_TARGET, shows_target=False,
    ),
    "position": Task(
        "go to a position and a heading, and stay there",
        {
            "alive": 0.1, "height": 0.2, "position": 0.25, "speed": 0.15, "heading": 0.15,
            "rates": 0.05, "effort": 0.1,
        },
        {**hover.REWARD_SCALES, "position": 0.5},
        (-1.0, -1.0, 1.0, -45.0 * _DEGREE), (1.0, 1.0, 2.0, 45.0 * _DEGREE),
    ),
    "waypoints": Task(
        "go from waypoint to waypoint, each with its heading, and stay at the last",
        {
            "alive": 0.1, "height": 0.2, "position": 0.35, "speed": 0.05, "heading": 0.15,
            "rates": 0.05, "effort": 0.1, "reached": 50.0,
        },
        {**hover.REWARD_SCALES, "position": 1.0, "speed": 2.0},
        (-2.0, -2.0, 1.0, -math.pi), (2.0, 2.0, 2.5, math.pi),
        moves_on=True,
    ),
    "trajectory": Task(
        "follow a path in time",
        {
            "alive": 0.1, "height": 0.2, "position": 0.4, "speed": 0.0, "heading": 0.15,
            "rates": 0.05, "effort": 0.1,
        },
        {**hover.REWARD_SCALES, "position": 0.25},
        HOVER_TARGET, HOVER_TARGET, follows_path=True, success=SUCCESS | {"drift": 1.0},
    ),
}  # fmt: skip
"""The tasks by name. ``reached`` is paid once per waypoint: more than moving on costs at first."""

WAY = (
    ("target_forward", "m", 50.0), ("target_right", "m", 50.0), ("target_up", "m", 10.0),
    ("heading_error", "rad", math.pi),
)  # fmt: skip
"""Name, unit and bound of the way to the target, which such a task appends to the observation.

Target minus *measured* position, turned by the measured heading; target minus measured heading.
"""
N_WAY = len(WAY)
MOTION = (
    ("path_forward", "m/s", 15.0), ("path_right", "m/s", 15.0), ("path_up", "m/s", 15.0),
    ("path_turn", "rad/s", 10.0), ("path_forward_acceleration", "m/s2", 60.0),
    ("path_right_acceleration", "m/s2", 60.0), ("path_up_acceleration", "m/s2", 60.0),
)  # fmt: skip
"""Name, unit and bound of how a path's target moves, appended after WAY; in the heading's axes."""
N_MOTION = len(MOTION)
LOW, HIGH = range(2)
"""Rows of the box that targets are drawn from."""
FORWARD, RIGHT, UP, TURN = range(N_WAY)
"""Places of the way to the target."""
_BOUNDS = np.array([bound for *_, bound in WAY])
_MOTION_BOUNDS = np.array([bound for *_, bound in MOTION])

WITHIN, REACHED = range(2)
"""Columns of a helicopter's progress: rows spent at the target so far, and targets reached."""


def task(name: str) -> Task:
    """A task by name."""
    if name not in TASKS:
        raise InputError(f"no task {name!r}: choose one of {', '.join(TASKS)}")
    return TASKS[name]


def course(name: str, target: Any = None) -> np.ndarray:
    """Targets that are given, in order, as x y z psi, shape (k, 4); k = 0: they are drawn.

    Args:
        target: (north, east, height, heading), for waypoints one or several; None: drawn, but for
            ``hover``, whose target is fixed.
    """
    own = task(name)
    if own.follows_path:
        return paths.path(target)[0][:1, :4]
    if name == "hover":
        if target is not None:
            raise InputError(
                "task 'hover' has its target over the start: 'position' takes a target"
            )
        target = HOVER_TARGET
    if target is None:
        return np.empty((0, 4))
    try:
        given = np.atleast_2d(np.array(target, dtype=float))
    except (TypeError, ValueError):
        given = np.empty(0)
    if given.ndim != 2 or given.shape[1] != 4 or not len(given) or not np.isfinite(given).all():
        raise InputError("a target is (north, east, height, heading) in m and rad, all finite")
    if len(given) > 1 and not own.moves_on:
        raise InputError(f"task {name!r} takes one target, found {len(given)}")
    outside = (given[:, DOWN] <= hover.LOWEST) | (given[:, DOWN] >= hover.HIGHEST)
    if (outside | (np.hypot(given[:, NORTH], given[:, EAST]) >= hover.FARTHEST)).any():
        raise InputError(
            f"a target must be {hover.LOWEST:g} to {hover.HIGHEST:g} m high and within "
            f"{hover.FARTHEST:g} m of the start"
        )
    return given * (1.0, 1.0, -1.0, 1.0)


def box(name: str) -> np.ndarray:
    """Where targets are drawn: lowest and highest x y z psi, shape (2, 4)."""
    own = task(name)
    return np.array([own.lowest, own.highest]) * (1.0, 1.0, -1.0, 1.0)


def places(name: str, sensors: Sequence[Sensor]) -> np.ndarray:
    """Where the observation has north, east, height and heading, (4,); empty where no target is shown.

    Raises:
        InputError: the task needs a position that these sensors do not measure.
    """
    if not task(name).shows_target:
        return np.empty(0, dtype=np.int64)
    names = [sensor.name for sensor in sensors]
    for wanted in (["x", "y", "z", "psi"], ["pn", "pe", "h", "psi"]):
        if all(channel in names for channel in wanted):
            return np.array([names.index(channel) for channel in wanted])
    raise InputError(
        f"task {name!r} needs sensors that measure position and heading: 'mocap' or 'state'"
    )


def height_sign(name: str, sensors: Sequence[Sensor]) -> float:
    """What makes the height reading at `places` the state z: 1 for z itself, -1 for h."""
    place = places(name, sensors)
    return 1.0 if len(place) and sensors[place[DOWN]].name == "z" else -1.0


@compiled()
def next_target(stream, course, box, reached, target):
    """The target after `reached` ones: from the course, or drawn.

    Args:
        stream: key and counter, (2,) uint64. course: targets given, x y z psi, (k, 4).
        box: lowest and highest of those drawn, (2, 4). target: is put here, (4,).
    """
    if len(course) > 0:
        k = min(reached, len(course) - 1)
        for i in range(4):
            target[i] = course[k, i]
    else:
        for i in range(4):
            target[i] = uniform(stream, box[LOW, i], box[HIGH, i])


@compiled()
def reaches(x, target, dwell, progress, course):
    """Count a row at the target; whether this row completes it.

    Args:
        x: full state, (29,). target: x y z psi, (4,). dwell: rows that complete it; 0: none do.
        progress: WITHIN and REACHED, (2,), in place. course: targets given, (k, 4).
    """
    north, east, down = x[S.X] - target[NORTH], x[S.Y] - target[EAST], x[S.Z] - target[DOWN]
    turn = wrap_angle(x[S.PSI] - target[HEADING])
    there = (
        north * north + east * east + down * down < RADIUS * RADIUS
        and abs(turn) < HEADING_TOLERANCE
    )
    progress[WITHIN] = progress[WITHIN] + 1 if there else 0
    left = len(course) == 0 or progress[REACHED] < len(course)
    if dwell == 0 or not left or progress[WITHIN] < dwell:
        return False
    progress[WITHIN] = 0
    progress[REACHED] += 1
    return True


@compiled()
def way_to_target(held, places, height_sign, target, out):
    """The way to the target by the readings, WAY, within its bounds.

    Args:
        held: readings. places, height_sign: from the functions of these names.
        target: x y z psi, (4,). out: is put here, (4,).
    """
    psi = held[places[HEADING]]
    north = target[NORTH] - held[places[NORTH]]
    east = target[EAST] - held[places[EAST]]
    out[FORWARD] = math.cos(psi) * north + math.sin(psi) * east
    out[RIGHT] = math.cos(psi) * east - math.sin(psi) * north
    out[UP] = height_sign * held[places[DOWN]] - target[DOWN]
    out[TURN] = wrap_angle(target[HEADING] - psi)
    for i in range(N_WAY):
        out[i] = min(max(out[i], -_BOUNDS[i]), _BOUNDS[i])


@compiled()
def row_of_path(row, rows, again):
    """Where a path is after so many control periods: past its last row from `again` on.

    Args:
        row: control periods since the start. rows: of the path. again: row that follows the last.
    """
    return row if row < rows else again + (row - again) % (rows - again)


@compiled()
def motion_of_target(point, psi, out):
    """How a path moves, MOTION, in the axes of a heading.

    Args:
        point: a row of a path, (paths.N_PATH,). psi: measured heading [rad]. out: is put here, (7,).
    """
    cosine, sine = math.cos(psi), math.sin(psi)
    for k, first in ((0, 4), (4, 8)):
        out[k] = cosine * point[first] + sine * point[first + 1]
        out[k + 1] = cosine * point[first + 1] - sine * point[first]
        out[k + 2] = -point[first + 2]
    out[3] = point[7]
    for i in range(N_MOTION):
        out[i] = min(max(out[i], -_MOTION_BOUNDS[i]), _MOTION_BOUNDS[i])


def judge(
    name: str,
    flown: np.ndarray,
    errors: Mapping[str, np.ndarray],
    reached: np.ndarray | int = 0,
    wanted: int = 1,
) -> np.ndarray:
    """Which flights were successes, (count,) bool.

    ``hover`` and ``position``: flown to the end, and from SETTLED on every error under SUCCESS's.
    ``trajectory``: the same, about the moving target, nearer to it and with the speed relative to it.
    ``waypoints``: flown to the end, and `wanted` of them reached.

    Args:
        flown: whether each was flown to the end, (count,).
        errors: with the keys of SUCCESS, each (count,): rms of the errors of height, speed and
            heading from SETTLED on, and the farthest drift: from the place at that time in
            ``hover``, whose sensors need not show the position, else from the target.
        reached: waypoints reached, (count,). wanted: how many it should have been.
    """
    if task(name).moves_on:
        return np.asarray(flown & (reached >= wanted))
    within = [errors[key] < limit for key, limit in task(name).success.items()]
    return np.logical_and.reduce([flown, *within])


def succeeded(
    name: str,
    states: np.ndarray,
    targets: np.ndarray,
    steps: int,
    reached: int = 0,
    wanted: int = 1,
    rates: np.ndarray | None = None,
) -> bool:
    """Whether one flight was a success by `judge`, from true states.

    Args:
        states: (n, >=16), one row after each step flown. targets: x y z psi in force, (n, 4).
        rates: of the targets, ``info["target_rates"]`` (n, 4), where they move.
        steps: how many the flight should have had.
        reached: waypoints reached, ``info["reached"]``. wanted: how many it should have been.
    """
    flown = np.array([len(states) >= steps and bool(np.isfinite(states).all())])
    x, goal = states[FIRST_JUDGED - 1 :], targets[FIRST_JUDGED - 1 :]
    errors = dict.fromkeys(SUCCESS, np.array([np.inf]))
    if len(x):
        place = x[0, PLACE] if name == "hover" else goal[:, HORIZONTAL]
        moving = None if rates is None else rates[FIRST_JUDGED - 1 :]
        squares = hover.squared_errors(x, goal, moving)
        errors = {k: np.sqrt([squares[k].mean()]) for k in ("height", "speed", "heading")}
        errors["drift"] = np.linalg.norm(x[:, PLACE] - place, axis=1).max(keepdims=True)
    return bool(judge(name, flown, errors, reached, wanted)[0])


def dwell_rows(name: str) -> int:
    """Rows at a target that complete it; 0 where the task does not move on."""
    return round(DWELL / hover.CONTROL_PERIOD) if task(name).moves_on else 0
