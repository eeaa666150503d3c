"""What changed: the difference of two logs of one flight, effect by effect.

Two logs of one flight (logs/edits.py) have one and the same noise, and the same faults of the model.
So what is fitted is the difference of the whitened innovations itself,

    e_after(p + change) - e_before(p) = 0,

which holds exactly at the true change, whatever the model lacks. There is no noise in it, so that even
what would be lost in the noise of one flight is seen. What a set of changes is worth: trials.py.

Where the logs are the same up to a row, the change begins there: the model then changes at that moment
(estimation/changing_model.py), and only what is behind it counts. No fit finds the moment; it lies
between the last row that is the same and the first that is not.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from coax_env.comparison.two_logs.before import Before
from coax_env.comparison.two_logs.logs import Logs
from coax_env.comparison.two_logs.stated import LEAST_DIFFERENT, Changes, Since, stated
from coax_env.comparison.two_logs.trials import Trial, best_trials, holds, without_worthless
from coax_env.errors import InputError
from coax_env.estimation.engine import Engine
from coax_env.estimation.helicopter import Moment
from coax_env.estimation.state_space import Record
from coax_env.progress import Progress


def changes(before: Before, after: Sequence[Record], progress: Progress | None = None) -> Changes:
    """What a second log of the same flight says differently.

    Args:
        before: the one log under its model.
        after: the other log's records, with the same rows.
        progress: called with a line of text.

    Raises:
        InputError: the logs are not of the same flight.
    """
    _check_same_rows(before.problem.engine.records, after)
    since = first_difference(before.problem.engine.records, after)
    if since is not None:
        before = before.since(since.moment)
    problem, fit, chosen = before.problem, before.fit, before.problem.settings
    report = progress or (lambda text: None)
    there = [mask & np.isfinite(record.z) for mask, record in zip(before.there, after, strict=True)]
    logs = Logs(
        Engine(problem.model, after, problem.engine.threads), fit, before.innovations, there
    )
    slopes = _of_readings(before, there)
    nothing = logs.difference(fit.values)
    best = Trial((), {}, 0.0, nothing, np.zeros((nothing.size, 0)))
    alternatives: dict[str, tuple[str, ...]] = {}
    different = float(0.5 * nothing @ nothing)
    while different > LEAST_DIFFERENT and len(best.effects) < chosen.most_causes:
        trials = best_trials(logs, before.known, slopes, best, nothing)
        if not trials or not holds(trials[0], best, nothing, chosen):
            break
        new = trials[0].effects[-1]
        alternatives[new] = tuple(
            t.effects[-1] for t in trials[1:] if trials[0].nats - t.nats < chosen.tie
        )
        report(f"{new} changed: {trials[0].nats - best.nats:.1f} nats")
        best = without_worthless(logs, before.known, trials[0], nothing, chosen)
    found = stated(problem, logs, before.known, best, alternatives, nothing)
    return replace(found, since=since)


def first_difference(before: Sequence[Record], after: Sequence[Record]) -> Since | None:
    """From when on two logs of a flight differ; None where they do from the start, or nowhere.

    Args:
        before, after: their records, in the order in which they were flown, with the same rows.
    """
    for k, (one, other) in enumerate(zip(before, after, strict=True)):
        same = np.all(one.command == other.command, axis=1)
        same &= np.all((one.z == other.z) | (np.isnan(one.z) & np.isnan(other.z)), axis=1)
        if same.all():
            continue
        row = int(np.argmin(same))
        if row == 0:
            return Since(Moment(one.whole, float(one.t[0])), float(one.t[0]), 0.0) if k else None
        gap = float(one.t[row] - one.t[row - 1])
        moment = Moment(one.whole, float(one.t[row]))
        return Since(moment, moment.t - 0.5 * gap, gap / math.sqrt(12.0))
    return None


def _of_readings(before: Before, there: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Slopes of the log before, of those of its readings that are in both logs."""
    own = np.concatenate([mask.ravel() for mask in before.there])
    both = np.concatenate([mask.ravel() for mask in there])[own]
    return {effect: slopes[both] for effect, slopes in before.slopes.items()}


def _check_same_rows(before: Sequence[Record], after: Sequence[Record]) -> None:
    same = len(before) == len(after) and all(
        a.name == b.name and np.array_equal(a.t, b.t) for a, b in zip(before, after, strict=True)
    )
    if not same:
        raise InputError("these are not two logs of one flight: their runs or rows differ")
