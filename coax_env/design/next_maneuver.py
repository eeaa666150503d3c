"""Which maneuver parts descriptions that these flights cannot tell apart: designed, not looked up.

T-optimality (Atkinson and Fedorov 1975): one description flies the maneuver as the truth, another
one is fitted to what its sensors would read. What the fit leaves,

    min over the other's free numbers of  1/2 |e|^2 + 1/2 moves' known moves   [nats],

is the evidence that the flight is expected to bring; `e` are the whitened innovations of the engine
on readings without noise, `known` what earlier flights and priors say of those numbers. A maneuver's
worth is the smallest such distance over all pairs, each member taken as the truth once, and the
winner has the largest. Every maneuver is first flown with every description and is left out where it
leaves the safe envelope.
"""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.errors import InputError
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.quadratic import bounded_solve
from coax_env.estimation.state_space import FreeParameter, Noise, Record
from coax_env.files import write_text
from coax_env.logs.flight import Flight, Run, write_flight
from coax_env.model.layout import CHANNELS, RPM_PER_RAD_S, VELOCITY
from coax_env.model.vehicle import Vehicle
from coax_env.simulation.maneuvers import (
    ASKED,
    DEGREE,
    Maneuver,
    Steps,
    doublet,
    maneuver,
    pulses,
    steps_3211,
    track,
)
from coax_env.simulation.simulate import Track, fly

ROW = 0.02
"""Seconds per row of a design; a faster sensor is logged at this rate with less noise, so that it
tells as much a second."""
MOST_ALTERNATIVES = 4


# --- what may be flown ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Envelope:
    """Limits within which a maneuver must stay, whichever description is true.

    lowest, ceiling: height [m]. tilt: of roll and pitch [rad]. turning: yaw rate [rad/s]. speed:
    [m/s]. room: horizontal distance from the start [m].
    """

    lowest: float = 0.15
    ceiling: float = 5.0
    tilt: float = 35.0 * DEGREE
    turning: float = 200.0 * DEGREE
    speed: float = 4.0
    room: float = 15.0

    def breach(self, flown: Track) -> str:
        """What a simulated run leaves the envelope by, in words; empty where it stays inside."""
        height = -flown["z"]
        tilt = np.maximum(abs(flown["phi"]), abs(flown["theta"])).max()
        turning = abs(flown["r"]).max()
        speed = np.linalg.norm(flown.state[:, VELOCITY], axis=1).max()
        away = np.hypot(flown["x"] - flown["x"][0], flown["y"] - flown["y"][0]).max()
        if flown.ended:
            return flown.ended
        if height.min() < self.lowest:
            return f"sinks to {height.min():.2f} m"
        if height.max() > self.ceiling:
            return f"climbs to {height.max():.1f} m"
        if tilt > self.tilt:
            return f"tilts by {tilt / DEGREE:.0f} deg"
        if turning > self.turning:
            return f"turns at {turning / DEGREE:.0f} deg/s"
        if speed > self.speed:
            return f"reaches {speed:.1f} m/s"
        if away > self.room:
            return f"goes {away:.0f} m away"
        return ""


def candidates() -> tuple[Maneuver, ...]:
    """The set a design chooses from: about ten seconds each, with a pilot; hover first."""
    return (
        maneuver("hover", duration=10.0),
        *_on_the_swash("lon", "longitudinal", -1.0),
        *_on_the_swash("lat", "lateral", 1.0),
        *(
            _injected("heave_3211", "collective", steps_3211(size, 1.0, unit),
                      f"3-2-1-1 on both rotor speeds, {100 * size:g} %, sides of {unit:g} s")
            for size, unit in ((0.03, 0.7), (0.05, 0.7), (0.08, 0.4))
        ),
        _injected("heave_doublet", "collective", doublet(0.06, 1.0, 0.8),
                  "doublet on both rotor speeds, 6 %, 0.8 s a side"),
        *(
            _injected("yaw_3211", "differential", steps_3211(size, 1.0, unit),
                      f"3-2-1-1 on the difference of the rotor speeds, {100 * size:g} %, "
                      f"sides of {unit:g} s")
            for size, unit in ((0.03, 0.4), (0.05, 0.3))
        ),
        _injected("yaw_doublet", "differential", doublet(0.03, 1.0, 0.8),
                  "doublet on the difference of the rotor speeds, 3 %, 0.8 s a side"),
        *(
            _injected("differential_rpm", "differential", pulses(size, 1.0, 0.25, 1.75, 4),
                      f"short pulses on the difference of the rotor speeds, {100 * size:g} %")
            for size in (0.08, 0.15)
        ),
        _asked("heading_turn", "heading", _turns("0 0, 1 0, 9 4"), "a full turn on the spot"),
        _asked("heading_turn", "heading", _turns("0 0, 1 0, 2.5 1, 4 1, 5.5 2, 7 2, 8.5 3, 10 3"),
               "three quarters of a turn on the spot, a quarter at a time"),
        _asked("low_hover", "height", track("0 1, 1 1, 3 0.4, 5 0.4, 6 0.25, 8 0.25, 10 0.8"),
               "hover while stepping down to a quarter of a metre and up again"),
        _asked("climb_descend", "height", track("0 1.5, 1 1.5, 3 3.5, 4 3.5, 6 1.2, 8 2.8, 10 1.5"),
               "climb and descend at 1 m/s, twice"),
        *(
            _asked(name, axis, track(f"0 0, 1 0, {1 + speed:g} {speed:g}, 6 {speed:g}, 9 0, 10 0"),
                   f"{where} to {speed:g} m/s and stop")
            for name, axis, where in (("forward_run", "forward", "forward"),
                                      ("side_run", "right", "to the right"))
            for speed in (1.5, 3.0)
        ),
    )  # fmt: skip


def _injected(name: str, axis: str, steps: Steps, summary: str) -> Maneuver:
    return Maneuver(name, 10.0, summary, injected={axis: steps})


def _asked(name: str, quantity: str, points: Steps, summary: str) -> Maneuver:
    return Maneuver(name, 10.0, summary, asked={quantity: points}, height=points[0][1] or 1.5)


def _turns(points: str) -> Steps:
    """Points of a heading track given in quarters of a turn."""
    return [(time, quarters * 90.0 * DEGREE) for time, quarters in track(points)]


def _on_the_swash(axis: str, word: str, sign: float) -> list[Maneuver]:
    name = f"delta_{axis}"
    doublets = [
        _injected(f"{axis}_doublet", name, doublet(sign * size * DEGREE, 1.0, side),
                  f"doublet on the {word} swash, {size:g} deg, {side:g} s a side")
        for size, side in ((3.0, 1.0), (5.0, 0.5))
    ]  # fmt: skip
    steps = [
        _injected(f"{axis}_3211", name, steps_3211(sign * size * DEGREE, 1.0, unit),
                  f"3-2-1-1 on the {word} swash, {size:g} deg, sides of {unit:g} s")
        for size, unit in ((4.0, 0.5), (4.0, 0.3), (6.0, 0.3))
    ]  # fmt: skip
    return doublets + steps


# --- what is to be told apart ---------------------------------------------------------------------


@dataclass(frozen=True)
class Alternative:
    """One description that the flights allow: an extended vehicle, and how well it is known.

    name: the effect that is its own. free: parameters that may still move, bounds in. known: (k, k)
    inverse covariance of their fitted values, from the flights so far and the priors.
    """

    name: str
    vehicle: Vehicle
    free: tuple[FreeParameter, ...]
    known: np.ndarray

    @classmethod
    def of(
        cls,
        name: str,
        vehicle: Vehicle,
        free: Sequence[FreeParameter],
        values: Mapping[str, float],
        information: np.ndarray | None = None,
    ) -> "Alternative":
        """From fitted values by name.

        Args:
            vehicle: the one the effects are added to.
            information: (k, k) what flights told of the free parameters; None: priors only.
        """
        own: dict[str, dict[str, float]] = {}
        base = {}
        for f in free:
            group, _, parameter = f.name.rpartition(".")
            if group:
                own.setdefault(group, {})[parameter] = values[f.name]
            else:
                base[f.name] = values[f.name]
        extended = vehicle.with_values(base)
        for effect, table in own.items():
            extended = extended.with_effect(effect, **table)
        known = np.diag([f.std**-2.0 for f in free])
        if information is not None:
            known = known + information
        return cls(name, extended, tuple(free), known)

    def values(self, noise: Noise) -> dict[str, float]:
        """Every value of the model, gusts' memory in."""
        return {**self.vehicle.values(), "gust_memory": noise.process["memory"]}


class _FromHere(HeliModel):
    """The helicopter started from a known state, as uncertain as ever about it."""

    def __init__(self, vehicle: Vehicle, start: np.ndarray) -> None:
        super().__init__(vehicle)
        self.first = start

    def start(self, record: Record) -> tuple[np.ndarray, np.ndarray]:
        _, covariance = super().start(record)
        return self.first.copy(), covariance


def logged_rates(flight: Flight) -> dict[str, float]:
    """How often each channel of a flight was read [Hz], over the runs that have it."""
    rates = {}
    for channel in flight.channels:
        runs = [run for run in flight.runs if channel in run.measured]
        count = sum(int(np.isfinite(run.measured[channel]).sum()) for run in runs)
        rates[channel] = count / sum(run.duration for run in runs)
    return rates


def expected_information(
    flown: Track,
    vehicle: Vehicle,
    free: Sequence[FreeParameter],
    noise: Noise,
    rates: Mapping[str, float],
) -> np.ndarray:
    """What a flown maneuver is expected to tell of some numbers: the Fisher information (k, k).

    Args:
        flown: simulated with `vehicle`. noise: of gusts and readings. rates: of the channels [Hz].
    """
    noise = _for_rows(noise, rates, float(flown.t[1] - flown.t[0]))
    model = _FromHere(vehicle, flown.state[0])
    engine = Engine(model, [_as_logged(flown, rates)], threads=1)
    values = {**vehicle.values(), "gust_memory": noise.process["memory"]}
    _, lin = engine.linearise({**{f.name: f.value for f in free}, **values}, noise, free)
    return lin.information[0]


def _as_logged(flown: Track, rates: Mapping[str, float]) -> Record:
    """A simulated run as the engine gets it: no noise, each channel at its own rate."""
    z = np.full(flown.readings.shape, np.nan)
    for channel, rate in rates.items():
        i = CHANNELS.index(channel)
        new = np.diff(np.floor(flown.t * rate + 1e-6), prepend=-1.0) > 0.0
        z[new, i] = flown.readings[new, i]
    return Record(flown.maneuver.name, flown.t, flown.command, z)


def _for_rows(noise: Noise, rates: Mapping[str, float], row: float) -> Noise:
    """Noise of readings averaged over a row where they come faster than rows do."""
    reading = {c: s * math.sqrt(min(1.0, 1.0 / (row * rates.get(c, 1.0))))
               for c, s in noise.reading.items()}  # fmt: skip
    return replace(noise, reading=reading)


def distance(
    flown: Track,
    other: Alternative,
    noise: Noise,
    rates: Mapping[str, float],
) -> float:
    """How far the best that `other` can do stays from a flown truth, nats.

    Args:
        flown: the truth, simulated.
        noise: of gusts and readings. rates: of the channels aboard [Hz].
    """
    noise = _for_rows(noise, rates, float(flown.t[1] - flown.t[0]))
    model = _FromHere(other.vehicle, flown.state[0])
    engine = Engine(model, [_as_logged(flown, rates)], threads=1)
    values = other.values(noise)
    passes, lin = engine.linearise(values, noise, other.free)
    at = np.array([values[f.name] for f in other.free])
    move = bounded_solve(
        lin.information[0] + other.known,
        -lin.slope[0],
        np.array([f.lower for f in other.free]) - at,
        np.array([f.upper for f in other.free]) - at,
    )
    moved = values | dict(zip(lin.names, (at + move).tolist(), strict=True))
    unmoved = engine.frozen_cost(passes, (), values, noise)
    fitted = engine.frozen_cost(passes, (), moved, noise) + 0.5 * float(move @ other.known @ move)
    return min(unmoved, fitted)


# --- the design -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Proposal:
    """A maneuver inside the envelope.

    nats: evidence it is expected to bring for the pair it parts least; where more than two are tied
    and it cannot win, a bound from above.
    """

    maneuver: Maneuver
    nats: float


@dataclass(frozen=True)
class Design:
    """Result of `design`: maneuvers by their worth, best first, and those left out with the reason."""

    alternatives: tuple[Alternative, ...]
    ranked: tuple[Proposal, ...]
    refused: tuple[tuple[Maneuver, str], ...]

    def worth(self, name: str) -> float | None:
        """Largest expected evidence [nats] of a maneuver of that name; None where it was left out."""
        return max((p.nats for p in self.ranked if p.maneuver.name == name), default=None)


def design(
    alternatives: Sequence[Alternative],
    noise: Noise,
    rates: Mapping[str, float],
    envelope: Envelope | None = None,
    maneuvers: Sequence[Maneuver] | None = None,
) -> Design:
    """Rank maneuvers by how well they part tied descriptions.

    Args:
        alternatives: two or more; of many the first MOST_ALTERNATIVES.
        noise: of gusts and readings. rates: channels aboard, and how often each is read [Hz].
        maneuvers: to choose from; default `candidates()`.
    """
    if len(alternatives) < 2:
        raise InputError(f"a design parts two descriptions or more, found {len(alternatives)}")
    envelope = envelope or Envelope()
    chosen = tuple(alternatives[:MOST_ALTERNATIVES])
    ranked: list[Proposal] = []
    refused = []
    best = -math.inf
    for plan in candidates() if maneuvers is None else maneuvers:
        flown, why = _fly_each(chosen, plan, envelope)
        if why:
            refused.append((plan, why))
            continue
        nats = _smallest(chosen, flown, noise, rates, best)
        best = max(best, nats)
        ranked.append(Proposal(plan, nats))
    ranked.sort(key=lambda p: -p.nats)
    return Design(chosen, tuple(ranked), tuple(refused))


def _fly_each(
    alternatives: Sequence[Alternative], plan: Maneuver, envelope: Envelope
) -> tuple[list[Track], str]:
    """The maneuver flown with every description, or why it must not be."""
    flown = []
    for alternative in alternatives:
        try:
            flown.append(fly(alternative.vehicle, plan, dt=ROW))
        except InputError as error:
            return [], str(error)
        why = envelope.breach(flown[-1])
        if why:
            return [], f"{why} with {alternative.name}"
    return flown, ""


def _smallest(
    alternatives: Sequence[Alternative],
    flown: Sequence[Track],
    noise: Noise,
    rates: Mapping[str, float],
    enough: float,
) -> float:
    """Smallest distance over pairs and directions; a pair below `enough` ends the comparison."""

    def from_truth(truth: int) -> float:
        least = math.inf
        for i, other in enumerate(alternatives):
            if i != truth:
                least = min(least, distance(flown[truth], other, noise, rates))
                if least < enough:
                    break
        return least

    with ThreadPoolExecutor(2) as pool:
        return min(pool.map(from_truth, range(len(alternatives))))


# --- what is said and written ---------------------------------------------------------------------


def advise(result: Design | None, evidence: float) -> dict[str, Any] | None:
    """`next_maneuver` of findings.json (contract.md), or None without a tie.

    evidence: nats that a decision takes.
    """
    if result is None or not result.ranked:
        return None
    best = result.ranked[0]
    hover = result.worth("hover")
    said = f"{best.maneuver.summary}: expected to part them by {_nats(best.nats)} nats"
    if hover is not None and best.maneuver.name != "hover":
        said += f"; hover by {_nats(hover)}"
    if best.nats < evidence:
        said += f". No maneuver tried reaches the {evidence:g} nats that a decision takes"
        if best.nats > 0.1 * evidence:
            said += f": fly it {math.ceil(evidence / best.nats)} times"
        else:
            said += ": better sensors are needed, not another maneuver"
    return {
        "maneuver": best.maneuver.name,
        "separates": [a.name for a in result.alternatives],
        "why": said,
    }


def _nats(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.1f}"


def write_flight_card(result: Design, flight: Flight, folder: str | Path) -> Path:
    """The best maneuver as a folder to fly from.

    ``card.toml`` and the run's CSV are a flight folder that `read_flight` reads: the commands that
    the simulated pilot gave on the first description. ``asked.csv`` is for a pilot or an autopilot:
    what to hold, and what to add to his own commands.
    """
    plan = result.ranked[0].maneuver
    flown = fly(result.alternatives[0].vehicle, plan)
    run = Run(plan.name, flown.t, flown.command, {}, plan.summary, instruction(plan))
    folder = write_flight(
        Flight(flight.vehicle, (run,), air=flight.air, noise=flight.noise), folder
    )
    write_text(folder / "asked.csv", asked_csv(plan, flown))
    return folder


def instruction(plan: Maneuver) -> str:
    """What a pilot does with a planned run, for the card's note."""
    what = "hold" if plan.injected else "fly"
    added = f" and add the steps on {', '.join(plan.injected)}" if plan.injected else ""
    return (
        f"planned, not flown: {what} height, speed and heading of asked.csv{added};"
        " the commands here are those of the simulated pilot"
    )


def asked_csv(plan: Maneuver, flown: Track) -> str:
    """Time, what to hold, and what to add to the pilot's own commands, row by row."""
    units = {"height": "m", "forward": "mps", "right": "mps", "heading": "rad"}
    header = ["t_s", *(f"{name}_{units[name]}" for name in ASKED)]
    header += ["add_rpm_upper", "add_rpm_lower", "add_delta_lon_rad", "add_delta_lat_rad"]
    added = plan.injection(flown.t, flown.command[0]) * [RPM_PER_RAD_S, RPM_PER_RAD_S, 1.0, 1.0]
    rows = np.column_stack([flown.t, plan.asked_for(flown.t), added])
    lines = [",".join(f"{value:.6g}" for value in row) for row in rows.tolist()]
    return "\n".join([",".join(header), *lines]) + "\n"
