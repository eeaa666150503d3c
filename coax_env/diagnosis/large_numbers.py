"""Beside a number of unusual size the other numbers of the same effect may be as large."""

import math
from collections.abc import Mapping
from dataclasses import replace

from coax_env.diagnosis.evidence import Evidence, less_sure
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.helicopter import UNUSUAL_FROM
from coax_env.estimation.quadratic import Quadratic
from coax_env.model import effects


def beside_large_axes(problem: Problem, fit: Fit) -> Problem:
    """With the priors of an effect's other axes as wide as the largest that was found.

    Where x is five times its usual size, that y and z are usual is not known.

    Args:
        problem, fit: after the search.
    """
    own = dict(problem.own)
    for effect in fit.active:
        numbers, largest = _of_a_large_one(problem, fit, effect)
        if len(_units(effect)) == 1:
            own[effect] = tuple(
                replace(f, std=largest * f.std) if f.name in numbers else f for f in own[effect]
            )
    return replace(problem, own=own)


def less_sure_beside_large_numbers(
    problem: Problem, fit: Fit, quadratic: Quadratic, evidence: Mapping[str, Evidence]
) -> Fit:
    """The fit whose std of an effect's numbers of other units has in it that they may be as large, too.

    A swash phase of 3.9 usual sizes had a change with rotor speed, which the flight does not determine,
    of -0.0002 +- 0.00017, where -0.0008 was true (`study_diagnosis.py --arms sizes_large --seed 857`,
    three 471, **synthetic**). The number itself stays by its usual prior: with a wider one a droop that
    is not there came back on a real helicopter (first CoaX).

    Args:
        problem, fit: with the causes. quadratic: linearised at the fit. evidence: of the causes.
    """
    precision, free = quadratic.precision.copy(), problem.free_names(fit.active)
    for effect in fit.active:
        numbers, largest = _of_a_large_one(problem, fit, effect)
        if len(_units(effect)) > 1:
            precision[quadratic.index(numbers)] /= largest**2
    if (precision == quadratic.precision).all():
        return fit
    wider = replace(quadratic, precision=precision)
    _, move = wider.best(free)
    std, wide = quadratic.std(free), wider.std(free)
    apart = {
        name: math.sqrt(float(move[i]) ** 2 + max(wide[name] ** 2 - std[name] ** 2, 0.0))
        for name, i in zip(free, quadratic.index(free), strict=True)
    }
    return less_sure(problem, fit, quadratic, evidence, apart)


def _of_a_large_one(problem: Problem, fit: Fit, effect: str) -> tuple[list[str], float]:
    """An effect's numbers that act, and the largest's size [prior std]; none where that is usual."""
    acting = set(problem.acting_names(effect))
    sizes_of = {
        f.name: abs(fit.values[f.name] - f.value) / f.std
        for f in problem.own[effect]
        if f.name in acting
    }
    largest = max(sizes_of.values())
    return (list(sizes_of), largest) if len(sizes_of) > 1 and largest > UNUSUAL_FROM else ([], 1.0)


def _units(effect: str) -> set[str]:
    """Units of an effect's numbers but for those of its shape."""
    return {p.unit for p in effects.CATALOGUE[effect].parameters if not p.shape}
