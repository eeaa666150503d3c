"""Simulated flights: a maneuver flown by the one kernel, seen through sensors, as a flight folder.

Also the paper's pre-flight simulation (section III.B) as a table: what its figures print, what its
equations give, what this run gives.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coax_env.errors import InputError
from coax_env.logs.flight import Flight, Run
from coax_env.logs.repairs import SHORTEST_RUN
from coax_env.model import dynamics, effects
from coax_env.model import parameters as P
from coax_env.model.actuators import limit, limits
from coax_env.model.layout import (
    CHANNELS,
    GUSTS,
    N_CHANNELS,
    N_FULL,
    N_STATES,
    RPM_PER_RAD_S,
    STATES,
)
from coax_env.model.sensors import Sensor, log_readings, log_suite, shake
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.simulation.maneuvers import Maneuver, maneuver
from coax_env.simulation.pilot import CORNER, Pilot, rounded

STEP = 0.01  # [s] the paper's
DEGREE = math.pi / 180.0
_TOO_FAR = 1.4  # [rad] of roll or pitch that ends a run


@dataclass(frozen=True)
class Gusts:
    """Gusts as the estimator models them: force and moment in body axes, exponential memory."""

    force_N: tuple[float, float, float] = (0.05, 0.05, 0.08)
    moment_Nm: tuple[float, float, float] = (1e-3, 1e-3, 3e-4)
    memory_s: float = 0.5

    def levels(self) -> np.ndarray:
        """Std of the six gust states, shape (6,)."""
        return np.array([*self.force_N, *self.moment_Nm])


@dataclass(frozen=True)
class Track:
    """The truth of one simulated run.

    Attributes:
        t: (n,) [s]; state: (n, 26) full state; command: (n, 4); readings: (n, 18) without noise.
        ended: why the run ended before its time, in words; empty where it did not.
    """

    maneuver: Maneuver
    t: np.ndarray
    state: np.ndarray
    command: np.ndarray
    readings: np.ndarray
    ended: str = ""

    def __getitem__(self, name: str) -> np.ndarray:
        """History of a state of the paper by its name, SI, shape (n,)."""
        return self.state[:, [n for n, _ in STATES].index(name)]

    def reading(self, channel: str) -> np.ndarray:
        """True readings of a channel, contract unit, shape (n,)."""
        return self.readings[:, CHANNELS.index(channel)]


def fly(
    vehicle: Vehicle | str,
    plan: Maneuver | str,
    *,
    seed: int | np.random.SeedSequence = 0,
    closed_loop: bool | None = None,
    gusts: Gusts | None = None,
    tremor: float = 0.0,
    dt: float = STEP,
) -> Track:
    """Fly one maneuver from the vehicle's own trim; the truth, without sensors.

    Args:
        closed_loop: whether a pilot flies; None leaves it to the maneuver.
        tremor: size of the pilot's tremor, 1 is usual.
        dt: seconds per row.

    Raises:
        InputError: no such maneuver or vehicle, no hover, or the run ends within two seconds.
    """
    vehicle = load_vehicle(vehicle)
    plan = maneuver(plan)
    piloted = plan.closed_loop if closed_loop is None else closed_loop
    rng = np.random.default_rng(seed)
    pilot = Pilot(vehicle, plan.height, dt, tremor) if piloted else None
    start, trim = dynamics.hover_trim(vehicle, plan.height)

    t = np.arange(round(plan.duration / dt) + 1) * dt
    plan_command = trim + plan.injection(t, trim)
    asked = rounded(plan.asked_for(t), round(CORNER / dt))
    asked_rate = np.gradient(asked, dt, axis=0)
    values = vehicle.vector.copy()
    gusting = gusts is not None and bool(np.any(gusts.levels()))
    level, keep = np.zeros(6), 0.0
    if gusts is not None:
        values[P.GUST_MEMORY] = gusts.memory_s
        level, keep = gusts.levels(), math.exp(-dt / gusts.memory_s)

    x = dynamics.full_state(start, trim, vehicle)
    if gusting:
        x[GUSTS] = level * rng.standard_normal(6)
    delay, within, last = _SwashDelay(values, trim, dt), limits(vehicle), trim.copy()
    work = np.zeros(dynamics.WORK_SIZE)
    states, commands = np.empty((len(t), N_FULL)), np.empty((len(t), 4))
    readings = np.empty((len(t), N_CHANNELS))
    vibration, azimuth = values[effects.parameter_index("vibration.amplitude")], 0.0
    rows, ended = len(t), ""
    for k, time in enumerate(t):
        command = plan_command[k].copy()
        if pilot is not None:
            command += pilot.correction(x, asked[k], asked_rate[k], dt, rng)
            command[:2] = np.maximum(command[:2], 0.0)
        commands[k] = command
        possible = command.copy()
        limit(possible, last, within, dt)
        pieces = delay.pieces(possible)
        dynamics.measure(x, dynamics.kernel_input(pieces[0][1], time), values, work, readings[k])
        shake(readings[k], azimuth, vibration)
        states[k] = x
        ended = _why_it_ends(x)
        if ended:
            rows = k
            break
        begin = time
        for seconds, held in pieces:
            dynamics.step(x, dynamics.kernel_input(held, begin), seconds, values, work, x)
            begin += seconds
        azimuth += dt * x[16]
        if gusting:
            x[GUSTS] += level * math.sqrt(1.0 - keep * keep) * rng.standard_normal(6)
    if rows and t[rows - 1] < SHORTEST_RUN:
        raise InputError(f"maneuver {plan.name!r} ends after {t[rows - 1]:.2f} s: {ended}")
    note = f"ended at {t[rows - 1]:.2f} s: {ended}" if ended else ""
    return Track(plan, t[:rows], states[:rows], commands[:rows], readings[:rows], note)


class _SwashDelay:
    """servo_delay in a simulated flight: swash commands come late, rows are split where they do."""

    def __init__(self, values: np.ndarray, trim: np.ndarray, dt: float) -> None:
        delay = values[effects.parameter_index("servo_delay.time")]
        self.whole = int(delay / dt + 1e-9)
        self.rest = max(delay - self.whole * dt, 0.0)
        if self.rest < 1e-9:
            self.rest = 0.0
        self.dt = dt
        self.waiting = [trim[2:].copy() for _ in range(self.whole + 1)]

    def pieces(self, command: np.ndarray) -> list[tuple[float, np.ndarray]]:
        """(seconds, commands in force) that make up this row."""
        self.waiting.append(command[2:].copy())
        older, newer = self.waiting[0], self.waiting[1]
        self.waiting.pop(0)
        now = np.concatenate([command[:2], newer])
        if self.rest == 0.0:
            return [(self.dt, now)]
        return [(self.rest, np.concatenate([command[:2], older])), (self.dt - self.rest, now)]


def _why_it_ends(x: np.ndarray) -> str:
    if not np.all(np.isfinite(x)):
        return "the simulation diverged"
    if max(abs(x[10]), abs(x[11])) > _TOO_FAR:
        return "the helicopter tipped over"
    if x[15] > 0.0:
        return "the helicopter hit the ground"
    return ""


def simulate(
    vehicle: Vehicle | str,
    maneuvers: str | Maneuver | Iterable[str | Maneuver],
    *,
    sensors: str = "onboard",
    noise: bool = True,
    seed: int = 0,
    closed_loop: bool | None = None,
    gusts: Gusts | None = None,
    tremor: float = 1.0,
    dt: float = STEP,
) -> Flight:
    """Fly maneuvers and log them as the sensors see them.

    Args:
        vehicle: what `load_vehicle` takes; its effects are flown.
        maneuvers: names of `maneuvers.MANEUVERS`, or maneuvers; one run each.
        sensors: suite of `sensors.SUITES`; ``state`` logs every channel, exactly.
        noise: whether chance plays in the readings: noise, drawn bias and lost samples. Rates,
            limits and delays stay.
        seed: of noise, tremor and gusts; the same seed gives the same flight.

    Raises:
        InputError: as `fly`.
    """
    vehicle = load_vehicle(vehicle)
    suite = log_suite(sensors, vehicle)
    tracks = fly_all(
        vehicle, maneuvers, seed=seed, closed_loop=closed_loop, gusts=gusts, tremor=tremor, dt=dt
    )
    return log_flight(vehicle, tracks, suite, noise=noise, seed=seed)


def fly_all(
    vehicle: Vehicle | str,
    maneuvers: str | Maneuver | Iterable[str | Maneuver],
    *,
    seed: int = 0,
    closed_loop: bool | None = None,
    gusts: Gusts | None = None,
    tremor: float = 1.0,
    dt: float = STEP,
) -> tuple[Track, ...]:
    """The truth behind `simulate`: one track per maneuver, each with its own chance."""
    plans = [maneuvers] if isinstance(maneuvers, str | Maneuver) else list(maneuvers)
    if not plans:
        raise InputError("simulate needs at least one maneuver")
    return tuple(
        fly(vehicle, plan, seed=air, closed_loop=closed_loop, gusts=gusts, tremor=tremor, dt=dt)
        for plan, (air, _) in zip(plans, _chances(seed, len(plans)), strict=True)
    )


def log_flight(
    vehicle: Vehicle,
    tracks: Sequence[Track],
    suite: Sequence[Sensor],
    *,
    noise: bool = True,
    seed: int = 0,
) -> Flight:
    """Tracks as a flight folder holds them, seen through sensors."""
    if not noise:
        suite = [replace(sensor, noise=0.0, bias_std=0.0, dropout=0.0) for sensor in suite]
    runs = [
        _log_run(track, suite, np.random.default_rng(readings))
        for track, (_, readings) in zip(tracks, _chances(seed, len(tracks)), strict=True)
    ]
    names = [run.name for run in runs]
    for k, name in enumerate(names):
        if name in names[:k]:  # flown again
            runs[k] = replace(runs[k], name=f"{name}_{names[:k].count(name) + 1}")
    return Flight(
        vehicle=vehicle.name,
        runs=tuple(runs),
        air={"density": vehicle["air_density"].value, "gravity": vehicle["gravity"].value},
        noise={s.name: s.noise for s in suite if s.noise > 0.0},
    )


def _chances(seed: int, runs: int) -> list[list[np.random.SeedSequence]]:
    """Per run a seed for air and hands, and one for the readings."""
    if seed < 0:
        raise InputError(f"the seed should not be negative, found {seed}")
    return [source.spawn(2) for source in np.random.SeedSequence(seed).spawn(runs)]


def _log_run(track: Track, suite: Sequence[Sensor], rng: np.random.Generator) -> Run:
    """What the sensors of a suite write down of a track."""
    return Run(
        name=track.maneuver.name,
        t=track.t,
        command=track.command,
        measured=log_readings(track.readings, track.t, tuple(suite), rng),
        maneuver=track.maneuver.name,
        note=track.ended,
    )


# --- the paper's pre-flight simulation ----------------------------------------------------------


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
    """A statement of design/paper.md about the doublet, checked by flying it."""

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
    q = _euler_doublet(vehicle)[:, 4] / DEGREE
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
            (1.0, -103.0), (float(-quoted[15]), float(quoted[5] / DEGREE)), 0.06,
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
