"""What a flexible model without names removes of the error: every generic term at once.

Bayesian linear regression on the residual wrench (a Gaussian process whose kernel is these terms), of
the whitened innovations and not of reconstructed forces, so that what the pilot does against a gust is
not taken for its cause. On each axis the prior's width is that of largest evidence. One Newton step: a
wrench enters the innovations nearly linearly.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.fits import at_optimum, linearise
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.unlisted import measured_terms, parameters
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter
from coax_env.model.generic_terms import AXES

PRIOR_WIDTHS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.001)  # in usual sizes


def black_box(problem: Problem, refitted: Fit) -> Fit:
    """The model with every term on every axis, from one whose own numbers are fitted."""
    known = measured_terms(problem)
    coefficients = [f for axis in AXES for f in parameters(problem.model, axis, known)]
    terms = [FreeParameter(f.name, 0.0, f.std) for f in coefficients]
    names = [f.name for f in terms]
    bare = replace(problem, own={}, added=())
    rest = bare.base_names(())
    box = bare.with_free(terms)
    fit = replace(refitted.at(dict.fromkeys(names, 0.0)), active=())
    fit, _, quadratic = linearise(box, fit)

    def with_widths(widths: Mapping[str, float]) -> Quadratic:
        shrink = np.array([widths[f.name.partition(".")[0]] for f in terms])
        precision = quadratic.precision.copy()
        precision[quadratic.index(names)] /= shrink**2
        return replace(quadratic, precision=precision)

    def evidence(widths: Mapping[str, float]) -> float:
        narrow = with_widths(widths)
        A = narrow.G + np.diag(narrow.precision)
        slope = narrow.g + narrow.precision * (narrow.at - narrow.mean)
        return 0.5 * float(slope @ np.linalg.solve(A, slope)) - narrow.occam(names, rest)

    widths = dict.fromkeys(AXES, PRIOR_WIDTHS[-1])
    for axis in (*AXES, *AXES):
        tried = [widths | {axis: width} for width in PRIOR_WIDTHS]
        widths = max(tried, key=evidence)
    return at_optimum(box, fit, with_widths(widths), (), {})
