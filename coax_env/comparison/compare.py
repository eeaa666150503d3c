"""What happened to a machine between two flights: a joint model of both, and what changed.

Data flow::

    two flights -> one problem with shared numbers, and each flight's air, battery and noise (shared.py)
        -> effects that both show (diagnosis.search) and changes (search.py), by turns
        -> evidence, alternatives, intervals -> changes.json

"The same" is an answer. What is wrong with the model is in both flights and cancels; what belongs to
air, ground, battery and pilot is each flight's own (circumstances.py) and never a change.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from coax_env.comparison.candidates import numbers, plain, scored
from coax_env.comparison.search import Changed, Weighed, alternatives, changes_found, standing
from coax_env.comparison.shared import (
    joint_problem,
    joint_start,
    parts_of,
    with_drifts,
    with_pilots,
)
from coax_env.comparison.two_flights import ROTOR_SPEED, A, B, OneFlight, read, read_two
from coax_env.comparison.two_logs.coordinates import effective
from coax_env.comparison.two_logs.difference import difference, of_one_flight
from coax_env.diagnosis.search import search
from coax_env.diagnosis.settings import SETTINGS, Settings
from coax_env.estimation.fitted_vehicle import with_timing
from coax_env.estimation.parted_engine import of_part
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.whiteness import Whiteness, whiteness
from coax_env.logs.flight import Flight
from coax_env.model import effects
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle import Vehicle
from coax_env.model.vehicle_file import load_vehicle
from coax_env.progress import Progress, reporter, shows_progress

ROUNDS = 2
"""Times that shared effects and changes are looked for by turns; ours."""


@dataclass(frozen=True)
class Comparison:
    """Result of `compare`.

    Attributes:
        changes: what changes.json holds.
        flights: both, as they were flown.
        white: flight -> channel -> whiteness of what the model leaves.
        state: the model of both; None of two logs of one flight (two_logs.py).
    """

    changes: dict[str, Any]
    flights: tuple[OneFlight, OneFlight]
    white: Mapping[str, Mapping[str, Whiteness]]
    state: Changed | None


@shows_progress("comparison")
def compare(
    a: Flight | str | Path,
    b: Flight | str | Path | None = None,
    vehicle: Vehicle | str | Path | None = None,
    progress: Progress | bool | None = None,
    settings: Settings = SETTINGS,
    waive: Collection[str] = (),
) -> Comparison:
    """What changed in a machine between two flights.

    Args:
        a: a Flight or its folder. b: the later one; None: parts "A" and "B" of `a`, by its card.
        vehicle: a Vehicle, name or path; default the cards'.
        progress: called with a line of text at every step; True: a bar on stderr.
        settings: thresholds and limits.
        waive: checks of a log with itself (consistency/) that are passed over, beside the cards'.

    Raises:
        InputError: no flight, no such parts, flights of two vehicles, or a log that contradicts itself.
    """
    report = reporter(progress)
    first, second = read(a), None if b is None else read(b)
    flights = read_two(first, second, vehicle, waive)
    if second is not None and of_one_flight(first, second):
        machine = load_vehicle(vehicle or first.vehicle)
        return Comparison(difference(first, second, machine, settings, report), flights, {}, None)
    return of_two_flights(flights, settings, report)


def of_two_flights(
    flights: tuple[OneFlight, OneFlight],
    settings: Settings = SETTINGS,
    report: Progress | None = None,
) -> Comparison:
    """As `compare`, each flight with noise of its own, whatever it is; its `state` is there.

    Args:
        flights: `read_two`.
        settings: thresholds and limits.
        report: called with a line of text at every step.
    """
    report = report or (lambda text: None)
    problem = joint_problem(flights, settings, report)
    report("estimating gusts and noise of each flight")
    fit = joint_start(problem, flights)
    state = Changed(problem, fit, (), numbers(problem, flights))
    state = changes_found(state, clearer_than_effects=True)
    for _ in range(ROUNDS):
        before = state.effects
        report("searching for what both flights show")
        fit, _ = search(state.problem, state.fit)
        state = replace(state, fit=fit)
        if not any("command_gain" in f.name for f in state.problem.added):
            problem, fit = with_pilots(state.problem, state.fit)
            state = replace(state, problem=problem, fit=fit)
        report("searching for what changed")
        state = changes_found(state)
        if set(state.effects) == set(before):
            break
    report("weighing the changes")
    state = replace(state, fit=with_drifts(state.problem, state.fit, settings))
    state, quadratic, evidence = standing(state)
    found = alternatives(state, quadratic, evidence)
    white = _whiteness(state)
    entries = _changes(state, quadratic, evidence, found)
    return Comparison(
        {
            "verdict": "changed" if entries else "same",
            "changes": entries,
            "unexplained": _unexplained(white),
            "circumstances": _circumstances(state, quadratic),
            "shared": list(state.fit.active),
            "bounds": _bounds(state, quadratic),
            "remarks": [f"{f.name}: {remark}" for f in flights for remark in f.remarks],
        },
        flights,
        white,
        state,
    )


# --- what is stated ---------------------------------------------------------------------------------


def _changes(
    state: Changed,
    quadratic: Quadratic,
    evidence: Mapping[str, Weighed],
    found: Mapping[str, Mapping[str, Changed]],
) -> list[dict[str, Any]]:
    """The changes, strongest first."""
    std = _std(state, quadratic)
    before, after = (part.values(state.fit.values) for part in parts_of(state.problem))
    dt = state.problem.row
    entries = []
    for effect in state.effects:
        was, became = (_effective(state, values, effect) for values in (before, after))
        table = {}
        for f in state.candidates[effect]:
            name = plain(f.name)
            moved = state.fit.values[f.name]
            change = became[name] - was[name]
            spread = float(std[f.name]) * math.sqrt(evidence[effect].inflation)
            if abs(moved) > 1e-9:  # an effective number's own scale
                spread *= abs(change / moved)
            table[name] = {
                "before": was[name],
                "after": became[name],
                "change": change,
                "std": with_timing(replace(f, name=name), spread, dt)
                if effect != "rotor_speed"
                else spread,
                "unit": _unit(name),
            }
        entries.append(
            {
                "effect": effect,
                "parameters": table,
                "evidence": evidence[effect].nats,
                "confusable_with": [*found[effect], *effects.found_by_the_name_of(effect)],
            }
        )
    return sorted(entries, key=lambda c: -c["evidence"])


def _std(state: Changed, quadratic: Quadratic) -> dict[str, float]:
    """Posterior std of every number that is free: an effect that neither flight shows is not there."""
    return quadratic.std(state.problem.free_names(state.fit.active))


def _effective(state: Changed, values: Mapping[str, float], effect: str) -> dict[str, float]:
    if effect == "rotor_speed":
        return {ROTOR_SPEED: values[ROTOR_SPEED]}
    return effective(state.problem, values, effect)


def _unit(name: str) -> str:
    effect, _, own = name.partition(".")
    if name == ROTOR_SPEED:
        return "1"
    return next(p.unit for p in effects.CATALOGUE[effect].parameters if p.name == own)


def _bounds(state: Changed, quadratic: Quadratic) -> dict[str, dict[str, Any]]:
    """The difference of every number, were its effect alone (beside the named ones) what changed."""
    found = {}
    for effect, group in state.candidates.items():
        score = scored(state.problem, quadratic, effect, group, inflated=True)
        for f in group:
            found[plain(f.name)] = {
                "value": score.move[f.name],
                "std": score.std[f.name] * math.sqrt(score.inflation),
                "usual": f.std,
                "unit": _unit(plain(f.name)),
                "nats": score.nats,
            }
    return found


def _whiteness(state: Changed) -> dict[str, dict[str, Whiteness]]:
    """Of each flight's innovations."""
    return {
        part.name: whiteness(
            part.engine.filter(part.values(state.fit.values), part.noise(state.fit.noise)), CHANNELS
        )
        for part in parts_of(state.problem)
    }


def _unexplained(white: Mapping[str, Mapping[str, Whiteness]]) -> list[dict[str, Any]]:
    """Channels that are coloured in the second flight and were not in the first."""
    return [
        {
            "channel": c,
            "depends_on": [],
            "share": round(w.coloured_share, 3),
            "form": "coloured since",
        }
        for c, w in white[B].items()
        if not w.white and c in white[A] and white[A][c].white
    ]


def _circumstances(state: Changed, quadratic: Quadratic) -> dict[str, Any]:
    """Air, battery and gusts of each flight: what differs and is no change of the machine."""
    std = _std(state, quadratic)
    found: dict[str, Any] = {}
    for part in parts_of(state.problem):
        noise = part.noise(state.fit.noise)
        own = {
            plain(f.name): {"value": float(state.fit.values[f.name]), "std": float(std[f.name])}
            for f in state.problem.added
            if f.name.endswith(of_part("", part.name))
            and plain(f.name)
            not in {plain(g.name) for e in state.effects for g in state.candidates[e]}
            and not f.name.startswith("command_gain")
        }
        gusts = {
            n: float(noise.process[n]) for n in ("force_xy", "force_z", "moment_xy", "moment_z")
        }
        found[part.name] = {"own": own, "gusts": gusts}
    return found
