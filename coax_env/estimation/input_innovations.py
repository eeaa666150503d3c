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

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from coax_env.estimation.engine import Engine
from coax_env.estimation.run_passes import RunPass
from coax_env.estimation.state_space import FreeParameter, Noise, Record
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


def shown_by_commands(
    engine: Engine, passes: Sequence[RunPass]
) -> tuple[list[Record], list[FreeParameter]]:
    """The engine's records with the input innovations in them, and the gains with their priors.

    Args:
        engine: model and records. passes: of it, with samples of the covariance (`sampled_passes`).
    """
    found = innovations(passes)
    return with_innovations(engine.records, found), command_gains(passes, found)


def with_innovations(records: Sequence[Record], found: Sequence[np.ndarray]) -> list[Record]:
    """Records with the input innovations of each, (n, 4), in them."""
    return [replace(r, input_innovations=e) for r, e in zip(records, found, strict=True)]


def sampled_passes(engine: Engine, values: Mapping[str, float], noise: Noise) -> list[RunPass]:
    """Passes of the filter with samples of its covariance, for `innovations` and `command_gains`.

    Args:
        engine: model and records. values: of all parameters, by name. noise: levels.
    """
    rows = [np.arange(_TRANSIENT_ROWS, r.t.size, _SAMPLE_ROWS) for r in engine.records]
    return engine.filter(values, noise, start_rows=rows)


def innovations(passes: Sequence[RunPass]) -> list[np.ndarray]:
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


def command_gains(passes: Sequence[RunPass], found: Sequence[np.ndarray]) -> list[FreeParameter]:
    """The gains with their priors: std of the filter's error over that of the innovations.

    None where all runs end within the filter's transient.
    """
    variances = np.vstack([np.einsum("sii->si", run.start_covariances) for run in passes])
    if not len(variances):
        return []
    unknown = np.sqrt(variances.mean(axis=0))
    spread = np.vstack(found)
    gains = []
    for name, corrected, taken in zip(P.COMMAND_GAINS, _CORRECTED, _TAKEN, strict=True):
        std = float(np.sqrt(np.mean((spread @ taken.T) ** 2)))
        if std > _LEAST_COMMAND_STD:
            gains.append(FreeParameter(name, 0.0, float(unknown[list(corrected)].mean()) / std))
    return gains
