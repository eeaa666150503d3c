"""What the commands know that the readings do not.

A filter takes the commands as given. But whoever flies watches the machine itself, and corrects what
the logged sensors show late or hardly at all. A command then tells where the machine is, and the
filter's error goes with it: gusts that are flown out look like a machine that answers weakly and late
(inertias, lags and delays too large, by several standard deviations; "in closed loop the commands
follow the gusts", Ljung 1999, ch. 13).

Here the joint likelihood of readings and commands is kept in its innovation form. What a command says
beyond what could be foreseen, its *news*, corrects the filter's state by constant gains, as a reading
would::

    u[k] = foreseen from u[k-1], u[k-2] and the filter's states + news[k]
    x[k] <- x[k] + command_gain news[k]

The foreseeable part is a linear regression, the same for all runs, robust against the steps of a
maneuver, which nobody's eyes have caused: news is clipped. The gains are fitted with everything else;
their prior says that news cannot tell more of a state than the filter does not know.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coax_env.diagnosis.search import TIE, Search, State
from coax_env.estimation.fit import Engine, RunPass
from coax_env.estimation.state_space import FreeParameter
from coax_env.estimation.whiteness import is_white
from coax_env.model import parameters as P

CLIP = 2.0
"""Robust standard deviations at which news ends: more is a maneuver."""
_ROUNDS = 5  # of reweighting
_EVERY = 37  # rows between looks at the filter's covariance, prime to all sensors' cycles
_SETTLED = 100  # rows that a filter takes to forget its start
_SEEN = (0, 1, 2, 3, 4, 5, 10, 11, 12, 13, 14, 15)  # states that a pilot can see
_LEAST = 1e-9  # std [rad, rad/s] below which a command is not flown by anyone

# per gain: the states it corrects, and what of the news (upper, lower, lon, lat) it takes
_CORRECTED = ((3, 4), (23, 24), (20, 21), (5,), (25,), (2,), (22,))
_TILTS = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_TURN = np.array([[1.0, -1.0, 0.0, 0.0]])
_LIFT = np.array([[1.0, 1.0, 0.0, 0.0]])
_TAKEN = (_TILTS, _TILTS, _TILTS, _TURN, _TURN, _LIFT, _LIFT)


def listen(search: Search, state: State) -> bool:
    """Fit the gains of the commands' news, where that is worth more than TIE. Changes `state`.

    Only where the innovations are white: what a model gets wrong follows the commands too, and news
    would explain it away. Once they are fitted, they stay: called again, it does nothing.

    Returns:
        whether the gains are fitted from now on.
    """
    if any(f.name in P.COMMAND_GAINS for f in search.base):
        return True
    passes = _passes(search.engine, state)
    if not is_white(passes, search.model.channels):
        return False
    gains = _gains(passes, _attach(search.engine, passes))
    search.loosen(gains)
    trial = replace(state, values={**dict.fromkeys(P.COMMAND_GAINS, 0.0), **state.values})
    trial = search.settle(trial, tolerance=0.5 * TIE)
    if state.objective - trial.objective > TIE:
        search.say(f"the commands know of the gusts: {state.objective - trial.objective:.1f} nats")
        state.values, state.objective = trial.values, trial.objective
        return True
    search.tighten(P.COMMAND_GAINS)
    for i, record in enumerate(search.engine.records):
        search.engine.records[i] = replace(record, news=None)
    return False


def attach_news(engine: Engine, state: State) -> None:
    """Give every record of an engine its news, from the filter at a state."""
    _attach(engine, _passes(engine, state))


def _passes(engine: Engine, state: State) -> list[RunPass]:
    rows = [np.arange(_SETTLED, r.t.size, _EVERY) for r in engine.records]
    return engine.filter(state.values, state.noise, start_rows=rows)


def _attach(engine: Engine, passes: Sequence[RunPass]) -> list[np.ndarray]:
    found = _news(passes)
    for i, news in enumerate(found):
        engine.records[i] = replace(engine.records[i], news=news)
    return found


def _news(passes: Sequence[RunPass]) -> list[np.ndarray]:
    """What cannot be foreseen of each run's commands, clipped, (n, 4) each."""
    known, change = [], []
    for run in passes:
        seen = run.states[:, _SEEN].copy()
        north, east = seen[:, 9].copy(), seen[:, 10].copy()
        cosine, sine = np.cos(seen[:, 8]), np.sin(seen[:, 8])
        seen[:, 9], seen[:, 10] = cosine * north + sine * east, cosine * east - sine * north
        u = run.record.command
        rows = np.hstack([seen[2:], seen[1:-1], u[1:-1], u[:-2]])
        known.append(rows - rows.mean(axis=0))
        change.append(u[2:] - u[1:-1])
    all_known, all_changes = np.vstack(known), np.vstack(change)
    unforeseen = np.column_stack([surprise(all_known, column) for column in all_changes.T])
    ends = np.cumsum([len(part) for part in change])
    return [
        np.vstack([np.zeros((2, unforeseen.shape[1])), part])
        for part in np.split(unforeseen, ends[:-1])
    ]


def surprise(known: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Residual of a robust regression (Huber's weights), clipped; zero where nothing changed.

    Args:
        known: (n, k) what a command may follow. change: (n,) of the command since the row before.

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
        solution = np.linalg.lstsq(X * weight[:, None], y * weight, rcond=1e-8)[0]
        rest = y - X @ solution
        std = 1.4826 * float(np.median(np.abs(rest)))
        weight = np.sqrt(np.minimum(1.0, CLIP * std / np.maximum(np.abs(rest), 1e-300)))
    result[moved] = np.clip(rest, -CLIP * std, CLIP * std)
    return result


def _gains(passes: Sequence[RunPass], news: Sequence[np.ndarray]) -> list[FreeParameter]:
    """The gains with their priors: std of the filter's error over that of the news."""
    variances = [np.einsum("sii->si", run.start_covariances) for run in passes]
    unknown = np.sqrt(np.vstack(variances).mean(axis=0))
    spread = np.vstack(news)
    found = []
    for name, corrected, taken in zip(P.COMMAND_GAINS, _CORRECTED, _TAKEN, strict=True):
        std = float(np.sqrt(np.mean((spread @ taken.T) ** 2)))
        if std > _LEAST:
            found.append(FreeParameter(name, 0.0, float(unknown[list(corrected)].mean()) / std))
    return found
