"""Numbers that may have changed between two logs, each a move in effective numbers.

Every effect of the catalogue is a candidate change about its fitted (or off) value, whether or not the
model has it; the vehicle's own numbers are shared. A move of a scale is the linkage gain times (1 + s),
wherever the fit had put it, so that nothing vanishes into a base number.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.helicopter import MOST_USUAL_SIZES
from coax_env.model import effects

ROTOR_SPEED = "rotor_speed"
"""Change that no effect of the catalogue is: both rotors turn (1 + s) times as fast per command.

A fuller battery, another motor or speed controller. Flown as commands that are (1 + s) times as large;
of the catalogue, thrust_scale lacks the torques and battery_sag begins with every run anew.
"""
ROTOR_SCALE = f"{ROTOR_SPEED}.scale"
USUAL_SPEED = 0.035  # half a usual thrust_scale
STEP = 0.05  # usual sizes by which a number is moved for a derivative; ours


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
