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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.design import next_maneuver
from coax_env.design.loop_oscillation import oscillations
from coax_env.design.loop_oscillation import remark as oscillation_remark
from coax_env.diagnosis import (
    confounding,
    findings,
    log_faults,
    slow_commands,
    unlisted,
)
from coax_env.diagnosis.black_box import black_box
from coax_env.diagnosis.calibration import calibrated, class_of
from coax_env.diagnosis.corrected_vehicle import corrected_vehicle
from coax_env.diagnosis.flown_numbers import REMARK, flying_nearest
from coax_env.diagnosis.gain import TOO_SHORT, flies_worse, gain_of
from coax_env.diagnosis.input_innovations import engine_as_fitted
from coax_env.diagnosis.late_readings import with_late
from coax_env.diagnosis.model_check import model_check
from coax_env.diagnosis.preparation import Prepared, prepared
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.remarks import (
    answered_gusts,
    held_out_before,
    lost_in_noise,
    one_step_against_a_second,
    remarks,
)
from coax_env.diagnosis.searches.once import from_causes_of, given_with
from coax_env.diagnosis.searches.searched import Searched, searched
from coax_env.diagnosis.settings import SETTINGS, Settings
from coax_env.diagnosis.shocks import engine_of
from coax_env.diagnosis.trust import trusts
from coax_env.diagnosis.unseen import worth_unseen
from coax_env.diagnosis.weighing import weighed_causes
from coax_env.estimation.battery import PER_VOLT
from coax_env.estimation.changing_model import Lap, clock_of
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter_noise import sensor_std
from coax_env.estimation.prediction import RunReplay, gusts_of, replay_runs
from coax_env.estimation.state_space import Record
from coax_env.estimation.whiteness import Whiteness, whiteness
from coax_env.logs.flight import Flight, read_flight
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.progress import Progress, reporter, shows_progress


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
    log = prepared(flight, vehicle, hold_out, exclude, settings, reporter(progress), waive)
    clock = clock_of(log.flight.runs)
    first, bare, refitted = _searched(log, clock)
    held = log_faults.undone(log.held, log.problem, first)
    passes_before = first.problem.engine.filter(bare.values, bare.noise)
    weighed = weighed_causes(first, clock)
    problem, fit, quadratic, evidence, passes_after, found = weighed.settled
    flown, onsets, white = weighed.flown, weighed.onsets, weighed.white
    sensors = {c: sensor_std(log.flight, c) for c in log.flight.channels}
    own = None
    if held:
        problem.report("flying the held-out runs")
        own = engine_as_fitted(problem, held, fit)
    own_numbers = flying_nearest(first.problem, refitted) if held else refitted
    replays, gain = _gain(problem, (bare, own_numbers, flown), held, own, sensors, ceiling)
    problem.report("asking left-out runs, halves and other noise whether the names hold")
    # what began in flight may have done so after them
    unseen = worth_unseen(problem, fit, quadratic, evidence, None if onsets else own)
    swinging = oscillations(log.flight.runs)
    trust = trusts(weighed, unseen, flies_worse(gain, begun=bool(onsets)), bool(swinging))
    causes = findings.causes(weighed, trust, log.lines, log.felt)
    described = unlisted.entries(problem, flown, quadratic, passes_after, weighed.terms)
    speaking_for = unlisted.described_channels(described)
    unnamed = findings.without_a_name(evidence, trust, white)
    unexplained = described + unnamed + findings.unexplained(white, speaking_for)
    problem.report("asking whether the fitted model makes such flights")
    check = model_check(problem.as_logged, flown, passes_after)
    problem.report("refitting the corrected model on everything")
    inflations = {e: judged.inflation for e, judged in evidence.items()}
    inflations |= unlisted.inflations(problem, fit, quadratic, weighed.terms)
    held = [with_late(r, problem.late) for r in held]
    corrected = corrected_vehicle(
        problem, fit, flown, quadratic, held, inflations, log.lines, log.flight
    )
    alarms = calibrated(settings.evidence, class_of(log.flight, vehicle, fit))
    by_evidence = [c["effect"] for c in causes if c["effect"] in found]
    design = confounding.separating_maneuver(
        problem, fit, quadratic, found, by_evidence, log.flight
    )
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
        flight=log.flight,
        vehicle_before=vehicle,
        vehicle_after=corrected,
        replay_before=replays[0],
        replay_refitted=replays[1],
        replay_after=replays[2],
        innovations_before=findings.innovations(passes_before),
        innovations_after=findings.innovations(passes_after),
        whiteness={"before": whiteness(passes_before, CHANNELS), "after": dict(white)},
        evidence_history=list(fit.history),
        strongest=fit.strongest,
        problem=first.problem.with_records(first.problem.engine.records),  # no pass is kept
        refitted=refitted,
        remarks=(
            *log.remarks,
            *log_faults.remarks(log.problem, first),
            *([REMARK] if flown.values != fit.values else []),
            *([oscillation_remark(swinging)] if swinging else []),
            *remarks(problem, flown, quadratic, {e: found[e] for e in found if trust[e].named}),
            *([TOO_SHORT] if held and gain is None else []),
            *lost_in_noise(gain),
            *one_step_against_a_second(gain, replays[1], replays[2], settings),
            *answered_gusts(gain),
            *held_out_before(gain, causes, log.flight.run_names),
            *check.remarks,
        ),
        noise=sensors,
        design=design,
    )


def _searched(log: Prepared, clock: Mapping[str, Lap]) -> tuple[Searched, Fit, Fit]:
    """What the search found; the vehicle as given, and with its own numbers refitted.

    Where speeds are known to follow the battery's voltage, as a machine that does not know it flies,
    and the search begins from the causes of a search without it, too.
    """
    first = slow_commands.likelier_on_the_way(searched(log.problem, log.noise, clock))
    if log.felt is None:
        return first, first.bare, first.refitted
    log.problem.report("searching as though they did not, for causes to begin with")
    without = searched(log.problem.with_model(log.as_given), log.noise, clock)
    first = from_causes_of(first, without)
    bare, refitted = given_with(first, {PER_VOLT: 0.0}, log.noise)
    return first, bare, refitted


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
