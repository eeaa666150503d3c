"""Planning a flight: which maneuvers, in which order, to learn a vehicle's numbers best.

The purpose of the paper's section III, taken further. Data flow::

    candidates (next_maneuver.py) and multisines -> flown with the vehicle and with draws of it
        -> outside the envelope: left out, and why -> expected information of each
        -> picked one by one, each the most informative beside those picked -> flight card

What is gained is the sum of the logarithms of the wanted numbers' std (all of them alike, whatever
their units: the log determinant of what is left beside the others, D_s-optimality, Atkinson and
Donev 1992, where numbers come in ties).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from coax_env.design.candidates import Envelope, candidates, flown_inside
from coax_env.design.discrimination import expected_information
from coax_env.design.flight_card import asked_csv, instruction
from coax_env.errors import InputError
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.helicopter_noise import (
    LEAST_READING_STD,
    MEMORIES,
    starting_noise,
    still_air,
)
from coax_env.estimation.state_space import FreeParameter, Noise
from coax_env.files import write_text
from coax_env.logs.flight import Flight, Run, write_flight
from coax_env.model.effects import CATALOGUE
from coax_env.model.sensors import log_suite
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.progress import Progress
from coax_env.simulation.maneuvers import AXES, DEGREE, Maneuver
from coax_env.simulation.multisine import multisines, steps
from coax_env.simulation.simulate import Gusts, Track

DRAWS = 5
"""Vehicles drawn from the file's spread that must stay inside the envelope too."""
LENGTH = 10.0
"""Seconds of a multisine."""
SIZES = {"collective": 0.04, "differential": 0.02, "delta_lon": 3.0 * DEGREE,
         "delta_lat": 3.0 * DEGREE}  # fmt: skip


@dataclass(frozen=True)
class PlannedRun:
    """A maneuver of the plan, simulated. gain: nats by which it narrows the wanted numbers."""

    maneuver: Maneuver
    flown: Track
    gain: float


@dataclass(frozen=True)
class FlightPlan:
    """Result of `plan_flight`.

    wanted: names of the numbers to learn. std_before, std_after: of each, expected. refused: maneuvers
    left out, and why. sensors: suite that is to be logged.
    """

    vehicle: Vehicle
    runs: tuple[PlannedRun, ...]
    wanted: tuple[str, ...]
    std_before: Mapping[str, float]
    std_after: Mapping[str, float]
    refused: tuple[tuple[Maneuver, str], ...]
    sensors: str


def plan_flight(
    vehicle: Vehicle | str | Path,
    learn: Collection[str] = (),
    runs: int = 8,
    sensors: str = "onboard",
    envelope: Envelope | None = None,
    gusts: Gusts | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> FlightPlan:
    """The maneuvers that are expected to determine a vehicle's numbers best.

    Args:
        vehicle: a Vehicle, name or path.
        learn: names of base parameters, of effects (all their parameters), or ``effect.parameter``;
            none: every base parameter with a std.
        runs: how many maneuvers.
        sensors: suite of `sensors.SUITES`, as it will be logged.
        gusts: of the air on the day; None: still.
        envelope: that every maneuver must stay in, whichever vehicle of the spread is true.
        seed: of the draws.
        progress: called with a line of text.

    Raises:
        InputError: nothing of that name to learn, or no maneuver stays inside the envelope.
    """

    report = progress or (lambda text: None)
    if runs < 1:
        raise InputError(f"a plan needs one run at least, found {runs}")
    vehicle = load_vehicle(vehicle)
    model = HeliModel(vehicle)
    free, wanted = _to_learn(model, learn)
    envelope = envelope or Envelope()
    rng = np.random.default_rng(seed)
    spread = [vehicle.draw(rng) for _ in range(DRAWS)]
    safe: list[tuple[Maneuver, Track]] = []
    refused = []
    options = (*candidates(), *multisine_maneuvers())
    for k, option in enumerate(options):
        report(f"flying {option.name} ({k + 1} of {len(options)})")
        flown, why = _safe(vehicle, spread, option, envelope)
        if flown is None:
            refused.append((option, why))
        else:
            safe.append((option, flown))
    if not safe:
        raise InputError(f"no maneuver stays inside the envelope: {refused[0][1]}")
    information = _information(safe, vehicle, free, sensors, gusts)
    index = np.array([k for k, f in enumerate(free) if f.name in wanted])
    picked, known = _pick(safe, information, np.diag([f.std**-2 for f in free]), index, runs)
    after = np.sqrt(np.diag(np.linalg.inv(known)))
    return FlightPlan(
        vehicle,
        tuple(picked),
        tuple(wanted),
        {f.name: f.std for f in free},
        {f.name: float(s) for f, s in zip(free, after, strict=True)},
        tuple(refused),
        sensors,
    )


def _information(
    safe: Sequence[tuple[Maneuver, Track]],
    vehicle: Vehicle,
    free: Sequence[FreeParameter],
    sensors: str,
    gusts: Gusts | None,
) -> list[np.ndarray]:
    """Information expected of each maneuver on the free parameters, (k, k) each."""
    suite = log_suite(sensors, vehicle)
    rates = {s.name: s.rate for s in suite}
    noise = _air(starting_noise(Flight(vehicle.name, ()), vehicle), gusts)
    noise = replace(noise, reading={s.name: max(s.noise, LEAST_READING_STD[s.name]) for s in suite})
    return [expected_information(flown, vehicle, free, noise, rates) for _, flown in safe]


def _pick(
    safe: Sequence[tuple[Maneuver, Track]],
    information: Sequence[np.ndarray],
    known: np.ndarray,
    index: np.ndarray,
    runs: int,
) -> tuple[list[PlannedRun], np.ndarray]:
    """Maneuvers one by one, each the most informative on the numbers at `index` beside those before.

    Returns:
        the maneuvers, and the information `known` (k, k) with theirs.
    """
    picked = []
    for _ in range(runs):
        before = _uncertainty(known, index)
        gains = [before - _uncertainty(known + more, index) for more in information]
        best = int(np.argmax(gains))
        known = known + information[best]
        picked.append(PlannedRun(*safe[best], float(gains[best])))
    return picked, known


def multisine_maneuvers() -> tuple[Maneuver, ...]:
    """Multisines on all four inputs at once, at half and at full size, with a pilot."""
    waves = multisines(len(AXES), LENGTH)
    return tuple(
        Maneuver(
            "multisine",
            LENGTH + 2.0,
            f"orthogonal multisines on all four inputs, {100 * part:.0f} % of full size",
            injected={
                axis: steps(wave, part * SIZES[axis], 1.0)
                for axis, wave in zip(AXES, waves.T, strict=True)
            },
        )
        for part in (0.5, 1.0)
    )


def _air(noise: Noise, gusts: Gusts | None) -> Noise:
    """Noise with the gusts of the day, and in still air what no model is without."""
    if gusts is None:
        return still_air(noise)
    force, moment = gusts.force_N, gusts.moment_Nm
    levels = {"force_xy": force[0], "force_z": force[2], "moment_xy": moment[0],
              "moment_z": moment[2], **dict.fromkeys(MEMORIES, gusts.memory_s)}  # fmt: skip
    return still_air(noise).with_levels(levels)


def _to_learn(model: HeliModel, learn: Collection[str]) -> tuple[list[FreeParameter], list[str]]:
    """Everything that is free, and the names of what is wanted of it."""
    free = model.base_parameters()
    if not learn:
        return free, [f.name for f in free]
    wanted: list[str] = []
    for name in learn:
        effect = name.partition(".")[0]
        if any(f.name == name for f in free):
            wanted.append(name)
        elif effect in CATALOGUE and not CATALOGUE[effect].line:
            own = model.effect_parameters(effect)
            names = [f.name for f in own if name in (effect, f.name)]
            if not names:
                raise InputError(f"effect {effect!r} has no parameter {name.partition('.')[2]!r}")
            if all(f.name != own[0].name for f in free):
                # about the usual size: at its off-value a lag or a shape has no slope
                free += [replace(f, value=f.value + 0.5 * f.std, probe=0.0) for f in own]
            free = [f for f in free if f.name not in CATALOGUE[effect].replaces]
            wanted += names
        else:
            known = ", ".join(f.name for f in model.base_parameters())
            raise InputError(
                f"nothing called {name!r} to learn; there are {known}, and the catalogue's effects"
            )
    return free, list(dict.fromkeys(wanted))


def _safe(
    vehicle: Vehicle, spread: Sequence[Vehicle], option: Maneuver, envelope: Envelope
) -> tuple[Track | None, str]:
    """The maneuver flown with the vehicle, or why it must not be."""
    first: Track | None = None
    for k, one in enumerate([vehicle, *spread]):
        whose = " with a vehicle drawn from the spread" if k else ""
        flown, why = flown_inside(one, option, envelope, whose)
        if flown is None:
            return None, why
        first = first or flown
    return first, ""


def _uncertainty(known: np.ndarray, index: np.ndarray) -> float:
    """Half the log determinant of the wanted numbers' covariance, nats."""
    covariance = np.linalg.inv(known)[np.ix_(index, index)]
    return 0.5 * float(np.linalg.slogdet(covariance)[1])


def write_plan(plan: FlightPlan, folder: str | Path) -> Path:
    """The plan as a folder to fly from: a flight folder with the simulated pilot's commands, and for
    each run ``asked_N.csv`` with what to hold and what to add."""
    suite = log_suite(plan.sensors, plan.vehicle)
    runs = []
    for k, planned in enumerate(plan.runs, 1):
        flown, option = planned.flown, planned.maneuver
        runs.append(
            Run(
                f"{k:02d}_{option.name}",
                flown.t,
                flown.command,
                {},
                option.summary,
                instruction(option),
            )
        )
    flight = Flight(
        plan.vehicle.name,
        tuple(runs),
        air={
            "density": plan.vehicle["air_density"].value,
            "gravity": plan.vehicle["gravity"].value,
        },
        noise={s.name: s.noise for s in suite if s.noise > 0.0},
    )
    folder = write_flight(flight, folder)
    for k, planned in enumerate(plan.runs, 1):
        write_text(folder / f"asked_{k:02d}.csv", asked_csv(planned.maneuver, planned.flown))
    return folder
