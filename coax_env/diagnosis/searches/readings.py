"""Searches with readings as they were before what a sensor or a logger did to them.

Where motion stays coloured it is asked whether the times of the log's rows are wrong
(clock_errors.py), and the search done again with readings that are as good as these. Where gyros or
accelerometers come later than all else (late_imu.py) it is done again with them moved back; where they
are read through a low-pass (sensor_low_pass.py) it is done again with what was before
it; where errors of readings last (sensor_errors.py), with these in it. Low-passes are then fitted once
more, and what motors make of jitter is asked anew for readings as they are then.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from coax_env.diagnosis import late_imu
from coax_env.diagnosis.clock_errors import with_clock_errors
from coax_env.diagnosis.fits import is_all_white
from coax_env.diagnosis.late_readings import moved_as_in
from coax_env.diagnosis.onsets.search import most_by_change, with_onsets
from coax_env.diagnosis.problem import Problem
from coax_env.diagnosis.rotor_jitter import with_share_anew
from coax_env.diagnosis.searches.once import Searched, is_coloured, likelier, searched_once
from coax_env.diagnosis.sensor_errors import lasting_errors
from coax_env.diagnosis.sensor_low_pass import GROUPS, LIKE, hidden_behind, low_passes
from coax_env.estimation.changing_model import Lap
from coax_env.estimation.low_pass import LowPass, before_low_pass
from coax_env.estimation.state_space import Noise, Record
from coax_env.model.layout import INERTIAL
from coax_env.plain_words import and_list

NEAR = 0.3
"""Share of what errors that last are worth that one change in flight must be by its score, to be asked
instead of them. On three flights with such errors the best change was worth 0.05 to 0.15 of them, and
asking took 64 s of 110; growth scores less than it is worth; ours."""
NEARLY = 0.1
"""Share of its time by which a low-pass must be another one for a further search; ours."""


def with_true_times(first: Searched, noise: Noise) -> Searched:
    """The search with rows whose times are wrong, where they are; what was found, where not.

    Args:
        first: the search with times as logged. noise: levels to start from.
    """
    problem = with_clock_errors(first.problem, first.fit)
    if problem is None:
        return first
    problem.report("searching again with readings as good as the times of their rows")
    return searched_once(problem, noise)


def before_low_passes(first: Searched, noise: Noise) -> Searched | None:
    """The search with readings as they were before a low-pass, where there is one.

    Args:
        first: the search in readings as logged. noise: levels to start from.
    """
    problem = first.problem
    smoothed = low_passes(problem, first.fit, noise)
    if not smoothed:
        return None
    problem.report("searching again with readings as they were before a low-pass")
    return _searched_before(first, problem.engine.records, smoothed, noise)


def with_imu_on_time(first: Searched, smoothed: Searched | None, noise: Noise) -> Searched | None:
    """The search with gyros or accelerometers moved back, where they come later than all else.

    Args:
        first: the search in readings as logged. noise: levels to start from.
        smoothed: behind low-passes, which make readings late, too.
    """
    problem, fit = first.problem, first.fit
    if not fit.active and not is_coloured(first, problem.model.channels):
        return None
    rows, nats = late_imu.rows_late(problem, fit)
    behind = first.cost - lost(problem, smoothed) if smoothed is not None else 0.0
    if not rows or not nats > behind:
        return None
    problem.report(f"{and_list(list(rows))} come late: {nats:.1f} nats")
    records = late_imu.on_time(problem.engine.records, rows, problem.row)
    moved = replace(problem.with_records(records), late_imu=rows)
    problem.report("searching again with readings moved back to when they were")
    other = searched_once(moved, noise)
    gained = first.cost - other.cost + late_imu.worth_left_out(problem, fit, rows)
    return other if gained > problem.settings.sure_evidence else None


def with_errors(found: Searched, noise: Noise, clock: Mapping[str, Lap]) -> tuple[Searched, Noise]:
    """The search with errors of readings that last, where they do, and the levels that it started from.

    Args:
        found: without such errors. noise: levels that it started from.
        clock: of all runs in the order in which they were flown.
    """
    erring = lasting_errors(found.problem, found.fit, noise)
    if erring is None:
        return found, noise
    if not erring.whiten:
        left = replace(found.problem, errors_left=erring.gained)
        return replace(found, problem=left), noise
    changed = _white_since(found, clock, erring.gained)
    if changed is not None:
        return changed, noise
    erring.problem.report("searching again with errors of readings that last")
    begun = with_share_anew(erring.problem, erring.fit, erring.begun)
    return likelier(searched_once(erring.problem, begun), erring.fit), begun


def behind_other_low_passes(problem: Problem, found: Searched, noise: Noise) -> Searched:
    """The search behind low-passes as they are beside errors that last, where that is likelier.

    Without such errors a low-pass takes a part of them up, or is not seen: then it is asked for where
    something is named that looks like it.

    Args:
        problem: as given. found: with errors that last. noise: levels that it started from.
    """
    behind = [
        group
        for group in GROUPS
        if found.problem.low_passes.keys() & set(group) or LIKE[group] in found.fit.active
    ]
    if not behind:
        return found
    logged = moved_as_in(found.problem, problem.engine.records)
    passes = low_passes(found.problem.with_records(logged), found.fit, noise, behind)
    if _are_nearly(passes, _inertial(found.problem.low_passes)):
        return found
    problem.report("searching again with readings as they were before these low-passes")
    again = _searched_before(found, logged, passes, noise)
    return again if lost(problem, again) < lost(problem, found) else found


def lost(problem: Problem, found: Searched) -> float:
    """Cost of what was found to the readings as logged [nats].

    Args:
        problem: as given, with these.
    """
    channels = problem.model.channels
    passes = _inertial(found.problem.low_passes)
    back = (before_low_pass(r, channels, passes)[1] for r in problem.engine.records)
    return found.cost - sum(back)


def _searched_before(
    found: Searched, logged: Sequence[Record], passes: Mapping[str, LowPass], noise: Noise
) -> Searched:
    """The search with readings as they were before low-passes, for what can be told from these.

    Args:
        found: a search of the same problem. logged: readings as logged.
        passes: by channel. noise: levels to start from.
    """
    problem = found.problem
    asked = set(problem.candidates) - hidden_behind(passes, found.fit, problem)
    others = {c: own for c, own in problem.low_passes.items() if c not in INERTIAL}
    behind = replace(problem, low_passes=others).behind(passes, logged)
    begun = with_share_anew(behind, found.fit, noise)
    return searched_once(behind.of_candidates(asked), begun)


def _white_since(found: Searched, clock: Mapping[str, Lap], gained: float) -> Searched | None:
    """With what changed in flight, where that leaves nothing coloured: a gyro that drifts off once.

    Args:
        found: without errors that last, which would take that up.
        clock: of all runs in the order in which they were flown.
        gained: by those errors [nats]: not asked where no change comes near it.
    """
    if most_by_change(found.problem, found.fit, found.quadratic) < NEAR * gained:
        return None
    state = with_onsets(found.problem, found.fit, found.quadratic, found.refitted, clock)
    if not state.onsets or not is_all_white(state.problem, state.fit):
        return None
    return replace(found, changing=state)


def _inertial(passes: Mapping[str, LowPass]) -> dict[str, LowPass]:
    """Low-passes of gyros and accelerometers alone."""
    return {channel: own for channel, own in passes.items() if channel in INERTIAL}


def _are_nearly(passes: Mapping[str, LowPass], others: Mapping[str, LowPass]) -> bool:
    """Whether low-passes, by channel, are the others to a share of their times."""
    if passes.keys() != others.keys():
        return False
    pairs = [(passes[channel], others[channel]) for channel in passes]
    return all(a.order == b.order and abs(a.time - b.time) < NEARLY * b.time for a, b in pairs)
