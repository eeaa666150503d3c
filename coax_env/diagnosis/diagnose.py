"""Diagnosis: what the simulation gets wrong on measured flights, why, and what mending it is worth.

Data flow::

    flight -> runs to fit, runs held out (chosen from commands and signatures, never from residuals)
    fit runs -> noise levels -> search (search.py) -> causes -> evidence, look-alikes
    held-out runs -> replay with the vehicle as given, refitted, extended -> gain with its interval
    all runs -> refit of the same structure -> extended vehicle file

Everything that is said about causes and gain comes from the fit runs and the held-out runs; the
vehicle file is refitted on all runs at the end, its structure unchanged.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from coax_env.design import next_maneuver
from coax_env.diagnosis import closed_loop, unlisted, vibration
from coax_env.diagnosis.calibration import false_alarm_rate
from coax_env.diagnosis.gain import gain_of
from coax_env.diagnosis.search import EVIDENCE, TIE, Search, State, Weight, together
from coax_env.errors import InputError
from coax_env.estimation.fit import Engine, RunPass, objective, part
from coax_env.estimation.fitted_vehicle import (
    double_counting,
    fitted_vehicle,
    median_step,
    with_timing,
)
from coax_env.estimation.helicopter import (
    BUFFET_LEVELS,
    FARTHEST,
    UNUSUAL,
    HeliModel,
    record_of,
    sensor_std,
    starting_noise,
)
from coax_env.estimation.prediction import RunReplay, fly_again, gusts_of
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise, Record
from coax_env.estimation.whiteness import Whiteness, whiteness
from coax_env.logs.flight import Flight, read_flight
from coax_env.model import effects
from coax_env.model.layout import CHANNELS
from coax_env.model.vehicle import Parameter, Vehicle
from coax_env.model.vehicle_file import load_vehicle

HORIZON = 1.0  # s
CALM = 5.0  # times the floor of a white level under which it is not worth a word
FAR = 5.0
"""Standard deviations that an unseen effect must move a number to be worth a word."""
MOST_WARNINGS = 3
FEW_RUNS = 4  # with fewer, the last third of each is held out
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Diagnosis:
    """Result of `diagnose`.

    findings: what findings.json says (contract.md). vehicle_after: the extended model, refitted on
    all runs. replay_before, replay_refitted, replay_after: held-out runs flown again with the vehicle
    as given, its base parameters refitted, and extended. innovations_before, innovations_after: run ->
    {"t": (n,), channel: (n,) whitened}, fit runs. remarks: on data and on unusual values. design: the
    maneuvers that part the strongest cause from its look-alikes; None without any.
    strongest: candidate of most evidence, named or not (search.py).
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


def diagnose(
    flight: Flight | str | Path,
    vehicle: Vehicle | str | Path | None = None,
    hold_out: Sequence[str] | None = None,
    exclude: Collection[str] = (),
    progress: Progress | None = None,
    ceiling: bool = False,
) -> Diagnosis:
    """Find the causes of what a vehicle's simulation gets wrong on a flight.

    Args:
        flight: a Flight or its folder. vehicle: a Vehicle, name or path; default the card's.
        hold_out: names of the runs to hold out; None chooses them; empty: all data fitted, no gain.
        exclude: effects of the catalogue that must not be named. ceiling: also say what a black box
            removes of the error, which takes half as long again.

    Raises:
        InputError: a run or effect that does not exist, or nothing left to fit.
    """

    def say(text: str) -> None:
        if progress:
            progress(text)

    flight = flight if isinstance(flight, Flight) else read_flight(flight)
    vehicle = load_vehicle(vehicle or flight.vehicle).in_air(flight.air)
    remarks = list(flight.notes) + double_counting(flight, vehicle)
    model = HeliModel(vehicle)
    candidates = namable(exclude, vehicle, flight)
    for name in hold_out or ():
        flight.run(name)
    if hold_out and set(hold_out) == set(flight.run_names):
        raise InputError("all runs are held out: nothing is left to fit on")
    line = vibration.find(flight) if "vibration" not in exclude else None
    calm = vibration.taken_out(flight, line) if line else flight
    if line:
        remarks.append(_taken_out(line))
    new_line = line if "vibration" not in vehicle.effects else None
    noise = starting_noise(calm, vibration.without(vehicle) if line else vehicle)
    records = [record_of(run) for run in calm.runs]
    sensors = {c: sensor_std(calm, c) for c in flight.channels}
    say("choosing the runs to hold out")
    fit, held = _split(model, records, noise, hold_out, candidates)

    say("estimating gusts and noise of the model as given")
    engine = Engine(model, fit)
    search = Search(engine, model, candidates, progress)
    bare = search.begin(noise)
    passes_before = engine.filter(bare.values, bare.noise)
    say("fitting the model's own parameters")
    refitted = search.refit_noise(search.settle(replace(bare, values=dict(bare.values))))
    say("searching for causes")
    state, quadratic = search.run(
        State([], dict(refitted.values), refitted.noise, refitted.objective)
    )
    state, quadratic, terms = unlisted.explain(search, state, quadratic)
    say("weighing the causes against their look-alikes")
    closed_loop.listen(search, state)
    state, quadratic, weights = search.prune(state)
    passes_after = engine.filter(state.values, state.noise)
    white_before = whiteness(passes_before, CHANNELS)
    white_after = whiteness(passes_after, CHANNELS)
    causes, ties = _causes(search, state, quadratic, weights, white_after)
    if new_line:
        causes = sorted([*causes, _vibration(new_line)], key=lambda c: -c["evidence"])
    described = unlisted.entries(search, state, quadratic, passes_after, terms)
    unexplained = described + _unexplained(white_after, unlisted.speaks_for(described))

    replays: list[list[RunReplay]] = [[], [], []]
    gain = None
    if held:
        say("flying the held-out runs")
        engine_held = Engine(model, held)
        replays = [
            fly_again(engine_held, s.values, s.noise, HORIZON, floor=s is state)
            for s in (bare, refitted, state)
        ]
        boxed: list[RunReplay] = []
        if ceiling:
            say("fitting a black box, for comparison")
            box = unlisted.black_box(search, refitted)
            boxed = fly_again(engine_held, box.values, box.noise, HORIZON)
        gain = gain_of(replays[0], replays[1], replays[2], sensors, HORIZON, boxed)
        gain["held_out"] = [r.name for r in held]
    say("refitting the extended model on everything")
    colours = {effect: weight.colour for effect, weight in weights.items()}
    colours |= unlisted.colours(search, state, quadratic, terms)
    vehicle_after = _extended(search, state, quadratic, held, flight, vehicle, colours)
    design = _design(search, state, quadratic, ties, flight, say)
    if new_line:
        amplitude = Parameter(new_line.amplitude, new_line.std, "m/s2", _diagnosed(flight))
        vehicle_after = vehicle_after.with_parameters({"vibration.amplitude": amplitude})
    findings = {
        "verdict": _verdict(bool(causes), bool(unexplained)),
        "causes": causes,
        "gusts": gusts_of(state.noise),
        "unexplained": unexplained,
        "gain": gain,
        "next_maneuver": next_maneuver.advise(design, EVIDENCE),
        "false_alarm_rate": false_alarm_rate(EVIDENCE),
    }
    return Diagnosis(
        findings=findings,
        flight=flight,
        vehicle_before=vehicle,
        vehicle_after=vehicle_after,
        replay_before=replays[0],
        replay_refitted=replays[1],
        replay_after=replays[2],
        innovations_before=_innovations(passes_before),
        innovations_after=_innovations(passes_after),
        whiteness={"before": white_before, "after": white_after},
        evidence_history=search.history,
        strongest=search.strongest,
        remarks=tuple(
            remarks
            + _shaken(state)
            + _unusual(search, state)
            + _rest_on(search, state, quadratic, ties)
        ),
        noise=sensors,
        design=design,
    )


# --- what to fit on ---------------------------------------------------------------------------------


def namable(exclude: Collection[str], vehicle: Vehicle, flight: Flight) -> tuple[str, ...]:
    """Effects that may be named: not excluded, not in the vehicle yet, and with their sensor aboard."""
    for name in exclude:
        if name not in effects.CATALOGUE:
            known = ", ".join(effects.CATALOGUE)
            raise InputError(f"no effect {name!r} to exclude; the catalogue has {known}")
    absent = set(exclude) | set(vehicle.effects)
    if "pn" in flight.channels:  # height then comes with the position, not from a sonar
        absent |= {"sonar_tilt", "sonar_scale", "sonar_delay"}
    return tuple(e for e, entry in effects.CATALOGUE.items() if e not in absent and not entry.line)


def _split(
    model: HeliModel,
    records: Sequence[Record],
    noise: Noise,
    hold_out: Sequence[str] | None,
    candidates: Sequence[str],
) -> tuple[list[Record], list[Record]]:
    """Records to fit and records to hold out."""
    if hold_out is not None:
        return (
            [r for r in records if r.name not in hold_out],
            [r for r in records if r.name in hold_out],
        )
    if len(records) < FEW_RUNS:
        return [_third(r, False) for r in records], [_third(r, True) for r in records]
    chosen = _fair_share(model, records, noise, candidates)
    return (
        [r for i, r in enumerate(records) if i not in chosen],
        [r for i, r in enumerate(records) if i in chosen],
    )


def _third(record: Record, last: bool) -> Record:
    cut = record.t[0] + (record.t[-1] - record.t[0]) * 2.0 / 3.0
    rows = record.t >= cut if last else record.t < cut
    return replace(part(record, rows), name=f"{record.name} (last third)" if last else record.name)


def _fair_share(
    model: HeliModel, records: Sequence[Record], noise: Noise, candidates: Sequence[str]
) -> tuple[int, ...]:
    """The quarter of the runs that holds out about a quarter of what is known of each effect.

    Information is that of each effect's first parameter, and of a moment that follows the heading,
    about the vehicle as given and with the starting noise, so that no residual has a say. An effect
    that would lose most of its excitation counts heavily; one that the held-out runs do not show at
    all counts too, since its gain could not be measured on them.
    """
    free = [model.effect_parameters(e)[0] for e in candidates] + unlisted.excitations()
    values = {**model.bare_values, **{f.name: f.value for f in free}}
    _, lin = Engine(model, records).linearise(values, noise, free)
    information = np.einsum("rkk->rk", lin.information)
    total = information.sum(0)
    share = information[:, total > 0.0] / total[total > 0.0]
    count = max(1, round(len(records) / 4))

    def unfairness(chosen: tuple[int, ...]) -> float:
        held = share[list(chosen)].sum(0)
        lost, unseen = np.maximum(held - 0.7, 0.0), np.maximum(0.1 - held, 0.0)
        return float(np.sum((held - 0.25) ** 2) + 10.0 * np.sum(lost + unseen))

    return min(combinations(range(len(records)), count), key=unfairness)


# --- causes -----------------------------------------------------------------------------------------


def _causes(
    search: Search,
    state: State,
    quadratic: Quadratic,
    weights: Mapping[str, Weight],
    white: Mapping[str, Whiteness],
) -> tuple[list[dict[str, Any]], dict[str, dict[str, State]]]:
    """Entries of findings.json, strongest first, and the refits with each one's look-alikes."""
    free = search.free_names(state.active)
    std = dict(zip(free, np.sqrt(np.diag(quadratic.covariance(free))), strict=True))
    dt = median_step(search.engine.records)
    channels = {effect: _channels(search, state, quadratic, effect) for effect in state.active}

    def look_alikes(effect: str) -> dict[str, State]:
        inflations = (white[c].inflation for c in channels[effect])
        colour = max([weights[effect].colour, *inflations])
        return _look_alikes(search, state, quadratic, effect, colour, weights[effect].lost)

    ties = search.for_each(look_alikes, state.active)
    causes: list[dict[str, Any]] = []
    for effect in state.active:
        entry = effects.CATALOGUE[effect]
        weight = weights[effect]
        causes.append(
            {
                "effect": effect,
                "parameters": {
                    f.name: {
                        "value": float(state.values[f.name]),
                        "std": _believed(state, f, std[f.name], weight.colour, dt),
                        "unit": p.unit,
                    }
                    for f, p in zip(search.by_effect[effect], entry.parameters, strict=True)
                },
                "evidence": weight.evidence,
                "confusable_with": list(ties[effect]),
                "channels": channels[effect],
            }
        )
    causes.sort(key=lambda c: -c["evidence"])
    return causes, {c["effect"]: ties[c["effect"]] for c in causes}


def _vibration(line: vibration.Line) -> dict[str, Any]:
    """The cause that is found by its line and not by a signature."""
    value = {"value": line.amplitude, "std": line.std, "unit": "m/s2"}
    return {
        "effect": "vibration",
        "parameters": {"vibration.amplitude": value},
        "evidence": line.evidence,
        "confusable_with": [],
        "channels": list(line.channels),
    }


def _taken_out(line: vibration.Line) -> str:
    return (
        f"the accelerometers shake at the {line.rotor} rotor's speed by {line.amplitude:.2g} m/s2:"
        " that line was taken out of their readings before anything else was looked for"
    )


def _believed(state: State, f: FreeParameter, std: float, colour: float, dt: float) -> float:
    """Std of a number: the signatures', with colour, the likelihood's own curvature and timing."""
    return with_timing(f, std * math.sqrt(colour) * state.wider.get(f.name, 1.0), dt)


def _look_alikes(
    search: Search,
    state: State,
    quadratic: Quadratic,
    effect: str,
    colour: float,
    lost: float,
) -> dict[str, State]:
    """Effects that would do as well in this one's place, by refitted likelihood, and those refits.

    Coloured innovations carry less than they seem to: the tie widens by the colour, up to half of
    what is `lost` (nats) with nothing in the effect's place.
    """
    tie = min(TIE * colour, max(0.5 * lost, TIE))
    now, _ = quadratic.best(search.free_names(state.active))
    rest = [e for e in state.active if e != effect]
    nothing, _ = quadratic.best(search.free_names(rest), search.off(effect))
    near = []
    for other in search.candidates:
        if other not in state.active:
            change, move = search.swap(quadratic, state.active, effect, other)
            does_something = nothing - now - change > 0.5 * (nothing - now)
            if change < 3.0 * tie and does_something:
                near.append((change, other, move))

    def in_its_place(other: str, move: np.ndarray, steps: int) -> State:
        values = dict(zip(quadratic.names, (quadratic.at + move).tolist(), strict=True))
        active = [other if e == effect else e for e in state.active]
        return search.settle(State(active, state.values | values, state.noise), steps)

    result = {}
    for _, other, move in sorted(near, key=lambda n: n[0])[:3]:
        trial = in_its_place(other, move, steps=2)
        if trial.objective - state.objective < tie:
            result[other] = trial
    # a lag is far from a delay of nothing: the quadratic has no say, and both may be there
    for twin in sorted(together(effect) & set(search.candidates) - set(result)):
        _, move = search.swap(quadratic, state.active, effect, twin)
        trial = in_its_place(twin, move, steps=6)
        mixed = search.score(quadratic, state.active, twin)[1] > EVIDENCE
        if mixed or trial.objective - state.objective < tie:
            result[twin] = trial
    return result


def _design(
    search: Search,
    state: State,
    quadratic: Quadratic,
    ties: Mapping[str, Mapping[str, State]],
    flight: Flight,
    say: Progress,
) -> next_maneuver.Design | None:
    """The maneuvers that part the strongest tied cause from its look-alikes.

    What the flights told of the alternatives' numbers is taken from the final quadratic.
    """
    tied = next((effect for effect, others in ties.items() if others), None)
    if tied is None:
        return None
    say("designing the next maneuver")
    alternatives = []
    for name, refit in {tied: state, **ties[tied]}.items():
        free = search.free_of_vehicle(refit.active)
        i = quadratic.index([f.name for f in free])
        alternatives.append(
            next_maneuver.Alternative.of(
                name, search.model.vehicle, free, refit.values, quadratic.G[np.ix_(i, i)]
            )
        )
    return next_maneuver.design(alternatives, state.noise, next_maneuver.logged_rates(flight))


def _channels(search: Search, state: State, quadratic: Quadratic, effect: str) -> list[str]:
    """Channels that carry most of an effect's signature, strongest first."""
    own = search.by_effect[effect]
    size = np.array([state.values[f.name] - f.value for f in own])
    strength = size**2 @ quadratic.by_channel[quadratic.index([f.name for f in own])]
    order = np.argsort(-strength)
    total = strength.sum()
    return [CHANNELS[i] for i in order if total > 0.0 and strength[i] > 0.1 * total]


def _shaken(state: State) -> list[str]:
    """What shakes the machine too fast to be a gust, in words; nothing where there is no sign of it."""
    process, floor = state.noise.process, state.noise.floor
    if not any(process[level] > CALM * floor[level] for level in BUFFET_LEVELS):
        return []  # what seemed to shake the bare model has found its cause
    xy, z, moment_xy, moment_z = (process[level] for level in BUFFET_LEVELS)
    return [
        "shaken by white noise beside the gusts, x and y, z:"
        f" force {xy:.2g}, {z:.2g} N s^1/2, moment {moment_xy:.2g}, {moment_z:.2g} N m s^1/2"
    ]


def _rest_on(
    search: Search, state: State, quadratic: Quadratic, ties: Mapping[str, Mapping[str, State]]
) -> list[str]:
    """Causes' numbers that an effect which these flights cannot show would change, in words.

    An interval knows of what is in the model. A usual accelerometer scale is worth nothing on flights
    that never leave 1 g, and is then in the accelerometer's bias.
    """
    free = search.free_names(state.active)
    std = np.sqrt(np.diag(quadratic.covariance(free)))
    named = {*state.active}.union(*ties.values())
    unseen = [
        f
        for effect in search.candidates
        if effect not in named
        for f in search.by_effect[effect]
        if f.probe == 0.0
    ]
    information, answers = quadratic.projected([f.name for f in unseen], free)
    of_cause = np.array([name.partition(".")[0] in state.active for name in free], bool)
    worst: dict[str, tuple[float, str]] = {}
    for f, known, answer in zip(unseen, np.diag(information), answers.T, strict=True):
        if 0.5 * known * f.std**2 > EVIDENCE:
            continue
        moved = np.abs(answer) * f.std
        for k in np.flatnonzero(of_cause & (moved > FAR * std)):
            name, effect = free[k], f.name.partition(".")[0]
            text = (
                f"{name} = {state.values[name]:.3g} holds without {effect}: a usual {f.name}"
                f" ({f.std:.2g}) cannot be seen here and would move it by {moved[k]:.2g}"
            )
            worst[name] = max(worst.get(name, (0.0, "")), (float(moved[k] / std[k]), text))
    return [text for _, text in sorted(worst.values(), reverse=True)[:MOST_WARNINGS]]


def _unusual(search: Search, state: State) -> list[str]:
    remarks = []
    for effect in state.active:
        for f in search.by_effect[effect]:
            size = abs(state.values[f.name] - f.value)
            if size > 0.99 * FARTHEST * f.std:
                remarks.append(
                    f"{f.name} stands at the limit of what is believed, {state.values[f.name]:.3g}:"
                    " something else hides behind this name"
                )
            elif size > UNUSUAL * f.std:
                remarks.append(
                    f"{f.name} = {state.values[f.name]:.3g} is outside its usual range"
                    f" ({f.value:g} +- {f.std:g}): take the name with care"
                )
    for f in search.free(state.active):
        if "." not in f.name:
            sigmas = (state.values[f.name] - f.value) / f.std
            if abs(sigmas) > 2.0:
                remarks.append(
                    f"base parameter {f.name} moved {sigmas:+.1f} prior sigmas,"
                    f" from {f.value:.4g} to {state.values[f.name]:.4g}"
                )
    return remarks


# --- what is left, what to do next --------------------------------------------------------------------


def _unexplained(
    white: Mapping[str, Whiteness], described: Collection[str]
) -> list[dict[str, Any]]:
    """Channels that are just not white, beside those that unlisted terms describe."""
    rest = [c for c, w in white.items() if not w.white and c not in described]
    return [
        {
            "channel": c,
            "depends_on": [],
            "share": round(white[c].coloured_share, 3),
            "form": "not found",
        }
        for c in rest
    ]


def _verdict(causes: bool, unexplained: bool) -> str:
    if causes:
        return "partly explained" if unexplained else "explained"
    return "unexplained" if unexplained else "consistent"


def _innovations(passes: Sequence[RunPass]) -> dict[str, dict[str, np.ndarray]]:
    result: dict[str, dict[str, np.ndarray]] = {}
    for run in passes:
        table = {"t": run.record.t}
        for i, channel in enumerate(CHANNELS):
            if np.isfinite(run.record.z[:, i]).any():
                table[channel] = run.innovations[:, i]
        result[run.record.name] = table
    return result


def _extended(
    search: Search,
    state: State,
    quadratic: Quadratic,
    held: Sequence[Record],
    flight: Flight,
    vehicle: Vehicle,
    colours: Mapping[str, float],
) -> Vehicle:
    """The vehicle with the causes in it, refitted on all runs."""
    loose = search.free(state.active)
    values, covariance = _with_held_out(search, state, quadratic, held)
    dt = median_step([*search.engine.records, *held])
    free = search.free_of_vehicle(state.active)
    own = [loose.index(f) for f in free]
    spread = np.sqrt(np.diag(covariance))

    def std(f: FreeParameter) -> float:
        colour = colours.get(f.name.partition(".")[0], 1.0)
        return _believed(state, f, float(spread[loose.index(f)]), colour, dt)

    return fitted_vehicle(
        vehicle,
        free,
        values,
        {f.name: std(f) for f in free},
        covariance[np.ix_(own, own)],
        _diagnosed(flight),
        flight,
    )


def _with_held_out(
    search: Search, state: State, quadratic: Quadratic, held: Sequence[Record]
) -> tuple[dict[str, float], np.ndarray]:
    """Values of the loose parameters, and their covariance, once the held-out runs are heard too.

    The fit on the other runs is the prior of one Gauss-Newton step, halved until the objective of all
    runs falls (a one-step estimator; Le Cam 1956, van der Vaart 1998, sec. 5.7).
    """
    loose = search.free(state.active)
    names = [f.name for f in loose]
    values = {name: state.values[name] for name in names}
    if not held:
        return values, quadratic.covariance(names)
    engine = Engine(search.model, held)
    if any(record.news is not None for record in search.engine.records):
        closed_loop.attach_news(engine, state)
    passes, lin = engine.linearise(state.values, state.noise, loose)
    heard = Quadratic.of(lin, loose, state.values)
    known = quadratic.index(names)
    # where they are fitted, the other runs and the priors pull nowhere
    both = replace(heard, G=heard.G + quadratic.G[np.ix_(known, known)], mean=heard.at)
    _, move = both.best(names)
    before = state.objective - sum(p.log_likelihood for p in passes)
    for part_of_it in (1.0, 0.5, 0.25):
        moved = dict(zip(names, (both.at + part_of_it * move).tolist(), strict=True))
        there = state.values | moved
        after = objective(search.engine.filter(there, state.noise), loose, there)
        if after - engine.log_likelihood(there, state.noise) < before:
            values = moved
            break
    return values, both.covariance(names)


def _diagnosed(flight: Flight) -> str:
    """Source of a number in the extended vehicle's file."""
    return f"diagnosed from {flight.path.name if flight.path else 'flight'}"
