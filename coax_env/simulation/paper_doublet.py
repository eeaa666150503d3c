"""The paper's pre-flight simulation (section III.B) as a table: what its figures print, what its
equations give, what is flown here.
"""

import math
from dataclasses import dataclass

import numpy as np

from coax_env.model import dynamics
from coax_env.model import state as S
from coax_env.model.layout import N_STATES, RPM_PER_RAD_S
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.simulation.maneuvers import maneuver
from coax_env.simulation.simulate import STEP, Track, fly

DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class DoubletRow:
    """One quantity of the paper's doublet: printed, from its equations, and as flown here.

    Ranges are (low, high); single values have low == high. ``axis`` is what the figure's axis can
    show, or 10 % about the number in the text.
    """

    quantity: str
    unit: str
    paper: str
    axis: tuple[float, float]
    equations: tuple[float, float]
    digits: int
    run: tuple[float, float]
    reduced: tuple[float, float]

    @property
    def agrees(self) -> bool:
        """Within 2 %, or half the last printed digit, of what the paper's equations give."""
        return all(
            abs(found - wanted) <= max(0.02 * abs(wanted), 0.5 * 10.0**-self.digits)
            for found, wanted in zip(self.run, self.equations, strict=True)
        )

    @property
    def fits_paper(self) -> bool:
        """With the printed tables, within what the paper prints."""
        return _inside(self.run, self.axis)

    @property
    def reduced_fits_paper(self) -> bool:
        """With the smaller K_b, within what the paper prints."""
        return _inside(self.reduced, self.axis)


def _inside(found: tuple[float, float], axis: tuple[float, float]) -> bool:
    return axis[0] <= found[0] and found[1] <= axis[1]


REDUCED_K_B = 0.67
"""Linkage gain that gives the paper's figures; Table III prints 0.91. Inferred, not known."""

_DOUBLET = (
    # quantity, unit, source, what the paper prints, its limits, equations, digits printed
    ("u", "m/s", "u", "±2", (-2, 2), (0.0, 2.00), 2),
    ("v", "m/s", "v", "±1", (-1, 1), (-0.12, 0.00), 2),
    ("w", "m/s", "w", "±1", (-1, 1), (-0.07, 0.29), 2),
    ("p", "deg/s", "p", "±30", (-30, 30), (-26.9, 25.1), 1),
    ("q", "deg/s", "q", "−20 .. 40", (-20, 40), (-19.6, 37.9), 1),
    ("r", "deg/s", "r", "±5", (-5, 5), (0, 0), 1),
    ("alpha_l", "deg", "alpha_l", "±5", (-5, 5), (-4.9, 5.3), 1),
    ("beta_l", "deg", "beta_l", "±2", (-2, 2), (-1.1, 1.2), 1),
    ("alpha_f", "deg", "alpha_f", "±5", (-5, 5), (-6.4, 5.1), 1),
    ("beta_f", "deg", "beta_f", "±5", (-5, 5), (-4.3, 2.3), 1),
    ("phi", "deg", "phi", "±4", (-4, 4), (-2.4, 4.4), 1),
    ("theta", "deg", "theta", "±5", (-5, 5), (-6.1, 4.6), 1),
    ("psi", "deg", "psi", "±2", (-2, 2), (0, 0.7), 1),
    ("y at 10 s", "m", "y", "±1", (-1, 1), (-0.34, -0.34), 2),
    ("x at 10 s", "m", "x", "around 6", (5.4, 6.6), (8.2, 8.2), 1),
    ("height lost", "m", "z", "around 0.7", (0.6, 0.8), (1.25, 1.25), 2),
)  # fmt: skip


def _doublet_range(track: Track, source: str, unit: str) -> tuple[float, float]:
    history = track[source] / (DEGREE if unit.startswith("deg") else 1.0)
    if source in ("x", "y", "z"):
        change = float(history[-1] - history[0])
        return change, change
    return float(history.min()), float(history.max())


def doublet_table(vehicle: Vehicle | str = "lama400d") -> tuple[DoubletRow, ...]:
    """The paper's doublet (Figs 3-10): printed, by its equations, and flown here with two K_b."""
    vehicle = load_vehicle(vehicle).without_effects()
    run = fly(vehicle, "lon_doublet")
    reduced = fly(vehicle.with_values({"swash_to_flap": REDUCED_K_B}), "lon_doublet")
    return tuple(
        DoubletRow(
            quantity, unit, paper, axis, equations, digits,
            _doublet_range(run, source, unit), _doublet_range(reduced, source, unit),
        )
        for quantity, unit, source, paper, axis, equations, digits in _DOUBLET
    )  # fmt: skip


@dataclass(frozen=True)
class Remark:
    """A statement of ours about the paper's doublet, checked by flying it."""

    statement: str
    expected: tuple[float, ...]
    found: tuple[float, ...]
    tolerance: float

    @property
    def holds(self) -> bool:
        """Every number within the relative tolerance."""
        return all(
            abs(f - e) <= self.tolerance * max(abs(e), 0.1)
            for f, e in zip(self.found, self.expected, strict=True)
        )


def doublet_remarks(vehicle: Vehicle | str = "lama400d") -> tuple[Remark, ...]:
    """What else is known about the paper's doublet, each flown here."""
    vehicle = load_vehicle(vehicle).without_effects()
    q = _euler_doublet(vehicle)[:, S.Q] / DEGREE
    quoted = _doublet_at(vehicle, np.array([2000.0, 2150.0]) / RPM_PER_RAD_S)
    v = vehicle.values()
    inverted = vehicle.with_values(
        {n: 1.0 / v[n] for n in ("flybar_to_rotor_lon", "flybar_to_rotor_lat")}
    )
    smaller = fly(vehicle, maneuver("lon_doublet").scaled(3.7 / 5.0))
    return (
        Remark(
            "Euler steps of 10 ms would give q from -27 to 43 deg/s: RK4 is used",
            (-27.0, 43.0), (float(q.min()), float(q.max())), 0.03,
        ),
        Remark(
            "at exactly 2000/2150 rpm the doublet ends 1 m higher and turning at -103 deg/s",
            (1.0, -103.0), (float(-quoted[S.Z]), float(quoted[S.R] / DEGREE)), 0.06,
        ),
        Remark(
            "inverting K_q and K_p, as the wording of the ratio suggests, gives x = 2.9 m",
            (2.9,), (float(fly(inverted, "lon_doublet")["x"][-1]),), 0.03,
        ),
        Remark(
            "an amplitude of 3.7 deg does what K_b = 0.67 does: x near 6.07 m, height lost 0.68 m",
            (6.07, 0.68),
            (float(smaller["x"][-1]), float(smaller["z"][-1] - smaller["z"][0])), 0.03,
        ),
    )  # fmt: skip


def _euler_doublet(vehicle: Vehicle) -> np.ndarray:
    """The doublet by Euler's method at 10 ms, shape (n, 16)."""
    plan = maneuver("lon_doublet")
    state, trim = dynamics.hover_trim(vehicle, plan.height)
    t = np.arange(round(plan.duration / STEP)) * STEP
    states = [state]
    for command in trim + plan.injection(t, trim):
        states.append(states[-1] + STEP * dynamics.derivative(states[-1], command, vehicle))
    return np.array(states)


def _doublet_at(vehicle: Vehicle, speeds: np.ndarray) -> np.ndarray:
    """State (16,) at the end of the doublet flown from rest at z = 0 at given rotor speeds."""
    plan = maneuver("lon_doublet")
    base = np.array([*speeds, 0.0, 0.0])
    t = np.arange(round(plan.duration / STEP)) * STEP
    x, work = dynamics.full_state(np.zeros(N_STATES), base, vehicle), np.zeros(dynamics.WORK_SIZE)
    for time, command in zip(t, base + plan.injection(t, base), strict=True):
        dynamics.step(x, dynamics.kernel_input(command, time), STEP, vehicle.vector, work, x)
    return x[:N_STATES]
