"""Input innovations: what the commands show of the machine beyond what the readings do.

A filter takes the commands as given. But whoever flies watches the machine itself, and corrects what
the logged sensors show late or hardly at all. A command then carries information on the state, and the
filter's error is correlated with it: gusts that are flown out look like a machine that answers weakly
and late (inertias, lags and delays too large, by several standard deviations; "in closed loop the
commands follow the gusts", Ljung 1999, ch. 13).

Here the joint input-output likelihood is kept in its innovation form (Ljung 1999, sec. 13.5, joint
input-output identification). What a command is beyond its prediction, its innovation, corrects the
filter's state by constant gains, as a reading would::

    u[k] = predicted from u[k-1], u[k-2] and the filter's states + innovation[k]
    x[k] <- x[k] + command_gain innovation[k]

The prediction is a linear regression, the same for all runs, robust against the steps of a maneuver,
which are no answer to the machine: innovations are clipped. The gains are fitted with everything else;
their prior says that a command cannot show more of a state than the filter does not know.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.fits import fitted
from coax_env.diagnosis.problem import Fit, Problem
from coax_env.diagnosis.shocks import engine_of
from coax_env.estimation.engine import Engine
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import FreeParameter, Record
from coax_env.estimation.whiteness import is_white
from coax_env.model import parameters as P
from coax_env.model import state as S

CLIP = 2.0
"""Robust standard deviations at which an innovation is clipped: more is a maneuver; ours."""
_ROUNDS = 5  # of reweighting
_SINGULAR = 1e-13  # of the largest singular value of the normal equations: rounding, and thus none
_SAMPLE_ROWS = 37  # rows between samples of the filter's covariance, prime to all sensors' cycles
_TRANSIENT_ROWS = 100  # rows that a filter takes to forget its start
_SEEN = (S.U, S.V, S.W, S.P, S.Q, S.R, S.PHI, S.THETA, S.PSI, S.X, S.Y, S.Z)  # by a pilot
_HEADING, _NORTH, _EAST = (_SEEN.index(state) for state in (S.PSI, S.X, S.Y))
_LEAST_COMMAND_STD = 1e-9  # std [rad, rad/s] below which a command is not flown by anyone

# per gain: the states it corrects, and what of the innovations (upper, lower, lon, lat) it takes
_CORRECTED = (
    (S.P, S.Q), (S.GUST_L, S.GUST_M), (S.GUST_X, S.GUST_Y), (S.R,), (S.GUST_N,), (S.W,), (S.GUST_Z,),
)  # fmt: skip
_TILTS = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_TURN = np.array([[1.0, -1.0, 0.0, 0.0]])
_LIFT = np.array([[1.0, 1.0, 0.0, 0.0]])
_TAKEN = (_TILTS, _TILTS, _TILTS, _TURN, _TURN, _LIFT, _LIFT)


def with_command_gains(problem: Problem, fit: Fit, coloured: bool = False) -> tuple[Problem, Fit]:
    """Fit the gains of the input innovations, where that gains more than a tie.

    Only where the innovations of the readings are white: what a model gets wrong follows the commands
    too, and the gains would explain it away.

    Args:
        problem, fit: after the search.
        coloured: fit them where innovations are not white, too: to ask names, not to be stated.

    Returns:
        the problem with input innovations in its records and the gains free, and the fit with them;
        both as they were where that gains nothing.
    """
    passes = _passes(problem.engine, fit)
    if not coloured and not is_white(passes, problem.model.channels):
        return problem, fit
    found = _innovations(passes)
    wider = problem.with_records(_with(problem.engine.records, found)).with_free(
        _gains(passes, found)
    )
    tie = problem.settings.tie
    trial = fitted(wider, fit.at({n: fit.values.get(n, 0.0) for n in P.COMMAND_GAINS}),
                   tolerance=0.5 * tie)  # fmt: skip
    gained = fit.objective - trial.objective
    if not gained > tie:  # none of two fits whose filters diverge
        return problem, fit
    problem.report(f"the commands carry information on the gusts: {gained:.1f} nats")
    return wider, trial


def has_command_gains(problem: Problem) -> bool:
    """Whether the gains of the input innovations are fitted."""
    return any(f.name in P.COMMAND_GAINS for f in problem.added)


def engine_as_fitted(problem: Problem, records: Sequence[Record], fit: Fit) -> Engine:
    """An engine over other records, with all that the fitted ones have: strengths, input innovations.

    Args:
        problem: as fitted. records: that were not fitted. fit: of the model that flies them.
    """
    engine = engine_of(problem, records, fit)
    return with_input_innovations(engine, fit) if has_command_gains(problem) else engine


def with_input_innovations(engine: Engine, fit: Fit) -> Engine:
    """The engine with the input innovations at a fit in its records."""
    found = _innovations(_passes(engine, fit))
    return Engine(engine.model, _with(engine.records, found), engine.threads)


def _with(records: Sequence[Record], found: Sequence[np.ndarray]) -> list[Record]:
    return [replace(r, input_innovations=e) for r, e in zip(records, found, strict=True)]


def _passes(engine: Engine, fit: Fit) -> list[RunPass]:
    rows = [np.arange(_TRANSIENT_ROWS, r.t.size, _SAMPLE_ROWS) for r in engine.records]
    return engine.filter(fit.values, fit.noise, start_rows=rows)


def _innovations(passes: Sequence[RunPass]) -> list[np.ndarray]:
    """What is not predicted of each run's commands, clipped, (n, 4) each."""
    known, change = [], []
    for run in passes:
        seen = run.states[:, _SEEN].copy()
        north, east = seen[:, _NORTH].copy(), seen[:, _EAST].copy()
        cosine, sine = np.cos(seen[:, _HEADING]), np.sin(seen[:, _HEADING])
        seen[:, _NORTH] = cosine * north + sine * east  # ahead and to the right, for a pilot
        seen[:, _EAST] = cosine * east - sine * north
        u = run.record.command
        rows = np.hstack([seen[2:], seen[1:-1], u[1:-1], u[:-2]])
        known.append(rows - rows.mean(axis=0))
        change.append(u[2:] - u[1:-1])
    all_known, all_changes = np.vstack(known), np.vstack(change)
    residuals = np.column_stack([clipped_residual(all_known, c) for c in all_changes.T])
    ends = np.cumsum([len(part) for part in change])
    return [
        np.vstack([np.zeros((2, residuals.shape[1])), part])
        for part in np.split(residuals, ends[:-1])
    ]


def clipped_residual(known: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Residual of a robust regression (Huber's weights), clipped; zero where nothing changed.

    Args:
        known: what a command may be predicted from, (n, k).
        change: of the command since the row before, (n,).

    Returns:
        shape (n,), in the command's unit.
    """
    moved = change != 0.0
    result = np.zeros_like(change)
    if moved.sum() <= 2 * known.shape[1]:
        return result
    X, y = known[moved], change[moved]
    X = np.column_stack([X / np.maximum(X.std(axis=0), 1e-12), np.ones(len(X))])
    weight = np.ones(len(X))
    for _ in range(_ROUNDS):
        weighted = X * weight[:, None]
        solution = np.linalg.lstsq(weighted.T @ X, weighted.T @ y, rcond=_SINGULAR)[0]
        rest = y - X @ solution
        std = 1.4826 * float(np.median(np.abs(rest)))
        weight = np.minimum(1.0, CLIP * std / np.maximum(np.abs(rest), 1e-300))
    result[moved] = np.clip(rest, -CLIP * std, CLIP * std)
    return result


def _gains(passes: Sequence[RunPass], found: Sequence[np.ndarray]) -> list[FreeParameter]:
    """The gains with their priors: std of the filter's error over that of the innovations."""
    variances = [np.einsum("sii->si", run.start_covariances) for run in passes]
    unknown = np.sqrt(np.vstack(variances).mean(axis=0))
    spread = np.vstack(found)
    gains = []
    for name, corrected, taken in zip(P.COMMAND_GAINS, _CORRECTED, _TAKEN, strict=True):
        std = float(np.sqrt(np.mean((spread @ taken.T) ** 2)))
        if std > _LEAST_COMMAND_STD:
            gains.append(FreeParameter(name, 0.0, float(unknown[list(corrected)].mean()) / std))
    return gains
