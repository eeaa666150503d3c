"""What must hold between the channels of any log, as regressions whose coefficients are near 1.

Kinematics hold for every machine: an angle and its rate, a height and its velocity, a velocity and the
specific force turned by the attitude. Three relations rest on the vehicle: that a swash command
turns the machine its own way, that the rotors' difference turns it in yaw, and that rotor speeds follow
their commands; of them only the sign is asked, and the size within a factor.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.signal import lfilter

from coax_env.consistency.even_rows import STEP, EvenRows, weak
from coax_env.model.layout import ROTOR_SPEEDS, RPM_PER_RAD_S

LONGEST_ANGLE = 0.6
"""Angle [rad] at which those inside a sine are cut: degrees must not make nonsense of the other
terms."""

Signals = Mapping[str, np.ndarray]
Parts = dict[str, np.ndarray]
"""Terms of a relation by name, (n,) on even rows; empty names are nuisance."""


@dataclass(frozen=True)
class Machine:
    """What the relations know of a vehicle in hover.

    Attributes:
        gravity: [m/s2].
        hover: rotor speeds, upper and lower [rev/min].
        yaw: yaw acceleration per rotor speed, upper and lower [rad/s2 per rev/min].
        flap: (4, 4) of the flaps and the bar [1/s]; flap_rates: (4, 2) by p, q; flap_swash: (4, 2)
            by delta_lon, delta_lat [1/s]; turned: (2, 4) accelerations of p, q by them [rad/s2 per
            rad]; crossed: (2, 2) by p, q [1/s].
    """

    gravity: float
    hover: tuple[float, float]
    yaw: tuple[float, float]
    flap: np.ndarray
    flap_rates: np.ndarray
    flap_swash: np.ndarray
    turned: np.ndarray
    crossed: np.ndarray


@dataclass(frozen=True)
class Relation:
    """derivative of `left` = sum of the parts, each with a coefficient.

    Attributes:
        left: channel; the name of a check is ``left-part``.
        order: of the derivative.
        uses: channels that the relation needs.
        may_use: others that it uses where there are some.
        parts: of a run, by the channel after which each is named.
        windows: lengths to try [s].
        exact: whether the coefficient is 1, or only its sign is known, and its size within a factor.
    """

    left: str
    order: int
    uses: tuple[str, ...]
    may_use: tuple[str, ...]
    parts: Callable[[Signals, Machine], Parts]
    windows: tuple[float, ...]
    exact: bool = True

    @property
    def channels(self) -> frozenset[str]:
        """All that it may read."""
        return frozenset((self.left, *self.uses, *self.may_use))


@dataclass(frozen=True)
class Coefficient:
    """One coefficient of a relation, as a log has it.

    std: of the coefficient. share: partial correlation. window: [s] at which it is seen best.
    """

    check: str
    left: str
    part: str
    value: float
    std: float
    share: float
    window: float
    exact: bool

    @property
    def strength(self) -> float:
        """How many std it is from 0."""
        return abs(self.value) / self.std


# --- the relations --------------------------------------------------------------------------------


def _small(angle: np.ndarray) -> np.ndarray:
    return np.clip(angle, -LONGEST_ANGLE, LONGEST_ANGLE)


def _angle(s: Signals, name: str, like: np.ndarray) -> np.ndarray:
    return _small(s[name]) if name in s else np.zeros(like.size)


def _roll(s: Signals, machine: Machine) -> Parts:
    p = s["p"]
    phi, theta = _small(s["phi"]), _angle(s, "theta", p)
    q, r = s.get("q", 0.0 * p), s.get("r", 0.0 * p)
    return {"p": p, "": np.tan(theta) * (q * np.sin(phi) + r * np.cos(phi))}


def _pitch(s: Signals, machine: Machine) -> Parts:
    q = s["q"]
    phi = _angle(s, "phi", q)
    return {"q": q * np.cos(phi), "": -s.get("r", 0.0 * q) * np.sin(phi)}


def _heading(s: Signals, machine: Machine) -> Parts:
    r = s["r"]
    phi, theta = _angle(s, "phi", r), _angle(s, "theta", r)
    return {
        "r": r * np.cos(phi) / np.cos(theta),
        "": s.get("q", 0.0 * r) * np.sin(phi) / np.cos(theta),
    }


def _velocity(rate: str, sign: float) -> Callable[[Signals, Machine], Parts]:
    return lambda s, machine: {rate: sign * s[rate]}


def _horizontal(axis: str) -> Callable[[Signals, Machine], Parts]:
    """North or east acceleration: tilt of the thrust, and the specific force along x and y."""

    def parts(s: Signals, machine: Machine) -> Parts:
        psi = s["psi"]
        phi, theta = _small(s["phi"]), _small(s["theta"])
        down = s["az"] if "az" in s else np.full(psi.size, -machine.gravity)
        north = axis == "north"
        forward, right = (np.cos(psi), -np.sin(psi)) if north else (np.sin(psi), np.cos(psi))
        found = {
            "theta": forward * np.sin(theta) * np.cos(phi) * down,
            "phi": -right * np.sin(phi) * down,
        }
        if "ax" in s:
            found["ax"] = forward * np.cos(theta) * s["ax"]
        if "ay" in s:
            found["ay"] = right * np.cos(phi) * s["ay"]
        return found

    return parts


def _vertical(sign: float) -> Callable[[Signals, Machine], Parts]:
    """Acceleration down (1) or up (-1)."""

    def parts(s: Signals, machine: Machine) -> Parts:
        phi, theta = _small(s["phi"]), _small(s["theta"])
        return {"az": sign * (np.cos(theta) * np.cos(phi) * s["az"])}

    return parts


def _swash(
    axis: int, rates: tuple[str, str], edges: tuple[int, ...]
) -> Callable[[Signals, Machine], Parts]:
    """Acceleration in p (0) or q (1), by the swash commands; the rates' own part is nuisance."""

    def parts(s: Signals, machine: Machine) -> Parts:
        p, q = (_rate(s, name) for name in rates)
        row = machine.turned[axis]
        of_rates = _flapping(machine, machine.flap_rates @ np.stack([p, q]), edges)
        main = "delta_lat" if axis == 0 else "delta_lon"
        other = "delta_lon" if axis == 0 else "delta_lat"
        own = {
            name: _flapping(machine, np.outer(machine.flap_swash[:, k], s[name]), edges)
            for k, name in enumerate(("delta_lon", "delta_lat"))
        }
        lower, bar = row[:2] @ of_rates[:2], row[2:] @ of_rates[2:]
        # what a turned swash plate would do with the other command
        across = machine.turned[1 - axis] @ own[other]
        return {
            main: row @ own[main],
            "": across,
            " lower": lower,
            " bar": bar,
            " across": machine.crossed[axis] @ np.stack([p, q]),
        }

    return parts


def _rate(s: Signals, name: str) -> np.ndarray:
    """p or q, or the slope of phi or theta in its place."""
    if name in ("p", "q"):
        return s[name]
    width = 11
    smooth = np.convolve(
        np.pad(s[name], width // 2, mode="edge"), np.full(width, 1 / width), "valid"
    )
    return np.gradient(smooth, STEP)


def _flapping(machine: Machine, forced: np.ndarray, edges: tuple[int, ...]) -> np.ndarray:
    """Response (4, n) of the flaps and the bar to what forces them, (4, n) [rad/s], run by run."""
    values, vectors = (np.real_if_close(x) for x in np.linalg.eig(machine.flap))
    modes = np.linalg.inv(vectors) @ forced
    first, rows = np.array(edges[:-1]), np.diff(edges)
    modes -= np.repeat(np.add.reduceat(modes, first, axis=1) / rows, rows, axis=1)
    for k, value in enumerate(values):
        stays = np.exp(value * STEP)
        through = lfilter([STEP], [1.0, -stays], modes[k])  # all runs as one...
        before = np.where(first > 0, through[first - 1], 0.0)
        modes[k] = through - np.repeat(before, rows) * _left(stays, edges)  # ...less what came over
    found: np.ndarray = np.real(vectors @ modes)
    return found


@lru_cache(maxsize=8)  # every change of a card asks for the same again
def _left(stays: complex, edges: tuple[int, ...]) -> np.ndarray:
    """What is left in each row (n,) of a mode before its run began; stays: from one row to the next."""
    rows = np.diff(edges)
    since = np.arange(edges[-1]) - np.repeat(edges[:-1], rows)
    found: np.ndarray = (stays ** np.arange(1, rows.max() + 1))[since]
    return found


def _yaw(speeds: tuple[str, str]) -> Callable[[Signals, Machine], Parts]:
    def parts(s: Signals, machine: Machine) -> Parts:
        both = [s[name] - np.median(s[name]) for name in speeds]
        turning = machine.yaw[0] * both[0] + machine.yaw[1] * both[1]
        found = {"rotors": turning}
        if "r" in s:
            found[""] = s["r"]
        return found

    return parts


def _follows(command: str, other: str) -> Callable[[Signals, Machine], Parts]:
    return lambda s, machine: {command: s[command], "": s[other]}


SLOW = (0.6, 1.2, 2.4)
QUICK = (0.2, 0.4, 0.8)


def relations(channels: frozenset[str], edges: tuple[int, ...] = (0,)) -> list[Relation]:
    """Those that a log with these channels and commands can be asked; edges: of its runs."""
    angles = ("phi", "theta", "psi")
    forces = ("ax", "ay", "az")
    body = ("p", "q", "r")
    speeds = ("rpm_upper_cmd", "rpm_lower_cmd")
    found = [
        Relation("phi", 1, ("p",), (*angles, *body), _roll, SLOW),
        Relation("theta", 1, ("q",), (*angles, *body), _pitch, SLOW),
        Relation("psi", 1, ("r",), (*angles, *body), _heading, SLOW),
        Relation("h", 1, ("vd",), (), _velocity("vd", -1.0), (1.2, 2.4, 4.8)),
        Relation("pn", 1, ("vn",), (), _velocity("vn", 1.0), (1.2, 2.4, 4.8)),
        Relation("pe", 1, ("ve",), (), _velocity("ve", 1.0), (1.2, 2.4, 4.8)),
        Relation("rpm_upper", 0, speeds, (), _follows(*speeds), SLOW),
        Relation("rpm_lower", 0, speeds, (), _follows(*speeds[::-1]), SLOW),
    ]
    for axis, velocity, position in (("north", "vn", "pn"), ("east", "ve", "pe")):
        left, order = (velocity, 1) if velocity in channels else (position, 2)
        found.append(Relation(left, order, angles, forces, _horizontal(axis), (1.0, 2.0, 4.0)))
    left, order, sign = ("vd", 1, 1.0) if "vd" in channels else ("h", 2, -1.0)
    found.append(
        Relation(left, order, ("phi", "theta", "az"), (), _vertical(sign), (1.0, 2.0, 4.0))
    )
    rates = ("p", "q") if {"p", "q"} <= channels else ("phi", "theta")
    order = 1 if "p" in rates else 2
    commands = ("delta_lon", "delta_lat")
    for k in (0, 1):
        found.append(
            Relation(
                rates[k],
                order,
                (*rates, *commands),
                (),
                _swash(k, rates, edges),
                QUICK,
                exact=False,
            )
        )
    if channels.issuperset(ROTOR_SPEEDS):
        speeds = ROTOR_SPEEDS
    yaw, order = ("r", 1) if "r" in channels else ("psi", 2)
    found.append(Relation(yaw, order, speeds, ("r",), _yaw(speeds), SLOW, exact=False))
    return [one for one in found if {one.left, *one.uses} <= channels]


# --- their coefficients ---------------------------------------------------------------------------

LEAST_FREEDOM = 5.0
"""Degrees of freedom of a regression: independent windows less what is fitted to them. With fewer, what
was left over says nothing of the noise; ours."""


def coefficients(relation: Relation, rows: EvenRows, machine: Machine) -> list[Coefficient]:
    """One for each named part, at the window at which it is seen best.

    Args:
        relation: between signals. rows: the log on even rows. machine: what it is asked of.
    """
    if not {relation.left, *relation.uses} <= rows.signals.keys():
        return []
    parts = relation.parts(rows.signals, machine)
    named = [k for k, name in enumerate(parts) if name and not name.startswith(" ")]
    names = list(parts)
    best: dict[str, Coefficient] = {}
    for length in relation.windows:
        y, X, runs = _projected(relation, rows, parts, length)
        # each run's mean is fitted too
        freedom = INDEPENDENT * (y.size - runs) - X.shape[1]
        if freedom < LEAST_FREEDOM or y.std() == 0.0:
            continue
        solution, std = _least_squares(X, y, freedom)
        for k in named:
            if not 0.0 < std[k] < np.inf:
                continue
            t = solution[k] / std[k]
            one = Coefficient(
                f"{relation.left}-{names[k]}", relation.left, names[k],
                float(solution[k]), float(std[k]), float(t / np.sqrt(t**2 + freedom)),
                length, relation.exact,
            )  # fmt: skip
            if names[k] not in best or one.strength > best[names[k]].strength:
                best[names[k]] = one
    return list(best.values())


INDEPENDENT = 0.5
"""Share of the windows that counts: they overlap by half."""


def _least_squares(X: np.ndarray, y: np.ndarray, freedom: float) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (m,) of X (k, m) in y (k,), and their std; infinite of a column that is 0.

    freedom: degrees, of independent windows.
    """
    spread = X.std(axis=0)
    used = np.flatnonzero(spread > 0.0)
    A = X[:, used] / spread[used]
    inverse = np.linalg.pinv(A.T @ A)
    solution = inverse @ (A.T @ y)
    left = y - A @ solution
    # what agrees to the last digit is a log of a simulation without noise
    variance = max(float(left @ left), 1e-12 * float(y @ y)) / freedom
    found, std = np.zeros(X.shape[1]), np.full(X.shape[1], np.inf)
    found[used] = solution / spread[used]
    std[used] = np.sqrt(variance * np.diag(inverse)) / spread[used]
    return found, std


def _projected(
    relation: Relation, rows: EvenRows, parts: Parts, length: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Windows in which all is known, without each run's own mean: (k,) of the left side, (k, parts);
    and how many runs they are of."""
    windows = rows.windows(relation.channels, length)
    if not windows.starts.size:
        return np.empty(0), np.empty((0, len(parts))), 0
    means = [weak(rows.signals[relation.left], windows.starts, length, relation.order)]
    means += [weak(values, windows.starts, length, 0) for values in parts.values()]
    own = windows.without_means(np.stack(means, axis=1))
    return own[:, 0], own[:, 1:], np.unique(windows.run).size


def rev_per_min(speeds: np.ndarray) -> tuple[float, float]:
    """Two rotor speeds (2,) [rad/s] in rev/min."""
    upper, lower = (RPM_PER_RAD_S * speeds).tolist()
    return upper, lower
