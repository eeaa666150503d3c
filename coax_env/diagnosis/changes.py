"""What changed: the difference of two logs of one machine, effect by effect.

Every effect of the catalogue is a candidate change about its fitted (or off) value, whether or not the
model has it; the vehicle's own numbers are shared. A change is a move in effective numbers: the
linkage gain times (1 + s), wherever the fit had put it, so that nothing vanishes into a base number.

Two logs of one flight (edits.py) have one and the same noise, and the same faults of the model. So what
is fitted is the difference of the whitened innovations itself,

    e_after(p + change) - e_before(p) = 0,

which holds exactly at the true change, whatever the model lacks. There is no noise in it, so that even
what would be lost in the noise of one flight is seen; what is left comes of how well forms and rows can
express the change, and its size is not known. So a set of changes is worth, in nats, half the number of
blocks of BLOCK seconds times the log of how many times smaller it makes the difference (a normal
residual of unknown variance; Schwarz 1978 for the numbers that it takes), FORM_ERROR of it never
counted. The std of a change is that of the residual's scores, block by block (sandwich; Huber 1967):
far smaller than the std of either diagnosis. What a change would be worth in a flight with noise of its
own is stated beside it, as its evidence.

Where the logs are the same up to a row, the change begins there: the model then changes at that moment
(estimation/changing_model.py), and only what is behind it counts. No fit finds the moment; it lies
between the last row that is the same and the first that is not.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from coax_env.diagnosis import vibration
from coax_env.diagnosis.diagnose import namable, stated
from coax_env.diagnosis.fits import fitted, noise_fitted, start
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.search import search
from coax_env.diagnosis.settings import SETTINGS, Settings
from coax_env.errors import InputError
from coax_env.estimation.changing_model import BEFORE, ChangingModel, clock_of
from coax_env.estimation.engine import BLOCK, Engine
from coax_env.estimation.fitted_vehicle import median_step
from coax_env.estimation.flown import flown_parts
from coax_env.estimation.helicopter import (
    MOST_USUAL_SIZES,
    ROTORS,
    HeliModel,
    Moment,
    record_of,
)
from coax_env.estimation.helicopter_noise import starting_noise
from coax_env.estimation.parted_engine import of_part
from coax_env.estimation.prediction import WARM_UP
from coax_env.estimation.quadratic import bounded_solve
from coax_env.estimation.state_space import Record
from coax_env.logs.fast_rows import decimated
from coax_env.logs.flight import Flight
from coax_env.model import effects
from coax_env.model.layout import N_COMMANDS
from coax_env.model.vehicle import Vehicle
from coax_env.progress import Progress

ROTOR_SPEED = "rotor_speed"
"""Change that no effect of the catalogue is: both rotors turn (1 + s) times as fast per command.

A fuller battery, another motor or speed controller. Flown as commands that are (1 + s) times as large;
of the catalogue, thrust_scale lacks the torques and battery_sag begins with every run anew.
"""
ROTOR_SCALE = f"{ROTOR_SPEED}.scale"
USUAL_SPEED = 0.035  # half a usual thrust_scale
STEP = 0.05  # usual sizes by which a number is moved for a derivative; ours
STEPS = 5  # Gauss-Newton steps at most; ours
CONVERGED = 1e-3  # usual sizes that a last step may move; ours
FORM_ERROR = 0.03
"""Share of the squared difference that may be left, since forms and rows express a change only so well.

Measured: a delay of 30 ms, resampled on rows 7 ms apart, leaves 1 %; ours.
"""
MANY_FORM_ERRORS = 3.0
"""FORM_ERRORs that a change must be worth that is named by a flight's own noise only; ours."""
LEAST_STD = 0.01
"""Std of a change as a share of it at least, for the same reason; ours. Where more of the difference is
left, the share is the root of what is left of its square: a change that no number can express as it is,
such as a constant tilt where the phase follows the rotor speed, is known no better than it fits."""
LEAST_DIFFERENT = 0.1
"""nats by which two logs differ at least: the digits of a CSV are worth 1e-6; ours."""
RIDGE = 100.0  # usual sizes: prior of a change that is there, wide enough not to move it; ours
TRIALS = 4  # candidates that are fitted at once, the best by the derivatives first; ours
HOPELESS = 0.5  # share of the best gain below which a candidate is not fitted; ours


@dataclass(frozen=True)
class Coordinate:
    """One number of a change. usual: its prior's std. lower, upper: how far it may move."""

    effect: str
    name: str
    unit: str
    usual: float
    lower: float
    upper: float
    step: float
    timing: bool = False


@dataclass(frozen=True)
class ParameterChange:
    """A number before and after, effective: with what a fit had put into its base parameter."""

    before: float
    after: float
    std: float
    unit: str

    @property
    def change(self) -> float:
        """After less before."""
        return self.after - self.before


@dataclass(frozen=True)
class Change:
    """An effect that changed. evidence: nats that it would be worth in a flight of its own noise."""

    effect: str
    parameters: Mapping[str, ParameterChange]
    evidence: float
    confusable_with: tuple[str, ...] = ()


@dataclass(frozen=True)
class Since:
    """From when on two logs of a flight differ. moment: the first row that does; t, std: of the time
    between the last row that is the same and that one [s]."""

    moment: Moment
    t: float
    std: float

    def entry(self) -> dict[str, str | float]:
        """As findings.json has a moment."""
        return {"run": self.moment.run, "t": self.t, "std": self.std}


@dataclass(frozen=True)
class Changes:
    """All that changed, strongest first.

    different: nats by which the logs differ under the model of the one before.
    left: nats of that which no change explains.
    since: from when on they differ; None: from the start.
    """

    changes: tuple[Change, ...]
    different: float
    left: float
    since: Since | None = None

    def as_json(self) -> dict[str, Any]:
        """As changes.json has it."""
        return {
            "verdict": "changed" if self.changes else "same",
            "since": self.since.entry() if self.since else None,
            "changes": [
                {
                    "effect": c.effect,
                    "parameters": {
                        name: {
                            "before": p.before, "after": p.after, "change": p.change,
                            "std": p.std, "unit": p.unit,
                        }
                        for name, p in c.parameters.items()
                    },
                    "evidence": c.evidence,
                    "confusable_with": list(c.confusable_with),
                }
                for c in self.changes
            ],
            "different_nats": self.different,
            "left_nats": self.left,
        }  # fmt: skip


# --- the model of the flight before ---------------------------------------------------------------


def calm(flight: Flight, vehicle: Vehicle) -> Flight:
    """What was flown, without what vibrates at a rotor's speed, in no more rows than a fit needs.

    Args:
        flight: as read.
        vehicle: in the flight's air.
    """
    return decimated(vibration.calmed(flown_parts(flight, vehicle), vehicle)[1])


def fitted_model(
    flight: Flight,
    vehicle: Vehicle,
    settings: Settings = SETTINGS,
    progress: Progress | None = None,
) -> tuple[Problem, Fit]:
    """The model of a flight, all runs fitted, with the effects that a search finds.

    Args:
        flight: `calm`.
        vehicle: in the flight's air.
        settings: of the search.
        progress: called with a line of text.
    """
    model = HeliModel(vehicle, stated(flight))
    records = [record_of(run) for run in flight.runs]
    candidates = namable((), vehicle, flight)
    problem = Problem.of(model, records, candidates, settings, progress)
    fit = start(problem, starting_noise(flight, vibration.without(vehicle)))
    fit, _ = search(problem, noise_fitted(problem, fitted(problem, fit)))
    return problem, fitted(problem, fit, settings.most_steps, settings.refinement_gain)


# --- the log before -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Before:
    """The log before under its model, and what every number would change of its innovations.

    Attributes:
        problem, fit: of that log.
        innovations: per record, (n, m) whitened.
        there: per record, (n, m), readings that count: from WARM_UP on, since a filter starts from the
            first readings as they are, biased or not.
        known: effect -> its coordinates.
        slopes: effect -> derivatives of all innovations in them, (readings, coordinates).
    """

    problem: Problem
    fit: Fit
    innovations: list[np.ndarray]
    there: list[np.ndarray]
    known: Mapping[str, list[Coordinate]]
    slopes: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, problem: Problem, fit: Fit) -> "Before":
        """From a fit, by one filter pass per number.

        Args:
            problem, fit: `fitted_model`, or of any diagnosis.
        """
        known: dict[str, list[Coordinate]] = {}
        for c in coordinates(problem, fit):
            known.setdefault(c.effect, []).append(c)
        passes = problem.engine.filter(fit.values, fit.noise)
        here = [run.innovations for run in passes]
        there = [
            np.isfinite(run.innovations) & (run.record.t - run.record.t[0] >= WARM_UP)[:, None]
            for run in passes
        ]
        own = _Logs(problem.engine, fit, here, there)
        problem.report(f"what {sum(map(len, known.values()))} numbers change of the innovations")
        slopes = {e: own.slopes(fit.values, coordinates) for e, coordinates in known.items()}
        return cls(problem, fit, here, there, known, slopes)

    def since(self, moment: Moment) -> "Before":
        """Of numbers that change at a moment of the flight, not in all of it.

        Args:
            moment: its run may be one that was cut into parts.
        """
        clock = clock_of(self.problem.engine.records)
        known = [e for e in self.known if e != ROTOR_SPEED]
        model = ChangingModel(self.problem.model, dict.fromkeys(known, moment), clock)
        was = {
            of_part(name, BEFORE): self.fit.values.get(name, p.off)
            for e in known
            for name, p in zip(
                effects.CATALOGUE[e].names(), effects.CATALOGUE[e].parameters, strict=True
            )
        }
        problem, fit = self.problem.with_model(model), self.fit.at(was)
        there = [
            mask & (model.stretches(record) == 0.0)[:, None]
            for mask, record in zip(self.there, problem.engine.records, strict=True)
        ]
        own = _Logs(problem.engine, fit, self.innovations, there)
        slopes = {e: own.slopes(fit.values, group) for e, group in self.known.items()}
        return replace(self, problem=problem, fit=fit, there=there, slopes=slopes)


# --- the search for what changed ------------------------------------------------------------------


@dataclass(frozen=True)
class _Logs:
    """Two logs under one model: innovations of the one before, an engine over the one after.

    there: per record, (n, m), readings that both have.
    """

    engine: Engine
    fit: Fit
    before: list[np.ndarray]
    there: list[np.ndarray]

    def difference(self, values: Mapping[str, float]) -> np.ndarray:
        """Whitened innovations (k,) of the log after at these values, less those of the one before."""
        faster = 1.0 + values.get(ROTOR_SCALE, 0.0)
        engine = self.engine if faster == 1.0 else _with_rotors(self.engine, faster)
        own = {name: value for name, value in values.items() if name != ROTOR_SCALE}
        passes = engine.filter(own, self.fit.noise)
        parts = [
            (run.innovations - before)[there]
            for run, before, there in zip(passes, self.before, self.there, strict=True)
        ]
        return np.nan_to_num(np.concatenate(parts), nan=0.0, posinf=0.0, neginf=0.0)

    @property
    def block(self) -> np.ndarray:
        """Number of the block of BLOCK seconds of every reading that is there, (k,)."""
        found, end = [], 0
        for record, there in zip(self.engine.records, self.there, strict=True):
            own = ((record.t - record.t[0]) / BLOCK).astype(np.int64)[np.nonzero(there)[0]]
            found.append(own + end)
            end += int(own.max(initial=-1)) + 1
        return np.concatenate(found)

    def slopes(self, at: Mapping[str, float], of: Sequence[Coordinate]) -> np.ndarray:
        """Derivatives (k, coordinates) of the difference about values `at`."""
        here = self.difference(at)
        columns = [(self.difference(moved(at, {c.name: c.step})) - here) / c.step for c in of]
        return np.column_stack(columns) if columns else np.zeros((here.size, 0))


def _with_rotors(engine: Engine, factor: float) -> Engine:
    """Over the same records, their rotor commands times a factor; from the model's moment on."""
    times = np.ones(N_COMMANDS)
    times[list(ROTORS)] = factor
    model, records = engine.model, []
    for record in engine.records:
        late = np.ones(record.t.size, bool)
        if isinstance(model, ChangingModel):
            late = model.stretches(record) == 0.0
        command = np.where(late[:, None], record.command * times, record.command)
        records.append(replace(record, command=command))
    return Engine(model, records, engine.threads)


@dataclass(frozen=True)
class _Trial:
    """Some effects changed, fitted. nats: worth over nothing changed, see above."""

    effects: tuple[str, ...]
    moves: Mapping[str, float]
    nats: float
    residual: np.ndarray = field(repr=False)
    slopes: np.ndarray = field(repr=False)


def changes(before: Before, after: Sequence[Record], progress: Progress | None = None) -> Changes:
    """What a second log of the same flight says differently.

    Args:
        before: the one log under its model.
        after: the other log's records, with the same rows.
        progress: called with a line of text.

    Raises:
        InputError: the logs are not of the same flight.
    """
    _check_same_rows(before.problem.engine.records, after)
    since = first_difference(before.problem.engine.records, after)
    if since is not None:
        before = before.since(since.moment)
    problem, fit, chosen = before.problem, before.fit, before.problem.settings
    report = progress or (lambda text: None)
    there = [mask & np.isfinite(record.z) for mask, record in zip(before.there, after, strict=True)]
    logs = _Logs(
        Engine(problem.model, after, problem.engine.threads), fit, before.innovations, there
    )
    slopes = _of_readings(before, there)
    nothing = logs.difference(fit.values)
    best = _Trial((), {}, 0.0, nothing, np.zeros((nothing.size, 0)))
    alternatives: dict[str, tuple[str, ...]] = {}
    different = float(0.5 * nothing @ nothing)
    while different > LEAST_DIFFERENT and len(best.effects) < chosen.most_causes:
        trials = _trials(logs, before.known, slopes, best, nothing)
        if not trials or not _holds(trials[0], best, nothing, chosen):
            break
        new = trials[0].effects[-1]
        alternatives[new] = tuple(
            t.effects[-1] for t in trials[1:] if trials[0].nats - t.nats < chosen.tie
        )
        report(f"{new} changed: {trials[0].nats - best.nats:.1f} nats")
        best = _without_worthless(logs, before.known, trials[0], nothing, chosen)
    found = _stated(problem, logs, before.known, best, alternatives, nothing)
    return replace(found, since=since)


def first_difference(before: Sequence[Record], after: Sequence[Record]) -> Since | None:
    """From when on two logs of a flight differ; None where they do from the start, or nowhere.

    Args:
        before, after: their records, in the order in which they were flown, with the same rows.
    """
    for k, (one, other) in enumerate(zip(before, after, strict=True)):
        same = np.all(one.command == other.command, axis=1)
        same &= np.all((one.z == other.z) | (np.isnan(one.z) & np.isnan(other.z)), axis=1)
        if same.all():
            continue
        row = int(np.argmin(same))
        if row == 0:
            return Since(Moment(one.whole, float(one.t[0])), float(one.t[0]), 0.0) if k else None
        gap = float(one.t[row] - one.t[row - 1])
        moment = Moment(one.whole, float(one.t[row]))
        return Since(moment, moment.t - 0.5 * gap, gap / math.sqrt(12.0))
    return None


def _of_readings(before: Before, there: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Slopes of the log before, of those of its readings that are in both logs."""
    own = np.concatenate([mask.ravel() for mask in before.there])
    both = np.concatenate([mask.ravel() for mask in there])[own]
    return {effect: slopes[both] for effect, slopes in before.slopes.items()}


def _holds(more: _Trial, fewer: _Trial, nothing: np.ndarray, settings: Settings) -> bool:
    """Whether one more change is worth it: by the logs themselves, or by a flight's own noise.

    The latter where two changes are there and one alone leaves much; never in what forms leave.
    """
    share = (_nats(fewer.residual) - _nats(more.residual)) / _nats(nothing)
    by_flight = _nats(fewer.residual) - _nats(more.residual) > settings.evidence
    by_logs = more.nats - fewer.nats > settings.evidence
    return by_logs or (by_flight and share > MANY_FORM_ERRORS * FORM_ERROR)


def _without_worthless(
    logs: _Logs,
    known: Mapping[str, Sequence[Coordinate]],
    best: _Trial,
    nothing: np.ndarray,
    settings: Settings,
) -> _Trial:
    """Without the changes that stood for those that came after them."""
    for effect in best.effects[:-1]:
        rest = tuple(e for e in best.effects if e != effect)
        fewer = _fitted(logs, known, rest, best.moves, nothing)
        if not _holds(best, fewer, nothing, settings):
            best = fewer
    return best


def _worth(nothing: np.ndarray, residual: np.ndarray, numbers: int, blocks: int) -> float:
    """Nats of so many numbers that leave a residual of the difference (k,) with nothing changed."""
    whole = float(nothing @ nothing)
    left = float(residual @ residual) / whole + FORM_ERROR
    return 0.5 * blocks * math.log((1.0 + FORM_ERROR) / left) - 0.5 * numbers * math.log(blocks)


def _trials(
    logs: _Logs,
    known: Mapping[str, Sequence[Coordinate]],
    slopes: Mapping[str, np.ndarray],
    best: _Trial,
    nothing: np.ndarray,
) -> list[_Trial]:
    """One more effect changed, the best few by the derivatives fitted; the best first."""
    gains: dict[str, float] = {}
    for effect in known.keys() - set(best.effects):
        J = np.column_stack([best.slopes, slopes[effect]])
        A = J.T @ J + _ridge([c for e in (*best.effects, effect) for c in known[e]])
        b = J.T @ best.residual
        gains[effect] = float(0.5 * b @ np.linalg.solve(A, b))
    ranked = sorted(gains, key=lambda e: -gains[e])[:TRIALS]
    tried = [e for e in ranked if gains[e] > HOPELESS * gains[ranked[0]]]
    found = [_fitted(logs, known, (*best.effects, e), best.moves, nothing) for e in tried]
    return sorted(found, key=lambda trial: -trial.nats)


def _fitted(
    logs: _Logs,
    known: Mapping[str, Sequence[Coordinate]],
    effect_names: tuple[str, ...],
    begin: Mapping[str, float],
    nothing: np.ndarray,
) -> _Trial:
    """Moves of some effects by Gauss-Newton, the others at what they were before."""
    own = [c for e in effect_names for c in known[e]]
    usual = np.array([c.usual for c in own])
    lower, upper = (np.array([getattr(c, side) for c in own]) for side in ("lower", "upper"))
    x = np.array([begin.get(c.name, 0.0) for c in own])

    def at(x: np.ndarray) -> dict[str, float]:
        return moved(logs.fit.values, dict(zip((c.name for c in own), x.tolist(), strict=True)))

    ridge = _ridge(own)

    def cost(residual: np.ndarray, x: np.ndarray) -> float:
        return float(0.5 * residual @ residual + 0.5 * x @ ridge @ x)

    residual = logs.difference(at(x))
    for _ in range(STEPS):
        J = logs.slopes(at(x), own)
        A = J.T @ J + ridge
        step = bounded_solve(A, -J.T @ residual - ridge @ x, lower - x, upper - x)
        for share in (1.0, 0.5, 0.2):
            there = logs.difference(at(x + share * step))
            if cost(there, x + share * step) < cost(residual, x):
                residual, x = there, x + share * step
                break
        else:
            break
        if np.abs(share * step / usual).max() < CONVERGED:
            break
    nats = _worth(nothing, residual, len(own), int(logs.block.max()) + 1)
    moves = dict(zip((c.name for c in own), x.tolist(), strict=True))
    return _Trial(effect_names, moves, nats, residual, J)


def _ridge(own: Sequence[Coordinate]) -> np.ndarray:
    """Precision of the prior of some coordinates, (c, c)."""
    return np.diag([1.0 / (RIDGE * c.usual) ** 2 for c in own])


# --- what is stated -------------------------------------------------------------------------------


def _stated(
    problem: Problem,
    logs: _Logs,
    known: Mapping[str, Sequence[Coordinate]],
    best: _Trial,
    alternatives: Mapping[str, tuple[str, ...]],
    nothing: np.ndarray,
) -> Changes:
    own = [c for e in best.effects for c in known[e]]
    unexpressed = math.sqrt(_nats(best.residual) / max(_nats(nothing), LEAST_DIFFERENT))
    std = _std(logs, own, best, median_step(problem.engine.records), max(unexpressed, LEAST_STD))
    fit = logs.fit
    stated = []
    for effect in best.effects:
        rest = tuple(e for e in best.effects if e != effect)
        without = _fitted(logs, known, rest, best.moves, nothing).residual if rest else nothing
        before = effective(problem, fit.values, effect)
        after = effective(problem, moved(fit.values, best.moves), effect)
        stated.append(
            Change(
                effect,
                {
                    c.name: ParameterChange(
                        before[c.name], after[c.name], std[c.name] * scale_of(before, c), c.unit
                    )
                    for c in known[effect]
                },
                _nats(without) - _nats(best.residual),
                alternatives[effect],
            )
        )
    stated.sort(key=lambda c: -c.evidence)
    return Changes(tuple(stated), _nats(nothing), _nats(best.residual))


def _nats(residual: np.ndarray) -> float:
    """What a difference (k,) would be worth in a flight with noise of its own."""
    return float(0.5 * residual @ residual)


def _std(
    logs: _Logs, own: Sequence[Coordinate], best: _Trial, dt: float, least: float
) -> dict[str, float]:
    """Std of every move by the residual's scores, block by block; lags with half a sample.

    At least a share of the effect's change, in usual sizes.
    """
    if not own:
        return {}
    count = int(logs.block.max()) + 1
    scores = np.zeros((count, len(own)))
    np.add.at(scores, logs.block, best.slopes * best.residual[:, None])
    inverse = np.linalg.inv(best.slopes.T @ best.slopes + _ridge(own))
    covariance = inverse @ (scores.T @ scores) @ inverse * count / max(count - len(own), 1)
    half = dt / math.sqrt(12.0)
    size: dict[str, float] = {}  # of an effect's change, in usual sizes
    for c in own:
        size[c.effect] = max(size.get(c.effect, 0.0), abs(best.moves[c.name]) / c.usual)
    return {
        c.name: math.hypot(s, least * size[c.effect] * c.usual, half if c.timing else 0.0)
        for c, s in zip(own, np.sqrt(np.diag(covariance)), strict=True)
    }


def _check_same_rows(before: Sequence[Record], after: Sequence[Record]) -> None:
    same = len(before) == len(after) and all(
        a.name == b.name and np.array_equal(a.t, b.t) for a, b in zip(before, after, strict=True)
    )
    if not same:
        raise InputError("these are not two logs of one flight: their runs or rows differ")


# --- coordinates of a change ----------------------------------------------------------------------


def coordinates(problem: Problem, fit: Fit) -> list[Coordinate]:
    """Every number that may have changed, about its value in a fit.

    Args:
        problem: whose vehicle and channels.
        fit: with the values.
    """
    found = [
        Coordinate(
            ROTOR_SPEED, ROTOR_SCALE, "1", USUAL_SPEED,
            -MOST_USUAL_SIZES * USUAL_SPEED, MOST_USUAL_SIZES * USUAL_SPEED, STEP * USUAL_SPEED,
        )
    ]  # fmt: skip
    for effect in (*problem.candidates, *problem.model.vehicle.effects):
        entry = effects.CATALOGUE.get(effect)
        if entry is None or entry.line:
            continue
        for name, p in zip(entry.names(), entry.parameters, strict=True):
            if p.shape:
                continue
            value = fit.values.get(name, p.off)
            most = MOST_USUAL_SIZES * p.usual
            lower, upper = max(p.lower - value, -most), min(p.upper - value, most)
            step = p.probe if abs(value) < 0.25 * p.probe else STEP * p.usual
            found.append(
                Coordinate(
                    effect, name, p.unit, p.usual, min(lower, 0.0), max(upper, 0.0),
                    -step if step > upper else step, p.timing,
                )
            )  # fmt: skip
    return found


def moved(values: Mapping[str, float], moves: Mapping[str, float]) -> dict[str, float]:
    """Values of all parameters after changes.

    A scale is multiplied; where the linkage gain changes, the tilt that a swash offset makes of the
    disc stays, as it does where the commands were logged in another unit.

    Args:
        values: of the model before.
        moves: coordinate -> how far it moves.
    """
    after = dict(values)
    for name, move in moves.items():
        if name == ROTOR_SCALE or _is_scale(name):
            after[name] = (1.0 + after.get(name, 0.0)) * (1.0 + move) - 1.0
        else:
            after[name] = after.get(name, _off(name)) + move
    if "swash_gain.scale" in moves:
        for axis in ("lon", "lat"):
            offset = f"swash_offset.{axis}"
            kept = values.get(offset, 0.0) / (1.0 + moves["swash_gain.scale"])
            after[offset] = kept + moves.get(offset, 0.0)
    return after


def effective(problem: Problem, values: Mapping[str, float], effect: str) -> dict[str, float]:
    """An effect's numbers with what stands in the base parameters that it replaces.

    Args:
        problem: whose vehicle file the base parameters stand in.
        values: of all parameters.
        effect: its name.
    """
    file = problem.model.bare_values
    if effect == ROTOR_SPEED:
        return {ROTOR_SCALE: values.get(ROTOR_SCALE, 0.0)}
    entry = effects.CATALOGUE[effect]
    found = {name: values.get(name, _off(name)) for name in entry.names()}
    for base in entry.replaces:
        (name,) = entry.names()
        if _is_scale(name):
            found[name] = (1.0 + found[name]) * values[base] / file[base] - 1.0
        else:
            found[name] += values[base] - file[base]
    return found


def scale_of(before: Mapping[str, float], c: Coordinate) -> float:
    """What a move of 1 in a coordinate is in its effective number."""
    multiplied = c.effect == ROTOR_SPEED or _is_scale(c.name)
    return 1.0 + before[c.name] if multiplied else 1.0


def _is_scale(name: str) -> bool:
    effect, _, own = name.partition(".")
    return own == "scale" and bool(effects.CATALOGUE[effect].replaces)


def _off(name: str) -> float:
    effect, _, own = name.partition(".")
    return next(p.off for p in effects.CATALOGUE[effect].parameters if p.name == own)
