"""Diagnosis: what the simulation gets wrong on measured flights, why, and what correcting it gains.

Data flow::

    flight -> runs to fit, runs held out (hold_out.py)
    runs to fit -> problem and first fit -> search -> onsets -> generic terms -> input innovations
        -> evidence -> confounded alternatives -> numbers that fly nearest, where much is coloured
        -> findings
    held-out runs -> replay with the vehicle as given, refitted, corrected -> gain with its interval
    all runs -> refit of the same structure -> corrected vehicle file

Everything that is stated about causes and gain comes from the fitted runs and the held-out runs; the
vehicle file is refitted on all runs at the end, its structure unchanged.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.consistency.agreement import refuse_disagreement
from coax_env.design import next_maneuver
from coax_env.design.loop_oscillation import oscillations
from coax_env.design.loop_oscillation import remark as oscillation_remark
from coax_env.diagnosis import (
    confounding,
    findings,
    log_faults,
    onboard_filter,
    slow_commands,
    unlisted,
)
from coax_env.diagnosis.battery import PER_VOLT, VOLTAGE, felt_voltage, stated, voltage_varies
from coax_env.diagnosis.black_box import black_box
from coax_env.diagnosis.calibration import calibrated, class_of
from coax_env.diagnosis.corrected_vehicle import corrected_vehicle, diagnosed_from
from coax_env.diagnosis.evidence import less_sure
from coax_env.diagnosis.flown_numbers import REMARK, flying_nearest, numbers_apart
from coax_env.diagnosis.gain import TOO_SHORT, flies_worse, gain_of
from coax_env.diagnosis.hold_out import check_hold_out, split
from coax_env.diagnosis.input_innovations import engine_as_fitted
from coax_env.diagnosis.late_readings import with_late
from coax_env.diagnosis.model_check import model_check
from coax_env.diagnosis.onsets.moment import moments_of
from coax_env.diagnosis.onsets.search import beside_onsets, with_onsets
from coax_env.diagnosis.problem import WEAK_OR_LATE, Fit, Problem
from coax_env.diagnosis.remarks import (
    answered_gusts,
    held_out_before,
    lost_in_noise,
    one_step_against_a_second,
    remarks,
)
from coax_env.diagnosis.searches.once import from_causes_of, given_with
from coax_env.diagnosis.searches.searched import searched
from coax_env.diagnosis.settings import SETTINGS, Settings
from coax_env.diagnosis.shock_evidence import in_own_strengths
from coax_env.diagnosis.shocks import engine_of
from coax_env.diagnosis.trust import beside_large_axes, less_sure_beside_large_numbers, trusts
from coax_env.diagnosis.unseen import worth_unseen
from coax_env.errors import InputError
from coax_env.estimation import vibration
from coax_env.estimation.changing_model import clock_of
from coax_env.estimation.engine import Engine
from coax_env.estimation.fitted_vehicle import double_counting
from coax_env.estimation.flown import flown_parts
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import sensor_std, starting_noise
from coax_env.estimation.prediction import RunReplay, gusts_of, replay_runs
from coax_env.estimation.state_space import Record
from coax_env.estimation.whiteness import Whiteness, whiteness
from coax_env.logs.fast_rows import decimated
from coax_env.logs.flight import Flight, read_flight
from coax_env.model import effects
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.progress import Progress, reporter, shows_progress

TURN = 2.0 * math.pi
SONAR = frozenset({"sonar_tilt", "sonar_scale", "sonar_delay"})
"""Effects of a height that is an echo's."""
OF_POSITION = frozenset({"frame_yaw", "marker_offset", "pose_delay", "position_spring"})
"""Effects that only a measured position shows."""
YAW = frozenset({"r", "psi"})
"""Readings of which one at least shows how the heading turns."""


@dataclass(frozen=True)
class Diagnosis:
    """Result of `diagnose`.

    Attributes:
        findings: what findings.json holds.
        vehicle_before: as given.
        vehicle_after: the corrected model, refitted on all runs.
        replay_before, replay_refitted, replay_after: held-out runs flown again with the vehicle as
            given, its own numbers refitted, and corrected.
        innovations_before, innovations_after: run -> {"t": (n,), channel: (n,) whitened}, fitted runs.
        whiteness: "before" and "after" -> channel -> whiteness of those.
        evidence_history: (move, nats) of the search.
        remarks: on data, on unusual values.
        noise: the sensors' std by channel.
        design: the maneuvers that separate the strongest confounded cause from its alternatives.
        strongest: candidate of most evidence, named or not.
        problem: what was searched for causes, readings, commands and noise as they were found.
        refitted: the model without a cause in it.
    """

    findings: dict[str, Any]
    flight: Flight
    vehicle_before: Vehicle
    vehicle_after: Vehicle
    replay_before: list[RunReplay]
    replay_refitted: list[RunReplay]
    replay_after: list[RunReplay]
    innovations_before: dict[str, dict[str, np.ndarray]]
    innovations_after: dict[str, dict[str, np.ndarray]]
    whiteness: dict[str, dict[str, Whiteness]]
    evidence_history: list[tuple[str, float]]
    remarks: tuple[str, ...] = ()
    noise: dict[str, float] = field(default_factory=dict)
    design: next_maneuver.Design | None = None
    strongest: tuple[float, str] = (-math.inf, "")
    problem: Problem | None = None
    refitted: Fit | None = None


SHARES = {
    "choosing": 0.09, "estimating": 0.13, "fitting": 0.2, "searching": 0.25,
    "asking whether something": 0.45, "weighing": 0.63, "asking which": 0.86, "flying": 0.88,
    "asking left-out": 0.91,
    "asking whether the fitted": 0.95, "refitting": 0.98,
}  # fmt: skip
"""How a step's line begins -> share of the time that has passed: means of the bundled flight, one with
nothing to find and one with three causes; of the first diagnosis in a fresh checkout compiling is more.
"""


@shows_progress("diagnosis", SHARES)
def diagnose(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    hold_out: Sequence[str] | None = None,
    exclude: Collection[str] = (),
    progress: Progress | bool | None = None,
    ceiling: bool = False,
    settings: Settings = SETTINGS,
    waive: Collection[str] = (),
) -> Diagnosis:
    """Find the causes of what a vehicle's simulation gets wrong on a flight.

    Args:
        flight: a Flight or its folder.
        vehicle: a Vehicle, name or path; default the card's.
        hold_out: names of the runs to hold out; None chooses them; empty: all data fitted, no gain.
        exclude: effects of the catalogue that must not be named.
        progress: called with a line of text at every step; True: a bar on stderr.
        ceiling: also report what a black box removes of the error, which takes half as long again.
        settings: thresholds and limits; a calibrated false alarm rate is that of the default.
        waive: checks of the log with itself (consistency/) that are passed over, beside the card's.

    Raises:
        InputError: a run or effect that does not exist, a log that contradicts itself, or nothing left
            to fit.
    """
    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    vehicle = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    flight.select(hold_out or ())
    check_hold_out(hold_out, flight.run_names)
    flight = flown_parts(flight, vehicle)
    passed_over = refuse_disagreement(flight, vehicle, waive)
    lines, calm, calm_vehicle = (
        ((), flight, vehicle) if "vibration" in exclude else vibration.calmed(flight, vehicle)
    )
    circular = onboard_filter.of_onboard_filter(calm.runs)
    flight, calm = decimated(flight), decimated(calm)
    new_lines = lines if "vibration" not in vehicle.effects else ()
    model = HeliModel(vehicle, stated(flight, vehicle))
    noise = starting_noise(calm, calm_vehicle)
    candidates = namable(exclude, vehicle, flight)
    report = reporter(progress)
    report("choosing the runs to hold out")
    records = [record_of(run) for run in calm.runs]
    of_sensors = []
    if circular:
        of_sensors.append(onboard_filter.remark())
        records = onboard_filter.read_seldom(records, CHANNELS)
    used, held = split(model, records, noise, hold_out, candidates, settings)
    fitted_on = flight.select(r.whole for r in used)
    model = given = HeliModel(vehicle, stated(fitted_on, vehicle))
    felt = felt_voltage(fitted_on, vehicle) if VOLTAGE in candidates else None
    if felt is not None and felt.is_shown(settings.evidence):
        report("speeds follow the battery's voltage, by the felt thrust")
        model = HeliModel(felt.known(vehicle, diagnosed_from(flight)))
        candidates = tuple(e for e in candidates if e != VOLTAGE)
    else:
        felt = None

    between = slow_commands.between_known(used)
    if between > settings.unknown_commands:
        of_sensors.append(slow_commands.of_seldom(between))
        candidates = tuple(e for e in candidates if e not in WEAK_OR_LATE)
    problem = Problem.of(model, used, candidates, settings, report)
    problem = replace(problem, of_onboard_filter=circular, between_commands=between)
    clock = clock_of(flight.runs)
    first = slow_commands.likelier_on_the_way(searched(problem, noise, clock))
    if felt is not None:
        report("searching as though they did not, for causes to begin with")
        first = from_causes_of(first, searched(problem.with_model(given), noise, clock))
    of_sensors += log_faults.remarks(problem, first)
    held = log_faults.undone(held, problem, first)
    problem, bare, refitted = first.problem, first.bare, first.refitted
    if felt is not None:
        bare, refitted = given_with(first, {PER_VOLT: 0.0}, noise)
    passes_before = problem.engine.filter(bare.values, bare.noise)
    state = first.changing or with_onsets(
        problem, first.fit, first.quadratic, first.refitted, clock
    )
    problem, fit, quadratic, terms = unlisted.explain(state.problem, state.fit, state.quadratic)
    report("weighing the causes against their confounded alternatives")
    problem, fit, quadratic, evidence, passes_after, found = confounding.settled(
        beside_large_axes(problem, fit), fit
    )
    evidence = in_own_strengths(problem, fit, evidence)
    white = {
        "before": whiteness(passes_before, CHANNELS),
        "after": whiteness(passes_after, CHANNELS),
    }
    onsets = moments_of(problem, fit, quadratic, evidence, state.onsets)
    fit = confounding.beside_alternatives(problem, fit, quadratic, evidence, found)
    fit = confounding.beside_undecided(problem, fit, quadratic, evidence)
    fit = less_sure_beside_large_numbers(problem, fit, quadratic, evidence)
    if circular:
        fit = less_sure(problem, fit, quadratic, evidence, onboard_filter.followed(problem, fit))
    if not onsets:
        fit = slow_commands.beside_straight_lines(problem, fit, quadratic, evidence)
    found |= beside_onsets(problem, fit, evidence, white["after"], onsets)
    report("asking which numbers fly nearest")
    flown = flying_nearest(problem, fit)
    flown = less_sure(problem, flown, quadratic, evidence, numbers_apart(fit, flown))
    sensors = {c: sensor_std(flight, c) for c in flight.channels}
    own = None
    if held:
        problem.report("flying the held-out runs")
        own = engine_as_fitted(problem, held, fit)
    own_numbers = flying_nearest(first.problem, refitted) if held else refitted
    replays, gain = _gain(problem, (bare, own_numbers, flown), held, own, sensors, ceiling)
    report("asking left-out runs, halves and other noise whether the names hold")
    # what began in flight may have done so after them
    unseen = worth_unseen(problem, fit, quadratic, evidence, None if onsets else own)
    worse = flies_worse(gain, begun=bool(onsets))
    swinging = oscillations(flight.runs)
    trust = trusts(
        problem, fit, quadratic, evidence, found, white["after"], onsets, unseen, worse,
        bool(swinging), flown,
    )  # fmt: skip
    causes = findings.causes(
        problem, flown, quadratic, evidence, found, trust, new_lines, onsets, felt
    )
    described = unlisted.entries(problem, flown, quadratic, passes_after, terms)
    speaking_for = unlisted.described_channels(described)
    unnamed = findings.without_a_name(evidence, trust, white["after"])
    unexplained = described + unnamed + findings.unexplained(white["after"], speaking_for)
    report("asking whether the fitted model makes such flights")
    check = model_check(problem.as_logged, flown, passes_after)
    report("refitting the corrected model on everything")
    inflations = {e: weighed.inflation for e, weighed in evidence.items()}
    inflations |= unlisted.inflations(problem, fit, quadratic, terms)
    held = [with_late(r, problem.late) for r in held]
    corrected = corrected_vehicle(
        problem, fit, flown, quadratic, held, inflations, new_lines, flight
    )
    alarms = calibrated(settings.evidence, class_of(flight, vehicle, fit))
    by_evidence = [c["effect"] for c in causes if c["effect"] in found]
    design = confounding.separating_maneuver(problem, fit, quadratic, found, by_evidence, flight)
    return Diagnosis(
        findings={
            "verdict": findings.verdict(causes, unexplained),
            "causes": causes,
            "gusts": gusts_of(fit.noise, fit.values),
            "noise": findings.noise_levels(fit.noise),
            "unexplained": unexplained,
            "gain": gain,
            "next_maneuver": next_maneuver.advise(design, settings.evidence)
            or confounding.turn_that_tells(causes),
            "false_alarm_rate": alarms.rate,
            "class": alarms.entry,
            "model_check": check.entry,
        },
        flight=flight,
        vehicle_before=vehicle,
        vehicle_after=corrected,
        replay_before=replays[0],
        replay_refitted=replays[1],
        replay_after=replays[2],
        innovations_before=findings.innovations(passes_before),
        innovations_after=findings.innovations(passes_after),
        whiteness=white,
        evidence_history=list(fit.history),
        strongest=fit.strongest,
        problem=first.problem.with_records(first.problem.engine.records),  # no pass is kept
        refitted=refitted,
        remarks=(
            *flight.notes,
            *passed_over,
            *double_counting(flight, vehicle),
            *([vibration.remark(lines)] if lines else []),
            *of_sensors,
            *([REMARK] if flown.values != fit.values else []),
            *([oscillation_remark(swinging)] if swinging else []),
            *remarks(problem, flown, quadratic, {e: found[e] for e in found if trust[e].named}),
            *([TOO_SHORT] if held and gain is None else []),
            *lost_in_noise(gain),
            *one_step_against_a_second(gain, replays[1], replays[2], settings),
            *answered_gusts(gain),
            *held_out_before(gain, causes, flight.run_names),
            *check.remarks,
        ),
        noise=sensors,
        design=design,
    )


def namable(exclude: Collection[str], vehicle: Vehicle, flight: Flight) -> tuple[str, ...]:
    """Effects that may be named: not excluded, not in the vehicle yet, and with their sensor aboard.

    Of sag by time and by voltage the one, of what goes by another's name the other.

    Args:
        exclude: effects of the catalogue.
        vehicle: as given.
        flight: whose channels are aboard.

    Raises:
        InputError: an effect to exclude that does not exist.
    """
    for name in exclude:
        if name not in effects.CATALOGUE:
            known = ", ".join(effects.CATALOGUE)
            raise InputError(f"no effect {name!r} to exclude; the catalogue has {known}")
    absent = set(exclude) | set(vehicle.effects) | _without_sensor(flight)
    absent.add("battery_sag" if voltage_varies(flight) else "battery_voltage")
    return tuple(
        e
        for e, entry in effects.CATALOGUE.items()
        if e not in absent and not entry.line and not entry.named_as
    )


def _without_sensor(flight: Flight) -> frozenset[str]:
    """Effects of readings that the flight does not have, or that another effect stands for.

    What only turns the heading is none where neither that nor its rate is read: velocities show where
    gusts have turned it, and four of four **synthetic** flights had a yaw inertia of 20 to 32 nats.
    Where a position is aboard, the height comes with it; where no gyro is either, so does the heading.
    Without a position a late attitude and a late pose are one effect.
    """
    tracked, gyros = {"pn", "pe"} <= set(flight.channels), {"p", "q", "r"} & set(flight.channels)
    absent = SONAR if tracked else OF_POSITION
    if YAW.isdisjoint(flight.channels):
        absent |= {e for e, entry in effects.CATALOGUE.items() if YAW.issuperset(entry.channels)}
    blind = (tracked and not gyros) or not _turns(flight)
    return absent | {"magnetic_field"} if blind else absent


def _turns(flight: Flight) -> bool:
    """Whether the headings of all runs together cover more than a quarter turn."""
    headings = [run.measured["psi"] for run in flight.runs if "psi" in run.measured]
    if not headings:
        return False
    around = np.sort(np.mod(np.concatenate(headings), TURN))
    around = around[np.isfinite(around)]
    gaps = np.diff(around, append=around[:1] + TURN)
    return bool(gaps.size) and TURN - float(gaps.max()) > TURN / 4.0


def _gain(
    problem: Problem,
    fits: tuple[Fit, Fit, Fit],
    held: Sequence[Record],
    own: Engine | None,
    sensors: Mapping[str, float],
    ceiling: bool,
) -> tuple[list[list[RunReplay]], dict[str, Any] | None]:
    """Replays of the held-out runs by the bare, refitted and corrected model, and the gain.

    Each by the very filter that was fitted, input innovations included: `own`; none is held out
    where that is None.
    """
    if own is None:
        return [[], [], []], None
    horizon = problem.settings.horizon
    bare, refitted, fit = fits
    before, own_numbers = (
        replay_runs(engine_of(problem, held, given), given.values, given.noise, horizon)
        for given in (bare, refitted)
    )
    after = replay_runs(own, fit.values, fit.noise, horizon, floor=True)
    flexible: list[RunReplay] = []
    if ceiling:
        problem.report("fitting a black box, for comparison")
        box = black_box(problem, refitted)
        flexible = replay_runs(engine_of(problem, held, box), box.values, box.noise, horizon)
    gain = gain_of(before, own_numbers, after, sensors, horizon, flexible)
    if gain is not None:
        gain["held_out"] = list(dict.fromkeys(r.whole for r in held))
    return [before, own_numbers, after], gain
