"""What no effect of the catalogue explains: generic terms on the six axes, found by their signatures.

The filter's gust states absorb a force or moment that the model lacks. Terms of generic_terms.py are
screened by how much of those estimates they follow; the best are weighed as effects are, by their
signatures with the base parameters and the causes in place projected out; what passes the threshold,
and is large enough to matter in prediction, becomes part of the model and is refitted with it. Then
the catalogue's search goes on from there: a named effect that had soaked up part of what a term
explains is worth nothing beside it and is dropped, one that is needed beside it stays, and one that
explains what the term does comes first, since terms are only asked for what it has left.

In still air such a force leaves coloured innovations. In gusts it does not: the gusts' own memory
whitens it. So an axis whose innovations are white is looked at too, but there a term must follow a
large part of the gusts themselves and be worth twice as much.

A term is a description with a value in prediction, not a cause.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from coax_env.diagnosis.fits import fitted, linearise, noise_fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.search import search
from coax_env.estimation.helicopter import MOST_USUAL_SIZES, HeliModel
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import FreeParameter
from coax_env.estimation.whiteness import whiteness
from coax_env.kernel.compilation import compiled
from coax_env.model import dynamics, effects
from coax_env.model import inputs as U
from coax_env.model import state as S
from coax_env.model import workspace as F
from coax_env.model.generic_terms import AXES, SCALES, SMALLEST, TERMS, Term, term_value
from coax_env.model.layout import CHANNELS, GUSTS, N_CHANNELS
from coax_env.model.usual_sizes import factor

CHANNELS_OF = {
    "unlisted_X": ("ax", ("ax",)),
    "unlisted_Y": ("ay", ("ay",)),
    "unlisted_Z": ("az", ("az", "h", "vd")),
    "unlisted_L": ("p", ("p", "phi")),
    "unlisted_M": ("q", ("q", "theta")),
    "unlisted_N": ("r", ("r", "psi")),
}
"""Channel under which an axis is reported, and all channels in which a load on it shows."""
SETTLING = 1.0  # s at the start of each run that are not screened

Candidate = tuple[str, tuple[Term, ...]]
"""Axis, and one term or the sine and cosine of one angle."""
SINGLES = tuple((term,) for term in TERMS)
PAIRS = tuple((a, b) for a, b in pairwise(TERMS) if a.kin and a.kin == b.kin)


@compiled(makes_arrays=True)
def _evaluate(states: np.ndarray, inputs: np.ndarray, p: np.ndarray, out: np.ndarray) -> None:
    """Every term at every row: states (n, 29), inputs (n, 5), out (n, terms)."""
    work = np.zeros(dynamics.WORK_SIZE)
    readings = np.empty(N_CHANNELS)
    for k in range(len(states)):
        # without an effect the kernel has no use for these, and leaves them
        work[F.LON_STEP] = inputs[k, U.DELTA_LON] - states[k, S.SWASH_LON]
        work[F.LAT_STEP] = inputs[k, U.DELTA_LAT] - states[k, S.SWASH_LAT]
        dynamics.measure(states[k], inputs[k], p, work, readings)  # leaves the workspace filled
        for i in range(out.shape[1]):
            out[k, i] = term_value(i, states[k], work, p)


@dataclass
class TermHistory:
    """The terms along the filtered flight: values (n, terms) and gust estimates (n, 6)."""

    values: np.ndarray
    gusts: np.ndarray

    @classmethod
    def of(cls, problem: Problem, fit: Fit, passes: Sequence[RunPass]) -> "TermHistory":
        """Evaluated at the filtered states, the first second of each run left out.

        Args:
            problem, fit: whose parameters the terms are evaluated with.
            passes: of the filter at the fit.
        """
        p = problem.model.vector(fit.values)
        values, gusts = [], []
        for run in passes:
            rows = run.record.t > run.record.t[0] + SETTLING
            table = np.empty((int(rows.sum()), len(TERMS)))
            _evaluate(run.states[rows], run.inputs[rows], p, table)
            values.append(table)
            gusts.append(run.states[rows, GUSTS])
        return cls(np.concatenate(values), np.concatenate(gusts))

    def columns(self, terms: Sequence[Term]) -> np.ndarray:
        """Values of some terms, (n, k)."""
        return self.values[:, [TERMS.index(term) for term in terms]]

    def gust(self, axis: str) -> np.ndarray:
        """The disturbance that the filter saw on an axis, (n,)."""
        return self.gusts[:, list(AXES).index(axis)]


def explain(
    problem: Problem, fit: Fit, quadratic: Quadratic
) -> tuple[Problem, Fit, Quadratic, list[Candidate]]:
    """Add generic terms to the model for what the catalogue has left.

    Args:
        problem, fit: after the search.
        quadratic: linearised at the fit.

    Returns:
        the problem with the terms free, the fit with them, its quadratic, and what was added. Without
        a term that is worth it nothing changes.
    """
    chosen = problem.settings
    given = problem, fit, quadratic
    taken: list[Candidate] = []
    refused: set[Candidate] = set()
    while len(taken) < chosen.most_terms and len(refused) < chosen.most_failures:
        best = _best(problem, fit, _screened(problem, fit, taken, refused))
        if best is None:
            break
        candidate, needed = best
        trial = _with(problem, fit, candidate, needed)
        if trial is None:
            refused.add(candidate)
            continue
        problem, fit = trial
        taken.append(candidate)
        problem.report(
            f"no effect explains {CHANNELS_OF[candidate[0]][0]}: added {_words(candidate)}"
        )
    if not taken:
        return problem, fit, quadratic, []
    problem.report("searching again beside the generic terms")
    fit, quadratic = search(problem, fit)
    if not math.isfinite(fit.objective):
        problem.report("refused the generic terms: with them the filter diverges")
        return *given, []
    return _pruned(problem, fit, quadratic, taken)


def _screened(
    problem: Problem, fit: Fit, taken: Sequence[Candidate], refused: Collection[Candidate]
) -> dict[Candidate, float]:
    """Candidates whose signatures are worth a look, and the evidence that each needs [nats]."""
    chosen = problem.settings
    passes = problem.engine.filter(fit.values, fit.noise)
    coloured = _coloured_axes(passes)
    history = TermHistory.of(problem, fit, passes)
    known = {name(axis, t) for axis, terms in taken for t in terms} | set(problem.model.bare_values)
    unseen = set(TERMS) - set(measured_terms(problem))
    known |= {name(axis, t) for axis in AXES for t in unseen}
    return {
        c: chosen.term_evidence if axis in coloured else chosen.term_evidence_white
        for axis in AXES
        for c in _screen(problem, history, axis, known)
        if c not in refused
    }


def entries(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    passes: Sequence[RunPass],
    taken: Sequence[Candidate],
) -> list[dict[str, Any]]:
    """findings.json's `unexplained` for the axes with terms, the largest share first.

    Args:
        problem, fit: with the terms.
        quadratic: linearised at the fit.
        passes: of the filter at the fit.
        taken: the terms.
    """
    if not taken:
        return []
    history = TermHistory.of(problem, fit, passes)
    return sorted(
        (
            _entry(
                problem,
                fit,
                quadratic,
                history,
                axis,
                [t for a, g in taken if a == axis for t in g],
            )
            for axis in dict.fromkeys(axis for axis, _ in taken)
        ),
        key=lambda entry: -entry["share"],
    )


def _entry(
    problem: Problem,
    fit: Fit,
    quadratic: Quadratic,
    history: TermHistory,
    axis: str,
    terms: Sequence[Term],
) -> dict[str, Any]:
    names = [name(axis, t) for t in terms]
    values = np.array([fit.values[n] for n in names])
    std = [standard_deviation(problem, fit, quadratic, n) for n in names]
    rest, load = history.gust(axis), history.columns(terms) @ values
    form = " + ".join(
        f"({v:.3g} ± {s:.1g}) {t.form}" for v, s, t in zip(values, std, terms, strict=True)
    )
    return {
        "channel": CHANNELS_OF[axis][0],
        "depends_on": list(dict.fromkeys(s for t in terms for s in t.follows)),
        "share": round(max(0.0, 1.0 - float(np.var(rest) / np.var(rest + load))), 3),
        "form": f"{form} [{AXES[axis][0]}]",
    }


def described_channels(found: Sequence[dict[str, Any]]) -> set[str]:
    """Channels whose coloured innovations these entries describe."""
    families = dict(CHANNELS_OF.values())
    return {c for entry in found for c in families[entry["channel"]]}


def acted_on(problem: Problem) -> set[str]:
    """Channels in which the generic terms that a problem has show."""
    axes = {f.name.partition(".")[0] for f in problem.added} & CHANNELS_OF.keys()
    return {c for axis in axes for c in CHANNELS_OF[axis][1]}


def standard_deviation(problem: Problem, fit: Fit, quadratic: Quadratic, one: str) -> float:
    """Posterior std of a term's coefficient, with the variance inflation of its own direction.

    Args:
        problem, fit: with the term.
        quadratic: linearised at the fit.
        one: full name of the coefficient.
    """
    names = problem.free_names(fit.active)
    variance = quadratic.covariance(names)[names.index(one), names.index(one)]
    return float(np.sqrt(variance * quadratic.variance_inflation([one], names)))


def inflations(
    problem: Problem, fit: Fit, quadratic: Quadratic, taken: Sequence[Candidate]
) -> dict[str, float]:
    """Variance inflation in the direction of each axis' terms, by axis.

    Args:
        problem, fit: with the terms.
        quadratic: linearised at the fit.
        taken: the terms.
    """
    free = problem.free_names(fit.active)
    return {
        axis: quadratic.variance_inflation(
            [name(a, t) for a, g in taken if a == axis for t in g], free
        )
        for axis in dict.fromkeys(axis for axis, _ in taken)
    }


def name(axis: str, term: Term) -> str:
    """Full name of a coefficient."""
    return f"{axis}.{term.key}"


def excitation(
    model: HeliModel, values: Mapping[str, float], passes: Sequence[RunPass]
) -> dict[str, np.ndarray]:
    """How much each run moves every state and command, whatever may follow them.

    Args:
        model: with the vehicle.
        values: of its parameters.
        passes: of a filter over the runs.

    Returns:
        what generic terms follow -> (runs, terms) the time integral of each term squared about its
        mean over all runs.
    """
    p = model.vector(values)
    tables = []
    for run in passes:
        table = np.empty((run.record.t.size, len(TERMS)))
        _evaluate(run.states, run.inputs, p, table)
        tables.append(table)
    mean = np.mean(np.concatenate(tables), axis=0)
    moved = np.array(
        [
            np.gradient(run.record.t) @ (table - mean) ** 2
            for run, table in zip(passes, tables, strict=True)
        ]
    )
    alone = [(k, term.follows[0]) for k, term in enumerate(TERMS) if len(term.follows) == 1]
    return {
        followed: moved[:, [k for k, name in alone if name == followed]]
        for followed in dict.fromkeys(name for _, name in alone)
    }


def measured_terms(problem: Problem) -> list[Term]:
    """The terms that need no channel that no run has."""
    return [t for t in TERMS if problem.aboard.issuperset(t.needs)]


# --- the search -----------------------------------------------------------------------------------


def _coloured_axes(passes: Sequence[RunPass]) -> list[str]:
    coloured = {c for c, w in whiteness(passes, CHANNELS).items() if not w.white}
    return [axis for axis, (_, family) in CHANNELS_OF.items() if coloured & set(family)]


def _screen(
    problem: Problem, history: TermHistory, axis: str, known: Collection[str]
) -> list[Candidate]:
    """The candidates of an axis that explain most of its gust estimates, and enough of them."""
    gust = history.gust(axis)
    ranked = []
    for terms in (*SINGLES, *PAIRS):
        if any(name(axis, t) in known for t in terms):
            continue
        columns = history.columns(terms)
        if np.all(columns.std(0) > 1e-9):
            share = _share(columns, gust)
            if share >= problem.settings.term_share:
                ranked.append((share, (axis, terms)))
    return [
        candidate
        for _, candidate in sorted(ranked, key=lambda r: -r[0])[: problem.settings.terms_screened]
    ]


def _share(columns: np.ndarray, y: np.ndarray) -> float:
    """Share of y's variance that the columns explain beside a constant."""
    design = np.column_stack([columns, np.ones(len(y))])
    left = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    return 1.0 - float(np.var(left) / max(np.var(y), 1e-30))


def _best(
    problem: Problem, fit: Fit, needed: Mapping[Candidate, float]
) -> tuple[Candidate, float] | None:
    """The candidate whose signature gains most beyond the evidence it needs, if any does."""
    if not needed:
        return None
    own = {f.name: f for axis, terms in needed for f in parameters(problem.model, axis, terms)}
    rest = problem.free_names(fit.active)
    _, _, quadratic = linearise(problem.with_free(own.values()), fit.at(dict.fromkeys(own, 0.0)))
    now, _ = quadratic.best(rest)
    ranked = []
    for axis, terms in needed:
        names = [name(axis, t) for t in terms]
        then, _ = quadratic.best(rest + names)
        gain = now - then - quadratic.occam(names, rest)
        ranked.append((gain - needed[axis, terms], (axis, terms)))
    margin, best = max(ranked, key=lambda r: r[0])
    return (best, needed[best]) if margin > 0.0 else None


def _with(
    problem: Problem, fit: Fit, candidate: Candidate, needed: float
) -> tuple[Problem, Fit] | None:
    """Problem and fit with a candidate's terms free; None where they do not hold or are too small."""
    own = parameters(problem.model, *candidate)
    names = [f.name for f in own]
    wider = problem.with_free(own)
    trial = fitted(wider, fit.at(dict.fromkeys(names, 0.0)), steps=1)
    trial = fitted(wider, noise_fitted(wider, trial), steps=1)
    trial, passes, quadratic = linearise(wider, trial)
    free = wider.free_names(trial.active)
    gain = (fit.objective - trial.objective) / quadratic.variance_inflation(names, free)
    gain -= quadratic.occam(names, [n for n in free if n not in names])
    history = TermHistory.of(wider, trial, passes)
    if gain > needed and _matters(problem.model, history, candidate, trial.values):
        return wider, trial.noted(f"+ {_words(candidate)}", gain)
    return None


def _matters(
    model: HeliModel, history: TermHistory, candidate: Candidate, values: Mapping[str, float]
) -> bool:
    axis, terms = candidate
    load = history.columns(terms) @ [values[name(axis, t)] for t in terms]
    smallest = SMALLEST[AXES[axis][0]] * factor(SCALES[axis], model.size_ratios)
    return float(load.std()) > smallest


def _pruned(
    problem: Problem, fit: Fit, quadratic: Quadratic, taken: Sequence[Candidate]
) -> tuple[Problem, Fit, Quadratic, list[Candidate]]:
    """Without the terms that the causes found beside them have made worthless."""
    kept = list(taken)
    for candidate in taken:
        names = [name(candidate[0], t) for t in candidate[1]]
        free = problem.free_names(fit.active)
        rest = [n for n in free if n not in names]
        now, _ = quadratic.best(free)
        then, _ = quadratic.best(rest, dict.fromkeys(names, 0.0))
        gain = (then - now) / quadratic.variance_inflation(names, free)
        gain -= quadratic.occam(names, rest)
        if gain < problem.settings.term_evidence:
            problem.report(f"dropped {_words(candidate)}: worth {gain:.1f} nats")
            kept.remove(candidate)
            problem = problem.with_fixed(names)
            fit = fitted(problem, fit.at(dict.fromkeys(names, 0.0)))
            fit, _, quadratic = linearise(problem, noise_fitted(problem, fit))
    return problem, fit, quadratic, kept


def parameters(model: HeliModel, axis: str, terms: Sequence[Term]) -> list[FreeParameter]:
    """Coefficients of terms on an axis under their priors.

    Args:
        model: whose sizes the priors have. axis: its group. terms: which.
    """
    known = dict(zip(effects.GROUPS[axis].names(), model.sized(axis), strict=True))
    return [
        FreeParameter(full, 0.0, p.usual, -MOST_USUAL_SIZES * p.usual, MOST_USUAL_SIZES * p.usual)
        for full, p in ((name(axis, t), known[name(axis, t)]) for t in terms)
    ]


def _words(candidate: Candidate) -> str:
    axis, terms = candidate
    return f"{axis[-1]} from " + " and ".join(t.form for t in terms)
