"""Attitude and position from what others log: quaternions between any frames, latitude and longitude.

Ours: body x forward, y right, z down; earth north, east, down; phi, theta, psi are the 3-2-1
angles that turn
the earth's axes into the body's.
"""

from collections.abc import Sequence

import numpy as np

from coax_env.errors import InputError

BODIES: dict[str, np.ndarray] = {
    "body": np.eye(3),
    "FRD": np.eye(3),
    "FLU": np.diag([1.0, -1.0, -1.0]),
}
"""Body frame -> rows: its axes in forward, right, down. "body" is ours, FRD; ROS has FLU."""
EARTHS: dict[str, np.ndarray] = {
    "NED": np.eye(3),
    "ENU": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "NWU": np.diag([1.0, -1.0, -1.0]),
}
"""Earth frame -> rows: its axes in north, east, down. NWU is a tracking system's with z up, whose
x is called
north; ROS has ENU."""
FORM = '"body to NED", "FLU to ENU" (ROS), "NED to body" and the like'


def frames_of(words: str) -> tuple[np.ndarray, np.ndarray, bool]:
    """Frames of ``"body to NED"``: the body's, the earth's (3, 3), and whether it turns body into
    earth.

    Raises:
        InputError: not of that form.
    """
    a, between, b = words.strip().partition(" to ")
    known = {name.lower(): axes for name, axes in {**BODIES, **EARTHS}.items()}
    bodies = {name.lower() for name in BODIES}
    first, second = a.strip().lower(), b.strip().lower()
    if between and {first, second} <= known.keys() and (first in bodies) != (second in bodies):
        if first in bodies:
            return known[first], known[second], True
        return known[second], known[first], False
    raise InputError(
        f"{words!r} is not of the form {FORM}: bodies are {', '.join(BODIES)}, earths"
        f" {', '.join(EARTHS)}"
    )


def attitude(q: np.ndarray, frames: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roll, pitch, heading [rad], each (n,), of quaternions.

    Args:
        q: (n, 4), w first; need not be of length 1; a row with a NaN, or of length 0, gives NaN.
        frames: what they turn into what, as of `frames_of`.
    """
    body, earth, from_body = frames_of(frames)
    turn = _matrices(q)
    if not from_body:
        turn = np.swapaxes(turn, 1, 2)
    # components of a vector in FRD -> those in NED
    ours = earth.T @ turn @ body
    phi = np.arctan2(ours[:, 2, 1], ours[:, 2, 2])
    theta = np.arcsin(np.clip(-ours[:, 2, 0], -1.0, 1.0))
    psi = np.arctan2(ours[:, 1, 0], ours[:, 0, 0])
    return phi, theta, psi


def euler_rates(
    gyros: Sequence[np.ndarray], phi: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rates of phi, theta, psi (n,) [rad/s] where gyros p, q, r turn the body; eq. (38)-(40).

    Args:
        gyros: p, q, r, (n,) each [rad/s]. phi, theta: (n,) [rad].
    """
    p, q, r = gyros
    across = np.sin(phi) * q + np.cos(phi) * r
    return p + np.tan(theta) * across, np.cos(phi) * q - np.sin(phi) * r, across / np.cos(theta)


def turned_to_earth(q: np.ndarray, body: np.ndarray) -> np.ndarray:
    """North, east, down (n, 3) of vectors (n, 3) in forward, left, up; q: (n, 4), FLU to ENU, w
    first."""
    found: np.ndarray = np.einsum("nij,nj->ni", _matrices(q), body) @ EARTHS["ENU"]
    return found


def _matrices(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4)."""
    length = np.linalg.norm(q, axis=1, keepdims=True)
    w, x, y, z = (q / np.where(length > 0.0, length, np.nan)).T
    return np.stack([
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ], 1)  # fmt: skip


# --- latitude and longitude -----------------------------------------------------------------------

EQUATOR = 6378137.0
"""Radius of the equator [m], WGS 84."""
FLATTENING = 1.0 / 298.257223563
"""Of the earth, WGS 84."""


def metres_per_radian(latitude: float) -> tuple[float, float]:
    """Way north and east per radian of latitude and of longitude [m], on WGS 84 at a latitude [rad]."""
    squared = FLATTENING * (2.0 - FLATTENING)
    root = 1.0 - squared * np.sin(latitude) ** 2
    north = EQUATOR * (1.0 - squared) / root**1.5
    east = EQUATOR / np.sqrt(root) * np.cos(latitude)
    return float(north), float(east)


def place(
    lat: np.ndarray, lon: np.ndarray, origin: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """North and east [m], (n,), of places; a plane: right to 0.1 % within some kilometres.

    Args:
        lat, lon: (n,) [rad].
        origin: latitude and longitude that are 0 [rad].
    """
    north, east = metres_per_radian(origin[0])
    around = (lon - origin[1] + np.pi) % (2.0 * np.pi) - np.pi
    return north * (lat - origin[0]), east * around
