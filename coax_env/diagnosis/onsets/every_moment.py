"""A change scored at every moment at once, at the gains of the filter without it.

A generalised likelihood ratio (Willsky and Jones 1976; Basseville and Nikiforov 1993, ch. 7), from one
pass back over each run (estimation/beginnings.py).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from coax_env.diagnosis.onsets.changing import Changing, may_begin
from coax_env.diagnosis.onsets.ends import MARGIN
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.estimation.beginnings import Asked, Beginning
from coax_env.estimation.changing_model import BEFORE
from coax_env.estimation.engine import objective
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import Record

SPACING = 0.01
"""s between the moments that are scored at once: every row of a log at 100 Hz. What jumps in a reading,
as thrust does in specific force, shows at its own row and is gone 0.02 s beside it; ours."""
MOST_MOMENTS = 6000
"""On long flights they are farther apart than that; ours, a bound on time."""
ROWS_AT_ONCE = 64
"""Moments whose matrices are made at once: some megabytes; ours."""
SETTLED = 1.0
"""s of a run after which a change in it can be told from its start; ours."""


@dataclass(frozen=True)
class Scored:
    """What a change of one effect is worth, by the quadratic. nats: over all moments. moment: the best.

    move: name -> what changes there, or where it ends, what was there before. beside: what it is worth
    beside the same cause that was always there.
    """

    effect: str
    nats: float
    moment: Moment
    move: Mapping[str, float]
    ends: bool
    beside: float


def scored(state: Changing) -> tuple[Changing, list[Scored]]:
    """Effects that may have begun, changed or ended, by what that is worth at any moment, best first.

    Args:
        state: a fit, wherever its quadratic was taken.

    Returns:
        the state with its objective and the quadratic at it, and the effects; as it is where none may.
    """
    problem, fit = state.problem, state.fit
    names = {e: _own(problem, e) for e in may_begin(problem, fit, state.onsets)}
    if not names:
        return state, []
    records = problem.engine.records
    rows = rows_of(records)
    everything = problem.parameters
    passes, lin, found = problem.engine.beginnings(
        fit.values, fit.noise, everything, rows, _asked(problem, fit, names)
    )
    fit = replace(fit, objective=objective(passes, problem.free(fit.active), fit.values))
    state = replace(state, fit=fit, quadratic=Quadratic.of(lin, everything, fit.values))
    table = Table.of(state, names)
    every = [
        Moment(record.whole, float(record.t[b.row]))
        for record, of_run in zip(records, found, strict=True)
        for b in of_run
    ]
    if not every:
        return state, []
    slopes, information, crossed = table.rows(found)
    ended = table.ended(slopes, information, crossed)
    best = []
    for k, (effect, own) in enumerate(names.items()):
        forms, always = [(False, *table.worth(k, slopes, information))], 0.0
        if effect not in fit.active:
            forms.append((True, *table.worth(k, *ended)))
            always = max(0.0, table.worth_of_constant(k))
        of_effect = []
        for ends, nats, moves in forms:
            if np.isfinite(nats).any():
                at = int(np.argmax(nats))
                total = float(logsumexp(nats)) - math.log(len(every))  # each as likely as any other
                move = dict(zip(own, moves[at].tolist(), strict=True))
                of_effect.append(Scored(effect, total, every[at], move, ends, total - always))
        best += sorted(of_effect, key=lambda s: -s.nats)[:1]
    return state, sorted(best, key=lambda s: -s.nats)


def _own(problem: Problem, effect: str) -> list[str]:
    """Plain names of an effect's numbers that act."""
    return [n for n in problem.acting_names(effect) if not n.endswith(BEFORE)]


def rows_of(records: Sequence[Record]) -> list[np.ndarray]:
    """Rows of each record at which something may begin: its first one, and every SPACING later on."""
    spacing = max(SPACING, sum(float(r.t[-1] - r.t[0]) for r in records) / MOST_MOMENTS)
    found = []
    for i, record in enumerate(records):
        t = record.t
        times = np.arange(t[0] + SETTLED, t[-1], spacing)
        if i > 0:
            times = np.append(t[0], times)
        else:
            times = times[times > t[0] + MARGIN]
        if i == len(records) - 1:
            times = times[times < t[-1] - MARGIN]
        found.append(np.unique(np.searchsorted(t, times - 1e-9)).astype(np.int64))
    return found


def _asked(problem: Problem, fit: Fit, names: Mapping[str, Sequence[str]]) -> Asked:
    """What a score takes of every row: beside what is free, and pairs of each effect's numbers."""
    places = {f.name: k for k, f in enumerate(problem.parameters)}
    groups = [np.array([places[n] for n in own], np.int64) for own in names.values()]
    return Asked(
        np.array([places[n] for n in problem.free_names(fit.active)], np.int64),
        np.concatenate([np.repeat(c, c.size) for c in groups]),
        np.concatenate([np.tile(c, c.size) for c in groups]),
    )


@dataclass(frozen=True)
class Table:
    """What the score of a change takes that does not depend on its moment.

    later: information (k, k) and slope_later: slope (k,) of all records behind each one. rest: places
    of what is free beside a change, inverse: (r, r) of its information and prior, pull: (r,) its slope.
    groups: places of each effect's numbers, smallest: sizes that matter of these, pairs: places of the
    groups' matrices.

    Variances are not inflated by the colour of the innovations: what changed and is not in the model
    yet colours them itself, and most of all the scores of its own numbers.
    """

    quadratic: Quadratic
    later: Sequence[np.ndarray]
    slope_later: Sequence[np.ndarray]
    rest: np.ndarray
    inverse: np.ndarray
    pull: np.ndarray
    groups: Sequence[np.ndarray]
    smallest: Sequence[np.ndarray]
    pairs: tuple[np.ndarray, np.ndarray]
    swapped: np.ndarray

    @classmethod
    def of(cls, state: Changing, names: Mapping[str, Sequence[str]]) -> "Table":
        """At a fit, for effects with these numbers."""
        problem, quadratic = state.problem, state.quadratic
        assert quadratic.parts is not None
        asked = _asked(problem, state.fit, names)
        rest = asked.beside
        pull = quadratic.g + quadratic.precision * (quadratic.at - quadratic.mean)
        known = quadratic.G[np.ix_(rest, rest)] + np.diag(quadratic.precision[rest])
        groups = [quadratic.index(own) for own in names.values()]
        firsts = np.cumsum([0, *(c.size**2 for c in groups)])
        sizes = {
            f"{e}.{p.name}": max(p.smallest, 1e-12) for e in names for p in problem.model.sized(e)
        }
        return cls(
            quadratic,
            _behind(quadratic.parts.information),
            _behind(quadratic.parts.slope),
            rest,
            cho_solve(cho_factor(known), np.eye(rest.size)),
            pull[rest],
            groups,
            [np.array([sizes[n] for n in own]) for own in names.values()],
            (asked.first, asked.second),
            np.concatenate(
                [first + np.arange(c.size**2).reshape(c.size, c.size).T.ravel()
                 for first, c in zip(firsts, groups, strict=False)]
            ),
        )  # fmt: skip

    def rows(
        self, found: Sequence[Sequence[Beginning]]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slope and information of every effect's numbers that move from each row on, and information
        across them and those that always were, what is free beside them projected out: (n, k) of all
        numbers, and the groups' matrices (n, p), row by row.

        Args:
            found: by record.
        """
        some = [
            of_run[k : k + ROWS_AT_ONCE]
            for of_run in found
            for k in range(0, len(of_run), ROWS_AT_ONCE)
        ]
        slopes, information, crossed = zip(*map(self._some_rows, some), strict=True)
        return np.concatenate(slopes), np.concatenate(information), np.concatenate(crossed)

    def _some_rows(self, some: Sequence[Beginning]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`rows` of some of one record."""
        later = self.later[some[0].record]
        across = np.array([b.across for b in some]) + later[:, self.rest]
        weights = across @ self.inverse
        slopes = np.array([b.slope for b in some]) + self.slope_later[some[0].record]
        i, j = self.pairs
        of_rest, behind = across[:, i], later[i, j]
        own = np.array([b.own for b in some]) + behind
        crossed = np.array([b.crossed for b in some]) + behind
        return (
            slopes - weights @ self.pull,
            own - np.einsum("npr,npr->np", of_rest, weights[:, j]),
            crossed - np.einsum("npr,pr->np", of_rest, self.always[1][j]),
        )

    @cached_property
    def always(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slope (k,) of numbers that always were, their weights on what is free beside them (k, r), and
        the groups' information.
        """
        across = self.quadratic.G[:, self.rest]
        weights = across @ self.inverse
        i, j = self.pairs
        own = self.quadratic.G[i, j] - np.einsum("pr,pr->p", across[i], weights[j])
        return self.quadratic.g - weights @ self.pull, weights, own

    def ended(
        self, slopes: np.ndarray, information: np.ndarray, crossed: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Slopes and information of what was there up to each row: of what always was, less what moves
        from there on.

        Args:
            slopes, information, crossed: as of `rows`.
        """
        slope, _, own = self.always
        return slope - slopes, own - crossed - crossed[:, self.swapped] + information

    def worth_of_constant(self, k: int) -> float:
        """What one effect is worth that was always there [nats]; k: its place."""
        slope, _, own = self.always
        return float(self.worth(k, slope[None], own[None])[0][0])

    def worth(
        self, k: int, slopes: np.ndarray, information: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """What a change of one effect is worth from each row on [nats], and how its numbers move.

        Where bounds are met the move is cut off there: it is worth that at least.

        Args:
            k: the effect's place. slopes, information: as of `rows`.
        """
        q, c = self.quadratic, self.groups[k]
        first = sum(group.size**2 for group in self.groups[:k])
        prior = q.precision[c]
        A = information[:, first : first + c.size**2].reshape(-1, c.size, c.size) + np.diag(prior)
        slope = slopes[:, c]
        x = np.linalg.solve(A, -slope[:, :, None])[:, :, 0]
        x = np.clip(x, (q.lower - q.at)[c], (q.upper - q.at)[c])
        gained = -np.sum((slope + 0.5 * np.einsum("nij,nj->ni", A, x)) * x, axis=1)
        occam = 0.5 * np.linalg.slogdet(A / np.sqrt(np.outer(prior, prior)))[1]
        large = np.any(np.abs(x) >= self.smallest[k], axis=1)
        return np.where(large, gained - occam, -math.inf), x


def _behind(parts: np.ndarray) -> list[np.ndarray]:
    """Sums over the records behind each one; parts: (records, ...)."""
    total = parts.sum(0)
    return list(total - np.cumsum(parts, axis=0))
