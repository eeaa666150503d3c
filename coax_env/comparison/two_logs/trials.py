"""What a set of changes is worth: fitted to the difference of two logs, weighed, kept or dropped.

What is left of the difference comes of how well forms and rows can express the change, and its size is
not known. So a set of changes is worth, in nats, half the number of blocks of BLOCK seconds times the
log of how many times smaller it makes the difference (a normal residual of unknown variance; Schwarz
1978 for the numbers that it takes), FORM_ERROR of it never counted.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from coax_env.comparison.two_logs.coordinates import Coordinate, moved
from coax_env.comparison.two_logs.logs import Logs
from coax_env.diagnosis.settings import Settings
from coax_env.estimation.quadratic import bounded_solve

STEPS = 5  # Gauss-Newton steps at most; ours
CONVERGED = 1e-3  # usual sizes that a last step may move; ours
FORM_ERROR = 0.03
"""Share of the squared difference that may be left, since forms and rows express a change only so well.

Measured: a delay of 30 ms, resampled on rows 7 ms apart, leaves 1 %; ours.
"""
MANY_FORM_ERRORS = 3.0
"""FORM_ERRORs that a change must be worth that is named by a flight's own noise only; ours."""
RIDGE = 100.0  # usual sizes: prior of a change that is there, wide enough not to move it; ours
TRIALS = 4  # candidates that are fitted at once, the best by the derivatives first; ours
HOPELESS = 0.5  # share of the best gain below which a candidate is not fitted; ours


@dataclass(frozen=True)
class Trial:
    """Some effects changed, fitted. nats: worth over nothing changed."""

    effects: tuple[str, ...]
    moves: Mapping[str, float]
    nats: float
    residual: np.ndarray = field(repr=False)
    slopes: np.ndarray = field(repr=False)


def best_trials(
    logs: Logs,
    known: Mapping[str, Sequence[Coordinate]],
    slopes: Mapping[str, np.ndarray],
    best: Trial,
    nothing: np.ndarray,
) -> list[Trial]:
    """One more effect changed, the best few by the derivatives fitted; the best first.

    Args:
        logs: two logs. known: effect -> its coordinates. slopes: effect -> its columns of
            derivatives of the difference, (k, coordinates).
        best: what has changed so far. nothing: the difference (k,) with nothing changed.
    """
    gains: dict[str, float] = {}
    for effect in known.keys() - set(best.effects):
        J = np.column_stack([best.slopes, slopes[effect]])
        A = J.T @ J + ridge_of([c for e in (*best.effects, effect) for c in known[e]])
        b = J.T @ best.residual
        gains[effect] = float(0.5 * b @ np.linalg.solve(A, b))
    ranked = sorted(gains, key=lambda e: -gains[e])[:TRIALS]
    tried = [e for e in ranked if gains[e] > HOPELESS * gains[ranked[0]]]
    found = [fitted(logs, known, (*best.effects, e), best.moves, nothing) for e in tried]
    return sorted(found, key=lambda trial: -trial.nats)


def fitted(
    logs: Logs,
    known: Mapping[str, Sequence[Coordinate]],
    effect_names: tuple[str, ...],
    begin: Mapping[str, float],
    nothing: np.ndarray,
) -> Trial:
    """Moves of some effects by Gauss-Newton, the others at what they were before.

    Args:
        logs: two logs. known: effect -> its coordinates. effect_names: those that move.
        begin: coordinate -> its move to begin with. nothing: the difference (k,) with nothing changed.
    """
    own = [c for e in effect_names for c in known[e]]
    usual = np.array([c.usual for c in own])
    lower, upper = (np.array([getattr(c, side) for c in own]) for side in ("lower", "upper"))
    x = np.array([begin.get(c.name, 0.0) for c in own])

    def at(x: np.ndarray) -> dict[str, float]:
        return moved(logs.fit.values, dict(zip((c.name for c in own), x.tolist(), strict=True)))

    ridge = ridge_of(own)

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
    nats = worth(nothing, residual, len(own), int(logs.block.max()) + 1)
    moves = dict(zip((c.name for c in own), x.tolist(), strict=True))
    return Trial(effect_names, moves, nats, residual, J)


def ridge_of(own: Sequence[Coordinate]) -> np.ndarray:
    """Precision of the prior of some coordinates `own`, (c, c)."""
    return np.diag([1.0 / (RIDGE * c.usual) ** 2 for c in own])


def worth(nothing: np.ndarray, residual: np.ndarray, numbers: int, blocks: int) -> float:
    """Nats of a set of changes.

    Args:
        nothing: the difference (k,) with nothing changed. residual: what the set leaves of it.
        numbers: of the set. blocks: of BLOCK seconds.
    """
    whole = float(nothing @ nothing)
    left = float(residual @ residual) / whole + FORM_ERROR
    return 0.5 * blocks * math.log((1.0 + FORM_ERROR) / left) - 0.5 * numbers * math.log(blocks)


def nats_of(residual: np.ndarray) -> float:
    """What a `residual` of the difference (k,) would be worth in a flight with noise of its own."""
    return float(0.5 * residual @ residual)


def holds(more: Trial, fewer: Trial, nothing: np.ndarray, settings: Settings) -> bool:
    """Whether one more change is worth it: by the logs themselves, or by a flight's own noise.

    The latter where two changes are there and one alone leaves much; never in what forms leave.

    Args:
        more, fewer: with and without the change. nothing: the difference (k,) with nothing changed.
        settings: with the threshold.
    """
    share = (nats_of(fewer.residual) - nats_of(more.residual)) / nats_of(nothing)
    by_flight = nats_of(fewer.residual) - nats_of(more.residual) > settings.evidence
    by_logs = more.nats - fewer.nats > settings.evidence
    return by_logs or (by_flight and share > MANY_FORM_ERRORS * FORM_ERROR)


def without_worthless(
    logs: Logs,
    known: Mapping[str, Sequence[Coordinate]],
    best: Trial,
    nothing: np.ndarray,
    settings: Settings,
) -> Trial:
    """Without the changes that stood for those that came after them.

    Args:
        logs: two logs. known: effect -> its coordinates. best: changes in the order in which they came.
        nothing: the difference (k,) with nothing changed. settings: with the threshold.
    """
    for effect in best.effects[:-1]:
        rest = tuple(e for e in best.effects if e != effect)
        fewer = fitted(logs, known, rest, best.moves, nothing)
        if not holds(best, fewer, nothing, settings):
            best = fewer
    return best
