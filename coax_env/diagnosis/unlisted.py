"""What no effect of the catalogue explains: generic terms on the six axes, found by their signatures.

The filter's gust states soak up a force or moment that the model lacks. Terms of generic_terms.py are
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

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from coax_env.diagnosis.search import EVIDENCE, Search, State
from coax_env.estimation.fit import RunPass
from coax_env.estimation.helicopter import FARTHEST
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter
from coax_env.estimation.whiteness import whiteness
from coax_env.kernel.compilation import compiled
from coax_env.model import dynamics, effects
from coax_env.model.generic_terms import AXES, SMALLEST, TERMS, Term, term_value
from coax_env.model.layout import CHANNELS, GUSTS, N_CHANNELS

SPOKEN_FOR = {
    "unlisted_X": ("ax", ("ax",)),
    "unlisted_Y": ("ay", ("ay",)),
    "unlisted_Z": ("az", ("az", "h", "vd")),
    "unlisted_L": ("p", ("p", "phi")),
    "unlisted_M": ("q", ("q", "theta")),
    "unlisted_N": ("r", ("r", "psi")),
}
"""Channel under which an axis is reported, and the channels it speaks for."""
TERM_EVIDENCE = 2.0 * EVIDENCE
"""Nats a term must be worth: more than an effect, since there are ten times as many to choose from."""
HIDDEN_EVIDENCE = 2.0 * TERM_EVIDENCE
"""The same on an axis whose innovations are white. On a clean gusty flight of eight runs the best of
all terms on all axes reached 4 nats, a moment a sin(3 psi) with a rms of the gusts' own 155."""
SCREENED = 10  # candidates of an axis that are looked at by their signatures
MOST_TERMS = 4  # taken in all
MOST_FAILURES = 3  # that do not hold before the search gives up
SHARE = 0.4
"""Share of an axis' estimated disturbance that a term must follow: less is told apart from nothing.

On real flights everything is a little coloured, and some term is always worth a few nats.
"""
PRIOR_WIDTHS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.001)  # of a black box' terms, in usual sizes
SETTLING = 1.0  # s at the start of each run that are not screened

Candidate = tuple[str, tuple[Term, ...]]
"""Axis, and one term or the sine and cosine of one angle."""
SINGLES = tuple((term,) for term in TERMS)
PAIRS = tuple((a, b) for a, b in pairwise(TERMS) if a.kin and a.kin == b.kin)


@compiled(makes_arrays=True)
def _evaluate(states: np.ndarray, inputs: np.ndarray, p: np.ndarray, out: np.ndarray) -> None:
    """Every term at every row: states (n, 26), inputs (n, 5), out (n, terms)."""
    work = np.empty(dynamics.WORK_SIZE)
    readings = np.empty(N_CHANNELS)
    for k in range(len(states)):
        dynamics.measure(states[k], inputs[k], p, work, readings)  # leaves the workspace filled
        for i in range(out.shape[1]):
            out[k, i] = term_value(i, states[k], work, p)


@dataclass
class Along:
    """The terms along the filtered flight: values (n, terms) and gust estimates (n, 6)."""

    values: np.ndarray
    gusts: np.ndarray

    @classmethod
    def of(cls, search: Search, state: State, passes: Sequence[RunPass]) -> "Along":
        """Evaluated at the filtered states, the first second of each run left out."""
        p = search.model.vector(state.values)
        values, gusts = [], []
        for run in passes:
            late = run.record.t > run.record.t[0] + SETTLING
            table = np.empty((int(late.sum()), len(TERMS)))
            _evaluate(run.states[late], run.inputs[late], p, table)
            values.append(table)
            gusts.append(run.states[late, GUSTS])
        return cls(np.concatenate(values), np.concatenate(gusts))

    def columns(self, terms: Sequence[Term]) -> np.ndarray:
        """Values of some terms, (n, k)."""
        return self.values[:, [TERMS.index(term) for term in terms]]

    def gust(self, axis: str) -> np.ndarray:
        """The disturbance that the filter saw on an axis, (n,)."""
        return self.gusts[:, list(AXES).index(axis)]


def explain(
    search: Search, state: State, quadratic: Quadratic
) -> tuple[State, Quadratic, list[Candidate]]:
    """Add generic terms to the model for what the catalogue has left.

    Returns the state with the terms in it (loose parameters of `search` from here on), its
    quadratic, and what was added. Without a term that is worth it nothing changes.
    """
    taken: list[Candidate] = []
    refused: set[Candidate] = set()
    while len(taken) < MOST_TERMS and len(refused) < MOST_FAILURES:
        passes = search.engine.filter(state.values, state.noise)
        coloured = _coloured_axes(passes)
        along = Along.of(search, state, passes)
        known = {name(axis, t) for axis, terms in taken for t in terms} | set(
            search.model.bare_values
        )
        screened = {
            c: TERM_EVIDENCE if axis in coloured else HIDDEN_EVIDENCE
            for axis in AXES
            for c in _screen(along, axis, known)
            if c not in refused
        }
        best = _best(search, state, screened)
        if best is None:
            break
        trial = _with(search, state, best, screened[best])
        if trial is None:
            refused.add(best)
            continue
        state = trial
        taken.append(best)
        search.say(f"no effect explains {SPOKEN_FOR[best[0]][0]}: added {_words(best)}")
    if not taken:
        return state, quadratic, []
    search.say("searching again beside the unlisted terms")
    state, quadratic = search.run(state)
    return *_prune(search, state, quadratic, taken), taken


def black_box(search: Search, refitted: State) -> State:
    """Every term on every axis at once: what a flexible model without names makes of the fit runs.

    Bayesian linear regression on the residual wrench (a Gaussian process whose kernel is these
    terms), of the whitened innovations and not of reconstructed forces, so that what the pilot does
    against a gust is not taken for its cause. On each axis the prior's width is that of largest
    evidence. One Newton step: a wrench enters the innovations nearly linearly.
    """
    terms = [FreeParameter(f.name, 0.0, f.std) for axis in AXES for f in _parameters(axis, TERMS)]
    names = [f.name for f in terms]
    box = Search(search.engine, search.model, (), search.progress, levels=search.levels)
    rest = [f.name for f in box.base]
    box.loosen(terms)
    state = replace(refitted, values={**refitted.values, **dict.fromkeys(names, 0.0)})
    _, quadratic = box.linearise(state)

    def with_widths(widths: Mapping[str, float]) -> Quadratic:
        shrink = np.array([widths[f.name.partition(".")[0]] for f in terms])
        precision = quadratic.precision.copy()
        precision[quadratic.index(names)] /= shrink**2
        return replace(quadratic, precision=precision)

    def worth(widths: Mapping[str, float]) -> float:
        narrow = with_widths(widths)
        A = narrow.G + np.diag(narrow.precision)
        slope = narrow.g + narrow.precision * (narrow.at - narrow.mean)
        return 0.5 * float(slope @ np.linalg.solve(A, slope)) - narrow.occam(names, rest)

    widths = dict.fromkeys(AXES, PRIOR_WIDTHS[-1])
    for axis in (*AXES, *AXES):
        tried = [widths | {axis: width} for width in PRIOR_WIDTHS]
        widths = max(tried, key=worth)
    return box.moved(state, with_widths(widths), [], {})


def entries(
    search: Search,
    state: State,
    quadratic: Quadratic,
    passes: Sequence[RunPass],
    taken: Sequence[Candidate],
) -> list[dict[str, Any]]:
    """findings.json's `unexplained` for the axes with terms, the largest share first."""
    if not taken:
        return []
    along = Along.of(search, state, passes)
    found = []
    for axis in dict.fromkeys(axis for axis, _ in taken):
        terms = [t for a, group in taken if a == axis for t in group]
        names = [name(axis, t) for t in terms]
        values = np.array([state.values[n] for n in names])
        std = np.array([standard_deviation(search, state, quadratic, n) for n in names])
        rest, load = along.gust(axis), along.columns(terms) @ values
        form = " + ".join(
            f"({v:.3g} ± {s:.1g}) {t.form}" for v, s, t in zip(values, std, terms, strict=True)
        )
        found.append(
            {
                "channel": SPOKEN_FOR[axis][0],
                "depends_on": list(dict.fromkeys(s for t in terms for s in t.follows)),
                "share": round(max(0.0, 1.0 - float(np.var(rest) / np.var(rest + load))), 3),
                "form": f"{form} [{AXES[axis][0]}]",
            }
        )
    return sorted(found, key=lambda entry: -entry["share"])


def speaks_for(found: Sequence[dict[str, Any]]) -> set[str]:
    """Channels whose colour these entries describe."""
    families = dict(SPOKEN_FOR.values())
    return {c for entry in found for c in families[entry["channel"]]}


def standard_deviation(search: Search, state: State, quadratic: Quadratic, one: str) -> float:
    """Posterior std of a term's coefficient, coloured innovations counted as `colours` does."""
    names = search.free_names(state.active)
    variance = quadratic.covariance(names)[names.index(one), names.index(one)]
    return float(np.sqrt(variance * quadratic.colour([one], names)))


def colours(
    search: Search, state: State, quadratic: Quadratic, taken: Sequence[Candidate]
) -> dict[str, float]:
    """Colour of the innovations in the direction of each axis' terms, by axis."""
    free = search.free_names(state.active)
    return {
        axis: quadratic.colour([name(a, t) for a, g in taken if a == axis for t in g], free)
        for axis in dict.fromkeys(axis for axis, _ in taken)
    }


def name(axis: str, term: Term) -> str:
    """Full name of a coefficient."""
    return f"{axis}.{term.key}"


def excitations() -> list[FreeParameter]:
    """Terms that stand for the rest when runs are chosen: no effect needs the heading to turn."""
    turning = [term for term in TERMS if term.key in ("sin_psi", "sin_3psi")]
    return _parameters("unlisted_M", turning)


# --- the search -----------------------------------------------------------------------------------


def _coloured_axes(passes: Sequence[RunPass]) -> list[str]:
    coloured = {c for c, w in whiteness(passes, CHANNELS).items() if not w.white}
    return [axis for axis, (_, family) in SPOKEN_FOR.items() if coloured & set(family)]


def _screen(along: Along, axis: str, known: Collection[str]) -> list[Candidate]:
    """The candidates of an axis that explain most of its gust estimates, and at least SHARE."""
    gust = along.gust(axis)
    ranked = []
    for terms in (*SINGLES, *PAIRS):
        if any(name(axis, t) in known for t in terms):
            continue
        columns = along.columns(terms)
        if np.all(columns.std(0) > 1e-9):
            share = _share(columns, gust)
            if share >= SHARE:
                ranked.append((share, (axis, terms)))
    return [candidate for _, candidate in sorted(ranked, key=lambda r: -r[0])[:SCREENED]]


def _share(columns: np.ndarray, y: np.ndarray) -> float:
    """Share of y's variance that the columns explain beside a constant."""
    design = np.column_stack([columns, np.ones(len(y))])
    left = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    return 1.0 - float(np.var(left) / max(np.var(y), 1e-30))


def _best(search: Search, state: State, needed: Mapping[Candidate, float]) -> Candidate | None:
    """The candidate whose signature is worth most beyond the evidence it needs, if any is."""
    if not needed:
        return None
    own = {f.name: f for axis, terms in needed for f in _parameters(axis, terms)}
    rest = search.free_names(state.active)
    search.loosen(list(own.values()))
    _, quadratic = search.linearise(
        replace(state, values={**state.values, **dict.fromkeys(own, 0.0)})
    )
    search.tighten(own)
    now, _ = quadratic.best(rest)
    ranked = []
    for axis, terms in needed:
        names = [name(axis, t) for t in terms]
        then, _ = quadratic.best(rest + names)
        worth = now - then - quadratic.occam(names, rest)
        ranked.append((worth - needed[axis, terms], (axis, terms)))
    margin, best = max(ranked, key=lambda r: r[0])
    return best if margin > 0.0 else None


def _with(search: Search, state: State, candidate: Candidate, needed: float) -> State | None:
    """The state with a candidate in it, refitted; None where it does not hold or is too small.

    The terms stay loose in `search` only where they hold.
    """
    own = _parameters(*candidate)
    names = [f.name for f in own]
    search.loosen(own)
    values = {**state.values, **dict.fromkeys(names, 0.0)}
    trial = search.refit_noise(search.settle(replace(state, values=values), steps=1))
    trial = search.settle(trial, steps=1)
    passes, quadratic = search.linearise(trial)
    free = search.free_names(trial.active)
    worth = (state.objective - trial.objective) / quadratic.colour(names, free)
    worth -= quadratic.occam(names, [n for n in free if n not in names])
    if worth > needed and _matters(Along.of(search, trial, passes), candidate, trial.values):
        search.history.append((f"+ {_words(candidate)}", worth))
        return trial
    search.tighten(names)
    return None


def _matters(along: Along, candidate: Candidate, values: dict[str, float]) -> bool:
    axis, terms = candidate
    load = along.columns(terms) @ [values[name(axis, t)] for t in terms]
    return float(load.std()) > SMALLEST[AXES[axis][0]]


def _prune(
    search: Search, state: State, quadratic: Quadratic, taken: list[Candidate]
) -> tuple[State, Quadratic]:
    """Take out of `taken`, in place, what the causes found beside it have made worthless."""
    for candidate in list(taken):
        names = [name(candidate[0], t) for t in candidate[1]]
        free = search.free_names(state.active)
        rest = [n for n in free if n not in names]
        now, _ = quadratic.best(free)
        then, _ = quadratic.best(rest, dict.fromkeys(names, 0.0))
        worth = (then - now) / quadratic.colour(names, free) - quadratic.occam(names, rest)
        if worth < TERM_EVIDENCE:
            search.say(f"dropped {_words(candidate)}: worth {worth:.1f} nats")
            taken.remove(candidate)
            search.tighten(names)
            state.values |= dict.fromkeys(names, 0.0)
            state = search.refit_noise(search.settle(state))
            _, quadratic = search.linearise(state)
    return state, quadratic


def _parameters(axis: str, terms: Sequence[Term]) -> list[FreeParameter]:
    known = dict(zip(effects.GROUPS[axis].names(), effects.GROUPS[axis].parameters, strict=True))
    return [
        FreeParameter(full, 0.0, p.usual, -FARTHEST * p.usual, FARTHEST * p.usual)
        for full, p in ((name(axis, t), known[name(axis, t)]) for t in terms)
    ]


def _words(candidate: Candidate) -> str:
    axis, terms = candidate
    return f"{axis[-1]} from " + " and ".join(t.form for t in terms)
