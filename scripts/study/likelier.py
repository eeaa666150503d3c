"""By how much the truth, fitted, is likelier than nothing on a flight: what its likelihood can show.

Expected worth (expected.py) knows the generator's sensors and air, but not what the log makes of them:
a low-pass that has to be taken back, errors that last, commands between rows that nobody knows. Noise
that is fitted without an effect takes it up there. So the truth is also given to the model that the
search ended with, its readings, commands and kinds of noise as found there::

    the hidden effects at their true sizes -> fitted with the noise, from steady noise, too
        -> each left out in turn, fitted with the noise -> nats, less the Occam factor

Which name was found is in none of this; the flight's own chance is: std of sqrt(2 nats).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from coax_env.diagnosis.fits import (
    converged,
    fitted,
    noise_fitted,
    quadratic_at,
    steadied,
    without,
)
from coax_env.diagnosis.problem import Fit, Problem
from study.expected import as_listed

TURNS = 3
"""Of numbers and noise by turns, from true sizes in noise that was fitted without them; ours."""


def likelier_than_nothing(
    problem: Problem | None, nothing: Fit | None, truth: Mapping[str, Any]
) -> dict[str, float | None]:
    """Nats of each hidden effect beside the others; None: no candidate of the search.

    Args:
        problem: what was searched. nothing: in it, without a cause, with its own noise.
        truth: of the generator, `hidden` and `values`.
    """
    assert problem is not None and nothing is not None, "not a diagnosis of its own"
    names, values = as_listed(truth)
    there = [name for name in names.values() if name in problem.candidates]
    result: dict[str, float | None] = dict.fromkeys(truth["hidden"])
    if not there:
        return result
    own = {n: v for n, v in values.items() if n.partition(".")[0] in there}
    true = replace(nothing.at(own), active=tuple(there))
    for _ in range(TURNS):
        true = fitted(problem, noise_fitted(problem, fitted(problem, true)))
    true = converged(problem, steadied(problem, converged(problem, true)))
    true, quadratic = quadratic_at(problem, true)

    def nats(effect: str) -> float:
        rest = converged(problem, noise_fitted(problem, without(problem, true, quadratic, effect)))
        least = rest.objective
        if not rest.active:
            least = min(least, converged(problem, nothing).objective)
        added = problem.acting_names(effect)
        beside = [n for n in problem.free_names(true.active) if n not in added]
        return least - true.objective - quadratic.occam(added, beside)

    return result | {e: nats(name) for e, name in names.items() if name in there}
