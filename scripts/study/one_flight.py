"""One flight of the study: fly it, diagnose it, judge what could have been known."""

import json
import math
import os
import tempfile
import time
import traceback
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import injector
from injector_craft import LAMA

from coax_env.diagnosis.diagnose import Diagnosis, diagnose
from coax_env.diagnosis.fits import fitted, noise_fitted, start
from coax_env.diagnosis.gain import gain_of
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.settings import SETTINGS
from coax_env.diagnosis.shocks import engine_of, in_shocks, with_shocks
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import HeliModel, record_of
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.prediction import replay_runs
from coax_env.estimation.state_space import Record
from coax_env.logs.flight import Flight, read_flight
from coax_env.model.effects import CATALOGUE
from coax_env.model.vehicle_file import load_vehicle
from study import baselines
from study.expected import catalogue_values, expected_evidence
from study.judge import OWN
from study.likelier import likelier_than_nothing
from study.plan import PlannedFlight, air_of, craft_of, size_on
from study.store import code_hash

SHOWN_FROM = 3.0
"""Thresholds that an effect of a flight of kind "many" must be expected to be worth on all its runs; a
quarter of them is held out, and two are then left."""


def fly_and_diagnose(flight: PlannedFlight, only_own: bool = False) -> dict[str, Any]:
    """The row of a flight; a failure is a row with `error`, so that the study goes on.

    One thread, since the study's workers share the cores. `only_own`: without the baselines.
    """
    os.environ["COAX_THREADS"] = "1"
    row: dict[str, Any] = {"plan": flight.as_json(), "code": code_hash()}
    try:
        with tempfile.TemporaryDirectory(prefix="coax-study-") as folder:
            return row | _result(flight, Path(folder) / "flight", only_own)
    except Exception as error:  # a crash on one flight is a result too
        where = traceback.extract_tb(error.__traceback__)[-1]
        return row | {"error": f"{type(error).__name__}: {error} ({where.name}:{where.lineno})"}


def _result(planned: PlannedFlight, folder: Path, only_own: bool) -> dict[str, Any]:
    if planned.kind == "many":
        planned, folder, truth = showing(planned, folder.parent)
    else:
        truth = hide(planned, folder)
    flight = read_flight(folder)
    start = time.perf_counter()
    result = diagnose(flight)
    seconds = time.perf_counter() - start
    findings = result.findings
    held = (findings["gain"] or {}).get("held_out", [])
    evidence, effect = result.strongest
    methods: dict[str, Any] = {
        OWN: {key: findings[key] for key in ("verdict", "causes", "unexplained")}
    }
    row = {
        "hidden": truth["hidden"],
        "values": truth["values"],
        "comparable": truth["comparable"],
        "expected": expected_evidence(planned, flight, truth, held),
        "likelier": likelier_than_nothing(result.problem, result.refitted, truth),
        "methods": methods,
        "gain": findings["gain"],
        "strongest": {"evidence": evidence if math.isfinite(evidence) else None, "effect": effect},
        "class": findings.get("class"),
        "history": result.evidence_history,
        "remarks": list(result.remarks),
        "seconds": seconds,
        "flown_s": sum(run.duration for run in flight.runs),
    }
    catalogued = [e for e in truth["hidden"] if e in CATALOGUE]
    whole_runs = bool(held) and set(held) <= set(flight.run_names) and not planned.arm
    if catalogued == truth["hidden"] and truth["hidden"] and whole_runs:
        row["true_structure"] = gain_of_the_truth(result, catalogued, truth["values"], held)
    if not only_own and not planned.arm:
        methods |= baselines.name_causes(flight)
    return json.loads(json.dumps(row, allow_nan=False))


def hide(planned: PlannedFlight, folder: Path) -> dict[str, Any]:
    """Fly the planned flight into a folder; its truth is returned and not left there.

    Where the pilot loses the helicopter, the effects are flown at four fifths of their size.
    """
    factor = 1.0
    craft = craft_of(planned)
    for _ in range(8):
        sizes = {
            e: {p: factor * v * size_on(craft, f"{e}.{p}") for p, v in t.items()}
            for e, t in planned.effects.items()
        }
        try:
            injector.fly(
                folder, sizes, gusts=air_of(planned), sensors=planned.sensors, seed=planned.seed,
                runs=planned.runs, craft=craft, pilot=planned.pilot,
                known_as=LAMA if planned.craft == "spread" else None,
                card_noise=planned.card_noise, longest=planned.longest or math.inf,
            )  # fmt: skip
        except RuntimeError:
            factor *= 0.8
            continue
        path = folder / "truth.json"
        truth = json.loads(path.read_text())
        path.unlink()
        if planned.craft == "spread":
            truth["comparable"] = _beside_the_file(truth["comparable"])
        return truth
    raise RuntimeError(f"the pilot cannot fly {planned.effects}")


def _beside_the_file(values: Mapping[str, float]) -> dict[str, float]:
    """Values of effects that no number of the vehicle's file is a part of."""
    kept = {}
    for name, value in values.items():
        effect = CATALOGUE.get(name.partition(".")[0])
        if effect is None or not effect.replaces:
            kept[name] = value
    return kept


def showing(planned: PlannedFlight, place: Path) -> tuple[PlannedFlight, Path, dict[str, Any]]:
    """The flight with those of its effects only that can be expected to show on it, all at once.

    Returns the plan, the flight's folder and its truth.
    """
    while True:
        folder = place / f"with-{len(planned.effects)}"
        truth = hide(planned, folder)
        expected = expected_evidence(planned, read_flight(folder), truth, ())
        shown = {
            effect: sizes
            for effect, sizes in planned.effects.items()
            if (expected[effect] or 0.0) > SHOWN_FROM * SETTINGS.evidence
        }
        if len(shown) == len(planned.effects):
            return planned, folder, truth
        planned = replace(planned, effects=shown)


def gain_of_the_truth(
    result: Diagnosis, hidden: list[str], values: Mapping[str, float], held: Collection[str]
) -> dict[str, Any]:
    """What the true structure removes on the same held-out runs, refitted on the same others.

    Args:
        result: of the diagnosis. hidden: the flight's true effects.
        values: of the generator, by its own names. held: names of the runs held out.
    """
    fit, engine_held = forced(result.flight, hidden, values, held)
    horizon = SETTINGS.horizon
    replayed = replay_runs(engine_held, fit.values, fit.noise, horizon)
    gain = gain_of(result.replay_before, result.replay_refitted, replayed, result.noise, horizon)
    return {key: gain[key] for key in ("error_removed_percent", "ci95")} if gain else {}


def forced(
    flight: Flight, hidden: list[str], values: Mapping[str, float], held: Collection[str]
) -> tuple[Fit, Engine]:
    """These effects fitted, from their true sizes on; and the engine of the held-out runs.

    Args:
        flight: its runs. hidden: names of the effects.
        values: of the generator, by its own names. held: names of the runs held out.
    """
    vehicle = load_vehicle(flight.vehicle).in_air(flight.air)
    model = HeliModel(vehicle)
    problem = Problem.of(model, _records(flight, held, within=False), hidden)
    fit = start(problem, starting_noise(flight, vehicle)).at(catalogue_values(values))
    fit = replace(fit, active=tuple(hidden))
    for _ in range(2):
        fit = fitted(problem, noise_fitted(problem, fit))
    if in_shocks(problem, fit):
        problem, fit = with_shocks(problem, fit)
    return fit, engine_of(problem, _records(flight, held, True), fit)


def _records(flight: Flight, held: Collection[str], within: bool) -> list[Record]:
    """Records of the held-out runs, or of the others (of all where parts of runs are held out)."""
    return [record_of(run) for run in flight.runs if (run.name in held) == within]
